"""One contract, one table: every public function of geometry, stages and metrics has a row, or the last test fails."""

import functools
import importlib
import inspect
import pkgutil

import pytest
import torch
from support.contract_inputs import HW, cameras, generator, pixels, poses, shifted, tracked, uniform
from support.contract_rows import PROMISES, Row, equal, leaves, reorder, take, tensor_map

from dhtorch.alignment import (
    align,
    error_model,
    references,
    residual_noise,
)
from dhtorch.experiments.focal import blur, filling, sharpness
from dhtorch.experiments.negative import helix_correlation, hole_attention, icp
from dhtorch.experiments.probes import ridge as probe
from dhtorch.geometry import (
    affine_alignment,
    camera,
    covariance,
    determinism,
    epipolar,
    filters,
    least_squares,
    map_estimate,
    no_depth,
    p3p,
    patches,
    plane_sweep,
    pyramid,
    ransac,
    reprojection_problem,
    se3,
    sparse_grid,
    thin_lens,
)
from dhtorch.geometry import (
    coarse_flow as start,
)
from dhtorch.geometry import (
    linalg as small,
)
from dhtorch.geometry import (
    pose_averaging as rigid,
)
from dhtorch.geometry import (
    pose_conventions as conventions,
)
from dhtorch.geometry import (
    windows as neighbours,
)
from dhtorch.metrics import holdout
from dhtorch.pipeline import (
    completion,
    dense,
    fused,
    map_filters,
    method,
    multiview,
    pair,
    surface,
    view_selection,
)
from dhtorch.records import Frame, TrackHint
from dhtorch.stages import (
    backproject,
    features,
    holes,
    misalignment,
    pose,
    pose_prior,
    score,
    track,
    track_chain,
    triangulate,
)
from dhtorch.validation import evidence, faults, validate, wrong_causes

FEW = 11  # points; no other axis of any answer is as long


# ---------------------------------------------------------------------------------------------------- inputs


def frames(batch, n, dtype):
    """A frame and its samples' pixels, with holes, dark, bright and textured places."""
    image = uniform(batch, 3, *HW, dtype=dtype, low=0.2, high=0.8)
    image[..., :12, :12], image[..., :12, 40:] = 0.0, 1.0
    depth = uniform(batch, *HW, dtype=dtype, low=1, high=1.05, seed=1)
    depth[:, 20:30, 20:30] = 0
    conf = torch.randint(0, 3, (batch, *HW), generator=generator(2), dtype=torch.uint8)
    return Frame(image, depth, cameras(batch, dtype), conf=conf), pixels(batch, n, dtype)


def sampled(batch, n, dtype):
    frame, uv = frames(batch, n, dtype)
    return frame, backproject.backproject(frame, uv)


def held(batch, n, dtype):
    """A given pose and what it is held against."""
    samples, tracks, fit, camera_0, camera_1 = tracked(batch, n, dtype)
    return pose_prior.make_prior(poses(batch, dtype), sigma=(0.01, 0.01)), samples, tracks, camera_0, camera_1, fit


def estimated(batch, n, dtype):
    samples, tracks, fit, camera_0, camera_1 = tracked(batch, n, dtype)
    return triangulate.two_view(samples, tracks, fit, camera_0, camera_1), samples, tracks, fit


def swept(batch, n, dtype):
    """View 0, view 1 and an inverse depth for every pixel of the former."""
    v, u = (uniform(batch, 1, 48, 64, dtype=dtype, seed=k) for k in (6, 7))
    T = se3.Pose(poses(batch, dtype, seed=2).R, uniform(batch, 3, dtype=dtype, low=-0.1, high=0.1, seed=3))
    view = plane_sweep.SweptView(filters.gaussian_blur(v, 2.0), cameras(batch, dtype, True, seed=5), T)
    q = uniform(batch, 48, 64, dtype=dtype, low=0.2, high=0.5)
    return plane_sweep.make_reference_view(filters.gaussian_blur(u, 2.0), cameras(batch, dtype, True)), view, q


def volumes(batch, n, dtype):
    return torch.randint(0, 31, (batch, 9, 12, 6), generator=generator(), dtype=torch.uint8)


def probed(batch, n, dtype):
    """Features and targets, the former repeating themselves a little."""
    x = uniform(batch, n, 3, dtype=dtype, low=-1)
    return torch.cat((x, 2 * x[..., :1] - 1), -1), uniform(batch, n, 2, dtype=dtype, seed=8)


def solved(batch, n, dtype):
    x, y = probed(batch, n, dtype)
    return probe.solve_ridge(probe.compute_moments(x, y), torch.tensor([0.1, 1.0])), x


def two_views(batch, n, dtype):
    _, tracks, fit, camera_0, camera_1 = tracked(batch, n, dtype)
    return tracks.uv_0, tracks.uv_1, camera_0, camera_1, fit.T_1_from_0


def posed(batch, n, dtype):
    """Stage 5: exact tracks, so that the pose does not depend on which points were drawn; 17 of them count."""
    samples, tracks, _, camera_0, camera_1 = tracked(batch, n, dtype, noise=0.0)
    tracks = tracks.replace(valid=tracks.valid & (torch.arange(n) < 17))
    return samples, tracks, camera_0, camera_1, uniform(1, 64, 3, dtype=torch.float64).expand(batch, 64, 3)


def pyramids(batch, n, dtype):
    image_0, image_1, _ = shifted(batch, n, dtype)
    return pyramid.build_pyramid(image_0, 2), pyramid.build_pyramid(image_1, 2)


def turns(batch, dtype):
    angle = uniform(batch, dtype=dtype, low=-0.5, high=0.5, seed=3)
    zoom = uniform(batch, dtype=dtype, low=0.7, high=1.4, seed=4)
    c, s = zoom * angle.cos(), zoom * angle.sin()
    return torch.stack([c, -s, s, c], -1).unflatten(-1, (2, 2))


def nearby(batch, n, dtype):
    uv = shifted(batch, n, dtype)[2]
    return uv, uv + 0.3


def judged(batch, n, dtype):
    frame, samples = sampled(batch, n, dtype)
    return samples, holdout.sample_truth(frame, samples.uv), 1.0


def masked(batch, n, dtype):
    frame, samples = sampled(batch, n, dtype)
    truth = holdout.select_candidates(*judged(batch, n, dtype))
    return truth, frame, samples.uv, 1.0


def planes(batch, n, dtype):
    """Linearisation of the pose problem: the point axis is last."""
    camera_1 = cameras(batch, dtype)
    xyz, uv = uniform(batch, 3, n, dtype=dtype, low=1, high=2), uniform(batch, 2, n, dtype=dtype, high=60)
    return poses(batch, dtype), camera_1.f, camera_1.c, xyz, uv


def positive(batch, n, dtype):
    A = uniform(batch, 6, 8, dtype=dtype)
    return A @ A.mT + 0.1 * torch.eye(6, dtype=dtype)


def problems(batch, n, dtype):
    """Near and far tracks of a few pairs as planes, the unknowns near their optimum, and a noise."""
    n = n + -n % determinism.PRODUCT_LANES
    samples, tracks, fit, camera_0, camera_1 = tracked(batch, n, dtype)
    near = torch.arange(n) % 3 > 0
    planes = lambda v: v.transpose(1, 2) if v.ndim == 3 else v  # noqa: E731
    flat = tracks.cov[..., 0, 0]
    problem = reprojection_problem.PoseDepthProblem(
        f=camera_1.f,
        c=camera_1.c,
        ray=planes(camera.rays(camera_0, tracks.uv_0)),
        uv=planes(tracks.uv_1),
        inverse=1 / samples.depth,
        variance=(samples.sigma / samples.depth.square()).square(),
        shape=torch.stack((flat, 0 * flat, 2 * flat), 1),
        near=near.expand(batch, n),
        far=~near.expand(batch, n),
    )
    turn = uniform(batch, 3, dtype=dtype, low=-0.01, high=0.01, seed=9)
    return (
        problem,
        reprojection_problem.Unknowns(fit.T_1_from_0, turn),
        uniform(*problem.near.shape, dtype=dtype, low=0.1),
    )


def linear(batch, n, dtype):
    problem, at, noise = problems(batch, n, dtype)
    tracks = reprojection_problem.linearise_tracks(problem, at)
    return tracks, reprojection_problem.noise_factors(tracks.fixed, noise)


def weighed(batch, n, dtype):
    problem, at, noise = problems(batch, n, dtype)
    weights = uniform(batch, dtype=dtype), uniform(batch, dtype=dtype, low=1e4, high=1e5)
    return problem, at, noise, *weights


def triples(batch, n, dtype):
    Y = uniform(batch, n, 3, 3, dtype=dtype, low=0.5, high=2)
    return Y / Y[..., 2:], Y


