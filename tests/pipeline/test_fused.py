"""Sparse and swept answers joined: the rules on single answers, and the product on the built-in room."""

import pytest
import torch

from dhtorch.codes import Source, is_estimated
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import fused
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.presets import FUSED
from dhtorch.pytree import collate, stack
from dhtorch.synthetic import SyntheticRoom

NEAR = 2.0
METHOD = FUSED.replace(n=512, complete={"planes": 48})


def answers(depth: float, sigma_rel: float, *, keep: bool = True, n_views: int = 2) -> fused._Answers:
    """One answer of one sample."""
    q, sigma = (torch.tensor([[x]], dtype=torch.float64) for x in (1 / depth, sigma_rel))
    return fused._Answers(
        torch.tensor([[keep]]),
        q,
        sigma,
        0.5 * sigma,
        sigma / (n_views - 1) ** 0.5,
        torch.tensor([[n_views]]),
        sigma.expand(5, 1, 1) / 5**0.5,
    )


NONE = answers(1.0, 1.0, keep=False)
RULES = {"limits": (2.0, 3.0), "factors": (0.6, 2.0)}


def answers_of(*stated):
    return [NONE if one is None else answers(*one) for one in stated]


SURE, WIDE = (4.0, 0.02), (4.0, 0.04)
WEIGHT = 0.04**2 / (0.02**2 / 2 + 0.04**2)


@pytest.mark.parametrize(
    ("sparse", "swept", "depth", "expected"),
    [
        # sure and unsure answers of each kind; answers that agree become their weighted mean
        ((answers(4.0, 0.02, n_views=3), None), ((4.1, 0.04), None), 1 / (WEIGHT / 4.0 + (1 - WEIGHT) / 4.1), 0.6 * 0.02 / 2**0.5),
        # of answers that conflict the surer stands with less certainty, between agreement and conflict as it is
        ((WIDE, None), ((5.0, 0.02), None), 5.0, 2 * 0.02),
        ((SURE, None), ((4.3, 0.02), None), 4.0, 0.02),
        # an uncertain answer counts only where one of the other kind agrees
        ((None, (4.0, 0.25)), (None, None), None, None),
        ((None, (4.0, 0.05)), (None, (9.0, 0.05)), None, None),
        ((None, (4.0, 0.25)), (None, (4.4, 0.3)), 4.156, None),
        ((SURE, None), (None, (4.1, 0.3)), 4.0004, None),
        # one answer alone stays as it is
        (((4.0, 0.1), None), (None, None), 4.0, 0.1),
        ((None, None), ((4.0, 0.1), None), 4.0, 0.1),
    ],
)  # fmt: skip
def test_sparse_and_swept_answers_are_joined_by_rules(sparse, swept, depth, expected):
    sides = [[x if isinstance(x, fused._Answers) else answers_of(x)[0] for x in side] for side in (sparse, swept)]
    joint = fused._join(*sides, **RULES)
    assert bool(joint.keep) == (depth is not None)
    if depth is not None:
        w = joint.weight
        assert float(1 / (w * joint.sparse.q + (1 - w) * joint.swept.q)) == pytest.approx(depth, rel=1e-3)
    if expected is not None:
        assert float(joint.expected) == pytest.approx(expected)


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=12, hw=(240, 320), depth_hw=(240, 320), lidar="exact", image_noise=0.0)


@pytest.fixture(scope="module")
def views(room):
    """A reference view whose returns end at two metres, and the other views."""
    return range_split(room[3], NEAR), stack([range_split(room[k], NEAR) for k in (0, 6, 9, 11)])


@pytest.fixture(scope="module")
def found(views):
    trace = {}
    with torch.no_grad():
        estimate = METHOD(*views, trace=trace)
    return estimate, trace


