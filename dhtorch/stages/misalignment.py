"""Beside stage 5: does depth belong to the picture? Near returns and the parallax of their pixels → pose, or a code.

A loader that mirrors, crops or shifts pictures and leaves depth and intrinsics as they are attaches returns to wrong
pixels. A motion still fits such tracks, because most of their displacement is rotation and mean depth; but the rest of
their parallax is not explained by the depth at their own pixels, or is explained better by the depth at others.

Alphabet: ``p`` the inverse depth of a return and ``q`` that of its track triangulated under the pose (1/m); ``a`` =
d(pixel of view 1) / dq along the epipolar line (px m), so that (q − p) a is the residual along that line in px.
"""

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import PoseCode
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, ransac
from dhtorch.geometry.checks import all_finite, any_possible, constant, shaped
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.reprojection_problem import MEDIAN_1D, MIN_NOISE_PX, undo_rolling_shutter
from dhtorch.ops.dispatch import operator, run_kernel
from dhtorch.pytree import chunked_apply
from dhtorch.records import Camera, Pose, PoseFit, Samples, Tracks

#: Limits the influence of a residual, in standard deviations: where the robust cost bends.
#: Source: FitOptions.bend, the same kernel.
COST_BEND = 2.0

#: Limits the near returns of a pair on which other attachments are tried, a count; more are thinned evenly.
#: Source: derived, a quarter of the default samples; limits the time.
MAX_ATTACHED_RETURNS = 512

#: Cells (across, down) of the picture in which the inverse depth of returns is averaged for other attachments, a count.
#: Source: chosen on shared_scenes, the field cases and the built-in rooms.
DEPTH_CELLS = (40, 30)

#: Other attachments that are tried: pixel of depth = centre + (sx, sy) · (pixel − centre) + (dx, dy) · picture size.
#: Source: derived, what loaders do: flips, centre crops by 10 to 40 %, shifts by 5 and 10 %.
ATTACHMENTS = (
    *((-1.0, 1.0, 0.0, 0.0), (1.0, -1.0, 0.0, 0.0), (-1.0, -1.0, 0.0, 0.0)),
    *((s, s, 0.0, 0.0) for s in (0.9, 0.8, 0.7, 0.6)),
    *((1.0, 1.0, d, 0.0) for d in (-0.1, -0.05, 0.05, 0.1)),
    *((1.0, 1.0, 0.0, d) for d in (-0.1, -0.05, 0.05, 0.1)),
)


class _Parallax(NamedTuple):
    """Near returns of B pairs with the parallax of their tracks; unused ones hold safe finite values."""

    uv: Tensor  # (B, N, 2) px of view 0
    p: Tensor  # (B, N) 1/m
    q: Tensor  # (B, N) 1/m
    a: Tensor  # (B, N) px m
    variance_rel: Tensor  # (B, N) relative variance of p
    noise: Tensor  # (B, 1) px, of a track across its epipolar line
    used: Tensor  # (B, N) bool


@shaped("samples.xyz: B N 3, tracks.uv_1: B N 2, fit.T_1_from_0.R: B 3 3, camera_0.f: B 2, camera_1.f: B 2")
def reject_misaligned(
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    camera_0: Camera,
    camera_1: Camera,
    *,
    max_unexplained: float = 0.65,
    min_gain: float = 0.85,
    few_returns: float = 3.0,
    min_t_snr: float = 30.0,
) -> PoseFit:
    """A fit without the poses of pairs whose depth does not belong to their pictures, which get the code MISALIGNED.

    Two ratios of mean robust costs, in [0, 1], of the residuals along the epipolar lines of n near returns decide. The
    first is the cost of the returned depths over that of one depth for all: returns at wrong pixels hardly improve on
    it. The second is the cost of the depths at other pixels (:data:`ATTACHMENTS`) over that of the depths at the
    tracks' own. Returns whose parallax hardly varies, or few of them, refute nothing.

    A shutter rate that was fitted to such pairs absorbs part of what the depths leave unexplained. So the first ratio
    is taken with the rolling shutter as it is, and must also exceed .5 where it is undone.

    Args:
        samples, tracks, camera_0, camera_1: the inputs of stage 5.
        fit: the result of stage 5.
        max_unexplained: limit of the first ratio; a pair is rejected above this plus ``few_returns`` / √n.
        min_gain: limit of the second ratio; a pair is rejected below this minus ``few_returns`` / √n.
        few_returns: standard deviation of the ratios times √n, as a margin.
        min_t_snr: length of the translation, in its own standard deviations, from which pairs are tested: with less
            there is no parallax to explain.

    Raises:
        ValueError: wrong shapes.

    Gradient: to the poses that stay; whether they do carries none.
    Cost: linear in N; two triangulations and 17 evaluations of the residuals along the epipolar lines.
    """
    reject = partial(
        _reject, max_unexplained=max_unexplained, min_gain=min_gain, few_returns=few_returns, min_t_snr=min_t_snr
    )
    cameras = (cam.ideal(camera_0), cam.ideal(camera_1))
    # Each near return of a pair has a row for every attachment.
    return chunked_apply(reject, 16, fit, samples, tracks, *cameras)


