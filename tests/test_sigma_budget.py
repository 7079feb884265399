"""The budget of sigma by cause and its intervals: sums, single causes, gradients, on the rules and on the room."""

import pytest
import torch

from dhtorch.codes import Cause, Source
from dhtorch.metrics.calibration import SigmaModel
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.presets import METHODS
from dhtorch.pytree import stack
from dhtorch.records import SigmaBudget, depth_interval
from dhtorch.synthetic import SyntheticRoom

NEAR = 2.0


@pytest.fixture(scope="module")
def views():
    room = SyntheticRoom(
        n_frames=12, hw=(120, 160), depth_hw=(120, 160), seed=3, lidar="exact", image_noise=0.0, supersample=1
    )
    return range_split(room[3], NEAR), stack([range_split(room[k], NEAR) for k in (0, 6, 9, 11)])


@pytest.fixture(scope="module")
def answers(views):
    """Estimates by method name, and the calibrated map of the last."""
    found = {}
    with torch.no_grad():
        for name in ("paper", "kornia", "map", "several", "auto", "fused"):
            method = {**METHODS, "several": METHODS["map"].replace(views=5)}[name]
            method = method.replace(n=512, **({"complete": {"planes": 48}} if name == "fused" else {}))
            found[name] = method(views[0], views[1] if method.views > 1 else views[1][3])
        found["plain"] = complete_depth(*views, method=method, planes=48)
        found["calibrated"] = complete_depth(*views, method=method, planes=48, calibration=default_calibration())
    return found


def total(budget: SigmaBudget) -> torch.Tensor:
    return sum(budget.values())


@pytest.mark.parametrize("name", ["paper", "kornia", "map", "several", "auto", "fused", "plain", "calibrated"])
def test_the_terms_sum_to_the_square_of_sigma_and_are_empty_where_unanswered(answers, name):
    answer = answers[name]
    budget, keep = answer.budget, answer.keep
    assert int(keep.sum()) > 300
    torch.testing.assert_close(total(budget)[keep], answer.sigma.square()[keep], rtol=2e-6, atol=0.0)
    assert all(bool((x[keep] >= 0).all()) and bool(x[~keep].isnan().all()) for x in budget.values())
    assert bool((budget.dominating[~keep] == Cause.NONE).all()) and bool((budget.dominating[keep] >= Cause.TRACK).all())
    largest = torch.stack(budget.values()).amax(0)
    assert torch.equal((budget.track == largest)[keep], (budget.dominating == Cause.TRACK)[keep])
    if name in ("plain", "calibrated"):
        keep = keep & ((answer.source == Source.RECOVERED) | (answer.source == Source.SWEPT))
    torch.testing.assert_close(total(answer.parts)[keep], answer.sigma.square()[keep], rtol=5e-6, atol=0.0)


def test_the_shared_part_is_all_but_track_and_model(answers):
    for name in ("paper", "map"):
        answer = answers[name]
        budget, keep = answer.budget, answer.keep
        shared = (budget.pose + budget.reference + budget.lens)[keep]
        torch.testing.assert_close(shared, answer.sigma_shared.square()[keep], rtol=1e-5, atol=1e-12)
        assert bool((budget.reference[keep] > 0).all()) == (name == "map")
        assert not bool(budget.lens[keep].any()) and not bool(budget.model[keep].any())
    assert bool((answers["auto"].budget.lens[answers["auto"].keep] > 0).all())


def test_a_return_is_all_reference_and_a_filled_pixel_all_model(answers):
    depth_map = answers["plain"]
    budget = depth_map.budget
    for source, term in ((Source.SENSOR, budget.reference), (Source.FILLED, budget.model)):
        at = depth_map.source == source
        assert bool(at.any())
        torch.testing.assert_close(term[at], depth_map.sigma.square()[at])
    assert bool((depth_map.replace(parts=None).budget.model > 0)[depth_map.source == Source.SWEPT].all())


def test_of_a_calibrated_map_the_model_has_what_the_calibration_adds(answers):
    at = (answers["plain"].source == Source.SWEPT) & (answers["calibrated"].source == Source.SWEPT)
    before, after = answers["plain"].budget.track[at], answers["calibrated"].budget.track[at]
    scale = default_calibration().sigma.scale
    torch.testing.assert_close(after, min(scale, 1.0) ** 2 * before, rtol=1e-4, atol=0.0)
    model, sigma = SigmaModel(2.0, 0.01), torch.tensor([0.1])
    wide = model(sigma, torch.tensor([3.0]))
    parts = model.corrected_parts(SigmaBudget.single("pose", sigma.square()), sigma, wide)
    assert float(parts.pose) == pytest.approx(0.01) and float(parts.model) == pytest.approx(0.03 + 0.03**2)


def test_the_interval_is_symmetric_in_inverse_depth():
    depth, sigma = torch.tensor([4.0, 4.0, 4.0, torch.nan]), torch.tensor([0.4, 2.0, 3.0, torch.nan])
    low, high = depth_interval(depth, sigma, 2.0)
    torch.testing.assert_close(1 / low[:1] - 1 / depth[:1], 1 / depth[:1] - 1 / high[:1])
    assert float(1 / low[0] - 0.25) == pytest.approx(2 * 0.4 / 16)
    assert high[1].isinf() and high[2].isinf() and low[3].isnan() and high[3].isnan()
    one, _ = depth_interval(depth, sigma, 1.0)
    assert bool((one[:3] > low[:3]).all())


def test_the_budget_is_differentiable(views):
    method = METHODS["map"].replace(n=256)
    image = (views[1].image[3] / 255).requires_grad_()
    estimate = method(views[0], views[1][3].replace(image=image))
    budget, keep = estimate.budget, estimate.keep
    for term in (budget.track, budget.pose):
        (gradient,) = torch.autograd.grad(term[keep].sum(), image, retain_graph=True)
        assert bool(gradient.isfinite().all()) and bool(gradient.any())
    low, high = estimate.interval()
    (gradient,) = torch.autograd.grad((high - low)[keep & high.isfinite()].sum(), image)
    assert bool(gradient.isfinite().all()) and bool(gradient.any())
