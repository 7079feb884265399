"""Reading pixels, against slices of single patches, OpenCV's grey values, and halves rounded upwards."""

import math

import cv2
import numpy as np
import pytest
import torch

from dhtorch.geometry import patches

H, W = 9, 13
#: Pixels, some of whose patches lie beyond each border and corner.
PIXELS = [[6, 4], [0, 0], [12, 8], [2, 8], [-5, 4], [30, -3], [2, 2], [10, 6], [11, 6], [10, 7]]


def images(B=2, C=3, dtype=torch.float64):
    bits = torch.randint(0, 256, (B, C, H, W), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    return bits if dtype == torch.uint8 else (bits.double() / 255).to(dtype)


def pixels(B=2):
    """Other pixels for every image."""
    return torch.tensor([PIXELS[b:] + PIXELS[:b] for b in range(B)], dtype=torch.int32)


def interleaved(image):
    return image.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)


def strided(image):
    """The same numbers in memory that holds others between them."""
    return image.repeat_interleave(2, -1)[..., ::2]


def patch(image, corner, size):
    """The patch (C, size, size) at a corner, moved inside where it would leave."""
    left, top = (min(max(int(x), 0), n - size) for x, n in zip(corner, (W, H), strict=True))
    return image[:, top : top + size, left : left + size]


def test_halves_are_rounded_upwards():
    for dtype in (torch.float32, torch.float64):
        x = torch.tensor([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, -0.75, -0.25, 0.49, 7.0, 1e6 + 0.5], dtype=dtype)
        found = patches.round_half_up(x.requires_grad_())
        assert found.tolist() == [-2, -1, 0, 1, 2, 3, -1, 0, 0, 7, 1e6 + 1]
        assert found.dtype == dtype and not found.requires_grad


def test_the_nearest_pixel_is_read_and_border_pixels_beyond():
    grid = images()[:, 0]
    values = [-7.0, -0.51, -0.5, -0.1, 0.0, 0.49, 0.5, 1.5, 2.5, 7.9, 8.49, 8.5, 11.5, 12.49, 12.5, 40.0]
    uv = torch.tensor([[(u, v) for u in values for v in values]] * 2, dtype=torch.float64)
    pixel = torch.tensor([[[math.floor(x + 0.5) for x in point] for point in uv[0].tolist()]] * 2)
    assert torch.equal(patches.containing_pixels(uv).long(), pixel)
    value, inside = patches.sample_nearest(grid, uv)
    index, _ = patches.nearest_pixel_index((H, W), pixel)
    u, v = pixel[..., 0].clamp(0, W - 1), pixel[..., 1].clamp(0, H - 1)
    assert torch.equal(index, v * W + u) and torch.equal(value, grid[torch.arange(2)[:, None], v, u])
    assert torch.equal(inside, (u == pixel[..., 0]) & (v == pixel[..., 1]))
    nowhere = torch.tensor([[[x, 1.0], [1.0, x]] for x in (math.nan, math.inf, -math.inf, 1e30, -1e30)])
    assert not patches.nearest_pixel_index((H, W), patches.containing_pixels(nowhere))[1].any()


