"""Check of a capture: planted faults of poses, time, orientation and depth are named with the option that undoes them,
and sound captures have no finding."""

import itertools
import math
import os
import re
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from support import box_scene as box
from support.cluttered_walk import N, walk
from support.stated_poses import poses_of, state_poses

from dhtorch import data
from dhtorch.data.corrections import Corrections
from dhtorch.data.io.decode import FormatError
from dhtorch.data.orientation import edge_correlations
from dhtorch.data.pose_convention import PoseConvention, parse_pose_convention
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera
from dhtorch.records import Frame, Pose, Samples, Tracks
from dhtorch.validation import capture_check, edges, picture_field, pose_check
from dhtorch.validation.capture_check import check_capture
from dhtorch.validation.edges import EdgeLag, clear_lead, do_edges_refute, find_edge_fault, find_edge_lag
from dhtorch.validation.faults import KNOWN_FAULTS, rot90_map
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS
from dhtorch.validation.picture_field import PictureField
from dhtorch.validation.pose_check import (
    PoseCheck,
    PoseReading,
    ReadingScores,
    check_poses,
    depth_disagreement,
    describe_contradiction,
    describe_factor,
    pose_readings,
)

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import capture_faults

ROOT = Path(os.environ.get("DHTORCH_DATA", "nowhere"))
needs_data = pytest.mark.skipif(not ROOT.is_dir(), reason="no DHTORCH_DATA")
SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def frames():
    return walk()


@pytest.fixture(scope="module")
def true(frames):
    return poses_of(frames)


def recording(frames, poses=None, first=0, **fields):
    fields = {"report": ("a remark",), "depth_unit": DepthUnit(0.001), **fields}
    number = torch.arange(first, first + len(frames))
    return Recording("walk", "made", frames.__getitem__, number, poses=poses, **fields)


# ------------------------------------------------------------------------------------------------------ whole captures


def test_a_sound_capture_has_no_finding(frames, true):
    check, assumed = check_capture(recording(frames, true)), "depth unit assumed: 1/1000 m (data.depth_unit= sets it)"
    assert check.findings == () and not check.poses_refuted and check.recording.poses is true
    assert check.assumed_unit == assumed and check.lines == [assumed, "a remark"]
    assert check.reported.poses is true and check.reported.report == (assumed, "a remark")
    assert check.poses.surfaces.stated < 0.01 and check.limits == []
    for unit in (DepthUnit(0.001, "camera.json: scale"), None):  # a stated one is not announced
        stated = check_capture(recording(frames[:2], depth_unit=unit, report=()))
        assert stated.lines == stated.limits == [] and stated.poses is None and stated.assumed_unit == ""


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


