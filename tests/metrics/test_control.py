"""Risk controls at their limits; many numbers at once: test_stored_answers.py."""

import math
import statistics

import pytest
import torch

from dhtorch.metrics import errors
from dhtorch.metrics.control import plug_in_threshold, scene_quantile_threshold


def equal_errors(error, n=8, scenes=2):
    """Scenes of n answers of the same error and of as many silent candidates."""
    depth = torch.cat((torch.full((n,), 4 * (1 + error)), torch.full((n,), math.nan))).double()
    return [errors.make_points(depth, torch.full_like(depth, 4.0)) for _ in range(scenes)]


def pair_scenes(*worst):
    """Scenes of an exact answer of score 0.9 and one of score 0.3 with the error given."""
    score = torch.tensor([0.3, 0.9])
    return [errors.make_points(torch.tensor([1.0 + e, 1.0]), torch.ones(2), score) for e in worst]


SILENT = errors.make_points(torch.full((5,), math.nan), torch.ones(5))
EMPTY = errors.make_points(torch.zeros(0), torch.zeros(0))
CLOSE = pair_scenes(0.090, 0.091, 0.092, 0.093, 0.090, 0.091, 0.092)
APART = pair_scenes(0.001, 0.098, 0.001, 0.098, 0.001, 0.098, 0.05)
ONE_BAD = pair_scenes(*[0.01] * 19, 0.4)
THIRD = 0.5 / 3 + statistics.stdev([0.25, 0.25, 0.0]) / math.sqrt(3)


@pytest.mark.parametrize(
    ("choose", "scenes", "target", "options", "expected"),
    [
        # A bound of exactly the target is accepted, and an error counts as one at most.
        (plug_in_threshold, equal_errors(0.25), 0.25, {}, {"threshold": 1, "n": 2}),
        (plug_in_threshold, equal_errors(0.25), 0.2499, {}, {"threshold": None}),
        (plug_in_threshold, equal_errors(0.5, scenes=3), 0.5, {}, {"bound": 0.5, "risk": 0.5, "coverage": 0.5}),
        (plug_in_threshold, equal_errors(7.0, 4), 0.99, {}, {"threshold": None}),
        # Silent scenes count with risk 0, those without candidates do not count; a single scene has no standard error.
        (plug_in_threshold, [*equal_errors(0.25), SILENT, EMPTY], 0.3, {}, {"n": 3, "risk": 0.5 / 3, "coverage": 1 / 3, "bound": THIRD}),
        (plug_in_threshold, equal_errors(0.25, scenes=1), 0.5, {}, {"threshold": None}),
        *(
            (choose, scenes, 0.1, {}, {"threshold": None, "coverage": 0, "n": scenes.count(SILENT)})
            for choose in (plug_in_threshold, scene_quantile_threshold)
            for scenes in ([], [EMPTY], [SILENT] * 30, [EMPTY, SILENT])
        ),
        # Of few scenes the next one's risk is bounded by their spread; of four no spread is estimated.
        (scene_quantile_threshold, CLOSE, 0.05, {}, {"threshold": 0.3}),
        (scene_quantile_threshold, APART, 0.05, {}, {"threshold": 0.9}),
        (scene_quantile_threshold, APART[:4], 0.05, {}, {"threshold": 0.3}),
        # One bad scene among many: the mean is met, and nine in ten are; all are at a higher threshold alone.
        (plug_in_threshold, ONE_BAD, 0.05, {}, {"threshold": 0.3}),
        (scene_quantile_threshold, ONE_BAD, 0.05, {}, {"threshold": 0.3}),
        (scene_quantile_threshold, ONE_BAD, 0.05, {"share": 1.0}, {"threshold": 0.9}),
        (scene_quantile_threshold, ONE_BAD[16:], 0.05, {}, {"threshold": 0.9}),
    ],
)  # fmt: skip
def test_limits_of_the_controls(choose, scenes, target, options, expected):
    found = choose(scenes, target, **options)
    for name, value in expected.items():
        assert getattr(found, name) == (pytest.approx(value) if isinstance(value, float) else value), name


@pytest.mark.parametrize("first_good", [0, 1, 5, 4000, 8192])
def test_more_than_4096_scores_are_thinned_evenly_from_the_lowest_to_the_highest(first_good):
    n = 8193
    scene = errors.make_points(
        torch.where(torch.arange(n) < first_good, 9.0, 1.0), torch.ones(n), torch.arange(float(n))
    )
    tried = torch.linspace(0, n - 1, 4096, dtype=torch.float64).round()
    found = plug_in_threshold([scene, scene], 1e-5).threshold
    assert found == float(tried[tried >= first_good][0])


@pytest.mark.parametrize("wrong", [0.0, 1.0, -0.1, math.nan])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("target", lambda x: plug_in_threshold([], x)),
        ("target", lambda x: scene_quantile_threshold([], x)),
        ("share", lambda x: scene_quantile_threshold([], 0.1, share=2 * x)),
    ],
)
def test_bad_targets_raise(name, call, wrong):
    with pytest.raises(ValueError, match=rf"control\.{name}: found"):
        call(wrong)
