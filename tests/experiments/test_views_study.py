"""Chosen views beside fixed gaps: who is asked about which frames, what is divided by what, and both verdicts."""

from functools import partial

import pytest
import torch
from support.numbered_frames import MAP, choosing, frame, scene, track

from dhtorch.data.pairs import by_gap
from dhtorch.experiments import protocol
from dhtorch.experiments.compare import views_study
from dhtorch.experiments.protocol import Outcome, Protocol, Settings, Variant

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default


def study(scenes, *, step=1, **options):
    methods = {"map": MAP, "auto": choosing(step)}
    given = {"gaps": (1, 2, 5, 12), "reference_views": 2, "rotation_gaps": (1, 2)} | options
    return views_study.run(scenes, methods, by_gap, Settings(), **given)


@pytest.fixture(scope="module")
def outcome():
    scenes = [scene(), scene("pair", n=2), scene("roundabout", role="rotation")]
    return study(scenes, rotations=[scene("carousel", role="rotation"), scene("hall", role="rotation")])


def views(outcome, name, place="hall"):
    rows = (r for r in outcome.rows if r["method"] == name and r["scene"] == place and r["pair"] is not None)
    return {r["pair"][0]: r["views"] for r in rows}


def test_a_gap_looks_ahead_and_behind_where_nothing_is_ahead(outcome):
    assert views(outcome, "map, gap 1") == {2: [3], 6: [7]}, "two of eight reference views, evenly spread"
    assert views(outcome, "map, gap 2") == {2: [4], 6: [8]}
    assert views(outcome, "map, gap 5") == {2: [7], 6: [1]}
    assert views(outcome, "map, gap 12") == {2: [], 6: []}
    assert views(outcome, "auto") == {2: [3], 6: [7]}, "the one of those around that it took"


def test_an_anchor_without_a_partner_is_silent_and_counted(outcome):
    rows = {r["method"]: r for r in outcome.rows if r["scene"] == "hall" and r["pair"] is None}
    assert len({r["n_candidates"] for r in rows.values()}) == 1 and rows["auto"]["n_candidates"] > 500
    assert rows["map, gap 12"]["n_kept"] == 0 and rows["map, gap 12"]["gate_share"]["no_track"] == 1
    coverage = {name: r["coverage"] for name, r in rows.items()}
    assert coverage["map, gap 5"] == pytest.approx(0.35, abs=0.01), "3 of 10 ahead, 4 of 10 behind"


def test_the_ratio_is_that_to_the_gap_which_is_best_in_hindsight(outcome):
    row = outcome.scenes("auto")["hall"]
    best, own = (outcome.scenes(name)["hall"]["coverage_at_5"] for name in ("map, gap 2", "auto"))
    assert best == pytest.approx(0.5, abs=0.01) and own == pytest.approx(0.2, abs=0.01)
    assert row["best_gap"] == 2 and row["fixed_gap_ratio"] == pytest.approx((own + 0.01) / (best + 0.01))
    for key in ("auto.fixed_gap_ratio", "auto.fixed_gap_ratio_worst"):
        assert outcome.summary[key]["value"] == pytest.approx(row["fixed_gap_ratio"])
        assert outcome.summary[key]["n"] == 1, "neither the scene of two frames nor those that turn"
    assert outcome.summary["map, gap 2.coverage_at_5"]["value"] == best
    assert outcome.summary["map, gap 12.coverage_at_5"]["value"] == 0


def test_the_worst_scene_is_the_one_that_reaches_least():
    dark = scene("attic", load=lambda i: frame(10 * i))  # steps of ten are not answered, by nobody
    found = study([dark, scene()])
    worst, mean = (found.summary[f"auto.fixed_gap_ratio{end}"]["value"] for end in ("_worst", ""))
    assert worst == found.scenes("auto")["hall"]["fixed_gap_ratio"] < 0.5
    assert found.scenes("auto")["attic"]["fixed_gap_ratio"] == 1 and mean == pytest.approx(worst**0.5)


def test_scenes_with_one_partner_stand_apart(outcome):
    row = outcome.scenes("auto")["pair"]
    assert row["one_partner"] is True and row["best_gap"] == 1 and row["fixed_gap_ratio"] == pytest.approx(1)
    assert outcome.scenes("auto")["hall"]["one_partner"] is False
    assert outcome.why.endswith("one source view only: pair")


def test_what_is_answered_in_a_turn_is_pooled_over_scenes_and_gaps(outcome):
    turning = {r["scene"] for r in outcome.rows if r.get("role") == "rotation"}
    assert turning == {"roundabout", "carousel"}, "a scene that the data hold is not asked twice"
    assert {r["method"] for r in outcome.rows if r["scene"] == "carousel"} == {"auto", "map, gap 1", "map, gap 2"}
    assert outcome.summary["auto.rotation_answered"]["value"] == pytest.approx(0.2, abs=0.01)
    assert outcome.summary["map.rotation_answered"]["value"] == pytest.approx(0.35, abs=0.01)
    assert outcome.summary["auto.rotation_answered"]["n"] == 2
    row = next(r for r in outcome.rows if (r["scene"], r["method"], r["pair"]) == ("carousel", "map, gap 2", None))
    assert row["recovered_share"] == pytest.approx(0.5, abs=0.01)


