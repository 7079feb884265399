"""Error models of a depth map, fitted to metric references: a scale, a shift, a tilt, a slow drift.

All models are special cases of one vector of unknowns and differ in its Gaussian prior: what a model lacks has a prior
of zero variance. The unknowns are fitted together, robustly, with the noise of the references among them; the evidence
of a model is the probability of the references under it: the fit, less the volume of what it could have fitted as well.

Alphabet: ``x`` value of the map, ``y = s x + t`` its head, depth or inverse depth; ``phi`` basis of the other errors of
log depth; ``xi`` all unknowns in prior standard deviations; ``r`` residual of log depth; ``M`` fits, of maps times
models; ``P`` unknowns, ``Q`` of them beside the head.
"""

from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.alignment.options import DEFAULT_ALIGNMENT_OPTIONS, AlignmentOptions
from dhtorch.alignment.references import MetricReferences
from dhtorch.geometry.covariance import masked_median
from dhtorch.geometry.least_squares import implicit_step, solve_spd

#: Nodes of the field over the picture (rows, columns).
#: Source: chosen on data=shared_scenes, align_study.json.
FIELD_NODES = (7, 9)

#: Nodes of the correction over log values.
#: Source: chosen on data=shared_scenes, align_study.json.
N_CURVE_KNOTS = 5

#: Slopes of a tilt, one per picture axis. Source: derived, a plane over the picture has two.
N_TILT_SLOPES = 2

#: Unknowns of the error that all far answers share: a scale, a slope along depth, one along each picture axis.
#: Source: derived, the columns of ``motion_error_basis``.
N_MOTION_ERRORS = 4

#: 68 % quantile of the absolute value of a t distribution with one degree of freedom, in scales.
#: Source: derived, tan(0.683 · π / 2).
T1_68_QUANTILE: Final = 1.84


class _ModelHead(NamedTuple):
    """Which parameters of ``y = s x + t`` are free."""

    scale: bool
    shift: bool


class _ErrorModel(NamedTuple):
    """Prior of a map's errors: standard deviations of log depth, 0 = absent."""

    head: str  # of MODEL_HEADS
    tilt: float  # from the middle to a side
    field: float  # smooth, over the picture
    curve: float  # smooth, over log depth
    short: bool  # whether the field's correlation is short

    def prior(self, options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS) -> float:
        """Prior log probability of the model, up to a constant: each kind of error costs the same."""
        return -options.complexity_log_penalty * (sum(MODEL_HEADS[self.head]) + (self.tilt > 0) + (self.field > 0))


#: Head -> free parameters, the simplest first; of two with one free parameter the scale, which many maps lack.
MODEL_HEADS: Final = {
    "raw": _ModelHead(scale=False, shift=False),
    "scale": _ModelHead(scale=True, shift=False),
    "shift": _ModelHead(scale=False, shift=True),
    "affine": _ModelHead(scale=True, shift=True),
}

#: Errors beside the head: standard deviations of tilt, field and curve (log depth), and whether the field is short.
#: Source: chosen on data=shared_scenes, align_study.json.
_DRIFTS: Final = {
    "": (0.0, 0.0, 0.0, False),
    "_tilt": (0.05, 0.0, 0.0, False),
    "_long_1": (0.02, 0.01, 0.002, False),
    "_long_4": (0.05, 0.04, 0.01, False),
    "_short_1": (0.01, 0.01, 0.002, True),
    "_short_4": (0.04, 0.04, 0.01, True),
}

#: Name -> model: every head with every drift.
ERROR_MODELS: Final = {
    head + drift: _ErrorModel(head, *rest) for head in MODEL_HEADS for drift, rest in _DRIFTS.items()
}


class _ErrorBasis(NamedTuple):
    """Basis of the errors beside the head: whitened kernels over places and values."""

    low: Tensor  # (B, 1) least value, on the scale of ``_log_level``
    width: Tensor  # (B, 1) range of the values on that scale
    node: Tensor  # (F, 2) of the field, in longer sides
    whiten: Tensor  # (2, F, F) whitening matrices of the nodes' kernels, long and short
    whiten_curve: Tensor  # (KNOTS, KNOTS) the same of the correction
    aspect: Tensor  # (2,) width and height in longer sides
    of_depth: bool  # whether y is depth, else inverse depth
    options: AlignmentOptions


class AlignmentProblem(NamedTuple):
    """References of a map, basis of its errors and initial heads: the input of :func:`fit_models`."""

    points: MetricReferences
    basis: _ErrorBasis
    start: Tensor  # (B, H, 2) initial heads, in the order of MODEL_HEADS
    level: Tensor  # (B, 1) median of y at the references

    @property
    def options(self) -> AlignmentOptions:
        """Options of the basis and of all fits."""
        return self.basis.options


