"""Affine registration against its point-by-point form, ``support/reference.py``: one window at a time, one regression a step."""

import math

import numpy as np
import pytest
import torch
from support import reference
from support.textures import places, waves

from dhtorch.geometry import affine_alignment
from dhtorch.geometry.pyramid import PyramidCache, build_pyramid
from dhtorch.records import TrackHint, Tracks
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine

H, W, WINDOW = 90, 106, 11
TURNED = [[1.03, 0.06], [-0.04, 0.96]]


def two_views(linear=TURNED, shift=(0.4, -0.7), gain=1.0, bias=0.0, noise=0.0, shortest=8.0):
    """Two pairs, the second image of each warped; different textures, noise and motion."""
    src, draw = waves(2, H, W, shortest=shortest), np.random.default_rng(5)
    dst = torch.cat(
        [
            waves(2, H, W, [s * x for x in shift], shortest=shortest, linear=linear)[k : k + 1]
            for k, s in enumerate((1, -1))
        ]
    )
    src, dst = (y + noise * torch.from_numpy(draw.standard_normal(y.shape)) for y in (src, dst))
    return src, gain * dst + bias


def pyramids(src, dst, n=2, window=WINDOW):
    return build_pyramid(src, n, window), build_pyramid(dst, n, window, gradients=False)


def by_hand(src, dst, uv, uv_1, steps=7, epsilon=0.01, max_shift=2.0, n_levels=2, window=WINDOW):
    """Registrations (B, N) by the slow search."""
    options = {"window": window, "iterations": steps, "epsilon_px": epsilon, "max_shift_px": max_shift}
    rows = []
    for b in range(len(uv)):
        here, there = reference.levels(src[b], 1, window), reference.levels(dst[b], n_levels, window)
        rows += [reference.register(here, there, x, x_1, **options) for x, x_1 in zip(uv[b], uv_1[b], strict=True)]
    shaped = [np.array([np.asarray(x) for x in c]) for c in zip(*rows, strict=True)]
    return [c.reshape(*uv.shape[:2], *c.shape[1:]) for c in shaped]


def agrees(found, expected, rtol=1e-6):
    for name, want in zip(found._fields, expected, strict=True):
        have = getattr(found, name).numpy()
        if name == "ok":
            assert (have == want).all()
        else:
            np.testing.assert_allclose(have, want, rtol=rtol, atol=1e-8, err_msg=name)


def near(uv, linear=TURNED, shift=(0.4, -0.7), spread=0.4, seed=3):
    """Starts about where the windows are."""
    middle = torch.tensor([(W - 1) / 2, (H - 1) / 2], dtype=uv.dtype)
    A, t = torch.tensor(linear, dtype=uv.dtype), torch.tensor([shift, [-s for s in shift]], dtype=uv.dtype)
    away = torch.from_numpy(np.random.default_rng(seed).uniform(-spread, spread, uv.shape))
    return (uv - middle) @ A.T + middle + t[:, None] + away


# --- what is found ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 6])
def test_every_step_is_the_regression_of_one_window(steps):
    src, dst = two_views(noise=0.01)
    uv = places(2, 6, H, W, margin=14)
    found = affine_alignment.register_affine(
        *pyramids(src, dst), uv, near(uv), window=WINDOW, iterations=steps, epsilon_px=0.0
    )
    expected = by_hand(src, dst, uv, near(uv), steps, 0.0)
    agrees(found, expected)
    assert expected[-1].mean() > 0.8 or not steps


@pytest.mark.parametrize(("gain", "bias"), [(1.6, -0.3), (0.5, 0.2), (0.21, 0.0), (0.19, 0.0), (4.8, 0.1), (5.3, 0.0)])
def test_contrast_is_taken_out_and_not_believed_beyond_five_times(gain, bias):
    src, dst = two_views(gain=gain, bias=bias)
    uv = places(2, 6, H, W, margin=14)
    expected = by_hand(src, dst, uv, near(uv))
    agrees(affine_alignment.register_affine(*pyramids(src, dst), uv, near(uv), window=WINDOW), expected)
    assert expected[-1].mean() > 0.8 if 0.2 < gain < 5 else expected[-1].mean() < 0.5


