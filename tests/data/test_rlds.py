"""RLDS data sets in TFRecord files: written with known geometry and read back, real ones, and damaged ones."""

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.box_scene import HW
from support.capture_cases import DELETE, Case, check_case
from support.robot_episodes import three_episodes
from support.writers import write_rlds

from dhtorch import data
from dhtorch.cli import run
from dhtorch.codes import Gate, PoseCode
from dhtorch.data.codecs import tfrecord
from dhtorch.data.io.decode import FormatError
from dhtorch.export.arrays import encode_depth_codes
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Frame
from dhtorch.synthetic import SyntheticRoom

ROOT = Path(os.environ.get("DHTORCH_DATA", "/nowhere")) / "rlds_bridge" / "bridge_dataset" / "1.0.0"
needs_data = pytest.mark.skipif(not ROOT.is_dir(), reason="DHTORCH_DATA has no rlds_bridge")
FILE = "tiny_robot-train.tfrecord-00000-of-00001"


# ---------------------------------------------------------------------------------------------------- written


@pytest.mark.parametrize("depth", ["png", "array", None])
@pytest.mark.parametrize("has_size", [True, False])
def test_what_is_written_is_read(depth: str | None, has_size: bool, tmp_path: Path) -> None:
    want = three_episodes()
    write_rlds(tmp_path, want, depth=depth, shards=2, has_size=has_size)  # type: ignore[arg-type]
    found = data.open_all(tmp_path, rate_hz=30)
    assert data.recognise(tmp_path)[0] == "rlds" and len(found) == 3
    assert found.names[1] == "tiny_robot/train_000001/image_0"  # type: ignore[attr-defined]
    for recording, frames in zip(found, want, strict=True):
        assert len(recording) == len(frames) and bool(recording.report) == (depth is None)
        for frame, shot in zip(recording, frames, strict=True):
            assert torch.equal(frame.image, shot.image)
            assert torch.allclose(frame.camera.f, shot.camera.f) and torch.allclose(frame.camera.c, shot.camera.c)
            assert torch.allclose(frame.T_world_from_cam.t, shot.T_world_from_cam.t, atol=1e-6)
            exact = {"png": torch.from_numpy(encode_depth_codes(shot.depth, 1000).astype(np.float32))[None] / 1000}
            expected = {"array": shot.depth, None: 0 * shot.depth}.get(depth, exact["png"])
            assert torch.allclose(frame.depth, expected, atol=1e-6)
        assert recording.times is not None and torch.equal(recording.times, torch.arange(len(frames)).double() / 30)


def test_an_episode_is_read_when_it_is_asked_for(tmp_path: Path) -> None:
    write_rlds(tmp_path, three_episodes())
    file = tmp_path / FILE
    spans = tfrecord.index_records(file)
    raw = bytearray(file.read_bytes())
    raw[spans[1].offset + 40] ^= 1
    file.write_bytes(raw)
    found = data.open_all(tmp_path)
    assert len(found[0]) == 2 and len(found[2]) == 4
    with pytest.raises(FormatError, match=r"record at byte \d+: found checksum [0-9a-f]{8}, expected [0-9a-f]{8}"):
        found[1]


def write_set(root: Path, _frames: list[Frame]) -> None:
    """Three episodes without intrinsics and poses."""
    write_rlds(root, three_episodes(), depth="array", intrinsics=False, poses=False)


def rlds_case(name: str, edits: Any = (), expect: Any = None, **more: Any) -> Case:
    return Case(name, write_set, lambda: three_episodes()[2], edits, expect or {}, **more)


