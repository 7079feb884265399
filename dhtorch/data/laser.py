"""Depth rendered from a laser scan, as the truth of a frame: taken to the image's pixels, held against the sensor.

Registration to the scan can fail, and the scan may be matched at another instant than the image. Both show as
disagreement with the frame's own sensor over the pixels where both answer; the sensor is good enough to notice, though
not good enough to judge by.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dhtorch.data.convert import resample_depth
from dhtorch.geometry.camera import Camera


def resample_laser_depth(
    laser: Tensor,  # (h, w) m, 0 = unknown
    laser_camera: Camera,
    sensor: Tensor,  # (h', w') m, 0 = no return
    sensor_camera: Camera,
    camera: Camera,  # of the image
    hw: tuple[int, int],
    max_disagreement: float,
) -> tuple[Tensor, float]:
    """Laser depth (H, W) at the image's pixels, and its disagreement with the sensor.

    Returns:
        The depth is 0 everywhere where the disagreement exceeds the limit, or where no pixel is shared (then NaN).
    """
    seen = resample_depth(laser, laser_camera, sensor_camera, (sensor.shape[0], sensor.shape[1]))
    off = _median_relative_difference(seen, sensor)
    if not off <= max_disagreement:
        return torch.zeros(hw, dtype=laser.dtype), off
    return resample_depth(laser, laser_camera, camera, hw), off


def _median_relative_difference(truth: Tensor, sensor: Tensor) -> float:
    """Median of |sensor − truth| / truth over the pixels where both answer; NaN where there is none."""
    both = (truth > 0) & (sensor > 0)
    if not bool(both.any()):
        return math.nan
    return float(((sensor - truth).abs() / truth)[both].median())
