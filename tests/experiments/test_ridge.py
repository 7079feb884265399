"""Ridge regression in closed form: against other solvers, streams against memory, splits, and intervals over groups."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from dhtorch.experiments.probes import ridge as probe
from dhtorch.metrics import bootstrap
from dhtorch.metrics.bootstrap import Interval

PENALTIES = torch.tensor([1e-3, 0.1, 3.0], dtype=torch.float64)


def samples(n=120, f=9, d=3, seed=0):
    """Features of very different spread around a common offset, and targets that depend on some."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(n, f, generator=g, dtype=torch.float64) * torch.logspace(-3, 3, f, dtype=torch.float64) + 5
    y = (x / x.std(0))[:, :d] @ torch.randn(d, d, generator=g, dtype=torch.float64)
    return x, y + 0.3 * torch.randn(n, d, generator=g, dtype=torch.float64)


def by_least_squares(x, y, penalty):
    """Standardised features, the intercept free, the penalty as further rows; solved by numpy."""
    x, y = x.numpy(), y.numpy()
    mean, std, n = x.mean(0), x.std(0), len(x)
    rows = np.concatenate((np.ones((n, 1)), (x - mean) / std), 1)
    held = np.concatenate((np.zeros((x.shape[1], 1)), np.diag(np.sqrt(n * np.broadcast_to(penalty, x.shape[1])))), 1)
    known = np.concatenate((y, np.zeros((x.shape[1], y.shape[1]))))
    w = np.linalg.lstsq(np.concatenate((rows, held)), known, rcond=None)[0]
    return torch.from_numpy(rows @ w)


# ---------------------------------------------------------------------------------------------------------- regression


@pytest.mark.parametrize("by_feature", [False, True])
def test_ridge_is_least_squares_with_further_rows(by_feature):
    x, y = samples(n=40, f=60)  # more features than samples
    penalty = PENALTIES[:, None] * torch.linspace(0.5, 2, 60) if by_feature else PENALTIES
    ours = probe.predict_targets(probe.solve_ridge(probe.compute_moments(x, y), penalty), x)
    for k in range(len(PENALTIES)):
        torch.testing.assert_close(ours[k], by_least_squares(x, y, penalty[k].numpy()), atol=1e-6, rtol=0)


def test_a_stream_of_shards_is_all_samples_at_once():
    x, y = samples(n=501)
    whole = probe.compute_moments(x, y)
    stream, joined = probe.MomentStream(9, 3), probe.compute_moments(x[:0], y[:0])
    for a, b in zip(x.split(64), y.split(64), strict=True):
        stream.add(a, b)
        joined = probe.join_moments(joined, probe.compute_moments(a, b))
    for found in (stream.moments, joined):
        for name in ("n", "x", "y", "xx", "xy", "yy"):
            want = getattr(whole, name)
            torch.testing.assert_close(getattr(found, name), want, rtol=0, atol=1e-12 * float(want.abs().max()))
    streamed, together = (probe.solve_ridge(m, PENALTIES).weight for m in (stream.moments, whole))
    torch.testing.assert_close(streamed, together, rtol=1e-9, atol=1e-12)


def test_columns_are_what_those_features_alone_give():
    x, y = samples()
    index = torch.tensor([7, 0, 3])
    ours = probe.solve_ridge(probe.select_features(probe.compute_moments(x, y), index), PENALTIES)
    alone = probe.solve_ridge(probe.compute_moments(x[:, index], y), PENALTIES)
    torch.testing.assert_close(ours.weight, alone.weight, rtol=1e-10, atol=0)


def test_samples_that_are_no_numbers_do_not_count():
    x, y = samples()
    spoilt, target = x.clone(), y.clone()
    spoilt[3, 2], target[50, 1] = torch.nan, torch.inf
    rest = torch.tensor([k for k in range(len(x)) if k not in (3, 50)])
    found, want = probe.compute_moments(spoilt, target), probe.compute_moments(x[rest], y[rest])
    assert int(found.n) == len(rest)
    torch.testing.assert_close(found.xx, want.xx, rtol=1e-12, atol=0)


