"""HTML page of a camera compared with its reference: drift over time, all episodes, and before/after, worst first.

The page is self-contained. Names from files are untrusted and escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dhtorch.runtime import storage
from dhtorch.viz.plots import draw_line, encode_uri, make_figure, set_axis, set_title
from dhtorch.viz.plots.colours import SERIES_COLOURS, Stroke
from dhtorch.viz.plots.markup import Markup, build_document, encode_png_uri, make_tag
from dhtorch.viz.viewer.validation import build_scrolled_table

#: Columns of the table, after the episode's name.
_PIN_COLUMNS = ("verdict", "median shift, px", "its sigma, px", "largest shift, px", "changes")

_PIN_CSS = Path(__file__).with_name("pin.css")


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
    """Shift of every image, px, one episode after the other."""
    figure, (axes,) = make_figure(size=(640, 216))
    first = 0
    for _, _, shifts in drift:
        draw_line(axes, range(first, first + len(shifts)), shifts, Stroke(SERIES_COLOURS[0]))
        first += len(shifts)
    set_axis(axes, "x", "images in order, a line an episode")
    set_axis(axes, "y", "shift, px", limits=(0.0, max(1.06, axes.get_ylim()[1])))
    set_title(axes, "Shift of the scene")
    return make_tag("figure", make_tag("img", src=encode_uri(figure), alt="Shift of the scene"))
