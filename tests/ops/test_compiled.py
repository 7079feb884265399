"""Compiled code answers as torch does, the sweep bit for bit, a search for points and the registration of their windows
up to the rounding of sums; nothing is compiled, loaded or used that nobody asked for."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from support.pose_problems import NOISE, map_pose_inputs, pose_depth_problem
from support.public_entries import VIEWS, differing_entries, public_results
from support.tiny_runs import ROOM
from torch.autograd import forward_ad
from torch.utils._pytree import tree_leaves

from dhtorch import WINDOW, codes
from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.geometry import (
    affine_alignment,
    components,
    epipolar,
    least_squares,
    map_estimate,
    patches,
    plane_sweep,
    pyramid,
    reprojection_problem,
    se3,
)
from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry import (
    windows as neighbours,
)
from dhtorch.geometry.camera import Camera, from_matrix, project, rays, undistort, undistort_jacobian, unproject
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.geometry.map_estimate import estimate_noise_variance
from dhtorch.geometry.reprojection_problem import PoseDepthProblem
from dhtorch.metrics.holdout import range_split
from dhtorch.ops import builder, constants, dispatch, loader
from dhtorch.pipeline import dense, map_filters, planes, surface
from dhtorch.pipeline.dense_options import DEFAULT_DENSE_OPTIONS, DenseOptions
from dhtorch.pipeline.pair import merge, undistort_tracks
from dhtorch.pipeline.presets import AUTO
from dhtorch.records import NO_HINT, DepthMap, Frame, MergedDepth, PoseFit, Samples, Shutter, TrackHint, Tracks
from dhtorch.stages import misalignment, pose
from dhtorch.stages.backproject import backproject
from dhtorch.stages.holes import classify, min_eigenvalue
from dhtorch.stages.pose import map_pose, pnp_ransac
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.synthetic import SyntheticRoom
from dhtorch.transforms import patch_tokens
from dhtorch.transforms.sample_access import SampleError
from dhtorch.transforms.sample_spec import SAMPLE_UNITS_PER_METRE, SampleSpec

COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
needs_compiler = pytest.mark.skipif(COMPILER is None or sys.platform == "win32", reason="no C++ compiler here")


@pytest.fixture(autouse=True)
def unused(monkeypatch, tmp_path):
    """Every test begins and ends without compiled code, and with none installed."""
    monkeypatch.setenv("DHTORCH_OPS", "0")
    monkeypatch.setattr(loader, "_loaded", [])
    monkeypatch.setattr(loader, "_tried", [])
    monkeypatch.setattr(loader, "INSTALLED", tmp_path / "installed")


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """A folder with the compiled file; one of a process, in which operations are registered once. The library of the
    user's cache, named after the sources, is linked where it is sound, so that other tests of the process may load it
    too, and compiled otherwise."""
    folder = tmp_path_factory.mktemp("cache")
    built = loader.library().resolve()
    if built.is_file() and loader.problem(built) is None:
        for path in (built, loader.manifest(built)):
            (folder / path.name).symlink_to(path)
        return folder
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DHTORCH_CACHE", str(folder))
        builder.build()
    return folder


@pytest.fixture
def loaded(cache, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    loader.load()


def volume(*shape, most, seed=0):
    return torch.randint(0, most, shape, generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)


def both_ways(call, monkeypatch):
    """What compiled code answers, and torch."""
    assert loader._loaded
    found = call()
    with monkeypatch.context() as patch:
        patch.setattr(loader, "_loaded", [])
        return found, call()


@needs_compiler
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("kind", [torch.uint8, torch.float32])
@pytest.mark.parametrize(("hw", "gradients"), [((61, 83), True), ((72, 96), False)])
def test_pyramids_agree_up_to_one_rounding(loaded, monkeypatch, channels, kind, hw, gradients):
    image = volume(2, channels, *hw, most=256)
    image = image if kind == torch.uint8 else image.float() / 255
    ours, torchs = both_ways(lambda: pyramid.build_pyramid(image, 3, 11, gradients=gradients), monkeypatch)
    assert len(ours.levels) == len(torchs.levels) == 3 and ours.pad == torchs.pad
    for a, b in zip(ours.levels, torchs.levels, strict=True):
        assert a.shape == b.shape and (a - b).abs().max() <= 2.0**-23
    assert not torch.equal(ours.levels[0][0], ours.levels[0][1])


@needs_compiler
def test_public_entries_give_the_bits_of_contiguous_copies(loaded):
    contiguous = public_results()
    for layout in VIEWS:
        assert differing_entries(public_results(layout), contiguous) == [], layout


@needs_compiler
@pytest.mark.parametrize("layout", ["interleaved", "planar", "grey", "bgr of rgba"])
@pytest.mark.parametrize(("block", "n"), [(3, 301), (7, 301), (9, 301), (7, 2500)])
def test_numbers_about_windows_agree_textures_up_to_rounding(loaded, monkeypatch, layout, block, n):
    """Of 2,173 pixels: where most are asked windows of all are found first."""
    image = volume(2, 1 if layout == "grey" else 3, 41, 53, most=256)
    if layout == "interleaved":
        image = image.contiguous(memory_format=torch.channels_last)
    if layout == "bgr of rgba":
        image = volume(2, 41, 53, 4, most=256).permute(0, 3, 1, 2)[:, [2, 1, 0]]
    depth = 4 * torch.rand(2, 41, 53, generator=torch.Generator().manual_seed(1)) - 1
    depth[:, ::7, ::5], depth[0, 3], depth[1, :, 9] = torch.nan, torch.inf, -torch.inf
    uv = torch.rand(2, n, 2, generator=torch.Generator().manual_seed(2)) * 70 - 8  # the border and beyond
    uv[0, 0] = torch.nan
    camera = Camera(f=torch.full((2, 2), 50.0), c=torch.full((2, 2), 20.0))
    frame = Frame(image=image, depth=depth, camera=camera, conf=None)
    at_once, alone = ["project_samples", "backproject"], ["window_extremes", "window_brightness"] if n == 301 else []
    for options, reads in ({}, at_once), ({"search_px": 1}, alone):  # a search for returns is torch's
        calls = counted(monkeypatch, *at_once, *alone, "window_texture", "classify_holes")
        ours, torchs = both_ways(
            lambda options=options: classify(frame, backproject(frame, uv, **options), block=block), monkeypatch
        )
        assert calls == [*reads, "window_texture", "classify_holes"]
        for name in ("depth", "confidence", "flag", "trackability", "hole"):
            a, b = getattr(ours, name), getattr(torchs, name)
            rounds = name == "trackability" and (a - b).abs().max() < 1e-7
            assert torch.equal(a.nan_to_num(7), b.nan_to_num(7)) or rounds, name
        assert ours.flag.unique().numel() > (3 if reads is at_once else 2) and ours.trackability.unique().numel() > 100


def counted(monkeypatch, *names):
    """Operations by name, which note in the list that they were called."""
    calls = []
    for name in names:
        was = getattr(torch.ops.dhtorch, name).default
        room_scene = SimpleNamespace(default=lambda *a, was=was, name=name, **k: (calls.append(name), was(*a, **k)))
        monkeypatch.setattr(torch.ops.dhtorch, name, room_scene)
    return calls


def a_view(*, hw=(61, 83), map_hw=(48, 64), seed=0):
    """Two views with levels of confidence, returns of every kind, bright and dark places, and cameras of their own."""
    image = (volume(2, 3, *hw, most=256, seed=seed) // 4 + 120).contiguous(memory_format=torch.channels_last)
    image[0, :, :20], image[1, :, :, :30], image[:, :, 40, 40:50] = 255, 5, 255
    depth = 4 * torch.rand(2, *map_hw, generator=torch.Generator().manual_seed(seed)) - 0.4
    depth[:, ::7, ::5], depth[0, 3], depth[1, :, 9] = torch.nan, torch.inf, -torch.inf
    K = torch.tensor([[[70.0, 0, 40], [0, 71, 30], [0, 0, 1]], [[64, 0, 41.5], [0, 66, 29], [0, 0, 1]]])
    return Frame(image=image, depth=depth, camera=from_matrix(K), conf=volume(2, *map_hw, most=3, seed=seed + 1))


@needs_compiler
def test_pixels_are_the_same(loaded, monkeypatch):
    uv = torch.rand(2, 50, 2, generator=torch.Generator().manual_seed(3)) * 40 - 5
    uv[0, :8, 0] = torch.tensor([torch.nan, torch.inf, -torch.inf, 3e9, -3e9, 0.5, -0.5, 1.5])
    calls = counted(monkeypatch, "containing_pixels")
    ours, torchs = both_ways(lambda: patches.containing_pixels(uv), monkeypatch)
    assert calls == ["containing_pixels"] and ours.dtype == torchs.dtype and torch.equal(ours, torchs)
    assert patches.containing_pixels(uv.double()).dtype == torch.int32 and len(calls) == 1


@needs_compiler
@pytest.mark.parametrize("n", [301, 1000, 6000], ids=["a few", "most of the map", "most of the picture"])
@pytest.mark.parametrize("lens", ["none", "of the map", "bent", "bent map"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"near_limit": 1.7, "min_conf": 2, "sigma_m": 0.004},
        {"min_conf": 0, "edge_rel": 0.6, "dark": 0.5, "saturated": 0.6, "highlight": 0.4, "sigma_rel": 0.03},
    ],
)
def test_samples_and_holes_are_the_same_bits(loaded, monkeypatch, lens, options, n):
    frame = a_view(map_hw=(61, 83) if lens == "bent" else (48, 64))
    own = Camera(f=frame.camera.f * 0.7, c=frame.camera.c * 0.8)
    bent = torch.tensor([[0.2, -0.1, 0.001, 0.002, 0.0]]).expand(2, 5)
    if lens == "bent":
        frame = frame.replace(camera=frame.camera.replace(distortion=bent), conf=None)
    if lens in ("of the map", "bent map"):
        frame = frame.replace(depth_camera=own.replace(distortion=bent if lens == "bent map" else None))
    uv = torch.rand(n, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([99.0, 75.0]) - 7
    uv[:5] = torch.tensor([torch.nan, torch.inf, -torch.inf, 3e9, -3e9])[:, None]
    calls = counted(monkeypatch, "project_samples", "backproject", "classify_holes")
    ours, torchs = both_ways(lambda: classify(frame, backproject(frame, uv, **options)), monkeypatch)
    assert calls == [*(["project_samples"] if "bent" not in lens else []), "backproject", "classify_holes"]
    assert (ours.sigma - torchs.sigma).abs().le(2.0**-23 * torchs.sigma).all(), "but for the rounding of a root"
    for name in ("uv", "depth", "xyz", "confidence", "flag", "hole"):
        a, b = getattr(ours, name), getattr(torchs, name)
        assert a.dtype == b.dtype and torch.equal(a.nan_to_num(7), b.nan_to_num(7)), name
        assert torch.equal(a.isnan(), b.isnan()), name
    assert ours.flag.unique().numel() > 8 and ours.hole.unique().numel() > 4 and ours.usable.any()


@needs_compiler
def test_samples_that_compiled_code_does_not_take_are_torchs(loaded, monkeypatch):
    calls = counted(monkeypatch, "backproject")
    frame, uv = a_view(), torch.rand(50, 2, generator=torch.Generator().manual_seed(2)) * 50
    backproject(frame, uv)
    assert calls.pop() == "backproject"
    backproject(frame, uv, search_px=2)
    backproject(frame.replace(sparse=torch.tensor([True, False])), uv)
    backproject(frame, uv, min_conf=-1)
    backproject(frame.replace(conf=frame.conf.long()), uv)
    backproject(frame.replace(depth=frame.depth.half()), uv)
    backproject(frame.replace(image=frame.image.float() / 255), uv)
    backproject(frame, uv.double())
    backproject(frame.map(lambda x: x.double() if x.dtype == torch.float32 else x), uv.double())
    leaf = frame.depth.nan_to_num(1, 1, 1).requires_grad_()
    found = backproject(frame.replace(depth=leaf), uv)
    (slope,) = torch.autograd.grad(found.xyz.nan_to_num().sum(), [leaf])
    assert slope.abs().sum() > 0
    focal = frame.camera.f.clone().requires_grad_()
    found = backproject(frame.replace(camera=frame.camera.replace(f=focal)), uv)
    assert torch.autograd.grad(found.xyz.nan_to_num().sum(), [focal])[0].abs().sum() > 0
    assert backproject(frame, uv.clone().requires_grad_()).xyz.requires_grad
    assert not calls


@needs_compiler
def test_windows_that_compiled_code_cannot_read_are_torchs(loaded, monkeypatch):
    for name in ("extremes", "brightness", "texture"):
        monkeypatch.setattr(torch.ops.dhtorch, f"window_{name}", None)
    image, uv = torch.rand(1, 3, 31, 32), torch.rand(1, 9, 2) * 30
    assert min_eigenvalue(image, uv).shape == (1, 9), "numbers that are no bytes"
    assert min_eigenvalue((255 * image).byte(), uv, block=15).shape == (1, 9), "a window of 17 pixels"
    (slope,) = torch.autograd.grad(min_eigenvalue(image.requires_grad_(), uv).sum(), [image])
    assert slope.abs().sum() > 0


@needs_compiler
def test_pyramids_that_compiled_code_cannot_build_are_torchs(loaded, monkeypatch):
    calls = counted(monkeypatch, "pyramid_level")
    image = torch.rand(1, 3, 48, 64)
    pyramid.build_pyramid(image.double(), 2, 11)
    pyramid.build_pyramid(image.transpose(-1, -2), 1, 11)
    (slope,) = torch.autograd.grad(
        pyramid.build_pyramid(image.requires_grad_(), 2, 11).levels[1].square().sum(), [image]
    )
    assert not calls and slope.abs().sum() > 0
    pyramid.build_pyramid(image.detach(), 2, 11)
    assert len(calls) == 2


@needs_compiler
@pytest.mark.parametrize("kind", [torch.uint16, torch.int16])
@pytest.mark.parametrize(("unit", "bounds"), [("mm", (0.0, torch.inf)), ("m", (0.0, torch.inf)), ("mm", (0.4, 9.0))])
def test_whole_depths_in_metres_are_the_same_bits(loaded, monkeypatch, kind, unit, bounds):
    every = torch.arange(-(1 << 15), 1 << 15, dtype=torch.int32).to(torch.int16).view(kind).view(2, 128, 256)
    calls = counted(monkeypatch, "write_metres")
    views = SampleSpec(depth_unit="mm", depth_range=bounds)
    if unit == "m":  # another divisor than the one that is written for
        monkeypatch.setitem(SAMPLE_UNITS_PER_METRE, "mm", 5000.0)
    ours, torchs = both_ways(lambda: views.metres(list(every)), monkeypatch)
    assert len(calls) == 2 and ours.dtype == torchs.dtype == torch.float32
    assert torch.equal(ours, torchs) and ours.unique().numel() > 8000 and ours.amin() == 0


@needs_compiler
def test_depths_that_compiled_code_does_not_take_are_torchs(loaded, monkeypatch):
    calls = counted(monkeypatch, "write_metres", "count_returns")
    whole = torch.arange(6000).view(1, 60, 100)
    for x in (whole.int(), whole.float(), whole.double(), whole.to(torch.uint8)):
        assert (SampleSpec(depth_unit="mm").metres([x])[0] - x / 1000.0).abs().max() < 1e-6
    assert SampleSpec(depth_unit=0.002).metres([whole.to(torch.int16)])[0, 0, 59, 99] == 5999 * 0.002
    with pytest.raises(SampleError, match="is the unit mm"):
        SampleSpec(depth_unit="m").metres([whole.to(torch.int16)])
    SampleSpec(depth_unit="m")._check_depth(whole.double())
    assert not calls


@needs_compiler
def test_the_unit_found_from_depths_is_that_of_torch(loaded, monkeypatch):
    views, random = SampleSpec(depth_unit="m"), torch.Generator().manual_seed(5)
    depth = 3 * torch.rand(6, 60, 80, generator=random)
    depth[0, ::2], depth[1], depth[2], depth[3, :40] = 0, 0, 0, 300.0
    depth[2, 31, 17], depth[4] = 1.5, 0.004
    depth[5, :, ::3] = torch.nan
    calls = counted(monkeypatch, "count_returns")
    for some in ([0, 5], [0, 1], [2], [3], [4], [5], [0, 3, 4]):
        ours, torchs = both_ways(lambda some=some: views._check_depth(depth[some]), monkeypatch)
        assert torch.equal(ours[0], torchs[0]) and ours[0].dtype == torchs[0].dtype
        assert ours[0].tolist() == [k != 1 for k in some]
        bad = [
            torch.stack([b for b, _, _ in said]).any(0).tolist() if said else [False] * len(some)
            for _, said in (ours, torchs)
        ]
        assert bad[0] == bad[1] == [k in (3, 4) for k in some]
    assert len(calls) == 7


@needs_compiler
def test_the_sensors_own_map_is_the_same_bits(loaded, monkeypatch):
    frame = a_view()
    uv = torch.rand(301, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([99.0, 75.0]) - 7
    samples = classify(frame, backproject(frame, uv, near_limit=2.5, min_conf=1))
    samples = samples.replace(xyz=torch.where(samples.depth[..., None] < 0.5, torch.inf, samples.xyz))
    calls = counted(monkeypatch, "sensor_values")
    ours, torchs = both_ways(lambda: merge(samples, None), monkeypatch)
    assert calls == ["sensor_values"] and 0 < (ours.source == Source.SENSOR).sum() < ours.source.numel()
    for name in ("uv", "depth", "sigma", "score", "source"):
        a, b = getattr(ours, name), getattr(torchs, name)
        assert a.dtype == b.dtype and torch.equal(a.nan_to_num(7), b.nan_to_num(7)), name
    leaf = samples.depth.clone().requires_grad_()
    assert merge(samples.replace(depth=leaf), None).depth.requires_grad
    assert merge(samples.map(lambda x: x.double() if x.is_floating_point() else x), None).depth.dtype == torch.float64
    assert calls == ["sensor_values"]


def sparse(batch, n, seed=0):
    """Samples, some outside of a picture of 60x80 and some that are no numbers, and their holes."""
    random = torch.Generator().manual_seed(seed)
    uv, depth, sigma = (torch.rand(batch, n, *k, generator=random) for k in ((2,), (), ()))
    uv = uv * torch.tensor([90.0, 70.0]) - 5
    uv[:, ::7, 1], depth[:, ::5], sigma[:, ::11], depth[:, ::13] = torch.nan, 0, torch.nan, torch.inf
    source, hole = (torch.randint(0, k, (batch, n), generator=random, dtype=torch.int32) for k in (3, 8))
    return MergedDepth(uv, depth, sigma, torch.ones_like(depth), source), hole - 1  # -1: of no class


@needs_compiler
@pytest.mark.parametrize("fit", ["stretch", "pad", "crop"])
@pytest.mark.parametrize(("batch", "n", "size"), [(1, 5000, None), (3, 400, (42, 70)), (2, 0, (28, 28))])
def test_tokens_are_the_same_bits(loaded, monkeypatch, fit, batch, n, size):
    found, hole = sparse(batch, n)
    asked = {"patch": 7, "tokens_hw": size, "fit": fit}
    ours, torchs = both_ways(lambda: patch_tokens(found, hole, (60, 80), **asked), monkeypatch)
    assert all(torch.equal(a, b) and a.dtype == b.dtype for a, b in zip(ours, torchs, strict=True))
    assert n == 0 or (ours[0] > 0).any(1).all()


@needs_compiler
def test_tokens_that_compiled_code_cannot_pool_are_torchs(loaded, monkeypatch):
    found, hole = sparse(1, 50)
    calls = counted(monkeypatch, "patch_tokens")
    patch_tokens(found.to(torch.float64), hole, (60, 80))
    patch_tokens(found, hole.long(), (60, 80))
    patch_tokens(found.replace(uv=found.uv.nan_to_num().int()), hole, (60, 80))
    patch_tokens(found.map(lambda x: x.requires_grad_() if x.is_floating_point() else x), hole, (60, 80))
    assert not calls
    patch_tokens(found.detach(), hole, (60, 80))
    assert calls


@needs_compiler
@pytest.mark.parametrize(
    ("shape", "views", "most"),
    [
        ((2, 7, 5, 48), (1, 3), 31),
        ((1, 1, 9, 3), (8,), 249),
        ((1, 6, 1, 4), (2,), 2),
        ((3, 5, 4, 130), (1, 2, 8), 255),
        ((4, 6, 7, 96), (1, 2, 3, 5), 31),
        ((1, 3, 3, 600), (1,), 20),
    ],
)
def test_surfaces_and_rivals_are_equal(loaded, monkeypatch, shape, views, most):
    """In numbers as small as costs allow: bytes where four paths fit into one, or two, or one, and larger ones."""
    C, views = volume(*shape, most=most), torch.tensor(views)
    (found, some), (expected, few) = both_ways(lambda: plane_sweep.aggregate_best_plane(C, views), monkeypatch)
    for a, b in zip((*found, some), (*expected, few), strict=True):
        assert torch.equal(a, b) and a.dtype == b.dtype
    for reach in (0.0, 2.0, 1e4):
        far = torch.full((len(C),), reach)
        a, b = both_ways(lambda far=far: plane_sweep.second_best_margin(some, found, far), monkeypatch)
        assert torch.equal(a, b)


@needs_compiler
def test_costs_are_equal_also_where_a_place_lies_behind_the_other_view(loaded, monkeypatch):
    """One pair sideways and turned, one straight ahead through what it sees; a view that only one of them wants."""
    pictures = gaussian_blur(torch.rand(2, 2, 30, 41, generator=torch.Generator().manual_seed(0)), 1.0)
    camera = Camera(torch.tensor([[40.0, 41.0], [35.0, 35.0]]), torch.tensor([[19.5, 14.0], [21.0, 15.5]]))
    motion = torch.tensor([[0.02, -0.1, 0.2, -0.3, 0.1, 0.05], [0.0, 0.0, 0.0, 0.1, 0.0, -1.4]])
    base = plane_sweep.make_reference_view(pictures[:, :1], camera)
    view = plane_sweep.SweptView(pictures[:, 1:], camera, se3.exp(motion))
    q = torch.linspace(0, 1, 37).square() * torch.tensor([[1.0], [0.9]])

    def costs():
        C = torch.zeros(2, *base.hw, 37, dtype=torch.uint8).movedim(-1, 1)
        for wanted in ([True, False], [True, True]):
            plane_sweep.add_census_costs(C, base, view, q, torch.tensor(wanted))
        return C

    assert bool((plane_sweep.epipolar_warp(base, view).c * q < -1).any()), "behind the other view"
    found, expected = both_ways(costs, monkeypatch)
    assert torch.equal(found, expected) and len(found.unique()) > 20


@needs_compiler
@pytest.mark.parametrize(("turning", "coefficients"), [(False, 0), (True, 0), (True, 5), (False, 8)])
def test_places_codes_and_smooth_maps_are_equal(loaded, monkeypatch, turning, coefficients):
    g = torch.Generator().manual_seed(1)
    picture = torch.rand(2, 1, 6, 21, generator=g).mul(9).round() / 9  # equal neighbours are not darker
    assert torch.equal(*both_ways(lambda: plane_sweep.census_transform(picture), monkeypatch))
    ray = torch.rand(2, 500, 3, generator=g) - 0.5
    lens = 0.2 * torch.rand(2, coefficients, generator=g) if coefficients else None
    camera = Camera(torch.tensor([[40.0, 41.0], [35.0, 35.0]]), torch.tensor([[19.5, 14.0], [21.0, 15.5]]), lens)
    motion = se3.exp(0.5 * torch.randn(2, 6, generator=g))
    view = plane_sweep.SweptView(
        torch.zeros(2, 1, 4, 4), camera, motion, 0.1 * torch.randn(2, 3, generator=g) if turning else None
    )
    found, expected = both_ways(
        lambda: plane_sweep.project_inverse_depth(view, ray, torch.rand(2, 500, generator=g.manual_seed(2))),
        monkeypatch,
    )
    assert torch.equal(found[0], expected[0]) and torch.equal(found[1], expected[1]) and not bool(found[1].all())
    for shape in ((2, 30, 17), (2, 3, 5), (2, 1, 1)):
        q = torch.rand(*shape, generator=g)
        smooth = both_ways(lambda q=q: neighbours.smooth_within_tolerance(q, torch.tensor([0.2, 0.5])), monkeypatch)
        assert torch.equal(*smooth)


@needs_compiler
@pytest.mark.parametrize("share", [0.4, 0.59, 0.7])
def test_components_are_equal(loaded, monkeypatch, share):
    g = torch.Generator().manual_seed(0)
    mask = torch.rand(2, 40, 53, generator=g) < share
    cuts = torch.rand(2, 40, 52, generator=g) < 0.9, torch.rand(2, 39, 53, generator=g) < 0.9
    calls = counted(monkeypatch, "small_components")
    for n, same in ((2, None), (7, cuts), (30, cuts)):
        found, expected = both_ways(lambda n=n, same=same: components.small_components(mask, n, same=same), monkeypatch)
        assert torch.equal(found, expected) and (n != 7 or 0 < int(expected.sum()) < int(mask.sum()))
    assert len(calls) == 3


def a_map_with_artefacts(hw, g):
    """Boxes before a slanted wall: swept depths with halos, specks and holes, returns on some boxes, and a picture."""
    h, w = hw
    rows, columns = torch.arange(h)[:, None], torch.arange(w)
    q, sensed = (0.2 + 0.001 * columns + 0.0005 * rows).expand(3, h, w).clone(), torch.zeros(3, h, w).bool()
    seen = q.clone()  # what the picture shows
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
    speck = torch.rand(3, h, w, generator=g) < 0.01
    depth = 1 / torch.where(speck, 2 * q, q)
    keep = torch.rand(3, h, w, generator=g) < torch.tensor([0.97, 0.9, 0.7])[:, None, None]
    usable = sensed & (torch.rand(3, h, w, generator=g) < 0.98)
    score = keep * torch.rand(3, h, w, generator=g)
    gate = torch.where(keep, Gate.ANSWER, Gate.NO_TRACK).int()
    columns = torch.where(keep, depth, torch.nan), torch.where(keep, 0.01 * depth, torch.nan), score
    swept = DepthMap(*columns, keep.int() * Source.SWEPT, gate)
    near = torch.where(usable, torch.tensor([1.02, 1.02, 1.08])[:, None, None] / seen, 0.0)
    returns = map_filters.SensorReturns(near, 0.01 * near, usable.float(), usable)
    grey = torch.where(torch.tensor([False, False, True])[:, None, None], 0.5, seen)
    return swept, returns, grey + 0.01 * torch.rand(3, h, w, generator=g)


@needs_compiler
@pytest.mark.parametrize("hw", [(60, 77), (23, 90), (2, 9), (1, 1)])
def test_filtered_maps_are_equal(loaded, monkeypatch, hw):
    """Sigma of filled pixels up to one rounding, since torch's root is not always the nearest number; score likewise."""
    swept, returns, grey = a_map_with_artefacts(hw, torch.Generator().manual_seed(2))
    options = replace(DenseOptions(), speck_px=9)
    sparse = torch.tensor([False, False, True])
    calls = counted(monkeypatch, "filter_map")
    found, expected = both_ways(lambda: map_filters.filter_map(swept, returns, grey, sparse, options), monkeypatch)
    assert len(calls) == 1
    for name in ("depth", "source", "gate"):
        assert torch.equal(getattr(found, name).nan_to_num(-1), getattr(expected, name).nan_to_num(-1)), name
    for name in ("sigma", "score"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=2.5e-7, atol=0, equal_nan=True, msg=name
        )
    for k in range(3):  # as if alone
        alone = map_filters.filter_map(swept[[k]], returns_of(returns, k), grey[[k]], sparse[[k]], options)
        assert torch.equal(alone.depth.nan_to_num(-1), found.depth[[k]].nan_to_num(-1))
    if hw != (60, 77):
        return
    known = map_filters._known(swept, returns)
    within = returns.usable & ~sparse[:, None, None]
    for some in (
        map_filters._halo(known, within, options),
        map_filters._fattened(known, grey, options),
        map_filters._torn(known, grey, options),
        map_filters._unsupported(known, options),
        map_filters._fill(known, within, options)[0],
    ):
        assert int(some.sum()) > 9
    assert int((found.gate != swept.gate).sum()) > 100 and int((found.source == Source.FILLED).sum()) > 50


