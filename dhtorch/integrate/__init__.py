"""Global integration: many views with their uncertainty → one map, as a signed distance field, points or a mesh.

:func:`fuse` blends depth, the sensor's, recovered or swept, into a sparse :class:`Volume`; :func:`points` and
:func:`mesh` take the surface out of it. ``sweeps`` asks for depth of every pixel, ``recording`` places the frames of a
recording and fuses what they say. The map only widens: nothing here moves a camera or closes a loop.
"""

from dhtorch.integrate.surface import Surface, mesh, points
from dhtorch.integrate.volume import View, Volume, confirmed, empty, fuse, reserve, splat

__all__ = ["Surface", "View", "Volume", "confirmed", "empty", "fuse", "mesh", "points", "reserve", "splat"]
