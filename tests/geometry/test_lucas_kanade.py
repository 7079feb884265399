"""Lucas-Kanade against its point-by-point form, ``support/reference.py``: windows read pixel by pixel, steps solved one by one."""

import math

import cv2
import numpy as np
import pytest
import torch
from support import reference
from support.textures import levels, places, waves

from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.determinism import ELEMENTWISE_LANES
from dhtorch.geometry.pyramid import PyramidCache, build_pyramid
from dhtorch.records import TrackHint
from dhtorch.stages.track import MIN_TRACK_EIGENVALUE, lucas_kanade, refine_tracks

H, W, WINDOW = 100, 122, 7
FIELDS = ("uv_1", "error", "photometric", "cov", "valid")
NORMALISE = ("none", "bias", "gain_bias")


def two_views(shift=(1.3, -0.9), gain=1.0, bias=0.0, shortest=9.0):
    """Two pairs that move apart."""
    src = waves(2, H, W, shortest=shortest)
    return src, gain * torch.cat(
        [waves(2, H, W, [s * x for x in shift], shortest=shortest)[k : k + 1] for k, s in enumerate((1, -1))]
    ) + bias


OPTIONS = {"window": WINDOW, "levels": 3, "iterations": 3, "epsilon_px": 0.0, "normalise": "none"}


def reference_options(o):
    """Those that the slow search knows."""
    return reference.Options(**{name: o[name] for name in reference.Options._fields})


def twin(src, dst, uv, init=None, limit=1.0, **options):
    """Tracks (B, N) by the slow search, and where that never left the fast one's maps."""
    o = OPTIONS | {"min_eigenvalue": MIN_TRACK_EIGENVALUE} | options
    rows = []
    for b in range(len(uv)):
        views = [reference.levels(image[b], o["levels"], o["window"]) for image in (src, dst)]
        for n, x in enumerate(uv[b]):
            start = None if init is None else init[b, n]
            rows.append(reference.lucas_kanade(*views, x, reference_options(o), start=start, max_round_trip_px=limit))
    shaped = [np.array([np.asarray(x) for x in c]) for c in zip(*rows, strict=True)]
    shaped = [c.reshape(*uv.shape[:2], *c.shape[1:]) for c in shaped]
    return dict(zip(FIELDS, shaped[:5], strict=True)), shaped[5]


def agrees(tracks, expected, where, share=0.8):
    assert where.mean() >= share
    for field in FIELDS:
        found = getattr(tracks, field).numpy()[where]
        if field == "valid":
            assert (found == expected[field][where]).all()
        else:
            np.testing.assert_allclose(found, expected[field][where], rtol=1e-7, atol=1e-8, err_msg=field)


# --- the search ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_levels", [1, 2, 3, 4])
def test_a_few_steps_on_every_level(n_levels):
    """Cells, rounded starts, doubled displacements, the way back, and what is said of the residual."""
    src, dst = two_views()
    uv = places(2, 10, H, W, margin=2)
    options = OPTIONS | {"levels": n_levels}
    agrees(lucas_kanade(src, dst, uv, **options), *twin(src, dst, uv, **options))


@pytest.mark.parametrize(
    ("normalise", "gain", "bias"),
    [
        ("none", 1.0, 0.0),
        ("bias", 1.2, 0.3),
        ("gain_bias", 1.4, -0.2),
        ("gain_bias", 7.0, 0.3),
        ("gain_bias", 0.15, 0.4),
    ],
)
def test_what_a_normalisation_takes_out(normalise, gain, bias):
    """Ratios of contrast beyond 5 and below 0.2 are not believed."""
    src, dst = two_views((0.6, -0.5), gain, bias)
    uv = places(2, 8, H, W, margin=12)
    options = OPTIONS | {"levels": 2, "normalise": normalise, "iterations": 2}
    agrees(lucas_kanade(src, dst, uv, **options), *twin(src, dst, uv, **options))