def test_an_anchor_that_no_frame_was_offered_for_says_nothing_about_silence():
    found = study([scene("carousel", role="rotation")], rotation_gaps=(2, 12))
    assert found.summary["map.rotation_answered"]["value"] == pytest.approx(0.5, abs=0.01)
    assert found.verdict == "undecided" and "several source views" in found.why
    nothing = study([scene(), scene("carousel", role="rotation")], rotation_gaps=(12,))
    assert nothing.summary["map.rotation_answered"]["value"] is None and "map at fixed gaps –" in nothing.why


def test_few_candidates_do_not_keep_a_turn_from_being_judged():
    blind = scene("carousel", load=lambda i: frame(i).replace(depth=torch.zeros(1, 48, 64)), role="rotation")
    found = study([scene(), blind])
    assert found.summary["auto.rotation_answered"]["value"] == pytest.approx(0.2, abs=0.01)


def test_all_anchors_and_several_seeds():
    found = study([scene()], reference_views=None, seeds=2, gaps=(2,))
    assert set(views(found, "auto")) == set(range(8)) and {r["method"] for r in found.rows} == {"auto", "map, gap 2"}
    assert not [name for name in found.summary if "seed" in name]
    assert found.verdict == "undecided" and "no scene in which the camera only turns" in found.why


@pytest.mark.parametrize(("step", "turn", "expected"), [(2, 10, "supported"), (1, 10, "refuted"), (2, 1, "refuted")])
def test_either_half_can_refute(step, turn, expected):
    carousel = scene("carousel", load=lambda i: frame(turn * i), role="rotation")  # steps of ten are not answered
    assert study([scene(), carousel], step=step).verdict == expected


def judged(worst, answered):
    rows = [
        {"scene": s, "method": "auto", "truth": "full", "pair": None, "role": None, "one_partner": False} for s in "ab"
    ]
    for row, value in zip(rows, (1.2, worst), strict=True):
        row["fixed_gap_ratio"] = value
    numbers = {"auto.fixed_gap_ratio_worst": worst, "auto.rotation_answered": answered, "map.rotation_answered": 0.1}
    return Outcome(rows=rows, summary={k: {"value": v} for k, v in numbers.items()})


@pytest.mark.parametrize(
    ("worst", "answered", "expected"),
    [(0.96, 0.004, True), (0.94, 0.004, False), (0.96, 0.006, False), (1.3, None, None), (None, 0.0, None)],
)
def test_verdict_goes_either_way(worst, answered, expected):
    if worst is None:
        found = views_study.verdict(Outcome(summary={}), {"pair"})
    else:
        found = views_study.verdict(judged(worst, answered))
    assert found[0] is expected
    assert ("b 0.94" in found[1]) == (worst == 0.94) and "a 1.2" not in found[1]


def test_what_cannot_be_asked_is_an_error():
    with pytest.raises(ValueError, match=r"experiment\.methods: found map, expected auto too"):
        views_study.run([], {"map": MAP}, by_gap, Settings())
    for options in ({"gaps": ()}, {"rotation_gaps": (0, 1)}, {"reference_views": 0}):
        with pytest.raises(ValueError, match=rf"experiment\.{next(iter(options))}: found"):
            study([scene()], **options)


def test_every_variant_sees_what_it_is_offered_and_a_frame_is_read_once():
    read = []

    def load(i):
        read.append(i)
        return frame(i)

    seen = {"own": [], "ahead": [], "behind": [], "nothing": []}

    def told(name, track, image_0, image_1, uv_0, *, hint):
        seen[name].append(int(image_1[0, 0, 0, 0]))
        return track(image_0, image_1, uv_0, hint=hint)

    offers = {
        "own": None,
        "ahead": lambda _r, i: [i + 1, i + 2],
        "behind": lambda _r, i: [i - 1],
        "nothing": lambda _r, _i: [],
    }
    methods = {name: MAP.replace(track=partial(told, name, track), views=2) for name in offers}
    variants = {name: Variant(methods[name], offers=offer) for name, offer in offers.items()}
    found = protocol.run([scene(load=load)], Protocol(variants), lambda _scene: [(3, 5)], Settings(batch=4))
    assert read == [2, 3, 4, 5], "the pair's own views are among those that are offered"
    assert seen == {"own": [4, 5], "ahead": [4, 5], "behind": [2], "nothing": []}
    rows = {r["method"]: r for r in found.rows if r["pair"] is not None}
    assert "views" not in rows["own"] and [rows[k]["views"] for k in ("ahead", "behind", "nothing")] == [
        [4, 5],
        [2],
        [],
    ]
    assert rows["nothing"]["n_kept"] == 0 and rows["nothing"]["n_candidates"] == rows["own"]["n_candidates"]
