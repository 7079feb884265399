"""Test writers of folders of numbered images: BOP, Replica, ScanNet, SensReader, Open3D, SUN3D, ICL-NUIM, ROS recorder.

Each writes what its format's public description states: image, depth codes, intrinsics and poses, in the format's own
units and axes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
)
from dhtorch.records import Camera, Frame
from support.writers.parts import (
    encode_jpeg,
    encode_unfiltered_png,
    format_row,
    format_rows,
    pose_row,
    save_file,
    save_rgbd,
)

#: Depth codes of one metre in ScanNet, 3RScan, Open3D and SUN3D: millimetres. Source: format definitions.
_CODES_PER_METRE_MM = 1000.0

#: Depth codes of one metre in Replica as NICE-SLAM renders it: 10 m fill 16 bits. Source: its cam_params.json.
_REPLICA_CODES_PER_METRE = 6553.5

#: Depth codes of one metre in the PNGs of TUM and ICL-NUIM. Source: format definitions.
_TUM_CODES_PER_METRE = 5000.0

#: Time between two images of SUN3D in microseconds, a part of the file names. Source: derived: 1e6 / 30 Hz.
_SUN3D_STEP_US = 33333

#: Change of the camera's y axis from down (OpenCV) to up (POV-Ray).
_FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def write_bop(root: Path, frames: Sequence[Frame], *, depth_scale: float = 0.1, poses: bool = True) -> None:
    """Write a scene of the BOP benchmark: ``rgb/``, ``depth/`` and ``scene_camera.json``.

    ``depth_scale``: mm of one depth code. ``poses``: write ``cam_R_w2c`` and ``cam_t_w2c`` (mm), which are optional.
    """
    entries = {}
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"rgb/{i:06d}.png", f"depth/{i:06d}.png", _CODES_PER_METRE_MM / depth_scale)
        entry = {"cam_K": K_matrix(frame.camera).ravel().tolist(), "depth_scale": depth_scale}
        if poses:
            w2c = np.linalg.inv(pose_matrix(frame))
            entry |= {"cam_R_w2c": w2c[:3, :3].ravel().tolist(), "cam_t_w2c": (1000 * w2c[:3, 3]).tolist()}
        entries[str(i)] = entry
    save_file(root / "scene_camera.json", json.dumps(entries, indent=1))


def write_replica(root: Path, frames: Sequence[Frame]) -> None:
    """Write a Replica scene as NICE-SLAM renders it: ``results/``, ``traj.txt`` and ``cam_params.json``."""
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"results/frame{i:06d}.jpg", f"results/depth{i:06d}.png", _REPLICA_CODES_PER_METRE)
    save_file(root / "traj.txt", "".join(format_row(pose_matrix(frame).ravel()) + "\n" for frame in frames))
    K, (h, w) = K_matrix(frames[0].camera), frames[0].hw
    camera = {"w": w, "h": h, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    parameters = {"camera": {**camera, "scale": _REPLICA_CODES_PER_METRE}}
    save_file(root / "cam_params.json", json.dumps(parameters))


def write_scannet(root: Path, frames: Sequence[Frame], *, lost: Sequence[int] = ()) -> None:
    """Write ScanNet's export: ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``, depth with a camera of its own.

    ``lost``: numbers of the frames whose pose is −inf, as where tracking failed.
    """
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"color/{i}.jpg", f"depth/{i}.png", _CODES_PER_METRE_MM)
        pose = np.full((4, 4), -np.inf) if i in lost else pose_matrix(frame)
        save_file(root / "pose" / f"{i}.txt", format_rows(pose))
    for kind, camera in (("color", frames[0].camera), ("depth", frames[0].map_camera)):
        save_file(root / "intrinsic" / f"intrinsic_{kind}.txt", format_rows(_K_4x4(camera)))
        save_file(root / "intrinsic" / f"extrinsic_{kind}.txt", format_rows(np.eye(4)))


def write_sens_folder(root: Path, frames: Sequence[Frame], *, pgm: bool = True, lost: Sequence[int] = ()) -> None:
    """Write ``_info.txt`` and ``frame-XXXXXX.{color.jpg,depth.pgm,pose.txt}``: 3RScan, or ScanNet by its SensReader.

    Args:
        root: folder of the scan.
        frames: depth may have its own resolution.
        pgm: depth as 16-bit PGM, else PNG.
        lost: numbers of the frames whose pose is −inf.
    """
    first = frames[0]
    (h, w), (depth_h, depth_w) = first.hw, first.depth.shape[-2:]
    for i, frame in enumerate(frames):
        code = encode_depth_codes(frame.depth, _CODES_PER_METRE_MM)
        head = f"P5\n{code.shape[1]} {code.shape[0]}\n65535\n".encode()
        picture = head + code.astype(">u2").tobytes() if pgm else encode_unfiltered_png(code)
        save_file(root / f"frame-{i:06d}.color.jpg", encode_jpeg(frame_to_hwc(frame), 97))
        save_file(root / f"frame-{i:06d}.depth.{'pgm' if pgm else 'png'}", picture)
        pose = np.full((4, 4), -np.inf) if i in lost else pose_matrix(frame)
        save_file(root / f"frame-{i:06d}.pose.txt", format_rows(pose))
    lines = [
        "m_versionNumber = 4",
        "m_sensorName = test",
        *(f"m_{name} = {value}" for name, value in (("colorWidth", w), ("colorHeight", h))),
        *(f"m_{name} = {value}" for name, value in (("depthWidth", depth_w), ("depthHeight", depth_h))),
        f"m_depthShift = {_CODES_PER_METRE_MM:g}",
        f"m_calibrationColorIntrinsic = {format_row(_K_4x4(first.camera).ravel())}",
        f"m_calibrationDepthIntrinsic = {format_row(_K_4x4(first.map_camera).ravel())}",
        f"m_frames.size = {len(frames)}",
    ]
    save_file(root / "_info.txt", "\n".join(lines) + "\n")


def write_open3d(
    root: Path,
    frames: Sequence[Frame],
    *,
    trajectory: str = "trajectory.log",
    intrinsics: str = "camera_intrinsic.json",
) -> None:
    """Write Open3D's layout: ``color/``, ``depth/``, an intrinsics file (K by columns) and a trajectory in blocks.

    ``trajectory``: ``trajectory.log``, ``odometry.log`` or ``scene/trajectory.log``. ``intrinsics``: its name.
    """
    blocks = []
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"color/{i:05d}.png", f"depth/{i:05d}.png", _CODES_PER_METRE_MM)
        blocks.append(f"{i} {i} {i + 1}\n" + format_rows(pose_matrix(frame)))
    save_file(root / trajectory, "".join(blocks))
    h, w = frames[0].hw
    camera = {"width": w, "height": h, "intrinsic_matrix": K_matrix(frames[0].camera).T.ravel().tolist()}
    save_file(root / intrinsics, json.dumps(camera))


def write_sun3d(root: Path, frames: Sequence[Frame]) -> None:
    """Write SUN3D's layout: ``image/``, ``depth/`` (codes in mm, rotated by 3 bits), ``extrinsics/``, K."""
    for i, frame in enumerate(frames):
        name = f"{i + 1:07d}-{i * _SUN3D_STEP_US:012d}"
        code = encode_depth_codes(frame.depth, _CODES_PER_METRE_MM)
        rotated = np.left_shift(code, 3) | np.right_shift(code, 13)
        save_file(root / "image" / f"{name}.png", encode_unfiltered_png(frame_to_hwc(frame)))
        save_file(root / "depth" / f"{name}.png", encode_unfiltered_png(rotated))
    save_file(root / "intrinsics.txt", format_rows(K_matrix(frames[0].camera)))
    poses = "".join(format_rows(pose_matrix(frame)[:3]) for frame in frames)
    save_file(root / "extrinsics" / "20130512130736.txt", poses)


