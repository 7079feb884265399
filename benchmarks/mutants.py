"""Do the tests notice? Plants one fault at a time in a copy of the tree and runs the tests of the module it is in.

    python benchmarks/mutants.py                                   # every fault of benchmarks/faults/
    python benchmarks/mutants.py geometry.se3 stages.pose          # those of some modules
    python benchmarks/mutants.py --every 4                         # a quarter of each module's
    python benchmarks/mutants.py --sweep 0.1 --seed 1f geometry    # a tenth of what the rules give instead
    python benchmarks/mutants.py --tests OLD/tests --json FILE     # the tests of another checkout
    python benchmarks/mutants.py --among tests/viz viz             # of the tests that are named, those in tests/viz
    python benchmarks/mutants.py --keyword "pose or lens" viz       # of these, those that pytest -k selects
    python benchmarks/mutants.py --list                            # faults per 1,000 lines of a package, nothing run

A fault is caught when a test of the module itself fails. Faults are named by function and by the text that is replaced,
never by line, so they survive moves; a text that is no longer there, or there twice, is an error. The copy is thrown
away. Every fault is tried in a process of its own, forked from one that has torch loaded. A fault in C++ is compiled
in the copy; files without one come from a cache beside it. ``--json`` keeps the rows of FILE whose faults are still
listed and were not tried again.
"""

from __future__ import annotations

import argparse
import ast
import gc
import itertools
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, thread
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from faults import FAULTS, TESTS
from faults.equivalents import EQUIVALENT
from faults.rows import Fault

ROOT = Path(__file__).resolve().parents[1]

#: Folders and files of the package that faults are planted in: all that computes or converts; of the laboratory what
#: others are measured with.
PLACES = (
    "alignment",
    "calibration",
    "cli",
    "codes",
    "data",
    "export",
    "extract",
    "functional",
    "geometry",
    "integrate",
    "losses",
    "measure",
    "metrics",
    "ops",
    "pipeline",
    "pytree",
    "records",
    "runtime",
    "stages",
    "transforms",
    "validation",
    "viz",
    "experiments/compare_methods",
    "experiments/probes/ridge",
)

#: Parts of the package that no answer is computed or converted in, or only for tests and studies.
UNPLANTED = {"synthetic", "testing"}

#: Fewest hand-written faults of a package per 1,000 lines of its code.
MIN_DENSITY = 12

#: Those of them in which every module has a fault of its own.
METHOD = (
    "records",
    "stages",
    "geometry",
    "pipeline/spec",
    "pipeline/method",
    "pipeline/presets",
    "pipeline/pair",
    "pipeline/multiview",
    "pipeline/view_report",
    "pipeline/view_selection",
    "pipeline/stream",
    "pipeline/dense",
    "pipeline/fused",
    "pipeline/completion",
    "pipeline/planes",
    "pipeline/surface",
    "pipeline/map_filters",
    "ops/loader",
    "ops/builder",
    "ops/dispatch",
    "alignment",
    "validation",
    "metrics",
    "calibration/monotone",
    "calibration/score_calibration",
    "experiments/compare_methods",
    "experiments/probes/ridge",
    "transforms",
    "runtime/code_dependencies",
    "runtime/results",
    "runtime/allocator",
    "runtime/output_folder",
    "runtime/storage",
    "extract",
)

#: pytest's ``-k`` of this run.
KEYWORD = [""]

#: The tests of every public function in one table, of which a module has its own rows.
TABLE = "tests/test_contract.py"

#: What the tests of a trial leave in its tree.
FAILURE, TIMES = "first_failure.txt", "seconds.json"

#: The last line of a table.
ALL = "all"

#: pytest's exit code where no test is left.
NONE = 5

#: What the copy of the tree leaves behind.
LEFT = (
    ".git",
    ".venv",
    "outputs",
    "multirun",
    "__pycache__",
    "*.egg-info",
    ".pytest_cache",
    ".mypy_cache",
    ".ruff_cache",
)


