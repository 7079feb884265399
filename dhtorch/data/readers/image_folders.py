"""Folders of images, depth maps, cameras and poses: rows of files -> a recording; the engine of all such layouts.

A layout lists its files, cameras and poses; this module pairs them, leaves out rows that lack a part (reported) and
decodes a row on access. :func:`open_numbered` opens rows that share one camera and have numbers; :func:`open_posed`
rows of exports that list every image with a camera of its own. Depth files are PNGs or PGMs of 16 bits, TIFFs or NPYs.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data import clocks, convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.codecs import pgm, pickles, tiff
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.data.stored_sizes import StoredSizes
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.no_depth import NO_DEPTH_CODES
from dhtorch.records import Camera, Frame

#: K of a camera, the file and the field that state it, and the image size (h, w) it is stated for; None = the images'.
StatedK = tuple[np.ndarray, Path, str, tuple[int, int] | None]

#: Options intrinsics, K and fov of a reader.
KOptions = tuple[intrinsics_options.IntrinsicsOption | None, Sequence[float] | None, float | None]

#: Names of the images of layouts that number all files of a frame in one folder.
NAMED_COLOUR_PATTERN = r"frame-(\d+)\.color\.(?:jpg|jpeg|png)"


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One row: files of a frame, and its camera, pose, time and unit where it has its own."""

    number: int  # in the capture; negative = not numbered
    image: Path
    depth: Path | None
    c2w: np.ndarray | None = None  # (4, 4), OpenCV axes; not finite where tracking was lost; None = no pose
    camera: Camera | None = None  # None = the recording's, or of ``K``
    units_per_metre: float | None = None  # depth codes of one metre; None = the recording's
    K: np.ndarray | None = None  # (3, 3) of the image, pixel centres at integers
    source: Path = Path()  # file that states K, for errors
    distortion: tuple[float, ...] | None = None  # OpenCV's order
    hw: tuple[int, int] | None = None  # of the image that K refers to; None = the stored image
    conf: Path | None = None
    origin: Path | None = None  # map of codes.Source: depth that is not the sensor's is left out; None = all is
    time: float | None = None  # s


@dataclass(frozen=True, eq=False)
class FrameLoader:
    """Position → frame, decoded from its files."""

    rows: tuple[FrameFiles, ...]
    hw: tuple[int, int]
    depth_hw: tuple[int, int]
    camera: Camera | None = None  # of all rows; None = each has its own
    depth_camera: Camera | None = None  # None = ``camera`` scaled to the depth's size
    units_per_metre: float = 1000.0
    step_m: float | None = None  # metres of one step, in place of ``units_per_metre``: numbers of any type
    no_return: tuple[int, ...] = NO_DEPTH_CODES
    rotated_bits: int = 0  # bits by which the codes are rotated to the left
    register: bool = False  # warp depth with a camera of its own to the image, at most at its own density
    exif: int | None = None  # orientation tag of every image; None = not checked
    level_of_code: Callable[[np.ndarray], np.ndarray] | None = None  # stored confidence → 0, 1 or 2; None = not read

    def __call__(self, i: int) -> Frame:
        """Decode the frame at position ``i``."""
        row = self.rows[i]
        camera = self.camera if row.camera is None else row.camera
        if camera is None:
            camera = _own_camera(row, self.hw)
        conf = None
        if self.level_of_code is not None and row.conf is not None:
            levels = self.level_of_code(files.read_image(row.conf, self.depth_hw)[0])
            conf = torch.from_numpy(np.ascontiguousarray(levels, np.uint8))[None]
        image = torch.from_numpy(files.read_image(row.image, self.hw, self.exif))
        depth, depth_camera = torch.from_numpy(self._read_depth(row)), self.depth_camera
        if depth_camera is not None and self.register:
            depth, depth_camera = convert.register_depth(depth, depth_camera, camera, self.hw), None
        return Frame(image[None], depth[None], camera, depth_camera, conf=conf)

    def _read_depth(self, row: FrameFiles) -> np.ndarray:
        """Depth (h, w) float32 in m; 0 = no return, also for codes and values that mean none."""
        file, bits, units = row.depth, self.rotated_bits, row.units_per_metre or self.units_per_metre
        if file is None:
            return np.zeros(self.depth_hw, np.float32)
        if file.suffix.lower() in _DEPTH_CODECS:
            values = _DEPTH_CODECS[file.suffix.lower()](file, self.depth_hw)
        elif self.step_m is None and not bits:
            return files.read_depth_png(file, units, self.depth_hw, self.no_return)
        else:
            values = files.read_depth_png(file, 1, self.depth_hw).astype(np.uint16)
        if self.step_m is None:
            code = values if bits == 0 else np.right_shift(values, bits) | np.left_shift(values, 16 - bits)
            return files.to_metres(code, units, self.no_return)
        steps = values.astype(np.float64)
        holes = ~np.isfinite(steps) | (steps <= 0)
        if values.dtype.kind != "f":
            holes |= np.isin(values, NO_DEPTH_CODES)
        if row.origin is not None:
            holes |= files.read_image(row.origin, self.depth_hw)[0] != Source.SENSOR
        return (np.where(holes, 0.0, steps) * self.step_m).astype(np.float32)


