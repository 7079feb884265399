"""Drawing of a map seen from outside, in its own colours and coloured by source."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dhtorch.codes import Source, names, words
from dhtorch.geometry import se3
from dhtorch.geometry.camera import project
from dhtorch.integrate.surface import Surface
from dhtorch.integrate.volume import VOLUME_SOURCES, splat_points
from dhtorch.records import Camera, Pose
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import add_legend, colours, make_image_grid, mark_options, prefix_title, save_figure
from dhtorch.viz.plots.colours import INK, SOFT, colour_by_source

#: Allowed lengths of the scale bar, m.
_SCALE_BAR_LENGTHS_M = tuple(m * 10.0**e for e in range(-3, 4) for m in (1, 2, 5))


def draw_map(
    path: str | Path,
    surface: Surface,
    cameras: Sequence[Pose],  # T_world_from_cam (1) of the fused views
    up: Sequence[float],  # in the world
    *,
    voxel: float,
    title: str = "",
    hw: tuple[int, int] = (600, 800),
) -> None:
    """Draw a map from outside, without walls that face away: in its own colours, and coloured by source.

    The scale bar is valid at the median depth of the map; nearer parts appear larger and farther ones smaller.
    """
    T = _viewpoint(surface, cameras, up)
    light = se3.rotate(T.R.mT, surface.normal[None].double())[0] @ torch.tensor([0.3, -0.5, -0.8]).double()
    shade = 0.35 + 0.65 * light.abs().nan_to_num(0.5).clamp(0, 1)[:, None]
    by_source = torch.from_numpy(colour_by_source(surface.source)) / 255 * shade
    xyz = se3.apply(se3.invert(T), surface.xyz[None].double())
    faces_away = (surface.normal.double() * (T.t - surface.xyz.double())).sum(-1) < 0
    ahead = (xyz[..., 2] > voxel) & ~faces_away
    camera_path = se3.apply(se3.invert(T), torch.cat([pose.t for pose in cameras])[None].double())
    camera = _fit_camera(torch.cat((xyz[ahead], camera_path[camera_path[..., 2] > voxel])), hw)
    uv = project(camera, xyz)
    depth = torch.where(ahead, xyz[..., 2], 0.0)
    colours_of_both = torch.cat((surface.features[:, :3].double(), by_source), -1)[None]
    view = splat_points(
        camera, hw, uv, depth, torch.ones_like(depth), colours_of_both, T_world_from_cam=T, radius=0.8 * voxel
    )
    picture = torch.where(view.depth[0, ..., None] > 0, view.features[0], 1.0).clamp(0, 1).numpy()
    dots = project(camera, camera_path)[camera_path[..., 2] > voxel].numpy()
    counts = {code: int((surface.source == code).sum()) for code in VOLUME_SOURCES}
    shown_counts = {code: n for code, n in counts.items() if n or code in (Source.SENSOR, Source.RECOVERED)}
    *first, last = (words(names(Source)[code]) for code in shown_counts)
    sources = f"{', '.join(first)} and {last}".capitalize()
    pictures = {
        prefix_title(f"Map of {format_count(len(cameras), 'view')}", title): picture[..., :3],
        sources: picture[..., 3:],
    }
    metre = float(camera.f[0, 0] / depth[depth > 0].median()) if bool((depth > 0).any()) else None
    _side_by_side(path, pictures, dots, shown_counts, metre)


def _side_by_side(
    path: str | Path,
    pictures: Mapping[str, np.ndarray],  # title → (H, W, 3) in [0, 1]
    camera_path: np.ndarray,  # (V, 2) px, positions of the cameras
    counts: Mapping[int, int],  # codes.Source → points
    metre: float | None,  # px
) -> None:
    """Draw images of one size with the camera path and a scale bar on each, and a legend of the sources."""
    figure, (images,) = make_image_grid("", [list(pictures.items())], width=346.0)
    H, W = next(iter(pictures.values())).shape[:2]
    inside = camera_path[((camera_path >= -0.5) & (camera_path <= (W - 0.5, H - 0.5))).all(-1)]
    for axes in images:
        axes.plot(*inside.T, "o-", color=INK, linewidth=0.8, markersize=1.5)
        if metre is not None:  # a bar of a round length, at most a fifth of the width, in the lower left corner
            length = max((x for x in _SCALE_BAR_LENGTHS_M if x * metre <= W / 5), default=_SCALE_BAR_LENGTHS_M[0])
            left, low = 0.017 * W, H - 0.017 * W
            axes.plot([left, left + length * metre], [low, low], "|-", color=INK, linewidth=1.2, markersize=5)
            axes.text(left, low - 0.014 * W, f"{length:g} m", color=SOFT)
    labels = {code: words(name) for code, name in names(Source).items()} | {Source.SWEPT: "recovered (swept)"}
    keys = {f"{labels[code]}  {n}": mark_options(colours.SOURCE_COLOURS[code], "s") for code, n in counts.items()}
    add_legend(figure, keys, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    save_figure(figure, path)


def _viewpoint(surface: Surface, cameras: Sequence[Pose], up: Sequence[float]) -> Pose:
    """Pose T_world_from_cam (1) outside and above the map, in the mean viewing direction of the cameras."""
    above = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    directions = [pose.R[0, :, 2].double() for pose in cameras]
    level = [
        direction - (direction @ above) * above
        for direction in (torch.stack(directions).mean(0), *directions, torch.eye(3).double()[0])
    ]
    ahead = next(direction / direction.norm() for direction in level if float(direction.norm()) > 0.1)
    xyz = surface.xyz[:: 1 + len(surface.xyz) // 1_000_000].double()
    middle = xyz.median(0).values if len(xyz) else cameras[0].t[0].double() + ahead
    far = float((xyz - middle).norm(dim=-1).quantile(0.9)) if len(xyz) else 1.0
    side = torch.linalg.cross(ahead, above)
    z = torch.nn.functional.normalize(ahead - 0.25 * side - 0.45 * above, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(-above, z), dim=0)
    return Pose(torch.stack((x, torch.linalg.cross(z, x), z), 1)[None], (middle - 2.2 * far * z)[None])


def _fit_camera(xyz: Tensor, hw: tuple[int, int]) -> Camera:
    """Camera (1) at the origin whose image ``xyz`` (P, 3) fill, without the outermost 0.5 % at each side."""
    if not len(xyz):
        return Camera(torch.full((1, 2), float(hw[1])).double(), torch.tensor([[hw[1] / 2, hw[0] / 2]]).double())
    flat = xyz[:: 1 + len(xyz) // 1_000_000, :2] / xyz[:: 1 + len(xyz) // 1_000_000, 2:]
    low, high = flat.quantile(0.005, 0), flat.quantile(0.995, 0)
    size = torch.tensor([hw[1], hw[0]]).double()
    focal = (0.9 * size / (high - low).clamp_min(1e-3)).amin()
    return Camera(focal.expand(1, 2), (size / 2 - focal * (low + high) / 2)[None])
