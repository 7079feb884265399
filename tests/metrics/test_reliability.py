"""Claimed against realised probability: bins against plain loops, folds by room, intervals over scenes."""

import math

import numpy as np
import pytest
import torch
from support.random_answers import random_points

from dhtorch.metrics import bootstrap, errors, reliability


def plain_reliability(claimed, good, weight, bins, equal_mass):
    """(claimed, realised, weight) of every bin, one answer at a time."""
    claimed = [min(max(p, 0.0), 1.0) for p in claimed]
    table = [[0.0, 0.0, 0.0] for _ in range(bins)]
    for p, g, w in zip(claimed, good, weight, strict=True):
        below = sum(v for q, v in zip(claimed, weight, strict=True) if q < p)
        own = sum(v for q, v in zip(claimed, weight, strict=True) if q == p)
        place = (below + own / 2) / sum(weight) if equal_mass else p
        row = table[min(int(place * bins), bins - 1)]
        row[0], row[1], row[2] = row[0] + w * p, row[1] + w * g, row[2] + w
    nan = math.nan
    return [(c / w, g / w, w / sum(weight)) if w else (nan, nan, 0.0) for c, g, w in table]


def plain_ece(table):
    return sum(w * abs(c - r) for c, r, w in table if w)


@pytest.mark.parametrize("equal_mass", [False, True])
@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize(("n", "bins"), [(1, 10), (13, 1), (60, 7), (60, 20)])
def test_a_reliability_diagram_equals_plain_loops(n, bins, ties, equal_mass):
    g = np.random.default_rng(n + bins)
    claimed = g.integers(-1, 8, n) / 6 if ties else g.uniform(-0.2, 1.2, n) ** 3
    good, weight = g.uniform(size=n) < 0.4, g.integers(1, 5, n) / 3
    for w in (weight, np.ones(n)):
        options = {"bins": bins, "equal_mass": equal_mass} | (
            {} if w is not weight else {"weight": torch.from_numpy(w)}
        )
        found = reliability.reliability_diagram(torch.from_numpy(claimed), torch.from_numpy(good), **options)
        expected = plain_reliability(claimed.tolist(), good.tolist(), w.tolist(), bins, equal_mass)
        for k, name in enumerate(("claimed", "realised", "weight")):
            assert getattr(found, name).tolist() == pytest.approx([row[k] for row in expected], nan_ok=True), name
        assert found.ece == pytest.approx(plain_ece(expected))


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
    scenes = [random_points(n, seed) for seed, n in enumerate((30, 80, 12))]
    pooled = [x.tolist() for x in reliability.pool_answers(scenes)]
    for options in ({}, {"bins": 4}):
        ece, equal_mass = (plain_ece(plain_reliability(*pooled, options.get("bins", 10), m)) for m in (False, True))
        found = reliability.measure_reliability(scenes, **options)
        assert found == {"ece": pytest.approx(ece), "ece_equal_mass": pytest.approx(equal_mass)}
    nothing = {"ece": None, "ece_equal_mass": None}
    assert reliability.measure_reliability([p[3:]]) == reliability.measure_reliability([]) == nothing


def test_a_room_is_never_tested_on_itself():
    scenes = {name: random_points(9, k) for k, name in enumerate("abcde")}
    folds = list(reliability.leave_one_room_out(scenes, {"b": "kitchen", "d": "kitchen"}))
    assert [sorted(held) for _, held in folds] == [["a"], ["b", "d"], ["c"], ["e"]]
    assert [sorted(others) for others, _ in folds] == [list("bcde"), list("ace"), list("abde"), list("abcd")]
    assert [sorted(h) for _, h in reliability.leave_one_room_out(scenes)] == [[c] for c in "abcde"]


@pytest.mark.parametrize("options", [{}, {"bins": 3}, {"bins": 3, "draws": 50}, {"seed": 9}])
def test_the_interval_of_ece_is_over_resampled_scenes(options):
    scenes = [random_points(n, s) for s, n in enumerate((60, 20, 90))]
    silent = errors.make_points(torch.full((4,), math.nan), torch.ones(4))
    found = reliability.ece_interval([*scenes, silent], **options)
    bins, draws, seed = (options.get(k, v) for k, v in (("bins", 10), ("draws", 2000), ("seed", 0)))
    assert found.value == pytest.approx(reliability.measure_reliability(scenes, bins=bins)["ece"]) and found.n == 3
    rows = [tuple(sorted(row)) for row in bootstrap.resample_scenes(3, draws, seed=seed).tolist()]
    each = {row: reliability.measure_reliability([scenes[i] for i in row], bins=bins)["ece"] for row in set(rows)}
    limits = np.percentile([each[row] for row in rows], [2.5, 97.5]).tolist()
    assert [found.low, found.high] == pytest.approx(limits)
    assert reliability.ece_interval([silent]) == (None, None, None, 0)


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
