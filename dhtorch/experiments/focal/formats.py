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
from dhtorch.data.survey import Survey, Tile, describe_camera, describe_pixels, report_depths, warn_of_duplicates
from dhtorch.experiments.focal import ddff12, fod500, image_folder
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks
from dhtorch.runtime.console import format_count
from dhtorch.runtime.safe_open import check_file_or_folder, restrict_links

# Survey of focal stacks for ``inspect``: facts, warnings and sample images.


def survey_stacks(stacks: FocalStacks, shown: int = 8) -> Survey:
    """Facts, warnings and at most ``shown`` image tiles of focal stacks, from the first stack."""
    out = Survey(stacks.name, stacks.format)
    stack: FocalStack = stacks[0]
    images = stack.images[0]
    s, c, h, w = images.shape
    out.add_fact("focal stacks", f"{len(stacks)}, of {format_count(s, 'picture')} each")
    out.add_fact("pictures", f"{w}x{h}, {describe_pixels(c, images)}")
    if stack.focus_m is None:
        out.warn("no focus distances: only the order of the pictures is available")
    else:
        out.add_fact("in focus at", ", ".join(f"{x:.3g}" for x in stack.focus_m[0].tolist()) + " m")
    if stack.focal_length_m is not None and stack.f_number is not None:
        out.add_fact("lens", f"f = {1e3 * float(stack.focal_length_m):g} mm, N = {float(stack.f_number):g}")
    if stack.camera is not None:
        out.add_fact("intrinsics", describe_camera(stack.camera, (h, w)))
    if stack.depth is not None:
        report_depths([stack.depth[0]], out)
    warn_of_duplicates(list(images), out, "pictures")
    out.warnings.extend(stacks.report)
    for k in sorted({round(k * (s - 1) / max(shown - 1, 1)) for k in range(shown)}):
        out.tiles.append(Tile(f"picture {k + 1}", images[k]))
    if stack.depth is not None:
        out.tiles.append(Tile("truth", depth=stack.depth[0]))
    return out


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