#: Planted fault -> (recording, cause, words, remedy, marks).
PLANTED = {
    **{
        c: (lambda frames, true, c=c: recording(frames, state_poses(true, parse_pose_convention(c))), "poses",
            f"{re.escape(parse_pose_convention(c).describe())}.*they are not used", f"data.pose_convention={c}",
            *[SLOW] * (c != "mm"))
        for c in ("mm", "wxyz", "world_to_camera", "opengl", "world_to_camera+opengl")
    },
    **{
        f"lag {lag}": (late(lag, has_poses), "time offset", f"depth is {words} against", f"data.depth_lag={lag}",
                       *[SLOW] * (lag == 1))
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


def by_name(table, n):
    """Parameters of a table of cases: n values each, then marks."""
    return [pytest.param(*case[:n], id=name, marks=case[n:]) for name, case in table.items()]


@pytest.mark.parametrize(("plant", "cause", "words", "remedy"), by_name(PLANTED, 4))
def test_a_planted_fault_is_named_with_the_option_that_undoes_it(plant, cause, words, remedy, frames, true):
    spoilt = plant(frames, true)
    check = check_capture(spoilt)
    finding = next(each for each in check.findings if re.search(words, each.text))
    assert (finding.cause, finding.remedy) == (cause, remedy) and str(finding) in check.lines
    assert str(finding) == (f"{finding.text} (remedy: {remedy})" if remedy else finding.text)
    assert check.poses_refuted == any(each.cause == "poses" for each in check.findings)
    assert (check.reported.poses is None) == (check.poses_refuted or spoilt.poses is None)
    assert check.reported.report[-1] == check.lines[-1]
    if cause in ("plausibility", "intrinsics"):
        return
    assert len(check.findings) == 1 or "depth_unit" in remedy
    if remedy:
        option, _, value = remedy.removeprefix("data.").partition("=")
        lag = int(value) if option == "depth_lag" else 0
        corrected = Corrections.from_options({option: lag or value}).apply(spoilt)
        for frame, number in zip(corrected, corrected.number, strict=True):
            torch.testing.assert_close(frame.depth, frames[int(number) + max(0, lag)].depth)
        if option == "pose_convention":
            torch.testing.assert_close(corrected.poses.t, true.t, atol=1e-9, rtol=0)
            torch.testing.assert_close(corrected.poses.R, true.R, atol=1e-6, rtol=0)
        assert not check_capture(corrected).findings or option == "depth_unit"


@pytest.mark.parametrize(("top", "left"), [(10, 13), *(pytest.param(*x, marks=SLOW) for x in ((0, 26), (19, 0)))])
def test_images_that_were_cropped_alone_are_named_with_their_intrinsics(top, left, frames, true):
    """80 % of each image, enlarged to its size again: depth, poses and K stay those of the whole image."""

    def crop(frame):
        inner = frame.image[..., top : top + 77, left : left + 102].float()
        return frame.replace(image=F.interpolate(inner, frame.hw, mode="bilinear").round().to(frame.image.dtype))

    check = check_capture(recording([crop(f) for f in frames], true))
    (finding,) = check.findings
    field, K = re.search(
        r"these show (\d\.\d\d) of the field of view.*= ([-\d, ]+) px at 128x96", finding.text
    ).groups()
    (h, w), zoom = frames[0].hw, 128 / 102
    true_K = [100 * zoom, 98 * h / 77, (64.5 + 0.5 - left) * zoom - 0.5, (46.0 + 0.5 - top) * h / 77 - 0.5]
    assert finding.cause == "registration" and not check.poses_refuted
    assert float(field) == pytest.approx(102 / w, abs=0.06)
    assert [float(x) for x in K.split(",")] == pytest.approx(true_K, abs=8)


def grey(frames):
    return [f.replace(image=torch.full_like(f.image, 90)) for f in frames]


def sizes(frames):
    small = lambda f: f.replace(image=f.image[..., ::2, ::2], depth=f.depth[..., ::2, ::2])  # noqa: E731
    return [f if k % 2 else small(f) for k, f in enumerate(frames)]


def opengl(true):
    return state_poses(true, parse_pose_convention("opengl"))


#: Case -> (recording, what holds of its check).
LITTLE = {
    "still": (
        lambda frames, true: recording([frames[0]] * N, Pose(true.R[:1].expand(N, 3, 3), true.t[:1].expand(N, 3))),
        lambda c: (c.limits[0].startswith(
            "the scale of depth and poses is not checked exactly: an error of a third or less"), len(c.limits) == 1), SLOW),
    "one frame": (lambda frames, true: recording(frames[:1], true[:1]), lambda c: (c.findings == (),), SLOW),
    "no depth": (changed(lambda f: f.replace(depth=0 * f.depth)), lambda c: (c.findings == (),), SLOW),
    "no texture": (lambda frames, true: recording(grey(frames), true), lambda c: (c.findings == (),), SLOW),
    "refuted by surfaces": (
        lambda frames, true: recording(grey(frames), opengl(true)), lambda c: (c.poses_refuted,), SLOW),
    "lost": (
        lambda frames, true: recording(frames, Pose(true.R, torch.full_like(true.t, torch.nan))),
        lambda c: (c.poses is None,), SLOW),
    "two sizes": (lambda frames, true: recording(sizes(frames), true), lambda c: (c.diagnosis is None,)),
    "sparse": (
        lambda frames, true: recording(frames, opengl(true), sparse=True),
        lambda c: (c.poses is None, c.diagnosis is None, not c.poses_refuted)),
}  # fmt: skip


@pytest.mark.parametrize(("make", "check"), by_name(LITTLE, 2))
def test_little_is_enough(make, check, frames, true):
    conditions = check(check_capture(make(frames, true)))
    assert all(conditions), conditions


def test_the_window_is_where_the_camera_moves_and_broken_frames_are_left_out(frames, true):
    """A capture that stands still, then walks; frames are decoded only in the window, and once."""
    still, decoded = 30, []

    def load(i):
        decoded.append(i)
        if i == still + 3:
            raise FormatError("x", "frame", "nothing", "a picture")
        return frames[max(i - still, 0)]

    poses = Pose(*(torch.cat((x[:1].expand(still, *x.shape[1:]), x)) for x in (true.R, true.t)))
    check = check_capture(Recording("walk", "made", load, torch.arange(still + N), poses=poses))
    assert check.findings == () and check.poses is not None
    assert min(decoded) >= still + N - 20 and still + N - 1 in decoded
    known = Recording("walk", "made", {}.__getitem__, torch.arange(N), poses=true)
    assert check_capture(known, dict(enumerate(frames))).poses.n_pairs > 2


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize(
    ("name", "cause", "words"),
    [
        ("field_cases/11a-poses-gl", "poses", "OpenGL"),
        ("field_cases/11b-poses-w2c", "poses", "inverted"),
        ("field_cases/11c-poses-wxyz", "poses", "contradict"),
        ("field_cases/24-depth-lags-one-frame", "time offset", "1 frame late"),
        ("field_cases/25-depth-off-by-1.1", "scale", "1.1"),
        ("field_cases/10-flipped-depth", "mirrored", "upside down"),
        ("holo_a", None, ""),
        ("field_cases/11e-poses-ok", None, ""),
    ],
)
def test_field_cases(name, cause, words):
    check = check_capture(data.open_all(ROOT / name)[0])
    if cause is None:
        assert check.findings == () and check.recording.poses is not None
    else:
        assert any(each.cause == cause and words in each.text for each in check.findings), check.lines


def test_the_camera_of_a_crop_and_the_miss_of_returns_under_it():
    stated = Camera(torch.tensor([[100.0, 110.0]]), torch.tensor([[49.5, 41.5]]))
    crop = PictureField(2.0, (0.25, -0.125), loss=0.1, stated_loss=1.0, lead=0.5)
    camera = crop.camera(stated, (80, 100))  # middle (49.5, 39.5), moved by (25, -10) px
    assert camera.f.tolist() == [[200, 220]]
    assert camera.c.tolist() == [[49.5 + 2 * (0 - 25), 39.5 + 2 * (2 + 10)]]
    assert crop.differs and not crop._replace(zoom=1.05).differs and not crop._replace(lead=0.0).differs
    frame = Frame(torch.zeros(1, 1, 80, 100), torch.full((1, 80, 100), 2.0), stated)
    uv = torch.cartesian_prod(torch.arange(20.0, 60, 4), torch.arange(20.0, 60, 4))[None]
    motion = Pose(torch.eye(3)[None], torch.tensor([[0.1, 0.0, 0.0]]))  # at 2 m and 100 px: 5 px to the right
    pair = picture_field._Returns(frame, frame, uv, uv + torch.tensor([5.0, 0.0]), motion)
    loss = picture_field._pair_loss(pair, torch.tensor([[1.0, 0.0, 0.0], [1.5, 0.0, 0.0]]))
    half = DEFAULT_VALIDATION_OPTIONS.half_loss_px
    assert loss.tolist() == pytest.approx([0.0, 16**2 / (16**2 + half**2)], abs=1e-5)  # 2.5 px of 100 are 16 of 640


def test_pairs_without_a_pose_so_many_frames_later_have_no_epipolar_distance(frames, true):
    """The last pair has a pose one frame earlier, and none one frame later."""
    uv = torch.rand(1, 20, 2, generator=torch.Generator().manual_seed(0)) * 50
    sample, track = SimpleNamespace(uv=uv), SimpleNamespace(uv_1=uv, valid=torch.ones(1, 20, dtype=torch.bool))
    tracks = SimpleNamespace(samples=[sample], tracks=[track])
    for by, first, has_pose in ((1, N - 2, False), (-1, 0, False), (-1, N - 2, True), (1, 0, True)):
        pairs = [(first, first + 1)]
        found = capture_check._epipolar_distance(true, by, dict(enumerate(frames)), pairs, tracks)
        assert (found >= 0) == has_pose and math.isnan(found) != has_pose


# -------------------------------------------------------------------------------------------------------------- edges


def delayed(frames, lag):
    """Frames whose depth comes ``lag`` frames late."""
    return [frame.replace(depth=frames[k - lag].depth) for k, frame in enumerate(frames) if 0 <= k - lag < len(frames)]


def turned(frames, plant):
    return [frame.replace(depth=plant(frame.depth)) for frame in frames]


@pytest.mark.parametrize(
    ("change", "lag"),
    [
        *((partial(delayed, lag=lag), lag) for lag in (0, 1, 2, 5, -1, -3)),
        (lambda frames: turned(frames, torch.zeros_like), 0),
        (lambda frames: delayed(frames, 1)[:4], 0),  # three have a depth of another frame
        (lambda frames: delayed([frames[3]] * N, 2), 0),
    ],
)
def test_lag_of_depth_by_edges(change, lag, frames):
    found = find_edge_lag(change(frames))
    assert found.lag == lag and (found.lead > 0.04 if lag else found == EdgeLag(0, 0.0))


@pytest.mark.parametrize(("n", "lag", "expected"), [(8, 2, 0.1), (7, 3, 0.1), (7, -3, 0.1), (6, 3, 0.0), (6, -3, 0.0)])
def test_the_lead_of_a_lag_is_its_correlation_less_that_without_over_four_frames_or_more(monkeypatch, n, lag, expected):
    scores = torch.linspace(0.2, 0.5, n)[:, None] + 0.1 * torch.diag(torch.ones(n - abs(lag)), lag)
    stubs = {
        "picture_edges": lambda image, grid_px: image.expand(3, 2, 2),
        "depth_over_picture": lambda frame, depth: frame.image[0],
        "depth_edges": lambda depth, hw: (depth.expand(3, *hw), torch.ones(hw) > 0),
        "edge_correlations": lambda pictures, edges, covered: scores,
        "_shifted_scores": lambda image, edges, _: scores[int(image[0, 0, 0]), int(edges[0, 0, 0])].expand(1),
    }
    for name, stub in stubs.items():
        monkeypatch.setattr(edges, name, stub)
    found = find_edge_lag([SimpleNamespace(image=torch.full((1, 1, 1, 1), float(k)), depth=None) for k in range(n)])
    assert found.lag == (lag if expected else 0) and found.lead == pytest.approx(expected)


APART = [0.0, 0.2, 0.0, 0.2]  # mean 0.1, standard error 0.1155 / 2


@pytest.mark.parametrize(
    ("lead", "errors", "expected"), [([0.1] * 4, 4.0, 0.1), ([0.04] * 4, 4.0, 0), (APART, 1.7, 0.1), (APART, 1.8, 0)]
)
def test_a_lead_is_above_the_least_and_above_its_standard_errors(lead, errors, expected):
    assert clear_lead(torch.tensor(lead), 0.05, errors=errors) == pytest.approx(expected)


def test_correlations_under_shifts_are_those_of_shifted_depth():
    generator = torch.Generator().manual_seed(0)
    image, depth = (torch.rand(3, 47, 60, generator=generator) for _ in range(2))
    covered = torch.rand(47, 60, generator=generator) > 0.3
    shifts = list(itertools.product(edges._SHIFTS_PX, repeat=2))
    moved, masks = (torch.stack([x.roll(by, (-2, -1)) for by in shifts]) for x in (depth, covered))
    expected = edge_correlations(image[None], moved, masks)[0]
    torch.testing.assert_close(edges._shifted_scores(image, depth, covered), expected, atol=1e-5, rtol=0)


def mirrored(depth):
    return depth.flip(-1)


@pytest.mark.parametrize(
    ("shown", "name"),
    [
        (lambda frames: frames, None),
        (lambda frames: turned(frames, mirrored), "mirrored left to right"),
        (lambda frames: turned(frames, lambda d: d.flip(-2)), "mirrored upside down"),
        (lambda frames: turned(frames, lambda d: rot90_map(d, 2)), "rolled by 180 degrees"),
        (lambda frames: turned(frames, lambda d: rot90_map(d, 1)), "rolled by 90 degrees"),
        (lambda frames: turned(frames, torch.zeros_like), None),
        (lambda frames: [], None),
        (lambda frames: frames[:2], None),
        (lambda frames: turned(frames[:2], mirrored), None),
        (lambda frames: turned(frames[:1], mirrored) * 8, None),
    ],
)
def test_turn_of_depth_by_edges(shown, name, frames):
    spoilt = shown(frames)
    fault = find_edge_fault(spoilt)
    assert (fault and fault.name) == name
    assert fault is None or "90" in name or torch.equal(fault.undo(spoilt[0].depth), frames[0].depth)


@pytest.mark.parametrize(
    ("kind", "shown", "refuted"),
    [
        *((kind, lambda frames: frames, True) for kind in ("mirrored", "rolled", "registration")),
        ("mirrored", lambda frames: turned(frames, lambda d: d.flip(-2)), False),  # the last of its kind
        ("mirrored", lambda frames: frames[:2], False),
        ("time offset", lambda frames: frames, False),  # edges of one frame show no lag
    ],
)
def test_edges_refute_a_fault_that_is_none(kind, shown, refuted, frames):
    assert do_edges_refute(shown(frames), {fault.kind: fault for fault in KNOWN_FAULTS}[kind]) == refuted


# ------------------------------------------------------------------------------------------- poses beside exact depth

PAIRS = [(3, 5), (4, 6), (5, 7), (6, 8)]
STATED, UP_BACK = PoseReading(), PoseReading(PoseConvention("right_up_back"))


class Box(SimpleNamespace):
    """A walk inside a box whose depth is exact, and exact tracks of 60 pixels of the first frame of each pair."""

    def check(self, poses=None, tracked=False, factor=1.0, pairs=PAIRS):
        scaled = {k: f.replace(depth=factor * f.depth) for k, f in self.frames.items()}
        tracks = [(s.replace(depth=factor * s.depth), t) for s, t in self.tracks[: len(pairs)]] if tracked else ()
        return check_poses(self.true if poses is None else poses, scaled, pairs, tracks)


@pytest.fixture(scope="module")
def scene():
    frames = dict(enumerate(box.walk(12)))
    return Box(frames=frames, true=poses_of(list(frames.values())),
               tracks=[exact_tracks(frames[i], frames[j]) for i, j in PAIRS])  # fmt: skip


def exact_tracks(a, b):
    g = torch.Generator().manual_seed(0)
    uv = (torch.rand(1, 60, 2, generator=g) * torch.tensor([box.HW[1] - 1, box.HW[0] - 1])).round()
    depth = a.depth[0, uv[0, :, 1].long(), uv[0, :, 0].long()][None]
    xyz = se3.apply(se3.relative(a.T_world_from_cam, b.T_world_from_cam), cam.unproject(a.camera, uv, depth).double())
    ones, none = torch.ones_like(depth), torch.zeros_like(depth, dtype=torch.int32)
    samples = Samples(uv, depth, 0.01 * depth, torch.cat((uv, depth[..., None]), -1), ones, none, depth, none)
    cov = torch.eye(2).expand(1, 60, 2, 2)
    return samples, Tracks(uv, cam.project(b.camera, xyz.float()), ones, ones, cov, torch.ones(1, 60) > 0)


def test_true_poses_agree(scene):
    for tracked in (False, True):
        check = scene.check(tracked=tracked)
        assert check.surfaces.stated < 0.005 < check.surfaces.without
        assert not check.contradicts and check.factor == 1 and check.n_pairs == len(PAIRS)
    assert check.tracks.stated < 0.01 and not check.by_tracks and check.best == check.surfaces.best


CONVENTIONS = ["world_to_camera", "opengl", "ros", "left_up_forward", "wxyz", "xyzw", "mm", "cm", "inch", "10.0", "0.1"]


@pytest.mark.parametrize(
    ("text", "tracked"),
    # Surfaces of a bare box alone do not show this order of quaternions. Of the units that differ in a factor some run.
    [
        pytest.param(text, tracked, marks=[SLOW] * (text in ("cm", "inch", "10.0", "left_up_forward")))
        for text in (*CONVENTIONS, "world_to_camera+opengl")
        for tracked in (False, True)
        if (text, tracked) != ("wxyz", False)
    ],
)
def test_a_convention_is_named(text, tracked, scene):
    convention = parse_pose_convention(text)
    check = scene.check(state_poses(scene.true, convention), tracked)
    assert check.contradicts and check.is_explained and check.by_tracks == tracked
    assert check.best == PoseReading(convention) and check.factor == 1
    text, remedy = describe_contradiction(check)
    assert text.startswith("poses and depth contradict each other (")
    assert ("near returns miss their tracks" if tracked else "if read otherwise") in text
    if check.best.factor == 1 or isinstance(convention.unit, str):
        assert convention.describe() in text
    assert remedy == f"data.pose_convention={convention}"


@pytest.mark.parametrize(("lag", "words"), [(1, "1 frame late"), (-2, "2 frames early"), (3, "3 frames late")])
@pytest.mark.parametrize("tracked", [False, True])
def test_a_lag_between_depth_and_poses_is_named(lag, words, tracked, scene):
    """The pose of a frame is stated ``lag`` frames later: its depth and image come early, and the reverse."""
    stated = poses_of([box.render(box.CAMERA, box.pose(k + lag), (2, 2)) for k in range(12)])
    check = scene.check(stated, tracked)
    assert check.contradicts and check.best == PoseReading(lag=-lag)
    text, remedy = describe_contradiction(check)
    assert f"{words} against the poses" in text and remedy == f"data.depth_lag={lag}"


@pytest.mark.parametrize(
    ("factor", "tracked", "n_pairs"),
    [*((x, tracked, 4) for x in (1.1, 0.9) for tracked in (False, True)), *((1.1, True, n) for n in (1, 2, 3))],
)
def test_a_factor_near_1_is_a_scale_and_refutes_nothing(factor, tracked, n_pairs, scene):
    """One pair or two decide neither by tracks nor on a factor."""
    check = scene.check(tracked=tracked, factor=factor, pairs=PAIRS[:n_pairs])
    assert not check.contradicts or n_pairs < 3
    assert check.factor == pytest.approx(factor if n_pairs > 2 else 1.0, rel=0.015)
    assert (check.tracks is not None) == (tracked and n_pairs > 2)
    assert f"depth is {check.factor:.2f} times what the poses' translations imply" in describe_factor(check)


@pytest.mark.parametrize(
    ("poses", "factor", "unit", "best", "start", "end", "remedy"),
    [
        # Codes of 1/5000 m that are read as millimetres: the unit is named, not a factor of the poses.
        (None, 5.0, 0.001, PoseReading(PoseConvention(unit=5.0)),
         "translations are 0.2 times what the depth has; the depth unit may be 1/5000 m", "", "data.depth_unit=0.0002"),
        (None, 5.0, 0.003, PoseReading(PoseConvention(unit=5.0)), "poses and depth contradict each other",
         "the unit of the depth or of the poses is another one", "data.pose_convention=5.0"),
        ([0, 1, 2, 9, 3, 8, 4, 7, 6, 5, 10, 11], 1.0, None, None, "without poses",
         "no other reading of the poses explains it", ""),
    ],
)  # fmt: skip
def test_depth_of_another_unit_and_poses_of_another_capture(poses, factor, unit, best, start, end, remedy, scene):
    check = scene.check(None if poses is None else scene.true[torch.tensor(poses)], factor=factor)
    assert check.contradicts and (check.best == best if best else not check.is_explained)
    text, found = describe_contradiction(check, None if unit is None else DepthUnit(unit))
    assert start in text and text.endswith(end) and found == remedy


def test_poses_that_are_not_finite_and_frames_of_little_depth_are_left_out(scene):
    """A pair without poses says nothing; with none left, only other readings could, and they have none either."""
    lost = torch.where(torch.arange(12)[:, None] == 3, torch.nan, scene.true.t)
    check = scene.check(Pose(scene.true.R, lost))
    assert check.n_pairs == len(PAIRS) - 1 and not check.contradicts
    few = torch.zeros(box.HW).index_put((torch.tensor(10), torch.arange(40)), torch.tensor(1.0))
    for none in (
        scene.check(Pose(scene.true.R, torch.full_like(scene.true.t, torch.nan))),
        scene.check(pairs=[]),
        scene.check(factor=few),
    ):
        assert none is None


def test_disagreement_is_the_median_relative_difference(scene):
    """Points carried by no motion into a map that is 3 % longer, half of which is 5 % longer still."""
    frame = scene.frames[0]
    v, u = torch.nonzero(frame.depth[0] > 0, as_tuple=True)
    xyz = cam.unproject(frame.camera, torch.stack((u, v), -1)[None].float(), frame.depth[0, v, u][None])[0].double()
    still = se3.identity(2, torch.zeros((), dtype=torch.float64))
    assert float(depth_disagreement(xyz, frame, still).max()) < 1e-6
    smaller = frame.replace(depth=frame.depth[:, ::2, ::2])
    assert float(depth_disagreement(xyz, smaller, still).max()) < 0.02, "by the camera of a smaller map"
    longer = frame.replace(depth=1.03 * frame.depth)
    torch.testing.assert_close(depth_disagreement(xyz, longer, still), torch.full((2,), 0.03 / 1.03).double())
    apart = Pose(still.R, torch.tensor([[0.0, 0, 0], [0, 0, -100.0]], dtype=torch.float64))
    behind = depth_disagreement(xyz, frame, apart)
    assert float(behind[0]) < 1e-6 and math.isnan(float(behind[1])), "points behind the camera meet nothing"
    assert math.isnan(float(depth_disagreement(xyz[:49], frame, still)[0])), "too few points"


def test_readings_are_distinct_and_the_stated_one_is_first():
    readings = pose_readings()
    assert readings[0] == STATED and len(set(readings)) == len(readings)
    assert {r.lag for r in readings} == set(range(-5, 6))
    assert sum(r.convention.inverse for r in readings) == 24
    assert all(r.is_small_factor == (0.67 < r.factor < 1.5 and r.convention.unit != "m") for r in readings)


def test_a_scale_error_goes_unnoticed_up_to_the_factors_whose_score_is_hardly_worse():
    """Scores that rise by the square of the factor's logarithm: steeply, hardly, and on one side alone."""
    readings = [r for r in pose_readings() if r.is_small_factor or r == STATED]
    log = torch.tensor([math.log(r.factor) for r in readings], dtype=torch.float64)
    error = partial(pose_check._unnoticed_scale_error, readings, track=None)
    steep, fine = error(1 + 1e4 * log**2), error(1 + 30 * log**2)
    assert steep == pose_check._MIN_FACTOR_OFFSET < fine < math.exp(float(log.abs().max())) - 1
    assert error(1 + 0 * log) == math.inf
    assert error(1 + 1e4 * log.clamp(min=0) ** 2) == error(1 + 1e4 * log.clamp(max=0) ** 2) == math.inf


SMALL = PoseReading(PoseConvention(unit=1.025**4))


@pytest.mark.parametrize(
    ("stated", "best_score", "best", "without", "tracks", "refuted", "factor"),
    [
        (0.021, 0.010, UP_BACK, 0.1, None, True, 1.2),  # twice as much and 1 % more
        (0.019, 0.010, UP_BACK, 0.1, None, False, 1.2),
        (0.0120, 0.0045, UP_BACK, 0.1, None, False, 1.2),  # less than 1 % more: three times are needed
        (0.0120, 0.0035, UP_BACK, 0.1, None, True, 1.2),
        (0.0035, 0.0010, UP_BACK, 0.1, None, False, 1.2),  # three times, but less than 0.3 % more
        (0.0045, 0.0014, UP_BACK, 0.1, None, True, 1.2),
        (0.06, 0.05, STATED, 0.04, None, True, 1.2),  # no better reading: beyond the bound and beyond no poses
        (0.06, 0.05, STATED, 0.07, None, False, 1.2),
        (0.04, 0.035, STATED, 0.01, None, False, 1.2),
        (math.nan, 0.01, UP_BACK, 0.1, None, True, 1.2),
        (math.nan, math.nan, UP_BACK, 0.1, None, False, 1.2),
        # Tracks decide where they are decisive.
        (0.01, 0.01, STATED, 0.1, (0.9, 1.0, UP_BACK, 0.3), True, 1.0),
        (0.01, 0.01, STATED, 0.1, (0.9, 1.0, UP_BACK, 0.6), False, 1.2),  # not clearly better
        (0.01, 0.01, STATED, 0.1, (0.15, 1.0, UP_BACK, 0.01), False, 1.2),  # the stated poses are good
        (0.01, 0.01, STATED, 0.1, (0.9, 1.0, SMALL, 0.3), False, 1.025**4),
    ],
)
def test_limits_of_a_contradiction(stated, best_score, best, without, tracks, refuted, factor):
    check = PoseCheck(ReadingScores(stated, without, best, best_score), tracks and ReadingScores(*tracks), 1.2, 4)
    assert check.contradicts == refuted and check.factor == factor
    assert not check.by_tracks or (check.is_explained and check.best == tracks[2])


@pytest.mark.parametrize(
    ("factor", "gain", "better", "pairs", "found"),
    [
        (1.1, 1.16, 8, 8, 1.1),
        (0.9, 1.16, 8, 8, 0.9),
        (1.1, 1.14, 8, 8, 1.0),
        (1.046, 1.16, 8, 8, 1.046),
        (1.044, 1.16, 8, 8, 1.0),
        (0.956, 1.16, 8, 8, 0.956),
        (0.958, 1.16, 8, 8, 1.0),
        (1.1, 1.16, 6, 8, 1.1),
        (1.1, 1.16, 5, 8, 1.0),
        (1.1, 1.16, 2, 2, 1.0),
        (1.1, 1.16, 3, 3, 1.1),
    ],
)
def test_a_factor_near_1_is_distinguishable_by_most_of_enough_pairs(monkeypatch, factor, gain, better, pairs, found):
    monkeypatch.setattr(pose_check, "_FINE_FACTORS", (factor,))
    stated = torch.full((pairs + 1,), 0.2)
    stated[pairs] = torch.nan  # a pair that the stated poses do not compare
    scaled = torch.where(torch.arange(pairs + 1) < better, 0.15, 0.25)
    median = torch.tensor([0.2 * gain / 1.16, 0.01, 0.2 / 1.16])
    columns = torch.stack((stated, torch.full_like(stated, 0.01), scaled), 1)
    readings = [STATED, UP_BACK, PoseReading(PoseConvention(unit=factor))]
    assert [r.is_small_factor for r in readings] == [False, False, True]
    assert pose_check._distinguishable_factor(readings, median, columns) == pytest.approx(found)


# --------------------------------------------------------------------------------------- the benchmark of planted faults

#: What is opened instead of a sound capture -> whether it is right.
OPENED = {
    "sound": (recording, 0, True),
    "two frames left out": (lambda f, true: recording(f[2:], true[2:], first=2), 0, True),
    "the first two lost by a lag": (lambda f, true: recording(f[2:], true[2:]), 2, True),
    "numbers that moved": (lambda f, true: recording(f[2:], true[2:]), 0, False),
    "other translations": (lambda f, true: recording(f, true.replace(t=1.1 * true.t)), 0, False),
    "without its poses": (lambda f, true: recording(f), 0, False),
    **{
        name: (changed(change), 0, False)
        for name, change in {
            "scaled": lambda f: f.replace(depth=1.02 * f.depth),
            "mirrored": lambda f: f.replace(depth=f.depth.flip(-1)),
            "smaller": lambda f: f.replace(depth=f.depth[..., ::2, ::2]),
            "mirrored image": lambda f: f.replace(image=f.image.flip(-1)),
            "holes": lambda f: f.replace(depth=torch.where(torch.rand(f.depth.shape) < 0.1, 0.0, f.depth)),
            "other f": lambda f: f.replace(camera=f.camera.replace(f=1.02 * f.camera.f)),
            "other c": lambda f: f.replace(camera=f.camera.replace(c=f.camera.c + 3)),
        }.items()
    },
}


@pytest.mark.slow
@pytest.mark.parametrize(("opened", "lag", "is_right"), by_name(OPENED, 3))
def test_the_benchmark_knows_the_truth(opened, lag, is_right, frames, true):
    sound = capture_faults.Sound(frames, list(range(len(frames))), true)
    assert capture_faults.is_right(opened(frames, true), sound, lag) == is_right


@pytest.mark.slow
def test_numbers_of_the_summary_of_the_benchmark():
    outcomes = [
        "none right",
        "none alarm",
        "lag_1 named",
        "lag_1 silent -",
        "w2c otherwise",
        "w2c refused",
        "w2c right",
    ]
    rows = [dict(zip(("fault", "outcome"), x.split(), strict=False), counted="-" not in x) for x in outcomes]
    summary = capture_faults.summarise(rows)
    assert summary["outcomes"] == {"right": 1, "refused": 1, "named": 1, "otherwise": 1, "silent": 1, "unchecked": 0}
    assert summary["n_counted"] == 4 and summary["named_rightly"] == 3 / 4
    assert summary["false_alarms"] == 1 / 2 and summary["n_sound"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "layout", "outcome"), [("opengl", "counted_frames", "named"), ("w2c", "record3d_mp4", None)]
)
def test_outcomes_of_rows_of_the_benchmark(fault, layout, outcome, frames, tmp_path):
    sound = capture_faults.read_sound(list(frames), layout)
    row = capture_faults.run_row(list(frames), layout, capture_faults.FAULTS[fault], sound, tmp_path / "capture")
    assert (row and row["outcome"]) == outcome, row
