"""Why a depth is wrong: what was done to a whole recording's maps, told by undoing each known fault in turn.

A fault that all frames share leaves a pattern: undo the right one, and the depth explains how points moved between the
pictures. Points are tracked once; under each hypothesis only their depth changes, and with it where the other picture
should show them. The one that explains clearly more than none at all, and more than any of another kind, is named.
Where the camera stands still no depth moves a point; maps beside the sensor are then held against its near returns.

Alphabet: P pairs of a window of frames, N samples; a *miss* is how far a track ends from where a depth says, in pixels
of a picture 640 wide; the *loss* of a pair is the mean of miss² / (miss² + c²), between 0 and 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch import pytree
from dhtorch.codes import Flag
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.geometry.patches import rescale_field_of_view, sample_nearest
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import StageTimer, solve_pose_and_triangulate
from dhtorch.records import Frame, Pose, Samples, Tracks
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.track import lucas_kanade

#: How pairs of a window are tracked and placed.
TRACKING_METHOD = Method(
    n=384,
    hypotheses=100,
    track=partial(lucas_kanade, levels=5, window=21, normalise="bias", start=coarse_flow),
    pose=pnp_ransac,
)

#: Miss at which the loss of a sample is a half, px of a picture 640 wide.
HALF_LOSS_PX = 2.0

#: Loss that an explanation must save over none, its standard errors over the pairs, and what it must save over the best
#: of another kind.
MIN_LOSS_SAVED, MIN_STANDARD_ERRORS, MIN_MARGIN_OVER_OTHERS = 0.04, 3.0, 0.015

#: Share of what a map misses beyond what the sensor's near returns miss that its cause must explain.
MIN_EXPLAINED_RATIO = 0.75

#: Without motions: ratio of a map to a near return at which the loss is a half, and the longer side of the grid of
#: returns.
HALF_LOSS_RATIO, RETURN_GRID_SIDE = 1.1, 64

#: Way of a camera that stands still at most, as a share of the median return.
STATIC_BASELINE_RATIO = 0.005

#: Frames that a depth may be early or late at most, and the factors on the focal length that are tried.
MAX_LAG_FRAMES = 5
FOCAL_FACTORS = (0.8, 0.87, 0.93, 0.95, 1.05, 1.07, 1.15, 1.25)

#: Fields of view of a depth over that of the picture it should be laid over, and by which share of the width it may lie
#: beside its place.
FIELD_OF_VIEW_RATIOS, SIDEWAYS_SHIFTS = (
    (0.55, 0.62, 0.7, 0.78, 0.87, 1.15, 1.28, 1.43, 1.6, 1.8),
    (-0.08, -0.04, 0.04, 0.08),
)

#: Factors that take a depth in another unit to metres; 1/256 m and 1/5000 m are the steps of KITTI's and TUM's files.
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

#: Factor by which a unit may fail to bring a map to its near returns, else it is not tried.
MAX_UNIT_MISFIT = 2.0

#: Pairs of a window, fewest that may name a cause, frames from one of a pair to the other, the widest first in which
#: such a share of the textured samples is found again.
MAX_WINDOW_PAIRS, MIN_WINDOW_PAIRS, PAIR_GAPS, MIN_TRACKED_RATIO = 8, 4, (8, 4, 2, 1), 0.4


@dataclass(frozen=True)
class KnownFault:
    """A fault that maps of a recording may share, and how it is undone."""

    kind: str  # unit | mirrored | rolled | registration | along the ray | inverse | time offset | focal length
    name: str  # of this one
    undo: Callable[[Tensor], Tensor] = lambda depth: depth  # map (B, h, w) → as it should be
    lag: int = 0  # frames by which the maps come late
    focal: float = 1.0  # what the focal length is to be multiplied by
    ray: bool = False  # depth is to be divided by the length of its ray
    scaled: bool = False  # what was undone is known up to a scale, which near returns tell


def rot90_map(depth: Tensor, quarters: int) -> Tensor:
    """A map (…, h, w) rolled counter-clockwise by quarter turns and stretched to its old size (nearest pixels)."""
    rolled = torch.rot90(depth, quarters, (-2, -1))
    if rolled.shape == depth.shape:
        return rolled
    flat = rolled.reshape(1, -1, *rolled.shape[-2:])
    return F.interpolate(flat, depth.shape[-2:], mode="nearest-exact").reshape(depth.shape)


def _seen_over(field: float) -> str:
    """The field in words; beyond the last one that is tried, nobody has looked."""
    bound = {FIELD_OF_VIEW_RATIOS[0]: "at most ", FIELD_OF_VIEW_RATIOS[-1]: "at least "}.get(field, "")
    return f"not registered: seen over {bound}{field:.2f} of the picture's field"


def ray_lengths(camera: cam.Camera, hw: tuple[int, int]) -> Tensor:
    """Lengths (B, h, w) of the viewing rays with z = 1 through a map's pixels: distance over depth. Gradient: none."""
    v, u = torch.meshgrid(*(torch.arange(n, device=camera.f.device) for n in hw), indexing="ij")
    uv = torch.stack((u, v), -1).view(1, -1, 2).expand(len(camera.f), -1, -1).to(camera.f)
    with torch.no_grad():
        return cam.rays(camera, uv).norm(dim=-1).unflatten(1, hw)


