"""Ridge regression in closed form: against other solvers, streams against memory, splits, and intervals over groups."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from dhtorch.experiments.probes import ridge
from dhtorch.experiments.probes.ridge import compute_moments, make_folds, predict_targets, solve_ridge
from dhtorch.metrics import bootstrap
from dhtorch.metrics.bootstrap import Interval

PENALTIES = torch.tensor([1e-3, 0.1, 3.0], dtype=torch.float64)


def samples(n=120, f=9, d=3, seed=0):
    """Features of very different spread around a common offset, and targets that depend on some."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, f, generator=g, dtype=torch.float64) * torch.logspace(-3, 3, f, dtype=torch.float64) + 5
    y = (x / x.std(0))[:, :d] @ torch.randn(d, d, generator=g, dtype=torch.float64)
    return x, y + 0.3 * torch.randn(n, d, generator=g, dtype=torch.float64)


def fitted(x, y, penalty=PENALTIES):
    return predict_targets(solve_ridge(compute_moments(x, y), penalty), x)


def by_least_squares(x, y, penalty):
    """Standardised features, the intercept free, the penalty as further rows; solved by numpy."""
    x, y, (n, f) = x.numpy(), y.numpy(), x.shape
    rows = np.concatenate((np.ones((n, 1)), (x - x.mean(0)) / x.std(0)), 1)
    held = np.concatenate((np.zeros((f, 1)), np.diag(np.sqrt(n * np.broadcast_to(penalty, f)))), 1)
    known = np.concatenate((y, np.zeros((f, y.shape[1]))))
    return torch.from_numpy(rows @ np.linalg.lstsq(np.concatenate((rows, held)), known, rcond=None)[0])


def by_scikit_learn(x, y, penalty):
    linear_model = pytest.importorskip("sklearn.linear_model")
    scaled = ((x - x.mean(0)) / x.std(0, correction=0)).numpy()
    return torch.from_numpy(linear_model.Ridge(alpha=float(penalty) * len(x)).fit(scaled, y.numpy()).predict(scaled))


@pytest.mark.parametrize(
    ("shape", "penalty", "oracle"),
    [
        ((40, 60), PENALTIES, by_least_squares),  # more features than samples
        ((40, 60), PENALTIES[:, None] * torch.linspace(0.5, 2, 60), by_least_squares),
        ((30, 4), torch.zeros(1).double(), by_least_squares),
        ((120, 9), PENALTIES, by_scikit_learn),
    ],
)
def test_ridge_is_that_of_other_solvers(shape, penalty, oracle):
    x, y = samples(*shape)
    for found, p in zip(fitted(x, y, penalty), penalty, strict=True):
        torch.testing.assert_close(found, oracle(x, y, p.numpy()), atol=1e-6, rtol=0)


