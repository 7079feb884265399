"""Frames of LeRobot videos paired with the rows of an episode by their time stamps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dhtorch.data.clocks import format_numbers, nearest_stamps
from dhtorch.data.codecs.video import read_video_times
from dhtorch.data.io.decode import FormatError


def find_row_stamps(file: Path, start: float, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(time stamps of a video, times (n,) at which it has the rows of an episode that starts at ``start``), s.

    Raises:
        FormatError: no video, or one without frames.
    """
    stamps = read_video_times(file)
    if len(stamps) == 0:
        raise FormatError(file, "frames", "none", "at least one")
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
        except (FormatError, ImportError):
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
