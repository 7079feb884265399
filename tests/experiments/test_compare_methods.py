"""One method against another, over seeds, scenes and rooms: by plain loops."""

import functools
import itertools
import math
import statistics

import pytest
import torch

from dhtorch import pytree
from dhtorch.experiments import compare_methods as compare
from dhtorch.metrics import bootstrap, calibration, control, errors, reliability, risk


def scene_of(n, seed=0, spread=1.0, silent=0.2, boast=1.0, floor=0.0):
    """Answers whose error is normal with a known relative sigma, and a score that falls with it."""
    g = torch.Generator().manual_seed(seed)
    rel = 0.02 + 0.3 * torch.rand(n, generator=g, dtype=torch.float64) ** 2
    true = 2 + 4 * torch.rand(n, generator=g, dtype=torch.float64)
    noise = ((spread * rel) ** 2 + floor**2).sqrt() * torch.randn(n, generator=g, dtype=torch.float64)
    depth = (true * (1 + noise)).clamp_min(0.01)
    keep = torch.rand(n, generator=g, dtype=torch.float64) >= silent
    return errors.make_points(depth, true, (0.1 / (0.1 + rel)) ** boast, sigma=rel * true, keep=keep)


def median(values):
    return statistics.median(v for v in values if v is not None)


def small(scale, n=60, names="abc", seeds=2, **options):
    """Two seeds of three scenes, the seeds of different size, so that nothing is exchangeable."""
    return {
        name: [scene_of(n + 9 * k + 7 * seed, 10 * k + seed, spread=scale, **options) for seed in range(seeds)]
        for k, name in enumerate(names)
    }


def test_ratios_equal_plain_loops():
    paper, ours = small(1.0, silent=0.3), small(0.6, silent=0.5, boast=0.5)
    found = compare.method_ratios({"map": ours, "paper": paper}, draws=300, seed=4)
    own, equal, ranked, covered = [], [], [], []
    for scene in paper:
        pairs = list(zip(ours[scene], paper[scene], strict=True))
        own.append([median(errors.measure_errors(p)["median_rel"] for p in side) for side in zip(*pairs, strict=True)])
        ranked.append([median(risk.measure_risk(p)["aurc"] for p in side) for side in zip(*pairs, strict=True)])
        covered.append(median(risk.measure_risk(p)["coverage_at_5"] for p in ours[scene]))
        cut = []
        for pair in pairs:  # the surest of either, as many as the more silent one answers
            n = min(int(p.keep.sum()) for p in pair)
            rows = [sorted(zip(p.answered().score.tolist(), p.answered().error.tolist(), strict=True)) for p in pair]
            cut.append([median(e for _, e in row[-n:]) for row in rows])
        equal.append([median(side) for side in zip(*cut, strict=True)])
    for name, ratios in (
        ("median_rel_ratio", own),
        ("median_rel_ratio_at_equal_coverage", equal),
        ("aurc_ratio", ranked),
    ):
        each = [a / b for a, b in ratios]
        wanted = bootstrap.interval_over_scenes(each, statistic="geometric_mean", draws=300, seed=4)
        entry = found.summary[f"map.{name}"]
        assert entry["value"] == pytest.approx(math.prod(each) ** (1 / 3)), name
        assert [entry[k] for k in ("low", "high", "n", "unit")] == pytest.approx([wanted.low, wanted.high, 3, "1"]), (
            name
        )
        assert [row[name] for row in found.rows] == pytest.approx(each), name
    worst = found.summary["map.worst_scene_ratio"]
    assert worst["value"] == pytest.approx(max(a / b for a, b in equal)) and (worst["low"], worst["n"]) == (None, 3)
    entry = found.summary["map.coverage_at_5"]
    assert (
        entry["value"] == pytest.approx(statistics.mean(covered))
        and [r["coverage_at_5"] for r in found.rows] == covered
    )
    assert [(row["method"], row["scene"]) for row in found.rows] == [("map", s) for s in "abc"]


def test_intervals_are_those_of_2000_draws_unless_asked_otherwise():
    paper, ours = small(1.0, names="abcde", seeds=1), small(0.6, names="abcde", seeds=1, silent=0.5)
    found = compare.method_ratios({"paper": paper, "map": ours})
    assert found == compare.method_ratios({"paper": paper, "map": ours}, draws=2000, seed=0)
    assert found != compare.method_ratios({"paper": paper, "map": ours}, draws=2000, seed=1)


