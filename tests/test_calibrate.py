"""Recalibration and the metrics beside it: brute force, scikit-learn where it is installed, simulation."""

import functools
import itertools
import json
import math
import random
import statistics

import pytest
import torch

from dhtorch import calibration
from dhtorch.codes import Gate
from dhtorch.evaluate import bootstrap, calibrate, compare, errors, monotone, recalibrate, risk
from dhtorch.records import Estimate, PoseFit, Samples, Tracks
from dhtorch.stages import score


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


def scene_of(n, seed=0, spread=1.0, silent=0.2, boast=1.0, floor=0.0):
    """Answers whose error is normal with a known relative sigma, and a score that falls with it."""
    g = generator(seed)
    rel = 0.02 + 0.3 * torch.rand(n, generator=g, dtype=torch.float64) ** 2
    true = 2 + 4 * torch.rand(n, generator=g, dtype=torch.float64)
    noise = ((spread * rel) ** 2 + floor**2).sqrt() * torch.randn(n, generator=g, dtype=torch.float64)
    depth = (true * (1 + noise)).clamp_min(0.01)
    keep = torch.rand(n, generator=g, dtype=torch.float64) >= silent
    return errors.points(depth, true, (0.1 / (0.1 + rel)) ** boast, sigma=rel * true, keep=keep)


# ---------------------------------------------------------------------------------------------------- isotonic


def brute_isotonic(y, w):
    """max over starts of min over ends of the weighted means that contain i."""
    n = len(y)

    def mean(j, k):
        return sum(a * b for a, b in zip(y[j:k], w[j:k], strict=True)) / sum(w[j:k])

    return [max(min(mean(j, k) for k in range(i + 1, n + 1)) for j in range(i + 1)) for i in range(n)]


@pytest.mark.parametrize("n", [0, 1, 2, 3, 12, 30])
def test_pool_adjacent_violators_equals_the_min_max_formula(n):
    draw = random.Random(n)
    for kind in range(4):
        y = [draw.choice([0.0, 1.0]) if kind % 2 else draw.gauss(0.1 * i, 1) for i in range(n)]
        w = [1.0] * n if kind < 2 else [draw.uniform(0.1, 3) for _ in range(n)]
        found = monotone.pool_adjacent_violators(torch.tensor(y), torch.tensor(w)).tolist()
        assert found == pytest.approx(brute_isotonic(torch.tensor(y).tolist(), torch.tensor(w).tolist()), abs=1e-6)


def test_pool_adjacent_violators_equals_scikit_learn():
    sklearn = pytest.importorskip("sklearn.isotonic")
    y, w = uniform(3000) + torch.linspace(0, 1, 3000, dtype=torch.float64), uniform(3000, seed=1) + 0.01
    expected = sklearn.isotonic_regression(y.numpy(), sample_weight=w.numpy())
    assert monotone.pool_adjacent_violators(y, w).tolist() == pytest.approx(expected.tolist(), abs=1e-12)


def test_a_table_runs_through_the_middles_of_the_blocks():
    x = torch.tensor([0.1, 0.2, 0.3, 0.5, 0.7, 0.9])
    y = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 1.0])  # blocks: .1 .2 at 0, .3 .5 at ½, .7 .9 at 1
    table = monotone.isotonic(x, y)
    at = torch.tensor([0.15, 0.4, 0.8], dtype=torch.float64)
    assert table(at).tolist() == pytest.approx([0, 0.5, 1], abs=1.1 * monotone.TILT)
    assert float(table(torch.tensor(0.275))) == pytest.approx(0.25, abs=1.1 * monotone.TILT)
    assert table(torch.tensor([-1.0, 0.1, 0.9, 7.0])).tolist() == pytest.approx([0, 0, 1, 1])
    falling = monotone.isotonic(x, 1 - y, rising=False)
    assert falling(at).tolist() == pytest.approx([1, 0.5, 0], abs=1.1 * monotone.TILT)


