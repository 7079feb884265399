"""Style rules beyond the linter: one statement a line, and few positional arguments."""

import ast
from pathlib import Path

import pytest
from support.source_trees import parsed

import dhtorch

ROOT = Path(dhtorch.__file__).parent
#: Not checked: parsers of files, figures, the pages of the report, and two more modules.
ELSEWHERE = ("data/", "viz/plots", "experiments/report/", "experiments/protocol.py", "geometry/epipolar.py")
FILES = [name for p in sorted(ROOT.rglob("*.py")) if not (name := p.relative_to(ROOT).as_posix()).startswith(ELSEWHERE)]

#: Most positional arguments of a call.
MOST = 6

#: Functions that take any number of like things, or the fields of a format.
VARIADIC = {"first_reason", "_bits", "pack", "min", "max", "zip", "chain"}


def shape(node):
    """The structure of an expression without its names, numbers and operators."""
    if isinstance(node, (ast.operator, ast.unaryop, ast.cmpop, ast.boolop, ast.expr_context)):
        return ""
    if isinstance(node, ast.UnaryOp):
        return shape(node.operand)
    if isinstance(node, (ast.Name, ast.Constant)) or (
        isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
    ):
        return "x"
    return type(node).__name__, *(shape(child) for child in ast.iter_child_nodes(node))


def packed(statement):
    """Whether an assignment makes two unlike calls at once."""
    if not (isinstance(statement, ast.Assign) and isinstance(statement.value, ast.Tuple)):
        return False
    values = statement.value.elts
    work = [v for v in values if any(isinstance(node, ast.Call) for node in ast.walk(v))]
    return isinstance(statement.targets[0], ast.Tuple) and len(work) > 1 and len({shape(v) for v in work}) > 1


def nodes():
    """Every node of every file that is checked, with its file."""
    for file in FILES:
        for node in ast.walk(parsed(ROOT / file)):
            yield file, node


def test_a_tuple_assigns_like_things():
    """``a, b = f(x), f(y)`` reads at once; ``a, b = f(x), g(y, z)`` is two statements in one line."""
    found = [f"{file}, line {node.lineno}: {ast.unparse(node)}" for file, node in nodes() if packed(node)]
    assert not found, "one statement a line:\n" + "\n".join(found)


def test_calls_name_what_they_pass():
    found = []
    for file, node in nodes():
        if isinstance(node, ast.Call) and len([a for a in node.args if not isinstance(a, ast.Starred)]) > MOST:
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name not in VARIADIC:
                found.append(f"{file}, line {node.lineno}: {name} is given {len(node.args)} arguments by their place")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a, b = f(x), g(y)", False),
        ("a, b = f(x), f(x.y) + 1", True),
        ("a, b = x, f(y)", False),
        ("a, b = (f(v) for v in (x, y))", False),
        ("low, high = x.amin(0) - 1, x.amax(0) + 1", False),
        ("a, b = f(x), [f(v) for v in y]", True),
    ],
)
def test_which_tuples_are_packed(text, expected):
    assert packed(ast.parse(text).body[0]) is expected