def test_seeds_are_paired_and_a_lone_one_raises():
    one, two = small(1.0, names="a", seeds=1), small(1.0, names="a", seeds=2)
    with pytest.raises(ValueError, match="shorter"):
        compare.cut_to_equal_coverage(two, one)


def test_promises_equal_plain_loops():
    """Every scene with a calibration learnt from the other rooms alone, its seeds joined."""
    ours, room = small(1.0, names="abcd"), {"a": "hall", "b": "hall"}
    found = compare.method_ratios({"paper": small(0.8, names="abcd"), "map": ours}, rooms=room, draws=200, seed=2)
    joined = {scene: pytree.collate(points) for scene, points in ours.items()}
    applied, sigmoid, realised = {}, {}, {5: [], 10: []}
    for scene, row in zip("abcd", found.rows, strict=True):
        others = [joined[s] for s in "abcd" if room.get(s, s) != room.get(scene, scene)]
        nine_in_ten = functools.partial(control.scene_quantile_threshold, few=100 * len(ours[scene]))
        learnt = calibration.fit_calibration(others, targets=(10, 5), choose=nine_in_ten)
        applied[scene] = learnt.apply(joined[scene])
        claimed = learnt.sigmoid(joined[scene].score)
        sigmoid[scene] = joined[scene].replace(score=torch.where(joined[scene].keep, claimed, 0.0))
        stated = errors.measure_errors(applied[scene])
        for name in ("within_sigma", "within_2sigma"):
            assert row[name] == stated[name], name
        for percent, values in realised.items():
            values.append(risk.realised_risk(joined[scene], learnt.thresholds[percent]))
            assert row[f"realised_risk_{percent}"] == values[-1]
            above = joined[scene].keep & (joined[scene].score >= (learnt.thresholds[percent] or math.inf))
            assert row[f"coverage_within_{percent}"] == pytest.approx(float(above.double().mean()))
            assert row[f"n_above_{percent}"] == pytest.approx(int(above.sum()) / len(ours[scene]))
    for name in ("within_sigma", "within_2sigma"):
        wanted = bootstrap.interval_over_scenes([row[name] for row in found.rows], statistic="mean", draws=200, seed=2)
        assert list(found.summary[f"map.{name}"].values())[:3] == list(wanted[:3]), name
    for percent, values in realised.items():
        counted = [v or 0.0 for v in values]
        assert found.summary[f"map.realised_risk_{percent}"]["value"] == pytest.approx(statistics.mean(counted))
        covered = statistics.mean(row[f"coverage_within_{percent}"] for row in found.rows)
        assert found.summary[f"map.coverage_within_{percent}"]["value"] == pytest.approx(covered)
        spoke = [v for v in values if v is not None]
        speaking = found.summary[f"map.risk_of_speaking_{percent}"]["value"]
        assert speaking == (pytest.approx(statistics.mean(spoke)) if spoke else None)
        enough = [row[f"n_above_{percent}"] >= 100 for row in found.rows]
        met = [v <= percent / 100 for v, counts in zip(counted, enough, strict=True) if counts]
        expected = pytest.approx(statistics.mean(met)) if met else None
        assert found.summary[f"map.within_target_{percent}"]["value"] == expected
        assert found.unanswered[f"map.{percent}"] == [s for s, v in zip("abcd", values, strict=True) if v is None]
    for name, scenes in (("ece", applied), ("ece_sigmoid", sigmoid), ("ece_raw", joined)):
        wanted = reliability.ece_interval(list(scenes.values()), draws=200, seed=2)
        assert list(found.summary[f"map.{name}"].values())[:3] == list(wanted[:3]), name


def exact(n, error=0.0):
    return errors.make_points(torch.full((n,), 1 + error), torch.ones(n))


def test_a_scene_counts_from_the_twentieth_answer_of_the_median_seed():
    def ratio(ours, theirs, **options):
        return compare.ratio_over_seeds(
            {"a": ours}, {"a": theirs}, lambda p: errors.measure_errors(p)["median_rel"], **options
        )

    enough, few = [exact(20, 0.5), exact(20, 0.5), exact(3, 0.5)], [exact(19, 0.25), exact(19, 0.25), exact(90, 0.25)]
    assert ratio(enough, enough) == ({"a": 1.0}, [])
    assert ratio(enough, few) == ratio(few, enough) == ({}, ["a"])
    found, left_out = ratio(enough, few, min_answers=19)
    assert found["a"] == pytest.approx(2) and left_out == []


