"""Stage 2 against a loop over samples that says the same in numpy: depth, points, flags, confidence, every option."""

import math

import numpy as np
import pytest
import torch

from dhtorch.codes import Flag
from dhtorch.geometry import camera as cam
from dhtorch.records import Camera, Frame
from dhtorch.stages.backproject import backproject

HW, DEPTH_HW = (40, 56), (20, 28)
LUMA = np.array([0.299, 0.587, 0.114])


def picture(rng, hw=HW):
    """(3, H, W) in [0, 1] made of 8×8 tiles: texture, black, white, and highlights of many kinds in their middles."""
    image = rng.uniform(0.3, 0.7, (3, *hw))
    for v in range(0, hw[0], 8):
        for u in range(0, hw[1], 8):
            tile = image[:, v : v + 8, u : u + 8]
            kind = rng.integers(6)
            if kind == 0:
                tile *= rng.choice([0.05, 0.15])
            elif kind == 1:
                tile[:] = 0.94 + 0.06 * tile
            elif kind == 2:
                tile[:] = 0.99 + 0.01 * tile
            elif kind >= 4:
                tile[:] = rng.uniform(0.3, 0.98)
                tile[:, 4, 4] = rng.uniform(0.7, 1.0)
                tile[rng.integers(3), 4, 4] *= rng.uniform(0.7, 1.0)
    return image


