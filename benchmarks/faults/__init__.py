"""The faults that ``mutants.py`` plants, by the part of the house they are in, and the tests that must notice.

A row is (function, text that is there once, text that takes its place); a fourth entry says why the fault changes no
answer. Rows come from what was once not noticed, and from what the rules of ``mutants.py --sweep`` drew.
"""

from faults import (
    commanding,
    compiled,
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

#: Module → the tests of its own that are to notice, quick ones first.
TESTS: dict[str, list[str]] = {module: tests for part in PARTS for module, tests in part.TESTS.items()}