def test_features_that_do_not_vary_and_sets_without_samples():
    x, y = samples()
    x = torch.cat((x, torch.full((len(x), 1), 7.3, dtype=x.dtype), torch.zeros(len(x), 1, dtype=x.dtype)), 1)
    linear = probe.solve_ridge(probe.compute_moments(x, y), PENALTIES)
    assert not linear.weight[:, -2:].any() and linear.weight[:, :-2].all()
    nothing = probe.solve_ridge(probe.compute_moments(x[:0], y[:0]), PENALTIES)
    assert not nothing.weight.any() and not nothing.bias.any()
    mean = probe.predict_targets(probe.solve_ridge(probe.compute_moments(x[:, :0], y), PENALTIES), x[:, :0])
    torch.testing.assert_close(mean, y.mean(0).expand_as(mean))


def test_gradients_reach_the_samples_and_the_penalties():
    x, y = samples(n=7, f=3, d=2)
    x = (x - 5) / x.std(0)
    fit = lambda x, y, p: probe.predict_targets(probe.solve_ridge(probe.compute_moments(x, y), p), x)  # noqa: E731
    inputs = [v.clone().requires_grad_() for v in (x, y, PENALTIES)]
    assert torch.autograd.gradcheck(fit, inputs, atol=1e-6)
    spoilt = x.clone()
    spoilt[2] = torch.nan
    spoilt[:, 1] = 1.0
    spoilt.requires_grad_()
    probe.solve_ridge(probe.compute_moments(spoilt, y), PENALTIES).weight.sum().backward()
    assert spoilt.grad.isfinite().all()


# ------------------------------------------------------------------------------------------------ splits and intervals


def test_every_group_is_judged_once_and_never_learnt_from():
    names = [f"task_{k}" for k in range(11)]
    folds = probe.make_folds([*names, *names], 4)
    assert sorted(g for fold in folds for g in fold.test) == sorted(names)
    for fold in folds:
        parts = [set(part) for part in fold]
        assert sum(map(len, parts)) == len(set.union(*parts)) == 11 and all(parts)
    assert probe.make_folds(names, 4) == probe.make_folds(names[::-1], 4) != probe.make_folds(names, 4, seed=1)
    with pytest.raises(ValueError, match="at least three"):
        probe.make_folds(names[:2])


def test_a_ratio_is_paired():
    g = torch.Generator().manual_seed(0)
    hard = torch.rand(30, generator=g, dtype=torch.float64) * 100  # tasks differ by far more than methods
    same, worse = probe.error_ratio(hard, hard), probe.error_ratio(1.1 * hard, hard)
    assert (same.value, same.low, same.high) == (1.0, 1.0, 1.0)
    assert worse.low == pytest.approx(1.1) == worse.high
    mean = probe.mean_squared_error(hard, torch.ones(30))
    assert mean.value == pytest.approx(float(hard.mean())) and mean.high - mean.low > 10
    noisy = probe.error_ratio(hard * (1 + 0.2 * torch.randn(30, generator=g, dtype=torch.float64)), hard)
    assert noisy.low < noisy.value < noisy.high < noisy.low + 0.3


@pytest.mark.parametrize(
    ("low", "high", "want"),
    [(0.99, 1.01, True), (0.97, 1.01, None), (1.03, 1.2, False), (0.5, 0.97, False), (1.01, 1.03, None)],
)
def test_equivalence_within_two_per_cent(low, high, want):
    assert probe.is_equivalent(Interval(1.0, low, high, 9)) is want
    assert probe.is_equivalent(Interval(1.0, None, None, 1)) is None


def loop_quotient(above, below, level, draws, seed):
    """Sums over resampled groups, one resample at a time."""
    rows = bootstrap.resample_scenes(len(above), draws, seed=seed).tolist()
    drawn = [sum(above[i] for i in row) / sum(below[i] for i in row) for row in rows]
    return sum(above) / sum(below), *np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])


@pytest.mark.parametrize("options", [{}, {"level": 0.6}, {"draws": 40}, {"seed": 3, "draws": 60}])
def test_intervals_of_errors_resample_groups(options):
    g = np.random.default_rng(1)
    ours, theirs, counts = g.uniform(1, 9, 6), g.uniform(1, 9, 6), g.integers(1, 20, 6).astype(float)
    t = {"level": 0.95, "draws": 2000, "seed": 0} | options
    mean = probe.mean_squared_error(torch.from_numpy(ours), torch.from_numpy(counts), **options)
    assert mean[:3] == pytest.approx(loop_quotient(ours, counts, **t)) and mean.n == 6
    ratio = probe.error_ratio(torch.from_numpy(ours), torch.from_numpy(theirs), **options)
    assert ratio[:3] == pytest.approx(loop_quotient(ours, theirs, **t))


