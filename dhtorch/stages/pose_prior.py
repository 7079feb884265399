"""Beside stage 5: check of a given relative pose against the near returns → the pose with a covariance, or a code.

Alphabet: ``r`` = projected − measured (px) of a near return under the given pose, ``S`` its covariance from the pose's
covariance, the sensor's noise and the track's; ``xi`` the tangent from the given pose to the one estimated from the
near returns.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import PoseCode, first_reason
from dhtorch.geometry import covariance, ransac, se3
from dhtorch.geometry import pose_conventions as conventions
from dhtorch.geometry.checks import shaped
from dhtorch.geometry.determinism import PRODUCT_LANES, round_up
from dhtorch.geometry.least_squares import MIN_DEPTH, linearise, select_batch
from dhtorch.geometry.linalg import small_matmul
from dhtorch.records import Camera, Frame, InitialPose, Pose, PoseFit, PosePrior, Samples, Tracks

#: Limits the residual of an explained near return, in standard deviations.
INLIER_SIGMAS = 3.0


class _NearTracks(NamedTuple):
    """Near returns and their tracks as planes; unused ones hold safe finite values."""

    xyz: Tensor  # (B, 3, N) m
    uv: Tensor  # (B, 2, N) px
    sigma: Tensor  # (B, N) m
    used: Tensor  # (B, N) bool


@shaped(
    "samples.xyz: B N 3, tracks.uv_1: B N 2, prior.T_1_from_0.R: B 3 3, prior.T_1_from_0.t: B 3, "
    "prior.cov: B 6 6, camera_1.f: B 2, fit.code: B"
)
def check_pose_prior(
    prior: PosePrior,
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    fit: PoseFit,
    *,
    max_residual: float = 0.01,
    min_near: int = 8,
    min_inlier_ratio: float = 0.5,
    min_confirmed: int = 4,
    max_deviation: float = 4.74,
    default_sigma: tuple[float, float] = (0.01, 0.02),
) -> PoseFit:
    """A given pose as the result of stage 5 with a covariance, or a code where the near returns refute it.

    It is refuted where near returns that one rigid motion explains (``fit``, from stage 5) mostly miss it: fewer than
    ``min_inlier_ratio`` of them lie within three standard deviations or ``max_residual``; or, where its covariance
    is stated, where the two motions differ by more than ``max_deviation`` standard deviations of both. Near returns
    that no rigid motion explains, or too few of them, refute nothing.

    A covariance that is not stated is estimated from the near returns: that of their own pose, plus xi xiᵀ. Where they
    have no pose, it is ``default_sigma`` if at least ``min_confirmed`` of them, and most of those present, are
    explained by the pose: a pose without covariance that no returns confirm is not used. A pose is exact only with a
    stated covariance of zero.

    Args:
        prior: B poses.
        samples, tracks, camera_0, camera_1: the inputs of stage 5.
        fit: the result of stage 5.
        max_residual: residual of a near return that is always tolerated, of a ray with z = 1; a pixel at least.
        min_near: fewer near returns refute nothing.
        min_inlier_ratio: fraction of them that a pose must explain.
        min_confirmed: near returns that a pose without stated covariance must explain.
        max_deviation: length of xi in standard deviations, those of ``fit`` counted threefold; the default refutes
            one right pose in a thousand.
        default_sigma: standard deviations (rad, m) of a pose that near returns confirm and do not measure.

    Returns:
        PoseFit with the given pose. Codes: TOO_FEW: not a finite pose, or too few near returns to estimate a covariance
        that is not stated; REFUTED, and ``matched_convention`` is then the index in
        :data:`dhtorch.geometry.pose_conventions.CONVENTIONS` under which the numbers would fit (0 = none, or not
        tested); NO_BASELINE: no translation, or one within its own noise. ``sigma_px`` is that of ``fit``, and
        ``t_snr`` is the larger of both.

    Raises:
        ValueError: wrong shapes.

    Gradient: R and t to the given pose; whether it is used, its covariance and the rest carry none.
    Cost: linear in N.
    """
    T = prior.T_1_from_0.to(samples.xyz.dtype)
    with torch.no_grad():
        finite = T.R.isfinite().flatten(1).all(1) & T.t.isfinite().all(1)
        if prior.cov is not None:
            finite = finite & prior.cov.isfinite().flatten(1).all(1)
        near = _near(samples, tracks)
        # Where the noise of tracks is not estimated it is taken as 1 px.
        floor_px = (max_residual * camera_1.f.detach().amin(-1)).clamp_min(1.0)
        own = select_batch(fit.ok, fit.T_1_from_0.detach().to(T.t.dtype), se3.identity(len(T.t), T.t))
        prior_pose = select_batch(finite, T.detach(), se3.identity(len(T.t), T.t))
        own_cov = torch.where(fit.ok[:, None, None], fit.cov, 0.0).nan_to_num().to(T.t.dtype)
        xi = torch.where(fit.ok[:, None], se3.log(se3.compose(own, se3.invert(prior_pose))), 0.0)
        prior_cov = None if prior.cov is None else prior.cov.detach().nan_to_num().to(T.t.dtype)
        explained = _square(near, prior_pose, camera_1, floor_px, prior_cov) < INLIER_SIGMAS**2
        no_baseline = fit.code == PoseCode.NO_BASELINE
        rigid_near = near.used & (_square(near, own, camera_1, floor_px, None) < INLIER_SIGMAS**2) & fit.ok[:, None]
        rigid_near = rigid_near | (near.used & no_baseline[:, None])
        enough_near = rigid_near.sum(-1) >= min_near
        refuted = enough_near & ((explained & rigid_near).sum(-1) < min_inlier_ratio * rigid_near.sum(-1))
        count = (explained & near.used).sum(-1)
        unconfirmed = (count < min_confirmed) | (count < min_inlier_ratio * near.used.sum(-1))
        unconfirmed = unconfirmed & ~fit.ok & (prior_cov is None)
        if prior_cov is None:
            default_variance = torch.tensor([default_sigma[0] ** 2] * 3 + [default_sigma[1] ** 2] * 3).to(T.t)
            cov = torch.where(
                fit.ok[:, None, None], own_cov + xi[:, :, None] * xi[:, None], torch.diag(default_variance)
            )
        else:
            cov = prior_cov
            # Standard deviations of stage 5 are first-order and leave out errors common to all returns: times 3.
            deviates = covariance.mahalanobis(xi, prior_cov + 9 * own_cov) > max_deviation
            refuted, no_baseline = refuted | (enough_near & fit.ok & deviates), torch.zeros_like(no_baseline)
        exact = ~(cov[:, 3:, 3:].abs().flatten(1).amax(1) > 0)
        t_snr = covariance.mahalanobis(T.t, cov[:, 3:, 3:])
        t_snr = torch.where(exact, torch.where((T.t != 0).any(-1), torch.inf, 0.0).to(T.t), t_snr)
        t_snr = torch.where(fit.ok, torch.maximum(t_snr, fit.t_snr.nan_to_num().to(t_snr)), t_snr)
        # A baseline is at least as long as its own standard deviation.
        code = first_reason(
            (~finite, PoseCode.TOO_FEW),
            (refuted, PoseCode.REFUTED),
            (no_baseline | ~(t_snr >= 1.0), PoseCode.NO_BASELINE),
            (unconfirmed, PoseCode.TOO_FEW),
            otherwise=PoseCode.OK,
        )
        inlier = explained & near.used
        square = _square(near, prior_pose, camera_1, None, None)
        rms_px = (torch.where(inlier, square, 0.0).sum(-1) / inlier.sum(-1).clamp_min(1)).sqrt()
        convention = torch.zeros_like(code)
        if prior.hypotheses is not None:
            convention = torch.where(
                refuted, _matched_convention(near, prior.hypotheses, camera_1, rigid_near, floor_px), convention
            )
    return PoseFit(
        T_1_from_0=T,
        cov=cov,
        inlier=inlier[:, : samples.uv.shape[1]],
        n_inlier=inlier.sum(-1),
        rms_px=rms_px,
        sigma_px=torch.where(fit.ok, fit.sigma_px.to(rms_px), 1.0),
        t_snr=t_snr,
        code=code,
        matched_convention=convention,
    ).without_pose(code != PoseCode.OK, code)


@shaped("fit.T_1_from_0.R: B 3 3, fit.code: B, prior_fit.code: B")
def reject_poses(fit: PoseFit, prior_fit: PoseFit) -> PoseFit:
    """A fit without the poses that ``prior_fit`` (:func:`check_pose_prior`) has as REFUTED or TOO_FEW, with that code.

    Raises ValueError for wrong shapes. Gradient: to the poses that stay.
    """
    rejected = fit.ok & ((prior_fit.code == PoseCode.REFUTED) | (prior_fit.code == PoseCode.TOO_FEW))
    return fit.without_pose(rejected, prior_fit.code)


def priors_from_frames(
    reference: Frame,
    others: Frame,
    *,
    sigma: tuple[float, float] | None = None,
    refine: bool = False,
) -> PosePrior:
    """Relative poses (B,) or (V, B) of frames with ``T_world_from_cam``, as the ``pose_prior`` of a method.

    Args:
        reference: B views.
        others: B other views, or V × B of them.
        sigma: standard deviations of a relative pose, rad and m; None = not stated.
        refine: use the pose only as the start of the most probable pose.

    Raises:
        ValueError: frames without a pose, or a sigma that is not two numbers of at least 0.

    Gradient: to the poses.
    """
    if reference.T_world_from_cam is None or others.T_world_from_cam is None:
        raise ValueError("given: frame.T_world_from_cam is absent, expected a data set that has camera-to-world poses")
    if sigma is not None and not (len(sigma) == 2 and all(0 <= s < float("inf") for s in sigma)):
        raise ValueError(f"given.sigma: found {sigma}, expected two numbers of at least 0: rad and m")
    world_0, world_1 = reference.T_world_from_cam, others.T_world_from_cam
    multiview = world_1.t.dim() == 3
    if multiview:
        world_0 = world_0.map(lambda x: x.expand(len(world_1.t), *x.shape))
    flat_0, flat_1 = (T.map(lambda x: x.flatten(0, 1)) if multiview else T for T in (world_0, world_1))
    # In float64: positions far from the world's origin differ little relative to their size.
    prior = relative_prior(flat_0, flat_1, sigma=sigma, refine=refine).to(reference.camera.f.dtype)
    return prior.map(lambda x: x.unflatten(0, world_1.t.shape[:2])) if multiview else prior


def relative_prior(
    T_world_from_0: Pose,  # (B,)
    T_world_from_1: Pose,  # (B,)
    *,
    sigma: tuple[float, float] | None = None,
    cov: Tensor | None = None,  # (B, 6, 6) of T_1_from_0
    refine: bool = False,
) -> PosePrior:
    """Relative pose of two poses in one world, with all its hypotheses. Gradient: to poses and covariance."""
    T = se3.relative(T_world_from_0, T_world_from_1)
    inverse_motion = se3.compose(T_world_from_1, se3.invert(T_world_from_0))
    return make_prior(T, inverse_motion, sigma=sigma, cov=cov, refine=refine)


def make_prior(
    T_1_from_0: Pose,  # (B,)
    other_way: Pose | None = None,  # (B,), None = its inverse
    *,
    sigma: tuple[float, float] | None = None,
    cov: Tensor | None = None,  # (B, 6, 6)
    refine: bool = False,
) -> PosePrior:
    """Prior of a relative pose with all its hypotheses; ``sigma`` (rad, m): its deviations where ``cov`` is None.

    Gradient: to poses and covariance.
    """
    if cov is None and sigma is not None:
        variance = [sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3
        cov = torch.diag(torch.tensor(variance).to(T_1_from_0.t)).expand(len(T_1_from_0.t), 6, 6)
    inverse_motion = se3.invert(T_1_from_0) if other_way is None else other_way
    record_type = InitialPose if refine else PosePrior
    return record_type(T_1_from_0, cov, conventions.pose_hypotheses(T_1_from_0.detach(), inverse_motion.detach()))


def _near(samples: Samples, tracks: Tracks) -> _NearTracks:
    """The tracked near returns as planes, N' > 0 a multiple of PRODUCT_LANES."""
    points = torch.cat((samples.xyz, tracks.uv_1, samples.sigma[..., None]), -1).detach().transpose(1, 2)
    used = tracks.valid & points.isfinite().all(1) & (points[:, 2] > 0)
    points = torch.where(used[:, None], points, torch.zeros_like(points))
    padding = (0, round_up(used.shape[1], PRODUCT_LANES) - used.shape[1])
    points, used = torch.nn.functional.pad(points, padding), torch.nn.functional.pad(used, padding)
    return _NearTracks(points[:, :3], points[:, 3:5], points[:, 5], used)


