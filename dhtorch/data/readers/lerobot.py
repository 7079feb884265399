"""Reader of LeRobot data sets v3 and v2.x (parquet tables and videos); one recording per episode and camera.

``meta/info.json`` names the features. In v3 a table or a video holds many episodes, whose starts are in
``meta/episodes``; in v2 each episode has files of its own, listed in ``meta/episodes.jsonl``. A row of an episode is a
frame; its image is the video frame at the episode's start plus the row's time stamp, or is stored in the table.

The format has no place for intrinsics and poses. K comes from option ``K``, else from a feature, else from the side-car
``meta/intrinsics.json``: ``{camera key: {"K": 3×3, "dist": […], "K_depth": 3×3}}``, the last two as needed. Depth
videos have no code for *no return*, see :mod:`dhtorch.data.depth_codes`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.clocks import nearest_stamps
from dhtorch.data.codecs.parquet import read_row
from dhtorch.data.codecs.video import read_video_frame
from dhtorch.data.io import decode as files
from dhtorch.data.readers.lerobot_meta import (
    LeRobotEpisode,
    LeRobotEpisodes,
    LeRobotFeature,
    LeRobotMeta,
    read_lerobot_episodes,
    read_lerobot_meta,
    select_colour_keys,
)
from dhtorch.data.readers.lerobot_rows import (
    decode_depth_picture,
    dequantise_depth,
    find_capture_columns,
    find_depth_feature,
    find_depth_unit,
    find_origin_feature,
    find_row_stamps,
    flag_unmarked_depth,
    pair_episode_videos,
    read_capture_clock,
    read_encoded_image,
    read_row_table,
    select_episode_rows,
)
from dhtorch.data.recording import Recording, Recordings
from dhtorch.data.stored_sizes import StoredSizes
from dhtorch.records import Camera, Frame


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    meta = root / "meta"
    if (meta / "info.json").is_file() and ((meta / "episodes").is_dir() or (meta / "episodes.jsonl").is_file()):
        return "meta/info.json and meta/episodes" + ("" if (meta / "episodes").is_dir() else ".jsonl")
    return None


def read(
    root: str | Path,
    *,
    episode: int | Sequence[int] | None = None,
    camera: str | Sequence[str] | None = None,
    depth: str | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    K_depth: Sequence[float] | None = None,
    distortion: Sequence[float] | None = None,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    pose: str | None = None,
    depth_range: Sequence[float] | None = None,
    tolerance: float = 1e-4,
    recovered: bool = False,
) -> Recordings:
    """Open a data set folder, one recording for each episode and camera.

    Args:
        root: the folder that holds ``meta/``.
        episode: number or numbers of the episodes. None = all.
        camera: key or keys of colour features, such as ``observation.images.front``. None = all.
        depth: key of the depth feature. None = the one named like the camera (``…front_depth``, ``…depth.front``), or
            the only one where there is one camera; where there is none, depth is empty and the report notes it.
        K: fx, fy, cx, cy of the image. None = feature ``intrinsics``, else ``meta/intrinsics.json``.
        fov: horizontal field of view of the image in degrees, for a guessed K where none is available.
        K_depth: as ``K``, of a depth map that is not registered to colour. None = the side-car's, else as colour.
        distortion: of the image, in OpenCV's order. None = the side-car's, else none.
        intrinsics: key of a feature with 4 (fx fy cx cy) or 9 numbers a frame; or four numbers as ``K``, or one as
            ``fov``. None = ``<camera>.intrinsics``, ``observation.camera.<name>.intrinsics``,
            ``observation.<name>.intrinsics`` or ``observation.intrinsics.<name>`` where there is one.
        pose: key of a feature with the camera-to-world pose: 16 numbers (4×4 by rows) or 7 (x y z qx qy qz qw). None =
            ``<camera>.pose``, ``observation.camera.<name>.pose`` or ``observation.<name>.T_world_from_cam`` where there
            is one, else no poses.
        depth_range: m, nearest and farthest return to keep; for lossy depth videos, whose zeros are blurred with
            their surroundings. None = all.
        tolerance: s, largest distance of a video frame from its row's time.
        recovered: read also the depths that ``dhtorch enrich`` recovered, as if they were returns of the sensor.

    Returns:
        Recordings named ``<data set>/episode_<number>/<camera>``, times from the start of the episode, or numbers and
        times of the capture that ``dhtorch enrich`` wrote the set from (``observation.frame_number`` and ``.time``).
        Rows that are missing or out of order are left out and reported. A table is read when one of its episodes is
        accessed.

    Raises:
        FormatError: an unknown key or episode, or damaged metadata; on access to an episode also no K, a damaged
            table, or values that are no camera or pose.
    """
    root = Path(root)
    meta = read_lerobot_meta(root)
    span = (
        (0.0, np.inf) if depth_range is None else tuple(files.to_array(depth_range, (2,), root, "option depth_range"))
    )
    wanted = None if episode is None else [episode] if isinstance(episode, int) else [int(e) for e in episode]
    episodes = read_lerobot_episodes(meta, wanted)
    meta, remarks = flag_unmarked_depth(meta, episodes[0], depth)
    episodes = replace(episodes, meta=meta)
    keys = select_colour_keys(meta, camera)
    if camera is None:  # a feature may be declared without data
        videos = episodes[0].videos
        keys = [key for key in keys if key not in videos or videos[key][0].is_file()] or keys
    rigs, columns = [], {*find_capture_columns(meta)}
    for key in keys:
        stated = intrinsics_options.parse_intrinsics(meta.root, meta.features[key].hw, intrinsics, K, fov)
        K_key = None if stated.K is not None else _find_column(meta, key, stated.feature, "intrinsics")
        own_key = f"observation.{key.split('.')[-1]}.T_world_from_cam"
        pose_key = _find_column(meta, key, pose, "pose") or (own_key if own_key in meta.features else None)
        columns |= {column for column in (K_key, pose_key) if column}
        rigs.append(
            partial(
                _open_camera,
                meta=meta,
                key=key,
                depth_key=depth,
                stated=stated,
                K_depth=K_depth,
                distortion=distortion,
                K_key=K_key,
                pose_key=pose_key,
                remarks=remarks,
                span=span,
                tolerance=tolerance,
                recovered=recovered,
            )
        )
    names = [_name(meta, key, number) for number in episodes.numbers for key in keys]
    return Recordings(
        names, partial(_make_recording, episodes=episodes, rigs=tuple(rigs), columns=tuple(sorted(columns)))
    )


def _name(meta: LeRobotMeta, key: str, episode: int) -> str:
    return f"{meta.name}/episode_{episode:06d}/{key.rsplit('.', maxsplit=1)[-1]}"


def _find_column(meta: LeRobotMeta, key: str, option: str | None, what: str) -> str | None:
    """The feature of the option, else the one named for ``what`` of the camera; None where there is none."""
    if option is not None:
        files.refuse_if(
            option not in meta.features, meta.root, f"option {what}", option, f"one of {', '.join(meta.features)}"
        )
        return option
    camera = key.rsplit(".", maxsplit=1)[-1]
    above = f"observation.camera.{camera}", f"observation.{camera}"
    names = (f"{key}.{what}", *(f"{name}.{what}" for name in above), f"observation.{what}.{camera}")
    return next((name for name in names if name in meta.features), None)


def _make_recording(
    i: int,
    *,
    episodes: LeRobotEpisodes,
    rigs: tuple[Callable[..., Recording], ...],
    columns: tuple[str, ...],  # further columns of the tables to read
) -> Recording:
    """Position → recording: the cameras of the first episode, then those of the second, …"""
    episode = episodes[i // len(rigs)]
    return rigs[i % len(rigs)](episode, read_row_table(episode.data, columns))


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    data: Path
    root: Path
    rows: np.ndarray  # (n,) place in the table
    times: np.ndarray  # (n,) s from the start of the episode
    image: LeRobotFeature
    depth: LeRobotFeature | None
    videos: dict[str, tuple[Path, float]]
    cameras: Camera  # (n), or (1) for all
    depth_camera: Camera | None
    step_m: float | None  # metres of one step of the stored depth; None = codes of LeRobot's depth videos
    span: tuple[float, float]
    tolerance: float
    pictures: dict[str, np.ndarray]  # video's key → frame of each row; no entry = to be found by its time
    origin: LeRobotFeature | None  # map of codes.Source: depth that is not the sensor's is left out; None = all is

    def __call__(self, i: int) -> Frame:
        camera = self.cameras[i : i + 1] if self.cameras.f.shape[0] > 1 else self.cameras
        depth = torch.zeros(self.image.hw) if self.depth is None else self._depth(i, self.depth)
        if self.origin is not None:
            origin = torch.tensor(self._codes(i, self.origin))
            depth = torch.where(origin == Source.SENSOR, depth, 0.0)
        return Frame(self._image(i)[None], depth[None], camera, self.depth_camera)

    def _image(self, i: int) -> Tensor:
        if self.image.dtype == "video":
            return torch.from_numpy(self._video(i, self.image, "rgb24")).permute(2, 0, 1).contiguous()
        data, file = self._bytes(i, self.image.key)
        return torch.from_numpy(files.decode_image(data, file, self.image.hw))

    def _depth(self, i: int, feature: LeRobotFeature) -> Tensor:
        if feature.dtype == "video":
            values = self._video(i, feature, "luma")
            if self.step_m is None:
                return self._within(dequantise_depth(feature, values, self.videos[feature.key][0]))
        elif feature.dtype == "image":
            data, file = self._bytes(i, feature.key)
            values = decode_depth_picture(data, file, feature.hw)
        else:
            values = self._numbers(i, feature)
        return self._within(values.reshape(feature.hw).astype(np.float64) * (self.step_m or 1.0))

    def _codes(self, i: int, feature: LeRobotFeature) -> np.ndarray:
        """Codes (h, w) of a row, stored as an image or as numbers."""
        if feature.dtype != "image":
            return self._numbers(i, feature)
        data, file = self._bytes(i, feature.key)
        return files.decode_image(data, file, feature.hw)[0]

    def _numbers(self, i: int, feature: LeRobotFeature) -> np.ndarray:
        """Numbers (h, w) of a row, stored as an array."""
        values = np.asarray(read_row(self.data, (feature.key,), int(self.rows[i]))[feature.key])
        files.refuse_if(
            values.size != feature.hw[0] * feature.hw[1] or values.dtype.kind not in "fiu",
            self.data,
            feature.key,
            f"shape {values.shape}",
            f"{feature.hw} numbers",
        )
        return values.reshape(feature.hw)

    def _within(self, depth: np.ndarray) -> Tensor:
        low, high = self.span
        keep = np.isfinite(depth) & (depth > 0) & (depth >= low) & (depth <= min(high, 1e6))
        return torch.from_numpy(np.where(keep, depth, 0).astype(np.float32))

    def _video(self, i: int, feature: LeRobotFeature, pixels: str) -> np.ndarray:
        file, start = self.videos[feature.key]
        if feature.key in self.pictures:
            return read_video_frame(file, int(self.pictures[feature.key][i]), feature.hw, pixels=pixels)
        times, targets = find_row_stamps(file, start, self.times[i : i + 1])
        nearest = int(nearest_stamps(targets, times, np.inf)[0])
        if abs(times[nearest] - targets[0]) > self.tolerance:
            problem = f"nearest frame at {times[nearest]:.6f} s"
            raise files.FormatError(file, f"time {targets[0]:.6f} s", problem, f"one within {self.tolerance} s")
        return read_video_frame(file, nearest, feature.hw, pixels=pixels)

    def _bytes(self, i: int, key: str) -> tuple[bytes, Path]:
        return read_encoded_image(self.data, self.root, key, int(self.rows[i]))


def _open_camera(
    episode: LeRobotEpisode,
    table: dict[str, np.ndarray],
    *,
    meta: LeRobotMeta,
    key: str,
    depth_key: str | None,
    stated: intrinsics_options.ParsedIntrinsics,
    K_depth: Sequence[float] | None,
    distortion: Sequence[float] | None,
    K_key: str | None,  # feature with K; None where K comes from elsewhere
    pose_key: str | None,
    remarks: tuple[str, ...],  # about the data set, for the report
    span: tuple[float, float],
    tolerance: float,
    recovered: bool,
) -> Recording:
    """The recording of a camera in an episode."""
    image = meta.features[key]
    rows, numbers, times, report = select_episode_rows(meta, episode, table)
    report += stated.report
    report += remarks
    depth = find_depth_feature(meta, key, depth_key)
    unit = None if depth is None else find_depth_unit(meta, depth, episode, int(rows[0]))
    if depth is None:
        report.append(f"{key}: no depth feature: depth is empty")
    origin = None if recovered or depth is None else find_origin_feature(meta, key, depth)
    if origin is not None:
        report.append("depths that dhtorch enrich recovered are left out (data.recovered=true reads them)")
    videos = {f.key: episode.videos[f.key] for f in (image, depth) if f is not None and f.dtype == "video"}
    has_picture, pictures, unpaired = pair_episode_videos(videos, numbers, times, tolerance)
    rows, numbers, times, report = rows[has_picture], numbers[has_picture], times[has_picture], report + unpaired
    values = None if K_key is None else table[K_key][rows]
    cameras, depth_camera = _read_cameras(meta, key, (K_key, values), depth, stated, options=(K_depth, distortion))
    poses = None
    if pose_key is not None:
        poses = convert.parse_poses(table[pose_key][rows], episode.data, pose_key)
    load = _Load(
        data=episode.data,
        root=meta.root,
        rows=rows,
        times=times,
        image=image,
        depth=depth,
        videos=videos,
        cameras=cameras,
        depth_camera=depth_camera,
        step_m=None if unit is None else unit.metres,
        span=span,
        tolerance=tolerance,
        pictures=pictures,
        origin=origin,
    )
    numbers, clock = read_capture_clock(meta, table, rows, numbers, times)
    return Recording(
        name=_name(meta, key, episode.number),
        format="lerobot",
        load=load,
        number=torch.from_numpy(numbers),
        root=meta.root,
        times=None if clock is None else torch.from_numpy(clock),
        poses=poses,
        rate_hz=None if clock is None else meta.fps,
        report=tuple(report),
        episode=episode.number,
        camera_name=key,
        depth_unit=unit,
        stored=StoredSizes(image.hw, None if depth is None or depth_camera is not None else depth.hw),
    )


def _read_cameras(
    meta: LeRobotMeta,
    key: str,
    column: tuple[str | None, np.ndarray | None],  # feature with K and its values in the rows
    depth: LeRobotFeature | None,
    stated: intrinsics_options.ParsedIntrinsics,
    *,
    options: tuple[Sequence[float] | None, Sequence[float] | None],  # K_depth, distortion
) -> tuple[Camera, Camera | None]:
    """Camera of the image (n, or 1 for all) and of a depth map with a K of its own."""
    (K_depth, distortion), root, hw = options, meta.root, meta.features[key].hw
    side_car = root / "meta" / "intrinsics.json"
    entry = files.read_json(side_car).get(key, {}) if side_car.is_file() else {}
    files.refuse_if(not isinstance(entry, dict), side_car, key, type(entry).__name__, "an object with K")
    distortion = distortion if distortion is not None else entry.get("dist")
    depth_camera = None
    if depth is not None and (K_depth is not None or entry.get("K_depth") is not None):
        value = convert.parse_K_option(K_depth, root, "option K_depth") if K_depth is not None else entry["K_depth"]
        depth_camera = convert.to_camera(value, depth.hw, side_car, "K_depth")
    if stated.K is not None:
        K = convert.make_K(*stated.K)
        return convert.to_camera(K, hw, root, "option K", distortion), depth_camera
    name, values = column
    if name is not None and values is not None:
        return convert.to_cameras(values, hw, root / "data", name, distortion), depth_camera
    if "K" not in entry:
        others = "data.intrinsics=FEATURE", "meta/intrinsics.json"
        raise intrinsics_options.missing_intrinsics_error(root, key, *others, depth=depth is not None)
    return convert.to_camera(entry["K"], hw, side_car, f"{key} K", distortion), depth_camera
