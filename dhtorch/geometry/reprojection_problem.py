"""Least-squares problem of a pair's pose: near tracks with sensor depth and far tracks without → normal equations.

Alphabet: view 0 is the reference view; ``x`` its viewing ray with z = 1 and ``q`` the inverse depth along it (1/m), so
that the point in camera 1 is R x + q t, up to scale, and q = 0 is a point at infinity. ``r`` = projected − measured
(px), ``S`` its covariance, ``s`` = d r / d q. Every track has its own q, which is eliminated from the problem (a Schur
complement of one number): with a sensor variance v of q, r has the covariance S + v s sᵀ; a far track has v = ∞ and
keeps only the part of r across its epipolar line. Both kinds become two whitened rows per track.

Unknowns of a pair: the pose T (left perturbation) and the *shutter rate* b (rad per unit of height): a camera that
reads row by row while it moves takes each row from another pose, which for short exposures is mainly an additional
rotation y · b, y being the height of x in the reference view. A shutter rate of zero is a global shutter.

Source: bundle adjustment with one free camera (B. Triggs et al., "Bundle adjustment: a modern synthesis", 2000);
tracks with and without depth in one problem: J. Zhang, M. Kaess, S. Singh, "Real-time depth enhanced monocular
odometry", 2014, and P. Proença, Y. Gao, "SPLODE", 2018; rows with a motion of their own: J. Hedborg et al., "Rolling
shutter bundle adjustment", 2012.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.checks import any_possible, constant, shaped
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.determinism import SUM_LANES
from dhtorch.geometry.least_squares import (
    INITIAL_DAMPING,
    MIN_DEPTH,
    NormalEquations,
    minimise,
    move_pose,
    normal_equations,
    robust_loss,
)
from dhtorch.geometry.linalg import rotate_planes
from dhtorch.geometry.se3 import Pose, hat
from dhtorch.ops.dispatch import operator, run_kernel
from dhtorch.pytree import Record, record

#: Limits how much closer than the nearest near return a far track may be: factor on inverse depth, without unit.
NEAREST_DEPTH_DIVISOR = 2.0

#: Squared residual of a point behind a camera, in variances: far beyond the bend of every robust kernel.
BEHIND_CAMERA_RESIDUAL = 1e4

#: Least estimated standard deviation of a residual coordinate, px.
MIN_NOISE_PX = 0.1

#: Largest estimated standard deviation of a residual coordinate, px.
MAX_NOISE_PX = 5.0

#: Median of |r| / sigma for normal noise in two coordinates, without unit.
#: Source: derived, sqrt(2 ln 2), the median of a Rayleigh distribution.
MEDIAN_2D = 1.17741

#: Median of |r| / sigma for normal noise in one coordinate, without unit.
#: Source: derived, the upper quartile of the standard normal distribution.
MEDIAN_1D = 0.67449


@record
class PoseDepthProblem(Record):
    """Tracks of B pairs as planes, N a multiple of ``SUM_LANES``; unused tracks hold any finite values."""

    f: Tensor  # (B, 2) px, camera 1
    c: Tensor  # (B, 2) px, camera 1
    ray: Tensor  # (B, 3, N) x in camera 0
    uv: Tensor  # (B, 2, N) ideal px, measured in camera 1
    inverse: Tensor  # (B, N) 1/m, the sensor's q; not read for far tracks
    variance: Tensor  # (B, N) 1/m², of the sensor's q
    shape: Tensor  # (B, 3, N) the noise's covariance in view 1 up to scale: xx, xy, yy
    near: Tensor  # (B, N) bool
    far: Tensor  # (B, N) bool


class Unknowns(NamedTuple):
    """The unknowns of a pair: pose and shutter rate."""

    T: Pose
    shutter_rate: Tensor | None  # (B, 3) rad per unit of y; None: not estimated


def retract_unknowns(at: Unknowns, xi: Tensor) -> Unknowns:
    """The unknowns displaced by xi (B, 9): tangent vector of the pose, shutter rate; (B, 6) without a shutter rate.

    Gradient: to both.
    """
    return Unknowns(move_pose(at.T, xi[:, :6]), None if at.shutter_rate is None else at.shutter_rate + xi[:, 6:])


@shaped("uv: B 2 N, f: B 2, c: B 2, y: B N, shutter_rate: B 3")
def undo_rolling_shutter(
    uv: Tensor,  # (B, 2, N) ideal px of camera 1, planes
    f: Tensor,  # (B, 2) px
    c: Tensor,  # (B, 2) px
    y: Tensor,  # (B, N) height of the reference view's ray
    shutter_rate: Tensor,  # (B, 3) rad per unit of y
) -> Tensor:
    """Pixels (B, 2, N) with the rolling shutter undone: each ray is rotated back by y · shutter rate.

    Gradient: to all. Raises ValueError for wrong shapes.
    """
    f, c = f[..., None], c[..., None]
    return _straighten((uv - c) / f, y, shutter_rate) * f + c


def _straighten(seen: Tensor, y: Tensor, shutter_rate: Tensor) -> Tensor:
    """:func:`undo_rolling_shutter` at z = 1: (u, v, 1) − y · shutter rate × (u, v, 1), divided by its z."""
    ray = torch.cat((seen, torch.ones_like(seen[:, :1])), 1)
    ray = ray - y[:, None] * rotate_planes(hat(shutter_rate), ray)
    z = ray[:, 2:]
    return ray[:, :2] / torch.where(z.abs() < 0.1, 0.1, z)  # beyond any shutter rate: stays finite


class TrackConstants(NamedTuple):
    """Quantities of a problem's tracks at z = 1 that do not depend on the pose."""

    seen: Tensor  # (B, 2, N) measured in camera 1
    shape: Tensor  # (B, 3, N) the noise's covariance there, up to scale: xx, xy, yy
    height: Tensor  # (B, N) of the ray in camera 0
    nearest: Tensor  # (B, 1) 1/m, largest q of the near tracks
    variance: Tensor  # (B, N) 1/m², of the sensor's q; 0 for tracks without one