@pytest.mark.parametrize("size", [1, 4, 5, 9])
def test_a_patch_fits_when_all_its_pixels_exist(size):
    every = torch.tensor([[(u, v) for u in range(-2, W + 2) for v in range(-2, H + 2)]], dtype=torch.int32)
    first, last = -(size // 2), size - size // 2 - 1
    want = [first + u >= 0 and last + u < W and first + v >= 0 and last + v < H for u, v in every[0].tolist()]
    assert patches.is_patch_inside(every, (H, W), size).tolist() == [want]


@pytest.mark.parametrize("layout", [torch.clone, interleaved, strided])
@pytest.mark.parametrize("graph", [False, True])
def test_patches_are_slices_moved_back_inside(layout, graph):
    image = layout(images()).requires_grad_(graph)
    corner = torch.tensor([[[0, 0], [-3, 2], [8, 4], [9, 5], [30, 30]], [[1, 3], [4, -9], [8, 5], [7, 0], [3, 4]]])
    found = patches.extract_patches(image, corner, 5)
    want = torch.stack([torch.stack([patch(image[b], x, 5) for x in corner[b].tolist()]) for b in range(2)])
    assert torch.equal(found, want)
    if graph:
        weight = torch.linspace(0, 1, want.numel(), dtype=want.dtype).view(want.shape)
        slopes = [torch.autograd.grad((x * weight).sum(), image, retain_graph=True)[0] for x in (found, want)]
        torch.testing.assert_close(*slopes)
    windows = patches.extract_windows(image, torch.tensor([[4 * H * W + 2 * W + 3], [5 * H * W + 4 * W + 8]]), 5)
    assert torch.equal(windows[0, 0], image[1, 1, 2:7, 3:8]) and torch.equal(windows[1, 0], image[1, 2, 4:9, 8:13])
    assert patches.extract_patches(image, corner, 9)[0, 0, 0].equal(image[0, 0, :, :9])
    with pytest.raises(ValueError, match="smaller than a patch of 10x10"):
        patches.extract_patches(image, corner, 10)


def corner_and_sum(p):
    """Numbers that tell channels, rows and columns apart."""
    weight = torch.arange(1, p[..., 0].numel() + 1, dtype=torch.float64).view(p.shape[:-1])
    return p[..., 0, -1, :].double().sum(0) if p.ndim == 4 else p[0, -1], (weight[..., None] * p).flatten(0, -2).sum(0)


def reduced_one_by_one(image, size, grey):
    """:func:`corner_and_sum` of every patch."""
    rows = []
    for b in range(2):
        around = torch.stack(
            [patch(image[b], [u - size // 2, v - size // 2], size) for u, v in pixels()[b].tolist()], -1
        )
        around = around.double() / 255 if grey and image.dtype == torch.uint8 else around.double()
        if grey and len(around) == 3:
            around = (torch.tensor([0.299, 0.587, 0.114]).double()[:, None, None, None] * around).sum(0, keepdim=True)
        rows.append(corner_and_sum(around))
    return [torch.stack(x).double() for x in zip(*rows, strict=True)]


@pytest.mark.parametrize("how", [torch.clone, interleaved, strided, "autocast", "medium", "graph"])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64])
@pytest.mark.parametrize("colour", [1, 3])
@pytest.mark.parametrize("grey", [False, True])
def test_reductions_are_those_of_a_loop_over_patches(how, dtype, colour, grey, monkeypatch):
    """Also where products lose bits, and in a graph, which reads interleaved bytes in another way."""
    image = images(C=colour, dtype=dtype)
    laid = (how if callable(how) else interleaved)(image)
    read = lambda x, p: patches.reduce_patches(x, p, size, corner_and_sum, grey=grey)  # noqa: E731
    read = torch.compile(read, backend="eager") if how == "graph" and dtype == torch.uint8 else read
    monkeypatch.setattr(torch, "get_float32_matmul_precision", lambda: "medium" if how == "medium" else "highest")
    for size in (4, 5):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=how == "autocast"):
            found = read(laid, pixels())
        for x, want in zip(found, reduced_one_by_one(image, size, grey), strict=True):
            torch.testing.assert_close(x.double(), want, rtol=1e-6, atol=1e-6)


def test_a_reductions_gradient_falls_on_the_pixels_it_saw():
    image = images().requires_grad_()
    (total,) = patches.reduce_patches(image, pixels(), 4, lambda p: (p[1].square().sum((0, 1)),))
    total.sum().backward()
    want = torch.zeros_like(image)
    for b in range(2):
        for u, v in pixels()[b].tolist():
            patch(want[b], (u - 2, v - 2), 4)[1] += 2 * patch(image.detach()[b], (u - 2, v - 2), 4)[1]
    torch.testing.assert_close(image.grad, want)
    with pytest.raises(ValueError, match=r"reduce_patches: image of 9x13 pixels is smaller than .* 10x10"):
        patches.reduce_patches(image, pixels(), 10, corner_and_sum)


@pytest.mark.parametrize("dim", [1, -1])
def test_grey_is_opencvs_and_the_same_bits_of_bytes_and_floats(dim):
    rgb = images(dtype=torch.uint8).movedim(1, dim)
    for x in (rgb, rgb.float() / 255, rgb.double() / 255):
        grey = patches.luma(x, dim)
        assert grey.dtype == (torch.float64 if x.dtype == torch.float64 else torch.float32) and grey.shape[dim] == 1
        for b in range(2):
            theirs = cv2.cvtColor(rgb.float()[b].movedim(dim if dim < 0 else 0, -1).numpy() / 255, cv2.COLOR_RGB2GRAY)
            np.testing.assert_allclose(grey[b].squeeze().numpy(), theirs, atol=1e-6)
    assert torch.equal(patches.luma(rgb, dim), patches.luma(rgb.float() / 255, dim))
    one = images(C=1, dtype=torch.uint8)
    assert torch.equal(patches.luma(one, 1), one.float() / 255) and patches.luma(one.double(), 1).equal(one.double())


def test_the_least_variance_of_residuals_is_that_of_rounding_to_bytes():
    grey = torch.rand(1_000_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float(((grey * 255).round() / 255 - grey).var()) == pytest.approx(patches.QUANTISATION_VARIANCE, rel=0.01)
