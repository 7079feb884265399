"""Numbers from estimates and truth: against numpy, scipy and plain loops."""

import math
import statistics

import numpy as np
import pytest
import torch
from support.random_answers import random_points

from dhtorch import pytree
from dhtorch.metrics import bootstrap, correlation, curves, errors, holdout, reliability, risk
from dhtorch.metrics.holdout import TruthCode
from dhtorch.records import Estimate


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
    found = errors.measure_errors(p)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=1e-12), name


def test_undefined_numbers_are_none():
    nothing = errors.measure_errors(errors.make_points(torch.zeros(0), torch.zeros(0)))
    assert nothing["n_candidates"] == nothing["n_kept"] == 0
    assert {v for k, v in nothing.items() if not k.startswith("n_")} == {None}
    silent = errors.make_points(torch.full((4,), math.nan), torch.ones(4))
    assert errors.measure_errors(silent)["coverage"] == 0 and errors.measure_errors(silent)["median_rel"] is None
    one = errors.measure_errors(errors.make_points(torch.tensor([1.1]), torch.ones(1)))
    assert one["corr"] is None and one["within_sigma"] is None and one["residual_px"] is None
    assert one["median_rel"] == pytest.approx(0.1, abs=1e-6)
    assert (
        reliability.measure_reliability([silent])
        == reliability.measure_reliability([])
        == {"ece": None, "ece_equal_mass": None}
    )


def test_points_of_an_estimate_are_its_candidates():
    n, nan = 4, math.nan
    row = torch.tensor([[1.0, nan, 3.0, nan]])
    gate = torch.tensor([[0, 6, 0, 1]], dtype=torch.int32)
    zero = torch.zeros(1, n)
    estimate = Estimate(torch.zeros(1, n, 2), row, row / 10, zero, zero, zero + 0.5, zero.int(), zero + 0.7, gate)
    truth = holdout.Truth(torch.full((1, n), 2.0), torch.tensor([[0, 0, TruthCode.WIDE, 0]], dtype=torch.int32))
    p = errors.points_from_estimate(estimate, truth)
    assert p.true_depth.tolist() == [2, 2, 2] and p.keep.tolist() == [True, False, False]
    assert p.error[0] == 0.5 and p.error[1:].isnan().all() and p.score[1:].tolist() == [0, 0]
    with pytest.raises(ValueError, match="make_points: score has shape"):
        errors.make_points(torch.ones(3), torch.ones(3), torch.ones(2))


def test_an_answer_that_is_no_depth_is_silence():
    p = errors.make_points(torch.tensor([1.0, math.inf, -1.0, 0.0, math.nan]), torch.ones(5), keep=torch.ones(5).bool())
    assert p.keep.tolist() == [True, False, False, False, False]


def test_summary_is_the_median_over_scenes_never_pooled():
    scenes = [
        {"scene": "a", "pair": None, "n_kept": 1000, "median_rel": 0.1, "pnp_ok": True, "ms": {"track": 5.0}},
        {"scene": "b", "pair": None, "n_kept": 10, "median_rel": 0.2, "pnp_ok": True, "ms": {"track": 6.0}},
        {"scene": "c", "pair": None, "n_kept": 10, "median_rel": 0.9, "pnp_ok": False, "ms": {"track": 9.0}},
        {"scene": "d", "pair": None, "n_kept": 0, "median_rel": None, "pnp_ok": False, "ms": {"track": 9.0}},
    ]
    summary = errors.summarise_scenes(scenes)
    assert set(summary) == {"n_kept", "median_rel", "ms.track"}
    assert summary["median_rel"] == {"value": 0.2, "low": 0.1, "high": 0.9, "n": 3, "unit": "1"}
    assert summary["n_kept"] == {"value": 1020, "low": None, "high": None, "n": 4, "unit": "count"}
    assert summary["ms.track"]["value"] == 7.5 and summary["ms.track"]["unit"] == "ms"
    assert errors.summarise_scenes(scenes, statistic="mean")["median_rel"]["value"] == pytest.approx(0.4)


