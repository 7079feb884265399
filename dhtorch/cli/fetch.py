"""The command ``dhtorch fetch``: the public scenes behind ``data=shared_scenes``, from the addresses of a table.

The table (``shared_scenes.json``) has for every scene its licence, its source, and the SHA-256 of every file. Files
come one by one from a base address, or out of an archive; some are cut to the frames that are used. Licences are shown
first. An interrupted download goes on where it stopped; nothing gets its name before its digest is right.
"""

import contextlib
import hashlib
import http.client
import json
import os
import shutil
import sys
import tarfile
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from dhtorch.cli.option_checks import validate_choices
from dhtorch.runtime import console, storage
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, open_output_folder

#: Set of scenes → its table.
FETCHED_SETS = {"shared_scenes": Path(__file__).with_name("shared_scenes.json")}

#: Folder of downloads in progress, below the output folder.
_PARTS_FOLDER = Path(PRIVATE_FOLDER, "fetch")

#: Bytes of a file or an archive at most. Source: derived, the largest archive of the table has 0.4 GB.
MAX_BYTES = 2 * 10**9

#: Bytes read at a time. Source: chosen on no data, any size reads equally fast.
_BLOCK_BYTES = 1 << 20

#: Seconds without an answer after which a server is given up. Source: chosen on no data.
_TIMEOUT_S = 60


@dataclass(frozen=True)
class _FetchedScene:
    """A scene of the table."""

    folder: str
    licence: str
    source: str  # page of the data, for people
    files: Mapping[str, str]  # name → SHA-256 of its content, as it is written
    base: str = ""  # address before the names
    archive: str = ""  # address of an archive that holds all files; empty: each has its own
    archive_sha256: str | None = None  # None = unknown: the digests of the files are checked alone
    inside: str = ""  # folder of the files in the archive
    cut: Mapping[str, Mapping[str, list[float]]] = field(default_factory=dict)  # name → rows, or times of a trajectory
    texts: Mapping[str, str] = field(default_factory=dict)  # name → content of files that are ours


def read_fetch_table(path: Path) -> list[_FetchedScene]:
    """Scenes of a table.

    Raises:
        ValueError: no table, a name that leads out of the folder, or an address that is neither http nor https.
    """
    try:
        scenes = [_FetchedScene(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))["scenes"]]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path}: found no table of scenes ({error}), expected one as {path.name} of dhtorch"
        ) from None
    for scene in scenes:
        for name in (scene.folder, *scene.files, *scene.texts):
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\\" in name or ":" in name:
                raise ValueError(f"{path}: {scene.folder}: found the name {name!r}, expected one inside the folder")
        for address in filter(None, (scene.base, scene.archive)):
            if urllib.parse.urlsplit(address).scheme not in ("http", "https"):
                raise ValueError(f"{path}: {scene.folder}: found {address!r}, expected an http or https address")
    return scenes


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Any) -> int:
    """Run ``dhtorch fetch SET``: 0 if all files are there, 2 if the licences were not accepted.

    Raises:
        ValueError, OSError: a bad table, no answer of a server, a wrong digest, a folder that cannot be written.
    """
    validate_choices(settings, {"set": FETCHED_SETS})
    scenes = read_fetch_table(Path(settings["table"] or FETCHED_SETS[settings["set"]]))
    out = Path(settings["out"] or os.environ.get("DHTORCH_DATA") or "dhtorch_data").expanduser()
    for scene in scenes:
        digest = "" if not scene.archive or scene.archive_sha256 else "; digest of the archive unknown, files checked"
        print(f"{scene.folder}: {scene.licence}; {scene.source}{digest}")
    if not settings["yes"] and not (
        sys.stdin.isatty() and input("Accept these licences? [y/N] ").strip().lower() in ("y", "yes")
    ):
        print("dhtorch: licences not accepted, nothing fetched; --yes accepts them", file=sys.stderr)
        return 2
    n = fetch_scenes(scenes, out)
    print(
        f"{console.format_count(n, 'file')} fetched into {out}; "
        f"for data={settings['set']} set DHTORCH_DATA={out.resolve()}"
    )
    return 0


def fetch_scenes(scenes: Sequence[_FetchedScene], out: Path, *, max_bytes: int = MAX_BYTES) -> int:
    """Download the files of all scenes that ``out`` lacks → their number.

    Raises:
        ValueError: a wrong digest, an archive without a file, a file or archive above ``max_bytes``.
        OSError: no answer, a truncated answer (the next call goes on from there), or a foreign file in ``out``.
    """
    n = 0
    with open_output_folder(out, "out") as output:
        output.check_folders([out / _PARTS_FOLDER, *(out / scene.folder for scene in scenes)])
        for scene in scenes:
            folder = out / scene.folder
            missing = [name for name, digest in scene.files.items() if not _has_digest(folder / name, digest)]
            texts = {k: v.encode() for k, v in scene.texts.items() if not _has_digest(folder / k, _sha256(v.encode()))}
            output.check([folder / name for name in (*missing, *texts)])
            for name, content in (*_contents(scene, missing, out / _PARTS_FOLDER, max_bytes), *texts.items()):
                storage.replace_file(folder / name, content)
                n += 1
        shutil.rmtree(out / _PARTS_FOLDER, ignore_errors=True)
    return n


