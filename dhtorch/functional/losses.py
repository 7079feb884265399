"""Losses for training on recovered depths and through the stages: depth with a sigma, pixels with a covariance, ranks.

Elements without a label, masked or behind the camera cost nothing.

What has no value is replaced before arithmetic, so that its gradient is exactly zero and never NaN.
"""

import torch
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import all_finite, shaped
from dhtorch.geometry.least_squares import MIN_DEPTH, robust_loss
from dhtorch.geometry.linalg import adjugate_2x2, determinant_2x2, quadratic_form, upper_triangle
from dhtorch.geometry.se3 import Pose


def sigma_weighted_depth_loss(
    prediction: Tensor,  # (…) m
    target: Tensor,  # (…) m; NaN or ≤ 0 = no label
    sigma: Tensor,  # (…) m, standard deviation of target - prediction; NaN or ≤ 0 = no label
    keep: Tensor | None = None,  # (…) bool, elements that count
    *,
    kernel: str | None = None,
    scale: float = 3.0,
    reduction: str = "mean",
) -> Tensor:
    """Depths and labels with a sigma -> loss, the mean of rho(((prediction − target) / sigma)²).

    A label counts with 1 / sigma², a missing one not at all: the labels may be recovered depths as they come
    (``estimate.depth``, ``.sigma``, ``.keep``), sensor depth with its noise, or both merged. Labels equal to the
    prediction within their sigmas have a loss of about 1.

    Args:
        prediction, target, sigma: equal shapes, maps (B, H, W) or samples (B, N).
        keep: elements that count, ``estimate.keep`` for an estimate; None = all that have a label.
        kernel: robust kernel rho of :func:`dhtorch.geometry.least_squares.robust_loss`: ``"huber"``, ``"cauchy"``,
            ``"geman_mcclure"``, or None, plain squares.
        scale: residual at which the kernel bends, in standard deviations.
        reduction: ``"mean"`` over the elements that count, ``"sum"``, or ``"none"``, the loss per element.

    Returns:
        A scalar, or (…) with 0 where an element does not count. Without any that counts the mean is 0. A prediction
        that counts and is not finite makes the loss NaN: a diverged network is not hidden.

    Raises:
        ValueError: unequal shapes, ``keep`` that is not bool, an unknown kernel or reduction.

    Gradient: to prediction and target; exactly 0 where an element does not count, whatever its values. Sigma is a
    weight and gets none: with one, the loss would be smallest for an infinite sigma.
    Source: the negative logarithm of a normal (kernel None) density of independent errors, without its constant.
    """
    _check_equal_shapes("sigma_weighted_depth_loss", prediction=prediction, target=target, sigma=sigma, keep=keep)
    sigma = sigma.detach()
    used = (target > 0) & target.isfinite() & (sigma > 0) & sigma.isfinite()
    if keep is not None:
        used = used & keep
    one = torch.ones_like(sigma)
    residual = (torch.where(used, prediction, 0) - torch.where(used, target, 0)) / torch.where(used, sigma, one)
    return _reduce(robust_loss(residual * residual, kernel, scale)[0], used, reduction)


