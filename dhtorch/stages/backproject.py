"""Stage 2: depth maps and sample pixels → metric points, sigma, confidence and flags.

A sample without a usable return is NaN and flagged, never filled from its neighbours.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Flag, Hole
from dhtorch.geometry import camera as cam
from dhtorch.geometry.checks import all_finite, check, constant, shaped
from dhtorch.geometry.patches import (
    containing_pixels,
    extract_patches,
    fits_window_kernel,
    flatten_images,
    gather_reduced,
    is_patch_inside,
    luma,
    nearest_pixel_index,
    reduce_patches,
    run_window_kernel,
    whole_is_faster,
)
from dhtorch.geometry.sensor_noise import get_sensor_noise
from dhtorch.geometry.windows import row_bands, window_extreme, window_sum
from dhtorch.ops.dispatch import operator
from dhtorch.records import Camera, Frame, Samples

#: Side of the neighbourhood for appearance flags and depth edges, px.
NEIGHBOURHOOD_PX = 5

#: Limits the colour of a highlight: difference of its channels as a fraction of the largest, without unit.
MAX_HIGHLIGHT_COLOUR_REL = 0.15

#: Least excess of a highlight over the mean of its neighbourhood, as a fraction of the range of grey values.
MIN_HIGHLIGHT_CONTRAST = 0.1


@shaped("frame.image: B C H W, frame.depth: B h w, frame.conf: B h w")
def backproject(
    frame: Frame,
    uv: Tensor,  # (N, 2) or (B, N, 2) px
    *,
    near_limit: float | None = None,
    min_conf: int = 1,
    sigma_m: float = 0.0,
    sigma_rel: float = 0.01,
    search_px: int | None = None,
    edge_rel: float = 0.1,
    dark: float = 0.05,
    saturated: float = 0.99,
    highlight: float = 0.85,
    sensor: str | Sequence[float] | None = None,
) -> Samples:
    """Samples of a frame at pixels uv: depth, sigma, camera-frame points, confidence and flags.

    The nearest depth pixel is read, so values are never mixed across an edge. In a sparse map (projected LiDAR) a
    sample takes the nearest return within ``search_px`` depth pixels instead.

    Args:
        frame: B views; depth of any resolution, see ``Frame.depth_camera``.
        uv: sample pixels, shared by the batch or per view.
        near_limit: m, None = none; returns beyond it stay in ``depth`` but get NaN in ``xyz`` and BEYOND_NEAR.
        min_conf: lowest accepted sensor confidence (0, 1, 2) where the frame has a confidence map.
        sigma_m, sigma_rel: sensor noise, sigma² = sigma_m² + (sigma_rel · z)².
        search_px: radius of the search for a return, depth pixels; None = 3 in frames that are
            ``sparse``, else 0.
        edge_rel: max / min − 1 of the returns in the 5×5 neighbourhood (or as far as is searched, where that is
            farther) above which DEPTH_EDGE is set.
        dark, saturated: mean grey of the neighbourhood below / above which UNDEREXPOSED / SATURATED is set.
        highlight: a colourless pixel above it that is brighter than its neighbourhood is SPECULAR.
        sensor: class of the sensor, whose noise by range replaces ``sigma_m`` and ``sigma_rel``, or three numbers
            (:data:`dhtorch.geometry.sensor_noise.SENSORS`); None = not stated.

    Returns:
        Samples with ``trackability`` 0 and ``hole`` NONE: the next stage fills them. ``confidence`` is the sensor's
        level scaled to [0, 1] (1 without a confidence map), halved for each of DEPTH_EDGE, SPECULAR and SATURATED, and
        0 where there is no usable return.

    Flags: NO_DEPTH, LOW_CONF, SPECULAR, SATURATED, UNDEREXPOSED, DEPTH_EDGE, BEYOND_NEAR, BORDER. Non-finite and
    non-positive depth counts as no return.

    Raises:
        ValueError: wrong shapes.

    Gradient: ``xyz`` to depth, intrinsics and ``uv``; the choice of the depth pixel, flags and confidence carry none.
    Source: paper, "Spiral sampling and confidence-aware sparse 3D".
    """
    if uv.dim() == 2:
        uv = uv.expand(len(frame.image), *uv.shape)
    check("backproject", uv=(uv, "B N 2"), f=(frame.camera.f, "B 2"))
    limits = _ReturnLimits(
        near_limit=near_limit,
        min_conf=min_conf,
        sigma_m=sigma_m,
        sigma_rel=sigma_rel,
        edge_rel=edge_rel,
        dark=dark,
        saturated=saturated,
        highlight=highlight,
    )
    camera, own = frame.camera, frame.depth_camera
    samples = _read_samples(
        frame.image,
        frame.depth,
        frame.conf,
        uv,
        *_intrinsics(camera),
        *((None, None, None) if own is None else _intrinsics(own)),
        frame=frame,
        search_px=search_px,
        limits=limits,
    )
    return samples if sensor is None else samples.replace(sigma=get_sensor_noise(sensor)(samples.depth))


class _ReturnLimits(NamedTuple):
    """Thresholds of returns and flags: options of :func:`backproject`."""

    near_limit: float | None
    min_conf: int
    sigma_m: float
    sigma_rel: float
    edge_rel: float
    dark: float
    saturated: float
    highlight: float


def _intrinsics(camera: Camera) -> tuple[Tensor, Tensor, Tensor | None]:
    return camera.f, camera.c, camera.distortion


def _read_samples_kernel(
    image: Tensor, depth: Tensor, conf: Tensor | None, uv: Tensor, *_: Tensor | None, **options: Any
) -> Samples:
    frame, limits = options["frame"], options["limits"]
    pixel, at, ray = _project_samples(frame, uv)
    picture, steps = flatten_images(image)
    outputs = z, sigma, confidence = tuple(ray.new_empty(ray.shape[:2]) for _ in range(3))
    xyz = torch.empty_like(ray)
    flag = torch.empty_like(z, dtype=torch.int32)
    hw, map_hw, n = frame.hw, (depth.shape[-2], depth.shape[-1]), uv.shape[1]
    size, reach = min(NEIGHBOURHOOD_PX, *hw), min(NEIGHBOURHOOD_PX, *map_hw)
    levels = depth.new_empty(0, dtype=torch.uint8) if conf is None else conf
    returns, windows = (depth, levels, at), (picture, pixel)
    limits = limits._replace(near_limit=torch.inf if limits.near_limit is None else limits.near_limit)
    torch.ops.dhtorch.backproject.default(
        *returns,
        *windows,
        ray,
        *outputs,
        *(xyz, flag),
        reach,
        *(*steps, *image.shape[1:], size),
        *limits,
        max_colour_rel=MAX_HIGHLIGHT_COLOUR_REL,
        min_contrast=MIN_HIGHLIGHT_CONTRAST,
        whole_map=whole_is_faster(map_hw, n, reach),
        whole_picture=whole_is_faster(hw, n, size),
    )
    unfilled = {"trackability": torch.zeros_like(z), "hole": torch.zeros_like(flag)}
    return Samples(uv=uv, depth=z, sigma=sigma, xyz=xyz, confidence=confidence, flag=flag, **unfilled)


def _project_samples(frame: Frame, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels of image and depth map (B, N, 2) int32 and rays (B, N, 3) of samples (B, N, 2), for the kernel."""
    camera, own = frame.camera, frame.depth_camera
    (h, w), (H, W) = frame.depth.shape[-2:], frame.hw
    if camera.distortion is None and (own is None or own.distortion is None):
        own_lens = [camera.f.new_empty(0)] * 2 if own is None else [own.f, own.c]
        start, *lens = (x.contiguous() for x in (uv, camera.f, camera.c, *own_lens))
        pixel, at = (torch.empty_like(start, dtype=torch.int32) for _ in range(2))
        ray = start.new_empty(*uv.shape[:2], 3)
        torch.ops.dhtorch.project_samples.default(start, *lens, pixel, at, ray, w / W, h / H)
        return pixel, at, ray
    place = cam.depth_pixels(camera, frame.hw, own, (h, w), uv)
    ray = cam.rays(camera, uv.nan_to_num(0.0, 0.0, 0.0)).contiguous()
    return containing_pixels(uv).contiguous(), containing_pixels(place).contiguous(), ray


