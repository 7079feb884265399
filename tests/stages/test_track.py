"""Lucas-Kanade: known motions, OpenCV as oracle, and the house rules; number by number: test_lucas_kanade.py."""

import os
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from dhtorch.geometry.lucas_kanade import CELL_LEVEL
from dhtorch.geometry.pyramid import PyramidCache, build_pyramid
from dhtorch.ops import dispatch
from dhtorch.records import TrackHint
from dhtorch.stages.track import lucas_kanade, refine_tracks

ROOT = os.environ.get("DHTORCH_DATA")
FIELDS = ("uv_1", "error", "photometric", "cov", "valid")


def scene(B, H, W, shift=(0.0, 0.0), seed=0, dtype=torch.float64):
    """Texture (B, 1, H, W) in [0, 1] of waves from 6 to 200 px, moved by exactly ``shift`` (u, v) px."""
    draw = torch.Generator().manual_seed(seed)
    length, turn, phase = torch.rand(3, B, 40, generator=draw, dtype=torch.float64)
    length, turn, phase = 6 * 33**length, 6.2832 * turn, 6.2832 * phase
    wave = 6.2832 / length[..., None] * torch.stack([turn.cos(), turn.sin()], -1)
    weight = (length.sqrt() / length.sqrt().sum(1, keepdim=True))[..., None, None]
    v, u = torch.meshgrid(torch.arange(H) - shift[1], torch.arange(W) - shift[0], indexing="ij")
    angle = wave[..., 0, None, None] * u + wave[..., 1, None, None] * v + phase[..., None, None]
    return (0.5 + (weight * angle.sin()).sum(1))[:, None].to(dtype)


def points(B, N, H, W, margin=0.0, seed=1, dtype=torch.float64):
    draw = torch.Generator().manual_seed(seed)
    size = torch.tensor([W - 1, H - 1], dtype=dtype) - 2 * margin
    return torch.rand(B, N, 2, generator=draw, dtype=torch.float64).to(dtype) * size + margin


# --- what is found ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.61), (5.3, 3.8), (-17.2, 11.6)])
def test_known_shift(shift):
    H, W = 150, 190
    uv = points(1, 60, H, W, margin=35)
    tracks = lucas_kanade(scene(1, H, W), scene(1, H, W, shift), uv, levels=3)
    distance = (tracks.uv_1 - uv - torch.tensor(shift)).norm(dim=-1)
    assert tracks.valid.all()
    assert distance.quantile(0.95) < 0.02
    assert tracks.error.median() < 1e-4


@pytest.mark.parametrize(
    ("normalise", "change"),
    [("bias", "none"), ("bias", "bias"), ("gain_bias", "none"), ("gain_bias", "bias"), ("gain_bias", "gain_bias")],
)
def test_illumination_that_a_normalisation_names_is_undone(normalise, change):
    """J = 1.3 I + 0.1; plain differences do not survive the offset."""
    H, W, shift = 100, 120, torch.tensor([2.3, -1.4])
    src, dst = scene(1, H, W) * 0.6, scene(1, H, W, shift.tolist()) * 0.6
    dst = {"none": dst, "bias": dst + 0.1, "gain_bias": 1.3 * dst + 0.1}[change]
    assert dst.max() < 1
    uv = points(1, 60, H, W, margin=25)
    tracks = lucas_kanade(src, dst, uv, normalise=normalise, levels=2)
    distance = (tracks.uv_1 - uv - shift).norm(dim=-1)[0]
    assert distance.quantile(0.95) < 0.03
    assert tracks.photometric.median() < 0.0006
    assert tracks.valid.all()
    if change != "none":
        plain = lucas_kanade(src, dst, uv, levels=2)
        assert (plain.uv_1 - uv - shift).norm(dim=-1).median() > 0.3


