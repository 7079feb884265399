"""Between stages 6 and 7: errors that all points of a source view share, seen over the views of one reference view.

The pose's covariance is that of noise. Calibration, distortion, rows that are exposed one after the other and near
things that move on their own add errors that are the same for all points of a view: no residual shows them where they
look like a translation. They show in three ways: a rotation between the views is much larger than the parallax that it
is to be told from; independent poses give the same points different depths; or most views have no motion that fits.

Alphabet: ``ratio`` the parallax of a point over the angle of rotation between the views, without unit.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dhtorch.codes import Gate
from dhtorch.geometry import se3
from dhtorch.geometry.checks import check
from dhtorch.geometry.covariance import masked_median
from dhtorch.records import Estimate, PoseFit, Samples, Tracks

#: Least angle of rotation, rad: limits the ratio from above. Source: derived, 1e-4 rad is .05 px at f = 500 px.
MIN_TURN = 1e-4

#: Fewest points from which a ratio or a disagreement is measured, a count. Source: chosen on the built-in rooms.
MIN_SHARED_POINTS = 12


def verify_views(
    samples: Samples,
    tracks: Tracks,  # (V, B, N)
    fits: PoseFit,  # (V, B)
    estimates: Estimate,  # (V, B, N)
    *,
    min_ratio: float | None = 0.13,
    turn_share: float = 0.0075,
    max_disagreement: float | None = 5.0,
    min_disagreement: float = 0.12,
    max_refuted: float | None = 1.0,
) -> Estimate:
    """Estimates (V, B, N) with the error that the points of a view share; without the views that cannot be right.

    Args:
        samples: (B, N) of the reference view; those without a return count.
        tracks, fits, estimates: of its V source views.
        min_ratio: median ratio of a view's points below which it has no baseline; None = no limit.
        turn_share: fraction of the angle of rotation that is taken as an error of direction common to all points. It
            adds ``turn_share / ratio`` to the relative sigma, shared and whole, of every point.
        max_disagreement: median logarithm of the ratio of two views' depths of the same points, in standard deviations
            of what is common to the points, above which the views contradict each other; None = no limit.
        min_disagreement: the same logarithm itself, up to which views never contradict each other.
        max_refuted: views without a motion that fits (no baseline, returns at wrong pixels, far tracks that contradict)
            although their tracks move further than those of a view that answers, per answering view, above which no
            view is used; None = no limit.

    Gates: NO_BASELINE for all points of a view that turns too much; CONTRADICTED for all answers of a reference view
    whose views contradict each other or are mostly refuted.

    Raises:
        ValueError: wrong shapes.

    Gradient: sigma to parallax, rotation and depth; gates carry none.
    Cost: linear in N, and in pairs of views.
    """
    check("verify_views", gate=(estimates.gate, "V B N"), uv=(samples.uv, "B N 2"), valid=(tracks.valid, "V B N"))
    check("verify_views", gate=(estimates.gate, "V B N"), R=(fits.T_1_from_0.R, "V B 3 3"))
    far = ~samples.usable
    refuted = _refuted_views(estimates, tracks)
    turn = _turn(fits)[..., None]  # (V, B, 1)
    ratio = estimates.parallax_deg * (math.pi / 180) / turn
    if turn_share > 0:
        estimates = _widen(estimates, turn_share / ratio.clamp_min(1e-6))
    if min_ratio is not None:
        used = estimates.keep & far
        is_turn = (_median(ratio.detach(), used) < min_ratio) & (used.sum(-1, keepdim=True) >= MIN_SHARED_POINTS)
        estimates = _unanswer(estimates, is_turn, Gate.NO_BASELINE)
    contradicted = torch.zeros_like(far[:, :1])
    if max_disagreement is not None:
        contradicted = contradicted | _disagree(estimates, far, max_disagreement, min_disagreement)
    if max_refuted is not None:
        contradicted = contradicted | (refuted >= max_refuted)[:, None]
    return _unanswer(estimates, contradicted.expand_as(estimates.gate[..., :1]), Gate.CONTRADICTED)


def _turn(fits: PoseFit) -> Tensor:
    """Angle of rotation (V, B) between the views, rad; 0 without a pose, at least :data:`MIN_TURN` with one."""
    R = torch.where(fits.ok[..., None, None], fits.T_1_from_0.R, torch.eye(3).to(fits.T_1_from_0.R))
    return se3.rotation_angle(R).clamp_min(MIN_TURN)


def _widen(estimates: Estimate, relative: Tensor) -> Estimate:
    """The estimates with a further common error, relative to depth (V, B, N)."""
    added = torch.where(estimates.keep, relative * estimates.depth, 0.0).square()
    sigma = torch.where(estimates.keep, (estimates.sigma.square() + added).sqrt(), estimates.sigma)
    shared = torch.where(estimates.keep, (estimates.sigma_shared.square() + added).sqrt(), estimates.sigma_shared)
    return estimates.replace(sigma=sigma, sigma_shared=shared)


def _unanswer(estimates: Estimate, rejected: Tensor, gate: int) -> Estimate:
    """The estimates without the answers of the ``rejected`` (V, B, 1), and with that gate on the other tracked points
    of views without a baseline, which have none at any point."""
    lost = estimates.keep & rejected
    gone = {name: getattr(estimates, name).masked_fill(lost, torch.nan) for name in ("depth", "sigma", "sigma_shared")}
    return estimates.replace(
        **gone, score=estimates.score.masked_fill(lost, 0.0), gate=estimates.gate.masked_fill(lost, gate)
    )


def _disagree(estimates: Estimate, far: Tensor, max_sigmas: float, least: float) -> Tensor:
    """Whether (B, 1) two views give the same points depths that differ by a common factor beyond their sigmas."""
    keep = estimates.keep & far & (estimates.depth > 0) & estimates.sigma.isfinite()
    depth = torch.where(keep, estimates.depth, 1.0).detach().double()
    shared = torch.where(keep, estimates.sigma_shared, 0.0).detach().double() / depth
    own = (torch.where(keep, estimates.sigma, 0.0).detach().double() / depth).square() - shared.square()
    V = len(depth)
    found = torch.zeros_like(far[:, :1])
    for i in range(V):
        for j in range(i):
            both = keep[i] & keep[j]
            n = both.sum(-1, keepdim=True)
            factor = masked_median((depth[i] / depth[j]).log(), both).abs()
            variance = masked_median(shared[i].square() + shared[j].square(), both)
            variance = variance + masked_median((own[i] + own[j]).clamp_min(0), both) / n.clamp_min(1)
            wrong = (factor > least) & (factor > max_sigmas * variance.sqrt())
            found = found | (wrong & (n >= MIN_SHARED_POINTS))
    return found


def _refuted_views(estimates: Estimate, tracks: Tracks) -> Tensor:
    """Views without a motion that fits, although their tracks move further than an answering view's, per answering
    view (B,); 0 without an answering view."""
    motion = (tracks.uv_1 - tracks.uv_0).detach().norm(dim=-1)
    motion = torch.where(tracks.valid.any(-1), _median(motion, tracks.valid)[..., 0], 0.0)  # (V, B)
    answers = estimates.keep.any(-1)
    least = torch.where(answers, motion, torch.inf).amin(0)
    refuting = (Gate.NO_BASELINE, Gate.CONTRADICTED)
    refuted = torch.stack([(estimates.gate == code).any(-1) for code in refuting]).any(0) & ~answers
    refuted = refuted & (motion >= least)
    return torch.where(answers.any(0), refuted.sum(0) / answers.sum(0).clamp_min(1), 0.0)


def _median(x: Tensor, used: Tensor) -> Tensor:
    """Median (V, B, 1) of the used entries of (V, B, N); 1 where there is none."""
    return masked_median(x.flatten(0, 1), used.flatten(0, 1)).unflatten(0, x.shape[:2])
