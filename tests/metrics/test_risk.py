"""What a score is worth: risk and coverage against plain loops, with ties, at the limits, and where the cut falls."""

import itertools
import math
import statistics

import pytest
import torch
from support.random_answers import random_points

from dhtorch import pytree
from dhtorch.metrics import errors, risk


def with_errors(error, score=None):
    """Answers whose relative errors are exactly those given."""
    p = errors.make_points(torch.ones(len(error)), torch.ones(len(error)), score)
    true = torch.where(torch.tensor(error) > 0, 1 / torch.tensor(error, dtype=torch.float64), 1.0).round()
    return p.replace(true_depth=true, depth=true + (torch.tensor(error) > 0))


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
        p = random_points(n, seed, ties, unanswered=0.0 if n == 1 else 0.3)
        if not p.keep.any():
            continue
        # a score that means something, so that the coverages are not all zero
        better = (p.score - p.error.nan_to_num()).mul(4).round() if ties else p.score - 3 * p.error.nan_to_num()
        for scored in (p, p.replace(score=better)):
            found = risk.measure_risk(scored)
            expected = brute_measure(scored.error.tolist(), scored.score.tolist(), scored.keep.tolist())
            for name, value in expected.items():
                assert found[name] == pytest.approx(value, abs=1e-12), name


def test_risk_does_not_depend_on_the_order_of_the_list():
    p = random_points(300, ties=True)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(3))
    there, back = risk.measure_risk(p), risk.measure_risk(p[order])
    for name, value in there.items():
        assert back[name] == pytest.approx(value, abs=1e-12), name


def test_a_perfect_order_has_no_excess_and_a_reversed_one_falls():
    p = random_points(200, unanswered=0.0)
    best, worst = risk.measure_risk(p.replace(score=-p.error)), risk.measure_risk(p.replace(score=p.error))
    assert best["aurc_excess"] == pytest.approx(0, abs=1e-12) and best["monotonicity"] == 1
    assert worst["aurc"] > best["aurc"] and worst["monotonicity"] == 0
    with pytest.raises(ValueError, match="risk_curve: score"):
        risk.risk_curve(torch.ones(3), torch.ones(2))


def test_the_curve_ends_at_the_coverage_and_never_beats_the_oracle():
    p = random_points(200)
    coverage, found = risk.risk_coverage(p)
    best = risk.risk_coverage(p, oracle=True)[1]
    assert coverage[-1] == pytest.approx(errors.measure_errors(p)["coverage"]) and coverage[0] == 1 / 200
    assert found[-1] == pytest.approx(best[-1]) and (best <= found + 1e-12).all() and (best < found - 0.05).any()


def test_coverage_counts_silent_candidates_and_needs_ten_points():
    true = torch.ones(40)
    depth = torch.where(torch.arange(40) < 20, 1.01, math.nan)
    assert risk.measure_risk(errors.make_points(depth, true))["coverage_at_5"] == 0.5
    few = torch.where(torch.arange(40) < 9, 1.01, math.nan)
    assert risk.measure_risk(errors.make_points(few, true))["coverage_at_5"] == 0


def test_monotonicity_and_the_largest_fall_by_hand():
    true = torch.ones(20)
    rising = risk.measure_risk(errors.make_points(true + torch.arange(20) / 100, true, 1 - torch.arange(20) / 20))
    assert rising["monotonicity"] == 1 and rising["largest_fall"] == 0
    wrong = true.clone()
    wrong[:2] = 1.5  # the two surest are the worst
    found = risk.measure_risk(errors.make_points(wrong, true, 1 - torch.arange(20) / 20))
    assert found["monotonicity"] == 0 and found["largest_fall"] == pytest.approx(0.5 - 0.05)
    assert risk.measure_risk(errors.make_points(true[:9], true[:9]))["largest_fall"] is None


def test_realised_risk_at_a_threshold():
    p = random_points(300, 1)
    for threshold in (0.0, 0.5, 0.8):
        sure = [min(e, 1.0) for e, s, k in zip(p.error, p.score, p.keep, strict=True) if k and s >= threshold]
        assert risk.realised_risk(p, threshold) == pytest.approx(float(sum(sure) / len(sure)), abs=1e-12)
    assert risk.realised_risk(p, 1.01) is None and risk.realised_risk(p, None) is None


def test_the_surest_answers():
    p = random_points(300, 1)
    kept = int(p.keep.sum())
    for n in (0, 1, 100, kept - 1, kept, kept + 9):
        cut = risk.keep_surest(p, n)
        assert int(cut.keep.sum()) == min(n, kept) and cut.keep.numel() == 300
        best = sorted(p.score[p.keep].tolist(), reverse=True)[:n]
        assert sorted(cut.answered().score.tolist(), reverse=True) == best
        assert errors.measure_errors(cut)["n_candidates"] == 300 and cut.depth[~cut.keep].isnan().all()


