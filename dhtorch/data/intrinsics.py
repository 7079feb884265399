"""Intrinsics options for captures without a stored K, common to all readers, and the error where K is missing.

``intrinsics`` covers all three forms: the name of a feature where a format has features, four numbers fx fy cx cy, or
one number, the horizontal field of view in degrees. ``K`` and ``fov`` accept only the latter two. A K from a field of
view is a guess (square pixels, principal point at the image centre, no distortion), and is reported as such.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io.decode import FormatError, refuse_if, to_array
from dhtorch.records import Camera

#: Options of every reader whose captures may lack a K; unset (None), they are ignored by all other readers.
INTRINSICS_OPTIONS = ("intrinsics", "K", "fov")

#: First words of the report line on a guessed K.
_GUESS_PREFIX = "intrinsics are a guess"

#: Offset of a principal point from the middle of a picture, as a fraction of its sides, up to which K is that of the
#: picture as it lies and at its size. Source: chosen on K of the shared data, which are at most 0.04 off.
MAX_CENTRE_OFFSET = 0.06

#: A feature's name, the horizontal field of view in degrees, or fx, fy, cx, cy in px.
IntrinsicsOption = str | float | Sequence[float]


class MissingIntrinsicsError(FormatError):
    """K of a camera is neither stored nor set by an option: its images can be viewed but not measured."""

    def with_remarks(self, remarks: Sequence[str]) -> "MissingIntrinsicsError":
        """The error with remarks after what was found, such as files that may hold K and are not read."""
        file, field, value, expected = self.args
        return MissingIntrinsicsError(file, field, "; ".join((value, *remarks)), expected)


@dataclass(frozen=True)
class ParsedIntrinsics:
    """Intrinsics of a camera as set by the options."""

    K: tuple[float, ...] | None = None  # fx, fy, cx, cy in px
    feature: str | None = None  # name of the feature with K
    report: tuple[str, ...] = ()  # note that K is a guess


def parse_intrinsics(
    root: Path,
    hw: tuple[int, int],
    intrinsics: IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    *,
    features: bool = True,
) -> ParsedIntrinsics:
    """The three options and the image size ``hw`` → intrinsics of a camera; warns where K is a guess.

    Raises:
        FormatError: more than one option, an angle outside 1 to 179°, not four numbers, or the name of a feature where
            the format has no ``features``.
    """
    stated = {
        name: value for name, value in zip(INTRINSICS_OPTIONS, (intrinsics, K, fov), strict=True) if value is not None
    }
    if not stated:
        return ParsedIntrinsics()
    refuse_if(len(stated) > 1, root, "options", " and ".join(f"data.{name}" for name in stated), "one of them")
    ((name, value),) = stated.items()
    if isinstance(value, str):
        expected = "fx fy cx cy, or degrees (the format has no features)"
        refuse_if(not features, root, "option intrinsics", value, expected)
        return ParsedIntrinsics(feature=value)
    if isinstance(value, int | float) and name != "K":
        # Horizontal field of view in degrees → fx, fy, cx, cy in px, square pixels around the image centre
        refuse_if(
            isinstance(value, bool) or not 1 <= value < 179,
            root,
            f"option {name}",
            value,
            "1 to 179 degrees, the horizontal field of view",
        )
        h, w = hw
        f = float(w / 2 / np.tan(np.radians(value) / 2))
        numbers = f, f, (w - 1) / 2, (h - 1) / 2
        source = f"a field of view of {value:g}° (data.{name})"
        report = f"{_GUESS_PREFIX} from {source}: depth and sigma are as accurate as this guess"
        warnings.warn(f"{root.resolve().name}: {report}", stacklevel=2)
        return ParsedIntrinsics(numbers, report=(report,))
    return ParsedIntrinsics(tuple(to_array(value, (4,), root, f"option {name}").tolist()))


def parse_camera(root: Path, hw: tuple[int, int], *options: Any) -> tuple[Camera | None, tuple[str, ...]]:
    """The three options of a format without features → the camera that they set, if any, and the report."""
    option = parse_intrinsics(root, hw, *options, features=False)
    camera = None if option.K is None else convert.to_camera(convert.make_K(*option.K), hw, root, "option K")
    return camera, option.report


def find_guess_report(report: Sequence[str]) -> str | None:
    """The line on a guessed K in a recording's report; None where K is not guessed."""
    return next((line for line in report if line.startswith(_GUESS_PREFIX)), None)


def missing_intrinsics_error(
    root: Path, camera: str | None, *others: str, depth: bool = True
) -> MissingIntrinsicsError:
    """The error for a camera without K, which lists the options that would set it.

    Args:
        root: the capture.
        camera: its name, where there are several.
        others: further options of the reader that set K, as text.
        depth: whether the camera has depth; without depth, K alone gives no metric result.
    """
    problem = "no intrinsics" if depth else "no intrinsics (and no depth: it can be viewed, but no depth recovered)"
    remedies = ["data.fov=69 (horizontal field of view in degrees, a guess)", "data.K=[fx,fy,cx,cy]", *others]
    return MissingIntrinsicsError(root, camera or "K", problem, f"{', '.join(remedies[:-1])} or {remedies[-1]}")
