"""Streams that tick apart: which entry of another stream belongs to an instant, and the pose in between.

Nothing is taken over from an earlier instant: what has no source view within the limit has none, index −1.
Alphabet: ``times`` (n,) s asked for; ``others`` (m,) s, sorted, at least one.
"""

from __future__ import annotations

import numpy as np

from dhtorch.data.convert import slerp


def nearest_stamps(times: np.ndarray, others: np.ndarray, limit: float) -> np.ndarray:
    """Index (n,) of the stamp in ``others`` nearest to each of ``times``; −1 where none is within ``limit`` s."""
    before, after = _bracketing_stamps(times, others)
    at = np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)
    return np.where(np.abs(others[at] - times) <= limit, at, -1)


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
    """Quaternions (n, 4), centres (n, 3) and whether there is a pose (n,) at ``times``.

    In this order: the pose stamped within ``same`` s; between two poses at most ``max_gap`` s apart, position linear
    and rotation at constant speed; the nearest one within ``max_difference`` s. ``max_gap`` 0 interpolates nothing.
    """
    before, after = _bracketing_stamps(times, others)
    span = others[after] - others[before]
    share = (times - others[before]) / np.where(span > 0, span, 1)
    own = nearest_stamps(times, others, same)
    between = (own < 0) & (share > 0) & (share < 1) & (span > 0) & (span <= max_gap)
    own = np.where(between | (own >= 0), own, nearest_stamps(times, others, max_difference))
    before, after = np.where(between, before, own), np.where(between, after, own)
    share = np.where(between, share, 0.0)
    centre = (1 - share)[:, None] * t[before] + share[:, None] * t[after]
    return slerp(q[before], q[after], share), centre, between | (own >= 0)


def _bracketing_stamps(times: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the stamps before and after; both the same one where there is only one."""
    after = np.searchsorted(others, times).clip(1, max(len(others) - 1, 1)).clip(max=len(others) - 1)
    return (after - 1).clip(0), after
