"""Residual noise of a depth map from pixel to pixel, estimated from near returns: errors that no error model explains.

Four contributions are distinguished.

1. Position within the pixel: a return lies somewhere in its pixel and so does the value of the map, so that on a slope
   both differ without an error.
2. Noise of the returns: it is correlated neither with how the map deviates from its surroundings nor with the residuals
   of returns some distance away, and differs between neighbours. It is not the map's.
3. Noise of the map: it grows with the roughness of the map; two levels, of the flatter and the rougher half of the
   returns.
4. Local errors: where returns are off by far more than that, so are the pixels around them on the same surface.

Correlations count only as far as they exceed their standard error, so that chance adds nothing.

Alphabet: ``r`` residual of log depth at references; ``read`` its variance by the position within the pixel; ``h``
roughness of the map; ``G`` candidates of a level.
"""

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS, AlignmentOptions
from dhtorch.alignment.references import MetricReferences, sample_at_references
from dhtorch.geometry.covariance import masked_median

#: Fraction of normal errors that lie within one sigma. Source: derived, erf(1 / √2).
ONE_SIGMA_QUANTILE: Final = 0.683

#: Quantile ``ONE_SIGMA_QUANTILE`` of the absolute value of a Cauchy distribution, in scales.
#: Source: derived, tan(0.683 · π / 2).
CAUCHY_68_QUANTILE: Final = 1.84


def residual_variance(
    points: MetricReferences,
    r: Tensor,  # (B, N)
    noise_terms: tuple[
        Tensor, Tensor
    ],  # (B, N) variance by the position within the pixel; standard deviation of the fit
    log: Tensor,  # (B, h, w) log depth of the map
    known: Tensor,  # (B, h, w) bool
    options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS,
) -> Tensor:
    """Residuals of near returns -> variance (B, h, w) of the map's log depth from pixel to pixel.

    Without near returns it is that of a usual map. The error of the fit itself is no scatter: residuals are taken
    relative to their median as far as the fit's sigma reaches.

    Gradient: none. Cost: that of a few images; local errors are evaluated on a coarse grid of places and depths.
    Raises ValueError for wrong shapes.
    """
    read, fit_sigma = noise_terms
    with torch.no_grad():
        near = points.used & points.near
        r = r - masked_median(r, near).maximum(-fit_sigma).minimum(fit_sigma)
        deviation_map = log - _window_mean(log, known, _window_side(log, options))
        roughness = _window_mean(deviation_map.square(), known, _window_side(deviation_map, options)).sqrt()
        h = sample_at_references(roughness, points.share)[0].clamp_min(1e-9)
        rough = near & (h >= masked_median(h, near))
        flat, gain = _levels(r, read, h, (near, rough), options)
        has_near = near.any(-1, keepdim=True)
        flat, gain = (
            torch.where(has_near, flat, options.default_residual),
            torch.where(has_near, gain, options.default_roughness_gain),
        )
        excess = (r.square() - options.outlier_sigmas**2 * (flat.square() + (gain * h).square() + read)).clamp_min(0)
        log_at = sample_at_references(log, points.share)[0]
        local_var = _local_variance(points.share, log_at, (excess, near), log, known, options)
        inlier = near & (r.abs() <= options.outlier_levels * flat)
        deviation = sample_at_references(deviation_map, points.share)[0]
        stated = (masked_median(points.var, inlier) - options.min_return_error**2).clamp_min(0)
        place = points.share * points.share.new_tensor(_side_lengths(log))
        distance = torch.cdist(place, place, compute_mode="donot_use_mm_for_euclid_dist")
        weight = inlier / (h.square() + (options.min_unevenness * flat).square()).clamp_min(1e-18)
        uneven_var = _uneven_variance(r, deviation, weight)
        smooth_var = _smooth_variance(r, distance, points.of_block, inlier, flat.square(), options)
        sensor_var = stated.minimum(_max_sensor_variance(r, distance, inlier, flat.square(), options))
        map_var = (uneven_var + smooth_var).maximum(flat.square() - sensor_var).minimum(flat.square())
        gain = _edge_gain(r, (deviation, h, points.of_block), (flat, gain), rough, stated, options)
        return map_var[..., None] + (gain[..., None] * roughness).square() + local_var


def _uneven_variance(r: Tensor, deviation: Tensor, weight: Tensor) -> Tensor:
    """Variance (B, 1) of the map's errors from pixel to pixel, from the regression of residuals on its deviation.

    Such errors make the map uneven: residuals have the opposite sign of its ``deviation`` from the surroundings. Where
    they have the same sign the map is too smooth, and the part of them that the deviation explains is the map's. An
    even map determines this best, whatever the noise of the returns.
    """
    cross, own, total = (
        (weight * v).sum(-1, keepdim=True) for v in (deviation * r, deviation.square(), torch.ones_like(r))
    )
    mean = cross / total.clamp_min(1e-18)
    return torch.where(mean < 0, -mean, mean * cross / own.clamp_min(1e-18))


