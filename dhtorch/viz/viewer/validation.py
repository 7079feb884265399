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
from dhtorch.viz.plots.document import document
from dhtorch.viz.plots.markup import Markup, png_address, tag

#: Under the numbers of a judged data set.
JUDGED = "Green is consistent, red is wrong; of all else nothing can be known."


@dataclass(frozen=True)
class JudgedFrame:
    """One frame of the page."""

    name: str
    cells: Sequence[str]  # in the order of the page's columns
    picture: bytes | None = None  # PNG


def page(
    title: str,
    said: Sequence[str],
    columns: Sequence[str],
    frames: Sequence[JudgedFrame],
    *,
    failed: Sequence[str] = (),
    word: str = "judge",
    note: str = JUDGED,
) -> str:
    """The page: what is said of the whole, a table of all frames in the order given, and the pictures."""
    top = [tag("h1", title), *(tag("p", text) for text in said), *(tag("p", text, class_="bad") for text in failed)]
    heads = (tag("th", name, scope="col", class_="num" if k else None) for k, name in enumerate(("frame", *columns)))
    rows = (
        tag("tr", tag("th", frame.name, scope="row"), *(tag("td", cell, class_="num") for cell in frame.cells))
        for frame in frames
    )
    table = tag("table", tag("thead", tag("tr", *heads)), tag("tbody", *rows))
    about = {"class_": "scroll", "tabindex": "0", "role": "region", "aria_label": "All frames"}
    figures = (_figure(frame.name, frame.picture) for frame in frames if frame.picture is not None)
    parts = (tag("header", *top, tag("p", note, class_="note")), tag("main", tag("div", table, **about), *figures))
    return document(f"{title} · dhtorch {word}", *parts)


def _figure(name: str, picture: bytes) -> Markup:
    scrolled = tag("div", tag("img", alt=name, src=png_address(picture)), class_="scroll", tabindex="0")
    return tag("figure", tag("figcaption", tag("strong", name)), scrolled)


def write(path: Path, title: str, **shown: Any) -> Path:
    """Write the page; ``shown`` as :func:`page` takes it.

    Raises:
        OSError: the file cannot be written.
    """
    return storage.replace_file(path, page(title, **shown).encode("utf-8"))


def cell(number: Mapping[str, float | None] | None, digits: int = 3) -> str:
    """A number with its interval, as a table shows it; – where it cannot be known."""
    if number is None or number.get("value") is None:
        return "–"
    value, low, high = (number[name] for name in ("value", "low", "high"))
    if low is None or high is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
