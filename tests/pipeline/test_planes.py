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


def slanted(a=5e-4, b=-3e-4, c=0.3):
    """Depth (1, h, w) of a plane, exactly."""
    v, u = torch.meshgrid(*(torch.arange(n).double() for n in HW), indexing="ij")
    return (1 / (a * u + b * v + c)).float()[None]


def square(top=40, bottom=80, left=50, right=100):
    hole = torch.zeros(1, *HW, dtype=torch.bool)
    hole[:, top:bottom, left:right] = True
    return hole


def sparse_pixels(seed):
    return torch.rand(1, *HW, generator=torch.Generator().manual_seed(seed)) > 0.25


U = torch.arange(HW[1]).expand(1, *HW)
PLANE, HOLE, ALL, NONE = slanted(), square(), torch.ones(1, *HW, dtype=torch.bool), square(0, 0)
STEP = torch.where(U < 75, 2.0, 3.0).expand(1, *HW)
LEAVING = slanted(a=-2e-3, b=0.0, c=0.6)  # a surface that leaves the reach to the right
NOISE = torch.rand(1, HW[0] // 8, HW[1] // 8, generator=torch.Generator().manual_seed(2))
NOISE = NOISE.repeat_interleave(8, 1).repeat_interleave(8, 2)
SPARSE = torch.ones(1, dtype=torch.bool)


def swept(depth, silent, sigma_rel=0.02):
    nan = torch.full_like(depth, torch.nan)
    return DepthMap(
        depth=torch.where(silent, nan, depth),
        sigma=torch.where(silent, nan, sigma_rel * depth),
        score=torch.where(silent, 0.0, 0.8),
        source=torch.where(silent, Source.NONE, Source.SWEPT).int(),
        gate=torch.where(silent, Gate.NO_TRACK, Gate.ANSWER).int(),
    )


def filled(depth, silent, grey=None, reach=0.5, usable=NONE, support=None, sparse=None, **options):
    grey = torch.full_like(depth, 0.5) if grey is None else grey
    before, zero = swept(depth, silent), torch.zeros_like(depth)
    usable = usable.expand_as(silent)
    returns = SensorReturns(torch.where(usable, depth, zero), torch.where(usable, 0.01 * depth, zero), zero + 1, usable)
    at = before if support is None else support, returns, grey[:, None], torch.full((len(depth),), reach)
    return fill_planes(before, *at, sparse=sparse, options=replace(DenseOptions(), **options))


@pytest.mark.parametrize(
    ("depth", "silent", "options", "pixels", "at_least", "at_most"),
    [
        (PLANE, HOLE, {}, HOLE, 1, 1),
        (PLANE, sparse_pixels(0), {}, ALL, 0.75, 1),
        (PLANE, ALL, {"support": swept(PLANE, sparse_pixels(1))}, ALL, 0.75, 1),
        (PLANE, ALL, {}, ALL, 0, 0),
        (PLANE, ~square(60, 76, 80, 96), {}, ~square(60, 76, 80, 96), 0, 0),
        (PLANE, U >= 80, {}, U >= 88, 0, 0),
        (PLANE, HOLE, {"grey": NOISE}, HOLE, 0, 0.02),
        (PLANE, HOLE, {"max_sigma_rel": 0.005}, HOLE, 0, 0),
        (PLANE, HOLE, {"reach": 6.0}, HOLE, 0, 0),
        (PLANE, HOLE, {"reach": 6.0, "max_refuted_rays": 1.0}, HOLE, 0, 0),
        (PLANE, HOLE, {"reach": 6.0, "sparse": SPARSE}, HOLE, 1, 1),
        (PLANE, HOLE | (U < 75), {"usable": (U < 75) & ~HOLE}, HOLE, 1, 1),
        (PLANE, HOLE | (U < 75), {"usable": (U < 75) & ~HOLE}, (U < 75) & ~HOLE, 0, 0),
        (PLANE, ALL, {"usable": ~HOLE}, ALL, 0, 0),
        (STEP, HOLE, {}, square(56, 64, 72, 80), 0, 0),
        (
            LEAVING,
            square(left=64) | (U < 64),
            {"usable": U < 64, "reach": 2.2},
            square(left=64) & (LEAVING > 2.2),
            0.6,
            1,
        ),
    ],
)
def test_a_plane_is_filled_exactly_where_it_is_known_and_nowhere_else(
    depth, silent, options, pixels, at_least, at_most
):
    """Share of the pixels that is answered; those that were answered before keep their bits."""
    before, after = swept(depth, silent), filled(depth, silent, **options)
    assert at_least <= float(after.keep[pixels].float().mean()) <= at_most
    new = after.keep & silent
    assert (after.source[new] == Source.FILLED).all() and (after.gate[new] == Gate.ANSWER).all()
    for name in ("depth", "sigma", "score", "source", "gate"):
        assert torch.equal(getattr(before, name)[~silent], getattr(after, name)[~silent]), name
    if depth is not STEP:
        torch.testing.assert_close(after.depth[new], depth[new], rtol=2e-5, atol=0)
    share = (after.sigma / after.depth)[new]
    torch.testing.assert_close(after.score[new], 0.1 / (0.1 + share))
    error = (after.depth - depth).abs()[new]
    assert (share > 0.005).all() and (error > 2 * after.sigma[new]).float().sum() <= 0.05 * len(error)


def test_a_few_wrong_answers_change_nothing():
    wrong = PLANE.clone()
    wrong[:, 32:40, 50:66] *= 2
    middle = square(top=50, bottom=70, left=70, right=90)
    torch.testing.assert_close(filled(wrong, HOLE).depth[middle], PLANE[middle], rtol=1e-3, atol=0)


def test_an_edge_of_grey_ends_the_support():
    grey = torch.where(square(top=24, bottom=96, left=32, right=120), 0.3, 0.7)
    found = filled(torch.where(grey > 0.5, 3 * PLANE, PLANE), HOLE, grey=grey)
    both = filled(PLANE, HOLE, grey=grey).keep & HOLE
    assert both.any()
    torch.testing.assert_close(found.depth[both], PLANE[both], rtol=2e-5, atol=0)


def test_sigma_grows_away_from_the_support():
    hole = square(left=0, right=56)
    after = filled(PLANE, hole, max_plane_sigma_rel=0.03)
    share = (after.sigma / after.depth)[0, 60]
    assert bool(after.keep[hole].all()) and float(share[0]) > 1.2 * float(share[40])
    assert bool((share[8:16].diff() < 0).all())  # within a cell too


def test_sigma_is_that_of_the_errors():
    noise = torch.randn(24, 1, 5, 5, generator=torch.Generator().manual_seed(3))
    noisy = PLANE * (1 + 0.03 * noise.repeat_interleave(24, 2).repeat_interleave(32, 3)[:, 0])
    after = filled(noisy, HOLE.expand(24, -1, -1))
    inside = after.keep & HOLE
    z = ((after.depth - PLANE) / after.sigma)[inside]
    within_1, within_3 = (float((z.abs() < k).float().mean()) for k in (1, 3))
    assert inside.sum() > 1000 and within_1 > 0.6 and within_3 > 0.98 and float(z.abs().median()) > 0.1


def test_the_gradient_reaches_the_support():
    depth = PLANE.double().requires_grad_()
    after = filled(depth, HOLE)
    (gradient,) = torch.autograd.grad(after.depth[0, 60, 75], depth)
    assert not bool(gradient[HOLE].any()) and int((gradient != 0).sum()) > 500
    # the depth of a plane grows with that of its support: sum of gradient times depth is the depth (Euler)
    assert float((gradient * depth).detach().sum()) == pytest.approx(float(after.depth[0, 60, 75].detach()), rel=1e-6)


def test_silence_before_a_foreground_refutes_a_plane_to_the_background():
    beyond, left = HOLE & (LEAVING > 2.25), U < 50
    bridged, refuted = (
        float(filled(LEAVING, HOLE | left, usable=left, reach=2.2, **more).keep[beyond].float().mean())
        for more in ({"max_refuted_rays": 1.0}, {})
    )
    assert bridged > 0.9 and refuted < 0.5 * bridged


def test_a_step_needs_a_majority_and_widens_sigma():
    loose = {"max_plane_disagreement": 1.0, "max_plane_sigma_rel": 0.03}
    some, all_ = (filled(STEP, HOLE, **loose, min_plane_share=share) for share in (0.8, 0.2))
    assert int(some.keep.sum()) < int(all_.keep.sum())
    beside = all_.keep & square(left=64, right=88)
    assert float((all_.sigma / all_.depth)[beside].median()) > 0.04


def test_few_cells_are_no_support():
    silent = torch.ones_like(ALL)
    silent[:, 24:96:24, 24:136:24] = False  # one pixel of a cell each
    few = {"min_cell_pixels": 1, "max_plane_sigma_rel": 0.1, "max_plane_disagreement": 1.0}
    sets = [int(filled(PLANE, silent, min_plane_support=n, **few).keep.sum()) for n in (4, 40)]
    assert sets[0] > sets[1] == int((~silent).sum())