FEATURES, K = "features.json", {"K": [100, 100, 32, 24]}
LONG: Any = {"featuresDict": {"features": {"image_0": {"image": {"shape": {"dimensions": ["1" * 40, "2", "3"]}}}}}}
LONG = {"featuresDict": {"features": {"observation": LONG}}}
LONG = {"featuresDict": {"features": {"steps": {"sequence": {"feature": LONG}}}}}
CASES = [
    rlds_case("one episode", (), {"title": "tiny_robot/train_000002/image_0", "posed": False, "times": None,
                                  "f": [100, 100], "number": [0, 1, 2, 3]}, options={"episode": 2} | K),
    rlds_case("a field of view", (), {"f": pytest.approx([HW[1] / 2] * 2)},
              options={"episode": 0, "split": "train", "fov": 90.0}),
    rlds_case("millimetres", (), {"unit": (1e-3, "option depth_unit")},
              options={"episode": 0, "fov": 90.0, "depth_unit": "mm"}),
    rlds_case("no K", options={"episode": 0}, error=r"data\.fov=69"),
    *(rlds_case(f"option {options}", options=options, error=message) for options, message in (
        ({"episode": 3}, "found 3, expected 0 to 2 in train"), ({"split": "test"}, "found test, expected one of train"),
        ({"camera": "observation/image_9"}, "expected one of observation/image_0"),
        ({"depth": "observation/depth_9"}, "option depth"), ({"intrinsics": "K"}, "option intrinsics"),
        ({"rate_hz": 0}, "option rate_hz"),
        ({"fov": 90.0, "K": [1, 1, 1, 1]}, "found data.K and data.fov, expected one of them"),
        ({"intrinsics": "action"}, "found 7 numbers a step, expected 4 or 9"),
        ({"fov": 90.0, "pose": "is_last"}, "expected 7 or 16"))),
    *(rlds_case(f"features {content}", [(FEATURES, content)], options=K, error=r"features\.json")
      for content in ("{}", '{"featuresDict": {"features": {}}}', "[]")),
    rlds_case("sizes of no array", [(FEATURES, LONG)], options=K, error="sizes of an array"),
    rlds_case("no features", [(FEATURES, DELETE)], error="format: found"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


# ---------------------------------------------------------------------------------------------------- checksums, messages


def test_check_sums() -> None:
    assert tfrecord.crc32c(b"123456789") == 0xE3069283  # RFC 3720, B.4, as the next ones
    assert tfrecord.crc32c(bytes(32)) == 0x8A9136AA
    assert tfrecord.crc32c(b"\xff" * 32) == 0x62A8AB43
    assert tfrecord.crc32c(bytes(range(32))) == 0x46DD794E

    def slowly(text: bytes) -> int:
        state = 0xFFFFFFFF
        for byte in text:
            state ^= byte
            for _ in range(8):
                state = (state >> 1) ^ (0x82F63B78 if state & 1 else 0)
        return state ^ 0xFFFFFFFF

    draw = np.random.default_rng(0)
    for size in (0, 1, 511, 512, 513, 1536, 3001):
        text = draw.integers(0, 256, size, dtype=np.uint8).tobytes()
        assert tfrecord.crc32c(text) == slowly(text)


def record(body: bytes) -> bytes:
    length = struct.pack("<Q", len(body))
    sums = (struct.pack("<I", tfrecord.mask_crc(tfrecord.crc32c(x))) for x in (length, body))
    return length + next(sums) + body + next(sums)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "found 0 bytes|records: found none"),
        (b"12345", "a TFRecord header of 12"),
        (record(b"abc")[:-1], "record 0"),
        (struct.pack("<Q", 3) + b"\0\0\0\0abc\0\0\0\0", "wrong checksum of its length"),
        (record(b"")[:8] + b"\0" * 8, "wrong checksum"),
        (record(struct.pack("<Q", 1 << 62)), "observation/image_0: found nothing"),
        (record(b"\x0a\xff\xff\xff\xff\x0f"), "a field of"),
        (record(b"\x0a" + b"\xff" * 12), "unterminated number"),
        (record(b"\x0b"), "wire type 3"),
    ],
)
def test_no_records(content: bytes, said: str, tmp_path: Path) -> None:
    write_rlds(tmp_path, three_episodes()[:1])
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(FormatError, match=said):
        _ = data.open_all(tmp_path, fov=60.0)[0]


def test_whole_numbers_of_all_sizes(tmp_path: Path) -> None:
    from support.writers.rlds import _encode_field, _int64s_feature  # noqa: PLC0415

    values = [0, 1, -1, 127, 128, 300, 2**62, -(2**63), 2**63 - 1]
    body = _encode_field(1, _encode_field(1, _encode_field(1, b"x") + _encode_field(2, _int64s_feature(values))))
    file = tmp_path / "x"
    file.write_bytes(record(body))
    (span,) = tfrecord.index_records(file)
    feature = tfrecord.parse_example(tfrecord.read_record(file, span), file, span.offset)["x"]
    assert tfrecord.read_feature_numbers(file, "x", feature, 9).tolist() == values
    with pytest.raises(FormatError, match="at most 3 numbers"):
        tfrecord.read_feature_numbers(file, "x", feature, 3)


# ---------------------------------------------------------------------------------------------------- still cameras


def test_a_camera_that_stands_still_has_no_baseline(tmp_path: Path) -> None:
    still = SyntheticRoom(n_frames=2, hw=(96, 128), path="static", lidar=None, depth_hw=(96, 128), supersample=1)
    moving = SyntheticRoom(n_frames=12, hw=(96, 128), lidar=None, depth_hw=(96, 128), supersample=1)
    for name in ("paper", "map"):
        trace: dict = {}
        estimate = METHODS[name](still[0], still[1], n=200, trace=trace)
        assert trace["fit"].code.tolist() == [PoseCode.NO_BASELINE]
        assert set(estimate.gate.unique().tolist()) <= {Gate.NO_TRACK, Gate.NO_TEXTURE, Gate.NO_BASELINE}
        METHODS[name](moving[0], moving[11], n=200, trace=trace)
        assert trace["fit"].code.tolist() == [PoseCode.TOO_FEW]


# ---------------------------------------------------------------------------------------------------- the real set


@needs_data
def test_the_bridge_set() -> None:
    found = data.open_all(ROOT, fov=60.0)
    assert len(found) == 2 * 25 * 4
    recording = found[0]
    assert recording.name == "bridge_dataset/train_000000/image_0" and len(recording) == 10
    shots = torch.cat([frame.image for frame in recording])
    assert shots.shape == (10, 3, 64, 64) and shots.float().std() > 20 and not recording[0].depth.any()
    black = data.open(ROOT, fov=60.0, split="val", episode=3, camera="observation/image_3")
    assert black[0].image.float().mean() < 5
    trace: dict = {}
    METHODS["map"](recording[0], recording[8], n=300, trace=trace)
    assert trace["fit"].code.tolist() == [PoseCode.NO_BASELINE]


@needs_data
def test_every_record_of_the_bridge_set_is_whole() -> None:
    for file in ROOT.glob("*.tfrecord-*"):
        for span in tfrecord.index_records(file):
            found = tfrecord.parse_example(tfrecord.read_record(file, span), file, span.offset)
            assert len(found) == 20 and len(found["steps/observation/image_0"].spans) == 10


@needs_data
def test_the_bridge_set_can_be_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.main(["inspect", str(ROOT), "--max-frames", "2", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "rlds" in said and "no intrinsics" in said and "64x64" in said
