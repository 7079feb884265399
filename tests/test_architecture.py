"""The floor plan: imports go down only, cv2 and hydra live where they should, and importing costs little."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import dhtorch

ROOT = Path(dhtorch.__file__).parent
LEVELS = [
    {"tree", "codes", "storage", "closure", "archive", "older", "console", "leash", "lock", "memory", "native"},
    {"geometry"},
    {"records", "drawing"},
    {"stages", "data", "evaluate", "export", "synthetic", "testing", "calibration", "anchors"},
    {"method", "frames", "distortion", "scatter", "stereo"},
    {"pair", "window", "methods", "first_release", "views", "offers"},
    {"stream", "dense", "rig", "metric"},
    {"evidence", "causes"},
    {"verdict"},
    {"transform", "integrate", "viewer"},
    {"extract"},
    {"studies"},
    {"commands", "__main__"},
]
LEVEL = {name: level for level, group in enumerate(LEVELS) for name in group}
SIDEWAYS = {
    ("archive", "closure"),
    ("archive", "storage"),
    ("lock", "storage"),
    ("native", "archive"),
    ("synthetic", "data"),
    ("synthetic", "testing"),
    ("testing", "data"),
    ("testing", "export"),
    ("calibration", "evaluate"),
    ("method", "frames"),
    ("method", "pair"),  # when it is called
    ("method", "window"),
    ("window", "pair"),
    ("views", "pair"),
    ("window", "views"),
    ("offers", "views"),
    ("methods", "views"),
    ("__main__", "commands"),
}
FILES = sorted(ROOT.rglob("*.py"))


def imported(path):
    """Dotted names a file imports, `from a import b` as a.b, with whether the import runs when the module loads."""
    tree = ast.parse(path.read_text())
    inside = {id(n) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef | ast.ClassDef) for n in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) not in inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from ((f"{node.module}.{alias.name}", id(node) not in inside) for alias in node.names)


def part(path):
    relative = path.relative_to(ROOT)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_only(path):
    here = part(path)
    if here == "__init__":
        return
    assert here in LEVEL, f"{path}: {here} has no floor"
    for name, _ in imported(path):
        pieces = name.split(".")
        if pieces[0] != "dhtorch" or len(pieces) < 2:
            continue
        there = pieces[1]
        assert there in LEVEL, f"{path}: imports {name}, which has no floor"
        if there == here:
            alike = here != "stages" or len(pieces) == 2 or pieces[2] == path.stem
            assert alike, f"{path}: a stage imports a stage"
            continue
        allowed = LEVEL[there] < LEVEL[here] or (here, there) in SIDEWAYS
        assert allowed, f"{path}: imports {name} from floor {LEVEL[there]}, stands on {LEVEL[here]}"


@pytest.mark.parametrize(
    ("library", "homes"),
    [
        ("cv2", {"data/files.py", "studies/baselines/opencv.py", "studies/baselines/stereo.py"}),
        ("hydra", {"commands/run.py", "commands/words.py"}),
        ("omegaconf", {"commands/run.py"}),
    ],
)
def test_libraries_stay_at_home(library, homes):
    users = {str(p.relative_to(ROOT)) for p in FILES if any(n.split(".")[0] == library for n, _ in imported(p))}
    assert users <= homes


def test_heavy_libraries_are_not_imported_with_the_package():
    heavy = ("matplotlib", "rich", "hydra", "cv2", "scipy", "transformers", "torch._dynamo", "sympy")
    code = "import sys, dhtorch; from dhtorch.pair import uniform_draws; uniform_draws(0, 1, 2)\n"
    code += f"print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "words",
    [["--version"], ["--help"], ["sede=1"], ["method.track.windw=3"], ["view", "--help"], ["extract", "mehtod=map"]],
)
def test_help_and_misspelt_options_are_answered_before_torch_is_loaded(words):
    code = "import atexit, sys\nfrom dhtorch.commands import run\n"
    code += "atexit.register(lambda: print('torch' in sys.modules, 'kornia' in sys.modules))\n"
    code += f"run.main({words})"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.splitlines()[-1] == "False False", out


def test_public_names_are_found_where_they_live():
    source = ast.parse((ROOT / "__init__.py").read_text())
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
        functions = {n.name for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)}
        exported = {name for name in dir(dhtorch) if not name.startswith("_")}
        assert path.stem not in sys.stdlib_module_names or path.parent != ROOT, path
        assert not (path.stem in functions and path.stem in exported and path.parent == ROOT), path
