"""Stage 1 against its formulas, point by point in plain Python, and what it refuses."""

import math

import numpy as np
import pytest
import torch

from dhtorch.stages.sample import regular_grid, spiral, vogel_spiral


def to_border(centre, angle, low, high):
    """How far the box reaches from its centre in a direction."""
    ways = []
    for k, d in enumerate((math.cos(angle), math.sin(angle))):
        room = high[k] - centre[k] if d > 0 else centre[k] - low[k]
        ways.append(room / max(abs(d), 1e-12))
    return min(ways)


def box(hw, margin):
    low, high = (margin, margin), (hw[1] - 1 - margin, hw[0] - 1 - margin)
    return low, high, tuple((a + b) / 2 for a, b in zip(low, high, strict=True))


def plain_spiral(hw, n, turns=None, foveation=1.0, gaze=None, inner_px=1.0, margin_px=2.0):
    low, high, middle = box(hw, margin_px)
    centre = gaze or middle
    turns = math.sqrt(foveation * n / (2 * math.pi)) if turns is None else turns
    points = []
    for k in range(n):
        s = (k // 2 + 0.5) / math.ceil(n / 2)
        angle = 2 * math.pi * turns * math.sqrt(s) + math.pi * (k % 2)
        reach = to_border(centre, angle, low, high)
        first = min(inner_px, reach)
        r = first + (reach - first) * s**foveation
        points.append((centre[0] + r * math.cos(angle), centre[1] + r * math.sin(angle)))
    return np.array(points)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"turns": 3.5},
        {"foveation": 0.5},
        {"foveation": 2.5},
        {"gaze": (20.0, 55.25)},
        {"gaze": (2.0, 57.0)},  # on the margin itself
        {"inner_px": 6.0},
        {"inner_px": 0.0},
        {"margin_px": 0.0},
        {"margin_px": 7.5, "gaze": (8.0, 20.0), "inner_px": 4.0, "foveation": 0.8, "turns": 2.0},
    ],
)
@pytest.mark.parametrize("n", [40, 41])
def test_the_spiral_is_its_formula(options, n):
    found = spiral((60, 80), n, **options, dtype=torch.float64)
    np.testing.assert_allclose(found.numpy(), plain_spiral((60, 80), n, **options), atol=1e-9)


@pytest.mark.parametrize(("gaze", "margin_px", "n"), [(None, 2.0, 30), ((15.0, 40.0), 5.0, 31)])
def test_vogels_sunflower_is_its_formula(gaze, margin_px, n):
    low, high, middle = box((60, 80), margin_px)
    centre, expected = gaze or middle, []
    for k in range(n):
        angle = k * math.pi * (3 - math.sqrt(5))
        r = to_border(centre, angle, low, high) * math.sqrt((k + 0.5) / n)
        expected.append((centre[0] + r * math.cos(angle), centre[1] + r * math.sin(angle)))
    found = vogel_spiral((60, 80), n, gaze=gaze, margin_px=margin_px, dtype=torch.float64)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)


@pytest.mark.parametrize(("hw", "n", "margin_px"), [((60, 80), 50, 2.0), ((20, 90), 7, 0.0), ((90, 20), 13, 4.0)])
def test_a_grid_fills_rows_of_equal_height_evenly(hw, n, margin_px):
    rows = min(max(round(math.sqrt(n * hw[0] / hw[1])), 1), n)
    (low_u, low_v), (high_u, high_v), _ = box(hw, margin_px)
    number = [sum(k * rows // n == row for k in range(n)) for row in range(rows)]
    assert max(number) - min(number) <= 1
    expected = [
        (low_u + (i + 0.5) / count * (high_u - low_u), low_v + (row + 0.5) / rows * (high_v - low_v))
        for row, count in enumerate(number)
        for i in range(count)
    ]
    found = regular_grid(hw, n, margin_px=margin_px, dtype=torch.float64)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_a_grid_of_a_long_image_is_one_row_and_that_of_a_tall_one_has_no_more_rows_than_points():
    assert regular_grid((4, 900), 3, margin_px=1).tolist() == [[150.5, 1.5], [449.5, 1.5], [748.5, 1.5]]
    assert regular_grid((900, 4), 3, margin_px=1).tolist() == [[1.5, 150.5], [1.5, 449.5], [1.5, 748.5]]


SAMPLERS = [spiral, regular_grid, vogel_spiral]


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_defaults_and_single_samples(sampler):
    assert sampler((5, 9), 4, margin_px=2)[:, 1].tolist() == [2.0] * 4, "the margin may leave one pixel"
    assert sampler((5, 5), 3).tolist() == [[2.0, 2.0]] * 3 and sampler((5, 5), 0).shape == (0, 2)
    first = sampler((50, 90), 3, dtype=torch.float64)
    assert first.dtype == torch.float64 and sampler((50, 90)).shape == (2048, 2)
    first.zero_()
    assert sampler((50, 90), 3).abs().min() > 0, "each call has a tensor of its own"
    reach = 0.0 if sampler is regular_grid else 0.5**0.5  # of the way to the border
    one = plain_spiral((50, 90), 1)[0] if sampler is spiral else (44.5 + reach * 42.5, 24.5)
    assert sampler((50, 90), 1, dtype=torch.float64)[0].tolist() == pytest.approx(list(one))


@pytest.mark.parametrize(
    ("samplers", "hw", "options", "message"),
    [
        (SAMPLERS, (5, 9), {"margin_px": 2.01}, r"margin_px.* 5x9 pixels"),
        (SAMPLERS, (5, 9), {"margin_px": -0.1}, r"margin_px.* 5x9 pixels"),
        (SAMPLERS, (5, 9), {"n": -1}, "n is -1"),
        *(
            (SAMPLERS[::2], (50, 90), {"gaze": gaze}, r"gaze.* 50x90 pixels")
            for gaze in ((1.9, 20.0), (20.0, 1.9), (87.1, 20.0), (20.0, 47.1))
        ),
        ([spiral], (50, 90), {"foveation": 0.0}, "foveation"),
        ([spiral], (50, 90), {"foveation": -1.0}, "foveation"),
    ],
)
def test_samples_that_cannot_be_raise(samplers, hw, options, message):
    for sampler in samplers:
        with pytest.raises(ValueError, match=message):
            sampler(hw, **{"n": 9, **options})
