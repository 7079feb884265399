"""Functions in kornia's conventions: the checks of kornia's ``BaseTester``, and an oracle beside each function."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch
from kornia.core.exceptions import BaseError
from kornia.geometry.calibration import solve_pnp_dlt
from kornia.geometry.epipolar import triangulate_points
from torch.autograd import gradcheck

from dhtorch import functional as fn
from dhtorch.geometry import se3

K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 520.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
K_2 = torch.tensor([[480.0, 0.0, 310.0], [0.0, 470.0, 250.0], [0.0, 0.0, 1.0]], dtype=torch.float64)

both_precisions = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
any_batch = pytest.mark.parametrize("batch", [(), (2,), (2, 3)])


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def seen(points, intrinsics):
    """Pixels (*, N, 2) of points of a camera."""
    uv = points @ intrinsics.mT
    return uv[..., :2] / uv[..., 2:]


def scene(batch=(), n=12, noise_px=0.0):
    """Points (*, n, 3) in camera 1, their pixels in both views, and R, t."""
    xyz = uniform(*batch, n, 3, seed=1) * torch.tensor([3.0, 2.0, 4.0]) + torch.tensor([-1.5, -1.0, 2.0])
    T = se3.exp(torch.tensor([[0.03, -0.08, 0.02, -0.4, 0.1, 0.05]], dtype=torch.float64))
    R, t = T.R[0].expand(*batch, 3, 3), T.t[0, :, None].expand(*batch, 3, 1)
    points2 = seen(xyz @ R.mT + t.mT, K_2) + noise_px * normal(*batch, n, 2, seed=2)
    return xyz, seen(xyz, K), points2, R, t


def pictures(batch=1, dtype=torch.float64, shift=(3.0, -2.0), hw=(96, 128)):
    """A smooth image and the same moved by ``shift`` px, (batch, 1, H, W) each."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in hw), indexing="ij")

    def at(u, v):
        return 0.5 + 0.2 * (u / 4).sin() * (v / 7).cos() + 0.15 * (u / 9 + v / 5).sin() + 0.1 * (v / 3).cos()

    two = (at(u, v), at(u - shift[0], v - shift[1]))
    return tuple(x[None, None].repeat(batch, 1, 1, 1).to(dtype) for x in two)


def places(batch=1, n=6, dtype=torch.float64):
    """Pixels of such an image away from its border."""
    return (uniform(batch, n, 2, seed=4) * torch.tensor([80.0, 48.0]) + 24).to(dtype)


def solve(*args, **options):
    return fn.solve_pnp_ransac(*args, **options, generator=torch.Generator())


def moved_image(shift, points):
    """The points of an image in a copy moved by ``shift`` (2,)."""
    v, u = torch.meshgrid(torch.arange(96.0).double(), torch.arange(128.0).double(), indexing="ij")
    u, v = u - shift[0], v - shift[1]
    second = 0.5 + 0.2 * (u / 4).sin() * (v / 7).cos() + 0.15 * (u / 9 + v / 5).sin() + 0.1 * (v / 3).cos()
    return fn.track_points_lk(pictures()[0], second[None, None], points, eps=1e-8, num_iters=60).points


def few_hypotheses(*args):
    return fn.solve_pnp_ransac(*args, num_hypotheses=64, generator=torch.Generator().manual_seed(0)).world_to_cam


SHAPES = {
    fn.triangulate_points_one_sided: lambda batch, n: [(*batch, n, 3), (*batch, n, 3, 3)],
    fn.solve_p3p: lambda batch, n: [(*batch, 4, 3, 4), (*batch, 4)],
    solve: lambda batch, n: [(*batch, 3, 4), batch, (*batch, n), (*batch, 6, 6)],
}


def arguments(function, batch, n):
    xyz, points1, points2, R, t = scene(batch, 3 if function is fn.solve_p3p else n)
    return (points1, points2, K, K_2, R, t) if function is fn.triangulate_points_one_sided else (xyz, points2, K_2)