# ------------------------------------------------------------------------------------------------ where a fault goes


def modules(root: Path = ROOT, places: Sequence[str] = PLACES) -> dict[str, Path]:
    """Modules of some places by dotted name below the package, C++ sources included."""
    files = {}
    for place in places:
        base = root / "dhtorch" / place
        sources = [base.with_suffix(".py")] if base.with_suffix(".py").exists() else base.rglob("*.[ch]*")
        python = [] if base.with_suffix(".py").exists() else base.rglob("*.py")
        for path in sorted([*sources, *python]):
            if path.suffix in (".py", ".cpp", ".h"):
                parts = path.relative_to(root / "dhtorch").with_suffix("").parts
                files[".".join(p for p in parts if p != "__init__")] = path
    return files


def package_of(module: str) -> str:
    """The package that a module lies in; compiled sources and laboratory modules count apart."""
    first, *rest = module.split(".")
    return f"{first}.csrc" if rest[:1] == ["csrc"] else first


def code_lines(path: Path) -> int:
    """Lines of a file that hold code: no blank line, comment, docstring or import."""
    text = path.read_text().splitlines()
    if path.suffix != ".py":
        return sum(1 for line in text if line.strip() and not line.strip().startswith(("//", "#")))
    rows: set[int] = set()
    for node in ast.walk(ast.parse("\n".join(text))):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.stmt) and not is_text and not isinstance(node, ast.Import | ast.ImportFrom):
            body = getattr(node, "body", None)
            rows.update(range(node.lineno, body[0].lineno if body else (node.end_lineno or 0) + 1))
    return sum(1 for row in rows if text[row - 1].strip() and not text[row - 1].strip().startswith(("#", '"""')))


def module_of(name: str, known: Iterable[str]) -> str:
    """The one known module whose dotted name is ``name`` or ends in it."""
    known = list(known)
    ends = [name] if name in known else [k for k in known if k.endswith(f".{name}")]
    if len(ends) != 1:
        raise ValueError(f"mutants: {name!r} names {ends or 'no module'}, expected one")
    return ends[0]


def within(places: Sequence[str], known: Iterable[str]) -> list[str]:
    """The known modules that are, or lie in, some places by dotted name."""
    known = list(known)
    by_place = {place: [m for m in known if f"{m}.".startswith(f"{place}.")] for place in places}
    for place, modules_there in by_place.items():
        if not modules_there:
            raise ValueError(f"mutants: {place!r} names no module, expected one or a folder of {', '.join(PLACES)}")
    return [m for m in known if any(m in there for there in by_place.values())]


def span(source: str, function: str) -> tuple[int, int]:
    """Where the definition of ``function`` begins and ends, in characters; of Python, else of C++."""
    if _is_cpp(source):
        return _cpp_span(source, function)
    body: Sequence[ast.stmt] = _parsed(source).body
    lines = source.splitlines(keepends=True)
    offset = [0]
    for line in lines:
        offset.append(offset[-1] + len(line))
    node: Any = None
    for word in function.split("."):
        node = next((x for x in body if word in _names(x)), None)
        if node is None:
            raise ValueError(f"mutants: no {function} to plant a fault in")
        body = getattr(node, "body", [])
    first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
    return offset[first - 1], offset[node.end_lineno]


def _is_cpp(source: str) -> bool:
    return source.startswith(("//", "#include", "#pragma"))


def _cpp_span(source: str, function: str) -> tuple[int, int]:
    """From the name of a function (or of what is assigned) to the end of its braces or statement."""
    begin = re.search(rf"\b{re.escape(function)}\s*(\([^;{{}}]*\)[^;{{}}()]*\{{|=)", source)
    if begin is None:
        raise ValueError(f"mutants: no {function} to plant a fault in")
    if begin.group().endswith("="):
        return begin.start(), source.index(";", begin.end())
    depth, at = 1, begin.end()
    while depth:
        depth += {"{": 1, "}": -1}.get(source[at], 0)
        at += 1
    return begin.start(), at


