"""The faults that ``mutants.py`` plants, by the part of the house they are in, and the tests that must notice.

A row is (function, text that is there once, text that takes its place); a fourth entry says why the fault changes no
answer. Rows come from what was once not noticed, and from what the rules of ``mutants.py --sweep`` drew.
"""

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

#: Module → the tests that are to notice: its own, then those that run what its own do not run.
TESTS: dict[str, list[str]] = {
    module: list(dict.fromkeys([*_NAMED.get(module, []), *covering.TESTS.get(module, [])]))
    for module in [*_NAMED, *(module for module in covering.TESTS if module not in _NAMED)]
}
