"""Reader of COLMAP's text model beside its images, with depth maps where there are any.

``cameras.txt`` and ``images.txt`` lie in the folder, in ``sparse/0/``, ``sparse/`` or ``colmap/``; images in
``images/`` (or ``rgb/``, ``color/``) under the names in ``images.txt``; depth maps in ``depth/`` under the images'
stems. The file's poses map world to camera, and the centre of its first pixel is (0.5, 0.5). COLMAP estimates poses up
to scale: unless they were aligned they are not metric, which the report states. ``dhtorch integrate`` writes models in
metres (``# metres``) with their images, and the times of these in ``times.txt``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.posed_images import PosedImage, format_names_left_out, open_posed_images
from dhtorch.data.recording import Recording

#: Files of the format that are not read: points and their tracks, rigs, settings of COLMAP.
UNUSED_FILES = ("points3D.txt", "rigs.txt", "frames.txt", "project.ini")

_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap")
_MODEL_FILES = ("cameras.txt", "images.txt")
_IMAGE_FOLDERS = ("images", "rgb", "color")
_DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff")

#: Poses of the layout of numbered frames; where they are, they win over an estimate.
_OWN_POSES = ("poses.txt", "pose.txt")

#: Camera model → numbers of focal lengths and of distortion coefficients. Source: COLMAP's camera models.
COLMAP_LENSES = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "FULL_OPENCV": (2, 8),
}

#: Most images of a model, as a bound for damaged files.
_MAX_IMAGES = 1_000_000


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    model = _find_model(root)
    if model is None or any((root / name).is_file() for name in _OWN_POSES):
        return None
    if model != root and _find_folder(root, _IMAGE_FOLDERS) is None:
        return None
    return " and ".join((model / name).relative_to(root).as_posix() for name in _MODEL_FILES)


def read(root: str | Path, *, images: str | None = None, depth: str | None = None) -> list[Recording]:
    """Open a model as one recording.

    Args:
        root: the folder of the model, or above it.
        images: folder of the images, absolute or relative to ``root``. None = ``images/``, ``rgb/`` or ``color/``.
        depth: folder of the depth maps. None = ``depth/`` where it exists.

    Returns:
        One recording. Images that are missing are left out and reported.

    Raises:
        FormatError: no images, a camera model without OpenCV's distortion, or a damaged file.
    """
    root = Path(root)
    model = _find_model(root)
    if model is None:
        command = "colmap model_converter --input_path sparse/0 --output_path sparse/0 --output_type TXT"
        raise FormatError(root, "model", "no text model", f"cameras.txt and images.txt (of a binary one: {command})")
    pictures = _find_folder(root, _IMAGE_FOLDERS) if images is None else _join(root, images)
    if pictures is None or not pictures.is_dir():
        problem = "none beside the model" if images is None else f"no folder {images}"
        raise FormatError(root, "images", problem, "images/, or data.images=FOLDER and data.depth=FOLDER")
    maps = root / "depth" if depth is None else _join(root, depth)
    lenses = read_colmap_cameras(model / "cameras.txt")
    times = _read_times(model / "times.txt")
    rows, missing = [], []
    for entry in _read_images(model / "images.txt"):
        image = files.resolve_inside(pictures, entry.name, model / "images.txt", f"image {entry.image_id}")
        if not image.is_file():
            missing.append(image)
            continue
        if entry.camera_id not in lenses:
            raise FormatError(model / "images.txt", f"camera of image {entry.image_id}", entry.camera_id, "a camera")
        lens = lenses[entry.camera_id]
        rows.append(
            PosedImage(
                image=image,
                depth=_find_depth(maps, image),
                K=lens.K,
                source=model / "cameras.txt",
                c2w=entry.c2w,
                distortion=lens.distortion,
                hw=lens.hw,
                time=times.get(entry.image_id),
            )
        )
    report = format_names_left_out(missing, "no such image")
    if not _is_metric(model / "images.txt"):
        report.append("poses were estimated by COLMAP: their scale is not metric unless it was aligned")
    return [open_posed_images(root, "colmap", rows, unit=None, report=report)]


def _find_model(root: Path) -> Path | None:
    folders = (root / name for name in _MODEL_FOLDERS)
    return next((folder for folder in folders if all((folder / name).is_file() for name in _MODEL_FILES)), None)


def _find_folder(root: Path, names: tuple[str, ...]) -> Path | None:
    return next((root / name for name in names if (root / name).is_dir()), None)


def _join(root: Path, option: str) -> Path:
    """Folder of an option, which may lie outside the capture."""
    return Path(os.path.normpath(root / option))


def _find_depth(folder: Path, image: Path) -> Path | None:
    candidates = (folder / f"{stem}{suffix}" for stem in (image.stem, image.name) for suffix in _DEPTH_SUFFIXES)
    return next((file for file in candidates if file.is_file()), None)


@dataclass(frozen=True, eq=False)
class ColmapLens:
    """A camera of a model."""

    hw: tuple[int, int]
    K: np.ndarray  # (3, 3), pixel centres at integers
    distortion: tuple[float, ...] | None


@dataclass(frozen=True, eq=False)
class _ImageEntry:
    """The pose and the name of one image in ``images.txt``."""

    image_id: int
    camera_id: int
    name: str
    c2w: np.ndarray  # (4, 4)


def read_colmap_cameras(file: Path) -> dict[int, ColmapLens]:
    """Camera id → camera, of ``cameras.txt``.

    Raises:
        FormatError: a camera model without OpenCV's distortion, or a damaged file.
    """
    lenses = {}
    for line, words in files.read_rows(file):
        model = words[1] if len(words) > 1 else ""
        if model not in COLMAP_LENSES:
            expected = f"{', '.join(COLMAP_LENSES)} (undistort the images first)"
            raise FormatError(file, f"line {line} model", model, expected)
        values = _parse_numbers(words[2:], 4 + sum(COLMAP_LENSES[model]), file, line)
        w, h = (round(files.to_positive(size, file, f"line {line} size")) for size in values[:2])
        lenses[_parse_id(words[0], file, line)] = make_colmap_lens(model, (h, w), values[2:])
    return lenses


def make_colmap_lens(model: str, hw: tuple[int, int], values: Sequence[float]) -> ColmapLens:
    """Parameters of a camera model of :data:`COLMAP_LENSES` → camera with pixel centres at integers."""
    n_focal, _ = COLMAP_LENSES[model]
    focal, (cx, cy), lens = values[:n_focal], values[n_focal : n_focal + 2], values[n_focal + 2 :]
    padded = [*lens, *[0.0] * (4 - len(lens))] if lens else []
    K = convert.make_K(focal[0], focal[-1], cx - 0.5, cy - 0.5)
    return ColmapLens(hw, K, tuple(padded) if any(padded) else None)


def _read_images(file: Path) -> list[_ImageEntry]:
    """Entries of ``images.txt``: two lines each, the second with observations, which may be empty."""
    entries, is_observations = list[_ImageEntry](), False
    for line, text in enumerate(files.read_lines(file), 1):
        if is_observations:
            is_observations = False
            continue
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        words = text.split(maxsplit=9)
        if len(words) != 10 or len(entries) >= _MAX_IMAGES:
            raise FormatError(file, f"line {line}", f"{len(words)} columns", "IMAGE_ID, QW … TZ, CAMERA_ID, NAME")
        qw, qx, qy, qz, *t = _parse_numbers(words[1:8], 7, file, line)
        w2c = convert.to_c2w(np.array([[qx, qy, qz, qw]]), np.array([t]), file, f"line {line}")[0]
        image_id, camera_id = _parse_id(words[0], file, line), _parse_id(words[8], file, line)
        entries.append(_ImageEntry(image_id, camera_id, words[9].strip(), np.linalg.inv(w2c)))
        is_observations = True
    return entries


def _read_times(file: Path) -> dict[int, float]:
    """Image id → time in s, from the file that ``dhtorch integrate`` writes; empty where there is none."""
    if not file.is_file():
        return {}
    return {
        _parse_id(words[0], file, line): _parse_numbers(words[1:], 1, file, line)[0]
        for line, words in files.read_rows(file)
    }


def _is_metric(file: Path) -> bool:
    """Whether a comment states that the poses are in metres."""
    head = files.read_lines(file)[:10]
    return any(text.startswith("#") and "metres" in text for text in head)


def _parse_id(word: str, file: Path, line: int) -> int:
    if not (word.isdecimal() and len(word) <= 18):
        raise FormatError(file, f"line {line}", word, "an id")
    return int(word)


def _parse_numbers(words: list[str], count: int, file: Path, line: int) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise FormatError(file, f"line {line}", " ".join(words), f"{count} numbers")
    return values