@pytest.mark.parametrize("epsilon", [0.002, 0.03, 0.3])
def test_a_step_that_moves_no_corner_further_than_epsilon_is_the_last(epsilon):
    src, dst = two_views(noise=0.02, shortest=6.0)
    uv = places(2, 8, H, W, margin=14)
    options = {"window": WINDOW, "iterations": 12, "epsilon_px": epsilon}
    agrees(
        affine_alignment.register_affine(*pyramids(src, dst), uv, near(uv), **options),
        by_hand(src, dst, uv, near(uv), 12, epsilon),
    )


@pytest.mark.parametrize(("scale", "n_levels"), [(1.9, 2), (1.9, 1), (2.7, 2), (0.55, 2), (0.35, 2)])
def test_magnified_windows_are_read_from_the_half_size_level_and_extreme_ones_not_believed(scale, n_levels):
    src, dst = two_views([[scale, 0.1], [-0.1, scale]], (0.3, 0.2), shortest=14.0)
    uv = torch.tensor([[[52.0, 44.0], [53.3, 45.2], [50.4, 43.6], [54.9, 46.0], [51.1, 46.8]]] * 2, dtype=torch.float64)
    start = near(uv, [[scale, 0.1], [-0.1, scale]], (0.3, 0.2), spread=0.2)
    options = {"window": WINDOW, "iterations": 12, "max_shift_px": 3.0}
    found = affine_alignment.register_affine(*pyramids(src, dst, n_levels), uv, start, **options)
    expected = by_hand(src, dst, uv, start, 12, max_shift=3.0, n_levels=n_levels)
    agrees(found, expected, rtol=1e-5)


def test_a_search_that_ends_too_far_or_worse_or_outside_keeps_its_start():
    src, dst = two_views(noise=0.03)
    uv = torch.cat([places(2, 20, H, W, margin=14), places(2, 10, H, W, margin=1, seed=8)], 1)
    start = near(uv, spread=5.0)
    seen = set()
    for limit in (0.5, 2.0, 50.0):
        found = affine_alignment.register_affine(*pyramids(src, dst), uv, start, window=WINDOW, max_shift_px=limit)
        expected = by_hand(src, dst, uv, start, max_shift=limit)
        agrees(found, expected, rtol=1e-3)  # where a search runs away, every rounding counts
        ok = found.ok
        assert (found.shift_px[ok] <= limit).all() and torch.equal(found.uv_1[~ok], start[~ok])
        assert (found.linear[~ok] == torch.eye(2)).all()
        seen.add(int(ok.sum()))
    assert len(seen) == 3


@pytest.mark.parametrize("window", [5, 9])
@pytest.mark.parametrize(("noise", "contrast"), [(0.0, 1.0), (0.05, 0.3), (0.02, 0.02)])
def test_the_covariance_in_windows_of_little_texture_and_much_noise(window, noise, contrast):
    """No residual below that of 8-bit rounding is believed, and at most nine tenths of the texture taken for noise."""
    src, dst = two_views(noise=noise / contrast)
    src, dst = 0.5 + contrast * (src - 0.5), 0.5 + contrast * (dst - 0.5)
    uv = places(2, 8, H, W, margin=14)
    found = affine_alignment.register_affine(
        *pyramids(src, dst, 1, window), uv, near(uv), window=window, iterations=2, epsilon_px=0.0
    )
    agrees(found, by_hand(src, dst, uv, near(uv), 2, 0.0, n_levels=1, window=window), rtol=1e-5)
    assert torch.linalg.eigvalsh(found.cov).min() > 0


