"""Pyramids of windows, against OpenCV's levels, kornia's filters and bilinear reading written out."""

import cv2
import numpy as np
import pytest
import torch
from support.textures import levels as levels_by_hand

from dhtorch.geometry import windows as neighbours
from dhtorch.geometry.pyramid import (
    GRAD_X_PLANE,
    GRAD_Y_PLANE,
    GREY_PLANE,
    OUTSIDE_MARGIN_PX,
    SEARCH_PADDING_PX,
    build_pyramid,
)


def noise(B, C, H, W, seed=0, dtype=torch.float64):
    return torch.rand(B, C, H, W, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("hw", [(60, 81), (53, 64), (47, 47)])
@pytest.mark.parametrize("band", [1 << 17, 500, 1])
def test_levels_are_opencvs_mirrored_beyond_the_border_with_scharrs_gradients(hw, band, monkeypatch):
    monkeypatch.setattr(neighbours, "MAX_BAND_PIXELS", band)
    image = noise(2, 1, *hw)
    found = build_pyramid(image, 3, 7)
    assert found.pad == 7 // 2 + SEARCH_PADDING_PX and len(found.levels) == 3
    for b in range(2):
        for k, want in enumerate(levels_by_hand(image[b], len(found.levels), 7)):
            assert found.hw(k) == want.grey.shape
            np.testing.assert_allclose(found.levels[k][b].numpy(), np.stack(want.planes), atol=1e-12)


def test_colours_and_bytes_become_grey_first():
    rgb = torch.randint(0, 256, (2, 3, 30, 33), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    found = build_pyramid(rgb, 2, 5)
    for b in range(2):
        grey = cv2.cvtColor(rgb[b].permute(1, 2, 0).numpy().astype(np.float32) / 255, cv2.COLOR_RGB2GRAY)
        for k, want in enumerate(levels_by_hand(torch.from_numpy(grey)[None], 2, 5)):
            np.testing.assert_allclose(found.levels[k][b].numpy(), np.stack(want.planes), atol=1e-6)
    dtypes = ((torch.uint8, torch.float32), (torch.float16, torch.float32), (torch.float64, torch.float64))
    for dtype, wide in dtypes:
        assert all(level.dtype == wide for level in build_pyramid(rgb.to(dtype), 2, 5).levels)


def test_a_pyramid_without_gradients_has_the_grey_values_alone():
    image = noise(2, 3, 47, 61)
    with_slopes, without = build_pyramid(image, 2, 9), build_pyramid(image, 2, 9, gradients=False)
    for level, grey in zip(with_slopes.levels, without.levels, strict=True):
        assert level.shape[1] == 3 and torch.equal(level[:, GREY_PLANE : GREY_PLANE + 1], grey)


@pytest.mark.parametrize(("window", "least"), [(21, 22), (5, 11), (19, 20), (3, 10)])
def test_no_level_is_smaller_than_the_window_or_its_padding(window, least):
    assert len(build_pyramid(noise(1, 1, least, 90), 4, window).levels) == 1
    assert len(build_pyramid(noise(1, 1, 90, 2 * least - 1), 4, window).levels) == 2
    assert len(build_pyramid(noise(1, 1, 90, 2 * least - 2), 4, window).levels) == 1
    for small in ((least - 1, 90), (90, least - 1)):
        with pytest.raises(ValueError, match="too small for window"):
            build_pyramid(noise(1, 1, *small), 4, window)


def test_as_many_levels_are_made_as_asked_for():
    assert [len(build_pyramid(noise(1, 1, 90, 90), n, 5).levels) for n in (1, 2, 3, 4, 9)] == [1, 2, 3, 4, 4]
    usual = build_pyramid(noise(1, 1, 180, 180), window=5), build_pyramid(noise(1, 1, 60, 60))
    assert len(usual[0].levels) == 4 and usual[1].pad == 21 // 2 + SEARCH_PADDING_PX, "four, and windows of 21 px"


@pytest.mark.parametrize(
    ("image", "options"),
    [
        ((1, 1, 40, 40), {"window": 20}),
        ((1, 1, 40, 40), {"window": 1}),
        ((1, 1, 40, 40), {"levels": 0}),
        ((1, 2, 40, 40), {}),
        ((1, 40, 40), {}),
    ],
)
def test_wrong_images_and_options_are_refused(image, options):
    with pytest.raises(ValueError, match="build_pyramid"):
        build_pyramid(torch.zeros(image), **options)


def test_bounds_are_the_pixels_area_and_a_margin_on_coarse_levels():
    found = build_pyramid(noise(1, 1, 50, 77), 2, 5)
    low, high = found.bounds()
    assert low.tolist() == [[-0.5], [-0.5]] and high.tolist() == [[76.5], [49.5]]
    low, high = found.bounds(1)  # where the same places lie on the level, MARGIN further out
    assert low.tolist() == [[-0.25 - OUTSIDE_MARGIN_PX]] * 2 and high.tolist() == [
        [38.25 + OUTSIDE_MARGIN_PX],
        [24.75 + OUTSIDE_MARGIN_PX],
    ]


def test_a_places_corner_is_the_pixel_left_of_and_above_it():
    found = build_pyramid(noise(1, 1, 50, 77), 2, 5)
    x = torch.tensor(
        [[3.0, 3.99, -0.01, -4.5, -9.0, 41.9, 43.0, 90.0], [24.0, 0.5, 28.2, 29.0, 50.0, -3.1, -4.0, -4.1]]
    )
    want = [[3, 3, -1, -4, -4, 41, 42, 42], [24, 0, 28, 28, 28, -4, -4, -4]]  # the level has 39 x 25 pixels
    assert found.corner(1, x).tolist() == want
    leaf = x.clone().requires_grad_()
    assert not found.corner(1, leaf).requires_grad


@pytest.mark.parametrize("size", [5, 7])
@pytest.mark.parametrize("level", [0, 1])
def test_windows_are_read_between_pixels(size, level):
    image = noise(2, 1, 34, 45)
    found = build_pyramid(image, 2, 7)
    H, W = found.hw(level)
    uv = np.random.default_rng(0).uniform([-3, -3], [W + 2, H + 2], (12, 2))
    uv[0], uv[1], uv[2] = (5, 7), (5.25, 7), (W - 1, H - 1)
    batch = torch.arange(12) % 2
    for planes in ((GRAD_X_PLANE, GRAD_Y_PLANE, GREY_PLANE), (GREY_PLANE,), (GRAD_Y_PLANE,)):
        read = found.windows(level, torch.from_numpy(uv.T), batch, size, planes)
        by_hand = [levels_by_hand(image[b], 2, 7)[level] for b in range(2)]
        for k, plane in enumerate(planes):
            want = [by_hand[n % 2].window(plane, uv[n], size) for n in range(12)]
            np.testing.assert_allclose(read[k].numpy(), want, atol=1e-12)
    assert torch.equal(
        found.windows(level, torch.from_numpy(uv.T), batch, size)[2],
        found.windows(level, torch.from_numpy(uv.T), batch, size, (GREY_PLANE,))[0],
    )


def test_gradients_to_the_image():
    image = noise(1, 1, 12, 13).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: build_pyramid(x, 1, 3).levels, image, fast_mode=True)
    image = noise(1, 3, 19, 20).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: build_pyramid(x, 2, 3).levels, image, fast_mode=True)
