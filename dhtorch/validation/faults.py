"""Diagnosis of the fault that the depth maps of a recording share, by undoing each known fault in turn.

A fault that all frames share leaves a pattern: with the right one undone, the depth explains how points move between
the pictures. Points are tracked once; under each hypothesis only their depth changes, and with it their predicted
position in the other picture. The hypothesis that explains the tracks clearly better than no fault, and better than any
of another kind, is the diagnosis. Where the camera does not move, no depth moves a point; maps beside the sensor are
then compared with its near returns.

Alphabet: P pairs of a window of frames, N samples; a *miss* is the distance of a track's end from the reprojected
point, in pixels of a picture 640 wide; the *loss* of a pair is the mean of miss² / (miss² + c²), between 0 and 1.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Flag
from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.geometry.patches import rescale_field_of_view, sample_nearest
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import StageTimer, solve_pose_and_triangulate
from dhtorch.records import Frame, Pose, Samples, Tracks
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.track import lucas_kanade
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS, ValidationOptions

#: Method that tracks the pairs of a window and fits their motions.
TRACKING_METHOD = Method(
    n=384,
    hypotheses=100,
    track=partial(lucas_kanade, levels=5, window=21, normalise="bias", start=coarse_flow),
    pose=pnp_ransac,
    verify=None,  # hypotheses attach depth to other pixels on purpose
)

#: Largest delay or lead of a map that is tried, frames.
MAX_LAG_FRAMES = 5

#: Fewest samples of a pair's mean loss.
MIN_LOSSES = 12

#: Factors on the focal length that are tried.
FOCAL_FACTORS = (0.8, 0.87, 0.93, 0.95, 1.05, 1.07, 1.15, 1.25)

#: Fields of view of an unregistered depth over that of its picture that are tried, in steps of about an eighth.
FIELD_OF_VIEW_RATIOS = (0.55, 0.62, 0.7, 0.78, 0.87, 1.15, 1.28, 1.43, 1.6, 1.8)

#: Horizontal offsets of an unregistered depth that are tried, as fractions of the width.
SIDEWAYS_SHIFTS = (-0.08, -0.04, 0.04, 0.08)

#: Unit of a depth and the unit it was taken for -> factor that takes it to metres. 1/256 m and 1/5000 m are the steps
#: of KITTI's and TUM's files. Source: derived, ratios of the units.
UNIT_FACTORS = {
    "mm read as m": 1e-3,
    "m read as mm": 1e3,
    "inch read as m": 0.0254,
    "m read as inch": 1 / 0.0254,
    "cm read as m": 1e-2,
    "dm read as mm, or m as cm": 1e2,
    "cm read as mm, or m as dm": 10.0,
    "mm read as cm, or tenths of mm as mm": 0.1,
    "foot read as m": 0.3048,
    "m read as foot": 1 / 0.3048,
    "1/5000 m read as mm": 0.2,
    "mm read as 1/5000 m": 5.0,
    "1/256 m read as mm": 1000 / 256,
    "mm read as 1/256 m": 256 / 1000,
}


@dataclass(frozen=True)
class KnownFault:
    """A fault that the maps of a recording may share, and its inverse."""

    kind: str  # unit | mirrored | rolled | registration | along the ray | inverse | time offset | focal length
    name: str  # of this fault
    undo: Callable[[Tensor], Tensor] = lambda depth: depth  # map (B, h, w) → map without the fault
    lag: int = 0  # frames by which the maps come late
    focal: float = 1.0  # factor that corrects the focal length
    ray: bool = False  # whether depth is to be divided by the length of its ray
    scaled: bool = False  # whether the undone map has an unknown scale, which near returns determine


def rot90_map(depth: Tensor, quarters: int) -> Tensor:
    """Map (…, h, w) rolled counter-clockwise by quarter turns and resized to its old size (nearest pixels)."""
    rolled = torch.rot90(depth, quarters, (-2, -1))
    if rolled.shape == depth.shape:
        return rolled
    flat = rolled.reshape(1, -1, *rolled.shape[-2:])
    return F.interpolate(flat, depth.shape[-2:], mode="nearest-exact").reshape(depth.shape)


def ray_lengths(camera: cam.Camera, hw: tuple[int, int]) -> Tensor:
    """Lengths (B, h, w) of the viewing rays with z = 1 through a map's pixels: distance over depth. Gradient: none."""
    with torch.no_grad():
        return plane_sweep.pixel_rays(camera, hw).contiguous().norm(dim=-1).unflatten(1, hw)


