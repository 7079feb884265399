"""Question: does correlating the two spiral signals in time squeeze out parallax?

The idea: each of the two phase-shifted arms is a 1-D signal; where the camera has moved, near things have shifted
further along it than far ones, so the size of the shift is a depth cue. Three readings of it: the shift of an arm's
signal against itself (``own_arm``), against the neighbouring winding of the other arm (``between_arms``), and
whichever correlates best, with the step across the arms counted in (``best_arm``). The controls are plain 2-D flow of
our own tracker (``flow``) and its component along the arm (``flow_along_arm``), which is all that a perfect 1-D
correlation could ever see. All are held against the sensor's inverse depth on the same sites.

Expectation (written before the run): no; the correlation with inverse depth is near zero (the paper: r = -0.04) and
below that of plain flow (+0.34), because what moves across an arm is not seen: under forward motion that is everything.
What would refute it: over the scenes, the median r of ``own_arm`` reaches half of that of ``flow``, or it beats
``flow`` on half of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.pairs import to_fixed_pairs
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.negative.arms import ArmShift, correlate_windows, sample_arm
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row, median_or_none
from dhtorch.experiments.screening import ScreenedItem, paired_metric, screen_scenes
from dhtorch.metrics import bootstrap, holdout
from dhtorch.metrics.correlation import pearson, spearman
from dhtorch.records import Frame, TrackHint
from dhtorch.stages.sample import spiral

QUESTION = "Does correlating the two spiral signals in time squeeze out parallax?"
EXPECTATION = "No: its shifts hardly correlate with inverse depth, plain 2-D flow does; forward motion is not seen."

VARIANTS = ("own_arm", "between_arms", "best_arm", "flow", "flow_along_arm")

#: Fewest sites on which a correlation is said.
_MIN_CORRELATION_SITES = 20

#: Flow below it (px) has no share that could be seen.
_MIN_FLOW_PX = 1.0

#: Shifts this near to each other (px) are the same.
_SAME_SHIFT_PX = 2.0

#: Points of the sampler per step (1 px) of an arm, from which its even steps are read: plenty.
_POINTS_PER_STEP = 4


class SpiralArm(NamedTuple):
    """One arm as a curve of even steps of 1 px."""

    uv: Tensor  # (L, 2) px
    tangent: Tensor  # (L, 2) unit
    turn: Tensor  # (L,) angle wound since the centre, in half turns


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    window: int = 41,
    max_lag_share: float = 0.0625,
    min_peak: float = 0.5,
    blur_px: float = 1.5,
    turns: float | None = None,
    foveation: float = 1.0,
    gaze: tuple[float, float] | None = None,
    round_arms: bool = False,
    progress: Progress = no_progress,
) -> Outcome:
    """Shifts along the arms and plain flow at as many sites as the method has samples, against inverse depth.

    Rows, per pair and per scene: ``corr`` (Pearson) and ``rank_corr`` (Spearman) of the size of the shift with inverse
    depth, over the sites that the own arm and the tracker answer, so that all are judged alike; ``corr_answered``, over
    those that the variant itself answers; ``coverage``, their share of the candidates; ``median_shift_px``;
    ``flow_share``, the median of its shift over plain flow's; ``along_share``, of the common sites those whose shift is
    within 2 px of what plain flow has along the arm: the rest recognised something else. A candidate is a site with
    texture whose return passes the truth test. Nothing is hidden from anyone.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; of the first the seats 2 to 4 are asked, at as many places as it has samples.
        window: of the correlation, px along the arm.
        max_lag_share: farthest shift looked for, share of the image width.
        min_peak: least correlation that counts as found.
        blur_px: of the picture, before the arms are read.
        turns, foveation, gaze: of the helix, see :func:`dhtorch.stages.sample.spiral`.
        round_arms: wind in circles, as far as they fit into the picture. The sampler's own arms wind into its corners;
            there they run partly along the radius, and see a part of forward motion that circles do not.

    Source: paper, "What Does Not Work", dual-helix temporal cross-correlation.
    """
    method = next(iter(methods.values()))

    def ask(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        views = [scene.recording[k].to(settings.dtype).to(settings.device) for k in item]
        lag = max(2, round(max_lag_share * views[0].hw[1]))
        arms = partial(make_arms, turns=turns, foveation=foveation, gaze=gaze, round_arms=round_arms)
        correlated = partial(correlate_windows, window=window, max_lag=lag, min_peak=min_peak)
        return _evaluate_pair(scene.hint, method, views[0], views[1], correlated=correlated, blur_px=blur_px, wind=arms)

    outcome = screen_scenes(
        scenes_of(scenes), lambda scene: to_fixed_pairs(pairs(scene)), ask, VARIANTS, truth="full", progress=progress
    )
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome))


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Is the helix's correlation below half of that of plain flow, and below it on most scenes?"""
    both = paired_metric(outcome, "full", "own_arm", "flow", "corr")
    if not both:
        return None, "no scene on which both have enough sites"
    helix, flow = (bootstrap.interval_over_scenes([pair[k] for pair in both]) for k in (0, 1))
    lower = sum(h < f for h, f in both)
    assert helix.value is not None and flow.value is not None
    why = (
        f"r with inverse depth, median over {len(both)} scenes: helix {helix.value:+.2f}, plain flow {flow.value:+.2f}"
        f" (paper: -0.04, +0.34); helix below flow on {lower}"
    )
    if max(helix.value, flow.value) <= 0:
        return None, f"{why}; neither is a depth cue here"
    return helix.value < 0.5 * flow.value and lower > len(both) / 2, why


