"""Dense maps beside their peers: who is judged where, what is divided by what, and peers that are right in a room."""

import pytest
import torch

from dhtorch import MAP
from dhtorch.codes import Gate, Source
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments.baselines import stereo
from dhtorch.experiments.compare import dense_comparison
from dhtorch.experiments.protocol import Outcome
from dhtorch.geometry import se3
from dhtorch.metrics import errors
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.records import DepthMap
from dhtorch.synthetic import SyntheticRoom

NEAR = 2.0
METHOD = MAP.replace(n=768)


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(120, 160), depth_hw=(120, 160), lidar="exact", image_noise=0.0, name="hall")


@pytest.fixture(scope="module")
def pair(room):
    """A reference view, another view that lies beside it, the motion that the room knows, and a grid of samples."""
    reference, other = room[3], room[11]
    grid = METHOD.backproject(range_split(reference, NEAR), dense.map_pixel_centres(reference, (40, 53)))
    return (
        range_split(reference, NEAR),
        other,
        dense_comparison.exact_pose_fit(reference, other, 1).T_1_from_0,
        grid,
        reference,
    )


def test_a_turn_is_counted_by_its_holes():
    whole = {"scene": "carousel", "method": "dense", "truth": "full", "pair": None, "role": "rotation"}
    pairs = [whole | {"pair": [k, k + 1], "role": None, "n_holes": 100, "n_recovered": n} for k, n in ((0, 1), (1, 4))]
    others = [pairs[0] | {"method": "sgbm"}, pairs[0] | {"truth": "rectifiable"}, pairs[0] | {"scene": "hall"}]
    (found,) = compare.rotation_answered([whole, *pairs, *others], ["dense"]).values()
    assert found["value"] == pytest.approx(5 / 200) and found["n"] == 1
    both = compare.rotation_answered([whole, *pairs, *others], ["dense", "sgbm"])
    assert both["dense.rotation_answered"]["value"] == pytest.approx(6 / 300), "seeds of a method are pooled"
    assert compare.rotation_answered(pairs, ["dense"])["dense.rotation_answered"]["value"] is None


def test_convoys_are_counted_by_their_role():
    depth = torch.tensor([1.0] * 6 + [1.3] * 2 + [torch.nan] * 2)
    points = errors.make_points(depth, torch.ones_like(depth))
    names = [
        ("cars", "dense", "full"),
        ("cars", "sgbm", "full"),
        ("cars", "dense", "rectifiable"),
        ("hall", "dense", "full"),
    ]
    rows = [{"scene": "cars", "role": "moving"}, {"scene": "hall", "role": None}]
    moving = dense_comparison._moving_points(Outcome(rows=rows, points=dict.fromkeys(names, points)))
    assert len(moving) == 1 and moving[0][0] is points
    found = compare.worst_wrong_share("dense", moving)["dense.convoy_wrong"]
    assert found["value"] == pytest.approx(0.2) and found["n"] == 1


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("tipped", [False, True])
def test_rectified_matching_is_right_whichever_way_the_other_camera_lies(room, mirrored, tipped):
    reference, other = (room[k] for k in ((11, 3) if mirrored else (3, 11)))
    T = dense_comparison.exact_pose_fit(reference, other, 1).T_1_from_0
    if tipped:  # both cameras rolled by a right angle: the other view is above or below
        reference, other = (rolled(frame) for frame in (reference, other))
        roll = se3.exp(torch.tensor([[0.0, 0.0, torch.pi / 2, 0.0, 0.0, 0.0]]))
        T = se3.compose(roll, se3.compose(T, se3.invert(roll)))
    grid = METHOD.backproject(reference, dense.map_pixel_centres(reference, (40, 40)))
    found = stereo.match_semi_global(reference, other, T, grid, nearest_m=torch.tensor([1.4]))
    truth = _truth(reference, grid)
    keep = found.keep & (truth > NEAR)
    error = ((found.depth - truth).abs() / truth)[keep]
    assert keep.sum() > 200 and float(error.median()) < 0.05


