"""RGB-D frames and a reconstruction of the same scene -> the reconstruction's size in metres, or where it is bent.

    model's pictures ─┐                 ┌─ same picture: depths of one pixel ──────────┐
                      ├─ match views ──┤                                              ├─ local scales ─ scale ± U
    capture's frames ─┘                 └─ other picture: tracks, pose of near returns ┘                └ faults

The sensor's returns are the ruler. A view and a frame that are the same picture are compared pixel by pixel; else the
view is tracked into the frame, and near returns give its pose relative to the frame in metres. Where the capture has
poses, the rigid part of the similarity follows from the cameras. The size is that of the depths; the camera path is
compared with the capture's poses, and where these are missing or do not show that it agrees, with motions between views
by near returns.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Flag
from dhtorch.data.models import ModelView, SceneModel, Similarity, read_model
from dhtorch.data.recording import Recording, picture_names
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.coarse_flow import coarse_flow
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.patches import sample_nearest
from dhtorch.geometry.sensor_noise import get_sensor_noise
from dhtorch.measure.local_scales import (
    DEFAULT_SCALE_TOLERANCE,
    LocalScales,
    ScaleFault,
    ScaleTolerance,
    estimate_scale,
    find_faults,
    local_scales,
)
from dhtorch.measure.path_scale import PathScale, measure_path
from dhtorch.metrics.camera_paths import CameraMotions, align_camera_paths, motions_of_path
from dhtorch.pipeline.picture_matching import is_same_picture, match_pictures, spread_evenly
from dhtorch.records import Frame, Pose, PoseFit, Samples, Tracks
from dhtorch.stages.backproject import backproject
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.sample import regular_grid
from dhtorch.stages.track import lucas_kanade

#: Relative standard deviation of the scale of a sensor of no stated class. Source: derived, the default ``sigma_rel``
#: of a return in :func:`dhtorch.stages.backproject.backproject`.
_UNSTATED_SENSOR_SIGMA = 0.01

#: Pixels of an image that are compared, a count. Source: the rates of scale_study hold for it.
_PLACES = 800

#: Fewest tracks of a registration, and fewest matched frames that can show a fault: counts. Source: as above.
_MIN_TRACKS, _MIN_FRAMES = 40, 3

#: Frames that are searched for the image of a view, per view compared, a count. Source: as above.
_FRAMES_PER_VIEW = 4

#: Most motions between views that are measured, a count. Source: chosen, five in each stretch of the path.
_MOTIONS = 40

#: Distance of two views between which a motion is measured, as a fraction of the depth, and the largest rotation
#: between them, rad. Source: chosen, the path's scale to 3 % by one motion in rooms and most of the view in common.
_BASELINE, _MOST_TURN = 0.1, 0.44

#: Standard deviation of log(scale of the path over that of the depths) where no motion is measured. Source: two of them
#: are the largest change of length that scale_study plants.
_UNSEEN_PATH = 0.05

#: Options of the pose from near returns: without a kernel, tracks that slide along an outline shorten the motions by
#: .8 % in room 72 of scale_study, with it by .3 %.
_ROBUST: dict[str, Any] = {"threshold_px": 2.0, "kernel": "geman_mcclure", "kernel_px": 0.5, "polish_steps": 3}

#: Flags of returns that are no part of the ruler: at edges of depth and of the picture.
_UNCLEAN = Flag.DEPTH_EDGE | Flag.BORDER


class _ViewMatch(NamedTuple):
    """A view of the model and the frame that measures it."""

    view: int
    frame: int
    is_same: bool  # the same picture


@dataclass(frozen=True, eq=False)
class ScaleResult:
    """The metric size of a model."""

    scale: float  # metres per unit of the model
    sigma: float  # of log(scale): all terms
    terms: dict[str, float]  # its terms: frames (scatter), sensor (its own scale), model (changes within the tolerance)
    faults: list[ScaleFault]  # empty = one scale holds everywhere that was measured
    gradients: list[ScaleFault]  # changes over recording, range, picture and place, beyond the tolerance or not
    local: LocalScales
    frame_log: np.ndarray  # (F,) log scale of every matched view, NaN where it has none
    frame_sigma: np.ndarray  # (F,)
    matches: list[_ViewMatch]  # (F,)
    names: list[str]  # (F,) of the views
    R: np.ndarray | None = None  # (3, 3) capture's world from model's; None = the capture has no poses
    t: np.ndarray | None = None  # (3,) m
    cov: np.ndarray | None = None  # (7, 7) of rotation (rad, on the left), translation (m) and log(scale)
    path: PathScale | None = None  # the camera path against motions in metres; None = none could be measured
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether one scale describes the model."""
        return not self.faults

    def interval(self, k: float = 2.0) -> tuple[float, float]:
        """Scale ± U with the coverage factor ``k``."""
        return self.scale * float(np.exp(-k * self.sigma)), self.scale * float(np.exp(k * self.sigma))

    @property
    def similarity(self) -> Similarity:
        """Model -> capture's world; without poses of the capture scale only."""
        R = np.eye(3) if self.R is None else self.R
        return Similarity(self.scale, R, np.zeros(3) if self.t is None else self.t)

    @property
    def by_range(self) -> list[tuple[float, float, float, int]]:
        """(from m, to m, relative difference of the scale there, local scales) in eight bins of equal number."""
        edges = np.quantile(self.local.depth, np.linspace(0, 1, 9))
        return [
            (float(a), float(b), float(np.expm1(np.median(self.local.log[here]) - np.log(self.scale))), int(here.sum()))
            for a, b in itertools.pairwise(edges)
            for here in [(self.local.depth >= a) & (self.local.depth <= b)]
            if here.any()
        ]