def _reject(fit: PoseFit, *inputs: Samples | Tracks | Camera, **limits: float) -> PoseFit:
    """:func:`reject_misaligned` for one chunk of pairs."""
    with torch.no_grad():
        rejected = _is_misaligned(fit, *inputs, **limits)  # type: ignore[arg-type]
    return fit.without_pose(rejected, PoseCode.MISALIGNED)


def _is_misaligned(
    fit: PoseFit,
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    *,
    max_unexplained: float,
    min_gain: float,
    few_returns: float,
    min_t_snr: float,
) -> Tensor:
    """Whether (B,) there is a pose and the limits of :func:`reject_misaligned` reject it."""
    straight = _near_parallax(samples, tracks, fit, camera_0, camera_1)
    n = straight.used.sum(-1)
    p = masked_median(straight.p, straight.used)
    variance = fit.cov.diagonal(dim1=-2, dim2=-1).nan_to_num(0.0)
    rotation, translation = variance.split(3, -1)
    # A pose stated to more than .003 rad (1.5 px at f = 500 px) leaves residuals that no depth explains.
    is_exact = (rotation.mean(-1) + translation.mean(-1) * p[:, 0].nan_to_num(0.0).square()).sqrt() <= 0.003
    # The limits of this test, here and in ``_attachment_gain``: chosen on shared_scenes, the field cases and the
    # built-in rooms, sound and with altered pictures.
    tested = fit.ok & is_exact & (n >= 24) & (fit.t_snr >= min_t_snr)
    if not any_possible(tested):
        return tested
    rolling = straight
    if fit.shutter is not None:
        rolling = _near_parallax(samples, tracks, fit.replace(shutter=None), camera_0, camera_1)
    rejected = _unexplained_ratio(rolling) > max_unexplained + few_returns / n.clamp_min(1).sqrt()
    if fit.shutter is not None:
        rejected = rejected & (_unexplained_ratio(straight) > 0.5)
    gain, n_shared = _attachment_gain(_thinned(straight), samples)
    rejected = rejected | (gain < min_gain - few_returns / n_shared.clamp_min(1).sqrt()).any(-1)
    return rejected & tested


def _near_parallax(samples: Samples, tracks: Tracks, fit: PoseFit, camera_0: Camera, camera_1: Camera) -> _Parallax:
    """Near returns and the parallax of their tracks under the pose, the fit's rolling shutter undone."""
    T, rate = fit.T_1_from_0, None if fit.shutter is None else fit.shutter.shutter_rate
    seen = tracks.uv_0, tracks.uv_1, tracks.valid
    intrinsics = camera_0.f, camera_0.c, camera_1.f, camera_1.c
    return _parallax(*seen, samples.xyz, samples.sigma, fit.ok, T.R, T.t, rate, *intrinsics)


def _parallax_kernel(*tensors: Any) -> _Parallax:
    uv_0, valid, sigma, t, rate = (tensors[k] for k in (0, 2, 4, 7, 8))
    p, q, a, variance_rel = sigma.new_empty(4, *sigma.shape)
    uv, noise, used = uv_0.new_empty(uv_0.shape), sigma.new_empty(len(sigma), 1), valid.new_empty(valid.shape)
    near = _Parallax(uv, p, q, a, variance_rel=variance_rel, noise=noise, used=used)
    inputs = *tensors[:8], t.new_empty(0, 3) if rate is None else rate, *tensors[9:]
    # .04 of depth is always tolerated beside the returns' own sigma: distortion and registration of sensors.
    return run_kernel("near_parallax", inputs, near, 0.04, MEDIAN_1D, MIN_NOISE_PX)


#: What the kernel reads: fields of tracks, samples and fit, the shutter rate (B, 3) or None, both cameras' intrinsics.
_PARALLAX_DTYPES = {
    name: torch.bool if name in ("valid", "posed") else torch.float32
    for name in (
        *("uv_0", "uv_1", "valid", "xyz", "sigma", "posed", "R", "t", "shutter_rate"),
        *("f_0", "c_0", "f_1", "c_1"),
    )
}


