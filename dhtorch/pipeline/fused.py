"""Sparse and swept depth as one product: at every sample and pixel one answer, on one scale of sigma.

    sparse answers (B, N) ─────────────┬─ common pose error ─ agreement ─ mean, or the surer ─┬─ Estimate (B, N)
    source views ─ sweep (B, h, w) ────┘                                                      └─ DepthMap (B, h, w)

Both kinds of answers stand on the same poses and images but fail apart: a track slides along an edge where the window
of a sweep holds, and a sweep has no unique plane where a texture repeats and a track is unique. So their difference is
evidence: two answers that agree are surer than either and may each be uncertain alone; of two that contradict each
other neither is sure.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Gate, Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.patches import containing_pixels, nearest_pixel_index, sample_nearest
from dhtorch.geometry.windows import window_extreme
from dhtorch.pipeline.dense import SelectedViews, Sweep, filter_sweep, gate_sweep, merge_returns, sweep_views
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.pipeline.spec import MethodSpec
from dhtorch.records import DepthMap, Estimate, Frame, SigmaBudget
from dhtorch.stages.fuse import fuse_consistent

#: Joint answers of the views, also uncertain ones: an answer of the sweep may agree with them.
#: Source: chosen on data=shared_scenes and data=streams, trials of limits from .1 to .5.
FUSE_UNCERTAIN: Final = partial(
    fuse_consistent, sure_rel=0.3, sure_rel_each=0.3, max_sigma_rel=0.4, max_static_ratio=0.7
)


class _Answers(NamedTuple):
    """Answers of one kind at the samples, (B, N) each; where ``keep`` is False the values are 1."""

    keep: Tensor  # bool
    q: Tensor  # 1/m
    sigma: Tensor  # sigma / depth
    shared: Tensor  # the pose's part of it
    expected: Tensor  # expected relative error, by which answers are ordered
    n_views: Tensor  # the reference view included
    terms: Tensor  # (5, B, N) sigma / depth by cause, in the order of SigmaBudget


class _Joint(NamedTuple):
    """Joint answers at the samples, (B, N) each, and those of either kind that they are made of."""

    keep: Tensor  # bool
    weight: Tensor  # of the sparse answer, in [0, 1]
    expected: Tensor  # expected relative error
    sparse: _Answers
    swept: _Answers


def fuse_with_sweep(
    method: MethodSpec,
    reference: Frame,
    selected: SelectedViews,
    *,
    fuse_uncertain: Callable[..., Estimate] = FUSE_UNCERTAIN,
    min_agreeing_correlation: float = 0.5,
    max_agreeing_sigma_rel: float = 0.4,
    max_agreeing_sigmas: float = 2.0,
    min_conflicting_sigmas: float = 3.0,
    agreement_gain: float = 0.6,
    conflict_loss: float = 2.0,
    half_error: float = 0.1,
    options: DenseOptions = DEFAULT_DENSE_OPTIONS,
    **changes: Any,
) -> tuple[Estimate, DepthMap]:
    """The sweep of the selected views of B reference views, joined with their sparse answers.

    Args:
        method: its ``backproject`` reads the near returns.
        reference: B views.
        selected: their source views with sparse answers and poses.
        fuse_uncertain: estimates of the views (V, B, N) -> joint answers (B, N), uncertain ones included.
        min_agreeing_correlation, max_agreeing_sigma_rel: limits of the sweep, in place of ``min_correlation`` and
            ``max_sigma_rel``, for answers that agree with a sparse one.
        max_agreeing_sigmas, min_conflicting_sigmas: difference of two inverse depths up to which they agree, and from
            which on they conflict, in its standard deviations.
        agreement_gain, conflict_loss: factors of the expected error of two answers that agree, that conflict.
        half_error: expected error h at which the score is one half.
        options: of the sweep.
        changes: fields of ``options``.

    Returns:
        Estimate: the mean of two answers that agree, weighted by 1 / e², else the one with the smaller expected error
        e: sigma / depth of the sweep, sigma / depth / √views of a sparse answer. Score is h / (h + e). ``parallax_deg``
        and ``residual_px`` are those of the tracks.
        DepthMap: near returns; swept pixels; the joint answers at the pixels of samples, where the pixel is or touches
        an answered one. ``source`` is that of the answer with the larger weight.

    The sweep's sigma gets the pose error that the sparse answers share: it is estimated from all views together, that
    of the sweep view by view. Limits and factors were chosen on ``data=shared_scenes`` and ``data=streams``.

    Gradient: depth to that of both kinds of answers; weights, sigma and choices carry none.
    """
    options = replace(options, **changes)
    wide = replace(options, min_correlation=min_agreeing_correlation, max_sigma_rel=max_agreeing_sigma_rel)
    sweep = sweep_views(reference, selected, method, options)
    # Standard deviation (B, 1) in 1/m of the inverse depths of a reference view that the poses cause; 0 = unknown, as a
    # median of few is one answer's.
    joined = selected.joined
    counts = joined.keep & ~selected.samples.usable & (joined.depth > 0)
    shared = joined.sigma_shared / torch.where(counts, joined.depth, 1.0).square()
    shared_q = torch.where(counts.sum(-1, keepdim=True) >= 9, masked_median(shared.detach(), counts), 0.0)
    swept = filter_sweep(sweep, _with_shared_error(gate_sweep(sweep, options), sweep, shared_q, half_error), options)
    uncertain = gate_sweep(sweep._replace(alone=torch.ones_like(sweep.alone)), wide)
    uncertain = _with_shared_error(uncertain, sweep, shared_q, half_error)
    at = cam.depth_pixels(reference.camera, reference.hw, None, sweep.base.hw, selected.samples.uv)
    fused = fuse_uncertain(selected.estimates)
    gate = torch.where(joined.gate == Gate.UNCERTAIN, fused.gate, joined.gate)
    gate = torch.where(joined.keep, Gate.UNCERTAIN, gate)
    joint = _join(
        (_sparse_answers(joined), _sparse_answers(fused.replace(gate=gate.to(torch.int32)))),
        (_swept_answers(swept, sweep, shared_q, at), _swept_answers(uncertain, sweep, shared_q, at)),
        limits=(max_agreeing_sigmas, min_conflicting_sigmas),
        factors=(agreement_gain, conflict_loss),
    )
    estimate = _joint_estimate(selected, joint, half_error)
    return estimate, merge_returns(_insert(swept, at, estimate, selected, joint), sweep.returns)


def _with_shared_error(swept: DepthMap, sweep: Sweep, shared_q: Tensor, half_error: float) -> DepthMap:
    """The swept map with sigma and score for a pose error of at least ``shared_q`` (B, 1) 1/m."""
    missing = (shared_q.to(swept.sigma)[..., None].square() - sweep.surface.shared).clamp_min(0)
    depth = swept.depth.detach()
    added = missing * depth.square().square()
    sigma = (swept.sigma.square() + added).sqrt()
    score = torch.where(swept.keep, half_error / (half_error + sigma / depth), 0.0)
    parts = None if swept.parts is None else swept.parts.replace(pose=swept.parts.pose + added)
    return swept.replace(sigma=sigma, score=score, parts=parts)


def _sparse_answers(estimate: Estimate) -> _Answers:
    """The answers of an estimate, ordered as :func:`dhtorch.stages.score.confidence_from_sigma` orders them."""
    keep = estimate.keep & (estimate.depth > 0) & estimate.sigma.isfinite()
    depth, sigma, shared = (
        torch.where(keep, x, 1.0) for x in (estimate.depth, estimate.sigma, estimate.sigma_shared.nan_to_num())
    )
    sigma, shared = ((x / depth).detach() for x in (sigma, shared))
    n_views = estimate.n_views
    expected = sigma / (n_views - 1).clamp_min(1).to(sigma).sqrt()
    return _Answers(keep, 1 / depth, sigma, shared, expected, n_views, terms=_terms(estimate.kept_parts, keep, depth))


def _swept_answers(swept: DepthMap, sweep: Sweep, shared_q: Tensor, at: Tensor) -> _Answers:
    """The answers (B, N) of a swept map at its pixels ``at`` (B, N, 2)."""
    depth, sigma, pose_var, keep = (
        sample_nearest(x, at)[0] for x in (swept.depth, swept.sigma, sweep.surface.shared, swept.keep)
    )
    keep = keep & (depth > 0) & sigma.isfinite()
    depth, sigma = torch.where(keep, depth, 1.0), torch.where(keep, sigma, 1.0)
    sigma = (sigma / depth).detach()
    shared = torch.minimum(torch.maximum(pose_var.sqrt(), shared_q.to(sigma)) * depth.detach(), sigma)
    n_views = sweep.n_views[:, None].expand_as(keep)
    parts = swept.replace(sigma=swept.sigma.detach()).budget.map(lambda x: sample_nearest(x, at)[0])
    return _Answers(keep, 1 / depth, sigma, shared, sigma, n_views, terms=_terms(parts, keep, depth))


def _terms(parts: SigmaBudget, keep: Tensor, depth: Tensor) -> Tensor:
    """sigma / depth (5, B, N) by cause; 0 where there is no answer."""
    variances = torch.stack([x.detach() for x in parts.values()])
    return torch.where(keep & (variances > 0) & variances.isfinite(), variances, 0.0).sqrt() / depth.detach()


def _join(
    sparse: tuple[_Answers, _Answers],
    swept: tuple[_Answers, _Answers],
    *,
    limits: tuple[float, float],
    factors: tuple[float, float],
) -> _Joint:
    """Answers of either kind, each with the uncertain ones beside them, -> joint answers.

    An uncertain answer counts only where it agrees with one of the other kind.
    """
    one, other = (
        _Answers(*(torch.where(sure.keep, x, y.to(x)) for x, y in zip(sure, unsure, strict=True)))
        for sure, unsure in (sparse, swept)
    )
    difference = (one.q - other.q).abs().detach()
    deviation = ((one.sigma * one.q).square() + (other.sigma * other.q).square()).sqrt().detach()
    agree = one.keep & other.keep & (difference <= limits[0] * deviation)
    one, other = (x._replace(keep=x.keep & (sure.keep | agree)) for x, sure in ((one, sparse[0]), (other, swept[0])))
    conflict = one.keep & other.keep & (difference >= limits[1] * deviation)
    e_one, e_other = (torch.where(x.keep, x.expected, torch.inf) for x in (one, other))
    share = e_other.square() / (e_one.square() + e_other.square())
    weight = torch.where(agree, share, (one.keep & (e_one <= e_other)).to(share))
    expected = torch.minimum(e_one, e_other)
    expected = torch.where(agree, factors[0] * expected, torch.where(conflict, factors[1] * expected, expected))
    return _Joint(one.keep | other.keep, weight, expected, one, other)


def _joint_estimate(selected: SelectedViews, joint: _Joint, half_error: float) -> Estimate:
    """The sparse estimate (B, N) with the joint answers at samples without a return."""
    sparse, open_ = selected.joined, ~selected.samples.usable
    answered = joint.keep & open_
    one, other, w = joint.sparse, joint.swept, joint.weight
    depth = 1 / (w * one.q + (1 - w) * other.q)
    sigma, shared = (
        (w * a + (1 - w) * b) * depth.detach() for a, b in ((one.sigma, other.sigma), (one.shared, other.shared))
    )
    n_views = torch.maximum(torch.where(w > 0, one.n_views, 0), torch.where(w < 1, other.n_views, 0))
    unanswered = torch.where(sparse.keep & open_, Gate.UNCERTAIN, sparse.gate)

    def choose(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(answered, new.to(old), old)

    *known, model = ((w * one.terms + (1 - w) * other.terms) * depth.detach()).square()
    model = torch.maximum(model, sigma.square() - sum(known))  # what the join adds
    pairs = zip((*known, model), sparse.kept_parts.values(), strict=True)
    parts = SigmaBudget(*(choose(new, old) for new, old in pairs))

    return sparse.replace(
        depth=choose(depth, sparse.depth),
        sigma=choose(sigma, sparse.sigma),
        sigma_shared=choose(shared, sparse.sigma_shared),
        n_views=choose(n_views, sparse.n_views),
        score=choose(half_error / (half_error + joint.expected), sparse.score),
        gate=torch.where(answered, Gate.ANSWER, unanswered).to(sparse.gate),
        parts=parts,
    )


def _insert(swept: DepthMap, at: Tensor, estimate: Estimate, selected: SelectedViews, joint: _Joint) -> DepthMap:
    """The swept map (B, h, w) with the joint answers at the pixels ``at`` (B, N, 2) of the samples.

    Only where the pixel is or touches an answered one: a lone pixel is no surface. Of several samples at one pixel the
    one with the largest score counts.
    """
    h, w = swept.depth.shape[-2:]
    index, inside = nearest_pixel_index((h, w), containing_pixels(at))
    touched = window_extreme(swept.keep, 1, torch.logical_or).flatten(1)
    wanted = joint.keep & ~selected.samples.usable & inside & touched.gather(1, index)
    rank = 1 + torch.where(wanted, estimate.score, -1.0).argsort(dim=-1, stable=True).argsort(dim=-1)
    rank = torch.where(wanted, rank, 0)
    best = index.new_zeros(len(index), h * w).scatter_reduce(1, index, rank, "amax")
    wins = wanted & (best.gather(1, index) == rank)
    target = torch.where(wins, index, h * w)  # the others write to a pixel that is cut off

    def write(values: Tensor, new: Tensor) -> Tensor:
        padded = torch.cat((values.flatten(1), values.new_zeros(len(values), 1)), 1)
        return padded.scatter(1, target, new.to(values))[:, :-1].unflatten(1, (h, w))

    source = torch.where(joint.weight > 0.5, Source.RECOVERED, Source.SWEPT)
    parts = None
    if swept.parts is not None:
        pairs = zip(swept.parts.values(), estimate.kept_parts.values(), strict=True)
        parts = SigmaBudget(*(write(values, new) for values, new in pairs))
    return DepthMap(
        depth=write(swept.depth, estimate.depth),
        sigma=write(swept.sigma, estimate.sigma),
        score=write(swept.score, estimate.score),
        source=write(swept.source, source),
        gate=write(swept.gate, torch.full_like(estimate.gate, Gate.ANSWER)),
        parts=parts,
    )
