"""A recording: the frames of one camera through one scene, read when asked for.

Opening a recording touches names, headers and text tables; pixels are decoded by ``recording[i]`` alone. So a large
set opens at once and streams at constant memory, also from the workers of a data loader (a recording pickles).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, overload

import torch
from torch import Tensor

from dhtorch.records import Frame, Pose


@dataclass(frozen=True, eq=False)
class Recording(Sequence[Frame]):
    """A lazy sequence of frames (B = 1) of one scene.

    A reader supplies ``load``, which decodes image, depth and cameras of position ``i``; the recording adds what is
    known for the whole sequence (time, pose). ``number`` keeps the place of every frame in the capture: where a frame
    was skipped the numbers have a gap, so that pairs never shift silently.

    Raises:
        ValueError: no frame, or fields of unequal length.
    """

    name: str  # of the scene, for tables and figures
    format: str  # the reader that made it
    load: Callable[[int], Frame]  # picklable; position → frame without time and pose
    number: Tensor  # (n,) int64, strictly increasing place of each frame in the capture
    root: Path | None = None  # folder or file that was opened; None = not from disk
    times: Tensor | None = None  # (n,) s, float64
    poses: Pose | None = None  # (n) T_world_from_cam, float64
    pose_axes: str = "cv"  # axes in which the capture writes its trajectory, cv or gl; ``poses`` are cv in any case
    rate_hz: float | None = None  # nominal frame rate
    sparse: bool = False  # depth is a projected LiDAR sweep: mostly empty between returns
    near: float | None = None  # m, the cutoff to use for a range split on this scene
    gap: int | None = None  # frame step that gives a usable baseline
    levels: int | None = None  # pyramid levels that the motion in this scene asks for
    room: str | None = None  # recordings of one place bear one name: what is learnt on one says little about the others
    role: str | None = None  # "rotation" = almost no baseline: never enters a mean
    episode: int | None = None  # its number in the data set, where episodes have one
    report: tuple[str, ...] = ()  # what was left out, and why

    def __post_init__(self) -> None:
        n = self.number.shape[0]
        if n == 0:
            raise ValueError(f"recording {self.name}: found no frame, expected at least one")
        lengths = {
            "times": n if self.times is None else self.times.shape[0],
            "poses": n if self.poses is None else self.poses.t.shape[0],
        }
        for what, length in lengths.items():
            if length != n:
                raise ValueError(f"recording {self.name}: found {length} {what}, expected one for each of {n} frames")
        if not bool((self.number.diff() > 0).all()):
            raise ValueError(f"recording {self.name}: number must increase strictly from frame to frame")

    def __len__(self) -> int:
        return self.number.shape[0]

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]  # one frame at a time: slices would decode
        i = self._position(index)
        frame = self.load(i)
        return frame.replace(
            time=None if self.times is None else self.times[i : i + 1],
            T_world_from_cam=None if self.poses is None else self.poses[i : i + 1],
            sparse=torch.tensor([True]) if self.sparse else None,
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.format}, {len(self)} frames)"

    def _position(self, index: int) -> int:
        i, n = operator.index(index), len(self)
        if not -n <= i < n:
            raise IndexError(f"recording {self.name}: frame {i} of {n}")
        return i % n


@dataclass(frozen=True, eq=False, repr=False)
class TruthRecording(Recording):
    """A recording that also knows the depth measured by another, better instrument: its own sensor is not its judge."""

    surfaces: ClassVar[dict[int, str]] = {0: "ordinary"}  # values of ``truth(i)["surface"]``
    odd_surfaces: ClassVar[tuple[str, ...]] = ()

    load_truth: Callable[[int], tuple[Tensor, float]] = field(kw_only=True)  # position → depth (H, W), disagreement

    def truth(self, index: int) -> dict[str, Tensor]:
        """What is really there at the centre of every image pixel of frame ``index``, as far as it was measured.

        Returns:
            ``depth`` (1, H, W) m float32, 0 where it is not known; ``surface`` (1, H, W) uint8, all 0: kinds of
            surface are not told apart; ``disagreement`` (1,), median relative difference from the frame's own sensor
            where both answer, NaN where they share no pixel. A truth that was rejected for it is 0 everywhere.
        """
        depth, disagreement = self.load_truth(self._position(index))
        surface = torch.zeros(1, *depth.shape, dtype=torch.uint8)
        return {"depth": depth[None], "surface": surface, "disagreement": torch.tensor([disagreement])}


@dataclass(frozen=True, eq=False)
class Recordings(Sequence[Recording]):
    """Many recordings of one data set, each opened when it is asked for.

    A set of robot episodes holds tens of thousands, with tables of their own, and a folder of archives hundreds of
    gigabytes: opening all takes minutes, listing them does not. Nothing is kept, so asking twice opens twice. What is
    wrong with one shows when that one is opened.
    """

    names: Sequence[str]  # of the recordings
    make: Callable[[int], Recording]  # picklable; position → recording of that name
    kept: dict[str, Any] = field(default_factory=dict)  # fields of every recording that the caller has set

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> list[Recording]: ...
    def __getitem__(self, index: int | slice) -> Recording | list[Recording]:
        places = range(len(self))
        if isinstance(index, slice):
            return [self[i] for i in places[index]]
        return replace(self.make(places[index]), **self.kept)

    def __repr__(self) -> str:
        return f"Recordings({len(self)}, {self.names[0]!r} …)"

    def replaced(self, fields: dict[str, Any]) -> Recordings:
        """The same with some fields set in every recording."""
        return replace(self, kept=self.kept | fields)


def numbers(n: int) -> Tensor:
    """(n,) int64 0, 1, 2, …: the frame numbers of a capture without gaps."""
    return torch.arange(n, dtype=torch.int64)
