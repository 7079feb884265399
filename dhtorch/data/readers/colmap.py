"""Reader of COLMAP's text model beside its images, with depth maps where there are any.

``cameras.txt`` and ``images.txt`` lie in the folder, in ``sparse/0/``, ``sparse/`` or ``colmap/``; images in
``images/`` (or ``rgb/``, ``color/``) under the names in ``images.txt``; depth maps in ``depth/`` under the images'
stems. The file's poses map world to camera, and the centre of its first pixel is (0.5, 0.5). COLMAP estimates poses up
to scale: unless they were aligned they are not metric, which the report states. ``dhtorch integrate`` writes models in
metres (``# metres``) with their images, and the times of these in ``times.txt``.
"""

import os
from pathlib import Path

from dhtorch.data.codecs.colmap import parse_id, parse_numbers, read_colmap_cameras, read_colmap_images
from dhtorch.data.io import decode as files
from dhtorch.data.readers.image_folders import FrameFiles, format_names_left_out, open_posed
from dhtorch.data.recording import Recording

#: Files of the format that are not read: points and their tracks, rigs, settings of COLMAP.
UNUSED_FILES = ("points3D.txt", "rigs.txt", "frames.txt", "project.ini")

#: Folders of a capture in which its model may lie.
MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap")
_MODEL_FILES = ("cameras.txt", "images.txt")
_IMAGE_FOLDERS = ("images", "rgb", "color")
_DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff")

#: Poses of the layout of numbered frames; where they are, they win over an estimate.
_OWN_POSES = ("poses.txt", "pose.txt")


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
        raise files.FormatError(
            root, "model", "no text model", f"cameras.txt and images.txt (of a binary one: {command})"
        )
    pictures = _find_folder(root, _IMAGE_FOLDERS) if images is None else Path(os.path.normpath(root / images))
    if pictures is None or not pictures.is_dir():
        problem = "none beside the model" if images is None else f"no folder {images}"
        raise files.FormatError(root, "images", problem, "images/, or data.images=FOLDER and data.depth=FOLDER")
    maps = root / "depth" if depth is None else Path(os.path.normpath(root / depth))
    lenses = read_colmap_cameras(model / "cameras.txt")
    times, file = {}, model / "times.txt"  # dhtorch integrate writes the times of the images
    for line, words in files.read_rows(file) if file.is_file() else ():
        times[parse_id(words[0], file, line)] = parse_numbers(words[1:], 1, file, line)[0]
    rows, missing = [], []
    for entry in read_colmap_images(model / "images.txt", observations=False):
        image = files.resolve_inside(pictures, entry.name, model / "images.txt", f"image {entry.image_id}")
        if not image.is_file():
            missing.append(image)
            continue
        files.refuse_if(
            entry.camera_id not in lenses,
            model / "images.txt",
            f"camera of image {entry.image_id}",
            entry.camera_id,
            "a camera",
        )
        lens = lenses[entry.camera_id]
        candidates = (maps / f"{stem}{suffix}" for stem in (image.stem, image.name) for suffix in _DEPTH_SUFFIXES)
        rows.append(
            FrameFiles(
                number=-1,
                image=image,
                depth=next((each for each in candidates if each.is_file()), None),
                K=lens.K,
                source=model / "cameras.txt",
                c2w=entry.c2w,
                distortion=lens.distortion,
                hw=lens.hw,
                time=times.get(entry.image_id),
            )
        )
    report = format_names_left_out(missing, "no such image")
    head = files.read_lines(model / "images.txt")[:10]
    if not any(text.startswith("#") and "metres" in text for text in head):
        report.append("poses were estimated by COLMAP: their scale is not metric unless it was aligned")
    return [open_posed(root, "colmap", rows, unit=None, report=report)]


def _find_model(root: Path) -> Path | None:
    folders = (root / name for name in MODEL_FOLDERS)
    return next((folder for folder in folders if all((folder / name).is_file() for name in _MODEL_FILES)), None)


def _find_folder(root: Path, names: tuple[str, ...]) -> Path | None:
    return next((root / name for name in names if (root / name).is_dir()), None)
