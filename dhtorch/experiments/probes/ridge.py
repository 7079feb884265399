"""Linear probe: closed-form ridge regression from features to targets, with cross-validation and bootstrap intervals.

Ridge regression depends on the data only through means and scatter matrices. Shards of any length are therefore
accumulated one by one (:class:`MomentStream`) in memory quadratic in the number of features, and every penalty and
every selection of features is solved from the same moments. Features are standardised internally by their standard
deviation; a constant feature gets the weight 0.

Alphabet: N samples, F features, D targets, P penalties, G groups (tasks) that a split never divides; ``*`` any
leading dimensions. Penalties are per sample and in units of standardised features: the loss is the *mean* squared
error + penalty · |w|², so that one grid serves sets of all sizes (scikit-learn's ``alpha`` is N times as large).
"""

import math
from collections.abc import Sequence
from random import Random
from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.metrics import bootstrap
from dhtorch.metrics.bootstrap import Interval
from dhtorch.pytree import Record, record

#: Lower bound of the penalty, which keeps the normal equations solvable if features are linearly dependent.
_MIN_PENALTY = 1e-12

#: A feature whose standard deviation is a smaller fraction of its mean counts as constant: the rest is rounding error.
_MIN_RELATIVE_SPREAD = 1e-9

#: Confidence level of the interval of the equivalence test: two one-sided tests at 5 % each.
EQUIVALENCE_LEVEL = 0.90


@record
class SampleMoments(Record):
    """Sufficient statistics of ridge regression: count, means and scatter matrices of samples; float64."""

    n: Tensor  # (*,) number of samples with finite values
    x: Tensor  # (*, F) mean of the features
    y: Tensor  # (*, D) mean of the targets
    xx: Tensor  # (*, F, F) sum of products of deviations from the mean
    xy: Tensor  # (*, F, D)
    yy: Tensor  # (*, D) sum of squared deviations


@record
class LinearProbe(Record):
    """Linear maps with bias from features to targets, one for each penalty; float64."""

    weight: Tensor  # (*, P, F, D), for features that are not standardised
    bias: Tensor  # (*, P, D)


class ProbeFold(NamedTuple):
    """Groups to train the probe on, to choose its penalty on, and to test it on."""

    train: tuple[str, ...]
    choose: tuple[str, ...]
    test: tuple[str, ...]


def compute_moments(x: Tensor, y: Tensor) -> SampleMoments:
    """Moments of samples (x, y): count, means and scatter; samples with a non-finite value are left out.

    Args:
        x: (*, N, F) features.
        y: (*, N, D) targets.

    Raises:
        ValueError: wrong shapes.

    Gradient: to x and y.
    """
    dx, dy, n, x_mean, y_mean = _centred(x, y)
    return SampleMoments(n, x_mean, y_mean, dx.mT @ dx, dx.mT @ dy, (dy * dy).sum(-2))


def join_moments(a: SampleMoments, b: SampleMoments) -> SampleMoments:
    """Moments of the union of two sets of samples from the moments of each.

    Raises:
        ValueError: different numbers of features or targets.

    Source: T. Chan, G. Golub, R. LeVeque, "Updating formulae and a pairwise algorithm for computing sample variances",
    1979.
    """
    check("join_moments", a_x=(a.x, "* F"), b_x=(b.x, "* F"), a_y=(a.y, "* D"), b_y=(b.y, "* D"))
    n = a.n + b.n
    share = b.n / n.clamp_min(1)
    between = (a.n * share)[..., None]
    dx, dy = b.x - a.x, b.y - a.y
    return SampleMoments(
        n,
        a.x + dx * share[..., None],
        a.y + dy * share[..., None],
        a.xx + b.xx + between[..., None] * dx[..., :, None] * dx[..., None, :],
        a.xy + b.xy + between[..., None] * dx[..., :, None] * dy[..., None, :],
        a.yy + b.yy + between * dy * dy,
    )


def select_features(of: SampleMoments, index: Tensor) -> SampleMoments:
    """Moments of the same samples restricted to the features ``index`` (f,) int64."""
    xx = of.xx.index_select(-1, index).index_select(-2, index)
    return of.replace(x=of.x.index_select(-1, index), xx=xx, xy=of.xy.index_select(-2, index))