def _contents(scene: _FetchedScene, names: Sequence[str], parts: Path, max_bytes: int) -> Iterator[tuple[str, bytes]]:
    """(name, checked content) of the files of a scene, one after another."""
    if not scene.archive:
        for name in console.progress(names, scene.folder, len(names)):
            address = scene.base + urllib.parse.quote(name)
            file = download(address, parts, None if name in scene.cut else scene.files[name], max_bytes)
            yield name, _finish(scene, name, file.read_bytes(), address)
            file.unlink()
    elif names:
        file = download(scene.archive, parts, scene.archive_sha256, max_bytes)
        try:
            opened = zipfile.ZipFile(file) if zipfile.is_zipfile(file) else tarfile.open(file)  # noqa: SIM115
        except (tarfile.TarError, EOFError, OSError) as error:
            file.unlink()
            raise ValueError(f"{scene.archive}: found no tar or zip archive ({error})") from None
        with opened as archive:
            for name in names:
                content = _read_member(archive, scene.inside + name, scene.archive, max_bytes)
                yield name, _finish(scene, name, content, f"{scene.archive}, {scene.inside}{name}")
        file.unlink()


def _finish(scene: _FetchedScene, name: str, content: bytes, where: str) -> bytes:
    """Content of a file, cut to its rows, with the right digest."""
    cut, lines = scene.cut.get(name, {}), content.splitlines(keepends=True)
    if "rows" in cut:  # first and last, from 0
        first, last = cut["rows"]
        content = b"".join(lines[int(first) : int(last) + 1])
    elif cut:  # comments, and the lines between two times
        low, high = cut["times"]
        kept = []
        for line in lines:
            with contextlib.suppress(IndexError, ValueError):  # a line without a number is in no span of times
                if line.startswith(b"#") or low <= float(line.split()[0]) <= high:
                    kept.append(line)
        content = b"".join(kept)
    _check_digest(_sha256(content), scene.files[name], where)
    return content


def download(address: str, folder: Path, digest: str | None, max_bytes: int = MAX_BYTES) -> Path:
    """Download a file into ``folder``, from where an earlier try stopped → its path; None as digest = unknown.

    Raises:
        ValueError: more than ``max_bytes``, or another digest; what was downloaded is removed.
        OSError: no answer, or one that ends early; what was downloaded stays for the next try.
    """
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / hashlib.sha256(address.encode()).hexdigest()
    part = target.with_suffix(".part")
    start = part.stat().st_size if part.is_file() else 0
    try:
        with _open_address(address, start) as answer:
            start = start if answer.status == http.HTTPStatus.PARTIAL_CONTENT else 0
            length = answer.headers.get("Content-Length")
            # Write an answer to a file from byte ``start`` on → size of the file
            total = start
            with part.open("r+b" if start else "wb") as file:
                file.seek(start)
                while block := answer.read(_BLOCK_BYTES):
                    total += len(block)
                    if total > max_bytes:
                        file.close()
                        part.unlink()
                        raise ValueError(f"{address}: found more than {max_bytes} bytes, expected at most that")
                    file.write(block)
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
        raise OSError(f"{address}: {getattr(error, 'reason', None) or error}; run again to go on") from None
    if length is not None and total < start + int(length):
        raise OSError(f"{address}: found {total} bytes, expected {start + int(length)}; run again to go on")
    try:
        if digest is not None:
            _check_digest(storage.compute_file_digest(part), digest, address)
    except ValueError:
        part.unlink()
        raise
    part.replace(target)
    return target


def _open_address(address: str, start: int) -> Any:
    """Answer of a server from byte ``start`` on; from the beginning where it has no such byte."""
    headers = {"User-Agent": "dhtorch", **({"Range": f"bytes={start}-"} if start else {})}
    try:
        return urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if start and error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            return _open_address(address, 0)
        raise


def _read_member(archive: tarfile.TarFile | zipfile.ZipFile, name: str, address: str, max_bytes: int) -> bytes:
    """Content of a regular file of an archive; nothing else of it is unpacked."""
    try:
        if isinstance(archive, zipfile.ZipFile):
            info = archive.getinfo(name)
            is_file, size, stream = not info.is_dir() and info.external_attr >> 28 != 0xA, info.file_size, None
        else:
            member = archive.getmember(name)
            is_file, size, stream = member.isreg(), member.size, archive
        if not is_file:
            raise ValueError(f"{address}: found a link or folder as {name}, expected a file")
        if size > max_bytes:
            raise ValueError(f"{address}: found {size} bytes in {name}, expected at most {max_bytes}")
        if stream is None:
            return archive.read(name)  # type: ignore[union-attr]
        extracted = stream.extractfile(name)
        assert extracted is not None
        return extracted.read()
    except KeyError:
        raise ValueError(f"{address}: found no {name} in the archive, expected it") from None
    except (tarfile.TarError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"{address}: {name}: found a damaged archive ({error})") from None


def _has_digest(path: Path, digest: str) -> bool:
    return path.is_file() and not path.is_symlink() and storage.compute_file_digest(path) == digest


def _check_digest(actual: str, expected: str, where: str) -> None:
    if actual != expected:
        raise ValueError(f"{where}: found SHA-256 {actual[:16]}…, expected {expected[:16]}…")


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