def make_arms(
    hw: tuple[int, int],
    n: int,
    like: Tensor,
    *,
    turns: float | None = None,
    foveation: float = 1.0,
    gaze: tuple[float, float] | None = None,
    round_arms: bool = False,
) -> tuple[SpiralArm, SpiralArm]:
    """The two arms of a spiral of ``n`` points as curves of even steps, or the same wound in circles."""
    turns = turns or math.sqrt(foveation * n / (2 * math.pi))
    total = int(_POINTS_PER_STEP * turns * math.pi * math.hypot(*hw)) & ~1
    uv = spiral(hw, total, turns=turns, foveation=foveation, gaze=gaze, dtype=torch.float64)
    s = (torch.arange(total // 2, dtype=torch.float64) + 0.5) / (total / 2)
    if round_arms:
        limit = torch.tensor([hw[1] - 1.0, hw[0] - 1.0], dtype=torch.float64)
        centre = limit / 2 if gaze is None else torch.tensor(gaze, dtype=torch.float64)
        radius = torch.minimum(centre, limit - centre).min() * s**foveation
        uv = centre + radius.repeat_interleave(2)[:, None] * torch.nn.functional.normalize(uv - centre, dim=-1)
    return _resample_evenly(uv[0::2], 2 * turns * s.sqrt(), like), _resample_evenly(
        uv[1::2], 2 * turns * s.sqrt(), like
    )


def _resample_evenly(uv: Tensor, turn: Tensor, like: Tensor) -> SpiralArm:
    """A finely sampled curve (M, 2) read at steps of 1 px."""
    length = torch.cat((uv.new_zeros(1), uv.diff(dim=0).norm(dim=-1).cumsum(0)))
    at = torch.arange(int(length[-1]), dtype=torch.float64)
    after = torch.searchsorted(length, at, right=True).clamp(1, len(length) - 1)
    share = ((at - length[after - 1]) / (length[after] - length[after - 1]).clamp_min(1e-12))[:, None]
    even = uv[after - 1] + share * (uv[after] - uv[after - 1])
    (tangent,) = torch.gradient(even, dim=0)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return SpiralArm(*(x.to(like) for x in (even, tangent, turn[after - 1])))


def _evaluate_pair(
    hint: TrackHint, method: Method, frame_0: Frame, frame_1: Frame, *, correlated: Any, blur_px: float, wind: Any
) -> dict[str, Row]:
    """Variant → numbers of one pair."""
    n = method.n
    arms = wind(frame_0.hw, n, frame_0.camera.f)
    sites = [torch.linspace(0, len(a.uv) - 1, n // 2, device=a.uv.device).round().long() for a in arms]
    uv = torch.cat([a.uv[s] for a, s in zip(arms, sites, strict=True)])
    tangent = torch.cat([a.tangent[s] for a, s in zip(arms, sites, strict=True)])
    signals = [[sample_arm(f.image, a.uv, blur_px=blur_px) for a in arms] for f in (frame_0, frame_1)]

    samples = method.sample_depth_at(frame_0, uv)
    truth = holdout.sample_truth(frame_0, samples.uv)
    candidate = holdout.select_candidates(samples, truth, 0.0).ok[0]
    tracks = method.track(frame_0.image, frame_1.image, samples.uv, hint=hint)
    flow = (tracks.uv_1 - tracks.uv_0)[0]

    own = [_correlate_arms(signals, arms, sites, a=k, b=k, step=0.0, correlated=correlated) for k in (0, 1)]
    other = [
        [_correlate_arms(signals, arms, sites, a=k, b=1 - k, step=step, correlated=correlated) for k in (0, 1)]
        for step in (-1.0, 1.0)
    ]
    along, lags, peaks = (torch.cat([part[i] for part in own]) for i in (0, 1, 2))
    neighbours = [[torch.cat([part[i] for part in parts]) for i in (0, 1, 2)] for parts in other]
    (in_way, in_lag, in_peak), (out_way, out_lag, out_peak) = neighbours
    outer = out_peak > in_peak
    across, across_lag = torch.where(outer, out_way, in_way), torch.where(outer, out_lag, in_lag)
    across_peak = torch.maximum(in_peak, out_peak)
    found = {
        "own_arm": (lags.abs(), peaks > 0),
        "between_arms": (across_lag.abs(), across_peak > 0),
        "best_arm": (torch.where(across_peak > peaks, across, along), torch.maximum(peaks, across_peak) > 0),
        "flow": (flow.norm(dim=-1), tracks.valid[0]),
        "flow_along_arm": ((flow * tangent).sum(-1).abs(), tracks.valid[0]),
    }
    common = candidate & (peaks > 0) & tracks.valid[0]
    plain = {"common": common, "flow": flow.norm(dim=-1), "along": found["flow_along_arm"][0]}
    return {name: _numbers(*shift, samples.depth[0], candidate, **plain) for name, shift in found.items()}


def _correlate_arms(
    signals: Any, arms: Any, sites: Any, *, a: int, b: int, step: float, correlated: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Arm a of view 0 against arm b of view 1, ``step`` half turns on: way in the picture, lag and peak (K,).

    Windows are searched around the place of the same direction from the centre.
    """
    site = sites[a]
    there = site
    if a != b:
        there = torch.searchsorted(arms[b].turn, arms[a].turn[site] + step).clamp_max(len(arms[b].turn) - 1)
    shift: ArmShift = correlated(signals[0][a], signals[1][b], site[None], there[None])
    curve = arms[b].uv
    place = (there + shift.lag[0]).clamp(0, len(curve) - 1)
    low = place.floor().long().clamp_max(len(curve) - 2)
    at = curve[low] + (place - low)[:, None] * (curve[low + 1] - curve[low])
    return (at - arms[a].uv[site]).norm(dim=-1), shift.lag[0], shift.peak[0]


def _numbers(
    shift: Tensor, answered: Tensor, depth: Tensor, candidate: Tensor, *, common: Tensor, flow: Tensor, along: Tensor
) -> Row:
    """How the size of the shift (K,) goes with inverse depth."""
    mine = candidate & answered
    same = mine & common

    def over(mask: Tensor, how: Any) -> float | None:
        x = shift[mask].double()
        y = 1 / depth[mask].double()
        found: float | None = how(x, y) if x.numel() >= _MIN_CORRELATION_SITES else None
        return found

    n, moved = int(candidate.sum()), same & (flow > _MIN_FLOW_PX)
    return {
        "n_candidates": n,
        "n_kept": int(mine.sum()),
        "coverage": int(mine.sum()) / n if n else None,
        "corr": over(same, pearson),
        "rank_corr": over(same, spearman),
        "corr_answered": over(mine, pearson),
        "median_shift_px": median_or_none(shift[mine].tolist()),
        "along_share": float(((shift - along).abs() < _SAME_SHIFT_PX)[same].float().mean())
        if bool(same.any())
        else None,
        "flow_share": median_or_none((shift / flow.clamp_min(_MIN_FLOW_PX))[moved].tolist()),
    }
