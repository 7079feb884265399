"""A map seen from outside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.drawing import INK, RECOVERED, SENSOR, legend, panel, save, source_colours
from dhtorch.geometry import se3
from dhtorch.geometry.camera import project
from dhtorch.integrate.surface import Surface
from dhtorch.integrate.volume import splat
from dhtorch.records import Camera, Pose


def draw_map(
    path: str | Path,
    surface: Surface,
    cameras: Sequence[Pose],  # T_world_from_cam (1) of the views it is made of
    up: Sequence[float],  # in the world
    *,
    voxel: float,
    hw: tuple[int, int] = (600, 800),
) -> None:
    """Draw a map from outside, walls that face away left out: in its own colours, and by where it comes from."""
    T = _viewpoint(surface, cameras, up)
    light = se3.rotate(T.R.mT, surface.normal[None].double())[0] @ torch.tensor([0.3, -0.5, -0.8]).double()
    shade = 0.35 + 0.65 * light.abs().nan_to_num(0.5).clamp(0, 1)[:, None]
    by_source = torch.from_numpy(source_colours(surface.source)) / 255 * shade
    xyz = se3.apply(se3.invert(T), surface.xyz[None].double())
    away = (surface.normal.double() * (T.t - surface.xyz.double())).sum(-1) < 0
    ahead = (xyz[..., 2] > voxel) & ~away
    way = se3.apply(se3.invert(T), torch.cat([pose.t for pose in cameras])[None].double())
    lens = _fitted(torch.cat((xyz[ahead], way[way[..., 2] > voxel])), hw)
    uv = project(lens, xyz)
    depth = torch.where(ahead, xyz[..., 2], 0.0)
    colours = torch.cat((surface.features[:, :3].double(), by_source), -1)[None]
    seen = splat(lens, hw, uv, depth, torch.ones_like(depth), colours, T_world_from_cam=T, radius=0.8 * voxel)
    picture = torch.where(seen.depth[0, ..., None] > 0, seen.features[0], 1.0).clamp(0, 1).numpy()
    dots = project(lens, way)[way[..., 2] > voxel].numpy()
    figure, left = panel(4.8, 4.8 * hw[0] / hw[1], f"Map of {len(cameras)} views")
    right = figure.add_axes((1.03, 0, 1, 1))
    right.set_title("sensor and recovered", loc="left", fontsize=11)
    for axes, part in ((left, picture[..., :3]), (right, picture[..., 3:])):
        axes.imshow(part, interpolation="antialiased")
        axes.plot(*dots.T, color=INK, linewidth=0.8, marker="o", markersize=1.5)
        axes.set(xlim=(-0.5, hw[1] - 0.5), ylim=(hw[0] - 0.5, -0.5))
        axes.set_axis_off()
    for code, colour, name in ((Source.SENSOR, SENSOR, "sensor"), (Source.RECOVERED, RECOVERED, "recovered")):
        right.plot([], [], "s", color=colour, label=f"{name}  {int((surface.source == code).sum())}")
    legend(right, *right.get_legend_handles_labels())
    save(figure, path)


def _viewpoint(surface: Surface, cameras: Sequence[Pose], up: Sequence[float]) -> Pose:
    """Outside and above, looking where the cameras look on average."""
    above = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    ways = [pose.R[0, :, 2].double() for pose in cameras]
    level = [way - (way @ above) * above for way in (torch.stack(ways).mean(0), *ways, torch.eye(3).double()[0])]
    ahead = next(way / way.norm() for way in level if float(way.norm()) > 0.1)
    xyz = surface.xyz[:: 1 + len(surface.xyz) // 1_000_000].double()
    middle = xyz.median(0).values if len(xyz) else cameras[0].t[0].double() + ahead
    far = float((xyz - middle).norm(dim=-1).quantile(0.9)) if len(xyz) else 1.0
    side = torch.linalg.cross(ahead, above)
    z = torch.nn.functional.normalize(ahead - 0.25 * side - 0.45 * above, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(-above, z), dim=0)
    return Pose(torch.stack((x, torch.linalg.cross(z, x), z), 1)[None], (middle - 2.2 * far * z)[None])


def _fitted(xyz: Tensor, hw: tuple[int, int]) -> Camera:
    """A camera at the origin whose picture is filled by all points but the outermost."""
    if not len(xyz):
        return Camera(torch.full((1, 2), float(hw[1])).double(), torch.tensor([[hw[1] / 2, hw[0] / 2]]).double())
    flat = xyz[:: 1 + len(xyz) // 1_000_000, :2] / xyz[:: 1 + len(xyz) // 1_000_000, 2:]
    low, high = flat.quantile(0.005, 0), flat.quantile(0.995, 0)
    size = torch.tensor([hw[1], hw[0]]).double()
    focal = (0.9 * size / (high - low).clamp_min(1e-3)).amin()
    return Camera(focal.expand(1, 2), (size / 2 - focal * (low + high) / 2)[None])