#: Hypothesis without a fault.
NO_FAULT = KnownFault("none", "none")

#: Hypotheses with a fault.
KNOWN_FAULTS: tuple[KnownFault, ...] = (
    *(KnownFault("unit", name, partial(torch.mul, other=factor)) for name, factor in UNIT_FACTORS.items()),
    KnownFault("mirrored", "mirrored left to right", partial(torch.flip, dims=(-1,))),
    KnownFault("mirrored", "mirrored upside down", partial(torch.flip, dims=(-2,))),
    KnownFault("along the ray", "distance along the ray, not depth", ray=True),
    KnownFault(
        "inverse",
        "inverse depth or disparity, not depth",
        scaled=True,
        undo=lambda depth: depth.reciprocal().where(depth > 0, 0.0),
    ),
    *(KnownFault("rolled", f"rolled by {90 * k} degrees", partial(rot90_map, quarters=4 - k)) for k in (1, 2, 3)),
    *(
        KnownFault(  # the first and the last field tried are bounds
            "registration",
            f"not registered: seen over {bound}{field:.2f} of the picture's field",
            partial(rescale_field_of_view, factor=field),
        )
        for field, bound in zip(
            FIELD_OF_VIEW_RATIOS, ("at most ", *[""] * (len(FIELD_OF_VIEW_RATIOS) - 2), "at least "), strict=True
        )
    ),
    *(
        KnownFault(
            "registration",
            f"not registered: {abs(x):.0%} of the width too far {'right' if x > 0 else 'left'}",
            partial(rescale_field_of_view, factor=1.0, right=x),
        )
        for x in SIDEWAYS_SHIFTS
    ),
    *(
        KnownFault("time offset", f"{abs(k)} frames {'late' if k > 0 else 'early'}", lag=k)
        for k in range(-MAX_LAG_FRAMES, MAX_LAG_FRAMES + 1)
        if k
    ),
    *(
        KnownFault("focal length", f"focal length {1 / factor:.2f} of the true one", focal=factor)
        for factor in FOCAL_FACTORS
    ),
)


class Diagnosis(NamedTuple):
    """Diagnosis of a window of frames."""

    cause: str | None  # name; None = no fault explains the window clearly better, or it is not observable
    kind: str | None  # of the cause
    loss: Mapping[str, float]  # hypothesis → mean loss over the pairs, "none" among them
    n_pairs: int  # pairs with a loss
    pairs: Sequence[tuple[int, int]] = ()  # evaluated pairs, as indices in the window
    by: str = "tracks"  # tracks | returns (then n_pairs counts frames)


