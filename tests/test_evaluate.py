"""Evaluation: the truth test on maps whose answer is known by hand, the metrics against plain loops."""

import math
import os
import statistics
from pathlib import Path

import numpy as np
import pytest
import torch

from dhtorch import data
from dhtorch.evaluate import bootstrap, calibrate, errors, holdout, risk
from dhtorch.evaluate.holdout import Rule
from dhtorch.records import Camera, Estimate, Frame, Samples

ROOT = os.environ.get("DHTORCH_DATA")


def frame_of(depth, hw=None, depth_camera=None):
    """A view with the depth map (h, w) or (B, h, w) and a grey image of size hw."""
    depth = depth if depth.dim() == 3 else depth[None]
    B, (h, w) = depth.shape[0], hw or depth.shape[-2:]
    camera = Camera(torch.full((B, 2), 50.0), torch.tensor([(w - 1) / 2, (h - 1) / 2]).expand(B, 2))
    return Frame(torch.full((B, 1, h, w), 0.5), depth, camera, depth_camera)


def at(*uv):
    return torch.tensor(uv, dtype=torch.float32)[None]


def samples_of(trackability):
    zero = torch.zeros_like(trackability)
    code = zero.int()
    return Samples(torch.zeros(*zero.shape, 2), zero, zero, torch.zeros(*zero.shape, 3), zero, code, trackability, code)


# ---------------------------------------------------------------------------------------------------- range split


def test_range_split_removes_what_lies_beyond_and_nothing_else():
    depth = torch.tensor([[[0.0, 1.0], [2.0, 2.5]]])
    near = holdout.range_split(frame_of(depth), 2.0)
    assert near.depth.tolist() == [[[0.0, 1.0], [2.0, 0.0]]]
    assert depth[0, 1, 1] == 2.5, "the full map is the truth and stays as it is"
    for nothing in (None, math.inf):
        assert torch.equal(holdout.range_split(frame_of(depth), nothing).depth, depth)


@pytest.mark.parametrize("cutoff", [-1.0, 0.0, math.nan, -math.inf])
def test_a_cutoff_that_is_no_distance_raises(cutoff):
    with pytest.raises(ValueError, match=r"holdout\.cutoff: found .*expected a positive number"):
        holdout.range_split(frame_of(torch.ones(4, 4)), cutoff)


# ---------------------------------------------------------------------------------------------------- truth test


def test_truth_rules_on_a_dense_map():
    depth = torch.full((60, 80), 4.0)
    depth[30, 20] = 0  # a missing pixel
    depth[:, 60:] = 5.0  # a step of 25 %
    depth[10, 40] = math.nan
    uv = at((10, 10), (20, 30), (22, 30), (23, 30), (57, 30), (58, 30), (47, 30), (48, 30), (-9, 5), (40, 10))
    truth = holdout.truth_at(frame_of(depth), uv)
    ok, none, close, wide = Rule.CANDIDATE, Rule.NO_RETURN, Rule.CLOSE, Rule.WIDE
    # columns: smooth but (10,10) reaches over the map's edge only with its wide window, which asks valid pixels alone
    assert truth.code[0].tolist() == [ok, none, close, ok, wide, close, ok, wide, none, none]
    assert truth.depth[0].tolist() == [4, 0, 4, 4, 4, 4, 4, 4, 0, 0]
    only = holdout.truth_at(frame_of(depth), uv, truth="5x5").code[0].tolist()
    assert only == [ok, none, close, ok, ok, close, ok, ok, none, none]
    raw = holdout.truth_at(frame_of(depth), uv, truth="raw").code[0].tolist()
    assert raw == [ok, none, ok, ok, ok, ok, ok, ok, none, none]
    with pytest.raises(ValueError, match=r"holdout\.truth: found 'best'"):
        holdout.truth_at(frame_of(depth), uv, truth="best")


