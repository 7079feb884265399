"""Monotone functions: against scikit-learn, numpy, scipy and plain loops."""

import itertools
import random

import numpy as np
import pytest
import torch

from dhtorch.calibration import monotone


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


# ---------------------------------------------------------------------------------------------------- isotonic


def brute_isotonic(y, w):
    """max over starts of min over ends of the weighted means that contain i."""
    n = len(y)

    def mean(j, k):
        return sum(a * b for a, b in zip(y[j:k], w[j:k], strict=True)) / sum(w[j:k])

    return [max(min(mean(j, k) for k in range(i + 1, n + 1)) for j in range(i + 1)) for i in range(n)]


@pytest.mark.parametrize("n", [0, 1, 2, 3, 12, 30])
def test_pool_adjacent_violators_equals_the_min_max_formula(n):
    draw = random.Random(n)
    for kind in range(4):
        y = [draw.choice([0.0, 1.0]) if kind % 2 else draw.gauss(0.1 * i, 1) for i in range(n)]
        w = [1.0] * n if kind < 2 else [draw.uniform(0.1, 3) for _ in range(n)]
        found = monotone._pool_adjacent_violators(torch.tensor(y), torch.tensor(w)).tolist()
        assert found == pytest.approx(brute_isotonic(torch.tensor(y).tolist(), torch.tensor(w).tolist()), abs=1e-6)


def test_a_table_runs_through_the_middles_of_the_blocks():
    x = torch.tensor([0.1, 0.2, 0.3, 0.5, 0.7, 0.9])
    y = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 1.0])  # blocks: .1 .2 at 0, .3 .5 at ½, .7 .9 at 1
    table = monotone.fit_isotonic(x, y)
    at = torch.tensor([0.15, 0.4, 0.8], dtype=torch.float64)
    assert table(at).tolist() == pytest.approx([0, 0.5, 1], abs=1.1 * monotone._MAX_END_RISE)
    assert float(table(torch.tensor(0.275))) == pytest.approx(0.25, abs=1.1 * monotone._MAX_END_RISE)
    assert table(torch.tensor([-1.0, 0.1, 0.9, 7.0])).tolist() == pytest.approx([0, 0, 1, 1])
    falling = monotone.fit_isotonic(x, 1 - y, rising=False)
    assert falling(at).tolist() == pytest.approx([1, 0.5, 0], abs=1.1 * monotone._MAX_END_RISE)


def test_a_table_keeps_every_order_within_its_range():
    x = uniform(400)
    for y in ((uniform(400, seed=1) < x).double(), (uniform(400, seed=1) < 0.5).double()):
        table = monotone.fit_isotonic(x, y, min_share=0.05, ends=(0, 1))
        values = table(torch.linspace(0, 1, 5000, dtype=torch.float64))
        assert (values.diff() > 0).all() or table.y.unique().numel() == 1
        assert values[0] >= 0 and values[-1] <= 1
        short = table(torch.linspace(0, 1, 200))
        assert short.dtype == torch.float32 and (short.diff() >= 0).all()


def test_blocks_are_joined_until_they_weigh_enough():
    x, y = torch.arange(100.0), (torch.arange(100) >= 99).double()  # one lucky point at the top
    bold, careful = monotone.fit_isotonic(x, y), monotone.fit_isotonic(x, y, min_share=0.1)
    assert float(bold(torch.tensor(99.0))) == 1
    assert float(careful(torch.tensor(99.0))) < 0.2
    g = uniform(300, seed=3)
    joined = monotone.fit_isotonic(g, (uniform(300, seed=4) < g).double(), min_share=0.1)
    assert joined.x.numel() <= 10 + 2


def test_equal_arguments_share_a_value_and_weights_count():
    x = torch.tensor([0.0, 0.0, 1.0, 1.0])
    table = monotone.fit_isotonic(x, torch.tensor([0.0, 1.0, 1.0, 1.0]), torch.tensor([3.0, 1.0, 1.0, 0.0]))
    assert table(torch.tensor([0.0, 1.0])).tolist() == pytest.approx([0.25, 1.0])
    with pytest.raises(ValueError, match="isotonic: found no point"):
        monotone.fit_isotonic(x, x, torch.zeros(4))
    with pytest.raises(ValueError, match="isotonic: y has shape"):
        monotone.fit_isotonic(x, x[1:])


