"""Open focal stacks of any supported format: ``open_stacks(path)``; FoD500 and folders of images."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import scenes_root
from dhtorch.data.codecs import exr, tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.survey import Survey, Tile, describe_camera, describe_pixels, report_depths, warn_of_duplicates
from dhtorch.experiments.focal import ddff12
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks, parse_focus_distances, read_pictures
from dhtorch.runtime.console import format_count
from dhtorch.runtime.safe_open import check_file_or_folder, restrict_links

# FoD500 (Focus on Defocus): five rendered images of a table of objects at different focus distances, with depth.
# ``<index>…All.tif`` five times and ``<index>…Dpt.exr`` (half floats, metres) for each index of six digits. The text
# between index and suffix is not documented in the authors' loaders; files are taken by name, near focus first.

_FOCUS_M = (0.1, 0.15, 0.3, 0.7, 1.5)  # m
_SAMPLE_PATTERN = re.compile(r"(\d{6}).*(All\.tif|Dpt\.exr)")
_FIRST_VALIDATION = 400


def _recognise_fod500(root: Path) -> str | None:
    """Text of the evidence that ``root`` holds stacks of this format; None without evidence."""
    names = {m[2] for file in root.iterdir() if (m := _SAMPLE_PATTERN.fullmatch(file.name))} if root.is_dir() else set()
    return "files <index>…All.tif" if "All.tif" in names else None


def read_fod500(
    root: str | Path,
    *,
    split: str | None = None,
    focus_m: Sequence[float] = _FOCUS_M,
    focal_length_m: float = 2.9e-3,
    f_number: float = 1.0,
    max_depth: float | None = 3.0,
) -> FocalStacks:
    """Open FoD500.

    Args:
        root: the folder with the images (``fs_6``).
        split: ``"train"`` = index below 400, ``"val"`` = the rest. None = both.
        focus_m: focus distances, in the order of the files.
        focal_length_m: of the rendering lens.
        f_number: of the rendering lens. 1.0 is the value of the authors' training (a default of 0.1 elsewhere in
            their code is not used).
        max_depth: depth is clipped to this, as in the authors' code. None = no clipping.

    Returns:
        Stacks, with depth if the folder has any; samples that lack an image or depth are left out and reported.
        The pixel pitch is not published, so there is no camera.

    Raises:
        FormatError: no complete sample, or an invalid option.
    """
    root = Path(root)
    focus = parse_focus_distances(focus_m, root)
    if split not in (None, "train", "val"):
        raise FormatError(root, "option split", split, "train or val")
    if max_depth is not None:
        files.to_positive(max_depth, root, "option max_depth")
    samples: dict[str, tuple[list[Path], list[Path]]] = {}  # index → files of images and of depth maps, by name
    for file in sorted(root.iterdir()) if root.is_dir() else ():
        match = _SAMPLE_PATTERN.fullmatch(file.name)
        if match and split in (None, "val" if int(match[1]) >= _FIRST_VALIDATION else "train"):
            samples.setdefault(match[1], ([], []))[match[2] == "Dpt.exr"].append(file)
    has_depth = any(depths for _, depths in samples.values())
    complete = {k: v for k, v in samples.items() if (len(v[0]), len(v[1])) == (len(focus), int(has_depth))}
    if not complete:
        expected = f"{len(focus)} *All.tif and one *Dpt.exr"
        raise FormatError(root, "samples", f"none complete among {len(samples)}", expected)
    load = partial(
        _load_fod500,
        list(complete.values()),
        focus,
        files.to_positive(focal_length_m, root, "option focal_length_m"),
        files.to_positive(f_number, root, "option f_number"),
        max_depth,
    )
    incomplete = [(k, *v) for k, v in samples.items() if k not in complete]
    report = tuple(
        f"sample {k}: {format_count(len(a), 'picture')} and {format_count(len(b), 'depth map')}: left out"
        for k, a, b in incomplete
    )
    return FocalStacks(root.resolve().name, "fod500", load, tuple(complete), root, report)


def _load_fod500(
    samples: Sequence[tuple[Sequence[Path], Sequence[Path]]],  # files of images and of depth maps
    focus: Tensor,  # (S,)
    focal_length_m: float,
    f_number: float,
    max_depth: float | None,
    i: int,
) -> FocalStack:
    """Index → decoded stack."""
    (pictures, depths), depth = samples[i], None
    images = read_pictures(pictures)
    if depths:
        metres = exr.read_exr(depths[0], "R", (images.shape[-2], images.shape[-1]))
        metres = np.where(np.isfinite(metres) & (metres > 0), metres, 0)
        depth = torch.from_numpy(metres if max_depth is None else metres.clip(max=max_depth))[None]
    focal_length, aperture = torch.tensor([focal_length_m]), torch.tensor([f_number])
    return FocalStack(images[None], focus[None], depth, focal_length_m=focal_length, f_number=aperture)


# A plain folder of images of one view, in the order of the numbers in their names.

_MAX_CHECKED_IMAGES = 16  # number of images whose headers are compared when recognising a folder
_DEPTH_FOLDERS = ("depth", "depths", "depth_maps")
#: Beginning of the name of a stack's folder or images: ``focus_stack``, ``focal-sweep``.
_STACK_PATTERN = re.compile(r"(foc(us|al)|z)[ _-]?(stack|sweep|bracket)", re.IGNORECASE)
_N_NAMED_FOLDERS = 3  # the folder of the images and those above it whose names count
_IMAGE_PATTERN = re.compile(r"[^.].*\.(png|jpe?g|tiff?)", re.IGNORECASE)

#: Files with intrinsics or poses, which a focal stack of one still camera does not have.
_CAMERA_FILES = (
    *("K.txt", "intrinsics.txt", "intrinsics.json", "camera.json", "cameras.json", "calibration.txt"),
    *("poses.txt", "pose", "poses", "trajectory.txt", "traj.txt", "groundtruth.txt", "transforms.json"),
    *("cameras.txt", "cameras.bin", "images.txt", "images.bin", "sparse", "odometry.csv", "camera_matrix.csv"),
)

#: Names of image folders of a recording, whose camera files lie in the folder above.
_IMAGE_FOLDERS = ("images", "image", "rgb", "color", "colour", "frames")


def _recognise_images(root: Path) -> str | None:
    """Text of the evidence that ``root`` is a stack of this format; None without evidence.

    Photos, frames of a film and images of a simulator have one size, too: a folder is a stack only where it, one of the
    two folders above it, or its images are named as one.
    """
    resolved = root.resolve()
    names = [place.name for place in (resolved, *resolved.parents)][:_N_NAMED_FOLDERS]
    names += sorted(file.name for file in _image_files(root))[:1]
    named = next((name for name in names if _STACK_PATTERN.match(name)), None)
    images = None if named is None else _describe_images(root)
    return None if images is None else f"{images}, named {named}"


def _describe_images(root: Path) -> str | None:
    """Text on the images of ``root`` where they can be a stack of this format; None where they cannot."""
    if any((root / name).is_dir() for name in _DEPTH_FOLDERS) or list_camera_files(root):
        return None  # an RGB-D recording, or a moving camera
    pictures = sorted(_image_files(root), key=files.natural_sort_key)
    sampled = pictures[:: max(1, len(pictures) // _MAX_CHECKED_IMAGES)]
    kinds = {_image_kind(file) for file in (*sampled, *pictures[-1:])}
    if len(pictures) < 2 or None in kinds or len(kinds) != 1:
        return None
    return f"{len(pictures)} pictures of one size"


def list_camera_files(folder: Path) -> list[str]:
    """Names of files with the intrinsics or poses of images, in their folder or in that above ``images/``."""
    if not folder.is_dir():
        return []
    above = [folder.parent] if folder.name.lower() in _IMAGE_FOLDERS else []
    return [name for place in (folder, *above) for name in _CAMERA_FILES if (place / name).exists()]


def read_images(root: str | Path, *, focus_m: Sequence[float] | None = None) -> FocalStacks:
    """Open a folder of images (PNG, JPEG, TIFF) as one focal stack.

    Args:
        root: the folder.
        focus_m: focus distances, in the order of the images. None = unknown.

    Raises:
        FormatError: fewer than two images, or a different number of distances.
    """
    root = Path(root)
    pictures = tuple(sorted(_image_files(root), key=files.natural_sort_key))
    if len(pictures) < 2:
        raise FormatError(root, "pictures", len(pictures), "at least two, at different focus")
    focus = None if focus_m is None else parse_focus_distances(focus_m, root, len(pictures))
    name = root.resolve().name
    return FocalStacks(name, "images", partial(_load_images, pictures, focus), (name,), root)


def _load_images(pictures: Sequence[Path], focus: Tensor | None, _i: int) -> FocalStack:
    """Index 0 → decoded stack."""
    return FocalStack(read_pictures(pictures)[None], None if focus is None else focus[None])


def _image_files(root: Path) -> list[Path]:
    """Image files in a folder, unsorted."""
    return [file for file in root.iterdir() if _IMAGE_PATTERN.fullmatch(file.name)] if root.is_dir() else []


def _image_kind(file: Path) -> tuple[object, ...] | None:
    """Size, channels and bits of an image file; None if it is damaged or of an unsupported type."""
    try:
        if file.suffix.lower() in (".tif", ".tiff"):
            return tuple(tiff.read_tiff_header(file))
        header = files.read_image_header(file)
        return header[:3] if header.bits == 8 else None
    except FormatError:
        return None


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


class _StackReader(NamedTuple):
    """Functions of a format."""

    recognise: Callable[[Path], str | None]  # folder or file → text of the evidence for the format; None without
    read: Callable[..., FocalStacks]


#: Name → reader, tried in this order; the first that recognises a folder reads it.
STACK_FORMATS: Final[dict[str, _StackReader]] = {
    "fod500": _StackReader(_recognise_fod500, read_fod500),
    "ddff12": _StackReader(ddff12.recognise, ddff12.read),
    "images": _StackReader(_recognise_images, read_images),
}


def open_stacks(root: str | Path, format: str = "auto", *, follow_links: bool = False, **options: Any) -> FocalStacks:
    """Open the focal stacks at ``root`` lazily: a stack is decoded when it is indexed.

    Args:
        root: a folder, or an HDF5 file.
        format: ``fod500``, ``ddff12``, ``images``, or ``auto`` to recognise it by its content.
        follow_links: whether symbolic links below ``root`` may lead out of it.
        options: keyword options of the reader, see ``read_fod500``, ``read_images`` and
            :func:`dhtorch.experiments.focal.ddff12.read`.

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
        if are_stacks and (evidence := _describe_images(Path(root))):
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
