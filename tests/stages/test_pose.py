"""Stage 5: the metric pose from near points, against truth, OpenCV and PoseLib, and what it refuses."""

import cv2
import numpy as np
import pytest
import torch

from dhtorch.codes import PoseCode
from dhtorch.geometry import se3
from dhtorch.records import Camera, Samples, Tracks
from dhtorch.stages.pose import pnp_ransac


def pairs(batch, n, *, noise=0.0, outliers=0.0, planar=False, seed=0, dtype=torch.float64):
    """Near points seen by two different cameras; arguments of the stage, and the true pose."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    f_0, f_1 = 450 + 100 * rand(batch, 2), 450 + 100 * rand(batch, 2)
    c = torch.tensor([320.0, 240.0], dtype=torch.float64) + 10 * rand(batch, 2)
    uv_0 = rand(batch, n, 2) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    ray = torch.cat(((uv_0 - c[:, None]) / f_0[:, None], torch.ones_like(uv_0[..., :1])), -1)
    depth = 2.0 / (1 + 0.3 * ray[..., 0] - 0.4 * ray[..., 1]) if planar else 0.8 + 2.2 * rand(batch, n)
    xyz = ray * depth[..., None]
    xi = 0.05 * torch.randn(batch, 6, generator=g, dtype=torch.float64)
    T = se3.exp(xi + torch.tensor([0, 0, 0, 0.1, 0, 0], dtype=torch.float64))
    Y = se3.apply(T, xyz)
    uv_1 = Y[..., :2] / Y[..., 2:] * f_1[:, None] + c[:, None]
    uv_1 = uv_1 + noise * torch.randn(uv_1.shape, generator=g, dtype=torch.float64)
    wrong = torch.arange(n) < round(outliers * n)
    anywhere = rand(batch, n, 2) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    uv_1 = torch.where(wrong[:, None], anywhere, uv_1)
    draws = rand(batch, 200, 3).float()
    args = (*_records(uv_0, depth, xyz, uv_1), Camera(f_0, c), Camera(f_1, c))
    return (*(x.to(dtype) for x in args), draws), T


def _records(uv_0, depth, xyz, uv_1):
    zero = torch.zeros_like(depth)
    code = zero.to(torch.int32)
    cov = torch.eye(2, dtype=depth.dtype).expand(*depth.shape, 2, 2).clone()
    samples = Samples(uv_0, depth, 0.01 * depth, xyz, zero + 1, code, zero + 1, code)
    return samples, Tracks(uv_0, uv_1, zero, zero, cov, zero == 0)


def with_points(args, *, xyz=None, uv_1=None, valid=None, camera_1=None):
    samples, tracks, camera_0, old_1, draws = args
    samples = samples if xyz is None else samples.replace(xyz=xyz)
    tracks = tracks if uv_1 is None else tracks.replace(uv_1=uv_1)
    tracks = tracks if valid is None else tracks.replace(valid=valid)
    return samples, tracks, camera_0, old_1 if camera_1 is None else camera_1, draws


def errors(fit, T):
    """Rotation (deg) and translation (m) errors."""
    R = fit.T_1_from_0.R.double() @ T.R.transpose(1, 2)
    return torch.rad2deg(se3.rotation_angle(R)), (fit.T_1_from_0.t.double() - T.t).norm(dim=-1)


def same(a, b):
    """Bit for bit, NaN equal to NaN."""
    return torch.equal(a.isnan(), b.isnan()) and torch.equal(a.nan_to_num(), b.nan_to_num())


# -------------------------------------------------------------------------------------------------- accuracy


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("n", [8, 40, 1500])
def test_exact_points_give_the_exact_pose(n, planar):
    args, T = pairs(6, n, planar=planar)
    fit = pnp_ransac(*args)
    assert fit.ok.all() and (fit.code == PoseCode.OK).all()
    assert fit.inlier.all() and (fit.n_inlier == n).all()
    rotation, translation = errors(fit, T)
    assert rotation.max() < 1e-8 and translation.max() < 1e-9
    assert fit.rms_px.max() < 1e-6


def by_opencv(xyz, uv, K):
    _, r, t, inlier = cv2.solvePnPRansac(
        xyz, uv, K, None, flags=cv2.SOLVEPNP_AP3P, reprojectionError=3.0, iterationsCount=200, confidence=0.999
    )
    index = inlier[:, 0]
    r, t = cv2.solvePnPRefineLM(xyz[index], uv[index], K, None, r, t)
    return cv2.Rodrigues(r)[0], t[:, 0]


def by_poselib(xyz, uv, K):
    poselib = pytest.importorskip("poselib")
    camera = {"model": "PINHOLE", "width": 640, "height": 480, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
    options = {"max_reproj_error": 3.0, "min_iterations": 100, "max_iterations": 1000}
    pose, _ = poselib.estimate_absolute_pose(uv, xyz, camera, options, {})
    return getattr(pose, "pose", pose).R, getattr(pose, "pose", pose).t


@pytest.mark.parametrize("peer", [by_opencv, by_poselib])
@pytest.mark.parametrize("planar", [False, True])
def test_no_less_accurate_than(peer, planar):
    """500 points, 30 % outliers, 0.5 px: mean errors over 40 pairs, both sides near the statistical limit."""
    args, T = pairs(40, 500, noise=0.5, outliers=0.3, planar=planar, dtype=torch.float32)
    rotation, translation = errors(pnp_ransac(*args), T)
    samples, tracks, _, camera_1, _ = args
    theirs = []
    for b in range(40):
        K = np.eye(3)
        K[[0, 1], [0, 1]], K[:2, 2] = camera_1.f[b].numpy(), camera_1.c[b].numpy()
        theirs.append(peer(samples.xyz[b].double().numpy(), tracks.uv_1[b].double().numpy(), K))
    R, t = (torch.tensor(np.stack(x)) for x in zip(*theirs, strict=True))
    their_rotation = torch.rad2deg(se3.rotation_angle(R @ T.R.transpose(1, 2)))
    their_translation = (t - T.t).norm(dim=-1)
    assert rotation.mean() <= their_rotation.mean()
    assert translation.mean() <= their_translation.mean()


def plain(args, fit, b, kernel=None, kernel_px=1.0):
    """Of one pair, in numpy: Σ r² over the inliers, and H = Σ w Jᵀ J with J by differences."""
    samples, tracks, _, camera, _ = args
    inlier = fit.inlier[b]
    X, uv = samples.xyz[b, inlier].double().numpy(), tracks.uv_1[b, inlier].double().numpy()

    def residuals(xi):
        T = se3.retract(fit.T_1_from_0[b : b + 1].to(torch.float64), torch.tensor(xi)[None])
        Y = X @ T.R[0].numpy().T + T.t[0].numpy()
        return camera.f[b].numpy() * Y[:, :2] / Y[:, 2:] + camera.c[b].numpy() - uv

    J = [(residuals(h) - residuals(-h)) / 2e-6 for h in 1e-6 * np.eye(6)]
    r2 = (residuals(np.zeros(6)) ** 2).sum(-1)
    w = {None: 1 + 0 * r2, "cauchy": 1 / (1 + r2 / kernel_px**2)}[kernel]
    return r2.sum(), np.einsum("ank,bnk,n->ab", J, J, w)


@pytest.mark.parametrize("kernel", [None, "cauchy"])
def test_what_is_said_about_a_pose_follows_from_its_residuals(kernel):
    """rms, noise (2 n - 6 degrees of freedom), covariance and significance of the translation, from numpy."""
    args, _ = pairs(3, 14, noise=0.7, outliers=0.2, seed=4)
    fit = pnp_ransac(*args, polish_steps=40, kernel=kernel, kernel_px=0.8)
    assert fit.ok.all() and (fit.n_inlier < 14).all()
    for b in range(3):
        n = int(fit.n_inlier[b])
        total, H = plain(args, fit, b, kernel, 0.8)
        np.testing.assert_allclose(float(fit.rms_px[b]), np.sqrt(total / n), rtol=1e-5)
        np.testing.assert_allclose(float(fit.sigma_px[b]), np.sqrt(total / (2 * n - 6)), rtol=1e-5)
        cov = total / (2 * n - 6) * np.linalg.inv(H)
        scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
        np.testing.assert_allclose(fit.cov[b].numpy() / scale, cov / scale, atol=1e-4)
        t = fit.T_1_from_0.t[b].numpy()
        snr = np.sqrt(t @ np.linalg.inv(fit.cov[b, 3:, 3:].numpy()) @ t)
        np.testing.assert_allclose(float(fit.t_snr[b]), snr, rtol=1e-9)
        assert torch.equal(fit.cov[b], fit.cov[b].mT)


def test_residuals_that_are_rounding_are_not_believed():
    args, _ = pairs(2, 30)
    fit = pnp_ransac(*args)
    assert (fit.sigma_px == 1e-6).all() and (fit.rms_px < 1e-6).all()
    assert (fit.t_snr > 1e4).all() and fit.cov.diagonal(dim1=1, dim2=2).sqrt().amax() < 1e-6


# -------------------------------------------------------------------------------------------------- options


def test_an_inlier_is_nearer_than_the_threshold():
    args, _ = pairs(1, 80)
    uv_1 = args[1].uv_1.clone()
    uv_1[0, 3, 0] += 1.9
    uv_1[0, 9, 1] -= 2.1
    uv_1[0, 20] += 1.4 * torch.tensor([1.0, -1.0], dtype=torch.float64)  # 1.98 px
    uv_1[0, 33] += 1.6 * torch.tensor([-1.0, 1.0], dtype=torch.float64)  # 2.26 px
    moved = with_points(args, uv_1=uv_1)
    for limit, out in ((1.5, [3, 9, 20, 33]), (2.0, [9, 33]), (2.2, [33]), (3.0, [])):
        fit = pnp_ransac(*moved, threshold_px=limit, kernel="geman_mcclure", kernel_px=0.05, polish_steps=6)
        assert (~fit.inlier[0]).nonzero()[:, 0].tolist() == out and int(fit.n_inlier) == 80 - len(out)


def test_so_many_inliers_are_asked_for_but_never_less_than_four():
    for usable, least, ok in ((8, 8, True), (7, 8, False), (5, 5, True), (4, 5, False), (4, 1, True), (3, 1, False)):
        args, _ = pairs(1, 20)
        few = with_points(args, valid=torch.arange(20)[None] < usable)
        fit = pnp_ransac(*few, min_inlier=least)
        assert bool(fit.ok) is ok and (ok or int(fit.code) == PoseCode.TOO_FEW)
    args, _ = pairs(1, 24)
    anywhere = torch.rand(24, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 480
    for right, ok in ((8, True), (7, False)):
        uv_1 = torch.where((torch.arange(24) < right)[:, None], args[1].uv_1, anywhere)
        fit = pnp_ransac(*with_points(args, uv_1=uv_1))
        assert bool(fit.ok) is ok and int(fit.n_inlier) == right


def test_each_refinement_brings_the_answer_nearer_to_the_optimum():
    """Search on few draws; steps on the search's points, then on all."""
    args, _ = pairs(12, 300, noise=2.0, seed=2)
    args = (*args[:4], args[4][:, :1])
    best = pnp_ransac(*args, threshold_px=60.0, local_optimisation=8, polish_steps=12)

    def off(local, polish):
        fit = pnp_ransac(*args, threshold_px=60.0, local_optimisation=local, polish_steps=polish)
        return float((fit.T_1_from_0.t - best.T_1_from_0.t).norm(dim=-1).amax())

    none, local, locals_, polish, polished = (off(*x) for x in ((0, 0), (1, 0), (2, 0), (0, 1), (0, 2)))
    assert local < 0.02 * none and locals_ < 0.1 * local and polish < 0.02 * none and polished < 0.01 * polish