@needs_compiler
def test_gated_and_merged_maps_agree_up_to_a_root(loaded, monkeypatch):
    """Four views: one refuted by its returns, one with a gate of its own, one with too few returns to be refuted."""
    g = torch.Generator().manual_seed(5)

    def uniform(low=0.0, high=1.0):
        return low + (high - low) * torch.rand(4, 31, 23, generator=g)

    q = uniform(-0.01, 0.5)
    scale = torch.tensor([1e-5, 1e-3, 1e-3, 1e-3])[:, None, None]
    own, shared = (scale * uniform() * q.square() for _ in range(2))
    flags = [uniform() < share for share in (0.9, 0.95, 0.05, 0.9)]
    pair_gate = torch.tensor([0, Gate.NO_POSE, 0, 0], dtype=torch.int32)
    usable = (uniform() < 0.3) & (torch.arange(31 * 23).view(31, 23) < torch.tensor([999, 999, 999, 9])[:, None, None])
    off = torch.tensor([1.06, 1.0, 1.6, 1.6])[:, None, None]  # the first within the ratio, beyond the sigmas
    near = torch.where(usable, off * uniform(0.99, 1.01) / q.clamp_min(1e-3), 0.0)
    options = replace(DenseOptions(), min_overlap_pixels=20, max_sigma_rel=0.04, min_correlation=0.1)
    surfaces = q, own, shared, uniform(), *flags, pair_gate, torch.tensor([0.01, 0.02, 0.0, 0.03])
    calls = counted(monkeypatch, "gate_map"), counted(monkeypatch, "merge_maps")
    found, expected = both_ways(lambda: dense._gate(*surfaces, near, 0.01 * near, usable, options=options), monkeypatch)
    roots = (1, 2)  # sigma and score
    for k, (a, b) in enumerate(zip(found, expected, strict=True)):
        torch.testing.assert_close(a, b, rtol=2.5e-7 if k in roots else 0, atol=0, equal_nan=True)
    codes = [set(x.unique().tolist()) for x in found[4]]
    kept, silent = {Gate.ANSWER, Gate.UNCERTAIN, Gate.NO_TRACK}, {Gate.NO_TRACK, Gate.UNCERTAIN}
    assert codes == [kept, {Gate.NO_POSE}, silent | {Gate.CONTRADICTED}, kept]
    swept = DepthMap(*found[:5])
    returns = map_filters.SensorReturns(near, 0.01 * near, uniform(), usable)
    merged = both_ways(lambda: dense.merge_returns(swept, returns), monkeypatch)
    for name in ("depth", "sigma", "score", "source", "gate"):
        a, b = (getattr(x, name) for x in merged)
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)
    assert [len(x) for x in calls] == [1, 1]


