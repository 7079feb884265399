"""The faults that ``benchmarks/mutants.py`` plants: each fits the code once, and the tests named for it exist."""

import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).parents[1]
sys.path.append(str(REPO / "benchmarks"))

import mutants  # noqa: E402
from faults import FAULTS, PARTS, TESTS  # noqa: E402
from faults.equivalents import EQUIVALENT  # noqa: E402
from faults.rows import Fault  # noqa: E402

KNOWN = mutants.modules()


@pytest.mark.parametrize("module", sorted({fault.module for fault in FAULTS}))
def test_every_fault_fits_the_code_once(module):
    source = KNOWN[mutants.module_of(module, KNOWN)].read_text()
    for fault in FAULTS:
        if fault.module == module:
            mutants.planted(source, fault)
            assert fault.old != fault.new, fault


def test_every_change_that_is_listed_as_equivalent_is_one_that_the_rules_give():
    for module in {key[0] for key in EQUIVALENT}:
        given = {(f.module, f.function, f.old, f.new) for f in mutants.by_rule(KNOWN[module].read_text(), module)}
        assert {key for key in EQUIVALENT if key[0] == module} <= given, module


def test_no_fault_is_planted_twice_and_no_table_hides_another():
    planted = [(f.module, f.function, f.old, f.new) for f in FAULTS]
    assert len(set(planted)) == len(planted), [fault for fault in planted if planted.count(fault) > 1]
    for name in ("FAULTS", "TESTS"):
        modules = [module for part in PARTS for module in getattr(part, name)]
        assert len(set(modules)) == len(modules), "two parts have one module"


def test_every_module_with_a_fault_names_tests_that_exist():
    assert {mutants.module_of(fault.module, KNOWN) for fault in FAULTS} <= set(TESTS) <= set(KNOWN)
    for tests in TESTS.values():
        for test in tests:
            path, _, name = test.partition("::")
            assert (REPO / path).is_file(), test
            assert f"def {name}(" in (REPO / path).read_text() if name else True, test


def test_every_module_of_the_method_has_a_fault():
    spoken_of = {mutants.module_of(fault.module, KNOWN) for fault in FAULTS}
    method = mutants.modules(places=mutants.METHOD)
    empty = {name for name, path in method.items() if "def " not in path.read_text()}
    assert set(method) - spoken_of - empty == set()


def test_every_package_has_its_share_of_faults():
    sparse = [
        (row["package"], row["lines"], row["faults"])
        for row in mutants.by_package([])
        if row["faults"] < mutants.MIN_DENSITY * row["lines"] / 1000
    ]
    assert not sparse


def test_a_package_of_the_tree_is_listed_or_left_out_by_name():
    top = {path.stem for path in (REPO / "dhtorch").iterdir() if not path.name.startswith((".", "_"))} - {"py"}
    assert top - {place.split("/")[0] for place in mutants.PLACES} == mutants.UNPLANTED


def test_a_run_of_one_package_keeps_the_rows_of_the_others():
    one, other = (
        {"module": mutants.module_of(f.module, KNOWN), "function": f.function, "old": f.old, "new": f.new}
        for f in (FAULTS[0], FAULTS[-1])
    )
    gone = one | {"old": "a text that no fault has", "verdict": "caught"}
    before = [one | {"verdict": "missed"}, other | {"verdict": "caught"}, gone]
    rows = mutants.joined(before, [one | {"verdict": "caught"}])
    assert sorted(row["module"] for row in rows) == sorted([one["module"], other["module"]])
    assert {row["verdict"] for row in rows} == {"caught"}


def test_rules_leave_out_options_and_take_the_first_for_each():
    source = "def f(x, k):\n    return g(x[k], scale=2) if x else any(h(x, k, 1))\n"
    changed = {fault.new for fault in mutants.by_rule(source, "m")}
    for part in ("g(x[0], scale=2)", "g(x[k])", "if not x else", "all(h(x, k, 1))", "h(x, k, 2)", "scale=3"):
        assert any(part in line for line in changed), part


def test_a_fault_in_cpp_is_placed_within_its_function():
    source = "// a\nconstexpr int kSize = 3;\nstatic int add(int a,\n    int b) {\n  if (a) { b += 1; }\n  return a + b;\n}\n"
    changed = mutants.planted(source, Fault("m", "add", "a + b", "a - b"))
    assert changed == source.replace("a + b", "a - b")
    assert "kSize = 4" in mutants.planted(source, Fault("m", "kSize", "3", "4"))
    with pytest.raises(ValueError, match="no subtract"):
        mutants.placed(source, Fault("m", "subtract", "a", "b"))


def test_what_does_not_fit_is_refused():
    source = "def double(x):\n    return x + x\n"
    assert "x - x" in mutants.planted(source, Fault("m", "double", "x + x", "x - x"))
    for fault in (Fault("m", "double", "x * x", ""), Fault("m", "double", "x", "y"), Fault("m", "treble", "x", "y")):
        with pytest.raises(ValueError, match="mutants: "):
            mutants.placed(source, fault)


def test_the_command_says_what_it_takes():
    words = [sys.executable, "benchmarks/mutants.py", "--help"]
    told = subprocess.run(words, cwd=REPO, capture_output=True, text=True, check=True)
    assert "--sweep" in told.stdout


def test_a_place_that_is_none_is_refused():
    assert mutants.within(["geometry.se3", "runtime.storage"], KNOWN) == ["geometry.se3", "runtime.storage"]
    assert set(mutants.within(["stages"], KNOWN)) == {m for m in KNOWN if m.startswith("stages.") or m == "stages"}
    with pytest.raises(ValueError, match="'se3' names no module"):
        mutants.within(["runtime.storage", "se3"], KNOWN)
