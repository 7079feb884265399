"""One method against another, over seeds, scenes and rooms: by plain loops."""

import functools
import math
import statistics

import pytest
import torch

from dhtorch import pytree
from dhtorch.experiments import compare_methods as compare
from dhtorch.metrics import bootstrap, control, errors, reliability, risk
from dhtorch.metrics.calibration.fitting import fit_calibration


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


def test_promises_equal_plain_loops():
    """Every scene with a calibration learnt from the other rooms alone, its seeds joined."""
    ours, room = small(1.0, names="abcd"), {"a": "hall", "b": "hall"}
    found = compare.method_ratios({"paper": small(0.8, names="abcd"), "map": ours}, rooms=room, draws=200, seed=2)
    joined = {scene: pytree.collate(points) for scene, points in ours.items()}
    applied, sigmoid, realised = {}, {}, {5: [], 10: []}
    for scene, row in zip("abcd", found.rows, strict=True):
        others = [joined[s] for s in "abcd" if room.get(s, s) != room.get(scene, scene)]
        nine_in_ten = functools.partial(control.scene_quantile_threshold, few=100 * len(ours[scene]))
        learnt = fit_calibration(others, targets=(10, 5), choose=nine_in_ten)
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


def median_rel(points):
    return errors.measure_errors(points)["median_rel"]


def defined_above(points):
    return None if float(points.depth[0]) < 1.4 else median_rel(points)


ENOUGH, FEW = [exact(20, 0.5), exact(20, 0.5), exact(3, 0.5)], [exact(19, 0.25), exact(19, 0.25), exact(90, 0.25)]


@pytest.mark.parametrize(
    ("ours", "theirs", "measure", "options", "ratio"),
    [
        (ENOUGH, ENOUGH, median_rel, {}, 1),  # the twentieth answer of the median seed counts
        (ENOUGH, FEW, median_rel, {}, None),
        (FEW, ENOUGH, median_rel, {}, None),
        (ENOUGH, FEW, median_rel, {"min_answers": 19}, 2),
        ([exact(30)], [exact(30, 0.5)], median_rel, {}, 2e-6),  # errors below a millionth count as one
        ([exact(30, 0.5)], [exact(30)], median_rel, {}, 5e5),
        ([exact(30)], [exact(30)], median_rel, {}, 1),
        (
            [exact(30, 0.5), exact(30, 0.25)],
            [exact(30, 0.5)] * 2,
            defined_above,
            {},
            1,
        ),  # seeds without it do not count
        ([exact(30, 0.5)], [exact(30, 0.5)], lambda _: None, {}, None),
    ],
)
def test_a_ratio_needs_twenty_answers_of_the_median_seed(ours, theirs, measure, options, ratio):
    found = compare.ratio_over_seeds({"a": ours}, {"a": theirs}, measure, **options)
    assert found == (({}, ["a"]) if ratio is None else ({"a": pytest.approx(ratio)}, []))


def test_a_scene_without_any_error_is_not_silent():
    perfect, paper = ({name: [exact(130, error)] for name in "abc"} for error in (0.0, 0.5))
    found = compare.method_ratios({"paper": paper, "map": perfect}, draws=20)
    assert found.unanswered == {"map.10": [], "map.5": []} and found.summary["map.realised_risk_5"]["value"] == 0
    back = compare.method_ratios({"map": perfect, "paper": paper}, reference="map", draws=20)
    assert back.unanswered == {"paper.10": list("abc"), "paper.5": list("abc")}
    assert back.summary["paper.within_target_5"]["value"] is None, "silence counts neither way"


def test_a_fallback_fills_only_what_a_method_lacks():
    paper, ours = small(1.0), small(0.5)
    several = {"b": small(0.4)["b"]}
    found = compare.method_ratios({"paper": paper, "map": ours, "auto": several}, fallback={"auto": "map"}, draws=20)
    alone = compare.method_ratios({"paper": paper, "auto": {**ours, **several}}, draws=20)
    assert [r for r in found.rows if r["method"] == "auto"] == alone.rows
    assert set(found.unanswered) == {"map.10", "map.5", "auto.10", "auto.5"}
    assert not compare.method_ratios({"base": paper}, reference="base").summary
    assert found != compare.method_ratios({"paper": paper, "map": ours, "auto": several}, fallback={"auto": "map"})


PAPER = small(1.0)


