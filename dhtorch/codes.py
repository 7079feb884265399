"""Code tables: flags of a sample, reasons for a missing return, reasons for a withheld answer, sources and states.

Codes are plain integers (an ``IntEnum`` member compared with a tensor inside ``torch.compile(fullgraph=True)`` becomes
a Python bool). Published numbers are fixed; the names in the tables are those in results and figures.

A code is one entry: ``NAME: Final = code(number, definition, …)``. Descriptions and figures read the entries, so that a
new code has a text everywhere and, until ``viz.plots.colours`` defines one for it, a default colour.
"""

import re
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import torch
from torch import Tensor


@dataclass(frozen=True)
class _CodeEntry:
    """Number and texts of one code."""

    number: int
    definition: str  # the condition that sets it
    meaning: str  # the same as a short clause for messages; default: the definition
    advice: str = ""  # what to change in the next recording; empty = nothing
    retry: str = ""  # options of a job to try; empty = none


_pending: list[_CodeEntry] = []  # entries of the class body in execution


def code(number: int, definition: str, *, meaning: str = "", advice: str = "", retry: str = "") -> int:
    """The number of a code; adds its :class:`_CodeEntry` to the table whose class body calls this."""
    _pending.append(_CodeEntry(number, definition, meaning or definition, advice, retry))
    return number


class CodeTable:
    """Base of the code tables: class attributes are plain integers, ``entries`` maps them to their entries."""

    entries: ClassVar[dict[int, _CodeEntry]]

    def __init_subclass__(cls) -> None:
        cls.entries = {entry.number: entry for entry in _pending}
        _pending.clear()


class Flag(CodeTable):
    """Bits of ``Samples.flag``: several may be set at once. The first five are the paper's."""

    NO_DEPTH: Final = code(1, "the sensor gave no return at this pixel")
    LOW_CONF: Final = code(2, "the sensor's own confidence is below the accepted level")
    SPECULAR: Final = code(4, "a bright, colourless highlight: returns there are unreliable")
    SATURATED: Final = code(8, "the image is clipped at white")
    UNDEREXPOSED: Final = code(16, "the image is too dark to see texture")
    DEPTH_EDGE: Final = code(32, "returns around the pixel differ: foreground and background meet")
    BEYOND_NEAR: Final = code(64, "a return beyond the user's near limit; kept in ``depth``, not in ``xyz``")
    BORDER: Final = code(128, "too close to the image border for a full neighbourhood")

    #: Any of these bits makes a return unusable (``xyz`` is NaN).
    UNUSABLE: Final = NO_DEPTH | LOW_CONF | BEYOND_NEAR


class Hole(CodeTable):
    """Classes of ``Samples.hole``: the reason why a sample has no usable return."""

    NONE: Final = code(0, "not a hole: there is a usable return")
    TRACKABLE_NO_LIDAR: Final = code(1, "normal brightness, enough texture, no usable depth: the key class")
    LOW_TEXTURE: Final = code(2, "normal brightness, but nothing to track")
    TOO_BRIGHT: Final = code(3, "clipped at white")
    TOO_DARK: Final = code(4, "underexposed")
    HIGHLIGHT: Final = code(5, "a specular highlight, which moves with the viewer")
    AT_BORDER: Final = code(6, "at the image border, where no track can start")


class Route(CodeTable):
    """Suggestion how to fill a hole (one per :class:`Hole` class)."""

    NOTHING: Final = code(0, "")
    TRIANGULATE: Final = code(1, "")
    CHANGE_EXPOSURE: Final = code(2, "")
    GET_CLOSER: Final = code(3, "")
    TURN_HEAD: Final = code(4, "")