def test_one_value_is_a_constant():
    table = monotone.fit_isotonic(torch.tensor([0.4]), torch.tensor([0.7]))
    assert table(torch.tensor([0.0, 0.4, 9.0])).tolist() == pytest.approx([0.7] * 3)


# ---------------------------------------------------------------------------------------------------- sigmoid


def test_platt_minimises_the_log_loss():
    p, w = uniform(500), uniform(500, seed=1)
    good = uniform(500, seed=2) < p**2
    found = monotone.fit_platt(p, good, w)

    def loss(slope, offset):
        claimed = torch.sigmoid(slope * torch.logit(p, eps=1e-6) + offset)
        return float(torch.nn.functional.binary_cross_entropy(claimed, good.double(), weight=w))

    best = loss(float(found.slope), float(found.offset))
    for da, db in itertools.product((-0.01, 0, 0.01), repeat=2):
        assert loss(float(found.slope) + da, float(found.offset) + db) >= best - 1e-9
    assert loss(1, 0) > best + 0.01
    assert found(p).tolist() == pytest.approx(
        torch.sigmoid(found.slope * torch.logit(p, eps=1e-6) + found.offset).tolist(), abs=1e-12
    )


def test_platt_survives_separable_one_sided_and_missing_data():
    p = torch.linspace(0, 1, 50, dtype=torch.float64)
    for good in (p > 0.5, p > 2, p >= 0):
        found = monotone.fit_platt(p, good)
        assert torch.isfinite(found.slope) and torch.isfinite(found.offset)
        assert found(p).isfinite().all()
    nothing = monotone.fit_platt(torch.zeros(0), torch.zeros(0).bool())
    assert (float(nothing.slope), float(nothing.offset)) == (1, 0)


# ---------------------------------------------------------------------------------------------------- references


@pytest.mark.parametrize("sign", [1, -1])
def test_a_table_is_numpys_interpolation(sign):
    x, y = uniform(9).sort().values, sign * uniform(9, seed=1).sort().values
    table, at = monotone.MonotoneTable(x, y), torch.linspace(-0.5, 1.5, 81, dtype=torch.float64)
    at = torch.cat((at, x))
    assert table(at).tolist() == pytest.approx(np.interp(at, x, y).tolist(), abs=1e-12)
    assert table(at.view(2, 1, 45)).shape == (2, 1, 45) and torch.equal(table(at[::2]), table(at)[::2])
    assert table(torch.tensor([0.3, torch.nan]).double()).isnan().tolist() == [False, True]
    assert table(at.float()).dtype == torch.float32
    inside = (x[:-1] + x.diff() / 3).requires_grad_()
    table(inside).sum().backward()
    torch.testing.assert_close(inside.grad, y.diff() / x.diff())


def test_corners_that_a_short_float_cannot_tell_apart_are_a_step():
    table = monotone.MonotoneTable(
        torch.tensor([0.0, 1.0, 1.0 + 1e-12, 2.0]).double(), torch.tensor([0.0, 1.0, 3.0, 4.0])
    )
    found = table(torch.tensor([0.5, 1.0, 1.5]))
    assert found[[0, 2]].tolist() == [0.5, 3.5] and 1 <= float(found[1]) <= 3


def test_a_table_of_one_corner_passes_nan_on():
    table = monotone.MonotoneTable(torch.tensor([0.4]), torch.tensor([0.7]))
    found = table(torch.tensor([[0.1, torch.nan, 9.0]]))
    assert found.isnan().tolist() == [[False, True, False]] and found[0, [0, 2]].tolist() == pytest.approx([0.7] * 2)


