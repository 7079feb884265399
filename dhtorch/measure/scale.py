"""RGB-D frames and a reconstruction of the same scene -> the reconstruction's size in metres, or where it is bent.

    model's pictures ─┐                 ┌─ same picture: depths of one pixel ──────────┐
                      ├─ match views ──┤                                              ├─ local scales ─ scale ± U
    capture's frames ─┘                 └─ other picture: tracks, pose of near returns ┘                └ faults

The sensor's returns are the ruler. A view and a frame that are the same picture are compared pixel by pixel; else the
view is tracked into the frame, and near returns give its pose relative to the frame in metres. Where the capture has
poses, the rigid part of the similarity follows from the cameras; the size never does.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Flag
from dhtorch.data.io.decode import read_image
from dhtorch.data.io.safe_open import record_opened_files
from dhtorch.data.models import ModelView, SceneModel, Similarity, read_model
from dhtorch.data.recording import Recording
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
from dhtorch.records import Camera, Frame, Pose, Samples, Tracks
from dhtorch.stages.backproject import backproject
from dhtorch.stages.pose import pnp_ransac
from dhtorch.stages.sample import regular_grid
from dhtorch.stages.track import lucas_kanade

_Chosen = TypeVar("_Chosen")

#: Relative standard deviation of the scale of a sensor of no stated class. Source: derived, the default ``sigma_rel``
#: of a return in :func:`dhtorch.stages.backproject.backproject`.
_UNSTATED_SENSOR_SIGMA = 0.01

#: Longer side of the pictures that are compared, px. Source: origin not recorded.
_COMPARED_PX = 320

#: Correlation of small pictures from which two may be of the same place. Source: origin not recorded.
_MIN_CORRELATION = 0.4

#: Median displacement of tracks between two pictures below which they are one, in px of ``_COMPARED_PX``. Source:
#: derived, 1/8: neighbouring frames of a hand-held video at 30 Hz move by more.
_SAME_PICTURE_PX = 0.125

#: Fewest tracks of a registration, and fewest matched frames that can show a fault. Source: origin not recorded.
_MIN_TRACKS, _MIN_FRAMES = 40, 3

#: A model point is seen in a picture unless another one is nearer by this fraction within a cell of so many cells
#: across. Source: origin not recorded.
_OCCLUSION_REL, _OCCLUSION_CELLS = 0.05, 48

#: Flags of returns that are no part of the ruler.
_UNCLEAN = Flag.DEPTH_EDGE | Flag.BORDER


@dataclass(frozen=True)
class ScaleOptions:
    """How :func:`metric_scale` measures."""

    n: int = 800  # places in a picture that are compared
    max_frames: int = 60  # views compared at most, evenly spread
    candidates: int = 2  # frames tried for a view that is no frame's picture
    edge_rel: float = 0.1  # spread of the returns around a place from which it counts as an edge, left out
    min_conf: int = 1  # of the sensor, 0 to 2
    tolerance: ScaleTolerance = DEFAULT_SCALE_TOLERANCE


#: The options of :func:`metric_scale` unless others are given.
DEFAULT_SCALE_OPTIONS: Final = ScaleOptions()


class ViewMatch(NamedTuple):
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
    matches: list[ViewMatch]  # (F,)
    names: list[str]  # (F,) of the views
    R: np.ndarray | None = None  # (3, 3) capture's world from model's; None = the capture has no poses
    t: np.ndarray | None = None  # (3,) m
    cov: np.ndarray | None = None  # (7, 7) of rotation (rad, on the left), translation (m) and log(scale)
    trajectory_scale: tuple[float, float] | None = None  # that of the camera paths alone and its relative sigma
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

    share: np.ndarray  # (N, 2)
    depth: np.ndarray  # (N,) m
    model_depth: np.ndarray  # (N,)
    xyz: np.ndarray  # (N, 3) model's world
    T_view_from_frame: np.ndarray  # (4, 4) metric


def metric_scale(
    model: SceneModel | str | Path,
    frames: Recording | Sequence[Frame],
    *,
    names: Sequence[str] | None = None,
    sensor: str | Sequence[float] | None = None,
    cutoff: float | None = None,
    options: ScaleOptions = DEFAULT_SCALE_OPTIONS,
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
        options: how to measure.

    Returns:
        ``scale`` with ``sigma``; ``faults`` where parts of the model have another scale than the rest: then no single
        scale is right, and that of the whole is only a mean. ``R``, ``t`` and ``cov`` where the capture has poses.

    Raises:
        ValueError: no view of the model can be matched with a frame, or too few returns lie on the model.
    """
    model = model if isinstance(model, SceneModel) else read_model(model)
    names = list(names) if names is not None else _picture_names(frames)
    matches, notes = _match_views(model, frames, names, options)
    pairs, used = [], []
    for match in matches:
        measured = _measure(model, model.views[match.view], frames[match.frame], match, cutoff, options)
        if measured is not None:
            pairs.append(measured)
            used.append(match)
    index = np.concatenate([np.full(len(p.depth), k) for k, p in enumerate(pairs)]) if pairs else np.zeros(0, int)
    columns = [np.concatenate(each) for each in zip(*(p[:4] for p in pairs), strict=True)] if pairs else []
    local = local_scales(index, *columns) if pairs else None
    if local is None or len(local.log) == 0:
        raise ValueError(
            f"{model.root}: found too few sensor returns on the model's points, expected frames that see it"
        )
    mean, scatter, frame_log, frame_sigma = estimate_scale(local, len(used))
    view_names = [model.views[match.view].name for match in used]
    faults, gradients = find_faults(local, view_names, options.tolerance)
    if len(used) < _MIN_FRAMES:
        notes.append(f"only {len(used)} view(s) matched: a bend or a drift of the model would not be seen")
    bend = max((abs(g.change) for g in gradients if abs(g.change) > g.sigma), default=0.0)
    terms = {"frames": scatter, "sensor": _sensor_sigma(sensor, float(np.median(local.depth))), "model": bend / 12**0.5}
    result = ScaleResult(
        scale=float(np.exp(mean)),
        sigma=float(np.sqrt(sum(term**2 for term in terms.values()))),
        terms=terms,
        faults=faults,
        gradients=gradients,
        local=local,
        frame_log=frame_log,
        frame_sigma=frame_sigma,
        matches=used,
        names=view_names,
        notes=notes,
    )
    return _place(result, model, frames, pairs)