def test_a_cut_through_equal_scores_keeps_a_fair_sample_in_any_order():
    p = random_points(2000, 1).replace(score=torch.ones(2000, dtype=torch.float64))
    p = p.replace(score=torch.where(p.keep, p.score, 0.0))
    cut = risk.keep_surest(p, 101)
    assert int(cut.keep.sum()) == 101
    assert errors.measure_errors(cut)["median_rel"] == pytest.approx(errors.measure_errors(p)["median_rel"], rel=0.03)
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(4))
    again = risk.keep_surest(p[order], 101)
    assert errors.measure_errors(again)["median_rel"] == errors.measure_errors(cut)["median_rel"]


# ---------------------------------------------------------------------------------------------------- at the limits


@pytest.mark.parametrize("percent", [5, 10, 20])
def test_a_risk_of_exactly_the_limit_is_accepted(percent):
    exact = with_errors([percent / 100])
    assert exact.error.tolist() == [percent / 100]
    found = risk.measure_risk(exact, min_points=1)
    assert [found[f"coverage_at_{p}"] for p in (5, 10, 20)] == [float(p >= percent) for p in (5, 10, 20)]


def test_ten_points_are_enough_for_a_coverage_and_nine_are_not():
    for n, expected in ((10, 1.0), (9, 0.0)):
        assert risk.measure_risk(with_errors([0.0] * n))["coverage_at_5"] == expected
    assert risk.measure_risk(with_errors([0.0] * 4), min_points=4)["coverage_at_5"] == 1
    assert risk.measure_risk(with_errors([0.0] * 4), min_points=5)["coverage_at_5"] == 0


def test_a_coverage_ends_where_scores_do_and_never_within_a_tie():
    score = torch.tensor([3.0] * 10 + [2.0] * 4)
    good_then_mixed = with_errors([0.0] * 10 + [0.0, 0.0, 1.0, 1.0], score)
    found = risk.measure_risk(good_then_mixed)
    assert found["coverage_at_10"] == 10 / 14 and found["coverage_at_20"] == 1, "2 errors in 14 are 14 %"


def test_the_risk_of_infinite_errors_is_one_and_scores_may_be_infinite():
    loss = risk.cap_error(torch.tensor([0.3, 1.0, 7.0, math.inf, math.nan]))
    assert loss.tolist() == pytest.approx([0.3, 1, 1, 1, 1])
    found = risk.risk_curve(torch.tensor([0.0, 1.0, 0.5]), torch.tensor([-math.inf, math.inf, 0.0]))
    assert found.dtype == torch.float64 and found.tolist() == [1.0, 0.75, 0.5]


def test_silent_candidates_come_last_whatever_the_scores_of_the_others():
    p = with_errors([0.0, 0.5], torch.tensor([-3.0, -2.0]))
    silent = errors.make_points(torch.full((2,), math.nan), torch.ones(2))
    both = pytree.collate([silent, p])
    assert risk.measure_risk(both)["aurc_full"] == pytest.approx((0.5 + 0.25 + 1.5 / 3 + 2.5 / 4) / 4)


def test_silent_scenes_and_none_at_all():
    silent = risk.measure_risk(errors.make_points(torch.full((12,), math.nan), torch.ones(12)))
    assert {k for k, v in silent.items() if v is not None} == {f"coverage_at_{p}" for p in (5, 10, 20)} | {"aurc_full"}
    assert silent["aurc_full"] == 1 and silent["coverage_at_5"] == silent["coverage_at_20"] == 0
    assert set(risk.measure_risk(errors.make_points(torch.zeros(0), torch.zeros(0))).values()) == {None}


def test_coverage_is_a_share_of_all_candidates():
    p = random_points(50, unanswered=0.5)
    kept = int(p.keep.sum())
    coverage, found = risk.risk_coverage(p)
    assert coverage.tolist() == pytest.approx([k / 50 for k in range(1, kept + 1)])
    loss = risk.cap_error(p.answered().error).tolist()
    assert found.tolist() == pytest.approx(brute_curve(loss, p.answered().score.tolist()))
    assert risk.risk_coverage(p, oracle=True)[1].tolist() == pytest.approx(brute_curve(loss, [-e for e in loss]))
    assert [x.numel() for x in risk.risk_coverage(p[:0])] == [0, 0]
    assert [x.tolist() for x in risk.risk_coverage(with_errors([0.5]))] == [[1.0], [0.5]]


