"""Rigs: several cameras with common instants joined into one recording, for pairs in space and in time.

Frames are ordered by instant, then by camera, each with its own intrinsics; ``camera`` and ``instant`` map a position
to its camera and instant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from dhtorch.data import open_all
from dhtorch.data.io.decode import FormatError, refuse_if
from dhtorch.data.recording import Recording, Recordings, TruthRecording
from dhtorch.data.scene import Scene, Scenes
from dhtorch.records import Frame, Pose
from dhtorch.runtime.console import format_count


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Recording):
    """The frames of several cameras."""

    cameras: tuple[str, ...] = field(kw_only=True)  # names of the cameras
    camera: Tensor = field(kw_only=True)  # (n,) int64, index in ``cameras`` of each frame
    instant: Tensor = field(kw_only=True)  # (n,) int64, index of each frame's instant


@dataclass(frozen=True, eq=False, repr=False)
class _TruthRig(Rig, TruthRecording):
    """A rig whose cameras all have ground truth."""

    def truth(self, index: int) -> dict[str, Tensor]:
        """As :meth:`TruthRecording.truth`, of the camera that took the frame."""
        i = self._position(index)
        assert isinstance(self.load, _Load)
        recording = self.load.recordings[int(self.camera[i])]
        assert isinstance(recording, TruthRecording)
        return recording.truth(int(self.load.places[i]))


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    recordings: tuple[Recording, ...]
    camera: Tensor  # (n,)
    places: Tensor  # (n,) positions in the recording of that camera

    def __call__(self, i: int) -> Frame:
        return self.recordings[int(self.camera[i])][int(self.places[i])]


def join_cameras(recordings: Sequence[Recording], *, tolerance: float | None = None, name: str | None = None) -> Rig:
    """Recordings of a rig's cameras → one recording of the instants common to all of them.

    Args:
        recordings: one for each camera. Where all have time stamps, the frames of an instant are those nearest in time
            to the first camera's frame; else those with the same number.
        tolerance: s, largest time difference within an instant. None = half the shortest median step.
        name: of the rig. None = the common prefix of the recordings' names.

    Raises:
        FormatError: fewer than two cameras, or no instant common to all.
    """
    where = recordings[0].root or Path(recordings[0].name) if recordings else Path("rig")
    names = [r.name.rpartition("/")[2] for r in recordings]
    refuse_if(
        len(recordings) < 2 or len(set(names)) < len(names),
        where,
        "cameras",
        ", ".join(names) or "none",
        "two or more cameras of different names",
    )
    places = _common_instants(recordings, tolerance)
    if not len(places):
        problem = "no instant common to all cameras"
        raise FormatError(where, ", ".join(names), problem, "frames of the same times or numbers")
    n, C = places.shape
    camera, flat = torch.arange(C).repeat(n), places.flatten()
    first = recordings[0].number[places[:, 0]]
    truth = all(isinstance(r, TruthRecording) for r in recordings)
    dropped = [
        f"{r.name}: {format_count(len(r) - n, 'frame')} without a common instant: left out"
        for r in recordings
        if len(r) > n
    ]
    make = _TruthRig if truth else Rig
    R, t = (
        _gather_by_camera([None if r.poses is None else getattr(r.poses, k) for r in recordings], camera, flat)
        for k in "Rt"
    )
    return make(
        name=name or recordings[0].name.rpartition("/")[0] or recordings[0].name,
        format=recordings[0].format,
        load=_Load(tuple(recordings), camera, flat),
        number=(first[:, None] * C + torch.arange(C)).flatten(),
        root=recordings[0].root,
        times=_gather_by_camera([r.times for r in recordings], camera, flat),
        poses=None if R is None or t is None else Pose(R, t),
        rate_hz=recordings[0].rate_hz,
        sparse=all(r.sparse for r in recordings),
        episode=recordings[0].episode,
        report=tuple(dict.fromkeys([line for r in recordings for line in r.report] + dropped)),
        cameras=tuple(names),
        camera=camera,
        instant=torch.arange(n).repeat_interleave(C),
    )


def open_rig(
    root: str | Path,
    format: str = "auto",
    *,
    tolerance: float | None = None,
    near: float | None = None,
    gap: int | None = None,
    levels: int | None = None,
    room: str | None = None,
    role: str | None = None,
    follow_links: bool = False,
    **options: object,
) -> Scenes:
    """Open the cameras at ``root`` as rigs, one for each scene or episode, lazily; notes as in ``open_capture``.

    Args:
        root, format, follow_links, options: as :func:`dhtorch.data.open_all`; the reader's options select cameras.
        tolerance: as :func:`join_cameras`.
        near, gap, levels, room, role: notes of the :class:`Scene`.

    Raises:
        FormatError: as :func:`dhtorch.data.open_all`, or no scene with two cameras.
    """
    recordings = open_all(root, format, follow_links=follow_links, **options)
    names = recordings.names if isinstance(recordings, Recordings) else [r.name for r in recordings]
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name.rpartition("/")[0], []).append(i)
    rigs = {scene: places for scene, places in groups.items() if scene and len(places) > 1}
    if not rigs:
        shown = ", ".join(names[:4])
        raise FormatError(root, "cameras", f"{len(names)} recordings: {shown}", "two or more cameras of one scene")
    lazy_rigs = Recordings(list(rigs), _MakeRig(recordings, tuple(map(tuple, rigs.values())), tolerance))
    return Scenes(lazy_rigs, partial(Scene, near=near, gap=gap, levels=levels, room=room, role=role))


@dataclass(frozen=True, eq=False)
class _MakeRig:
    """Position → rig."""

    recordings: Sequence[Recording]
    groups: tuple[tuple[int, ...], ...]
    tolerance: float | None

    def __call__(self, i: int) -> Rig:
        return join_cameras([self.recordings[place] for place in self.groups[i]], tolerance=self.tolerance)


def _common_instants(recordings: Sequence[Recording], tolerance: float | None) -> Tensor:
    """(instants, cameras) positions of the frames of each instant."""
    times = [r.times for r in recordings]
    first = recordings[0]
    columns = [torch.arange(len(first))]
    matched = torch.ones(len(first), dtype=torch.bool)
    stamps = [t for t in times if t is not None]
    if len(stamps) == len(times):
        steps = [float(t.diff().median()) for t in stamps if len(t) > 1]
        limit = tolerance if tolerance is not None else 0.5 * min(steps, default=1.0)
        for other in stamps[1:]:
            at = _nearest_stamp(stamps[0], other)
            columns.append(at)
            matched &= (other[at] - stamps[0]).abs() <= limit
            matched &= (
                _nearest_stamp(other, stamps[0])[at] == columns[0]
            )  # mutual nearest neighbours: one instant per frame
    else:
        for r in recordings[1:]:
            at = torch.searchsorted(r.number, first.number).clamp(max=len(r) - 1)
            columns.append(at)
            matched &= r.number[at] == first.number
    return torch.stack(columns, 1)[matched]


def _nearest_stamp(stamps: Tensor, among: Tensor) -> Tensor:
    """Position (n,) in ``among`` (m,), in any order, of the nearest to each of ``stamps``; of two the earlier."""
    order = among.argsort(stable=True)
    ordered = among[order]
    right = torch.searchsorted(ordered, stamps).clamp(max=len(ordered) - 1)
    left = (right - 1).clamp_min(0)
    return order[torch.where((stamps - ordered[left]).abs() <= (ordered[right] - stamps).abs(), left, right)]


def match_instants(recording: Recording, other: Recording) -> list[int]:
    """For each frame of ``recording`` the position in ``other`` of the frame of its instant; -1 = none."""
    positions = [-1] * len(recording)
    for i, k in _common_instants([recording, other], None).tolist():
        positions[i] = k
    return positions


def _gather_by_camera(values: Sequence[Tensor | None], camera: Tensor, places: Tensor) -> Tensor | None:
    """Values of the rig's frames gathered from each camera's (n, …); None where a camera lacks them."""
    available = [v for v in values if v is not None]
    if len(available) < len(values):
        return None
    return torch.stack([available[c][p] for c, p in zip(camera.tolist(), places.tolist(), strict=True)])
