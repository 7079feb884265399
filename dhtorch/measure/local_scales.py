"""Local scales of a model -> its scale with a standard deviation, and the places where it has another one.

A local scale is the median ratio of sensor depth to model depth in one region of one picture. In a sound model all
local scales are equal but for noise. In a bent or drifting one they change along the recording, with range, over the
picture or from place to place; contrasts measure these changes, each with a standard deviation from the scatter between
frames. Errors that the sensor makes everywhere are common to all local scales and cancel in the contrasts.

Alphabet: ``C`` local scales, ``F`` frames, ``K`` contrasts; logarithms of scales, so that a difference is a ratio.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

#: Rows and columns of the regions of a picture. Source: chosen on: room 300 of scale_study, regions of at least
#: 25 returns with 400 samples in a picture.
REGIONS = (3, 4)

#: Fewest ratios of a local scale. Source: origin not recorded.
MIN_RATIOS = 6

#: Least standard deviation of a local scale, as a log ratio: errors that neighbouring returns share. Source: chosen on:
#: room 300 of scale_study.
SHARED_NOISE = 0.004

#: Standard deviation of a normal variable per median absolute deviation. Source: derived, 1 / Phi^-1(3/4).
SIGMA_OF_MAD = 1.4826

#: Standard deviation of a median per that of a mean. Source: derived, sqrt(pi / 2).
MEDIAN_LOSS = 1.2533


class LocalScales(NamedTuple):
    """Log scales of the regions of F pictures, ordered by frame."""

    frame: np.ndarray  # (C,) int64, 0 … F − 1
    region: np.ndarray  # (C,) int64, row by row
    log: np.ndarray  # (C,) log(sensor depth / model depth)
    sigma: np.ndarray  # (C,)
    depth: np.ndarray  # (C,) m, median sensor depth
    share: np.ndarray  # (C, 2) place in the picture, 0 … 1
    xyz: np.ndarray  # (C, 3) median place in the model's world, model units


@dataclass(frozen=True)
class ScaleFault:
    """A part of the model whose scale differs from that of the rest."""

    kind: str  # drift | bend | frames | range | picture | region | place
    where: str
    change: float  # relative change of scale: between the ends of a gradient, or of the part to the rest
    sigma: float

    def __str__(self) -> str:
        return f"{self.where}: scale changes by {self.change:+.1%} (sigma {self.sigma:.1%})"


@dataclass(frozen=True)
class ScaleTolerance:
    """When a change of scale refuses a model: beyond ``change`` by more than ``deviations`` standard deviations."""

    change: float = 0.015  # Source: chosen on: room 300 of scale_study
    deviations: float = 2.0  # gradients, of which there are a dozen. Source: as above
    scan_deviations: float = 4.0  # parts, of which there are about a hundred. Source: as above


#: When a model is refused unless said otherwise.
DEFAULT_SCALE_TOLERANCE = ScaleTolerance()


def local_scales(
    frame: np.ndarray,  # (N,) int
    share: np.ndarray,  # (N, 2)
    depth: np.ndarray,  # (N,) m, sensor
    model_depth: np.ndarray,  # (N,) model units
    xyz: np.ndarray,  # (N, 3)
) -> LocalScales:
    """Pairs of depths of one point -> the local scales of all regions with at least ``MIN_RATIOS`` of them."""
    row, column = (np.clip((share[:, k] * n).astype(int), 0, n - 1) for k, n in ((1, REGIONS[0]), (0, REGIONS[1])))
    region = row * REGIONS[1] + column
    key = frame * (REGIONS[0] * REGIONS[1]) + region
    ratio = np.log(depth / model_depth)
    cells = [np.nonzero(key == k)[0] for k in np.unique(key)]
    cells = [cell for cell in cells if len(cell) >= MIN_RATIOS]
    log = np.array([np.median(ratio[c]) for c in cells])
    mad = np.array([np.median(np.abs(ratio[c] - m)) for c, m in zip(cells, log, strict=True)])
    sigma = np.hypot(MEDIAN_LOSS * SIGMA_OF_MAD * mad / np.sqrt([max(len(c), 1) for c in cells]), SHARED_NOISE)
    first = np.array([c[0] for c in cells], int)
    return LocalScales(
        frame=frame[first],
        region=region[first],
        log=log,
        sigma=sigma,
        depth=np.array([np.median(depth[c]) for c in cells]),
        share=np.array([np.median(share[c], 0) for c in cells]).reshape(-1, 2),
        xyz=np.array([np.median(xyz[c], 0) for c in cells]).reshape(-1, 3),
    )


def estimate_scale(local: LocalScales, n_frames: int) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Local scales -> (log scale, its standard deviation, log scale (F,) of every frame, and its deviation (F,)).

    The scale is a robust mean over frames. Its standard deviation is the larger of that from the scatter between frames
    and a jackknife over up to eight stretches of the recording, within which frames share errors.
    """
    log, sigma = np.full(n_frames, np.nan), np.full(n_frames, np.nan)
    for f in np.unique(local.frame):
        here = local.frame == f
        log[f] = _robust_mean(local.log[here], local.sigma[here])
        sigma[f] = np.sqrt(1 / (local.sigma[here] ** -2).sum())
    has = np.isfinite(log)
    spread = SIGMA_OF_MAD * np.median(np.abs(log[has] - np.median(log[has])))
    total = np.hypot(sigma, spread)
    mean = _robust_mean(log[has], total[has])
    parts = [p for p in np.array_split(np.nonzero(has)[0], min(8, has.sum())) if len(p)]
    without = [_robust_mean(np.delete(log, p)[n], np.delete(total, p)[n]) for p in parts for n in [np.delete(has, p)]]
    n = len(parts)
    jackknife = np.sqrt((n - 1) / n * ((np.array(without) - mean) ** 2).sum()) if n > 1 else np.inf
    return mean, max(float(np.sqrt(1 / (total[has] ** -2).sum())), float(jackknife)), log, sigma


