"""Reader of RH20T scenes: a robot seen by many cameras, each with its own time stamps; one recording per camera.

A scene folder holds ``metadata.json`` and, for each camera, ``cam_<serial>/`` with ``color.mp4``, ``depth.mp4`` (often
in a parallel tree) and ``timestamps.npy``; beside the scenes lies ``calib/<stamp>/`` with ``intrinsics.npy`` (for
1280×720), ``extrinsics.npy`` (world → camera; the world is the calibration marker) and ``tcp.npy``. The ``.npy`` files
are pickles: they are read as data (:mod:`dhtorch.data.codecs.pickles`), no code in them runs.

A depth image is twice as high as the colour image, the low bytes above the high bytes, in millimetres. A camera on the
hand moves with the tool centre point (:mod:`dhtorch.data.readers.rh20t_robot`). :func:`read_robot_streams` reads the
robot's data. Scenes named ``…_human`` show a person at the same task; which arrays they lack is unconfirmed, so only
videos, time stamps and the calibration are required of a scene.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.clocks import nearest_stamps
from dhtorch.data.codecs.pickles import read_npy
from dhtorch.data.codecs.video import read_video_frame, read_video_header
from dhtorch.data.io import decode as files
from dhtorch.data.readers.rh20t_robot import (
    ROBOT_ARMS,
    RobotArm,
    RobotStream,
    hand_camera_poses,
    ms_to_seconds,
    read_calibration_tcp,
    read_robot_streams,
    read_tcp_in_base,
)
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cameras
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime.console import format_count

__all__ = ["RobotStream", "read", "read_robot_streams", "recognise"]


#: Depth codes of one metre. Source: format definition (rh20t_api).
_UNITS_PER_METRE = 1000


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if (root / "metadata.json").is_file() and any(root.glob("cam_*/timestamps.npy")):
        return "metadata.json and cam_<serial>/timestamps.npy"
    return None


def read(
    root: str | Path,
    *,
    serials: Sequence[str] | None = None,
    depth_root: str | None = None,
    calibration: str | None = None,
    calibrated_hw: Sequence[int] = (720, 1280),
    configuration: int | None = None,
    in_hand: Sequence[str] | None = None,
    max_difference: float = 0.02,
    max_gap: float = 0.5,
    outlier: float = 0.0,
) -> list[Recording]:
    """Open a scene, one recording for each camera that has images and a calibration.

    Args:
        root: the folder of the scene.
        serials: cameras to open. None = all; those that cannot be opened are then left out and reported.
        depth_root: the folder of the same scene in the parallel tree of depth videos. None = ``root``.
        calibration: the folder with the calibrations by stamp. None = ``calib`` beside the scene.
        calibrated_hw: height and width that ``intrinsics.npy`` refers to; K is scaled exactly to the video's size.
        configuration: 1 to 7, the robot. None = from ``cfg_000N`` in the folder's name.
        in_hand: serials of the cameras on the hand, first the one of the published mount. None = those of the
            configuration.
        max_difference: s, largest time difference of associated colour and depth images.
        max_gap: s, longest gap of the tcp stream across which the pose of a camera on the hand is interpolated.
        outlier: m, a return that differs by more from the median of the returns within two pixels is dropped; 0 = off.
            Whether the depth videos are lossless is unconfirmed; a lossy high byte is off by multiples of 0.256 m.

    Returns:
        Recordings named ``<scene>/<serial>``, colour and depth paired by time. Without ``depth.mp4`` the depth is
        empty, which is reported. Poses are absent for a camera on the hand without tcp data.

    Raises:
        FormatError: no camera, no calibration (``calib`` −1), a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    meta = files.read_json(root / "metadata.json")
    stamp = meta.get("calib", -1)
    files.refuse_if(
        isinstance(stamp, bool) or not isinstance(stamp, int | str) or not re.fullmatch(r"\d{10,16}", str(stamp)),
        root / "metadata.json",
        "calib",
        stamp,
        "the stamp of a calibration (-1 = none)",
    )
    parent = root.parent.parent if root.parent.name == "action" else root.parent
    folder = (Path(calibration) if calibration is not None else parent / "calib") / str(stamp)
    hw = files.to_array(calibrated_hw, (2,), root, "option calibrated_hw")
    rig = _SceneCameras(
        root=root,
        depth_root=Path(depth_root) if depth_root is not None else root,
        folder=folder,
        K=_read_by_serial(folder / "intrinsics.npy"),
        E=_read_by_serial(folder / "extrinsics.npy"),
        hw=(int(hw[0]), int(hw[1])),
        arm=_find_arm(root, configuration, in_hand),
        max_difference=max_difference,
        max_gap=max_gap,
        outlier=outlier,
    )
    present = sorted(d.name[4:] for d in root.glob("cam_*") if d.is_dir())
    files.refuse_if(
        unknown := sorted(set(serials or ()) - set(present)),
        root,
        "option serials",
        ", ".join(unknown),
        f"some of {', '.join(present)}",
    )
    incomplete = {} if serials else {s: reason for s in present if (reason := rig.lacks(s))}
    opened = [s for s in serials or present if s not in incomplete]
    files.refuse_if(
        not opened, root, "cameras", ", ".join(incomplete.values()) or "none", "one with images and calibration"
    )
    left_out = tuple(f"camera {s}: {reason}: left out" for s, reason in incomplete.items())
    doubtful = meta.get("bad_calib_view", ())
    doubtful_serials = {str(s) for s in doubtful} if isinstance(doubtful, list) else set()
    return [rig.recording(s, left_out, s in doubtful_serials) for s in opened]


