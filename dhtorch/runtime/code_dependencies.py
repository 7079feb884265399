"""Source files that a job depends on: modules named in its settings, their imports, and the data files beside them.

A result stays valid while none of these files change: editing another experiment, a viewer or the command does not
invalidate a running sweep, editing a stage does.
"""

import ast
import hashlib
import importlib.util
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

_PACKAGE = "dhtorch"

#: An import of this package anywhere in a file; also matches docstrings, which adds dependencies but misses none.
_IMPORT_PATTERN = re.compile(
    r"^[ \t]*(?:from[ \t]+(dhtorch[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+(dhtorch[\w.]*))",
    re.MULTILINE,
)


def iter_targets(settings: Any) -> Iterator[str]:
    """Dotted names of all ``_target_`` functions in nested settings."""
    if isinstance(settings, Mapping):
        if isinstance(settings.get("_target_"), str):
            yield settings["_target_"]
        settings = list(settings.values())
    for value in settings if isinstance(settings, list | tuple) else ():
        yield from iter_targets(value)


def find_reachable_modules(names: Iterable[str], folder: str | Path | None = None) -> dict[str, Path]:
    """Name → file of all code reachable from the dotted ``names`` of modules and functions, and of the data beside it.

    Imports inside functions count. Of a third-party package only the named module counts, and what it imports of this
    package. All files other than code in the folder of a subpackage count with its modules, which may read them.

    Args:
        names: dotted; unknown names are ignored.
        folder: of this package; None = the installed package.
    """
    folder = Path(__file__).parents[1] if folder is None else Path(folder)
    files: dict[str, Path] = {}
    waiting = list(names)
    visited: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in visited:
            continue
        visited.add(name)
        for key, path in _find_module_files(name, folder).items():
            if key in files:
                continue
            files[key] = path
            # The package's own __init__ imports lazily: such modules appear under their own names.
            if key != "__init__.py":
                waiting += iter_imports(path.read_text(encoding="utf-8"))
    folders = {p.parent for key, p in files.items() if "/" in key and not key.startswith(_EXTERNAL_PREFIX)}
    for path in (p for subfolder in folders for p in (*subfolder.iterdir(), *subfolder.glob("csrc/*"))):
        if path.is_file() and path.suffix != ".py":
            files[path.relative_to(folder).as_posix()] = path
    return dict(sorted(files.items()))


def compute_code_digest(files: Mapping[str, Path]) -> str:
    """Name → file, from :func:`find_reachable_modules` -> SHA-256 over syntax trees; comments, layout and docstrings do
    not enter."""
    total = hashlib.sha256()
    for name in sorted(files):
        total.update(f"{name} {digest_source(files[name])} ".encode())
    return total.hexdigest()


def digest_source(path: Path) -> str:
    """SHA-256 of the syntax tree of a Python file without docstrings; of the bytes of any other file."""
    content = path.read_bytes()
    return _digest_syntax(content) if path.suffix == ".py" else hashlib.sha256(content).hexdigest()


@lru_cache(maxsize=1024)  # the jobs of a sweep reach the same modules
def _digest_syntax(source: bytes) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def iter_imports(source: str) -> Iterator[str]:
    """Source text -> dotted names imported from this package, ``from a import b`` as a.b."""
    for module, names, plain in _IMPORT_PATTERN.findall(source):
        yield plain or module
        for name in re.sub(r"#[^\n]*", "", names).strip("() \n").split(","):
            if name.strip():
                yield f"{module}.{name.split()[0]}"


#: Prefix of the names of third-party modules.
_EXTERNAL_PREFIX = "elsewhere:"


def _find_module_files(name: str, folder: Path) -> dict[str, Path]:
    """Files of the module with ``name``, and of the packages loaded with it."""
    first, *rest = name.split(".")
    if first != _PACKAGE:
        # File of the third-party module with ``name``
        parts = name.split(".")
        for length in range(len(parts), 0, -1):
            try:
                spec = importlib.util.find_spec(".".join(parts[:length]))
            except (ImportError, ValueError, AttributeError):
                continue
            if spec is not None:
                is_python = spec.origin is not None and spec.origin.endswith(".py")
                return {_EXTERNAL_PREFIX + spec.name: Path(str(spec.origin))} if is_python else {}
        return {}
    for length in range(len(rest), -1, -1):
        base = folder.joinpath(*rest[:length])
        if length and (path := base.with_suffix(".py")).is_file():
            break
        if (path := base / "__init__.py").is_file():
            break
    else:
        return {}
    packages = [folder.joinpath(*rest[:above], "__init__.py") for above in range(length - 1, -1, -1)]
    return {p.relative_to(folder).as_posix(): p for p in (path, *packages) if p.is_file()}
