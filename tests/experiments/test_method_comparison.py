"""Methods against the paper's, several seeds: what is compared, what is named, and a verdict that goes either way."""

from dataclasses import replace

import pytest
import torch
from hydra import compose as compose_settings
from hydra import initialize_config_dir
from hydra.utils import instantiate
from support import numbered_frames as stepping

from dhtorch.cli.run import config_dir
from dhtorch.data.pairs import candidate_frames
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments.compare import method_comparison
from dhtorch.metrics import errors
from dhtorch.synthetic.stress import STRESSES


def method(name="paper"):
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        return instantiate(compose_settings("run", [f"method={name}", "method.n=768"]).method, _convert_="all")


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


def test_halves_of_the_candidates_are_disjoint_and_together_all():
    recording = stepping.scene("long", n=40).recording
    halves = [method_comparison.half_of_candidates(recording, 20, half=k) for k in (0, 1)]
    assert sorted([*halves[0], *halves[1]]) == candidate_frames(recording, 20)


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
