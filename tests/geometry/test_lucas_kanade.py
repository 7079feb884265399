"""Lucas-Kanade on textures with an exact motion; one step against linear regression on windows that OpenCV made.

Kernel and torch reference, which are two implementations of the search, are compared in tests/ops/test_operators.py.
"""

import math

import cv2
import numpy as np
import pytest
import torch
from support.textures import levels, places, waves

from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.pyramid import build_pyramid
from dhtorch.records import TrackHint
from dhtorch.stages.track import MIN_TRACK_EIGENVALUE, lucas_kanade, refine_tracks

H, W, WINDOW = 100, 122, 7
FIELDS = ("uv_1", "error", "photometric", "cov", "valid")
NORMALISE = ("none", "bias", "gain_bias")
OPTIONS = {"window": WINDOW, "levels": 3, "iterations": 3, "epsilon_px": 0.0, "normalise": "none"}
WIDE = {"max_round_trip_px": 1e9}


def two_views(shift=(1.3, -0.9), gain=1.0, bias=0.0, shortest=9.0):
    """Two pairs that move apart."""
    src = waves(2, H, W, shortest=shortest)
    moved = [waves(2, H, W, [s * x for x in shift], shortest=shortest)[k : k + 1] for k, s in enumerate((1, -1))]
    return src, gain * torch.cat(moved) + bias


def texture(image, x, normalise="none"):
    """Smaller eigenvalue per pixel of the gradients' products in a window, of what the normalisation leaves."""
    (level,) = levels(image, 1, WINDOW)
    g, T = np.stack([level.window(k, x, WINDOW) for k in (1, 2)]), level.window(0, x, WINDOW)
    free = np.stack([np.ones_like(T), T][: NORMALISE.index(normalise)], 1) if normalise != "none" else T[:, None] * 0
    g = g - (free @ np.linalg.lstsq(free, g.T, rcond=None)[0]).T
    return np.linalg.eigvalsh(g @ g.T)[0] / WINDOW**2


# --- the search ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shift", "gain", "bias", "start", "options"),
    [
        ((0.6, -0.5), 1.0, 0.0, None, {"levels": 1}),
        ((1.3, -0.9), 1.0, 0.0, None, {"levels": 2}),
        ((4.3, -3.9), 1.0, 0.0, None, {"levels": 3}),
        ((6.3, -5.2), 1.0, 0.0, None, {"levels": 4, "window": 13}),
        ((1.3, -0.9), 1.0, 0.0, None, {"levels": 2, "window": 5}),
        ((1.3, -0.9), 1.0, 0.0, None, {"levels": 2, "window": 31}),
        ((0.6, -0.5), 1.0, 0.3, None, {"levels": 2, "normalise": "bias"}),
        ((0.6, -0.5), 1.4, -0.2, None, {"levels": 2, "normalise": "gain_bias"}),
        ((0.6, -0.5), 4.5, 0.3, None, {"levels": 2, "normalise": "gain_bias"}),
        ((0.6, -0.5), 0.25, 0.4, None, {"levels": 2, "normalise": "gain_bias"}),
        ((5.0, -5.5), 1.0, 0.0, (4.4, -5.9), {"levels": 1}),
    ],
)
def test_an_exact_motion_is_found(shift, gain, bias, start, options):
    src, dst = (x[:1] for x in two_views(shift, gain, bias, shortest=20.0))
    uv = places(1, 40, H, W, margin=24)
    hint = TrackHint(start=None if start is None else uv + torch.tensor(start).double())
    found = lucas_kanade(
        src, dst, uv, hint=hint, **OPTIONS | {"iterations": 24, "epsilon_px": 1e-4, "window": 13} | options
    )
    miss = (found.uv_1 - uv - torch.tensor(shift).double()).norm(dim=-1)[found.valid]
    assert found.valid.float().mean() > 0.8 and miss.median() < 0.02 and miss.max() < 0.1
    assert (found.photometric[found.valid] / gain).max() < 0.01 and found.error[found.valid].max() < 0.05


