"""Association of streams with different time stamps: nearest stamps, interpolated poses, films beside rows of tables.

Values are never carried over from an earlier instant: a time without a stamp within the limit has index −1.
Alphabet: ``times`` (n,) s, query times; ``others`` (m,) s, stamps of the other stream, sorted, at least one.
"""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dhtorch.data.convert import slerp

#: Largest distance of a picture from its row, in steps of the rows' clock. Source: derived: half a step separates two
#: rows; less, because the film's stamps jitter.
_MAX_PAIR_STEPS = 0.4
#: Starts of a film that are tried, in rows or pictures beyond the difference of their counts; and their largest count.
#: Source: chosen: both streams may lack a few at their start.
_MORE_STARTS, _MAX_STARTS = 2, 32
#: Mean distances up to this factor and this many steps above the least one count as equal. Source: chosen: above the
#: rounding of stamps to milliseconds.
_EQUAL_FIT_FACTOR, _EQUAL_FIT_STEPS = 1.5, 0.03

#: Frame rates in Hz that are plausible without a nominal one. Source: chosen: time-lapse to high-speed cameras.
_PLAUSIBLE_HZ = (0.2, 1000.0)
#: Largest ratio of a measured rate and a nominal one, and of a rate in another unit, either way. Source: chosen: no
#: recorder is much faster than its sensor; slower ones keep one frame of several, which only a unit explains otherwise.
_MAX_FASTER = 3.0
#: Unit of time stamps and its seconds.
_STAMP_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


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


@dataclass(frozen=True, eq=False)
class FilmPairing:
    """Pictures of a film paired with the rows of a table."""

    picture: np.ndarray  # (n,) index of the picture of each row; −1 = none
    speed: float = 1.0  # seconds of the table's clock in one of the film's
    by_stamps: bool = False  # else by their places


def pair_film(pictures: np.ndarray, rows: np.ndarray) -> list[FilmPairing]:
    """Stamps (m,) of a film and (n,) of table rows, s → the pairings that fit best, the earliest start first.

    The two clocks differ by a constant, and by a factor where a writer gave the film a nominal rate. As many pictures
    as rows are paired by their places, unless the film has gaps where the table has none. Otherwise gaps and the length
    of the film decide. Several pairings fit equally where the film has a constant rate and is shorter than the table:
    its stamps do not show where pictures were lost.
    """
    n, m = len(rows), len(pictures)
    if not (min(n, m) > 1 and _is_increasing(pictures) and _is_increasing(rows)):
        return _pair_by_place(n, m)
    step, film_step = float(np.median(np.diff(rows))), float(np.median(np.diff(pictures)))
    speeds = dict.fromkeys((1.0, step / film_step))
    # Relative deviation of a film's steps from their median up to which its rate counts as constant. Source: derived:
    # the clock of Matroska (1 ms) rounds steps of 60 Hz by 6 %, and a lost picture doubles a step.
    constant = bool((np.abs(np.diff(pictures) / film_step - 1) <= 0.25).all())
    # Distance in steps of a row from the picture of its place, beyond which films with as many pictures as rows, but
    # with gaps where the table has none, are paired by stamps. Source: derived: one step less jitter.
    if n == m and (constant or min(_place_error(pictures, rows, speed) for speed in speeds) <= 0.75 * step):
        return _pair_by_place(n, m)
    fits = [_Fit.of(pictures, rows, speed, start) for speed in speeds for start in _starts(n, m)]
    # Largest mean distance of a pairing by stamps, in steps. Source: derived: that of arbitrary stamps is half of
    # ``_MAX_PAIR_STEPS``.
    fits = [fit for fit in fits if fit.error <= 0.15]
    most = max((fit.count for fit in fits), default=0)
    # Least share of pictures (or rows, where these are fewer) that a pairing by stamps must cover. Source: chosen.
    if most < min(n, m) * (1 if constant else 0.6):
        return _pair_by_place(n, m)
    best = min((fit for fit in fits if fit.count == most), key=lambda fit: (fit.speed != 1, fit.error))
    limit = max(_EQUAL_FIT_FACTOR * best.error, best.error + _EQUAL_FIT_STEPS)
    equal = [fit for fit in fits if (fit.count, fit.speed) == (most, best.speed) and fit.error <= limit]
    first = min(equal, key=lambda fit: abs(fit.start))
    # Rows between two pictures of a slower film, or pictures between two rows, are no losses: the first is paired.
    ratio = best.speed * film_step / step
    others = [fit for fit in equal if abs(fit.start - first.start) > max(ratio, 1 / ratio) - 0.5]
    return [FilmPairing(fit.picture, fit.speed, by_stamps=True) for fit in (first, *others)]


