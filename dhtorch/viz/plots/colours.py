"""Every colour of the project, in figures, pages, viewers and notebooks: the only place where one is written down.

Blue is the sensor, orange is what was recovered, purple is what was swept, and nothing else is drawn in them. A method
has one colour in every figure. Depth has one colour map, blue near and red far, also where a viewer brings its own
(Rerun's has the same name).
Colours stay apart for the colour-blind where they can (Okabe and Ito, Tol); those of methods, series and gates are seen
on light and on dark ground alike. Only what belongs to a page, as its ink and ground, has a counterpart in the dark.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from dhtorch.codes import Cause, CodeTable, Gate, Hole, Source, State, names

#: What a depth comes from; pixels without an answer are paler.
SENSOR, RECOVERED, SWEPT, ALIGNED, UNANSWERED = "#0072B2", "#E69F00", "#C653A6", "#3F8F6B", "#B4B4B4"
FILLED = "#7A5AA8"

#: Variable of the pages → its colour by day and in the dark. Figures are drawn in those of the day.
PAGE_COLOURS = {
    "ground": ("#fdfdfb", "#15181b"),
    "card": ("#ffffff", "#1b2024"),
    "stage": ("#e9ebea", "#0b0d0f"),
    "tint": ("#f3f3ef", "#1e2226"),
    "faint": ("#d9dbd8", "#363c42"),
    "soft": ("#5b6268", "#a1a8ae"),
    "ink": ("#1c2024", "#e6e8ea"),
    "link": ("#0b5c93", "#7cc0f2"),
    "good": ("#1b6e3c", "#63c98a"),
    "bad": ("#a8321f", "#f08a74"),
    "theirs": ("#8a4f00", "#f0b860"),
    "theirs-ground": ("#fdf4e3", "#2c2417"),
    "picture": ("#efeeea", "#c9c8c3"),
    "rim": ("#40331a", "#0d0d0d"),
}
INK, SOFT, FAINT, PICTURE = (PAGE_COLOURS[name][0] for name in ("ink", "soft", "faint", "picture"))
#: Figures of the paper, beside ours: edge and inside.
PAPER_EDGE, PAPER_FILL = PAGE_COLOURS["theirs"][0], PAGE_COLOURS["theirs-ground"][0]
#: In space: what another colouring leaves aside, and the held-out returns.
PALE, HIDDEN_RETURN = "#737880", "#739E80"
#: Around a mark, so that it is seen on any picture.
WHITE, BLACK = "#ffffff", "#000000"

#: Method → its colour.
METHOD_COLOURS = {
    "paper": INK,
    "kornia": "#4B8BBE",
    "map": "#009E73",
    "window": "#CC79A7",
    "auto": "#C03A5A",
    "fused": "#E0662F",
    "opencv": "#8C6D31",
    "xfeat": "#7A5CC8",
}
#: Series that are no method, in turn.
SERIES_COLOURS = ("#2A9DA8", "#D55E00", "#6B8E23", "#A0529C", "#7D7D7D", "#4F6D8F")
#: Where the colours are used up they come again in these dashes, points.
_SERIES_DASHES: tuple[tuple[float, ...], ...] = ((), (5.0, 2.5), (1.5, 1.8), (7.0, 2.0, 1.5, 2.0))

#: Of codes without a colour of their own.
DEFAULT_CODE_COLOUR = "#7C6F64"


def _with_defaults(table: type[CodeTable], own: dict[int, str], leave_out: int | None = None) -> dict[int, str]:
    """Code -> colour for every code of a table but one: its own, else the default."""
    return {code: own.get(code, DEFAULT_CODE_COLOUR) for code in names(table) if code != leave_out}


_GATE_COLOURS = {
    Gate.NO_TRACK: "#9A9A9A",
    Gate.NO_TEXTURE: "#5E5E5E",
    Gate.NO_POSE: "#5C7391",
    Gate.NO_BASELINE: "#8068D8",
    Gate.BEHIND: "#C9A400",
    Gate.PARALLAX: "#CC79A7",
    Gate.RESIDUAL: "#D55E00",
    Gate.INCONSISTENT: "#A8376E",
    Gate.UNCERTAIN: "#44AA99",
    Gate.LOW_SCORE: "#999933",
    Gate.CONTRADICTED: "#6B4A1F",
    Gate.POSE_REFUTED: "#8C2D6B",
}
GATE_COLOURS = _with_defaults(Gate, _GATE_COLOURS, Gate.ANSWER)
_HOLE_COLOURS = {
    Hole.TRACKABLE_NO_LIDAR: "#D55E00",
    Hole.LOW_TEXTURE: "#5E5E5E",
    Hole.TOO_BRIGHT: "#F0E442",
    Hole.TOO_DARK: BLACK,
    Hole.HIGHLIGHT: "#CC79A7",
    Hole.AT_BORDER: "#009E73",
}
HOLE_COLOURS = _with_defaults(Hole, _HOLE_COLOURS, Hole.NONE)
_SOURCE_COLOURS = {
    Source.NONE: UNANSWERED,
    Source.SENSOR: SENSOR,
    Source.RECOVERED: RECOVERED,
    Source.SWEPT: SWEPT,
    Source.ALIGNED: ALIGNED,
    Source.FILLED: FILLED,
}

SOURCE_COLOURS = _with_defaults(Source, _SOURCE_COLOURS)

#: Largest cause of a sigma.
CAUSE_COLOURS = _with_defaults(Cause, dict(enumerate(SERIES_COLOURS, start=Cause.TRACK)), Cause.NONE)

#: State of a pixel of a validated map.
_STATE_COLOURS = {State.CANNOT_KNOW: PICTURE, State.CONSISTENT: "#63c98a", State.WRONG: "#a8321f"}
STATE_COLOURS = _with_defaults(State, _STATE_COLOURS)

#: Quantity → matplotlib's name of its colour map.
DEPTH_CMAP, SCORE_CMAP, ERROR_CMAP, SIGNED_CMAP, GREY_CMAP = "turbo", "viridis", "Spectral_r", "RdBu_r", "gray"
#: Where 1/m is drawn: near is large, and blue as well.
INVERSE_DEPTH_CMAP = f"{DEPTH_CMAP}_r"


class Stroke(NamedTuple):
    """How a series is drawn."""

    colour: str
    width: float = 1.8  # points
    dashes: tuple[float, ...] = ()  # points on, off, …; none = a whole line
    opacity: float = 1.0

    def options(self) -> dict[str, Any]:
        """Options of ``axes.plot``."""
        style = (0, self.dashes) if self.dashes else "solid"
        return {"color": self.colour, "linewidth": self.width, "linestyle": style, "alpha": self.opacity}


def assign_strokes(names: Iterable[str]) -> dict[str, Stroke]:
    """Name → stroke: a method's own colour, the others in turn and then dashed."""
    names = list(dict.fromkeys(names))
    others = [name for name in names if name not in METHOD_COLOURS]
    strokes = {name: Stroke(METHOD_COLOURS[name]) for name in names if name in METHOD_COLOURS}
    for k, name in enumerate(others):
        again, colour = divmod(k, len(SERIES_COLOURS))
        strokes[name] = Stroke(SERIES_COLOURS[colour], dashes=_SERIES_DASHES[again % len(_SERIES_DASHES)])
    return {name: strokes[name] for name in names}