@lru_cache(maxsize=4)
def _parsed(source: str) -> ast.Module:
    return ast.parse(source)


def _names(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    if isinstance(node, ast.Assign):
        return [name.id for t in node.targets for name in ast.walk(t) if isinstance(name, ast.Name)]
    if isinstance(node, ast.AnnAssign | ast.AugAssign) and isinstance(node.target, ast.Name):
        return [node.target.id]
    return []


def placed(source: str, fault: Fault) -> tuple[int, int]:
    """Where the function of a fault begins and ends; the text to be replaced must be there once."""
    first, last = span(source, fault.function)
    inside = source[first:last]
    if inside.count(fault.old) != 1:
        raise ValueError(
            f"mutants: {fault.module}.{fault.function} holds {fault.old!r} {inside.count(fault.old)} times, expected 1"
        )
    return first, last


def planted(source: str, fault: Fault) -> str:
    """The source with the fault in it."""
    first, last = placed(source, fault)
    inside = source[first:last]
    changed = source[:first] + inside.replace(fault.old, fault.new) + source[last:]
    if not _is_cpp(source):
        ast.parse(_dedented(changed[first : last + len(changed) - len(source)]))
    return changed


# ------------------------------------------------------------------------------------------------ faults by rule

_SWAPS: dict[type, tuple[str, str]] = {
    **{ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.Pow: ("**", "*")},
    **{ast.Lt: ("<", ">"), ast.Gt: (">", "<"), ast.LtE: ("<=", ">="), ast.GtE: (">=", "<="), ast.Eq: ("==", "!=")},
    **{ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"), ast.And: ("and", "or"), ast.Or: ("or", "and")},
    **{ast.FloorDiv: ("//", "/"), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is")},
}

_TWINS = {"minimum": "maximum", "sin": "cos", "amin": "amax", "any": "all", "argmin": "argmax", "min": "max"}
_TWINS |= {"clamp_min": "clamp_max", "zeros_like": "ones_like", "mean": "sum", "floor": "ceil", "cumsum": "flip"}
_TWINS |= {"width": "height", "left": "right", "first": "last", "start": "end", "logical_and": "logical_or"}
_TWINS |= {"isfinite": "isnan", "startswith": "endswith", "argmax": "argmin", "sum": "mean", "rows": "columns"}
_TWINS |= {b: a for a, b in _TWINS.items()}

#: Calls of a name, not of an attribute.
_NAME_TWINS = {"any": "all", "all": "any", "min": "max", "max": "min", "sorted": "list"}


def by_rule(source: str, module: str) -> Iterator[Fault]:
    """One fault for each change of the rules, where the text that it replaces is unique.

    Operators exchanged, numbers changed (indices, axes and units among them), signs and negations dropped, conditions
    inverted, ``any`` for ``all``, the first element for one that a variable names, a keyword argument, an entry of a
    tuple or of a dictionary left out.
    """
    if _is_cpp(source):
        yield from _cpp_by_rule(source, module)
        return
    for function in _functions(ast.parse(source)):
        first, last = span(source, function)
        inside = source[first:last]
        tree = ast.parse(_dedented(inside))
        flat = _dedented(inside).splitlines(keepends=True)
        annotations = _annotations(tree)
        for node in (x for x in ast.walk(tree) if x not in annotations):
            for statement, (a, b), new in _changes(node, flat):
                old, changed = _around(flat, statement, a, b, new)
                if inside.count(old) == 1 and old != changed:
                    yield Fault(module, function, old, changed)


def known_equivalent(fault: Fault) -> Fault:
    """The fault, with the reason why it changes no answer where one is listed."""
    reason = EQUIVALENT.get((fault.module, fault.function, fault.old, fault.new), "")
    return replace(fault, equivalent=reason) if reason else fault


def _is_code(path: Path, fault: Fault) -> bool:
    """Whether a file can be parsed with the fault; C++ is left to its compiler."""
    try:
        return path.suffix != ".py" or bool(ast.parse(planted(path.read_text(), fault)))
    except SyntaxError:
        return False


def _annotations(tree: ast.AST) -> set[ast.AST]:
    """Nodes of annotations, which Python does not evaluate here."""
    fields = (getattr(node, name, None) for node in ast.walk(tree) for name in ("annotation", "returns"))
    return {node for field in fields if field is not None for node in ast.walk(field)}


def _cpp_by_rule(source: str, module: str) -> Iterator[Fault]:
    """Every spaced operator of a C++ function exchanged."""
    swaps = {" + ": " - ", " - ": " + ", " * ": " / ", " < ": " > ", " > ": " < ", " && ": " || ", " || ": " && "}
    for function in dict.fromkeys(re.findall(r"^(?!namespace)[\w:<>,&* ]*?(\w+)\([^;{}]*\)\s*\{$", source, re.M)):
        first, last = _cpp_span(source, function)
        inside = source[first:last]
        for line in (x.strip() for x in inside.splitlines()[1:]):
            for old in (o for o in swaps if line.count(o) == 1 and inside.count(line) == 1):
                yield Fault(module, function, line, line.replace(old, swaps[old]))


def _functions(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.ClassDef):
            yield from (f"{node.name}.{x.name}" for x in node.body if isinstance(x, ast.FunctionDef))


def _dedented(text: str) -> str:
    indent = len(text) - len(text.lstrip(" "))
    return "".join(line[indent:] if line[:indent].isspace() or not indent else line for line in text.splitlines(True))


def _changes(node: ast.AST, lines: list[str]) -> Iterator[tuple[int, tuple[int, int], str]]:
    """(line, (first, last) column, new text) of what the rules do to a node that fits on one line."""
    if getattr(node, "lineno", 0) != getattr(node, "end_lineno", -1):
        return
    row: int = node.lineno - 1  # type: ignore[attr-defined]
    pairs = []
    if isinstance(node, ast.BinOp):
        pairs = [(node.left, node.op, node.right)]
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        pairs = [(node.left, node.ops[0], node.comparators[0])]
    elif isinstance(node, ast.BoolOp):
        pairs = [(node.values[0], node.op, node.values[1])]
    for left, op, right in pairs:
        if type(op) in _SWAPS:
            old, new = _SWAPS[type(op)]
            a = lines[row].find(
                old, _column(lines[row], left.end_col_offset or 0), _column(lines[row], right.col_offset)
            )
            if a >= 0:
                yield row, (a, a + len(old)), new
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        a, b = _column(lines[row], node.col_offset), _column(lines[row], node.end_col_offset or 0)
        yield row, (a, b), str(node.value + 1 if type(node.value) is int else node.value * 2 or 1.0)
    if isinstance(node, ast.Constant) and type(node.value) is bool:
        a, b = _column(lines[row], node.col_offset), _column(lines[row], node.end_col_offset or 0)
        yield row, (a, b), str(not node.value)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Invert | ast.Not):
        a = _column(lines[row], node.col_offset)
        yield row, (a, _column(lines[row], node.operand.col_offset)), " "
    if isinstance(node, ast.Attribute) and node.attr in _TWINS:
        b = _column(lines[row], node.end_col_offset or 0)
        yield row, (b - len(node.attr), b), _TWINS[node.attr]
    yield from _omissions(node, row, lines[row])


def _omissions(node: ast.AST, row: int, line: str) -> Iterator[tuple[int, tuple[int, int], str]]:
    """The changes of ``_changes`` that invert a condition, leave an entry out, or take the first for the one named."""

    def columns(first: Any, last: Any) -> tuple[int, int]:
        return _column(line, first.col_offset), _column(line, last.end_col_offset)

    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _NAME_TWINS:
        yield row, columns(node.func, node.func), _NAME_TWINS[node.func.id]
    if isinstance(node, ast.Call):
        before = [*node.args, *node.keywords]
        for previous, option in itertools.pairwise(before):
            if isinstance(option, ast.keyword):
                yield row, (columns(previous, previous)[1], columns(option, option)[1]), ""
    if isinstance(node, ast.Tuple | ast.List) and len(node.elts) > 2 and isinstance(node.ctx, ast.Load):
        yield row, (columns(node.elts[-2], node.elts[-2])[1], columns(node.elts[-1], node.elts[-1])[1]), ""
    if isinstance(node, ast.Dict) and len(node.values) > 1:
        yield row, (columns(node.values[-2], node.values[-2])[1], columns(node.values[-1], node.values[-1])[1]), ""
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Name) and isinstance(node.ctx, ast.Load):
        yield row, columns(node.slice, node.slice), "0"
    if isinstance(node, ast.IfExp) and not isinstance(node.test, ast.BoolOp | ast.Compare):
        a, b = columns(node.test, node.test)
        yield row, (a, b), f"not {line[a:b]}"


def _column(line: str, offset: int) -> int:
    """Characters for ast's bytes."""
    return len(line.encode()[:offset].decode())


def _around(lines: list[str], row: int, a: int, b: int, new: str) -> tuple[str, str]:
    line = lines[row].rstrip("\n")
    strip = len(line) - len(line.lstrip())
    return line[strip:], line[strip:a] + new + line[b:]


# ------------------------------------------------------------------------------------------------ trying one


def warm() -> None:
    """What every trial needs and no fault is in, loaded once."""
    import cv2  # noqa: F401
    import hydra  # noqa: F401
    import hypothesis  # noqa: F401
    import kornia  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    import pytest  # noqa: F401
    import torch
    import torch._dynamo
    from torch.func import jacfwd  # noqa: F401

    torch.set_num_threads(1)
    gc.freeze()  # a fork's collections leave alone what it shares with its parent


class Order:
    """Keeps those tests of the contract's table that belong to the module; quick ones first, as they once were."""

    def __init__(self, module: str, seconds: Mapping[str, float]) -> None:
        self.stem, self.seconds = module.rsplit(".", 1)[-1], seconds

    def pytest_collection_modifyitems(self, items: list) -> None:
        """Drop the rows of other modules, and sort."""
        mine = [x for x in items if "test_contract" not in x.nodeid or re.search(rf"[\[-]{self.stem}\.", x.nodeid)]
        items[:] = sorted(mine, key=lambda x: self.seconds.get(x.nodeid, 0.0))


class Record:
    """Writes down the seconds of every test, and the first test that failed and why."""

    def __init__(self, tree: Path) -> None:
        self.failure, self.times = tree / FAILURE, tree / TIMES
        self.seconds: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        """A failure at once: the process may not end well."""
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + getattr(report, "duration", 0.0)
        if report.failed and not self.failure.exists():
            crash = getattr(report.longrepr, "reprcrash", None)
            self.failure.write_text(f"{report.nodeid}\n{getattr(crash, 'message', report.longrepr)}")

    def pytest_collectreport(self, report: Any) -> None:
        """A module that cannot be imported is noticed, too."""
        self.pytest_runtest_logreport(report)

    def pytest_sessionfinish(self) -> None:
        """What the next run is ordered by."""
        self.times.write_text(json.dumps(self.seconds))


#: Words of pytest where the package, which all tests load, cannot be imported with the fault.
UNLOADED = "ImportError while loading conftest"


class Tried(NamedTuple):
    """What became of some tests."""

    failed: bool
    why: str = ""  # which test first, and its reason
    seconds: Mapping[str, float] = MappingProxyType({})  # of every test that ended


def trial(tree: Path, module: str, tests: Sequence[str], limit_s: float, order: Mapping[str, float]) -> Tried:
    """Run the module's tests over the tree in a fork; a fault that C++ cannot be compiled with is caught."""
    failure, times = tree / FAILURE, tree / TIMES
    for path in (failure, times):
        path.unlink(missing_ok=True)
    start = time.perf_counter()
    child = os.fork()
    if child == 0:
        os.setsid()
        _run_tests(tree, module, tests, order)
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done or time.perf_counter() - start > limit_s:
            break
        time.sleep(0.02)
    if not done:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return Tried(True, f"did not end in {limit_s:.0f} s")
    code = os.waitstatus_to_exitcode(status)
    if code < 0 and not failure.exists():
        return Tried(True, f"ended by {signal.Signals(-code).name}")
    if code not in (0, 1, NONE) and not failure.exists():
        log = (tree / "log").read_text()
        if UNLOADED not in log:
            raise RuntimeError(f"mutants: the tests of {module} could not be run (exit code {code}): {log[-2000:]}")
        return Tried(True, f"{UNLOADED}: {log.strip().splitlines()[-1]}")
    why, seconds = (
        failure.read_text() if failure.exists() else "",
        json.loads(times.read_text()) if times.exists() else {},
    )
    return Tried(code not in (0, NONE), why, seconds)


def _run_tests(tree: Path, module: str, tests: Sequence[str], order: Mapping[str, float]) -> None:
    """In the fork: the package and its tests come from the tree, also for processes that the tests start."""
    code = 2
    try:
        log = os.open(tree / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(tree)
        vars(thread)["_threads_queues"].clear()  # a process that a test forks would wait for this one's pool, and fail
        os.environ |= {"PYTHONPATH": str(tree), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "DHTORCH_OPS": "0"}
        if ".csrc." in module:
            os.environ["CXX"] = f"{sys.executable} {Path(__file__).resolve().with_name('cached_compiler.py')}"
        sys.path[:0] = [str(tree)]
        import pytest

        options = ["-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow", "-k", KEYWORD[0]]
        code = int(pytest.main([*options, *tests], plugins=[Order(module, order), Record(tree)]))
    finally:
        sys.stdout.flush()
        os._exit(code)


class Bench:
    """A copy of the tree that faults are planted in, one after the other."""

    def __init__(self, folder: Path, tests: Path) -> None:
        self.tree, self.second = folder, 1_000_000_000
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*LEFT), dirs_exist_ok=True)
        shutil.rmtree(folder / "tests")
        shutil.copytree(tests, folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))

    def run(
        self, fault: Fault | None, module: str, tests: Sequence[str], limit_s: float, order: Mapping[str, float]
    ) -> Tried:
        """Plant, run, take out again."""
        path = modules(self.tree)[module]
        source = path.read_text()
        tests = [t for t in tests if (self.tree / t.split("::")[0]).exists()]
        table = [t for t in tests if t == TABLE]  # long to collect, and seldom needed
        outcome = Tried(False)
        try:
            if fault is not None:
                self._write(path, planted(source, fault))
            for some in ([t for t in tests if t not in table], table):
                if some and not outcome.failed:
                    more = trial(self.tree, module, some, limit_s, order)
                    outcome = more._replace(seconds={**outcome.seconds, **more.seconds})
            return outcome
        finally:
            self._write(path, source)

    def _write(self, path: Path, source: str) -> None:
        """Each version has a second of its own: what is compiled of one is not taken for another of the same length."""
        path.write_text(source)
        self.second += 1
        os.utime(path, (self.second, self.second))


