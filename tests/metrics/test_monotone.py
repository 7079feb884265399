"""Monotone functions: against scikit-learn, numpy, scipy and plain loops."""

import itertools

import numpy as np
import pytest
import torch

from dhtorch.metrics import monotone


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def plain_isotonic(x, y, weight, rising, min_share, ends):
    """Corners of the table: the blocks, joined while they are light, their middles, the tilted ends."""
    regression = pytest.importorskip("sklearn.isotonic").isotonic_regression
    at = sorted({a for a, w in zip(x, weight, strict=True) if w})
    mass = [sum(w for a, w in zip(x, weight, strict=True) if a == b) for b in at]
    rows = list(zip(x, y, weight, strict=True))
    mean = [sum(w * v for a, v, w in rows if a == b) / m for b, m in zip(at, mass, strict=True)]
    fitted = regression(mean, sample_weight=mass, increasing=rising)
    blocks = []  # weight, weight · x, weight · y
    for key, group in itertools.groupby(range(len(at)), key=lambda k: round(fitted[k], 12)):
        members = list(group)
        heavy = sum(mass[k] for k in members)
        block = [heavy, sum(mass[k] * at[k] for k in members), heavy * key]
        light = blocks and blocks[-1][0] < min_share * sum(mass)
        blocks.append([a + b for a, b in zip(blocks.pop(), block, strict=True)] if light else block)
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
@pytest.mark.parametrize("n", [1, 4, 25, 80])
def test_a_table_runs_straight_from_the_middle_of_a_block_to_the_next(n, options, rising):
    g = np.random.default_rng(n)
    x = g.integers(1, 20, n) / 20
    y = np.where(g.uniform(size=n) < x, 1.0, 0.0) if n == 80 else x + g.normal(0, 0.2, n)
    y, weight = y if rising else -y, g.integers(0, 4, n) / 2
    weight[0] = 1.0
    found = monotone.fit_isotonic(*map(torch.from_numpy, (x, y, weight)), rising=rising, **options)
    options = {"min_share": 0.0, "ends": None, **options}
    xs, ys = plain_isotonic(x.tolist(), y.tolist(), weight.tolist(), rising, **options)
    assert found.x.tolist() == pytest.approx(xs, abs=1e-9) and found.y.tolist() == pytest.approx(ys, abs=1e-9)
    values = found(torch.linspace(*(options["ends"] or (0, 1)), 999, dtype=torch.float64)).diff()
    assert ((values if rising else -values) >= 0).all()


@pytest.mark.parametrize(
    ("x", "y", "options", "corners"),
    [
        # steps smaller than four tilts are tilted by a quarter; a block that weighs just enough stays
        ([0.0, 0.2, 0.6, 1.0], [0.5, 0.5, 0.502, 0.502], {}, ([0, 0.1, 0.8, 1.0], [0.5, 0.5005, 0.5015, 0.502])),
        ([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0], {"min_share": 0.25}, ([0, 1, 2, 3], [0, 1, 2, 3])),
        ([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0], {"min_share": 0.26}, ([0, 0.5, 2.5, 3], [0.5, 0.501, 2.499, 2.5])),
        ([0.4], [0.7], {}, ([0.4], [0.7])),
        ([0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0], {"weight": torch.tensor([3.0, 1, 1, 0])}, ([0, 1], [0.25, 1])),
    ],
)  # fmt: skip
def test_corners_by_hand(x, y, options, corners):
    table = monotone.fit_isotonic(torch.tensor(x), torch.tensor(y).double(), **options)
    assert (table.x.tolist(), table.y.tolist()) == (pytest.approx(corners[0]), pytest.approx(corners[1]))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_table_is_numpys_interpolation(sign):
    x, y = uniform(9).sort().values, sign * uniform(9, seed=1).sort().values
    table, at = monotone.MonotoneTable(x, y), torch.cat((torch.linspace(-0.5, 1.5, 81, dtype=torch.float64), x))
    assert table(at).tolist() == pytest.approx(np.interp(at, x, y).tolist(), abs=1e-12)
    assert table(at.view(2, 1, 45)).shape == (2, 1, 45) and torch.equal(table(at[::2]), table(at)[::2])
    assert table(torch.tensor([0.3, torch.nan]).double()).isnan().tolist() == [False, True]
    inside = (x[:-1] + x.diff() / 3).requires_grad_()
    table(inside).sum().backward()
    torch.testing.assert_close(inside.grad, y.diff() / x.diff())


