"""The built-in recording: a hand-held phone with a LiDAR in a furnished room, with exact ground truth.

Images are ray cast (:mod:`dhtorch.synthetic.room`), so depth, poses and intrinsics are exact; the sensor depth is a
model of a phone's LiDAR. Every frame is a function of the options and its index alone: not of the other frames, the
order of access, the process or the number of threads.
"""

import inspect
import itertools
from collections.abc import Sequence
from random import Random
from typing import Any, ClassVar

import torch
from torch import Generator, Tensor

from dhtorch.data.recording import TruthRecording, consecutive_frame_numbers
from dhtorch.data.scene import Scene
from dhtorch.geometry.camera import Camera, resize
from dhtorch.records import Frame, Pose
from dhtorch.runtime.console import format_count
from dhtorch.synthetic.paths import CAMERA_PATHS, hand_held_path, reported_poses
from dhtorch.synthetic.raycast import SURFACE_DARK, SURFACE_MIRROR, SURFACE_ORDINARY, SURFACE_WINDOW, world_rays
from dhtorch.synthetic.room import furnished_room
from dhtorch.synthetic.shading import ShadedRoom

#: Values of ``truth(i)["surface"]`` without moving bodies.
SURFACE_NAMES = {SURFACE_ORDINARY: "ordinary", SURFACE_MIRROR: "mirror", SURFACE_WINDOW: "window", SURFACE_DARK: "dark"}


