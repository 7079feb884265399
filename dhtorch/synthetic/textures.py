"""Procedural, tileable textures of the built-in room.

A picture is a (SIZE, SIZE, 3) tensor of display values (about the square root of reflectance) in [0, 1]. A painter
depends on the room's generator alone, so a seed determines all pictures. Detail has several scales: large shapes for
coarse pyramid levels, grain of a few texels for the finest.

Alphabet: ``u`` right and ``v`` down, in [0, 1) over the tile. Only correctly rounded arithmetic is used (no sine, no
logarithm): the result does not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Generator, Tensor

TEXTURE_SIZE_PX = 512  #: texels along a side, a power of two

_PALETTE = (
    (0.90, 0.86, 0.76),
    (0.80, 0.42, 0.28),
    (0.20, 0.46, 0.50),
    (0.16, 0.22, 0.38),
    (0.88, 0.68, 0.28),
    (0.46, 0.54, 0.30),
    (0.76, 0.46, 0.50),
    (0.22, 0.20, 0.20),
    (0.60, 0.74, 0.82),
)

_Colour = tuple[float, float, float]
_Painter = Callable[[Generator], Tensor]


def paint_textures(names: list[str], generator: Generator) -> Tensor:
    """(len(names), SIZE, SIZE, 3) pictures in [0, 1]; a name such as ``poster:2`` is the third poster."""
    return torch.stack([_PAINTERS[name.partition(":")[0]](generator).clamp(0, 1) for name in names])


def _periodic_noise(generator: Generator, hw: tuple[int, int], cells: tuple[int, int]) -> Tensor:
    """Periodic smooth random field (h, w) in [0, 1] with ``cells`` independent values down and across."""
    grid = torch.rand(cells, generator=generator)
    for dim in (0, 1):
        position = torch.arange(hw[dim]) * (cells[dim] / hw[dim])
        low = position.floor()
        index = low.long()
        w = position - low
        w = (w * w * (3 - 2 * w)).unsqueeze(1 - dim)
        grid = grid.index_select(dim, index) * (1 - w) + grid.index_select(dim, (index + 1) % cells[dim]) * w
    return grid


def _fractal_noise(g: Generator, cells: int, octaves: int, stretch: int = 1) -> Tensor:
    """Sum of noise octaves (SIZE, SIZE) in [0, 1]; ``stretch`` times finer across than down."""
    total, weight = torch.zeros(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), 0.0
    for k in range(octaves):
        down, across = (min(n << k, TEXTURE_SIZE_PX // 2) for n in (cells, cells * stretch))
        total = total + 0.6**k * _periodic_noise(g, (TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), (down, across))
        weight += 0.6**k
    return total / weight


def _texture_uv() -> tuple[Tensor, Tensor]:
    position = (torch.arange(TEXTURE_SIZE_PX) + 0.5) / TEXTURE_SIZE_PX
    return position.expand(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), position[:, None].expand(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX)


def _smooth_step(x: Tensor, width: float) -> Tensor:
    """0 below -width, 1 above width, smooth between: an edge without aliasing."""
    x = (x / (2 * width) + 0.5).clamp(0, 1)
    return x * x * (3 - 2 * x)


def _triangle_wave(x: Tensor) -> Tensor:
    """Triangle wave of period 1 in [0, 1], 0 at integers."""
    return 1 - (2 * (x - x.floor()) - 1).abs()


def _blend(a: _Colour | Tensor, b: _Colour | Tensor, weight: Tensor) -> Tensor:
    """Blend of two colours or pictures by a (SIZE, SIZE) weight."""
    a, b = torch.as_tensor(a), torch.as_tensor(b)
    return a + (b - a) * weight[..., None]


def _draw_pigment(g: Generator) -> Tensor:
    """Random colour of the palette, slightly lighter or darker."""
    choice, tone = torch.rand(2, generator=g).tolist()
    return torch.tensor(_PALETTE[int(choice * len(_PALETTE))]) * (0.85 + 0.3 * tone)


def _cell_noise(g: Generator, row: Tensor, column: Tensor, n: tuple[int, int]) -> Tensor:
    """A random number per (row, column) cell, for every texel."""
    table = torch.rand(n, generator=g)
    return table[row.long() % n[0], column.long() % n[1]]


def _plaster(g: Generator) -> Tensor:
    return _blend((0.955, 0.955, 0.955), (0.975, 0.975, 0.975), _fractal_noise(g, 3, 3))


def _brick(g: Generator) -> Tensor:
    u, v = _texture_uv()
    rows, columns = 24, 8
    y = v * rows
    x = u * columns + 0.5 * (y.floor() % 2)
    gap = torch.minimum(_triangle_wave(x) / columns, _triangle_wave(y) / rows) * 0.5
    wobble = _fractal_noise(g, 32, 3)
    inside = _smooth_step(gap - 0.0045 - 0.003 * wobble, 0.003)
    shade = _cell_noise(g, y.floor(), x.floor(), (rows, columns))
    brick = _blend((0.50, 0.27, 0.22), (0.80, 0.50, 0.38), shade) * (0.70 + 0.55 * _fractal_noise(g, 24, 4))[..., None]
    return _blend((0.78, 0.75, 0.70), brick, inside)


def _planks(g: Generator) -> Tensor:
    u, v = _texture_uv()
    n = 8
    x = u * n
    row = x.floor()
    y = v * 2 + _cell_noise(g, row, row * 0, (n, 1))
    gap = torch.minimum(_triangle_wave(x) / n, _triangle_wave(y) / 2) * 0.5
    tone = _cell_noise(g, row, y.floor() % 2, (n, 2))
    wood = _wood(g) * (0.72 + 0.4 * tone)[..., None]
    return _blend((0.20, 0.13, 0.09), wood, _smooth_step(gap - 0.002, 0.0015))


def _wood(g: Generator) -> Tensor:
    u, _ = _texture_uv()
    warp = _periodic_noise(g, (TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), (2, 6))
    rings = _triangle_wave(u * 10 + 2.5 * warp)
    grain = _fractal_noise(g, 8, 4, stretch=16)
    light = 0.25 * rings + 0.75 * grain
    return _blend((0.40, 0.25, 0.15), (0.86, 0.64, 0.43), light * 1.25 - 0.1)


def _carpet(g: Generator) -> Tensor:
    u, v = _texture_uv()
    a, b = (u - 0.5).abs(), (v - 0.5).abs()
    edge = torch.maximum(a, b)
    base = _blend((0.45, 0.12, 0.14), (0.62, 0.20, 0.18), _fractal_noise(g, 16, 3))
    lattice = _triangle_wave(u * 8 + v * 8) * _triangle_wave(u * 8 - v * 8)
    base = _blend(base, (0.90, 0.78, 0.55), _smooth_step(lattice - 0.55, 0.04))
    petals = _triangle_wave((u * u + v * v) * 24) * _triangle_wave(u * 12) * _triangle_wave(v * 12)
    base = _blend(base, (0.15, 0.22, 0.38), _smooth_step(petals - 0.38, 0.04))
    medallion = _smooth_step(0.25 - a - b, 0.006)
    base = _blend(
        base,
        _blend((0.14, 0.2, 0.36), (0.85, 0.70, 0.48), _smooth_step(_triangle_wave((a + b) * 22) - 0.6, 0.08)),
        medallion,
    )
    border = _smooth_step(edge - 0.40, 0.004)
    pattern = _triangle_wave(u * 24) * _triangle_wave(v * 24) - 0.30
    base = _blend(base, _blend((0.13, 0.18, 0.32), (0.88, 0.74, 0.52), _smooth_step(pattern, 0.06)), border)
    return base * (0.70 + 0.45 * _fractal_noise(g, 96, 2))[..., None]


def _wallpaper(g: Generator) -> Tensor:
    u, v = _texture_uv()
    n = 8
    stripe = _smooth_step(_triangle_wave(u * n) - 0.5, 0.06)
    row = (v * 2 * n).floor()
    column = (u * n).floor()
    size = 0.20 + 0.30 * _cell_noise(g, row, column, (2 * n, n))
    x, y = u * n - column - 0.5, v * 2 * n - row - 0.5
    leaf = _smooth_step(size - x.abs() * 2 - y.abs(), 0.05)
    base = _blend((0.60, 0.68, 0.66), (0.72, 0.79, 0.75), stripe)
    return _blend(base, (0.30, 0.45, 0.44), leaf) * (0.88 + 0.2 * _fractal_noise(g, 64, 2))[..., None]


def _fabric(g: Generator) -> Tensor:
    u, v = _texture_uv()
    weave = 0.5 * _triangle_wave(u * 64) + 0.5 * _triangle_wave(v * 64)
    plaid = _smooth_step(_triangle_wave(u * 4) - 0.82, 0.05) + _smooth_step(_triangle_wave(v * 4) - 0.82, 0.05)
    light = 0.55 + 0.15 * weave + 0.30 * _fractal_noise(g, 12, 4) - 0.16 * plaid
    return light[..., None].expand(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX, 3)


def _poster(g: Generator) -> Tensor:
    """Overlapping discs and bars, from large to small, between two background colours."""
    u, v = _texture_uv()
    picture = _blend(_draw_pigment(g), _draw_pigment(g), v * 0.7 + 0.3 * _fractal_noise(g, 4, 3))
    for k in range(24):
        cx, cy, rx, ry, slant = torch.rand(5, generator=g).tolist()
        size = 0.30 / (1 + 0.22 * k)
        rx, ry, slant = size * (0.4 + rx), size * (0.4 + ry), slant - 0.5
        # Paint only the bounding box of the shape.
        box = tuple(
            slice(max(0, int((c - 0.8 * size * 2) * TEXTURE_SIZE_PX)), int((c + 0.8 * size * 2) * TEXTURE_SIZE_PX))
            for c in (cy, cx)
        )
        du, dv = u[box] - cx, v[box] - cy
        x, y = (du + slant * dv) / rx, (dv - slant * du) / ry
        edge = (x * x + y * y).sqrt() if k % 2 else torch.maximum(x.abs(), y.abs())
        picture[box] = _blend(picture[box], _draw_pigment(g), 0.92 * _smooth_step(1 - edge, 0.004 / min(rx, ry)))
    picture = picture * (0.55 + 0.85 * _fractal_noise(g, 12, 4))[..., None]
    return _blend(
        (0.93, 0.92, 0.88),
        picture,
        _smooth_step(torch.minimum(_triangle_wave(u), _triangle_wave(v)) * 0.5 - 0.035, 0.003),
    )


def _landscape(g: Generator) -> Tensor:
    """Sky, hills, a few houses and trees: the view out of the window."""
    u, v = _texture_uv()
    cloud = _smooth_step(_fractal_noise(g, 4, 5) - 0.55, 0.12)
    picture = _blend(_blend((0.62, 0.80, 1.0), (0.93, 0.97, 1.0), v), (1.0, 1.0, 1.0), cloud * 0.8)
    for k, colour in enumerate(((0.66, 0.76, 0.82), (0.50, 0.66, 0.50), (0.38, 0.58, 0.32))):
        line = _periodic_noise(g, (1, TEXTURE_SIZE_PX), (1, 5 + 4 * k))
        hill = _smooth_step(v - 0.50 - 0.10 * k + 0.20 * (line - 0.5), 0.004)
        picture = _blend(picture, torch.tensor(colour) * (0.75 + 0.5 * _fractal_noise(g, 32, 3))[..., None], hill)
    for _ in range(7):
        cx, cy, size, tone = torch.rand(4, generator=g).tolist()
        cy, size = 0.68 + 0.22 * cy, 0.04 + 0.05 * size
        wall = _smooth_step(size - torch.maximum((u - cx).abs(), (v - cy).abs()), 0.002)
        roof = _smooth_step(
            size * 1.3 - (u - cx).abs() - 1.4 * (cy - size - v).clamp(min=0) - 9 * (v - cy + size).clamp(min=0), 0.003
        )
        panes = _smooth_step(_triangle_wave((u - cx) / size) * _triangle_wave((v - cy) / size) - 0.45, 0.05)
        picture = _blend(picture, _blend((0.95, 0.90, 0.80), (0.35, 0.40, 0.48), panes), wall)
        picture = _blend(picture, (0.45 + 0.3 * tone, 0.25, 0.2), roof)
    return picture


def _page(g: Generator) -> Tensor:
    """Two columns of print, a headline and a picture."""
    u, v = _texture_uv()
    lines = 36
    row = (v * lines).floor()
    word = _cell_noise(g, row, (u * 30).floor(), (lines, 30)) > 0.22
    printed = word & (_triangle_wave(u * 2) > 0.12)
    ink = torch.where(printed, _smooth_step(_triangle_wave(v * lines) - 0.45, 0.12), 0.0)
    ink = ink * (0.35 + 0.65 * _periodic_noise(g, (TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), (128, 200)))
    page = _blend((0.94, 0.93, 0.90), (0.18, 0.18, 0.20), ink)
    head = _smooth_step(_periodic_noise(g, (TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), (24, 64)) - 0.5, 0.05)
    top = (v < 0.14) & (_triangle_wave(u) > 0.08)
    page = _blend(page, _blend((0.94, 0.93, 0.90), (0.08, 0.08, 0.10), head), top.float())
    photo = ((u > 0.55) & (u < 0.93) & (v > 0.22) & (v < 0.52)).float()
    return _blend(
        page, _blend(_draw_pigment(g), _draw_pigment(g), _smooth_step(_fractal_noise(g, 6, 4) - 0.5, 0.05)), photo
    )


def _spine(g: Generator) -> Tensor:
    """A book's back or cover, to be tinted: bands, a title block, wear."""
    u, v = _texture_uv()
    cover = 0.62 + 0.30 * _fractal_noise(g, 10, 4)
    bands = _smooth_step(_triangle_wave(v * 3 + 0.12) - 0.90, 0.03)
    title = _smooth_step(0.30 - (u - 0.5).abs(), 0.02) * _smooth_step(0.17 - (v - 0.36).abs(), 0.01)
    print_ = _smooth_step(_fractal_noise(g, 14, 2) - 0.52, 0.04)
    cover = _blend(cover[..., None].expand(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX, 3), (1.0, 0.92, 0.62), bands)
    return _blend(cover, _blend((1.0, 0.97, 0.86), (0.15, 0.13, 0.12), print_), title)


