"""Pairs of views that no method can be expected to like: a small random room, and what may go wrong with it.

A pair is a function of the seed and its number alone. The room is a box with three smaller boxes in it, painted with
noise that is the same from both sides; depth is exact up to 1 % of noise and reaches 2 m. Then one kind of trouble is
made. ``truth`` is what the reference view shows before.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera
from dhtorch.records import Frame, Pose
from dhtorch.stages.sample import spiral

HW = (96, 128)
NEAR = 2.0  # m, how far the sensor reaches
FOCAL = 105.0  # px
NAN, INF = math.nan, math.inf


@dataclass
class Pair:
    """One pair in the making (B = 1)."""

    room: "Room"
    draw: Random
    g: torch.Generator
    image_0: Tensor  # (3, H, W)
    image_1: Tensor
    depth: Tensor  # (H, W) m, as the sensor has it
    truth: Tensor  # (H, W) m
    face: Tensor  # (H, W) which plane is seen
    uv: Tensor  # (N, 2) px
    motion: Pose  # T_1_from_0 (1)
    f: tuple[Tensor, Tensor]  # (2,) px of view 0 and view 1, as the method is told
    c: tuple[Tensor, Tensor]
    lens: Tensor | None = None  # (5,) distortion, as the method is told

    def look(self, xi: list[float]) -> None:
        """Take view 1 again from another place: rotation (rad) and translation (m) of T_1_from_0."""
        self.motion = se3.exp(torch.tensor([xi], dtype=torch.float64))
        self.image_1 = self.room.view(se3.compose(self.room.start, se3.invert(self.motion)))[0]

    def near(self, mask: Tensor) -> None:
        """Keep the sensor's returns under the mask."""
        self.depth = torch.where(mask, self.depth, torch.zeros_like(self.depth))

    def frames(self) -> tuple[Frame, Frame]:
        """What a method is given."""
        lens = None if self.lens is None else self.lens[None]
        cameras = [Camera(f[None], c[None], lens) for f, c in zip(self.f, self.c, strict=True)]
        reference = Frame(self.image_0[None], self.depth[None], cameras[0])
        return reference, Frame(self.image_1[None], torch.zeros_like(self.depth)[None], cameras[1])


class Room:
    """A box seen from inside, with three boxes in it."""

    def __init__(self, draw: Random, g: torch.Generator) -> None:
        half = [draw.uniform(1.2, 2.5), draw.uniform(1.0, 1.5), draw.uniform(2.5, 4.0)]
        boxes = [([-h for h in half[:2]] + [-1.0], half)]
        for _ in range(3):
            middle = [draw.uniform(-0.5, 0.5), draw.uniform(-0.3, 0.5), draw.uniform(1.0, 1.7)]
            size = [draw.uniform(0.1, 0.3) for _ in range(3)]
            boxes.append(
                ([m - s for m, s in zip(middle, size, strict=True)], [m + s for m, s in zip(middle, size, strict=True)])
            )
        self.low, self.high = (torch.tensor([b[k] for b in boxes], dtype=torch.float64) for k in (0, 1))
        self.paint = [torch.rand(1, 3, 40, 40, 40, generator=g) for _ in range(2)]
        turn = [draw.uniform(-0.15, 0.15) for _ in range(3)]
        self.start = se3.exp(torch.tensor([[*turn, *(draw.uniform(-0.1, 0.1) for _ in range(3))]], dtype=torch.float64))

    def view(self, T_world_from_cam: Pose) -> tuple[Tensor, Tensor, Tensor]:
        """Image (3, H, W), depth (H, W) and plane (H, W) from one place."""
        v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in HW), indexing="ij")
        ray = torch.stack(((u - HW[1] / 2) / FOCAL, (v - HW[0] / 2) / FOCAL, torch.ones_like(u)), -1)
        ray = (ray[..., None, :] * T_world_from_cam.R[0]).sum(-1)[..., None, :]  # (H, W, 1, 3)
        o = T_world_from_cam.t[0]
        ray = torch.where(ray.abs() < 1e-9, 1e-9, ray)
        a, b = (self.low - o) / ray, (self.high - o) / ray
        (enter, first), (leave, last) = torch.minimum(a, b).max(-1), torch.maximum(a, b).min(-1)
        far, wall = leave[..., 0], last[..., 0]
        enter = torch.where((enter < leave) & (enter > 0.05), enter, INF)[..., 1:]
        near, box = enter.min(-1)
        inside = near < far
        depth = torch.where(inside, near, far)
        side = torch.where(inside, first[..., 1:].gather(-1, box[..., None])[..., 0], wall)
        face = torch.where(inside, box + 1, 0) * 6 + side * 2 + (ray[..., 0, :].gather(-1, side[..., None])[..., 0] > 0)
        xyz = (o + ray[..., 0, :] * depth[..., None]).float()[None, None]  # (1, 1, H, W, 3)
        image = sum(
            F.grid_sample(p, xyz / reach, padding_mode="reflection", align_corners=False)[0, :, 0]
            for p, reach in zip(self.paint, (1.2, 4.0), strict=True)
        )
        return ((image - 1.0) * 0.9 + 0.5).clamp(0.02, 0.98), depth.float(), face  # type: ignore[operator]


