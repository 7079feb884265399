"""What is said of the depth of a data set, judged or anchored, as one HTML page that needs nothing beside itself:
worst first.

Names come from files of others: they are escaped. Pictures are inside the page.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dhtorch import storage
from dhtorch.drawing.colours import style_sheet

#: Under the numbers of a judged data set.
JUDGED = "Green is consistent, red is wrong; of all else nothing can be known."

_STYLE = """
body { margin: 0 auto; max-width: 76rem; padding: 1.2rem; background: var(--ground); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1, h2 { overflow-wrap: anywhere; } p { max-width: 60rem; } .note { color: var(--soft); }
.bad { color: var(--bad); font-weight: 600; } .good { color: var(--good); font-weight: 600; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.9rem; }
th, td { padding: 0.2rem 0.6rem; text-align: right; border-bottom: 1px solid var(--faint); }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; height: auto; } .scroll { overflow-x: auto; }
"""


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
    lines = ["<!doctype html>", '<html lang="en"><head><meta charset="utf-8">']
    lines += [
        f"<title>{html.escape(title)} · dhtorch {word}</title>",
        f"<style>{style_sheet()}{_STYLE}</style></head><body>",
    ]
    lines += [f"<h1>{html.escape(title)}</h1>", *(f"<p>{html.escape(text)}</p>" for text in said)]
    lines += [f'<p class="bad">{html.escape(text)}</p>' for text in failed]
    lines += [f'<p class="note">{html.escape(note)}</p>']
    head = "".join(f"<th>{html.escape(name)}</th>" for name in ("frame", *columns))
    lines += ['<div class="scroll"><table>', f"<thead><tr>{head}</tr></thead><tbody>"]
    for frame in frames:
        cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in (frame.name, *frame.cells))
        lines.append(f"<tr>{cells}</tr>")
    lines.append("</tbody></table></div>")
    for frame in frames:
        if frame.picture is not None:
            data = base64.b64encode(frame.picture).decode("ascii")
            name = html.escape(frame.name, quote=True)
            lines += [f"<h2>{name}</h2>", f'<img alt="{name}" src="data:image/png;base64,{data}">']
    return "\n".join([*lines, "</body></html>", ""])


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
