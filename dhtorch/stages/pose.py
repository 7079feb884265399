"""Stage 5, near returns and their tracks → the metric relative pose of the pair, with a covariance, or none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dhtorch.codes import PoseCode
from dhtorch.geometry import covariance, ransac, se3
from dhtorch.geometry.least_squares import (
    LANES,
    MIN_DEPTH,
    Normal,
    gauss_newton_step,
    linearise,
    minimise,
    normal_equations,
    robust,
)
from dhtorch.geometry.shapes import check
from dhtorch.records import Camera, Pose, PoseFit, Samples, Tracks
from dhtorch.tree import collate

#: Pairs solved together: few enough for their temporaries to stay in cache.
PAIRS = 16

#: Points the search looks at; a pair with more is thinned evenly. The last steps see all points.
SEARCH_POINTS = 256

#: Noise below this is not believed (px): residuals of exact data are rounding.
MIN_SIGMA_PX = 1e-6


def pnp_ransac(
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    draws: Tensor,  # (B, H, 3) uniform in [0, 1), made on the CPU
    *,
    threshold_px: float = 3.0,
    min_inlier: int = 8,
    local_optimisation: int = 2,
    polish_steps: int = 2,
    kernel: str | None = None,
    kernel_px: float = 1.0,
) -> PoseFit:
    """The metric pose of camera 1 relative to camera 0 from samples with a sensor return, or the reason why not.

    Each draw picks three near points, whose four possible poses are scored on the others by truncated squared errors.
    The best two are refined by damped Gauss–Newton steps on the truncated cost (the set of inliers is
    recomputed at each step), the better one again on all points, and a last undamped step from that detached optimum
    carries the gradient.

    Args:
        samples: near points are those with finite ``xyz`` (camera 0, m); the others are ignored here.
        tracks: ``uv_1`` in ideal pixels of camera 1; only ``valid`` ones are used.
        camera_0: not needed, ``xyz`` is metric; here because seats share their arguments.
        camera_1: intrinsics of view 1, ideal.
        draws: the randomness, H hypotheses per pair.
        threshold_px: largest reprojection error of an inlier.
        min_inlier: fewer inliers (or fewer than 4) make no pose.
        local_optimisation: steps for each of the best two hypotheses.
        polish_steps: steps for the better one on all points, before the last.
        kernel: None, ``"huber"``, ``"cauchy"`` or ``"geman_mcclure"``: robust weights of the inliers in the polish.
        kernel_px: where the kernel bends.

    Returns:
        PoseFit; ``cov`` = sigma_px² (Jᵀ W J)⁻¹, with sigma_px from the inliers' residuals (2 n − 6 degrees of freedom)
        and first-order, so it knows nothing of errors in ``xyz``. Where there is no pose, R, t, cov, rms_px, sigma_px
        and t_snr are NaN, no point is an inlier and ``n_inlier`` is what was counted. Codes: TOO_FEW near points or
        inliers; DEGENERATE: the points lie on a line or leave the pose undetermined. Points in one plane are fine.

    Raises:
        ValueError: wrong shapes, no hypothesis, an unknown kernel.

    Gradient: R and t to near ``xyz``, ``uv_1`` and camera 1, exact to first order for small residuals, zero for
    outliers; cov, rms_px, sigma_px and t_snr are detached.
    Cost: linear in B, H and N. Float64 in the minimal solver and the last step, the inputs' dtype elsewhere.
    Source: paper, "LiDAR-anchored relative pose", with P3P in place of EPnP. Checked against cv2 and PoseLib.
    """
    B = check(
        "pnp_ransac",
        xyz=(samples.xyz, "B N 3"),
        uv_1=(tracks.uv_1, "B N 2"),
        valid=(tracks.valid, "B N"),
        f_1=(camera_1.f, "B 2"),
        draws=(draws, "B H 3"),
    )["B"]
    options = _Options(threshold_px, max(4, min_inlier), local_optimisation, polish_steps, kernel, kernel_px)
    inputs = (samples.xyz, tracks.uv_1, tracks.valid, camera_1.f, camera_1.c, draws.to(samples.xyz))
    if B <= PAIRS:
        return _fit(options, *inputs)
    return collate([_fit(options, *(x[b : b + PAIRS] for x in inputs)) for b in range(0, B, PAIRS)])


@dataclass(frozen=True)
class _Options:
    threshold_px: float
    min_inlier: int
    local_optimisation: int
    polish_steps: int
    kernel: str | None
    kernel_px: float


def _fit(options: _Options, xyz: Tensor, uv: Tensor, valid: Tensor, f: Tensor, c: Tensor, draws: Tensor) -> PoseFit:
    N = xyz.shape[1]
    xyz, uv, usable = _planes(xyz, uv, valid)
    with torch.no_grad():
        start, found = _robust_pose(xyz, uv, usable, f, c, draws, options)
    # The last step, in float64 and with the graph on.
    rows, depth = linearise(start, f.double(), c.double(), xyz.double(), uv.double())
    with torch.no_grad():
        square = (rows[:, 6] * rows[:, 6]).sum(1)
        inlier = usable & found[:, None] & (depth > MIN_DEPTH) & (square < options.threshold_px**2)
        weight = robust(square, options.kernel, options.kernel_px)[1] * inlier
    H, g = normal_equations(rows, weight)
    T, solved = gauss_newton_step(start, H, g)
    with torch.no_grad():
        n_inlier = inlier.sum(-1)
        enough = n_inlier >= options.min_inlier
        line = ransac.collinear(xyz, torch.where(enough[:, None], inlier, usable))
        finite = T.R.isfinite().flatten(1).all(1) & T.t.isfinite().all(1)
        code = torch.where(solved & finite, PoseCode.OK, PoseCode.DEGENERATE)
        code = torch.where(enough, code, PoseCode.TOO_FEW)
        code = torch.where(line, PoseCode.DEGENERATE, code)
        code = torch.where(usable.sum(-1) >= options.min_inlier, code, PoseCode.TOO_FEW).to(torch.int32)
        ok = code == PoseCode.OK
        total = (square * inlier).sum(-1)
        rms_px = (total / n_inlier.clamp_min(1)).sqrt()
        sigma_px = (total / (2 * n_inlier - 6).clamp_min(1)).sqrt().clamp_min(MIN_SIGMA_PX)
        cov, _ = covariance.from_normal(H, sigma_px)
        t_snr = covariance.mahalanobis(T.t, cov[:, 3:, 3:])

    def answer(x: Tensor) -> Tensor:
        return torch.where(ok.view(-1, *[1] * (x.ndim - 1)), x, torch.nan).to(uv.dtype)

    return PoseFit(
        T_1_from_0=Pose(answer(T.R), answer(T.t)),
        cov=answer(cov),
        inlier=(inlier & ok[:, None])[:, :N],
        n_inlier=n_inlier,
        rms_px=answer(rms_px),
        sigma_px=answer(sigma_px),
        t_snr=answer(t_snr),
        code=code,
    )


def _planes(xyz: Tensor, uv: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Planes (B, 3, N'), (B, 2, N') and usable (B, N'), N' > 0 a multiple of LANES; unusable points at a safe place."""
    usable = valid & xyz.isfinite().all(-1) & uv.isfinite().all(-1)
    safe = torch.tensor([0.0, 0.0, 1.0], dtype=xyz.dtype, device=xyz.device)
    xyz = torch.where(usable[..., None], xyz, safe)
    uv = torch.where(usable[..., None], uv, torch.zeros_like(uv))
    N = usable.shape[1]
    padding = max(N + -N % LANES, LANES) - N
    xyz, uv = (torch.nn.functional.pad(x.transpose(1, 2), (0, padding)) for x in (xyz, uv))
    return xyz, uv, torch.nn.functional.pad(usable, (0, padding))


