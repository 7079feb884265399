"""Where to look first: the coarse motion of the whole picture, by correlation, without training.

Alphabet: a, b the small pictures of image 0 and 1, (B, h, w); ``k`` how many pixels of an image make one of its small
picture; K = R x C *cells*, windows of a on a regular grid; A a similarity (turn and zoom) about the middles of both
pictures, one of ``G`` candidates; V (…, D, D) how well a cell fits where A puts it, moved by a whole-pixel offset.

Every cell is correlated with all of the other picture that it may have moved to; what a cell cannot tell alone its
neighbours tell it (messages along the four directions of the grid, which let the motion change by a little at a price
and by anything at a higher one). Gain and bias cancel in the correlation. Turn and zoom are found first, on pictures of
half the size, among a few candidates; to take one of them it must fit better than none.

All that is summed is whole numbers small enough for a float to hold: the answer depends on no order of summation, so
not on the batch, the number of threads or the device.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import linalg as closed
from dhtorch.geometry.checks import any_possible, check
from dhtorch.geometry.filters import grayscale
from dhtorch.pytree import Record, record

#: Longest side of the small pictures, px, and of those on which turn and zoom are found.
COARSE_SIDE_PX, ROTATION_SIDE_PX = 64, 32

#: Width of a cell's window, an odd number of small pixels, and about how far apart cells lie.
CELL_WINDOW_PX, CELL_STEP_PX = 9, 5
ROTATION_WINDOW_PX, ROTATION_STEP_PX = 7, 5

#: Turns in degrees and zooms that are tried; their products are the candidates, the first of all is none.
ROTATIONS_DEG, ZOOMS = (0.0, -30.0, -15.0, 15.0, 30.0), (1.0, 1 / 1.4, 1.4)

#: How much better than none (mean correlation) a turn must fit.
MIN_CORRELATION_GAIN = 0.03

#: Grey levels of a small picture, and what a correlation of one is in whole numbers: their products' sum over a window
#: stays below 2^24.
GREY_LEVELS, CORRELATION_UNIT = 1023, 1024

#: A window whose contrast is a smaller share of the whole picture's than this, or fewer grey levels, counts as flat.
FLAT_CONTRAST_RATIO, FLAT_CONTRAST_LEVELS = 0.05, 2.0

#: What it costs neighbours to differ by one small pixel, and at most, in correlation.
SMOOTHNESS_COST, MAX_SMOOTHNESS_COST = 0.1, 0.5

#: Logarithm of a gain that counts as none, and its steps; gains that are believed.
UNIT_GAIN_LOG, GAIN_STEPS, COARSE_GAIN_RANGE = 0.1, 32, (0.1, 10.0)

#: Correlation from which on a cell has a say, and the least mean say of a picture with any start at all.
MIN_CELL_CORRELATION, MIN_MEAN_WEIGHT = 0.6, 0.02


@record
class CoarseFlow(Record):
    """The coarse motion from image 0 to image 1, on a grid of cells."""

    uv_0: Tensor  # (B, R, C, 2) px, middles of the cells in image 0
    uv_1: Tensor  # (B, R, C, 2) px, where they went; NaN everywhere in a pair without support
    support: Tensor  # (B, R, C) in [0, 1], 0 = guessed from the neighbours
    linear: Tensor  # (B, 2, 2) turn and zoom that windows undergo, d uv_1 / d uv_0
    gain: Tensor  # (B,) contrast of image 1 over that of image 0; 1 where they hardly differ

    def at(self, uv: Tensor) -> Tensor:
        """Where to look in image 1 for points ``uv`` (B, N, 2) px of image 0: (B, N, 2) px, NaN where nothing is known.

        Bilinear between the middles of cells, and constant motion beyond the outermost.
        """
        check("Flow.at", uv_1=(self.uv_1, "B R C 2"), uv=(uv, "B N 2"))
        first, last = self.uv_0[:, 0, 0], self.uv_0[:, -1, -1]
        place = (uv - first[:, None]) / (last - first)[:, None]  # 0 at the first cell, 1 at the last
        moved = (self.uv_1 - self.uv_0).permute(0, 3, 1, 2)
        known = moved.isfinite().all((1, 2, 3))
        moved = torch.where(known[:, None, None, None], moved, torch.zeros_like(moved))
        step = F.grid_sample(
            moved, 2 * place[:, None].to(moved.dtype) - 1, mode="bilinear", padding_mode="border", align_corners=True
        )
        found = uv + step[:, :, 0].transpose(1, 2).to(uv.dtype)
        return torch.where(known[:, None, None], found, torch.full_like(found, torch.nan))


@torch.no_grad()
def coarse_flow(
    image_0: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    image_1: Tensor,  # (B, C, H', W')
    *,
    linear: Tensor | None = None,  # (B, 2, 2)
    reach: float = 0.25,
    rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    zooms: tuple[float, ...] = ZOOMS,
) -> CoarseFlow:
    """The coarse motion of the picture from image 0 to image 1, whatever their exposures.

    Args:
        linear: turn and zoom, where they are known; None = they are looked for.
        reach: longest displacement beside turn and zoom, as a share of the longer side of image 1.
        rotations_deg, zooms: in-plane turns and magnifications that are tried, the first of each being none.

    Returns:
        Flow, in whole small pixels made smooth over neighbouring cells: the fine search does the rest. A cell whose own
        window fits nowhere moves with its neighbours; a pair in which hardly a cell fits has no start at all (NaN).

    Raises:
        ValueError: wrong shapes.

    Gradient: none; a start is a choice.
    Cost: independent of the images' size but for one reading of each; a pair more where some pair is turned.
    """
    check("coarse_flow", image_0=(image_0, "B C H W"), image_1=(image_1, "B C H' W'"), linear=(linear, "B 2 2"))
    small_0, small_1 = downscale(image_0, COARSE_SIDE_PX), downscale(image_1, COARSE_SIDE_PX)
    a, b = _quantised(small_0), _quantised(small_1)
    larger = small_1.scale / small_0.scale  # turns and zooms are those of small pictures from here on
    if linear is None:
        found = _best_similarity(image_0, image_1, reach, rotations_deg, zooms)
        plain = torch.eye(2, device=a.device).expand_as(found)
        some = any_possible(is_not_identity(found))
        rivals = torch.stack([plain, found], 1) if some else plain[:, None]
    else:
        rivals = linear.to(a)[:, None] / larger
    centre, offset, fit, total = _match(a, b, rivals, reach, CELL_WINDOW_PX, CELL_STEP_PX)
    first = torch.arange(rivals.shape[1], device=a.device) == 0
    pick = torch.arange(len(a), device=a.device), torch.where(first, total + MIN_CORRELATION_GAIN, total).argmax(1)
    offset, fit, linear = offset[pick], fit[pick], rivals[pick]
    say = ((fit - MIN_CELL_CORRELATION) / (1 - MIN_CELL_CORRELATION)).clamp_min(0)
    gain = _gain(a, b, centre, offset, linear, say)
    offset = _spread(offset, say)
    uv_0 = small_0.to_image(centre)
    uv_1 = small_1.to_image(centre + offset)
    silent = say.mean((-2, -1)) < MIN_MEAN_WEIGHT
    uv_1 = torch.where(silent[:, None, None, None], torch.full_like(uv_1, torch.nan), uv_1)
    gain = torch.where(silent, torch.ones_like(gain), gain)
    linear = torch.where(silent[:, None, None], torch.eye(2, device=a.device), linear)  # nothing supports a turn
    return CoarseFlow(uv_0=uv_0.expand_as(uv_1), uv_1=uv_1, support=say, linear=linear * larger, gain=gain)


def invert_similarity(linear: Tensor) -> Tensor:
    """The inverse (B, 2, 2) of turns and zooms. Gradient: to them."""
    return closed.inverse_2x2(*linear.flatten(-2).unbind(-1), least=1e-30).movedim(0, -1).unflatten(-1, (2, 2))


def apply_similarity(
    linear: Tensor,  # (B, 2, 2)
    uv: Tensor,  # (B, N, 2) px
    hw: tuple[int, int],
) -> Tensor:
    """Where pixels of the upright picture lie in the image: (B, N, 2) px, turned and zoomed about its middle.

    Where there is no turn they stay, bit for bit. Gradient: to both.
    """
    middle = uv.new_tensor([(hw[1] - 1) / 2, (hw[0] - 1) / 2])
    there = (linear.to(uv)[:, None] * (uv - middle)[..., None, :]).sum(-1) + middle
    return torch.where(is_not_identity(linear)[:, None, None], there, uv)


def undo_similarity(
    image: Tensor,  # (B, C, H, W) C 1 or 3; float in [0, 1] or uint8
    linear: Tensor,  # (B, 2, 2) a turn and a zoom
    gain: Tensor,  # (B,)
) -> Tensor:
    """The grey picture (B, 1, H, W) with turn, zoom and gain undone: its pixel x is the image at ``turned(linear, x)``,
    its grey values divided by ``gain``.

    Beyond the image its border repeats. Where there is nothing to undo the picture is the image's, bit for bit.
    Gradient: to the image.
    """
    check("undo_similarity", image=(image, "B C H W"), linear=(linear, "B 2 2"), gain=(gain, "B"))
    picture = _grey(image)
    H, W = picture.shape[-2:]
    if any_possible(is_not_identity(linear)):
        rows, columns = (torch.arange(n, device=image.device, dtype=picture.dtype) for n in (H, W))
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        uv = apply_similarity(linear, torch.stack([u, v], -1).reshape(1, H * W, 2).expand(len(picture), -1, -1), (H, W))
        place = ((2 * uv + 1) / uv.new_tensor([W, H]) - 1).reshape(-1, H, W, 2)
        seen = F.grid_sample(picture, place, mode="bilinear", padding_mode="border", align_corners=False)
        picture = torch.where(is_not_identity(linear)[:, None, None, None], seen, picture)
    gain = gain.to(picture)[:, None, None, None]
    return torch.where(gain == 1, picture, picture / gain)


def is_not_identity(linear: Tensor) -> Tensor:
    """(B,) bool: not the identity."""
    return (linear != torch.eye(2, device=linear.device, dtype=linear.dtype)).flatten(1).any(1)


class DownscaledImage(NamedTuple):
    """A picture of a few thousand pixels, each the mean of a square of the image's."""

    grey: Tensor  # (B, 1, h, w) in [0, 1]
    scale: int  # image pixels in a row that make one
    first: float  # px, the image's coordinate of the middle of small pixel 0

    def to_image(self, uv: Tensor) -> Tensor:
        """Small pixels as pixels of the image."""
        return uv * self.scale + self.first


