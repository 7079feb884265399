"""Decoders of LZFSE, OpenEXR and video: what they give back, and that damage never reaches further than an error."""

import contextlib
import io
import multiprocessing
import os
import random
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.box_scene import walk
from support.byte_damage import overwrite
from support.writers.parts import write_video
from support.writers.rosbag import BagLayout, write_rosbag

from dhtorch import data
from dhtorch.data.codecs import exr as codec_exr
from dhtorch.data.codecs import lzfse as codec_lzfse
from dhtorch.data.codecs import parquet
from dhtorch.data.codecs import video as codec_video
from dhtorch.data.depth_maps import DepthMaps
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError, resolve_inside
from dhtorch.data.readers import lerobot_meta
from dhtorch.data.readers.lerobot_rows import read_row_table
from dhtorch.data.units import DepthUnit

lzfse = pytest.importorskip("lzfse")
OpenEXR = pytest.importorskip("OpenEXR")
av = pytest.importorskip("av")

HERE = Path("here")


def test_a_missing_decoder_names_its_extra() -> None:
    with pytest.raises(ImportError, match=r"needs no_such_a or no_such_b, .* pip install no_such_a$"):
        files.import_optional("no_such_a", "no_such_b")
    assert files.import_optional("no_such_a", "json").__name__ == "json"


# -------------------------------------------------------------------------------------------------------------- lzfse


def texts() -> list[bytes]:
    """One for each kind of block: compressed, LZVN, stored, empty, many blocks."""
    draw = np.random.default_rng(0)
    noise = draw.normal(2, 0.1, (256, 192)).astype("<f4").tobytes()
    return [noise, b"abcabcabcd" * 300, b"short", b"", bytes(1_000_000), draw.bytes(100_000), noise * 4]


@pytest.mark.parametrize("text", texts(), ids=lambda text: f"{len(text)}")
def test_lzfse_gives_back_the_bytes(text: bytes) -> None:
    packed = lzfse.compress(text)
    assert codec_lzfse.lzfse_unpacked_size(packed, HERE, "depth") == len(text)
    assert codec_lzfse.decompress_lzfse(packed, len(text), HERE, "depth") == text
    for other in {len(text) + 4, max(len(text) - 4, 0)} - {len(text)}:
        with pytest.raises(FormatError, match=rf"depth: found {len(text)} bytes when unpacked, expected {other}"):
            codec_lzfse.decompress_lzfse(packed, other, HERE, "depth")
    # each place where a block may end, and a good many others
    for cut in {*range(1, 40), len(packed) // 2, len(packed) - 4, len(packed) - 20} if len(packed) > 100 else ():
        with pytest.raises(FormatError, match=r"here: depth: found b'.*' at byte \d+ of \d+"):
            codec_lzfse.decompress_lzfse(packed[:-cut], len(text), HERE, "depth")


def test_lzfse_that_is_not_compressed_is_taken_as_it_is_and_one_that_lies_never_gets_room() -> None:
    raw = np.arange(12, dtype="<f4").tobytes()
    assert codec_lzfse.decompress_lzfse(raw, 48, HERE, "depth") == raw
    with pytest.raises(FormatError, match="whole LZFSE block"):
        codec_lzfse.decompress_lzfse(raw, 44, HERE, "depth")
    packed = bytearray(lzfse.compress(bytes(1_000_000)))
    packed[4:8] = struct.pack("<I", 1000)  # claims few bytes and holds a million
    claimed = codec_lzfse.lzfse_unpacked_size(bytes(packed), HERE, "depth")
    assert claimed < 1_000_000
    with contextlib.suppress(FormatError):
        assert len(codec_lzfse.decompress_lzfse(bytes(packed), claimed, HERE, "depth")) == claimed


# ------------------------------------------------------------------------------------------------------------ OpenEXR


def exr(file: Path, channels: dict[str, np.ndarray], compression: object = OpenEXR.ZIP_COMPRESSION) -> Path:
    OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, channels).write(str(file))
    return file