def test_a_table_keeps_every_order_within_its_range():
    x = uniform(400)
    for y in ((uniform(400, seed=1) < x).double(), (uniform(400, seed=1) < 0.5).double()):
        table = monotone.isotonic(x, y, min_share=0.05, ends=(0, 1))
        values = table(torch.linspace(0, 1, 5000, dtype=torch.float64))
        assert (values.diff() > 0).all() or table.y.unique().numel() == 1
        assert values[0] >= 0 and values[-1] <= 1
        short = table(torch.linspace(0, 1, 200))
        assert short.dtype == torch.float32 and (short.diff() >= 0).all()


def test_blocks_are_joined_until_they_weigh_enough():
    x, y = torch.arange(100.0), (torch.arange(100) >= 99).double()  # one lucky point at the top
    bold, careful = monotone.isotonic(x, y), monotone.isotonic(x, y, min_share=0.1)
    assert float(bold(torch.tensor(99.0))) == 1
    assert float(careful(torch.tensor(99.0))) < 0.2
    g = uniform(300, seed=3)
    joined = monotone.isotonic(g, (uniform(300, seed=4) < g).double(), min_share=0.1)
    assert joined.x.numel() <= 10 + 2


def test_equal_arguments_share_a_value_and_weights_count():
    x = torch.tensor([0.0, 0.0, 1.0, 1.0])
    table = monotone.isotonic(x, torch.tensor([0.0, 1.0, 1.0, 1.0]), torch.tensor([3.0, 1.0, 1.0, 0.0]))
    assert table(torch.tensor([0.0, 1.0])).tolist() == pytest.approx([0.25, 1.0])
    with pytest.raises(ValueError, match="isotonic: found no point"):
        monotone.isotonic(x, x, torch.zeros(4))
    with pytest.raises(ValueError, match="isotonic: y has shape"):
        monotone.isotonic(x, x[1:])


def test_one_value_is_a_constant():
    table = monotone.isotonic(torch.tensor([0.4]), torch.tensor([0.7]))
    assert table(torch.tensor([0.0, 0.4, 9.0])).tolist() == pytest.approx([0.7] * 3)


# ---------------------------------------------------------------------------------------------------- sigmoid


def test_platt_minimises_the_log_loss():
    p, w = uniform(500), uniform(500, seed=1)
    good = uniform(500, seed=2) < p**2
    found = monotone.platt(p, good, w)

    def loss(slope, offset):
        claimed = torch.sigmoid(slope * torch.logit(p, eps=1e-6) + offset)
        return float(torch.nn.functional.binary_cross_entropy(claimed, good.double(), weight=w))

    best = loss(float(found.slope), float(found.offset))
    for da, db in itertools.product((-0.01, 0, 0.01), repeat=2):
        assert loss(float(found.slope) + da, float(found.offset) + db) >= best - 1e-9
    assert loss(1, 0) > best + 0.01
    assert found(p).tolist() == pytest.approx(
        torch.sigmoid(found.slope * torch.logit(p, eps=1e-6) + found.offset).tolist(), abs=1e-12
    )


def test_platt_equals_scikit_learn():
    linear = pytest.importorskip("sklearn.linear_model")
    p, w = uniform(800), uniform(800, seed=1)
    good = uniform(800, seed=2) < p**2
    model = linear.LogisticRegression(C=1e8, tol=1e-10, max_iter=1000)
    model.fit(torch.logit(p, eps=1e-6)[:, None].numpy(), good.numpy(), sample_weight=w.numpy())
    found = monotone.platt(p, good, w)
    assert [float(found.slope), float(found.offset)] == pytest.approx(
        [model.coef_[0, 0], model.intercept_[0]], abs=1e-3
    )


def test_platt_survives_separable_one_sided_and_missing_data():
    p = torch.linspace(0, 1, 50, dtype=torch.float64)
    for good in (p > 0.5, p > 2, p >= 0):
        found = monotone.platt(p, good)
        assert torch.isfinite(found.slope) and torch.isfinite(found.offset)
        assert found(p).isfinite().all()
    nothing = monotone.platt(torch.zeros(0), torch.zeros(0).bool())
    assert (float(nothing.slope), float(nothing.offset)) == (1, 0)


# ---------------------------------------------------------------------------------------------------- calibration


