"""dhtorch: a short-range depth sensor as a metric ruler.

Near returns fix the metric relative pose of two views; what can be tracked beyond the sensor's reach is triangulated
under that pose; weak geometry stays a hole that says why. ``extend`` is the method, ``merge`` the map it gives.
"""

from dhtorch.pair import extend, merge
from dhtorch.records import Camera, Estimate, Frame, Map, Pose, PoseFit, Samples, Tracks
from dhtorch.transform import ExtendDepth
from dhtorch.tree import collate

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Estimate",
    "ExtendDepth",
    "Frame",
    "Map",
    "Pose",
    "PoseFit",
    "Samples",
    "Tracks",
    "collate",
    "extend",
    "merge",
]