def diagnose(
    frames: Sequence[Frame],
    maps: Sequence[Tensor] | None = None,
    *,
    method: Method = TRACKING_METHOD,
    seed: int = 0,
    watched: "WindowTracks | None" = None,
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> Diagnosis:
    """Window of frames and their maps -> the known fault that they share, if one explains the pictures clearly best.

    Args:
        frames: some twenty views in their order, B = 1 each, of equal sizes.
        maps: (1, h, w) m of each, over the field of view of the picture, evaluated under the motions that are fitted to
            the sensor's near returns; None = the sensor's own depth, under whose hypotheses motions are fitted each
            time.
        method: its stages 1 to 5 track the pairs and fit their motions.
        seed: of the pose search.
        watched: result of :func:`track_window` on the same pictures; None = computed here.
        options: tuning constants of tracks, losses and their comparison.

    Where all frames have a pose (``T_world_from_cam``), misses under that motion count half, so that a unit or a focal
    length is observable, which motions fitted to the same depth absorb. Without poses a unit of the sensor's own depth
    is not observable and no hypothesis. Where fewer than four pairs have a motion, ``maps`` are compared with the
    sensor's near returns in the frames themselves.

    Raises:
        ValueError: fewer than two frames, or not one map for each.

    Gradient: none.
    Cost: a track of each pair, and a pose of each pair and hypothesis.
    """
    if len(frames) < 2 or (maps is not None and len(maps) != len(frames)):
        n_maps = "none" if maps is None else len(maps)
        raise ValueError(
            f"diagnose: found {len(frames)} frames and {n_maps} maps, expected two or more frames, and as many maps"
        )
    with torch.no_grad():
        window_tracks = track_window(frames, method, options) if watched is None else watched
        diagnosis = _diagnose_by_tracks(frames, maps, method, seed, window_tracks, options)
        has_motion = diagnosis.n_pairs >= options.min_window_pairs and not _is_static(frames, options)
        if maps is None or diagnosis.cause is not None or has_motion:
            return diagnosis
        by_returns = _diagnose_by_returns(frames, maps, method, options)
        return by_returns if by_returns.n_pairs >= options.min_window_pairs else diagnosis


def _diagnose_by_tracks(
    frames: Sequence[Frame],
    maps: Sequence[Tensor] | None,
    method: Method,
    seed: int,
    watched: "WindowTracks",
    options: ValidationOptions,
) -> Diagnosis:
    """Diagnosis by the motion of points between pictures."""
    if not watched.pairs:
        return Diagnosis(None, None, {}, 0)
    window = FaultWindow(
        references=pytree.collate([frames[i] for i, _ in watched.pairs]),
        others=pytree.collate([frames[j] for _, j in watched.pairs]),
        samples=pytree.collate(watched.samples),
        tracks=pytree.collate(watched.tracks),
        maps=maps,
        depths=[frame.depth for frame in frames],
        pairs=watched.pairs,
        method=method,
        seed=seed,
        options=options,
    )
    hypotheses = {cause.name: cause for cause in window.hypotheses()}
    base = window.sample_losses(NO_FAULT)
    losses = {name: window.comparable_loss(cause, base) for name, cause in hypotheses.items()}
    diagnosis = select_cause(losses, options)._replace(pairs=watched.pairs)
    if diagnosis.cause is None or window.explains(hypotheses[diagnosis.cause]):
        return diagnosis
    return diagnosis._replace(cause=None, kind=None)


def _is_static(frames: Sequence[Frame], options: ValidationOptions) -> bool:
    """Whether the given trajectory has no baseline, so that the motion of points is independent of depth."""
    poses = [frame.T_world_from_cam for frame in frames]
    positions = [pose.t for pose in poses if pose is not None]
    if len(positions) < len(poses):
        return False
    baseline = (torch.cat(positions) - positions[0]).norm(dim=-1).max()
    returns = torch.cat([frame.depth[frame.depth > 0] for frame in frames])
    return len(returns) > 0 and bool(baseline < options.static_baseline_ratio * returns.median())


def _diagnose_by_returns(
    frames: Sequence[Frame], maps: Sequence[Tensor], method: Method, options: ValidationOptions
) -> Diagnosis:
    """Diagnosis by near returns, where there is no motion; frames take the place of pairs."""
    indices = sorted(
        {round((len(frames) - 1) * k / (options.max_window_pairs - 1)) for k in range(options.max_window_pairs)}
    )
    returns = {i: _near_returns(frames[i], method, options) for i in indices}
    # A focal length does not change the map at a pixel.
    hypotheses = [NO_FAULT, *(cause for cause in KNOWN_FAULTS if cause.kind != "focal length")]
    losses = {}
    for cause in hypotheses:
        loss_of_frame = [
            _return_loss(returns[i], maps[i + cause.lag], cause, frames[i], options)
            if 0 <= i + cause.lag < len(maps)
            else None
            for i in indices
        ]
        losses[cause.name] = torch.stack([torch.tensor(torch.nan) if x is None else x for x in loss_of_frame])
    diagnosis = select_cause(losses, options)._replace(by="returns")
    if diagnosis.cause is None:
        return diagnosis
    before, after = losses[NO_FAULT.name], losses[diagnosis.cause]
    valid = before.isfinite() & after.isfinite()
    is_explained = (before - after)[valid].mean() >= options.min_explained_ratio * before[valid].mean()
    return diagnosis if bool(is_explained) else diagnosis._replace(cause=None, kind=None)


def _near_returns(frame: Frame, method: Method, options: ValidationOptions) -> tuple[Tensor, Tensor]:
    """Places (1, N, 2) px of a grid over a picture, and the near return (1, N) m there, 0 without one or at an edge."""
    view = frame if frame.depth_camera is not None else frame.replace(camera=cam.ideal(frame.camera))
    samples = method.backproject(view, dense.map_pixel_centres(frame, dense.map_hw(frame.hw, options.return_grid_side)))
    valid = samples.usable & ((samples.flag & (Flag.DEPTH_EDGE | Flag.SPECULAR)) == 0)
    return samples.uv, torch.where(valid, samples.depth, 0.0)


def _return_loss(
    uv_and_depth: tuple[Tensor, Tensor], depth: Tensor, cause: KnownFault, frame: Frame, options: ValidationOptions
) -> Tensor:
    """Mean loss of a map (1, h, w) with a fault undone at near returns; NaN where too few have a value."""
    uv, returned = uv_and_depth
    depth = undo_fault(depth.to(returned), cause, frame.replace(depth_camera=None))
    map_depth = _sample_map(depth, uv, frame.hw)
    map_depth = map_depth * _median_ratio(returned, map_depth) if cause.scaled else map_depth
    both = (returned > 0) & (map_depth > 0)
    miss = torch.where(both, map_depth / torch.where(both, returned, 1.0), 1.0).log() / math.log(
        options.half_loss_ratio
    )
    return _mean_loss(bounded_loss(miss, 1.0), both)[0].cpu()


def select_cause(losses: Mapping[str, Tensor], options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS) -> Diagnosis:
    """Losses (P,) of the pairs under each hypothesis (NaN = no loss) -> diagnosis. Gradient: none."""
    kinds = {cause.name: cause.kind for cause in (NO_FAULT, *KNOWN_FAULTS)}
    base = losses[NO_FAULT.name]
    valid = base.isfinite()
    mean = {name: float(loss[valid & loss.isfinite()].mean()) for name, loss in losses.items()}
    finite = {name: value for name, value in mean.items() if math.isfinite(value)}
    no_cause = Diagnosis(None, None, finite, int(valid.sum()))
    differences = {name: base - loss for name, loss in losses.items() if name != NO_FAULT.name}
    saved = {name: x[x.isfinite()] for name, x in differences.items()}
    saved = {name: x for name, x in saved.items() if len(x) >= options.min_window_pairs}
    if not saved:
        return no_cause
    best = max(saved, key=lambda name: float(saved[name].mean()))
    error = float(saved[best].std() / len(saved[best]) ** 0.5)
    # Over the pairs with both losses, since some pairs are easier; NaN without any.
    margins = [float((losses[name] - losses[best]).nanmean()) for name in saved if kinds[name] != kinds[best]]
    is_clear = float(saved[best].mean()) > max(options.min_loss_saved, options.min_standard_errors * error)
    return (
        no_cause._replace(cause=best, kind=kinds[best])
        if is_clear and not any(margin <= options.min_margin_over_others for margin in margins)
        else no_cause
    )


class WindowTracks(NamedTuple):
    """Pairs of a window, with the samples of each first picture and their tracks into the second."""

    pairs: Sequence[tuple[int, int]]
    samples: Sequence[Samples]
    tracks: Sequence[Tracks]


@dataclass(frozen=True, eq=False)
class SampleLosses:
    """Losses of the samples of a window's pairs under one hypothesis."""

    loss: Tensor  # (P, N) in [0, 1]
    used: Tensor  # (P, N) bool: the sample has a depth and a track
    defined: Tensor  # (P,) bool: the pair has a loss

    def mean(self) -> Tensor:
        """(P,) mean over the used samples; NaN where it is not defined or of too few samples."""
        return torch.where(self.defined, _mean_loss(self.loss, self.used), torch.nan)


@dataclass(frozen=True, eq=False)
class FaultWindow:
    """Tracked pairs of a window: the data of all hypotheses, independent of depth."""

    references: Frame  # (P, …)
    others: Frame  # (P, …)
    samples: Samples  # (P, N) with the sensor's own depth
    tracks: Tracks  # (P, N)
    maps: Sequence[Tensor] | None  # of all frames
    depths: Sequence[Tensor]  # of all frames, the sensor's own
    pairs: Sequence[tuple[int, int]]  # frames of each
    method: Method
    seed: int
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS

    def hypotheses(self) -> Sequence[KnownFault]:
        """Observable hypotheses: a motion fitted to near returns absorbs a focal length and their unit."""
        absorbed: set[str] = {"inverse"} if self.maps is None else set()
        if self.references.T_world_from_cam is None or self.others.T_world_from_cam is None:
            absorbed |= {"focal length", "unit"} if self.maps is None else {"focal length"}
        hypotheses = [NO_FAULT, *(cause for cause in KNOWN_FAULTS if cause.kind not in absorbed)]
        if self.maps is None:
            return hypotheses
        samples = self.method.backproject(self.references, self.samples.uv)
        depth = torch.cat([self.maps[i] for i, _ in self.pairs]).to(samples.depth)
        returned = torch.where(samples.usable, samples.depth, 0.0)
        ratios = _median_ratio(returned, _sample_map(depth, self.samples.uv, self.references.hw))
        if not bool((ratios > 0).any()):
            return hypotheses
        # A unit must be possible at the median ratio of near returns to the maps.
        ratio = float(ratios[ratios > 0].median())
        limit = math.log(self.options.max_unit_misfit)
        units = {name for name, factor in UNIT_FACTORS.items() if not abs(math.log(ratio / factor)) < limit}
        return [cause for cause in hypotheses if cause.name not in units]

    def explains(self, cause: KnownFault) -> bool:
        """Whether undoing the fault removes most of the maps' loss beyond that of the sensor's returns.

        A fault that is only better than none is no explanation. True where too few pairs have near returns, and for the
        sensor's own depth, for which there is no other depth to compare with.
        """
        if self.maps is None:
            return True
        before, after = (self.sample_losses(fault, near=True).mean() for fault in (NO_FAULT, cause))
        sensor_loss = self.sample_losses(NO_FAULT, near=True, sensor=True, focal=cause.focal).mean()
        valid = before.isfinite() & after.isfinite() & sensor_loss.isfinite()
        if int(valid.sum()) < self.options.min_window_pairs:
            return True
        return float((before - after)[valid].mean()) >= self.options.min_explained_ratio * float(
            (before - sensor_loss)[valid].mean()
        )

    def comparable_loss(self, cause: KnownFault, base: SampleLosses) -> Tensor:
        """(P,) loss with that fault undone, comparable with the loss ``base`` without a fault; NaN without one.

        A fault of the sensor's own depth that is undone may leave depth at some of the samples only, to which the
        motion is then fitted, too, and some samples are easier than others: the difference is taken over the samples
        with depth under both hypotheses, and added to the mean of ``base``. Motions of maps beside the sensor do not
        depend on the fault, and losses are compared as they are.
        """
        if cause == NO_FAULT:
            return base.mean()
        if self.maps is not None:
            return self.sample_losses(cause).mean()
        losses = self.sample_losses(cause)
        both = base.used & losses.used
        return base.mean() + replace(losses, used=both).mean() - replace(base, used=both).mean()

    def sample_losses(
        self, cause: KnownFault, *, near: bool = False, sensor: bool = False, focal: float | None = None
    ) -> SampleLosses:
        """Losses (P, N) of the samples with that fault undone.

        Args:
            cause: the fault that is undone.
            near: only of samples with a near return.
            sensor: of the sensor's returns instead of the maps.
            focal: factor on the focal lengths; None = the cause's.
        """
        frame_index = [i + cause.lag for i, _ in self.pairs]
        in_window = torch.tensor([0 <= i < len(self.depths) for i in frame_index], device=self.samples.uv.device)
        frame_index = [min(max(i, 0), len(self.depths) - 1) for i in frame_index]
        factor = cause.focal if focal is None else focal
        views = (self._scaled(self.references, factor), self._scaled(self.others, factor))
        is_sensor_map = self.maps is None
        returns = self.references.depth
        if is_sensor_map:
            returns = undo_fault(torch.cat([self.depths[i] for i in frame_index]), cause, views[0])
        view = views[0].replace(depth=returns)
        samples = self.method.backproject(view, self.samples.uv).replace(trackability=self.samples.trackability)
        returned = torch.where(samples.usable, samples.depth, 0.0)
        depth = returned
        if self.maps is not None and not sensor:
            picture_view = views[0].replace(depth_camera=None)
            depth = undo_fault(torch.cat([self.maps[i] for i in frame_index]).to(returned), cause, picture_view)
            depth = _sample_map(depth, self.samples.uv, view.hw)
            depth = depth * _median_ratio(returned, depth) if cause.scaled else depth
            depth = torch.where(samples.usable, depth, 0.0) if near else depth
        losses = self._losses_under_fitted_motion(samples, depth, views)
        trajectory = self._losses_under_trajectory(depth, views)
        if trajectory is not None:
            fitted = torch.where(losses.used & losses.defined[:, None], losses.loss, 1.0)
            losses = replace(trajectory, loss=0.5 * (fitted + trajectory.loss))
        return replace(losses, defined=losses.defined & in_window)

    @staticmethod
    def _scaled(frame: Frame, factor: float) -> Frame:
        """Frames with the focal lengths of both cameras times a factor."""
        camera = frame.camera.replace(f=frame.camera.f * factor)
        depth_camera = frame.depth_camera
        if depth_camera is not None:
            depth_camera = depth_camera.replace(f=depth_camera.f * factor)
        return frame.replace(camera=camera, depth_camera=depth_camera)

    def _losses_under_fitted_motion(self, samples: Samples, depth: Tensor, views: tuple[Frame, Frame]) -> SampleLosses:
        """Losses under motions fitted to near returns; without a motion 1 for the sensor's own depth, else none."""
        cameras = views[0].camera, views[1].camera
        _, usable, fit = solve_pose_and_triangulate(
            self.method, samples, self.tracks, *cameras, seed=self.seed, fit=None, clock=StageTimer(None)
        )
        is_static = fit.t_snr < 3
        losses = self._reprojection_losses(depth, usable, fit.T_1_from_0, cameras)
        if self.maps is None:
            return replace(losses, loss=torch.where(fit.ok[:, None], losses.loss, 1.0))
        return replace(losses, defined=fit.ok & ~is_static)

    def _losses_under_trajectory(self, depth: Tensor, views: tuple[Frame, Frame]) -> SampleLosses | None:
        """Losses under the motions of the frames' own poses; None where they have none."""
        a, b = views[0].T_world_from_cam, views[1].T_world_from_cam
        if a is None or b is None:
            return None
        T = se3.relative(a, b).map(lambda x: x.to(depth))
        return self._reprojection_losses(depth, self.tracks, T, (views[0].camera, views[1].camera))

    def _reprojection_losses(
        self, depth: Tensor, tracks: Tracks, T: Pose, cameras: tuple[cam.Camera, cam.Camera]
    ) -> SampleLosses:
        """Losses of the samples that have a depth and a track."""
        xyz = cam.unproject(cameras[0], self.samples.uv, depth)
        used = tracks.valid & (depth > 0) & xyz.isfinite().all(-1)
        xyz_1 = se3.apply(T, torch.where(used[..., None], xyz, 1.0))
        in_front = used & (xyz_1[..., 2] > 1e-6)
        uv = cam.project(cameras[1], torch.where(in_front[..., None], xyz_1, 1.0))
        miss = (uv - self.tracks.uv_1).norm(dim=-1) * (640 / self.references.hw[1])
        loss = torch.where(in_front, bounded_loss(miss, self.options.half_loss_px), 1.0)
        return SampleLosses(loss, used, torch.ones_like(used[:, 0]))


def bounded_loss(miss: Tensor, half: float) -> Tensor:
    """Misses (any shape) -> losses in [0, 1): miss² / (miss² + half²), a half at ``half``. Gradient: to the misses."""
    return miss.square() / (miss.square() + half**2)


def _mean_loss(loss: Tensor, used: Tensor) -> Tensor:
    """Mean (P,) of the used losses (P, N); NaN of fewer than :data:`MIN_LOSSES`."""
    n = used.sum(-1)
    mean = torch.where(used, loss, 0.0).sum(-1) / n.clamp_min(1)
    return torch.where(n >= MIN_LOSSES, mean, torch.nan)


def undo_fault(depth: Tensor, cause: KnownFault, view: Frame) -> Tensor:
    """Maps (P, h, w) with a fault undone, over the field of view of the pictures or of a depth camera."""
    depth = cause.undo(depth)
    if not cause.ray:
        return depth
    hw = (depth.shape[-2], depth.shape[-1])
    return depth / ray_lengths(view.depth_camera or cam.resize(view.camera, view.hw, hw), hw)


def _sample_map(depth: Tensor, uv: Tensor, hw: tuple[int, int]) -> Tensor:
    """Values (P, N) of maps (P, h, w) at pixels (P, N, 2) of pictures of size ``hw``; 0 where they are not finite."""
    at = cam.resize_pixels(uv, hw, (depth.shape[-2], depth.shape[-1]))
    return sample_nearest(depth, at)[0].nan_to_num(0.0, 0.0, 0.0)


def _median_ratio(returned: Tensor, depth: Tensor) -> Tensor:
    """Median ratio (P, 1) of near returns (P, N) to a map's depth (P, N) there; 0 where no return meets it."""
    both = (returned > 0) & (depth > 0)
    ratio = torch.where(both, returned / torch.where(both, depth, 1.0), torch.nan)
    return ratio.nanmedian(-1, keepdim=True).values.nan_to_num(0.0)


def track_window(
    frames: Sequence[Frame],
    method: Method = TRACKING_METHOD,
    options: ValidationOptions = DEFAULT_VALIDATION_OPTIONS,
) -> WindowTracks:
    """Window of frames -> tracks between pairs with the widest gap over which enough samples are tracked.

    Gradient: none.
    """
    pair_of_frame: dict[int, tuple[int, Samples, Tracks]] = {}
    # Reference views, evenly spread, far enough from the ends of the window for earlier and later maps.
    n, steps = len(frames), options.max_window_pairs - 1
    low, high = (MAX_LAG_FRAMES, n - 1 - MAX_LAG_FRAMES) if n > 3 * MAX_LAG_FRAMES else (0, n - 2)
    spread = sorted({low + round((high - low) * k / steps) for k in range(options.max_window_pairs)})
    for gap in [gap for gap in options.pair_gaps if gap < n]:
        first_frames = [i for i in spread if i not in pair_of_frame and i + gap < n]
        if not first_frames:
            continue
        with torch.no_grad():
            references = [frames[i] for i in first_frames]
            others = [frames[i + gap] for i in first_frames]
            samples = method.sample_depth(pytree.collate(references))
            tracks = method.track(pytree.collate(references).image, pytree.collate(others).image, samples.uv)
            is_textured = samples.trackability >= method.min_trackability
            tracks = tracks.replace(valid=tracks.valid & is_textured)
        is_tracked = tracks.valid.sum(-1) >= options.min_tracked_ratio * is_textured.sum(-1).clamp_min(1)
        for k, i in enumerate(first_frames):
            if bool(is_tracked[k]):
                pair_of_frame[i] = gap, samples[k : k + 1], tracks[k : k + 1]
    frame_order = sorted(pair_of_frame)
    pairs = [(i, i + pair_of_frame[i][0]) for i in frame_order]
    return WindowTracks(pairs, [pair_of_frame[i][1] for i in frame_order], [pair_of_frame[i][2] for i in frame_order])