def test_a_boastful_score_becomes_calibrated_in_scenes_not_fitted():
    fitting = [scene_of(4000, seed, boast=0.3) for seed in range(6)]
    fresh = [scene_of(4000, seed, boast=0.3) for seed in range(10, 16)]
    learnt = recalibrate.fit(fitting)
    before, after = calibrate.measure(fresh)["ece"], calibrate.measure([learnt.apply(s) for s in fresh])["ece"]
    assert before > 0.1 and after < 0.02
    expected = torch.cat([learnt.expected_error(s.answered().score) for s in fresh])
    actual = torch.cat([risk.capped(s.answered().error) for s in fresh])
    assert float(expected.mean()) == pytest.approx(float(actual.mean()), rel=0.05)
    assert float(expected[expected < 0.05].mean()) == pytest.approx(float(actual[expected < 0.05].mean()), rel=0.1)


def test_every_scene_teaches_equally():
    few, many = scene_of(50, 1), scene_of(5000, 2, spread=3.0)
    once, copied = recalibrate.fit([few, many]), recalibrate.fit([few, many[torch.arange(5000).repeat(3)]])
    at = torch.linspace(0, 1, 30, dtype=torch.float64)
    torch.testing.assert_close(once.probability(at), copied.probability(at))
    torch.testing.assert_close(once.expected_error(at), copied.expected_error(at))


@pytest.mark.parametrize(("spread", "floor"), [(0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (1.5, 0.03), (0.7, 0.1)])
def test_the_correction_of_sigma_is_found(spread, floor):
    scenes = [scene_of(n, seed, spread=spread, floor=floor) for seed, n in enumerate((2000, 9000, 5000))]
    found = recalibrate.fit_sigma(scenes)
    stated, one = torch.linspace(0.02, 0.32, 30, dtype=torch.float64), torch.ones(30, dtype=torch.float64)
    torch.testing.assert_close(
        found(stated, one), recalibrate.SigmaModel(spread, floor)(stated, one), rtol=0.08, atol=0
    )
    learnt = [errors.measure(recalibrate.fit(scenes).apply(s)) for s in scenes]
    assert statistics.mean(m["within_sigma"] for m in learnt) == pytest.approx(0.683, abs=0.002)
    assert statistics.mean(m["within_2sigma"] for m in learnt) == pytest.approx(0.954, abs=0.01)
    assert found(torch.tensor(3.0), torch.tensor(2.0)) == pytest.approx(math.hypot(3 * found.scale, 2 * found.floor))
    assert recalibrate.fit_sigma([errors.points(torch.ones(3), torch.ones(3))]) is None


def test_the_correction_of_sigma_weighs_scenes_and_survives_exact_ones():
    few, many = scene_of(300, 1), scene_of(3000, 2, spread=3.0)
    once, copied = recalibrate.fit_sigma([few, many]), recalibrate.fit_sigma([few, many[torch.arange(3000).repeat(3)]])
    assert (once.scale, once.floor) == pytest.approx((copied.scale, copied.floor), rel=1e-9)
    exact = recalibrate.fit_sigma([errors.points(torch.ones(30), torch.ones(30), sigma=torch.ones(30))])
    assert math.isfinite(exact.scale) and math.isfinite(exact.floor)


def test_calibration_changes_no_order_and_keeps_silence():
    scene = scene_of(1000, 3)
    there = recalibrate.fit([scene_of(2000, s) for s in range(3)]).apply(scene)
    assert torch.equal(there.keep, scene.keep) and (there.score[~scene.keep] == 0).all()
    assert risk.measure(there)["aurc"] == pytest.approx(risk.measure(scene)["aurc"], abs=1e-12)


def test_a_calibration_of_nothing_raises():
    silent = errors.points(torch.full((4,), math.nan), torch.ones(4))
    for scenes in ([], [silent]):
        with pytest.raises(ValueError, match="fit: found no answer"):
            recalibrate.fit(scenes)


def fitted(**provenance):
    note = {"method": "test", "scenes": ["a", "b"]} | provenance
    return recalibrate.fit([scene_of(800, s) for s in range(3)], provenance=note)


def test_json_there_and_back(tmp_path):
    learnt = fitted(truth="full")
    back = calibration.load(calibration.save(learnt, tmp_path / "sub" / "mine.json"))
    at = torch.linspace(-0.1, 1.1, 200, dtype=torch.float64)
    for name in ("probability", "expected_error", "sigmoid"):
        assert torch.equal(getattr(back, name)(at), getattr(learnt, name)(at)), name
    assert (back.sigma, back.thresholds) == (learnt.sigma, learnt.thresholds)
    assert back.provenance == learnt.provenance
    assert back.provenance["n_scenes"] == 3 and back.to_json() == learnt.to_json()


def broken(path, value):
    content = json.loads(fitted().to_json())
    place = content
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return json.dumps(content)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), 2, r"mine\.json\.schema: found 2, expected 1"),
        (("probability",), None, r"mine\.json\.probability: found nothing"),
        (("more",), 1, r"mine\.json\.more: found an unknown field"),
        (("probability", "score"), [0.5, 0.2], r"mine\.json\.probability\.value: found .* expected 2, one for each"),
        (("probability", "value", 0), 2.0, r"mine\.json\.probability\.value: found .*expected rising numbers from 0"),
        (("expected_error", "value", 0), 0, r"mine\.json\.expected_error\.value: found .*expected falling numbers"),
        (("probability", "score", 1), -1.0, r"mine\.json\.probability\.score: found .*expected rising"),
        (("probability", "score", 1), "0.1", r"mine\.json\.probability\.score\.1: found 0\.1, expected a finite"),
        (("expected_error", "score"), [], r"mine\.json\.expected_error\.score: found \[\], expected a list"),
        (("sigmoid", "slope"), True, r"mine\.json\.sigmoid\.slope: found true"),
        (("sigma", "floor"), -1, r"mine\.json\.sigma\.floor: found -1, expected no negative"),
        (("sigma", "scale"), 10**400, r"mine\.json\.sigma\.scale: found 1000"),
        (("sigma",), {"scale": 1}, r"mine\.json\.sigma\.floor: found nothing"),
        (("thresholds", "ten"), 0.5, r"mine\.json\.thresholds\.ten: found ten, expected a whole number"),
        (("provenance",), [], r"mine\.json\.provenance: found \[\], expected an object"),
    ],
)
def test_a_damaged_calibration_is_refused_by_file_and_field(path, value, message, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(broken(path, value))
    with pytest.raises(ValueError, match=message):
        calibration.load(file)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"schema": NaN}', "null"])
