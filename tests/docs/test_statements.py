"""What the package says it was checked against: every such sentence names a test, and that test uses what it names.

In docstrings and in comments of constants: "Checked against ``cv2.undistortPoints`` (``tests/geometry/test_camera.py``)." A peer
is a function of another package, or one of the test's own that finds the same in a plainer way. On the pages: a sentence
with "checked", "tested" or "verified" names the test in the same way, within single backquotes.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from support.source_trees import parsed

from dhtorch.geometry.pyramid import build_pyramid

REPO = Path(__file__).resolve().parents[2]

#: Packages that code is compared with.
PEERS = {"cv2", "kornia", "poselib", "scipy", "sklearn", "skimage", "torchvision", "numpy", "torch"}

SAYS_SO = re.compile(
    r"\b(?:checked|tested|verified|validated) (?:against|with|by)\b|\((?:checked|tested|verified)\)"
    r"|\bverified\b|\bequal to `+(?:cv2|kornia|poselib|scipy|sklearn|torch)\b|`(?:cv2|kornia|poselib|scipy|sklearn)\.",
    re.I,
)
PAGE_SAYS_SO = re.compile(r"\b(?:checked|tested|verified)\b", re.I)
TEST = re.compile(r"tests/(?:\w+/)?test_\w+\.py")


def sentences(text: str) -> list[str]:
    """Sentences of paragraphs; rows of tables apart."""
    paragraphs = (" ".join(part.split()) for part in re.split(r"\n\s*\n|\n(?=\|)", text))
    return [sentence for part in paragraphs for sentence in re.split(r"(?<=[.:])\s+(?=[A-Z`])", part)]


def documented(source: str) -> Iterator[tuple[str, str]]:
    """(function or class, text) of every docstring; ("", text) of every comment that documents a constant (``#:``)."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield getattr(node, "name", ""), ast.get_docstring(node) or ""
    for block in re.findall(r"(?m)^[ ]*#:.*(?:\n[ ]*#.*)*", source):
        yield "", re.sub(r"(?m)^\s*#:?\s?", "", block)


def roots(tree: ast.AST) -> set[str]:
    """Packages that a file imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "importorskip":
            found |= {str(a.value).split(".")[0] for a in node.args if isinstance(a, ast.Constant)}
    return found


def used(tree: ast.AST) -> set[str]:
    """Names and attributes that a file reads; an import alone is no use."""
    return {x.id for x in ast.walk(tree) if isinstance(x, ast.Name)} | {
        x.attr for x in ast.walk(tree) if isinstance(x, ast.Attribute)
    }


def read_with(path: Path) -> list[ast.Module]:
    """A file of tests and the helpers beside it that it imports."""
    imports = (node for node in ast.walk(parsed(path)) if isinstance(node, ast.ImportFrom))
    names = {n.module for n in imports if (n.module or "").startswith("support.")}
    tests = next(folder for folder in path.parents if folder.name == "tests")
    helpers = (tests / f"{name.replace('.', '/')}.py" for name in sorted(names))
    return [parsed(path), *(parsed(helper) for helper in helpers if helper.is_file())]


def peers_of(sentence: str) -> list[str]:
    """What a sentence compares with: names of other packages, and plain names that follow "against"."""
    quoted = re.findall(r"`+([A-Za-z_][\w.]*)(?:\([^`]*\))?`+", sentence)
    after = re.split(r"\bagainst\b", sentence, maxsplit=1)[-1] if "against" in sentence else ""
    own = re.findall(r"``([a-z]\w*)``", after)
    return [q for q in quoted if q.split(".")[0] in PEERS] + [q for q in own if q not in PEERS]


def wrong_with(sentence: str, owner: str = "", root: Path = REPO) -> list[str]:
    """What is wrong with a sentence that says something was checked; empty if all of it holds."""
    named, peers = TEST.findall(sentence), peers_of(sentence)
    if not named:
        return ["names no test (tests/test_*.py)"]
    missing = [name for name in named if not (root / name).is_file()]
    if missing:
        return [f"{name} does not exist" for name in missing]
    if not peers:
        return ["names no peer in backquotes"]
    trees = [tree for name in named for tree in read_with(root / name)]
    found = []
    for peer in peers:
        first, last = peer.split(".")[0], peer.rsplit(".", 1)[-1]
        if first in PEERS:
            fine = any(first in roots(t) and last in used(t) for t in trees)
        else:
            fine = any(last in used(t) and last in _defined(t) for t in trees)
        if not fine:
            found.append(f"{', '.join(named)} does not use {peer}")
    if owner and not owner.startswith("_") and not any(owner in used(t) for t in trees):
        found.append(f"{', '.join(named)} does not use {owner}")
    return found


def _defined(tree: ast.AST) -> set[str]:
    return {x.name for x in ast.walk(tree) if isinstance(x, ast.FunctionDef)}


@cache
def statements() -> list[tuple[str, str, str]]:
    """(module, what it is about, sentence) over the package. A module that itself calls a peer may speak of it."""
    made = []
    for path in sorted((REPO / "dhtorch").rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if not SAYS_SO.search(re.sub(r"\s+(?:#:?\s*)?", " ", source)):
            continue
        calls = roots(parsed(path))
        for owner, text in documented(source):
            for sentence in sentences(text):
                found = SAYS_SO.search(sentence)
                if found and not (found[0].startswith("`") and found[0].strip("`.") in calls):
                    made.append((path.relative_to(REPO).as_posix(), owner, sentence))
    return made


def test_what_the_package_says_was_checked_is_checked():
    wrong = [
        f"{path}, {owner}: {fault}: {sentence}"
        for path, owner, sentence in statements()
        for fault in wrong_with(sentence, owner)
    ]
    assert not wrong, "\n".join(wrong)


def test_statements_are_found():
    """Those of the lens, the exponential map, the tracker and the pose are among them."""
    found = {owner for _, owner, _ in statements()}
    assert {"undistort", "project", "exp", "triangulate", "lucas_kanade", "pnp_ransac", "min_eigenvalue"} <= found


@pytest.mark.parametrize(
    "page", ["README.md", *sorted(p.relative_to(REPO).as_posix() for p in (REPO / "docs").rglob("*.md"))]
)
def test_what_a_page_says_was_tested_names_its_test(page):
    prose = re.sub(r"^```.*?^```", "", (REPO / page).read_text(encoding="utf-8"), flags=re.M | re.S)
    wrong = []
    for sentence in sentences(prose):
        if PAGE_SAYS_SO.search(sentence):
            named = [name for name in TEST.findall(sentence) if (REPO / name).is_file()]
            peers = re.findall(r"`((?:dhtorch|torch|cv2|kornia)\.[\w.]+)`", sentence)
            sources = [(REPO / name).read_text(encoding="utf-8") for name in named]
            if not named or not all(peer in source for peer in peers for source in sources):
                wrong.append(sentence)
    assert not wrong, "\n".join(wrong)


TESTED = "import cv2\nfrom kornia.geometry import project\n\ndef oracle():\n    pass\n\ndef test():\n"
TESTED += "    cv2.undistort(oracle(), mine())\n"


@pytest.mark.parametrize(
    ("sentence", "fault"),
    [
        ("Checked against ``cv2.undistort`` (``tests/test_a.py``).", None),
        ("Checked against ``cv2.undistort(x, 3)`` and a loop, ``oracle`` of ``tests/test_a.py``.", None),
        ("Equal to ``cv2.undistort`` (``tests/test_a.py``) at ``uv``.", None),
        ("Checked against ``cv2.undistort``.", "names no test"),
        ("Checked against OpenCV (``tests/test_a.py``).", "names no peer"),
        ("Checked against ``cv2.undistort`` (``tests/test_b.py``).", "test_b.py does not exist"),
        ("Checked against ``cv2.undistort`` (``tests/test_a.py``, ``tests/test_b.py``).", "test_b.py does not exist"),
        ("Checked against ``cv2.remap`` (``tests/test_a.py``).", "does not use cv2.remap"),
        ("Checked against ``kornia.undistort`` and ``scipy.undistort`` (``tests/test_a.py``).", "does not use scipy"),
        ("Checked against ``kornia.geometry.project`` (``tests/test_a.py``).", "does not use kornia.geometry.project"),
        ("Checked against a loop, ``mine`` of ``tests/test_a.py``.", "does not use mine"),
    ],
)
def test_a_sentence_is_held_to_what_it_says(tmp_path, sentence, fault):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text(TESTED)
    found = wrong_with(sentence, "mine", tmp_path)
    assert (not found) if fault is None else any(fault in f for f in found), found


def test_what_a_helper_of_the_test_uses_counts(tmp_path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "support").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text("from support.helper import slow\n")
    (tmp_path / "tests" / "support" / "helper.py").write_text(TESTED)
    sentence = "Checked against ``cv2.undistort`` (``tests/test_a.py``)."
    assert not wrong_with(sentence, "mine", tmp_path)
    (tmp_path / "tests" / "test_c.py").write_text("import other\n")
    assert wrong_with(sentence.replace("test_a", "test_c"), "mine", tmp_path)


def test_a_test_that_leaves_out_the_function_itself_does_not_count(tmp_path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text(TESTED)
    sentence = "Checked against ``cv2.undistort`` (``tests/test_a.py``)."
    assert wrong_with(sentence, "yours", tmp_path) == ["tests/test_a.py does not use yours"]
    assert not wrong_with(sentence, "_inner", tmp_path), "an inner function is tested through others"


@pytest.mark.parametrize(
    "text",
    [
        "Gradient: none. Checked\nagainst ``cv2.remap``.",
        "The map (tested); written out here.",
        "The values are verified.",
        "Equal to\n``kornia.filters.sobel``.",
        "Grey, as ``cv2.cvtColor`` makes it.",
    ],
)
def test_such_sentences_are_recognised(text):
    assert [s for s in sentences(text) if SAYS_SO.search(s)]


def test_comments_of_constants_are_read_whole():
    source = '"""Module."""\n\n#: The weights of\n#: ``cv2.cvtColor``.\nLUMA = (1, 2)\n\n\ndef f():\n    """Text."""\n'
    assert list(documented(source)) == [("", "Module."), ("f", "Text."), ("", "The weights of\n``cv2.cvtColor``.")]


@pytest.mark.parametrize("hw", [(80, 200), (87, 88), (88, 175), (175, 176), (176, 177), (23, 400)])
def test_a_pyramid_has_as_many_levels_as_opencv_makes(hw):
    last, _ = cv2.buildOpticalFlowPyramid(np.zeros(hw, np.uint8), (21, 21), 5)
    assert len(build_pyramid(torch.zeros(1, 1, *hw), 6, window=21).levels) == last + 1