@pytest.mark.parametrize("function", SHAPES)
@both_precisions
@any_batch
def test_shapes_follow_the_batch_and_dtypes_the_points(function, batch, dtype):
    args = arguments(function, batch, 12)
    out = function(*(x.to(dtype) for x in args))
    assert [x.shape for x in out] == SHAPES[function](batch, 12)
    assert all(x.dtype in (dtype, torch.bool) for x in out)
    pose = torch.cat(scene(batch)[3:], -1)
    if function is fn.solve_p3p:
        off = torch.where(out[1], (out[0] - pose[..., None, :, :]).abs().amax((-1, -2)), torch.inf).amin(-1)
    else:
        off = (out[0] - (pose if function is solve else scene(batch)[0])).abs()
    assert off.max() < (1e-6 if dtype == torch.float64 else 1e-2)
    if function is fn.triangulate_points_one_sided:
        assert function(*arguments(function, batch, 0))[0].shape == (*batch, 0, 3)


@both_precisions
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("hw", [(96, 128), (97, 131)])
@pytest.mark.parametrize("shift", [(3.0, -2.0), (-9.5, 6.25)])
def test_a_moved_image(shift, hw, batch, channels, dtype):
    """Small and large motions; sizes that do not halve evenly."""
    first, second = (x.repeat(1, channels, 1, 1) for x in pictures(batch, dtype, shift, hw))
    points = places(batch, 30, dtype)
    tracks = fn.track_points_lk(first, second, points, num_levels=3)
    assert [x.shape for x in tracks] == [(batch, 30, 2), (batch, 30), (batch, 30), (batch, 30, 2, 2)]
    assert tracks.points.dtype == tracks.covariance.dtype == dtype and tracks.valid.dtype == torch.bool
    off = (tracks.points - points - torch.tensor(shift, dtype=dtype))[tracks.valid]
    assert tracks.valid.float().mean() > 0.8 and off.abs().max() < 0.05
    assert (tracks.round_trip[tracks.valid] < 0.1).all()
    assert fn.track_points_lk(first, second, points[:, :0]).points.shape == (batch, 0, 2)


PAIR, PLACES = pictures(2), places(2)


@pytest.mark.parametrize(
    ("function", "args", "position", "wrong"),
    [
        *((fn.triangulate_points_one_sided, arguments(fn.triangulate_points_one_sided, (), 12), k, x) for k, x in ((0, lambda x: x[..., :1]), (0, lambda x: x[:-1]), (2, lambda x: x[:2]), (5, lambda x: x[:, 0]))),
        *((fn.track_points_lk, (*PAIR, PLACES, PLACES), k, x) for k, x in ((0, lambda x: x[0]), (2, lambda x: x[..., :1]), (2, lambda x: x[:1]), (1, lambda x: x[:1]), (3, lambda x: x[0]))),
        *((fn.solve_p3p, arguments(fn.solve_p3p, (2,), 3), k, x) for k, x in ((0, lambda x: x[:, :2]), (1, lambda x: x[..., :1]), (2, lambda x: x[:2]))),
        *((solve, arguments(solve, (2,), 12), k, x) for k, x in ((0, lambda x: x[..., :2]), (0, lambda x: x[:, 1:]), (2, lambda x: x[0]))),
    ],
)  # fmt: skip
def test_wrong_shapes_raise_kornias_error(function, args, position, wrong):
    function(*args)
    with pytest.raises(BaseError):
        function(*args[:position], wrong(args[position]), *args[position + 1 :])


@pytest.mark.parametrize(
    ("function", "args", "options"),
    [
        (fn.triangulate_points_one_sided, (*scene((2,), 3, 1.0)[1:3], K, K_2, *scene((2,), 3)[3:]), {"rtol": 1e-3, "atol": 1e-5}),
        # Residuals that are not zero count as well.
        (few_hypotheses, (scene(n=12)[0], scene(n=12, noise_px=0.3)[2], K_2), {"eps": 1e-5, "atol": 1e-4, "rtol": 1e-3}),
        # The step reads Scharr gradients of pixels, the finite difference the image between them: they differ by up to
        # 0.04, from an exact derivative of 1 both by less than that.
        (moved_image, (torch.tensor([2.0, -1.0], dtype=torch.float64), places(n=3)), {"eps": 1e-2, "atol": 0.04}),
    ],
)  # fmt: skip
def test_gradients_are_those_of_finite_differences(function, args, options):
    assert gradcheck(function, [x.clone().requires_grad_() for x in args], **options)