@shaped(
    "depth_0: B N, uv_0: B N 2, uv_1: B N 2, cov: B N 2 2, keep: B N, T_1_from_0.R: B 3 3, T_1_from_0.t: B 3, "
    "camera_0.f: B 2, camera_1.f: B 2"
)
def reprojection_loss(
    depth_0: Tensor,  # (B, N) m, z in camera 0; NaN or ≤ 0 = none
    uv_0: Tensor,  # (B, N, 2) px, of the reference view as it is, lens included
    uv_1: Tensor,  # (B, N, 2) px, measured in the source view as it is
    T_1_from_0: Pose,
    camera_0: Camera,
    camera_1: Camera,
    *,
    cov: Tensor | None = None,  # (B, N, 2, 2) px², of uv_1
    keep: Tensor | None = None,  # (B, N) bool, points that count
    kernel: str | None = None,
    scale: float = 3.0,
    reduction: str = "mean",
) -> Tensor:
    """Depths of the reference view, a pose and measured pixels -> loss, the mean of rho(rᵀ cov⁻¹ r).

    r = uv_1 − π_1(T · π_0⁻¹(uv_0, depth_0)) in pixels. The depths may be an estimate's, a sensor's or a network's;
    ``uv_0``, ``uv_1``, ``cov`` and ``keep`` (``valid``) those of :class:`dhtorch.records.Tracks`, or of any matcher.
    With the right geometry and pixels as noisy as ``cov`` states the loss is 2, at depths fitted to ``uv_1`` it is 1.

    Args:
        depth_0, uv_0: points in the reference view.
        uv_1: their pixels in the source view.
        T_1_from_0: relative pose; a pair whose pose is not finite does not count.
        camera_0, camera_1: intrinsics and lenses of the two views.
        cov: covariance of ``uv_1``; None = 1 px² in every direction.
        keep: points that count; None = all.
        kernel, scale, reduction: as :func:`sigma_weighted_depth_loss`.

    Returns:
        A scalar, or (B, N) with 0 where a point does not count: masked, without depth or pixel, outside the lens model,
        with a singular covariance, or behind camera 1, where it has no pixel. Without any that counts the mean is 0.

    Raises:
        ValueError: wrong shapes, ``keep`` that is not bool, an unknown kernel or reduction.

    Gradient: to depth, pixels, pose, intrinsics and lenses; exactly 0 from points that do not count. The covariance is
    a weight and gets none.
    Source: R. Hartley, A. Zisserman, "Multiple View Geometry", section 4.2.8 (Mahalanobis distance of pixels).
    """
    _check_equal_shapes("reprojection_loss", depth_0=depth_0, keep=keep)
    posed = T_1_from_0.R.isfinite().flatten(1).all(-1) & all_finite(T_1_from_0.t, -1)
    eye = torch.eye(3).to(T_1_from_0.R)
    T = Pose(torch.where(posed[:, None, None], T_1_from_0.R, eye), torch.where(posed[:, None], T_1_from_0.t, eye[2]))
    used = (depth_0 > 0) & depth_0.isfinite() & all_finite(uv_0, -1) & all_finite(uv_1, -1) & posed[:, None]
    used = used if keep is None else used & keep
    if camera_0.distortion is not None:
        with torch.no_grad():
            used = used & all_finite(cam.rays(camera_0, torch.where(used[..., None], uv_0, camera_0.c[:, None])), -1)
    uv_0 = torch.where(used[..., None], uv_0, camera_0.c.detach()[:, None])
    xyz_1 = se3.apply(T, cam.unproject(camera_0, uv_0, torch.where(used, depth_0, 1)))
    used = used & (xyz_1[..., 2] > MIN_DEPTH)
    inverse, invertible = _inverse_covariance(torch.eye(2).to(uv_1).expand(*uv_1.shape, 2) if cov is None else cov)
    used = used & invertible
    residual = uv_1 - cam.project(camera_1, torch.where(used[..., None], xyz_1, eye[2]))
    du, dv = torch.where(used[..., None], residual, 0).unbind(-1)
    return _reduce(robust_loss(quadratic_form(du, dv, *inverse), kernel, scale)[0], used, reduction)


