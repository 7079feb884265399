"""The built-in furnished room: its solids, materials and lights.

World axes as a camera's: x right, y down, z forward, the floor at y = 0. Helpers take heights above the floor. A viewer
stands at about (-0.45, 1.3 m up, 0.2) and looks along z. Within 2 m of it a low shelf of drawers and books divides the
room, with a plant, a globe, a picture and a laptop on it; beyond it an armchair, a sofa under the window on the right,
and along the brick wall a bookcase, a sideboard with a screen, a picture and a mirror. The other walls are blank or
papered. The seed decides paint, tint and small placements.

Surfaces that face the viewer have texture at several scales, where window-based trackers are accurate. Slanted and
plain boards are white. That near surfaces are easy to track is a property of this room, not of rooms in general.
"""

import math
from functools import lru_cache
from random import Random

from dhtorch.synthetic.paths import rotation_from_angles
from dhtorch.synthetic.raycast import SURFACE_DARK, SURFACE_MIRROR, SURFACE_WINDOW, Material, Solid, Triple
from dhtorch.synthetic.shading import Light, ShadedRoom

ROOM_LEFT_M, ROOM_RIGHT_M, ROOM_FRONT_M, ROOM_BACK_M, _ROOM_HEIGHT_M = (
    -2.6,
    2.1,
    -0.5,
    4.4,
    2.6,
)  #: walls and ceiling, m
_FACE_NEG_X, _FACE_POS_X, _FACE_TOP, _FACE_BOTTOM, _FACE_NEG_Z, _FACE_POS_Z = range(
    6
)  # faces by outward normal; up is -y
_LAMP_CENTRE = (-0.15, 1.98, 3.1)  #: middle of the lampshade: x, height, z

_BLANK_WALL = Material("plaster", (0.93, 0.91, 0.86), 2.0)
_PALE_WOOD = Material("wood", (1.15, 1.15, 1.12), 0.8)
_WHITE_PAINT = Material("plain", (0.88, 0.87, 0.84), 0.6)
_OAK_WOOD = Material("wood", (0.72, 0.66, 0.62), 0.7)
_BLACK_PLASTIC = Material("plain", (0.13, 0.13, 0.14), 0.5, kind=SURFACE_DARK)
_MIRROR_GLASS = Material("plain", (0.8, 0.85, 0.85), kind=SURFACE_MIRROR, reflect=0.93)
_SCREEN_GLASS = Material("plain", (0.07, 0.07, 0.08), 0.5, kind=SURFACE_DARK, reflect=0.06)

_BOOK_COLOURS: tuple[Triple, ...] = (
    (0.62, 0.22, 0.18),
    (0.22, 0.32, 0.50),
    (0.24, 0.42, 0.32),
    (0.80, 0.66, 0.40),
    (0.85, 0.82, 0.74),
    (0.30, 0.28, 0.28),
    (0.55, 0.38, 0.28),
    (0.42, 0.54, 0.60),
)


