"""Claimed against realised probability: bins against plain loops, folds by room, intervals over scenes."""

import math

import numpy as np
import pytest
import torch
from support.random_answers import random_points

from dhtorch.metrics import bootstrap, errors, reliability


def brute_ece(scenes, bins):
    total = 0.0
    for k in range(bins):
        weight = claimed = good = 0.0
        for scene in scenes:
            for p, e in scene:
                if min(int(p * bins), bins - 1) == k:
                    weight, claimed, good = (
                        weight + 1 / len(scene),
                        claimed + p / len(scene),
                        good + (e < 0.1) / len(scene),
                    )
        total += abs(claimed - good)
    return total / len(scenes)


def test_ece_equals_brute_force_with_equal_weight_per_scene():
    scenes = [random_points(n, seed) for seed, n in enumerate((30, 400, 90))]
    plain = [list(zip(s.answered().score.tolist(), s.answered().error.tolist(), strict=True)) for s in scenes]
    assert reliability.measure_reliability(scenes)["ece"] == pytest.approx(brute_ece(plain, 10), abs=1e-12)
    assert reliability.measure_reliability(scenes, bins=4)["ece"] == pytest.approx(brute_ece(plain, 4), abs=1e-12)
    twice = [*scenes[:1], *scenes[:1], *scenes]
    assert reliability.measure_reliability(twice)["ece"] != pytest.approx(
        reliability.measure_reliability(scenes)["ece"], abs=1e-6
    )


def test_a_calibrated_score_has_a_small_ece_and_a_boastful_one_has_not():
    g = torch.Generator().manual_seed(0)
    claimed = torch.rand(20000, generator=g, dtype=torch.float64)
    good = torch.rand(20000, generator=g, dtype=torch.float64) < claimed
    assert reliability.reliability_diagram(claimed, good).ece < 0.02
    assert reliability.reliability_diagram(claimed, good, equal_mass=True).ece < 0.02
    assert reliability.reliability_diagram(claimed**0.5, good).ece == pytest.approx(2 / 3 - 1 / 2, abs=0.02)


def test_equal_mass_bins_weigh_the_same_and_keep_ties_together():
    claimed = torch.rand(1000, generator=torch.Generator().manual_seed(0)) ** 3
    diagram = reliability.reliability_diagram(claimed, claimed > 0.5, equal_mass=True)
    torch.testing.assert_close(diagram.weight, torch.full((10,), 0.1, dtype=torch.float64), atol=2e-3, rtol=0)
    assert (diagram.claimed.diff() > 0).all()
    same = reliability.reliability_diagram(torch.full((50,), 0.5), torch.arange(50) < 25, equal_mass=True)
    assert sorted(same.weight.tolist()) == [0.0] * 9 + [1.0] and same.ece == 0


def test_certainty_falls_into_the_last_bin():
    diagram = reliability.reliability_diagram(torch.tensor([1.0, 0.0]), torch.tensor([True, False]))
    assert diagram.weight[[0, 9]].tolist() == [0.5, 0.5] and diagram.ece == 0


def test_a_room_never_judges_itself():
    scenes = {name: random_points(9, k) for k, name in enumerate("abcde")}
    folds = list(reliability.leave_one_room_out(scenes, {"b": "kitchen", "d": "kitchen"}))
    assert [sorted(held) for _, held in folds] == [["a"], ["b", "d"], ["c"], ["e"]]
    assert [sorted(others) for others, _ in folds] == [list("bcde"), list("ace"), list("abde"), list("abcd")]
    assert [sorted(h) for _, h in reliability.leave_one_room_out(scenes)] == [[c] for c in "abcde"]


def test_the_interval_of_ece_surrounds_ece():
    scenes = [random_points(n, s) for s, n in enumerate((60, 20, 90, 30))]
    silent = errors.make_points(torch.full((4,), math.nan), torch.ones(4))
    found = reliability.ece_interval([*scenes, silent])
    assert found.value == pytest.approx(reliability.measure_reliability(scenes)["ece"], abs=1e-12) and found.n == 4
    pairs = [[scenes[i] for i in row] for row in bootstrap.resample_scenes(4, 200, seed=5).tolist()]
    slow = torch.tensor([reliability.measure_reliability(p)["ece"] for p in pairs], dtype=torch.float64).quantile(
        torch.tensor([0.025, 0.975], dtype=torch.float64)
    )
    quick = reliability.ece_interval(scenes, draws=200, seed=5)
    assert [quick.low, quick.high] == pytest.approx(slow.tolist(), abs=1e-12)
    assert reliability.ece_interval([silent]) == (None, None, None, 0)


def loop_reliability(claimed, good, weight, bins, equal_mass):
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


@pytest.mark.parametrize("equal_mass", [False, True])
@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize(("n", "bins"), [(1, 10), (13, 1), (60, 7), (60, 20)])
def test_a_reliability_diagram_equals_plain_loops(n, bins, ties, equal_mass):
    g = np.random.default_rng(n + bins)
    claimed = g.integers(-1, 8, n) / 6 if ties else g.uniform(-0.2, 1.2, n) ** 3
    good, weight = g.uniform(size=n) < 0.4, g.integers(1, 5, n) / 3
    found = reliability.reliability_diagram(
        *map(torch.from_numpy, (claimed, good, weight)), bins=bins, equal_mass=equal_mass
    )
    expected = loop_reliability(claimed.tolist(), good.tolist(), weight.tolist(), bins, equal_mass)
    for k, name in enumerate(("claimed", "realised", "weight")):
        assert getattr(found, name).tolist() == pytest.approx([row[k] for row in expected], nan_ok=True), name
    assert found.ece == pytest.approx(sum(w * abs(c - r) for c, r, w in expected if w))
    plain = reliability.reliability_diagram(torch.from_numpy(claimed), torch.from_numpy(good), bins=bins)
    same = loop_reliability(claimed.tolist(), good.tolist(), [1.0] * n, bins, False)
    assert plain.weight.tolist() == pytest.approx([w for *_, w in same])


