"""Frames of a box seen from inside, with exact depth and pose, for the tests of the readers."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dhtorch.data.recording import Recording
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import patches, se3
from dhtorch.records import Camera, Frame, Pose

BOX = torch.tensor([2.0, 1.5, 3.0], dtype=torch.float64)  # half sizes of the room, m
HW = (48, 64)
CAMERA = Camera(torch.tensor([[61.5, 58.25]]), torch.tensor([[33.5, 21.75]]))  # nothing about it is symmetric


def render(
    camera: Camera, T: Pose, hw: tuple[int, int], time: float = 0.0, depth_camera: Camera | None = None
) -> Frame:
    """The frame of a camera at ``T`` inside the box; depth is exact to float32."""
    xyz, _ = hit(camera, T, hw)
    tone = [torch.sin(3 * xyz[..., 0] + 1), torch.sin(4 * xyz[..., 1] - xyz[..., 0]), torch.sin(5 * xyz[..., 2])]
    image = ((torch.stack(tone) * 0.5 + 0.5) * 255).round().to(torch.uint8)
    _, depth = hit(depth_camera or camera, T, hw)
    stamp = torch.tensor([time], dtype=torch.float64)
    return Frame(image[None], depth[None].float(), camera, depth_camera, time=stamp, T_world_from_cam=T)


def hit(camera: Camera, T: Pose, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(world points (H, W, 3), depth (H, W)) where the rays of all pixels meet the box, float64."""
    v, u = torch.meshgrid(torch.arange(hw[0]), torch.arange(hw[1]), indexing="ij")
    uv = torch.stack((u, v), -1).reshape(1, -1, 2).double()
    ray = se3.rotate(T.R, cameras.rays(camera.to(torch.float64), uv))[0]
    depth = ((torch.sign(ray) * BOX - T.t[0]) / ray).amin(-1)
    return (T.t[0] + depth[:, None] * ray).reshape(*hw, 3), depth.reshape(hw)


def pose(i: float, offset: float = 0.0) -> Pose:
    """Pose ``i`` of a path that rotates about all three axes."""
    xi = torch.tensor(
        [[0.25 - 0.03 * i + offset, 0.7 + 0.05 * i, -0.4 + 0.04 * i, 0.3 * math.sin(i), 0.1 * i, -0.2 + 0.08 * i]]
    )
    return se3.exp(xi.double())


def walk(n: int = 4, camera: Camera = CAMERA, hw: tuple[int, int] = HW, **options: Camera) -> list[Frame]:
    """The first ``n`` frames of that path at 30 Hz."""
    return [render(camera, pose(i), hw, 100 + i / 30, **options) for i in range(n)]


def off_wall(xyz: Tensor) -> Tensor:
    """Relative distance of world points from the walls."""
    return ((xyz.double().abs() / BOX).amax(-1) - 1).abs()


def world_points(frame: Frame) -> Tensor:
    """World points (1, P, 3) of all returns of a frame."""
    v, u = torch.nonzero(frame.depth[0] > 0, as_tuple=True)
    uv = torch.stack((u, v), -1).double()[None]
    camera = (frame.depth_camera or frame.camera).to(torch.float64)
    return se3.apply(frame.T_world_from_cam, cameras.unproject(camera, uv, frame.depth[0, v, u].double()[None]))[0]


def own_camera(frame: Frame) -> Frame:
    """The frame with the camera of its depth map stated."""
    return frame.replace(depth_camera=cameras.resize(frame.camera, frame.hw, tuple(frame.depth.shape[-2:])))


def turned_over(frame: Frame) -> Frame:
    """The frame with wrong camera axes (OpenGL for OpenCV), which a check of poses must detect."""
    over = torch.diag(torch.tensor([1.0, -1.0, -1.0])).to(frame.T_world_from_cam.R)
    return frame.replace(T_world_from_cam=Pose(frame.T_world_from_cam.R @ over, frame.T_world_from_cam.t))


def disagreement(a: Frame, b: Frame, near: float = math.inf, reach: int = 0) -> tuple[float, int]:
    """Median of |z − z'| / z' between the points of ``a`` carried into ``b`` and the returns there, and their number.

    ``reach``: look for the agreeing return within so many pixels (sparse depth).
    """
    v, u = torch.nonzero((a.depth[0] > 0) & (a.depth[0] < near), as_tuple=True)
    xyz = cameras.unproject(a.depth_camera or a.camera, torch.stack((u, v), -1).float()[None], a.depth[0, v, u][None])
    xyz = se3.apply(se3.relative(a.T_world_from_cam, b.T_world_from_cam), xyz.double())
    uv, z = cameras.project(b.depth_camera or b.camera, xyz.float()), xyz[..., 2]
    best = torch.full_like(z, math.inf)
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            value, inside = patches.sample_nearest(b.depth, uv + torch.tensor([du, dv]))
            error = (z - value).abs() / value.clamp(min=1e-9)
            best = torch.where(inside & (value > 0) & (z > 0), torch.minimum(best, error), best)
    finite = best[torch.isfinite(best)]
    return float(finite.median()), finite.numel()


def turned_back(recording: Recording, up: Sequence[float]) -> Recording:
    """The recording in the world of the box; in its own, ``up`` is the −y of the box."""
    turn = Pose(se3.turn_between(up, (0.0, -1.0, 0.0))[None], torch.zeros(1, 3).double())
    return recording if recording.poses is None else replace(recording, poses=se3.compose(turn, recording.poses))


def check_same(got: Recording, frames: list[Frame], step: float) -> None:
    """Asserts that a recording holds these frames: cameras, poses and pictures equal, depth to half a ``step`` (m)."""
    for i, want in enumerate(frames):
        frame = got[i]
        assert frame.image.dtype == torch.uint8 and frame.depth.dtype == torch.float32
        assert torch.equal(frame.camera.f, want.camera.f) and torch.equal(frame.camera.c, want.camera.c)
        torch.testing.assert_close(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-12, rtol=0)
        torch.testing.assert_close(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-12, rtol=0)
        torch.testing.assert_close(frame.depth, want.depth, atol=step / 2 + 1e-6, rtol=0)
        assert torch.equal(frame.image, want.image)
        assert float(off_wall(world_points(frame)).max()) < 2 * step
    if len(frames) > 1:
        assert len(got) == len(frames)
        assert disagreement(got[0], got[1])[0] < 0.02
