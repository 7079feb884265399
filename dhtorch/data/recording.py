"""Recording: a lazy sequence of the frames of one camera through one scene; a frame is decoded on access.

Opening a recording reads names, headers and text tables; only ``recording[i]`` decodes pixels. Large sets therefore
open quickly and stream at constant memory, also from data-loader workers (recordings are picklable).
"""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, TypeVar, overload

import torch
from torch import Tensor

from dhtorch.data.stored_sizes import StoredSizes, check_orientation
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.no_depth import clear_no_depth
from dhtorch.records import Frame, Pose
from dhtorch.runtime.console import format_count
from dhtorch.runtime.numerics import standard_numerics
from dhtorch.runtime.safe_open import record_opened_files, restrict_links

_Item = TypeVar("_Item")


@dataclass(frozen=True, eq=False)
class Recording(Sequence[Frame]):
    """A lazy sequence of frames (B = 1) of one scene.

    A reader must set ``name``, ``format``, ``load``, which decodes image, depth and cameras of position ``i``, and
    ``number``, the place of every frame in the capture: skipped frames leave a gap in the numbers, so that pairs do not
    shift. It may set ``root``, ``times``, ``poses`` with their ``pose_axes``, ``rate_hz``, ``sparse``, ``episode``,
    ``camera_name``, ``depth_unit`` and ``report``, where the capture contains them; the recording adds time, pose and
    ``sparse`` to its frames. Notes of a benchmark are not part of a recording: see :class:`dhtorch.data.scene.Scene`.

    Raises:
        ValueError: no frame, or fields of unequal length.
    """

    name: str  # of the scene, for tables and figures
    format: str  # name of the reader
    load: Callable[[int], Frame]  # picklable; position → frame without time and pose
    number: Tensor  # (n,) int64, strictly increasing frame numbers of the capture
    root: Path | None = None  # opened folder or file; None = not from disk
    times: Tensor | None = None  # (n,) s, float64
    poses: Pose | None = None  # (n) T_world_from_cam, float64
    pose_axes: str = "cv"  # camera axes of the capture's trajectory, cv or gl; ``poses`` are always cv
    rate_hz: float | None = None  # nominal frame rate
    sparse: bool = False  # depth is a projected LiDAR sweep: mostly empty between returns
    episode: int | None = None  # its number in the data set, where episodes have one
    report: tuple[str, ...] = ()  # what was left out or guessed, and why
    camera_name: str | None = None  # the data set's name of the camera, where an episode has several
    depth_unit: DepthUnit | None = None  # of the stored depth; None = the format defines metres
    stored: StoredSizes | None = None  # sizes and stated turn of the files, if not yet applied (orient_recording)
    bounds: Path | None = None  # symbolic links must not point outside it; None = no restriction

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
                raise ValueError(
                    f"recording {self.name}: found {length} {what}, expected one for each of {format_count(n, 'frame')}"
                )
        if not bool((self.number.diff() > 0).all()):
            raise ValueError(f"recording {self.name}: number must increase strictly from frame to frame")

    def __len__(self) -> int:
        return self.number.shape[0]

    @standard_numerics
    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]  # one frame at a time: slices would decode
        i = self._position(index)
        with restrict_links(self.bounds):
            frame = self.load(i)
        if frame.depth_camera is None:
            check_orientation(self.root or self.name, (frame.depth.shape[-2], frame.depth.shape[-1]), frame.hw)
        return frame.replace(
            depth=clear_no_depth(frame.depth),
            time=None if self.times is None else self.times[i : i + 1],
            T_world_from_cam=None if self.poses is None else self.poses[i : i + 1],
            sparse=torch.tensor([True]) if self.sparse else frame.sparse,
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.format}, {format_count(len(self), 'frame')})"

    def _position(self, index: int) -> int:
        i, n = operator.index(index), len(self)
        if not -n <= i < n:
            raise IndexError(f"recording {self.name}: frame {i} of {n}")
        return i % n


