"""Measurements: the metric size of a reconstruction."""

from dhtorch.measure.models import ModelView, SceneModel, read_model
from dhtorch.measure.scale import ScaleResult, metric_scale

__all__ = ["ModelView", "ScaleResult", "SceneModel", "metric_scale", "read_model"]
