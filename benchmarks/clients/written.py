"""Sets written here for what no real one at hand has: actions and depth at once, from two cameras; RLDS with depth."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import array, parquet

from dhtorch.records import Frame
from dhtorch.synthetic.robot import _solve_joints
from dhtorch.synthetic.two_cameras import open_two_cameras

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from support.writers import write_lerobot, write_rlds

CAMERAS = ("observation.images.left", "observation.images.right")
BASE = np.array([[0, -1, 0, 0], [0, 0, -1, 0.35], [1, 0, 0, -0.5], [0, 0, 0, 1.0]])  # world from base: z up, m
EPISODES, LENGTH = 2, 6

#: Frames of an episode that Diffusion trains on: LeRobot leaves out the last 7 of each.
LONG = 10


def seen(length: int = LENGTH, **options: Any) -> list[list[list[Frame]]]:
    """Camera → episode → frames of a robot that walks through the built-in room."""
    sized = {"n_frames": length, "hw": (96, 128), "depth_hw": (48, 64), "supersample": 1, "range_limit": 3.0} | options
    rigs = [open_two_cameras(seed=seed, **sized)[0].recording for seed in range(2, 2 + EPISODES)]
    spans = range(0, length), range(length, 2 * length)
    return [[[rig[i] for i in span] for rig in rigs] for span in spans]


def hand(frame: Frame) -> np.ndarray:
    """Seven joint angles and the gripper's width (8,) of an arm that carries the camera, rad and m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = frame.T_world_from_cam.R[0].numpy(), frame.T_world_from_cam.t[0].numpy()
    return np.append(_solve_joints(np.linalg.inv(BASE) @ T), 0.02 + 0.01 * np.sin(40 * T[2, 3]))


def write_robot(root: Path, keys: Sequence[str] = CAMERAS, length: int = LENGTH, **options: Any) -> None:
    """A LeRobot v2.1 set of cameras with depth, a state of 8 numbers, and as action the state a frame later.

    ``options`` are those of the room (:func:`dhtorch.synthetic.two_cameras.open_two_cameras`).
    """
    cameras = seen(length, **options)[: len(keys)]
    for key, episodes in zip(keys, cameras, strict=True):
        at = root if key == keys[0] else root.with_name(f"{root.name}-{key}")
        write_lerobot(at, episodes, version=2, camera=key, image="image", depth="tiff", fps=30, poses=False)
    number = {"dtype": "float32", "shape": [8], "names": [f"joint_{i}" for i in range(7)] + ["gripper"]}
    info, other = (folder / "meta" / "info.json" for folder in (root, at))
    metadata, more = json.loads(info.read_text()), json.loads(other.read_text())["features"]
    metadata["features"] |= {k: v for k, v in more.items() if k.startswith(keys[-1])}
    metadata["features"] |= {"observation.state": number, "action": number}
    info.write_text(json.dumps(metadata))
    tables = [sorted((folder / "data").rglob("*.parquet")) for folder in (root, at)]
    for file, beside, episode in zip(*tables, cameras[0], strict=True):
        table, right = parquet.read_table(file), parquet.read_table(beside)
        for name in (name for name in right.column_names if name not in table.column_names):
            table = table.append_column(name, right[name])
        states = np.stack([hand(frame) for frame in episode]).astype(np.float32)
        nexts = np.concatenate([states[1:], states[-1:]])
        for name, values in (("observation.state", states), ("action", nexts)):
            table = table.append_column(name, array(values.tolist()))
        parquet.write_table(table, file)


def write_steps(root: Path) -> None:
    """An RLDS set of one camera with depth, seven actions a step and poses."""
    write_rlds(root, seen()[0])


#: Name of such a set → what writes it.
WRITTEN = {
    "robot": lambda root: write_robot(root, CAMERAS[:1], LONG),
    "two-camera robot": lambda root: write_robot(root, length=LONG),
    "RLDS with depth": write_steps,
}
