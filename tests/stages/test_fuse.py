"""Fusion of consistent views, against a loop over the points; contradictions, single views and views without an answer."""

import itertools
import math
from functools import partial

import pytest
import torch
from support.view_estimates import make_estimates, random_estimates

from dhtorch.codes import Gate
from dhtorch.geometry import camera as cam
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.patches import is_inside_picture
from dhtorch.pipeline import view_selection
from dhtorch.pipeline.view_selection import downscale_frame, select_views_by_preview
from dhtorch.pytree import collate, stack
from dhtorch.records import Frame, Pose, Tracks
from dhtorch.stages.fuse import fuse_consistent, inverse_variance
from dhtorch.stages.sample import spiral
from dhtorch.synthetic import open_room


def one_point(q, variance, weight_of, *, max_chi2, max_conflict_ratio):
    """Indices of the views that stand together, and whether the others silence them."""
    best, stand = -1.0, []
    for v in range(len(q)):
        side = [u for u in range(len(q)) if (q[u] - q[v]) ** 2 <= max_chi2 * (variance[u] + variance[v])]
        support = sum(weight_of[u] for u in side)
        if support > best:
            best, stand = support, side
    mine = sum(weight_of[u] for u in stand)
    return stand, sum(weight_of) - mine > max_conflict_ratio * mine


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"max_chi2": 1.0},
        {"max_conflict_ratio": 0.0},
        {"max_conflict_ratio": 10.0},
        {"sure_rel": 0.0},
        {"max_sigma_rel": 0.03},
        {"sure_rel_each": 0.01},
    ],
)
def test_views_are_joined_as_a_loop_over_points_joins_them(options):
    o = {
        "max_chi2": 9.0,
        "max_conflict_ratio": 0.25,
        "sure_rel": 0.05,
        "sure_rel_each": 0.08,
        "max_sigma_rel": 0.2,
    } | options
    views = random_estimates(spread=3.0, N=60)
    found = fuse_consistent(views, **options)
    seen = set()
    for b, k in itertools.product(range(2), range(60)):
        said = [v for v in range(4) if views.gate[v, b, k] == 0]
        depth, sigma, shared = (
            [float(getattr(views, name)[v, b, k]) for v in said] for name in ("depth", "sigma", "sigma_shared")
        )
        q = [1 / z for z in depth]
        whole = [(s / z**2) ** 2 for s, z in zip(sigma, depth, strict=True)]
        common = [(s / z**2) ** 2 for s, z in zip(shared, depth, strict=True)]
        own = [max(w - c, 1e-3 * w) for w, c in zip(whole, common, strict=True)]
        variance = [a + c for a, c in zip(own, common, strict=True)]
        weight = [1 / x for x in variance]
        gate = found.gate[b, k]
        if not said:
            assert gate == views.gate[-1, b, k] and found.n_views[b, k] == 1
            continue
        sure = [x * x / s for x, s in zip(q, variance, strict=True)]
        stand, against = one_point(
            q, variance, sure, max_chi2=o["max_chi2"], max_conflict_ratio=o["max_conflict_ratio"]
        )
        assert found.n_views[b, k] == len(stand) + 1
        total = sum(weight[u] for u in stand)
        mean = sum(weight[u] * q[u] for u in stand) / total
        chi2 = sum((q[u] - mean) ** 2 / variance[u] for u in stand) / max(len(stand) - 1, 1)
        alike = (sum(weight[u] * math.sqrt(own[u]) for u in stand) / total) ** 2
        both = (sum(weight[u] * math.sqrt(common[u]) for u in stand) / total) ** 2
        joint = math.sqrt((alike + both) * max(chi2, 1.0)) / mean**2
        expected = Gate.ANSWER
        if joint * mean > min(o["max_sigma_rel"], o["sure_rel_each"] * len(stand) if stand[1:] else o["sure_rel"]):
            expected = Gate.UNCERTAIN
        expected = Gate.INCONSISTENT if against else expected
        seen.add(int(expected))
        assert gate == expected
        if expected == Gate.ANSWER:
            assert float(found.depth[b, k]) == pytest.approx(1 / mean)
            assert float(found.sigma[b, k]) == pytest.approx(joint)
            assert float(found.sigma_shared[b, k]) == pytest.approx(math.sqrt(both * max(chi2, 1.0)) / mean**2)
            residual = sum(weight[u] * float(views.residual_px[said[u], b, k]) ** 2 for u in stand) / total
            assert float(found.residual_px[b, k]) == pytest.approx(math.sqrt(residual))
            assert found.parallax_deg[b, k] == max(views.parallax_deg[said[u], b, k] for u in stand)
        else:
            assert found.depth[b, k].isnan() and found.sigma[b, k].isnan() and found.score[b, k] == 0
    assert len(seen) >= 2


