"""Bare matplotlib figure with drawing functions in points (1/72 inch), x to the right, y up; legend.

matplotlib is imported on first use, and only its figure objects are used: no global state, window or font setting
changes.
"""

from __future__ import annotations

import contextlib
import pathlib
import re
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from dhtorch.runtime import storage
from dhtorch.viz.plots.colours import GREY_CMAP, INK, PAPER_EDGE, SOFT, Stroke

#: Font size of text, points.
TEXT_SIZE_PT = 10.0
#: Font size of titles, points.
_TITLE_SIZE_PT = 11.0
#: Assumed letter width for truncation, as a fraction of the font size.
LETTER_WIDTH_EM = 0.59
#: Smallest font size of a long title, points.
_MIN_TITLE_SIZE_PT = 8.0
#: Assumed letter width of bold titles, as a fraction of the font size.
_BOLD_LETTER_WIDTH_EM = 0.66

#: Padding around a saved figure, inches.
_PADDING_IN = 0.1
#: Kinds of files that matplotlib's Agg draws.
_RASTER_KINDS = ("png", "jpg", "jpeg")

CanvasPoint = tuple[float, float]


class LegendKey(NamedTuple):
    """An entry of a legend."""

    text: str
    colour: str
    shape: str = "line"  # line | dot | box | cross | diamond
    stroke: Stroke | None = None  # of a line


class Mark(NamedTuple):
    """A drawn element: kind, corner positions in the panel, stroke, and tooltip."""

    kind: str  # line | dot | diamond | bar
    places: tuple[CanvasPoint, ...]
    stroke: Stroke
    tooltip: str = ""  # tooltip
    edge: str | None = None  # colour of the edge of a bar


