"""How far answers are from truth: per pair, per scene, over scenes.

The unit of evaluation is :class:`Points`: the candidates of a pair or scene, silent ones included, in one flat list.
Points are pooled inside a scene; scenes are joined by the median of their numbers and never by pooling. Whatever has
no value (no answer, no candidate, no variance) is None, which a result file writes as null.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.metrics import bootstrap
from dhtorch.metrics.correlation import pearson
from dhtorch.metrics.holdout import Truth
from dhtorch.pytree import Record, record
from dhtorch.records import Estimate

#: Metric name → None where undefined.
MetricValues = dict[str, float | None]

#: What names a row of a result rather than measuring it.
_ROW_KEYS = ("scene", "pair", "method")

#: An answer whose relative error is larger counts as silently wrong.
GROSS_ERROR_REL = 0.2


@record
class Points(Record):
    """Candidates: what was said about each and what is true. Floating fields are float64."""

    true_depth: Tensor  # (P,) m
    depth: Tensor  # (P,) m; NaN where silent
    score: Tensor  # (P,) larger is surer; the values need no meaning beyond their order
    keep: Tensor  # (P,) bool, answered
    sigma: Tensor  # (P,) m; NaN where silent or not stated
    residual_px: Tensor  # (P,) px; NaN where silent or not stated

    @property
    def error(self) -> Tensor:
        """(P,) relative error |z − z*| / z*; NaN where silent."""
        return (self.depth - self.true_depth).abs() / self.true_depth

    def answered(self) -> Points:
        """The points that were answered."""
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
    """The candidates among equally shaped arrays of any depth source, as one flat list.

    Args:
        depth: answers; a non-finite or non-positive one is silence.
        true_depth: what they are held against; a non-finite or non-positive one is no candidate.
        score: how sure the source is; None = equally sure everywhere.
        sigma: claimed standard deviation of depth; None = none claimed.
        residual_px: reprojection residual; None = none known.
        keep: answered; None = wherever there is a depth.
        candidate: what counts; None = wherever there is truth.

    Raises:
        ValueError: unequal shapes.
    """
    given = {"depth": depth, "score": score, "sigma": sigma, "residual_px": residual_px, "keep": keep}
    for name, value in {**given, "candidate": candidate}.items():
        if value is not None and value.shape != true_depth.shape:
            found, expected = tuple(value.shape), tuple(true_depth.shape)
            raise ValueError(f"make_points: {name} has shape {found}, expected {expected}, the shape of true_depth")
    counts = true_depth.isfinite() & (true_depth > 0)
    counts = counts if candidate is None else counts & candidate.bool()
    said = depth.isfinite() & (depth > 0)
    said = said if keep is None else said & keep.bool()

    def flat(value: Tensor | None, silent: float) -> Tensor:
        full = true_depth.new_full((), silent).double()
        return torch.where(said, full if value is None else value.detach().double(), silent)[counts]

    return Points(
        true_depth=true_depth.detach().double()[counts],
        depth=flat(depth, torch.nan),
        score=flat(torch.ones_like(true_depth) if score is None else score.nan_to_num(nan=0.0), 0.0),
        keep=said[counts],
        sigma=flat(sigma, torch.nan),
        residual_px=flat(residual_px, torch.nan),
    )


def points_from_estimate(
    estimate: Estimate,
    truth: Truth,
) -> Points:
    """The candidates of a batch of pairs as one flat list, pair after pair; index both by ``[b : b + 1]`` for one pair.

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
    """Coverage and error of the answers of a pair or scene.

    Returns:
        ``n_candidates``, ``n_kept``; ``coverage``, answered share of the candidates; and over the answered ones
        ``median_rel`` and ``p90_rel`` of the relative error, ``wrong_share`` (error > 20 %), ``corr`` (Pearson, of
        recovered and true depth), median ``residual_px``, ``within_sigma`` and ``within_2sigma`` (share whose error is
        at most one and two claimed standard deviations). None where undefined.
    """
    n = pooled.keep.numel()
    answered = pooled.answered()
    error, sigma = answered.error, answered.sigma
    off = (answered.depth - answered.true_depth).abs()
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
        "within_sigma": _share((off <= sigma)[stated]),
        "within_2sigma": _share((off <= 2 * sigma)[stated]),
    }


def summarise_scenes(
    scenes: Iterable[Mapping[str, Any]], *, statistic: str = "median", draws: int = 2000, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Scenes joined to one number per metric: the ``summary`` of a result.

    Args:
        scenes: the numbers of each scene (one row each); groups such as ``ms: {track: …}`` become ``ms.track``, and
            what is no number (names, lists, truth values) is passed over.
        statistic: ``median`` or ``mean`` over scenes. Counts (``n_…``) are added up and have no interval.
        draws, seed: of the bootstrap over scenes.

    Returns:
        Metric → ``{value, low, high, n, unit}``: a 95 % interval, n = scenes in which it is defined; value None where
        it is in none.
    """
    flat = [_flatten(scene) for scene in scenes]
    summary: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(name for scene in flat for name in scene):
        values = [scene.get(name) for scene in flat]
        if name.startswith("n_"):
            defined = [v for v in values if v is not None]
            found = bootstrap.Interval(sum(defined) if defined else None, None, None, len(defined))
        else:
            found = bootstrap.interval_over_scenes(values, statistic=statistic, draws=draws, seed=seed)
        summary[name] = found.entry(metric_unit(name))
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
        elif key in _ROW_KEYS:
            continue
        elif value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
            flat[prefix + key] = value
    return flat


def _quantile(x: Tensor, q: float) -> float | None:
    """Quantile with linear interpolation, of any number of values (``torch.quantile`` stops at 2²⁴)."""
    if not x.numel():
        return None
    place = q * (x.numel() - 1)
    low = int(place)
    ordered = x.sort().values
    a = float(ordered[low])
    b = float(ordered[min(low + 1, x.numel() - 1)])
    return a + (place - low) * (b - a)


def _share(mask: Tensor) -> float | None:
    return float(mask.double().mean()) if mask.numel() else None
