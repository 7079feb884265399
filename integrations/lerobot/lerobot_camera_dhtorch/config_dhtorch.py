"""Options of the camera type ``dhtorch``."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.cameras import CameraConfig


@CameraConfig.register_subclass("dhtorch")
@dataclass(kw_only=True)
class DhtorchCameraConfig(CameraConfig):
    """A depth camera of LeRobot, and how its depth is extended.

    ``fps``, ``width`` and ``height`` are those of the depth camera, where they are not stated here.
    """

    camera: CameraConfig  # with use_depth: true
    intrinsics: list[float]  # fx, fy, cx, cy of the picture, px, as the camera's maker or a calibration states them
    depth_intrinsics: list[float] | None = None  # of the depth map; None = it covers the same field as the picture
    depth_unit: str = "mm"  # of the camera's maps, as LeRobot's cameras give them
    gap: int = 1  # frames between the two views
    size: int = 160  # longer side of the computed map, px; it is enlarged to the picture's size
    method: str | None = None  # None = that of dense maps
    n: int | None = None  # samples per picture; None = the method's own number

    def __post_init__(self) -> None:
        for name in ("fps", "width", "height"):
            if getattr(self, name) is None:
                setattr(self, name, getattr(self.camera, name))
        if not getattr(self.camera, "use_depth", False):
            raise ValueError(f"camera {self.camera.type} has no use_depth: true, expected a depth camera")
        if len(self.intrinsics) != 4:
            raise ValueError(f"intrinsics has {len(self.intrinsics)} numbers, expected fx, fy, cx, cy")
