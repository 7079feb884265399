"""The thin lens, against the lens equation and similar triangles in plain numbers."""

import math

import numpy as np
import pytest
import torch

from dhtorch.geometry.thin_lens import GAUSSIAN_OF_DISC, Lens, depth_of_spot, spot_diameter, spot_gain

F, STOP, PITCH, FOCUS = (0.05, 0.035), (2.0, 5.6), (5e-6, 2e-6), (2.0, 0.8)


def lens():
    return Lens(*(torch.tensor(x, dtype=torch.float64) for x in (F, STOP, PITCH)))


def spot_px(b, z, focus):
    """Images form at v(z), the sensor stands at v(focus); the cone of light behind the aperture is cut there."""
    v = {x: 1 / (1 / F[b] - 1 / x) for x in (z, focus)}
    return F[b] / STOP[b] * (v[focus] - v[z]) / v[z] / PITCH[b]


def test_the_spot_is_the_cut_through_the_cone_of_light():
    depth = torch.tensor([[0.3, 1.0, 2.0, 4.0, 300.0], [0.2, 0.8, 0.9, 2.0, 50.0]], dtype=torch.float64)
    spot = spot_diameter(lens(), depth, torch.tensor(FOCUS, dtype=torch.float64))
    want = [[spot_px(b, float(z), FOCUS[b]) for z in depth[b]] for b in range(2)]
    np.testing.assert_allclose(spot.numpy(), want, rtol=1e-9, atol=1e-9)
    assert spot[0, 0] < 0 < spot[0, 3], "positive beyond the focus"


def test_the_gain_is_pixels_of_spot_per_dioptre_out_of_focus():
    focus = torch.tensor([[0.5, 2.0, 7.0], [0.1, 0.8, 1e3]], dtype=torch.float64)
    gain = spot_gain(lens(), focus)
    for b in range(2):
        for k, s in enumerate(focus[b].tolist()):
            # A quarter of a dioptre nearer and farther, in front of the same sensor.
            near, far = (spot_px(b, 1 / (1 / s + d), s) for d in (0.25, -0.0005))
            assert float(gain[b, k]) == pytest.approx((far - near) / 0.2505, rel=1e-6)


def test_a_focus_at_the_focal_length_or_nearer_is_kept_a_nanometre_beyond_it():
    gain = spot_gain(lens(), torch.tensor([[0.05, 0.01], [0.035, 0.0351]], dtype=torch.float64))
    want = F[0] ** 2 / STOP[0] / (1e-9 * PITCH[0])
    np.testing.assert_allclose(gain[0].numpy(), [0.05 * want, 0.01 * want], rtol=1e-6)


def test_depth_and_spot_are_inverse_to_each_other():
    focus = torch.tensor(FOCUS, dtype=torch.float64)
    depth = torch.tensor([[0.3, 1.0, 2.0, 40.0], [0.2, 0.8, 0.9, 3.0]], dtype=torch.float64)
    spot = torch.tensor(
        [[spot_px(b, float(z), FOCUS[b]) for z in depth[b]] for b in range(2)], dtype=torch.float64, requires_grad=True
    )
    found = depth_of_spot(lens(), spot, focus)
    torch.testing.assert_close(found, depth, rtol=1e-9, atol=0)


def test_no_spot_beyond_the_focus_is_larger_than_infinitys():
    focus = torch.tensor(FOCUS, dtype=torch.float64)
    infinity = torch.tensor([[spot_px(b, 1e15, FOCUS[b])] for b in range(2)], dtype=torch.float64)
    found = depth_of_spot(lens(), infinity * torch.tensor([0.999, 1.001, 1e3, -1e3], dtype=torch.float64), focus)
    assert found.isnan().tolist() == [[False, True, True, False]] * 2
    for b in range(2):
        assert float(found[b, 0]) == pytest.approx(1000 * FOCUS[b], rel=1e-6)
    exact = Lens(*(torch.ones(1) for _ in range(3)))  # f = N = pitch = 1: at s = 2 the gain is 2, infinity's spot 1
    assert depth_of_spot(exact, torch.tensor([[1.0]]), torch.tensor([2.0])).isnan().all()


def test_a_disc_spreads_as_a_gaussian_of_a_quarter_of_its_diameter():
    x = np.linspace(-0.5, 0.5, 2001)
    chord = 2 * np.sqrt(0.25 - x**2)
    assert pytest.approx(math.sqrt((x**2 * chord).sum() / chord.sum()), rel=1e-3) == GAUSSIAN_OF_DISC
