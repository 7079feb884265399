"""Beside stage 4: samples and relative poses → where each sample lies in the source views, searched where poses say.

Alphabet: q inverse depth (1/m); K hypotheses of q for each sample; ``ncc`` the correlation of two windows without
their means, in [-1, 1]; a window is warped by the affine motion that turn, zoom and the hypothesis predict.

A sample with a return is predicted by the pose alone. One without lies on a short segment of its epipolar line, from
infinity to the near limit. The segment is searched on a small image, and the best hypothesis is searched again more
finely on larger images. A match is *unique* if every other place of the segment fits clearly worse.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.checks import constant, shaped
from dhtorch.geometry.coarse_flow import DownscaledImage, downscale
from dhtorch.geometry.determinism import chunk_size
from dhtorch.geometry.lucas_kanade import masked_apply
from dhtorch.geometry.se3 import Pose
from dhtorch.pytree import Record, record
from dhtorch.records import Camera, Samples

#: Widths of the windows on these images, in samples, odd. Source: chosen on the built-in rooms.
SEARCH_WINDOWS = (7, 9, 11)

#: Half the distance over which the affine motion of a window is measured, px. Source: derived, half of a window.
AFFINE_HALF_WIDTH_PX = 8.0

#: Limits the depth of a hypothesis in the source view, as a fraction of that in the reference view.
#: Source: derived, closer to the source view than a tenth: windows are magnified tenfold.
MIN_DEPTH_IN_SOURCE = 0.1


@record
class GuidedMatches(Record):
    """Places of samples in the source views under relative poses."""

    uv_1: Tensor  # (V, B, N, 2) px; not finite where nothing is predicted
    cov: Tensor  # (V, B, N, 2, 2) px²
    ncc: Tensor  # (V, B, N) correlation of the windows there; 0 where not searched
    rms: Tensor  # (V, B, N) grey difference of the windows, gain and bias taken out
    unique: Tensor  # (B, N) bool: fits well, and all other places of the segment fit clearly worse


class _Segment(NamedTuple):
    """Epipolar segments of M points in one view: the point of inverse depth q is centre + q t there, up to scale."""

    centre: Tensor  # (3, M) R r
    right: Tensor  # (3, M) R r of the pixel AFFINE_HALF_WIDTH_PX to the right
    below: Tensor  # (3, M)
    t: Tensor  # (3, M) m
    f: Tensor  # (2, M) px of the source view
    c: Tensor  # (2, M)
    distortion: Tensor  # (k, M), k = 0 without a lens
    posed: Tensor  # (M,) bool, the view has a pose


class _Points(NamedTuple):
    """M samples to be searched."""

    uv_0: Tensor  # (2, M) px
    q_max: Tensor  # (M,) 1/m, end of the segment
    batch: Tensor  # (M,)
    segments: tuple[_Segment, ...]  # one per view


@shaped("image_0: B C H W, samples.xyz: B N 3, wanted: B N, images_1: V B C h w, T_1_from_0.t: V B 3")
def guided_search(
    samples: Samples,
    image_0: Tensor,  # (B, C, H, W)
    images_1: Tensor,  # (V, B, C, H', W')
    camera_0: Camera,
    cameras_1: Camera,  # (V, B)
    T_1_from_0: Pose,  # (V, B)
    *,
    wanted: Tensor | None = None,  # (B, N) bool
    hypotheses: int = 40,
    near_quantile: float = 0.1,
    min_ncc: float = 0.7,
    max_cost_ratio: float = 0.7,
    exclusion: int = 3,
) -> GuidedMatches:
    """Samples and relative poses → places in the source views: predicted with a return, searched for without.

    A hypothesis is scored by the mean correlation of the better half of the views: others may be occluded. The place
    in each view is that of the joint optimum.

    Args:
        samples: of view 0, classified.
        T_1_from_0: poses of the views; one that is not finite predicts nothing, and its view is not searched.
        wanted: samples without a return that are searched; None = all. The others cost nothing and are not finite.
        hypotheses: inverse depths on the coarse image, evenly spaced from 0.
        near_quantile: of the depths of the returns; the segment ends there.
        min_ncc: least correlation of a match: of a unique one jointly, and in each view of its own.
        max_cost_ratio: largest cost (1 - ncc) of a unique match over the least cost elsewhere on the segment.
        exclusion: hypotheses closer than this to the best one are not *elsewhere*.

    Returns:
        :class:`GuidedMatches`; ``uv_1`` is not finite in views that do not show the sample.

    Raises:
        ValueError: wrong shapes, or fewer than three hypotheses.

    Gradient: none; a choice. The tracker refines from it.
    Cost: wanted samples x views x (hypotheses x 49 + 1,400) values of grey.
    """
    if hypotheses < 3:
        raise ValueError(f"guided_search: hypotheses is {hypotheses}, expected at least 3")
    with torch.no_grad():
        dtype = torch.promote_types(samples.uv.dtype, torch.float32)
        T = T_1_from_0.detach().map(lambda x: x.to(dtype))
        posed = T.R.isfinite().flatten(2).all(2) & T.t.isfinite().all(2)  # (V, B)
        T = Pose(
            torch.where(posed[..., None, None], T.R, torch.eye(3, dtype=T.R.dtype, device=T.R.device)),
            torch.where(posed[..., None], T.t, 0.0),
        )
        searched = ~samples.usable & posed.any(0)[:, None]
        searched = searched if wanted is None else searched & wanted
        points = _points(samples, camera_0, cameras_1, T, posed, near_quantile)
        # Longest sides, px, from coarse to fine; chosen on the built-in rooms.
        levels = [
            (downscale(image_0.detach(), side), [downscale(image.detach(), side) for image in images_1])
            for side in (160, 320, 640)
        ]
        V = len(images_1)
        empty = points.uv_0.new_zeros(1, searched.numel())
        limits = hypotheses, min_ncc, max_cost_ratio, exclusion

        def search(uv_0: Tensor, q_max: Tensor, batch: Tensor, *segments: _Segment) -> tuple[Tensor, ...]:
            # The windows of 96 points in one view take about a megabyte and fit the cache.
            leaves, spec = pytree.tree_flatten(_Points(uv_0, q_max, batch, segments))
            parts = zip(*(x.split(chunk_size(96, uv_0), -1) for x in leaves), strict=True)
            chunks = [_search(levels, pytree.tree_unflatten(part, spec), *limits) for part in parts]
            return tuple(torch.cat(field, -1) for field in zip(*chunks, strict=True))

        fields = masked_apply(
            searched.flatten(),
            search,
            (empty.expand(V, -1),) * 4 + (empty,),
            (points.uv_0, points.q_max, points.batch, *points.segments),
        )
        q, variance, ncc, rms, unique = (x.unflatten(-1, tuple(searched.shape)) for x in fields)
        unique = searched & (unique[0] > 0)
        views = [
            _places(samples, points.segments[v], q[v], searched & posed[v][:, None], cameras_1[v], T[v])
            for v in range(V)
        ]
        cov = variance[..., None, None] * torch.eye(2, dtype=variance.dtype, device=variance.device)
        uv_1, cov, ncc, rms = (x.to(samples.uv.dtype) for x in (torch.stack(views), cov, ncc, rms))
        return GuidedMatches(uv_1, cov, ncc, rms, unique)


def _places(samples: Samples, s: _Segment, q: Tensor, searched: Tensor, camera_1: Camera, T: Pose) -> Tensor:
    """Pixels (B, N, 2) of the returns and of the inverse depths q (B, N) that were found; else not finite."""
    near = samples.usable & s.posed.view(q.shape)
    xyz = torch.where(near[..., None], samples.xyz.detach().to(T.t.dtype), 1.0)
    there = se3.apply(T, xyz)
    matched = (s.centre + q.flatten() * s.t).T.unflatten(0, tuple(q.shape))
    ahead = torch.where(near, there[..., 2] / xyz[..., 2], matched[..., 2]) > MIN_DEPTH_IN_SOURCE
    place = cam.project(camera_1, torch.where(near[..., None], there, matched))
    return torch.where(((near | searched) & ahead)[..., None], place, torch.nan)


def _points(
    samples: Samples, camera_0: Camera, cameras_1: Camera, T: Pose, posed: Tensor, near_quantile: float
) -> _Points:
    """All samples and their segments in all views, B · N points in a row."""
    B, N = samples.xyz.shape[:2]
    uv_0 = samples.uv.detach().to(T.t.dtype).expand(B, N, 2)
    shifts = (0.0, 0.0), (AFFINE_HALF_WIDTH_PX, 0.0), (0.0, AFFINE_HALF_WIDTH_PX)
    rays = [cam.rays(camera_0, uv_0 + constant(uv_0, shift)).nan_to_num(0.0, 0.0, 0.0) for shift in shifts]
    returned = samples.usable & (samples.trackability > 0)  # those without texture may be mere filling of a batch
    depth = torch.where(returned, samples.depth.detach(), torch.inf).to(T.t.dtype).sort(-1).values
    rank = (near_quantile * returned.sum(-1)).long().clamp(max=N - 1)
    nearest = depth.gather(-1, rank[:, None])[:, 0]
    q_max = torch.where(nearest.isfinite() & (nearest > 0), 1 / nearest, 0.0)

    def point(x: Tensor) -> Tensor:
        return x.to(T.t.dtype).repeat_interleave(N, 0).T

    def turned(ray: Tensor, v: int) -> Tensor:
        return se3.rotate(T.R[v], ray).reshape(B * N, 3).T

    segments = [
        _Segment(
            centre=turned(rays[0], v),
            right=turned(rays[1], v),
            below=turned(rays[2], v),
            t=point(T.t[v]),
            f=point(cameras_1.f[v].detach()),
            c=point(cameras_1.c[v].detach()),
            distortion=point(
                uv_0.new_zeros(B, 0) if cameras_1.distortion is None else cameras_1.distortion[v].detach()
            ),
            posed=posed[v].repeat_interleave(N),
        )
        for v in range(len(posed))
    ]
    batch = torch.arange(B, device=uv_0.device).repeat_interleave(N)
    return _Points(uv_0.reshape(B * N, 2).T, q_max.repeat_interleave(N), batch, tuple(segments))


def _search(
    levels: list[tuple[DownscaledImage, list[DownscaledImage]]],
    points: _Points,
    K: int,
    min_ncc: float,
    max_cost_ratio: float,
    exclusion: int,
) -> tuple[Tensor, ...]:
    """Points → (V, M) inverse depth, variance (px²), ncc and rms of the match in each view; (1, M) unique (0 or 1)."""
    q = points.q_max[:, None] * torch.linspace(0, 1, K, device=points.q_max.device, dtype=points.q_max.dtype)
    step = points.q_max / (K - 1)
    unique = torch.ones_like(step, dtype=torch.bool)
    n_posed = torch.stack([s.posed for s in points.segments]).sum(0)
    better_half = (n_posed // 2)[None, :, None]  # the last index of the better half of the views
    for level, (small_0, smalls_1) in enumerate(levels):
        # Windows (M, P) of the samples without their means.
        u, v = _window_offsets(level, points.uv_0)
        x, y = (((points.uv_0[i] - small_0.first) / small_0.scale)[:, None] + d for i, d in ((0, u), (1, v)))
        template = _read_bilinear(small_0.grey, points.batch, x, y)
        template = template - template.mean(-1, keepdim=True)
        windows = points.batch, small_0, template, level
        views = [_correlate(windows, s, q, small_1) for s, small_1 in zip(points.segments, smalls_1, strict=True)]
        ncc = torch.stack([view[0] for view in views])  # (V, M, K)
        ordered = ncc.clamp_min(0).sort(0, descending=True).values.cumsum(0)
        last = better_half.clamp(max=len(ncc) - 1).expand(1, *ncc.shape[1:])
        joint = ordered.gather(0, last)[0] / (last[0] + 1)
        score, k = joint.max(-1)
        if level == 0:
            place = torch.arange(K, device=k.device)
            # Between hypotheses a repeated texture fits equally well at its periods: local maxima are raised to the
            # vertex of the parabola through their neighbours.
            left, middle, right = joint[:, :-2], joint[:, 1:-1], joint[:, 2:]
            bend = (2 * middle - left - right).clamp_min(1e-6)
            vertex = middle + (right - left).square() / (8 * bend)
            is_peak = (middle >= left) & (middle >= right)
            peak = torch.cat((joint[:, :1], torch.where(is_peak, vertex, middle).clamp(max=1), joint[:, -1:]), 1)
            elsewhere = torch.where((place - k[:, None]).abs() >= exclusion, peak, -1.0).amax(-1)
            best = peak.gather(1, k[:, None])[:, 0]
            # On the built-in rooms interpolation alone costs some hundredths: below .05 costs do not differ.
            unique = (1 - best + 0.05) < max_cost_ratio * (1 - elsewhere + 0.05)
        if level == 1:
            unique = unique & (score >= min_ncc)
        if level == len(levels) - 1:
            break
        centre = q.gather(1, k[:, None])[:, 0] + _vertex(joint, k)[0] * step
        step = step / 3
        # 7 hypotheses at a third of the distance on the image before: one of those distances to both sides.
        reach = torch.arange(7, device=q.device, dtype=q.dtype) - 3
        q = (centre[:, None] + reach * step[:, None]).clamp_min(0)
    fields = _matches_of_views(views, q, joint, step, template.square().mean(-1).sqrt())
    return (*fields, unique[None].to(step))


def _matches_of_views(
    views: list[tuple[Tensor, Tensor]], q: Tensor, joint: Tensor, step: Tensor, spread: Tensor
) -> tuple[Tensor, ...]:
    """Inverse depth, variance, ncc and rms (V, M) at the joint optimum on the finest image, in every view.

    The variance is that of the joint optimum: views share the reference view's window, so it does not shrink with
    their number.
    """
    # Interpolation and blur join 3 x 3 samples.
    n = SEARCH_WINDOWS[-1] ** 2 / 9
    score, k = joint.max(-1)
    offset, bend, inner = _vertex(joint, k)
    q_joint = q.gather(1, k[:, None])[:, 0] + offset * step
    variance_in_steps = (1 - score.clamp(0, 1).square()) / (bend * n)
    fields = []
    for ncc, place in views:
        own = ncc.gather(1, k[:, None])[:, 0]
        ends = (place.gather(2, (inner + d).expand(2, *inner.shape))[..., 0] for d in (0, 1))
        pace = torch.sub(*ends).square().sum(0)
        rms = (1 - own.clamp(0, 1).square()).sqrt() * spread
        # From a tenth of a pixel to the distance of the coarse hypotheses.
        variance = (variance_in_steps * pace).clamp(0.01, 25.0)
        fields.append((q_joint, variance, own, rms))
    return tuple(torch.stack(x) for x in zip(*fields, strict=True))


def _vertex(score: Tensor, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Maximum k (M,) of scores (M, K) → offset (M,) of the parabola's vertex, its bend, and k kept from the ends."""
    inner = k.clamp(1, score.shape[1] - 2)[:, None]
    left, middle, right = (score.gather(1, inner + d)[:, 0] for d in (-1, 0, 1))
    bend = (2 * middle - left - right).clamp_min(1e-6)
    return torch.where(k == inner[:, 0], (0.5 * (right - left) / bend).clamp(-0.5, 0.5), 0.0), bend, inner


