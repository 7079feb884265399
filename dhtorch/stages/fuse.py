"""Fusion of source views: estimates (V, B, N) of one reference view's samples → one estimate (B, N)."""

import math

import torch
from torch import Tensor

from dhtorch.codes import Gate, first_reason
from dhtorch.geometry.checks import check
from dhtorch.records import Estimate, SigmaBudget


def inverse_variance(
    estimates: Estimate,  # (V, B, N), one per view
    *,
    min_views: int = 2,
    max_chi2: float = 9.0,
    correlation: float = 1.0,
    max_sigma_rel: float | None = 0.1,
    max_static_ratio: float = 0.5,
) -> Estimate:
    """Inverse-variance mean of several views' estimates (V, B, N) -> (B, N); unanswered where the views contradict.

    Errors of triangulation are symmetric in inverse depth, not in depth, so inverse depths are averaged, each with its
    own inverse variance. The disagreement of the views is used twice: more than ``max_chi2`` variances per degree of
    freedom leave the point unanswered, and a smaller excess over one increases its sigma.

    Args:
        min_views: fewer answering views (or all, where there are not so many) make no answer.
        max_chi2: sum of squared differences from the mean, in variances, per view beyond the first.
        correlation: of the views' own errors, which share the reference view's window. At 1 sigma is the weighted mean
            of the views', at 0 it decreases with the root of their number. The poses' parts are always taken as common
            to the views: all poses are estimated from the same near returns.
        max_sigma_rel: sigma / depth of the fused answer above which it is withheld; None = no limit. Views may answer
            with a far larger sigma.
        max_static_ratio: fraction of the views without a baseline above which no view is used: the few baselines found
            where the camera hardly moved are most likely wrong.

    Returns:
        Estimate (B, N); a single view's as it is. ``n_views`` counts the reference view; ``parallax_deg`` is the
        largest of all views, ``residual_px`` the weighted rms of those that answered (of none: the last view's);
        ``score`` is 1 where answered.

    Gates: NO_BASELINE for all points of a reference view whose views mostly have none; with too few views, the gate of
    the unanswered view in which the point came furthest, NO_POSE where no view has a pose; INCONSISTENT, UNCERTAIN.

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
    answered = _is_answered(estimates)
    inverse, own, shared = _inverse_depth(estimates, answered)
    n = answered.sum(0)
    weight, mean, chi2 = _mean(inverse, own * own + shared * shared, answered)
    widening = chi2.clamp_min(1)
    own_2 = correlation * (weight * own).sum(0).square() + (1 - correlation) * (weight * own).square().sum(0)
    shared_2 = (weight * shared).sum(0).square() * widening
    depth = 1 / mean
    sigma = depth * depth * (own_2 * widening + shared_2).sqrt()
    unsure = torch.zeros_like(n, dtype=torch.bool) if max_sigma_rel is None else sigma > max_sigma_rel * depth
    gate = first_reason((~(chi2 <= max_chi2), Gate.INCONSISTENT), (unsure, Gate.UNCERTAIN))
    gate = torch.where(n < min(max(min_views, 1), V), _furthest_reason(estimates.gate, answered), gate)
    return _joint_estimate(
        estimates,
        _static_gate(estimates, gate, max_static_ratio),
        answered,
        weight,
        depth=depth,
        sigma=sigma,
        sigma_shared=depth * depth * _root(shared_2),
        parallax_deg=estimates.parallax_deg.amax(0),
        correlation=correlation,
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
    """Mean of the largest set of agreeing views' estimates (V, B, N) -> (B, N); a single precise view may answer alone.

    Every view is scored by the weights (depth / sigma)² of the views that agree with it; the view with the highest
    score and those that agree with it form the answer, and the others count against it. An unanswered view counts
    neither for nor against it, so another view never removes an answer that it does not contradict.

    Args:
        max_chi2: squared difference of two views' inverse depths, over the sum of their variances, up to which they
            agree.
        max_conflict_ratio: (depth / sigma)² of the views that disagree, as a fraction of that of the views that agree,
            above which the point is unanswered.
        sure_rel: sigma / depth up to which one view answers without another that agrees.
        sure_rel_each: sigma / depth up to which several answer, per agreeing view: a larger sigma needs more views.
        max_sigma_rel: sigma / depth of the joint answer above which it is withheld; None = no limit.
        max_static_ratio: fraction of the views without a baseline above which no view is used.

    Returns:
        Estimate (B, N); a single view's as it is. The joint inverse depth is the mean of those that agree, by inverse
        variance. Sigma is the weighted mean of theirs and never less: the views share the reference view's window and
        the near returns, so what they have in common is not averaged out; where they differ by more than their
        sigmas it grows with the root of that ratio. ``n_views`` counts the reference view and those that agree;
        ``parallax_deg`` is their largest, ``residual_px`` their weighted rms; ``score`` is 1 where answered.

    Gates: NO_BASELINE for all points of a reference view whose views mostly have none; where no view answers, the gate
    of the view in which the point came furthest, NO_POSE where no view has a pose; INCONSISTENT (other views disagree),
    UNCERTAIN (a sigma too large for so many views); CONTRADICTED for all answers where more views are CONTRADICTED than
    answer.

    Raises:
        ValueError: wrong shapes, or no view.

    Gradient: depth and sigma to those of the views; which of them agree, and gates, carry none.
    Cost: linear in views except their comparison, a few operations on (V, V, B, N).
    """
    V = check("fuse_consistent", gate=(estimates.gate, "V B N"), depth=(estimates.depth, "V B N"))["V"]
    if V < 1:
        raise ValueError("fuse_consistent: expected at least one view")
    if V == 1:
        return estimates[0]
    answered = _is_answered(estimates)
    inverse, own, shared = _inverse_depth(estimates, answered)
    variance = own.square() + shared.square()
    sureness = torch.where(
        answered, inverse.square() / variance, torch.zeros_like(variance)
    ).detach()  # (depth / sigma)²
    agreeing = _largest_agreement(inverse.detach(), variance.detach(), sureness, answered, max_chi2)
    n_agreeing = agreeing.sum(0)
    contradicted = torch.where(agreeing, 0.0, sureness).sum(0) > max_conflict_ratio * torch.where(
        agreeing, sureness, 0.0
    ).sum(0)
    weight, mean, chi2 = _mean(inverse, variance, agreeing)
    own_2, shared_2 = ((weight * part).sum(0).square() * chi2.clamp_min(1) for part in (own, shared))
    depth = 1 / mean
    sigma = depth * depth * _root(own_2 + shared_2)
    max_rel = torch.where(n_agreeing < 2, sure_rel, sure_rel_each * n_agreeing).clamp(
        max=math.inf if max_sigma_rel is None else max_sigma_rel
    )
    gate = first_reason((contradicted, Gate.INCONSISTENT), (sigma > max_rel * depth, Gate.UNCERTAIN))
    gate = torch.where(n_agreeing < 1, _furthest_reason(estimates.gate, answered), gate)
    # More views are contradicted than answer: an independently moving foreground is near in all of them.
    contradicted, answering = ((estimates.gate == x).any(-1).sum(0) for x in (Gate.CONTRADICTED, Gate.ANSWER))
    gate = torch.where((contradicted > answering)[:, None] & (gate == Gate.ANSWER), Gate.CONTRADICTED, gate)
    parallax = torch.where(
        agreeing | (n_agreeing < 1), estimates.parallax_deg, torch.zeros_like(estimates.parallax_deg)
    )
    return _joint_estimate(
        estimates,
        _static_gate(estimates, gate, max_static_ratio),
        agreeing,
        weight,
        depth=depth,
        sigma=sigma,
        sigma_shared=depth * depth * _root(shared_2),
        parallax_deg=parallax.amax(0),
    )


def _largest_agreement(
    inverse: Tensor, variance: Tensor, sureness: Tensor, answered: Tensor, max_chi2: float
) -> Tensor:
    """Views (V, B, N) that agree with the view of highest score, itself included."""
    chi2 = (inverse[:, None] - inverse).square() / (variance[:, None] + variance)
    agree = answered[:, None] & answered & (chi2 <= max_chi2)
    support = torch.where(agree, sureness, torch.zeros_like(sureness)).sum(1)
    best = support.argmax(0)  # the first of equals
    return agree.gather(0, best[None, None].expand(1, *agree.shape[1:]))[0]


def _is_answered(estimates: Estimate) -> Tensor:
    """(V, B, N) bool: answered, with a finite positive sigma."""
    return estimates.keep & (estimates.depth > 0) & (estimates.sigma > 0) & estimates.sigma.isfinite()


def _mean(inverse: Tensor, variance: Tensor, used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Weights, inverse-variance mean (of no view: 1) and chi² per view beyond the first of the ``used`` (V, B, N)."""
    weight = torch.where(used, 1 / variance, torch.zeros_like(variance))
    total, n = weight.sum(0), used.sum(0)
    weight = weight / torch.where(n > 0, total, torch.ones_like(total))
    mean = torch.where(n > 0, (weight * inverse).sum(0), torch.ones_like(total))
    chi2 = torch.where(used, (inverse - mean).square() / variance, torch.zeros_like(variance)).sum(0)
    return weight, mean, chi2 / (n - 1).clamp_min(1)


