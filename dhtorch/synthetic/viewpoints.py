"""Independent views of the built-in room from random positions and directions, one frame each."""

from random import Random

import torch

from dhtorch.geometry.camera import Camera, resize
from dhtorch.records import Pose
from dhtorch.synthetic.paths import rotation_from_angles
from dhtorch.synthetic.recording import SyntheticRoom, phone_camera
from dhtorch.synthetic.room import ROOM_BACK_M, ROOM_FRONT_M, ROOM_LEFT_M, ROOM_RIGHT_M, furnished_room

#: Number of views per room seed.
_VIEWS_PER_ROOM = 5

#: A view with more than a hundredth of its pixels nearer than this is redrawn, m.
_MIN_DEPTH_M = 0.4


def open_viewpoints(
    n: int = 20,
    *,
    seed: int = 2,
    hw: tuple[int, int] = (240, 320),
    image_noise: float = 0.0,
    supersample: int = 2,
) -> list[SyntheticRoom]:
    """``n`` random views of the room with exact depth, a recording of one frame each.

    The viewer stands anywhere, at a height of 0.9 to 1.7 m, and looks in any direction, mostly slightly down; the seed
    of the room changes every :data:`_VIEWS_PER_ROOM` views. View ``k`` does not depend on ``n``.

    Args:
        n: number of views.
        seed: of rooms and viewers.
        hw, image_noise, supersample: as :class:`SyntheticRoom`. Without noise by default: a camera model applied
            to the image adds its own.

    Raises:
        ValueError: ``n`` below 1, or an option that :class:`SyntheticRoom` rejects.
    """
    if n < 1:
        raise ValueError(f"viewpoints: n is {n}, expected at least 1")
    views = []
    for k in range(n):
        room, camera = seed + k // _VIEWS_PER_ROOM, phone_camera((hw[0], hw[1]))
        view = SyntheticRoom(
            seed=room,
            n_frames=1,
            hw=hw,
            lidar="exact",
            image_noise=image_noise,
            supersample=supersample,
            name=f"viewpoint_{k:02d}",
            true_poses=_draw_pose(room, camera, (hw[0], hw[1]), Random(f"viewpoint {seed} {k}")),
        )
        views.append(view)
    return views


def _draw_pose(room: int, camera: Camera, hw: tuple[int, int], draw: Random) -> Pose:
    """A random pose away from near surfaces: ``T_world_from_cam`` (1), float64."""
    solids = furnished_room(room).solids
    small = (24, 32)
    camera = resize(camera, hw, small)
    while True:
        x, z = draw.uniform(ROOM_LEFT_M + 0.5, ROOM_RIGHT_M - 0.5), draw.uniform(ROOM_FRONT_M + 0.4, ROOM_BACK_M - 0.8)
        R = torch.tensor(
            [rotation_from_angles(draw.uniform(-180, 180), draw.uniform(-22, 4), 0.0)], dtype=torch.float64
        )
        pose = Pose(R, torch.tensor([[x, -draw.uniform(0.9, 1.7), z]], dtype=torch.float64))
        depth, _ = solids.view(camera, pose, small)
        if float(depth.sort().values[len(depth) // 100]) > _MIN_DEPTH_M:
            return pose