def _own_camera(row: FrameFiles, hw: tuple[int, int]) -> Camera:
    return convert.to_camera(row.K, hw, row.source, f"intrinsics of {row.image.name}", row.distortion)


def _read_array(file: Path, hw: tuple[int, int] | None = None) -> np.ndarray:
    """The numbers (h, w) of an NPY file."""
    values = pickles.read_npy(file)
    if isinstance(values, np.ndarray) and values.ndim == 3 and 1 in (values.shape[0], values.shape[2]):
        values = values.reshape(values.shape[:2] if values.shape[2] == 1 else values.shape[1:])
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        kind = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise files.FormatError(file, "depth", kind, "numbers of shape (height, width)")
    files.refuse_if(hw not in (None, values.shape), file, "depth", f"shape {values.shape}", f"shape {hw}")
    return values


#: Decoders (file, size) of depth files that are no PNGs.
_DEPTH_CODECS: Mapping[str, Callable[..., np.ndarray]] = {
    ".pgm": pgm.read_pgm,
    ".npy": _read_array,
    ".tif": tiff.read_tiff,
    ".tiff": tiff.read_tiff,
}


def read_depth_type(file: Path | None) -> tuple[tuple[int, int], bool]:
    """((height, width), whether the numbers are integers) of a depth file."""
    file = file or Path()
    kind = file.suffix.lower()
    if kind in (".tif", ".tiff"):
        header = tiff.read_tiff_header(file)
        return header.hw, header.dtype.kind != "f"
    if kind in _DEPTH_CODECS:
        values = _DEPTH_CODECS[kind](file)
        return (values.shape[0], values.shape[1]), values.dtype.kind != "f"
    return files.read_image_header(file).hw, True


# ----------------------------------------------------------------------------------------------------- numbered rows


@dataclass(frozen=True, eq=False)
class FolderParts:
    """What a layout of numbered frames has: its rows, and what it states of their camera, depth and poses."""

    rows: Sequence[FrameFiles]  # at least one, sorted by number
    K: StatedK | None  # of the images; options go before it
    K_file: str  # the file that would state it, for the error where K is missing
    units_per_metre: float  # depth codes of one metre
    unit_source: str | None  # what states it; None = assumed
    poses_file: Path | None  # file or folder of the poses, for errors; None = no poses
    report: Sequence[str] = ()
    depth_K: StatedK | None = None  # where depth has a camera of its own
    rotated_bits: int = 0  # bits by which the depth codes are rotated
    name: str | None = None  # of the recording; None = the folder's


