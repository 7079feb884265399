"""Image tables: rows of number, image, depth file, pose and camera -> a recording; shared by readers of image folders.

A reader lists its files and numbers, this module pairs them, leaves out rows that lack a part (reported, by number) and
decodes a row on access. Depth files are 16-bit PNGs or PGMs of codes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dhtorch.data import clocks, convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.codecs import pgm
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording
from dhtorch.data.stored_sizes import StoredSizes
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.no_depth import NO_DEPTH_CODES
from dhtorch.records import Camera, Frame

IMAGE_NAME_PATTERN = re.compile(r"(.+)\.(?:png|jpg|jpeg|pgm)", re.IGNORECASE)

#: Names of the images of layouts that number all files of a frame in one folder.
NAMED_COLOUR_PATTERN = r"frame-(\d+)\.color\.(?:jpg|jpeg|png)"

#: Name with a running number and a time stamp in microseconds, as SUN3D's and Redwood's ``0000012-000000366966``.
_STAMPED_NAME_PATTERN = re.compile(r"\d+-(\d{9,})")

#: Codes rotated by 3 bits hold the depth's 3 highest bits at the lower end, which are at most this number for depths
#: below 3/8 of the range (24.6 m in mm); plain codes have all 8 numbers there. Source: derived.
_MAX_LOW_BITS = 2
#: Least share of non-zero codes with such lower bits in rotated codes; 3/8 of plain codes have them. Source: chosen
#: between 3/8 and 1.
_MIN_ROTATED = 0.7

_K_EXPECTED = "fx fy cx cy, or a 3x3 or 4x4 matrix"

#: Largest relative difference of two aspect ratios that are one picture at two sizes. Source: derived: rounding of the
#: shorter side to a pixel at 120 pixels is 0.8 %, ScanNet's 1296×968 differs from 640×480 by 0.4 %.
_MAX_ASPECT_ERROR = 0.01

#: Names of depth files that are decoded by the PGM codec.
_PGM_SUFFIX = ".pgm"


@dataclass(frozen=True)
class ImageRow:
    """One frame: its number in the capture, its files, and pose and camera where it has its own."""

    number: int
    image: Path
    depth: Path
    c2w: np.ndarray | None = None  # (4, 4); not finite where tracking was lost; None = no pose
    camera: Camera | None = None  # None = the recording's
    units_per_metre: float | None = None  # depth codes of one metre; None = the recording's


@dataclass(frozen=True, eq=False)
class ImageTableLoader:
    """Position → frame, decoded from its files."""

    rows: tuple[ImageRow, ...]
    hw: tuple[int, int]
    depth_hw: tuple[int, int]
    camera: Camera
    depth_camera: Camera | None = None  # None = ``camera`` scaled to the depth's size
    units_per_metre: float = 1000.0
    no_return: tuple[int, ...] = NO_DEPTH_CODES
    rotated_bits: int = 0  # bits by which the codes are rotated to the left
    register: bool = False  # warp depth with a camera of its own to the image, at most at its own density
    exif: int | None = None  # orientation tag of every image; None = not checked

    def __call__(self, i: int) -> Frame:
        """Decode the frame at position ``i``."""
        row = self.rows[i]
        camera = self.camera if row.camera is None else row.camera
        image = torch.from_numpy(files.read_image(row.image, self.hw, self.exif))
        depth = torch.from_numpy(self._read_depth(row))
        depth_camera = self.depth_camera
        if depth_camera is not None and self.register:
            depth, depth_camera = convert.register_depth(depth, depth_camera, camera, self.hw), None
        return Frame(image[None], depth[None], camera, depth_camera)

    def _read_depth(self, row: ImageRow) -> np.ndarray:
        units = self.units_per_metre if row.units_per_metre is None else row.units_per_metre
        if self.rotated_bits == 0 and row.depth.suffix.lower() != _PGM_SUFFIX:
            return files.read_depth_png(row.depth, units, self.depth_hw, self.no_return)
        return files.to_metres(self._read_codes(row.depth), units, self.no_return)

    def _read_codes(self, file: Path) -> np.ndarray:
        if file.suffix.lower() == _PGM_SUFFIX:
            code = pgm.read_pgm(file, self.depth_hw)
        else:
            code = files.read_depth_png(file, 1, self.depth_hw).astype(np.uint16)
        return rotate_codes(code, self.rotated_bits)


def read_stored_sizes(loader: ImageTableLoader) -> tuple[ImageTableLoader, StoredSizes]:
    """The loader with the orientation tag of its first image, and what the files state of their orientation."""
    exif = files.read_image_header(loader.rows[0].image).orientation
    _refuse_turned_depth(loader)
    depth_hw = loader.depth_hw if loader.depth_camera is None else None
    return replace(loader, exif=exif), StoredSizes.of_images(loader.hw, depth_hw, exif)


def _refuse_turned_depth(loader: ImageTableLoader) -> None:
    """Raise if depth maps lie turned by 90 degrees against the intrinsics of their own camera."""
    if loader.depth_camera is None:
        return
    c, (h, w) = loader.depth_camera.c[0] + 0.5, loader.depth_hw
    stated, turned = (float((c / c.new_tensor(size) - 0.5).abs().max()) for size in ((w, h), (h, w)))
    if turned <= intrinsics_options.MAX_CENTRE_OFFSET and stated > 2 * intrinsics_options.MAX_CENTRE_OFFSET:
        size = f"{w}x{h}, turned against its intrinsics with the principal point {c[0]:.0f}, {c[1]:.0f} px"
        raise FormatError(loader.rows[0].depth, "size", size, "depth maps as their camera lies")


def are_codes_rotated(file: Path) -> bool:
    """Whether the codes of a depth PNG are rotated to the left by 3 bits, as far as its returns show."""
    code = files.read_depth_png(file, 1).astype(np.uint16)
    returns = code[code > 0]
    return returns.size == 0 or float((returns % 8 <= _MAX_LOW_BITS).mean()) >= _MIN_ROTATED


def choose_rotated_bits(file: Path, rotated: bool | None, bits: int, whose: str) -> tuple[int, tuple[str, ...]]:
    """Bits by which the codes of a format that rotates them are rotated, and the remark where they are not.

    Args:
        file: a depth map, which decides where ``rotated`` is None.
        rotated: the reader's option.
        bits: of the format.
        whose: the format, for the remark.
    """
    if are_codes_rotated(file) if rotated is None else rotated:
        return bits, ()
    return 0, (f"depth codes are not rotated by {bits} bits, unlike {whose}: read unrotated (data.rotated=true)",)


def rotate_codes(code: np.ndarray, bits: int) -> np.ndarray:
    """Codes uint16 that are stored rotated to the left by ``bits`` → the codes."""
    return code if bits == 0 else np.right_shift(code, bits) | np.left_shift(code, 16 - bits)


def open_image_table(
    root: Path,
    format: str,
    loader: ImageTableLoader,
    *,
    unit: DepthUnit,
    poses_file: Path | None,
    fps: float | None = None,
    report: Sequence[str] = (),
    name: str | None = None,
) -> Recording:
    """Rows of one capture → its recording; rows whose pose is lost or missing are left out and reported.

    Args:
        root: folder of the capture.
        format: name of the reader.
        loader: of all rows, sorted by number.
        unit: of the depth codes.
        poses_file: file or folder of the poses, for errors; None = no poses.
        fps: frame rate, for time stamps; None = no time stamps.
        report: of the reader.
        name: of the recording; None = the folder's.

    Raises:
        FormatError: no row, or values that are no poses.
    """
    rows, lost = split_lost(loader.rows)
    lines = [*report, *lost]
    if not rows:
        raise FormatError(root, "frames", "none with image, depth map and pose", "at least one")
    poses = None
    if all(row.c2w is not None for row in rows):
        poses = convert.to_poses(np.stack([row.c2w for row in rows if row.c2w is not None]), poses_file or root)
    else:
        lines.append("no poses")
    rate = None if fps is None else files.to_positive(fps, root, "option fps")
    number = torch.tensor([row.number for row in rows])
    loader, stored = read_stored_sizes(replace(loader, rows=tuple(rows)))
    return Recording(
        name=name or root.resolve().name,
        format=format,
        load=loader,
        number=number,
        root=root,
        times=None if rate is None else number.double() / rate,
        poses=poses,
        rate_hz=rate,
        report=tuple(lines),
        depth_unit=unit,
        stored=stored,
    )


def split_lost(rows: Sequence[ImageRow]) -> tuple[list[ImageRow], list[str]]:
    """Rows with a usable pose, or all rows without poses where none has one; report of those left out."""
    if all(row.c2w is None for row in rows):
        return list(rows), []
    without = [row.number for row in rows if row.c2w is None]
    lost = [row.number for row in rows if row.c2w is not None and not np.isfinite(row.c2w).all()]
    report = [
        *files.format_left_out(without, "no pose"),
        *files.format_left_out(lost, "the pose is not finite (tracking lost)"),
    ]
    left_out = {*without, *lost}
    kept = [row for row in rows if row.number not in left_out]
    if kept:
        return kept, report
    return [replace(row, c2w=None) for row in rows], ["every pose is missing or not finite (tracking lost)"]


# ------------------------------------------------------------------------------------------------------------ files


def list_images(folder: Path) -> dict[str, Path]:
    """Images of a folder by their names without suffix, in natural order; nothing where there is no folder."""
    if not folder.is_dir():
        return {}
    named = {m[1]: file for file in folder.iterdir() if (m := IMAGE_NAME_PATTERN.fullmatch(file.name))}
    return {stem: named[stem] for stem in sorted(named, key=files.natural_sort_key)}


def list_numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder whose names match ``pattern`` by the number in its first group, in increasing order."""
    if not folder.is_dir():
        return {}
    expression = re.compile(pattern, re.IGNORECASE)
    numbered = {int(m[1]): file for file in folder.iterdir() if (m := expression.fullmatch(file.name))}
    return dict(sorted(numbered.items()))


