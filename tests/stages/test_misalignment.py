"""Depth attached to other pixels than the picture's: the pair gets a code of its own; sound pairs keep every bit."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from dhtorch import ExtendDepth
from dhtorch.codes import Gate, PoseCode, Source
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline.presets import MAP
from dhtorch.records import Camera, Pose, PoseFit, Samples, Tracks
from dhtorch.stages.misalignment import reject_misaligned
from dhtorch.stages.pose import map_pose, pnp_ransac
from dhtorch.stages.triangulate import two_view

N, SIZE = 2048, torch.tensor([640.0, 480.0], dtype=torch.float64)
CENTRE = SIZE / 2
CAMERA = Camera(f=torch.full((1, 2), 525.0, dtype=torch.float64), c=CENTRE[None])
#: What a loader does to pictures alone → pixel of the depth that a pixel of the picture belongs to.
ALTERED = {
    "mirrored": lambda uv: torch.stack((SIZE[0] - uv[..., 0], uv[..., 1]), -1),
    "upside down": lambda uv: torch.stack((uv[..., 0], SIZE[1] - uv[..., 1]), -1),
    "turned": lambda uv: SIZE - uv,
    "cropped": lambda uv: CENTRE + 0.8 * (uv - CENTRE),
    "shifted": lambda uv: uv - torch.tensor([0.1, 0.0], dtype=uv.dtype) * SIZE,
}


def depth_at(uv: Tensor) -> Tensor:
    """A room with boxes in it, as depth (…) m at pixels (…, 2): piecewise, with edges and slopes."""
    x, y = ((uv - CENTRE) / SIZE).unbind(-1)
    depth = 2.4 - 1.0 * y + 1.4 * x
    depth = torch.where((x + 0.25).abs() + (y - 0.1).abs() < 0.16, 1.1 + 0 * x, depth)
    depth = torch.where((x - 0.2).square() + (y + 0.2).square() < 0.02, 1.6 + 0 * x, depth)
    return torch.where((x - 0.35).abs().maximum((y - 0.3).abs()) < 0.1, 0.9 + 0 * x, depth)


def pair(altered=None, step=0.08, dtype=torch.float64) -> tuple[Samples, Tracks, Camera]:
    """A pair whose pictures show the room at altered pixels, and its depth that at the own pixels."""
    draw = torch.Generator().manual_seed(1)
    uv_0 = 20 + torch.rand(1, N, 2, generator=draw, dtype=torch.float64) * (SIZE - 40)
    T = Pose(
        se3.exp(torch.tensor([[0.01, -0.02, 0.005, 0, 0, 0]], dtype=torch.float64)).R,
        torch.tensor([[step, 0.3 * step, 0.2 * step]], dtype=torch.float64),
    )
    scene = uv_0 if altered is None else altered(uv_0)
    xyz = cam.unproject(CAMERA, scene, depth_at(scene))
    moved = cam.project(CAMERA, (T.R[:, None] @ xyz[..., None])[..., 0] + T.t[:, None])
    uv_1 = moved if altered is None else uv_0 + shown(altered, scene, moved)
    uv_1 = uv_1 + 0.15 * torch.randn(1, N, 2, generator=draw, dtype=torch.float64)
    depth = depth_at(uv_0)
    near = torch.arange(N) % 4 > 0
    points = torch.where(near[:, None], cam.unproject(CAMERA, uv_0, depth), torch.nan)
    zero, code = torch.zeros(1, N, dtype=torch.float64), torch.zeros(1, N, dtype=torch.int32)
    unread = {"confidence": zero, "flag": code, "trackability": zero + 1, "hole": code}
    samples = Samples(uv_0, torch.where(near, depth, 0.0), sigma=0.01 * depth, xyz=points, **unread)
    cov = 0.02 * torch.eye(2, dtype=torch.float64).expand(1, N, 2, 2)
    tracks = Tracks(uv_0, uv_1, error=zero, photometric=zero, cov=cov, valid=zero == 0)
    return samples.to(dtype), tracks.to(dtype), CAMERA.to(dtype)


def shown(altered, scene: Tensor, moved: Tensor) -> Tensor:
    """Displacement in the altered picture of what moves from ``scene`` to ``moved`` in the whole one."""
    zero = torch.zeros(2, dtype=torch.float64)
    axes = torch.stack([altered(axis) - altered(zero) for axis in torch.eye(2, dtype=torch.float64)]).diagonal()
    return (moved - scene) / axes


def solved(stage, samples: Samples, tracks: Tracks, camera: Camera) -> PoseFit:
    draws = torch.rand(1, 200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return stage(samples, tracks, camera, camera, draws)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stage", [map_pose, pnp_ransac])
def test_sound_pairs_keep_every_bit(stage, dtype):
    for step in (0.04, 0.08, 0.15):
        samples, tracks, camera = pair(step=step, dtype=dtype)
        fit = solved(stage, samples, tracks, camera)
        checked = reject_misaligned(samples, tracks, fit, camera, camera)
        assert fit.ok.all() and checked.ok.all()
        for name in ("cov", "inlier", "rms_px", "sigma_px", "t_snr", "code"):
            assert torch.equal(getattr(fit, name), getattr(checked, name)), name
        assert torch.equal(fit.T_1_from_0.R, checked.T_1_from_0.R)


#: Of crops and shifts the most probable pose absorbs too much in this room for a decision.
FOUND = [
    *((map_pose, name) for name in ("mirrored", "upside down", "turned")),
    *((pnp_ransac, name) for name in ALTERED),
]


@pytest.mark.parametrize(("stage", "name"), FOUND)
def test_altered_pictures_have_no_answer(stage, name):
    samples, tracks, camera = pair(ALTERED[name])
    fit = solved(stage, samples, tracks, camera)
    checked = reject_misaligned(samples, tracks, fit, camera, camera)
    assert not checked.ok.any() and (stage is map_pose or fit.ok.all())
    if fit.ok.any():
        assert checked.code.tolist() == [PoseCode.MISALIGNED]
        assert checked.T_1_from_0.t.isnan().all() and not checked.inlier.any()
        estimate = two_view(samples, tracks, checked, camera, camera)
        assert (estimate.gate == Gate.MISALIGNED).all()


def misaligned() -> tuple[Samples, Tracks, Camera, PoseFit]:
    """A pair that the near returns of its own pixels refute, under the pose of the sound one."""
    samples, tracks, camera = pair()
    wrong = torch.flip(samples.xyz[..., 2:], (1,))
    xyz = torch.where(samples.usable[..., None], samples.xyz / samples.xyz[..., 2:] * wrong, torch.nan)
    return samples.replace(xyz=xyz), tracks, camera, solved(map_pose, samples, tracks, camera)


def test_limits_and_what_cannot_be_tested():
    samples, tracks, camera, fit = misaligned()

    def code(few: slice = slice(None), **options) -> int:
        some = tracks.replace(valid=tracks.valid & (torch.arange(N) < N)[None])
        some = some.replace(valid=torch.zeros_like(some.valid).index_fill(1, torch.arange(N)[few], True))
        return int(reject_misaligned(samples, some, fit, camera, camera, **options).code)

    assert code() == PoseCode.MISALIGNED
    assert code(slice(0, 20)) == PoseCode.OK  # fewer returns than are tested
    assert code(min_t_snr=1e9) == PoseCode.OK
    assert code(max_unexplained=9.0, min_gain=0.0) == PoseCode.OK
    assert code(slice(0, 80)) == PoseCode.MISALIGNED and code(slice(0, 80), few_returns=99.0) == PoseCode.OK


def test_only_the_rejected_pair_of_a_batch_changes_also_beyond_a_chunk():
    samples, tracks, camera, fit = misaligned()
    whole, *_ = pair()
    batch = 18

    def repeat(x):
        return x.map(lambda y: y.expand(batch, *y.shape[1:]))

    xyz = torch.cat((samples.xyz, whole.xyz.expand(batch - 1, -1, -1)))
    inputs = repeat(whole).replace(xyz=xyz), repeat(tracks), repeat(fit), repeat(camera), repeat(camera)
    checked = reject_misaligned(*inputs)
    assert checked.code.tolist() == [PoseCode.MISALIGNED] + [PoseCode.OK] * (batch - 1)
    assert checked.T_1_from_0.t[0].isnan().all() and torch.equal(checked.T_1_from_0.t[1:], inputs[2].T_1_from_0.t[1:])


ROOT = os.environ.get("DHTORCH_DATA")


@pytest.mark.data
@pytest.mark.skipif(not ROOT, reason="DHTORCH_DATA is not set")
def test_a_loader_that_mirrors_pictures_alone_is_silent_and_named():
    case = Path(str(ROOT)) / "field_cases" / "27-loader-mirror-and-65535"
    pictures = [cv2.imread(str(case / f"0000{i}.jpg"))[:, :, ::-1].copy() for i in (0, 4)]
    images = [torch.from_numpy(picture).permute(2, 0, 1) for picture in pictures]
    code = cv2.imread(str(case / "00000.png"), -1).astype(np.int32)
    depth, K = torch.from_numpy(np.where(code < 1800, code, 0)), torch.tensor([525.0, 525.0, 319.5, 239.5])
    sample = {"depth": depth, "intrinsics": K}
    extend = ExtendDepth(method=MAP, other_image="image1", depth_unit="mm")
    sound = extend({**sample, "image": images[0], "image1": images[1]})
    assert (sound["dhtorch.source"] == Source.RECOVERED).sum() > 200 and sound["dhtorch.pose_code"] == PoseCode.OK
    mirrored = extend({**sample, "image": images[0].flip(2), "image1": images[1].flip(2)})
    assert not (mirrored["dhtorch.source"] == Source.RECOVERED).any()
    assert mirrored["dhtorch.pose_code"] == PoseCode.MISALIGNED
