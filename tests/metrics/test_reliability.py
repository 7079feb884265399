"""Claimed against realised probability: bins by hand, folds by room; many numbers at once: test_stored_answers.py."""

import math

import pytest
import torch
from support.random_answers import random_points

from dhtorch.metrics import errors, reliability


@pytest.mark.parametrize(
    ("claimed", "good", "options", "weight", "ece"),
    [
        ([1.0, 0.0], [True, False], {}, [0.5] + [0] * 8 + [0.5], 0),  # certainty falls into the last bin
        (
            [0.5] * 50,
            [True] * 25 + [False] * 25,
            {"equal_mass": True},
            [0] * 5 + [1] + [0] * 4,
            0,
        ),  # ties stay together
        ([], [], {}, [0] * 10, None),
        ([1.0, 1.0], [True, True], {"weight": torch.zeros(2), "equal_mass": True}, [0] * 10, None),
        ([0.25], [True], {"bins": 1}, [1], 0.75),
    ],
)
def test_diagrams_by_hand(claimed, good, options, weight, ece):
    found = reliability.reliability_diagram(torch.tensor(claimed), torch.tensor(good, dtype=torch.bool), **options)
    assert (found.weight.tolist(), found.ece) == (weight, ece)


@pytest.mark.parametrize(
    ("args", "options", "message"),
    [
        ((torch.ones(1), torch.ones(1).bool()), {"bins": 0}, "found bins=0, expected at least 1"),
        ((torch.ones(2), torch.ones(1).bool()), {}, "reliability: "),
        ((torch.ones(1), torch.ones(1).bool(), torch.ones(2)), {}, "reliability: "),
    ],
)
def test_wrong_diagrams_raise(args, options, message):
    with pytest.raises(ValueError, match=message):
        reliability.reliability_diagram(*args, **options)


def test_a_calibrated_score_has_a_small_ece_and_an_overconfident_one_has_not():
    g = torch.Generator().manual_seed(0)
    claimed = torch.rand(20000, generator=g, dtype=torch.float64)
    good = torch.rand(20000, generator=g, dtype=torch.float64) < claimed
    assert reliability.reliability_diagram(claimed, good).ece < 0.02
    assert reliability.reliability_diagram(claimed, good, equal_mass=True).ece < 0.02
    assert reliability.reliability_diagram(claimed**0.5, good).ece == pytest.approx(2 / 3 - 1 / 2, abs=0.02)


def test_answers_are_pooled_with_equal_weight_per_scene_and_an_error_of_a_tenth_is_not_good():
    depth, score = torch.tensor([11.0, 10.5, 12.0, math.nan]), torch.tensor([0.5, 0.25, 1, 1])
    p = errors.make_points(depth, torch.full((4,), 10.0), score)
    score, good, weight = reliability.pool_answers([p, p[:2]])
    assert score.tolist() == [0.5, 0.25, 1, 0.5, 0.25] and good.tolist() == [False, True, False, False, True]
    assert weight.tolist() == pytest.approx([1 / 3] * 3 + [1 / 2] * 2)
    nothing = {"ece": None, "ece_equal_mass": None}
    assert reliability.measure_reliability([p[3:]]) == reliability.measure_reliability([]) == nothing


def test_a_room_is_never_tested_on_itself():
    scenes = {name: random_points(9, k) for k, name in enumerate("abcde")}
    folds = list(reliability.leave_one_room_out(scenes, {"b": "kitchen", "d": "kitchen"}))
    assert [sorted(held) for _, held in folds] == [["a"], ["b", "d"], ["c"], ["e"]]
    assert [sorted(others) for others, _ in folds] == [list("bcde"), list("ace"), list("abde"), list("abcd")]
    assert [sorted(h) for _, h in reliability.leave_one_room_out(scenes)] == [[c] for c in "abcde"]


def honest(n, seed=0, boast=0.0):
    """Answers that are good with the probability they claim, or with ``boast`` less."""
    g = torch.Generator().manual_seed(seed)
    claimed = 0.3 + 0.7 * torch.rand(n, generator=g, dtype=torch.float64)
    good = torch.rand(n, generator=g, dtype=torch.float64) < claimed - boast
    true = torch.full((n,), 2.0, dtype=torch.float64)
    return errors.make_points(torch.where(good, 2.02, 3.0).double(), true, claimed)


def test_excess_ece_is_the_ece_less_its_mean_under_the_claims():
    scene, g = honest(60, seed=3, boast=0.3), torch.Generator().manual_seed(5)
    ece = lambda good: reliability.reliability_diagram(scene.score, good, bins=4, equal_mass=True).ece  # noqa: E731
    drawn = [ece(torch.rand(60, generator=g, dtype=torch.float64) < scene.score) for _ in range(30)]
    expected = ece(scene.error < 0.1) - sum(drawn) / 30
    assert reliability.excess_ece(scene, bins=4, draws=30, seed=5) == pytest.approx(expected) and expected > 0.1
    assert reliability.excess_ece(scene.replace(keep=torch.zeros_like(scene.keep))) is None
    assert reliability.excess_ece(honest(4000)) < 0.01, "an honest score has none"
