"""Files beside the images that look like calibration, poses or metadata and that no reader opened.

Names alone decide what looks so. Files that a format defines and that hold neither cameras nor poses nor units are
listed by its reader as ``UNUSED_FILES`` (glob patterns of names).
"""

import os
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path

from dhtorch.runtime.console import format_count

_SUFFIXES = (".json", ".yaml", ".yml", ".txt", ".log", ".csv", ".ini", ".toml", ".xml", ".freiburg", ".sim", ".traj")

#: Names of folders of calibration or poses, whose files count whatever their suffix.
_FOLDERS = ("pose*", "intrinsic*", "extrinsic*", "calib*", "camera*", "cam_info*")

#: Names that do not describe the frames: texts about the capture, checksums, build files, and what dhtorch writes.
_OTHER_NAMES = (
    "readme*",
    "license*",
    "licence*",
    "citation*",
    "changelog*",
    "notice*",
    "requirements*.txt",
    "cmakelists.txt",
    "*checksum*",
    "*sums",
    "*sums.txt",
    "md5*",
    "sha1*",
    "sha256*",
    "complete.json",
    "dhtorch*.json",
    ".*",
)

_NUMBER = re.compile(r"\d+")
_MAX_NAMES_SHOWN = 5  # names in the line


def report_unread(root: Path, opened: Iterable[Path], unused: Sequence[str] = ()) -> list[str]:
    """The line on files at ``root`` and in its folders that look like metadata and were not opened; none = no line.

    Args:
        root: folder of the capture; a file has nothing beside it.
        opened: files that the reader opened. A folder with one of them is not searched, and a file whose name differs
            from one of them by numbers alone is not named: it belongs to a frame that is left out or read later.
        unused: names of files of the format that are left unread on purpose, as glob patterns.
    """
    if not root.is_dir():
        return []
    read = {os.path.realpath(file) for file in opened}
    read_folders = {str(folder) for file in read for folder in Path(file).parents}
    read_kinds = {_NUMBER.sub("#", file) for file in read if _NUMBER.search(Path(file).name)}
    names = []
    for entry in sorted(root.iterdir()):
        place = os.path.realpath(entry)
        if _is_other(entry.name, unused):
            continue
        if entry.is_dir():
            names += [] if place in read_folders else _list_folder(entry, unused)
        elif place not in read and entry.suffix.lower() in _SUFFIXES and _NUMBER.sub("#", place) not in read_kinds:
            names.append(entry.name)
    if not names:
        return []
    more = f" and {format_count(len(names) - _MAX_NAMES_SHOWN, 'other')}" if len(names) > _MAX_NAMES_SHOWN else ""
    return [f"not read: {', '.join(names[:_MAX_NAMES_SHOWN])}{more} (cameras, poses or units in them are not used)"]


def _list_folder(folder: Path, unused: Sequence[str]) -> list[str]:
    """Metadata files of a folder that was not read: its only one by name, several as the folder and their number."""
    is_metadata = any(fnmatch(folder.name.lower(), pattern) for pattern in _FOLDERS)
    files = [
        file.name
        for file in sorted(folder.iterdir())
        if not _is_other(file.name, unused)
        and (file.suffix.lower() in _SUFFIXES or (is_metadata and file.suffix))
        and file.is_file()
    ]
    if len(files) == 1:
        return [f"{folder.name}/{files[0]}"]
    return [f"{folder.name}/ ({format_count(len(files), 'file')})"] if files else []


def _is_other(name: str, unused: Sequence[str]) -> bool:
    return any(fnmatch(name.lower(), pattern.lower()) for pattern in (*_OTHER_NAMES, *unused))