@lru_cache(maxsize=2)
def furnished_room(seed: int = 2) -> ShadedRoom:
    """The furnished room of a seed, shaded; cached for the last two seeds."""
    draw = Random(seed)
    size = (ROOM_RIGHT_M - ROOM_LEFT_M, _ROOM_HEIGHT_M, ROOM_BACK_M - ROOM_FRONT_M)
    faces = {
        _FACE_TOP: Material("plaster", (0.97, 0.96, 0.93), 2.0),
        _FACE_BOTTOM: Material("planks", tile=1.3),
        _FACE_POS_Z: Material("brick", tile=2.0),
        _FACE_NEG_Z: Material("wallpaper", tile=1.6),
        _FACE_NEG_X: _BLANK_WALL,
        _FACE_POS_X: _BLANK_WALL,
    }
    solids = [
        make_box((ROOM_LEFT_M + ROOM_RIGHT_M) / 2, 0, (ROOM_BACK_M + ROOM_FRONT_M) / 2, size, _BLANK_WALL, faces=faces)
    ]
    for part in (_divider, _on_the_divider, _seats, _back_wall, _side_walls):
        solids += part(draw)
    window = Light(
        (ROOM_RIGHT_M - 0.03, -1.5, ROOM_BACK_M - 1.2), (0, 0, 0.55), (0, 0.5, 0), (-1, 0, 0), (2.9, 3.1, 3.4), (3, 4)
    )
    lamp = Light(
        (_LAMP_CENTRE[0], -_LAMP_CENTRE[1], _LAMP_CENTRE[2]),
        (0.12, 0, 0),
        (0, 0, 0.12),
        (0, 0, 0),
        (1.25, 1.08, 0.84),
        (2, 2),
    )
    ceiling = Light((-0.6, -_ROOM_HEIGHT_M + 0.02, 1.2), (0.4, 0, 0), (0, 0, 0.4), (0, 1, 0), (1.5, 1.4, 1.25), (3, 3))
    return ShadedRoom(solids, [window, lamp, ceiling], ambient=0.42, seed=seed)


def make_box(
    x: float,
    height: float,
    z: float,
    size: Triple,
    surface: Material,
    *,
    yaw: float = 0,
    pitch: float = 0,
    **more: object,
) -> Solid:
    """A box of ``size`` (x, up, z) whose lower side is ``height`` above the floor; angles in degrees."""
    R = tuple(map(tuple, rotation_from_angles(yaw, pitch, 0.0)))
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Solid((x, -height - half[1], z), half, surface, R, **more)  # type: ignore[arg-type]


def _make_ball(x: float, height: float, z: float, radius: float, surface: Material, **more: object) -> Solid:
    """A ball resting ``height`` above the floor."""
    return Solid((x, -height - radius, z), (radius, radius, radius), surface, ball=True, **more)  # type: ignore[arg-type]


def _legs(x: float, z: float, size: Triple, thick: float, surface: Material, yaw: float = 0) -> list[Solid]:
    """Four legs under a plate of ``size`` whose top is ``size[1]`` above the floor."""
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    legs = []
    for i in (-1, 1):
        for k in (-1, 1):
            dx, dz = i * (size[0] / 2 - thick), k * (size[2] / 2 - thick)
            legs.append(
                make_box(x + c * dx + s * dz, 0, z - s * dx + c * dz, (thick, size[1], thick), surface, yaw=yaw)
            )
    return legs


def _divider(draw: Random) -> list[Solid]:
    """A low open shelf across the view, with five bays of drawers, boxes and books, and the lamp behind it."""
    x0, z, pitch, top = -1.25, 1.95, 0.42, 0.86
    width = 5 * pitch
    parts = [make_box(x0 + width / 2, h, z, (width + 0.03, 0.03, 0.36), _WHITE_PAINT) for h in (0.03, 0.43, top - 0.03)]
    parts += [make_box(x0 + k * pitch, 0.03, z, (0.03, top - 0.06, 0.36), _WHITE_PAINT) for k in range(6)]
    parts.append(make_box(x0 + width / 2, 0.03, z + 0.175, (width, top - 0.06, 0.01), _WHITE_PAINT))
    fronts = ["print", "poster:0", "books", "wallpaper", "poster:2"]
    draw.shuffle(fronts)
    for row in (0.06, 0.46):
        for k, front in enumerate(fronts if row > 0.4 else reversed(fronts)):
            left = x0 + k * pitch + 0.015
            if front == "books":
                parts += _books(draw, left, left + pitch - 0.03, row, z, shortest=0.9)
            else:
                tile = 0.6 if front in ("print", "wallpaper") else None
                parts.append(
                    make_box(left + pitch / 2 - 0.015, row, z, (pitch - 0.04, 0.36, 0.34), Material(front, tile=tile))
                )
    shade = Material("print", (0.8, 0.75, 0.65), 0.5, glow=0.4)
    parts.append(
        make_box(
            _LAMP_CENTRE[0], _LAMP_CENTRE[1] + 0.17, _LAMP_CENTRE[2], (0.012, 1.0, 0.012), _BLACK_PLASTIC, shadow=False
        )
    )
    return [*parts, _make_ball(_LAMP_CENTRE[0], _LAMP_CENTRE[1] - 0.17, _LAMP_CENTRE[2], 0.17, shade, shadow=False)]