class MomentStream:
    """Accumulates the moments of shards in place: F² numbers in memory, whatever the number of samples.

    Equal to :func:`compute_moments` of all shards together up to rounding. Followed by :func:`solve_ridge`, peak memory
    is four F × F matrices of float64 and a few copies of a shard: 3.3 GB measured for F = 10,000 in shards of 1,000. No
    gradients.
    """

    def __init__(self, features: int, targets: int, device: torch.device | str = "cpu") -> None:
        zeros = {"dtype": torch.float64, "device": device}
        F, D = features, targets
        self.moments = SampleMoments(*(torch.zeros(size, **zeros) for size in ((), (F,), (D,), (F, F), (F, D), (D,))))  # type: ignore[call-overload]

    @torch.no_grad()
    def add(self, x: Tensor, y: Tensor) -> None:
        """Add the features (N, F) and targets (N, D) of one shard.

        Raises:
            ValueError: wrong shapes.
        """
        m = self.moments
        check("MomentStream.add", x=(x, "N F"), y=(y, "N D"), features=(m.x, "F"), targets=(m.y, "D"))
        dx, dy, n, x_mean, y_mean = _centred(x, y)
        share = n / (m.n + n).clamp_min(1)
        delta_x, delta_y, between = x_mean - m.x, y_mean - m.y, float(m.n * share)
        m.xx.addmm_(dx.mT, dx).addr_(delta_x, delta_x, alpha=between)
        m.xy.addmm_(dx.mT, dy).addr_(delta_x, delta_y, alpha=between)
        m.yy.add_((dy * dy).sum(0)).add_(delta_y * delta_y, alpha=between)
        m.x.add_(delta_x * share)
        m.y.add_(delta_y * share)
        m.n.add_(n)


def solve_ridge(of: SampleMoments, penalty: Tensor) -> LinearProbe:
    """Ridge regressions with an intercept, one for each penalty: moments, penalties -> linear maps.

    Args:
        of: moments of the training samples.
        penalty: (P,), or (P, F) for a different penalty per feature. Values below :data:`_MIN_PENALTY` are raised to
            it.

    Returns:
        Linear maps. The weights are 0 without samples and for constant features.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the moments and the penalties.
    Cost: P Cholesky factorisations of F × F.
    Source: A. Hoerl, R. Kennard, "Ridge regression: biased estimation for nonorthogonal problems", 1970.
    """
    check("solve_ridge", x=(of.x, "* F"), xx=(of.xx, "* F F"), xy=(of.xy, "* F D"), y=(of.y, "* D"))
    F = of.x.shape[-1]
    if penalty.dim() not in (1, 2) or penalty.shape[1:] not in ((), (F,)):
        raise ValueError(f"solve_ridge: penalty has shape {tuple(penalty.shape)}, expected (P,) or (P, {F})")
    n = of.n.clamp_min(1)[..., None]
    variance = of.xx.diagonal(dim1=-2, dim2=-1) / n
    varies = variance > (_MIN_RELATIVE_SPREAD * of.x).square().clamp_min(1e-300)
    unit = torch.where(varies, torch.where(varies, variance, 1.0).rsqrt(), 0.0)
    gram = of.xx * (unit / n)[..., :, None] * unit[..., None, :]
    cross = of.xy * (unit / n)[..., None]
    weights = [_solve_gram(gram, p, cross) for p in penalty.to(gram).clamp_min(_MIN_PENALTY).unbind(0)]
    weight = torch.stack(weights, -3) if weights else cross.new_zeros(*cross.shape[:-2], 0, *cross.shape[-2:])
    weight = weight * unit[..., None, :, None]
    bias = of.y[..., None, :] - (weight * of.x[..., None, :, None]).sum(-2)
    return LinearProbe(weight, bias)


def predict_targets(linear: LinearProbe, x: Tensor) -> Tensor:
    """Predictions (*, P, N, D), float64, of every map of ``linear`` for features (*, N, F).

    Raises:
        ValueError: the numbers of features differ.
    """
    check("predict_targets", weight=(linear.weight, "* F D"), x=(x, "* N F"))
    return x.double()[..., None, :, :] @ linear.weight + linear.bias[..., None, :]


