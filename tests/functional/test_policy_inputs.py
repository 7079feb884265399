"""Geometry images and point clouds: the stated codes, their inverse, and which pixels become points."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from dhtorch import functional as fn
from dhtorch.codes import Source, names
from dhtorch.functional.policy_inputs import LOWEST_RATIO, NEAREST_M, SOURCE_STEP
from dhtorch.geometry import camera as cam

K = torch.tensor([[60.0, 0.0, 31.0], [0.0, 62.0, 23.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def maps(*batch, hw=(48, 64), low=0.25, high=20.0):
    """Depth, sigma and source with a third of the pixels unanswered."""
    draw = torch.Generator().manual_seed(3)
    depth, ratio = (torch.rand(*batch, *hw, generator=draw, dtype=torch.float64) for _ in range(2))
    source = torch.randint(0, max(names(Source)) + 1, (*batch, *hw), generator=draw, dtype=torch.int32)
    depth = torch.where(source > 0, low * (high / low) ** depth, 0.0)
    return depth, depth * LOWEST_RATIO**ratio, source


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_decoding_is_within_half_a_code(batch):
    depth, sigma, source = maps(*batch)
    image = fn.geometry_image(depth, sigma, source)
    assert image.shape == (*batch, 3, 48, 64)
    assert image.dtype == torch.uint8
    back = fn.decode_geometry_image(image)
    assert torch.equal(back.source, source)
    valid = source > 0
    assert torch.equal(back.depth > 0, valid)
    inverse = (1 / back.depth.double()[valid] - 1 / depth[valid]).abs()
    assert inverse.max() <= 0.5 / (255 * NEAREST_M) * 1.0001
    assert inverse.max() > 0.45 / (255 * NEAREST_M)  # the limit is the one that is reached
    ratio = torch.log(back.sigma.double()[valid] / back.depth.double()[valid] * depth[valid] / sigma[valid]).abs()
    assert ratio.max() <= 0.5 * -math.log(LOWEST_RATIO) / 254 * 1.001
    assert ratio.max() < math.log(1.014)


def test_pixels_without_depth_are_black_and_ranges_end_at_the_last_codes():
    depth = torch.tensor([[0.0, math.nan, math.inf, -1.0, 1.0, 0.01, 1e6, 2.0, 2.0]])
    sigma = torch.tensor([[0.0, 1.0, 1.0, 1.0, 0.1, 1.0, 1.0, 0.0, math.nan]])
    source = torch.tensor([[0, 1, 1, 1, 0, 1, 1, 1, 1]])
    red, green, blue = fn.geometry_image(depth, sigma, source)[:, 0].tolist()
    assert red == [0] * 5 + [255, 1, 32, 32]
    assert green == [0] * 5 + [255, 1, 0, 0]
    assert blue == [0] * 5 + [SOURCE_STEP] * 4
    back = fn.decode_geometry_image(fn.geometry_image(depth, sigma, source))
    assert back.depth[0, 5:7].tolist() == [NEAREST_M, 255 * NEAREST_M]
    assert back.sigma[0, 7:].tolist() == [0.0, 0.0]


def test_every_source_survives_an_error_of_the_codec_below_half_its_step():
    source = torch.tensor([sorted(names(Source))])
    image = fn.geometry_image(torch.ones(source.shape), torch.ones(source.shape), source).int()
    for error in (-SOURCE_STEP // 2 + 1, SOURCE_STEP // 2 - 1):
        moved = (image + error).clamp(0, 255).to(torch.uint8)
        assert torch.equal(fn.decode_geometry_image(moved).source, source.int())


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_a_picture_divided_by_255_decodes_the_same(dtype):
    image = fn.geometry_image(*maps())
    expected, actual = fn.decode_geometry_image(image), fn.decode_geometry_image(image.to(dtype) / 255)
    assert actual.depth.dtype == dtype
    assert torch.equal(actual.source, expected.source)
    torch.testing.assert_close(actual.depth.float(), expected.depth, rtol=2e-3, atol=0)


def test_points_lie_on_the_rays_of_their_pixels_at_the_depth_of_the_map():
    depth = maps()[0]
    xyz = fn.point_cloud(depth, K, n=200)
    u, v = (K[:2] @ (xyz / xyz[:, 2:]).mT).round().long()
    assert torch.equal(depth[v, u], xyz[:, 2])
    back = (K @ (xyz / xyz[:, 2:]).mT)[:2]
    torch.testing.assert_close(back, torch.stack((u, v)).double())
    assert len({(int(a), int(b)) for a, b in zip(u, v, strict=True)}) == 200


def test_a_lens_bends_the_rays():
    depth, lens = torch.full((48, 64), 2.0, dtype=torch.float64), torch.tensor([0.1, -0.05, 0.001, 0.002])
    xyz = fn.point_cloud(depth, K, n=100, distortion=lens)
    uv = cam.project(cam.from_matrix(K[None], lens[None].double()), xyz[None])[0]
    assert (uv - uv.round()).abs().max() < 1e-4
    assert (xyz - fn.point_cloud(depth, K, n=100)).abs().max() > 1e-3


def test_fewer_points_are_the_first_of_more_and_they_repeat_when_pixels_run_out():
    depth = torch.zeros(48, 64, dtype=torch.float64)
    depth[10:12, 20:23] = 1.0 + torch.arange(6, dtype=torch.float64).view(2, 3)
    few, many = fn.point_cloud(depth, K, n=4), fn.point_cloud(depth, K, n=15)
    assert torch.equal(many[:4], few)
    assert sorted(many[:6, 2].tolist()) == [1, 2, 3, 4, 5, 6]
    assert torch.equal(many[6:12], many[:6])
    assert torch.equal(many[12:], many[:3])
    assert not fn.point_cloud(torch.zeros(2, 5, 7), K, n=3).any()


def test_gradient_of_points():
    depth = (1 + maps(hw=(6, 8))[0]).requires_grad_()  # every pixel has one, so that no step of the check adds it
    lens = torch.tensor([0.01, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    assert gradcheck(
        lambda *x: fn.point_cloud(x[0], x[1], n=20, distortion=x[2]), (depth, K.clone().requires_grad_(), lens)
    )


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: fn.geometry_image(torch.ones(4, 5), torch.ones(4, 6), torch.ones(4, 5)), "sigma"),
        (lambda: fn.decode_geometry_image(torch.ones(4, 5, 3)), "image"),
        (lambda: fn.point_cloud(torch.ones(4, 5), torch.eye(4)), "K"),
        (lambda: fn.point_cloud(torch.ones(4, 5), torch.eye(3), n=0), "expected at least 1"),
    ],
)
def test_wrong_shapes_raise(call, text):
    with pytest.raises(ValueError, match=text):
        call()