def test_nothing_is_found_without_texture_and_of_points_that_are_not_wanted():
    src, dst = two_views()
    src[0, :, :, 60:] = 0.3
    uv = places(2, 12, H, W, margin=14)
    start, views = near(uv), pyramids(src, dst)
    found = affine_alignment.register_affine(*views, uv, start, window=WINDOW)
    flat = torch.zeros(2, 12, dtype=torch.bool)
    flat[0] = uv[0, :, 0] > 67
    assert flat.sum() > 2 and not found.ok[flat].any() and found.ok[1].float().mean() > 0.8
    wanted = torch.arange(12) % 3 == torch.tensor([[0], [1]])
    some = affine_alignment.register_affine(*views, uv, start, wanted=wanted, window=WINDOW)
    assert torch.equal(some.ok, found.ok & wanted) and torch.equal(some.uv_1[~wanted], start[~wanted])
    for name in found._fields:
        assert torch.equal(getattr(some, name)[wanted], getattr(found, name)[wanted]), name


# --- one more step ---------------------------------------------------------------------------------------------------


def test_the_differentiable_step_is_one_regression_from_where_it_is_put():
    src, dst = two_views(gain=1.2, bias=-0.1)
    uv = places(2, 6, H, W, margin=14)
    uv_1 = near(uv)
    linear = torch.eye(2, dtype=uv.dtype) + 0.1 * (
        torch.from_numpy(np.random.default_rng(2).random((2, 6, 2, 2))) - 0.5
    )
    source, target = pyramids(src, dst, 1)
    found = affine_alignment.registration_step(source, target, uv, uv_1, linear, window=WINDOW)
    for b in range(2):
        here, there = (reference.levels(image[b], 1, WINDOW)[0] for image in (src, dst))
        for n in range(6):
            want = reference.register_step(here, there, uv[b, n], uv_1[b, n], linear[b, n], window=WINDOW)
            np.testing.assert_allclose(found[b, n].numpy(), want.numpy(), atol=1e-8)


def test_a_step_leaves_what_it_cannot_move():
    src, dst = two_views()
    src[:, :, :30] = 0.5
    place = torch.tensor([[60.0, 12.0], [60, 60], [-0.6, 60], [60, 60], [math.nan, 60], [60, 60]]).double()
    place_1 = torch.tensor([[61.0, 12.0], [61, 60], [50, 60], [W, 60], [62, 60], [61, 60]]).double()
    linear = torch.eye(2).double().repeat(2, 6, 1, 1)
    linear[:, 5, 0, 1] = math.nan
    uv, uv_1 = place.expand(2, -1, -1), place_1.expand(2, -1, -1)
    found = affine_alignment.registration_step(*pyramids(src, dst, 1), uv, uv_1, linear, window=WINDOW)
    moved = (found != uv_1).any(-1)
    assert found.isfinite().all()
    assert moved[:, [0, 1]].tolist() == [[False, True]] * 2
    assert not moved[:, 5].any()


# --- as a stage ------------------------------------------------------------------------------------------------------


def given(uv, uv_1, valid):
    """A search that finds what it is told to, with numbers that can be told apart."""
    number = torch.arange(float(uv[..., 0].numel()), dtype=uv.dtype).view(uv.shape[:2])
    cov = (5 + number)[..., None, None] * torch.eye(2, dtype=uv.dtype)
    tracks = Tracks(uv_0=uv, uv_1=uv_1, error=0.1 * number, photometric=3 + number, cov=cov, valid=valid)
    return lambda *_, **__: tracks


