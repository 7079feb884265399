"""One map of a recording from the maps of its frames, as they lie in files: nothing is asked of a method again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.integrate.level import mean_upwards, upwards
from dhtorch.integrate.recording import mapped
from dhtorch.integrate.scales import REACH, TOLD_BY, coarse, union
from dhtorch.integrate.surface import Surface, mesh, points
from dhtorch.integrate.sweeps import edges
from dhtorch.integrate.volume import Volume, confirmed, empty, fuse, reserve
from dhtorch.records import Pose

#: Swept maps that must agree on a surface of which nothing else speaks; of fewer maps all.
MIN_MAPS = 2

#: Depth of a neighbour over a pixel's own, minus one, from which on neither is believed: a step lies between them.
EDGE_REL = 0.1


Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]


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
    progress: Progress = lambda items, _text, _total: items,
) -> tuple[Surface, list[float]]:
    """The surface that the maps of ``frames`` show together, and which way is up.

    Args:
        recording: whose own trajectory places the frames; without one only the first of ``frames`` is used, and the
            world is its camera.
        frames: positions; those without a finite pose are left out.
        read: the map of a frame.
        voxel: m, of what the sensor sees; what was swept has voxels of its own where it is less sure.
        meshed: triangles (needs scikit-image), else points.
        progress: wraps the loop over frames.

    Raises:
        ValueError: no frame that could be placed.
    """
    poses = _places(recording, frames)
    if not poses:
        raise ValueError(f"{recording.name}: found no frame with a finite pose, expected one at least")
    wide = coarse(voxel, _sigmas([read(k) for k in list(poses)[:TOLD_BY]]))
    views = partial(_fused, recording, poses, read, progress=progress)
    if wide is None:
        volumes = [views(empty(voxel), (Source.SENSOR, Source.SWEPT))]
    else:
        volumes = [views(empty(voxel), (Source.SENSOR,)), views(empty(wide), (Source.SENSOR, Source.SWEPT))]
    surface = reduce(union, map(points, volumes))
    placed = list(poses.values())
    up = upwards(recording, placed, surface.xyz, 2 * voxel) if len(surface.xyz) else mean_upwards(placed).tolist()
    return (reduce(union, map(mesh, volumes)) if meshed and len(surface.xyz) else surface), up


def _fused(
    recording: Recording,
    poses: Mapping[int, Pose],
    read: Callable[[int], FrameMap],
    volume: Volume,
    sources: Sequence[int],
    *,
    progress: Progress,
) -> Volume:
    """The volume after these sources of all frames."""
    if Source.SWEPT in sources:
        for k in poses:
            volume = reserve(volume, _view(recording, k, read(k), Source.SWEPT, poses[k]), max_reach=REACH)
    for source in sources:
        name = "sensor" if source == Source.SENSOR else "swept"
        for k in progress(list(poses), f"{recording.name}: {name}", len(poses)):
            view = _view(recording, k, read(k), source, poses[k])
            volume = fuse(volume, view, source=source, max_reach=REACH)
    return confirmed(volume, min(MIN_MAPS, len(poses)))


def _sigmas(maps: Sequence[FrameMap]) -> Tensor:
    """Of swept pixels."""
    return torch.cat([found.sigma[(found.source == Source.SWEPT) & (found.depth > 0)] for found in maps])


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