# ---------------------------------------------------------------------------------------------------- bootstrap


def test_an_interval_resamples_scenes_and_repeats_itself():
    values = [0.02, 0.05, None, 0.04, 0.30, 0.06, math.nan]
    found = bootstrap.interval_over_scenes(values)
    assert found.value == 0.05 and found.n == 5 and 0.02 <= found.low < 0.05 < found.high <= 0.30
    assert found == bootstrap.interval_over_scenes(values)
    assert bootstrap.interval_over_scenes(values, seed=1, draws=50) != bootstrap.interval_over_scenes(values, draws=50)
    assert bootstrap.interval_over_scenes([0.3]) == (0.3, None, None, 1)
    assert bootstrap.interval_over_scenes([None]) == (None, None, None, 0)


def test_an_interval_of_the_mean_is_as_wide_as_theory_says():
    values = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64).tolist()
    found = bootstrap.interval_over_scenes(values, statistic="mean", draws=4000)
    half = 1.96 * statistics.stdev(values) / 20
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.1)


@pytest.mark.parametrize("options", [{"statistic": "mode"}, {"level": 1.0}])
def test_bad_bootstrap_options_raise(options):
    with pytest.raises(ValueError, match=r"bootstrap\.\w+: found"):
        bootstrap.interval_over_scenes([1.0, 2.0], **options)


def test_the_geometric_mean_of_ratios():
    found = bootstrap.interval_over_scenes([0.5, 2.0, None, 1.0], statistic="geometric_mean")
    assert found.value == pytest.approx(1) and found.n == 3 and 0.5 <= found.low < 1 < found.high <= 2
    halves = bootstrap.interval_over_scenes([0.25] * 5, statistic="geometric_mean")
    assert (halves.low, halves.value, halves.high) == pytest.approx((0.25, 0.25, 0.25))


def test_an_interval_of_any_number_leaves_undefined_draws_out():
    values = torch.tensor([1.0, math.nan, 3.0])
    found = bootstrap.interval_of_statistic(lambda index: values[index].nanmean(-1), 3, draws=500)
    assert found.value == 2 and 1 <= found.low <= 2 <= found.high <= 3
    assert bootstrap.interval_of_statistic(lambda index: index.sum(-1) * math.nan, 3).value is None


def loop_interval(values, join, level, draws, seed):
    """Every resample of the scenes for itself, then the percentiles that enclose ``level``."""
    found = [
        join([values[i] for i in row]) for row in bootstrap.resample_scenes(len(values), draws, seed=seed).tolist()
    ]
    return join(values), *np.percentile(found, [50 * (1 - level), 50 * (1 + level)])


@pytest.mark.parametrize("n", [2, 5, 8])
@pytest.mark.parametrize(
    ("statistic", "join"),
    [("median", np.median), ("mean", np.mean), ("geometric_mean", statistics.geometric_mean)],
)
def test_an_interval_equals_percentiles_of_resampled_scenes(n, statistic, join):
    values = np.random.default_rng(n).uniform(0.1, 3, n).tolist()
    found = bootstrap.interval_over_scenes(
        [None, *values, -math.inf], statistic=statistic, level=0.8, draws=300, seed=4
    )
    assert found[:3] == pytest.approx(loop_interval(values, join, 0.8, 300, 4), rel=1e-9) and found.n == n
    assert bootstrap.interval_over_scenes(values)[:3] == pytest.approx(
        loop_interval(values, np.median, 0.95, 2000, 0), rel=1e-9
    )