def _smooth_variance(
    r: Tensor, distance: Tensor, of_block: Tensor, valid: Tensor, prior: Tensor, options: AlignmentOptions
) -> Tensor:
    """Variance (B, 1) of the map's smooth errors, from products of the residuals of distant returns.

    Returns at a ``distance`` (B, N, N) beyond the sensor's noise share the map's errors and not their own. Products of
    their residuals are regressed on the covariance of a field of correlation length ``map_correlation_length``; pairs
    of blocks (``of_block`` (B, N, blocks), one of them 1) are the unit of the standard error. With few pairs the
    estimate tends to the ``prior`` (B, 1), the whole of the scatter.
    """
    pair = valid[:, None] & valid[..., None] & (distance > options.noise_independence_distance)
    kernel = torch.where(pair, (-0.5 * (distance / options.map_correlation_length).square()).exp(), 0.0)
    products = of_block.mT @ (kernel * r[:, None] * r[..., None]) @ of_block  # every pair of blocks occurs twice
    error = 2 * products.square().sum((1, 2)) - products.diagonal(dim1=1, dim2=2).square().sum(-1)
    shrunk = _positive_part(products.sum((1, 2))[:, None], error[:, None])
    return (shrunk + options.prior_pairs * prior) / (kernel.square().sum((1, 2))[:, None] + options.prior_pairs)


def _max_sensor_variance(
    r: Tensor, distance: Tensor, valid: Tensor, prior: Tensor, options: AlignmentOptions
) -> Tensor:
    """Upper bound (B, 1) of the returns' noise variance, from differences of neighbouring returns.

    At least ``min_uncorrelated_ratio`` of it differs between neighbours, so that larger errors that neighbours share
    are the map's. With few pairs the bound tends to the ``prior`` (B, 1), the whole of the scatter.
    """
    itself = torch.eye(r.shape[1], dtype=torch.bool, device=r.device)
    pair = valid[:, None] & valid[..., None] & (distance <= options.noise_independence_distance) & ~itself
    difference_var = torch.where(pair, 0.5 * (r[:, None] - r[..., None]).square(), 0.0).sum((1, 2))[:, None]
    return (difference_var / options.min_uncorrelated_ratio + options.prior_pairs * prior) / (
        pair.sum((1, 2))[:, None] + options.prior_pairs
    )


def _edge_gain(
    r: Tensor,
    map_at_points: tuple[Tensor, Tensor, Tensor],
    levels: tuple[Tensor, Tensor],
    rough: Tensor,
    stated: Tensor,
    options: AlignmentOptions,
) -> Tensor:
    """Error per roughness (B, 1) of the map, without the noise of the returns where the map is rough.

    Sensors are noisier on slanted and dark surfaces and at edges; at most the ``stated`` variance (B, 1) is taken for
    their noise. The error is the map's as far as residuals are correlated, with either sign, with its deviation from
    the surroundings: so they are where an edge is blurred or moved.
    """
    deviation, h, of_block = map_at_points
    flat, gain = levels
    level = flat.square() + (gain * h).square()
    weight = (rough & (r.square() <= options.outlier_levels**2 * level)) / level.clamp_min(1e-18)
    products = (weight * deviation * r)[:, None] @ of_block
    correlation = products.sum(-1).abs()
    significance = _positive_part(correlation, products.square().sum(-1)) / correlation.clamp_min(1e-18)
    sensor_square = (1 - significance) * stated / masked_median(h.square(), rough).clamp_min(1e-18)
    return (gain.square() - sensor_square).maximum(significance * gain.square()).sqrt()


def _positive_part(total: Tensor, square: Tensor) -> Tensor:
    """Sum and its squared standard error -> shrunk sum: 0 below one error, nearly the whole beyond several (the
    positive part of James and Stein's estimate)."""
    return (total - square / total.clamp_min(1e-18)).clamp_min(0)


def _side_lengths(x: Tensor) -> tuple[float, float]:
    """Width and height of a map as fractions of the longer side."""
    return x.shape[-1] / max(x.shape[-2:]), x.shape[-2] / max(x.shape[-2:])


def _window_side(x: Tensor, options: AlignmentOptions) -> int:
    """Side of the roughness window, px, odd."""
    return max(3, 2 * round(0.5 * options.roughness_window * max(x.shape[-2:])) + 1)


