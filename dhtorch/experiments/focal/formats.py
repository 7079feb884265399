"""Open focal stacks of any supported format: ``open_stacks(path)``."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from dhtorch.data import scenes_root
from dhtorch.data.io.decode import FormatError
from dhtorch.experiments.focal import ddff12, fod500, image_folder
from dhtorch.experiments.focal.stacks import FocalStacks
from dhtorch.runtime.safe_open import check_file_or_folder, restrict_links

#: Name → reader, tried in this order; the first that recognises a folder reads it.
STACK_FORMATS: Final[dict[str, ModuleType]] = {"fod500": fod500, "ddff12": ddff12, "images": image_folder}


def open_stacks(root: str | Path, format: str = "auto", *, follow_links: bool = False, **options: Any) -> FocalStacks:
    """Open the focal stacks at ``root`` lazily: a stack is decoded when it is indexed.

    Args:
        root: a folder, or an HDF5 file.
        format: ``fod500``, ``ddff12``, ``images``, or ``auto`` to recognise it by its content.
        follow_links: whether symbolic links below ``root`` may lead out of it.
        options: keyword options of the reader, see ``dhtorch.experiments.focal.<format>.read`` (``images``:
            ``image_folder``).

    Raises:
        FormatError: missing path, unknown format, or a file that violates its format.
        ValueError: an option unknown to the reader.
    """
    root = Path(root)
    check_file_or_folder(root, "focal stacks")
    if format == "auto":
        format = recognise_stacks(root, follow_links=follow_links, are_stacks=True)[0]
    elif format not in STACK_FORMATS:
        raise FormatError(root, "format", format, f"auto, {', '.join(STACK_FORMATS)}")
    read = STACK_FORMATS[format].read
    valid_options = list(inspect.signature(read).parameters)[1:]
    for option in options:
        if option not in valid_options:
            raise ValueError(
                f"stacks: format {format} has no option {option!r}, expected one of {', '.join(valid_options)}"
            )
    bounds = None if follow_links else root
    with restrict_links(bounds):
        return replace(read(root, **options), bounds=bounds)


def recognise_stacks(root: str | Path, *, follow_links: bool = False, are_stacks: bool = False) -> tuple[str, str]:
    """Format of the focal stacks at ``root`` and the text of the evidence for it.

    Args:
        root, follow_links: as :func:`open_stacks`.
        are_stacks: whether the caller states that ``root`` holds focal stacks. Images of one size are one then; else a
            name must show it.

    Raises:
        FormatError: no format recognises it.
    """
    with restrict_links(None if follow_links else Path(root)):
        for name, reader in STACK_FORMATS.items():
            if evidence := reader.recognise(Path(root)):
                return name, evidence
        if are_stacks and (evidence := image_folder.describe_images(Path(root))):
            return "images", evidence
    raise FormatError(root, "format", "no focal stack", f"one of {', '.join(STACK_FORMATS)}")


def open_collections(root: str | Path | None = None, scenes: Sequence[Mapping[str, Any]] = ()) -> list[FocalStacks]:
    """Open the focal stacks of a list of scenes below one folder.

    Args:
        root: folder to which the scenes' paths are relative. None = the environment variable ``DHTORCH_DATA``.
        scenes: for each, ``path`` and any arguments of :func:`open_stacks`.

    Raises:
        FormatError: as :func:`dhtorch.data.open_scenes`.
    """
    root = scenes_root(root)
    for scene in scenes:
        if "path" not in scene:
            raise FormatError(root, "scenes", dict(scene), "an entry with a path")
    return [open_stacks(root / str(s["path"]), **{k: v for k, v in s.items() if k != "path"}) for s in scenes]
