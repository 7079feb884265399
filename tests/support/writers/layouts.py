"""Test writers of simple layouts: TUM RGB-D, numbered frames, rectified pairs, LiDAR with cameras."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.export.arrays import (
    K_matrix,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose
from support.writers.parts import encode_unfiltered_png, format_row, format_rows, pose_row, save_file, save_rgbd

#: Lag in s of the depth stamps behind the colour stamps: TUM's streams are not synchronous.
_TUM_DEPTH_LAG_S = 0.0125


def write_tum(
    root: Path, frames: Sequence[Frame], *, camera: int | None = None, units_per_metre: float = 5000.0
) -> None:
    """Write a TUM RGB-D sequence: ``rgb/``, ``depth/``, their lists and ``groundtruth.txt``.

    The format has no place for K. ``camera`` 1, 2 or 3 names the freiburg camera in the trajectory's header, so that a
    reader uses the published calibration (frames of 640×480); None writes the frames' own to ``meta.json``. The
    trajectory has the colour stamps.
    """
    lists: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    poses = ["# ground truth trajectory", f"# file: 'rgbd_dataset_{f'freiburg{camera}' if camera else 'own'}.bag'"]
    poses.append("# timestamp tx ty tz qx qy qz qw")
    for frame in frames:
        time = frame_time_s(frame)
        late = time + _TUM_DEPTH_LAG_S
        save_rgbd(root, frame, f"rgb/{time:.6f}.png", f"depth/{late:.6f}.png", units_per_metre)
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lists["depth"].append(f"{late:.6f} depth/{late:.6f}.png")
        poses.append(f"{time:.6f} {pose_row(frame)}")
    for name, lines in (("rgb", lists["rgb"]), ("depth", lists["depth"]), ("groundtruth", poses)):
        save_file(root / f"{name}.txt", "\n".join(lines) + "\n")
    if camera is None:
        distortion = frames[0].camera.distortion
        meta = {
            "K": K_matrix(frames[0].camera).tolist(),
            "dist": [0.0] * 5 if distortion is None else distortion[0].tolist(),
        }
        save_file(root / "meta.json", json.dumps(meta))


def write_named_frames(
    root: Path, frames: Sequence[Frame], *, units_per_metre: float = 1000.0, fps: float | None = None
) -> None:
    """``frame-XXXXXX.{color.png,depth.png,pose.txt}`` and ``camera-intrinsics.txt``, as 7-Scenes.

    Where the frames' depth has a camera of its own, the intrinsics file holds that one and ``meta.json`` holds both.
    """
    meta: dict[str, Any] = {} if fps is None else {"fps": fps}
    if frames[0].depth_camera is not None:
        meta |= {"K": K_matrix(frames[0].camera).tolist(), "K_depth": K_matrix(frames[0].depth_camera).tolist()}
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"frame-{i:06d}.color.png", f"frame-{i:06d}.depth.png", units_per_metre)
        save_file(root / f"frame-{i:06d}.pose.txt", format_rows(pose_matrix(frame)))
    save_file(root / "camera-intrinsics.txt", format_rows(K_matrix(frames[0].depth_camera or frames[0].camera)))
    if meta:
        save_file(root / "meta.json", json.dumps(meta))


def write_counted_frames(root: Path, frames: Sequence[Frame], *, units_per_metre: float = 1000.0) -> None:
    """``images/``, ``depth/``, ``poses.txt`` (one row-major matrix per line) and ``K.txt``."""
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"images/{i:05d}.png", f"depth/{i:05d}.png", units_per_metre)
    save_file(root / "poses.txt", "".join(format_row(pose_matrix(frame).ravel()) + "\n" for frame in frames))
    save_file(root / "K.txt", format_rows(K_matrix(frames[0].camera)))


def write_calib_pair(root: Path, left: Frame, right: Frame) -> None:
    """Write a rectified pair as in Middlebury and ETH3D: ``calib.txt``, ``im0.png``, ``im1.png``, ``disp0.pfm``."""
    baseline, doffs = _rectification(left, right)
    h, w = left.hw
    lines = [f"cam{i}={_format_matlab(K_matrix(frame.camera))}" for i, frame in enumerate((left, right))]
    lines += [f"doffs={doffs!r}", f"baseline={baseline * 1000!r}", f"width={w}", f"height={h}", f"ndisp={w}"]
    save_file(root / "calib.txt", "\n".join(lines) + "\n")
    for i, frame in enumerate((left, right)):
        save_file(root / f"im{i}.png", encode_unfiltered_png(frame_to_hwc(frame)))
    disparity = _disparity(left, baseline, doffs)
    save_file(root / "disp0.pfm", f"Pf\n{w} {h}\n-1\n".encode() + disparity[::-1].astype("<f4").tobytes())


def write_npz_pair(root: Path, left: Frame, right: Frame, *, name: str = "scene") -> None:
    """Write a rectified pair as in scikit-image: ``*_left.png``, ``*_right.png``, ``*_disp.npz``, ``meta.json``."""
    baseline, doffs = _rectification(left, right)
    save_file(root / f"{name}_left.png", encode_unfiltered_png(frame_to_hwc(left)))
    save_file(root / f"{name}_right.png", encode_unfiltered_png(frame_to_hwc(right)))
    disparity = np.ascontiguousarray(_disparity(left, baseline, doffs), np.float32)
    np.savez_compressed(root / f"{name}_disp.npz", disparity)
    meta = {"K_left": K_matrix(left.camera).tolist(), "K_right": K_matrix(right.camera).tolist()}
    save_file(root / "meta.json", json.dumps(meta | {"baseline_m": baseline, "doffs": doffs}))


def write_driving(
    root: Path,
    frames: Mapping[str, Sequence[Frame]],  # camera name → its frames, as many for each camera
    T_world_from_lidar: Pose,  # (n) one for each instant
    *,
    lidar_lag: float = 0.09,
) -> None:
    """Write a DGP scene folder: ``scene_*.json``, ``calibration/``, ``rgb/<camera>/``, ``point_cloud/LIDAR/*.npz``.

    The sweep of an instant contains all returns of its frames' depth maps in the LiDAR's frame, stamped ``lidar_lag`` s
    later.
    """
    key = "0" * 40
    data, samples = [], []
    for i in range(T_world_from_lidar.t.shape[0]):
        shots = {name: list_[i] for name, list_ in frames.items()}
        stamp = max(frame_time_s(frame) for frame in shots.values()) + lidar_lag
        data.append(_datum(f"{i}L", "LIDAR", stamp, _write_sweep(root, i, shots, T_world_from_lidar[i : i + 1])))
        for name, frame in shots.items():
            file, (h, w) = f"rgb/{name}/{i:06d}.png", frame.hw
            save_file(root / file, encode_unfiltered_png(frame_to_hwc(frame)))
            image = {"filename": file, "channels": 3, "height": h, "width": w, "pose": _pose_json(pose_matrix(frame))}
            data.append(_datum(f"{i}{name}", name, frame_time_s(frame), {"image": image}))
        samples.append({"calibration_key": key, "datum_keys": [f"{i}L", *(f"{i}{name}" for name in shots)]})
    save_file(root / f"scene_{key}.json", json.dumps({"data": data, "samples": samples, "name": "written"}))
    zero = dict.fromkeys(("fx", "fy", "cx", "cy", "skew"), 0.0)  # the LiDAR has an entry too
    intrinsics = [zero, *(_intrinsics_json(list_[0].camera) for list_ in frames.values())]
    save_file(root / "calibration" / f"{key}.json", json.dumps({"names": ["LIDAR", *frames], "intrinsics": intrinsics}))


def _write_sweep(root: Path, i: int, shots: Mapping[str, Frame], T_world_from_lidar: Pose) -> dict[str, Any]:
    points = []
    for frame in shots.values():
        v, u = torch.nonzero(frame.depth[0] > 0, as_tuple=True)
        uv = torch.stack((u, v), -1).double()
        xyz = cameras.unproject(frame.camera.to(torch.float64), uv[None], frame.depth[0, v, u].double()[None])
        T_world_from_cam = se3.from_matrix(torch.from_numpy(pose_matrix(frame))[None])
        points.append(se3.apply(se3.relative(T_world_from_cam, T_world_from_lidar), xyz)[0])
    xyz_lidar = torch.cat(points).numpy()
    file = f"point_cloud/LIDAR/{i:06d}.npz"
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(root / file, data=np.concatenate((xyz_lidar, np.full((len(xyz_lidar), 1), 0.5)), 1))
    pose = _pose_json(se3.to_matrix(T_world_from_lidar)[0].numpy())
    return {"point_cloud": {"filename": file, "point_format": ["X", "Y", "Z", "INTENSITY"], "pose": pose}}


def _datum(key: str, name: str, stamp: float, datum: dict[str, Any]) -> dict[str, Any]:
    text = datetime.fromtimestamp(stamp, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    return {"key": key, "id": {"name": name, "timestamp": text}, "datum": datum}


def _pose_json(pose: np.ndarray) -> dict[str, dict[str, float]]:
    rotation = dict(zip(("qx", "qy", "qz", "qw"), map(float, rotation_to_xyzw(pose[:3, :3])), strict=True))
    return {"rotation": rotation, "translation": dict(zip("xyz", map(float, pose[:3, 3]), strict=True))}


def _intrinsics_json(camera: Camera) -> dict[str, float]:
    (fx, fy), (cx, cy) = camera.f[0].tolist(), camera.c[0].tolist()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": 0.0}


def _rectification(left: Frame, right: Frame) -> tuple[float, float]:
    """Baseline (m) and difference of the principal points (px)."""
    baseline = (pose_matrix(right)[:3, 3] - pose_matrix(left)[:3, 3])[0]
    return float(baseline), float(K_matrix(right.camera)[0, 2] - K_matrix(left.camera)[0, 2])


def _disparity(left: Frame, baseline: float, doffs: float) -> np.ndarray:
    """f · baseline / depth − doffs; infinite where there is no return."""
    depth = left.depth[0].double().numpy()
    scale = float(left.camera.f[0, 0]) * baseline
    return np.where(depth > 0, scale / np.where(depth > 0, depth, 1) - doffs, np.inf)


def _format_matlab(K: np.ndarray) -> str:
    return "[" + "; ".join(" ".join(f"{x!r}" for x in row) for row in K.tolist()) + "]"
