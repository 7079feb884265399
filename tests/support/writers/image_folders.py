"""Test writers of image folders: dhtorch's own and other people's layouts, and exports with a camera for every image."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
    pose_matrix,
    rotation_to_xyzw,
)
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose
from support.writers.parts import (
    encode_jpeg,
    encode_unfiltered_png,
    format_row,
    format_rows,
    pose_row,
    save_file,
    save_rgbd,
)

# ----------------------------------------------------------------------------------------------------------- layouts

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


# ----------------------------------------------------------------------------------------------------- image_folders

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


# ------------------------------------------------------------------------------------------------------ posed_images

#: Change of camera axes from OpenCV (y down, z forward) to OpenGL (y up, z backward).
_FLIP_Y_AND_Z = np.diag([1.0, -1.0, -1.0, 1.0])

#: Names of the distortion coefficients in nerfstudio, in OpenCV's order.
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3")

#: Code of Polycam's confidence by level: low, medium, high. Source: its description.
_POLYCAM_CONFIDENCE = np.array([0, 127, 255], np.uint8)

#: Time stamps in Polycam's file names for one second. Source: its description (microseconds).
_POLYCAM_STAMPS_PER_S = 1e6


def write_nerfstudio(
    root: Path,
    frames: Sequence[Frame],
    *,
    unit_key: str | None = "depth_unit_scale_factor",
    unit_m: float = 1e-3,
    depth_key: str = "depth_file_path",
    suffix: str = ".png",
    times: bool = True,
    shared_K: bool = False,
    applied: np.ndarray | None = None,
    scale: float = 1.0,
) -> None:
    """Write ``transforms.json``, ``images/`` and ``depth/``.

    Args:
        root: an empty folder.
        frames: of one camera, B = 1.
        unit_key: field that states metres of one depth code, ``integer_depth_scale`` for NeRFCapture; None = none.
        unit_m: metres of one depth code.
        depth_key: field of the depth file, ``depth_path`` for NeRFCapture.
        suffix: of ``file_path``; NeRFCapture omits it.
        times: write ``timestamp``, as NeRFCapture does.
        shared_K: write the first frame's intrinsics once, for all frames.
        applied: 4×4 rigid motion of the world that a converter applied (``applied_transform``).
        scale: of the world that a converter applied then (``applied_scale``).
    """
    about: dict[str, Any] = {"camera_model": "OPENCV", "frames": []}
    about |= {} if unit_key is None else {unit_key: unit_m}
    about |= {} if applied is None else {"applied_transform": applied[:3].tolist()}
    about |= {} if scale == 1 else {"applied_scale": scale}
    about |= _nerfstudio_camera(frames[0]) if shared_K else {}
    for i, frame in enumerate(frames):
        name = f"frame_{i + 1:05d}"
        c2w = (np.eye(4) if applied is None else applied) @ pose_matrix(frame) @ _FLIP_Y_AND_Z
        c2w[:3, 3] *= scale
        entry = {"file_path": f"./images/{name}{suffix}", depth_key: f"./depth/{name}.png"}
        entry |= {"transform_matrix": c2w.tolist()} | ({} if shared_K else _nerfstudio_camera(frame))
        about["frames"].append(entry | ({"timestamp": frame_time_s(frame)} if times else {}))
        save_rgbd(root, frame, f"images/{name}.png", f"depth/{name}.png", 1 / unit_m)
    save_file(root / "transforms.json", json.dumps(about))


def _nerfstudio_camera(frame: Frame) -> dict[str, float]:
    """Intrinsics with the centre of the first pixel at (0.5, 0.5)."""
    K, distortion = K_matrix(frame.camera), frame.camera.distortion
    lens = [] if distortion is None else distortion[0].tolist()
    values = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    values |= {"w": frame.hw[1], "h": frame.hw[0], **dict(zip(_LENS_NAMES, lens, strict=False))}
    return {name: float(value) for name, value in values.items()}


def write_polycam(root: Path, frames: Sequence[Frame], *, corrected: bool = True) -> None:
    """Write a raw export below ``keyframes/``: images, cameras, depth in mm, confidence.

    ``corrected``: write images and cameras also as ``corrected_images/`` and ``corrected_cameras/``; the originals then
    have poses that are off by 1 m.
    """
    folder = root / "keyframes"
    for frame in frames:
        stem = str(round(frame_time_s(frame) * _POLYCAM_STAMPS_PER_S))
        K = K_matrix(frame.camera)
        c2w = pose_matrix(frame) @ _FLIP_Y_AND_Z
        picture = encode_unfiltered_png(frame_to_hwc(frame))
        camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "blur_score": 100.0}
        camera |= {"width": frame.hw[1], "height": frame.hw[0]}
        for prefix in ("", "corrected_") if corrected else ("",):
            offset = 1.0 if corrected and not prefix else 0.0
            pose = {f"t_{i}{j}": float(c2w[i, j]) + offset * (j == 3) for i in range(3) for j in range(4)}
            save_file(folder / f"{prefix}images" / f"{stem}.png", picture)
            save_file(folder / f"{prefix}cameras" / f"{stem}.json", json.dumps({**camera, **pose}))
        depth = encode_depth_codes(frame.depth, 1000)
        levels = np.where(depth > 0, 2, 0) if frame.conf is None else frame.conf[0].numpy()
        save_file(folder / "depth" / f"{stem}.png", encode_unfiltered_png(depth))
        save_file(folder / "confidence" / f"{stem}.png", encode_unfiltered_png(_POLYCAM_CONFIDENCE[levels]))
    save_file(root / "mesh_info.json", json.dumps({"alignmentTransform": np.eye(4).ravel().tolist()}))


def write_colmap_capture(
    root: Path, frames: Sequence[Frame], *, folder: str = "sparse/0", model: str = "OPENCV", is_metric: bool = True
) -> None:
    """Write a COLMAP text model below ``folder``, ``images/`` and ``depth/`` in mm.

    ``is_metric``: state metres and write ``times.txt``, as dhtorch does; COLMAP itself has neither. ``model``: PINHOLE,
    SIMPLE_RADIAL (of the first coefficient) or OPENCV.
    """
    cameras, images, times = [], [], []
    for i, frame in enumerate(frames, start=1):
        K, distortion, name = K_matrix(frame.camera), frame.camera.distortion, f"{i:04d}.png"
        lens = np.zeros(4) if distortion is None else distortion[0, :4].double().numpy()
        f, c = [K[0, 0], K[1, 1]], [K[0, 2] + 0.5, K[1, 2] + 0.5]
        values = {"PINHOLE": [*f, *c], "SIMPLE_RADIAL": [f[0], *c, lens[0]], "OPENCV": [*f, *c, *lens]}[model]
        cameras.append(f"{i} {model} {frame.hw[1]} {frame.hw[0]} {format_row(values)}")
        w2c = np.linalg.inv(pose_matrix(frame))
        x, y, z, w = rotation_to_xyzw(w2c[:3, :3])
        images += [f"{i} {format_row([w, x, y, z, *w2c[:3, 3]])} {i} {name}", "12.5 7.25 -1" if i % 2 else ""]
        times.append(f"{i} {format_row([frame_time_s(frame)])}")
        save_rgbd(root, frame, f"images/{name}", f"depth/{name}", 1000)
    head = ["# Image list with two lines of data per image", *(["# metres"] if is_metric else [])]
    texts = {"cameras": ["# Camera list", *cameras], "images": [*head, *images], "points3D": ["# 3D point list"]}
    for kind, lines in (texts | ({"times": times} if is_metric else {})).items():
        save_file(root / folder / f"{kind}.txt", "\n".join(lines) + "\n")
