"""Many views of one anchor: each answers as a pair, and the answers that agree are joined.

    reference view ─ samples ─┬─ view 1 ─ track, pose, triangulate ─┐
                           ├─ view 2 ─ track, pose, triangulate ─┼─ fuse ─ score
                           └─ view … ─ track, pose, triangulate ─┘

Views in between are easier to track into than the widest one, and a track that slid along its epipolar line, which no
pair can see, contradicts them.
"""

from __future__ import annotations

import time

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.geometry.checks import check
from dhtorch.geometry.pyramid import PyramidCache
from dhtorch.pipeline.pair import StageTimer, solve_pose_and_triangulate, track_in_chunks, upcast_intrinsics
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.pipeline.view_selection import rank_views
from dhtorch.pytree import R, stack
from dhtorch.records import NO_HINT, Estimate, Frame, PoseFit, PosePrior, Samples, TrackHint, Tracks, ViewSelection

#: Samples, about, by which key views are chosen.
N_PREVIEW_SAMPLES = 256


def estimate_multiview(
    method: MethodSpec,
    reference: Frame,
    others: Frame,
    *,
    seed: int | Tensor = 0,
    fit: PoseFit | PosePrior | None = None,
    hint: TrackHint = NO_HINT,
    trace: Trace | None = None,
) -> Estimate:
    """The method's answer for B reference views with V × B other views; what ``method(reference view, others)`` calls.

    Every view is a pair with the anchor: tracked from it, with a pose and a depth of its own. The depths are fused.
    Views are tracked into one after the other, then all poses are solved together.
    The first three seats see the reference view once; ``score`` sees the fused estimate, with tracks and pose of the
    last view. Of more than ``method.views`` the best are chosen, by ``method.select_views`` or by a few of the samples
    (:func:`dhtorch.pipeline.view_selection.rank_views`); ``trace`` then has the :class:`dhtorch.records.ViewSelection`.
    ``method.chain`` only gives a start: what is searched for is always the reference view's window.

    Raises:
        ValueError: wrong shapes, different batch sizes, no other view.
    """
    check("extend", image_0=(reference.image, "B C H W"), images=(others.image, "V B c h w"))
    check("extend", f_0=(reference.camera.f, "B 2"), f=(others.camera.f, "V B 2"))
    if not others.image.shape[0]:
        raise ValueError("extend: found no other view, expected at least one")
    began, ms = time.perf_counter(), {}
    reference, others = upcast_intrinsics(reference), upcast_intrinsics(others)
    samples = method.sample_depth(reference)
    ms["samples"] = 1e3 * (time.perf_counter() - began)
    hint = hint if hint.pyramid is not None else hint.replace(pyramid=PyramidCache(reference.image))
    every = torch.arange(len(others.image), device=samples.uv.device)[:, None].expand(-1, len(samples.uv))
    choice = ViewSelection(every)
    if len(others.image) > method.views:
        began = time.perf_counter()
        choice = _select_views(method, reference, others, samples, seed=seed, fit=fit, hint=hint)
        ms["select_views"] = 1e3 * (time.perf_counter() - began)
        pick = choice.index, torch.arange(len(samples.uv), device=choice.index.device)
        others, fit = others[pick], None if fit is None else fit[pick]
    traces = _estimate_views(method, reference, others, samples, seed=seed, fit=fit, hint=hint, ms=ms)
    last, began = traces[-1], time.perf_counter()
    estimate = method.fuse(stack([t["estimate"] for t in traces]))
    estimate = method.score(estimate, samples, last["tracks_ideal"], last["fit"])
    ms["fuse"] = 1e3 * (time.perf_counter() - began)
    if trace is not None:
        trace.update({**last, "estimate": estimate, "ms": ms, "views": traces, "choice": choice})
    return estimate


def _select_views(
    method: MethodSpec,
    reference: Frame,
    others: Frame,
    samples: Samples,
    *,
    seed: int | Tensor,
    fit: PoseFit | PosePrior | None,
    hint: TrackHint,
) -> ViewSelection:
    """Which of the views are asked, as the method chooses them or by a few of the samples."""
    if method.select_views is not None:
        found = method.select_views(reference, others, method.views, fit=fit)
        return found if isinstance(found, ViewSelection) else ViewSelection(found)
    thin = samples[:, :: max(1, method.n // N_PREVIEW_SAMPLES)]
    probes = _estimate_views(method, reference, others, thin, seed=seed, fit=fit, hint=hint, ms={})
    return rank_views(stack([t["estimate"] for t in probes]), method.views)


def _estimate_views(
    method: MethodSpec,
    reference: Frame,
    others: Frame,
    samples: Samples,
    *,
    seed: int | Tensor,
    fit: PoseFit | PosePrior | None,
    hint: TrackHint,
    ms: dict[str, float],
) -> list[Trace]:
    """The reference view's samples in each of the views, as a pair."""
    clock = StageTimer({"ms": ms})
    seen: list[Tracks] = []
    for k, image in enumerate(others.image):
        if method.chain and seen:
            hint = hint.replace(start=_extrapolate_tracks(seen[-1], (k + 1) / k))
        seen.append(clock("track", track_in_chunks(method, reference.image, image, samples.uv, hint)))
    V, B = others.image.shape[:2]
    answers = solve_pose_and_triangulate(
        method,
        _repeat_views(samples, V),
        pytree.collate(seen),
        _repeat_views(reference.camera, V),
        others.camera.map(lambda x: x.flatten(0, 1)),
        seed=seed if isinstance(seed, int) else seed.repeat(V),
        fit=None if fit is None else fit.map(lambda x: x.flatten(0, 1)),
        clock=clock,
    )
    names = "estimate", "tracks_ideal", "fit"
    by_view = dict(zip(names, (x.map(lambda y: y.unflatten(0, (V, B))) for x in answers), strict=True))
    return [
        {"ms": ms, "samples": samples, "tracks": seen[k], **{name: x[k] for name, x in by_view.items()}}
        for k in range(V)
    ]


def _repeat_views(record: R, V: int) -> R:
    """The reference view's (B, …), once for every view: (V B, …)."""
    return record.map(lambda x: x.expand(V, *x.shape).flatten(0, 1))


def _extrapolate_tracks(tracks: Tracks, pace: float) -> Tensor:
    """Where a search may start that has come ``pace`` times as far as the last one."""
    uv_0, uv_1 = tracks.uv_0.detach(), tracks.uv_1.detach()
    return torch.where(tracks.valid[..., None], uv_0 + (uv_1 - uv_0) * pace, uv_0)