@pytest.mark.parametrize(
    ("function", "args", "options"),
    [
        (fn.triangulate_points_one_sided, arguments(fn.triangulate_points_one_sided, (2,), 12), {}),
        (fn.solve_p3p, arguments(fn.solve_p3p, (2,), 3), {}),
        pytest.param(fn.track_points_lk, (*pictures(), places()), {"num_levels": 2}, marks=pytest.mark.slow),
        pytest.param(fn.solve_pnp_ransac, arguments(solve, (2,), 20), {"num_hypotheses": 32}, marks=pytest.mark.slow),
    ],
)
def test_functions_are_captured_as_one_graph(function, args, options):
    torch._dynamo.reset()  # a call of another shape before would make sizes symbols
    captured = torch.compile(partial(function, **options), backend="eager", fullgraph=True)(*args)
    for a, b in zip(captured, function(*args, **options), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3)


@both_precisions
def test_exact_points_are_those_of_opencv_and_kornia(dtype):
    xyz, points1, points2, R, t = scene()
    X, _ = fn.triangulate_points_one_sided(*(x.to(dtype) for x in (points1, points2, K, K_2, R, t)))
    rtol = 1e-9 if dtype == torch.float64 else 2e-4
    torch.testing.assert_close(X.double(), xyz, rtol=rtol, atol=rtol)
    P_1, P_2 = K @ torch.eye(3, 4).double(), K_2 @ torch.cat((R, t), -1)
    theirs = cv2.triangulatePoints(*(x.numpy() for x in (P_1, P_2, points1.mT, points2.mT)))
    torch.testing.assert_close(X.double(), torch.from_numpy(theirs[:3] / theirs[3]).mT, rtol=rtol, atol=rtol)
    kornias = triangulate_points(P_1[None], P_2[None], points1[None], points2[None])[0]
    torch.testing.assert_close(X.double(), kornias, rtol=rtol, atol=rtol)


def test_noisy_points_are_opencvs_optimum_where_the_first_view_is_exact():
    """OpenCV's correction moves both pixels; in a first view a thousand times as large it moves the second alone."""
    _, points1, points2, R, t = scene(noise_px=2.0)
    K_1 = torch.diag(torch.tensor([1e3, 1e3, 1.0], dtype=torch.float64)) @ K
    F = torch.linalg.inv(K_2).mT @ se3.hat(t[:, 0]) @ R @ torch.linalg.inv(K_1)
    moved = cv2.correctMatches(F.numpy(), 1e3 * points1[None].numpy(), points2[None].numpy())
    P_1, P_2 = K_1 @ torch.eye(3, 4).double(), K_2 @ torch.cat((R, t), -1)
    theirs = cv2.triangulatePoints(P_1.numpy(), P_2.numpy(), *(x[0].T for x in moved))
    X, _ = fn.triangulate_points_one_sided(points1, points2, K, K_2, R, t)
    torch.testing.assert_close(X, torch.from_numpy(theirs[:3] / theirs[3]).mT, rtol=1e-4, atol=1e-4)
    assert (X - scene()[0]).abs().max() > 1e-2


def test_without_a_baseline_the_covariance_is_infinite_and_gradients_are_finite():
    _, points1, points2, R, t = scene()
    points2 = points2.requires_grad_()
    X, cov = fn.triangulate_points_one_sided(points1, points2, K, K_2, R, 0 * t)
    assert (cov == torch.inf).all() and not X.any()
    X.sum().backward()
    assert points2.grad.isfinite().all()