def test_scenes_are_drawn_with_replacement_each_as_often_as_another():
    index = bootstrap.resample_scenes(7, 20000, seed=2)
    assert index.shape == (20000, 7) and index.min() == 0 and index.max() == 6
    share = torch.bincount(index.flatten(), minlength=7) / index.numel()
    assert share.tolist() == pytest.approx([1 / 7] * 7, abs=4 * math.sqrt(6 / 49 / 140000))
    distinct = (torch.nn.functional.one_hot(index, 7).sum(1) > 0).sum(1).double().mean()
    assert float(distinct) == pytest.approx(7 * (1 - (6 / 7) ** 7), abs=0.03)
    assert torch.equal(index, bootstrap.resample_scenes(7, 20000, seed=2)) and not torch.equal(
        index, bootstrap.resample_scenes(7, 20000, seed=3)
    )
    assert torch.equal(bootstrap.resample_scenes(7, 9), bootstrap.resample_scenes(7, 9, seed=0))


def test_an_interval_of_any_number_holds_95_per_cent_of_2000_draws():
    values = torch.tensor([3.0, 1.0, 4.0, 1.5, 9.0], dtype=torch.float64)
    found = bootstrap.interval_of_statistic(lambda index: values[index].amax(-1) - values[index].mean(-1), 5)
    expected = loop_interval(values.tolist(), lambda x: max(x) - sum(x) / 5, 0.95, 2000, 0)
    assert found[:3] == pytest.approx(expected)


def test_a_number_that_is_undefined_for_all_scenes_has_no_interval_but_a_count():
    nothing = bootstrap.interval_of_statistic(lambda index: index.sum(-1) * math.nan, 3)
    assert nothing == (None, None, None, 3)
    assert bootstrap.interval_of_statistic(lambda index: index.sum(-1) * math.inf, 3).value is None
    once = bootstrap.interval_of_statistic(lambda index: index.sum(-1) + 5.0, 1)
    assert once == (5.0, None, None, 1) and bootstrap.interval_of_statistic(lambda index: index.sum(-1), 0).n == 0


@pytest.mark.parametrize("level", [0.0, 1.0, 1.5, -0.1])
def test_a_level_that_is_no_probability_raises(level):
    with pytest.raises(ValueError, match=r"bootstrap\.level: found"):
        bootstrap.interval_of_statistic(lambda index: index.sum(-1), 2, level=level)


# ---------------------------------------------------------------------------------------------------- correlation


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("n", [2, 3, 40])
def test_correlations_are_scipys(n, ties):
    stats = pytest.importorskip("scipy.stats")
    g = np.random.default_rng(n)
    x, y = (g.integers(0, 6, n).astype(float) if ties else g.normal(5, 3, n) for _ in range(2))
    x[0], y[0] = 6.5, 7.5  # so that both spread
    a, b = torch.from_numpy(x), torch.from_numpy(y + 0.3 * x)
    assert correlation.pearson(a, b) == pytest.approx(stats.pearsonr(a, b)[0], abs=1e-12)
    assert correlation.spearman(a, b) == pytest.approx(stats.spearmanr(a, b)[0], abs=1e-12)
    ranks = correlation._ranks(a)
    assert ranks.dtype == torch.float64 and ranks.tolist() == (stats.rankdata(x) - 1).tolist()


def test_a_correlation_needs_two_values_that_differ():
    one, two, same = torch.tensor([1.0]), torch.tensor([1.0, 2.0]), torch.tensor([3.0, 3.0])
    for of in (correlation.pearson, correlation.spearman):
        assert of(one, one) is None and of(two, same) is None and of(same, two) is None and of(one[:0], one[:0]) is None
        assert of(two, -two) == pytest.approx(-1)


# ---------------------------------------------------------------------------------------------------- errors, limits


def test_an_error_of_a_fifth_is_not_wrong_and_one_of_exactly_sigma_is_within():
    """Errors 1/5, 1/4 and 2/4 with sigmas that are the error, half of it, and less."""
    p = errors.make_points(
        torch.tensor([6.0, 5.0, 6.0]), torch.tensor([5.0, 4.0, 4.0]), sigma=torch.tensor([1.0, 0.5, 0.9])
    )
    found = errors.measure_errors(p)
    assert found["wrong_share"] == 2 / 3
    assert found["within_sigma"] == 1 / 3 and found["within_2sigma"] == 2 / 3


