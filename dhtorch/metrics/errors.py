"""Depth errors of estimates against the truth: per pair, per scene and over scenes.

The unit of evaluation is :class:`Points`: the candidates of a pair or scene, unanswered ones included, as a flat list.
Points are pooled within a scene; scenes are combined by the median of their values and never by pooling. Undefined
values (no answer, no candidate, no variance) are None, written to a result file as null.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.metrics.bootstrap import Interval, interval_over_scenes
from dhtorch.metrics.correlation import pearson
from dhtorch.metrics.holdout import Truth
from dhtorch.pytree import Record, record
from dhtorch.records import Estimate

#: Relative error below which an answer is good.
GOOD_ERROR_REL = 0.1


#: Metric name → value, None where undefined.
MetricValues = dict[str, float | None]

#: Relative error above which an answer is a gross error.
GROSS_ERROR_REL = 0.2


@record
class Points(Record):
    """Candidates with their estimated and true depth. Floating fields are float64."""

    true_depth: Tensor  # (P,) m
    depth: Tensor  # (P,) m; NaN where unanswered
    score: Tensor  # (P,) larger is more certain; only the order of the values matters
    keep: Tensor  # (P,) bool, answered
    sigma: Tensor  # (P,) m; NaN where unanswered or not stated
    residual_px: Tensor  # (P,) px; NaN where unanswered or not stated

    @property
    def error(self) -> Tensor:
        """(P,) relative error |z − z*| / z*; NaN where unanswered."""
        return (self.depth - self.true_depth).abs() / self.true_depth

    def answered(self) -> "Points":
        """The answered points."""
        return self[self.keep]


def make_points(
    depth: Tensor,  # (*) m
    true_depth: Tensor,  # (*) m
    score: Tensor | None = None,  # (*)
    *,
    sigma: Tensor | None = None,  # (*) m
    residual_px: Tensor | None = None,  # (*) px
    keep: Tensor | None = None,  # (*) bool
    candidate: Tensor | None = None,  # (*) bool
) -> Points:
    """Points of one pair or scene from equally shaped arrays of any depth source: its candidates as one flat list.

    Args:
        depth: estimates; non-finite or non-positive ones are unanswered.
        true_depth: ground truth; where it is not finite or not positive there is no candidate.
        score: confidence of the source; None = equal everywhere.
        sigma: stated standard deviation of depth; None = none stated.
        residual_px: reprojection residual; None = none stated.
        keep: answered; None = wherever depth is valid.
        candidate: evaluated; None = wherever the truth is valid.

    Raises:
        ValueError: unequal shapes.
    """
    arrays = {"depth": depth, "score": score, "sigma": sigma, "residual_px": residual_px, "keep": keep}
    for name, value in {**arrays, "candidate": candidate}.items():
        if value is not None and value.shape != true_depth.shape:
            shape, expected = tuple(value.shape), tuple(true_depth.shape)
            raise ValueError(f"make_points: {name} has shape {shape}, expected {expected}, the shape of true_depth")
    counts = true_depth.isfinite() & (true_depth > 0)
    counts = counts if candidate is None else counts & candidate.bool()
    is_answered = depth.isfinite() & (depth > 0)
    is_answered = is_answered if keep is None else is_answered & keep.bool()

    def flat(value: Tensor | None, fill: float) -> Tensor:
        full = true_depth.new_full((), fill).double()
        return torch.where(is_answered, full if value is None else value.detach().double(), fill)[counts]

    return Points(
        true_depth=true_depth.detach().double()[counts],
        depth=flat(depth, torch.nan),
        score=flat(torch.ones_like(true_depth) if score is None else score.nan_to_num(nan=0.0), 0.0),
        keep=is_answered[counts],
        sigma=flat(sigma, torch.nan),
        residual_px=flat(residual_px, torch.nan),
    )


def points_from_estimate(
    estimate: Estimate,
    truth: Truth,
) -> Points:
    """Points of a batch of pairs, pair after pair in one list; index both arguments by ``[b : b + 1]`` for one pair.

    Raises:
        ValueError: wrong shapes.
    """
    check("points_from_estimate", gate=(estimate.gate, "B N"), depth=(truth.depth, "B N"))
    return make_points(
        estimate.depth,
        truth.depth,
        estimate.score,
        sigma=estimate.sigma,
        residual_px=estimate.residual_px,
        keep=estimate.keep,
        candidate=truth.ok,
    )


def measure_errors(pooled: Points) -> MetricValues:
    """Coverage and errors of the answers of a pair or scene.

    Returns:
        ``n_candidates``, ``n_kept``; ``coverage``, answered fraction of the candidates; and over the answered ones
        ``median_rel`` and ``p90_rel`` of the relative error, ``wrong_share`` (fraction with an error > 20 %), ``corr``
        (Pearson, of recovered and true depth), median ``residual_px``, ``within_sigma`` and ``within_2sigma`` (fraction
        whose error is at most one and two stated standard deviations). None where undefined.
    """
    n = pooled.keep.numel()
    answered = pooled.answered()
    error, sigma = answered.error, answered.sigma
    error_m = (answered.depth - answered.true_depth).abs()
    stated = sigma.isfinite()
    return {
        "n_candidates": n,
        "n_kept": answered.keep.numel(),
        "coverage": answered.keep.numel() / n if n else None,
        "median_rel": _quantile(error, 0.5),
        "p90_rel": _quantile(error, 0.9),
        "wrong_share": _share(error > GROSS_ERROR_REL),
        "corr": pearson(answered.depth, answered.true_depth),
        "residual_px": _quantile(answered.residual_px[answered.residual_px.isfinite()], 0.5),
        "within_sigma": _share((error_m <= sigma)[stated]),
        "within_2sigma": _share((error_m <= 2 * sigma)[stated]),
    }


def summarise_scenes(
    scenes: Iterable[Mapping[str, Any]], *, statistic: str = "median", draws: int = 2000, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Metrics combined over scenes, with intervals: the ``summary`` of a result.

    Args:
        scenes: the metrics of each scene (one row each); groups such as ``ms: {track: …}`` become ``ms.track``, and
            values that are not numbers (names, lists, booleans) are ignored.
        statistic: ``median`` or ``mean`` over scenes. Counts (``n_…``) are added up and have no interval.
        draws, seed: of the bootstrap over scenes.

    Returns:
        Metric → ``{value, low, high, n, unit}``: a 95 % interval, n = scenes in which it is defined; value None if
        in none.
    """
    flat = [_flatten(scene) for scene in scenes]
    summary: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(name for scene in flat for name in scene):
        values = [scene.get(name) for scene in flat]
        if name.startswith("n_"):
            defined = [v for v in values if v is not None]
            interval = Interval(sum(defined) if defined else None, None, None, len(defined))
        else:
            interval = interval_over_scenes(values, statistic=statistic, draws=draws, seed=seed)
        summary[name] = interval.entry(metric_unit(name))
    return summary


def metric_unit(name: str) -> str:
    """Unit of a metric by its name: ``count``, ``px``, ``ms``, ``m``, ``deg`` or ``1``."""
    if name.startswith("n_"):
        return "count"
    if name.startswith("ms.") or name == "ms":
        return "ms"
    for suffix in ("px", "deg", "m"):
        if name.endswith(f"_{suffix}"):
            return suffix
    return "1"


def _flatten(row: Mapping[str, Any], prefix: str = "") -> dict[str, float | None]:
    flat: dict[str, float | None] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        elif key in ("scene", "pair", "method"):  # they identify a row of a result
            continue
        elif value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
            flat[prefix + key] = value
    return flat


def _quantile(x: Tensor, q: float) -> float | None:
    """Quantile with linear interpolation, of any number of values (``torch.quantile`` is limited to 2²⁴)."""
    if not x.numel():
        return None
    position = q * (x.numel() - 1)
    low = int(position)
    ordered = x.sort().values
    a = float(ordered[low])
    b = float(ordered[min(low + 1, x.numel() - 1)])
    return a + (position - low) * (b - a)


def _share(mask: Tensor) -> float | None:
    return float(mask.double().mean()) if mask.numel() else None
