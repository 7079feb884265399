"""Shading of the room: textures, precomputed light and one mirror reflection.

Light is computed when a :class:`ShadedRoom` is constructed, on a grid of nodes over each face: area lights with soft
shadows, and ambient light with occlusion. It does not depend on the viewer, so a surface point has the same colour in
every frame (except for the mirror and the gloss of the screen).

Colours are display values, roughly square roots of light: multiplying them multiplies light and reflectance.
Alphabet: as in :mod:`dhtorch.synthetic.raycast`; L nodes, P rays.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dhtorch.geometry.patches import LUMA_WEIGHTS
from dhtorch.geometry.se3 import Pose
from dhtorch.synthetic.raycast import SURFACE_MOVING, Material, Solid, Solids, Triple, dot_product
from dhtorch.synthetic.textures import TEXTURE_SIZE_PX, paint_textures

_RAYS_PER_CHUNK = 1 << 16  # rays shaded at a time: enough to amortise a call, few enough to stay in the cache


@dataclass(frozen=True)
class Light:
    """A rectangular area light ``centre ± u ± v`` along ``normal``; with a zero normal, in all directions."""

    centre: Triple
    u: Triple
    v: Triple
    normal: Triple
    colour: Triple
    samples: tuple[int, int] = (3, 3)


class ShadedRoom:
    """Solids with textures and precomputed light, for rendering."""

    def __init__(self, solids: Sequence[Solid], lights: Sequence[Light], *, ambient: float, seed: int):
        self._lights, self._ambient = tuple(lights), ambient
        self._names = sorted({s.picture for s in _face_materials(solids)})
        self._pictures = _Pictures(paint_textures(self._names, torch.Generator().manual_seed(seed)))
        self._furnish(solids, None)

    def _furnish(self, solids: Sequence[Solid], lit: "_Lightmap | None") -> None:
        """Set the solids and compute their light; the first ones keep the light ``lit``."""
        surfaces = _face_materials(solids)
        self.solids = Solids(solids)
        self.kind = torch.tensor([s.kind for s in surfaces])  # (faces,), as are the next ones
        self._picture = torch.tensor([self._names.index(s.picture) for s in surfaces])
        self._reflect = torch.tensor([s.reflect for s in surfaces])
        self._glow = torch.tensor([s.glow for s in surfaces])
        self._tint = torch.tensor([s.tint for s in surfaces])
        # (faces, 3): texels per half width across and down, signed so that print is not mirrored; texels per m.
        rows = []
        for f, surface in enumerate(surfaces):
            solid, axis, positive = solids[f // 6], (f % 6) // 2, f % 2
            half = [solid.half[k] for k in ((2, 1), (0, 2), (0, 1))[axis]]
            per_m = [TEXTURE_SIZE_PX / (surface.tile or 2 * h) for h in half]
            # Seen from outside, x runs left on the far (+z) face and z runs left on the near (-x) one; inside, the
            # reverse.
            flip = (axis == 0 and not positive) or (axis == 2 and bool(positive))
            across = -1 if axis != 1 and flip == (f >= 6) else 1
            down = -1 if axis == 1 and not positive else 1
            rows.append([across * half[0] * per_m[0], down * half[1] * per_m[1], (per_m[0] * per_m[1]) ** 0.5])
        self._scale = torch.tensor(rows)
        #: Mean grey of each face (faces,), display values: its brightness to an active sensor.
        self.albedo = (self._pictures.mean[self._picture] * self._tint * torch.tensor(LUMA_WEIGHTS)).sum(-1)
        self.light = _Lightmap(self.solids, self._lights, self._ambient, lit)

    def joined_by(self, guests: Sequence[Solid]) -> "ShadedRoom":
        """The room with further solids, lit where they stand; the light of the room itself is unchanged.

        Raises:
            ValueError: a guest has a picture that nothing in the room has, or casts a shadow.
        """
        for guest in guests:
            if guest.shadow:
                raise ValueError("shaded room: found a guest that casts a shadow, expected shadow=False")
        for surface in _face_materials(guests):
            if surface.picture not in self._names:
                raise ValueError(f"shaded room: picture is {surface.picture!r}, expected one of {self._names}")
        room = copy.copy(self)
        room._furnish([*self.solids.each, *guests], self.light)
        return room

    def moved(self, motion: Pose) -> "ShadedRoom":
        """The room with its ``SURFACE_MOVING`` solids after rigid motions (n) of the world, in unchanged light.

        The k-th of them has the motion k mod n. A surface point keeps its colour, so that it can be tracked like any
        other.
        """
        room = copy.copy(self)
        solids = list(self.solids.each)
        k = 0
        for i, solid in enumerate(solids):
            if solid.surface.kind == SURFACE_MOVING:
                turn = k % len(motion.t)
                solids[i], k = solid.moved(motion[turn : turn + 1]), k + 1
        room.solids = Solids(solids)
        return room

    def relit(self, factors: Sequence[float], ambient: float) -> "ShadedRoom":
        """The room with the power of its lights times ``factors``, and another ambient light.

        Raises:
            ValueError: not one factor for each light.
        """
        if len(factors) != len(self._lights):
            raise ValueError(f"shaded room: found {len(factors)} factors for {len(self._lights)} lights")
        room = copy.copy(self)
        colours = ((light.colour, k) for light, k in zip(self._lights, factors, strict=True))
        powers = [(p[0] * k, p[1] * k, p[2] * k) for p, k in colours]
        room._lights = tuple(replace(light, colour=p) for light, p in zip(self._lights, powers, strict=True))
        room._ambient = ambient
        room._furnish(self.solids.each, None)
        return room

    def shade(
        self, o: Sequence[Tensor], d: Sequence[Tensor], t: Tensor, index: Tensor, spread: float
    ) -> tuple[Tensor, Tensor]:
        """Colours (P, 3), not clipped, and faces (P,) of rays that hit solid ``index`` (P,) at ``t`` (P,).

        ``spread``: width of a ray per unit of ``t``; pictures are filtered to it.
        """
        parts = [slice(k, k + _RAYS_PER_CHUNK) for k in range(0, t.numel(), _RAYS_PER_CHUNK)]
        strips = [self._paint([c[s] for c in o], [c[s] for c in d], t[s], index[s], spread) for s in parts]
        colour, face = torch.cat([s[0] for s in strips]), torch.cat([s[1] for s in strips])
        return self._mirror(colour, face, o, d, t, spread), face

    def cosine(self, d: Sequence[Tensor], face: Tensor, p: Sequence[Tensor]) -> Tensor:
        """Cosine (P,) of the angle between a ray and the normal of the face it hits at ``p``, in [0, 1]."""
        along = dot_product(d, self.solids.normal(face, p)).abs()
        return (along / dot_product(d, d).sqrt()).clamp(0, 1)

    def mirrored(
        self, o: Sequence[Tensor], d: Sequence[Tensor], t: Tensor, face: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor, Tensor]:
        """Origins, directions, distances and solids of the rays after reflection at ``face`` (P,)."""
        p = [o[k] + d[k] * t for k in range(3)]
        normal = self.solids.normal(face, p)
        along = dot_product(d, normal)
        bounced = [d[k] - 2 * along * normal[k] for k in range(3)]
        start = [p[k] + 1e-4 * bounced[k] for k in range(3)]
        return start, bounced, *self.solids.cast(start, bounced)

    def _paint(
        self, o: Sequence[Tensor], d: Sequence[Tensor], t: Tensor, index: Tensor, spread: float
    ) -> tuple[Tensor, Tensor]:
        p = [o[k] + d[k] * t for k in range(3)]
        face, across, down = self.solids.locate(index, p)
        scale = self._scale[face]
        # Isotropic filter: the geometric mean of the footprint across and along the slant.
        width = spread * t / self.cosine(d, face, p).clamp(min=1e-3).sqrt() * scale[:, 2]
        picture = self._pictures.sample(self._picture[face], across * scale[:, 0], down * scale[:, 1], width)
        return picture * self._tint[face] * (self.light.sample(face, across, down) + self._glow[face, None]), face

    def _mirror(
        self, colour: Tensor, face: Tensor, o: Sequence[Tensor], d: Sequence[Tensor], t: Tensor, spread: float
    ) -> Tensor:
        """Blend the colour (P, 3) with that of the mirrored rays; a mirror in a mirror shows its own colour."""
        index = (self._reflect[face] > 0).nonzero()[:, 0]
        if not index.numel():
            return colour
        rays = self.mirrored([c[index] for c in o], [c[index] for c in d], t[index], face[index])
        reflected, _ = self._paint(*rays, spread * 2)  # about the width at the whole distance travelled
        weight = self._reflect[face[index], None]
        return colour.index_copy(0, index, colour[index] * (1 - weight) + reflected * weight)


class _Pictures:
    """Tileable pictures with a mipmap pyramid each, all texels in one table."""

    def __init__(self, pictures: Tensor):
        levels, parts, start = [], [], 0
        while pictures.shape[1] > 1:
            size = pictures.shape[1]
            levels.append((start, size))
            parts.append(pictures.reshape(len(pictures), -1, 3))
            start += size * size
            rows = pictures[:, ::2] + pictures[:, 1::2]
            pictures = (rows[:, :, ::2] + rows[:, :, 1::2]) * 0.25
        self.mean = pictures[:, 0, 0]  # (pictures, 3)
        self._levels = torch.tensor(levels)
        self._texels = torch.cat(parts, 1).reshape(-1, 3)
        self._texels_each = start

    def sample(self, picture: Tensor, x: Tensor, y: Tensor, width: Tensor) -> Tensor:
        """Trilinear look-up (P, 3) at texel coordinates from the picture's middle, averaged over ``width`` texels."""
        # log2 to within 0.09, linear between powers of two: from the exponent bits of a float32.
        log2 = width.clamp(min=1e-6).view(torch.int32).float() * 2.0**-23 - 127
        level = log2.clamp(0, len(self._levels) - 1.001)
        finer = level.floor().long()
        near, far = (self._bilinear(picture * self._texels_each, finer + k, x, y) for k in (0, 1))
        return near + (far - near) * (level - finer)[:, None]

    def _bilinear(self, base: Tensor, level: Tensor, x: Tensor, y: Tensor) -> Tensor:
        start, size = self._levels[level].unbind(-1)
        shrink = size / TEXTURE_SIZE_PX
        x, y = x * shrink + (size / 2 - 0.5), y * shrink + (size / 2 - 0.5)
        left, above = x.floor(), y.floor()
        wx, wy = (x - left)[:, None], (y - above)[:, None]
        mask = size - 1
        x0, y0 = left.long() & mask, above.long() & mask
        x1, y1 = (x0 + 1) & mask, (y0 + 1) & mask
        row0, row1 = base + start + y0 * size, base + start + y1 * size
        a, b, c, e = (self._texels.index_select(0, k) for k in (row0 + x0, row0 + x1, row1 + x0, row1 + x1))
        top = a + (b - a) * wx
        return top + (c + (e - c) * wx - top) * wy