@pytest.mark.parametrize("start", [(0.0, 0.0), (4.4, -6.3)])
def test_a_given_start_is_used_there_and_its_opposite_back(start):
    src, dst = two_views((5.0, -5.5))
    dst = torch.cat([dst[:1], waves(2, H, W, (4.0, -7.0), shortest=9.0)[1:]])
    uv = places(2, 8, H, W, margin=14)
    init = uv + torch.tensor(start, dtype=uv.dtype) + 0.3 * (places(2, 8, 2, 2, 0) - 0.5)
    options = OPTIONS | {"iterations": 4}
    tracks = lucas_kanade(src, dst, uv, hint=TrackHint(start=init), **options)
    expected, stayed = twin(src, dst, uv, init=init, **options)
    agrees(tracks, expected, stayed, share=0.7 if start[0] else 0.0)
    if start[0]:
        assert expected["valid"][stayed].mean() > 0.7


@pytest.mark.parametrize(
    ("n_levels", "epsilon", "steps"), [(1, 0.05, 18), (1, 0.004, 6), (2, 0.001, 7), (2, 0.004, 14)]
)
def test_a_step_shorter_than_epsilon_ends_a_search_and_coarse_ones_at_four_times_that(n_levels, epsilon, steps):
    """The last step but two of a map leaps; points at rest after eight stay. Less contrast makes every step too short
    on the way there and too long on the way back."""
    src, dst = two_views((0.5, -0.4))
    dst = 0.5 + 0.65 * (dst - 0.5)
    uv = places(2, 8, H, W, margin=12)
    options = {"window": 13, "levels": n_levels, "iterations": steps, "epsilon_px": epsilon, "normalise": "bias"}
    agrees(lucas_kanade(src, dst, uv, **options), *twin(src, dst, uv, **options), share=0.9)


def test_windows_of_another_width():
    src, dst = two_views()
    uv = places(2, 6, H, W, margin=3)
    for window in (5, 13):
        options = OPTIONS | {"levels": 2, "window": window}
        agrees(lucas_kanade(src, dst, uv, **options), *twin(src, dst, uv, **options))


def test_more_steps_are_taken_only_when_asked_for_and_needed():
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


# --- what is believed ------------------------------------------------------------------------------------------------


def test_a_round_trip_of_the_limit_or_more_is_not_believed():
    src, dst = two_views((2.0, -1.3), shortest=6.0)
    uv = places(2, 30, H, W, margin=12)
    wide = lucas_kanade(src, dst, uv, **OPTIONS, max_round_trip_px=1e9)
    limit = wide.error[wide.valid].sort().values[20].item()
    narrow = lucas_kanade(src, dst, uv, **OPTIONS, max_round_trip_px=limit)
    assert torch.equal(narrow.valid, wide.valid & (wide.error < limit)) and narrow.valid.sum() == 20
    assert all(torch.equal(getattr(narrow, f), getattr(wide, f)) for f in FIELDS if f != "valid")
    usual = lucas_kanade(src, dst, uv, **OPTIONS)
    assert torch.equal(usual.valid, wide.valid & (wide.error < 1.0)), "1 px"


def test_the_error_is_the_distance_after_tracking_back_with_the_images_exchanged():
    src, dst = two_views((2.0, -1.3), shortest=6.0)
    uv = places(2, 20, H, W, margin=12)
    options = OPTIONS | {"iterations": 2}
    there = lucas_kanade(src, dst, uv, **options, max_round_trip_px=1e9)
    back = lucas_kanade(dst, src, there.uv_1, **options)
    both = there.valid
    torch.testing.assert_close(there.error[both], (back.uv_1 - uv).norm(dim=-1)[both], atol=1e-7, rtol=0)
    assert both.float().mean() > 0.8 and there.error[both].max() > 0.003


