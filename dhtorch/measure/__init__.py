"""Measurements: the metric size of a reconstruction; the motion of a camera that should stand still."""

from dhtorch.data.models import ModelView, SceneModel, read_model
from dhtorch.measure.change_points import find_change_points
from dhtorch.measure.pin import CameraPin
from dhtorch.measure.scale import ScaleResult, metric_scale
from dhtorch.records import PinResult

__all__ = [
    "CameraPin",
    "ModelView",
    "PinResult",
    "ScaleResult",
    "SceneModel",
    "find_change_points",
    "metric_scale",
    "read_model",
]