def test_errors_below_a_millionth_count_as_one():
    measure = lambda p: errors.measure_errors(p)["median_rel"]  # noqa: E731
    ours, theirs = {"a": [exact(30)]}, {"a": [exact(30, 0.5)]}
    assert compare.ratio_over_seeds(ours, theirs, measure)[0]["a"] == pytest.approx(2e-6)
    assert compare.ratio_over_seeds(theirs, ours, measure)[0]["a"] == pytest.approx(5e5)
    assert compare.ratio_over_seeds(ours, ours, measure)[0]["a"] == 1


def test_a_scene_without_any_error_is_not_silent():
    perfect, paper = ({name: [exact(130, error)] for name in "abc"} for error in (0.0, 0.5))
    found = compare.method_ratios({"paper": paper, "map": perfect}, draws=20)
    assert found.unanswered == {"map.10": [], "map.5": []} and found.summary["map.realised_risk_5"]["value"] == 0
    back = compare.method_ratios({"map": perfect, "paper": paper}, reference="map", draws=20)
    assert back.unanswered == {"paper.10": list("abc"), "paper.5": list("abc")}
    assert back.summary["paper.within_target_5"]["value"] is None, "silence counts neither way"


def test_seeds_without_the_number_are_passed_over_and_a_scene_without_any_is_left_out():
    ours, theirs = {"a": [exact(30, 0.5), exact(30, 0.25)]}, {"a": [exact(30, 0.5)] * 2}
    some = lambda p: None if float(p.depth[0]) < 1.4 else errors.measure_errors(p)["median_rel"]  # noqa: E731
    assert compare.ratio_over_seeds(ours, theirs, some)[0] == {"a": 1.0}
    assert compare.ratio_over_seeds(ours, theirs, lambda _: None) == ({}, ["a"])


def test_a_fallback_fills_only_what_a_method_lacks_and_silence_of_a_target_is_named():
    paper, ours = small(1.0), small(0.5)
    window = {"b": small(0.4)["b"]}
    found = compare.method_ratios({"paper": paper, "map": ours, "window": window}, fallback={"window": "map"}, draws=20)
    alone = compare.method_ratios({"paper": paper, "window": {**ours, **window}}, draws=20)
    assert [r for r in found.rows if r["method"] == "window"] == alone.rows
    assert set(found.unanswered) == {"map.10", "map.5", "window.10", "window.5"}
    with pytest.raises(ValueError, match=r"compare\.window\.a: found nothing, expected 2 seeds as paper"):
        compare.method_ratios({"paper": paper, "map": ours, "window": window})
    assert not compare.method_ratios({"base": paper}, reference="base").summary
    with pytest.raises(ValueError, match="found no method, expected paper among them"):
        compare.method_ratios({})


# ---------------------------------------------------------------------------------------------------- larger scenes


def seeds_of(scale, names="abcdef", n=150, **options):
    """Three seeds of every scene; errors are ``scale`` times those of scale 1."""
    return {
        name: [scene_of(n, 100 * k + seed, spread=scale, **options) for seed in range(3)]
        for k, name in enumerate(names)
    }


def test_ratios_are_medians_over_seeds_then_a_geometric_mean_over_scenes():
    paper, ours = seeds_of(1.0, n=400), seeds_of(0.5, n=400)
    found = compare.method_ratios({"paper": paper, "map": ours})
    expected = []
    for scene in paper:
        a, b = ([errors.measure_errors(p)["median_rel"] for p in side[scene]] for side in (ours, paper))
        expected.append(statistics.median(a) / statistics.median(b))
    entry = found.summary["map.median_rel_ratio"]
    assert entry["value"] == pytest.approx(statistics.geometric_mean(expected)) == pytest.approx(0.5, abs=0.01)
    assert entry["low"] <= entry["value"] <= entry["high"] and entry["n"] == 6 and entry["unit"] == "1"
    assert [row["median_rel_ratio"] for row in found.rows] == pytest.approx(expected)
    aurc = [
        statistics.median(risk.measure_risk(p)["aurc"] for p in ours[s])
        / statistics.median(risk.measure_risk(p)["aurc"] for p in paper[s])
        for s in paper
    ]
    assert found.summary["map.aurc_ratio"]["value"] == pytest.approx(statistics.geometric_mean(aurc))
    worst = max(row["median_rel_ratio_at_equal_coverage"] for row in found.rows)
    assert found.summary["map.worst_scene_ratio"]["value"] == worst
    assert found.left_out == {"map": []}


