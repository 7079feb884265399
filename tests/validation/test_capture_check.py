"""Check of a capture: each planted fault has a finding of its kind whose option undoes it; sound captures have none."""

import math
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from support.cluttered_walk import N, walk
from support.stated_poses import poses_of, state_poses

from dhtorch import data
from dhtorch.data.corrections import Corrections
from dhtorch.data.io.decode import FormatError
from dhtorch.data.pose_convention import parse_pose_convention
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.camera import Camera
from dhtorch.records import Frame, Pose
from dhtorch.validation import capture_check, picture_field
from dhtorch.validation.capture_check import Finding, check_capture
from dhtorch.validation.faults import KNOWN_FAULTS
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS
from dhtorch.validation.picture_field import PictureField

ROOT = Path(os.environ.get("DHTORCH_DATA", "nowhere"))
needs_data = pytest.mark.skipif(not ROOT.is_dir(), reason="no DHTORCH_DATA")

ASSUMED = "depth unit assumed: 1/1000 m (data.depth_unit= sets it)"


@pytest.fixture(scope="module")
def frames():
    return list(walk())


@pytest.fixture(scope="module")
def true(frames):
    return poses_of(frames)


def recording(frames, poses=None, **fields):
    fields = {"report": ("a remark",), "depth_unit": DepthUnit(0.001), **fields}
    return Recording("walk", "made", frames.__getitem__, torch.arange(len(frames)), poses=poses, **fields)


def undone(check, spoilt):
    """The recording with the option of the last finding."""
    name, _, value = check.findings[-1].remedy.removeprefix("data.").partition("=")
    return Corrections.from_options({name: int(value) if name == "depth_lag" else value}).apply(spoilt)


def test_a_sound_capture_has_no_finding(frames, true):
    check = check_capture(recording(frames, true))
    assert check.findings == () and not check.poses_refuted and check.recording.poses is true
    assert check.assumed_unit == ASSUMED and check.lines == [ASSUMED, "a remark"]
    assert check.reported.poses is true and check.reported.report == (ASSUMED, "a remark")
    assert check.poses.surfaces.stated < 0.01
    for unit in (DepthUnit(0.001, "camera.json: scale"), None):  # a stated one is not announced
        stated = check_capture(recording(frames[:2], depth_unit=unit, report=()))
        assert stated.lines == [] and stated.poses is None and stated.assumed_unit == ""


SLOW = pytest.mark.slow
NOISE = torch.Generator().manual_seed(0)
SCALE = "which one, depth and poses alone do not show"


def late(lag, has_poses):
    """Frames whose depth comes ``lag`` frames late, and their positions."""

    def plant(frames, true):
        inside = [k for k in range(N) if 0 <= k - lag < N]
        shown = [frames[k].replace(depth=frames[k - lag].depth) for k in inside]
        return recording(shown, true[torch.tensor(inside)] if has_poses else None)

    return plant


def changed(change, has_poses=True):
    return lambda frames, true: recording([change(frame) for frame in frames], true if has_poses else None)


def with_camera(f, c, by=lambda x: x):
    return lambda frame: frame.replace(
        camera=frame.camera.replace(f=f * by(frame.camera.f), c=f * by(frame.camera.c) + c)
    )