def test_a_sigmoid_is_scipys_of_the_logit():
    special = pytest.importorskip("scipy.special")
    sigmoid = monotone.Sigmoid(torch.tensor(1.7), torch.tensor(-0.6))
    p = torch.tensor([-1.0, 0.0, 1e-7, 1e-6, 0.2, 0.5, 0.9, 1 - 1e-6, 1.0, 3.0], dtype=torch.float64)
    expected = special.expit(1.7 * special.logit(p.clamp(1e-6, 1 - 1e-6).numpy()) - 0.6)
    assert sigmoid(p).tolist() == pytest.approx(expected.tolist(), abs=1e-7)
    assert sigmoid(p.float()).dtype == torch.float32


def loop_isotonic(x, y, weight, rising, min_share, ends):
    """Corners of the table: the blocks, joined while they are light, their middles, the tilted ends."""
    at = sorted({a for a, w in zip(x, weight, strict=True) if w})
    mass = [sum(w for a, w in zip(x, weight, strict=True) if a == b) for b in at]
    mean = [
        sum(w * v for a, v, w in zip(x, y, weight, strict=True) if a == b) / m for b, m in zip(at, mass, strict=True)
    ]
    sign = 1 if rising else -1
    fitted = [sign * v for v in brute_isotonic([sign * v for v in mean], mass)]
    blocks = []  # weight, weight · x, weight · y
    for key, group in itertools.groupby(range(len(at)), key=lambda k: round(fitted[k], 12)):
        rows = list(group)
        heavy = sum(mass[k] for k in rows)
        block = [heavy, sum(mass[k] * at[k] for k in rows), heavy * key]
        if blocks and blocks[-1][0] < min_share * sum(mass):
            blocks[-1] = [a + b for a, b in zip(blocks[-1], block, strict=True)]
        else:
            blocks.append(block)
    if len(blocks) > 1 and blocks[-1][0] < min_share * sum(mass):
        last = blocks.pop()
        blocks[-1] = [a + b for a, b in zip(blocks[-1], last, strict=True)]
    middle, value = [b[1] / b[0] for b in blocks], [b[2] / b[0] for b in blocks]
    low, high = ends or (at[0], at[-1])
    if len(blocks) == 1:
        return middle, value
    tilt = lambda step: max(-1e-3, min(1e-3, step / 4))  # noqa: E731
    xs, ys = list(middle), list(value)
    if low < middle[0]:
        xs, ys = [low, *xs], [value[0], value[0] + tilt(value[1] - value[0]), *ys[1:]]
    if high > middle[-1]:
        xs, ys = [*xs, high], [*ys[:-1], value[-1] - tilt(value[-1] - value[-2]), value[-1]]
    return xs, ys


@pytest.mark.parametrize("rising", [True, False])
@pytest.mark.parametrize(
    "options", [{}, {"min_share": 0.15}, {"ends": (-1.0, 2.0)}, {"min_share": 0.3, "ends": (0.0, 1.0)}]
)
@pytest.mark.parametrize("n", [4, 25, 80])
def test_a_table_runs_straight_from_the_middle_of_a_block_to_the_next(n, options, rising):
    g = np.random.default_rng(n)
    x = g.integers(1, 20, n) / 20
    y = np.where(g.uniform(size=n) < x, 1.0, 0.0) if n == 80 else x + g.normal(0, 0.2, n)
    y = y if rising else -y
    weight = g.integers(0, 4, n) / 2
    weight[0] = 1.0
    found = monotone.fit_isotonic(*map(torch.from_numpy, (x, y, weight)), rising=rising, **options)
    asked = {"min_share": 0.0, "ends": None, **options}
    xs, ys = loop_isotonic(x.tolist(), y.tolist(), weight.tolist(), rising, **asked)
    assert found.x.tolist() == pytest.approx(xs, abs=1e-9) and found.y.tolist() == pytest.approx(ys, abs=1e-9)


