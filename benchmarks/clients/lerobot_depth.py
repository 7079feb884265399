"""Depth that LeRobot wrote itself, as images and as video: its own reading, dhtorch's and its loaders', in metres.

In an environment that has LeRobot 0.6 and dhtorch:  python benchmarks/clients/lerobot_depth.py NEW_FOLDER
"""

import inspect
import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from dhtorch.data import open_all
from dhtorch.transforms import SampleSpec, declared_depth_range, declared_depth_unit

H, W, N, FPS, IMAGE, DEPTH = 48, 64, 4, 10, "observation.images.front", "observation.images.front_depth"


def truth(i: int) -> np.ndarray:
    """A ramp from 0.3 to 6 m (H, W, 1) with a hole, and a part beyond the 10 m of a video's codes."""
    z = np.linspace(0.3, 6.0, H * W, dtype=np.float32).reshape(H, W, 1) + np.float32(0.01 * i)
    z[8:16, 8:24] = 0.0
    z[24:32, 8:24] += 8.0
    return z


def written(root: Path, videos: bool) -> None:
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


def opened(root: Path, unit: str) -> LeRobotDataset:
    return LeRobotDataset("local/set", root=root, video_backend="pyav", depth_output_unit=unit)


def in_loader(dataset: LeRobotDataset, i: int) -> np.ndarray:
    """Depth (H, W) of a frame in m as ``ExtendDepth(depth_unit="auto")`` reads it in ``ExtendedDataset``; 0 = none."""
    stated = {"depth_unit": declared_depth_unit(dataset, DEPTH), "depth_range": declared_depth_range(dataset, DEPTH)}
    return SampleSpec(**stated).metres([dataset[i][DEPTH]])[0, 0].numpy()


def main(folder: str) -> None:
    if "depth_output_unit" not in inspect.signature(LeRobotDataset).parameters:
        sys.exit("this LeRobot knows no depth, expected 0.6 or later")
    result = {}
    for kind in ("image", "video"):
        root = Path(folder) / kind
        written(root, kind == "video")
        theirs, in_mm = opened(root, "m"), opened(root, "mm")
        mine = open_all(root, "lerobot", fov=69)[0]
        off = dict.fromkeys(("truth", "loaders", "in_loader_m", "in_loader_mm"), 0.0)
        for i in range(N):
            z, own, true = theirs[i][DEPTH].numpy().squeeze(), mine[i].depth[0].numpy(), truth(i)[..., 0]
            known = (true > 0) & ((true < 10) | (kind == "image"))
            seen = {"truth": own, "in_loader_m": in_loader(theirs, i), "in_loader_mm": in_loader(in_mm, i)}
            for name, depth in seen.items():
                assert np.array_equal(depth > 0, known), f"{kind} {i}, {name}: pixels without depth"
                off[name] = max(off[name], float(np.abs(depth - true)[known].max()))
            off["loaders"] = max(off["loaders"], float(np.abs(own - z)[known].max()))
        hole = theirs[0][DEPTH].numpy().squeeze()[8:16, 8:24]
        result[kind] = {**off, "hole_in_lerobot_m": [float(hole.min()), float(hole.max())]}
    off = {"depth": result["image"]["loaders"], "depth in video": result["video"]["loaders"]}
    print(json.dumps({"frames": N, "unit": "m", "largest_difference": off, **result}))


if __name__ == "__main__":
    main(sys.argv[1])
