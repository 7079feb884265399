"""HTML as text that cannot be broken by what is put into it."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable

_CONTROL = "\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff"

#: What XML cannot hold at all.
_FORBIDDEN = re.compile(f"[{_CONTROL}]")

#: What cannot stand in markup as it is: that, halves of surrogate pairs, and markup's own signs.
_UNSAFE = re.compile(f"[{_CONTROL}\ud800-\udfff&<>\"']")


class Markup(str):
    """Text that is markup already and is not escaped again."""

    __slots__ = ()


def escape_html(text: object) -> Markup:
    """Text as it stands in markup; markup stays as it is."""
    if isinstance(text, Markup):
        return text
    plain = str(text)
    if not _UNSAFE.search(plain):
        return Markup(plain)
    plain = plain.encode("utf-8", "replace").decode()  # half a surrogate pair cannot be written to a file
    return Markup(html.escape(_FORBIDDEN.sub("\ufffd", plain)))


def make_tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """An element: children are escaped unless they are markup, attributes that are None are left out.

    An underscore at the end of an attribute's name is dropped (``class_``), others become hyphens.
    """
    said = "".join(
        f' {key.removesuffix("_").replace("_", "-")}="{escape_html(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    inner = join_markup(children)
    return Markup(f"<{name}{said}>{inner}</{name}>" if inner or name not in _VOID_ELEMENTS else f"<{name}{said}/>")


def join_markup(parts: Iterable[object], between: str = "") -> Markup:
    """Parts one after the other, escaped unless they are markup."""
    return Markup(between.join(escape_html(part) for part in parts))


def encode_png_uri(picture: bytes) -> str:
    """A picture as an address that holds it: a page needs nothing beside itself."""
    return f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"


#: Elements that have no content; any other without content keeps its closing tag.
_VOID_ELEMENTS = frozenset(["meta", "link", "br", "hr", "img"])
