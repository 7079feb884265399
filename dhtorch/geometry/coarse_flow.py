"""Coarse flow: two images -> motion of the whole image on a grid of cells, by correlation, without training.

Alphabet: a, b the small images of image 0 and 1, (B, h, w); ``k`` the number of image pixels per small pixel along an
axis; K = R x C *cells*, windows of a on a regular grid; A a similarity (rotation and zoom) about the centres of both
images, one of ``G`` candidates; V (…, D, D) the correlation of a cell at its position under A plus an integer offset.

Every cell is correlated with the other image within its search range; ambiguous cells are resolved by their
neighbours (belief propagation along the four directions of the grid, with a cost that grows with the change of motion
up to a limit). Gain and bias cancel in the correlation. Rotation and zoom are estimated first, on images of half the
size, among a few candidates; a candidate is accepted if it fits better than the identity by a margin.

All sums are of integers that a float represents exactly: the result depends on no order of summation, so not on the
batch, the number of threads or the device.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import linalg as closed_form
from dhtorch.geometry.checks import any_possible, constant, shaped
from dhtorch.geometry.filters import grayscale
from dhtorch.pytree import Record, record

#: Longest side of the small images for the flow, px.
COARSE_SIDE_PX = 64

#: Width of a cell's window in the flow, small pixels, odd.
CELL_WINDOW_PX = 9

#: In-plane rotations of the candidates, degrees, the identity first.
ROTATIONS_DEG = (0.0, -30.0, -15.0, 15.0, 30.0)

#: Mean correlation by which a candidate must exceed that of the identity.
MIN_CORRELATION_GAIN = 0.03

#: Largest grey value of a small image, in integer steps.
GREY_LEVELS = 1023

#: Length of a normalised window, in integer steps; its square is a correlation of 1, and sums of products over a window
#: stay below 2²⁴, exact in float32. Source: derived, 1024² = 2²⁰ < 2²⁴.
CORRELATION_UNIT = 1024

#: Cost of a difference of one small pixel between neighbouring cells, in correlation.
SMOOTHNESS_COST = 0.1

#: Quantisation steps of the logarithm of the gain per unit.
GAIN_STEPS = 32

#: Correlation from which on a cell has a positive weight.
MIN_CELL_CORRELATION = 0.6


@record
class CoarseFlow(Record):
    """The coarse motion from image 0 to image 1, on a grid of cells."""

    uv_0: Tensor  # (B, R, C, 2) px, centres of the cells in image 0
    uv_1: Tensor  # (B, R, C, 2) px, the same in image 1; NaN everywhere in a pair without support
    support: Tensor  # (B, R, C) weight in [0, 1], 0 = interpolated from the neighbours
    linear: Tensor  # (B, 2, 2) rotation and zoom of windows, d uv_1 / d uv_0
    gain: Tensor  # (B,) contrast of image 1 over that of image 0; 1 where they hardly differ

    @shaped("self.uv_1: B R C 2, uv: B N 2", "CoarseFlow.at")
    def at(self, uv: Tensor) -> Tensor:
        """Points ``uv`` (B, N, 2) px of image 0 -> predicted positions (B, N, 2) px in image 1, NaN without support.

        Bilinear between the centres of cells, and constant motion beyond the outermost.
        """
        first, last = self.uv_0[:, 0, 0], self.uv_0[:, -1, -1]
        cell_position = (uv - first[:, None]) / (last - first)[:, None]  # 0 at the first cell, 1 at the last
        displacement = (self.uv_1 - self.uv_0).permute(0, 3, 1, 2)
        is_finite = displacement.isfinite().all((1, 2, 3))
        displacement = torch.where(is_finite[:, None, None, None], displacement, torch.zeros_like(displacement))
        step = F.grid_sample(
            displacement,
            2 * cell_position[:, None].to(displacement.dtype) - 1,
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        )
        uv_1 = uv + step[:, :, 0].transpose(1, 2).to(uv.dtype)
        return torch.where(is_finite[:, None, None], uv_1, torch.full_like(uv_1, torch.nan))


@torch.no_grad()
@shaped("image_0: B C H W, image_1: B C h w, linear: B 2 2")
def coarse_flow(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    *,
    linear: Tensor | None = None,  # (B, 2, 2)
    reach: float = 0.25,
    rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    zooms: tuple[float, ...] = (1.0, 1 / 1.4, 1.4),
) -> CoarseFlow:
    """Two images -> coarse motion from image 0 to image 1, independent of their exposures.

    Args:
        linear: rotation and zoom, where known; None = estimated.
        reach: longest displacement beside rotation and zoom, as a fraction of the longer side of image 1.
        rotations_deg, zooms: in-plane rotations and zooms of the candidates, the identity first in each.

    Returns:
        Flow, in integer small pixels smoothed over neighbouring cells; a fine search refines it. A cell whose own
        window fits nowhere moves with its neighbours; a pair in which hardly any cell fits has no flow (NaN).

    Raises:
        ValueError: wrong shapes.

    Gradient: none; the flow is a discrete choice.
    Cost: independent of the images' size but for one pass over each; twice the flow where any pair is rotated.
    """
    small_0, small_1 = downscale(image_0, COARSE_SIDE_PX), downscale(image_1, COARSE_SIDE_PX)
    a, b = _quantised(small_0), _quantised(small_1)
    scale_ratio = small_1.scale / small_0.scale  # from here on similarities map small images
    if linear is None:
        similarity = _best_similarity(image_0, image_1, reach, rotations_deg, zooms)
        identity = torch.eye(2, device=a.device).expand_as(similarity)
        any_turned = any_possible(is_not_identity(similarity))
        candidates = torch.stack([identity, similarity], 1) if any_turned else identity[:, None]
    else:
        candidates = linear.to(a)[:, None] / scale_ratio
    # Approximate distance of neighbouring cells in the flow, small pixels.
    centre, offset, fit, score = _match(a, b, candidates, reach, CELL_WINDOW_PX, 5)
    first = torch.arange(candidates.shape[1], device=a.device) == 0
    best = torch.arange(len(a), device=a.device), torch.where(first, score + MIN_CORRELATION_GAIN, score).argmax(1)
    offset, fit, linear = offset[best], fit[best], candidates[best]
    weight = ((fit - MIN_CELL_CORRELATION) / (1 - MIN_CELL_CORRELATION)).clamp_min(0)
    gain = _gain(a, b, centre, offset, linear, weight)
    offset = _smooth_offsets(offset, weight)
    uv_0 = small_0.to_image(centre)
    uv_1 = small_1.to_image(centre + offset)
    # Lower limit of the mean weight of the cells, in [0, 1]; below it a pair has no flow.
    unsupported = weight.mean((-2, -1)) < 0.02
    uv_1 = torch.where(unsupported[:, None, None, None], torch.full_like(uv_1, torch.nan), uv_1)
    gain = torch.where(unsupported, torch.ones_like(gain), gain)
    linear = torch.where(unsupported[:, None, None], torch.eye(2, device=a.device), linear)  # no support for a rotation
    return CoarseFlow(uv_0=uv_0.expand_as(uv_1), uv_1=uv_1, support=weight, linear=linear * scale_ratio, gain=gain)


def invert_similarity(linear: Tensor) -> Tensor:
    """Similarities (B, 2, 2) -> their inverses. Gradient: to them."""
    return closed_form.inverse_2x2(*linear.flatten(-2).unbind(-1), least=1e-30).movedim(0, -1).unflatten(-1, (2, 2))


def apply_similarity(
    linear: Tensor,  # (B, 2, 2)
    uv: Tensor,  # (B, N, 2) px
    hw: tuple[int, int],
) -> Tensor:
    """Pixels (B, N, 2) of the upright image -> pixels of the image, rotated and zoomed about its centre.

    Under the identity they are unchanged, bit for bit. Gradient: to both.
    """
    middle = constant(uv, [(hw[1] - 1) / 2, (hw[0] - 1) / 2])
    transformed = (linear.to(uv)[:, None] * (uv - middle)[..., None, :]).sum(-1) + middle
    return torch.where(is_not_identity(linear)[:, None, None], transformed, uv)


@shaped("image: B C H W, linear: B 2 2, gain: B")
def undo_similarity(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    linear: Tensor,  # (B, 2, 2) rotation and zoom
    gain: Tensor,  # (B,)
) -> Tensor:
    """Image -> grey image (B, 1, H, W) without rotation, zoom and gain: its pixel x is the image at
    ``apply_similarity(linear, x)``, its grey values divided by ``gain``.

    Beyond the image its border repeats. Under the identity and gain 1 the grey values are unchanged, bit for bit.
    Gradient: to the image.
    """
    picture = _grey(image)
    H, W = picture.shape[-2:]
    if any_possible(is_not_identity(linear)):
        rows, columns = (torch.arange(n, device=image.device, dtype=picture.dtype) for n in (H, W))
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        uv = apply_similarity(linear, torch.stack([u, v], -1).reshape(1, H * W, 2).expand(len(picture), -1, -1), (H, W))
        grid = ((2 * uv + 1) / constant(uv, [W, H]) - 1).reshape(-1, H, W, 2)
        sampled = F.grid_sample(picture, grid, mode="bilinear", padding_mode="border", align_corners=False)
        picture = torch.where(is_not_identity(linear)[:, None, None, None], sampled, picture)
    gain = gain.to(picture)[:, None, None, None]
    return torch.where(gain == 1, picture, picture / gain)


def is_not_identity(linear: Tensor) -> Tensor:
    """Whether each similarity (B, 2, 2) differs from the identity, (B,) bool."""
    return (linear != torch.eye(2, device=linear.device, dtype=linear.dtype)).flatten(1).any(1)


class DownscaledImage(NamedTuple):
    """A small image, each pixel the mean of a square of image pixels."""

    grey: Tensor  # (B, 1, h, w) in [0, 1]
    scale: int  # image pixels per small pixel along an axis
    first: float  # px, coordinate of the centre of small pixel 0 in the image

    def to_image(self, uv: Tensor) -> Tensor:
        """Coordinates in small pixels -> coordinates in pixels of the image."""
        return uv * self.scale + self.first


@shaped("image: B C H W")
def downscale(image: Tensor, long: int) -> DownscaledImage:
    """Image (B, C, H, W) -> grey image with a longer side of at most ``long``; a smaller image keeps its size.

    In squares of sixteen pixels and more only every so many rows and columns are averaged: a hundred pixels give about
    the same mean as a thousand. Gradient: to the image.
    """
    scale = max(1, math.ceil(max(image.shape[-2:]) / long))
    stride = max(1, scale // 8)
    side = scale // stride
    picture = _grey(image[..., ::stride, ::stride])
    return DownscaledImage(F.avg_pool2d(picture, side), side * stride, (side - 1) * stride / 2)


def _grey(image: Tensor) -> Tensor:
    """Grey image (B, 1, H, W) in single precision at least."""
    picture = grayscale(image)
    return picture.to(torch.promote_types(picture.dtype, torch.float32))


def _best_similarity(
    image_0: Tensor, image_1: Tensor, reach: float, rotations_deg: tuple[float, ...], zooms: tuple[float, ...]
) -> Tensor:
    """Two images -> similarity (B, 2, 2) of the candidates with the highest mean correlation."""
    # Longest side of the small images for rotation and zoom, px.
    a, b = (_quantised(downscale(image, 32)) for image in (image_0, image_1))
    like = a.new_empty(0, dtype=torch.get_default_dtype())
    angle = constant(like, [math.radians(t) for z in zooms for t in rotations_deg])
    zoom = constant(like, [z for z in zooms for t in rotations_deg])
    c, s = zoom * angle.cos(), zoom * angle.sin()
    candidates = torch.stack([c, -s, s, c], -1).reshape(1, -1, 2, 2).expand(len(a), -1, -1, -1)
    # Width of a cell's window in the search for rotation and zoom, small pixels, odd.
    # Approximate distance of neighbouring cells in the search for rotation and zoom, small pixels.
    score = _match(a, b, candidates, reach, 7, 5)[3]
    is_identity = torch.arange(score.shape[1], device=score.device) == 0
    best = torch.where(is_identity, score + MIN_CORRELATION_GAIN, score).argmax(1)
    return candidates[torch.arange(len(best), device=best.device), best]


def _quantised(picture: DownscaledImage) -> Tensor:
    """Small image -> integer grey values (B, h, w) from 0 to ``GREY_LEVELS``."""
    return (picture.grey[:, 0] * GREY_LEVELS).round()


def _match(a: Tensor, b: Tensor, A: Tensor, reach: float, window: int, step: int) -> tuple[Tensor, ...]:
    """Images a, b and candidates A -> cell centres (R, C, 2), offsets to b (B, G, R, C, 2), small px, correlations
    (B, G, R, C), and mean correlation (B, G) of the cells that A maps into the image."""
    (h, w), (h_1, w_1) = a.shape[-2:], b.shape[-2:]
    R, C = (max(2, round(n / step)) for n in (h, w))
    v, u = ((torch.arange(m, device=a.device) + 0.5) * (n / m) - 0.5 for m, n in ((R, h), (C, w)))
    centre = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).to(a)
    radius = math.ceil(reach * max(h_1, w_1))
    middle_0, middle_1 = (constant(a, [(x - 1) / 2, (y - 1) / 2]) for y, x in ((h, w), (h_1, w_1)))
    projected = (A[:, :, None, None] * (centre - middle_0)[..., None, :]).sum(-1) + middle_1  # (B, G, R, C, 2)
    templates = _normalise(_sample_windows(a, centre.reshape(1, 1, -1, 2), A, window), _flat_variance(a))
    # Normalised correlation (B, G, K, h, w) of every template with every pixel of b, in 1 /
    # ``CORRELATION_UNIT``²
    r = window // 2
    windows = F.unfold(F.pad(b[:, None], (r, r, r, r), mode="replicate"), window)
    S = torch.bmm(templates.flatten(1, 2), _normalise(windows.transpose(1, 2), _flat_variance(b)).transpose(1, 2))
    S = S.reshape(*templates.shape[:3], *b.shape[-2:])
    V = _crop_scores(S, projected.round().long(), radius)
    aggregated = V + _messages_along(V) + _messages_along(V.transpose(2, 3)).transpose(2, 3)
    D = 2 * radius + 1
    i = aggregated.flatten(-2).argmax(-1)
    peak = _max_3x3(V)
    fit = peak.flatten(-2).gather(-1, i[..., None])[..., 0] / CORRELATION_UNIT**2
    shift = torch.stack([i % D, i // D], -1) - radius
    inside = ((projected > -0.5) & (projected < constant(projected, [w_1 - 0.5, h_1 - 0.5]))).all(-1)
    score = torch.where(inside, fit, torch.zeros_like(fit)).sum((-2, -1)) / inside.sum((-2, -1)).clamp_min(1)
    return centre, projected.round() + shift - centre, fit, score


def _sample_windows(a: Tensor, centre: Tensor, A: Tensor, window: int) -> Tensor:
    """Windows (B, G, K, window²) of a around ``centre`` (B or 1, G or 1, K, 2), transformed by each similarity."""
    r = window // 2
    offset = torch.arange(-r, r + 1, device=a.device, dtype=a.dtype)
    offset = torch.stack(torch.meshgrid(offset, offset, indexing="xy"), -1).reshape(-1, 2)
    source_offset = (invert_similarity(A)[:, :, None] * offset[:, None, :]).sum(-1)  # (B, G, window², 2)
    uv = centre[..., None, :] + source_offset[:, :, None]
    h, w = a.shape[-2:]
    grid = (2 * uv + 1) / constant(uv, [w, h]) - 1
    out = F.grid_sample(a[:, None], grid.flatten(1, 2), mode="bilinear", padding_mode="border", align_corners=False)
    return out[:, 0].unflatten(1, (*A.shape[1:2], -1))


def _gain(a: Tensor, b: Tensor, centre: Tensor, offset: Tensor, linear: Tensor, cell_weight: Tensor) -> Tensor:
    """Matched cells -> ratio of their contrasts (B,), quantised; 1 where it hardly differs from one."""
    windows_0 = _sample_windows(a, centre.reshape(1, 1, -1, 2), linear[:, None], CELL_WINDOW_PX)[:, 0]
    centre_1 = (centre + offset).flatten(1, 2)[:, None]
    identity = torch.eye(2, device=a.device).expand_as(linear)[:, None]
    windows_1 = _sample_windows(b, centre_1, identity, CELL_WINDOW_PX)[:, 0]
    ratio = (_variance(windows_1) + 1).log() - (_variance(windows_0) + 1).log()
    weight = cell_weight.flatten(1)
    mean = (ratio * weight).sum(-1) / weight.sum(-1).clamp_min(1e-6) / 2
    mean = (mean * GAIN_STEPS).round() / GAIN_STEPS
    # Absolute logarithm of the gain up to which it counts as 1.
    # Limits of the gain, a ratio of contrasts.
    return torch.where(mean.abs() > 0.1, mean, torch.zeros_like(mean)).exp().clamp(0.1, 10.0)


def _variance(windows: Tensor) -> Tensor:
    """Variance (…) of windows (…, n)."""
    n = windows.shape[-1]
    x = windows.round().double()  # integers: exact
    return ((x.square().sum(-1) - x.sum(-1).square() / n) / n).clamp_min(0)


def _flat_variance(picture: Tensor) -> Tensor:
    """Variance (B,) of grey levels, of an image (B, h, w), that regularises the contrast of flat windows."""
    # Contrast of a window over that of the whole image, a ratio of standard deviations, that regularises flat
    # windows.
    # Lower limit of that regularising standard deviation, grey levels.
    return (0.05**2 * _variance(picture.flatten(1))).clamp_min(2.0**2)


def _normalise(windows: Tensor, floor: Tensor) -> Tensor:
    """Windows (B, …, n) -> integers of mean 0 and length ``CORRELATION_UNIT``; shorter for flat windows."""
    n = windows.shape[-1]
    floor = floor.reshape(-1, *[1] * (windows.dim() - 1))
    x = windows.round().double()
    total = x.sum(-1, keepdim=True)  # integers: exact
    squares = x.square().sum(-1, keepdim=True)
    energy = squares - total * total / n + n * floor
    return ((x - total / n) * (CORRELATION_UNIT / energy.sqrt())).round().float()


def _crop_scores(S: Tensor, centre: Tensor, radius: int) -> Tensor:
    """Crops (B, G, R, C, D, D) of S within ``radius`` of ``centre`` (B, G, R, C, 2); 0 outside the image."""
    h, w = S.shape[-2:]
    o = torch.arange(-radius, radius + 1, device=S.device)
    u, v = centre[..., 0, None] + o, centre[..., 1, None] + o
    inside = ((v >= 0) & (v < h))[..., :, None] & ((u >= 0) & (u < w))[..., None, :]
    index = v.clamp(0, h - 1)[..., :, None] * w + u.clamp(0, w - 1)[..., None, :]
    scores = S.reshape(*centre.shape[:-1], h * w).gather(-1, index.flatten(-2)).reshape(index.shape)
    return torch.where(inside, scores, torch.zeros_like(scores))


def _messages_along(V: Tensor) -> Tensor:
    """Sum of the messages to each row of cells from the rows before and after it, along dim 2."""
    forward, backward = _forward_messages(torch.cat([V, V.flip(2)])).chunk(2)
    return forward + backward.flip(2)


def _forward_messages(V: Tensor) -> Tensor:
    """Messages (B, G, R, C, D, D) to each row of cells from the rows before it, along dim 2."""
    messages = [torch.zeros_like(V[:, :, 0])]
    for row in V.unbind(2)[:-1]:
        # Max-sum message of x (…, D, D): best value less ``SMOOTHNESS_COST`` per small pixel, limited below
        x = row + messages[-1]
        # Largest cost of a difference between neighbouring cells, in correlation.
        least = x.amax((-2, -1), keepdim=True) - round(0.5 * CORRELATION_UNIT**2)
        best = torch.maximum(x, least)
        for _ in range(2):
            best = torch.maximum(best, _max_3x3(best) - round(SMOOTHNESS_COST * CORRELATION_UNIT**2))
        messages.append(best - least)
    return torch.stack(messages, 2)


def _max_3x3(x: Tensor) -> Tensor:
    """Maximum of each value of x (…, D, D) and its eight neighbours."""
    x = F.pad(x, (1, 1, 1, 1), value=-math.inf)
    x = torch.maximum(torch.maximum(x[..., :-2], x[..., 1:-1]), x[..., 2:])
    return torch.maximum(torch.maximum(x[..., :-2, :], x[..., 1:-1, :]), x[..., 2:, :])


def _smooth_offsets(offset: Tensor, cell_weight: Tensor) -> Tensor:
    """Offsets (B, R, C, 2) -> weighted means of their neighbourhood; of the whole image where its weights are 0."""
    weight = cell_weight[..., None]
    weighted = offset * weight
    smoothed, weight_sum = _binomial(weighted), _binomial(weight)
    mean = weighted.sum((1, 2), keepdim=True) / weight.sum((1, 2), keepdim=True).clamp_min(1e-6)
    return (smoothed + 1e-3 * mean) / (weight_sum + 1e-3)


def _binomial(x: Tensor) -> Tensor:
    """(B, R, C, …) smoothed by (1 2 1)/4 along R and C, with nothing beyond the border."""
    for dim in (1, 2):
        zero = torch.zeros_like(x.narrow(dim, 0, 1))
        n = x.shape[dim]
        before = torch.cat([zero, x.narrow(dim, 0, n - 1)], dim)
        after = torch.cat([x.narrow(dim, 1, n - 1), zero], dim)
        x = (before + after + 2 * x) * 0.25
    return x
