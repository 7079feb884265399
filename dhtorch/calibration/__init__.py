"""Calibrations that travel with the package, one JSON file each, and files of the user's own.

    calibration = dhtorch.calibration.load_calibration("map")
    score = functools.partial(rank_by_error, recalibration=calibration.probability)

Fit one with :func:`dhtorch.calibration.score_calibration.fit_calibration`, on scenes with truth, and keep it with
:func:`save_calibration`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from dhtorch.calibration.score_calibration import Calibration, parse_calibration

#: What a file that is kept must say of its origin.
_REQUIRED_PROVENANCE = ("method", "scenes")


def list_calibrations() -> list[str]:
    """Names of the calibrations that travel with the package."""
    return sorted(file.stem for file in Path(__file__).parent.glob("*.json"))


def load_calibration(name: str | Path) -> Calibration:
    """The calibration of that name, or in that file.

    Args:
        name: one of :func:`list_calibrations`, or the path of a ``.json`` file.

    Raises:
        FileNotFoundError: no such calibration.
        ValueError: not a valid calibration; the message names file and field.
    """
    path = Path(name)
    if path.suffix != ".json":
        path = Path(__file__).parent / f"{name}.json"
    if not path.is_file():
        raise FileNotFoundError(f"{name}: found no calibration, expected a .json file or one of {list_calibrations()}")
    return parse_calibration(path.read_text(encoding="utf-8"), path.name)


def load_probability(name: str | Path) -> Callable[[Tensor], Tensor]:
    """Only the table from score to the probability of a good answer: what ``rank_by_error(recalibration=)`` takes."""
    return load_calibration(name).probability


def save_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration as JSON.

    Raises:
        ValueError: its provenance does not say which method and scenes it was fitted on.
    """
    for field in _REQUIRED_PROVENANCE:
        if not calibration.provenance.get(field):
            raise ValueError(f"{path}: found no provenance.{field}, expected what the calibration was fitted on")
    text = calibration.to_json()
    parse_calibration(text, str(path))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path
