"""Stage 2, what the sensor says there: depth at the samples → metric points, confidence and flags.

Fail loud, fail localised: a sample without a usable return is NaN and flagged, never filled from its neighbours.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.codes import Flag, Hole
from dhtorch.geometry import camera as cam
from dhtorch.geometry.lookup import luma, patches, round_half_up
from dhtorch.geometry.shapes import check
from dhtorch.records import Frame, Samples

#: Side of the neighbourhood that appearance and depth edges are judged on, px.
NEIGHBOURHOOD = 5


def backproject(
    frame: Frame,
    uv: Tensor,  # (N, 2) or (B, N, 2) px
    *,
    near_limit: float = float("inf"),
    min_conf: int = 1,
    sigma_m: float = 0.0,
    sigma_rel: float = 0.01,
    search_px: int = 0,
    edge_rel: float = 0.1,
    dark: float = 0.05,
    saturated: float = 0.99,
    highlight: float = 0.85,
) -> Samples:
    """Read the depth at sample pixels and lift it to camera-frame points.

    The nearest depth pixel is read, so values are never mixed across an edge. For a sparse map (projected LiDAR),
    ``search_px`` lets a sample take the nearest return within that many depth pixels instead.

    Args:
        frame: B views; depth of any resolution, see ``Frame.depth_camera``.
        uv: sample pixels, shared by the batch or per view.
        near_limit: returns beyond it (m) stay in ``depth`` but get NaN in ``xyz`` and BEYOND_NEAR.
        min_conf: lowest accepted sensor confidence (0, 1, 2) where the frame has a confidence map.
        sigma_m, sigma_rel: sensor noise, sigma² = sigma_m² + (sigma_rel · z)².
        search_px: radius of the search for a return, depth pixels.
        edge_rel: max / min − 1 of the returns in the 5×5 neighbourhood above which DEPTH_EDGE is set.
        dark, saturated: mean grey of the neighbourhood below / above which UNDEREXPOSED / SATURATED is set.
        highlight: a colourless pixel above it that outshines its neighbourhood is SPECULAR.

    Returns:
        Samples with ``trackability`` 0 and ``hole`` NONE: the next stage fills them. ``confidence`` is the sensor's
        level scaled to [0, 1] (1 where it reports none), halved for each of DEPTH_EDGE, SPECULAR and SATURATED, and
        0 where there is no usable return.

    Flags: NO_DEPTH, LOW_CONF, SPECULAR, SATURATED, UNDEREXPOSED, DEPTH_EDGE, BEYOND_NEAR, BORDER. Non-finite and
    non-positive depth counts as no return.

    Raises:
        ValueError: wrong shapes.

    Gradient: ``xyz`` to depth, intrinsics and ``uv``; the choice of the depth pixel, flags and confidence carry none.
    Source: paper, "Spiral sampling and confidence-aware sparse 3D".
    """
    sizes = check(
        "backproject", image=(frame.image, "B C H W"), depth=(frame.depth, "B h w"), conf=(frame.conf, "B h w")
    )
    if uv.dim() == 2:
        uv = uv.expand(sizes["B"], *uv.shape)
    check("backproject", uv=(uv, "B N 2"), f=(frame.camera.f, "B 2"))
    depth, conf, edge = _read_depth(frame, uv, search_px, edge_rel)
    returned = depth > 0
    low_conf = returned & (conf < min_conf)
    beyond = returned & (depth > near_limit)
    appearance = _appearance(frame.image, uv, dark, saturated, highlight)
    flag = (
        _bit(~returned, Flag.NO_DEPTH)
        | _bit(low_conf, Flag.LOW_CONF)
        | _bit(beyond, Flag.BEYOND_NEAR)
        | _bit(edge, Flag.DEPTH_EDGE)
        | appearance
    )
    usable = (flag & Flag.UNUSABLE) == 0
    safe = torch.where(usable, depth, torch.ones_like(depth))
    xyz = cam.unproject(frame.camera, uv, safe)
    usable = usable & xyz.isfinite().all(-1)  # a pixel outside the lens model has no ray
    halvings = edge.int() + _has(appearance, Flag.SPECULAR).int() + _has(appearance, Flag.SATURATED).int()
    confidence = conf.to(depth.dtype).clamp(0, 2) / 2 * 0.5**halvings
    return Samples(
        uv=uv,
        depth=depth,
        sigma=(sigma_m**2 + (sigma_rel * depth) ** 2).sqrt() if sigma_m > 0 else sigma_rel * depth,
        xyz=torch.where(usable[..., None], xyz, torch.full_like(xyz, torch.nan)),
        confidence=torch.where(usable, confidence, torch.zeros_like(confidence)),
        flag=flag,
        trackability=torch.zeros_like(depth),
        hole=torch.full_like(flag, Hole.NONE),
    )


def _read_depth(frame: Frame, uv: Tensor, search_px: int, edge_rel: float) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (B, N), 0 = none; sensor confidence level (B, N); whether returns around it differ (B, N)."""
    h, w = frame.depth.shape[-2:]
    size = min(max(NEIGHBOURHOOD, 2 * search_px + 1), h, w)
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, (h, w), uv)
    centre = round_half_up(place.nan_to_num(-1e6)).clamp(-1e6, 1e6).long()
    inside = ((centre >= 0) & (centre < torch.tensor([w, h], device=uv.device))).all(-1)
    corner = centre - size // 2
    window = patches(frame.depth[:, None], corner, size)[:, :, 0].flatten(-2)  # (B, N, size²)
    window = torch.where(window.isfinite() & (window > 0), window, torch.zeros_like(window))
    # Patches are shifted inside at the border: find each pixel's offset from the wanted one by its true coordinates.
    first = torch.stack((corner[..., 0].clamp(0, w - size), corner[..., 1].clamp(0, h - size)), -1)
    steps = torch.arange(size, device=uv.device)
    du = (first[..., 0, None] + steps - centre[..., 0, None])[..., None, :]
    dv = (first[..., 1, None] + steps - centre[..., 1, None])[..., :, None]
    reach = torch.maximum(du.abs(), dv.abs()).flatten(-2)
    distance = (du * du + dv * dv).flatten(-2)
    reachable = (reach <= search_px) & (window > 0)
    pick = torch.where(reachable, distance, distance.new_full((), 1 << 30)).argmin(-1, keepdim=True)
    found = reachable.gather(-1, pick)[..., 0] & inside
    value = torch.where(found, window.gather(-1, pick)[..., 0], torch.zeros_like(window[..., 0]))
    high = window.amax(-1)
    low = torch.where(window > 0, window, torch.full_like(window, torch.inf)).amin(-1)
    edge = found & (high > low * (1 + edge_rel))
    if frame.conf is None:
        level = torch.full_like(value, 2).to(torch.uint8)
    else:
        level = patches(frame.conf[:, None], corner, size)[:, :, 0].flatten(-2).gather(-1, pick)[..., 0]
    return value, level, edge.detach()


