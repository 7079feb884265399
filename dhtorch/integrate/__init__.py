"""Integration of many depth views with their uncertainty into one map: a signed distance field, points or a mesh.

:func:`fuse_views` blends depth, the sensor's, recovered or swept, into a sparse :class:`Volume`; :func:`extract_points`
and :func:`extract_mesh` extract its surface. ``sweeps`` computes dense depth maps, ``recording`` places the frames of a
recording and fuses their depth. Nothing here refines camera poses or closes loops.
"""

from dhtorch.integrate.surface import Surface, extract_mesh, extract_points
from dhtorch.integrate.volume import (
    DepthView,
    Volume,
    drop_unconfirmed,
    fuse_views,
    make_volume,
    reserve_blocks,
    splat_points,
)

__all__ = [
    "DepthView",
    "Surface",
    "Volume",
    "drop_unconfirmed",
    "extract_mesh",
    "extract_points",
    "fuse_views",
    "make_volume",
    "reserve_blocks",
    "splat_points",
]