@pytest.mark.parametrize("linear", [TURNED, [[1.9, 0.1], [-0.1, 1.9]]])
@pytest.mark.parametrize("made", [False, True])
def test_valid_tracks_are_registered_and_rejected_ones_say_how_far_they_went(linear, made):
    big = linear is not TURNED
    src, dst = two_views(linear, (0.3, 0.2), shortest=14.0 if big else 8.0, noise=0.01)
    uv = places(2, 10, H, W, margin=40 if big else 14)
    start = near(uv, linear, (0.3, 0.2), spread=0.3 if big else 1.2)
    valid = torch.arange(20).view(2, 10) % 4 != 1
    options = {"window": WINDOW, "iterations": 9, "epsilon_px": 0.05, "max_shift_px": 0.9}
    images = (torch.zeros_like(src) if made else src, dst)
    extra = {"hint": TrackHint(pyramid=PyramidCache(src))} if made else {}
    tracks = lucas_kanade_affine(*images, uv, track=given(uv, start, valid), **options, **extra)
    found, _, rms, cov, shift, ok = (torch.from_numpy(x) for x in by_hand(src, dst, uv, start, 9, 0.05, 0.9))
    old = given(uv, start, valid)()
    error = torch.where(valid & ~ok, torch.maximum(old.error, shift.clamp(max=0.9)), old.error)
    want = {"uv_1": torch.where((valid & ok)[..., None], found, start), "error": error}
    want |= {
        "photometric": torch.where(valid, rms, old.photometric),
        "cov": torch.where(valid[..., None, None], cov, old.cov),
    }
    for name, value in want.items():
        torch.testing.assert_close(getattr(tracks, name), value, rtol=1e-5, atol=1e-7)
    assert torch.equal(tracks.valid, valid) and torch.equal(tracks.uv_0, uv)
    assert (valid & ok).sum() > 2 and (error > old.error).any() and (valid & ~ok & (error == old.error)).any()


def test_the_search_before_it_is_given_the_start_the_pyramid_and_the_levels():
    src, dst = two_views()
    uv, seen = places(2, 5, H, W, margin=14), []

    def track(*images, **options):
        seen.append((*images, options))
        return lucas_kanade(*images, **options)

    made = PyramidCache(src)
    run = lambda **options: lucas_kanade_affine(src, dst, uv, track=track, **options)  # noqa: E731
    run(hint=TrackHint(uv + 1, made), window=WINDOW, levels=2)
    run(hint=TrackHint(levels=1), levels=3)
    run()
    (a, b, x, first), (*_, second), (*_, usual) = seen
    assert a is src and b is dst and x is uv and set(first) == {"hint"}
    assert torch.equal(first["hint"].start, uv + 1) and first["hint"].pyramid is made and first["hint"].levels == 2
    assert second["hint"].levels == 1 and torch.equal(second["hint"].pyramid.image, src)
    assert usual["hint"].levels == 4 and usual["hint"].start is None


def test_the_usual_registration_takes_seven_steps_of_a_window_of_21_px_and_2_px_at_most():
    src, dst = two_views(noise=0.02, shortest=6.0)
    uv = places(2, 16, H, W, margin=22)
    start = near(uv, spread=1.8)
    sure = torch.ones(2, 16, dtype=torch.bool)
    usual = lucas_kanade_affine(src, dst, uv, track=given(uv, start, sure))
    plain = affine_alignment.register_affine(*pyramids(src, dst, 2, 21), uv, start)
    expected = by_hand(src, dst, uv, start, 7, 0.01, 2.0, window=21)
    agrees(plain, expected, rtol=1e-5)
    np.testing.assert_allclose(usual.uv_1.numpy(), expected[0], rtol=1e-6)
    assert 0 < expected[-1].mean() < 1 and (expected[-2] > 1.8).any() and (expected[-2] < 2).any()


