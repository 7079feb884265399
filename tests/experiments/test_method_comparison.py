"""Methods against the paper's, several seeds: what is compared, what is named, and a verdict that goes either way."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from hydra import compose as compose_settings
from hydra import initialize_config_dir
from hydra.utils import instantiate
from support import numbered_frames as stepping

from dhtorch.cli.run import config_dir
from dhtorch.codes import Gate
from dhtorch.data.pairs import by_gap, candidate_frames
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments.compare import method_comparison
from dhtorch.experiments.protocol import Settings
from dhtorch.metrics import errors, uncertainty
from dhtorch.metrics.calibration import load_calibration
from dhtorch.records import Estimate
from dhtorch.synthetic.recording import open_rooms
from dhtorch.synthetic.stress import STRESSES


def method(name="paper"):
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        return instantiate(compose_settings("run", [f"method={name}", "method.n=768"]).method, _convert_="all")


@pytest.fixture(scope="module")
def outcome():
    rooms = open_rooms(("walk", "lateral", "rotation"), n_frames=4, hw=(192, 256), gap=3, lidar="exact")
    methods = {"paper": method(), "strict": method().replace(triangulate={"max_residual_px": 0.5})}
    methods["opencv"] = method("opencv")
    methods["kornia"] = methods["paper"]  # a twin that agrees whatever the scene
    moving = ["synthetic_lateral", "synthetic_rotation", "elsewhere"]
    return method_comparison.run(rooms, {}, by_gap, Settings(), methods=methods, seeds=2, moving=moving)


def candidates(answered, wrong, silent):
    depth = torch.tensor([1.0] * answered + [1.3] * wrong + [torch.nan] * silent)
    return errors.make_points(depth, torch.ones_like(depth))


def test_the_worst_room_is_the_one_with_most_wrong_answers_a_candidate():
    few = [candidates(0, 1, 9), candidates(0, 3, 7)]  # all that is said is wrong, but little is said
    many = [candidates(5, 4, 1), candidates(7, 2, 1)]
    found = compare.worst_wrong_share("map", [few, many, [candidates(0, 0, 0)]])
    assert found["map.convoy_wrong"]["value"] == pytest.approx(0.3) and found["map.convoy_wrong"]["n"] == 2
    assert compare.worst_wrong_share("map", []) == {}


def judged(**changes):
    good = {"median_rel_ratio": 0.6, "worst_scene_ratio": 1.0, "aurc_ratio": 0.5, "coverage_at_5": 0.3}
    good |= {"within_sigma": 0.7, "within_2sigma": 0.95, "ece": 0.05, "realised_risk_10": 0.08}
    values = good | {"realised_risk_5": 0.04} | changes
    return compare.MethodComparison(summary={f"map.{k}": {"value": v} for k, v in values.items()})


@pytest.mark.slow
def test_a_method_that_chooses_is_offered_the_frames_around_and_held_against_the_window():
    rooms = open_rooms(("walk", "lateral"), n_frames=7, hw=(192, 256), gap=3, lidar="exact")
    rooms = [replace(room, room=name) for room, name in zip(rooms, ("hall", "attic"), strict=True)]
    methods = {"paper": method(), "map": method("map"), "window": method("map").replace(views=2)}
    methods["auto"] = method("auto").replace(views=3)
    pairs = partial(by_gap, gap=3, stride=3)
    found = method_comparison.run(
        rooms, {}, pairs, Settings(), methods=methods, seeds=1, indoor=["hall"], baselines=["window"]
    )
    rows = [r for r in found.rows if r["method"] == "auto" and r["pair"] is not None]
    assert rows and all(len(r["views"]) == 3 and r["pair"][0] not in r["views"] for r in rows)
    assert all("views" not in r for r in found.rows if r["method"] == "window")
    for key in ("error_ratio_to_window", "aurc_full_ratio_to_window", "worst_scene_ratio_to_window"):
        assert found.summary[f"auto.{key}"]["value"] > 0
    assert found.summary["auto.coverage_at_5_indoor"]["n"] == 1
    assert not any(k.startswith("map.error_ratio_to") for k in found.summary)
    scenes = found.scenes("auto")
    assert "aurc_full_ratio_to_window" in scenes["synthetic_walk"]
    assert scenes["synthetic_walk"]["coverage"] > found.scenes("window")["synthetic_walk"]["coverage"] - 0.02


def test_a_scene_of_too_few_candidates_keeps_a_row_and_has_no_ratio():
    blind = stepping.scene("dark", load=lambda i: stepping.frame(i).replace(depth=torch.zeros(1, 48, 64)))
    methods = {"paper": stepping.MAP, "window": stepping.MAP.replace(views=2), "auto": stepping.choosing(2, 3)}
    scenes = [blind, stepping.scene()]
    pairs = partial(by_gap, stride=4)
    found = method_comparison.run(
        scenes, {}, pairs, Settings(), methods=methods, seeds=1, stand_ins={"window": "paper"}, baselines=["window"]
    )
    rows = found.scenes("auto")
    assert rows["dark"]["note"] == "too few candidates" and "aurc_full_ratio_to_window" not in rows["dark"]
    assert rows["hall"]["aurc_full_ratio_to_window"] > 0


def off_by(ratio, step=2):
    """A method that answers every ``step``-th sample ``ratio`` too far with a sigma of 1 %, whatever the view."""

    def triangulate(samples, *_):
        unanswered = Estimate.unanswered(samples, Gate.NO_TRACK, n_views=2)
        answers = torch.arange(samples.uv.shape[1]).expand_as(samples.depth) % step == 0
        depth = torch.where(answers, (1 + ratio) * stepping.FAR, torch.nan)
        gate = torch.where(answers, Gate.ANSWER, unanswered.gate)
        return unanswered.replace(depth=depth, sigma=depth / 100, sigma_shared=0 * depth, gate=gate)

    return stepping.choosing(1).replace(triangulate=triangulate)


def stated(ratio=0.0, step=2, **options):
    """Interval numbers of such a method on two scenes with a truth of their own and one whose truth is exact."""
    options = {"exact": ["exact"], "floors": {"h": 1.0, "hall": 0.02}, "disjoint": ["auto"]} | options
    methods = {"paper": stepping.MAP, "auto": off_by(ratio, step)}
    scenes = [stepping.scene(name) for name in ("hall", "attic", "exact")]
    return method_comparison.run(scenes, {}, by_gap, Settings(), methods=methods, seeds=1, **options)


def test_intervals_biases_causes_and_halves_of_the_views():
    outcome = stated()
    rows = outcome.scenes("auto")
    assert {row["method"] for row in outcome.rows} == {"paper", "auto"} and list(rows) == ["hall", "attic", "exact"]
    for row in rows.values():
        numbers = row["against_paper"]
        assert numbers["interval_1"] == numbers["interval_2"] == 1 and numbers["worst_bias"] < 1e-6
        assert row["chi2"] == pytest.approx(0, abs=1e-6) and row["n_chi2"] > 20
        assert sum(row[f"{cause}_share"] for cause in ("track", "pose", "reference", "lens", "model")) == (
            pytest.approx(1)
        )
        assert [b["n"] for b in numbers["bias_bins"]] == [row["n_kept"]]
    floors = [row["against_paper"]["floor"] for row in rows.values()]
    assert floors == [0.02, None, 0.01], "the longest start that fits; exact truth"
    assert outcome.summary["auto.chi2"]["value"] == pytest.approx(0, abs=1e-6)
    assert not any("half" in name for name in outcome.summary)
    within = outcome.summary["auto.scenes_within"]
    assert (within["value"], within["n"]) == (0, 3), "all of the answers are more than 98 %"
    calibrated = load_calibration("auto").apply(outcome.points["hall", "auto", "full"])
    assert rows["hall"]["against_paper"]["calibrated_2"] == uncertainty.interval_coverage(calibrated, 2)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"ratio": 0.015}, {"room_bias": 0.015, "bias_over_floor": 0.75, "interval_1": 0, "interval_2": 1}),
        ({"ratio": -0.015}, {"room_bias": 0.015, "bias_over_floor": 0.75}),
        ({"ratio": 0.015, "floors": None}, {"room_bias": 0.015, "bias_over_floor": None}),
        ({"ratio": 0.015, "exact": ()}, {"room_bias": None, "bias_over_floor": 0.75}),
        ({"step": 100}, {"scenes_within": None, "room_bias": None, "interval_2": 1}),
    ],
)
def test_the_largest_bias_counts_and_scenes_of_few_answers_do_not(options, expected):
    summary = stated(disjoint=(), **options).summary
    for name, value in expected.items():
        assert summary[f"auto.{name}"]["value"] == pytest.approx(value, abs=1e-4), name


def test_halves_of_the_candidates_are_disjoint_and_together_all():
    recording = stepping.scene("long", n=40).recording
    halves = [method_comparison.half_of_candidates(recording, 20, half=k) for k in (0, 1)]
    assert sorted([*halves[0], *halves[1]]) == candidate_frames(recording, 20)


def test_fixed_gaps_chains_and_further_ratios():
    methods = {"paper": stepping.MAP, "map": stepping.MAP, "twin": stepping.MAP}
    options = {"once": ["twin"], "twins": ["twin"], "gaps": (2, 5, 12), "chained": ["map"]}
    ratios = {"map_chain": "map", "none": "map"}
    found = method_comparison.run(
        [stepping.scene()], {}, by_gap, Settings(), methods=methods, seeds=1, ratios=ratios, **options
    )
    rows = {r["method"]: r for r in found.rows if r["pair"] is None}
    views = {r["pair"][0]: r["views"] for r in found.rows if r["method"] == "map, gap 5" and r["pair"] is not None}
    assert views[2] == [7] and views[6] == [1], "behind where nothing is ahead"
    assert rows["map, gap 12"]["n_kept"] == 0 and rows["map, gap 12"]["n_candidates"] == rows["map"]["n_candidates"]
    assert rows["map, gap 2"]["coverage"] == pytest.approx(0.5, abs=0.01)
    values = {name: entry["value"] for name, entry in found.summary.items() if "_ratio_to_" in name}
    assert values == {
        f"{pair}": 1
        for k in ("coverage", "error", "equal_error")
        for pair in (f"twin.{k}_ratio_to_paper", f"map_chain.{k}_ratio_to_map")
    }


@pytest.mark.slow
def test_several_seeds_on_rooms_one_of_which_only_turns(outcome):
    """Rows are those of the first seed, numbers of all; the rotation enters no mean, but what is answered there."""
    assert {r["method"] for r in outcome.rows} == {"paper", "strict", "opencv", "kornia"}
    assert not any("seed" in k for k in outcome.summary)
    scenes = outcome.scenes("strict")
    assert list(scenes) == ["synthetic_walk", "synthetic_lateral"]
    assert "against_paper" not in outcome.scenes("paper")["synthetic_walk"]
    assert {f"strict.{number}" for number in method_comparison.METHOD_BARS} <= set(outcome.summary)
    ratios = [row["against_paper"]["median_rel_ratio"] for row in scenes.values()]
    assert outcome.summary["strict.median_rel_ratio"]["value"] == pytest.approx((ratios[0] * ratios[1]) ** 0.5)
    for number in ("strict.median_rel_ratio", "kornia.coverage_ratio_to_paper", "kornia.error_ratio_to_paper"):
        assert outcome.summary[number]["n"] == 2 and "strict.error_ratio_to_paper" not in outcome.summary
    assert outcome.verdict == "refuted" and "bars met" in outcome.why and "strict states no sigma" in outcome.why
    assert outcome.summary["strict.within_sigma"]["value"] is None and "strict.within" not in outcome.why
    for name in ("paper", "strict"):
        shares = []
        for scene in ("synthetic_lateral", "synthetic_rotation"):
            pools = [outcome.points[scene, variant, "full"] for variant in (name, f"{name}, seed 1")]
            wrong = sum(int((p.keep & (p.error > 0.2)).sum()) for p in pools)
            shares.append(wrong / sum(p.keep.numel() for p in pools))
        assert outcome.summary[f"{name}.convoy_wrong"]["value"] == pytest.approx(max(shares))
    rows = [r for r in outcome.rows if r["scene"] == "synthetic_rotation" and r["pair"] and r["method"] == "paper"]
    first = sum(r["n_recovered"] for r in rows) / sum(r["n_holes"] for r in rows)
    found = outcome.summary["paper.rotation_answered"]
    assert found["n"] == 1 and found["value"] == pytest.approx(first, abs=0.05)
    assert not {"opencv.rotation_answered", "opencv.convoy_wrong"} & outcome.summary.keys()


def twin(coverage):
    return {"kornia.coverage_ratio_to_paper": {"value": coverage}, "kornia.error_ratio_to_paper": {"value": 1.15}}


SILENT = {"left_out": {"map": ["terrace"]}, "unanswered": {"map.5": ["desk"]}}


@pytest.mark.parametrize(
    ("comparison", "arguments", "expected", "text"),
    [
        (judged(), (["map"], set()), True, "9 of 9 bars met"),
        (judged(within_sigma=0.76), (["map"], set()), False, "map.within_sigma 0.760 (bar 0.68)"),
        (judged(coverage_at_5=0.25), (["map"], set()), False, "map.coverage_at_5"),
        (judged(aurc_ratio=None), (["map"], set()), None, "map.aurc_ratio is not defined"),
        (judged(within_sigma=0.76), (["map"], set(), None, {"map"}), True, "map states no sigma"),
        (judged(median_rel_ratio=0.65), (["map"], set()), True, "9 of 9"),
        (judged(median_rel_ratio=0.65), (["map"], {"map"}), False, "map.median_rel_ratio 0.650 (bar 0.6)"),
        *((judged(), (names, set(), twin(1.1)), True, "bars met") for names in (["map"], [])),
        *((judged(), (names, set(), twin(x)), False, "kornia.cov") for names in (["map"], []) for x in (0.89, 1.11)),
        (judged(), (["map"], set(), twin(None)), None, "kornia.coverage_ratio_to_paper is not defined"),
        *(
            (judged(room_bias=x), (["map"], set()), y, "bars met")
            for x, y in ((0.005, True), (0.02, False), (None, True))
        ),
        (
            replace(judged(), **SILENT),
            (["map"], set()),
            True,
            "map without ratio: terrace; map.5 % risk: no answer on desk",
        ),
    ],
)
def test_every_bar_counts_where_it_is_defined(comparison, arguments, expected, text):
    holds, why = method_comparison.verdict(comparison, *arguments)
    assert holds is expected and text in why


def test_the_settings_name_the_rooms_in_which_a_body_moves_and_those_of_streams():
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        settings = compose_settings("run", ["experiment=method_comparison"]).experiment
        streams, shared = (compose_settings("run", [f"data={name}"]).data for name in ("streams", "shared_scenes"))
    assert [*settings.moving] == [f"stress_{name}" for name, of in STRESSES.items() if of.moving]
    rooms, known = ({scene.get("room", scene.path) for scene in data.scenes} for data in (streams, shared))
    assert rooms == set(settings.indoor) and rooms < known