def _pixels(s: _Segment, ray: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (2, M, K) and relative depth (M, K) of points with inverse depth q (M, K) on rays (3, M)."""
    x, y, z = ray[..., None] + q * s.t[..., None]
    camera = Camera(s.f.T, s.c.T, s.distortion.T if len(s.distortion) else None)
    ahead = z.clamp_min(MIN_DEPTH_IN_SOURCE)
    return cam.project(camera, torch.stack((x, y, ahead), -1)).movedim(-1, 0), z


def _window_offsets(level: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets u, v (P,) of a window's samples, small pixels."""
    width = SEARCH_WINDOWS[level]
    # Samples 1, 1 and 2 px apart: windows of 21 to 28 px of 640.
    axis = (torch.arange(width, device=like.device, dtype=like.dtype) - width // 2) * (1.0, 1.0, 2.0)[level]
    return axis.repeat(width), axis.repeat_interleave(width)


def _correlate(
    windows: tuple[Tensor, DownscaledImage, Tensor, int],
    s: _Segment,
    q: Tensor,  # (M, K)
    small_1: DownscaledImage,
) -> tuple[Tensor, Tensor]:
    """Correlation (M, K) of the windows at inverse depths q, -1 outside the picture, and their pixels (2, M, K)."""
    batch, small_0, template, level = windows  # (M,), and windows (M, P) of the reference view without their means
    place, depth = _pixels(s, s.centre, q)
    turn = small_0.scale / small_1.scale / AFFINE_HALF_WIDTH_PX
    du, dv = ((_pixels(s, ray, q)[0] - place) * turn for ray in (s.right, s.below))
    u, v = _window_offsets(level, q)
    centre = (place - small_1.first) / small_1.scale
    x, y = (centre[i][..., None] + du[i][..., None] * u + dv[i][..., None] * v for i in (0, 1))
    window = _read_bilinear(small_1.grey, batch, x.flatten(1), y.flatten(1)).unflatten(1, (q.shape[1], -1))
    window = window - window.mean(-1, keepdim=True)
    # Noise of one step of 8 bits regularises flat windows.
    noise = len(u) * (1 / 255) ** 2 / small_0.scale
    product = (window * template[:, None]).sum(-1)  # not a matrix product, whose sums depend on the batch
    energy = (template.square().sum(-1)[:, None] + noise) * (window.square().sum(-1) + noise)
    H, W = small_1.grey.shape[-2:]
    inside = (centre >= 0).all(0) & (centre[0] <= W - 1) & (centre[1] <= H - 1)
    seen = inside & (depth > MIN_DEPTH_IN_SOURCE) & s.posed[:, None]
    return torch.where(seen, product / energy.sqrt(), -1.0), place


def _read_bilinear(image: Tensor, batch: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Bilinear values (M, P) of images (B, 1, h, w) at small pixels x, y (M, P); the border is repeated outside."""
    h, w = image.shape[-2:]
    x, y = x.clamp(0, w - 1), y.clamp(0, h - 1)
    x0, y0 = x.floor().clamp(max=w - 2), y.floor().clamp(max=h - 2)
    fx, fy = x - x0, y - y0
    index = (batch[:, None] * (h * w) + y0.long() * w + x0.long()).flatten()
    flat = image.reshape(-1).to(x.dtype)
    a, b, c, d = (flat.index_select(0, index + k).view(x.shape) for k in (0, 1, w, w + 1))
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    return top + fy * (bottom - top)
