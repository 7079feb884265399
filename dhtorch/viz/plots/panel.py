"""One pair of axes: collects marks, then renders them as a matplotlib figure or as inline SVG.

Alphabet: x, y are data; u, v are positions in the panel in points (1/72 inch), v up. A panel stores its marks as plain
numbers until it is drawn. It draws its own frame: matplotlib's axes take ten times as long, and pages have hundreds of
panels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dhtorch.viz.plots.axis import Axis, OptionalNumbers
from dhtorch.viz.plots.canvas import (
    LETTER_WIDTH_EM,
    TEXT_SIZE_PT,
    Canvas,
    CanvasPoint,
    LegendKey,
    Mark,
    save_figure,
    to_plain_line,
    truncate_text,
)
from dhtorch.viz.plots.colours import FAINT, PAPER_EDGE, PAPER_FILL, Stroke

#: Height of a named row, points.
_ROW_HEIGHT_PT = 19
#: Panels beside one another in a picture.
_PANELS_PER_ROW = 3
#: Height of the margins around the rows, points.
_ROWS_MARGIN_PT = 66


class Panel:
    """One pair of axes; add marks, then :meth:`figure` or :func:`dhtorch.viz.plots.svg.render_inline_svg`."""

    def __init__(
        self,
        title: str,
        x: Axis,
        y: Axis | None,  # None = categorical rows, see ``rows``
        *,
        size: CanvasPoint = (300, 216),  # points; with rows the height follows from their number
        rows: Sequence[str] = (),
    ) -> None:
        self.title, self.x, self.y, self.rows = title, x, y, list(rows)
        longest = max((len(r) for r in rows), default=0)
        self.width: float = size[0]
        self.height: float = size[1] if y else _ROWS_MARGIN_PT + _ROW_HEIGHT_PT * len(rows)
        self.left = min(0.4 * size[0], 12 + LETTER_WIDTH_EM * TEXT_SIZE_PT * longest) if rows else 46.0
        self.right, self.top, self.bottom = 14.0, 26.0 if title else 10.0, 40.0 if x.label else 22.0
        self.marks: list[Mark] = []

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of the plot area as fractions of the panel, as for matplotlib axes."""
        width, height = self.width - self.left - self.right, self.height - self.top - self.bottom
        return self.left / self.width, self.bottom / self.height, width / self.width, height / self.height

    @property
    def words(self) -> str:
        """Text alternative of the panel, for screen readers."""
        return self.title or f"{self.y.label if self.y else ', '.join(self.rows)} against {self.x.label}"

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Data point -> position (u, v); with rows, y is the row number from the top."""
        left, bottom, width, height = self.box
        part = 1 - (y + 0.5) / len(self.rows) if self.y is None else self.y.place(y)
        return self.width * (left + self.x.place(x) * width), self.height * (bottom + part * height)

    def line(self, xs: OptionalNumbers, ys: OptionalNumbers, stroke: Stroke) -> None:
        """Add a line, broken at missing values; a single value between gaps becomes a dot."""
        run: list[CanvasPoint] = []
        for x, y in [*zip(xs, ys, strict=True), (None, None)]:
            if x is not None and y is not None:
                run.append(self.at(x, y))
                continue
            if len(run) == 1:
                self.marks.append(Mark("dot", tuple(run), stroke._replace(width=4.4)))
            elif run:
                self.marks.append(Mark("line", tuple(run), stroke))
            run = []

    def dot(self, x: float, y: float, stroke: Stroke, tooltip: str = "", width: float = 6.8) -> None:
        """Add a dot with the tooltip ``tooltip``."""
        self.marks.append(Mark("dot", (self.at(x, y),), stroke._replace(width=width), tooltip))

    def diamond(self, x: float, y: float, tooltip: str = "") -> None:
        """Add a diamond, the mark of the paper's values."""
        (u, v), r = self.at(x, y), 5
        corners = ((u, v - r), (u + r, v), (u, v + r), (u - r, v))
        self.marks.append(Mark("diamond", corners, Stroke(PAPER_FILL), tooltip, PAPER_EDGE))

    def bar(self, x_0: float, x_1: float, y_0: float, y_1: float, colour: str, edge: str | None = None) -> None:
        """Add a filled rectangle."""
        (u_0, v_0), (u_1, v_1) = self.at(x_0, y_0), self.at(x_1, y_1)
        u_1 = max(u_1, u_0 + 0.5)
        corners = ((u_0, v_0), (u_1, v_0), (u_1, v_1), (u_0, v_1))
        self.marks.append(Mark("bar", corners, Stroke(colour), edge=edge))

    def fill(self, xs: Sequence[float], ys: Sequence[float], colour: str) -> None:
        """Add a filled polygon."""
        self.marks.append(Mark("bar", tuple(self.at(x, y) for x, y in zip(xs, ys, strict=True)), Stroke(colour)))

    def canvas(self, dpi: float = 160) -> Canvas:
        """A canvas with the panel drawn on it, for further drawing."""
        canvas = Canvas(self.width, self.height, dpi)
        self.draw(canvas)
        return canvas

    def figure(self, *, dpi: float = 160, keys: Sequence[LegendKey] = ()) -> Any:
        """The panel as a matplotlib ``Figure``, with a legend beside it."""
        return self.canvas(dpi).finished(keys)

    def draw(self, canvas: Canvas) -> None:
        """Draw frame and marks."""
        self._frame(canvas)
        for mark in self.marks:
            canvas.mark(mark)

    def _frame(self, canvas: Canvas) -> None:
        right, base, ceiling = self.width - self.right, self.bottom, self.height - self.top
        grid = []
        for tick in self.x.ticks():
            u = self.at(tick, 0 if self.y is None else self.y.low)[0]
            grid.append(((u, base), (u, ceiling)))
            canvas.text(self.x.write(tick), u, base - 14, ha="center")
        for k, name in enumerate(self.rows):
            v = self.at(self.x.low, k)[1]
            grid.append(((self.left, v), (right, v)))
            canvas.text(
                truncate_text(to_plain_line(name), self.left - 8, TEXT_SIZE_PT),
                self.left - 8,
                v - 3.5,
                ha="right",
                tooltip=name,
            )
        for tick in self.y.ticks() if self.y else ():
            v = self.at(self.x.low, tick)[1]
            grid.append(((self.left, v), (right, v)))
            canvas.text(self.y.write(tick) if self.y else "", self.left - 5, v - 3.5, ha="right")
        canvas.lines(grid, Stroke(FAINT, 0.7))
        canvas.title(self.title, self.width, self.height)
        canvas.text(self.x.label, (self.left + right) / 2, 8, ha="center")
        if self.y:
            canvas.text(self.y.label, 12, (base + ceiling) / 2, ha="center", rotation=90)


def save_panels(path: Any, panels: Sequence[Panel], keys: Sequence[LegendKey] = ()) -> None:
    """Write panels, three beside one another, with one legend, as a picture."""
    rows = [panels[k : k + _PANELS_PER_ROW] for k in range(0, len(panels), _PANELS_PER_ROW)]
    heights = [max(panel.height for panel in row) for row in rows]
    canvas = Canvas(max(sum(panel.width for panel in row) for row in rows), sum(heights), dpi=160)
    for n, row in enumerate(rows):
        for k, panel in enumerate(row):
            canvas.set_origin(sum(before.width for before in row[:k]), sum(heights[n + 1 :]))
            panel.draw(canvas)
    save_figure(canvas.finished(keys), path)
