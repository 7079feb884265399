"""A camera of LeRobot that gives the picture of another one, its depth extended, and the standard deviation of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from lerobot.cameras import Camera
from lerobot.cameras.utils import make_cameras_from_configs
from torch import Tensor
from torch.nn.functional import interpolate

from dhtorch import ExtendDepth
from lerobot_camera_dhtorch.config_dhtorch import DhtorchCameraConfig
from lerobot_camera_dhtorch.window import FrameWindow

#: Largest depth that a map of whole millimetres holds, mm. Source: derived, largest number of 16 bits less the code of
#: saturated sensors.
MAX_MM = 65534


class DhtorchCamera(Camera):
    """Picture, far depth and sigma of a depth camera.

    ``read``, ``async_read`` and ``read_latest`` give the picture; each takes a new frame of the depth camera, with the
    map that belongs to it. ``read_latest_depth`` and ``read_latest_sigma`` give the maps of that frame, which are
    computed when they are read first, in the thread that reads; ``read_depth``, ``async_read_depth`` and
    ``read_sigma`` take a frame before. Maps are (H, W, 1) uint16, mm, 0 = none, as those of LeRobot's cameras.
    """

    use_rgb = True
    use_depth = True

    def __init__(self, config: DhtorchCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.camera = make_cameras_from_configs({"depth": config.camera})["depth"]
        self.window = FrameWindow(config.gap)
        lens = None if config.depth_intrinsics is None else tuple(config.depth_intrinsics)
        self.extend = ExtendDepth(
            method=config.method,
            n=config.n,
            dense={"size": config.size},
            intrinsics=tuple(config.intrinsics),
            depth_intrinsics=lens,
            depth_unit=config.depth_unit,
            batched=False,
        )
        self._sample: dict[str, Tensor] | None = None
        self._maps: dict[str, np.ndarray] = {}

    @property
    def is_connected(self) -> bool:
        """Whether the depth camera is."""
        return self.camera.is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """None: the depth camera's own type finds it."""
        return []

    def connect(self, warmup: bool = True) -> None:
        """Connect the depth camera."""
        self.camera.connect(warmup)
        self.fps, self.width, self.height = self.camera.fps, self.camera.width, self.camera.height
        self.reset()

    def disconnect(self) -> None:
        """Disconnect the depth camera."""
        self.camera.disconnect()
        self.reset()

    def reset(self) -> None:
        """Forget past frames: the next one is the first of an episode."""
        self.window.reset()
        self._sample, self._maps = None, {}

    def read(self) -> np.ndarray:
        """The next picture (H, W, 3)."""
        return self._take(self.camera.read())

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The newest picture that was not read yet."""
        return self._take(self.camera.async_read(timeout_ms))

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """The newest picture."""
        return self._take(self.camera.read_latest(max_age_ms))

    def read_depth(self) -> np.ndarray:
        """Depth map of the next frame."""
        self.read()
        return self._map("depth_map")

    def async_read_depth(self, timeout_ms: float = 200) -> np.ndarray:
        """Depth map of the newest frame that was not read yet."""
        self.async_read(timeout_ms)
        return self._map("depth_map")

    def read_latest_depth(self, max_age_ms: int = 500) -> np.ndarray:
        """Depth map of the picture that was read last."""
        if self._sample is None:
            self.read_latest(max_age_ms)
        return self._map("depth_map")

    def read_sigma(self) -> np.ndarray:
        """Standard deviation of the next frame's depth map."""
        self.read()
        return self._map("sigma_map")

    def read_latest_sigma(self, max_age_ms: int = 500) -> np.ndarray:
        """Standard deviation of :meth:`read_latest_depth`."""
        if self._sample is None:
            self.read_latest(max_age_ms)
        return self._map("sigma_map")

    def _take(self, picture: np.ndarray) -> np.ndarray:
        """Keep a picture and its depth map as the newest frame; the same picture again is no new frame."""
        image = torch.as_tensor(picture)
        if self._sample is None or not torch.equal(self._sample["image"][-1], image):
            newest = getattr(self.camera, "read_latest_depth", self.camera.read_depth)  # 0.4 has the latter alone
            depth = torch.as_tensor(np.asarray(newest()).squeeze())
            images, depths, is_pad = self.window.push(image, depth)
            self._sample, self._maps = {"image": images, "depth": depths, "image_is_pad": is_pad}, {}
        return picture

    def _map(self, name: str) -> np.ndarray:
        """A map of the newest frame (H, W, 1) uint16, mm."""
        assert self._sample is not None
        if not self._maps:
            with torch.inference_mode():
                out = self.extend(self._sample)
            assert out is not None
            hw = self._sample["image"].shape[1:3]
            self._maps = {key: _millimetres(out[f"dhtorch.{key}"], hw) for key in ("depth_map", "sigma_map")}
        return self._maps[name]


def _millimetres(metres: Tensor, hw: tuple[int, int]) -> np.ndarray:
    """Map (h, w) m, 0 = none -> (H, W, 1) uint16, mm; what is known stays at least 1 mm."""
    large = interpolate(metres[None, None].float(), tuple(hw), mode="nearest")[0, 0]
    whole = (large * 1000).round().clamp(1, MAX_MM)
    return torch.where(large > 0, whole, 0.0).numpy().astype(np.uint16)[..., None]
