"""Poses beside depth: the true reading is named among all that are tried, by surfaces alone and by tracks."""

import math
from functools import partial

import pytest
import torch
from support import box_scene as box
from support.stated_poses import poses_of, state_poses

from dhtorch.data.pose_convention import PoseConvention, parse_pose_convention
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.records import Pose, Samples, Tracks
from dhtorch.validation import pose_check
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

N = 12
PAIRS = [(3, 5), (4, 6), (5, 7), (6, 8)]
NONE, UP_BACK = PoseReading(), PoseReading(PoseConvention("right_up_back"))


@pytest.fixture(scope="module")
def frames():
    """A walk inside a box whose depth is exact, by position."""
    return dict(enumerate(box.walk(N)))


@pytest.fixture(scope="module")
def true(frames):
    return poses_of(list(frames.values()))


@pytest.fixture(scope="module")
def tracks(frames):
    """Exact tracks of 60 pixels of the first frame of each pair."""
    return [exact_tracks(frames[i], frames[j]) for i, j in PAIRS]


def exact_tracks(a, b):
    g = torch.Generator().manual_seed(0)
    uv = torch.rand(1, 60, 2, generator=g) * torch.tensor([box.HW[1] - 1, box.HW[0] - 1])
    uv = uv.round()
    depth = a.depth[0, uv[0, :, 1].long(), uv[0, :, 0].long()][None]
    xyz = se3.apply(se3.relative(a.T_world_from_cam, b.T_world_from_cam), cam.unproject(a.camera, uv, depth).double())
    end = cam.project(b.camera, xyz.float())
    ones, none = torch.ones_like(depth), torch.zeros_like(depth, dtype=torch.int32)
    samples = Samples(uv, depth, 0.01 * depth, torch.cat((uv, depth[..., None]), -1), ones, none, depth, none)
    cov = torch.eye(2).expand(1, 60, 2, 2)
    return samples, Tracks(uv, end, ones, ones, cov, torch.ones(1, 60, dtype=torch.bool))


def test_true_poses_agree(frames, true, tracks):
    for by in ((), tracks):
        check = check_poses(true, frames, PAIRS, by)
        assert check.surfaces.stated < 0.005 < check.surfaces.without
        assert not check.contradicts and check.factor == 1 and check.n_pairs == len(PAIRS)
    assert check.tracks.stated < 0.01 and not check.by_tracks and check.best == check.surfaces.best


CONVENTIONS = [
    "world_to_camera",
    "opengl",
    "ros",
    "left_up_forward",
    "wxyz",
    "xyzw",
    "mm",
    "cm",
    "inch",
    "10.0",
    "0.1",
    "world_to_camera+opengl",
]


@pytest.mark.parametrize(
    ("text", "tracked"),
    # Surfaces of a bare box alone do not show this order of quaternions. Of the units that differ in a factor some run.
    [
        pytest.param(text, tracked, marks=[pytest.mark.slow] * (text in ("cm", "inch", "10.0", "left_up_forward")))
        for text in CONVENTIONS
        for tracked in (False, True)
        if (text, tracked) != ("wxyz", False)
    ],
)
def test_a_convention_is_named(text, tracked, frames, true, tracks):
    convention = parse_pose_convention(text)
    check = check_poses(state_poses(true, convention), frames, PAIRS, tracks if tracked else ())
    assert check.contradicts and check.is_explained and check.by_tracks == tracked
    assert check.best == PoseReading(convention) and check.factor == 1
    text, remedy = describe_contradiction(check)
    assert text.startswith("poses and depth contradict each other (")
    assert ("near returns miss their tracks" if tracked else "if read otherwise") in text
    if check.best.factor == 1 or isinstance(convention.unit, str):
        assert convention.describe() in text
    assert remedy == f"data.pose_convention={convention}"


@pytest.mark.parametrize("lag", [1, -2, 3])
@pytest.mark.parametrize("tracked", [False, True])
def test_a_lag_between_depth_and_poses_is_named(lag, tracked, frames, tracks):
    """The pose of a frame is stated ``lag`` frames later: its depth and picture come early, and the reverse."""
    stated = poses_of([box.render(box.CAMERA, box.pose(k + lag), (2, 2)) for k in range(N)])
    check = check_poses(stated, frames, PAIRS, tracks if tracked else ())
    assert check.contradicts and check.best == PoseReading(lag=-lag)
    text, remedy = describe_contradiction(check)
    shown = f"{abs(lag)} frame{'s' if abs(lag) > 1 else ''} {'late' if lag > 0 else 'early'} against the poses"
    assert shown in text and remedy == f"data.depth_lag={lag}"


