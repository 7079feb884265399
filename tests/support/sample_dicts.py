"""A small data set of the synthetic room as sample dicts; at module level, so that spawned workers can import it."""

from functools import cache

import numpy as np
import torch

from dhtorch.geometry import camera as cam
from dhtorch.synthetic.recording import SyntheticRoom

GAP = 6
SIDE = 112
NEAR = 2.0


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
