"""The floor plan: imports go down only, cv2 and hydra live where they should, and importing costs little."""

import ast
import functools
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.source_trees import parsed

import dhtorch

ROOT = Path(dhtorch.__file__).parent
#: Packages and modules of the root by floor, highest first: imports go down only. Those of one floor do not import each
#: other. There are no exceptions.
FLOORS = (
    {"cli"},
    {"extract", "experiments"},
    {"transforms", "measure"},
    {"validation", "integrate", "synthetic", "losses"},
    {"pipeline", "functional"},
    {"stages", "alignment", "metrics", "export", "data"},
    {"viz"},
    {"records"},
    {"geometry"},
    {"ops"},
    {"runtime"},
    {"codes", "pytree"},
)
FLOOR = {name: -k for k, names in enumerate(FLOORS) for name in names}

#: Modules whose functions may import dhtorch: public names on first use; help and misspelt options before torch.
LAZY = ("__init__.py", "__main__.py", "cli/")

FILES = sorted(ROOT.rglob("*.py"))
#: Files outside ``dhtorch.ops`` that have to do with it; ``ops`` stands in every import and every call of an operator.
OUTSIDE_OPS = [p for p in FILES if p.relative_to(ROOT).parts[0] != "ops" and re.search(r"\bops\b", p.read_text())]


