"""A depth camera that plays the built-in room, and a robot with it that reads as LeRobot's own robots do."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig

from dhtorch.synthetic.two_cameras import open_two_cameras

HW, N_FRAMES, RANGE_M = (192, 256), 6, 2.5


@cache
def room(range_m=RANGE_M):
    """Frames of the room; depth beyond the range has no return."""
    sized = {"hw": HW, "depth_hw": HW, "supersample": 2, "step_m": 0.03, "range_limit": range_m, "n_frames": N_FRAMES}
    recording = open_two_cameras(seed=2, **sized)[0].recording
    return [recording[i] for i in range(N_FRAMES)]


def intrinsics():
    """fx, fy, cx, cy of the room's camera, px."""
    camera = room()[0].camera
    return [*camera.f[0].tolist(), *camera.c[0].tolist()]


@CameraConfig.register_subclass("fake_depth")
@dataclass(kw_only=True)
class FakeDepthCameraConfig(CameraConfig):
    """Options of the played camera."""

    fps: int | None = 30
    height: int | None = HW[0]
    width: int | None = HW[1]
    use_depth: bool = True


class FakeDepthCamera(Camera):
    """One frame further with every picture that is read; depth in whole millimetres, (H, W, 1)."""

    use_rgb = use_depth = True

    def __init__(self, config):
        super().__init__(config)
        self.at, self.on = -1, False

    is_connected = property(lambda self: self.on)
    find_cameras = staticmethod(list)

    def connect(self, warmup=True):
        self.on = True

    def disconnect(self):
        self.on = False

    def read(self):
        self.at = min(self.at + 1, N_FRAMES - 1)
        return np.ascontiguousarray((room()[self.at].image[0].permute(1, 2, 0) * 255).round().byte().numpy())

    def async_read(self, timeout_ms=200):
        return self.read()

    def read_latest(self, max_age_ms=500):
        return self.read()

    def read_depth(self):
        depth = room()[self.at].depth[0].nan_to_num(0.0)
        return (depth * 1000).round().numpy().astype(np.uint16)[..., None]


@RobotConfig.register_subclass("fake_arm")
@dataclass(kw_only=True)
class FakeArmConfig(RobotConfig):
    """Options of the robot."""

    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class FakeArm(Robot):
    """Eight joints that go where they are sent, and cameras, read as ``so_follower`` reads them."""

    config_class, name = FakeArmConfig, "fake_arm"
    is_calibrated = True

    def __init__(self, config):
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)
        self.joints = {f"joint_{i}.pos": 0.0 for i in range(8)}
        self.sent = []

    @property
    def observation_features(self):
        shapes = {}
        for name, camera in self.cameras.items():
            shapes[name] = (camera.height, camera.width, 3)
            if getattr(camera, "use_depth", False):
                shapes[f"{name}_depth"] = (camera.height, camera.width, 1)
        return {**dict.fromkeys(self.joints, float), **shapes}

    action_features = property(lambda self: dict.fromkeys(self.joints, float))
    is_connected = property(lambda self: all(camera.is_connected for camera in self.cameras.values()))

    def connect(self, calibrate=True):
        for camera in self.cameras.values():
            camera.connect()

    def calibrate(self): ...

    def configure(self): ...

    def get_observation(self):
        observation = dict(self.joints)
        for name, camera in self.cameras.items():
            observation[name] = camera.read_latest()
            if getattr(camera, "use_depth", False):
                newest = getattr(camera, "read_latest_depth", camera.read_depth)
                observation[f"{name}_depth"] = newest()
        return observation

    def send_action(self, action):
        self.sent.append(action)
        self.joints |= action
        return action

    def disconnect(self):
        print(f"actions sent: {len(self.sent)}")
        for camera in self.cameras.values():
            camera.disconnect()
