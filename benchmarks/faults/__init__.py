"""The faults that ``mutants.py`` plants, by the part of the house they are in, and the tests that must notice.

A row is (function, text that is there once, text that takes its place); a fourth entry says why the fault changes no
answer. Rows come from what was once not noticed, and from what the rules of ``mutants.py --sweep`` drew.
"""

from pathlib import Path

from faults import (
    commanding,
    compiled,
    covering,
    enriching,
    entry,
    front,
    geometry,
    joining,
    judging,
    kornia,
    mapping,
    pose_priors,
    reading,
    ruling,
    solving,
    sweeping,
    windows,
    writing,
)
from faults.rows import Fault, faults

PARTS = (
    *(geometry, solving, windows, front, kornia, joining, pose_priors),
    *(sweeping, entry, enriching, judging, ruling, writing, reading, commanding, mapping, compiled),
)

FAULTS: list[Fault] = [fault for part in PARTS for fault in faults(part.FAULTS)]

_NAMED: dict[str, list[str]] = {module: tests for part in PARTS for module, tests in part.TESTS.items()}

#: Tests that compare answers, readings and figures with stored ones, by package.
_STORED = dict.fromkeys(
    ("alignment", "calibration", "geometry", "integrate", "measure", "metrics"), "test_stored_answers"
)
_STORED |= dict.fromkeys(("pipeline", "records", "stages", "validation", "experiments"), "test_stored_answers")
_STORED |= {"data": "data/test_stored_readings", "viz": "viz/test_drawn_figures"}


#: Packages with public functions that ``test_contract.py`` calls.
_IN_CONTRACT = ("alignment", "geometry", "metrics", "pipeline", "stages", "validation")

_ROOT = Path(__file__).resolve().parents[2]


def _tests_of(module: str) -> list[str]:
    """The module's own tests, those of stored values, further ones that run its lines, and then all of its package."""
    package = module.split(".", maxsplit=1)[0]
    stored = _STORED.get(package)
    own = [*_NAMED.get(module, []), *([f"tests/{stored}.py"] if stored else []), *covering.TESTS.get(module, [])]
    contract = ["tests/test_contract.py"] if package in _IN_CONTRACT else []
    rest = sorted(path.relative_to(_ROOT).as_posix() for path in (_ROOT / "tests" / package).glob("test_*.py"))
    return list(dict.fromkeys([*own, *contract, *rest]))


#: Module → the tests that are to notice, in the order in which they run.
TESTS: dict[str, list[str]] = {module: _tests_of(module) for module in dict.fromkeys([*_NAMED, *covering.TESTS])}