def test_the_spread_limits_are_where_they_are_said_to_be():
    u = torch.arange(100.0)
    for slope, close_fails, wide_fails in ((0.004, False, False), (0.008, False, True), (0.014, True, True)):
        depth = (10 * (1 + slope) ** u).expand(60, 100)  # 5 px spread (1 + s)^4 − 1, 25 px (1 + s)^24 − 1
        assert ((1 + slope) ** 4 - 1 >= 0.05) == close_fails
        assert ((1 + slope) ** 24 - 1 >= 0.15) == wide_fails
        code = int(holdout.truth_at(frame_of(depth), at((50, 30))).code)
        assert code == (Rule.CLOSE if close_fails else Rule.WIDE if wide_fails else Rule.CANDIDATE)


def test_a_wider_patch_asks_for_a_wider_window():
    depth = torch.full((60, 80), 4.0)
    depth[:, 60:] = 5.0
    uv = at((44, 30))
    assert holdout.truth_at(frame_of(depth), uv, window=25).ok.all()
    assert not holdout.truth_at(frame_of(depth), uv, window=35).ok.any()


def test_sparse_truth_takes_the_nearest_return():
    depth = torch.zeros(60, 80)
    depth[30, 30], depth[33, 33] = 8.0, 8.2  # both in reach of (31, 31); (30, 30) is nearer
    depth[10, 10], depth[10, 13] = 8.0, 9.0  # 12.5 % apart: close fails
    depth[50, 10], depth[50, 17] = 8.0, 9.5  # 7 px apart: only the wide window sees both
    uv = at((31, 31), (32.6, 32.6), (10, 11), (10, 50), (60, 30), (34, 33))
    truth = holdout.truth_at(frame_of(depth), uv, sparse=True)
    assert truth.code[0].tolist() == [0, 0, Rule.CLOSE, Rule.WIDE, Rule.NO_RETURN, 0]
    torch.testing.assert_close(truth.depth[0], torch.tensor([8.0, 8.2, 8.0, 8.0, 0.0, 8.2]))
    raw = holdout.truth_at(frame_of(depth), uv, sparse=True, truth="raw")
    assert raw.ok[0].tolist() == [True, True, True, True, False, True]
    close = holdout.truth_at(frame_of(depth), uv, sparse=True, truth="5x5")
    assert close.ok[0].tolist() == [True, True, False, True, False, True]


def test_a_coarse_map_is_read_by_the_exact_scaling_rule():
    depth = (torch.arange(12.0) + 100).expand(8, 12)  # spread under 5 % within 3 px
    frame = frame_of(depth, hw=(32, 48))
    u = torch.arange(4, 44, dtype=torch.float32)
    uv = torch.stack((u, torch.full_like(u, 15.0)), -1)[None]
    truth = holdout.truth_at(frame, uv)
    assert truth.ok.all()  # 5 and 25 px of the image are 3 and 7 px of the map
    torch.testing.assert_close(truth.depth[0], 100 + torch.floor((u + 0.5) / 4 - 0.5 + 0.5))


def test_a_map_with_its_own_camera_is_reached_along_the_ray():
    depth = (100 + torch.arange(40.0)).expand(30, 40)
    own = Camera(torch.tensor([[25.0, 25.0]]), torch.tensor([[10.0, 14.0]]))
    frame = frame_of(depth, hw=(60, 80), depth_camera=own)
    truth = holdout.truth_at(frame, at((39.5, 29.5), (49.5, 29.5)), truth="raw")
    assert truth.depth[0].tolist() == [110.0, 115.0]


def test_truth_of_a_pair_does_not_depend_on_its_batch():
    torch.set_num_threads(1)
    depth = 3 + torch.rand(5, 40, 50, generator=torch.Generator().manual_seed(0)) * 0.3
    depth[depth < 3.02] = 0
    uv = torch.rand(5, 203, 2, generator=torch.Generator().manual_seed(1)) * 45
    frame = frame_of(depth)
    for sparse in (False, True):
        together = holdout.truth_at(frame, uv, sparse=sparse)
        for b in range(5):
            alone = holdout.truth_at(frame[b : b + 1], uv[b : b + 1], sparse=sparse)
            assert torch.equal(alone.depth, together.depth[b : b + 1])
            assert torch.equal(alone.code, together.code[b : b + 1])


