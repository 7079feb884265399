"""One map of a recording from the maps of its frames, as they lie in files: nothing is asked of a method again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import reduce
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
from dhtorch.integrate.volume import View, Volume, confirmed, empty, fuse, reserve
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
    volumes = [empty(voxel), *([] if wide is None else [empty(wide)])]
    volumes = _fused(recording, poses, read, volumes, progress=progress)
    surface = reduce(union, map(points, volumes))
    placed = list(poses.values())
    shown = surface.xyz, 2 * voxel, surface.normal
    up = upwards(recording, placed, *shown) if len(surface.xyz) else mean_upwards(placed).tolist()
    return (reduce(union, map(mesh, volumes)) if meshed and len(surface.xyz) else surface), up


def _fused(
    recording: Recording,
    poses: Mapping[int, Pose],
    read: Callable[[int], FrameMap],
    volumes: Sequence[Volume],
    *,
    progress: Progress,
) -> list[Volume]:
    """The volumes after all frames: what the sensor says in each of them, what was swept in the last."""

    def views(source: int) -> Iterator[View]:
        name = "sensor" if source == Source.SENSOR else "swept"
        for k in progress(list(poses), f"{recording.name}: {name}", len(poses)):
            yield _view(recording, k, read(k), source, poses[k])

    *finer, last = volumes
    for k in poses:
        last = reserve(last, _view(recording, k, read(k), Source.SWEPT, poses[k]), max_reach=REACH)
    volumes = [*finer, last]
    for view in views(Source.SENSOR):
        volumes = [fuse(volume, view, max_reach=REACH) for volume in volumes]
    *finer, last = volumes
    for view in views(Source.SWEPT):
        last = fuse(last, view, source=Source.SWEPT, max_reach=REACH)
    return [*finer, confirmed(last, min(MIN_MAPS, len(poses)))]


def _sigmas(maps: Sequence[FrameMap]) -> Tensor:
    """Of swept pixels."""
    return torch.cat([found.sigma[(found.source == Source.SWEPT) & (found.depth > 0)] for found in maps])


def _places(recording: Recording, frames: Sequence[int]) -> dict[int, Pose]:
    if recording.poses is None:
        return {k: se3.identity(1, torch.zeros((), dtype=torch.float64)) for k in frames[:1]}
    poses = {k: recording.poses[k : k + 1].to(torch.float64) for k in frames}
    return {k: T for k, T in poses.items() if bool(T.R.isfinite().all() and T.t.isfinite().all())}


def _view(recording: Recording, k: int, found: FrameMap, source: int, T_world_from_cam: Pose) -> View:
    """The pixels of one source, but for those beside a step."""
    depth, sigma = found.depth[None], found.sigma[None]
    keep = (found.source[None] == source) & (depth > 0) & (sigma > 0) & (edges(depth) <= EDGE_REL)
    depth = torch.where(keep, depth, 0.0)
    score = torch.where(keep, 0.1 / (0.1 + sigma / torch.where(keep, depth, 1.0)), 0.0)
    return mapped(recording[k], depth, sigma, score, T_world_from_cam=T_world_from_cam)
