"""How far a map in metres is off from pixel to pixel, as its near returns show it: what no model holds of sigma.

Four things are told apart. A return stands somewhere in its pixel and so does the value of the map, so that on a slope
both differ though neither is wrong. What returns have by themselves is not the map's: it goes neither with how the map
stands out of its surroundings nor with what returns a little way off have, and differs from each to the next. What is
left goes with how rough the map is around: two levels, of the flatter and the rougher half of the returns. And where
returns are off by far more than that, so are the pixels around them on the same surface. What chance alone may have
made is nobody's error: both kinds of going together count as far as they exceed their standard error.

Alphabet: ``r`` residual of log depth at references; ``read`` its variance by where in the pixel they stand; ``h`` how
rough the map is; ``G`` candidates of a level.
"""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.alignment.references import MIN_RETURN_ERROR, MetricReferences, sample_at_references
from dhtorch.geometry.covariance import masked_median

#: Relative scatter of a map without near returns.
DEFAULT_RESIDUAL: Final = 0.01

#: How that goes with roughness.
DEFAULT_ROUGHNESS_GAIN: Final = 0.5

#: Side of the window in which a map is rough, as a share of its longer side.
ROUGHNESS_WINDOW: Final = 0.03

#: Share of errors that lie within one sigma.
ONE_SIGMA_QUANTILE: Final = 0.683

#: Share of a Cauchy distribution's scale that so many lie within.
CAUCHY_68_QUANTILE: Final = 1.84

#: Candidates, as powers of ten from, to and how many: levels of relative error, and of error by roughness.
ERROR_LEVELS, ROUGHNESS_LEVELS = (-5, 0, 51), (-3, 1, 41)

#: Widths of the kernels of what is off in places: share of the longer side, and log depth.
PLACE_KERNEL_WIDTH, DEPTH_KERNEL_WIDTH = 0.04, 0.05

#: Weight of what no return says against those around a pixel.
EMPTY_KERNEL_WEIGHT: Final = 0.3

#: Depths between which what is off in places is found.
N_DEPTH_BINS: Final = 48

#: From how many sigmas on a return is off by more than the map's scatter. Beyond two, chance leaves .08 of the variance
#: of returns with normal noise, all over the map; beyond three, .005.
OUTLIER_SIGMAS: Final = 3.0

#: Returns off by more of these levels are no witnesses of what returns have by themselves.
OUTLIER_LEVELS: Final = 3.0

#: Unevenness of a map, as a share of the scatter of returns, below which it is as good as even.
MIN_UNEVENNESS: Final = 0.1

#: How far apart returns are at least that a map is wrong at alike and a sensor is not, whose noise is smooth over a few
#: of its pixels; and the correlation length of what the map is wrong by there, that of the shortest field of a model
#: (:data:`dhtorch.alignment.error_model.FIELD_LENGTHS`). Shares of the longer side.
NOISE_INDEPENDENCE_DISTANCE, MAP_CORRELATION_LENGTH = 0.035, 0.13

#: Least share of what returns have by themselves that differs from each to the next.
MIN_UNCORRELATED_RATIO: Final = 0.5

#: Pairs of returns for which the belief counts that all of the scatter is the map's.
PRIOR_PAIRS: Final = 10


