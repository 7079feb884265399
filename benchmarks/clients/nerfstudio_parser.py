"""nerfstudio's own parser of an enriched folder: pictures, cameras, poses and depth, against the files.

In an environment that has nerfstudio, of which only what its parsers import is needed:
python benchmarks/clients/nerfstudio_parser.py NERFSTUDIO
"""

import json
import sys
from pathlib import Path

import numpy as np
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils.data_utils import get_depth_image_from_path
from PIL import Image

AS_WRITTEN = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "eval_mode": "all"}


def main(root: str) -> None:
    parsed = NerfstudioDataParserConfig(data=Path(root), downscale_factor=1, **AS_WRITTEN).setup()
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
    print(json.dumps({"frames": len(shots), "unit": unit, "largest_difference": worst}))


if __name__ == "__main__":
    main(sys.argv[1])
