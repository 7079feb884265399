"""A plane sweep: how well every pixel of a view fits another view at every depth, and the surface that fits best.

Alphabet: q inverse depth (1/m), of D *planes*, rising from 0 (infinity); N = h · w pixels of view 0, row by row, and
their rays r (z = 1); R, t the motion to view 1, so that a pixel is seen at π(R r + q t); a *code* is the census of a
window, 31 signs in one int32; C (B, h, w, D) the cost, how many signs differ; S the cost of the best surface through a
place; W the windows in which the surface found is fitted once more, by grey values.

View 1 is read once, into a picture that is turned as view 0 is (*level*): there a plane moves pixels only along their
epipolar lines, windows are not turned against each other, and codes can be looked up without being made again. A lens
and a shutter's turn are in that reading; no picture is undistorted first.

All costs are whole numbers: they depend on no order of summation, so not on batch, threads, tiles or device.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import all_finite, all_known, check
from dhtorch.geometry.se3 import Pose
from dhtorch.geometry.windows import window_sum
from dhtorch.ops.constants import FIT_RADIUS_PX
from dhtorch.ops.dispatch import operator
from dhtorch.pytree import Record, record

#: Offsets (down, right) of the signs of a census: a checkerboard of 9 x 7 pixels without its middle.
CENSUS_OFFSETS = tuple((i, j) for i in range(-3, 4) for j in range(-4, 5) if (i + j) % 2 and (i, j) != (-3, -4))[:31]

#: What a step of one plane and a jump of any height cost a surface, and what a pixel costs that view 1 does not show:
#: less than a misfit (half of the signs), more than a fit. In signs.
STEP_COST, JUMP_COST, UNSEEN_COST = 3, 18, 11

#: Sides that a surface comes to a pixel from.
N_PATHS = 4

#: Most views whose costs one byte can add up.
MAX_SWEPT_VIEWS = 8

#: Rows whose best planes are read at once.
ROWS_PER_BLOCK = 32

#: How far beyond view 0's border its points are looked for: the longer side over this.
BORDER_DIVISOR = 4

#: Least variance in a window of the grey value's change with inverse depth, m².
FLAT_GRADIENT_VARIANCE = 1e-12

#: Gains between two windows that are believed, and the variance of grey values under which nothing is seen.
WINDOW_GAIN_RANGE, FLAT_VARIANCE = (0.5, 2.0), 1e-8

#: A point at less than this depth in view 1, as a share of its depth in view 0, is behind it; and the factor by which
#: its pixel is then moved out of every picture.
MIN_DEPTH_RATIO, BEHIND_SCALE = 1e-3, 1e9


@record
class ReferenceView(Record):
    """View 0, whose pixels are asked for their depth; made by :func:`make_reference_view`."""

    image: Tensor  # (B, 1, h, w) grey
    camera: Camera
    ray: Tensor  # (B, N, 3) z = 1; straight ahead where the lens knows none
    known: Tensor  # (B, N) bool, the lens knows a ray
    code: Tensor  # (B, h, w) int32, see census

    @property
    def hw(self) -> tuple[int, int]:
        """Height and width of the picture."""
        return self.image.shape[-2], self.image.shape[-1]


@record
class SweptView(Record):
    """View 1 and how it stands to view 0."""

    image: Tensor  # (B, 1, H, W) grey
    camera: Camera
    T_1_from_0: Pose
    shutter_rate: Tensor | None = None  # (B, 3) rad per unit of y, of a rolling shutter


class EpipolarWarp(NamedTuple):
    """Where the level picture sees every pixel of view 0: inverse depth q at (a + q b) / (1 + q c), px of view 0."""

    a: Tensor  # (B, 2, N)
    b: Tensor  # (B, 2, 1)
    c: Tensor  # (B, 1)

    def at(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels u and v, (B, N) each, at inverse depths q (B, N) or (B, 1); far outside where behind view 1."""
        z = 1 + q * self.c
        scale = torch.where(z > MIN_DEPTH_RATIO, 1 / z, BEHIND_SCALE)
        u, v = ((self.a[:, k] + q * self.b[:, k]) * scale for k in (0, 1))
        return u, v

    def cell(self, q: Tensor, hw: tuple[int, int], margin: int) -> Tensor:
        """Index (B, N) of the nearest pixel of a picture of size ``hw`` in which view 0 begins ``margin`` px inside; of
        its border where that lies outside."""
        column, row = (
            x.add_(margin + 0.5).clamp_(0, size - 1).to(torch.int32)  # cut off, which is floor
            for x, size in zip(self.at(q), hw[::-1], strict=True)
        )
        return row.mul_(hw[1]).add_(column).long()