def _sensor_sigma(sensor: str | Sequence[float] | None, depth: float) -> float:
    """Relative standard deviation of a sensor's own scale at a depth, m."""
    if sensor is None:
        return _UNSTATED_SENSOR_SIGMA
    return float(get_sensor_noise(sensor)(torch.tensor(depth, dtype=torch.float64))) / depth


# ------------------------------------------------------------------------------------------------------------ matching


def _picture_names(frames: Recording | Sequence[Frame]) -> list[str] | None:
    """File names of the frames' pictures; None where frames are no files of their own."""
    if not isinstance(frames, Recording):
        return None
    names = []
    for i in range(len(frames)):
        with record_opened_files() as opened:
            _ = frames[i].image
        pictures = [f for f in opened if f.suffix.lower() in (".png", ".jpg", ".jpeg") and "depth" not in f.parent.name]
        pictures = [f for f in pictures if "conf" not in f.parent.name]
        if len(pictures) != 1:
            return None
        names.append(pictures[0].name)
    return names


def _match_views(
    model: SceneModel, frames: Recording | Sequence[Frame], names: Sequence[str] | None, options: ScaleOptions
) -> tuple[list[ViewMatch], list[str]]:
    """Views with the frames that measure them, evenly spread and in the order of the frames, and notes.

    Equal names are one picture unless the model's picture differs from the frame's. Without equal names pictures are
    compared.
    """
    by_name = {Path(name).stem: k for k, name in reversed(list(enumerate(names or ())))}
    named = [(k, by_name.get(Path(view.name).stem)) for k, view in enumerate(model.views)]
    matches = [ViewMatch(k, f, is_same=True) for k, f in named if f is not None]
    matches = _spread(sorted(matches, key=lambda m: m.frame), options.max_frames)
    checked = [_is_same(model.views[m.view], frames[m.frame]) for m in matches]
    same = [m for m, ok in zip(matches, checked, strict=True) if ok is not False]
    if len(same) >= min(_MIN_FRAMES, len(model.views)):
        notes = [] if any(checked) else ["the model's pictures are not there: views were matched by name alone"]
        return same, notes
    with_picture = [k for k, view in enumerate(model.views) if view.image is not None]
    if not with_picture:
        raise ValueError(
            f"{model.root}: found no picture of the model and no view named as a frame of the capture, expected its "
            "pictures (images=FOLDER) or names of views that are those of frames"
        )
    return _match_by_content(model, frames, _spread(with_picture, options.max_frames), options), []


