"""``dhtorch inspect``: its report on written captures, its warnings, and that it accepts real ones."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console
from support import damage_harness as hostile
from support import writers
from support.box_scene import HW, pose, render
from support.focal_stacks import random_stack
from support.writers import focal as stack_writers

from dhtorch import data
from dhtorch.cli import inspect as capture
from dhtorch.cli import run
from dhtorch.data import FormatError
from dhtorch.data.recording import Recording
from dhtorch.data.survey import Survey, report_depths, survey_recording
from dhtorch.experiments.focal import formats
from dhtorch.experiments.focal.formats import survey_stacks
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

ROOT = os.environ.get("DHTORCH_DATA")
real = pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")


CAMERA = Camera(torch.tensor([[61.5, 60.25]]), torch.tensor([[33.5, 21.75]]))


def walk(n: int, hw: tuple[int, int] = HW) -> list[Frame]:
    """A calm walk through the box: 1 m/s, 20°/s."""
    xi = torch.tensor([[0.25, 0.7, -0.4, 0.3, 0.1, -0.2]]) + torch.arange(n)[:, None] * torch.tensor(
        [0.01, -0.004, 0.005, 0.02, -0.01, 0.025]
    )
    return [render(CAMERA, se3.exp(xi[i : i + 1].double()), hw, 100 + i / 30) for i in range(n)]


def with_conf(frames: list[Frame]) -> list[Frame]:
    conf = (torch.arange(HW[0] * HW[1]).view(1, *HW) % 4).clamp(max=2).to(torch.uint8)
    return [frame.replace(conf=conf) for frame in frames]


def only(path: Path) -> Survey:
    (found,) = capture.find_captures(path)
    (survey,) = capture.survey_capture(found)
    return survey


def facts(survey: Survey) -> dict[str, str]:
    return dict(survey.facts)


def check_sheet(file: Path) -> np.ndarray:
    """A picture with something in it."""
    picture = cv2.imread(str(file))
    assert picture is not None and picture.shape[0] > 80 and picture.shape[1] > 400
    assert len(np.unique(picture @ np.array([1, 1 << 8, 1 << 16]))) > 50
    return picture


# ------------------------------------------------------------------------------------------------------ written samples


def _driving(root: Path, n: int) -> None:
    eye = Pose(torch.eye(3).double().expand(n, 3, 3), torch.zeros(n, 3).double())
    writers.write_driving(root, {"FRONT": walk(n), "REAR": walk(n)}, eye)


def _arkitscenes(root: Path, n: int) -> None:
    frames = with_conf(walk(n))
    writers.write_arkitscenes(root, {"lowres_wide": frames, "lowres_depth": frames}, trajectory=frames)


def _mp4(root: Path, n: int) -> None:
    writers.write_record3d_mp4(root / "a.mp4", walk(n))


def _rh20t(root: Path, n: int) -> None:
    writers.write_rh20t(root, {"036422060909": walk(n, (36, 64))})


#: How to write n frames, the format that they are recognised as, and the number of recordings.
RECORDED: dict[str, tuple[Callable[[Path, int], object], str, int]] = {
    "tum": (lambda root, n: writers.write_tum(root, walk(n)), "tum", 1),
    "named": (lambda root, n: writers.write_named_frames(root, walk(n), fps=30), "frames_dir", 1),
    "counted": (lambda root, n: writers.write_counted_frames(root, walk(n)), "frames_dir", 1),
    "driving": (_driving, "driving", 2),
    "stray": (lambda root, n: writers.write_stray(root, with_conf(walk(n))), "stray", 1),
    "stray_depth_only": (lambda root, n: writers.write_stray(root, with_conf(walk(n)), video=False), "stray", 1),
    "r3d": (lambda root, n: writers.write_r3d(root / "a.r3d", with_conf(walk(n))), "record3d", 1),
    "record3d_exr": (lambda root, n: writers.write_record3d_exr(root, walk(n)), "record3d", 1),
    "record3d_mp4": (_mp4, "record3d", 1),
    "arkitscenes": (_arkitscenes, "arkitscenes", 1),
    "ca1m": (lambda root, n: writers.write_ca1m(root / "ca1m-val-42.tar", with_conf(walk(n)), walk(n)), "ca1m", 1),
    "rh20t": (_rh20t, "rh20t", 1),
    "lerobot": (lambda root, n: writers.write_lerobot(root, [walk(n), walk(n + 1)]), "lerobot", 2),
}
WRITTEN: dict[str, tuple[Callable[[Path], object], str, int]] = {
    **{name: (partial(write, n=3), format, count) for name, (write, format, count) in RECORDED.items()},
    "fod500": (lambda root: stack_writers.write_fod500(root, {0: random_stack(0), 1: random_stack(1)}), "fod500", 1),
    "ddff12": (lambda root: stack_writers.write_ddff12(root / "a.h5", {"val": [random_stack(0, 10)]}), "ddff12", 1),
    "images": (lambda root: stack_writers.write_image_folder(root / "focus_stack", random_stack(0, 5)), "images", 1),
}


#: How far down captures are laid: some make a folder of their own, or are named after a file.
BELOW = {n: ("", "one", "one/two")[k % 3] for k, n in enumerate(WRITTEN)} | {"ca1m": "", "rh20t": "one"}


#: Further layouts of formats of which one is among the others, and formats whose reader has tests of the same capture.
SLOW = (
    "named",
    "driving",
    "stray",
    "stray_depth_only",
    "record3d_exr",
    "record3d_mp4",
    "arkitscenes",
    "ca1m",
    "fod500",
    "counted",
)


@pytest.mark.parametrize(
    ("name", "below"), [pytest.param(*each, marks=[pytest.mark.slow] * (each[0] in SLOW)) for each in BELOW.items()]
)
def test_written_captures_are_found_and_shown(
    name: str, below: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write, format, count = WRITTEN[name]
    root = tmp_path / "given" / below
    root.mkdir(parents=True)
    write(root)
    assert capture.main([str(tmp_path / "given"), "--out", str(tmp_path / "out"), "--max-frames", "3"]) == 0
    said = capsys.readouterr().out
    sheets = sorted((tmp_path / "out").glob("*.png"))
    assert len(sheets) == count and said.count("wrote ") == count and f" {format} (" in said
    check_sheet(sheets[0])
    if below:
        assert all(sheet.name.startswith("given_one") for sheet in sheets)


def test_facts_of_a_recording(tmp_path: Path) -> None:
    frames = walk(4)
    frames[1] = frames[1].replace(depth=frames[1].depth * (torch.arange(HW[1]) >= HW[1] // 2))
    writers.write_named_frames(tmp_path, frames, fps=30)
    survey = survey_recording(data.open(tmp_path))
    capture.add_check(survey, data.open(tmp_path))
    said = facts(survey)
    assert said["unit"] == "depth unit assumed: 1/1000 m (data.depth_unit= sets it)"
    assert said["frames"] == "4" and said["rate"] == "30 Hz measured, nominal 30 Hz" and said["duration"] == "0.100 s"
    assert said["pictures"] == "64x48, colour, 8 bits" and said["depth"] == "64x48"
    assert said["holes"] == "0.0 to 50.0 % of the depth map"
    assert said["intrinsics"].startswith("f 61.50 60.25, c 33.50 21.75 px, field of view 55° x 43°, no distortion")
    values = torch.cat([f.depth[f.depth > 0] for f in frames])
    median = float(said["depth percentiles"].split("50 %: ")[1].split(",")[0])
    assert median == pytest.approx(float(values.quantile(0.5)), abs=2e-3)
    steps = torch.cat([f.T_world_from_cam.t for f in frames]).diff(dim=0).norm(dim=-1)
    assert said["path"].startswith(f"{float(steps.sum()):.3f} m long")
    assert said["speed"].endswith(f"at most {30 * float(steps.max()):.3f} m/s")
    assert float(said["depth and poses"].split()[2]) < 3
    assert survey.warnings == []
    assert [tile.title for tile in survey.tiles] == ["0", "1", "2", "3"]


def test_facts_of_confidence_and_of_frames_left_out(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, with_conf(walk(4)), video=False)
    (tmp_path / "depth" / "000002.png").unlink()
    survey = only(tmp_path)
    said = facts(survey)
    assert said["confidence"] == "low 25.0 %, medium 25.0 %, high 50.0 %"
    assert said["frames"] == "3, 1 number missing in between" and said["pictures"] == "none"
    words = "\n".join(survey.warnings)
    assert "depth only: there are no pictures" in words and "rgb.mp4: file: found no such file" in words
    assert "gaps in time" not in words


def test_facts_of_stacks(tmp_path: Path) -> None:
    stack_writers.write_fod500(tmp_path, {3: random_stack(3), 4: random_stack(4)})
    survey = survey_stacks(formats.open_stacks(tmp_path))
    said = facts(survey)
    assert said["focal stacks"] == "2, of 5 pictures each" and said["in focus at"] == "0.1, 0.15, 0.3, 0.7, 1.5 m"
    assert said["lens"] == "f = 2.9 mm, N = 1" and said["holes"].startswith("0.5 %") and survey.warnings == []
    same = random_stack(0, 1).images.expand(1, 4, 3, 12, 16)
    stack_writers.write_image_folder(tmp_path / "b", random_stack(0).replace(images=same))
    survey = survey_stacks(formats.open_stacks(tmp_path / "b"))
    assert survey.warnings == [
        "no focus distances: only the order of the pictures is available",
        "all pictures that were read are the same picture",
    ]


# ------------------------------------------------------------------------------------------------------------- warnings


def recording(frames: list[Frame], **options: object) -> Recording:
    poses = Pose(torch.cat([f.T_world_from_cam.R for f in frames]), torch.cat([f.T_world_from_cam.t for f in frames]))
    fields = {"times": torch.arange(len(frames)).double() / 30, "poses": poses, "number": torch.arange(len(frames))}
    return Recording("written", "test", frames.__getitem__, **(fields | options))


def warned(frames: list[Frame], **options: object) -> list[str]:
    written = recording(frames, **options)
    survey = survey_recording(written)
    capture.add_check(survey, written)
    return survey.warnings


def test_sound_recordings_raise_no_warning() -> None:
    assert warned(walk(6)) == []


@pytest.mark.slow
def test_poses_that_are_constant_or_turn_only() -> None:
    frames = walk(4)
    still = Pose(pose(0).R.expand(4, 3, 3), pose(0).t.expand(4, 3))
    assert "poses are constant" in warned(frames, poses=still)
    turning = Pose(torch.cat([f.T_world_from_cam.R for f in frames]), pose(0).t.expand(4, 3))
    assert "the camera turns but does not move: there is no baseline" in warned(frames, poses=turning)


@pytest.mark.slow
def test_poses_that_jump_or_contradict_the_depth() -> None:
    frames = walk(6)
    good = recording(frames).poses
    jump = good.t.clone()
    jump[3:] += 2.0
    assert any(
        w.startswith("the camera jumps: ") and w.endswith("at frame 3")
        for w in warned(frames, poses=Pose(good.R, jump))
    )
    flipped = good.R @ torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    readings = {
        "OpenGL camera axes": Pose(flipped, good.t),
        "world-to-camera poses": se3.invert(good),
        "translations are 10 times what the depth has": Pose(good.R, good.t * 10),
    }
    for reading, poses in readings.items():
        (contradiction,) = [w for w in warned(frames, poses=poses) if "contradict" in w]
        assert contradiction.startswith("poses and depth contradict each other (") and reading in contradiction
    assert not any("contradict" in w for w in warned(frames))


@pytest.mark.slow
def test_times_that_stand_or_gap() -> None:
    frames = walk(6)
    gap = torch.tensor([0, 1, 2, 9, 10, 11], dtype=torch.float64) / 30
    assert "1 gap in time, the longest 0.233 s" in warned(frames, times=gap)
    back = torch.tensor([0, 1, 1, 2, 3, 4], dtype=torch.float64) / 30
    assert "time stamps do not increase at 1 place" in warned(frames, times=back)
    assert "no time stamps" in warned(frames, times=None)


@pytest.mark.parametrize(("spread", "is_flat"), [(0.0009, True), (0.0011, False)])
@pytest.mark.parametrize("many_holes", [False, True])
def test_limits_of_depth_maps(spread: float, is_flat: bool, many_holes: bool) -> None:
    depth = 2 + spread * torch.linspace(0, 1, 100).reshape(10, 10)
    depth.flatten()[1 : 52 if many_holes else 51] = 0
    survey = Survey("depth", "none")
    report_depths([depth], survey)
    assert dict(survey.facts)["holes"] == ("51.0" if many_holes else "50.0") + " % of the depth map"
    holes, flat = ["most of the depth map is holes (51 %)"], ["depth is the same everywhere"]
    assert survey.warnings == holes * many_holes + flat * is_flat


@pytest.mark.slow
def test_depth_that_cannot_be() -> None:
    frames = walk(3)

    def with_depth(change: Callable[[torch.Tensor], torch.Tensor]) -> list[str]:
        return warned([f.replace(depth=change(f.depth)) for f in frames])

    assert "no depth at all in the frames that were read" in with_depth(torch.zeros_like)
    assert any("m is beyond the reach of any depth sensor" in w for w in with_depth(lambda d: d * 1000))
    assert "depth is the same everywhere" in with_depth(torch.ones_like)
    holes = with_depth(lambda d: d * (torch.arange(HW[1]) < 10))
    assert any(w.startswith("most of the depth map is holes (84 %)") for w in holes)
    one = [frames[0].replace(depth=torch.zeros(1, *HW)), *frames[1:]]
    assert "1 of 3 depth maps that were read are empty" in warned(one)


@pytest.mark.slow
def test_pictures_and_cameras_that_cannot_be() -> None:
    frames = walk(3)
    assert "all frames that were read are the same picture" in warned(
        [f.replace(image=frames[0].image) for f in frames]
    )
    assert "all pictures are black" in warned([f.replace(image=f.image // 255) for f in frames])
    wide = CAMERA.replace(f=torch.tensor([[61.5, 40.0]]))
    assert any("pixels are not square" in w for w in warned([f.replace(camera=wide) for f in frames]))
    aside = CAMERA.replace(c=torch.tensor([[5.0, 21.0]]))
    words = warned([f.replace(camera=aside) for f in frames])
    assert "the principal point is far from the middle of the picture" in words
    zoom = [f.replace(camera=CAMERA.replace(f=CAMERA.f * (1 + 0.01 * i))) for i, f in enumerate(frames)]
    assert facts(survey_recording(recording(zoom)))["focal length"].startswith("61.50 to 62.73 px: it changes")


# ----------------------------------------------------------------------------------------------- nothing real is refused


@pytest.mark.parametrize("name", RECORDED)
def test_one_frame_is_enough(name: str, tmp_path: Path) -> None:
    write, format, count = RECORDED[name]
    write(tmp_path, 1)
    (found,) = capture.find_captures(tmp_path)
    shown = list(capture.survey_capture(found))
    assert found.format == format and len(shown) == count
    assert facts(shown[0])["frames"] == "1" and len(shown[0].tiles) == 1
    tile = shown[0].tiles[0]
    assert float(tile.depth.max()) > 0 and (name == "stray_depth_only" or tile.image.shape[0] == 3)
    if name in ("tum", "stray_depth_only"):
        check_sheet(capture.write_contact_sheet(shown[0], tmp_path / "out"))


#: The command on a recording of one and of several cameras; on all other formats with the slow tests.
COMMANDED = [
    name if name in ("tum", "driving") else pytest.param(name, marks=pytest.mark.slow)
    for name in sorted({*RECORDED} - {"stray_depth_only"})
]


@pytest.mark.parametrize("name", COMMANDED)
def test_the_command_takes_what_inspect_finds(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Focal stacks, which have no pairs: test_focal_stacks."""
    RECORDED[name][0](tmp_path, 3)
    (found,) = capture.find_captures(tmp_path)
    monkeypatch.chdir(tmp_path)
    settings = ["data=auto", f"data.root={found.path}", "pairs.gap=1", "holdout.cutoff=1.5", "method.n=64"]
    assert run.main([*settings, "figures=false", "hydra.run.dir=out"]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert len(result["data"]["scenes"]) == RECORDED[name][2] and result["data"]["n_pairs"] >= RECORDED[name][2]


def test_a_damaged_frame_is_a_warning(tmp_path: Path) -> None:
    writers.write_named_frames(tmp_path, walk(3))
    (tmp_path / "frame-000001.depth.png").write_bytes(b"\x89PNG")
    survey = only(tmp_path)
    assert [tile.title for tile in survey.tiles] == ["0", "2"]
    assert any(w.startswith("frame 1 cannot be read: ") and "frame-000001.depth.png" in w for w in survey.warnings)


def test_a_capture_that_its_reader_refuses_is_shown_as_pictures(tmp_path: Path) -> None:
    writers.write_tum(tmp_path, walk(3))
    (tmp_path / "meta.json").write_text('{"K": 3}')  # no calibration: the reader must refuse
    survey = only(tmp_path)
    assert survey.format == "loose pictures" and facts(survey)["pictures"] == "3, 64x48"
    assert survey.warnings[0].startswith("the tum reader rejects it: ") and "meta.json: K: found" in survey.warnings[0]
    assert facts(survey)["depth maps"] == "3, 64x48"
    check_sheet(capture.write_contact_sheet(survey, tmp_path / "out"))


def test_loose_pictures_with_a_broken_one(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(writers.parts.encode_unfiltered_png(np.full((10, 12, 3), 90, np.uint8)))
    (tmp_path / "b.png").write_bytes(
        writers.parts.encode_unfiltered_png(np.arange(120, dtype=np.uint16).reshape(10, 12) + 500)
    )
    whole = writers.parts.encode_unfiltered_png(np.zeros((10, 12, 3), np.uint8))
    (tmp_path / "c.png").write_bytes(whole[:-20])
    survey = only(tmp_path)
    assert facts(survey)["pictures"] == "1, 12x10" and facts(survey)["depth range"] == "0.500 to 0.619 m"
    assert any("c.png: data: found a truncated or damaged png" in w for w in survey.warnings)


def test_many_recordings_are_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _driving(tmp_path, 3)
    monkeypatch.setattr(capture, "_MAX_RECORDINGS", 1)
    survey = only(tmp_path)
    assert "2 recordings in this capture, the first 1 shown" in survey.warnings


#: Names of images of one size that are no focal stack.
PHOTOS = {
    "phone": [f"IMG_{4000 + k}.JPG" for k in range(3)],
    "screenshots": [f"Screenshot 2026-01-0{k + 1} at 10.00.00.png" for k in range(3)],
    "burst": [f"IMG_20260101_100000_BURST{k:03d}.jpg" for k in range(4)],
    "one": ["IMG_0001.jpg"],
    "simulator": [f"_out/{k:08d}.png" for k in range(4)],
    "film": [f"DCIM/100APPLE/frame_{k}.png" for k in range(4)],
}


def write_photos(folder: Path, names: list[str]) -> None:
    noise = np.random.default_rng(0)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(noise.integers(0, 256, (24, 32, 3), np.uint8)).save(folder / name)
        if name == "broken.png":
            (folder / name).write_bytes(b"no image")


@pytest.mark.parametrize("name", PHOTOS)
def test_images_of_one_size_are_photos_without_depth(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_photos(tmp_path / name, PHOTOS[name])
    (found,) = capture.find_captures(tmp_path / name)
    assert found.kind == "pictures"
    count = f"{len(PHOTOS[name])} picture{'s' * (len(PHOTOS[name]) > 1)}"
    said = f"{name}: {count} without depth; sensor depth of near surfaces is required for metric scale (from a phone: "
    for words, code in (([str(tmp_path / name)], 2), (["inspect", str(tmp_path / name), "--out", str(tmp_path)], 0)):
        assert run.main(words) == code
        printed = "".join(capsys.readouterr())
        assert said in printed and "focal stack" not in printed


def test_a_focal_stack_is_named_as_one(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for name in ("focus_stack_a/9", "Focal-Sweep", "zstack/x/y", "x/focus-bracket"):
        write_photos(tmp_path / "1" / name, ["1.png", "2.png"])
        (found,) = capture.find_captures(tmp_path / "1" / name)
        assert (found.kind, found.format) == ("stacks", "images") and ", named " in found.evidence
    write_photos(tmp_path / "2", ["focus_stack_1.png", "focus_stack_2.png"])
    assert capture.find_captures(tmp_path / "2")[0].kind == "stacks"
    assert run.main([str(tmp_path / "2")]) == 2 and "focal stacks (images) of a still camera" in capsys.readouterr().err
    for name in ("no_focus_stack", "focus", "stack", "focus_stack/a/b/c"):
        write_photos(tmp_path / "3" / name, ["1.png", "2.png"])
        assert capture.find_captures(tmp_path / "3" / name)[0].kind == "pictures", name
        assert formats.open_stacks(tmp_path / "3" / name).format == "images", "where the caller states it"


def test_recordings_below_come_before_loose_images(tmp_path: Path) -> None:
    writers.write_tum(tmp_path / "a" / "scan", walk(2))
    write_photos(tmp_path, ["screenshot.png", "a/1.jpg", "a/2.jpg"])
    assert [found.format for found in capture.find_captures(tmp_path)] == ["tum"]


@pytest.mark.parametrize(
    ("images", "others", "said"),
    [
        (
            ["1.jpg", "2.jpg"],
            ["scan.png"],
            r"2 pictures and 1 depth map of no known format (2 .jpg, scan.png); a layout",
        ),
        (
            [],
            ["depth/1.png", "depth/2.png"],
            "2 depth maps of no known format (depth/ (2 .png)); a layout of docs/data",
        ),
        (["1.jpg", "2.jpg"], ["1.hdf5"], "2 pictures of no known format (1.hdf5, 2 .jpg); a layout of docs/data.md is"),
        (["a/1.jpg", "b/2.jpg"], [], "2 pictures without depth; sensor depth"),
        (["broken.png"], [], "no readable image (broken.png)"),
    ],
)
def test_loose_images_are_described_by_all_files(
    images: list[str], others: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    write_photos(tmp_path / "x", images)
    for name in others:
        (tmp_path / "x" / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".png"):
            Image.fromarray(np.full((24, 32), 900, np.uint16)).save(tmp_path / "x" / name)
        else:
            (tmp_path / "x" / name).write_bytes(b"1 0 0")
    assert run.main([str(tmp_path / "x")]) == 2
    assert f"x: {said}" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "format"), [("frame_000001", "frames_dir"), ("1305031102.175304", "tum")])
def test_time_stamps_are_numbers_with_a_fraction(name: str, format: str, tmp_path: Path) -> None:
    write_photos(tmp_path, [f"rgb/{name}.png"])
    (tmp_path / "depth").mkdir()
    Image.fromarray(np.full((24, 32), 900, np.uint16)).save(tmp_path / "depth" / f"{name}.png")
    assert data.recognise(tmp_path)[0] == format
    (tmp_path / "rgb" / f"{name}.png").unlink()
    with pytest.raises(FormatError, match="found depth, rgb, expected"):
        data.recognise(tmp_path)


def test_several_captures_in_one_folder(tmp_path: Path) -> None:
    for name in ("a", "b"):
        writers.write_named_frames(tmp_path / name, walk(2))
    assert [found.path.name for found in capture.find_captures(tmp_path)] == ["a", "b"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (None, "an empty folder"),
        ("room.zip", "room.zip: an archive, unpack it first"),
        ("clip.mp4", "clip.mp4: a video without depth"),
        ("notes.txt", "no capture here or up to two folders below"),
    ],
)
def test_what_lies_there_instead_of_a_capture_is_said(tmp_path: Path, name: str | None, said: str) -> None:
    if name is not None:
        (tmp_path / name).write_bytes(b"nothing of use")
        alone = said.partition(": ")[2] or "a .txt file, which no reader supports"
        with pytest.raises(FormatError, match=f"{name}: content: found {alone}"):
            capture.find_captures(tmp_path / name)
    with pytest.raises(FormatError, match=f"content: found {said}"):
        capture.find_captures(tmp_path)


def test_nothing_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "a" / "b" / "c").mkdir(parents=True)
    writers.write_named_frames(tmp_path / "a" / "b" / "c", walk(1))
    assert run.main(["inspect", str(tmp_path)]) != 0
    said = " ".join(capsys.readouterr().err.split())
    assert "content: found no capture here or up to two folders below: a/b/c/ (" in said and "from a phone: " in said
    assert run.main(["inspect", str(tmp_path / "nowhere")]) != 0
    with pytest.raises(FormatError, match="format: found frame_dir, expected auto, record3d"):
        capture.main([str(tmp_path), "--format", "frame_dir"])
    with pytest.raises(ValueError, match="--max-frames: found 0, expected at least 1"):
        capture.main([str(tmp_path), "--max-frames", "0"])


def test_the_remedies_are_typed_at_the_terminal(tmp_path: Path) -> None:
    """In a process of its own: a capture without intrinsics, with a unit and a delay of its depth."""
    writers.write_counted_frames(tmp_path / "room", walk(3))
    (tmp_path / "room" / "K.txt").unlink()
    words = ["inspect", "room", "--fov", "63", "--depth-unit=mm", "data.depth_lag=1", "max_frames=2"]
    done = subprocess.run(
        [sys.executable, "-m", "dhtorch", *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    for told in ("field of view 63°", "depth unit: 1/1000 m (option depth_unit)", "depth is that of 1 frame later"):
        assert told in text
    assert "no intrinsics" not in text and "wrote outputs/" in text


def test_links_are_followed_and_options_without_a_reader_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    writers.write_named_frames(tmp_path / "elsewhere", walk(2))
    (tmp_path / "room").mkdir()
    for each in (tmp_path / "elsewhere").iterdir():
        (tmp_path / "room" / each.name).symlink_to(each)
    words = ["inspect", str(tmp_path / "room"), "--out", str(tmp_path / "out")]
    assert run.main([*words, "follow_links=true"]) == 0
    assert "frames_dir (" in capsys.readouterr().out
    assert run.main([*words, "data.follow_links=maybe"]) == 2
    assert "data.follow_links: found 'maybe', expected true or false" in capsys.readouterr().err
    (tmp_path / "loose").mkdir()
    cv2.imwrite(str(tmp_path / "loose" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    assert run.main(["inspect", str(tmp_path / "loose"), *words[2:], "--fov", "63"]) == 0
    assert "not a recording: data.fov not used" in capsys.readouterr().out


def test_a_reader_that_rejects_an_option_stops_the_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    writers.write_counted_frames(tmp_path / "room", walk(2))
    words = ["inspect", str(tmp_path / "room"), "--out", str(tmp_path / "out")]
    assert run.main([*words, "--K", "1,2,3"]) == 2
    assert "option K: found [1.0, 2.0, 3.0], expected 4 finite numbers" in capsys.readouterr().err


def test_command_writes_to_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    writers.write_named_frames(tmp_path / "room [1]", walk(2))
    monkeypatch.chdir(tmp_path)
    assert run.main(["inspect", "room [1]", "--format", "frames_dir"]) == 0
    (sheet,) = (tmp_path / "outputs").glob("*-*-*/*-*-*/*.png")
    assert sheet.name == "room_1_.png" and "room [1]" in capsys.readouterr().out  # brackets are no markup


def test_warnings_are_printed(tmp_path: Path) -> None:
    out = io.StringIO()
    survey = survey_recording(replace(recording(walk(2)), report=("frame [7]: left out",)))
    capture.print_survey(
        capture.FoundCapture(tmp_path, "recording", "test", "format= given"), survey, Console(file=out, width=200)
    )
    assert "warning" in out.getvalue() and "frame [7]: left out" in out.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["named", "stray_depth_only", "images"])
def test_damaged_captures_are_inspected_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    def look(path: Path) -> None:
        for found in capture.find_captures(path):
            for survey in capture.survey_capture(found, 3):
                assert survey.facts

    hostile.attack(WRITTEN[name][0], look, tmp_path, mutants=15)


# --------------------------------------------------------------------------------------------------------- real pieces

REAL = {
    "7s_redkitchen_000": "frames_dir",
    "7s_redkitchen_600": "frames_dir",
    "arkit_single": "loose pictures",
    "dgp_drive6cam": "driving",
    "eth3d_terrace": "rectified",
    "focus_stack_heatsink": "images",
    "focus_stack_room": "images",
    "holo_a": "frames_dir",
    "middlebury_motorcycle": "rectified",
    "r3d_door": "record3d",
    "stray_room": "stray",
    "tum_fr1_desk9": "tum",
    "tum_fr1_rpy_a": "tum",
}


@pytest.mark.slow
@pytest.mark.data
@real
@pytest.mark.parametrize("name", REAL)
def test_real_pieces_are_inspected(name: str, tmp_path: Path) -> None:
    (found,) = capture.find_captures(Path(ROOT) / name)
    assert found.format == REAL[name]
    surveys = list(capture.survey_capture(found, 3))
    assert surveys and all(survey.tiles for survey in surveys)
    if name in ("arkit_single", "holo_a", "stray_room"):
        check_sheet(capture.write_contact_sheet(surveys[0], tmp_path))
    for survey in surveys:
        assert not any("contradict" in w or "constant" in w or "jumps" in w for w in survey.warnings)
        if "depth and poses" in facts(survey):  # measured 0.3 to 1.3 %
            assert float(facts(survey)["depth and poses"].split()[2]) < 2
