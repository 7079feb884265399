"""matplotlib figures in the project's style: axes with a grid and without a frame, titles, legends, files.

matplotlib is imported on first use, and only its figure objects are used: no global state, window or font setting
changes.
"""

import base64
import contextlib
import io
import pathlib
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dhtorch.runtime import storage
from dhtorch.viz.plots.colours import FAINT, INK, PAPER_EDGE, PAPER_FILL, SOFT, Stroke

#: Options of the mark of the paper's values, as of ``axes.plot``.
PAPER_MARK: Mapping[str, Any] = {
    "linestyle": "none", "marker": "D", "markersize": 7, "markerfacecolor": PAPER_FILL, "markeredgecolor": PAPER_EDGE,
}  # fmt: skip


def make_figure(n: int = 1, size: tuple[float, float] = (300.0, 216.0), **shared: Any) -> tuple[Any, list[Any]]:
    """Figure of ``n`` axes of a size in points, at most three beside one another; ``shared`` as of ``subplots``."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    columns = min(n, 3)
    rows = -(-n // columns)
    figure = Figure((size[0] * columns / 72, size[1] * rows / 72), dpi=160, layout="constrained")
    every = figure.subplots(rows, columns, squeeze=False, **shared).ravel()
    for axes in every:
        axes.grid(color=FAINT, linewidth=0.7)
        axes.set_axisbelow(True)
        axes.spines[:].set_visible(False)
        axes.tick_params(which="both", length=0, labelcolor=SOFT, labelleft=True, labelbottom=True)
    for unused in every[n:]:
        unused.remove()
    return figure, list(every[:n])


def set_axis(
    axes: Any, name: str, label: str = "", *, log: bool = False, percent: bool = False, limits: Any = (None, None)
) -> None:
    """Label, scale, round ticks and limits of the axis ``x`` or ``y``, after the values are drawn."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator  # noqa: PLC0415

    if log:
        getattr(axes, f"set_{name}scale")("log")
    axis = getattr(axes, f"{name}axis")
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)) if log else MaxNLocator(6, steps=(1, 2, 5, 10)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value if percent else value:.4g}"))
    axis.set_label_text(to_plain_line(label), color=SOFT)
    if limits != (None, None):
        getattr(axes, f"set_{name}lim")(*limits)


def draw_rows(axes: Any, intervals: Sequence[Sequence[float | None]], colours: Sequence[str]) -> None:
    """Intervals (low, value, high) in rows 0, 1, …, with dots at the values; what is None is left out."""
    low, value, high = np.array(intervals, float).reshape(-1, 3).T
    axes.hlines(range(len(colours)), low, high, color=colours, linewidth=1.8)
    axes.scatter(value, range(len(colours)), s=36, color=colours, zorder=2.5)


def set_rows(axes: Any, names: Sequence[str]) -> None:
    """Named rows 0, 1, … from the top, in place of a y axis."""
    axes.set_yticks(range(len(names)), [shorten(name, 40) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)


def set_title(axes: Any, text: str, width: float = 300.0) -> None:
    """Title at the left of axes of a width in points; a long one is set smaller, then cut in its middle."""
    size = min(11.0, max(8.0, width / (0.66 * max(len(text), 1))))
    axes.set_title(shorten(text, int(width / 4.8)), loc="left", fontsize=size, fontweight="bold", color=INK)


def draw_line(axes: Any, xs: Any, ys: Any, stroke: Stroke, **options: Any) -> None:
    """Draw a line, broken at missing values (None or NaN); a single value between gaps is a dot."""
    x, y = np.asarray(xs, float), np.asarray(ys, float)
    known = np.isfinite(x) & np.isfinite(y)
    alone = known & ~np.append(known[1:], False) & ~np.append([False], known[:-1])
    dots = {"marker": "o", "markersize": 4.4, "markevery": alone.tolist()} if alone.any() else {}
    axes.plot(x, y, **stroke.options(), **dots, **options)


def add_legend(figure: Any, entries: Mapping[str, Mapping[str, Any]], **place: Any) -> None:
    """Legend of entries (text → options of ``Line2D``), above the axes unless placed otherwise."""
    from matplotlib.lines import Line2D  # noqa: PLC0415

    handles = [Line2D([], [], label=to_plain_line(text), **options) for text, options in entries.items()]
    place = place or {"loc": "outside upper left", "ncols": 5}
    if handles:
        figure.legend(handles=handles, frameon=False, fontsize=9, labelcolor=INK, **place)


def mark_options(colour: str, marker: str = "o") -> dict[str, Any]:
    """Options of a mark without a line, as of ``Line2D``."""
    return {"color": colour, "linestyle": "none", "marker": marker, "markersize": 6, "markeredgecolor": colour}


def save_figure(figure: Any, path: Any, kind: str = "png") -> None:
    """Write a figure, including artists outside its axes; ``kind`` is the format where ``path`` is an open file."""
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

    is_open = not isinstance(path, str | pathlib.Path)
    kind = kind if is_open else pathlib.Path(path).suffix[1:]
    options = {"metadata": {"Date": None}} if kind == "svg" else {}
    with warnings.catch_warnings(), rc_context({"svg.fonttype": "none", "svg.hashsalt": "dhtorch"}):
        warnings.filterwarnings("ignore", message="Glyph")  # glyphs missing in the font
        if figure.get_layout_engine() is not None:
            figure.draw_without_rendering()  # which places the axes
        # the box that bbox_inches="tight" finds, which draws the figure for it
        box = figure.get_tightbbox(FigureCanvasAgg(figure).get_renderer()).padded(0.1)
        with contextlib.nullcontext(path) if is_open else storage.replace_at_end(path) as unfinished:
            figure.savefig(unfinished, bbox_inches=box, format=kind, **options)


def encode_uri(figure: Any, kind: str = "svg") -> str:
    """Figure -> data URI of an SVG, the same every time, or of a PNG."""
    out = io.BytesIO()
    save_figure(figure, out, kind)
    return (
        f"data:image/{'svg+xml' if kind == 'svg' else kind};base64,{base64.b64encode(out.getvalue()).decode('ascii')}"
    )


def to_plain_line(text: str) -> str:
    """Text on one line, without control characters and unpaired surrogates; a dollar sign begins no formula."""
    text = str(text).encode("utf-8", "replace").decode().replace("$", "\\$")
    return " ".join("".join(c if c.isprintable() or c.isspace() else "\ufffd" for c in text).split())


def shorten(text: str, letters: int) -> str:
    """Text on one line of at most so many letters: a long one is cut before its last third, where a cutoff stands."""
    text, end = to_plain_line(text), letters // 3
    return text if len(text) <= letters else f"{text[: letters - end - 1]}…{text[-end:]}"


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
