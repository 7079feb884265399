"""Camera paths in the built-in room: pose of the viewer in every frame, and as a device reports it: turned, late,
drifting and noisy.

A path is a smooth closed form of the length travelled (m) and the time (s): frame ``i`` does not depend on the number
of frames, and a long recording stays in the room by oscillating. Sines are taken with Python's ``math``, one by one, so
that poses do not depend on vector widths.
"""

import math
from collections.abc import Callable, Sequence
from random import Random

import torch
from torch import Generator, Tensor

from dhtorch.geometry import se3
from dhtorch.geometry.se3 import Pose

_Position = tuple[float, float, float]  # x, height, z; m
_Angles = tuple[float, float, float]  # yaw (positive: right), pitch (positive: up), roll; degrees

_START_POSITION, _YAW, _PITCH = (-0.45, 1.3, 0.2), 12.0, -9.0  # initial position and viewing direction of the viewer
_ORBIT_CENTRE = (-0.1, 0.9, 2.0)  # centre of an orbit


def hand_held_path(
    path: str, n_frames: int, *, step_m: float, rate_hz: float, seed: int, pan: tuple[float, float] = (0.0, 0.0)
) -> Pose:
    """``T_world_from_cam`` (n_frames), float64, of one of :data:`CAMERA_PATHS`.

    ``pan``: degrees of yaw to the right added to the first frame, and added from frame to frame.
    """
    stations = [CAMERA_PATHS[path](_Hand(seed), step_m * i, i / rate_hz) for i in range(n_frames)]
    turns = [(yaw + pan[0] + pan[1] * i, *pitch_roll) for i, (_, (yaw, *pitch_roll)) in enumerate(stations)]
    return Pose(
        torch.tensor([rotation_from_angles(*angles) for angles in turns], dtype=torch.float64),
        torch.tensor([(x, -height, z) for (x, height, z), _ in stations], dtype=torch.float64),
    )


def turn_by_hand(times: Sequence[float], *, duration_s: float, degrees: float, reach_m: float, seed: int) -> Pose:
    """``T_world_from_cam`` (n), float64, of a camera that a hand turns on the spot, at ``times`` in s.

    The viewing direction swings by ``degrees`` within ``duration_s``, in a seeded direction that is mostly sideways,
    and the camera rolls by a quarter of that. The wrist, not the camera's centre, is the centre of the rotation, and
    sways: within ``duration_s`` the camera's centre moves by about ``reach_m``.
    """
    hand = _Hand(seed)
    draw = Random(f"wrist {seed}")
    tilt = math.radians(draw.uniform(-35.0, 35.0))
    sense = draw.choice((-1, 1))
    lever = torch.tensor([0.0, 0.0, 0.9 * reach_m / math.radians(degrees)], dtype=torch.float64)
    x0, height0, z0 = _START_POSITION
    start = torch.tensor([x0, -height0, z0], dtype=torch.float64)
    rotations, centres = [], []
    for time in times:
        turn = 0.5 * sense * degrees * -math.cos(math.pi * time / duration_s)
        roll = 0.25 * degrees * hand.sway(0, time / duration_s)
        R = rotation_from_angles(_YAW + turn * math.cos(tilt), _PITCH + turn * math.sin(tilt), roll)
        rotations.append(torch.tensor(R, dtype=torch.float64))
        sway = [0.1 * reach_m * hand.sway(1 + k, 2 * math.pi * time / duration_s) for k in range(3)]
        centres.append(start + rotations[-1] @ lever + torch.tensor(sway, dtype=torch.float64))
    return Pose(torch.stack(rotations), torch.stack(centres))


class _Hand:
    """Seeded phases of the small unintended motions of a hand-held camera."""

    def __init__(self, seed: int):
        draw = Random(f"hand {seed}")
        self._phases = [draw.uniform(0, 2 * math.pi) for _ in range(12)]
        self.start = draw.uniform(-0.6, -0.3)

    def sway(self, k: int, phase: float) -> float:
        """Smooth oscillation in [-1, 1]: two sines of incommensurate periods."""
        a, b = self._phases[2 * k], self._phases[2 * k + 1]
        return 0.65 * math.sin(phase + a) + 0.35 * math.sin(1.83 * phase + b)


def _walk(hand: _Hand, way: float, time: float) -> tuple[_Position, _Angles]:
    side = 0.55 * math.sin(way / 0.55 + hand.start)
    x, height, z = _START_POSITION
    position = (x + side, height + 0.03 * hand.sway(0, way / 0.25), z + 0.08 * hand.sway(1, way / 0.4))
    tremor = [hand.sway(2 + k, 2 * math.pi * 0.9 * time) for k in range(3)]
    return position, (_YAW - 11 * side + 0.6 * tremor[0], _PITCH + 0.6 * tremor[1], 0.8 * tremor[2])


def _lateral(hand: _Hand, way: float, time: float) -> tuple[_Position, _Angles]:
    x, height, z = _START_POSITION
    return (x + 0.55 * math.sin(way / 0.55 + hand.start), height, z), (_YAW, _PITCH, 0.0)


