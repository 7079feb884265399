"""A scene: a recording, and what whoever chose it for a benchmark notes about it.

A recording holds what a capture says of itself. From where on its returns are to be held back, which step gives a
usable baseline, which room it shows and whether it may enter a mean are decisions; they stand beside it, in the
settings of the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from dhtorch.data.recording import LazySequence, Recording, Recordings
from dhtorch.records import TrackHint


@dataclass(frozen=True, eq=False)
class Scene:
    """A recording and a benchmark's notes on it.

    Where a recording has two frames alone and no ``gap`` is said, it is the step between them.
    """

    recording: Recording
    near: float | None = None  # m, the cutoff to use for a range split
    gap: int | None = None  # frame step that gives a usable baseline
    levels: int | None = None  # pyramid levels that the motion asks for
    room: str | None = None  # scenes of one place bear one name: what is learnt on one says little about the others
    role: str | None = None  # "rotation" = almost no baseline, "moving" = what is near moves; never enters a mean

    def __post_init__(self) -> None:
        if not isinstance(self.recording, Recording):
            raise ValueError(f"data: found {self.recording!r}, expected a recording whose camera moves")
        if self.gap is None and len(self.recording) == 2:
            object.__setattr__(self, "gap", int(self.recording.number[1] - self.recording.number[0]))

    @classmethod
    def of(cls, given: SceneLike) -> Scene:
        """The scene itself, or a recording without notes.

        Raises:
            ValueError: neither a scene nor a recording.
        """
        return given if isinstance(given, Scene) else cls(given)

    @property
    def name(self) -> str:
        """Of the recording, for tables and figures."""
        return self.recording.name

    @property
    def root(self) -> Path | None:
        """Folder or file of the recording; None = not from disk."""
        return self.recording.root

    @property
    def place(self) -> str:
        """The room, or the recording's own name where none is noted."""
        return self.room or self.name

    @property
    def hint(self) -> TrackHint:
        """What a tracker is told of the motion."""
        return TrackHint(levels=self.levels)


#: What is asked for a scene; a recording is one without notes.
SceneLike = Scene | Recording


@dataclass(frozen=True, eq=False)
class Scenes(LazySequence[Scene]):
    """Scenes of one data set with the same notes, each recording opened when its scene is asked for."""

    recordings: Sequence[Recording]
    noted: Callable[[Recording], Scene] = Scene  # picklable; recording → scene

    def __len__(self) -> int:
        return len(self.recordings)

    def made(self, place: int) -> Scene:
        """The recording there, noted."""
        return self.noted(self.recordings[place])

    def __repr__(self) -> str:
        return f"Scenes({self.recordings!r})"


def scenes_of(given: SceneLike | Sequence[SceneLike]) -> Sequence[Scene]:
    """One scene or several, given as such or as recordings; lazy where the recordings are.

    Raises:
        ValueError: something that is neither.
    """
    if isinstance(given, Scenes):
        return given
    if isinstance(given, Recordings):
        return Scenes(given)
    if isinstance(given, Scene | Recording):
        return [Scene.of(given)]
    return [Scene.of(each) for each in (given if isinstance(given, list | tuple) else (given,))]
