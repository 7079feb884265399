"""Names: a public top-level name has one meaning, and words of the former private language do not come back."""

import ast
import re
from collections import defaultdict
from pathlib import Path

from support.source_trees import parsed

import dhtorch

ROOT = Path(dhtorch.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))

#: Names of an interface that several modules implement: readers, experiments, commands, types of rows, cameras and
#: poses as matrices.
INTERFACES = {
    *(
        "main",
        "run",
        "read",
        "recognise",
        "UNUSED_FILES",
        "verdict",
        "QUESTION",
        "EXPECTATION",
        "VARIANTS",
        "Row",
        "Progress",
    ),
    *("from_matrix", "to_matrix"),
}

#: Words that name a concept otherwise now, as identifiers: word → the term.
REPLACED = {
    "anchor": "reference (view)",
    "anchors": "references, reference_views",
    "partner": "source_view",
    "partners": "source_views",
    "judge": "validate",
    "judged": "validated",
    "seat": "stage",
    "worth": "gain",
    "told": "the quantity: in_sensor, predictions, noise_terms",
    "said": "sentences, lines, tooltip",
    "asked": "selected, requested, candidates",
    "ask": "estimate, evaluate",
    "given": "sources, prior, settings, call_options",
    "found": "the quantity: depth_map, fit, summary, actual",
    "say": "add_fact, compute",
    "made": "load_item, the thing made",
    "room_scene": "annotate",
    "silent": "unanswered, no_answer",
    "held": "cached, limited, pose_returns",
}

#: Terms of the field that contain such a word.
TERMS = ("held_out", "held_back", "hand_held", "hand_made")


def top_level_names(tree):
    """Public names that a module defines itself; those that it imports are none."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (
                x.id for t in targets for x in ast.walk(t) if isinstance(x, ast.Name) and isinstance(x.ctx, ast.Store)
            )


def parts_of(name):
    """The words of an identifier, terms of the field left out."""
    return re.split(r"_+", re.sub("|".join(TERMS), "", name.lower()))


def test_no_public_name_has_two_meanings():
    homes = defaultdict(set)
    for path in FILES:
        for name in top_level_names(parsed(path)):
            if not name.startswith("_"):
                homes[name].add(str(path.relative_to(ROOT)))
    several = {name: sorted(at) for name, at in homes.items() if len(at) > 1 and name not in INTERFACES}
    assert not several


def identifiers(tree):
    """All names that a module reads or defines; names of arguments of compiled operators are not its own."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Call) and node.keywords and not ast.unparse(node.func).startswith("torch.ops."):
            yield from (keyword.arg for keyword in node.keywords if keyword.arg)


def test_no_identifier_is_a_replaced_word():
    again = {
        (str(path.relative_to(ROOT)), name): REPLACED[part]
        for path in FILES
        for name in set(identifiers(parsed(path)))
        for part in parts_of(name)
        if part in REPLACED
    }
    assert not again