@pytest.mark.parametrize("factor", [1.1, 0.9])
@pytest.mark.parametrize("tracked", [False, True])
def test_a_factor_near_1_is_a_scale_and_refutes_nothing(factor, tracked, frames, true, tracks):
    scaled = {k: f.replace(depth=factor * f.depth) for k, f in frames.items()}
    by = [(s.replace(depth=factor * s.depth), t) for s, t in tracks] if tracked else ()
    check = check_poses(true, scaled, PAIRS, by)
    assert not check.contradicts
    assert check.factor == pytest.approx(factor, rel=0.015)
    assert f"depth is {check.factor:.2f} times what the poses' translations imply" in describe_factor(check)


def test_one_pair_or_two_decide_neither_by_tracks_nor_on_a_factor_near_1(frames, true, tracks):
    scaled = {k: f.replace(depth=1.1 * f.depth) for k, f in frames.items()}
    by = [(s.replace(depth=1.1 * s.depth), t) for s, t in tracks]
    for n, factor in ((1, 1.0), (2, 1.0), (3, 1.1)):
        check = check_poses(true, scaled, PAIRS[:n], by[:n])
        assert check.factor == pytest.approx(factor, rel=0.015) and (check.tracks is not None) == (n > 2)


def test_depth_of_another_common_unit_is_named(frames, true):
    """Codes of 1/5000 m that are read as millimetres: the unit is named, not a factor of the poses."""
    scaled = {k: f.replace(depth=5 * f.depth) for k, f in frames.items()}
    check = check_poses(true, scaled, PAIRS)
    assert check.contradicts and check.best == PoseReading(PoseConvention(unit=5.0))
    text, remedy = describe_contradiction(check, DepthUnit(0.001))
    assert "translations are 0.2 times what the depth has; the depth unit may be 1/5000 m" in text
    assert remedy == "data.depth_unit=0.0002"
    text, remedy = describe_contradiction(check, DepthUnit(0.003))
    assert text.endswith("the unit of the depth or of the poses is another one")
    assert remedy == "data.pose_convention=5.0"


def test_unrelated_poses_are_refuted_without_a_reading(frames, true):
    """Poses of another capture, in another order."""
    order = torch.tensor([0, 1, 2, 9, 3, 8, 4, 7, 6, 5, 10, 11])
    check = check_poses(true[order], frames, PAIRS)
    assert check.contradicts and not check.is_explained
    text, remedy = describe_contradiction(check)
    assert text.endswith("no other reading of the poses explains it") and "without poses" in text and remedy == ""


def test_poses_that_are_not_finite_are_left_out(frames, true):
    """A pair without poses says nothing; with none left, only other readings could, and they have none either."""
    lost = Pose(true.R, torch.where(torch.arange(N)[:, None] == 3, torch.nan, true.t))
    check = check_poses(lost, frames, PAIRS)
    assert check.n_pairs == len(PAIRS) - 1 and not check.contradicts
    assert check_poses(Pose(true.R, torch.full_like(true.t, torch.nan)), frames, PAIRS) is None


def test_too_little_depth_or_no_pair_gives_no_check(frames, true):
    assert check_poses(true, frames, []) is None
    few = {}
    for k, frame in frames.items():
        depth = torch.zeros_like(frame.depth)
        depth[0, 10, :40] = frame.depth[0, 10, :40]
        few[k] = frame.replace(depth=depth)
    assert check_poses(true, few, PAIRS) is None


def test_disagreement_is_the_median_relative_difference(frames):
    """Points carried by no motion into a map that is 3 % longer, half of which is 5 % longer still."""
    frame = frames[0]
    v, u = torch.nonzero(frame.depth[0] > 0, as_tuple=True)
    xyz = cam.unproject(frame.camera, torch.stack((u, v), -1)[None].float(), frame.depth[0, v, u][None])[0].double()
    still = se3.identity(2, torch.zeros((), dtype=torch.float64))
    assert float(depth_disagreement(xyz, frame, still).max()) < 1e-6
    longer = frame.replace(depth=1.03 * frame.depth)
    torch.testing.assert_close(depth_disagreement(xyz, longer, still), torch.full((2,), 0.03 / 1.03).double())
    apart = Pose(still.R, torch.tensor([[0.0, 0, 0], [0, 0, -100.0]], dtype=torch.float64))
    behind = depth_disagreement(xyz, frame, apart)
    assert float(behind[0]) < 1e-6 and math.isnan(float(behind[1])), "points behind the camera meet nothing"
    assert math.isnan(float(depth_disagreement(xyz[:49], frame, still)[0])), "too few points"


def test_the_camera_of_a_smaller_map(frames):
    frame = frames[0]
    half = frame.replace(depth=frame.depth[:, ::2, ::2])
    torch.testing.assert_close(half.map_camera.f, frame.camera.f / 2)
    own = frame.replace(depth_camera=box.CAMERA.replace(f=torch.tensor([[7.0, 7.0]])))
    assert torch.equal(own.map_camera.f, own.depth_camera.f) and frame.map_camera is frame.camera


