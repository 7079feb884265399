"""Stage 5: near returns and tracks → metric relative pose of the pair with a covariance, or a code without pose."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from dhtorch.codes import PoseCode, first_reason
from dhtorch.geometry import camera as cam
from dhtorch.geometry import covariance, p3p, ransac, reprojection_problem, se3
from dhtorch.geometry.checks import all_finite, shaped
from dhtorch.geometry.determinism import PRODUCT_LANES, SUM_LANES, round_up, run_without_grad
from dhtorch.geometry.least_squares import (
    INITIAL_DAMPING,
    MIN_DEPTH,
    MIN_PIVOT,
    NormalEquations,
    has_graph,
    implicit_step,
    linearise,
    minimise,
    move_pose,
    normal_equations,
    reprojection_residuals,
    robust_loss,
    select_batch,
    solve_spd,
)
from dhtorch.geometry.linalg import upper_triangle
from dhtorch.geometry.map_estimate import FitOptions, estimate_map_pose, pose_covariance
from dhtorch.geometry.reprojection_problem import PoseDepthProblem
from dhtorch.ops.dispatch import operator
from dhtorch.pytree import chunked_apply
from dhtorch.records import Camera, Pose, PoseFit, Samples, Shutter, Tracks

#: Limits the pairs that :func:`map_pose` solves together, a count; each track has ten columns.
MAP_CHUNK_PAIRS = 16

#: Limits the points of a pair in the search, a count; more are thinned evenly. The last steps use all points.
MAX_SEARCH_POINTS = 256


@shaped("samples.xyz: B N 3, tracks.uv_1: B N 2, tracks.valid: B N, camera_1.f: B 2, draws: B H 3")
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
    polish_steps: int = 1,
    kernel: str | None = None,
    kernel_px: float = 1.0,
) -> PoseFit:
    """Metric pose of camera 1 relative to camera 0 from tracked samples with a return, or a code where there is none.

    Each draw selects three near points, whose four possible poses are scored on the others by truncated squared errors.
    The best two are refined by damped Gauss–Newton steps on the truncated cost (the inliers are recomputed at each
    step), the better one again on all points, and a last undamped step from that detached optimum carries the gradient.

    Args:
        samples: near points are those with finite ``xyz`` (B, N, 3), m in camera 0; the others are ignored here.
        tracks: ``uv_1`` (B, N, 2) in ideal pixels of camera 1; only ``valid`` (B, N) ones are used.
        camera_0: not used, ``xyz`` is metric; part of the stage's signature.
        camera_1: intrinsics of view 1, ideal: focal lengths and principal point, (B, 2) px each.
        draws: (B, H, 3), the randomness: H hypotheses per pair.
        threshold_px: largest reprojection error of an inlier.
        min_inlier: fewer inliers (or fewer than 4) make no pose.
        local_optimisation: steps for each of the best two hypotheses.
        polish_steps: steps for the better one on all points, before the last.
        kernel: None, ``"huber"``, ``"cauchy"`` or ``"geman_mcclure"``: robust weights of the inliers in the polish.
        kernel_px: where the kernel bends.

    Returns:
        PoseFit: ``T_1_from_0`` with R (B, 3, 3) and t (B, 3) m, which carry points from camera 0 to camera 1;
        ``inlier`` (B, N); ``code`` (B,); ``cov`` (B, 6, 6) = sigma_px² (Jᵀ W J)⁻¹ of (rotation rad, translation m),
        with sigma_px from the inliers' residuals (2 n − 6 degrees of freedom) and first-order; it does not contain
        errors of ``xyz``. Where there is no pose, R, t, cov, rms_px, sigma_px and t_snr are NaN, no point is an inlier
        and ``n_inlier`` is the count before that. Codes: TOO_FEW near points or inliers; DEGENERATE: the points lie on
        a line or leave the pose undetermined. Points in one plane are fine.

    Raises:
        ValueError: wrong shapes, no hypothesis, an unknown kernel.

    Gradient: R and t to near ``xyz``, ``uv_1`` and camera 1, exact to first order, zero for outliers; cov,
    rms_px, sigma_px and t_snr are detached.
    Cost: linear in B, H and N. Float64 in the minimal solver and the last step, the inputs' dtype elsewhere.
    Source: paper, "LiDAR-anchored relative pose", with P3P in place of EPnP. Checked against
    ``cv2.solvePnPRansac`` and ``poselib.estimate_absolute_pose`` (``tests/stages/test_pose.py``).

    Example:
        >>> import torch
        >>> from dhtorch.codes import PoseCode
        >>> from dhtorch.geometry.camera import project, unproject
        >>> from dhtorch.records import Camera, Samples, Tracks
        >>> from dhtorch.stages.pose import pnp_ransac
        >>> draw = torch.Generator().manual_seed(0)
        >>> camera = Camera(f=torch.full((2, 2), 500.0), c=torch.full((2, 2), 320.0))  # B = 2 pairs
        >>> uv_0, depth = 640 * torch.rand(2, 50, 2, generator=draw), 1 + 3 * torch.rand(2, 50, generator=draw)
        >>> xyz = unproject(camera, uv_0, depth)  # (B, N, 3) m
        >>> uv_1 = project(camera, xyz + torch.tensor([0.2, 0.0, 0.0]))  # camera 1 stands 0.2 m to the left
        >>> uv_1[:, :10] += 40.0  # wrong tracks
        >>> zero, code = torch.zeros(2, 50), torch.zeros(2, 50, dtype=torch.int32)
        >>> unread = {"confidence": zero, "flag": code, "trackability": zero, "hole": code}
        >>> samples = Samples(uv_0, depth, sigma=0.01 * depth, xyz=xyz, **unread)
        >>> valid = torch.stack((zero[0] == 0, zero[1] == 1))  # no valid track in the second pair
        >>> cov = torch.eye(2).expand(2, 50, 2, 2)
        >>> tracks = Tracks(uv_0, uv_1, error=zero, photometric=zero, cov=cov, valid=valid)
        >>> fit = pnp_ransac(samples, tracks, camera, camera, torch.rand(2, 100, 3, generator=draw))
        >>> fit.code.tolist() == [PoseCode.OK, PoseCode.TOO_FEW], fit.n_inlier.tolist()
        (True, [40, 0])
        >>> (fit.T_1_from_0.t[0] - torch.tensor([0.2, 0.0, 0.0])).abs().max() < 1e-4
        tensor(True)
        >>> fit.T_1_from_0.t[1]
        tensor([nan, nan, nan])
    """
    options = _Options(
        threshold_px=threshold_px,
        min_inlier=max(4, min_inlier),
        local_optimisation=local_optimisation,
        polish_steps=polish_steps,
        kernel=kernel,
        kernel_px=kernel_px,
    )
    inputs = (samples.xyz, tracks.uv_1, tracks.valid, cam.ideal(camera_1), draws.to(samples.xyz))
    # Few enough pairs for their temporaries to stay in cache.
    return chunked_apply(partial(run_without_grad, _fit, options), 16, *inputs)


@dataclass(frozen=True)
class _Options:
    threshold_px: float
    min_inlier: int
    local_optimisation: int
    polish_steps: int
    kernel: str | None
    kernel_px: float


def _fit(options: _Options, xyz: Tensor, uv: Tensor, valid: Tensor, camera: Camera, draws: Tensor) -> PoseFit:
    # x, y, z, u, v (B, 5, N') and usable (B, N'), N' > 0 a multiple of PRODUCT_LANES; unusable points at zero
    points = torch.cat((xyz.transpose(1, 2), uv.transpose(1, 2)), 1)
    usable = valid & all_finite(points, 1)
    points = torch.where(usable[:, None], points, torch.zeros_like(points))
    N = usable.shape[1]
    padding = (0, round_up(N, PRODUCT_LANES) - N)
    points, usable = torch.nn.functional.pad(points, padding), torch.nn.functional.pad(usable, padding)
    fit = _near_pose(points, usable, camera.f, camera.c, draws, options=options)
    return fit.replace(inlier=fit.inlier[:, : xyz.shape[1]])


def _is_truncated_only(*_: Tensor, options: _Options) -> bool:
    """Whether costs are truncated squares without a robust kernel."""
    return options.kernel is None


def _near_pose_kernel(
    points: Tensor, usable: Tensor, f: Tensor, c: Tensor, draws: Tensor, *, options: _Options
) -> PoseFit:
    lens = f.contiguous(), c.contiguous()
    start, valid = _robust_pose_kernel(points, usable, *lens, draws, options=options)
    B = len(points)
    R, t, cov, rms, sigma, t_snr = (points.new_empty(B, *size) for size in ((3, 3), (3,), (6, 6), (), (), ()))
    inlier = torch.empty_like(usable)
    n_inlier, code = (torch.empty_like(valid, dtype=dtype) for dtype in (torch.int64, torch.int32))
    # Least standard deviation of the noise, px: residuals of exact data are rounding.
    torch.ops.dhtorch.pose_last_step.default(
        *(points, usable, *lens, start.R, start.t, valid),
        *(R, t, cov, inlier, n_inlier, rms, sigma, t_snr, code),
        threshold_px=options.threshold_px,
        min_inlier=options.min_inlier,
        min_sigma=1e-6,
        min_depth=MIN_DEPTH,
        min_pivot=MIN_PIVOT,
        max_ratio=ransac.MAX_DISTANCE_RATIO,
        min_spread=ransac.MIN_SPREAD_RATIO,
    )
    return PoseFit(
        T_1_from_0=Pose(R, t),
        cov=cov,
        inlier=inlier,
        n_inlier=n_inlier,
        rms_px=rms,
        sigma_px=sigma,
        t_snr=t_snr,
        code=code,
    )


@operator(
    kernel=_near_pose_kernel,
    dtypes={"points": torch.float32, "usable": torch.bool} | dict.fromkeys(("f", "c", "draws"), torch.float32),
    any_layout=("f", "c", "draws"),
    when=_is_truncated_only,
)
def _near_pose(points: Tensor, usable: Tensor, f: Tensor, c: Tensor, draws: Tensor, *, options: _Options) -> PoseFit:
    """:func:`pnp_ransac` of planes x, y, z, u, v (B, 5, N'), N' > 0 a multiple of ``PRODUCT_LANES``."""
    with torch.no_grad():
        start, has_start = _robust_pose(points, usable, f, c, draws, options=options)
    start = start.detach()  # forward mode passes through no_grad, into a search that may meet a singular triple
    # The last step, in float64 and with the graph on.
    f, c = f.double(), c.double()
    xyz, uv = points.double().split((3, 2), 1)
    rows, depth = linearise(start, f, c, xyz, uv)
    square = (rows[:, 6] * rows[:, 6]).sum(1)
    inlier = usable & has_start[:, None] & (depth > MIN_DEPTH) & (square < options.threshold_px**2)
    H, g = _inlier_normal_equations(options, rows, inlier)
    eye = torch.eye(6, dtype=H.dtype, device=H.device).expand_as(H)
    x, solved = solve_spd(H.detach(), torch.cat((-g.detach()[..., None], eye), -1))

    def equations(xi: Tensor) -> Tensor:
        moved, _ = linearise(move_pose(start, xi), f.detach(), c.detach(), xyz.detach(), uv.detach())
        return _inlier_normal_equations(options, moved, inlier)[1]

    T = move_pose(start, x[..., 0])
    if has_graph(g):
        T = move_pose(T, implicit_step(equations, g))
    with torch.no_grad():
        n_inlier = inlier.sum(-1)
        enough = n_inlier >= options.min_inlier
        collinear = ransac.is_collinear(xyz, torch.where(enough[:, None], inlier, usable))
        finite = (T.R.sum((1, 2)) + T.t.sum(1)).isfinite()
        code = first_reason(
            (usable.sum(-1) < options.min_inlier, PoseCode.TOO_FEW),
            (collinear, PoseCode.DEGENERATE),
            (~enough, PoseCode.TOO_FEW),
            (~(solved & finite), PoseCode.DEGENERATE),
            otherwise=PoseCode.OK,
        )
        total = torch.where(inlier, square, 0.0).detach().sum(-1)
        rms_px = (total / n_inlier.clamp_min(1)).sqrt()
        sigma_px = (total / (2 * n_inlier - 6).clamp_min(1)).sqrt().clamp_min(1e-6)
        inverse = x[..., 1:]
        cov = (inverse + inverse.transpose(1, 2)) * (0.5 * sigma_px * sigma_px)[:, None, None]
        # With H = L Lᵀ, the lower end of L is the factor of the translation's information, the rotation eliminated.
        lower = torch.linalg.cholesky_ex(H.detach()).L[:, 3:, 3:]
        whitened = (lower * T.t[..., None]).sum(1)
        t_snr = (whitened * whitened).sum(-1).sqrt() / sigma_px
    fit = PoseFit(T, cov, inlier, n_inlier, rms_px=rms_px, sigma_px=sigma_px, t_snr=t_snr, code=code)
    return fit.to(points.dtype).without_pose(code != PoseCode.OK, code)


def _inlier_normal_equations(o: _Options, rows: Tensor, inlier: Tensor) -> tuple[Tensor, Tensor]:
    """Normal equations of the inliers, weighted by the robust kernel."""
    _, weight = robust_loss((rows[:, 6] * rows[:, 6]).sum(1), o.kernel, o.kernel_px)
    return normal_equations(rows, torch.where(inlier, weight, 0.0))


def _robust_pose_kernel(
    points: Tensor, usable: Tensor, f: Tensor, c: Tensor, draws: Tensor, *, options: _Options
) -> tuple[Pose, Tensor]:
    B = len(points)
    R, t = (points.new_empty(B, *size, dtype=torch.float64) for size in ((3, 3), (3,)))
    valid = torch.empty_like(usable[:, 0])
    torch.ops.dhtorch.robust_pose.default(
        points=points,
        usable=usable,
        f=f.contiguous(),
        c=c.contiguous(),
        draws=draws.contiguous(),
        R=R,
        t=t,
        found=valid,
        threshold_px=options.threshold_px,
        local_optimisation=options.local_optimisation,
        polish_steps=options.polish_steps,
        search_points=MAX_SEARCH_POINTS,
        preview_points=ransac.PREVIEW_POINTS,
        shortlist=ransac.SHORTLISTED_POSES,
        keep=ransac.KEPT_POSES,
        damping=INITIAL_DAMPING,
        min_depth=MIN_DEPTH,
        min_height=p3p.MIN_HEIGHT_RATIO,
        max_cosine=p3p.MAX_RAY_COSINE,
    )
    return Pose(R, t), valid


@operator(
    kernel=_robust_pose_kernel,
    dtypes={"points": torch.float32, "usable": torch.bool} | dict.fromkeys(("f", "c", "draws"), torch.float32),
    any_layout=("f", "c", "draws"),
    when=_is_truncated_only,
)
def _robust_pose(
    points: Tensor, usable: Tensor, f: Tensor, c: Tensor, draws: Tensor, *, options: _Options
) -> tuple[Pose, Tensor]:
    """Search, refine the best two, polish the better: float64 pose (R orthonormal) and whether (B,) there is one."""
    index, count = ransac.usable_first(usable, min(MAX_SEARCH_POINTS, usable.shape[1]))
    near = points.gather(2, index[:, None].expand(-1, 5, -1))
    poses, cost = ransac.search_hypotheses(near, count, f, c, draws, threshold_px=options.threshold_px)
    valid, keep = cost[:, 0].isfinite(), cost.shape[1]
    used = torch.arange(index.shape[1], device=index.device) < count[:, None]
    near, used, fk, ck = (x.repeat_interleave(keep, 0) for x in (near, used, f, c))
    normal, cost_of = _truncated(near, used, fk, ck, threshold_px=options.threshold_px)
    flat = Pose(poses.R.flatten(0, 1), poses.t.flatten(0, 1))
    flat, cost = minimise(normal, flat, options.local_optimisation, cost=cost_of, move=move_pose)
    best = cost.view(-1, keep).argmin(1) + keep * torch.arange(len(f), device=f.device)
    normal, cost_of = _truncated(
        points, usable, f, c, threshold_px=options.threshold_px, kernel=options.kernel, kernel_px=options.kernel_px
    )
    T, _ = minimise(normal, flat[best], options.polish_steps, cost=cost_of, move=move_pose)
    return Pose(se3.orthonormal(T.R.double()), T.t.double()), valid


def _truncated(
    points: Tensor,
    usable: Tensor,
    f: Tensor,
    c: Tensor,
    *,
    threshold_px: float,
    kernel: str | None = None,
    kernel_px: float = 1.0,
) -> tuple[Callable[[Pose], NormalEquations], Callable[[Pose], Tensor]]:
    """The cost Σ rho(min(r², threshold²)) of search and refinement as functions: with normal equations, and alone.

    Points behind the camera cost threshold².
    """
    limits = torch.where(usable, threshold_px * threshold_px, 0.0).to(points.dtype)
    xyz, uv = points[:, :3], points[:, 3:]

    def truncated(r: Tensor, depth: Tensor) -> Tensor:
        square = (r * r).sum(1)
        return torch.where(depth > MIN_DEPTH, torch.minimum(square, limits), limits)

    def normal(T: Pose) -> NormalEquations:
        rows, depth = linearise(T, f, c, xyz, uv)
        square = truncated(rows[:, 6], depth)
        rho, weight = robust_loss(square, kernel, kernel_px)
        return NormalEquations(rho.sum(-1), *normal_equations(rows, torch.where(square < limits, weight, 0.0)))

    def cost(T: Pose) -> Tensor:
        rho, _ = robust_loss(truncated(*reprojection_residuals(T, f, c, xyz, uv)), kernel, kernel_px)
        return rho.sum(-1)

    return normal, cost


@shaped("samples.xyz: B N 3, tracks.uv_1: B N 2, tracks.cov: B N 2 2")
def map_pose(
    samples: Samples,
    tracks: Tracks,
    camera_0: Camera,
    camera_1: Camera,
    draws: Tensor,  # (B, H, 3) uniform in [0, 1)
    *,
    start: Callable[..., PoseFit] = pnp_ransac,
    far_weight: float = FitOptions.far_weight,
    max_rise: float = FitOptions.max_rise,
    isotropic: float = 0.1,
    shutter_sigma: float = FitOptions.shutter_sigma,
    shutter_gain: float = FitOptions.shutter_gain,
    translation_gain: float = FitOptions.translation_gain,
    kernel: str | None = FitOptions.kernel,
    bend: float = FitOptions.bend,
    near_steps: int = FitOptions.near_steps,
    steps: int = FitOptions.steps,
    blocks: tuple[int, int] | None = FitOptions.blocks,
    threshold_px: float = 3.0,
) -> PoseFit:
    """Most probable pose of all tracks: near tracks determine the scale, far tracks, without depth, the rotation.

    One least-squares problem per pair (:mod:`dhtorch.geometry.reprojection_problem`). A near residual is weighted by
    the noise of its track and of its depth; a far track has its own inverse depth, which is eliminated. First the near
    tracks alone are solved from the pose of ``start``, then all of them. The second pose is kept unless it fits the
    near tracks clearly worse: far tracks are many, and deviations from a rigid scene seen by two pinhole cameras show
    in them first. The noise scale is estimated from the residuals, near and far separately. Where it explains much of
    the residuals, each image row gets its own rotation, as under a rolling shutter.

    Args:
        samples: near points are those with finite ``xyz`` (B, N, 3), m in camera 0, and their noise ``sigma`` (B, N) m.
        tracks: ``uv_0``, ``uv_1`` (B, N, 2) in ideal pixels, ``cov`` (B, N, 2, 2) up to scale (px²); only ``valid``
            (B, N) ones are used.
        camera_0, camera_1: intrinsics, ideal; they may differ.
        draws: (B, H, 3), the randomness of ``start``.
        start: another function of this stage.
        far_weight: weight of a far track's cost: not its inverse variance, because neighbours share their errors.
        max_rise: fraction by which the near cost may rise over that of the near tracks alone.
        isotropic: fraction of a track's noise that does not depend on its patch, see ``covariance.noise_shape``.
        shutter_sigma: standard deviation of the shutter rate's prior, rad per unit of height (of a ray with z = 1);
            0 for a global shutter.
        shutter_gain: fraction of the cost that a shutter rate must take away to be accepted.
        translation_gain: fraction of the cost of the best pure rotation that the translation must take away.
        kernel, bend: robust kernel and the residual, in standard deviations, at which it bends.
        near_steps, steps: Levenberg–Marquardt steps of the two solutions.
        blocks: number of blocks of near tracks, across and down, whose scatter enlarges ``cov``; None = independent.
        threshold_px: largest reprojection error of a near track that is reported as an inlier.

    Returns:
        PoseFit with ``shutter``, shapes as of :func:`pnp_ransac`. ``cov`` is the sandwich of an M-estimator with
        inverse depths and shutter rate eliminated, which residuals with heavy tails enlarge; ``sigma_px`` is the noise
        scale of the far tracks, a factor on their shape. Codes: those of ``start`` where it has no pose; DEGENERATE:
        the near tracks leave the pose undetermined; NO_BASELINE: a pure rotation explains the tracks nearly as well;
        KEPT_PNP: far tracks contradict the near ones, and the pose is that of the near tracks alone.

    Raises:
        ValueError: wrong shapes, an unknown kernel; else as ``start``.

    Gradient: R, t and shutter rate to near ``xyz``, ``uv_0``, ``uv_1`` and both cameras, through one last step from the
    detached optimum: exact to first order. Noise and its scale, cov and codes are detached.
    Cost: linear in B and N. Float64 in the last step and the covariance, the inputs' dtype elsewhere.
    Source: see :mod:`dhtorch.geometry.reprojection_problem`.

    Example:
        >>> import torch
        >>> from dhtorch.geometry.camera import project, unproject
        >>> from dhtorch.records import Camera, Samples, Tracks
        >>> from dhtorch.stages.pose import map_pose
        >>> draw = torch.Generator().manual_seed(0)
        >>> camera = Camera(f=torch.full((1, 2), 500.0), c=torch.full((1, 2), 320.0))
        >>> uv_0, depth = 640 * torch.rand(1, 60, 2, generator=draw), 1 + 3 * torch.rand(1, 60, generator=draw)
        >>> xyz = unproject(camera, uv_0, depth)  # (B, N, 3) m
        >>> uv_1 = project(camera, xyz + torch.tensor([0.2, 0.0, 0.0])) + 0.2 * torch.randn(1, 60, 2, generator=draw)
        >>> xyz[:, 20:] = torch.nan  # the sensor does not reach the last 40
        >>> zero, code = torch.zeros(1, 60), torch.zeros(1, 60, dtype=torch.int32)
        >>> unread = {"confidence": zero, "flag": code, "trackability": zero, "hole": code}
        >>> samples = Samples(uv_0, depth, sigma=0.01 * depth, xyz=xyz, **unread)
        >>> cov = torch.eye(2).expand(1, 60, 2, 2)
        >>> tracks = Tracks(uv_0, uv_1, error=zero, photometric=zero, cov=cov, valid=zero == 0)
        >>> fit = map_pose(samples, tracks, camera, camera, torch.rand(1, 100, 3, generator=draw))
        >>> fit.T_1_from_0.R.shape, fit.cov.shape, fit.shutter.shutter_rate.shape
        (torch.Size([1, 3, 3]), torch.Size([1, 6, 6]), torch.Size([1, 3]))
        >>> off = fit.T_1_from_0.t - torch.tensor([0.2, 0.0, 0.0])
        >>> sigma = fit.cov.diagonal(dim1=1, dim2=2).sqrt()[:, 3:]  # m
        >>> bool((off.abs() < 0.01).all()), bool((off.abs() < 4 * sigma).all())
        (True, True)
    """
    first = start(samples, tracks, camera_0, camera_1, draws)
    options = FitOptions(
        far_weight=far_weight,
        max_rise=max_rise,
        shutter_sigma=shutter_sigma,
        shutter_gain=shutter_gain,
        translation_gain=translation_gain,
        kernel=kernel,
        bend=bend,
        near_steps=near_steps,
        steps=steps,
        blocks=None if blocks is None else (blocks[0], blocks[1]),
    )
    problem = run_without_grad(_pose_depth_problem, samples, tracks, camera_0, camera_1, isotropic)
    return chunked_apply(
        partial(run_without_grad, _fit_all, options, threshold_px), MAP_CHUNK_PAIRS, first, problem, tracks
    )


def _fit_all(o: FitOptions, threshold_px: float, first: PoseFit, problem: PoseDepthProblem, tracks: Tracks) -> PoseFit:
    eye = se3.identity(len(first.code), problem.f)
    solution = estimate_map_pose(problem.detach(), select_batch(first.ok, first.T_1_from_0.detach(), eye), o)
    # The last step, in float64 and with the graph on.
    problem = problem.to(torch.float64)
    solution = pytree.tree_map(lambda x: x.double() if x.is_floating_point() else x, solution)
    solution = solution._replace(at=solution.at._replace(T=Pose(se3.orthonormal(solution.at.T.R), solution.at.T.t)))
    normal = partial(
        reprojection_problem.pose_normal_equations,
        noise=solution.noise,
        far_weight=solution.far_weight,
        shutter_precision=solution.shutter_precision,
        kernel=o.kernel,
        bend=o.bend,
    )
    _, H, g = normal(problem, solution.at)
    xi, solved = solve_spd(H.detach(), -g.detach()[..., None])
    at = reprojection_problem.retract_unknowns(solution.at, xi[..., 0])
    fixed = problem.detach()
    if has_graph(g):
        at = reprojection_problem.retract_unknowns(
            at, implicit_step(lambda xi: normal(fixed, reprojection_problem.retract_unknowns(solution.at, xi)).g, g)
        )
    with torch.no_grad():
        cov, cov_ok = pose_covariance(problem, solution, o)
        finite = at.T.R.isfinite().flatten(1).all(1) & at.T.t.isfinite().all(1)
        code = torch.where(solution.far_weight < o.far_weight, PoseCode.KEPT_PNP, PoseCode.OK)
        code = torch.where(solution.translates, code, PoseCode.NO_BASELINE)
        code = torch.where(solved & cov_ok & finite, code, PoseCode.DEGENERATE)
        code = torch.where(first.ok, code, first.code).to(torch.int32)
        ok = (code == PoseCode.OK) | (code == PoseCode.KEPT_PNP)
        inlier, rms_px = _reprojection(problem, at, threshold_px)
        far_noise = torch.where(problem.far, solution.noise, 0.0).amax(-1)
        variance = torch.where(problem.far.any(-1), far_noise, solution.noise.amax(-1))
        t_snr = covariance.mahalanobis(at.T.t, cov[:, 3:6, 3:6])
    assert at.shutter_rate is not None  # estimate_map_pose returns one, zero where not accepted
    fit = PoseFit(
        T_1_from_0=at.T,
        cov=cov[:, :6, :6],
        inlier=inlier[:, : tracks.uv_1.shape[1]],
        n_inlier=torch.where(ok, inlier.sum(-1), first.n_inlier),
        rms_px=rms_px,
        sigma_px=variance.sqrt(),
        t_snr=t_snr,
        code=code,
        shutter=Shutter(at.shutter_rate, cov),
    )
    return fit.to(tracks.uv_1.dtype).without_pose(~ok, code)


def _pose_depth_problem(
    samples: Samples, tracks: Tracks, camera_0: Camera, camera_1: Camera, isotropic: float
) -> PoseDepthProblem:
    """Tracks of a pair as planes, N' > 0 a multiple of ``SUM_LANES``; unused ones hold safe finite values."""
    usable = tracks.valid & all_finite(tracks.uv_1, -1) & all_finite(tracks.uv_0, -1)
    xyz, sigma = samples.xyz, samples.sigma.detach()
    near = usable & samples.usable & (xyz[..., 2] > 0) & (sigma > 0) & sigma.isfinite()
    far = usable & ~samples.usable
    z = torch.where(near, xyz[..., 2], torch.ones_like(sigma))
    shape = covariance.noise_shape(tracks.cov.detach(), usable, isotropic)
    ray = cam.rays(cam.ideal(camera_0), torch.where(usable[..., None], tracks.uv_0, torch.zeros_like(tracks.uv_0)))
    ray = torch.where(near[..., None], torch.where(near[..., None], xyz, torch.ones_like(xyz)) / z[..., None], ray)
    spread = torch.where(near, sigma, torch.ones_like(sigma)) / (z * z).detach()
    uv = torch.where(usable[..., None], tracks.uv_1, torch.zeros_like(tracks.uv_1))
    N = usable.shape[1]
    padding = round_up(N, SUM_LANES) - N

    def plane(x: Tensor, value: float = 0.0) -> Tensor:
        x = x.transpose(1, 2).contiguous() if x.ndim == 3 else x  # operators read contiguous planes
        return torch.nn.functional.pad(x, (0, padding), value=value)

    shape = torch.stack(upper_triangle(shape), 1)
    one = torch.eye(1, dtype=shape.dtype, device=shape.device).expand(1, padding)
    ends = torch.cat((one, 0 * one, one)).expand(len(shape), 3, padding)
    return PoseDepthProblem(
        f=camera_1.f,
        c=camera_1.c,
        ray=plane(ray, 1.0),
        uv=plane(uv),
        inverse=plane(1 / z, 1.0),
        variance=plane(spread * spread, 1.0),
        shape=torch.cat((shape, ends), -1),
        near=torch.nn.functional.pad(near, (0, padding)),
        far=torch.nn.functional.pad(far, (0, padding)),
    )


def _reprojection(
    problem: PoseDepthProblem, at: reprojection_problem.Unknowns, threshold_px: float
) -> tuple[Tensor, Tensor]:
    """Near tracks (B, N) whose sensor point projects within ``threshold_px`` of the measured one; their rms px (B,)."""
    uv = problem.uv
    if at.shutter_rate is not None:
        uv = reprojection_problem.undo_rolling_shutter(uv, problem.f, problem.c, problem.ray[:, 1], at.shutter_rate)
    r, depth = reprojection_residuals(at.T, problem.f, problem.c, problem.ray / problem.inverse[:, None], uv)
    square = (r * r).sum(1)
    inlier = problem.near & (depth > MIN_DEPTH) & (square < threshold_px**2)
    return inlier, (torch.where(inlier, square, 0.0).sum(-1) / inlier.sum(-1).clamp_min(1)).sqrt()
