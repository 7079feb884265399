"""CA-1M archives, and the tar and TIFF decoding below them."""

import io
import math
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from support import writers
from support.arkitscenes_frames import VGA, VGA_HW, shots
from support.box_scene import HW, check_same, render
from support.ca1m_archives import ca1m_archive, ca1m_frames
from support.capture_cases import Case, check_case

from dhtorch import data
from dhtorch.data import FormatError
from dhtorch.data.codecs import tarballs, tiff
from dhtorch.data.readers import ca1m
from dhtorch.export.tiff import encode_float_tiff
from dhtorch.records import Camera, Frame

PORTRAIT = Camera(torch.tensor([[58.25, 61.5]]), torch.tensor([[21.75, 30.5]]))


def rewrite(file: Path, change: Callable[[str, bytes], tuple[str, bytes] | None]) -> None:
    """The archive with its members changed, renamed or (None) left out."""
    out = io.BytesIO()
    with tarfile.open(file) as old, tarfile.open(fileobj=out, mode="w") as new:
        for info in old.getmembers():
            kept = change(info.name, old.extractfile(info).read())
            if kept is not None:
                info.name, info.size = kept[0], len(kept[1])
                new.addfile(info, io.BytesIO(kept[1]))
    file.write_bytes(out.getvalue())


# ------------------------------------------------------------------------------------------------ written, then read


def test_laser_depth_is_the_truth_at_the_images_pixels(tmp_path: Path) -> None:
    file, frames, _ = ca1m_archive(tmp_path, n=2)
    recording = data.open(file)
    for i, frame in enumerate(frames):
        exact = recording.truth(i)
        want = render(VGA, frame.T_world_from_cam, VGA_HW).depth
        known = exact["depth"] > 0
        assert exact["depth"].shape == (1, *VGA_HW) and float(known.double().mean()) > 0.7
        assert float(((exact["depth"] - want).abs() / want)[known].max()) < 0.01
        assert float(exact["disagreement"]) < 0.01 and not exact["surface"].any()
    assert not hasattr(data.open(file, truth=False), "truth")


def test_failed_registration_is_rejected(tmp_path: Path) -> None:
    frames, lasers = ca1m_frames(2)
    lasers[1] = lasers[1].replace(depth=lasers[1].depth * 0.9)
    writers.write_ca1m(tmp_path / "ca1m-val-1.tar", frames, lasers, without=[(0, "gt/depth.png")])
    recording = data.open(tmp_path)
    assert recording.report == ("1 frame without gt/depth: no ground truth",)
    none, bad = recording.truth(0), recording.truth(1)
    assert none["depth"].shape == (1, *VGA_HW) and not none["depth"].any() and math.isnan(none["disagreement"])
    assert not bad["depth"].any() and float(bad["disagreement"]) == pytest.approx(0.111, abs=0.005)
    assert data.open(tmp_path, max_disagreement=0.2).truth(1)["depth"].any()


def write(
    root: Path,
    frames: list[Frame],
    *,
    lasers: list[Frame] | None = None,
    change: Callable[[str, bytes], tuple[str, bytes] | None] | None = None,
    **options: Any,
) -> None:
    """An archive with its members changed."""
    file = root / "ca1m-val-1.tar"
    writers.write_ca1m(file, frames, ca1m_frames(len(frames))[1] if lasers is None else lasers, **options)
    if change is not None:
        rewrite(file, change)


def ca1m_case(name: str, n: int = 4, expect: Any = None, **more: Any) -> Case:
    frames = more.pop("frames", lambda: ca1m_frames(n)[0])
    rest = {key: more.pop(key) for key in ("options", "error") if key in more}
    return Case(name, write, frames, (), expect or {}, written=more, path="ca1m-val-1.tar", **rest)


def plain(name: str, body: bytes) -> tuple[str, bytes] | None:
    """No confidence and no intrinsics of the depth."""
    return None if "confidence" in name or "wide/depth/K" in name else (name, body)


def flat(name: str, body: bytes) -> tuple[str, bytes]:
    """Flat matrices, and other extensions."""
    if "RT" in name or "K.json" in name:
        return f"./{name}", b"[" + body.replace(b"[", b"").replace(b"]", b"") + b"]"
    return name.replace(".png", ".tiff").replace("wide/depth.", "WIDE/Depth."), body


def confidence(values: np.ndarray) -> Callable[[str, bytes], tuple[str, bytes]]:
    """Another confidence in every frame."""
    return lambda name, body: (name, encode_float_tiff(values) if "confidence" in name else body)


def upright() -> list[Frame]:
    """A frame of a phone that was held upright."""
    return [render(PORTRAIT, shots([100.0])[0].T_world_from_cam, (64, 48), 100.0)]


NONE = ("no confidence: all returns are weighted equally",)
LEVELS = ca1m_frames(1)[0][0].conf[0].numpy()
MISSING = [(1, "gt/RT.json"), (3, "wide/depth/confidence.tiff"), (4, "wide/image.png"), (5, "gt/depth/K.json")]
LOST = [f"^1 frame without {what}: left out" for what in ("gt/rt", "wide/depth/confidence", "wide/image")]
TIMES = [99.9, 100.0, 100.1]