@pytest.mark.parametrize("normalise", NORMALISE)
def test_windows_need_more_texture_than_the_limit_in_both_images(normalise):
    src, dst = two_views((0.4, 0.3))
    fade = torch.linspace(0.02, 1, W, dtype=torch.float64)
    src, dst = 0.5 + fade * (src - 0.5), 0.5 + fade.flip(0) * (dst - 0.5)
    uv = places(2, 25, H, W, margin=12)
    options = OPTIONS | {"normalise": normalise, "levels": 1, "iterations": 1}
    uv_1 = lucas_kanade(src, dst, uv, **options, min_eigenvalue=0.0).uv_1

    def texture(image, x):
        g, _ = reference.template(
            reference.levels(image, 1, WINDOW)[0], x, reference.Options(WINDOW, normalise=normalise)
        )
        return float(torch.linalg.eigvalsh(g @ g.T)[0]) / WINDOW**2

    pairs = [(b, n) for b in range(2) for n in range(25)]
    here = np.array([texture(src[b], uv[b, n]) for b, n in pairs]).reshape(2, 25)
    there = np.array([texture(dst[b], uv_1[b, n]) for b, n in pairs]).reshape(2, 25)
    limit = float(np.median(np.minimum(here, there)))
    found = lucas_kanade(src, dst, uv, **options, min_eigenvalue=limit, max_round_trip_px=1e9)
    every = lucas_kanade(src, dst, uv, **options, min_eigenvalue=0.0, max_round_trip_px=1e9)
    enough = (here > limit) & (there > limit)
    assert (found.valid.numpy() == (enough & every.valid.numpy())).all() and 5 < found.valid.sum() < 30
    assert ((here > limit) & ~enough).any() and ((there > limit) & ~enough).any()
    still = torch.from_numpy(here <= limit)
    assert torch.equal(found.uv_1[still], uv[still]), "without texture no step"


def test_a_window_that_still_runs_is_lost():
    """Long waves, 11 px apart: one map of 2 px is left at once, four maps suffice."""
    src, dst = waves(2, H, W, shortest=45.0), waves(2, H, W, (7.5, -4.0), shortest=45.0)
    uv = places(2, 20, H, W, margin=25)
    options = OPTIONS | {"levels": 1, "window": 31, "max_round_trip_px": 1e9}
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
    inside = [True, False] * 4
    assert lucas_kanade(src, src, edge, **OPTIONS).valid.tolist() == [inside] * 2
    moved = waves(2, H, W, (1.0, 0.0), shortest=9.0)
    uv = torch.tensor([[W - 1.0, 50.0], [W - 1.75, 50.0], [W - 6.0, 50.0]], dtype=torch.float64).expand(2, -1, -1)
    found = lucas_kanade(src, moved, uv, **OPTIONS | {"levels": 1, "iterations": 20}, max_round_trip_px=1e9)
    assert (found.valid == (found.uv_1[..., 0] <= W - 0.5)).all() and found.valid[:, 2].all()


def test_where_nothing_is_known_the_start_comes_back():
    src, dst = two_views()
    uv = torch.tensor([[-3.0, 20.0], [math.nan, 20.0], [40.0, 1e30], [50.0, 50.0]], dtype=torch.float64).expand(
        2, -1, -1
    )
    init = torch.tensor([[5.0, 6.0], [7.0, 8.0], [9.0, 9.0], [math.nan, 51.0]], dtype=torch.float64).expand(2, -1, -1)
    for run in (
        lucas_kanade(src, dst, uv, hint=TrackHint(start=init), **OPTIONS),
        lucas_kanade(src, dst, uv, **OPTIONS),
    ):
        assert run.valid.tolist() == [[False, False, False, True]] * 2
    started, plain = (
        lucas_kanade(src, dst, uv, hint=TrackHint(start=init), **OPTIONS),
        lucas_kanade(src, dst, uv, **OPTIONS),
    )
    assert started.uv_1[:, :2].tolist() == [[[5.0, 6.0], [0.0, 20.0]]] * 2, "the start, 0 for what is not finite"
    assert plain.uv_1[:, :3].tolist() == [[[-3.0, 20.0], [0.0, 20.0], [40.0, 1e30]]] * 2
    torch.testing.assert_close(started.uv_1[:, 3], plain.uv_1[:, 3], atol=0.02, rtol=0)


