"""A small synthetic robot data set in RH20T's format: an arm with an in-hand camera looks, then moves.

Every scene is one such step. For :data:`_LOOK_S` the hand drifts sideways and turns at constant rates, which gives the
camera a baseline; then, without a stop of the drift, it advances by a fixed share of the remaining way to a target in
the middle of the picture. The next motion of the hand therefore has a part that the past motion determines (drift and
turn) and a part that only the distance of the target determines (the advance): the question whether metric depth
predicts the motion has an answer. What could stand in for the distance is drawn without regard to it:

- the target is a box whose *apparent* size and texture scale are drawn, not its size in metres;
- the target's place in the picture is always about the middle, so that the context need not hold it;
- the base of the arm stands at a place drawn around the hand, so that its state does not give the way;
- boxes beside the target, nearer than the sensor's range, have distances of their own; behind it is any part of the
  room. They give the two-view pose returns where the target is beyond the range, as in half of the scenes.

A task determines the target's texture, shape and apparent size, a scene the rest. The earlier set could not decide the
question. Of the six components of its motion only the one along the optical axis depended on the distance; the past
motion gave a part of that one, the others had directions drawn anew, so that no feature of an unseen task predicts
them, and two were constant, so that their error in units of their own spread was that of rounding: 1.0 for every arm.
With 24 tasks the true distance as a feature changed the error of that component from 0.79 to 0.44 of its variance, and
the mean over the components from 0.76 to 0.71.

The set comes with the true depth (:meth:`dhtorch.data.recording.TruthRecording.truth`), for a control of the probe. It
does not represent real robots.

Alphabet: ``d`` (m) z-depth from the camera, at the middle of the look, to the nearest face of the target; axes of the
world as the room's: x right, y down, z forward; of the camera the same.
"""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.codecs.pickles import read_npy
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.rh20t_robot import ROBOT_ARMS
from dhtorch.data.readers.rh20t_set import open_set
from dhtorch.data.recording import MeasuredRecording, Recording, Recordings
from dhtorch.records import Pose
from dhtorch.synthetic.paths import rotation_from_angles
from dhtorch.synthetic.raycast import Material, Solid, Solids
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.rh20t import write_rh20t
from dhtorch.synthetic.room import ROOM_BACK_M, ROOM_FRONT_M, ROOM_LEFT_M, ROOM_RIGHT_M, furnished_room
from dhtorch.synthetic.shading import ShadedRoom

#: Frames a second, as RH20T's cameras.
_RATE_HZ = 10.0

#: Duration of the look and of the advance after it, s. Source: derived, the probe's history and a frame more, its
#: horizon.
_LOOK_S, _ADVANCE_S = 0.4, 0.4

#: Range of d, m, drawn evenly in its logarithm, and range of the sensor along the ray, m: half of the targets are
#: beyond it. Source: chosen, an arm's reach to a few steps; a short-range sensor on a hand.
_DISTANCE_M, _SENSOR_RANGE_M = (0.5, 2.5), 1.2

#: The advance: share of the way, and distance at which the way ends, m. Source: chosen, so that the hand's speed stays
#: below 3 m/s.
_ADVANCE_SHARE, _STOP_M = 0.2, 0.25

#: Speed of the drift, m/s, and largest rate of turn about each axis, degrees/s. Source: chosen, baselines of 4 to 9 cm
#: over the probe's history, and a target that stays in the picture.
_DRIFT_M_PER_S, _TURN_DEG_PER_S = (0.15, 0.30), 8.0

#: Apparent width of the target (width / d), range over the tasks and spread within a task; its height over its width.
#: Source: chosen, two to six tenths of the picture's width.
_APPARENT_WIDTH, _APPARENT_SPREAD, _ASPECT = (0.35, 0.65), 0.08, (0.6, 0.8)

#: Directions x / z, y / z of the boxes beside the target, range of their depth, m, and of their apparent width.
#: Source: chosen, along the lower edge and the sides of the picture, within the sensor's range.
_BESIDE = ((-0.5, 0.27), (-0.22, 0.31), (0.08, 0.33), (0.33, 0.30), (0.56, 0.25), (-0.55, -0.1), (0.56, -0.14))
_BESIDE_DEPTH_M, _BESIDE_WIDTH = (0.55, 1.05), (0.16, 0.30)

_PICTURES = ("poster:0", "poster:1", "poster:2", "poster:3", "print", "carpet", "speckle", "wallpaper", "globe")

#: Draws of a camera's place in the room before the draw is given up. Source: derived, a hundred times what is needed.
_MAX_DRAWS = 2000