def make(number: int, *, seed: int = 0, n: int = 128) -> tuple[str, Pair]:
    """Kind and pair of one number; kinds take turns."""
    kind = [*KINDS][number % len(KINDS)]
    draw, g = Random(f"{seed} {number}"), torch.Generator().manual_seed(Random(f"{number} {seed}").getrandbits(62))
    room = Room(draw, g)
    image, depth, face = room.view(room.start)
    noisy = depth * (1 + 0.01 * torch.randn(HW, generator=g))
    f, c = torch.full((2,), FOCAL), torch.tensor([HW[1] / 2, HW[0] / 2])
    sensed = torch.where(noisy <= NEAR, noisy, torch.zeros_like(noisy))
    eye = se3.identity(1, room.start.t)
    pair = Pair(room, draw, g, image, image, sensed, depth, face, spiral(HW, n), eye, (f, f), (c, c))
    pair.look([*_vector(draw, 0.03), *_vector(draw, draw.uniform(0.05, 0.15), flat=True)])
    KINDS[kind](pair)
    noise = [0.004 * torch.randn(3, *HW, generator=g) for _ in range(2)]
    pair.image_0, pair.image_1 = pair.image_0 + noise[0], pair.image_1 + noise[1]
    return kind, pair


def _vector(draw: Random, length: float, *, flat: bool = False) -> list[float]:
    v = [draw.gauss(0, 1), draw.gauss(0, 1), 0.3 * draw.gauss(0, 1) if flat else draw.gauss(0, 1)]
    return [length * x / math.hypot(*v) for x in v]


def _some(pair: Pair, n: int) -> None:
    """``n`` of the samples keep their return."""
    at = pair.uv.round().long()
    alive = [k for k in range(len(at)) if pair.depth[at[k, 1], at[k, 0]] > 0]
    mask = torch.zeros(HW, dtype=torch.bool)
    for k in pair.draw.sample(alive, min(n, len(alive))):
        mask[at[k, 1], at[k, 0]] = True
    pair.near(mask)


def _coplanar(pair: Pair) -> None:
    seen = pair.face[pair.depth > 0]
    pair.near(pair.face == (seen.mode().values if len(seen) else 0))


def _collinear(pair: Pair, noise: float) -> None:
    """Half of the samples on one row of one plane; only there are returns, whose points lie on a line."""
    _coplanar(pair)
    row = (pair.depth > 0).sum(1).argmax()
    half = len(pair.uv) // 2
    line = torch.stack((torch.linspace(3, HW[1] - 4, half).round(), row.float().expand(half)), -1)
    pair.uv = torch.cat((line, pair.uv[half:]))
    pair.depth = torch.where(pair.depth > 0, pair.truth * (1 + noise * torch.randn(HW, generator=pair.g)), 0)
    pair.near((torch.arange(HW[0]) == row)[:, None].expand(HW))


