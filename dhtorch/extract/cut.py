"""Part of a data set: the first frames of each recording, or some of the recordings; opened when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import overload

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene


@dataclass(frozen=True, eq=False)
class Cut(Sequence[Scene]):
    """Scenes with so many frames each at most."""

    scenes: Sequence[Scene]
    frames: int

    def __len__(self) -> int:
        return len(self.scenes)

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scene]: ...
    def __getitem__(self, index: int | slice) -> Scene | list[Scene]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        scene = self.scenes[index]
        return replace(scene, recording=shorter(scene.recording, self.frames))


@dataclass(frozen=True, eq=False)
class Chosen(Sequence[Recording]):
    """The recordings of some scenes."""

    scenes: Sequence[Scene]
    places: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.places)

    @overload
    def __getitem__(self, index: int) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> list[Recording]: ...
    def __getitem__(self, index: int | slice) -> Recording | list[Recording]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        return self.scenes[self.places[index]].recording


def cut(scenes: Sequence[Scene], frames: int | None) -> Sequence[Scene]:
    """The scenes with their first frames alone; None = all."""
    return scenes if frames is None else Cut(scenes, frames)


def shorter(recording: Recording, frames: int) -> Recording:
    """The first frames of a recording."""
    times, poses = recording.times, recording.poses
    return replace(
        recording,
        number=recording.number[:frames],
        times=None if times is None else times[:frames],
        poses=None if poses is None else poses[:frames],
    )
