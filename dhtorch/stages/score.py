"""Stage 7: estimates → estimates with a selective score in [0, 1] and its threshold, which is the last gate.

Three closed-form scores and a learned one. Alphabet of the latter: ``x`` (…, 8) evidence of an answer in logarithms,
``e`` its expected relative error.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from dhtorch.codes import Gate
from dhtorch.geometry.checks import shaped
from dhtorch.geometry.determinism import pad_elementwise
from dhtorch.records import Estimate, PoseFit, Samples, Tracks
from dhtorch.runtime import storage

#: Limits relative errors and ratios from above, without unit: their squares stay in the range of float32.
MAX_RATIO = 1e6

#: Features of a learned score, each as a logarithm, and the limits to which their values are clamped, in their unit.
SCORE_FEATURES: dict[str, tuple[float, float]] = {
    "expected_error": (1e-5, 1e2),  # e of confidence_from_error
    "shared_error": (1e-5, 1e2),  # the pose's part of sigma / depth
    "parallax_deg": (1e-3, 1e2),
    "residual_px": (1e-2, 1e2),
    "round_trip_px": (1e-3, 1e2),
    "photometric": (1e-4, 1.0),
    "trackability": (1e-7, 1.0),
    "reach": (1e-2, 1e2),  # depth over the mean depth of the inlier returns of the pose
}

#: Limits the logarithm of the factor by which a learned score changes the expected error, without unit.
MAX_LOG_FACTOR = 4.0


@shaped("estimate.gate: B N, samples.uv: B N 2, tracks.valid: B N")
def confidence(
    estimate: Estimate,
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    *,
    half_parallax_deg: float = 2.0,
    residual_scale_px: float = 3.0,
    min_score: float = 0.0,
) -> Estimate:
    """Score of every answer from parallax p and residual r: p / (p + p½) · max(0, 1 − r / r₀).

    The paper describes a continuous score that rises with parallax and falls with the reprojection residual but
    gives no formula; this one, with both constants as options, is not the paper's. The score orders answers by risk;
    it is not a probability.

    Args:
        estimate: from stage 6.
        samples, tracks, fit: part of the stage's signature, not used.
        half_parallax_deg: parallax p½ at which the first factor is one half.
        residual_scale_px: residual r₀ at which the second factor reaches zero.
        min_score: answers below it become unanswered with LOW_SCORE.

    Returns:
        Estimate with ``score`` in [0, 1], 0 where unanswered.

    Raises:
        ValueError: wrong shapes.

    Gradient: to parallax and residual; the threshold carries none.
    Source: paper, "Selective confidence".
    """
    parallax, residual = estimate.parallax_deg, estimate.residual_px
    stated = estimate.keep & parallax.isfinite() & residual.isfinite()
    parallax, residual = (torch.where(stated, x, 0.0) for x in (parallax, residual))
    score = parallax / (parallax + half_parallax_deg) * (1 - residual / residual_scale_px).clamp_min(0)
    return _apply_min_score(estimate, score, min_score)


@shaped("estimate.gate: B N, samples.uv: B N 2, tracks.valid: B N")
def confidence_from_error(
    estimate: Estimate,
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    *,
    residual_scale_px: float = 0.5,
    photometric_scale: float | None = None,
    round_trip_scale_px: float | None = 0.4,
    half_error: float = 0.1,
    recalibration: Callable[[Tensor], Tensor] | None = None,
    min_score: float = 0.0,
) -> Estimate:
    """Score of every answer from its expected relative error e: h / (h + e).

    e = (own part of sigma) / depth · sqrt(1 + (r / s)² + …): how far the depth moves with the noise of its own track,
    more where the track disagrees with the pose. The part of sigma that all points of the pair share belongs in the
    reported sigma; it does not distinguish the points of a pair, and is left out.

    Args:
        estimate: from stage 6, with ``sigma``, ``sigma_shared`` and ``residual_px``.
        samples, fit: part of the stage's signature, not used.
        tracks: with ``photometric`` and ``error``, where their scale is not None.
        residual_scale_px: reprojection residual s that contributes as much as the track's own noise.
        photometric_scale: grey difference of the patches that does, in grey values from 0 to 1; None = not used.
        round_trip_scale_px: round trip that does; None = not used.
        half_error: expected error h at which the score is one half.
        recalibration: elementwise, score → probability that the error is below 10 %, such as the table of a
            calibration (``dhtorch.metrics.calibration``); None = unchanged score. An increasing one keeps the order.
        min_score: answers below it (after recalibration) become unanswered with LOW_SCORE.

    Returns:
        Estimate with ``score`` in [0, 1], 0 where unanswered or without an expected error.

    Raises:
        ValueError: wrong shapes.

    Gradient: to sigma, depth, residual and the other terms used; the threshold carries none.
    """
    terms = [(estimate.residual_px, residual_scale_px)]
    if photometric_scale is not None:
        terms.append((tracks.photometric, photometric_scale))
    if round_trip_scale_px is not None:
        terms.append((tracks.error, round_trip_scale_px))
    expected, stated = _expected_error(estimate, terms)
    return _scored(estimate, expected, stated, half_error, min_score, recalibration)


@shaped("estimate.gate: B N, samples.uv: B N 2, tracks.valid: B N")
def confidence_from_sigma(
    estimate: Estimate,
    samples: Samples,
    tracks: Tracks,
    fit: PoseFit,
    *,
    half_error: float = 0.1,
    recalibration: Callable[[Tensor], Tensor] | None = None,
    min_score: float = 0.0,
) -> Estimate:
    """Score of every answer of several views from its sigma and the number of agreeing views: h / (h + e).

    e = sigma / depth / √views: agreeing views have too much in common for sigma to shrink with their number, but an
    answer that is wrong by far more than its sigma is seldom repeated by another view.

    Args:
        estimate: from ``fuse``, or from stage 6 (one view).
        samples, tracks, fit: part of the stage's signature, not used.
        half_error, recalibration, min_score: as in :func:`confidence_from_error`.

    Returns:
        Estimate with ``score`` in [0, 1], 0 where unanswered or without an expected error.

    Raises:
        ValueError: wrong shapes.

    Gradient: to sigma and depth; the threshold carries none.
    """
    stated = estimate.keep & (estimate.depth > 0) & estimate.sigma.isfinite()
    depth, sigma = (torch.where(stated, x, 1.0) for x in (estimate.depth, estimate.sigma))
    expected = (sigma / depth).clamp(max=MAX_RATIO) / (estimate.n_views - 1).clamp_min(1).to(depth).sqrt()
    return _scored(estimate, expected, stated, half_error, min_score, recalibration)


@shaped("estimate.gate: B N, samples.uv: B N 2, tracks.valid: B N, fit.inlier: B N")
def score_features(estimate: Estimate, samples: Samples, tracks: Tracks, fit: PoseFit) -> tuple[Tensor, Tensor]:
    """Features of every answer for a learned score: logarithms (B, N, 8) in the order of :data:`SCORE_FEATURES`.

    Returns:
        The logarithms, 0 where there is no answer with a sigma, and a mask (B, N) of where there is.

    Raises:
        ValueError: wrong shapes.

    Gradient: to depth, sigma, parallax and residual; zero beyond the limits and where there is no answer.
    """
    terms = [(estimate.residual_px, 0.5), (tracks.error, 0.4)]
    expected, stated = _expected_error(estimate, terms)
    evidence = (estimate.parallax_deg, estimate.residual_px, tracks.error, tracks.photometric, samples.trackability)
    for x in evidence:
        stated = stated & x.isfinite()
    depth = torch.where(stated, estimate.depth, 1.0)
    inlier = fit.inlier & (samples.depth > 0)
    total = torch.where(inlier, samples.depth, 0.0).sum(-1, keepdim=True)
    mean_near_depth = total / inlier.sum(-1, keepdim=True).clamp_min(1)
    reach = depth / torch.where(mean_near_depth > 0, mean_near_depth, 1.0)
    shared = torch.where(stated, estimate.sigma_shared, 0.0) / depth
    columns = (expected, shared, *(torch.where(stated, x, 1.0) for x in evidence), reach)
    logarithms = [
        pad_elementwise(torch.log, x.clamp(*limits)) for x, limits in zip(columns, SCORE_FEATURES.values(), strict=True)
    ]
    return torch.stack([torch.where(stated, x, 0.0) for x in logarithms], -1), stated


class LearnedScore(nn.Module):
    """Stage 7 with trained weights: estimate, samples, tracks, fit -> estimate with the score h / (h + e).

    e = exp(g(x)) times the expected error of :func:`confidence_from_error`, g a network with one hidden layer.
    Untrained, g is 0 and the score that of ``confidence_from_error``. Train it on answers with truth by
    :func:`expected_error_loss`; it is stored as JSON or through ``state_dict``.

    Args:
        hidden: width of the hidden layer.
        half_error: e at which the score is one half.
        min_score: answers below it become unanswered with LOW_SCORE.
        seed: of the first layer's weights.

    Gradient: to the weights, and through :func:`score_features`; the threshold carries none.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, hidden: int = 16, *, half_error: float = 0.1, min_score: float = 0.0, seed: int = 0) -> None:
        super().__init__()
        n = len(SCORE_FEATURES)
        weights = torch.rand(hidden, n + 1, generator=torch.Generator().manual_seed(seed)) * 2 - 1
        self.register_buffer("mean", torch.zeros(n))  # of the evidence it is trained on
        self.register_buffer("spread", torch.ones(n))
        self.first = nn.Parameter(weights[:, :n] / n**0.5)  # (hidden, 8)
        self.first_bias = nn.Parameter(weights[:, n] / n**0.5)
        self.last = nn.Parameter(torch.zeros(hidden))
        self.last_bias = nn.Parameter(torch.zeros(()))
        self.half_error, self.min_score = half_error, min_score
        self.provenance: dict[str, Any] = {}

    def forward(self, estimate: Estimate, samples: Samples, tracks: Tracks, fit: PoseFit) -> Estimate:
        """The estimate with its score; 0 where unanswered or without an expected error."""
        x, stated = score_features(estimate, samples, tracks, fit)
        expected = pad_elementwise(torch.exp, self.log_error(x))
        return _scored(estimate, expected, stated, self.half_error, self.min_score)

    def log_error(
        self,
        x: Tensor,  # (…, 8) evidence
    ) -> Tensor:
        """Logarithm (…) of the expected relative error. Sums are written out: no answer depends on its batch."""
        z = (x - self.mean.to(x)) / self.spread.to(x)
        first = self.first.to(x)
        hidden = self.first_bias.to(x).expand(*x.shape[:-1], -1)
        for k in range(x.shape[-1]):
            hidden = hidden + z[..., k, None] * first[:, k]
        hidden = hidden / (1 + hidden.abs())
        correction = self.last_bias.to(x).expand(x.shape[:-1])
        for k, weight in enumerate(self.last.to(x).unbind()):
            correction = correction + weight * hidden[..., k]
        return x[..., 0] + MAX_LOG_FACTOR * correction / (MAX_LOG_FACTOR + correction.abs())

    def to_json(self) -> str:
        """Weights, options and provenance as strict JSON. It contains nothing executable."""
        weights = {k: v.tolist() for k, v in self.state_dict().items()}
        options = {"half_error": self.half_error, "min_score": self.min_score}
        content = {"evidence": [*SCORE_FEATURES], **options, "weights": weights, "provenance": self.provenance}
        return storage.dump_strict_json(content, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str, where: str = "learned score") -> Self:
        """The scorer that :meth:`to_json` wrote.

        Raises:
            ValueError: not strict JSON, other evidence, or weights of another shape; the message names ``where``.
        """
        try:
            content = storage.parse_strict_json(text)
            if content["evidence"] != [*SCORE_FEATURES]:
                raise ValueError(f"evidence is {content['evidence']}")
            weights = {k: torch.tensor(v, dtype=torch.float32) for k, v in content["weights"].items()}
            half_error, min_score = float(content["half_error"]), float(content["min_score"])
            scorer = cls(len(weights["last"]), half_error=half_error, min_score=min_score)
            scorer.load_state_dict(weights)
            scorer.provenance = dict(content["provenance"])
        except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(
                f"{where}: found {reason}, expected a learned score on {', '.join(SCORE_FEATURES)}"
            ) from error
        return scorer

    def save(self, path: str | Path) -> Path:
        """Write :meth:`to_json` to a file."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.to_json(), encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """The scorer in that file. Raises FileNotFoundError, or ValueError naming the file as :meth:`from_json`."""
        return cls.from_json(storage.read_utf8(path), str(path))


@shaped("log_error: n, error: n, weight: n")
def expected_error_loss(
    log_error: Tensor,  # (n,) of the scorer
    error: Tensor,  # (n,) actual relative error
    weight: Tensor,  # (n,) adds up to 1
) -> Tensor:
    """Loss of expected errors e: Σ w (ln e + min(error, 1) / e), least where e is the mean error of such answers.

    The negative log-likelihood of an exponential distribution. Its optimum is the mean, as the risk of selected answers
    is one, and it compares ratios: 1 % expected for 2 % is as wrong as 10 % for 20 %.

    Gradient: to ``log_error``. Raises ValueError for wrong shapes.
    """
    return (weight * (log_error + error.clamp(max=1) * (-log_error).exp())).sum()


def _expected_error(estimate: Estimate, terms: list[tuple[Tensor, float]]) -> tuple[Tensor, Tensor]:
    """Expected relative error (B, N) from the own part of sigma and (term, scale) pairs, and where it is defined."""
    whole, shared, depth = estimate.sigma, estimate.sigma_shared, estimate.depth
    stated = estimate.keep & (depth > 0) & whole.isfinite() & shared.isfinite()
    for x, _ in terms:
        stated = stated & x.isfinite()
    inverse = 1 / torch.where(stated, depth, 1.0)
    whole = (torch.where(stated, whole, 1.0) * inverse).clamp(max=MAX_RATIO)
    shared = (torch.where(stated, shared, 0.0) * inverse).clamp(max=MAX_RATIO)
    # The own part is at least 1e-6 of a variance; squares stay in the range of float32.
    own = torch.maximum(whole * whole - shared * shared, 1e-6 * whole * whole).clamp_min(1e-12)
    spread = torch.ones_like(depth)
    for x, scale in terms:
        ratio = (torch.where(stated, x, 0.0) / scale).clamp(max=MAX_RATIO)
        spread = spread + ratio * ratio
    return (own * spread).sqrt(), stated


def _scored(
    estimate: Estimate,
    expected: Tensor,
    stated: Tensor,
    half_error: float,
    min_score: float,
    recalibration: Callable[[Tensor], Tensor] | None = None,
) -> Estimate:
    """The estimate with the score h / (h + e), recalibrated, 0 where no error e is stated, under its threshold."""
    score = torch.where(stated, half_error / (half_error + expected), 0.0)
    if recalibration is not None:
        score = torch.where(stated, recalibration(score), 0.0)
    return _apply_min_score(estimate, score, min_score)


def _apply_min_score(estimate: Estimate, score: Tensor, min_score: float) -> Estimate:
    """The estimate with its score; answers below ``min_score`` become unanswered with LOW_SCORE."""
    score = torch.where(estimate.keep, score, 0.0)
    return estimate.replace(score=score).withheld(score < min_score, Gate.LOW_SCORE)