def returns_of(returns, k):
    return map_filters.SensorReturns(*(x[[k]] for x in returns))


def weakly_textured(hw, seed=0, B=3):
    """Arguments of fill_planes: views of two slanted surfaces of several grey values, answered in part or, on the right,
    as a whole, with noise, outliers, holes, and returns on the left; the second sensor reaches far, the last view has
    no sweep."""
    g = torch.Generator().manual_seed(seed)
    v, u = torch.meshgrid(*(torch.arange(n).float() for n in hw), indexing="ij")
    slope = torch.tensor([1.0, -0.7, 0.4])[:B, None, None] * 4e-4
    q = 0.35 + slope * (u - hw[1] / 2) - 3e-4 * (v - hw[0] / 2)
    q = torch.where(u + 0.3 * v < 0.7 * hw[1], q, 0.75 * q)
    depth = (1 + 0.02 * torch.randn(B, *hw, generator=g)) / q
    depth = torch.where(torch.rand(B, *hw, generator=g) < 0.04, 1.5 * depth, depth)
    depth[:, ::17, ::5], depth[:, ::13, ::7] = torch.inf, -1.0
    patches = torch.rand(B, -(-hw[0] // 24), -(-hw[1] // 32), generator=g)
    grey = 0.4 + 0.09 * patches.repeat_interleave(24, 1).repeat_interleave(32, 2)[:, : hw[0], : hw[1]]
    whole = u > 0.72 * hw[1]
    answered = whole | (torch.rand(B, *hw, generator=g) < 0.6)
    hole = (u - 0.6 * hw[1]).abs() < 0.1 * hw[1]
    hole = hole | ((v - 0.3 * hw[0]).abs() < 0.12 * hw[0]) & (u > 0.2 * hw[1])
    support = answered & ~hole
    swept = support & (whole | (torch.rand(B, *hw, generator=g) < 0.7))
    if B > 2:
        swept[2] = support[2] = False
    sigma = 0.02 * depth * (0.5 + torch.rand(B, *hw, generator=g))

    def filtered(keep):
        nan = torch.full_like(depth, torch.nan)
        code = torch.where(keep, Source.SWEPT, Source.NONE).int()
        gate = torch.where(keep, codes.Gate.ANSWER, codes.Gate.NO_TRACK).int()
        return DepthMap(torch.where(keep, depth, nan), torch.where(keep, sigma, nan), 0.8 * keep, code, gate)

    usable = (u < 0.3 * hw[1]) & (torch.rand(B, *hw, generator=g) < 0.5)
    returns = map_filters.SensorReturns(1.01 / q, 0.01 / q, torch.ones_like(q), usable)
    reach = torch.tensor([0.5, 3.2, 3.0])[:B]
    return filtered(swept), filtered(support), returns, grey[:, None], reach


PLANE_OPTIONS = {
    "as they are": {},
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


@needs_compiler
@pytest.mark.parametrize("options", PLANE_OPTIONS.values(), ids=PLANE_OPTIONS)
@pytest.mark.parametrize("hw", [(150, 203), (97, 240)])
def test_filled_planes_agree_up_to_rounding(loaded, monkeypatch, hw, options):
    views, calls = weakly_textured(hw), counted(monkeypatch, "fill_planes")
    options = replace(DEFAULT_DENSE_OPTIONS, **options)
    sparse = torch.tensor([False, False, True])
    for given in (None, sparse, ~sparse):
        ours, torchs = both_ways(
            lambda given=given: planes.fill_planes(*views, sparse=given, options=options), monkeypatch
        )
        filled, expected = ours.source == Source.FILLED, torchs.source == Source.FILLED
        both = filled & expected
        assert expected[:2].flatten(1).sum(1).min() > 100 and not expected[2].any()
        assert (filled != expected).sum() <= expected.sum() / 200
        for name, limit in (("depth", 1e-3 * torchs.sigma), ("sigma", 1e-3 * torchs.sigma), ("score", 1e-3)):
            difference = (getattr(ours, name) - getattr(torchs, name)).abs()
            assert (difference <= limit)[both].float().mean() >= 0.99, name
        for name in ("depth", "sigma", "score", "source", "gate"):
            a, b = getattr(ours, name), getattr(views[0], name)
            assert torch.equal(a[~filled].nan_to_num(7), b[~filled].nan_to_num(7)), name
        assert not ours.gate[filled].any()
    assert len(calls) == 3


@needs_compiler
@pytest.mark.parametrize("hw", [(64, 97), (5, 150), (3, 2), (0, 4)])
def test_filled_planes_depend_on_no_other_view(loaded, monkeypatch, hw):
    swept, support, returns, grey, reach = weakly_textured(hw)
    calls = counted(monkeypatch, "fill_planes")
    options = replace(DEFAULT_DENSE_OPTIONS, min_plane_support=6, max_plane_sigma_rel=0.1, max_sigma_rel=1.0)
    together = planes.fill_planes(swept, support, returns, grey, reach, options=options)
    assert hw[0] < 60 or (together.source == Source.FILLED).any()
    for k in range(3):
        one = slice(k, k + 1)
        alone_returns = map_filters.SensorReturns(*(x[one] for x in returns))
        alone = planes.fill_planes(swept[one], support[one], alone_returns, grey[one], reach[one], options=options)
        for a, b in zip(tree_leaves(together[one]), tree_leaves(alone), strict=True):
            assert torch.equal(a.nan_to_num(7), b.nan_to_num(7))
    none = slice(0, 0)
    empty = map_filters.SensorReturns(*(x[none] for x in returns))
    assert planes.fill_planes(swept[none], support[none], empty, grey[none], reach[none]).depth.shape == (0, *hw)
    assert len(calls) == 5


@needs_compiler
def test_planes_that_compiled_code_does_not_fill_are_torchs(loaded, monkeypatch):
    swept, support, returns, grey, reach = weakly_textured((97, 240), B=1)
    calls = counted(monkeypatch, "fill_planes")
    options = replace(DEFAULT_DENSE_OPTIONS, **PLANE_OPTIONS["loose"])
    leaf = support.depth.clone().requires_grad_()
    filled = planes.fill_planes(swept, support.replace(depth=leaf), returns, grey, reach, options=options)
    where = filled.source == Source.FILLED
    assert where.any() and torch.autograd.grad(filled.depth[where].sum(), [leaf])[0].abs().sum() > 0
    double = swept.replace(depth=swept.depth.double(), sigma=swept.sigma.double(), score=swept.score.double())
    assert planes.fill_planes(double, support, returns, grey, reach, options=options).depth.dtype == torch.float64
    assert not calls
    mirrored = map_filters.SensorReturns(*(x.flip(-1).contiguous().flip(-1) for x in returns))
    expanded = planes.fill_planes(swept, support, mirrored, grey, reach, options=options)
    assert calls and torch.equal(expanded.gate, filled.gate)


@needs_compiler
@pytest.mark.parametrize("lens", [False, True])
@pytest.mark.parametrize("hw", [(41, 53), (6, 70), (9, 3)])
def test_fitted_windows_agree_up_to_rounding(loaded, monkeypatch, lens, hw):
    """Pairs turned and moved, pixels that leave the other picture or lie behind it, and one without texture."""
    g = torch.Generator().manual_seed(3)
    pictures = gaussian_blur(torch.rand(3, 2, *hw, generator=g), 1.2)
    pictures[2, 0] = 0.4
    f = torch.full((3, 2), float(max(hw)))
    lens = torch.tensor([[0.05, -0.01, 0.001, -0.002]]).expand(3, -1) if lens else None
    camera = Camera(f, torch.tensor([[hw[1] / 2, hw[0] / 2]]).expand(3, -1), lens)
    motion = se3.exp(0.05 * torch.randn(3, 6, generator=g) + torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -0.4]))
    base = plane_sweep.make_reference_view(pictures[:, :1], camera)
    view = plane_sweep.SweptView(pictures[:, 1:], camera, motion)
    q = 0.2 + 0.1 * gaussian_blur(torch.rand(3, 1, *hw, generator=g), 2.0)[:, 0]
    q[:, 0] = 4.0  # behind
    picture = plane_sweep.stack_gradients(view.image)
    found, expected = both_ways(lambda: plane_sweep.fit_windows(base, view, picture, q), monkeypatch)
    assert torch.equal(found.seen, expected.seen) and not bool(found.seen.all()) and bool(found.seen.any())
    for name in ("step", "contrast", "noise", "correlation", "motion"):
        a, b = getattr(found, name), getattr(expected, name)
        scale = b.abs().flatten(1).mean(1).clamp_min(1e-6)[:, None]
        assert a.shape == b.shape and ((a - b).flatten(1).abs() <= 1e-4 * (scale + b.flatten(1).abs())).all(), name
    assert found.correlation[:2].abs().mean() > 0.05


@needs_compiler
@pytest.mark.parametrize("turning", [False, True])
def test_what_hides_and_how_sure_motions_are_agrees(loaded, monkeypatch, turning):
    g = torch.Generator().manual_seed(8)
    grey = torch.rand(2, 1, 13, 50, generator=g)
    camera = Camera(torch.tensor([[40.0, 41.0], [35.0, 35.0]]), torch.tensor([[24.5, 6.0], [21.0, 5.5]]))
    T = se3.exp(torch.tensor([[0.02, -0.1, 0.2, -0.6, 0.1, 0.05], [0.0, 0.0, 0.0, 0.1, 0.0, -1.4]]))
    base, view = plane_sweep.make_reference_view(grey, camera), plane_sweep.SweptView(grey, camera, T)
    q = torch.rand(2, 13, 50, generator=g)
    near = torch.tensor([0.01, 0.3])
    found, expected = both_ways(
        lambda: plane_sweep.occlusion_mask(plane_sweep.epipolar_warp(base, view), q, near), monkeypatch
    )
    assert torch.equal(found, expected) and 0.05 < found.float().mean() < 0.9
    half = torch.randn(2, 9 if turning else 6, 9 if turning else 6, generator=g)
    cov = 1e-4 * half @ half.mT
    none = torch.zeros(2)
    shutter = Shutter(torch.zeros(2, 3), cov) if turning else None
    code = torch.tensor([PoseCode.OK, PoseCode.KEPT_PNP], dtype=torch.int32)
    fit = PoseFit(T, cov[:, :6, :6], none[:, None] > 1, none.long(), none, none, none, code, shutter)
    motion = torch.randn(2, 13, 50, 2, generator=g)
    motion[0, :2] = 0.0
    found, expected = both_ways(lambda: surface.pose_variance(base, view, fit, q, motion), monkeypatch)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0)
    for code in (PoseCode.OK, PoseCode.TOO_FEW):
        lost = fit.replace(code=torch.full_like(fit.code, code), cov=fit.cov * torch.nan, shutter=None)
        a, b = both_ways(lambda lost=lost: surface.pose_variance(base, view, lost, q, motion), monkeypatch)
        assert torch.equal(a, b) and not a.any(), "what is not known is no number"