def _spread(items: Sequence[_Chosen], most: int) -> list[_Chosen]:
    """At most ``most`` items, evenly spread."""
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))]


def _small(image: Tensor) -> Tensor:
    """Picture (1, C, H, W) -> grey (1, 1, h, w) with the longer side ``_COMPARED_PX`` or less."""
    factor = min(1.0, _COMPARED_PX / max(image.shape[-2:]))
    hw = [max(32, round(s * factor)) for s in image.shape[-2:]]
    return torch.nn.functional.interpolate(grayscale(image), hw, mode="area")


def _is_same(view: ModelView, frame: Frame) -> bool | None:
    """Whether a view's picture is the frame's, at any size; None = the view's picture is not there."""
    if view.image is None:
        return None
    a = _small(torch.from_numpy(read_image(view.image))[None])
    b = torch.nn.functional.interpolate(_small(frame.image), a.shape[-2:], mode="area")
    uv = regular_grid((a.shape[-2], a.shape[-1]), 150, margin_px=12.0)[None]
    tracks = lucas_kanade(a, b, uv, levels=3, normalise="gain_bias")
    valid = tracks.valid[0]
    if int(valid.sum()) < 10:
        return False
    moved = (tracks.uv_1 - tracks.uv_0)[0][valid].norm(dim=-1)
    return bool(moved.median() < _SAME_PICTURE_PX)


def _match_by_content(
    model: SceneModel, frames: Recording | Sequence[Frame], views: Sequence[int], options: ScaleOptions
) -> list[ViewMatch]:
    """Views with the frames whose pictures are most similar, the same picture where there is one."""
    chosen = _spread(range(len(frames)), 4 * options.max_frames)
    of_frames = torch.stack([_thumbnail(frames[i].image) for i in chosen])
    matches = []
    for k in views:
        image = model.views[k].image
        assert image is not None
        alike = of_frames @ _thumbnail(torch.from_numpy(read_image(image))[None])
        order = alike.argsort(descending=True)[: options.candidates].tolist()
        best = [chosen[i] for i in order if alike[i] > _MIN_CORRELATION]
        same = [i for i in best if _is_same(model.views[k], frames[i])]
        matches += [ViewMatch(k, i, is_same=bool(same)) for i in (same[:1] or best[:1])]
    return sorted(matches, key=lambda m: m.frame)


def _thumbnail(image: Tensor) -> Tensor:
    """Picture (1, C, H, W) -> normalised grey values (768,) of a thumbnail."""
    x = torch.nn.functional.interpolate(grayscale(image), (24, 32), mode="area").flatten().float()
    x = x - x.mean()
    return x / x.norm().clamp_min(1e-6)


# ----------------------------------------------------------------------------------------------------------- measuring


def _measure(
    model: SceneModel, view: ModelView, frame: Frame, match: ViewMatch, limit: float | None, options: ScaleOptions
) -> _Pairs | None:
    """Depths of places of a view in metres and in the model's units; None where too few are comparable."""
    frame = frame.to(torch.float64)
    uv, model_depth = _model_depths(model, view, options.n)
    if len(uv) < _MIN_TRACKS // 2:
        return None
    if match.is_same:
        at = _same_pixels(view, frame, uv)
        samples = _returns(frame, at, limit, options)
        identity = np.eye(4)
        depth, ok = samples.depth[0], _is_clean(samples)
        return _select(view, uv, depth, model_depth, ok, identity)
    return _measure_by_tracks(view, frame, uv, model_depth, limit, options)


def _model_depths(model: SceneModel, view: ModelView, n: int) -> tuple[Tensor, Tensor]:
    """Pixels (N, 2) of a view, of K's size, with a depth (N,) of the model there."""
    if view.depth is not None:
        uv = regular_grid(view.hw, n, dtype=torch.float64)
        at = cam.resize_pixels(uv, view.hw, (view.depth.shape[0], view.depth.shape[1]))
        depth = sample_nearest(torch.from_numpy(view.depth)[None], at[None])[0][0].double()
        return uv[depth > 0], depth[depth > 0]
    seen = slice(None) if view.point is None else view.point
    xyz = model.xyz[seen]
    local = (xyz - view.c2w[:3, 3]) @ view.c2w[:3, :3]
    z = torch.from_numpy(local[:, 2])
    camera = _camera_of(view)
    if view.uv is None:
        uv = cam.project(cam.ideal(camera), torch.from_numpy(np.where(local[:, 2:] > 0, local, 1.0))[None])
        uv = cam.distort(camera, uv)[0]
        keep = _unoccluded(uv, z, view.hw)
    else:
        uv, keep = torch.from_numpy(np.array(view.uv)), z > 0
    index = keep.nonzero()[:, 0]
    index = index[torch.linspace(0, max(len(index) - 1, 0), min(len(index), n)).round().long()]
    return uv[index].double(), z[index].double()