class ErrorModelFit(NamedTuple):
    """Models fitted to the references of a map, (B, K, …)."""

    model: Tensor  # (B, K) int64, index in ERROR_MODELS
    head: Tensor  # (B, K, 2) s and t
    beta: Tensor  # (B, K, SLOPES + F + KNOTS) slopes, nodes, knots
    spread: Tensor  # (B, K, P', P) root of the covariance of head and beta: times its transpose
    noise: Tensor  # (B, K, 2) factors on the stated noise of near and far references
    evidence: Tensor  # (B, K) log probability of the references; -inf where the fit failed

    def pick(self, at: Tensor) -> "ErrorModelFit":
        """The fits (B, K') of the models at indices ``at`` (B, K') among these."""
        picked = (
            part.gather(1, at.view(*at.shape, *(1,) * (part.dim() - 2)).expand(-1, -1, *part.shape[2:]))
            for part in self
        )
        return ErrorModelFit(*picked)

    @property
    def short(self) -> Tensor:
        """Whether the correlation length of a model's field is the short one, (B, K) bool."""
        return torch.tensor([m.short for m in ERROR_MODELS.values()], device=self.model.device)[self.model]


def make_basis(
    x: Tensor, known: Tensor, *, of_depth: bool = True, options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS
) -> _ErrorBasis:
    """Map ``x`` (B, h, w), valid where ``known`` -> basis of its errors. Gradient: none."""
    h, w = x.shape[-2:]
    level = torch.where(known, _log_level(x), torch.nan).flatten(1).detach()
    low, high = level.nan_to_num(torch.inf).amin(-1), level.nan_to_num(-torch.inf).amax(-1)
    has_range = low < high
    aspect = x.new_tensor([w / max(h, w), h / max(h, w)])
    v, u = torch.meshgrid(*(torch.linspace(0, 1, n).to(x) for n in FIELD_NODES), indexing="ij")
    node = torch.stack((u, v), -1).flatten(0, 1) * aspect
    return _ErrorBasis(
        low=torch.where(has_range, low, 0.0)[:, None],
        width=torch.where(has_range, high - low, 1.0)[:, None],
        node=node,
        whiten=torch.stack([_whitener(node, length) for length in options.field_lengths]),
        whiten_curve=_whitener(_knots(x), options.curve_length),
        aspect=aspect,
        of_depth=of_depth,
        options=options,
    )


def _log_level(x: Tensor) -> Tensor:
    """Abscissa of the correction: the logarithm of a value, continued smoothly to zero and below."""
    return torch.asinh(x / 0.02)


def _knots(x: Tensor) -> Tensor:
    """Nodes (KNOTS, 1) of the correction on [0, 1], of the type of ``x``."""
    return torch.linspace(0, 1, N_CURVE_KNOTS)[:, None].to(x)


def _kernel(a: Tensor, b: Tensor, length: float) -> Tensor:
    """Gaussian kernel (..., N, F) of places (..., N, d) and nodes (F, d)."""
    return (-0.5 * (a[..., None, :] - b).square().sum(-1) / length**2).exp()


def _whitener(node: Tensor, length: float) -> Tensor:
    """Matrix (F, F) that turns kernels of places and nodes (F, d) into functions with unit normal coefficients."""
    eye = torch.eye(len(node)).to(node)
    L = torch.linalg.cholesky(_kernel(node, node, length) + 1e-6 * eye)
    return torch.linalg.solve_triangular(L, eye, upper=False).mT


def evaluate_fields(basis: _ErrorBasis, share: Tensor, short: Tensor) -> Tensor:
    """Slopes and field functions (B, K, N, SLOPES + F) at places (B, N, 2) of models whose correlation length is the
    ``short`` (B, K) or the long one."""
    lengths = zip(basis.options.field_lengths, basis.whiten, strict=True)
    fields = [_kernel(share * basis.aspect, basis.node, length) @ whiten for length, whiten in lengths]
    long_field, short_field = (torch.cat((2 * share - 1, field), -1)[:, None] for field in fields)
    return torch.where(short[..., None, None], short_field, long_field)


def interpolation_variance(model: Tensor, field: Tensor) -> Tensor:
    """Variance (B, K, N) of the field of models (B, K) that its nodes do not determine, at places whose functions of
    :func:`evaluate_fields` are ``field`` (B, K, N, SLOPES + F)."""
    sd = field.new_tensor([m.field for m in ERROR_MODELS.values()])[model]
    return sd.square()[..., None] * (1 - field[..., N_TILT_SLOPES:].square().sum(-1)).clamp_min(0)