@functools.cache
def imports(path):
    """Of each import of a file its dotted name, `from a import b` as a.b, and whether it stands within a function."""
    tree = parsed(path)
    found = []
    within = {id(n) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for n in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += ((alias.name, id(node) in within) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found += ((f"{node.module}.{alias.name}", id(node) in within) for alias in node.names)
    return found


def module_of(name):
    """The module or package of dhtorch that a dotted name belongs to, as its path below the package; None if another's."""
    parts = name.split(".")
    if parts[0] != "dhtorch":
        return None
    for n in range(len(parts), 0, -1):
        base = ROOT.joinpath(*parts[1:n])
        if base.with_suffix(".py").is_file() or (base / "__init__.py").is_file():
            return base.relative_to(ROOT)
    raise AssertionError(f"{name}: no module")


def upward_imports(path):
    """Imports of a file that do not go down, one sentence each."""
    relative = path.relative_to(ROOT)
    if str(relative) in ("__init__.py", "__main__.py"):
        return
    part = relative.parts[0].removesuffix(".py")
    if part not in FLOOR:
        yield f"{relative}: {part} has no floor"
        return
    for name, _ in imports(path):
        module = module_of(name)
        if module is None or not module.parts:
            continue
        other = module.parts[0]
        if other not in FLOOR:
            yield f"{relative}: imports {name}, which has no floor"
        elif other != part and FLOOR[other] >= FLOOR[part]:
            yield f"{relative}: imports {name}"
        elif part == other == "stages" and path.stem != "__init__":
            yield f"{relative}: a stage imports a stage"


def test_imports_go_down_only():
    upward = [sentence for path in FILES for sentence in upward_imports(path)]
    assert not upward, "\n".join(upward)


def test_no_function_imports_the_package():
    late = [
        f"{relative}: imports {name} within a function"
        for path in FILES
        if not (relative := str(path.relative_to(ROOT))).startswith(LAZY)
        for name, within in imports(path)
        if within and name.split(".")[0] == "dhtorch"
    ]
    assert not late, "\n".join(late)


def test_no_two_modules_import_each_other():
    """The import graph has no circle, however long. A package stands for its ``__init__`` module."""
    graph = {}
    for path in FILES:
        relative = path.relative_to(ROOT)
        here = relative.parent if path.stem == "__init__" else relative.with_suffix("")
        if here == Path():  # public names are imported on first use
            continue
        graph[here] = {m for name, within in imports(path) if not within and (m := module_of(name)) not in (None, here)}
    done, open_ = set(), []

    def visit(module):
        assert module not in open_, " -> ".join(map(str, [*open_[open_.index(module) :], module]))
        if module in done:
            return
        open_.append(module)
        for other in sorted(graph.get(module, ())):
            visit(other)
        open_.pop()
        done.add(module)

    for module in sorted(graph):
        visit(module)


@pytest.mark.parametrize(
    ("library", "homes"),
    [
        ("cv2", {"data/io/decode.py", "experiments/baselines/opencv.py", "experiments/baselines/stereo.py"}),
        ("hydra", {"cli/run.py", "cli/option_checks.py"}),
        ("omegaconf", {"cli/run.py"}),
    ],
)
def test_libraries_stay_at_home(library, homes):
    users = {str(p.relative_to(ROOT)) for p in FILES if any(n.split(".")[0] == library for n, _ in imports(p))}
    assert users <= homes


def test_heavy_libraries_are_not_imported_with_the_package():
    heavy = ("matplotlib", "rich", "hydra", "cv2", "scipy", "transformers", "torch._dynamo", "sympy")
    code = "import sys, dhtorch; from dhtorch.pipeline.pair import uniform_draws; uniform_draws(0, 1, 2)\n"
    code += f"print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "words",
    [["--help"], ["sede=1"], ["method.track.windw=3"], ["view", "--help"], ["extract", "mehtod=map"]],
)
def test_help_and_misspelt_options_are_answered_before_torch_is_loaded(words):
    code = "import atexit, sys\nfrom dhtorch.cli import run\n"
    code += "atexit.register(lambda: print('torch' in sys.modules, 'kornia' in sys.modules))\n"
    code += f"run.main({words})"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.splitlines()[-1] == "False False", out


def test_public_names_are_found_where_they_live():
    source = parsed(ROOT / "__init__.py")
    (shown,) = (n for n in source.body if isinstance(n, ast.If))
    homes = {alias.name: node.module for node in shown.body for alias in node.names}
    assert sorted(homes) == sorted(dhtorch.__all__) and set(dhtorch.__all__) <= set(dir(dhtorch))
    for name, home in homes.items():
        assert getattr(dhtorch, name) is getattr(importlib.import_module(home), name)
    assert dhtorch.geometry.camera.Camera is dhtorch.Camera
    with pytest.raises(AttributeError, match="no attribute 'extnd'"):
        dhtorch.extnd  # noqa: B018


def test_no_module_shadows_the_standard_library_or_its_own_function():
    for path in FILES:
        if path.stem in ("__init__", "__main__"):
            continue
        functions = {n.name for n in parsed(path).body if isinstance(n, ast.FunctionDef)}
        exported = {name for name in dir(dhtorch) if not name.startswith("_")}
        assert path.stem not in sys.stdlib_module_names or path.parent != ROOT, path
        assert not (path.stem in functions and path.stem in exported and path.parent == ROOT), path


#: Functions that run a kernel by its name.
RUNNERS = ("run_kernel", "run_window_kernel")


def functions_that_run_operators(tree):
    """Of a module: names of functions that name ``torch.ops.dhtorch`` or run a kernel by its name (None outside any), and
    of those passed to the dispatch as kernels; with those that a kernel written there calls."""
    inside, kernels = set(), set()
    scopes = [(None, node) for node in tree.body]
    while scopes:
        name, node = scopes.pop()
        name = node.name if name is None and isinstance(node, ast.FunctionDef) else name
        if isinstance(node, ast.Attribute | ast.Name) and ast.unparse(node) in ("torch.ops.dhtorch", *RUNNERS):
            inside.add(name)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "operator":
            values = [word.value for word in node.keywords if word.arg == "kernel"]
            kernels |= {name.id for value in values for name in ast.walk(value) if isinstance(name, ast.Name)}
            continue
        scopes += [(name, child) for child in ast.iter_child_nodes(node)]
    return inside, kernels


def callers_of(tree, name):
    """Names of a module's functions that call another one."""
    functions = [f for f in tree.body if isinstance(f, ast.FunctionDef)]
    calls = {f.name: {ast.unparse(n.func) for n in ast.walk(f) if isinstance(n, ast.Call)} for f in functions}
    return {caller for caller, called in calls.items() if name in called}


@pytest.mark.parametrize("path", OUTSIDE_OPS, ids=lambda p: str(p.relative_to(ROOT)))
def test_compiled_operators_run_through_the_dispatch_alone(path):
    """Only kernels registered by ``operator(kernel=...)``, and what they alone call, name ``torch.ops.dhtorch``; outside
    ``dhtorch.ops`` the loader only describes what computes, and nothing else asks whether tensors may be dispatched."""
    relative = path.relative_to(ROOT)
    imported = {name for name, _ in imports(path) if name.startswith("dhtorch.ops")}
    assert all(
        name in ("dhtorch.ops.dispatch.operator", "dhtorch.ops.dispatch.run_kernel", "dhtorch.ops.loader")
        or name.startswith("dhtorch.ops.constants.")
        for name in imported
    )
    assert {*re.findall(r"\bloader\.(\w+)", path.read_text())} <= {
        "describe_operators"
    } or "dhtorch.ops.loader" not in imported
    tree = parsed(path)
    inside, kernels = functions_that_run_operators(tree)
    for name in inside - kernels - {*RUNNERS}:
        assert name is not None and callers_of(tree, name), f"{relative}: {name} is no kernel"
        assert callers_of(tree, name) <= kernels, f"{relative}: {name} is no kernel"


def test_every_compiled_operator_has_a_kernel_that_runs_it():
    pattern = r"(?:torch\.ops\.dhtorch\.|run_(?:window_)?kernel\(\s*\")(\w+)"
    named = {m for path in FILES for m in re.findall(pattern, path.read_text())}
    defined = {m for path in ROOT.glob("ops/csrc/*.cpp") for m in re.findall(r'm\.impl\("(\w+)"', path.read_text())}
    assert named - {"scale"} == defined, "scale is the example of the dispatch"
