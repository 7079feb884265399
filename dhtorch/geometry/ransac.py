"""Random sample consensus over camera poses, all hypotheses of all pairs at once, with fixed sizes.

Alphabet: B pairs, H drawn triples, K candidate poses, M points in M *slots*: the usable points of a pair come first, in
order, ``count`` (B,) of them. Points are planes (B, 3, M) and (B, 2, M). Nothing here carries a gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.geometry.covariance import median
from dhtorch.geometry.least_squares import MIN_DEPTH
from dhtorch.geometry.p3p import p3p
from dhtorch.geometry.se3 import Pose
from dhtorch.geometry.shapes import check

#: A point set counts as a line when its spread across is below this share of its spread along.
MIN_SPREAD = 1e-3

#: Points this many times as far as the median one are directions, not places: a renderer's sky at 1e10 m, with the
#: points of a room, would look like a line.
FAR_OFF = 100.0

#: Residuals of hypotheses that are looked at together: three planes of them stay in cache.
RESIDUALS = 1 << 15


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
    found = usable.cumsum(-1)
    number = found[:, -1]
    index = torch.searchsorted(found, even_slots(number, size) + 1)
    return index.clamp(max=N - 1), number.clamp(max=size)


def even_slots(count: Tensor, size: int) -> Tensor:
    """(B, size) slots below ``count`` (B,): 0, 1, 2, … while they last; evenly thinned where there are more."""
    slot = torch.arange(size, device=count.device)
    count = count[:, None]
    return torch.where(count > size, slot * count // size, torch.minimum(slot, (count - 1).clamp_min(0)))


def distinct_triples(
    draws: Tensor,  # (B, H, 3) uniform in [0, 1)
    count: Tensor,  # (B,) int64
) -> Tensor:
    """Three different slots below ``count`` per draw, uniformly: (B, H, 3) int64.

    The second draw chooses among the slots left by the first, the third among those left by both. With fewer than
    three slots the triples cannot be distinct (and stay in range).

    Raises:
        ValueError: wrong shapes.
    """
    check("distinct_triples", draws=(draws, "B H 3"), count=(count, "B"))
    left = (count[:, None, None] - torch.arange(3, device=count.device)).clamp_min(1)
    first, second, third = torch.minimum((draws * left).long(), left - 1).unbind(-1)
    second = second + (second >= first)
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    third = third + (third >= low)
    third = third + (third >= high)
    return torch.minimum(torch.stack((first, second, third), -1), (count - 1).clamp_min(0)[:, None, None])


@torch.no_grad()
def msac_cost(
    T: Pose,  # R (B, K, 3, 3), t (B, K, 3)
    f: Tensor,  # (B, 2) px
    xyz: Tensor,  # (B, 3, M) m
    uv: Tensor,  # (B, 2, M) px relative to the principal point
    used: Tensor,  # (B, M) bool
    threshold_px: float,
) -> Tensor:
    """Truncated squared reprojection errors, summed over the used points: (B, K) px².

    Points behind the camera count in full, save one exactly on its axis: refinement, not this ranking, decides on
    inliers.

    Source: P. Torr, A. Zisserman, "MLESAC" (CVIU 2000), the truncated score.
    """
    sizes = check("msac_cost", R=(T.R, "B K 3 3"), t=(T.t, "B K 3"), xyz=(xyz, "B 3 M"), uv=(uv, "B 2 M"))
    limits = (used * (threshold_px * threshold_px))[:, None]
    scale = torch.cat((f, torch.ones_like(f[:, :1])), 1)[:, :, None, None]
    P = (torch.cat((T.R, T.t[..., None]), -1).transpose(1, 2) * scale).flatten(1, 2)  # (B, 3 K, 4)
    points = torch.cat((xyz, torch.ones_like(xyz[:, :1])), 1)
    pairs = max(RESIDUALS // (sizes["K"] * max(sizes["M"], 1)), 1)
    costs = []
    for b in range(0, len(f), pairs):  # few pairs at a time keep the temporaries in cache
        part = slice(b, b + pairs)
        x, y, z = torch.bmm(P[part], points[part]).unflatten(1, (3, -1)).unbind(1)
        w = z.clamp_min_(MIN_DEPTH).reciprocal_()  # points behind the camera land far outside the image
        x = x.mul_(w).sub_(uv[part, :1])
        y = y.mul_(w).sub_(uv[part, 1:])
        costs.append(torch.minimum(x.mul_(x).add_(y.mul_(y)), limits[part]).sum(-1))
    return torch.cat(costs)


@torch.no_grad()
def search(
    xyz: Tensor,  # (B, 3, M) m
    uv: Tensor,  # (B, 2, M) px
    count: Tensor,  # (B,) usable slots
    f: Tensor,  # (B, 2) px
    c: Tensor,  # (B, 2) px
    draws: Tensor,  # (B, H, 3) uniform in [0, 1)
    *,
    threshold_px: float,
    keep: int = 2,
    preview: int = 32,
    shortlist: int = 32,
) -> tuple[Pose, Tensor]:
    """The ``keep`` best poses among four solutions of each of H minimal triples.

    All solutions are scored on ``preview`` evenly taken points; the ``shortlist`` best of them on all points.

    Returns:
        Pose with R (B, keep, 3, 3), t (B, keep, 3), best first, and their costs (B, keep), infinite where there was
        no valid solution (the pose is then finite but meaningless).

    Raises:
        ValueError: wrong shapes, fewer hypotheses (4 H) than ``keep``.
    """
    sizes = check("search", xyz=(xyz, "B 3 M"), uv=(uv, "B 2 M"), f=(f, "B 2"), c=(c, "B 2"), draws=(draws, "B H 3"))
    if 4 * sizes["H"] < keep:
        raise ValueError(f"search: draws has shape {tuple(draws.shape)}, expected at least {keep} solutions")
    uv = uv - c[..., None]
    rays = torch.cat((uv / f[..., None], torch.ones_like(uv[:, :1])), 1)
    triples = distinct_triples(draws, count)
    picked = _take(torch.cat((rays, xyz), 1), triples.flatten(1)).unflatten(2, triples.shape[1:]).permute(0, 2, 3, 1)
    R, t, valid = p3p(picked[..., :3], picked[..., 3:])
    poses = Pose(R.flatten(1, 2), t.flatten(1, 2))
    few = even_slots(count, preview)
    used = torch.arange(preview, device=count.device) < count[:, None]
    cost = msac_cost(poses, f, _take(xyz, few), _take(uv, few), used, threshold_px)
    cost = cost.masked_fill(~valid.flatten(1), torch.inf)
    poses, cost = _best(poses, cost, min(max(shortlist, keep), 4 * sizes["H"]))
    used = torch.arange(sizes["M"], device=count.device) < count[:, None]
    full = msac_cost(poses, f, xyz, uv, used, threshold_px)
    return _best(poses, full.masked_fill(cost == torch.inf, torch.inf), keep)


def collinear(
    xyz: Tensor,  # (B, 3, M) m
    used: Tensor,  # (B, M) bool
) -> Tensor:
    """(B,) bool: the used points lie on one line (or in one point), and so leave a rotation undetermined.

    The second largest eigenvalue of their scatter is compared with the largest through the matrix's invariants. Points
    more than ``FAR_OFF`` times as far from the origin as the median one are not looked at.

    Raises:
        ValueError: wrong shapes.
    """
    check("collinear", xyz=(xyz, "B 3 M"), used=(used, "B M"))
    reach = xyz.detach().abs().amax(1)
    used = (used & (reach <= FAR_OFF * median(reach, used)))[:, None]
    x = xyz.masked_fill(~used, 0.0).double()
    x = (x - x.sum(-1, keepdim=True) / used.sum(-1, keepdim=True).clamp_min(1)) * used
    scatter = torch.bmm(x, x.transpose(1, 2))
    trace = scatter.diagonal(dim1=-2, dim2=-1).sum(-1)
    minors = 0.5 * (trace * trace - (scatter * scatter).sum((-2, -1)))  # ≈ product of the two largest eigenvalues
    return minors <= (MIN_SPREAD * trace) ** 2


def _take(planes: Tensor, slots: Tensor) -> Tensor:
    """(B, C, M) at (B, S) slots → (B, C, S)."""
    return planes.gather(2, slots[:, None].expand(-1, planes.shape[1], -1))


def _best(poses: Pose, cost: Tensor, keep: int) -> tuple[Pose, Tensor]:
    cost, index = cost.topk(keep, dim=1, largest=False)
    R = poses.R.gather(1, index[..., None, None].expand(-1, -1, 3, 3))
    return Pose(R, poses.t.gather(1, index[..., None].expand(-1, -1, 3))), cost
