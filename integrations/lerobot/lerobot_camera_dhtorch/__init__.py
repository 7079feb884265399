"""dhtorch in LeRobot: an import registers the processor steps and the camera type ``dhtorch``."""

from lerobot_camera_dhtorch.camera import DhtorchCamera
from lerobot_camera_dhtorch.config_dhtorch import DhtorchCameraConfig
from lerobot_camera_dhtorch.steps import (
    CameraPinStep,
    ExtendDepthStep,
    GeometryImageStep,
    MaskSilenceStep,
    PointCloudStep,
    ValidateDepthStep,
    insert_steps,
)

__all__ = [
    "CameraPinStep",
    "DhtorchCamera",
    "DhtorchCameraConfig",
    "ExtendDepthStep",
    "GeometryImageStep",
    "MaskSilenceStep",
    "PointCloudStep",
    "ValidateDepthStep",
    "insert_steps",
]
