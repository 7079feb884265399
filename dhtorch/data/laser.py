"""True depth from a laser scan: rendered depth -> image pixels, rejected where it disagrees with the sensor.

Registration to the scan can fail, and the scan may be associated with another instant than the image. Both cause
disagreement with the frame's own sensor over their common pixels; the sensor is accurate enough to detect this, though
not to serve as truth.
"""

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
    """Laser depth → (depth (H, W) at the image's pixels, its disagreement with the sensor).

    Returns:
        The depth is 0 everywhere if the disagreement exceeds the limit or no pixel is common (then it is NaN).
    """
    at_sensor = resample_depth(laser, laser_camera, sensor_camera, (sensor.shape[0], sensor.shape[1]))
    common = (at_sensor > 0) & (sensor > 0)
    difference = ((sensor - at_sensor).abs() / at_sensor)[common]
    disagreement = float(difference.median()) if bool(common.any()) else math.nan
    if not disagreement <= max_disagreement:
        return torch.zeros(hw, dtype=laser.dtype), disagreement
    return resample_depth(laser, laser_camera, camera, hw), disagreement
