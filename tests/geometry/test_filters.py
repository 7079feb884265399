"""Filters of whole images, against SciPy's with the border's pixels repeated."""

import math

import numpy as np
import pytest
import scipy.ndimage as ndi
import torch

from dhtorch.geometry.filters import box_mean, correlate_separable, gaussian_blur, gaussian_taps, grayscale
from dhtorch.geometry.patches import luma


def pictures(seed=0):
    return torch.rand(2, 3, 9, 12, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("down", "across"), [((0.2, -1.0, 0.7), (0.5, 0.1, -0.3, 0.9, 2.0)), ((1.0,), (3.0, 0, -1.0))])
def test_correlation_along_both_axes(down, across):
    x = pictures()
    want = ndi.correlate1d(ndi.correlate1d(x.numpy(), down, axis=2, mode="nearest"), across, axis=3, mode="nearest")
    np.testing.assert_allclose(correlate_separable(x, down, across).numpy(), want, atol=1e-12)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 1.1, 2.6])
def test_a_gaussian_reaches_four_deviations_and_is_scipys(sigma):
    x, reach = pictures(), math.ceil(4 * sigma)
    want = ndi.gaussian_filter(x.numpy(), sigma, mode="nearest", radius=reach, axes=(2, 3))
    np.testing.assert_allclose(gaussian_blur(x, sigma).numpy(), want, atol=1e-12)
    assert len(gaussian_taps(sigma)) == 2 * reach + 1


def test_a_blur_may_reach_less_far():
    want = ndi.gaussian_filter(pictures().numpy(), 1.2, mode="nearest", radius=2, axes=(2, 3))
    np.testing.assert_allclose(gaussian_blur(pictures(), 1.2, reach_px=2).numpy(), want, atol=1e-12)
    assert gaussian_blur(pictures()[:0], 1.2).shape == (0, 3, 9, 12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_grey_is_that_of_patches_bit_for_bit(dtype):
    x = pictures().to(dtype)
    assert torch.equal(grayscale(x), luma(x, 1)) and torch.equal(grayscale(x[:, :1]), x[:, :1])
    whole = (255 * x).to(torch.uint8)
    assert torch.equal(grayscale(whole), luma(whole, 1)) and torch.equal(grayscale(whole[:, :1]), luma(whole[:, :1], 1))


@pytest.mark.parametrize("sigma", [0.4, 1.0, 2.3])
def test_the_derivative_answers_1_to_a_slope_of_1(sigma):
    taps, reach = gaussian_taps(sigma, derivative=True), math.ceil(4 * sigma)
    place = np.arange(-reach, reach + 1)
    assert np.dot(taps, 0.7 + place) == pytest.approx(1, rel=1e-12), "a picture that rises by 1 per pixel"
    weight = np.exp(-(place**2) / (2 * sigma**2))
    np.testing.assert_allclose(taps, place * weight / (place**2 * weight).sum(), rtol=1e-12, atol=1e-15)
    smooth = np.sin(np.arange(60) / 12.0)
    if sigma == 2.3:  # wide enough to be sampled well: SciPy's derivative of the same Gaussian
        want = ndi.gaussian_filter1d(smooth, sigma, order=1, radius=reach)
        found = ndi.correlate1d(smooth, taps)
        np.testing.assert_allclose(found[15:-15], want[15:-15], rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_a_box_is_the_mean_of_a_square(radius):
    want = ndi.uniform_filter(pictures().numpy(), 2 * radius + 1, mode="nearest", axes=(2, 3))
    np.testing.assert_allclose(box_mean(pictures(), radius).numpy(), want, atol=1e-12)


def test_bad_taps_are_refused():
    for taps in (([1.0], [0.5, 0.5]), ([0.5, 0.5], [1.0])):
        with pytest.raises(ValueError, match="expected odd numbers"):
            correlate_separable(pictures(), *taps)
    for bad in ((-0.1, False), (math.nan, False), (0.0, True), (-1.0, True)):
        with pytest.raises(ValueError, match="expected a positive number"):
            gaussian_taps(*bad)