def _on_the_divider(draw: Random) -> list[Solid]:
    top, x, z = 0.86, -0.2, 1.95
    return [
        *_plant(x - 0.92, top, z + 0.05, 1.1),
        make_box(x - 0.56, top, z + 0.02, (0.09, 0.03, 0.09), _OAK_WOOD, yaw=10),
        _make_ball(x - 0.56, top + 0.03, z + 0.02, 0.14, Material("globe", tile=0.36)),
        make_box(x - 0.10, top, z + 0.07, (0.30, 0.36, 0.07), Material("poster:1"), yaw=draw.uniform(4, 14)),
        *_laptop(x + 0.42, top, z - 0.03),
        _make_ball(x - 0.40, top, z - 0.06, 0.04, Material("speckle", (1.0, 0.55, 0.15), 0.25)),
        _make_ball(x - 0.46, top, z - 0.12, 0.042, Material("speckle", (0.9, 0.2, 0.15), 0.25)),
    ]


def _laptop(x: float, height: float, z: float) -> list[Solid]:
    case = Material("plain", (0.7, 0.7, 0.72))
    picture = Material("poster:0", (0.9, 0.9, 0.9), glow=0.12)
    lid, keys, screen = (
        (x + 0.045, height + 0.015, z + 0.125),
        {_FACE_TOP: Material("keyboard")},
        {_FACE_NEG_Z: picture},
    )
    return [
        make_box(x, height, z, (0.35, 0.018, 0.23), case, yaw=-18, faces=keys),
        make_box(*lid, (0.35, 0.24, 0.012), _SCREEN_GLASS, yaw=-18, pitch=-14, faces=screen),
    ]


def _plant(x: float, height: float, z: float, size: float) -> list[Solid]:
    """A plant: a pot with a bush of four balls."""
    leaf = Material("leaves", tile=0.25)
    pot = Material("speckle")
    bush = ((0, 0, 0.10), (-0.06, -0.03, 0.07), (0.05, 0.04, 0.075), (0.02, -0.06, 0.06))
    balls = [
        _make_ball(x + size * dx, height + size * (0.15 + 0.045 * k), z + size * dz, size * r, leaf)
        for k, (dx, dz, r) in enumerate(bush)
    ]
    return [make_box(x, height, z, (0.10 * size, 0.16 * size, 0.10 * size), pot, yaw=30), *balls]


def _chair(x: float, z: float, yaw: float, surface: Material) -> list[Solid]:
    """A wooden chair whose back stands on its local +z side."""
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))

    def at(dx: float, dz: float) -> tuple[float, float]:
        return x + c * dx + s * dz, z - s * dx + c * dz

    cover = Material("print", (1.0, 0.95, 0.9), 0.55)
    parts = [
        make_box(x, 0.43, z, (0.44, 0.05, 0.44), cover, yaw=yaw),
        *_legs(x, z, (0.44, 0.43, 0.44), 0.04, surface, yaw),
    ]
    for dx in (-0.21, 0.21):
        px, pz = at(dx, 0.2)
        parts.append(make_box(px, 0.47, pz, (0.04, 0.54, 0.03), surface, yaw=yaw))
    px, pz = at(0, 0.2)
    return [*parts, make_box(px, 0.56, pz, (0.385, 0.43, 0.045), cover, yaw=yaw)]


