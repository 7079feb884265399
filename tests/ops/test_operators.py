"""One oracle for all operators: whatever a call hands to a kernel, the torch reference answers alike.

A *call* of the table runs public functions on inputs that reach every branch of their kernels. Each kernel that runs is
compared with its reference on the same arguments, in one of the two orders in memory that its parameters may have, for
each element of the batch alone, for none, and on arguments that a kernel must leave to torch.
"""

import importlib
import inspect
import pkgutil
import sys
from dataclasses import replace
from functools import partial

import pytest
import torch
from support.contract_inputs import tracked
from support.contract_rows import equal, leaves
from support.pose_problems import NOISE, map_pose_inputs, pose_depth_problem
from support.public_entries import VIEWS, differing_entries, public_results
from torch.utils import _pytree as pytree

import dhtorch
from dhtorch import AUTO, FUSED, MAP, PAPER
from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.geometry import (
    affine_alignment,
    camera,
    components,
    epipolar,
    least_squares,
    map_estimate,
    patches,
    plane_sweep,
    pyramid,
    reprojection_problem,
    se3,
    windows,
)
from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.geometry.reprojection_problem import PoseDepthProblem
from dhtorch.metrics.holdout import range_split
from dhtorch.ops import loader
from dhtorch.pipeline import dense, map_filters, planes, surface
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS
from dhtorch.pipeline.pair import merge, undistort_tracks
from dhtorch.records import DepthMap, Frame, MergedDepth, PoseFit, Shutter, TrackHint
from dhtorch.stages import misalignment, pose
from dhtorch.stages.backproject import backproject
from dhtorch.stages.holes import classify, min_eigenvalue
from dhtorch.stages.pose import map_pose, pnp_ransac
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.synthetic import SyntheticRoom
from dhtorch.transforms import patch_tokens, sample_spec
from dhtorch.transforms.sample_spec import SampleSpec

for package in ("geometry", "stages", "pipeline", "transforms"):
    for info in pkgutil.iter_modules(importlib.import_module(f"dhtorch.{package}").__path__):
        importlib.import_module(f"dhtorch.{package}.{info.name}")

#: Name of an operator -> the function that dispatches it.
OPERATORS = {
    f.__name__: f
    for module in list(sys.modules.values())
    if module.__name__.startswith("dhtorch.")
    for f in vars(module).values()
    if inspect.isfunction(f) and f.__code__.co_name == "dispatched"
}

#: How far numbers of kernel and reference may be apart: a fraction of their size, or of the mean size of all, and the
#: fraction of them that may be further apart; and the fraction of masks, codes and indices that may differ. 0 = equal.
TOLERANCES = {
    "_depth_variance": (1e-6, 0.0),
    "_equations": (1e-4, 0.0),
    "_filled": (1e-5, 0.005),
    "_filter": (2.5e-7, 0.0),
    "_fit_windows": (1e-5, 0.0),
    "_gate": (2.5e-7, 0.0),
    "_mean_cost": (5e-6, 0.0),
    "_minimum": (1e-4, 0.0),
    "_near_pose": (5e-4, 0.001),
    "_noise": (1e-4, 0.0),
    "_parallax": (1e-6, 0.0),
    "_pose_variance": (1e-6, 0.0),
    "_read_samples": (2.5e-7, 0.0),
    "_register_level": (1e-4, 0.02),
    "_robust_cost": (1e-6, 0.0),
    "_robust_pose": (1e-4, 0.0),
    "_sandwich": (1e-10, 0.0),
    "_search": (1e-5, 0.01),
    "_solve": (1e-10, 0.0),
    "_squared_differences": (5e-6, 0.0),
    "_squares": (2e-4, 0.0),
    "_triangulate": (1e-6, 0.0),
    "_window_texture": (4e-5, 0.0),
}

#: Operators whose points of all pairs form one row, or which read images from their options: no batch to take apart.
ONE_ROW = ("_search", "_squared_differences", "_register_level", "_read_samples")

#: Operators that write to an argument.
WRITING = ("_write_metres", "_add_costs", "_fill_level")

#: Operators whose values have a meaning only where their mask, the second of the results, is true.
MASKED = ("_search", "_register_level")


def drawn(seed=0):
    return torch.Generator().manual_seed(seed)


def whole_numbers(*shape, most, seed=0):
    return torch.randint(0, most, shape, generator=drawn(seed), dtype=torch.uint8)


def uniform(*shape, seed=0, low=0.0, high=1.0):
    return low + (high - low) * torch.rand(*shape, generator=drawn(seed))


#: Two cameras of images of about 40 x 30 pixels.
SMALL_CAMERAS = Camera(torch.tensor([[40.0, 41.0], [35.0, 35.0]]), torch.tensor([[19.5, 14.0], [21.0, 15.5]]))

#: The first turned and moved sideways, the second straight ahead, through what it sees.
MOTIONS = torch.tensor([[0.02, -0.1, 0.2, -0.3, 0.1, 0.05], [0.0, 0.0, 0.0, 0.1, 0.0, -1.4]])


# ---------------------------------------------------------------------------------------------------- the calls


def methods():
    """PAPER, MAP, two source views, AUTO, and maps of every pixel."""
    room = SyntheticRoom(n_frames=9, hw=(96, 128), depth_hw=(48, 64))
    frame, *others = (range_split(room[k], 2.0) for k in (1, 6, 8))
    for method in (PAPER, MAP, MAP.replace(views=5), AUTO):
        method.replace(n=256)(frame, others if method.views > 1 else others[0])
    dhtorch.complete_depth(frame, others, method=FUSED.replace(n=256), size=64)


def transform():
    """A sample of a data loader with depth in millimetres, its numbers and tokens."""
    room = SyntheticRoom(n_frames=3, hw=(96, 128), depth_hw=(48, 64))
    K = camera.to_matrix(room[0].camera)[0]
    keys = {"image": "image", "depth": "depth", "intrinsics": "K", "depth_unit": "mm", "n": 64, "tokens_hw": (28, 42)}
    extend = dhtorch.ExtendDepth(**keys, other_image="other")
    for kind in (torch.int16, torch.uint16):
        depth = (1000 * room[0].depth[0]).to(torch.int32).to(kind)
        extend({"image": room[0].image[0], "depth": depth, "K": K, "other": room[2].image[0]})


