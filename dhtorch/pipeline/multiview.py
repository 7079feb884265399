"""Several source views of one reference view: each is solved as a pair, and consistent estimates are fused.

    reference view ─ samples ─┬─ view 1 ─ track, pose, triangulate ─┐
                              ├─ view 2 ─ track, pose, triangulate ─┼─ fuse ─ score
                              └─ view … ─ track, pose, triangulate ─┘

Intermediate views are easier to track into than the widest one, and contradict a track that slid along its epipolar
line, which a single pair cannot detect.
"""

import time
from collections.abc import Sequence

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Gate
from dhtorch.geometry.checks import check
from dhtorch.geometry.pyramid import PyramidCache
from dhtorch.pipeline.pair import (
    StageTimer,
    add_pose_samples,
    repeat_views,
    solve_pairs,
    track_in_chunks,
    upcast_intrinsics,
    without_added,
)
from dhtorch.pipeline.spec import MethodSpec, Trace
from dhtorch.pipeline.view_selection import rank_views, select_views_by_pose
from dhtorch.pytree import stack
from dhtorch.records import NO_HINT, Estimate, Frame, PoseFit, PosePrior, Samples, TrackHint, Tracks, ViewSelection


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
    """Estimate (B, n) of a method for B reference views with V × B other views, for ``method(reference, others)``.

    Every view is a pair with the reference view, with its own tracks, pose and depth. The depths are fused.
    Views are tracked one after the other, then all poses are solved together.
    Stages 1 to 3 run once per reference view; ``score`` gets the fused estimate, with tracks and pose of the last view.
    Of more than ``method.views`` views the best are selected, by ``method.select_views`` or by a few of the samples
    (:func:`dhtorch.pipeline.view_selection.rank_views`); ``trace`` then has the :class:`dhtorch.records.ViewSelection`.
    ``method.chain`` only gives a start: the template is always the reference view's window.

    Raises:
        ValueError: wrong shapes, different batch sizes, no other view.
    """
    check("extend", image_0=(reference.image, "B C H W"), images=(others.image, "V B c h w"))
    check("extend", f_0=(reference.camera.f, "B 2"), f=(others.camera.f, "V B 2"))
    if not others.image.shape[0]:
        raise ValueError("extend: found no other view, expected at least one")
    start_time, ms = time.perf_counter(), {}
    reference, others = upcast_intrinsics(reference), upcast_intrinsics(others)
    samples = method.sample_depth(reference)
    n = samples.uv.shape[1]
    samples = add_pose_samples(method, reference, samples)
    ms["samples"] = 1e3 * (time.perf_counter() - start_time)
    hint = hint.replace(between=None)
    hint = hint if hint.pyramid is not None else hint.replace(pyramid=PyramidCache(reference.image))
    all_views = torch.arange(len(others.image), device=samples.uv.device)[:, None].expand(-1, len(samples.uv))
    choice = ViewSelection(all_views)
    if len(others.image) > method.views:
        start_time = time.perf_counter()
        choice = _select_views(method, reference, others, samples, seed=seed, fit=fit, hint=hint)
        ms["select_views"] = 1e3 * (time.perf_counter() - start_time)

    def estimate_views(index: Tensor) -> list[Trace]:
        """Traces of the views of an index (v, B)."""
        views, poses = others, fit
        if len(index) < len(others.image):
            rows = index, torch.arange(len(samples.uv), device=index.device)
            views, poses = others[rows], None if fit is None else fit[rows]
        return _estimate_views(method, reference, views, samples, seed=seed, fit=poses, hint=hint, ms=ms)

    traces = estimate_views(choice.index)
    if choice.reserve is not None and (n_mute := min(int(_is_mute(traces).sum(0).max()), len(choice.reserve))) > 0:
        next_best = choice.reserve[:n_mute]
        traces, choice = _replace_mute_views(traces, estimate_views(next_best), choice, next_best)
    start_time = time.perf_counter()
    if method.verify_views is not None:
        verified = method.verify_views(
            samples, *(stack([t[name] for t in traces]) for name in ("tracks_ideal", "fit", "estimate"))
        )
        traces = [{**t, "estimate": verified[k]} for k, t in enumerate(traces)]
    if samples.uv.shape[1] > n:
        traces = [without_added(t, n) for t in traces]
    last = traces[-1]
    estimate = method.fuse(stack([t["estimate"] for t in traces]))
    estimate = method.score(estimate, last["samples"], last["tracks_ideal"], last["fit"])
    ms["fuse"] = 1e3 * (time.perf_counter() - start_time)
    if trace is not None:
        trace.update({**last, "estimate": estimate, "ms": ms, "views": traces, "choice": choice})
    return estimate