def _window_mean(x: Tensor, valid: Tensor, side: int) -> Tensor:
    """Mean (B, h, w) of the valid pixels of the window around each; 0 where it is not valid itself."""
    mask = valid.to(x)[:, None]
    total, count = (F.avg_pool2d(m, side, 1, side // 2) for m in (torch.where(valid, x, 0.0)[:, None], mask))
    return torch.where(valid, (total / count.clamp_min(1e-6))[:, 0], 0.0)


def _levels(
    r: Tensor, read: Tensor, h: Tensor, masks: tuple[Tensor, Tensor], options: AlignmentOptions
) -> tuple[Tensor, Tensor]:
    """Level (B, 1) within which 68 % of the errors of the flatter half lie, and level per roughness ``h`` of the
    rougher half; ``masks`` (B, N) are the near returns and the rougher of them.

    A return lies either where the map's value was taken or beside it: each is as likely, errors are Cauchy distributed.
    The most probable level gives the probability with which a return counts as one at the place of the value.
    """
    near, rough = masks
    levels, gains = (torch.logspace(*of).to(r) for of in (options.error_levels, options.roughness_levels))
    levels = levels.square()[None, :, None].expand(len(r), -1, r.shape[1])
    flat = _quantile_68(r.abs(), _inlier_probability(r, levels, read, near & ~rough))
    gains = torch.cat((torch.zeros_like(gains[:1]), gains))
    levels = (flat.square() / CAUCHY_68_QUANTILE**2).clamp_min(1e-10)[..., None] + (
        gains[:, None] * h[:, None]
    ).square()
    relative_error = (8 / near.sum(-1, keepdim=True).clamp_min(8)).sqrt()  # of a difference of variances of two halves
    excess = (r.square() - flat.square() * (1 + relative_error)).clamp_min(0).sqrt() / h
    return flat, _quantile_68(excess, _inlier_probability(r, levels, read, rough)).clamp_max(
        10.0 ** options.roughness_levels[1]
    )


def _inlier_probability(r: Tensor, levels: Tensor, read: Tensor, valid: Tensor) -> Tensor:
    """Probability (B, N) that references lie where the map's value was taken, under the most probable of ``levels``
    (B, G, N), squared scales of their errors; 0 of those that are not ``valid``."""
    same_place, other_place = (
        1 / (v.sqrt() * (1 + r[:, None].square() / v)) for v in (levels, levels + read[:, None] / CAUCHY_68_QUANTILE**2)
    )
    log_likelihood = torch.where(valid[:, None], (same_place + other_place).log(), 0.0).sum(-1)
    best = log_likelihood.argmax(-1)[:, None, None].expand(-1, -1, r.shape[1])
    return torch.where(valid, (same_place / (same_place + other_place)).gather(1, best)[:, 0], 0.0)


def _quantile_68(value: Tensor, weight: Tensor) -> Tensor:
    """Weighted quantile (B, 1) of values (B, N) at ``ONE_SIGMA_QUANTILE``."""
    value, order = value.sort(-1)
    sums = weight.gather(1, order).cumsum(-1)
    index = (sums < ONE_SIGMA_QUANTILE * sums[:, -1:]).sum(-1, keepdim=True).clamp_max(value.shape[1] - 1)
    return value.gather(1, index)


def _local_variance(
    share: Tensor,  # (B, N, 2)
    log_at: Tensor,  # (B, N) log depth of the map at references
    excess_and_use: tuple[Tensor, Tensor],  # (B, N) squared errors beyond the scatter; which references count
    log_depth: Tensor,  # (B, h, w)
    valid: Tensor,  # (B, h, w)
    options: AlignmentOptions,
) -> Tensor:
    """Mean (B, h, w) squared error of the references around each pixel at about its depth, by a bilateral grid."""
    excess, used = excess_and_use
    rows, columns = log_depth.shape[-2:]
    sides = _side_lengths(log_depth)
    low = torch.where(valid, log_depth, torch.inf).flatten(1).amin(-1, keepdim=True)
    high = torch.where(valid, log_depth, -torch.inf).flatten(1).amax(-1, keepdim=True)
    width = torch.where(low < high, high - low, 1.0)
    low = torch.where(low < high, low, 0.0)
    step = (width / (options.n_depth_bins - 1)).clamp_min(options.depth_kernel_width)
    bins = low + width * torch.linspace(0, 1, options.n_depth_bins).to(log_depth)
    axis_kernels = [
        _kernel(
            share[..., k] * side,
            side * torch.linspace(0, 1, max(3, round(2 * side / options.place_kernel_width))).to(log_depth)[None],
            options.place_kernel_width,
        )
        for k, side in enumerate(sides)
    ]
    depth_kernel = _kernel(log_at, bins, step[..., None]) * used[:, None]
    place_kernel = axis_kernels[1][:, :, None] * axis_kernels[0][:, None]  # (B, rows, columns, N)
    mass_and_total = torch.stack((depth_kernel, depth_kernel * excess[:, None]), 1)  # (B, 2, BINS, N)
    grid = torch.einsum("byxn,bckn->bckyx", place_kernel, mass_and_total)
    v, u = torch.meshgrid(*((2 * torch.arange(n).to(log_depth) + 1) / n - 1 for n in (rows, columns)), indexing="ij")
    bin_place = 2 * (log_depth - low[..., None]) / width[..., None] - 1
    where = torch.stack((u.expand_as(bin_place), v.expand_as(bin_place), bin_place), -1)[:, None]
    mass, total = F.grid_sample(grid, where, padding_mode="border", align_corners=True)[:, :, 0].unbind(1)
    return total / (mass + options.empty_kernel_weight)


def _kernel(at: Tensor, node: Tensor, length: float | Tensor) -> Tensor:
    """Gaussian kernel (B, K, N) of places (B, N) and nodes (B or 1, K)."""
    return (-0.5 * ((at[:, None] - node[..., None]) / length).square()).exp()
