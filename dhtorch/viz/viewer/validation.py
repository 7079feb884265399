"""HTML page of validated or aligned depth maps, or of pinned episodes: summary, table, figures; worst first.

The page is self-contained. Names from files are untrusted and escaped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dhtorch.runtime import storage
from dhtorch.viz.plots import draw_line, encode_uri, make_figure, set_axis, set_title
from dhtorch.viz.plots.colours import SERIES_COLOURS, Stroke
from dhtorch.viz.plots.markup import Markup, build_document, encode_png_uri, make_tag

#: Note on the page of a validated data set.
_STATES_NOTE = "Green is consistent, red is wrong, all else cannot be checked."


@dataclass(frozen=True)
class ValidatedFrame:
    """One frame or episode of the page."""

    name: str
    cells: Sequence[str]  # in the order of the page's columns
    picture: bytes | None = None  # PNG
    after: bytes | None = None  # PNG that is shown in turn with it


def write_validation_page(
    path: Path,
    title: str,
    *,
    sentences: Sequence[str],
    columns: Sequence[str],
    frames: Sequence[ValidatedFrame],
    failed: Sequence[str] = (),
    word: str = "validate",
    note: str | None = _STATES_NOTE,
    kind: str = "frame",
    above: Sequence[Markup] = (),
    own: Path | None = None,
) -> Path:
    """Write the page: summary lines, a table of the frames with cells in the given order, and the figures.

    Raises:
        OSError: the file cannot be written.
    """
    top = [make_tag("h1", title), *(make_tag("p", text) for text in sentences)]
    top += [make_tag("p", text, class_="bad") for text in failed]
    top += [] if note is None else [make_tag("p", note, class_="note")]
    heads = (make_tag("th", head, scope="col", class_="num" if k else None) for k, head in enumerate((kind, *columns)))
    body = (
        make_tag("tr", make_tag("th", each.name, scope="row"), *(make_tag("td", x, class_="num") for x in each.cells))
        for each in frames
        if each.cells
    )
    table = make_tag("table", make_tag("thead", make_tag("tr", *heads)), make_tag("tbody", *body))
    scrolled = make_tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=f"All {kind}s")
    figures = (_build_figure(each) for each in frames if each.picture is not None)
    parts = make_tag("header", *top), make_tag("main", *above, scrolled, *figures)
    page = build_document(f"{title} · dhtorch {word}", *parts, own=own)
    return storage.replace_file(path, page.encode("utf-8"))


def _build_figure(frame: ValidatedFrame) -> Markup:
    """Figure of a frame; with a second picture, both in one place, in turn."""
    assert frame.picture is not None
    name, uri = make_tag("strong", frame.name), encode_png_uri(frame.picture)
    if frame.after is None:
        image = make_tag("img", alt=frame.name, src=uri)
        return make_tag("figure", make_tag("figcaption", name), make_tag("div", image, class_="scroll", tabindex="0"))
    before = make_tag("img", alt="reference", src=uri)
    after = make_tag("img", alt="picture", src=encode_png_uri(frame.after), class_="after")
    caption = make_tag("figcaption", name, " reference and picture in turn")
    return make_tag("figure", caption, make_tag("div", before, after, class_="blink"))


def format_estimate(number: Mapping[str, float | None] | None, digits: int = 3) -> str:
    """Value with its interval -> table cell; – for an unknown value."""
    if number is None or number.get("value") is None:
        return "–"
    value, low, high = (number[name] for name in ("value", "low", "high"))
    if low is None or high is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def draw_drift(drift: Sequence[tuple[str, Sequence[int], Sequence[float]]]) -> Markup:
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
