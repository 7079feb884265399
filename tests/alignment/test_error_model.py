"""What may be wrong with a map, piece by piece: heads, fields, corrections, and what a fit does not know of them."""

import pytest
import torch

from dhtorch.alignment import error_model
from dhtorch.alignment.error_model import ERROR_MODELS, MODEL_HEADS, AlignmentProblem, ErrorModelFit
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS
from dhtorch.alignment.references import MetricReferences

HW = (6, 8)


def points(n=40, seed=0):
    g = torch.Generator().manual_seed(seed)
    share = torch.rand(1, n, 2, generator=g, dtype=torch.float64)
    x = 1 + 3 * torch.rand(1, n, generator=g, dtype=torch.float64)
    one = torch.ones_like(x)
    return MetricReferences(share, x, 0.1 * one, x, 1e-4 * one, 0 * one, one > 0, one > 0)


def basis(of_depth=True):
    x = torch.linspace(1, 4, 48, dtype=torch.float64).view(1, *HW)
    return error_model.make_basis(x, x > 0, of_depth=of_depth)


@pytest.mark.parametrize("of_depth", [True, False])
def test_a_head_gives_depth_or_its_inverse(of_depth):
    x, head = torch.tensor([0.5, 2.0, -9.0]).double(), torch.tensor([2.0, 1.0], dtype=torch.float64)
    log, slope = error_model.predict_log_depth(head, x, basis(of_depth))
    y = torch.tensor([2.0, 5.0, DEFAULT_ALIGNMENT_OPTIONS.min_head]).double()
    torch.testing.assert_close(log, y.log() * (1 if of_depth else -1))
    by_hand = torch.func.jacrev(lambda h: error_model.predict_log_depth(h, x, basis(of_depth))[0])(head)
    torch.testing.assert_close(slope[:2], by_hand[:2])


def test_a_map_of_one_value_has_a_correction_too():
    flat = torch.full((1, *HW), 2.0, dtype=torch.float64)
    found = error_model.make_basis(flat, flat > 0)
    assert (
        found.width.tolist() == [[1.0]]
        and error_model.evaluate_curves(found, torch.full((1, 3), 2.0).double()).isfinite().all()
    )


def test_short_fields_are_those_of_near_neighbours():
    where = torch.tensor([[[0.5, 0.5], [0.6, 0.5], [0.9, 0.9]]], dtype=torch.float64)
    found = error_model.evaluate_fields(basis(), where, torch.tensor([[False, True]]))
    assert found.shape[:3] == (1, 2, 3)
    torch.testing.assert_close(found[0, :, :, :2], (2 * where - 1).expand(2, -1, -1))
    kernel = found[0, :, :, error_model.N_TILT_SLOPES :] @ found[0, :, :, error_model.N_TILT_SLOPES :].mT
    torch.testing.assert_close(kernel.diagonal(dim1=-2, dim2=-1), torch.ones(2, 3).double(), atol=0.1, rtol=0)
    assert kernel[0, 0, 1] > kernel[1, 0, 1] > kernel[1, 0, 2] and kernel[0, 0, 2] > kernel[1, 0, 2]


def test_what_a_fit_does_not_know_is_carried_to_the_anchors():
    references, of = points(), basis()
    size = error_model.N_TILT_SLOPES + len(of.node) + error_model.N_CURVE_KNOTS
    head = torch.tensor([[[1.5, 0.2]]], dtype=torch.float64)
    spread = torch.zeros(1, 1, 2 + size, 2 + size, dtype=torch.float64)
    spread[..., 0, 0], spread[..., 1, 1] = 0.03, 0.05
    fit = ErrorModelFit(
        model=torch.tensor([[list(ERROR_MODELS).index("affine")]]),
        head=head,
        beta=torch.zeros(1, 1, size, dtype=torch.float64),
        spread=spread,
        noise=torch.ones(1, 1, 2, dtype=torch.float64),
        evidence=torch.zeros(1, 1, dtype=torch.float64),
    )
    mean, var = error_model.predict_references(
        fit, AlignmentProblem(references, of, head.expand(1, len(MODEL_HEADS), 2), references.x[:, :1])
    )
    y = 1.5 * references.x + 0.2
    torch.testing.assert_close(mean[0], y.log())
    torch.testing.assert_close(var[0], ((0.03 * references.x) ** 2 + 0.05**2) / y**2)
    torch.testing.assert_close(error_model.placement_variance(head, references)[0], (0.1 * 1.5 / y) ** 2)


def test_what_lies_between_nodes_is_part_of_what_is_believed_of_a_field():
    """Nodes and what they do not hold make up the variance that a model states, at nodes and between them."""
    of = basis()
    g = torch.Generator().manual_seed(0)
    where = torch.cat((of.node / of.aspect, torch.rand(60, 2, generator=g, dtype=torch.float64)))[None]
    names = ["raw", "raw_tilt", "scale_long_4", "raw_short_4"]
    model = torch.tensor([[list(ERROR_MODELS).index(name) for name in names]])
    short = torch.tensor([[ERROR_MODELS[name].short for name in names]])
    field = error_model.evaluate_fields(of, where, short)
    found = error_model.interpolation_variance(model, field)[0]
    assert (found[:2] == 0).all() and found[2].sqrt().max() < 2e-4
    assert found[3, : len(of.node)].sqrt().max() < 2e-4 and found[3, len(of.node) :].sqrt().mean() > 2e-3
    held = 0.04**2 * field[0, 3, :, error_model.N_TILT_SLOPES :].square().sum(-1)
    torch.testing.assert_close(held + found[3], torch.full_like(held, 0.04**2), rtol=1e-4, atol=0)


def test_anchors_of_which_there_are_none_are_as_good_as_they_would_have_said():
    references = points()
    task = AlignmentProblem(
        references, basis(), torch.tensor([[[1.0, 0.0]]]).double().expand(1, len(MODEL_HEADS), 2), references.x[:, :1]
    )
    raw = torch.tensor([[list(ERROR_MODELS).index("raw")]])
    for near in (True, False):
        alone = references._replace(near=torch.full_like(references.near, near))
        noise = error_model.fit_models(task._replace(points=alone), raw, alone.used).noise[0, 0]
        assert noise[int(near)] == 1, "near answers, far ones"


def test_degrees_of_freedom_that_are_stated_are_those_of_near_references():
    references = points()
    depth = references.depth.clone()
    depth[0, :4] *= 1.1
    references = references._replace(depth=depth)
    task = AlignmentProblem(
        references, basis(), torch.tensor([[[1.0, 0.0]]]).double().expand(1, len(MODEL_HEADS), 2), references.x[:, :1]
    )
    scale = torch.tensor([[list(ERROR_MODELS).index("scale")]])
    for near in (True, False):
        alone = task._replace(points=references._replace(near=torch.full_like(references.near, near)))
        heads = [
            error_model.fit_models(alone, scale, references.used, freedom=torch.tensor([freedom]).double()).head
            for freedom in (2.0, 200.0)
        ]
        assert torch.equal(*heads) is not near


def test_far_answers_lean_together_and_near_returns_do_not():
    references = points()
    far = torch.arange(40)[None] % 2 == 0
    references = references._replace(near=~far, shared=torch.where(far, 0.05, 0.0).double())
    lean = error_model.motion_error_basis(references)
    assert lean.shape == (1, 40, error_model.N_MOTION_ERRORS) and (lean[~far] == 0).all()
    torch.testing.assert_close(lean[far][:, 0], torch.full((20,), 0.05).double())
    assert (lean[far].abs().amax(0) > 0.02).all() and lean.abs().max() <= 3 * 0.05
