"""How closely the fast searches and their slow twins agree, and the twins' own ground: OpenCV's levels, plain slices."""

import numpy as np
import pytest
import torch
from support import reference
from support.textures import levels, places, waves

from dhtorch.geometry import affine_alignment, patches
from dhtorch.geometry.pyramid import build_pyramid
from dhtorch.records import TrackHint
from dhtorch.stages.track import lucas_kanade, refine_tracks

H, W, WINDOW = 90, 106, 11


def picture(seed=0, channels=1):
    return waves(channels, H, W, seed=seed)[:, 0]


@pytest.mark.parametrize("window", [5, 11])
def test_levels_are_opencvs(window):
    """Binomial halves, Scharr's slopes, the mirror image beyond the border."""
    ours, theirs = reference.levels(picture(), 3, window), levels(picture(), 3, window)
    for a, b in zip(ours, theirs, strict=True):
        assert a.hw == (b.H, b.W) and a.pad == b.pad
        np.testing.assert_allclose(a.planes.numpy(), np.stack(b.planes), atol=1e-13)
        for plane in range(3):
            at = places(1, 30, b.H, b.W, margin=-20)[0]
            np.testing.assert_allclose(a.read(plane, at.T).numpy(), b.read(plane, *at.T.numpy()), atol=1e-13)
            x = torch.tensor([7.3, 12.8]).double()
            np.testing.assert_allclose(a.window(plane, x, 5).numpy(), b.window(plane, x.numpy(), 5), atol=1e-13)


def test_levels_are_those_of_the_fast_pyramid():
    image = picture(channels=3)
    fast = build_pyramid(image[None], 3, WINDOW)
    for a, b in zip(reference.levels(image, 3, WINDOW), fast.levels, strict=True):
        torch.testing.assert_close(a.planes, b[0], atol=1e-13, rtol=0)
    grey = (255 * image).byte()
    torch.testing.assert_close(
        reference.levels(grey, 1, 5)[0].planes[0].float(), build_pyramid(grey[None], 1, 5).levels[0][0, 0]
    )


@pytest.mark.parametrize("normalise", ["none", "bias", "gain_bias"])
@pytest.mark.parametrize("given", [False, True])
def test_tracks_agree_to_rounding(normalise, given):
    """The usual options; where a search never left its maps. Measured: 5e-14 px, and 7e-6 px in float32."""
    src, dst = waves(1, H, W, shortest=9.0), waves(1, H, W, (1.6, -1.1), shortest=9.0)
    uv = places(1, 12, H, W, margin=8)
    start = uv + torch.tensor([1.2, -0.6]).double()
    options = {"window": WINDOW, "levels": 3, "normalise": normalise}
    fast = lucas_kanade(src, dst, uv, hint=TrackHint(start=start if given else None), **options)
    views = [reference.levels(image[0], 3, WINDOW) for image in (src, dst)]
    o = reference.Options(WINDOW, normalise=normalise)
    slow = [
        reference.lucas_kanade(*views, x, o, start=s if given else None) for x, s in zip(uv[0], start[0], strict=True)
    ]
    stayed = torch.tensor([t.stayed for t in slow])
    assert stayed.float().mean() > 0.7
    torch.testing.assert_close(fast.uv_1[0][stayed], torch.stack([t.uv_1 for t in slow])[stayed], rtol=0, atol=1e-12)
    torch.testing.assert_close(fast.cov[0][stayed], torch.stack([t.cov for t in slow])[stayed], rtol=1e-7, atol=0)
    assert fast.valid[0][stayed].tolist() == [t.valid for t in slow if t.stayed] and fast.valid.float().mean() > 0.7
    single = lucas_kanade(
        src.float(), dst.float(), uv.float(), hint=TrackHint(start=start.float() if given else None), **options
    )
    apart = (single.uv_1[0] - torch.stack([t.uv_1 for t in slow])).abs()[stayed & single.valid[0]]
    assert apart.max() < 2e-5
    # One step from where any search ended is the same step, whatever way led there.
    again = refine_tracks(src, dst, uv, fast.uv_1, window=WINDOW, normalise=normalise)
    for n, (x, x_1) in enumerate(zip(uv[0], fast.uv_1[0], strict=True)):
        step = reference.one_step(views[1][0], x_1, *reference.template(views[0][0], x, o), o)
        torch.testing.assert_close(again[0, n], x_1 - step, rtol=0, atol=1e-12)


