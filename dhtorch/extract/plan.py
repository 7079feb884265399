"""Which rows there are and which shard each belongs to: known before a pixel is decoded, the same on every machine."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

from dhtorch.data.pairs import by_choice, spaced_frames
from dhtorch.data.scene import Scene


@dataclass(frozen=True)
class ShardSpec:
    """Some rows in a row, and the file that holds them."""

    number: int
    of: int
    rows: range  # positions in the plan

    @property
    def name(self) -> str:
        """Of its file: sorted by name is sorted by row."""
        return f"shard-{self.number:05d}.parquet"


@dataclass(frozen=True)
class ExtractionPlan:
    """Every frame of a data set, by episode and then by frame."""

    order: tuple[int, ...]  # place of each recording in the data set
    episodes: tuple[int, ...]  # its number, never falling
    ends: tuple[int, ...]  # position behind its last frame
    roots: tuple[Path, ...]  # what was opened

    def __len__(self) -> int:
        return self.ends[-1]

    def place(self, position: int) -> tuple[int, int, int]:
        """(place of the recording, number of its episode, frame in the recording) of a row."""
        k = bisect_right(self.ends, position)
        return self.order[k], self.episodes[k], position - (self.ends[k - 1] if k else 0)

    def beside(self, k: int) -> list[int]:
        """Places in the data set of the other recordings of the episode that recording ``k`` belongs to."""
        number = self.episodes[self.order.index(k)]
        return [other for other, its in zip(self.order, self.episodes, strict=True) if its == number and other != k]

    @property
    def spans(self) -> list[range]:
        """The positions of each recording, in order."""
        return [range(a, b) for a, b in pairwise((0, *self.ends))]

    def shards(self, rows: int, *, apart: bool = False) -> list[ShardSpec]:
        """The whole in pieces of so many rows; the last may be shorter. ``apart``: none has rows of two recordings."""
        spans = self.spans if apart else [range(len(self))]
        pieces = [span[i : i + rows] for span in spans for i in range(0, len(span), rows)]
        return [ShardSpec(k, len(pieces), piece) for k, piece in enumerate(pieces)]


#: The ``gap`` with which the method chooses among past frames.
AUTO_GAP = "auto"


def candidates_by_frame(scene: Scene, past: bool = True) -> dict[int, tuple[int, ...]]:
    """Frame → the frames (``past``: before it) among which the method chooses; the first has none before it."""
    if len(scene.recording) < 2:
        return {}
    return {pair.reference: pair.candidates for pair in by_choice(scene, stride=1, past=past)}


def view_offsets(scene: Scene, gap: int | None, views: int) -> list[int]:
    """How many frames before a frame its other views are, the farthest last; none with gap 0.

    Raises:
        ValueError: no gap is known, or there are not that many frames between.
    """
    gap = scene.gap if gap is None else gap
    if gap is None:
        raise ValueError(
            f"extract.gap: {scene.name} knows no gap of its own, expected a number of frames; 0 = front end alone"
        )
    return spaced_frames(0, gap, views) if gap else []


def make_plan(scenes: Sequence[Scene], gap: int | str | None, views: int, *, rigs: bool = False) -> ExtractionPlan:
    """The plan of a data set; opens each recording once, for its length.

    Args:
        scenes: of the data set.
        gap, views: see :func:`view_offsets`; a gap of :data:`AUTO_GAP` is right for all.
        rigs: an episode may have several cameras, whose recordings follow one another by the order of ``scenes``.

    Raises:
        ValueError: two recordings of one episode, or no gap.
        FormatError: a recording that cannot be opened.
    """
    found: dict[tuple[int, int], tuple[int, str, int]] = {}
    cameras: Counter[int] = Counter()
    together: dict[str, int] = {}
    roots: dict[Path, None] = {}
    for k, scene in enumerate(scenes):
        recording = scene.recording
        if not isinstance(gap, str):
            view_offsets(scene, gap, views)
        number = recording.episode
        if number is None and rigs and recording.camera_name is not None:  # several cameras, no episodes
            number = together.setdefault(recording.name.rpartition("/")[0], k)
        number = k if number is None else number
        if cameras[number] and not rigs:
            both = f"{found[number, 0][1]} and {recording.name}"
            raise ValueError(f"data: {both} are one episode, expected one camera of it (data.camera=KEY)")
        found[number, cameras[number]] = (k, recording.name, len(recording))
        cameras[number] += 1
        if recording.root is not None:
            roots[recording.root] = None
    places = sorted(found)
    order, _, lengths = zip(*(found[place] for place in places), strict=True)
    return ExtractionPlan(order, tuple(number for number, _ in places), tuple(accumulate(lengths)), tuple(roots))
