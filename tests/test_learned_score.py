"""Seat 7 with weights: starts as the score made by hand, learns which answers err, travels as text, and is judged on
rooms it has not seen."""

import json
from functools import partial

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from dhtorch.codes import Gate
from dhtorch.data.pairs import by_gap
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.evaluate import bootstrap, holdout, risk
from dhtorch.evaluate.errors import select
from dhtorch.experiments import learned_score
from dhtorch.experiments.learned_score import Lesson, train
from dhtorch.experiments.protocol import Settings
from dhtorch.run import config_dir
from dhtorch.seats import refill
from dhtorch.stages.score import EVIDENCE, MOST, LearnedScore, evidence, expected_error_loss, rank_by_error
from dhtorch.tree import collate

with initialize_config_dir(str(config_dir()), version_base="1.3"):
    MAP = instantiate(compose("run", ["method=map", "method.n=512"]).method, _convert_="all")


def room(seed=2, **options):
    return SyntheticRoom(**{"seed": seed, "hw": (120, 160), "path": "orbit", "n_frames": 17, "gap": 16, **options})


def held_out(recording, method=MAP, **options):
    """(trace, truth, points) of one pair of a room."""
    frame = recording[0]
    trace = {}
    near, other = (holdout.range_split(recording[k], recording.near) for k in (0, 16))
    estimate = method(near, other, trace=trace, **options)
    known = frame.replace(depth=recording.truth(0)["depth"], depth_camera=None)
    truth = holdout.candidates(trace["samples"], holdout.truth_at(known, trace["samples"].uv), recording.near)
    return trace, truth, select(estimate, truth)


@pytest.fixture(scope="module")
def answers():
    return held_out(room())


def parts(trace):
    return trace["estimate"], trace["samples"], trace["tracks_ideal"], trace["fit"]