def test_covariance_is_that_of_the_errors():
    """Noise of known size at whole pixels: errors have the size that the reported covariance claims."""
    H, W, noise = 200, 260, 0.02
    src, clean = scene(1, H, W), scene(1, H, W, (2.0, 1.0))
    uv = points(1, 800, H, W, margin=25).round()
    dst = clean + noise * torch.randn(clean.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    tracks = lucas_kanade(src, dst, uv, levels=2)
    error = (tracks.uv_1 - uv - torch.tensor([2.0, 1.0], dtype=torch.float64))[0]
    squared = (error[:, None] @ torch.linalg.inv(tracks.cov[0]) @ error[..., None]).flatten()
    assert 1.0 < squared[tracks.valid[0]].median() < 2.0  # chi² of two degrees of freedom: 1.39
    assert abs(tracks.photometric.median().item() / noise - 1) < 0.1


# --- what cannot be found --------------------------------------------------------------------------------------------


def test_points_that_leave_lie_outside_or_are_no_numbers_are_not_valid():
    H, W = 100, 120
    src, dst = scene(1, H, W), scene(1, H, W, (9.0, 0.0))
    nan, inf = float("nan"), float("inf")
    lost = [[115.0, 50.0], [-3.0, 20.0], [60.0, 130.0], [nan, nan], [inf, 50.0], [1e30, 1e30]]
    uv = torch.tensor([[*lost, [60.0, 50.0]]], dtype=torch.float64)
    leaves = [x.clone().requires_grad_() for x in (src, dst, uv)]
    tracks = lucas_kanade(*leaves, levels=2)
    assert tracks.valid.tolist() == [[False] * 6 + [True]]
    assert torch.equal(tracks.uv_1[0, 1:3], uv[0, 1:3]) and all(getattr(tracks, f).isfinite().all() for f in FIELDS)
    tracks.uv_1.sum().backward()
    assert all(x.grad.isfinite().all() for x in leaves)


@pytest.mark.parametrize("normalise", ["none", "bias", "gain_bias"])
def test_black_flat_and_broken_images_are_silent(normalise):
    image = scene(1, 60, 80, dtype=torch.float32)
    broken = image.clone()
    broken[..., 20:40, 30:50] = float("nan")
    uv = points(1, 100, 60, 80, dtype=torch.float32)
    for a, b in ((image * 0, image * 0), (image * 0 + 1, image * 0 + 1), (image * 0, image), (broken * 0, image)):
        assert not lucas_kanade(a, b, uv, normalise=normalise).valid.any()
    for a, b in ((image * 0, image), (image, image * 0), (image, broken), (broken, image)):
        tracks = lucas_kanade(a, b, uv, normalise=normalise)
        assert all(getattr(tracks, f).isfinite().all() for f in FIELDS)


IMAGE, UV = torch.rand(2, 1, 50, 60), torch.zeros(2, 5, 2)


@pytest.mark.parametrize(
    "call",
    [
        lambda: lucas_kanade(IMAGE.expand(2, 2, 50, 60), IMAGE.expand(2, 2, 50, 60), UV),
        lambda: lucas_kanade(IMAGE, IMAGE, UV, hint=TrackHint(start=UV[:, :2])),
        lambda: lucas_kanade(IMAGE, IMAGE, UV, normalise="both"),
        lambda: lucas_kanade(IMAGE, IMAGE, UV, iterations=0),
        lambda: lucas_kanade(IMAGE, IMAGE, UV, window=51),
        lambda: lucas_kanade(IMAGE, IMAGE, UV, hint=TrackHint(pyramid=PyramidCache(IMAGE[..., :-1]))),
        lambda: lucas_kanade(IMAGE, IMAGE, UV, hint=TrackHint(pyramid=PyramidCache(IMAGE[:1]))),
        lambda: refine_tracks(IMAGE, IMAGE, UV, UV, normalise="both"),
    ],
)
def test_wrong_options_raise(call):
    with pytest.raises(ValueError):
        call()


# --- options ---------------------------------------------------------------------------------------------------------


def test_colour_and_bytes_are_grey_images_of_opencv():
    rgb = (torch.cat([scene(1, 80, 90, seed=s) for s in range(3)], 1) * 255).round().to(torch.uint8)
    grey = torch.from_numpy(cv2.cvtColor(rgb[0].permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY))[None, None]
    moved = torch.roll(rgb, (2, 1), (2, 3))
    uv = points(1, 50, 80, 90, margin=20, dtype=torch.float32)
    tracks = lucas_kanade(rgb, moved, uv)
    assert (tracks.uv_1 - lucas_kanade(grey, torch.roll(grey, (2, 1), (2, 3)), uv).uv_1).abs().max() < 0.02
    assert (tracks.uv_1 - uv - torch.tensor([1.0, 2.0]))[tracks.valid].abs().max() < 0.02


# --- house rules -----------------------------------------------------------------------------------------------------


def test_points_that_share_a_coarse_search_do_not_depend_on_each_other(monkeypatch):
    """On four levels points of one cell are searched for together: bit for bit as alone, and in torch as where nothing is
    shared (under vmap)."""
    H, W = 176, 200
    src, dst = (scene(2, H, W, shift, dtype=torch.float32) for shift in ((0.0, 0.0), (11.3, -6.2)))
    uv = points(2, 100, H, W, dtype=torch.float32)
    assert len(build_pyramid(src).levels) > CELL_LEVEL
    whole = lucas_kanade(src, dst, uv)
    assert whole.valid.float().mean() > 0.5
    for b, n in ((0, 3), (1, 77)):
        alone = lucas_kanade(src[b : b + 1], dst[b : b + 1], uv[b : b + 1, n : n + 1])
        assert all(torch.equal(getattr(alone, f)[0, 0], getattr(whole, f)[b, n]) for f in FIELDS)
    part = uv[:, :20]
    mapped = torch.func.vmap(lambda i, j, x: lucas_kanade(i[None], j[None], x[None])[0])(src, dst, part)
    monkeypatch.setattr(dispatch, "is_in_use", lambda: False)
    whole = lucas_kanade(src, dst, uv)
    assert all(torch.equal(getattr(mapped, f), getattr(whole, f)[:, :20]) for f in FIELDS)


@pytest.mark.parametrize("normalise", ["none", "bias", "gain_bias"])
def test_refine_gradcheck(normalise):
    src, dst = scene(2, 24, 26), scene(2, 24, 26, (0.7, 0.3)) * 1.1
    uv_0 = points(2, 3, 24, 26, margin=2)
    uv_1 = uv_0 + torch.tensor([0.8, 0.25], dtype=torch.float64)
    leaves = tuple(x.clone().requires_grad_() for x in (src, dst, uv_0))
    step = lambda i, j, x: refine_tracks(i, j, x, uv_1, window=7, normalise=normalise)  # noqa: E731
    assert (step(*leaves) - uv_1).abs().min() > 1e-4
    assert torch.autograd.gradcheck(step, leaves, fast_mode=True)


def test_gradient_is_that_of_the_tracked_position():
    """Moving the start moves the end alike; moving image 1's content moves the end with it (finite differences of the
    whole search, not of the step)."""
    H, W = 80, 90
    src, dst = scene(1, H, W), scene(1, H, W, (1.4, 0.8))
    uv = points(1, 20, H, W, margin=25)
    J_leaf, uv_leaf = dst.clone().requires_grad_(), uv.clone().requires_grad_()
    tracks = lucas_kanade(src, J_leaf, uv_leaf)
    to_uv, to_J = torch.autograd.grad(tracks.uv_1[..., 0].sum(), (uv_leaf, J_leaf))
    assert (to_uv[..., 0] - 1).abs().median() < 0.05 and to_uv[..., 1].abs().median() < 0.05
    drift = scene(1, H, W, (1.41, 0.8)) - dst
    assert abs((to_J * drift).sum().item() / (20 * 0.01) - 1) < 0.05


# --- real images -----------------------------------------------------------------------------------------------------


def real_pairs():
    root = Path(ROOT or ".")
    kitchen = [(f"7s_redkitchen_{k}", 20) for k in ("000", "200", "400", "600")]
    for name, gap in (("holo_a", 3), *kitchen, ("tum_fr1_desk9", 4)):
        files = sorted(f for f in (root / name).rglob("*") if f.suffix in (".png", ".jpg") and "depth" not in str(f))
        yield from ((name, files[i], files[i + gap], 4) for i in range(0, len(files) - gap, 24))
    motorcycle = root / "middlebury_motorcycle"
    yield "motorcycle", motorcycle / "motorcycle_left.png", motorcycle / "motorcycle_right.png", 6
    files = sorted((root / "dgp_drive6cam").rglob("*.jpg"))
    yield from (("dgp", a, b, 6) for a, b in pairwise(files) if a.parent == b.parent)


def opencv(a, b, uv, n_levels):
    """Forward and back, as users of OpenCV do: positions, and round trips below 1 px."""
    options = {"winSize": (21, 21), "maxLevel": n_levels - 1, "criteria": (3, 30, 0.01)}
    there, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, uv[:, None], None, **options)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, **options)
    return (
        there[:, 0],
        (ok * ok_back)[:, 0].astype(bool) & (np.linalg.norm(back[:, 0] - uv, axis=1) < 1),
        (ok * ok_back)[:, 0] > 0,
    )


