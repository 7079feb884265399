"""Calibration of scores and sigmas: fitted on scenes with ground truth, applied to the estimates of others.

A calibration is stored as a small JSON text: two tables of the score (probability of a good answer, expected error), a
sigmoid as a simple baseline, a correction of sigma, thresholds chosen by plug-in risk control, and its provenance.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor

from dhtorch.calibration.monotone import MonotoneTable, Sigmoid, fit_isotonic, fit_platt
from dhtorch.metrics import control
from dhtorch.metrics.errors import Points
from dhtorch.metrics.reliability import GOOD_ERROR_REL, pool_answers
from dhtorch.metrics.risk import cap_error
from dhtorch.records import DepthMap, SigmaBudget
from dhtorch.runtime import storage

_SCHEMA_VERSION = 1

Answers = TypeVar("Answers", Points, DepthMap)

#: Least fraction of the fitting scenes' weight in a step of a table.
_MIN_STEP_SHARE = 0.02

#: Probability that a normal variable lies within one standard deviation.
_ONE_SIGMA_SHARE = 0.6826894921370859

#: Fraction required within two standard deviations: less than the 95 % of a normal variable, because errors have
#: heavier tails and a few gross ones would widen every sigma; slightly above 90 %, to hold 90 % in other rooms.
_TWO_SIGMA_SHARE = 0.91

#: Target mean errors, in per cent, for which thresholds are stored.
_TARGET_ERRORS_PERCENT = (5, 10, 20)


#: Floors of sigma tried, as fractions of the depth.
_SIGMA_FLOORS_REL = (0.0, *(1e-4 * 10 ** (k / 10) for k in range(31)))


@dataclass(frozen=True)
class SigmaModel:
    """Correction of a stated sigma: a scale, and a floor as a fraction of the depth added in quadrature."""

    scale: float  # of the stated sigma; for noise stated too small, or common to all points
    floor: float  # errors not in any stated noise: lens, calibration, the point that a patch represents

    def __call__(self, sigma: Tensor, depth: Tensor) -> Tensor:
        """sqrt((scale · sigma)² + (floor · depth)²), in the unit of both."""
        return ((self.scale * sigma).square() + (self.floor * depth).square()).sqrt()

    def corrected_parts(self, parts: SigmaBudget, stated: Tensor, corrected: Tensor) -> SigmaBudget:
        """Variances by cause of a ``stated`` sigma -> those of the ``corrected``: a scale below one shrinks all terms,
        what scale and floor add is in ``model``."""
        parts = parts.map(lambda x: min(self.scale, 1.0) ** 2 * x)
        added = corrected.square() - (min(self.scale, 1.0) * stated).square()
        return parts.replace(model=parts.model + added.clamp_min(0))


@dataclass(frozen=True)
class Calibration:
    """Calibrated meaning of a score and a sigma, fitted on the scenes named in ``provenance``."""

    probability: MonotoneTable  # score → P(relative error < 10 %)
    expected_error: MonotoneTable  # score → mean capped relative error
    sigmoid: Sigmoid  # score in [0, 1] → P(relative error < 10 %), the baseline
    sigma: SigmaModel | None  # None = no sigma was stated
    thresholds: Mapping[int, float | None]  # mean error in per cent → threshold on the score; None = none is feasible
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def apply(self, scene: Answers) -> Answers:
        """The same answers, of a scene or of a depth map, with calibrated score and sigma."""
        score = torch.where(scene.keep, self.probability(scene.score), 0.0).to(scene.score)
        if self.sigma is None:
            return scene.replace(score=score)
        sigma = self.sigma(scene.sigma, scene.depth)
        if isinstance(scene, DepthMap) and scene.parts is not None:
            scene = scene.replace(parts=self.sigma.corrected_parts(scene.parts, scene.sigma, sigma))
        return scene.replace(score=score, sigma=sigma)

    def min_score(self, percent: int) -> float | None:
        """The threshold for a mean error of ``percent``, on the calibrated score; None = answer nothing.

        Raises:
            KeyError: no threshold was fitted for that target.
        """
        threshold = self.thresholds[percent]
        return None if threshold is None else float(self.probability(torch.tensor(threshold, dtype=torch.float64)))

    def to_json(self) -> str:
        """The calibration as strict JSON."""
        content = {
            "schema": _SCHEMA_VERSION,
            "good_error": GOOD_ERROR_REL,
            "probability": _corners(self.probability),
            "expected_error": _corners(self.expected_error),
            "sigmoid": {"slope": float(self.sigmoid.slope), "offset": float(self.sigmoid.offset)},
            "sigma": None if self.sigma is None else {"scale": self.sigma.scale, "floor": self.sigma.floor},
            "thresholds": {str(k): v for k, v in self.thresholds.items()},
            "provenance": dict(self.provenance),
        }
        return storage.dump_strict_json(content, indent=1) + "\n"


def fit_calibration(
    scenes: Sequence[Points],
    *,
    min_share: float = _MIN_STEP_SHARE,
    targets: Sequence[int] = _TARGET_ERRORS_PERCENT,
    choose: Callable[[Sequence[Points], float], control.ScoreThreshold] = control.plug_in_threshold,
    provenance: Mapping[str, Any] | None = None,
) -> Calibration:
    """Fit a calibration of scores and sigmas on scenes with ground truth; every scene has the same weight.

    Args:
        scenes: candidates with answers, scores and, where stated, sigmas; any depth source.
        min_share: least fraction of the weight in a step of a table.
        targets: mean errors, in per cent, for which thresholds are chosen.
        choose: the risk control that chooses them, such as :func:`dhtorch.metrics.control.scene_quantile_threshold`.
        provenance: origin of the scenes, as JSON values; ``n_scenes`` and ``n_answers`` are added. A saved file
            needs ``method`` and ``scenes``.

    Raises:
        ValueError: no answer in any scene.
    """
    score, good, weight = pool_answers(scenes)
    if not score.numel():
        raise ValueError("fit_calibration: found no answer in any scene, expected at least one")
    loss = cap_error(torch.cat([s.answered().error for s in scenes]))
    ends = (0.0, 1.0) if bool(((score >= 0) & (score <= 1)).all()) else None
    note = {**(provenance or {}), "n_scenes": sum(bool(s.keep.any()) for s in scenes), "n_answers": score.numel()}
    return Calibration(
        probability=fit_isotonic(score, good.double(), weight, min_share=min_share, ends=ends),
        expected_error=fit_isotonic(score, loss, weight, rising=False, min_share=min_share, ends=ends),
        sigmoid=fit_platt(score, good, weight),
        sigma=fit_sigma_model(scenes),
        thresholds={percent: choose(scenes, percent / 100).threshold for percent in targets},
        provenance=note,
    )


def fit_sigma_model(scenes: Sequence[Points]) -> SigmaModel | None:
    """Sigma correction after which 68 % of the answers lie within one sigma and at least 91 % within two.

    Scenes have the same weight. For every floor the scale follows from the 68 %; of all these pairs the one with the
    largest likelihood of the errors is taken (Student's t with three degrees of freedom, robust to gross errors). If
    fewer than 91 % then lie within two sigmas, scale and floor are widened until they do.

    Returns:
        SigmaModel; None if no sigma is stated.
    """
    errors, sigmas, weights = [], [], []
    for scene in scenes:
        answered = scene.answered()
        stated = answered.sigma.isfinite() & (answered.sigma > 0)
        error = ((answered.depth - answered.true_depth).abs() / answered.depth)[stated]
        errors.append(error)
        sigmas.append((answered.sigma / answered.depth)[stated])
        weights.append(torch.full_like(error, 1 / max(error.numel(), 1)))
    if not sum(e.numel() for e in errors):
        return None
    error, sigma, weight = torch.cat(errors), torch.cat(sigmas), torch.cat(weights)
    best, lowest_cost = SigmaModel(1.0, 0.0), math.inf
    for floor in _SIGMA_FLOORS_REL:
        scale = (
            _quantile((error.square() - floor * floor) / sigma.square(), weight, _ONE_SIGMA_SHARE).clamp_min(0).sqrt()
        )
        model = SigmaModel(float(scale), floor)
        spread = model(sigma, torch.ones_like(sigma)).clamp_min(torch.finfo(sigma.dtype).tiny)
        cost = float((weight * (2 * torch.log1p((error / spread).square() / 3) + spread.log())).sum())
        best, lowest_cost = (model, cost) if cost < lowest_cost else (best, lowest_cost)
    spread = best(sigma, torch.ones_like(sigma)).clamp_min(torch.finfo(sigma.dtype).tiny)
    wider = max(1.0, float(_quantile(error / spread, weight, _TWO_SIGMA_SHARE)) / 2)
    return SigmaModel(best.scale * wider, best.floor * wider)


def _quantile(x: Tensor, weight: Tensor, share: float) -> Tensor:
    """Weighted quantile: the smallest value with at least the fraction ``share`` of the weight at or below it."""
    order = x.argsort()
    below = weight[order].cumsum(0) / weight.sum()
    k = torch.searchsorted(below, torch.tensor(share, dtype=below.dtype, device=below.device))
    return x[order][k.clamp(max=x.numel() - 1)]


def parse_calibration(text: str, where: str = "calibration") -> Calibration:
    """Parse a calibration from the JSON text of :meth:`Calibration.to_json`.

    Args:
        text: content of the file.
        where: name of the file, for messages.

    Raises:
        ValueError: not strict JSON, or a field is missing, unknown or out of range; the message names file and field.
    """
    try:
        content = storage.parse_strict_json(text)
    except ValueError as error:
        raise ValueError(f"{where}: found no strict JSON ({error}), expected a calibration") from error
    names = ("schema", "good_error", "probability", "expected_error", "sigmoid", "sigma", "thresholds")
    _fields(content, (*names, "provenance"), where)
    for name, value in (("schema", _SCHEMA_VERSION), ("good_error", GOOD_ERROR_REL)):
        _expect(content[name] == value, f"{where}.{name}", content[name], str(value))
    _fields(content["sigmoid"], ("slope", "offset"), f"{where}.sigmoid")
    slope, offset = (_number(content["sigmoid"][k], f"{where}.sigmoid.{k}") for k in ("slope", "offset"))
    _expect(isinstance(content["provenance"], dict), f"{where}.provenance", content["provenance"], "an object")
    return Calibration(
        probability=_read_table(content["probability"], f"{where}.probability", rising=True),
        expected_error=_read_table(content["expected_error"], f"{where}.expected_error", rising=False),
        sigmoid=Sigmoid(torch.tensor(slope, dtype=torch.float64), torch.tensor(offset, dtype=torch.float64)),
        sigma=None if content["sigma"] is None else _read_sigma(content["sigma"], f"{where}.sigma"),
        thresholds=_read_thresholds(content["thresholds"], f"{where}.thresholds"),
        provenance=content["provenance"],
    )


def _corners(table: MonotoneTable) -> dict[str, list[float]]:
    return {"score": table.x.tolist(), "value": table.y.tolist()}


def _read_table(content: Any, where: str, *, rising: bool) -> MonotoneTable:
    _fields(content, ("score", "value"), where)
    columns: dict[str, Tensor] = {}
    for name in ("score", "value"):
        _expect(isinstance(content[name], list) and content[name] != [], f"{where}.{name}", content[name], "a list")
        numbers = [_number(v, f"{where}.{name}.{k}") for k, v in enumerate(content[name])]
        columns[name] = torch.tensor(numbers, dtype=torch.float64)
    x, y = content["score"], content["value"]
    _expect(len(x) == len(y), f"{where}.value", f"{len(y)} numbers", f"{len(x)}, one for each score")
    _expect(all(a < b for a, b in pairwise(x)), f"{where}.score", x, "rising numbers")
    ordered = all((a <= b) if rising else (a >= b) for a, b in pairwise(y))
    _expect(ordered and all(0 <= v <= 1 for v in y), f"{where}.value", y, f"{_direction(rising)} numbers from 0 to 1")
    return MonotoneTable(columns["score"], columns["value"])


def _read_sigma(content: Any, where: str) -> SigmaModel:
    _fields(content, ("scale", "floor"), where)
    for name in ("scale", "floor"):
        _expect(
            _number(content[name], f"{where}.{name}") >= 0, f"{where}.{name}", content[name], "a number of at least 0"
        )
    return SigmaModel(float(content["scale"]), float(content["floor"]))


def _read_thresholds(content: Any, where: str) -> dict[int, float | None]:
    _expect(isinstance(content, dict), where, content, "an object")
    thresholds: dict[int, float | None] = {}
    for name, value in content.items():
        _expect(
            name.isdecimal() and len(name) <= 2 and int(name) > 0, f"{where}.{name}", name, "a whole number of per cent"
        )
        thresholds[int(name)] = None if value is None else _number(value, f"{where}.{name}")
    return thresholds


def _direction(rising: bool) -> str:
    return "rising" if rising else "falling"


def _fields(content: Any, names: Sequence[str], where: str) -> None:
    _expect(isinstance(content, dict), where, content, "an object")
    for name in names:
        _expect(name in content, f"{where}.{name}", "nothing", "a value")
    for name in content:
        _expect(name in names, f"{where}.{name}", "an unknown field", ", ".join(names))


def _number(value: Any, where: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_finite = is_number and abs(value) <= sys.float_info.max
    _expect(is_finite, where, value, "a finite number")
    return float(value)


def _expect(condition: bool, where: str, actual: Any, expected: str) -> None:
    if not condition:
        text = actual if isinstance(actual, str) else storage.dump_strict_json(actual)
        raise ValueError(f"{where}: found {text if len(text) <= 60 else text[:57] + '...'}, expected {expected}")