@pytest.mark.parametrize("name", ["NO", "RLE", "ZIPS", "ZIP", "PIZ"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_exr_gives_back_the_channel(tmp_path: Path, name: str, dtype: type) -> None:
    depth = (np.random.default_rng(0).random((77, 51)) * 5).astype(dtype)
    file = exr(tmp_path / "d.exr", {"R": depth}, getattr(OpenEXR, f"{name}_COMPRESSION"))
    got = codec_exr.read_exr(file, hw=(77, 51))
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, depth.astype(np.float32))
    whole = file.read_bytes()
    for cut in (1, 10, len(whole) // 3, len(whole) - 20, len(whole) - 4):
        file.write_bytes(whole[:-cut])
        with pytest.raises(FormatError, match=r"d\.exr: \w+"):
            codec_exr.read_exr(file)


WINDOW = b"dataWindow\0box2i\0"
A, B = np.full((4, 6), 1, np.float32), np.full((4, 6), 2, np.float32)


def window(x: int, y: int) -> Callable[[bytes], bytes]:
    """An image whose header states another corner."""
    return lambda whole: re.sub(
        re.escape(WINDOW) + b"(.{4}).{16}",
        lambda m: WINDOW + m[1] + struct.pack("<4i", 0, 0, x, y),
        whole,
        flags=re.DOTALL,
    )


@pytest.mark.parametrize(
    ("channels", "damage", "options", "answer"),
    [
        ({"odd": A}, bytes, {}, 1),
        ({"R": B, "odd": A}, bytes, {}, 2),
        ({"R": B, "odd": A}, bytes, {"channel": "odd"}, 1),
        ({"R": B, "odd": A}, bytes, {"channel": "far"}, "channels: found R, odd, expected far"),
        ({"odd1": A, "odd2": B}, bytes, {}, "channels: found odd1, odd2, expected one of R"),
        ({"R": B}, bytes, {"hw": (6, 4)}, "size: found 6x4, expected 4x6"),
        ({"R": A}, window(2**14, 2**14), {}, "dataWindow: found 16385x16385 with 1"),
        ({"R": A}, window(2**30, 2**30), {}, "header: found "),
        ({"R": A}, lambda whole: whole[:4] + struct.pack("<I", 2 | 0x1000) + whole[8:], {}, "header|parts"),
        ({"R": A}, lambda whole: whole[:4] + struct.pack("<I", 2 | 0x200) + whole[8:], {}, "header|parts"),
        ({"R": A}, lambda whole: b"\x89PNG" + whole, {}, "expected an OpenEXR image"),
    ],
)
def test_exr_chooses_its_channel_and_its_header_decides_before_the_decoder(
    tmp_path: Path,
    channels: dict[str, np.ndarray],
    damage: Callable[[bytes], bytes],
    options: dict[str, Any],
    answer: int | str,
) -> None:
    file = exr(tmp_path / "1.exr", channels)
    file.write_bytes(damage(file.read_bytes()))
    if isinstance(answer, int):
        assert codec_exr.read_exr(file, **options)[0, 0] == answer
        assert codec_exr.decode_exr_header(file.read_bytes(), file) == ((4, 6), tuple(channels))
    else:
        with pytest.raises(FormatError, match=answer):
            codec_exr.read_exr(file, **options)


# -------------------------------------------------------------------------------------------------------------- video

N = 40


def grey(i: int) -> np.ndarray:
    return np.full((48, 64, 3), 40 + 5 * i, np.uint8)


def number(picture: np.ndarray) -> int:
    """Which of the grey pictures this is."""
    return round((float(picture.mean()) - 40) / 5)


def film(file: Path, codec: str = "libx264", **options: object) -> Path:
    write_video(file, [grey(i) for i in range(N)], [i / 60 for i in range(N)], codec=codec, **options)
    return file


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("b_frames", [0, 3])
def test_frames_by_number_in_any_order(tmp_path: Path, codec: str, b_frames: int) -> None:
    file = film(tmp_path / "a.mp4", codec, b_frames=b_frames)
    header = codec_video.read_video_header(file)
    assert (header.n, header.hw, header.rate_hz) == (N, (48, 64), 60)
    assert header.codec == {"libx264": "h264", "libx265": "hevc"}[codec]
    np.testing.assert_allclose(codec_video.read_video_times(file), np.arange(N) / 60, atol=1e-6)
    order = [*range(N), *random.Random(0).choices(range(N), k=40), *reversed(range(N))]
    assert [number(codec_video.read_video_frame(file, i)) for i in order] == order


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("b_frames", [0, 2])
def test_a_frame_hidden_by_an_edit_list_is_there_for_who_asks(tmp_path: Path, codec: str, b_frames: int) -> None:
    file = film(tmp_path / "a.mp4", codec, b_frames=b_frames, hide_first=True)
    shown = len(codec_video.read_video_times(file))
    assert shown == N - 1 and number(codec_video.read_video_frame(file, 0)) == 1
    assert codec_video.read_video_header(file, all_frames=True).n == N
    assert codec_video.read_video_times(file, all_frames=True)[0] == pytest.approx(-1 / 60, abs=1e-4)
    got = [number(codec_video.read_video_frame(file, i, all_frames=True)) for i in range(N)]
    assert got == list(range(N))


@pytest.mark.parametrize("hidden", [False, True])
def test_a_decoder_that_shows_no_index_counts_the_same(tmp_path: Path, hidden: bool, monkeypatch) -> None:
    """PyAV before 17."""
    file = film(tmp_path / "a.mp4", hide_first=hidden)
    said = [codec_video.read_video_header(file, all_frames=every) for every in (False, True)]
    codec_video.close_videos()
    without = lambda thing, name, other: other if name == "index_entries" else getattr(thing, name, other)  # noqa: E731
    monkeypatch.setattr(codec_video, "getattr", without, raising=False)
    assert [codec_video.read_video_header(file, all_frames=every) for every in (False, True)] == said
    assert [header.n for header in said] == [N - hidden, N]
    codec_video.close_videos()


def test_a_damaged_frame_never_shifts_the_others(tmp_path: Path) -> None:
    file = film(tmp_path / "a.mp4", key_every=10, b_frames=0)
    with av.open(str(file)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    whole = bytearray(file.read_bytes())
    for at, size in places[10:13]:  # the second key frame and what follows
        whole[at + 4 : at + size] = bytes(size - 4)
    file.write_bytes(bytes(whole))
    assert codec_video.read_video_header(file).n == N
    with pytest.raises(FormatError, match=r"a.mp4: frame 10: found"):
        codec_video.read_video_frame(file, 10)
    for i in (*range(10), *range(20, N)):
        assert number(codec_video.read_video_frame(file, i)) == i


def change(file: Path, at: bytes, offset: int, new: bytes) -> Path:
    """The file with other bytes beside the first ``at``."""
    whole = file.read_bytes()
    place = whole.index(at) + offset
    file.write_bytes(whole[:place] + new + whole[place + len(new) :])
    return file


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (
            lambda root: codec_video.read_video_frame(film(root / "a.mp4"), N),
            "frame 40: found 40 frames, expected 40 frames",
        ),
        (
            lambda root: codec_video.read_video_frame(film(root / "a.mp4"), 0, (64, 48)),
            "frame 0 size: found 64x48, expected 48x64",
        ),
        (
            lambda root: codec_video.read_video_header(root / "no.mp4"),
            r"no.mp4: file: found no such file, expected a readable file",
        ),
        (
            lambda root: codec_video.read_video_header(film(root / "a.mp4"), track=1),
            "streams: found 1 of video, expected at least 2",
        ),
        (
            lambda root: codec_video.read_video_header(change(film(root / "a.mp4"), b"moov", 0, b"moon")),
            "a.mp4: content",
        ),
        (
            lambda root: codec_video.read_video_header(change(film(root / "a.mp4"), b"stts", 12, b"\x7f\0\0\0")),
            r"stts: found 2\d+ samples in \d+ bytes",
        ),
        (
            lambda root: codec_video.read_video_header(change(film(root / "a.mp4"), b"ftyp", 0, b"none")),
            r"content: found .*expected a video file: mp4, mov",
        ),
    ],
)
def test_unsound_videos(tmp_path: Path, read: Callable[[Path], object], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read(tmp_path)


def boxes(kind: bytes, *content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(b"".join(content)), kind) + b"".join(content)


def test_each_track_has_the_display_matrix_of_its_own() -> None:
    video = boxes(b"mdia", boxes(b"hdlr", bytes(8) + b"vide"))
    matrix = struct.pack(">5i", 0, 65536, 0, -65536, 0)
    headers = [b"", boxes(b"tkhd", bytes(40) + matrix), b"", boxes(b"tkhd", b"\1" + bytes(51) + matrix)]
    stream = io.BytesIO(boxes(b"moov", *(boxes(b"trak", header, video) for header in headers)))
    assert [codec_video._inspect_mp4(stream, HERE, track) for track in range(5)] == [0, 1, 0, 1, 0]


@pytest.mark.parametrize(("stored", "kind", "scale"), [("yuv420p", np.uint8, 1), ("yuv420p10le", np.uint16, 4)])
def test_luma_is_the_stored_plane_without_its_padding(tmp_path: Path, stored: str, kind: type, scale: int) -> None:
    ramp = np.repeat((np.arange(50) * 5).astype(np.uint8)[None, :, None], 48, 0).repeat(3, 2)
    write_video(tmp_path / "a.mp4", [ramp] * 2, [0, 0.1], stored=stored, crf=1)
    luma, full = (codec_video.read_video_frame(tmp_path / "a.mp4", 0, pixels=p) for p in ("luma", "gray"))
    assert luma.dtype == kind and luma.shape == (48, 50)
    assert np.abs(luma / scale - (16 + full.astype(float) * 219 / 255)).max() < 2


def _in_child(file: Path, wanted: list[int], say: Callable[[list[int]], None]) -> None:
    say([number(codec_video.read_video_frame(file, i)) for i in wanted])


def test_a_forked_worker_opens_its_own(tmp_path: Path) -> None:
    """Parent and children read on in turn: with a shared file position they would get one another's bytes."""
    noise = np.random.default_rng(0).integers(-30, 30, (N, 96, 128, 3))
    pictures = [np.full((96, 128, 3), 40 + 5 * i) + noise[i] for i in range(N)]
    file = tmp_path / "a.mp4"
    noisy = [np.clip(x, 0, 255).astype(np.uint8) for x in pictures]
    write_video(file, noisy, [i / 60 for i in range(N)], crf=0)
    assert file.stat().st_size > 400_000  # many times what a decoder reads ahead
    assert number(codec_video.read_video_frame(file, 3)) == 3
    fork = multiprocessing.get_context("fork")
    answers = fork.SimpleQueue()
    wanted = list(range(4, N - 4))
    children = [fork.Process(target=_in_child, args=(file, wanted, answers.put)) for _ in range(2)]
    for child in children:
        child.start()
    assert [number(codec_video.read_video_frame(file, i)) for i in wanted] == wanted
    for child in children:
        child.join(30)
        assert child.exitcode == 0
    assert [answers.get() for _ in children] == [wanted] * 2


def test_a_few_decoders_stay_open(tmp_path: Path) -> None:
    many = [film(tmp_path / f"{i}.mp4", b_frames=0) for i in range(11)]

    def held() -> int:
        return sum(os.path.realpath(each).startswith(str(tmp_path)) for each in Path("/proc/self/fd").iterdir())

    codec_video.close_videos()
    for i in range(3):
        for file in many:
            assert number(codec_video.read_video_frame(file, i)) == i
    assert held() == 8
    codec_video.close_videos()
    assert held() == 0


@pytest.mark.parametrize("name", ["", "a\0b", "x" * 1001, "/etc/passwd", "../a.png", "a/../../b.png"])
def test_a_name_that_leads_out_of_the_capture_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"file_path: found .*expected a file inside the capture"):
        resolve_inside(tmp_path, name, tmp_path / "a.json", "file_path")
    for inside in ("a/b.png", "x" * 1000):
        assert resolve_inside(tmp_path, inside, tmp_path / "a.json", "file_path") == tmp_path / inside


@pytest.mark.parametrize("wrong", [-1.0, 1.5, 10.0, float("nan")])
def test_counts_are_whole_numbers_below_a_limit(wrong: float) -> None:
    assert lerobot_meta._check_counts(np.array([0.0, 9.0]), HERE, "length", 10).tolist() == [0, 9]
    with pytest.raises(FormatError, match=f"length: found {wrong}, expected a count"):
        lerobot_meta._check_counts(np.array([0.0, wrong]), HERE, "length", 10)


# ------------------------------------------------------------------------------------------------------------- caches


def write_table(file: Path, value: int) -> None:
    arrow, table = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {"timestamp": np.arange(9.0), "frame_index": np.full(9, value), "episode_index": np.zeros(9, np.int64)}
    table.write_table(arrow.table(columns), file, use_dictionary=False, compression="none")


def write_maps(file: Path, value: int) -> None:
    np.save(file, np.full((2, 4, 6), value, np.float32))


def write_bag(file: Path, value: int) -> None:
    frames = [frame.replace(image=torch.full_like(frame.image, value)) for frame in walk(1, hw=(24, 32))]
    write_rosbag(file, frames, BagLayout("ros1", compression="lz4"))


#: Content cached in a process: name of the file, how it is written with a value, and how the value is read.
CACHED: dict[str, tuple[str, Callable[[Path, int], object], Callable[[Path], object]]] = {
    "cell": ("a.parquet", write_table, lambda file: parquet.read_row(file, ("frame_index",), 4)["frame_index"]),
    "rows": ("a.parquet", write_table, lambda file: read_row_table(file, ())["frame_index"][4]),
    "maps": ("a.npy", write_maps, lambda file: DepthMaps([file], DepthUnit(1.0), (4, 6), clip_index=[1])[0].max()),
    "chunk": ("a.bag", write_bag, lambda file: int(data.open(file)[0].image[0, 0, 0, 0])),
    "frame": (
        "a.mp4",
        lambda file, value: write_video(file, [grey(value)] * 3, [0, 0.1, 0.2], codec="libx264"),
        lambda file: number(codec_video.read_video_frame(file, 1)),
    ),
}


@pytest.mark.parametrize("kind", CACHED)
def test_content_cached_in_a_process_is_that_of_the_file(tmp_path: Path, kind: str) -> None:
    """Also after a change that leaves the file's size and time of modification as they were."""
    name, write, read = CACHED[kind]
    write(tmp_path / name, 3)
    write(tmp_path / f"new_{name}", 5)
    assert read(tmp_path / name) == 3
    content = (tmp_path / f"new_{name}").read_bytes()
    assert len(content) == (tmp_path / name).stat().st_size or kind == "frame"
    overwrite(tmp_path / name, content)
    assert read(tmp_path / name) == 5
