"""A map as a COLMAP workspace: pictures in ``images/``, cameras, poses and points with tracks in ``sparse/0/``.

The layout is that of COLMAP's own workspaces, which gsplat, nerfstudio and other trainers of splats open. They take
depth from the points that a picture observes: the recovered points, the sensor's, and some of the swept ones are
written, so that these trainers get all three without further files. Most of them know no lens: pictures are written
undistorted, as ``colmap image_undistorter`` does.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data.recording import Recording
from dhtorch.export import ColmapImage, encode_png, write_colmap
from dhtorch.export.arrays import colour_to_uint8
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.integrate.recording import PairEstimate
from dhtorch.pipeline.dense import map_pixel_centres
from dhtorch.pipeline.pair import merge
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime import storage

#: Folders of the workspace.
MODEL_FOLDER, IMAGE_FOLDER = Path("sparse/0"), Path("images")

#: Files of the model.
MODEL_FILES = ("cameras.txt", "images.txt", "points3D.txt", "times.txt")

#: Largest distance, px, of an observation from the point's projection by the written poses.
#: Source: COLMAP's default for its own points (``filter_max_reproj_error`` = 4).
_MAX_REPROJECTION_PX = 4.0


class _Points(NamedTuple):
    """Points with their observations in up to two pictures."""

    xyz: Tensor  # (P, 3) m in the world
    rgb: Tensor  # (P, 3) in [0, 1]
    error: Tensor  # (P,) px
    seen_by: Tensor  # (P, 2) numbers of pictures, -1 = none
    uv: Tensor  # (P, 2, 2) px


class _ColmapCounts(NamedTuple):
    """Points of a written workspace."""

    n_points: int
    n_triangulated: int  # observed in two pictures
    n_outliers: int  # observations left out: farther than 4 px from the projection


def write_colmap_workspace(
    folder: Path, recording: Recording, answers: Sequence[PairEstimate], poses: Mapping[int, Pose]
) -> _ColmapCounts:
    """Write the pictures, cameras, poses and points of a map.

    Observations farther than 4 px from the point's projection are left out, and recovered points with a single
    observation left. Sensor and swept points may have one observation, in the picture whose depth they are.

    Args:
        folder: of the workspace.
        recording: its frames are the pictures.
        answers: estimates of pairs.
        poses: frame → T_world_from_cam (1); other frames are not written.
    """
    shots: list[ColmapImage] = []
    lenses: list[Camera] = []
    number: dict[int, int] = {}
    for k, T in poses.items():
        frame: Frame = recording[k]
        name = f"{int(recording.number[k]):06d}.png"
        picture, camera = _undistort(frame)
        storage.replace_file(folder / IMAGE_FOLDER / name, encode_png(picture))
        number[k] = len(shots)
        time = None if recording.times is None else float(recording.times[k])
        shots.append(ColmapImage(name, camera, frame.hw, T, time))
        lenses.append(frame.camera)
    placed = [answer for answer in answers if answer.pair[0] in poses]
    parts = [_sample_points(answer, shots, lenses, number) for answer in placed]
    points = [part for part, _ in parts]
    points += [_swept_points(a, recording[a.pair[0]], shots, number) for a in placed if a.swept is not None]
    empty = _Points(
        torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 2).long(), torch.zeros(0, 2, 2)
    )
    joined = _Points(*(torch.cat(column) for column in zip(*(points or [empty]), strict=True)))
    write_colmap(folder / MODEL_FOLDER, shots, joined.xyz, **{k: v for k, v in joined._asdict().items() if k != "xyz"})
    pairs = int((joined.seen_by >= 0).all(1).sum())
    return _ColmapCounts(len(joined.xyz), pairs, sum(n for _, n in parts))


def _undistort(frame: Frame) -> tuple[np.ndarray, Camera]:
    """Picture (H, W) or (H, W, 3) uint8 without distortion and without empty pixels, and its camera."""
    camera = frame.camera.to(torch.float64)
    if camera.distortion is None or not bool(camera.distortion.any()):
        return _to_pixels(frame.image[0]), cameras.ideal(frame.camera)
    h, w = frame.hw
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (h, w)), indexing="ij")
    grid = torch.stack((u, v), -1)
    ideal = cameras.undistort(camera, grid.reshape(1, -1, 2)).reshape(h, w, 2)
    low = torch.stack((ideal[:, 0, 0].max(), ideal[0, :, 1].max()))
    high = torch.stack((ideal[:, -1, 0].min(), ideal[-1, :, 1].min()))
    scale = torch.tensor([w - 1, h - 1]) / (high - low)
    lens = cameras.distort(camera, (grid / scale + low).reshape(1, -1, 2)).reshape(1, h, w, 2)
    where = 2 * lens / torch.tensor([w - 1, h - 1]) - 1
    image = frame.image.double() if frame.image.is_floating_point() else frame.image / 255
    picture = F.grid_sample(image.double(), where, align_corners=True, padding_mode="border")
    return _to_pixels(picture[0]), cameras.ideal(camera).replace(f=camera.f * scale, c=(camera.c - low) * scale)


def _to_pixels(image: Tensor) -> np.ndarray:
    """Image (C, H, W) -> (H, W) or (H, W, 3) uint8."""
    picture = colour_to_uint8(image.movedim(0, -1).cpu().numpy())
    return picture[..., 0] if picture.shape[-1] == 1 else picture


def _sample_points(
    answer: PairEstimate, shots: Sequence[ColmapImage], lenses: Sequence[Camera], number: Mapping[int, int]
) -> tuple[_Points, int]:
    """Points of the samples of one pair, and the number of observations left out."""
    merged = merge(answer.samples, answer.estimate)
    source = merged.source[0]
    views = [number[answer.pair[0]], number.get(answer.pair[1], number[answer.pair[0]])]
    world = _to_world(answer, merged.uv, merged.depth, shots[views[0]])
    tracked = [torch.ones_like(source, dtype=torch.bool), answer.tracks.valid[0] & (views[0] != views[1])]
    pixels = [
        _undistort_pixels(uv, lenses[view], shots[view])
        for uv, view in zip((merged.uv, answer.tracks.uv_1), views, strict=True)
    ]
    uv, observed = torch.stack(pixels, 1), torch.stack(tracked, 1)
    distance = torch.stack([_distance_px(world, pixels[n], shots[view]) for n, view in enumerate(views)], 1)
    agrees = observed & (distance <= _MAX_REPROJECTION_PX)
    count = agrees.sum(1)
    keep = ((source == Source.SENSOR) & agrees[:, 0]) | ((source == Source.RECOVERED) & (count == 2))
    error = torch.where(
        count == 2, torch.where(agrees, distance, 0.0).sum(1) / 2, -1.0
    )  # COLMAP's of a point without one
    seen_by = torch.where(agrees, torch.tensor(views), -1)
    outliers = int((observed & (distance > _MAX_REPROJECTION_PX))[source != Source.NONE].sum())
    return _Points(*(x[keep] for x in (world, answer.rgb[0], error, seen_by, uv))), outliers


def _swept_points(
    answer: PairEstimate, frame: Frame, shots: Sequence[ColmapImage], number: Mapping[int, int]
) -> _Points:
    """Some of the swept pixels of a reference view, evenly taken, each observed in that picture."""
    assert answer.swept is not None
    depth = answer.swept.read()[0].flatten()
    chosen = (depth > 0).nonzero()[:, 0]
    # 4000 at most, a few times the samples of a view: a map has a hundred times more than trainers start from.
    chosen = chosen[:: max(1, -(-len(chosen) // 4000))]
    uv = map_pixel_centres(frame, answer.swept.hw)[chosen]
    shot = number[answer.pair[0]]
    world = _to_world(answer, uv[None], depth[None, chosen], shots[shot])
    pixels = _undistort_pixels(uv[None], frame.camera, shots[shot])
    inside = pixels.isfinite().all(1)
    column, row = (x.clamp(0, n - 1) for x, n in zip(uv.round().long().unbind(1), frame.hw[::-1], strict=True))
    picture = frame.image[0] if frame.image.is_floating_point() else frame.image[0] / 255
    rgb = picture.expand(3, *frame.hw)[:, row, column].T.to(answer.rgb)
    points = _Points(
        world,
        rgb,
        torch.full((len(uv),), -1.0, dtype=world.dtype),
        torch.tensor([[shot, -1]]).expand(len(uv), 2),
        torch.stack((pixels, torch.full_like(pixels, torch.nan)), 1),
    )
    return _Points(*(x[inside] for x in points))


def _to_world(answer: PairEstimate, uv: Tensor, depth: Tensor, shot: ColmapImage) -> Tensor:
    """Points (P, 3) m in the world, float64."""
    return se3.apply(shot.T_world_from_cam, cameras.unproject(answer.camera, uv, depth).double())[0]


def _undistort_pixels(uv: Tensor, lens: Camera, shot: ColmapImage) -> Tensor:
    """Pixels (1, P, 2) of a frame in its undistorted picture, (P, 2) float64; NaN outside of the picture."""
    on_rays = cameras.unproject(lens.to(torch.float64), uv.double(), torch.ones_like(uv[..., 0], dtype=torch.float64))
    pixels = cameras.project(shot.camera.to(torch.float64), on_rays)[0]
    limit = torch.tensor(shot.hw[::-1], dtype=torch.float64) - 0.5
    return torch.where(((pixels > -0.5) & (pixels < limit)).all(1, keepdim=True), pixels, torch.nan)


def _distance_px(world: Tensor, uv: Tensor, shot: ColmapImage) -> Tensor:
    """Distance (P,) px of pixels from the projections of points; infinite for those behind the camera, NaN outside."""
    camera = se3.apply(se3.invert(shot.T_world_from_cam), world[None])
    distance = (cameras.project(shot.camera.to(torch.float64), camera)[0] - uv).norm(dim=-1)
    return torch.where((camera[0, :, 2] > 0) | distance.isnan(), distance, torch.inf)
