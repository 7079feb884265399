"""What speaks for or against a depth map, each kind by itself, on answers and views made by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from dhtorch.codes import Flag, Gate
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.camera import Camera
from dhtorch.pipeline.surface import SourceView
from dhtorch.records import Estimate, Samples
from dhtorch.validation import evidence
from dhtorch.validation.evidence import (
    ValidationReferences,
    depth_consistency_evidence,
    inflate_sigma,
    photometric_evidence,
    resolution_sigma,
    sparse_evidence,
    triangulated_depth,
    validation_references,
)
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS

HW = (24, 32)


def told(uv, depth, sigma=0.01, shared=0.0, near=False):
    """Answers at pixels (N, 2) of a picture of ``HW``."""
    uv = torch.tensor(uv, dtype=torch.float32)[None]
    full = [torch.as_tensor(x, dtype=torch.float32).expand(1, uv.shape[1]) for x in (depth, sigma, shared)]
    return ValidationReferences(
        uv, *full, used=torch.ones_like(full[0], dtype=torch.bool), near=torch.full_like(full[0], near) > 0
    )


def a_view(t, use=True):
    """A source view that stands ``t`` m beside, and the grid."""
    camera = Camera(torch.tensor([[40.0, 40.0]]), torch.tensor([[15.5, 11.5]]))
    picture = torch.rand(1, 1, *HW, generator=torch.Generator().manual_seed(0))
    T = se3.exp(torch.tensor([[0.0, 0.0, 0.0, *t]]))
    return plane_sweep.make_reference_view(picture, camera), SourceView(
        plane_sweep.SweptView(picture, camera, T), picture.expand(-1, 3, -1, -1), None, torch.tensor([use])
    )


def test_what_a_return_says_is_not_said_again_by_an_answer():
    uv = torch.tensor([[[3.0, 3.0], [9.0, 9.0]]])
    zero, two = torch.zeros(1, 2), torch.tensor([[1.0, 2.0]])
    flag = torch.tensor([[0, Flag.BEYOND_NEAR]]).int()
    samples = Samples(
        uv, two, 0.01 * two, torch.tensor([[[1.0] * 3, [torch.nan] * 3]]), zero + 1, flag, zero + 1, zero.int()
    )
    answers = Estimate.unanswered(samples, Gate.ANSWER, n_views=2)
    answers = answers.replace(depth=3 * two, sigma=0.1 * two, sigma_shared=0.05 * two)
    found = validation_references(samples, answers, near=True)
    assert found.depth.tolist() == [[1.0, 6.0]]
    assert found.near.tolist() == [[True, False]]
    assert found.shared[0, 0] == 0, "a return shares no motion"
    assert found.shared[0, 1] > 0


def test_answers_that_disagree_are_as_unsure_as_they_disagree():
    flat = torch.full((1, *HW), 2.0)
    alike = sparse_evidence(flat, HW, told([[10, 10], [14, 10]], [1.5, 1.5]), 0.02)
    apart = sparse_evidence(flat, HW, told([[10, 10], [14, 10]], [1.2, 1.9]), 0.02)
    assert alike.misfit[0, 10, 12] == pytest.approx(math.log(2 / 1.5) / math.hypot(0.01, 0.02), rel=1e-3)
    middle = 0.5 * (math.log(2 / 1.2) + math.log(2 / 1.9))
    spread = 0.5 * (math.log(2 / 1.2) - math.log(2 / 1.9))
    assert apart.misfit[0, 10, 12] == pytest.approx(middle / math.sqrt(0.01**2 + 0.02**2 + spread**2), rel=1e-3)
    assert alike.sure[0, 10, 12] and not apart.sure[0, 10, 12]


def test_a_reference_counts_on_its_own_surface_of_the_map():
    step = torch.ones(1, *HW)
    step[..., 16:] = 3.0
    found = sparse_evidence(step, HW, told([[15, 10]], 1.0), 0.02).misfit
    assert found[0, 10, 14] == found[0, 10, 15] == 0 and found[..., 16:].isnan().all()


def test_a_reference_is_as_unsure_as_the_map_is_loose_there():
    loose = torch.zeros(1, 12, 16)
    loose[0, 5, 5] = 0.03
    found = inflate_sigma(told([[10.5, 10.5], [20, 20]], 2.0, sigma=0.04), loose, HW)
    torch.testing.assert_close(found.sigma, torch.tensor([[0.05, 0.04]]))


STEP = torch.tensor([[[1.0, 1.0, 3.0, 3.0]]]).expand(1, 2, 4)
HOLED = torch.where(torch.arange(4) == 2, 0.0, STEP)  # a step to no value is none
EXTENT = math.log(3) * torch.tensor([0, 0, 0, 0.25, 0.25, 0, 0, 0]).sqrt()


@pytest.mark.parametrize(
    ("depth", "hw", "extent"),
    [
        (STEP, (2, 4), 0.0),  # as fine as its grid
        (STEP, (1, 2), 0.0),  # finer
        (STEP.mT, (2, 4), 0.0),  # finer down, and coarser across, without a step there
        (HOLED, (4, 8), 0.0),
        (STEP, (4, 8), EXTENT),
    ],
)
def test_the_extent_of_a_pixel_is_how_far_the_next_one_may_be_true(depth, hw, extent):
    torch.testing.assert_close(resolution_sigma(depth, hw), torch.as_tensor(extent).expand(1, *hw))


def test_of_several_views_the_mildest_counts_and_a_pixel_without_a_depth_has_none(monkeypatch):
    base, source_view = a_view((0.1, 0, 0))
    misfit = {0: 5.0, 1: -2.0, 2: 4.0, 3: 0.5}
    of_view = lambda q, base, p, tolerance, options: (torch.full_like(q, misfit[p.fit]), q > 0)  # noqa: E731
    monkeypatch.setattr(evidence, "_view_evidence", of_view)
    views = [source_view._replace(fit=k) for k in range(3)] + [source_view._replace(fit=3, use=torch.tensor([False]))]
    holed = torch.full((1, *HW), 2.0)
    holed[0, 10, 10] = 0
    found = photometric_evidence(holed, base, views, 0.02)
    assert (found.misfit[holed > 0] == -2).all() and (found.view[holed > 0] == 1).all()
    assert found.misfit[0, 10, 10].isnan()


def test_the_best_of_other_depths_is_named_with_its_factor(monkeypatch):
    q = torch.full((1, *HW), 0.5)
    likes = dict.fromkeys(DEFAULT_VALIDATION_OPTIONS.rival_factors, 0.1) | {0.58: 0.95, 1.14: 0.6}

    def fit(base, view, picture, at, *, radius):
        value = likes[min(likes, key=lambda k: abs(k - float(at[0, 0, 0]) / 0.5))]
        return SimpleNamespace(correlation=torch.full_like(at, value), seen=torch.ones_like(at) > 0)

    monkeypatch.setattr(plane_sweep, "fit_windows", fit)
    base, source_view = a_view((0.1, 0, 0))
    best, factor, beside = evidence._rivals(q, base, source_view, DEFAULT_VALIDATION_OPTIONS)
    assert best[0, 5, 5] == pytest.approx(0.95)
    assert factor[0, 5, 5] == pytest.approx(0.58)
    assert beside[0, 5, 5] == pytest.approx(
        0.95
        if 0.7 * DEFAULT_VALIDATION_OPTIONS.detectable_log_ratio
        < -math.log(0.58)
        < 3 * DEFAULT_VALIDATION_OPTIONS.detectable_log_ratio
        else 0.6
    )


def test_what_another_view_does_not_see_it_says_nothing_of():
    """The right edge of the picture leaves the other view's field."""
    base, source_view = a_view((0.4, 0, 0))
    pose = SimpleNamespace(
        cov=1e-8 * torch.eye(6)[None], shutter=None, ok=torch.tensor([True]), T_1_from_0=source_view.view.T_1_from_0
    )
    misfit, sure = evidence._view_evidence(
        torch.full((1, *HW), 1.0), base, source_view._replace(fit=pose), 0.02, DEFAULT_VALIDATION_OPTIONS
    )
    assert misfit[0, :, -10:].isnan().all()
    assert not sure[0, :, -10:].any()


