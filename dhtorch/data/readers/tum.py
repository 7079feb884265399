"""Reader of TUM RGB-D sequences: colour, depth and a motion-capture trajectory, each with its own time stamps.

``rgb/<stamp>.png``, ``depth/<stamp>.png`` (16 bits, 5000 = 1 m, already registered to colour), listed with their stamps
in ``rgb.txt`` and ``depth.txt`` (or ``associations.txt``, or by the file names alone), and ``groundtruth.txt`` with
``stamp tx ty tz qx qy qz qw``, the pose of the colour camera in the capture hall.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording
from dhtorch.records import Camera, Frame

#: Published calibration of the three colour cameras at 640×480: fx fy cx cy, then k1 k2 p1 p2 k3.
_CAMERA_CALIBRATIONS = {
    1: ((517.306408, 516.469215, 318.643040, 255.313989), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    2: ((520.908620, 521.007327, 325.141442, 249.701764), (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    3: ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
_ROS_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
_IMAGE_HW = (480, 640)
_RATE_HZ = 30.0

#: Largest interval in s between two poses to interpolate in: across longer ones tracking was lost.
_MAX_POSE_GAP_S = 0.05


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    has_listing = any((root / name).is_file() for name in ("rgb.txt", "associations.txt", "groundtruth.txt"))
    if not (root / "rgb").is_dir() or not (root / "depth").is_dir():
        return None
    if has_listing or not any(file.stem.isdigit() for file in (root / "rgb").iterdir()):  # plain numbers are no stamps
        return "rgb/ and depth/ folders of time-stamped images"
    return None


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption = "camera",
    K: Sequence[float] | None = None,
    fov: float | None = None,
    camera: int | None = None,
    poses: bool = True,
    max_difference: float = 0.02,
    units_per_metre: float = 5000.0,
) -> list[Recording]:
    """Open one sequence.

    Args:
        root: the folder of the sequence.
        intrinsics: ``"camera"`` = the published calibration of the camera that took it, with its distortion;
            ``"ros"`` = the driver's default used to register the depth (f = 525, no distortion); or four
            numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images, without distortion.
        fov: horizontal field of view of the images in degrees, for a guessed K where none is available.
        camera: 1, 2 or 3. None = the ``freiburgN`` (``frN``) in the folder's name or in the trajectory's header;
            failing both, ``K`` and ``dist`` of a side-car ``meta.json``.
        poses: read the trajectory; frames that it does not cover are left out. False keeps every RGB-D frame.
        max_difference: s, largest time difference of associated images, depth maps and poses.
        units_per_metre: of the depth codes: 5000 as documented. ORB-SLAM2 uses 5208 for camera 2, and factors for each
            camera are quoted elsewhere (unconfirmed, or already applied in the files).

    Returns:
        One recording at the stamps of the colour images. Poses are interpolated between the two neighbouring ones
        where these are less than 0.05 s apart, else the nearest one within ``max_difference`` is used. Images without
        depth or pose are left out and reported.

    Raises:
        FormatError: no image, nothing associates, an unknown camera, or a damaged file.
    """
    root = Path(root)
    colour, depth = _read_listing(root, "rgb"), _read_listing(root, "depth")
    pairs = associate([t for t, _ in colour], [t for t, _ in depth], max_difference)
    if not pairs:
        problem = f"{len(colour)} images and {len(depth)} depth maps, none within {max_difference} s of one another"
        raise FormatError(root, "time stamps", problem, "pairs")
    report = _format_unmatched(len(colour) - len(pairs), "images", "depth map", max_difference)
    trajectory = root / "groundtruth.txt"
    c2w = None
    if poses and trajectory.is_file():
        c2w, covered = _interpolate_trajectory(trajectory, np.array([colour[i][0] for i, _ in pairs]), max_difference)
        report += _format_unmatched(int((~covered).sum()), "RGB-D frames", "pose", max_difference)
        pairs = [pair for pair, keep in zip(pairs, covered, strict=True) if keep]
    hw = files.read_image_header(colour[pairs[0][0]][1]).hw
    stated = intrinsics_options.parse_intrinsics(root, hw, None if isinstance(intrinsics, str) else intrinsics, K, fov)
    load = _Load(
        images=tuple(colour[i][1] for i, _ in pairs),
        depths=tuple(depth[j][1] for _, j in pairs),
        hw=hw,
        camera=_make_camera(root, intrinsics, camera, hw, stated.K),
        units_per_metre=files.to_positive(units_per_metre, root, "option units_per_metre"),
    )
    return [
        Recording(
            name=root.resolve().name,
            format="tum",
            load=load,
            number=torch.tensor([i for i, _ in pairs]),
            root=root,
            times=torch.tensor([colour[i][0] for i, _ in pairs], dtype=torch.float64),
            poses=None if c2w is None else convert.to_poses(c2w, trajectory),
            rate_hz=_RATE_HZ,
            report=(*report, *stated.report),
        )
    ]


def associate(times_a: Sequence[float], times_b: Sequence[float], max_difference: float) -> list[tuple[int, int]]:
    """One-to-one pairs (i, j), sorted by i, of stamps less than ``max_difference`` s apart; the closest pair first."""
    order = np.argsort(np.asarray(times_b, dtype=np.float64), kind="stable")
    sorted_b = np.asarray(times_b, dtype=np.float64)[order]
    candidates = []
    for i, t in enumerate(times_a):
        low, high = np.searchsorted(sorted_b, (t - max_difference, t + max_difference), "left")
        candidates += [(abs(t - sorted_b[k]), i, int(order[k])) for k in range(low, high)]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for difference, i, j in sorted(candidates):
        if difference < max_difference and i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return sorted(pairs.items())


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    images: tuple[Path, ...]
    depths: tuple[Path, ...]
    hw: tuple[int, int]
    camera: Camera
    units_per_metre: float

    def __call__(self, i: int) -> Frame:
        image = files.read_image(self.images[i], self.hw)
        depth = files.read_depth_png(self.depths[i], self.units_per_metre, self.hw)
        return Frame(torch.from_numpy(image)[None], torch.from_numpy(depth)[None], self.camera)


def _format_unmatched(count: int, what: str, without: str, max_difference: float) -> list[str]:
    return [f"{count} {what} without a {without} within {max_difference} s: left out"] if count else []


def _read_listing(root: Path, kind: str) -> list[tuple[float, Path]]:
    """(stamp, file) of the images of ``kind`` ("rgb" or "depth"), sorted by time; of two with one stamp the first."""
    table, joint = root / f"{kind}.txt", root / "associations.txt"
    if table.is_file():
        rows = [(table, line, words[:2]) for line, words in files.read_rows(table)]
    elif joint.is_file():
        column = 0 if kind == "rgb" else 2
        rows = [(joint, line, words[column : column + 2]) for line, words in files.read_rows(joint)]
    else:
        pictures = sorted((root / kind).glob("*.png")) if (root / kind).is_dir() else []
        rows = [(root / kind, i, [file.stem, f"{kind}/{file.name}"]) for i, file in enumerate(pictures)]
    by_stamp: dict[float, Path] = {}
    for file, line, words in rows:
        if len(words) != 2 or not re.fullmatch(r"\d+(\.\d*)?", words[0]):
            raise FormatError(file, f"line {line}", " ".join(words) or "nothing", "a time stamp and a file name")
        picture = Path(words[1])
        if picture.is_absolute() or ".." in picture.parts:
            raise FormatError(file, f"line {line}", words[1], "a file inside the sequence's folder")
        by_stamp.setdefault(float(words[0]), root / picture)
    if not by_stamp:
        raise FormatError(root, f"{kind} frames", "none", f"time-stamped images in {kind}/")
    return sorted(by_stamp.items())


def _interpolate_trajectory(file: Path, times: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrices of the covered ``times``, and the mask (n,) of covered times."""
    rows = files.read_table(file, 8)
    rows = rows[np.isfinite(rows).all(-1) & (np.linalg.norm(rows[:, 4:], axis=-1) > 1e-6)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if len(rows) == 0:
        raise FormatError(file, "poses", "no usable row", "rows of stamp, position and quaternion")
    after = np.searchsorted(rows[:, 0], times, "left").clip(1, max(len(rows) - 1, 1)).clip(max=len(rows) - 1)
    before = (after - 1).clip(0)
    a, b = rows[before], rows[after]
    span = b[:, 0] - a[:, 0]
    weight = (times - a[:, 0]) / np.where(span > 0, span, 1)
    nearest_weight = np.where(weight > 0.5, 1.0, 0.0)
    nearest = np.minimum(np.abs(times - a[:, 0]), np.abs(times - b[:, 0]))
    interpolated = (weight >= 0) & (weight <= 1) & (span < _MAX_POSE_GAP_S)
    covered = interpolated | (nearest < max_difference)
    if not covered.any():
        raise FormatError(file, "time stamps", f"no pose within {max_difference} s of any image", "overlapping clocks")
    weight = np.where(interpolated, weight, nearest_weight)[covered, None]
    a, b = a[covered], b[covered]
    # q and −q are one rotation; over 10 ms or less linear interpolation of quaternions equals slerp.
    sign = np.where((a[:, 4:] * b[:, 4:]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    q = (1 - weight) * a[:, 4:] + weight * sign * b[:, 4:]
    return convert.to_c2w(q, (1 - weight) * a[:, 1:4] + weight * b[:, 1:4], file), covered


def _make_camera(
    root: Path,
    intrinsics: intrinsics_options.IntrinsicsOption,
    number: int | None,
    hw: tuple[int, int],
    K: tuple[float, ...] | None,
) -> Camera:
    if K is not None:
        return convert.to_camera(convert.make_K(*K), hw, root, "option K")
    if intrinsics not in ("camera", "ros"):
        raise FormatError(root, "option intrinsics", intrinsics, "camera or ros")
    if number not in (None, *_CAMERA_CALIBRATIONS):
        raise FormatError(root, "option camera", number, "1, 2 or 3")
    side_car = root / "meta.json"
    number = number or _find_camera_number(root)
    if number is None and intrinsics == "camera":
        if not side_car.is_file():
            raise intrinsics_options.missing_intrinsics_error(
                root, None, "data.camera=1, 2 or 3 (freiburg), data.intrinsics=ros", "meta.json"
            )
        meta = files.read_json(side_car)
        return convert.to_camera(meta.get("K"), hw, side_car, "K", meta.get("dist"))
    if hw != _IMAGE_HW:
        raise FormatError(root, "image size", f"{hw[1]}x{hw[0]}", "640x480, the size of the published calibration")
    values, distortion = _CAMERA_CALIBRATIONS[number] if number and intrinsics == "camera" else (_ROS_INTRINSICS, None)
    return convert.to_camera(convert.make_K(*values), hw, root, "K", distortion)


def _find_camera_number(root: Path) -> int | None:
    """1, 2 or 3 from the folder's name, else from the trajectory's header comments; None if neither names a camera."""
    texts = [root.resolve().name]
    if (root / "groundtruth.txt").is_file():
        lines = files.read_lines(root / "groundtruth.txt")[:5]
        texts += [line for line in lines if line.startswith("#")]
    matches = [m for text in texts if (m := re.search(r"(?:freiburg|fr)([123])(?![0-9])", text))]
    return int(matches[0][1]) if matches else None