def test_points_are_those_of_opencv():
    rough = uniform(1, 1, 100, 132, seed=7)
    smooth = torch.nn.functional.avg_pool2d(rough, 5, 1)
    bytes_ = ((smooth - smooth.min()) / (smooth.max() - smooth.min()) * 255).round().to(torch.uint8)
    first, second = bytes_[..., 3:, :-5].contiguous(), bytes_[..., :-3, 5:].contiguous()
    points = places(n=40, dtype=torch.float32)
    tracks = fn.track_points_lk(first, second, points, fb_threshold=None)
    options = {"winSize": (21, 21), "maxLevel": 3, "criteria": (3, 30, 0.01)}
    here, there = first[0, 0].numpy(), second[0, 0].numpy()
    theirs, status, _ = cv2.calcOpticalFlowPyrLK(here, there, points[0].numpy(), None, **options)
    back, _, _ = cv2.calcOpticalFlowPyrLK(there, here, theirs, None, **options)
    agreed = (status[:, 0] == 1) & (np.abs(back - points[0].numpy()).max(1) < 0.5)
    assert agreed.mean() > 0.9 and tracks.valid[0].numpy()[agreed].all()
    assert np.abs(tracks.points[0].numpy() - theirs)[agreed].max() < 0.03


def test_points_without_texture_outside_or_refuted_are_not_valid_and_stay_finite():
    first, second = pictures()
    first, second = first.clone(), second.clone()
    first[..., :48, :64], second[..., :48, :64] = 0.5, 0.5
    points = torch.tensor([[[20.0, 20.0], [300.0, 40.0], [-5.0, 10.0], [96.0, 60.0]]], dtype=torch.float64)
    tracks = fn.track_points_lk(first, second, points)
    assert tracks.valid.tolist() == [[False, False, False, True]]
    assert all(x.isfinite().all() for x in (tracks.points, tracks.round_trip, tracks.covariance))
    unlike = uniform(1, 1, 96, 128), uniform(1, 1, 96, 128, seed=1), places(n=50)
    shares = [fn.track_points_lk(*unlike, fb_threshold=x).valid.double().mean() for x in (1.0, None)]
    assert shares[0] < 0.5 < 0.8 < shares[1]
    with pytest.raises(ValueError, match="window"):
        fn.track_points_lk(first, second, places(), window_size=20)
    kept = fn.track_points_lk(*pictures(), places(), fb_threshold=0.0)
    assert not kept.valid.any() and fn.track_points_lk(*pictures(), places(), fb_threshold=None).valid.all()


def test_poses_are_those_of_poselib():
    poselib = pytest.importorskip("poselib")
    xyz, _, points2, _, _ = scene((50,), n=3)
    poses, valid = fn.solve_p3p(xyz, points2, K_2)
    rays = torch.cat((points2, torch.ones(50, 3, 1, dtype=torch.float64)), -1) @ torch.linalg.inv(K_2).mT
    rays = rays / rays.norm(dim=-1, keepdim=True)
    found = 0
    for k in range(50):
        for pose in poselib.p3p(list(rays[k].numpy()), list(xyz[k].numpy())):
            off = (poses[k] - torch.from_numpy(np.concatenate((pose.R, pose.t[:, None]), 1))).abs().amax((-1, -2))
            assert torch.where(valid[k], off, torch.inf).min() < 1e-5
            found += 1
    assert found >= 50


