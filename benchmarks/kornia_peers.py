"""What is asked of us and of kornia in :mod:`beside_kornia`: one :class:`Peer` for every pair of functions.

Where our function calls kornia's, ``ours`` is what we had before, from :mod:`before_kornia`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import before_kornia as before
import kornia.geometry as kg
import numpy as np
import torch
from kornia import filters as kf
from kornia import morphology
from kornia.color import rgb_to_grayscale
from kornia.enhance import normalize
from kornia.feature import gftt_response
from kornia.geometry import conversions as kc
from kornia.geometry import epipolar as ke
from kornia.geometry import transform as kt
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera import project_points, unproject_points
from kornia.geometry.camera.projection_z1 import dx_project_points_z1
from kornia.geometry.liegroup import Se3, So3
from kornia.geometry.quaternion import Quaternion
from kornia.geometry.solvers import solve_cubic
from torch import Tensor

from dhtorch.data import convert
from dhtorch.experiments.baselines import dinov2
from dhtorch.experiments.focal import filling, sharpness
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, filters, p3p, pyramid, se3
from dhtorch.geometry.patches import luma
from dhtorch.records import Camera, Pose
from dhtorch.stages import holes

Make = Callable[[torch.dtype, int, int], tuple[Any, ...]]


@dataclass(frozen=True)
class Peer:
    """One question to both sides."""

    ours: str  # dotted, below dhtorch
    kornia: str  # dotted, below kornia
    make: Make  # (dtype, B, N) → arguments
    mine: Callable[..., Any]
    theirs: Callable[..., Any]
    why: str  # of what is used, in a few words
    used: str = "ours"
    size: tuple[int, int] = (8, 2048)  # B, N of the timing
    points: tuple[int, ...] = ()  # arguments with points along axis 1: fewer may be asked for
    note: str = ""  # what was asked, beyond B and N
    hard: Callable[[], tuple[Any, ...]] | None = None  # arguments where a formula divides by zero
    arrays: bool = False  # ours is of numpy's arrays: no gradient, no graph


def generator(seed: int = 0) -> torch.Generator:
    """The same draws for both sides."""
    return torch.Generator().manual_seed(seed)


def draw(*shape: int, dtype: torch.dtype, seed: int = 0) -> Tensor:
    """Uniform numbers in [0, 1)."""
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64).to(dtype)


def cameras(dtype: torch.dtype, B: int, distorted: bool = False) -> Camera:
    """Phone cameras of 640 × 480, with a lens as of a phone."""
    f, c = 500 + 20 * draw(B, 2, dtype=dtype), torch.tensor([320.0, 240.0], dtype=dtype) + draw(B, 2, dtype=dtype)
    lens = torch.tensor([[0.12, -0.25, 0.001, -0.0007, 0.1]], dtype=dtype).repeat(B, 1)
    return Camera(f, c, lens if distorted else None)


def pixels(dtype: torch.dtype, B: int, N: int, seed: int = 1) -> Tensor:
    """Places in such a picture."""
    return draw(B, N, 2, dtype=dtype, seed=seed) * torch.tensor([640.0, 480.0], dtype=dtype)


def depths(dtype: torch.dtype, B: int, N: int) -> Tensor:
    """Between 0.5 and 5 m."""
    return 0.5 + 4.5 * draw(B, N, dtype=dtype, seed=2)


def tangents(dtype: torch.dtype, B: int) -> Tensor:
    """Motions of a hand-held camera between two views, (B, 6)."""
    return ((draw(B, 6, dtype=torch.float64, seed=3) - 0.5) * 0.4).to(dtype)


def motions(dtype: torch.dtype, B: int) -> Pose:
    """The same as poses."""
    T = se3.exp(tangents(torch.float64, B))
    return Pose(T.R.to(dtype), T.t.to(dtype))


def two_views(dtype: torch.dtype, B: int, N: int) -> tuple[Any, ...]:
    """Tracks with half a pixel of noise, cameras and the motion."""
    camera, T, uv = cameras(torch.float64, B), motions(torch.float64, B), pixels(torch.float64, B, N)
    seen = cam.project(camera, se3.apply(T, cam.unproject(camera, uv, depths(torch.float64, B, N))))
    seen = seen + 0.5 * torch.randn(seen.shape, generator=generator(4), dtype=torch.float64)
    return uv.to(dtype), seen.to(dtype), camera.to(dtype), T.to(dtype)


def picture(dtype: torch.dtype, B: int, C: int = 3, hw: tuple[int, int] = (480, 640)) -> Tensor:
    """Smooth structure with noise on top, in [0, 1]."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in hw), indexing="ij")
    wave = 0.5 + 0.25 * torch.sin(u / 7 + v / 31) * torch.cos(v / 11)
    return (wave + 0.2 * draw(B, C, *hw, dtype=torch.float64, seed=5)).to(dtype)


