"""Beside stage 5: a pose from elsewhere held against the near returns, whose word on the motion is independent of it.

Alphabet: ``r`` = projected − measured (px) of a near return under the given pose, ``S`` the covariance that the pose's
own, the sensor's noise and the track's give it; ``xi`` the tangent from the given pose to the one that the near returns
have by themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import PoseCode, first_reason
from dhtorch.geometry import covariance, ransac, se3
from dhtorch.geometry import pose_conventions as conventions
from dhtorch.geometry.checks import check
from dhtorch.geometry.determinism import PRODUCT_LANES, round_up
from dhtorch.geometry.least_squares import MIN_DEPTH, linearise, select_batch
from dhtorch.geometry.linalg import small_matmul
from dhtorch.records import Camera, Frame, InitialPose, Pose, PoseFit, PosePrior, Samples, Tracks

#: Near returns by which it is told how a refuted pose was meant; more are thinned evenly.
MAX_CONVENTION_RETURNS = 256

#: A near return is explained within so many standard deviations.
INLIER_SIGMAS = 3.0

#: Noise of a track, px, where nothing tells it.
DEFAULT_TRACK_NOISE_PX = 1.0

#: Factor on the standard deviations of seat 5: to first order, and blind to errors that all returns share.
FIT_SIGMA_INFLATION = 3.0

#: Translation in its own standard deviations below which there is none.
MIN_PRIOR_T_SNR = 1.0


class _Near(NamedTuple):
    """Near returns as planes; unused ones at a safe place."""

    xyz: Tensor  # (B, 3, N) m
    uv: Tensor  # (B, 2, N) px
    sigma: Tensor  # (B, N) m
    used: Tensor  # (B, N) bool


def check_pose_prior(
    given: PosePrior,
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    found: PoseFit,
    *,
    max_residual: float = 0.01,
    min_near: int = 8,
    min_inlier_ratio: float = 0.5,
    min_confirmed: int = 4,
    max_deviation: float = 4.74,
    default_sigma: tuple[float, float] = (0.01, 0.02),
) -> PoseFit:
    """A pose from elsewhere as seat 5's answer, or the reason why it is not used.

    It is refuted where near returns that one rigid motion explains (``found``, from seat 5) mostly miss it: fewer than
    ``min_inlier_ratio`` of them lie within three standard deviations or ``max_residual``; or, where its covariance
    is stated, where the two motions differ by more than ``max_deviation`` standard deviations of both. Near returns
    that no rigid motion explains, or too few of them, refute nothing.

    A covariance that is not stated is taken from the near returns: their own, and the square of how far they say the
    pose is off. Where they have no pose of their own, it is ``default_sigma`` if a few of them, and most of those there
    are, confirm the pose: one that nobody confirms and for which nobody vouches is not used. Exact is a pose only where
    that is stated, as a covariance of zero.

    Args:
        given: B poses.
        samples, tracks, camera_0, camera_1: what seat 5 is given.
        found: what seat 5 says.
        max_residual: residual of a near return that is forgiven in any case, of a ray with z = 1; a pixel at least.
        min_near: fewer near returns refute nothing.
        min_inlier_ratio: share of them that a pose must explain.
        min_confirmed: near returns that must be explained by a pose whose covariance nobody knows.
        max_deviation: length of xi in standard deviations, those of ``found`` counted threefold; as it is, one right
            pose in a thousand is refuted.
        default_sigma: standard deviations (rad, m) of a pose that near returns confirm and do not measure.

    Returns:
        PoseFit with the given pose. Codes: TOO_FEW: not a finite pose, or too few near returns to know a covariance
        that is not stated; REFUTED, and ``looks`` then tells in which of
        :data:`dhtorch.geometry.pose_conventions.CONVENTIONS` the numbers would fit (0 = in none, or not asked);
        NO_BASELINE: no translation, or one within its own noise. ``sigma_px`` is that of ``found``, and ``t_snr``
        too where it is the larger: whoever sees a baseline, there is one.

    Raises:
        ValueError: wrong shapes.

    Gradient: R and t to the given pose; whether it is used, its covariance and the rest carry none.
    Cost: linear in N.
    """
    check("check_pose_prior", xyz=(samples.xyz, "B N 3"), uv_1=(tracks.uv_1, "B N 2"), R=(given.T_1_from_0.R, "B 3 3"))
    check("check_pose_prior", t=(given.T_1_from_0.t, "B 3"), cov=(given.cov, "B 6 6"), f_1=(camera_1.f, "B 2"))
    T = given.T_1_from_0.to(samples.xyz.dtype)
    N = samples.uv.shape[1]
    with torch.no_grad():
        finite = T.R.isfinite().flatten(1).all(1) & T.t.isfinite().all(1)
        if given.cov is not None:
            finite = finite & given.cov.isfinite().flatten(1).all(1)
        near = _near(samples, tracks)
        miss_px = (max_residual * camera_1.f.detach().amin(-1)).clamp_min(DEFAULT_TRACK_NOISE_PX)
        own = select_batch(found.ok, found.T_1_from_0.detach().to(T.t.dtype), se3.identity(len(T.t), T.t))
        stood = select_batch(finite, T.detach(), se3.identity(len(T.t), T.t))
        own_cov = torch.where(found.ok[:, None, None], found.cov, 0.0).nan_to_num().to(T.t.dtype)
        xi = torch.where(found.ok[:, None], se3.log(se3.compose(own, se3.invert(stood))), 0.0)
        stated = None if given.cov is None else given.cov.detach().nan_to_num().to(T.t.dtype)
        explained = _square(near, stood, camera_1, miss_px, stated) < INLIER_SIGMAS**2
        still = found.code == PoseCode.NO_BASELINE
        rigid = near.used & (_square(near, own, camera_1, miss_px, None) < INLIER_SIGMAS**2) & found.ok[:, None]
        rigid = rigid | (near.used & still[:, None])
        enough = rigid.sum(-1) >= min_near
        refuted = enough & ((explained & rigid).sum(-1) < min_inlier_ratio * rigid.sum(-1))
        count = (explained & near.used).sum(-1)
        unknown = (count < min_confirmed) | (count < min_inlier_ratio * near.used.sum(-1))
        unknown = unknown & ~found.ok & (stated is None)
        if stated is None:
            spread = torch.tensor([default_sigma[0] ** 2] * 3 + [default_sigma[1] ** 2] * 3).to(T.t)
            cov = torch.where(found.ok[:, None, None], own_cov + xi[:, :, None] * xi[:, None], torch.diag(spread))
        else:
            cov = stated
            far = covariance.mahalanobis(xi, stated + FIT_SIGMA_INFLATION**2 * own_cov) > max_deviation
            refuted, still = refuted | (enough & found.ok & far), torch.zeros_like(still)
        t_snr = _t_snr(T.t, cov[:, 3:, 3:])
        t_snr = torch.where(found.ok, torch.maximum(t_snr, found.t_snr.nan_to_num().to(t_snr)), t_snr)
        code = first_reason(
            (~finite, PoseCode.TOO_FEW),
            (refuted, PoseCode.REFUTED),
            (still | ~(t_snr >= MIN_PRIOR_T_SNR), PoseCode.NO_BASELINE),
            (unknown, PoseCode.TOO_FEW),
            otherwise=PoseCode.OK,
        )
        ok, inlier = code == PoseCode.OK, explained & near.used
        square = _square(near, stood, camera_1, None, None)
        rms_px = (torch.where(inlier, square, 0.0).sum(-1) / inlier.sum(-1).clamp_min(1)).sqrt()
        looks = torch.zeros_like(code)
        if given.hypotheses is not None:
            looks = torch.where(refuted, _matched_convention(near, given.hypotheses, camera_1, rigid, miss_px), looks)

    def answer(x: Tensor) -> Tensor:
        return torch.where(ok.view(-1, *[1] * (x.ndim - 1)), x, torch.nan)

    return PoseFit(
        T_1_from_0=Pose(answer(T.R), answer(T.t)),
        cov=answer(cov),
        inlier=(inlier & ok[:, None])[:, :N],
        n_inlier=inlier.sum(-1),
        rms_px=answer(rms_px),
        sigma_px=answer(torch.where(found.ok, found.sigma_px.to(rms_px), DEFAULT_TRACK_NOISE_PX)),
        t_snr=answer(t_snr),
        code=code,
        matched_convention=looks,
    )


def reject_poses(fit: PoseFit, held: PoseFit) -> PoseFit:
    """A fit without the poses that, ``held`` as given ones, were refuted or that nobody confirms, for that reason.

    Raises ValueError for wrong shapes. Gradient: to the poses that stay.
    """
    check("reject_poses", R=(fit.T_1_from_0.R, "B 3 3"), code=(fit.code, "B"), code_held=(held.code, "B"))
    gone = fit.ok & ((held.code == PoseCode.REFUTED) | (held.code == PoseCode.TOO_FEW))

    def left(x: Tensor) -> Tensor:
        return torch.where(gone.view(-1, *[1] * (x.dim() - 1)), torch.nan, x)

    return fit.replace(
        T_1_from_0=fit.T_1_from_0.map(left),
        cov=left(fit.cov),
        inlier=fit.inlier & ~gone[:, None],
        rms_px=left(fit.rms_px),
        sigma_px=left(fit.sigma_px),
        t_snr=left(fit.t_snr),
        shutter=None if fit.shutter is None else fit.shutter.map(left),
        code=torch.where(gone, held.code, fit.code).to(fit.code.dtype),
    )


def priors_from_frames(
    reference: Frame,
    others: Frame,
    *,
    sigma: tuple[float, float] | None = None,
    refine: bool = False,
) -> PosePrior:
    """The motions that frames carry (``T_world_from_cam``), for the ``given`` of a method.

    Args:
        reference: B views.
        others: B other views, or V × B of them.
        sigma: standard deviations of a relative pose, rad and m; None = not stated.
        refine: only start the search for the most probable pose from it.

    Raises:
        ValueError: frames without a pose, or a sigma that is not two numbers of at least 0.

    Gradient: to the poses.
    """
    if reference.T_world_from_cam is None or others.T_world_from_cam is None:
        raise ValueError("given: frame.T_world_from_cam is absent, expected a data set that has camera-to-world poses")
    if sigma is not None and not (len(sigma) == 2 and all(0 <= s < float("inf") for s in sigma)):
        raise ValueError(f"given.sigma: found {sigma}, expected two numbers of at least 0: rad and m")
    world_0, world_1 = reference.T_world_from_cam, others.T_world_from_cam
    several = world_1.t.dim() == 3
    if several:
        world_0 = world_0.map(lambda x: x.expand(len(world_1.t), *x.shape))
    flat_0, flat_1 = (T.map(lambda x: x.flatten(0, 1)) if several else T for T in (world_0, world_1))
    # In float64: places far from the world's origin differ by little of their size.
    made = relative_prior(flat_0, flat_1, sigma=sigma, refine=refine).to(reference.camera.f.dtype)
    return made.map(lambda x: x.unflatten(0, world_1.t.shape[:2])) if several else made


def relative_prior(
    T_world_from_0: Pose,  # (B,)
    T_world_from_1: Pose,  # (B,)
    *,
    sigma: tuple[float, float] | None = None,
    cov: Tensor | None = None,  # (B, 6, 6) of T_1_from_0
    refine: bool = False,
) -> PosePrior:
    """A given motion of two poses in one world, with all its hypotheses. Gradient: to poses and covariance."""
    T = se3.relative(T_world_from_0, T_world_from_1)
    back = se3.compose(T_world_from_1, se3.invert(T_world_from_0))
    return make_prior(T, back, sigma=sigma, cov=cov, refine=refine)


def make_prior(
    T_1_from_0: Pose,  # (B,)
    other_way: Pose | None = None,  # (B,), None = its inverse
    *,
    sigma: tuple[float, float] | None = None,
    cov: Tensor | None = None,  # (B, 6, 6)
    refine: bool = False,
) -> PosePrior:
    """A given motion with all its hypotheses; ``sigma``: standard deviations, rad and m, where ``cov`` is not given.

    Gradient: to poses and covariance.
    """
    if cov is None and sigma is not None:
        spread = [sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3
        cov = torch.diag(torch.tensor(spread).to(T_1_from_0.t)).expand(len(T_1_from_0.t), 6, 6)
    back = se3.invert(T_1_from_0) if other_way is None else other_way
    made = InitialPose if refine else PosePrior
    return made(T_1_from_0, cov, conventions.pose_hypotheses(T_1_from_0.detach(), back.detach()))


def _near(samples: Samples, tracks: Tracks) -> _Near:
    """The near returns that were tracked, N' > 0 a multiple of PRODUCT_LANES."""
    points = torch.cat((samples.xyz, tracks.uv_1, samples.sigma[..., None]), -1).detach().transpose(1, 2)
    used = tracks.valid & points.isfinite().all(1) & (points[:, 2] > 0)
    points = torch.where(used[:, None], points, torch.zeros_like(points))
    more = (0, round_up(used.shape[1], PRODUCT_LANES) - used.shape[1])
    points, used = torch.nn.functional.pad(points, more), torch.nn.functional.pad(used, more)
    return _Near(points[:, :3], points[:, 3:5], points[:, 5], used)