def rolled(frame):
    """The same view from a camera rolled by a right angle: x is where y was, y where -x was."""
    f, c = frame.camera.f, frame.camera.c
    camera = frame.camera.replace(f=f.flip(-1), c=torch.stack([frame.hw[0] - 1 - c[:, 1], c[:, 0]], -1))
    image, depth = (x.transpose(-1, -2).flip(-1) for x in (frame.image, frame.depth))
    return frame.replace(image=image, depth=depth, camera=camera, depth_camera=None, conf=None)


def test_flow_is_triangulated_and_bilateral_filling_guesses(pair):
    near, other, T, grid, exact = pair
    truth = _truth(exact, grid)
    flow = stereo.match_optical_flow(near, other, T, grid)
    keep = flow.keep & (truth > NEAR)
    assert keep.sum() > 200 and float(((flow.depth - truth).abs() / truth)[keep].median()) < 0.06
    filled = stereo.fill_bilateral(near, grid)
    at = grid.usable
    assert bool(filled.keep.all()) and float((filled.depth - truth).abs()[at].median()) < 0.1
    assert bool((filled.score[at].mean() > filled.score[~at].mean()).all()), "what was carried far is less sure"
    lost = se3.identity(1, torch.zeros(1)).map(lambda x: x * torch.nan)
    for silent in (
        stereo.match_optical_flow(near, other, lost, grid),
        stereo.match_semi_global(near, other, lost, grid, nearest_m=truth[:, 0]),
    ):
        assert bool((silent.gate == Gate.NO_POSE).all()) and bool(silent.depth.isnan().all())


def test_views_before_each_other_cannot_be_rectified(pair):
    near, other, _, grid, _ = pair
    ahead = se3.exp(torch.tensor([[0.0, 0.0, 0.0, 0.01, 0.0, -0.2]]))
    beside = se3.exp(torch.tensor([[0.0, 0.0, 0.0, 0.2, 0.0, -0.01]]))
    views = (near.camera, near.hw), (other.camera, other.hw)
    assert [bool(stereo.is_epipole_inside(views, T)) for T in (ahead, beside)] == [True, False]
    silent = stereo.match_semi_global(near, other, ahead, grid, nearest_m=torch.tensor([1.4]))
    assert bool((silent.gate == Gate.NO_BASELINE).all())


def test_a_map_is_read_at_the_nearest_pixel_and_the_sensor_is_no_answer(pair):
    near, _, _, grid, _ = pair
    h, w = 30, 40
    depth = torch.arange(h * w, dtype=torch.float32).view(1, h, w) + 1
    source = torch.full((1, h, w), Source.SWEPT, dtype=torch.int32)
    source[:, :, :20] = Source.SENSOR
    found = DepthMap(depth, 0.1 * depth, torch.full_like(depth, 0.5), source, torch.zeros_like(source))
    got = dense_comparison.sample_map(found, grid, near)
    u, v = ((grid.uv[0, :, k] + 0.5) / 4 - 0.5 for k in (0, 1))
    right = u > 19.6
    expected = (v.round().clamp(0, h - 1) * w + u.round().clamp(0, w - 1) + 1)[right]
    assert torch.equal(got.keep[0], (u + 0.5).floor() > 19.5)
    inner = got.keep[0][right] & ((u[right] % 1 - 0.5).abs() > 0.01) & ((v[right] % 1 - 0.5).abs() > 0.01)
    assert torch.equal(got.depth[0][right][inner], expected[inner])


def test_rooms_are_judged_where_both_views_see_texture(room):
    reference, other = room[3], room[11]
    odd = torch.zeros(1, 120, 160, dtype=torch.bool)
    asked = dense_comparison.evaluated_pixels(reference, other, odd)
    assert 500 < asked.sum() < 0.9 * asked.numel() and bool((reference.depth[asked] > NEAR).all())
    odd[:, :, 80:] = True
    assert not bool(dense_comparison.evaluated_pixels(reference, other, odd)[:, :, 76:].any())
    away = other.replace(depth=0.5 * other.depth)
    assert not bool(dense_comparison.evaluated_pixels(reference, away, odd).any()), "another surface stands before it"


def _truth(exact, grid):
    u, v = grid.uv[0].round().long().unbind(-1)
    return exact.depth[:, v.clamp(0, exact.depth.shape[-2] - 1), u.clamp(0, exact.depth.shape[-1] - 1)]
