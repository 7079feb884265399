"""The code that a job can reach: modules that its settings name, what these import, and the data beside them.

A result counts as finished as long as none of this changes: another experiment, a viewer or the command may be edited
under a sweep that goes on, a stage may not.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

_PACKAGE = "dhtorch"

#: An import of this package at any depth of a file; also one in a docstring, which reaches too far and no harm.
_IMPORT_PATTERN = re.compile(
    r"^[ \t]*(?:from[ \t]+(dhtorch[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+(dhtorch[\w.]*))",
    re.MULTILINE,
)


def iter_targets(settings: Any) -> Iterator[str]:
    """Dotted names of the functions that settings name, at every depth."""
    if isinstance(settings, Mapping):
        if isinstance(settings.get("_target_"), str):
            yield settings["_target_"]
        settings = list(settings.values())
    for value in settings if isinstance(settings, list | tuple) else ():
        yield from iter_targets(value)


def find_reachable_modules(names: Iterable[str], folder: str | Path | None = None) -> dict[str, Path]:
    """Name → file of all code behind the dotted ``names`` of modules and functions, and of the data beside it.

    Imports inside functions count like others. Of a package of somebody else the module that is named counts, and what
    it imports of this one. What files a module may read is told by its folder: all that is no code in the folder of a
    subpackage counts with its modules.

    Args:
        names: dotted; what does not exist is passed over.
        folder: of this package; None = the installed package.
    """
    folder = Path(__file__).parents[1] if folder is None else Path(folder)
    found: dict[str, Path] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        for key, path in _find_module_files(name, folder).items():
            if key in found:
                continue
            found[key] = path
            # What the package itself names is imported when it is asked for, and then stands here as its own module.
            if key != "__init__.py":
                waiting += iter_imports(path.read_text(encoding="utf-8"))
    beside = {p.parent for key, p in found.items() if "/" in key and not key.startswith(_EXTERNAL_PREFIX)}
    for place in beside:
        found |= {p.relative_to(folder).as_posix(): p for p in place.iterdir() if p.is_file() and p.suffix != ".py"}
    return dict(sorted(found.items()))


def iter_imports(source: str) -> Iterator[str]:
    """Dotted names that a file imports of this package, ``from a import b`` as a.b."""
    for module, names, plain in _IMPORT_PATTERN.findall(source):
        yield plain or module
        for name in re.sub(r"#[^\n]*", "", names).strip("() \n").split(","):
            if name.strip():
                yield f"{module}.{name.split()[0]}"


#: Begins the name of a module of somebody else.
_EXTERNAL_PREFIX = "elsewhere:"


def _find_module_files(name: str, folder: Path) -> dict[str, Path]:
    """The module that holds ``name``, and the packages that are loaded with it."""
    first, *rest = name.split(".")
    if first != _PACKAGE:
        return _find_external_file(name)
    for length in range(len(rest), -1, -1):
        base = folder.joinpath(*rest[:length])
        if length and (path := base.with_suffix(".py")).is_file():
            break
        if (path := base / "__init__.py").is_file():
            break
    else:
        return {}
    packages = [p / "__init__.py" for p in path.parents if p == folder or folder in p.parents]
    return {p.relative_to(folder).as_posix(): p for p in (path, *packages) if p.is_file()}


def _find_external_file(name: str) -> dict[str, Path]:
    """The file of somebody else's module that holds ``name``."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            spec = importlib.util.find_spec(".".join(parts[:length]))
        except (ImportError, ValueError, AttributeError):
            continue
        if spec is not None:
            ours = spec.origin is not None and spec.origin.endswith(".py")
            return {_EXTERNAL_PREFIX + spec.name: Path(str(spec.origin))} if ours else {}
    return {}