class _Pairs(NamedTuple):
    """Depths of N places of one view in metres and in the model's units."""

    share: np.ndarray  # (N, 2) place in the picture, 0 … 1
    depth: np.ndarray  # (N,) m
    model_depth: np.ndarray  # (N,)
    xyz: np.ndarray  # (N, 3) model's world
    c2w: np.ndarray | None  # (4, 4) of the view in the capture's world, m; None where the frame has no pose
    T_view_from_frame: Pose  # (1) m


def metric_scale(
    model: SceneModel | str | Path,
    frames: Recording | Sequence[Frame],
    *,
    names: Sequence[str] | None = None,
    sensor: str | Sequence[float] | None = None,
    cutoff: float | None = None,
    max_frames: int = 60,
    tolerance: ScaleTolerance = DEFAULT_SCALE_TOLERANCE,
) -> ScaleResult:
    """Model up to scale and RGB-D frames of the same scene -> metric scale with a standard deviation, or its faults.

    Args:
        model: a reconstruction, or its path.
        frames: RGB-D frames (batch size 1); their poses are used where they have them.
        names: of the frames' pictures, to find the model's views by name. None = as the recording's files are called.
        sensor: class of the depth sensor or three numbers (:func:`dhtorch.geometry.sensor_noise.get_sensor_noise`): an
            error that all returns share is not observable, and the noise of one return enters sigma as if it were such.
            None = not stated, 1 %.
        cutoff: m; farther returns are not used. None = all are.
        max_frames: views compared at most, evenly spread.
        tolerance: change of scale from which a model is refused.

    Returns:
        ``scale`` with ``sigma``; ``faults`` where parts of the model, or its camera path, have another scale than the
        rest: then no single scale is right, and that of the whole is only a mean. Changes within the tolerance enter
        ``sigma``. ``R``, ``t`` and ``cov`` where the capture has poses.

    Raises:
        ValueError: no view of the model can be matched with a frame, or too few returns lie on the model.
    """
    model = model if isinstance(model, SceneModel) else read_model(model)
    if names is None and isinstance(frames, Recording):
        names = picture_names(frames)
    candidates, route, notes = _match_views(model, frames, names, max_frames)
    measured = [(m, _measure(model, model.views[m.view], frames[m.frame], m.is_same, cutoff)) for m in candidates]
    matches = [match for match, pairs in measured if pairs is not None]
    pairs = [each for _, each in measured if each is not None]
    columns = [np.concatenate(each) for each in zip(*(p[:4] for p in pairs), strict=True)]
    local = local_scales(np.repeat(np.arange(len(pairs)), [len(p.depth) for p in pairs]), *columns) if pairs else None
    if local is None or len(local.log) == 0:
        raise ValueError(
            f"{model.root}: found too few sensor returns on the model's points, expected frames that see it"
        )
    mean, scatter, frame_log, frame_sigma = estimate_scale(local, len(matches))
    view_names = [model.views[match.view].name for match in matches]
    faults, gradients = find_faults(local, view_names, tolerance)
    if len(matches) < _MIN_FRAMES:
        notes.append(f"only {len(matches)} view(s) matched: a bend or a drift of the model would not be seen")
    bend = max((abs(g.change) for g in gradients if abs(g.change) > g.sigma), default=0.0)
    depth = torch.tensor(np.median(local.depth))
    own = _UNSTATED_SENSOR_SIGMA if sensor is None else float(get_sensor_noise(sensor)(depth) / depth)
    scale = float(np.exp(mean))
    compare = partial(measure_path, scale=scale, depth=float(depth), tolerance=tolerance)
    path = _compare_path(model, frames, route, list(zip(matches, pairs, strict=True)), compare, limit=cutoff, own=own)
    unseen = path is None and len(model.views) > 1
    if unseen:
        notes.append(
            "no motion between views could be measured: a camera path of another scale would not be seen, and U covers "
            f"one that is up to {2 * _UNSEEN_PATH:.0%} longer or shorter than the depths"
        )
    faults = (path.faults if path else []) + faults
    spread = path.spread if path else _UNSEEN_PATH * unseen
    terms = {"frames": scatter, "sensor": own, "model": max(bend / 12**0.5, spread)}
    sigma = float(np.sqrt(sum(term**2 for term in terms.values())))
    R, t, cov = None, None, None
    if (poses := _poses_of(pairs)) is not None:
        of_model = np.stack([model.views[match.view].c2w for match in matches])
        R, t, cov = align_camera_paths(poses, of_model, scale, sigma)
    return ScaleResult(
        scale=scale,
        sigma=sigma,
        terms=terms,
        faults=faults,
        gradients=gradients,
        local=local,
        frame_log=frame_log,
        frame_sigma=frame_sigma,
        matches=matches,
        names=view_names,
        notes=notes,
        R=R,
        t=t,
        cov=cov,
        path=path,
    )


