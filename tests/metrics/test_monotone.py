"""Monotone functions: by hand, against numpy and scipy; many numbers at once: test_stored_answers.py."""

import numpy as np
import pytest
import torch

from dhtorch.metrics import monotone


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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
