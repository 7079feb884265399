"""Risk and coverage of a score: with ties and at the limits; many numbers at once: test_stored_answers.py."""

import math

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


TIED = with_errors([0.0] * 10 + [0.0, 0.0, 1.0, 1.0], torch.tensor([3.0] * 10 + [2.0] * 4))
SILENT = errors.make_points(torch.full((12,), math.nan), torch.ones(12))
LAST = pytree.collate([SILENT[:2], with_errors([0.0, 0.5], torch.tensor([-3.0, -2.0]))])
THREE = with_errors([0.1, 0.2, 0.5], torch.tensor([0.75, 0.5, 0.25]))


@pytest.mark.parametrize(
    ("points", "options", "expected"),
    [
        # a risk of exactly the limit is accepted
        (with_errors([0.05]), {"min_points": 1}, {"coverage_at_5": 1, "coverage_at_10": 1, "coverage_at_20": 1}),
        (with_errors([0.1]), {"min_points": 1}, {"coverage_at_5": 0, "coverage_at_10": 1, "coverage_at_20": 1}),
        (with_errors([0.2]), {"min_points": 1}, {"coverage_at_5": 0, "coverage_at_10": 0, "coverage_at_20": 1}),
        # ten points are enough for a coverage and nine are not
        (with_errors([0.0] * 10), {}, {"coverage_at_5": 1}),
        (with_errors([0.0] * 9), {}, {"coverage_at_5": 0, "largest_fall": None}),
        (with_errors([0.0] * 4), {"min_points": 4}, {"coverage_at_5": 1}),
        (with_errors([0.0] * 4), {"min_points": 5}, {"coverage_at_5": 0}),
        # a coverage ends where scores do and never within a tie: 2 errors in 14 are 14 %
        (TIED, {}, {"coverage_at_10": 10 / 14, "coverage_at_20": 1}),
        # silent candidates come last, whatever the scores of the others
        (LAST, {}, {"aurc_full": (0.5 + 0.25 + 1.5 / 3 + 2.5 / 4) / 4}),
        (SILENT, {}, {"aurc_full": 1, **dict.fromkeys((f"coverage_at_{p}" for p in (5, 10, 20)), 0)} | dict.fromkeys(("aurc", "aurc_excess", "augrc", "monotonicity", "largest_fall"))),
        (SILENT[:0], {}, dict.fromkeys(risk.measure_risk(SILENT))),
        (with_errors([0.1] * 37), {}, {"monotonicity": 1, "largest_fall": 0}),
    ],
)  # fmt: skip
def test_limits_of_risk(points, options, expected):
    found = risk.measure_risk(points, **options)
    for name, value in expected.items():
        assert found[name] == (None if value is None else pytest.approx(value)), name


@pytest.mark.parametrize(
    ("points", "threshold", "expected"),
    [
        (THREE, 0.5, 0.15),
        (THREE, 0.25, 0.8 / 3),
        (THREE, 0.7500001, None),
        (THREE, None, None),
        (THREE.replace(keep=torch.tensor([True, False, True])), 0.5, 0.1),
        (errors.make_points(torch.full((2,), 9.0), torch.ones(2)), 0.0, 1),
    ],
)
def test_realised_risk_at_a_threshold(points, threshold, expected):
    assert risk.realised_risk(points, threshold) == (None if expected is None else pytest.approx(expected))


def test_the_risk_of_infinite_errors_is_one_and_scores_may_be_infinite():
    loss = risk.cap_error(torch.tensor([0.3, 1.0, 7.0, math.inf, math.nan]))
    assert loss.tolist() == pytest.approx([0.3, 1, 1, 1, 1])
    found = risk.risk_curve(torch.tensor([0.0, 1.0, 0.5]), torch.tensor([-math.inf, math.inf, 0.0]))
    assert found.dtype == torch.float64 and found.tolist() == [1.0, 0.75, 0.5]
    with pytest.raises(ValueError, match="risk_curve: score"):
        risk.risk_curve(torch.ones(3), torch.ones(2))


@pytest.mark.parametrize("n", [0, 1, 7, 100, 190, 10**6])
def test_the_surest_answers(n):
    p = random_points(300, 1)
    kept = int(p.keep.sum())
    cut = risk.keep_surest(p, n)
    if n >= kept:
        assert cut is p
        return
    assert int(cut.keep.sum()) == n and not (cut.keep & ~p.keep).any() and torch.equal(cut.true_depth, p.true_depth)
    assert sorted(cut.answered().score.tolist()) == sorted(p.score[p.keep].tolist())[kept - n :]
    for name, silent in {"depth": math.nan, "sigma": math.nan, "residual_px": math.nan, "score": 0.0}.items():
        expected = torch.where(cut.keep, getattr(p, name), silent)
        torch.testing.assert_close(getattr(cut, name), expected, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(("n", "tied"), [(4, (1, 4, 7)), (3, (2, 6))])
def test_a_cut_through_equal_scores_takes_the_middles_of_equal_parts_of_the_tie(n, tied):
    error = [0.5, 0.1, 0.25, 0.2, 0.0, 1 / 3, 1 / 6, 1 / 7, 1 / 8, 1 / 9, 0.05]
    p = with_errors(error, torch.tensor([1.0] * 9 + [2.0, 0.5]))
    for order in (torch.arange(11), torch.arange(11).flip(0)):
        found = sorted(risk.keep_surest(p[order], n).answered().error.tolist())
        assert found == pytest.approx(sorted([*(sorted(error[:9])[k] for k in tied), 1 / 9]))


KNEE = [0.6, 0.5, 0.35, 0.2, 0.1], [0.13, 0.11, 0.08, 0.075, 0.07]


@pytest.mark.parametrize(
    ("coverage", "risks", "expected"),
    [
        (*KNEE, 2),
        ([10 * c for c in KNEE[0]], [r / 7 + 3 for r in KNEE[1]], 2),
        (KNEE[0][::-1], KNEE[1][::-1], 2),
        *(([0.1, 0.2, 0.3], r, None) for r in ([0.1, 0.2, 0.3], [0.3, 0.2, 0.1], [0.1, 0.25, 0.3], [0.1, 0.1, 0.1])),
        ([0.1, 0.2], [0.1, 0.2], None),
        ([], [], None),
        ([0.2, 0.2, 0.2], [0.1, 0.2, 0.3], None),
    ],
)
def test_the_knee_is_the_point_farthest_below_the_chord(coverage, risks, expected):
    assert risk.find_knee(coverage, risks) == expected
