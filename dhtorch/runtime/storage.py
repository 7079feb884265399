"""Strict JSON and atomic file writing.

Strict JSON is the subset that all JSON parsers read alike: no ``NaN``, no ``Infinity``, no duplicate keys in an object.
"""

import contextlib
import hashlib
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from dhtorch.runtime import output_folder
from dhtorch.runtime.safe_open import MAX_TEXT_BYTES, open_regular, read_bytes, read_file_version

#: Maximum nesting of lists and objects in a file, as they are traversed by recursion.
_MAX_NESTING = 64

#: Characters of a file's name in the name of its unfinished file. Source: chosen, enough to recognise it.
_UNFINISHED_NAME_CHARACTERS = 32

#: Permissions of a written file: readable by all, writable by its owner.
_FILE_MODE = 0o644

#: Age in ns from which on a file's digest is kept: two writes within one step of the file system's clock may give one
#: version. Source: FAT's step, 2 s, the longest of the file systems in use.
_SETTLED_NS = 2_000_000_000

#: Digests of this process: version of a file (:func:`read_file_version`) → SHA-256.
_digests: dict[tuple[int, ...], str] = {}


def to_strict_json(value: Any) -> Any:
    """Python value -> value that strict JSON can hold: finite numbers, strings, lists, objects with string keys, null.

    Non-finite numbers become null; numpy and torch values become numbers and lists, paths become strings.

    Raises:
        TypeError: a value without a JSON counterpart.
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
    raise TypeError(f"result: found a {type(value).__name__}, expected a value that JSON can hold")


def dump_strict_json(value: Any, **layout: Any) -> str:
    """Value -> text in strict JSON; ``layout`` as for :func:`json.dumps`.

    Raises:
        ValueError: a number that is not finite (see :func:`to_strict_json`).
        TypeError: a value that JSON cannot hold.
    """
    return json.dumps(value, **{"ensure_ascii": False, **layout}, allow_nan=False)


def parse_strict_json(text: str) -> Any:
    """Text in strict JSON -> value.

    Raises:
        ValueError: no JSON, a number that is not finite, a duplicate key in an object, or values nested
            deeper than ``_MAX_NESTING``.
    """
    try:
        value = json.loads(text, parse_constant=_reject_constant, object_pairs_hook=_reject_duplicate_keys)
    except RecursionError:
        raise ValueError(f"values nested deeper than {_MAX_NESTING}") from None
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(_MAX_NESTING):
        level = [inner for item in level for inner in (item.values() if isinstance(item, dict) else item)]
        level = [item for item in level if isinstance(item, dict | list)]
    if level:
        raise ValueError(f"values nested deeper than {_MAX_NESTING}")
    return value


def read_utf8(path: str | Path) -> str:
    """Text of a file in UTF-8, of at most ``MAX_TEXT_BYTES``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no regular file, empty, too large, or bytes that are no UTF-8; the message names the file.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: found no such file, expected a file")
    try:
        return read_bytes(Path(path), MAX_TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: found {error.reason} at byte {error.start}, expected text in UTF-8") from None


def write_json(path: str | Path, value: Any) -> Path:
    """Write a value atomically as strict JSON, one line per member.

    Raises:
        ValueError: a number that is not finite; nothing is written.
    """
    return replace_file(path, (dump_strict_json(value, indent=1) + "\n").encode("utf-8"))


def replace_file(path: str | Path, content: bytes) -> Path:
    """Write a file atomically: ``path`` holds either its old content or all of the new content."""
    path = Path(path)
    with write_atomically(path) as file:
        file.write(content)
    return path


@contextlib.contextmanager
def write_atomically(path: str | Path) -> Iterator[IO[bytes]]:
    """Context with an open file, which gets the name ``path`` at the end; nothing is left if the block fails."""
    path = Path(path)
    with replace_at_end(path) as unfinished:
        try:
            with unfinished.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            if error.filename is not None or error.errno is None:
                raise
            raise OSError(error.errno, error.strerror, str(path)) from error  # full disk, file size limit


@contextlib.contextmanager
def replace_at_end(path: str | Path) -> Iterator[Path]:
    """Context with a path to write to: the file gets the name ``path`` at the end; nothing is left if the block fails.

    In an output folder that is open (:mod:`dhtorch.runtime.output_folder`) the file is entered in its manifest.

    Raises:
        FileExistsError: a link or a foreign file of an open output folder is in the way.
    """
    path = Path(path)
    folder = output_folder.find_output_folder(path)
    if folder is not None:
        folder.check([path])
    path.parent.mkdir(parents=True, exist_ok=True)
    if folder is not None:
        unfinished = folder.new_unfinished(path.suffix)
    else:  # beside the file, with a name that is no longer than that of the file may be
        prefix = f".{path.name[:_UNFINISHED_NAME_CHARACTERS]}."
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=output_folder.UNFINISHED_SUFFIX, dir=path.parent)
        os.close(handle)
        unfinished = Path(name)
    try:
        yield unfinished
        unfinished.chmod(_FILE_MODE)
        if folder is not None:
            folder.record(path, unfinished)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    with contextlib.suppress(OSError):  # so that the rename is durable, where the system can open folders
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def compute_file_digest(path: Path) -> str:
    """SHA-256 of all bytes of a file, in hex; a version of a file is read once in a process."""
    now_ns = time.time_ns()
    version = read_file_version(path)
    if (known := _digests.get(version)) is not None:
        return known
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if now_ns - max(version[-2:]) > _SETTLED_NS:
        _digests[version] = digest
    return digest


def copy_file(source: str | Path, path: str | Path) -> Path:
    """Copy a file atomically; does nothing if the source is missing or ``path`` already has its bytes.

    Raises:
        FormatError: the source is a link to outside the capture being read.
    """
    source, path = Path(source), Path(path)
    if not source.is_file():
        return path
    is_as_long = path.is_file() and path.stat().st_size == source.stat().st_size
    if is_as_long and compute_file_digest(path) == compute_file_digest(source):
        return path
    with open_regular(source) as source_file, write_atomically(path) as file:
        shutil.copyfileobj(source_file, file)
    return path


def has_files(folder: Path) -> bool:
    """Whether a folder or its subfolders hold a file, unfinished files and dhtorch's own records excluded."""
    files = (entry for entry in folder.rglob("*") if entry.is_symlink() or not entry.is_dir())
    return any(
        not (output_folder.is_private(f.relative_to(folder)) or output_folder.is_unfinished(f.name)) for f in files
    )


def _reject_constant(word: str) -> None:
    raise ValueError(f"the constant {word}")


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {next(n for n in names if names.count(n) > 1)!r} twice")
    return members