def test_candidates_are_held_back_smooth_and_textured_and_counted_by_rule():
    truth = holdout.Truth(
        depth=torch.tensor([[0.0, 1.0, 3.0, 3.0, 3.0, 3.0, 3.0, 2.0]]),
        code=torch.tensor([[1, 0, 0, 3, 4, 0, 0, 3]], dtype=torch.int32),
    )
    trackability = torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0, 0.19, 1.0, 1.0]])
    excluded = torch.tensor([[True] + [False] * 5 + [True, False]])
    found = holdout.candidates(samples_of(trackability), truth, 2.0, excluded=excluded)
    expected = [Rule.NO_RETURN, Rule.NEAR, 0, Rule.CLOSE, Rule.WIDE, Rule.TEXTURE, Rule.EXCLUDED, Rule.NEAR]
    assert found.code[0].tolist() == expected
    assert found.dropped() == {"close": 1, "wide": 1, "excluded": 1, "texture": 1}
    assert not holdout.candidates(samples_of(trackability), truth, None).ok.any()


def test_the_texture_limit_is_a_share_of_the_median():
    trackability = torch.tensor([[1.0, 2.0, 3.0, 4.0, 0.49, 100.0]])  # median 2.5
    truth = holdout.Truth(torch.full((1, 6), 5.0), torch.zeros(1, 6, dtype=torch.int32))
    assert holdout.candidates(samples_of(trackability), truth, 2.0).ok[0].tolist() == [True] * 4 + [False, True]


def test_no_samples():
    truth = holdout.truth_at(frame_of(torch.ones(30, 30)), torch.zeros(1, 0, 2))
    assert holdout.candidates(samples_of(torch.zeros(1, 0)), truth, 0.5).code.shape == (1, 0)


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
@pytest.mark.parametrize(("name", "cutoff"), [("holo_a", 2.5), ("7s_redkitchen_600", 2.0), ("dgp_drive6cam", 20.0)])
def test_every_held_back_return_of_a_real_frame_is_accounted_for(name, cutoff):
    recording = data.open_all(Path(ROOT) / name)[0]
    frame = recording[0]
    v, u = torch.meshgrid(torch.arange(4, frame.hw[0], 11.0), torch.arange(4, frame.hw[1], 11.0), indexing="ij")
    uv = torch.stack((u, v), -1).flatten(0, 1)[None]
    textured = samples_of(torch.rand(1, uv.shape[1], generator=torch.Generator().manual_seed(0)))
    kept = []
    for rule in holdout.TESTS:
        truth = holdout.truth_at(frame, uv, truth=rule, sparse=recording.sparse)
        found = holdout.candidates(textured, truth, cutoff)
        assert int(found.ok.sum()) + sum(found.dropped().values()) == int((truth.depth > cutoff).sum())
        kept.append(found.ok)
    assert (kept[0] >= kept[1]).all() and (kept[1] >= kept[2]).all()
    assert kept[0].sum() > kept[2].sum() > 0.2 * kept[0].sum()
    near = holdout.range_split(frame, cutoff)
    assert near.depth.max() <= cutoff and torch.equal(near.depth > 0, (frame.depth > 0) & (frame.depth <= cutoff))


# ---------------------------------------------------------------------------------------------------- errors


def random_points(n, seed=0, ties=False, silent=0.3):
    g = np.random.default_rng(seed)
    true = g.uniform(2, 6, n)
    depth = true * np.exp(g.normal(0, 0.3, n))
    score = g.integers(0, 6, n) / 5 if ties else g.uniform(0, 1, n)
    keep = g.uniform(size=n) > silent
    t = torch.from_numpy
    return errors.points(
        t(depth), t(true), t(score), sigma=t(0.2 * true), residual_px=t(g.uniform(0, 3, n)), keep=t(keep)
    )


