"""What all pages share: colours by day and in the dark, how text, tables and figures are set, and the frame around it.

A page adds rules of its own behind these; it holds nothing that lies elsewhere.
"""

from __future__ import annotations

from pathlib import Path

from dhtorch.viz.plots.colours import style_sheet
from dhtorch.viz.plots.markup import Markup, tag

_SHEET = Path(__file__).with_name("page.css")


def sheet(own: Path | None = None) -> Markup:
    """The style sheet of a page, with its own rules last."""
    return Markup("\n".join([style_sheet(), *(p.read_text(encoding="utf-8") for p in (_SHEET, own) if p is not None)]))


def document(title: str, *body: object, own: Path | None = None) -> str:
    """A page of its title and the children of its body; text is escaped unless it is markup."""
    metas = ({"charset": "utf-8"}, {"name": "viewport", "content": "width=device-width, initial-scale=1"})
    head = tag("head", *(tag("meta", **m) for m in metas), tag("title", title), tag("style", sheet(own)))
    return "<!doctype html>\n" + tag("html", head, tag("body", *body), lang="en") + "\n"