def test_answers_without_a_stated_sigma_or_residual_do_not_count_there():
    nan = math.nan
    p = errors.make_points(
        torch.tensor([1.0, 1.1, 2.0]),
        torch.ones(3),
        sigma=torch.tensor([nan, 0.2, 0.1]),
        residual_px=torch.tensor([3.0, nan, 1.0]),
    )
    found = errors.measure_errors(p)
    assert (found["within_sigma"], found["within_2sigma"], found["residual_px"]) == (0.5, 0.5, 2.0)


def test_points_of_a_scene_are_pooled_before_the_quantile_is_taken():
    """Two pairs of 1 and 4 answers: the median of all five, not the mean of two medians."""
    one = errors.make_points(torch.tensor([1.5]), torch.ones(1))
    four = errors.make_points(1 + torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64), torch.ones(4))
    found = errors.measure_errors(pytree.collate([one, four]))
    assert found["median_rel"] == pytest.approx(0.3) and found["p90_rel"] == pytest.approx(0.46)


def test_points_takes_any_shape_and_counts_what_may_count():
    nan = math.nan
    depth = torch.tensor([[1.0, 2.0, nan], [4.0, 5.0, 6.0]])
    true = torch.tensor([[2.0, math.inf, 2.0], [nan, 2.0, -1.0]])
    candidate = torch.tensor([[1, 1, 1], [1, 1, 1]])
    p = errors.make_points(depth, true, torch.tensor([[nan, 0.2, 0.3], [0.4, 0.5, 0.6]]), sigma=depth / 10)
    assert p.true_depth.tolist() == [2, 2, 2] and p.keep.tolist() == [True, False, True]
    assert p.score.tolist() == pytest.approx([0, 0, 0.5]) and p.sigma.isnan().tolist() == [False, True, False]
    assert {x.dtype for x in (p.true_depth, p.depth, p.score, p.sigma, p.residual_px)} == {torch.float64}
    assert not errors.make_points(torch.ones(4), torch.tensor([0.0, nan, math.inf, -math.inf])).keep.numel()
    candidate[0, 0] = 0
    assert errors.make_points(depth, true, candidate=candidate).true_depth.tolist() == [2, 2]
    refused = errors.make_points(depth, true, keep=torch.tensor([[0, 1, 1], [1, 1, 1]]))
    assert refused.keep.tolist() == [False, False, True] and refused.depth[0].isnan()
    assert refused.score.tolist() == [0, 0, 1] and refused.residual_px.isnan().all()
    for name in ("depth", "sigma", "residual_px", "keep", "candidate"):
        with pytest.raises(ValueError, match=f"make_points: {name} has shape \\(3,\\), expected \\(2, 3\\)"):
            errors.make_points(**{"depth": depth, "true_depth": true, name: torch.ones(3)})


def test_a_summary_passes_over_names_and_flattens_groups():
    one = {"scene": 1, "pair": 2, "method": 3, "text": "a", "list": [1], "yes": True, "n_kept": None, "px": 1}
    two = {"ms": {"a": {"b": 4.0}, "c": 6}, "residual_px": 3.0, "err_m": 1, "n_kept": 7, "turn_deg": None}
    found = errors.summarise_scenes([one, two])
    assert list(found) == ["n_kept", "px", "ms.a.b", "ms.c", "residual_px", "err_m", "turn_deg"]
    assert [found[k]["unit"] for k in found] == ["count", "1", "ms", "ms", "px", "m", "deg"]
    assert [found[k]["value"] for k in found] == [7, 1, 4, 6, 3, 1, None]
    assert [found[k]["n"] for k in found] == [1, 1, 1, 1, 1, 1, 0]
    assert errors.metric_unit("ms") == "ms" and errors.metric_unit("corr") == "1" and errors.metric_unit("items") == "1"
    assert errors.summarise_scenes([one])["n_kept"]["value"] is None


