"""Reading pixels, against single patches and pixels of ``support/reference.py``."""

import math

import cv2
import numpy as np
import pytest
import torch
from support.reference import luma, nearest, patch

from dhtorch.geometry import patches
from dhtorch.geometry.determinism import ELEMENTWISE_LANES

H, W = 9, 13
#: Pixels, some of whose patches lie beyond each border and corner.
PIXELS = [[6, 4], [0, 0], [12, 8], [2, 8], [-5, 4], [30, -3], [2, 2], [10, 6], [11, 6], [10, 7]]


def pictures(B=2, C=3, dtype=torch.float64, seed=0):
    draw = torch.Generator().manual_seed(seed)
    bits = torch.randint(0, 256, (B, C, H, W), generator=draw, dtype=torch.uint8)
    return bits if dtype == torch.uint8 else (bits.double() / 255).to(dtype)


def pixels(B=2):
    """Other pixels for every picture."""
    return torch.tensor([PIXELS[b:] + PIXELS[:b] for b in range(B)], dtype=torch.int32)


def interleaved(image):
    return image.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)


def strided(image):
    """The same numbers in memory that holds others between them."""
    wide = torch.full((*image.shape[:3], 2 * image.shape[3]), 7, dtype=image.dtype)
    wide[..., ::2] = image
    return wide[..., ::2]


# --- whole numbers ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_halves_are_rounded_upwards(dtype):
    x = torch.tensor([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5, -0.75, -0.25, 0.49, 7.0, 1e6 + 0.5], dtype=dtype)
    found = patches.round_half_up(x.requires_grad_())
    assert found.tolist() == [-2, -1, 0, 1, 2, 3, 4, -1, 0, 0, 7, 1e6 + 1]
    assert found.dtype == dtype and not found.requires_grad


def test_a_place_lies_in_the_pixel_whose_middle_is_nearest_and_no_place_in_none():
    uv = torch.tensor([[[0.5, 1.49], [-0.5, -0.51], [2.5, 3.5], [math.nan, 2.0]]])
    found = patches.containing_pixels(uv)
    assert found.tolist() == [[[1, 1], [0, -1], [3, 4], [-1, 2]]] and found.dtype == torch.int32
    nowhere = torch.tensor([[[x, 1.0], [1.0, x]] for x in (math.nan, math.inf, -math.inf, 1e30, -1e30)])
    assert not patches.nearest_pixel_index((H, W), patches.containing_pixels(nowhere))[1].any()


def test_the_nearest_pixel_is_read_and_border_pixels_beyond():
    grid = pictures()[:, 0]
    values = [-7.0, -0.51, -0.5, -0.1, 0.0, 0.49, 0.5, 1.5, 2.5, 7.9, 8.49, 8.5, 11.5, 12.49, 12.5, 40.0]
    uv = torch.tensor([[(u, v) for u in values for v in values]] * 2, dtype=torch.float64)
    value, inside = patches.sample_nearest(grid, uv)
    for b in range(2):
        for n, (u, v) in enumerate(uv[b].tolist()):
            assert (value[b, n], bool(inside[b, n])) == nearest(grid[b], (u, v))


def test_the_index_of_a_pixel_counts_along_rows():
    index, inside = patches.nearest_pixel_index((H, W), pixels())
    want = [[min(max(v, 0), H - 1) * W + min(max(u, 0), W - 1) for u, v in row] for row in pixels().tolist()]
    assert index.tolist() == want and index.dtype == torch.int64
    assert inside.tolist() == [[0 <= u < W and 0 <= v < H for u, v in row] for row in pixels().tolist()]


