"""Stage 7 with weights learns which answers err, and is judged on rooms it has not seen; the stage alone: test_score.py."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from support.rooms import room_scene

from dhtorch.cli.run import config_dir
from dhtorch.data.pairs import by_gap
from dhtorch.experiments.probes import learned_score
from dhtorch.experiments.probes.learned_score import LabelledAnswers, train_score
from dhtorch.experiments.protocol import Settings
from dhtorch.metrics import holdout, risk
from dhtorch.metrics.errors import points_from_estimate
from dhtorch.stages.score import SCORE_FEATURES, LearnedScore
from dhtorch.synthetic.recording import SyntheticRoom

pytestmark = pytest.mark.slow  # long; shorter experiments of the same protocols run by default

with initialize_config_dir(str(config_dir()), version_base="1.3"):
    MAP = instantiate(compose("run", ["method=map", "method.n=512"]).method, _convert_="all")


class Room(SyntheticRoom):
    """One pair of views of the room that other tests draw, too, drawn once."""

    def __init__(self, **options):
        super().__init__(hw=(120, 160), supersample=1, path="orbit", n_frames=17, **options)
        self.drawn = {}

    def __getitem__(self, i):
        if i not in self.drawn:
            self.drawn[i] = super().__getitem__(i)
        return self.drawn[i]


@pytest.fixture(scope="module")
def rooms():
    """Two, which differ in how far their views lie apart."""
    return [room_scene(room, gap=16) for room in (Room(name="room0"), Room(name="room1", step_m=0.025))]


def made_up(n=4000, seed=0):
    """Answers whose mean error is what a score by hand expects, times what the photometric evidence says."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, len(SCORE_FEATURES), generator=g) * 0.5 - 3.5
    mean = (x[:, 0] + 1.5 * (x[:, 5] + 3.5)).exp()
    return LabelledAnswers(x, -mean * (1 - torch.rand(n, generator=g)).log())


def aurc(error, expected):
    return float(risk.risk_curve(error.clamp(max=1).double(), -expected.double()).mean())


def test_it_learns_what_makes_answers_err_and_foresees_the_mean_error():
    scorer, unseen = train_score([made_up(seed=0), made_up(seed=1)]), made_up(seed=2)
    expected = scorer.log_error(unseen.x).exp()
    assert aurc(unseen.error, expected) < 0.9 * aurc(unseen.error, unseen.x[:, 0])
    for some in (unseen.x[:, 5] > -3.2, (unseen.x[:, 5] + 3.5).abs() < 0.3, unseen.x[:, 5] < -3.8):
        assert float(expected[some].mean() / unseen.error[some].clamp(max=1).mean()) == pytest.approx(1, abs=0.15)
    once, again = (train_score([made_up(200), made_up(200, seed=1)], steps=3).state_dict() for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(once.values(), again.values(), strict=True))
    with pytest.raises(ValueError, match="no answer with ground truth"):
        train_score([LabelledAnswers(torch.zeros(0, 8), torch.zeros(0))])


def test_scenes_weigh_the_same_however_many_answers_they_have():
    """A large scene whose photometric evidence is right and a small one where it is the wrong way round."""
    right, wrong = made_up(4000, seed=0), made_up(4000, seed=1)
    turned = wrong.replace(x=torch.cat((wrong.x[:, :5], -7 - wrong.x[:, 5:6], wrong.x[:, 6:]), 1))
    probe = torch.full((2, len(SCORE_FEATURES)), -3.5)
    probe[0, 5], probe[1, 5] = -2.5, -4.5
    even = train_score([right, turned[:400]], most=4000, steps=100).log_error(probe)
    alone = train_score([right], most=4000, steps=100).log_error(probe)
    assert float(alone[0] - alone[1]) == pytest.approx(3.0, abs=0.8)
    assert abs(float(even[0] - even[1])) < 0.5 * float(alone[0] - alone[1])


def held_out(scene, method):
    """(trace, points) of the pair."""
    recording = scene.recording
    frame = recording[0]
    trace = {}
    near, other = (holdout.range_split(recording[k], scene.near) for k in (0, 16))
    estimate = method(near, other, trace=trace)
    known = frame.replace(depth=recording.truth(0)["depth"], depth_camera=None)
    truth = holdout.select_candidates(trace["samples"], holdout.sample_truth(known, trace["samples"].uv), scene.near)
    return trace, points_from_estimate(estimate, truth)


def test_the_experiment_scores_the_same_answers_three_ways(tmp_path, monkeypatch, rooms):
    taught = []

    def remembered(lessons, **options):
        taught.append(lessons)
        return train_score(lessons, **options)

    monkeypatch.setattr(learned_score, "train_score", remembered)
    target = tmp_path / "score.json"
    outcome = learned_score.run(rooms, {"map": MAP}, by_gap, Settings(), steps=20, save=str(target))
    rows = {v: outcome.scenes(v) for v in ("paper", "by_error", "learned")}
    for scene in ("room0", "room1"):
        for same in ("n_kept", "median_rel", "coverage"):
            assert len({r[scene][same] for r in rows.values()}) == 1, "only the order differs"
        assert rows["paper"][scene]["n_kept"] > 20
        assert len({r[scene]["aurc"] for r in rows.values()}) == 3
    for_first, for_second, for_all = taught
    assert len(for_first) == len(for_second) == 1 and len(for_all) == 2
    assert torch.equal(for_all[0].x, for_second[0].x) and torch.equal(for_all[1].x, for_first[0].x)
    trace, _ = held_out(rooms[0], MAP.replace(score=train_score(for_first, steps=20)))
    scores = outcome.points["room0", "learned", "full"].answered().score
    assert torch.isin(scores, trace["estimate"].score.double()).all(), "the other room's scorer sat in the seat"
    saved = LearnedScore.read(target)
    assert saved.provenance["scenes"] == ["room0", "room1"] and saved.provenance["steps"] == 20
    assert {"learned.aurc_ratio", "learned.aurc_ratio_by_error", "by_error.aurc_ratio"} <= outcome.summary.keys()