def seen_from_above(hw=(61, 83), map_hw=(48, 64)):
    """Two views with levels of confidence, returns of every kind, bright and dark places, and cameras of their own."""
    image = (whole_numbers(2, 3, *hw, most=256) // 4 + 120).contiguous(memory_format=torch.channels_last)
    image[0, :, :20], image[1, :, :, :30], image[:, :, 40, 40:50] = 255, 5, 255
    depth = uniform(2, *map_hw, low=-0.4, high=3.6)
    depth[:, ::7, ::5], depth[0, 3], depth[1, :, 9] = torch.nan, torch.inf, -torch.inf
    K = torch.tensor([[[70.0, 0, 40], [0, 71, 30], [0, 0, 1]], [[64, 0, 41.5], [0, 66, 29], [0, 0, 1]]])
    return Frame(image, depth, camera.from_matrix(K), conf=whole_numbers(2, *map_hw, most=3, seed=1))


def samples(n, lens, **options):
    """Samples, their holes and the sensor's own map; pixels beyond the border, or that are no numbers."""
    frame = seen_from_above(map_hw=(61, 83) if lens == "bent" else (48, 64))
    own = Camera(f=frame.camera.f * 0.7, c=frame.camera.c * 0.8)
    bent = torch.tensor([[0.2, -0.1, 0.001, 0.002, 0.0]]).expand(2, 5)
    if lens == "bent":
        frame = frame.replace(camera=frame.camera.replace(distortion=bent), conf=None)
    if "map" in lens:
        frame = frame.replace(depth_camera=own.replace(distortion=bent if lens == "bent map" else None))
    uv = uniform(n, 2, seed=2) * torch.tensor([99.0, 75.0]) - 7
    uv[:5] = torch.tensor([torch.nan, torch.inf, -torch.inf, 3e9, -3e9])[:, None]
    found = classify(frame, backproject(frame, uv, **options))
    merge(found.replace(xyz=torch.where(found.depth[..., None] < 0.5, torch.inf, found.xyz)), None)


def windows_of(layout, n, block=7, **options):
    """Windows around samples in images of any layout; those of all pixels are computed where most are sampled."""
    image = whole_numbers(2, 1 if layout == "grey" else 3, 41, 53, most=256)
    if layout == "interleaved":
        image = image.contiguous(memory_format=torch.channels_last)
    if layout == "bgr of rgba":
        image = whole_numbers(2, 41, 53, 4, most=256).permute(0, 3, 1, 2)[:, [2, 1, 0]]
    depth = uniform(2, 41, 53, seed=1, low=-1, high=3)
    depth[:, ::7, ::5], depth[0, 3], depth[1, :, 9] = torch.nan, torch.inf, -torch.inf
    uv = uniform(2, n, 2, seed=2, low=-8, high=62)
    uv[0, 0] = torch.nan
    frame = Frame(image, depth, Camera(f=torch.full((2, 2), 50.0), c=torch.full((2, 2), 20.0)))
    classify(frame, backproject(frame, uv, **options), block=block)


def pixels():
    uv = uniform(2, 50, 2, seed=3, low=-5, high=35)
    uv[0, :8, 0] = torch.tensor([torch.nan, torch.inf, -torch.inf, 3e9, -3e9, 0.5, -0.5, 1.5])
    patches.containing_pixels(uv)


def pyramids():
    for channels in (1, 3):
        image = whole_numbers(2, channels, 61, 83, most=256)
        pyramid.build_pyramid(image, 3, 11)
        pyramid.build_pyramid(image[..., 1:, 3:].float() / 255, 3, 11, gradients=False)


def depths_in_metres():
    """All 16-bit numbers, and maps without returns, of wrong units, or with values that are no numbers."""
    every = torch.arange(-(1 << 15), 1 << 15, dtype=torch.int32).to(torch.int16).view(2, 128, 256)
    for kind in (torch.uint16, torch.int16):
        for bounds in ((0.0, torch.inf), (0.4, 9.0)):
            SampleSpec(depth_unit="mm", depth_range=bounds).metres(list(every.view(kind)))
    depth = uniform(6, 60, 80, seed=5, high=3)
    depth[0, ::2], depth[1], depth[2], depth[3, :40] = 0, 0, 0, 300.0
    depth[2, 31, 17], depth[4] = 1.5, 0.004
    depth[5, :, ::3] = torch.nan
    for some in ([0, 5], [0, 1], [2], [3], [4], [5], [0, 3, 4]):
        sample_spec._check_returns(depth[some], spec=SampleSpec(depth_unit="m"), low=0.01, high=100.0)


def tokens():
    for batch, n, size in ((1, 5000, None), (3, 400, (42, 70)), (2, 0, (28, 28))):
        uv = uniform(batch, n, 2) * torch.tensor([90.0, 70.0]) - 5
        depth, sigma = uniform(batch, n, seed=1), uniform(batch, n, seed=2)
        uv[:, ::7, 1], depth[:, ::5], sigma[:, ::11], depth[:, ::13] = torch.nan, 0, torch.nan, torch.inf
        source = whole_numbers(batch, n, most=3, seed=3).int()
        hole = whole_numbers(batch, n, most=8, seed=4).int() - 1  # -1: of no class
        for fit in ("stretch", "pad", "crop"):
            merged = MergedDepth(uv, depth, sigma, torch.ones_like(depth), source)
            patch_tokens(merged, hole, (60, 80), patch=7, tokens_hw=size, fit=fit)


def surfaces():
    """Costs as small as bytes hold: four paths fit into one, or two, or one, and larger ones."""
    for shape, views, most in (
        ((2, 7, 5, 48), (1, 3), 31),
        ((1, 1, 9, 3), (8,), 249),
        ((1, 6, 1, 4), (2,), 2),
        ((3, 5, 4, 130), (1, 2, 8), 255),
        ((4, 6, 7, 96), (1, 2, 3, 5), 31),
        ((1, 3, 3, 600), (1,), 20),
    ):
        best, some = plane_sweep.aggregate_best_plane(whole_numbers(*shape, most=most), torch.tensor(views))
        for reach in (0.0, 2.0, 1e4):
            plane_sweep.second_best_margin(some, best, torch.full(shape[:1], reach))


def costs():
    """Costs of planes, also behind the source view, and of a view that one pair only wants."""
    images = gaussian_blur(uniform(2, 2, 30, 41), 1.0)
    base = plane_sweep.make_reference_view(images[:, :1], SMALL_CAMERAS)
    view = plane_sweep.SweptView(images[:, 1:], SMALL_CAMERAS, se3.exp(MOTIONS))
    q = torch.linspace(0, 1, 37).square() * torch.tensor([[1.0], [0.9]])
    C = torch.zeros_like(plane_sweep.new_cost_volume(q, hw=base.hw))
    for wanted in ([True, False], [True, True]):
        plane_sweep.add_census_costs(C, base, view, q, torch.tensor(wanted))


def projections(turning, coefficients):
    image = uniform(2, 1, 6, 21, seed=1).mul(9).round() / 9  # equal neighbours are not darker
    plane_sweep.census_transform(image)
    lens = uniform(2, coefficients, seed=2, high=0.2) if coefficients else None
    T = se3.exp(0.5 * torch.randn(2, 6, generator=drawn(3)))
    rate = 0.1 * torch.randn(2, 3, generator=drawn(4)) if turning else None
    view = plane_sweep.SweptView(torch.zeros(2, 1, 4, 4), SMALL_CAMERAS.replace(distortion=lens), T, rate)
    plane_sweep.project_inverse_depth(view, uniform(2, 500, 3, seed=5, low=-0.5, high=0.5), uniform(2, 500, seed=6))
    for shape in ((2, 30, 17), (2, 3, 5), (2, 1, 1)):
        windows.smooth_within_tolerance(uniform(*shape, seed=7), torch.tensor([0.2, 0.5]))


def connected():
    cuts = uniform(2, 40, 52) < 0.9, uniform(2, 39, 53, seed=1) < 0.9
    for fraction in (0.4, 0.59, 0.7):
        for n, same in ((2, None), (7, cuts), (30, cuts)):
            components.small_components(uniform(2, 40, 53, seed=2) < fraction, n, same=same)


def filtered(hw):
    """Boxes before a slanted wall: swept depths with halos, specks and holes, returns on some boxes, and an image."""
    g = drawn(2)
    (h, w), rows, columns = hw, torch.arange(hw[0])[:, None], torch.arange(hw[1])
    q, sensed = (0.2 + 0.001 * columns + 0.0005 * rows).expand(3, h, w).clone(), torch.zeros(3, h, w).bool()
    seen = q.clone()  # what the image shows
    for k in range(12):
        sides = 4 + 14 * torch.rand(2, generator=g) * (1 + (k > 8))
        top, left = ((n - 2) * x for n, x in zip(hw, torch.rand(2, generator=g), strict=True))
        box = (rows - top).abs().lt(sides[0]) & (columns - left).abs().lt(sides[1])
        wider = (rows - top).abs().lt(sides[0] + 3) & (columns - left).abs().lt(sides[1] + 3)
        depth = 0.25 + 0.5 * torch.rand(1, generator=g)
        q[k % 3] = torch.where(wider, depth, q[k % 3])
        seen[k % 3] = torch.where(box, depth, seen[k % 3])
        if k % 2:
            sensed[k % 3] |= box
    q = q * (1 + 0.004 * torch.randn(3, h, w, generator=g))
    depth = 1 / torch.where(torch.rand(3, h, w, generator=g) < 0.01, 2 * q, q)
    keep = torch.rand(3, h, w, generator=g) < torch.tensor([0.97, 0.9, 0.7])[:, None, None]
    usable = sensed & (torch.rand(3, h, w, generator=g) < 0.98)
    swept = swept_map(keep, depth, 0.01 * depth, keep * torch.rand(3, h, w, generator=g))
    near = torch.where(usable, torch.tensor([1.02, 1.02, 1.08])[:, None, None] / seen, 0.0)
    returns = map_filters.SensorReturns(near, 0.01 * near, usable.float(), usable)
    grey = torch.where(torch.tensor([False, False, True])[:, None, None], 0.5, seen)
    grey = grey + 0.01 * torch.rand(3, h, w, generator=g)
    sparse = torch.tensor([False, False, True])
    map_filters.filter_map(swept, returns, grey, sparse, replace(DEFAULT_DENSE_OPTIONS, speck_px=9))


def swept_map(keep, depth, sigma, score):
    nan, code = torch.tensor(torch.nan), torch.where(keep, Source.SWEPT, Source.NONE).int()
    gate = torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).int()
    return DepthMap(torch.where(keep, depth, nan), torch.where(keep, sigma, nan), score, code, gate)