def run(
    faults: Sequence[Fault], tests_of: dict[str, list[str]], tests: Path, jobs: int, quiet: bool
) -> Iterator[dict[str, Any]]:
    """Try every fault; rows with what caught it, as they come in order."""
    known = modules()
    named = [(module_of(f.module, known), f) for f in faults]
    for module, fault in named:
        placed(known[module].read_text(), fault)  # said before anything runs
    warm()
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        benches = [Bench(Path(folder) / str(k), tests) for k in range(jobs)]
        clean = _clean(benches, sorted({m for m, _ in named}), tests_of)
        whole = {module: sum(of.values()) for module, of in clean.items()}

        def one(k: int) -> dict[str, Any]:
            bench = free.pop()
            module, fault = named[k]
            try:
                outcome = bench.run(fault, module, tests_of[module], 60 + 4 * whole[module], clean[module])
            finally:
                free.append(bench)
            row = row_of(module, fault, outcome)
            if not quiet or row["verdict"] in ("missed", "noticed"):
                place = f"{module}.{fault.function}"
                print(f"{row['verdict']:10} {place}: {fault.old!r} -> {fault.new!r}  {row.get('by', '')}", flush=True)
            return row

        free = list(benches)
        with ThreadPoolExecutor(jobs) as pool:
            yield from pool.map(one, range(len(named)))


