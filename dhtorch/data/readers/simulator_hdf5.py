"""Reader of simulators' demonstrations in HDF5: robomimic (robosuite), ManiSkill 3 and ManiSkill 2.

- *robomimic*: ``data/demo_<k>/obs/<camera>_image`` (T, H, W, 3) and ``<camera>_depth`` (T, H, W, 1) in metres; the
  attribute ``camera_info`` of a demonstration holds K and, for a camera that stands, its pose.
- *ManiSkill 3*: ``traj_<k>/obs/sensor_data/<camera>/{rgb,depth}``, depth in mm, and
  ``sensor_param/<camera>/{intrinsic_cv,extrinsic_cv,cam2world_gl}`` of every step.
- *ManiSkill 2*: the same in ``obs/image`` and ``obs/camera_param``, depth in 1/1024 m.

Every episode and camera is a recording. Pictures are left as stored: robosuite renders upside down, robomimic turns
pictures and depth upright before it writes them. K of these renderers counts from the corner of the first pixel; half a
pixel is subtracted. There are no times: steps of a simulation have no clock.

Depth of a z-buffer, none of whose values exceeds 1, is converted where the planes of the renderer are set by
``clip_planes``: z = near / (1 - d (1 - near / far)), as MuJoCo's.
"""

import json
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.codecs.hdf5 import Hdf5Array, list_hdf5_group, read_hdf5_text
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording, Recordings, consecutive_frame_numbers
from dhtorch.data.units import DepthUnit
from dhtorch.records import Camera, Frame, Pose

_SUFFIXES: Final = (".h5", ".hdf5")
_EPISODE: Final = re.compile(r"(?:demo|traj|episode)_(\d+)")
_CODES_PER_METRE: Final = 1000.0  # of whole numbers: millimetres. Source: ManiSkill 3, sensor_data depth


def recognise(root: Path) -> str | None:
    """The content by which ``root`` is recognised as this format, as text; None if it is not."""
    if root.suffix.lower() not in _SUFFIXES or not root.is_file():
        return None
    try:
        episodes = _list_episodes(root)
        cameras = _list_cameras(root, episodes[0]) if episodes else []
    except files.FormatError:
        return None
    return f"HDF5 episodes {episodes[0]} … with depth of {cameras[0].name}" if cameras else None


def read(
    root: str | Path,
    *,
    camera: str | Sequence[str] | None = None,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    clip_planes: Sequence[float] | None = None,
) -> Recordings:
    """Open one file.

    Args:
        root: the ``.h5`` or ``.hdf5`` file.
        camera: names of cameras. None = all with depth.
        intrinsics, K, fov: where the file has no K, or instead of it; see :mod:`dhtorch.data.intrinsics`.
        clip_planes: distances (m) of the near and the far plane of the renderer: depth is a z-buffer.

    Returns:
        One recording for each episode and camera.

    Raises:
        FormatError: no episode, no camera with depth, no K, or a damaged file.
        ImportError: no decoder of HDF5 is installed.
    """
    root = Path(root)
    episodes = _list_episodes(root)
    files.refuse_if(not episodes, root, "episodes", "none", "data/demo_<k> or traj_<k>")
    cameras = [entry.name for entry in _list_cameras(root, episodes[0])]
    files.refuse_if(
        not cameras, root, episodes[0], "no camera with depth", "obs/<camera>_depth or sensor_data/<camera>/depth"
    )
    chosen = cameras if camera is None else [camera] if isinstance(camera, str) else list(camera)
    files.refuse_if(
        unknown := [name for name in chosen if name not in cameras],
        root,
        "option camera",
        ", ".join(unknown),
        f"among {', '.join(cameras)}",
    )
    planes = None if clip_planes is None else files.to_array(clip_planes, (2,), root, "option clip_planes")
    if planes is not None and not 0 < planes[0] < planes[1]:
        raise files.FormatError(root, "option clip_planes", planes.tolist(), "0 < near < far")
    entries = [(episode, name) for episode in episodes for name in chosen]
    names = [f"{root.stem}/{episode.rpartition('/')[2]}/{name}" for episode, name in entries]
    return Recordings(
        names,
        partial(
            _make_recording,
            file=root,
            entries=tuple(entries),
            names=tuple(names),
            K_options=(intrinsics, K, fov),
            planes=planes,
        ),
    )


class _Arrays(NamedTuple):
    """Arrays of a camera in an episode."""

    name: str
    image: Hdf5Array
    depth: Hdf5Array
    K: Hdf5Array | None
    w2c: Hdf5Array | None  # OpenCV's axes
    c2w_gl: Hdf5Array | None
    codes_per_metre: float  # of depth in whole numbers
    layout: str