def _robust_mean(x: np.ndarray, sigma: np.ndarray) -> float:
    """Huber's mean of values with standard deviations, which bends at 1.5 of them."""
    mean = float(np.median(x)) if len(x) else np.nan
    for _ in range(20):
        weight = 1 / (sigma * np.maximum(sigma, np.abs(x - mean) / 1.5))
        mean = float((weight * x).sum() / weight.sum()) if len(x) else np.nan
    return mean


class _Contrast(NamedTuple):
    """A column over the local scales: its coefficient is the change of log scale over a gradient, or of a part."""

    kind: str
    where: str
    column: np.ndarray  # (C,)
    is_part: bool


def find_faults(
    local: LocalScales, names: list[str], tolerance: ScaleTolerance = DEFAULT_SCALE_TOLERANCE
) -> tuple[list[ScaleFault], list[ScaleFault]]:
    """Local scales and the F frames' names -> (changes of scale beyond the tolerance, all gradients).

    Faults are ordered by their excess in standard deviations, the largest first.
    """
    contrasts = list(_contrasts(local, names))
    if not contrasts or len(np.unique(local.frame)) < 2:
        return [], []
    change, sigma = _fit_contrasts(local, contrasts)
    limit = np.where([c.is_part for c in contrasts], tolerance.scan_deviations, tolerance.deviations)
    excess = (np.abs(change) - tolerance.change) / sigma - limit
    rows = [
        ScaleFault(c.kind, c.where, float(np.expm1(d)), float(s))
        for c, d, s in zip(contrasts, change, sigma, strict=True)
    ]
    faults = [rows[k] for k in np.argsort(-excess) if excess[k] > 0]
    return faults, [row for row, c in zip(rows, contrasts, strict=True) if not c.is_part]


def _fit_contrasts(local: LocalScales, contrasts: list[_Contrast]) -> tuple[np.ndarray, np.ndarray]:
    """Change (K,) of log scale along every contrast and its standard deviation, from the scatter between frames."""
    X = np.stack([c.column for c in contrasts], 1)
    w = 1 / (local.sigma**2 + 1e-4)
    w = w / w.sum()
    X = X - w @ X
    y = np.clip(local.log - np.median(local.log), -1.0, 1.0)
    y = y - w @ y
    square = (w[:, None] * X**2).sum(0)
    change = (w[:, None] * X * y[:, None]).sum(0) / square
    rest = y[:, None] - X * change
    frames, index = np.unique(local.frame, return_inverse=True)
    score = np.zeros((len(frames), X.shape[1]))
    np.add.at(score, index, w[:, None] * X * rest)
    clustered = (score**2).sum(0) * len(frames) / max(len(frames) - 1, 1)
    # Few frames or places scatter little by chance: not below independent local scales of their common scatter.
    scatter = SIGMA_OF_MAD * np.median(np.abs(rest - np.median(rest, 0)), 0)
    independent = ((w[:, None] * X) ** 2).sum(0) * np.maximum(scatter, SHARED_NOISE) ** 2
    return change, np.sqrt(np.maximum(clustered, independent)) / square


