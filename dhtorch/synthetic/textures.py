"""Procedural, tileable textures of the built-in room.

An image is a (SIZE, SIZE, 3) tensor of display values (about the square root of reflectance) in [0, 1]. A painter
depends on the room's generator alone, so a seed determines all images. Detail has several scales: large shapes for
coarse pyramid levels, grain of a few texels for the finest.

Alphabet: ``u`` right and ``v`` down, in [0, 1) over the tile. Only correctly rounded arithmetic is used (no sine, no
logarithm): the result does not depend on the number of threads.
"""

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
_Painter = Callable[[Generator, Tensor, Tensor], Tensor]  # generator, u and v (SIZE, SIZE) -> (SIZE, SIZE, 3)


def paint_textures(names: list[str], generator: Generator) -> Tensor:
    """(len(names), SIZE, SIZE, 3) images in [0, 1]; a name such as ``poster:2`` is the third poster."""
    position = (torch.arange(TEXTURE_SIZE_PX) + 0.5) / TEXTURE_SIZE_PX
    v, u = torch.meshgrid(position, position, indexing="ij")
    return torch.stack([_PAINTERS[name.partition(":")[0]](generator, u, v).clamp(0, 1) for name in names])


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


def _shaded(image: Tensor, base: float, gain: float, noise: Tensor) -> Tensor:
    """Image times ``base + gain · noise``."""
    return image * (base + gain * noise)[..., None]


def _grain(g: Generator, cells: tuple[int, int]) -> Tensor:
    return _periodic_noise(g, (TEXTURE_SIZE_PX, TEXTURE_SIZE_PX), cells)


