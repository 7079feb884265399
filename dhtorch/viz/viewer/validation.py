"""HTML page of validated or aligned depth maps: summary, table of all frames, figures; worst first.

The page is self-contained. Names from files are untrusted and escaped.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dhtorch.runtime import storage
from dhtorch.viz.plots.markup import Markup, build_document, encode_png_uri, make_tag

#: Note on the page of a validated data set.
_STATES_NOTE = "Green is consistent, red is wrong, all else cannot be checked."


@dataclass(frozen=True)
class ValidatedFrame:
    """One frame of the page."""

    name: str
    cells: Sequence[str]  # in the order of the page's columns
    picture: bytes | None = None  # PNG


def _build_page(
    title: str,
    sentences: Sequence[str],
    columns: Sequence[str],
    frames: Sequence[ValidatedFrame],
    *,
    failed: Sequence[str] = (),
    word: str = "validate",
    note: str = _STATES_NOTE,
) -> str:
    """The page: summary lines, a table of the frames with cells in the given order, and the figures."""
    top = [
        make_tag("h1", title),
        *(make_tag("p", text) for text in sentences),
        *(make_tag("p", text, class_="bad") for text in failed),
    ]
    table = build_scrolled_table(
        "All frames", ("frame", *columns), [(frame.name, frame.cells) for frame in frames if frame.cells]
    )
    figures = (_build_figure(frame.name, frame.picture) for frame in frames if frame.picture is not None)
    parts = (
        make_tag("header", *top, make_tag("p", note, class_="note")),
        make_tag("main", table, *figures),
    )
    return build_document(f"{title} · dhtorch {word}", *parts)


def build_scrolled_table(label: str, heads: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> Markup:
    """Table with a name and cells in each row, which scrolls on narrow screens; ``label`` names the region."""
    top = (make_tag("th", head, scope="col", class_="num" if k else None) for k, head in enumerate(heads))
    body = (
        make_tag("tr", make_tag("th", name, scope="row"), *(make_tag("td", cell, class_="num") for cell in cells))
        for name, cells in rows
    )
    table = make_tag("table", make_tag("thead", make_tag("tr", *top)), make_tag("tbody", *body))
    return make_tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=label)


def _build_figure(name: str, picture: bytes) -> Markup:
    scrolled = make_tag("div", make_tag("img", alt=name, src=encode_png_uri(picture)), class_="scroll", tabindex="0")
    return make_tag("figure", make_tag("figcaption", make_tag("strong", name)), scrolled)


def write_validation_page(path: Path, title: str, **shown: Any) -> Path:
    """Write the page; ``shown`` as :func:`_build_page` takes it.

    Raises:
        OSError: the file cannot be written.
    """
    return storage.replace_file(path, _build_page(title, **shown).encode("utf-8"))


def format_estimate(number: Mapping[str, float | None] | None, digits: int = 3) -> str:
    """Value with its interval -> table cell; – for an unknown value."""
    if number is None or number.get("value") is None:
        return "–"
    value, low, high = (number[name] for name in ("value", "low", "high"))
    if low is None or high is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