def residual_variance(
    points: MetricReferences,
    r: Tensor,  # (B, N)
    told: tuple[Tensor, Tensor],  # (B, N) variance by reading; standard deviation of the fit
    log: Tensor,  # (B, h, w) log depth of the map
    known: Tensor,  # (B, h, w) bool
) -> Tensor:
    """Variance (B, h, w) of log depth from pixel to pixel; that of a usual map where there are no near returns.

    What the fit itself may be off by is no scatter: as far as its sigma reaches, residuals are taken from their middle.

    Gradient: none. Cost: that of a few images; references are seen on a coarse grid of places and depths.
    Raises ValueError for wrong shapes.
    """
    read, of_fit = told
    with torch.no_grad():
        near = points.used & points.near
        r = r - masked_median(r, near).maximum(-of_fit).minimum(of_fit)
        out = _standing_out(log, known)
        rough = _roughness(out, known)
        h = sample_at_references(rough, points.share)[0].clamp_min(1e-9)
        steep = near & (h >= masked_median(h, near))
        flat, slope = _levels(r, read, h, (near, steep))
        some = near.any(-1, keepdim=True)
        flat, slope = torch.where(some, flat, DEFAULT_RESIDUAL), torch.where(some, slope, DEFAULT_ROUGHNESS_GAIN)
        excess = (r.square() - OUTLIER_SIGMAS**2 * (flat.square() + (slope * h).square() + read)).clamp_min(0)
        level = sample_at_references(log, points.share)[0]
        off = _local_variance(points.share, level, (excess, near), log, known)
        calm = near & (r.abs() <= OUTLIER_LEVELS * flat)
        stands = sample_at_references(out, points.share)[0]
        stated = (masked_median(points.var, calm) - MIN_RETURN_ERROR**2).clamp_min(0)
        place = points.share * points.share.new_tensor(_sides(log))
        apart = torch.cdist(place, place, compute_mode="donot_use_mm_for_euclid_dist")
        fast = _uneven_variance(r, stands, calm / (h.square() + (MIN_UNEVENNESS * flat).square()).clamp_min(1e-18))
        slow = _smooth_variance(r, apart, points.of_block, calm, flat.square())
        alone = stated.minimum(_max_sensor_variance(r, apart, calm, flat.square()))
        of_map = (fast + slow).maximum(flat.square() - alone).minimum(flat.square())
        slope = _edge_noise(r, (stands, h, points.of_block), (flat, slope), steep, stated)
        return of_map[..., None] + (slope[..., None] * rough).square() + off


def _uneven_variance(r: Tensor, stands: Tensor, weight: Tensor) -> Tensor:
    """Variance (B, 1) of what a map is off by from pixel to pixel: that makes it uneven, and residuals go with how it
    ``stands`` out of its surroundings, against it. Where they go along with it the map is too smooth, and what of them
    is told by it is the map's. Where it is even this is known best, whatever returns have by themselves."""
    both, alone, whole = ((weight * v).sum(-1, keepdim=True) for v in (stands * r, stands.square(), torch.ones_like(r)))
    mean = both / whole.clamp_min(1e-18)
    return torch.where(mean < 0, -mean, mean * both / alone.clamp_min(1e-18))


def _smooth_variance(r: Tensor, apart: Tensor, of_block: Tensor, among: Tensor, whole: Tensor) -> Tensor:
    """Variance (B, 1) of what a map is off by over more than a few pixels of a sensor: returns that stand ``apart``
    (B, N, N) are off alike by it, and not by what they have by themselves. It is that of a field of correlation
    ``MAP_CORRELATION_LENGTH``: products of residuals are regressed on it, pairs of blocks (``of_block`` (B, N, blocks),
        one of them 1)
    being the unit of chance. Without many pairs it is as likely the ``whole`` (B, 1) of
    the scatter."""
    pair = among[:, None] & among[..., None] & (apart > NOISE_INDEPENDENCE_DISTANCE)
    alike = torch.where(pair, (-0.5 * (apart / MAP_CORRELATION_LENGTH).square()).exp(), 0.0)
    both = of_block.mT @ (alike * r[:, None] * r[..., None]) @ of_block  # every pair of blocks is there twice
    error = 2 * both.square().sum((1, 2)) - both.diagonal(dim1=1, dim2=2).square().sum(-1)
    more = _beyond_chance(both.sum((1, 2))[:, None], error[:, None])
    return (more + PRIOR_PAIRS * whole) / (alike.square().sum((1, 2))[:, None] + PRIOR_PAIRS)


def _max_sensor_variance(r: Tensor, apart: Tensor, among: Tensor, whole: Tensor) -> Tensor:
    """Most variance (B, 1) that returns have by themselves: ``MIN_UNCORRELATED_RATIO`` of it differs from each to the
    next, so that what neighbours are off by alike is more than that. Without many pairs it is as likely the ``whole``
    (B, 1) of the scatter."""
    itself = torch.eye(r.shape[1], dtype=torch.bool, device=r.device)
    pair = among[:, None] & among[..., None] & (apart <= NOISE_INDEPENDENCE_DISTANCE) & ~itself
    differ = torch.where(pair, 0.5 * (r[:, None] - r[..., None]).square(), 0.0).sum((1, 2))[:, None]
    return (differ / MIN_UNCORRELATED_RATIO + PRIOR_PAIRS * whole) / (pair.sum((1, 2))[:, None] + PRIOR_PAIRS)