def _brick(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    y = v * 24
    x = u * 8 + 0.5 * (y.floor() % 2)
    gap = torch.minimum(_triangle_wave(x) / 8, _triangle_wave(y) / 24) * 0.5
    inside = _smooth_step(gap - 0.0045 - 0.003 * _fractal_noise(g, 32, 3), 0.003)
    brick = _blend((0.50, 0.27, 0.22), (0.80, 0.50, 0.38), _cell_noise(g, y.floor(), x.floor(), (24, 8)))
    return _blend((0.78, 0.75, 0.70), _shaded(brick, 0.70, 0.55, _fractal_noise(g, 24, 4)), inside)


def _planks(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    x = u * 8
    row = x.floor()
    y = v * 2 + _cell_noise(g, row, row * 0, (8, 1))
    gap = torch.minimum(_triangle_wave(x) / 8, _triangle_wave(y) / 2) * 0.5
    tone = _cell_noise(g, row, y.floor() % 2, (8, 2))
    return _blend((0.20, 0.13, 0.09), _shaded(_wood(g, u, v), 0.72, 0.4, tone), _smooth_step(gap - 0.002, 0.0015))


def _wood(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    light = 0.25 * _triangle_wave(u * 10 + 2.5 * _grain(g, (2, 6))) + 0.75 * _fractal_noise(g, 8, 4, stretch=16)
    return _blend((0.40, 0.25, 0.15), (0.86, 0.64, 0.43), light * 1.25 - 0.1)


def _carpet(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    """A ground with a lattice, petals, a medallion and a border, each (weight, its colour or image)."""
    a, b, wave = (u - 0.5).abs(), (v - 0.5).abs(), _triangle_wave
    image = _blend((0.45, 0.12, 0.14), (0.62, 0.20, 0.18), _fractal_noise(g, 16, 3))
    lattice = wave(u * 8 + v * 8) * wave(u * 8 - v * 8)
    petals = wave((u * u + v * v) * 24) * wave(u * 12) * wave(v * 12)
    rings = _smooth_step(wave((a + b) * 22) - 0.6, 0.08)
    pattern = _smooth_step(wave(u * 24) * wave(v * 24) - 0.30, 0.06)
    for colour, weight in (
        ((0.90, 0.78, 0.55), _smooth_step(lattice - 0.55, 0.04)),
        ((0.15, 0.22, 0.38), _smooth_step(petals - 0.38, 0.04)),
        (_blend((0.14, 0.2, 0.36), (0.85, 0.70, 0.48), rings), _smooth_step(0.25 - a - b, 0.006)),
        (_blend((0.13, 0.18, 0.32), (0.88, 0.74, 0.52), pattern), _smooth_step(torch.maximum(a, b) - 0.40, 0.004)),
    ):
        image = _blend(image, colour, weight)
    return _shaded(image, 0.70, 0.45, _fractal_noise(g, 96, 2))


def _wallpaper(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    row, column = (v * 16).floor(), (u * 8).floor()
    size = 0.20 + 0.30 * _cell_noise(g, row, column, (16, 8))
    leaf = _smooth_step(size - (u * 8 - column - 0.5).abs() * 2 - (v * 16 - row - 0.5).abs(), 0.05)
    stripe = _blend((0.60, 0.68, 0.66), (0.72, 0.79, 0.75), _smooth_step(_triangle_wave(u * 8) - 0.5, 0.06))
    return _shaded(_blend(stripe, (0.30, 0.45, 0.44), leaf), 0.88, 0.2, _fractal_noise(g, 64, 2))


def _fabric(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    weave = 0.5 * _triangle_wave(u * 64) + 0.5 * _triangle_wave(v * 64)
    plaid = _smooth_step(_triangle_wave(u * 4) - 0.82, 0.05) + _smooth_step(_triangle_wave(v * 4) - 0.82, 0.05)
    light = 0.55 + 0.15 * weave + 0.30 * _fractal_noise(g, 12, 4) - 0.16 * plaid
    return light[..., None].expand(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX, 3)


def _poster(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    """Overlapping discs and bars, from large to small, between two background colours."""
    image = _blend(_draw_pigment(g), _draw_pigment(g), v * 0.7 + 0.3 * _fractal_noise(g, 4, 3))
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
        image[box] = _blend(image[box], _draw_pigment(g), 0.92 * _smooth_step(1 - edge, 0.004 / min(rx, ry)))
    frame = _smooth_step(torch.minimum(_triangle_wave(u), _triangle_wave(v)) * 0.5 - 0.035, 0.003)
    return _blend((0.93, 0.92, 0.88), _shaded(image, 0.55, 0.85, _fractal_noise(g, 12, 4)), frame)


def _landscape(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    """Sky, hills, a few houses and trees: the view out of the window."""
    cloud = _smooth_step(_fractal_noise(g, 4, 5) - 0.55, 0.12)
    image = _blend(_blend((0.62, 0.80, 1.0), (0.93, 0.97, 1.0), v), (1.0, 1.0, 1.0), cloud * 0.8)
    for k, colour in enumerate(((0.66, 0.76, 0.82), (0.50, 0.66, 0.50), (0.38, 0.58, 0.32))):
        line = _periodic_noise(g, (1, TEXTURE_SIZE_PX), (1, 5 + 4 * k))
        hill = _smooth_step(v - 0.50 - 0.10 * k + 0.20 * (line - 0.5), 0.004)
        image = _blend(image, _shaded(torch.tensor(colour), 0.75, 0.5, _fractal_noise(g, 32, 3)), hill)
    for _ in range(7):
        cx, cy, size, tone = torch.rand(4, generator=g).tolist()
        cy, size = 0.68 + 0.22 * cy, 0.04 + 0.05 * size
        across = (u - cx).abs()
        roof = size * 1.3 - across - 1.4 * (cy - size - v).clamp(min=0) - 9 * (v - cy + size).clamp(min=0)
        panes = _smooth_step(_triangle_wave((u - cx) / size) * _triangle_wave((v - cy) / size) - 0.45, 0.05)
        wall = _blend((0.95, 0.90, 0.80), (0.35, 0.40, 0.48), panes)
        image = _blend(image, wall, _smooth_step(size - torch.maximum(across, (v - cy).abs()), 0.002))
        image = _blend(image, (0.45 + 0.3 * tone, 0.25, 0.2), _smooth_step(roof, 0.003))
    return image


def _page(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    """Two columns of print, a headline and an image."""
    printed = (_cell_noise(g, (v * 36).floor(), (u * 30).floor(), (36, 30)) > 0.22) & (_triangle_wave(u * 2) > 0.12)
    ink = torch.where(printed, _smooth_step(_triangle_wave(v * 36) - 0.45, 0.12), 0.0)
    page = _blend((0.94, 0.93, 0.90), (0.18, 0.18, 0.20), ink * (0.35 + 0.65 * _grain(g, (128, 200))))
    head = _blend((0.94, 0.93, 0.90), (0.08, 0.08, 0.10), _smooth_step(_grain(g, (24, 64)) - 0.5, 0.05))
    page = _blend(page, head, ((v < 0.14) & (_triangle_wave(u) > 0.08)).float())
    photo = _blend(_draw_pigment(g), _draw_pigment(g), _smooth_step(_fractal_noise(g, 6, 4) - 0.5, 0.05))
    return _blend(page, photo, ((u > 0.55) & (u < 0.93) & (v > 0.22) & (v < 0.52)).float())


def _spine(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    """A book's back or cover, to be tinted: bands, a title block, wear."""
    cover = (0.62 + 0.30 * _fractal_noise(g, 10, 4))[..., None].expand(TEXTURE_SIZE_PX, TEXTURE_SIZE_PX, 3)
    cover = _blend(cover, (1.0, 0.92, 0.62), _smooth_step(_triangle_wave(v * 3 + 0.12) - 0.90, 0.03))
    title = _smooth_step(0.30 - (u - 0.5).abs(), 0.02) * _smooth_step(0.17 - (v - 0.36).abs(), 0.01)
    words = _smooth_step(_fractal_noise(g, 14, 2) - 0.52, 0.04)
    return _blend(cover, _blend((1.0, 0.97, 0.86), (0.15, 0.13, 0.12), words), title)


def _keyboard(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    is_board = (v < 0.62) & (_triangle_wave(u) > 0.07)
    edge = torch.minimum(_triangle_wave(u * 14), _triangle_wave(v * 8))
    key = torch.where(is_board, _smooth_step(edge - 0.22, 0.08), 0.0)
    pad = _smooth_step(0.13 - (u - 0.5).abs(), 0.004) * _smooth_step(0.13 - (v - 0.81).abs(), 0.004)
    board = _blend((0.66, 0.67, 0.69), (0.20, 0.20, 0.22), key)
    board = _blend(board, (0.85, 0.85, 0.85), _smooth_step(_fractal_noise(g, 48, 2) - 0.56, 0.03) * key)
    return _blend(board, (0.55, 0.56, 0.58), pad)


def _globe(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    relief = _fractal_noise(g, 5, 5)
    soil = _blend((0.30, 0.50, 0.22), (0.86, 0.76, 0.50), (relief * 5 - 2.5).clamp(0, 1))
    grid = torch.maximum(*(_smooth_step(_triangle_wave(x * 8) - 0.94, 0.03) for x in (u, v)))
    land = _blend((0.20, 0.42, 0.66), soil, _smooth_step(relief - 0.50, 0.012))
    return _blend(land, (0.95, 0.95, 0.90), grid * 0.6)


def _speckle(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    dots = _smooth_step(_fractal_noise(g, 40, 2) - 0.60, 0.03)
    return _blend(_blend((0.82, 0.78, 0.72), (0.95, 0.92, 0.88), _fractal_noise(g, 4, 3)), (0.32, 0.28, 0.26), dots)


def _print(g: Generator, u: Tensor, v: Tensor) -> Tensor:
    """Printed cloth: random patches of paint on cream, at several scales."""
    cloth = _blend((0.86, 0.82, 0.72), (0.76, 0.72, 0.62), _fractal_noise(g, 5, 3))
    for cells, bare in ((6, 0.60), (6, 0.62), (10, 0.64), (16, 0.66), (28, 0.68)):
        patch = _smooth_step(_grain(g, (cells, cells)) - bare, 0.5 / cells)
        cloth = _blend(cloth, _draw_pigment(g), patch * 0.7)
    return _shaded(cloth, 0.60, 0.75, _fractal_noise(g, 20, 4))


_PAINTERS: dict[str, _Painter] = {
    "plaster": lambda g, u, v: _blend((0.955, 0.955, 0.955), (0.975, 0.975, 0.975), _fractal_noise(g, 3, 3)),
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
    "leaves": lambda g, u, v: _blend(
        (0.08, 0.18, 0.08),
        (0.50, 0.68, 0.30),
        _smooth_step(_fractal_noise(g, 36, 3) - 0.48, 0.08) * (0.4 + 0.6 * _fractal_noise(g, 24, 3)),
    ),
    "speckle": _speckle,
    "print": _print,
    "plain": lambda g, u, v: _blend((0.90, 0.90, 0.90), (1.0, 1.0, 1.0), _fractal_noise(g, 8, 4)),
}