def test_text_that_is_no_calibration_is_refused(text, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"mine\.json"):
        calibration.load(file)


def test_origin_is_not_optional(tmp_path):
    with pytest.raises(ValueError, match=r"provenance\.scenes, expected"):
        calibration.save(fitted(scenes=[]), tmp_path / "mine.json")
    with pytest.raises(FileNotFoundError, match="nobody: found no calibration"):
        calibration.load("nobody")


@pytest.mark.parametrize("name", calibration.available() or [None])
def test_what_travels_with_the_package_is_valid(name):
    if name is None:
        pytest.skip("no calibration travels with the package yet")
    found = calibration.load(name)
    assert found.provenance["method"] and found.provenance["scenes"] and found.to_json()


# ---------------------------------------------------------------------------------------------------- folds, intervals


def test_a_room_never_judges_itself():
    scenes = {name: scene_of(30, k) for k, name in enumerate("abcde")}
    folds = list(calibrate.leave_one_room_out(scenes, {"b": "kitchen", "d": "kitchen"}))
    assert [sorted(held) for _, held in folds] == [["a"], ["b", "d"], ["c"], ["e"]]
    assert [sorted(others) for others, _ in folds] == [list("bcde"), list("ace"), list("abde"), list("abcd")]
    assert [sorted(h) for _, h in calibrate.leave_one_room_out(scenes)] == [[c] for c in "abcde"]


def test_the_interval_of_ece_surrounds_ece():
    scenes = [scene_of(n, s, boast=0.4) for s, n in enumerate((300, 40, 900, 100))]
    silent = errors.points(torch.full((4,), math.nan), torch.ones(4))
    found = calibrate.ece_interval([*scenes, silent])
    assert found.value == pytest.approx(calibrate.measure(scenes)["ece"], abs=1e-12) and found.n == 4
    pairs = [[scenes[i] for i in row] for row in bootstrap.resample(4, 200, seed=5).tolist()]
    slow = torch.tensor([calibrate.measure(p)["ece"] for p in pairs], dtype=torch.float64).quantile(
        torch.tensor([0.025, 0.975], dtype=torch.float64)
    )
    quick = calibrate.ece_interval(scenes, draws=200, seed=5)
    assert [quick.low, quick.high] == pytest.approx(slow.tolist(), abs=1e-12)
    assert calibrate.ece_interval([silent]) == (None, None, None, 0)


