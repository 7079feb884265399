"""HTML pages: elements with escaped text and attributes, and the document shared by all pages.

The document has light and dark colours and the style of text, tables and figures. A page appends its own rules and
loads no external files.
"""

import base64
import html
import re
from collections.abc import Iterable
from pathlib import Path

from dhtorch.viz.plots.colours import build_colour_variables

_CONTROL = "\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff"

#: Characters not allowed in XML.
_FORBIDDEN = re.compile(f"[{_CONTROL}]")

#: Characters that must be replaced or escaped: those, unpaired surrogates, and markup characters.
_UNSAFE = re.compile(f"[{_CONTROL}\ud800-\udfff&<>\"']")


class Markup(str):
    """Text that is already markup and is not escaped again."""

    __slots__ = ()


def escape_html(text: object) -> Markup:
    """Text -> escaped markup; markup is returned unchanged."""
    if isinstance(text, Markup):
        return text
    plain = str(text)
    if not _UNSAFE.search(plain):
        return Markup(plain)
    plain = plain.encode("utf-8", "replace").decode()  # unpaired surrogates cannot be encoded
    return Markup(html.escape(_FORBIDDEN.sub("\ufffd", plain)))


def make_tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """HTML element; children are escaped unless they are markup, attributes that are None are omitted.

    A trailing underscore of an attribute name is dropped (``class_``), other underscores become hyphens.
    """
    attributes_text = "".join(
        f' {key.removesuffix("_").replace("_", "-")}="{escape_html(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    inner = join_markup(children)
    return Markup(
        f"<{name}{attributes_text}>{inner}</{name}>"
        if inner or name not in _VOID_ELEMENTS
        else f"<{name}{attributes_text}/>"
    )


def join_markup(parts: Iterable[object], between: str = "") -> Markup:
    """Concatenate parts, escaped unless they are markup."""
    return Markup(between.join(escape_html(part) for part in parts))


def encode_png_uri(picture: bytes) -> str:
    """PNG -> data URI."""
    return f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"


#: Elements without content or closing tag.
_VOID_ELEMENTS = frozenset(["meta", "link", "br", "hr", "img"])

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
