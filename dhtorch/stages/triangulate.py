"""Stage 6: two views' tracks and pose → depth with a sigma, or a gate code where the geometry is weak."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dhtorch.codes import Gate, Hole, PoseCode, first_reason
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar
from dhtorch.geometry.checks import all_finite, constant, shaped
from dhtorch.geometry.covariance import masked_median, noise_shape
from dhtorch.geometry.reprojection_problem import undo_rolling_shutter
from dhtorch.records import Camera, Estimate, Pose, PoseFit, Samples, SigmaBudget, Tracks

#: Approximate number of samples in a cell of the image.
SAMPLES_PER_CELL = 10

#: Lower limit of the number of answers that are tested.
MIN_FREE_SPACE_ANSWERS = 10


@shaped("tracks.uv_0: B N 2, samples.uv: B N 2, fit.T_1_from_0.R: B 3 3")
def two_view(
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    camera_0: Camera,
    camera_1: Camera,
    *,
    min_parallax_deg: float | None = 0.3,
    max_residual_px: float | None = 3.0,
    max_sigma_rel: float | None = None,
    min_t_snr: float | None = None,
    max_mismatch_px: float | None = None,
    max_far_noise: float | None = None,
    max_in_reach: float | None = None,
    fitted_noise: bool = False,
    isotropic: float = 0.1,
    mismatch_px: float | None = None,
    residual_px: float | None = None,
    round_trip_px: float | None = None,
    sigma_scale: float = 1.0,
    sensor_share: float = 0.0,
    solver: Callable[..., epipolar.TwoView] = epipolar.triangulate,
) -> Estimate:
    """Triangulate every track under the metric pose -> depth with a sigma, or a gate where the geometry is weak.

    The variance of a depth z, to first order, with s = ∂uv_1/∂z (px/m) and g = s / (sᵀ s) the depth per pixel::

        sigma² = c² · gᵀ Σ_track g · (1 + Σ_k (term_k / scale_k)²)    the point's own: its track and its error terms
               + c² · gᵀ J Σ_pose Jᵀ g                                shared through the pose, J = ∂uv_1/∂pose
               + (h · n · z)²                                         shared through the sensor: a wrong scale

    c is ``sigma_scale``; Σ_track the track's covariance, or its shape with the size of the pose's residuals
    (``fitted_noise``); the terms are the mismatch of the patches, the reprojection residual and the round trip, each
    over its scale (``mismatch_px``, ``residual_px``, ``round_trip_px``; None leaves it out); Σ_pose includes the
    shutter rate where the fit has one; h is ``sensor_share`` and n the median relative noise of the near returns among
    the pose's inliers. ``sigma_shared``² is the last two lines.

    Args:
        samples: N samples of view 0 (their own depth is not used here).
        tracks: their pixels in both views, ideal.
        fit: metric relative pose.
        camera_0, camera_1: intrinsics of the two views, ideal; they may differ.
        min_parallax_deg: rays closer to parallel than this are not answered; None = no limit.
        max_residual_px: reprojection error above which a point is not answered; None = no limit. Triangulation is
            one-sided, so the residual in view 0 is zero and the one in view 1 is the larger of the two.
        max_sigma_rel: sigma / depth above which a point is not answered; None = no limit.
        min_t_snr: length of the translation, in its own standard deviations, below which no point of the pair is
            answered; None = no limit.
        max_mismatch_px: grey difference of a track's patches above which it may have slid along its epipolar line, and
            is not answered; as the equivalent shift, the rms over the root of the sample's trackability. None = no
            limit.
        max_far_noise: standard deviation of the far tracks' residuals, of a ray with z = 1, above which the near
            returns are taken as independently moving and no point of the pair is answered; None = no limit.
        max_in_reach: fraction of the answers that may lie where the sensor would have measured them
            (:func:`free_space_violations`); above it no point is answered. None = no limit.
        fitted_noise: take the scale of the tracks' noise from the pose's residuals (``fit.sigma_px``), and from the
            tracks' covariances only its shape; else the covariances as they are.
        isotropic: fraction of that shape which does not depend on the patch, see ``covariance.noise_shape``.
        mismatch_px: mismatch whose term equals the track's own noise; None leaves the term out.
        residual_px, round_trip_px: reprojection residual and round trip whose term does: a track that contradicts the
            pose, or itself, is worse than others with its patch; None leaves the term out.
        sigma_scale: factor on the tracks' and the pose's parts of sigma, from a calibration.
        sensor_share: fraction of the sensor's relative noise that all its returns have in common (a wrong scale): it
            enters every recovered depth in full, however many near points there are.
        solver: ``(uv_0, uv_1, camera_0, camera_1, T_1_from_0) -> TwoView``, the triangulation.

    Returns:
        Estimate with score 1 where answered (the next stage ranks). ``sigma`` combines the track's covariance and
        the pose's (with it the sensor's noise, which the pose has from the near points); ``sigma_shared`` is the pose's
        part, common to the pair's points.

    Gates, the first that applies: NO_TRACK, NO_BASELINE, POSE_REFUTED, MISALIGNED, NO_POSE, BEHIND, PARALLAX,
    RESIDUAL, INCONSISTENT, UNCERTAIN; CONTRADICTED in place of an answer.
    The rolling shutter of the fit (``fit.shutter``) is undone in ``uv_1`` and included in sigma.

    Raises:
        ValueError: wrong shapes.

    Gradient: depth, sigma, parallax and residual to pixels, cameras and pose; gates carry none. Points that are not
    answered pass no gradient.
    Source: paper, "Gated two-view triangulation and abstention".
    """
    posed, static = fit.ok[:, None], fit.code == PoseCode.NO_BASELINE
    tracked = tracks.valid & all_finite(tracks.uv_0, -1) & all_finite(tracks.uv_1, -1)
    uv_0, uv_1 = (torch.where(tracked[..., None], x, 0) for x in (tracks.uv_0, tracks.uv_1))
    cov = torch.where(tracked[..., None, None], tracks.cov, 0)
    grey_rms, round_trip, texture = (
        torch.where(tracked, x, 0) for x in (tracks.photometric, tracks.error, samples.trackability)
    )
    y = None
    if fit.shutter is not None:
        y = cam.ray_heights(camera_0, uv_0)
        shutter_rate = torch.where(posed, fit.shutter.shutter_rate, torch.zeros_like(fit.shutter.shutter_rate))
        uv_1 = undo_rolling_shutter(uv_1.transpose(1, 2), camera_1.f, camera_1.c, y, shutter_rate).transpose(1, 2)
    # Without a pose a fixed valid one, so that arithmetic and gradients stay finite.
    T, eye = fit.T_1_from_0, torch.eye(3, dtype=fit.cov.dtype, device=fit.cov.device)
    T = Pose(torch.where(posed[..., None], T.R, eye), torch.where(posed, T.t, eye[0]))
    geometry = solver(uv_0, uv_1, camera_0, camera_1, T)
    parallax_deg = geometry.parallax * (180 / math.pi)
    mismatch = grey_rms / texture.clamp_min(1e-8).sqrt()
    if fitted_noise:  # the shape of the tracks' covariances and the scale of the pose's residuals
        scale = torch.where(fit.ok[:, None], fit.sigma_px[:, None], 1.0).to(cov.dtype)
        cov = noise_shape(cov, tracked, isotropic) * (scale * scale)[..., None, None]
    own, shared = _variance(geometry, cov, fit, y)
    own, shared = own * sigma_scale**2, shared * sigma_scale**2
    own = own * _variance_factor(
        (mismatch, mismatch_px), (geometry.residual_px, residual_px), (round_trip, round_trip_px)
    )
    no_share = torch.zeros_like(shared)
    by_pose, by_sensor = shared, no_share
    if sensor_share > 0:
        used = fit.inlier & (samples.depth > 0)
        relative = samples.sigma / torch.where(used, samples.depth, torch.ones_like(samples.depth))
        relative = torch.where(used.any(-1, keepdim=True), masked_median(relative, used), 0.0)
        by_sensor = (sensor_share * relative * geometry.depth) ** 2
        shared = by_pose + by_sensor
    behind = ~((geometry.depth > 0) & (geometry.depth_1 > 0))
    weak = torch.zeros_like(fit.ok) if min_t_snr is None else ~(fit.t_snr >= min_t_snr)
    limit = None if max_sigma_rel is None else (max_sigma_rel * geometry.depth) ** 2
    gate = first_reason(
        (~tracked, Gate.NO_TRACK),
        (static[:, None].expand_as(tracked), Gate.NO_BASELINE),
        ((fit.code == PoseCode.REFUTED)[:, None].expand_as(tracked), Gate.POSE_REFUTED),
        ((fit.code == PoseCode.MISALIGNED)[:, None].expand_as(tracked), Gate.MISALIGNED),
        (~posed, Gate.NO_POSE),
        (weak[:, None].expand_as(tracked), Gate.NO_BASELINE),
        (behind, Gate.BEHIND),
        (parallax_deg <= (min_parallax_deg if min_parallax_deg is not None else -1.0), Gate.PARALLAX),
        (geometry.residual_px >= (max_residual_px if max_residual_px is not None else torch.inf), Gate.RESIDUAL),
        (_above(mismatch, max_mismatch_px), Gate.INCONSISTENT),
        (_above(own + shared, limit), Gate.UNCERTAIN),
    )
    sigma = _root(own + shared, gate == Gate.ANSWER)
    contradicted = torch.zeros_like(fit.ok)
    if max_far_noise is not None:
        contradicted = contradicted | (fit.sigma_px > max_far_noise * camera_1.f.detach().amin(-1))
    if max_in_reach is not None:
        sensor_depth = torch.where(samples.usable, samples.depth, torch.zeros_like(samples.depth))
        candidates = (gate == Gate.ANSWER) & (samples.hole == Hole.TRACKABLE_NO_LIDAR)
        violations = free_space_violations(samples.uv, sensor_depth, fit.inlier, candidates, geometry.depth, sigma)
        contradicted = contradicted | (violations > max_in_reach)
    gate = torch.where((gate == Gate.ANSWER) & contradicted[:, None], Gate.CONTRADICTED, gate)
    keep, measured = gate == Gate.ANSWER, tracked & posed
    return Estimate(
        uv=samples.uv,
        depth=torch.where(keep, geometry.depth, torch.nan),
        sigma=torch.where(keep, sigma, torch.nan),
        sigma_shared=torch.where(keep, _root(shared, keep), torch.nan),
        parallax_deg=torch.where(measured, parallax_deg, torch.zeros_like(parallax_deg)),
        residual_px=torch.where(measured, geometry.residual_px, torch.zeros_like(geometry.residual_px)),
        n_views=torch.where(measured, 2, 1).to(torch.int32),
        score=keep.to(geometry.depth.dtype),
        gate=gate,
        parts=SigmaBudget(own, by_pose, by_sensor, lens=no_share, model=no_share),
    )


def _variance(geometry: epipolar.TwoView, cov: Tensor, fit: PoseFit, y: Tensor | None) -> tuple[Tensor, Tensor]:
    """Own and shared variance of depth; a shutter rate adds three columns to the pose's."""
    if fit.shutter is None or y is None:
        return epipolar.depth_variance(geometry, cov, fit.cov.nan_to_num())
    J = torch.cat((geometry.J_pose, geometry.J_pose[..., :3] * y[..., None, None]), -1)
    return epipolar.depth_variance(geometry._replace(J_pose=J), cov, fit.shutter.cov.nan_to_num())