def test_the_geometric_mean_of_ratios():
    found = bootstrap.interval([0.5, 2.0, None, 1.0], statistic="geometric_mean")
    assert found.value == pytest.approx(1) and found.n == 3 and 0.5 <= found.low < 1 < found.high <= 2
    halves = bootstrap.interval([0.25] * 5, statistic="geometric_mean")
    assert (halves.low, halves.value, halves.high) == pytest.approx((0.25, 0.25, 0.25))


def test_an_interval_of_any_number_leaves_undefined_draws_out():
    values = torch.tensor([1.0, math.nan, 3.0])
    found = bootstrap.interval_of(lambda index: values[index].nanmean(-1), 3, draws=500)
    assert found.value == 2 and 1 <= found.low <= 2 <= found.high <= 3
    assert bootstrap.interval_of(lambda index: index.sum(-1) * math.nan, 3).value is None


# ---------------------------------------------------------------------------------------------------- risk


def test_monotonicity_and_the_largest_fall_by_hand():
    true = torch.ones(20)
    rising = risk.measure(errors.points(true + torch.arange(20) / 100, true, 1 - torch.arange(20) / 20))
    assert rising["monotonicity"] == 1 and rising["largest_fall"] == 0
    wrong = true.clone()
    wrong[:2] = 1.5  # the two surest are the worst
    found = risk.measure(errors.points(wrong, true, 1 - torch.arange(20) / 20))
    assert found["monotonicity"] == 0 and found["largest_fall"] == pytest.approx(0.5 - 0.05)
    assert risk.measure(errors.points(true[:9], true[:9]))["largest_fall"] is None


