"""Scene: a recording with the notes of a benchmark (near cutoff, gap, pyramid levels, room, role).

A recording holds only what the capture itself contains. The depth from which returns are held out, the step with a
usable baseline, the room and whether the scene enters a mean are decisions of a benchmark, kept in the data settings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from dhtorch.data.recording import LazySequence, Recording, Recordings
from dhtorch.records import TrackHint


@dataclass(frozen=True, eq=False)
class Scene:
    """A recording and a benchmark's notes on it.

    Where a recording has only two frames and no ``gap`` is set, the gap is the step between them.
    """

    recording: Recording
    near: float | None = None  # m, cutoff of a range split
    gap: int | None = None  # frame step that gives a usable baseline
    levels: int | None = None  # pyramid levels that the motion requires
    room: str | None = None  # scenes of one place share one name: they are not independent samples
    role: str | None = None  # "rotation" = almost no baseline, "moving" = near objects move; excluded from means

    def __post_init__(self) -> None:
        if not isinstance(self.recording, Recording):
            raise ValueError(f"data: found {self.recording!r}, expected a recording whose camera moves")
        if self.gap is None and len(self.recording) == 2:
            object.__setattr__(self, "gap", int(self.recording.number[1] - self.recording.number[0]))

    @classmethod
    def of(cls, item: "SceneLike") -> "Scene":
        """The scene itself, or a recording without notes.

        Raises:
            ValueError: neither a scene nor a recording.
        """
        return item if isinstance(item, Scene) else cls(item)

    @property
    def name(self) -> str:
        """Name of the recording, for tables and figures."""
        return self.recording.name

    @property
    def root(self) -> Path | None:
        """Folder or file of the recording; None = not from disk."""
        return self.recording.root

    @property
    def place(self) -> str:
        """The room, or the recording's name where no room is noted."""
        return self.room or self.name

    @property
    def hint(self) -> TrackHint:
        """Hint on the motion for a tracker."""
        return TrackHint(levels=self.levels)


#: Accepted where a scene is expected: a recording is a scene without notes.
SceneLike = Scene | Recording


@dataclass(frozen=True, eq=False)
class Scenes(LazySequence[Scene]):
    """Scenes of one data set with the same notes, each recording opened on access to its scene."""

    recordings: Sequence[Recording]
    annotate: Callable[[Recording], Scene] = Scene  # picklable; recording → scene

    def __len__(self) -> int:
        return len(self.recordings)

    def load_item(self, place: int) -> Scene:
        """The scene at ``place``."""
        return self.annotate(self.recordings[place])

    def __repr__(self) -> str:
        return f"Scenes({self.recordings!r})"


def scenes_of(data: SceneLike | Sequence[SceneLike]) -> Sequence[Scene]:
    """One scene or recording, or a sequence of them → sequence of scenes; lazy where the recordings are.

    Raises:
        ValueError: an item that is neither.
    """
    if isinstance(data, Scenes):
        return data
    if isinstance(data, Recordings):
        return Scenes(data)
    if isinstance(data, Scene | Recording):
        return [Scene.of(data)]
    return [Scene.of(item) for item in (data if isinstance(data, list | tuple) else (data,))]
