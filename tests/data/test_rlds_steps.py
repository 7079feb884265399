"""Values of a range of steps, read from the middle of a record: each step has its own."""

from types import SimpleNamespace

import numpy as np
import pytest

from dhtorch.data.codecs.tfrecord import ByteSpan, ExampleFeature
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.rlds_steps import EpisodeSteps

N, SIZE = 19, 3
FIRST = 11  # bytes of the file before the numbers


def episode(path, kind="float", n=N, dtype="float32", more=b""):
    """Steps whose numbers are 100 · step + column, packed as floats or as one varint each; texts and images name their
    step."""
    numbers = (100 * np.arange(n)[:, None] + np.arange(SIZE)).reshape(-1)
    if kind == "float":
        packed = numbers.astype("<f4").tobytes()
    else:
        packed = b"".join(bytes([x & 0x7F | 0x80, x >> 7]) if x > 127 else bytes([x]) for x in numbers.tolist())
    words = [f"step {i}".encode() for i in range(n)]
    starts = np.cumsum([0, *map(len, words)])
    path.write_bytes(b"." * FIRST + packed + more + b"".join(words))
    begin = FIRST + len(packed) + len(more)
    spans = tuple(ByteSpan(begin + int(a), len(w)) for a, w in zip(starts, words, strict=False))
    parsed = {
        "steps/action": ExampleFeature(kind, (ByteSpan(FIRST, len(packed)),)),
        "steps/image": ExampleFeature("bytes", spans),
        "steps/text": ExampleFeature("bytes", spans),
    }
    features = {
        "action": SimpleNamespace(kind="tensor", dtype=dtype, shape=(SIZE,)),
        "image": SimpleNamespace(kind="image"),
        "text": SimpleNamespace(kind="text"),
    }
    return EpisodeSteps(SimpleNamespace(file=path, split="train", number=2), n, features, parsed)


@pytest.mark.parametrize("kind", ["float", "int64"])
@pytest.mark.parametrize("steps", [range(8), range(8, 16), range(16, 19), range(5, 5)])
def test_steps_have_their_own_numbers(kind, steps, tmp_path):
    of = episode(tmp_path / "record", kind, dtype="float32" if kind == "float" else "int64")
    values = of.values("action", steps)
    assert values.dtype == of.features["action"].dtype and values.shape == (len(steps), SIZE)
    assert np.array_equal(values, 100 * np.array(steps)[:, None] + np.arange(SIZE))


def test_steps_have_their_own_pictures_and_texts(tmp_path):
    of = episode(tmp_path / "record")
    assert of.values("image", range(8, 11)) == [b"step 8", b"step 9", b"step 10"]
    assert of.values("text", range(8, 11)) == ["step 8", "step 9", "step 10"]


def test_numbers_of_another_length_are_refused(tmp_path):
    of = episode(tmp_path / "record", "int64", dtype="int64")
    short = EpisodeSteps(of.place, N + 1, of.features, of.parsed)
    with pytest.raises(FormatError, match=f"{N * SIZE} numbers"):
        short.values("action", range(2))
