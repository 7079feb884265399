"""Stage 3: the order of its classes, its limits, texture by a plain formula and by OpenCV, what to try for each hole."""

import cv2
import numpy as np
import pytest
import torch

from dhtorch.codes import Flag, Hole
from dhtorch.records import Camera, Frame, Samples
from dhtorch.stages.holes import classify, min_eigenvalue

HW = (24, 32)
GREY = np.array([0.299, 0.587, 0.114])


def picture(channels=3, seed=0):
    return torch.rand(2, channels, *HW, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pixels(margin=0.0, n=60, seed=1):
    uv = torch.rand(2, n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return margin - 0.5 + uv * (torch.tensor([HW[1], HW[0]]) - 2 * margin)


def plain_eigenvalue(grey, u, v, block):
    """Of the mean gradient matrix over a block around the pixel, moved inside with the filter's rim."""
    reach = block // 2 + 1
    v, u = (min(max(int(np.floor(x + 0.5)), reach), n - 1 - reach) for x, n in ((v, HW[0]), (u, HW[1])))
    sobel = np.outer([1, 2, 1], [-1, 0, 1]) / 4
    total = np.zeros((2, 2))
    for y in range(v - block // 2, v + block // 2 + 1):
        for x in range(u - block // 2, u + block // 2 + 1):
            around = grey[y - 1 : y + 2, x - 1 : x + 2]
            gradient = np.array([(around * sobel).sum(), (around * sobel.T).sum()])
            total += np.outer(gradient, gradient) / block**2
    return np.linalg.eigvalsh(total)[0]


@pytest.mark.parametrize(("block", "channels"), [(3, 1), (5, 3), (7, 1), (7, 3)])
def test_trackability_is_the_smaller_eigenvalue_of_the_mean_gradient_matrix(block, channels):
    image, uv = picture(channels), pixels()
    found = min_eigenvalue(image, uv, block=block)
    for b in range(2):
        grey = image[b, 0].numpy() if channels == 1 else np.tensordot(GREY, image[b].numpy(), 1)
        expected = [plain_eigenvalue(grey, *place, block) for place in uv[b].tolist()]
        np.testing.assert_allclose(found[b].numpy(), expected, rtol=1e-9)


def test_trackability_looks_at_a_block_of_seven_and_is_opencvs():
    grey, uv = picture(1)[:1].float(), pixels(margin=5)[:1]
    theirs = torch.from_numpy(cv2.cornerMinEigenVal(grey[0, 0].numpy(), 7, ksize=3))
    at = (uv[0] + 0.5).floor().long()
    torch.testing.assert_close(min_eigenvalue(grey, uv)[0], theirs[at[:, 1], at[:, 0]], rtol=1e-4, atol=1e-6)


def test_texture_in_one_direction_cannot_be_tracked_and_has_finite_gradients():
    image = torch.zeros(1, 1, *HW, dtype=torch.float64)
    image[..., 16:] = 1
    image.requires_grad_()
    uv = torch.tensor([[[16.0, 12.0], [4.0, 4.0]]], dtype=torch.float64)
    found = min_eigenvalue(image, uv)
    assert found.abs().max() < 1e-12
    found.sum().backward()
    assert image.grad.isfinite().all()


def taken(flags, usable=False, trackable=True):
    """A frame that is textured or not, and samples in its middle with those flags."""
    n = len(flags)
    frame = Frame(
        image=picture()[:1] if trackable else 0 * picture()[:1],
        depth=torch.zeros(1, *HW),
        camera=Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[16.0, 12.0]])),
    )
    zero = torch.zeros(1, n)
    xyz = torch.full((1, n, 3), 1.0 if usable else torch.nan)
    flag = torch.tensor([flags], dtype=torch.int32)
    uv = torch.tensor([16.0, 12.0]).expand(1, n, 2).double()
    return frame, Samples(uv, zero, zero, xyz, zero, flag, zero, zero.to(torch.int32))


ASKED = [
    (Flag.BORDER, Hole.AT_BORDER),
    (Flag.UNDEREXPOSED, Hole.TOO_DARK),
    (Flag.SATURATED, Hole.TOO_BRIGHT),
    (Flag.SPECULAR, Hole.HIGHLIGHT),
]


def test_of_two_reasons_the_first_asked_names_the_hole():
    other = Flag.NO_DEPTH | Flag.LOW_CONF | Flag.DEPTH_EDGE | Flag.BEYOND_NEAR
    pairs = [(a, b) for k, a in enumerate(ASKED) for b in ASKED[k:]]
    frame, samples = taken([a[0] | b[0] | other for a, b in pairs])
    assert classify(frame, samples).hole[0].tolist() == [a[1] for a, _ in pairs]
    frame, samples = taken([a[0] for a, _ in pairs] + [other], trackable=False)
    assert classify(frame, samples).hole[0].tolist() == [a[1] for a, _ in pairs] + [Hole.LOW_TEXTURE]
    frame, samples = taken([other, 0])
    assert classify(frame, samples).hole[0].tolist() == [Hole.TRACKABLE_NO_LIDAR] * 2
    frame, samples = taken([a[0] for a, _ in pairs], usable=True, trackable=False)
    assert classify(frame, samples).hole[0].tolist() == [Hole.NONE] * len(pairs)


def test_texture_at_the_limit_is_enough():
    frame, samples = taken([Flag.NO_DEPTH])
    found = classify(frame, samples)
    texture = float(min_eigenvalue(frame.image, samples.uv))
    assert found.trackability.dtype == torch.float32 and float(found.trackability) == pytest.approx(texture, rel=1e-6)
    for limit, hole in ((texture, Hole.TRACKABLE_NO_LIDAR), (texture * (1 + 1e-12), Hole.LOW_TEXTURE)):
        assert classify(frame, samples, min_trackability=limit).hole.item() == hole
    wide = classify(frame, samples, block=11).trackability.item()
    assert wide == pytest.approx(float(min_eigenvalue(frame.image, samples.uv, block=11)), rel=1e-6) != texture
    assert torch.equal(found.flag, samples.flag) and torch.equal(found.uv, samples.uv)


@pytest.mark.parametrize("missing", [[0, 1, 2], [0, 1], [1]])
def test_a_point_without_a_ray_is_a_hole_whatever_its_depth(missing):
    frame, samples = taken([0, 0], usable=True)
    xyz = samples.xyz.clone()
    xyz[0, 1, missing] = torch.nan
    assert classify(frame, samples.replace(xyz=xyz)).hole.tolist() == [[Hole.NONE, Hole.TRACKABLE_NO_LIDAR]]