@dataclass(frozen=True, eq=False, repr=False)
class TruthRecording(Recording):
    """A recording with ground truth that is independent of its own depth sensor."""

    surfaces: ClassVar[dict[int, str]] = {0: "ordinary"}  # values of ``truth(i)["surface"]``
    odd_surfaces: ClassVar[tuple[str, ...]] = ()  # where triangulation correctly differs from the surface's depth

    def truth(self, index: int) -> dict[str, Tensor]:
        """True depth and surface kind at the centre of every image pixel of frame ``index``, where available.

        Returns:
            ``depth`` (1, H, W) m float32, 0 where unknown; ``surface`` (1, H, W) uint8, a key of ``surfaces``; where an
            instrument measured the truth also ``disagreement`` (1,), its median relative difference from the frame's
            own sensor.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredRecording(TruthRecording):
    """A recording with true depth measured by a second, more accurate instrument."""

    load_truth: Callable[[int], tuple[Tensor, float]] = field(kw_only=True)  # position → depth (H, W), disagreement

    def truth(self, index: int) -> dict[str, Tensor]:
        """As :meth:`TruthRecording.truth`, where it was measured.

        Returns:
            ``surface`` is all 0: kinds of surface are not distinguished. ``disagreement`` is over pixels where both
            instruments have depth, NaN where they share none. A truth rejected for its disagreement is 0 everywhere.
        """
        with restrict_links(self.bounds):
            depth, disagreement = self.load_truth(self._position(index))
        surface = torch.zeros(1, *depth.shape, dtype=torch.uint8)
        return {"depth": depth[None], "surface": surface, "disagreement": torch.tensor([disagreement])}


class LazySequence(Sequence[_Item]):
    """A sequence whose items are created on access; subclasses define ``__len__`` and :meth:`made`."""

    def load_item(self, place: int) -> _Item:
        """Create the item at ``place``, counted from 0."""
        raise NotImplementedError

    @overload
    def __getitem__(self, index: int) -> _Item: ...
    @overload
    def __getitem__(self, index: slice) -> list[_Item]: ...
    def __getitem__(self, index: int | slice) -> _Item | list[_Item]:
        places = range(len(self))
        if isinstance(index, slice):
            return [self.load_item(place) for place in places[index]]
        return self.load_item(places[index])


@dataclass(frozen=True, eq=False)
class Recordings(LazySequence[Recording]):
    """Many recordings of one data set, each opened on access.

    A set of robot episodes has tens of thousands of recordings, each with tables of its own, and a folder of archives
    hundreds of gigabytes: opening all takes minutes, listing them does not. Nothing is cached: each access opens the
    recording again. Errors of a recording are raised when it is opened.
    """

    names: Sequence[str]  # of the recordings
    make: Callable[[int], Recording]  # picklable; position → recording of that name

    def __len__(self) -> int:
        return len(self.names)

    def load_item(self, place: int) -> Recording:
        """Open the recording at ``place``."""
        return self.make(place)

    def __repr__(self) -> str:
        return f"Recordings({len(self)}, {self.names[0]!r} …)"


def consecutive_frame_numbers(n: int) -> Tensor:
    """(n,) int64 0, 1, 2, …: the frame numbers of a capture without gaps."""
    return torch.arange(n, dtype=torch.int64)


def picture_names(recording: Recording) -> list[str] | None:
    """File names of the frames' pictures; None where frames are no picture files of their own."""
    names = []
    for i in range(len(recording)):
        with record_opened_files() as opened:
            _ = recording[i].image
        pictures = [f for f in opened if f.suffix.lower() in (".png", ".jpg", ".jpeg")]
        pictures = [f for f in pictures if not any(word in f.parent.name for word in ("depth", "conf"))]
        if len(pictures) != 1:
            return None
        names.append(pictures[0].name)
    return names