def _keyboard(g: Generator) -> Tensor:
    u, v = _texture_uv()
    x, y = u * 14, v * 8
    board = (v < 0.62) & (_triangle_wave(u) > 0.07)
    key = torch.where(board, _smooth_step(torch.minimum(_triangle_wave(x), _triangle_wave(y)) - 0.22, 0.08), 0.0)
    glyph = _smooth_step(_fractal_noise(g, 48, 2) - 0.56, 0.03) * key
    base = _blend((0.66, 0.67, 0.69), (0.20, 0.20, 0.22), key)
    pad = _smooth_step(0.13 - (u - 0.5).abs(), 0.004) * _smooth_step(0.13 - (v - 0.81).abs(), 0.004)
    return _blend(_blend(base, (0.85, 0.85, 0.85), glyph), (0.55, 0.56, 0.58), pad)


def _globe(g: Generator) -> Tensor:
    relief = _fractal_noise(g, 5, 5)
    land = _smooth_step(relief - 0.50, 0.012)
    soil = _blend((0.30, 0.50, 0.22), (0.86, 0.76, 0.50), (relief * 5 - 2.5).clamp(0, 1))
    u, v = _texture_uv()
    grid = torch.maximum(
        _smooth_step(_triangle_wave(u * 8) - 0.94, 0.03), _smooth_step(_triangle_wave(v * 8) - 0.94, 0.03)
    )
    return _blend(_blend((0.20, 0.42, 0.66), soil, land), (0.95, 0.95, 0.90), grid * 0.6)