def parse_rgb(colour: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def colour_by_source(source: Any) -> np.ndarray:
    """Colours (P, 3) uint8 of points by codes.Source (P,): sensor blue, recovered orange, swept purple."""
    code = np.asarray(source.detach().cpu() if hasattr(source, "detach") else source).astype(np.int64)
    return colour_by_code(SOURCE_COLOURS, code)


def colour_by_code(table: Mapping[int, str], code: np.ndarray) -> np.ndarray:
    """Colours (…, 3) uint8 of codes (…) by a table of this module."""
    rows = np.zeros((max(table) + 1, 3), np.uint8)
    for number, colour in table.items():
        rows[number] = parse_rgb(colour)
    return rows[code]


def sample_cmap(name: str, n: int = 17) -> list[str]:
    """A colour map at n places from its low to its high end, for drawers that do not have it."""
    from matplotlib import colormaps  # noqa: PLC0415
    from matplotlib.colors import to_hex  # noqa: PLC0415

    return [to_hex(colour) for colour in colormaps[name](np.linspace(0, 1, n))]


def build_colour_variables() -> str:
    """The variables of a page by day and in the dark, and those of the colours that are the same in both."""
    fixed = {
        "sensor": SENSOR,
        "recovered": RECOVERED,
        "swept": SWEPT,
        "unanswered": UNANSWERED,
        "white": WHITE,
        "black": BLACK,
    }
    day, night = ({name: pair[k] for name, pair in PAGE_COLOURS.items()} for k in (0, 1))
    dark = f"@media (prefers-color-scheme: dark) {{ {_format_root_rule(night)} }}"
    return f"{_format_root_rule({**day, **fixed})}\n{dark}\n"


def _format_root_rule(variables: dict[str, str]) -> str:
    declarations = " ".join(f"--{name}: {colour};" for name, colour in variables.items())
    return f":root {{ color-scheme: light dark; {declarations} }}"