class SyntheticRoom(TruthRecording):
    """The built-in room: a recording whose frames are rendered on access.

    Args:
        seed: of the paint and small placements, the path and the sensor noise.
        n_frames: number of frames.
        hw: (height, width) of the image in pixels.
        path: one of :data:`CAMERA_PATHS`. ``walk`` is a hand-held sweep; ``rotation`` does not translate, ``static``
            does not move.
        step_m: length of the path from frame to frame (for ``rotation``: the same pace, as an angle).
        rate_hz: frame rate.
        lidar: ``phone`` = the model of :func:`simulate_phone_lidar`; ``exact`` = true depth at every image pixel; None
            = no sensor, depth is 0 everywhere.
        depth_hw: (height, width) of the phone's depth map, and of the empty one.
        range_limit: of the phone's LiDAR, m along the ray.
        depth_noise: factor on the LiDAR's noise; with 0 its drop-outs and limits remain.
        image_noise: standard deviation of the pixel noise, grey levels of 255.
        supersample: rays per pixel and axis.
        trajectory_axes: ``cv`` or ``gl``, the axes stated for the device's trajectory (``pose_axes``; frames have
            OpenCV axes in any case).
        trajectory_offset_deg, trajectory_lag_s, trajectory_drift_deg_per_s, trajectory_rotation_noise_deg: errors of
            the frames' trajectory, which ``true_poses`` does not have; see
            :func:`dhtorch.synthetic.paths.reported_poses`.
        name: of the recording.
        true_poses: (n_frames) T_world_from_cam, float64, instead of the path's.
        times: (n_frames) s, float64, instead of the frame rate's.

    Raises:
        ValueError: an unknown path or LiDAR, or a size, count or limit that is not positive.
    """

    surfaces = SURFACE_NAMES
    odd_surfaces: ClassVar[tuple[str, ...]] = ("mirror", "window")

    def __init__(
        self,
        *,
        seed: int = 2,
        n_frames: int = 12,
        hw: tuple[int, int] = (480, 640),
        path: str = "walk",
        step_m: float = 0.02,
        rate_hz: float = 30.0,
        lidar: str | None = "phone",
        depth_hw: tuple[int, int] = (192, 256),
        range_limit: float = 5.0,
        depth_noise: float = 1.0,
        image_noise: float = 1.0,
        supersample: int = 2,
        trajectory_axes: str = "cv",
        trajectory_offset_deg: float = 0.0,
        trajectory_lag_s: float = 0.0,
        trajectory_drift_deg_per_s: float = 0.0,
        trajectory_rotation_noise_deg: float = 0.0,
        name: str = "synthetic_room",
        true_poses: Pose | None = None,
        times: Tensor | None = None,
    ):
        if path not in CAMERA_PATHS:
            raise ValueError(f"synthetic room: path is {path!r}, expected one of {', '.join(CAMERA_PATHS)}")
        if lidar not in ("phone", "exact", None):
            raise ValueError(f"synthetic room: lidar is {lidar!r}, expected phone, exact or None")
        if trajectory_axes not in ("cv", "gl"):
            raise ValueError(f"synthetic room: trajectory_axes is {trajectory_axes!r}, expected cv or gl")
        positive = {"n_frames": n_frames, "rate_hz": rate_hz, "range_limit": range_limit, "supersample": supersample}
        for option, value in {**positive, "hw": min(hw), "depth_hw": min(depth_hw)}.items():
            if not value > 0:
                raise ValueError(f"synthetic room: {option} is {value}, expected a positive number")
        if true_poses is None:
            true_poses = hand_held_path(path, n_frames, step_m=step_m, rate_hz=rate_hz, seed=seed)
        times = consecutive_frame_numbers(n_frames).double() / rate_hz if times is None else times
        reported = reported_poses(
            true_poses,
            times,
            offset_deg=trajectory_offset_deg,
            lag_s=trajectory_lag_s,
            drift_deg_per_s=trajectory_drift_deg_per_s,
            rotation_noise_deg=trajectory_rotation_noise_deg,
            seed=seed,
        )
        super().__init__(
            name=name,
            format="synthetic",
            load=self._render,
            number=consecutive_frame_numbers(n_frames),
            times=times,
            poses=reported,
            pose_axes=trajectory_axes,
            rate_hz=rate_hz,
        )
        self.true_poses = true_poses
        self.seed, self.path, self.lidar = seed, path, lidar
        self.hw, self.depth_hw = (hw[0], hw[1]), (depth_hw[0], depth_hw[1])
        self.range_limit, self.depth_noise, self.image_noise = range_limit, depth_noise, image_noise
        self.supersample = supersample
        self.camera = phone_camera(self.hw)
        self._frames: dict[int, Frame] = {}

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]  # single frames only: a slice would render them all
        i = self._position(index)
        if i not in self._frames:
            self._frames[i] = self._render(i)
        return self._frames[i]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_frames": {}}  # not pickled: a worker renders its own frames

    def __repr__(self) -> str:
        frames = format_count(len(self), "frame")
        return f"SyntheticRoom(seed={self.seed}, path={self.path!r}, lidar={self.lidar!r}, {frames})"

    def truth(self, index: int) -> dict[str, Tensor]:
        """True depth and surface kind at the centre of every image pixel of frame ``index``.

        A mirror or a window pane has the depth of its own surface. What is visible *in* it lies elsewhere, where it is
        triangulated: evaluate such pixels separately, by ``surface``.

        Returns:
            ``depth`` (1, H, W) m float32 and ``surface`` (1, H, W) uint8, a key of :data:`SURFACE_NAMES`.
        """
        i = self._position(index)
        return self._true_view(i, self.camera, self.true_poses[i : i + 1], self.hw)

    def world(self, index: int) -> ShadedRoom:
        """The room at frame ``index``."""
        return furnished_room(self.seed)

    def _true_view(self, i: int, camera: Camera, pose: Pose, hw: tuple[int, int]) -> dict[str, Tensor]:
        scene = self.world(i)
        depth, solid = scene.solids.view(camera, pose, hw)
        o, d = world_rays(camera, pose, hw)
        face, _, _ = scene.solids.locate(solid, [o[k] + d[k] * depth for k in range(3)])
        return {"depth": depth.view(1, *hw), "surface": scene.kind[face].to(torch.uint8).view(1, *hw)}

    def _render(self, i: int) -> Frame:
        pose, poses, times = self.true_poses[i : i + 1], self.poses, self.times
        assert poses is not None and times is not None
        scene = self.world(i)
        image = self._picture(i)
        image = image * 255 + self.image_noise * torch.randn(image.shape, generator=self._generator(i, "image"))
        conf = torch.zeros(1, *self.depth_hw, dtype=torch.uint8)
        depth = conf.float()
        depth_camera = resize(self.camera, self.hw, self.depth_hw)
        if self.lidar == "phone":
            options = {"range_limit": self.range_limit, "noise_factor": self.depth_noise}
            depth, conf = simulate_phone_lidar(
                scene, depth_camera, pose, self.depth_hw, generator=self._generator(i, "lidar"), **options
            )
        elif self.lidar == "exact":
            depth, depth_camera = self.truth(i)["depth"], self.camera
            conf = torch.full_like(depth, 2, dtype=torch.uint8)
        return Frame(
            image=(image + 0.5).floor().clamp(0, 255).to(torch.uint8),
            depth=depth,
            camera=self.camera,
            depth_camera=depth_camera,
            conf=conf,
            time=times[i : i + 1],
            T_world_from_cam=poses[i : i + 1].to(torch.float32),
        )

    def _picture(self, i: int) -> Tensor:
        return self._photograph(i, self.camera, self.true_poses[i : i + 1], self.hw)

    def _photograph(self, i: int, camera: Camera, pose: Pose, hw: tuple[int, int], *, exposure: float = 1.0) -> Tensor:
        return _photograph(self.world(i), camera, pose, hw, supersample=self.supersample, exposure=exposure)

    def _generator(self, i: int, stream: str) -> Generator:
        return Generator().manual_seed(Random(f"{self.seed} {i} {stream}").getrandbits(62))