@operator(kernel=_parallax_kernel, dtypes=_PARALLAX_DTYPES, any_layout=tuple(_PARALLAX_DTYPES))
def _parallax(*tensors: Any) -> _Parallax:
    """:func:`_near_parallax` of tensors."""
    seen_0, seen_1, valid, xyz, sigma, posed, R, t, rate = tensors[:9]
    camera_0, camera_1 = (Camera(*intrinsics) for intrinsics in (tensors[9:11], tensors[11:]))
    posed = posed[:, None]
    tracked = valid & all_finite(seen_0, -1) & all_finite(seen_1, -1) & posed
    uv_0, uv_1 = (torch.where(tracked[..., None], x, torch.zeros_like(x)) for x in (seen_0, seen_1))
    if rate is not None:
        rate = torch.where(posed, rate, torch.zeros_like(rate))
        height = cam.ray_heights(camera_0, uv_0)
        uv_1 = undo_rolling_shutter(uv_1.transpose(1, 2), camera_1.f, camera_1.c, height, rate).transpose(1, 2)
    eye = torch.eye(3, dtype=uv_1.dtype, device=uv_1.device)
    T = Pose(torch.where(posed[..., None], R, eye), torch.where(posed, t, eye[0]))
    geometry = epipolar.triangulate(uv_0, uv_1, camera_0, camera_1, T)
    z, depth = xyz[..., 2], geometry.depth
    is_usable = all_finite(xyz, -1)
    q = 1 / torch.where(depth.abs() > 1e-6, depth, torch.full_like(depth, 1e-6))
    a = torch.linalg.vector_norm(geometry.slope, dim=-1) * depth * depth
    used = tracked & is_usable & (z > 0) & sigma.isfinite() & (a > 0) & a.isfinite()
    p = 1 / torch.where(used, z, torch.ones_like(z))
    q, a, sigma = (torch.where(used, x, torch.zeros_like(x)) for x in (q, a, sigma))
    far = tracked & ~is_usable
    across = [torch.where(m.any(-1, keepdim=True), masked_median(geometry.residual_px, m), 0.0) for m in (used, far)]
    noise = (torch.maximum(*across) / MEDIAN_1D).clamp_min(MIN_NOISE_PX)
    variance_rel = (sigma * p) ** 2 + 0.04**2
    return _Parallax(uv_0, p, q, a, variance_rel=variance_rel, noise=noise, used=used)


def _thinned(near: _Parallax) -> _Parallax:
    """At most :data:`MAX_ATTACHED_RETURNS` of the used returns."""
    if near.used.shape[1] == 0:
        return near
    index, count = ransac.usable_first(near.used, min(MAX_ATTACHED_RETURNS, near.used.shape[1]))
    used = torch.arange(index.shape[1], device=index.device) < count[:, None]
    p, q, a, variance_rel = (x.gather(1, index) for x in (near.p, near.q, near.a, near.variance_rel))
    uv = near.uv.gather(1, index[..., None].expand(-1, -1, 2))
    return _Parallax(uv, p, q, a, variance_rel=variance_rel, noise=near.noise, used=used)


def _profile_cost(near: _Parallax, p: Tensor, used: Tensor, scale: Tensor | None) -> Tensor:
    """Mean robust cost (B, K) of the residuals (q − s p) a of inverse depths p (B, K, N); s = 1, or fitted.

    ``scale`` (B, K) is where the fit of s starts, ``used`` (B, K, N) which returns count.
    """
    return _mean_cost(near.q, near.a, near.variance_rel, near.noise, *(p, used, scale))


#: What the kernel reads: fields of :class:`_Parallax` (B, N) and (B, 1), then the arguments of :func:`_profile_cost`.
_COST_DTYPES = {
    name: torch.bool if name == "used" else torch.float32
    for name in ("q", "a", "variance_rel", "noise", "p", "used", "scale")
}


# The kernel takes 4 reweighted steps.
@operator(
    kernel=lambda *tensors: run_kernel(
        "profile_cost",
        (*tensors[:6], tensors[4].new_empty(0, tensors[4].shape[1]) if tensors[6] is None else tensors[6]),
        tensors[4].new_empty(tensors[4].shape[:2]),
        *(COST_BEND, 4),
    ),
    dtypes=_COST_DTYPES,
    any_layout=tuple(_COST_DTYPES),
)
def _mean_cost(*tensors: Any) -> Tensor:
    """:func:`_profile_cost` of tensors."""
    q, a, variance_rel, noise = (x[:, None] for x in tensors[:4])
    p, used, scale = tensors[4:]
    residuals = partial(_square, q, a, variance_rel, noise)
    square, variance = residuals(p if scale is None else scale[..., None] * p)
    if scale is not None:
        scale, a_squared = scale[..., None], a**2
        for _ in range(4):
            weight = a_squared / variance * (COST_BEND**2 / (COST_BEND**2 + square)) ** 2
            weight = torch.where(used, weight, 0.0) * p
            total = (weight * p).sum(-1, keepdim=True)
            fitted = (weight * q).sum(-1, keepdim=True) / torch.where(total > 0, total, 1.0)
            scale = torch.where(fitted > 0, fitted, scale)
            square, variance = residuals(scale * p)
    cost = torch.where(used, square / (COST_BEND**2 + square), 0.0)
    return cost.sum(-1) / used.sum(-1).clamp_min(1)


