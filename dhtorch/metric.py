"""Anybody's depth in metres: a map tied to near returns and far answers, with a sigma for every pixel.

    map ─┐                ┌─ raw ────────────────┐
         ├─ robust heads ─┼─ scale, scale + shift ┼─ left-out blocks ─ chosen ─ DepthMap
    anchors ┘             └─ and a smooth field ──┘

What a map lacks is a metre, then a shift, then a slow drift over picture and depth. More is believed only as far as
anchors that were left out agree better with it; where they do not, the map is left alone.

Alphabet: ``x`` value of the map, ``y`` what it stands for (depth, or inverse depth), ``y = s x + t`` the head, ``phi``
hat functions of place and log depth, ``log z = log z(head) + phi · beta``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Gate, Source, first_reason
from dhtorch.geometry.covariance import median
from dhtorch.geometry.least_squares import solve_spd
from dhtorch.geometry.lookup import nearest
from dhtorch.geometry.shapes import check
from dhtorch.records import DepthMap, Estimate, Samples

#: What a map may be: metres as it says, depth up to a scale, up to a scale and a shift, inverse depth up to both, or
#: any rising function of depth.
KINDS: Final = ("metric", "scale", "affine", "inverse", "ordinal")

#: Anchors of one source that are used at most, evenly spread over its samples or pixels.
MOST = 1024

#: Nodes of the field over the picture (rows, columns), and of the correction over log depth.
NODES, KNOTS = (5, 6), 5

#: Unknowns of an error that all far answers share.
LEANS = 4

#: Correlation length of the field as a share of the picture's longer side, and of the other as one of the range.
LENGTH, RANGE = 0.3, 0.4

#: Relative error that every map has by itself, from pixel to pixel, and degrees of freedom of Student's t.
FLOOR, FREEDOM = 0.01, 4.0

#: Share of it that stays where map and anchors agree perfectly.
LEAST = 0.3

#: Relative error that far answers have beside what they state, each alone and all together: matches that slip, and
#: motions that their covariance takes for better than they are.
FAR_ALONE, FAR_SHARED = 0.02, 0.03

#: Squared sigmas at which a left-out anchor counts as half lost.
LOST = 9.0

#: Blocks (rows, columns) that are left out together, in so many turns.
BLOCKS, FOLDS = (6, 8), 4

#: Anchors of one block that count as one where their errors are the map's own.
CORRELATED = 0.2

#: Standard errors by which a richer model must beat a simpler one on anchors that it has not seen.
SURE = 2.0

#: And by what loss at least: an error that all anchors of a kind share is the same in all blocks.
MARGIN = 0.02

#: Fewest anchors of a fit, and share of a far map's variance that all its pixels share (its motion's).
FEWEST, SHARED = 8, 0.5

#: Sigma of the shift of a map that claims to have none, as a share of the anchors' median depth.
NO_SHIFT = 1e-6


class Model(NamedTuple):
    """How much of a map is taken to be wrong. Simplest first."""

    near: bool  # fitted to the near returns alone
    scale: bool
    shift: bool
    field: float  # standard deviation of the field, of log depth; 0 = none
    curve: float  # the same for the correction over log depth


MODELS: Final = {
    "raw": Model(False, False, False, 0.0, 0.0),
    "near_scale": Model(True, True, False, 0.0, 0.0),
    "near_affine": Model(True, True, True, 0.0, 0.0),
    "scale": Model(False, True, False, 0.0, 0.0),
    "affine": Model(False, True, True, 0.0, 0.0),
    "scale_field": Model(False, True, False, 0.03, 0.01),
    "affine_field": Model(False, True, True, 0.03, 0.01),
    "bent_field": Model(False, True, False, 0.06, 0.02),
}

#: Kind → models that make sense of it.
_OF_KIND: Final = {
    "metric": tuple(MODELS),
    "scale": tuple(name for name in MODELS if name != "raw"),
    "affine": ("near_affine", "affine", "affine_field"),
    "inverse": ("near_affine", "affine", "affine_field"),
    "ordinal": ("near_affine", "affine", "affine_field"),
}


class Anchors(NamedTuple):
    """What is known in metres, on pixels of the map; (B, N) each."""

    place: Tensor  # (B, N, 2) px of the map
    x: Tensor  # the map there, in y's unit
    depth: Tensor  # m
    var: Tensor  # of log depth, what each has alone
    shared: Tensor  # standard deviation of log depth that all far ones have in common
    near: Tensor  # bool
    used: Tensor  # bool
    block: Tensor  # int64, part of the picture; near and far ones of one part are two


class Fit(NamedTuple):
    """A model fitted: head, field and their covariances."""

    head: Tensor  # (B, 2)
    head_cov: Tensor  # (B, 2, 2)
    beta: Tensor  # (B, P)
    cov: Tensor  # (B, P, P)
    ok: Tensor  # (B,) bool


class Chosen(NamedTuple):
    """Which model was taken, and how all did on anchors left out; for reports."""

    model: Tensor  # (B,) int64, place in ``names``
    names: tuple[str, ...]
    loss: Tensor  # (K, B) mean over blocks, inf where a model could not be fitted
    factor: Tensor  # (B,) by which sigmas were stretched
    good: Tensor  # (K, B) bool, what the anchors do not refute


def anchor(
    depth_map: Tensor,  # (B, h, w) or DepthMap
    anchors: Samples | Estimate | DepthMap | Sequence[Samples | Estimate | DepthMap],
    *,
    hw: tuple[int, int] | None = None,
    kind: str = "metric",
    max_sigma_rel: float = 0.5,
    trace: dict[str, Chosen] | None = None,
) -> DepthMap:
    """A map of anybody's, in metres, with a sigma for every pixel.

    Robust heads (Student's t) tie the map to the anchors: nothing, a scale, a scale and a shift, from the near returns
    alone or from all. On top may lie a field over the picture and a correction over log depth, both Gaussian processes
    on coarse nodes, so that they are zero away from anchors. Every model is fitted without some blocks of the picture
    and held against the anchors there; the simplest one is taken that is not surely worse than the best, and how far
    the others of these are from it is part of sigma. An error that all far answers share (the motion's) is an unknown
    of the fit and no part of the answer.

    Args:
        depth_map: values (B, h, w) over the field of the picture; not finite, or not positive where depth is meant,
            is no value.
        anchors: near returns (usable ``Samples``), far answers (``Estimate``) or maps (``DepthMap``; pixels whose
            source is the sensor count as near), one or several.
        hw: height and width of the picture in whose pixels samples and estimates are; None = the map's.
        kind: ``metric`` (may be right as it is), ``scale``, ``affine`` (depth up to scale and shift), ``inverse``
            (disparity up to both) or ``ordinal`` (any rising function of depth).
        max_sigma_rel: sigma / depth above which a pixel is silent.
        trace: gets ``chosen``.

    Returns:
        DepthMap of source ANCHORED. Score is 0.1 / (0.1 + sigma / depth). Gates: NO_TRACK where the map has no value,
        NO_POSE where the anchors are fewer than eight or no model can be fitted, UNCERTAIN.

    Raises:
        ValueError: wrong shapes, an unknown kind, no anchors, a limit that is not positive.

    Gradient: depth to the map and to the anchors' depth and sigma, through all reweighted solves (first order); the
    choice of the model, ``ordinal``'s order of values and the answer's sigma carry none.
    Source: Student's t by iteratively reweighted least squares: K. Lange et al., "Robust statistical modeling using
    the t distribution", 1989; blocks: D. Roberts et al., "Cross-validation strategies for data with structure", 2017.
    """
    values = depth_map.depth if isinstance(depth_map, DepthMap) else depth_map
    check("anchor", depth_map=(values, "B h w"))
    if kind not in KINDS:
        raise ValueError(f"anchor: kind is {kind!r}, expected one of {', '.join(KINDS)}")
    if not max_sigma_rel > 0:
        raise ValueError(f"anchor: max_sigma_rel is {max_sigma_rel}, expected a positive number")
    given = [anchors] if isinstance(anchors, Samples | Estimate | DepthMap) else list(anchors)
    if not given:
        raise ValueError("anchor: found no anchors, expected near returns, far answers, or both")
    size = (values.shape[-2], values.shape[-1])
    x = values.double()
    known = x.isfinite() & ((x > 0) if kind in ("metric", "scale") else torch.ones_like(x, dtype=torch.bool))
    known = known & (depth_map.keep if isinstance(depth_map, DepthMap) else known)
    points = anchored(torch.where(known, x, torch.nan), given, hw or size)
    if kind == "ordinal":
        x = _ordered(x, points)
        points = points._replace(x=_ordered(points.x, points))
    # Values of any unit: 1 is the median of the anchored ones.
    unit = median(points.x.abs(), points.used).clamp_min(1e-12) if kind != "metric" else torch.ones_like(x[:, 0, :1])
    x, points = x / unit[..., None], points._replace(x=points.x / unit)
    basis = _Basis(x, known, points, size)
    fits, chosen = _choose(points, basis, kind)
    if trace is not None:
        trace["chosen"] = chosen
    return _answered((x, known), points, basis, fits, chosen, (kind, max_sigma_rel, values.dtype))


def anchored(x: Tensor, given: Sequence[Samples | Estimate | DepthMap], hw: tuple[int, int]) -> Anchors:
    """All anchors on the pixels of a map (B, h, w), NaN where it has no value; those without one are not used."""
    h, w = x.shape[-2:]
    found = []
    for one in given:
        depth, sigma = one.depth.double(), one.sigma.double()
        if isinstance(one, DepthMap):
            rows, columns = (torch.arange(n, device=x.device).double() for n in depth.shape[-2:])
            v, u = torch.meshgrid((rows + 0.5) / len(rows), (columns + 0.5) / len(columns), indexing="ij")
            share = torch.stack([u, v], -1).flatten(0, 1).expand(len(depth), -1, -1)
            depth, sigma, keep = (x.flatten(1) for x in (depth, sigma, one.keep))
            near = (one.source == Source.SENSOR).flatten(1)
            shared = torch.where(near, 0.0, SHARED**0.5 * sigma)
        else:
            share = (one.uv.double() + 0.5) / one.uv.new_tensor([hw[1], hw[0]]).double()
            keep = one.usable if isinstance(one, Samples) else one.keep
            near = torch.full_like(keep, isinstance(one, Samples))
            shared = torch.zeros_like(sigma) if isinstance(one, Samples) else one.sigma_shared.double()
        check("anchor", depth_map=(x, "B h w"), anchors=(share, "B N 2"))
        n = depth.shape[1]
        pick = torch.linspace(0, n - 1, min(n, MOST), device=x.device).round().long()
        place = share[:, pick] * share.new_tensor([w, h]) - 0.5
        z, s, c = depth[:, pick], sigma[:, pick], shared[:, pick]
        value, inside = nearest(x, place)
        use = keep[:, pick] & inside & value.isfinite() & z.isfinite() & (z > 0) & s.isfinite() & (s >= 0)
        z = torch.where(use, z, 1.0)
        rel, together = (torch.where(use, q / z, 0.0) for q in (s, c))
        var = (rel.square() - together.square()).clamp_min(0) + FLOOR**2
        is_far = ~near[:, pick]
        var = var + FAR_ALONE**2 * is_far
        together = torch.where(is_far, (together.square() + FAR_SHARED**2).sqrt(), 0.0)
        cell = (share[:, pick] * share.new_tensor([BLOCKS[1], BLOCKS[0]])).floor().long()
        column, row = cell[..., 0].clamp(0, BLOCKS[1] - 1), cell[..., 1].clamp(0, BLOCKS[0] - 1)
        block = 2 * (row * BLOCKS[1] + column) + near[:, pick].long()
        told = torch.where(use, value, 1.0)
        rest = {"var": var, "shared": together, "near": near[:, pick], "used": use, "block": block}
        found.append(Anchors(place=place, x=told, depth=z, **rest))
    return Anchors(*(torch.cat(parts, 1) for parts in zip(*found, strict=True)))


def _ordered(x: Tensor, points: Anchors) -> Tensor:
    """Values through the rising broken line that fits the anchors' depths best: means of equally many anchors, joined
    where they fall (isotonic regression as its min-max formula)."""
    n_knots = 12
    huge = torch.where(points.used, points.x.detach(), torch.inf)
    order = huge.argsort(-1)
    value, log_z = points.x.detach().gather(1, order), points.depth.log().gather(1, order)
    count = points.used.sum(-1, keepdim=True)
    rank = torch.arange(order.shape[1], device=x.device) / count.clamp_min(1)
    bins = torch.arange(n_knots, device=x.device)[:, None]
    inside = ((rank * n_knots).floor()[:, None] == bins).double()  # (B, knots, N)
    mass = inside.sum(-1).clamp_min(1e-9)
    at, level = (inside @ value[..., None])[..., 0] / mass, (inside @ log_z[..., None])[..., 0] / mass
    heavy = torch.cat((torch.zeros_like(mass[:, :1]), mass.cumsum(-1)), -1)
    total = torch.cat((torch.zeros_like(mass[:, :1]), (mass * level).cumsum(-1)), -1)
    mean = (total[:, None, 1:] - total[:, :-1, None]) / (heavy[:, None, 1:] - heavy[:, :-1, None]).clamp_min(1e-9)
    upper = torch.triu(torch.ones(n_knots, n_knots, dtype=torch.bool, device=x.device))
    mean = torch.where(upper, mean, torch.inf)  # (B, from, to)
    least = mean.flip(-1).cummin(-1).values.flip(-1)  # over all ends from k on
    rising = torch.where(upper, least, -torch.inf).amax(1)
    at = at + 1e-9 * torch.arange(n_knots, device=x.device)
    flat = x.flatten(1)
    right = torch.searchsorted(at.contiguous(), flat.detach().contiguous()).clamp(1, n_knots - 1)
    x0, x1, y0, y1 = (c.gather(1, k) for c in (at, rising) for k in (right - 1, right))
    slope = (y1 - y0) / (x1 - x0).clamp_min(1e-9)
    return (y0 + slope * (flat - x0)).clamp(-7, 7).exp().view_as(x)


class _Basis:
    """Hat functions over picture and log value, and what is believed of their weights beforehand."""

    def __init__(self, x: Tensor, known: Tensor, points: Anchors, size: tuple[int, int]) -> None:
        rows, columns = NODES
        self.size = size
        log = torch.where(known & (x > 0), x.clamp_min(1e-12), torch.nan).log().flatten(1)
        low, high = log.nan_to_num(torch.inf).amin(-1), log.nan_to_num(-torch.inf).amax(-1)
        some = low < high
        self.low = torch.where(some, low, 0.0)[:, None]
        self.width = torch.where(some, high - low, 1.0)[:, None]
        share = (points.place + 0.5) / x.new_tensor([size[1], size[0]])
        across, down = _hats(share[..., 0], columns), _hats(share[..., 1], rows)
        self.field = (down[..., :, None] * across[..., None, :]).flatten(-2)
        self.curve = _hats(self.level(points.x), KNOTS)
        # What a wrong motion does to far answers: a wrong scale, and a lean that grows with depth.
        z = points.depth / median(points.depth, points.used)
        lean = torch.stack((torch.ones_like(z), z - 1, *(z * (2 * share[..., k] - 1) for k in (0, 1))), -1).clamp(-3, 3)
        shared = points.shared[..., None] * lean
        self.phi = torch.cat((torch.ones_like(z)[..., None], self.field, self.curve, shared), -1)
        longer = max(size)
        v, u = torch.meshgrid(
            torch.linspace(0, size[0] / longer, rows), torch.linspace(0, size[1] / longer, columns), indexing="ij"
        )
        node = torch.stack((u, v), -1).flatten(0, 1).to(x)
        self.of_field = _inverse_kernel(node, LENGTH)
        self.of_curve = _inverse_kernel(torch.linspace(0, 1, KNOTS)[:, None].to(x), RANGE)

    def level(self, x: Tensor) -> Tensor:
        """Log value from 0, the smallest of the map, to 1."""
        log = x.clamp_min(1e-12).log()
        return ((log.flatten(1) - self.low) / self.width).clamp(0, 1).view_as(x)

    def precision(self, model: Model) -> Tensor:
        """Of the weights (P, P) under a model."""
        tight = 1e8
        field = (
            self.of_field / model.field**2 if model.field else tight * torch.eye(len(self.of_field)).to(self.of_field)
        )
        curve = self.of_curve / model.curve**2 if model.curve else tight * torch.eye(KNOTS).to(self.of_curve)
        free = 1e4 if model.field or model.curve else tight
        one = torch.ones(1, 1).to(field)
        return torch.block_diag(free * one, field, curve, torch.eye(LEANS).to(field))


def _hats(share: Tensor, n: int) -> Tensor:
    """Hat functions (..., n) at places between 0 and 1."""
    at = share.clamp(0, 1)[..., None] * (n - 1)
    return (1 - (at - torch.arange(n, device=share.device)).abs()).clamp_min(0)


def _inverse_kernel(node: Tensor, length: float) -> Tensor:
    square = (node[:, None] - node).square().sum(-1)
    K = (-0.5 * square / length**2).exp() + 1e-3 * torch.eye(len(node)).to(node)
    return torch.linalg.inv(K)


def _solve(points: Anchors, basis: _Basis, model: Model, use: Tensor, kind: str) -> Fit:
    """One model fitted to the anchors in ``use`` (B, N) bool."""
    use = use & (points.near | (not model.near))
    far = ~points.near & use
    target = 1 / points.depth if kind == "inverse" else points.depth
    scale = 1 / target  # residuals are relative
    ones = torch.ones_like(points.x)
    A = torch.stack((points.x, ones), -1) * scale[..., None]
    rhs = target * scale
    level = median(target.detach(), use)[..., 0]
    prior = torch.tensor([1e-6, 1e-6], dtype=A.dtype, device=A.device).expand(len(A), 2).clone()
    raw = torch.tensor([1.0, 0.0], dtype=A.dtype, device=A.device).expand(len(A), 2)
    if not model.shift:
        prior[:, 1] = 1 / (NO_SHIFT * level).square()
    var = points.var + torch.where(far, points.shared, 0.0).square()
    weight = _spread(points, use) / var
    head, head_cov = raw, A.new_zeros(len(A), 2, 2)
    enough = use.sum(-1) >= FEWEST
    if model.scale:
        r = torch.zeros_like(rhs)
        for _ in range(8):
            w = weight * _student(r, var)
            H = (A * w[..., None]).mT @ A + torch.diag_embed(prior)
            solved, ok = solve_spd(H, (A * w[..., None]).mT @ rhs[..., None])
            head = solved[..., 0]
            r = (A * head[:, None]).sum(-1) - rhs
        head_cov, _ = solve_spd(H.detach(), torch.eye(2).to(H).expand_as(H))
        enough = enough & ok & (head[:, 0] > 0)
    P = basis.phi.shape[-1]
    miss = points.depth.log() - _log_depth(points.x * head[:, :1] + head[:, 1:], kind)
    if not (model.field or model.curve):
        return Fit(head, head_cov, head.new_zeros(len(head), P), head.new_zeros(len(head), P, P), enough)
    weight = _spread(points, use) / points.var
    prior_beta, r = basis.precision(model), miss
    for _ in range(5):
        w = weight * _student(r, points.var)
        phi = basis.phi * w[..., None]
        H = phi.mT @ basis.phi + prior_beta
        beta, ok = solve_spd(H, phi.mT @ miss[..., None])
        r = miss - (basis.phi @ beta)[..., 0]
    cov, _ = solve_spd(H.detach(), torch.eye(P).to(H).expand_as(H))
    return Fit(head, head_cov, beta[..., 0], cov, enough & ok)


def _student(r: Tensor, var: Tensor) -> Tensor:
    """Weights of residuals under Student's t."""
    return (FREEDOM + 1) / (FREEDOM + r.square() / var)


def _spread(points: Anchors, use: Tensor) -> Tensor:
    """Weight (B, N) of each anchor among those of its block, 0 where it is not used."""
    count = points.x.new_zeros(len(use), 2 * BLOCKS[0] * BLOCKS[1])
    count = count.scatter_add(1, points.block, use.to(count)).gather(1, points.block)
    return use / (1 + CORRELATED * (count - 1).clamp_min(0))


def _log_depth(y: Tensor, kind: str) -> Tensor:
    """Of what a head says; a head that says nothing positive says a millimetre, or a kilometre."""
    log = y.clamp_min(1e-3).log()
    return -log if kind == "inverse" else log


def _predicted(fit: Fit, points: Anchors, basis: _Basis, kind: str) -> tuple[Tensor, Tensor]:
    """Log depth (B, N) at the anchors and its variance."""
    y = points.x * fit.head[:, :1] + fit.head[:, 1:]
    phi = torch.cat((basis.phi[..., :-LEANS], torch.zeros_like(basis.phi[..., -LEANS:])), -1)
    log = _log_depth(y, kind) + (phi @ fit.beta[..., None])[..., 0]
    var = ((phi @ fit.cov) * phi).sum(-1) + _of_head(fit, points.x, y)
    return log.detach(), var.detach()


def _of_head(fit: Fit, x: Tensor, y: Tensor) -> Tensor:
    """Variance of log depth by the head's covariance."""
    ss, st, tt = (fit.head_cov[:, i, j].view(-1, *(1,) * (x.dim() - 1)) for i, j in ((0, 0), (0, 1), (1, 1)))
    return (x.square() * ss + 2 * x * st + tt).clamp_min(0) / y.detach().square().clamp_min(1e-6)


def _choose(points: Anchors, basis: _Basis, kind: str) -> tuple[list[Fit], Chosen]:
    """All models fitted to all anchors, and which of them is taken."""
    names = _OF_KIND[kind]
    block = points.block // 2
    fold = (block // BLOCKS[1] * 2 + block % BLOCKS[1]) % FOLDS
    with torch.no_grad():
        turns = [_left_out(points, basis, kind, names, fold == k) for k in range(FOLDS)]
        fold_of = torch.nn.functional.one_hot(fold, FOLDS).bool()
        missed, var, ok = (
            torch.stack(parts, -1) for parts in zip(*turns, strict=True)
        )  # (K, B, N, F) twice, (K, B, F)
        missed, var = ((x * fold_of).sum(-1) for x in (missed, var))
        fine = ok.all(-1)
        noise = points.var + torch.where(points.near, 0.0, points.shared).square()
        square = missed.square() / noise
        loss = square / (square + LOST)  # bounded: a model shall not be bent for what is wrong by far
        by_block, count = _by_block(loss, points)
        mean = (by_block * count).sum(-1) / count.sum(-1).clamp_min(1)
        mean = torch.where(fine, mean, torch.inf)
        best = mean.argmin(0)
        at = best[None, :, None].expand(1, -1, by_block.shape[-1])
        more = by_block - by_block.gather(0, at)
        n = count.sum(-1).clamp_min(1)
        average = (more * count).sum(-1) / n
        spread = (((more - average[..., None]).square() * count).sum(-1) / n / n).sqrt()
        good = fine & (average <= SURE * spread + MARGIN)
        model = good.to(torch.int8).argmax(0)
        own = missed.gather(0, model[None, :, None].expand(1, *missed.shape[1:]))[0]
        own_var = var.gather(0, model[None, :, None].expand(1, *var.shape[1:]))[0]
        factor = _stretch(own, own_var + noise, points)
        some = fine.any(0) & (points.used.sum(-1) >= FEWEST)
        model = torch.where(some, model, -1)
    fits = [_solve(points, basis, MODELS[name], points.used, kind) for name in names]
    return fits, Chosen(model, names, mean, factor, good)


def _left_out(
    points: Anchors, basis: _Basis, kind: str, names: Sequence[str], out: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """How far all models (K, B, N) miss all anchors in log depth when some are left out, their variance, whether they
    could be fitted (K, B)."""
    missed, var, ok = [], [], []
    for name in names:
        fit = _solve(points, basis, MODELS[name], points.used & ~out, kind)
        log, own = _predicted(fit, points, basis, kind)
        missed.append(points.depth.log() - log)
        var.append(own)
        ok.append(fit.ok)
    return torch.stack(missed), torch.stack(var), torch.stack(ok)


def _by_block(loss: Tensor, points: Anchors) -> tuple[Tensor, Tensor]:
    """Mean loss of every block (K, B, blocks), and which blocks have anchors (B, blocks)."""
    n = 2 * BLOCKS[0] * BLOCKS[1]
    count = points.x.new_zeros(len(points.x), n).scatter_add(1, points.block, points.used.to(points.x))
    index = points.block.expand_as(loss)
    total = loss.new_zeros(*loss.shape[:-1], n).scatter_add(-1, index, loss * points.used)
    return total / count.clamp_min(1), (count > 0).to(loss)


def _stretch(missed: Tensor, var: Tensor, points: Anchors) -> Tensor:
    """By how much sigma (B,) must grow or shrink for 68 % of the anchors left out to lie within one."""
    ratio = torch.where(points.used, missed.abs() / var.sqrt(), torch.nan)
    factor = ratio.nanquantile(0.683, dim=-1)
    n = points.used.sum(-1)
    return ((factor.nan_to_num(1.0).log() * n / (n + 20)).exp()).clamp(0.3, 5.0)


def _answered(
    at: tuple[Tensor, Tensor],  # the map (B, h, w) and where it has a value
    points: Anchors,
    basis: _Basis,
    fits: list[Fit],
    chosen: Chosen,
    told: tuple[str, float, torch.dtype],  # kind, max_sigma_rel, of the answer
) -> DepthMap:
    (x, known), (kind, max_sigma_rel, dtype) = at, told
    index = chosen.model.clamp_min(0)

    def pick(name: str) -> Tensor:
        every = torch.stack([getattr(fit, name) for fit in fits], 1)
        row = index.view(-1, *(1,) * (every.dim() - 1)).expand(-1, 1, *every.shape[2:])
        return every.gather(1, row)[:, 0]

    fit = Fit(*(pick(name) for name in Fit._fields))
    safe = torch.where(known, x, torch.ones_like(x))
    share = [(torch.arange(k, device=x.device) + 0.5) / k for k in basis.size]
    hats = _hats(share[0].to(x), NODES[0]), _hats(share[1].to(x), NODES[1])
    y, log = _log_map(fit, safe, basis, kind, hats)
    depth = log.exp()
    (down, across), n = hats, NODES[0] * NODES[1]
    with torch.no_grad():
        var = _of_head(fit, safe, y) + _of_field(fit, down, across)
        knots = fit.cov.diagonal(dim1=-2, dim2=-1)[:, n + 1 : -LEANS]
        var = var + _between(knots, basis.level(safe)) + _local(points, basis, fit, kind, hats)
        sigma_rel = var.sqrt() * chosen.factor[:, None, None]
        doubt = torch.zeros_like(log)
        count = chosen.good.sum(0).clamp_min(1)[:, None, None]
        for one, good in zip(fits, chosen.good, strict=True):
            apart = _log_map(one, safe, basis, kind, hats)[1] - log
            doubt = doubt + torch.where(good[:, None, None], apart.square(), 0.0) / count
        sigma_rel = (sigma_rel.square() + doubt).sqrt()
        log_step = log - _around(log, known)
        sigma_rel = (sigma_rel.square() + (0.5 * log_step).square()).sqrt()
    silent = (chosen.model < 0)[:, None, None].expand_as(known)
    behind = (y <= 1e-3) | ~depth.isfinite()
    unsure = behind | ~(sigma_rel <= max_sigma_rel)
    gate = first_reason((~known, Gate.NO_TRACK), (silent, Gate.NO_POSE), (unsure, Gate.UNCERTAIN))
    keep = gate == Gate.ANSWER
    return DepthMap(
        depth=torch.where(keep, depth, torch.nan).to(dtype),
        sigma=torch.where(keep, sigma_rel * depth.detach(), torch.nan).to(dtype),
        score=torch.where(keep, 0.1 / (0.1 + sigma_rel), 0.0).to(dtype),
        source=torch.where(keep, Source.ANCHORED, Source.NONE).to(torch.int32),
        gate=gate,
    )


def _log_map(fit: Fit, x: Tensor, basis: _Basis, kind: str, hats: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """What a model's head says, and its log depth, (B, h, w) each."""
    n = NODES[0] * NODES[1]
    y = x * fit.head[:, :1, None] + fit.head[:, 1:, None]
    field = hats[0] @ fit.beta[:, 1 : n + 1].unflatten(1, NODES) @ hats[1].mT
    curve = _between(fit.beta[:, n + 1 : -LEANS], basis.level(x))
    return y, _log_depth(y, kind) + fit.beta[:, :1, None] + field + curve


def _around(x: Tensor, known: Tensor) -> Tensor:
    """Mean (B, h, w) of the known ones of the 3 x 3 pixels around each."""
    mask = known.to(x)[:, None]
    total, count = (F.avg_pool2d(m, 3, 1, 1) for m in (torch.where(known, x, 0.0)[:, None], mask))
    return torch.where(known, (total / count.clamp_min(1e-6))[:, 0], x)


def _between(knots: Tensor, level: Tensor) -> Tensor:
    """Values (B, h, w) of a broken line with ``knots`` (B, K) at levels from 0 to 1."""
    K = knots.shape[-1]
    at = level * (K - 1)
    left = at.floor().clamp(0, K - 2).long()
    low, high = (knots.gather(1, (left + k).flatten(1)).view_as(level) for k in (0, 1))
    return low + (at - left) * (high - low)


def _of_field(fit: Fit, down: Tensor, across: Tensor) -> Tensor:
    """Variance (B, h, w) of constant and field."""
    n = NODES[0] * NODES[1]
    C = fit.cov[:, 1 : n + 1, 1 : n + 1].unflatten(1, NODES).unflatten(3, NODES)
    with_one = fit.cov[:, 0, 1 : n + 1].unflatten(1, NODES)
    square = torch.einsum("ra,ri,baxiy->brxy", down, down, C)
    field = torch.einsum("cx,cy,brxy->brc", across, across, square)
    return (field + 2 * down @ with_one @ across.mT + fit.cov[:, :1, :1]).clamp_min(0)


def _local(points: Anchors, basis: _Basis, fit: Fit, kind: str, hats: tuple[Tensor, Tensor]) -> Tensor:
    """Variance (B, h, w) by which map and anchors disagree around each pixel beyond what the anchors have alone."""
    log, _ = _predicted(fit, points, basis, kind)
    noise = points.var + torch.where(points.near, 0.0, points.shared).square()
    square = (points.depth.detach().log() - log).square().clamp(max=0.25)
    weight = basis.field * points.used[..., None]
    everywhere = median(square, points.used) / 0.455
    prior = 5.0
    held = ((weight * square.clamp_max(100.0)[..., None]).sum(1) + prior * everywhere) / (weight.sum(1) + prior)
    own = ((weight * (noise - FLOOR**2)[..., None]).sum(1)) / (weight.sum(1) + prior)
    local = (held - own).clamp_min((LEAST * FLOOR) ** 2).unflatten(1, NODES)
    return hats[0] @ local @ hats[1].mT