def gates():
    """Four views: one refuted by its returns, one with a gate of its own, one with too few returns to be refuted."""
    q = uniform(4, 31, 23, low=-0.01, high=0.5)
    scale = torch.tensor([1e-5, 1e-3, 1e-3, 1e-3])[:, None, None]
    own, shared = (scale * uniform(4, 31, 23, seed=k) * q.square() for k in (1, 2))
    flags = [uniform(4, 31, 23, seed=k) < fraction for k, fraction in enumerate((0.9, 0.95, 0.05, 0.9), 3)]
    pair_gate = torch.tensor([0, Gate.NO_POSE, 0, 0], dtype=torch.int32)
    counted = torch.arange(31 * 23).view(31, 23) < torch.tensor([999, 999, 999, 9])[:, None, None]
    usable = (uniform(4, 31, 23, seed=7) < 0.3) & counted
    off = torch.tensor([1.06, 1.0, 1.6, 1.6])[:, None, None]  # the first within the ratio, beyond the sigmas
    near = torch.where(usable, off * uniform(4, 31, 23, seed=8, low=0.99, high=1.01) / q.clamp_min(1e-3), 0.0)
    options = replace(DEFAULT_DENSE_OPTIONS, min_overlap_pixels=20, max_sigma_rel=0.04, min_correlation=0.1)
    of_surface = q, own, shared, uniform(4, 31, 23, seed=9), *flags, pair_gate, torch.tensor([0.01, 0.02, 0.0, 0.03])
    swept = DepthMap(*dense._gate(*of_surface, near, 0.01 * near, usable, options=options)[:5])
    dense.merge_returns(swept, map_filters.SensorReturns(near, 0.01 * near, uniform(4, 31, 23, seed=10), usable))


