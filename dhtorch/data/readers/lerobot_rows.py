"""Rows of LeRobot tables: those of an episode with frame numbers and times, encoded images, and frames of videos."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from dhtorch.data.clocks import format_numbers, nearest_stamps
from dhtorch.data.codecs.parquet import read_cell, read_columns
from dhtorch.data.codecs.video import read_video_times
from dhtorch.data.io import decode as files
from dhtorch.data.readers.lerobot_meta import LeRobotEpisode, LeRobotMeta
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
    cell = read_cell(table, key, row)
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
