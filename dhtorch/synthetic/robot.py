"""A small synthetic robot data set in RH20T's format: an arm with an in-hand camera in the built-in room.

A task is an object in the room and a motion towards it; the scenes of a task differ in start, pace, direction, in the
room's paint and in where the arm stands. The remaining way of the hand is the distance of the object beyond the
stopping distance: it can be predicted from depth, and not from the state, because the arm's base is elsewhere in every
scene. The set is for tests of reading and probing; it does not represent real robots.

Alphabet: ``d`` (m) distance from the camera to the object; axes of the world as the room's: x right, y down, z forward.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np
import torch

from dhtorch.data.readers.rh20t_robot import ROBOT_ARMS
from dhtorch.data.readers.rh20t_set import open_set
from dhtorch.data.recording import Recordings
from dhtorch.records import Pose
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.testing.rh20t import write_rh20t

#: Targets of the hand: x, height, z, m, and viewing direction, degrees: yaw (positive: looks right), pitch.
_TARGETS = (
    (-0.76, 1.02, 1.95, 0, -12),
    (-0.30, 1.02, 1.98, 8, -6),
    (0.22, 0.95, 1.90, -10, -14),
    (-1.12, 1.00, 1.98, -6, -10),
    (-0.60, 0.62, 1.78, 5, -4),
    (0.35, 0.40, 3.10, 10, -40),
    (-1.30, 1.20, 4.15, -8, -3),
    (-0.40, 0.75, 4.12, 12, -12),
    (0.73, 0.70, 4.15, 6, -8),
    (-1.75, 0.55, 3.20, -25, -22),
    (1.62, 0.60, 2.75, 40, -15),
    (-1.90, 0.75, 4.15, -12, -6),
)

#: Motions of the hand at the target.
_MOTIONS = ("reach", "pick", "slide", "screw")

#: Frames a second, as RH20T's cameras.
_RATE_HZ = 10.0

_CONFIGURATION = 1  # a Flexiv arm
_START_MS = 1_600_000_000_000

#: Time between the calibrations of the scenes of a task, ms: each has its own. Source: derived, above any task count.
_MS_BETWEEN_CALIBRATIONS = 10_000

#: Half the width of the box in which the arm's base stands, m. Source: derived, several times the way of the hand.
_BASE_SPREAD_M = 0.25
_OPEN_MM, _CLOSED_MM = 80.0, 25.0


def open_robot(
    root: str | None = None,
    *,
    tasks: int = 12,
    scenes: int = 2,
    n_frames: int = 22,
    hw: tuple[int, int] = (144, 256),
    seed: int = 2,
) -> Recordings:
    """Open the synthetic robot set as any other RH20T set; it is written first if it does not exist.

    Args:
        root: folder to write to and to read from; existing files are used unchanged. None = a temporary folder that
            is deleted at the end of the process.
        tasks, scenes: number of tasks, and of scenes of each.
        n_frames: frames of a scene, 0.1 s apart.
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
    return open_set(folder)


_TEMPORARY_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