def test_tables_of_one_corner_and_corners_that_a_short_float_does_not_distinguish():
    one = monotone.MonotoneTable(torch.tensor([0.4]), torch.tensor([0.7]))(torch.tensor([[0.1, torch.nan, 9.0]]))
    assert one.isnan().tolist() == [[False, True, False]] and one[0, [0, 2]].tolist() == pytest.approx([0.7] * 2)
    step = monotone.MonotoneTable(torch.tensor([0.0, 1.0, 1.0 + 1e-12, 2.0]).double(), torch.tensor([0.0, 1, 3, 4]))
    found = step(torch.tensor([0.5, 1.0, 1.5]))
    assert found.dtype == torch.float32 and found[[0, 2]].tolist() == [0.5, 3.5] and 1 <= float(found[1]) <= 3


def test_a_sigmoid_is_scipys_of_the_logit():
    special = pytest.importorskip("scipy.special")
    sigmoid = monotone.Sigmoid(torch.tensor(1.7), torch.tensor(-0.6))
    p = torch.tensor([-1.0, 0.0, 1e-7, 1e-6, 0.2, 0.5, 0.9, 1 - 1e-6, 1.0, 3.0], dtype=torch.float64)
    expected = special.expit(1.7 * special.logit(p.clamp(1e-6, 1 - 1e-6).numpy()) - 0.6)
    assert sigmoid(p).tolist() == pytest.approx(expected.tolist(), abs=1e-7)
    assert sigmoid(p.float()).dtype == torch.float32


@pytest.mark.parametrize("good", ["drawn", "drawn again", "separable", "all", "none"])
def test_platt_is_the_minimum_that_scipy_finds(good):
    """Of the weighted mean log loss and a ridge of 1e-6 / 2 towards the identity."""
    optimize, special = pytest.importorskip("scipy.optimize"), pytest.importorskip("scipy.special")
    p, w = uniform(60, seed=len(good)), uniform(60, seed=9)
    drawn = uniform(60, seed=20) < p**2
    good = {"separable": p > 0.6, "all": p >= 0, "none": p > 2}.get(good, drawn)
    feature, sign = special.logit(p.clamp(1e-6, 1 - 1e-6).numpy()), np.where(good, 1.0, -1.0)
    share = w.numpy() / w.numpy().sum()

    def loss(theta):
        claimed = -sign * (theta[0] * feature + theta[1])
        return (share * np.logaddexp(0, claimed)).sum() + 0.5e-6 * ((theta[0] - 1) ** 2 + theta[1] ** 2)

    found = monotone.fit_platt(p, good, 1000 * w)
    options = {"xatol": 1e-9, "fatol": 1e-15, "maxiter": 4000}
    best = optimize.minimize(loss, [1.0, 0.0], method="Nelder-Mead", options=options)
    tolerance = 1e-5 if good is drawn else 5e-3
    assert [float(found.slope), float(found.offset)] == pytest.approx(best.x.tolist(), rel=tolerance, abs=1e-5)


def test_platt_takes_as_many_steps_as_stated_and_is_the_identity_of_nothing():
    p, good = uniform(200), uniform(200, seed=2) < uniform(200) ** 3
    none, one, many = (monotone.fit_platt(p, good, **options) for options in ({"steps": 0}, {"steps": 1}, {}))
    nothing = monotone.fit_platt(torch.zeros(0), torch.zeros(0).bool())
    assert [(float(s.slope), float(s.offset)) for s in (none, nothing)] == [(1, 0)] * 2
    assert float(one.offset) != 0 and float(one.offset) != pytest.approx(float(many.offset), rel=1e-3)


@pytest.mark.parametrize(
    ("fit", "args", "message"),
    [
        (monotone.fit_isotonic, (torch.ones(4), torch.ones(4), torch.zeros(4)), "isotonic: found no point"),
        (monotone.fit_isotonic, (torch.ones(4), torch.ones(3)), "isotonic: y has shape"),
        (monotone.fit_platt, (torch.ones(4), torch.ones(3)), "platt: good has shape"),
    ],
)
def test_wrong_points_raise(fit, args, message):
    with pytest.raises(ValueError, match=message):
        fit(*args)
