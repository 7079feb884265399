"""Stage 2 on kornia: depth maps and sample pixels → metric points, sigma, confidence and flags."""

import kornia.geometry as kg
import torch
from torch import Tensor

from dhtorch.codes import Flag
from dhtorch.geometry.camera import depth_pixels, undistort
from dhtorch.geometry.checks import constant
from dhtorch.geometry.filters import grayscale
from dhtorch.records import Frame, Samples

#: Radii, px, that limit a sample's surroundings and, in a sparse depth map, the search for a return. Source: ``PAPER``.
RADIUS_PX, SPARSE_RADIUS_PX = 2, 3


def backproject_kornia(
    frame: Frame,
    uv: Tensor,  # (N, 2) or (B, N, 2) px
    *,
    near_limit: float | None = None,
    min_conf: int = 1,
    sigma_m: float = 0.0,
    sigma_rel: float = 0.01,
    edge_rel: float = 0.1,
    dark: float = 0.05,
    saturated: float = 0.99,
    highlight: float = 0.85,
) -> Samples:
    """Samples of a frame at pixels uv: depth, sigma, points X = z K⁻¹ (u, v, 1), confidence and flags.

    Depth is read from the nearest pixel of its map, in a sparse map from the nearest return. Options, flags, missing
    values: :func:`dhtorch.stages.backproject.backproject`.

    Gradient: ``xyz``, ``depth`` and ``sigma`` to the depth map, ``xyz`` also to intrinsics and ``uv``.
    Source: paper, "Spiral sampling and confidence-aware sparse 3D".
    """
    uv = uv.expand(len(frame.image), *uv.shape[-2:])
    depth, level, is_edge = _read_returns(frame, uv, edge_rel)
    camera = frame.camera.to_kornia(frame.hw)
    xyz = kg.camera.unproject_points(undistort(frame.camera, uv), depth[..., None], camera.camera_matrix)
    colours, pixel = _read_windows(frame.image.detach(), uv, RADIUS_PX)
    grey, centre = grayscale(colours)[:, 0], colours.shape[-1] // 2
    colour, grey_centre, mean = colours[..., centre], grey[..., centre], grey.mean(-1)
    last = constant(pixel, [frame.hw[1] - 1, frame.hw[0] - 1])
    is_colourless = colour.amax(1) - colour.amin(1) <= 0.15 * colour.amax(1)  # as in PAPER, and 0.1 below
    flags = {
        Flag.NO_DEPTH: depth <= 0,
        Flag.LOW_CONF: (depth > 0) & (level < min_conf),
        Flag.BEYOND_NEAR: depth > (torch.inf if near_limit is None else near_limit),
        Flag.DEPTH_EDGE: is_edge,
        Flag.BORDER: ((pixel < 0) | (pixel > last)).flatten(2).any(-1),
        Flag.UNDEREXPOSED: mean <= dark,
        Flag.SATURATED: mean >= saturated,
        Flag.SPECULAR: is_colourless & (grey_centre >= highlight) & (grey_centre - mean >= 0.1),
    }
    flag = torch.stack([torch.where(mask, bit, 0) for bit, mask in flags.items()]).sum(0).int()
    doubts = [torch.where(flags[bit], 0.5, 1.0) for bit in (Flag.DEPTH_EDGE, Flag.SPECULAR, Flag.SATURATED)]
    confidence = (level / 2).clamp(0, 1) * torch.stack(doubts).prod(0)
    usable = ((flag & Flag.UNUSABLE) == 0) & xyz.isfinite().all(-1)
    return Samples(
        uv=uv,
        depth=depth,
        sigma=(sigma_m**2 + (sigma_rel * depth) ** 2).sqrt() if sigma_m > 0 else sigma_rel * depth,
        xyz=torch.where(usable[..., None], xyz, torch.nan),
        confidence=torch.where(usable, confidence, 0.0),
        flag=flag,
        trackability=torch.zeros_like(depth),
        hole=torch.zeros_like(flag),
    )


def _read_returns(frame: Frame, uv: Tensor, edge_rel: float) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (B, N), 0 = none, confidence level (B, N), and whether the returns around differ (B, N)."""
    hw, radius = frame.depth.shape[-2:], RADIUS_PX if frame.sparse is None else SPARSE_RADIUS_PX
    place = depth_pixels(frame.camera, frame.hw, frame.depth_camera, (hw[0], hw[1]), uv)
    depth = frame.depth.nan_to_num(0, 0, 0).relu().to(uv.dtype)
    maps = torch.stack((depth, torch.full_like(depth, 2) if frame.conf is None else frame.conf.to(depth)), 1)
    windows, pixel = _read_windows(maps, place, radius)
    around, centre = windows[:, 0].detach(), pixel.shape[2] // 2
    index = torch.full_like(around[..., 0], centre, dtype=torch.int64)
    if frame.sparse is not None:
        offset, sparse = pixel - pixel[:, :, [centre]], frame.sparse[:, None, None]
        around = torch.where(sparse | (offset.abs().amax(-1) <= RADIUS_PX), around, 0.0)
        distance = torch.where(around > 0, offset.square().sum(-1), torch.inf)
        index = torch.where(sparse[..., 0] & (around > 0).any(-1), distance.argmin(-1), index)
    value, level = windows.gather(3, index[:, None, :, None].expand(-1, 2, -1, 1))[..., 0].unbind(1)
    limit = (1 + edge_rel) * torch.where(around > 0, around, torch.inf).amin(-1)
    return value, level.detach(), (value > 0) & (around.amax(-1) > limit)


def _read_windows(maps: Tensor, uv: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Values (B, C, N, P) of maps (B, C, H, W) in the P pixels around places (B, N, 2), 0 outside; and those pixels."""
    side = torch.arange(-radius, radius + 1, device=uv.device)
    pixel = (uv.detach().nan_to_num(-100.0) + 0.5).floor()[:, :, None] + torch.cartesian_prod(side, side).flip(-1)
    values = kg.transform.remap(maps.to(uv.dtype), pixel[..., 0], pixel[..., 1], mode="nearest", align_corners=True)
    return values.to(maps.dtype), pixel