def test_windows_that_fit_say_nothing_where_the_lens_knows_no_ray(monkeypatch):
    base, source_view = a_view((0.1, 0, 0))
    pose = SimpleNamespace(
        cov=1e-8 * torch.eye(6)[None], shutter=None, ok=torch.tensor([True]), T_1_from_0=source_view.view.T_1_from_0
    )
    like = torch.full((1, *HW), 0.5)
    window = SimpleNamespace(
        seen=like > 0, correlation=like * 0 + 0.99, noise=like * 1e-6, contrast=like, step=like * 0.1,
        motion=torch.full((1, *HW, 2), 4.0),
    )  # fmt: skip
    monkeypatch.setattr(plane_sweep, "fit_windows", lambda *args, **options: window)
    monkeypatch.setattr(evidence, "_rivals", lambda *args: (like * 0 + 0.1, like * 0 + 1.14, like * 0 + 0.1))
    known = torch.ones(1, *HW, dtype=torch.bool)
    known[0, :, :5] = False
    misfit, sure = evidence._view_evidence(
        like, base.replace(known=known.flatten(1)), source_view._replace(fit=pose), 0.02, DEFAULT_VALIDATION_OPTIONS
    )
    assert misfit[known].isfinite().all()
    assert sure[known].all()
    assert misfit[~known].isnan().all()
    assert not sure[~known].any()


