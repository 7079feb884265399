"""Rows of LeRobot tables: those of an episode with frame numbers and times, encoded images, frames of videos, depth.

A depth video holds 12-bit codes (:mod:`dhtorch.data.depth_codes`). A video of more bits without a stated range holds
steps of a unit, as images and arrays do.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dhtorch.data.clocks import format_numbers, nearest_stamps
from dhtorch.data.codecs.parquet import read_columns, read_row
from dhtorch.data.codecs.tiff import decode_tiff, decode_tiff_header
from dhtorch.data.codecs.video import read_video_header, read_video_times
from dhtorch.data.depth_codes import CODE_BITS, DEFAULT_RANGE, N_CODES, find_return_range, metres_by_code
from dhtorch.data.io import decode as files
from dhtorch.data.readers.lerobot_meta import LeRobotEpisode, LeRobotFeature, LeRobotMeta, select_colour_keys
from dhtorch.data.units import UNIT_METRES, DepthUnit
from dhtorch.runtime import safe_open as doors
from dhtorch.runtime.console import format_count

#: Columns of ``dhtorch enrich``: frame number and time (s) in the capture that was enriched. Source: robot_target.
_CAPTURE_COLUMNS = ("observation.frame_number", "observation.time")

#: Largest difference in s between a float32 time stamp and the exact grid (frame number / fps) it was rounded from.
_MAX_GRID_ERROR_S = 1e-4


def read_row_table(file: Path, more: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The time and index columns of a whole table, and the columns ``more``; image columns are not read.

    The last table is cached, since the next episode is usually in it.

    Raises:
        FormatError: a missing or damaged table or column.
    """
    return _read_cached_table(file, doors.read_version(file), more)


@lru_cache(maxsize=1)
def _read_cached_table(file: Path, _version: tuple[int, ...], extra: tuple[str, ...]) -> dict[str, np.ndarray]:
    table: dict[str, np.ndarray] = {}
    index_columns = "timestamp", "frame_index", "episode_index"
    for name, values in read_columns(file, [index_columns[0], *extra], optional=index_columns[1:]).items():
        if not isinstance(values, np.ndarray):
            raise files.FormatError(file, name, "no numbers", "numbers")
        files.refuse_if(
            name in index_columns and values.size != len(values),
            file,
            name,
            f"shape {values.shape}",
            "one number per row",
        )
        table[name] = values.reshape(-1) if name in index_columns else values
    return table