def weakly_textured(hw, B=3):
    """Arguments of fill_planes: views of two slanted surfaces of several grey values, answered in part or, on the right,
    as a whole, with noise, outliers, holes, and returns on the left; the second sensor reaches far, the last view has
    no sweep."""
    v, u = torch.meshgrid(*(torch.arange(n).float() for n in hw), indexing="ij")
    slope = torch.tensor([1.0, -0.7, 0.4])[:B, None, None] * 4e-4
    q = 0.35 + slope * (u - hw[1] / 2) - 3e-4 * (v - hw[0] / 2)
    q = torch.where(u + 0.3 * v < 0.7 * hw[1], q, 0.75 * q)
    depth = (1 + 0.02 * torch.randn(B, *hw, generator=drawn(0))) / q
    depth = torch.where(uniform(B, *hw, seed=1) < 0.04, 1.5 * depth, depth)
    depth[:, ::17, ::5], depth[:, ::13, ::7] = torch.inf, -1.0
    cells = uniform(B, -(-hw[0] // 24), -(-hw[1] // 32), seed=2)
    grey = 0.4 + 0.09 * cells.repeat_interleave(24, 1).repeat_interleave(32, 2)[:, : hw[0], : hw[1]]
    whole = u > 0.72 * hw[1]
    hole = (u - 0.6 * hw[1]).abs() < 0.1 * hw[1]
    hole = hole | ((v - 0.3 * hw[0]).abs() < 0.12 * hw[0]) & (u > 0.2 * hw[1])
    support = (whole | (uniform(B, *hw, seed=3) < 0.6)) & ~hole
    swept = support & (whole | (uniform(B, *hw, seed=4) < 0.7))
    if B > 2:
        swept[2] = support[2] = False
    sigma = 0.02 * depth * uniform(B, *hw, seed=5, low=0.5, high=1.5)
    usable = (u < 0.3 * hw[1]) & (uniform(B, *hw, seed=6) < 0.5)
    returns = map_filters.SensorReturns(1.01 / q, 0.01 / q, torch.ones_like(q), usable)
    maps = (swept_map(keep, depth, sigma, 0.8 * keep) for keep in (swept, support))
    return *maps, returns, grey[:, None], torch.tensor([0.5, 3.2, 3.0])[:B]


def filled(hw, **options):
    sparse = torch.tensor([False, False, True])
    for given in (None, sparse, ~sparse):
        planes.fill_planes(*weakly_textured(hw), sparse=given, options=replace(DEFAULT_DENSE_OPTIONS, **options))


#: Options of ``fill_planes``.
PLANE_OPTIONS = {
    "defaults": {},
    "loose": {
        "max_plane_disagreement": 1.0,
        "min_plane_share": 0.9,
        "max_plane_sigma_rel": 0.05,
        "max_refuted_rays": 1.0,
        "max_plane_difference": 0.1,
        "max_sigma_rel": 0.5,
    },
    "small cells": {
        "plane_cell_px": 5,
        "min_cell_pixels": 3,
        "plane_reach_cells": 9,
        "plane_ray_support": 2,
        "min_plane_support": 8,
        "plane_neighbours": 1,
        "min_triple_area": 2.0,
        "max_plane_sigma_rel": 0.03,
    },
    "strict": {
        "plane_grey_difference": 0.04,
        "plane_inlier_ratio": 0.06,
        "min_plane_support": 30,
        "independent_support": 0.1,
        "common_sigma_ratio": 0.8,
        "plane_reach": 0.8,
        "max_sigma_rel": 0.022,
    },
}


def fits(hw, lens=None, **options):
    """Pairs turned and moved, pixels that leave the source view or lie behind it, and one without texture."""
    grey_0, grey_1 = (gaussian_blur(uniform(3, 1, *hw, seed=k), 1.2) for k in (3, 5))
    grey_0[2] = 0.4
    lens = None if lens is None else torch.tensor([lens] * 3)
    of_both = Camera(torch.full((3, 2), float(max(hw))), torch.tensor([[hw[1] / 2, hw[0] / 2]] * 3), lens)
    T = se3.exp(0.05 * torch.randn(3, 6, generator=drawn(3)) + torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -0.4]))
    base, view = plane_sweep.make_reference_view(grey_0, of_both), plane_sweep.SweptView(grey_1, of_both, T)
    q = 0.2 + 0.1 * gaussian_blur(uniform(3, 1, *hw, seed=4), 2.0)[:, 0]
    q[:, 0] = 4.0  # behind
    plane_sweep.fit_windows(base, view, plane_sweep.stack_gradients(view.image), q, **options)


def occlusions(turning):
    grey = uniform(2, 1, 13, 50, seed=8)
    of_both = SMALL_CAMERAS.replace(c=torch.tensor([[24.5, 6.0], [21.0, 5.5]]))
    T = se3.exp(MOTIONS * torch.tensor([1.0, 1.0, 1.0, 2.0, 1.0, 1.0]))
    base, view = plane_sweep.make_reference_view(grey, of_both), plane_sweep.SweptView(grey, of_both, T)
    q = uniform(2, 13, 50, seed=9)
    plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, torch.tensor([0.01, 0.3]))
    half = torch.randn(2, 9, 9, generator=drawn(10))
    cov, none = 1e-4 * half @ half.mT, torch.zeros(2)
    shutter = Shutter(torch.zeros(2, 3), cov) if turning else None
    code = torch.tensor([PoseCode.OK, PoseCode.KEPT_PNP], dtype=torch.int32)
    fit = PoseFit(T, cov[:, :6, :6].contiguous(), none[:, None] > 1, none.long(), none, none, none, code, shutter)
    motion = torch.randn(2, 13, 50, 2, generator=drawn(11))
    motion[0, :2] = 0.0
    surface.pose_variance(base, view, fit, q, motion)
    for code in (PoseCode.OK, PoseCode.TOO_FEW):  # what is not known is no number
        lost = fit.replace(code=torch.full_like(fit.code, code), cov=fit.cov * torch.nan, shutter=None)
        assert not surface.pose_variance(base, view, lost, q, motion).any()


def seen_twice():
    """Two images, each seen again moved by a few pixels and lit otherwise; points in, at the border of and beside it."""
    rough, fine = (gaussian_blur(uniform(2, 1, 120, 150, seed=k), s) - 0.5 for k, s in ((5, 3.0), (6, 0.8)))
    wide = 2.5 * rough + fine + 0.5
    here, there = wide[..., 10:-10, 10:-10], 0.8 * wide[..., 13:-7, 5:-15] + 0.1
    there = there + 0.004 * torch.randn(there.shape, generator=drawn(7))
    uv = uniform(2, 300, 2, seed=8) * torch.tensor([134.0, 104.0]) - 2
    uv[:, 0], uv[0, 1], uv[1, 1] = torch.nan, torch.inf, 1e30
    return here.clamp(0, 1), there.clamp(0, 1), uv


def searched(normalise, window, levels):
    here, there, uv = seen_twice()
    if normalise != "gain_bias":
        there = (there - there.mean()) * here.std() / there.std() + here.mean()
    start = TrackHint(start=(uv + torch.tensor([4.0, -4.0])).nan_to_num(posinf=1e30))
    lucas_kanade(here, there, uv, hint=start, normalise=normalise, window=window, levels=levels)
    if levels > 1:
        lucas_kanade(here, there, uv, normalise=normalise, window=window, levels=levels)
    here[0, 0, 30:33, 60:63], there[1, 0, 70:72, :20] = torch.nan, torch.inf
    lucas_kanade(here, there, uv, hint=start, normalise=normalise, window=window, levels=levels)


def registered(**options):
    """Windows registered from 0.2 px beside where they moved to, all and a third; without texture, and of no numbers."""
    here, there, uv = seen_twice()
    window = options.get("window", 21)
    some = uniform(*uv.shape[:2], seed=7) < 0.3
    for first, wanted in ((here, None), (here, some), (0 * here, None)):
        views = pyramid.build_pyramid(first, 1, window), pyramid.build_pyramid(there, 2, window, gradients=False)
        affine_alignment.register_affine(*views, uv, uv + torch.tensor([5.2, -2.8]), wanted=wanted, **options)
    here[0, 0, 30:33, 60:63], there[1, 0, 70:72, :20] = torch.nan, torch.inf
    views = pyramid.build_pyramid(here, 1, window), pyramid.build_pyramid(there, 2, window)
    affine_alignment.register_affine(*views, uv, uv + torch.tensor([5.2, -2.8]), **options)


