"""Frames of the box of ``box_scene.py`` with a texture that can be tracked; fast to render."""

import torch

from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose
from support import box_scene as box

HW = (96, 128)
CAMERA = Camera(torch.tensor([[88.0, 86.0]]), torch.tensor([[64.5, 46.0]]))

#: Range of the sensor, m.
NEAR = 3.0


def at(i: float, step_m: float = 0.04) -> Pose:
    """Pose ``i`` of a walk to the right that faces the far wall."""
    xi = torch.tensor([[0.05 + 0.01 * i, 0.6 - 0.012 * i, 0.02 * i, 0.2 + step_m * i, 0.3 + 0.1 * step_m * i, -1.6]])
    return se3.exp(xi.double())


def view(T: Pose, hw: tuple[int, int] = HW, camera: Camera = CAMERA) -> Frame:
    """The frame of a camera at ``T`` in the box, with exact depth."""
    xyz, depth = box.hit(camera, T, hw)
    g = torch.Generator().manual_seed(0)
    wave = torch.randn(3, 24, generator=g, dtype=torch.float64)
    wave = wave / wave.norm(dim=0) * torch.logspace(0.6, 1.8, 24, dtype=torch.float64)  # 1.6 m to 10 cm
    tone = torch.sin(xyz @ wave + 6 * torch.rand(24, generator=g, dtype=torch.float64)).mean(-1) * 1.5
    grey = ((tone * 0.5 + 0.5).clamp(0, 1) * 255).round().to(torch.uint8)
    return Frame(grey.expand(1, 3, -1, -1).contiguous(), depth[None].float(), camera, T_world_from_cam=T)


def near(frame: Frame, limit: float = NEAR) -> Frame:
    """The frame with near returns only."""
    return frame.replace(depth=torch.where(frame.depth <= limit, frame.depth, torch.zeros_like(frame.depth)))