def tensor(image):
    return torch.from_numpy(image)[None, None]


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_real_pairs_agree_with_opencv():
    draw, distances, verdicts = np.random.default_rng(0), {}, []
    for name, file_0, file_1, n_levels in real_pairs():
        a, b = (cv2.imread(str(f), cv2.IMREAD_GRAYSCALE) for f in (file_0, file_1))
        uv = (draw.random((800, 2)) * [a.shape[1] - 1, a.shape[0] - 1]).astype(np.float32)
        expected, ok, _ = opencv(a, b, uv, n_levels)
        tracks = lucas_kanade(tensor(a), tensor(b), torch.from_numpy(uv)[None], levels=n_levels)
        valid = tracks.valid[0].numpy()
        distance = np.linalg.norm(tracks.uv_1[0].numpy() - expected, axis=1)
        distances.setdefault(name, []).append(distance[ok & valid])
        verdicts.append((ok == valid).mean())
    assert len(distances) == 8
    for name, parts in distances.items():
        distance = np.concatenate(parts)
        assert len(distance) > 40, name
        assert np.median(distance) < 0.05, name
        assert (distance < 0.3).mean() > 0.95, name
    assert np.mean(verdicts) > 0.95


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_misses_on_known_warps_of_real_images():
    root, misses = Path(ROOT), []
    names = ("7s_redkitchen_000", "7s_redkitchen_200", "7s_redkitchen_400", "holo_a", "tum_fr1_desk9")
    for seed, name in enumerate(names):
        draw = np.random.default_rng(seed)
        file = min(f for f in (root / name).rglob("*") if f.suffix in (".png", ".jpg") and "depth" not in str(f))
        a = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        H, W = a.shape
        M = cv2.getRotationMatrix2D((W / 2, H / 2), draw.uniform(-4, 4), draw.uniform(0.95, 1.05))
        M[:, 2] += draw.uniform(-12, 12, 2)
        b = cv2.warpAffine(a, M, (W, H), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        b = np.clip(b + draw.normal(0, 2, b.shape), 0, 255).astype(np.uint8)
        uv = (draw.random((1024, 2)) * [W - 1, H - 1]).astype(np.float32)
        truth = uv @ M[:, :2].T + M[:, 2]
        inside = ((truth >= 0) & (truth <= [W - 1, H - 1])).all(1)
        theirs, _, found = opencv(a, b, uv, 4)
        ours = lucas_kanade(tensor(a), tensor(b), torch.from_numpy(uv)[None], max_round_trip_px=1e9)
        lost = [~ours.valid[0].numpy() | (np.linalg.norm(ours.uv_1[0].numpy() - truth, axis=1) > 1)]
        lost += [~found | (np.linalg.norm(theirs - truth, axis=1) > 1)]
        misses.append([x[inside].mean() for x in lost])
    ours, theirs = np.mean(misses, 0)
    assert ours < 1.05 * theirs + 0.002, (ours, theirs)


def test_image_smaller_than_a_window_at_a_level_uses_fewer_levels():
    src, dst = scene(1, 40, 50), scene(1, 40, 50, (1.5, 0.5))
    uv = points(1, 20, 40, 50, margin=14)
    assert torch.equal(lucas_kanade(src, dst, uv, levels=5).uv_1, lucas_kanade(src, dst, uv, levels=1).uv_1)
    J_large = F.pad(dst, (0, 60, 0, 60), mode="replicate")
    assert lucas_kanade(src, J_large, uv, levels=5).valid.float().mean() > 0.9
