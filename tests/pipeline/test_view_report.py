"""Frames offered around a reference view: who chooses, what is chosen, why, and what a job, a map and a word make of it."""

import logging
import math
from functools import partial

import pytest
import torch
from support.rooms import room_scene

from dhtorch.cli import run
from dhtorch.data.pairs import by_choice, by_gap
from dhtorch.experiments import pair, protocol
from dhtorch.integrate import recording as maps
from dhtorch.pipeline.presets import AUTO, MAP, PAPER
from dhtorch.pipeline.view_report import ViewReport, report_selection, with_view_selection
from dhtorch.pipeline.view_selection import select_views_by_preview
from dhtorch.pytree import stack
from dhtorch.records import ViewSelection
from dhtorch.synthetic import SyntheticRoom

N = 256
SMALL = {"paper": PAPER, "map": MAP, "window": MAP.replace(views=2), "auto": AUTO.replace(views=2)}
SMALL = {name: method.replace(n=N) for name, method in SMALL.items()}
OFFERED = partial(by_choice, steps=(1, 2, 4), stride=3)  # reference views 0 and 3 of five frames


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(hw=(120, 160), n_frames=5, supersample=1, step_m=0.04, lidar="exact")


@pytest.fixture(scope="module")
def outcome(room):
    return pair.run([room_scene(room)], SMALL, OFFERED, protocol.Settings(cutoff=math.inf))


@pytest.mark.slow
def test_every_method_chooses_among_what_is_offered(outcome):
    offered = {0: {1, 2, 4}, 3: {1, 2, 4}}
    rows = [r for r in outcome.rows if r["pair"] is not None]
    assert {(r["method"], r["pair"][0]) for r in rows} == {(name, i) for name in SMALL for i in offered}
    for row in rows:
        (i, j), views = row["pair"], row["views"]
        assert len(views) == SMALL[row["method"]].views and set(views) <= offered[i] and views == sorted(views)
        assert j == views[-1], "tracks and pose of the row are those of the last"
        assert row["why"]["n_offered"] == 3 and len(row["why"]["gain"]) == len(views)
        assert max(row["why"]["gain"]) > 0 and 0 <= row["why"]["n_no_answer"] < 3
    of = {name: [r["views"] for r in rows if r["method"] == name] for name in SMALL}
    assert of["paper"] == of["map"], "all choose alike"
    for name in ("window", "auto"):
        assert all(one[0] in two for one, two in zip(of["map"], of[name], strict=True)), "the best is chosen first"


def test_what_chooses_for_itself_is_asked_as_it_is():
    assert with_view_selection(AUTO) is AUTO
    for method in (PAPER, MAP, MAP.replace(views=5)):
        assert (
            with_view_selection(method).select_views is select_views_by_preview
            and with_view_selection(method).views == method.views
        )
        assert not with_view_selection(method).chain, "views lie on both sides: none says where the next search begins"


def test_a_stage_may_give_indices_alone(room):
    last = SMALL["map"].replace(
        select_views=lambda _anchor, others, views, *, fit: torch.full((views, 1), len(others.image) - 1)
    )
    trace = {}
    last(room[0], stack([room[k] for k in (1, 2, 4)]), trace=trace)
    assert trace["choice"].index.tolist() == [[2]] and trace["choice"].gain is None
    assert str(report_selection(0, (1, 2, 4), trace)) == "frame 0: view 4, chosen of 3"


def test_why_is_said_in_one_line(caplog):
    choice = ViewSelection(
        torch.tensor([[0], [3]]), torch.tensor([[12.345], [310.4]]), torch.tensor([[False]] * 3 + [[True]])
    )
    with caplog.at_level(logging.DEBUG, "dhtorch"):
        found = report_selection(12, (4, 9, 20, 31), {"choice": choice})
    line = "frame 12: views 4, 31, chosen of 4 (gain 12.3, 310; 1 had no baseline or no pose)"
    assert [r.getMessage() for r in caplog.records] == [line] == [str(found)]
    assert found.row() == {"views": [4, 31], "why": {"n_offered": 4, "gain": [12.35, 310.4], "n_no_answer": 1}}
    assert report_selection(0, (1,), {}) == ViewReport(0, (1,), 1) and str(report_selection(0, (1,), {})).endswith(
        "1, all that were offered"
    )


def test_what_a_view_adds_and_which_say_nothing(room):
    choice = select_views_by_preview(
        room[0], stack([room[k] for k in (0, 1, 2, 4)]), 3
    )  # the reference view itself has no baseline
    assert choice.no_answer[0, 0] and not choice.no_answer[3, 0] and choice.index[:, 0].tolist() == [1, 2, 3]
    one = select_views_by_preview(room[0], stack([room[k] for k in (0, 1, 2, 4)]), 1)
    best = int(one.index[0, 0])
    assert float(choice.gain[best - 1, 0]) == float(one.gain[0, 0]) == float(choice.gain.max())


def test_two_frames_are_each_others_view():
    two = SyntheticRoom(hw=(120, 160), n_frames=2, supersample=1, step_m=0.08, lidar="exact")
    found = pair.run([room_scene(two)], {"auto": SMALL["auto"]}, by_choice, protocol.Settings(cutoff=math.inf))
    rows = [r for r in found.rows if r["pair"] is not None]
    assert [(r["pair"], r["views"], r["why"]["gain"]) for r in rows] == [([0, 1], [1], None), ([1, 0], [0], None)]


def test_a_map_knows_all_views_and_links_them(room):
    found = list(maps.estimate_pairs(room, SMALL["window"], OFFERED(room), cutoff=math.inf))
    assert [a.pair[0] for a in found] == [0, 3] and all(a.pair[1] == a.picked.views[-1] for a in found)
    assert all([*a.links] == [a.pair[1], a.picked.views[0]] or set(a.links) == set(a.picked.views) for a in found)
    places = maps.place_frames(room, found, poses="anchored")
    asked = {0, 3}.union(*(a.picked.views for a in found))
    assert set(places.poses) <= asked and len(places.poses) + places.n_unplaced == len(asked)
    (one,) = maps.estimate_pairs(room, SMALL["window"], by_gap(room, 2)[:1])
    assert one.picked is None and [*one.links] == [2] and one.pair == (0, 2)


@pytest.mark.parametrize(
    ("words", "choice"),
    [
        (["pairs.gap=2"], ["pairs=gap"]),
        (["integrate", "pairs.metres=0.1"], ["pairs=baseline"]),
        (["pairs.seconds=1,2", "-m"], ["pairs=time"]),
        (["pairs=gap", "pairs.gap=2"], []),
        (["pairs.stride=2"], []),
        ([], []),
    ],
)
def test_an_option_of_one_choice_alone_chooses_it(words, choice):
    assert run._add_implied_choice(words) == [*words, *choice]