def _edge_noise(
    r: Tensor, of_map: tuple[Tensor, Tensor, Tensor], levels: tuple[Tensor, Tensor], steep: Tensor, stated: Tensor
) -> Tensor:
    """Level (B, 1) of error by roughness, less what returns have by themselves where a map is rough, at most what is
    ``stated`` (B, 1): sensors are noisier on slanted and dark surfaces and at edges. It is the map's as far as
    residuals go with how it stands out of its surroundings, along or against it: what blurs or moves an edge does."""
    stands, h, of_block = of_map
    flat, slope = levels
    level = flat.square() + (slope * h).square()
    weight = (steep & (r.square() <= OUTLIER_LEVELS**2 * level)) / level.clamp_min(1e-18)
    both = (weight * stands * r)[:, None] @ of_block
    along = both.sum(-1).abs()
    sure = _beyond_chance(along, both.square().sum(-1)) / along.clamp_min(1e-18)
    alone = (1 - sure) * stated / masked_median(h.square(), steep).clamp_min(1e-18)
    return (slope.square() - alone).maximum(sure * slope.square()).sqrt()


def _beyond_chance(total: Tensor, square: Tensor) -> Tensor:
    """What is left of a sum whose standard error is known, squared: none below one error, nearly all beyond several
    (the positive part of James and Stein's estimate)."""
    return (total - square / total.clamp_min(1e-18)).clamp_min(0)


def _roughness(out: Tensor, known: Tensor) -> Tensor:
    """How far (B, h, w) pixels stand ``out`` of those around them, root mean square over the same window."""
    return _around(out.square(), known, _side(out)).sqrt()


def _standing_out(x: Tensor, known: Tensor) -> Tensor:
    """By how much (B, h, w) pixels differ from the mean of those around them."""
    return x - _around(x, known, _side(x))


def _sides(x: Tensor) -> tuple[float, float]:
    """Width and height of a map in longer sides."""
    return x.shape[-1] / max(x.shape[-2:]), x.shape[-2] / max(x.shape[-2:])


def _side(x: Tensor) -> int:
    """Pixels along the window in which a map is rough."""
    return max(3, 2 * round(0.5 * ROUGHNESS_WINDOW * max(x.shape[-2:])) + 1)


