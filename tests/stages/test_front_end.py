"""Stages 1 to 3 (sampling, back-projection, hole taxonomy) and their look-ups, on exact inputs and against OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from dhtorch.codes import ROUTE_OF_HOLE, Flag, Hole, Route, names
from dhtorch.geometry import camera as cam
from dhtorch.geometry import patches
from dhtorch.geometry.patches import extract_patches, luma, sample_nearest
from dhtorch.records import Camera, Frame
from dhtorch.stages.backproject import backproject
from dhtorch.stages.holes import classify, min_eigenvalue
from dhtorch.stages.sample import regular_grid, spiral, vogel_spiral

HW = (96, 128)
SAMPLERS = [spiral, regular_grid, vogel_spiral]


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def make_frame(depth=None, image=None, conf=None, **changes):
    rng = torch.Generator().manual_seed(3)
    if image is None:
        image = torch.randint(60, 200, (1, 3, *HW), dtype=torch.uint8, generator=rng)
    if depth is None:
        depth = torch.full((1, *HW), 1.5)
    camera = Camera(torch.tensor([[100.0, 101.0]]), torch.tensor([[63.0, 47.0]]))
    return Frame(image=image, depth=depth, camera=camera, conf=conf, **changes)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("n", [0, 1, 2, 7, 500, 2048])
@pytest.mark.parametrize("hw", [(480, 640), (224, 224), (1440, 1920), (30, 400)])
def test_samplers_give_exactly_n_points_inside(sampler, n, hw):
    uv = sampler(hw, n)
    assert uv.shape == (n, 2) and uv.dtype == torch.float32
    assert (uv >= 0).all() and (uv[:, 0] <= hw[1] - 1).all() and (uv[:, 1] <= hw[0] - 1).all()


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_samplers_reach_the_corners(sampler):
    uv = sampler((480, 640), 2048)
    corners = torch.tensor([[0, 0], [639, 0], [0, 479], [639, 479]], dtype=torch.float32)
    spacing = (480 * 640 / 2048) ** 0.5
    assert (torch.cdist(corners, uv).amin(1) < 4 * spacing).all()


def test_spiral_is_densest_at_the_gaze_and_has_no_duplicates():
    for gaze in (None, (100.0, 300.0)):
        uv = spiral((480, 640), 2048, gaze=gaze)
        centre = torch.tensor(gaze or (319.5, 239.5))
        r = (uv - centre).norm(dim=1)
        shares = torch.histc(r, 5, 0, 100) / (torch.arange(5) * 2 + 1)  # per ring area
        assert (shares[:-1] > shares[1:]).all()
        distance = torch.cdist(uv.double(), uv.double()) + 1e9 * torch.eye(len(uv))
        assert distance.min() > (0.5 if gaze is None else 0.2)  # a gaze near the border squeezes one side
        assert len(torch.unique(uv.round(), dim=0)) > 0.97 * len(uv)


def test_spiral_arms_are_half_a_turn_apart_and_foveation_flattens():
    uv = spiral((401, 401), 1000, margin_px=0) - 200
    first, second = uv[0::2], uv[1::2]
    assert torch.allclose(first, -second, atol=1e-3)
    inner = [(spiral((400, 400), 1000, foveation=g) - 199.5).norm(dim=1).lt(60).float().mean() for g in (0.5, 1.0, 2.0)]
    assert inner[0] < inner[1] < inner[2]


def test_vogel_and_grid_are_uniform():
    for sampler in (regular_grid, vogel_spiral):
        uv = sampler((400, 400), 4000)
        cells = torch.histogramdd(uv, [4, 4], range=[0.0, 400.0, 0.0, 400.0]).hist
        assert cells.min() > 0.7 * 250 and cells.max() < 1.3 * 250


def test_patches_agree_with_slices_and_shift_inside():
    image = rand(2, 3, 20, 30)
    corner = torch.tensor([[[4, 5], [-3, 18], [29, 0]], [[0, 0], [25, 15], [7, 7]]])
    out = extract_patches(image, corner, 5)
    assert torch.equal(out[0, 0], image[0, :, 5:10, 4:9])
    assert torch.equal(out[0, 1], image[0, :, 15:20, 0:5])
    assert torch.equal(out[1, 1], image[1, :, 15:20, 25:30])
    assert torch.equal(out, extract_patches(image.clone().requires_grad_(), corner, 5))
    with pytest.raises(ValueError, match="smaller than a patch"):
        extract_patches(image, corner, 21)


def test_luma_is_opencv_grey():
    rgb = (256 * rand(1, 3, 20, 30)).to(torch.uint8)
    ours = luma(rgb, 1)[0, 0].numpy() * 255
    theirs = cv2.cvtColor(rgb[0].permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    assert np.abs(ours - theirs).max() <= 0.51  # OpenCV rounds to integers


def test_nearest_reads_the_nearest_pixel_and_knows_the_border():
    depth = torch.arange(12.0).view(1, 3, 4)
    value, inside = sample_nearest(
        depth, torch.tensor([[[0.4, 0.6], [3.4, 2.4], [3.6, 0.0], [-0.6, 0.0], [torch.nan, 0]]])
    )
    assert value[0, :2].tolist() == [4.0, 11.0] and inside.tolist() == [[True, True, False, False, False]]


def test_backprojection_is_the_pinhole_formula():
    depth = rand(1, *HW) + 1
    frame = make_frame(depth)
    uv = spiral(HW, 300)
    s = backproject(frame, uv)
    z = depth[0, (uv[:, 1] + 0.5).floor().long(), (uv[:, 0] + 0.5).floor().long()]
    expected = torch.stack(((uv[:, 0] - 63) * z / 100, (uv[:, 1] - 47) * z / 101, z), -1)
    assert torch.allclose(s.xyz[0], expected, atol=1e-5)
    assert torch.equal(s.depth[0], z)
    assert torch.allclose(s.sigma, 0.01 * s.depth)


def test_a_missing_return_is_never_filled_and_edges_never_mix():
    depth = torch.full((1, *HW), 1.0)
    depth[:, :, 64:] = 3.0
    depth[:, 40:60, 40:60] = 0
    depth[0, 10, 10], depth[0, 12, 12], depth[0, 14, 14] = torch.nan, -1.0, torch.inf
    uv = torch.cartesian_prod(torch.arange(2.0, 126), torch.arange(2.0, 94))
    s = backproject(make_frame(depth), uv)
    assert set(s.depth.unique().tolist()) <= {0.0, 1.0, 3.0}
    none = s.depth == 0
    assert torch.equal(none, (s.flag & Flag.NO_DEPTH) != 0)
    assert s.xyz[none].isnan().all() and s.xyz[~none].isfinite().all()
    assert (s.confidence[none] == 0).all() and (s.confidence[~none] > 0).all()
    hole = (uv[:, 0] >= 40) & (uv[:, 0] < 60) & (uv[:, 1] >= 40) & (uv[:, 1] < 60)
    assert none[0][hole].all()
    edge = (s.flag[0] & Flag.DEPTH_EDGE) != 0
    far_from_step = (uv[:, 0] - 63.5).abs() > 3
    assert edge[~far_from_step].any() and not edge[far_from_step].any()


def test_search_takes_the_nearest_return_of_a_sparse_map():
    depth = torch.zeros(1, *HW)
    depth[0, 50, 60], depth[0, 52, 60] = 2.0, 4.0
    uv = torch.tensor([[60.0, 50.0], [60.0, 51.2], [57.0, 50.0], [56.0, 50.0], [60.0, 47.0]])
    assert backproject(make_frame(depth), uv).depth.tolist() == [[2, 0, 0, 0, 0]]
    found = backproject(make_frame(depth), uv, search_px=3).depth
    assert found.tolist() == [[2.0, 2.0, 2.0, 0.0, 2.0]]
    assert backproject(make_frame(depth), torch.tensor([[60.0, 52.4]]), search_px=3).depth.tolist() == [[4.0]]


def test_depth_of_its_own_resolution_and_camera():
    small = rand(1, 24, 32) + 1
    uv = spiral(HW, 200)
    coarse = backproject(make_frame(small), uv)
    pixel = ((uv + 0.5) / 4 - 0.5 + 0.5).floor().long()
    assert torch.equal(coarse.depth[0], small[0, pixel[:, 1], pixel[:, 0]])
    frame = make_frame(small)
    own = cam.resize(frame.camera, HW, (24, 32))
    assert torch.equal(backproject(frame.replace(depth_camera=own), uv).depth, coarse.depth)
    wide = own.replace(f=own.f * 1.3)  # a longer lens sees less: samples outside its field have no return
    outside = backproject(frame.replace(depth_camera=wide), uv)
    assert (outside.depth == 0).any() and ((outside.flag & Flag.NO_DEPTH) != 0).any()


def test_flags_confidence_and_limits():
    image = torch.full((1, 3, *HW), 120, dtype=torch.uint8)
    image[:, :, :30, :30] = 2
    image[:, :, :30, 60:] = 255
    image[:, :, 70, 70] = 250  # one glint
    conf = torch.full((1, *HW), 2, dtype=torch.uint8)
    conf[:, 40:60, :30] = 0
    conf[:, 40:60, 60:] = 1
    depth = torch.full((1, *HW), 1.5)
    depth[:, 80:] = 4
    uv = torch.tensor([[10.0, 10.0], [90, 10], [70, 70], [10, 50], [90, 50], [50, 90], [0, 50], [50, 50]])
    s = backproject(make_frame(depth, image, conf), uv, near_limit=3.0)
    flags = [{k for bit, k in names(Flag).items() if int(f) & bit} for f in s.flag[0]]
    assert flags == [
        {"UNDEREXPOSED"},
        {"SATURATED"},
        {"SPECULAR"},
        {"LOW_CONF"},
        set(),
        {"BEYOND_NEAR"},
        {"LOW_CONF", "BORDER"},
        set(),
    ]
    assert s.confidence[0].tolist() == [1, 0.5, 0.5, 0, 0.5, 0, 0, 1]
    assert s.depth[0, 5] == 4 and s.xyz[0, 5].isnan().all()


@pytest.mark.parametrize("colour", [1, 3])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_summaries_are_those_of_the_patches_for_planar_and_interleaved_pictures(monkeypatch, colour, dtype):
    monkeypatch.setattr(patches, "MAX_CHUNK_NUMBERS", 5 * 5 * colour * 64)  # several pieces
    image = torch.randint(0, 255, (2, colour, *HW), generator=torch.Generator().manual_seed(0)).to(dtype)
    pixel = torch.randint(-9, 140, (2, 300, 2), dtype=torch.int32, generator=torch.Generator().manual_seed(1))
    expected = extract_patches(image, pixel - 2, 5).float()
    for picture in (image, image.contiguous(memory_format=torch.channels_last), image.repeat(1, 1, 1, 2)[..., : HW[1]]):
        first, total = patches.reduce_patches(picture, pixel, 5, lambda p: (p[-1, 1, 0], p.float().sum((0, 1, 2))))
        assert torch.equal(first.float(), expected[:, :, -1, 1, 0])
        torch.testing.assert_close(total, expected.sum((2, 3, 4)))
    with pytest.raises(ValueError, match="smaller than a patch"):
        patches.reduce_patches(image[..., :4], pixel, 5, lambda p: (p[0, 0, 0],))


def test_grey_of_interleaved_bytes_is_exact_whoever_else_is_asked_for():
    image = torch.randint(0, 256, (3, 3, *HW), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    image = image.contiguous(memory_format=torch.channels_last)
    uv = spiral(HW, 777).expand(3, -1, -1)
    found = min_eigenvalue(image, uv)
    assert torch.equal(found[1:2, 5:105], min_eigenvalue(image[1:2], uv[1:2, 5:105]))
    expected = min_eigenvalue(image.double() / 255, uv)
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-8)
    with torch.autocast("cpu", dtype=torch.bfloat16):  # which takes bits off products, not off pixels
        torch.testing.assert_close(min_eigenvalue(image, uv).double(), expected, rtol=1e-5, atol=1e-8)


def test_a_spiral_asked_for_twice_is_the_same_and_each_is_its_own():
    first = spiral(HW, 50, dtype=torch.float64)
    first.zero_()
    assert torch.equal(spiral(HW, 50), spiral(HW, 50, dtype=torch.float64).float()) and spiral(HW, 50).abs().min() > 0


def test_every_hole_has_one_class():
    image = torch.randint(60, 200, (1, 3, *HW), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    image[:, :, :30, :30], image[:, :, :30, 60:], image[:, :, 60:, :40] = 2, 255, 128
    depth = torch.zeros(1, *HW)
    depth[:, :, 100:] = 1.0
    uv = torch.tensor([[10.0, 10.0], [80, 10], [20, 80], [60, 60], [110, 60], [0, 50]])
    frame = make_frame(depth, image)
    s = classify(frame, backproject(frame, uv))
    expected = [Hole.TOO_DARK, Hole.TOO_BRIGHT, Hole.LOW_TEXTURE, Hole.TRACKABLE_NO_LIDAR, Hole.NONE, Hole.AT_BORDER]
    assert s.hole[0].tolist() == expected
    assert set(ROUTE_OF_HOLE) == set(names(Hole)) and set(ROUTE_OF_HOLE.values()) <= set(names(Route))


def test_cost_does_not_grow_with_the_image(monkeypatch):
    """The stages read patches only: pixels away from every sample may hold anything without changing the answer."""
    frame = make_frame(image=rand(1, 3, *HW))
    uv = torch.tensor([[60.0, 50.0], [64.0, 52.0]])
    a = classify(frame, backproject(frame, uv))
    image, depth = torch.full_like(frame.image, torch.nan), torch.full_like(frame.depth, torch.nan)
    image[..., 40:62, 50:74], depth[..., 40:62, 50:74] = frame.image[..., 40:62, 50:74], frame.depth[..., 40:62, 50:74]
    other = frame.replace(image=image, depth=depth)
    b = classify(other, backproject(other, uv))
    assert torch.equal(a.trackability, b.trackability) and torch.equal(a.xyz, b.xyz) and torch.equal(a.flag, b.flag)