def _contrasts(local: LocalScales, names: list[str]) -> Iterator[_Contrast]:
    """Gradients along recording, range, picture and the model's principal axes; parts of each of them."""
    F = len(names)
    time = local.frame / max(F - 1, 1) - 0.5
    log_depth = np.log(local.depth)
    low, high = np.quantile(local.depth, (0.05, 0.95))
    u, v = (local.share - 0.5).T
    ends = f"from {names[0]} to {names[-1]}"
    yield from _gradients("drift", ends, time, "bend", f"{ends}, ends against middle")
    if high > 1.2 * low:
        along = (log_depth - np.log(low)) / np.log(high / low) - 0.5
        yield _Contrast("range", f"from {low:.2g} to {high:.2g} m", np.clip(along, -0.7, 0.7), is_part=False)
    yield _Contrast("picture", "from left to right of the picture", u, is_part=False)
    yield _Contrast("picture", "from top to bottom of the picture", v, is_part=False)
    yield _Contrast("picture", "from centre to corners of the picture", 2 * (u**2 + v**2), is_part=False)
    centred = local.xyz - np.median(local.xyz, 0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    for k, axis in enumerate(axes):
        place = centred @ axis
        low, high = np.quantile(place, (0.05, 0.95))
        if high > low:
            along = np.clip((place - low) / (high - low) - 0.5, -0.7, 0.7)
            to = ", ".join(f"{x:+.2f}" for x in axis)
            where = f"across the model along ({to})"
            yield from _gradients("place", where, along, "place", f"{where}, ends against middle", first=k)
    for length in sorted({max(3, round(F * part)) for part in (0.5, 0.33, 0.2, 0.1)}):
        for first in range(0, F - length + 1, max(1, length // 2)):
            last = first + length - 1
            inside = (local.frame >= first) & (local.frame <= last)
            yield from _part("frames", f"frames {names[first]} to {names[last]}", inside, local)
    for region in np.unique(local.region):
        row, column = divmod(int(region), REGIONS[1])
        where = f"picture region row {row + 1} of {REGIONS[0]}, column {column + 1} of {REGIONS[1]}"
        yield from _part("region", where, local.region == region, local)
    for inside in _places(local.xyz, np.arange(len(local.xyz)), depth=4):
        mask = np.zeros(len(local.xyz), bool)
        mask[inside] = True
        centre = ", ".join(f"{x:.3g}" for x in np.median(local.xyz[inside], 0))
        yield from _part("place", f"around ({centre}) in the model", mask, local)


def _gradients(kind: str, where: str, x: np.ndarray, bent: str, where_bent: str, first: int = 0) -> Iterator[_Contrast]:
    """Linear and quadratic change over ``x`` in −½ … ½."""
    yield _Contrast(kind, where, x, is_part=False)
    yield _Contrast(bent, where_bent, 4 * x**2, is_part=False)


def _part(kind: str, where: str, inside: np.ndarray, local: LocalScales) -> Iterator[_Contrast]:
    """The contrast of a part with enough local scales in it, from at least three frames, and outside of it."""
    n = inside.sum()
    frames = len(np.unique(local.frame[inside]))
    if n >= MIN_RATIOS and frames >= min(3, local.frame.max() + 1) and n <= 0.7 * len(inside):
        yield _Contrast(kind, where, inside.astype(float), is_part=True)


def _places(xyz: np.ndarray, index: np.ndarray, depth: int) -> Iterator[np.ndarray]:
    """Index sets of the halves, quarters, … of the points, each cut at the median of its longest axis."""
    if depth == 0 or len(index) < 2 * MIN_RATIOS:
        return
    axis = np.ptp(xyz[index], axis=0).argmax()
    order = index[np.argsort(xyz[index, axis], kind="stable")]
    for half in np.array_split(order, 2):
        yield half
        yield from _places(xyz, half, depth - 1)
