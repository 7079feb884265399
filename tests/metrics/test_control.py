"""Risk controls: at their limits, and the guarantee for the next scene over many drawn worlds."""

import math
import statistics

import pytest
import torch

from dhtorch.metrics import control, errors, risk
from dhtorch.metrics.control import conformal_threshold, plug_in_threshold, scene_quantile_threshold


def world_of(n, points=40, seed=0, hard=0.2):
    """Exchangeable scenes: each draws how good its answers are and how well its score orders them; some are hostile."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    level, hostile, own = 0.02 + 0.1 * draw(n, 1), draw(n, 1) < hard, draw(n, points)
    error = level * own * 6 + hostile * 0.3 * draw(n, points)
    score = 1 / (1 + own + 0.3 * draw(n, points))
    depth = torch.where(draw(n, points) < 0.2, torch.nan, 2 * (1 + error))
    flat = errors.make_points(depth, torch.full_like(depth, 2.0), score)
    return flat.map(lambda x: x.reshape(n, points))


def scenes_of(n, **options):
    """The scenes of a world, one by one."""
    world = world_of(n, **options)
    return [world[k] for k in range(n)]


@pytest.mark.parametrize(
    ("target", "confidence", "needed"),
    [(0.1, None, 9), (0.05, None, 19), (0.2, None, 4), (0.1, 0.9, 22), (0.05, 0.95, 59), (0.1, 0.5, 7)],
)
def test_few_scenes_get_the_number_that_it_takes(target, confidence, needed):
    assert control.scenes_needed(target, confidence=confidence) == needed
    perfect = [errors.make_points(torch.ones(20), torch.ones(20)) for _ in range(needed)]
    assert conformal_threshold(perfect, target, confidence=confidence).threshold == 1.0
    found = conformal_threshold(perfect[1:], target, confidence=confidence)
    assert (found.threshold, found.needed, found.n, found.coverage) == (None, needed, needed - 1, 0)
    assert found.why == f"{needed - 1} scenes are too few: a target of {target:g} takes at least {needed}"


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
        (plug_in_threshold, equal_errors(0.5, scenes=3), 0.5, {}, {"bound": 0.5, "risk": 0.5, "coverage": 0.5, "needed": None}),
        (conformal_threshold, equal_errors(0.5, scenes=3), 0.4375, {}, {"bound": 0.4375, "risk": 0.25, "coverage": 0.5, "needed": 2}),
        (conformal_threshold, equal_errors(0.5, scenes=3), 0.4374, {}, {"threshold": None}),
        (plug_in_threshold, equal_errors(7.0, 4), 0.99, {}, {"threshold": None}),
        (conformal_threshold, equal_errors(7.0, 4, scenes=9), 0.55, {}, {"bound": 0.55}),
        (conformal_threshold, equal_errors(9.0, scenes=9), 0.1, {}, {"bound": None, "why": "no threshold meets 0.1 on these 9 scenes"}),
        # Silent scenes count with risk 0, those without candidates do not count; a single scene has no standard error.
        (plug_in_threshold, [*equal_errors(0.25), SILENT, EMPTY], 0.3, {}, {"n": 3, "risk": 0.5 / 3, "coverage": 1 / 3, "bound": THIRD}),
        (plug_in_threshold, scenes_of(1), 0.5, {}, {"threshold": None}),
        *(
            (choose, scenes, 0.1, {}, {"threshold": None, "coverage": 0, "n": scenes.count(SILENT)})
            for choose in (plug_in_threshold, conformal_threshold, scene_quantile_threshold)
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


@pytest.mark.parametrize(("target", "n", "worlds"), [(0.1, 100, 30), (0.05, 19, 60)])
def test_conformal_control_bounds_the_mean_loss_of_the_next_scene(target, n, worlds):
    losses, none = [], 0
    for seed in range(1000, 1000 + worlds):
        world = world_of(n + 20, points=20, seed=seed)
        threshold = conformal_threshold([world[k] for k in range(n)], target).threshold
        none += threshold is None
        taken = world[n:].keep & (world[n:].score >= (math.inf if threshold is None else threshold))
        losses.append(float(torch.where(taken, risk.cap_error(world[n:].error), 0.0).mean()))
    assert statistics.mean(losses) <= target + 2 * statistics.stdev(losses) / math.sqrt(worlds)
    assert n < 100 or (none == 0 and statistics.mean(losses) > 0.5 * target), "a silent control has no loss"


@pytest.mark.parametrize("wrong", [0.0, 1.0, -0.1, math.nan])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("target", lambda x: plug_in_threshold([], x)),
        ("target", lambda x: conformal_threshold([], x)),
        ("target", lambda x: scene_quantile_threshold([], x)),
        ("confidence", lambda x: conformal_threshold([], 0.1, confidence=x)),
        ("share", lambda x: scene_quantile_threshold([], 0.1, share=2 * x)),
    ],
)
def test_bad_targets_raise(name, call, wrong):
    with pytest.raises(ValueError, match=rf"control\.{name}: found"):
        call(wrong)