def _clean(benches: list[Bench], wanted: list[str], tests_of: dict[str, list[str]]) -> dict[str, Mapping[str, float]]:
    """Seconds that each test of every module takes as it is; they must pass. A file is run once for all modules."""
    free = list(benches)
    owner = {(module if test == TABLE else "", test): module for module in wanted for test in tests_of[module]}

    def one(key: tuple[str, str]) -> Mapping[str, float]:
        bench = free.pop()
        try:
            outcome = bench.run(None, owner[key], [key[1]], 600, {})
            if outcome.failed:
                raise RuntimeError(f"mutants: {key[1]} fails without a fault: {outcome.why}")
            return outcome.seconds
        finally:
            free.append(bench)

    with ThreadPoolExecutor(len(benches)) as pool:
        of = dict(zip(owner, pool.map(one, owner), strict=True))
    return {
        module: {k: v for test in tests_of[module] for k, v in of[module if test == TABLE else "", test].items()}
        for module in wanted
    }


def row_of(module: str, fault: Fault, outcome: Tried) -> dict[str, Any]:
    """What became of one fault. ``noticed``: said to change no answer, and yet a test failed."""
    right, wrong = ("noticed", "equivalent") if fault.equivalent else ("caught", "missed")
    row = {"module": module, "function": fault.function, "old": fault.old, "new": fault.new}
    details = {"reason": fault.equivalent} if fault.equivalent else {"by": outcome.why.partition("\n")[0]}
    return row | {"verdict": right if outcome.failed else wrong} | details


