"""Most probable pose of near and far tracks with its covariance: noise scale, accepted parameters, sandwich estimate.

Alphabet: that of :mod:`dhtorch.geometry.reprojection_problem`; ``noise`` (B, N) px² is the scale of each track's noise;
``psi`` = w r a residual after its robust weight w, in standard deviations.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.checks import all_known, is_static
from dhtorch.geometry.determinism import SUM_LANES, round_up
from dhtorch.geometry.least_squares import (
    normal_equations,
    robust_loss,
    robust_weight_slope,
    select_batch,
    solve_spd,
)
from dhtorch.geometry.linalg import small_matmul
from dhtorch.geometry.reprojection_problem import (
    MIN_NOISE_PX,
    PoseDepthProblem,
    TrackConstants,
    Unknowns,
    estimate_noise_variance,
    linearise_tracks,
    minimise_tracks,
    noise_factors,
    sandwich_sums,
    shutter_prior,
    squared_residuals,
    squared_residuals_at,
    track_constants,
    whitened_residuals,
)
from dhtorch.geometry.se3 import Pose

#: Precision (1/rad²) of the prior that fixes a shutter rate at zero.
GLOBAL_SHUTTER_PRECISION = 1e18

#: Degrees of freedom that a pose takes from its residuals, a count.
#: Source: derived, 3 of rotation + 3 of translation.
N_POSE_PARAMETERS = 6

#: Least ratio of mean psi′ to mean w, without unit: residuals all beyond the bend would make it negative.
MIN_PSI_SLOPE = 0.1

#: Limits a mean weight that is divided by from below, without unit.
MIN_WEIGHT_DIVISOR = 1e-9

#: Limits cost differences that count as none, in variances of a residual.
COST_SLACK = 1.0


@dataclass(frozen=True)
class FitOptions:
    """Options of one pose estimate and the only place of their defaults; see ``stages.pose.map_pose``."""

    #: Weight of a far track's robust cost, in [0, 1] and without unit; a near track's is 1. Not an inverse variance,
    #: because neighbouring tracks share their errors.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    far_weight: float = 0.1

    #: Limits the relative rise of the near tracks' cost when far tracks are included, a fraction without unit.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    max_rise: float = 0.1

    #: Limits the shutter rate: standard deviation of its prior around zero, rad per unit of height of a ray with z = 1;
    #: 0 is a global shutter.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    shutter_sigma: float = 0.01

    #: Fraction of the cost, without unit, that a shutter rate must take away to be accepted.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    shutter_gain: float = 0.02

    #: Fraction of the cost of the best pure rotation, without unit, that a translation must take away to be accepted.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    translation_gain: float = 0.55

    #: Robust kernel of a whitened residual: None, ``"huber"``, ``"cauchy"`` or ``"geman_mcclure"``.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    kernel: str | None = "geman_mcclure"

    #: Limits the influence of a residual: where the kernel bends, in standard deviations.
    #: Source: chosen on shared_scenes and the built-in rooms, docs/methods.md.
    bend: float = 2.0

    #: Limits the Levenberg–Marquardt steps of the estimate from near tracks, a count.
    near_steps: int = 4

    #: Limits the Levenberg–Marquardt steps of each estimate from all tracks, a count.
    steps: int = 6

    #: Blocks of near tracks (across, down) from whose scatter the covariance is enlarged, a count; None = not at all.
    #: Source: docs/uncertainty.md, "What was tried".
    blocks: tuple[int, int] | None = None


class MapSolution(NamedTuple):
    """The unknowns at the optimum, and the noise and weights of the cost that they minimise."""

    at: Unknowns  # with a shutter rate, zero where none was accepted
    noise: Tensor  # (B, N) px²
    far_weight: Tensor  # (B,) 0 where far tracks were not accepted
    shutter_precision: Tensor  # (B,) 1/rad²
    translates: Tensor  # (B,) bool, a pure rotation does not explain the tracks


@torch.no_grad()
def estimate_map_pose(problem: PoseDepthProblem, start: Pose, o: FitOptions) -> MapSolution:
    """Most probable unknowns of a problem from a start pose: near tracks first, then all, then all with a shutter rate.

    *Far tracks* are accepted unless they raise the near tracks' robust cost by more than ``max_rise``. A *shutter rate*
    is accepted where it lowers the whole cost by more than the fraction ``shutter_gain``, a *translation* where it
    lowers the cost of the best pure rotation by more than ``translation_gain``. More parameters always fit better; how
    much better without need depends on systematic errors, which no number of tracks averages out: hence fractions.
    Distant returns move little and gain little: their number dilutes the fraction. So a translation is also accepted
    where the nearest fraction of the near tracks shows it, the others weighing as if they had no return.

    Raises:
        ValueError: wrong shapes, an unknown kernel.

    Cost: ``near_steps`` + 3.5 ``steps`` evaluations of the used tracks. Only their number depends on values.
    """
    full_problem, (problem, near_problem) = problem, _compact_problems(problem)
    known, near_known = track_constants(problem), track_constants(near_problem)
    at = Unknowns(start, None)
    zero_rate = torch.zeros_like(start.t)
    no_far, far, rigid = (torch.full_like(start.t[:, 0], x) for x in (0.0, o.far_weight, GLOBAL_SHUTTER_PRECISION))
    solve = partial(minimise_tracks, problem, kernel=o.kernel, bend=o.bend, known=known)
    noise_at = partial(estimate_noise_variance, problem, known=known)

    near, half = at, o.near_steps // 2
    for steps in (half, o.near_steps - half):
        noise = estimate_noise_variance(near_problem, near, known=near_known)
        robust: dict[str, Any] = {"kernel": o.kernel, "bend": o.bend, "known": near_known}
        near, _ = minimise_tracks(near_problem, near, noise, no_far, rigid, steps=steps, **robust)
    both, _ = solve(near, noise_at(near), far, rigid, steps=o.steps)
    noise, precision = noise_at(both), rigid
    if o.shutter_sigma > 0:
        both, rigid_cost = solve(both, noise, far, rigid, steps=o.steps // 2)
        both = both._replace(shutter_rate=zero_rate)
        prior = torch.full_like(rigid, o.shutter_sigma**-2)
        rolling, shutter_cost = solve(both, noise, far, prior, steps=o.steps)
        has_shutter = rigid_cost - shutter_cost > o.shutter_gain * rigid_cost + COST_SLACK
        both, precision = select_batch(has_shutter, rolling, both), torch.where(has_shutter, prior, rigid)
    near = near._replace(shutter_rate=zero_rate)
    both = both if o.shutter_sigma > 0 else both._replace(shutter_rate=zero_rate)
    near_noise = noise[:, : near_problem.near.shape[1]]
    cost_near, cost_both = (
        torch.where(near_problem.near, _costs(near_problem, x, near_noise, o, near_known), 0.0).sum(-1)
        for x in (near, both)
    )
    accept_far = cost_both <= cost_near * (1 + o.max_rise) + COST_SLACK
    at, precision = select_batch(accept_far, both, near), torch.where(accept_far, precision, rigid)
    far = torch.where(accept_far, far, no_far)
    noise = noise_at(at)
    translates = _translates(problem, at, noise, far, precision, o=o, known=known)
    of_near, of_far = (torch.where(kind, noise, 0.0).amax(-1, keepdim=True) for kind in (~problem.far, problem.far))
    noise = torch.where(full_problem.far, of_far, of_near.clamp_min(MIN_NOISE_PX**2))
    return MapSolution(at, noise, far, precision, translates)


def _compact_problems(problem: PoseDepthProblem) -> tuple[PoseDepthProblem, PoseDepthProblem]:
    """Problems of the used tracks and of the near tracks, as wide as the pair with most tracks; near tracks first."""
    if is_static(problem.near):
        return problem, problem
    used = problem.near | problem.far
    order = (used.to(torch.uint8) + problem.near.to(torch.uint8)).argsort(dim=1, descending=True, stable=True)

    def compact(kept: Tensor) -> PoseDepthProblem:
        width = int(kept.sum(1).max())
        index = order[:, : round_up(width, SUM_LANES)]

        def pick(x: Tensor) -> Tensor:
            return x.gather(-1, index.view(len(x), *[1] * (x.ndim - 2), -1).expand(*x.shape[:-1], -1))

        planes = {k: pick(getattr(problem, k)) for k in ("ray", "uv", "inverse", "variance", "shape", "near", "far")}
        return problem.replace(**planes)

    return compact(used), compact(problem.near)


def _translates(
    problem: PoseDepthProblem,
    at: Unknowns,
    noise: Tensor,
    far: Tensor,
    precision: Tensor,
    *,
    o: FitOptions,
    known: TrackConstants,
) -> Tensor:
    """Whether (B,) the cost is far below that of the best rotation without translation, under the same noise."""
    solve = partial(minimise_tracks, problem, kernel=o.kernel, bend=o.bend, rotation_only=True, known=known)
    of_tracks = noise, far, precision
    without_t = Unknowns(Pose(at.T.R, torch.zeros_like(at.T.t)), at.shutter_rate)
    rotation_only, rotation_cost = solve(without_t, *of_tracks, steps=o.steps)  # the least t would be a baseline
    _, cost = solve(at, *of_tracks, steps=0)
    translates = rotation_cost - cost > o.translation_gain * rotation_cost + COST_SLACK
    if all_known(translates):
        return translates
    costs = [_costs(problem, x, noise, o, known) for x in (rotation_only, at)]
    # Fractions of the near tracks, nearest first, that alone may show a translation, without unit.
    for fraction in (0.25, 0.5):
        inverse = torch.where(problem.near, problem.inverse, 0.0)
        last = (problem.near.sum(-1, keepdim=True) * fraction).ceil().long().sub(1).clamp_min(0)
        in_nearest = problem.near & (inverse >= inverse.sort(-1, descending=True).values.gather(-1, last))
        weight = torch.where(in_nearest, 1.0, torch.where(problem.near | problem.far, far[:, None], 0.0))
        without_translation, with_translation = ((track_costs * weight).sum(-1) for track_costs in costs)
        improves = without_translation - with_translation > o.translation_gain * without_translation + COST_SLACK
        # Least number of tracks in such a fraction.
        translates = translates | (improves & (in_nearest.sum(-1) >= 20))
    return translates


@torch.no_grad()
def pose_covariance(problem: PoseDepthProblem, solution: MapSolution, o: FitOptions) -> tuple[Tensor, Tensor]:
    """Covariance (B, 9, 9) of (rotation, translation, shutter rate), and ``ok`` (B,); zero where not ok.

    Neither the far weight nor a robust weight is an inverse variance, so this is the sandwich A⁻¹ M A⁻¹ of an
    M-estimator: A = Σ ω ψ′ Jᵀ S⁻¹ J is the slope of the equations, M = Σ ω² ψ² Jᵀ S⁻¹ J their scatter, with the inverse
    depths eliminated from both. ψ′ and ψ² are taken as means over each kind of track, so residuals with heavier tails
    than assumed enlarge the covariance. A shutter rate that was not accepted is still unknown: it has its prior's
    freedom here.

    Where neighbouring near tracks share their errors, the sandwich is too small. With ``blocks`` it is multiplied by
    the ratio of the scatter of the unknowns when one block of near tracks after the other is left out.

    Source: P. Huber, "Robust Statistics", 1981, section 7.6; of the blocks H. Künsch, "The jackknife and the bootstrap
    for general stationary observations", 1989, with a linear step in place of a new solution.
    """

    def sums() -> tuple[Tensor, Tensor]:
        _, rows, _, *weights = _sandwich_parts(problem, solution, o)
        bread, meat = (normal_equations(rows, weight.double(), block=SUM_LANES)[0] for weight in weights)
        return bread, meat

    A, M = sandwich_sums(
        problem,
        solution.at,
        solution.noise,
        solution.far_weight,
        robust=(o.kernel, o.bend),
        reference=sums,
        limits=(MIN_PSI_SLOPE, N_POSE_PARAMETERS, MIN_WEIGHT_DIVISOR),
    )
    precision = o.shutter_sigma**-2 if o.shutter_sigma > 0 else GLOBAL_SHUTTER_PRECISION
    prior = torch.diag_embed(shutter_prior(torch.full_like(solution.shutter_precision, precision).double()))
    A, M = A + prior, M + prior
    inverse, ok = solve_spd(A, torch.eye(9, dtype=A.dtype, device=A.device).expand_as(A))
    whole = small_matmul(small_matmul(inverse, M), inverse)
    whole = 0.5 * (whole + whole.transpose(1, 2))
    if o.blocks is not None:
        front, rows, weight, bread, _ = _sandwich_parts(problem, solution, o)
        blocks = _blocks_of(problem.ray, problem.near & front, *o.blocks)
        steps = _steps_without_blocks(rows, bread, weight, blocks, solution)
        # Covariance of the delete-block jackknife over the stated one, (B,) and at least 1: mean over the
        # unknowns
        K = steps.shape[1]
        whitened, _ = solve_spd(torch.where(ok[:, None, None], whole, torch.eye(9).to(whole)), steps.mT)
        n_free = N_POSE_PARAMETERS + 3 * (solution.shutter_precision < GLOBAL_SHUTTER_PRECISION)
        whole = whole * ((K - 1) / K * (steps * whitened.mT).sum((1, 2)) / n_free).clamp_min(1.0)[:, None, None]
    return whole, ok


def _sandwich_parts(problem: PoseDepthProblem, solution: MapSolution, o: FitOptions) -> tuple[Tensor, ...]:
    """What the sandwich and the jackknife of :func:`pose_covariance` add up: whether tracks are in front (B, N),
    whitened rows (B, 10, 2, N), robust weight of each track (B, N), and its weights in bread and meat."""
    linear = linearise_tracks(problem, solution.at)
    factors = noise_factors(linear.fixed, solution.noise)
    rows, square = whitened_residuals(linear, factors).double(), squared_residuals(linear, factors)
    _, weight = robust_loss(square, o.kernel, o.bend)
    bread, meat = torch.zeros_like(square), torch.zeros_like(square)
    near_weight = torch.ones_like(solution.far_weight)
    for mask, omega, size in ((problem.near, near_weight, 2), (problem.far, solution.far_weight, 1)):
        used = mask & linear.front
        rise, scatter = _rise_and_scatter(square, weight, used, size, o)
        bread = torch.where(used, weight * (omega * rise)[:, None], bread)
        meat = torch.where(used, weight * weight * (omega * omega * scatter)[:, None], meat)
    return linear.front, rows, weight, bread, meat


def _blocks_of(ray: Tensor, used: Tensor, across: int, down: int) -> Tensor:
    """Membership (B, K, N) in K = across · down blocks of equally many used tracks: columns by x, each parted by y."""

    def parts(x: Tensor, mask: Tensor, n: int) -> Tensor:
        """Part 0 … n - 1 of the masked tracks by rising x."""
        rank = torch.where(mask, x, torch.inf).argsort(dim=-1, stable=True).argsort(dim=-1, stable=True)
        return (rank * n // mask.sum(-1, keepdim=True).clamp_min(1)).clamp(max=n - 1)

    x, y = (ray[:, :2] / ray[:, 2:]).unbind(1)
    column = parts(x, used, across)
    columns = [used & (column == k) for k in range(across)]
    return torch.stack([mask & (parts(y, mask, down) == k) for mask in columns for k in range(down)], 1)


def _steps_without_blocks(rows: Tensor, bread: Tensor, weight: Tensor, blocks: Tensor, solution: MapSolution) -> Tensor:
    """Steps (B, K, 9) of the unknowns to where they would be without one block of near tracks, to first order."""
    prior = torch.diag_embed(shutter_prior(solution.shutter_precision.double()))
    whole = normal_equations(rows, bread.double(), block=SUM_LANES)[0] + prior
    parts, slopes = [], []
    for member in blocks.double().unbind(1):
        parts.append(normal_equations(rows, bread * member, block=SUM_LANES)[0])
        slopes.append(normal_equations(rows, weight * member, block=SUM_LANES)[1])
    rest = whole[:, None] - torch.stack(parts, 1)
    steps, _ = solve_spd(rest.flatten(0, 1), torch.stack(slopes, 1).flatten(0, 1)[..., None])
    return steps.unflatten(0, rest.shape[:2])[..., 0]


def _costs(problem: PoseDepthProblem, at: Unknowns, noise: Tensor, o: FitOptions, known: TrackConstants) -> Tensor:
    """Robust cost (B, N) of every track with weight 1."""
    square, _ = squared_residuals_at(problem, at, known)(noise)
    return robust_loss(square, o.kernel, o.bend)[0]


def _rise_and_scatter(square: Tensor, weight: Tensor, used: Tensor, size: int, o: FitOptions) -> tuple[Tensor, Tensor]:
    """mean psi′ / mean w and mean psi² / mean w² (B,) of the used tracks, whose residuals have ``size`` coordinates.

    Both are corrected for the degrees of freedom that the pose takes from few residuals, the scatter once for itself
    and once for the noise scale, which is estimated from the same residuals.
    """
    steeper = robust_weight_slope(square, o.kernel, o.bend) * square * (2 / size) + weight

    def total(x: Tensor) -> Tensor:
        return torch.where(used, x, 0.0).sum(-1)

    count = total(torch.ones_like(weight)).clamp_min(1.0)
    mean = total(steeper) / count
    uneven = (total(steeper * steeper) / count - mean * mean) / (mean * mean).clamp_min(MIN_PSI_SLOPE**2)
    free = size * count
    few = 1 + N_POSE_PARAMETERS / free * uneven
    spent = free / (free - N_POSE_PARAMETERS).clamp_min(1.0)
    rise = mean / (total(weight) / count).clamp_min(MIN_WEIGHT_DIVISOR)
    scatter = total(weight * weight * square) / size / total(weight * weight).clamp_min(MIN_WEIGHT_DIVISOR)
    return rise.clamp_min(MIN_PSI_SLOPE) / few, scatter * spent * spent
