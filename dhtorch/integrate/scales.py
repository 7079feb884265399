"""Two grids of one map: a fine one for sensor depth and a coarse one for the less accurate recovered depth.

A grid stores distances up to a few voxels from a surface. For depth more accurate than that a finer grid would show
more detail; for less accurate depth the views of one surface do not overlap. Sensor depth and triangulated depth differ
tenfold in sigma, so each has voxels of its own size, and the map is the union of both surfaces.
"""

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.integrate.surface import Surface

#: Largest twofold sigma of depth that is fused, in truncations of the grid.
MAX_REACH_TRUNCATIONS = 5.0
#: Maps whose sigmas determine the size of the coarse voxels.
N_MAPS_FOR_VOXEL = 5


def choose_coarse_voxel(voxel: float, sigma: Tensor) -> float | None:
    """Voxel, m, of the grid for depth of standard deviations ``sigma`` (P,) m; None = one grid of ``voxel`` suffices.

    Gradient: none.
    """
    usable = sigma[sigma.isfinite() & (sigma > 0)]
    coarse = float(usable.median()) / 4 if len(usable) else 0.0
    return float(f"{coarse:.2g}") if coarse > 1.5 * voxel else None


def merge_surfaces(fine: Surface, wide: Surface) -> Surface:
    """Union of the fine surface and of the coarse surface's points that are not of the sensor.

    Both are points or both are meshes; a triangle is kept if all its corners are. Gradient: none.
    """
    keep = wide.source != Source.SENSOR
    face = None
    if fine.face is not None and wide.face is not None:
        kept_faces = wide.face[keep[wide.face].all(-1)]
        keep = torch.zeros_like(keep).index_fill(0, kept_faces.flatten().unique(), True)
        face = torch.cat((fine.face, (keep.cumsum(0) - 1)[kept_faces] + len(fine.xyz)))
    return Surface(
        xyz=torch.cat((fine.xyz, wide.xyz[keep])),
        normal=torch.cat((fine.normal, wide.normal[keep])),
        features=torch.cat((fine.features, wide.features[keep])),
        sigma=torch.cat((fine.sigma, wide.sigma[keep])),
        source=torch.cat((fine.source, wide.source[keep])),
        face=face,
    )
