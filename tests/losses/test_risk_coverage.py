"""Soft risk–coverage loss: equals the area of the metrics for hard ranks, orders answers by error when minimised."""

import pytest
import torch

from dhtorch.losses import risk_coverage_loss
from dhtorch.metrics.risk import risk_curve


def answers(n=60, sets=3):
    g = torch.Generator().manual_seed(5)
    return (torch.rand(sets, n, generator=g, dtype=torch.float64) for _ in range(2))


def test_hard_ranks_give_the_area_of_the_metrics():
    confidence, error = answers()
    area = torch.stack([risk_curve(e, c).mean() for c, e in zip(confidence, error, strict=True)])
    torch.testing.assert_close(risk_coverage_loss(confidence, error, temperature=1e-7), area)


def test_answers_that_do_not_count_change_nothing_and_get_no_gradient():
    confidence, error = answers()
    keep = torch.arange(60) < 40
    padded_c, padded_e = (torch.where(keep, x, float("nan")).requires_grad_() for x in (confidence, error))
    loss = risk_coverage_loss(padded_c, padded_e, keep.expand(3, -1))
    torch.testing.assert_close(loss, risk_coverage_loss(confidence[:, :40], error[:, :40]))
    loss.sum().backward()
    for x in (padded_c, padded_e):
        assert x.grad.isfinite().all() and (x.grad[:, 40:] == 0).all() and (x.grad[:, :40] != 0).all()


def test_an_error_above_1_counts_as_1_and_has_no_gradient():
    confidence, error = answers()
    error = (3 * error).requires_grad_()
    loss = risk_coverage_loss(confidence, error)
    torch.testing.assert_close(loss, risk_coverage_loss(confidence, error.clamp(max=1)))
    loss.sum().backward()
    assert torch.equal(error.grad > 0, error < 1)


def test_no_answers_cost_nothing():
    confidence, error = answers()
    loss = risk_coverage_loss(confidence.requires_grad_(), error, torch.zeros(3, 60, dtype=torch.bool))
    loss.sum().backward()
    assert (loss == 0).all() and (confidence.grad == 0).all()


def test_gradients():
    confidence, error = answers(n=7, sets=2)
    assert torch.autograd.gradcheck(risk_coverage_loss, (confidence.requires_grad_(), error.requires_grad_()))


def test_minimising_it_orders_answers_by_error():
    """From equal confidences: descent reaches the area of the best order, which is below half of where it began."""
    _, error = answers(n=40, sets=1)
    error = error**4
    confidence = torch.zeros_like(error).requires_grad_()
    optimiser = torch.optim.Adam([confidence], lr=0.05)
    for _ in range(200):
        optimiser.zero_grad()
        risk_coverage_loss(confidence, error).sum().backward()
        optimiser.step()
    reached, best = (float(risk_curve(error[0], c).mean()) for c in (confidence.detach()[0], -error[0]))
    assert reached < 1.01 * best < 0.5 * float(error.mean())


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan")])
def test_a_temperature_is_positive(temperature):
    with pytest.raises(ValueError, match="temperature is"):
        risk_coverage_loss(*answers(), temperature=temperature)
