"""Measurements: the metric size of a reconstruction; the motion of a camera that should stand still."""

from dhtorch.data.models import ModelView, SceneModel, read_model
from dhtorch.measure.pin import CameraPin, PinResult
from dhtorch.measure.scale import ScaleResult, metric_scale

__all__ = ["CameraPin", "ModelView", "PinResult", "ScaleResult", "SceneModel", "metric_scale", "read_model"]