#: Least distance of the camera from walls, m, and the range of its height. Source: chosen, above most furniture.
_WALL_M, _HEIGHT_M = 0.3, (1.1, 1.6)

_CONFIGURATION = 1  # a Flexiv arm
_START_MS = 1_600_000_000_000

#: Time between the calibrations of the scenes of a task, ms: each has its own. Source: derived, above any task count.
_MS_BETWEEN_CALIBRATIONS = 10_000

#: Range of the place of the arm's base behind, below and beside the hand, m. Source: chosen, within the arm's reach.
_BASE_M = ((0.45, 0.75), (0.2, 0.5), (-0.25, 0.25))
_OPEN_MM, _CLOSED_MM = 80.0, 25.0

#: File of a scene with its true depth, and its unit, m: 16 bit reach 13 m.
_TRUTH_FILE, _TRUTH_UNIT_M = "true_depth.npy", 0.0002


def open_robot(
    root: str | None = None,
    *,
    tasks: int = 24,
    scenes: int = 4,
    n_frames: int = 9,
    hw: tuple[int, int] = (144, 256),
    seed: int = 2,
) -> Recordings:
    """Open the synthetic robot set as any other RH20T set, with true depth; it is written first if it does not exist.

    Args:
        root: folder to write to and to read from; existing files are used unchanged. None = a temporary folder that
            is deleted at the end of the process.
        tasks, scenes: number of tasks, and of scenes of each.
        n_frames: frames of a scene, 0.1 s apart; the look and the advance take nine.
        hw: (height, width) of the images, with the aspect ratio of 720×1280; depth has half the size.
        seed: of rooms, motions and noise.

    Raises:
        ValueError: a count below 1, or another aspect ratio.
        FormatError: ``root`` holds other files.
    """
    if min(tasks, scenes, n_frames) < 1 or hw[0] * 16 != hw[1] * 9 or hw[0] % 4:
        raise ValueError(
            f"synthetic robot: tasks {tasks}, scenes {scenes}, n_frames {n_frames}, hw {tuple(hw)}; expected counts of"
            " at least 1 and an image with the aspect ratio of 720x1280 and a height that is a multiple of 4"
        )
    if root is None:
        _TEMPORARY_FOLDERS.append(tempfile.TemporaryDirectory(prefix="dhtorch_robot_"))
        root = _TEMPORARY_FOLDERS[-1].name
    folder = Path(root)
    if not folder.is_dir() or not any(folder.iterdir()):
        write_robot(folder, tasks=tasks, scenes=scenes, n_frames=n_frames, hw=hw, seed=seed)
    written = open_set(folder)
    return Recordings(written.names, partial(_open_with_truth, written))


_TEMPORARY_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