class RectifiedView(NamedTuple):
    """View 1 as it would be seen without its turn, around the place of view 0's picture."""

    code: Tensor  # (B, H · W) int32, see census; negative where view 1 shows nothing, so along the border
    hw: tuple[int, int]  # H and W
    margin: int  # px by which pixel (0, 0) of view 0 lies inside


def pixel_rays(camera: Camera, hw: tuple[int, int], margin: int = 0) -> Tensor:
    """Rays (B, N, 3) with z = 1 of all pixels of a picture and of ``margin`` more around it; NaN outside the lens.

    In memory each axis lies by itself, as all numbers here that belong to a pixel do: operations then run along pixels.
    """
    columns, rows = (torch.arange(-margin, n + margin, device=camera.f.device).to(camera.f) for n in hw[::-1])
    if camera.distortion is not None:
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        uv = torch.stack([u, v], -1).reshape(1, -1, 2).expand(len(camera.f), -1, -1)
        return cam.rays(camera, uv).mT.contiguous().mT
    x, y = ((place - camera.c[:, k, None]) / camera.f[:, k, None] for k, place in enumerate((columns, rows)))
    x = x[:, None].expand(-1, len(rows), -1)
    y = y[:, :, None].expand(-1, -1, len(columns))
    return torch.stack([x, y, torch.ones_like(x)], 1).flatten(2).mT


def make_reference_view(image: Tensor, camera: Camera) -> ReferenceView:
    """View 0 of a grey picture (B, 1, h, w). Gradient: to the picture and, through the rays, to the camera."""
    check("make_reference_view", image=(image, "B 1 h w"), f=(camera.f, "B 2"))
    ray = pixel_rays(camera, (image.shape[-2], image.shape[-1]))
    known = all_finite(ray, -1) if camera.distortion is not None else _sees(camera, ray)
    if not (known.is_cpu and all_known(known)):
        ray = torch.where(known[..., None], ray, ray.new_tensor([0.0, 0.0, 1.0]))
    return ReferenceView(image, camera, ray, known, census_transform(image.detach()))


def _sees(camera: Camera, ray: Tensor) -> Tensor:
    """Whether each ray (B, N, 3) of a camera without distortion is one, (B, N): a focal length is, or is none."""
    fine = (camera.f.isfinite() & (camera.f != 0) & camera.c.isfinite()).all(-1, keepdim=True)
    return fine.expand(ray.shape[:-1]).contiguous()


