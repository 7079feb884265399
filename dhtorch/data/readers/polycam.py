"""Reader of Polycam's raw data: ``keyframes/`` with images, cameras, depth and confidence of a phone with LiDAR.

``cameras/NAME.json`` holds fx, fy, cx, cy, width, height and the camera-to-world pose ``t_00`` to ``t_23`` with ARKit's
axes (y up, z backward); NAME is a time stamp in microseconds and shared by ``images/NAME.jpg``, ``depth/NAME.png``
(16 bits, mm, at a lower resolution) and ``confidence/NAME.png`` (0 low, 255 high, medium between them).
``corrected_images/`` without distortion and ``corrected_cameras/`` with optimised poses are read instead where the
export has both. ``mesh_info.json`` and ``raw.glb`` describe the mesh, in axes of its own, and are not needed.
"""

from pathlib import Path

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.readers.image_folders import FrameFiles, list_images, open_posed
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit

#: Files of the format that are not read: of the mesh, and cameras (time stamps) of the folder that was not chosen.
UNUSED_FILES = ("mesh_info.json", "[0-9]*.json")

#: Folder of the cameras → folder of the images they belong to, in order of preference.
_FOLDERS = {"corrected_cameras": "corrected_images", "cameras": "images"}

#: Unit of the depth maps. Source: Polycam's description of its raw data.
_UNIT = DepthUnit(1e-3, "format definition: Polycam stores millimetres")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    found = _find_folders(root)
    return None if found is None else f"{found[0].name}/ with {' and '.join(found[1])}"


def read(root: str | Path, *, corrected: bool = True) -> list[Recording]:
    """Open a raw export, or its folder ``keyframes``, as one recording.

    Args:
        root: the folder.
        corrected: read optimised poses and undistorted images where the export has them.

    Returns:
        One recording with times from the file names. Images without camera are left out and reported; those without
        depth map have empty depth.

    Raises:
        FormatError: no camera with an image, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    found = _find_folders(root)
    if found is None:
        raise files.FormatError(root, "folders", "none", "keyframes/ with cameras/ and images/")
    keyframes, folders = found
    cameras, images = folders if corrected else ("cameras", "images")
    pictures, depths = list_images(keyframes / images), list_images(keyframes / "depth")
    confidences = list_images(keyframes / "confidence")
    sources = {file.stem: file for file in sorted((keyframes / cameras).glob("*.json"))}
    rows = [
        _parse_row(sources[name], i, picture, depths.get(name), confidences.get(name))
        for i, (name, picture) in enumerate(pictures.items())
        if name in sources
    ]
    report = files.format_left_out(
        [i for i, name in enumerate(pictures) if name not in sources], f"no file in {cameras}/"
    )
    report += files.format_left_out([name for name in sources if name not in pictures], f"no file in {images}/")
    return [
        open_posed(
            root,
            "polycam",
            rows,
            unit=_UNIT,
            report=report,
            name=(root if keyframes != root else root.resolve().parent).resolve().name,
            pose_axes="gl",
            level_of_code=_level_of_code,
        )
    ]


def _find_folders(root: Path) -> tuple[Path, tuple[str, str]] | None:
    """The folder with the cameras (``keyframes``, or the path itself), and its first pair of folders with a camera."""
    for keyframes in (root / "keyframes", root):
        for cameras, images in _FOLDERS.items():
            if (keyframes / images).is_dir() and any((keyframes / cameras).glob("*.json")):
                return keyframes, (cameras, images)
    return None


def _parse_row(source: Path, number: int, image: Path, depth: Path | None, conf: Path | None) -> FrameFiles:
    camera = files.read_json(source)
    fx, fy, cx, cy, width, height = (
        files.to_positive(files.get_entry(camera, name, (int, float), source), source, name)
        for name in ("fx", "fy", "cx", "cy", "width", "height")
    )
    rows = [[files.get_entry(camera, f"t_{i}{j}", (int, float), source) for j in range(4)] for i in range(3)]
    c2w = np.vstack((files.to_array(rows, (3, 4), source, "t_00 to t_23"), [0.0, 0.0, 0.0, 1.0]))
    stamp = camera.get("timestamp", int(image.stem) if image.stem.isdecimal() else None)
    return FrameFiles(
        image=image,
        depth=depth,
        K=convert.make_K(fx, fy, cx, cy),
        source=source,
        c2w=convert.cv_from_gl(c2w[None])[0],
        hw=(round(height), round(width)),
        conf=conf,
        number=number,
        time=stamp * 1e-6 if isinstance(stamp, int | float) and not isinstance(stamp, bool) else None,
    )


def _level_of_code(code: np.ndarray) -> np.ndarray:
    """Stored confidence → 0 low, 1 medium, 2 high."""
    # Code of high confidence. Source: Polycam's description; medium is 127 there and 54 in other exports.
    return np.where(code == 255, 2, np.where(code > 0, 1, 0))
