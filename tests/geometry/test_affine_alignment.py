"""Affine re-registration: exact warps, Monte-Carlo for the covariance, rejections, gradients.

Kernel and torch reference, which are two implementations of the search, are compared in tests/ops/test_operators.py.
"""

import math

import pytest
import torch

from dhtorch.geometry import affine_alignment
from dhtorch.geometry.pyramid import build_pyramid
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine

HW = (160, 200)
FIELDS = ("uv_1", "error", "photometric", "cov", "valid")


def warped(linear, shift, seed=0, shortest=8.0, gain=1.0, bias=0.0, noise=0.0, hw=HW):
    """Two views (1, 1, H, W) float64 of a texture of waves, the second warped exactly, and the warp of pixels."""
    draw = torch.Generator().manual_seed(seed)
    length, turn, phase = torch.rand(3, 50, generator=draw, dtype=torch.float64)
    length, turn, phase = shortest * (200 / shortest) ** length, 2 * math.pi * turn, 2 * math.pi * phase
    wave = (2 * math.pi / length)[:, None] * torch.stack((turn.cos(), turn.sin()), -1)
    weight = 1.5 * length.sqrt() / length.sqrt().sum()
    A, t = torch.tensor(linear, dtype=torch.float64), torch.tensor(shift, dtype=torch.float64)
    v, u = torch.meshgrid(*(torch.arange(s, dtype=torch.float64) for s in hw), indexing="ij")
    uv, middle = torch.stack((u, v), -1), torch.tensor([hw[1] / 2, hw[0] / 2], dtype=torch.float64)

    def picture(p):
        return (0.5 + (weight * torch.sin(p @ wave.T + phase)).sum(-1))[None, None]

    image_0, image_1 = picture(uv), gain * picture((uv - middle - t) @ torch.linalg.inv(A).T + middle) + bias
    image_0, image_1 = (
        i + noise * torch.randn(i.shape, generator=draw, dtype=torch.float64) for i in (image_0, image_1)
    )
    return image_0, image_1, lambda p: (p - middle) @ A.T + middle + t


