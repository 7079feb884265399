"""Question: does the correlation of the two spiral signals in time measure parallax?

Each of the two phase-shifted arms is a 1-D signal; when the camera moves, near points shift further along it than far
ones, so the size of the shift is a depth cue. It is measured as the shift of an arm's signal against itself
(``own_arm``), against the neighbouring winding of the other arm (``between_arms``), and as that of the higher
correlation, including the step across the arms (``best_arm``). Controls: plain 2-D flow of the package's tracker
(``flow``) and its component along the arm (``flow_along_arm``), the most that a perfect 1-D correlation could measure.
All are compared with the sensor's inverse depth at the same sites.

Expectation (written before the run): no; the correlation with inverse depth is near zero (the paper: r = -0.04) and
below that of plain flow (+0.34), because what moves across an arm is not seen: under forward motion that is everything.
What would refute it: over the scenes, the median r of ``own_arm`` reaches half of that of ``flow``, or it beats
``flow`` on half of them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.pairs import to_fixed_pairs
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import MainMetric, Row, median_or_none
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    ScenePairs,
    ScreenedItem,
    Settings,
    no_progress,
    paired_metric,
    screen_scenes,
)
from dhtorch.geometry import filters
from dhtorch.geometry.checks import check
from dhtorch.metrics import bootstrap, holdout
from dhtorch.metrics.correlation import pearson, spearman
from dhtorch.pytree import Record, record
from dhtorch.records import Frame, TrackHint
from dhtorch.stages.sample import spiral

# Spiral arms as 1-D signals: sampling along an arm, and shifts along it by windowed cross-correlation.
#
# Alphabet: ``signal`` (B, L) grey values at even steps along an arm; a *site* is an index into it; ``lag`` number of
# steps by which the window around a site is shifted in the other signal. A lag is a displacement along the arm; motion
# across the arm is not measured: under forward motion every point moves along its radius, and an arm crosses all
# radii.

#: Variance of a window (grey values in [0, 1]) below which it is too flat to be matched.
_FLAT_VARIANCE = 1e-6


@record
class _ArmShift(Record):
    """Shift of the window around each site along the arm, with its correlation."""

    lag: Tensor  # (B, K) steps along the arm; 0 where not valid
    peak: Tensor  # (B, K) normalised correlation there, in [-1, 1]; 0 where not valid
    valid: Tensor  # (B, K) bool: windows inside, not flat, and the peak not at an end of the search range


def sample_arm(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    arm: Tensor,  # (L, 2) px
    *,
    blur_px: float = 1.5,
) -> Tensor:
    """Grey values (B, L) along an arm by bilinear interpolation of the image after a Gaussian blur.

    The blur makes windows tolerant to small motion across the arm, and prevents aliasing of fine texture.

    Args:
        image: B images.
        arm: positions, the same in all images; outside the image the border is repeated.
        blur_px: standard deviation; 0 = none.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the image and to ``arm``.
    """
    check("sample_arm", image=(image, "B C H W"), arm=(arm, "L 2"))
    grey = filters.grayscale(image).to(arm.dtype)
    H, W = grey.shape[-2:]
    if blur_px > 0:
        reach = max(1, int(3 * blur_px + 0.5))
        grey = filters.gaussian_blur(grey, blur_px, reach_px=reach)
    limit = torch.tensor([W - 1, H - 1], dtype=arm.dtype, device=arm.device)
    x = torch.minimum(arm.clamp_min(0), limit)
    low = torch.minimum(x.detach().floor(), (limit - 1).clamp_min(0))
    a, b = (x - low).unbind(-1)
    flat = grey.flatten(1)
    first = (low[:, 1] * W + low[:, 0]).long()
    right, below = (1 if W > 1 else 0), (W if H > 1 else 0)
    top = flat[:, first] * (1 - a) + flat[:, first + right] * a
    bottom = flat[:, first + below] * (1 - a) + flat[:, first + below + right] * a
    return top * (1 - b) + bottom * b


def correlate_windows(
    signal_0: Tensor,  # (B, L)
    signal_1: Tensor,  # (B, M)
    site_0: Tensor,  # (B, K) int64, index into signal 0
    site_1: Tensor,  # (B, K) int64, index into signal 1 at which lag 0 lies
    *,
    window: int = 41,
    max_lag: int = 40,
    min_peak: float = 0.5,
) -> _ArmShift:
    """Windowed normalised cross-correlation of two signals, its highest peak refined between steps by a parabola.

    Args:
        signal_0, signal_1: the same arm in two images, or two arms.
        site_0, site_1: centre of each window, and centre of its search range.
        window: steps in a window, odd.
        max_lag: half width of the search range, in steps.
        min_peak: smallest correlation of a match.

    Returns:
        Shift. Not valid: a window or a search that leaves its signal, a flat window, a peak at the end of the search
        or below ``min_peak``.

    Raises:
        ValueError: wrong shapes, an even window, ``max_lag`` below 1, or signals shorter than window and search.

    Gradient: of the parabola through three correlations to both signals; the argmax carries none.
    """
    check("correlate_windows", signal_0=(signal_0, "B L"), signal_1=(signal_1, "B M"), site_0=(site_0, "B K"))
    check("correlate_windows", signal_0=(signal_0, "B L"), site_1=(site_1, "B K"), site_0=(site_0, "B K"))
    if window < 3 or window % 2 == 0 or max_lag < 1:
        raise ValueError(
            f"correlate_windows: window is {window} and max_lag {max_lag}, expected odd from 3, and from 1"
        )
    span = window + 2 * max_lag
    if signal_0.shape[1] < window or signal_1.shape[1] < span:
        lengths = f"{signal_0.shape[1]} and {signal_1.shape[1]} steps"
        raise ValueError(f"correlate_windows: signals have {lengths}, expected at least {window} and {span}")
    start_0, start_1 = site_0 - window // 2, site_1 - span // 2
    last_0, last_1 = signal_0.shape[1] - window, signal_1.shape[1] - span
    inside = (start_0 >= 0) & (start_0 <= last_0) & (start_1 >= 0) & (start_1 <= last_1)
    template = _read_windows(signal_0, start_0.clamp(0, last_0), window)  # (B, K, window)
    search = _read_windows(signal_1, start_1.clamp(0, last_1), span)  # (B, K, span)
    score, textured = _normalised_correlation(template, search)
    best = score.detach()[..., 1:-1].argmax(-1) + 1
    left, peak, right = (score.gather(-1, (best + k)[..., None])[..., 0] for k in (-1, 0, 1))
    curvature = left - 2 * peak + right
    curved = curvature < -1e-6
    offset = torch.where(
        curved, 0.5 * (left - right) / torch.where(curved, curvature, -torch.ones_like(curvature)), 0.0
    )
    ends = torch.maximum(score.detach()[..., 0], score.detach()[..., -1])
    valid = inside & textured & (ends <= peak) & (peak >= min_peak)
    zero = torch.zeros_like(peak)
    return _ArmShift(torch.where(valid, best - max_lag + offset, zero), torch.where(valid, peak, zero), valid)


def _read_windows(signal: Tensor, start: Tensor, length: int) -> Tensor:
    """Windows (B, K, length) of a signal from start indices (B, K)."""
    index = start[..., None] + torch.arange(length, device=signal.device)
    return signal.gather(1, index.flatten(1)).view(index.shape)


def _normalised_correlation(template: Tensor, search: Tensor) -> tuple[Tensor, Tensor]:
    """Correlation (B, K, lags) of a window with every window of the search range, and whether it is textured (B, K)."""
    window = template.shape[-1]
    windows = search.unfold(-1, window, 1)  # (B, K, lags, window), a view
    t = template - template.mean(-1, keepdim=True)
    power_t = (t * t).mean(-1, keepdim=True)
    offset = search.mean(-1, keepdim=True)  # against cancellation in the variances below
    centred = windows - offset[..., None]
    mean_p = centred.mean(-1)
    power_p = (centred * centred).mean(-1) - mean_p * mean_p
    covariance = (centred * t[..., None, :]).mean(-1)
    both_textured = (power_t > _FLAT_VARIANCE) & (power_p > _FLAT_VARIANCE)
    norm = torch.where(both_textured, power_t * power_p, torch.ones_like(power_p)).sqrt()
    return torch.where(both_textured, covariance / norm, torch.zeros_like(covariance)), (power_t > _FLAT_VARIANCE)[
        ..., 0
    ]


VARIANTS = ("own_arm", "between_arms", "best_arm", "flow", "flow_along_arm")

#: Smallest number of sites for a correlation.
_MIN_CORRELATION_SITES = 20

#: Smallest flow, px, for a ratio of the shift to it.
_MIN_FLOW_PX = 1.0

#: Largest difference, px, of shifts that count as equal.
_SAME_SHIFT_PX = 2.0

#: Points of the sampler per step (1 px) of an arm, from which the evenly spaced points are interpolated.
_POINTS_PER_STEP = 4


class _SpiralArm(NamedTuple):
    """Spiral arm as a curve of points 1 px apart."""

    uv: Tensor  # (L, 2) px
    tangent: Tensor  # (L, 2) unit
    turn: Tensor  # (L,) angle from the centre, in half turns


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
    """Run the experiment: shifts along the arms and plain flow against inverse depth, at as many sites as samples.

    Rows, per pair and per scene: ``corr`` (Pearson) and ``rank_corr`` (Spearman) of the size of the shift with inverse
    depth, over the sites answered by the own arm and by the tracker, the same for all variants; ``corr_answered``, over
    the sites answered by the variant; ``coverage``, their fraction of the candidates; ``median_shift_px``;
    ``flow_share``, the median ratio of its shift to plain flow's; ``along_share``, the fraction of the common sites
    whose shift is within 2 px of plain flow's component along the arm: the others are false matches. A candidate is a
    site with texture and a return with valid ground truth. The method sees all returns.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; stages 2 to 4 of the first are run, at as many sites as it has samples.
        window: of the correlation, px along the arm.
        max_lag_share: half width of the search range, as a fraction of the image width.
        min_peak: smallest correlation of a match.
        blur_px: standard deviation of the blur of the image before the arms are sampled.
        turns, foveation, gaze: of the helix, see :func:`dhtorch.stages.sample.spiral`.
        round_arms: arms are circles that fit into the image. The sampler's own arms extend into its corners, where they
            run partly along the radius and measure a part of forward motion that circles do not.

    Source: paper, "What Does Not Work", dual-helix temporal cross-correlation.
    """
    method = next(iter(methods.values()))

    def evaluate_item(scene: Scene, item: ScreenedItem) -> dict[str, Row]:
        views = [scene.recording[k].to(settings.dtype).to(settings.device) for k in item]
        lag = max(2, round(max_lag_share * views[0].hw[1]))
        make_pair_arms = partial(make_arms, turns=turns, foveation=foveation, gaze=gaze, round_arms=round_arms)
        correlate = partial(correlate_windows, window=window, max_lag=lag, min_peak=min_peak)
        return _evaluate_pair(
            scene.hint, method, views[0], views[1], correlate=correlate, blur_px=blur_px, make_pair_arms=make_pair_arms
        )

    outcome = screen_scenes(
        scenes_of(scenes),
        lambda scene: to_fixed_pairs(pairs(scene)),
        evaluate_item,
        VARIANTS,
        truth="full",
        metrics=(
            MainMetric("corr", larger_is_better=True),
            MainMetric("rank_corr", larger_is_better=True),
            MainMetric("coverage", larger_is_better=True),
        ),
        finished=settings.finished,
        progress=progress,
    )
    return outcome.decide(
        "Does the correlation of the two spiral signals in time measure parallax?",
        "No: its shifts hardly correlate with inverse depth, plain 2-D flow does; forward motion is not seen.",
        *verdict(outcome),
    )


def verdict(outcome: Outcome) -> tuple[bool | None, str]:
    """Verdict and text: correlation of the helix below half of plain flow's, and below it on most scenes."""
    value_pairs = paired_metric(outcome, "full", "own_arm", "flow", "corr")
    if not value_pairs:
        return None, "no scene on which both have enough sites"
    helix, flow = (bootstrap.interval_over_scenes([pair[k] for pair in value_pairs]) for k in (0, 1))
    lower = sum(h < f for h, f in value_pairs)
    assert helix.value is not None and flow.value is not None
    why = (
        f"r with inverse depth, median over {len(value_pairs)} scenes: helix {helix.value:+.2f},"
        f" plain flow {flow.value:+.2f} (paper: -0.04, +0.34); helix below flow on {lower}"
    )
    if max(helix.value, flow.value) <= 0:
        return None, f"{why}; neither is a depth cue here"
    return helix.value < 0.5 * flow.value and lower > len(value_pairs) / 2, why