@needs_compiler
@pytest.mark.parametrize("source_views", [1, 2])
def test_maps_agree_to_far_less_than_their_sigma(loaded, monkeypatch, source_views):
    room = SyntheticRoom(n_frames=9, hw=(96, 128), depth_hw=(48, 64))
    reference, *others = (range_split(room[k], 2.0) for k in (1, 6, 8))
    with monkeypatch.context() as patch:
        patch.setattr(loader, "_loaded", [])
        trace = {}
        asked = dense.selected_views(WINDOW(reference, others, trace=trace), others, trace)
    found, expected = both_ways(
        lambda: dense.sweep_depth(
            reference, asked, method=AUTO, source_views=source_views, planes=48, max_sigma_rel=0.5
        ),
        monkeypatch,
    )
    assert (found.gate != expected.gate).float().mean() <= 0.005 and torch.equal(found.gate == 0, found.depth > 0)
    both = (found.source == Source.SWEPT) & (expected.source == Source.SWEPT)
    assert both.float().mean() > 0.1
    assert ((found.depth - expected.depth)[both].abs() / expected.sigma[both]).quantile(0.99) <= 0.1
    torch.testing.assert_close(found.sigma[both].median(), expected.sigma[both].median(), rtol=1e-3, atol=0.0)


@needs_compiler
def test_windows_of_another_size_or_type_or_with_a_graph_are_fitted_by_torch(loaded, monkeypatch):
    calls = counted(monkeypatch, "fit_windows")
    grey = torch.rand(1, 2, 12, 14, generator=torch.Generator().manual_seed(4))
    camera = Camera(torch.full((1, 2), 20.0), torch.tensor([[6.5, 5.5]]))
    motion = se3.exp(torch.tensor([[0.0, 0.0, 0.0, 0.1, 0.0, 0.0]]))

    def fitted(grey, **options):
        base = plane_sweep.make_reference_view(grey[:, :1], camera.to(grey.dtype))
        view = plane_sweep.SweptView(grey[:, 1:], camera.to(grey.dtype), motion.to(grey.dtype))
        q = torch.full_like(grey[:, 0], 0.5)
        return plane_sweep.fit_windows(base, view, plane_sweep.stack_gradients(view.image), q, **options)

    fitted(grey.double())
    fitted(grey, radius=2)
    graph = grey.clone().requires_grad_()
    (slope,) = torch.autograd.grad(fitted(graph).step.sum(), [graph])
    assert bool(slope.isfinite().all()) and slope.abs().sum() > 0 and not calls
    fitted(grey)
    assert calls


@pytest.fixture(scope="module")
def seen_twice():
    """Two pictures, each seen again moved by a few pixels and lit otherwise; points in, at the border of and beside it."""
    g = torch.Generator().manual_seed(5)
    rough, fine = (gaussian_blur(torch.rand(2, 1, 120, 150, generator=g), s) - 0.5 for s in (3.0, 0.8))
    wide = 2.5 * rough + fine + 0.5
    here, there = wide[..., 10:-10, 10:-10], 0.8 * wide[..., 13:-7, 5:-15] + 0.1
    there = there + 0.004 * torch.randn(there.shape, generator=g)
    uv = torch.rand(2, 300, 2, generator=g) * torch.tensor([134.0, 104.0]) - 2
    uv[:, 0], uv[0, 1], uv[1, 1] = torch.nan, torch.inf, 1e30
    return here.clamp(0, 1), there.clamp(0, 1), uv


def agree(found, expected, exact=None):
    """The same verdicts but for one in 200, or as many as single precision itself changes of ``exact`` ones on either
    side, and valid places alike to far less than their sigma."""
    unsure = 0.0 if exact is None else sum((exact.valid != x.valid).float().mean() for x in (found, expected))
    assert (found.valid != expected.valid).float().mean() <= max(0.005, unsure)
    if exact is not None:
        apart_from_exact = [(exact.valid != x.valid).float().mean() for x in (found, expected)]
        assert apart_from_exact[0] <= max(0.005, 1.5 * apart_from_exact[1]), (
            "no further from double precision than torch"
        )
    both = found.valid & expected.valid
    assert both.float().mean() > 0.5
    apart = (found.uv_1 - expected.uv_1)[both].norm(dim=-1)
    sigma = expected.cov[both].diagonal(dim1=-1, dim2=-2).amax(-1).sqrt()
    assert apart.median() <= 1e-4 and (apart / sigma).quantile(0.99) <= 0.1
    for name in ("error", "photometric", "cov"):
        a, b = (getattr(x, name)[both].flatten() for x in (found, expected))
        assert (a - b).abs().median() <= 1e-3 * b.abs().median()


@needs_compiler
@pytest.mark.parametrize(
    ("normalise", "window", "levels"), [("none", 21, 4), ("bias", 15, 3), ("gain_bias", 11, 3), ("none", 33, 1)]
)
def test_a_search_for_points_agrees_up_to_rounding(loaded, monkeypatch, seen_twice, normalise, window, levels):
    here, there, uv = seen_twice
    if normalise != "gain_bias":
        there = (there - there.mean()) * here.std() / there.std() + here.mean()
    options = {"normalise": normalise, "window": window, "levels": levels}
    far = torch.tensor([[[4.0, -4.0]]])
    if normalise == "gain_bias":  # more of them: single precision itself is unsure of some
        here, there, uv = (torch.cat(4 * [x]) for x in (here, there, uv))
        far = torch.tensor([[4.0, -4.0], [4.0, -3.0], [3.0, -4.0], [5.0, -2.0]]).repeat_interleave(2, 0)[:, None]
    for hint in (NO_HINT, TrackHint(start=(uv + far).nan_to_num(posinf=1e30))):
        if hint is not NO_HINT or levels > 1:
            wide = lucas_kanade(here.double(), there.double(), uv.double(), hint=hint, **options)
            agree(*both_ways(lambda h=hint: lucas_kanade(here, there, uv, hint=h, **options), monkeypatch), wide)