@pytest.mark.parametrize("n", [10, 11, 19, 23, 57])
@pytest.mark.parametrize("seed", range(3))
def test_monotonicity_equals_brute_force(n, seed):
    p = random_points(n, seed, unanswered=0.0)
    loss = risk.cap_error(p.error)[p.score.argsort(descending=True)].tolist()
    tenths = [statistics.mean(loss[: n * k // 10]) for k in range(1, 11)]
    found = risk.measure_risk(p)
    assert found["monotonicity"] == sum(b >= a for a, b in itertools.pairwise(tenths)) / 9
    falls = [a - b for k, a in enumerate(tenths) for b in tenths[k:]]
    assert found["largest_fall"] == pytest.approx(max(falls), abs=1e-12)


def test_a_level_curve_does_not_fall():
    assert risk.measure_risk(with_errors([0.1] * 37))["monotonicity"] == 1


def test_an_answer_that_scores_the_threshold_is_accepted():
    p = with_errors([0.1, 0.2, 0.5], torch.tensor([0.75, 0.5, 0.25]))
    assert risk.realised_risk(p, 0.5) == pytest.approx(0.15) and risk.realised_risk(p, 0.25) == pytest.approx(0.8 / 3)
    silent = p.replace(keep=torch.tensor([True, False, True]))
    assert risk.realised_risk(silent, 0.5) == pytest.approx(0.1), "silent ones are not accepted, whatever their score"
    assert risk.realised_risk(errors.make_points(torch.full((2,), 9.0), torch.ones(2)), 0.0) == 1, (
        "an error counts as 1 at most"
    )


def test_a_cut_through_equal_scores_takes_the_middles_of_equal_parts_of_the_tie():
    error = [0.5, 0.1, 0.25, 0.2, 0.0, 1 / 3, 1 / 6, 1 / 7, 1 / 8, 1 / 9, 0.05]
    score = torch.tensor([1.0] * 9 + [2.0, 0.5])
    cut = risk.keep_surest(with_errors(error, score), 4)
    tied = sorted(error[:9])
    assert sorted(cut.answered().error.tolist()) == pytest.approx(sorted([tied[1], tied[4], tied[7], 1 / 9]))
    two = risk.keep_surest(with_errors(error, score), 3)
    assert sorted(two.answered().error.tolist()) == pytest.approx(sorted([tied[2], tied[6], 1 / 9]))


def test_what_a_cut_silences_is_silent_in_every_field():
    p = random_points(30, unanswered=0.2)
    cut = risk.keep_surest(p, 7)
    assert torch.equal(cut.true_depth, p.true_depth) and not cut.score[~cut.keep].any()
    for name in ("depth", "sigma", "residual_px"):
        assert getattr(cut, name)[~cut.keep].isnan().all(), name
        assert torch.equal(getattr(cut, name)[cut.keep], getattr(p, name)[cut.keep]), name
    assert torch.equal(cut.score[cut.keep], p.score[cut.keep]) and not (cut.keep & ~p.keep).any()
    assert risk.keep_surest(p, 24 + 30) is p


def test_sparsification_by_hand_and_its_ends():
    g = torch.Generator().manual_seed(5)
    error = torch.rand(400, generator=g, dtype=torch.float64)
    one = torch.ones_like(error)

    def scored(score):
        return errors.make_points(1 + error, one, score)

    assert risk.ause(scored(-error)) == pytest.approx(0, abs=1e-12), "the errors' own order"
    assert risk.ause(scored(one)) == pytest.approx(1), "what cannot be told apart is left as chance leaves it"
    assert risk.ause(scored(error)) > 1.5, "the worst order"
    score = torch.rand(400, generator=g, dtype=torch.float64)
    left, best = ([float(error[order][: round(4 * (100 - k))].mean()) for k in range(96)] for order in (
        score.argsort(descending=True), error.argsort()
    ))  # fmt: skip
    area = statistics.mean(a - b for a, b in zip(left, best, strict=True))
    chance = float(error.mean()) - statistics.mean(best)
    assert risk.ause(scored(score)) == pytest.approx(area / chance)
    assert (
        risk.ause(
            errors.make_points(torch.full((3,), torch.nan), one[:3], one[:3], keep=torch.zeros(3, dtype=torch.bool))
        )
        is None
    )


def test_the_knee_is_the_point_farthest_below_the_chord():
    coverage, risks = [0.6, 0.5, 0.35, 0.2, 0.1], [0.13, 0.11, 0.08, 0.075, 0.07]
    assert risk.find_knee(coverage, risks) == 2
    assert risk.find_knee([10 * c for c in coverage], [r / 7 + 3 for r in risks]) == 2, "no units"
    assert risk.find_knee(coverage[::-1], risks[::-1]) == 2, "no order of the points"
    for straight in ([0.1, 0.2, 0.3], [0.3, 0.2, 0.1], [0.1, 0.25, 0.3], [0.1, 0.1, 0.1]):
        assert risk.find_knee([0.1, 0.2, 0.3], straight) is None, straight
    assert risk.find_knee([0.1, 0.2], [0.1, 0.2]) is None and risk.find_knee([], []) is None
    assert risk.find_knee([0.2, 0.2, 0.2], [0.1, 0.2, 0.3]) is None, "no width"
