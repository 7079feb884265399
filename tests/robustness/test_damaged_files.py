"""Damaged captures of every format are valid data or a FormatError; the harness finds readers that misbehave."""

import itertools
import mmap
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support import byte_damage as mutations
from support import damage_harness as hostile
from support.captures_by_format import SAMPLES as CAPTURES
from support.other_inputs import OTHER_INPUTS

from dhtorch.data import FormatError

SAMPLES = CAPTURES | OTHER_INPUTS
FEW, MUTANTS, MANY = 4, 15, 2000  # of every format: more where few do no damage; the many run with the slow tests
#: Every fourth capture; the others and the other inputs, which ``make fuzz`` reads too, run with the slow tests.
NAMES = [
    pytest.param(name, marks=[pytest.mark.slow] * (k % 4 > 0 or name in OTHER_INPUTS))
    for k, name in enumerate([*CAPTURES, *OTHER_INPUTS])
]


@pytest.mark.parametrize("name", NAMES)
def test_damaged_captures_are_a_format_error_or_valid(name: str, tmp_path: Path) -> None:
    for mutants in (FEW, MUTANTS):
        (folder := tmp_path / str(mutants)).mkdir()
        counts = hostile.attack(*SAMPLES[name], folder, mutants=mutants)
        if counts["frames"] > 0 and counts["FormatError"] > mutants // 5:
            break
    assert counts["frames"] > 0 and counts["FormatError"] > counts.total() // 5  # damage is felt, and not everywhere


#: All but settings, which are the user's own.
FOREIGN = [
    pytest.param(name, marks=[pytest.mark.slow] * (name not in ("record3d_archive", "result", "points")))
    for name in SAMPLES
    if name != "settings"
]


@pytest.mark.parametrize("name", FOREIGN)
def test_what_is_no_file_is_a_format_error_or_valid(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pipes, sockets, devices, folders and files of 3 GiB in the place of each kind of file: no hang, no flood."""
    monkeypatch.setattr(hostile, "PATIENCE", 10)
    with hostile.sample(*SAMPLES[name], tmp_path) as (good, outcome_of):
        outcomes = [(what, outcome_of(want)) for what, want in mutations.iter_strange(good)]
    assert outcomes and not [each for each in outcomes if each[1].kind not in hostile.FINE]


#: Words of each command that takes a path; one has a capture beside it.
COMMANDS = {
    **{name: [name, "PATH", "out=OUT"] for name in ("complete", "extract")},
    **{name: [name, "PATH", "output=OUT"] for name in ("integrate", "run", "stream", "validate")},
    "PATH": ["PATH", "out=OUT"],
    "inspect": ["inspect", "PATH", "--out", "OUT"],
    "view": ["view", "PATH", "html=OUT.html"],
    "report": ["report", "PATH"],
    "enrich": ["enrich", "PATH", "OUT"],
    "align": ["align", "PATH", "depth=CAPTURE", "out=OUT"],
    "align depth": ["align", "CAPTURE", "depth=PATH", "out=OUT"],
    "validate depth": ["validate", "CAPTURE", "depth=PATH", "output=OUT"],
    "scale": ["scale", "PATH", "CAPTURE", "out=OUT"],
    "scale capture": ["scale", "CAPTURE", "PATH", "out=OUT"],
    "pin": ["pin", "PATH", "CAPTURE", "output=OUT"],
    "pin source": ["pin", "CAPTURE", "PATH", "output=OUT"],
}
#: Hung or read all of it once.
ONCE = [
    *(("view", ".ply", kind) for kind in ("pipe", "device", "3 GiB")),
    *((name, ".json", "3 GiB") for name in ("view", "report")),
]
CASES = [
    *ONCE,
    *(
        pytest.param(name, suffix, kind, marks=pytest.mark.slow)
        for name, suffix, kind in itertools.product(
            COMMANDS, (".r3d", ".json", ".ply", ".png"), mutations.STRANGE_FILES
        )
        if (name, suffix, kind) not in ONCE
    ),
]


@pytest.mark.parametrize(("name", "suffix", "kind"), CASES)
def test_a_command_says_what_is_no_file(
    name: str, suffix: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hostile, "PATIENCE", 30)
    monkeypatch.setattr(hostile, "SECONDS", 20)
    CAPTURES["tum"][0](capture := tmp_path / "capture")
    mutations.STRANGE_FILES[kind](path := tmp_path / f"x{suffix}")
    places = {"PATH": str(path), "CAPTURE": str(capture), "OUT": str(tmp_path / "out")}
    words = [re.sub("|".join(places), lambda found: places[found[0]], word) for word in COMMANDS[name]]
    outcome = hostile.run_command(words, path, tmp_path)
    assert outcome.kind == "FormatError", outcome


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", SAMPLES)
def test_many_damaged_captures(name: str, tmp_path: Path) -> None:
    counts = hostile.attack(*SAMPLES[name], tmp_path, mutants=MANY, seed=1)
    print(f"{name}: {dict(counts)}")
    assert counts.total() == MANY


# ------------------------------------------------------------------------------------- the harness finds what it should


def _one_file(root: Path) -> Path:
    (root / "a.txt").write_text("0123456789")
    return root / "a.txt"


def _read_zeros(path: Path) -> None:
    with Path("/dev/zero").open("rb") as zeros:
        for _ in range(99):
            zeros.read(1 << 20)


def _misread(path: Path, misdeed: Callable[[Path], Any]) -> None:
    """A reader that does well on the intact file and misbehaves on any other."""
    if not path.is_file() or path.read_bytes() != b"0123456789":
        misdeed(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("misdeed", "kind"),
    [
        (lambda path: 1 / 0, "ZeroDivisionError"),
        (lambda path: os.abort(), "crash"),
        (lambda path: os._exit(86), "code executed"),
        (lambda path: time.sleep(60), "hang"),
        (lambda path: sum(0 for _ in iter(int, 1)), "busy"),
        # pages of its own, whatever freed memory the process still holds
        (lambda path: mmap.mmap(-1, 100 << 20).write(bytes(100 << 20)), "memory"),
        (_read_zeros, "flood"),
        (lambda path: (path.parent / "b").write_text("1"), "crash"),
        (lambda path: (path.parent.parent / "intact" / "a.txt").read_text(), "escape"),
        (lambda path: os.system("true"), "escape"),
        (lambda path: (_ for _ in ()).throw(FormatError(path)), "a FormatError that does not name file and field"),
    ],
)
def test_harness_sees(
    misdeed: Callable[[Path], Any], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind == "hang":
        monkeypatch.setattr(hostile, "PATIENCE", 0.5)
    elif kind == "busy":
        monkeypatch.setattr(hostile, "SECONDS", 1)
    elif kind == "memory":
        monkeypatch.setattr(hostile, "BYTES", 64 << 20)  # less to fill on a busy machine
    with pytest.raises(AssertionError, match=rf"mutant \d+ \(.*\): {kind}"):
        hostile.attack(_one_file, lambda path: _misread(path, misdeed), tmp_path, mutants=3)
