"""Global integration: many views with their uncertainty → one map, as a signed distance field, points or a mesh.

:func:`fuse_views` blends depth, the sensor's, recovered or swept, into a sparse :class:`Volume`; :func:`extract_points`
and :func:`extract_mesh` take the surface out of it. ``sweeps`` asks for depth of every pixel, ``recording`` places the
frames of a recording and fuses what they say. The map only widens: nothing here moves a camera or closes a loop.
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
