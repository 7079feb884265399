"""Films beside rows of tables: pairing by stamps and places, and rates that are not plausible."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from dhtorch import data
from dhtorch.data import corrections
from dhtorch.data.clocks import describe_rate, format_numbers, interpolate_poses, pair_film, pair_stamps
from dhtorch.synthetic import SyntheticRoom

ROWS = np.arange(12) / 30
LOST = [4, 5, 6]
GAP = [0, 1, 2, 3, -1, -1, -1, 4, 5, 6, 7, 8]


def paired(pictures: Sequence[float] | np.ndarray, rows: Sequence[float] | np.ndarray = ROWS) -> list[list[int]]:
    return [pairing.picture.tolist() for pairing in pair_film(np.array(pictures), np.array(rows))]


NOISE = np.random.default_rng(0)
PAUSED = [0, 1 / 15, 2 / 15, 1.2, 1.2 + 1 / 15, 1.2 + 2 / 15]
#: Stamps of a film, those of the rows, and all pairings.
PAIRED = [
    *(
        (np.delete(np.arange(12) / rate, LOST), ROWS + start, [GAP])  # gaps of a film show which rows have no image
        for rate in (30.0, 60.0, 24.0, 0.03)
        for start in (0.0, 86400.5)
    ),
    # A film of a fraction or a multiple of the rate is paired by its length.
    (ROWS[::2], ROWS, [[0, -1, 1, -1, 2, -1, 3, -1, 4, -1, 5, -1]]),
    (ROWS[::3], ROWS, [[0, -1, -1, 1, -1, -1, 2, -1, -1, 3, -1, -1]]),
    (np.arange(24) / 60, ROWS, [list(range(0, 24, 2))]),
    # As many images as rows are paired by their places, unless there are gaps elsewhere.
    *(
        (film, ROWS, [list(range(12))])
        for film in (
            ROWS, np.arange(12) / 60, ROWS + 0.01 * np.sin(np.arange(12)), np.sort(NOISE.uniform(0, 0.4, 12)),
            np.zeros(12), np.full(12, np.nan),
        )
    ),
    (np.delete(ROWS, [8, 9]), np.delete(ROWS, [3, 4]), [[0, 1, 2, 5, 6, 7, -1, -1, 8, 9]]),
    (np.arange(6) / 60, PAUSED, [list(range(6))]),  # a pause of the table does not shift a film that counts on
    ([0, 0, 0], [0, 0, 0, 0, 0], [[0, 1, 2, -1, -1], [-1, -1, 0, 1, 2]]),  # the first or the last are lost
]  # fmt: skip


@pytest.mark.parametrize(("film", "rows", "pairings"), PAIRED)
def test_images_of_a_film_are_paired_with_rows(film: np.ndarray, rows: np.ndarray, pairings: list[list[int]]) -> None:
    assert paired(film, rows) == pairings


def test_a_short_film_of_constant_rate_may_start_at_any_row() -> None:
    candidates = paired(ROWS[:9])
    assert candidates[0] == [*range(9), -1, -1, -1] and candidates[-1] == [-1, -1, -1, *range(9)]
    assert len(paired(ROWS[:6])) == 7  # a nominal rate and the first half, or the whole at half the rate: not known
    assert len(paired(np.delete(ROWS, [4, 5, 11]))) == 2  # a gap and a lost end
    for n, m in ((4, 3), (3, 4), (2, 12), (12, 2)):
        assert all(len(each) == n and max(each) < m for each in paired(ROWS[:m] * 1.3, ROWS[:n]))


@pytest.mark.parametrize("jitter", [0.0, 0.001])
@pytest.mark.parametrize("drift", [1.0, 1.001])
def test_clocks_may_drift_and_jitter(jitter: float, drift: float) -> None:
    rows = np.arange(2000) / 60
    kept = np.delete(np.arange(2000), [500, 501, 1400])
    film = drift * rows[kept] + np.random.default_rng(1).uniform(-jitter, jitter, len(kept))
    (pairing,) = paired(film, rows)
    found = np.array(pairing)
    assert (found[kept] == np.arange(len(kept))).mean() > 0.99
    assert (found[[500, 501, 1400]] == -1).all()


@pytest.mark.parametrize(
    ("step", "nominal", "remark"),
    [
        (1 / 30, None, None),
        (1 / 30, 60.0, None),
        (1 / 3, 30.0, None),  # one frame of ten
        (33.3, None, "milliseconds"),
        (33.3e3, 30.0, "microseconds"),
        (33.3e6, None, "nanoseconds"),
        (1 / 5230, None, "5,230 Hz"),
        (1 / 240, 30.0, "240 Hz, 30 Hz nominal"),
    ],
)
def test_rates_that_are_not_plausible(step: float, nominal: float | None, remark: str | None) -> None:
    described = describe_rate(np.arange(20) * step, nominal)
    assert (described is None) if remark is None else (described is not None and remark in described)


def test_every_recording_reports_its_rate() -> None:
    room = SyntheticRoom(n_frames=4, hw=(24, 32))
    sound = data.Recording("room", "none", room.load, room.number, times=room.times, rate_hz=room.rate_hz)
    assert corrections.Corrections().apply(sound).report == ()
    wrong = corrections.Corrections().apply(replace(sound, times=1000 * torch.arange(4).double() / 30, rate_hz=None))
    assert wrong.report[-1] == "time stamps are likely in milliseconds: frames follow at 0.03 Hz"


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([0], "row 0"),
        ([4, 5, 6], "rows 4, 5, 6"),
        ([1, 3, 4, 5, 6, 9], "rows 1, 3 to 6, 9"),
        (range(1, 21, 2), "rows 1, 3, 5, 7, 9, 11 and 4 more"),
    ],
)
def test_numbers_as_text(numbers: Sequence[int], text: str) -> None:
    assert format_numbers(numbers, "row") == text


def turned(degrees: Sequence[float]) -> np.ndarray:
    """Unit quaternions (x, y, z, w) of turns about y."""
    half = np.radians(np.array(degrees)) / 2
    return np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], 1)


def test_poses_between_stamps_are_interpolated_and_others_are_the_nearest() -> None:
    stamps = np.array([0.0, 1.0, 5.0])
    centres = np.array([[0.0, 0, 0], [2.0, 4, 0], [9.0, 9, 9]])
    times = np.array([0.25, 1.0, 2.9, 4.9, 5.05, -0.05, 9.0])
    limits = {"same": 1e-6, "max_difference": 0.2, "max_gap": 1.5}
    q, t, covered = interpolate_poses(times, stamps, turned([0, 40, 90]), centres, **limits)
    assert covered.tolist() == [True, True, False, True, True, True, False], "a gap of 4 s is not bridged"
    expected = turned([10, 40, 90, 90, 0])
    kept = covered.nonzero()[0]
    assert np.allclose(q[kept], expected) and np.allclose(
        t[kept], [[0.5, 1, 0], [2, 4, 0], *[[9, 9, 9]] * 2, [0, 0, 0]]
    )
    flipped = turned([0, 40, 90]) * [[1], [-1], [1]]  # the same rotations
    again, _, _ = interpolate_poses(times[:1], stamps, flipped, centres, **limits)
    assert np.allclose(np.abs((again * q[:1]).sum(-1)), 1)
    _, _, alone = interpolate_poses(times, stamps, turned([0, 40, 90]), centres, **{**limits, "max_gap": 0.0})
    assert alone.tolist() == [False, True, False, True, True, True, False]


def test_stamps_are_paired_within_half_a_step() -> None:
    pictures = np.arange(4) * 0.1
    near, far = (pair_stamps(pictures, pictures + shift).tolist() for shift in (0.03, 0.045))
    assert near == far == [[k, k] for k in range(4)]
    assert pair_stamps(pictures, pictures + 0.06).tolist() == [[k + 1, k] for k in range(3)], "the next one is nearer"