def _square(near: _NearTracks, T: Pose, camera: Camera, floor_px: Tensor | None, cov: Tensor | None) -> Tensor:
    """Squared residuals (B, N) in variances of track, sensor and pose; in px² where ``floor_px`` is None."""
    rows, depth = linearise(T, camera.f, camera.c, near.xyz, near.uv)
    x, y = rows[:, 6].unbind(1)
    if floor_px is None:
        return torch.where(depth > MIN_DEPTH, x * x + y * y, torch.inf)
    z = torch.where(near.used, near.xyz[:, 2], 1.0)
    ray_sigma = torch.baddbmm(torch.zeros_like(T.t)[..., None], T.R, near.xyz) * (near.sigma / z)[:, None]
    slope = (rows[:, 3:6] * ray_sigma[:, :, None]).sum(1)  # (B, 2, N) px per standard deviation of the return
    a, b, c = slope[:, 0] ** 2, slope[:, 0] * slope[:, 1], slope[:, 1] ** 2
    if cov is not None:
        J = rows[:, :6].permute(0, 3, 2, 1)  # (B, N, 2, 6)
        S = (small_matmul(J, cov[:, None])[..., None, :] * J[..., None, :, :]).sum(-1)
        a, b, c = a + S[..., 0, 0], b + S[..., 0, 1], c + S[..., 1, 1]
    floor = (floor_px / INLIER_SIGMAS)[:, None] ** 2
    a, c = a + floor, c + floor
    square = (c * x * x - 2 * b * x * y + a * y * y) / (a * c - b * b)
    return torch.where((depth > MIN_DEPTH) & near.used, square, torch.inf)


