"""A quick walk past boards that stand in a textured room: exact depth with many steps, which move in the picture."""

from functools import cache

import torch
from torch import Tensor

from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

N = 14
HW = (96, 128)
CAMERA = Camera(torch.tensor([[100.0, 98.0]]), torch.tensor([[64.5, 46.0]]))

#: Boards that face the camera: middle x, y, distance z, half width and half height, m. Nothing is symmetric.
BOARDS = (
    (-1.3, 0.3, 1.9, 0.22, 0.5),
    (-0.75, -0.45, 2.5, 0.3, 0.2),
    (-0.35, 0.35, 1.5, 0.16, 0.4),
    (0.1, -0.3, 1.8, 0.2, 0.3),
    (0.5, 0.5, 2.2, 0.25, 0.3),
    (0.9, -0.1, 1.6, 0.15, 0.45),
    (1.4, 0.2, 2.4, 0.3, 0.3),
    (1.9, -0.3, 1.9, 0.2, 0.5),
    (0.3, 0.9, 2.6, 0.9, 0.12),
)
_BACK_M, _FLOOR_M = 3.2, 1.1


def at(k: float) -> Pose:
    """Pose ``k``: 4 cm to the right and a turn by 1.6 degrees to the left each frame, with some sway."""
    sway = float(torch.sin(torch.tensor(0.7 * k)))
    xi = torch.tensor([[0.015 * sway, 0.2 - 0.028 * k, 0.01 * sway, -0.25 + 0.04 * k, 0.012 * sway, 0.05 * sway]])
    return se3.exp(xi.double())


def view(T: Pose) -> Frame:
    """The frame of a camera at ``T``."""
    v, u = torch.meshgrid(torch.arange(HW[0]), torch.arange(HW[1]), indexing="ij")
    uv = torch.stack((u, v), -1).reshape(1, -1, 2).double()
    ray, start = se3.rotate(T.R, cameras.rays(CAMERA.to(torch.float64), uv))[0], T.t[0]
    depth = (_BACK_M - start[2]) / ray[:, 2].clamp_min(1e-6)
    floor = torch.where(ray[:, 1] > 1e-6, (_FLOOR_M - start[1]) / ray[:, 1].clamp_min(1e-6), torch.inf)
    surface = torch.where(floor < depth, 1, 0)
    depth = torch.minimum(depth, floor)
    for k, (x, y, z, w, h) in enumerate(BOARDS):
        along = (z - start[2]) / ray[:, 2].clamp_min(1e-6)
        at_board = start + along[:, None] * ray
        hit = ((at_board[:, 0] - x).abs() < w) & ((at_board[:, 1] - y).abs() < h) & (along < depth)
        depth, surface = torch.where(hit, along, depth), torch.where(hit, k + 2, surface)
    image = _paint(start + depth[:, None] * ray, surface)
    depth = torch.where(depth < 6, depth, 0.0)  # the sensor's range
    return Frame(image, depth.reshape(1, *HW).float(), CAMERA, T_world_from_cam=T)


def _paint(xyz: Tensor, surface: Tensor) -> Tensor:
    """Grey pictures (1, 3, h, w) of points (P, 3): a tone for each surface, and fine waves."""
    g = torch.Generator().manual_seed(0)
    tone = torch.rand(len(BOARDS) + 2, generator=g, dtype=torch.float64)[surface]
    wave = torch.randn(3, 16, generator=g, dtype=torch.float64)
    wave = wave / wave.norm(dim=0) * torch.logspace(0.9, 1.7, 16, dtype=torch.float64)
    waves = torch.sin(xyz @ wave + 6 * torch.rand(16, generator=g, dtype=torch.float64)).mean(-1)
    grey = ((0.15 + 0.6 * tone + 0.45 * waves).clamp(0, 1) * 255).round().to(torch.uint8)
    return grey.reshape(1, 1, *HW).expand(1, 3, *HW).contiguous()


@cache
def walk(n: int = N) -> tuple[Frame, ...]:
    """The first ``n`` frames of the walk."""
    return tuple(view(at(k)) for k in range(n))