def test_more_steps_are_taken_only_where_needed():
    src, dst = two_views()
    uv = places(2, 12, H, W, margin=12)
    run = lambda **options: lucas_kanade(src, dst, uv, **OPTIONS | options).uv_1  # noqa: E731
    eight = run(iterations=8)
    assert (run(iterations=2) - eight).abs().max() > 1e-3 and not torch.equal(run(iterations=9), eight)
    assert torch.equal(run(iterations=40, epsilon_px=9.0), run(iterations=8, epsilon_px=9.0)), "at rest after one map"


def test_the_last_cell_holds_the_borders_points():
    """Also where the image is whole cells of 4 px of level 2 wide and high."""
    src, dst = waves(2, 96, 112), waves(2, 96, 112, (0.3, -0.2))
    corner = torch.tensor([[111.5, 95.5], [111.5, 40.0], [50.0, 95.5]], dtype=torch.float64).expand(2, -1, -1)
    at, inside = (lucas_kanade(src, dst, uv, **OPTIONS).uv_1 - uv for uv in (corner, corner - 1e-6))
    torch.testing.assert_close(at, inside, atol=1e-4, rtol=0)


# --- what is valid ---------------------------------------------------------------------------------------------------


def test_a_track_is_valid_below_the_limit_of_its_round_trip():
    src, dst = two_views((2.0, -1.3), shortest=6.0)
    uv = places(2, 30, H, W, margin=12)
    options = OPTIONS | {"iterations": 2}
    wide = lucas_kanade(src, dst, uv, **options, **WIDE)
    limit = wide.error[wide.valid].sort().values[20].item()
    narrow = lucas_kanade(src, dst, uv, **options, max_round_trip_px=limit)
    assert torch.equal(narrow.valid, wide.valid & (wide.error < limit)) and narrow.valid.sum() == 20
    assert all(torch.equal(getattr(narrow, f), getattr(wide, f)) for f in FIELDS if f != "valid")
    assert torch.equal(lucas_kanade(src, dst, uv, **options).valid, wide.valid & (wide.error < 1.0)), "1 px"
    back = lucas_kanade(dst, src, wide.uv_1, **options)
    torch.testing.assert_close(wide.error[wide.valid], (back.uv_1 - uv).norm(dim=-1)[wide.valid], atol=1e-7, rtol=0)


@pytest.mark.parametrize("normalise", NORMALISE)
def test_windows_need_more_texture_than_the_limit_in_both_images(normalise):
    src, dst = two_views((0.4, 0.3))
    fade = torch.linspace(0.02, 1, W, dtype=torch.float64)
    src, dst = 0.5 + fade * (src - 0.5), 0.5 + fade.flip(0) * (dst - 0.5)
    uv = places(2, 25, H, W, margin=12)
    options = OPTIONS | {"normalise": normalise, "levels": 1, "iterations": 1}
    every = lucas_kanade(src, dst, uv, **options, **WIDE, min_eigenvalue=0.0)
    here, there = (
        np.array([[texture(x, y.numpy(), normalise) for y in pair] for x, pair in zip(image, at, strict=True)])
        for image, at in ((src, uv), (dst, every.uv_1))
    )
    limit = float(np.median(np.minimum(here, there)))
    found = lucas_kanade(src, dst, uv, **options, **WIDE, min_eigenvalue=limit)
    enough = (here > limit) & (there > limit)
    assert (found.valid.numpy() == (enough & every.valid.numpy())).all() and 5 < found.valid.sum() < 30
    still = torch.from_numpy(here <= limit)
    assert torch.equal(found.uv_1[still], uv[still]), "without texture no step"


def test_a_window_that_still_runs_is_lost():
    """Long waves, 11 px apart: one map of 2 px is left at once, four maps suffice."""
    src, dst = waves(2, H, W, shortest=45.0), waves(2, H, W, (7.5, -4.0), shortest=45.0)
    uv = places(2, 20, H, W, margin=25)
    options = OPTIONS | {"levels": 1, "window": 31} | WIDE
    running = lucas_kanade(src, dst, uv, **options | {"iterations": 2})
    assert not running.valid.any()
    assert torch.equal(running.error, (running.uv_1 - uv).norm(dim=-1)), "the way there: no way back"
    arrived = lucas_kanade(src, dst, uv, **options | {"iterations": 32})
    assert arrived.valid.float().mean() > 0.9
    assert (arrived.uv_1 - uv - torch.tensor([7.5, -4.0]))[arrived.valid].abs().max() < 0.2


