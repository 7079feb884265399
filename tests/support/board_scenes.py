"""Scenes of textured boards seen by two cameras, with exact depth, for tests of dense maps."""

from dataclasses import dataclass

import torch

from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.records import Frame, Pose


@dataclass
class Board:
    """A textured plane z = depth + slope · x (m, world), between x and y limits; a mirror shows one behind it."""

    depth: float
    x: tuple[float, float] = (-9.0, 9.0)
    y: tuple[float, float] = (-9.0, 9.0)
    slope: float = 0.0
    stripes: float | None = None  # m, period of a texture that repeats along x
    plain: bool = False
    mirrored: float | None = None  # m, depth of what this board shows as a mirror
    seed: int = 0

    def colour(self, x, y):
        """Grey values in [0, 1] at points (x, y) of the board."""
        if self.plain:
            return torch.full_like(x, 0.5)
        if self.stripes:
            return 0.5 + 0.4 * torch.sin(2 * torch.pi * x / self.stripes)
        uv = torch.stack([x, y], -1).flatten(1, 2) * 90 + 350
        return plane_sweep.sample_bilinear(_paint(self.seed), uv % 690 + 4)[0][:, 0].view_as(x)


_PAINTED: dict[int, torch.Tensor] = {}


def _paint(seed):
    if seed not in _PAINTED:
        g = torch.Generator().manual_seed(seed)
        image = gaussian_blur(torch.rand(1, 1, 700, 700, generator=g), 1.5)
        _PAINTED[seed] = (image - image.min()) / (image.max() - image.min())
    return _PAINTED[seed]


def look(boards, t, *, hw=(120, 160), f=140.0, angle=(0.0, 0.0, 0.0)):
    """(frame with exact depth of a camera at ``t`` (m) turned by ``angle`` (rad), index of the board in each pixel)."""
    h, w = hw
    camera = Camera(torch.tensor([[f, f]]), torch.tensor([[w / 2 - 0.5, h / 2 - 0.5]]))
    T = se3.exp(torch.tensor([[*angle, 0.0, 0.0, 0.0]]))
    ray = se3.rotate(T.R, plane_sweep.pixel_rays(camera, hw)).unflatten(1, hw)
    x0, y0, z0 = t
    depth = torch.full((1, h, w), torch.inf)
    image = torch.zeros(1, h, w)
    which = torch.full((1, h, w), -1)
    for k, board in enumerate(boards):
        s = (board.depth + board.slope * x0 - z0) / (ray[..., 2] - board.slope * ray[..., 0])
        x, y = x0 + s * ray[..., 0], y0 + s * ray[..., 1]
        inside = (s > 0) & (x >= board.x[0]) & (x < board.x[1]) & (y >= board.y[0]) & (y < board.y[1]) & (s < depth)
        far = s if board.mirrored is None else (board.mirrored - z0) / ray[..., 2]
        shade = board.colour(x0 + far * ray[..., 0], y0 + far * ray[..., 1])
        image, depth, which = (
            torch.where(inside, shade, image),
            torch.where(inside, s, depth),
            torch.where(inside, k, which),
        )
    pose = Pose(T.R, torch.tensor([[x0, y0, z0]], dtype=torch.float32))
    z = (se3.rotate(T.R.mT, (depth[..., None] * ray).flatten(1, 2)))[..., 2].unflatten(1, hw)
    return Frame(image[:, None], z, camera, T_world_from_cam=pose), which