#: Planted fault -> (recording, cause, words, remedy).
PLANTED = {
    **{
        c: (lambda frames, true, c=c: recording(frames, state_poses(true, parse_pose_convention(c))), "poses",
            f"{re.escape(parse_pose_convention(c).describe())}.*they are not used", f"data.pose_convention={c}")
        for c in ("mm", "wxyz", "world_to_camera", "opengl", "world_to_camera+opengl")
    },
    **{
        f"lag {lag}": (late(lag, has_poses), "time offset", f"depth is {words} against", f"data.depth_lag={lag}")
        for lag, has_poses, words in ((1, True, "1 frame late"), (-2, True, "2 frames early"), (3, False, "3 frames late"))
    },
    **{
        turn: (changed(lambda f, d=d: f.replace(depth=f.depth.flip(d))), "rolled" if turn == "180" else "mirrored",
               "depth and pictures differ in orientation: depth is ", f"data.depth_turn={turn}")
        for turn, d in (("left_right", -1), ("upside_down", -2), ("180", (-2, -1)))
    },
    "factor": (changed(lambda f: f.replace(depth=1.1 * f.depth)), "scale", f"depth is 1.1.*{SCALE}", ""),
    "unit": (changed(lambda f: f.replace(depth=5 * f.depth)), "poses", "depth unit may be 1/5000 m", "data.depth_unit=0.0002"),
    "noise": (
        changed(lambda f: f.replace(depth=torch.rand(f.depth.shape, generator=NOISE) * 9 + 1)),
        "plausibility", "depths of two frames disagree by", ""),
    "exchanged": (
        changed(with_camera(1, 0, lambda x: x.flip(-1))), "intrinsics",
        "cx and cy .and fx and fy. look exchanged", "data.K=[fx,fy,cx,cy]"),
    "larger": (
        changed(with_camera(2, 0.5), has_poses=False), "intrinsics",
        "the intrinsics look like those of pictures 1.98 times as large", "data.K=[fx,fy,cx,cy]"),
}  # fmt: skip

QUICK = ("mm", "lag 3", "left_right", "factor", "unit", "noise", "exchanged", "larger")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[SLOW] * (name not in QUICK)) for name in PLANTED])
def test_a_planted_fault_is_named_with_the_option_that_undoes_it(name, frames, true):
    plant, cause, words, remedy = PLANTED[name]
    spoilt = plant(frames, true)
    check = check_capture(spoilt)
    finding = next(each for each in check.findings if re.search(words, each.text))
    assert (finding.cause, finding.remedy) == (cause, remedy) and str(finding) in check.lines
    assert str(finding) == (f"{finding.text} (remedy: {remedy})" if remedy else finding.text)
    assert check.poses_refuted == any(each.cause == "poses" for each in check.findings)
    assert (check.reported.poses is None) == (check.poses_refuted or spoilt.poses is None)
    assert check.reported.report[-1] == check.lines[-1]
    if name in ("noise", "exchanged", "larger"):
        return
    assert len(check.findings) == 1 or name == "unit"
    if remedy:
        corrected = undone(check, spoilt)
        for frame, number in zip(corrected, corrected.number, strict=True):
            k = int(number) + max(0, int(name[4:])) if name.startswith("lag") else int(number)
            torch.testing.assert_close(frame.depth, frames[k].depth)
        if cause == "poses" and name != "unit":
            torch.testing.assert_close(corrected.poses.t, true.t, atol=1e-9, rtol=0)
            torch.testing.assert_close(corrected.poses.R, true.R, atol=1e-6, rtol=0)
        assert not check_capture(corrected).findings or name == "unit"


@pytest.mark.parametrize(
    ("top", "left"),
    [(10, 13), pytest.param(0, 26, marks=pytest.mark.slow), pytest.param(19, 0, marks=pytest.mark.slow)],
)
def test_pictures_that_were_cropped_alone_are_named_with_their_intrinsics(top, left, frames, true):
    """80 % of each picture, enlarged to its size again: depth, poses and K stay those of the whole picture."""

    def crop(frame):
        inner = frame.image[..., top : top + 77, left : left + 102].float()
        return frame.replace(image=F.interpolate(inner, frame.hw, mode="bilinear").round().to(frame.image.dtype))

    check = check_capture(recording([crop(f) for f in frames], true))
    (finding,) = check.findings
    assert finding.cause == "registration" and not check.poses_refuted
    share = float(re.search(r"these show (\d\.\d\d) of the field of view", finding.text).group(1))
    stated = [float(x) for x in re.search(r"= ([-\d, ]+) px at 128x96", finding.text).group(1).split(",")]
    h, w = frames[0].hw
    zoom = w / 102
    true_K = [100 * zoom, 98 * h / 77, (64.5 + 0.5 - left) * zoom - 0.5, (46.0 + 0.5 - top) * h / 77 - 0.5]
    assert share == pytest.approx(1 / zoom, abs=0.06)
    assert stated == pytest.approx(true_K, abs=8)