@pytest.mark.parametrize(
    ("depth", "sigma", "gate", "expected"),
    [
        # the reason is that of the view in which the point came furthest
        ([4.0] * 3, 0.1, [Gate.NO_TRACK, Gate.UNCERTAIN, Gate.NO_TRACK], Gate.UNCERTAIN),
        ([4.0] * 3, 0.1, [Gate.NO_POSE, Gate.NO_TRACK, Gate.NO_TRACK], Gate.NO_POSE),
        ([4.0] * 3, 0.1, [Gate.NO_TRACK] * 3, Gate.NO_TRACK),
        # a contradiction silences and an outvoted view does not
        ([4.0, 4.1, 4.05, 9.0], [0.1, 0.1, 0.1, 2.0], 0, Gate.ANSWER),
        ([4.0, 6.0], 0.1, 0, Gate.INCONSISTENT),
        ([4.0, 4.1, 6.0], 0.1, 0, Gate.INCONSISTENT),
        # one view alone must be sure, and what views share is not averaged out
        ([4.0, 1.0], [0.19, 1.0], [0, 2], Gate.ANSWER),
        ([4.0, 1.0], [0.21, 1.0], [0, 2], Gate.UNCERTAIN),
        ([4.0, 4.0], 0.5, 0, Gate.ANSWER),
        ([4.0, 4.0], 0.9, 0, Gate.UNCERTAIN),
    ],
)
def test_gates_of_one_point(depth, sigma, gate, expected):
    assert int(fuse_consistent(make_estimates(depth, sigma, gate=gate)).gate) == expected


def test_no_view_with_a_pose_is_the_reason_for_every_point():
    views = random_estimates(V=3, N=4)
    gate = torch.full_like(views.gate, int(Gate.NO_TRACK))
    gate[:, :, 0] = int(Gate.NO_POSE)
    assert bool((fuse_consistent(views.replace(gate=gate)).gate == Gate.NO_POSE).all())
    gate[1, :, 0] = int(Gate.UNCERTAIN)
    assert fuse_consistent(views.replace(gate=gate)).gate[0, 1:].tolist() == [Gate.NO_TRACK] * 3


def test_where_most_views_stand_still_none_is_used():
    views = random_estimates(V=5, B=2, N=6, unanswered=0.0, spread=0.1)
    for still, silenced in ((2, False), (3, True), (5, True)):
        gate = views.gate.clone()
        gate[:still, 1, 2] = Gate.NO_BASELINE
        found = fuse_consistent(views.replace(gate=gate), sure_rel=1.0)
        assert bool((found.gate[1] == Gate.NO_BASELINE).all()) == silenced and bool((found.gate[0] == 0).all())
    assert bool((fuse_consistent(views.replace(gate=gate), max_static_ratio=1.0, sure_rel=1.0).gate[0] == 0).all())


def test_a_single_partner_is_its_own_answer_and_none_is_refused():
    views = random_estimates(V=1, N=9)
    assert torch.equal(fuse_consistent(views).depth.nan_to_num(), views.depth[0].nan_to_num())
    with pytest.raises(ValueError, match="at least one view"):
        fuse_consistent(views[:0])


@pytest.mark.parametrize("fuse", [fuse_consistent, partial(inverse_variance, max_sigma_rel=None, max_chi2=1e9)])
def test_gradients_are_finite_and_right(fuse):
    views = random_estimates(N=6, spread=1.0)
    keep = fuse(views).keep
    assert int(keep.sum()) > 3

    def answer(depth, sigma):
        found = fuse(views.replace(depth=depth, sigma=sigma))
        return found.depth[keep], found.sigma[keep], found.residual_px[keep]

    depth, sigma = (x.nan_to_num(1.0).requires_grad_() for x in (views.depth, views.sigma))
    assert torch.autograd.gradcheck(answer, (depth, sigma), eps=1e-7, atol=1e-5)


# -------------------------------------------------------------------------------------------------- which views


@pytest.fixture(scope="module")
def room():
    return open_room(seed=1, n_frames=12, hw=(240, 320), near=2.0).recording