def track_constants(problem: PoseDepthProblem) -> TrackConstants:
    """Constants of a problem's tracks, shared by several linearisations. Gradient: as :func:`linearise_tracks`."""
    f0, f1 = problem.f[:, :1], problem.f[:, 1:]
    return TrackConstants(
        seen=(problem.uv - problem.c[..., None]) / problem.f[..., None],
        shape=problem.shape / torch.cat((f0 * f0, f0 * f1, f1 * f1), 1)[..., None],
        height=problem.ray[:, 1] / problem.ray[:, 2],
        nearest=torch.where(problem.near, problem.inverse, 0.0).amax(-1, keepdim=True).detach(),
        variance=torch.where(problem.near, problem.variance, 0.0),
    )


class _LinearisedTracks(NamedTuple):
    """The tracks of a problem linearised at z = 1: two equations each, inverse depths not yet eliminated."""

    u: Tensor  # (B, 7, N), along u: six columns of the pose, then the residual; or (B, 1, N), the residual alone
    v: Tensor  # (B, 7, N) or (B, 1, N), along v
    slope: Tensor  # (B, 2, N) m, d r / d q
    free: Tensor  # (B, N) bool, q is fixed neither by the sensor nor at infinity: its prior variance is infinite
    front: Tensor  # (B, N) bool, in front of camera 1 and not at the epipole; others are finite and meaningless
    fixed: TrackConstants


