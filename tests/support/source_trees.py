"""Source files parsed once in a process, for the tests that read the package's code."""

import ast
import functools
from pathlib import Path


@functools.cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file, shared by its readers, none of which changes it."""
    return ast.parse(path.read_text(encoding="utf-8"))
