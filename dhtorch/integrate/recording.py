"""Integration of one recording: estimates of its pairs, poses of its frames, and fusion into volumes.

Frames are placed either by the recording's own trajectory (``device``) or by the relative poses that the method
estimated between them (``anchored``). The latter link frames only where a pose was solved, so that the recording may
fall into fragments. Fragments are not joined; the map consists of the one with the most frames.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data.pairs import Pair, spaced_frames
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene, SceneLike
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3, sparse_grid
from dhtorch.geometry.patches import sample_nearest
from dhtorch.integrate.sweeps import DenseSweep, StoredSweep, SweepStore, depth_step_rel
from dhtorch.integrate.volume import (
    VOLUME_SOURCES,
    DepthView,
    Volume,
    drop_unconfirmed,
    fuse_views,
    reserve_blocks,
    splat_points,
)
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.dense import map_pixel_centres
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.view_report import ViewReport, report_selection, with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import Camera, Estimate, Frame, Pose, PoseFit, Samples, Tracks

POSE_SOURCES = ("device", "anchored")


@dataclass(frozen=True)
class PairEstimate:
    """The method's estimate for one pair, with the colours and the camera that a map needs."""

    pair: tuple[int, int]  # reference view and source view; of several chosen source views the last
    samples: Samples
    estimate: Estimate
    tracks: Tracks  # as tracked, in the pictures' own pixels
    fit: PoseFit
    rgb: Tensor  # (1, N, 3) in [0, 1] at the samples
    camera: Camera  # of the reference view
    hw: tuple[int, int]
    picked: ViewReport | None = None  # if the method chose among several source views
    others: Mapping[int, PoseFit] = field(default_factory=dict)  # poses of all chosen source views
    swept: StoredSweep | None = None  # dense map of the reference view, if one was computed

    @property
    def links(self) -> dict[int, PoseFit]:
        """Source view → its pose relative to the reference view, for all source views used."""
        return {self.pair[1]: self.fit, **self.others}

    @property
    def recovered(self) -> Tensor:
        """(1, N) bool: samples with an estimate but without a usable return, as in ``merge``."""
        return self.estimate.keep & ~self.samples.usable


@dataclass(frozen=True)
class PlacedFrames:
    """Poses of the frames of a map in its world."""

    poses: dict[int, Pose]  # frame → T_world_from_cam (1), float64
    n_fragments: int  # number of fragments that the frames form
    n_unplaced: int  # frames of other fragments, or without a finite pose


def estimate_pairs(
    scene: SceneLike,
    method: Method,
    pairs: Iterable[Pair] | Iterable[tuple[int, int]],
    *,
    cutoff: float | None = None,
    seed: int = 0,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
    sweep: DenseSweep | None = None,
    shelf: SweepStore | None = None,
) -> Iterator[PairEstimate]:
    """The method's estimates for all pairs of a scene, one after the other.

    Args:
        scene, pairs: see ``dhtorch.data``.
        method: with one or several source views, which lie between the two of the pair or are chosen among candidates.
        cutoff: m; returns beyond it are hidden from the method. None = none are.
        seed, device, dtype: of the method's run; the estimates are returned on the CPU.
        sweep: also computes a dense map of each reference view, in the same run of the method.
        shelf: storage of the dense maps; None = a new one for this call.

    Raises:
        ValueError: as the method, the readers and the hold-out raise it.
    """
    scene = Scene.of(scene)
    hint, recording = scene.hint, scene.recording
    shelf = SweepStore() if shelf is None else shelf
    for i, j in pairs:
        candidates = () if isinstance(j, int) else j
        source_views = spaced_frames(i, j, max(1, min(method.views, j - i))) if isinstance(j, int) else candidates
        visible = [range_split(recording[k].to(dtype).to(device), cutoff) for k in (i, *source_views)]
        pair_method = with_view_selection(method) if candidates else method
        trace: dict[str, Any] = {}
        with torch.no_grad():
            others = stack(visible[1:]) if len(source_views) > 1 else visible[-1]
            estimator = pair_method if sweep is None else partial(sweep, pair_method)
            estimate = estimator(visible[0], others, seed=seed, hint=hint, trace=trace)
            samples = trace["samples"].to("cpu")
            rgb = _sample_colours(visible[0], trace["samples"].uv)
        tracks, fit = (trace[k].to("cpu") for k in ("tracks", "fit"))
        camera = visible[0].camera.to("cpu")
        selection = report_selection(i, candidates, trace) if candidates else None
        fits = [t["fit"].to("cpu") for t in trace.get("views", ())]
        yield PairEstimate(
            pair=(i, source_views[-1] if selection is None else selection.views[-1]),
            samples=samples,
            estimate=estimate.to("cpu"),
            tracks=tracks,
            fit=fit,
            rgb=rgb.cpu(),
            camera=camera,
            hw=visible[0].hw,
            picked=selection,
            others={} if selection is None else dict(zip(selection.views, fits or [fit], strict=True)),
            swept=shelf.put(trace["dense"]) if sweep is not None else None,
        )


