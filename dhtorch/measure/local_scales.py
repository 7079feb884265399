"""Local scales of a model -> its scale with a standard deviation, and the places where it has another one.

A local scale is the median ratio of sensor depth to model depth in one region of one picture. In a sound model all
local scales are equal but for noise. In a bent or drifting one they change along the recording, with range, over the
picture or from place to place; contrasts measure these changes, each with a standard deviation from the scatter between
frames. Errors that the sensor makes everywhere are common to all local scales and cancel in the contrasts.

Alphabet: ``C`` local scales, ``F`` frames, ``K`` contrasts; logarithms of scales, so that a difference is a ratio.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dhtorch.metrics.grouped import grouped_slopes, huber_mean, mad_sigma, mean_over_stretches

#: Rows and columns of the regions of a picture. Source: chosen on: room 300 of scale_study, regions of at least
#: 25 returns with 400 samples in a picture.
REGIONS = (3, 4)

#: Fewest ratios of a local scale.
MIN_RATIOS = 6

#: Least standard deviation of a local scale, as a log ratio: errors that neighbouring returns share. Source: chosen on:
#: room 300 of scale_study.
SHARED_NOISE = 0.004

#: Least standard deviation of a local scale in a contrast, as a log ratio. Source: chosen on: room 300 of scale_study.
LEAST_SIGMA = 0.01

#: Deviation of a frame's scale, in standard deviations of the frames, from which it is one of a part of its own.
#: Source: as ``ScaleTolerance.scan_deviations``.
OUTLIER_SIGMAS = 4.0

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

    kind: str  # drift | bend | frames | range | picture | region | place | path | curl | views
    where: str
    change: float  # relative change of scale: between the ends of a gradient, of part to rest, of path to depths
    sigma: float

    def __str__(self) -> str:
        effect = _EFFECTS.get(self.kind, "scale changes by")
        return f"{self.where}: {effect} {self.change:+.1%} (sigma {self.sigma:.1%})"


#: What a change of some kinds is, where it is none of the scale: a fraction of the path's length, and of the depth.
_EFFECTS = {"curl": "the path's end moves by", "views": "off by at least"}


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
    spread = np.array([mad_sigma(ratio[c]) for c in cells])
    sigma = np.hypot(MEDIAN_LOSS * spread / np.sqrt([len(c) for c in cells]), SHARED_NOISE)
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
    """Local scales -> (log scale, its standard deviation, log scale (F,) of every frame, and its deviation (F,))."""
    log, sigma = np.full(n_frames, np.nan), np.full(n_frames, np.nan)
    for f in np.unique(local.frame):
        here = local.frame == f
        log[f] = huber_mean(local.log[here], local.sigma[here])
        sigma[f] = np.sqrt(1 / (local.sigma[here] ** -2).sum())
    return *mean_over_stretches(log, sigma), log, sigma


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
    columns = np.stack([c.column for c in contrasts], 1)
    log = np.clip(local.log - np.median(local.log), -1.0, 1.0)
    change, sigma = grouped_slopes(columns, log, np.hypot(local.sigma, LEAST_SIGMA), local.frame, SHARED_NOISE)
    limit = np.where([c.is_part for c in contrasts], tolerance.scan_deviations, tolerance.deviations)
    excess = (np.abs(change) - tolerance.change) / sigma - limit
    rows = [
        ScaleFault(c.kind, c.where, float(np.expm1(d)), float(s))
        for c, d, s in zip(contrasts, change, sigma, strict=True)
    ]
    faults = [rows[k] for k in np.argsort(-excess) if excess[k] > 0]
    return faults, [row for row, c in zip(rows, contrasts, strict=True) if not c.is_part]


def _contrasts(local: LocalScales, names: list[str]) -> Iterator[_Contrast]:
    """Gradients along recording, range, picture and the model's principal axes; parts of each of them."""
    low, high = np.quantile(local.depth, (0.05, 0.95))
    u, v = (local.share - 0.5).T
    time = local.frame / max(len(names) - 1, 1) - 0.5
    yield from _gradients(("drift", "bend"), f"from {names[0]} to {names[-1]}", time)
    if high > 1.2 * low:
        along = np.clip(np.log(local.depth / low) / np.log(high / low) - 0.5, -0.7, 0.7)
        yield _Contrast("range", f"from {low:.2g} to {high:.2g} m", along, is_part=False)
    yield _Contrast("picture", "from left to right of the picture", u, is_part=False)
    yield _Contrast("picture", "from top to bottom of the picture", v, is_part=False)
    yield _Contrast("picture", "from centre to corners of the picture", 2 * (u**2 + v**2), is_part=False)
    centred = local.xyz - np.median(local.xyz, 0)
    for axis in np.linalg.svd(centred, full_matrices=False)[2]:
        place = centred @ axis
        low, high = np.quantile(place, (0.05, 0.95))
        if high > low:
            along = np.clip((place - low) / (high - low) - 0.5, -0.7, 0.7)
            to = ", ".join(f"{x:+.2f}" for x in axis)
            yield from _gradients(("place", "place"), f"across the model along ({to})", along)
    for kind, where, inside in _parts(local, names):
        n_frames = len(np.unique(local.frame[inside]))
        if MIN_RATIOS <= inside.sum() <= 0.7 * len(inside) and n_frames >= min(3, local.frame.max() + 1):
            yield _Contrast(kind, where, inside.astype(float), is_part=True)


