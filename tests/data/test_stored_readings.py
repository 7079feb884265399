"""What is read of a small capture of every format, and the errors of damaged ones, are stored in ``stored_readings.json``.

Whatever changes a number, a note or an error of a reader changes a line here. Other tests say whether it is right.
``DHTORCH_STORE=1 pytest tests/data/test_stored_readings.py`` stores them anew, after a change that is meant.
"""

import json
import random
import re
import warnings
from pathlib import Path
from unittest import mock

import pytest

pytest.importorskip("av")
pytest.importorskip("h5py")
pytest.importorskip("lzfse")
pytest.importorskip("OpenEXR")
pytest.importorskip("pyarrow")

from support import byte_damage, digests
from support import damage_harness as harness
from support.captures_by_format import SAMPLES
from support.stored_values import stored_values

from dhtorch.cli import inspect
from dhtorch.data import FormatError
from dhtorch.validation.capture_check import CaptureCheck

FILE = Path(__file__).with_name("stored_readings.json")

#: Damaged captures of each format whose files are not compressed by a library of another version elsewhere.
DAMAGED = 16

#: Files whose decoders have messages of their own.
FOREIGN = (".mp4", ".mkv", ".exr", ".h5", ".hdf5", ".jpg", ".jpeg", ".parquet", ".tif", ".tiff")


def tables(recording):
    """What a recording states beside its frames, and its first and last frame."""
    names = ("name", "format", "number", "times", "poses", "depth_unit", "rate_hz", "camera_name", "episode", "sparse")
    stated = {name: getattr(recording, name) for name in names if hasattr(recording, name)}
    frames = {"first": recording[0], "last": recording[len(recording) - 1]}
    return digests.digest(stated | frames | {"report": list(getattr(recording, "report", ()))})


def readings(path):
    """Digest of every recording or stack at a path."""
    return [tables(each) for each in harness._opened(path)[:2]]


def surveyed(path):
    """Facts and warnings of ``dhtorch inspect``, without the check of poses and depth (``test_stored_answers.py``)."""
    lines = []
    with mock.patch.object(inspect, "check_capture", lambda recording, _: CaptureCheck(recording)):
        for capture in inspect.find_captures(path):
            for survey in inspect.survey_capture(capture, 2):
                lines += [survey.name, *(f"{what}: {text}" for what, text in survey.facts), *survey.warnings]
    return lines


def plain(value, root):
    """Without the place of the capture and addresses of objects."""
    text = json.dumps(value).replace(str(root), "ROOT")
    return json.loads(re.sub(r"0x[0-9a-f]+", "0x", text))


def attempt(call, root):
    """The result of a call, or its error."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return plain(call(), root)
    except (FormatError, ValueError) as error:
        return plain(f"{type(error).__name__}: {error}", root)


def found(name, folder):
    """All that is stored of a format."""
    root = folder / "capture"
    root.mkdir(parents=True)
    write, read = SAMPLES[name]
    path = write(root) or root
    result = {"read": attempt(lambda: readings(path), folder), "inspect": attempt(lambda: surveyed(path), folder)}
    good = {str(f.relative_to(root)): f.read_bytes() for f in sorted(root.rglob("*")) if f.is_file()}
    have, errors = good, []
    for seed in range(DAMAGED):
        what, want = byte_damage.mutate(good, random.Random(f"{name} {seed}"))
        if any(word.endswith(FOREIGN) for word in re.split(r"[:;] ", what)):
            continue
        harness._lay(root, have, want)
        have = want
        outcome = attempt(lambda: bool(read(path)), folder)
        errors.append([what, outcome if isinstance(outcome, str) else "read"])
    return result | {"damaged": errors}


@pytest.mark.parametrize("name", SAMPLES)
def test_a_format_reads_as_it_is_stored(name, tmp_path):
    now = found(name, tmp_path)
    stored = stored_values(FILE, {name: now}, SAMPLES)[name]
    assert now["damaged"] == stored["damaged"] and len(now["inspect"]) == len(stored["inspect"])
    for line, expected in zip(now["inspect"], stored["inspect"], strict=True):  # shares depend on the processor
        assert digests.alike(line, expected, 0.02, 0.02), f"found {line}, stored {expected}"
    assert isinstance(now["read"], str) == isinstance(stored["read"], str)
    if isinstance(now["read"], str):
        assert now["read"] == stored["read"]
        return
    assert len(now["read"]) == len(stored["read"])
    wrong = [line for a, b in zip(now["read"], stored["read"], strict=True) for line in digests.differences(a, b)]
    assert not wrong, "\n".join(wrong)


def test_every_format_is_stored():
    assert list(stored_values(FILE)) == list(SAMPLES)
