"""The seat beside the line: what several views of one reference view say about its samples, joined into one answer."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dhtorch.codes import Gate, first_reason
from dhtorch.geometry.checks import check
from dhtorch.records import Estimate

#: Least share of a variance that is put down to the point's own track, whatever the pose's part.
MIN_FUSED_OWN_RATIO = 1e-3


def inverse_variance(
    estimates: Estimate,  # (V, B, N), one per view
    *,
    min_views: int = 2,
    max_chi2: float = 9.0,
    correlation: float = 1.0,
    max_sigma_rel: float | None = 0.1,
    max_static_ratio: float = 0.5,
) -> Estimate:
    """Join the answers of several views of the same samples; where they contradict each other, say nothing.

    Errors of triangulation are even in inverse depth, not in depth, so inverse depths are averaged, each by its own
    inverse variance. What the views disagree by is asked twice: more than ``max_chi2`` variances per degree of freedom
    silences the point, and a smaller excess over one widens its sigma.

    Args:
        min_views: fewer answering views (or all, where there are not so many) make no answer.
        max_chi2: sum of squared differences from the mean, in variances, per view beyond the first.
        correlation: of the views' own errors, which share the reference view's window. At 1 sigma is the weighted mean
            of the views', at 0 it shrinks with the root of their number. The poses' parts are always taken to be common
            to the
            views: all poses rest on the same near returns.
        max_sigma_rel: sigma / depth of the fused answer above which it is withheld; None asks nothing. Views may answer
            far less surely than that.
        max_static_ratio: share of the views without a baseline above which none is believed: the few that found one
            where the camera hardly moved have most likely taken something else for it.

    Returns:
        Estimate (B, N); a single view's as it is. ``n_views`` counts the reference view; ``parallax_deg`` is the
        largest of all views, ``residual_px`` the weighted rms of those that answered (of none: the last view's);
        ``score`` is 1 where answered.

    Gates: NO_BASELINE for all points of a reference view whose views mostly have none; with too few views, the reason
        of the
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
    said = _is_answered(estimates)
    inverse, own, shared = _inverse_depth(estimates, said)
    n = said.sum(0)
    weight, mean, chi2 = _mean(inverse, own * own + shared * shared, said)
    widening = chi2.clamp_min(1)
    own_2 = correlation * (weight * own).sum(0).square() + (1 - correlation) * (weight * own).square().sum(0)
    shared_2 = (weight * shared).sum(0).square() * widening
    depth = 1 / mean
    sigma = depth * depth * (own_2 * widening + shared_2).sqrt()
    unsure = torch.zeros_like(n, dtype=torch.bool) if max_sigma_rel is None else sigma > max_sigma_rel * depth
    gate = first_reason((~(chi2 <= max_chi2), Gate.INCONSISTENT), (unsure, Gate.UNCERTAIN))
    gate = torch.where(n < min(max(min_views, 1), V), _last_reason(estimates.gate, said), gate)
    return _joint(
        estimates,
        _static_gate(estimates, gate, max_static_ratio),
        said,
        weight,
        depth=depth,
        sigma=sigma,
        sigma_shared=depth * depth * _root(shared_2),
        parallax_deg=estimates.parallax_deg.amax(0),
    )


def fuse_consistent(
    estimates: Estimate,  # (V, B, N), one per view
    *,
    max_chi2: float = 9.0,
    max_conflict_ratio: float = 0.25,
    sure_rel: float = 0.05,
    sure_rel_each: float = 0.08,
    max_sigma_rel: float | None = 0.2,
    max_static_ratio: float = 0.5,
) -> Estimate:
    """Join the views that agree about a sample; one view alone answers where it is sure by itself.

    Every view is asked how much the others agree with it, each as sure as its (depth / sigma)²; the one with most
    agreement and those that agree with it answer together, and the others speak against the answer. A view that is
    silent speaks neither for it nor against it, so another view never costs an answer that it does not contradict.

    Args:
        max_chi2: squared difference of two views' inverse depths, over the sum of their variances, up to which they
            agree.
        max_conflict_ratio: (depth / sigma)² of the views that disagree, as a share of that of the views that agree,
            above which the point is silenced.
        sure_rel: sigma / depth up to which one view answers without another that agrees.
        sure_rel_each: sigma / depth up to which several answer, for each that agrees: what is unsure needs many.
        max_sigma_rel: sigma / depth of the joint answer above which it is withheld; None asks nothing.
        max_static_ratio: share of the views without a baseline above which none is believed.

    Returns:
        Estimate (B, N); a single view's as it is. The joint inverse depth is the mean of those that agree, by inverse
        variance. Sigma is the weighted mean of theirs and never less: the views share the reference view's window and
        the near returns, so what they have in common is not averaged out; where they differ by more than they say it
        grows with the root of that ratio. ``n_views`` counts the reference view and those that agree; ``parallax_deg``
        is their largest, ``residual_px`` their weighted rms; ``score`` is 1 where answered.

    Gates: NO_BASELINE for all points of a reference view whose views mostly have none; where no view answers, the
        reason of
    the last; INCONSISTENT (other views disagree), UNCERTAIN (a sigma too large for so many views);
    CONTRADICTED for all answers where it silences more views than answer.

    Raises:
        ValueError: wrong shapes, or no view.

    Gradient: depth and sigma to those of the views; which of them agree, and gates, carry none.
    Cost: linear in views but for comparing them with each other, a few operations on (V, V, B, N).
    """
    V = check("fuse_consistent", gate=(estimates.gate, "V B N"), depth=(estimates.depth, "V B N"))["V"]
    if V < 1:
        raise ValueError("fuse_consistent: expected at least one view")
    if V == 1:
        return estimates[0]
    said = _is_answered(estimates)
    inverse, own, shared = _inverse_depth(estimates, said)
    variance = own.square() + shared.square()
    sureness = torch.where(said, inverse.square() / variance, torch.zeros_like(variance)).detach()  # (depth / sigma)²
    joined = _largest_agreement(inverse.detach(), variance.detach(), sureness, said, max_chi2)
    n = joined.sum(0)
    against = torch.where(joined, 0.0, sureness).sum(0) > max_conflict_ratio * torch.where(joined, sureness, 0.0).sum(0)
    weight, mean, chi2 = _mean(inverse, variance, joined)
    own_2, shared_2 = ((weight * part).sum(0).square() * chi2.clamp_min(1) for part in (own, shared))
    depth = 1 / mean
    sigma = depth * depth * _root(own_2 + shared_2)
    limit = torch.where(n < 2, sure_rel, sure_rel_each * n).clamp(
        max=math.inf if max_sigma_rel is None else max_sigma_rel
    )
    gate = first_reason((against, Gate.INCONSISTENT), (sigma > limit * depth, Gate.UNCERTAIN))
    gate = torch.where(n < 1, _last_reason(estimates.gate, said), gate)
    gate = _contradicted_gate(estimates, gate)
    parallax = torch.where(joined | (n < 1), estimates.parallax_deg, torch.zeros_like(estimates.parallax_deg))
    return _joint(
        estimates,
        _static_gate(estimates, gate, max_static_ratio),
        joined,
        weight,
        depth=depth,
        sigma=sigma,
        sigma_shared=depth * depth * _root(shared_2),
        parallax_deg=parallax.amax(0),
    )


def _largest_agreement(inverse: Tensor, variance: Tensor, sureness: Tensor, said: Tensor, max_chi2: float) -> Tensor:
    """Which views (V, B, N) stand together: those that agree with the view that has most agreement, it included."""
    apart = (inverse[:, None] - inverse).square() / (variance[:, None] + variance)
    agreeing = said[:, None] & said & (apart <= max_chi2)
    support = torch.where(agreeing, sureness, torch.zeros_like(sureness)).sum(1)
    first = support.argmax(0)  # the first of equals
    return agreeing.gather(0, first[None, None].expand(1, *agreeing.shape[1:]))[0]


def _is_answered(estimates: Estimate) -> Tensor:
    """(V, B, N) bool: an answer that can be weighed."""
    return estimates.keep & (estimates.depth > 0) & (estimates.sigma > 0) & estimates.sigma.isfinite()


def _mean(inverse: Tensor, variance: Tensor, among: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the views ``among`` (V, B, N) that count: their weights, their mean by inverse variance (of none: 1), and what
    they differ by, in variances per view beyond the first."""
    weight = torch.where(among, 1 / variance, torch.zeros_like(variance))
    total, n = weight.sum(0), among.sum(0)
    weight = weight / torch.where(n > 0, total, torch.ones_like(total))
    mean = torch.where(n > 0, (weight * inverse).sum(0), torch.ones_like(total))
    chi2 = torch.where(among, (inverse - mean).square() / variance, torch.zeros_like(variance)).sum(0)
    return weight, mean, chi2 / (n - 1).clamp_min(1)


def _static_gate(estimates: Estimate, gate: Tensor, max_static_ratio: float) -> Tensor:
    """The gates (B, N); NO_BASELINE for all points of a reference view whose views mostly have none."""
    still = (estimates.gate == Gate.NO_BASELINE).any(-1).sum(0) > max_static_ratio * len(estimates.gate)
    return torch.where(still[:, None], Gate.NO_BASELINE, gate).to(torch.int32)


def _contradicted_gate(estimates: Estimate, gate: Tensor) -> Tensor:
    """The gates (B, N); CONTRADICTED for what a reference view answers of whose views more are contradicted than
    answer: what moves on its own is near in all of them."""
    against = (estimates.gate == Gate.CONTRADICTED).any(-1).sum(0)
    answering = (estimates.gate == Gate.ANSWER).any(-1).sum(0)
    moving = against > answering
    return torch.where(moving[:, None] & (gate == Gate.ANSWER), Gate.CONTRADICTED, gate)


def _joint(
    estimates: Estimate,
    gate: Tensor,  # (B, N)
    among: Tensor,  # (V, B, N) bool, the views that count
    weight: Tensor,  # (V, B, N)
    *,
    depth: Tensor,  # (B, N) m
    sigma: Tensor,
    sigma_shared: Tensor,
    parallax_deg: Tensor,
) -> Estimate:
    """The answer that the gates let through; its residual is the weighted rms of the views, of none the last view's."""
    dtype = estimates.depth.dtype
    keep = gate == Gate.ANSWER
    n = among.sum(0)
    residual_px = torch.where(among, estimates.residual_px, torch.zeros_like(estimates.residual_px))
    residual_px = _root((weight * residual_px.square()).sum(0)).to(dtype)

    def answer(x: Tensor) -> Tensor:
        return torch.where(keep, x, torch.full_like(x, torch.nan)).to(dtype)

    return Estimate(
        uv=estimates.uv[-1],
        depth=answer(depth),
        sigma=answer(sigma),
        sigma_shared=answer(sigma_shared),
        parallax_deg=parallax_deg,
        residual_px=torch.where(n > 0, residual_px, estimates.residual_px[-1]),
        n_views=(n + 1).to(torch.int32),
        score=keep.to(dtype),
        gate=gate,
    )


def _inverse_depth(estimates: Estimate, said: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depth and the own and shared parts of its standard deviation, float64; 1 where nothing was said."""
    one = torch.ones_like(estimates.depth)
    inverse = 1 / torch.where(said, estimates.depth, one).double()
    whole = torch.where(said, estimates.sigma, one).double() * inverse * inverse
    shared = torch.where(said, estimates.sigma_shared, 0 * one).double() * inverse * inverse
    own = (whole.square() - shared.square()).clamp_min(MIN_FUSED_OWN_RATIO * whole.square()).sqrt()
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