def matrices(camera: Camera) -> Tensor:
    """K (B, 3, 3)."""
    return cam.to_matrix(camera)


def fundamental(camera: Camera, T: Pose) -> Tensor:
    """F (B, 3, 3) with uv_1ᵀ F uv_0 = 0."""
    K_inverse = torch.linalg.inv(matrices(camera))
    return K_inverse.mT @ se3.hat(T.t) @ T.R @ K_inverse


def projections(camera: Camera, T: Pose) -> tuple[Tensor, Tensor]:
    """P (B, 3, 4) of both views."""
    K, first = matrices(camera), se3.to_matrix(se3.identity(len(T.R), T.t))
    return K @ first[:, :3], K @ se3.to_matrix(T)[:, :3]


def quaternions(dtype: torch.dtype, B: int) -> Tensor:
    """x y z w of any rotation, (B, 4)."""
    q = torch.randn(B, 4, generator=generator(6), dtype=torch.float64)
    return (q / q.norm(dim=-1, keepdim=True)).to(dtype)


def turns(dtype: torch.dtype, B: int) -> Tensor:
    """Rotation matrices of any angle, (B, 3, 3)."""
    return kc.quaternion_to_rotation_matrix(quaternions(torch.float64, B).roll(1, -1)).to(dtype)


def by_numpy(fn: Callable[..., np.ndarray]) -> Callable[..., Tensor]:
    """A function of arrays, asked with tensors."""
    return lambda *xs: torch.from_numpy(np.asarray(fn(*(x.numpy() for x in xs))))


def grid(hw: tuple[int, int], like: Tensor) -> Tensor:
    """All pixels (1, H W, 2)."""
    v, u = torch.meshgrid(*(torch.arange(n) for n in hw), indexing="ij")
    return torch.stack((u, v), -1).view(1, -1, 2).to(like)


FILE = __file__
_SLOPE, _SMOOTH, _SECOND = [-0.5, 0.0, 0.5], [0.25, 0.5, 0.25], [-1.0, 2.0, -1.0]
_BINOMIAL = torch.tensor([[1.0, 4.0, 6.0, 4.0, 1.0]]) / 16


def _half(x: Tensor) -> Tensor:
    level = pyramid.build_pyramid(x, 2, 21, gradients=False)
    return level.levels[1][:, :, level.pad : -level.pad, level.pad : -level.pad]


def _gradients(x: Tensor) -> Tensor:
    level = pyramid.build_pyramid(x, 1, 21)
    return level.levels[0][:, 1:, level.pad : -level.pad, level.pad : -level.pad]


def _colmap(R: Tensor) -> Tensor:
    return torch.tensor([before.quaternion(r) for r in R.tolist()], dtype=R.dtype)


def _positive(q: Tensor) -> Tensor:
    """The one of q and −q whose w is not negative; w first."""
    return q * torch.where(q[..., :1] < 0, -1.0, 1.0)


def _xyzw(q: Tensor) -> Tensor:
    return q.roll(-1, -1)


def _normalised(x: Tensor) -> Tensor:
    mean, std = (x.new_tensor(c).view(3, 1, 1) for c in (dinov2.COLOUR_MEAN, dinov2.COLOUR_STD))
    return (x - mean) / std


def _guided(z: Tensor, guide: Tensor) -> Tensor:
    return kf.guided_blur(luma(guide, 1), z[:, None], 3, 1e-3, border_type="replicate")[:, 0]


def _cubics(_: torch.dtype, B: int, N: int) -> tuple[Tensor]:
    m, a = draw(3, B * N, dtype=torch.float64, seed=7) * 0.3 + 0.6, draw(3, B * N, dtype=torch.float64, seed=8) + 0.5
    return (p3p._cones(m, a),)  # always in float64, as the search does


