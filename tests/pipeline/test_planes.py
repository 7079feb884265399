"""Planes through what surrounds a surface without texture: exact where it is one, silent or unsure where it is not."""

from dataclasses import replace

import pytest
import torch

from dhtorch.codes import Gate, Source
from dhtorch.pipeline.dense_options import DenseOptions
from dhtorch.pipeline.map_filters import SensorReturns
from dhtorch.pipeline.planes import fill_planes
from dhtorch.records import DepthMap

HW = (120, 160)


def slanted(hw=HW, a=5e-4, b=-3e-4, c=0.3):
    """Depth (1, h, w) of a plane, exactly."""
    v, u = torch.meshgrid(*(torch.arange(n).double() for n in hw), indexing="ij")
    return (1 / (a * u + b * v + c)).float()[None]


def square(hw=HW, top=40, bottom=80, left=50, right=100):
    hole = torch.zeros(1, *hw, dtype=torch.bool)
    hole[:, top:bottom, left:right] = True
    return hole


def swept(depth, silent, sigma_rel=0.02):
    nan = torch.full_like(depth, torch.nan)
    return DepthMap(
        depth=torch.where(silent, nan, depth),
        sigma=torch.where(silent, nan, sigma_rel * depth),
        score=torch.where(silent, 0.0, 0.8),
        source=torch.where(silent, Source.NONE, Source.SWEPT).int(),
        gate=torch.where(silent, Gate.NO_TRACK, Gate.ANSWER).int(),
    )


def returned(depth, usable):
    zero = torch.zeros_like(depth)
    return SensorReturns(torch.where(usable, depth, zero), torch.where(usable, 0.01 * depth, zero), zero + 1, usable)


def filled(depth, silent, grey=None, reach=0.5, usable=None, support=None, **options):
    grey = torch.full_like(depth, 0.5) if grey is None else grey
    before = swept(depth, silent)
    usable = torch.zeros_like(silent) if usable is None else usable
    sparse = options.pop("sparse", None)
    reach = torch.full((len(depth),), reach)
    support = before if support is None else support
    returns = returned(depth, usable)
    return fill_planes(
        before, support, returns, grey[:, None], reach, sparse=sparse, options=replace(DenseOptions(), **options)
    )


def test_a_plane_without_texture_is_filled_exactly():
    depth, hole = slanted(), square()
    after = filled(depth, hole)
    torch.testing.assert_close(after.depth, depth, rtol=2e-5, atol=0)
    assert bool((after.source[hole] == Source.FILLED).all()) and bool((after.gate[hole] == Gate.ANSWER).all())
    assert bool((after.source[~hole] == Source.SWEPT).all())
    share = after.sigma[hole] / after.depth[hole]
    torch.testing.assert_close(after.score[hole], 0.1 / (0.1 + share))
    assert bool((share > 0.005).all()) and bool((share < 0.03).all())


def test_answered_pixels_keep_their_bits():
    depth, hole = slanted(), square()
    before, after = swept(depth, hole), filled(depth, hole)
    for name in ("depth", "sigma", "score", "source", "gate"):
        assert torch.equal(getattr(before, name)[~hole], getattr(after, name)[~hole])


def test_scattered_answers_support_a_plane():
    depth = slanted()
    silent = torch.rand(1, *HW, generator=torch.Generator().manual_seed(0)) > 0.25
    after = filled(depth, silent)
    torch.testing.assert_close(after.depth[after.keep], depth[after.keep], rtol=2e-5, atol=0)
    assert float(after.keep.float().mean()) > 0.75


def test_what_the_filters_made_silent_supports_a_plane():
    depth = slanted()
    specks = torch.rand(1, *HW, generator=torch.Generator().manual_seed(1)) > 0.25
    silent = torch.ones_like(specks)
    assert not bool(filled(depth, silent).keep.any())
    after = filled(depth, silent, support=swept(depth, specks))
    assert float(after.keep.float().mean()) > 0.75 and bool((after.source[after.keep] == Source.FILLED).all())


def test_a_few_wrong_answers_change_nothing():
    depth, hole = slanted(), square()
    wrong = depth.clone()
    wrong[:, 32:40, 50:66] *= 2
    after = filled(wrong, hole)
    middle = square(top=50, bottom=70, left=70, right=90)
    torch.testing.assert_close(after.depth[middle], depth[middle], rtol=1e-3, atol=0)


def test_a_step_under_one_grey_value_is_silent_or_unsure():
    depth = torch.full((1, *HW), 2.0)
    depth[..., 75:] = 3.0
    hole = square()
    after = filled(depth, hole)
    error = (after.depth - depth).abs()[after.keep & hole]
    assert not bool(after.keep[:, 56:64, 72:80].any())
    assert float((error > 2 * after.sigma[after.keep & hole]).float().mean() if error.numel() else 0.0) < 0.05


