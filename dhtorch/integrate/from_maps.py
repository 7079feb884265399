"""Fusion of a recording's saved depth maps into one surface, without another run of a method."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.codes import Source, is_estimated
from dhtorch.data.recording import Recording
from dhtorch.geometry import se3
from dhtorch.integrate.level import estimate_up, mean_camera_up
from dhtorch.integrate.recording import view_from_depth_map
from dhtorch.integrate.scales import MAX_REACH_TRUNCATIONS, N_MAPS_FOR_VOXEL, choose_coarse_voxel, merge_surfaces
from dhtorch.integrate.surface import Surface, extract_mesh, extract_points
from dhtorch.integrate.sweeps import depth_step_rel
from dhtorch.integrate.volume import DepthView, Volume, drop_unconfirmed, fuse_views, make_volume, reserve_blocks
from dhtorch.records import Pose

Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]


class FrameMap(NamedTuple):
    """Depth map of one frame, (h, w) each."""

    depth: Tensor  # m, 0 = none
    sigma: Tensor  # m
    source: Tensor  # codes.Source


def fuse_frame_maps(
    recording: Recording,
    frames: Sequence[int],
    read: Callable[[int], FrameMap],
    *,
    voxel: float,
    meshed: bool,
    progress: Progress = lambda items, _text, _total: items,
) -> tuple[Surface, list[float]]:
    """Surface fused from the depth maps of ``frames``, and the upward direction of its world (3).

    Args:
        recording: its trajectory places the frames; without one only the first of ``frames`` is used, and the world is
            its camera.
        frames: indices; those without a finite pose are left out.
        read: frame index → its depth map.
        voxel: m, of the grid for sensor depth; swept depth gets a coarser grid if it is less accurate.
        meshed: extract triangles (needs scikit-image), else points.
        progress: wraps the loop over frames.

    Raises:
        ValueError: no frame that could be placed.
    """
    if recording.poses is None:
        poses = {k: se3.identity(1, torch.zeros((), dtype=torch.float64)) for k in frames[:1]}
    else:
        poses = {k: recording.poses[k : k + 1].to(torch.float64) for k in frames}
    poses = {k: T for k, T in poses.items() if bool(T.R.isfinite().all() and T.t.isfinite().all())}
    if not poses:
        raise ValueError(f"{recording.name}: found no frame with a finite pose, expected one at least")
    maps = [read(k) for k in list(poses)[:N_MAPS_FOR_VOXEL]]
    sigmas = torch.cat([m.sigma[is_estimated(m.source) & (m.depth > 0)] for m in maps])
    coarse_voxel = choose_coarse_voxel(voxel, sigmas)
    volumes = [make_volume(voxel), *([] if coarse_voxel is None else [make_volume(coarse_voxel)])]
    volumes = _fuse_sources(recording, poses, read, volumes, progress=progress)
    surface = reduce(merge_surfaces, map(extract_points, volumes))
    placed = list(poses.values())
    evidence = surface.xyz, 2 * voxel, surface.normal
    up = estimate_up(recording, placed, *evidence) if len(surface.xyz) else mean_camera_up(placed).tolist()
    return (reduce(merge_surfaces, map(extract_mesh, volumes)) if meshed and len(surface.xyz) else surface), up


def _fuse_sources(
    recording: Recording,
    poses: Mapping[int, Pose],
    read: Callable[[int], FrameMap],
    volumes: Sequence[Volume],
    *,
    progress: Progress,
) -> list[Volume]:
    """The volumes after fusion of all frames: sensor depth in each of them, swept depth in the last."""

    def views(source: int) -> Iterator[tuple[DepthView, Tensor]]:
        name = "sensor" if source == Source.SENSOR else "swept"
        for k in progress(list(poses), f"{recording.name}: {name}", len(poses)):
            frame_map = read(k)
            filled = frame_map.source[None] == Source.FILLED
            yield _make_view(recording, k, frame_map, source, poses[k]), torch.where(filled, Source.FILLED, source)

    fuse = partial(fuse_views, max_reach=MAX_REACH_TRUNCATIONS, in_place=True)
    *finer, last = volumes
    for k in poses:
        last = reserve_blocks(
            last, _make_view(recording, k, read(k), Source.SWEPT, poses[k]), max_reach=MAX_REACH_TRUNCATIONS
        )
    volumes = [*finer, last]
    for view, _ in views(Source.SENSOR):
        volumes = [fuse(volume, view) for volume in volumes]
    *finer, last = volumes
    for view, source in views(Source.SWEPT):
        last = fuse(last, view, source=source)
    return [*finer, drop_unconfirmed(last, min(2, len(poses)))]  # maps that agree on a surface without other depth


def _make_view(recording: Recording, k: int, frame_map: FrameMap, source: int, T_world_from_cam: Pose) -> DepthView:
    """Depth view of the pixels of one source, without those beside a depth step."""
    depth, sigma = frame_map.depth[None], frame_map.sigma[None]
    chosen = is_estimated(frame_map.source) if source == Source.SWEPT else frame_map.source == source
    keep = chosen[None] & (depth > 0) & (sigma > 0) & (depth_step_rel(depth) <= 0.1)
    depth = torch.where(keep, depth, 0.0)
    score = torch.where(keep, 0.1 / (0.1 + sigma / torch.where(keep, depth, 1.0)), 0.0)
    return view_from_depth_map(recording[k], depth, sigma, score, T_world_from_cam=T_world_from_cam)