def _determinants(cones: Tensor) -> Tensor:
    """The cubic's coefficients (M, 4), as the search for its root makes them."""
    k = (p3p._cofactors(cones)[:, :, :, None] * cones[:, :, None]).sum(0).sum(0).flatten(0, 1)
    return k.movedim(0, -1) * k.new_tensor([1.0, 3.0, 3.0, 1.0])


def _outer(roots: Tensor) -> Tensor:
    """Of three real roots (M, 3) the one farthest from the others; of a single one, with zeros behind it, that one."""
    far = (roots[..., None] - roots[..., None, :]).abs().sum(-1).argmax(-1, keepdim=True)
    single = (roots[..., 1:] == 0).all(-1, keepdim=True)
    return roots.gather(-1, torch.where(single, 0, far))[..., 0]


def _behind() -> tuple[Any, ...]:
    """Points in the camera's plane, and behind it."""
    xyz = torch.tensor([[[0.1, 0.2, 0.0], [0.1, -0.2, -1.0], [0.0, 0.0, 0.0], [0.3, 0.2, 1.0]]])
    return cameras(torch.float32, 1), xyz


def _folded() -> tuple[Any, ...]:
    """Pixels of a barrel so wide that its outermost ones come from nowhere."""
    camera = cameras(torch.float32, 1).replace(distortion=torch.tensor([[-0.5, 0.0, 0.0, 0.0]]))
    return camera, torch.tensor([[[320.0, 240.0], [0.0, 0.0], [900.0, 700.0]]])


def _still() -> tuple[Any, ...]:
    """No motion, and half a turn."""
    return (torch.tensor([[0.0] * 6, [0.0, 0.0, torch.pi, 0.1, 0.2, 0.3]]),)


def _unturned() -> tuple[Any, ...]:
    """No turn, and half a turn about an axis."""
    return (torch.stack((torch.eye(3), torch.diag(torch.tensor([-1.0, -1.0, 1.0])))),)


def _no_baseline() -> tuple[Any, ...]:
    """A camera that only turned."""
    uv_0, uv_1, camera, T = two_views(torch.float32, 1, 5)
    return uv_0, uv_1, camera, Pose(T.R, torch.zeros_like(T.t))