def open_room(*, near: float = 2.0, gap: int = 6, **options: Any) -> Scene:
    """The built-in room as a scene.

    Args:
        near: m, cutoff for a range split.
        gap: frame step; 6 with the default step is a distance of 12 cm.
        options: of :class:`SyntheticRoom`.

    Raises:
        ValueError: near or gap is not positive, or an unknown option; else as :class:`SyntheticRoom`.
    """
    parameters = inspect.signature(SyntheticRoom).parameters
    for option in options:
        if option not in parameters:
            raise ValueError(f"synthetic room: found option {option!r}, expected one of {', '.join(parameters)}")
    return room_to_scene(SyntheticRoom(**options), near, gap)


def room_to_scene(room: SyntheticRoom, near: float, gap: int) -> Scene:
    """A room as a scene with its cutoff and frame step; a path without baseline has the role ``rotation``.

    Raises:
        ValueError: near or gap is not positive.
    """
    for name, value in {"near": near, "gap": gap}.items():
        if not value > 0:
            raise ValueError(f"synthetic room: {name} is {value}, expected a positive number")
    return Scene(room, near=near, gap=gap, role="rotation" if room.path in ("rotation", "static") else None)


def open_rooms(
    paths: Sequence[str] = tuple(CAMERA_PATHS),
    *,
    seed: int | Sequence[int] = 2,
    n_frames: int = 12,
    hw: tuple[int, int] = (480, 640),
    lidar: str | None = "phone",
    depth_noise: float = 1.0,
    image_noise: float = 1.0,
    near: float = 2.0,
    gap: int = 6,
) -> list[Scene]:
    """The room along several paths and of several seeds, one scene each; options as :func:`open_room`.

    A recording is named after its path and, with several seeds, its seed.
    """
    options: dict[str, Any] = {"n_frames": n_frames, "hw": hw, "lidar": lidar, "near": near, "gap": gap}
    options |= {"depth_noise": depth_noise, "image_noise": image_noise}
    seeds = [seed] if isinstance(seed, int) else list(seed)
    scenes = []
    for path, number in itertools.product(paths, seeds):
        name = f"synthetic_{path}" if isinstance(seed, int) else f"synthetic_{path}_{number}"
        scenes.append(open_room(path=path, seed=number, name=name, **options))
    return scenes


def join_scenes(parts: Sequence[Sequence[Scene]]) -> list[Scene]:
    """Scenes of several sources in one list, e.g. real ones and built-in rooms."""
    return [scene for part in parts for scene in part]


