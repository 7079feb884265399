"""Subsets of a data set, opened lazily: the first frames of each recording, or selected recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from dhtorch.data.recording import LazySequence, Recording
from dhtorch.data.scene import Scene


@dataclass(frozen=True, eq=False)
class TruncatedScenes(LazySequence[Scene]):
    """Scenes of at most ``frames`` frames each."""

    scenes: Sequence[Scene]
    frames: int

    def __len__(self) -> int:
        return len(self.scenes)

    def load_item(self, place: int) -> Scene:
        """Truncated scene at an index."""
        scene = self.scenes[place]
        return replace(scene, recording=truncate_recording(scene.recording, self.frames))


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


def truncate_scenes(scenes: Sequence[Scene], frames: int | None) -> Sequence[Scene]:
    """Scenes -> scenes of their first frames; None = all frames."""
    return scenes if frames is None else TruncatedScenes(scenes, frames)


def truncate_recording(recording: Recording, frames: int) -> Recording:
    """Recording -> recording of its first frames."""
    times, poses = recording.times, recording.poses
    kept = {field.name: getattr(recording, field.name) for field in fields(Recording)}  # a subclass has other arguments
    kept |= {"number": recording.number[:frames]}
    kept |= {"times": None if times is None else times[:frames], "poses": None if poses is None else poses[:frames]}
    return Recording(**kept)
