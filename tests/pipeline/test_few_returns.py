"""A sensor with few returns: samples are added where these are, for the previews' poses and for the pose itself."""

import math

import pytest
import torch

from dhtorch.pipeline.pair import add_pose_samples, sample_returns
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pipeline.view_selection import select_views_by_preview
from dhtorch.pytree import collate, stack
from dhtorch.synthetic import SyntheticRoom

#: ``AUTO`` without added samples and what came with them.
AUTO_2 = AUTO.replace(
    verify_views=None, guide=None, pose_samples=0, select_views={"near": 0, "prefer_tracked": False, "reserve": 0}
)

#: The first candidates see what the reference view sees, the last do not.
CANDIDATES = (1, 3, 4, 5, 6, 8, 10, 12)


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=13, hw=(120, 160), step_m=0.12, supersample=1)


@pytest.fixture(scope="module")
def sparse(room):
    """Reference view with a return in one of seventy pixels: 14 of 2048 samples have one."""
    reference = room[2]
    kept = torch.rand(reference.depth.shape, generator=torch.Generator().manual_seed(0)) < 0.015
    return reference.replace(depth=torch.where(kept, reference.depth, 0.0))


@pytest.fixture(scope="module")
def candidates(room):
    return stack([room[k] for k in CANDIDATES])


def test_previews_have_poses_where_samples_are_drawn_at_returns(sparse, candidates):
    assert 3 <= int(AUTO.sample_depth(sparse).usable.sum()) <= 70
    assert select_views_by_preview(sparse, candidates, 2, near=0).no_answer.all()
    selection = select_views_by_preview(sparse, candidates, 2)
    assert not selection.no_answer[selection.index[:, 0], 0].any() and (selection.gain > 0).all()


def test_a_reference_view_with_few_returns_answers_where_a_fixed_gap_does(room, sparse, candidates):
    fixed, estimate = MAP(sparse, room[3]), AUTO.replace(views=2)(sparse, candidates)
    assert int(estimate.keep.sum()) > 0.8 * int(fixed.keep.sum()) > 800
    truth = room.truth(2)["depth"][0]
    u, v = estimate.uv[0].round().long().unbind(-1)
    error = (estimate.depth[0] / truth[v, u] - 1).abs()[estimate.keep[0]]
    assert float(error.median()) < 0.03


def test_samples_at_returns_are_spread_and_have_depth(room, sparse):
    every = sample_returns(MAP, sparse, 64)
    used = every.trackability > 0
    assert every.usable[used].all() and int(used.sum()) == 64
    assert len(torch.unique(every.uv[0], dim=0)) == 64
    half = every.uv[0].mean(0) / torch.tensor([160.0, 120.0])
    assert bool(((half - 0.5).abs() < 0.15).all()), "no part of the image is preferred"
    left = torch.arange(sparse.depth.shape[-1]) < 16
    few = sparse.replace(depth=torch.where(left, sparse.depth, 0.0))
    n_few = int((sample_returns(MAP, few, 64).trackability > 0).sum())
    assert 0 < n_few < 64


def test_views_with_enough_returns_are_not_changed_by_others_of_their_batch(room, sparse):
    method = AUTO.replace(n=512)
    full = room[2]
    assert add_pose_samples(method, full, method.sample_depth(full)).uv.shape[1] == 512
    both = collate([full, sparse])
    assert add_pose_samples(method, both, method.sample_depth(both)).uv.shape[1] > 512
    others = stack([collate([room[k], room[k]]) for k in (3, 4)])
    alone, together = method(full, [room[3], room[4]]), method(both, others)
    assert alone.uv.shape == (1, 512, 2) and together.uv.shape == (2, 512, 2)
    for field in ("depth", "sigma", "score", "gate"):
        one, two = getattr(alone, field)[0], getattr(together, field)[0]
        assert torch.equal(one.nan_to_num(-math.pi), two.nan_to_num(-math.pi)), field


def test_a_pair_uses_added_samples_for_its_pose_alone(room, sparse):
    method, trace = MAP.replace(pose_samples=256), {}
    before, after = MAP(sparse, room[3], trace={}), method(sparse, room[3], trace=trace)
    assert before.uv.shape == after.uv.shape and trace["tracks"].uv_1.shape == after.uv.shape
    assert trace["fit"].inlier.shape == after.gate.shape
    assert int(trace["fit"].n_inlier) > 3 * int(MAP.sample_depth(sparse).usable.sum())