def pair_numbered(
    images: Mapping[int, Path], depths: Mapping[int, Path], poses: Mapping[int, np.ndarray]
) -> tuple[list[ImageRow], list[str]]:
    """Rows of the numbers that have an image and a depth map, and the report of the others."""
    both = sorted(images.keys() & depths.keys())
    report = files.format_left_out(sorted(images.keys() - depths.keys()), "no depth map")
    report += files.format_left_out(sorted(depths.keys() - images.keys()), "no image")
    return [ImageRow(i, images[i], depths[i], poses.get(i)) for i in both], report


def pair_folders(root: Path, images: Mapping[str, Path], depths: Mapping[str, Path], table: Path | None) -> ImagePairs:
    """Images and depth maps of two folders, paired by a table of file names, equal names, or stamps in the names.

    Args:
        root: folder of the capture, for errors and the paths of ``table``.
        images, depths: by their names without suffix.
        table: text file with the names of an image and of its depth map in each line, in any order; None = none.

    Raises:
        FormatError: a table with other names, or names that cannot be paired.
    """
    places = {stem: i for i, stem in enumerate(images)}
    if table is not None:
        pairs = _read_pair_table(table, images, depths)
    elif images.keys() & depths.keys():
        pairs = [(stem, stem) for stem in images if stem in depths]
    else:
        pairs = _pair_stamped(root, images, depths)
    paired = {stem for stem, _ in pairs}
    report = files.format_left_out([places[stem] for stem in images if stem not in paired], "no depth map")
    unused = len(depths) - len({stem for _, stem in pairs})
    if unused:
        report.append(f"{unused} depth map{'s' if unused > 1 else ''} without an image: left out")
    rows = tuple(ImageRow(places[a], images[a], depths[b]) for a, b in sorted(pairs, key=lambda pair: places[pair[0]]))
    return ImagePairs(rows, tuple(report))