@shaped("confidence: B N, error: B N, keep: B N")
def risk_coverage_loss(
    confidence: Tensor,  # (B, N), any numbers that order the answers of a set, such as -ln(expected error)
    error: Tensor,  # (B, N) relative error, counted as 1 where larger
    keep: Tensor | None = None,  # (B, N) bool, answers that count
    *,
    temperature: float = 0.1,
) -> Tensor:
    """Confidences and errors -> area (B,) under the risk–coverage curve of each set, least in the order of the errors.

    The risk of the surest k answers is their mean error, and the area the mean risk over all k: an error at rank r
    counts with (1/r + 1/(r + 1) + … + 1/n) / n. Here a rank is 1 plus the sum of sigmoid(Δconfidence / temperature)
    over the other answers; for a temperature towards 0 and confidences without ties the area is ``aurc`` of
    :func:`dhtorch.metrics.risk.measure_risk`.

    Args:
        confidence, error: of the answers of B sets, such as pairs or scenes.
        keep: answers that count; None = all.
        temperature: difference of confidence at which two answers are ordered with weight 0.73 instead of 1.

    Returns:
        (B,) area, 0 for a set without answers. For the geometric mean over sets minimise the mean of its logarithm.

    Raises:
        ValueError: wrong shapes, or a temperature that is not positive.

    Gradient: to both; 0 from answers that do not count, and to the error where it is larger than 1.
    Memory: B · N².
    Source: derived, the area of Y. Geifman, G. Uziel, R. El-Yaniv, "Bias-reduced uncertainty estimation", 2019, as a
    sum over answers; soft ranks as in T. Qin, T. Liu, H. Li, "A general approximation framework for direct optimization
    of information retrieval measures", 2010.
    """
    if not temperature > 0:
        raise ValueError(f"risk_coverage_loss: temperature is {temperature}, expected a positive number")
    used = torch.ones_like(error, dtype=torch.bool) if keep is None else keep
    c = torch.where(used, confidence, 0)
    e = torch.where(used, error, 0).clamp(max=1)
    n = used.sum(-1, keepdim=True).to(c)
    ahead = ((c[..., None, :] - c[..., :, None]) / temperature).sigmoid()
    others = used[..., None, :] & ~torch.eye(c.shape[-1], dtype=torch.bool, device=c.device)
    rank = 1 + torch.where(others, ahead, 0).sum(-1)
    weight = torch.digamma(n + 1) - torch.digamma(torch.where(used, rank, 1))
    return torch.where(used, e * weight, 0).sum(-1) / n[..., 0].clamp_min(1)


def _inverse_covariance(cov: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Entries (xx, xy, yy) of the inverses of covariances (…, 2, 2) without gradient, and which of them exist."""
    xx, xy, yy = upper_triangle(cov.detach())
    det = determinant_2x2(xx, xy, xy, yy)
    invertible = (xx > 0) & (yy > 0) & (det > 0) & det.isfinite()
    a, b, _, c = adjugate_2x2(xx, xy, xy, yy)
    zero, one = torch.zeros_like(det), torch.ones_like(det)
    det = torch.where(invertible, det, one)
    return (
        torch.where(invertible, a / det, one),
        torch.where(invertible, b / det, zero),
        torch.where(invertible, c / det, one),
    ), invertible


def _reduce(cost: Tensor, used: Tensor, reduction: str) -> Tensor:
    """Costs of the used elements: their mean, their sum, or each, 0 for the others."""
    cost = torch.where(used, cost, 0)
    if reduction == "none":
        return cost
    if reduction == "sum":
        return cost.sum()
    if reduction == "mean":
        return cost.sum() / used.sum().clamp_min(1)
    raise ValueError(f"loss: reduction is {reduction!r}, expected 'mean', 'sum' or 'none'")


def _check_equal_shapes(where: str, *, keep: Tensor | None, **values: Tensor) -> None:
    """Raise ValueError unless all shapes are equal and ``keep`` is a mask: gate codes would count in reverse."""
    shapes = {name: tuple(x.shape) for name, x in (values | {"keep": keep}).items() if x is not None}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"{where}: shapes are {shapes}, expected equal ones")
    if keep is not None and keep.dtype != torch.bool:
        raise ValueError(f"{where}: keep is {keep.dtype}, expected bool (of gate codes: estimate.keep, or gate == 0)")