def _appearance(image: Tensor, uv: Tensor, dark: float, saturated: float, highlight: float) -> Tensor:
    """Flag bits (B, N) that the picture alone decides."""
    H, W = image.shape[-2:]
    size = min(NEIGHBOURHOOD, H, W)
    half = size // 2
    corner = round_half_up(uv.nan_to_num(-1e6)).clamp(-1e6, 1e6).long() - half
    pixels = patches(image.detach(), corner, size)
    grey = luma(pixels, 2)[:, :, 0]
    mean = grey.mean((-1, -2))
    centre = grey[..., half, half]
    colour = pixels[..., half, half].to(grey.dtype)
    top = colour.amax(-1)
    colourless = top - colour.amin(-1) <= 0.15 * top
    shine = colourless & (centre >= highlight) & (centre - mean >= 0.1)
    limit = torch.tensor([W - size, H - size], device=uv.device)
    border = ((corner < 0) | (corner > limit)).any(-1)
    return (
        _bit(mean <= dark, Flag.UNDEREXPOSED)
        | _bit(mean >= saturated, Flag.SATURATED)
        | _bit(shine, Flag.SPECULAR)
        | _bit(border, Flag.BORDER)
    )


def _bit(mask: Tensor, bit: int) -> Tensor:
    return mask.to(torch.int32) * bit


def _has(flag: Tensor, bit: int) -> Tensor:
    return (flag & bit) != 0
