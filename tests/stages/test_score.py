"""Stage 7 alone: both scores made by hand and the learned one against plain numpy, on made-up answers."""

import json
import math

import numpy as np
import pytest
import torch

from dhtorch.codes import Gate, PoseCode
from dhtorch.records import Estimate, Pose, PoseFit, Samples, Tracks
from dhtorch.stages.score import (
    MAX_LOG_FACTOR,
    SCORE_FEATURES,
    LearnedScore,
    confidence,
    confidence_from_error,
    expected_error_loss,
    score_features,
)

B, N = 2, 12


def rand(*shape, seed, low=0.0, high=1.0):
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def answers():
    """(estimate, samples, tracks, fit): answers that differ in everything; the last two of each pair are silent."""
    depth = rand(B, N, seed=0, low=2, high=6)
    sigma = depth * rand(B, N, seed=1, low=0.01, high=0.2)
    gate = torch.zeros(B, N, dtype=torch.int32)
    gate[:, -2], gate[:, -1] = Gate.PARALLAX, Gate.NO_TRACK
    keep = gate == 0
    zero = torch.zeros(B, N, dtype=torch.float64)
    estimate = Estimate(
        uv=rand(B, N, 2, seed=2, high=50),
        depth=torch.where(keep, depth, torch.nan),
        sigma=torch.where(keep, sigma, torch.nan),
        sigma_shared=torch.where(keep, sigma * rand(B, N, seed=3, low=0.1, high=0.9), torch.nan),
        parallax_deg=rand(B, N, seed=4, low=0.2, high=9),
        residual_px=rand(B, N, seed=5, low=0.02, high=2.5),
        n_views=torch.full((B, N), 2, dtype=torch.int32),
        score=keep.double(),
        gate=gate,
    )
    samples = Samples(
        uv=estimate.uv,
        depth=rand(B, N, seed=6, low=0.5, high=1.5),
        sigma=zero + 0.01,
        xyz=rand(B, N, 3, seed=7),
        confidence=zero + 1,
        flag=0 * gate,
        trackability=rand(B, N, seed=8, low=1e-4, high=1e-2),
        hole=0 * gate,
    )
    tracks = Tracks(
        uv_0=estimate.uv,
        uv_1=estimate.uv + 1,
        error=rand(B, N, seed=9, low=0.01, high=0.9),
        photometric=rand(B, N, seed=10, low=0.002, high=0.1),
        cov=torch.eye(2).double().expand(B, N, 2, 2),
        valid=keep,
    )
    inlier = rand(B, N, seed=11) < 0.5
    nothing = torch.zeros(B, dtype=torch.float64)
    pose = Pose(torch.eye(3).double().expand(B, 3, 3), torch.ones(B, 3).double())
    cov = torch.eye(6).double().expand(B, 6, 6)
    code = torch.full((B,), PoseCode.OK, dtype=torch.int32)
    fit = PoseFit(pose, cov, inlier, inlier.sum(1), nothing, nothing + 1, nothing + 50, code)
    return estimate, samples, tracks, fit


def arrays(record):
    return {k: v.numpy() for k, v in vars(record).items() if isinstance(v, torch.Tensor)}


def same(score, expected, keep):
    np.testing.assert_allclose(score.numpy(), np.where(keep, expected, 0.0), rtol=1e-9)


# ---------------------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize("options", [{}, {"half_parallax_deg": 5.0}, {"residual_scale_px": 1.2}])
def test_the_papers_score_rises_with_parallax_and_falls_with_the_residual(options):
    estimate, *rest = answers()
    p, r = estimate.parallax_deg.numpy(), estimate.residual_px.numpy()
    half, scale = options.get("half_parallax_deg", 2.0), options.get("residual_scale_px", 3.0)
    found = confidence(estimate, *rest, **options)
    same(found.score, p / (p + half) * np.maximum(0, 1 - r / scale), estimate.keep.numpy())
    for name in ("uv", "depth", "sigma", "sigma_shared", "parallax_deg", "residual_px", "n_views", "gate"):
        assert torch.equal(getattr(found, name).nan_to_num(), getattr(estimate, name).nan_to_num()), name