def make_arms(
    hw: tuple[int, int],
    n: int,
    like: Tensor,
    *,
    turns: float | None = None,
    foveation: float = 1.0,
    gaze: tuple[float, float] | None = None,
    round_arms: bool = False,
) -> tuple[_SpiralArm, _SpiralArm]:
    """The two arms of a spiral of ``n`` points as curves of points 1 px apart; circular with ``round_arms``."""
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


def _resample_evenly(uv: Tensor, turn: Tensor, like: Tensor) -> _SpiralArm:
    """Resample a dense curve (M, 2) at steps of 1 px."""
    length = torch.cat((uv.new_zeros(1), uv.diff(dim=0).norm(dim=-1).cumsum(0)))
    position = torch.arange(int(length[-1]), dtype=torch.float64)
    after = torch.searchsorted(length, position, right=True).clamp(1, len(length) - 1)
    weight = ((position - length[after - 1]) / (length[after] - length[after - 1]).clamp_min(1e-12))[:, None]
    even = uv[after - 1] + weight * (uv[after] - uv[after - 1])
    (tangent,) = torch.gradient(even, dim=0)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return _SpiralArm(*(x.to(like) for x in (even, tangent, turn[after - 1])))


def _evaluate_pair(
    hint: TrackHint,
    method: Method,
    frame_0: Frame,
    frame_1: Frame,
    *,
    correlate: Any,
    blur_px: float,
    make_pair_arms: Any,
) -> dict[str, Row]:
    """Variant → row of one pair of frames."""
    n = method.n
    arms = make_pair_arms(frame_0.hw, n, frame_0.camera.f)
    sites = [torch.linspace(0, len(a.uv) - 1, n // 2, device=a.uv.device).round().long() for a in arms]
    uv = torch.cat([a.uv[s] for a, s in zip(arms, sites, strict=True)])
    tangent = torch.cat([a.tangent[s] for a, s in zip(arms, sites, strict=True)])
    signals = [[sample_arm(f.image, a.uv, blur_px=blur_px) for a in arms] for f in (frame_0, frame_1)]

    samples = method.sample_depth_at(frame_0, uv)
    truth = holdout.sample_truth(frame_0, samples.uv)
    candidate = holdout.select_candidates(samples, truth, 0.0).ok[0]
    tracks = method.track(frame_0.image, frame_1.image, samples.uv, hint=hint)
    flow = (tracks.uv_1 - tracks.uv_0)[0]

    own_arm = [_correlate_arms(signals, arms, sites, a=k, b=k, step=0.0, correlate=correlate) for k in (0, 1)]
    other_arm = [
        [_correlate_arms(signals, arms, sites, a=k, b=1 - k, step=step, correlate=correlate) for k in (0, 1)]
        for step in (-1.0, 1.0)
    ]
    own_shift, lags, peaks = (torch.cat([part[i] for part in own_arm]) for i in (0, 1, 2))
    neighbours = [[torch.cat([part[i] for part in parts]) for i in (0, 1, 2)] for parts in other_arm]
    (inner_shift, in_lag, in_peak), (outer_shift, out_lag, out_peak) = neighbours
    outer = out_peak > in_peak
    other_shift, across_lag = torch.where(outer, outer_shift, inner_shift), torch.where(outer, out_lag, in_lag)
    across_peak = torch.maximum(in_peak, out_peak)
    shifts = {
        "own_arm": (lags.abs(), peaks > 0),
        "between_arms": (across_lag.abs(), across_peak > 0),
        "best_arm": (torch.where(across_peak > peaks, other_shift, own_shift), torch.maximum(peaks, across_peak) > 0),
        "flow": (flow.norm(dim=-1), tracks.valid[0]),
        "flow_along_arm": ((flow * tangent).sum(-1).abs(), tracks.valid[0]),
    }
    common = candidate & (peaks > 0) & tracks.valid[0]
    plain = {"common": common, "flow": flow.norm(dim=-1), "along": shifts["flow_along_arm"][0]}
    return {name: _correlation_row(*shift, samples.depth[0], candidate, **plain) for name, shift in shifts.items()}


def _correlate_arms(
    signals: Any, arms: Any, sites: Any, *, a: int, b: int, step: float, correlate: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Correlate arm a of view 0 with arm b of view 1, ``step`` half turns on: shift in px, lag and peak, (K,) each.

    The search is centred on the point of the same direction from the image centre.
    """
    site = target = sites[a]
    if a != b:
        target = torch.searchsorted(arms[b].turn, arms[a].turn[site] + step).clamp_max(len(arms[b].turn) - 1)
    shift: _ArmShift = correlate(signals[0][a], signals[1][b], site[None], target[None])
    curve = arms[b].uv
    position = (target + shift.lag[0]).clamp(0, len(curve) - 1)
    low = position.floor().long().clamp_max(len(curve) - 2)
    point = curve[low] + (position - low)[:, None] * (curve[low + 1] - curve[low])
    return (point - arms[a].uv[site]).norm(dim=-1), shift.lag[0], shift.peak[0]


def _correlation_row(
    shift: Tensor, answered: Tensor, depth: Tensor, candidate: Tensor, *, common: Tensor, flow: Tensor, along: Tensor
) -> Row:
    """Row of correlations of the size of a shift (K,) with inverse depth."""
    own = candidate & answered
    shared = own & common

    def over(mask: Tensor, statistic: Callable[[Tensor, Tensor], float | None]) -> float | None:
        enough = int(mask.sum()) >= _MIN_CORRELATION_SITES
        return statistic(shift[mask].double(), 1 / depth[mask].double()) if enough else None

    n, moving = int(candidate.sum()), shared & (flow > _MIN_FLOW_PX)
    return {
        "n_candidates": n,
        "n_kept": int(own.sum()),
        "coverage": int(own.sum()) / n if n else None,
        "corr": over(shared, pearson),
        "rank_corr": over(shared, spearman),
        "corr_answered": over(own, pearson),
        "median_shift_px": median_or_none(shift[own].tolist()),
        "along_share": float(((shift - along).abs() < _SAME_SHIFT_PX)[shared].float().mean())
        if bool(shared.any())
        else None,
        "flow_share": median_or_none((shift / flow.clamp_min(_MIN_FLOW_PX))[moving].tolist()),
    }