def write_robot(root: Path, *, tasks: int, scenes: int, n_frames: int, hw: tuple[int, int], seed: int) -> None:
    """Write the set below ``root``; options as :func:`open_robot`."""
    for scene in range(scenes):  # the outer loop: each scene has its own room
        for task in range(tasks):
            episode = _Episode.of(task, scene, seed)
            times = [i / _RATE_HZ for i in range(n_frames)]
            c2w = np.stack([episode.camera(t) for t in times])
            start = _START_MS / 1000 + 1000 * (1 + task) + 100 * scene
            room = SyntheticRoom(
                seed=seed + scene,
                n_frames=n_frames,
                hw=hw,
                depth_hw=(hw[0] // 2, hw[1] // 2),
                rate_hz=_RATE_HZ,
                supersample=1,
                true_poses=Pose(torch.from_numpy(c2w[:, :3, :3]), torch.from_numpy(c2w[:, :3, 3])),
                times=torch.tensor([start + t for t in times], dtype=torch.float64),
            )
            base = episode.base()
            home = episode.camera(0.0)
            arm = ROBOT_ARMS[_CONFIGURATION]
            write_rh20t(
                root,
                {arm.in_hand[0]: list(room)},
                configuration=_CONFIGURATION,
                T_world_from_base=base,
                hand_at_calibration=home,
                name=f"task_{task + 1:04d}_user_0001_scene_{scene + 1:04d}",
                stamp=_START_MS + task + _MS_BETWEEN_CALIBRATIONS * scene,
                joint=np.stack([_solve_joints(np.linalg.inv(base) @ T @ arm.X) for T in c2w]),
                width=np.array([episode.width(t) for t in times]),
            )


@dataclass(frozen=True)
class _Episode:
    """One scene of a task: the pose of the hand as a function of time (s) since the start."""

    motion: str
    thing: tuple[float, float, float]  # world, m
    yaw: float  # degrees
    pitch: float
    start: float  # s, when the motion begins
    length: float  # s
    far: float  # m, d at the start
    near: float  # m, d at the end
    side: float  # m, of a slide
    roll: float  # degrees, of a screw
    offset: tuple[float, float]  # m, how far beside the object the camera looks
    base_offset: tuple[float, float, float]  # m, world, of the arm's base

    @staticmethod
    def of(task: int, scene: int, seed: int) -> _Episode:
        """The episode of a task, which determines object and motion, and a scene, which determines the rest."""
        x, height, z, yaw, pitch = _TARGETS[task % len(_TARGETS)]
        draw_task = Random(f"robot {seed} {task}")
        draw = Random(f"robot {seed} {task} {scene}")
        return _Episode(
            motion=_MOTIONS[(task + task // len(_TARGETS)) % len(_MOTIONS)],
            thing=(x, -height, z),
            yaw=yaw + draw_task.uniform(-4, 4) + draw.uniform(-5, 5),
            pitch=pitch + draw_task.uniform(-3, 3) + draw.uniform(-3, 3),
            start=draw.uniform(0.0, 0.5),
            length=draw.uniform(1.0, 1.5),
            far=draw.uniform(0.50, 0.80),
            near=draw.uniform(0.24, 0.30),
            side=draw.choice((-1, 1)) * draw.uniform(0.10, 0.16),
            roll=draw.choice((-1, 1)) * draw.uniform(40, 70),
            offset=(draw.uniform(-0.05, 0.05), draw.uniform(-0.03, 0.03)),
            base_offset=tuple(draw.uniform(-_BASE_SPREAD_M, _BASE_SPREAD_M) for _ in range(3)),  # type: ignore[arg-type]
        )

    def camera(self, time: float) -> np.ndarray:
        """Pose of the camera at ``time``: camera to world (4, 4)."""
        done = _smooth_ramp((time - self.start) / self.length)
        d, side, roll = self.near, 0.0, 0.0
        if self.motion == "slide":
            d, side = self.near + 0.15, self.side * (2 * done - 1)
        elif self.motion == "pick":
            half = self.length / 2
            back = _smooth_ramp((time - self.start - half - 0.2) / half)
            d += (self.far - self.near) * (1 - _smooth_ramp((time - self.start) / half) + 0.8 * back)
        else:
            d += (self.far - self.near) * (1 - done)
            roll = self.roll * done if self.motion == "screw" else 0.0
        sway = 0.002 * math.sin(7.0 * time + 10 * self.length)
        R = _rotation_from_angles(self.yaw, self.pitch, roll)
        aim = _rotation_from_angles(self.yaw, self.pitch, 0.0)
        beside = aim @ np.array([self.offset[0] + side, self.offset[1] + sway, -d])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, np.array(self.thing) + beside
        return T

    def base(self) -> np.ndarray:
        """Base of the arm to world (4, 4): in front of and below the object, z up; elsewhere in every scene."""
        x, y, z = (a + b for a, b in zip(self.thing, self.base_offset, strict=True))
        T = np.eye(4)
        T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # base x = world z, base z = up
        T[:3, 3] = [x, y + 0.35, z - 1.05]
        return T

    def width(self, time: float) -> float:
        """Opening of the gripper at ``time``, mm: it closes when the hand arrives."""
        arrives = self.start + self.length * (0.5 if self.motion == "pick" else 1.0)
        return _OPEN_MM + (_CLOSED_MM - _OPEN_MM) * _smooth_ramp((time - arrives) / 0.3)


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


def _rotation_from_angles(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """World from camera: roll about z, then pitch about x (positive: up), then yaw about y (positive: right)."""
    a, b, c = (math.radians(v) for v in (yaw, pitch, roll))
    about_y = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    about_z = np.array([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
    return about_y @ about_x @ about_z
