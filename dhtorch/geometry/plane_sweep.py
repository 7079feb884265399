"""Plane sweep: the matching cost of every pixel of a reference view in a source view at every depth -> best surface.

Alphabet: q inverse depth (1/m), of D *planes*, rising from 0 (infinity); N = h · w pixels of the reference view (view
0), row by row, and their rays r (z = 1); R, t the motion to the source view (view 1), in which a pixel projects to
π(R r + q t); a *code* is the census of a window, 31 signs in one int32; C (B, h, w, D) the cost, the number of signs
that differ; S the aggregated cost, of the best surface through a pixel and plane; W the windows in which the surface is
refined by grey values.

The source view is resampled once, into the orientation of the reference view (*rectified*): a plane then moves pixels
only along their epipolar lines, windows are not rotated against each other, and codes are computed once and looked up.
The resampling includes lens distortion and the rotation of a rolling shutter; no image is undistorted first.

All costs are integers: they depend on no order of summation, so not on batch, threads, tiles or device.
"""

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import all_finite, all_known, check, constant, shaped
from dhtorch.geometry.se3 import Pose
from dhtorch.geometry.windows import window_sum
from dhtorch.ops.constants import FIT_RADIUS_PX
from dhtorch.ops.dispatch import operator, run_kernel
from dhtorch.pytree import Record, record

#: Offsets (down, right) of the signs of a census, px: a checkerboard of 9 x 7 pixels without its middle pixel. 31 signs
#: fit an int32 whose sign bit marks unseen pixels.
CENSUS_OFFSETS = tuple((i, j) for i in range(-3, 4) for j in range(-4, 5) if (i + j) % 2 and (i, j) != (-3, -4))[:31]

#: Smoothness cost of a step of one plane between neighbouring pixels, in signs.
STEP_COST = 3

#: Smoothness cost of a jump of any height between neighbouring pixels, in signs.
JUMP_COST = 18

#: Cost of a pixel that the source view does not show, in signs: less than a misfit (half of the signs), more than a
#: fit.
UNSEEN_COST = 11

#: Aggregation paths per pixel: from the left, right, top and bottom. Source: derived, 2 axes · 2 directions.
N_PATHS = 4

#: Largest number of source views whose costs, at most 31 signs each, add up in one byte. Source: derived, ⌊255 / 31⌋.
MAX_SWEPT_VIEWS = 8

#: Rows whose best planes are computed at once.
ROWS_PER_BLOCK = 32

#: Margin around the reference image in which the source view is sampled: its longer side over this number.
BORDER_DIVISOR = 4

#: Lower limit of the variance, in a window, of the grey value's derivative by inverse depth, m².
FLAT_GRADIENT_VARIANCE = 1e-12

#: Limits of the gain between two windows, a ratio.
WINDOW_GAIN_RANGE = (0.5, 2.0)

#: Lower limit of the variance of grey values (in [0, 1]) in a window.
FLAT_VARIANCE = 1e-8

#: Depth in the source view over depth in the reference view up to which a point is behind the source view.
MIN_DEPTH_RATIO = 1e-3

#: Factor on the pixel of a point behind the source view, which moves it outside any image.
BEHIND_SCALE = 1e9


@record
class ReferenceView(Record):
    """The reference view (view 0), whose pixels get a depth; built by :func:`make_reference_view`."""

    image: Tensor  # (B, 1, h, w) grey
    camera: Camera
    ray: Tensor  # (B, N, 3) z = 1; the optical axis where the lens model has no ray
    known: Tensor  # (B, N) bool, the lens model has a ray
    ideal_uv: Tensor  # (B, 2, N) px, of the rays in the camera without its lens
    code: Tensor  # (B, h, w) int32, see census

    @property
    def hw(self) -> tuple[int, int]:
        """Height and width of the image."""
        return self.image.shape[-2], self.image.shape[-1]