def _duplicated(pair: Pair) -> None:
    distinct = pair.uv[torch.randperm(len(pair.uv), generator=pair.g)[: pair.draw.randint(1, 6)]]
    pair.uv = distinct.repeat(len(pair.uv), 1)[: len(pair.uv)]


def _swapped(pair: Pair) -> None:
    """View 1 is called the reference view, with the depth of view 0."""
    pair.image_0, pair.image_1 = pair.image_1, pair.image_0


def _unrelated(pair: Pair) -> None:
    pair.image_1 = Room(pair.draw, pair.g).view(pair.room.start)[0]


def _junk(pair: Pair, *values: float, share: float = 0.3) -> None:
    """Some returns become one of the values."""
    pick = torch.tensor(values)[torch.randint(len(values), HW, generator=pair.g)]
    pair.depth = torch.where(torch.rand(HW, generator=pair.g) < share, pick, pair.depth)


def _blank(pair: Pair, value: float, views: tuple[int, ...] = (0, 1)) -> None:
    """Images of one value."""
    for view in views:
        setattr(pair, f"image_{view}", torch.full((3, *HW), value))


def _spots(pair: Pair, value: float) -> None:
    """Some pixels of both images become one value."""
    for name in ("image_0", "image_1"):
        hit = torch.rand(HW, generator=pair.g) < pair.draw.choice((1e-4, 0.01, 0.5))
        setattr(pair, name, torch.where(hit, value, getattr(pair, name)))


def _saturated(pair: Pair) -> None:
    gain = pair.draw.uniform(2, 8)
    pair.image_0, pair.image_1 = (pair.image_0 * gain).clamp(0, 1), (pair.image_1 * gain).clamp(0, 1)


def _noise(pair: Pair) -> None:
    pair.image_0, pair.image_1 = (torch.rand(3, *HW, generator=pair.g) for _ in range(2))