def test_groups_that_say_nothing_are_left_out():
    squares, counts = torch.tensor([4.0, 0.0, 6.0, 0.0]), torch.tensor([2.0, 0.0, 2.0, 1.0])
    found = probe.mean_squared_error(squares, counts)
    assert found.value == 2 and found.n == 3, "no error is a number, no sample is none"
    found = probe.error_ratio(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([2.0, 2.0, 0.0]))
    assert found.value == 0.25 and found.n == 2
    assert probe.error_ratio(torch.ones(2), torch.zeros(2)).value is None, "nothing to divide by"
    assert probe.mean_squared_error(squares[:0], counts[:0]).n == 0
    for call in (probe.mean_squared_error, probe.error_ratio):
        with pytest.raises(ValueError, match=call.__name__):
            call(squares, counts[1:])


def test_equivalence_ends_at_the_margin():
    at = lambda low, high, **options: probe.is_equivalent(Interval(1.0, low, high, 9), **options)  # noqa: E731
    assert at(0.98, 1.0) is None and at(1.0, 1.02) is None, "the whole interval lies strictly within"
    assert at(0.9, 0.98) is None and at(1.02, 1.1) is None, "or strictly beyond"
    assert (
        at(0.9, 1.1, margin=0.2) is True and at(1.1, 1.2, margin=0.05) is False and at(0.8, 0.9, margin=0.05) is False
    )
    assert at(0.9, 1.1) is None and at(None, 1.0) is None and at(1.0, None) is None