def _seats(draw: Random) -> list[Solid]:
    cushion, sofa = Material("fabric", (0.50, 0.62, 0.72), 0.6), Material("fabric", (0.62, 0.66, 0.58), 0.8)
    x, z = ROOM_RIGHT_M - 0.47, ROOM_BACK_M - 1.2
    parts = [
        make_box(x, 0.10, z, (0.85, 0.32, 1.7), sofa),
        make_box(ROOM_RIGHT_M - 0.16, 0.30, z, (0.22, 0.50, 1.7), sofa),
        make_box(x, 0.10, z - 0.9, (0.88, 0.50, 0.18), sofa),
        make_box(x, 0.10, z + 0.9, (0.88, 0.50, 0.18), sofa),
        make_box(x + 0.12, 0.44, z + 0.55, (0.14, 0.38, 0.40), Material("carpet"), yaw=20, pitch=8),
        make_box(x + 0.10, 0.44, z - 0.45, (0.14, 0.36, 0.38), Material("print", (1.0, 0.75, 0.65), 0.5), yaw=-25),
        make_box(0.0, 0.001, 3.0, (2.0, 0.012, 1.5), Material("carpet"), yaw=3),
        make_box(0.35, 0.36, 3.1, (0.85, 0.04, 0.5), _PALE_WOOD, yaw=8),
        *_legs(0.35, 3.1, (0.85, 0.36, 0.5), 0.05, _PALE_WOOD, 8),
        make_box(0.25, 0.40, 3.1, (0.21, 0.012, 0.28), Material("page"), yaw=-30),
        _make_ball(0.58, 0.40, 3.15, 0.09, Material("speckle", tile=0.3)),
    ]
    x, z, yaw = -1.75, 3.2, draw.uniform(55, 68)
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    parts += [
        make_box(x, 0.08, z, (0.72, 0.34, 0.72), cushion, yaw=yaw),
        make_box(x - 0.33 * s, 0.30, z - 0.33 * c, (0.72, 0.55, 0.16), cushion, yaw=yaw),
        make_box(x + 0.38 * c, 0.08, z - 0.38 * s, (0.14, 0.54, 0.72), cushion, yaw=yaw),
        make_box(x - 0.38 * c, 0.08, z + 0.38 * s, (0.14, 0.54, 0.72), cushion, yaw=yaw),
    ]
    return parts + _chair(-1.0, 2.6, draw.uniform(-60, -40), _OAK_WOOD)


def _back_wall(draw: Random) -> list[Solid]:
    z = ROOM_BACK_M
    x0, x1, top = -2.15, -0.95, 2.05
    parts = [make_box((x0 + x1) / 2, 0, z - 0.015, (x1 - x0, top, 0.02), _OAK_WOOD)]
    parts += [make_box(x, 0, z - 0.16, (0.03, top, 0.30), _OAK_WOOD) for x in (x0, (x0 + x1) / 2, x1)]
    shelves = (0.06, 0.46, 0.86, 1.26, 1.66, 2.03)
    parts += [make_box((x0 + x1) / 2, h, z - 0.16, (x1 - x0, 0.03, 0.30), _OAK_WOOD) for h in shelves]
    for h in shelves[:-1]:
        for left in (x0 + 0.03, (x0 + x1) / 2 + 0.03):
            parts += _books(draw, left, left + 0.53, h + 0.03, z - 0.15)
    x = 0.15
    parts += [
        make_box(x, 0.08, z - 0.22, (1.5, 0.50, 0.40), _WHITE_PAINT),
        make_box(x, 0.10, z - 0.43, (0.015, 0.46, 0.02), _OAK_WOOD),
        make_box(x, 0.72, z - 0.06, (1.15, 0.66, 0.05), _BLACK_PLASTIC, faces={_FACE_NEG_Z: _SCREEN_GLASS}),
        make_box(x - 0.55, 0.58, z - 0.25, (0.13, 0.18, 0.12), Material("speckle", (0.6, 0.8, 0.9), 0.3), yaw=20),
        _make_ball(x - 0.55, 0.74, z - 0.25, 0.13, Material("leaves", tile=0.4)),
        make_box(x + 0.58, 0.58, z - 0.22, (0.16, 0.22, 0.02), Material("poster:3"), yaw=-12, pitch=-8),
        make_box(x, 1.60, z - 0.02, (0.85, 0.60, 0.03), Material("landscape", (0.85, 0.8, 0.75))),
        make_box(1.38, 0.80, z - 0.025, (0.66, 1.16, 0.03), _PALE_WOOD),
        make_box(1.38, 0.84, z - 0.043, (0.58, 1.08, 0.01), _PALE_WOOD, faces={_FACE_NEG_Z: _MIRROR_GLASS}),
        make_box(1.89, 1.55, z - 0.02, (0.30, 0.42, 0.03), Material("poster:2")),
    ]
    return parts