def magnified():
    """Windows magnified so much that they are registered on the level of half the size."""
    small = gaussian_blur(uniform(1, 1, 60, 80, seed=6), 1.5)
    small = (small - small.mean()) * 2 + 0.5
    large = torch.nn.functional.interpolate(small, scale_factor=2, mode="bicubic", align_corners=False)
    uv = 15 + uniform(1, 100, 2, seed=7) * torch.tensor([50.0, 30.0])
    views = pyramid.build_pyramid(small, 1), pyramid.build_pyramid(large, 2)
    affine_alignment.register_affine(*views, uv, 2 * uv + 0.7, linear=1.9 * torch.eye(2)[None])


def near_pairs(batch, n, wrong):
    """Points 1 to 4 m away seen again with noise, a fraction of them anywhere: input of ``pnp_ransac``."""
    found, tracks, _, *cameras = tracked(batch, n, torch.float32)
    outlier = uniform(batch, n, 1, seed=6) < wrong
    tracks = tracks.replace(
        uv_1=torch.where(outlier, uniform(batch, n, 2, seed=7, high=64), tracks.uv_1),
        valid=uniform(batch, n, seed=8) < 0.9,
    )
    return found, tracks, *cameras, uniform(batch, 64, 3, seed=9)


def near_poses(batch, n, wrong, **options):
    pnp_ransac(*near_pairs(batch, n, wrong), **options)


def hopeless_poses():
    """Too few tracks, none with depth, points on a line, in one place, tracks of no numbers, and one that has a pose."""
    found, tracks, *rest = near_pairs(7, 60, 0.2)
    xyz, uv_1, valid = found.xyz.clone(), tracks.uv_1.clone(), tracks.valid.clone()
    valid[0] = False
    valid[1, 2:] = False
    xyz[2] = torch.nan
    xyz[3] = torch.linspace(1, 2, 60)[:, None] * torch.tensor([0.1, 0.2, 1.0])
    xyz[4] = xyz[4, :1]
    uv_1[5] = torch.inf
    codes = pnp_ransac(found.replace(xyz=xyz), tracks.replace(uv_1=uv_1, valid=valid), *rest).code
    assert codes.tolist()[:3] == [PoseCode.TOO_FEW] * 3 and codes[6] == PoseCode.OK and (codes[3:6] > 0).all()


def differentiated():
    """Where the pose carries a gradient, its search alone is compiled."""
    found, tracks, *rest = near_pairs(2, 90, 0.2)
    uv_1 = tracks.uv_1.clone().requires_grad_()
    assert pnp_ransac(found, tracks.replace(uv_1=uv_1), *rest).T_1_from_0.t.requires_grad


def every_track(turning, dtype=torch.float32):
    """Tracks of every kind, as many as compiled code takes; their unknowns and noise."""
    problem, at = pose_depth_problem()
    rest = (x.repeat(*[1] * (x.ndim - 1), 16) for x in pytree.tree_leaves(problem)[2:])
    at = at._replace(T=at.T.to(dtype), shutter_rate=at.shutter_rate.to(dtype) if turning else None)
    return PoseDepthProblem(problem.f, problem.c, *rest).to(dtype), at, NOISE.repeat(1, 16).to(dtype)


def equations(turning):
    for dtype in (torch.float32, torch.float64):
        problem, at, noise = every_track(turning, dtype)
        weights = torch.tensor([0.1, 0.7], dtype=dtype), torch.tensor([1e4, 10.0], dtype=dtype)
        robust = {"kernel": "geman_mcclure", "bend": 2.0}
        normal, cost = reprojection_problem.pose_normal_equations_at(problem, noise, *weights, **robust)
        normal(at), cost(at)
        if dtype == torch.float32:
            known = reprojection_problem.track_constants(problem)
            reprojection_problem.squared_residuals_at(problem, at, known)(noise)
            for steps, rotation_only in ((0, False), (1, True), (4, False), (4, True)):
                reprojection_problem.minimise_tracks(
                    problem, at, noise, *weights, steps=steps, rotation_only=rotation_only, **robust
                )
            reprojection_problem.estimate_noise_variance(problem, at)


def covariances():
    problem, at, noise = every_track(True, torch.float64)
    for far in (0.0, 0.1):
        weight = torch.tensor([far, 0.7], dtype=torch.float64)
        solution = map_estimate.MapSolution(at, noise, weight, 1e4 * weight, weight > 0)
        for options in (map_estimate.FitOptions(), map_estimate.FitOptions(bend=0.7, blocks=(2, 2))):
            assert map_estimate.pose_covariance(problem, solution, options)[1].all()


def systems(n, columns):
    """Small systems of any scale: not a number, negative, infinite, zero and of rank one, and two sound ones."""
    rows = torch.randn(7, n + 4, n, generator=drawn(n), dtype=torch.float64)
    scales = torch.logspace(-3, 3, n, dtype=torch.float64)
    H, b = (
        rows.mT @ rows * scales * scales[:, None],
        torch.randn(7, n, columns, generator=drawn(1), dtype=torch.float64),
    )
    H[1, 0, 0], H[2, 1, 1], b[3, 0, 0], H[4], H[5] = torch.nan, -1.0, torch.inf, 0.0, 1.0
    assert least_squares.solve_spd(H, b)[1].tolist() == [True, *[False] * 5, True]
    assert least_squares.solve_spd(H.float(), b.float())[0].dtype == torch.float32


