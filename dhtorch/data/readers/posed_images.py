"""Posed images: rows of image, camera and pose, with or without depth map and confidence -> a recording.

Shared by readers of exports that list every image with a camera of its own (nerfstudio, Polycam, COLMAP). A row is
decoded on access. Depth maps are 16-bit PNGs, TIFFs or NPYs of any size and cover the field of view of their image.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data import convert
from dhtorch.data.codecs import pickles, tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.orientation import StoredSizes
from dhtorch.data.readers.image_table import fit_K
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.no_depth import NO_DEPTH_CODES
from dhtorch.records import Frame


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One row: files, camera, pose and time of an image."""

    image: Path
    depth: Path | None
    K: np.ndarray  # (3, 3) of the image, pixel centres at integers
    source: Path  # file that states the camera, for errors
    c2w: np.ndarray | None = None  # (4, 4) camera to world, OpenCV axes; None = no pose
    distortion: tuple[float, ...] | None = None  # OpenCV's order
    hw: tuple[int, int] | None = None  # of the image that K refers to; None = the stored image
    conf: Path | None = None
    origin: Path | None = None  # map of codes.Source: depth that is not the sensor's is left out; None = all is
    time: float | None = None  # s
    number: int = -1  # in the capture; negative = not numbered


def _load_frame(
    i: int,
    *,
    rows: tuple[PosedImage, ...],
    hw: tuple[int, int],
    depth_hw: tuple[int, int],
    step_m: float,  # metres of one step of the stored depth
    exif: int,  # orientation tag of every image
    level_of_code: Callable[[np.ndarray], np.ndarray] | None = None,  # stored confidence → 0, 1 or 2; None = not read
) -> Frame:
    """Position → frame, decoded from its files."""
    row = rows[i]
    camera = convert.to_camera(row.K, hw, row.source, f"intrinsics of {row.image.name}", row.distortion)
    conf = None
    if level_of_code is not None and row.conf is not None:
        levels = level_of_code(files.read_image(row.conf, depth_hw)[0])
        conf = torch.from_numpy(np.ascontiguousarray(levels, np.uint8))[None]
    image = torch.from_numpy(files.read_image(row.image, hw, exif))
    depth = np.zeros(depth_hw) if row.depth is None else _read_depth_steps(row.depth, depth_hw) * step_m
    if row.depth is not None and row.origin is not None:
        depth[files.read_image(row.origin, depth_hw)[0] != Source.SENSOR] = 0
    return Frame(image[None], torch.from_numpy(depth.astype(np.float32))[None], camera, conf=conf)


