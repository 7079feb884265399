"""Lucas-Kanade: illumination, silent images, colours, known warps of real images; number by number: test_lucas_kanade.py."""

import os
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


# --- what cannot be found --------------------------------------------------------------------------------------------


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


# --- real images -----------------------------------------------------------------------------------------------------


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
