"""Writer of RH20T scenes: videos by camera, a calibration folder, and the robot's streams."""

import json
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.readers.rh20t_robot import ROBOT_ARMS
from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.export.video import write_lossless
from dhtorch.records import Frame

_CALIBRATION_STAMP_MS = 1_600_000_000_000  # time of the calibration


def write_rh20t(
    root: Path,
    cameras: Mapping[str, Sequence[Frame]],  # serial → its frames; K refers to the frames' own size
    *,
    configuration: int = 1,
    T_world_from_base: np.ndarray | None = None,
    hand_at_calibration: np.ndarray | None = None,
    depth: bool = True,
    depth_root: Path | None = None,
    lag: float = 0.0,
    calibrated_hw: tuple[int, int] = (720, 1280),
    name: str = "task_0001_user_0001_scene_0001",
    stamp: int = _CALIBRATION_STAMP_MS,
    joint: np.ndarray | None = None,
    width: np.ndarray | None = None,
) -> Path:
    """Write a scene folder below ``root`` (returned) with the calibration beside it; times are integer milliseconds.

    The tcp follows from the poses of the first camera on the hand of ``configuration`` and its mount. The extrinsics of
    the cameras on the hand were taken at another pose, ``hand_at_calibration`` (4×4 camera to world). Colour is
    lossless RGB video, depth lossless full-range luma, ``lag`` s later. ``joint`` (n, d) rad and ``width`` (n,) of the
    gripper, in mm, are the robot's at the times of each camera; None = as in ``_write_streams``. Scenes with one
    ``stamp`` share a calibration.
    """
    scene = root / f"{name}_cfg_{configuration:04d}"
    arm, folder = ROBOT_ARMS[configuration], root / "calib" / str(stamp)
    world_from_base = np.eye(4) if T_world_from_base is None else T_world_from_base
    first = cameras.get(arm.in_hand[0])
    start = pose_matrix(first[0]) if first else np.eye(4)
    calibrated = start if hand_at_calibration is None else hand_at_calibration
    offset = calibrated @ np.linalg.inv(start)
    K, E, tcp = {}, {}, {}
    for serial, frames in cameras.items():
        camera_folder = scene / f"cam_{serial}"
        stamps = [round(1000 * frame_time_s(frame)) for frame in frames]
        depth_stamps = [stamp + round(1000 * lag) for stamp in stamps]
        write_lossless(camera_folder / "color.mp4", [frame_to_hwc(f) for f in frames], "rgb24", rate=Fraction(10))
        if depth:
            depth_file = (depth_root or scene) / camera_folder.name / "depth.mp4"
            codes = [encode_depth_codes(f.depth, 1000) for f in frames]  # low bytes above high bytes
            planes = [np.concatenate((code & 255, code >> 8)).astype(np.uint8) for code in codes]
            write_lossless(depth_file, planes, "yuvj420p", rate=Fraction(10))
        _save_npy(camera_folder / "timestamps.npy", {"color": stamps, "depth": depth_stamps if depth else []})
        full = K_matrix(frames[0].camera)  # of the full-size image, such that exact scaling gives the frame's own K
        for axis, size, whole in ((0, frames[0].hw[1], calibrated_hw[1]), (1, frames[0].hw[0], calibrated_hw[0])):
            full[axis, axis] *= whole / size
            full[axis, 2] = (full[axis, 2] + 0.5) * whole / size - 0.5
        K[serial] = np.hstack((full, np.zeros((3, 1))))
        poses = [pose_matrix(frame) for frame in frames]
        c2w = offset @ poses[0] if serial in arm.in_hand else poses[0]
        E[serial] = [np.linalg.inv(c2w), np.eye(4)]
        if first:
            hand = [pose_matrix(frame) for frame in first]
            published = [
                np.linalg.inv(arm.align_base) @ _tcp_pose(world_from_base, h, arm.X) @ arm.align_tcp for h in hand
            ]
            entries = zip(stamps, published, strict=False)
            tcp[serial] = [{"timestamp": t, "tcp": _pose_vector(T), "robot_ft": np.zeros(6)} for t, T in entries]
    for kind, content in (("intrinsics", K), ("extrinsics", E)):
        _save_npy(folder / f"{kind}.npy", content)
    _save_npy(folder / "tcp.npy", to_robot_notation(arm.robot, _tcp_pose(world_from_base, calibrated, arm.X)))
    if first:
        _save_npy(scene / "transformed" / "tcp_base.npy", tcp)
    stamps_of = {s: [round(1000 * frame_time_s(f)) for f in fs] for s, fs in cameras.items()}
    _write_streams(scene / "transformed", stamps_of, joint, width)
    about = {"calib": stamp, "finish_time": stamp + 10**6, "rating": 9}
    (scene / "metadata.json").write_text(json.dumps(about), encoding="utf-8")
    return scene


def to_robot_notation(robot: str, T: np.ndarray) -> np.ndarray:
    """Tcp pose (4×4, base ← tcp) → the notation of that robot's calibration file."""
    if robot in ("flexiv", "ur5"):
        return _pose_vector(T)
    if robot == "franka":  # its tool axis is reversed
        x, y, z, w = rotation_to_xyzw(T[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
        axis = np.array([x, y, z])
        angle = 2 * np.arctan2(np.linalg.norm([x, y, z]), w)
        return np.append(T[:3, 3], angle * axis / max(float(np.linalg.norm(axis)), 1e-300))
    R = T[:3, :3]
    angles = (
        np.arctan2(R[2, 1], R[2, 2]),
        np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])),
        np.arctan2(R[1, 0], R[0, 0]),
    )
    return np.append(1000 * T[:3, 3], angles)


def _tcp_pose(world_from_base: np.ndarray, c2w: np.ndarray, X: np.ndarray) -> np.ndarray:
    return np.linalg.inv(world_from_base) @ c2w @ X


def _pose_vector(T: np.ndarray) -> np.ndarray:
    """x y z qw qx qy qz."""
    q = rotation_to_xyzw(T[:3, :3])
    return np.array([*T[:3, 3], q[3], *q[:3]])


def _write_streams(
    folder: Path, stamps: Mapping[str, Sequence[int]], joints: np.ndarray | None, widths: np.ndarray | None
) -> None:
    """Write the robot's streams; by default functions of t (s since the start): joint j + t, width 50 − t, force t.

    The wrist sensor's zero is 3; forces in a camera's frame are twice those in the base frame.
    """
    start = min(min(times) for times in stamps.values())
    joint: dict[str, dict[int, Any]] = {}
    gripper: dict[str, dict[int, Any]] = {}
    for serial, times in stamps.items():
        laws = [(t - start) / 1000 for t in times]
        joint[serial] = dict(zip(times, [np.arange(7) + t for t in laws] if joints is None else joints, strict=True))
        width = dict(zip(times, [50 - t for t in laws] if widths is None else widths.tolist(), strict=True))
        gripper[serial] = {t: {"gripper_command": [w, 1, 2], "gripper_info": [w, 0, 0]} for t, w in width.items()}
    for name, scale in (("force_torque", 2.0), ("force_torque_base", 1.0)):
        loads = {s: [(t, scale * np.full(6, (t - start) / 1000)) for t in times] for s, times in stamps.items()}
        entries = {s: [{"timestamp": t, "zeroed": x, "raw": x + 3} for t, x in load] for s, load in loads.items()}
        _save_npy(folder / f"{name}.npy", entries)
    _save_npy(folder / "joint.npy", joint)
    _save_npy(folder / "gripper.npy", gripper)


def _save_npy(file: Path, content: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, content, allow_pickle=True)
