"""How a docstring of this project becomes Markdown: what mkdocstrings (griffe) is told before it reads one.

Docstrings here are Google's ``Args``, ``Returns``, ``Raises`` and closing words of our own (``Gradient: …``), shapes
stand behind arguments and fields as comments, and names are marked as Sphinx does. The comments become part of the
text, the words and the marks plain Markdown.
"""

import re
from typing import Any

import griffe

#: Words that open a paragraph of a docstring and are no section to griffe.
WORDS = ("Gradient", "Cost", "Source", "Flags", "Gates", "Codes", "Alphabet", "Question", "What would refute it")

_WORD = re.compile(rf"^({'|'.join(WORDS)}|Expectation \([^)]*\)): ", re.M)
_ROLE = re.compile(r":(?:class|func|mod|data|meth|attr|exc):`~?([\w.]+)`")
_COMMENT = re.compile(r"#:?\s+(?P<text>\S.*)$")
_SECTION = re.compile(r"^(Returns|Yields|Raises): +(?=\S)", re.M)


class HouseStyle(griffe.Extension):
    """Rewrite docstrings before they are parsed."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Modules, classes, functions, fields and constants alike."""
        if obj.is_attribute and obj.docstring is None:
            text = _comment_of(obj)
            if text:
                obj.docstring = griffe.Docstring(text, lineno=obj.lineno, parent=obj)
        if obj.is_function:
            _note_shapes(obj)
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(docstring: str) -> str:
    """Our closing words as paragraphs of their own, names in code type."""
    text = _SECTION.sub(lambda m: f"\n**{m[1]}:** ", docstring)  # a section in one line is a sentence
    text = _WORD.sub(lambda m: f"\n**{m[1]}:** ", text)
    text = _ROLE.sub(r"`\1`", text)
    text = re.sub(r"::$", ":", text, flags=re.M)  # what stands indented below is code to Markdown as well
    # Markdown would read these as links or emphasis; inside ``…`` they are left alone.
    return re.sub(r"(?<=\w)\*(?=\w)", r"\\*", text)


def _lines(obj: Any) -> list[str]:
    """The source lines of an object, from the file's text."""
    if obj.lineno is None or not isinstance(obj.filepath, type(obj.package.filepath)):
        return []
    whole = obj.lines_collection[obj.filepath]
    return whole[obj.lineno - 1 : obj.endlineno or obj.lineno]


def _comment_of(obj: Any) -> str:
    """What stands behind a field or a constant, or above it as ``#:``."""
    lines = _lines(obj)
    if lines and (match := _COMMENT.search(_without_strings(lines[-1]))):
        return lines[-1][match.start("text") :].strip()
    whole, above = obj.lines_collection[obj.filepath], []
    for line in reversed(whole[: (obj.lineno or 1) - 1]):
        if not line.strip().startswith("#:"):
            break
        above.append(line.strip()[2:].strip())
    return " ".join(reversed(above))


def _note_shapes(function: Any) -> None:
    """Shapes behind the arguments of a signature, as entries of ``Args`` (or before the words there)."""
    shapes: dict[str, str] = {}
    names = {p.name for p in function.parameters}
    for line in _lines(function):
        if '"""' in line:
            break
        opens = re.match(r"\s*(\w+)\s*[:=,]", line)
        match = _COMMENT.search(_without_strings(line))
        if opens and match and opens[1] in names:
            shapes[opens[1]] = match["text"].strip()
    if not shapes or function.docstring is None:
        return
    text = function.docstring.value
    for name in [n for n in shapes if re.search(rf"^ {{4}}{n}: ", text, re.M)]:
        text = re.sub(rf"^( {{4}}{name}: )", rf"\g<1>{_escaped(shapes.pop(name))}; ", text, count=1, flags=re.M)
    entries = "".join(f"    {name}: {shape}\n" for name, shape in shapes.items())
    if entries and "\nArgs:\n" in text:
        text = text.replace("\nArgs:\n", f"\nArgs:\n{entries}", 1)
    elif entries:
        text = f"{text.rstrip()}\n\nArgs:\n{entries}"
    function.docstring.value = text


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\")


def _without_strings(line: str) -> str:
    """The line with string literals blanked, so that a ``#`` in one opens no comment."""
    return re.sub(r"\"[^\"]*\"|'[^']*'", lambda m: "_" * len(m[0]), line)