def _forward(hand: _Hand, way: float, time: float) -> tuple[_Position, _Angles]:
    a = math.radians(_YAW)
    go = 0.35 * math.sin(way / 0.35 - 0.5)
    x, height, z = _START_POSITION
    return (x + math.sin(a) * go, height, z + 0.2 + math.cos(a) * go), (_YAW, _PITCH, 0.0)


def _orbit(hand: _Hand, way: float, time: float) -> tuple[_Position, _Angles]:
    radius = 1.75
    a = 0.5 * math.sin(way / (0.5 * radius) + hand.start)
    drop = math.degrees(math.atan2(_START_POSITION[1] - _ORBIT_CENTRE[1], radius))
    position = (_ORBIT_CENTRE[0] - radius * math.sin(a), _START_POSITION[1], _ORBIT_CENTRE[2] - radius * math.cos(a))
    return position, (math.degrees(a), -0.6 * drop, 0.0)


def _turn(hand: _Hand, way: float, time: float) -> tuple[_Position, _Angles]:
    yaw = _YAW + 20 * math.sin(way / 0.45 + hand.start)
    return _START_POSITION, (yaw, _PITCH + 3 * hand.sway(0, way / 0.4), 1.5 * hand.sway(1, way / 0.4))


def _static(hand: _Hand, way: float, time: float) -> tuple[_Position, _Angles]:
    return _START_POSITION, (_YAW, _PITCH, 0.0)


#: Paths by name: position and angles after a length (m) and a time (s).
CAMERA_PATHS: dict[str, Callable[[_Hand, float, float], tuple[_Position, _Angles]]] = {
    "walk": _walk,
    "lateral": _lateral,
    "forward": _forward,
    "orbit": _orbit,
    "rotation": _turn,
    "static": _static,
}


def rotation_from_angles(yaw: float, pitch: float, roll: float) -> list[list[float]]:
    """World from camera: roll about z, then pitch about x (positive: up), then yaw about y (positive: right)."""
    (ca, sa), (cb, sb), (cc, sc) = ((math.cos(math.radians(v)), math.sin(math.radians(v))) for v in (yaw, pitch, roll))
    return [
        [ca * cc + sa * sb * sc, -ca * sc + sa * sb * cc, sa * cb],
        [cb * sc, cb * cc, -sb],
        [-sa * cc + ca * sb * sc, sa * sc + ca * sb * cc, ca * cb],
    ]


# ------------------------------------------------------------------------------------------- a device's own trajectory

#: Axis of the drift, world coordinates: up, since gravity corrects the other two. Source: derived, the rooms' axes.
_DRIFT_AXIS = (0.0, -1.0, 0.0)


def reported_poses(
    poses: Pose,
    times: Tensor,
    *,
    offset_deg: float = 0.0,
    lag_s: float = 0.0,
    drift_deg_per_s: float = 0.0,
    rotation_noise_deg: float = 0.0,
    seed: int = 0,
) -> Pose:
    """True poses (n,) of a camera -> those that its device reports for the same frames.

    Args:
        poses: T_world_from_cam, float64.
        times: (n,) s, increasing.
        offset_deg: constant angle between the device's axes and the camera's, about their diagonal.
        lag_s: the pose reported for a frame is the one of this time before it; before the first frame it is the first.
        drift_deg_per_s: turn about the vertical that the reported rotation gains.
        rotation_noise_deg: standard deviation of an independent turn of every frame, per axis.
        seed: of the noise.

    Returns:
        Poses (n,), float64; equal to ``poses`` with all options 0.
    """
    late = _earlier(poses, times, lag_s) if lag_s else poses
    centre = late.t
    turns = {
        "offset": torch.full((1, 3), math.radians(offset_deg) / 3**0.5, dtype=centre.dtype),
        "drift": (times - times[0])[:, None].to(centre)
        * math.radians(drift_deg_per_s)
        * centre.new_tensor(_DRIFT_AXIS),
        "noise": math.radians(rotation_noise_deg)
        * torch.randn(len(times), 3, generator=Generator().manual_seed(seed), dtype=centre.dtype),
    }
    R = {name: se3.exp(torch.cat((turn, torch.zeros_like(turn)), -1)).R for name, turn in turns.items()}
    return Pose(R["drift"] @ late.R @ R["offset"] @ R["noise"], centre)


def _earlier(poses: Pose, times: Tensor, lag_s: float) -> Pose:
    """Poses at ``times - lag_s``: position linear, rotation at constant speed between neighbouring frames."""
    at = (times - lag_s).clamp_min(times[0])
    after = torch.searchsorted(times, at).clamp(1, max(len(times) - 1, 1)).clamp(max=len(times) - 1)
    before = (after - 1).clamp_min(0)
    span = (times[after] - times[before]).clamp_min(1e-12)
    weight = ((at - times[before]) / span).to(poses.t)[:, None]
    step = se3.log(se3.relative(poses[after], poses[before]))  # pose of `after` in the frame of `before`
    turn = torch.cat((weight * step[:, :3], torch.zeros_like(step[:, 3:])), -1)
    centre = (1 - weight) * poses.t[before] + weight * poses.t[after]
    return Pose(poses.R[before] @ se3.exp(turn).R, centre)
