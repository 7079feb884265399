"""What is said of the depth of a data set, judged or anchored, as one HTML page that needs nothing beside itself:
worst first.

Names come from files of others: they are escaped. Pictures are inside the page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dhtorch.runtime import storage
from dhtorch.viz.plots.document import build_document
from dhtorch.viz.plots.markup import Markup, encode_png_uri, make_tag

#: Under the numbers of a judged data set.
_STATES_NOTE = "Green is consistent, red is wrong; of all else nothing can be known."


@dataclass(frozen=True)
class ValidatedFrame:
    """One frame of the page."""

    name: str
    cells: Sequence[str]  # in the order of the page's columns
    picture: bytes | None = None  # PNG


def _build_page(
    title: str,
    said: Sequence[str],
    columns: Sequence[str],
    frames: Sequence[ValidatedFrame],
    *,
    failed: Sequence[str] = (),
    word: str = "judge",
    note: str = _STATES_NOTE,
) -> str:
    """The page: what is said of the whole, a table of all frames in the order given, and the pictures."""
    top = [
        make_tag("h1", title),
        *(make_tag("p", text) for text in said),
        *(make_tag("p", text, class_="bad") for text in failed),
    ]
    heads = (
        make_tag("th", name, scope="col", class_="num" if k else None) for k, name in enumerate(("frame", *columns))
    )
    rows = (
        make_tag(
            "tr", make_tag("th", frame.name, scope="row"), *(make_tag("td", cell, class_="num") for cell in frame.cells)
        )
        for frame in frames
    )
    table = make_tag("table", make_tag("thead", make_tag("tr", *heads)), make_tag("tbody", *rows))
    about = {"class_": "scroll", "tabindex": "0", "role": "region", "aria_label": "All frames"}
    figures = (_build_figure(frame.name, frame.picture) for frame in frames if frame.picture is not None)
    parts = (
        make_tag("header", *top, make_tag("p", note, class_="note")),
        make_tag("main", make_tag("div", table, **about), *figures),
    )
    return build_document(f"{title} · dhtorch {word}", *parts)


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
    """A number with its interval, as a table shows it; – where it cannot be known."""
    if number is None or number.get("value") is None:
        return "–"
    value, low, high = (number[name] for name in ("value", "low", "high"))
    if low is None or high is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
