"""Fraction of faults drawn by rule that the tests catch, by group of packages.

    python benchmarks/mutants.py --record lines.json             # once per commit: which functions each test runs
    python benchmarks/mutants.py 300 --lines lines.json --json FILE
    python benchmarks/mutants.py 40 data geometry --lines lines.json --tests OLD/tests

Each fault changes one token or argument of a function: operators and comparisons exchanged, numbers and truth values
changed, signs and negations dropped, conditions inverted, early returns left out, two arguments exchanged, a keyword
argument or an entry of a tuple or dictionary left out; in C++ an operator exchanged. Faults are drawn from all changes
of all packages with a seed, by default the commit. Each is planted alone in a copy of the tree, and the tests that run
its function are run there in a fork of one process that has torch loaded, most specific first, up to ``BUDGET_S``
seconds of tests. A fault that a rule of ``EQUIVALENT`` proves to change no answer is drawn again.
"""

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
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, thread
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]

#: Packages whose faults are counted together.
GROUPS = {
    "data": "data",
    **dict.fromkeys(("geometry", "ops", "stages"), "geometry, ops, stages"),
    **dict.fromkeys(("pipeline", "alignment", "metrics"), "pipeline, alignment, metrics"),
    **dict.fromkeys(("cli", "viz", "runtime"), "cli, viz, runtime"),
}
OTHER = "all others"

#: Seconds of tests for one fault, as recorded without faults: nine in ten functions are run by fewer.
BUDGET_S = 40.0

#: Tests of compiled operators: no Python function marks their lines.
CPP_TESTS = ("tests/ops", "tests/test_stored_answers.py")

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

#: Old text, new text -> why the change alters no answer. Regular expressions of the changed line.
EQUIVALENT = (
    (r"zip\(.*strict=True", r"strict=False|zip\((?!.*strict)", "the sequences are of one length"),
    (r"\.(arg)?sort\(.*dim=-1", r"\.(arg)?sort\((?!.*dim)", "the last axis is the default"),
    (r"@operator\(.*any_layout", r"@operator\((?!.*any_layout)", "torch computes the same without the kernel"),
    (r"\.unbind\(-1\)", r"\.unbind\( ?1\)", "the last axis of two"),
    (r"dtype=torch\.u?int(8|16)\b", r"^(?!.*dtype=)", "the same whole numbers in a wider type"),
)  # fmt: skip


class Fault(NamedTuple):
    """One change of one line."""

    file: str  # below the root
    function: str  # that the line lies in, "A.method" of a class
    line: int  # from 1
    old: str
    new: str


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
_TWINS |= {"isfinite": "isnan", "startswith": "endswith", "rows": "columns"}
_TWINS |= {b: a for a, b in _TWINS.items()}

#: Calls of a name, not of an attribute.
_NAME_TWINS = {"any": "all", "all": "any", "min": "max", "max": "min", "sorted": "list"}


def draw(number: int, packages: Sequence[str], seed: str) -> list[Fault]:
    """Faults drawn from all that the rules give in some packages; in all where none is named."""
    faults: list[Fault] = []
    for path in sorted((ROOT / "dhtorch").rglob("*")):
        package = path.relative_to(ROOT / "dhtorch").parts[0].removesuffix(".py")
        if path.suffix in (".py", ".cpp", ".h") and (not packages or package in packages):
            rules = _python_faults if path.suffix == ".py" else _cpp_faults
            faults += rules(path.read_text(), str(path.relative_to(ROOT)))
    random.Random(seed).shuffle(faults)
    return list(itertools.islice(filter(_counts, faults), number))


def _counts(fault: Fault) -> bool:
    """Whether the file can be parsed with a fault, and no rule proves that it alters no answer."""
    if fault.old == fault.new or any(re.search(a, fault.old) and re.search(b, fault.new) for a, b, _ in EQUIVALENT):
        return False
    lines = (ROOT / fault.file).read_text().splitlines()
    lines[fault.line - 1] = fault.new
    try:
        return not fault.file.endswith(".py") or bool(ast.parse("\n".join(lines)))
    except SyntaxError:
        return False