def test_registrations_agree_to_rounding():
    """Measured: 2e-14 px, and 1.1e-5 px in float32."""
    turned = [[1.03, 0.06], [-0.04, 0.96]]
    src, dst = waves(1, H, W), 1.3 * waves(1, H, W, (0.4, -0.7), linear=turned) - 0.1
    uv = places(1, 12, H, W, margin=14)
    middle = torch.tensor([(W - 1) / 2, (H - 1) / 2]).double()
    start = (uv - middle) @ torch.tensor(turned).double().T + middle + torch.tensor([0.6, -0.5]).double()
    source, target = build_pyramid(src, 2, WINDOW), build_pyramid(dst, 2, WINDOW, gradients=False)
    fast = affine_alignment.register_affine(source, target, uv, start, window=WINDOW)
    here, there = reference.levels(src[0], 1, WINDOW), reference.levels(dst[0], 2, WINDOW)
    slow = [reference.register(here, there, x, s, window=WINDOW) for x, s in zip(uv[0], start[0], strict=True)]
    assert fast.ok[0].tolist() == [t.ok for t in slow] and fast.ok.float().mean() > 0.7
    torch.testing.assert_close(fast.uv_1[0], torch.stack([t.uv_1 for t in slow]), rtol=0, atol=1e-12)
    torch.testing.assert_close(fast.linear[0], torch.stack([t.linear for t in slow]), rtol=0, atol=1e-12)
    torch.testing.assert_close(fast.cov[0], torch.stack([t.cov for t in slow]), rtol=1e-5, atol=0)
    single = affine_alignment.register_affine(
        *(build_pyramid(y.float(), 2, WINDOW) for y in (src, dst)), uv.float(), start.float(), window=WINDOW
    )
    assert (single.uv_1[0] - torch.stack([t.uv_1 for t in slow])).abs().max() < 3e-5


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_patches_agree_bit_for_bit_and_grey_values_to_the_last_bit(dtype):
    image = (picture(channels=3).clamp(0, 1) * 255).byte()
    image = image if dtype == torch.uint8 else image.float() / 255
    uv = places(1, 40, H, W, margin=-4)
    pixel = patches.containing_pixels(uv)
    seen = patches.reduce_patches(image[None], pixel, 5, lambda p: (p.float().amax((0, 1, 2)), p[1, 0, 3].float()))
    corners = patches.extract_patches(image[None], pixel - 2, 5)
    for n, (u, v) in enumerate(pixel[0].tolist()):
        want = reference.patch(image, (u, v), 5)
        assert torch.equal(corners[0, n], want)
        assert (seen[0][0, n], seen[1][0, n]) == (want.max().float(), want[1, 0, 3].float())
    torch.testing.assert_close(patches.luma(image, 0), reference.luma(image), atol=2e-7, rtol=0)
    value, inside = patches.sample_nearest(image[:1].float(), uv)
    for n, x in enumerate(uv[0]):
        want, exists = reference.nearest(image[0].float(), x)
        assert value[0, n] == want and bool(inside[0, n]) == exists


def test_a_round_trip_of_the_limit_or_more_is_not_believed():
    src, dst = waves(1, H, W, shortest=6.0), waves(1, H, W, (2.0, -1.3), shortest=6.0)
    views = [reference.levels(image[0], 2, WINDOW) for image in (src, dst)]
    o = reference.Options(WINDOW, iterations=2, epsilon_px=0.0)
    found = [reference.lucas_kanade(*views, x, o, max_round_trip_px=9.0) for x in places(1, 12, H, W, margin=12)[0]]
    known = [
        (t, x) for t, x in zip(found, places(1, 12, H, W, margin=12)[0], strict=True) if t.valid and t.error > 1e-6
    ]
    assert len(known) > 5
    for track, x in known:
        for limit, valid in ((0.6 * track.error, False), (track.error, False), (1.01 * track.error, True)):
            again = reference.lucas_kanade(*views, x, o, max_round_trip_px=limit)
            assert again.valid is valid and again.error == track.error


def test_points_beside_the_border_of_a_cell_share_the_search_of_their_own():
    """Cells are 16 px wide on level 2 and begin half a pixel before the first pixel's middle."""
    src, dst = waves(1, H, W), waves(1, H, W, (0.6, -0.4))
    uv = torch.tensor([[[15.3, 40.0], [15.7, 40.0], [40.0, 31.2], [40.0, 31.8], [47.6, 47.6]]]).double()
    fast = lucas_kanade(src, dst, uv, window=WINDOW, levels=3, iterations=1, epsilon_px=0.0)
    views = [reference.levels(image[0], 3, WINDOW) for image in (src, dst)]
    slow = [reference.lucas_kanade(*views, x, reference.Options(WINDOW, 1, 0.0)) for x in uv[0]]
    assert all(t.stayed for t in slow)
    torch.testing.assert_close(fast.uv_1[0], torch.stack([t.uv_1 for t in slow]), rtol=0, atol=1e-12)


def test_a_window_needs_more_texture_than_the_limit_times_its_pixels():
    (level,) = reference.levels(picture(), 1, WINDOW)
    x, still = torch.tensor([50.0, 40.0]).double(), torch.zeros(2).double()
    g, _ = reference.template(level, x, reference.Options(WINDOW))
    texture = float(torch.linalg.eigvalsh(g @ g.T)[0]) / WINDOW**2
    for limit, found in ((0.999 * texture, True), (1.001 * texture, False)):
        o = reference.Options(WINDOW, min_eigenvalue=limit)
        assert reference.search([level], [level], x, still, o, alike=True).valid is found


def test_half_a_pixel_around_the_outermost_ones_belongs_to_a_picture():
    for u, v in ((-0.5, 3.0), (9.5, 3.0), (4.0, -0.5), (4.0, 6.5)):
        step = 1e-9 * torch.tensor([u - 4.5, v - 3.0]).double().sign()
        at = torch.tensor([u, v]).double()
        assert reference.within(at, (7, 10)) and not reference.within(at + step, (7, 10))