def _matched_convention(near: _NearTracks, hypotheses: Pose, camera: Camera, rigid: Tensor, floor_px: Tensor) -> Tensor:
    """Index (B,) of the convention that explains most of the rigid near returns, and at least half; 0 = none."""
    B, K = hypotheses.t.shape[:2]
    # More returns are thinned evenly.
    index, count = ransac.usable_first(rigid, min(256, rigid.shape[1]))
    slot = torch.arange(index.shape[1], device=index.device) < count[:, None]

    def thin(x: Tensor) -> Tensor:
        thinned = x.gather(-1, index.view(B, *[1] * (x.dim() - 2), -1).expand(*x.shape[:-1], -1))
        return thinned.repeat_interleave(K, 0)

    subset = _NearTracks(thin(near.xyz), thin(near.uv), thin(near.sigma), slot.repeat_interleave(K, 0))
    flat = hypotheses.map(lambda x: x.flatten(0, 1).to(near.xyz.dtype))
    camera = camera.map(lambda x: x.repeat_interleave(K, 0))
    square = (
        _square(subset, flat, camera, floor_px.repeat_interleave(K, 0), None)
        .clamp(max=INLIER_SIGMAS**2)
        .nan_to_num(INLIER_SIGMAS**2)
    )
    cost = torch.where(subset.used, square, 0.0).sum(-1).view(B, K) / (INLIER_SIGMAS**2 * count.clamp_min(1))[:, None]
    best = (cost <= cost.amin(-1, keepdim=True) + 0.05).int().argmax(-1)  # the simplest of those with equal fit
    fits = (cost.gather(-1, best[:, None])[:, 0] < 0.5) & (count > 0)
    return torch.where(fits, best, 0).to(torch.int32)
