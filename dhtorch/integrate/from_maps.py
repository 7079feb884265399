"""One map of a recording from the maps of its frames, as they lie in files: nothing is asked of a method again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.integrate.level import mean_upwards, upwards
from dhtorch.integrate.recording import mapped
from dhtorch.integrate.surface import Surface, mesh, points
from dhtorch.integrate.sweeps import edges
from dhtorch.integrate.volume import confirmed, empty, fuse, reserve
from dhtorch.records import Pose

#: Swept maps that must agree on a surface of which nothing else speaks; of fewer maps all.
MIN_MAPS = 2

#: Depth of a neighbour over a pixel's own, minus one, from which on neither is believed: a step lies between them.
EDGE_REL = 0.1


class FrameMap(NamedTuple):
    """What is known of one frame, (h, w) each."""

    depth: Tensor  # m, 0 = none
    sigma: Tensor  # m
    source: Tensor  # codes.Source


def join(
    recording: Recording,
    frames: Sequence[int],
    read: Callable[[int], FrameMap],
    *,
    voxel: float,
    meshed: bool,
    progress: Callable[[Iterable[Any], str, int], Iterable[Any]] = lambda items, _text, _total: items,
) -> tuple[Surface, list[float]]:
    """The surface that the maps of ``frames`` show together, and which way is up.

    Args:
        recording: whose own trajectory places the frames; without one only the first of ``frames`` is used, and the
            world is its camera.
        frames: positions; those without a finite pose are left out.
        read: the map of a frame.
        voxel: m.
        meshed: triangles (needs scikit-image), else points.
        progress: wraps the loop over frames.

    Raises:
        ValueError: no frame that could be placed.
    """
    poses = _places(recording, frames)
    if not poses:
        raise ValueError(f"{recording.name}: found no frame with a finite pose, expected one at least")
    volume = empty(voxel)
    for k in poses:
        volume = reserve(volume, _view(recording, k, read(k), Source.SWEPT, poses[k]))
    for source in (Source.SENSOR, Source.SWEPT):
        name = "sensor" if source == Source.SENSOR else "swept"
        for k in progress(list(poses), f"{recording.name}: {name}", len(poses)):
            volume = fuse(volume, _view(recording, k, read(k), source, poses[k]), source=source)
    volume = confirmed(volume, min(MIN_MAPS, len(poses)))
    surface = points(volume)
    placed = list(poses.values())
    up = upwards(recording, placed, surface.xyz, 2 * voxel) if len(surface.xyz) else mean_upwards(placed).tolist()
    return (mesh(volume) if meshed and len(surface.xyz) else surface), up


def _places(recording: Recording, frames: Sequence[int]) -> dict[int, Pose]:
    if recording.poses is None:
        return {k: se3.identity(1, torch.zeros((), dtype=torch.float64)) for k in frames[:1]}
    poses = {k: recording.poses[k : k + 1].to(torch.float64) for k in frames}
    return {k: T for k, T in poses.items() if bool(T.R.isfinite().all() and T.t.isfinite().all())}


def _view(recording: Recording, k: int, found: FrameMap, source: int, T_world_from_cam: Pose) -> Any:
    """The pixels of one source, but for those beside a step."""
    depth, sigma = found.depth[None], found.sigma[None]
    keep = (found.source[None] == source) & (depth > 0) & (sigma > 0) & (edges(depth) <= EDGE_REL)
    depth = torch.where(keep, depth, 0.0)
    score = torch.where(keep, 0.1 / (0.1 + sigma / torch.where(keep, depth, 1.0)), 0.0)
    return mapped(recording[k], depth, sigma, score, T_world_from_cam=T_world_from_cam)