def _python_faults(source: str, file: str) -> Iterator[Fault]:
    lines = source.splitlines()
    tree = ast.parse(source)
    fields = (getattr(node, name, None) for node in ast.walk(tree) for name in ("annotation", "returns"))
    annotations = {node for field in fields if field is not None for node in ast.walk(field)}
    for outer in tree.body:
        inner = outer.body if isinstance(outer, ast.ClassDef) else [outer]
        for function in (x for x in inner if isinstance(x, ast.FunctionDef)):
            name = f"{outer.name}.{function.name}" if isinstance(outer, ast.ClassDef) else function.name
            for node in (x for x in ast.walk(function) if x not in annotations):
                row = getattr(node, "lineno", 0)
                if row and row == node.end_lineno:  # type: ignore[attr-defined]
                    line = lines[row - 1]
                    for first, last, text in _changes(node, line):
                        yield Fault(file, name, row, line, line[:first] + text + line[last:])


def _changes(node: ast.AST, line: str) -> Iterator[tuple[int, int, str]]:
    """(first column, last column, new text) of what the rules do to a node that lies on one line."""

    def columns(first: Any, last: Any) -> tuple[int, int]:  # ast counts bytes
        of = [len(line.encode()[:byte].decode()) for byte in (first.col_offset, last.end_col_offset)]
        return of[0], of[1]

    pairs = []
    if isinstance(node, ast.BinOp):
        pairs = [(node.left, node.op, node.right)]
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        pairs = [(node.left, node.ops[0], node.comparators[0])]
    elif isinstance(node, ast.BoolOp):
        pairs = [(node.values[0], node.op, node.values[1])]
    for left, op, right in (p for p in pairs if type(p[1]) in _SWAPS):
        old, new = _SWAPS[type(op)]
        at = line.find(old, columns(left, left)[1], columns(right, right)[0])
        if at >= 0:
            yield at, at + len(old), new
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield *columns(node, node), str(node.value + 1 if type(node.value) is int else node.value * 2 or 1.0)
    elif isinstance(node, ast.Constant) and type(node.value) is bool:
        yield *columns(node, node), str(not node.value)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Invert | ast.Not):
        yield columns(node, node)[0], columns(node.operand, node.operand)[0], " "
    elif isinstance(node, ast.Attribute) and node.attr in _TWINS:
        last = columns(node, node)[1]
        yield last - len(node.attr), last, _TWINS[node.attr]
    elif isinstance(node, ast.Return) and line.lstrip().startswith("return") and node.col_offset > 4:
        yield *columns(node, node), "pass"
    elif isinstance(node, ast.Tuple | ast.List) and len(node.elts) > 2 and isinstance(node.ctx, ast.Load):
        yield columns(node.elts[-2], node.elts[-2])[1], columns(node.elts[-1], node.elts[-1])[1], ""
    elif isinstance(node, ast.Dict) and len(node.values) > 1:
        yield columns(node.values[-2], node.values[-2])[1], columns(node.values[-1], node.values[-1])[1], ""
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Name) and isinstance(node.ctx, ast.Load):
        yield *columns(node.slice, node.slice), "0"
    elif isinstance(node, ast.IfExp) and not isinstance(node.test, ast.BoolOp | ast.Compare):
        first, last = columns(node.test, node.test)
        yield first, last, f"not {line[first:last]}"
    elif isinstance(node, ast.Call):
        if isinstance(node.func, ast.Name) and node.func.id in _NAME_TWINS:
            yield *columns(node.func, node.func), _NAME_TWINS[node.func.id]
        for previous, option in itertools.pairwise([*node.args, *node.keywords]):
            if isinstance(option, ast.keyword):
                yield columns(previous, previous)[1], columns(option, option)[1], ""
            elif isinstance(option, ast.Name) and isinstance(previous, ast.Name):
                first, last = columns(previous, option)
                yield first, last, f"{option.id}, {previous.id}"


def _cpp_faults(source: str, file: str) -> Iterator[Fault]:
    """Every spaced operator inside the functions of a C++ file exchanged."""
    swaps = {" + ": " - ", " - ": " + ", " * ": " / ", " < ": " > ", " > ": " < ", " && ": " || ", " || ": " && "}
    function = ""
    for row, line in enumerate(source.splitlines(), 1):
        begin = re.match(r"(?!namespace)[\w:<>,&* ]*?(\w+)\([^;{}]*\)?", line) if line[:1].isalpha() else None
        function = begin.group(1) if begin else function
        if line[:1] == " " and function and not line.lstrip().startswith("//"):
            for old in (o for o in swaps if line.count(o) == 1):
                yield Fault(file, function, row, line, line.replace(old, swaps[old]))


# ------------------------------------------------------------------------------------------------ which tests run what