def test_the_joint_estimate_answers_what_either_answers_and_keeps_the_samples_with_returns(found):
    estimate, trace = found
    sparse, samples = trace["sparse"], trace["samples"]
    open_ = ~samples.usable
    assert bool(estimate.keep[open_ & sparse.keep].all())
    assert int((estimate.keep & open_).sum()) > 1.1 * int((sparse.keep & open_).sum())
    for name in ("depth", "sigma", "gate", "n_views", "score"):
        torch.testing.assert_close(getattr(estimate, name)[~open_], getattr(sparse, name)[~open_], equal_nan=True)
    kept = estimate.keep
    assert bool((estimate.sigma[kept] > 0).all()) and bool((estimate.sigma_shared <= estimate.sigma)[kept].all())
    assert bool((estimate.score[~kept] == 0).all()) and bool(estimate.depth[~kept].isnan().all())


def test_the_joint_errors_are_no_larger_and_lie_as_often_within_sigma(room, found):
    estimate, trace = found
    truth = room[3].depth[0]
    uv = trace["samples"].uv[0].round().long()
    true = truth[uv[:, 1], uv[:, 0]]
    both = (estimate.keep & trace["sparse"].keep & ~trace["samples"].usable)[0] & (true > NEAR)
    error, before = ((x.depth[0] - true).abs()[both] / true[both] for x in (estimate, trace["sparse"]))
    assert both.sum() > 50 and float(error.median()) <= 1.05 * float(before.median())
    within, within_before = (
        float(((x.depth[0] - true).abs() < 2 * x.sigma[0])[both].float().mean()) for x in (estimate, trace["sparse"])
    )
    assert within >= within_before - 0.05


def test_the_map_has_returns_swept_pixels_and_joint_answers_at_samples(views, found):
    estimate, trace = found
    depth_map, samples = trace["dense"], trace["samples"]
    sensed = depth_map.source == Source.SENSOR
    torch.testing.assert_close(depth_map.depth[sensed], views[0].depth[sensed])
    assert bool((depth_map.source == Source.RECOVERED).any()) and bool((depth_map.source == Source.SWEPT).any())
    uv = samples.uv[0].round().long()
    at = depth_map.map(lambda x: x[:, uv[:, 1], uv[:, 0]])
    joint = (at.source == Source.RECOVERED) & estimate.keep & ~samples.usable
    shares = (at.depth == estimate.depth)[joint].float().mean()  # several samples may share a pixel
    assert joint.sum() > 10 and float(shares) > 0.9
    answered = depth_map.keep
    assert bool((answered == (sensed | is_estimated(depth_map.source))).all())


def test_complete_depth_and_the_method_give_one_product(views, found):
    estimate, trace = found
    again = {}
    with torch.no_grad():
        depth_map = complete_depth(*views, method=METHOD, planes=48, trace=again)
    for name in ("depth", "sigma", "score", "source", "gate"):
        assert torch.equal(getattr(depth_map, name).nan_to_num(), getattr(trace["dense"], name).nan_to_num()), name
        if name != "source":
            assert torch.equal(getattr(again["fused"], name).nan_to_num(), getattr(estimate, name).nan_to_num()), name


@pytest.mark.slow
def test_a_batch_is_a_loop_bit_for_bit(room, views):
    reference = range_split(room[4], NEAR)
    others = stack([range_split(room[k], NEAR) for k in (1, 7, 10, 11)])
    with torch.no_grad():
        together = METHOD(collate([views[0], reference]), collate([views[1], others], dim=1))
        alone = [METHOD(views[0], views[1]), METHOD(reference, others)]
    for b, one in enumerate(alone):
        for name in ("depth", "sigma", "score", "gate"):
            assert torch.equal(getattr(together, name)[b : b + 1].nan_to_num(), getattr(one, name).nan_to_num()), name


def test_joint_depth_carries_gradients(views):
    reference, others = views
    image, depth = reference.image.float(), reference.depth
    image = image / 255 if reference.image.dtype == torch.uint8 else image
    image, depth = (x.clone().requires_grad_() for x in (image, depth))
    estimate = METHOD(reference.replace(image=image, depth=depth), others)
    estimate.depth[estimate.keep].sum().backward()
    for x in (image, depth):
        assert bool(x.grad.isfinite().all()) and bool((x.grad != 0).any())