@dataclass(frozen=True)
class ImagePairs:
    """Paired images and depth maps, numbered by the place of the image among all images, and what was left out."""

    rows: tuple[ImageRow, ...]
    report: tuple[str, ...]


def _read_pair_table(table: Path, images: Mapping[str, Path], depths: Mapping[str, Path]) -> list[tuple[str, str]]:
    by_file = {(file.parent.name, file.name): ("image", stem) for stem, file in images.items()}
    by_file |= {(file.parent.name, file.name): ("depth", stem) for stem, file in depths.items()}
    pairs = []
    for line, words in files.read_rows(table):
        named = dict(by_file[key] for word in words if (key := (Path(word).parent.name, Path(word).name)) in by_file)
        if named.keys() != {"image", "depth"}:
            raise FormatError(table, f"line {line}", " ".join(words), "the names of an image and of its depth map")
        pairs.append((named["image"], named["depth"]))
    return list({image: (image, depth) for image, depth in reversed(pairs)}.values())


def _pair_stamped(root: Path, images: Mapping[str, Path], depths: Mapping[str, Path]) -> list[tuple[str, str]]:
    stems = list(images), list(depths)
    stamps = []
    for named in stems:
        matches = [_STAMPED_NAME_PATTERN.fullmatch(stem) for stem in named]
        stamps.append(np.array([int(m[1]) * 1e-6 for m in matches if m]))
        if not named or len(stamps[-1]) != len(named):
            expected = "the same names in both, or a time stamp in each name"
            raise FormatError(root, "file names", f"{', '.join(named[:3]) or 'none'}, …", expected)
    return [(stems[0][i], stems[1][j]) for i, j in clocks.pair_stamps(*stamps)]