def _gradients(kinds: tuple[str, str], where: str, x: np.ndarray) -> Iterator[_Contrast]:
    """Linear and quadratic change over ``x`` in −½ … ½."""
    yield _Contrast(kinds[0], where, x, is_part=False)
    yield _Contrast(kinds[1], f"{where}, ends against middle", 4 * x**2, is_part=False)


def _parts(local: LocalScales, names: list[str]) -> Iterator[tuple[str, str, np.ndarray]]:
    """(kind, where, mask (C,)) of stretches of frames, picture regions and places."""
    F = len(names)
    for length in sorted({max(3, round(F * share)) for share in (0.5, 0.33, 0.2, 0.1)}):
        for first in range(0, F - length + 1, max(1, length // 2)):
            last = first + length - 1
            yield "frames", f"frames {names[first]} to {names[last]}", (local.frame >= first) & (local.frame <= last)
    of_frame = np.array([np.median(local.log[local.frame == f]) for f in np.unique(local.frame)])
    off = of_frame - np.median(of_frame)
    for far in (off, -off):
        alone = np.unique(local.frame)[far > OUTLIER_SIGMAS * mad_sigma(off)]
        listed = ", ".join(names[f] for f in alone[:3])
        yield "frames", f"{len(alone)} of {F} frames, such as {listed}", np.isin(local.frame, alone)
    for region in np.unique(local.region):
        row, column = divmod(int(region), REGIONS[1])
        where = f"picture region row {row + 1} of {REGIONS[0]}, column {column + 1} of {REGIONS[1]}"
        yield "region", where, local.region == region
    for inside in _places(local.xyz, np.arange(len(local.xyz)), depth=4):
        centre = ", ".join(f"{x:.3g}" for x in np.median(local.xyz[inside], 0))
        yield "place", f"around ({centre}) in the model", np.isin(np.arange(len(local.xyz)), inside)


def _places(xyz: np.ndarray, index: np.ndarray, depth: int) -> Iterator[np.ndarray]:
    """Index sets of the halves, quarters, … of the points, each cut at the median of its longest axis."""
    if depth == 0 or len(index) < 2 * MIN_RATIOS:
        return
    axis = np.ptp(xyz[index], axis=0).argmax()
    order = index[np.argsort(xyz[index, axis], kind="stable")]
    for half in np.array_split(order, 2):
        yield half
        yield from _places(xyz, half, depth - 1)
