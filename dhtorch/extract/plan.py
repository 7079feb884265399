"""Which rows there are and which shard each belongs to: known before a pixel is decoded, the same on every machine."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

from dhtorch.data.pairs import between, by_choice
from dhtorch.data.scene import Scene


@dataclass(frozen=True)
class Shard:
    """Some rows in a row, and the file that holds them."""

    number: int
    of: int
    rows: range  # positions in the plan

    @property
    def name(self) -> str:
        """Of its file: sorted by name is sorted by row."""
        return f"shard-{self.number:05d}.parquet"


@dataclass(frozen=True)
class Plan:
    """Every frame of a data set, by episode and then by frame."""

    order: tuple[int, ...]  # place of each recording in the data set
    episodes: tuple[int, ...]  # its number, increasing
    ends: tuple[int, ...]  # position behind its last frame
    roots: tuple[Path, ...]  # what was opened

    def __len__(self) -> int:
        return self.ends[-1]

    def place(self, position: int) -> tuple[int, int, int]:
        """(place of the recording, number of its episode, frame in the recording) of a row."""
        k = bisect_right(self.ends, position)
        return self.order[k], self.episodes[k], position - (self.ends[k - 1] if k else 0)

    def shards(self, rows: int) -> list[Shard]:
        """The whole in pieces of so many rows; the last one may be shorter."""
        starts = range(0, len(self), rows)
        return [Shard(k, len(starts), range(i, min(i + rows, len(self)))) for k, i in enumerate(starts)]


#: The ``gap`` with which the method chooses among past frames.
CHOICE = "auto"


def offers(scene: Scene) -> dict[int, tuple[int, ...]]:
    """Frame → the frames before it among which the method chooses; the first has none."""
    if len(scene.recording) < 2:
        return {}
    return {pair.anchor: pair.offered for pair in by_choice(scene, stride=1, past=True)}


def steps_back(scene: Scene, gap: int | None, views: int) -> list[int]:
    """How many frames before a frame its other views are, the farthest last; none with gap 0.

    Raises:
        ValueError: no gap is known, or there are not that many frames between.
    """
    gap = scene.gap if gap is None else gap
    if gap is None:
        raise ValueError(
            f"extract.gap: {scene.name} knows no gap of its own, expected a number of frames; 0 = front end alone"
        )
    return between(0, gap, views) if gap else []


def make(scenes: Sequence[Scene], gap: int | str | None, views: int) -> Plan:
    """The plan of a data set; opens each recording once, for its length.

    Args:
        scenes: of the data set.
        gap, views: see :func:`steps_back`; a gap of :data:`CHOICE` is right for all.

    Raises:
        ValueError: two recordings of one episode, or no gap.
        FormatError: a recording that cannot be opened.
    """
    found: dict[int, tuple[int, str, int]] = {}
    roots: dict[Path, None] = {}
    for k, scene in enumerate(scenes):
        recording = scene.recording
        if not isinstance(gap, str):
            steps_back(scene, gap, views)
        number = recording.episode
        number = k if number is None else number
        if number in found:
            both = f"{found[number][1]} and {recording.name}"
            raise ValueError(f"data: {both} are one episode, expected one camera of it (data.camera=KEY)")
        found[number] = (k, recording.name, len(recording))
        if recording.root is not None:
            roots[recording.root] = None
    episodes = sorted(found)
    lengths = [found[number][2] for number in episodes]
    order = tuple(found[number][0] for number in episodes)
    return Plan(order, tuple(episodes), tuple(accumulate(lengths)), tuple(roots))