def _static_gate(estimates: Estimate, gate: Tensor, max_static_ratio: float) -> Tensor:
    """The gates (B, N); NO_BASELINE for all points of a reference view whose views mostly have none."""
    static = (estimates.gate == Gate.NO_BASELINE).any(-1).sum(0) > max_static_ratio * len(estimates.gate)
    return torch.where(static[:, None], Gate.NO_BASELINE, gate).to(torch.int32)


def _joint_estimate(
    estimates: Estimate,
    gate: Tensor,  # (B, N)
    used: Tensor,  # (V, B, N) bool, the views of the mean
    weight: Tensor,  # (V, B, N)
    *,
    depth: Tensor,  # (B, N) m
    sigma: Tensor,
    sigma_shared: Tensor,
    parallax_deg: Tensor,
    correlation: float = 1.0,
) -> Estimate:
    """The joint estimate under the gates; its residual is the weighted rms of the views, of no view the last one's."""
    dtype = estimates.depth.dtype
    keep = gate == Gate.ANSWER
    n = used.sum(0)
    residual_px = torch.where(used, estimates.residual_px, torch.zeros_like(estimates.residual_px))
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
        parts=_joint_parts(estimates, used, weight, depth, sigma, correlation).to(dtype),
    )


def _joint_parts(
    estimates: Estimate, used: Tensor, weight: Tensor, depth: Tensor, sigma: Tensor, correlation: float
) -> SigmaBudget:
    """Variances (B, N) of the joint depth by cause: each term joined as the whole, what joining adds in ``model``."""
    parts = estimates.kept_parts
    square = torch.where(used, estimates.depth.double(), 1.0).square()

    def deviations(x: Tensor) -> Tensor:
        """Weighted standard deviations (V, B, N) of the joint depth by one term of the views."""
        return weight * _root(torch.where(used, x.double(), 0.0)) / square * depth.square()

    track, *common = (deviations(x) for x in parts.values())
    own = correlation * track.sum(0).square() + (1 - correlation) * track.square().sum(0)
    pose, reference, lens, model = (x.sum(0).square() for x in common)
    widening = (sigma.square() - own - pose - reference - lens).clamp_min(0)
    return SigmaBudget(own, pose, reference, lens, torch.maximum(model, widening))


