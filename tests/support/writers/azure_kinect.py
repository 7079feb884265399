"""Test writer of Azure Kinect recordings."""

import json
import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.io.decode import import_optional
from dhtorch.export.arrays import (
    K_matrix,
    encode_depth_codes,
    frame_time_s,
    frame_to_hwc,
)
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

_TICKS_PER_S = 1000  # of the time base
#: Depth mode by its size (height, width): (side of the binned sensor, crop at the left, crop at the top).
_MODES = {(288, 320): (512, 96, 90), (576, 640): (1024, 192, 180), (512, 512): (512, 0, 0)}


def write_azure_kinect(
    file: Path,
    frames: Sequence[Frame],
    *,
    T_colour_from_depth: Pose | None = None,
    T_depth_from_rig: Pose | None = None,
    lost_depth: Sequence[int] = (),
    names: tuple[str, str] = ("COLOR", "DEPTH"),
    depth_codec: str = "rawvideo",
) -> None:
    """Write a ``.mkv`` with an MJPEG colour and a 16-bit depth track.

    Args:
        file: to be written.
        frames: depth has the camera ``depth_camera``, or that of the image.
        T_colour_from_depth: written with both cameras to the attachment ``calibration.json``; None = no attachment.
        T_depth_from_rig: place of the rig's origin, to which both poses refer; None = the depth camera.
        lost_depth: numbers of frames whose depth is not written.
        names: of the tracks.
        depth_codec: ``rawvideo`` (b16g, as the device's) or ``ffv1``.
    """
    av = import_optional("av")
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w", format="matroska", options={"allow_raw_vfw": "1"}) as container:
        streams = [
            _add_stream(container, "mjpeg", "yuvj444p", frames[0].hw, names[0]),
            _add_stream(
                container,
                depth_codec,
                "gray16be" if depth_codec == "rawvideo" else "gray16le",
                tuple(frames[0].depth.shape[1:]),
                names[1],
            ),
        ]
        streams[0].options = {"q:v": "2", "qmin": "1"}
        if T_colour_from_depth is not None:
            text = json.dumps(_calibration(frames[0], T_colour_from_depth, T_depth_from_rig)) + "\0"
            container.add_attachment("calibration.json", "application/octet-stream", text.encode())
        for i, frame in enumerate(frames):
            stamp = round((frame_time_s(frame) - frame_time_s(frames[0])) * _TICKS_PER_S)
            pictures = [(frame_to_hwc(frame), "rgb24"), (encode_depth_codes(frame.depth, 1000), "gray16le")]
            for k, (stream, (picture, pixels)) in enumerate(zip(streams, pictures, strict=True)):
                if k == 1 and i in lost_depth:
                    continue
                out = av.VideoFrame.from_ndarray(picture, format=pixels)
                out.pts, out.time_base = stamp, Fraction(1, _TICKS_PER_S)
                container.mux(stream.encode(out))
        for stream in streams:
            container.mux(stream.encode())
    if depth_codec == "rawvideo":
        _set_pixel_code(file, *frames[0].depth.shape[1:])


def _set_pixel_code(file: Path, h: int, w: int) -> None:
    """Complete the depth track's bitmap header as the device does: rows from the top, code of big-endian grey."""
    content = bytearray(file.read_bytes())
    at = content.index(struct.pack("<Iii", 40, w, -h))
    content[at + 8 : at + 12] = struct.pack("<i", h)
    content[at + 16 : at + 20] = b"b16g"
    file.write_bytes(content)


def _add_stream(container: Any, codec: str, pixels: str, hw: tuple[int, ...], name: str) -> Any:
    stream = container.add_stream(codec, rate=30)
    stream.pix_fmt = pixels
    stream.height, stream.width = hw
    stream.codec_context.time_base = Fraction(1, _TICKS_PER_S)
    stream.codec_context.thread_count = 1
    stream.metadata["title"] = name
    return stream


def _calibration(frame: Frame, T_colour_from_depth: Pose, T_depth_from_rig: Pose | None) -> dict[str, Any]:
    h, w = frame.hw
    side, left, top = _MODES[tuple(frame.depth.shape[1:])]  # type: ignore[index]
    T = se3.to_matrix(T_colour_from_depth)[0].double().numpy()
    rig = np.eye(4) if T_depth_from_rig is None else se3.to_matrix(T_depth_from_rig)[0].double().numpy()
    depth_camera = frame.depth_camera or frame.camera
    entries = [
        _entry("D0", depth_camera, grid=(side, side, left, top), sensor=(1024, 1024), T=rig),
        _entry("PV0", frame.camera, grid=(w, w * 3 // 4, 0, (w * 3 // 4 - h) // 2), sensor=(3072, 4096), T=T @ rig),
    ]
    return {"CalibrationInformation": {"Cameras": entries}}


def _entry(
    place: str, camera: Camera, *, grid: tuple[int, int, int, int], sensor: tuple[int, int], T: np.ndarray
) -> dict[str, Any]:
    w, h, left, top = grid
    K = K_matrix(camera)
    D = np.zeros(8)
    if camera.distortion is not None:
        coefficients = camera.distortion[0].double().numpy()
        D[: len(coefficients)] = coefficients
    k1, k2, p1, p2, k3, k4, k5, k6 = D.tolist()
    centre = [(K[0, 2] + 0.5 + left) / w, (K[1, 2] + 0.5 + top) / h]
    return {
        "Location": f"CALIBRATION_CameraLocation{place}",
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": [*centre, K[0, 0] / w, K[1, 1] / h, k1, k2, k3, k4, k5, k6, 0, 0, p2, p1],
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "MetricRadius": 1.74,
        "Rt": {"Rotation": T[:3, :3].reshape(-1).tolist(), "Translation": T[:3, 3].tolist()},
        "SensorHeight": sensor[0],
        "SensorWidth": sensor[1],
    }