def test_errors_equal_numpy():
    p = random_points(500)
    keep = p.keep.numpy()
    z, true, sigma, residual = (x.numpy()[keep] for x in (p.depth, p.true_depth, p.sigma, p.residual_px))
    rel = np.abs(z - true) / true
    expected = {
        "n_candidates": 500,
        "n_kept": keep.sum(),
        "coverage": keep.mean(),
        "median_rel": np.median(rel),
        "p90_rel": np.percentile(rel, 90),
        "wrong_share": (rel > 0.2).mean(),
        "corr": np.corrcoef(z, true)[0, 1],
        "residual_px": np.median(residual),
        "within_sigma": (np.abs(z - true) <= sigma).mean(),
        "within_2sigma": (np.abs(z - true) <= 2 * sigma).mean(),
    }
    found = errors.measure(p)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=1e-12), name


def test_undefined_numbers_are_none():
    nothing = errors.measure(errors.points(torch.zeros(0), torch.zeros(0)))
    assert nothing["n_candidates"] == nothing["n_kept"] == 0
    assert {v for k, v in nothing.items() if not k.startswith("n_")} == {None}
    silent = errors.points(torch.full((4,), math.nan), torch.ones(4))
    assert errors.measure(silent)["coverage"] == 0 and errors.measure(silent)["median_rel"] is None
    one = errors.measure(errors.points(torch.tensor([1.1]), torch.ones(1)))
    assert one["corr"] is None and one["within_sigma"] is None and one["residual_px"] is None
    assert one["median_rel"] == pytest.approx(0.1, abs=1e-6)
    numbers = risk.measure(silent)
    assert numbers["aurc"] is None and numbers["aurc_full"] == 1 and numbers["coverage_at_10"] == 0
    assert set(risk.measure(errors.points(torch.zeros(0), torch.zeros(0))).values()) == {None}
    assert calibrate.measure([silent]) == calibrate.measure([]) == {"ece": None, "ece_equal_mass": None}


def test_points_of_an_estimate_are_its_candidates():
    n, nan = 4, math.nan
    row = torch.tensor([[1.0, nan, 3.0, nan]])
    gate = torch.tensor([[0, 6, 0, 1]], dtype=torch.int32)
    zero = torch.zeros(1, n)
    estimate = Estimate(torch.zeros(1, n, 2), row, row / 10, zero, zero, zero + 0.5, zero.int(), zero + 0.7, gate)
    truth = holdout.Truth(torch.full((1, n), 2.0), torch.tensor([[0, 0, Rule.WIDE, 0]], dtype=torch.int32))
    p = errors.select(estimate, truth)
    assert p.true_depth.tolist() == [2, 2, 2] and p.keep.tolist() == [True, False, False]
    assert p.error[0] == 0.5 and p.error[1:].isnan().all() and p.score[1:].tolist() == [0, 0]
    with pytest.raises(ValueError, match="points: score has shape"):
        errors.points(torch.ones(3), torch.ones(3), torch.ones(2))


def test_an_answer_that_is_no_depth_is_silence():
    p = errors.points(torch.tensor([1.0, math.inf, -1.0, 0.0, math.nan]), torch.ones(5), keep=torch.ones(5).bool())
    assert p.keep.tolist() == [True, False, False, False, False]


def test_summary_is_the_median_over_scenes_never_pooled():
    scenes = [
        {"scene": "a", "pair": None, "n_kept": 1000, "median_rel": 0.1, "pnp_ok": True, "ms": {"track": 5.0}},
        {"scene": "b", "pair": None, "n_kept": 10, "median_rel": 0.2, "pnp_ok": True, "ms": {"track": 6.0}},
        {"scene": "c", "pair": None, "n_kept": 10, "median_rel": 0.9, "pnp_ok": False, "ms": {"track": 9.0}},
        {"scene": "d", "pair": None, "n_kept": 0, "median_rel": None, "pnp_ok": False, "ms": {"track": 9.0}},
    ]
    summary = errors.summarise(scenes)
    assert set(summary) == {"n_kept", "median_rel", "ms.track"}
    assert summary["median_rel"] == {"value": 0.2, "low": 0.1, "high": 0.9, "n": 3, "unit": "1"}
    assert summary["n_kept"] == {"value": 1020, "low": None, "high": None, "n": 4, "unit": "count"}
    assert summary["ms.track"]["value"] == 7.5 and summary["ms.track"]["unit"] == "ms"
    assert errors.summarise(scenes, statistic="mean")["median_rel"]["value"] == pytest.approx(0.4)