def test_moments_are_numpys_in_parts_and_with_leading_dimensions():
    g = torch.Generator().manual_seed(0)
    x, y = (torch.randn(2, 3, 501, k, generator=g) * 3 + 2 for k in (4, 2))
    parts = [compute_moments(x[:, :, a:b], y[:, :, a:b]) for a, b in ((0, 64), (64, 501), (501, 501))]
    stream = ridge.MomentStream(4, 2)
    for a, b in zip(x[1, 2].split(64), y[1, 2].split(64), strict=True):
        stream.add(a.requires_grad_(), b)
    assert not stream.moments.x.requires_grad
    a, t = x[1, 2].double().numpy(), y[1, 2].double().numpy()
    da, dt = a - a.mean(0), t - t.mean(0)
    expected = {"n": 501, "x": a.mean(0), "y": t.mean(0), "xx": da.T @ da, "xy": da.T @ dt, "yy": (dt**2).sum(0)}
    whole = compute_moments(x, y)
    joined = [
        ridge.join_moments(ridge.join_moments(parts[i], parts[j]), parts[k]) for i, j, k in ((0, 1, 2), (2, 1, 0))
    ]
    for name, want in expected.items():
        for moments in (whole, *joined):
            assert getattr(moments, name).dtype == torch.float64
            np.testing.assert_allclose(getattr(moments, name)[1, 2].numpy(), want, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(getattr(stream.moments, name).numpy(), want, rtol=1e-9, atol=1e-9)
    linear = solve_ridge(whole, PENALTIES)
    assert linear.weight.shape == (2, 3, 3, 4, 2)
    torch.testing.assert_close(predict_targets(linear, x)[1, 2], fitted(x[1, 2], y[1, 2]))


def test_selected_features_and_finite_samples_give_what_these_alone_give():
    x, y = samples()
    index = torch.tensor([7, 0, 3])
    selected = solve_ridge(ridge.select_features(compute_moments(x, y), index), PENALTIES)
    torch.testing.assert_close(selected.weight, solve_ridge(compute_moments(x[:, index], y), PENALTIES).weight)
    broken, target = x.clone(), y.clone()
    broken[3, 2], target[50, 1] = torch.nan, torch.inf
    rest = [k for k in range(len(x)) if k not in (3, 50)]
    found, want = compute_moments(broken, target), compute_moments(x[rest], y[rest])
    assert int(found.n) == len(rest)
    torch.testing.assert_close(found.xx, want.xx, rtol=1e-12, atol=0)


def test_constant_features_and_sets_without_samples_have_no_weight():
    x, y = samples()
    x = torch.cat((x, torch.full((len(x), 1), 7.3, dtype=x.dtype), torch.zeros(len(x), 1, dtype=x.dtype)), 1)
    linear = solve_ridge(compute_moments(x, y), PENALTIES)
    assert not linear.weight[:, -2:].any() and linear.weight[:, :-2].all()
    nothing = solve_ridge(compute_moments(x[:0], y[:0]), PENALTIES)
    assert not nothing.weight.any() and not nothing.bias.any()
    torch.testing.assert_close(fitted(x[:, :0], y), y.mean(0).expand(3, *y.shape))
    twice = compute_moments(torch.cat((x[:, :3], x[:, :1]), 1), y)  # cannot be solved without a penalty
    none, least = solve_ridge(twice, torch.tensor([0.0, 1e-12, 1e-9]).double()).weight[:2]
    assert torch.equal(none, least) and none.isfinite().all()
    assert solve_ridge(twice, torch.zeros(0)).weight.shape == (0, 4, 3)
    for spread, used in ((3e-9, True), (3e-10, False)):  # a feature varies from a billionth of its mean
        numbers = 40, [1.0], [0.0], [[40 * spread**2]], [[40 * spread]], [40.0]  # of -1, 1, -1, ... times the spread
        of = ridge.SampleMoments(*(torch.tensor(v, dtype=torch.float64) for v in numbers))
        assert bool(solve_ridge(of, PENALTIES).weight.any()) is used
        assert solve_ridge(of.replace(x=torch.zeros(1).double()), PENALTIES).weight.any(), "of mean 0 any spread is one"


def test_gradients_reach_the_samples_and_the_penalties():
    x, y = samples(n=7, f=3, d=2)
    x = (x - 5) / x.std(0)
    assert torch.autograd.gradcheck(fitted, [v.clone().requires_grad_() for v in (x, y, PENALTIES)], atol=1e-6)
    x[2], x[:, 1] = torch.nan, 1.0
    solve_ridge(compute_moments(x.requires_grad_(), y), PENALTIES).weight.sum().backward()
    assert x.grad.isfinite().all()


M = compute_moments(*samples())


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: make_folds(["a", "b", "c"], 2), r"folds: found 2 parts of 3 groups, expected at least three"),
        (lambda: make_folds(["a", "a", "b"], 3), r"folds: found 2 parts of 2 groups, expected at least three"),
        (lambda: ridge.join_moments(M, ridge.select_features(M, torch.tensor([0]))), "join_moments"),
        (lambda: ridge.MomentStream(3, 2).add(torch.ones(4, 2), torch.ones(4, 2)), r"MomentStream\.add"),
        (lambda: ridge.MomentStream(3, 2).add(torch.ones(4, 3), torch.ones(4, 1)), r"MomentStream\.add"),
        (lambda: compute_moments(torch.ones(4, 3), torch.ones(3, 2)), r"compute_moments: y has shape \(3, 2\)"),
        (lambda: compute_moments(torch.ones(2, 4, 3), torch.ones(4, 2)), "expected the same samples"),
        (lambda: solve_ridge(M, torch.tensor(1.0)), r"ridge: penalty has shape .*expected \(P,\) or \(P, 9\)"),
        (lambda: solve_ridge(M, torch.ones(2, 4)), r"ridge: penalty has shape .*expected \(P,\) or \(P, 9\)"),
        (lambda: predict_targets(solve_ridge(M, PENALTIES), torch.ones(4, 3)), "predict_targets"),
        (lambda: ridge.error_ratio(torch.ones(3), torch.ones(2)), "error_ratio"),
        (lambda: ridge.mean_squared_error(torch.ones(3), torch.ones(2)), "mean_squared_error"),
    ],
)
def test_wrong_inputs_are_named(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()


@pytest.mark.parametrize(("n", "groups"), [(5, 12), (3, 3), (4, 11), (9, 3)])
def test_every_group_is_tested_once_by_a_probe_that_neither_saw_it_nor_chose_on_it(n, groups):
    names = [f"g{k:02}" for k in range(groups)]
    folds = make_folds([*names, *names], n)
    assert len(folds) == min(n, groups) and sorted(g for fold in folds for g in fold.test) == names
    for k, fold in enumerate(folds):
        assert fold.choose == folds[(k + 1) % len(folds)].test and max(map(len, fold[1:])) <= -(-groups // len(folds))
        assert set(fold.train) == set(names) - set(fold.test) - set(fold.choose) and fold.train
    assert folds == make_folds(names[::-1], n) and (n == 5) <= (folds == make_folds(names))
    assert len({make_folds(names, n, seed=s)[0].test for s in range(9)}) > 1, "shuffled"


@pytest.mark.parametrize("options", [{}, {"level": 0.6}, {"draws": 40}, {"seed": 3, "draws": 60}])
def test_intervals_of_errors_resample_groups(options):
    g = np.random.default_rng(1)
    ours, theirs, counts = g.uniform(1, 9, 6), g.uniform(1, 9, 6), g.integers(1, 20, 6).astype(float)

    def by_loop(above, below, level=0.95, draws=2000, seed=0):
        rows = bootstrap.resample_scenes(6, draws, seed=seed).tolist()
        drawn = [sum(above[i] for i in row) / sum(below[i] for i in row) for row in rows]
        return sum(above) / sum(below), *np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])

    for call, below in ((ridge.mean_squared_error, counts), (ridge.error_ratio, theirs)):
        found = call(torch.from_numpy(ours), torch.from_numpy(below), **options)
        assert found[:3] == pytest.approx(by_loop(ours, below, **options)) and found.n == 6