def _books(draw: Random, left: float, right: float, height: float, z: float, *, shortest: float = 0.64) -> list[Solid]:
    """Upright books, at most 33 cm tall, from left to right until the board is full; backs 13 cm behind ``z``."""
    books: list[Solid] = []
    x = left
    stop = right - draw.uniform(0.0, 0.12)
    while True:
        width = draw.uniform(0.025, 0.06)
        book_height = draw.uniform(0.33 * shortest, 0.33)
        depth = draw.uniform(0.16, 0.24)
        if x + width > stop:
            return books
        base = draw.choice(_BOOK_COLOURS)
        tone = draw.uniform(0.75, 1.2)
        surface = Material("spine", (base[0] * tone, base[1] * tone, base[2] * tone))
        books.append(
            make_box(
                x + width / 2,
                height,
                z + 0.13 - depth / 2,
                (width - 0.003, book_height, depth),
                surface,
                shadow=False,
            )
        )
        x += width


def _side_walls(draw: Random) -> list[Solid]:
    x, z = ROOM_RIGHT_M, ROOM_BACK_M - 1.2
    pane = Material("landscape", (1.12, 1.12, 1.1), 1.7, kind=SURFACE_WINDOW, glow=0.9)
    frame = Material("plain", (0.95, 0.95, 0.94), 0.7)
    parts = [make_box(x - 0.005, 1.0, z, (0.012, 1.05, 1.2), frame, faces={_FACE_NEG_X: pane}, shadow=False)]
    for h, dz, size in (
        (0.94, 0, (0.10, 0.06, 1.36)),
        (2.05, 0, (0.06, 0.06, 1.32)),
        (0.98, -0.63, (0.06, 1.1, 0.06)),
        (0.98, 0.63, (0.06, 1.1, 0.06)),
        (0.98, 0, (0.05, 1.1, 0.05)),
    ):
        parts.append(make_box(x - 0.02, h, z + dz, size, frame))
    curtain = Material("fabric", (0.85, 0.72, 0.55), 0.5)
    for dz in (-0.98, -0.90, -0.82, 0.82, 0.90, 0.98):
        parts.append(
            make_box(
                x - 0.07, 0.55, z + dz, (0.05 + 0.03 * draw.random(), 1.70, 0.07), curtain, yaw=draw.uniform(-25, 25)
            )
        )
    for k, (pz, h) in enumerate(((0.6, 1.2), (1.7, 1.3), (3.0, 1.25))):
        parts.append(make_box(ROOM_LEFT_M + 0.02, h, pz, (0.03, 0.6, 0.5), Material(f"poster:{2 + k}")))
    parts += [
        make_box(1.3, 0, ROOM_FRONT_M + 0.02, (0.9, 2.05, 0.04), _PALE_WOOD),
        make_box(-0.6, 1.1, ROOM_FRONT_M + 0.02, (0.9, 0.7, 0.03), Material("poster:1")),
        make_box(-1.7, 0, ROOM_FRONT_M + 0.25, (1.0, 1.1, 0.45), _OAK_WOOD),
    ]
    return parts
