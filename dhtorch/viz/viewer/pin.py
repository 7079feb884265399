"""HTML page of a camera compared with its reference: drift over time, all episodes, and before/after, worst first.

The page is self-contained. Names from files are untrusted and escaped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dhtorch.runtime import storage
from dhtorch.viz.plots.axis import fit_axis
from dhtorch.viz.plots.colours import SERIES_COLOURS, Stroke
from dhtorch.viz.plots.document import build_document
from dhtorch.viz.plots.markup import Markup, encode_png_uri, make_tag
from dhtorch.viz.plots.panel import Panel
from dhtorch.viz.plots.svg import render_inline_svg
from dhtorch.viz.viewer.validation import build_scrolled_table

#: Columns of the table, after the episode's name.
_PIN_COLUMNS = ("verdict", "median shift, px", "its sigma, px", "largest shift, px", "changes")

_PIN_CSS = Path(__file__).with_name("pin.css")

#: Size of the plot of the drift, points.
_DRIFT_SIZE_PT = (640, 216)


@dataclass(frozen=True)
class PinnedEpisode:
    """One episode of the page."""

    name: str
    cells: Sequence[str]  # in the order of the columns
    before: bytes | None = None  # PNG of the reference
    after: bytes | None = None  # PNG of the picture with the largest shift


def write_pin_page(
    path: Path,
    title: str,
    sentences: Sequence[str],
    episodes: Sequence[PinnedEpisode],
    drift: Sequence[tuple[str, Sequence[int], Sequence[float]]],
    *,
    failed: Sequence[str] = (),
) -> Path:
    """Write the page; ``episodes`` in the order in which they are shown, ``drift`` of each: name, frames, shifts in px.

    Raises:
        OSError: the file cannot be written.
    """
    top = [make_tag("h1", title), *(make_tag("p", text) for text in sentences)]
    top += [make_tag("p", text, class_="bad") for text in failed]
    table = build_scrolled_table("All episodes", ("episode", *_PIN_COLUMNS), [(e.name, e.cells) for e in episodes])
    figures = [_build_blink(e) for e in episodes if e.before is not None and e.after is not None]
    body = make_tag("main", _draw_drift(drift), table, *figures)
    page = build_document(f"{title} · dhtorch pin", make_tag("header", *top), body, own=_PIN_CSS)
    return storage.replace_file(path, page.encode("utf-8"))


def _build_blink(episode: PinnedEpisode) -> Markup:
    """Reference and picture in one place, in turn."""
    assert episode.before is not None and episode.after is not None
    before = make_tag("img", alt="reference", src=encode_png_uri(episode.before))
    after = make_tag("img", alt="picture", src=encode_png_uri(episode.after), class_="after")
    caption = make_tag("figcaption", make_tag("strong", episode.name), " reference and picture in turn")
    return make_tag("figure", caption, make_tag("div", before, after, class_="blink"))


def _draw_drift(drift: Sequence[tuple[str, Sequence[int], Sequence[float]]]) -> Markup:
    """Shift of every picture, px, one episode after the other."""
    xs: list[float | None] = []
    ys: list[float | None] = []
    for _, _, shifts in drift:
        first = sum(x is not None for x in xs)
        xs += [*(float(first + k) for k in range(len(shifts))), None]
        ys += [*(None if math.isnan(y) else y for y in shifts), None]
    names = "pictures in order, a line an episode"
    panel = Panel(
        "Shift of the scene", fit_axis(xs, names), fit_axis([*ys, 1.0], "shift, px", low=0.0), size=_DRIFT_SIZE_PT
    )
    panel.line(xs, ys, Stroke(SERIES_COLOURS[0]))
    return make_tag("figure", Markup(render_inline_svg(panel)))
