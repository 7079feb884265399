"""Cameras of a bag's topics, from their ``CameraInfo``."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import ros_images, ros_messages
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.rosbag_index import BagIndex, PictureStream
from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera


class TopicCamera(NamedTuple):
    """Camera of a topic."""

    camera: Camera
    report: tuple[str, ...] = ()


def find_camera(bag: BagIndex, stream: PictureStream) -> TopicCamera | None:
    """Camera of a topic from the CameraInfo beside it, else from the only one of its frame; None without any."""
    assert stream.head is not None
    parent = stream.base.rpartition("/")[0]
    names = [f"{parent}/camera_info", f"{stream.base}/camera_info", f"{parent.rpartition('/')[0]}/info/camera_info"]
    name = next((name for name in names if name in bag.infos), None)
    if name is None:
        frame = stream.head.frame
        of_frame = [n for n, info in bag.infos.items() if frame and info.header.frame == frame and info.K[0, 0] > 0]
        name = of_frame[0] if len(of_frame) == 1 else None
    if name is None or not bag.infos[name].K[0, 0] > 0:  # 0 = not calibrated
        return None
    info, where = bag.infos[name], Path(f"{bag.root}{name}")
    is_rectified = "rect" in stream.base.rpartition("/")[2] and info.P[0, 0] > 0
    K, D = (info.P[:, :3], None) if is_rectified else (info.K, ros_images.to_opencv_distortion(info, where))
    K, hw = _crop(K, info)
    report: tuple[str, ...] = ()
    if hw != stream.head.hw:
        h, w = stream.head.hw
        if abs(w * hw[0] - h * hw[1]) > max(h, w):  # more than a pixel off the calibration's aspect
            raise FormatError(where, "width, height", f"{hw[1]}x{hw[0]}", f"{w}x{h} as {stream.topic.name}")
        K = convert.resize_K(K, hw, stream.head.hw)
        report = (f"{stream.topic.name}: K of {hw[1]}x{hw[0]} pixels is scaled to {w}x{h}",)
    return TopicCamera(convert.to_camera(K, stream.head.hw, where, "P" if is_rectified else "K", D), report)


def _crop(K: np.ndarray, info: ros_messages.CameraInfo) -> tuple[np.ndarray, tuple[int, int]]:
    """K and size of the region of interest after binning."""
    h, w = (roi or whole for roi, whole in zip(info.roi_hw, info.hw, strict=True))
    K = K.copy()
    K[:2, 2] -= info.offset
    bx, by = (max(1, n) for n in info.binning)
    if (bx, by) == (1, 1):
        return K, (h, w)
    return convert.resize_K(K, (h, w), (h // by, w // bx)), (h // by, w // bx)


def differ_in_size_alone(camera: Camera, hw: tuple[int, int], own: Camera, depth_hw: tuple[int, int]) -> bool:
    """Whether two cameras differ in the size of their images alone."""
    scaled = cameras.resize(camera, hw, depth_hw)
    is_close = torch.allclose(scaled.f, own.f, rtol=1e-3) and torch.allclose(scaled.c, own.c, rtol=0, atol=0.51)
    if camera.distortion is None or own.distortion is None:
        return is_close  # a driver that registers depth may state no distortion of it
    is_alike = camera.distortion.shape == own.distortion.shape and torch.allclose(camera.distortion, own.distortion)
    return is_close and is_alike