def _unoccluded(uv: Tensor, z: Tensor, hw: tuple[int, int]) -> Tensor:
    """Points (N,) inside a picture that are not behind others in their cell."""
    size = max(hw) / _OCCLUSION_CELLS
    inside = (z > 0) & (uv >= 0).all(-1) & (uv[:, 0] <= hw[1] - 1) & (uv[:, 1] <= hw[0] - 1)
    cell = (uv.nan_to_num(-1.0) / size).long()
    key = torch.where(inside, cell[:, 1] * (_OCCLUSION_CELLS + 1) + cell[:, 0], 0).clamp_min(0)
    nearest = torch.full((int(key.max()) + 1 if len(key) else 1,), torch.inf, dtype=z.dtype)
    nearest.scatter_reduce_(0, key[inside], z[inside], "amin")
    return inside & (z <= (1 + _OCCLUSION_REL) * nearest[key])


def _camera_of(view: ModelView) -> Camera:
    K = torch.from_numpy(np.array(view.K, np.float64))[None]
    lens = None if view.distortion is None else torch.tensor([view.distortion], dtype=torch.float64)
    return cam.from_matrix(K, lens)


def _same_pixels(view: ModelView, frame: Frame, uv: Tensor) -> Tensor:
    """Pixels (1, N, 2) of a frame for those of a view that is the same picture, resized or cut."""
    if abs(view.hw[0] * frame.hw[1] / (view.hw[1] * frame.hw[0]) - 1) < 0.01:
        return cam.resize_pixels(uv, view.hw, frame.hw)[None]
    ideal = cam.undistort(_camera_of(view), uv[None])
    camera = cam.ideal(_camera_of(view))
    rays = cam.unproject(camera, ideal, torch.ones(1, len(uv), dtype=torch.float64))
    return cam.distort(frame.camera, cam.project(cam.ideal(frame.camera), rays))


def _returns(frame: Frame, at: Tensor, limit: float | None, options: ScaleOptions) -> Samples:
    return backproject(frame, at, near_limit=limit, min_conf=options.min_conf, edge_rel=options.edge_rel)


def _is_clean(samples: Samples) -> Tensor:
    """Returns (N,) within range, away from edges of depth and of the picture."""
    return samples.usable[0] & (samples.flag[0] & _UNCLEAN == 0)


def _select(
    view: ModelView, uv: Tensor, depth: Tensor, model_depth: Tensor, ok: Tensor, T: np.ndarray
) -> _Pairs | None:
    if int(ok.sum()) < _MIN_TRACKS // 2:
        return None
    uv, depth, model_depth = uv[ok], depth[ok], model_depth[ok]
    ideal = cam.undistort(_camera_of(view), uv[None])
    xyz = cam.unproject(cam.ideal(_camera_of(view)), ideal, model_depth[None])[0].numpy()
    share = ((uv + 0.5) / torch.tensor([view.hw[1], view.hw[0]])).clamp(0, 1 - 1e-9).numpy()
    world = xyz @ view.c2w[:3, :3].T + view.c2w[:3, 3]
    return _Pairs(share, depth.numpy(), model_depth.numpy(), world, T)