def test_the_way_there_must_end_inside_the_image():
    """Half a pixel around the outermost pixels' middles still belongs to them."""
    src = waves(2, H, W, shortest=9.0)
    edge = torch.tensor([[-0.49, 50.0], [-0.51, 50], [W - 0.51, 50], [W - 0.49, 50], [60, -0.49], [60, -0.51]])
    edge = torch.cat([edge, torch.tensor([[60, H - 0.51], [60, H - 0.49]])]).double().expand(2, -1, -1)
    assert lucas_kanade(src, src, edge, **OPTIONS).valid.tolist() == [[True, False] * 4] * 2
    moved = waves(2, H, W, (1.0, 0.0), shortest=9.0)
    uv = torch.tensor([[W - 1.0, 50.0], [W - 1.75, 50.0], [W - 6.0, 50.0]], dtype=torch.float64).expand(2, -1, -1)
    found = lucas_kanade(src, moved, uv, **OPTIONS | {"levels": 1, "iterations": 20}, **WIDE)
    assert (found.valid == (found.uv_1[..., 0] <= W - 0.5)).all() and found.valid[:, 2].all()


def test_where_nothing_is_known_the_start_comes_back():
    src, dst = two_views()
    points = [[-3.0, 20.0], [math.nan, 20.0], [40.0, 1e30], [50.0, 50.0], [1.5, 40.0], [60.0, H - 2.5]]
    starts = [[5.0, 6.0], [7.0, 8.0], [9.0, 9.0], [math.nan, 51.0], [-0.7, 40.0], [60.0, H - 0.3]]
    uv, init = (torch.tensor(x, dtype=torch.float64).expand(2, -1, -1) for x in (points, starts))
    started, plain = (
        lucas_kanade(src, dst, uv, hint=TrackHint(start=x), **OPTIONS | {"levels": 1}) for x in (init, None)
    )
    assert started.valid.tolist() == [[False] * 3 + [True] + [False] * 2] * 2 and plain.valid[:, 3].all()
    assert started.uv_1[:, :2].tolist() == [[[5.0, 6.0], [0.0, 20.0]]] * 2, "the start, 0 for what is not finite"
    torch.testing.assert_close(started.uv_1[:, 4:], init[:, 4:], rtol=0, atol=1e-12)
    assert plain.uv_1[:, :3].tolist() == [[[-3.0, 20.0], [0.0, 20.0], [40.0, 1e30]]] * 2
    torch.testing.assert_close(started.uv_1[:, 3], plain.uv_1[:, 3], atol=0.02, rtol=0)


# --- one step, residual, covariance ----------------------------------------------------------------------------------


@pytest.mark.parametrize("normalise", NORMALISE)
@pytest.mark.parametrize("gain", [1.0, 1.3, 8.0, 0.1])
def test_refining_is_one_step_of_regression_and_squares_are_its_residual(normalise, gain):
    src, dst = two_views((0.4, -0.3), gain, 0.1)
    uv = places(2, 8, H, W, margin=1)
    uv_1 = uv + torch.tensor([0.45, -0.2], dtype=uv.dtype)
    found = refine_tracks(src, dst, uv, uv_1, window=WINDOW, normalise=normalise)
    o, batch = lk.SearchOptions(WINDOW, 1, 0.0, 0.0, normalise), torch.arange(2).repeat_interleave(8)
    views = [build_pyramid(y, 1, WINDOW) for y in (src, dst)]
    squares = lk.squared_differences(*views, o, uv.flatten(0, 1).T, (uv_1 - uv).flatten(0, 1).T, batch).view(2, 8)
    for b in range(2):
        level_0, level_1 = levels(src[b], 1, WINDOW)[0], levels(dst[b], 1, WINDOW)[0]
        for n in range(8):
            x, x_1 = uv[b, n].numpy(), uv_1[b, n].numpy()
            T, J = level_0.window(0, x, WINDOW), level_1.window(0, x_1, WINDOW)
            columns = [level_0.window(1, x, WINDOW), level_0.window(2, x, WINDOW), np.ones_like(T), T]
            free = columns[: 2 + NORMALISE.index(normalise)]
            step = np.linalg.lstsq(np.stack(free, 1), J - T, rcond=None)[0][:2]
            T, J = (T, J) if normalise == "none" else (T - T.mean(), J - J.mean())
            if normalise == "gain_bias":
                gain_here = np.clip(np.polyfit(T, J, 1)[0], 0.2, 5.0)
                step, J = step / gain_here, J / gain_here
            np.testing.assert_allclose(found[b, n].numpy(), x_1 - step, atol=1e-9)
            assert float(squares[b, n]) == pytest.approx(((J - T) ** 2).sum(), rel=1e-9)
    dark = build_pyramid(torch.full_like(dst, math.nan), 1, WINDOW)
    broken = lk.squared_differences(views[0], dark, o, uv[0].T, 0 * uv[0].T, batch[:8])
    assert broken.tolist() == [WINDOW**2] * 8, "as black on white"