def read_K(file: Path) -> np.ndarray:
    """K (3, 3) of a text file with fx fy cx cy, or a 3×3, 3×4 or 4×4 matrix by rows, in any number of lines.

    Raises:
        FormatError: other numbers, or words that are no numbers.
    """
    words = [word for _, row in files.read_rows(file) for word in row]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise FormatError(file, "K", " ".join(words), _K_EXPECTED) from None
    if values.size == 4:
        return convert.make_K(*values)
    columns = {9: 3, 12: 4, 16: 4}.get(values.size)
    if columns is None:
        raise FormatError(file, "K", f"{values.size} numbers", _K_EXPECTED)
    return values.reshape(-1, columns)[:3, :3]


def read_pose(file: Path) -> np.ndarray:
    """Matrix (4, 4) of a file with 4 rows, not necessarily finite."""
    matrix = files.read_table(file, 4)
    if matrix.shape != (4, 4):
        raise FormatError(file, "pose", f"{len(matrix)} rows", "4 rows of 4 numbers")
    return matrix


def read_depth_hw(file: Path) -> tuple[int, int]:
    """(height, width) of a depth file."""
    if file.suffix.lower() != _PGM_SUFFIX:
        return files.read_image_header(file).hw
    h, w = pgm.read_pgm(file).shape
    return h, w


# ------------------------------------------------------------------------------------------------------ cameras


def choose_camera(
    root: Path,
    hw: tuple[int, int],
    stated: tuple[object, Path, str] | None,  # K, its file and its field; None = the capture states none
    intrinsics: intrinsics_options.IntrinsicsOption | None,
    K: Sequence[float] | None,
    fov: float | None,
    *,
    where: str,
) -> tuple[Camera, tuple[str, ...]]:
    """Camera of the images from the options, else from the capture, and the report of a guess.

    ``where``: the file that would hold K, for the error where it is missing.

    Raises:
        FormatError: no K, or no camera for an image of size ``hw``.
    """
    option = intrinsics_options.parse_intrinsics(root, hw, intrinsics, K, fov)
    if option.feature is not None:
        expected = "fx fy cx cy, or degrees (the format has no features)"
        raise FormatError(root, "option intrinsics", option.feature, expected)
    if option.K is not None:
        return convert.to_camera(convert.make_K(*option.K), hw, root, "option K"), option.report
    if stated is None:
        raise intrinsics_options.missing_intrinsics_error(root, None, where)
    return convert.to_camera(stated[0], hw, *stated[1:]), ()


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
    if abs(stated_hw[0] * hw[1] / (stated_hw[1] * hw[0]) - 1) > _MAX_ASPECT_ERROR:
        raise FormatError(file, "image size", sizes[1], f"{sizes[0]} as the images, or the same aspect ratio (data.K)")
    report = f"images of {sizes[0]}, {file.name} states K for {sizes[1]}: K is scaled"
    return convert.resize_K(K, stated_hw, hw), (report,)