def downscale(image: Tensor, long: int) -> DownscaledImage:
    """The picture (B, C, H, W) with a longer side of at most ``long``; one that is no larger stays as it is.

    Of squares wider than sixteen pixels only every so many rows and columns are read: a hundred pixels tell a mean as
    well as a thousand do. Gradient: to the image.
    """
    check("downscale", image=(image, "B C H W"))
    scale = max(1, math.ceil(max(image.shape[-2:]) / long))
    thin = max(1, scale // 8)
    side = scale // thin
    picture = _grey(image[..., ::thin, ::thin])
    return DownscaledImage(F.avg_pool2d(picture, side), side * thin, (side - 1) * thin / 2)


def _grey(image: Tensor) -> Tensor:
    """(B, 1, H, W) in single precision at least."""
    picture = grayscale(image)
    return picture.to(torch.promote_types(picture.dtype, torch.float32))


def _best_similarity(
    image_0: Tensor, image_1: Tensor, reach: float, rotations_deg: tuple[float, ...], zooms: tuple[float, ...]
):
    """The similarity (B, 2, 2) among the candidates under which the pictures agree best."""
    a, b = (_quantised(downscale(image, ROTATION_SIDE_PX)) for image in (image_0, image_1))
    angle = torch.tensor([math.radians(t) for z in zooms for t in rotations_deg], device=a.device)
    zoom = torch.tensor([z for z in zooms for t in rotations_deg], device=a.device)
    c, s = zoom * angle.cos(), zoom * angle.sin()
    candidates = torch.stack([c, -s, s, c], -1).reshape(1, -1, 2, 2).expand(len(a), -1, -1, -1)
    total = _match(a, b, candidates, reach, ROTATION_WINDOW_PX, ROTATION_STEP_PX)[3]
    plain = torch.arange(total.shape[1], device=total.device) == 0
    best = torch.where(plain, total + MIN_CORRELATION_GAIN, total).argmax(1)
    return candidates[torch.arange(len(best), device=best.device), best]


def _quantised(picture: DownscaledImage) -> Tensor:
    """(B, h, w) whole numbers from 0 to ``GREY_LEVELS``."""
    return (picture.grey[:, 0] * GREY_LEVELS).round()


def _match(a: Tensor, b: Tensor, A: Tensor, reach: float, window: int, step: int) -> tuple[Tensor, ...]:
    """Cells (R, C, 2) of a, how far each moved to b (B, G, R, C, 2), small px, how well it fits there (B, G, R, C), and
    how well those fit (B, G) that A leaves in the picture."""
    (h, w), (h_1, w_1) = a.shape[-2:], b.shape[-2:]
    centre = _cells(h, w, step).to(a)
    most = math.ceil(reach * max(h_1, w_1))
    middle_0, middle_1 = (a.new_tensor([(x - 1) / 2, (y - 1) / 2]) for y, x in ((h, w), (h_1, w_1)))
    moved = (A[:, :, None, None] * (centre - middle_0)[..., None, :]).sum(-1) + middle_1  # (B, G, R, C, 2)
    templates = _unit(_read(a, centre.reshape(1, 1, -1, 2), A, window), _floor(a))
    S = _correlation(templates, b, window)
    V = _around(S, moved.round().long(), most)
    joined = _aggregate_neighbours(V)
    D = 2 * most + 1
    i = joined.flatten(-2).argmax(-1)
    near = _highest(V)
    fit = near.flatten(-2).gather(-1, i[..., None])[..., 0] / CORRELATION_UNIT**2
    shift = torch.stack([i % D, i // D], -1) - most
    stays = ((moved > -0.5) & (moved < moved.new_tensor([w_1 - 0.5, h_1 - 0.5]))).all(-1)
    total = torch.where(stays, fit, torch.zeros_like(fit)).sum((-2, -1)) / stays.sum((-2, -1)).clamp_min(1)
    return centre, moved.round() + shift - centre, fit, total


def _cells(h: int, w: int, step: int) -> Tensor:
    """Middles (R, C, 2) of the cells of a small picture."""
    R, C = (max(2, round(n / step)) for n in (h, w))
    v, u = ((torch.arange(m) + 0.5) * (n / m) - 0.5 for m, n in ((R, h), (C, w)))
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def _read(a: Tensor, centre: Tensor, A: Tensor, window: int) -> Tensor:
    """Windows (B, G, K, window²) of a around ``centre`` (B or 1, G or 1, K, 2), as each similarity shows them."""
    r = window // 2
    o = torch.arange(-r, r + 1, device=a.device, dtype=a.dtype)
    o = torch.stack(torch.meshgrid(o, o, indexing="xy"), -1).reshape(-1, 2)
    read = (invert_similarity(A)[:, :, None] * o[:, None, :]).sum(-1)  # (B, G, window², 2)
    at = centre[..., None, :] + read[:, :, None]
    h, w = a.shape[-2:]
    grid = (2 * at + 1) / at.new_tensor([w, h]) - 1
    out = F.grid_sample(a[:, None], grid.flatten(1, 2), mode="bilinear", padding_mode="border", align_corners=False)
    return out[:, 0].unflatten(1, (*A.shape[1:2], -1))


def _gain(a: Tensor, b: Tensor, centre: Tensor, offset: Tensor, linear: Tensor, say: Tensor) -> Tensor:
    """Ratio of the contrasts (B,) of cells that found each other, as far as it differs from one, in coarse steps."""
    here = _read(a, centre.reshape(1, 1, -1, 2), linear[:, None], CELL_WINDOW_PX)[:, 0]
    there = (centre + offset).flatten(1, 2)[:, None]
    plain = torch.eye(2, device=a.device).expand_as(linear)[:, None]
    seen = _read(b, there, plain, CELL_WINDOW_PX)[:, 0]
    ratio = (_variance(seen) + 1).log() - (_variance(here) + 1).log()
    weight = say.flatten(1)
    mean = (ratio * weight).sum(-1) / weight.sum(-1).clamp_min(1e-6) / 2
    mean = (mean * GAIN_STEPS).round() / GAIN_STEPS
    return torch.where(mean.abs() > UNIT_GAIN_LOG, mean, torch.zeros_like(mean)).exp().clamp(*COARSE_GAIN_RANGE)


def _variance(windows: Tensor) -> Tensor:
    """(…, n) → (…); mean of squares about the mean."""
    n = windows.shape[-1]
    x = windows.round().double()  # whole numbers: exact
    return ((x.square().sum(-1) - x.sum(-1).square() / n) / n).clamp_min(0)


def _correlation(templates: Tensor, b: Tensor, window: int) -> Tensor:
    """Normalised correlation of every template with every place of b: (B, G, K, h, w), in units of 1 / UNIT²."""
    r = window // 2
    there = F.unfold(F.pad(b[:, None], (r, r, r, r), mode="replicate"), window)
    S = torch.bmm(templates.flatten(1, 2), _unit(there.transpose(1, 2), _floor(b)).transpose(1, 2))
    return S.reshape(*templates.shape[:3], *b.shape[-2:])


def _floor(picture: Tensor) -> Tensor:
    """Variance (B,) of grey levels under which a window of a picture (B, h, w) counts as flat."""
    return (FLAT_CONTRAST_RATIO**2 * _variance(picture.flatten(1))).clamp_min(FLAT_CONTRAST_LEVELS**2)


def _unit(windows: Tensor, floor: Tensor) -> Tensor:
    """Windows (B, …, n) of mean 0 and length UNIT, in whole numbers; flat ones shorter."""
    n = windows.shape[-1]
    floor = floor.reshape(-1, *[1] * (windows.dim() - 1))
    x = windows.round().double()
    total = x.sum(-1, keepdim=True)  # of whole numbers: exact
    squares = x.square().sum(-1, keepdim=True)
    energy = squares - total * total / n + n * floor
    return ((x - total / n) * (CORRELATION_UNIT / energy.sqrt())).round().float()


def _around(S: Tensor, at: Tensor, most: int) -> Tensor:
    """The part (B, G, R, C, D, D) of S within ``most`` of ``at`` (B, G, R, C, 2); 0 outside the picture."""
    h, w = S.shape[-2:]
    o = torch.arange(-most, most + 1, device=S.device)
    u, v = at[..., 0, None] + o, at[..., 1, None] + o
    inside = ((v >= 0) & (v < h))[..., :, None] & ((u >= 0) & (u < w))[..., None, :]
    index = v.clamp(0, h - 1)[..., :, None] * w + u.clamp(0, w - 1)[..., None, :]
    found = S.reshape(*at.shape[:-1], h * w).gather(-1, index.flatten(-2)).reshape(index.shape)
    return torch.where(inside, found, torch.zeros_like(found))


def _aggregate_neighbours(V: Tensor) -> Tensor:
    """V (B, G, R, C, D, D) and what the cells to all four sides make of it, as sums of best chains of neighbours."""
    return V + _messages_along(V) + _messages_along(V.transpose(2, 3)).transpose(2, 3)


def _messages_along(V: Tensor) -> Tensor:
    """What each row of cells hears from those before it and from those after it, along dim 2."""
    onwards, back = _chain(torch.cat([V, V.flip(2)])).chunk(2)
    return onwards + back.flip(2)


def _chain(V: Tensor) -> Tensor:
    """What each row of cells hears from the rows before it: (B, G, R, C, D, D) along dim 2."""
    heard = [torch.zeros_like(V[:, :, 0])]
    for row in V.unbind(2)[:-1]:
        heard.append(_message(row + heard[-1]))
    return torch.stack(heard, 2)


def _message(x: Tensor) -> Tensor:
    """Best of x (…, D, D) over nearby offsets, each small pixel at the price of SLOPE, at most MOST below the best."""
    floor = x.amax((-2, -1), keepdim=True) - round(MAX_SMOOTHNESS_COST * CORRELATION_UNIT**2)
    best = torch.maximum(x, floor)
    for _ in range(2):
        best = torch.maximum(best, _highest(best) - round(SMOOTHNESS_COST * CORRELATION_UNIT**2))
    return best - floor


def _highest(x: Tensor) -> Tensor:
    """The highest of each value of x (…, D, D) and its eight neighbours."""
    x = F.pad(x, (1, 1, 1, 1), value=-math.inf)
    x = torch.maximum(torch.maximum(x[..., :-2], x[..., 1:-1]), x[..., 2:])
    return torch.maximum(torch.maximum(x[..., :-2, :], x[..., 1:-1, :]), x[..., 2:, :])


def _spread(offset: Tensor, say: Tensor) -> Tensor:
    """Offsets (B, R, C, 2), each the mean of its surroundings by their say; without any, of the whole picture."""
    weight = say[..., None]
    moving = offset * weight
    near, known = _binomial(moving), _binomial(weight)
    whole = moving.sum((1, 2), keepdim=True) / weight.sum((1, 2), keepdim=True).clamp_min(1e-6)
    return (near + 1e-3 * whole) / (known + 1e-3)


def _binomial(x: Tensor) -> Tensor:
    """(B, R, C, …) smoothed by (1 2 1)/4 along R and C, with nothing beyond the border."""
    for dim in (1, 2):
        zero = torch.zeros_like(x.narrow(dim, 0, 1))
        n = x.shape[dim]
        before = torch.cat([zero, x.narrow(dim, 0, n - 1)], dim)
        after = torch.cat([x.narrow(dim, 1, n - 1), zero], dim)
        x = (before + after + 2 * x) * 0.25
    return x