def test_the_next_part_chooses_and_the_others_teach():
    for n, groups in ((5, 12), (3, 3), (4, 4)):
        names = [f"g{k:02}" for k in range(groups)]
        folds = probe.make_folds(names, n) if n != 5 else probe.make_folds(names)
        assert len(folds) == n
        for k, fold in enumerate(folds):
            assert fold.choose == folds[(k + 1) % n].test
            assert set(fold.train) == set(names) - set(fold.test) - set(fold.choose)
            assert max(len(fold.test), len(fold.choose)) <= -(-groups // n)
    assert len(probe.make_folds(names[:3], 9)) == 3, "no more parts than groups"
    tests = [probe.make_folds([f"g{k:02}" for k in range(12)], seed=s)[0].test for s in range(4)]
    assert len(set(tests)) > 1 and all(list(t) != ["g00", "g05", "g10"] for t in tests), "shuffled"
    for wrong in ((["a", "b", "c"], 2), (["a", "a", "b"], 3)):
        with pytest.raises(ValueError, match=r"folds: found 2 parts of \d groups, expected at least three"):
            probe.make_folds(*wrong)


def test_moments_are_numpys_and_keep_leading_dimensions():
    g = torch.Generator().manual_seed(0)
    x, y = (torch.randn(2, 3, 15, k, generator=g) * 3 + 2 for k in (4, 2))
    found = probe.compute_moments(x, y)
    assert found.n.shape == (2, 3) and {v.dtype for v in vars(found).values()} == {torch.float64}
    for b in range(2):
        for c in range(3):
            a, t = x[b, c].double().numpy(), y[b, c].double().numpy()
            da, dt = a - a.mean(0), t - t.mean(0)
            expected = (15, a.mean(0), t.mean(0), da.T @ da, da.T @ dt, (dt**2).sum(0))
            for name, want in zip(("n", "x", "y", "xx", "xy", "yy"), expected, strict=True):
                np.testing.assert_allclose(getattr(found, name)[b, c].numpy(), want, rtol=1e-9, atol=1e-9)
    linear = probe.solve_ridge(found, PENALTIES)
    assert linear.weight.shape == (2, 3, 3, 4, 2) and probe.predict_targets(linear, x).shape == (2, 3, 3, 15, 2)
    alone = probe.predict_targets(probe.solve_ridge(probe.compute_moments(x[1, 2], y[1, 2]), PENALTIES), x[1, 2])
    torch.testing.assert_close(probe.predict_targets(linear, x)[1, 2], alone)


def test_joined_moments_keep_leading_dimensions_and_take_empty_sides():
    g = torch.Generator().manual_seed(0)
    x, y = (torch.randn(2, 12, k, generator=g, dtype=torch.float64) + 1 for k in (3, 2))
    whole, parts = (
        probe.compute_moments(x, y),
        [probe.compute_moments(x[:, a:b], y[:, a:b]) for a, b in ((0, 4), (4, 12), (12, 12))],
    )
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        joined = probe.join_moments(probe.join_moments(parts[order[0]], parts[order[1]]), parts[order[2]])
        for name in ("n", "x", "y", "xx", "xy", "yy"):
            torch.testing.assert_close(getattr(joined, name), getattr(whole, name))
    with pytest.raises(ValueError, match="join_moments"):
        probe.join_moments(whole, probe.select_features(whole, torch.tensor([0])))


def test_a_stream_takes_only_what_it_was_made_for_and_keeps_no_gradient():
    stream = probe.MomentStream(3, 2)
    x, y = torch.ones(4, 3, requires_grad=True), torch.ones(4, 2)
    stream.add(x, y)
    assert not stream.moments.x.requires_grad and float(stream.moments.n) == 4
    for wrong in ((x[:, :2], y), (x, y[:, :1]), (x[0], y[0])):
        with pytest.raises(ValueError, match=r"MomentStream\.add"):
            stream.add(*wrong)
    with pytest.raises(ValueError, match=r"compute_moments: y has shape \(3, 2\)"):
        probe.compute_moments(x, y[:3])
    with pytest.raises(ValueError, match="expected the same samples"):
        probe.compute_moments(x.expand(2, 4, 3), y)


def test_a_penalty_of_nothing_is_the_least_and_shapes_are_asked():
    x, y = samples(n=30, f=4)
    twice = torch.cat((x, x[:, :1]), 1)  # cannot be solved without a penalty
    of = probe.compute_moments(twice, y)
    none, least = probe.solve_ridge(of, torch.tensor([0.0, 1e-12, 1e-9]).double()).weight[:2]
    assert torch.equal(none, least) and none.isfinite().all()
    plain = probe.predict_targets(probe.solve_ridge(probe.compute_moments(x, y), torch.zeros(1).double()), x)[0]
    torch.testing.assert_close(plain, by_least_squares(x, y, 0.0), rtol=0, atol=1e-6)
    assert probe.solve_ridge(of, torch.zeros(0)).weight.shape == (0, 5, 3)
    for wrong in (torch.tensor(1.0), torch.ones(2, 4), torch.ones(2, 5, 1)):
        with pytest.raises(ValueError, match=r"ridge: penalty has shape .*expected \(P,\) or \(P, 5\)"):
            probe.solve_ridge(of, wrong)
    with pytest.raises(ValueError, match="predict_targets"):
        probe.predict_targets(probe.solve_ridge(of, PENALTIES), x)


def test_a_feature_varies_from_a_billionth_of_its_mean():
    for spread, used in ((3e-9, True), (3e-10, False)):
        numbers = 40, [1.0], [0.0], [[40 * spread**2]], [[40 * spread]], [40.0]  # of -1, 1, -1, ... times the spread
        of = probe.SampleMoments(*(torch.tensor(v, dtype=torch.float64) for v in numbers))
        assert bool(probe.solve_ridge(of, PENALTIES).weight.any()) is used
    assert probe.solve_ridge(of.replace(x=torch.zeros(1).double()), PENALTIES).weight.any(), (
        "of mean 0 any spread is one"
    )


def test_ridge_is_scikit_learns():
    linear_model = pytest.importorskip("sklearn.linear_model")
    x, y = samples()
    ours = probe.predict_targets(probe.solve_ridge(probe.compute_moments(x, y), PENALTIES), x)
    scaled = ((x - x.mean(0)) / x.std(0, correction=0)).numpy()
    for k, penalty in enumerate(PENALTIES.tolist()):
        theirs = linear_model.Ridge(alpha=penalty * len(x)).fit(scaled, y.numpy()).predict(scaled)
        assert np.abs(theirs - ours[k].numpy()).max() < 1e-6


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
    assert many < few + 4e6
    assert few < 5 * F * F * 8 + 5 * n * F * 8 + 20e6
