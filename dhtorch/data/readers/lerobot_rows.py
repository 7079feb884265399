"""Rows of a LeRobot table: which belong to an episode, in what order, at what time."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from dhtorch.data.codecs.parquet import read_columns
from dhtorch.data.io import safe_open as doors
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.lerobot_meta import LeRobotEpisode, LeRobotMeta
from dhtorch.runtime.console import format_count

#: s; stamps are float32, and the grid that they were rounded from is exact.
_MAX_GRID_ERROR_S = 1e-4


def read_row_table(file: Path, more: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The columns that place a row, and ``more``, of a whole table; pictures stay where they are.

    The last table stays in memory, since the next episode lies in it as a rule.

    Raises:
        FormatError: a missing or damaged table or column.
    """
    return _read_cached_table(file, doors.modification_time_ns(file), more)


@lru_cache(maxsize=1)
def _read_cached_table(file: Path, _changed: int, more: tuple[str, ...]) -> dict[str, np.ndarray]:
    table: dict[str, np.ndarray] = {}
    places = "timestamp", "frame_index", "episode_index"
    for name, values in read_columns(file, [places[0], *more], optional=places[1:]).items():
        if not isinstance(values, np.ndarray):
            raise FormatError(file, name, "no numbers", "numbers")
        if name in places and values.size != len(values):
            raise FormatError(file, name, f"shape {values.shape}", "one number a row")
        table[name] = values.reshape(-1) if name in places else values
    return table


def select_episode_rows(
    meta: LeRobotMeta, episode: LeRobotEpisode, table: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Rows of the episode, their frame numbers and times (s), and what was left out.

    A table without frame numbers counts its rows. Times that all lie by one shift beside the grid of these numbers
    (a clock that does not begin at 0) are brought back to it: pictures follow the rows, and the shift is reported.

    Raises:
        FormatError: no usable row.
    """
    every = np.full(len(table["timestamp"]), episode.number)
    rows = np.flatnonzero(table.get("episode_index", every) == episode.number)
    stamp = table["timestamp"][rows].astype(np.float64)
    number = table["frame_index"][rows].astype(np.float64) if "frame_index" in table else np.arange(float(len(rows)))
    sound = (number >= 0) & (number < 2**31) & (number == np.floor(number)) & (stamp >= 0) & (stamp < 1e9)  # not NaN
    report = []
    keep = sound & _is_increasing(number, sound) & _is_increasing(stamp, sound)
    if not keep.all():
        report.append(f"episode {episode.number}: {format_count(int((~keep).sum()), 'row')} out of order: left out")
    if episode.length is not None and episode.length != len(rows):
        report.append(
            f"episode {episode.number}: {format_count(len(rows), 'row')}, {episode.length} according to meta/episodes"
        )
    rows, number, stamp = rows[keep], number[keep], stamp[keep]
    if len(rows) == 0:
        raise FormatError(episode.data, f"episode {episode.number}", "no usable row", "frames")
    grid = number / meta.fps
    shift = float(np.median(stamp - grid))
    if abs(shift) > _MAX_GRID_ERROR_S and (np.abs(stamp - grid - shift) < _MAX_GRID_ERROR_S).all():
        report.append(f"episode {episode.number}: times begin at {stamp[0]:.4g} s: pictures taken by the order of rows")
        stamp = grid
    return rows, number.astype(np.int64), np.where(np.abs(grid - stamp) < _MAX_GRID_ERROR_S, grid, stamp), report


def _is_increasing(values: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Which values are larger than every sound one before them."""
    known = np.where(sound, values, -1.0)
    return values > np.maximum.accumulate(np.concatenate(([-1.0], known)))[:-1]