@pytest.mark.slow
def test_a_motion_that_does_not_show_the_scale_is_stated(frames, true):
    assert check_capture(recording(frames, true)).limits == []
    assert check_capture(recording(frames)).limits == []
    still = Pose(true.R[:1].expand(N, 3, 3), true.t[:1].expand(N, 3))
    check = check_capture(recording([frames[0]] * N, still))
    (limit,) = check.limits
    assert limit.startswith("the scale of depth and poses is not checked exactly: an error of a third or less")


def test_the_window_is_where_the_camera_moves_and_broken_frames_are_left_out(frames, true):
    """A capture that stands still, then walks; frames are decoded only in the window, unreadable ones left out."""
    still = 30
    decoded = []

    def load(i):
        decoded.append(i)
        if i == still + 3:
            raise FormatError("x", "frame", "nothing", "a picture")
        return frames[max(i - still, 0)]

    t = torch.cat((true.t[:1].expand(still, 3), true.t))
    R = torch.cat((true.R[:1].expand(still, 3, 3), true.R))
    whole = Recording("walk", "made", load, torch.arange(still + N), poses=Pose(R, t))
    check = check_capture(whole)
    assert check.findings == () and check.poses is not None
    assert min(decoded) >= still + N - 20 and still + N - 1 in decoded


def test_frames_that_are_decoded_already_are_not_decoded_again_nor_poses_checked_by_sparse_depth(frames, true):
    whole = Recording("walk", "made", {}.__getitem__, torch.arange(N), poses=true)
    assert check_capture(whole, dict(enumerate(frames))).poses.n_pairs > 2
    check = check_capture(recording(frames, state_poses(true, parse_pose_convention("mm")), sparse=True))
    assert check.poses is None and check.diagnosis is None and not check.poses_refuted


@pytest.mark.slow
def test_little_is_enough(frames, true):
    """One frame, no depth, no texture: no finding and no error."""
    assert check_capture(recording(frames[:1], true[:1])).findings == ()
    empty = [f.replace(depth=torch.zeros_like(f.depth)) for f in frames]
    assert check_capture(recording(empty, true)).findings == ()
    grey = [f.replace(image=torch.full_like(f.image, 90)) for f in frames]
    check = check_capture(recording(grey, state_poses(true, parse_pose_convention("opengl"))))
    assert check.poses_refuted, "surfaces alone refute the poses"
    assert check_capture(recording(grey, true)).findings == ()
    lost = Pose(true.R, torch.full_like(true.t, torch.nan))
    assert check_capture(recording(frames, lost)).poses is None


def test_pictures_of_two_sizes_are_checked_without_tracks(frames, true):
    mixed = [f if k % 2 else f.replace(image=f.image[..., ::2, ::2]) for k, f in enumerate(frames)]
    mixed = [f if k % 2 else f.replace(depth=f.depth[..., ::2, ::2]) for k, f in enumerate(mixed)]
    assert check_capture(recording(mixed, true)).diagnosis is None


def test_a_fault_names_the_option_that_undoes_it():
    fault = {fault.name: fault for fault in KNOWN_FAULTS}
    remedy = {name: capture_check._fault_finding(fault[name]).remedy for name in fault}
    assert remedy["mirrored left to right"] == "data.depth_turn=left_right"
    assert remedy["mirrored upside down"] == "data.depth_turn=upside_down"
    assert remedy["rolled by 180 degrees"] == "data.depth_turn=180"
    late, early = (capture_check._fault_finding(fault[name]) for name in ("3 frames late", "2 frames early"))
    assert late == Finding("time offset", "depth is 3 frames late against the pictures", "data.depth_lag=3")
    assert early == Finding("time offset", "depth is 2 frames early against the pictures", "data.depth_lag=-2")


