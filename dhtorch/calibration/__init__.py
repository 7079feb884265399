"""Loading and saving of score calibrations: those shipped with the package, one JSON file each, and the user's own.

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
from dhtorch.runtime import storage

#: Required entries of a saved calibration's ``provenance``.
_REQUIRED_PROVENANCE = ("method", "scenes")


def list_calibrations() -> list[str]:
    """Names of the calibrations shipped with the package."""
    return sorted(file.stem for file in Path(__file__).parent.glob("*.json"))


def load_calibration(name: str | Path) -> Calibration:
    """Load a calibration by its name or from a file.

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
    return parse_calibration(storage.read_utf8(path), path.name)


def load_probability(name: str | Path) -> Callable[[Tensor], Tensor]:
    """The table from score to the probability of a good answer alone, for ``rank_by_error(recalibration=)``."""
    return load_calibration(name).probability


def save_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration as JSON.

    Raises:
        ValueError: its provenance lacks the method or the scenes that it was fitted on.
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
