"""Moving bodies in the built-in room and their motions: with the viewer, in a hand, or on a turntable.

A body has a *home* pose in front of the viewer of the static path, where its light is computed; a motion is its
displacement from home. It uses the textures of the room, is otherwise the same for every seed, and casts no shadow: the
rest of the room looks the same with and without it.

Alphabet: ``T_world_from_home`` (n) a motion of the world, one a frame; axes of the world as the room's, lengths in m.
"""

import math
from functools import lru_cache

import torch

from dhtorch.geometry import se3
from dhtorch.geometry.se3 import Pose
from dhtorch.pytree import collate
from dhtorch.synthetic.paths import hand_held_path, rotation_from_angles
from dhtorch.synthetic.raycast import SURFACE_MOVING, Material, Solid, Triple
from dhtorch.synthetic.room import furnished_room, make_box
from dhtorch.synthetic.shading import ShadedRoom

#: Pose of the viewer with a body in front of it, and its viewing direction, degrees to the right.
_VIEWER_POSE, _YAW = hand_held_path("static", 1, step_m=0.0, rate_hz=1.0, seed=0), 12.0

#: Centre of the held body, in the viewer's axes (x right, y down, z forward).
_CARRIED_CENTRE: Triple = (0.02, 0.05, 0.52)

#: Centre of the turntable, in the viewer's axes, and its rotation, degrees per frame.
_TURNTABLE_CENTRE: Triple = (0.0, 0.02, 1.07)
_TURN_DEG_PER_FRAME = 2.0

#: Frames in which a body in a lane speeds up and slows down once.
_SURGE_FRAMES = 9


def _body_box(
    at: Triple, size: Triple, picture: str, *, tile: float | None = None, yaw: float = 0, pitch: float = 0
) -> Solid:
    """A box with its centre ``at`` and its rotation in the viewer's axes; ``size`` is (across, up, deep)."""
    x, y, z = se3.apply(_VIEWER_POSE, torch.tensor([[at]], dtype=torch.float64))[0, 0].tolist()
    surface = Material(picture, tile=tile, kind=SURFACE_MOVING)
    return make_box(x, -y - size[1] / 2, z, size, surface, yaw=_YAW + yaw, pitch=pitch, shadow=False)


def _parcel_stack() -> list[Solid]:
    """A stack of parcels, 0.8 to 1.2 m in front of the viewer."""
    return [
        _body_box((0.05, 0.05, 1.11), (0.42, 0.32, 0.22), "poster:0", yaw=24),
        _body_box((-0.19, 0.10, 0.97), (0.21, 0.23, 0.18), "print", tile=0.5, yaw=-18),
        _body_box((0.20, 0.16, 0.95), (0.20, 0.14, 0.16), "poster:2", yaw=8),
        _body_box((0.02, -0.18, 1.09), (0.25, 0.15, 0.16), "poster:1", yaw=-12),
        _body_box((0.0, 0.25, 1.07), (0.58, 0.05, 0.34), "carpet", yaw=4),
    ]


def _carried_parcel() -> list[Solid]:
    """A parcel and the fingers that hold it, 0.4 to 0.6 m in front of the viewer."""
    x, y, z = _CARRIED_CENTRE
    parcel = _body_box(_CARRIED_CENTRE, (0.26, 0.19, 0.10), "poster:3", yaw=22, pitch=-16)
    label = _body_box((x - 0.02, y - 0.11, z + 0.01), (0.13, 0.07, 0.08), "poster:1", yaw=-14)
    fingers = [
        _body_box((x + 0.11, y + 0.03 * k - 0.02, z - 0.06), (0.09, 0.022, 0.022), "speckle", tile=0.15, yaw=30)
        for k in range(4)
    ]
    return [parcel, label, *fingers]


#: Bodies by name.
MOVING_BODIES = {"parcels": _parcel_stack, "held": _carried_parcel}


@lru_cache(maxsize=2)
def room_with_body(seed: int, guest: str) -> ShadedRoom:
    """The furnished room of a seed with one of :data:`MOVING_BODIES` at home; cached for the last two."""
    return furnished_room(seed).joined_by(MOVING_BODIES[guest]())


def move_with_viewer(T_world_from_cam: Pose, *, share: float = 1.0) -> Pose:
    """``T_world_from_home`` (n) of a body that translates by ``share`` times the viewer's translation."""
    moved = T_world_from_cam.t - _VIEWER_POSE.t
    return Pose(se3.identity(len(moved), moved).R, share * moved)


def move_in_lanes(T_world_from_cam: Pose, *, shares: tuple[float, ...], unevenness: float = 0.0) -> Pose:
    """``T_world_from_home`` (n k), the k motions of a frame one after the other, of bodies in lanes of their own.

    A body translates by its of the k ``shares`` times the viewer's translation, backwards where negative. Its speed
    rises and falls by the fraction ``unevenness`` of the viewer's within :data:`_SURGE_FRAMES` frames.
    """
    moved = T_world_from_cam.t - _VIEWER_POSE.t
    steps = torch.diff(moved, dim=0, prepend=moved[:1])
    lanes = []
    for k, share in enumerate(shares):
        phase = [2 * math.pi * (i / _SURGE_FRAMES + k / len(shares)) for i in range(len(moved))]
        surge = torch.tensor([[math.sin(p)] for p in phase], dtype=moved.dtype)
        lanes.append(share * moved + unevenness * (surge * steps).cumsum(0))
    t = torch.stack(lanes, 1).flatten(0, 1)
    return Pose(se3.identity(len(t), t).R, t)


def move_in_hand(T_world_from_cam: Pose) -> Pose:
    """``T_world_from_home`` (n) of a body that moves rigidly with the viewer, with small motions of the hand added."""
    hand_motions = []
    for i in range(T_world_from_cam.t.shape[0]):
        turn = rotation_from_angles(
            3.0 * math.sin(0.41 * i), 2.0 * math.sin(0.29 * i + 1.0), 2.0 * math.sin(0.33 * i + 2.0)
        )
        shift = [0.012 * math.sin(0.37 * i), 0.010 * math.sin(0.31 * i + 2.0), 0.010 * math.sin(0.43 * i + 4.0)]
        hand_motions.append(_rotate_about(_CARRIED_CENTRE, turn, shift))
    home_from_viewer = se3.invert(_VIEWER_POSE)
    home = home_from_viewer.map(lambda x: x.expand(len(hand_motions), *x.shape[1:]))
    return se3.compose(se3.compose(T_world_from_cam, collate(hand_motions)), home)


def turn_on_turntable(T_world_from_cam: Pose) -> Pose:
    """``T_world_from_home`` (n) of a body that turns by :data:`_TURN_DEG_PER_FRAME` about the vertical axis of the
    turntable."""
    axis = se3.apply(_VIEWER_POSE, torch.tensor([[_TURNTABLE_CENTRE]], dtype=torch.float64))[0, 0].tolist()
    n = T_world_from_cam.t.shape[0]
    return collate(
        [
            _rotate_about(tuple(axis), rotation_from_angles(_TURN_DEG_PER_FRAME * i, 0.0, 0.0), [0.0, 0.0, 0.0])
            for i in range(n)
        ]
    )


def _rotate_about(centre: tuple[float, ...], turn: list[list[float]], shift: list[float]) -> Pose:
    """Motion (1): rotation ``turn`` about ``centre``, then translation ``shift``."""
    R, c = torch.tensor([turn], dtype=torch.float64), torch.tensor([centre], dtype=torch.float64)
    return Pose(R, c - se3.rotate(R, c[:, None])[:, 0] + torch.tensor([shift], dtype=torch.float64))