def test_an_interval_is_an_entry_of_a_summary():
    found = bootstrap.interval_over_scenes([1.0, 2.0, 4.0])
    assert found.entry("m") == {"value": 2.0, "low": found.low, "high": found.high, "n": 3, "unit": "m"}
    assert list(found.entry()) == ["value", "low", "high", "n", "unit"] and found.entry()["unit"] == "1"
    assert bootstrap.without_interval(0.5, 4, "ms") == {"value": 0.5, "low": None, "high": None, "n": 4, "unit": "ms"}


def test_a_summary_hands_its_options_to_the_bootstrap():
    scenes = [{"x": float(v)} for v in (1, 2, 4, 9, 30)]
    for statistic, draws, seed in (("median", 2000, 0), ("mean", 70, 0), ("mean", 70, 5)):
        options = {} if draws == 2000 else {"statistic": statistic, "draws": draws, "seed": seed}
        wanted = bootstrap.interval_over_scenes([1, 2, 4, 9, 30], statistic=statistic, draws=draws, seed=seed)
        assert errors.summarise_scenes(scenes, **options)["x"] == wanted._asdict() | {"unit": "1"}


# ---------------------------------------------------------------------------------------------------- curves


def five(x):
    return None if x is None or math.isnan(x) else float(f"{x:.5g}")


@pytest.mark.parametrize("n", [1, 7, 33, 90])
@pytest.mark.parametrize("ties", [False, True])
def test_curves_equal_plain_loops(n, ties):
    p = random_points(n, seed=n, ties=ties, unanswered=0.0 if n == 1 else 0.3)
    found, a = curves.sample_curves(p), p.answered()
    kept = a.keep.numel()
    ranked = sorted(zip(a.score.tolist(), a.error.tolist(), strict=True), key=lambda row: -row[0])
    at = sorted({max(1, round(kept * k / 20)) for k in range(1, 21)})
    curve, oracle = risk.risk_coverage(p)[1].tolist(), np.minimum(sorted(a.error.tolist()), 1)
    assert found["risk_coverage"]["coverage"] == [five(k / n) for k in at]
    assert found["risk_coverage"]["risk"] == [five(curve[k - 1]) for k in at]
    assert found["risk_coverage"]["oracle"] == pytest.approx([five(oracle[:k].mean()) for k in at], rel=2e-5)
    assert found["risk_coverage"]["score"] == [five(ranked[k - 1][0]) for k in at]
    medians = [float(np.median([e for _, e in ranked[:k]])) for k in at]
    assert found["risk_coverage"]["median_rel"] == pytest.approx([five(x) for x in medians], rel=2e-5)
    tenths = np.array_split(np.argsort(p.true_depth.numpy(), kind="stable"), min(10, n))
    error, keep = p.error.numpy(), p.keep.numpy()
    assert found["distance"]["depth"] == [five(np.median(p.true_depth.numpy()[k])) for k in tenths]
    assert found["distance"]["coverage"] == [five(keep[k].mean()) for k in tenths]
    medians = [np.median(error[k][keep[k]]) if keep[k].any() else None for k in tenths]
    assert found["distance"]["median_rel"] == [five(x) for x in medians]
    table = reliability.reliability_diagram(a.score, a.error < 0.1, bins=10)
    for name in ("claimed", "realised", "weight"):
        assert found["reliability"][name] == [five(x) for x in getattr(table, name).tolist()]


def test_curves_of_nothing_are_empty():
    nothing = curves.sample_curves(errors.make_points(torch.zeros(0), torch.zeros(0)))
    assert {len(v) for part in ("risk_coverage", "distance") for v in nothing[part].values()} == {0}
    assert set(nothing["reliability"]["claimed"]) == {None}
    silent = curves.sample_curves(errors.make_points(torch.full((3,), math.nan), torch.arange(1.0, 4)))
    assert silent["distance"] == {"depth": [1, 2, 3], "coverage": [0, 0, 0], "median_rel": [None] * 3}
    assert silent["risk_coverage"]["coverage"] == []