def _measure_by_tracks(
    view: ModelView, frame: Frame, uv: Tensor, model_depth: Tensor, limit: float | None, options: ScaleOptions
) -> _Pairs | None:
    """As :func:`_measure`, of a view that is no frame's picture: its places are tracked into the frame."""
    if view.image is None:
        return None
    picture = torch.from_numpy(read_image(view.image))[None].double() / 255
    own_hw = (picture.shape[-2], picture.shape[-1])
    start = cam.resize_pixels(uv, view.hw, own_hw)[None]
    image = frame.image.double() / (255 if frame.image.dtype == torch.uint8 else 1)
    with torch.no_grad():
        tracks = lucas_kanade(picture, image, start, levels=5, normalise="gain_bias", start=coarse_flow)
        samples = _returns(frame, tracks.uv_1, limit, options)
        valid = tracks.valid & _is_clean(samples)[None]
        if int(valid.sum()) < _MIN_TRACKS:
            return None
        camera = _camera_of(view)
        draws = torch.rand(1, 128, 3, generator=torch.Generator().manual_seed(0)).double()
        ideal = cam.undistort(camera, uv[None])
        back = Tracks(tracks.uv_1, ideal, tracks.error, tracks.photometric, tracks.cov, valid)
        fit = pnp_ransac(samples, back, frame.camera, cam.ideal(camera), draws, threshold_px=2.0)
        if not bool(fit.ok) or int(fit.n_inlier) < _MIN_TRACKS:
            return None
        depth = se3.apply(fit.T_1_from_0, samples.xyz.nan_to_num(0.0))[0, :, 2]
    return _select(view, uv, depth, model_depth, fit.inlier[0], se3.to_matrix(fit.T_1_from_0)[0].numpy())


# ------------------------------------------------------------------------------------------------------------- placing


def _place(
    result: ScaleResult, model: SceneModel, frames: Recording | Sequence[Frame], pairs: Sequence[_Pairs]
) -> ScaleResult:
    """The result with the rigid part of the similarity from the cameras, where the capture has poses."""
    poses = [_pose_of(frames, match.frame) for match in result.matches]
    if any(pose is None for pose in poses) or len(poses) < _MIN_FRAMES:
        return result
    own = np.stack([p @ np.linalg.inv(q.T_view_from_frame) for p, q in zip(poses, pairs, strict=True) if p is not None])
    of_model = np.stack([model.views[match.view].c2w for match in result.matches])
    turns = own[:, :3, :3] @ of_model[:, :3, :3].transpose(0, 2, 1)
    u, _, vt = np.linalg.svd(np.median(turns, 0))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turned = result.scale * of_model[:, :3, 3] @ R.T
    offset = own[:, :3, 3] - turned
    t = np.median(offset, 0)
    rest = turns @ R.T
    omega = se3.log(Pose(torch.from_numpy(rest), torch.zeros(len(rest), 3, dtype=torch.float64)))[:, :3].numpy()
    cov = np.zeros((7, 7))
    cov[:3, :3], cov[6, 6] = _covariance_of_mean(omega), result.sigma**2
    centre = turned.mean(0)
    lever = np.concatenate((se3.hat(torch.from_numpy(centre)).numpy(), np.zeros((3, 3)), -centre[:, None]), 1)
    cov[3:6] = lever @ cov
    cov[:, 3:6] = cov[3:6].T
    cov[3:6, 3:6] = lever[:, [0, 1, 2, 6]] @ cov[np.ix_([0, 1, 2, 6], [3, 4, 5])] + _covariance_of_mean(offset)
    return replace(result, R=R, t=t, cov=cov, trajectory_scale=_trajectory_scale(own[:, :3, 3], of_model[:, :3, 3]))


def _pose_of(frames: Recording | Sequence[Frame], i: int) -> np.ndarray | None:
    """(4, 4) camera to world of a frame; None where it has none."""
    if isinstance(frames, Recording):
        pose = None if frames.poses is None else frames.poses[i : i + 1]
    else:
        pose = frames[i].T_world_from_cam
    if pose is None or not bool(pose.t.isfinite().all()):
        return None
    return se3.to_matrix(pose.map(lambda x: x.double()))[0].numpy()


def _covariance_of_mean(x: np.ndarray) -> np.ndarray:
    """Covariance (n, n) of the mean of rows (F, n) whose errors last over an eighth of them."""
    means = np.stack([part.mean(0) for part in np.array_split(x, min(8, len(x)))])
    return np.cov(means.T) / len(means)


def _trajectory_scale(own: np.ndarray, of_model: np.ndarray) -> tuple[float, float] | None:
    """Metres per unit by the camera paths alone and its relative sigma: distances of views a half of the path apart."""
    half = len(own) // 2
    a, b = (np.linalg.norm(c[half:] - c[: len(c) - half], axis=1) for c in (own, of_model))
    ok = (a > 0) & (b > 0)
    if ok.sum() < _MIN_FRAMES:
        return None
    ratio = np.log(a[ok] / b[ok])
    return float(np.exp(np.median(ratio))), float(1.4826 * np.median(np.abs(ratio - np.median(ratio))))