def _variance_factor(*terms: tuple[Tensor, float | None]) -> Tensor | float:
    """Factor on a track's variance from error terms and their scales: 1 + Σ (term / scale)²."""
    factor: Tensor | float = 1.0
    for term, scale in terms:
        if scale is not None:
            factor = factor + (term / scale) ** 2
    return factor


def _above(x: Tensor, limit: Tensor | float | None) -> Tensor:
    """Where ``x`` exceeds the limit or is not a number; nowhere without a limit."""
    return torch.zeros_like(x, dtype=torch.bool) if limit is None else ~(x <= limit)


def _root(x: Tensor, keep: Tensor) -> Tensor:
    """Square root whose gradient stays finite where the value is not used or zero."""
    positive = keep & (x > 0)
    return torch.where(positive, torch.where(positive, x, torch.ones_like(x)).sqrt(), torch.zeros_like(x))


@shaped("uv: B N 2, sensed: B N, pose_returns: B N, candidates: B N, depth: B N, sigma: B N")
def free_space_violations(
    uv: Tensor,  # (B, N, 2) px
    sensed: Tensor,  # (B, N) m, 0 = no return
    pose_returns: Tensor,  # (B, N) bool
    candidates: Tensor,  # (B, N) bool
    depth: Tensor,  # (B, N) m
    sigma: Tensor,  # (B, N) m
) -> Tensor:
    """Fraction (B,) of the answers without return whose depth plus two sigma is below the median depth of the returns.

    Args:
        uv: samples.
        sensed: depth of the sensor at the samples.
        pose_returns: returns that the pose is estimated from; their median depth is within the range of the sensor.
        candidates: answers at samples whose return is missing for no other reason. Only those in cells of the image
            without any return are tested: small holes between returns are usual.
        depth, sigma: depth of the answers and its standard deviation.

    Returns:
        0 where fewer than :data:`MIN_FREE_SPACE_ANSWERS` answers are tested, for a sensor that is sparse also where it
        has returns, and where more returns than answers are given: a moving object would then be most of the measured
        scene, and a sensor of long range has its holes for other reasons.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    has_return = sensed > 0
    pose_returns = pose_returns & has_return
    return_ratio = _return_ratio(uv, has_return)
    # Lower limit of the fraction of samples with a return in the cells of returns; in sparser data a missing return
    # is no evidence of free space.
    dense = torch.where(has_return, return_ratio, 0).sum(-1) >= 0.6 * has_return.sum(-1).clamp_min(1)
    few_returns = pose_returns.sum(-1) <= candidates.sum(-1)
    candidates = candidates & (return_ratio == 0)
    violating = candidates & (depth.detach() + 2 * sigma.detach() < masked_median(sensed.detach(), pose_returns))
    n = candidates.sum(-1)
    ratio = violating.sum(-1) / n.clamp_min(1).to(depth.dtype)
    testable = dense & pose_returns.any(-1) & (n >= MIN_FREE_SPACE_ANSWERS) & few_returns
    return torch.where(testable, ratio, torch.zeros_like(ratio))


def _return_ratio(uv: Tensor, has_return: Tensor) -> Tensor:
    """Fraction (B, N) of the samples in each sample's cell that have a return; cells divide the samples' extent."""
    N = uv.shape[1]
    rows = max(1, round((0.75 * N / SAMPLES_PER_CELL) ** 0.5))
    columns = max(1, round(N / SAMPLES_PER_CELL / rows))
    lowest, highest = uv.detach().amin(1, keepdim=True), uv.detach().amax(1, keepdim=True)
    cell_position = (uv.detach() - lowest) / (highest - lowest).clamp_min(1e-6) * constant(uv, [columns, rows])
    column, row = cell_position.long().unbind(-1)
    cell = column.clamp_max(columns - 1) + columns * row.clamp_max(rows - 1)
    ones = torch.ones_like(uv[..., 0])
    empty = ones.new_zeros(len(ones), columns * rows)
    in_cell, returns = (
        empty.scatter_add(1, cell, x) for x in (ones, torch.where(has_return, ones, 0))
    )  # integers: exact
    return returns.gather(1, cell) / in_cell.gather(1, cell)
