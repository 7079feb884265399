"""Global integration: many views with their uncertainty → one map, as a signed distance field, points or a mesh.

:func:`fuse` blends depth, the sensor's or recovered, into a sparse :class:`Volume`; :func:`points` and :func:`mesh`
take the surface out of it. ``recording`` places the frames of a recording and fuses what they say. The map only widens:
nothing here moves a camera or closes a loop.
"""

from dhtorch.integrate.surface import Surface, mesh, points
from dhtorch.integrate.volume import View, Volume, empty, fuse, splat

__all__ = ["Surface", "View", "Volume", "empty", "fuse", "mesh", "points", "splat"]
