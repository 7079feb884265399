"""Depth that LeRobot wrote itself, as pictures and as video: its own reading and dhtorch's, in metres.

In an environment that has LeRobot 0.6 and dhtorch:  python benchmarks/clients/lerobot_depth.py NEW_FOLDER
"""

import inspect
import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from dhtorch.data import open_all

H, W, N, FPS, IMAGE, DEPTH = 48, 64, 4, 10, "observation.images.front", "observation.images.front_depth"


def truth(i: int) -> np.ndarray:
    """A ramp from 0.3 to 6 m (H, W, 1) with a hole."""
    z = np.linspace(0.3, 6.0, H * W, dtype=np.float32).reshape(H, W, 1) + np.float32(0.01 * i)
    z[8:16, 8:24] = 0.0
    return z


def written(root: Path, videos: bool) -> LeRobotDataset:
    picture = {"dtype": "video" if videos else "image", "names": ["height", "width", "channels"]}
    features = {IMAGE: {**picture, "shape": (H, W, 3)}, "action": {"dtype": "float32", "shape": (7,), "names": None}}
    features[DEPTH] = {**picture, "shape": (H, W, 1), "info": {"is_depth_map": True}}
    options = {"fps": FPS, "root": root, "features": features, "use_videos": videos}
    dataset = LeRobotDataset.create("local/set", **options)
    for i in range(N):
        colour = np.full((H, W, 3), 40 * i, np.uint8)
        frame = {IMAGE: colour, DEPTH: truth(i), "action": np.zeros(7, np.float32), "task": "look"}
        dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/set", root=root, video_backend="pyav", depth_output_unit="m")


def main(folder: str) -> None:
    if "depth_output_unit" not in inspect.signature(LeRobotDataset).parameters:
        sys.exit("this LeRobot knows no depth, expected 0.6 or later")
    result = {}
    for kind in ("image", "video"):
        theirs = written(Path(folder) / kind, kind == "video")
        mine = open_all(Path(folder) / kind, "lerobot", fov=69)[0]
        off = dict.fromkeys(("truth", "loaders"), 0.0)
        for i in range(N):
            z, own, true = theirs[i][DEPTH].numpy().squeeze(), mine[i].depth[0].numpy(), truth(i)[..., 0]
            assert np.array_equal(own > 0, true > 0), f"{kind} {i}: invalid pixels"
            known = true > 0
            off["truth"] = max(off["truth"], float(np.abs(own - true)[known].max()))
            off["loaders"] = max(off["loaders"], float(np.abs(own - z)[known].max()))
        hole = theirs[0][DEPTH].numpy().squeeze()[8:16, 8:24]
        result[kind] = {**off, "hole_in_lerobot_m": [float(hole.min()), float(hole.max())]}
    off = {"depth": result["image"]["loaders"], "depth in video": result["video"]["loaders"]}
    print(json.dumps({"frames": N, "unit": "m", "largest_difference": off, **result}))


if __name__ == "__main__":
    main(sys.argv[1])