def test_texture_is_no_weak_texture():
    depth, hole = slanted(), square()
    grey = torch.rand(1, HW[0] // 8, HW[1] // 8, generator=torch.Generator().manual_seed(2))
    grey = grey.repeat_interleave(8, 1).repeat_interleave(8, 2)
    assert float(filled(depth, hole, grey=grey).keep[hole].float().mean()) < 0.02


def test_an_edge_of_grey_ends_the_support():
    depth, hole = slanted(), square()
    grey = torch.where(square(top=24, bottom=96, left=32, right=120), 0.3, 0.7)
    near = filled(depth, hole, grey=grey)
    far = filled(torch.where(grey > 0.5, 3 * depth, depth), hole, grey=grey)
    assert bool(near.keep[hole].any())
    both = near.keep & hole
    torch.testing.assert_close(far.depth[both], depth[both], rtol=2e-5, atol=0)


def test_without_support_all_is_silent():
    depth, none = slanted(), torch.ones(1, *HW, dtype=torch.bool)
    assert not bool(filled(depth, none).keep.any())
    none[:, 60:76, 80:96] = False
    assert int(filled(depth, none).keep.sum()) == 256


def test_sigma_grows_away_from_the_support_until_the_plane_ends():
    depth, hole = slanted(), square(top=40, bottom=80, left=0, right=56)
    after = filled(depth, hole, max_plane_sigma_rel=0.03)
    share = (after.sigma / after.depth)[0, 60]
    assert bool(after.keep[hole].all()) and float(share[0]) > 1.2 * float(share[40])
    assert bool((share[8:16].diff() < 0).all())  # within a cell too
    open_side = torch.arange(HW[1]).expand(1, *HW) >= 80
    assert not bool(filled(depth, open_side).keep[..., 88:].any())


def test_sigma_is_that_of_the_errors():
    depth, hole = slanted(), square()
    noise = torch.randn(24, 1, 5, 5, generator=torch.Generator().manual_seed(3))
    noisy = depth * (1 + 0.03 * noise.repeat_interleave(24, 2).repeat_interleave(32, 3)[:, 0])
    after = filled(noisy, hole.expand(24, -1, -1))
    inside = after.keep & hole
    z = ((after.depth - depth) / after.sigma)[inside]
    within_1, within_3 = (float((z.abs() < k).float().mean()) for k in (1, 3))
    assert inside.sum() > 1000 and within_1 > 0.6 and within_3 > 0.98
    assert float(z.abs().median()) > 0.1


def test_the_sensors_silence_refutes_a_plane_within_its_reach():
    depth, hole = slanted(), square()
    assert not bool(filled(depth, hole, reach=6.0).keep[hole].any())
    assert not bool(filled(depth, hole, reach=6.0, max_refuted_rays=1.0).keep[hole].any())
    sparse = torch.ones(1, dtype=torch.bool)
    assert bool(filled(depth, hole, reach=6.0, sparse=sparse).keep[hole].all())


def test_returns_support_planes_but_not_alone():
    depth, hole = slanted(), square()
    left = torch.arange(HW[1]).expand(1, *HW) < 75
    after = filled(depth, hole | left, usable=left & ~hole)
    torch.testing.assert_close(after.depth[hole], depth[hole], rtol=2e-5, atol=0)
    assert not bool((after.keep & left & ~hole).any())
    assert not bool(filled(depth, torch.ones_like(hole), usable=~hole).keep.any())


def test_an_unsure_plane_is_silent():
    depth, hole = slanted(), square()
    assert not bool(filled(depth, hole, max_sigma_rel=0.005).keep[hole].any())


def test_the_gradient_reaches_the_support():
    depth, hole = slanted().double().requires_grad_(), square()
    after = filled(depth, hole)
    filled_depth = after.depth[0, 60, 75].detach()
    (gradient,) = torch.autograd.grad(after.depth[0, 60, 75], depth)
    assert not bool(gradient[hole].any()) and int((gradient != 0).sum()) > 500
    # the depth of a plane grows with that of its support: sum of gradient times depth is the depth (Euler)
    assert float((gradient * depth).sum()) == pytest.approx(float(filled_depth), rel=1e-6)
    assert not after.sigma[hole].requires_grad or not bool(
        torch.autograd.grad(after.sigma[hole].sum(), depth, allow_unused=True)[0][hole].any()
    )


def test_silence_before_a_foreground_refutes_a_plane_to_the_background():
    depth, hole = slanted(a=-2e-3, b=0.0, c=0.6), square()
    left = (torch.arange(HW[1]) < 50).expand(1, *HW)
    beyond = hole & (depth > 2.25)
    bridged = filled(depth, hole | left, usable=left, reach=2.2, max_refuted_rays=1.0)
    refuted = filled(depth, hole | left, usable=left, reach=2.2)
    assert float(bridged.keep[beyond].float().mean()) > 0.9
    assert float(refuted.keep[beyond].float().mean()) < 0.5 * float(bridged.keep[beyond].float().mean())


def test_a_surface_that_leaves_the_sensors_reach_is_not_refuted():
    depth = slanted(a=-2e-3, b=0.0, c=0.6)
    returns = (torch.arange(HW[1]) < 64).expand(1, *HW)  # to the last cell within the reach
    hole = square(left=64, right=100)
    after = filled(depth, hole | returns, usable=returns, reach=2.2)
    assert float(after.keep[hole & (depth > 2.2)].float().mean()) > 0.6


def test_a_step_needs_a_majority_and_widens_sigma():
    depth = torch.full((1, *HW), 2.0)
    depth[..., 75:] = 3.0
    hole = square()
    loose = {"max_plane_disagreement": 1.0, "min_plane_share": 0.2, "max_plane_sigma_rel": 0.03}
    some, all_ = (filled(depth, hole, **{**loose, "min_plane_share": share}) for share in (0.8, 0.2))
    assert int(some.keep.sum()) < int(all_.keep.sum())
    beside = all_.keep & square(left=64, right=88)
    assert float((all_.sigma / all_.depth)[beside].median()) > 0.04


def test_few_cells_are_no_support():
    depth, silent = slanted(), torch.ones(1, *HW, dtype=torch.bool)
    silent[:, 24:96:24, 24:136:24] = False  # one pixel of a cell each
    few = {"min_cell_pixels": 1, "max_plane_sigma_rel": 0.1, "max_plane_disagreement": 1.0}
    sets = [int(filled(depth, silent, min_plane_support=n, **few).keep.sum()) for n in (4, 40)]
    assert sets[0] > sets[1] == int((~silent).sum())
