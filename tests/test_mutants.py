"""``benchmarks/mutants.py``: what is drawn can be planted, and depends on the seed alone."""

import sys
from pathlib import Path

REPO = Path(__file__).parents[1]
sys.path.append(str(REPO / "benchmarks"))

import mutants  # noqa: E402


def test_each_drawn_fault_changes_one_line_of_its_file_and_no_equivalent_is_drawn():
    drawn = mutants.draw(40, ["geometry", "ops"], "a")
    assert len(drawn) == 40 and drawn == mutants.draw(40, ["geometry", "ops"], "a") != mutants.draw(
        40, ["geometry", "ops"], "b"
    )
    for fault in drawn:
        assert (REPO / fault.file).read_text().splitlines()[fault.line - 1] == fault.old != fault.new
    assert not mutants._counts(drawn[0]._replace(old="zip(a, b, strict=True)", new="zip(a, b, strict=False)"))