@pytest.mark.parametrize(
    ("call", "numbers", "expected"),
    [
        (ridge.mean_squared_error, ([4.0, 0.0, 6.0, 0.0], [2.0, 0.0, 2.0, 1.0]), (2.0, 3)),  # no sample is no number
        (ridge.error_ratio, ([1.0, 0.0, 0.0], [2.0, 2.0, 0.0]), (0.25, 2)),
        (ridge.error_ratio, ([1.0, 1.0], [0.0, 0.0]), (None, 2)),
        (ridge.mean_squared_error, ([], []), (None, 0)),
    ],
)
def test_groups_without_samples_are_left_out(call, numbers, expected):
    found = call(*map(torch.tensor, numbers))
    assert (found.value, found.n) == expected


@pytest.mark.parametrize(
    ("low", "high", "margin", "expected"),
    [
        *((0.99, 1.01, 0.02, True), (0.97, 1.01, 0.02, None), (1.03, 1.2, 0.02, False), (0.5, 0.97, 0.02, False)),
        *((1.01, 1.03, 0.02, None), (0.98, 1.0, 0.02, None), (1.0, 1.02, 0.02, None), (0.9, 0.98, 0.02, None)),
        *((1.02, 1.1, 0.02, None), (0.9, 1.1, 0.2, True), (1.1, 1.2, 0.05, False), (0.8, 0.9, 0.05, False)),
        *((None, 1.0, 0.02, None), (1.0, None, 0.02, None)),
    ],
)
def test_equivalence_needs_the_interval_strictly_within_the_margin_or_beyond(low, high, margin, expected):
    assert ridge.is_equivalent(Interval(1.0, low, high, 9), margin) is expected
    assert margin != 0.02 or ridge.is_equivalent(Interval(1.0, low, high, 9)) is expected


MEMORY = """
import resource, torch
from dhtorch.experiments.probes import ridge as probe
torch.set_num_threads(1)
F, n = {F}, {n}
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
penalties = torch.logspace(-3, 2, 6)
probe.solve_ridge(probe.compute_moments(torch.randn(n, 100), torch.randn(n, 6)), penalties)
before, stream = peak(), probe.MomentStream(F, 6)
for shards in (2, 20):
    for k in range(shards):
        x = torch.randn(n, F, generator=torch.Generator().manual_seed(k))
        stream.add(x, x[:, :6])
    probe.solve_ridge(stream.moments, penalties)
    print(peak() - before)
"""


@pytest.mark.slow
def test_memory_is_squares_of_the_features_and_a_shard_however_many_there_are():
    """6,600 x 600, which would take 32 MB: five squares and some copies of one shard, after 2 shards as after 22."""
    F, n = 600, 300
    done = subprocess.run([sys.executable, "-c", MEMORY.format(F=F, n=n)], capture_output=True, text=True, check=True)
    few, many = map(int, done.stdout.split())
    assert many < few + 4e6 and few < 5 * F * F * 8 + 5 * n * F * 8 + 20e6
