"""Anybody's depth in metres: a map tied to near returns and far answers, with a sigma for every pixel.

    map ─┐                ┌─ right as it is ───────┐
         ├─ robust fits ──┼─ scale, shift, or both ┼─ the one under which the references are most probable ─ DepthMap
    references ┘             └─ and a smooth field ───┘        └─ its rivals, and references left out: sigma

What a map lacks is a metre, then a shift, then a slow drift over picture and depth
(:mod:`dhtorch.alignment.error_model`). More is believed only as far as it makes the references more probable than its
freedom costs, and tells those that were left out better; where it does not, the map is left alone.

Alphabet: ``x`` value of the map, ``r`` residual of log depth, ``K`` models, ``M`` the most probable ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.alignment import error_model, residual_noise
from dhtorch.alignment.error_model import ERROR_MODELS, MODEL_HEADS, T1_68_QUANTILE, AlignmentProblem, ErrorModelFit
from dhtorch.alignment.references import (
    BLOCK_CORRELATION,
    ERROR_BLOCKS,
    MIN_RETURN_ERROR,
    MetricReferences,
    collect_references,
    local_spread,
    sample_at_references,
)
from dhtorch.codes import Gate, Source, first_reason
from dhtorch.geometry.checks import check
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import solve_spd
from dhtorch.records import DepthMap, Estimate, Samples

#: What a map may be: metres as it says, depth up to a scale, up to a scale and a shift, inverse depth up to both, or
#: any rising function of depth.
ALIGNMENT_KINDS: Final = ("metric", "scale", "affine", "inverse", "ordinal")

#: Kind → models that make sense of it: those that are free where it is. What has an order alone is not bent across the
#: picture.
_OF_KIND: Final = {
    "metric": tuple(ERROR_MODELS),
    "scale": tuple(name for name, model in ERROR_MODELS.items() if MODEL_HEADS[model.head].scale),
    **dict.fromkeys(
        ("affine", "inverse"), tuple(name for name, model in ERROR_MODELS.items() if all(MODEL_HEADS[model.head]))
    ),
    "ordinal": tuple(MODEL_HEADS),
}

#: Fewest references of a fit, and most models that share in sigma.
MIN_REFERENCES, MAX_MODELS = 8, 3

#: Pixels between places where what varies slowly over the picture is found.
FIELD_STRIDE_PX: Final = 8

#: References are left out in so many turns: scattered blocks, and quarters of the picture.
N_SCATTERED_FOLDS, N_QUADRANT_FOLDS = 4, 4

#: Relative error below which nobody asks which of two models fits a near return better.
EXACT_FIT_ERROR: Final = 0.002

#: Standard errors by which far answers must tell a shift worse that near returns meet as exactly as that; else one.
VETO_STANDARD_ERRORS: Final = 2.0

#: Loss by which models differ through rounding alone.
LOSS_ROUNDING: Final = 1e-6

#: What is lost by a model that could not be fitted.
FAILED_FIT_LOSS: Final = 10.0

#: Bounds of what the references left out do to sigma, and how many leave it as it is.
SIGMA_SCALE_RANGE, SIGMA_SCALE_PRIOR = (0.3, 4.0), 20

#: Least probability of a power that is part of sigma: less changes no interval that nine of ten errors lie in.
MIN_POWER_PROBABILITY: Final = 0.1

#: Steps of the fit of a power.
POWER_STEPS: Final = 30

#: Relative error at which the head's start bends from least squares to least absolute values.
HUBER_BEND: Final = 0.03


class ModelSelection(NamedTuple):
    """How probable the models are, and what the references say of sigma; for reports."""

    model: Tensor  # (B,) int64, the taken one's place in ``names``; -1 where there is none
    names: tuple[str, ...]
    weight: Tensor  # (B, K) probability by the evidence of all references; the taken one need not be the likeliest
    factor: Tensor  # (B,) by which sigma was stretched


def align_depth(
    depth_map: Tensor,  # (B, h, w) or DepthMap
    references: Samples | Estimate | DepthMap | Sequence[Samples | Estimate | DepthMap],
    *,
    hw: tuple[int, int] | None = None,
    kind: str = "metric",
    max_sigma_rel: float = 0.5,
    trace: dict[str, ModelSelection] | None = None,
) -> DepthMap:
    """A map of anybody's, in metres, with a sigma for every pixel.

    Robust fits (Student's t) tie the map to the references: nothing, a scale, a shift, both; on top a tilt or a field
    over the picture and a correction over depth, both Gaussian processes, so that they are zero away from
    references. How far references are off by themselves is found with each fit, and how heavy the tails of near returns
    are with the answer's. How probable the references are under a fit (its evidence) says which may be taken; it is, in
    place of a plain head, only where references that were left out bear it out. Its two nearest rivals are part of
    sigma. An error that all far answers share (the motion's) is an unknown of the fit and no part of the answer.

    Sigma is the covariance of what was fitted, stretched until references that were left out (scattered blocks, and
    whole quarters of the picture) lie within it as often as they should; what the models disagree by, and a power of
    the map where near returns do not tell it from them; and how far near
    returns scatter about the map where it is as rough as around a pixel, more where they are off in places
    (:mod:`dhtorch.alignment.residual_noise`). It is against the references' own metre: what all near returns are wrong
    by, nothing here can tell.

    Args:
        depth_map: values (B, h, w) over the field of the picture; not finite, or not positive where depth is meant,
            is no value.
        references: near returns (usable ``Samples``), far answers (``Estimate``) or maps (``DepthMap``; pixels whose
            source is the sensor count as near), one or several.
        hw: height and width of the picture in whose pixels samples and estimates are; None = the map's.
        kind: ``metric`` (may be right as it is), ``scale``, ``affine`` (depth up to scale and shift), ``inverse``
            (disparity up to both) or ``ordinal`` (any rising function of depth; the answer rises with it).
        max_sigma_rel: sigma / depth above which a pixel is silent.
        trace: gets ``chosen``.

    Returns:
        DepthMap of source ALIGNED. Score is 0.1 / (0.1 + sigma / depth). Gates: NO_TRACK where the map has no value,
        NO_POSE where the references are fewer than eight or no model can be fitted, UNCERTAIN.

    Raises:
        ValueError: wrong shapes, an unknown kind, no references, a limit that is not positive.

    Gradient: depth to the map and to the references' depth, by the implicit function theorem (first order); the
    choice of the model, where fits start, ``ordinal``'s order of values and the answer's sigma carry none.
    Cost: mostly that of the fits, which does not grow with the map's size.
    Source: Student's t by expectation and maximisation: K. Lange et al., "Robust statistical modeling using the t
    distribution", 1989; evidence: D. MacKay, "Bayesian interpolation", 1992; blocks: D. Roberts et al.,
    "Cross-validation strategies for data with structure", 2017.
    """
    values = depth_map.depth if isinstance(depth_map, DepthMap) else depth_map
    check("align_depth", depth_map=(values, "B h w"))
    if kind not in ALIGNMENT_KINDS:
        raise ValueError(f"align_depth: kind is {kind!r}, expected one of {', '.join(ALIGNMENT_KINDS)}")
    if not max_sigma_rel > 0:
        raise ValueError(f"align_depth: max_sigma_rel is {max_sigma_rel}, expected a positive number")
    given = [references] if isinstance(references, Samples | Estimate | DepthMap) else list(references)
    if not given:
        raise ValueError("align_depth: found no references, expected near returns, far answers, or both")
    x = values.double()
    known = x.isfinite() & ((x > 0) if kind in ("metric", "scale") else torch.ones_like(x, dtype=torch.bool))
    known = known & (depth_map.keep if isinstance(depth_map, DepthMap) else known)
    points = collect_references(torch.where(known, x, torch.nan), given, hw or (x.shape[-2], x.shape[-1]))
    x = torch.where(known, x, torch.ones_like(x))
    if kind == "ordinal":
        x, at = _isotonic_map(x, points), _isotonic_map(points.x, points)
        within = sample_at_references(local_spread(torch.where(known, x, torch.nan)), points.share)[0]
        points = points._replace(x=at, within=torch.where(points.used, within, 0.0))
    elif kind != "metric":  # values of any unit: 1 is the median of the aligned ones
        unit = masked_median(points.x.detach().abs(), points.used).clamp_min(1e-12)
        x, points = x / unit[..., None], points._replace(x=points.x / unit, within=points.within / unit)
    task = _task(x, known, points, of_depth=kind != "inverse")
    fits, chosen = _select_model(task, _OF_KIND[kind])
    if trace is not None:
        trace["chosen"] = chosen
    log, sigma_rel = _average_models(task, fits, chosen, x, known)
    return _aligned_map(log, sigma_rel, known, chosen, (max_sigma_rel, values.dtype))


def _task(x: Tensor, known: Tensor, points: MetricReferences, *, of_depth: bool) -> AlignmentProblem:
    """What is fitted, and where fits start."""
    target = points.depth if of_depth else 1 / points.depth
    start = _initial_heads(points.x.detach(), target.detach(), points)
    level = masked_median(target.detach(), points.used)
    return AlignmentProblem(points, error_model.make_basis(x, known, of_depth=of_depth), start, level)


def _initial_heads(x: Tensor, y: Tensor, points: MetricReferences) -> Tensor:
    """Heads (B, H, 2) as HEADS: none, the median ratio, the median difference, the line of least absolute relative
    error."""
    ratio = masked_median(y / torch.where(x == 0, torch.nan, x), points.used)[:, 0]
    scale = torch.stack((ratio.abs(), torch.zeros_like(ratio)), -1)
    A = torch.stack((x, torch.ones_like(x)), -1) / y[..., None]
    weight = points.weight(points.used)
    eye = 1e-9 * torch.eye(2).to(x)
    w = weight
    for _ in range(10):
        W = A * w[..., None]
        line, ok = solve_spd(W.mT @ A + eye, W.sum(1)[..., None])
        w = weight / (((A @ line)[..., 0] - 1).square() + HUBER_BEND**2).sqrt()
    line = torch.where((ok & (line[:, 0, 0] > 0))[:, None], line[..., 0], scale)
    one = torch.ones_like(ratio)
    none, shift = (
        torch.stack((one, t), -1) for t in (torch.zeros_like(ratio), masked_median(y - x, points.used)[:, 0])
    )
    return torch.stack((none, scale, shift, line), 1)


class _LeftOut(NamedTuple):
    """References left out in turns T, as C models predict them."""

    r: Tensor  # (B, C, T, N) residuals of log depth, NaN where they were not left out
    var: Tensor  # (B, C, T, N) of the residual, as the model states it


def _select_model(task: AlignmentProblem, names: tuple[str, ...]) -> tuple[ErrorModelFit, ModelSelection]:
    """The chosen model and its likeliest rivals (B, M) with their shares as evidence, and how probable all are."""
    points = task.points
    place = torch.tensor([list(ERROR_MODELS).index(name) for name in names], device=points.x.device)
    with torch.no_grad():
        every = error_model.fit_models(task, place.expand(len(points.x), -1), points.used)
        some = every.evidence.isfinite().any(-1) & (points.used.sum(-1) >= MIN_REFERENCES)
        prior = every.evidence.new_tensor([ERROR_MODELS[name].prior for name in names])
        weight = torch.softmax(torch.where(some[:, None], every.evidence + prior, 0.0), -1)
        heads = [head for head in MODEL_HEADS if head in names]
        simple = torch.tensor([names.index(head) for head in heads], device=place.device)
        asked = torch.cat((simple.expand(len(weight), -1), weight.argmax(-1, keepdim=True)), -1)
        left = _cross_validate(task, place[asked])
        fitted = every.evidence.gather(1, asked).isfinite()
        left = left._replace(r=torch.where(fitted[..., None, None], left.r, torch.nan))
        head = torch.tensor([heads.index(ERROR_MODELS[name].head) for name in names], device=place.device)[asked[:, -1]]
        taken = _simplest(points, left, heads, head)[:, None]
        factor = _sigma_scale(points, left, taken)
        best = asked.gather(1, taken)
        # What the references left out do not tell from the most probable model shares alike with it.
        share = weight.scatter(1, best, weight.amax(-1, keepdim=True))
        rivals = share.scatter(1, best, 2.0).topk(min(MAX_MODELS, len(names)), -1).indices
        model = torch.where(some, best[:, 0], -1)
        mean, _ = error_model.predict_references(every.pick(best), task)
        freedom = error_model.estimate_freedom(points.depth.log() - mean[:, 0], points)
    fits = error_model.fit_models(task, place[rivals], points.used, error_model.FINAL_STEPS, freedom)
    return fits._replace(evidence=share.gather(1, rivals).log()), ModelSelection(model, names, weight, factor)


def _cross_validate(task: AlignmentProblem, model: Tensor) -> _LeftOut:
    """References as models (B, C) predict them that were fitted without them."""
    points = task.points
    cell = points.block // 2
    row, column = cell // ERROR_BLOCKS[1], cell % ERROR_BLOCKS[1]
    quarter = 2 * (2 * row // ERROR_BLOCKS[0]) + 2 * column // ERROR_BLOCKS[1]
    turns = [(row * 2 + column) % N_SCATTERED_FOLDS == k for k in range(N_SCATTERED_FOLDS)] + [
        quarter == k for k in range(N_QUADRANT_FOLDS)
    ]
    out = torch.stack(turns, 1)
    every = out.repeat(1, model.shape[1], 1)
    fit = error_model.fit_models(task, model.repeat_interleave(len(turns), 1), points.used[:, None] & ~every)
    mean, var = error_model.predict_references(fit, task)
    noise = (T1_68_QUANTILE * fit.noise[..., :1]).clamp_max(1.0).square() * points.var[:, None]
    asked = every & points.used[:, None] & fit.evidence.isfinite()[..., None]
    r = torch.where(asked, points.depth.log()[:, None] - mean, torch.nan)
    var = var + noise + error_model.placement_variance(fit.head, points)
    return _LeftOut(*(part.unflatten(1, (model.shape[1], len(turns))) for part in (r, var)))


def _simplest(points: MetricReferences, left: _LeftOut, heads: Sequence[str], head: Tensor) -> Tensor:
    """Place (B,) of the first model whose loss is within one standard error of the least, blocks of the picture being
    the unit (Breiman's rule): one error bar in favour of what changes the map less. The first ones are the plain
    ``heads``; the last one has the head at the places ``head`` (B,) among them and perhaps a drift. The metre is the
    near returns'; where there are far answers, they must not refute a shift (lose more by it than one standard error),
    and bear a drift out: what near returns alone ask for in their part of the picture is no evidence of the far
    part."""
    block = _block_losses(points, left)
    n = block.mean.shape[1]
    of_far = block.mass * (torch.arange(block.mass.shape[-1], device=block.mass.device) % 2 == 0)
    far = (of_far * block.mean).sum(-1)
    place = torch.arange(n, device=far.device)
    below = torch.cat(((place[:-1] - 1).expand(len(far), -1), head[:, None]), -1).clamp_min(0)
    simpler = far.cummin(-1).indices.gather(1, below)
    worse, error = _loss_difference(block.mean, simpler, of_far)
    told = (points.used & ~points.near).sum(-1, keepdim=True) >= MIN_REFERENCES
    shifts = torch.tensor([*(MODEL_HEADS[name].shift for name in heads), False], device=far.device)
    bent = shifts & (worse > torch.where(block.met <= EXACT_FIT_ERROR, VETO_STANDARD_ERRORS, 1.0) * error)
    drifts = (place == n - 1) & (worse >= 0)
    refused = told & (bent | drifts)
    mean = (block.mass * block.mean).sum(-1).masked_fill(refused, torch.inf)
    more, error = _loss_difference(block.mean, mean.argmin(-1, keepdim=True).expand(-1, n), block.mass)
    good = (more <= error.clamp_min(LOSS_ROUNDING)) & mean.isfinite()
    return good.to(torch.int8).argmax(-1)


def _loss_difference(loss: Tensor, other: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    """By how much models (B, C) lose more in blocks of a ``mass`` than models at places ``other`` (B, C), and the
    standard error of that."""
    more = loss - loss.gather(1, other[..., None].expand_as(loss))
    total = mass.sum(-1, keepdim=True).clamp_min(1e-9)
    middle = (mass * more).sum(-1, keepdim=True) / total
    error = ((mass / total).square() * (more - middle).square()).sum(-1).sqrt()
    return middle[..., 0], error


class _BlockLosses(NamedTuple):
    """What models lose in blocks of the picture, near and far ones being two."""

    mean: Tensor  # (B, C, blocks)
    mass: Tensor  # (B, 1, blocks) share of all, as far as references of one block count as fewer
    met: Tensor  # (B, C) median relative error of near returns


def _block_losses(points: MetricReferences, left: _LeftOut) -> _BlockLosses:
    """The loss of a reference is the logarithm of how far it is off, above what it may be off by itself: for far
    answers what they state, for near returns the least median that any model leaves, since returns are often better
    than they say. A core that a model fits exactly so outweighs a tail that another makes shorter."""
    r = left.r.square().nanmean(2).sqrt()
    near = torch.where(points.near[:, None], r, torch.nan).nanmedian(-1).values
    core = near.nan_to_num(torch.inf).amin(-1).clamp(EXACT_FIT_ERROR, MIN_RETURN_ERROR)[:, None]
    alone = torch.where(points.near, core.square(), points.var + points.shared.square())
    loss = 0.5 * (r.square() / alone[:, None]).log1p()
    known = loss.isfinite().any(1)[:, None]
    loss = loss.nan_to_num(FAILED_FIT_LOSS)
    block = points.block[:, None]
    total = loss.new_zeros(*loss.shape[:2], 2 * ERROR_BLOCKS[0] * ERROR_BLOCKS[1])
    count = total[:, :1].scatter_add(2, block, known.to(loss))
    mean = total.scatter_add(2, block.expand_as(loss), torch.where(known, loss, 0.0)) / count.clamp_min(1)
    mass = count / (1 + BLOCK_CORRELATION * (count - 1).clamp_min(0))
    return _BlockLosses(mean, mass / mass.sum(-1, keepdim=True).clamp_min(1e-9), near.nan_to_num(torch.inf))


def _sigma_scale(points: MetricReferences, left: _LeftOut, taken: Tensor) -> Tensor:
    """By how much sigma (B,) must grow or shrink for 68 % of the near references left out to lie within one."""
    r, var = (part.gather(1, taken[..., None, None].expand(-1, 1, *part.shape[2:]))[:, 0] for part in left)
    ratio = torch.where(points.near[:, None], r.abs() / var.sqrt(), torch.nan).flatten(1)
    n = ratio.isfinite().sum(-1)
    found = ratio.nanquantile(0.683, -1).nan_to_num(1.0).clamp_min(1e-3)
    return (found.log() * n / (n + SIGMA_SCALE_PRIOR)).exp().clamp(*SIGMA_SCALE_RANGE)


# ---------------------------------------------------------------------------------------------------------- every pixel


def _average_models(
    task: AlignmentProblem, fits: ErrorModelFit, chosen: ModelSelection, x: Tensor, known: Tensor
) -> tuple[Tensor, Tensor]:
    """Log depth (B, h, w), and sigma of it."""
    share = torch.softmax(fits.evidence.nan_to_num(neginf=-1e300).detach(), -1)
    logs, var = zip(*(_predict_map(task, fits.pick(at), x) for at in _model_indices(fits)), strict=True)
    means = torch.stack(logs, 1)
    log = means[:, 0]
    with torch.no_grad():
        apart = (means - log[:, None]).square()
        spread = (
            share[..., None, None] * (chosen.factor.square()[:, None, None, None] * torch.stack(var, 1) + apart)
        ).sum(1)
        mean, of_fit = (part[:, 0] for part in error_model.predict_references(fits, task))
        spread = spread + _power_law_variance(task, (mean, fits.noise[:, 0], fits.model[:, 0]), x, log)
        told = (
            error_model.placement_variance(fits.head[:, :1], task.points)[:, 0],
            chosen.factor[:, None] * of_fit.sqrt(),
        )
        return log, (
            spread + residual_noise.residual_variance(task.points, task.points.depth.log() - mean, told, log, known)
        ).sqrt()


def _power_law_variance(task: AlignmentProblem, found: tuple[Tensor, Tensor, Tensor], x: Tensor, log: Tensor) -> Tensor:
    """Variance (B, h, w) of log depth: how far a power of the map, fitted to near returns, is from the answer, as far
    as references leave it as probable. Over a short range a line and a power are alike, and beyond it they are not; far
    answers tell them apart as far as an error that all of them may share lets them."""
    points = task.points
    mean, noise, model = found
    near = points.used & points.near
    weight = points.weight(near)
    square = (noise[:, :1].square() * points.var).clamp_min(error_model.MIN_REFERENCE_NOISE**2)
    A = _line(points.x)
    target = points.depth.log()
    eye = 1e-9 * torch.eye(2).to(A)
    w = weight / square
    for _ in range(POWER_STEPS):
        W = A * w[..., None]
        line, ok = solve_spd(W.mT @ A + eye, W.mT @ target[..., None])
        r = target - (A @ line)[..., 0]
        w = weight / (square + r.square())
    better = (weight * (((target - mean).square() / square).log1p() - (r.square() / square).log1p())).sum(-1)
    better = better + _far_log_odds(points, target - mean, r)
    prior = x.new_tensor([m.prior for m in ERROR_MODELS.values()])
    share = torch.sigmoid(better + ERROR_MODELS["affine"].prior - prior[model])
    asked = ok & (share >= MIN_POWER_PROBABILITY) & (near.sum(-1) >= MIN_REFERENCES) & (~near | (points.x > 0)).all(-1)
    apart = (_line(x) @ line[:, None])[..., 0] - log
    return torch.where(asked, share, 0.0)[:, None, None] * torch.where(x > 0, apart, 0.0).square()


def _far_log_odds(points: MetricReferences, one: Tensor, other: Tensor) -> Tensor:
    """By how much the middle of the far answers is more probable (B,), as a logarithm, under the second of two
    residuals (B, N) than under the first: one draw, of what all far answers may be off by together."""
    far = points.used & ~points.near
    together = masked_median(error_model.motion_error_basis(points).square().sum(-1), far)
    told = (
        0.5
        * (masked_median(one, far).square() - masked_median(other, far).square())
        / together.clamp_min(MIN_RETURN_ERROR**2)
    )
    return torch.where(far.sum(-1) >= MIN_REFERENCES, told[:, 0], 0.0)


def _line(x: Tensor) -> Tensor:
    """One and the logarithm of values (..., 2); 0 of what has none."""
    return torch.stack((torch.ones_like(x), torch.where(x > 0, x, 1.0).log()), -1)


def _model_indices(fits: ErrorModelFit) -> list[Tensor]:
    """Places (B, 1) of every model in turn."""
    B, M = fits.model.shape
    return [fits.model.new_full((B, 1), k) for k in range(M)]


def _predict_map(task: AlignmentProblem, fit: ErrorModelFit, x: Tensor) -> tuple[Tensor, Tensor]:
    """Log depth (B, h, w) of one model and its variance. What varies over the picture alone is found on a coarse grid,
    what varies with the value at every pixel."""
    basis, flat, size = task.basis, x.flatten(1), (x.shape[-2], x.shape[-1])
    n = error_model.N_TILT_SLOPES + len(basis.node)
    head, beta, spread = fit.head[:, 0], fit.beta[:, 0], fit.spread[:, 0]
    coarse = [max(3, -(-s // FIELD_STRIDE_PX) + 1) for s in size]
    v, u = torch.meshgrid(*(torch.linspace(0, 1, k).to(x) for k in coarse), indexing="ij")
    share = torch.stack((u, v), -1).flatten(0, 1).expand(len(x), -1, -1)
    field = error_model.evaluate_fields(basis, share, fit.short)[:, 0]
    of_place, of_value = spread[:, 2 : 2 + n], torch.cat((spread[:, :2], spread[:, 2 + n :]), 1)
    spread_field = field @ of_place
    of_field = spread_field.square().sum(-1) + error_model.interpolation_variance(fit.model, field[:, None])[:, 0]
    parts = field @ beta[:, :n, None], of_field[..., None], spread_field @ of_value.mT
    maps = torch.cat(parts, -1).mT.unflatten(-1, coarse)
    maps = F.interpolate(maps, size, mode="bicubic", align_corners=True).flatten(2)
    curve = error_model.evaluate_curves(basis, flat)
    log, slope = error_model.predict_log_depth(head, flat, basis)
    log = log + maps[:, 0] + (curve @ beta[:, n:, None])[..., 0]
    with torch.no_grad():
        along = torch.cat((slope, curve), -1)
        var = maps[:, 1] + 2 * (along * maps[:, 2:].mT).sum(-1) + (along @ of_value).square().sum(-1)
    return log.view_as(x), var.clamp_min(0).view_as(x)


def _aligned_map(
    log: Tensor, sigma_rel: Tensor, known: Tensor, chosen: ModelSelection, told: tuple[float, torch.dtype]
) -> DepthMap:
    max_sigma_rel, dtype = told
    depth = log.exp()
    silent = (chosen.model < 0)[:, None, None].expand_as(known)
    unsure = ~depth.isfinite() | ~(sigma_rel <= max_sigma_rel)
    gate = first_reason((~known, Gate.NO_TRACK), (silent, Gate.NO_POSE), (unsure, Gate.UNCERTAIN))
    keep = gate == Gate.ANSWER
    return DepthMap(
        depth=torch.where(keep, depth, torch.nan).to(dtype),
        sigma=torch.where(keep, sigma_rel * depth.detach(), torch.nan).to(dtype),
        score=torch.where(keep, 0.1 / (0.1 + sigma_rel), 0.0).to(dtype),
        source=torch.where(keep, Source.ALIGNED, Source.NONE).to(torch.int32),
        gate=gate,
    )


def _isotonic_map(x: Tensor, points: MetricReferences) -> Tensor:
    """Values through the rising broken line that fits the references' depths best: means of equally many references,
    joined where they fall (isotonic regression as its min-max formula)."""
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
