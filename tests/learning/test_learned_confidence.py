"""A confidence trained on its risk, with short settings: it learns what orders errors, and never from the room it scores."""

import json
import math
import sys
from pathlib import Path

import pytest
import torch

from dhtorch import MAP
from dhtorch.experiments.probes.learned_score import LabelledAnswers
from dhtorch.stages.score import SCORE_FEATURES, LearnedScore
from dhtorch.synthetic import open_room

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks" / "learning"))

import learned_confidence


def made_up_answers(n, seed):
    """Answers whose error is what the analytic score expects, times what the photometric evidence says."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, len(SCORE_FEATURES), generator=g) * 0.5 - 3.5
    mean = (x[:, 0] + 1.5 * (x[:, 5] + 3.5)).exp()
    return LabelledAnswers(x, -mean * (1 - torch.rand(n, generator=g)).log())


def test_a_confidence_trained_on_the_risk_orders_unseen_answers_better():
    labelled = {name: made_up_answers(600, seed) for seed, name in enumerate(("a", "b", "c"))}
    areas = learned_confidence.measure(labelled, {name: name for name in labelled}, seed=0, steps=60)
    assert [*areas] == ["a", "b", "c"]
    for of_scene in areas.values():
        assert of_scene["by_risk"] < 0.9 * of_scene["by_error"]
    summary = learned_confidence.compare([areas, areas])
    assert summary["by_risk.aurc_ratio"]["high"] < 0.9
    mean = sum(math.log(a["by_risk"] / a["by_error"]) for a in areas.values()) / 3
    assert summary["by_risk.aurc_ratio"]["of_seeds"] == pytest.approx([math.exp(mean)] * 2)


def test_no_score_is_trained_on_the_room_that_it_scores(monkeypatch):
    labelled = {name: made_up_answers(60, seed) for seed, name in enumerate(("a1", "a2", "b", "c"))}
    seen = []

    def note(lessons, *_args, **_kwargs):
        seen.append({name for name, answers in labelled.items() if any(answers is lesson for lesson in lessons)})
        return LearnedScore()

    monkeypatch.setattr(learned_confidence, "train_by_risk", note)
    monkeypatch.setattr(learned_confidence, "train_score", note)
    learned_confidence.measure(labelled, {"a1": "a", "a2": "a", "b": "b", "c": "c"}, seed=0, steps=1)
    assert seen[::2] == seen[1::2] == [{"b", "c"}, {"a1", "a2", "c"}, {"a1", "a2", "b"}]


def test_the_confidence_script(monkeypatch, tmp_path, capsys):
    """Two rooms of one pair each; errors and analytic scores are those of the method's own answers."""
    rooms = [
        open_room(seed=0, path="orbit", n_frames=17, hw=(120, 160), supersample=1, gap=16, step_m=step, name=name)
        for name, step in (("a", 0.02), ("b", 0.025))
    ]
    monkeypatch.setattr(learned_confidence, "open_scenes", lambda _name: rooms)
    monkeypatch.setattr(learned_confidence, "MAP", MAP.replace(n=512))
    monkeypatch.setattr(learned_confidence, "FEWEST", 10)
    monkeypatch.setattr(sys, "argv", ["learned_confidence.py", "--steps", "2", "--json", str(tmp_path / "result.json")])
    learned_confidence.main()
    (row,) = json.loads((tmp_path / "result.json").read_text())
    assert [*row["answers"]] == ["a", "b"] and row["rooms"] == 2
    for of_scene in row["aurc"][0].values():
        assert 0 < of_scene["by_error"] < 0.3
    assert "by_risk.aurc_ratio_regressed" in capsys.readouterr().out