def open_numbered(root: Path, format: str, parts: FolderParts, options: KOptions, fps: float | None) -> Recording:
    """Parts of one capture → its recording; rows whose pose is lost or missing are left out and reported.

    Args:
        root: folder of the capture.
        format: name of the reader.
        parts: of the capture.
        options: intrinsics, K and fov of the reader.
        fps: frame rate, for time stamps; None = no time stamps.

    Raises:
        FormatError: no K, or values that are no cameras or poses.
    """
    rows, stated = parts.rows, parts.K
    hw, (depth_hw, _) = files.read_image_header(rows[0].image).hw, read_depth_type(rows[0].depth)
    camera, guess = intrinsics_options.parse_camera(root, hw, *options)
    if camera is None and stated is None:
        raise intrinsics_options.missing_intrinsics_error(root, None, parts.K_file)
    scaled: tuple[str, ...] = ()
    if camera is None and stated is not None:
        camera, scaled = _fit_camera(stated, hw)
        if rows[0].K is not None:  # equal matrices share one camera
            cameras = {K.tobytes(): convert.to_camera(K, hw, *stated[1:3]) for row in rows if (K := row.K) is not None}
            rows = [row if row.K is None else replace(row, camera=cameras[row.K.tobytes()]) for row in rows]
    depth_camera, depth_scaled = (None, ()) if parts.depth_K is None else _fit_camera(parts.depth_K, depth_hw)
    rows, lost = split_lost(rows)
    lines, poses = [*parts.report, *scaled, *depth_scaled, *guess, *lost], None
    if all(row.c2w is not None for row in rows):
        poses = convert.to_poses(np.stack([row.c2w for row in rows if row.c2w is not None]), parts.poses_file or root)
    else:
        lines.append("no poses")
    rate = None if fps is None else files.to_positive(fps, root, "option fps")
    number = torch.tensor([row.number for row in rows])
    units, bits = parts.units_per_metre, parts.rotated_bits
    loader, stored = read_stored_sizes(
        FrameLoader(tuple(rows), hw, depth_hw, camera, depth_camera, units, rotated_bits=bits)
    )
    return Recording(
        name=parts.name or root.resolve().name,
        format=format,
        load=loader,
        number=number,
        root=root,
        times=None if rate is None else number.double() / rate,
        poses=poses,
        rate_hz=rate,
        report=tuple(lines),
        depth_unit=DepthUnit(1 / units, parts.unit_source),
        stored=stored,
    )


def read_stored_sizes(loader: FrameLoader) -> tuple[FrameLoader, StoredSizes]:
    """The loader with the orientation tag of its first image, and what the files state of their orientation.

    Raises:
        FormatError: depth maps lie turned by 90 degrees against the intrinsics of their own camera.
    """
    exif = files.read_image_header(loader.rows[0].image).orientation
    depth_hw: tuple[int, int] | None = loader.depth_hw
    if loader.depth_camera is not None:
        c, (h, w), depth_hw = loader.depth_camera.c[0] + 0.5, loader.depth_hw, None
        stated, turned = (float((c / c.new_tensor(size) - 0.5).abs().max()) for size in ((w, h), (h, w)))
        files.refuse_if(
            turned <= intrinsics_options.MAX_CENTRE_OFFSET and stated > 2 * intrinsics_options.MAX_CENTRE_OFFSET,
            loader.rows[0].depth or "depth",
            "size",
            f"{w}x{h}, turned against its intrinsics with the principal point {c[0]:.0f}, {c[1]:.0f} px",
            "depth maps as their camera lies",
        )
    return replace(loader, exif=exif), StoredSizes.of_images(loader.hw, depth_hw, exif)


def choose_rotated_bits(file: Path | None, rotated: bool | None, whose: str) -> tuple[int, tuple[str, ...]]:
    """Bits by which the codes of a format that rotates them to the left are rotated, and the remark where not.

    ``rotated`` is the reader's option; None = as far as the returns of the depth PNG ``file`` show.
    """
    if rotated is None:
        code = files.read_depth_png(file or Path(), 1).astype(np.uint16)
        returns = code[code > 0]
        # Codes rotated by 3 bits hold the depth's 3 highest bits at the lower end, which are at most 2 for depths below
        # 3/8 of the range (24.6 m in mm); 3/8 of plain codes have such lower bits, so that 0.7 divides 3/8 from 1.
        rotated = returns.size == 0 or float((returns % 8 <= 2).mean()) >= 0.7
    if rotated:
        return 3, ()
    return 0, (f"depth codes are not rotated by 3 bits, unlike {whose}: read unrotated (data.rotated=true)",)


def split_lost(rows: Sequence[FrameFiles]) -> tuple[list[FrameFiles], list[str]]:
    """Rows with a usable pose, or all rows without poses where none has one; report of those left out."""
    if all(row.c2w is None for row in rows):
        return list(rows), []
    without = [row.number for row in rows if row.c2w is None]
    lost = [row.number for row in rows if row.c2w is not None and not np.isfinite(row.c2w).all()]
    if len(without) + len(lost) == len(rows):
        return [replace(row, c2w=None) for row in rows], ["every pose is missing or not finite (tracking lost)"]
    return [row for row in rows if row.c2w is not None and np.isfinite(row.c2w).all()], [
        *files.format_left_out(without, "no pose"),
        *files.format_left_out(lost, "the pose is not finite (tracking lost)"),
    ]