PEERS = (
    Peer(
        "geometry.camera.project",
        "geometry.camera.project_points",
        lambda d, B, N: (cameras(d, B), cam.unproject(cameras(d, B), pixels(d, B, N), depths(d, B, N))),
        cam.project,
        lambda c, xyz: project_points(xyz, matrices(c)),
        "slower, since a matrix is asked for; a lens is part of ours",
        hard=_behind,
        points=(1,),
    ),
    Peer(
        "geometry.camera.project",
        "geometry.camera.PinholeCamera.project",
        lambda d, B, N: (cameras(d, B), cam.unproject(cameras(d, B), pixels(d, B, N), depths(d, B, N))),
        cam.project,
        lambda c, xyz: c.to_kornia((480, 640)).project(xyz),
        "slower: 4×4 products for what two quotients say",
        hard=_behind,
        points=(1,),
    ),
    Peer(
        "geometry.camera.unproject",
        "geometry.camera.unproject_points",
        lambda d, B, N: (cameras(d, B), pixels(d, B, N), depths(d, B, N)),
        cam.unproject,
        lambda c, uv, z: unproject_points(uv, z[..., None], matrices(c)),
        "kornia's asks for a matrix, and building it takes longer than the answer; the bits are the same",
        points=(1, 2),
    ),
    Peer(
        "geometry.camera.rays",
        "geometry.conversions.normalize_points_with_intrinsics",
        lambda d, B, N: (cameras(d, B), pixels(d, B, N)),
        cam.rays,
        lambda c, uv: kc.convert_points_to_homogeneous(kc.normalize_points_with_intrinsics(uv, matrices(c))),
        "as above; a lens is part of ours",
        points=(1,),
    ),
    Peer(
        "geometry.camera.distort",
        "geometry.calibration.distort_points",
        lambda d, B, N: (cameras(d, B, True), pixels(d, B, N)),
        before.distort,
        lambda c, uv: distort_points(uv, matrices(c), c.distortion),
        "no Jacobian is made on the way",
        used="kornia",
        points=(1,),
    ),
    Peer(
        "geometry.camera.undistort",
        "geometry.calibration.undistort_points",
        lambda d, B, N: (cameras(d, B, True), pixels(d, B, N)),
        cam.undistort,
        lambda c, uv: undistort_points(uv, matrices(c), c.distortion),
        "kornia stops after five fixed-point steps: behind a wide lens most pixels are not there yet, and none says so",
        hard=_folded,
        points=(1,),
    ),
    Peer(
        "geometry.camera.resize",
        "geometry.camera.PinholeCamera.scale",
        lambda d, B, N: (cameras(d, B),),
        lambda c: matrices(cam.resize(c, (480, 640), (240, 320))),
        lambda c: c.to_kornia((480, 640)).scale(c.f.new_full((len(c.f),), 0.5)).intrinsics[:, :3, :3],
        "kornia's scales the principal point without the half pixel: a quarter of a pixel off at half size",
    ),
    Peer(
        "geometry.camera.unproject (all pixels)",
        "geometry.depth.depth_to_3d_v2",
        lambda d, B, N: (cameras(d, B), depths(d, B, 192 * 256)),
        lambda c, z: cam.unproject(c, grid((192, 256), z).expand(len(z), -1, 2), z),
        lambda c, z: kg.depth.depth_to_3d_v2(z.view(-1, 192, 256), matrices(c)).flatten(1, 2),
        "the same bits; pixels in any order, and those of a lens",
        size=(1, 192 * 256),
    ),
    Peer(
        "geometry.se3.exp",
        "geometry.liegroup.Se3.exp",
        lambda d, B, N: (tangents(d, B),),
        lambda xi: pose44(se3.exp(xi)),
        lambda xi: Se3.exp(xi.roll(3, -1)).matrix()[:, :3],
        "slower, in the inner loop of every refinement",
        hard=_still,
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.exp (rotation)",
        "geometry.conversions.axis_angle_to_rotation_matrix",
        lambda d, B, N: (tangents(d, B),),
        lambda xi: se3.exp(xi).R,
        lambda xi: kc.axis_angle_to_rotation_matrix(xi[:, :3]),
        "a third of what is needed: the translation asks for the same sines again",
        hard=_still,
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.compose",
        "geometry.linalg.compose_transformations",
        lambda d, B, N: (motions(d, B), motions(d, B + 1)[1:]),
        lambda a, b: pose44(se3.compose(a, b)),
        lambda a, b: kg.compose_transformations(se3.to_matrix(a), se3.to_matrix(b))[:, :3],
        "slower; 4×4 products of what two small ones say",
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.invert",
        "geometry.linalg.inverse_transformation",
        lambda d, B, N: (motions(d, B),),
        lambda a: pose44(se3.invert(a)),
        lambda a: kg.inverse_transformation(se3.to_matrix(a))[:, :3],
        "slower",
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.relative",
        "geometry.linalg.relative_transformation",
        lambda d, B, N: (motions(d, B), motions(d, B + 1)[1:]),
        lambda a, b: pose44(se3.relative(a, b)),
        lambda a, b: kg.relative_transformation(se3.to_matrix(b), se3.to_matrix(a))[:, :3],
        "slower",
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.apply",
        "geometry.linalg.transform_points",
        lambda d, B, N: (motions(d, B), cam.unproject(cameras(d, B), pixels(d, B, N), depths(d, B, N))),
        se3.apply,
        lambda T, xyz: kg.transform_points(se3.to_matrix(T), xyz),
        "slower; a matrix product, whose rounding may depend on the batch",
        points=(1,),
    ),
    Peer(
        "geometry.se3.hat",
        "geometry.liegroup.So3.hat",
        lambda d, B, N: (tangents(d, B)[:, :3],),
        se3.hat,
        So3.hat,
        "slower, in every step of a refinement; the bits are the same",
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.rotation_angle",
        "geometry.conversions.rotation_matrix_to_axis_angle",
        lambda d, B, N: (turns(d, B),),
        se3.rotation_angle,
        lambda R: kc.rotation_matrix_to_axis_angle(R).norm(dim=-1),
        "slower, by way of a quaternion",
        hard=_unturned,
        size=(64, 1),
    ),
    Peer(
        "geometry.se3.to_matrix",
        "geometry.conversions.Rt_to_matrix4x4",
        lambda d, B, N: (motions(d, B),),
        before.to_matrix,
        lambda T: kc.Rt_to_matrix4x4(T.R, T.t[..., None]),
        "the same bits",
        used="kornia",
        size=(64, 1),
    ),
    Peer(
        "geometry.epipolar.triangulate",
        "geometry.epipolar.triangulate_points",
        two_views,
        lambda a, b, c, T: epipolar.triangulate_depth(a, b, c, c, T),
        lambda a, b, c, T: ke.triangulate_points(*projections(c, T), a, b)[..., 2],
        "slower by far; the linear answer shares the residual with the pixel that is exact here",
        hard=_no_baseline,
        points=(0, 1),
    ),
    Peer(
        "geometry.epipolar.triangulate",
        "geometry.epipolar.triangulate_points",
        two_views,
        lambda a, b, c, T: epipolar.triangulate_depth(a, b, c, c, T),
        lambda a, b, c, T: ke.triangulate_points(*projections(c, T), a, b, solver="cofactor")[..., 2],
        "slower; otherwise as above",
        hard=_no_baseline,
        points=(0, 1),
        note="solver cofactor",
    ),
    Peer(
        "geometry.epipolar.triangulate (residual_px)",
        "geometry.epipolar.left_to_right_epipolar_distance",
        two_views,
        lambda a, b, c, T: epipolar.triangulate(a, b, c, c, T).residual_px,
        lambda a, b, c, T: ke.left_to_right_epipolar_distance(a, b, fundamental(c, T)),
        "ours falls out of the triangulation, which is what was timed; kornia's alone is a matrix product",
        points=(0, 1),
    ),
    Peer(
        "geometry.epipolar.triangulate (residual_px)",
        "geometry.epipolar.sampson_epipolar_distance",
        two_views,
        lambda a, b, c, T: epipolar.triangulate(a, b, c, c, T).residual_px,
        lambda a, b, c, T: ke.sampson_epipolar_distance(a, b, fundamental(c, T), squared=False),
        "another question: both pixels may move, here the reference view's is exact",
        points=(0, 1),
    ),
    Peer(
        "geometry.epipolar.point_jacobians",
        "geometry.camera.dx_project_points_z1",
        lambda d, B, N: (cameras(d, B), cam.unproject(cameras(d, B), pixels(d, B, N), depths(d, B, N))),
        lambda c, xyz: epipolar.point_jacobians(c, xyz)[0],
        lambda c, xyz: dx_project_points_z1(xyz) * c.f[:, None, :, None],
        "no guard where z = 0; the pose's Jacobian shares its terms with ours",
        hard=_behind,
        points=(1,),
    ),
    Peer(
        "geometry.p3p (cubic)",
        "geometry.solvers.solve_cubic",
        _cubics,
        p3p._outer_root,
        lambda cones: _outer(solve_cubic(_determinants(cones))),
        "slower; one root is asked for, the best conditioned",
        size=(16, 128),
        note="2048 cubics of random triangles",
    ),
    Peer(
        "geometry.filters.grey",
        "color.rgb_to_grayscale",
        lambda d, B, N: (picture(d, B),),
        lambda x: luma(x, 1),
        rgb_to_grayscale,
        "the same bits; patches, of any layout, stay with `lookup.luma`, which is twice as fast on them",
        used="kornia",
        size=(2, 1),
        note="640×480",
    ),
    Peer(
        "geometry.pyramid.build_pyramid (half size)",
        "geometry.transform.pyrdown",
        lambda d, B, N: (picture(d, B, 1),),
        _half,
        kt.pyrdown,
        "slower, and at other places: pixel i of a level lies between pixels of the level below",
        size=(2, 1),
        note="640×480",
    ),
    Peer(
        "geometry.pyramid.build_pyramid (half size)",
        "filters.filter2d_separable",
        lambda d, B, N: (picture(d, B, 1),),
        _half,
        lambda x: kf.filter2d_separable(x, _BINOMIAL.to(x), _BINOMIAL.to(x))[..., ::2, ::2],
        "slower: it filters every pixel and keeps a quarter",
        size=(2, 1),
        note="640×480",
    ),
    Peer(
        "geometry.pyramid.build_pyramid (gradients)",
        "filters.spatial_gradient",
        lambda d, B, N: (picture(d, B, 1),),
        _gradients,
        lambda x: kf.spatial_gradient(x)[:, 0],
        "Sobel's and plain differences only, here Scharr's; slower",
        size=(2, 1),
        note="640×480",
    ),
    Peer(
        "stages.holes.min_eigenvalue",
        "feature.gftt_response",
        lambda d, B, N: (picture(d, B), pixels(d, B, N).round()),
        holes.min_eigenvalue,
        lambda x, uv: (
            gftt_response(luma(x, 1))
            .flatten(1)
            .gather(1, (uv[..., 1] * 640 + uv[..., 0]).long().clamp_max(480 * 640 - 1))
        ),
        "the whole picture for some points, and another window",
        size=(1, 2048),
        points=(1,),
        note="640×480",
    ),
    Peer(
        "geometry.filters.gaussian",
        "filters.gaussian_blur2d",
        lambda d, B, N: (picture(d, B, 1),),
        lambda x: before.gaussian(x, 6.0),
        lambda x: kf.gaussian_blur2d(x, 49, (6.0, 6.0), border_type="replicate"),
        "ours made a new picture for every tap",
        used="kornia",
        size=(2, 1),
        note="640×480, σ = 6 px",
    ),
    Peer(
        "geometry.filters.gaussian",
        "filters.gaussian_blur2d",
        lambda d, B, N: (picture(d, B, 1),),
        lambda x: before.gaussian(x, 1.0),
        lambda x: kf.gaussian_blur2d(x, 9, (1.0, 1.0), border_type="replicate"),
        "the same",
        used="kornia",
        size=(2, 1),
        note="640×480, σ = 1 px",
    ),
    Peer(
        "geometry.filters.gaussian",
        "filters.gaussian_blur2d",
        lambda d, B, N: (picture(d, B, 1, (64, 80)),),
        lambda x: before.gaussian(x, 2.0),
        lambda x: kf.gaussian_blur2d(x, 17, (2.0, 2.0), border_type="replicate"),
        "slower on small pictures; those of the experiments have 640×480 pixels",
        used="kornia",
        size=(2, 1),
        note="80×64, σ = 2 px",
    ),
    Peer(
        "geometry.filters.box",
        "filters.box_blur",
        lambda d, B, N: (picture(d, B, 1, (192, 256)),),
        lambda x: filters.box_mean(x, 1),
        lambda x: kf.box_blur(x, 3, border_type="replicate", separable=True),
        "slower",
        size=(2, 1),
        note="256×192, radius 1",
    ),
    Peer(
        "geometry.filters.separable",
        "filters.filter2d_separable",
        lambda d, B, N: (picture(d, B, 1),),
        lambda x: filters.correlate_separable(x, [1.0], _SECOND),
        lambda x: kf.filter2d_separable(x, x.new_tensor([_SECOND]), x.new_tensor([[1.0]]), border_type="replicate"),
        "slower for few taps",
        size=(2, 1),
        note="640×480, second difference",
    ),
    Peer(
        "experiments.focal.sharpness (gradients)",
        "filters.spatial_gradient",
        lambda d, B, N: (picture(d, B, 1),),
        lambda x: torch.stack(
            (filters.correlate_separable(x, _SMOOTH, _SLOPE), filters.correlate_separable(x, _SLOPE, _SMOOTH)), 2
        ),
        kf.spatial_gradient,
        "as long at best, three times as long where memory is fresh",
        size=(2, 1),
        note="640×480",
    ),
    Peer(
        "experiments.focal.filling.guided_filter",
        "filters.guided_blur",
        lambda d, B, N: (depths(d, B, 192 * 256).view(B, 192, 256), picture(d, B, 3, (192, 256))),
        filling.fill_guided,
        _guided,
        "kornia's cannot leave out pixels without a return",
        size=(1, 1),
        note="256×192, every pixel with a return",
    ),
    Peer(
        "experiments.focal.sharpness (resampling)",
        "geometry.transform.remap",
        lambda d, B, N: (picture(d, B), torch.tensor([[0.01, 1.3, -0.7]], dtype=d).repeat(B, 1)),
        before.resample,
        sharpness._resample,
        "pixels instead of a grid from −1 to 1",
        used="kornia",
        size=(2, 1),
        note="640×480, bicubic",
    ),
    Peer(
        "experiments.baselines.dinov2.pixel_values (colours)",
        "enhance.normalize",
        lambda d, B, N: (picture(d, B, 3, (224, 224)),),
        _normalised,
        lambda x: normalize(x, x.new_tensor(dinov2.COLOUR_MEAN), x.new_tensor(dinov2.COLOUR_STD)),
        "the same bits",
        used="kornia",
        size=(8, 1),
        note="224×224",
    ),
    Peer(
        "data.convert (nearest of a window)",
        "morphology.erosion",
        lambda d, B, N: (depths(d, B, 192 * 256).view(B, 192, 256),),
        lambda z: torch.stack([convert._window_min(x, 4) for x in z]),
        lambda z: morphology.erosion(z[:, None], z.new_ones(9, 9))[:, 0],
        "slower by far",
        size=(1, 1),
        note="256×192, 9 × 9 pixels",
    ),
    Peer(
        "data.convert.to_c2w",
        "geometry.conversions.quaternion_to_rotation_matrix",
        lambda d, B, N: (quaternions(d, B), draw(B, 3, dtype=d)),
        by_numpy(lambda q, t: before.to_c2w(q, t)[:, :3, :3]),
        lambda q, t: kc.quaternion_to_rotation_matrix(q.roll(1, -1)),
        "some hundredths of a millisecond per file",
        used="kornia",
        arrays=True,
        size=(1000, 1),
        note="a recording's 1000 poses",
    ),
    Peer(
        "data.convert.to_c2w",
        "geometry.conversions.quaternion_to_rotation_matrix",
        lambda d, B, N: (quaternions(d, B), draw(B, 3, dtype=d)),
        by_numpy(lambda q, t: before.to_c2w(q, t)[:, :3, :3]),
        lambda q, t: kc.quaternion_to_rotation_matrix(q.roll(1, -1)),
        "the same, of one pose: what a live stream asks for",
        used="kornia",
        arrays=True,
        size=(1, 1),
        note="one pose",
    ),
    Peer(
        "data.convert.to_quaternions",
        "geometry.conversions.axis_angle_to_quaternion",
        lambda d, B, N: (tangents(d, B)[:, :3],),
        by_numpy(before.to_quaternions),
        lambda v: _xyzw(kc.axis_angle_to_quaternion(v)),
        "some hundredths of a millisecond per file",
        used="kornia",
        arrays=True,
        size=(1000, 1),
        note="a recording's 1000 poses",
    ),
    Peer(
        "data.convert.slerp",
        "geometry.quaternion.Quaternion.slerp",
        lambda d, B, N: (quaternions(d, B), quaternions(d, B + 1)[1:], draw(B, dtype=d)),
        lambda *xs: _positive(by_numpy(before.slerp)(*xs).roll(1, -1)),
        lambda a, b, s: _positive(Quaternion(a.roll(1, -1)).slerp(Quaternion(b.roll(1, -1)), s).data),
        "ours returns its ends bit for bit; slower",
        arrays=True,
        size=(1000, 1),
        note="a recording's 1000 poses",
    ),
    Peer(
        "data.convert.cv_from_gl",
        "geometry.conversions.camtoworld_graphics_to_vision_4x4",
        lambda d, B, N: (se3.to_matrix(motions(d, B)),),
        by_numpy(before.cv_from_gl),
        kc.camtoworld_graphics_to_vision_4x4,
        "one product with a constant; slower",
        arrays=True,
        size=(1000, 1),
        note="a recording's 1000 poses",
    ),
    Peer(
        "export.colmap (quaternion)",
        "geometry.conversions.rotation_matrix_to_quaternion",
        lambda d, B, N: (turns(d, B),),
        _colmap,
        lambda R: _positive(kc.rotation_matrix_to_quaternion(R)),
        "a millisecond per picture that is written; thirteen lines fewer",
        used="kornia",
        arrays=True,
        size=(1, 1),
        note="one pose",
    ),
)


def pose44(T: Pose) -> Tensor:
    """(B, 3, 4), ours, as numbers to compare."""
    return torch.cat((T.R, T.t[..., None]), -1)
