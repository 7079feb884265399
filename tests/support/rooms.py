"""Synthetic rooms that tests share, each rendered once in a process and never changed."""

from functools import cache

import torch

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.geometry import se3
from dhtorch.pytree import collate
from dhtorch.synthetic.paths import hand_held_path
from dhtorch.synthetic.recording import SyntheticRoom, room_to_scene
from support.writers.image_folders import write_tum


@cache
def room(**options) -> SyntheticRoom:
    """The synthetic room with these options; without antialiasing (four times slower) unless ``supersample`` is given."""
    return SyntheticRoom(**{"supersample": 1, **options})


def room_scene(recording, near=2.0, gap=6) -> Scene:
    """The recording as a scene with a near limit (m) and a frame gap; a scene is returned as it is."""
    if isinstance(recording, SyntheticRoom):
        return room_to_scene(recording, near, gap)
    return recording if isinstance(recording, Scene) else Scene(recording, near=near, gap=gap)


class Changed(SyntheticRoom):
    """A room with its frames changed by a function and some fields replaced."""

    def __init__(self, room, change=lambda frame: frame, **fields):
        self.__dict__.update(room.__dict__, **fields)
        self.whole, self.change = room, change

    def __getitem__(self, i):
        return self.change(self.whole[i])


def untold(room) -> Recording:
    """The recording of a room without its truth."""
    return Recording(name=room.name, format="made", load=room.__getitem__, number=room.number, poses=room.poses)


def moved_camera_capture(root):
    """A capture at ``root`` whose camera stands still, and elsewhere from its frame 4 of 8 on; the path and the frames."""
    here = hand_held_path("static", 1, step_m=0.0, rate_hz=30.0, seed=3)
    there = se3.compose(here, se3.exp(torch.tensor([[0.02, -0.03, 0.01, 0.02, 0.01, 0.03]], dtype=torch.float64)))
    poses = collate([*[here] * 4, *[there] * 4])
    options = {"hw": (120, 160), "depth_hw": (120, 160), "n_frames": 8, "seed": 3, "true_poses": poses}
    recording = SyntheticRoom(supersample=1, **options)  # poses cannot be a key of the cache
    frames = [recording[i] for i in range(8)]
    write_tum(root, frames)
    return root, frames
