"""What may be wrong with somebody's map, fitted to references: a metre, a shift, a tilt, a slow drift.

All models are one line of unknowns, nested by what is believed of them beforehand: what a model does not have is held
at zero. They are fitted together, robustly, with the references' own noise among the unknowns, and each says how
probable the references are under it: what it explains, less what it could have explained as well.

Alphabet: ``x`` value of the map, ``y = s x + t`` its head, depth or inverse depth; ``phi`` what else may be wrong with
log depth; ``xi`` all unknowns in standard deviations of what is believed; ``r`` residual of log depth; ``M`` fits, of
maps times models; ``P`` unknowns, ``Q`` of them beside the head.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.alignment.references import MetricReferences
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import implicit_step, solve_spd

#: Nodes of the field over the picture (rows, columns), and of the correction over values.
FIELD_NODES, N_CURVE_KNOTS = (7, 9), 5

#: Slopes over the picture, and unknowns of an error that all far answers share.
N_TILT_SLOPES, N_MOTION_ERRORS = 2, 4

#: Correlation lengths of fields, long and short, as a share of the picture's longer side, and of the correction as one
#: of the range.
FIELD_LENGTHS, CURVE_LENGTH = (0.3, 0.13), 0.4

#: Degrees of freedom of Student's t: as heavy a tail as keeps a fit where nearly half of the references are wrong; and
#: lighter ones, for near returns that are found to have no such tail.
STUDENT_FREEDOM: Final = 1.0
LIGHTER_FREEDOMS: Final = (2.0, 4.0, 8.0, 30.0)

#: Share of a t distribution's scale that 68 % lie within.
T1_68_QUANTILE: Final = 1.84

#: Least relative noise of a reference; bounds of the factors on what near and far references state.
MIN_REFERENCE_NOISE: Final = 3e-4
NEAR_NOISE_RANGE, FAR_NOISE_RANGE = (1e-4, 1e4), (0.4, 8.0)

#: References for which what is stated of their noise counts.
STATED_NOISE_WEIGHT: Final = 0.1

#: Standard deviations of what is believed of scale (as a share) and shift (as a share of the references' median).
SCALE_PRIOR_SIGMA, SHIFT_PRIOR_SIGMA = 1.0, 0.5

#: Least head, as a share of where a fit starts and of a usual value.
MIN_SCALE, MIN_HEAD = 0.05, 1e-3

#: How much less likely, as a logarithm, a map with one more kind of error is.
COMPLEXITY_LOG_PENALTY: Final = 3.0

#: Steps of a fit that is to be weighed, and of one that is answered with.
SELECTION_STEPS, FINAL_STEPS = 10, 40


class ModelHead(NamedTuple):
    """What is free in ``y = s x + t``."""

    scale: bool
    shift: bool


class ErrorModel(NamedTuple):
    """What is taken to be wrong with a map; standard deviations of log depth, 0 = nothing."""

    head: str  # of HEADS
    tilt: float  # from the middle to a side
    field: float  # smooth, over the picture
    curve: float  # smooth, over log depth
    short: bool  # whether the field's correlation is short

    @property
    def prior(self) -> float:
        """Log probability, up to a constant: every kind of freedom is less likely than none."""
        return -COMPLEXITY_LOG_PENALTY * (sum(MODEL_HEADS[self.head]) + (self.tilt > 0) + (self.field > 0))


#: The simplest first: of two with as many freedoms the one that many maps lack, a metre, and not a shift.
MODEL_HEADS: Final = {
    "raw": ModelHead(scale=False, shift=False),
    "scale": ModelHead(scale=True, shift=False),
    "shift": ModelHead(scale=False, shift=True),
    "affine": ModelHead(scale=True, shift=True),
}

#: What may be wrong beside the head.
_DRIFTS: Final = {
    "": (0.0, 0.0, 0.0, False),
    "_tilt": (0.05, 0.0, 0.0, False),
    "_long_1": (0.02, 0.01, 0.002, False),
    "_long_4": (0.05, 0.04, 0.01, False),
    "_short_1": (0.01, 0.01, 0.002, True),
    "_short_4": (0.04, 0.04, 0.01, True),
}

ERROR_MODELS: Final = {head + drift: ErrorModel(head, *rest) for head in MODEL_HEADS for drift, rest in _DRIFTS.items()}


class ErrorBasis(NamedTuple):
    """What may be wrong beside the head: kernels of places and values, made white."""

    low: Tensor  # (B, 1) least value, as ``_level`` has it
    width: Tensor  # (B, 1)
    node: Tensor  # (F, 2) of the field, in longer sides
    whiten: Tensor  # (2, F, F) what makes kernels of the nodes white, long and short
    whiten_curve: Tensor  # (KNOTS, KNOTS)
    aspect: Tensor  # (2,) width and height in longer sides
    of_depth: bool  # whether y is depth, else inverse depth


class AlignmentProblem(NamedTuple):
    """A map and its references, ready to be fitted."""

    points: MetricReferences
    basis: ErrorBasis
    start: Tensor  # (B, H, 2) heads from which fits start, as HEADS
    level: Tensor  # (B, 1) a usual value of y


class ErrorModelFit(NamedTuple):
    """Models fitted to the references of a map, (B, K, …)."""

    model: Tensor  # (B, K) int64, place in MODELS
    head: Tensor  # (B, K, 2) s and t
    beta: Tensor  # (B, K, SLOPES + F + KNOTS) slopes, nodes, knots
    spread: Tensor  # (B, K, P', P): times its transpose it is the covariance of head and beta
    noise: Tensor  # (B, K, 2) factors of what near and far references state
    evidence: Tensor  # (B, K) log probability of the references; -inf where it could not be fitted

    def pick(self, at: Tensor) -> ErrorModelFit:
        """The models (B, K') at places ``at`` among these."""
        found = (
            part.gather(1, at.view(*at.shape, *(1,) * (part.dim() - 2)).expand(-1, -1, *part.shape[2:]))
            for part in self
        )
        return ErrorModelFit(*found)

    @property
    def short(self) -> Tensor:
        """Whether the correlation of a model's field is short, (B, K) bool."""
        return torch.tensor([m.short for m in ERROR_MODELS.values()], device=self.model.device)[self.model]


def make_basis(x: Tensor, known: Tensor, *, of_depth: bool = True) -> ErrorBasis:
    """For a map ``x`` (B, h, w) where it is ``known``. Gradient: none."""
    h, w = x.shape[-2:]
    log = torch.where(known, _level(x), torch.nan).flatten(1).detach()
    low, high = log.nan_to_num(torch.inf).amin(-1), log.nan_to_num(-torch.inf).amax(-1)
    some = low < high
    aspect = x.new_tensor([w / max(h, w), h / max(h, w)])
    v, u = torch.meshgrid(*(torch.linspace(0, 1, n).to(x) for n in FIELD_NODES), indexing="ij")
    node = torch.stack((u, v), -1).flatten(0, 1) * aspect
    return ErrorBasis(
        low=torch.where(some, low, 0.0)[:, None],
        width=torch.where(some, high - low, 1.0)[:, None],
        node=node,
        whiten=torch.stack([_whitener(node, length) for length in FIELD_LENGTHS]),
        whiten_curve=_whitener(_knots(x), CURVE_LENGTH),
        aspect=aspect,
        of_depth=of_depth,
    )


def _level(x: Tensor) -> Tensor:
    """What the correction goes along: log value, made smooth near zero and below."""
    return torch.asinh(x / 0.02)


def _knots(x: Tensor) -> Tensor:
    return torch.linspace(0, 1, N_CURVE_KNOTS)[:, None].to(x)


def _kernel(a: Tensor, b: Tensor, length: float) -> Tensor:
    """Of places (..., N, d) and (F, d)."""
    return (-0.5 * (a[..., None, :] - b).square().sum(-1) / length**2).exp()


def _whitener(node: Tensor, length: float) -> Tensor:
    eye = torch.eye(len(node)).to(node)
    L = torch.linalg.cholesky(_kernel(node, node, length) + 1e-6 * eye)
    return torch.linalg.solve_triangular(L, eye, upper=False).mT


def evaluate_fields(basis: ErrorBasis, share: Tensor, short: Tensor) -> Tensor:
    """Slopes and field (B, K, N, SLOPES + F) at places (B, N, 2), of models whose correlation is ``short`` (B, K)."""
    each = [_kernel(share * basis.aspect, basis.node, FIELD_LENGTHS[k]) @ basis.whiten[k] for k in (0, 1)]
    long, near_by = (torch.cat((2 * share - 1, field), -1)[:, None] for field in each)
    return torch.where(short[..., None, None], near_by, long)


def interpolation_variance(model: Tensor, field: Tensor) -> Tensor:
    """Variance (B, K, N) of the field of models (B, K) that its nodes do not hold, at places whose functions of
    :func:`evaluate_fields` are ``field`` (B, K, N, SLOPES + F)."""
    sd = field.new_tensor([m.field for m in ERROR_MODELS.values()])[model]
    return sd.square()[..., None] * (1 - field[..., N_TILT_SLOPES:].square().sum(-1)).clamp_min(0)


def evaluate_curves(basis: ErrorBasis, x: Tensor) -> Tensor:
    """The correction's functions (B, N, KNOTS) at values (B, N)."""
    along = ((_level(x) - basis.low) / basis.width).clamp(-0.2, 1.2)
    return _kernel(along[..., None], _knots(x), CURVE_LENGTH) @ basis.whiten_curve


def predict_log_depth(head: Tensor, x: Tensor, basis: ErrorBasis) -> tuple[Tensor, Tensor]:
    """Log depth (..., N) of heads (..., 2) at values (..., N) and its derivative (..., N, 2) by them; a head that says
    nothing positive says ``MIN_HEAD``."""
    y = (x * head[..., :1] + head[..., 1:]).clamp_min(MIN_HEAD)
    sign = 1.0 if basis.of_depth else -1.0
    return sign * y.log(), torch.stack((x, torch.ones_like(x)), -1) * (sign / y)[..., None]


def predict_references(fit: ErrorModelFit, task: AlignmentProblem) -> tuple[Tensor, Tensor]:
    """Log depth (B, K, N) at the references and its variance."""
    points, basis = task.points, task.basis
    x = points.x[:, None].expand(-1, fit.head.shape[1], -1)
    log, slope = predict_log_depth(fit.head, x, basis)
    curve = evaluate_curves(basis, points.x)[:, None].expand(-1, x.shape[1], -1, -1)
    field = evaluate_fields(basis, points.share, fit.short)
    phi = torch.cat((field, curve), -1)
    mean = log + (phi @ fit.beta[..., None])[..., 0]
    var = (torch.cat((slope, phi), -1) @ fit.spread).square().sum(-1)
    return mean, var + interpolation_variance(fit.model, field)


def placement_variance(head: Tensor, points: MetricReferences) -> Tensor:
    """Variance (B, K, N) of the log depth that heads (B, K, 2) give references, by where in its pixel each stands.
    Gradient: none."""
    with torch.no_grad():
        y = (points.x[:, None] * head[..., :1] + head[..., 1:]).clamp_min(MIN_HEAD)
        return (points.within[:, None] * head[..., :1] / y).square()


# -------------------------------------------------------------------------------------------------------------- fitting


class _Problem(NamedTuple):
    """M fits as equations."""

    x: Tensor  # (M, N)
    log: Tensor  # (M, N) of depth
    var: Tensor  # (M, N)
    near: Tensor  # (M, N) bool
    weight: Tensor  # (M, N)
    phi: Tensor  # (M, N, Q) in standard deviations
    start: Tensor  # (M, 2)
    head_sd: Tensor  # (M, 2)
    sd: Tensor  # (M, Q)
    freedom: Tensor  # (M, N) degrees of freedom
    basis: ErrorBasis

    def missed(self, xi: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (M, N), and the derivative (M, N, P) of what is predicted."""
        log, slope = predict_log_depth(self.start + self.head_sd * xi[:, :2], self.x, self.basis)
        r = self.log - log - (self.phi @ xi[:, 2:, None])[..., 0]
        return r, torch.cat((slope * self.head_sd[:, None], self.phi), -1)

    def square(self, noise: Tensor) -> Tensor:
        """Variance (M, N) of the references' own noise under factors (M, 2)."""
        factor = torch.where(self.near, noise[:, :1], noise[:, 1:])
        return (factor.square() * self.var).clamp_min(MIN_REFERENCE_NOISE**2)

    def first_noise(self, r: Tensor) -> Tensor:
        """Factors (M, 2) by medians."""
        groups = (self.weight > 0) & torch.stack((self.near, ~self.near))
        found = [masked_median(r.square() / self.var, group) / 0.455 for group in groups]
        return _bounded(torch.cat(found, -1))

    def next_noise(self, r: Tensor, noise: Tensor) -> Tensor:
        """Factors (M, 2) that residuals ask for: one step of expectation and maximisation."""
        w = _student(r, self.square(noise), self.freedom) * r.square() / self.var
        share = self.weight * torch.stack((self.near, ~self.near))
        return _bounded((((share * w).sum(-1) + STATED_NOISE_WEIGHT) / (share.sum(-1) + STATED_NOISE_WEIGHT)).mT)

    def equations(self, xi: Tensor, noise: Tensor) -> Tensor:
        """What is zero at the optimum, (M, P + 2)."""
        r, A = self.missed(xi)
        square = self.square(noise)
        pull = self.weight * _student(r, square, self.freedom) / square * r
        return torch.cat(((A.mT @ pull[..., None])[..., 0] - xi, self.next_noise(r, noise) - noise), -1)


def _bounded(square: Tensor) -> Tensor:
    low, high = (square.new_tensor(b) for b in zip(NEAR_NOISE_RANGE, FAR_NOISE_RANGE, strict=True))
    return square.maximum(low**2).minimum(high**2).sqrt()


def _student(r: Tensor, square: Tensor, freedom: Tensor) -> Tensor:
    """Weights of residuals under Student's t."""
    return (freedom + 1) / (freedom + r.square() / square)


def fit_models(
    task: AlignmentProblem,
    model: Tensor,  # (B, K) int64
    used: Tensor,  # (B, N) bool, or (B, K, N)
    steps: int = SELECTION_STEPS,
    freedom: Tensor | None = None,  # (B,) of near references
) -> ErrorModelFit:
    """Models fitted to the references that are used.

    Student's t by expectation and maximisation, noise and all, on Gauss–Newton steps; the evidence is Laplace's, with
    references of one block counting as fewer.

    Gradient: head and beta to the map's values and the references' depth and variance, by the implicit function
        theorem.
    """
    p = _problem(task, model, used)
    if freedom is not None:
        lighter = freedom.repeat_interleave(model.shape[1])[:, None]
        p = p._replace(freedom=torch.where(p.near, lighter, p.freedom))
    asked = torch.is_grad_enabled() and any(t.requires_grad for t in (p.x, p.log, p.var))
    with torch.no_grad():
        xi, noise, ok = _optimum(p, steps)
        root, evidence, fine = _laplace(p, xi, noise)
        ok = ok & fine & xi.isfinite().all(-1)
    if asked:
        q = torch.cat((xi, noise), -1)

        def after(step: Tensor) -> Tensor:
            return p.equations(*(q + step).split([xi.shape[1], 2], -1))

        xi = xi + implicit_step(after, after(torch.zeros_like(q)))[:, :-2]
    seen = slice(2, -N_MOTION_ERRORS)
    sd = p.sd[:, :-N_MOTION_ERRORS]
    spread = torch.cat((root[:, :2] * p.head_sd[..., None], root[:, seen] * sd[..., None]), 1)
    found = (p.start + p.head_sd * xi[:, :2], sd * xi[:, seen], spread, noise, torch.where(ok, evidence, -torch.inf))
    return ErrorModelFit(model, *(part.unflatten(0, model.shape) for part in found))


def estimate_freedom(r: Tensor, points: MetricReferences) -> Tensor:
    """Degrees of freedom (B,) under which residuals (B, N) of near references are likeliest. Gradient: none."""
    with torch.no_grad():
        near = points.used & points.near
        weight = points.weight(points.used) * near
        u = r.square() / points.var
        tried = u.new_tensor([STUDENT_FREEDOM, *LIGHTER_FREEDOMS])[:, None, None]
        square = (masked_median(u, near) / 0.455).clamp_min(NEAR_NOISE_RANGE[0] ** 2).expand(len(tried), -1, -1)
        mass = weight.sum(-1, keepdim=True).clamp_min(1e-9)
        for _ in range(30):
            square = ((weight * _student(u.sqrt(), square, tried) * u).sum(-1, keepdim=True) / mass).clamp_min(1e-12)
        half = 0.5 * (tried + 1)
        like = half.lgamma() - (0.5 * tried).lgamma() - 0.5 * (tried * square).log()
        like = (weight * (like - half * (u / square / tried).log1p())).sum(-1)
        return tried[like.argmax(0), 0, 0]


def _problem(task: AlignmentProblem, model: Tensor, used: Tensor) -> _Problem:
    points, basis = task.points, task.basis
    B, K = model.shape

    def each(t: Tensor) -> Tensor:
        return t[:, None].expand(B, K, *t.shape[1:]).flatten(0, 1)

    of = list(ERROR_MODELS.values())
    place = torch.tensor([list(MODEL_HEADS).index(m.head) for m in of], device=model.device)[model]
    free = points.x.new_tensor([MODEL_HEADS[m.head] for m in of])[model]
    short = torch.tensor([m.short for m in of], device=model.device)[model]
    rest = torch.cat((evaluate_curves(basis, points.x), motion_error_basis(points)), -1)[:, None].expand(B, K, -1, -1)
    sd = points.x.new_tensor([_deviations(m) for m in of])[model.flatten()]
    start = task.start.gather(1, place[..., None].expand(-1, -1, 2))
    believed = free * torch.stack(
        (SCALE_PRIOR_SIGMA * start[..., 0], (SHIFT_PRIOR_SIGMA * task.level).expand_as(place)), -1
    )
    weight = [points.weight(one) for one in used.unbind(1)] if used.dim() == 3 else [points.weight(used)] * K
    return _Problem(
        x=each(points.x),
        log=each(points.depth.log()),
        var=each(points.var),
        near=each(points.near),
        weight=torch.stack(weight, 1).flatten(0, 1),
        phi=torch.cat((evaluate_fields(basis, points.share, short), rest), -1).flatten(0, 1) * sd[:, None],
        start=start.flatten(0, 1),
        head_sd=believed.flatten(0, 1),
        sd=sd,
        freedom=torch.full_like(each(points.x), STUDENT_FREEDOM),
        basis=basis,
    )


def _deviations(model: ErrorModel) -> list[float]:
    """Standard deviations of slopes, nodes, knots and leans."""
    field = [model.field] * (FIELD_NODES[0] * FIELD_NODES[1])
    return [model.tilt] * N_TILT_SLOPES + field + [model.curve] * N_CURVE_KNOTS + [1.0] * N_MOTION_ERRORS


def motion_error_basis(points: MetricReferences) -> Tensor:
    """What a wrong motion does to the log depth of far answers (B, N, LEANS), one standard deviation each: a wrong
    scale, and a lean that grows with depth."""
    z, side = points.depth / masked_median(points.depth, points.used), 2 * points.share - 1
    lean = torch.stack((torch.ones_like(z), z - 1, z * side[..., 0], z * side[..., 1]), -1).clamp(-3, 3)
    return points.shared[..., None] * lean


def _optimum(p: _Problem, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Unknowns (M, P), noise (M, 2) and whether they could be found (M,)."""
    xi = p.x.new_zeros(len(p.x), p.phi.shape[-1] + 2)
    least = (MIN_SCALE - 1) * p.start[:, :1] / p.head_sd[:, :1].clamp_min(1e-12)
    r, A = p.missed(xi)
    noise = p.first_noise(r)
    eye = torch.eye(xi.shape[1]).to(xi)
    for _ in range(steps):
        square = p.square(noise)
        W = A * (p.weight * _student(r, square, p.freedom) / square)[..., None]
        step, ok = solve_spd(W.mT @ A + eye, W.mT @ r[..., None] - xi[..., None])
        xi = xi + step[..., 0]
        xi = torch.cat((torch.maximum(xi[:, :1], least), xi[:, 1:]), -1)
        r, A = p.missed(xi)
        noise = p.next_noise(r, noise)
    return xi, noise, ok


def _laplace(p: _Problem, xi: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A root (M, P, P) of the covariance, log probability (M,) of the references, whether there is one (M,)."""
    r, A = p.missed(xi)
    square = p.square(noise)
    eye = torch.eye(xi.shape[1]).to(xi)
    H = (A * (p.weight * _student(r, square, p.freedom) / square)[..., None]).mT @ A + eye
    L, info = torch.linalg.cholesky_ex(H)
    ok = (info == 0) & L.isfinite().flatten(1).all(-1)
    log_t = -0.5 * (p.freedom + 1) * (r.square() / square / p.freedom).log1p() - 0.5 * square.log()
    L = torch.where(ok[:, None, None], L, eye)
    volume = L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    evidence = (p.weight * log_t).sum(-1) - 0.5 * xi.square().sum(-1) - volume
    return torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False).mT, evidence, ok