def lenses(coefficients):
    """Pixels of two lenses, also outside of the lens's model, and pixels that are no numbers."""
    lens = torch.tensor([[0.26, -0.95, -0.005, 0.002, 1.1, 0.1, 0.02, 0.01], [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    bent = Camera(uniform(2, 2, low=500, high=520), torch.full((2, 2), 300.0), lens[:, :coefficients])
    uv = uniform(2, 301, 2, seed=coefficients, low=-150, high=850)
    uv[0, 0], uv[1, 3, 1] = torch.nan, torch.inf
    assert 2 <= int(camera.undistort(bent, uv).isnan().any(-1).sum()) < 500
    camera.undistort_jacobian(bent, uv[:, 4:])
    camera.rays(bent, uv), camera.rays(bent.replace(distortion=None), uv)


def straight_tracks():
    """Tracks in ideal pixels, of lenses of both views or either, some outside of them."""
    _, tracks, straight, _, _ = near_pairs(3, 301, 0.2)
    bent = straight.replace(distortion=torch.tensor([[0.26, -0.95, -0.005, 0.002, 1.1]]).expand(3, 5))
    uv_0, uv_1, cov = 1.8 * tracks.uv_0 - 200, tracks.uv_1.clone(), tracks.cov * uniform(3, 301, 2, 2, low=1, high=2)
    uv_0[0, 0], uv_1[1, 3, 1], cov[2, 5, 0, 1], cov[0, 7] = torch.nan, torch.inf, torch.nan, torch.inf
    for cameras in ((bent, bent), (bent, straight), (straight, bent)):
        undistort_tracks(tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov), *cameras)


def depths_of_tracks():
    """Triangulated tracks, the last pair without a baseline, and their variances, one of which is infinite."""
    _, tracks, of_both, _, _ = near_pairs(3, 301, 0.2)
    T = se3.exp(0.1 * torch.randn(3, 6, generator=drawn(1)))
    T = T.replace(t=T.t * torch.tensor([[1.0], [1.0], [0.0]]))
    geometry = epipolar.triangulate(tracks.uv_0, tracks.uv_1, of_both, of_both, T)
    geometry.slope[0, 3] = 0.0
    rows = torch.randn(3, 6, 9, generator=drawn(2))
    own, _ = epipolar.depth_variance(geometry, tracks.cov + uniform(3, 301, 1, 1, high=0.1), 1e-6 * rows @ rows.mT)
    assert own[0, 3].isinf()


def parallaxes(turning):
    found, tracks, of_both, _, _ = near_pairs(3, 301, 0.2)
    xyz, uv_1, sigma = found.xyz.clone(), tracks.uv_1.clone(), found.sigma.clone()
    xyz[:, ::3], uv_1[0, 5], xyz[1, 7, 2], sigma[1, 8] = torch.nan, torch.nan, -1.0, torch.inf
    fit = pnp_ransac(*near_pairs(3, 301, 0.2)).replace(code=torch.tensor([0, 0, 2], dtype=torch.int32))
    fit = fit.replace(T_1_from_0=se3.exp(0.1 * torch.randn(3, 6, generator=drawn(1))))
    shutter = Shutter(0.05 * torch.randn(3, 3, generator=drawn(2)), torch.zeros(3, 9, 9)) if turning else None
    seen = found.replace(xyz=xyz, sigma=sigma), tracks.replace(uv_1=uv_1), fit.replace(shutter=shutter)
    used = misalignment._near_parallax(*seen, of_both, of_both.replace(f=1.1 * of_both.f)).used
    assert used.any(1).tolist() == [True, True, False]


def depth_profiles():
    """Costs of profiles, of which one has no point, one half of them, and one fit is not positive."""
    q, a, p = uniform(2, 301, low=0.5, high=1.5), uniform(2, 301, seed=1, high=50), uniform(2, 4, 301, seed=2, low=0.5)
    noise = {"variance_rel": uniform(2, 301, seed=3, high=0.01), "noise": uniform(2, 1, seed=4, low=0.1, high=1.1)}
    near = misalignment._Parallax(uniform(2, 301, 2, seed=5), q, q, a, used=q > 0, **noise)
    used = uniform(2, 4, 301, seed=6) < 0.8
    used[0, 0], used[1, 3, 150:], q[1, :150] = False, False, -q[1, :150]
    for scale in (None, uniform(2, 4, seed=7, low=0.5, high=1.5)):
        assert misalignment._profile_cost(near, p, used, scale)[0, 0] == 0


def map_poses():
    arguments, _, _, _ = map_pose_inputs(6, near=80, far=220, turn=0.01)
    map_pose(*(x.to(torch.float32) for x in arguments))


def left_to_torch():
    """Options that a kernel does not have: each reaches the kernels of other steps alone."""
    frame, uv = seen_from_above(), uniform(50, 2, high=50)
    sparse = torch.tensor([True, False])
    for same, options in ((frame.replace(sparse=sparse), {}), (frame, {"min_conf": -1}), (frame, {"search_px": 2})):
        backproject(same, uv, **options)
    backproject(frame.replace(conf=frame.conf.long()), uv)
    min_eigenvalue(frame.image.contiguous(), uv.expand(2, -1, -1), block=15)
    SampleSpec(depth_unit=0.002).metres([torch.arange(6000).view(1, 60, 100).to(torch.int16)])
    fits((41, 53), radius=2)
    near_poses(3, 90, 0.2, kernel="huber")
    problem, at, noise = every_track(True)
    weights = torch.tensor([0.1, 0.7]), torch.tensor([1e4, 10.0])
    for of_tracks, kernel in ((noise, "cauchy"), (noise.double(), "geman_mcclure")):
        normal, cost = reprojection_problem.pose_normal_equations_at(
            problem, of_tracks, *weights, kernel=kernel, bend=2
        )
        normal(at), cost(at)
    here, there, uv = seen_twice()
    narrow, usable = [pyramid.build_pyramid(x, 1, 9) for x in (here, there)], ((uv > 20) & (uv < 80)).all(-1)
    affine_alignment.register_affine(*narrow, uv, uv, wanted=usable, window=11)


# --------------------------------------------------------------------------------------------------- the oracle


def is_single(x):
    return x.dtype == torch.float32


def agree(name, found, expected, relative=None, fraction=None):
    """Assert that results of one operator have the same shapes and dtypes, and values within its tolerance."""
    limits = TOLERANCES.get(name, (0.0, 0.0))
    relative, fraction = (a if b is None else b for a, b in zip(limits, (relative, fraction), strict=True))
    found, expected = leaves(found), leaves(expected)
    assert [(x.shape, x.dtype) for x in found] == [(x.shape, x.dtype) for x in expected], name
    both = found[1] & expected[1] if name in MASKED else torch.ones((), dtype=torch.bool)
    for k, (x, y) in enumerate(zip(found, expected, strict=True)):
        size = torch.where(both & y.isfinite(), y, 0).abs().double()
        limit = relative * (size + size.sum() / (size > 0).sum().clamp_min(1))
        apart = (x != y) & ~(x.isnan() & y.isnan()) & ~((x - y).abs() <= limit) if x.is_floating_point() else x != y
        apart = apart & both if x.is_floating_point() else apart
        assert int(apart.sum()) <= fraction * x.numel(), f"{name}, result {k}: {int(apart.sum())} of {x.numel()} differ"


class Oracle:
    """Stands before every kernel: compares it with its reference."""

    def __init__(self, monkeypatch):
        self.monkeypatch, self.reached, self.total = monkeypatch, {}, 0.0
        self.is_busy, self.left_to_torch = False, None
        for name, fn in OPERATORS.items():
            cell = fn.__closure__[fn.__code__.co_freevars.index("kernel")]
            monkeypatch.setattr(cell, "cell_contents", partial(self.checked, name, fn, cell.cell_contents))

    def checked(self, name, fn, kernel, *args, **options):
        """What the kernel answers, after the comparisons."""
        assert name != self.left_to_torch, f"{name}: its kernel runs on arguments that are torch's"
        if self.is_busy:
            return kernel(*args, **options)
        self.is_busy = True
        self.reached[name] = self.reached.get(name, 0) + 1
        read, theirs = (pytree.tree_map_only(torch.Tensor, torch.clone, args) for _ in range(2))
        with self.monkeypatch.context() as patch:
            patch.setattr(loader, "_loaded", [])
            expected = fn.__wrapped__(*theirs, **options)
        found = kernel(*args, **options)
        if name != "new_cost_volume":  # whose values are those of its memory
            results = (args, theirs) if found is None else (found, expected)
            agree(name, *results)
            if self.reached[name] <= 2:
                self.variants(name, fn, kernel, read, options, results[0])
        self.total += sum(float(x.nan_to_num(0, 0, 0).double().sum()) for x in leaves(args if found is None else found))
        self.is_busy = False
        return found

    def variants(self, name, fn, kernel, args, options, result):
        """The same arguments in another order in memory, one pair alone, none; in double precision and with a graph."""

        def run(change, call=kernel):
            changed = [change(x) if isinstance(x, torch.Tensor) else x for x in args]
            found = call(*changed, **options)
            return changed if found is None else found

        any_layout = [layout for _, layout in inspect.getclosurevars(fn).nonlocals["parameters"]]
        turned = {
            id(x) for x, layout in zip(args, any_layout, strict=False) if layout and x is not None and x.dim() > 1
        }
        agree(name, run(lambda x: x.mT.contiguous().mT if id(x) in turned else x.clone()), result)
        batch = next((len(x) for x in leaves(args)), 0)
        if name not in ONE_ROW and batch > 1:

            def taken(part):
                return lambda x: x[part].clone() if x.shape[:1] == (batch,) else x.clone()

            agree(name, run(taken(slice(1, 2))), pytree.tree_map_only(torch.Tensor, taken(slice(1, 2)), result), 0, 0)
            assert not any(x.numel() for x in leaves(run(taken(slice(0, 0)))) if x.shape[:1] != (batch,)), name
        is_alone = name in (*ONE_ROW, *WRITING) or any(
            callable(x) or isinstance(x, torch.Tensor) for x in pytree.tree_leaves(options)
        )
        if is_alone or not any(map(is_single, leaves(args))):
            return
        self.left_to_torch = name
        with torch.inference_mode(False), torch.enable_grad():
            leaf = run(lambda x: x.clone().requires_grad_() if is_single(x) else x.clone(), fn)
        agree(name, pytree.tree_map_only(torch.Tensor, torch.detach, leaf), result)
        wide = run(lambda x: x.double() if is_single(x) else x.clone(), fn)
        self.left_to_torch = None
        assert all(x.dtype != torch.float32 for x in leaves(wide)), name


def every(fn, *rows, **options):
    """A call of the function with each row of arguments."""
    for row in rows:
        fn(*row, **options)


SAMPLES = "_classify_holes _read_samples _sensor_values _window_texture containing_pixels"
WINDOWS = "_classify_holes _read_samples _window_texture containing_pixels"
FRONT = "_depth_variance _fill_level _near_pose _parallax _search _squared_differences _triangulate"
METHODS = (
    f"{WINDOWS} {FRONT} _equations _mean_cost _minimum _noise _rays _register_level _sandwich _solve _squares census_transform"
    " _project sample_bilinear new_cost_volume _add_costs aggregate_best_plane _second_best smooth_within_tolerance"
    " _fit_windows _pose_variance _add_to_sums _occlusion_mask _gate _filter _filled _merge"
)
BENT = (0.05, -0.01, 0.001, -0.002)

#: Name -> a call, and the operators whose kernels it reaches.
CALLS = {
    "methods": (methods, METHODS),
    "transform": (transform, f"{WINDOWS} {FRONT} _check_returns _write_metres _pool_tokens"),
    **{f"samples, {lens}": (partial(every, samples, (301, lens), (1000, lens), (6000, lens)), SAMPLES) for lens in ("none", "of the map", "bent", "bent map")},
    "samples, loose": (partial(samples, 301, "none", near_limit=1.7, min_conf=2, sigma_m=0.004), SAMPLES),
    "samples, strict": (partial(samples, 301, "of the map", min_conf=0, edge_rel=0.6, dark=0.5, saturated=0.6, highlight=0.4, sigma_rel=0.03), SAMPLES),
    **{f"windows, {layout}": (partial(every, windows_of, (layout, 301, 3), (layout, 301, 9), (layout, 2500, 7)), WINDOWS) for layout in ("interleaved", "planar", "grey", "bgr of rgba")},
    "windows, search": (partial(windows_of, "planar", 301, search_px=1), WINDOWS.replace("_read_samples", "_window_brightness _window_extremes")),
    "pixels": (pixels, "containing_pixels"),
    "pyramids": (pyramids, "_fill_level"),
    "depths": (depths_in_metres, "_check_returns _write_metres"),
    "tokens": (tokens, "_pool_tokens"),
    "surfaces": (surfaces, "_second_best aggregate_best_plane"),
    "costs": (costs, "_add_costs census_transform _project new_cost_volume"),
    "projections": (partial(every, projections, (False, 0), (True, 0), (True, 5), (False, 8)), "census_transform _project smooth_within_tolerance"),
    "components": (connected, "_small"),
    "filters": (partial(every, filtered, ((60, 77),), ((23, 90),), ((2, 9),), ((1, 1),)), "_filter"),
    "gates": (gates, "_gate _merge"),
    **{f"planes, {name}": (partial(every, filled, ((150, 203),), ((97, 240),), **options), "_filled") for name, options in PLANE_OPTIONS.items()},
    "planes, small": (partial(every, filled, ((5, 150),), ((3, 2),), ((0, 4),)), "_filled"),
    "fits": (partial(every, fits, ((41, 53),), ((6, 70), BENT), ((9, 3),)), "census_transform _fit_windows _project _rays"),
    "occlusions": (partial(every, occlusions, (False,), (True,)), "census_transform _occlusion_mask _pose_variance"),
    "search": (partial(searched, "none", 21, 4), "_fill_level _search _squared_differences"),
    "search, bias": (partial(searched, "bias", 15, 3), "_fill_level _search _squared_differences"),
    "search, gain": (partial(searched, "gain_bias", 21, 2), "_fill_level _search _squared_differences"),
    "search, wide": (partial(searched, "none", 33, 1), "_fill_level _search _squared_differences"),
    "registration": (registered, "_fill_level _register_level"),
    "registration, few steps": (partial(registered, window=13, iterations=3), "_fill_level _register_level"),
    "registration, no step": (partial(registered, iterations=0), "_fill_level _register_level"),
    "registration, coarse": (partial(registered, epsilon_px=0.3), "_fill_level _register_level"),
    "magnified": (magnified, "_fill_level _register_level"),
    "near poses": (partial(every, near_poses, (3, 700, 0.3), (20, 100, 0.4), (40, 12, 0.2)), "_near_pose"),
    "near poses, unpolished": (partial(near_poses, 20, 100, 0.4, local_optimisation=0, polish_steps=0), "_near_pose"),
    "near poses, polished": (partial(near_poses, 20, 100, 0.4, polish_steps=3, threshold_px=1.5), "_near_pose"),
    "hopeless poses": (hopeless_poses, "_near_pose"),
    "differentiated": (differentiated, "_robust_pose _solve"),
    "equations": (partial(every, equations, (False,), (True,)), "_equations _minimum _noise _robust_cost _squares"),
    "covariances": (covariances, "_sandwich _solve"),
    "systems": (partial(every, systems, (6, 1), (6, 7), (9, 9), (3, 1)), "_solve"),
    "lenses": (partial(every, lenses, (4,), (5,), (8,)), "_rays _undistort _undistort_jacobian"),
    "straight tracks": (straight_tracks, "_undistort_tracks"),
    "depths of tracks": (depths_of_tracks, "_depth_variance _triangulate"),
    "parallaxes": (partial(every, parallaxes, (False,), (True,)), "_near_pose _parallax"),
    "depth profiles": (depth_profiles, "_mean_cost"),
    "map poses": (map_poses, "_equations _minimum _near_pose _noise _rays _sandwich _solve _squares"),
    "left to torch": (left_to_torch, "census_transform _fill_level _project _solve _window_brightness _window_extremes containing_pixels sample_bilinear"),
}  # fmt: skip

#: Call -> other tolerances: with a free gain single precision itself does not determine one point in twenty.
UNSURE = {"search, gain": {"_search": (1e-4, 0.06)}}

#: A call, and limits that its kernels take from torch's side: each changes what kernel and reference answer alike.
LIMITS = [
    ("surfaces", plane_sweep, "JUMP_COST", 2),
    ("surfaces", plane_sweep, "STEP_COST", 1),
    ("costs", plane_sweep, "UNSEEN_COST", 7),
    ("projections", plane_sweep, "MIN_DEPTH_RATIO", 0.5),
    ("fits", plane_sweep, "WINDOW_GAIN_RANGE", (0.9, 1.1)),
    ("fits", plane_sweep, "FLAT_VARIANCE", 1e-2),
    ("fits", plane_sweep, "FLAT_GRADIENT_VARIANCE", 1.0),
    ("search", lk, "AITKEN_RATIO_RANGE", (0.0, 0.1)),
    ("search, gain", lk, "CONTRAST_RATIO_RANGE", (0.95, 1.05)),
    ("registration", affine_alignment, "AFFINE_DAMPING", 0.1),
    ("registration", affine_alignment, "MAX_EXTRAPOLATION", 0.1),
    ("registration", affine_alignment, "REGISTRATION_GAIN_RANGE", (0.9, 1.1)),
    ("near poses", pose, "MAX_SEARCH_POINTS", 64),
    ("equations", reprojection_problem, "BEHIND_CAMERA_RESIDUAL", 3.0),
    ("depths of tracks", epipolar, "MIN_SQUARED_SLOPE", 1e4),
]


@pytest.fixture
def oracle(loaded, monkeypatch):
    return Oracle(monkeypatch)


@pytest.mark.parametrize("name", CALLS)
def test_kernels_agree_with_their_references(oracle, monkeypatch, name):
    call, operators = CALLS[name]
    monkeypatch.setattr(sys.modules[__name__], "TOLERANCES", TOLERANCES | UNSURE.get(name, {}))
    call()
    assert sorted(oracle.reached) == sorted(operators.split())


def test_every_operator_is_reached():
    assert {name for _, operators in CALLS.values() for name in operators.split()} == set(OPERATORS)


@pytest.mark.parametrize(("name", "owner", "limit", "value"), LIMITS, ids=lambda x: x if isinstance(x, str) else "")
def test_kernels_take_their_limits_from_torch(oracle, monkeypatch, name, owner, limit, value):
    monkeypatch.setattr(sys.modules[__name__], "TOLERANCES", TOLERANCES | UNSURE.get(name, {}))
    CALLS[name][0]()
    before, oracle.total = oracle.total, 0.0
    monkeypatch.setattr(owner, limit, value)
    if name == "surfaces":
        steps = {"step": plane_sweep.STEP_COST, "jump": plane_sweep.JUMP_COST}
        monkeypatch.setattr(plane_sweep.aggregate_costs, "__kwdefaults__", steps)
    CALLS[name][0]()
    assert oracle.total != before


def test_public_entries_give_the_bits_of_contiguous_copies(loaded):
    contiguous = public_results()
    for layout in VIEWS:
        assert differing_entries(public_results(layout), contiguous) == [], layout


@pytest.mark.parametrize("tracker", [lucas_kanade, lucas_kanade_affine])
def test_a_track_is_the_same_in_any_batch(loaded, tracker):
    here, there, uv = seen_twice()
    together = tracker(here, there, uv)
    for k in range(len(uv)):
        alone = tracker(here[k : k + 1], there[k : k + 1], uv[k : k + 1].flip(1))
        equal(alone.map(lambda x: x.flip(1)), together[k : k + 1])


def without_kernels(call, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(loader, "_loaded", [])
        return call()


@pytest.mark.parametrize("name", ["PAPER", "MAP", "AUTO", "complete_depth"])
def test_answers_agree_to_far_less_than_their_sigma(loaded, monkeypatch, name):
    room = SyntheticRoom(n_frames=9, hw=(96, 128), depth_hw=(48, 64))
    frame, *others = (range_split(room[k], 2.0) for k in (1, 6, 8))

    def answers():
        if name == "complete_depth":
            return dhtorch.complete_depth(frame, others, method=FUSED.replace(n=256), size=96)
        method = getattr(dhtorch, name).replace(n=512)
        return method(frame, others if method.views > 1 else others[0])

    found, expected = answers(), without_kernels(answers, monkeypatch)
    assert (found.gate != expected.gate).float().mean() <= 0.01
    both = (found.gate == 0) & (expected.gate == 0) & (expected.sigma > 0)
    assert both.float().mean() > 0.1
    assert ((found.depth - expected.depth)[both].abs() / expected.sigma[both]).quantile(0.99) <= 0.1
    torch.testing.assert_close(found.sigma[both].median(), expected.sigma[both].median(), rtol=1e-3, atol=0.0)