def test_steps_smaller_than_four_tilts_are_tilted_by_a_quarter():
    x = torch.tensor([0.0, 0.2, 0.6, 1.0])
    table = monotone.fit_isotonic(x, torch.tensor([0.5, 0.5, 0.502, 0.502]).double())
    assert table.x.tolist() == pytest.approx([0, 0.1, 0.8, 1.0])
    assert table.y.tolist() == pytest.approx([0.5, 0.5005, 0.5015, 0.502])


def test_a_block_that_weighs_just_enough_stays():
    x, y = torch.arange(4.0), torch.tensor([0.0, 1.0, 2.0, 3.0])
    assert monotone.fit_isotonic(x, y, min_share=0.25).y.tolist() == [0, 1, 2, 3]
    assert monotone.fit_isotonic(x, y, min_share=0.26).y.tolist() == pytest.approx([0.5, 0.5 + 1e-3, 2.5 - 1e-3, 2.5])


@pytest.mark.parametrize("seed", range(3))
def test_platt_is_the_minimum_that_scipy_finds(seed):
    """Of the weighted mean log loss and a pull of 1e-6 / 2 towards the identity; also of data that can be separated."""
    optimize, special = pytest.importorskip("scipy.optimize"), pytest.importorskip("scipy.special")
    p, w = uniform(60, seed=seed), uniform(60, seed=9)
    good = p > 0.6 if seed == 2 else uniform(60, seed=seed + 20) < p**2
    feature, sign = special.logit(p.numpy()), np.where(good, 1.0, -1.0)
    share = w.numpy() / w.numpy().sum()

    def loss(theta):
        claimed = -sign * (theta[0] * feature + theta[1])
        return (share * np.logaddexp(0, claimed)).sum() + 0.5e-6 * ((theta[0] - 1) ** 2 + theta[1] ** 2)

    found = monotone.fit_platt(p, good, w)
    best = optimize.minimize(
        loss, [1.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-15, "maxiter": 4000}
    )
    tolerance = 2e-3 if seed == 2 else 1e-5
    assert [float(found.slope), float(found.offset)] == pytest.approx(best.x.tolist(), rel=tolerance, abs=1e-5)
    scaled = monotone.fit_platt(p, good, 1000 * w)
    assert float(scaled.slope) == pytest.approx(float(found.slope), rel=1e-9), "weights are shares"


def test_platt_takes_as_many_steps_as_asked():
    p, good = uniform(200), uniform(200, seed=2) < uniform(200) ** 3
    none, one, all_ = (monotone.fit_platt(p, good, **options) for options in ({"steps": 0}, {"steps": 1}, {}))
    assert (float(none.slope), float(none.offset)) == (1, 0)
    assert float(one.offset) != 0 and float(one.offset) != pytest.approx(float(all_.offset), rel=1e-3)
    with pytest.raises(ValueError, match="platt: "):
        monotone.fit_platt(p, good[1:])
    with pytest.raises(ValueError, match="pool_adjacent_violators: "):
        monotone._pool_adjacent_violators(p, p[1:])


def test_pool_adjacent_violators_equals_scikit_learn():
    sklearn = pytest.importorskip("sklearn.isotonic")
    y, w = uniform(3000) + torch.linspace(0, 1, 3000, dtype=torch.float64), uniform(3000, seed=1) + 0.01
    expected = sklearn.isotonic_regression(y.numpy(), sample_weight=w.numpy())
    assert monotone._pool_adjacent_violators(y, w).tolist() == pytest.approx(expected.tolist(), abs=1e-12)


def test_platt_equals_scikit_learn():
    linear = pytest.importorskip("sklearn.linear_model")
    p, w = uniform(800), uniform(800, seed=1)
    good = uniform(800, seed=2) < p**2
    model = linear.LogisticRegression(C=1e8, tol=1e-10, max_iter=1000)
    model.fit(torch.logit(p, eps=1e-6)[:, None].numpy(), good.numpy(), sample_weight=w.numpy())
    found = monotone.fit_platt(p, good, w)
    assert [float(found.slope), float(found.offset)] == pytest.approx(
        [model.coef_[0, 0], model.intercept_[0]], abs=1e-3
    )
