"""A plain folder of images of one view as a focal stack, in the order of the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from dhtorch.data.codecs import tiff as codec_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks, parse_focus_distances, read_pictures

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


def recognise(root: Path) -> str | None:
    """Text of the evidence that ``root`` is a stack of this format; None without evidence.

    Photos, frames of a film and images of a simulator have one size, too: a folder is a stack only where it, one of the
    two folders above it, or its images are named as one.
    """
    resolved = root.resolve()
    names = [place.name for place in (resolved, *resolved.parents)][:_N_NAMED_FOLDERS]
    names += sorted(file.name for file in _image_files(root))[:1]
    named = next((name for name in names if _STACK_PATTERN.match(name)), None)
    images = None if named is None else describe_images(root)
    return None if images is None else f"{images}, named {named}"


def describe_images(root: Path) -> str | None:
    """Text on the images of ``root`` where they can be a stack of this format; None where they cannot."""
    if any((root / name).is_dir() for name in _DEPTH_FOLDERS):
        return None  # an RGB-D recording
    if list_camera_files(root):
        return None  # a moving camera
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


def read(root: str | Path, *, focus_m: Sequence[float] | None = None) -> FocalStacks:
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
    return FocalStacks(name, "images", _StackLoader(pictures, focus), (name,), root)


@dataclass(frozen=True, eq=False)
class _StackLoader:
    """Index 0 → decoded stack."""

    pictures: tuple[Path, ...]
    focus: Tensor | None

    def __call__(self, i: int) -> FocalStack:
        return FocalStack(read_pictures(self.pictures)[None], None if self.focus is None else self.focus[None])


def _image_files(root: Path) -> list[Path]:
    """Image files in a folder, unsorted."""
    return [file for file in root.iterdir() if _IMAGE_PATTERN.fullmatch(file.name)] if root.is_dir() else []


def _image_kind(file: Path) -> tuple[object, ...] | None:
    """Size, channels and bits of an image file; None if it is damaged or of an unsupported type."""
    try:
        if file.suffix.lower() in (".tif", ".tiff"):
            return tuple(codec_tiff.read_tiff_header(file))
        header = files.read_image_header(file)
        return header[:3] if header.bits == 8 else None
    except FormatError:
        return None