@record
class SweptView(Record):
    """A source view (view 1) and its pose relative to the reference view."""

    image: Tensor  # (B, 1, H, W) grey
    camera: Camera
    T_1_from_0: Pose
    shutter_rate: Tensor | None = None  # (B, 3) rad per unit of y, of a rolling shutter


class EpipolarWarp(NamedTuple):
    """Inverse depth q of a reference pixel -> pixel of the rectified image, (a + q b) / (1 + q c), px of view 0."""

    a: Tensor  # (B, 2, N)
    b: Tensor  # (B, 2, 1)
    c: Tensor  # (B, 1)

    def at(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse depths q (B, N) or (B, 1) -> pixels u and v, (B, N) each; far outside for points behind view 1."""
        z = 1 + q * self.c
        scale = torch.where(z > MIN_DEPTH_RATIO, 1 / z, BEHIND_SCALE)
        u, v = ((self.a[:, k] + q * self.b[:, k]) * scale for k in (0, 1))
        return u, v

    def cell(self, q: Tensor, hw: tuple[int, int], margin: int) -> Tensor:
        """Inverse depths -> flat index (B, N) of the nearest pixel of an image of size ``hw`` in which view 0 begins
        ``margin`` px from the border; of a border pixel for points outside."""
        column, row = (
            x.add_(margin + 0.5)
            .clamp_(0, size - 1)
            .to(torch.int32)  # truncation, which is floor for non-negative numbers
            for x, size in zip(self.at(q), hw[::-1], strict=True)
        )
        return row.mul_(hw[1]).add_(column).long()


def pixel_rays(camera: Camera, hw: tuple[int, int], margin: int = 0) -> Tensor:
    """Camera and image size -> rays (B, N, 3), z = 1, of its pixels and ``margin`` px around; NaN outside the lens.

    In memory each axis is a contiguous plane, as are all per-pixel numbers of this module: operations then run along
    pixels.
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


@shaped("image: B 1 h w, camera.f: B 2")
def make_reference_view(image: Tensor, camera: Camera) -> ReferenceView:
    """Grey image (B, 1, h, w) and camera -> reference view. Gradient: to the image and, through the rays, to the
    camera."""
    ray = pixel_rays(camera, (image.shape[-2], image.shape[-1]))
    has_ray = all_finite(ray, -1) if camera.distortion is not None else _has_focal_length(camera, ray)
    if not all_known(has_ray):
        ray = torch.where(has_ray[..., None], ray, constant(ray, [0.0, 0.0, 1.0]))
    ideal_uv = ray[..., :2].mT * camera.f[..., None] + camera.c[..., None]
    return ReferenceView(image, camera, ray, has_ray, ideal_uv.contiguous(), census_transform(image.detach()))


def _has_focal_length(camera: Camera, ray: Tensor) -> Tensor:
    """Whether a camera without distortion has rays (B, N, 3): (B, N), finite parameters and a non-zero focal length."""
    is_finite = (camera.f.isfinite() & (camera.f != 0) & camera.c.isfinite()).all(-1, keepdim=True)
    return is_finite.expand(ray.shape[:-1]).contiguous()


@shaped("ray: B N 3, q: B N, view.T_1_from_0.t: B 3")
def project_inverse_depth(view: SweptView, ray: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Rays (B, N, 3) of view 0 and inverse depths q (B, N) -> pixels (B, N, 2) of view 1, and whether the points lie in
    front of it (B, N). Gradient: to everything."""
    T, camera = view.T_1_from_0, view.camera
    cam.check_lens(camera)
    return _project(ray, q, T.R, T.t, view.shutter_rate, *(camera.f, camera.c, camera.distortion))


def _project_kernel(*tensors: Any) -> tuple[Tensor, Tensor]:
    ray, q, R, t, shutter_rate, f, c, distortion = tensors
    planes = ray.mT.contiguous()
    uv = torch.empty_like(planes[:, :2])
    in_front = torch.empty_like(q, dtype=torch.bool)
    motion = R, t, torch.zeros_like(t) if shutter_rate is None else shutter_rate
    lens = t.new_empty(0, 0) if distortion is None else distortion
    torch.ops.dhtorch.project_inverse_depth.default(planes, q, *motion, f, c, lens, *(uv, in_front), MIN_DEPTH_RATIO)
    return uv.mT, in_front


@operator(
    kernel=_project_kernel,
    dtypes=dict.fromkeys(("ray", "q", "R", "t", "shutter_rate", "f", "c", "distortion"), torch.float32),
    any_layout=("ray",),
)
def _project(*tensors: Any) -> tuple[Tensor, Tensor]:
    """:func:`project_inverse_depth` under a motion, into a camera's intrinsics."""
    ray, q, R, t, shutter_rate, f, c, distortion = tensors
    x, y, z = (component + q * t[:, None] for component, t in zip(rotate_rays(R, ray), t.unbind(-1), strict=True))
    if shutter_rate is not None:
        p, o, s = (shutter_rate[:, k, None] * ray[..., 1] for k in range(3))
        x, y, z = x + (o * z - s * y), y + (s * x - p * z), z + (p * y - o * x)
    in_front = z > MIN_DEPTH_RATIO
    x, y, z = (torch.where(in_front, component, 1.0) for component in (x, y, z))
    if distortion is not None:
        return cam.project(Camera(f, c, distortion), torch.stack((x, y, z), -1)), in_front
    axes = [component / z * f[:, k, None] + c[:, k, None] for k, component in enumerate((x, y))]
    return torch.stack(axes, 1).mT, in_front


def rotate_rays(R: Tensor, ray: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (B, 3, 3) times rays (B, N, 3) -> one tensor (B, N) per axis, the numbers of
    :func:`dhtorch.geometry.se3.rotate`, which takes several times as long on so many. Gradient: to both."""
    x, y, z = ray.unbind(-1)
    right, down, forward = (x * row[:, 0, None] + y * row[:, 1, None] + z * row[:, 2, None] for row in R.unbind(1))
    return right, down, forward


@operator(
    kernel=lambda image, uv: run_kernel(
        "sample_bilinear",
        (image, uv.mT),
        (image.new_empty(*image.shape[:2], uv.shape[1]), uv.new_empty(uv.shape[:2], dtype=torch.bool)),
    ),
    dtypes={"image": torch.float32, "uv": torch.float32},
    any_layout=("uv",),
)
def sample_bilinear(image: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Images (B, C, H, W) and pixels (B, N, 2) -> bilinear values (B, C, N), and which pixels lie inside (B, N).

    Gradient: to both."""
    H, W = image.shape[-2:]
    size = constant(uv, [W, H])
    inside = ((uv >= 0) & (uv <= size - 1)).all(-1)
    grid = ((2 * uv + 1) / size - 1).clamp(-2, 2)[:, :, None]
    values = F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values[..., 0], inside


def epipolar_warp(base: ReferenceView, view: SweptView) -> EpipolarWarp:
    """Reference and source view -> path of every reference pixel in the rectified image. Gradient: to cameras and
    motion."""
    s = se3.rotate(view.T_1_from_0.R.mT, view.T_1_from_0.t[:, None]).mT
    f, c = base.camera.f[..., None], base.camera.c[..., None]
    return EpipolarWarp(base.ideal_uv, s[:, :2] * f + c * s[:, 2:], s[:, 2])


@operator(
    kernel=shaped("grey: B 1 h w", "census_transform")(
        lambda grey: run_kernel(
            "census_transform",
            (grey[:, 0], torch.tensor(CENSUS_OFFSETS)),
            torch.empty_like(grey[:, 0], dtype=torch.int32),
        )
    ),
    dtypes={"grey": torch.float32},
)
@shaped("grey: B 1 h w")
def census_transform(grey: Tensor) -> Tensor:
    """Images (B, 1, h, w) -> codes (B, h, w) int32: of each of 31 neighbours whether it is darker than the middle."""
    h, w = grey.shape[-2:]
    padded, middle = F.pad(grey, (4, 4, 3, 3), mode="replicate")[:, 0], grey[:, 0]
    code = torch.zeros_like(middle, dtype=torch.int32)
    for first in range(0, len(CENSUS_OFFSETS), 8):  # one byte at a time takes a quarter of the memory
        byte = torch.zeros_like(middle, dtype=torch.uint8)
        for k, (i, j) in enumerate(CENSUS_OFFSETS[first : first + 8]):
            byte += (padded[:, 3 + i : 3 + i + h, 4 + j : 4 + j + w] < middle).to(torch.uint8).mul_(1 << k)
        code += byte.to(torch.int32) << first
    return code


@torch.no_grad()
def add_census_costs(
    C: Tensor,  # (B, D, h, w) uint8, in place
    base: ReferenceView,
    view: SweptView,
    q: Tensor,  # (B, D)
    wanted: Tensor,  # (B,) bool, other pairs cost UNSEEN_COST everywhere
    *,
    fresh: bool = False,
) -> None:
    """Add the matching costs of every pixel and plane in a source view to C; ``fresh``: C is overwritten.

    At most :data:`MAX_SWEPT_VIEWS` views fit into a byte. C comes from :func:`new_cost_volume`, or has its planes first
    in memory. Memory: images of view 0's size, whatever D. Gradient: none.
    """
    height, width, margin = _padded_size(base.hw)
    hw = height, width
    # The source view in the orientation of the reference view, on its pixel grid plus the margin.
    ray = pixel_rays(cam.ideal(base.camera), base.hw, margin)
    uv, in_front = project_inverse_depth(view, ray, ray.new_zeros(ray.shape[:2]))
    grey, inside = sample_bilinear(view.image, uv)
    visible = (inside & in_front).unflatten(-1, hw) & wanted[:, None, None]
    visible = F.pad(visible[:, 1:-1, 1:-1], (1, 1, 1, 1))
    code = torch.where(visible, census_transform(grey.detach().unflatten(-1, hw)[:, 0, None]), -1).flatten(1)
    warp = epipolar_warp(base, view)
    _add_costs(C.movedim(1, -1), base.code.flatten(1), code, *warp, q, layout=(hw, margin), fresh=fresh)


def _add_costs_kernel(*tensors: Any, layout: tuple[tuple[int, int], int], fresh: bool) -> None:
    C, code_0, code_1, a, b, c, q = tensors
    hw, margin = layout
    warp = a, b[..., 0].contiguous(), c[:, 0].contiguous()
    limits = UNSEEN_COST, MIN_DEPTH_RATIO, BEHIND_SCALE
    torch.ops.dhtorch.add_census_costs.default(C, code_0, code_1, *warp, q.contiguous(), *hw, margin, *limits, fresh)


@operator(
    kernel=_add_costs_kernel,
    dtypes={"C": torch.uint8, "code_0": torch.int32, "code_1": torch.int32}
    | dict.fromkeys(("a", "b", "c", "q"), torch.float32),
    any_layout=("b", "c", "q"),
)
def _add_costs(*tensors: Any, layout: tuple[tuple[int, int], int], fresh: bool) -> None:
    """:func:`add_census_costs` to C (B, h, w, D), from codes (B, N) and (B, H · W), negative where view 1 shows
    nothing, the fields of :class:`EpipolarWarp` and ``layout``, the size and margin of the rectified view."""
    C, code_0, code_1, a, b, c, q = tensors
    warp = EpipolarWarp(a, b, c)
    if fresh:
        C.zero_()
    for k in range(q.shape[1]):
        code = code_1.gather(1, warp.cell(q[:, k, None], *layout))
        x = code ^ code_0  # the number of bits that are set among its lower 31
        x = x - x.bitwise_right_shift(1).bitwise_and_(0x55555555)
        high = x.bitwise_right_shift(2).bitwise_and_(0x33333333)
        x = x.bitwise_and_(0x33333333).add_(high)
        x = x.add_(x.bitwise_right_shift(4)).bitwise_and_(0x0F0F0F0F)
        # the highest byte holds the sum of all bytes
        count = x.mul_(0x01010101).bitwise_right_shift_(24)
        unseen = code.bitwise_right_shift(31)  # all bits or none; boolean masks take three times as long
        cost = count.add_(unseen.bitwise_and_(UNSEEN_COST - count))
        C[..., k] += cost.to(torch.uint8).unflatten(-1, C.shape[1:3])


# The kernel fills the volume pixel by pixel.
@operator(
    kernel=lambda q, *, hw: torch.empty(len(q), *hw, q.shape[1], dtype=torch.uint8).movedim(-1, 1),
    dtypes={"q": torch.float32},
)
def new_cost_volume(q: Tensor, *, hw: tuple[int, int]) -> Tensor:
    """Planes q (B, D) and image size -> uninitialised costs (B, D, h, w) uint8, in the memory layout that
    :func:`add_census_costs` fills fastest. Gradient: none."""
    return torch.empty(*q.shape, *hw, dtype=torch.uint8, device=q.device)


def planes_last(C: Tensor) -> Tensor:
    """Costs (B, D, h, w) -> (B, h, w, D), contiguous; a view of those of :func:`new_cost_volume` where possible.

    Gradient: none."""
    view = C.movedim(1, -1)
    if view.is_contiguous():
        return view
    last = C.new_empty(view.shape)
    for pixels_last, planes_last in zip(C.flatten(2), last.flatten(1, 2), strict=True):
        planes_last.copy_(pixels_last.t())  # matrix by matrix takes a quarter of the time of a permutation
    return last


def aggregate_costs(
    C: Tensor,  # (B, h, w, D) integers
    views: Tensor | int = 1,  # (B,), or one for all: number of views whose costs C sums
    *,
    step: int = STEP_COST,
    jump: int = JUMP_COST,
) -> Tensor:
    """Costs C -> costs (B, h, w, D) int16 of the best surface through every pixel and plane, summed over four paths.

    Memory: two bytes per pixel and plane. Gradient: none.
    Source: H. Hirschmueller, "Stereo processing by semiglobal matching and mutual information", 2008, of four paths.
    """
    price = torch.as_tensor(views, dtype=torch.int16, device=C.device)
    check("aggregate_costs", C=(C, "B h w D"), views=(price if price.dim() else None, "B"))
    price = price.reshape(-1, 1, 1)
    S = torch.zeros_like(C, dtype=torch.int16)
    for dim in (1, 2):
        _add_paths(C, S, dim, price * step, price * jump)
    return S


def _add_paths(C: Tensor, S: Tensor, dim: int, step: Tensor, jump: Tensor) -> None:
    """Add to S the costs of the best paths along ``dim`` from the first row of C and from the last."""
    n, D = C.shape[dim], C.shape[-1]
    ends = torch.stack([C.select(dim, 0), C.select(dim, n - 1)]).to(torch.int16)
    path = F.pad(ends, (1, 1), value=torch.iinfo(torch.int16).max // 2)  # no plane beyond either end
    for k in range(n):
        current = path[..., 1:-1]
        if k:
            lowest = _min_last(current)
            best = torch.minimum(path[..., :D], path[..., 2:]).add_(step)
            best = torch.minimum(torch.minimum(best, current), lowest + jump)
            current.copy_(best.sub_(lowest))
            current[0].add_(C.select(dim, k))
            current[1].add_(C.select(dim, n - 1 - k))
        S.select(dim, k).add_(current[0])
        S.select(dim, n - 1 - k).add_(current[1])


def _min_last(x: Tensor) -> Tensor:
    """Minimum along the last axis, which is kept: by halves, as long as that is faster."""
    n = x.shape[-1]
    while n > 16:
        half = (n + 1) // 2
        x, n = torch.minimum(x[..., :half], x[..., n - half :]), half
    return x.amin(-1, keepdim=True)


class _BestPlane(NamedTuple):
    """The best plane of every pixel."""

    plane: Tensor  # (B, h, w) int64
    shift: Tensor  # (B, h, w) in [-0.5, 0.5] planes, to the minimum of the parabola
    cost: Tensor  # (B, h, w) of that plane


@shaped("S: B h w D")
def best_plane(S: Tensor) -> _BestPlane:
    """Aggregated costs S (B, h, w, D) -> plane of least cost, the first of equals, and parabolic sub-plane shift."""
    return _BestPlane(
        *(torch.cat(part, 1) for part in zip(*map(_argmin_subplane, S.split(ROWS_PER_BLOCK, 1)), strict=True))
    )


def _argmin_subplane(S: Tensor) -> tuple[Tensor, ...]:
    D = S.shape[-1]
    plane = torch.arange(D, dtype=torch.int32, device=S.device)
    cost_and_plane = _min_last(S.to(torch.int32).mul_(D).add_(plane))[..., 0]  # least cost, the first of equals
    index, cost = (cost_and_plane % D).long(), cost_and_plane // D
    centre = index.clamp(1, D - 2)
    low, middle, high = (S.gather(-1, (centre + o)[..., None])[..., 0].float() for o in (-1, 0, 1))
    curvature = low + high - 2 * middle
    shift = (0.5 * (low - high) / curvature.clamp_min(1e-6)).clamp(-0.5, 0.5)
    shift = torch.where((curvature > 0) & (index == centre), shift, torch.zeros_like(shift))
    return index, shift, cost.to(S.dtype)


def _aggregate_best_plane_kernel(C: Tensor, views: Tensor) -> tuple[_BestPlane, Tensor]:
    B, h, w, D = C.shape
    prices = ((price * views).to(torch.int16).expand(B).contiguous() for price in (STEP_COST, JUMP_COST))
    best = _BestPlane(*(torch.empty(B, h, w, dtype=dtype) for dtype in (torch.int64, torch.float32, torch.int16)))
    sampled_costs = torch.empty(B, (h + 1) // 2, (w + 1) // 2, D, dtype=torch.int16)
    torch.ops.dhtorch.aggregate_best_plane.default(C, *prices, *best, sampled_costs)
    return best, sampled_costs


@operator(
    kernel=_aggregate_best_plane_kernel,
    dtypes={"C": torch.uint8, "views": (torch.int64, torch.int32, torch.int16)},
    any_layout=("views",),
)
def aggregate_best_plane(
    C: Tensor,  # (B, h, w, D) uint8
    views: Tensor,  # (B,) number of views whose costs C sums
) -> tuple[_BestPlane, Tensor]:
    """Costs C -> best planes, and the aggregated costs (B, ⌈h/2⌉, ⌈w/2⌉, D) of every other row and column.

    :func:`best_plane` of :func:`aggregate_costs`; the kernel keeps the aggregated costs of two rows only.
    """
    S = aggregate_costs(C, views)
    return best_plane(S), S[:, ::2, ::2]


def second_best_margin(some: Tensor, best: _BestPlane, reach: Tensor) -> Tensor:
    """Cost margin (B, h, w) of the best plane over the best one further than ``reach`` (B,) planes away.

    Computed at every other row and column from the costs ``some`` (B, ⌈h/2⌉, ⌈w/2⌉, D) of
    :func:`aggregate_best_plane`, and repeated for the neighbouring pixels. Gradient: none.
    """
    plane, cost = (x[:, ::2, ::2].contiguous() for x in (best.plane, best.cost))
    return (
        (_second_best(some, plane, reach) - cost)
        .repeat_interleave(2, 1)
        .repeat_interleave(2, 2)[:, : best.cost.shape[1], : best.cost.shape[2]]
    )


def _second_best_kernel(costs: Tensor, plane: Tensor, reach: Tensor) -> Tensor:
    least = torch.empty_like(plane, dtype=torch.int16)
    for b, distance in enumerate(reach.tolist()):
        torch.ops.dhtorch.second_best.default(costs[b].flatten(0, 1), plane[b], least[b], int(distance))
    return least


@operator(
    kernel=_second_best_kernel,
    dtypes={"costs": torch.int16, "plane": torch.int64, "reach": torch.float32},
    any_layout=("reach",),
)
def _second_best(costs: Tensor, plane: Tensor, reach: Tensor) -> Tensor:
    """Least of the ``costs`` (B, h, w, D) further than ``reach`` (B,) planes from ``plane`` (B, h, w): (B, h, w)."""
    plane_index = torch.arange(costs.shape[-1], dtype=torch.int16, device=costs.device)
    reach, least = reach.to(torch.int16)[:, None, None, None], []
    for block, block_plane in zip(*(x.split(ROWS_PER_BLOCK // 2, 1) for x in (costs, plane)), strict=True):
        near = (plane_index - block_plane[..., None].to(torch.int16)).abs() <= reach
        least.append(block.masked_fill(near, torch.iinfo(costs.dtype).max).amin(-1))
    return torch.cat(least, 1)


class _WindowFit(NamedTuple):
    """Fit of the grey values around every pixel in one source view at given depths; (B, h, w) each."""

    step: Tensor  # 1/m, the Gauss-Newton step of inverse depth
    contrast: Tensor  # m², variance in W of the grey value's derivative by q: the information of a step
    noise: Tensor  # variance in W of the grey values' differences
    correlation: Tensor  # normalised, in [-1, 1]
    seen: Tensor  # bool
    motion: Tensor  # (B, h, w, 2) px·m, d pixel / d q


def stack_gradients(grey: Tensor) -> Tensor:
    """Grey images (B, 1, H, W) -> (B, 3, H, W): grey and its central differences along u and v."""
    padded = F.pad(grey, (1, 1, 1, 1), mode="replicate")
    du, dv = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    return torch.cat([grey, 0.5 * du, 0.5 * dv], 1)


def fit_windows(
    base: ReferenceView,
    view: SweptView,
    picture_1: Tensor,  # (B, 3, H, W), of view 1 by stack_gradients
    q: Tensor,  # (B, h, w) 1/m
    *,
    radius: int = FIT_RADIUS_PX,
) -> _WindowFit:
    """Inverse depths q -> one Gauss-Newton step per pixel towards equal grey values in its window, up to gain and bias.

    Every pixel of a window is sampled at its own depth, so that slanted and curved surfaces are compared undistorted.

    Gradient: to everything; at the depth of best fit the step is 0 and its derivative that of the depth (implicit
    function theorem, with the Gauss-Newton Hessian).
    """
    flat = q.flatten(1)
    delta_q = 1e-3 * flat.detach().amax(1, keepdim=True).clamp_min(1e-3)
    uv, in_front = project_inverse_depth(view, base.ray, flat)
    uv_nearer = project_inverse_depth(view, base.ray, flat + delta_q)[0]
    return _fit_windows(base.image, picture_1, uv, uv_nearer, delta_q, in_front, radius=radius)


def _fit_windows_kernel(
    grey: Tensor, picture_1: Tensor, uv: Tensor, uv_nearer: Tensor, delta_q: Tensor, in_front: Tensor, *, radius: int
) -> _WindowFit:
    positions = uv.mT.contiguous(), uv_nearer.mT.contiguous(), delta_q[:, 0]
    outputs = step, contrast, noise, correlation = tuple(torch.empty_like(grey[:, 0]) for _ in range(4))
    inside = torch.empty_like(step, dtype=torch.bool)
    motion = torch.empty_like(positions[0])
    limits = *WINDOW_GAIN_RANGE, FLAT_VARIANCE, FLAT_GRADIENT_VARIANCE
    torch.ops.dhtorch.fit_windows.default(grey, picture_1, *positions, *outputs, inside, motion, *limits)
    seen = inside & in_front.view_as(inside)
    return _WindowFit(step, contrast, noise, correlation, seen, motion.mT.unflatten(1, inside.shape[1:]))


@operator(
    kernel=_fit_windows_kernel,
    dtypes=dict.fromkeys(("grey", "picture_1", "uv", "uv_nearer", "delta_q"), torch.float32) | {"in_front": torch.bool},
    any_layout=("uv", "uv_nearer", "in_front"),
    when=lambda *_, radius: radius == FIT_RADIUS_PX,
)
def _fit_windows(
    grey: Tensor, picture_1: Tensor, uv: Tensor, uv_nearer: Tensor, delta_q: Tensor, in_front: Tensor, *, radius: int
) -> _WindowFit:
    """:func:`fit_windows` of view 0's grey values (B, 1, h, w) and the pixels of view 1 that they project to: ``uv``
    (B, N, 2), and ``uv_nearer`` (B, N, 2) for inverse depths larger by ``delta_q`` (B, 1) 1/m; ``in_front`` (B, N)."""
    hw = grey.shape[-2:]
    motion = (uv_nearer - uv) / delta_q[..., None]
    values, inside = sample_bilinear(picture_1, uv)
    J, du, dv = (x.unflatten(-1, hw) for x in values.unbind(1))
    du_dq, dv_dq = (x.unflatten(-1, hw) for x in motion.unbind(-1))
    g = du * du_dq + dv * dv_dq
    I = grey[:, 0]  # noqa: E741  (the alphabet of registration)
    weight = 1 / (2 * radius + 1) ** 2
    products = (I, J, g, I * I, J * J, I * J, g * g, g * I, g * J)
    i, j, k, ii, jj, ij, kk, ki, kj = (weight * window_sum(x, radius) for x in products)
    ii, jj, ij = (ii - i * i).clamp_min(FLAT_VARIANCE), (jj - j * j).clamp_min(FLAT_VARIANCE), ij - i * j
    kk = (kk - k * k).clamp_min(FLAT_GRADIENT_VARIANCE)
    gain = (ij / jj).clamp(*WINDOW_GAIN_RANGE)
    return _WindowFit(
        step=((ki - k * i) - gain * (kj - k * j)) / (gain * kk),
        contrast=kk * gain * gain,
        noise=(ii + gain * gain * jj - 2 * gain * ij).clamp_min(0),
        correlation=ij / (ii * jj).sqrt(),
        seen=(inside & in_front).unflatten(-1, hw),
        motion=motion.unflatten(1, hw),
    )


def occlusion_mask(go: EpipolarWarp, q: Tensor, tolerance: Tensor) -> Tensor:
    """Inverse depths q (B, h, w) -> which pixels (B, h, w) are occluded in view 1, by a pixel nearer by more than
    ``tolerance`` (B,) 1/m. Gradient: none."""
    return _occlusion_mask(*go, q.flatten(1), tolerance, hw=(q.shape[1], q.shape[2])).unflatten(1, q.shape[1:])


def _padded_size(hw: tuple[int, int]) -> tuple[int, int, int]:
    """Image size -> height and width with a border for points outside the image; width of the border, px."""
    border = max(hw) // BORDER_DIVISOR
    return hw[0] + 2 * border, hw[1] + 2 * border, border


@operator(
    kernel=lambda a, b, c, q, tolerance, *, hw: run_kernel(
        "occlusion_mask",
        (a, b[..., 0], c[:, 0], q, tolerance),
        torch.empty_like(q, dtype=torch.bool),
        *(*_padded_size(hw), MIN_DEPTH_RATIO, BEHIND_SCALE),
    ),
    dtypes=dict.fromkeys(("a", "b", "c", "q", "tolerance"), torch.float32),
    any_layout=("b", "c"),
)
def _occlusion_mask(a: Tensor, b: Tensor, c: Tensor, q: Tensor, tolerance: Tensor, *, hw: tuple[int, int]) -> Tensor:
    """:func:`occlusion_mask` (B, N) of a map (B, N) of size ``hw`` and the fields of :class:`EpipolarWarp`."""
    height, width, border = _padded_size(hw)
    index = EpipolarWarp(a, b, c).cell(q, (height, width), border)
    nearest = q.new_full((len(q), height * width), -1.0).scatter_reduce(1, index, q, "amax")
    return nearest.gather(1, index) > q + tolerance[:, None]
