"""HTML elements with escaped text and attributes."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable

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