class Tracer:
    """Plugin of pytest: which functions of the package each test runs, its seconds, and whether it passed."""

    def __init__(self, file: Path) -> None:
        self.file, self.tests = (
            file,
            defaultdict[str, dict[str, Any]](lambda: {"s": 0.0, "runs": set(), "passed": True}),
        )
        self.codes: dict[Any, str] = {}
        self.runs: set[str] = set()

    def __call__(self, frame: Any, event: str, arg: object) -> None:
        """Trace function of calls alone."""
        name = self.codes.get(frame.f_code)
        if name is None:
            code, package = frame.f_code, str(ROOT / "dhtorch") + os.sep
            inside = code.co_filename.startswith(package)
            function = code.co_qualname.partition(".<locals>")[0]
            name = f"{Path(code.co_filename).relative_to(ROOT)}:{function}" if inside else ""
            self.codes[code] = name
        if name:
            self.runs.add(name)

    def pytest_runtest_setup(self, item: Any) -> None:
        """Fixtures count for the test that makes them."""
        self.runs = self.tests[item.nodeid]["runs"]
        threading.settrace(self)  # type: ignore[arg-type]
        sys.settrace(self)  # type: ignore[arg-type]

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Seconds and outcome."""
        test = self.tests[report.nodeid]
        test["s"] += report.duration
        test["passed"] &= report.passed

    def pytest_sessionfinish(self) -> None:
        """One file for each process; the controller of pytest-xdist has run nothing itself."""
        sys.settrace(None)
        ran = {k: {**v, "runs": sorted(v["runs"])} for k, v in self.tests.items() if v["passed"] and v["runs"]}
        self.file.with_suffix(f".{os.getpid()}").write_text(json.dumps(ran))


def pytest_configure(config: Any) -> None:
    """``-p mutants``."""
    if "MUTANTS_LINES" in os.environ:
        config.pluginmanager.register(Tracer(Path(os.environ["MUTANTS_LINES"])))


def record(file: Path, jobs: int) -> None:
    """Runs the suite with a tracer -> ``{test: {s, runs}}`` of every test that passes."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.pathsep.join([str(ROOT / "benchmarks"), str(ROOT)])
        env = os.environ | {"MUTANTS_LINES": f"{folder}/part", "PYTHONPATH": path, "DHTORCH_OPS": "0"}
        command = [
            sys.executable,
            "-m",
            "pytest",
            "tests",
            "-q",
            "-n",
            str(jobs),
            "-p",
            "mutants",
            "-p",
            "no:cacheprovider",
        ]
        subprocess.run(command, cwd=ROOT, env=env, check=False)
        tests: dict[str, Any] = {}
        for part in Path(folder).iterdir():
            tests |= json.loads(part.read_text())
    file.write_text(json.dumps(tests))


def tests_for(fault: Fault, lines: dict[str, Any]) -> list[str]:
    """Tests that run a fault's function, those that run few other functions first; of its module where none does."""
    if not fault.file.endswith(".py"):
        return list(CPP_TESTS)
    wanted = f"{fault.file}:{fault.function}"
    named = [t for t, of in lines.items() if wanted in of["runs"]]
    named = named or [t for t, of in lines.items() if any(r.startswith(f"{fault.file}:") for r in of["runs"])]
    named.sort(key=lambda t: (len(lines[t]["runs"]), lines[t]["s"]))
    total = list(itertools.accumulate(lines[t]["s"] + 0.01 for t in named))
    return [t for t, s in zip(named, total, strict=True) if s <= BUDGET_S] or named[:1]


# ------------------------------------------------------------------------------------------------ trying one