def frames(depth_hw=DEPTH_HW, seed=0, dtype=torch.float64):
    """Two frames whose depth has steps, holes and values that are none, with a confidence map."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.0, 1.05, (2, *depth_hw)) * np.where(np.arange(depth_hw[1]) < depth_hw[1] // 2, 1.3, 2.0)
    depth[:, depth_hw[0] // 2 :] *= 1.12
    for odd in (0.0, np.nan, np.inf, -1.0):
        depth[rng.random(depth.shape) < 0.06] = odd
    depth[:, 3:9, 4:10] = 0.0
    camera = Camera(torch.tensor([[60.0, 63.0], [80.0, 77.0]]), torch.tensor([[27.0, 19.0], [30.0, 21.5]]))
    return Frame(
        image=torch.tensor(np.stack([picture(rng), picture(rng)])).to(dtype),
        depth=torch.tensor(depth).to(dtype),
        camera=camera.to(dtype),
        conf=torch.tensor(rng.integers(0, 3, depth.shape), dtype=torch.uint8),
    )


def everywhere(seed=1, n=120):
    """Pixels of two views, up to two outside of the picture, and the middles of all tiles."""
    rng = np.random.default_rng(seed)
    some = rng.uniform(-2, 1, (2, n, 2)) + rng.uniform(0, 1, (2, n, 2)) * np.array([HW[1] + 1, HW[0] + 1])
    v, u = np.mgrid[4 : HW[0] : 8, 4 : HW[1] : 8]
    middles = np.broadcast_to(np.stack([u.ravel(), v.ravel()], -1), (2, u.size, 2))
    return torch.tensor(np.concatenate([some, middles + 0.3], 1))


def window(x, centre, size):
    """Square (…, size, size) around a pixel (u, v), moved inside."""
    first = [min(max(c - size // 2, 0), n - size) for c, n in zip(centre, x.shape[:-3:-1], strict=True)]
    return x[..., first[1] : first[1] + size, first[0] : first[0] + size]


def plain(
    frame,
    uv,
    *,
    near_limit=math.inf,
    min_conf=1,
    sigma_m=0.0,
    sigma_rel=0.01,
    search_px=0,
    edge_rel=0.1,
    dark=0.05,
    saturated=0.99,
    highlight=0.85,
):
    """(depth, sigma, xyz, confidence, flag) of every sample, one after the other."""
    rows = []
    for b in range(len(uv)):
        image, depth = frame.image[b].numpy(), frame.depth[b].numpy()
        (h, w), (H, W) = depth.shape, image.shape[1:]
        returned = np.isfinite(depth) & (depth > 0)
        places = np.argwhere(returned).tolist()
        for u, v in uv[b].tolist():
            place = [(u + 0.5) * w / W - 0.5, (v + 0.5) * h / H - 0.5]
            at = [math.floor(x + 0.5) for x in place]
            around = window(np.where(returned, depth, np.nan), at, min(max(5, 2 * search_px + 1), h, w))
            reach = [
                ((x - at[0]) ** 2 + (y - at[1]) ** 2, y, x)
                for y, x in places
                if search_px and max(abs(x - at[0]), abs(y - at[1])) <= search_px
            ]
            x, y = min(reach)[:0:-1] if reach else at
            z = float(depth[y, x]) if 0 <= x < w and 0 <= y < h and returned[y, x] else 0.0
            level = int(frame.conf[b, y, x]) if 0 <= x < w and 0 <= y < h else 0
            at = [math.floor(u + 0.5), math.floor(v + 0.5)]
            patch = window(image, at, 5)
            mean, centre = LUMA @ patch.mean((1, 2)), patch[:, 2, 2]
            top, bottom = centre.max(), centre.min()
            shine = top - bottom <= 0.15 * top and LUMA @ centre >= highlight and LUMA @ centre - mean >= 0.1
            edge = z > 0 and np.nanmax(around) > np.nanmin(around) * (1 + edge_rel)
            bits = {
                Flag.NO_DEPTH: z == 0,
                Flag.LOW_CONF: z > 0 and level < min_conf,
                Flag.BEYOND_NEAR: z > near_limit,
                Flag.DEPTH_EDGE: edge,
                Flag.BORDER: not (2 <= at[0] <= W - 3 and 2 <= at[1] <= H - 3),
                Flag.UNDEREXPOSED: mean <= dark,
                Flag.SATURATED: mean >= saturated,
                Flag.SPECULAR: shine,
            }
            flag = sum(bit for bit, holds in bits.items() if holds)
            usable = not flag & (Flag.NO_DEPTH | Flag.LOW_CONF | Flag.BEYOND_NEAR)
            confidence = level / 2 * 0.5 ** (int(edge) + int(shine) + int(bits[Flag.SATURATED])) if usable else 0.0
            (fx, fy), (cx, cy) = frame.camera.f[b].tolist(), frame.camera.c[b].tolist()
            xyz = [(u - cx) / fx * z, (v - cy) / fy * z, z] if usable else [math.nan] * 3
            rows.append((z, math.sqrt(sigma_m**2 + (sigma_rel * z) ** 2), xyz, confidence, flag))
    return [torch.tensor(column, dtype=uv.dtype).unflatten(0, uv.shape[:2]) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"near_limit": 2.1},
        {"min_conf": 2},
        {"min_conf": 0},
        {"sigma_m": 0.03, "sigma_rel": 0.02},
        {"sigma_rel": 0.05},
        {"search_px": 1},
        {"search_px": 4, "near_limit": 2.1},
        {"edge_rel": 0.7},
        {"dark": 0.1, "saturated": 0.95},
        {"highlight": 0.6},
        {"rows": slice(5, 9)},  # a depth map smaller than the neighbourhood
    ],
)
def test_every_sample_equals_a_plain_loop(options):
    frame, uv = frames(), everywhere()
    if "rows" in options:
        frame, options = frame.replace(depth=frame.depth[:, 5:9], conf=frame.conf[:, 5:9]), {}
    found = backproject(frame, uv, **options)
    depth, sigma, xyz, confidence, flag = plain(frame, uv, **options)
    assert torch.equal(found.flag, flag.int())
    for name, expected in {"depth": depth, "sigma": sigma, "xyz": xyz, "confidence": confidence}.items():
        torch.testing.assert_close(getattr(found, name), expected, equal_nan=True, rtol=1e-12, atol=1e-12)
    assert torch.equal(found.uv, uv)
    assert (found.trackability == 0).all() and (found.hole == 0).all() and found.hole.dtype == torch.int32
    seen = {bit for bit in (1, 2, 4, 8, 16, 32, 128) if ((found.flag & bit) != 0).sum() >= 3}
    assert len(seen) >= 6 and len(found.confidence.unique()) >= 4


@pytest.mark.parametrize(("interleaved", "pixels"), [(False, 1 << 17), (True, 1 << 17), (False, 700)])
def test_all_pixels_at_once_have_the_bits_of_a_few(interleaved, pixels, monkeypatch):
    """So many are read from windows of the whole picture and map, some rows after the other; a few from patches."""
    monkeypatch.setattr("dhtorch.geometry.windows.MAX_BAND_PIXELS", pixels)
    frame = frames(dtype=torch.float32)
    image = (255 * frame.image).round().to(torch.uint8)
    frame = frame.replace(image=image.to(memory_format=torch.channels_last) if interleaved else image)
    v, u = torch.meshgrid(torch.arange(-2.0, HW[0] + 2), torch.arange(-2.0, HW[1] + 2), indexing="ij")
    uv = torch.cat([torch.stack([u, v], -1).reshape(-1, 2), everywhere()[0].float()])
    found = backproject(frame, uv)
    few = [backproject(frame, some) for some in uv.split(100)]  # of 560 and 2240 pixels
    for name in ("depth", "sigma", "xyz", "confidence", "flag"):
        parts = torch.cat([getattr(part, name) for part in few], 1)
        assert torch.equal(getattr(found, name).nan_to_num(-1), parts.nan_to_num(-1)), name
    assert all((found.flag & bit).any() for bit in (1, 2, 4, 8, 16, 32, 128))


def still(image=0.5, depth=1.5, hw=(16, 16), **changes):
    """A grey view of one value and one depth, exact in binary."""
    return Frame(
        image=torch.full((1, 1, *hw), image),
        depth=torch.full((1, *hw), depth),
        camera=Camera(torch.tensor([[16.0, 16.0]]), torch.tensor([[8.0, 8.0]])),
        **changes,
    )


GLINT = still(0.25)
GLINT.image[..., 8, 8] = 0.75
STEP = still()
STEP.depth[:, :, 9:] = 2.25
CONF = torch.full((1, 16, 16), 2, dtype=torch.uint8)
CONF[0, 8, 8] = 1
WHITE = still(1.0).image


def glint(rgb, around):
    """A pixel of three bytes on a grey surface."""
    image = torch.full((1, 3, 16, 16), around, dtype=torch.uint8)
    image[0, :, 8, 8] = torch.tensor(rgb, dtype=torch.uint8)
    return still().replace(image=image)


@pytest.mark.parametrize(
    ("frame", "options", "flag", "confidence"),
    [
        (still(), {}, 0, 1),
        # limits hold at the limit itself
        (still(), {"near_limit": 1.5}, 0, 1),
        (still(), {"near_limit": 1.49}, Flag.BEYOND_NEAR, 0),
        (still(), {"dark": 0.5}, Flag.UNDEREXPOSED, 1),
        (still(), {"dark": 0.499}, 0, 1),
        (still(), {"saturated": 0.5}, Flag.SATURATED, 0.5),
        (still(), {"saturated": 0.501}, 0, 1),
        (STEP, {"edge_rel": 0.5}, 0, 1),
        (STEP, {"edge_rel": 0.499}, Flag.DEPTH_EDGE, 0.5),
        (GLINT, {"highlight": 0.75}, Flag.SPECULAR, 0.5),
        (GLINT, {"highlight": 0.751}, 0, 1),
        (still(conf=CONF), {"min_conf": 1}, 0, 0.5),
        (still(conf=CONF), {"min_conf": 2}, Flag.LOW_CONF, 0),
        (still(conf=0 * CONF), {"min_conf": 0}, 0, 0),
        (STEP.replace(conf=0 * CONF), {}, Flag.LOW_CONF | Flag.DEPTH_EDGE, 0),
        # confidence is halved for every doubt
        (STEP.replace(conf=CONF), {}, Flag.DEPTH_EDGE, 0.25),
        (STEP.replace(image=WHITE, conf=CONF), {}, Flag.DEPTH_EDGE | Flag.SATURATED, 0.125),
        (STEP.replace(image=WHITE), {}, Flag.DEPTH_EDGE | Flag.SATURATED, 0.25),
        # grey 26 of 255 lies between 0.1 and 0.11 of white
        (still().replace(image=torch.full((1, 1, 16, 16), 26, dtype=torch.uint8)), {"dark": 0.11}, Flag.UNDEREXPOSED, 1),
        (still().replace(image=torch.full((1, 1, 16, 16), 26, dtype=torch.uint8)), {"dark": 0.1}, 0, 1),
        # a highlight has no colour (a channel that lacks 14 % passes) and outshines its surroundings by a tenth
        (glint((240, 240, 240), 200), {}, Flag.SPECULAR, 0.5),
        (glint((240, 240, 240), 214), {}, 0, 1),
        (glint((240, 240, 240), 213), {}, Flag.SPECULAR, 0.5),
        (glint((240, 240, 207), 180), {}, Flag.SPECULAR, 0.5),
        (glint((240, 240, 201), 180), {}, 0, 1),
        (glint((201, 240, 240), 180), {}, 0, 1),
    ],
)  # fmt: skip
def test_flags_and_confidence_at_the_limits(frame, options, flag, confidence):
    found = backproject(frame, torch.tensor([[8.0, 8.0]]), **options)
    assert (int(found.flag), float(found.confidence)) == (flag, confidence)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depth_of_half_precision_is_computed_with_as_pixels_are(dtype):
    frame = still(depth=1.1).replace(depth=torch.full((1, 16, 16), 1.1).half())
    uv = torch.tensor([[8.0, 8.0]], dtype=dtype)
    found = backproject(frame.replace(camera=frame.camera.to(dtype)), uv, sigma_rel=0.1)
    value = torch.tensor(1.1).half().to(dtype)
    assert found.depth.dtype == found.sigma.dtype == found.confidence.dtype == dtype
    assert found.depth[0, 0] == value and found.sigma[0, 0] == 0.1 * value


@pytest.mark.parametrize("search", [0, 1, 3, 4])
def test_pixels_outside_of_the_image_or_no_numbers_find_a_return_within_the_search_alone(search):
    nan, inf = math.nan, math.inf
    places = [
        [nan, nan],
        [nan, 5],
        [5, nan],
        [inf, 3],
        [3, -inf],
        [-40, 5],
        [5, 90],
        [-4, 5],
        [27, 5],
        [5, -4],
        [5, 19],
    ]
    found = backproject(still(hw=(16, 24)), torch.tensor([places]), search_px=search)
    none = torch.tensor([[True] * 7 + [search < 4] * 4])
    assert torch.equal(found.depth == 0, none) and torch.equal((found.flag & Flag.NO_DEPTH) != 0, none)
    assert found.xyz[none].isnan().all() and ((found.flag & Flag.BORDER) != 0).all()


def test_sparse_frames_are_searched_by_themselves():
    """Among returns at every seventh pixel, frame by frame; a radius holds for all."""
    H, W = HW
    depth = torch.zeros(2, H, W)
    depth[:, ::7, ::7] = 2.0
    camera = Camera(torch.full((2, 2), 30.0), torch.full((2, 2), 8.0))
    frame = Frame(torch.full((2, 1, H, W), 0.5), depth, camera, sparse=torch.tensor([True, False]))
    v, u = torch.meshgrid(torch.arange(12.0), torch.arange(15.0), indexing="ij")
    uv = torch.stack((u, v), -1).reshape(1, -1, 2).expand(2, -1, -1)
    found, wide, none = backproject(frame, uv), backproject(frame, uv, search_px=3), backproject(frame, uv, search_px=0)
    for field in ("depth", "flag", "confidence"):
        assert torch.equal(getattr(found, field)[0], getattr(wide, field)[0])
        assert torch.equal(getattr(found, field)[1], getattr(none, field)[1])
    assert (wide.depth == 2).all() and int((none.depth == 2).sum()) == 2 * 6 < int((found.depth == 2).sum())


def test_a_pixel_outside_of_the_lens_model_has_no_point():
    lens = Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[8.0, 8.0]]), torch.tensor([[-0.4, 0.0, 0.0, 0.0]]))
    uv = torch.tensor([[10.0, 12.0], [60.0, 60.0]])
    assert cam.undistort(lens, uv[None])[0, 1].isnan().all()
    found = backproject(still(hw=(64, 64)).replace(camera=lens), uv)
    assert found.usable.tolist() == [[True, False]] and found.confidence.tolist() == [[1, 0]]
    assert found.depth.tolist() == [[1.5, 1.5]]
    ray = cam.undistort(lens, uv[None])[0, 0] - 8
    torch.testing.assert_close(found.xyz[0, 0], torch.tensor([*(1.5 * ray / 30).tolist(), 1.5]))