def _square(near: _Near, T: Pose, camera: Camera, miss_px: Tensor | None, cov: Tensor | None) -> Tensor:
    """Squared residuals (B, N) in variances: the track's, the sensor's and the pose's; without ``miss_px`` in px²."""
    rows, depth = linearise(T, camera.f, camera.c, near.xyz, near.uv)
    x, y = rows[:, 6].unbind(1)
    if miss_px is None:
        return torch.where(depth > MIN_DEPTH, x * x + y * y, torch.inf)
    z = torch.where(near.used, near.xyz[:, 2], 1.0)
    turned = torch.baddbmm(torch.zeros_like(T.t)[..., None], T.R, near.xyz) * (near.sigma / z)[:, None]
    slope = (rows[:, 3:6] * turned[:, :, None]).sum(1)  # (B, 2, N) px per standard deviation of the return
    a, b, c = slope[:, 0] ** 2, slope[:, 0] * slope[:, 1], slope[:, 1] ** 2
    if cov is not None:
        J = rows[:, :6].permute(0, 3, 2, 1)  # (B, N, 2, 6)
        S = (small_matmul(J, cov[:, None])[..., None, :] * J[..., None, :, :]).sum(-1)
        a, b, c = a + S[..., 0, 0], b + S[..., 0, 1], c + S[..., 1, 1]
    floor = (miss_px / INLIER_SIGMAS)[:, None] ** 2
    a, c = a + floor, c + floor
    square = (c * x * x - 2 * b * x * y + a * y * y) / (a * c - b * b)
    return torch.where((depth > MIN_DEPTH) & near.used, square, torch.inf)


