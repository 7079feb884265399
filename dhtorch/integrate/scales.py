"""Two grids of one map: one as fine as the sensor, one as coarse as what was recovered is unsure.

A grid keeps distances a few voxels from a surface. Where depth is surer than that, a finer grid would show more; where
it is less sure, views of one surface never meet. A sensor's depth and what two views tell differ tenfold in sigma, so
each gets voxels of its own size, and the map is both surfaces together.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dhtorch.codes import Source
from dhtorch.integrate.surface import Surface

#: Voxels of the coarse grid to a median sigma of what it holds.
_VOXELS_PER_SIGMA = 4
#: Truncations of a grid from which on twofold sigma says nothing there.
MAX_REACH_TRUNCATIONS = 5.0
#: Maps whose sigmas tell the size of the coarse voxels.
N_MAPS_FOR_VOXEL = 5
#: Coarse over fine voxel below which one grid holds all.
_MIN_COARSE_RATIO = 1.5


def choose_coarse_voxel(voxel: float, sigma: Tensor) -> float | None:
    """Voxel, m, of the grid for depth of standard deviations ``sigma`` (P,) m; None = the sensor's ``voxel`` will do.

    Gradient: none.
    """
    usable = sigma[sigma.isfinite() & (sigma > 0)]
    wide = float(usable.median()) / _VOXELS_PER_SIGMA if len(usable) else 0.0
    return float(f"{wide:.2g}") if wide > _MIN_COARSE_RATIO * voxel else None


def merge_surfaces(fine: Surface, wide: Surface) -> Surface:
    """The fine surface, and of the coarse one what the sensor has not made.

    Points or meshes, both of one kind; of a mesh those triangles stay of which all corners stay. Gradient: none.
    """
    keep = wide.source != Source.SENSOR
    face = None
    if fine.face is not None and wide.face is not None:
        whole = wide.face[keep[wide.face].all(-1)]
        keep = torch.zeros_like(keep).index_fill(0, whole.flatten().unique(), True)
        face = torch.cat((fine.face, (keep.cumsum(0) - 1)[whole] + len(fine.xyz)))
    return Surface(
        xyz=torch.cat((fine.xyz, wide.xyz[keep])),
        normal=torch.cat((fine.normal, wide.normal[keep])),
        features=torch.cat((fine.features, wide.features[keep])),
        sigma=torch.cat((fine.sigma, wide.sigma[keep])),
        source=torch.cat((fine.source, wide.source[keep])),
        face=face,
    )