def test_the_better_of_two_hypotheses_is_kept_whichever_comes_first():
    """Three quarters of the points move one way, a quarter another; each motion is drawn once, in either order."""
    args, T = pairs(2, 80, noise=0.1)
    other = se3.retract(T, torch.tensor([[0.0, 0.02, 0.0, 0.2, 0.0, 0.0]], dtype=torch.float64).expand(2, 6))
    Y = se3.apply(other, args[0].xyz)
    seen = Y[..., :2] / Y[..., 2:] * args[3].f[:, None] + args[3].c[:, None]
    uv_1 = torch.where((torch.arange(80) >= 60)[:, None], seen, args[1].uv_1)
    triple = lambda a, b, c: [(a + 0.5) / 80, (b - 0.5) / 79, (c - 1.5) / 78]  # noqa: E731
    first, second = triple(3, 25, 50), triple(61, 68, 76)
    draws = torch.tensor([[first, second], [second, first]], dtype=torch.float64)
    fit = pnp_ransac(*with_points(args, uv_1=uv_1)[:4], draws)
    assert fit.inlier[:, :60].all() and (fit.n_inlier <= 70).all()
    rotation, _ = errors(fit, T)
    assert rotation.max() < 0.05


# -------------------------------------------------------------------------------------------------- refusals