class Canvas:
    """A bare matplotlib figure, drawn on in points."""

    def __init__(self, width: float, height: float, dpi: float) -> None:
        from matplotlib.figure import Figure  # noqa: PLC0415
        from matplotlib.transforms import Affine2D  # noqa: PLC0415

        self.figure = Figure((width / 72, height / 72), dpi=dpi)
        self.figure.suppressComposite = True  # images side by side stay images of their own
        self._canvas_points = Affine2D().scale(1 / width, 1 / height) + self.figure.transFigure
        self.points = self._canvas_points
        self._picture_axes: Any = None  # of all pictures: making axes takes longer than drawing an image
        self.tooltips: list[str] = []  # tooltips of the artists named tooltip-0, tooltip-1, …

    def set_origin(self, u: float, v: float) -> None:
        """Place the origin of what is drawn next at (u, v)."""
        from matplotlib.transforms import Affine2D  # noqa: PLC0415

        self.points = Affine2D().translate(u, v) + self._canvas_points

    def text(
        self, text: str, u: float, v: float, *, size: float = TEXT_SIZE_PT, tooltip: str = "", **options: Any
    ) -> None:
        """Draw text at (u, v); ``tooltip``: tooltip with the full text if it was truncated."""
        from matplotlib.text import Text  # noqa: PLC0415

        text = to_plain_line(text)
        if not text:
            return
        weight = "bold" if options.pop("bold", False) else "normal"
        artist = Text(u, v, text, color=INK if weight == "bold" else SOFT, fontsize=size, fontweight=weight, **options)
        artist.set(parse_math=False, rotation_mode="anchor", transform=self.points)
        self._add(artist, tooltip if to_plain_line(tooltip) != text else "")

    def title(self, text: str, width: float, height: float, left: float = 0.0) -> None:
        """Draw a title along the upper edge; long titles are set smaller, then truncated in the middle."""
        text = to_plain_line(text)
        size = min(_TITLE_SIZE_PT, max(_MIN_TITLE_SIZE_PT, width / (_BOLD_LETTER_WIDTH_EM * max(len(text), 1))))
        shown = truncate_text(text, width * LETTER_WIDTH_EM / _BOLD_LETTER_WIDTH_EM, size, end=len(text) // 3)
        self.text(shown, left + 2, height - 14, size=size, bold=True, tooltip=text)

    def lines(self, segments: Iterable[Sequence[CanvasPoint]], stroke: Stroke, tooltip: str = "") -> None:
        """Draw polylines as one path."""
        from matplotlib.path import Path  # noqa: PLC0415

        places: list[CanvasPoint] = []
        codes: list[Any] = []
        for segment in segments:
            places += segment
            codes += [Path.MOVETO, *[Path.LINETO] * (len(segment) - 1)]
        options = {"linewidth": stroke.width, "alpha": None if stroke.opacity == 1 else stroke.opacity}
        dashes = (0, stroke.dashes) if stroke.dashes else "solid"
        self._path(places, codes, tooltip, fill=False, edgecolor=stroke.colour, linestyle=dashes, **options)

    def dots(self, places: Iterable[CanvasPoint], stroke: Stroke, tooltip: str = "") -> None:
        """Draw dots as wide as the stroke: zero-length lines with round caps, the shortest form in SVG."""
        from matplotlib.path import Path  # noqa: PLC0415

        ends = [end for u, v in places for end in ((u, v), (u + 1e-4, v))]
        codes = [Path.MOVETO, Path.LINETO] * (len(ends) // 2)
        options = {"linewidth": stroke.width, "capstyle": "round", "snap": False}
        self._path(ends, codes, tooltip, fill=False, edgecolor=stroke.colour, **options)

    def mark(self, mark: Mark) -> None:
        """Draw one mark of a panel."""
        if mark.kind == "line":
            self.lines([mark.places], mark.stroke, mark.tooltip)
        elif mark.kind == "dot":
            self.dots(mark.places, mark.stroke, mark.tooltip)
        else:
            self.area(mark.places, mark.stroke.colour, mark.tooltip, mark.edge, 1.8 if mark.kind == "diamond" else 0.5)

    def area(
        self,
        corners: Sequence[CanvasPoint],
        colour: str,
        tooltip: str = "",
        edge: str | None = None,
        width: float = 0.5,  # of the edge
    ) -> None:
        """Draw a filled polygon."""
        from matplotlib.path import Path  # noqa: PLC0415

        codes = [Path.MOVETO, *[Path.LINETO] * (len(corners) - 1), Path.CLOSEPOLY]
        options = {"facecolor": colour, "edgecolor": edge or "none", "linewidth": width if edge else 0}
        self._path([*corners, corners[0]], codes, tooltip, **options)

    def axes(self) -> Any:
        """matplotlib axes over the whole canvas in points, for artists with a colour map."""
        axes = self.figure.add_axes((0, 0, 1, 1), zorder=1e6)
        width, height = 72 * self.figure.get_size_inches()
        axes.set(xlim=(0, width), ylim=(0, height))
        axes.set_axis_off()
        return axes

    def picture(self, pixels: Any, box: tuple[float, float, float, float]) -> None:
        """Draw an image, (H, W) grey or (H, W, 3) in [0, 1], below all else; ``box``: left, bottom, width, height."""
        (left, bottom, width, height), limits = box, 72 * self.figure.get_size_inches()
        if self._picture_axes is None:
            self._picture_axes = self.axes()
            self._picture_axes.set_zorder(-1)
        axes = self._picture_axes
        axes.imshow(
            pixels,
            cmap=GREY_CMAP,
            vmin=0,
            vmax=1,
            extent=(left, left + width, bottom, bottom + height),
            aspect="auto",
            interpolation="antialiased",
        )
        axes.set(xlim=(0, limits[0]), ylim=(0, limits[1]))

    def finished(self, keys: Sequence[LegendKey]) -> Any:
        """The figure with a legend beside it."""
        if keys:
            options = {"bbox_to_anchor": (1.0, 1.0), "frameon": False, "fontsize": 9, "labelcolor": INK}
            self.figure.legend(handles=list(map(_make_legend_handle, keys)), loc="upper left", **options)
        return self.figure

    def _path(self, places: Sequence[Any], codes: Sequence[Any], tooltip: str, **options: Any) -> None:
        from matplotlib.patches import PathPatch  # noqa: PLC0415
        from matplotlib.path import Path  # noqa: PLC0415

        if places:
            path = Path(places, codes)
            path.should_simplify = False
            joined = {"joinstyle": "round"} | options
            self._add(PathPatch(path, transform=self.points, **joined), tooltip)

    def _add(self, artist: Any, tooltip: str) -> None:
        if tooltip:
            artist.set_gid(f"tooltip-{len(self.tooltips)}")
            self.tooltips.append(to_plain_line(tooltip))
        artist.set_figure(self.figure)
        artist.set_zorder(len(self.figure.artists))  # in drawing order
        self.figure.artists.append(artist)


def to_plain_line(text: str) -> str:
    """Text on one line, without control characters and unpaired surrogates."""
    text = str(text).encode("utf-8", "replace").decode()
    return " ".join("".join(c if c.isprintable() or c.isspace() else "\ufffd" for c in text).split())


def truncate_text(text: str, width: float, size: float, end: int = 0) -> str:
    """Truncate a text to ``width`` points; up to ``end`` of its last letters are kept (at most a third of all)."""
    max_letters = int(width / (LETTER_WIDTH_EM * size) + 1e-6)
    if len(text) <= max_letters:
        return text
    last = min(end, max_letters // 3)
    return f"{text[: max_letters - 1 - last]}…{text[len(text) - last :]}"


def format_capture_name(name: str) -> str:
    """Name of a capture -> words for a title: ``kitchen_scan`` → ``Kitchen scan``."""
    plain = re.sub(r"_+|(?<=[^\W\d])-+(?=[^\W\d])", " ", name).strip() or name
    return plain[:1].upper() + plain[1:]


def format_frame(capture: str, frame: object) -> str:
    """Title text of a frame of a capture: ``Kitchen scan, frame 63``."""
    return f"{format_capture_name(capture)}, frame {frame}"


def append_cutoff(place: str, cutoff: float | None) -> str:
    """Append the cutoff (m) to a title."""
    return place if cutoff is None else f"{place}, cutoff {cutoff:g} m"


def prefix_title(words: str, title: str) -> str:
    """Prefix a figure title with the scene title."""
    return f"{title}: {words[0].lower()}{words[1:]}" if title else words


def save_figure(figure: Any, path: Any, kind: str = "png") -> None:
    """Write a figure, including artists outside its axes; ``kind`` is the format where ``path`` is an open file."""
    is_open = not isinstance(path, str | pathlib.Path)
    kind = kind if is_open else pathlib.Path(path).suffix[1:]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # glyphs missing in the font
        box = _fit_box(figure) if kind in _RASTER_KINDS else "tight"
        with contextlib.nullcontext(path) if is_open else storage.replace_at_end(path) as unfinished:
            figure.savefig(unfinished, bbox_inches=box, pad_inches=_PADDING_IN, format=kind)


def _fit_box(figure: Any) -> Any:
    """Box of a figure's artists with padding, inches; as ``bbox_inches="tight"``, which draws the figure for it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

    return figure.get_tightbbox(FigureCanvasAgg(figure).get_renderer()).padded(_PADDING_IN)


def _make_legend_handle(key: LegendKey) -> Any:
    """Legend handle of an entry."""
    from matplotlib.lines import Line2D  # noqa: PLC0415

    options: dict[str, Any] = {"label": key.text, "linestyle": "none", "markersize": 6, "markerfacecolor": key.colour}
    if key.shape == "line":
        stroke = key.stroke or Stroke(key.colour)
        dashes: Any = (0, stroke.dashes) if stroke.dashes else "solid"
        return Line2D([], [], color=key.colour, linewidth=stroke.width, linestyle=dashes, label=key.text)
    marker, edge = _LEGEND_MARKERS[key.shape]
    return Line2D([], [], marker=marker, markeredgecolor=edge or key.colour, **options)


#: Shape of an entry → matplotlib marker and edge colour, None = the entry's own colour.
_LEGEND_MARKERS = {"dot": ("o", "none"), "box": ("s", "none"), "cross": ("x", None), "diamond": ("D", PAPER_EDGE)}
