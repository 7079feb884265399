"""Many views of one anchor: each answers as a pair, and the answers that agree are joined.

    anchor view ─ samples ─┬─ view 1 ─ track, pose, triangulate ─┐
                           ├─ view 2 ─ track, pose, triangulate ─┼─ fuse ─ score
                           └─ view … ─ track, pose, triangulate ─┘

Views in between are easier to track into than the widest one, and a track that slid along its epipolar line, which no
pair can see, contradicts them.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Gate, first_reason
from dhtorch.geometry.pyramid import build_pyramid
from dhtorch.geometry.shapes import check
from dhtorch.geometry.steady import steady
from dhtorch.pair import Trace, extend, lifted
from dhtorch.records import Estimate, Frame, PoseFit, Samples, Tracks
from dhtorch.stages import backproject as _backproject
from dhtorch.stages import holes as _holes
from dhtorch.stages import pose as _pose
from dhtorch.stages import sample as _sample
from dhtorch.stages import score as _score
from dhtorch.stages import track as _track
from dhtorch.stages import triangulate as _triangulate
from dhtorch.tree import stack

#: Least share of a variance that is put down to the point's own track, whatever the pose's part.
OWN_SHARE = 1e-3

#: Samples, about, by which key views are chosen.
PROBES = 256


def inverse_variance(
    estimates: Estimate,  # (V, B, N), one per view
    *,
    min_views: int = 2,
    max_chi2: float = 9.0,
    correlation: float = 1.0,
    max_sigma_rel: float | None = 0.1,
    max_still: float = 0.5,
) -> Estimate:
    """Join the answers of several views of the same samples; where they contradict each other, say nothing.

    Errors of triangulation are even in inverse depth, not in depth, so inverse depths are averaged, each by its own
    inverse variance. What the views disagree by is asked twice: more than ``max_chi2`` variances per degree of freedom
    silences the point, and a smaller excess over one widens its sigma.

    Args:
        min_views: fewer answering views (or all, where there are not so many) make no answer.
        max_chi2: sum of squared differences from the mean, in variances, per view beyond the first.
        correlation: of the views' own errors, which share the anchor's window. At 1 sigma is the weighted mean of the
            views', at 0 it shrinks with the root of their number. The poses' parts are always taken to be common to the
            views: all poses rest on the same near returns.
        max_sigma_rel: sigma / depth of the fused answer above which it is withheld; None asks nothing. Views may answer
            far less surely than that.
        max_still: share of the views without a baseline above which none is believed: the few that found one where the
            camera hardly moved have most likely taken something else for it.

    Returns:
        Estimate (B, N); a single view's as it is. ``n_views`` counts the anchor; ``parallax_deg`` is the largest of
        all views, ``residual_px`` the weighted rms of those that answered (of none: the last view's); ``score`` is 1
        where answered.

    Gates: NO_BASELINE for all points of an anchor whose views mostly have none; with too few views, the reason of the
    last view that is silent; INCONSISTENT, UNCERTAIN.

    Raises:
        ValueError: wrong shapes, or no view.

    Gradient: depth and sigma to those of the views; gates carry none.
    Cost: linear in views.
    """
    V = check("inverse_variance", gate=(estimates.gate, "V B N"), depth=(estimates.depth, "V B N"))["V"]
    if V < 1:
        raise ValueError("inverse_variance: expected at least one view")
    if V == 1:
        return estimates[0]
    said = estimates.keep & (estimates.depth > 0) & (estimates.sigma > 0) & estimates.sigma.isfinite()
    inverse, own, shared = _inverse_depth(estimates, said)
    variance = own * own + shared * shared
    weight = torch.where(said, 1 / variance, torch.zeros_like(variance))
    total = weight.sum(0)
    weight = weight / torch.where(total > 0, total, torch.ones_like(total))
    n = said.sum(0)
    mean = (weight * inverse).sum(0)
    mean = torch.where(n > 0, mean, torch.ones_like(mean))
    chi2 = torch.where(said, (inverse - mean).square() / variance, torch.zeros_like(variance)).sum(0)
    chi2 = chi2 / (n - 1).clamp_min(1)
    widening = chi2.clamp_min(1)
    own_2 = correlation * (weight * own).sum(0).square() + (1 - correlation) * (weight * own).square().sum(0)
    shared_2 = (weight * shared).sum(0).square() * widening
    depth = 1 / mean
    sigma = depth * depth * (own_2 * widening + shared_2).sqrt()
    unsure = torch.zeros_like(n, dtype=torch.bool) if max_sigma_rel is None else sigma > max_sigma_rel * depth
    gate = first_reason((~(chi2 <= max_chi2), Gate.INCONSISTENT), (unsure, Gate.UNCERTAIN))
    gate = torch.where(n < min(max(min_views, 1), V), _last_reason(estimates.gate, said), gate)
    still = (estimates.gate == Gate.NO_BASELINE).any(-1).sum(0) > max_still * V
    gate = torch.where(still[:, None], Gate.NO_BASELINE, gate).to(torch.int32)
    keep = gate == Gate.ANSWER
    residual_px = torch.where(said, estimates.residual_px, torch.zeros_like(estimates.residual_px))
    residual_px = _root((weight * residual_px.square()).sum(0)).to(estimates.depth.dtype)

    def answer(x: Tensor) -> Tensor:
        return torch.where(keep, x, torch.full_like(x, torch.nan)).to(estimates.depth.dtype)

    return Estimate(
        uv=estimates.uv[-1],
        depth=answer(depth),
        sigma=answer(sigma),
        sigma_shared=answer(depth * depth * _root(shared_2)),
        parallax_deg=estimates.parallax_deg.amax(0),
        residual_px=torch.where(n > 0, residual_px, estimates.residual_px[-1]),
        n_views=(n + 1).to(torch.int32),
        score=keep.to(estimates.depth.dtype),
        gate=gate,
    )


def extend_window(
    anchor: Frame,
    others: Frame,
    *,
    sample: Callable[..., Tensor] = _sample.spiral,
    backproject: Callable[..., Samples] = _backproject.backproject,
    classify: Callable[..., Samples] = _holes.classify,
    track: Callable[..., Tracks] = _track.lucas_kanade,
    pose: Callable[..., PoseFit] = _pose.pnp_ransac,
    triangulate: Callable[..., Estimate] = _triangulate.two_view,
    score: Callable[..., Estimate] = _score.rank,
    fuse: Callable[..., Estimate] = inverse_variance,
    views: int = 5,
    chain: bool = True,
    n: int = 2048,
    hypotheses: int = 200,
    min_trackability: float = 1e-5,
    seed: int | Tensor = 0,
    fit: PoseFit | None = None,
    trace: Trace | None = None,
) -> Estimate:
    """Extend the depth sensor of ``anchor`` with the parallax to several other views.

    Every view is a pair with the anchor: tracked from it, with a pose and a depth of its own. The depths are fused.

    Args:
        anchor: B anchor views; answers are depths along their samples.
        others: V × B other views, in the order in which the camera took them.
        sample, backproject, classify, track, pose, triangulate, score: the seven seats, as in ``extend``. The first
            three see the anchor once; ``score`` sees the fused estimate, with tracks and pose of the last view.
        fuse: estimates of all views (V, B, N) → Estimate.
        views: how many other views are used. Of more the best are chosen (:func:`key_views`), by a few of the samples.
            A caller with a recording hands over as many, spread evenly from the anchor to the other view of a pair.
        chain: begin the search in each view where its predecessor was found, further on at the same pace. It only is
            a start: what is searched for is always the anchor's window.
        n, hypotheses, min_trackability, seed: as in ``extend``; all views have the same draws.
        fit: poses from elsewhere, (V, B).
        trace: as in ``extend``, of the last view, with ``ms`` summed over views and ``views``, the traces of all.

    Returns:
        Estimate for the B × n samples of the anchor.

    Raises:
        ValueError: wrong shapes, different batch sizes, no other view.

    Gradient: as ``extend``, through all views.
    Cost: linear in views; the anchor's pyramid is built once.
    """
    check("extend_window", image_0=(anchor.image, "B C H W"), images=(others.image, "V B c h w"))
    check("extend_window", f_0=(anchor.camera.f, "B 2"), f=(others.camera.f, "V B 2"))
    if not others.image.shape[0]:
        raise ValueError("extend_window: found no other view, expected at least one")
    began, ms = time.perf_counter(), {}
    anchor, others = lifted(anchor), lifted(others)
    uv = sample(anchor.hw, n, device=anchor.camera.f.device, dtype=anchor.camera.f.dtype)
    samples = classify(anchor, backproject(anchor, uv))
    ms["samples"] = 1e3 * (time.perf_counter() - began)
    common: dict[str, Any] = {"track": track, "chain": chain, "pose": pose, "triangulate": triangulate, "ms": ms}
    common |= {"hypotheses": hypotheses, "min_trackability": min_trackability, "seed": seed}
    if len(others.image) > views:
        thin = samples[:, :: max(1, n // PROBES)]
        index = key_views(stack([t["estimate"] for t in _ask_views(anchor, others, thin, fit=fit, **common)]), views)
        pick = index, torch.arange(index.shape[1], device=index.device)
        others, fit = others[pick], None if fit is None else fit[pick]
    traces = _ask_views(anchor, others, samples, fit=fit, **common)
    last, began = traces[-1], time.perf_counter()
    estimate = fuse(stack([t["estimate"] for t in traces]))
    estimate = score(estimate, samples, last["tracks_ideal"], last["fit"])
    ms["fuse"] = 1e3 * (time.perf_counter() - began)
    if trace is not None:
        trace.update({**last, "estimate": estimate, "ms": ms, "views": traces})
    return estimate


def key_views(
    estimates: Estimate,  # (V, B, N), one per view
    views: int,
    *,
    good_sigma_rel: float = 0.1,
) -> Tensor:
    """Which views to keep, by the sigma to expect of the points together: (views, B) indices, rising.

    A wide view is sure of what it sees, a near one sees more. What a set of views is worth is the sum over the points
    of log(1 + sum of (good_sigma_rel · depth / sigma)² over its views); views are added one by one, each the one that
    adds most, the wider of equals.

    Raises:
        ValueError: wrong shapes, or not 1 <= views <= V.
    """
    V = check("key_views", gate=(estimates.gate, "V B N"), sigma=(estimates.sigma, "V B N"))["V"]
    if not 1 <= views <= V:
        raise ValueError(f"key_views: views is {views}, expected 1 to {V}")
    said = estimates.keep & (estimates.sigma > 0) & estimates.sigma.isfinite()
    ratio = good_sigma_rel * estimates.depth / torch.where(said, estimates.sigma, 1.0)
    worth = torch.where(said, ratio, 0.0).detach().double().square().flip(0)  # argmax takes the first of equals
    known = torch.zeros_like(worth[0])
    free = torch.ones_like(worth[:, :, 0], dtype=torch.bool)
    for _ in range(views):
        gain = steady(torch.log1p, known + worth).sum(-1).masked_fill(~free, -torch.inf)
        best = torch.nn.functional.one_hot(gain.argmax(0), V).T.bool()
        known = known + (worth * best[..., None]).sum(0)
        free = free & ~best
    return free.flip(0).long().argsort(dim=0, stable=True)[:views]


def _ask_views(
    anchor: Frame,
    others: Frame,
    samples: Samples,
    *,
    track: Callable[..., Tracks],
    chain: bool,
    fit: PoseFit | None,
    ms: dict[str, float],
    **seats: Any,
) -> list[Trace]:
    """The anchor's samples in each of the views, as a pair."""
    given: dict[str, Any] = {"sample": partial(_given, samples.uv), "score": _no_score, "n": samples.uv.shape[1]}
    given |= {"backproject": partial(_given, samples), "classify": partial(_given, samples)}
    known = _pyramid(track, anchor.image)
    traces: list[Trace] = []
    for k in range(len(others.image)):
        if chain and traces:
            known |= _start(track, traces[-1]["tracks"], (k + 1) / k)
        traces.append({"ms": ms})
        own = None if fit is None else fit[k]
        extend(anchor, others[k], track=partial(track, **known), fit=own, trace=traces[-1], **given, **seats)
    return traces


def _inverse_depth(estimates: Estimate, said: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depth and the own and shared parts of its standard deviation, float64; 1 where nothing was said."""
    one = torch.ones_like(estimates.depth)
    inverse = 1 / torch.where(said, estimates.depth, one).double()
    whole = torch.where(said, estimates.sigma, one).double() * inverse * inverse
    shared = torch.where(said, estimates.sigma_shared, 0 * one).double() * inverse * inverse
    own = (whole.square() - shared.square()).clamp_min(OWN_SHARE * whole.square()).sqrt()
    return inverse, own, shared


def _last_reason(gate: Tensor, said: Tensor) -> Tensor:
    """Gate (B, N) of the last of the views (V, B, N) that did not answer."""
    reason = torch.full_like(gate[0], Gate.INCONSISTENT)
    for code, answered in zip(gate, said, strict=True):
        reason = torch.where(answered | (code == Gate.ANSWER), reason, code)
    return reason


def _root(x: Tensor) -> Tensor:
    """Square root with a finite gradient at zero."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, torch.ones_like(x)).sqrt(), torch.zeros_like(x))


def _pyramid(track: Callable[..., Tracks], image: Tensor) -> dict[str, Any]:
    """The anchor's pyramid as an option of the tracker, where it takes one (and says of how many levels)."""
    known = inspect.signature(track).parameters
    if not {"pyramid_0", "levels", "window"} <= set(known):
        return {}
    return {"pyramid_0": build_pyramid(image, known["levels"].default, known["window"].default)}


def _start(track: Callable[..., Tracks], tracks: Tracks, pace: float) -> dict[str, Any]:
    """Where a search may start that has come ``pace`` times as far as the last one, where the tracker asks."""
    if "uv_1_init" not in inspect.signature(track).parameters:
        return {}
    uv_0, uv_1 = tracks.uv_0.detach(), tracks.uv_1.detach()
    return {"uv_1_init": torch.where(tracks.valid[..., None], uv_0 + (uv_1 - uv_0) * pace, uv_0)}


def _given(value: Any, *_args: Any, **_options: Any) -> Any:
    return value


def _no_score(estimate: Estimate, *_args: Any) -> Estimate:
    return estimate
