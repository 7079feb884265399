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
from dhtorch.validation.capture_check import CaptureCheck, Finding, check_capture
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


def options_of(remedy):
    """Text of a remedy → options of a capture."""
    name, _, value = remedy.removeprefix("data.").partition("=")
    return {name: int(value) if name == "depth_lag" else value}


def undone(check, spoilt):
    """The recording with the option of the only finding."""
    (finding,) = check.findings
    return Corrections.from_options(options_of(finding.remedy)).apply(spoilt)


def test_a_sound_capture_has_no_finding(frames, true):
    check = check_capture(recording(frames, true))
    assert check.findings == () and not check.poses_refuted and check.recording.poses is true
    assert check.assumed_unit == ASSUMED and check.lines == [ASSUMED, "a remark"]
    assert check.reported.poses is true and check.reported.report == (ASSUMED, "a remark")
    assert check.poses.surfaces.stated < 0.01


def test_a_stated_unit_is_not_announced(frames):
    check = check_capture(recording(frames, depth_unit=DepthUnit(0.001, "camera.json: scale"), report=()))
    assert check.lines == [] and check.poses is None and check.assumed_unit == ""
    assert check_capture(recording(frames, depth_unit=None, report=())).lines == []


@pytest.mark.parametrize(
    "convention",
    [
        "mm",
        *(
            pytest.param(c, marks=pytest.mark.slow)
            for c in ("wxyz", "world_to_camera", "opengl", "world_to_camera+opengl")
        ),
    ],
)
def test_refuted_poses_are_named_and_removed(convention, frames, true):
    parsed = parse_pose_convention(convention)
    spoilt = recording(frames, state_poses(true, parsed))
    check = check_capture(spoilt)
    (finding,) = check.findings
    assert finding.cause == "poses" and parsed.describe() in finding.text and "they are not used" in finding.text
    assert finding.remedy == f"data.pose_convention={convention}"
    assert check.poses_refuted and check.recording.poses is None and spoilt.poses is not None
    corrected = undone(check, spoilt)
    torch.testing.assert_close(corrected.poses.t, true.t, atol=1e-9, rtol=0)
    torch.testing.assert_close(corrected.poses.R, true.R, atol=1e-6, rtol=0)
    assert check.reported.poses is None and check.reported.report[-1] == str(finding)
    assert check.lines[-1].endswith(f"(remedy: data.pose_convention={convention})")


@pytest.mark.parametrize(
    ("lag", "has_poses"), [*(pytest.param(lag, True, marks=pytest.mark.slow) for lag in (1, -2)), (3, False)]
)
def test_late_depth_is_named_with_its_lag(lag, has_poses, frames, true):
    inside = [k for k in range(N) if 0 <= k - lag < N]
    late = [frames[k].replace(depth=frames[k - lag].depth) for k in inside]
    spoilt = recording(late, true[torch.tensor(inside)] if has_poses else None)
    check = check_capture(spoilt)
    (finding,) = check.findings
    assert finding.cause == "time offset" and finding.remedy == f"data.depth_lag={lag}"
    shown = f"{abs(lag)} frame{'s' if abs(lag) > 1 else ''} {'late' if lag > 0 else 'early'} against "
    assert f"depth is {shown}" in finding.text and not check.poses_refuted
    for frame, number in zip(corrected := undone(check, spoilt), undone(check, spoilt).number, strict=True):
        assert torch.equal(frame.depth, frames[inside[int(number)]].depth)
    assert not check_capture(corrected).findings


@pytest.mark.parametrize(
    "turn", ["left_right", *(pytest.param(turn, marks=pytest.mark.slow) for turn in ("upside_down", "180"))]
)
def test_turned_depth_is_named_with_its_turn(turn, frames, true):
    flip = {"left_right": (-1,), "upside_down": (-2,), "180": (-2, -1)}[turn]
    spoilt = recording([f.replace(depth=f.depth.flip(flip)) for f in frames], true)
    check = check_capture(spoilt)
    (finding,) = check.findings
    assert finding.cause == ("rolled" if turn == "180" else "mirrored")
    assert finding.text.startswith("depth and pictures differ in orientation: depth is ")
    assert finding.remedy == f"data.depth_turn={turn}" and not check.poses_refuted
    assert torch.equal(undone(check, spoilt)[2].depth, frames[2].depth)


