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

#: K of a camera, the file and the field that state it, and the image size (h, w) it is stated for; None = the images'.
StatedK = tuple[np.ndarray, Path, str, tuple[int, int] | None]

IMAGE_NAME_PATTERN = re.compile(r"(.+)\.(?:png|jpg|jpeg|pgm)", re.IGNORECASE)

#: Names of the images of layouts that number all files of a frame in one folder.
NAMED_COLOUR_PATTERN = r"frame-(\d+)\.color\.(?:jpg|jpeg|png)"

#: Name with a running number and a time stamp in microseconds, as SUN3D's and Redwood's ``0000012-000000366966``.
_STAMPED_NAME_PATTERN = re.compile(r"\d+-(\d{9,})")


_K_EXPECTED = "fx fy cx cy, or a 3x3 or 4x4 matrix"


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
        units, bits = row.units_per_metre or self.units_per_metre, self.rotated_bits
        if row.depth.suffix.lower() == _PGM_SUFFIX:
            metres = files.to_metres(_rotate_codes(pgm.read_pgm(row.depth, self.depth_hw), bits), units, self.no_return)
        elif bits:
            code = files.read_depth_png(row.depth, 1, self.depth_hw).astype(np.uint16)
            metres = files.to_metres(_rotate_codes(code, bits), units, self.no_return)
        else:
            metres = files.read_depth_png(row.depth, units, self.depth_hw, self.no_return)
        depth, depth_camera = torch.from_numpy(metres), self.depth_camera
        if depth_camera is not None and self.register:
            depth, depth_camera = convert.register_depth(depth, depth_camera, camera, self.hw), None
        return Frame(image[None], depth[None], camera, depth_camera)


def read_stored_sizes(loader: ImageTableLoader) -> tuple[ImageTableLoader, StoredSizes]:
    """The loader with the orientation tag of its first image, and what the files state of their orientation.

    Raises:
        FormatError: depth maps lie turned by 90 degrees against the intrinsics of their own camera.
    """
    exif = files.read_image_header(loader.rows[0].image).orientation
    depth_hw: tuple[int, int] | None = loader.depth_hw
    if loader.depth_camera is not None:
        c, (h, w), depth_hw = loader.depth_camera.c[0] + 0.5, loader.depth_hw, None
        stated, turned = (float((c / c.new_tensor(size) - 0.5).abs().max()) for size in ((w, h), (h, w)))
        if turned <= intrinsics_options.MAX_CENTRE_OFFSET and stated > 2 * intrinsics_options.MAX_CENTRE_OFFSET:
            size = f"{w}x{h}, turned against its intrinsics with the principal point {c[0]:.0f}, {c[1]:.0f} px"
            raise FormatError(loader.rows[0].depth, "size", size, "depth maps as their camera lies")
    return replace(loader, exif=exif), StoredSizes.of_images(loader.hw, depth_hw, exif)


def choose_rotated_bits(file: Path, rotated: bool | None, whose: str) -> tuple[int, tuple[str, ...]]:
    """Bits by which the codes of a format that rotates them to the left are rotated, and the remark where not.

    ``rotated`` is the reader's option; None = as far as the returns of the depth PNG ``file`` show.
    """
    if rotated is None:
        code = files.read_depth_png(file, 1).astype(np.uint16)
        returns = code[code > 0]
        # Codes rotated by 3 bits hold the depth's 3 highest bits at the lower end, which are at most 2 for depths below
        # 3/8 of the range (24.6 m in mm); 3/8 of plain codes have such lower bits, so that 0.7 divides 3/8 from 1.
        rotated = returns.size == 0 or float((returns % 8 <= 2).mean()) >= 0.7
    if rotated:
        return 3, ()
    return 0, (f"depth codes are not rotated by 3 bits, unlike {whose}: read unrotated (data.rotated=true)",)


def _rotate_codes(code: np.ndarray, bits: int) -> np.ndarray:
    """Codes uint16 that are stored rotated to the left by ``bits`` → the codes."""
    return code if bits == 0 else np.right_shift(code, bits) | np.left_shift(code, 16 - bits)