def test_poses_are_those_of_opencv_and_poselib():
    xyz, _, points2, _, _ = scene((4,), n=60, noise_px=0.5)
    points2[:, :15] += 60.0 * uniform(4, 15, 2, seed=8) + 20
    found = solve(xyz, points2, K_2)
    poselib = pytest.importorskip("poselib")
    camera = {"model": "PINHOLE", "width": 640, "height": 480, "params": K_2[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()}
    for k in range(4):
        X, uv = xyz[k].numpy(), points2[k].numpy()
        ok, turn, t, _ = cv2.solvePnPRansac(X, uv, K_2.numpy(), None, reprojectionError=3.0, iterationsCount=1000)
        theirs = torch.from_numpy(np.concatenate((cv2.Rodrigues(turn)[0], t), 1))
        assert ok and (found.world_to_cam[k] - theirs).abs().max() < 0.02
        pose, info = poselib.estimate_absolute_pose(
            uv, X, camera, {"max_reproj_error": 3.0}, {"loss_type": "TRUNCATED"}
        )
        theirs = torch.from_numpy(np.concatenate((pose.R, pose.t[:, None]), 1))
        assert (found.world_to_cam[k] - theirs).abs().max() < 2e-3
        assert found.inliers[k].tolist() == info["inliers"]


def test_planar_and_hopeless_elements_are_solved_or_masked_beside_others():
    """What kornia's linear solver refuses for the whole batch."""
    xyz, _, _, R, t = scene((3,), n=30)
    xyz[0, :, 2] = 3.0
    points2 = seen(xyz @ R.mT + t.mT, K_2)
    points2[1] = 600 * uniform(30, 2, seed=9)
    with pytest.raises(AssertionError):
        solve_pnp_dlt(xyz, points2, K_2.expand(3, 3, 3))
    found = solve(xyz, points2, K_2)
    assert found.valid.tolist() == [True, False, True]
    truth = torch.cat((R, t), -1)
    torch.testing.assert_close(found.world_to_cam[[0, 2]], truth[[0, 2]], rtol=0, atol=1e-8)
    assert torch.equal(found.world_to_cam[1], torch.eye(3, 4, dtype=torch.float64)) and not found.covariance[1].any()


def test_masked_correspondences_are_not_used():
    xyz, _, points2, R, t = scene(n=40)
    points2[:25] += 40.0  # more than the others, and alike
    mask = torch.arange(40) >= 25
    found = solve(xyz, points2, K_2, mask)
    torch.testing.assert_close(found.world_to_cam, torch.cat((R, t), -1), rtol=0, atol=1e-8)
    assert torch.equal(found.inliers, mask)


def test_covariance_is_that_of_random_draws():
    xyz, points1, points2, R, t = scene(n=4)
    half = torch.tensor([[0.3, 0.0], [0.1, 0.2]], dtype=torch.float64)
    pose_half = torch.diag(torch.tensor([1, 1, 1, 3, 3, 3], dtype=torch.float64)) * 2e-4
    draws = 20_000
    moved = se3.retract(se3.Pose(R.expand(draws, 3, 3), t[:, 0].expand(draws, 3)), normal(draws, 6) @ pose_half.mT)
    noisy = points2 + normal(draws, 4, 2, seed=5) @ half.mT
    X, _ = fn.triangulate_points_one_sided(points1.expand(draws, -1, -1), noisy, K, K_2, moved.R, moved.t[..., None])
    _, cov = fn.triangulate_points_one_sided(
        *(points1, points2, K, K_2, R, t),
        covariance2=(half @ half.mT).expand(4, 2, 2),
        pose_covariance=pose_half @ pose_half.mT,
    )
    off = X - xyz
    sampled = torch.einsum("dni,dnj->nij", off, off) / draws
    torch.testing.assert_close(cov, sampled, rtol=0.05, atol=0.02 * float(sampled.abs().max()))


def test_a_start_replaces_the_pyramid():
    points, shift = places(n=20), torch.tensor([14.0, 9.0], dtype=torch.float64)
    options = {"num_levels": 1, "window_size": 9}
    alone = fn.track_points_lk(*pictures(shift=shift.tolist()), points, **options)
    begun = fn.track_points_lk(*pictures(shift=shift.tolist()), points, points + shift + 0.5, **options)
    right = [(((x.points - points - shift).abs() < 0.1).all(-1) & x.valid).double().mean() for x in (alone, begun)]
    assert right[0] < 0.5 < 0.9 < right[1]


def test_points_on_a_line_have_no_pose_and_leave_the_others_alone():
    xyz, _, points2, _, _ = scene((2,), n=3)
    xyz[0] = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.1, 3.0], [0.2, 0.2, 4.0]])
    poses, valid = fn.solve_p3p(xyz, points2, K_2)
    assert not valid[0].any() and valid[1].any()
    assert torch.equal(poses[0], torch.eye(3, 4, dtype=torch.float64).expand(4, 3, 4))


def test_gradients_stay_finite_where_there_is_no_pose():
    xyz, points2 = scene((2,))[0].requires_grad_(), 600 * uniform(2, 12, 2, seed=9)
    solve(xyz, points2, K_2).world_to_cam.sum().backward()
    assert xyz.grad.isfinite().all()
