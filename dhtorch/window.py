"""Many views of one anchor: each answers as a pair, and the answers that agree are joined.

    anchor view ─ samples ─┬─ view 1 ─ track, pose, triangulate ─┐
                           ├─ view 2 ─ track, pose, triangulate ─┼─ fuse ─ score
                           └─ view … ─ track, pose, triangulate ─┘

Views in between are easier to track into than the widest one, and a track that slid along its epipolar line, which no
pair can see, contradicts them.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.geometry.exact import steady
from dhtorch.geometry.pyramid import Pyramids
from dhtorch.geometry.shapes import check
from dhtorch.method import Method, Trace
from dhtorch.pair import ask_pair, lifted
from dhtorch.records import NO_HINT, Estimate, Frame, PoseFit, Samples, TrackHint, Tracks
from dhtorch.tree import stack

#: Samples, about, by which key views are chosen.
PROBES = 256


def ask_window(
    method: Method,
    anchor: Frame,
    others: Frame,
    *,
    seed: int | Tensor = 0,
    fit: PoseFit | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
) -> Estimate:
    """The method's answer for B anchors with V × B other views; what ``method(anchor, others)`` calls.

    Every view is a pair with the anchor: tracked from it, with a pose and a depth of its own. The depths are fused.
    The first three seats see the anchor once; ``score`` sees the fused estimate, with tracks and pose of the last
    view. Of more than ``method.views`` the best are chosen (:func:`key_views`), by a few of the samples.
    ``method.chain`` only gives a start: what is searched for is always the anchor's window.

    Raises:
        ValueError: wrong shapes, different batch sizes, no other view.
    """
    check("extend", image_0=(anchor.image, "B C H W"), images=(others.image, "V B c h w"))
    check("extend", f_0=(anchor.camera.f, "B 2"), f=(others.camera.f, "V B 2"))
    if not others.image.shape[0]:
        raise ValueError("extend: found no other view, expected at least one")
    began, ms = time.perf_counter(), {}
    anchor, others = lifted(anchor), lifted(others)
    samples = method.look(anchor)
    ms["samples"] = 1e3 * (time.perf_counter() - began)
    hint = hint if hint.pyramid is not None else hint.replace(pyramid=Pyramids(anchor.image))
    common: dict[str, Any] = {"seed": seed, "hint": hint, "ms": ms}
    if len(others.image) > method.views:
        thin = samples[:, :: max(1, method.n // PROBES)]
        probes = _ask_views(method, anchor, others, thin, fit=fit, **common)
        index = key_views(stack([t["estimate"] for t in probes]), method.views)
        pick = index, torch.arange(index.shape[1], device=index.device)
        others, fit = others[pick], None if fit is None else fit[pick]
    traces = _ask_views(method, anchor, others, samples, fit=fit, **common)
    last, began = traces[-1], time.perf_counter()
    estimate = method.fuse(stack([t["estimate"] for t in traces]))
    estimate = method.score(estimate, samples, last["tracks_ideal"], last["fit"])
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
        known = known + torch.where(best[..., None], worth, 0.0).sum(0)
        free = free & ~best
    return free.flip(0).long().argsort(dim=0, stable=True)[:views]


def _ask_views(
    method: Method,
    anchor: Frame,
    others: Frame,
    samples: Samples,
    *,
    seed: int | Tensor,
    fit: PoseFit | None,
    hint: TrackHint,
    ms: dict[str, float],
) -> list[Trace]:
    """The anchor's samples in each of the views, as a pair."""
    front: dict[str, Any] = {"sample": partial(_given, samples.uv), "backproject": partial(_given, samples)}
    one = method.replace(**front, classify=partial(_given, samples), score=_no_score, n=samples.uv.shape[1])
    traces: list[Trace] = []
    for k in range(len(others.image)):
        if method.chain and traces:
            hint = hint.replace(start=_further(traces[-1]["tracks"], (k + 1) / k))
        traces.append({"ms": ms})
        own = None if fit is None else fit[k]
        ask_pair(one, anchor, others[k], seed=seed, fit=own, hint=hint, trace=traces[-1])
    return traces


def _further(tracks: Tracks, pace: float) -> Tensor:
    """Where a search may start that has come ``pace`` times as far as the last one."""
    uv_0, uv_1 = tracks.uv_0.detach(), tracks.uv_1.detach()
    return torch.where(tracks.valid[..., None], uv_0 + (uv_1 - uv_0) * pace, uv_0)


def _given(value: Any, *_args: Any, **_options: Any) -> Any:
    return value


def _no_score(estimate: Estimate, *_args: Any) -> Estimate:
    return estimate
