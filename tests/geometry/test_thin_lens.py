"""The thin lens, against the lens equation and similar triangles."""

import math

import numpy as np
import pytest
import torch

from dhtorch.geometry.thin_lens import GAUSSIAN_OF_DISC, Lens, depth_of_spot, spot_diameter, spot_gain


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


F, STOP, PITCH, FOCUS = double(0.05, 0.035), double(2.0, 5.6), double(5e-6, 2e-6), double(2.0, 0.8)
LENS = Lens(F, STOP, PITCH)


def spot_px(z, focus):
    """Images form at v(z), the sensor stands at v(focus); the cone of light behind the aperture is cut there."""
    at_z, at_focus = (1 / (1 / F[:, None] - 1 / x) for x in (z, focus))
    return (F / STOP / PITCH)[:, None] * (at_focus - at_z) / at_z


def test_the_spot_is_the_cut_through_the_cone_of_light_and_tells_the_depth():
    depth = double([0.3, 1.0, 2.0, 4.0, 300.0], [0.2, 0.8, 0.9, 2.0, 50.0])
    want = spot_px(depth, FOCUS[:, None])
    torch.testing.assert_close(spot_diameter(LENS, depth, FOCUS), want, rtol=1e-9, atol=1e-9)
    assert want[0, 0] < 0 < want[0, 3], "positive beyond the focus"
    torch.testing.assert_close(depth_of_spot(LENS, want, FOCUS), depth, rtol=1e-9, atol=0)
    assert (
        spot_diameter(LENS, double([0.0, -1.0, 1.0]).expand(2, 3), FOCUS).isnan().tolist() == [[True, True, False]] * 2
    )


def test_the_gain_is_pixels_of_spot_per_dioptre_out_of_focus():
    focus = double([0.5, 2.0, 7.0], [0.1, 0.8, 1e3])
    # A quarter of a dioptre nearer, and a little farther, in front of the same sensor.
    near, far = (spot_px(1 / (1 / focus + d), focus) for d in (0.25, -0.0005))
    torch.testing.assert_close(spot_gain(LENS, focus), (far - near) / 0.2505, rtol=1e-6, atol=0)
    gain = spot_gain(LENS, double([0.05, 0.01], [0.035, 0.0351]))  # a focus is kept a nanometre beyond the focal length
    torch.testing.assert_close(gain[0], double(0.05, 0.01) * F[0] ** 2 / STOP[0] / (1e-9 * PITCH[0]), rtol=1e-6, atol=0)


def test_no_spot_beyond_the_focus_is_larger_than_infinitys():
    infinity = spot_px(torch.full((2, 1), 1e15, dtype=torch.float64), FOCUS[:, None])
    found = depth_of_spot(LENS, infinity * double(0.999, 1.001, 1e3, -1e3), FOCUS)
    assert found.isnan().tolist() == [[False, True, True, False]] * 2
    torch.testing.assert_close(found[:, 0], 1000 * FOCUS, rtol=1e-6, atol=0)
    exact = Lens(*(torch.ones(1) for _ in range(3)))  # f = N = pitch = 1: at s = 2 the gain is 2, infinity's spot 1
    assert depth_of_spot(exact, torch.tensor([[1.0]]), torch.tensor([2.0])).isnan().all()


def test_a_disc_spreads_as_a_gaussian_of_a_quarter_of_its_diameter():
    x = np.linspace(-0.5, 0.5, 2001)
    chord = 2 * np.sqrt(0.25 - x**2)
    assert pytest.approx(math.sqrt((x**2 * chord).sum() / chord.sum()), rel=1e-3) == GAUSSIAN_OF_DISC