class Failure:
    """Plugin of pytest: writes down the first test that fails at once, since the process may not end well."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def pytest_runtest_logreport(self, report: Any) -> None:
        """The first failure."""
        if report.failed and not self.file.exists():
            self.file.write_text(report.nodeid)

    pytest_collectreport = pytest_runtest_logreport


def attempt(fault: Fault, tree: Path, tests: Sequence[str]) -> str:
    """The test that catches a fault in a copy of the tree, "" where none does, by a fork of this process."""
    file = tree / fault.file
    source = file.read_text()
    lines = source.splitlines(keepends=True)
    lines[fault.line - 1] = fault.new + "\n"
    file.write_text("".join(lines))
    shutil.rmtree(file.parent / "__pycache__", ignore_errors=True)  # two versions may be of one length and second
    failure = tree / "first_failure"
    failure.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        _run_tests(tree, tests, failure, is_cpp=not fault.file.endswith(".py"))
    try:
        end = time.monotonic() + 60 + 6 * BUDGET_S
        while not (status := os.waitpid(child, os.WNOHANG))[0]:
            if time.monotonic() > end:
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return "did not end"
            time.sleep(0.02)
        code = os.waitstatus_to_exitcode(status[1])
        if code == 0:
            return ""
        return failure.read_text() if failure.exists() else f"pytest ended with {code}"
    finally:
        file.write_text(source)
        shutil.rmtree(file.parent / "__pycache__", ignore_errors=True)


def _run_tests(tree: Path, tests: Sequence[str], failure: Path, *, is_cpp: bool) -> None:
    """In the fork: the package and its tests come from the tree, also for processes that the tests start."""
    code = 2
    try:
        os.setsid()
        log = os.open(tree / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(tree)
        vars(thread)["_threads_queues"].clear()  # a process that a test forks would wait for this one's pool, and fail
        os.environ |= {"PYTHONPATH": str(tree), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        os.environ["CXX" if is_cpp else "DHTORCH_OPS"] = (
            f"{sys.executable} {Path(__file__).resolve().with_name('cached_compiler.py')}" if is_cpp else "0"
        )
        sys.path[:0] = [str(tree)]
        import pytest

        options = ["-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow"]
        code = int(pytest.main([*options, *tests], plugins=[Failure(failure)]))
    finally:
        os._exit(code)


def try_all(faults: Sequence[Fault], lines: dict[str, Any], tests: Path, jobs: int) -> Iterator[dict[str, Any]]:
    """Plants each fault alone in a copy of the tree -> rows of what caught it."""
    import cv2  # noqa: F401  (what every trial needs and no fault is in, loaded once)
    import hydra  # noqa: F401
    import hypothesis  # noqa: F401
    import kornia  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    import pytest  # noqa: F401
    import torch
    import torch._dynamo

    torch.set_num_threads(1)
    gc.freeze()  # a fork's collections leave alone what it shares with its parent
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        free = [Path(folder) / str(k) for k in range(jobs)]
        for tree in free:
            shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*LEFT))
            shutil.rmtree(tree / "tests")
            shutil.copytree(tests, tree / "tests", ignore=shutil.ignore_patterns("__pycache__"))

        def one(fault: Fault) -> dict[str, Any]:
            tree, named = free.pop(), tests_for(fault, lines)
            by = attempt(fault, tree, named) if named else ""
            free.append(tree)
            package = fault.file.split("/")[1].removesuffix(".py")
            row = {
                "group": GROUPS.get(package, OTHER),
                "package": package,
                **fault._asdict(),
                "caught": bool(by),
                "by": by,
            }
            print(
                "caught" if by else "MISSED", fault.file, fault.function, fault.old.strip(), "->", fault.new.strip(), by
            )
            return row

        with ThreadPoolExecutor(jobs) as pool:
            yield from pool.map(one, faults)


def summarize(rows: Sequence[dict[str, Any]]) -> list[tuple[str, int, int]]:
    """(group or package, caught, tried) of every group, of every package, and of all."""
    total = Counter(name for row in rows for name in (row["group"], f"`{row['package']}`", "all"))
    caught = Counter(name for row in rows if row["caught"] for name in (row["group"], f"`{row['package']}`", "all"))
    groups = [*dict.fromkeys(GROUPS.values()), OTHER]
    names = [*groups, *sorted(name for name in total if name.startswith("`")), "all"]
    return [(name, caught[name], total[name]) for name in names if total[name]]


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("number", nargs="?", type=int, default=300, help="faults to draw")
    parser.add_argument("packages", nargs="*", help="packages of dhtorch to draw from; all of them")
    parser.add_argument("--record", type=Path, help="run the suite and write here which functions each test runs")
    parser.add_argument("--lines", type=Path, help="file of --record")
    parser.add_argument("--seed", help="any text; the commit")
    parser.add_argument("--tests", type=Path, default=ROOT / "tests", help="folder of tests, this checkout's")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.record:
        record(args.record, args.jobs)
        return 0
    if args.lines is None:
        parser.error("expected --lines FILE, written by --record FILE")
    seed = (
        args.seed or subprocess.check_output(["git", "-C", ROOT, "rev-parse", "--short=8", "HEAD"], text=True).strip()
    )
    faults = draw(args.number, args.packages, seed)
    rows = []
    for row in try_all(faults, json.loads(args.lines.read_text()), args.tests, args.jobs):
        rows.append({**row, "seed": seed})
        if args.json:  # at once: what was tried in an hour is not lost with the next
            args.json.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    for name, caught, total in summarize(rows):
        print(f"{name:45} {caught:4} of {total:4} = {caught / total:.0%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