def _leaves(g: Generator) -> Tensor:
    shape = _smooth_step(_fractal_noise(g, 36, 3) - 0.48, 0.08)
    return _blend((0.08, 0.18, 0.08), (0.50, 0.68, 0.30), shape * (0.4 + 0.6 * _fractal_noise(g, 24, 3)))


def _speckle(g: Generator) -> Tensor:
    dots = _smooth_step(_fractal_noise(g, 40, 2) - 0.60, 0.03)
    return _blend(_blend((0.82, 0.78, 0.72), (0.95, 0.92, 0.88), _fractal_noise(g, 4, 3)), (0.32, 0.28, 0.26), dots)


def _print(g: Generator) -> Tensor:
    """Printed cloth: random patches of paint on cream, at several scales."""
    cloth = _blend((0.86, 0.82, 0.72), (0.76, 0.72, 0.62), _fractal_noise(g, 5, 3))
    for cells, share in ((6, 0.60), (6, 0.62), (10, 0.64), (16, 0.66), (28, 0.68)):
        patch = _smooth_step(
            _periodic_noise(g, (TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), (cells, cells)) - share, 0.5 / cells
        )
        cloth = _blend(cloth, _draw_pigment(g), patch * 0.7)
    return cloth * (0.60 + 0.75 * _fractal_noise(g, 20, 4))[..., None]


def _plain(g: Generator) -> Tensor:
    return _blend((0.90, 0.90, 0.90), (1.0, 1.0, 1.0), _fractal_noise(g, 8, 4))


_PAINTERS: dict[str, _Painter] = {
    "plaster": _plaster,
    "brick": _brick,
    "planks": _planks,
    "wood": _wood,
    "carpet": _carpet,
    "wallpaper": _wallpaper,
    "fabric": _fabric,
    "poster": _poster,
    "landscape": _landscape,
    "page": _page,
    "spine": _spine,
    "keyboard": _keyboard,
    "globe": _globe,
    "leaves": _leaves,
    "speckle": _speckle,
    "print": _print,
    "plain": _plain,
}