def _match_views(
    model: SceneModel, frames: Recording | Sequence[Frame], names: Sequence[str] | None, max_frames: int
) -> tuple[list[_ViewMatch], list[_ViewMatch], list[str]]:
    """Views with the frames that measure them, evenly spread and in the order of the frames; all such views, also those
    between; and notes.

    Equal names are one picture unless the model's picture differs from the frame's. Without equal names pictures are
    compared.
    """
    by_name = {Path(name).stem: k for k, name in reversed(list(enumerate(names or ())))}
    named = [(k, by_name.get(Path(view.name).stem)) for k, view in enumerate(model.views)]
    route = sorted((_ViewMatch(k, f, is_same=True) for k, f in named if f is not None), key=lambda m: m.frame)
    matches = spread_evenly(route, max_frames)
    pictures = {k: view.read_picture for k, view in enumerate(model.views) if view.image is not None}
    checked = [m.view not in pictures or is_same_picture(pictures[m.view](), frames[m.frame].image) for m in matches]
    same = [m for m, ok in zip(matches, checked, strict=True) if ok]
    if len(same) >= min(_MIN_FRAMES, len(model.views)):
        seen = any(m.view in pictures for m in same)
        route = [m for m in route if m in same or m not in matches]
        return same, route, [] if seen else ["the model's pictures are not there: views were matched by name alone"]
    if not pictures:
        raise ValueError(
            f"{model.root}: found no picture of the model and no view named as a frame of the capture, expected its "
            "pictures (images=FOLDER) or names of views that are those of frames"
        )
    images = {i: lambda i=i: frames[i].image for i in spread_evenly(range(len(frames)), _FRAMES_PER_VIEW * max_frames)}
    compared = {k: pictures[k] for k in spread_evenly(list(pictures), max_frames)}
    route = sorted((_ViewMatch(*m) for m in match_pictures(compared, images)), key=lambda m: m.frame)
    return route, route, []


