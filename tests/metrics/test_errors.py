"""Numbers from estimates and truth: by hand and against scipy; many numbers at once: test_stored_answers.py."""

import math

import numpy as np
import pytest
import torch

from dhtorch.metrics import bootstrap, correlation, curves, errors, holdout
from dhtorch.metrics.holdout import TruthCode
from dhtorch.records import Estimate

NAN = math.nan


def points(depth, true, **columns):
    column = lambda x: None if x is None else torch.tensor(x)  # noqa: E731
    return errors.make_points(torch.tensor(depth), torch.tensor(true), **{k: column(v) for k, v in columns.items()})


NOTHING = dict.fromkeys(("coverage", "median_rel", "p90_rel", "wrong_share", "corr", "residual_px", "within_sigma"))


@pytest.mark.parametrize(
    ("p", "expected"),
    [
        (errors.make_points(torch.zeros(0), torch.zeros(0)), {"n_candidates": 0, "n_kept": 0, **NOTHING}),
        (points([NAN] * 4, [1.0] * 4), {"n_candidates": 4, "n_kept": 0, **NOTHING, "coverage": 0}),
        (points([1.1], [1.0]), {"corr": None, "within_sigma": None, "residual_px": None, "median_rel": 0.1}),
        # errors 1/5, 1/4 and 2/4 with sigmas that are the error, half of it, and less
        (points([6.0, 5.0, 6.0], [5.0, 4.0, 4.0], sigma=[1.0, 0.5, 0.9]), {"wrong_share": 2 / 3, "within_sigma": 1 / 3, "within_2sigma": 2 / 3}),
        # answers without a stated sigma or residual do not count there
        (points([1.0, 1.1, 2.0], [1.0] * 3, sigma=[NAN, 0.2, 0.1], residual_px=[3.0, NAN, 1.0]), {"within_sigma": 0.5, "within_2sigma": 0.5, "residual_px": 2.0}),
        (points([1.1, 1.2, 1.3, 1.4, 1.5], [1.0] * 5), {"median_rel": 0.3, "p90_rel": 0.46}),
    ],
)  # fmt: skip
def test_errors_at_their_limits(p, expected):
    found = errors.measure_errors(p)
    for name, value in expected.items():
        assert found[name] == (None if value is None else pytest.approx(value, abs=1e-6)), name


def test_points_of_an_estimate_are_its_candidates():
    row, zero = torch.tensor([[1.0, NAN, 3.0, NAN]]), torch.zeros(1, 4)
    gate = torch.tensor([[0, 6, 0, 1]], dtype=torch.int32)
    estimate = Estimate(torch.zeros(1, 4, 2), row, row / 10, zero, zero, zero + 0.5, zero.int(), zero + 0.7, gate)
    truth = holdout.Truth(torch.full((1, 4), 2.0), torch.tensor([[0, 0, TruthCode.WIDE, 0]], dtype=torch.int32))
    p = errors.points_from_estimate(estimate, truth)
    assert p.true_depth.tolist() == [2, 2, 2] and p.keep.tolist() == [True, False, False]
    assert p.error.tolist()[0] == 0.5 and p.score.tolist() == [pytest.approx(0.7), 0, 0]
    assert p.sigma.tolist()[0] == pytest.approx(0.1) and p.residual_px[0] == 0.5


DEPTH = torch.tensor([[1.0, 2.0, NAN], [4.0, 5.0, 6.0]])
TRUE = torch.tensor([[2.0, math.inf, 2.0], [NAN, 2.0, -1.0]])


@pytest.mark.parametrize(
    ("options", "true", "keep", "score"),
    [
        ({}, [2, 2, 2], [True, False, True], [1, 0, 1]),
        ({"score": torch.tensor([[NAN, 0.2, 0.3], [0.4, 0.5, 0.6]])}, [2, 2, 2], [True, False, True], [0, 0, 0.5]),
        ({"candidate": torch.tensor([[0, 1, 1], [1, 1, 1]])}, [2, 2], [False, True], [0, 1]),
        ({"keep": torch.tensor([[0, 1, 1], [1, 1, 1]])}, [2, 2, 2], [False, False, True], [0, 0, 1]),
        ({"depth": torch.tensor([[math.inf, 1, -1.0], [1, 0.0, 1]])}, [2, 2, 2], [False] * 3, [0, 0, 0]),
    ],
)
def test_points_take_any_shape_and_count_what_may_count(options, true, keep, score):
    p = errors.make_points(**{"depth": DEPTH, "true_depth": TRUE, "sigma": DEPTH / 10, **options})
    assert (p.true_depth.tolist(), p.keep.tolist(), p.score.tolist()) == (true, keep, pytest.approx(score))
    assert torch.equal(p.depth.isfinite(), p.keep) and torch.equal(p.sigma.isfinite(), p.keep)
    assert p.residual_px.isnan().all()
    assert {x.dtype for x in (p.true_depth, p.depth, p.score, p.sigma, p.residual_px)} == {torch.float64}


@pytest.mark.parametrize("name", ["depth", "score", "sigma", "residual_px", "keep", "candidate"])
def test_points_of_unequal_shapes_raise(name):
    with pytest.raises(ValueError, match=rf"make_points: {name} has shape \(3,\), expected \(2, 3\)"):
        errors.make_points(**{"depth": DEPTH, "true_depth": TRUE, name: torch.ones(3)})