def select_episode_rows(
    meta: LeRobotMeta, episode: LeRobotEpisode, table: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """(rows of the episode, their frame numbers, their times in s, report of what was left out).

    Without frame numbers in the table, rows are numbered. If all times differ from the grid of these numbers by one
    shift (a clock that does not start at 0), the grid is used: images are taken by the order of rows, which is
    reported.

    Raises:
        FormatError: no usable row.
    """
    default = np.full(len(table["timestamp"]), episode.number)
    rows = np.flatnonzero(table.get("episode_index", default) == episode.number)
    stamp = table["timestamp"][rows].astype(np.float64)
    number = table["frame_index"][rows].astype(np.float64) if "frame_index" in table else np.arange(float(len(rows)))
    numbered = (number >= 0) & (number < 2**31) & (number == np.floor(number))  # not NaN
    report: list[str] = []
    if "frame_index" in table and bool((numbered & _is_increasing(number, numbered)).all()):
        stamp, report = _replace_disordered(stamp, number / meta.fps, f"episode {episode.number}")
    valid = numbered & (stamp >= 0) & (stamp < 1e9)
    keep = valid & _is_increasing(number, valid) & _is_increasing(stamp, valid)
    if not keep.all():
        report.append(f"episode {episode.number}: {format_count(int((~keep).sum()), 'row')} out of order: left out")
    if episode.length is not None and episode.length != len(rows):
        report.append(
            f"episode {episode.number}: {format_count(len(rows), 'row')}, {episode.length} according to meta/episodes"
        )
    rows, number, stamp = rows[keep], number[keep], stamp[keep]
    files.refuse_if(len(rows) == 0, episode.data, f"episode {episode.number}", "no usable row", "frames")
    grid = number / meta.fps
    shift = float(np.median(stamp - grid))
    if abs(shift) > _MAX_GRID_ERROR_S and (np.abs(stamp - grid - shift) < _MAX_GRID_ERROR_S).all():
        report.append(f"episode {episode.number}: times begin at {stamp[0]:.4g} s: images taken by the order of rows")
        stamp = grid
    return rows, number.astype(np.int64), np.where(np.abs(grid - stamp) < _MAX_GRID_ERROR_S, grid, stamp), report


def _replace_disordered(stamp: np.ndarray, grid: np.ndarray, name: str) -> tuple[np.ndarray, list[str]]:
    """Stamps of numbered rows, or the grid of their numbers where stamps do not increase and most lie on the grid."""
    with np.errstate(invalid="ignore"):
        if len(stamp) < 2 or bool((np.diff(stamp) > 0).all()):
            return stamp, []
        on_grid = np.abs(stamp - grid - np.nanmedian(stamp - grid)) < _MAX_GRID_ERROR_S
    if on_grid.mean() <= 0.5:
        return stamp, []
    wrong = format_count(int((~on_grid).sum()), "time stamp")
    return grid, [f"{name}: {wrong} out of order: rows keep the order of their numbers, at the nominal rate"]


def find_capture_columns(meta: LeRobotMeta) -> tuple[str, ...]:
    """The columns in which ``dhtorch enrich`` keeps numbers and times of a capture; none in other data sets."""
    return _CAPTURE_COLUMNS if {*_CAPTURE_COLUMNS} <= {*meta.features} else ()


def read_capture_clock(
    meta: LeRobotMeta, table: dict[str, np.ndarray], rows: np.ndarray, numbers: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """(numbers, times in s) of the capture from which ``dhtorch enrich`` wrote the rows, else those of the rows.

    The times are None where that capture had none: those of the rows are then an assumed rate.
    """
    if not find_capture_columns(meta):
        return numbers, times
    own_numbers, own_times = (table[name][rows].reshape(-1).astype(np.float64) for name in _CAPTURE_COLUMNS)
    whole = np.isfinite(own_numbers).all() and (np.diff(own_numbers) > 0).all()
    increasing = np.isfinite(own_times).all() and (np.diff(own_times) > 0).all()
    kept = own_times if increasing else None if np.isnan(own_times).all() else times
    return own_numbers.astype(np.int64) if whole else numbers, kept


def read_encoded_image(table: Path, root: Path, key: str, row: int) -> tuple[bytes, Path]:
    """Encoded image of a row and its file: bytes in the table, or the file that the table names.

    Raises:
        FormatError: no image in that cell, or a missing file.
    """
    cell = read_row(table, (key,), row)[key]
    files.refuse_if(not isinstance(cell, dict), table, key, type(cell).__name__, "an image: bytes and path")
    data, path = cell.get("bytes"), cell.get("path")
    if isinstance(data, bytes) and data:
        return data, table
    files.refuse_if(not isinstance(path, str), table, key, "neither bytes nor path", "an image")
    file = files.resolve_inside(root, path, table, key)
    return files.read_bytes(file), file


def _is_increasing(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Mask of the values that are larger than every valid value before them."""
    valid_values = np.where(valid, values, -1.0)
    return values > np.maximum.accumulate(np.concatenate(([-1.0], valid_values)))[:-1]


def find_row_stamps(file: Path, start: float, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(time stamps of a video, times (n,) at which it has the rows of an episode that starts at ``start``), s.

    Raises:
        FormatError: no video, or one without frames.
    """
    stamps = read_video_times(file)
    files.refuse_if(len(stamps) == 0, file, "frames", "none", "at least one")
    # A video of one episode starts with it, whatever its first time stamp.
    return stamps, times + start + (float(stamps[0]) if start == 0 else 0.0)


def pair_episode_videos(
    videos: Mapping[str, tuple[Path, float]],  # key → file and the episode's start in it, s
    numbers: np.ndarray,  # (n,) frame numbers of the rows
    times: np.ndarray,  # (n,) s from the start of the episode
    tolerance: float,
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """(mask (n,) of rows with a frame in every video, key → their frames, report of the others).

    A video that cannot be read, or that has no row's frame, is left to the access to a frame, which fails.
    """
    has_picture, pictures, report = np.ones(len(times), bool), dict[str, np.ndarray](), list[str]()
    for key, (file, start) in videos.items():
        try:
            stamps, targets = find_row_stamps(file, start, times)
        except (files.FormatError, ImportError):
            continue
        nearest = nearest_stamps(targets, stamps, tolerance)
        if (nearest < 0).any() and start == 0 and len(stamps) == len(times) == numbers[-1] + 1:
            report.append(f"{file.name} has as many frames as rows, but at other times: paired by their order")
            nearest = numbers
        if (nearest < 0).all():
            continue
        lost = numbers[nearest < 0].tolist()
        if lost:
            at_end = bool((nearest[: len(times) - len(lost)] >= 0).all())
            have = "have" if len(lost) > 1 else "has"
            line = f"{format_numbers(lost, 'row')} {have} no picture in {file.name}: left out"
            line += "; the video ends early, and its stamps do not show frames lost before" if at_end else ""
            report.append(line)
        pictures[key] = nearest
        has_picture &= nearest >= 0
    return has_picture, {key: nearest[has_picture] for key, nearest in pictures.items()}, report


# -------------------------------------------------------------------------------------------------------------- depth

_GREY = "gray"  # start of FFmpeg's names of pixel formats with one channel


class _PixelType(NamedTuple):
    """Type of the stored pixels of a feature."""

    name: str  # such as gray12le, uint16, float32
    bits: int  # per channel
    channels: int


def flag_unmarked_depth(
    meta: LeRobotMeta, episode: LeRobotEpisode, requested: str | None
) -> tuple[LeRobotMeta, tuple[str, ...]]:
    """Flag features that are depth by their pixels: one channel of more than 8 bits, without ``is_depth_map``.

    Returns:
        The metadata with these features flagged, and a remark on each that is not ``requested``.

    Raises:
        FormatError: a damaged video or image of the episode.
    """
    features, remarks = dict(meta.features), list[str]()
    for key, feature in meta.features.items():
        if feature.dtype not in ("video", "image") or feature.is_depth:
            continue
        if feature.channels != 1 and not str(_stated_pixel_format(feature)).startswith(_GREY):
            continue
        if key in episode.videos and not episode.videos[key][0].is_file():
            continue
        pixels = _read_pixel_type(meta, feature, episode, 0)
        if pixels.channels != 1 or pixels.bits <= 8:
            continue
        features[key] = replace(feature, info={**feature.info, "is_depth_map": True})
        if key != requested:
            remark = f"{key} looks like depth: one channel, {pixels.name}, without is_depth_map"
            remarks.append(f"{remark}; data.depth={key} sets it")
    return replace(meta, features=features), tuple(remarks)


def find_depth_unit(meta: LeRobotMeta, feature: LeRobotFeature, episode: LeRobotEpisode, row: int) -> DepthUnit | None:
    """Unit of the stored depth; None = a video of LeRobot's codes, whose range defines metres.

    ``depth_unit`` of the feature's info, for an array also ``unit`` (as ``dhtorch enrich`` writes it), else m for
    floats and mm for integers, as in LeRobot. ``row`` of the table holds an image of the episode.

    Raises:
        FormatError: an unknown unit, or a damaged image or video.
    """
    if feature.dtype == "video":
        has_range = any(f"{prefix}{name}" in feature.info for name in DEFAULT_RANGE for prefix in ("", "video."))
        if has_range or _read_pixel_type(meta, feature, episode, row).bits <= CODE_BITS:
            return None
        return DepthUnit(UNIT_METRES["mm"])
    entry = "unit" if feature.dtype != "image" and "depth_unit" not in feature.info else "depth_unit"
    stated = feature.info.get(entry)
    if stated is None:
        is_float = _read_pixel_type(meta, feature, episode, row).name.startswith("float")
        return DepthUnit(UNIT_METRES["m" if is_float else "mm"])
    if not isinstance(stated, str) or stated not in UNIT_METRES:
        expected = f"one of {', '.join(UNIT_METRES)}"
        raise files.FormatError(meta.root / "meta" / "info.json", f"{feature.key} {entry}", stated, expected)
    return DepthUnit(UNIT_METRES[stated], f"meta/info.json: {feature.key} {entry}")


def _stated_pixel_format(feature: LeRobotFeature) -> str | None:
    """FFmpeg's name of a video's pixel format in the feature's info; None = not stated."""
    stated = feature.info.get("video.pix_fmt", feature.info.get("pix_fmt"))
    return stated if isinstance(stated, str) else None


def _read_pixel_type(meta: LeRobotMeta, feature: LeRobotFeature, episode: LeRobotEpisode, row: int) -> _PixelType:
    """Type of a feature's pixels: from its info or the header of its video or of the image in ``row``."""
    if feature.dtype == "video":
        name = _stated_pixel_format(feature) or read_video_header(episode.videos[feature.key][0]).pixels
        bits = re.search(r"(\d+)[lb]e$", name)
        return _PixelType(name, int(bits[1]) if bits else 8, 1 if name.startswith(_GREY) else feature.channels)
    if feature.dtype != "image":
        return _PixelType(feature.dtype, 8 * np.dtype(feature.dtype).itemsize, 1)
    data, file = read_encoded_image(episode.data, meta.root, feature.key, row)
    if data[:2] in (b"II", b"MM"):
        tiff = decode_tiff_header(data, file)
        return _PixelType(str(tiff.dtype), 8 * tiff.dtype.itemsize, tiff.samples)
    header = files.decode_image_header(data, file)
    return _PixelType(f"uint{header.bits}", header.bits, header.channels)


def find_depth_feature(meta: LeRobotMeta, camera: str, requested: str | None) -> LeRobotFeature | None:
    """The depth feature of a camera: as ``requested``, named like the camera, enriched, or the only one; else None."""
    depths = {key: f for key, f in meta.features.items() if f.is_depth and len(f.shape) >= 2}
    if requested is not None:
        files.refuse_if(
            requested not in meta.features or len(meta.features[requested].shape) < 2,
            meta.root,
            "option depth",
            requested,
            f"one of {', '.join(depths) or 'none'}",
        )
        return meta.features[requested]
    matching = [f for key, f in depths.items() if _distinctive_words(key) == _distinctive_words(camera)]
    if len(matching) == 1:
        return matching[0]
    if (enriched := f"{camera}_depth_enriched") in depths:  # by dhtorch enrich, of a source with a depth video
        return depths[enriched]
    return next(iter(depths.values())) if len(depths) == 1 and len(select_colour_keys(meta)) == 1 else None


def find_origin_feature(meta: LeRobotMeta, camera: str, depth: LeRobotFeature) -> LeRobotFeature | None:
    """The map of codes.Source that ``dhtorch enrich`` wrote beside its depth; None for depth of another writer."""
    origin = meta.features.get(f"{camera}_dhtorch_source")
    return origin if origin is not None and "quantiser_step_m" in depth.info and origin.hw == depth.hw else None


def _distinctive_words(key: str) -> frozenset[str]:
    """The words of a key without those that name the kind of image (rgb, depth, images, …)."""
    kinds = {"observation", "images", "image", "depth", "depths", "rgb", "color", "colour", ""}
    return frozenset(re.split(r"[._\-]", key.lower())) - kinds


def dequantise_depth(feature: LeRobotFeature, codes: np.ndarray, file: Path) -> np.ndarray:
    """12-bit codes (h, w) → depth in m, 0 = no return.

    Raises:
        FormatError: codes of more bits, or an invalid range in the feature's info.
    """
    files.refuse_if(
        codes.dtype != np.uint16 or codes.max(initial=0) >= N_CODES,
        file,
        f"{feature.key} pixels",
        f"{codes.dtype} up to {codes.max(initial=0)}",
        "12-bit codes",
    )
    metres = metres_by_code(feature.info, feature.key, file)
    low, high = find_return_range(feature.info, feature.key, file)
    return np.where((metres > low) & (metres <= high), metres, 0.0)[codes]


def decode_depth_picture(data: bytes, file: Path, hw: tuple[int, int]) -> np.ndarray:
    """TIFF or 16-bit PNG → numbers (h, w) as stored.

    Raises:
        FormatError: another format or size.
    """
    if data[:2] in (b"II", b"MM"):
        return decode_tiff(data, file, hw)
    return files.decode_depth_png(data, file, 1.0, hw).astype(np.uint16)