def _square(q: Tensor, a: Tensor, variance_rel: Tensor, noise: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Squared residual along the epipolar line in variances, and its variance px²: track and sensor."""
    variance = noise**2 + variance_rel * (p * a) ** 2
    return ((q - p) * a) ** 2 / variance, variance


def _unexplained_ratio(near: _Parallax) -> Tensor:
    """Cost of the returned depths over that of one depth for all (B,)."""
    p, used = near.p[:, None], near.used[:, None]
    own = _profile_cost(near, p, used, None)
    flat = _profile_cost(near, torch.ones_like(p), used, masked_median(near.q, near.used).clamp_min(1e-6))
    return (own / torch.where(flat > 0, flat, 1.0))[:, 0]


def _attachment_gain(near: _Parallax, samples: Samples) -> tuple[Tensor, Tensor]:
    """Cost of the depths at other pixels over that of the depths at the own ones (B, K), and the shared returns."""
    size = _sampled_size(samples)
    mean, filled = _cell_means(samples, size)
    change = constant(near.p, [(1.0, 1.0, 0.0, 0.0), *ATTACHMENTS])
    centre = size[:, None] / 2
    at = centre + (near.uv[:, None] - centre) * change[:, None, :2] + change[:, None, 2:] * size[:, None]
    cell, inside = _cells(at.flatten(1, 2), size)
    p, has = (x.gather(1, cell).view(at.shape[:-1]) for x in (mean, filled))
    has = has & inside.view(has.shape) & near.used[:, None]
    used = has[:, 1:] & has[:, :1]
    own, other = (torch.where(used, x, torch.ones_like(x)) for x in (p[:, :1].expand_as(used), p[:, 1:]))
    own_sum, other_sum = (torch.where(used, x, 0.0).sum(-1) for x in (own, other))
    own_cost = _profile_cost(near, own, used, torch.ones_like(own_sum))
    scale = torch.where(other_sum > 0, own_sum / torch.where(other_sum > 0, other_sum, 1.0), 1.0)
    cost = _profile_cost(near, other, used, scale)
    n = used.sum(-1)
    testable = (n >= 24) & (n >= 0.25 * near.used.sum(-1, keepdim=True))
    testable = testable & (own_cost > 0.05)
    return torch.where(testable, cost / torch.where(own_cost > 0, own_cost, 1.0), torch.inf), n


def _sampled_size(samples: Samples) -> Tensor:
    """Size (B, 1, 2) px of the picture that samples cover; the principal point of a crop is not its middle."""
    if samples.uv.shape[1] == 0:
        return samples.xyz.new_ones(len(samples.uv), 1, 2)
    first, last = samples.uv.aminmax(dim=1, keepdim=True)
    return (first + last + 1).to(samples.xyz.dtype)


def _cells(uv: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the cell of each pixel (B, M, 2), and whether the pixel is inside the picture."""
    place = uv / size
    inside = ((place >= 0) & (place < 1)).all(-1)
    across, down = DEPTH_CELLS
    column, row = (place[..., i].nan_to_num().clamp(0, 1) for i in (0, 1))
    cell = (column * across).long().clamp(0, across - 1) + across * (row * down).long().clamp(0, down - 1)
    return cell, inside


def _cell_means(samples: Samples, size: Tensor) -> tuple[Tensor, Tensor]:
    """Mean inverse depth of the returns in each cell (B, cells), and whether there is one."""
    z = samples.xyz[..., 2]
    usable = samples.usable & (z > 0)
    cell, inside = _cells(samples.uv.to(z.dtype), size)
    count = (usable & inside).to(z.dtype)
    inverse = count / torch.where(usable, z, torch.ones_like(z))
    empty = z.new_zeros(len(z), DEPTH_CELLS[0] * DEPTH_CELLS[1])
    total, n = empty.scatter_add(1, cell, inverse), empty.scatter_add(1, cell, count)
    return total / n.clamp_min(1), n > 0