@shaped("problem.ray: B 3 N, problem.uv: B 2 N, at.shutter_rate: B 3")
def linearise_tracks(
    problem: PoseDepthProblem, at: Unknowns, *, columns: bool = True, known: TrackConstants | None = None
) -> _LinearisedTracks:
    """Residuals and Jacobian of a problem at the sensor's inverse depths, and at the most probable ones of far tracks.

    Without ``columns`` the residuals alone, the same bits: enough for :func:`squared_residuals`. ``known`` is
    :func:`track_constants` of the problem where already computed.

    Gradient: to measurements, cameras, rays and the sensor's q; the far tracks' q is fixed at its optimum, where it has
    no first-order effect. Raises ValueError for wrong shapes.
    """
    known = track_constants(problem) if known is None else known
    seen = known.seen if at.shutter_rate is None else _straighten(known.seen, known.height, at.shutter_rate)
    t = at.T.t[..., None]
    # The ray in camera 1 and its epipolar line, in one product.
    a, line = rotate_planes(torch.cat((at.T.R, torch.linalg.cross(t, at.T.R, dim=1)), 1), problem.ray).chunk(2, 1)
    with torch.no_grad():
        best = _inverse_depth(a, t, line, seen, known.shape)
        # A point cannot lie beyond infinity: q is then fixed at 0 and not eliminated.
        free = ~(problem.near | (best < 0))
    q = torch.where(problem.near, problem.inverse, best.clamp_min(0))
    Y = a + q[:, None] * t
    # At the epipole a track fits any pose if its point is near enough, and then constrains it far too strongly.
    front = (Y[:, 2] > MIN_DEPTH) & (problem.near | (q < NEAREST_DEPTH_DIVISOR * known.nearest))
    w = Y[:, 2].masked_fill(~front, 1.0).reciprocal()
    plane = Y[:, :2] * w[:, None]
    slope = (t[:, :2] - plane * t[:, 2:]) * w[:, None]
    if not columns:
        r = plane - seen
        return _LinearisedTracks(r[:, :1], r[:, 1:], slope, free, front, known)
    k = q * w
    (x, y) = plane.unbind(1)
    (x_r, y_r) = (plane - seen).unbind(1)
    (xx, yy) = (1 + plane * plane).unbind(1)
    (xk, yk) = (plane * -k[:, None]).unbind(1)
    xy, zero = x * y, torch.zeros_like(x)
    u, v = torch.stack((-xy, xx, -y, k, zero, xk, x_r), 1), torch.stack((-yy, xy, x, zero, k, yk, y_r), 1)
    return _LinearisedTracks(u, v, slope, free, front, known)


def whitened_residuals(
    linear: _LinearisedTracks, factors: tuple[Tensor, Tensor, Tensor], shutter_rate: bool = True
) -> Tensor:
    """Whitened rows (B, 10, 2, N) without inverse depths: six columns of the pose, three of the shutter, the residual.

    Args:
        linear: :func:`linearise_tracks` of the tracks.
        factors: :func:`noise_factors` of their noise.
        shutter_rate: whether the shutter rate has columns; (B, 7, 2, N) without.

    Gradient: to ``linear`` and the noise.
    """
    m0, m1 = (m[:, None] for m in _whitener(linear, factors))
    rows = m0 * linear.u[:, :, None] + m1 * linear.v[:, :, None]
    if not shutter_rate:
        return rows
    return torch.cat((rows[:, :6], rows[:, :3] * linear.fixed.height[:, None, None], rows[:, 6:]), 1)