def _stripes(pair: Pair) -> None:
    """Both views show the same stripes, shifted: nothing says how far, or along them."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in HW), indexing="ij")
    a, period = pair.draw.uniform(0, math.pi), pair.draw.uniform(4, 16)
    phase = (math.cos(a) * u + math.sin(a) * v) * (2 * math.pi / period)
    pair.image_0 = (0.5 + 0.4 * phase.sin()).expand(3, *HW)
    pair.image_1 = (0.5 + 0.4 * (phase + pair.draw.uniform(-2, 2)).sin()).expand(3, *HW)


def _moving(pair: Pair) -> None:
    """Half of view 1 went somewhere else."""
    half = HW[1] // 2
    moved = pair.image_1.roll((pair.draw.randint(-6, 6), pair.draw.randint(-6, 6)), (1, 2))
    pair.image_1 = torch.cat((moved[..., :half], pair.image_1[..., half:]), -1)


def _wrong_camera(pair: Pair, low: float, high: float) -> None:
    """Focal lengths off by a factor in the range, principal points off by as many pixels."""
    factors = [torch.tensor([math.exp(pair.draw.uniform(low, high)) for _ in range(2)]) for _ in range(2)]
    shifts = [torch.tensor([pair.draw.gauss(0, 10 * high) for _ in range(2)]) for _ in range(2)]
    pair.f = (pair.f[0] * factors[0], pair.f[1] * factors[1])
    pair.c = (pair.c[0] + shifts[0], pair.c[1] + shifts[1])


def _not_a_camera(pair: Pair) -> None:
    bad = torch.tensor([pair.draw.choice((0.0, NAN, INF, -FOCAL, 1e-30, 1e30)), FOCAL])
    pair.f = (bad, pair.f[1]) if pair.draw.random() < 0.5 else (pair.f[0], bad)


def _lens(pair: Pair, scale: float) -> None:
    """A distortion that the images do not have."""
    pair.lens = torch.tensor([pair.draw.gauss(0, scale) for _ in range(5)])


def _lie(pair: Pair) -> None:
    """Returns that have nothing to do with the scene."""
    random = 0.3 + (NEAR - 0.3) * torch.rand(HW, generator=pair.g)
    pair.depth = torch.where(pair.depth > 0, random, pair.depth)


def _outside(pair: Pair) -> None:
    """Samples outside the image, and some that are no pixels at all."""
    away = torch.rand(len(pair.uv), generator=pair.g) < 0.5
    places = torch.tensor([[-5.0, 20.0], [500.0, -300.0], [NAN, 10.0], [INF, NAN], [1e20, 1e20]])
    pick = places[torch.randint(len(places), (len(pair.uv),), generator=pair.g)]
    pair.uv = torch.where(away[:, None], pick, pair.uv)


KINDS: dict[str, Callable[[Pair], None]] = {
    "nothing wrong": lambda pair: None,
    "no near points": lambda pair: pair.near(torch.zeros(HW, dtype=torch.bool)),
    "one near point": lambda pair: _some(pair, 1),
    "three near points": lambda pair: _some(pair, 3),
    "eight near points": lambda pair: _some(pair, 8),
    "collinear": lambda pair: _collinear(pair, 0.0),
    "collinear up to 1 % noise": lambda pair: _collinear(pair, 0.01),
    "coplanar": _coplanar,
    "duplicated points": _duplicated,
    "points behind": lambda pair: pair.look(
        [0.0, 0.0, 0.0, 0.0, 0.0, -pair.draw.uniform(1.8, 2.4)]
    ),  # View 1 stands beyond the near points: they are behind it.
    "identical frames": lambda pair: setattr(pair, "image_1", pair.image_0.clone()),
    "pure rotation": lambda pair: pair.look([*_vector(pair.draw, pair.draw.uniform(0.01, 0.06)), 0.0, 0.0, 0.0]),
    "swapped frames": _swapped,
    "unrelated images": _unrelated,
    "huge motion": lambda pair: pair.look(
        [*_vector(pair.draw, pair.draw.uniform(0.3, 3)), *_vector(pair.draw, pair.draw.uniform(0.3, 1))]
    ),
    "moving scene": _moving,
    "upside down": lambda pair: setattr(pair, "image_1", pair.image_1.flip(1, 2)),
    "mirrored": lambda pair: setattr(pair, "image_1", pair.image_1.flip(2)),
    "NaN depth": lambda pair: _junk(pair, NAN),
    "all depth NaN": lambda pair: _junk(pair, NAN, share=2.0),
    "infinite depth": lambda pair: _junk(pair, INF, -INF),
    "tiny, huge, negative depth": lambda pair: _junk(pair, -1.0, 1e-30, 1e-4, 1e30, 3e38),
    "random depth": _lie,
    "depth in mm": lambda pair: setattr(pair, "depth", 1e3 * pair.depth),
    "depth in light years": lambda pair: setattr(pair, "depth", 1e-16 * pair.depth),
    "constant images": lambda pair: _blank(pair, 0.5),
    "black view 1": lambda pair: _blank(pair, 0.0, (1,)),
    "saturated": _saturated,
    "noise images": _noise,
    "stripes": _stripes,
    "NaN pixels": lambda pair: _spots(pair, NAN),
    "infinite pixels": lambda pair: _spots(pair, INF),
    "all pixels NaN": lambda pair: _blank(pair, NAN, (0,)),
    "wrong intrinsics": lambda pair: _wrong_camera(pair, -0.7, 0.7),
    "absurd intrinsics": lambda pair: _wrong_camera(pair, -5.0, 5.0),
    "no intrinsics": _not_a_camera,
    "wrong lens": lambda pair: _lens(pair, 0.3),
    "absurd lens": lambda pair: _lens(pair, 1e3),
    "lens of NaN": lambda pair: _lens(pair, NAN),
    "samples outside": _outside,
}