def test_readings_are_distinct_and_the_stated_one_is_first():
    readings = pose_readings()
    assert readings[0] == NONE and len(set(readings)) == len(readings)
    assert {r.lag for r in readings} == set(range(-5, 6))
    assert sum(r.convention.inverse for r in readings) == 24
    assert all(r.is_small_factor == (0.67 < r.factor < 1.5 and r.convention.unit != "m") for r in readings)


def test_a_scale_error_goes_unnoticed_up_to_the_factors_whose_score_is_hardly_worse():
    """Scores that rise by the square of the factor's logarithm: steeply, hardly, and on one side alone."""
    readings = [r for r in pose_readings() if r.is_small_factor or r == NONE]
    log = torch.tensor([math.log(r.factor) for r in readings], dtype=torch.float64)
    error = partial(pose_check._unnoticed_scale_error, readings, track=None)
    steep, fine = error(1 + 1e4 * log**2), error(1 + 30 * log**2)
    assert steep == pose_check._MIN_FACTOR_OFFSET < fine < math.exp(float(log.abs().max())) - 1
    assert error(1 + 0 * log) == math.inf
    assert error(1 + 1e4 * log.clamp(min=0) ** 2) == error(1 + 1e4 * log.clamp(max=0) ** 2) == math.inf


def check_of(stated, best_score, best=UP_BACK, without=0.1, tracks=None, factor=1.0):
    return PoseCheck(ReadingScores(stated, without, best, best_score), tracks, factor, 4)


@pytest.mark.parametrize(
    ("stated", "best_score", "best", "without", "refuted"),
    [
        (0.021, 0.010, UP_BACK, 0.1, True),  # twice as much and 1 % more
        (0.019, 0.010, UP_BACK, 0.1, False),
        (0.0120, 0.0045, UP_BACK, 0.1, False),  # less than 1 % more: three times are needed
        (0.0120, 0.0035, UP_BACK, 0.1, True),
        (0.0035, 0.0010, UP_BACK, 0.1, False),  # three times, but less than 0.3 % more
        (0.0045, 0.0014, UP_BACK, 0.1, True),
        (0.06, 0.05, NONE, 0.04, True),  # no better reading: beyond the bound and beyond no poses
        (0.06, 0.05, NONE, 0.07, False),
        (0.04, 0.035, NONE, 0.01, False),
        (math.nan, 0.01, UP_BACK, 0.1, True),
        (math.nan, math.nan, UP_BACK, 0.1, False),
    ],
)
def test_limits_of_a_contradiction(stated, best_score, best, without, refuted):
    assert check_of(stated, best_score, best, without).contradicts == refuted


def test_tracks_decide_where_they_are_decisive():
    opengl, small = PoseReading(PoseConvention("right_up_back")), PoseReading(PoseConvention(unit=1.025**4))
    sound = (0.01, 0.01)
    decisive = check_of(*sound, tracks=ReadingScores(0.9, 1.0, opengl, 0.3))
    assert decisive.by_tracks and decisive.contradicts and decisive.is_explained and decisive.best == opengl
    assert not check_of(*sound, tracks=ReadingScores(0.9, 1.0, opengl, 0.6)).contradicts, "not clearly better"
    assert not check_of(*sound, tracks=ReadingScores(0.15, 1.0, opengl, 0.01)).contradicts, "the stated poses are good"
    scale = check_of(*sound, tracks=ReadingScores(0.9, 1.0, small, 0.3), factor=1.2)
    assert not scale.contradicts and scale.factor == 1.025**4
    assert check_of(*sound, factor=1.2).factor == 1.2


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
        (1.1, 1.16, pose_check._MIN_DECIDING_PAIRS - 1, pose_check._MIN_DECIDING_PAIRS - 1, 1.0),
        (1.1, 1.16, pose_check._MIN_DECIDING_PAIRS, pose_check._MIN_DECIDING_PAIRS, 1.1),
    ],
)
def test_a_factor_near_1_is_distinguishable_by_most_of_enough_pairs(monkeypatch, factor, gain, better, pairs, found):
    monkeypatch.setattr(pose_check, "_FINE_FACTORS", (factor,))
    other = PoseReading(PoseConvention(unit=factor))
    flipped = PoseReading(PoseConvention("right_up_back"))
    stated = torch.full((pairs + 1,), 0.2)
    stated[pairs] = torch.nan  # a pair that the stated poses do not compare
    scaled = torch.where(torch.arange(pairs + 1) < better, 0.15, 0.25)
    median = torch.tensor([0.2 * gain / 1.16, 0.01, 0.2 / 1.16])
    columns = torch.stack((stated, torch.full_like(stated, 0.01), scaled), 1)
    assert other.is_small_factor and not flipped.is_small_factor
    assert pose_check._distinguishable_factor([NONE, flipped, other], median, columns) == pytest.approx(found)