def test_the_papers_score_is_zero_where_parallax_or_residual_is_no_number():
    estimate, *rest = answers()
    parallax, residual = estimate.parallax_deg.clone(), estimate.residual_px.clone()
    parallax[0, 0], residual[0, 1], parallax[0, 2] = torch.nan, torch.nan, torch.inf
    found = confidence(estimate.replace(parallax_deg=parallax, residual_px=residual), *rest).score
    assert found[0, :3].tolist() == [0, 0, 0] and (found[0, 3:-2] > 0).all() and found.isfinite().all()


def plain_error(
    estimate, tracks, *, residual_scale_px=0.5, photometric_scale=None, round_trip_scale_px=0.4, share=1e-6
):
    e, t = arrays(estimate), arrays(tracks)
    own = e["sigma"] ** 2 - e["sigma_shared"] ** 2
    own = np.maximum(own, share * e["sigma"] ** 2)
    spread = 1 + (e["residual_px"] / residual_scale_px) ** 2
    if photometric_scale is not None:
        spread = spread + (t["photometric"] / photometric_scale) ** 2
    if round_trip_scale_px is not None:
        spread = spread + (t["error"] / round_trip_scale_px) ** 2
    return np.sqrt(own * spread) / e["depth"]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"residual_scale_px": 1.5},
        {"photometric_scale": 0.03},
        {"round_trip_scale_px": None},
        {"round_trip_scale_px": 0.1},
        {"residual_scale_px": 0.2, "photometric_scale": 0.01, "round_trip_scale_px": 0.8},
    ],
)
def test_the_score_is_half_where_the_expected_error_is_the_half_error(options):
    estimate, samples, tracks, fit = answers()
    expected = plain_error(estimate, tracks, **options)
    keep = estimate.keep.numpy()
    for half in (0.1, 0.03):
        found = confidence_from_error(estimate, samples, tracks, fit, half_error=half, **options)
        same(found.score, half / (half + expected), keep)
    found = confidence_from_error(estimate, samples, tracks, fit, **options)
    same(found.score, 0.1 / (0.1 + expected), keep)
    assert torch.equal(found.gate, estimate.gate)


def test_a_recalibration_changes_scores_of_answers_alone_and_comes_before_the_threshold():
    stage = answers()
    keep = stage[0].keep
    plain = confidence_from_error(*stage)
    found = confidence_from_error(*stage, recalibration=lambda s: 1 - s / 2)
    torch.testing.assert_close(found.score, torch.where(keep, 1 - plain.score / 2, 0.0))
    limit = float((1 - plain.score / 2)[keep].median())
    strict = confidence_from_error(*stage, recalibration=lambda s: 1 - s / 2, min_score=limit)
    assert torch.equal(strict.gate == Gate.LOW_SCORE, keep & (found.score < limit))


@pytest.mark.parametrize("stage", [confidence, confidence_from_error, "learned"])
def test_below_the_threshold_and_not_at_it_an_answer_becomes_silent(stage):
    parts = answers()
    ask = (lambda *p, min_score=0.0: LearnedScore(min_score=min_score)(*p)) if stage == "learned" else stage
    plain = ask(*parts)
    limit = sorted(plain.score[plain.keep].tolist())[7]
    strict = ask(*parts, min_score=limit)
    low = plain.keep & (plain.score < limit)
    assert int(low.sum()) == 7 and torch.equal(strict.gate == Gate.LOW_SCORE, low)
    for name in ("depth", "sigma", "sigma_shared"):
        x, y = getattr(strict, name), getattr(plain, name)
        assert x[low].isnan().all() and torch.equal(x[strict.keep], y[strict.keep]), name
    assert torch.equal(strict.score, torch.where(low, 0, plain.score))
    assert torch.equal(strict.gate[~plain.keep], plain.gate[~plain.keep]), "a reason stays the first one"