def write_robot(root: Path, *, tasks: int, scenes: int, n_frames: int, hw: tuple[int, int], seed: int) -> None:
    """Write the set below ``root``; options as :func:`open_robot`."""
    for scene in range(scenes):  # the outer loop: each scene has its own room
        for task in range(tasks):
            step = _Step.of(task, scene, seed)
            times = [i / _RATE_HZ for i in range(n_frames)]
            c2w = np.stack([step.camera(t) for t in times])
            start = _START_MS / 1000 + 1000 * (1 + task) + 100 * scene
            room = _RoomWithThings(
                step.things,
                seed=seed + scene,
                n_frames=n_frames,
                hw=hw,
                depth_hw=(hw[0] // 2, hw[1] // 2),
                range_limit=_SENSOR_RANGE_M,
                rate_hz=_RATE_HZ,
                supersample=1,
                true_poses=Pose(torch.from_numpy(c2w[:, :3, :3]), torch.from_numpy(c2w[:, :3, 3])),
                times=torch.tensor([start + t for t in times], dtype=torch.float64),
            )
            base = step.base()
            arm = ROBOT_ARMS[_CONFIGURATION]
            folder = write_rh20t(
                root,
                {arm.in_hand[0]: list(room)},
                configuration=_CONFIGURATION,
                T_world_from_base=base,
                hand_at_calibration=step.camera(0.0),
                name=f"task_{task + 1:04d}_user_0001_scene_{scene + 1:04d}",
                stamp=_START_MS + task + _MS_BETWEEN_CALIBRATIONS * scene,
                joint=np.stack([_solve_joints(np.linalg.inv(base) @ T @ arm.X) for T in c2w]),
                width=np.array([step.width(t) for t in times]),
            )
            depth = torch.cat([room.truth(i)["depth"] for i in range(n_frames)])
            np.save(folder / _TRUTH_FILE, (depth / _TRUTH_UNIT_M).round().numpy().astype(np.uint16))


def _open_with_truth(written: Recordings, position: int) -> Recording:
    """Open a recording of the set with the true depth that stands beside it."""
    recording = written[position]
    assert recording.root is not None  # read from a folder
    content = {f.name: getattr(recording, f.name) for f in fields(Recording)}
    return MeasuredRecording(**content, load_truth=partial(_load_truth, recording.root / _TRUTH_FILE))


def _load_truth(file: Path, position: int) -> tuple[Tensor, float]:
    """True depth (H, W) of a frame in m, 0 where a ray leaves the room; no disagreement is measured."""
    codes = read_npy(file)
    if not isinstance(codes, np.ndarray) or codes.ndim != 3 or not position < len(codes):
        raise FormatError(file, "true depth", type(codes).__name__, f"an array (n, H, W) with n above {position}")
    return torch.from_numpy(codes[position].astype(np.float32) * np.float32(_TRUTH_UNIT_M)), math.nan


class _RoomWithThings(SyntheticRoom):
    """The built-in room with further solids in it."""

    def __init__(self, things: Sequence[Solid], **options: Any) -> None:
        super().__init__(**options)
        self._world = furnished_room(self.seed).joined_by(things)

    def world(self, index: int) -> ShadedRoom:
        return self._world


@dataclass(frozen=True)
class _Step:
    """One look and the advance after it: pose of the hand's camera as a function of time (s), and what it looks at."""

    middle: np.ndarray  # (4, 4) camera to world in the middle of the look's last two frames, at ``moment``
    moment: float  # s
    drift: np.ndarray  # (3,) m/s, camera axes at ``moment``
    turn: np.ndarray  # (3,) rad/s, camera axes
    advance: float  # m, along the optical axis at ``moment``
    things: tuple[Solid, ...]  # the target first
    base_place: tuple[float, float, float]  # m, behind, below and beside the hand
    base_yaw: float  # degrees, from the heading of the camera

    @staticmethod
    def of(task: int, scene: int, seed: int) -> "_Step":
        """The step of a task, which determines the target's looks, and a scene, which determines the rest."""
        of_task = Random(f"robot {seed} {task}")
        draw = Random(f"robot {seed} {task} {scene}")
        picture = of_task.choice(_PICTURES)
        apparent = of_task.uniform(*_APPARENT_WIDTH)
        aspect = of_task.uniform(*_ASPECT)
        pitch = of_task.uniform(-10, 0)
        d = math.exp(draw.uniform(*map(math.log, _DISTANCE_M)))
        width = d * apparent * (1 + draw.uniform(-_APPARENT_SPREAD, _APPARENT_SPREAD))
        size = (width, width * aspect, 0.3 * width)
        pose = _draw_free_view(furnished_room(seed + scene).solids, d, size, pitch, draw)
        yaw = draw.uniform(-15, 15)
        things = [_make_thing(pose, (0.0, 0.0, d + size[2] / 2), size, picture, yaw)]
        for x, y in _BESIDE:
            z, apparent = draw.uniform(*_BESIDE_DEPTH_M), draw.uniform(*_BESIDE_WIDTH)
            at = (z * (x + draw.uniform(-0.04, 0.04)), z * (y + draw.uniform(-0.03, 0.03)), z)
            box = (z * apparent, z * apparent * draw.uniform(0.6, 1.2), 0.08)
            things.append(_make_thing(pose, at, box, draw.choice(_PICTURES), draw.uniform(-30, 30)))
        way = draw.uniform(0, 2 * math.pi)
        speed = draw.uniform(*_DRIFT_M_PER_S)
        turn = [math.radians(draw.uniform(-_TURN_DEG_PER_S, _TURN_DEG_PER_S)) for _ in range(3)]
        back, below, beside = (draw.uniform(*limits) for limits in _BASE_M)
        return _Step(
            middle=pose,
            moment=_LOOK_S - 0.5 / _RATE_HZ,
            drift=np.array([speed * math.cos(way), speed * math.sin(way), 0.0]),
            turn=np.array(turn),
            advance=_ADVANCE_SHARE * (d - _STOP_M),
            things=tuple(things),
            base_place=(back, below, beside),
            base_yaw=draw.uniform(-10, 10),
        )

    def camera(self, time: float) -> np.ndarray:
        """Pose of the camera at ``time``: camera to world (4, 4)."""
        since = time - self.moment
        ahead = self.advance * _smooth_ramp((time - _LOOK_S) / _ADVANCE_S)
        T = np.eye(4)
        # Rotation (3, 3) about the axis of ``turn`` (3,) by its length, rad: Rodrigues' formula
        turn = self.turn * since
        angle = float(np.linalg.norm(turn))
        x, y, z = turn / max(angle, 1e-300)
        K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        T[:3, :3] = np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K)
        T[:3, 3] = self.drift * since + np.array([0.0, 0.0, ahead])
        return self.middle @ T

    def base(self) -> np.ndarray:
        """Base of the arm to world (4, 4): behind and below the hand, z up, x about the heading of the camera."""
        heading = math.atan2(self.middle[0, 2], self.middle[2, 2]) + math.radians(self.base_yaw)
        forward = np.array([math.sin(heading), 0.0, math.cos(heading)])
        up = np.array([0.0, -1.0, 0.0])
        left = np.cross(up, forward)
        back, below, beside = self.base_place
        T = np.eye(4)
        T[:3, :3] = np.stack([forward, left, up], 1)
        T[:3, 3] = self.middle[:3, 3] - back * forward - below * up + beside * left
        return T

    def width(self, time: float) -> float:
        """Opening of the gripper at ``time``, mm: it closes as the hand advances."""
        return _OPEN_MM + (_CLOSED_MM - _OPEN_MM) * _smooth_ramp((time - _LOOK_S) / _ADVANCE_S)