def squared_residuals(linear: _LinearisedTracks, factors: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Squared length (B, N) of the whitened residuals; :data:`BEHIND_CAMERA_RESIDUAL` for points behind camera 1.

    Gradient: as :func:`whitened_residuals`.
    """
    m0, m1 = _whitener(linear, factors)
    return _square(linear, m0 * linear.u[:, -1:] + m1 * linear.v[:, -1:])


def squared_residuals_at(
    problem: PoseDepthProblem, at: Unknowns, known: TrackConstants
) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """:func:`squared_residuals` at fixed unknowns as a function of noise (B, N) px², with the tracks in front (B, N).

    ``known`` is :func:`track_constants` of the problem.

    Gradient: as :func:`whitened_residuals`.
    """

    linearised: _LinearisedTracks | None = None

    def linear() -> _LinearisedTracks:  # no functools.cache, which torch.compile cannot build within a graph
        nonlocal linearised
        linearised = linearise_tracks(problem, at, columns=False, known=known) if linearised is None else linearised
        return linearised

    return lambda noise: _squares(*_track_tensors(problem, known, noise_factors(known, noise), at), linear=linear)


#: Dtypes of the kernels' inputs, in the order of :func:`_track_tensors`.
_TRACK_DTYPES = {
    name: torch.bool if name == "near" else torch.float32
    for name in (
        *("ray", "inverse", "near"),
        *("seen", "shape", "height", "nearest", "variance"),
        *("a", "b", "d"),
        *("R", "t", "shutter_rate"),
    )
}

#: The same of the noise's: which tracks are far in place of its factors.
_NOISE_DTYPES = {
    name: torch.bool if name in ("near", "far") else torch.float32
    for name in (
        *("ray", "inverse", "near"),
        *("seen", "shape", "height", "nearest", "variance"),
        "far",
        *("R", "t", "shutter_rate"),
    )
}


def _track_tensors(
    problem: PoseDepthProblem, constants: TrackConstants, factors: tuple[Tensor, Tensor, Tensor], at: Unknowns
) -> tuple[Tensor | None, ...]:
    """Tracks and unknowns as the argument tuple of the operators below."""
    return problem.ray, problem.inverse, problem.near, *constants, *factors, at.T.R, at.T.t, at.shutter_rate


def _kernel_arguments(*tensors: Any) -> tuple[Tensor, ...]:
    """The same tuple for a C++ operator: a shutter rate of shape (0, 3) where there is none."""
    *tracks, t, shutter_rate = tensors
    return *tracks, t, t.new_empty(0, 3) if shutter_rate is None else shutter_rate


def _depth_limits() -> tuple[float, float, float]:
    return NEAREST_DEPTH_DIVISOR, BEHIND_CAMERA_RESIDUAL, MIN_DEPTH


#: Dtypes of numbers in kernels in single and in double precision.
_FLOATS = torch.float32, torch.float64

#: :data:`_TRACK_DTYPES` of such kernels.
_ANY_PRECISION = {name: dtype if dtype == torch.bool else _FLOATS for name, dtype in _TRACK_DTYPES.items()}


def _has_whole_lanes(ray: Tensor, *_: Tensor | None, **__: Any) -> bool:
    """Whether the number of tracks is a multiple of the kernel's vector width."""
    return ray.shape[-1] % SUM_LANES == 0


@operator(
    kernel=lambda ray, inverse, near, *others, linear: run_kernel(
        "squared_residuals",
        _kernel_arguments(ray, inverse, near, *others),
        (torch.empty_like(inverse), torch.empty_like(near)),
        *_depth_limits(),
    ),
    dtypes=_TRACK_DTYPES,
    any_layout=("R", "t", "shutter_rate"),
    when=_has_whole_lanes,
)
def _squares(*tensors: Any, linear: Callable[[], _LinearisedTracks]) -> tuple[Tensor, Tensor]:
    """Squared whitened residuals (B, N) of :func:`_track_tensors` linearised as ``linear``, and tracks in front."""
    tracks, (a, b, d) = linear(), tensors[8:11]
    return squared_residuals(tracks, (a, b, d)), tracks.front


@torch.no_grad()
def estimate_noise_variance(
    problem: PoseDepthProblem, at: Unknowns, rounds: int = 3, known: TrackConstants | None = None
) -> Tensor:
    """Variance (B, N) px² of a residual coordinate from medians; one for the near, one for the far tracks of a pair.

    Medians do not contain the scale that the sensor's noise adds to a near residual; so the estimate is repeated with
    the previous one, the first from unit noise. ``known`` is :func:`track_constants` of the problem where already
    computed.

    Gradient: none. Raises ValueError for wrong shapes.
    """
    c = track_constants(problem) if known is None else known
    tensors = problem.ray, problem.inverse, problem.near, *c, problem.far, at.T.R, at.T.t, at.shutter_rate
    return _noise(*tensors, tracks=(problem, at, c), rounds=rounds)


@operator(
    kernel=lambda ray, inverse, *others, tracks, rounds: run_kernel(
        "track_noise",
        _kernel_arguments(ray, inverse, *others),
        torch.empty_like(inverse),
        *(rounds, MEDIAN_2D, MEDIAN_1D, MIN_NOISE_PX**2, MAX_NOISE_PX**2),
        *_depth_limits(),
    ),
    dtypes=_NOISE_DTYPES,
    any_layout=("R", "t", "shutter_rate"),
    when=_has_whole_lanes,
)
def _noise(*tensors: Any, tracks: tuple[PoseDepthProblem, Unknowns, TrackConstants], rounds: int) -> Tensor:
    """:func:`estimate_noise_variance` of tracks and unknowns."""
    problem, at, known = tracks
    noise, square_of = torch.ones_like(problem.inverse), squared_residuals_at(problem, at, known)
    for _ in range(rounds):
        square, front = square_of(noise)
        size = square.sqrt()
        near = masked_median(size, problem.near & front) / MEDIAN_2D
        far = masked_median(size, problem.far & front) / MEDIAN_1D
        far = torch.where(problem.far.any(-1, keepdim=True), far, near)
        factor = torch.where(problem.far, far, near)
        noise = (noise * factor * factor).clamp(MIN_NOISE_PX**2, MAX_NOISE_PX**2)
    return noise


def pose_normal_equations(
    problem: PoseDepthProblem,
    at: Unknowns,
    noise: Tensor,  # (B, N) px²
    far_weight: Tensor,  # (B,)
    shutter_precision: Tensor,  # (B,) 1/rad²
    *,
    kernel: str | None,
    bend: float,
) -> NormalEquations:
    """Cost and normal equations (n = 9): near tracks weigh 1, far tracks ``far_weight``, shutter rate prior at zero.

    Args:
        problem, at, noise: as in :func:`linearise_tracks` and :func:`whitened_residuals`. Without a shutter rate n = 6.
        far_weight: of a far track's robust cost; 0 leaves far tracks out.
        shutter_precision: of the shutter rate's prior at zero; a huge one fixes it there.
        kernel, bend: robust kernel of a whitened residual and where it bends, see ``least_squares.robust_loss``.

    Gradient: as :func:`whitened_residuals`. Raises ValueError for wrong shapes or an unknown kernel.
    """
    return pose_normal_equations_at(problem, noise, far_weight, shutter_precision, kernel=kernel, bend=bend)[0](at)


def _fixed_tensors(
    problem: PoseDepthProblem, noise: Tensor, far_weight: Tensor, known: TrackConstants | None = None
) -> tuple[TrackConstants, tuple[Tensor, Tensor, Tensor], Tensor]:
    """What the cost of tracks contains beside the unknowns."""
    constants = track_constants(problem) if known is None else known
    share = torch.where(problem.near, 1.0, torch.where(problem.far, far_weight[:, None], 0.0))
    return constants, noise_factors(constants, noise), share


def pose_normal_equations_at(
    problem: PoseDepthProblem,
    noise: Tensor,  # (B, N) px²
    far_weight: Tensor,  # (B,)
    shutter_precision: Tensor,  # (B,) 1/rad²
    *,
    kernel: str | None,
    bend: float,
    fixed: tuple[TrackConstants, tuple[Tensor, Tensor, Tensor], Tensor] | None = None,
) -> tuple[Callable[[Unknowns], NormalEquations], Callable[[Unknowns], Tensor]]:
    """:func:`pose_normal_equations` as a function of the unknowns, and its cost (B,) alone with the same bits.

    ``fixed`` is what :func:`_fixed_tensors` computes, if it is known.

    Gradient: as :func:`whitened_residuals`.
    """
    constants, factors, share = _fixed_tensors(problem, noise, far_weight) if fixed is None else fixed

    def total_cost(cost: Tensor, shutter_rate: Tensor | None) -> Tensor:
        return cost if shutter_rate is None else cost + shutter_precision * (shutter_rate * shutter_rate).sum(-1)

    def with_prior(cost: Tensor, H: Tensor, g: Tensor, shutter_rate: Tensor | None) -> NormalEquations:
        if shutter_rate is None:
            return NormalEquations(cost, H, g)
        precision = shutter_prior(shutter_precision.to(g.dtype))
        deviation = torch.cat((torch.zeros_like(g[:, :6]), shutter_rate), -1)
        return NormalEquations(
            total_cost(cost, shutter_rate), H + torch.diag_embed(precision), g + precision * deviation
        )

    robust = kernel, bend

    def normal(at: Unknowns) -> NormalEquations:
        linear = partial(linearise_tracks, problem, at, known=constants)
        tensors = _track_tensors(problem, constants, factors, at)
        return with_prior(*_equations(*tensors, share, linear=linear, robust=robust), at.shutter_rate)

    def cost(at: Unknowns) -> Tensor:
        linear = partial(linearise_tracks, problem, at, columns=False, known=constants)
        tensors = _track_tensors(problem, constants, factors, at)
        return total_cost(_robust_cost(*tensors, share, linear=linear, robust=robust), at.shutter_rate)

    return normal, cost


def minimise_tracks(
    problem: PoseDepthProblem,
    at: Unknowns,
    noise: Tensor,  # (B, N) px²
    far_weight: Tensor,  # (B,)
    shutter_precision: Tensor,  # (B,) 1/rad²
    *,
    kernel: str | None,
    bend: float,
    steps: int,
    rotation_only: bool = False,
    known: TrackConstants | None = None,
) -> tuple[Unknowns, Tensor]:
    """Unknowns after ``steps`` of Levenberg–Marquardt on :func:`pose_normal_equations` from ``at``, and their cost.

    With ``rotation_only`` the translation stays as it is. ``known`` is as in :func:`linearise_tracks`; arguments
    otherwise as of :func:`pose_normal_equations`.

    Gradient: none. Raises ValueError for wrong shapes or an unknown kernel.
    """
    constants, factors, share = fixed = _fixed_tensors(problem, noise, far_weight, known)
    weights = problem, noise, far_weight, shutter_precision
    cost_of = partial(pose_normal_equations_at, *weights, kernel=kernel, bend=bend, fixed=fixed)
    tensors = _track_tensors(problem, constants, factors, at)
    options = (steps, rotation_only)
    return _minimum(*tensors, share, shutter_precision, cost_of=cost_of, at=at, robust=(kernel, bend), options=options)


def _is_geman_mcclure(*tensors: Any, robust: tuple[str | None, float], **_: Any) -> bool:
    """Whether the compiled kernels implement the robust kernel, divide the number of tracks and fit the precision."""
    is_one_precision = len({x.dtype for x in tensors if x is not None} - {torch.bool}) == 1
    return robust[0] == "geman_mcclure" and is_one_precision and _has_whole_lanes(tensors[0])


def _minimum_kernel(
    *tensors: Any,
    cost_of: Callable[..., Any],
    at: Unknowns,
    robust: tuple[str | None, float],
    options: tuple[int, bool],
) -> tuple[Unknowns, Tensor]:
    *tracks, share, precision = tensors
    kernel_args = [x.contiguous() for x in _kernel_arguments(*tracks)]
    best = [torch.empty_like(x) for x in kernel_args[-3:]]
    cost = share.new_empty(len(share))
    (steps, rotation_only), (_, bend) = options, robust
    torch.ops.dhtorch.minimise_tracks.default(
        *kernel_args,
        share,
        precision,
        *best,
        cost=cost,
        steps=steps,
        damping=INITIAL_DAMPING,
        rotation_only=rotation_only,
        bend=bend,
        nearest_divisor=NEAREST_DEPTH_DIVISOR,
        behind=BEHIND_CAMERA_RESIDUAL,
        min_depth=MIN_DEPTH,
    )
    return Unknowns(Pose(best[0], best[1]), None if tracks[-1] is None else best[2]), cost


@operator(
    kernel=_minimum_kernel,
    dtypes=_TRACK_DTYPES | {"share": torch.float32, "shutter_precision": torch.float32},
    any_layout=("R", "t", "shutter_rate"),
    when=_is_geman_mcclure,
)
def _minimum(
    *tensors: Any,
    cost_of: Callable[..., Any],
    at: Unknowns,
    robust: tuple[str | None, float],
    options: tuple[int, bool],
) -> tuple[Unknowns, Tensor]:
    """:func:`minimise_tracks` of :func:`_track_tensors`, their weight ``share`` (B, N) and the prior's precision."""
    (normal, cost), (steps, rotation_only) = cost_of(), options

    def evaluate_rotation(at: Unknowns) -> NormalEquations:
        value, H, g = normal(at)
        free = constant(g, ([1.0] * 3 + [0.0] * 3 + [1.0] * 3)[: g.shape[-1]])
        return NormalEquations(value, H * free * free[:, None] + torch.diag(1 - free), g * free)

    return minimise(evaluate_rotation if rotation_only else normal, at, steps, cost=cost, move=retract_unknowns)


def _sum_tracks(*tensors: Any, bend: float, with_equations: bool) -> NormalEquations:
    *tracks, share = tensors
    B, n = (len(share) if with_equations else 0), (6 if tracks[-1] is None else 9)
    sums = NormalEquations(share.new_empty(len(share)), share.new_empty(B, n, n), share.new_empty(B, n))
    return run_kernel("pose_normal_equations", (*_kernel_arguments(*tracks), share), sums, bend, *_depth_limits())


@operator(
    kernel=lambda *tensors, linear, robust: _sum_tracks(*tensors, bend=robust[1], with_equations=True),
    dtypes=_ANY_PRECISION | {"share": _FLOATS},
    any_layout=("R", "t", "shutter_rate"),
    when=_is_geman_mcclure,
)
def _equations(
    *tensors: Any, linear: Callable[[], _LinearisedTracks], robust: tuple[str | None, float]
) -> NormalEquations:
    """Cost, H and g of :func:`_track_tensors` with the weight ``share`` (B, N) of each track, before any prior."""
    tracks, (a, b, d), shutter_rate, share = linear(), tensors[8:11], tensors[-2], tensors[-1]
    rows = whitened_residuals(tracks, (a, b, d), shutter_rate is not None)
    rho, weight = robust_loss(_square(tracks, rows[:, -1]), *robust)
    H, g = normal_equations(rows, torch.where(tracks.front, weight * share, 0.0), block=SUM_LANES)
    return NormalEquations((rho * share).sum(-1), H, g)


@operator(
    kernel=lambda *tensors, linear, robust: _sum_tracks(*tensors, bend=robust[1], with_equations=False).cost,
    dtypes=_ANY_PRECISION | {"share": _FLOATS},
    any_layout=("R", "t", "shutter_rate"),
    when=_is_geman_mcclure,
)
def _robust_cost(*tensors: Any, linear: Callable[[], _LinearisedTracks], robust: tuple[str | None, float]) -> Tensor:
    """The cost (B,) of :func:`_equations` alone."""
    square = squared_residuals(linear(), tensors[8:11])
    return (robust_loss(square, *robust)[0] * tensors[-1]).sum(-1)


def sandwich_sums(
    problem: PoseDepthProblem,
    at: Unknowns,
    noise: Tensor,  # (B, N) px²
    far_weight: Tensor,  # (B,)
    *,
    robust: tuple[str | None, float],
    reference: Callable[[], tuple[Tensor, Tensor]],
    limits: tuple[float, float, float],
) -> tuple[Tensor, Tensor]:
    """Bread and meat (B, 9, 9) of the sandwich of ``map_estimate.pose_covariance``, compiled where it can be.

    Args:
        problem, at, noise, far_weight: as in :func:`pose_normal_equations`, with a shutter rate.
        robust: name of the robust kernel and where it bends.
        reference: the same in torch.
        limits: least ratio of mean psi′ to mean w, degrees of freedom that the pose takes, least mean weight.

    Gradient: none. Raises ValueError for wrong shapes.
    """
    constants, factors, _ = _fixed_tensors(problem, noise, far_weight)
    tensors = _track_tensors(problem, constants, factors, at)
    return _sandwich(*tensors, problem.far, far_weight, reference=reference, robust=robust, limits=limits)


@operator(
    kernel=lambda *tensors, reference, robust, limits: run_kernel(
        "pose_sandwich",
        (*_kernel_arguments(*tensors[:-2]), *tensors[-2:]),
        tensors[-1].new_empty(2, len(tensors[-1]), 9, 9).unbind(),
        *(robust[1], *limits, *_depth_limits()),
    ),
    dtypes={name: torch.bool if dtype == torch.bool else torch.float64 for name, dtype in _TRACK_DTYPES.items()}
    | {"far": torch.bool, "far_weight": torch.float64},
    any_layout=("R", "t", "shutter_rate"),
    when=_is_geman_mcclure,
)
def _sandwich(
    *tensors: Any,
    reference: Callable[[], tuple[Tensor, Tensor]],
    robust: tuple[str | None, float],
    limits: tuple[float, float, float],
) -> tuple[Tensor, Tensor]:
    """:func:`sandwich_sums` of :func:`_track_tensors`, far tracks (B, N) and their weight (B,)."""
    return reference()


def _square(linear: _LinearisedTracks, r: Tensor) -> Tensor:
    """Squared length (B, N) of whitened residuals (B, 2, N)."""
    return torch.where(linear.front, (r * r).sum(1), BEHIND_CAMERA_RESIDUAL)


def shutter_prior(shutter_precision: Tensor) -> Tensor:
    """Diagonal (B, 9) of the prior's information matrix: zero for the pose, the precision for the shutter rate."""
    zero = torch.zeros_like(shutter_precision)
    return torch.stack((*[zero] * 6, *[shutter_precision] * 3), -1)


def _inverse_depth(a: Tensor, t: Tensor, line: Tensor, seen: Tensor, shape: Tensor) -> Tensor:
    """Maximum-likelihood q (B, N) of a track without depth: its pixel is moved onto the epipolar line along the noise.

    ``a`` (B, 3, N) is the reference view's ray rotated into camera 1, ``line`` = t × a. Negative where the rays
    diverge; 0 without baseline.
    """
    n, last = line[:, :2], line[:, 2]
    m = shape[:, :2] * n[:, :1] + shape[:, 1:] * n[:, 1:]
    lift = ((n * seen).sum(1) + last) / (n * m).sum(1).clamp_min(1e-30)
    seen = seen - lift[:, None] * m
    p, d = a[:, :2] - a[:, 2:] * seen, t[:, :2] - t[:, 2:] * seen
    return -(p * d).sum(1) / (d * d).sum(1).clamp_min(1e-24)


def noise_factors(constants: TrackConstants, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """a, b, d (B, N) of L⁻¹ = [[a, 0], [−b d, d]], which whitens the noise S = L Lᵀ of a track."""
    xx, xy, yy = (constants.shape * noise[:, None]).unbind(1)
    b = xy / xx
    return xx.rsqrt(), b, (yy - b * xy).rsqrt()


def _whitener(linear: _LinearisedTracks, factors: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The columns (B, 2, N) of a matrix M with MᵀM = (S + variance s sᵀ)⁻¹, singular where the variance is infinite.

    With S = L Lᵀ the whitened slope e = L⁻¹ s is a vector of the plane. Only the residual along it depends on q: its
    weight is multiplied by 1 / (1 + |e|² variance). M rotates e to the first axis and scales that axis.
    """
    a, b, d = factors
    s0, s1 = linear.slope.unbind(1)
    e0, e1 = a * s0, d * (s1 - b * s0)
    square = e0 * e0 + e1 * e1
    no_slope, free = square < 1e-12, linear.free
    if any_possible(no_slope):  # there the pixel does not depend on q, and any axis serves
        unit = square.masked_fill(no_slope, 1.0).rsqrt()
        e0, e1 = (e0 * unit).masked_fill(no_slope, 1.0), (e1 * unit).masked_fill(no_slope, 0.0)
        free = free & ~no_slope
    else:
        unit = square.rsqrt()
        e0, e1 = e0 * unit, e1 * unit
    scale = (1 + square * linear.fixed.variance).rsqrt().masked_fill(free, 0.0)
    scale0, scale1, bd = scale * e0, scale * e1, b * d
    return (
        torch.stack((scale0 * a - scale1 * bd, -e1 * a - e0 * bd), 1),
        torch.stack((scale1 * d, e0 * d), 1),
    )