def test_the_camera_of_a_crop_and_the_miss_of_returns_under_it():
    stated = Camera(torch.tensor([[100.0, 110.0]]), torch.tensor([[49.5, 41.5]]))
    crop = PictureField(2.0, (0.25, -0.125), loss=0.1, stated_loss=1.0, lead=0.5)
    camera = crop.camera(stated, (80, 100))  # middle (49.5, 39.5), moved by (25, -10) px
    assert camera.f.tolist() == [[200, 220]]
    assert camera.c.tolist() == [[49.5 + 2 * (0 - 25), 39.5 + 2 * (2 + 10)]]
    assert crop.differs and not crop._replace(zoom=1.05).differs and not crop._replace(lead=0.0).differs
    frame = Frame(torch.zeros(1, 1, 80, 100), torch.full((1, 80, 100), 2.0), stated)
    v, u = torch.meshgrid(torch.arange(20.0, 60, 4), torch.arange(20.0, 60, 4), indexing="ij")
    uv = torch.stack((u, v), -1).view(1, -1, 2)
    motion = Pose(torch.eye(3)[None], torch.tensor([[0.1, 0.0, 0.0]]))  # at 2 m and 100 px: 5 px to the right
    pair = picture_field._Returns(frame, frame, uv, uv + torch.tensor([5.0, 0.0]), motion)
    loss = picture_field._pair_loss(pair, torch.tensor([[1.0, 0.0, 0.0], [1.5, 0.0, 0.0]]))
    half = DEFAULT_VALIDATION_OPTIONS.half_loss_px
    assert loss.tolist() == pytest.approx([0.0, 16**2 / (16**2 + half**2)], abs=1e-5)  # 2.5 px of 100 are 16 of 640


FIELD_CASES = {
    "11a-poses-gl": ("poses", "OpenGL"),
    "11b-poses-w2c": ("poses", "inverted"),
    "11c-poses-wxyz": ("poses", "contradict"),
    "24-depth-lags-one-frame": ("time offset", "1 frame late"),
    "25-depth-off-by-1.1": ("scale", "1.1"),
    "10-flipped-depth": ("mirrored", "upside down"),
}


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize("name", FIELD_CASES)
def test_field_cases_are_named(name):
    cause, words = FIELD_CASES[name]
    check = check_capture(data.open_all(ROOT / "field_cases" / name)[0])
    assert any(each.cause == cause and words in each.text for each in check.findings), check.lines


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize("name", ["holo_a", "field_cases/11e-poses-ok"])
def test_sound_captures_have_no_finding(name):
    check = check_capture(data.open_all(ROOT / name)[0])
    assert check.findings == () and check.recording.poses is not None


def test_pairs_without_a_pose_so_many_frames_later_have_no_epipolar_distance(frames, true):
    """The last pair has a pose one frame earlier, and none one frame later."""
    n = len(frames)
    uv = torch.rand(1, 20, 2, generator=torch.Generator().manual_seed(0)) * 50
    sample, track = SimpleNamespace(uv=uv), SimpleNamespace(uv_1=uv, valid=torch.ones(1, 20, dtype=torch.bool))
    tracks = SimpleNamespace(samples=[sample], tracks=[track])

    def distance(by, pair):
        return capture_check._epipolar_distance(true, by, dict(enumerate(frames)), [pair], tracks)

    assert math.isnan(distance(1, (n - 2, n - 1))) and math.isnan(distance(-1, (0, 1)))
    assert distance(-1, (n - 2, n - 1)) >= 0 and distance(1, (0, 1)) >= 0