def test_only_valid_tracks_have_a_derivative():
    src, dst = two_views()
    uv = places(2, 6, H, W, margin=14).requires_grad_()
    valid = torch.arange(12).view(2, 6) % 2 == 0
    options = {"track": given(uv.detach(), near(uv.detach()), valid), "window": WINDOW}
    for leaf, call in (
        (uv, lambda: lucas_kanade_affine(src, dst, uv, **options)),
        (src, lambda: lucas_kanade_affine(src.requires_grad_(), dst, uv.detach(), **options)),
        (dst, lambda: lucas_kanade_affine(src.detach(), dst.requires_grad_(), uv.detach(), **options)),
    ):
        tracks = call()
        assert not tracks.cov.requires_grad and not tracks.error.requires_grad
        for keep, some in ((valid, True), (~valid, False)):
            (slope,) = torch.autograd.grad(tracks.uv_1[keep].sum(), leaf, retain_graph=True, allow_unused=True)
            assert bool((slope != 0).any()) == some
        linear = affine_alignment.register_affine(
            *pyramids(src, dst), uv.detach(), options["track"]().uv_1, window=WINDOW
        ).linear
        again = affine_alignment.registration_step(
            *pyramids(src, dst, 1), leaf if leaf is uv else uv.detach(), tracks.uv_1, linear, window=WINDOW
        )
        (want,) = torch.autograd.grad(again[valid].sum(), leaf)
        (slope,) = torch.autograd.grad(tracks.uv_1[valid].sum(), leaf, retain_graph=True)
        torch.testing.assert_close(slope, want, rtol=1e-6, atol=1e-9)
        with torch.no_grad():
            assert torch.equal(call().uv_1, tracks.uv_1) and not call().uv_1.requires_grad


def test_a_picture_that_only_changes_along_rows_determines_no_motion():
    row = 0.5 + 0.3 * torch.sin(torch.arange(W, dtype=torch.float64) / 3)
    src = row.expand(2, 1, H, W).contiguous()
    uv = places(2, 6, H, W, margin=14)
    views, still = pyramids(src, src.roll(1, 3), 1), torch.eye(2, dtype=uv.dtype).expand(2, 6, 2, 2)
    assert torch.equal(affine_alignment.registration_step(*views, uv, uv + 0.3, still, window=WINDOW), uv + 0.3)
    assert not affine_alignment.register_affine(*views, uv, uv + 0.3, window=WINDOW).ok.any()


def test_a_search_that_ends_with_more_noise_than_it_began_with_is_rejected():
    """One step from far away, or in another picture, often makes it worse."""
    src, dst = two_views()
    uv = places(2, 20, H, W, margin=14)
    start = near(uv, spread=4.0)
    options = {"iterations": 1, "epsilon_px": 0.0, "max_shift_px": 50.0}
    for image in (dst, waves(2, H, W, seed=9)):
        found = affine_alignment.register_affine(*pyramids(src, image), uv, start, window=WINDOW, **options)
        agrees(found, by_hand(src, image, uv, start, 1, 0.0, 50.0), rtol=1e-5)


def test_a_search_that_ends_outside_is_rejected_however_well_it_fits():
    """Image 1 goes on beyond its border as its mirror image does."""
    draw = np.random.default_rng(4)
    length, phase, turn = (x[:, None, None] for x in (draw.uniform(9, 30, 15), *draw.uniform(0, 6, (2, 15))))
    v, u = np.mgrid[:H, :W].astype(float)

    def picture(u):
        waves = np.cos(2 * np.pi / length * np.cos(turn) * u) * np.cos(2 * np.pi / length * np.sin(turn) * v + phase)
        return torch.from_numpy(0.5 + 0.1 * waves.sum(0))[None, None]

    uv = torch.tensor([[[7.0, 30.0], [7.0, 45.0], [7.0, 60.0], [9.0, 30.0], [9.0, 45.0], [9.0, 60.0]]]).double()
    truth = uv - torch.tensor([7.9, 0.0])
    found = affine_alignment.register_affine(
        *pyramids(picture(u - 7.9), picture(u)), uv, truth + torch.tensor([0.6, 0.0]), window=WINDOW
    )
    assert found.ok.tolist() == [[False] * 3 + [True] * 3]
    assert (found.shift_px - 0.6).abs().max() < 0.05, "rejected or not, it went there"