def points(n, seed=1, hw=HW, margin=36):
    size = torch.tensor([hw[1], hw[0]], dtype=torch.float64) - 2 * margin
    return torch.rand(1, n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * size + margin


def registered(image_0, image_1, uv_0, uv_1, **options):
    source, target = build_pyramid(image_0, 3), build_pyramid(image_1, 3)
    return affine_alignment.register_affine(source, target, uv_0, uv_1, **options)


SLANTED, STILL = [[1.06, 0.05], [-0.07, 0.95]], [[1.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    ("linear", "gain", "bias"),
    [(SLANTED, 1.0, 0.0), (SLANTED, 0.7, 0.1), ([[0.75, 0.2], [-0.2, 0.75]], 1.0, 0.0), ([[1, 0], [0, 1]], 1.3, -0.1)],
)
def test_an_exact_warp_is_found(linear, gain, bias):
    image_0, image_1, warp = warped(linear, (0.37, -0.61), gain=gain, bias=bias, shortest=12)
    uv = points(100)
    start = warp(uv) + 0.3 * torch.randn(uv.shape, generator=torch.Generator().manual_seed(2), dtype=uv.dtype)
    found = registered(image_0, image_1, uv, start)
    miss = (found.uv_1 - warp(uv)).norm(dim=-1)
    assert found.ok.all()
    assert miss.median() < 0.025 and miss.max() < 0.09  # what reading between pixels costs at waves of 12 px
    assert (found.linear - torch.tensor(linear, dtype=uv.dtype)).abs().median() < 0.0025
    assert found.rms.median() < 0.0007


def test_it_improves_plain_tracks_of_a_slanted_texture():
    image_0, image_1, warp = warped(SLANTED, (2.2, -1.4), shortest=12)
    uv = points(100)
    plain, better = (fn(image_0, image_1, uv) for fn in (lucas_kanade, lucas_kanade_affine))
    miss = lambda tracks: (tracks.uv_1 - warp(uv)).norm(dim=-1)[plain.valid].median()  # noqa: E731
    assert torch.equal(plain.valid, better.valid) and plain.valid.all()
    assert miss(better) < 0.1 * miss(plain)


@pytest.mark.parametrize(
    ("linear", "shift"),
    [(STILL, (1.0, -2.0)), (STILL, (0.3, -0.71)), (SLANTED, (0.5, 0.5)), (SLANTED, (0.3, -0.71))],
)
def test_covariance_is_right_on_white_noise(linear, shift):
    """Mean squared error in units of the covariance: 1 in expectation, at whole, half and other positions."""
    square = []
    for seed in range(2):
        image_0, image_1, warp = warped(linear, shift, seed=seed, noise=3 / 255, shortest=8)
        uv = points(250, seed=seed)
        start = warp(uv) + 0.2 * torch.randn(uv.shape, generator=torch.Generator().manual_seed(seed), dtype=uv.dtype)
        found = registered(image_0.float(), image_1.float(), uv, start)
        assert found.ok.float().mean() > 0.99
        e = (found.uv_1 - warp(uv))[..., None]
        square.append((e * torch.linalg.solve(found.cov, e)).sum((-2, -1))[found.ok] / 2)
    assert 0.9 < torch.cat(square).mean() < 1.2


def test_rejected_registrations_keep_the_track_and_say_so():
    image_0, image_1, _ = warped([[1.0, 0.0], [0.0, 1.0]], (0.0, 0.0))
    uv = points(60)
    astray = uv + torch.tensor([7.0, 5.0], dtype=uv.dtype)  # on another part of the texture

    def track(image_0, image_1, uv_0, **options):
        return lucas_kanade(image_0, image_1, uv_0, **options).replace(uv_1=astray)

    tracks, plain = lucas_kanade_affine(image_0, image_1, uv, track=track), lucas_kanade(image_0, image_1, uv)
    rejected = (tracks.uv_1 == astray).all(-1)
    assert rejected.float().mean() > 0.5 and tracks.valid.all()
    assert (tracks.error >= plain.error).all() and tracks.error[rejected].median() > 0.3
    assert tracks.photometric[rejected].median() > 20 * lucas_kanade_affine(image_0, image_1, uv).photometric.median()


def test_nothing_to_hold_on_to():
    """No texture, not finite, outside: no exception, the start comes back, all numbers finite."""
    flat = torch.full((1, 1, *HW), 0.5)
    uv = torch.tensor([[[50.0, 50.0], [torch.nan, 20.0], [-30.0, 20.0], [3.0, 3.0], [199.4, 159.4]]])
    found = registered(flat, flat, uv, uv)
    assert not found.ok.any() and torch.equal(found.uv_1.nan_to_num(), uv.nan_to_num())
    for image in (flat, torch.rand(1, 1, *HW, generator=torch.Generator().manual_seed(0))):
        tracks = lucas_kanade_affine(image, image, uv)
        assert all(getattr(tracks, k).isfinite().all() for k in FIELDS)


def test_the_derivative_is_that_of_the_converged_position():
    """Moving the start of a window moves its end by the affine part; brightening a pixel moves it as it does."""
    image_0, image_1, warp = warped(SLANTED, (0.4, 0.2), shortest=20, hw=(64, 64))
    uv = points(3, hw=(64, 64), margin=26).requires_grad_()
    image_1.requires_grad_()
    tight = {"iterations": 60, "epsilon_px": 1e-9}
    tracks = lucas_kanade_affine(image_0, image_1, uv, levels=1, **tight)
    by_uv, by_image = torch.autograd.grad(tracks.uv_1[..., 0].sum(), (uv, image_1))
    assert (by_uv[0] - torch.tensor(SLANTED[0], dtype=uv.dtype)).abs().max() < 0.02
    bump = torch.zeros_like(image_1)
    pixel = warp(uv.detach())[0, 0].round().long()
    bump[0, 0, pixel[1] + 3, pixel[0] - 2] = 1e-4
    moved = [lucas_kanade_affine(image_0, image_1.detach() + s * bump, uv.detach(), levels=1, **tight) for s in (1, -1)]
    numeric = (moved[0].uv_1 - moved[1].uv_1)[..., 0].sum() / 2e-4
    analytic = (by_image * bump).sum() / 1e-4
    assert abs(numeric - analytic) < 0.1 * abs(numeric)


def scaled(factor):
    return [[factor, 0.1], [-0.1, factor]]


@pytest.mark.parametrize(
    ("linear", "gain", "off", "options", "is_ok"),
    [
        (SLANTED, 4.8, 0.3, {}, True),
        (SLANTED, 5.3, 0.3, {}, False),
        (SLANTED, 0.21, 0.3, {}, True),
        (SLANTED, 0.19, 0.3, {}, False),
        (scaled(1.9), 1.0, 0.2, {"linear": 1.8, "iterations": 12}, True),
        (scaled(2.7), 1.0, 0.2, {"linear": 2.6, "iterations": 12}, False),
        (scaled(0.55), 1.0, 0.2, {"linear": 0.6, "iterations": 12}, True),
        (scaled(0.35), 1.0, 0.2, {"linear": 0.38, "iterations": 12}, False),
        (STILL, 1.0, 1.5, {"max_shift_px": 1.7}, True),
        (STILL, 1.0, 1.5, {"max_shift_px": 1.3}, False),
        (STILL, 1.0, 9.0, {"iterations": 1, "max_shift_px": 50.0}, False),  # one step from far away is often worse
    ],
)
def test_contrast_size_shift_and_residual_have_limits(linear, gain, off, options, is_ok):
    image_0, image_1, warp = warped(linear, (0.4, -0.3), gain=gain, shortest=24 if "linear" in options else 12)
    uv = points(60, margin=70)
    if "linear" in options:
        options = options | {"linear": options["linear"] * torch.eye(2, dtype=uv.dtype)[None]}
    start = warp(uv) + torch.tensor([off, 0.0], dtype=uv.dtype)
    found = registered(image_0, image_1, uv, start, **options)
    assert (found.ok.float().mean() > 0.8) if is_ok else (found.ok.float().mean() < 0.5)
    assert torch.equal(found.uv_1[~found.ok], start[~found.ok])
    assert (found.linear[~found.ok] == options.get("linear", torch.eye(2)[None])).all()
    some = torch.arange(60)[None] % 3 == 0
    chosen = registered(image_0, image_1, uv, start, wanted=some, **options)
    assert torch.equal(chosen.ok, found.ok & some) and torch.equal(chosen.uv_1[~some], start[~some])


def test_an_image_that_only_changes_along_rows_determines_no_motion():
    row = 0.5 + 0.3 * torch.sin(torch.arange(200, dtype=torch.float64) / 3)
    image = row.expand(1, 1, 160, 200).contiguous()
    uv, still = points(6), torch.eye(2, dtype=torch.float64).expand(1, 6, 2, 2)
    views = build_pyramid(image, 1), build_pyramid(image.roll(1, 3), 1)
    assert torch.equal(affine_alignment.registration_step(*views, uv, uv + 0.3, still), uv + 0.3)
    assert not affine_alignment.register_affine(*views, uv, uv + 0.3).ok.any()