@pytest.mark.parametrize("size", [1, 4, 5, 9])
def test_a_patch_fits_when_all_its_pixels_exist(size):
    every = torch.tensor([[(u, v) for u in range(-2, W + 2) for v in range(-2, H + 2)]], dtype=torch.int32)
    first, last = -(size // 2), size - size // 2 - 1
    want = [first + u >= 0 and last + u < W and first + v >= 0 and last + v < H for u, v in every[0].tolist()]
    assert patches.is_patch_inside(every, (H, W), size).tolist() == [want]


# --- patches ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", [torch.clone, interleaved, strided])
@pytest.mark.parametrize("graph", [False, True])
def test_patches_are_slices_moved_back_inside(layout, graph):
    image = layout(pictures()).requires_grad_(graph)
    corner = torch.tensor([[[0, 0], [-3, 2], [8, 4], [9, 5], [30, 30]], [[1, 3], [4, -9], [8, 5], [7, 0], [3, 4]]])
    found = patches.extract_patches(image, corner, 5)
    for b in range(2):
        for n, (u, v) in enumerate(corner[b].tolist()):
            left, top = min(max(u, 0), W - 5), min(max(v, 0), H - 5)
            assert torch.equal(found[b, n], image[b, :, top : top + 5, left : left + 5])
    with pytest.raises(ValueError, match="smaller than a patch of 10x10"):
        patches.extract_patches(image, corner, 10)
    assert patches.extract_patches(image, corner, 9)[0, 0, 0].equal(image[0, 0, :, :9])


def test_a_patches_gradient_falls_on_its_pixels():
    image = pictures(B=1).requires_grad_()
    corner = torch.tensor([[[1, 2], [2, 2]]])
    weight = torch.rand(1, 2, 3, 4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (patches.extract_patches(image, corner, 4) * weight).sum().backward()
    want = torch.zeros_like(image)
    for n, (u, v) in enumerate(corner[0].tolist()):
        want[0, :, v : v + 4, u : u + 4] += weight[0, n]
    torch.testing.assert_close(image.grad, want)


@pytest.mark.parametrize("graph", [False, True])
def test_windows_are_counted_through_a_stack_of_planes(graph):
    stack = pictures().requires_grad_(graph)  # six planes
    found = patches.extract_windows(stack, torch.tensor([[4 * H * W + 2 * W + 3], [5 * H * W + 4 * W + 8]]), 5)
    assert torch.equal(found[0, 0], stack[1, 1, 2:7, 3:8]) and torch.equal(found[1, 0], stack[1, 2, 4:9, 8:13])


# --- summaries -------------------------------------------------------------------------------------------------------


def corner_and_sum(p):
    """Numbers that tell channels, rows and columns apart."""
    weight = torch.arange(1, p[..., 0].numel() + 1, dtype=torch.float64).view(p.shape[:-1])
    return p[..., 0, -1, :].double().sum(0) if p.ndim == 4 else p[0, -1], (weight[..., None] * p).flatten(0, -2).sum(0)


@pytest.mark.parametrize("layout", [torch.clone, interleaved, strided])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64])
@pytest.mark.parametrize("colour", [1, 3])
@pytest.mark.parametrize("grey", [False, True])
def test_summaries_are_those_of_a_loop_over_patches(layout, dtype, colour, grey):
    image = pictures(C=colour, dtype=dtype)
    for size in (4, 5):
        found = patches.reduce_patches(layout(image), pixels(), size, corner_and_sum, grey=grey)
        for b in range(2):
            for n, (u, v) in enumerate(pixels()[b].tolist()):
                around = patch(image[b], (u, v), size).double()
                around = around / 255 if grey and dtype == torch.uint8 else around
                if grey and colour == 3:
                    around = luma(around)
                for x, want in zip(found, corner_and_sum(around[..., None]), strict=True):
                    assert float(x[b, n]) == pytest.approx(float(want), rel=1e-6)