def place_frames(recording: Recording, answers: Sequence[PairEstimate], *, poses: str = "device") -> PlacedFrames:
    """Poses in one world of all frames that the pairs' estimates contain.

    Args:
        recording: with ``poses`` if they are to be used.
        answers: the estimates of all pairs.
        poses: ``device``, the recording's own trajectory; ``anchored``, the pairs' relative poses chained along the
            fewest links from the first frame of a fragment, which has the pose of the recording's trajectory, or of
            the origin.

    Raises:
        ValueError: another value, or ``device`` for a recording without a trajectory.
    """
    if poses not in POSE_SOURCES:
        raise ValueError(f"poses: found {poses!r}, expected one of {', '.join(POSE_SOURCES)}")
    frames = sorted({k for answer in answers for k in (answer.pair[0], *answer.links)})
    trajectory = recording.poses
    own_poses = {} if trajectory is None else {k: trajectory[k : k + 1].to(torch.float64) for k in frames}
    own_poses = {k: T for k, T in own_poses.items() if bool(T.R.isfinite().all() and T.t.isfinite().all())}
    if poses == "device":
        if recording.poses is None:
            raise ValueError(f"poses: {recording.name} has no trajectory of its own, expected poses=anchored")
        return PlacedFrames(own_poses, int(bool(own_poses)), len(frames) - len(own_poses))
    links: dict[int, list[tuple[int, Pose]]] = {k: [] for k in frames}
    for answer in answers:
        i = answer.pair[0]
        for j, fit in answer.links.items():
            if bool(fit.ok[0]):
                T = fit.T_1_from_0.to(torch.float64)
                links[i].append((j, se3.invert(T)))
                links[j].append((i, T))
    fragments: list[dict[int, Pose]] = []
    for k in frames:
        if not any(k in fragment for fragment in fragments):
            start = own_poses.get(k, se3.identity(1, torch.zeros(1, dtype=torch.float64)))
            fragments.append(chain_poses(k, start, links))
    largest = max(fragments, key=len) if fragments else {}
    return PlacedFrames(largest, len(fragments), len(frames) - len(largest))