def format_numbers(numbers: Sequence[int], word: str) -> str:
    """``row 4``, ``rows 4, 5, 6``, ``rows 4 to 40, 50``: numbers as text, at most six ranges."""
    groups: list[list[int]] = []
    for number in numbers:
        if groups and number == groups[-1][-1] + 1:
            groups[-1].append(number)
        else:
            groups.append([number])
    parts = [
        part for group in groups for part in ([f"{group[0]} to {group[-1]}"] if len(group) > 3 else map(str, group))
    ]
    more = f" and {len(parts) - 6} more" if len(parts) > 6 else ""
    return f"{word}{'s' * (len(numbers) > 1)} {', '.join(parts[:6])}{more}"


def describe_rate(times: np.ndarray, nominal_hz: float | None) -> str | None:
    """Remark on time stamps (n,) in s whose rate is not plausible, or far from the nominal one; None if it is."""
    steps = np.diff(times)
    if not len(steps) or not np.median(steps) > 0:
        return None
    rate = 1 / float(np.median(steps))
    low, high = _PLAUSIBLE_HZ if nominal_hz is None else (nominal_hz / _MAX_FASTER, nominal_hz * _MAX_FASTER)
    units = [unit for unit, seconds in _STAMP_UNITS.items() if low <= rate / seconds <= high]
    if low <= rate <= high or (rate < low and nominal_hz is not None and not units):
        return None
    likely = f"likely in {units[0]}" if units else "not in seconds, or damaged"
    nominal = "" if nominal_hz is None else f", {nominal_hz:g} Hz nominal"
    return f"time stamps are {likely}: frames follow at {rate:,.4g} Hz{nominal}"


@dataclass(frozen=True, eq=False)
class _Fit:
    """A film that starts at a row (or, negative, at a picture), followed through the rows."""

    start: int
    speed: float
    picture: np.ndarray  # (n,)
    count: int  # of pairs
    error: float  # mean distance of the pairs, steps

    @classmethod
    def of(cls, pictures: np.ndarray, rows: np.ndarray, speed: float, start: int) -> "_Fit":
        """Each picture's nearest later row within ``_MAX_PAIR_STEPS``, the offset of the clocks following slowly."""
        step, stamps = float(np.median(np.diff(rows))), rows.tolist()
        offset = stamps[max(start, 0)] - speed * float(pictures[max(-start, 0)])
        picture, last, distances = np.full(len(rows), -1), -1, []
        for j, stamp in enumerate(pictures.tolist()[max(-start, 0) :], max(-start, 0)):
            time = speed * stamp + offset
            i = min(max(bisect.bisect_left(stamps, time), 1), len(stamps) - 1)
            i = i - 1 if time - stamps[i - 1] <= stamps[i] - time else i
            distance = stamps[i] - time
            if i > last and abs(distance) <= _MAX_PAIR_STEPS * step:
                picture[i], last = j, i
                distances.append(abs(distance) / step)
                # Share of a picture's distance by which the offset between the clocks follows it: compensates clocks of
                # slightly different speed, but not the jitter of single stamps. Source: chosen: a drift of 0.1 step per
                # picture is followed.
                offset += 0.2 * distance
        return cls(start, speed, picture, len(distances), float(np.mean(distances)) if distances else np.inf)


def _pair_by_place(n: int, m: int) -> list[FilmPairing]:
    """Pairing by place: first with first, and last with last where the numbers differ."""
    places = np.arange(n)
    starts = [0] if n == m else [0, m - n]
    return [FilmPairing(np.where((places + s >= 0) & (places + s < m), places + s, -1)) for s in starts]


def _starts(n: int, m: int) -> range:
    """Rows (or, negative, pictures) at which a film may start."""
    rows, pictures = (min(max(d, 0) + _MORE_STARTS, _MAX_STARTS, k - 1) for d, k in ((n - m, n), (m - n, m)))
    return range(-pictures, rows + 1)


def _place_error(pictures: np.ndarray, rows: np.ndarray, speed: float) -> float:
    """Largest distance in s of a row from the picture of its place, under the best constant offset."""
    difference = rows - speed * pictures
    return float(np.abs(difference - np.median(difference)).max())


def _is_increasing(stamps: np.ndarray) -> bool:
    return bool(np.isfinite(stamps).all() and (np.diff(stamps) > 0).all())


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