def _robust_pose(
    xyz: Tensor, uv: Tensor, usable: Tensor, f: Tensor, c: Tensor, draws: Tensor, options: _Options
) -> tuple[Pose, Tensor]:
    """Search, refine the best two, polish the better: a float64 pose (exactly a rotation) and whether there is one."""
    index, count = ransac.usable_first(usable, min(SEARCH_POINTS, usable.shape[1]))
    near, seen = (x.gather(2, index[:, None].expand(-1, x.shape[1], -1)) for x in (xyz, uv))
    poses, cost = ransac.search(near, seen, count, f, c, draws, threshold_px=options.threshold_px)
    found = cost[:, 0].isfinite()
    keep = cost.shape[1]
    used = torch.arange(index.shape[1], device=index.device) < count[:, None]
    fk, ck, near, seen, used = (x.repeat_interleave(keep, 0) for x in (f, c, near, seen, used))
    cost_of = _truncated(fk, ck, near, seen, used, options.threshold_px)
    flat = Pose(poses.R.flatten(0, 1), poses.t.flatten(0, 1))
    flat, cost = minimise(cost_of, flat, options.local_optimisation)
    best = cost.unflatten(0, (-1, keep)).argmin(1)[:, None]
    R = flat.R.unflatten(0, (-1, keep)).gather(1, best[..., None, None].expand(-1, 1, 3, 3))[:, 0]
    t = flat.t.unflatten(0, (-1, keep)).gather(1, best[..., None].expand(-1, 1, 3))[:, 0]
    cost_of = _truncated(f, c, xyz, uv, usable, options.threshold_px, options.kernel, options.kernel_px)
    T, _ = minimise(cost_of, Pose(R, t), options.polish_steps)
    safe = found & T.R.isfinite().flatten(1).all(1) & T.t.isfinite().all(1)
    eye = se3.identity(len(f), T.R)
    R = torch.where(safe[:, None, None], T.R, eye.R).double()
    return Pose(_orthonormal(R), torch.where(safe[:, None], T.t, eye.t).double()), safe


def _truncated(
    f: Tensor,
    c: Tensor,
    xyz: Tensor,
    uv: Tensor,
    usable: Tensor,
    threshold_px: float,
    kernel: str | None = None,
    kernel_px: float = 1.0,
) -> Callable[[Pose], Normal]:
    """The cost that search and refinement share: Σ rho(min(r², threshold²)), points behind the camera in full."""
    limit = threshold_px * threshold_px

    def evaluate(T: Pose) -> Normal:
        rows, depth = linearise(T, f, c, xyz, uv)
        square = (rows[:, 6] * rows[:, 6]).sum(1)
        square = square.masked_fill(depth <= MIN_DEPTH, limit).clamp(max=limit)
        rho, weight = robust(square, kernel, kernel_px)
        H, g = normal_equations(rows, weight * (usable & (square < limit)))
        return Normal((rho * usable).sum(-1), H, g)

    return evaluate


def _orthonormal(R: Tensor) -> Tensor:
    """The rotation nearest along Gram–Schmidt to one that has drifted by rounding."""
    x = R[:, 0] / R[:, 0].norm(dim=-1, keepdim=True)
    z = torch.linalg.cross(x, R[:, 1])
    z = z / z.norm(dim=-1, keepdim=True)
    return torch.stack((x, torch.linalg.cross(z, x), z), 1)