def _matched_convention(near: _Near, hypotheses: Pose, camera: Camera, rigid: Tensor, miss_px: Tensor) -> Tensor:
    """Which reading (B,) explains most of the near returns that move rigidly, and at least half; 0 = none."""
    B, K = hypotheses.t.shape[:2]
    index, count = ransac.usable_first(rigid, min(MAX_CONVENTION_RETURNS, rigid.shape[1]))
    slot = torch.arange(index.shape[1], device=index.device) < count[:, None]

    def thin(x: Tensor) -> Tensor:
        some = x.gather(-1, index.view(B, *[1] * (x.dim() - 2), -1).expand(*x.shape[:-1], -1))
        return some.repeat_interleave(K, 0)

    fewer = _Near(thin(near.xyz), thin(near.uv), thin(near.sigma), slot.repeat_interleave(K, 0))
    flat = hypotheses.map(lambda x: x.flatten(0, 1).to(near.xyz.dtype))
    camera = camera.map(lambda x: x.repeat_interleave(K, 0))
    square = (
        _square(fewer, flat, camera, miss_px.repeat_interleave(K, 0), None)
        .clamp(max=INLIER_SIGMAS**2)
        .nan_to_num(INLIER_SIGMAS**2)
    )
    missed = torch.where(fewer.used, square, 0.0).sum(-1).view(B, K) / (INLIER_SIGMAS**2 * count.clamp_min(1))[:, None]
    best = (missed <= missed.amin(-1, keepdim=True) + 0.05).int().argmax(-1)  # the simplest of those that fit alike
    fits = (missed.gather(-1, best[:, None])[:, 0] < 0.5) & (count > 0)
    return torch.where(fits, best, 0).to(torch.int32)


def _t_snr(t: Tensor, cov: Tensor) -> Tensor:
    """Translation in its own standard deviations (B,): infinite where it is known exactly and not zero."""
    exact = ~(cov.abs().flatten(1).amax(1) > 0)
    snr = covariance.mahalanobis(t, cov)
    return torch.where(exact, torch.where((t != 0).any(-1), torch.inf, 0.0).to(t), snr)