def test_where_no_error_can_be_stated_the_score_is_zero():
    estimate, samples, tracks, fit = answers()
    broken = {
        "depth": (-1.0, 0.0),
        "sigma": (torch.nan, torch.inf),
        "sigma_shared": (torch.nan, torch.inf),
        "residual_px": (torch.nan, torch.inf),
    }
    for name, values in broken.items():
        x = getattr(estimate, name).clone()
        x[1, 0], x[1, 1] = values
        found = confidence_from_error(estimate.replace(**{name: x}), samples, tracks, fit)
        assert found.score[1, :2].tolist() == [0, 0] and (found.score[1, 2:-2] > 0).all(), name
        again = confidence_from_error(
            estimate.replace(**{name: x}), samples, tracks, fit, recalibration=lambda s: 1 - s / 2
        )
        assert again.score[1, :2].tolist() == [0, 0] and again.score.isfinite().all(), name
        assert not score_features(estimate.replace(**{name: x}), samples, tracks, fit)[1][1, :2].any(), name
    for name, scale in (("photometric", "photometric_scale"), ("error", "round_trip_scale_px")):
        x = getattr(tracks, name).clone()
        x[1, 0] = torch.nan
        found = [
            confidence_from_error(estimate, samples, tracks.replace(**{name: x}), fit, **{scale: s}).score
            for s in (0.3, None)
        ]
        assert found[0][1, 0] == 0 and found[1][1, 0] > 0, "only where it is asked"


# ---------------------------------------------------------------------------------------------------- evidence


def plain_evidence(estimate, samples, tracks, fit):
    e, s, t, inlier = arrays(estimate), arrays(samples), arrays(tracks), fit.inlier.numpy()
    near = np.array([s["depth"][b][inlier[b] & (s["depth"][b] > 0)].mean() for b in range(B)])
    return {
        "expected_error": plain_error(estimate, tracks),
        "shared_error": e["sigma_shared"] / e["depth"],
        "parallax_deg": e["parallax_deg"],
        "residual_px": e["residual_px"],
        "round_trip_px": t["error"],
        "photometric": t["photometric"],
        "trackability": s["trackability"],
        "reach": e["depth"] / near[:, None],
    }


def test_evidence_is_the_logarithm_of_what_it_is_called():
    estimate, samples, tracks, fit = answers()
    depth = samples.depth.clone()
    depth[:, 0] = 0  # an inlier without a return does not count in the mean
    samples, fit = samples.replace(depth=depth), fit.replace(inlier=fit.inlier | (torch.arange(N) == 0))
    x, stated = score_features(estimate, samples, tracks, fit)
    assert torch.equal(stated, estimate.keep) and (x[~stated] == 0).all() and x.shape == (B, N, 8)
    columns = plain_evidence(estimate, samples, tracks, fit)
    assert [*columns] == [*SCORE_FEATURES]
    for k, (name, expected) in enumerate(columns.items()):
        np.testing.assert_allclose(x[..., k][stated].numpy(), np.log(expected)[stated], rtol=1e-9, err_msg=name)


# ---------------------------------------------------------------------------------------------------- learned


def trained(seed=1, hidden=5, spread=1.0, **options):
    """A scorer whose every weight is drawn."""
    scorer = LearnedScore(hidden, **options).double()
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for x in (*scorer.parameters(), scorer.mean):
            x.copy_(spread * torch.randn(x.shape, generator=g, dtype=torch.float64))
        scorer.spread.copy_(0.5 + torch.rand(8, generator=g, dtype=torch.float64))
    return scorer


def plain_forward(scorer, x):
    w = {k: v.detach().double().numpy() for k, v in scorer.state_dict().items()}
    hidden = (x - w["mean"]) / w["spread"] @ w["first"].T + w["first_bias"]
    hidden = hidden / (1 + np.abs(hidden))
    more = hidden @ w["last"] + w["last_bias"]
    return x[..., 0] + 4.0 * more / (4.0 + np.abs(more))