@pytest.mark.parametrize("seed", range(3))
def test_the_largest_fall_equals_brute_force(seed):
    p = scene_of(333, seed, boast=0.0 if seed == 2 else 1.0)
    p = p.replace(score=uniform(p.keep.numel(), seed=seed))
    answered = p.answered()
    order = answered.score.argsort(descending=True)
    loss = answered.error.clamp(max=1)[order].tolist()
    tenths = [statistics.mean(loss[: len(loss) * k // 10]) for k in range(1, 11)]
    falls = [a - b for k, a in enumerate(tenths) for b in tenths[k:]]
    assert risk.measure(p)["largest_fall"] == pytest.approx(max(falls), abs=1e-12)


def test_realised_risk_at_a_threshold():
    p = scene_of(300, 1)
    for threshold in (0.0, 0.5, 0.8):
        sure = [min(e, 1.0) for e, s, k in zip(p.error, p.score, p.keep, strict=True) if k and s >= threshold]
        assert risk.realised(p, threshold) == pytest.approx(float(sum(sure) / len(sure)), abs=1e-12)
    assert risk.realised(p, 1.01) is None and risk.realised(p, None) is None


def test_the_surest_answers():
    p = scene_of(300, 1)
    kept = int(p.keep.sum())
    for n in (0, 1, 100, kept - 1, kept, kept + 9):
        cut = risk.surest(p, n)
        assert int(cut.keep.sum()) == min(n, kept) and cut.keep.numel() == 300
        best = sorted(p.score[p.keep].tolist(), reverse=True)[:n]
        assert sorted(cut.answered().score.tolist(), reverse=True) == best
        assert errors.measure(cut)["n_candidates"] == 300 and cut.depth[~cut.keep].isnan().all()


def test_a_cut_through_equal_scores_keeps_a_fair_sample_in_any_order():
    p = scene_of(2000, 1).replace(score=torch.ones(2000, dtype=torch.float64))
    p = p.replace(score=torch.where(p.keep, p.score, 0.0))
    cut = risk.surest(p, 101)
    assert int(cut.keep.sum()) == 101
    assert errors.measure(cut)["median_rel"] == pytest.approx(errors.measure(p)["median_rel"], rel=0.03)
    order = torch.randperm(2000, generator=generator(4))
    again = risk.surest(p[order], 101)
    assert errors.measure(again)["median_rel"] == errors.measure(cut)["median_rel"]


# ---------------------------------------------------------------------------------------------------- comparison


def seeds_of(scale, names="abcdef", n=400, **options):
    """Three seeds of every scene; errors are ``scale`` times those of scale 1."""
    return {
        name: [scene_of(n, 100 * k + seed, spread=scale, **options) for seed in range(3)]
        for k, name in enumerate(names)
    }


def test_ratios_are_medians_over_seeds_then_a_geometric_mean_over_scenes():
    paper, ours = seeds_of(1.0), seeds_of(0.5)
    found = compare.method_ratios({"paper": paper, "map": ours})
    expected = []
    for scene in paper:
        a, b = ([errors.measure(p)["median_rel"] for p in side[scene]] for side in (ours, paper))
        expected.append(statistics.median(a) / statistics.median(b))
    entry = found.summary["map.median_rel_ratio"]
    assert entry["value"] == pytest.approx(statistics.geometric_mean(expected)) == pytest.approx(0.5, abs=0.01)
    assert entry["low"] <= entry["value"] <= entry["high"] and entry["n"] == 6 and entry["unit"] == "1"
    assert [row["median_rel_ratio"] for row in found.rows] == pytest.approx(expected)
    aurc = [
        statistics.median(risk.measure(p)["aurc"] for p in ours[s])
        / statistics.median(risk.measure(p)["aurc"] for p in paper[s])
        for s in paper
    ]
    assert found.summary["map.aurc_ratio"]["value"] == pytest.approx(statistics.geometric_mean(aurc))
    worst = max(row["median_rel_ratio_at_equal_coverage"] for row in found.rows)
    assert found.summary["map.worst_scene_ratio"]["value"] == worst
    assert found.left_out == {"map": []}


def test_every_number_of_the_comparison_is_there():
    methods = {"paper": seeds_of(1.0), "map": seeds_of(0.5), "window": {"a": seeds_of(0.4)["a"]}}
    found = compare.method_ratios(methods, fallback={"window": "map"}, rooms={"b": "kitchen", "c": "kitchen"})
    names = "median_rel_ratio median_rel_ratio_at_equal_coverage worst_scene_ratio aurc_ratio coverage_at_5"
    names += " within_sigma within_2sigma ece realised_risk_10 realised_risk_5"
    for method, name in itertools.product(("map", "window"), names.split()):
        assert found.summary[f"{method}.{name}"]["value"] is not None, (method, name)
    assert not any(key.startswith("paper.") for key in found.summary)
    assert found.summary["map.within_sigma"]["value"] == pytest.approx(0.683, abs=0.03)
    assert found.summary["map.within_2sigma"]["value"] == pytest.approx(0.954, abs=0.02)
    assert found.summary["map.ece"]["value"] < 0.06 < found.summary["map.ece_raw"]["value"]
    assert found.summary["map.realised_risk_10"]["value"] <= 0.1
    rows = {(row["method"], row["scene"]): row for row in found.rows}
    assert rows["window", "b"]["median_rel_ratio"] == rows["map", "b"]["median_rel_ratio"]
    assert rows["window", "a"]["median_rel_ratio"] < rows["map", "a"]["median_rel_ratio"]


def test_promises_come_from_other_rooms():
    strange = {"f": seeds_of(8.0, "f")["f"]}  # errors eight times what sigma and score say
    ours = seeds_of(1.0, "abcde") | strange
    found = compare.method_ratios({"paper": seeds_of(1.0), "map": ours})
    row = next(r for r in found.rows if r["scene"] == "f")
    assert row["within_sigma"] < 0.2 and row["realised_risk_10"] > 0.2
    twins = compare.method_ratios({"paper": seeds_of(1.0, "ef"), "map": {"e": ours["e"]} | strange}, rooms={"e": "f"})
    assert "within_sigma" not in twins.rows[0] and twins.summary["map.ece"]["value"] is None


def test_at_equal_coverage_both_are_cut_to_the_smaller():
    paper, ours = seeds_of(1.0, silent=0.0), seeds_of(1.0, silent=0.6)
    a, b = compare.equal_coverage(ours, paper)
    for scene, seed in itertools.product(paper, range(3)):
        assert int(a[scene][seed].keep.sum()) == int(b[scene][seed].keep.sum()) == int(ours[scene][seed].keep.sum())
    found = compare.method_ratios({"paper": paper, "map": ours})
    assert found.summary["map.median_rel_ratio_at_equal_coverage"]["value"] > 1.3
    assert found.summary["map.median_rel_ratio"]["value"] == pytest.approx(1, abs=0.1)


def test_scenes_with_few_answers_are_named_and_leave_the_mean():
    ours = seeds_of(0.5) | {"c": [scene_of(400, s, silent=0.97) for s in range(3)]}
    found = compare.method_ratios({"paper": seeds_of(1.0), "map": ours})
    assert found.left_out == {"map": ["c"]} and found.summary["map.median_rel_ratio"]["n"] == 5
    assert next(r for r in found.rows if r["scene"] == "c")["median_rel_ratio"] is None
    bad = seeds_of(0.5) | {"c": [scene_of(400, s, silent=1.1) for s in range(3)]}
    found = compare.method_ratios({"paper": seeds_of(1.0), "map": bad})
    assert found.left_out == {"map": ["c"]} and found.silent["map.10"] == ["c"]
    realised = [row["realised_risk_10"] or 0.0 for row in found.rows]
    assert found.summary["map.realised_risk_10"]["value"] == pytest.approx(statistics.mean(realised))


def test_methods_that_do_not_match_raise():
    paper = seeds_of(1.0)
    with pytest.raises(ValueError, match=r"compare\.reference: found map, expected paper"):
        compare.method_ratios({"map": paper})
    with pytest.raises(ValueError, match=r"compare\.map\.a: found nothing, expected 3 seeds"):
        compare.method_ratios({"paper": paper, "map": {k: v for k, v in paper.items() if k != "a"}})
    with pytest.raises(ValueError, match=r"compare\.map\.b: found 2 seeds"):
        compare.method_ratios({"paper": paper, "map": paper | {"b": paper["b"][:2]}})
    with pytest.raises(ValueError, match=r"compare\.map\.z: found a scene"):
        compare.method_ratios({"paper": paper, "map": paper | {"z": paper["b"]}})


# ---------------------------------------------------------------------------------------------------- the seat


def answers(sigma, shared=0.0, depth=2.0, residual=0.0, gate=None, error=0.0, photometric=0.0):
    """An estimate (1, N) and what else the seat takes."""
    sigma = torch.as_tensor(sigma, dtype=torch.float64)[None]
    like = torch.ones_like(sigma)
    gate = torch.zeros_like(sigma).int() if gate is None else torch.tensor([gate], dtype=torch.int32)
    silent = gate != 0
    blank = lambda x: torch.where(silent, torch.nan, x * like)  # noqa: E731
    uv = torch.zeros(*sigma.shape, 2, dtype=torch.float64)
    estimate = Estimate(
        uv, blank(depth), blank(sigma), blank(shared), 0 * like, residual * like, gate, 1.0 - silent.double(), gate
    )
    samples = Samples(uv, like, like, torch.zeros(*sigma.shape, 3), like, gate, like, gate)
    cov = torch.eye(2, dtype=torch.float64).expand(*sigma.shape, 2, 2)
    tracks = Tracks(uv, uv, error * like, photometric * like, cov, ~silent)
    none = torch.zeros(1)
    return estimate, samples, tracks, PoseFit(None, none, none, none, none, none, none, none)


def scores(*args, **options):
    return score.rank_by_error(*answers(*args), **options).score[0]


def test_the_score_is_the_stated_function_of_the_expected_error():
    sigma, shared = torch.tensor([0.1, 0.5, 2.0]), 0.06
    found = score.rank_by_error(*answers(sigma, shared, residual=0.8), residual_scale_px=0.5, half_error=0.2).score[0]
    expected = [math.sqrt(s * s - shared * shared) / 2 * math.sqrt(1 + (0.8 / 0.5) ** 2) for s in sigma.tolist()]
    assert found.tolist() == pytest.approx([0.2 / (0.2 + e) for e in expected], rel=1e-6)


def test_the_score_falls_with_every_reason_to_doubt():
    rising = torch.linspace(1e-3, 3, 50, dtype=torch.float64)
    own = scores(rising)
    assert (own.diff() < 0).all() and 0 < own[-1] < own[0] < 1
    for name, option in (
        ("residual", "residual_scale_px"),
        ("photometric", "photometric_scale"),
        ("error", "round_trip_scale_px"),
    ):
        worse = [
            score.rank_by_error(*answers([0.1], **{name: x}), **{option: 0.5}).score.item() for x in (0, 0.1, 1, 9)
        ]
        assert worse == sorted(worse, reverse=True) and len(set(worse)) == 4, name
    ignored = score.rank_by_error(*answers([0.1], photometric=3.0, error=2.0), round_trip_scale_px=None).score
    assert ignored == score.rank_by_error(*answers([0.1])).score


def test_what_a_pair_shares_moves_no_rank_and_never_flatters():
    shared = torch.tensor([0.0, 0.3, 3.0])
    whole = (0.1**2 + shared**2).sqrt()
    estimate, *rest = answers(whole.double())
    estimate = estimate.replace(sigma_shared=shared.double()[None])
    assert score.rank_by_error(estimate, *rest).score[0].tolist() == pytest.approx([0.1 / (0.1 + 0.05)] * 3, rel=1e-4)
    swamped = score.rank_by_error(*answers([10.0], 10.0)).score.item()
    assert swamped <= 0.1 / (0.1 + 10.0 / 2 * math.sqrt(score.OWN_SHARE)) + 1e-9


def test_answers_without_a_stated_error_score_zero_and_silence_stays():
    estimate, *rest = answers([0.1, math.nan, math.inf, 0.1, 0.1], gate=[0, 0, 0, Gate.PARALLAX, 0])
    out = score.rank_by_error(estimate, *rest)
    assert out.score[0].tolist() == pytest.approx([2 / 3, 0, 0, 0, 2 / 3])
    assert out.gate[0].tolist() == [0, 0, 0, Gate.PARALLAX, 0] and out.depth[0, 3].isnan()
    cut = score.rank_by_error(estimate, *rest, min_score=0.5)
    assert cut.gate[0].tolist() == [0, Gate.LOW_SCORE, Gate.LOW_SCORE, Gate.PARALLAX, 0]
    assert cut.depth[0].isnan().tolist() == [False, True, True, True, False] == cut.sigma[0].isnan().tolist()


def test_a_recalibrated_score_is_the_tables_probability():
    table = fitted().probability
    sigma = torch.linspace(0.01, 2, 40, dtype=torch.float64)
    raw, out = scores(sigma), scores(sigma, recalibration=table)
    assert torch.equal(out, table(raw)) and (out.diff() < 0).all()
    limit = fitted().min_score(10)
    kept = score.rank_by_error(*answers(sigma), recalibration=table, min_score=limit).keep[0]
    assert torch.equal(kept, raw >= fitted().thresholds[10]) and 0 < kept.sum() < 40


@pytest.mark.parametrize("kind", ["table", "sigmoid"])
def test_a_recalibrated_seat_captures_maps_differentiates_and_keeps_to_itself(kind):
    learnt = fitted()
    seat = functools.partial(
        score.rank_by_error, recalibration=learnt.probability if kind == "table" else learnt.sigmoid
    )
    _, *rest = answers([0.1] * 37)
    sigma = 0.01 + uniform(5, 37)
    estimate = answers([0.1] * 37)[0].map(lambda x: x.expand(5, *x.shape[1:])).replace(sigma=sigma)

    def out(s, estimate=estimate):
        records = [r.map(lambda x: x[:1].expand(s.shape[0], *x.shape[1:])) for r in (estimate, *rest[:2])]
        return seat(records[0].replace(sigma=s), *records[1:], rest[2]).score

    torch.set_num_threads(1)
    together = out(sigma.float())
    for b in range(5):
        assert torch.equal(together[b : b + 1], out(sigma[b : b + 1].float()))
    torch._dynamo.reset()
    assert torch.equal(torch.compile(out, fullgraph=True, backend="eager")(sigma), out(sigma))
    assert torch.allclose(torch.func.vmap(lambda s: out(s[None])[0])(sigma), out(sigma))
    assert torch.autograd.gradcheck(out, (sigma[:1].clone().requires_grad_(),))