def made_up(n=4000, seed=0):
    """Answers whose mean error is what a score by hand expects, times what the photometric evidence says."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, len(EVIDENCE), generator=g) * 0.5 - 3.5
    mean = (x[:, 0] + 1.5 * (x[:, 5] + 3.5)).exp()
    return Lesson(x, -mean * (1 - torch.rand(n, generator=g)).log())


def aurc(error, expected):
    return float(risk.curve(error.clamp(max=1).double(), -expected.double()).mean())


def test_untrained_it_is_the_score_made_by_hand(answers):
    scored, by_hand = LearnedScore()(*parts(answers[0])), rank_by_error(*parts(answers[0]))
    assert int(scored.keep.sum()) > 100
    torch.testing.assert_close(scored.score, by_hand.score, atol=1e-6, rtol=1e-5)
    assert torch.equal(scored.gate, by_hand.gate) and torch.equal(scored.depth.isnan(), by_hand.depth.isnan())


def test_evidence_says_what_it_is_called(answers):
    x, stated = evidence(*parts(answers[0]))
    estimate, samples, tracks, fit = parts(answers[0])
    column = dict(zip(EVIDENCE, x.unbind(-1), strict=True))
    assert torch.equal(stated, estimate.keep) and bool((x[~stated] == 0).all())
    near = samples.depth[fit.inlier].mean()
    for name, expected in {
        "parallax_deg": estimate.parallax_deg,
        "residual_px": estimate.residual_px,
        "round_trip_px": tracks.error,
        "trackability": samples.trackability,
        "shared_error": estimate.sigma_shared / estimate.depth,
        "reach": estimate.depth / near,
    }.items():
        limited = expected.clamp(*EVIDENCE[name])[stated]
        torch.testing.assert_close(column[name][stated].exp(), limited, rtol=1e-4, atol=1e-6, msg=name)


def test_it_learns_what_makes_answers_err_and_foresees_the_mean_error():
    scorer, unseen = train([made_up(seed=0), made_up(seed=1)]), made_up(seed=2)
    expected = scorer.log_error(unseen.x).exp()
    assert aurc(unseen.error, expected) < 0.9 * aurc(unseen.error, unseen.x[:, 0])
    for some in (unseen.x[:, 5] > -3.2, (unseen.x[:, 5] + 3.5).abs() < 0.3, unseen.x[:, 5] < -3.8):
        assert float(expected[some].mean() / unseen.error[some].clamp(max=1).mean()) == pytest.approx(1, abs=0.15)
    again = train([made_up(seed=0), made_up(seed=1)])
    assert all(
        torch.equal(a, b) for a, b in zip(scorer.state_dict().values(), again.state_dict().values(), strict=True)
    )
    with pytest.raises(ValueError, match="no answer with truth"):
        train([Lesson(torch.zeros(0, 8), torch.zeros(0))])


def test_the_loss_is_least_at_the_mean_error():
    error = torch.tensor([0.01, 0.02, 0.09])
    weight = torch.full((3,), 1 / 3)
    at = [float(expected_error_loss(torch.full((3,), e).log(), error, weight)) for e in (0.03, 0.04, 0.05)]
    assert at[1] < min(at[0], at[2])
    log_error = torch.full((3,), 0.04, dtype=torch.float64).log().requires_grad_()
    expected_error_loss(log_error, error.double(), weight.double()).backward()
    assert abs(float(log_error.grad.sum())) < 1e-6
    assert float(expected_error_loss(torch.zeros(1), torch.tensor([50.0]), torch.ones(1))) == 1, "errors count as one"


def test_scenes_weigh_the_same_however_many_answers_they_have():
    """A large scene whose photometric evidence is right and a small one where it is the wrong way round."""
    right, wrong = made_up(4000, seed=0), made_up(4000, seed=1)
    turned = wrong.replace(x=torch.cat((wrong.x[:, :5], -7 - wrong.x[:, 5:6], wrong.x[:, 6:]), 1))
    probe = torch.full((2, len(EVIDENCE)), -3.5)
    probe[0, 5], probe[1, 5] = -2.5, -4.5
    even = train([right, turned[:400]], most=4000).log_error(probe)
    alone = train([right], most=4000).log_error(probe)
    assert float(alone[0] - alone[1]) == pytest.approx(3.0, abs=0.8)
    assert abs(float(even[0] - even[1])) < 0.5 * float(alone[0] - alone[1])


def test_the_correction_is_bounded_and_gradients_reach_every_weight(answers):
    scorer = LearnedScore(seed=1)
    torch.nn.init.normal_(scorer.last, std=1e4)
    x, _ = evidence(*parts(answers[0]))
    assert float((scorer.log_error(x) - x[..., 0]).detach().abs().max()) <= MOST
    scorer = LearnedScore(seed=1)
    torch.nn.init.normal_(scorer.last)
    recording = room()
    depth = recording[0].depth.clone().requires_grad_()
    near = holdout.range_split(recording[0].replace(depth=depth), recording.near)
    estimate = refill(MAP, score=scorer)(near, holdout.range_split(recording[16], recording.near))
    estimate.score.sum().backward()
    for name, weight in scorer.named_parameters():
        assert weight.grad.isfinite().all() and weight.grad.abs().max() > 0, name
    assert depth.grad.isfinite().all() and depth.grad.abs().max() > 0


def test_a_row_does_not_depend_on_its_mates(answers):
    torch.set_num_threads(1)
    scorer = LearnedScore(seed=1)
    torch.nn.init.normal_(scorer.last)
    turned = [
        [r.map(lambda x, k=k: x.roll(k, 1) if x.dim() > 1 else x) for r in parts(answers[0])] for k in (0, 7, 133)
    ]
    records = [collate(group) for group in zip(*turned, strict=True)]
    together = scorer(*records)
    for b in range(3):
        alone = scorer(*(r[b : b + 1] for r in records))
        assert torch.equal(together.score[b : b + 1], alone.score)


def test_below_the_threshold_answers_are_silenced(answers):
    scorer = LearnedScore(min_score=0.9)
    scored = scorer(*parts(answers[0]))
    low = answers[0]["estimate"].keep & ~scored.keep
    assert int(low.sum()) > 0 and bool((scored.gate[low] == Gate.LOW_SCORE).all())
    assert bool((scored.score[scored.keep] >= 0.9).all()) and bool(scored.depth[low].isnan().all())


def test_it_travels_as_text_and_as_weights_only(tmp_path, answers):
    scorer = train([made_up()], hidden=5)
    scorer.provenance = {"scenes": ["a"]}
    copy = LearnedScore.read(scorer.save(tmp_path / "deep" / "score.json"))
    assert copy.provenance == {"scenes": ["a"]} and copy.half_error == scorer.half_error
    torch.save(scorer.state_dict(), tmp_path / "score.pt")
    other = LearnedScore(5)
    other.load_state_dict(torch.load(tmp_path / "score.pt", weights_only=True))
    for found in (copy, other):
        assert torch.equal(found(*parts(answers[0])).score, scorer(*parts(answers[0])).score)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("weights"),
        lambda c: c.update(evidence=["parallax_deg"]),
        lambda c: c["weights"].update(last=[0.0] * 3),
        lambda c: c["weights"].update(extra=[0.0]),
        lambda c: c["weights"]["last"].__setitem__(0, "1"),
        lambda c: c["weights"]["last"].__setitem__(0, float("nan")),
        lambda c: c.update(half_error=None),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, change):
    content = json.loads(LearnedScore().to_json())
    change(content)
    path = tmp_path / "score.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"score\.json: found .* expected a learned score"):
        LearnedScore.read(path)


def test_the_experiment_scores_the_same_answers_three_ways(tmp_path, monkeypatch):
    rooms = [room(seed) for seed in (2, 3)]
    for k, recording in enumerate(rooms):
        recording.name = f"room{k}"
    taught = []

    def remembered(lessons, **options):
        taught.append(lessons)
        return train(lessons, **options)

    monkeypatch.setattr(learned_score, "train", remembered)
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
    trace, _, _ = held_out(rooms[0], refill(MAP, score=train(for_first, steps=20)))
    scores = outcome.points["room0", "learned", "full"].answered().score
    assert torch.isin(scores, trace["estimate"].score.double()).all(), "the other room's scorer sat in the seat"
    saved = LearnedScore.read(target)
    assert saved.provenance["scenes"] == ["room0", "room1"] and saved.provenance["steps"] == 20
    assert {"learned.aurc_ratio", "learned.aurc_ratio_by_error", "by_error.aurc_ratio"} <= outcome.summary.keys()


def test_one_room_is_not_enough_and_several_views_are_refused():
    outcome = learned_score.run([room()], {"map": MAP}, by_gap, Settings(), steps=2)
    assert outcome.verdict == "undecided" and "two rooms" in outcome.why
    (row,) = outcome.scenes("learned").values()
    assert row["note"] == "no other room to learn from"
    with pytest.raises(ValueError, match="two views"):
        learned_score.run([room()], {"window": partial(MAP, views=3)}, by_gap, Settings())


def test_the_verdict_goes_either_way():
    def decide(paper, by_hand):
        found = {
            k: bootstrap.Interval(*v, 9)
            for k, v in (("learned.aurc_ratio", paper), ("learned.aurc_ratio_by_error", by_hand))
        }
        return learned_score.verdict(found)[0]

    assert decide((0.6, 0.5, 0.7), (0.9, 0.85, 0.95)) is True
    assert decide((0.6, 0.5, 0.7), (0.95, 0.85, 1.02)) is None
    assert decide((0.6, 0.5, 0.7), (1.01, 0.85, 1.2)) is False
    assert decide((0.6, None, None), (0.9, None, None)) is None