def test_the_generated_header_holds_the_codes_and_the_shared_constants():
    header = loader.constants_header()
    for table in (codes.Flag, codes.Hole, codes.Source):
        for code, name in codes.names(table).items():
            assert f" {table.__name__.upper()}_{name} = {code};" in header
    assert "UNUSABLE" not in header
    assert "LUMA_THOUSANDTHS[] = {299, 587, 114};" in header and sum(constants.LUMA_THOUSANDTHS) == 1000
    for name in ("FIT_RADIUS_PX", "MAX_KERNEL_WINDOW_PX", "MAX_MAP_RADIUS_PX"):
        assert f" {name} = {getattr(constants, name)};" in header


def test_another_constant_has_a_file_of_its_own(monkeypatch):
    before = loader.library()
    monkeypatch.setattr(constants, "FIT_RADIUS_PX", 5)
    assert loader.library() != before


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [(platform, "machine", lambda: "other"), (sys, "platform", "other"), (loader, "FLAGS", ["-O0"])],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_another_machine_or_command_has_a_file_of_its_own(monkeypatch, owner, name, value):
    level = loader.level()
    before = loader.file_name(level)
    monkeypatch.setattr(owner, name, value)
    assert loader.file_name(level) != before


def test_a_map_fits_into_the_kernel_and_a_level_is_padded_by_more_than_it_reads():
    assert max(*lk.TOP_RADII, *lk.MIDDLE_RADII, *lk.FINEST_RADII) <= constants.MAX_MAP_RADIUS_PX
    reach = pyramid.OUTSIDE_MARGIN_PX + constants.MAX_MAP_RADIUS_PX + 2
    assert reach <= pyramid.SEARCH_PADDING_PX, "the largest radius, and a row"


@needs_compiler
def test_kernels_take_their_limits_from_torchs_side(loaded, monkeypatch):
    """Another constant changes what the kernel answers as it changes the reference."""
    C, views = volume(1, 6, 7, 20, most=31), torch.tensor(1)
    before = plane_sweep.aggregate_best_plane(C, views)[0].cost
    monkeypatch.setattr(plane_sweep, "JUMP_COST", 2)
    monkeypatch.setattr(plane_sweep.aggregate_costs, "__kwdefaults__", {"step": plane_sweep.STEP_COST, "jump": 2})
    found, expected = both_ways(lambda: plane_sweep.aggregate_best_plane(C, views)[0].cost, monkeypatch)
    assert torch.equal(found, expected) and not torch.equal(found, before)
    samples, tracks, camera, _, draws = near_pairs(3, 200, 0.3)
    poses = pnp_ransac(samples, tracks, camera, camera, draws)
    monkeypatch.setattr(pose, "MAX_SEARCH_POINTS", 5)
    assert not torch.equal(pnp_ransac(samples, tracks, camera, camera, draws).T_1_from_0.t, poses.T_1_from_0.t)


def registered(here, there, uv, **options):
    """Windows at ``uv`` registered from three pixels left and five below, which is where they moved to but for 0.2 px."""
    window = options.get("window", 21)
    views = pyramid.build_pyramid(here, 1, window), pyramid.build_pyramid(there, 2, window, gradients=False)
    moved = torch.tensor([5.2, -2.8]) if "linear" not in options else torch.tensor([0.2, 0.2])
    return affine_alignment.register_affine(*views, uv, uv + moved.to(uv), **options)


def register_alike(found, expected, most_apart=0.1):
    """The same verdicts but for one in 200, and windows alike to far less than their sigma."""
    assert (found.ok != expected.ok).float().mean() <= 0.005
    both = found.ok & expected.ok
    assert both.float().mean() > 0.5
    apart = (found.uv_1 - expected.uv_1)[both].norm(dim=-1)
    sigma = expected.cov[both].diagonal(dim1=-1, dim2=-2).amax(-1).sqrt()
    assert apart.median() <= 1e-4 and (apart / sigma).quantile(0.99) <= most_apart
    for name in ("linear", "rms", "cov", "shift_px"):
        a, b = (getattr(x, name)[both] for x in (found, expected))
        assert (a - b).abs().median() <= 1e-3 * b.abs().median(), name


@needs_compiler
@pytest.mark.parametrize(
    "options", [{}, {"window": 9, "iterations": 3}, {"iterations": 0}, {"epsilon_px": 0.3}], ids=str
)
def test_a_registration_agrees_up_to_rounding(loaded, monkeypatch, seen_twice, options):
    here, there, uv = seen_twice
    found, expected = both_ways(lambda: registered(here, there, uv, **options), monkeypatch)
    register_alike(found, expected)
    assert not torch.equal(found.cov, expected.cov), "not compiled"


@needs_compiler
def test_a_magnified_window_is_registered_on_the_half_size_level_alike(loaded, monkeypatch):
    g = torch.Generator().manual_seed(6)
    small = gaussian_blur(torch.rand(1, 1, 60, 80, generator=g), 1.5)
    small = (small - small.mean()) * 2 + 0.5
    large = torch.nn.functional.interpolate(small, scale_factor=2, mode="bicubic", align_corners=False)
    uv = 15 + torch.rand(1, 100, 2, generator=g) * torch.tensor([50.0, 30.0])

    def magnified():
        views = pyramid.build_pyramid(small, 1), pyramid.build_pyramid(large, 2)
        return affine_alignment.register_affine(*views, uv, 2 * uv + 0.7, linear=1.9 * torch.eye(2)[None])

    found, expected = both_ways(magnified, monkeypatch)
    register_alike(found, expected)
    assert (found.linear.det()[found.ok] > affine_alignment.HALVING_MAGNIFICATION**2).all()


@needs_compiler
def test_a_registration_is_the_same_in_any_batch_and_without_texture_none(loaded, monkeypatch, seen_twice):
    here, there, uv = seen_twice
    together = registered(here, there, uv)
    some = torch.rand(uv.shape[:2], generator=torch.Generator().manual_seed(7)) < 0.3
    chosen = registered(here, there, uv, wanted=some)
    for name in affine_alignment.AffineRegistration._fields:
        whole = getattr(together, name)
        assert torch.equal(getattr(chosen, name)[some & together.ok], whole[some & together.ok]), name
        alone = getattr(registered(here[1:], there[1:], uv[1:, ::3]), name)
        assert torch.equal(alone[0][together.ok[1, ::3]], whole[1, ::3][together.ok[1, ::3]]), name
    for found, expected in zip(*both_ways(lambda: registered(0 * here, there, uv), monkeypatch), strict=True):
        assert torch.allclose(found, expected, equal_nan=True)
    assert not found.any(), "no texture"


@needs_compiler
def test_a_registration_in_another_type_or_reaching_past_the_padding_is_torchs(loaded, monkeypatch, seen_twice):
    here, there, uv = seen_twice
    calls = counted(monkeypatch, "register_affine")
    registered(here.double(), there.double(), uv.double())
    narrow = pyramid.build_pyramid(here, 1, 9), pyramid.build_pyramid(there, 1, 9)
    usable = (uv > 20).all(-1) & (uv < 80).all(-1)
    affine_alignment.register_affine(*narrow, uv, uv, wanted=usable, window=11)
    assert not calls
    registered(here, there, uv)
    assert calls


@needs_compiler
def test_a_registration_keeps_its_gradient(loaded, monkeypatch, seen_twice):
    here, there, uv = seen_twice
    start = TrackHint(start=(uv[1:] + torch.tensor([5.0, -3.0])))

    def slope():
        seen = there[1:].clone().requires_grad_()
        tracks = lucas_kanade_affine(here[1:], seen, uv[1:], hint=start)
        (slope,) = torch.autograd.grad(tracks.uv_1[tracks.valid & (tracks.error < 0.5)].sum(), seen)
        return slope

    found, expected = both_ways(slope, monkeypatch)
    assert expected.abs().max() > 0 and (found - expected).norm() < 0.02 * expected.norm()


@needs_compiler
def test_a_registration_of_pixels_that_are_no_numbers_is_rejected_alike(loaded, monkeypatch, seen_twice):
    here, there, uv = seen_twice
    here, there = here.clone(), there.clone()
    here[0, 0, 30:33, 60:63], there[1, 0, 70:72, :20] = torch.nan, torch.inf
    found, expected = both_ways(lambda: registered(here, there, uv), monkeypatch)
    register_alike(found, expected)
    assert torch.equal(found.cov.isfinite(), expected.cov.isfinite()) and not bool(found.cov.isfinite().all())
    assert bool(found.cov[found.ok].isfinite().all())


