"""Ray casting of boxes and balls: nearest intersections, surface coordinates, normals and shadow casters.

Alphabet: ``o`` origin and ``d`` direction of rays, as triples of tensors or numbers that broadcast; ``t`` distance in
units of ``d`` (for a camera ray, whose z is 1, the z-depth); solid ``i``; face ``6 i + 2 axis + (outward normal
positive)``. Solid 0 is the room, seen from inside.

Only correctly rounded arithmetic and fixed summation orders are used, here and in all rendering: results do not depend
on the number of threads.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dhtorch.geometry.camera import Camera
from dhtorch.geometry.se3 import Pose

Triple = tuple[float, float, float]
_Vector = Sequence[Tensor] | Sequence[float] | Sequence[Tensor | float]  # three components that broadcast

SURFACE_ORDINARY, SURFACE_MIRROR, SURFACE_WINDOW, SURFACE_DARK, SURFACE_MOVING = (
    0,
    1,
    2,
    3,
    4,
)  #: kinds of surface; MOVING: of a moving body
_NO_HIT_M = 1e9  #: distance of rays without a hit

_RAYS_PER_CHUNK = 1 << 8  # rays cast at all solids at a time: few enough to stay in the cache


@dataclass(frozen=True)
class Material:
    """Appearance of a face, and its kind for the sensor model."""

    picture: str  #: name of a texture
    tint: Triple = (1.0, 1.0, 1.0)
    tile: float | None = None  #: m per repetition; None stretches one copy over the face
    kind: int = SURFACE_ORDINARY
    reflect: float = 0.0  #: fraction of the colour from the mirrored ray
    glow: float = 0.0  #: emitted light, in units of the picture


@dataclass(frozen=True)
class Solid:
    """A box, or the ball inside a cube. ``faces`` overrides the surface of single faces ``2 axis + positive``."""

    centre: Triple
    half: Triple
    surface: Material
    R: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  #: world from local
    ball: bool = False
    shadow: bool = True
    faces: dict[int, Material] = field(default_factory=dict)

    def moved(self, motion: Pose) -> "Solid":
        """The solid after a rigid motion (1) of the world."""
        turn, centre = torch.tensor(self.R, dtype=torch.float64), torch.tensor(self.centre, dtype=torch.float64)
        R, t = motion.R[0].double(), motion.t[0].double()
        rows: list[Triple] = [(a, b, c) for a, b, c in (R @ turn).tolist()]
        x, y, z = (R @ centre + t).tolist()
        return replace(self, centre=(x, y, z), R=(rows[0], rows[1], rows[2]))


class Solids:
    """Solids for ray casting, batched."""

    def __init__(self, solids: Sequence[Solid]):
        self.each = tuple(solids)
        self.centre = torch.tensor([s.centre for s in solids])
        self.half = torch.tensor([s.half for s in solids])
        self.R = torch.tensor([s.R for s in solids])
        self.ball = torch.tensor([s.ball for s in solids])
        self._square = torch.tensor([s.half[0] ** 2 for s in solids])  # of a ball's radius, rounded once

    def view(self, camera: Camera, T_world_from_cam: Pose, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """z-depth (H·W,) and solid index (H·W,) at the pixel centres of one camera (B = 1).

        Each solid is tested only in the rectangle of pixels that its corners span.
        """
        x, y = _image_plane(camera, hw)
        R, o = T_world_from_cam.R[0].double(), T_world_from_cam.t[0].double()
        t = torch.full(hw, _NO_HIT_M)
        index = torch.zeros(hw, dtype=torch.int64)
        rectangles = _solid_rectangles(self, R, o, x, y)
        rectangles[0] = (slice(None), slice(None))
        for i, (solid, (rows, columns)) in enumerate(zip(self.each, rectangles, strict=True)):
            xs, ys = x[None, columns], y[rows, None]
            if xs.numel() and ys.numel():
                local = torch.tensor(solid.R, dtype=torch.float64).T
                A = (local @ R).tolist()
                origin = (local @ (o - torch.tensor(solid.centre, dtype=torch.float64))).tolist()
                d = [(xs * A[k][0] + A[k][2]) + ys * A[k][1] for k in range(3)]
                _update_nearest(t[rows, columns], index[rows, columns], i, *_span(solid, origin, d))
        return t.flatten(), index.flatten()

    def cast(self, o: Sequence[Tensor], d: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Distance (P,) and solid index (P,) along arbitrary rays."""
        parts = [slice(k, k + _RAYS_PER_CHUNK) for k in range(0, max(o[0].numel(), 1), _RAYS_PER_CHUNK)]
        strips = [self._cast([c[s] for c in o], [c[s] for c in d]) for s in parts]
        return torch.cat([t for t, _ in strips]), torch.cat([index for _, index in strips])

    def _cast(self, o: list[Tensor], d: list[Tensor]) -> tuple[Tensor, Tensor]:
        """All solids against all rays at once; of solids hit at the same distance, the first."""
        centre, half = self.centre[..., None].unbind(1), self.half[..., None].unbind(1)
        o, d = _to_local(centre, [c.unbind(1) for c in self.R[..., None].unbind(2)], o, d)
        spans = zip(_ball_span(self._square[:, None], o, d), _box_span(half, o, d), strict=True)
        enter, leave, hit = (torch.where(self.ball[:, None], of_ball, of_box) for of_ball, of_box in spans)
        distance = torch.cat((leave[:1], enter[1:]))  # the room is hit on leaving it
        distance = torch.where(hit & (distance >= 0), distance, _NO_HIT_M)
        t = distance.amin(0).clamp(max=_NO_HIT_M)
        first = torch.where(distance == t, torch.arange(len(distance))[:, None], len(distance)).amin(0)
        return t, torch.where(t < _NO_HIT_M, first, 0)

    def locate(self, index: Tensor, p: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Face (P,) of points on solids, and their coordinates (P,), (P,) across and down the face in [-1, 1].

        A ball is mapped like the cube around it: its points are projected onto the cube.
        """
        centre, half, R = self.centre[index], self.half[index], self.R[index]
        rel = [p[k] - centre[:, k] for k in range(3)]
        x, y, z = (dot_product(rel, R[:, :, k].unbind(-1)) / half[:, k] for k in range(3))
        is_x = (x.abs() >= y.abs()) & (x.abs() >= z.abs())
        is_y = ~is_x & (y.abs() >= z.abs())
        main = torch.where(is_x, x, torch.where(is_y, y, z))
        axis = torch.where(is_x, 0, torch.where(is_y, 1, 2))
        reach = main.abs().clamp(min=1e-12)
        across, down = torch.where(is_x, z, x) / reach, torch.where(is_y, z, y) / reach
        return index * 6 + axis * 2 + torch.where(main > 0, 1, 0), across, down

    def points(self, face: Tensor, across: Tensor, down: Tensor) -> list[Tensor]:
        """The inverse of :meth:`locate`: three components (P,) of world points."""
        index, axis, sign = face // 6, (face % 6) // 2, (face % 2) * 2.0 - 1
        local = [
            torch.where(axis == 0, sign, across),
            torch.where(axis == 1, sign, down),
            torch.where(axis == 2, sign, torch.where(axis == 0, across, down)),
        ]
        shrink = torch.where(self.ball[index], 1 / dot_product(local, local).sqrt(), 1.0)
        half, R, centre = self.half[index], self.R[index], self.centre[index]
        local = [local[k] * half[:, k] * shrink for k in range(3)]
        return [centre[:, k] + dot_product(R[:, k].unbind(-1), local) for k in range(3)]

    def normal(self, face: Tensor, p: Sequence[Tensor]) -> list[Tensor]:
        """Unit normal towards the free space of the room, three components (P,)."""
        index, axis, sign = face // 6, (face % 6) // 2, (face % 2) * 2.0 - 1
        sign = torch.where(index == 0, -sign, sign)
        flat = self.R[index, :, axis] * sign[:, None]
        ball, radius, centre = self.ball[index], self.half[index, 0], self.centre[index]
        return [torch.where(ball, (p[k] - centre[:, k]) / radius, flat[:, k]) for k in range(3)]

    def blockers(
        self, p: Sequence[Tensor], reach: float, way: Sequence[Tensor] | None = None
    ) -> list[tuple[Solid, Tensor]]:
        """Shadow-casting solids, each with the indices of the points that it could shade.

        These are the points p (P,) with a part of the solid nearer than ``reach`` (m) to the point itself, or to the
        straight segment ``way`` (P,) from it.
        """
        blockers = []
        for solid in self.each[1:]:
            if solid.shadow:
                rel = [solid.centre[k] - p[k] for k in range(3)]
                if way is not None:
                    along = (dot_product(rel, way) / dot_product(way, way)).clamp(0, 1)
                    rel = [rel[k] - along * way[k] for k in range(3)]
                index = (dot_product(rel, rel) < (reach + math.hypot(*solid.half)) ** 2).nonzero()[:, 0]
                if index.numel():
                    blockers.append((solid, index))
        return blockers

    def open_distance(self, solid: Solid, o: Sequence[Tensor], d: Sequence[Tensor]) -> Tensor:
        """Distance (…) that rays travel before they enter ``solid``, at most 1; 0 for rays that start inside."""
        enter, leave, met = _span(solid, *_to_local(solid.centre, [*zip(*solid.R, strict=True)], o, d))
        if solid is self.each[0]:
            return leave.clamp(0, 1)
        return torch.where(met & (leave > 0), enter, 1.0).clamp(0, 1)


def dot_product(a: _Vector, b: _Vector) -> Tensor:
    """Scalar product of triples of components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # type: ignore[return-value]


def world_rays(camera: Camera, T_world_from_cam: Pose, hw: tuple[int, int]) -> tuple[list[Tensor], list[Tensor]]:
    """Origins and directions (z = 1 in the camera) through all pixel centres, three (H·W,) components each."""
    x, y = _image_plane(camera, hw)
    R, t = T_world_from_cam.R[0].tolist(), T_world_from_cam.t[0].tolist()
    d = [((x[None] * R[k][0] + R[k][2]) + y[:, None] * R[k][1]).flatten() for k in range(3)]
    return [torch.tensor(c, dtype=torch.float32).expand(d[0].shape) for c in t], d


def _span(solid: Solid, o: _Vector, d: _Vector) -> tuple[Tensor, Tensor, Tensor]:
    """Distances at which rays in the solid's own axes enter and leave it, and whether they hit it."""
    return _ball_span(solid.half[0] ** 2, o, d) if solid.ball else _box_span(solid.half, o, d)


def _ball_span(square: float | Tensor, o: _Vector, d: _Vector) -> tuple[Tensor, Tensor, Tensor]:
    a, b = dot_product(d, d), dot_product(o, d)
    under = b * b - a * (dot_product(o, o) - square)
    root = under.clamp(min=0).sqrt()
    return (-b - root) / a, (-b + root) / a, under > 0


def _box_span(half: _Vector, o: _Vector, d: _Vector) -> tuple[Tensor, Tensor, Tensor]:
    enters, leaves = [], []
    for k in range(3):
        inverse = 1 / torch.as_tensor(d[k])
        a, b = (-half[k] - o[k]) * inverse, (half[k] - o[k]) * inverse
        enters.append(torch.minimum(a, b))
        leaves.append(torch.maximum(a, b))
    enter = torch.maximum(torch.maximum(enters[0], enters[1]), enters[2])
    leave = torch.minimum(torch.minimum(leaves[0], leaves[1]), leaves[2])
    return enter, leave, leave > enter


def _update_nearest(t: Tensor, index: Tensor, i: int, enter: Tensor, leave: Tensor, hit: Tensor) -> None:
    """Write solid ``i`` into ``t`` and ``index`` where it is the nearest hit; the room is hit on leaving it."""
    distance = leave if i == 0 else enter
    first = hit & (distance < t) & (distance >= 0)
    t.copy_(torch.where(first, distance, t))
    index.masked_fill_(first, i)


def _to_local(centre: _Vector, columns: Sequence[_Vector], o: _Vector, d: _Vector) -> tuple[list[Tensor], list[Tensor]]:
    rel = [o[k] - centre[k] for k in range(3)]
    return [dot_product(rel, c) for c in columns], [dot_product(d, c) for c in columns]


def _image_plane(camera: Camera, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Ideal image-plane coordinates of the columns (W,) and rows (H,), float32."""
    f, c = camera.f[0].double(), camera.c[0].double()
    x = (torch.arange(hw[1], dtype=torch.float64) - c[0]) / f[0]
    y = (torch.arange(hw[0], dtype=torch.float64) - c[1]) / f[1]
    return x.float(), y.float()


def _solid_rectangles(solids: Solids, R: Tensor, o: Tensor, x: Tensor, y: Tensor) -> list[tuple[slice, slice]]:
    """For each solid the rows and columns whose rays can hit it; all of them if it extends behind the camera."""
    signs = torch.tensor([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=torch.float64)
    half, turn, centre = solids.half.double(), solids.R.double(), solids.centre.double()
    cam = ((signs * half[:, None]) @ turn.mT + centre[:, None] - o) @ R  # (solids, 8 corners, 3)
    z = cam[..., 2]
    xy = cam[..., :2] / z[..., None]
    low, high = (xy.amin(1) - 1e-4).float(), (xy.amax(1) + 1e-4).float()
    bounds = [torch.searchsorted(axis, edge[:, k].contiguous()) for k, axis in ((1, y), (0, x)) for edge in (low, high)]
    rectangles = [(slice(a, b), slice(c, e)) for a, b, c, e in torch.stack(bounds, 1).tolist()]
    for i in (z.amin(1) < 0.02).nonzero()[:, 0].tolist():
        rectangles[i] = (slice(0, 0), slice(0, 0)) if float(z[i].amax()) <= 0 else (slice(None), slice(None))
    return rectangles