def _draw_free_view(
    solids: Solids, d: float, size: tuple[float, float, float], pitch: float, draw: Random
) -> np.ndarray:
    """Pose (4, 4) of a camera in the room that sees a box of ``size`` at ``d`` without furniture or a wall before it.

    Raises:
        RuntimeError: no such place was drawn.
    """
    depth = d + size[2]
    corners = [(x * size[0] / 2, y * size[1] / 2, depth) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    for _ in range(_MAX_DRAWS):
        place = [draw.uniform(ROOM_LEFT_M + _WALL_M, ROOM_RIGHT_M - _WALL_M), -draw.uniform(*_HEIGHT_M)]
        place.append(draw.uniform(ROOM_FRONT_M + _WALL_M, ROOM_BACK_M - _WALL_M))
        T = np.eye(4)
        T[:3, :3] = rotation_from_angles(draw.uniform(-180, 180), pitch + draw.uniform(-4, 4), 0.0)
        T[:3, 3] = place
        ways = (T[:3, :3] @ np.array(corners).T).T
        o, v = ([torch.tensor(c, dtype=torch.float32) for c in x.T] for x in (np.tile(place, (len(ways), 1)), ways))
        if bool((solids.cast(o, v)[0] > 1).all()):
            return T
    raise RuntimeError(f"synthetic robot: found no free view of {d:.2f} m in {_MAX_DRAWS} draws")


def _make_thing(
    T_world_from_cam: np.ndarray,
    at: tuple[float, float, float],
    size: tuple[float, float, float],
    picture: str,
    yaw: float,
) -> Solid:
    """A box with its centre ``at`` and ``size`` (across, down, deep) in camera axes, one copy of the picture a face."""
    R = T_world_from_cam[:3, :3] @ np.array(rotation_from_angles(yaw, 0.0, 0.0))
    x, y, z = (T_world_from_cam[:3, :3] @ np.array(at) + T_world_from_cam[:3, 3]).tolist()
    rows = [(a, b, c) for a, b, c in R.tolist()]
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Solid((x, y, z), half, Material(picture), (rows[0], rows[1], rows[2]), shadow=False)


def _solve_joints(T_base_from_tcp: np.ndarray) -> np.ndarray:
    """Seven joint angles (7,) of a tcp pose (4, 4), rad: two links of 0.6 m in a turning plane, three at the wrist.

    Not a real arm's kinematics: it only has to be a smooth function of the hand's pose.
    """
    x, y, z = T_base_from_tcp[:3, 3]
    reach = math.hypot(x, y)
    far = min(math.hypot(reach, z), 1.199)
    elbow = math.pi - 2 * math.asin(far / 1.2)
    shoulder = math.atan2(z, reach) + elbow / 2
    R = T_base_from_tcp[:3, :3]
    wrist = (
        math.atan2(R[2, 1], R[2, 2]),
        math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0])),
        math.atan2(R[1, 0], R[0, 0]),
    )
    return np.array([math.atan2(y, x), shoulder, 0.0, elbow, *wrist])


def _smooth_ramp(share: float) -> float:
    """Ramp from 0 to 1 as ``share`` goes from 0 to 1, with zero speed and acceleration at the ends."""
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10 + s * (6 * s - 15))