def test_every_number_of_the_comparison_is_there():
    paper, ours = (seeds_of(scale, names="abcd", n=400) for scale in (1.0, 0.5))
    methods = {"paper": paper, "map": ours, "window": {"a": seeds_of(0.4, n=400)["a"]}}
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
    a, b = compare.cut_to_equal_coverage(ours, paper)
    for scene, seed in itertools.product(paper, range(3)):
        assert int(a[scene][seed].keep.sum()) == int(b[scene][seed].keep.sum()) == int(ours[scene][seed].keep.sum())
    found = compare.method_ratios({"paper": paper, "map": ours})
    assert found.summary["map.median_rel_ratio_at_equal_coverage"]["value"] > 1.3
    assert found.summary["map.median_rel_ratio"]["value"] == pytest.approx(1, abs=0.1)


def test_scenes_with_few_answers_are_named_and_leave_the_mean():
    ours = seeds_of(0.5) | {"c": [scene_of(150, s, silent=0.97) for s in range(3)]}
    found = compare.method_ratios({"paper": seeds_of(1.0), "map": ours})
    assert found.left_out == {"map": ["c"]} and found.summary["map.median_rel_ratio"]["n"] == 5
    assert next(r for r in found.rows if r["scene"] == "c")["median_rel_ratio"] is None
    bad = seeds_of(0.5) | {"c": [scene_of(150, s, silent=1.1) for s in range(3)]}
    found = compare.method_ratios({"paper": seeds_of(1.0), "map": bad})
    assert found.left_out == {"map": ["c"]} and found.unanswered["map.10"] == ["c"]
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


def test_one_method_against_another_with_its_silence():
    """Ratios at equal coverage as in the comparison, the worst of them, and areas in which silence counts as one."""
    ours, theirs = small(0.5, silent=0.1, n=90), small(1.0, silent=0.6, n=90)
    numbers, rows = compare.multiview_ratios(ours, theirs, "window", draws=50)
    equal, _ = compare.ratio_over_seeds(
        *compare.cut_to_equal_coverage(ours, theirs), lambda p: errors.measure_errors(p)["median_rel"]
    )
    assert numbers["error_ratio_to_window"].value == pytest.approx(math.prod(equal.values()) ** (1 / 3))
    assert numbers["worst_scene_ratio_to_window"].value == max(equal.values())
    full = []
    for scene in ours:
        areas = [median(risk.measure_risk(p)["aurc_full"] for p in side[scene]) for side in (ours, theirs)]
        full.append(areas[0] / areas[1])
        assert rows[scene] == {
            "error_ratio_to_window": equal[scene],
            "aurc_full_ratio_to_window": pytest.approx(full[-1]),
        }
    value = numbers["aurc_full_ratio_to_window"].value
    assert value == pytest.approx(math.prod(full) ** (1 / 3)) and value < 0.6


def test_a_method_that_is_silent_has_an_area_but_no_error_to_compare():
    mute = {name: [p.replace(keep=torch.zeros_like(p.keep)) for p in seeds] for name, seeds in small(1.0).items()}
    numbers, rows = compare.multiview_ratios(mute, small(1.0), "window", draws=20)
    assert numbers["error_ratio_to_window"].value is None and numbers["worst_scene_ratio_to_window"].value is None
    assert numbers["aurc_full_ratio_to_window"].value > 1 and all(len(row) == 1 for row in rows.values())


def test_a_target_is_counted_where_a_hundred_answers_are_above_its_threshold():
    n = {name: [scene_of(400, k, spread=0.2)] for k, name in enumerate("abcd")}
    few = n | {"d": [n["d"][0][:90]]}
    for scenes, counted in ((n, 4), (few, 3)):
        found = compare.method_ratios({"paper": scenes, "map": scenes}, draws=20)
        kept = [row["realised_risk_10"] <= 0.1 for row in found.rows if row["n_above_10"] >= 100]
        assert len(kept) == found.summary["map.within_target_10"]["n"] == counted
        assert found.summary["map.within_target_10"]["value"] == pytest.approx(statistics.mean(kept)) and kept[0]
        assert found.summary["map.ece_scenes"]["n"] == 4
