"""Random sample consensus over camera poses: points and draws → best poses, all pairs at once, with fixed sizes.

Alphabet: B pairs, H drawn triples, K candidate poses, M points in M *slots*: the usable points of a pair come first, in
order, ``count`` (B,) of them. Points are planes (B, 3, M) and (B, 2, M). Nothing here carries a gradient.
"""

import torch
from torch import Tensor

from dhtorch.geometry.checks import check, shaped
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import MIN_DEPTH
from dhtorch.geometry.p3p import p3p_of_planes
from dhtorch.geometry.se3 import Pose

#: Limits the flatness of a point set: spread across over spread along below which it is a line, without unit.
MIN_SPREAD_RATIO = 1e-3

#: Limits the distance of a point, in multiples of the median distance: farther points are directions. With a renderer's
#: sky at 1e10 m the points of a room would look like a line.
MAX_DISTANCE_RATIO = 100.0

#: Limits the points that all hypotheses are scored on first, a count.
PREVIEW_POINTS = 32

#: Limits the hypotheses that are then scored on all points, a count.
SHORTLISTED_POSES = 32

#: Limits the best hypotheses that are returned, a count.
KEPT_POSES = 2


def usable_first(
    usable: Tensor,  # (B, N) bool
    size: int,
) -> tuple[Tensor, Tensor]:
    """Indices (B, size) of usable points in order, and how many there are (B,), at most ``size``.

    Where a row has more than ``size`` usable points they are thinned evenly. Slots beyond the count repeat a point.

    Raises:
        ValueError: wrong shapes, or no point at all (N = 0).
    """
    N = check("usable_first", usable=(usable, "B N"))["N"]
    if N == 0:
        raise ValueError("usable_first: usable has no points, expected N > 0")
    rank = usable.cumsum(-1)
    n_usable = rank[:, -1]
    index = torch.searchsorted(rank, evenly_spaced_slots(n_usable, size) + 1)
    return index.clamp(max=N - 1), n_usable.clamp(max=size)