def near_pairs(batch, n, wrong, seed=0):
    """Points 0.5 to 2.5 m away seen again with 0.3 px of noise, a share of them anywhere: input of ``pnp_ransac`` and ``map_pose``."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=g)

    camera = Camera(500 + 50 * uniform(batch, 2), 300 + 20 * uniform(batch, 2))
    uv_0, depth = 640 * uniform(batch, n, 2), 0.5 + 2 * uniform(batch, n)
    xyz = unproject(camera, uv_0, depth)
    T = se3.exp(0.1 * torch.randn(batch, 6, generator=g))
    uv_1 = project(camera, se3.apply(T, xyz)) + 0.3 * torch.randn(batch, n, 2, generator=g)
    uv_1 = torch.where(uniform(batch, n, 1) < wrong, 640 * uniform(batch, n, 2), uv_1)
    zero, code = torch.zeros(batch, n), torch.zeros(batch, n, dtype=torch.int32)
    samples = Samples(uv_0, depth, 0.01 * depth, xyz, zero, code, zero, code)
    tracks = Tracks(uv_0, uv_1, zero, zero, torch.eye(2).expand(batch, n, 2, 2), uniform(batch, n) < 0.9)
    return samples, tracks, camera, camera, uniform(batch, 64, 3)


def poses_alike(found, expected):
    assert torch.equal(found.code, expected.code)
    assert (found.inlier != expected.inlier).float().mean() <= 0.001
    sigma = expected.cov.diagonal(dim1=1, dim2=2).sqrt()
    turn, shift = (getattr(found.T_1_from_0, k) - getattr(expected.T_1_from_0, k) for k in ("R", "t"))
    apart = torch.cat((turn.abs().flatten(1) / sigma[:, :3].amax(1, keepdim=True), shift.abs() / sigma[:, 3:]), 1)
    assert apart[expected.ok].quantile(0.99) <= 0.01
    return int(expected.ok.sum())  # poses


def noise_alike(found, expected):
    for name in ("rms_px", "sigma_px", "t_snr", "cov"):
        a, b = (getattr(fit, name)[expected.ok].flatten() for fit in (found, expected))
        assert ((a - b).abs() <= 1e-3 * b.abs() + 1e-9).float().mean() >= 0.99, name


@needs_compiler
@pytest.mark.parametrize(("batch", "n", "wrong"), [(3, 700, 0.3), (20, 100, 0.4), (40, 12, 0.2)])
def test_a_pose_from_near_points_agrees_up_to_rounding(loaded, monkeypatch, batch, n, wrong):
    args = near_pairs(batch, n, wrong)
    found, expected = both_ways(lambda: pnp_ransac(*args), monkeypatch)
    assert poses_alike(found, expected) > batch // 2
    noise_alike(found, expected)
    for options in ({"local_optimisation": 0, "polish_steps": 0}, {"polish_steps": 3, "threshold_px": 1.5}):
        poses_alike(*both_ways(lambda o=options: pnp_ransac(*args, **o), monkeypatch))
    alone = [pnp_ransac(*(x[k : k + 1] for x in args)) for k in range(2)]
    for one, k in zip(alone, range(2), strict=True):
        assert torch.equal(one.T_1_from_0.R[0].nan_to_num(), found.T_1_from_0.R[k].nan_to_num()), "its company is told"


@needs_compiler
def test_the_reasons_for_no_pose_agree(loaded, monkeypatch):
    samples, tracks, *rest = near_pairs(7, 60, 0.2)
    xyz, uv_1, valid = samples.xyz.clone(), tracks.uv_1.clone(), tracks.valid.clone()
    valid[0] = False
    valid[1, 2:] = False
    xyz[2] = torch.nan
    xyz[3] = torch.linspace(1, 2, 60)[:, None] * torch.tensor([0.1, 0.2, 1.0])  # a line
    xyz[4] = xyz[4, :1]
    uv_1[5] = torch.inf
    args = (samples.replace(xyz=xyz), tracks.replace(uv_1=uv_1, valid=valid), *rest)
    found, expected = both_ways(lambda: pnp_ransac(*args), monkeypatch)
    assert torch.equal(found.code, expected.code)
    assert found.code.tolist()[:3] == [PoseCode.TOO_FEW] * 3 and found.code[6] == PoseCode.OK
    assert bool(found.T_1_from_0.R[:6].isnan().all())


@needs_compiler
def test_poses_in_another_type_by_a_kernel_or_with_a_graph_are_torchs(loaded, monkeypatch):
    samples, tracks, camera, _, draws = near_pairs(2, 90, 0.2)
    calls = counted(monkeypatch, "robust_pose")
    pnp_ransac(samples, tracks, camera, camera, draws)
    assert len(calls) == 1
    pnp_ransac(samples, tracks, camera, camera, draws, kernel="huber")
    pnp_ransac(*(x.to(torch.float64) for x in (samples, tracks, camera, camera)), draws)
    assert len(calls) == 1
    leaf = tracks.uv_1.clone().requires_grad_()

    def shift():
        (grad,) = torch.autograd.grad(
            pnp_ransac(samples, tracks.replace(uv_1=leaf), camera, camera, draws).T_1_from_0.t.sum(), leaf
        )
        return grad

    torch.testing.assert_close(*both_ways(shift, monkeypatch), atol=1e-6, rtol=1e-3)


def every_track(turning):
    """Tracks of every kind, as many as compiled code takes; their unknowns and noise."""
    problem, at = pose_depth_problem()
    problem = PoseDepthProblem(
        problem.f, problem.c, *(x.repeat(*[1] * (x.ndim - 1), 16) for x in tree_leaves(problem)[2:])
    )
    noise = NOISE.repeat(1, 16)
    return (
        problem.to(torch.float32),
        at._replace(T=at.T.to(torch.float32), shutter_rate=at.shutter_rate.float() if turning else None),
        noise.float(),
    )


@needs_compiler
@pytest.mark.parametrize("turning", [False, True])
def test_equations_of_tracks_agree_up_to_rounding(loaded, monkeypatch, turning):
    problem, at, noise = every_track(turning)
    told = (problem, noise, torch.tensor([0.1, 0.7]), torch.tensor([1e4, 10.0]))
    asked = counted(monkeypatch, "pose_normal_equations")

    def ask(kernel="geman_mcclure", told=told, at=at):
        normal, cost = reprojection_problem.pose_normal_equations_at(*told, kernel=kernel, bend=2.0)
        return (*normal(at), cost(at))

    found, expected = both_ways(ask, monkeypatch)
    assert len(asked) == 2
    for a, b in zip(found, expected, strict=True):
        assert a.shape == b.shape and (a - b).abs().amax() <= 2e-4 * b.abs().amax()
    for i in range(6):  # each column, whatever its unit
        torch.testing.assert_close(found[1][:, i, i], expected[1][:, i, i], rtol=1e-3, atol=0)
    ask(kernel="cauchy")
    mixed = [told[0], told[1].double(), *told[2:]]
    ask(told=mixed)
    assert len(asked) == 2, "in torch"
    wide = [x.to(torch.float64) for x in told]
    rate = None if at.shutter_rate is None else at.shutter_rate.double()
    found, expected = both_ways(
        lambda: ask(told=wide, at=at._replace(T=at.T.to(torch.float64), shutter_rate=rate)), monkeypatch
    )
    assert len(asked) == 4
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == torch.float64 and (a - b).abs().amax() <= 1e-11 * b.abs().amax()
    asked.clear()
    leaf = at.T.t.clone().requires_grad_()
    assert ask(at=at._replace(T=at.T.replace(t=leaf)))[0].requires_grad
    assert not asked, "in torch"
    (square, front), (wanted, ahead) = both_ways(
        lambda: reprojection_problem.squared_residuals_at(problem, at)(noise), monkeypatch
    )
    assert torch.equal(front, ahead) and 0 < front.float().mean() < 1
    torch.testing.assert_close(square, wanted, rtol=1e-3, atol=1e-3)


@needs_compiler
@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("rotation_only", [False, True])
def test_minima_over_tracks_and_their_noise_agree_up_to_rounding(loaded, monkeypatch, turning, rotation_only):
    problem, at, noise = every_track(turning)
    used = problem, at, noise, torch.tensor([0.1, 0.7]), torch.tensor([1e4, 10.0])
    asked = counted(monkeypatch, "minimise_tracks"), counted(monkeypatch, "track_noise")
    options = {"kernel": "geman_mcclure", "bend": 2.0, "rotation_only": rotation_only}
    for steps in (0, 1, 4):
        (found, cost), (expected, wanted) = both_ways(
            lambda k=steps: reprojection_problem.minimise_tracks(*used, steps=k, **options), monkeypatch
        )
        torch.testing.assert_close(cost, wanted, rtol=1e-3, atol=0)
        assert (found.shutter_rate is None) == (not turning)
        for a, b in zip(*((x.T.R, x.T.t, x.shutter_rate) for x in (found, expected)), strict=True):
            assert a is None or (a - b).abs().amax() <= 1e-4
    found, expected = both_ways(lambda: estimate_noise_variance(problem, at), monkeypatch)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)
    assert [len(x) for x in asked] == [3, 1]


@needs_compiler
@pytest.mark.parametrize("far", [0.0, 0.1])
def test_covariances_of_poses_agree_up_to_rounding(loaded, monkeypatch, far):
    problem, at, noise = every_track(turning=True)
    wide = problem.to(torch.float64)
    at = at._replace(T=at.T.to(torch.float64), shutter_rate=at.shutter_rate.double())
    weight = torch.tensor([far, 0.7], dtype=torch.float64)
    solution = map_estimate.MapSolution(at, noise.double(), weight, 1e4 * weight, weight > 0)
    asked = counted(monkeypatch, "pose_sandwich")
    for options in (map_estimate.FitOptions(), map_estimate.FitOptions(bend=0.7, blocks=(2, 2))):
        (found, ok), (expected, sound) = both_ways(
            lambda o=options: map_estimate.pose_covariance(wide, solution, o), monkeypatch
        )
        assert ok.all() and sound.all()
        size = expected.diagonal(dim1=1, dim2=2).sqrt()
        assert ((found - expected) / (size[:, :, None] * size[:, None])).abs().amax() <= 1e-10
    assert len(asked) == 2
    map_estimate.pose_covariance(wide, solution, map_estimate.FitOptions(kernel="huber"))
    assert len(asked) == 2, "in torch"


@needs_compiler
@pytest.mark.parametrize(("n", "columns"), [(6, 1), (6, 7), (9, 9), (3, 1)])
def test_solutions_of_small_systems_agree_up_to_rounding(loaded, monkeypatch, n, columns):
    g = torch.Generator().manual_seed(n)
    rows = torch.randn(7, n + 4, n, generator=g, dtype=torch.float64)
    H = (
        rows.mT
        @ rows
        * torch.logspace(-3, 3, n, dtype=torch.float64)
        * torch.logspace(-3, 3, n, dtype=torch.float64)[:, None]
    )
    b = torch.randn(7, n, columns, generator=g, dtype=torch.float64)
    H[1, 0, 0], H[2, 1, 1], b[3, 0, 0], H[4] = torch.nan, -1.0, torch.inf, 0.0
    H[5] = torch.ones(n, n)  # of rank one
    asked = counted(monkeypatch, "solve_spd")
    (x, ok), (expected, sound) = both_ways(lambda: least_squares.solve_spd(H, b), monkeypatch)
    assert len(asked) == 1
    assert torch.equal(ok, sound) and ok.tolist() == [True, *[False] * 5, True]
    assert not x[~ok].any()
    assert (x - expected).abs().amax() <= 1e-11 * expected.abs().amax()
    assert least_squares.solve_spd(H.float(), b.float())[0].dtype == torch.float32
    alone, _ = least_squares.solve_spd(H[6:], b[6:])
    assert torch.equal(alone[0], x[6])
    assert least_squares.solve_spd(H.requires_grad_(), b)[0].requires_grad


@needs_compiler
@pytest.mark.parametrize("coefficients", [4, 5, 8])
def test_pixels_of_a_lens_are_the_same_bits(loaded, monkeypatch, coefficients):
    """Those outside of the lens's model, and pixels that are no numbers, too."""
    g = torch.Generator().manual_seed(coefficients)
    lens = torch.tensor([[0.26, -0.95, -0.005, 0.002, 1.1, 0.1, 0.02, 0.01], [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    camera = Camera(500 + 20 * torch.rand(2, 2, generator=g), torch.full((2, 2), 300.0), lens[:, :coefficients])
    uv = 1000 * torch.rand(2, 301, 2, generator=g) - 150
    uv[0, 0], uv[1, 3, 1] = torch.nan, torch.inf
    asked = counted(monkeypatch, "undistort"), counted(monkeypatch, "undistort_jacobian")
    found, expected = both_ways(lambda: undistort(camera, uv), monkeypatch)
    assert 2 <= int(expected.isnan().any(-1).sum()) < 500
    torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    found, expected = both_ways(lambda: undistort_jacobian(camera, uv[:, 4:]), monkeypatch)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    assert [len(x) for x in asked] == [1, 1]
    for seen_by in (camera, camera.replace(distortion=None)):
        found, expected = both_ways(lambda lens=seen_by: rays(lens, uv), monkeypatch)
        torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(undistort(camera[1:], uv[1:]).nan_to_num(), undistort(camera, uv)[1:].nan_to_num())
    assert undistort(camera, uv.clone().requires_grad_()).requires_grad
    with pytest.raises(ValueError, match="7 coefficients"):
        undistort(camera.replace(distortion=torch.zeros(2, 7)), uv)


@needs_compiler
@pytest.mark.parametrize("bent", ["both", "first", "second"])
def test_tracks_in_ideal_pixels_are_the_same_bits(loaded, monkeypatch, bent):
    _, tracks, camera, _, _ = near_pairs(3, 301, 0.2)
    lens = torch.tensor([[0.26, -0.95, -0.005, 0.002, 1.1]]).expand(3, 5)
    cameras = [camera.replace(distortion=lens if bent in ("both", name) else None) for name in ("first", "second")]
    uv_0, uv_1, cov = 1.8 * tracks.uv_0 - 200, tracks.uv_1.clone(), tracks.cov * (1 + torch.rand(3, 301, 2, 2))
    uv_0[0, 0], uv_1[1, 3, 1], cov[2, 5, 0, 1], cov[0, 7] = torch.nan, torch.inf, torch.nan, torch.inf
    seen = tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov)
    asked = counted(monkeypatch, "undistort_tracks")
    found, expected = both_ways(lambda: undistort_tracks(seen, *cameras), monkeypatch)
    assert len(asked) == 1
    for name in ("uv_0", "uv_1", "cov", "valid"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=0, equal_nan=True)
    assert 0 < int((seen.valid & ~found.valid).sum()) < 300
    alone = undistort_tracks(seen[1:2], *(x[1:2] for x in cameras))
    assert torch.equal(alone.cov.nan_to_num(), found.cov[1:2].nan_to_num())


@needs_compiler
def test_triangulated_tracks_agree_up_to_rounding(loaded, monkeypatch):
    _, tracks, camera, _, _ = near_pairs(3, 301, 0.2)
    T = se3.exp(0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(1)))
    T = T.replace(t=T.t * torch.tensor([[1.0], [1.0], [0.0]]))  # the last pair has no baseline
    asked = counted(monkeypatch, "triangulate")
    found, expected = both_ways(lambda: epipolar.triangulate(tracks.uv_0, tracks.uv_1, camera, camera, T), monkeypatch)
    assert len(asked) == 1
    for name, a, b in zip(expected._fields, found, expected, strict=True):
        assert a.shape == b.shape, name
        torch.testing.assert_close(a, b, rtol=2e-6, atol=2e-6, msg=lambda text, name=name: f"{name}: {text}")
    geometry = expected._replace(slope=expected.slope.clone())
    geometry.slope[0, 3] = 0.0
    rows = torch.randn(3, 6, 9, generator=torch.Generator().manual_seed(2))
    cov = tracks.cov + 0.1 * torch.rand(3, 301, 1, 1, generator=torch.Generator().manual_seed(3))
    variances = both_ways(lambda: epipolar.depth_variance(geometry, cov, 1e-6 * rows @ rows.mT), monkeypatch)
    for a, b in zip(*variances, strict=True):
        assert torch.equal(a.isinf(), b.isinf()) and bool(a[0, 3].isinf())
        torch.testing.assert_close(a, b, rtol=1e-4, atol=0)
    leaf = tracks.uv_1.clone().requires_grad_()
    assert epipolar.triangulate(tracks.uv_0, leaf, camera, camera, T).depth.requires_grad


@needs_compiler
@pytest.mark.parametrize("turning", [False, True])
def test_parallax_of_near_returns_agrees_up_to_rounding(loaded, monkeypatch, turning):
    samples, tracks, camera, other, _ = near_pairs(3, 301, 0.2)
    xyz, uv_1, sigma = samples.xyz.clone(), tracks.uv_1.clone(), samples.sigma.clone()
    xyz[:, ::3], uv_1[0, 5], xyz[1, 7, 2], sigma[1, 8] = torch.nan, torch.nan, -1.0, torch.inf
    T = se3.exp(0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(1)))
    nothing = torch.full((3, 9, 9), 0.0)
    fit = pnp_ransac(*near_pairs(3, 301, 0.2)).replace(T_1_from_0=T, code=torch.tensor([0, 0, 2], dtype=torch.int32))
    rate = 0.05 * torch.randn(3, 3, generator=torch.Generator().manual_seed(2))
    fit = fit.replace(shutter=Shutter(rate, nothing) if turning else None)
    inputs = samples.replace(xyz=xyz, sigma=sigma), tracks.replace(uv_1=uv_1), fit
    asked = counted(monkeypatch, "near_parallax")
    found, expected = both_ways(
        lambda: misalignment._near_parallax(*inputs, camera, other.replace(f=1.1 * other.f)), monkeypatch
    )
    assert len(asked) == 1
    assert torch.equal(found.used, expected.used) and expected.used.any(1).tolist() == [True, True, False]
    for name, a, b in zip(expected._fields, found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6, msg=lambda text, name=name: f"{name}: {text}")