def simulate_phone_lidar(
    scene: ShadedRoom,
    camera: Camera,
    T_world_from_cam: Pose,
    hw: tuple[int, int],
    *,
    generator: Generator,
    range_limit: float = 5.0,
    noise_factor: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """Simulated depth of a phone's LiDAR (B = 1): depth (1, h, w) m, 0 = no return, and confidence 0–2.

    The returned light falls with reflectance, slant and squared range. Where it is weak the noise is larger, the
    confidence lower and returns are missing. They are also missing on mirrors (remaining ones lie *behind* the mirror,
    at low confidence), window panes, grazing surfaces, at depth edges (remaining ones mix both sides) and towards
    ``range_limit``, beyond which there are none. Gaps come in patches, and noise is correlated between neighbours, as
    in a device that interpolates between sparse beams. Parameters are plausible, not fitted to a device.

    Returns:
        depth float32 and confidence uint8 (2 high, 1 medium, 0 low or no return), both (1, h, w).
    """
    depth, solid = scene.solids.view(camera, T_world_from_cam, hw)
    o, d = world_rays(camera, T_world_from_cam, hw)
    p = [o[k] + d[k] * depth for k in range(3)]
    face, _, _ = scene.solids.locate(solid, p)
    cosine, kind = scene.cosine(d, face, p), scene.kind[face]
    per_depth = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt()
    edge, mixed = _depth_edges(depth.view(hw))
    measured = torch.where(edge, mixed, depth)
    at_mirror = (kind == SURFACE_MIRROR).nonzero()[:, 0]
    _, _, reflected, _ = scene.mirrored(
        [c[at_mirror] for c in o], [c[at_mirror] for c in d], depth[at_mirror], face[at_mirror]
    )
    measured = measured.index_copy(0, at_mirror, depth[at_mirror] + reflected)
    distance = measured * per_depth
    returned = scene.albedo[face] * scene.albedo[face] * cosine / (distance * distance)

    far = ((distance / range_limit - 0.85) / 0.15).clamp(0, 1)
    p_lost = 0.6 * far
    for probability in (
        torch.where(edge, 0.5, 0.0),
        torch.where(kind == SURFACE_MIRROR, 0.85, 0.0),
        torch.where(kind == SURFACE_WINDOW, 0.9, 0.0),
        0.9 * ((0.25 - cosine) / 0.25).clamp(0, 1),
        0.9 * (1 - returned / 0.001).clamp(0, 1),
    ):
        p_lost = 1 - (1 - p_lost) * (1 - probability)
    answered = (_patchy_uniform(hw, generator) >= p_lost) & (distance <= range_limit)

    sigma = (0.002 + 0.0025 * distance * distance) * (0.025 / returned.clamp(min=1e-6)).sqrt().clamp(1, 2.5)
    error = noise_factor * sigma * _shared_normal(hw, generator)
    reported = ((distance + error) / per_depth).clamp(min=0.05)
    level = (returned > 0.001).int() + ((returned > 0.025) & (far == 0)).int()
    level = torch.where(edge | (kind == SURFACE_MIRROR) | (kind == SURFACE_WINDOW), 0, level)
    depth = torch.where(answered, reported, torch.zeros_like(reported))
    conf = torch.where(answered, level, 0).to(torch.uint8)
    return depth.view(1, *hw), conf.view(1, *hw)


def _photograph(
    scene: ShadedRoom, camera: Camera, pose: Pose, hw: tuple[int, int], *, supersample: int, exposure: float = 1.0
) -> Tensor:
    """Rendered image (1, 3, H, W), display values in [0, 1], times ``exposure`` and clipped: the mean of
    ``supersample``² rays in each pixel."""
    s = supersample
    fine_hw = (hw[0] * s, hw[1] * s)
    dense = resize(camera, hw, fine_hw)
    depth, solid = scene.solids.view(dense, pose, fine_hw)
    o, d = world_rays(dense, pose, fine_hw)
    colour, _ = scene.shade(o, d, depth, solid, 1 / float(dense.f.min()))
    colour = (colour * exposure).clamp(0, 1).view(hw[0], s, hw[1], s, 3)
    total = torch.zeros(*hw, 3)
    for i in range(s):
        for k in range(s):
            total = total + colour[:, i, :, k]
    return total.permute(2, 0, 1)[None] / (s * s)


def _depth_edges(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Mask of depth edges of a map (h, w), and the mean with the farther neighbour; both flat (h·w,).

    A plane has linear inverse depth, however slanted: the second difference distinguishes jumps from slopes.
    """
    inverse = torch.nn.functional.pad(1 / depth[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    middle = inverse[1:-1, 1:-1]
    sides = [inverse[1:-1, :-2], inverse[1:-1, 2:], inverse[:-2, 1:-1], inverse[2:, 1:-1]]
    bend = torch.maximum((sides[0] + sides[1] - 2 * middle).abs(), (sides[2] + sides[3] - 2 * middle).abs())
    farther = torch.minimum(torch.minimum(sides[0], sides[1]), torch.minimum(sides[2], sides[3]))
    return (bend > 0.05 * middle).flatten(), (0.5 * depth + 0.5 / farther).flatten()


def _patchy_uniform(hw: tuple[int, int], generator: Generator) -> Tensor:
    """Uniform numbers (h·w,), most of them equal within blocks of 4×4 pixels, so that gaps come in patches."""
    coarse = torch.rand((hw[0] + 3) // 4, (hw[1] + 3) // 4, generator=generator)
    coarse = coarse.repeat_interleave(4, 0)[: hw[0]].repeat_interleave(4, 1)[:, : hw[1]]
    per_pixel = torch.rand(hw, generator=generator)
    return torch.where(torch.rand(hw, generator=generator) < 0.3, per_pixel, coarse).flatten()


def _shared_normal(hw: tuple[int, int], generator: Generator) -> Tensor:
    """Standard normal numbers (h·w,), 64 % of whose variance is correlated over about 6 pixels."""
    smooth = torch.randn(-(-hw[0] // 6) + 1, -(-hw[1] // 6) + 1, generator=generator)
    for dim in (0, 1):
        pixel = torch.arange(hw[dim])
        low, w = pixel // 6, ((pixel % 6) / 6).unsqueeze(1 - dim)
        mixed = smooth.index_select(dim, low) * (1 - w) + smooth.index_select(dim, low + 1) * w
        smooth = mixed / ((1 - w) * (1 - w) + w * w).sqrt()  # keeps the variance at 1
    return (0.8 * smooth + 0.6 * torch.randn(hw, generator=generator)).flatten()


def phone_camera(hw: tuple[int, int]) -> Camera:
    """Camera (1) with f = 525 px at 640 columns and a principal point slightly off the centre."""
    s = hw[1] / 640
    c = [hw[1] / 2 + 2.3 * s - 0.5, hw[0] / 2 - 1.4 * s - 0.5]
    return Camera(torch.tensor([[525.0 * s, 525.0 * s]]), torch.tensor([c]))