@pytest.mark.parametrize("n", [0, 64, 150])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_summaries_see_whole_lanes_of_a_few_patches_at_a_time(n, dtype, monkeypatch):
    image = interleaved(pictures(dtype=dtype))
    draw = np.random.default_rng(0)
    pixel = torch.from_numpy(draw.integers(-3, 16, (2, n, 2)).astype(np.int32))
    seen = []

    def first(p):
        assert p.shape[:2] == (3, 3) and p.shape[2] % ELEMENTWISE_LANES == 0
        seen.append(p.shape[2])
        return (p[0, 0],)

    (whole,) = patches.reduce_patches(image, pixel, 3, first, grey=True)
    assert whole.shape == (2, n) and len(seen) == 1
    monkeypatch.setattr(patches, "MAX_CHUNK_NUMBERS", 3 * 3 * 3 * 128)
    (parts,) = patches.reduce_patches(image, pixel, 3, first, grey=True)
    assert torch.equal(parts, whole) and max(seen[1:]) <= 128
    assert len(seen) - 1 == max(1, -(-2 * n // 128)), "as many patches at a time as there is room for"
    want = [[patch(image[b], pixel[b, k].tolist(), 3)[:, 0, 0] for k in range(n)] for b in range(2)]
    if n:
        grey = patches.luma(torch.stack([torch.stack(x) for x in want]), -1)[..., 0]
        torch.testing.assert_close(whole, grey)


def test_a_summarys_gradient_falls_on_the_pixels_it_saw():
    image = pictures().requires_grad_()
    (total,) = patches.reduce_patches(image, pixels(), 4, lambda p: (p[1].square().sum((0, 1)),))
    total.sum().backward()
    want = torch.zeros_like(image)
    for b in range(2):
        for u, v in pixels()[b].tolist():
            patch(want[b], (u, v), 4)[1] += 2 * patch(image.detach()[b], (u, v), 4)[1]
    torch.testing.assert_close(image.grad, want)


@pytest.mark.parametrize("how", ["autocast", "matmul"])
def test_grey_values_of_bytes_keep_their_bits_where_products_lose_some(how):
    image = interleaved(pictures(dtype=torch.uint8))
    read = lambda: patches.reduce_patches(image, pixels(), 5, corner_and_sum, grey=True)  # noqa: E731
    want = read()
    precision = torch.get_float32_matmul_precision()
    try:
        if how == "matmul":
            torch.set_float32_matmul_precision("medium")
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=how == "autocast"):
            found = read()
    finally:
        torch.set_float32_matmul_precision(precision)
    for x, y in zip(found, want, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-6, atol=0, check_dtype=False)


@pytest.mark.parametrize("grey", [False, True])
def test_a_graph_reads_interleaved_bytes_as_python_does(grey):
    image = interleaved(pictures(dtype=torch.uint8))
    read = lambda x, p: patches.reduce_patches(x, p, 5, corner_and_sum, grey=grey)  # noqa: E731
    for x, y in zip(torch.compile(read, backend="eager")(image, pixels()), read(image, pixels()), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-6, atol=0, check_dtype=False)


def test_patches_larger_than_the_image_are_refused():
    for size, fine in ((9, True), (10, False)):
        if fine:
            patches.reduce_patches(pictures(), pixels(), size, corner_and_sum)
        else:
            with pytest.raises(ValueError, match=r"reduce_patches: image of 9x13 pixels is smaller than .* 10x10"):
                patches.reduce_patches(pictures(), pixels(), size, corner_and_sum)


# --- grey ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, -1])
def test_grey_is_opencvs(dim):
    rgb = pictures(dtype=torch.uint8).movedim(1, dim)
    for x in (rgb, rgb.float() / 255, rgb.double() / 255):
        grey = patches.luma(x, dim)
        assert grey.dtype == (torch.float64 if x.dtype == torch.float64 else torch.float32)
        for b in range(2):
            theirs = cv2.cvtColor(rgb.float()[b].movedim(dim if dim < 0 else 0, -1).numpy() / 255, cv2.COLOR_RGB2GRAY)
            np.testing.assert_allclose(grey[b].squeeze().numpy(), theirs, atol=1e-6)
        assert grey.shape[dim] == 1


def test_bytes_and_floats_of_one_picture_have_the_same_grey_bit_for_bit():
    rgb = pictures(dtype=torch.uint8)
    assert torch.equal(patches.luma(rgb, 1), patches.luma(rgb.float() / 255, 1))
    one = pictures(C=1, dtype=torch.uint8)
    assert torch.equal(patches.luma(one, 1), one.float() / 255)
    assert patches.luma(one.double(), 1).equal(one.double())


def test_rounding_to_bytes_has_the_variance_that_residuals_are_not_believed_below():
    grey = torch.rand(1_000_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float(((grey * 255).round() / 255 - grey).var()) == pytest.approx(patches.QUANTISATION_VARIANCE, rel=0.01)