def _make_recording(
    i: int,
    *,
    file: Path,
    entries: tuple[tuple[str, str], ...],  # (path of the episode, camera)
    names: tuple[str, ...],
    K_options: tuple[intrinsics_options.IntrinsicsOption | None, Sequence[float] | None, float | None],
    planes: np.ndarray | None,
) -> Recording:
    """Position → recording."""
    episode, name = entries[i]
    arrays = next((entry for entry in _list_cameras(file, episode) if entry.name == name), None)
    if arrays is None:
        raise files.FormatError(file, episode, f"no depth of {name}", "that of the first episode's cameras")
    n, hw = _check_shapes(arrays)
    info = _read_camera_info(file, episode, name)
    camera, guess = intrinsics_options.parse_camera(file, hw, *K_options)
    if camera is None and (array := arrays.K) is not None:
        files.refuse_if(array.shape[1:] != (3, 3), array.file, array.key, f"an array of {array.shape}", "steps x 3 x 3")
        matrices = _to_pixel_centres(_read_rows(array, n))
        camera = convert.to_cameras(matrices, hw, array.file, array.key, None)
    elif camera is None and "intrinsics" in info:
        camera = convert.to_camera(_to_pixel_centres(info["intrinsics"]), hw, file, "camera_info intrinsics")
    if camera is None:
        raise intrinsics_options.missing_intrinsics_error(file, name)
    is_whole = arrays.depth.dtype.kind in "iu"
    load = partial(
        _load_frame,
        arrays=arrays,
        hw=hw,
        camera=camera,
        metres=1 / arrays.codes_per_metre if is_whole else 1.0,
        planes=planes,
    )
    # of an episode's number: more do not fit into 64 bits
    number = int(episode.rpartition("_")[2][:18])
    return Recording(
        name=names[i],
        format="simulator_hdf5",
        load=load,
        number=consecutive_frame_numbers(n),
        root=file,
        poses=_read_poses(arrays, n, info),
        episode=number,
        camera_name=name,
        report=guess,
        depth_unit=DepthUnit(1 / arrays.codes_per_metre, f"{arrays.layout}: definition of its depth")
        if is_whole
        else None,
    )


def _load_frame(
    i: int,
    *,
    arrays: _Arrays,
    hw: tuple[int, int],
    camera: Camera,  # one, or one for each step
    metres: float,
    planes: np.ndarray | None,
) -> Frame:
    """Position → frame."""
    image = arrays.image.row(i)
    depth = arrays.depth.row(i).reshape(arrays.depth.shape[1:3])
    if planes is not None:
        near, far = planes
        with np.errstate(divide="ignore", invalid="ignore"):
            metric = np.where(depth < 1, near / (1 - depth.astype(np.float64) * (1 - near / far)), 0.0)
    else:
        metric = files.to_metres(depth, 1 / metres) if depth.dtype.kind in "iu" else depth
    metric = metric.astype(np.float32)
    with np.errstate(invalid="ignore"):
        metric = np.where(np.isfinite(metric) & (metric > 0), metric, np.float32(0))
    camera = camera if camera.f.shape[0] == 1 else camera[i : i + 1]
    if image.dtype != np.uint8:  # numbers from 0 to 1
        image = (np.nan_to_num(image.astype(np.float32)) * 255).clip(0, 255).round().astype(np.uint8)
    picture = torch.from_numpy(np.ascontiguousarray(image[..., :3].transpose(2, 0, 1)))
    return Frame(picture[None], torch.from_numpy(metric)[None], camera)


# --------------------------------------------------------------------------------------------------------------- file


def _list_episodes(file: Path) -> list[str]:
    """Paths of the episodes in numerical order."""
    top = list_hdf5_group(file)
    inside = "data/" if top.get("data", 0) is None else ""
    names = list_hdf5_group(file, "data") if inside else top
    episodes = [name for name, array in names.items() if array is None and _EPISODE.fullmatch(name)]
    return [f"{inside}{name}" for name in sorted(episodes, key=files.natural_sort_key)]