def open_posed_images(
    root: Path,
    format: str,
    rows: Sequence[PosedImage],
    *,
    unit: DepthUnit | None,
    report: Sequence[str] = (),
    name: str | None = None,
    pose_axes: str = "cv",
    level_of_code: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Recording:
    """Rows of one camera → its recording, ordered by number, else time, else name; incomplete rows are reported.

    Args:
        root: folder of the capture.
        format: name of the reader.
        rows: in any order.
        unit: of the depth maps; None = millimetres for integers and metres for floats, assumed.
        report: of the reader.
        name: of the recording; None = the folder's.
        pose_axes: camera axes of the stored poses, ``cv`` or ``gl``.
        level_of_code: stored confidence → 0, 1 or 2; None = confidence is not read.

    Raises:
        FormatError: no image, images of several aspect ratios, or values that are no cameras or poses.
    """
    lines, rows = list(report), _sort(rows)
    rows, left_out = _select_complete(rows)
    lines += left_out
    if not rows:
        raise FormatError(root, "frames", "; ".join(lines) or "none", "at least one image with a pose")
    header = files.read_image_header(rows[0].image)
    hw = header.hw
    rows, scaled = _fit_cameras(rows, hw, header.orientation)
    lines += scaled
    _ = convert.to_camera(rows[0].K, hw, rows[0].source, f"intrinsics of {rows[0].image.name}", rows[0].distortion)
    maps = [row.depth for row in rows if row.depth is not None]
    lines += _report_missing_depth(rows)
    is_unstated = unit is None and bool(maps)
    first = _read_depth_type(maps[0]) if maps else (hw, True)
    if is_unstated:
        unit = DepthUnit(1e-3 if first[1] else 1.0)
    if not all(row.conf is not None for row in rows):
        level_of_code = None
    poses = None
    if rows[0].c2w is not None:
        poses = convert.to_poses(np.stack([row.c2w for row in rows if row.c2w is not None]), rows[0].source)
    times, time_report = _parse_times(rows)
    step_m = 1.0 if unit is None else unit.metres
    return Recording(
        name=name or root.resolve().name,
        format=format,
        load=partial(
            _load_frame,
            rows=tuple(rows),
            hw=hw,
            depth_hw=first[0],
            step_m=step_m,
            exif=header.orientation,
            level_of_code=level_of_code,
        ),
        number=torch.tensor([row.number for row in rows] if rows[0].number >= 0 else list(range(len(rows)))),
        root=root,
        times=times,
        poses=poses,
        pose_axes=pose_axes,
        report=(*lines, *time_report),
        depth_unit=unit if maps else None,
        stored=StoredSizes.of_images(hw, first[0] if maps else None, header.orientation),
    )


def _sort(rows: Sequence[PosedImage]) -> list[PosedImage]:
    """Rows in the order of their numbers, else of the numbers in their names, else of time, else of their names."""
    counted = []
    for row in rows:
        match = re.search(r"(\d+)\D*$", row.image.stem)  # the last number in the name, if it can count frames
        # A number of more digits is a time stamp: a week at 100 Hz has 8 digits, time stamps in µs since a phone's
        # start have 10 or more.
        number = int(match[1]) if match and len(match[1]) <= 9 else -1
        counted.append(row if row.number >= 0 else replace(row, number=number))
    numbers = [row.number for row in counted]
    if min(numbers, default=0) >= 0 and len(set(numbers)) == len(numbers):
        return sorted(counted, key=lambda row: row.number)
    unnumbered = [replace(row, number=-1) for row in counted]
    times = [row.time for row in unnumbered]
    if None not in times and len(set(times)) == len(times):
        return sorted(unnumbered, key=lambda row: row.time or 0.0)
    return sorted(unnumbered, key=lambda row: files.natural_sort_key(row.image))


def _read_depth_steps(file: Path, hw: tuple[int, int]) -> np.ndarray:
    """Depth (h, w) float64 in steps of the file's unit; 0 = no return, also for codes and values that mean none.

    Raises:
        FormatError: another type or size, or a damaged file.
    """
    kind = file.suffix.lower()
    if kind == ".npy":
        values = _read_array(file)
        if values.shape != hw:
            raise FormatError(file, "depth", f"shape {values.shape}", f"shape {hw}")
    elif kind in (".tif", ".tiff"):
        values = tiff.read_tiff(file, hw)
    else:
        return files.read_depth_png(file, 1.0, hw).astype(np.float64)
    steps = values.astype(np.float64)
    holes = ~np.isfinite(steps) | (steps <= 0)
    if values.dtype.kind != "f":
        holes |= np.isin(values, NO_DEPTH_CODES)
    return np.where(holes, 0.0, steps)


def _read_depth_type(file: Path) -> tuple[tuple[int, int], bool]:
    """((height, width), whether the numbers are integers) of a depth file."""
    kind = file.suffix.lower()
    if kind == ".npy":
        values = _read_array(file)
        return (values.shape[0], values.shape[1]), values.dtype.kind != "f"
    if kind in (".tif", ".tiff"):
        header = tiff.read_tiff_header(file)
        return header.hw, header.dtype.kind != "f"
    return files.read_image_header(file).hw, True


def _read_array(file: Path) -> np.ndarray:
    values = pickles.read_npy(file)
    if isinstance(values, np.ndarray) and values.ndim == 3 and 1 in (values.shape[0], values.shape[2]):
        values = values.reshape(values.shape[:2] if values.shape[2] == 1 else values.shape[1:])
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        kind = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise FormatError(file, "depth", kind, "numbers of shape (height, width)")
    return values


def _select_complete(rows: Sequence[PosedImage]) -> tuple[list[PosedImage], list[str]]:
    """Rows with an image, and with a finite pose where any row has one; report of the others by name."""
    present = [row for row in rows if row.image.is_file()]
    report = format_names_left_out([row.image for row in rows if not row.image.is_file()], "no such image")
    if all(row.c2w is None for row in present):
        return present, report + (["no poses"] if present else [])
    is_posed = [row.c2w is not None and bool(np.isfinite(row.c2w).all()) for row in present]
    lost = [row.image for row, posed in zip(present, is_posed, strict=True) if not posed]
    report += format_names_left_out(lost, "no pose, or one that is not finite (tracking lost)")
    return [row for row, posed in zip(present, is_posed, strict=True) if posed], report


def format_names_left_out(images: Sequence[Path], reason: str) -> list[str]:
    """Report line on images that are left out, or empty list."""
    return [line.replace("frame", "image", 1) for line in files.format_left_out([f.name for f in images], reason)]


def _report_missing_depth(rows: Sequence[PosedImage]) -> list[str]:
    without = [row.image.name for row in rows if row.depth is None]
    if len(without) == len(rows):
        return ["no depth maps: depth is empty"]
    shown = files.format_left_out(without, "no depth map")
    return [line.replace("frame", "image", 1).replace(": left out", ": its depth is empty") for line in shown]


def _fit_cameras(rows: Sequence[PosedImage], hw: tuple[int, int], exif: int) -> tuple[list[PosedImage], list[str]]:
    """Rows with K for images of size ``hw``, and the report where a stated size differs.

    K that is stated for images as their orientation tag turns them is kept: they are turned when the recording is.
    """
    fitted, report = [], dict[str, None]()
    for row in rows:
        # EXIF orientations from which on width and height are exchanged. Source: EXIF 2.3, tag 0x0112.
        if exif >= 5 and row.hw == hw[::-1]:
            fitted.append(row)
            continue
        K, lines = fit_K(row.K, row.hw or hw, hw, row.source)
        report |= dict.fromkeys(lines)
        fitted.append(replace(row, K=K, hw=hw))
    return fitted, list(report)


def _parse_times(rows: Sequence[PosedImage]) -> tuple[Tensor | None, list[str]]:
    """Times of sorted rows in s, None where a stamp is missing or they are no clock; report of the reason."""
    stamps = [row.time for row in rows if row.time is not None]
    if not stamps:
        return None, []
    if len(stamps) < len(rows):
        return None, [f"{len(rows) - len(stamps)} of {len(rows)} images have no time stamp: there are no times"]
    times = torch.tensor(stamps, dtype=torch.float64)
    steps = times.diff()
    if not bool(times.isfinite().all()) or not bool((steps > 0).all()):
        return None, ["time stamps do not increase with the numbers of the images: there are no times"]
    # Stamps of larger steps are no seconds: nanoseconds and microseconds of video give 1e4 or more, images of a person
    # walking from place to place far less.
    if len(steps) and float(steps.median()) > 1000.0:
        return None, [f"time stamps step by {float(steps.median()):.6g}, no seconds: there are no times"]
    return times, []
