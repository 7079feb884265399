"""Calibrations that travel with the package, one JSON file each, and files of the user's own.

    calibration = dhtorch.calibration.load("map")
    score = functools.partial(rank_by_error, recalibration=calibration.probability)

Fit one with :func:`dhtorch.calibration.score_calibration.fit`, on scenes with truth, and keep it with :func:`save`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from dhtorch.calibration.score_calibration import Calibration, from_json

#: What a file that is kept must say of its origin.
PROVENANCE = ("method", "scenes")


def available() -> list[str]:
    """Names of the calibrations that travel with the package."""
    return sorted(file.stem for file in Path(__file__).parent.glob("*.json"))


def load(name: str | Path) -> Calibration:
    """The calibration of that name, or in that file.

    Args:
        name: one of :func:`available`, or the path of a ``.json`` file.

    Raises:
        FileNotFoundError: no such calibration.
        ValueError: not a valid calibration; the message names file and field.
    """
    path = Path(name)
    if path.suffix != ".json":
        path = Path(__file__).parent / f"{name}.json"
    if not path.is_file():
        raise FileNotFoundError(f"{name}: found no calibration, expected a .json file or one of {available()}")
    return from_json(path.read_text(encoding="utf-8"), path.name)


def probability(name: str | Path) -> Callable[[Tensor], Tensor]:
    """Only the table from score to the probability of a good answer: what ``rank_by_error(recalibration=)`` takes."""
    return load(name).probability


def save(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration as JSON.

    Raises:
        ValueError: its provenance does not say which method and scenes it was fitted on.
    """
    for field in PROVENANCE:
        if not calibration.provenance.get(field):
            raise ValueError(f"{path}: found no provenance.{field}, expected what the calibration was fitted on")
    text = calibration.to_json()
    from_json(text, str(path))
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path
