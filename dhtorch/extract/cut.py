"""Part of a data set: the first frames of each recording, or some of the recordings; opened when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dhtorch.data.recording import LazySequence, Recording
from dhtorch.data.scene import Scene


@dataclass(frozen=True, eq=False)
class TruncatedScenes(LazySequence[Scene]):
    """Scenes with so many frames each at most."""

    scenes: Sequence[Scene]
    frames: int

    def __len__(self) -> int:
        return len(self.scenes)

    def made(self, place: int) -> Scene:
        """The scene there, cut."""
        scene = self.scenes[place]
        return replace(scene, recording=truncate_recording(scene.recording, self.frames))


@dataclass(frozen=True, eq=False)
class SelectedRecordings(LazySequence[Recording]):
    """The recordings of some scenes."""

    scenes: Sequence[Scene]
    places: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.places)

    def made(self, place: int) -> Recording:
        """The recording of the scene there."""
        return self.scenes[self.places[place]].recording


def truncate_scenes(scenes: Sequence[Scene], frames: int | None) -> Sequence[Scene]:
    """The scenes with their first frames alone; None = all."""
    return scenes if frames is None else TruncatedScenes(scenes, frames)


def truncate_recording(recording: Recording, frames: int) -> Recording:
    """The first frames of a recording."""
    times, poses = recording.times, recording.poses
    return replace(
        recording,
        number=recording.number[:frames],
        times=None if times is None else times[:frames],
        poses=None if poses is None else poses[:frames],
    )
