"""HTML document shared by all pages: light and dark colours, style of text, tables and figures.

A page appends its own rules; it loads no external files.
"""

from __future__ import annotations

from pathlib import Path

from dhtorch.viz.plots.colours import build_colour_variables
from dhtorch.viz.plots.markup import Markup, make_tag

_STYLE_SHEET = Path(__file__).with_name("page.css")


def build_style_sheet(own: Path | None = None) -> Markup:
    """Style sheet of a page, with its own rules last."""
    return Markup(
        "\n".join(
            [build_colour_variables(), *(p.read_text(encoding="utf-8") for p in (_STYLE_SHEET, own) if p is not None)]
        )
    )


def build_document(title: str, *body: object, own: Path | None = None) -> str:
    """Title and body elements -> HTML page; text is escaped unless it is markup."""
    metas = ({"charset": "utf-8"}, {"name": "viewport", "content": "width=device-width, initial-scale=1"})
    head = make_tag(
        "head",
        *(make_tag("meta", **m) for m in metas),
        make_tag("title", title),
        make_tag("style", build_style_sheet(own)),
    )
    return "<!doctype html>\n" + make_tag("html", head, make_tag("body", *body), lang="en") + "\n"