def on_line(args, T, noise, dtype):
    """Points on a line, one point many times, and points anywhere."""
    along = torch.linspace(-1, 1, 30, dtype=torch.float64)
    line = torch.stack((along, 0.5 * along, 2 + 0.3 * along), -1)
    xyz = torch.stack((line, torch.tensor([0.2, 0.1, 1.5], dtype=torch.float64).expand(30, 3), args[0].xyz[2]))
    Y = se3.apply(T, xyz)
    uv_1 = Y[..., :2] / Y[..., 2:] * args[3].f[:, None] + args[3].c[:, None]
    uv_1 = uv_1 + noise * torch.randn(uv_1.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return *(x.to(dtype) for x in with_points(args, xyz=xyz, uv_1=uv_1)[:4]), args[4]


FEW, LINE = [PoseCode.TOO_FEW] * 3, [PoseCode.DEGENERATE, PoseCode.DEGENERATE, PoseCode.OK]
BROKEN = torch.tensor([[torch.nan, torch.nan], [0.0, 0.0], [500.0, 500.0]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("made", "change", "expected"),
    [
        *((pairs(3, n), lambda args, T: args, FEW) for n in (0, 1, 2, 3, 7)),
        (pairs(3, 60, outliers=1.0), lambda args, T: args, FEW),
        *(
            (pairs(3, 30), lambda args, T, x=x, d=d: on_line(args, T, x, d), LINE)
            for x in (0.0, 0.5)
            for d in (torch.float32, torch.float64)
        ),
        (pairs(3, 30), lambda args, T: with_points(args, camera_1=args[3].replace(f=BROKEN)), None),
    ],
)
def test_what_has_no_pose_is_refused(made, change, expected):
    fit = pnp_ransac(*change(*made))
    lost = fit.code != PoseCode.OK
    assert lost[:2].all() and (expected is None or fit.code.tolist() == expected)
    assert torch.equal(fit.ok, ~lost) and not fit.inlier[lost].any() and (fit.n_inlier[fit.code == FEW[0]] < 8).all()
    for x in (fit.T_1_from_0.R, fit.T_1_from_0.t, fit.cov, fit.rms_px, fit.sigma_px, fit.t_snr):
        assert x[lost].isnan().all() and x[~lost].isfinite().all()


def test_points_behind_the_camera_are_no_inliers():
    args, T = pairs(2, 60)
    xyz = args[0].xyz.clone()
    # The mirror image of a point through camera 1's centre projects to the same pixel.
    mirrored = se3.apply(se3.invert(T), -se3.apply(T, xyz))
    xyz[:, :20] = mirrored[:, :20]
    fit = pnp_ransac(*with_points(args, xyz=xyz))
    assert fit.ok.all() and not fit.inlier[:, :20].any() and fit.inlier[:, 20:].all()


def test_a_point_behind_the_camera_and_seen_on_its_axis_holds_nothing():
    """There the projection of a point held away from the camera's plane is where it was seen."""
    args, T = pairs(2, 40, noise=0.2)
    clean = pnp_ransac(*with_points(args, valid=torch.arange(40).expand(2, 40) != 7))
    xyz, uv_1 = args[0].xyz.clone(), args[1].uv_1.clone()
    back = torch.tensor([0.0, 0.0, -2.0], dtype=torch.float64).expand(2, 1, 3)
    for pose in (T, clean.T_1_from_0):
        xyz[:, 7] = se3.apply(se3.invert(pose), back)[:, 0]
        uv_1[:, 7] = args[3].c
        fit = pnp_ransac(*with_points(args, xyz=xyz, uv_1=uv_1))
        assert fit.ok.all() and not fit.inlier[:, 7].any()
        torch.testing.assert_close(fit.T_1_from_0.t, clean.T_1_from_0.t, rtol=0, atol=1e-5)


def test_inliers_on_a_line_are_degenerate_whatever_stands_beside_it():
    """A point off the line whose pixel is wrong by a little gives the search a pose, and no refinement keeps it."""
    args, T = pairs(6, 31)
    along = torch.linspace(-1, 1, 31, dtype=torch.float64)
    xyz = torch.stack((along, 0.5 * along, 2 + 0.3 * along), -1).expand(6, 31, 3).clone()
    xyz[:, 30] = torch.tensor([-0.4, 0.6, 1.7], dtype=torch.float64)
    Y = se3.apply(T, xyz)
    uv_1 = Y[..., :2] / Y[..., 2:] * args[3].f[:, None] + args[3].c[:, None]
    g = torch.Generator().manual_seed(0)
    uv_1 = uv_1 + 0.3 * torch.randn(uv_1.shape, generator=g, dtype=torch.float64)
    uv_1[:, 30] += 6 * torch.nn.functional.normalize(torch.randn(6, 2, generator=g, dtype=torch.float64), dim=-1)
    fit = pnp_ransac(*with_points(args, xyz=xyz, uv_1=uv_1))
    on_line = fit.n_inlier == 30
    assert on_line.sum() >= 4 and (fit.code[on_line] == PoseCode.DEGENERATE).all()
