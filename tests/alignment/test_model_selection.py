"""Which model is taken for a map: the simplest of those that tell left-out references as well."""

import pytest
import torch

from dhtorch.alignment.align import _HeldOut, _one_standard_error_choice
from dhtorch.alignment.error_model import MODEL_HEADS
from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS
from dhtorch.alignment.references import ERROR_BLOCKS, MetricReferences

RAW, SCALE, SHIFT, AFFINE, DRIFT = range(5)
PER_BLOCK = 4


@pytest.fixture(scope="module")
def points():
    """Near returns and far answers, four of each in every block of the picture."""
    rows, columns = ERROR_BLOCKS
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    cell = torch.stack(((u + 0.5) / columns, (v + 0.5) / rows), -1).flatten(0, 1).double()
    share = cell.repeat(2 * PER_BLOCK, 1)[None]
    near = (torch.arange(share.shape[1]) < share.shape[1] // 2)[None]
    one = torch.ones_like(share[..., 0])
    return MetricReferences(
        share, x=one, within=0 * one, depth=one, var=1e-4 * one, shared=0 * one, near=near, used=torch.ones_like(near)
    )


def choice(points, r):
    """Index of the selected model under residuals (1, C, 1, N) of left-out references."""
    held_out = _HeldOut(r, torch.full_like(r, 1e-4))
    heads, head = list(MODEL_HEADS), torch.tensor([AFFINE])
    return _one_standard_error_choice(points, held_out, heads, head, DEFAULT_ALIGNMENT_OPTIONS)


def taken(points, near, far, seed=0):
    """The model that is taken where left-out references are missed by so much, of each model the near and the far ones;
    None = it could not be fitted."""
    draw = torch.Generator().manual_seed(seed)
    noise = torch.randn(points.x.shape[1], generator=draw, dtype=torch.float64)  # a reference's own, to all models
    size = [torch.where(points.near[0], a or torch.nan, b or torch.nan) for a, b in zip(near, far, strict=True)]
    r = (torch.stack(size) * noise)[None, :, None]
    return int(choice(points, r))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("near", "far", "expected"),
    [
        ((0.01, 0.01, 0.01, 0.01, 0.01), (0.02, 0.02, 0.02, 0.02, 0.02), RAW),
        ((0.1, 0.01, 0.01, 0.01, 0.01), (0.1, 0.02, 0.02, 0.02, 0.02), SCALE),
        ((0.1, 0.1, 0.01, 0.01, 0.01), (0.1, 0.1, 0.02, 0.02, 0.02), SHIFT),
        ((0.1, 0.1, 0.1, 0.01, 0.01), (0.1, 0.1, 0.1, 0.02, 0.02), AFFINE),
        ((0.1, 0.1, 0.1, 0.1, 0.01), (0.2, 0.2, 0.2, 0.2, 0.02), DRIFT),
    ],
)
def test_the_simplest_model_that_does_is_taken(points, near, far, expected, seed):
    assert taken(points, near, far, seed) == expected


@pytest.mark.parametrize("seed", range(4))
def test_what_bends_a_map_far_answers_must_bear_out(points, seed):
    """An affine head and a drift that near returns alone ask for would be wrong farther away."""
    near = (0.03, 0.03, 0.03, 0.01, 0.008)
    assert taken(points, near, (0.02, 0.02, 0.02, 0.1, 0.1), seed) == RAW
    assert taken(points, near, (0.1, 0.1, 0.1, 0.02, 0.1), seed) == AFFINE


@pytest.mark.parametrize("seed", range(4))
def test_far_answers_refute_a_shift_and_not_a_scale(points, seed):
    """The metre is the near returns'. A shift tells the far part otherwise than the near one, alone or with a scale."""
    far = (0.02, 0.03, 0.1, 0.1, 0.1)
    assert taken(points, (0.1, 0.1, 0.01, 0.1, 0.1), far, seed) != SHIFT
    assert taken(points, (0.1, 0.1, 0.01, 0.1, 0.1), (0.1, 0.1, 0.02, 0.1, 0.1), seed) == SHIFT
    assert taken(points, (0.1, 0.01, 0.01, 0.1, 0.1), far, seed) == SCALE


def test_a_shift_that_near_returns_meet_exactly_is_not_refuted_by_one_standard_error(points):
    """Far answers that happen to tell it a little worse outweigh returns which a line merely tells better."""
    draw = torch.Generator().manual_seed(0)
    kept = {}
    for met in (0.0005, 0.01):
        kept[met] = 0
        for _ in range(40):
            noise = torch.randn(5, points.x.shape[1], generator=draw, dtype=torch.float64)
            far = torch.tensor([0.020, 0.020, 0.1, 0.023, 0.1])[:, None] * noise
            near = torch.tensor([0.1, 0.1, 0.1, met, 0.1])[:, None] * noise[:1]
            r = torch.where(points.near, near, far)[None, :, None]
            kept[met] += int(choice(points, r)) == AFFINE
    assert kept[0.0005] > kept[0.01] + 5


def test_a_model_that_cannot_be_fitted_is_not_taken(points):
    assert taken(points, (None, 0.01, 0.01, 0.01, 0.01), (None, 0.02, 0.02, 0.02, 0.02)) == SCALE
    assert taken(points, (0.1, 0.1, 0.1, 0.1, None), (0.1, 0.1, 0.1, 0.1, None)) == RAW