def _load_frame(
    i: int,
    *,
    colour: Path,
    depth: Path | None,
    places: tuple[tuple[int, int], ...],  # index of the colour frame, index of the depth frame
    camera: Camera,
    hw: tuple[int, int],
    depth_hw: tuple[int, int],
    outlier: float,
) -> Frame:
    """Position → frame."""
    k, j = places[i]
    image = torch.from_numpy(read_video_frame(colour, k, hw)).permute(2, 0, 1).contiguous()
    h, w = depth_hw
    metres = torch.zeros(h, w)
    if depth is not None:
        planes = read_video_frame(depth, j, (2 * h, w), pixels="gray")
        codes = planes[:h].astype(np.float32) + planes[h:].astype(np.float32) * 256
        metres = torch.from_numpy(codes) / _UNITS_PER_METRE
    if outlier > 0:  # returns further from the median of their 5×5 window become 0
        empty = torch.where(metres > 0, metres, torch.full_like(metres, torch.nan))
        windows = torch.nn.functional.pad(empty, (2, 2, 2, 2), value=torch.nan).unfold(0, 5, 1).unfold(1, 5, 1)
        median = windows.reshape(h, w, 25).nanmedian(-1).values
        metres = torch.where((metres - median).abs() > outlier, torch.zeros_like(metres), metres)
    return Frame(image[None], metres[None], camera)


