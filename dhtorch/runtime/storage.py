"""Strict JSON, and files that hold either what they held before or all of the new content.

Strict JSON is what every reader of JSON understands alike: no ``NaN``, no ``Infinity``, and no key twice in an object.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

#: Lists and objects inside one another that a file may hold: whoever walks through them does so by recursion.
_MAX_NESTING = 64

#: How the name of a file ends while it is written.
_UNFINISHED_SUFFIX = ".tmp"


def to_strict_json(value: Any) -> Any:
    """The same value in what strict JSON can hold: finite numbers, strings, lists, objects with string keys, null.

    Non-finite numbers become null; numpy and torch values become numbers and lists, paths become strings.

    Raises:
        TypeError: a value that has no counterpart.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): to_strict_json(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_strict_json(v) for v in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # torch.Tensor, numpy.ndarray and numpy scalars
        return to_strict_json(value.tolist())
    raise TypeError(f"result: found a {type(value).__name__}, expected something that JSON can hold")


def dump_strict_json(value: Any, **layout: Any) -> str:
    """Strict JSON of what has a counterpart in it; ``layout`` as for :func:`json.dumps`.

    Raises:
        ValueError: a number that is not finite (see :func:`to_strict_json`).
        TypeError: a value that JSON does not know.
    """
    return json.dumps(value, **{"ensure_ascii": False, **layout}, allow_nan=False)


def parse_strict_json(text: str) -> Any:
    """The value of a text in strict JSON.

    Raises:
        ValueError: no JSON, a number that is not finite, a key that stands twice in one object, or values nested
            deeper than ``_MAX_NESTING``.
    """
    try:
        value = json.loads(text, parse_constant=_reject_constant, object_pairs_hook=_reject_duplicate_keys)
    except RecursionError:
        raise ValueError(f"values nested deeper than {_MAX_NESTING}") from None
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(_MAX_NESTING):
        level = [inner for each in level for inner in (each.values() if isinstance(each, dict) else each)]
        level = [each for each in level if isinstance(each, dict | list)]
    if level:
        raise ValueError(f"values nested deeper than {_MAX_NESTING}")
    return value


def write_json(path: str | Path, value: Any) -> Path:
    """Write a value as strict JSON, a line for every member, so that ``path`` never holds half of it.

    Raises:
        ValueError: a number that is not finite; nothing is written.
    """
    return replace_file(path, (dump_strict_json(value, indent=1) + "\n").encode("utf-8"))


@contextlib.contextmanager
def _add_path_to_errors(path: Path) -> Iterator[None]:
    """An error of the system that names no file (a full disk, a limit of size) names ``path``."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def replace_file(path: str | Path, content: bytes) -> Path:
    """Write a file so that, whatever happens, ``path`` holds either what it held before or all of the new content."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=_UNFINISHED_SUFFIX, dir=path.parent)
    os.close(handle)
    with write_atomically(path, Path(name)) as file:
        file.write(content)
        Path(name).chmod(0o644)
    _sync_folder(path.parent)
    return path


@contextlib.contextmanager
def write_atomically(path: Path, unfinished: Path) -> Iterator[IO[bytes]]:
    """The file ``unfinished``, in the folder of ``path``, to be written: it is ``path`` once the block ends, and gone
    where the block fails."""
    try:
        with _add_path_to_errors(path), unfinished.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def copy_file(source: str | Path, path: str | Path) -> Path:
    """Copy a file, however large, so that ``path`` never holds half of it; nothing is done where there is no source, or
    a copy of its size already."""
    source, path = Path(source), Path(path)
    if not source.is_file() or (path.is_file() and path.stat().st_size == source.stat().st_size):
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        source.open("rb") as found,
        write_atomically(path, path.with_name(f".{path.name}.copy{_UNFINISHED_SUFFIX}")) as file,
    ):
        shutil.copyfileobj(found, file)
    return path


def remove_unfinished_files(path: str | Path) -> None:
    """Remove what a writer of ``path`` left beside it when it was killed. Nobody may be writing ``path`` meanwhile."""
    path = Path(path)
    for left in path.parent.glob(f".{path.name}.*{_UNFINISHED_SUFFIX}"):
        left.unlink(missing_ok=True)


def has_files(folder: Path) -> bool:
    """Whether a file lies in a folder or below; what an interrupted write left of one does not count."""
    inside = (entry for entry in folder.rglob("*") if entry.is_symlink() or not entry.is_dir())
    return any(not (f.name.startswith(".") and f.name.endswith(_UNFINISHED_SUFFIX)) for f in inside)


def _reject_constant(word: str) -> None:
    raise ValueError(f"the constant {word}")


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {next(n for n in names if names.count(n) > 1)!r} twice")
    return found


def _sync_folder(folder: Path) -> None:
    """Make a rename durable, where the system lets a folder be opened."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)
