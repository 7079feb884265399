"""Unit of stored depth: metres of one step, and what states it."""

from dataclasses import dataclass
from typing import Final

#: Name of a unit → metres.
UNIT_METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}


@dataclass(frozen=True)
class DepthUnit:
    """Metres of one step of the stored depth, and the source of that value.

    ``source`` names the file and field, the option, or the format's definition that states the unit. None = nothing
    states it: the value is the convention of the layout, an assumption that every command reports.
    """

    metres: float
    source: str | None = None

    @property
    def is_assumed(self) -> bool:
        """Whether nothing states the unit."""
        return self.source is None

    def __str__(self) -> str:
        """``depth unit assumed: 1/1000 m``, or ``depth unit: 1/1000 m (scene_camera.json: depth_scale)``."""
        steps = format_unit(self.metres)
        return f"depth unit assumed: {steps}" if self.source is None else f"depth unit: {steps} ({self.source})"


def format_unit(metres: float) -> str:
    """Metres of one step as text: ``1/1000 m``, or ``0.0254 m`` where its inverse is not a whole number."""
    inverse = 1 / metres
    if metres < 1 and abs(inverse - round(inverse)) < 1e-6 * inverse:
        return f"1/{round(inverse)} m"
    return f"{metres:g} m"


def parse_unit(unit: str | float) -> float:
    """``m``, ``cm``, ``mm``, ``inch``, a fraction of a metre such as ``1/5000``, or metres of one step → metres.

    Raises:
        ValueError: anything else.
    """
    metres: object = unit
    if isinstance(unit, str):
        if unit in UNIT_METRES:
            return UNIT_METRES[unit]
        numerator, _, denominator = unit.removesuffix("m").strip().partition("/")
        try:
            metres = float(numerator) / float(denominator or 1)
        except (ValueError, ZeroDivisionError):
            metres = None
    if isinstance(metres, int | float) and not isinstance(metres, bool) and 0 < metres < float("inf"):
        return float(metres)
    raise ValueError(f"depth_unit: found {unit!r}, expected {', '.join(UNIT_METRES)}, 1/5000, or metres of one step")