@operator(
    kernel=_read_samples_kernel,
    dtypes={
        "image": torch.uint8,
        "depth": torch.float32,
        "conf": torch.uint8,
        "uv": torch.float32,
        "f": torch.float32,
        "c": torch.float32,
        "distortion": torch.float32,
        "depth_f": torch.float32,
        "depth_c": torch.float32,
        "depth_distortion": torch.float32,
    },
    any_layout=("image", "uv", "f", "c", "distortion", "depth_f", "depth_c", "depth_distortion"),
    # Samples read the nearest pixel of a dense map, with a confidence threshold that fits a byte.
    when=lambda *_, frame, search_px, limits: not search_px and frame.sparse is None and 0 <= limits.min_conf <= 255,
)
def _read_samples(*tensors: Any, frame: Frame, search_px: int | None, limits: _ReturnLimits) -> Samples:
    """:func:`backproject` of a frame; ``tensors`` are the frame's tensors that the kernel reads, and uv (B, N, 2)."""
    uv = tensors[3]
    pixel = containing_pixels(uv)
    depth, level, edge = _read_depth(frame, uv, pixel, search_px or 0, limits.edge_rel)
    if search_px is None and frame.sparse is not None:
        # 3 depth pixels, the 7×7 windows in which ``metrics.holdout`` reads sparse returns.
        pairs = zip(_read_depth(frame, uv, pixel, 3, limits.edge_rel), (depth, level, edge), strict=True)
        depth, level, edge = (torch.where(frame.sparse[:, None], a, b) for a, b in pairs)
    border, dark, saturated, specular = _appearance(frame.image, pixel, limits)
    has_return = depth > 0
    beyond = torch.zeros_like(has_return) if limits.near_limit is None else depth > limits.near_limit
    low_conf = has_return & (level < limits.min_conf)
    xyz = cam.unproject(frame.camera, uv.nan_to_num(0.0, 0.0, 0.0), depth)  # no gradient to NaN
    usable = has_return & ~(low_conf | beyond)
    usable = usable & all_finite(xyz, -1)  # a pixel outside the lens model has no ray
    confidence = (level.to(depth.dtype) / 2).clamp(0, 1)
    for doubt in (edge, specular, saturated):
        confidence = torch.where(doubt, confidence / 2, confidence)
    noise = limits.sigma_rel * depth
    return Samples(
        uv=uv,
        depth=depth,
        sigma=(limits.sigma_m**2 + noise**2).sqrt() if limits.sigma_m > 0 else noise,
        xyz=torch.where(usable[..., None], xyz, torch.nan),
        confidence=torch.where(usable, confidence, 0.0),
        flag=_bits(
            (~has_return, Flag.NO_DEPTH),
            (low_conf, Flag.LOW_CONF),
            (beyond, Flag.BEYOND_NEAR),
            (edge, Flag.DEPTH_EDGE),
            (border, Flag.BORDER),
            (dark, Flag.UNDEREXPOSED),
            (saturated, Flag.SATURATED),
            (specular, Flag.SPECULAR),
        ),
        trackability=torch.zeros_like(depth),
        hole=torch.full_like(depth, Hole.NONE, dtype=torch.int32),
    )


