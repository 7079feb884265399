"""``dhtorch inspect``: its report on written captures, its warnings, and that it accepts real ones."""

import io
import json
import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

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
from torch import Tensor

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


def check_sheet(file: Path) -> None:
    """A picture with something in it."""
    picture = cv2.imread(str(file))
    assert picture is not None and picture.shape[0] > 80 and picture.shape[1] > 400
    assert len(np.unique(picture @ np.array([1, 1 << 8, 1 << 16]))) > 50


# ------------------------------------------------------------------------------------------------------ written samples


EYE = Pose(torch.eye(3).double().expand(3, 3, 3), torch.zeros(3, 3).double())


def _driving(root: Path, n: int) -> None:
    writers.write_driving(root, {"FRONT": walk(n), "REAR": walk(n)}, EYE[:n])


def _arkitscenes(root: Path, n: int) -> None:
    frames = with_conf(walk(n))
    writers.write_arkitscenes(root, {"lowres_wide": frames, "lowres_depth": frames}, trajectory=frames)


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
    "record3d_mp4": (lambda root, n: writers.write_record3d_mp4(root / "a.mp4", walk(n)), "record3d", 1),
    "arkitscenes": (_arkitscenes, "arkitscenes", 1),
    "ca1m": (lambda root, n: writers.write_ca1m(root / "ca1m-val-42.tar", with_conf(walk(n)), walk(n)), "ca1m", 1),
    "rh20t": (lambda root, n: writers.write_rh20t(root, {"036422060909": walk(n, (36, 64))}), "rh20t", 1),
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
    ("name", "n"),
    [pytest.param(name, 3, marks=[pytest.mark.slow] * (name in SLOW)) for name in WRITTEN]
    + [(name, 1) for name in RECORDED],
)
def test_written_captures_are_found_and_shown(name: str, n: int, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write, format, count = RECORDED[name] if n == 1 else WRITTEN[name]
    root = tmp_path / "given" / BELOW[name]
    root.mkdir(parents=True)
    write(root, n) if n == 1 else write(root)
    assert run.main(["inspect", str(tmp_path / "given"), "--out", str(tmp_path / "out"), "--max-frames", "3"]) == 0
    said = capsys.readouterr().out
    sheets = sorted((tmp_path / "out").glob("*.png"))
    assert len(sheets) == count and said.count("wrote ") == count and f" {format} (" in said
    assert n == 3 or re.search(r"^frames +1\b", said, re.M), said
    check_sheet(sheets[0])
    assert all(sheet.name.startswith("given_one") for sheet in sheets if BELOW[name])


def test_facts_of_a_recording(tmp_path: Path) -> None:
    frames = walk(4)
    frames[1] = frames[1].replace(depth=frames[1].depth * (torch.arange(HW[1]) >= HW[1] // 2))
    writers.write_named_frames(tmp_path, frames, fps=30)
    survey = only(tmp_path)
    said = facts(survey)
    steps = torch.cat([f.T_world_from_cam.t for f in frames]).diff(dim=0).norm(dim=-1)
    for name, text in {
        "unit": "depth unit assumed: 1/1000 m (data.depth_unit= sets it)",
        "frames": "4",
        "rate": "30 Hz measured, nominal 30 Hz",
        "duration": "0.100 s",
        "pictures": "64x48, colour, 8 bits",
        "depth": "64x48",
        "holes": "0.0 to 50.0 % of the depth map",
        "intrinsics": "f 61.50 60.25, c 33.50 21.75 px, field of view 55° x 43°, no distortion",
        "path": f"{float(steps.sum()):.3f} m long",
        "speed": f"at most {30 * float(steps.max()):.3f} m/s",
    }.items():
        assert text in said[name], name
    values = torch.cat([f.depth[f.depth > 0] for f in frames])
    median = float(said["depth percentiles"].split("50 %: ")[1].split(",")[0])
    assert median == pytest.approx(float(values.quantile(0.5)), abs=2e-3)
    assert float(said["depth and poses"].split()[2]) < 3 and survey.warnings == []
    assert [tile.title for tile in survey.tiles] == ["0", "1", "2", "3"]


def test_facts_of_confidence_of_frames_left_out_and_of_a_zoom(tmp_path: Path) -> None:
    writers.write_stray(tmp_path, with_conf(walk(4)), video=False)
    (tmp_path / "depth" / "000002.png").unlink()
    survey = only(tmp_path)
    expected = {"confidence": "low 25.0 %, medium 25.0 %, high 50.0 %", "pictures": "none"}
    expected |= {"frames": "3, 1 number missing in between"}
    assert expected.items() <= facts(survey).items()
    words = "\n".join(survey.warnings)
    assert "depth only: there are no pictures" in words and "rgb.mp4: file: found no such file" in words
    assert "gaps in time" not in words
    zoom = [f.replace(camera=CAMERA.replace(f=CAMERA.f * (1 + 0.01 * i))) for i, f in enumerate(FRAMES[:3])]
    assert facts(survey_recording(recording(zoom)))["focal length"].startswith("61.50 to 62.73 px: it changes")


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


def survey_of(made: Recording, monkeypatch: pytest.MonkeyPatch) -> Survey:
    """Survey of a recording as the command makes it."""
    monkeypatch.setattr(capture, "_open_recordings", lambda *_: [made])
    (survey,) = capture.survey_capture(capture.FoundCapture(Path("/nowhere"), "recording", "tum", ""))
    return survey


FRAMES = walk(6)
GOOD = recording(FRAMES).poses
JUMP = GOOD.t + torch.tensor([0.0, 0, 0, 2, 2, 2])[:, None]
OPENGL = Pose(GOOD.R @ torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)), GOOD.t)
CONTRADICT = "poses and depth contradict each other ("


def each(n: int = 3, **change: Callable[[Any], Any]) -> list[Frame]:
    """The first n frames with changed fields."""
    return [frame.replace(**{k: make(getattr(frame, k)) for k, make in change.items()}) for frame in FRAMES[:n]]


def seconds(*thirtieths: int) -> Tensor:
    return torch.tensor(thirtieths, dtype=torch.float64) / 30


#: Frames, other fields of their recording → parts of its warnings, joined by ``|``; none where it is empty.
WARNED: list[tuple[list[Frame], dict[str, object], str]] = [
    (FRAMES, {}, ""),
    (each(4), {"poses": Pose(pose(0).R.expand(4, 3, 3), pose(0).t.expand(4, 3))}, "poses are constant"),
    (each(4), {"poses": Pose(GOOD.R[:4], pose(0).t.expand(4, 3))}, "the camera turns but does not move: there is no baseline"),
    (FRAMES, {"poses": Pose(GOOD.R, JUMP)}, "the camera jumps: |at frame 3"),
    (FRAMES, {"poses": OPENGL}, f"{CONTRADICT}|OpenGL camera axes"),
    (FRAMES, {"poses": se3.invert(GOOD)}, f"{CONTRADICT}|world-to-camera poses"),
    (FRAMES, {"poses": Pose(GOOD.R, GOOD.t * 10)}, f"{CONTRADICT}|translations are 10 times what the depth has"),
    (FRAMES, {"times": seconds(0, 1, 2, 9, 10, 11)}, "1 gap in time, the longest 0.233 s"),
    (FRAMES, {"times": seconds(0, 1, 1, 2, 3, 4)}, "time stamps do not increase at 1 place"),
    (FRAMES, {"times": None}, "no time stamps"),
    (each(depth=torch.zeros_like), {}, "no depth at all in the frames that were read"),
    (each(depth=lambda d: d * 1000), {}, "m is beyond the reach of any depth sensor"),
    (each(depth=torch.ones_like), {}, "depth is the same everywhere"),
    (each(depth=lambda d: d * (torch.arange(HW[1]) < 10)), {}, "most of the depth map is holes (84 %)"),
    ([*each(1, depth=torch.zeros_like), *FRAMES[1:3]], {}, "1 of 3 depth maps that were read are empty"),
    (each(image=lambda _: FRAMES[0].image), {}, "all frames that were read are the same picture"),
    (each(image=lambda x: x // 255), {}, "all pictures are black"),
    (each(camera=lambda c: c.replace(f=torch.tensor([[61.5, 40.0]]))), {}, "pixels are not square"),
    (each(camera=lambda c: c.replace(c=torch.tensor([[5.0, 21.0]]))), {}, "the principal point is far from the middle of the picture"),
    (walk(2), {"report": ("frame [7]: left out",)}, "frame [7]: left out"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("frames", "fields", "words"),
    [pytest.param(*row, marks=[pytest.mark.slow] * (1 < k < len(WARNED) - 1)) for k, row in enumerate(WARNED)],
)
def test_what_cannot_be_is_a_warning(
    frames: list[Frame], fields: dict[str, object], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = survey_of(recording(frames, **fields), monkeypatch)
    whole = "\n".join(survey.warnings)
    assert all(part in whole for part in words.split("|"))
    assert words or not survey.warnings
    out = io.StringIO()
    capture.print_survey(capture.FoundCapture(tmp_path, "recording", "test", ""), survey, Console(file=out, width=300))
    assert ("warning" in out.getvalue()) == bool(words) and all(part in out.getvalue() for part in words.split("|"))


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


# ----------------------------------------------------------------------------------------------- nothing real is refused


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
    assert "2 recordings in this capture, the first 1 shown" in only(tmp_path).warnings


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


@pytest.mark.parametrize("name", PHOTOS)
def test_images_of_one_size_are_photos_without_depth(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_photos(tmp_path / name, PHOTOS[name])
    (found,) = capture.find_captures(tmp_path / name)
    count = f"{len(PHOTOS[name])} picture{'s' * (len(PHOTOS[name]) > 1)}"
    assert found.kind == "pictures" and run.main([str(tmp_path / name)]) == 2
    said = f"{name}: {count} without depth; sensor depth of near surfaces is required for metric scale (from a phone: "
    printed = capsys.readouterr().err
    assert said in printed and "focal stack" not in printed


def test_a_focal_stack_is_named_as_one(tmp_path: Path) -> None:
    for name in ("focus_stack_a/9", "Focal-Sweep", "zstack/x/y", "x/focus-bracket"):
        write_photos(tmp_path / "1" / name, ["1.png", "2.png"])
        (found,) = capture.find_captures(tmp_path / "1" / name)
        assert (found.kind, found.format) == ("stacks", "images") and ", named " in found.evidence
    for name in ("no_focus_stack", "focus", "stack", "focus_stack/a/b/c"):
        write_photos(tmp_path / "3" / name, ["1.png", "2.png"])
        assert capture.find_captures(tmp_path / "3" / name)[0].kind == "pictures", name
        assert formats.open_stacks(tmp_path / "3" / name).format == "images", "where the caller states it"


@pytest.mark.parametrize(("name", "format"), [("frame_000001", "frames_dir"), ("1305031102.175304", "tum")])
def test_time_stamps_are_numbers_with_a_fraction(name: str, format: str, tmp_path: Path) -> None:
    write_photos(tmp_path, [f"rgb/{name}.png"])
    (tmp_path / "depth").mkdir()
    Image.fromarray(np.full((24, 32), 900, np.uint16)).save(tmp_path / "depth" / f"{name}.png")
    assert data.recognise(tmp_path)[0] == format
    (tmp_path / "rgb" / f"{name}.png").unlink()
    with pytest.raises(FormatError, match="found depth, rgb, expected"):
        data.recognise(tmp_path)


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