class Gate(CodeTable):
    """Codes of ``Estimate.gate``, in order of precedence: the first reason that holds is the code."""

    ANSWER: Final = code(0, "answered")
    NO_TRACK: Final = code(
        1,
        "not tracked into the other view, or lost on the way back",
        meaning="what has no return could not be found in other views",
        advice="texture and a view from the side would help",
        retry="the two views lie too far apart or show nothing in common: try a smaller pairs.gap, or pairs=auto",
    )
    NO_TEXTURE: Final = code(
        2,
        "trackability below the limit",
        meaning="blank surfaces, on which nothing can be followed",
        retry="try frames with more detail in sight",
    )
    NO_POSE: Final = code(
        3,
        "no metric relative pose for this pair",
        meaning="too few returns could be tracked",
        advice="slower motion, more light and texture would help",
        retry="try a larger holdout.cutoff, or holdout=none",
    )
    NO_BASELINE: Final = code(
        4,
        "the cameras did not translate (significantly)",
        meaning="near returns show no translation of the camera",
        advice="moving it sideways by a tenth of the distance would help; if it moved, depth may not fit the images",
        retry="try a larger pairs.gap, or pairs=auto",
    )
    BEHIND: Final = code(5, "the rays meet behind a camera", meaning="what would lie behind a camera")
    PARALLAX: Final = code(
        6, "the rays are too close to parallel", meaning="seen from nearly the same direction in all views"
    )
    RESIDUAL: Final = code(
        7, "the rays miss each other by too many pixels", meaning="the views do not meet in one point"
    )
    INCONSISTENT: Final = code(
        8, "another view, or the patch itself, contradicts the depth", meaning="the views do not agree"
    )
    UNCERTAIN: Final = code(
        9,
        "sigma / depth above the limit",
        meaning="the views lie too close together for what is far",
        advice="moving sideways would help",
    )
    LOW_SCORE: Final = code(10, "score below the threshold", meaning="answers with too low a score")
    CONTRADICTED: Final = code(
        11,
        "far tracks contradict the near returns: these lie on moving objects",
        meaning="what the sensor sees moves, or contradicts the pictures",
        advice="a still scene would help",
        retry="try frames in which nothing else moves",
    )
    POSE_REFUTED: Final = code(
        12,
        "the near returns contradict the given pose",
        meaning="the poses given contradict the near returns",
        advice="see their axes, direction and unit",
    )
    MISALIGNED: Final = code(
        13,
        "depth and picture do not belong together: the returns do not explain the parallax of their pixels",
        meaning="depth and picture do not belong together",
        advice="see whether only one of them was mirrored, cropped, shifted or turned; the returns are at wrong pixels",
    )


class PoseCode(CodeTable):
    """Codes of ``PoseFit.code``."""

    OK: Final = code(0, "")
    TOO_FEW: Final = code(1, "fewer usable correspondences or inliers than the minimum")
    DEGENERATE: Final = code(2, "the points do not determine a pose (collinear, coincident)")
    NO_BASELINE: Final = code(3, "the camera did not translate significantly, or stood still")
    KEPT_PNP: Final = code(4, "refinement did not improve the fit; the PnP pose was kept")
    REFUTED: Final = code(5, "the near returns contradict the given pose")
    MISALIGNED: Final = code(
        6,
        "depth and picture do not belong together: the returns do not explain the parallax of their pixels",
        meaning="depth and picture do not belong together",
        advice="see whether only one of them was mirrored, cropped, shifted or turned; the returns are at wrong pixels",
    )


class Source(CodeTable):
    """Origin of a value of a merged map."""

    NONE: Final = code(0, "")
    SENSOR: Final = code(1, "")
    RECOVERED: Final = code(2, "a tracked sample, triangulated")
    SWEPT: Final = code(3, "a pixel of a dense map, matched along its epipolar line")
    ALIGNED: Final = code(4, "a pixel of an external depth map, aligned to returns and recovered depths")
    FILLED: Final = code(5, "a pixel of a dense map, interpolated from neighbours on the same surface")


class Cause(CodeTable):
    """Codes of the terms of sigma², see :class:`dhtorch.records.SigmaBudget`."""

    NONE: Final = code(0, "no answer")
    TRACK: Final = code(1, "the point's own match")
    POSE: Final = code(2, "the relative pose")
    REFERENCE: Final = code(3, "the depth sensor: what all its returns have in common")
    LENS: Final = code(4, "intrinsics, distortion and rows")
    MODEL: Final = code(5, "joining, filling or calibration: what no other term explains")