def linking_pairs(pairs: Sequence[tuple[int, int]], *, chosen: bool = False) -> list[tuple[int, int]]:
    """Additional pairs, nearly as wide as ``pairs``, so that the poses of all of them together link every frame.

    Steps of a single width never link neighbours; steps of two widths without a common factor do. The wider a step the
    more accurate its translation, so the second width is the largest such. Pairs that a method has ``chosen`` are of
    many widths and on both sides: steps of their median width are then added as well.
    """
    frames = sorted({k for pair in pairs for k in pair})
    position = {k: n for n, k in enumerate(frames)}
    widths = sorted(abs(position[j] - position[i]) for i, j in pairs)
    width = widths[len(widths) // 2] if widths else 1
    coprime = [w for w in range(1, width) if math.gcd(w, width) == 1 and w + width - 1 <= len(frames)]
    step = coprime[-1] if coprime else 1
    steps = sorted({step, width}) if chosen else [step]
    links = [(frames[n], frames[n + step]) for step in steps for n in range(len(frames) - step)]
    listed = {*pairs, *((j, i) for i, j in pairs)}
    return [link for link in links if link not in listed]


def fuse_recording(
    recording: Recording, volume: Volume, answers: Sequence[PairEstimate], places: PlacedFrames, **options: Any
) -> Volume:
    """The volume after fusion of all placed frames: :func:`fuse_recording_grids` with one volume."""
    (fused,) = fuse_recording_grids(recording, [volume], answers, places, **options)
    return fused


def fuse_recording_grids(
    recording: Recording,
    volumes: Sequence[Volume],
    answers: Sequence[PairEstimate],
    places: PlacedFrames,
    *,
    sources: Sequence[int] = VOLUME_SOURCES,
    cutoff: float | None = None,
    sigma_m: float = 0.0,
    sigma_rel: float = 0.01,
    min_conf: int = 1,
    min_maps: int = 2,
    max_reach: float = 3.0,
    weight: str = "variance",
    after: Callable[[int, list[Volume]], None] = lambda _source, _volumes: None,
    progress: Callable[[Iterable[Any], str, int], Iterable[Any]] = lambda items, _text, _total: items,
) -> list[Volume]:
    """The volumes after fusion of all placed frames: sensor depth, then recovered points, then swept maps.

    The sensor's depth is fused into every volume, each frame read once for all of them; the other sources only into
    the last one.

    Whole patches of a swept map may be wrong together, and float in space that other frames see through. The blocks of
    all maps are therefore reserved first (:func:`dhtorch.integrate.reserve_blocks`), so that whatever the order every
    ray updates the voxels it passes. Surfaces that no second map confirms are dropped
    (:func:`dhtorch.integrate.drop_unconfirmed`).

    Args:
        recording: read again, frame by frame.
        volumes: with four feature channels: red, green, blue and score.
        answers, places: from :func:`estimate_pairs` and :func:`place_frames`.
        sources: codes.Source to fuse.
        cutoff: m; returns beyond it are hidden.
        sigma_m, sigma_rel, min_conf: the sensor's noise and least confidence, as in stage 2.
        min_maps: swept maps that must agree on a surface without other depth; if there are fewer, all of them.
        max_reach, weight: of :func:`dhtorch.integrate.fuse_views`.
        after: called after each source with (codes.Source, volumes).
        progress: wraps the loop over frames: (items, text, number of items) → items.

    Returns:
        Volumes; recovered points are discs of 1.5 voxels, added where the sensor has no usable return.
    """
    *finer, volume = volumes
    fuse = partial(fuse_views, max_reach=max_reach, weight=weight)
    maps = [a for a in answers if a.pair[0] in places.poses and a.swept is not None and a.swept.n]
    for answer in progress(maps, f"{recording.name}: room", len(maps)) if Source.SWEPT in sources else ():
        volume = reserve_blocks(volume, view_from_sweep(recording, answer, places), max_reach=max_reach)
    if Source.SENSOR in sources:
        noise: dict[str, Any] = {"sigma_m": sigma_m, "sigma_rel": sigma_rel, "min_conf": min_conf}
        for k in progress(list(places.poses), f"{recording.name}: sensor", len(places.poses)):
            frame = range_split(recording[k].to(volume.distance.dtype), cutoff)
            *finer, volume = (
                fuse_views(
                    v,
                    view_from_sensor(
                        frame, places.poses[k], radius=1.5 * v.voxel if recording.sparse else None, **noise
                    ),
                    weight=weight,
                )
                for v in (*finer, volume)
            )
        after(Source.SENSOR, [*finer, volume])
    if Source.RECOVERED in sources:
        placed = [a for a in answers if a.pair[0] in places.poses and bool(a.recovered.any())]
        for answer in progress(placed, f"{recording.name}: recovered", len(placed)):
            estimate, T = answer.estimate, places.poses[answer.pair[0]]
            features = torch.cat((answer.rgb, estimate.score[..., None]), -1)
            points = estimate.uv, torch.where(answer.recovered, estimate.depth, 0.0), estimate.sigma, features
            view = splat_points(answer.camera, answer.hw, *points, T_world_from_cam=T, radius=1.5 * volume.voxel)
            volume = fuse(volume, view, source=Source.RECOVERED)
        after(Source.RECOVERED, [*finer, volume])
    if Source.SWEPT in sources:
        for answer in progress(maps, f"{recording.name}: swept", len(maps)):
            source = answer.swept.read()[-1]
            volume = fuse(volume, view_from_sweep(recording, answer, places), source=source)
        volume = drop_unconfirmed(volume, max(1, min(min_maps, len(maps))))
        after(Source.SWEPT, [*finer, volume])
    return [*finer, volume]


def measure_coverage(xyz: Tensor, cell: float) -> dict[str, Any]:
    """Number of occupied cells of ``cell`` metres of points (P, 3), and of their connected components.

    Keys: ``n_voxels`` occupied; ``n_islands``, components of touching cells; ``largest_island``, the fraction of the
    cells in the largest one, None without any.
    """
    key = sparse_grid.occupied_cells(xyz, cell)
    if not len(key):
        return {"n_voxels": 0, "n_islands": 0, "largest_island": None}
    sizes = sparse_grid.connected_components(key).bincount()
    return {"n_voxels": len(key), "n_islands": len(sizes), "largest_island": int(sizes.max()) / len(key)}


def view_from_sensor(
    frame: Frame,
    T_world_from_cam: Pose,
    *,
    sigma_m: float = 0.0,
    sigma_rel: float = 0.01,
    min_conf: int = 1,
    edge_rel: float = 0.1,
    radius: float | None = None,
) -> DepthView:
    """Depth view of one frame's sensor depth (B = 1), with colours of the image and the sensor confidence as score.

    Returns below ``min_conf`` are left out, and so are those beside a depth step of more than ``edge_rel``, which may
    mix both sides. With ``radius``, for sparse depth, every return becomes a disc of so many metres instead.
    """
    depth = torch.where(frame.depth.isfinite() & (frame.depth > 0), frame.depth, 0.0)
    hw = (depth.shape[-2], depth.shape[-1])
    camera = frame.map_camera
    score = torch.ones_like(depth) if frame.conf is None else frame.conf.to(depth) / 2
    if frame.conf is not None:
        depth = torch.where(frame.conf >= min_conf, depth, 0.0)
    if radius is None:
        depth = torch.where(depth_step_rel(depth) > edge_rel, 0.0, depth)
    sigma = (sigma_m**2 + (sigma_rel * depth).square()).sqrt()
    v, u = torch.meshgrid(*(torch.arange(n, device=depth.device) for n in hw), indexing="ij")
    uv = torch.stack((u, v), -1).view(1, -1, 2).to(depth)
    same = frame.depth_camera is None and hw == frame.hw
    seen = uv if same else cameras.project(frame.camera, cameras.rays(camera, uv).nan_to_num())
    features = torch.cat((_sample_colours(frame, seen), score.view(1, -1, 1)), -1)
    if radius is not None:
        index = (depth.flatten() > 0).nonzero()[:, 0]
        values = (uv[:, index], depth.flatten(1)[:, index], sigma.flatten(1)[:, index], features[:, index])
        return splat_points(camera, hw, *values, T_world_from_cam=T_world_from_cam, radius=radius)
    return DepthView(depth, sigma, features.view(1, *hw, 4), camera, T_world_from_cam)


def view_from_sweep(recording: Recording, answer: PairEstimate, places: PlacedFrames) -> DepthView:
    """Depth view of the swept pixels of a reference view's map, with colours of its image."""
    assert answer.swept is not None
    return view_from_depth_map(
        recording[answer.pair[0]], *answer.swept.read()[:3], T_world_from_cam=places.poses[answer.pair[0]]
    )


def view_from_depth_map(
    frame: Frame,
    depth: Tensor,  # (1, h, w) m, over the frame's whole image, 0 = none
    sigma: Tensor,  # (1, h, w) m
    score: Tensor,  # (1, h, w)
    *,
    T_world_from_cam: Pose,
) -> DepthView:
    """Depth view of a depth map of one frame, with colours of its image."""
    hw = depth.shape[-2], depth.shape[-1]
    features = torch.cat((_sample_colours(frame, map_pixel_centres(frame, hw)[None]), score.view(1, -1, 1)), -1)
    camera = cameras.resize(frame.camera, frame.hw, hw)
    return DepthView(depth, sigma, features.view(1, *hw, 4), camera, T_world_from_cam)


def chain_poses(first: int, start: Pose, links: dict[int, list[tuple[int, Pose]]]) -> dict[int, Pose]:
    """Poses of all frames that links connect to the first one, each along the fewest links."""
    poses, queue = {first: start}, deque([first])
    while queue:
        k = queue.popleft()
        for neighbour, T_k_from_neighbour in links[k]:
            if neighbour not in poses:
                poses[neighbour] = se3.compose(poses[k], T_k_from_neighbour)
                queue.append(neighbour)
    return poses


def _sample_colours(frame: Frame, uv: Tensor) -> Tensor:
    """Colours (1, N, 3) in [0, 1] of the nearest pixels to ``uv``."""
    image = frame.image[0].expand(3, -1, -1)
    value = sample_nearest(image, uv.expand(3, -1, -1))[0].T[None]
    return value.to(uv) / 255 if image.dtype == torch.uint8 else value