def _is_possible(cause: KnownFault, ratio: float) -> bool:
    """Whether it can be a cause where near returns stand at so many times what the maps say; 0 = not known."""
    factor = UNIT_FACTORS.get(cause.name)
    return factor is None or ratio == 0 or abs(math.log(ratio / factor)) < math.log(MAX_UNIT_MISFIT)


def _mirrored(depth: Tensor, axis: int) -> Tensor:
    return depth.flip(axis)


def _inverse(depth: Tensor) -> Tensor:
    return torch.where(depth > 0, 1 / torch.where(depth > 0, depth, 1.0), 0.0)


def _times(depth: Tensor, factor: float) -> Tensor:
    return depth * factor


#: Hypotheses: nothing first, then what is undone.
NO_FAULT = KnownFault("none", "none")
KNOWN_FAULTS: tuple[KnownFault, ...] = (
    *(KnownFault("unit", name, partial(_times, factor=factor)) for name, factor in UNIT_FACTORS.items()),
    KnownFault("mirrored", "mirrored left to right", partial(_mirrored, axis=-1)),
    KnownFault("mirrored", "mirrored upside down", partial(_mirrored, axis=-2)),
    KnownFault("along the ray", "distance along the ray, not depth", ray=True),
    KnownFault("inverse", "inverse depth or disparity, not depth", _inverse, scaled=True),
    *(KnownFault("rolled", f"rolled by {90 * k} degrees", partial(rot90_map, quarters=4 - k)) for k in (1, 2, 3)),
    *(
        KnownFault("registration", _seen_over(field), partial(rescale_field_of_view, factor=field))
        for field in FIELD_OF_VIEW_RATIOS
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
    """What was found out about a window of frames."""

    cause: str | None  # name; None = nothing explains better than no fault, or it cannot be known
    kind: str | None  # of the cause
    loss: Mapping[str, float]  # hypothesis → mean loss over the pairs, "none" among them
    n_pairs: int  # pairs that could tell
    pairs: Sequence[tuple[int, int]] = ()  # that were looked at, as places in the window
    by: str = "tracks"  # what told: tracks | returns (then n_pairs counts frames)


def diagnose(
    frames: Sequence[Frame],
    maps: Sequence[Tensor] | None = None,
    *,
    method: Method = TRACKING_METHOD,
    seed: int = 0,
    watched: WindowTracks | None = None,
) -> Diagnosis:
    """The known fault that the maps of a window of frames share, if one explains the pictures clearly best.

    Args:
        frames: some twenty views in their order, B = 1 each, of equal sizes.
        maps: (1, h, w) m of each, over the field of the picture, held against the motions that the sensor's near
            returns give; None = the sensor's own depth, whose hypotheses each give motions of their own.
        method: how pairs are tracked and placed; its seats 1 to 5 count.
        seed: of the pose search.
        watched: what :func:`track_window` found in the same pictures; None = it is asked.

    Where all frames carry a pose of their own (``T_world_from_cam``) misses under that motion count half, so that a
    unit or a focal length, which motions fitted to the same depth swallow, shows. Without, a unit of the sensor's own
    depth cannot be known and is not named. Where fewer than four pairs have a motion, ``maps`` are held against the
    sensor's near returns in the frames themselves.

    Raises:
        ValueError: fewer than two frames, or not one map for each.

    Gradient: none.
    Cost: a track of each pair, and a pose of each pair and hypothesis.
    """
    if len(frames) < 2 or (maps is not None and len(maps) != len(frames)):
        found = "none" if maps is None else len(maps)
        raise ValueError(f"diagnose: found {len(frames)} frames and {found} maps, expected two or more, as many maps")
    with torch.no_grad():
        named = _by_tracks(frames, maps, method, seed, track_window(frames, method) if watched is None else watched)
        moves = named.n_pairs >= MIN_WINDOW_PAIRS and not _stands(frames)
        if maps is None or named.cause is not None or moves:
            return named
        told = _by_returns(frames, maps, method)
        return told if told.n_pairs >= MIN_WINDOW_PAIRS else named


def _by_tracks(
    frames: Sequence[Frame], maps: Sequence[Tensor] | None, method: Method, seed: int, watched: WindowTracks
) -> Diagnosis:
    """What the motion of points between pictures names."""
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
    )
    asked = {cause.name: cause for cause in window.hypotheses()}
    named = select_cause({name: window.loss(cause) for name, cause in asked.items()})._replace(pairs=watched.pairs)
    if named.cause is None or window.explains(asked[named.cause]):
        return named
    return named._replace(cause=None, kind=None)


def _stands(frames: Sequence[Frame]) -> bool:
    """Whether a trajectory says that the camera stays in its place, so that motions tell depths nothing apart."""
    poses = [frame.T_world_from_cam for frame in frames]
    at = [pose.t for pose in poses if pose is not None]
    if len(at) < len(poses):
        return False
    way = (torch.cat(at) - at[0]).norm(dim=-1).max()
    returns = torch.cat([frame.depth[frame.depth > 0] for frame in frames])
    return len(returns) > 0 and bool(way < STATIC_BASELINE_RATIO * returns.median())


def _by_returns(frames: Sequence[Frame], maps: Sequence[Tensor], method: Method) -> Diagnosis:
    """What near returns name where no motion is known; a frame is one witness here as a pair is elsewhere."""
    places = sorted({round((len(frames) - 1) * k / (MAX_WINDOW_PAIRS - 1)) for k in range(MAX_WINDOW_PAIRS)})
    told = {i: _returns(frames[i], method) for i in places}
    # Those of one place in the picture know no focal length.
    asked = [NO_FAULT, *(cause for cause in KNOWN_FAULTS if cause.kind != "focal length")]
    losses = {}
    for cause in asked:
        held = [
            _return_loss(told[i], maps[i + cause.lag], cause, frames[i]) if 0 <= i + cause.lag < len(maps) else None
            for i in places
        ]
        losses[cause.name] = torch.stack([torch.tensor(torch.nan) if x is None else x for x in held])
    named = select_cause(losses)._replace(by="returns")
    if named.cause is None:
        return named
    before, after = losses[NO_FAULT.name], losses[named.cause]
    known = before.isfinite() & after.isfinite()
    explained = (before - after)[known].mean() >= MIN_EXPLAINED_RATIO * before[known].mean()
    return named if bool(explained) else named._replace(cause=None, kind=None)


def _returns(frame: Frame, method: Method) -> tuple[Tensor, Tensor]:
    """Places (1, N, 2) px of a grid over a picture, and the near return (1, N) m there, 0 without one or at an edge."""
    straight = frame if frame.depth_camera is not None else frame.replace(camera=cam.ideal(frame.camera))
    found = method.backproject(straight, dense.map_pixel_centres(frame, dense.map_hw(frame.hw, RETURN_GRID_SIDE)))
    fine = found.usable & ((found.flag & (Flag.DEPTH_EDGE | Flag.SPECULAR)) == 0)
    return found.uv, torch.where(fine, found.depth, 0.0)


def _return_loss(told: tuple[Tensor, Tensor], depth: Tensor, cause: KnownFault, frame: Frame) -> Tensor:
    """Mean loss of a map (1, h, w) with a fault undone at near returns; NaN where it meets too few."""
    uv, returned = told
    depth = _undone(depth.to(returned), cause, frame.replace(depth_camera=None))
    at = _said(depth, uv, frame.hw)
    at = at * _ratio(returned, at) if cause.scaled else at
    both = (returned > 0) & (at > 0)
    miss = torch.where(both, at / torch.where(both, returned, 1.0), 1.0).log() / math.log(HALF_LOSS_RATIO)
    return _mean_over(miss.square() / (miss.square() + 1), both)[0].cpu()


def select_cause(losses: Mapping[str, Tensor]) -> Diagnosis:
    """What is named by losses (P,) of the pairs under each hypothesis, NaN where a pair cannot tell. Gradient: none."""
    kinds = {cause.name: cause.kind for cause in (NO_FAULT, *KNOWN_FAULTS)}
    base = losses[NO_FAULT.name]
    able = base.isfinite()
    mean = {name: float(loss[able & loss.isfinite()].mean()) for name, loss in losses.items()}
    nothing = Diagnosis(
        None, None, {name: value for name, value in mean.items() if math.isfinite(value)}, int(able.sum())
    )
    saved = {
        name: (base - loss)[base.isfinite() & loss.isfinite()] for name, loss in losses.items() if name != NO_FAULT.name
    }
    saved = {name: each for name, each in saved.items() if len(each) >= MIN_WINDOW_PAIRS}
    if not saved:
        return nothing
    best = max(saved, key=lambda name: float(saved[name].mean()))
    error = float(saved[best].std() / len(saved[best]) ** 0.5)
    beyond = [_mean_of_both(losses[name] - losses[best]) for name in saved if kinds[name] != kinds[best]]
    clear = float(saved[best].mean()) > max(MIN_LOSS_SAVED, MIN_STANDARD_ERRORS * error)
    return (
        nothing._replace(cause=best, kind=kinds[best])
        if clear and all(x > MIN_MARGIN_OVER_OTHERS for x in beyond)
        else nothing
    )


def _mean_of_both(more: Tensor) -> float:
    """Of the pairs that both can tell, since some are easier than others; infinite without any."""
    known = more[more.isfinite()]
    return float(known.mean()) if len(known) else math.inf


class WindowTracks(NamedTuple):
    """Pairs of a window, and the samples of each first picture with where the second shows them."""

    pairs: Sequence[tuple[int, int]]
    samples: Sequence[Samples]
    tracks: Sequence[Tracks]


@dataclass(frozen=True, eq=False)
class FaultWindow:
    """Pairs of a window, tracked: what stays the same whatever the depth."""

    references: Frame  # (P, …)
    others: Frame  # (P, …)
    samples: Samples  # (P, N) as the sensor has them
    tracks: Tracks  # (P, N)
    maps: Sequence[Tensor] | None  # of all frames
    depths: Sequence[Tensor]  # of all frames, the sensor's own
    pairs: Sequence[tuple[int, int]]  # frames of each
    method: Method
    seed: int

    def hypotheses(self) -> Sequence[KnownFault]:
        """What could be known: a motion fitted to near returns swallows a focal length, and the unit of its own."""
        swallowed: set[str] = {"inverse"} if self.maps is None else set()
        if self.references.T_world_from_cam is None or self.others.T_world_from_cam is None:
            swallowed |= {"focal length", "unit"} if self.maps is None else {"focal length"}
        asked = [NO_FAULT, *(cause for cause in KNOWN_FAULTS if cause.kind not in swallowed)]
        ratio = 0.0 if self.maps is None else self._returned_over(self.maps)
        return [each for each in asked if _is_possible(each, ratio)]

    def _returned_over(self, maps: Sequence[Tensor]) -> float:
        """Median ratio of near returns to what maps say there; 0 without one."""
        samples = self.method.backproject(self.references, self.samples.uv)
        depth = torch.cat([maps[i] for i, _ in self.pairs]).to(samples.depth)
        told = torch.where(samples.usable, samples.depth, 0.0)
        found = _ratio(told, _said(depth, self.samples.uv, self.references.hw))
        return float(found[found > 0].median()) if bool((found > 0).any()) else 0.0

    def explains(self, cause: KnownFault) -> bool:
        """Whether maps with that fault undone come near to the sensor's returns, where there are any: an explanation
        that is only better than none is none. The sensor's own depth is held against nothing."""
        if self.maps is None:
            return True
        before, after = (self.loss(each, near=True) for each in (NO_FAULT, cause))
        least = self.loss(NO_FAULT, near=True, sensor=True, focal=cause.focal)
        known = before.isfinite() & after.isfinite() & least.isfinite()
        if int(known.sum()) < MIN_WINDOW_PAIRS:
            return True
        return float((before - after)[known].mean()) >= MIN_EXPLAINED_RATIO * float((before - least)[known].mean())

    def loss(
        self, cause: KnownFault, *, near: bool = False, sensor: bool = False, focal: float | None = None
    ) -> Tensor:
        """(P,) loss with that fault undone; NaN where a pair cannot tell.

        Args:
            cause: what is undone.
            near: of samples with a near return alone.
            sensor: of the sensor's returns, whatever the maps.
            focal: another factor on the focal lengths than the cause's.
        """
        place = [i + cause.lag for i, _ in self.pairs]
        there = torch.tensor([0 <= i < len(self.depths) for i in place], device=self.samples.uv.device)
        place = [min(max(i, 0), len(self.depths) - 1) for i in place]
        factor = cause.focal if focal is None else focal
        scaled = (self._scaled(self.references, factor), self._scaled(self.others, factor))
        own = self.maps is None
        returns = self.references.depth
        if own:
            returns = _undone(torch.cat([self.depths[i] for i in place]), cause, scaled[0])
        view = scaled[0].replace(depth=returns)
        samples = self.method.backproject(view, self.samples.uv).replace(trackability=self.samples.trackability)
        told = torch.where(samples.usable, samples.depth, 0.0)
        depth = told
        if self.maps is not None and not sensor:
            picture = scaled[0].replace(depth_camera=None)
            depth = _undone(torch.cat([self.maps[i] for i in place]).to(told), cause, picture)
            depth = _said(depth, self.samples.uv, view.hw)
            depth = depth * _ratio(told, depth) if cause.scaled else depth
            depth = torch.where(samples.usable, depth, 0.0) if near else depth
        found = self._under_fit(samples, depth, scaled)
        given = self._under_trajectory(depth, scaled)
        if given is not None:
            found = 0.5 * (torch.where(found.isfinite(), found, 1.0) + given)
        return torch.where(there, found, torch.nan)

    @staticmethod
    def _scaled(frame: Frame, factor: float) -> Frame:
        camera = frame.camera.replace(f=frame.camera.f * factor)
        depth_camera = frame.depth_camera
        if depth_camera is not None:
            depth_camera = depth_camera.replace(f=depth_camera.f * factor)
        return frame.replace(camera=camera, depth_camera=depth_camera)

    def _under_fit(self, samples: Samples, depth: Tensor, views: tuple[Frame, Frame]) -> Tensor:
        """Under motions fitted to near returns; a pair without one misses everything, of the sensor's own depth."""
        cameras = views[0].camera, views[1].camera
        _, usable, fit = solve_pose_and_triangulate(
            self.method, samples, self.tracks, *cameras, seed=self.seed, fit=None, clock=StageTimer(None)
        )
        still = fit.t_snr < 3
        loss = self._missed(depth, usable, fit.T_1_from_0, cameras)
        lost = 1.0 if self.maps is None else torch.nan
        return torch.where(fit.ok & ~(still & (self.maps is not None)), loss, lost)

    def _under_trajectory(self, depth: Tensor, views: tuple[Frame, Frame]) -> Tensor | None:
        """Under the motions of the frames' own poses; None where they have none."""
        a, b = views[0].T_world_from_cam, views[1].T_world_from_cam
        if a is None or b is None:
            return None
        T = se3.relative(a, b).map(lambda x: x.to(depth))
        return self._missed(depth, self.tracks, T, (views[0].camera, views[1].camera))

    def _missed(self, depth: Tensor, tracks: Tracks, T: Pose, cameras: tuple[cam.Camera, cam.Camera]) -> Tensor:
        """Mean loss (P,) of the samples that have a depth and a track."""
        xyz = cam.unproject(cameras[0], self.samples.uv, depth)
        used = tracks.valid & (depth > 0) & xyz.isfinite().all(-1)
        there = se3.apply(T, torch.where(used[..., None], xyz, 1.0))
        ahead = used & (there[..., 2] > 1e-6)
        uv = cam.project(cameras[1], torch.where(ahead[..., None], there, 1.0))
        miss = (uv - self.tracks.uv_1).norm(dim=-1) * (640 / self.references.hw[1])
        loss = torch.where(ahead, miss.square() / (miss.square() + HALF_LOSS_PX**2), 1.0)
        return _mean_over(loss, used)


def _mean_over(loss: Tensor, used: Tensor) -> Tensor:
    """Mean (P,) of the losses (P, N) that count; NaN of too few."""
    n = used.sum(-1)
    mean = torch.where(used, loss, 0.0).sum(-1) / n.clamp_min(1)
    return torch.where(n >= 12, mean, torch.nan)


def _undone(depth: Tensor, cause: KnownFault, view: Frame) -> Tensor:
    """Maps (P, h, w) as they should be, over the field of the pictures or of a camera of their own."""
    depth = cause.undo(depth)
    if not cause.ray:
        return depth
    hw = (depth.shape[-2], depth.shape[-1])
    return depth / ray_lengths(view.depth_camera or cam.resize(view.camera, view.hw, hw), hw)


def _said(depth: Tensor, uv: Tensor, hw: tuple[int, int]) -> Tensor:
    """What maps (P, h, w) say at pixels (P, N, 2) of pictures of size ``hw``; 0 where nothing finite."""
    at = cam.resize_pixels(uv, hw, (depth.shape[-2], depth.shape[-1]))
    return sample_nearest(depth, at)[0].nan_to_num(0.0, 0.0, 0.0)


def _ratio(told: Tensor, depth: Tensor) -> Tensor:
    """Median ratio (P, 1) of near returns ``told`` (P, N) to what a map says there; 0 where no return meets it."""
    both = (told > 0) & (depth > 0)
    ratio = torch.where(both, told / torch.where(both, depth, 1.0), torch.nan)
    return ratio.nanmedian(-1, keepdim=True).values.nan_to_num(0.0)


def track_window(frames: Sequence[Frame], method: Method = TRACKING_METHOD) -> WindowTracks:
    """How points move between the pictures of a window, in pairs as wide as tracks hold: what no depth changes.

    Gradient: none.
    """
    found: dict[int, tuple[int, Samples, Tracks]] = {}
    for gap in [gap for gap in PAIR_GAPS if gap < len(frames)]:
        firsts = [i for i in _reference_frames(len(frames)) if i not in found and i + gap < len(frames)]
        if not firsts:
            continue
        with torch.no_grad():
            samples, tracks = _tracked([frames[i] for i in firsts], [frames[i + gap] for i in firsts], method)
        textured = (samples.trackability >= method.min_trackability).sum(-1).clamp_min(1)
        holds = tracks.valid.sum(-1) >= MIN_TRACKED_RATIO * textured
        for k, i in enumerate(firsts):
            if bool(holds[k]):
                found[i] = gap, samples[k : k + 1], tracks[k : k + 1]
    order = sorted(found)
    pairs = [(i, i + found[i][0]) for i in order]
    return WindowTracks(pairs, [found[i][1] for i in order], [found[i][2] for i in order])


def _tracked(references: Sequence[Frame], others: Sequence[Frame], method: Method) -> tuple[Samples, Tracks]:
    """Samples of some frames found again in others."""
    samples = method.sample_depth(pytree.collate(references))
    tracks = method.track(pytree.collate(references).image, pytree.collate(others).image, samples.uv)
    return samples, tracks.replace(valid=tracks.valid & (samples.trackability >= method.min_trackability))


def _reference_frames(n: int) -> list[int]:
    """Reference views of a window, spread evenly, not so near its ends that no earlier or later map is known."""
    low, high = (MAX_LAG_FRAMES, n - 1 - MAX_LAG_FRAMES) if n > 3 * MAX_LAG_FRAMES else (0, n - 2)
    return sorted({low + round((high - low) * k / (MAX_WINDOW_PAIRS - 1)) for k in range(MAX_WINDOW_PAIRS)})
