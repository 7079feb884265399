"""Metric alignment of a depth map to near returns and triangulated points, with a standard deviation for every pixel.

    map ─┐                   ┌─ identity ──────────────┐
         ├─ robust fits of ──┼─ scale, shift, or both ─┼─ model selection by evidence ─ DepthMap
    references ┘             └─ and a smooth field ────┘  and left-out references: sigma

A map may lack a scale, then a shift, then a slow drift over picture and depth (:mod:`dhtorch.alignment.error_model`).
A model with more freedom is selected only where it makes the references more probable in spite of its complexity and
predicts left-out references better; otherwise the map is left unchanged.

Alphabet: ``x`` value of the map, ``r`` residual of log depth, ``K`` models, ``M`` the most probable ones.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.alignment import error_model, residual_noise
from dhtorch.alignment.error_model import ERROR_MODELS, MODEL_HEADS, T1_68_QUANTILE, AlignmentProblem, ErrorModelFit
from dhtorch.alignment.map_family import find_map_family, least_absolute_line
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS, AlignmentOptions
from dhtorch.alignment.references import (
    ERROR_BLOCKS,
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
from dhtorch.runtime.numerics import standard_numerics

#: What the values of a map mean: depth in metres, depth up to scale, depth up to scale and shift, inverse depth up to
#: scale and shift, or any increasing function of depth.
ALIGNMENT_KINDS: Final = ("metric", "scale", "affine", "inverse", "ordinal")

#: Kind → admissible error models: those in which everything that the kind leaves open is free. A map with an order
#: alone gets no field over the picture.
_MODELS_OF_KIND: Final = {
    "metric": tuple(ERROR_MODELS),
    "scale": tuple(name for name, model in ERROR_MODELS.items() if MODEL_HEADS[model.head].scale),
    **dict.fromkeys(
        ("affine", "inverse"), tuple(name for name, model in ERROR_MODELS.items() if all(MODEL_HEADS[model.head]))
    ),
    "ordinal": tuple(MODEL_HEADS),
}


class ModelSelection(NamedTuple):
    """Probabilities of the models and the factor on sigma; for reports."""

    model: Tensor  # (B,) int64, index of the selected model in ``names``; -1 where there is none
    names: tuple[str, ...]
    weight: Tensor  # (B, K) probability by the evidence of all references; the selected one need not be the likeliest
    factor: Tensor  # (B,) by which sigma was multiplied
    family: Tensor | None = None  # (B,) int64, index in ``map_family.MAP_FAMILIES``; None = not looked for


@standard_numerics
def align_depth(
    depth_map: Tensor,  # (B, h, w) or DepthMap
    references: Samples | Estimate | DepthMap | Sequence[Samples | Estimate | DepthMap],
    *,
    hw: tuple[int, int] | None = None,
    kind: str = "metric",
    max_sigma_rel: float = 0.5,
    options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS,
    trace: dict[str, ModelSelection] | None = None,
) -> DepthMap:
    """Depth map of any kind and metric references -> depth map in metres with a standard deviation for every pixel.

    Robust fits (Student's t) align the map to the references: identity, a scale, a shift, both; each with or without a
    tilt or a field over the picture and a correction over depth. Field and correction are Gaussian processes, so that
    they are zero away from references. The noise of the references is estimated with each fit, and the tails of the
    near returns' noise with that of the answer. Models are compared by their evidence (the probability of the
    references); the most probable one replaces a plain head only where left-out references support it. Its two nearest
    rivals contribute to sigma. An error that all far answers share (the motion's) is an unknown of the fit and no part
    of the answer.

    The variance is the covariance of the fitted parameters, scaled until left-out references (scattered blocks, and
    whole quarters of the picture) lie within it as often as they should; the differences between the models, and a
    power law of the map where near returns do not distinguish it from them; and the scatter of near returns about the
    map, where it is as rough as around a pixel, more where they are off locally
    (:mod:`dhtorch.alignment.residual_noise`). It is relative to the references' own metric scale: an error that all
    near returns share is not observable here.

    Args:
        depth_map: values (B, h, w) over the field of view of the picture; values that are not finite, or not positive
            where depth is meant, are missing.
        references: near returns (usable ``Samples``), far answers (``Estimate``) or maps (``DepthMap``; pixels whose
            source is the sensor count as near), one or several.
        hw: height and width of the picture in whose pixels samples and estimates are; None = the map's.
        kind: ``metric`` (may be right as it is), ``scale``, ``affine`` (depth up to scale and shift), ``inverse``
            (disparity up to both) or ``ordinal`` (any increasing function of depth; the answer increases with it).
        max_sigma_rel: sigma / depth above which a pixel is left unanswered.
        options: tuning constants of the references, the fits, the selection and sigma.
        trace: receives the :class:`ModelSelection` as ``chosen``.

    Returns:
        DepthMap of source ALIGNED. Score is 0.1 / (0.1 + sigma / depth). Gates: NO_TRACK where the map has no value,
        NO_POSE where the references are fewer than eight, no model can be fitted, or the near returns show that a map
        of depth holds disparities or a z-buffer (:mod:`dhtorch.alignment.map_family`), UNCERTAIN.

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
    sources = [references] if isinstance(references, Samples | Estimate | DepthMap) else list(references)
    if not sources:
        raise ValueError("align_depth: found no references, expected near returns, far answers, or both")
    x = values.double()
    valid = x.isfinite() & ((x > 0) if kind in ("metric", "scale") else torch.ones_like(x, dtype=torch.bool))
    valid = valid & (depth_map.keep if isinstance(depth_map, DepthMap) else valid)
    points = collect_references(torch.where(valid, x, torch.nan), sources, hw or (x.shape[-2], x.shape[-1]), options)
    x = torch.where(valid, x, torch.ones_like(x))
    if kind == "ordinal":
        x, x_at_references = _isotonic_map(x, points), _isotonic_map(points.x, points)
        within = sample_at_references(local_spread(torch.where(valid, x, torch.nan)), points.share)[0]
        points = points._replace(x=x_at_references, within=torch.where(points.used, within, 0.0))
    elif kind != "metric":  # values of any unit: divided by their median at the references
        unit = masked_median(points.x.detach().abs(), points.used).clamp_min(1e-12)
        x, points = x / unit[..., None], points._replace(x=points.x / unit, within=points.within / unit)
    problem = _alignment_problem(x, valid, points, options, of_depth=kind != "inverse")
    fits, selection = _select_model(problem, _MODELS_OF_KIND[kind])
    if kind in ("metric", "scale", "affine"):  # values are linear in depth
        family = find_map_family(points, options)
        selection = selection._replace(model=torch.where(family == 0, selection.model, -1), family=family)
    if trace is not None:
        trace["chosen"] = selection
    log_depth, sigma_rel = _average_models(problem, fits, selection, x, valid)
    return _aligned_map(log_depth, sigma_rel, valid, selection, (max_sigma_rel, values.dtype))


def _alignment_problem(
    x: Tensor, valid: Tensor, points: MetricReferences, options: AlignmentOptions, *, of_depth: bool
) -> AlignmentProblem:
    """Map and references -> the problem with its basis and the initial heads."""
    target = points.depth if of_depth else 1 / points.depth
    start = _initial_heads(points.x.detach(), target.detach(), points, options)
    level = masked_median(target.detach(), points.used)
    basis = error_model.make_basis(x, valid, of_depth=of_depth, options=options)
    return AlignmentProblem(points, basis, start, level)


def _initial_heads(x: Tensor, y: Tensor, points: MetricReferences, options: AlignmentOptions) -> Tensor:
    """Heads (B, H, 2) in the order of MODEL_HEADS: identity, the median ratio, the median difference, the line of least
    absolute relative error."""
    ratio = masked_median(y / torch.where(x == 0, torch.nan, x), points.used)[:, 0]
    scale = torch.stack((ratio.abs(), torch.zeros_like(ratio)), -1)
    line, ok = least_absolute_line(x, y, points.weight(points.used, options), options)
    line = torch.where((ok & (line[:, 0] > 0))[:, None], line, scale)
    ones = torch.ones_like(ratio)
    identity, shift = (
        torch.stack((ones, t), -1) for t in (torch.zeros_like(ratio), masked_median(y - x, points.used)[:, 0])
    )
    return torch.stack((identity, scale, shift, line), 1)


class _HeldOut(NamedTuple):
    """Left-out references in folds T, as predicted by C models."""

    r: Tensor  # (B, C, T, N) residuals of log depth, NaN where the fold includes the reference in the fit
    var: Tensor  # (B, C, T, N) predicted variance of the residual


def _select_model(problem: AlignmentProblem, names: tuple[str, ...]) -> tuple[ErrorModelFit, ModelSelection]:
    """The selected model and its likeliest rivals (B, M), their weights as evidence, and the probabilities of all."""
    points, options = problem.points, problem.options
    index = torch.tensor([list(ERROR_MODELS).index(name) for name in names], device=points.x.device)
    with torch.no_grad():
        all_fits = error_model.fit_models(problem, index.expand(len(points.x), -1), points.used)
        solvable = all_fits.evidence.isfinite().any(-1) & (points.used.sum(-1) >= options.min_references)
        prior = all_fits.evidence.new_tensor([ERROR_MODELS[name].prior(options) for name in names])
        weight = torch.softmax(torch.where(solvable[:, None], all_fits.evidence + prior, 0.0), -1)
        heads = [head for head in MODEL_HEADS if head in names]
        plain = torch.tensor([names.index(head) for head in heads], device=index.device)
        candidates = torch.cat((plain.expand(len(weight), -1), weight.argmax(-1, keepdim=True)), -1)
        held_out = _cross_validate(problem, index[candidates])
        fitted = all_fits.evidence.gather(1, candidates).isfinite()
        held_out = held_out._replace(r=torch.where(fitted[..., None, None], held_out.r, torch.nan))
        head_of_model = torch.tensor([heads.index(ERROR_MODELS[name].head) for name in names], device=index.device)
        head = head_of_model[candidates[:, -1]]
        selected = _one_standard_error_choice(points, held_out, heads, head, options)[:, None]
        # Factor (B,) on sigma under which 68 % of the left-out near references lie within one sigma.
        r, var = (part.gather(1, selected[..., None, None].expand(-1, 1, *part.shape[2:]))[:, 0] for part in held_out)
        ratio = torch.where(points.near[:, None], r.abs() / var.sqrt(), torch.nan).flatten(1)
        n = ratio.isfinite().sum(-1)
        factor = ratio.nanquantile(0.683, -1).nan_to_num(1.0).clamp_min(1e-3)
        factor = (factor.log() * n / (n + options.sigma_scale_prior)).exp().clamp(*options.sigma_scale_range)
        best = candidates.gather(1, selected)
        # Left-out references do not distinguish the selected model from the most probable one: equal weights.
        share = weight.scatter(1, best, weight.amax(-1, keepdim=True))
        rivals = share.scatter(1, best, 2.0).topk(min(options.max_models, len(names)), -1).indices
        model = torch.where(solvable, best[:, 0], -1)
        mean, _ = error_model.predict_references(all_fits.pick(best), problem)
        freedom = error_model.estimate_freedom(points.depth.log() - mean[:, 0], points, options)
    fits = error_model.fit_models(problem, index[rivals], points.used, options.final_steps, freedom)
    return fits._replace(evidence=share.gather(1, rivals).log()), ModelSelection(model, names, weight, factor)


def _cross_validate(problem: AlignmentProblem, model: Tensor) -> _HeldOut:
    """Predictions of left-out references by models (B, C) that were fitted without them."""
    points = problem.points
    cell = points.block // 2
    row, column = cell // ERROR_BLOCKS[1], cell % ERROR_BLOCKS[1]
    quarter = 2 * (2 * row // ERROR_BLOCKS[0]) + 2 * column // ERROR_BLOCKS[1]
    # Folds of scattered blocks (2 × 2 checkerboard classes), and of whole quarters of the picture.
    folds = [(row * 2 + column) % 4 == k for k in range(4)] + [quarter == k for k in range(4)]
    in_fold = torch.stack(folds, 1)
    left_out = in_fold.repeat(1, model.shape[1], 1)
    fit = error_model.fit_models(problem, model.repeat_interleave(len(folds), 1), points.used[:, None] & ~left_out)
    mean, var = error_model.predict_references(fit, problem)
    noise = (T1_68_QUANTILE * fit.noise[..., :1]).clamp_max(1.0).square() * points.var[:, None]
    predicted = left_out & points.used[:, None] & fit.evidence.isfinite()[..., None]
    r = torch.where(predicted, points.depth.log()[:, None] - mean, torch.nan)
    var = var + noise + error_model.placement_variance(fit.head, points, problem.options)
    return _HeldOut(*(part.unflatten(1, (model.shape[1], len(folds))) for part in (r, var)))


def _one_standard_error_choice(
    points: MetricReferences, held_out: _HeldOut, heads: Sequence[str], head: Tensor, options: AlignmentOptions
) -> Tensor:
    """Index (B,) of the selected candidate: the first one whose loss is within one standard error of the least.

    One-standard-error rule (Breiman) over blocks of the picture, in favour of the model that changes the map less. The
    first candidates are the plain ``heads``; the last one has the head at the indices ``head`` (B,) among them and
    perhaps a drift.

    1. The metric scale is the near returns'.
    2. Far answers, where there are any, veto a shift that raises their loss by more than one standard error.
    3. Far answers must support a drift: what near returns alone require in their part of the picture is no evidence for
       the far part.
    """
    loss, mass, near_error = _block_losses(points, held_out, options)
    n = loss.shape[1]
    far_mass = mass * (torch.arange(mass.shape[-1], device=mass.device) % 2 == 0)
    far_loss = (far_mass * loss).sum(-1)
    candidate = torch.arange(n, device=far_loss.device)
    simpler_limit = torch.cat(((candidate[:-1] - 1).expand(len(far_loss), -1), head[:, None]), -1).clamp_min(0)
    simpler = far_loss.cummin(-1).indices.gather(1, simpler_limit)
    increase, error = _loss_difference(loss, simpler, far_mass)
    enough_far = (points.used & ~points.near).sum(-1, keepdim=True) >= options.min_references
    has_shift = torch.tensor([*(MODEL_HEADS[name].shift for name in heads), False], device=far_loss.device)
    shift_refuted = has_shift & (
        increase > torch.where(near_error <= options.exact_fit_error, options.veto_standard_errors, 1.0) * error
    )
    drift_refuted = (candidate == n - 1) & (increase >= 0)
    rejected = enough_far & (shift_refuted | drift_refuted)
    mean = (mass * loss).sum(-1).masked_fill(rejected, torch.inf)
    excess, error = _loss_difference(loss, mean.argmin(-1, keepdim=True).expand(-1, n), mass)
    good = (excess <= error.clamp_min(options.loss_rounding)) & mean.isfinite()
    return good.to(torch.int8).argmax(-1)


def _loss_difference(loss: Tensor, other: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    """Mean loss (B, C) of models over blocks of weight ``mass`` minus that of models at indices ``other`` (B, C), and
    the standard error of the difference."""
    difference = loss - loss.gather(1, other[..., None].expand_as(loss))
    total = mass.sum(-1, keepdim=True).clamp_min(1e-9)
    mean = (mass * difference).sum(-1, keepdim=True) / total
    error = ((mass / total).square() * (difference - mean).square()).sum(-1).sqrt()
    return mean[..., 0], error


def _block_losses(
    points: MetricReferences, held_out: _HeldOut, options: AlignmentOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals of left-out references -> losses of models in blocks of the image (B, C, blocks), weights of the blocks
    (B, 1, blocks), and the median relative error of near returns (B, C).

    Near and far references of one part form two blocks; correlated references of one block count as fewer.

    The loss of a reference is the logarithm of its residual relative to its own error: the stated one for far answers;
    for near returns the least median residual of any model, since returns are often better than they state. A core that
    a model fits exactly thus outweighs a tail that another one shortens.
    """
    r = held_out.r.square().nanmean(2).sqrt()
    near_error = torch.where(points.near[:, None], r, torch.nan).nanmedian(-1).values
    core = near_error.nan_to_num(torch.inf).amin(-1).clamp(options.exact_fit_error, options.min_return_error)[:, None]
    own_var = torch.where(points.near, core.square(), points.var + points.shared.square())
    loss = 0.5 * (r.square() / own_var[:, None]).log1p()
    valid = loss.isfinite().any(1)[:, None]
    loss = loss.nan_to_num(options.failed_fit_loss)
    block = points.block[:, None]
    total = loss.new_zeros(*loss.shape[:2], 2 * ERROR_BLOCKS[0] * ERROR_BLOCKS[1])
    count = total[:, :1].scatter_add(2, block, valid.to(loss))
    mean = total.scatter_add(2, block.expand_as(loss), torch.where(valid, loss, 0.0)) / count.clamp_min(1)
    mass = count / (1 + options.block_correlation * (count - 1).clamp_min(0))
    return mean, mass / mass.sum(-1, keepdim=True).clamp_min(1e-9), near_error.nan_to_num(torch.inf)


# ---------------------------------------------------------------------------------------------------------- every pixel


def _average_models(
    problem: AlignmentProblem, fits: ErrorModelFit, selection: ModelSelection, x: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """Log depth (B, h, w) of the selected model, and its standard deviation with that of the model averaging."""
    share = torch.softmax(fits.evidence.nan_to_num(neginf=-1e300).detach(), -1)
    B, M = fits.model.shape
    picks = (fits.pick(fits.model.new_full((B, 1), k)) for k in range(M))
    logs, var = zip(*(_predict_map(problem, fit, x) for fit in picks), strict=True)
    means = torch.stack(logs, 1)
    log_depth = means[:, 0]
    with torch.no_grad():
        between = (means - log_depth[:, None]).square()
        total_var = (
            share[..., None, None] * (selection.factor.square()[:, None, None, None] * torch.stack(var, 1) + between)
        ).sum(1)
        mean, fit_var = (part[:, 0] for part in error_model.predict_references(fits, problem))
        total_var = total_var + _power_law_variance(problem, (mean, fits.noise[:, 0], fits.model[:, 0]), x, log_depth)
        reading_and_fit = (
            error_model.placement_variance(fits.head[:, :1], problem.points, problem.options)[:, 0],
            selection.factor[:, None] * fit_var.sqrt(),
        )
        residual = problem.points.depth.log() - mean
        noise_var = residual_noise.residual_variance(
            problem.points, residual, reading_and_fit, log_depth, valid, problem.options
        )
        return log_depth, (total_var + noise_var).sqrt()


def _power_law_variance(
    problem: AlignmentProblem, fit: tuple[Tensor, Tensor, Tensor], x: Tensor, log_depth: Tensor
) -> Tensor:
    """Variance (B, h, w) of log depth: squared distance of a power law of the map, fitted to near returns, from the
    answer, times its probability.

    Over a short range a line and a power law are alike, and beyond it they are not; far answers distinguish them as far
    as an error that all of them may share permits.
    """
    points, options = problem.points, problem.options
    mean, noise, model = fit
    near = points.used & points.near
    weight = points.weight(near, options)
    square = (noise[:, :1].square() * points.var).clamp_min(options.min_reference_noise**2)
    A = _log_line(points.x)
    target = points.depth.log()
    eye = 1e-9 * torch.eye(2).to(A)
    w = weight / square
    for _ in range(options.power_steps):
        W = A * w[..., None]
        line, ok = solve_spd(W.mT @ A + eye, W.mT @ target[..., None])
        r = target - (A @ line)[..., 0]
        w = weight / (square + r.square())
    log_odds = (weight * (((target - mean).square() / square).log1p() - (r.square() / square).log1p())).sum(-1)
    log_odds = log_odds + _far_log_odds(points, target - mean, r, options)
    prior = x.new_tensor([m.prior(options) for m in ERROR_MODELS.values()])
    probability = torch.sigmoid(log_odds + ERROR_MODELS["affine"].prior(options) - prior[model])
    applies = (
        ok
        & (probability >= options.min_power_probability)
        & (near.sum(-1) >= options.min_references)
        & (~near | (points.x > 0)).all(-1)
    )
    difference = (_log_line(x) @ line[:, None])[..., 0] - log_depth
    return torch.where(applies, probability, 0.0)[:, None, None] * torch.where(x > 0, difference, 0.0).square()


def _far_log_odds(points: MetricReferences, r: Tensor, r_other: Tensor, options: AlignmentOptions) -> Tensor:
    """Log odds (B,) of the far answers' median under residuals ``r_other`` (B, N) against ``r`` (B, N): one draw of the
    error that all far answers may share."""
    far = points.used & ~points.near
    shared_var = masked_median(error_model.motion_error_basis(points).square().sum(-1), far)
    log_odds = (
        0.5
        * (masked_median(r, far).square() - masked_median(r_other, far).square())
        / shared_var.clamp_min(options.min_return_error**2)
    )
    return torch.where(far.sum(-1) >= options.min_references, log_odds[:, 0], 0.0)


def _log_line(x: Tensor) -> Tensor:
    """Columns (..., 2) of a line in log x: one and the logarithm; 0 where there is none."""
    return torch.stack((torch.ones_like(x), torch.where(x > 0, x, 1.0).log()), -1)


def _predict_map(problem: AlignmentProblem, fit: ErrorModelFit, x: Tensor) -> tuple[Tensor, Tensor]:
    """Log depth (B, h, w) of one model and its variance.

    What varies over the picture alone is evaluated on a coarse grid, what varies with the value at every pixel.
    """
    basis, flat, size = problem.basis, x.flatten(1), (x.shape[-2], x.shape[-1])
    n = error_model.N_TILT_SLOPES + len(basis.node)
    head, beta, spread = fit.head[:, 0], fit.beta[:, 0], fit.spread[:, 0]
    coarse = [max(3, -(-s // problem.options.field_stride_px) + 1) for s in size]
    v, u = torch.meshgrid(*(torch.linspace(0, 1, k).to(x) for k in coarse), indexing="ij")
    share = torch.stack((u, v), -1).flatten(0, 1).expand(len(x), -1, -1)
    field = error_model.evaluate_fields(basis, share, fit.short)[:, 0]
    place_root, value_root = spread[:, 2 : 2 + n], torch.cat((spread[:, :2], spread[:, 2 + n :]), 1)
    field_root = field @ place_root
    field_var = field_root.square().sum(-1) + error_model.interpolation_variance(fit.model, field[:, None])[:, 0]
    parts = field @ beta[:, :n, None], field_var[..., None], field_root @ value_root.mT
    maps = torch.cat(parts, -1).mT.unflatten(-1, coarse)
    maps = F.interpolate(maps, size, mode="bicubic", align_corners=True).flatten(2)
    curve = error_model.evaluate_curves(basis, flat)
    log_depth, slope = error_model.predict_log_depth(head, flat, basis)
    log_depth = log_depth + maps[:, 0] + (curve @ beta[:, n:, None])[..., 0]
    with torch.no_grad():
        along = torch.cat((slope, curve), -1)
        var = maps[:, 1] + 2 * (along * maps[:, 2:].mT).sum(-1) + (along @ value_root).square().sum(-1)
    return log_depth.view_as(x), var.clamp_min(0).view_as(x)


def _aligned_map(
    log_depth: Tensor,
    sigma_rel: Tensor,
    valid: Tensor,
    selection: ModelSelection,
    limit_and_dtype: tuple[float, torch.dtype],
) -> DepthMap:
    """Log depth and relative sigma -> DepthMap with gates."""
    max_sigma_rel, dtype = limit_and_dtype
    depth = log_depth.exp()
    no_model = (selection.model < 0)[:, None, None].expand_as(valid)
    uncertain = ~depth.isfinite() | ~(sigma_rel <= max_sigma_rel)
    gate = first_reason((~valid, Gate.NO_TRACK), (no_model, Gate.NO_POSE), (uncertain, Gate.UNCERTAIN))
    keep = gate == Gate.ANSWER
    return DepthMap(
        depth=torch.where(keep, depth, torch.nan).to(dtype),
        sigma=torch.where(keep, sigma_rel * depth.detach(), torch.nan).to(dtype),
        score=torch.where(keep, 0.1 / (0.1 + sigma_rel), 0.0).to(dtype),
        source=torch.where(keep, Source.ALIGNED, Source.NONE).to(torch.int32),
        gate=gate,
    )


def _isotonic_map(x: Tensor, points: MetricReferences) -> Tensor:
    """Values through the increasing broken line that fits the references' log depths best: means of equally many
    references, joined where they decrease (isotonic regression by its min-max formula)."""
    n_knots = 12
    value_or_inf = torch.where(points.used, points.x.detach(), torch.inf)
    order = value_or_inf.argsort(-1)
    value, log_z = points.x.detach().gather(1, order), points.depth.log().gather(1, order)
    count = points.used.sum(-1, keepdim=True)
    rank = torch.arange(order.shape[1], device=x.device) / count.clamp_min(1)
    bins = torch.arange(n_knots, device=x.device)[:, None]
    inside = ((rank * n_knots).floor()[:, None] == bins).double()  # (B, knots, N)
    mass = inside.sum(-1).clamp_min(1e-9)
    knot, level = (inside @ value[..., None])[..., 0] / mass, (inside @ log_z[..., None])[..., 0] / mass
    cumulative_mass = torch.cat((torch.zeros_like(mass[:, :1]), mass.cumsum(-1)), -1)
    cumulative_level = torch.cat((torch.zeros_like(mass[:, :1]), (mass * level).cumsum(-1)), -1)
    mean = (cumulative_level[:, None, 1:] - cumulative_level[:, :-1, None]) / (
        cumulative_mass[:, None, 1:] - cumulative_mass[:, :-1, None]
    ).clamp_min(1e-9)
    upper = torch.triu(torch.ones(n_knots, n_knots, dtype=torch.bool, device=x.device))
    mean = torch.where(upper, mean, torch.inf)  # (B, from, to)
    least = mean.flip(-1).cummin(-1).values.flip(-1)  # over all ends from k on
    rising = torch.where(upper, least, -torch.inf).amax(1)
    knot = knot + 1e-9 * torch.arange(n_knots, device=x.device)
    flat = x.flatten(1)
    right = torch.searchsorted(knot.contiguous(), flat.detach().contiguous()).clamp(1, n_knots - 1)
    x0, x1, y0, y1 = (c.gather(1, k) for c in (knot, rising) for k in (right - 1, right))
    slope = (y1 - y0) / (x1 - x0).clamp_min(1e-9)
    return (y0 + slope * (flat - x0)).clamp(-7, 7).exp().view_as(x)