def project_inverse_depth(view: SweptView, ray: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Where view 1 sees the points on rays (B, N, 3) at inverse depths q (B, N): pixels (B, N, 2) of its picture, and
    whether they lie before it (B, N). Gradient: to everything."""
    check("project_inverse_depth", ray=(ray, "B N 3"), q=(q, "B N"), t=(view.T_1_from_0.t, "B 3"))
    T, camera = view.T_1_from_0, view.camera
    if camera.distortion is None:
        motion = T.R, T.t, view.shutter_rate
        return _project_pinhole(ray, q, *motion, camera.f, camera.c)
    xyz, front = _move_points(ray, q, T.R, T.t, view.shutter_rate)
    return cam.project(camera, torch.stack(xyz, -1)), front


def _move_points(
    ray: Tensor, q: Tensor, R: Tensor, t: Tensor, shutter_rate: Tensor | None
) -> tuple[list[Tensor], Tensor]:
    """Points R r + q t of view 1, three planes (B, N) with 1 where they are behind it, and whether they are not."""
    x, y, z = (part + q * t[:, None] for part, t in zip(rotate_rays(R, ray), t.unbind(-1), strict=True))
    if shutter_rate is not None:
        p, o, s = (shutter_rate[:, k, None] * ray[..., 1] for k in range(3))
        x, y, z = x + (o * z - s * y), y + (s * x - p * z), z + (p * y - o * x)
    front = z > MIN_DEPTH_RATIO
    return [torch.where(front, part, 1.0) for part in (x, y, z)], front


def _project_pinhole_kernel(*tensors: Any) -> tuple[Tensor, Tensor]:
    ray, q, R, t, shutter_rate, f, c = tensors
    planes = ray.mT.contiguous()
    uv = torch.empty_like(planes[:, :2])
    front = torch.empty_like(q, dtype=torch.bool)
    motion = R, t, torch.zeros_like(t) if shutter_rate is None else shutter_rate
    torch.ops.dhtorch.project_inverse_depth.default(planes, q, *motion, f, c, *(uv, front), MIN_DEPTH_RATIO)
    return uv.mT, front


@operator(
    kernel=_project_pinhole_kernel,
    dtypes=dict.fromkeys(("ray", "q", "R", "t", "shutter_rate", "f", "c"), torch.float32),
    any_layout=("ray",),
)
def _project_pinhole(*tensors: Any) -> tuple[Tensor, Tensor]:
    """:func:`project_inverse_depth` into a camera without distortion."""
    ray, q, R, t, shutter_rate, f, c = tensors
    (x, y, z), front = _move_points(ray, q, R, t, shutter_rate)
    places = [part / z * f[:, k, None] + c[:, k, None] for k, part in enumerate((x, y))]
    return torch.stack(places, 1).mT, front


def rotate_rays(R: Tensor, ray: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(B, 3, 3) times each of (B, N, 3), one tensor (B, N) an axis: the numbers of :func:`dhtorch.geometry.se3.rotate`,
    which takes several times as long on so many. Gradient: to both."""
    x, y, z = ray.unbind(-1)
    right, down, ahead = (x * row[:, 0, None] + y * row[:, 1, None] + z * row[:, 2, None] for row in R.unbind(1))
    return right, down, ahead


def _sample_bilinear_kernel(image: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    axes = uv.mT.contiguous()
    values = image.new_empty(*image.shape[:2], uv.shape[1])
    inside = torch.empty_like(axes[:, 0], dtype=torch.bool)
    torch.ops.dhtorch.sample_bilinear.default(image, axes, values, inside)
    return values, inside


@operator(kernel=_sample_bilinear_kernel, dtypes={"image": torch.float32, "uv": torch.float32}, any_layout=("uv",))
def sample_bilinear(image: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Values (B, C, N) of pictures (B, C, H, W) at pixels (B, N, 2), and which lie inside (B, N). Gradient: to both."""
    H, W = image.shape[-2:]
    size = uv.new_tensor([W, H])
    inside = ((uv >= 0) & (uv <= size - 1)).all(-1)
    place = ((2 * uv + 1) / size - 1).clamp(-2, 2)[:, :, None]
    values = F.grid_sample(image, place, mode="bilinear", padding_mode="border", align_corners=False)
    return values[..., 0], inside


def epipolar_warp(base: ReferenceView, view: SweptView) -> EpipolarWarp:
    """How the pixels of view 0 travel in the level picture of view 1. Gradient: to cameras and motion."""
    s = se3.rotate(view.T_1_from_0.R.mT, view.T_1_from_0.t[:, None]).mT
    f, c = base.camera.f[..., None], base.camera.c[..., None]
    a = base.ray[..., :2].mT * f + c
    return EpipolarWarp(a.contiguous(), s[:, :2] * f + c * s[:, 2:], s[:, 2])


def census_transform(grey: Tensor) -> Tensor:
    """Codes (B, h, w) int32 of pictures (B, 1, h, w): of each of 31 neighbours whether it is darker than the middle."""
    check("census_transform", grey=(grey, "B 1 h w"))
    return _census(grey)


def _census_kernel(grey: Tensor) -> Tensor:
    code = torch.empty_like(grey[:, 0], dtype=torch.int32)
    torch.ops.dhtorch.census_transform.default(grey[:, 0], torch.tensor(CENSUS_OFFSETS), code)
    return code


@operator(kernel=_census_kernel, dtypes={"grey": torch.float32})
def _census(grey: Tensor) -> Tensor:
    h, w = grey.shape[-2:]
    padded, middle = F.pad(grey, (4, 4, 3, 3), mode="replicate")[:, 0], grey[:, 0]
    code = torch.zeros_like(middle, dtype=torch.int32)
    for first in range(0, len(CENSUS_OFFSETS), 8):  # a byte at a time is a quarter of the memory
        byte = torch.zeros_like(middle, dtype=torch.uint8)
        for k, (i, j) in enumerate(CENSUS_OFFSETS[first : first + 8]):
            byte += (padded[:, 3 + i : 3 + i + h, 4 + j : 4 + j + w] < middle).to(torch.uint8).mul_(1 << k)
        code += byte.to(torch.int32) << first
    return code


def count_set_bits(x: Tensor) -> Tensor:
    """How many of the lower 31 bits of int32 (…) are set."""
    x = x - x.bitwise_right_shift(1).bitwise_and_(0x55555555)
    high = x.bitwise_right_shift(2).bitwise_and_(0x33333333)
    x = x.bitwise_and_(0x33333333).add_(high)
    x = x.add_(x.bitwise_right_shift(4)).bitwise_and_(0x0F0F0F0F)
    return x.mul_(0x01010101).bitwise_right_shift_(24)  # the sum of the bytes stands in the highest


def rectify_view(base: ReferenceView, view: SweptView, wanted: Tensor) -> RectifiedView:
    """View 1 turned as view 0 is; showing nothing to pairs that are not ``wanted`` (B,). Gradient: none."""
    margin = max(base.hw) // BORDER_DIVISOR
    hw = base.hw[0] + 2 * margin, base.hw[1] + 2 * margin
    ray = pixel_rays(cam.ideal(base.camera), base.hw, margin)
    uv, front = project_inverse_depth(view, ray, ray.new_zeros(ray.shape[:2]))
    grey, inside = sample_bilinear(view.image, uv)
    seen = (inside & front).unflatten(-1, hw) & wanted[:, None, None]
    seen = F.pad(seen[:, 1:-1, 1:-1], (1, 1, 1, 1))
    code = census_transform(grey.detach().unflatten(-1, hw)[:, 0, None])
    return RectifiedView(torch.where(seen, code, -1).flatten(1), hw, margin)


def census_cost(base: ReferenceView, seen: RectifiedView, go: EpipolarWarp, q: Tensor) -> Tensor:
    """How badly pixels fit at inverse depths q (B, N) or (B, 1): signs that differ, (B, N) int32; UNSEEN where view 1
    does not show them. Gradient: none."""
    return _census_cost(base.code.flatten(1), seen, go, q)


def _census_cost(code_0: Tensor, seen: RectifiedView, go: EpipolarWarp, q: Tensor) -> Tensor:
    code = seen.code.gather(1, go.cell(q, seen.hw, seen.margin))
    count = count_set_bits(code ^ code_0)
    unseen = code.bitwise_right_shift(31)  # all bits or none; masks take three times as long
    return count.add_(unseen.bitwise_and_(UNSEEN_COST - count))


@torch.no_grad()
def add_census_costs(
    C: Tensor,  # (B, D, h, w) uint8, in place
    base: ReferenceView,
    view: SweptView,
    q: Tensor,  # (B, D)
    wanted: Tensor,  # (B,) bool, others cost UNSEEN everywhere
    *,
    fresh: bool = False,
) -> None:
    """Add to C how badly every pixel fits a view at every plane; ``fresh``: C holds nothing yet.

    At most :data:`MAX_SWEPT_VIEWS` views fit into a byte. C is of :func:`new_cost_volume`, or has its planes first in
    memory. Memory: pictures of view 0's size, whatever D. Gradient: none.
    """
    seen = rectify_view(base, view, wanted)
    places = seen.hw, seen.margin
    _add_costs(
        C.movedim(1, -1), base.code.flatten(1), seen.code, *epipolar_warp(base, view), q, places=places, fresh=fresh
    )


def _add_costs_kernel(*tensors: Any, places: tuple[tuple[int, int], int], fresh: bool) -> None:
    C, code_0, code_1, a, b, c, q = tensors
    hw, margin = places
    warp = a, b[..., 0].contiguous(), c[:, 0].contiguous()
    limits = UNSEEN_COST, MIN_DEPTH_RATIO, BEHIND_SCALE
    torch.ops.dhtorch.add_census_costs.default(C, code_0, code_1, *warp, q.contiguous(), *hw, margin, *limits, fresh)


@operator(
    kernel=_add_costs_kernel,
    dtypes={"C": torch.uint8, "code_0": torch.int32, "code_1": torch.int32}
    | dict.fromkeys(("a", "b", "c", "q"), torch.float32),
    any_layout=("b", "c", "q"),
)
def _add_costs(*tensors: Any, places: tuple[tuple[int, int], int], fresh: bool) -> None:
    """:func:`add_census_costs` to C (B, h, w, D), of codes (B, N) and (B, H · W), the fields of :class:`EpipolarWarp`
    and the size and margin of the rectified view."""
    C, code_0, code_1, a, b, c, q = tensors
    seen = RectifiedView(code_1, *places)
    go = EpipolarWarp(a, b, c)
    if fresh:
        C.zero_()
    for k in range(q.shape[1]):
        C[..., k] += _census_cost(code_0, seen, go, q[:, k, None]).to(torch.uint8).unflatten(-1, C.shape[1:3])


def _new_cost_volume_kernel(q: Tensor, *, hw: tuple[int, int]) -> Tensor:
    return torch.empty(len(q), *hw, q.shape[1], dtype=torch.uint8).movedim(-1, 1)  # the kernel adds pixel by pixel


@operator(kernel=_new_cost_volume_kernel, dtypes={"q": torch.float32})
def new_cost_volume(q: Tensor, *, hw: tuple[int, int]) -> Tensor:
    """Memory for costs (B, D, h, w) uint8 at planes q (B, D), in the layout that :func:`add_census_costs` fills in the
    least time; its values are undefined. Gradient: none."""
    return torch.empty(*q.shape, *hw, dtype=torch.uint8, device=q.device)


def planes_last(C: Tensor) -> Tensor:
    """Costs (B, D, h, w) as (B, h, w, D), contiguous; a view of those of :func:`new_cost_volume` where that is
    possible. Gradient: none."""
    view = C.movedim(1, -1)
    if view.is_contiguous():
        return view
    last = C.new_empty(view.shape)
    for pixels_last, planes_last in zip(C.flatten(2), last.flatten(1, 2), strict=True):
        planes_last.copy_(pixels_last.t())  # of a matrix at once takes a quarter of what a permutation does
    return last


def aggregate_costs(
    C: Tensor,  # (B, h, w, D) whole numbers
    views: Tensor | int = 1,  # (B,) how many views' costs are in C
    *,
    step: int = STEP_COST,
    jump: int = JUMP_COST,
) -> Tensor:
    """Cost (B, h, w, D) int16 of the best surface through every pixel at every plane, from its four sides.

    Memory: two bytes for every place. Gradient: none.
    Source: H. Hirschmueller, "Stereo processing by semiglobal matching and mutual information", 2008, of four paths.
    """
    check("aggregate_costs", C=(C, "B h w D"))
    price = torch.as_tensor(views, dtype=torch.int16, device=C.device).reshape(-1, 1, 1)
    S = torch.zeros_like(C, dtype=torch.int16)
    for dim in (1, 2):
        _both_ways(C, S, dim, price * step, price * jump)
    return S


def _both_ways(C: Tensor, S: Tensor, dim: int, step: Tensor, jump: Tensor) -> None:
    """Add to S the costs of the best paths from the first row of C along ``dim``, and from the last."""
    n, D = C.shape[dim], C.shape[-1]
    here = torch.stack([C.select(dim, 0), C.select(dim, n - 1)]).to(torch.int16)
    path = F.pad(here, (1, 1), value=torch.iinfo(torch.int16).max // 2)  # no plane lies beyond the ends
    for k in range(n):
        now = path[..., 1:-1]
        if k:
            low = _least(now)
            best = torch.minimum(path[..., :D], path[..., 2:]).add_(step)
            best = torch.minimum(torch.minimum(best, now), low + jump)
            now.copy_(best.sub_(low))
            now[0].add_(C.select(dim, k))
            now[1].add_(C.select(dim, n - 1 - k))
        S.select(dim, k).add_(now[0])
        S.select(dim, n - 1 - k).add_(now[1])


def _least(x: Tensor) -> Tensor:
    """The smallest along the last axis, which stays: by halves, as long as that is faster."""
    n = x.shape[-1]
    while n > 16:
        half = (n + 1) // 2
        x, n = torch.minimum(x[..., :half], x[..., n - half :]), half
    return x.amin(-1, keepdim=True)


class BestPlane(NamedTuple):
    """The best plane of every pixel."""

    plane: Tensor  # (B, h, w) int64
    shift: Tensor  # (B, h, w) in [-0.5, 0.5] planes, to where the cost would be least
    cost: Tensor  # (B, h, w) of that plane


def best_plane(S: Tensor) -> BestPlane:
    """The plane of least cost S (B, h, w, D), the first of equals, and the parabola through its neighbours' costs."""
    check("best_plane", S=(S, "B h w D"))
    return BestPlane(*(torch.cat(part, 1) for part in zip(*map(_winner, S.split(ROWS_PER_BLOCK, 1)), strict=True)))


def _winner(S: Tensor) -> tuple[Tensor, ...]:
    D = S.shape[-1]
    plane = torch.arange(D, dtype=torch.int32, device=S.device)
    both = _least(S.to(torch.int32).mul_(D).add_(plane))[..., 0]  # the least cost, and of equals the first
    index, cost = (both % D).long(), both // D
    centre = index.clamp(1, D - 2)
    low, middle, high = (S.gather(-1, (centre + o)[..., None])[..., 0].float() for o in (-1, 0, 1))
    bend = low + high - 2 * middle
    shift = (0.5 * (low - high) / bend.clamp_min(1e-6)).clamp(-0.5, 0.5)
    shift = torch.where((bend > 0) & (index == centre), shift, torch.zeros_like(shift))
    return index, shift, cost.to(S.dtype)


def _aggregate_best_plane_kernel(C: Tensor, views: Tensor) -> tuple[BestPlane, Tensor]:
    B, h, w, D = C.shape
    prices = ((price * views).to(torch.int16).expand(B).contiguous() for price in (STEP_COST, JUMP_COST))
    best = BestPlane(*(torch.empty(B, h, w, dtype=dtype) for dtype in (torch.int64, torch.float32, torch.int16)))
    some = torch.empty(B, (h + 1) // 2, (w + 1) // 2, D, dtype=torch.int16)
    torch.ops.dhtorch.aggregate_best_plane.default(C, *prices, *best, some)
    return best, some


@operator(
    kernel=_aggregate_best_plane_kernel,
    dtypes={"C": torch.uint8, "views": (torch.int64, torch.int32, torch.int16)},
    any_layout=("views",),
)
def aggregate_best_plane(
    C: Tensor,  # (B, h, w, D) uint8
    views: Tensor,  # (B,) how many views' costs are in C
) -> tuple[BestPlane, Tensor]:
    """The best planes of the best surface, and its cost (B, ⌈h/2⌉, ⌈w/2⌉, D) at every other pixel, both ways.

    :func:`best_plane` of :func:`aggregate_costs`; the kernel keeps the costs of two rows only.
    """
    S = aggregate_costs(C, views)
    return best_plane(S), S[:, ::2, ::2]


def second_best_margin(some: Tensor, best: BestPlane, reach: Tensor) -> Tensor:
    """How much more the best plane costs (B, h, w) that lies further than ``reach`` (B,) planes from the winner.

    Asked at every other pixel, both ways, of the costs ``some`` (B, ⌈h/2⌉, ⌈w/2⌉, D) there, see
    :func:`aggregate_best_plane`; its neighbours have its answer. Gradient: none.
    """
    plane, cost = (x[:, ::2, ::2].contiguous() for x in (best.plane, best.cost))
    return _for_all(_second_best(some, plane, reach) - cost, best.cost)


def _second_best_kernel(some: Tensor, plane: Tensor, reach: Tensor) -> Tensor:
    least = torch.empty_like(plane, dtype=torch.int16)
    for b, far in enumerate(reach.tolist()):
        torch.ops.dhtorch.second_best.default(some[b].flatten(0, 1), plane[b], least[b], int(far))
    return least


@operator(
    kernel=_second_best_kernel,
    dtypes={"some": torch.int16, "plane": torch.int64, "reach": torch.float32},
    any_layout=("reach",),
)
def _second_best(some: Tensor, plane: Tensor, reach: Tensor) -> Tensor:
    """Least cost (B, h, w) of ``some`` (B, h, w, D) further than ``reach`` (B,) planes from ``plane`` (B, h, w)."""
    places = torch.arange(some.shape[-1], dtype=torch.int16, device=some.device)
    reach, found = reach.to(torch.int16)[:, None, None, None], []
    for part, at in zip(*(x.split(ROWS_PER_BLOCK // 2, 1) for x in (some, plane)), strict=True):  # as it is read
        near = (places - at[..., None].to(torch.int16)).abs() <= reach
        found.append(part.masked_fill(near, torch.iinfo(some.dtype).max).amin(-1))
    return torch.cat(found, 1)


def _for_all(x: Tensor, like: Tensor) -> Tensor:
    """What was asked at every other pixel, both ways, also for its neighbours."""
    return x.repeat_interleave(2, 1).repeat_interleave(2, 2)[:, : like.shape[1], : like.shape[2]]


class WindowFit(NamedTuple):
    """How the grey values around every pixel fit one view at the depths given; (B, h, w) each."""

    step: Tensor  # 1/m, the Gauss-Newton step of inverse depth
    contrast: Tensor  # m², variance in W of the grey value's change with q: what a step is told by
    noise: Tensor  # variance in W of the grey values' differences
    correlation: Tensor  # normalised, in [-1, 1]
    seen: Tensor  # bool
    motion: Tensor  # (B, h, w, 2) px·m, d pixel / d q


def stack_gradients(grey: Tensor) -> Tensor:
    """Pictures (B, 3, H, W): grey and its central differences along u and v, from (B, 1, H, W)."""
    padded = F.pad(grey, (1, 1, 1, 1), mode="replicate")
    du, dv = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    return torch.cat([grey, 0.5 * du, 0.5 * dv], 1)


def fit_windows(
    base: ReferenceView,
    view: SweptView,
    picture_1: Tensor,  # (B, 3, H, W), view 1's by with_gradients
    q: Tensor,  # (B, h, w) 1/m
    *,
    radius: int = FIT_RADIUS_PX,
) -> WindowFit:
    """One step of every pixel's inverse depth towards equal grey values in its window, whatever bias and gain.

    Every pixel of a window is read at its own depth, so that slanted and curved surfaces are compared as they are.

    Gradient: to everything; at the depth that fits the step is 0 and its derivative that of the depth (implicit
    function theorem, with the Gauss-Newton Hessian).
    """
    flat = q.flatten(1)
    little = 1e-3 * flat.detach().amax(1, keepdim=True).clamp_min(1e-3)
    uv, front = project_inverse_depth(view, base.ray, flat)
    further = project_inverse_depth(view, base.ray, flat + little)[0]
    return _fit_windows(base.image, picture_1, uv, further, little, front, radius=radius)


def _has_kernel_radius(*_: Tensor, radius: int) -> bool:
    return radius == FIT_RADIUS_PX


def _fit_windows_kernel(
    grey: Tensor, picture_1: Tensor, uv: Tensor, further: Tensor, little: Tensor, front: Tensor, *, radius: int
) -> WindowFit:
    places = uv.mT.contiguous(), further.mT.contiguous(), little[:, 0]
    outputs = step, contrast, noise, correlation = tuple(torch.empty_like(grey[:, 0]) for _ in range(4))
    inside = torch.empty_like(step, dtype=torch.bool)
    motion = torch.empty_like(places[0])
    limits = *WINDOW_GAIN_RANGE, FLAT_VARIANCE, FLAT_GRADIENT_VARIANCE
    torch.ops.dhtorch.fit_windows.default(grey, picture_1, *places, *outputs, inside, motion, *limits)
    seen = inside & front.view_as(inside)
    return WindowFit(step, contrast, noise, correlation, seen, motion.mT.unflatten(1, inside.shape[1:]))


@operator(
    kernel=_fit_windows_kernel,
    dtypes=dict.fromkeys(("grey", "picture_1", "uv", "further", "little"), torch.float32) | {"front": torch.bool},
    any_layout=("uv", "further", "front"),
    when=_has_kernel_radius,
)
def _fit_windows(
    grey: Tensor, picture_1: Tensor, uv: Tensor, further: Tensor, little: Tensor, front: Tensor, *, radius: int
) -> WindowFit:
    """:func:`fit_windows` of view 0's grey values (B, 1, h, w), where view 1 shows its pixels, ``uv`` (B, N, 2), and
    would show them nearer by ``little`` (B, 1) 1/m, ``further`` (B, N, 2); ``front`` (B, N): not behind it."""
    hw = grey.shape[-2:]
    motion = (further - uv) / little[..., None]
    values, inside = sample_bilinear(picture_1, uv)
    J, du, dv = (x.unflatten(-1, hw) for x in values.unbind(1))
    du_dq, dv_dq = (x.unflatten(-1, hw) for x in motion.unbind(-1))
    g = du * du_dq + dv * dv_dq
    I = grey[:, 0]  # noqa: E741  (the alphabet of registration)
    share = 1 / (2 * radius + 1) ** 2
    products = (I, J, g, I * I, J * J, I * J, g * g, g * I, g * J)
    i, j, k, ii, jj, ij, kk, ki, kj = (share * window_sum(x, radius) for x in products)
    ii, jj, ij = (ii - i * i).clamp_min(FLAT_VARIANCE), (jj - j * j).clamp_min(FLAT_VARIANCE), ij - i * j
    kk = (kk - k * k).clamp_min(FLAT_GRADIENT_VARIANCE)
    gain = (ij / jj).clamp(*WINDOW_GAIN_RANGE)
    return WindowFit(
        step=((ki - k * i) - gain * (kj - k * j)) / (gain * kk),
        contrast=kk * gain * gain,
        noise=(ii + gain * gain * jj - 2 * gain * ij).clamp_min(0),
        correlation=ij / (ii * jj).sqrt(),
        seen=(inside & front).unflatten(-1, hw),
        motion=motion.unflatten(1, hw),
    )


def occlusion_mask(go: EpipolarWarp, q: Tensor, tolerance: Tensor) -> Tensor:
    """Which pixels (B, h, w) of a map of inverse depths another one covers in view 1, nearer by more than
    ``tolerance`` (B,) 1/m. Gradient: none."""
    return _occlusion_mask(*go, q.flatten(1), tolerance, hw=(q.shape[1], q.shape[2])).unflatten(1, q.shape[1:])


def _with_border(hw: tuple[int, int]) -> tuple[tuple[int, int], int]:
    """Height and width of a picture with the border in which points beside it are looked for; the border's width."""
    edge = max(hw) // BORDER_DIVISOR
    return (hw[0] + 2 * edge, hw[1] + 2 * edge), edge


def _occlusion_mask_kernel(
    a: Tensor, b: Tensor, c: Tensor, q: Tensor, tolerance: Tensor, *, hw: tuple[int, int]
) -> Tensor:
    size, edge = _with_border(hw)
    covered = torch.empty_like(q, dtype=torch.bool)
    warp = a, b[..., 0].contiguous(), c[:, 0].contiguous()
    limits = MIN_DEPTH_RATIO, BEHIND_SCALE
    torch.ops.dhtorch.occlusion_mask.default(*warp, q, tolerance, covered, *size, edge, *limits)
    return covered


@operator(
    kernel=_occlusion_mask_kernel,
    dtypes=dict.fromkeys(("a", "b", "c", "q", "tolerance"), torch.float32),
    any_layout=("b", "c"),
)
def _occlusion_mask(a: Tensor, b: Tensor, c: Tensor, q: Tensor, tolerance: Tensor, *, hw: tuple[int, int]) -> Tensor:
    """:func:`occlusion_mask` (B, N) of a map (B, N) of size ``hw`` and the fields of :class:`EpipolarWarp`."""
    size, edge = _with_border(hw)
    index = EpipolarWarp(a, b, c).cell(q, size, edge)
    front = q.new_full((len(q), size[0] * size[1]), -1.0).scatter_reduce(1, index, q, "amax")
    return front.gather(1, index) > q + tolerance[:, None]