def test_a_diagram_of_nothing_has_no_error_and_no_bins_raise():
    nothing = reliability.reliability_diagram(torch.zeros(0), torch.zeros(0).bool())
    assert nothing.ece is None and nothing.weight.tolist() == [0] * 10 and nothing.claimed.isnan().all()
    assert (
        reliability.reliability_diagram(torch.ones(2), torch.ones(2).bool(), torch.zeros(2), equal_mass=True).ece
        is None
    )
    assert reliability.reliability_diagram(torch.full((1,), 0.25), torch.ones(1).bool(), bins=1).ece == 0.75
    for bins in (0, -1):
        with pytest.raises(ValueError, match=f"found bins={bins}, expected at least 1"):
            reliability.reliability_diagram(torch.ones(1), torch.ones(1).bool(), bins=bins)
    for wrong in ((torch.ones(2), torch.ones(1).bool()), (torch.ones(1), torch.ones(1).bool(), torch.ones(2))):
        with pytest.raises(ValueError, match="reliability: "):
            reliability.reliability_diagram(*wrong)


def test_both_errors_of_calibration_weigh_every_scene_alike():
    scenes = [random_points(n, seed) for seed, n in enumerate((30, 80, 12))]
    answered = [s.answered() for s in scenes]
    claimed = [x for a in answered for x in a.score.tolist()]
    good = [x for a in answered for x in (a.error < 0.1).tolist()]
    weight = [1 / a.keep.numel() for a in answered for _ in range(a.keep.numel())]
    for bins in (10, 4):
        options = {} if bins == 10 else {"bins": bins}
        for name, equal_mass in (("ece", False), ("ece_equal_mass", True)):
            table = loop_reliability(claimed, good, weight, bins, equal_mass)
            expected = sum(w * abs(c - r) for c, r, w in table if w)
            assert reliability.measure_reliability(scenes, **options)[name] == pytest.approx(expected, abs=1e-9), name


def test_an_error_of_exactly_a_tenth_is_not_good():
    p = errors.make_points(
        torch.tensor([11.0, 10.5, 12.0, math.nan]), torch.full((4,), 10.0), torch.tensor([0.5, 0.25, 1, 1])
    )
    score, good, weight = reliability.pool_answers([p, p[:2]])
    assert score.tolist() == [0.5, 0.25, 1, 0.5, 0.25] and good.tolist() == [False, True, False, False, True]
    assert weight.tolist() == pytest.approx([1 / 3] * 3 + [1 / 2] * 2)


def test_the_interval_of_ece_hands_its_options_on():
    scenes = [random_points(n, s) for s, n in enumerate((60, 20, 90))]
    for options in ({}, {"bins": 3}, {"bins": 3, "draws": 50}, {"seed": 9}):
        found = reliability.ece_interval(scenes, **options)
        bins, draws, seed = (options.get(k, v) for k, v in (("bins", 10), ("draws", 2000), ("seed", 0)))
        assert found.value == pytest.approx(reliability.measure_reliability(scenes, bins=bins)["ece"])
        rows = bootstrap.resample_scenes(3, draws, seed=seed)
        each = {tuple(sorted(row)): None for row in rows.tolist()}
        each = {row: reliability.measure_reliability([scenes[i] for i in row], bins=bins)["ece"] for row in each}
        drawn = [each[tuple(sorted(row))] for row in rows.tolist()]
        assert [found.low, found.high] == pytest.approx(np.percentile(drawn, [2.5, 97.5]).tolist())


def honest(n, seed=0, boast=0.0):
    """Answers that are good with the probability they claim, or with ``boast`` less."""
    g = torch.Generator().manual_seed(seed)
    claimed = 0.3 + 0.7 * torch.rand(n, generator=g, dtype=torch.float64)
    good = torch.rand(n, generator=g, dtype=torch.float64) < claimed - boast
    true = torch.full((n,), 2.0, dtype=torch.float64)
    return errors.make_points(torch.where(good, 2.02, 3.0).double(), true, claimed)


@pytest.mark.slow
def test_excess_ece_forgives_chance_and_nothing_else():
    few, many = (sum(reliability.excess_ece(honest(n, seed)) for seed in range(8)) / 8 for n in (40, 4000))
    assert few < 0.03 and many < 0.005
    raw = reliability.reliability_diagram(honest(40).score, honest(40).error < 0.1, equal_mass=True).ece
    assert raw > 0.08, "what chance alone makes of forty answers"
    for n in (400, 4000):
        assert reliability.excess_ece(honest(n, boast=0.2)) == pytest.approx(0.2, abs=0.05)


def test_excess_ece_is_the_ece_less_its_mean_under_the_claims():
    scene = honest(60, seed=3, boast=0.3)
    g = torch.Generator().manual_seed(5)
    drawn = [
        reliability.reliability_diagram(
            scene.score, torch.rand(60, generator=g, dtype=torch.float64) < scene.score, bins=4, equal_mass=True
        ).ece
        for _ in range(30)
    ]
    found = reliability.reliability_diagram(scene.score, scene.error < 0.1, bins=4, equal_mass=True).ece
    expected = found - sum(drawn) / 30
    assert reliability.excess_ece(scene, bins=4, draws=30, seed=5) == pytest.approx(expected) and expected > 0.1
    mute = scene.replace(keep=torch.zeros_like(scene.keep))
    assert reliability.excess_ece(mute) is None