def by_module(rows: Sequence[dict[str, Any]], *, packages: bool = False) -> list[tuple[str, int, int, int]]:
    """Module (or package), faults caught, how many change an answer, and how many change none; then the same of all."""
    names = [package_of(row["module"]) if packages else row["module"] for row in rows]
    count = Counter((each, row["verdict"]) for name, row in zip(names, rows, strict=True) for each in (name, ALL))
    return [
        (name, count[name, "caught"], count[name, "caught"] + count[name, "missed"], count[name, "equivalent"])
        for name in [*sorted(set(names)), ALL]
    ]


def by_package(rows: Sequence[dict[str, Any]], faults: Sequence[Fault] = FAULTS) -> list[dict[str, Any]]:
    """Of every package: lines of code, faults listed, and of those tried how many are to be caught, and were."""
    known = modules()
    lines, listed = Counter[str](), Counter[str]()
    for name, path in known.items():
        lines[package_of(name)] += code_lines(path)
    for fault in faults:
        listed[package_of(module_of(fault.module, known))] += 1
    tried = Counter((package_of(row["module"]), row["verdict"]) for row in rows)
    return [
        {
            "package": name,
            "lines": lines[name],
            "faults": listed[name],
            "caught": tried[name, "caught"],
            "of": tried[name, "caught"] + tried[name, "missed"],
        }
        for name in sorted(lines)
    ]