@dataclass(frozen=True, eq=False)
class _SceneCameras:
    """Data and options common to the cameras of a scene."""

    root: Path
    depth_root: Path
    folder: Path
    K: dict[str, Any]
    E: dict[str, Any]
    hw: tuple[int, int]
    arm: RobotArm | None
    max_difference: float
    max_gap: float
    outlier: float

    def lacks(self, serial: str) -> str | None:
        """The reason why a camera cannot be opened; None if it can."""
        for name in ("color.mp4", "timestamps.npy"):
            if not (self.root / f"cam_{serial}" / name).is_file():
                return f"no {name}"
        return None if serial in self.K and serial in self.E else f"no calibration in {self.folder.name}"

    def recording(self, serial: str, report: tuple[str, ...], doubted: bool) -> Recording:
        home = self.root / f"cam_{serial}"
        colour, depth = home / "color.mp4", self.depth_root / f"cam_{serial}" / "depth.mp4"
        notes = list(report) + ([f"camera {serial}: calibration marked as bad in the metadata"] if doubted else [])
        header = read_video_header(colour)
        size = header.hw
        depth_size = size
        if depth.is_file():
            high, wide = read_video_header(depth).hw
            depth_size = (high // 2, wide)
            files.refuse_if(
                high % 2 or depth_size[0] * size[1] != depth_size[1] * size[0],
                depth,
                "size",
                f"{wide}x{high}",
                f"twice as high as an image like {size[1]}x{size[0]}",
            )
        else:
            notes.append(f"camera {serial}: no depth.mp4: depth is empty")
        places, times = self._places(home / "timestamps.npy", header.n, depth if depth.is_file() else None, notes)
        poses, covered = self._poses(serial, times, notes)
        kept = np.flatnonzero(covered)
        places = tuple(places[k] for k in kept)
        return Recording(
            name=f"{self.root.resolve().name}/{serial}",
            format="rh20t",
            load=partial(
                _load_frame,
                colour=colour,
                depth=depth if depth.is_file() else None,
                places=places,
                camera=self._camera(serial, size),
                hw=size,
                depth_hw=depth_size,
                outlier=self.outlier,
            ),
            number=torch.tensor([k for k, _ in places]),
            root=self.root,
            times=torch.from_numpy(times[kept]),
            poses=poses,
            rate_hz=header.rate_hz or 10.0,
            report=tuple(notes),
            depth_unit=DepthUnit(1 / _UNITS_PER_METRE, "RH20T stores mm") if depth.is_file() else None,
        )

    def _camera(self, serial: str, hw: tuple[int, int]) -> Camera:
        file = self.folder / "intrinsics.npy"
        value = self.K.get(serial)
        K = value if isinstance(value, np.ndarray) else None
        if K is None or K.shape not in ((3, 3), (3, 4)) or K.dtype.kind not in "fiu" or (K[:, 3:] != 0).any():
            problem = type(value).__name__ if K is None else f"an array of shape {K.shape}"
            raise files.FormatError(file, serial, problem, "3x3 intrinsics, or 3x4 with a zero column")
        files.refuse_if(
            hw[0] * self.hw[1] != hw[1] * self.hw[0],
            file,
            "image size",
            f"{hw[1]}x{hw[0]}",
            f"the shape of {self.hw[1]}x{self.hw[0]}",
        )
        full = convert.to_camera(K[:, :3].astype(np.float64), self.hw, file, serial)
        return cameras.resize(full.to(torch.float64), self.hw, hw).to(torch.float32)

    def _extrinsics(self, serial: str) -> np.ndarray:
        """World → camera (4, 4): the first of a camera's matrices."""
        file = self.folder / "extrinsics.npy"
        value = self.E.get(serial)
        first: Any = value[0] if isinstance(value, list | np.ndarray) and len(value) else None
        files.refuse_if(
            not isinstance(first, np.ndarray) or first.shape != (4, 4) or first.dtype.kind != "f",
            file,
            serial,
            type(first).__name__,
            "a list of 4x4 matrices",
        )
        convert.to_poses(first[None].astype(np.float64), file, serial)
        return first.astype(np.float64)

    def _places(
        self, file: Path, n_colour: int, depth: Path | None, notes: list[str]
    ) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
        """Index pairs (colour frame, depth frame) and their times (s), sorted by time."""
        lists = read_npy(file)
        colour = _frame_stamps(lists, "color", n_colour, file, notes)
        if depth is None:
            return tuple((k, -1) for k, _ in colour), np.array([t for _, t in colour])
        depth_stamps = _frame_stamps(lists, "depth", read_video_header(depth).n, file, notes)
        nearest = nearest_stamps(
            np.array([t for _, t in colour]), np.array([t for _, t in depth_stamps]), self.max_difference
        )
        pairs = [(k, depth_stamps[j][0], t) for (k, t), j in zip(colour, nearest, strict=True) if j >= 0]
        if len(pairs) < len(colour):
            images = format_count(len(colour) - len(pairs), "image")
            notes.append(f"{images} without depth within {self.max_difference} s: left out")
        files.refuse_if(
            not pairs, file, "time stamps", f"no depth within {self.max_difference} s of any image", "pairs"
        )
        return tuple((k, j) for k, j, _ in pairs), np.array([t for _, _, t in pairs])

    def _poses(self, serial: str, times: np.ndarray, notes: list[str]) -> tuple[Pose | None, np.ndarray]:
        """Poses at the covered ``times`` (None = no poses), and the mask (n,) of covered times."""
        all_covered = np.ones(len(times), dtype=bool)
        file = self.folder / "extrinsics.npy"
        E = self._extrinsics(serial)
        if self.arm is None or serial not in self.arm.in_hand:
            if self.arm is None:
                notes.append("unknown configuration: every camera is assumed stationary (option configuration)")
            return convert.to_poses(np.repeat(np.linalg.inv(E)[None], len(times), 0), file, serial), all_covered
        missing_files = [
            f for f in (self.folder / "tcp.npy", self.root / "transformed" / "tcp_base.npy") if not f.is_file()
        ]
        if missing_files or self.arm.in_hand[0] not in self.E:
            missing = missing_files[0].name if missing_files else f"extrinsics of {self.arm.in_hand[0]}"
            notes.append(f"camera {serial} is on the hand, without {missing}: no poses")
            return None, all_covered
        stream = read_tcp_in_base(self.root)
        files.refuse_if(
            not len(stream.times), self.root / "transformed" / "tcp_base.npy", "entries", "none usable", "poses"
        )
        tcp, covered = stream.at(times, self.max_gap)
        files.refuse_if(
            not covered.any(),
            self.root / "transformed" / "tcp_base.npy",
            "time stamps",
            "none near an image",
            "overlap",
        )
        if not covered.all():
            notes.append(
                f"camera {serial}: {format_count(int((~covered).sum()), 'frame')} in a gap of the tcp stream: left out"
            )
        T = read_calibration_tcp(self.folder / "tcp.npy", self.arm)
        hand = self._extrinsics(self.arm.in_hand[0])
        c2w = hand_camera_poses(self.arm, E, hand, T, tcp[covered], file)
        return convert.to_poses(c2w, file, serial), covered


def _find_arm(root: Path, configuration: int | None, in_hand: Sequence[str] | None) -> RobotArm | None:
    files.refuse_if(
        configuration is not None and configuration not in ROBOT_ARMS,
        root,
        "option configuration",
        configuration,
        "1 to 7",
    )
    match = re.search(r"cfg_0*([1-7])(?!\d)", root.resolve().name)
    number = configuration or (int(match[1]) if match else None)
    if number is None:
        return None
    return ROBOT_ARMS[number]._replace(in_hand=tuple(in_hand)) if in_hand is not None else ROBOT_ARMS[number]


def _read_by_serial(file: Path) -> dict[str, Any]:
    value = read_npy(file)
    files.refuse_if(not isinstance(value, dict), file, "content", type(value).__name__, "a dict by camera serial")
    return {str(key): entry for key, entry in value.items()}


def _frame_stamps(lists: Any, kind: str, n: int, file: Path, notes: list[str]) -> list[tuple[int, float]]:
    """(frame index, time in s) of the video's frames, strictly increasing in time."""
    stamps: Any = lists.get(kind) if isinstance(lists, dict) else None
    if isinstance(stamps, np.ndarray):
        stamps = stamps.tolist()
    files.refuse_if(
        not isinstance(stamps, list) or not stamps, file, kind, type(stamps).__name__, "a list of Unix milliseconds"
    )
    if len(stamps) != n:
        counts = f"{format_count(len(stamps), f'{kind} stamp')} for {format_count(n, 'frame')}"
        notes.append(f"{counts}: the first {min(n, len(stamps))} are used")
    kept: list[tuple[int, float]] = []
    for k, stamp in enumerate(stamps[:n]):
        t = ms_to_seconds(stamp, file, kind)
        if not kept or t > kept[-1][1]:
            kept.append((k, t))
    if (lost := min(n, len(stamps)) - len(kept)) > 0:
        notes.append(
            f"{format_count(lost, f'{kind} frame')} with a time stamp not later than the previous one: left out"
        )
    return kept