def test_a_pyramid_made_before_is_used_in_the_images_place():
    src, dst = two_views()
    uv = places(2, 8, H, W, margin=12)
    other = waves(2, H, W, seed=9)
    found = lucas_kanade(other, dst, uv, hint=TrackHint(pyramid=PyramidCache(src)), **OPTIONS)
    want = lucas_kanade(src, dst, uv, **OPTIONS)
    assert all(torch.equal(getattr(found, f), getattr(want, f)) for f in FIELDS)
    two = lucas_kanade(src, dst, uv, hint=TrackHint(levels=2), **OPTIONS)
    assert torch.equal(two.uv_1, lucas_kanade(src, dst, uv, **OPTIONS | {"levels": 2}).uv_1), "as many as are asked for"


# --- one step, residual, covariance ----------------------------------------------------------------------------------


@pytest.mark.parametrize("normalise", NORMALISE)
@pytest.mark.parametrize("gain", [1.0, 1.3, 8.0, 0.1])
def test_refining_is_one_step_of_regression(normalise, gain):
    src, dst = two_views((0.4, -0.3), gain, 0.1)
    uv = places(2, 8, H, W, margin=1)
    uv_1 = uv + torch.tensor([0.45, -0.2], dtype=uv.dtype)
    found = refine_tracks(src, dst, uv, uv_1, window=WINDOW, normalise=normalise)
    for b in range(2):
        level_0, level_1 = levels(src[b], 1, WINDOW)[0], levels(dst[b], 1, WINDOW)[0]
        for n in range(8):
            x, x_1 = uv[b, n].numpy(), uv_1[b, n].numpy()
            T, J = level_0.window(0, x, WINDOW), level_1.window(0, x_1, WINDOW)
            columns = [level_0.window(1, x, WINDOW), level_0.window(2, x, WINDOW), np.ones_like(T), T]
            free = columns[: 2 + NORMALISE.index(normalise)]
            step = np.linalg.lstsq(np.stack(free, 1), J - T, rcond=None)[0][:2]
            if normalise == "gain_bias":
                step /= np.clip(np.polyfit(T, J, 1)[0], 0.2, 5.0)
            np.testing.assert_allclose(found[b, n].numpy(), x_1 - step, atol=1e-9)


def test_refining_leaves_what_it_cannot_refine():
    src, dst = two_views((0.4, -0.3))
    src[:, :, :30] = 0.5
    uv = (
        torch.tensor([[60.0, 10.0], [60, 60], [-0.6, 60], [60, 60], [math.nan, 60], [60, 60]])
        .double()
        .expand(2, -1, -1)
    )
    uv_1 = torch.tensor([[61.0, 10.0], [61, 60], [5, 60], [W, 60], [62, 60], [62, math.inf]]).double().expand(2, -1, -1)
    found = refine_tracks(src, dst, uv, uv_1, window=WINDOW)
    want = uv_1.clone()
    want[:, 5, 1] = 0
    moved = torch.tensor([False, True, False, False, False, False])
    assert torch.equal(found[:, ~moved], want[:, ~moved]) and (found - want)[:, 1].abs().min() > 1e-4
    g, _ = reference.template(reference.levels(src[0], 1, WINDOW)[0], uv[0, 1], reference.Options(WINDOW))
    texture = float(torch.linalg.eigvalsh(g @ g.T)[0]) / WINDOW**2
    for share, stays in ((0.999, False), (1.001, True)):
        found = refine_tracks(src, dst, uv, uv_1, window=WINDOW, min_eigenvalue=share * texture)
        assert torch.equal(found[0, 1], uv_1[0, 1]) == stays


def test_the_usual_limit_of_texture_is_opencvs():
    """``minEigThreshold`` 1e-4: of bytes, whose slopes Scharr's filter makes 32 times as large, in units of 2^20."""
    wave = (127.5 + 60 * np.sin(np.arange(64) / 3.0)[None] * np.cos(np.arange(64) / 4.0)[:, None]).astype(np.uint8)
    g = [cv2.Scharr(wave, cv2.CV_64F, *o)[22:43, 22:43] for o in ((1, 0), (0, 1))]
    theirs = np.linalg.eigvalsh([[(a * b).sum() for a in g] for b in g])[0] / 2**20 / 21**2
    (level,) = reference.levels(torch.from_numpy(wave / 255.0)[None], 1, 21)
    ours, _ = reference.template(level, torch.tensor([32.0, 32.0]).double(), reference.Options())
    small = float(torch.linalg.eigvalsh(ours @ ours.T)[0])
    assert theirs / 1e-4 == pytest.approx(small / 21**2 / MIN_TRACK_EIGENVALUE, rel=1e-6)