def open_image_table(
    root: Path,
    format: str,
    rows: Sequence[ImageRow],
    options: tuple[intrinsics_options.IntrinsicsOption | None, Sequence[float] | None, float | None],
    *,
    stated: StatedK | None,
    where: str,
    units_per_metre: float,
    unit: DepthUnit,
    poses_file: Path | None,
    depth_stated: StatedK | None = None,
    rotated_bits: int = 0,
    fps: float | None = None,
    report: Sequence[str] = (),
    name: str | None = None,
) -> Recording:
    """Rows of one capture → its recording; rows whose pose is lost or missing are left out and reported.

    Args:
        root: folder of the capture.
        format: name of the reader.
        rows: at least one, sorted by number.
        options: intrinsics, K and fov of the reader.
        stated: K of the images in the capture, if any; options go before it.
        where: the file that would hold it, for the error where K is missing.
        units_per_metre: depth codes of one metre.
        unit: of the depth codes, and what states it.
        poses_file: file or folder of the poses, for errors; None = no poses.
        depth_stated: K of the depth maps where they have a camera of their own.
        rotated_bits: bits by which the depth codes are rotated.
        fps: frame rate, for time stamps; None = no time stamps.
        report: of the reader.
        name: of the recording; None = the folder's.

    Raises:
        FormatError: no K, or values that are no cameras or poses.
    """
    hw, depth_hw = files.read_image_header(rows[0].image).hw, read_depth_hw(rows[0].depth)
    option, scaled = parse_option(root, hw, *options), tuple[str, ...]()
    if option.K is not None:
        camera = convert.to_camera(convert.make_K(*option.K), hw, root, "option K")
    elif stated is None:
        raise intrinsics_options.missing_intrinsics_error(root, None, where)
    else:
        camera, scaled = _fit_camera(stated, hw)
    depth_camera, depth_scaled = (None, ()) if depth_stated is None else _fit_camera(depth_stated, depth_hw)
    rows, lost = split_lost(rows)
    lines, poses = [*report, *scaled, *depth_scaled, *option.report, *lost], None
    if all(row.c2w is not None for row in rows):
        poses = convert.to_poses(np.stack([row.c2w for row in rows if row.c2w is not None]), poses_file or root)
    else:
        lines.append("no poses")
    rate = None if fps is None else files.to_positive(fps, root, "option fps")
    number = torch.tensor([row.number for row in rows])
    loader, stored = read_stored_sizes(
        ImageTableLoader(tuple(rows), hw, depth_hw, camera, depth_camera, units_per_metre, rotated_bits=rotated_bits)
    )
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
    root: Path, images: Mapping[int, Path], depths: Mapping[int, Path], poses: Mapping[int, np.ndarray]
) -> tuple[list[ImageRow], list[str]]:
    """Rows of the numbers that have an image and a depth map, and the report of the others.

    Raises:
        FormatError: no such number.
    """
    both = sorted(images.keys() & depths.keys())
    if not both:
        raise FormatError(root, "depth maps", f"{len(depths)} for {len(images)} images", "the images' numbers")
    report = files.format_left_out(sorted(images.keys() - depths.keys()), "no depth map")
    report += files.format_left_out(sorted(depths.keys() - images.keys()), "no image")
    return [ImageRow(i, images[i], depths[i], poses.get(i)) for i in both], report


def pair_folders(
    root: Path, images: Mapping[str, Path], depths: Mapping[str, Path], table: Path | None
) -> tuple[list[ImageRow], list[str]]:
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
            if named.keys() != {"image", "depth"}:
                raise FormatError(table, f"line {line}", " ".join(words), "the names of an image and of its depth map")
            pairs.append((named["image"], named["depth"]))
        pairs = list({image: (image, depth) for image, depth in reversed(pairs)}.values())
    elif images.keys() & depths.keys():
        pairs = [(stem, stem) for stem in images if stem in depths]
    else:
        pairs = _pair_stamped(root, list(images), list(depths))
    if not pairs:
        raise FormatError(root, "depth maps", f"{len(depths)} for {len(images)} images", "one for each image")
    paired = {stem for stem, _ in pairs}
    report = files.format_left_out([places[stem] for stem in images if stem not in paired], "no depth map")
    unused = len(depths) - len({stem for _, stem in pairs})
    if unused:
        report.append(f"{unused} depth map{'s' if unused > 1 else ''} without an image: left out")
    pairs.sort(key=lambda pair: places[pair[0]])
    return [ImageRow(places[a], images[a], depths[b]) for a, b in pairs], report


def _pair_stamped(root: Path, *stems: list[str]) -> list[tuple[str, str]]:
    """Pairs of names (of an image, of a depth map) whose time stamps are nearest."""
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


def parse_option(
    root: Path,
    hw: tuple[int, int],
    intrinsics: intrinsics_options.IntrinsicsOption | None,
    K: Sequence[float] | None,
    fov: float | None,
) -> intrinsics_options.ParsedIntrinsics:
    """The options of a format without features; raises where they name one."""
    option = intrinsics_options.parse_intrinsics(root, hw, intrinsics, K, fov)
    if option.feature is not None:
        expected = "fx fy cx cy, or degrees (the format has no features)"
        raise FormatError(root, "option intrinsics", option.feature, expected)
    return option


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
    if abs(stated_hw[0] * hw[1] / (stated_hw[1] * hw[0]) - 1) > 0.01:
        raise FormatError(file, "image size", sizes[1], f"{sizes[0]} as the images, or the same aspect ratio (data.K)")
    report = f"images of {sizes[0]}, {file.name} states K for {sizes[1]}: K is scaled"
    return convert.resize_K(K, stated_hw, hw), (report,)