def evenly_spaced_slots(count: Tensor, size: int) -> Tensor:
    """Slots (B, size) below ``count`` (B,): 0, 1, 2, … up to the count; evenly thinned where there are more."""
    slot, count = torch.arange(size, device=count.device), count[:, None]
    return torch.minimum(slot * count.clamp_min(size) // size, (count - 1).clamp_min(0))


@shaped("draws: B H 3, count: B")
def distinct_triples(
    draws: Tensor,  # (B, H, 3) uniform in [0, 1)
    count: Tensor,  # (B,) int64
) -> Tensor:
    """Three different slots below ``count`` per draw, uniformly distributed: (B, H, 3) int64.

    The second draw chooses among the slots left by the first, the third among those left by both. With fewer than
    three slots the triples cannot be distinct (and stay in range).

    Raises:
        ValueError: wrong shapes.
    """
    left = (count[:, None, None] - torch.arange(3, device=count.device)).clamp_min(1)
    first, second, third = torch.minimum((draws * left).long(), left - 1).unbind(-1)
    second = torch.where(second >= first, second + 1, second)
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    third = torch.where(third >= low, third + 1, third)
    third = torch.where(third >= high, third + 1, third)
    return torch.minimum(torch.stack((first, second, third), -1), (count - 1).clamp_min(0)[:, None, None])


@torch.no_grad()
def msac_cost(
    poses: Tensor,  # (B, 4, 3 K): columns of (R | t), rows times (fx, fy, 1); all first rows, all second, all third
    points: Tensor,  # (B, 6, M): u, v (px, from the principal point), x, y, z (m), 1
    limits: Tensor,  # (B, M) px²: largest squared error, 0 for points that are not used
) -> Tensor:
    """Truncated squared reprojection errors, summed over points: (B, K) px².

    Points behind the camera cost their limit, except one exactly on its axis: inliers are determined by the refinement,
    not by this ranking.

    Source: P. Torr, A. Zisserman, "MLESAC" (CVIU 2000), the truncated score.
    """
    sizes = check("msac_cost", poses=(poses, "B 4 P"), points=(points, "B 6 M"), limits=(limits, "B M"))
    uv, xyz = points[:, :2], points[:, 2:]
    # Limits the residuals of hypotheses computed together, a count: three planes of them stay in cache.
    pairs = max((1 << 15) // max(sizes["P"] * sizes["M"], 1), 1)
    costs = []
    for b in range(0, len(points), pairs):  # few pairs at a time keep the temporaries in cache
        part = slice(b, b + pairs)
        x, y, z = torch.bmm(poses[part].transpose(1, 2), xyz[part]).unflatten(1, (3, -1)).unbind(1)
        w = z.clamp_min_(MIN_DEPTH).reciprocal_()  # points behind the camera land far outside the image
        x = x.mul_(w).sub_(uv[part, :1])
        y = y.mul_(w).sub_(uv[part, 1:])  # both at once saves three calls, and a compiler's fusing them
        costs.append(torch.minimum(x.mul_(x).add_(y.mul_(y)), limits[part, None]).sum(-1))
    return torch.cat(costs)


@torch.no_grad()
def search_hypotheses(
    points: Tensor,  # (B, 5, M): x, y, z (m) and their measured pixel u, v (px)
    count: Tensor,  # (B,) usable slots
    f: Tensor,  # (B, 2) px
    c: Tensor,  # (B, 2) px
    draws: Tensor,  # (B, H, 3) uniform in [0, 1)
    *,
    threshold_px: float,
    keep: int = KEPT_POSES,
    preview: int = PREVIEW_POINTS,
    shortlist: int = SHORTLISTED_POSES,
) -> tuple[Pose, Tensor]:
    """The ``keep`` best poses among four solutions of each of H minimal triples.

    All solutions are scored on ``preview`` evenly taken points; the ``shortlist`` best of them on all points.

    Returns:
        Pose with R (B, keep, 3, 3), t (B, keep, 3), best first, and their costs (B, keep), infinite where there was
        no valid solution (the pose is then finite but meaningless).

    Raises:
        ValueError: wrong shapes, fewer hypotheses (4 H) than ``keep``.
    """
    sizes = check("search_hypotheses", points=(points, "B 5 M"), f=(f, "B 2"), c=(c, "B 2"), draws=(draws, "B H 3"))
    M, K = sizes["M"], 4 * sizes["H"]
    if keep > K:
        raise ValueError(f"search_hypotheses: draws has shape {tuple(draws.shape)}, expected at least {keep} solutions")
    xyz, uv = points[:, :3], points[:, 3:]
    uv, one = uv - c[..., None], torch.ones_like(uv[:, :1])
    triples = distinct_triples(draws, count)
    picked = _take(torch.cat((uv / f[..., None], one, xyz), 1), triples.flatten(1)[:, None])
    rays, places = picked.unflatten(2, triples.shape[1:]).permute(3, 1, 0, 2).split(3, 1)  # (point, coordinate, B, H)
    R, t, valid = p3p_of_planes(rays, places)
    poses = torch.cat((R, t[:, None]), 1).permute(3, 1, 0, 2, 4).flatten(3)  # (B, column, row, K)
    lenses = poses * torch.cat((f, one[:, 0, :1]), 1)[:, None, :, None]
    points = torch.cat((uv, xyz, one), 1)
    used = torch.arange(M, device=count.device) < count[:, None]
    limits = torch.where(used, threshold_px**2, 0.0).to(points.dtype)
    n_preview = min(preview, M)
    preview_points = _take(points, evenly_spaced_slots(count, n_preview)[:, None])
    cost = msac_cost(lenses.flatten(2), preview_points, limits[:, :n_preview])
    cost = cost.masked_fill(~valid.transpose(0, 1).flatten(1), torch.inf)
    cost, index = cost.topk(min(max(shortlist, keep), K), largest=False)
    full = msac_cost(_take(lenses, index[:, None, None]).flatten(2), points, limits)
    # The preview is part of all points, so the larger cost is that of all points, or infinity.
    cost, best = torch.maximum(cost, full).topk(keep, largest=False)
    poses = _take(poses, index.gather(1, best)[:, None, None]).permute(0, 3, 2, 1)
    return Pose(poses[..., :3], poses[..., 3]), cost


@shaped("xyz: B 3 M, used: B M")
def is_collinear(
    xyz: Tensor,  # (B, 3, M) m
    used: Tensor,  # (B, M) bool
) -> Tensor:
    """Whether (B,) the used points lie on one line (or in one point), which leaves a rotation undetermined.

    The second largest eigenvalue of their scatter is compared with the largest through the matrix's invariants. Points
    more than ``MAX_DISTANCE_RATIO`` times as far from the origin as the median one are left out.

    Raises:
        ValueError: wrong shapes.
    """
    reach = xyz.detach().abs().amax(1)
    used = (used & (reach <= MAX_DISTANCE_RATIO * masked_median(reach, used)))[:, None]
    x = xyz.masked_fill(~used, 0.0).double()
    x = torch.where(used, x - x.sum(-1, keepdim=True) / used.sum(-1, keepdim=True).clamp_min(1), 0.0)
    scatter = torch.bmm(x, x.transpose(1, 2))
    trace = scatter.diagonal(dim1=-2, dim2=-1).sum(-1)
    minors = 0.5 * (trace * trace - (scatter * scatter).sum((-2, -1)))  # ≈ product of the two largest eigenvalues
    return minors <= (MIN_SPREAD_RATIO * trace) ** 2


def _take(x: Tensor, index: Tensor) -> Tensor:
    """Planes (B, …, M) at (B, 1, …, S) slots → (B, …, S)."""
    return x.gather(-1, index.expand(*x.shape[:-1], -1))