def _measure(model: SceneModel, view: ModelView, frame: Frame, is_same: bool, limit: float | None) -> _Pairs | None:
    """Depths of places of a view in metres and in the model's units; None where too few are comparable.

    A view that is no frame's picture is tracked into the frame, whose near returns give its pose there.
    """
    frame = frame.to(torch.float64)
    uv, model_depth = _model_depths(model, view)
    T_view_from_frame: Pose | None = se3.identity(1, model_depth)
    if len(uv) < _MIN_TRACKS // 2:
        return None
    if is_same:
        samples = backproject(frame, _same_pixels(view, frame, uv), near_limit=limit)
        depth, used = samples.depth[0], _is_clean(samples)
    else:
        fit, depth, used = _register(view, frame, uv, limit)
        T_view_from_frame = None if fit is None else fit.T_1_from_0
    if T_view_from_frame is None or int(used.sum()) < _MIN_TRACKS // 2:
        return None
    uv, depth, model_depth = uv[used], depth[used], model_depth[used]
    share = ((uv + 0.5) / torch.tensor([view.hw[1], view.hw[0]])).clamp(0, 1 - 1e-9).numpy()
    xyz = cam.unproject(cam.ideal(view.camera), cam.undistort(view.camera, uv[None]), model_depth[None])[0].numpy()
    pose = frame.T_world_from_cam
    c2w = None
    if pose is not None and bool(pose.t.isfinite().all()):
        c2w = se3.to_matrix(se3.compose(pose, se3.invert(T_view_from_frame)))[0].numpy()
    return _Pairs(share, depth.numpy(), model_depth.numpy(), view.to_world(xyz), c2w, T_view_from_frame)


def _model_depths(model: SceneModel, view: ModelView) -> tuple[Tensor, Tensor]:
    """At most ``_PLACES`` pixels (N, 2) of a view, of K's size, with a depth (N,) of the model there."""
    if view.depth is None:
        uv, depth = model.seen_points(view)
        index = torch.linspace(0, max(len(uv) - 1, 0), min(len(uv), _PLACES)).round().long()
        return uv[index], depth[index]
    uv = regular_grid(view.hw, _PLACES, dtype=torch.float64)
    at = cam.resize_pixels(uv, view.hw, (view.depth.shape[0], view.depth.shape[1]))
    depth = sample_nearest(torch.from_numpy(view.depth)[None], at[None])[0][0].double()
    return uv[depth > 0], depth[depth > 0]


def _same_pixels(view: ModelView, frame: Frame, uv: Tensor) -> Tensor:
    """Pixels (1, N, 2) of a frame for those of a view that is the same picture, resized or cut."""
    if _has_same_aspect(view, frame):
        return cam.resize_pixels(uv, view.hw, frame.hw)[None]
    rays = cam.rays(cam.ideal(view.camera), cam.undistort(view.camera, uv[None]))
    return cam.distort(frame.camera, cam.project(cam.ideal(frame.camera), rays))


def _has_same_aspect(view: ModelView, frame: Frame) -> bool:
    return abs(view.hw[0] * frame.hw[1] / (view.hw[1] * frame.hw[0]) - 1) < 0.01


def _is_clean(samples: Samples) -> Tensor:
    """Returns (N,) within range, away from edges of depth and of the picture."""
    return samples.usable[0] & (samples.flag[0] & _UNCLEAN == 0)


def _poses_of(pairs: Sequence[_Pairs]) -> np.ndarray | None:
    """Poses (F, 4, 4) of views in the capture's world, m; None where not all have one or too few."""
    poses = [p.c2w for p in pairs if p.c2w is not None]
    return np.stack(poses) if len(poses) == len(pairs) >= _MIN_FRAMES else None


def _compare_path(
    model: SceneModel,
    frames: Recording | Sequence[Frame],
    route: list[_ViewMatch],
    measured: list[tuple[_ViewMatch, _Pairs]],
    compare: Callable[..., PathScale | None],
    *,
    limit: float | None,
    own: float,
) -> PathScale | None:
    """The camera path against the capture's poses; against near returns where there are no poses, where these do not
    show that the path agrees with the depths, and where they contradict the near returns."""
    by_poses = None
    if (poses := _poses_of([pairs for _, pairs in measured])) is not None:
        views = [model.views[match.view] for match, _ in measured]
        by_poses = compare("the capture's poses", motions_of_path(poses), views, own=own)
        if by_poses is not None and by_poses.agrees:
            return by_poses
    motions = _track_motions(model, frames, route, measured, limit)
    by_returns = compare("near returns", motions, [model.views[match.view] for match in route])
    if by_poses is None or by_returns is None:
        return by_poses or by_returns
    apart = abs(np.log(by_poses.scale / by_returns.scale)) / np.hypot(by_poses.sigma, by_returns.sigma)
    return by_returns if apart > DEFAULT_SCALE_TOLERANCE.deviations or by_returns.sigma < by_poses.sigma else by_poses


