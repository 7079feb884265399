"""K of a capture that does not say it: from an option, whoever the reader is, or a refusal that names the options.

``intrinsics`` is one option for all: a feature's name where a format has features, four numbers fx fy cx cy, or one
number, the field of view from side to side in degrees. ``K`` and ``fov`` say the last two alone. A K from a field of
view is a guess (square pixels around the picture's centre, no distortion), and is called one wherever it is used.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dhtorch.data.io.decode import FormatError, to_array

#: Of every reader whose captures may lack a K; nothing said to another reader is no option of its.
INTRINSICS_OPTIONS = ("intrinsics", "K", "fov")

#: How a report begins that says a K is guessed.
_GUESS_PREFIX = "intrinsics are a guess"

#: A feature's name, degrees from side to side, or fx, fy, cx, cy.
IntrinsicsOption = str | float | Sequence[float]


class MissingIntrinsicsError(FormatError):
    """Nobody says K of a camera: nothing can be measured in it, though it can be looked at."""


@dataclass(frozen=True)
class ParsedIntrinsics:
    """What the options say of a camera."""

    K: tuple[float, ...] | None = None  # fx, fy, cx, cy in px
    feature: str | None = None  # the name of one that holds K
    report: tuple[str, ...] = ()  # that it is a guess


def parse_intrinsics(
    root: Path,
    hw: tuple[int, int],
    intrinsics: IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
) -> ParsedIntrinsics:
    """What the three options say of a camera whose pictures have the size ``hw``; a guess is warned of.

    Raises:
        FormatError: more than one of them, no angle that a picture can see, or no four numbers.
    """
    said = {
        name: value for name, value in zip(INTRINSICS_OPTIONS, (intrinsics, K, fov), strict=True) if value is not None
    }
    if not said:
        return ParsedIntrinsics()
    if len(said) > 1:
        raise FormatError(root, "options", " and ".join(f"data.{name}" for name in said), "one of them")
    ((name, value),) = said.items()
    if isinstance(value, str):
        return ParsedIntrinsics(feature=value)
    if isinstance(value, int | float) and name != "K":
        numbers = _intrinsics_from_fov(value, hw, root, name)
        report = (
            f"{_GUESS_PREFIX} from a field of view of {value:g}° (data.{name}): depth and sigma hold as far as it does"
        )
        warnings.warn(f"{root.resolve().name}: {report}", stacklevel=2)
        return ParsedIntrinsics(numbers, report=(report,))
    return ParsedIntrinsics(tuple(to_array(value, (4,), root, f"option {name}").tolist()))


def _intrinsics_from_fov(degrees: float, hw: tuple[int, int], root: Path, name: str = "fov") -> tuple[float, ...]:
    """fx, fy, cx, cy of a picture that sees so many degrees from side to side."""
    if isinstance(degrees, bool) or not 1 <= degrees < 179:
        raise FormatError(root, f"option {name}", degrees, "1 to 179 degrees from side to side")
    h, w = hw
    f = float(w / 2 / np.tan(np.radians(degrees) / 2))
    return f, f, (w - 1) / 2, (h - 1) / 2


def find_guess_report(report: Sequence[str]) -> str | None:
    """What a recording's report says of a guessed K, if it is one."""
    return next((line for line in report if line.startswith(_GUESS_PREFIX)), None)


def missing_intrinsics_error(
    root: Path, camera: str | None, *others: str, depth: bool = True
) -> MissingIntrinsicsError:
    """The refusal of a camera whose K nobody says.

    Args:
        root: the capture.
        camera: its name, where there are several.
        others: what else would say it, in words.
        depth: whether it has depth; without any a K alone gives no metre.
    """
    found = "no intrinsics" if depth else "no intrinsics (nor depth: it can be looked at, and nothing be recovered)"
    ways = ["data.fov=69 (degrees from side to side, a guess)", "data.K=[fx,fy,cx,cy]", *others]
    return MissingIntrinsicsError(root, camera or "K", found, f"{', '.join(ways[:-1])} or {ways[-1]}")