# ---------------------------------------------------------------------------------------------------- risk


def brute_curve(loss, score):
    """Expected running mean over all orders of tied scores, one k at a time."""
    risks = []
    for k in range(1, len(loss) + 1):
        threshold = sorted(score, reverse=True)[k - 1]
        sure = [e for e, s in zip(loss, score, strict=True) if s > threshold]
        tied = [e for e, s in zip(loss, score, strict=True) if s == threshold]
        risks.append((sum(sure) + (k - len(sure)) * sum(tied) / len(tied)) / k)
    return risks


def brute_measure(error, score, keep, min_points=10):
    n = len(error)
    loss = [min(e, 1.0) for e, k in zip(error, keep, strict=True) if k]
    sure = [s for s, k in zip(score, keep, strict=True) if k]
    risks, oracle = brute_curve(loss, sure), brute_curve(loss, [-e for e in loss])
    everything = [min(e, 1.0) if k else 1.0 for e, k in zip(error, keep, strict=True)]
    full = brute_curve(everything, [s if k else -9.0 for s, k in zip(score, keep, strict=True)])
    numbers = {
        "aurc": statistics.mean(risks),
        "aurc_excess": statistics.mean(risks) - statistics.mean(oracle),
        "aurc_full": statistics.mean(full),
        "augrc": statistics.mean(r * (k + 1) / len(risks) for k, r in enumerate(risks)),
    }
    for percent in (5, 10, 20):
        best = 0
        for threshold in set(sure):
            accepted = [e for e, s in zip(loss, sure, strict=True) if s >= threshold]
            if len(accepted) >= min_points and sum(accepted) / len(accepted) <= percent / 100:
                best = max(best, len(accepted))
        numbers[f"coverage_at_{percent}"] = best / n
    return numbers


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("n", [1, 2, 9, 40, 150])
def test_risk_equals_brute_force(n, ties):
    for seed in range(4):
        p = random_points(n, seed, ties, silent=0.0 if n == 1 else 0.3)
        if not p.keep.any():
            continue
        # a score that means something, so that the coverages are not all zero
        better = (p.score - p.error.nan_to_num()).mul(4).round() if ties else p.score - 3 * p.error.nan_to_num()
        for scored in (p, p.replace(score=better)):
            found = risk.measure(scored)
            expected = brute_measure(scored.error.tolist(), scored.score.tolist(), scored.keep.tolist())
            for name, value in expected.items():
                assert found[name] == pytest.approx(value, abs=1e-12), name


def test_risk_does_not_depend_on_the_order_of_the_list():
    p = random_points(300, ties=True)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(3))
    there, back = risk.measure(p), risk.measure(p[order])
    for name, value in there.items():
        assert back[name] == pytest.approx(value, abs=1e-12), name


def test_a_perfect_order_has_no_excess_and_a_reversed_one_falls():
    p = random_points(200, silent=0.0)
    best, worst = risk.measure(p.replace(score=-p.error)), risk.measure(p.replace(score=p.error))
    assert best["aurc_excess"] == pytest.approx(0, abs=1e-12) and best["monotonicity"] == 1
    assert worst["aurc"] > best["aurc"] and worst["monotonicity"] == 0
    with pytest.raises(ValueError, match="curve: score"):
        risk.curve(torch.ones(3), torch.ones(2))


def test_the_curve_ends_at_the_coverage_and_never_beats_the_oracle():
    p = random_points(200)
    coverage, found = risk.risk_coverage(p)
    best = risk.risk_coverage(p, oracle=True)[1]
    assert coverage[-1] == pytest.approx(errors.measure(p)["coverage"]) and coverage[0] == 1 / 200
    assert found[-1] == pytest.approx(best[-1]) and (best <= found + 1e-12).all() and (best < found - 0.05).any()


def test_coverage_counts_silent_candidates_and_needs_ten_points():
    true = torch.ones(40)
    depth = torch.where(torch.arange(40) < 20, 1.01, math.nan)
    assert risk.measure(errors.points(depth, true))["coverage_at_5"] == 0.5
    few = torch.where(torch.arange(40) < 9, 1.01, math.nan)
    assert risk.measure(errors.points(few, true))["coverage_at_5"] == 0