def mean_and_corner(patch):
    return patch.mean((0, 1, 2)), patch[-1, 0, 0]


def registered(batch, n, dtype):
    """Two sets of points of which one is the other moved a little, and where to start."""
    xyz = uniform(batch, n, 3, dtype=dtype, low=1, high=2)
    T = se3.exp(uniform(batch, 6, dtype=dtype, low=-0.02, high=0.02))
    return xyz, se3.apply(T, xyz), se3.identity(batch, xyz)


def waves(batch, n, dtype):
    """Two signals, the second shifted by three steps, and sites away from their ends."""
    signal = torch.nn.functional.avg_pool1d(uniform(batch, 330, dtype=torch.float64), 9, 1).to(dtype)
    site = 80 + torch.randint(0, 160, (batch, n), generator=generator(3))
    return signal[:, :-3], signal[:, 3:], site, site


def places(batch, n):
    """Cells of a grid."""
    return torch.randint(-9, 9, (batch, n, 3), generator=generator(5))


def clustered(batch, n, dtype):
    return pixels(batch, n, dtype), torch.rand(batch, n, generator=generator(3)) < 0.6


def with_options(fn, **options):
    """A function of the table with other options, under its own name."""
    return functools.update_wrapper(functools.partial(fn, **options), fn)


def chained(image_0, image_1, uv_0):
    """Tracks through an image between."""
    hint = TrackHint(between=((image_0 + image_1) / 2,))
    return track_chain.track_chain(image_0, image_1, uv_0, hint=hint, track=track.lucas_kanade)


#: A picture turned by a quarter, enlarged and shifted.
AFFINE = torch.tensor([[[0.0, -2.0, 40.0], [2.0, 0.0, 3.0], [0.0, 0.0, 1.0]]])


def grid_matches(image_0, image_1):
    """A matcher: pixels of a grid, and their neighbours."""
    v, u = torch.meshgrid(torch.arange(2.0, HW[0], 4), torch.arange(2.0, HW[1], 4), indexing="ij")
    uv = torch.stack((u, v), -1).flatten(0, 1)
    return uv, uv + torch.tensor([1.0, 0.5])


def lenses(batch, dtype):
    """A fast lens behind which a metre is a few pixels of blur."""
    values = ((0.03, 0.04), (1.0, 2.0), (1e-4, 2e-4))
    return thin_lens.Lens(*(uniform(batch, dtype=dtype, low=a, high=b, seed=k) for k, (a, b) in enumerate(values)))


def stacks(batch, n, dtype):
    """A picture and ever softer copies of it."""
    image = shifted(batch, n, dtype)[0]
    return torch.stack([filters.gaussian_blur(image, s) for s in (1.0, 0.0, 1.5, 2.5)], 1)


def blurs(batch, n, dtype):
    image = uniform(batch, 1, *HW, dtype=torch.float64, seed=7).round().to(dtype)
    return blur.estimate_blur(filters.gaussian_blur(torch.nn.functional.avg_pool2d(image, 5, 1, 2), 1.0))


def sensed(batch, n, dtype):
    coarse = uniform(batch, 8, 12, dtype=dtype, low=1, high=3)
    coarse[:, 2, 3] = 0
    return coarse, uniform(batch, 3, *HW, dtype=dtype)


def filled(batch, n, dtype):
    coarse, _ = sensed(batch, n, dtype)
    return filling.fill_bilinear(coarse, HW), coarse, blurs(batch, n, dtype)


def entries(batch, n, dtype):
    """Of 2×2 matrices, none of them singular."""
    return tuple(uniform(batch, n, dtype=dtype, low=k, high=k + 0.5, seed=k) for k in (1, 2, 4, 3))


def wrong_last_axis(position):
    """A call whose argument at ``position`` lacks its last column."""
    return lambda args: tuple(tensor_map(lambda v: v[..., :-1], a) if k == position else a for k, a in enumerate(args))


# ---------------------------------------------------------------------------------------------------- the table

ALL = "dtype batch vmap capture gradcheck empty shuffle padding nan raises"
POINTLESS = "dtype batch vmap capture gradcheck"
POINTWISE = "dtype batch vmap capture gradcheck empty shuffle padding nan"