def _track_motions(
    model: SceneModel,
    frames: Recording | Sequence[Frame],
    route: list[_ViewMatch],
    measured: list[tuple[_ViewMatch, _Pairs]],
    limit: float | None,
) -> CameraMotions:
    """Motions between views of a route: near returns at one of them, tracked into another."""
    c2w = np.stack([model.views[match.view].c2w for match in route])
    rows = []
    for match, pairs in spread_evenly(measured, _MOTIONS):
        first = route.index(match)
        second = first + _choose_second(c2w[first:], float(np.median(pairs.model_depth)))
        if second == first:
            continue
        here, other, frame = model.views[match.view], route[second], frames[match.frame].to(torch.float64)
        if match.is_same and _has_same_aspect(here, frame):
            frame = frame.replace(camera=cam.resize(here.camera, here.hw, frame.hw))
        view, own = model.views[other.view], frames[other.frame] if other.is_same else None
        fit, _, _ = _register(view, frame, _model_depths(model, view)[0], limit, own)
        if fit is not None:
            T = se3.compose(fit.T_1_from_0, se3.invert(pairs.T_view_from_frame))
            rows.append((first, second, se3.to_matrix(T)[0].numpy(), fit.cov[0].numpy()))
    columns = list(zip(*rows, strict=True)) or [()] * 4
    return CameraMotions(*(np.array(x, int) for x in columns[:2]), *(np.array(x) for x in columns[2:]))


def _choose_second(c2w: np.ndarray, depth: float) -> int:
    """Place, in a path (F, 4, 4), of the camera whose distance from the first is nearest to ``_BASELINE`` of the depth;
    the next one where that alone is farther, 0 where none of those that share most of its view is far enough."""
    baseline = np.linalg.norm(c2w[:, :3, 3] - c2w[0, :3, 3], axis=1) / depth
    cosine = (np.einsum("ij,nij->n", c2w[0, :3, :3], c2w[:, :3, :3]) - 1) / 2
    shared = np.logical_and.accumulate((baseline < 2 * _BASELINE) & (cosine > np.cos(_MOST_TURN)))
    usable = shared & (baseline > _BASELINE / 4)
    if not usable.any():
        return int(len(c2w) > 1 and baseline[1] >= 2 * _BASELINE)
    return int(np.argmin(np.where(usable, np.abs(np.log(np.maximum(baseline, 1e-9) / _BASELINE)), np.inf)))


@torch.no_grad()
def _register(
    view: ModelView, frame: Frame, uv: Tensor, limit: float | None, own: Frame | None = None
) -> tuple[PoseFit | None, Tensor, Tensor]:
    """Pose (1) of a frame in the camera of a view of another picture, depths (N,) m there at pixels (N, 2) of the view,
    and which of them agree; no pose where too few do. ``own``: the frame that is the view's picture; None = none is.
    """
    nothing = None, uv[:, 0], torch.zeros(len(uv), dtype=torch.bool)
    if own is None and view.image is None:
        return nothing
    picture = view.read_picture() if own is None else own.image
    start = cam.resize_pixels(uv, view.hw, (picture.shape[-2], picture.shape[-1]))[None]
    start = start if own is None else _same_pixels(view, own, uv)
    image_0, image_1 = (grayscale(image).float() for image in (picture, frame.image))
    tracks = lucas_kanade(image_0, image_1, start, levels=5, normalise="gain_bias", start=coarse_flow)
    samples = backproject(frame, tracks.uv_1, near_limit=limit)
    valid = tracks.valid & _is_clean(samples)[None]
    if int(valid.sum()) < _MIN_TRACKS:
        return nothing
    draws = torch.rand(1, 128, 3, generator=torch.Generator().manual_seed(0)).double()
    ideal = cam.undistort(view.camera, uv[None])
    back = Tracks(tracks.uv_1, ideal, tracks.error, tracks.photometric, tracks.cov, valid)
    fit = pnp_ransac(samples, back, frame.camera, cam.ideal(view.camera), draws, **_ROBUST)
    if not bool(fit.ok) or int(fit.n_inlier) < _MIN_TRACKS:
        return nothing
    return fit, se3.apply(fit.T_1_from_0, samples.xyz.nan_to_num(0.0))[0, :, 2], fit.inlier[0]
