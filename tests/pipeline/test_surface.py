"""What a map of every pixel is made of: whose word counts, what makes it unsure, and when it is silent."""

import pytest
import torch
from support.board_scenes import Board, look

from dhtorch import MAP
from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.experiments.compare.dense_comparison import exact_pose_fit
from dhtorch.geometry import plane_sweep, se3
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense, surface
from dhtorch.pipeline.dense_options import DenseOptions
from dhtorch.pytree import collate, stack

NEAR, N = 2.0, 512
METHOD = MAP.replace(n=N)


@pytest.fixture(scope="module")
def scene():
    """A wall beyond the sensor between boards within its reach; the reference view, two other views, and what is known."""
    boards = [Board(1.5, x=(-9, -0.35), seed=7), Board(1.5, y=(0.42, 9), seed=8), Board(3.0, seed=2)]
    small = {"hw": (60, 80), "f": 70.0}
    frames = [look(boards, at, **small)[0] for at in ((0.0, 0.0, 0.0), (0.15, 0.02, 0.01), (-0.04, 0.01, 0.0))]
    reference, *others = (range_split(frame, NEAR) for frame in frames)
    fits = [exact_pose_fit(frames[0], frame, N) for frame in frames[1:]]
    cov = torch.diag(torch.tensor([1e-8] * 3 + [1e-6] * 3)).expand(1, 6, 6)
    estimates, samples = [], None
    for other, fit in zip(others, fits, strict=True):
        trace = {}
        estimates.append(METHOD(reference, other, fit=fit.replace(cov=cov), trace=trace))
        samples = trace["samples"]
    given = stack([fit.replace(cov=cov) for fit in fits])
    return reference, dense.SelectedViews(estimates[0], stack(others), stack(estimates), given, samples)


def mapped(scene, **options):
    reference, asked = scene
    with torch.no_grad():
        return dense.sweep_depth(reference, asked, **{"method": METHOD, "planes": 24, "source_views": 1, **options})


def only(asked, *views):
    """What was asked of some of the views alone."""
    at = torch.tensor(views)
    return asked._replace(frames=asked.frames[at], estimates=asked.estimates[at], fits=asked.fits[at])


def lost(asked, view, b=slice(None)):
    """The same with one view whose motion was not found."""
    code = asked.fits.code.clone()
    code[view, b] = PoseCode.TOO_FEW
    return asked._replace(fits=asked.fits.replace(code=code))


def equal(a, b):
    return all(
        torch.equal(getattr(a, k).nan_to_num(-1), getattr(b, k).nan_to_num(-1)) for k in ("depth", "sigma", "gate")
    )


def test_pixels_of_a_map_stand_for_what_they_cover(scene):
    reference, _ = scene
    uv = dense.map_pixel_centres(reference, (30, 40)).unflatten(0, (30, 40))
    assert uv[0, 0].tolist() == [0.5, 0.5] and uv[29, 39].tolist() == [78.5, 58.5] and uv[0, 1].tolist() == [2.5, 0.5]
    picture, camera = dense.downscale_grey(reference, 40)
    torch.testing.assert_close(picture[0, 0, 3, 5], reference.image[0, 0, 6:8, 10:12].mean())
    torch.testing.assert_close(camera.c, (reference.camera.c + 0.5) / 2 - 0.5)


def test_a_few_returns_refute_no_motion(scene):
    reference, asked = scene
    fits = asked.fits.replace(T_1_from_0=asked.fits.T_1_from_0.replace(t=1.5 * asked.fits.T_1_from_0.t))
    wrong = asked._replace(fits=fits)
    refuted = mapped((reference, wrong))
    silent = refuted.gate[refuted.source == Source.NONE]
    assert not bool((refuted.source == Source.SWEPT).any()) and bool((silent == Gate.CONTRADICTED).any())
    few = torch.zeros_like(reference.depth)
    few[:, 10:14, :30] = reference.depth[:, 10:14, :30]
    assert 20 < int((few > 0).sum()) < DenseOptions.min_overlap_pixels
    assert bool((mapped((reference.replace(depth=few), wrong)).source == Source.SWEPT).any())


def test_what_moves_on_its_own_silences_every_pixel(scene):
    reference, asked = scene
    gate = torch.where(asked.joined.keep, Gate.CONTRADICTED, asked.joined.gate)
    found = mapped((reference, asked._replace(joined=asked.joined.replace(gate=gate))))
    assert set(found.gate[found.source != Source.SENSOR].tolist()) == {int(Gate.CONTRADICTED)}


def test_views_that_are_of_no_use_to_one_of_a_batch_say_nothing_of_it(scene):
    reference, asked = scene
    alone, both = mapped((reference, only(asked, 0))), mapped(scene, source_views=2)
    assert not equal(alone, both), "the second view says something"
    assert equal(mapped((reference, lost(asked, 1)), source_views=2), alone)
    twice = asked._replace(
        joined=collate([asked.joined] * 2),
        samples=collate([asked.samples] * 2),
        **{k: getattr(asked, k)[:, [0, 0]] for k in ("frames", "estimates", "fits")},
    )
    found = mapped((collate([reference] * 2), lost(twice, 1, 0)), source_views=2)
    assert equal(found[:1], alone) and equal(found[1:], both)


def test_what_a_motion_does_not_know_of_a_depth_is_its_derivative_along_the_line(scene):
    """How far the depth must go for a pixel to stay where it is seen, for each of six displacements of the pose."""
    reference, asked = scene
    base = plane_sweep.make_reference_view(*(x.to(torch.float64) for x in dense.downscale_grey(reference, 80)))
    view = dense.source_view_of(asked, torch.tensor([0]), 80, torch.tensor([True]), base.image).view.to(torch.float64)
    A = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cov, q = (A @ A.T)[None], torch.full((1, *base.hw), 0.3, dtype=torch.float64)
    little = 1e-6

    def seen(view, q):
        return plane_sweep.project_inverse_depth(view, base.ray, q.flatten(1))[0][0]

    motion = (seen(view, q + little) - seen(view, q)) / little
    rows = []
    for xi in little * torch.eye(6, dtype=torch.float64):
        T = se3.compose(se3.exp(xi[None]), view.T_1_from_0)
        rows.append(((seen(view.replace(T_1_from_0=T), q) - seen(view, q)) / little * motion).sum(-1))
    J = torch.stack(rows, -1) / motion.square().sum(-1, keepdim=True)
    fit = asked.fits[0].to(torch.float64).replace(cov=cov)
    found = surface.pose_variance(base, view, fit, q, motion.unflatten(0, base.hw)[None])
    torch.testing.assert_close(found.flatten(), ((J @ cov[0]) * J).sum(-1), rtol=1e-4, atol=0.0)