def density(rows: Sequence[dict[str, Any]]) -> str:
    """The table of ``by_package``."""
    lines = [
        f"{row['package']:16} {row['lines']:6} {row['faults']:6} {1000 * row['faults'] / max(1, row['lines']):9.1f}"
        f" {row['caught']:6} {row['of']:6} {row['caught'] / row['of'] if row['of'] else float('nan'):7.1%}"
        for row in rows
    ]
    return "\n".join([f"{'package':16} {'lines':>6} {'faults':>6} {'per 1,000':>9} {'caught':>6} {'of':>6}", *lines])


def joined(before: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of earlier runs whose fault is still listed and was not tried again, and the new ones; by module."""

    def key(row: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(row[name] for name in ("module", "function", "old", "new"))

    known = modules()
    listed = {(module_of(f.module, known), f.function, f.old, f.new): k for k, f in enumerate(FAULTS)}
    latest = {key(row): row for row in [*before, *rows]}
    return [latest[each] for each in sorted(latest.keys() & listed.keys(), key=lambda each: (each[0], listed[each]))]


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Caught of those that change an answer, by module."""
    counts = by_module(rows)
    lines = [f"{name:28} {caught:6} {of:3} {same or '':>6}" for name, caught, of, same in counts]
    _, caught, of, _ = counts[-1]
    share = f" = {caught / of:.1%}" if of else ""
    return "\n".join([f"{'module':28} caught  of  equivalent", *lines]) + share


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", help="dotted names below dhtorch, or their beginnings; all of them")
    parser.add_argument("--sweep", type=float, default=0.0, help="draw this share of what the rules give instead")
    parser.add_argument("--seed", default="0", help="any text that the draw is to depend on, a commit for one")
    parser.add_argument("--untried", action="store_true", help="leave out the faults that FILE of --json has a row of")
    parser.add_argument("--list", action="store_true", help="run nothing; print what is listed for every package")
    parser.add_argument(
        "--every", type=int, default=1, help="of each module's faults only every so many, the first too"
    )
    parser.add_argument("--tests", type=Path, default=ROOT / "tests", help="folder of tests, this checkout's")
    parser.add_argument("--among", default="", help="of the tests that are named, those below this path")
    parser.add_argument("--keyword", default="", help="of these, those that match (pytest -k); misses are not recorded")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--quiet", action="store_true", help="print only what was missed")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    known = modules()
    wanted = within(args.modules, known) if args.modules else list(known)
    if args.list:
        print(density(by_package([])))
        return 0
    before = json.loads(args.json.read_text()) if args.json and args.json.exists() and not args.sweep else []
    if args.sweep:
        drawn = [f for m in wanted if m in TESTS for f in by_rule(known[m].read_text(), m)]
        faults = random.Random(args.seed).sample(drawn, round(args.sweep * len(drawn)))
        faults = [known_equivalent(fault) for fault in faults if _is_code(known[fault.module], fault)]
    else:
        home = [(module_of(f.module, known), f) for f in FAULTS]
        faults = [f for m in wanted for f in [f for place, f in home if place == m][:: args.every]]
    KEYWORD[0] = args.keyword
    rows = []
    named = {module: [test for test in tests if test.startswith(args.among)] for module, tests in TESTS.items()}
    done = {(row["module"], row["function"], row["old"], row["new"]) for row in before if args.untried}
    home = [(module_of(fault.module, known), fault) for fault in faults]
    faults = [f for m, f in home if named.get(m) and (m, f.function, f.old, f.new) not in done]
    for row in run(faults, named, args.tests, args.jobs, args.quiet):
        rows.append(row | {"seed": args.seed} if args.sweep else row)
        if args.json:  # at once: what was tried in an hour is not lost with the next
            sure = [row for row in rows if not (args.among or args.keyword) or row["verdict"] == "caught"]
            so_far = rows if args.sweep else joined(before, sure)
            args.json.write_text(json.dumps(so_far, indent=1) + "\n")
    print(summary(rows))
    print(density(by_package(rows, faults)))
    return int(any(row["verdict"] == "noticed" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