def test_a_summary_is_over_scenes_and_flattens_groups():
    one = {"scene": 1, "pair": 2, "method": 3, "text": "a", "list": [1], "yes": True, "n_kept": None, "px": 1}
    two = {"ms": {"a": {"b": 4.0}, "c": 6}, "residual_px": 3.0, "err_m": 1, "n_kept": 7, "turn_deg": None}
    found = errors.summarise_scenes([one, two])
    rows = {name: (entry["value"], entry["n"], entry["unit"]) for name, entry in found.items()}
    assert rows == {
        "n_kept": (7, 1, "count"),
        "px": (1, 1, "1"),
        "ms.a.b": (4, 1, "ms"),
        "ms.c": (6, 1, "ms"),
        "residual_px": (3, 1, "px"),
        "err_m": (1, 1, "m"),
        "turn_deg": (None, 0, "deg"),
    }
    assert [errors.metric_unit(name) for name in ("ms", "corr", "items")] == ["ms", "1", "1"]
    assert errors.summarise_scenes([one])["n_kept"]["value"] is None
    counts = errors.summarise_scenes([{"n_kept": k, "x": x} for k, x in ((1000, 0.1), (10, 0.2), (0, None))])
    assert counts["n_kept"] == {"value": 1010, "low": None, "high": None, "n": 3, "unit": "count"}
    for options in ({}, {"statistic": "mean", "draws": 70}, {"statistic": "mean", "draws": 70, "seed": 5}):
        interval = bootstrap.interval_over_scenes([1, 2, 4, 9, 30], **options)
        scenes = [{"x": float(v)} for v in (1, 2, 4, 9, 30)]
        assert errors.summarise_scenes(scenes, **options)["x"] == interval._asdict() | {"unit": "1"}


# ---------------------------------------------------------------------------------------------------- bootstrap


def test_scenes_are_drawn_with_replacement_each_as_often_as_another():
    index = bootstrap.resample_scenes(7, 20000, seed=2)
    assert index.shape == (20000, 7) and index.min() == 0 and index.max() == 6
    fraction = torch.bincount(index.flatten(), minlength=7) / index.numel()
    assert fraction.tolist() == pytest.approx([1 / 7] * 7, abs=4 * math.sqrt(6 / 49 / 140000))
    distinct = (torch.nn.functional.one_hot(index, 7).sum(1) > 0).sum(1).double().mean()
    assert float(distinct) == pytest.approx(7 * (1 - (6 / 7) ** 7), abs=0.03)
    assert torch.equal(index, bootstrap.resample_scenes(7, 20000, seed=2))
    assert torch.equal(bootstrap.resample_scenes(7, 9), bootstrap.resample_scenes(7, 9, seed=0))


THREE = torch.tensor([1.0, NAN, 3.0])


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda: bootstrap.interval_over_scenes([0.3]), (0.3, None, None, 1)),
        (lambda: bootstrap.interval_over_scenes([None]), (None, None, None, 0)),
        (lambda: bootstrap.interval_of_statistic(lambda i: i.sum(-1) * NAN, 3), (None, None, None, 3)),
        (lambda: bootstrap.interval_of_statistic(lambda i: i.sum(-1) * math.inf, 3), (None, None, None, 3)),
        (lambda: bootstrap.interval_of_statistic(lambda i: i.sum(-1) + 5.0, 1), (5.0, None, None, 1)),
        (lambda: bootstrap.interval_of_statistic(lambda i: i.sum(-1), 0), (None, None, None, 0)),
        (lambda: bootstrap.interval_of_statistic(lambda i: THREE[i].nanmean(-1), 3, draws=500), (2, 1, 3, 3)),
        (lambda: bootstrap.interval_over_scenes([1.0] * 3).entry("m"), {"value": 1, "low": 1, "high": 1, "n": 3, "unit": "m"}),
        (lambda: bootstrap.without_interval(0.5, 4, "ms"), {"value": 0.5, "low": None, "high": None, "n": 4, "unit": "ms"}),
    ],
)  # fmt: skip
def test_intervals_of_few_scenes(call, expected):
    assert call() == expected


@pytest.mark.parametrize("options", [{"statistic": "mode"}, *({"level": v} for v in (0.0, 1.0, 1.5, -0.1))])
def test_bad_bootstrap_options_raise(options):
    with pytest.raises(ValueError, match=rf"bootstrap\.{next(iter(options))}: found"):
        bootstrap.interval_over_scenes([1.0, 2.0], **options)


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


@pytest.mark.parametrize("correlate", [correlation.pearson, correlation.spearman])
@pytest.mark.parametrize(
    ("x", "y", "expected"), [([1], [1], None), ([1, 2], [3, 3], None), ([3, 3], [1, 2], None), ([], [], None), ([1, 2], [2, 1], -1)]
)  # fmt: skip
def test_a_correlation_needs_two_values_that_differ(correlate, x, y, expected):
    found = correlate(torch.tensor(x, dtype=torch.float64), torch.tensor(y, dtype=torch.float64))
    assert found == (None if expected is None else pytest.approx(expected))


# ---------------------------------------------------------------------------------------------------- curves


def test_curves_of_nothing_are_empty():
    nothing = curves.sample_curves(errors.make_points(torch.zeros(0), torch.zeros(0)))
    assert {len(v) for part in ("risk_coverage", "distance") for v in nothing[part].values()} == {0}
    assert set(nothing["reliability"]["claimed"]) == {None}
    silent = curves.sample_curves(errors.make_points(torch.full((3,), NAN), torch.arange(1.0, 4)))
    assert silent["distance"] == {"depth": [1, 2, 3], "coverage": [0, 0, 0], "median_rel": [None] * 3}
    assert silent["risk_coverage"]["coverage"] == []