def evaluate_curves(basis: _ErrorBasis, x: Tensor) -> Tensor:
    """Functions (B, N, KNOTS) of the correction at values (B, N)."""
    along = ((_log_level(x) - basis.low) / basis.width).clamp(-0.2, 1.2)
    return _kernel(along[..., None], _knots(x), basis.options.curve_length) @ basis.whiten_curve


def predict_log_depth(head: Tensor, x: Tensor, basis: _ErrorBasis) -> tuple[Tensor, Tensor]:
    """Log depth (..., N) of heads (..., 2) at values (..., N), and its derivative (..., N, 2) by the heads.

    A head below the option ``min_head`` is replaced by it.
    """
    y = (x * head[..., :1] + head[..., 1:]).clamp_min(basis.options.min_head)
    sign = 1.0 if basis.of_depth else -1.0
    return sign * y.log(), torch.stack((x, torch.ones_like(x)), -1) * (sign / y)[..., None]


def predict_references(fit: ErrorModelFit, task: AlignmentProblem) -> tuple[Tensor, Tensor]:
    """Predicted log depth (B, K, N) at the references and its variance."""
    points, basis = task.points, task.basis
    x = points.x[:, None].expand(-1, fit.head.shape[1], -1)
    log_depth, slope = predict_log_depth(fit.head, x, basis)
    curve = evaluate_curves(basis, points.x)[:, None].expand(-1, x.shape[1], -1, -1)
    field = evaluate_fields(basis, points.share, fit.short)
    phi = torch.cat((field, curve), -1)
    mean = log_depth + (phi @ fit.beta[..., None])[..., 0]
    var = (torch.cat((slope, phi), -1) @ fit.spread).square().sum(-1)
    return mean, var + interpolation_variance(fit.model, field)


def placement_variance(
    head: Tensor, points: MetricReferences, options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS
) -> Tensor:
    """Variance (B, K, N) of the log depth that heads (B, K, 2) predict at references, due to their unknown positions
    within a pixel. Gradient: none."""
    with torch.no_grad():
        y = (points.x[:, None] * head[..., :1] + head[..., 1:]).clamp_min(options.min_head)
        return (points.within[:, None] * head[..., :1] / y).square()


# -------------------------------------------------------------------------------------------------------------- fitting