def test_a_factor_near_1_is_a_scale_without_a_culprit(frames, true):
    check = check_capture(recording([f.replace(depth=1.1 * f.depth) for f in frames], true))
    (finding,) = check.findings
    assert finding.cause == "scale" and not check.poses_refuted and finding.remedy == ""
    assert "depth is 1.1" in finding.text and "which one, depth and poses alone do not show" in finding.text
    assert str(finding) == finding.text


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


def test_depth_in_another_unit_is_named(frames, true):
    """Steps of 1/5000 m that are read as millimetres."""
    spoilt = recording([f.replace(depth=5 * f.depth) for f in frames], true)
    check = check_capture(spoilt)
    finding = next(each for each in check.findings if each.cause == "poses")
    assert "the depth unit may be 1/5000 m" in finding.text and finding.remedy == "data.depth_unit=0.0002"
    corrected = Corrections(depth_unit="0.0002").apply(spoilt)
    torch.testing.assert_close(corrected[1].depth, frames[1].depth)


def test_depth_that_disagrees_with_itself_is_named(frames, true):
    """Returns of a random depth in every frame, by which no reading of the poses agrees."""
    noise = torch.Generator().manual_seed(0)
    random = [f.replace(depth=torch.rand(f.depth.shape, generator=noise) * 9 + 1) for f in frames]
    findings = check_capture(recording(random, true)).findings
    assert any("depths of two frames disagree by" in finding.text for finding in findings)


def test_exchanged_intrinsics_are_named(frames, true):
    def exchanged(frame):
        return frame.replace(camera=frame.camera.replace(f=frame.camera.f.flip(-1), c=frame.camera.c.flip(-1)))

    causes = check_capture(recording([exchanged(f) for f in frames], true)).findings
    assert causes[0].cause == "intrinsics" and "cx and cy (and fx and fy) look exchanged" in causes[0].text
    assert causes[0].remedy == "data.K=[fx,fy,cx,cy]"


def test_intrinsics_of_larger_pictures_are_named(frames):
    twice = [f.replace(camera=f.camera.replace(f=2 * f.camera.f, c=2 * f.camera.c + 0.5)) for f in frames[:3]]
    finding = check_capture(recording(twice)).findings[0]
    assert finding.cause == "intrinsics" and finding.remedy == "data.K=[fx,fy,cx,cy]"
    assert "the intrinsics look like those of pictures 1.98 times as large" in finding.text


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


def test_frames_that_are_decoded_already_are_not_decoded_again(frames, true):
    def load(i):
        raise AssertionError(f"frame {i} was decoded")

    whole = Recording("walk", "made", load, torch.arange(N), poses=true)
    assert check_capture(whole, dict(enumerate(frames))).poses.n_pairs > 2


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


def test_poses_are_not_checked_by_sparse_depth(frames, true):
    check = check_capture(recording(frames, state_poses(true, parse_pose_convention("mm")), sparse=True))
    assert check.poses is None and check.diagnosis is None and not check.poses_refuted


def test_pictures_of_two_sizes_are_checked_without_tracks(frames, true):
    mixed = [f if k % 2 else f.replace(image=f.image[..., ::2, ::2]) for k, f in enumerate(frames)]
    mixed = [f if k % 2 else f.replace(depth=f.depth[..., ::2, ::2]) for k, f in enumerate(mixed)]
    assert check_capture(recording(mixed, true)).diagnosis is None


def test_lines_and_words_of_findings():
    finding = Finding("poses", "wrong", "data.x=1")
    assert str(finding) == "wrong (remedy: data.x=1)" and str(Finding("scale", "wrong")) == "wrong"
    check = CaptureCheck(recording([None]), findings=(finding, Finding("scale", "far")))
    assert check.poses_refuted and check.lines == ["a remark", "wrong (remedy: data.x=1)", "far"]
    assert not CaptureCheck(recording([None]), findings=(Finding("scale", "far"),)).poses_refuted


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
