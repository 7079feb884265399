"""Every tuning constant says where its number comes from: module-level numbers of the method, and fields of options."""

import ast
import re
from pathlib import Path

import pytest

import dhtorch

ROOT = Path(dhtorch.__file__).parent
FILES = sorted(
    p for name in ("stages", "geometry", "pipeline", "alignment", "validation") for p in (ROOT / name).glob("*.py")
)

#: How a comment names the origin of a number.
SOURCE = re.compile(r"Source: (?:paper, \"|derived, \S|chosen on \S|origin not recorded\.|[A-Z]\S)", re.S)


def is_number(node):
    """A numeric literal, with a sign, an arithmetic expression of such, or a tuple or list of them."""
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(is_number(x) for x in node.elts)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def assigned(body):
    """(name, value, line) of every assignment of a body, each element of a tuple for itself."""
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            yield node.target.id, node.value, node.lineno
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name):
                    yield target.id, node.value, node.lineno
                elif isinstance(target, ast.Tuple):
                    yield ", ".join(ast.unparse(x) for x in target.elts), node.value, node.lineno


def comment_above(lines, line):
    """The block of ``#`` lines right above a line, joined, and the comment at its end."""
    block, k = [], line - 2
    while k >= 0 and lines[k].strip().startswith("#"):
        block.insert(0, lines[k].strip().lstrip("#:").strip())
        k -= 1
    return " ".join([*block, lines[line - 1].partition("#")[2].strip(" :")])


def without_source(path):
    """Numeric constants of a file whose comment names no origin."""
    source = path.read_text(encoding="utf-8")
    lines, tree = source.split("\n"), ast.parse(source)
    bodies = [tree.body]
    bodies += [
        n.body for n in tree.body if isinstance(n, ast.ClassDef) and n.name.endswith("Options") and n.name[0] != "_"
    ]
    for body in bodies:
        for name, value, line in assigned(body):
            if is_number(value) and not SOURCE.search(comment_above(lines, line)):
                yield f"{path.relative_to(ROOT)}:{line}: {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_constant_names_its_origin(path):
    missing = list(without_source(path))
    assert not missing, f"no `Source: …` (paper, derived, chosen on, a publication, or origin not recorded): {missing}"


def test_a_constant_without_origin_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr("test_provenance.ROOT", tmp_path)
    file = tmp_path / "module.py"
    file.write_text(
        '#: Limit, px. Source: paper, "Gates".\nA = 3\n\n#: Limit, px.\nB, C = 1.0, -2\n\n'
        "class FitOptions:\n    #: Weight. Source: origin not recorded.\n    d: float = 0.1\n    e: int = 2\n"
    )
    assert list(without_source(file)) == ["module.py:5: B, C", "module.py:10: e"]


def test_no_constant_was_chosen_on_the_untouched_scenes():
    """README's numbers are of ``data=untouched``: whatever cites one of its scenes as an origin would be tuned to it."""
    scenes = re.compile(r"untouched|middlebury_2005|slambook|seeds? 100\d", re.I)
    cited = [
        f"{path.relative_to(ROOT)}: {comment}"
        for path in sorted(ROOT.rglob("*.py"))
        for comment in re.findall(r"Source:[^\n]*(?:\n\s*#:?[^\n]*)*", path.read_text(encoding="utf-8"))
        if scenes.search(comment.split("Source:")[1]) and "vision.middlebury.edu" not in comment
    ]
    files = [p for p in sorted(ROOT.rglob("*.json")) if p.parent.name != "cli"]  # there: what `dhtorch fetch` loads
    calibrations = [p.name for p in files if scenes.search(p.read_text(encoding="utf-8"))]
    assert files
    assert cited == [] and calibrations == []
