"""A nerfstudio folder against a LeRobot set of the same source: keys as documented, cameras, poses, depth, pictures.

nerfstudio's own parser is not asked, its keys are: https://docs.nerf.studio/quickstart/data_conventions.html

python benchmarks/clients/compare_nerfstudio.py NERFSTUDIO LEROBOT
"""

import json
import sys
from pathlib import Path

import numpy as np
from columns import columns
from PIL import Image
from torch_loader import Rows

AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's of a camera from OpenCV's
NEEDED = {"file_path", "transform_matrix", "depth_file_path", "fl_x", "fl_y", "cx", "cy", "w", "h"}


def main(root: str, twin: str) -> None:
    about, rows, keys = json.loads((Path(root) / "transforms.json").read_text()), Rows(twin), columns(twin)["keys"]
    frames = sum(row["episode_index"] == 0 for row in rows.rows)  # a folder holds one episode
    unit = about["depth_unit_scale_factor"]
    shots = sorted(about["frames"], key=lambda shot: shot["file_path"])
    assert about["camera_model"] == "OPENCV" and len(shots) == frames, f"{len(shots)} frames, expected {frames}"
    worst = dict.fromkeys(("depth", "numbers"), 0.0)
    for i, shot in enumerate(shots):
        assert shot.keys() >= NEEDED, NEEDED - shot.keys()
        row = rows[i]
        assert np.array_equal(np.array(Image.open(Path(root) / shot["file_path"])), row[keys["image"]]), i
        depth = np.array(Image.open(Path(root) / shot["depth_file_path"]))
        assert depth.dtype == np.uint16 or depth.dtype == np.int32, depth.dtype
        worst["depth"] = max(worst["depth"], float(np.abs(depth * unit - row[keys["depth"]]).max()))
        K = np.asarray(row[keys["intrinsics"]])
        own = np.array([shot["fl_x"], shot["fl_y"], shot["cx"] - 0.5, shot["cy"] - 0.5])
        pose = np.array(shot["transform_matrix"]) @ AXES
        stated = np.asarray(row[keys["intrinsics"].replace("intrinsics", "T_world_from_cam")]).reshape(4, 4)
        off = max(np.abs(own - K[[0, 4, 2, 5]]).max(), np.abs(pose - stated).max())
        worst["numbers"] = max(worst["numbers"], float(off))
    print(json.dumps({"frames": len(shots), "unit": unit, "largest_difference": worst}))


if __name__ == "__main__":
    main(*sys.argv[1:])