@pytest.mark.parametrize("normalise", NORMALISE)
def test_squares_are_those_of_the_windows(normalise):
    src, dst = two_views(gain=6.5, bias=-0.3)
    x, d = places(1, 9, H, W, margin=0)[0].T.contiguous(), places(1, 9, 3, 3, 0, seed=3)[0].T - 1.0
    batch = torch.arange(9) % 2
    o = lk.SearchOptions(WINDOW, 1, 0.0, 0.0, normalise)
    pyramids = (build_pyramid(y, 1, WINDOW) for y in (src, dst))
    found = lk.squared_differences(*pyramids, o, x, d, batch)
    for n in range(9):
        views = (reference.levels(y[n % 2], 1, WINDOW)[0] for y in (src, dst))
        slow = reference.Options(WINDOW, normalise=normalise)
        want = reference.difference(*views, x[:, n], (x + d)[:, n], slow)
        assert float(found[n]) == pytest.approx(want, rel=1e-9)
    dark = torch.full_like(dst, math.nan)
    broken = lk.squared_differences(build_pyramid(src, 1, WINDOW), build_pyramid(dark, 1, WINDOW), o, x, d, batch)
    assert broken.tolist() == [WINDOW**2] * 9, "as black on white"


def test_the_covariance_is_variance_over_texture_kept_from_vanishing():
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    cases = [
        (3.0, 2.0, 0.01),
        (3.0, 2.0, 0.0),
        (5.0, 1e-9, 0.02),
        (5.0, 4.9e-5, 0.02),
        (5.0, 5.1e-5, 0.02),
        (0, 0, 0.5),
    ]
    cases += [(1e-5, 1e-10, 0.5)]
    A = [turn @ np.diag([large, small]) @ turn.T for large, small, _ in cases]
    found = lk.window_covariance(
        torch.tensor([[a[0, 0], a[0, 1], a[1, 1]] for a in A], dtype=torch.float64).T,
        torch.tensor([c[2] for c in cases], dtype=torch.float64),
    )
    for n, (large, small, variance) in enumerate(cases):
        lift = max(1e-5 * max(large, 1e-4) - small, 0)
        values = max(variance, 1 / (12 * 255**2)) / np.array([large + lift, small + lift])
        np.testing.assert_allclose(found[..., n].numpy(), turn @ np.diag(values) @ turn.T, rtol=1e-6, atol=1e-6)
    broken = lk.window_covariance(torch.full((3, 1), math.nan), torch.tensor([0.5]))
    np.testing.assert_allclose(broken[..., 0].numpy(), np.eye(2) * 0.5 / 1e-9, rtol=1e-5)


def test_some_are_replaced_and_the_others_kept():
    wanted = torch.arange(130) % 3 == 0
    values = (torch.arange(130.0), torch.zeros(2, 130))
    seen = []

    def double(x, y):
        assert x.shape[-1] % ELEMENTWISE_LANES == 0
        seen.append(x)
        return 2 * x, y + 1

    first, second = lk.masked_apply(wanted, double, values, (torch.arange(130.0) + 5, torch.ones(2, 130)))
    assert torch.equal(first, torch.where(wanted, 2 * (torch.arange(130.0) + 5), torch.arange(130.0)))
    assert torch.equal(second, torch.where(wanted, 2.0, 0.0).expand(2, -1)) and set(seen[0].tolist()) == set(
        (torch.arange(130.0) + 5)[wanted].tolist()
    )
    assert lk.masked_apply(wanted & False, double, values, values) is values and len(seen) == 1
    low, high = torch.tensor([[0.0], [1.0]]), torch.tensor([[2.0], [3.0]])
    x = torch.tensor([[0.0, 2.0, 2.1, 1.0, 1.0, math.nan, -0.1], [1.0, 3.0, 2.0, 3.1, 0.9, 2.0, 2.0]])
    assert lk.is_between(x, low, high).tolist() == [True, True, False, False, False, False, False]