def test_the_learned_score_is_its_network_written_out():
    stage, scorer = answers(), trained(half_error=0.07)
    x, stated = score_features(*stage)
    expected = plain_forward(scorer, x.numpy())
    np.testing.assert_allclose(scorer.log_error(x).detach().numpy(), expected, rtol=1e-9)
    same(scorer(*stage).score.detach(), 0.07 / (0.07 + np.exp(expected)), stated.numpy())
    single = scorer.log_error(x.float())
    assert single.dtype == torch.float32, "in the numbers of the evidence"
    np.testing.assert_allclose(single.detach().numpy(), expected, rtol=1e-4, atol=1e-4)


def test_untrained_it_is_the_score_made_by_hand():
    stage = answers()
    scored, by_hand = LearnedScore()(*stage), confidence_from_error(*stage)
    torch.testing.assert_close(scored.score.detach(), by_hand.score, rtol=1e-9, atol=0)
    assert torch.equal(scored.gate, by_hand.gate) and torch.equal(scored.depth.isnan(), by_hand.depth.isnan())


def test_the_correction_is_bounded_and_gradients_reach_every_weight():
    x, stated = score_features(*answers())
    wild = trained(spread=1e3)
    more = (wild.log_error(x) - x[..., 0]).detach()[stated].abs()
    assert more.max() <= MAX_LOG_FACTOR == 4 and more.min() > 3.9
    scorer = trained()
    stage = answers()
    depth = stage[0].depth.clone().requires_grad_()
    scorer(stage[0].replace(depth=depth), *stage[1:]).score.sum().backward()
    for name, weight in scorer.named_parameters():
        assert weight.grad.isfinite().all() and weight.grad.abs().max() > 0, name
    assert depth.grad.isfinite().all() and depth.grad[stage[0].keep].abs().min() > 0


def test_the_loss_is_the_likelihood_of_an_exponential_law_whose_errors_count_as_one_at_most():
    log_error, weight = rand(9, seed=0, low=-4, high=0), rand(9, seed=1)
    error = rand(9, seed=2, high=2.0)
    expected = 0.0
    for g, e, w in zip(log_error.tolist(), error.tolist(), weight.tolist(), strict=True):
        expected += w * (g + min(e, 1.0) / math.exp(g))
    assert (error > 1).any() and float(expected_error_loss(log_error, error, weight)) == pytest.approx(expected)


# ---------------------------------------------------------------------------------------------------- as text


def test_it_travels_as_text_and_as_weights_only(tmp_path):
    scorer = trained(half_error=0.2, min_score=0.3).float()
    scorer.provenance = {"scenes": ["a"]}
    copy = LearnedScore.read(scorer.save(tmp_path / "deep" / "score.json"))
    assert copy.provenance == {"scenes": ["a"]} and (copy.half_error, copy.min_score) == (0.2, 0.3)
    torch.save(scorer.state_dict(), tmp_path / "score.pt")
    other = LearnedScore(5, half_error=0.2, min_score=0.3)
    other.load_state_dict(torch.load(tmp_path / "score.pt", weights_only=True))
    for found in (copy, other):
        assert torch.equal(found(*answers()).score, scorer(*answers()).score)
    with pytest.raises(FileNotFoundError):
        LearnedScore.read(tmp_path / "none.json")


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("weights"),
        lambda c: c.update(evidence=["parallax_deg"]),
        lambda c: c["weights"].update(last=[0.0] * 3),
        lambda c: c["weights"].update(extra=[0.0]),
        lambda c: c["weights"]["last"].__setitem__(0, "1"),
        lambda c: c["weights"]["last"].__setitem__(0, float("nan")),
        lambda c: c["weights"]["last"].__setitem__(0, 10**400),
        lambda c: c.update(half_error=None),
        b"\x93NUMPY",
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, change):
    content = json.loads(LearnedScore().to_json())
    is_text = callable(change)
    if is_text:
        change(content)
    path = tmp_path / "score.json"
    path.write_bytes(json.dumps(content).encode() if is_text else change)
    with pytest.raises(ValueError, match=rf"score\.json: found .* expected {'a learned score' if is_text else 'text'}"):
        LearnedScore.read(path)