# -------------------------------------------------------------------------------------------------------- posed rows


def open_posed(
    root: Path,
    format: str,
    rows: Sequence[FrameFiles],
    *,
    unit: DepthUnit | None,
    report: Sequence[str] = (),
    name: str | None = None,
    pose_axes: str = "cv",
    level_of_code: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Recording:
    """Rows with ``K`` → their recording, ordered by number, else time, else name; incomplete rows are reported.

    Args:
        root: folder of the capture.
        format: name of the reader.
        rows: in any order, with images of one size; depth maps of any size cover the field of view of their image.
        unit: of the depth maps; None = millimetres for integers and metres for floats, assumed.
        report: of the reader.
        name: of the recording; None = the folder's.
        pose_axes: camera axes of the stored poses, ``cv`` or ``gl``.
        level_of_code: stored confidence → 0, 1 or 2; None = confidence is not read.

    Raises:
        FormatError: no image, images of several aspect ratios, or values that are no cameras or poses.
    """
    rows, left_out = _select_complete(_sort(rows))
    lines = [*report, *left_out]
    files.refuse_if(not rows, root, "frames", "; ".join(lines) or "none", "at least one image with a pose")
    header = files.read_image_header(rows[0].image)
    hw = header.hw
    rows, scaled = _fit_rows(rows, hw, header.orientation)
    _own_camera(rows[0], hw)
    without = [row.image for row in rows if row.depth is None]
    maps = [row.depth for row in rows if row.depth is not None]
    if maps:
        missing = format_names_left_out(without, "no depth map")
        lines += [*scaled, *(line.replace(": left out", ": its depth is empty") for line in missing)]
    else:
        lines += [*scaled, "no depth maps: depth is empty"]
    depth_hw, is_integer = read_depth_type(maps[0]) if maps else (hw, True)
    unit = unit or DepthUnit(1e-3 if is_integer else 1.0)
    poses = None
    if rows[0].c2w is not None:
        poses = convert.to_poses(np.stack([row.c2w for row in rows if row.c2w is not None]), rows[0].source)
    times, time_report = _parse_times(rows)
    return Recording(
        name=name or root.resolve().name,
        format=format,
        load=FrameLoader(
            tuple(rows),
            hw,
            depth_hw,
            step_m=unit.metres,
            exif=header.orientation,
            level_of_code=level_of_code if all(row.conf is not None for row in rows) else None,
        ),
        number=torch.tensor([row.number for row in rows] if rows[0].number >= 0 else list(range(len(rows)))),
        root=root,
        times=times,
        poses=poses,
        pose_axes=pose_axes,
        report=(*lines, *time_report),
        depth_unit=unit if maps else None,
        stored=StoredSizes.of_images(hw, depth_hw if maps else None, header.orientation),
    )


def _sort(rows: Sequence[FrameFiles]) -> list[FrameFiles]:
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


def _select_complete(rows: Sequence[FrameFiles]) -> tuple[list[FrameFiles], list[str]]:
    """Rows with an image, and with a finite pose where any row has one; report of the others by name."""
    present = [row for row in rows if row.image.is_file()]
    report = format_names_left_out([row.image for row in rows if not row.image.is_file()], "no such image")
    if all(row.c2w is None for row in present):
        return present, report + (["no poses"] if present else [])
    is_posed = {row.image: row.c2w is not None and bool(np.isfinite(row.c2w).all()) for row in present}
    lost = format_names_left_out(
        [row.image for row in present if not is_posed[row.image]], "no pose, or one that is not finite (tracking lost)"
    )
    return [row for row in present if is_posed[row.image]], report + lost


def format_names_left_out(images: Sequence[Path], reason: str) -> list[str]:
    """Report line on images that are left out, or empty list."""
    return [line.replace("frame", "image", 1) for line in files.format_left_out([f.name for f in images], reason)]


def _fit_rows(rows: Sequence[FrameFiles], hw: tuple[int, int], exif: int) -> tuple[list[FrameFiles], list[str]]:
    """Rows with K for images of size ``hw``, and the report where a stated size differs.

    K that is stated for images as their orientation tag turns them is kept: they are turned when the recording is.
    """
    fitted, report = [], dict[str, None]()
    for row in rows:
        # EXIF orientations from which on width and height are exchanged. Source: EXIF 2.3, tag 0x0112.
        if row.K is None or (exif >= 5 and row.hw == hw[::-1]):
            fitted.append(row)
            continue
        K, lines = fit_K(row.K, row.hw or hw, hw, row.source)
        report |= dict.fromkeys(lines)
        fitted.append(replace(row, K=K, hw=hw))
    return fitted, list(report)


def _parse_times(rows: Sequence[FrameFiles]) -> tuple[Tensor | None, list[str]]:
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


# ------------------------------------------------------------------------------------------------------------ files


def first_file(*places: Path) -> Path | None:
    """The first of the places that is a file; None where none is."""
    return next((place for place in places if place.is_file()), None)


def list_images(folder: Path) -> dict[str, Path]:
    """Images of a folder by their names without suffix, in natural order; nothing where there is no folder."""
    if not folder.is_dir():
        return {}
    pattern = re.compile(r"(.+)\.(?:png|jpg|jpeg|pgm)", re.IGNORECASE)
    named = {m[1]: file for file in folder.iterdir() if (m := pattern.fullmatch(file.name))}
    return {stem: named[stem] for stem in sorted(named, key=files.natural_sort_key)}


def first_image_folder(root: Path, names: Sequence[str]) -> Path | None:
    """The first of the folders with images; None where none has any."""
    return next((root / name for name in names if list_images(root / name)), None)


def list_numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder whose names match ``pattern`` by the number in its first group, in increasing order."""
    if not folder.is_dir():
        return {}
    expression = re.compile(pattern, re.IGNORECASE)
    numbered = {int(m[1]): file for file in folder.iterdir() if (m := expression.fullmatch(file.name))}
    return dict(sorted(numbered.items()))


def pair_numbered(
    root: Path, images: Mapping[int, Path], depths: Mapping[int, Path], poses: Mapping[int, np.ndarray]
) -> tuple[list[FrameFiles], list[str]]:
    """Rows of the numbers that have an image and a depth map, and the report of the others.

    Raises:
        FormatError: no such number.
    """
    both = sorted(images.keys() & depths.keys())
    problem = f"{len(depths)} for {len(images)} images"
    files.refuse_if(not both, root, "depth maps", problem, "the images' numbers")
    report = files.format_left_out(sorted(images.keys() - depths.keys()), "no depth map")
    report += files.format_left_out(sorted(depths.keys() - images.keys()), "no image")
    return [FrameFiles(i, images[i], depths[i], poses.get(i)) for i in both], report


def pair_folders(
    root: Path, images: Mapping[str, Path], depths: Mapping[str, Path], table: Path | None
) -> tuple[list[FrameFiles], list[str]]:
    """Rows of images and depth maps of two folders, numbered by the place of the image among all, and the report.

    Args:
        root: folder of the capture, for errors and the paths of ``table``.
        images, depths: by their names without suffix.
        table: text file with the names of an image and of its depth map in each line, in any order; None = none, the
            names are equal or hold time stamps.

    Raises:
        FormatError: a table with other names, names that cannot be paired, or no pair.
    """
    places = {stem: i for i, stem in enumerate(images)}
    if table is not None:
        by_file = {(file.parent.name, file.name): ("image", stem) for stem, file in images.items()}
        by_file |= {(file.parent.name, file.name): ("depth", stem) for stem, file in depths.items()}
        pairs = []
        for line, words in files.read_rows(table):
            keys = [(Path(word).parent.name, Path(word).name) for word in words]
            named = dict(by_file[key] for key in keys if key in by_file)
            expected = "the names of an image and of its depth map"
            files.refuse_if(named.keys() != {"image", "depth"}, table, f"line {line}", " ".join(words), expected)
            pairs.append((named["image"], named["depth"]))
        pairs = list({image: (image, depth) for image, depth in reversed(pairs)}.values())
    elif images.keys() & depths.keys():
        pairs = [(stem, stem) for stem in images if stem in depths]
    else:
        pairs = _pair_stamped(root, list(images), list(depths))
    problem = f"{len(depths)} for {len(images)} images"
    files.refuse_if(not pairs, root, "depth maps", problem, "one for each image")
    paired = {stem for stem, _ in pairs}
    report = files.format_left_out([places[stem] for stem in images if stem not in paired], "no depth map")
    unused = len(depths) - len({stem for _, stem in pairs})
    if unused:
        report.append(f"{unused} depth map{'s' if unused > 1 else ''} without an image: left out")
    pairs.sort(key=lambda pair: places[pair[0]])
    return [FrameFiles(places[a], images[a], depths[b]) for a, b in pairs], report


def _pair_stamped(root: Path, *stems: list[str]) -> list[tuple[str, str]]:
    """Pairs of names (of an image, of a depth map) whose time stamps are nearest."""
    stamps = []
    for named in stems:
        # a running number and a time stamp in microseconds, as SUN3D's and Redwood's ``0000012-000000366966``
        matches = [re.fullmatch(r"\d+-(\d{9,})", stem) for stem in named]
        stamps.append(np.array([int(m[1]) * 1e-6 for m in matches if m]))
        expected = "the same names in both, or a time stamp in each name"
        is_other = not named or len(stamps[-1]) != len(named)
        files.refuse_if(is_other, root, "file names", f"{', '.join(named[:3]) or 'none'}, …", expected)
    return [(stems[0][i], stems[1][j]) for i, j in clocks.pair_stamps(*stamps)]


def read_K(file: Path) -> np.ndarray:
    """K (3, 3) of a text file with fx fy cx cy, or a 3×3, 3×4 or 4×4 matrix by rows, in any number of lines.

    Raises:
        FormatError: other numbers, or words that are no numbers.
    """
    words = [word for _, row in files.read_rows(file) for word in row]
    expected = "fx fy cx cy, or a 3x3 or 4x4 matrix"
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise files.FormatError(file, "K", " ".join(words), expected) from None
    if values.size == 4:
        return convert.make_K(*values)
    files.refuse_if(values.size not in (9, 12, 16), file, "K", f"{values.size} numbers", expected)
    return values.reshape(4 if values.size == 16 else 3, -1)[:3, :3]


def read_pose(file: Path) -> np.ndarray:
    """Matrix (4, 4) of a file with 4 rows, not necessarily finite."""
    matrix = files.read_table(file, 4)
    files.refuse_if(matrix.shape != (4, 4), file, "pose", f"{len(matrix)} rows", "4 rows of 4 numbers")
    return matrix


# ------------------------------------------------------------------------------------------------- units and cameras


def choose_units(
    root: Path,
    option: float | None,
    document: Mapping[str, Any],
    file: Path | None,
    usual: float,
    source: str | None = None,
) -> tuple[float, str | None]:
    """(depth codes of one metre, what states it): the option, else ``depth_scale`` of a file, else the usual number."""
    if option is not None:
        return files.to_positive(option, root, "option units_per_metre"), "option units_per_metre"
    if file is None or "depth_scale" not in document:
        return usual, source
    return files.to_positive(document["depth_scale"], file, "depth_scale"), f"{file.name}: depth_scale"


def _fit_camera(stated: StatedK, hw: tuple[int, int]) -> tuple[Camera, tuple[str, ...]]:
    """Camera for images of size ``hw``, and the report of scaling."""
    K, file, field, stated_hw = stated
    K, scaled = fit_K(K, stated_hw or hw, hw, file)
    return convert.to_camera(K, hw, file, field), scaled


def fit_K(
    K: np.ndarray, stated_hw: tuple[int, int], hw: tuple[int, int], file: Path
) -> tuple[np.ndarray, tuple[str, ...]]:
    """K of an image of size ``stated_hw`` → K of the images of size ``hw``, and the report where these differ.

    Raises:
        FormatError: another aspect ratio: an image cut or turned, for which K is not known.
    """
    if stated_hw == hw:
        return K, ()
    sizes = f"{hw[1]}x{hw[0]}", f"{stated_hw[1]}x{stated_hw[0]}"
    # Aspect ratios of one image at two sizes: rounding of the shorter side to a pixel at 120 pixels is 0.8 %, ScanNet's
    # 1296×968 differs from 640×480 by 0.4 %.
    files.refuse_if(
        min(stated_hw) < 1 or abs(stated_hw[0] * hw[1] / (stated_hw[1] * hw[0]) - 1) > 0.01,
        file,
        "image size",
        sizes[1],
        f"{sizes[0]} as the images, or the same aspect ratio (data.K)",
    )
    report = f"images of {sizes[0]}, {file.name} states K for {sizes[1]}: K is scaled"
    return convert.resize_K(K, stated_hw, hw), (report,)