def _around(x: Tensor, known: Tensor, side: int) -> Tensor:
    """Mean (B, h, w) of the known ones of the pixels around each; 0 where it is not known itself."""
    mask = known.to(x)[:, None]
    total, count = (F.avg_pool2d(m, side, 1, side // 2) for m in (torch.where(known, x, 0.0)[:, None], mask))
    return torch.where(known, (total / count.clamp_min(1e-6))[:, 0], 0.0)


def _levels(r: Tensor, read: Tensor, h: Tensor, among: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Level (B, 1) within which 68 % of the errors of the flatter half lie, and by roughness ``h`` of the rougher half,
    ``among`` near returns and the rougher of them (B, N).

    A return either stands where the map's value was taken or beside it: each is as likely, errors are Cauchy's. Their
    likeliest level says how much each return counts as one that is read where it stands.
    """
    near, steep = among
    levels, slopes = (torch.logspace(*of).to(r) for of in (ERROR_LEVELS, ROUGHNESS_LEVELS))
    levels = levels.square()[None, :, None].expand(len(r), -1, r.shape[1])
    flat = _quantile_68(r.abs(), _inlier_probability(r, levels, read, near & ~steep))
    slopes = torch.cat((torch.zeros_like(slopes[:1]), slopes))
    levels = (flat.square() / CAUCHY_68_QUANTILE**2).clamp_min(1e-10)[..., None] + (
        slopes[:, None] * h[:, None]
    ).square()
    known_to = (8 / near.sum(-1, keepdim=True).clamp_min(8)).sqrt()  # the difference of two variances, of half each
    beyond = (r.square() - flat.square() * (1 + known_to)).clamp_min(0).sqrt() / h
    return flat, _quantile_68(beyond, _inlier_probability(r, levels, read, steep)).clamp_max(
        10.0 ** ROUGHNESS_LEVELS[1]
    )


def _inlier_probability(r: Tensor, levels: Tensor, read: Tensor, among: Tensor) -> Tensor:
    """How probable (B, N) it is that references are read where they stand, under the likeliest of ``levels`` (B, G, N),
    squared scales of their errors; 0 of those that are not ``among`` them."""
    there, beside = (
        1 / (v.sqrt() * (1 + r[:, None].square() / v)) for v in (levels, levels + read[:, None] / CAUCHY_68_QUANTILE**2)
    )
    like = torch.where(among[:, None], (there + beside).log(), 0.0).sum(-1)
    best = like.argmax(-1)[:, None, None].expand(-1, -1, r.shape[1])
    return torch.where(among, (there / (there + beside)).gather(1, best)[:, 0], 0.0)


def _quantile_68(value: Tensor, weight: Tensor) -> Tensor:
    """Weighted quantile (B, 1) of values (B, N) at ``ONE_SIGMA_QUANTILE``."""
    value, order = value.sort(-1)
    sums = weight.gather(1, order).cumsum(-1)
    at = (sums < ONE_SIGMA_QUANTILE * sums[:, -1:]).sum(-1, keepdim=True).clamp_max(value.shape[1] - 1)
    return value.gather(1, at)


def _local_variance(
    share: Tensor,  # (B, N, 2)
    level: Tensor,  # (B, N) log depth of the map at references
    found: tuple[Tensor, Tensor],  # (B, N) what they are off by, squared; which count
    log: Tensor,  # (B, h, w)
    known: Tensor,  # (B, h, w)
) -> Tensor:
    """Mean (B, h, w) of what references are off by, of those around each pixel and about as deep: a bilateral grid."""
    excess, used = found
    rows, columns = log.shape[-2:]
    sides = _sides(log)
    low = torch.where(known, log, torch.inf).flatten(1).amin(-1, keepdim=True)
    high = torch.where(known, log, -torch.inf).flatten(1).amax(-1, keepdim=True)
    width = torch.where(low < high, high - low, 1.0)
    low = torch.where(low < high, low, 0.0)
    step = (width / (N_DEPTH_BINS - 1)).clamp_min(DEPTH_KERNEL_WIDTH)
    bins = low + width * torch.linspace(0, 1, N_DEPTH_BINS).to(log)
    of_place = [
        _kernel(
            share[..., k] * side,
            side * torch.linspace(0, 1, max(3, round(2 * side / PLACE_KERNEL_WIDTH))).to(log)[None],
            PLACE_KERNEL_WIDTH,
        )
        for k, side in enumerate(sides)
    ]
    of_depth = _kernel(level, bins, step[..., None]) * used[:, None]
    place = of_place[1][:, :, None] * of_place[0][:, None]  # (B, rows, columns, N)
    both = torch.stack((of_depth, of_depth * excess[:, None]), 1)  # (B, 2, BINS, N)
    grid = torch.einsum("byxn,bckn->bckyx", place, both)
    v, u = torch.meshgrid(*((2 * torch.arange(n).to(log) + 1) / n - 1 for n in (rows, columns)), indexing="ij")
    at = 2 * (log - low[..., None]) / width[..., None] - 1
    where = torch.stack((u.expand_as(at), v.expand_as(at), at), -1)[:, None]
    mass, total = F.grid_sample(grid, where, padding_mode="border", align_corners=True)[:, :, 0].unbind(1)
    return total / (mass + EMPTY_KERNEL_WEIGHT)


def _kernel(at: Tensor, node: Tensor, length: float | Tensor) -> Tensor:
    """Of places (B, N) and nodes (B or 1, K): (B, K, N)."""
    return (-0.5 * ((at[:, None] - node[..., None]) / length).square()).exp()