@pytest.mark.parametrize(
    ("methods", "sentence"),
    [
        ({}, "found no method, expected paper among them"),
        ({"map": PAPER}, r"compare\.reference: found map, expected paper"),
        ({"paper": PAPER, "map": {"b": PAPER["b"]}}, r"compare\.map\.a: found nothing, expected 2 seeds as paper"),
        ({"paper": PAPER, "map": PAPER | {"b": PAPER["b"][:1]}}, r"compare\.map\.b: found 1 seeds"),
        ({"paper": PAPER, "map": PAPER | {"z": PAPER["b"]}}, r"compare\.map\.z: found a scene"),
    ],
)
def test_methods_that_do_not_match_raise(methods, sentence):
    with pytest.raises(ValueError, match=sentence):
        compare.method_ratios(methods)


def test_known_errors_give_known_numbers():
    """Sigma is right, errors halve, and one room is eight times off what its score and sigma state."""
    paper = small(1.0, n=400, names="abcdef", seeds=3)
    ours = small(0.5, n=400, names="abcde", seeds=3) | {"f": small(8.0, n=150, names="f", seeds=3)["f"]}
    ours["c"] = [scene_of(150, s, silent=1.1) for s in range(3)]
    found = compare.method_ratios({"paper": paper, "map": ours})
    rows = {row["scene"]: row for row in found.rows}
    assert (
        rows["a"]["median_rel_ratio"] == pytest.approx(0.5, abs=0.06)
        and found.summary["map.median_rel_ratio"]["n"] == 5
    )
    assert found.left_out == {"map": ["c"]} and found.unanswered["map.10"] == ["c"] and rows["c"]["aurc_ratio"] is None
    assert rows["f"]["within_sigma"] < 0.2 and rows["f"]["realised_risk_10"] > 0.2
    honest = compare.method_ratios({"paper": paper, "map": small(1.0, n=400, names="abcdef", seeds=3)}).summary
    assert honest["map.within_sigma"]["value"] == pytest.approx(0.683, abs=0.03)
    assert honest["map.within_2sigma"]["value"] == pytest.approx(0.954, abs=0.02)
    assert honest["map.ece"]["value"] < 0.06 < honest["map.ece_raw"]["value"]
    one_room = compare.method_ratios({"paper": small(1.0, names="ef"), "map": small(1.0, names="ef")}, rooms={"e": "f"})
    assert "within_sigma" not in one_room.rows[0] and one_room.summary["map.ece"]["value"] is None


def test_one_method_against_another_with_its_silence():
    """Ratios at equal coverage as in the comparison, the worst of them, and areas in which silence counts as one."""
    ours, theirs = small(0.5, silent=0.1, n=90), small(1.0, silent=0.6, n=90)
    numbers, rows = compare.multiview_ratios(ours, theirs, "other", draws=50)
    cut = compare.cut_to_equal_coverage(ours, theirs)
    equal, _ = compare.ratio_over_seeds(*cut, median_rel)
    assert numbers["error_ratio_to_other"].value == pytest.approx(math.prod(equal.values()) ** (1 / 3))
    assert numbers["worst_scene_ratio_to_other"].value == max(equal.values())
    full = []
    for scene in ours:
        assert [int(p.keep.sum()) for p in cut[0][scene]] == [int(p.keep.sum()) for p in theirs[scene]]
        areas = [median(risk.measure_risk(p)["aurc_full"] for p in side[scene]) for side in (ours, theirs)]
        full.append(areas[0] / areas[1])
        assert rows[scene]["error_ratio_to_other"] == equal[scene]
        assert rows[scene]["aurc_full_ratio_to_other"] == pytest.approx(full[-1])
    value = numbers["aurc_full_ratio_to_other"].value
    assert value == pytest.approx(math.prod(full) ** (1 / 3)) and value < 0.6
    mute = {name: [p.replace(keep=torch.zeros_like(p.keep)) for p in seeds] for name, seeds in theirs.items()}
    numbers, rows = compare.multiview_ratios(mute, theirs, "other", draws=20)
    assert numbers["error_ratio_to_other"].value is None and numbers["worst_scene_ratio_to_other"].value is None
    assert numbers["aurc_full_ratio_to_other"].value > 1 and all(len(row) == 1 for row in rows.values())


def test_a_target_is_counted_where_a_hundred_answers_are_above_its_threshold():
    n = {name: [scene_of(400, k, spread=0.2)] for k, name in enumerate("abcd")}
    for scenes, counted in ((n, 4), (n | {"d": [n["d"][0][:90]]}, 3)):
        found = compare.method_ratios({"paper": scenes, "map": scenes}, draws=20)
        kept = [row["realised_risk_10"] <= 0.1 for row in found.rows if row["n_above_10"] >= 100]
        assert len(kept) == found.summary["map.within_target_10"]["n"] == counted
        assert found.summary["map.within_target_10"]["value"] == pytest.approx(statistics.mean(kept)) and kept[0]
        assert found.summary["map.ece_scenes"]["n"] == 4
