"""Metrics of stated uncertainty: bias by range, coverage of intervals, agreement of independent answers.

A sigma is judged by three numbers that do not replace each other: how often the truth lies in the interval of k
standard deviations, by how much answers of one range are off on average, and whether answers of the same points from
disjoint sets of source views differ by what their sigmas allow. The order that sigma gives answers is judged by AURC
and AUSE (:mod:`dhtorch.metrics.risk`).
"""

import math
from typing import NamedTuple

import torch

from dhtorch.metrics.errors import MetricValues, Points
from dhtorch.metrics.risk import ause, measure_risk
from dhtorch.records import Estimate, depth_interval

#: Ratio of the far to the near end of a range bin. Source: derived, 1.25 = ten bins a decade.
RANGE_BIN_RATIO = 1.25


class _RangeBias(NamedTuple):
    """Signed error of the answers whose true depth lies in one range bin."""

    low: float  # m
    high: float  # m
    n: int
    bias: float  # median of (z − z*) / z*
    mean: float  # mean of the same, each at most 1 in size


def range_bias(points: Points, *, min_answers: int = 200) -> list[_RangeBias]:
    """Bias in bins of true depth with edges at powers of :data:`RANGE_BIN_RATIO` m, from near to far.

    Bins with fewer than ``min_answers`` answers are left out. Bins of the *estimated* depth would show a bias without
    any: of symmetric errors the large ones are sorted into the far bins.
    """
    answered = points.answered()
    signed = (answered.depth - answered.true_depth) / answered.true_depth
    index = (answered.true_depth.log() / math.log(RANGE_BIN_RATIO)).floor().long()
    bins = []
    for k in index.unique().tolist():
        error = signed[index == k]
        if error.numel() >= min_answers:
            edges = RANGE_BIN_RATIO**k, RANGE_BIN_RATIO ** (k + 1)
            bins.append(_RangeBias(*edges, error.numel(), float(error.median()), float(error.clamp(-1, 1).mean())))
    return bins


def interval_coverage(points: Points, k: float) -> float | None:
    """Fraction of the answers with a sigma whose truth lies in :func:`dhtorch.records.depth_interval`; None = none."""
    answered = points.answered()
    stated = answered[answered.sigma.isfinite()]
    if not stated.depth.numel():
        return None
    low, high = depth_interval(stated.depth, stated.sigma, k)
    return float(((stated.true_depth >= low) & (stated.true_depth <= high)).double().mean())


def measure_uncertainty(points: Points) -> MetricValues:
    """``interval_1``, ``interval_2``: coverage at k = 1 and 2. ``aurc`` and ``ause``. ``worst_bias``: largest size of
    the bias of a range bin; ``n_bias_bins``: number of bins with enough answers. None where undefined."""
    bins = range_bias(points)
    return {
        "interval_1": interval_coverage(points, 1.0),
        "interval_2": interval_coverage(points, 2.0),
        "aurc": measure_risk(points)["aurc"],
        "ause": ause(points),
        "worst_bias": max((abs(b.bias) for b in bins), default=None),
        "n_bias_bins": len(bins),
    }


class _DisjointAgreement(NamedTuple):
    """Agreement of answers of the same samples from disjoint sets of source views; None without enough answers."""

    chi2: float | None  # mean squared difference of inverse depth over its variance: 1 where sigma is right
    chi2_median: float | None  # the same from the median, insensitive to gross errors
    n: int


def disjoint_agreement(one: Estimate, other: Estimate, *, min_answers: int = 20) -> _DisjointAgreement:
    """Reduced chi² of two estimates (B, N) of the same samples from disjoint source views.

    The difference of inverse depths is divided by both sigmas without their ``reference`` terms: both answers hang on
    the same near returns, so a wrong scale of the sensor cancels.
    """
    both = one.keep & other.keep & (one.sigma > 0) & (other.sigma > 0)
    if int(both.sum()) < min_answers:
        return _DisjointAgreement(None, None, int(both.sum()))
    parts = []
    for estimate in (one, other):
        depth = estimate.depth[both].double()
        variance = (estimate.sigma.square() - estimate.budget.reference)[both].double()
        parts.append((1 / depth, (variance / depth.square().square()).clamp_min(torch.finfo(torch.float64).tiny)))
    (q, variance), (p, other_variance) = parts
    square = (q - p).square() / (variance + other_variance)
    # 0.45…: the square of a standard normal variable that half of the draws exceed
    return _DisjointAgreement(float(square.mean()), float(square.median()) / 0.4549364231195724, square.numel())