def _is_mute(traces: Sequence[Trace]) -> Tensor:
    """Whether views (V, B) have no pose. Those without a baseline, or contradicted, are evidence and are kept."""
    gates = torch.stack([t["estimate"].gate for t in traces])
    return ((gates > Gate.ANSWER) & (gates <= Gate.NO_POSE)).all(-1)


def _replace_mute_views(
    traces: Sequence[Trace], reserve: Sequence[Trace], choice: ViewSelection, reserve_index: Tensor
) -> tuple[list[Trace], ViewSelection]:
    """The traces with views without a pose replaced by those of the reserve that have one, and the new choice.

    As many of the reserve count as a reference view has views without a pose, whatever its batch has. Views stay in
    rising order. Their gains are those of the preview, 0 of the replacements.
    """
    everything = [*traces, *reserve]
    index = torch.cat((choice.index, reserve_index))
    is_mute = _is_mute(everything)
    place = torch.arange(len(reserve), device=is_mute.device)[:, None]
    is_mute[len(traces) :] |= place >= is_mute[: len(traces)].sum(0)
    order = is_mute.long().argsort(dim=0, stable=True)[: len(traces)]
    order = order.gather(0, index.gather(0, order).argsort(dim=0, stable=True))
    rows = order, torch.arange(order.shape[1], device=order.device)
    names = [name for name in everything[0] if isinstance(everything[0][name], pytree.Record) and name != "samples"]
    chosen = {name: stack([t[name] for t in everything])[rows] for name in names}
    gain = None
    if choice.gain is not None:
        gain = torch.cat((choice.gain, choice.gain.new_zeros(reserve_index.shape)))[rows]
    new = [{**traces[k], **{name: chosen[name][k] for name in names}} for k in range(len(traces))]
    return new, choice.replace(index=index[rows], gain=gain, reserve=None)


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
    """The views to use (views, B), by the method's ``select_views`` or by the estimates of a few of the samples.

    With a prior and a guide, which finds what the poses predict, by the poses alone.
    """
    if method.guide is not None and isinstance(fit, PosePrior):
        returned = samples.usable & (samples.trackability >= method.min_trackability)
        depth = torch.where(returned, samples.depth, 0.0).amax(-1)  # the farthest return
        return select_views_by_pose(reference, others, method.views, fit.T_1_from_0, depth)
    if method.select_views is not None:
        selection = method.select_views(reference, others, method.views, fit=fit)
        return selection if isinstance(selection, ViewSelection) else ViewSelection(selection)
    # About 256 samples decide.
    preview = samples[:, :: max(1, method.n // 256)]
    traces = _estimate_views(method, reference, others, preview, seed=seed, fit=fit, hint=hint, ms={})
    return rank_views(stack([t["estimate"] for t in traces]), method.views)


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
    """Traces of the pairs of the reference view's samples with each of the views, in the order of the views."""
    clock = StageTimer({"ms": ms})
    tracks: list[Tracks] = []
    for k, image in enumerate(others.image):
        if method.chain and tracks:
            uv_0, uv_1 = tracks[-1].uv_0.detach(), tracks[-1].uv_1.detach()
            ahead = torch.where(tracks[-1].valid[..., None], uv_0 + (uv_1 - uv_0) * ((k + 1) / k), uv_0)
            hint = hint.replace(start=ahead)
        tracks.append(clock("track", track_in_chunks(method, reference.image, image, samples.uv, hint)))
    V, B = others.image.shape[:2]
    solved = solve_pairs(
        method,
        reference,
        others,
        repeat_views(samples, V),
        pytree.collate(tracks),
        seed=seed if isinstance(seed, int) else seed.repeat(V),
        fit=None if fit is None else fit.map(lambda x: x.flatten(0, 1)),
        hint=hint,
        clock=clock,
    )
    names = "tracks", "estimate", "tracks_ideal", "fit"
    by_view = dict(zip(names, (x.map(lambda y: y.unflatten(0, (V, B))) for x in solved), strict=True))
    return [{"ms": ms, "samples": samples, **{name: x[k] for name, x in by_view.items()}} for k in range(V)]
