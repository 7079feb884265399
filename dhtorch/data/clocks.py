"""Association of streams with different time stamps: nearest stamps, and interpolated poses.

Values are never carried over from an earlier instant: a time without a stamp within the limit has index −1.
Alphabet: ``times`` (n,) s, query times; ``others`` (m,) s, stamps of the other stream, sorted, at least one.
"""

from __future__ import annotations

import numpy as np

from dhtorch.data.convert import slerp


def nearest_stamps(times: np.ndarray, others: np.ndarray, limit: float) -> np.ndarray:
    """Index (n,) of the stamp in ``others`` nearest to each of ``times``; −1 where none is within ``limit`` s."""
    before, after = _bracketing_stamps(times, others)
    nearest = np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)
    return np.where(np.abs(others[nearest] - times) <= limit, nearest, -1)


def pair_stamps(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of indices of mutually nearest stamps of two streams, in any order, within half the shorter period.

    The period is the median step; where neither stream has two stamps, the limit is half a second. Pairs are sorted by
    the first stream's stamps.
    """
    order, other_order = np.argsort(times, kind="stable"), np.argsort(others, kind="stable")
    a, b = times[order], others[other_order]
    if not (len(a) and len(b)):
        return np.empty((0, 2), np.int64)
    steps = [float(np.median(step)) for step in (np.diff(a), np.diff(b)) if len(step)]
    limit = 0.5 * min([step for step in steps if step > 0], default=1.0)
    nearest, back = nearest_stamps(a, b, limit), nearest_stamps(b, a, limit)
    paired = np.flatnonzero((nearest >= 0) & (back[nearest] == np.arange(len(a))))
    return np.stack((order[paired], other_order[nearest[paired]]), -1)


def interpolate_poses(
    times: np.ndarray,
    others: np.ndarray,  # stamps of the poses
    q: np.ndarray,  # (m, 4) unit quaternions, camera to world
    t: np.ndarray,  # (m, 3) m, camera centres
    *,
    same: float,
    max_difference: float,
    max_gap: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses at ``times``: quaternions (n, 4), centres (n, 3), and the mask (n,) of times with a pose.

    In this order: the pose stamped within ``same`` s; interpolation between two poses at most ``max_gap`` s apart,
    position linear and rotation at constant speed; the nearest pose within ``max_difference`` s. ``max_gap`` = 0: no
    interpolation.
    """
    before, after = _bracketing_stamps(times, others)
    span = others[after] - others[before]
    weight = (times - others[before]) / np.where(span > 0, span, 1)
    nearest = nearest_stamps(times, others, same)
    interpolated = (nearest < 0) & (weight > 0) & (weight < 1) & (span > 0) & (span <= max_gap)
    nearest = np.where(interpolated | (nearest >= 0), nearest, nearest_stamps(times, others, max_difference))
    before, after = np.where(interpolated, before, nearest), np.where(interpolated, after, nearest)
    weight = np.where(interpolated, weight, 0.0)
    centre = (1 - weight)[:, None] * t[before] + weight[:, None] * t[after]
    return slerp(q[before], q[after], weight), centre, interpolated | (nearest >= 0)


def _bracketing_stamps(times: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the stamps before and after each time; equal where there is only one stamp."""
    after = np.searchsorted(others, times).clip(1, max(len(others) - 1, 1)).clip(max=len(others) - 1)
    return (after - 1).clip(0), after