# --- options as they are and with a graph ----------------------------------------------------------------------------


def test_the_usual_search_has_four_levels_windows_of_21_px_30_steps_and_no_normalisation():
    draw = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 1, 50, 50, generator=draw, dtype=torch.float64)
    src = torch.nn.functional.interpolate(coarse, (340, 340), mode="bicubic")
    dst = 1.2 * src.roll((9, -6), (2, 3)) + 0.1 * torch.rand(src.shape, generator=draw, dtype=torch.float64)
    dst[..., :170] = src.flip(3)[..., :170]  # where nothing comes to rest
    uv = places(1, 24, 340, 340, margin=20)
    named = {"window": 21, "levels": 4, "iterations": 30, "epsilon_px": 0.01, "max_round_trip_px": 1.0}
    named |= {"normalise": "none", "min_eigenvalue": 1e-4 * 1024 / 255**2}
    usual, plain = lucas_kanade(src, dst, uv, **named), lucas_kanade(src, dst, uv)
    assert all(torch.equal(getattr(usual, f), getattr(plain, f)) for f in FIELDS)
    for name, value in {"window": 23, "levels": 5, "iterations": 31, "epsilon_px": 0.02}.items():
        assert not torch.equal(lucas_kanade(src, dst, uv, **named | {name: value}).uv_1, plain.uv_1), name


@pytest.mark.parametrize("normalise", NORMALISE)
@pytest.mark.parametrize("who", range(3))
def test_with_a_graph_valid_tracks_take_one_more_step(normalise, who):
    src, dst = two_views((0.5, -0.4))
    fade = torch.linspace(0.001, 0.1, W, dtype=torch.float64)  # also less texture than by default is enough
    leaves = [0.5 + fade * (src - 0.5), 0.5 + fade * (dst - 0.5), places(2, 20, H, W, margin=12)]
    options = OPTIONS | {"normalise": normalise, "min_eigenvalue": 1e-9}
    options |= {"iterations": 1, "max_round_trip_px": 0.01}
    plain = lucas_kanade(*leaves, **options)
    assert 0.1 < plain.valid.float().mean() < 0.95 and not plain.uv_1.requires_grad
    leaves[who] = leaves[who].requires_grad_()
    graph = lucas_kanade(*leaves, **options)
    step = refine_tracks(*leaves, plain.uv_1, window=WINDOW, normalise=normalise, min_eigenvalue=1e-9)
    assert torch.equal(graph.uv_1, torch.where(plain.valid[..., None], step, plain.uv_1))
    assert all(torch.equal(getattr(graph, f), getattr(plain, f)) for f in FIELDS[1:])
    assert not graph.error.requires_grad and not graph.cov.requires_grad
    (slope,) = torch.autograd.grad(graph.uv_1[plain.valid].sum(), leaves[who], retain_graph=True)
    assert (slope != 0).any()
    (none,) = torch.autograd.grad(graph.uv_1[~plain.valid].sum(), leaves[who])
    assert (none == 0).all()
    with torch.no_grad():
        assert torch.equal(lucas_kanade(*leaves, **options).uv_1, plain.uv_1)


def test_a_search_that_starts_outside_does_not_begin():
    src, dst = two_views((0.6, 0.4))
    uv = torch.tensor([[1.5, 40.0], [60.0, H - 2.5], [60.0, 40.0]], dtype=torch.float64).expand(2, -1, -1)
    init = torch.tensor([[-0.7, 40.0], [60.0, H - 0.3], [60.5, 40.2]], dtype=torch.float64).expand(2, -1, -1)
    found = lucas_kanade(src, dst, uv, hint=TrackHint(start=init), **OPTIONS | {"levels": 1})
    torch.testing.assert_close(found.uv_1[:, :2], init[:, :2], rtol=0, atol=1e-12)
    assert found.valid.tolist() == [[False, False, True]] * 2 and (found.uv_1[:, 2] != init[:, 2]).all()
