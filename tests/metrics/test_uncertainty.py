"""Coverage of intervals, bias by range and agreement of disjoint views, on drawn answers whose errors are known."""

import math

import pytest
import torch

from dhtorch.metrics.errors import make_points
from dhtorch.metrics.uncertainty import (
    RANGE_BIN_RATIO,
    disjoint_agreement,
    interval_coverage,
    measure_uncertainty,
    range_bias,
)
from dhtorch.records import Estimate, SigmaBudget


def draw(n, seed):
    return torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def points(n=20000, stated=1.0, scale=1.0):
    """Answers with a normal error of 4 % in inverse depth, whose sigma is ``stated`` times that."""
    true = torch.linspace(2.0, 6.0, n, dtype=torch.float64)
    q = (1 + 0.04 * draw(n, 0)) / true
    depth = scale / q
    return make_points(depth, true, sigma=stated * 0.04 / true * depth.square())


@pytest.mark.parametrize(("k", "share"), [(1, 0.683), (2, 0.954)])
def test_intervals_of_a_true_sigma_hold_what_a_normal_error_holds(k, share):
    assert interval_coverage(points(), k) == pytest.approx(share, abs=0.01)
    assert interval_coverage(points(stated=0.5), 2 * k) == pytest.approx(share, abs=0.01)


def test_without_a_sigma_there_is_no_coverage_and_without_answers_no_number():
    unstated = points().replace(sigma=torch.full((20000,), torch.nan, dtype=torch.float64))
    assert interval_coverage(unstated, 2) is None
    some = torch.cat((torch.full((10000,), 1e-9), torch.full((10000,), torch.nan))).double()
    assert interval_coverage(points().replace(sigma=some), 2) == 0
    nothing = points(n=3)[:0]
    assert measure_uncertainty(nothing) == {
        **dict.fromkeys(("interval_1", "interval_2", "aurc", "ause", "worst_bias")),
        "n_bias_bins": 0,
    }


def test_bias_is_that_of_the_range_and_small_bins_are_left_out():
    far = points(scale=1.03)
    bins = range_bias(far)
    everything = range_bias(far, min_answers=1)
    assert len(bins) == 5 and len(everything) == 6, "the last bin has the answers from 5.96 m to 6 m"
    assert everything[:5] == bins and 100 < everything[5].n < 200
    assert all(b.high == pytest.approx(RANGE_BIN_RATIO * b.low) for b in bins)
    assert all(b.bias == pytest.approx(0.03, abs=0.005) for b in bins)
    assert sum(b.n for b in everything) == 20000 and bins[0].low < 2.0 < bins[0].high and everything[5].high > 6.0
    assert measure_uncertainty(far)["worst_bias"] == max(abs(b.bias) for b in bins)
    gross = far.replace(depth=torch.where(torch.arange(20000) % 10 == 0, 100.0, far.depth))
    assert range_bias(gross)[2].mean > 0.1 > range_bias(gross)[2].bias
    one = torch.tensor([2.2, 2.2, 2.2, 2.2], dtype=torch.float64)
    few = far[:4].replace(true_depth=one, depth=one * torch.tensor([0.5, 0.9, 1.1, 9.0]).double())
    (only,) = range_bias(few, min_answers=4)
    assert only.n == 4
    assert only.mean == pytest.approx((-0.5 - 0.1 + 0.1 + 1) / 4) and only.bias == pytest.approx(-0.1)


def estimate(seed, stated=1.0, common=0.0, n=4000):
    """Answers of 3 m with an own error of 2 % and a common one; sigma states both, the latter as ``reference``."""
    q = (1 + 0.02 * draw(n, seed) + common * draw(1, 99)) / 3
    depth = (1 / q)[None]
    variance = (0.02 * stated / 3) ** 2 * depth.square().square()
    scale = (common / 3) ** 2 * depth.square().square()
    zero = torch.zeros_like(depth)
    return Estimate(
        uv=torch.zeros(1, n, 2),
        depth=depth,
        sigma=(variance + scale).sqrt(),
        sigma_shared=scale.sqrt(),
        parallax_deg=zero,
        residual_px=zero,
        n_views=zero.int(),
        score=zero + 1,
        gate=zero.int(),
        parts=SigmaBudget(variance, zero, scale, zero, zero),
    )


def test_disjoint_views_agree_by_what_they_do_not_share():
    for common in (0.0, 0.1):
        right = disjoint_agreement(estimate(1, common=common), estimate(2, common=common))
        assert right.chi2 == pytest.approx(1, abs=0.08) and right.chi2_median == pytest.approx(1, abs=0.1)
        assert right.n == 4000
    bold = disjoint_agreement(estimate(1, stated=0.5), estimate(2, stated=0.5))
    assert bold.chi2 == pytest.approx(4, abs=0.3)
    few = estimate(2)
    few = few.replace(gate=torch.where(torch.arange(4000)[None] < 10, 0, 5).int())
    assert disjoint_agreement(estimate(1), few) == (None, None, 10)
    assert math.isfinite(bold.chi2_median)
