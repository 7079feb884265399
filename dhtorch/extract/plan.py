"""Rows of an extraction and their shards, planned before any pixel is decoded, the same on every machine."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

from dhtorch.data.pairs import by_choice, spaced_frames
from dhtorch.data.scene import Scene


@dataclass(frozen=True)
class ShardSpec:
    """A shard: consecutive rows, and the file that holds them."""

    number: int
    of: int
    rows: range  # positions in the plan

    @property
    def name(self) -> str:
        """Name of the file; sorting by name sorts by row."""
        return f"shard-{self.number:05d}.parquet"


@dataclass(frozen=True)
class ExtractionPlan:
    """Order of all frames of a data set, by episode and then by frame."""

    order: tuple[int, ...]  # index of each recording in the data set
    episodes: tuple[int, ...]  # episode number of each recording, ascending
    ends: tuple[int, ...]  # position after the last frame of each recording
    roots: Mapping[Path, Path | None]  # folders and files of the recordings, with their ``bounds``

    def __len__(self) -> int:
        return self.ends[-1]

    def place(self, position: int) -> tuple[int, int, int]:
        """Position -> (index of the recording in the data set, number of its episode, frame in the recording)."""
        k = bisect_right(self.ends, position)
        return self.order[k], self.episodes[k], position - (self.ends[k - 1] if k else 0)

    def beside(self, k: int) -> list[int]:
        """Index of a recording in the data set -> indices of the other recordings of its episode."""
        number = self.episodes[self.order.index(k)]
        return [other for other, its in zip(self.order, self.episodes, strict=True) if its == number and other != k]

    @property
    def spans(self) -> list[range]:
        """The positions of each recording, in order."""
        return [range(a, b) for a, b in pairwise((0, *self.ends))]

    def shards(self, rows: int, *, apart: bool = False) -> list[ShardSpec]:
        """Shards of ``rows`` rows each, the last may be shorter. ``apart``: no shard has rows of two recordings."""
        spans = self.spans if apart else [range(len(self))]
        parts = [span[i : i + rows] for span in spans for i in range(0, len(span), rows)]
        return [ShardSpec(k, len(parts), part) for k, part in enumerate(parts)]


#: Value of ``gap`` for view selection among past frames.
AUTO_GAP = "auto"


def candidates_by_frame(scene: Scene, past: bool = True) -> dict[int, tuple[int, ...]]:
    """Scene -> frame → candidates of view selection; ``past``: only earlier frames, none for the first frame."""
    if len(scene.recording) < 2:
        return {}
    return {pair.reference: pair.candidates for pair in by_choice(scene, stride=1, past=past)}


def view_offsets(scene: Scene, gap: int | None, views: int) -> list[int]:
    """Gap and number of source views -> offsets in frames back from the reference, the farthest last; gap 0 = none.

    Raises:
        ValueError: no gap in the options or the scene, or fewer frames in the gap than views.
    """
    gap = scene.gap if gap is None else gap
    if gap is None:
        raise ValueError(
            f"extract.gap: {scene.name} has no gap of its own, expected a number of frames; 0 = front end only"
        )
    return spaced_frames(0, gap, views) if gap else []


def make_plan(scenes: Sequence[Scene], gap: int | str | None, views: int, *, rigs: bool = False) -> ExtractionPlan:
    """Scenes -> plan of all their frames; opens each recording once to read its length.

    Args:
        scenes: of the data set.
        gap, views: see :func:`view_offsets`; a gap of :data:`AUTO_GAP` suits all.
        rigs: an episode may have several cameras, whose recordings follow one another in the order of ``scenes``.

    Raises:
        ValueError: two recordings of one episode without ``rigs``, or no gap.
        FormatError: a recording that cannot be opened.
    """
    recordings: dict[tuple[int, int], tuple[int, str, int]] = {}
    cameras: Counter[int] = Counter()
    rig_episodes: dict[str, int] = {}
    roots: dict[Path, Path | None] = {}
    for k, scene in enumerate(scenes):
        recording = scene.recording
        if not isinstance(gap, str):
            view_offsets(scene, gap, views)
        number = recording.episode
        if number is None and rigs and recording.camera_name is not None:  # several cameras, no episodes
            number = rig_episodes.setdefault(recording.name.rpartition("/")[0], k)
        number = k if number is None else number
        if cameras[number] and not rigs:
            names = f"{recordings[number, 0][1]} and {recording.name}"
            raise ValueError(f"data: {names} are one episode, expected one camera of it (data.camera=KEY)")
        recordings[number, cameras[number]] = (k, recording.name, len(recording))
        cameras[number] += 1
        if recording.root is not None:
            roots[recording.root] = recording.bounds
    keys = sorted(recordings)
    order, _, lengths = zip(*(recordings[key] for key in keys), strict=True)
    return ExtractionPlan(order, tuple(number for number, _ in keys), tuple(accumulate(lengths)), roots)