def _read_depth(
    frame: Frame, uv: Tensor, pixel: Tensor, search_px: int, edge_rel: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (B, N), 0 = none; sensor confidence level (B, N); whether returns around it differ (B, N).

    ``pixel`` is the image's pixel at ``uv``, and the depth map's where both have the same size.
    """
    h, w = frame.depth.shape[-2:]
    place = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, (h, w), uv)
    size = min(max(NEIGHBOURHOOD_PX, 2 * search_px + 1), h, w)
    pixel = pixel if place is uv else containing_pixels(place)
    if whole_is_faster((h, w), uv.shape[1], size):
        low, high = (gather_reduced(x, pixel, size) for x in _whole_extremes(frame.depth, size))
    else:
        low, high = _window_extremes(frame.depth[:, None], pixel, size=size)
    if search_px > 0:
        pixel = containing_pixels(_nearest_return(frame.depth, place, size, search_px))
    index, inside = nearest_pixel_index((h, w), pixel)
    value = frame.depth.flatten(1).gather(1, index)
    value = value.to(torch.promote_types(value.dtype, uv.dtype))  # half precision is for storage only
    value = torch.where(inside, value.nan_to_num(0.0, 0.0, 0.0).relu(), 0.0)
    edge = (value > 0) & (high > low * (1 + edge_rel))
    level = torch.full_like(value, 2) if frame.conf is None else frame.conf.flatten(1).gather(1, index)
    return value, level, edge


@operator(
    kernel=lambda depth, pixel, *, size: tuple(
        run_window_kernel("window_extremes", (depth, pixel, size), depth.new_empty(2, *pixel.shape[:2]))
    ),
    dtypes={"depth": torch.float32, "pixel": torch.int32},
    any_layout=("depth",),
    when=fits_window_kernel,
)
def _window_extremes(depth: Tensor, pixel: Tensor, *, size: int) -> tuple[Tensor, Tensor]:
    """Smallest and largest return (B, N) of maps (B, 1, h, w) around pixels (B, N, 2)."""
    low, high = reduce_patches(depth, pixel, size, _extremes)
    return low, high


def _extremes(window: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest return of windows (1, size, size, P): infinity and 0 where there is none."""
    window = window.detach().flatten(0, 2).nan_to_num(0, 0, 0)
    none = torch.nn.functional.threshold(window, 0.0, torch.inf)
    return none.amin(0), window.amax(0)


def _whole_extremes(depth: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """:func:`_extremes` around every pixel (B, h, w) of a depth map."""
    low, high = [], []
    for inside, around in _bands_with_margin(depth, size // 2):
        band = depth[:, around].detach().nan_to_num(0, 0, 0)
        none = torch.nn.functional.threshold(band, 0.0, torch.inf)
        low.append(window_extreme(none, size // 2, torch.minimum)[:, inside])
        high.append(window_extreme(band, size // 2, torch.maximum)[:, inside])
    return torch.cat(low, 1), torch.cat(high, 1)


def _bands_with_margin(image: Tensor, radius: int) -> Iterator[tuple[slice, slice]]:
    """Row bands of an image: the band's rows within the rows read for it, and the rows read (margin ``radius``)."""
    for part in row_bands(image, image.shape[-2:]):
        top = max(part.start - radius, 0)
        yield slice(part.start - top, part.stop - top), slice(top, part.stop + radius)


def _nearest_return(depth: Tensor, place: Tensor, size: int, search_px: int) -> Tensor:
    """The pixel (B, N, 2) with a return nearest to each ``place``, ``place`` itself where none is within reach."""
    h, w = depth.shape[-2:]
    # farther outside, nothing is within reach
    pixel = containing_pixels(place).clamp(-1 - search_px, max(h, w) + search_px)
    window = extract_patches(depth.detach()[:, None], pixel - size // 2, size).flatten(2)  # moved inside at the border
    last = torch.tensor([w - size, h - size], device=depth.device)
    first = torch.minimum((pixel - size // 2).clamp_min(0), last)
    steps = torch.arange(size, device=depth.device)
    du, dv = ((first - pixel)[..., k, None] + steps for k in (0, 1))
    du, dv = du[..., None, :], dv[..., :, None]
    near = (torch.maximum(du.abs(), dv.abs()) <= search_px).flatten(-2) & place.isfinite().all(-1, keepdim=True)
    reachable = near & (window > 0) & (window < torch.inf)
    distance = (du * du + dv * dv).flatten(-2)
    pick = torch.where(reachable, distance, distance.new_full((), 1 << 30)).argmin(-1, keepdim=True)
    nearest = first + torch.cat((pick % size, torch.div(pick, size, rounding_mode="floor")), -1)
    return torch.where(reachable.gather(-1, pick), nearest.to(place.dtype), place)


def _appearance(image: Tensor, pixel: Tensor, limits: _ReturnLimits) -> tuple[Tensor, ...]:
    """Flags (B, N) from the image alone: border, underexposed, saturated, highlight."""
    hw = (image.shape[-2], image.shape[-1])
    size = min(NEIGHBOURHOOD_PX, *hw)
    white = 1 if image.is_floating_point() else 255

    def doubts_of(mean: Tensor, centre: Tensor, top: Tensor, bottom: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        colourless = top - bottom <= MAX_HIGHLIGHT_COLOUR_REL * top
        bright = (centre >= limits.highlight * white) & (centre - mean >= MIN_HIGHLIGHT_CONTRAST * white)
        specular = colourless & bright
        return mean <= limits.dark * white, mean >= limits.saturated * white, specular

    if whole_is_faster(hw, pixel.shape[1], size) and image.dtype == torch.uint8:
        bands = zip(*(doubts_of(*brightness) for brightness in _whole_brightness(image, size)), strict=True)
        doubts = tuple(gather_reduced(torch.cat(rows, 1), pixel, size) for rows in bands)
    else:
        doubts = doubts_of(*_window_brightness(image.detach(), pixel, size=size))
    return ~is_patch_inside(pixel, hw, size), *doubts


@operator(
    kernel=lambda image, pixel, *, size: tuple(
        run_window_kernel(
            "window_brightness", (image, pixel, size), image.new_empty(4, *pixel.shape[:2], dtype=torch.float32)
        )
    ),
    dtypes={"image": torch.uint8, "pixel": torch.int32},
    any_layout=("image",),
    when=fits_window_kernel,
)
def _window_brightness(image: Tensor, pixel: Tensor, *, size: int) -> tuple[Tensor, ...]:
    """:func:`_brightness` around pixels (B, N, 2) of images (B, C, H, W), four tensors (B, N)."""
    return reduce_patches(image, pixel, size, _brightness)


def _brightness(patch: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean grey of windows (C, size, size, P); grey, largest and smallest channel of their middle pixel; (P,) each."""
    patch = patch if patch.is_floating_point() else patch.float()
    middle = patch[:, patch.shape[1] // 2, patch.shape[2] // 2]
    mean, centre = luma(torch.stack((patch.flatten(1, 2).mean(1), middle), 1), 0)[0]
    return mean, centre, middle.amax(0), middle.amin(0)


def _whole_brightness(image: Tensor, size: int) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """:func:`_brightness` around every pixel (B, H, W) of uint8 images, one row band after the other.

    Sums of bytes are exact in any order; a band needs no fresh memory.
    """
    for inside, around in _bands_with_margin(image, size // 2):
        band = image[..., around, :]
        total = window_sum(band.to(torch.int16).flatten(0, 1), size // 2)[:, inside].unflatten(0, image.shape[:2])
        planes = band[..., inside, :].contiguous()
        mean, centre = (luma(x, 1)[:, 0] for x in (total.float() / size**2, planes.float()))
        yield mean, centre, planes.amax(1).float(), planes.amin(1).float()


def _bits(*masks: tuple[Tensor, int]) -> Tensor:
    """Bit set (…) int32 of (mask, bit) pairs with bits below 256."""
    if torch.compiler.is_compiling():  # which fuses them into one loop
        return sum(
            (torch.where(mask, bit, 0) for mask, bit in masks[1:]), torch.where(masks[0][0], masks[0][1], 0)
        ).int()
    stacked = torch.stack([mask for mask, _ in masks])
    bits = constant(stacked.to(torch.uint8), [bit for _, bit in masks])[:, None, None]
    return torch.where(stacked, bits, 0).sum(0, dtype=torch.int32)
