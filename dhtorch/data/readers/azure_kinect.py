"""Reader of Matroska videos with a colour and a depth track, as Azure Kinect's ``k4arecorder`` writes them.

Tracks are named ``COLOR`` (MJPEG, NV12 or YUY2), ``DEPTH`` (16 bits, mm) and ``IR``; the attachment
``calibration.json`` holds the factory's intrinsics, normalised and counted from the image's corner, and the extrinsics
of both cameras. With it the depth is registered to colour by a forward warp at its own density, holes are not filled.
Without it K has to be set, and the depth must have the colour's size: it is then taken as registered to colour.

Frames are colour and depth maps stamped within half a period of one another, at the colour's stamps; there is no pose.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.clocks import pair_stamps
from dhtorch.data.codecs import video
from dhtorch.data.io import decode as files
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.records import Camera, Frame, Pose

_CALIBRATION: Final = "calibration.json"  # name of the attachment
_DEPTH_FOURCC: Final = "b16g"  # 16 bits, big-endian
_UNITS_PER_METRE: Final = 1000.0  # of the depth codes. Source: Azure Kinect SDK, format of recordings
_CONVERTER: Final = "Open3D's azure_kinect_mkv_reader.py --input FILE.mkv --output FOLDER"

#: Depth mode by the size (height, width) of the map: (side of the binned sensor, crop at the left, crop at the top).
_DEPTH_MODES: Final = {
    (288, 320): (512, 96, 90),
    (576, 640): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
_SENSOR_ASPECT: Final = 3 / 4  # height by width of the colour sensor; modes of 16:9 are cropped alike above and below
_LEGACY_ASPECT: Final = 9 / 16  # of colour calibrations by older firmware: the sensor cropped to 16:9
_N_PARAMETERS: Final = 14  # cx cy fx fy k1 … k6 codx cody p2 p1


class _Tracks(NamedTuple):
    """Numbers of the tracks among those of video."""

    colour: int
    depth: int


def recognise(root: Path) -> str | None:
    """The content by which ``root`` is recognised as this format, as text; None if it is not."""
    tracks = _find_tracks(root)
    if tracks is None:
        return None
    track = video.list_video_tracks(root)[tracks.depth]
    return f"a video with a depth track {track.name or track.codec}"


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
) -> list[Recording]:
    """Open one video.

    Args:
        root: the ``.mkv`` file.
        intrinsics, K, fov: of the colour track instead of the attached calibration, see
            :mod:`dhtorch.data.intrinsics`.

    Returns:
        One recording without poses.

    Raises:
        FormatError: no depth track, no calibration and no K, depth of another size than colour without calibration,
            no frame with both, or a damaged file.
        ImportError: no decoder is installed.
    """
    root = Path(root)
    tracks = _find_tracks(root)
    if tracks is None:
        raise files.FormatError(root, "tracks", "no colour and depth track", "a Matroska video with both")
    headers = [video.read_video_header(root, track=track) for track in tracks]
    hw, depth_hw = (header.hw for header in headers)
    camera, report = intrinsics_options.parse_camera(root, hw, intrinsics, K, fov)
    calibration = _read_calibration(root, hw, depth_hw)
    if camera is None and calibration is not None:
        camera = calibration[0].camera
    if camera is None:
        raise intrinsics_options.missing_intrinsics_error(root, None, f"an attachment {_CALIBRATION} in the video")
    if calibration is None and hw != depth_hw:
        size = f"a depth track of {depth_hw[1]}x{depth_hw[0]} without {_CALIBRATION}"
        raise files.FormatError(root, "depth", size, f"{hw[1]}x{hw[0]} as the colour track, or files of {_CONVERTER}")
    times = [video.read_video_times(root, track=track) for track in tracks]
    pairs = pair_stamps(*times)
    if not len(pairs):
        problem = f"{len(times[0])} pictures and {len(times[1])} depth maps, none within half a period"
        raise files.FormatError(root, "time stamps", problem, "pairs")
    left_out = sorted(set(range(len(times[0]))) - set(pairs[:, 0].tolist()))
    lines = [*report, *files.format_left_out(left_out, "no depth map within half a period")]
    if calibration is None:
        lines.append(f"no {_CALIBRATION}: depth is taken as registered to colour")
    return [
        Recording(
            name=root.stem,
            format="azure_kinect",
            load=partial(
                _load_frame,
                file=root,
                tracks=tracks,
                pairs=pairs,
                hw=hw,
                depth_hw=depth_hw,
                camera=camera,
                calibration=calibration,
            ),
            number=torch.from_numpy(pairs[:, 0].copy()),
            root=root,
            times=torch.from_numpy(times[0][pairs[:, 0]]),
            rate_hz=headers[0].rate_hz,
            report=tuple(lines),
            depth_unit=DepthUnit(1 / _UNITS_PER_METRE, None if calibration is None else f"{root.name}: {_CALIBRATION}"),
        )
    ]


class _Lens(NamedTuple):
    """Camera of a calibration."""

    camera: Camera
    radius: float  # largest distance from the axis at depth 1 for which the model holds
    T_cam_from_rig: Pose


def _load_frame(
    i: int,
    *,
    file: Path,
    tracks: _Tracks,
    pairs: np.ndarray,  # (n, 2) numbers of picture and depth map
    hw: tuple[int, int],
    depth_hw: tuple[int, int],
    camera: Camera,
    calibration: tuple[_Lens, _Lens] | None,  # of colour and depth
) -> Frame:
    """Position → frame."""
    picture, depth_map = pairs[i].tolist()
    image = video.read_video_frame(file, picture, hw, track=tracks.colour)
    code = video.read_video_frame(file, depth_map, depth_hw, pixels="gray16le", track=tracks.depth)
    depth = torch.from_numpy(files.to_metres(code, _UNITS_PER_METRE))
    if calibration is not None:
        # Depth map of the colour camera at the density of the depth camera.
        of_colour, of_depth = calibration
        v, u = torch.nonzero(depth > 0, as_tuple=True)
        uv = torch.stack((u, v), -1).to(depth.dtype)
        xyz = cameras.unproject(of_depth.camera, uv[None], depth[v, u][None])
        T_colour_from_depth = se3.compose(of_colour.T_cam_from_rig, se3.invert(of_depth.T_cam_from_rig))
        xyz = se3.apply(T_colour_from_depth.to(depth.dtype), xyz)[0]
        is_modelled = xyz[:, :2].norm(dim=-1) <= of_colour.radius * xyz[:, 2]
        size = convert.size_of_registered_depth(of_depth.camera, camera, hw)
        depth = convert.splat_depth(xyz[is_modelled], cameras.resize(camera, hw, size), size)
    return Frame(torch.from_numpy(image).permute(2, 0, 1).contiguous()[None], depth[None], camera)


def _find_tracks(file: Path) -> _Tracks | None:
    """Numbers of the colour and depth track, by name, else by the type of their pixels; None without both."""
    if file.suffix.lower() != ".mkv" or not file.is_file():
        return None
    try:
        tracks = video.list_video_tracks(file)
    except files.FormatError:
        return None
    names = [track.name.upper() for track in tracks]
    visible = [i for i, name in enumerate(names) if name not in ("IR", "INFRARED")]
    depth = [i for i in visible if "DEPTH" in names[i]] or [i for i in visible if tracks[i].fourcc == _DEPTH_FOURCC]
    colour = [i for i in visible if names[i] in ("COLOR", "COLOUR", "RGB")] or visible
    colour = [i for i in colour if i not in depth]
    return _Tracks(colour[0], depth[0]) if colour and depth else None


# ------------------------------------------------------------------------------------------------------- calibration


def _read_calibration(file: Path, hw: tuple[int, int], depth_hw: tuple[int, int]) -> tuple[_Lens, _Lens] | None:
    """Lenses of the colour and the depth camera; None without an attached calibration."""
    content = video.read_attachment(file, _CALIBRATION)
    if content is None:
        return None
    where = Path(f"{file}/{_CALIBRATION}")
    value = files.decode_json(content.rstrip(b"\0"), where)
    entries = files.get_entry(value, "CalibrationInformation.Cameras", list, where)
    by_location = {str(entry.get("Location")): entry for entry in entries if isinstance(entry, dict)}
    locations = [f"CALIBRATION_CameraLocation{name}" for name in ("PV0", "D0")]
    lost = [location for location in locations if location not in by_location]
    files.refuse_if(lost, where, "Cameras", ", ".join(by_location) or "none", ", ".join(lost[:1]))
    colour, depth = (by_location[location] for location in locations)
    if depth_hw not in _DEPTH_MODES:
        size = f"{depth_hw[1]}x{depth_hw[0]}"
        expected = ", ".join(f"{w}x{h}" for h, w in _DEPTH_MODES)
        raise files.FormatError(file, "depth size", size, f"one of {expected}, the modes of {_CALIBRATION}")
    side, left, top = _DEPTH_MODES[depth_hw]
    return (
        _parse_lens(colour, _colour_grid(colour, hw, where), hw, where),
        _parse_lens(depth, (side, side, left, top), depth_hw, where),
    )


def _colour_grid(entry: dict[str, Any], hw: tuple[int, int], file: Path) -> tuple[float, float, float, float]:
    """(width, height, crop at the left, crop at the top) in px of the image to which normalised values refer."""
    h, w = hw
    sensor_h, sensor_w = (files.to_positive(entry.get(f"Sensor{side}"), file, side) for side in ("Height", "Width"))
    aspect = sensor_h / sensor_w
    files.refuse_if(
        not any(abs(aspect - known) < 1e-3 for known in (_SENSOR_ASPECT, _LEGACY_ASPECT)),
        file,
        "SensorWidth, SensorHeight",
        f"{sensor_w:g}x{sensor_h:g}",
        "4:3 or 16:9",
    )
    files.refuse_if(
        not any(abs(h / w - known) < 1e-3 for known in (_SENSOR_ASPECT, _LEGACY_ASPECT)),
        file,
        "colour size",
        f"{w}x{h}",
        "4:3 or 16:9, a mode of the camera",
    )
    return w, w * aspect, 0.0, (w * aspect - h) / 2


def _parse_lens(
    entry: dict[str, Any], grid: tuple[float, float, float, float], hw: tuple[int, int], file: Path
) -> _Lens:
    kind = files.get_entry(entry, "Intrinsics.ModelType", str, file)
    files.refuse_if(
        not kind.endswith("BrownConrady"), file, "ModelType", kind, "CALIBRATION_LensDistortionModelBrownConrady"
    )
    values = files.get_entry(entry, "Intrinsics.ModelParameters", list, file)
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = files.to_array(
        values, (_N_PARAMETERS,), file, "ModelParameters"
    ).tolist()
    files.refuse_if(
        codx or cody, file, "ModelParameters codx, cody", f"{codx:g}, {cody:g}", "0, a distortion about the axis"
    )
    w, h, left, top = grid
    # Normalised values count from the corner of the first pixel, ours from its centre.
    K = convert.make_K(fx * w, fy * h, cx * w - left - 0.5, cy * h - top - 0.5)
    camera = convert.to_camera(K, hw, file, "ModelParameters", [k1, k2, p1, p2, k3, k4, k5, k6])
    radius = float(files.to_array(entry.get("MetricRadius", 0), (), file, "MetricRadius"))
    T = np.eye(4)
    T[:3, :3] = files.to_array(files.get_entry(entry, "Rt.Rotation", list, file), (9,), file, "Rotation").reshape(3, 3)
    T[:3, 3] = files.to_array(files.get_entry(entry, "Rt.Translation", list, file), (3,), file, "Translation")
    # Largest distance from the axis at depth 1 for which a lens model holds, where the calibration has none. Source:
    # Azure Kinect SDK, intrinsic_transformation.c.
    return _Lens(camera, radius if radius > 0 else 1.7, convert.to_poses(T[None], file, "Rt"))