def test_refining_leaves_what_it_cannot_refine():
    src, dst = two_views((0.4, -0.3))
    src[:, :, :30] = 0.5
    points = [[60.0, 10.0], [60, 60], [-0.6, 60], [60, 60], [math.nan, 60], [60, 60]]
    moved = [[61.0, 10.0], [61, 60], [5, 60], [W, 60], [62, 60], [62, math.inf]]
    uv, uv_1 = (torch.tensor(x).double().expand(2, -1, -1) for x in (points, moved))
    found = refine_tracks(src, dst, uv, uv_1, window=WINDOW)
    want = uv_1.nan_to_num(posinf=0)
    still = torch.tensor([True, False, True, True, True, True])
    assert torch.equal(found[:, still], want[:, still]) and (found - want)[:, 1].abs().min() > 1e-4
    for factor, stays in ((0.999, False), (1.001, True)):
        limit = factor * texture(src[0], uv[0, 1].numpy())
        found = refine_tracks(src, dst, uv, uv_1, window=WINDOW, min_eigenvalue=limit)
        assert torch.equal(found[0, 1], uv_1[0, 1]) == stays


def test_the_default_limit_of_texture_is_opencvs():
    """``minEigThreshold`` 1e-4: of bytes, whose slopes Scharr's filter makes 32 times as large, in units of 2^20."""
    wave = (127.5 + 60 * np.sin(np.arange(64) / 3.0)[None] * np.cos(np.arange(64) / 4.0)[:, None]).astype(np.uint8)
    g = [cv2.Scharr(wave, cv2.CV_64F, *o)[29:36, 29:36] for o in ((1, 0), (0, 1))]
    theirs = np.linalg.eigvalsh([[(a * b).sum() for a in g] for b in g])[0] / 2**20 / WINDOW**2
    ours = texture(torch.from_numpy(wave / 255.0)[None], np.array([32.0, 32.0]))
    assert theirs / 1e-4 == pytest.approx(ours / MIN_TRACK_EIGENVALUE, rel=1e-6)


def test_the_covariance_is_variance_over_texture_kept_from_vanishing():
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    cases = [(3.0, 2.0, 0.01), (3.0, 2.0, 0.0), (5.0, 1e-9, 0.02), (5.0, 4.9e-5, 0.02), (5.0, 5.1e-5, 0.02)]
    cases += [(0, 0, 0.5), (1e-5, 1e-10, 0.5)]
    A = np.array([turn @ np.diag([large, small]) @ turn.T for large, small, _ in cases])
    upper = torch.from_numpy(np.stack((A[:, 0, 0], A[:, 0, 1], A[:, 1, 1])))
    found = lk.window_covariance(upper, torch.tensor([c[2] for c in cases], dtype=torch.float64))
    for n, (large, small, variance) in enumerate(cases):
        lift = max(1e-5 * max(large, 1e-4) - small, 0)
        values = max(variance, 1 / (12 * 255**2)) / np.array([large + lift, small + lift])
        np.testing.assert_allclose(found[..., n].numpy(), turn @ np.diag(values) @ turn.T, rtol=1e-6, atol=1e-6)
    broken = lk.window_covariance(torch.full((3, 1), math.nan), torch.tensor([0.5]))
    np.testing.assert_allclose(broken[..., 0].numpy(), np.eye(2) * 0.5 / 1e-9, rtol=1e-5)


# --- default options, and with a graph -------------------------------------------------------------------------------
