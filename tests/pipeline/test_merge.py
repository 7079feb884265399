"""Between the stages: precisions of intrinsics, and tracks through lenses."""

import numpy as np
import torch

from dhtorch.geometry import camera as cam
from dhtorch.pipeline.pair import undistort_tracks, upcast_intrinsics
from dhtorch.records import Camera, Frame, Tracks

HW = (20, 30)


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frame(batch=2, seed=0, dtype=torch.float64, lens=None):
    camera = Camera(torch.tensor([[40.0, 42.0]]), torch.tensor([[15.0, 9.0]]), lens)
    camera = camera.map(lambda x: x.expand(batch, -1)).to(dtype)
    return Frame(image=rand(batch, 1, *HW, seed=seed).float(), depth=1 + rand(batch, *HW, seed=seed + 1), camera=camera)


def tracks_of(uv, seed=13):
    batch, n = uv.shape[:2]
    half = rand(batch, n, 2, 2, seed=seed) - 0.5
    return Tracks(
        uv_0=uv,
        uv_1=uv + 2 * rand(batch, n, 2, seed=seed + 1) - 1,
        error=rand(batch, n, seed=seed + 2),
        photometric=rand(batch, n, seed=seed + 3),
        cov=half @ half.mT + 0.1 * torch.eye(2),
        valid=rand(batch, n, seed=seed + 4) < 0.8,
    )


# ---------------------------------------------------------------------------------------------------- the map


# ---------------------------------------------------------------------------------------------------- without texture


def test_intrinsics_of_half_precision_are_computed_with_as_single_ones():
    half = frame(1, dtype=torch.float16)
    seen = half.camera.map(lambda x: x[:1])
    both = half.replace(depth_camera=seen, image=half.image.half())
    found = upcast_intrinsics(both)
    assert found.camera.f.dtype == found.depth_camera.c.dtype == torch.float32
    assert torch.equal(found.camera.f, half.camera.f.float()) and found.image.dtype == torch.float16
    for dtype in (torch.float32, torch.float64):
        plain = frame(1, dtype=dtype)
        assert upcast_intrinsics(plain).camera is plain.camera and upcast_intrinsics(plain).depth_camera is None


# ---------------------------------------------------------------------------------------------------- draws


# ---------------------------------------------------------------------------------------------------- lenses

LENS_0 = torch.tensor([[0.262383, -0.953104, -0.005358, 0.002628, 1.163314]])
LENS_1 = torch.tensor([[-0.21, 0.09, 0.012, -0.007, 0.02]])


def through_lenses():
    """Two different lenses, and tracks (1, 40) with covariances of their own."""
    camera_0 = Camera(torch.tensor([[517.3, 516.5]]), torch.tensor([[318.6, 255.3]]), LENS_0)
    camera_1 = Camera(torch.tensor([[420.0, 470.0]]), torch.tensor([[300.6, 231.3]]), LENS_1)
    tracks = tracks_of(rand(1, 40, 2, seed=50) * torch.tensor([560.0, 400.0]) + 40)
    return tracks, camera_0.to(torch.float64), camera_1.to(torch.float64)


def test_tracks_lose_the_lens_of_their_own_view():
    tracks, camera_0, camera_1 = through_lenses()
    ideal = undistort_tracks(tracks, camera_0, camera_1)
    torch.testing.assert_close(cam.distort(camera_0, ideal.uv_0), tracks.uv_0, atol=1e-6, rtol=0)
    torch.testing.assert_close(cam.distort(camera_1, ideal.uv_1), tracks.uv_1, atol=1e-6, rtol=0)
    assert torch.equal(ideal.valid, tracks.valid)
    assert torch.equal(ideal.error, tracks.error) and torch.equal(ideal.photometric, tracks.photometric)
    assert undistort_tracks(tracks, cam.ideal(camera_0), cam.ideal(camera_1)) is tracks
    for one, other in ((camera_0, cam.ideal(camera_1)), (cam.ideal(camera_0), camera_1)):
        half = undistort_tracks(tracks, one, other)
        assert torch.equal(half.uv_0, tracks.uv_0 if one.distortion is None else ideal.uv_0)
        torch.testing.assert_close(half.uv_1, tracks.uv_1 if other.distortion is None else ideal.uv_1)
        torch.testing.assert_close(half.cov, tracks.cov if other.distortion is None else ideal.cov)


def test_covariances_go_through_the_second_lens_as_finite_differences_do():
    tracks, camera_0, camera_1 = through_lenses()
    ideal, h = undistort_tracks(tracks, camera_0, camera_1), 1e-3
    columns = []
    for step in h * torch.eye(2).double():
        columns.append(
            (cam.undistort(camera_1, tracks.uv_1 + step) - cam.undistort(camera_1, tracks.uv_1 - step)) / (2 * h)
        )
    J = torch.stack(columns, -1)[0].numpy()
    assert np.abs(J[:, 0, 1] - J[:, 1, 0]).max() > 0.01, "a Jacobian that is not its transpose"
    expected = [J[k] @ tracks.cov[0, k].numpy() @ J[k].T for k in range(40)]
    np.testing.assert_allclose(ideal.cov[0].numpy(), expected, rtol=1e-5)


def test_a_pixel_outside_of_a_lens_model_or_no_number_is_no_longer_valid():
    camera = Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[8.0, 8.0]]), torch.tensor([[-0.4, 0.0, 0.0, 0.0]]))
    camera = camera.to(torch.float64)
    tracks = tracks_of(torch.tensor([[[9.0, 9.0]]]).double().expand(1, 7, 2))
    out, nan = torch.tensor([60.0, 60.0]).double(), torch.nan
    uv_0, uv_1, cov = tracks.uv_0.clone(), tracks.uv_1.clone(), tracks.cov.clone()
    uv_0[0, 1], uv_1[0, 2], uv_0[0, 3, 0], uv_1[0, 4, 1], cov[0, 5] = out, out, nan, nan, nan
    valid = torch.ones(1, 7, dtype=torch.bool)
    valid[0, 6] = False
    leaves = [x.requires_grad_() for x in (uv_0, uv_1, cov)]
    given = tracks.replace(uv_0=uv_0, uv_1=uv_1, cov=cov, valid=valid)
    found = undistort_tracks(given, camera, camera)
    assert found.valid.tolist() == [[True, False, False, False, False, True, False]]
    for x, y in ((found.uv_0, uv_0), (found.uv_1, uv_1)):
        assert torch.equal(x[0, 1:5].nan_to_num(-7), y[0, 1:5].nan_to_num(-7)), "it stays where it was"
    assert found.cov[0, 5].isnan().all() and found.cov[0, :5].isfinite().all()
    (found.uv_0[0, :2].sum() + found.uv_1[0, :2].sum() + found.cov[0, :2].sum()).backward()
    assert all(x.grad.isfinite().all() for x in leaves)
