"""Subsets of a data set, opened lazily: some frames of each recording, or selected recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

from dhtorch.data.recording import LazySequence, Recording
from dhtorch.data.scene import Scene
from dhtorch.records import Frame


@dataclass(frozen=True, eq=False)
class _SubsampledScenes(LazySequence[Scene]):
    """Scenes of every ``every``-th frame, of at most ``max_frames`` frames each."""

    scenes: Sequence[Scene]
    every: int
    max_frames: int | None

    def __len__(self) -> int:
        return len(self.scenes)

    def load_item(self, place: int) -> Scene:
        """Subsampled scene at an index."""
        scene, every = self.scenes[place], self.every
        recording = scene.recording
        part = slice(None, None if self.max_frames is None else every * self.max_frames, every)
        times, poses = recording.times, recording.poses
        kept = {field.name: getattr(recording, field.name) for field in fields(Recording)}  # a subclass has others
        load = recording.load if every == 1 else partial(_load_every, recording.load, every)
        kept |= {"number": recording.number[part], "load": load}
        kept |= {"times": None if times is None else times[part], "poses": None if poses is None else poses[part]}
        return replace(scene, recording=Recording(**kept))


@dataclass(frozen=True, eq=False)
class SelectedRecordings(LazySequence[Recording]):
    """Recordings of the scenes at some indices."""

    scenes: Sequence[Scene]
    places: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.places)

    def load_item(self, place: int) -> Recording:
        """Recording at an index."""
        return self.scenes[self.places[place]].recording


def subsample_scenes(scenes: Sequence[Scene], every: int, max_frames: int | None) -> Sequence[Scene]:
    """Scenes -> scenes of every ``every``-th frame, of the first ``max_frames`` of these; None = all."""
    return scenes if every == 1 and max_frames is None else _SubsampledScenes(scenes, every, max_frames)


def _load_every(load: Callable[[int], Frame], every: int, position: int) -> Frame:
    """Frame at ``every`` times the position."""
    return load(position * every)
