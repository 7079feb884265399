"""A small data set of the synthetic room as sample dicts; at module level, so that spawned workers can import it."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import torch

from dhtorch.geometry import camera as cam
from dhtorch.synthetic.recording import SyntheticRoom

GAP = 6
SIDE = 112
NEAR = 2.0

#: Info of a depth feature, as LeRobot 0.6.1 writes it into meta/info.json for a video with its default options.
DEPTH_VIDEO = {
    "is_depth_map": True, "depth_unit": "mm", "video.height": SIDE, "video.width": SIDE, "video.codec": "hevc",
    "video.pix_fmt": "gray12le", "video.fps": 30, "video.channels": 1, "has_audio": False, "video.g": 2,
    "video.crf": 30, "video.preset": None, "video.fast_decode": 0, "video.video_backend": "pyav",
    "video.extra_options": {"x265-params": "lossless=1"}, "video.depth_min": 0.01, "video.depth_max": 10.0,
    "video.shift": 3.5, "video.use_log": True,
}  # fmt: skip


def depth_video(key, output="mm", **info):
    """What a LeRobotDataset declares of its depth video ``key``, handed out in ``output``; ``info`` replaces entries."""
    about = {**DEPTH_VIDEO, **{f"video.{name}": value for name, value in info.items()}}
    feature = {"dtype": "video", "shape": (SIDE, SIDE, 1), "names": ["height", "width", "channels"], "info": about}
    return {"meta": SimpleNamespace(features={key: feature}, depth_keys=[key]), "depth_output_unit": output}


@cache
def room():
    return SyntheticRoom(hw=(SIDE, SIDE), n_frames=12, lidar="exact", image_noise=0.0, supersample=1)


@cache
def frames():
    """Samples: uint8 HWC image, uint16 mm depth cut at the near limit, 3×3 intrinsics, as arrays; two episodes."""
    source, samples = room(), []
    for i in range(len(source)):
        frame = source[i]
        mm = torch.where(frame.depth[0] <= NEAR, frame.depth[0] * 1000, 0.0).round().numpy().astype(np.uint16)
        sample = {
            "image": frame.image[0].permute(1, 2, 0).contiguous().numpy(),
            "depth": mm,
            "intrinsics": cam.to_matrix(frame.camera)[0].numpy(),
            "index": i,
            "episode_index": i // 9,
            "task": "look around",
        }
        samples.append(sample)
    return samples


class Frames(torch.utils.data.Dataset):
    """Map-style; ``corrupt`` items raise as a decoder would."""

    fps = 30

    def __init__(self, items, corrupt=()):
        self.items, self.corrupt = list(items), set(corrupt)

    def __len__(self):
        return len(self.items)

    def __getitem__(self, i):
        if i in self.corrupt:
            raise OSError(f"frame {i}: premature end of file")
        if not 0 <= i < len(self.items):
            raise IndexError(i)
        return self.items[i]


class Stream(torch.utils.data.IterableDataset):
    fps = 30

    def __init__(self, items):
        self.items = list(items)

    def __iter__(self):
        return iter(self.items)