class _Problem(NamedTuple):
    """Data and prior of M fits."""

    x: Tensor  # (M, N)
    log: Tensor  # (M, N) log depth of the references
    var: Tensor  # (M, N) stated variance of log depth
    near: Tensor  # (M, N) bool
    weight: Tensor  # (M, N) 0 = not used
    phi: Tensor  # (M, N, Q) basis, times prior standard deviations
    start: Tensor  # (M, 2) initial heads
    head_sd: Tensor  # (M, 2) prior standard deviations
    sd: Tensor  # (M, Q) prior standard deviations
    freedom: Tensor  # (M, N) degrees of freedom of Student's t
    basis: _ErrorBasis

    def residuals(self, xi: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (M, N), and the derivative (M, N, P) of the predicted log depth."""
        log_depth, slope = predict_log_depth(self.start + self.head_sd * xi[:, :2], self.x, self.basis)
        r = self.log - log_depth - (self.phi @ xi[:, 2:, None])[..., 0]
        return r, torch.cat((slope * self.head_sd[:, None], self.phi), -1)

    def _noise_variance(self, noise: Tensor) -> Tensor:
        """Noise variance (M, N) of the references under factors (M, 2)."""
        factor = torch.where(self.near, noise[:, :1], noise[:, 1:])
        return (factor.square() * self.var).clamp_min(self.basis.options.min_reference_noise**2)

    def _initial_noise(self, r: Tensor) -> Tensor:
        """Residuals (M, N) -> noise factors (M, 2), by medians; 0.455 is the median of a chi-square of one freedom."""
        groups = (self.weight > 0) & torch.stack((self.near, ~self.near))
        squares = [masked_median(r.square() / self.var, group) / 0.455 for group in groups]
        return _bounded_factors(torch.cat(squares, -1), self.basis.options)

    def _next_noise(self, r: Tensor, noise: Tensor) -> Tensor:
        """Noise factors (M, 2) after one step of expectation and maximisation under residuals (M, N)."""
        weighted_square = _student_weight(r, self._noise_variance(noise), self.freedom) * r.square() / self.var
        group_weight = self.weight * torch.stack((self.near, ~self.near))
        prior_weight = self.basis.options.stated_noise_weight
        square = ((group_weight * weighted_square).sum(-1) + prior_weight) / (group_weight.sum(-1) + prior_weight)
        return _bounded_factors(square.mT, self.basis.options)

    def equations(self, xi: Tensor, noise: Tensor) -> Tensor:
        """Stationarity conditions (M, P + 2), zero at the optimum."""
        r, A = self.residuals(xi)
        variance = self._noise_variance(noise)
        score = self.weight * _student_weight(r, variance, self.freedom) / variance * r
        return torch.cat(((A.mT @ score[..., None])[..., 0] - xi, self._next_noise(r, noise) - noise), -1)


def _bounded_factors(square: Tensor, options: AlignmentOptions) -> Tensor:
    """Squared noise factors (M, 2) -> factors within their bounds."""
    low, high = (square.new_tensor(b) for b in zip(options.near_noise_range, options.far_noise_range, strict=True))
    return square.maximum(low**2).minimum(high**2).sqrt()


def _student_weight(r: Tensor, square: Tensor, freedom: Tensor) -> Tensor:
    """Weights of residuals under Student's t of scale² ``square`` and degrees of freedom ``freedom``."""
    return (freedom + 1) / (freedom + r.square() / square)


def fit_models(
    task: AlignmentProblem,
    model: Tensor,  # (B, K) int64
    used: Tensor,  # (B, N) bool, or (B, K, N)
    steps: int | None = None,  # None = those of model selection
    freedom: Tensor | None = None,  # (B,) of near references
) -> ErrorModelFit:
    """Problem and model indices -> parameters, covariance, noise and evidence of each model.

    Student's t by expectation and maximisation, the noise included, with Gauss–Newton steps; the evidence is Laplace's
    approximation, in which correlated references of one block count as fewer.

    Gradient: head and beta to the map's values and the references' depth and variance, by the implicit function
        theorem.
    """
    p = _problem(task, model, used)
    if freedom is not None:
        near_freedom = freedom.repeat_interleave(model.shape[1])[:, None]
        p = p._replace(freedom=torch.where(p.near, near_freedom, p.freedom))
    needs_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in (p.x, p.log, p.var))
    with torch.no_grad():
        xi, noise, ok = _optimum(p, task.options.selection_steps if steps is None else steps)
        root, evidence, positive_definite = _laplace(p, xi, noise)
        ok = ok & positive_definite & xi.isfinite().all(-1)
    if needs_gradient:
        q = torch.cat((xi, noise), -1)

        def equations_after(step: Tensor) -> Tensor:
            return p.equations(*(q + step).split([xi.shape[1], 2], -1))

        xi = xi + implicit_step(equations_after, equations_after(torch.zeros_like(q)))[:, :-2]
    beta_part = slice(2, -N_MOTION_ERRORS)
    sd = p.sd[:, :-N_MOTION_ERRORS]
    spread = torch.cat((root[:, :2] * p.head_sd[..., None], root[:, beta_part] * sd[..., None]), 1)
    parts = (
        p.start + p.head_sd * xi[:, :2],
        sd * xi[:, beta_part],
        spread,
        noise,
        torch.where(ok, evidence, -torch.inf),
    )
    return ErrorModelFit(model, *(part.unflatten(0, model.shape) for part in parts))


def estimate_freedom(
    r: Tensor, points: MetricReferences, options: AlignmentOptions = DEFAULT_ALIGNMENT_OPTIONS
) -> Tensor:
    """Residuals (B, N) of near references -> their most probable degrees of freedom (B,). Gradient: none."""
    with torch.no_grad():
        near = points.used & points.near
        weight = points.weight(points.used, options) * near
        u = r.square() / points.var
        candidates = u.new_tensor([options.student_freedom, *options.lighter_freedoms])[:, None, None]
        square = (
            (masked_median(u, near) / 0.455).clamp_min(options.near_noise_range[0] ** 2).expand(len(candidates), -1, -1)
        )
        mass = weight.sum(-1, keepdim=True).clamp_min(1e-9)
        for _ in range(30):
            weighted_square = weight * _student_weight(u.sqrt(), square, candidates) * u
            square = (weighted_square.sum(-1, keepdim=True) / mass).clamp_min(1e-12)
        half = 0.5 * (candidates + 1)
        log_density = half.lgamma() - (0.5 * candidates).lgamma() - 0.5 * (candidates * square).log()
        log_likelihood = (weight * (log_density - half * (u / square / candidates).log1p())).sum(-1)
        return candidates[log_likelihood.argmax(0), 0, 0]