# ---------------------------------------------------------------------------------------------------- calibration


def brute_ece(scenes, bins):
    total = 0.0
    for k in range(bins):
        weight = claimed = good = 0.0
        for scene in scenes:
            for p, e in scene:
                if min(int(p * bins), bins - 1) == k:
                    weight, claimed, good = (
                        weight + 1 / len(scene),
                        claimed + p / len(scene),
                        good + (e < 0.1) / len(scene),
                    )
        total += abs(claimed - good)
    return total / len(scenes)


def test_ece_equals_brute_force_with_equal_weight_per_scene():
    scenes = [random_points(n, seed) for seed, n in enumerate((30, 400, 90))]
    plain = [list(zip(s.answered().score.tolist(), s.answered().error.tolist(), strict=True)) for s in scenes]
    assert calibrate.measure(scenes)["ece"] == pytest.approx(brute_ece(plain, 10), abs=1e-12)
    assert calibrate.measure(scenes, bins=4)["ece"] == pytest.approx(brute_ece(plain, 4), abs=1e-12)
    twice = [*scenes[:1], *scenes[:1], *scenes]
    assert calibrate.measure(twice)["ece"] != pytest.approx(calibrate.measure(scenes)["ece"], abs=1e-6)


def test_a_calibrated_score_has_a_small_ece_and_a_boastful_one_has_not():
    g = torch.Generator().manual_seed(0)
    claimed = torch.rand(20000, generator=g, dtype=torch.float64)
    good = torch.rand(20000, generator=g, dtype=torch.float64) < claimed
    assert calibrate.reliability(claimed, good).ece < 0.02
    assert calibrate.reliability(claimed, good, equal_mass=True).ece < 0.02
    assert calibrate.reliability(claimed**0.5, good).ece == pytest.approx(2 / 3 - 1 / 2, abs=0.02)


def test_equal_mass_bins_weigh_the_same_and_keep_ties_together():
    claimed = torch.rand(1000, generator=torch.Generator().manual_seed(0)) ** 3
    diagram = calibrate.reliability(claimed, claimed > 0.5, equal_mass=True)
    torch.testing.assert_close(diagram.weight, torch.full((10,), 0.1, dtype=torch.float64), atol=2e-3, rtol=0)
    assert (diagram.claimed.diff() > 0).all()
    same = calibrate.reliability(torch.full((50,), 0.5), torch.arange(50) < 25, equal_mass=True)
    assert sorted(same.weight.tolist()) == [0.0] * 9 + [1.0] and same.ece == 0


def test_certainty_falls_into_the_last_bin():
    diagram = calibrate.reliability(torch.tensor([1.0, 0.0]), torch.tensor([True, False]))
    assert diagram.weight[[0, 9]].tolist() == [0.5, 0.5] and diagram.ece == 0


# ---------------------------------------------------------------------------------------------------- bootstrap


def test_an_interval_resamples_scenes_and_repeats_itself():
    values = [0.02, 0.05, None, 0.04, 0.30, 0.06, math.nan]
    found = bootstrap.interval(values)
    assert found.value == 0.05 and found.n == 5 and 0.02 <= found.low < 0.05 < found.high <= 0.30
    assert found == bootstrap.interval(values)
    assert bootstrap.interval(values, seed=1, draws=50) != bootstrap.interval(values, draws=50)
    assert bootstrap.interval([0.3]) == (0.3, None, None, 1)
    assert bootstrap.interval([None]) == (None, None, None, 0)


def test_an_interval_of_the_mean_is_as_wide_as_theory_says():
    values = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64).tolist()
    found = bootstrap.interval(values, statistic="mean", draws=4000)
    half = 1.96 * statistics.stdev(values) / 20
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.1)


@pytest.mark.parametrize("options", [{"statistic": "mode"}, {"level": 1.0}])
def test_bad_bootstrap_options_raise(options):
    with pytest.raises(ValueError, match=r"bootstrap\.\w+: found"):
        bootstrap.interval([1.0, 2.0], **options)