ROWS = [
    Row(camera.from_matrix, lambda b, n, d: (camera.to_matrix(cameras(b, d)),), POINTLESS + " raises", grad=(0,), bad=wrong_last_axis(0)),
    Row(camera.to_matrix, lambda b, n, d: (cameras(b, d),), POINTLESS, grad=(0,)),
    Row(camera.ideal, lambda b, n, d: (cameras(b, d, True),), POINTLESS, grad=(0,)),
    Row(camera.resize_pixels, lambda b, n, d: (pixels(b, n, d), HW, (24, 32)), "dtype batch vmap capture gradcheck empty", grad=(0,)),
    Row(camera.resize, lambda b, n, d: (cameras(b, d), HW, (24, 32)), POINTLESS, grad=(0,)),
    Row(camera.warp, lambda b, n, d: (cameras(b, d, True), AFFINE.to(d).expand(b, 3, 3)), POINTLESS + " raises", grad=(0, 1), bad=wrong_last_axis(1)),
    Row(camera.project, lambda b, n, d: (cameras(b, d, True), uniform(b, n, 3, dtype=d, low=1, high=2)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(camera.unproject, lambda b, n, d: (cameras(b, d, True), pixels(b, n, d), uniform(b, n, dtype=d, low=1)), ALL, (1, 2), (0, 1, 2), bad=wrong_last_axis(1), leaks=True),
    Row(camera.rays, lambda b, n, d: (cameras(b, d, True), pixels(b, n, d)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(camera.ray_heights, lambda b, n, d: (cameras(b, d), pixels(b, n, d)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(camera.distort, lambda b, n, d: (cameras(b, d, True), pixels(b, n, d)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(camera.undistort, lambda b, n, d: (cameras(b, d, True), pixels(b, n, d)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(camera.undistort_jacobian, lambda b, n, d: (cameras(b, d, True), pixels(b, n, d)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(camera.depth_pixels, lambda b, n, d: (cameras(b, d), HW, cameras(b, d, seed=4), (24, 32), pixels(b, n, d)), ALL, (4,), (0, 2, 4), bad=wrong_last_axis(4), leaks=True),
    Row(se3.identity, lambda b, n, d: (b, torch.zeros(1, dtype=d)), "dtype"),
    Row(se3.from_matrix, lambda b, n, d: (se3.to_matrix(poses(b, d)),), POINTLESS, grad=(0,)),
    Row(se3.to_matrix, lambda b, n, d: (poses(b, d),), POINTLESS, grad=(0,)),
    Row(se3.apply, lambda b, n, d: (poses(b, d), uniform(b, n, 3, dtype=d)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(se3.rotate, lambda b, n, d: (poses(b, d).R, uniform(b, n, 3, dtype=d)), "dtype batch vmap capture gradcheck empty shuffle padding nan", (1,), (0, 1), leaks=True),
    Row(se3.compose, lambda b, n, d: (poses(b, d), poses(b, d, seed=1)), POINTLESS, grad=(0, 1)),
    Row(se3.invert, lambda b, n, d: (poses(b, d),), POINTLESS, grad=(0,)),
    Row(se3.relative, lambda b, n, d: (poses(b, d), poses(b, d, seed=1)), POINTLESS, grad=(0, 1)),
    Row(se3.hat, lambda b, n, d: (uniform(b, n, 3, dtype=d),), "dtype batch vmap capture gradcheck empty shuffle padding nan", (0,), (0,)),
    Row(se3.exp, lambda b, n, d: (uniform(b, 6, dtype=d, low=-1),), POINTLESS + " raises", grad=(0,), bad=wrong_last_axis(0)),
    Row(rigid.average_poses, lambda b, n, d: (se3.Pose(*(x.unflatten(0, (b, 5)) for x in (poses(5 * b, d).R, poses(5 * b, d).t))), positive(5 * b, n, d).unflatten(0, (b, 5)), torch.ones(b, 5, dtype=torch.bool)), "dtype batch vmap capture raises", bad=wrong_last_axis(1), atol=1e-4),
    Row(se3.log, lambda b, n, d: (poses(b, d),), POINTLESS + " raises", grad=(0,), bad=lambda a: (a[0].replace(t=a[0].t[:, :2]),)),
    Row(se3.adjoint, lambda b, n, d: (poses(b, d),), POINTLESS + " raises", grad=(0,), bad=lambda a: (a[0].replace(t=a[0].t[:, :2]),)),
    Row(se3.orthonormal, lambda b, n, d: (poses(b, d).R,), POINTLESS, grad=(0,)),
    Row(conventions.pose_hypotheses, lambda b, n, d: (poses(b, d), poses(b, d, seed=1)), POINTLESS + " raises", grad=(0, 1), bad=lambda a: (a[0], a[1].replace(t=a[1].t[:, :2]))),
    Row(conventions.motion_from_axes, lambda b, n, d: (poses(b, d), conventions.STATED_AXES["gl"]), POINTLESS, grad=(0,)),
    Row(conventions.pose_from_axes, lambda b, n, d: (poses(b, d), conventions.STATED_AXES["gl"]), POINTLESS, grad=(0,)),
    Row(conventions.relative_covariance, lambda b, n, d: (poses(b, d), positive(b, n, d), positive(b, n, d)), POINTLESS + " raises", grad=(0, 1, 2), bad=wrong_last_axis(1)),
    Row(se3.retract, lambda b, n, d: (poses(b, d), uniform(b, 6, dtype=d, low=-1)), POINTLESS + " raises", grad=(0, 1), bad=wrong_last_axis(1)),
    Row(se3.rotation_angle, lambda b, n, d: (poses(b, d).R,), POINTLESS, grad=(0,)),
    Row(patches.flatten_images, lambda b, n, d: (frames(b, n, d)[0].image,), "dtype capture gradcheck", grad=(0,)),
    Row(patches.extract_patches, lambda b, n, d: (frames(b, n, d)[0].image, pixels(b, n, d).long(), 5), "dtype batch vmap capture gradcheck empty shuffle padding raises", (1,), (0,), bad=wrong_last_axis(1)),
    Row(patches.extract_windows, lambda b, n, d: (frames(b, n, d)[0].depth, torch.arange(b)[:, None] * HW[0] * HW[1] + torch.arange(n) % 900, 5), "dtype capture gradcheck empty", grad=(0,)),
    Row(patches.reduce_patches, lambda b, n, d: (frames(b, n, d)[0].image, pixels(b, n, d).int(), 5, mean_and_corner), "dtype batch vmap capture gradcheck empty shuffle padding raises", (1,), (0,), bad=wrong_last_axis(1)),
    Row(patches.nearest_pixel_index, lambda b, n, d: (HW, pixels(b, n, d).int()), "batch vmap capture empty shuffle padding", (1,)),
    Row(patches.luma, lambda b, n, d: (frames(b, n, d)[0].image, 1), POINTLESS, grad=(0,)),
    Row(patches.sample_nearest, lambda b, n, d: (frames(b, n, d)[0].depth, pixels(b, n, d)), "dtype batch vmap capture gradcheck empty shuffle padding nan raises", (1,), (0,), bad=wrong_last_axis(1)),
    Row(patches.rescale_field_of_view, lambda b, n, d: (frames(b, n, d)[0].depth, 1.3, 0.1), "dtype batch vmap capture gradcheck", (0,), (0,)),
    Row(patches.containing_pixels, lambda b, n, d: (pixels(b, n, d),), "batch vmap capture empty shuffle padding nan", (0,)),
    Row(patches.is_patch_inside, lambda b, n, d: (pixels(b, n, d).int(), HW, 5), "batch vmap capture empty shuffle padding", (0,)),
    Row(patches.is_inside_picture, lambda b, n, d: (pixels(b, n, d), frames(b, n, d)[0].image), "batch vmap capture empty shuffle padding", (0,)),
    Row(patches.gather_reduced, lambda b, n, d: (frames(b, n, d)[0].depth, pixels(b, n, d).int(), 5), "dtype batch vmap capture gradcheck empty shuffle padding", (1,), (0,)),
    Row(patches.round_half_up, lambda b, n, d: (pixels(b, n, d),), "dtype batch vmap capture empty shuffle padding nan", (0,)),
    Row(sparse_grid.pack_cells, lambda b, n, d: (places(b, n),), "batch vmap capture empty shuffle padding raises", (0,), bad=wrong_last_axis(0)),
    Row(sparse_grid.unpack_cells, lambda b, n, d: (sparse_grid.pack_cells(places(b, n)),), "batch vmap capture empty shuffle padding", (0,)),
    Row(sparse_grid.find_cells, lambda b, n, d: (sparse_grid.pack_cells(places(b, 40)).unique(), sparse_grid.pack_cells(places(b, n))), "batch capture empty shuffle padding raises", (1,), shared=(0,), bad=lambda a: (a[0][None], a[1])),
    Row(sparse_grid.touches_cells, lambda b, n, d: (sparse_grid.pack_cells(places(1, n)[0]), sparse_grid.pack_cells(places(b, 9)).unique()), "capture empty raises", bad=lambda a: (a[0][None], a[1])),
    Row(epipolar.triangulate, two_views, ALL, (0, 1), (0, 1, 2, 3, 4), bad=wrong_last_axis(0), leaks=True),
    Row(epipolar.triangulate_depth, two_views, ALL, (0, 1), (0, 1, 2, 3, 4), bad=wrong_last_axis(0), leaks=True),
    Row(epipolar.describe_triangulation, lambda b, n, d: (camera.unproject(two_views(b, n, d)[2], two_views(b, n, d)[0], uniform(b, n, dtype=d, low=1, high=2)), *two_views(b, n, d)), ALL, (0, 1, 2), (0, 1, 2, 3, 4, 5), bad=wrong_last_axis(0), leaks=True),
    Row(epipolar.point_jacobians, lambda b, n, d: (cameras(b, d), uniform(b, n, 3, dtype=d, low=1, high=2)), ALL, (1,), (0, 1), bad=wrong_last_axis(1), leaks=True),
    Row(epipolar.depth_variance, lambda b, n, d: (epipolar.triangulate(*two_views(b, n, d)), tracked(b, n, d)[1].cov, tracked(b, n, d)[2].cov), "dtype batch vmap capture gradcheck empty shuffle padding nan", (0, 1), (0, 1, 2), leaks=True),
    Row(determinism.pad_elementwise, lambda b, n, d: (torch.sin, uniform(b, n, dtype=d)), "dtype batch vmap capture gradcheck empty shuffle padding nan", (1,), (1,)),
    Row(small.determinant_2x2, entries, POINTWISE, (0, 1, 2, 3), (0, 1, 2, 3)),
    Row(small.adjugate_2x2, entries, POINTWISE, (0, 1, 2, 3), (0, 1, 2, 3)),
    Row(with_options(small.inverse_2x2, least=1e-9), entries, "dtype capture gradcheck", grad=(0, 1, 2, 3)),
    Row(small.eigenvalues_2x2, lambda b, n, d: entries(b, n, d)[:3], POINTWISE, (0, 1, 2), (0, 1, 2)),
    Row(small.quadratic_form, lambda b, n, d: (*entries(b, n, d), uniform(b, n, dtype=d)), POINTWISE, (0, 1, 2, 3, 4), (0, 1, 2, 3, 4)),
    Row(small.upper_triangle, lambda b, n, d: (tracked(b, n, d)[1].cov,), POINTWISE, (0,), (0,)),
    Row(small.small_matmul, lambda b, n, d: (tracked(b, n, d)[1].cov, uniform(b, n, 2, 3, dtype=d)), POINTWISE, (0, 1), (0, 1)),
    Row(small.matmul_planes, lambda b, n, d: (uniform(3, 2, b, n, dtype=d), uniform(2, 3, b, n, dtype=d)), "dtype capture gradcheck empty", grad=(0, 1)),
    Row(small.rotate_planes, lambda b, n, d: (poses(b, d).R, uniform(b, 3, n, dtype=d)), "dtype batch vmap capture gradcheck empty", grad=(0, 1)),
    Row(small.solve_cholesky, lambda b, n, d: (uniform(b, 6, 1, dtype=d), torch.linalg.cholesky(positive(b, n, d))), "dtype batch vmap capture"),
    Row(small.cofactor_planes, lambda b, n, d: (uniform(3, 3, b, n, dtype=d),), "dtype capture gradcheck empty", grad=(0,)),
    Row(backproject.backproject, frames, ALL, (1,), (0, 1), bad=wrong_last_axis(1)),
    Row(holes.classify, sampled, "dtype batch vmap capture empty shuffle padding nan raises", (1,), (), bad=wrong_last_axis(1)),
    Row(holes.min_eigenvalue, lambda b, n, d: (frames(b, n, d)[0].image, pixels(b, n, d)), ALL, (1,), (0,), bad=wrong_last_axis(1)),
    Row(holes.suggest_route, lambda b, n, d: (sampled(b, n, d)[1].hole,), "batch vmap capture empty shuffle padding", (0,)),
    Row(triangulate.two_view, tracked, ALL, (0, 1), (1, 3, 4), bad=lambda a: (a[0], a[1].replace(uv_0=a[1].uv_0[:, 1:]), *a[2:])),
    Row(score.confidence, estimated, ALL, (0, 1, 2), (0,), bad=lambda a: (a[0], a[1].replace(uv=a[1].uv[:, 1:]), *a[2:])),
    Row(score.confidence_from_error, estimated, ALL, (0, 1, 2), (0,), bad=lambda a: (a[0], a[1].replace(uv=a[1].uv[:, 1:]), *a[2:])),
    Row(score.confidence_from_sigma, estimated, ALL, (0, 1, 2), (0,), bad=lambda a: (a[0], a[1].replace(uv=a[1].uv[:, 1:]), *a[2:])),
    Row(score.score_features, estimated, "dtype batch vmap capture gradcheck empty shuffle nan raises", (0, 1, 2), (0,), bad=lambda a: (a[0], a[1].replace(uv=a[1].uv[:, 1:]), *a[2:])),
    Row(score.expected_error_loss, lambda b, n, d: (uniform(n, dtype=d, low=-5), uniform(n, dtype=d), uniform(n, dtype=d)), "dtype capture gradcheck raises", grad=(0,), bad=wrong_last_axis(1)),
    Row(pose.pnp_ransac, posed, "dtype batch vmap capture empty padding raises", (0, 1), bad=lambda a: (a[0], a[1].replace(uv_1=a[1].uv_1[:, 1:]), *a[2:]), atol=1e-4, slow="capture"),
    Row(pose_prior.check_pose_prior, held, "dtype batch vmap capture empty raises", (1, 2), bad=lambda a: (a[0], a[1], a[2].replace(uv_1=a[2].uv_1[:, 1:]), *a[3:]), atol=1e-4, slow="capture"),
    Row(misalignment.reject_misaligned, tracked, "dtype batch vmap capture empty raises", (0, 1), bad=lambda a: (a[0], a[1].replace(uv_1=a[1].uv_1[:, 1:]), *a[2:]), atol=1e-4),
    Row(pose_prior.relative_prior, lambda b, n, d: (poses(b, d), poses(b, d, seed=1)), "dtype batch vmap capture gradcheck", grad=(0, 1)),
    Row(pose_prior.make_prior, lambda b, n, d: (poses(b, d),), "dtype batch vmap capture gradcheck", grad=(0,)),
    Row(pose.map_pose, posed, "dtype batch vmap capture empty padding raises", (0, 1), bad=lambda a: (a[0], a[1].replace(uv_1=a[1].uv_1[:, 1:]), *a[2:]), atol=1e-4, slow="capture"),
    Row(track.lucas_kanade, shifted, "dtype batch capture empty shuffle padding nan raises", (2,), bad=wrong_last_axis(2), atol=1e-4, slow="capture"),
    Row(track.refine_tracks, lambda b, n, d: (*shifted(b, n, d), shifted(b, n, d)[2] + 0.3), "dtype batch capture gradcheck empty shuffle padding nan raises", (2, 3), (0, 1), bad=wrong_last_axis(2), atol=1e-4),
    Row(pyramid.build_pyramid, lambda b, n, d: (shifted(b, n, d)[0], 2, 9), "dtype batch capture"),
    Row(start.coarse_flow, lambda b, n, d: shifted(b, n, d)[:2], "batch capture", slow="capture"),
    Row(start.undo_similarity, lambda b, n, d: (shifted(b, n, d)[0], turns(b, d), uniform(b, dtype=d, low=0.5, high=2.0)), "dtype batch vmap capture gradcheck", grad=(0,)),
    Row(start.apply_similarity, lambda b, n, d: (turns(b, d), pixels(b, n, d), HW), "dtype batch vmap capture gradcheck empty shuffle padding", (1,), (1,)),
    Row(plane_sweep.pixel_rays, lambda b, n, d: (cameras(b, d), (5, 7), 2), "dtype batch capture gradcheck", grad=(0,), slow="capture"),
    Row(plane_sweep.make_reference_view, lambda b, n, d: (uniform(b, 1, *HW, dtype=d), cameras(b, d)), "dtype batch capture raises", bad=lambda a: (a[0][0], a[1])),
    Row(plane_sweep.project_inverse_depth, lambda b, n, d: (swept(b, n, d)[1], camera.rays(cameras(b, d), pixels(b, n, d)), uniform(b, n, dtype=d)), "dtype batch vmap capture gradcheck empty shuffle padding raises", (1, 2), (0, 1, 2), bad=wrong_last_axis(2)),
    Row(plane_sweep.rotate_rays, lambda b, n, d: (swept(b, n, d)[1].T_1_from_0.R, uniform(b, n, 3, dtype=d)), "dtype batch vmap capture gradcheck empty shuffle padding", (1,), (0, 1)),
    Row(plane_sweep.sample_bilinear, lambda b, n, d: (uniform(b, 3, *HW, dtype=d), pixels(b, n, d)), "dtype batch capture gradcheck empty", grad=(0, 1)),
    Row(plane_sweep.epipolar_warp, lambda b, n, d: swept(b, n, d)[:2], "dtype batch capture"),
    Row(plane_sweep.census_transform, lambda b, n, d: (uniform(b, 1, *HW, dtype=d),), "batch capture raises", bad=lambda a: (a[0][0],)),
    Row(plane_sweep.aggregate_costs, lambda b, n, d: (volumes(b, n, d), torch.arange(1, b + 1)), "batch capture raises", bad=lambda a: (a[0][0], a[1])),
    Row(plane_sweep.best_plane, lambda b, n, d: (plane_sweep.aggregate_costs(volumes(b, n, d)),), "batch capture raises", bad=lambda a: (a[0][0],)),
    Row(plane_sweep.aggregate_best_plane, lambda b, n, d: (volumes(b, n, d), torch.arange(1, b + 1)), "batch capture"),
    Row(plane_sweep.stack_gradients, lambda b, n, d: (uniform(b, 1, *HW, dtype=d),), POINTLESS, grad=(0,)),
    Row(plane_sweep.fit_windows, lambda b, n, d: (*swept(b, n, d)[:2], plane_sweep.stack_gradients(swept(b, n, d)[1].image), swept(b, n, d)[2]), "dtype batch capture"),
    Row(neighbours.smooth_within_tolerance, lambda b, n, d: (uniform(b, 12, 15, dtype=d), uniform(b, dtype=d)), "dtype batch vmap capture gradcheck", grad=(0,)),
    Row(neighbours.window_sum, lambda b, n, d: (uniform(b, 12, 15, dtype=d), 2), "dtype batch vmap capture gradcheck", grad=(0,)),
    Row(neighbours.window_extreme, lambda b, n, d: (uniform(b, 12, 15, dtype=d), 2, torch.maximum), "dtype batch vmap capture gradcheck", grad=(0,)),
    Row(neighbours.window_range, lambda b, n, d: (uniform(b, 12, 15, dtype=d), 2), "dtype batch vmap capture"),
    Row(plane_sweep.occlusion_mask, lambda b, n, d: (plane_sweep.epipolar_warp(*swept(b, n, d)[:2]), swept(b, n, d)[2], uniform(b, dtype=d, high=0.1)), "batch capture"),
    Row(with_options(features.match_features, matcher=grid_matches), shifted, "dtype batch empty shuffle padding nan raises", (2,), bad=wrong_last_axis(2)),
    Row(functools.update_wrapper(chained, track_chain.track_chain), shifted, "dtype batch capture empty shuffle padding nan raises", (2,), bad=wrong_last_axis(2), atol=1e-4, slow="capture"),
    Row(track.lucas_kanade_affine, shifted, "dtype batch capture empty shuffle padding nan raises", (2,), bad=wrong_last_axis(2), atol=1e-4, slow="capture"),
    Row(affine_alignment.register_affine, lambda b, n, d: (*pyramids(b, n, d), *nearby(b, n, d)), "dtype batch capture empty shuffle padding nan raises", (2, 3), bad=wrong_last_axis(2), atol=1e-4, slow="capture"),
    Row(affine_alignment.registration_step, lambda b, n, d: (*pyramids(b, n, d), *nearby(b, n, d), torch.eye(2, dtype=d).expand(b, n, 2, 2)), "dtype batch capture gradcheck empty shuffle padding nan raises", (2, 3, 4), (0, 1), bad=wrong_last_axis(2), atol=1e-4),
    Row(p3p.p3p, triples, "dtype batch vmap capture shuffle padding", (0, 1), atol=1e-4),
    Row(least_squares.linearise, planes, "dtype batch vmap capture gradcheck empty raises", grad=(0, 1, 2, 3, 4), bad=lambda a: (*a[:4], a[4][..., 1:])),
    Row(least_squares.reprojection_residuals, planes, "dtype batch vmap capture gradcheck empty raises", grad=(0, 1, 2, 3, 4), bad=lambda a: (*a[:4], a[4][..., 1:])),
    Row(least_squares.robust_loss, lambda b, n, d: (uniform(b, n, dtype=d), "cauchy", 0.5), "dtype batch vmap capture gradcheck empty shuffle padding nan", (0,), (0,)),
    Row(least_squares.solve_spd, lambda b, n, d: (positive(b, n, d), uniform(b, 6, 1, dtype=d)), "dtype batch vmap capture"),
    Row(least_squares.normal_equations, lambda b, n, d: (uniform(b, 7, 2, n - n % 16 + 16, dtype=d), uniform(b, n - n % 16 + 16, dtype=d)), "dtype batch vmap capture gradcheck", grad=(0, 1)),
    Row(least_squares.move_pose, lambda b, n, d: (poses(b, d), uniform(b, 6, dtype=d, low=-0.2, high=0.2)), POINTLESS + " raises", grad=(0, 1), bad=wrong_last_axis(1)),
    Row(least_squares.select_batch, lambda b, n, d: (uniform(b, dtype=d) > 0.5, poses(b, d), poses(b, d, seed=1)), POINTLESS, grad=(1, 2)),
    Row(least_squares.robust_weight_slope, lambda b, n, d: (uniform(b, n, dtype=d), "geman_mcclure", 0.5), "dtype batch vmap capture gradcheck empty shuffle padding nan", (0,), (0,)),
    Row(least_squares.implicit_step, lambda b, n, d: (torch.sin, uniform(b, 6, dtype=d, low=-0.2, high=0.2)), "dtype batch capture"),
    Row(reprojection_problem.retract_unknowns, lambda b, n, d: (reprojection_problem.Unknowns(poses(b, d), uniform(b, 3, dtype=d)), uniform(b, 9, dtype=d, low=-0.2, high=0.2)), "dtype batch vmap capture"),
    Row(reprojection_problem.undo_rolling_shutter, lambda b, n, d: (pixels(b, n, d).mT, cameras(b, d).f, cameras(b, d).c, uniform(b, n, dtype=d, low=-0.5, high=0.5), uniform(b, 3, dtype=d, high=0.02)), "dtype batch vmap capture gradcheck empty raises", grad=(0, 1, 2, 3, 4), bad=wrong_last_axis(3)),
    Row(reprojection_problem.track_constants, lambda b, n, d: problems(b, n, d)[:1], "dtype batch vmap capture"),
    Row(reprojection_problem.linearise_tracks, lambda b, n, d: problems(b, n, d)[:2], "dtype batch vmap capture raises", bad=lambda a: (a[0].replace(uv=a[0].uv[..., 1:]), a[1])),
    Row(reprojection_problem.noise_factors, lambda b, n, d: (linear(b, n, d)[0].fixed, problems(b, n, d)[2]), "dtype batch vmap capture gradcheck", grad=(1,)),
    Row(reprojection_problem.whitened_residuals, linear, "dtype batch vmap capture gradcheck", grad=(1,)),
    Row(reprojection_problem.squared_residuals, linear, "dtype batch vmap capture gradcheck", grad=(1,)),
    Row(with_options(reprojection_problem.pose_normal_equations, kernel="geman_mcclure", bend=2.0), weighed, "dtype batch vmap capture"),
    Row(reprojection_problem.shutter_prior, lambda b, n, d: (uniform(b, dtype=d),), POINTLESS, grad=(0,)),
    Row(reprojection_problem.estimate_noise_variance, lambda b, n, d: problems(b, n, d)[:2], "dtype batch vmap capture"),
    Row(map_estimate.estimate_map_pose, lambda b, n, d: (problems(b, n, d)[0], problems(b, n, d)[1].T, map_estimate.FitOptions()), "batch vmap capture", slow="capture"),
    Row(map_estimate.pose_covariance, lambda b, n, d: (problems(b, n, d)[0], map_estimate.MapSolution(*weighed(b, n, d)[1:], torch.ones(b, dtype=torch.bool)), map_estimate.FitOptions()), "batch vmap capture"),
    Row(covariance.noise_shape, lambda b, n, d: (tracked(b, n, d)[1].cov * uniform(b, n, 1, 1, dtype=d, low=0.5), torch.ones(b, n, dtype=torch.bool), 0.1), "dtype batch vmap capture gradcheck empty shuffle raises", (0, 1), (0,), bad=wrong_last_axis(0)),
    Row(covariance.masked_median, lambda b, n, d: (uniform(b, n, dtype=d), uniform(b, n, dtype=d, seed=1) > 0.3), "dtype batch vmap capture gradcheck empty shuffle raises", (0, 1), (0,), bad=wrong_last_axis(1)),
    Row(covariance.covariance_from_normal, lambda b, n, d: (positive(b, n, d), uniform(b, dtype=d, low=0.1)), "dtype batch vmap capture"),
    Row(covariance.mahalanobis, lambda b, n, d: (uniform(b, 6, dtype=d), positive(b, n, d)), "dtype batch vmap capture"),
    Row(ransac.is_collinear, lambda b, n, d: (uniform(b, 3, n, dtype=d), torch.ones(b, n, dtype=torch.bool)), "batch capture"),
    Row(ransac.distinct_triples, lambda b, n, d: (uniform(b, 20, 3, dtype=d), torch.full((b,), n)), "batch vmap capture"),
    Row(ransac.evenly_spaced_slots, lambda b, n, d: (torch.full((b,), n), 16), "batch vmap capture"),
    Row(ransac.usable_first, lambda b, n, d: (uniform(b, n, dtype=d) > 0.5, 16), "batch vmap capture"),
    Row(holdout.range_split, lambda b, n, d: (frames(b, n, d)[0], 1.02), "dtype batch vmap capture gradcheck", grad=(0,)),
    Row(holdout.sample_truth, frames, ALL, (1,), (0,), bad=wrong_last_axis(1)),
    Row(holdout.split_half, lambda b, n, d: (sampled(b, n, d)[1], 3), "dtype batch empty raises", (0,), bad=lambda a: (a[0].replace(trackability=a[0].trackability[:, 1:]), a[1])),
    Row(holdout.hide_returns, lambda b, n, d: (sampled(b, n, d)[1], torch.rand(b, n, generator=generator(3)) < 0.5), ALL, (0, 1), (0,), bad=lambda a: (a[0], a[1][:, 1:])),
    Row(holdout.require_masked, masked, "dtype batch vmap capture empty shuffle raises", (0, 2), bad=lambda a: (a[0].replace(depth=a[0].depth[:, 1:]), *a[1:])),
    Row(holdout.select_real_holes, lambda b, n, d: (*sampled(b, n, d), holdout.sample_truth(*frames(b, n, d))), "dtype batch vmap capture empty raises", (1, 2), bad=lambda a: (a[0], a[1], a[2].replace(depth=a[2].depth[:, 1:]))),
    Row(helix_correlation.sample_arm, lambda b, n, d: (frames(b, n, d)[0].image, pixels(1, n, d)[0]), "dtype batch capture gradcheck raises", grad=(0, 1), shared=(1,), bad=wrong_last_axis(1)),
    Row(helix_correlation.correlate_windows, waves, "dtype batch vmap capture gradcheck empty shuffle padding raises", (2, 3), (0, 1), bad=wrong_last_axis(3)),
    Row(with_options(icp.register_icp, iterations=5), registered, "dtype batch vmap capture shuffle raises", (0,), bad=wrong_last_axis(0)),
    Row(with_options(icp.estimate_normals, neighbours=4), lambda b, n, d: registered(b, n, d)[:1], "dtype batch vmap capture shuffle raises", (0,), bad=wrong_last_axis(0)),
    Row(hole_attention.largest_cluster, clustered, "dtype batch vmap capture shuffle raises", (0, 1), bad=wrong_last_axis(0)),
    Row(holdout.select_candidates, judged, "dtype batch vmap capture empty shuffle raises", (0, 1), bad=lambda a: (a[0], a[1].replace(depth=a[1].depth[:, 1:]), a[2])),
    *(
        Row(clear, lambda b, n, d: (torch.where(frames(b, n, d)[0].depth > 2, 50.0, frames(b, n, d)[0].depth),), POINTLESS, grad=(0,))
        for clear in (no_depth.clear_no_depth, no_depth.clear_saturated, no_depth.clear_far_constant)
    ),
    Row(filters.grayscale, lambda b, n, d: (frames(b, n, d)[0].image,), POINTLESS, grad=(0,)),
    Row(filters.correlate_separable, lambda b, n, d: (frames(b, n, d)[0].image, [0.25, 0.5, 0.25], [-0.5, 0.0, 0.5]), POINTLESS + " raises", grad=(0,), bad=lambda a: (a[0][0], *a[1:])),
    Row(filters.gaussian_blur, lambda b, n, d: (frames(b, n, d)[0].image, 1.2), POINTLESS + " raises", grad=(0,), bad=lambda a: (a[0][0], a[1])),
    Row(filters.box_mean, lambda b, n, d: (frames(b, n, d)[0].image, 2), POINTLESS + " raises", grad=(0,), bad=lambda a: (a[0][0], a[1])),
    Row(thin_lens.spot_gain, lambda b, n, d: (lenses(b, d), uniform(b, 3, dtype=d, low=1, high=4)), POINTLESS + " raises", grad=(0, 1), bad=lambda a: (a[0], a[1][:, 0])),
    Row(thin_lens.spot_diameter, lambda b, n, d: (lenses(b, d), uniform(b, n, dtype=d, low=1, high=4), uniform(b, dtype=d, low=1, high=4, seed=1)), ALL, (1,), (0, 1, 2), bad=lambda a: (a[0], a[1], a[2][None])),
    Row(thin_lens.depth_of_spot, lambda b, n, d: (lenses(b, d), uniform(b, n, dtype=d, low=-2, high=0.5), uniform(b, dtype=d, low=1, high=2, seed=1)), ALL, (1,), (0, 1, 2), bad=lambda a: (a[0], a[1], a[2][None]), leaks=True),
    Row(blur.estimate_blur, lambda b, n, d: (shifted(b, n, d)[0],), "dtype batch vmap capture raises", bad=lambda a: (a[0][0],), slow="capture"),
    Row(blur.inverse_depth_from_blur, lambda b, n, d: (blurs(b, n, d), torch.ones(b, *HW, dtype=d), lenses(b, d), uniform(b, dtype=d, low=1, high=2)), "dtype batch vmap capture raises", bad=wrong_last_axis(1)),
    Row(blur.guess_side_by_height, lambda b, n, d: (blurs(b, n, d),), "dtype vmap capture"),
    Row(blur.guess_side_by_colour, lambda b, n, d: (frames(b, n, d)[0].image,), "dtype batch vmap capture raises", bad=lambda a: (a[0][:, :2],), slow="capture"),
    Row(sharpness.measure_sharpness, lambda b, n, d: (stacks(b, n, d),), POINTLESS + " raises", grad=(0,), bad=lambda a: (a[0][0],)),
    Row(sharpness.find_sharpest, lambda b, n, d: (sharpness.measure_sharpness(stacks(b, n, d)),), "dtype batch vmap capture raises", bad=lambda a: (a[0][0],)),
    Row(sharpness.depth_at_focus, lambda b, n, d: (uniform(b, *HW, dtype=d, high=3), torch.tensor([0.5, 1.0, 2.0, 4.0], dtype=d).expand(b, 4)), "dtype batch gradcheck raises", grad=(0, 1), bad=lambda a: (a[0][0], a[1])),
    Row(sharpness.align_stack, lambda b, n, d: (stacks(b, n, d),), "dtype raises", bad=lambda a: (a[0][0],)),
    Row(probe.compute_moments, probed, "vmap capture gradcheck empty raises", grad=(0, 1), bad=lambda a: (a[0][:, 1:], a[1])),
    Row(probe.join_moments, lambda b, n, d: (probe.compute_moments(*probed(b, n, d)), probe.compute_moments(*probed(b, n + 2, d))), "vmap capture gradcheck empty raises", grad=(0, 1), bad=lambda a: (a[0], probe.select_features(a[1], torch.tensor([0])))),
    Row(probe.solve_ridge, lambda b, n, d: (probe.compute_moments(*probed(b, n, d)), torch.tensor([0.1, 1.0], dtype=d)), "capture gradcheck empty raises", grad=(1,), bad=lambda a: (a[0], torch.ones(2, 3))),
    Row(probe.predict_targets, solved, "vmap capture gradcheck empty raises", grad=(0, 1), bad=wrong_last_axis(1)),
    Row(filling.fill_bilinear, lambda b, n, d: (sensed(b, n, d)[0], HW), "dtype batch vmap capture raises", bad=lambda a: (a[0][0], a[1])),
    Row(filling.fill_joint_bilateral, sensed, "dtype vmap capture gradcheck raises", grad=(1,), bad=lambda a: (a[0][0], a[1]), slow="capture"),
    Row(filling.fill_guided, sensed, "dtype batch vmap capture gradcheck raises", grad=(1,), bad=lambda a: (a[0][0], a[1])),
    Row(filling.fill_defocus_guided, filled, "dtype vmap capture raises", bad=wrong_last_axis(0), slow="capture"),
]  # fmt: skip

#: Functions without a batch of points: samplers, loops over a callable, flat lists of pooled points. Their promises are
#: tested where they are at home (test_front_end.py, test_pose.py, test_errors.py, test_integrate.py).
ELSEWHERE = {
    *(f"dhtorch.stages.pose_prior.{name}" for name in ("priors_from_frames", "reject_poses")),
    "dhtorch.geometry.determinism.run_without_grad",
    "dhtorch.geometry.camera.check_lens",  # tests/geometry/test_camera.py, tests/ops/test_compiled.py
    # tests/geometry/test_motion_fit.py, tests/measure
    *(f"dhtorch.geometry.motion_fit.{name}" for name in ("fit_motion", "mean_flow_form", "rotation_from_flow")),
    *(f"dhtorch.geometry.{name}" for name in ("motion_fit.scene_flow", "motion_fit.fit_epipolar_motion")),
    *(f"dhtorch.geometry.covariance.{name}" for name in ("chi2_quantile", "grouped_covariance")),
    *(f"dhtorch.metrics.change_points.{name}" for name in ("mean_changes", "median_of_three")),
    *(f"dhtorch.metrics.camera_paths.{name}" for name in ("align_camera_paths", "compare_motions", "motions_of_path")),
    *(
        f"dhtorch.metrics.grouped.{name}"
        for name in ("covariance_of_mean", "grouped_slopes", "huber_mean", "mad_sigma", "mean_over_stretches")
    ),
    *(
        f"dhtorch.geometry.checks.{name}" for name in ("constant", "move_from_host")
    ),  # tests/pipeline/test_accelerator.py
    "dhtorch.geometry.determinism.chunk_size",
    "dhtorch.metrics.holdout.truth_kept_ratio",
    "dhtorch.metrics.risk.find_knee",
    *(f"dhtorch.geometry.sensor_noise.{name}" for name in ("get_sensor_noise", "sensor_of_format")),
    *(
        f"dhtorch.metrics.uncertainty.{name}"  # tests/metrics/test_uncertainty.py
        for name in ("disjoint_agreement", "interval_coverage", "measure_uncertainty", "range_bias")
    ),
    "dhtorch.geometry.least_squares.has_graph",
    "dhtorch.geometry.patches.product_is_exact",
    *(f"dhtorch.geometry.patches.{name}" for name in ("fits_window_kernel", "run_window_kernel")),
    *(f"dhtorch.geometry.plane_sweep.{name}" for name in ("new_cost_volume", "planes_last")),
    "dhtorch.geometry.reprojection_problem.squared_residuals_at",
    "dhtorch.geometry.windows.row_bands",
    "dhtorch.geometry.p3p.p3p_of_planes",
    *(f"dhtorch.stages.sample.{name}" for name in ("spiral", "vogel_spiral", "regular_grid")),
    *(
        f"dhtorch.geometry.checks.{name}"
        for name in (
            "all_finite",
            "check",
            "shaped",
            "is_static",
            "is_transformed",
            "any_possible",
            "all_known",
        )
    ),
    *(f"dhtorch.geometry.sparse_grid.{name}" for name in ("occupied_cells", "connected_components")),
    *(
        f"dhtorch.integrate.volume.{name}"
        for name in ("make_volume", "fuse_views", "reserve_blocks", "drop_unconfirmed", "splat_points")
    ),
    "dhtorch.integrate.sweeps.depth_step_rel",
    *(f"dhtorch.integrate.surface.{name}" for name in ("extract_points", "extract_mesh")),
    "dhtorch.integrate.picture.draw_map",
    "dhtorch.integrate.from_maps.fuse_frame_maps",
    *(f"dhtorch.integrate.scales.{name}" for name in ("choose_coarse_voxel", "merge_surfaces")),
    *(
        f"dhtorch.integrate.mapping.{name}"
        for name in ("map_scene", "run", "choose_voxel", "should_mesh", "write_mapped_scene", "write_surface")
    ),
    *(f"dhtorch.integrate.mapping.{name}" for name in ("surface_shape", "file_from_world")),
    "dhtorch.integrate.colmap_model.write_colmap_workspace",
    *(
        f"dhtorch.integrate.level.{name}"
        for name in (
            "estimate_up",
            "mean_camera_up",
        )
    ),
    "dhtorch.geometry.se3.turn_between",
    *(
        f"dhtorch.integrate.recording.{name}"
        for name in (
            "estimate_pairs",
            "place_frames",
            "chain_poses",
            "linking_pairs",
            "fuse_recording",
            "fuse_recording_grids",
            "measure_coverage",
            "view_from_sensor",
            "view_from_sweep",
            "view_from_depth_map",
        )
    ),
    "dhtorch.geometry.filters.gaussian_taps",
    "dhtorch.pipeline.multiview.estimate_multiview",
    *(
        f"dhtorch.pipeline.pair.{name}"
        for name in (
            "estimate_pair",
            "sample_returns",
            "add_pose_samples",
            "without_added",
            "track_in_chunks",
            "solve_pose_and_triangulate",
            "solve_pairs",
            "repeat_views",
            "merge",
            "upcast_intrinsics",
            "undistort_tracks",
            "uniform_draws",
        )
    ),
    "dhtorch.stages.fuse.inverse_variance",
    "dhtorch.stages.fuse.fuse_consistent",
    "dhtorch.stages.shared_error.verify_views",
    "dhtorch.stages.triangulate.free_space_violations",
    *(
        f"dhtorch.pipeline.view_selection.{name}"
        for name in (
            "select_views_by_preview",
            "select_views_by_pose",
            "downscale_frame",
            "rank_views",
            "tracked_motion",
        )
    ),
    *(f"dhtorch.geometry.coarse_flow.{name}" for name in ("downscale", "is_not_identity", "invert_similarity")),
    "dhtorch.stages.track.resolve_coarse_flow",
    "dhtorch.stages.guided_search.guided_search",
    "dhtorch.geometry.patches.whole_is_faster",
    "dhtorch.geometry.components.small_components",
    *(
        f"dhtorch.metrics.map_quality.{name}"
        for name in ("find_artefacts", "artefact_counts", "near_depth_step", "step_counts")
    ),
    *(f"dhtorch.geometry.plane_sweep.{name}" for name in ("add_census_costs", "second_best_margin")),
    *(
        f"dhtorch.pipeline.dense.{name}"
        for name in (
            "map_hw",
            "dense_options",
            "map_pixel_centres",
            "downscale_grey",
            "sensor_depth_map",
            "check_dense_options",
        )
    ),
    *(
        f"dhtorch.pipeline.dense.{name}"
        for name in ("sweep_depth", "sweep_views", "gate_sweep", "filter_sweep", "merge_returns", "selected_views")
    ),
    "dhtorch.pipeline.dense.top_views",
    *(f"dhtorch.pipeline.completion.{name}" for name in ("complete_depth", "default_calibration")),
    "dhtorch.pipeline.fused.fuse_with_sweep",
    *(
        f"dhtorch.pipeline.map_filters.{name}"
        for name in ("filter_map", "map_fields", "with_fields", "copy_fields", "fill_fields")
    ),
    "dhtorch.pipeline.planes.fill_planes",
    "dhtorch.pipeline.dense.source_view_of",
    *(f"dhtorch.pipeline.surface.{name}" for name in ("sweep_planes", "refine_surface", "pose_variance")),
    *(
        f"dhtorch.validation.validate.{name}"
        for name in ("validate_depth", "validate_against", "combine_evidence", "clipped_depth", "share_interval")
    ),
    *(
        f"dhtorch.validation.evidence.{name}"
        for name in (
            "validation_references",
            "resolution_sigma",
            "is_coarser",
            "pixel_centres",
            "inflate_sigma",
            "no_evidence",
        )
    ),
    *(
        f"dhtorch.validation.evidence.{name}"
        for name in ("sparse_evidence", "photometric_evidence", "depth_consistency_evidence", "nearest_surface")
    ),
    "dhtorch.validation.evidence.triangulated_depth",
    *(
        f"dhtorch.validation.wrong_causes.{name}"
        for name in ("extend_surface", "flying_evidence", "outline_evidence", "name_causes")
    ),
    *(
        f"dhtorch.validation.faults.{name}"
        for name in (
            "rot90_map",
            "diagnose",
            "select_cause",
            "track_window",
            "ray_lengths",
            "undo_fault",
            "bounded_loss",
        )
    ),
    "dhtorch.metrics.detection.auroc",
    "dhtorch.alignment.align.align_depth",
    *(
        f"dhtorch.alignment.references.{name}"
        for name in ("collect_references", "sample_at_references", "local_spread")
    ),
    *(
        f"dhtorch.alignment.error_model.{name}"
        for name in (
            "make_basis",
            "evaluate_fields",
            "evaluate_curves",
            "predict_log_depth",
            "predict_references",
            "fit_models",
        )
    ),
    *(
        f"dhtorch.alignment.error_model.{name}"
        for name in ("placement_variance", "estimate_freedom", "motion_error_basis", "interpolation_variance")
    ),
    "dhtorch.alignment.residual_noise.residual_variance",
    "dhtorch.geometry.determinism.round_up",
    "dhtorch.geometry.least_squares.minimise",
    *(f"dhtorch.stages.track_chain.{name}" for name in ("frames_between", "images_used")),
    *(
        f"dhtorch.geometry.reprojection_problem.{name}"
        for name in ("pose_normal_equations_at", "minimise_tracks", "sandwich_sums")
    ),
    *(
        f"dhtorch.geometry.lucas_kanade.{n}"
        for n in (
            "search_displacements",
            "lucas_kanade_step",
            "squared_differences",
            "compare_windows",
            "window_covariance",
            "masked_apply",
            "is_between",
        )
    ),
    *(f"dhtorch.geometry.ransac.{name}" for name in ("msac_cost", "search_hypotheses")),
    *(
        f"dhtorch.metrics.errors.{name}"
        for name in ("make_points", "points_from_estimate", "measure_errors", "summarise_scenes", "metric_unit")
    ),
    *(
        f"dhtorch.metrics.risk.{name}"
        for name in ("ause", "cap_error", "risk_curve", "measure_risk", "realised_risk", "risk_coverage", "keep_surest")
    ),
    *(
        f"dhtorch.metrics.reliability.{n}"
        for n in (
            "reliability_diagram",
            "excess_ece",
            "pool_answers",
            "measure_reliability",
            "ece_interval",
            "leave_one_room_out",
        )
    ),
    *(
        f"dhtorch.metrics.calibration.{name}"
        for name in (
            "parse_calibration",
            *("list_calibrations", "load_calibration", "load_probability", "save_calibration"),
        )
    ),
    *(f"dhtorch.metrics.monotone.{name}" for name in ("fit_isotonic", "fit_platt")),
    *(
        f"dhtorch.metrics.control.{name}"
        for name in (
            "plug_in_threshold",
            "scene_quantile_threshold",
        )
    ),
    *(
        f"dhtorch.experiments.probes.ridge.{name}"
        for name in ("select_features", "make_folds", "mean_squared_error", "error_ratio", "is_equivalent")
    ),
    "dhtorch.metrics.curves.sample_curves",
    *(f"dhtorch.metrics.correlation.{name}" for name in ("pearson", "spearman")),
    *(
        f"dhtorch.metrics.bootstrap.{name}"
        for name in ("interval_over_scenes", "interval_of_statistic", "resample_scenes", "without_interval")
    ),
}


def case(row, promise):
    slow = [pytest.mark.slow] * (promise in row.slow.split())
    return pytest.param(row, marks=slow, id=f"{row.fn.__module__.split('.')[-1]}.{row.fn.__name__}")


def named(promise):
    rows = [row for row in ROWS if promise in row.promises.split()]
    return pytest.mark.parametrize("row", [case(row, promise) for row in rows])


# ---------------------------------------------------------------------------------------------------- the promises


@named("dtype")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_floating_outputs_follow_the_inputs_dtype(row, dtype):
    out = leaves(row.fn(*row.make(2, 7, dtype)))
    assert out and all(x.dtype == dtype for x in out if x.is_floating_point())


@named("batch")
def test_a_batch_is_a_loop_bit_for_bit(row):
    torch.set_num_threads(1)
    for n in (7, 64, 203):
        args = row.make(5, n, torch.float32)
        together = row.fn(*args)
        for b in (0, 3, 4):
            equal(tensor_map(lambda v, b=b: v[b : b + 1], together), row.fn(*take(args, row, b)))


@named("vmap")
def test_vmap_is_a_batch(row):
    args = row.make(3, 7, torch.float64)
    tensors, spec = zip(*(torch.utils._pytree.tree_flatten(a) for a in args), strict=True)
    flat = [v for group in tensors for v in group]
    moving = [k for k, v in enumerate(flat) if isinstance(v, torch.Tensor) and row.shared == ()]

    def one(*values):
        full = list(flat)
        for k, v in zip(moving, values, strict=True):
            full[k] = v[None]
        parts, start = [], 0
        for group, s in zip(tensors, spec, strict=True):
            parts.append(torch.utils._pytree.tree_unflatten(full[start : start + len(group)], s))
            start += len(group)
        return tuple(x[0] for x in leaves(row.fn(*parts)))

    mapped = torch.func.vmap(one)(*(flat[k] for k in moving))
    equal(tuple(leaves(row.fn(*args))), tuple(mapped), atol=1e-9)


#: Stages whose steps others of these capture, too.
CAPTURED_BY_OTHERS = {"make_prior", "relative_prior", "reject_misaligned", "refine_tracks"}


def captured():
    """Rows that are captured; those of geometry, which the stages capture with themselves, and of single experiments among
    the slow tests."""
    for row in (row for row in ROWS if "capture" in row.promises.split()):
        is_inner = row.fn.__module__.startswith(("dhtorch.geometry.", "dhtorch.experiments."))
        is_inner |= row.fn.__name__ in CAPTURED_BY_OTHERS
        param = case(row, "capture")
        yield pytest.param(*param.values, id=param.id, marks=[*param.marks, *[pytest.mark.slow] * is_inner])


@pytest.mark.parametrize("row", captured())
def test_captures_as_one_graph(row):
    torch._dynamo.reset()
    args = row.make(2, 7, torch.float64)
    with torch.no_grad():
        captured = torch.compile(row.fn, fullgraph=True, backend="eager")(*args)
        equal(tuple(leaves(row.fn(*args))), tuple(leaves(captured)), atol=row.atol)


@named("gradcheck")
def test_gradients(row):
    assert row.grad, "a row that promises gradients names the arguments"
    args = row.make(1, 4, torch.float64)
    flat = [leaves(args[k]) for k in row.grad]
    wanted = [v for group in flat for v in group if v.is_floating_point() and v.isfinite().all()]

    def call(*values):
        replacement = dict(zip(map(id, wanted), values, strict=True))
        new = [tensor_map(lambda v: replacement.get(id(v), v), a) if k in row.grad else a for k, a in enumerate(args)]
        out = [x for x in leaves(row.fn(*new)) if x.is_floating_point() and x.requires_grad]
        return tuple(torch.where(x.isfinite(), x, torch.zeros_like(x)) for x in out)

    inputs = tuple(v.detach().clone().requires_grad_() for v in wanted)
    # Whole images are checked along random directions, which finds the same mistakes in seconds.
    whole_images = sum(v.numel() for v in inputs) > 500
    assert inputs and torch.autograd.gradcheck(call, inputs, atol=1e-5, rtol=1e-3, fast_mode=whole_images)


@named("empty")
def test_no_points(row):
    """The answer about no points has the shapes and kinds of one about a few; a point axis alone is empty."""
    few, none = (leaves(row.fn(*row.make(2, n, torch.float32))) for n in (FEW, 0))
    assert len(few) == len(none)
    for x, y in zip(few, none, strict=True):
        assert y.dtype == x.dtype and y.shape == tuple(0 if size == FEW else size for size in x.shape)


@named("shuffle")
def test_shuffled_points_shuffle_the_answers(row):
    args = row.make(2, 9, torch.float64)
    order = torch.randperm(9, generator=generator())
    straight, shuffled = row.fn(*args), row.fn(*reorder(args, row, order))
    equal(
        tensor_map(lambda v: v[:, order] if v.dim() > 1 and v.shape[1] == 9 else v, straight), shuffled, atol=row.atol
    )


@named("padding")
def test_more_points_change_nothing_for_the_others(row):
    args = row.make(2, 24, torch.float64)
    few = reorder(args, row, torch.arange(17))
    cut = tensor_map(lambda v: v[:, :17] if v.dim() > 1 and v.shape[1] == 24 else v, row.fn(*args))
    equal(cut, row.fn(*few), atol=row.atol)


@named("nan")
def test_hopeless_values_neither_raise_nor_spread(row):
    """NaN in one point: no exception; the others keep their answers, and the gradients of these answers."""
    args = row.make(2, 9, torch.float64)

    def spoil(v):
        if not v.is_floating_point():
            return v
        v = v.clone()
        v[:, 4] = torch.nan
        return v

    others = torch.tensor([0, 1, 2, 3, 5, 6, 7, 8])
    pick = lambda tree: tensor_map(lambda v: v[:, others] if v.dim() > 1 and v.shape[1] == 9 else v, tree)  # noqa: E731

    def answered(given):
        """The other points' answers, and what these say to their own points and to everything that is shared."""
        want = lambda v: v.detach().clone().requires_grad_(v.is_floating_point())  # noqa: E731
        given = tuple(tensor_map(want, a) if k in row.grad else a for k, a in enumerate(given))
        answers = pick(row.fn(*given))
        numbers = [x for x in leaves(answers) if x.requires_grad]
        if not row.grad:
            return answers, ()
        sum((torch.where(x.isfinite(), x, 0) * x.detach().cos()).nansum() for x in numbers).backward()
        said = []
        for k in row.grad:
            slopes = [v.grad for v in leaves(given[k]) if v.is_floating_point() and v.grad is not None]
            said += pick(slopes) if k in row.points else [] if row.leaks else slopes
        return tensor_map(torch.Tensor.detach, answers), tuple(said)

    (whole, slopes), (spoilt, left) = (
        answered(a) for a in (args, tuple(tensor_map(spoil, a) if k in row.points else a for k, a in enumerate(args)))
    )
    equal(whole, spoilt, atol=row.atol)
    equal(slopes, left, atol=row.atol)
    assert all(slope.isfinite().all() for slope in slopes) and bool(slopes) == bool(row.grad)


@named("raises")
def test_wrong_shapes_raise(row):
    args = row.make(2, 9, torch.float32)
    with pytest.raises(ValueError, match="expected"):
        row.fn(*row.bad(args))


#: Function -> positions of arguments that may have another batch size: without use, with leading axes of any number, or
#: not checked before another function.
OTHER_BATCH = {
    "pnp_ransac": (2,),
    "check_pose_prior": (3,),
    "track_chain": (0, 1),
    **dict.fromkeys(("confidence", "confidence_from_error", "confidence_from_sigma"), (3,)),
    **dict.fromkeys(("join_moments", "solve_ridge", "predict_targets"), (0, 1)),
}


@named("raises")
def test_another_batch_in_one_argument_raises(row):
    args = row.make(2, 9, torch.float32)
    batched = [k for k, a in enumerate(args) if any(v.shape[:1] == (2,) for v in leaves(a)) and k not in row.shared]
    for position in batched if len(batched) > 1 else ():
        if position not in OTHER_BATCH.get(row.fn.__name__, ()):
            longer = tensor_map(lambda v: torch.cat((v, v[:1])) if v.shape[:1] == (2,) else v, args[position])
            with pytest.raises(ValueError, match="expected"):
                row.fn(*args[:position], longer, *args[position + 1 :])


@named("raises")
def test_another_number_of_points_in_one_argument_raises(row):
    args = row.make(2, 9, torch.float32)
    for position in row.points if len(row.points) > 1 else ():
        fewer = tensor_map(lambda v: v[:, :8] if v.shape[1:2] == (9,) else v, args[position])
        with pytest.raises(ValueError, match="expected"):
            row.fn(*args[:position], fewer, *args[position + 1 :])


# ---------------------------------------------------------------------------------------------------- completeness


#: Estimators of the laboratory that keep the promises of a stage.
ESTIMATORS = (helix_correlation, hole_attention, icp, blur, filling, sharpness)


def public_functions():
    parts = [
        method,
        pair,
        view_selection,
        multiview,
        dense,
        completion,
        fused,
        map_filters,
        importlib.import_module("dhtorch.pipeline.planes"),
        references,
        error_model,
        residual_noise,
        surface,
        align,
        evidence,
        faults,
        validate,
        wrong_causes,
        *ESTIMATORS,
    ]
    parts.append(importlib.import_module("dhtorch.experiments.probes.ridge"))
    for package in ("geometry", "stages", "metrics", "integrate"):
        module = importlib.import_module(f"dhtorch.{package}")
        found = pkgutil.iter_modules(module.__path__, f"dhtorch.{package}.")
        parts += [importlib.import_module(info.name) for info in found]
    for part in parts:
        for name, fn in inspect.getmembers(part, inspect.isfunction):
            experiment = part in ESTIMATORS and name in ("run", "verdict", "make_arms", "consecutive_links")
            if not name.startswith("_") and fn.__module__ == part.__name__ and not experiment:
                yield f"{part.__name__}.{name}"


def test_every_public_function_has_a_row():
    table = {f"{row.fn.__module__}.{row.fn.__name__}" for row in ROWS} | ELSEWHERE
    assert set(public_functions()) - table == set()
    assert table - set(public_functions()) == set(), "rows of functions that no longer exist"
    for row in ROWS:
        assert set(row.promises.split()) <= set(PROMISES), row
