"""Stage 6 on a scene: closed-form two-view depth, its uncertainty, the gates; option by option: test_two_view.py."""

import math

import cv2
import numpy as np
import pytest
import torch

from dhtorch.codes import Gate
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar, se3
from dhtorch.records import Camera, Samples, Tracks
from dhtorch.stages.triangulate import two_view


def scene(n=200, batch=2, dtype=torch.float64, seed=0, noise_px=0.0, t=(0.2, -0.05, 0.03)):
    """Points seen by two different cameras: samples, tracks, exact pose, cameras, true depth."""
    rng = torch.Generator().manual_seed(seed)
    rand = lambda *s: torch.rand(*s, generator=rng, dtype=torch.float64)  # noqa: E731
    camera_0 = Camera(
        torch.tensor([[500.0, 505.0]]).repeat(batch, 1).double(),
        torch.tensor([[320.0, 240.0]]).repeat(batch, 1).double(),
    )
    camera_1 = Camera(
        torch.tensor([[420.0, 410.0]]).repeat(batch, 1).double(),
        torch.tensor([[300.0, 260.0]]).repeat(batch, 1).double(),
    )
    uv_0 = rand(batch, n, 2) * torch.tensor([600.0, 440.0]) + 20
    depth = 2 + 4 * rand(batch, n)
    T = se3.exp(torch.cat((0.1 * (rand(batch, 3) - 0.5), torch.tensor(t).double().expand(batch, 3)), -1))
    xyz = cam.unproject(camera_0, uv_0, depth)
    noise = torch.randn(batch, n, 2, generator=rng, dtype=torch.float64) * noise_px
    uv_1 = cam.project(camera_1, se3.apply(T, xyz)) + noise
    zero = torch.zeros(batch, n, dtype=torch.float64)
    flag = zero.to(torch.int32)
    samples = Samples(uv_0, zero, zero, torch.full_like(xyz, torch.nan), zero, flag, zero + 1, flag)
    cov = torch.eye(2, dtype=torch.float64).expand(batch, n, 2, 2) * max(noise_px, 0.1) ** 2
    tracks = Tracks(uv_0, uv_1, zero, zero, cov, zero == 0)
    cast = lambda r: r.to(dtype)  # noqa: E731
    return cast(samples), cast(tracks), cast(known_pose_fit(T, n)), cast(camera_0), cast(camera_1), depth.to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_exact_input_gives_exact_depth(dtype):
    *stage, depth = scene(dtype=dtype)
    estimate = two_view(*stage)
    assert (estimate.gate == Gate.ANSWER).all()
    assert torch.allclose(estimate.depth, depth, rtol=1e-9 if dtype == torch.float64 else 2e-3)
    assert estimate.residual_px.max() < (1e-9 if dtype == torch.float64 else 1e-2)


def test_agrees_with_opencv_and_is_the_maximum_likelihood_depth():
    _, tracks, fit, camera_0, camera_1, depth = scene(noise_px=0.5, batch=1)
    ours = epipolar.triangulate(tracks.uv_0, tracks.uv_1, camera_0, camera_1, fit.T_1_from_0)
    K_0, K_1 = (cam.to_matrix(c)[0].numpy() for c in (camera_0, camera_1))
    T = se3.to_matrix(fit.T_1_from_0)[0, :3].numpy()
    X = cv2.triangulatePoints(K_0 @ np.eye(3, 4), K_1 @ T, tracks.uv_0[0].T.numpy(), tracks.uv_1[0].T.numpy())
    theirs = torch.from_numpy(X[2] / X[3])
    errors = [((z - depth[0]) / depth[0]).abs().median() for z in (ours.depth[0], theirs)]
    assert errors[0] <= errors[1] * 1.02
    # No other depth along the reference view's ray comes closer to the measured pixel.
    for step in (-1e-3, 1e-3):
        moved = cam.unproject(camera_0, tracks.uv_0, ours.depth * (1 + step))
        miss = (cam.project(camera_1, se3.apply(fit.T_1_from_0, moved)) - tracks.uv_1).norm(dim=-1)
        assert (miss >= ours.residual_px - 1e-9).all()


def test_gates_name_the_first_reason():
    samples, tracks, fit, camera_0, camera_1, depth = scene(n=6, batch=1)
    uv_1, valid = tracks.uv_1.clone(), tracks.valid.clone()
    valid[0, 0] = False
    uv_1[0, 1] = torch.nan
    # The image of a point behind camera 0 on the same ray: an intersection with negative depth.
    behind = cam.unproject(camera_0, tracks.uv_0, -depth)
    uv_1[0, 2] = cam.project(camera_1, se3.apply(fit.T_1_from_0, behind))[0, 2]
    far = cam.unproject(camera_0, tracks.uv_0, torch.full_like(depth, 500.0))
    uv_1[0, 3] = cam.project(camera_1, se3.apply(fit.T_1_from_0, far))[0, 3]
    geometry = epipolar.triangulate(tracks.uv_0, tracks.uv_1, camera_0, camera_1, fit.T_1_from_0)
    along = geometry.slope[0, 4] / geometry.slope[0, 4].norm()
    uv_1[0, 4] += 5 * torch.stack((-along[1], along[0]))
    estimate = two_view(samples, tracks.replace(uv_1=uv_1, valid=valid), fit, camera_0, camera_1)
    expected = [Gate.NO_TRACK, Gate.NO_TRACK, Gate.BEHIND, Gate.PARALLAX, Gate.RESIDUAL, Gate.ANSWER]
    assert estimate.gate[0].tolist() == expected
    assert math.isclose(estimate.residual_px[0, 4], 5, rel_tol=1e-3)
    assert estimate.depth[0, :5].isnan().all() and (estimate.score[0] == torch.tensor([0, 0, 0, 0, 0, 1.0])).all()
    open_gates = two_view(
        samples,
        tracks.replace(uv_1=uv_1, valid=valid),
        fit,
        camera_0,
        camera_1,
        min_parallax_deg=None,
        max_residual_px=None,
    )
    assert open_gates.gate[0].tolist() == [Gate.NO_TRACK] * 2 + [Gate.BEHIND] + [Gate.ANSWER] * 3