def _list_cameras(file: Path, episode: str) -> list[_Arrays]:
    """Cameras of an episode that have pictures and depth."""
    if list_hdf5_group(file, episode).get("obs", 0) is not None:
        return []
    obs = list_hdf5_group(file, f"{episode}/obs")
    # Source: ManiSkill 2, RecordEpisode
    for data, parameters, codes, layout in (
        ("sensor_data", "sensor_param", _CODES_PER_METRE, "ManiSkill 3"),
        ("image", "camera_param", 1024.0, "ManiSkill 2"),
    ):
        if obs.get(data, 0) is None:
            path, cameras = f"{episode}/obs", []
            stated = list_hdf5_group(file, f"{path}/{parameters}") if obs.get(parameters, 0) is None else {}
            for name, group in list_hdf5_group(file, f"{path}/{data}").items():
                arrays = {} if group is not None else list_hdf5_group(file, f"{path}/{data}/{name}")
                image, depth = arrays.get("rgb") or arrays.get("Color"), arrays.get("depth")
                if image is None or depth is None:
                    continue
                values = list_hdf5_group(file, f"{path}/{parameters}/{name}") if name in stated else {}
                intrinsic, extrinsic, model = (values.get(k) for k in ("intrinsic_cv", "extrinsic_cv", "cam2world_gl"))
                cameras.append(_Arrays(name, image, depth, intrinsic, extrinsic, model, codes, layout))
            return cameras
    cameras = []
    for key, depth in obs.items():
        name = key.removesuffix("_depth")
        image = obs.get(f"{name}_image")
        if key.endswith("_depth") and depth is not None and image is not None:
            cameras.append(_Arrays(name, image, depth, None, None, None, _CODES_PER_METRE, "robomimic"))
    return cameras


def _check_shapes(arrays: _Arrays) -> tuple[int, tuple[int, int]]:
    """(steps, size of the pictures)."""
    image, depth = arrays.image, arrays.depth
    files.refuse_if(
        len(image.shape) != 4 or image.shape[3] not in (3, 4),
        image.file,
        image.key,
        f"an array of {image.shape}",
        "steps x height x width x 3",
    )
    files.refuse_if(
        len(depth.shape) not in (3, 4) or (len(depth.shape) == 4 and depth.shape[3] != 1),
        depth.file,
        depth.key,
        f"an array of {depth.shape}",
        "steps x height x width x 1",
    )
    files.refuse_if(
        depth.shape[0] != image.shape[0] or not image.shape[0],
        depth.file,
        depth.key,
        f"{depth.shape[0]} steps",
        f"{image.shape[0]}, as of {image.key}",
    )
    files.refuse_if(
        0 in image.shape
        or 0 in depth.shape
        or max(np.prod(image.shape[1:3]), np.prod(depth.shape[1:3])) > files.MAX_PIXELS,
        image.file,
        image.key,
        f"pictures of {image.shape[1:3]}",
        f"1 to {files.MAX_PIXELS} pixels",
    )
    return image.shape[0], (image.shape[1], image.shape[2])


def _read_rows(array: Hdf5Array, n: int) -> np.ndarray:
    files.refuse_if(array.shape[0] != n, array.file, array.key, f"{array.shape[0]} rows", f"{n}, one for each step")
    return array.values().astype(np.float64)


def _to_pixel_centres(K: Any) -> Any:
    """K that counts from the corner of the first pixel → K that counts from its centre; other values unchanged."""
    try:
        shifted = np.array(K, np.float64)
        shifted[..., :2, 2] -= 0.5
    except (TypeError, ValueError, IndexError):
        return K  # refused by the check of K
    return shifted


def _read_poses(arrays: _Arrays, n: int, info: dict[str, Any]) -> Pose | None:
    """Camera-to-world of each step; None where the file has none."""
    if (gl := arrays.c2w_gl) is not None:
        files.refuse_if(gl.shape[1:] != (4, 4), gl.file, gl.key, f"an array of {gl.shape}", "steps x 4 x 4")
        return convert.to_poses(convert.cv_from_gl(_read_rows(gl, n)), gl.file, gl.key)
    if (w2c := arrays.w2c) is not None:
        files.refuse_if(
            w2c.shape[1:] not in ((3, 4), (4, 4)), w2c.file, w2c.key, f"an array of {w2c.shape}", "steps x 3 x 4"
        )
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3] = _read_rows(w2c, n)[:, :3]
        poses = convert.to_poses(T, w2c.file, w2c.key)
        R = poses.R.mT
        return Pose(R, -(R @ poses.t[..., None])[..., 0])
    if "extrinsics" in info and "eye_in_hand" not in arrays.name:  # of a camera in the hand: relative to the hand
        T = files.to_array(info["extrinsics"], (4, 4), arrays.image.file, "camera_info extrinsics")
        return convert.to_poses(np.tile(T, (n, 1, 1)), arrays.image.file, "camera_info extrinsics")
    return None


def _read_camera_info(file: Path, episode: str, camera: str) -> dict[str, Any]:
    """Entry of a camera in robomimic's ``camera_info``; empty where there is none."""
    text = read_hdf5_text(file, episode, "camera_info")
    value = {} if text is None else files.decode_json(text, file)
    entry = value.get(camera, {}) if isinstance(value, dict) else {}
    if not isinstance(entry, dict):
        raise files.FormatError(file, "camera_info", json.dumps(entry)[:60], "an object with intrinsics and extrinsics")
    return entry
