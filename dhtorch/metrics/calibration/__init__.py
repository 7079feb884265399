"""Calibration of scores and sigmas: fitted on scenes with ground truth, applied to the estimates of others.

A calibration is stored as a small JSON text: two tables of the score (probability of a good answer, expected error), a
sigmoid as a simple baseline, a correction of sigma, thresholds chosen by plug-in risk control, and its provenance.
Those shipped with the package are loaded by name:

    calibration = dhtorch.metrics.calibration.load_calibration("map")
    score = functools.partial(rank_by_error, recalibration=calibration.probability)
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from dhtorch.metrics.errors import GOOD_ERROR_REL, Points
from dhtorch.metrics.monotone import MonotoneTable, Sigmoid
from dhtorch.records import DepthMap, SigmaBudget
from dhtorch.runtime import storage

Answers = TypeVar("Answers", Points, DepthMap)

#: Calibrations shipped with the package, one JSON file each.
_SHIPPED = Path(__file__).parent

#: Values that every file of this layout has.
_LAYOUT = {"schema": 1, "good_error": GOOD_ERROR_REL}


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
            **_LAYOUT,
            "probability": {"score": self.probability.x.tolist(), "value": self.probability.y.tolist()},
            "expected_error": {"score": self.expected_error.x.tolist(), "value": self.expected_error.y.tolist()},
            "sigmoid": {"slope": float(self.sigmoid.slope), "offset": float(self.sigmoid.offset)},
            "sigma": None if self.sigma is None else {"scale": self.sigma.scale, "floor": self.sigma.floor},
            "thresholds": {str(k): v for k, v in self.thresholds.items()},
            "provenance": dict(self.provenance),
        }
        return storage.dump_strict_json(content, indent=1) + "\n"


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
    tables = {"probability": True, "expected_error": False}  # name -> whether it rises
    _fields(content, (*_LAYOUT, *tables, "sigmoid", "sigma", "thresholds", "provenance"), where)
    for name, value in _LAYOUT.items():
        _expect(content[name] == value, f"{where}.{name}", content[name], str(value))
    numbers = {}
    for name, keys in {"sigmoid": ("slope", "offset"), "sigma": ("scale", "floor")}.items():
        if name == "sigmoid" or content[name] is not None:
            _fields(content[name], keys, f"{where}.{name}")
            numbers[name] = [_number(content[name][k], f"{where}.{name}.{k}") for k in keys]
    for key, value in zip(("scale", "floor"), numbers.get("sigma", ()), strict=False):
        _expect(value >= 0, f"{where}.sigma.{key}", content["sigma"][key], "a number of at least 0")
    _expect(isinstance(content["provenance"], dict), f"{where}.provenance", content["provenance"], "an object")
    _expect(isinstance(content["thresholds"], dict), f"{where}.thresholds", content["thresholds"], "an object")
    thresholds = {}
    for name, value in content["thresholds"].items():
        field_name, is_percent = f"{where}.thresholds.{name}", name.isdecimal() and len(name) <= 2 and int(name) > 0
        _expect(is_percent, field_name, name, "a whole number of per cent")
        thresholds[int(name)] = None if value is None else _number(value, field_name)
    return Calibration(
        **{k: _read_table(content[k], f"{where}.{k}", rising=rises) for k, rises in tables.items()},
        sigmoid=Sigmoid(*(torch.tensor(v, dtype=torch.float64) for v in numbers["sigmoid"])),
        sigma=SigmaModel(*numbers["sigma"]) if "sigma" in numbers else None,
        thresholds=thresholds,
        provenance=content["provenance"],
    )


def list_calibrations() -> list[str]:
    """Names of the calibrations shipped with the package."""
    return sorted(file.stem for file in _SHIPPED.glob("*.json"))


def load_calibration(name: str | Path) -> Calibration:
    """Load a calibration by its name or from a file.

    Args:
        name: one of :func:`list_calibrations`, or the path of a ``.json`` file.

    Raises:
        FileNotFoundError: no such calibration.
        ValueError: not a valid calibration; the message names file and field.
    """
    path = Path(name) if Path(name).suffix == ".json" else _SHIPPED / f"{name}.json"
    if not path.is_file():
        raise FileNotFoundError(f"{name}: found no calibration, expected a .json file or one of {list_calibrations()}")
    return parse_calibration(storage.read_utf8(path), path.name)


def load_probability(name: str | Path) -> Callable[[Tensor], Tensor]:
    """The table from score to the probability of a good answer alone, for ``rank_by_error(recalibration=)``."""
    return load_calibration(name).probability


def save_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration as JSON.

    Raises:
        ValueError: its provenance lacks the method or the scenes that it was fitted on.
    """
    for name in ("method", "scenes"):
        if not calibration.provenance.get(name):
            raise ValueError(f"{path}: found no provenance.{name}, expected what the calibration was fitted on")
    text = calibration.to_json()
    parse_calibration(text, str(path))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def _read_table(content: Any, where: str, *, rising: bool) -> MonotoneTable:
    _fields(content, ("score", "value"), where)
    for name in ("score", "value"):
        _expect(isinstance(content[name], list) and content[name] != [], f"{where}.{name}", content[name], "a list")
    x, y = ([_number(v, f"{where}.{name}.{k}") for k, v in enumerate(content[name])] for name in ("score", "value"))
    _expect(len(x) == len(y), f"{where}.value", f"{len(y)} numbers", f"{len(x)}, one for each score")
    _expect(all(a < b for a, b in pairwise(x)), f"{where}.score", content["score"], "rising numbers")
    ordered = all((a <= b) if rising else (a >= b) for a, b in pairwise(y))
    expected = f"{'rising' if rising else 'falling'} numbers from 0 to 1"
    _expect(ordered and all(0 <= v <= 1 for v in y), f"{where}.value", content["value"], expected)
    return MonotoneTable(*(torch.tensor(v, dtype=torch.float64) for v in (x, y)))


def _fields(content: Any, names: Sequence[str], where: str) -> None:
    _expect(isinstance(content, dict), where, content, "an object")
    for name in names:
        _expect(name in content, f"{where}.{name}", "nothing", "a value")
    for name in content:
        _expect(name in names, f"{where}.{name}", "an unknown field", ", ".join(names))


def _number(value: Any, where: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    _expect(is_number and abs(value) <= sys.float_info.max, where, value, "a finite number")
    return float(value)


def _expect(condition: bool, where: str, actual: Any, expected: str) -> None:
    if not condition:
        text = actual if isinstance(actual, str) else storage.dump_strict_json(actual)
        raise ValueError(f"{where}: found {text if len(text) <= 60 else text[:57] + '...'}, expected {expected}")