@needs_compiler
@pytest.mark.parametrize("fitted", [False, True])
def test_costs_of_depth_profiles_agree_up_to_rounding(loaded, monkeypatch, fitted):
    g = torch.Generator().manual_seed(0)

    def uniform(*shape):
        return torch.rand(*shape, generator=g)

    q, a, p = 0.5 + uniform(2, 301), 50 * uniform(2, 301), 0.5 + uniform(2, 4, 301)
    near = misalignment._Parallax(
        uniform(2, 301, 2), q, q, a, variance_rel=0.01 * uniform(2, 301), noise=0.1 + uniform(2, 1), used=q > 0
    )
    used, scale = uniform(2, 4, 301) < 0.8, 0.5 + uniform(2, 4) if fitted else None
    used[0, 0] = False
    q[1, :150] = -q[1, :150]  # some fits are not positive
    used[1, 3, 150:] = False
    asked = counted(monkeypatch, "profile_cost")
    found, expected = both_ways(lambda: misalignment._profile_cost(near, p, used, scale), monkeypatch)
    assert len(asked) == 1 and found[0, 0] == 0
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0)


@needs_compiler
def test_a_pose_from_all_tracks_agrees_to_far_less_than_its_sigma(loaded, monkeypatch):
    args, _, _, _ = map_pose_inputs(6, near=80, far=220, turn=0.01)
    args = [x.to(torch.float32) for x in args]
    found, expected = both_ways(lambda: map_pose(*args), monkeypatch)
    assert poses_alike(found, expected) == 6
    assert not torch.equal(found.T_1_from_0.t, expected.T_1_from_0.t), "not compiled"
    alone = map_pose(*(x[2:3] for x in args))
    assert torch.equal(alone.T_1_from_0.t[0], found.T_1_from_0.t[2]), "its company is told"


@needs_compiler
def test_a_point_is_the_same_in_any_batch(loaded, seen_twice):
    here, there, uv = seen_twice
    together = lucas_kanade(here, there, uv)
    for k in range(len(uv)):
        alone = lucas_kanade(here[k : k + 1], there[k : k + 1], uv[k : k + 1].flip(1))
        for name in ("uv_1", "cov", "error", "photometric", "valid"):
            assert torch.equal(getattr(alone, name)[0].flip(0), getattr(together, name)[k]), name


@needs_compiler
def test_pixels_that_are_no_numbers_hurt_only_the_windows_they_are_in(loaded, monkeypatch, seen_twice):
    here, there, uv = seen_twice
    here, there = here.clone(), there.clone()
    here[0, 0, 30:33, 60:63], there[1, 0, 70:72, :20] = torch.nan, torch.inf
    found, expected = both_ways(lambda: lucas_kanade(here, there, uv, normalise="bias", levels=2), monkeypatch)
    agree(found, expected)
    assert bool(found.cov.isfinite().all() and found.uv_1.isfinite().all())


@needs_compiler
def test_a_search_in_another_type_or_with_a_graph_is_torchs(loaded, monkeypatch, seen_twice):
    here, there, uv = seen_twice
    found, expected = both_ways(lambda: lucas_kanade(here.double(), there.double(), uv.double()), monkeypatch)
    assert torch.equal(found.uv_1, expected.uv_1)
    calls = counted(monkeypatch, "lk_search")
    lucas_kanade(here.double(), there.double(), uv.double())
    assert not calls
    lucas_kanade(here, there, uv)
    assert calls


@needs_compiler
def test_what_compiled_code_cannot_do_is_left_to_torch(loaded, monkeypatch):
    seen = []
    kinds = {"x": torch.float32, "code": (torch.uint8, torch.int32), "any_strides": torch.float32}

    @dispatch.operator(kernel=lambda *_, **__: seen.append("kernel"), dtypes=kinds, any_layout=("any_strides",))
    def both(x, code=None, any_strides=None, *, option=0):
        """The reference."""
        seen.append("torch")

    def which(*args, **kwargs):
        both(*args, **kwargs)
        return seen.pop()

    x = torch.zeros(2, 3, 4, 5)
    assert both.__name__ == "both" and both.__doc__ == "The reference."
    assert which(x, x.to(torch.uint8)) == which(x, x.int(), x.mT) == which(x) == which(any_strides=x, x=x) == "kernel"
    for one in (x.double(), x.half(), x.mT, x.to("meta"), torch.nn.Parameter(x), torch._neg_view(x)):
        assert which(one) == "torch"
    assert which(x, x) == which(x, x.long()) == which(code=x.long(), x=x) == which(x, None, x.double()) == "torch"
    with torch.no_grad():
        assert which(torch.nn.Parameter(x)) == "torch", "no plain tensor"
        assert which(x.clone().requires_grad_()) == "kernel"
    torch.vmap(lambda y: (both(y), y)[1])(x)
    assert seen.pop() == "torch"
    with forward_ad.dual_level():
        assert which(x) == "torch"
    C = volume(2, 4, 5, 6, most=31)
    assert torch.equal(
        plane_sweep.aggregate_best_plane(C.int(), torch.tensor(1))[1],
        plane_sweep.aggregate_best_plane(C, torch.tensor(1))[1],
    ), "other numbers"
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert which(x) == "torch"


def test_an_operator_runs_its_kernel_where_its_condition_holds(monkeypatch):
    monkeypatch.setattr(loader, "_loaded", [None])

    @dispatch.operator(
        kernel=lambda *tensors, radius: "kernel",
        dtypes={"x": torch.float32, "y": torch.float32},
        when=lambda *tensors, radius: radius == 4,
    )
    def both(*tensors, radius):
        """The reference."""
        return "torch"

    x = torch.zeros(3)
    assert both(x, x, radius=4) == both(x, None, radius=4) == "kernel"
    assert both(x, x, radius=2) == both(x, x.double(), radius=4) == "torch"
    for wrong in ({"y": torch.float32}, {"x": torch.float32, "z": torch.float32}):
        with pytest.raises(TypeError, match=r"double: found dtypes of .*, expected x"):

            @dispatch.operator(kernel=both, dtypes=wrong)
            def double(x):
                """The reference."""


@needs_compiler
def test_tangents_are_carried_though_compiled_code_is_loaded(loaded):
    image, tangent = torch.rand(2, 1, 3, 48, 64)
    with forward_ad.dual_level():
        top = pyramid.build_pyramid(forward_ad.make_dual(image, tangent), 2, 11).levels[1]
        found = forward_ad.unpack_dual(top).tangent
    expected = pyramid.build_pyramid(tangent, 2, 11).levels[1]  # linear in the image
    assert found is not None and torch.allclose(found, expected, atol=1e-6)
    assert dispatch.is_in_use()