@pytest.mark.slow
def test_each_reference_of_a_batch_gets_its_own_views(room):
    references = [room[0], room[11]]
    others = [[room[k] for k in ks] for ks in ((1, 3, 6, 9), (10, 8, 5, 2))]
    both = select_views_by_preview(
        collate(references), stack([collate(list(pair)) for pair in zip(*others, strict=True)]), 2
    ).index
    for b in range(2):
        assert select_views_by_preview(references[b], stack(others[b]), 2).index[:, 0].tolist() == both[:, b].tolist()


def test_a_small_frame_sees_the_same_rays(room):
    frame: Frame = room[0]
    little, k = downscale_frame(frame, 80)
    assert k == 4 and little.hw == (60, 80)
    uv = torch.tensor([[[10.0, 20.0], [63.0, 5.0]]])
    torch.testing.assert_close(cam.rays(little.camera, uv), cam.rays(frame.camera, uv * k + (k - 1) / 2))
    assert downscale_frame(frame, 400)[1] == 1
    frame = frame.replace(depth_camera=None)
    own = cam.resize(frame.camera, frame.hw, (frame.depth.shape[-2], frame.depth.shape[-1]))
    kept = downscale_frame(frame, 80)[0].depth_camera
    assert torch.equal(kept.f, own.f) and torch.equal(kept.c, own.c), "the map is as large as it was"
    turned = own.replace(c=own.c + 3)
    assert downscale_frame(frame.replace(depth_camera=turned), 80)[0].depth_camera is turned


def test_a_small_picture_is_no_reason_to_be_less_sure(room):
    frames = [room[k] for k in (0, 2, 4, 6)]
    large, little = (
        select_views_by_preview(frames[0], stack(frames[1:]), 3, long=n, good_sigma_rel=1e-4) for n in (400, 160)
    )
    ratio = little.gain / large.gain
    assert bool((ratio > 1 / 3).all() and (ratio < 3).all()), ratio


def test_tracked_motion_is_that_of_valid_tracks_in_tenths_of_the_side():
    uv_0, none = torch.zeros(1, 2, 2), torch.zeros(1, 2)
    uv_1, valid = torch.tensor([[[3.0, 4.0], [30.0, 40.0]]]), torch.tensor([[True, False]])
    tracks = Tracks(uv_0, uv_1, none, none, torch.zeros(1, 2, 2, 2), valid)
    assert view_selection.tracked_motion(tracks, 50).tolist() == pytest.approx([math.log(2)])


def test_information_of_a_view_grows_with_the_turn_of_the_line_and_falls_where_it_is_not_recognised():
    camera = Camera(torch.tensor([[100.0, 110.0]]), torch.tensor([[50.0, 40.0]]))
    frame = Frame(torch.zeros(1, 1, 80, 100), torch.zeros(1, 80, 100), camera)
    motions = [[-0.4, 0.0, -1.0], [0.3, 0.1, -0.2], [torch.nan] * 3, [0.0, 0.0, -9.0]]
    T = Pose(torch.eye(3).expand(4, 1, 3, 3), torch.tensor(motions)[:, None])
    uv = spiral((80, 100), view_selection.PREVIEW_METHOD.n)
    points = torch.cat(((uv - camera.c) / camera.f, torch.ones(len(uv), 1)), -1) * 2
    gains = []
    for motion in motions:
        there = points + torch.tensor(motion)
        shown = (there[:, 2] > 0) & is_inside_picture(cam.project(camera, there[None]), frame.image)[0]
        turn = torch.nn.functional.cosine_similarity(points, there).clamp(-1, 1).acos()
        precision = 0.1 * turn * 100  # of tracks with a standard deviation of one pixel
        seen = (-0.5 * (turn / 0.2) ** 2).exp()
        gains.append(float(((precision * seen).square().where(shown, 0.0)).nan_to_num().double().log1p().sum()))
    frames = stack([frame] * 4)
    for k in (0, 1):
        alone = view_selection.select_views_by_pose(frame, frames[k : k + 1], 1, T[k : k + 1], torch.tensor([2.0]))
        assert float(alone.gain) == pytest.approx(gains[k], rel=1e-3)
    found = view_selection.select_views_by_pose(frame, frames, 2, T, torch.tensor([2.0]))
    assert found.index.flatten().tolist() == [0, 1] and gains[2] == gains[3] == 0