def test_maps_speak_only_between_views_that_stand_apart():
    """A surface in front of what the other view's map shows: one of the two is wrong, if the views tell depths apart."""
    near, far = torch.full((1, *HW), 1.0), torch.full((1, *HW), 3.0)
    base, apart = a_view((0.6, 0, 0))
    found = depth_consistency_evidence(near, base, [apart], [far], 0.02)
    known = found.misfit.isfinite()
    assert known.any()
    assert (found.misfit[known] < -3).all()
    assert not found.sure.any()
    base, same = a_view((1e-4, 0, 0))
    assert not depth_consistency_evidence(near, base, [same], [far], 0.02).misfit.isfinite().any()
    assert not depth_consistency_evidence(far, base, [apart], [near], 0.02).misfit.isfinite().any(), (
        "what lies behind may be hidden"
    )


def test_a_batch_of_maps_is_judged_member_by_member():
    draw = torch.Generator().manual_seed(3)
    maps = [1 + k + torch.rand(1, *HW, generator=draw).cumsum(-1) / 9 for k in range(3)]
    points = [
        told((torch.rand(12, 2, generator=draw) * torch.tensor([31.0, 23.0])).tolist(), 1.2 + k, 0.01 + 0.02 * k)
        for k in range(3)
    ]
    batch = ValidationReferences(*(torch.cat(part) for part in zip(*points, strict=True)))
    together = sparse_evidence(torch.cat(maps), HW, batch, 0.02)
    depths = triangulated_depth(torch.cat(maps), HW, batch)
    for k in range(3):
        alone = sparse_evidence(maps[k], HW, points[k], 0.02)
        for name in ("misfit", "sure", "view"):
            a, b = (getattr(x, name)[i] for x, i in ((together, k), (alone, 0)))
            torch.testing.assert_close(a, b, equal_nan=True)
        torch.testing.assert_close(depths[k], triangulated_depth(maps[k], HW, points[k])[0], equal_nan=True)
        assert alone.misfit.isfinite().any() and depths[k].isfinite().any()
