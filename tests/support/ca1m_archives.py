"""CA-1M archives of a walk inside the box: pictures, depth of another camera, and laser depth."""

from pathlib import Path

import numpy as np
import torch

from dhtorch.records import Camera, Frame
from support import writers
from support.arkitscenes_frames import VGA, VGA_HW, shots
from support.box_scene import CAMERA

LASER_HW = (72, 96)
LASER = Camera(torch.tensor([[92.0, 86.0]]), torch.tensor([[50.5, 31.0]]))


def ca1m_frames(n: int = 4) -> tuple[list[Frame], list[Frame]]:
    """(frames with a depth camera, frames with laser depth) at 10 Hz."""
    times = 100 + np.arange(n) / 10
    frames = []
    for image, depth in zip(shots(times, VGA, VGA_HW), shots(times), strict=True):
        frames.append(image.replace(depth=depth.depth, conf=depth.conf, depth_camera=CAMERA))
    return frames, shots(times, LASER, LASER_HW)


def ca1m_archive(folder: Path, n: int = 4, **options: object) -> tuple[Path, list[Frame], list[Frame]]:
    """(an archive written in this folder, its frames, its laser frames)."""
    frames, lasers = ca1m_frames(n)
    file = folder / "ca1m-val-42898570.tar"
    writers.write_ca1m(file, frames, lasers, **options)
    return file, frames, lasers