class _Lightmap:
    """Light on a grid of nodes over each face, interpolated bilinearly; that of the first faces may be given."""

    def __init__(
        self,
        solids: Solids,
        lights: Sequence[Light],
        ambient: float,
        existing: "_Lightmap | None" = None,
        *,
        spacing: float = 0.1,
    ):
        half = solids.half
        size = torch.stack([half[:, [2, 1]], half[:, [0, 2]], half[:, [0, 1]]], 1) * 2
        n = (size / spacing).ceil().long() + 1  # (solids, axis, 2)
        n = torch.where(solids.ball[:, None, None], n.clamp(min=5), n)
        self.n = n.repeat_interleave(2, 1).reshape(-1, 2)  # (faces, 2) nodes across and down
        count = self.n[:, 0] * self.n[:, 1]
        self.start = count.cumsum(0) - count
        face = torch.arange(len(count)).repeat_interleave(count)
        node = torch.arange(len(face)) - self.start[face]
        if existing is not None:
            face, node = face[len(existing.values) :], node[len(existing.values) :]
        n = self.n[face]
        across, down = (node % n[:, 0]) / (n[:, 0] - 1) * 2 - 1, (node // n[:, 0]) / (n[:, 1] - 1) * 2 - 1
        p = solids.points(face, across * 0.995, down * 0.995)
        normal = solids.normal(face, p)
        p = [p[k] + 0.003 * normal[k] for k in range(3)]
        power = ambient * _ambient_light(solids, p, normal)
        for light in lights:
            power = power + _direct_light(solids, light, p, normal)
        values = power.sqrt()
        self.values: Tensor = values if existing is None else torch.cat((existing.values, values))  # (L, 3)

    def sample(self, face: Tensor, across: Tensor, down: Tensor) -> Tensor:
        """Light (P, 3) at coordinates in [-1, 1] of faces."""
        n = self.n[face]
        columns, last = n[:, 0], n - 1
        x = (across.clamp(-1, 1) + 1) * 0.5 * last[:, 0]
        y = (down.clamp(-1, 1) + 1) * 0.5 * last[:, 1]
        x0 = torch.minimum(x.long(), last[:, 0] - 1)
        y0 = torch.minimum(y.long(), last[:, 1] - 1)
        wx, wy = (x - x0)[:, None], (y - y0)[:, None]
        k = self.start[face] + y0 * columns + x0
        a, b, c, e = (self.values.index_select(0, j) for j in (k, k + 1, k + columns, k + columns + 1))
        top = a + (b - a) * wx
        return top + (c + (e - c) * wx - top) * wy


def _direct_light(solids: Solids, light: Light, p: list[Tensor], normal: list[Tensor]) -> Tensor:
    """Power (L, 3) that points receive from a light, with soft shadows."""
    rows, columns = light.samples
    offsets = [((2 * i + 1) / columns - 1, (2 * k + 1) / rows - 1) for k in range(rows) for i in range(columns)]
    target = [torch.tensor([[light.centre[j] + a * light.u[j] + b * light.v[j]] for a, b in offsets]) for j in range(3)]
    d = [target[k] - p[k] for k in range(3)]  # (samples, L)
    square = dot_product(d, d).clamp(min=0.04)
    shine = -dot_product(d, light.normal) if any(light.normal) else square.sqrt()
    gain = dot_product(d, normal).clamp(min=0) * shine.clamp(min=0) / (square * square)
    facing = gain.any(0).nonzero()[:, 0]  # points that face away from the whole light need no shadow test
    gain[:, facing] *= _is_unshaded(solids, light, [c[facing] for c in p], [c[:, facing] for c in d])
    total = torch.zeros_like(gain[0])
    for k in range(len(offsets)):  # summed in a fixed order
        total = total + gain[k]
    return (total / len(offsets))[:, None] * torch.tensor(light.colour)


def _is_unshaded(solids: Solids, light: Light, p: list[Tensor], d: list[Tensor]) -> Tensor:
    """1 where the segments ``d`` (samples, P) from points ``p`` (P,) to samples of a light are free, else 0."""
    clear = torch.ones_like(d[0])
    half = math.hypot(*(abs(light.u[k]) + abs(light.v[k]) for k in range(3)))
    for solid, index in solids.blockers(p, half + 1e-3, [light.centre[k] - p[k] for k in range(3)]):
        far = solids.open_distance(solid, [c[index] for c in p], [c[:, index] for c in d])
        clear[:, index] = torch.where(far > 0.98, clear[:, index], 0.0)
    return clear


def _ambient_light(solids: Solids, p: list[Tensor], normal: list[Tensor], *, reach: float = 1.1) -> Tensor:
    """Fraction (L, 3) of the ambient light that is not occluded by solids within ``reach`` (m)."""
    sphere = _sphere_directions()
    d = [torch.tensor([[c[k]] for c in sphere]) for k in range(3)]
    side = torch.where(
        dot_product(d, normal) < 0, -reach, reach
    )  # the same directions for all points, flipped to the side of the normal
    d = [c * side for c in d]  # (directions, L)
    clear = solids.open_distance(solids.each[0], p, d)
    for solid, index in solids.blockers(p, reach):
        far = solids.open_distance(solid, [c[index] for c in p], [c[:, index] for c in d])
        clear[:, index] = torch.minimum(clear[:, index], far)
    weight = 0.35 + dot_product(d, normal) / reach
    total, total_weight = torch.zeros_like(p[0]), torch.zeros_like(p[0])
    for k in range(len(sphere)):
        total, total_weight = total + clear[k] * weight[k], total_weight + weight[k]
    from_above = 0.8 - 0.2 * normal[1]
    return (from_above * total / total_weight)[:, None] * torch.tensor([0.96, 0.98, 1.04])


def _sphere_directions(n: int = 14) -> list[Triple]:
    """Directions (n) spread over the sphere: a spiral in equal height steps, rotated by the golden angle each."""
    c, s = -0.7373688780783197, 0.6754902942615238  # cosine and sine of the golden angle
    x, y = 1.0, 0.0
    directions = []
    for k in range(n):
        h = 1 - (2 * k + 1) / n
        r = (1 - h * h) ** 0.5
        directions.append((r * x, h, r * y))
        x, y = c * x - s * y, s * x + c * y
    return directions


def _face_materials(solids: Sequence[Solid]) -> list[Material]:
    """Material of every face, six per solid."""
    return [s.faces.get(f, s.surface) for s in solids for f in range(6)]