def _inverse_depth(estimates: Estimate, answered: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depth and the own and shared parts of its standard deviation, float64; 1 where unanswered."""
    one = torch.ones_like(estimates.depth)
    inverse = 1 / torch.where(answered, estimates.depth, one).double()
    total = torch.where(answered, estimates.sigma, one).double() * inverse * inverse
    shared = torch.where(answered, estimates.sigma_shared, 0 * one).double() * inverse * inverse
    # The own part of a variance is at least a thousandth, whatever the pose's part.
    own = (total.square() - shared.square()).clamp_min(1e-3 * total.square()).sqrt()
    return inverse, own, shared


def _furthest_reason(gate: Tensor, answered: Tensor) -> Tensor:
    """Gate (B, N) of the unanswered view (V, B, N) in which the point came furthest; gates are in order of precedence.

    NO_POSE for all points where no view has a pose: that some are not tracked either is not why they stay unanswered.
    """
    reason = torch.where(answered | (gate == Gate.ANSWER), -1, gate).amax(0)
    reason = torch.where(reason < 0, Gate.INCONSISTENT, reason)
    no_pose = (gate == Gate.NO_POSE).any(-1).all(0)
    untracked = (reason == Gate.NO_TRACK) | (reason == Gate.NO_TEXTURE)
    return torch.where(no_pose[:, None] & untracked, Gate.NO_POSE, reason).to(gate.dtype)


def _root(x: Tensor) -> Tensor:
    """Square root with a finite gradient at zero."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, torch.ones_like(x)).sqrt(), torch.zeros_like(x))