def _problem(task: AlignmentProblem, model: Tensor, used: Tensor) -> _Problem:
    """Problem, model indices (B, K) and used references -> data and prior of M = B · K fits."""
    points, basis, options = task.points, task.basis, task.options
    B, K = model.shape

    def per_fit(t: Tensor) -> Tensor:
        return t[:, None].expand(B, K, *t.shape[1:]).flatten(0, 1)

    models = list(ERROR_MODELS.values())
    head = torch.tensor([list(MODEL_HEADS).index(m.head) for m in models], device=model.device)[model]
    free = points.x.new_tensor([MODEL_HEADS[m.head] for m in models])[model]
    short = torch.tensor([m.short for m in models], device=model.device)[model]
    rest = torch.cat((evaluate_curves(basis, points.x), motion_error_basis(points)), -1)[:, None].expand(B, K, -1, -1)
    nodes = FIELD_NODES[0] * FIELD_NODES[1]
    sigmas = [[m.tilt] * N_TILT_SLOPES + [m.field] * nodes + [m.curve] * N_CURVE_KNOTS for m in models]
    sd = points.x.new_tensor([s + [1.0] * N_MOTION_ERRORS for s in sigmas])[model.flatten()]
    start = task.start.gather(1, head[..., None].expand(-1, -1, 2))
    head_sd = free * torch.stack(
        (options.scale_prior_sigma * start[..., 0], (options.shift_prior_sigma * task.level).expand_as(head)), -1
    )
    if used.dim() == 3:
        weight = [points.weight(used_by_model, options) for used_by_model in used.unbind(1)]
    else:
        weight = [points.weight(used, options)] * K
    return _Problem(
        x=per_fit(points.x),
        log=per_fit(points.depth.log()),
        var=per_fit(points.var),
        near=per_fit(points.near),
        weight=torch.stack(weight, 1).flatten(0, 1),
        phi=torch.cat((evaluate_fields(basis, points.share, short), rest), -1).flatten(0, 1) * sd[:, None],
        start=start.flatten(0, 1),
        head_sd=head_sd.flatten(0, 1),
        sd=sd,
        freedom=torch.full_like(per_fit(points.x), options.student_freedom),
        basis=basis,
    )


def motion_error_basis(points: MetricReferences) -> Tensor:
    """Effect of a wrong motion on the log depth of far answers (B, N, MOTION_ERRORS), one standard deviation each: a
    wrong scale, and slopes along depth and across the picture that grow with depth."""
    z, side = points.depth / masked_median(points.depth, points.used), 2 * points.share - 1
    lean = torch.stack((torch.ones_like(z), z - 1, z * side[..., 0], z * side[..., 1]), -1).clamp(-3, 3)
    return points.shared[..., None] * lean


def _optimum(p: _Problem, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Unknowns (M, P), noise factors (M, 2) and whether the solves succeeded (M,)."""
    xi = p.x.new_zeros(len(p.x), p.phi.shape[-1] + 2)
    min_scale = (p.basis.options.min_scale - 1) * p.start[:, :1] / p.head_sd[:, :1].clamp_min(1e-12)
    r, A = p.residuals(xi)
    noise = p._initial_noise(r)
    eye = torch.eye(xi.shape[1]).to(xi)
    for _ in range(steps):
        variance = p._noise_variance(noise)
        W = A * (p.weight * _student_weight(r, variance, p.freedom) / variance)[..., None]
        step, ok = solve_spd(W.mT @ A + eye, W.mT @ r[..., None] - xi[..., None])
        xi = xi + step[..., 0]
        xi = torch.cat((torch.maximum(xi[:, :1], min_scale), xi[:, 1:]), -1)
        r, A = p.residuals(xi)
        noise = p._next_noise(r, noise)
    return xi, noise, ok


def _laplace(p: _Problem, xi: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Root (M, P, P) of the covariance, log evidence (M,), and whether the Hessian is positive definite (M,)."""
    r, A = p.residuals(xi)
    variance = p._noise_variance(noise)
    eye = torch.eye(xi.shape[1]).to(xi)
    H = (A * (p.weight * _student_weight(r, variance, p.freedom) / variance)[..., None]).mT @ A + eye
    L, info = torch.linalg.cholesky_ex(H)
    ok = (info == 0) & L.isfinite().flatten(1).all(-1)
    log_t = -0.5 * (p.freedom + 1) * (r.square() / variance / p.freedom).log1p() - 0.5 * variance.log()
    L = torch.where(ok[:, None, None], L, eye)
    volume = L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    evidence = (p.weight * log_t).sum(-1) - 0.5 * xi.square().sum(-1) - volume
    return torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False).mT, evidence, ok