def make_folds(groups: Sequence[str], n: int = 5, *, seed: int = 0) -> list[ProbeFold]:
    """Cross-validation folds over groups: part k is for the test, part k + 1 for the penalty, the others for training.

    Args:
        groups: names; repeated ones count once.
        n: number of parts, filled in turn after a shuffle; at most the number of groups.
        seed: of the shuffle.

    Raises:
        ValueError: fewer than three groups or parts.
    """
    names = sorted(set(groups))
    n = min(n, len(names))
    if n < 3:
        raise ValueError(f"experiment.n_folds: found {n} parts of {len(names)} groups, expected at least three of each")
    Random(f"folds {seed}").shuffle(names)
    parts = [tuple(names[k::n]) for k in range(n)]
    return [
        ProbeFold(
            tuple(name for j in range(n) if j not in (k, (k + 1) % n) for name in parts[j]),
            parts[(k + 1) % n],
            parts[k],
        )
        for k in range(n)
    ]


def mean_squared_error(
    squares: Tensor, counts: Tensor, *, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> Interval:
    """Mean squared error over all samples, with a bootstrap interval from resampling groups.

    Args:
        squares, counts: (G,) sum of squared errors and number of samples of each group; groups without samples are
            left out.
        level, draws, seed: of the bootstrap.
    """
    check("mean_squared_error", squares=(squares, "G"), counts=(counts, "G"))
    return _bootstrap_quotient(squares, counts, counts > 0, level, draws, seed)


def error_ratio(ours: Tensor, theirs: Tensor, *, level: float = 0.95, draws: int = 2000, seed: int = 0) -> Interval:
    """Ratio of two errors on the same samples, with a paired bootstrap interval from resampling groups.

    Args:
        ours, theirs: (G,) sum of squared errors of each group; groups where both are 0 are left out.
        level, draws, seed: of the bootstrap.
    """
    check("error_ratio", ours=(ours, "G"), theirs=(theirs, "G"))
    return _bootstrap_quotient(ours, theirs, (ours > 0) | (theirs > 0), level, draws, seed)


def is_equivalent(interval: Interval, margin: float = 0.02) -> bool | None:
    """Equivalence test of a ratio to 1 within ``margin``: True, False, or None if the interval does not decide.

    True: the whole interval lies within the margin. False: the whole interval lies outside, on one side. With an
    interval of level :data:`EQUIVALENCE_LEVEL` the former is the usual pair of one-sided tests at 5 %.

    Source: D. Schuirmann, "A comparison of the two one-sided tests procedure …", 1987.
    """
    if interval.low is None or interval.high is None:
        return None
    if 1 - margin < interval.low and interval.high < 1 + margin:
        return True
    return False if interval.high < 1 - margin or interval.low > 1 + margin else None


def _centred(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Deviations of x and y from their means, number and means of the finite samples; float64."""
    check("compute_moments", x=(x, "* N F"), y=(y, "* N D"))
    if x.shape[:-1] != y.shape[:-1]:
        raise ValueError(
            f"compute_moments: x has shape {tuple(x.shape)}, y {tuple(y.shape)}, expected the same samples"
        )
    finite = (x.isfinite().all(-1) & y.isfinite().all(-1))[..., None]
    n = finite.sum((-2, -1)).double()
    parts = []
    for values in (x.double(), y.double()):
        kept = torch.where(finite, values, 0.0)
        mean = kept.sum(-2) / n.clamp_min(1)[..., None]
        parts += [torch.where(finite, kept - mean[..., None, :], 0.0), mean]
    return parts[0], parts[2], n, parts[1], parts[3]


def _solve_gram(gram: Tensor, penalty: Tensor, cross: Tensor) -> Tensor:
    """Solution of (gram + diag(penalty)) w = cross by Cholesky."""
    diagonal = gram.diagonal(dim1=-2, dim2=-1) + penalty
    lower, _ = torch.linalg.cholesky_ex(torch.diagonal_scatter(gram, diagonal, dim1=-2, dim2=-1))
    return torch.cholesky_solve(cross, lower)


def _bootstrap_quotient(
    numerator: Tensor, denominator: Tensor, valid: Tensor, level: float, draws: int, seed: int
) -> Interval:
    """Quotient of the sums over the valid groups, with its bootstrap interval."""
    numerator, denominator = numerator[valid].double(), denominator[valid].double()

    def quotient(index: Tensor) -> Tensor:
        total = denominator[index].sum(-1)
        return torch.where(total > 0, numerator[index].sum(-1) / total, math.nan)

    return bootstrap.interval_of_statistic(quotient, len(numerator), level=level, draws=draws, seed=seed)