class State(CodeTable):
    """Codes of the pixels of a validated depth map."""

    CANNOT_KNOW: Final = code(0, "no evidence: no baseline, no texture, occluded, or no depth")
    CONSISTENT: Final = code(1, "supported by evidence that would detect an error of 20 %")
    WRONG: Final = code(2, "contradicted by evidence, and supported by none")


class PinVerdict(CodeTable):
    """Codes of ``PinResult.verdict``."""

    NOT_MOVED: Final = code(0, "the camera stands where it stood, as far as the picture can tell")
    MOVED: Final = code(1, "the camera was moved")
    CANNOT_KNOW: Final = code(2, "the picture does not determine where the camera stands")


class PinReason(CodeTable):
    """Codes of ``PinResult.reason``: why a picture does not determine where the camera stands."""

    ANSWERED: Final = code(0, "answered")
    NO_TRACKS: Final = code(1, "hardly anything of the reference was found: covered, dark, or another view")
    NO_AGREEMENT: Final = code(2, "what was found does not move as one: little background, or another scene")
    ONE_PLACE: Final = code(3, "what agrees lies in one part of the picture")
    UNCERTAIN: Final = code(4, "the shift is not known to a pixel")
    ZOOM: Final = code(5, "zoom or focus changed: another focal length explains the picture better than a motion")
    ZOOM_OR_MOTION: Final = code(
        6, "moved along the axis, or zoom or focus changed: the depths in view do not tell which"
    )


class WrongCause(CodeTable):
    """Codes of the causes of wrong pixels of a validated depth map."""

    NONE: Final = code(0, "not wrong, or unknown")
    OTHER: Final = code(1, "wrong for none of the causes below")
    GHOST: Final = code(
        2,
        "a surface nearer than the sensor's minimum range has a false depth far behind it",
        meaning="ghosts of surfaces nearer than the sensor measures",
        advice="keep things farther than the sensor's minimum range",
    )
    FLYING_PIXEL: Final = code(
        3,
        "between a foreground and a background, on neither",
        meaning="flying pixels between foreground and background",
        advice="remove pixels whose neighbours have other depths",
    )
    EDGE_BLEED: Final = code(
        4,
        "the depth of one side of an outline on the other side",
        meaning="edges that bleed over the neighbouring surface",
        advice="leave out a few pixels along outlines, or upsample depth less",
    )


#: Kind of a pixel, as counts and pages name it → its codes of :class:`Source`. Only values from other views are
#: ``recovered``; values interpolated from neighbours are ``filled``.
SOURCES_OF_KIND: Final[dict[str, tuple[int, ...]]] = {
    "recovered": (Source.RECOVERED, Source.SWEPT),
    "filled": (Source.FILLED,),
    "sensor": (Source.SENSOR,),
    "no_answer": (Source.NONE,),
}


def count_kinds(by_source: Any) -> dict[str, Any]:
    """Numbers by kind of :data:`SOURCES_OF_KIND` from numbers by source.

    ``by_source``: what is counted, indexed by code of :class:`Source`: numbers of pixels, as of ``bincount``, their
    fractions, or arrays of them.
    """
    return {kind: sum(by_source[code] for code in codes) for kind, codes in SOURCES_OF_KIND.items()}


def is_recovered(source: Any) -> Any:
    """Whether a depth comes from other views: swept, or a sparse answer at that pixel.

    ``source``: a tensor or an array of codes of :class:`Source`; the result is of the same kind, bool.
    """
    return (source == Source.RECOVERED) | (source == Source.SWEPT)


def is_swept(source: Any) -> Any:
    """Whether a pixel of a dense map has a depth without a return: matched, or interpolated from such neighbours.

    ``source``: a tensor or an array of codes of :class:`Source`; the result is of the same kind, bool.
    """
    return (source == Source.SWEPT) | (source == Source.FILLED)