@needs_compiler
def test_a_library_is_in_use_where_there_is_one_unless_it_is_turned_off(cache, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    assert not dispatch.is_in_use() and loader.describe_operators() == "torch" and not loader._loaded
    monkeypatch.delenv("DHTORCH_OPS")
    assert dispatch.is_in_use() and loader._loaded == [loader.library()]
    assert loader.describe_operators() == f"compiled {loader.level()}"
    assert {*cache.iterdir()} == {loader.library(), loader.manifest(loader.library())}, "nothing unfinished stays"


def test_without_a_library_torch_computes_and_nothing_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("DHTORCH_OPS")
    with pytest.warns(ImportWarning, match=f"operators: torch, .* slower .*: {loader.COMMAND}") as heard:
        assert not dispatch.is_in_use() and loader.describe_operators() == "torch"
    assert len(heard) == 1, "a category that Python ignores: the library prints nothing"
    monkeypatch.setenv("DHTORCH_OPS", "1")
    with pytest.raises(FileNotFoundError, match=f"no library for .*; compile it with {loader.COMMAND}"):
        plane_sweep.aggregate_best_plane(volume(1, 2, 2, 3, most=31), torch.tensor(1))
    assert not (tmp_path / "none").exists()


def test_how_many_times_slower_torch_is_was_measured():
    """Whole calls of one thread in the result files that the loader names."""
    results, ratios = Path(__file__).parents[2] / "benchmarks" / "results", []
    for name in ("pair", "pair_avx2", "dense_speed", "dense_speed_avx2"):
        rows = [
            r for r in json.loads((results / f"{name}.json").read_text()) if r["threads"] == 1 and "." not in r["name"]
        ]
        times = {(r["name"], r["mode"]): r["ours_ms"] for r in rows}
        ratios += [times[call, "eager"] / ms for (call, mode), ms in times.items() if mode == "compiled"]
    assert len(ratios) == 14 and (round(min(ratios)), round(max(ratios))) == loader.TIMES_SLOWER


#: Torch computes for the library, for a quiet command, for two commands, and for one that leaves compiled code unused.
FIRST_USE = """
import os, sys
from dhtorch.cli import run
from dhtorch.ops import dispatch, loader
loader.INSTALLED = loader.cache()
words = sys.argv[1:]
print(dispatch.is_in_use(), file=sys.stderr)
for flags, switch, is_first in ((["-q"], "", True), ([], "", True), ([], "", False), ([], "0", True)):
    os.environ["DHTORCH_OPS"] = switch
    loader._tried[:] = loader._tried[: not is_first]
    print(run.main([*flags, *words]), file=sys.stderr)
"""


def test_a_command_prints_once_that_operators_are_not_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "none"))
    monkeypatch.setenv("DHTORCH_OPS", "")
    words = ["stream", *ROOM[:4], "data=synthetic", "method=map", "method.n=64", "max_frames=2", "output=out"]
    command = [sys.executable, "-c", FIRST_USE, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    line = f"dhtorch: warning: operators: torch, {loader._ADVICE}"
    assert done.stderr.splitlines() == ["False", "0", line, "0", "0", "0"]
    assert loader.COMMAND in line and "3 to 9 times slower" in line and "C++ compiler" in line


def copy_of(cache, folder):
    """The compiled library and its manifest, copied to another cache -> its path."""
    shutil.copytree(cache, folder)
    return folder / loader.library().name


def damage(path):
    path.write_bytes(path.read_bytes()[:-1] + b"x")


def truncate(path):
    path.write_bytes(path.read_bytes()[:1000])


def empty(path):
    path.write_bytes(b"")


def make_foreign(path):
    """A file with a right checksum that no processor can load."""
    path.write_bytes(b"\x7fELF" + bytes(200))
    loader.manifest(path).write_text(json.dumps({"sha256": loader.checksum(path)}))


def lose_the_manifest(path):
    loader.manifest(path).unlink()


def spoil_the_manifest(path):
    loader.manifest(path).write_text('{"sha256": null')


def open_the_file(path):
    path.chmod(0o777)


def open_the_folder(path):
    path.parent.chmod(0o777)


@needs_compiler
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (damage, "differs from its checksum"),
        (truncate, "differs from its checksum"),
        (empty, "differs from its checksum"),
        (make_foreign, "Could not load|file"),
        (lose_the_manifest, "does not hold its checksum"),
        (spoil_the_manifest, "does not hold its checksum"),
        (open_the_file, "may be written by other users"),
        (open_the_folder, "may be written by other users"),
    ],
)
def test_a_spoiled_library_is_left_with_one_warning_and_built_again(cache, tmp_path, monkeypatch, spoil, message):
    path = copy_of(cache, tmp_path / "copy")
    spoil(path)
    monkeypatch.setenv("DHTORCH_CACHE", str(path.parent))
    monkeypatch.delenv("DHTORCH_OPS")
    with pytest.warns(UserWarning, match=message) as heard:
        assert not dispatch.is_in_use() and not dispatch.is_in_use()
    assert len(heard) == 1 and "torch is used" in str(heard[0].message) and loader.COMMAND in str(heard[0].message)
    monkeypatch.setenv("DHTORCH_OPS", "1")
    with pytest.raises(OSError, match=message):
        loader.load()
    if spoil not in (make_foreign, open_the_folder):
        monkeypatch.setattr(builder, "_compile", lambda compiler, work, level: write(work / "made.so", b"new"))
        assert builder.build() == path and path.read_bytes() == b"new" and loader.problem(path) is None


def write(path, data):
    path.write_bytes(data)
    return path


@needs_compiler
def test_a_library_of_other_sources_is_left(cache, tmp_path, monkeypatch):
    name = copy_of(cache, tmp_path / "installed").name
    for file in (tmp_path / "installed").iterdir():
        file.rename(file.with_name(file.name.replace(name[8:24], "0123456789abcdef")))
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("DHTORCH_OPS")
    with pytest.warns(UserWarning, match="of other sources or another processor"):
        assert not dispatch.is_in_use()


@needs_compiler
def test_the_library_of_a_wheel_is_used_before_the_cache(cache, tmp_path, monkeypatch):
    path, opened = copy_of(cache, tmp_path / "installed"), []
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    monkeypatch.delenv("DHTORCH_OPS")
    monkeypatch.setattr(torch.ops, "load_library", opened.append)  # a process registers the operators once
    assert dispatch.is_in_use() and loader._loaded == [path] and opened == [str(path.resolve())]


@needs_compiler
def test_two_processes_may_build_at_once(tmp_path, monkeypatch):
    """Each writes files of its own; the names are those of whole files at any time."""
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "cache"))
    made = []

    def compile_while_another_does(compiler, work, level):
        if not made:
            made.append(work)
            builder.build()  # the other process, from beginning to end
        return write(work / "made.so", b"whole")

    monkeypatch.setattr(builder, "_compile", compile_while_another_does)
    path = builder.build()
    assert loader.problem(path) is None and path.read_bytes() == b"whole"
    assert {*path.parent.iterdir()} == {path, loader.manifest(path)}


def spoiled_copies(cache, tmp_path):
    """Folders with copies of the library: sound, changed, cut short, foreign, without a manifest; and one without any."""
    spoil = {"sound": lambda _: None, "changed": damage, "cut": truncate, "foreign": make_foreign}
    spoil["no manifest"] = lose_the_manifest
    folders = {name: copy_of(cache, tmp_path / name).parent for name in spoil}
    for name, change in spoil.items():
        change(folders[name] / loader.library().name)
    (tmp_path / "none").mkdir()
    return folders | {"none": tmp_path / "none"}


def run_workers(count, folders, monkeypatch):
    """{name of a folder: [operators, warnings, whether the answers are torch's] of each worker}, in a new process."""
    monkeypatch.delenv("DHTORCH_OPS", raising=False)
    program = Path(__file__).parents[1] / "support" / "library_workers.py"
    command = [sys.executable, str(program), str(count), *map(str, folders.values())]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    return dict(zip(folders, map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked")
def test_every_worker_of_a_loader_takes_a_sound_library_and_leaves_another(cache, tmp_path, monkeypatch):
    found = run_workers(3, spoiled_copies(cache, tmp_path), monkeypatch)
    compiled = f"compiled {loader.level()}"
    assert found["sound"] == [[compiled, [], True]] * 3 and found["none"] == [["torch", [], True]] * 3
    for name in ("changed", "cut", "foreign", "no manifest"):
        for operators, heard, same in found[name]:
            assert operators == "torch" and same and len(heard) == 1, name
            assert "(torch is used)" in heard[0] and loader.COMMAND in heard[0], name


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked")
def test_workers_that_start_while_the_library_is_replaced_have_a_whole_one(cache, tmp_path, monkeypatch):
    """A build renames the manifest and then the library, again and again, here with a file of other bytes."""
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    path = copy_of(cache, tmp_path / "copy")
    variants = [path.read_bytes(), path.read_bytes() + bytes(8)]
    stop, replaced = threading.Event(), []

    def replace():
        while not stop.is_set():
            new = write(path.with_name("new.so"), variants[len(replaced) % 2])
            note = path.with_name("new.json")
            note.write_text(json.dumps({"sha256": loader.checksum(new)}))
            note.replace(loader.manifest(path))
            time.sleep(0.01)
            new.replace(path)
            replaced.append(time.monotonic())
            time.sleep(0.6)

    thread = threading.Thread(target=replace)
    thread.start()
    try:
        found = run_workers(4, {str(k): path.parent for k in range(6)}, monkeypatch)
    finally:
        stop.set()
        thread.join()
    assert len(replaced) >= 3
    assert [row for rows in found.values() for row in rows] == [[f"compiled {loader.level()}", [], True]] * 24


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="the compiler of this test is a shell script")
def test_builds_of_several_processes_at_once_leave_one_whole_library(cache, tmp_path, monkeypatch):
    """Beside them workers start; the compiler here copies a library, slowly."""
    monkeypatch.setenv("DHTORCH_CACHE", str(cache))
    sound = loader.library()
    script = tmp_path / "c++"
    script.write_text(
        f"""#!/bin/sh
sleep 0.1
link=no
while [ $# -gt 0 ]; do
  case "$1" in -shared) link=yes;; -o) out="$2";; esac
  shift
done
if [ $link = yes ]; then dd if={sound} of="$out" bs=65536 2>/dev/null; else : > "$out"; fi
"""
    )
    script.chmod(0o755)
    monkeypatch.setenv("CXX", str(script))
    folder = tmp_path / "cache"
    copy_of(cache, folder)
    damage(folder / sound.name)  # so that each process compiles again
    monkeypatch.setenv("DHTORCH_CACHE", str(folder))
    builds = [
        subprocess.Popen([sys.executable, "-m", "dhtorch.ops"], stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    heard = [build.communicate(timeout=300)[0] for build in builds]
    assert [build.returncode for build in builds] == [0, 0, 0] and all(sound.name in text for text in heard)
    path = folder / sound.name
    assert loader.problem(path) is None and path.read_bytes() == sound.read_bytes()
    assert {*folder.iterdir()} == {path, loader.manifest(path)}, "nothing unfinished stays"
    assert run_workers(2, {"built": folder}, monkeypatch) == {"built": [[f"compiled {loader.level()}", [], True]] * 2}


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="the administrator may write everywhere")
def test_a_cache_without_permission_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir(mode=0o500)
    with pytest.raises(OSError, match=r"cache: no permission to write .*; set DHTORCH_CACHE"):
        builder.build()


@needs_compiler
def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path / "cache"))

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(builder.tempfile, "TemporaryDirectory", refuse)
    with pytest.raises(OSError, match=r"cache: no permission to write .*; set DHTORCH_CACHE"):
        builder.build()


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="levels are those of x86-64")
def test_a_torch_held_to_narrower_vectors_has_a_file_of_its_own(monkeypatch):
    files = set()
    for capability, level in loader.LEVELS.items():
        monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda word=capability: word)
        assert loader.level() == level and level in loader.library().name
        files.add(loader.library())
    assert len(files) == len(loader.levels()) == 3
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "another")
    assert loader.level() == "x86-64-v2"


def test_another_torch_shares_the_file(monkeypatch):
    before = loader.library()
    monkeypatch.setattr(torch, "__version__", "2.11.1")
    assert loader.library() == before


@pytest.mark.parametrize("machine", ["aarch64", "arm64"])
def test_a_processor_without_levels_has_one_file(monkeypatch, machine):
    before = loader.library()
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert loader.levels() == (machine,) and loader.library() != before and machine in loader.library().name


def test_a_torch_that_is_too_old_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path))
    for old in ("2.5.1+cpu", "2.9.0a0+git1"):
        monkeypatch.setattr(torch, "__version__", old)
        for call in (builder.build, loader.load):
            with pytest.raises(OSError, match=rf"found torch {re.escape(old)}, expected at least 2\.10"):
                call()
        monkeypatch.delenv("DHTORCH_OPS", raising=False)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert not dispatch.is_in_use(), "the reference computes, without a warning"
    assert not list(tmp_path.iterdir())


def test_the_command_says_what_it_does_and_takes_no_options():
    for option, code in (("--help", 0), ("--fast", 2)):
        asked = [sys.executable, "-m", "dhtorch.ops", option]
        said = subprocess.run(asked, capture_output=True, text=True, check=False)
        assert said.returncode == code and loader.COMMAND in said.stdout


def test_a_compiler_that_is_missing_or_fails_is_reported(tmp_path, monkeypatch):
    monkeypatch.setenv("DHTORCH_CACHE", str(tmp_path))
    monkeypatch.setenv("CXX", "no-such-compiler-7")
    asked = [sys.executable, "-m", "dhtorch.ops"]
    said = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert said.returncode == 2 and "no-such-compiler-7: no such C++ compiler" in said.stderr
    if shutil.which("false"):
        monkeypatch.setenv("CXX", "false --kind")
        with pytest.raises(OSError, match=r"false --kind .*exit code 1"):
            builder.build()
        assert not list(tmp_path.iterdir())
