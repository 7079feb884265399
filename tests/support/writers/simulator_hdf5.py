"""Test writer of simulators' demonstrations in HDF5: robomimic and ManiSkill."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from dhtorch.data.io.decode import import_optional
from dhtorch.export.arrays import K_matrix, frame_to_hwc, pose_matrix
from dhtorch.records import Frame

_CODES_PER_METRE = {"maniskill3": 1000, "maniskill2": 1024}


def write_simulator_hdf5(
    file: Path,
    episodes: Sequence[Sequence[Frame]],
    layout: Literal["robomimic", "maniskill3", "maniskill2"],
    *,
    camera: str = "front",
    parameters: bool = True,
    clip_planes: tuple[float, float] | None = None,
) -> None:
    """Write episodes of one camera.

    Args:
        file: to be written.
        episodes: frames of each.
        layout: of the file.
        camera: its name.
        parameters: write K and poses; robomimic's pose is that of the first frame.
        clip_planes: robomimic's depth is a z-buffer between these planes (m).
    """
    h5py = import_optional("h5py")
    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, "w") as root:
        for i, frames in enumerate(episodes):
            pictures = np.stack([frame_to_hwc(frame) for frame in frames])
            depth = np.stack([frame.depth[0].numpy() for frame in frames])[..., None]
            K = np.stack([K_matrix(frame.camera) for frame in frames])
            K[:, :2, 2] += 0.5  # renderers count from the corner of the first pixel
            c2w = np.stack([pose_matrix(frame) for frame in frames])
            if layout == "robomimic":
                episode = root.create_group(f"data/demo_{i}")
                if clip_planes is not None:
                    near, far = clip_planes
                    depth = (1 - near / depth.astype(np.float64)) / (1 - near / far)
                episode[f"obs/{camera}_image"], episode[f"obs/{camera}_depth"] = pictures, depth.astype(np.float32)
                if parameters:
                    entry = {"intrinsics": K[0].tolist(), "extrinsics": c2w[0].tolist()}
                    episode.attrs["camera_info"] = json.dumps({camera: entry})
                continue
            data, stated = {
                "maniskill3": ("sensor_data", "sensor_param"), "maniskill2": ("image", "camera_param")
            }[layout]  # fmt: skip
            obs = root.create_group(f"traj_{i}/obs")
            codes = np.round(depth * _CODES_PER_METRE[layout])
            obs.create_dataset(
                f"{data}/{camera}/rgb", data=pictures, compression="gzip", chunks=(1, *pictures.shape[1:])
            )
            obs[f"{data}/{camera}/depth"] = codes.astype(np.int16 if layout == "maniskill3" else np.uint16)
            if parameters:
                obs[f"{stated}/{camera}/intrinsic_cv"] = K.astype(np.float32)
                obs[f"{stated}/{camera}/extrinsic_cv"] = np.linalg.inv(c2w)[:, :3].astype(np.float64)
                obs[f"{stated}/{camera}/cam2world_gl"] = c2w @ np.diag([1.0, -1, -1, 1])