def is_estimated(source: Any) -> Any:
    """Whether a pixel of a dense map has a depth from images: swept, filled, or a sparse answer at that pixel.

    ``source``: a tensor or an array of codes of :class:`Source`; the result is of the same kind, bool.
    """
    return is_swept(source) | (source == Source.RECOVERED)


def describe(table: type[CodeTable], name: str) -> _CodeEntry | None:
    """The entry of a code by its name in any case; None where the table has no such code."""
    numbers = {code_name: number for number, code_name in names(table).items()}
    return table.entries.get(numbers.get(name.upper(), -1))


def names(table: type) -> dict[int, str]:
    """``{code: name}`` of a code table, in numeric order; composite masks are left out for bit sets."""
    pairs = {v: k for k, v in vars(table).items() if k.isupper() and isinstance(v, int) and k != "UNUSABLE"}
    return dict(sorted(pairs.items()))


def name(column: str | type[CodeTable], value: Any) -> Any:
    """Names of integer codes, as loaders, features and estimates hold them.

    Args:
        column: name of the column (``gate``, ``hole``, ``dhtorch.source_map``, …), or the code table.
        value: an int, a tensor or an array of integers.

    Returns:
        The name; nested lists of names for a tensor or an array. Bits of a flag are joined by ``|``; ``""`` = none.

    Raises:
        ValueError: a column without codes, or a code that its table does not have.
    """
    table = column if isinstance(column, type) else _find_table(column)
    codes = value.tolist() if hasattr(value, "tolist") else value
    return [name(table, each) for each in codes] if isinstance(codes, list) else _name_code(table, int(codes))


def _find_table(column: str) -> type[CodeTable]:
    """The code table of a column, with or without the prefix of a sample's keys."""
    plain = column.rpartition(".")[2].removeprefix("dh_").removesuffix("_map")
    tables = {re.sub(r"(?<!^)(?=[A-Z])", "_", table.__name__).lower(): table for table in CodeTable.__subclasses__()}
    tables |= {key.removeprefix("sample_").removeprefix("wrong_"): table for key, table in tables.items()}
    if plain not in tables:
        raise ValueError(f"codes: found the column {column!r}, expected one of {', '.join(tables)}")
    return tables[plain]


def _name_code(table: type[CodeTable], value: int) -> str:
    known = names(table)
    if table is Flag:
        return "|".join(text for bit, text in known.items() if value & bit)
    if value not in known:
        raise ValueError(f"{table.__name__}: found the code {value}, expected one of {', '.join(map(str, known))}")
    return known[value]


def words(name: str) -> str:
    """A code's name as text: TRACKABLE_NO_LIDAR → trackable, no LiDAR."""
    return name.lower().replace("_no_lidar", ", no LiDAR").replace("_", " ")


#: Route of each class of hole; NOTHING for one that is not listed.
ROUTE_OF_HOLE: Final[dict[int, int]] = dict.fromkeys(names(Hole), Route.NOTHING) | {
    Hole.TRACKABLE_NO_LIDAR: Route.TRIANGULATE,
    Hole.LOW_TEXTURE: Route.GET_CLOSER,
    Hole.TOO_BRIGHT: Route.CHANGE_EXPOSURE,
    Hole.TOO_DARK: Route.CHANGE_EXPOSURE,
    Hole.AT_BORDER: Route.TURN_HEAD,
}


def first_reason(*reasons: tuple[Tensor, int], otherwise: int = 0) -> Tensor:
    """Codes int32 of the first mask that is True, in the order of ``reasons``; ``otherwise`` where none is.

    Args:
        reasons: (mask, code) pairs; masks are equally shaped bool tensors.
        otherwise: code where no mask is True.
    """
    code = torch.full_like(reasons[0][0], otherwise, dtype=torch.int32)
    for mask, reason in reversed(reasons):
        code.masked_fill_(mask, reason)
    return code
