"""nerfstudio's own parser of an enriched folder: pictures, cameras, poses, depth and points, against the files.

In an environment with nerfstudio (only the imports of its parsers are needed, and open3d for the points):
python benchmarks/clients/nerfstudio_parser.py NERFSTUDIO
"""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils.data_utils import get_depth_image_from_path
from PIL import Image

AS_WRITTEN = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "eval_mode": "all"}


def main(root: str) -> None:
    points = importlib.util.find_spec("open3d") is not None  # nerfstudio reads splatfacto's points by it
    options = {**AS_WRITTEN, "downscale_factor": 1, "load_3D_points": points}
    parsed = NerfstudioDataParserConfig(data=Path(root), **options).setup()
    outputs = parsed.get_dataparser_outputs("train")
    about = json.loads((Path(root) / "transforms.json").read_text())
    shots = {str(Path(root) / shot["file_path"]): shot for shot in about["frames"]}
    assert len(outputs.image_filenames) == len(shots) == len(outputs.cameras), f"{len(shots)} frames"
    worst, unit = dict.fromkeys(("depth", "numbers"), 0.0), outputs.metadata["depth_unit_scale_factor"]
    for i, (image, depth) in enumerate(zip(outputs.image_filenames, outputs.metadata["depth_filenames"], strict=True)):
        shot, camera = shots[str(image)], outputs.cameras[i]
        values = [float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy", "width", "height")]
        own = [shot[name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")]
        pose = camera.camera_to_worlds.numpy() - np.float32(shot["transform_matrix"])[:3]
        worst["numbers"] = max(
            worst["numbers"], float(np.abs(pose).max()), *np.abs(np.subtract(values, np.float32(own)))
        )
        metres = get_depth_image_from_path(Path(depth), shot["h"], shot["w"], unit * outputs.dataparser_scale)
        stored = np.array(Image.open(Path(root) / shot["depth_file_path"])) * about["depth_unit_scale_factor"]
        rows, cols = (np.arange(n) * size // n for n, size in zip((shot["h"], shot["w"]), stored.shape, strict=True))
        stored = stored[rows[:, None], cols]  # a smaller map is repeated to the picture's size, never interpolated
        assert np.array_equal(stored > 0, metres.numpy()[..., 0] > 0), i
        worst["depth"] = max(worst["depth"], float(np.abs(metres.numpy()[..., 0] - stored).max()))
    said = {"frames": len(shots), "unit": unit, "largest_difference": worst}
    if points:
        header, _, body = (Path(root) / about["ply_file_path"]).read_bytes().partition(b"end_header\n")
        assert header.count(b"property") == 6, "x y z as floats, red green blue as bytes"
        stored = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
        assert np.array_equal(outputs.metadata["points3D_rgb"].numpy(), stored["rgb"])
        worst["points"] = float(np.abs(outputs.metadata["points3D_xyz"].numpy() - stored["xyz"]).max())
        said["points"] = len(stored)
    print(json.dumps(said))


if __name__ == "__main__":
    main(sys.argv[1])
