"""Correlation along spiral arms: known shifts of a signal, of a moved picture and of a scaled one."""

import math

import pytest
import torch

from dhtorch.experiments.negative import helix_correlation as experiment
from dhtorch.experiments.negative.helix_correlation import correlate_windows, sample_arm

HW = (160, 200)
CENTRE = torch.tensor([99.5, 79.5])


def waves(at, seed=0, n=40, shortest=9.0):
    """A smooth random function of places (…, d) with values in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.randn(n, at.shape[-1], generator=generator)
    turn = (
        turn
        / turn.norm(dim=-1, keepdim=True)
        * 2
        * math.pi
        / (shortest * (1 + 4 * torch.rand(n, 1, generator=generator)))
    )
    phase = 2 * math.pi * torch.rand(n, generator=generator)
    return 0.5 + (at @ turn.T.to(at) + phase).sin().sum(-1) / (2 * math.sqrt(n) * 2)


def picture(move=lambda uv: uv):
    v, u = torch.meshgrid(torch.arange(float(HW[0])), torch.arange(float(HW[1])), indexing="ij")
    return waves(move(torch.stack((u, v), -1)), shortest=20.0)[None, None]


def signals(*shifts, length=400):
    x = torch.arange(length).double()[:, None]
    return torch.stack([waves(x - shift) for shift in shifts])


def test_what_cannot_be_found_is_not_valid():
    at = torch.tensor([[20, 200, 395]])
    assert correlate_windows(signals(0), signals(0), at, at).valid.tolist() == [[False, True, False]], (
        "windows leave the arm"
    )
    flat = torch.full((1, 400), 0.3).double()
    for first, second in ((flat, signals(0)), (signals(0), flat)):
        found = correlate_windows(first, second, at, at)
        assert not bool(found.valid.any()) and not bool(found.lag.any()) and not bool(found.peak.any())
    middle = torch.tensor([[200]])
    assert not bool(correlate_windows(signals(0), signals(20.0), middle, middle, max_lag=15, min_peak=0.9).valid.any())


def test_gradient_moves_the_shift():
    first, at = signals(0), torch.tensor([[150, 250]])
    shift = torch.tensor(4.3, dtype=torch.float64, requires_grad=True)
    x = torch.arange(400).double()[:, None]
    correlate_windows(first, waves(x - shift)[None], at, at).lag.sum().backward()
    assert abs(float(shift.grad) - 2) < 0.2, "each of the two lags follows the shift"


def test_an_arm_reads_between_pixels():
    ramp = torch.arange(30.0).expand(20, 30)[None, None] / 30 + torch.arange(20.0)[:, None] / 50
    arm = torch.tensor([[3.25, 4.5], [12.0, 7.75], [29.0, 19.0]])
    expected = arm[:, 0] / 30 + arm[:, 1] / 50
    torch.testing.assert_close(sample_arm(ramp, arm, blur_px=0)[0], expected)
    torch.testing.assert_close(sample_arm(ramp, arm[1:2])[0], expected[1:2])  # a blur leaves a ramp alone
    byte = (255 * ramp).round().clamp(0, 255).to(torch.uint8)
    torch.testing.assert_close(sample_arm(byte, arm[:2], blur_px=0)[0], expected[:2], atol=0.005, rtol=0)


def test_arms_are_curves_of_even_steps_half_a_turn_apart():
    first, second = experiment.make_arms(HW, 512, CENTRE)
    for arm in (first, second):
        steps = arm.uv.diff(dim=0).norm(dim=-1)
        assert float(steps.quantile(0.05)) > 0.97 and float(steps.max()) < 1.01
        torch.testing.assert_close(arm.tangent.norm(dim=-1), torch.ones(len(arm.uv)))
    k = torch.searchsorted(second.turn, first.turn[700:2500:300])
    out, back = first.uv[700:2500:300] - CENTRE, second.uv[k] - CENTRE
    cosine = (out * back).sum(-1) / out.norm(dim=-1) / back.norm(dim=-1)
    assert float(cosine.max()) < -0.99, "equal turns lie on opposite sides"


def test_round_arms_wind_in_circles():
    for arm in experiment.make_arms(HW, 512, CENTRE, round_arms=True):
        way = arm.uv[300:] - CENTRE
        radius = way.norm(dim=-1)
        assert float(radius.max()) == pytest.approx(79.5, abs=0.5) and bool((radius.diff() > 0).all())
        assert float(((way / radius[:, None]) * arm.tangent[300:]).sum(-1).abs().max()) < 0.1, "hardly any radial part"


def along(move):
    """Lags along a round arm where they were found, tangents and ways from the centre there."""
    arm, _ = experiment.make_arms(HW, 512, CENTRE, round_arms=True)
    at = torch.arange(100, len(arm.uv) - 100, 15)
    first, second = (sample_arm(p, arm.uv) for p in (picture(), picture(move)))
    found = correlate_windows(first, second, at[None], at[None], window=41, max_lag=15, min_peak=0.8)
    valid = found.valid[0]
    assert int(valid.sum()) > 40
    return found.lag[0, valid], arm.tangent[at[valid]], arm.uv[at[valid]] - CENTRE


@pytest.mark.parametrize(
    ("shift", "start", "options"), [(0.0, 0, {}), (7.3, 0, {}), (-11.6, 0, {}), (30.0, 25, {"max_lag": 10})]
)
def test_a_known_shift_is_found_between_steps(shift, start, options):
    at = torch.tensor([[80, 150, 200, 300]])
    found = correlate_windows(signals(0), 0.5 * signals(shift) + 0.2, at, at + start, **options)
    assert bool(found.valid.all()) and float(found.peak.min()) > 0.97
    torch.testing.assert_close(found.lag, torch.full((1, 4), shift - start).double(), atol=0.05, rtol=0)


def test_an_arm_sees_a_slide_and_a_turn_by_their_tangential_parts_and_no_growth():
    slide, turn = (
        torch.tensor([2.0, 1.0]),
        torch.tensor([[math.cos(0.04), math.sin(0.04)], [-math.sin(0.04), math.cos(0.04)]]),
    )
    lag, tangent, _ = along(lambda uv: uv - slide)
    wrong = (lag - tangent @ slide).abs() / slide.norm()
    assert float(wrong.median()) < 0.2 and float(wrong.quantile(0.8)) < 0.6
    for move, low, high in (
        (lambda uv: CENTRE + (uv - CENTRE) @ turn.T, 0.9, 1.1),
        (lambda uv: CENTRE + (uv - CENTRE) / 1.04, 0.0, 0.35),
    ):
        lag, _, way = along(move)
        assert float((0.04 * way.norm(dim=-1)).median()) > 1.5, "every point moves"
        assert low < float((lag.abs() / (0.04 * way.norm(dim=-1))).median()) < high