def write_icl_nuim(
    root: Path, frames: Sequence[Frame], *, trajectory: str = "livingRoom0.gt.freiburg", calibration: bool = True
) -> None:
    """Write ICL-NUIM's TUM-compatible PNGs: ``rgb/0.png``, ``depth/0.png``, ``associations.txt``, ``*.gt.freiburg``.

    Depth stands in the first column of ``associations.txt``. The trajectory has a camera with y up and a world that is
    mirrored like it (POV-Ray), for a K with a negative fy; the images are upright. ``calibration``: write that K to
    ``calibration.txt``; the published sets have no file with K.
    """
    rows, poses = [], []
    for i, frame in enumerate(frames):
        save_rgbd(root, frame, f"rgb/{i}.png", f"depth/{i}.png", _TUM_CODES_PER_METRE)
        rows.append(f"{i} depth/{i}.png {i} rgb/{i}.png")
        poses.append(f"{i} " + pose_row(frame, _FLIP_Y @ pose_matrix(frame) @ _FLIP_Y))
    save_file(root / "associations.txt", "\n".join(rows) + "\n")
    if calibration:
        K = K_matrix(frames[0].camera)
        save_file(root / "calibration.txt", format_row([K[0, 0], -K[1, 1], K[0, 2], K[1, 2]]) + "\n")
    save_file(root / trajectory, "\n".join(poses) + "\n")


def write_ros_tum(root: Path, frames: Sequence[Frame], *, units_per_metre: float = _CODES_PER_METRE_MM) -> None:
    """Write TUM's layout as recorders for ROS do: ``calibration.txt`` holds K, nothing states the unit of depth."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for frame in frames:
        stamp = f"{frame_time_s(frame):.6f}"
        save_rgbd(root, frame, f"rgb/{stamp}.png", f"depth/{stamp}.png", units_per_metre)
        lines = (f"{stamp} rgb/{stamp}.png", f"{stamp} depth/{stamp}.png", f"{stamp} {pose_row(frame)}")
        for column, line in zip(lists.values(), lines, strict=True):
            column.append(line)
    for name, lines in lists.items():
        save_file(root / f"{name}.txt", "\n".join(lines) + "\n")
    K = K_matrix(frames[0].camera)
    save_file(root / "calibration.txt", format_row([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) + "\n")


def _K_4x4(camera: Camera) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = K_matrix(camera)
    return matrix