CASES = [
    ca1m_case("whole", 4, {"format": "ca1m", "report": (), "rate": pytest.approx(10), "number": [0, 1, 2, 3],
                           "times": pytest.approx([100, 100.1, 100.2, 100.3]), "same": ([0, 1, 2, 3], 1e-3, 1.0, True)}),
    ca1m_case("held upright", 1, {"hw": (64, 48), "report": NONE, "same": ([0], 1e-3), "truth": True}, frames=upright,
              lasers=upright()),
    ca1m_case("members missing in the middle", 6, {"number": [0, 2, 5], "same": ([0, 2, 5], 1e-3), "truth": True},
              without=MISSING),
    ca1m_case("members missing, no confidence wanted", 6, {"number": [0, 2, 3, 5]}, without=MISSING,
              options={"confidence": None}),
    ca1m_case("no confidence, no camera of the depth", 4,
              {"conf": False, "depth f": None, "number": [0, 1, 2, 3], "report": NONE}, change=plain),
    ca1m_case("no truth wanted", 2, {"truth": False}, options={"truth": False}),
    ca1m_case("levels", 1, {"same": ([0], 1e-3), "conf": True}, change=confidence(LEVELS),
              options={"confidence": "level"}),
    ca1m_case("levels taken for fractions", 1, change=confidence(LEVELS),
              error=r"confidence: found 0 to 2, expected 0 to 1 \(option confidence"),
    ca1m_case("no numbers", 1, change=confidence(np.where(LEVELS > 1, np.nan, 0.0)),
              error="confidence: found 0 to 0, expected 0 to 1"),
    ca1m_case("an unknown option", 1, options={"confidence": "percent"},
              error="option confidence: found percent, expected unit, level or None"),
    ca1m_case("flat matrices and other extensions", 4, {"same": ([0, 1, 2, 3], 1e-3)}, change=flat),
    ca1m_case("frames sorted as numbers", 3, {"times": TIMES, "same": ([2, 1, 0], 1e-3)},
              frames=lambda: shots(TIMES)[::-1], lasers=shots(TIMES)[::-1]),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


def test_what_is_lost_is_named_and_strange_members_are_passed_over(tmp_path: Path) -> None:
    file, frames, _ = ca1m_archive(tmp_path, n=6, without=MISSING)
    recording = data.open(file)
    assert sorted(recording.report) == sorted(line.removeprefix("^") for line in LOST)
    assert recording.truth(2)["depth"].any()  # the laser's camera taken for that of the image, scaled
    with tarfile.open(file, "a") as more:
        for name in ("../../outside.wide/image.png", "/1/2.wide/image.png", "readme.txt", "42898570/x.wide/image.png"):
            more.addfile(tarfile.TarInfo(name))
    check_same(data.open(file), [frames[i] for i in (0, 2, 5)], 1 / 1000)
    assert sorted(p.name for p in tmp_path.iterdir()) == [file.name]


def test_confidence_is_a_fraction_in_three_steps(tmp_path: Path) -> None:
    steps = torch.linspace(0, 1, HW[0] * HW[1]).view(HW)
    write(tmp_path, ca1m_frames(1)[0], change=confidence(steps.numpy()))
    conf = data.open(tmp_path)[0].conf[0]
    assert conf[steps < 0.25].max() == 0 and conf[steps >= 0.75].min() == 2
    assert set(conf[(steps >= 0.25) & (steps < 0.75)].tolist()) == {1}


def test_what_is_no_archive_of_ours(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "other.tar", "w") as other:
        other.addfile(tarfile.TarInfo("a/b.png"))
    (tmp_path / "noise.tar").write_bytes(bytes(range(256)) * 8)
    (tmp_path / "empty.tar").write_bytes(b"")
    for name, message in (
        ("other.tar", r"other.tar: frames: found none, expected members wide/image"),
        ("noise.tar", r"noise.tar: header at byte 0: found a wrong checksum"),
        ("empty.tar", r"empty.tar: content: found 0 bytes, expected a tar archive"),
        ("gone.tar", r"gone.tar: path: found no such file"),
        ("", r"archives: found none, expected ca1m-<split>-<video id>.tar"),
    ):
        assert ca1m.recognise(tmp_path / name) is None
        with pytest.raises(FormatError, match=message):
            data.open(tmp_path / name, "ca1m")
    with pytest.raises(FormatError, match="file: found no such file"):
        list(tarballs.iter_tar_members(tmp_path / "gone.tar"))


def test_a_folder_of_archives_is_listed_and_none_is_opened(tmp_path: Path) -> None:
    """A hundred gigabytes are a hundred archives; one that is damaged leaves the others alone."""
    file, frames = ca1m_archive(tmp_path, n=2)[:2]
    (tmp_path / "ca1m-val-99.tar").write_bytes(b"no archive")
    recordings = data.open_all(tmp_path)
    assert list(recordings.names) == [file.stem, "ca1m-val-99"]
    assert recordings[0].name == file.stem and len(recordings[0]) == len(frames)
    with pytest.raises(FormatError, match=r"ca1m-val-99.tar: "):
        recordings[1]
    scenes = data.open_capture(tmp_path, gap=1)
    assert len(scenes) == 2 and (scenes[0].name, scenes[0].gap) == (file.stem, 1)


# -------------------------------------------------------------------------------------------------------------- tar


@pytest.mark.parametrize("format", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_members_against_the_standard_library(tmp_path: Path, format: int) -> None:
    file = tmp_path / "a.tar"
    rng = np.random.default_rng(0)
    long = "folder/" * 20 + "name.png"
    with tarfile.open(file, "w", format=format) as archive:
        for name in ("a.txt", "b/c.txt", long, "é.txt", "d.txt"):
            info = tarfile.TarInfo(name)
            body = rng.bytes(int(rng.integers(0, 2000)))
            info.size = len(body)
            archive.addfile(info, io.BytesIO(body))
        for kind in (tarfile.SYMTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE, tarfile.LNKTYPE):
            info = tarfile.TarInfo("odd" if kind != tarfile.DIRTYPE else "odd/")
            info.type, info.linkname = kind, "a.txt"
            archive.addfile(info)
        info = tarfile.TarInfo("last.txt")
        info.size = 3
        archive.addfile(info, io.BytesIO(b"end"))
    with tarfile.open(file) as archive:
        want = [(m.name, m.offset_data, m.size) for m in archive.getmembers() if m.isreg()]
        got = list(tarballs.iter_tar_members(file))
        assert [tuple(m) for m in got] == want and len(got) == 6
        for m in got:
            assert tarballs.read_tar_member(file, m.offset, m.size) == archive.extractfile(m.name).read()


def test_damaged_archives_end_the_walk(tmp_path: Path) -> None:
    file, _, _ = ca1m_archive(tmp_path, n=1)
    good = file.read_bytes()
    offset = next(iter(tarballs.iter_tar_members(file))).offset

    def header(at: int, field: bytes) -> bytes:
        block = bytearray(good[:512])
        block[at : at + len(field)] = field
        block[148:156] = b" " * 8
        block[148:156] = b"%06o\0 " % sum(block)
        return bytes(block) + good[512:]

    for content, message in (
        (good[: offset + 10], r"wide/image.png: found 10 of \d+ bytes, expected a whole archive"),
        (b"x" + good[1:], r"header at byte 0: found a wrong checksum, expected a tar header, not compressed"),
        (header(124, b"77777777777\0"), r"wide/image.png: found \d+ of 8589934591 bytes, expected a whole archive"),
        (header(124, b"\x80" + b"\xff" * 11), r"wide/image.png: found \d+ of \d{20,} bytes"),
        (header(124, b"\xff" * 12), r"header at byte 0: found size .*, expected a number of bytes"),
        (header(124, b"eleven     \0"), r"header at byte 0: found size b'eleven"),
        (header(156, b"S"), r"wide/image.png: found a sparse member, expected plain files"),
        (header(156, b"x"), None),  # a picture where a pax header is announced: ignored
    ):
        file.write_bytes(content)
        if message is None:
            assert len(list(tarballs.iter_tar_members(file))) == 10
        else:
            with pytest.raises(FormatError, match=message):
                list(tarballs.iter_tar_members(file))
    file.write_bytes(good)
    with pytest.raises(FormatError, match="found 9 bytes, expected at most 8 bytes"):
        tarballs.read_tar_member(file, 512, 9, limit=8)
    with pytest.raises(FormatError, match="found 0 bytes, expected 9 bytes"):
        tarballs.read_tar_member(file, len(good), 9)


def test_pax_sizes_and_long_names_are_bounded(tmp_path: Path) -> None:
    file = tmp_path / "a.tar"
    for key, value, message in (
        ("size", "99999999999999", "found .* of 99999999999999 bytes, expected a whole archive"),
        ("path", "x" * 1_100_000, "expected at most 1000000 bytes"),
    ):
        with tarfile.open(file, "w", format=tarfile.PAX_FORMAT) as archive:
            info = tarfile.TarInfo("a.txt")
            info.pax_headers = {key: value}
            archive.addfile(info)
        with pytest.raises(FormatError, match=message):
            list(tarballs.iter_tar_members(file))


# -------------------------------------------------------------------------------------------------------------- TIFF


@pytest.mark.parametrize("deflate", [False, True])
def test_our_tiff_is_one(deflate: bool) -> None:
    picture = np.random.default_rng(0).random((5, 7), dtype=np.float32)
    content = encode_float_tiff(picture, deflate=deflate)
    assert np.array_equal(tifffile.imread(io.BytesIO(content)), picture)
    assert np.array_equal(tiff.decode_tiff(content, Path("a.tiff"), (5, 7)), picture)
