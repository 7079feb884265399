"""Stress recordings of the built-in room: one per difficulty of a capture, with exact ground truth.

Difficulties: paths with little parallax, near returns that hardly constrain a pose, a noisier sensor, a rolling
shutter, displaced image tiles, wrong tracks, moving bodies near by, a camera turned by hand, large motion, exposure
jumps and motion blur.
Recordings are named ``stress_<name>``.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.scene import Scene
from dhtorch.geometry.camera import Camera, depth_pixels
from dhtorch.geometry.patches import round_half_up
from dhtorch.records import Frame, Pose, Tracks
from dhtorch.synthetic.guests import move_in_hand, move_in_lanes, move_with_viewer, room_with_body, turn_on_turntable
from dhtorch.synthetic.paths import hand_held_path, rotation_from_angles, turn_by_hand
from dhtorch.synthetic.raycast import SURFACE_MOVING, world_rays
from dhtorch.synthetic.recording import SURFACE_NAMES, SyntheticRoom, room_to_scene
from dhtorch.synthetic.shading import ShadedRoom

#: Number of near returns kept in ``few_near``.
_N_FEW_NEAR = 20

#: Standard deviation of the additional relative depth error in ``depth_noise``; per pixel, on top of the phone's.
_DEPTH_NOISE_REL = 0.025

#: Rolling shutter: seconds from the first row to the last, and number of bands of rows with the same pose.
_READOUT_S, _N_ROW_BANDS = 0.02, 30

#: Displaced fraction of the image (``moved``) or of the tracks (``mistracks``), side of the image tiles, and range of
#: the displacement, px at 640 columns.
_MOVED_SHARE, _TILE_PX, _MOVED_RANGE_PX = 0.3, 80, (6.0, 24.0)

#: ``fast``: degrees of yaw to the right added to the first frame of the path, and added from frame to frame.
_PAN_DEG = (-6.0, 1.2)

#: ``exposure_jump``: range of the exposure change in stops, brighter or darker; grey values are then clipped.
_EXPOSURE_STOPS = (0.5, 1.0)

#: ``motion_blur``: range of the blur length, px at 640 columns; its direction differs from frame to frame.
_SMEAR_RANGE_PX = (5.0, 15.0)

#: Hand-turned cameras: bands of rows with the same exposure, seconds of exposure, moments that make an exposure, and
#: amplitude of the changes of exposure between frames, stops.
_N_TURN_BANDS, _TURN_EXPOSURE_S, _N_TURN_EXPOSURES, _EXPOSURE_SWING_STOPS = 8, 0.012, 2, 0.3

#: Positions of samples: ``(hw, n) -> uv (n, 2)``.
_SamplePattern = Callable[[tuple[int, int], int], Tensor]


class StressRoom(SyntheticRoom):
    """The built-in room with one of the stresses.

    If a body moves, its visible surface has the kind ``moving`` and is evaluated separately.

    Args:
        stress: one of :data:`STRESSES`.
        places: for ``few_near``: sample positions of the method, at which returns are kept. None = anywhere.
        n_places: number of sample positions.
        near: m; the stresses of the sensor concern returns up to this depth.
        gap: number of first frames, the reference views, that ``moved`` does not change.
        options: of :class:`SyntheticRoom`; the options of the stress override them.

    Raises:
        ValueError: an unknown stress; else as :class:`SyntheticRoom`.
    """

    surfaces = SURFACE_NAMES | {SURFACE_MOVING: "moving"}
    odd_surfaces = (*SyntheticRoom.odd_surfaces, "moving")

    def __init__(
        self,
        stress: str,
        *,
        places: _SamplePattern | None = None,
        n_places: int = 2048,
        near: float = 2.0,
        gap: int = 6,
        **options: Any,
    ):
        if stress not in STRESSES:
            raise ValueError(f"stress room: stress is {stress!r}, expected one of {', '.join(STRESSES)}")
        options = {"name": f"stress_{stress}", **options, **STRESSES[stress].options}
        self.bands: list[Pose] = []
        path_options = {k: options[k] for k in _PATH_OPTIONS if k in options}
        if stress == "rolling_shutter":
            self.bands, options["true_poses"] = _rolling_shutter_poses(**path_options)
        if stress == "fast":
            options["true_poses"] = _panning_poses(**path_options)
        self.turn = STRESSES[stress].turn
        if self.turn is not None:
            n_frames, rate_hz = options.get("n_frames", 12), options.get("rate_hz", 30.0)
            self._pose_at = partial(
                turn_by_hand,
                duration_s=n_frames / rate_hz,
                degrees=self.turn.degrees,
                reach_m=self.turn.reach_m,
                seed=options.get("seed", 2),
            )
            options["true_poses"] = self._pose_at([i / rate_hz for i in range(n_frames)])
        super().__init__(**options)
        self.stress, self.places, self.n_places = stress, places, n_places
        moving = STRESSES[stress].moving
        #: T_world_from_home (n_frames k) of the moving body, None without one: see :mod:`dhtorch.synthetic.guests`.
        self.body_poses = None if moving is None else moving.motion(self.true_poses)
        self.near, self.gap = near, gap
        if self.bands:
            self.camera = self.camera.replace(readout=torch.tensor([_READOUT_S]))

    def truth(self, index: int) -> dict[str, Tensor]:
        """As :meth:`SyntheticRoom.truth`; under a rolling shutter with the pose of each row."""
        i = self._position(index)
        if not self.bands:
            return super().truth(i)
        parts = [self._true_view(i, camera, pose, hw) for camera, pose, hw in self._rows(i)]
        return {k: torch.cat([part[k] for part in parts], 1) for k in parts[0]}

    def world(self, index: int) -> ShadedRoom:
        """As :meth:`SyntheticRoom.world`, with the moving body at its position in frame ``index``."""
        i, moving = self._position(index), STRESSES[self.stress].moving
        if self.turn is not None:
            return room_with_body(self.seed, "parcels")
        if moving is None or self.body_poses is None:
            return super().world(i)
        k = len(self.body_poses.t) // len(self)
        return room_with_body(self.seed, moving.guest).moved(self.body_poses[i * k : (i + 1) * k])

    def gain(self, index: int) -> float:
        """Factor on the grey values of frame ``index`` before clipping; 1 except for ``exposure_jump`` and turns."""
        i = self._position(index)
        if self.turn is not None:
            return math.pow(2.0, _EXPOSURE_SWING_STOPS * math.sin(0.9 * i + self.seed))
        if self.stress != "exposure_jump":
            return 1.0
        stops = (
            _EXPOSURE_STOPS[0]
            + (_EXPOSURE_STOPS[1] - _EXPOSURE_STOPS[0]) * torch.rand(1, generator=self._generator(i, "gain")).item()
        )
        brighter = (i + i // self.gap) % 2 == 0  # changes from frame to frame and over a gap
        return math.pow(2.0, stops if brighter else -stops)

    def smear(self, index: int) -> tuple[float, float]:
        """Motion of a far point to the right and down during the exposure of frame ``index``, px; 0 except for
        ``motion_blur``."""
        if self.stress != "motion_blur":
            return 0.0, 0.0
        angle, size = torch.rand(2, generator=self._generator(self._position(index), "smear")).tolist()
        length = (_SMEAR_RANGE_PX[0] + (_SMEAR_RANGE_PX[1] - _SMEAR_RANGE_PX[0]) * size) * self.hw[1] / 640
        return length * math.cos(2 * math.pi * angle), length * math.sin(2 * math.pi * angle)

    def spoil_track(self, track: Callable[..., Tracks]) -> Callable[..., Tracks]:
        """The tracker ``track`` as it works in this room: under ``mistracks`` with many wrong tracks."""
        if self.stress != "mistracks":
            return track
        return partial(_displace_tracks, track)

    def _picture(self, i: int) -> Tensor:
        if self.stress == "motion_blur":
            # Motion-blurred image: mean of renderings at most a pixel apart, on both sides of the
            # frame's pose
            right, down = self.smear(i)
            n = math.ceil(math.hypot(right, down)) + 1
            pose, f = self.true_poses[i : i + 1], float(self.camera.f[0, 0])
            total = torch.zeros(1, 3, *self.hw)
            for k in range(n):
                offset = (k / (n - 1) - 0.5) / f  # turning the camera left and up shifts the image right and down
                turn = torch.tensor(
                    [rotation_from_angles(-math.degrees(right * offset), math.degrees(down * offset), 0.0)],
                    dtype=torch.float64,
                )
                total = total + self._photograph(i, self.camera, Pose(pose.R @ turn, pose.t), self.hw)
            return total / n
        if self.turn is not None:
            return self._turned(i)
        if not self.bands:
            return self._photograph(i, self.camera, self.true_poses[i : i + 1], self.hw, exposure=self.gain(i))
        return torch.cat([self._photograph(i, camera, pose, hw) for camera, pose, hw in self._rows(i)], 2)

    def _turned(self, i: int) -> Tensor:
        """Image under a rolling shutter with motion blur: bands of rows, each the mean over its exposure."""
        turn, rate_hz = self.turn, self.rate_hz
        assert turn is not None and rate_hz is not None
        edges = [round(k * self.hw[0] / _N_TURN_BANDS) for k in range(_N_TURN_BANDS + 1)]
        bands = []
        for top, bottom in pairwise(edges):
            camera = self.camera.replace(c=self.camera.c - torch.tensor([[0.0, float(top)]]))
            middle = i / rate_hz + turn.readout_s * ((top + bottom) / (2 * self.hw[0]) - 0.5)
            offsets = [(k + 0.5) / _N_TURN_EXPOSURES - 0.5 for k in range(_N_TURN_EXPOSURES)]
            moments = [middle + _TURN_EXPOSURE_S * offset for offset in offsets]
            poses = self._pose_at(moments)
            parts = [
                self._photograph(i, camera, poses[k : k + 1], (bottom - top, self.hw[1]), exposure=self.gain(i))
                for k in range(_N_TURN_EXPOSURES)
            ]
            bands.append(torch.stack(parts).mean(0))
        return torch.cat(bands, 2)

    def _render(self, i: int) -> Frame:
        return STRESSES[self.stress].spoil(self, i, super()._render(i))

    def _rows(self, i: int) -> Iterator[tuple[Camera, Pose, tuple[int, int]]]:
        """Camera, pose and size of the bands of rows of frame ``i``, from the top."""
        edges = [round(k * self.hw[0] / _N_ROW_BANDS) for k in range(_N_ROW_BANDS + 1)]
        for k, (top, bottom) in enumerate(pairwise(edges)):
            if bottom > top:
                shift = torch.tensor([[0.0, float(top)]])
                pose = self.bands[i][k : k + 1]
                yield self.camera.replace(c=self.camera.c - shift), pose, (bottom - top, self.hw[1])


#: Options of :class:`SyntheticRoom` that determine its path.
_PATH_OPTIONS = ("path", "n_frames", "step_m", "rate_hz", "seed")


def _rolling_shutter_poses(
    path: str = "walk", n_frames: int = 12, step_m: float = 0.02, rate_hz: float = 30.0, seed: int = 2
) -> tuple[list[Pose], Pose]:
    """Poses of the row bands of every frame, and poses of the frames, which are those of their middle bands."""
    per_frame = round(_N_ROW_BANDS / (_READOUT_S * rate_hz))
    n = n_frames * per_frame + _N_ROW_BANDS
    every = hand_held_path(path, n, step_m=step_m / per_frame, rate_hz=rate_hz * per_frame, seed=seed)
    middle = torch.arange(n_frames) * per_frame + _N_ROW_BANDS // 2
    bands = [every[i * per_frame : i * per_frame + _N_ROW_BANDS] for i in range(n_frames)]
    return bands, Pose(every.R[middle], every.t[middle])


def _panning_poses(
    path: str = "lateral", n_frames: int = 12, step_m: float = 0.02, rate_hz: float = 30.0, seed: int = 2
) -> Pose:
    """Poses (n_frames) of a lateral path with the pan :data:`_PAN_DEG`."""
    return hand_held_path(path, n_frames, step_m=step_m, rate_hz=rate_hz, seed=seed, pan=_PAN_DEG)


def open_stress(
    stresses: Sequence[str] | None = None,
    *,
    seed: int = 2,
    n_frames: int = 12,
    hw: tuple[int, int] = (240, 320),
    near: float = 2.0,
    gap: int = 6,
    places: _SamplePattern | None = None,
    n_places: int = 2048,
) -> list[Scene]:
    """The room under each of :data:`STRESSES` (None = all), one scene each; options as :class:`StressRoom`.

    A scene with a moving body has the role ``moving`` and a cutoff of at most that of the body; one with a camera that
    is turned by hand has the role ``rotation``.
    """
    options: dict[str, Any] = {"seed": seed, "n_frames": n_frames, "hw": hw, "near": near, "gap": gap}
    names = STRESSES if stresses is None else stresses
    scenes = []
    for name in names:
        room, (_, _, moving, turn) = StressRoom(name, places=places, n_places=n_places, **options), STRESSES[name]
        near_of = min(near, *(of.near for of in (moving, turn) if of is not None), math.inf)
        role = "rotation" if turn is not None else "moving" if moving is not None else None
        scene = room_to_scene(room, near_of, gap)
        scenes.append(scene if role is None else replace(scene, role=role))
    return scenes


def _keep_one_plane(room: StressRoom, i: int, frame: Frame) -> Frame:
    """The frame without near returns off the plane that most of them lie on, and without those off their surface."""
    assert frame.depth_camera is not None
    scene, pose, hw = room.world(i), room.true_poses[i : i + 1], room.depth_hw
    depth, solid = scene.solids.view(frame.depth_camera, pose, hw)
    o, d = world_rays(frame.depth_camera, pose, hw)
    face, _, _ = scene.solids.locate(solid, [o[k] + d[k] * depth for k in range(3)])
    returns = frame.depth.flatten()
    near = (returns > 0) & (returns <= room.near)
    accurate = near & ((returns / depth - 1).abs() < 0.05) & ~scene.solids.ball[solid]
    plane = torch.bincount(face[accurate], minlength=1).argmax()
    return _remove_returns(frame, near & ~(accurate & (face == plane)))


def _keep_few_returns(room: StressRoom, i: int, frame: Frame) -> Frame:
    """The frame with only :data:`_N_FEW_NEAR` of the near returns that a method would read."""
    returns = frame.depth.flatten()
    near = (returns > 0) & (returns <= room.near)
    usable = near if frame.conf is None else near & (frame.conf.flatten() > 0)
    if room.places is not None:
        uv = room.places(room.hw, room.n_places)[None].to(frame.depth)
        pixel = round_half_up(depth_pixels(frame.camera, room.hw, frame.depth_camera, room.depth_hw, uv))[0].long()
        h, w = room.depth_hw
        pixel = pixel[((pixel >= 0) & (pixel < torch.tensor([w, h]))).all(-1)]
        read = torch.zeros_like(near).index_fill(0, pixel[:, 1] * w + pixel[:, 0], True)
        usable = usable & read
    chosen = usable.nonzero()[:, 0]
    chosen = chosen[torch.randperm(len(chosen), generator=room._generator(i, "few"))[:_N_FEW_NEAR]]
    return _remove_returns(frame, near & ~torch.zeros_like(near).index_fill(0, chosen, True))


def _add_depth_noise(room: StressRoom, i: int, frame: Frame) -> Frame:
    noise = torch.randn(frame.depth.shape, generator=room._generator(i, "noise"))
    return frame.replace(depth=frame.depth * (1 + _DEPTH_NOISE_REL * noise).clamp_min(0.5))


def _displace_tiles(room: StressRoom, i: int, frame: Frame) -> Frame:
    """The frame with displaced tiles of the image, so that tracks end in the wrong place with a good photometric fit.

    The first ``gap`` frames, the reference views, are unchanged.
    """
    if i < room.gap:
        return frame
    g, (H, W) = room._generator(i, "moved"), room.hw
    tile = max(round(_TILE_PX * W / 640), 1)
    v, u = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    rows, columns = -(-H // tile), -(-W // tile)
    square = (v // tile) * columns + u // tile
    moved = torch.randperm(rows * columns, generator=g)[: round(_MOVED_SHARE * rows * columns)]
    low, high = (px * W / 640 for px in _MOVED_RANGE_PX)
    offset = torch.randn(rows * columns, 2, generator=g)
    offset = (
        offset / offset.norm(dim=-1, keepdim=True) * (low + (high - low) * torch.rand(rows * columns, 1, generator=g))
    )
    shift = torch.zeros_like(offset).index_copy(0, moved, offset[moved]).round().long()
    row, column = (v + shift[square, 1]).clamp(0, H - 1), (u + shift[square, 0]).clamp(0, W - 1)
    return frame.replace(image=frame.image[..., row, column])


def _displace_tracks(
    track: Callable[..., Tracks], image_0: Tensor, image_1: Tensor, uv_0: Tensor, **options: Any
) -> Tracks:
    """Tracks of which the fraction :data:`_MOVED_SHARE` is displaced, with their quality measures unchanged.

    The displacements depend on the second image alone, so they are the same for every method.
    """
    tracks = track(image_0, image_1, uv_0, **options)
    low, high = (px * image_1.shape[-1] / 640 for px in _MOVED_RANGE_PX)
    shifts = []
    for image in image_1:
        grey_levels = image if image.dtype == torch.uint8 else (255 * image).round()
        g = torch.Generator().manual_seed(int(grey_levels.long().sum()))
        wrong, length, angle = torch.rand(3, uv_0.shape[1], 1, generator=g)
        direction = torch.cat((torch.cos(2 * torch.pi * angle), torch.sin(2 * torch.pi * angle)), -1)
        shifts.append(torch.where(wrong < _MOVED_SHARE, direction * (low + (high - low) * length), 0.0))
    return tracks.replace(uv_1=tracks.uv_1 + torch.stack(shifts).to(tracks.uv_1))


def _remove_returns(frame: Frame, gone: Tensor) -> Frame:
    """The frame without the returns in the flat mask ``gone``."""
    depth = torch.where(gone.view(frame.depth.shape), torch.zeros_like(frame.depth), frame.depth)
    return frame.replace(depth=depth)


class _MovingBody(NamedTuple):
    """A moving body of a stress."""

    guest: str  # name in guests.MOVING_BODIES
    motion: Callable[[Pose], Pose]  # T_world_from_cam (n) → T_world_from_home (n k), k motions of a frame
    near: float  # m, cutoff at which all or half of the near returns are of the body


class _HandTurn(NamedTuple):
    """A camera turned by hand before a stack of parcels, see :func:`dhtorch.synthetic.paths.turn_by_hand`."""

    degrees: float
    reach_m: float
    readout_s: float = 0.02  # of the rolling shutter, from the first row to the last
    near: float = 1.3  # m, cutoff at which near returns lie on the parcels


class Stress(NamedTuple):
    """A stress: options of the room, a change of its frames, and a moving body."""

    options: dict[str, Any]
    spoil: Callable[[StressRoom, int, Frame], Frame] = lambda room, i, frame: frame
    moving: _MovingBody | None = None
    turn: _HandTurn | None = None


#: Traffic: all that is near moves along the viewer's way, at speeds that rise and fall. Far depths then have a wrong
#: scale, and neither lie within the sensor's reach nor contradict the near tracks.
_ONCOMING = partial(move_in_lanes, shares=(-0.5,), unevenness=0.5)
_UNEVEN = partial(move_in_lanes, shares=(0.3,), unevenness=0.5)
_LANES = partial(move_in_lanes, shares=(0.4, -0.5, 0.4), unevenness=0.2)

#: Options of rooms with a camera that is turned by hand; the exposure already averages over pixels.
_TURNED: dict[str, Any] = {"path": "static", "supersample": 1}

#: The stresses by name.
STRESSES: dict[str, Stress] = {
    "lateral": Stress({"path": "lateral"}),
    "forward": Stress({"path": "forward"}),
    "orbit": Stress({"path": "orbit"}),
    "rotation": Stress({"path": "rotation"}),
    "rotation_exact": Stress({"path": "rotation", "lidar": "exact", "image_noise": 0.0}),
    "rotation_hand_6": Stress(_TURNED, turn=_HandTurn(6.0, 0.02)),
    "rotation_hand_8": Stress(_TURNED, turn=_HandTurn(8.0, 0.03)),
    "rotation_hand_20": Stress(_TURNED, turn=_HandTurn(20.0, 0.03, readout_s=0.0)),
    "rotation_hand_30": Stress(_TURNED, turn=_HandTurn(30.0, 0.03, readout_s=0.0)),
    "planar_near": Stress({"path": "walk"}, _keep_one_plane),
    "few_near": Stress({"path": "walk"}, _keep_few_returns),
    "depth_noise": Stress({"path": "walk"}, _add_depth_noise),
    "rolling_shutter": Stress({"path": "walk"}),
    "moved": Stress({"path": "walk"}, _displace_tiles),
    "mistracks": Stress({"path": "walk"}),
    "convoy": Stress({"path": "walk"}, moving=_MovingBody("parcels", move_with_viewer, 1.3)),
    "convoy_slow": Stress({"path": "walk"}, moving=_MovingBody("parcels", partial(move_with_viewer, share=0.5), 1.3)),
    "convoy_oncoming": Stress({"path": "lateral"}, moving=_MovingBody("parcels", _ONCOMING, 1.3)),
    "convoy_uneven": Stress({"path": "walk"}, moving=_MovingBody("parcels", _UNEVEN, 1.3)),
    "convoy_lanes": Stress({"path": "walk"}, moving=_MovingBody("parcels", _LANES, 1.3)),
    "held_object": Stress({"path": "walk"}, moving=_MovingBody("held", move_in_hand, 2.0)),
    "turntable": Stress({"path": "static"}, moving=_MovingBody("parcels", turn_on_turntable, 1.3)),
    "fast": Stress({"path": "lateral"}),
    "exposure_jump": Stress({"path": "walk"}),
    "motion_blur": Stress({"path": "walk"}),
}
