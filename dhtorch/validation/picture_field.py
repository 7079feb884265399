"""Field of view of the pictures of a capture, measured under poses and depth that agree with one another.

Pictures that were cropped or resized alone keep the intrinsics of the whole picture, with which the depth still agrees.
Each near return is looked up through a picture camera that is tried, moved by the stated pose and compared with the end
of its track: the camera with the least loss is that of the pictures.

Alphabet: H cameras that are tried, N near returns of all pairs.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.records import Camera, Frame, Pose, Samples, Tracks
from dhtorch.validation.edges import clear_lead
from dhtorch.validation.faults import MIN_LOSSES, bounded_loss
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS

#: Factors on the focal length that are tried first: pictures cropped to 1 / factor of their field, or seen over more.
#: Source: derived, steps of about a tenth, whose misses are within those of tracks over 40 px.
_ZOOMS: Final = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.33, 1.5, 1.7, 2.0)

#: Another camera is reported if its loss is at most this fraction of that of the stated one.
#: Source: chosen on the sound captures of the shared data (fractions of 0.91 and more, differences up to 0.04) and on
#: pictures cropped to 80 % in the middle and at a corner (at most 0.81, at least 0.15).
_MAX_LOSS_RATIO: Final = 0.86

#: Least difference of the two losses for that. Source: chosen on the same captures and pictures.
_MIN_LOSS_DIFFERENCE: Final = 0.1

#: Least change of the focal length that is reported.
#: Source: chosen on the sound captures of the shared data: up to 0.05 in 7-Scenes, whose K is that of the data sheet.
_MIN_ZOOM_OFFSET: Final = 0.08


class PictureField(NamedTuple):
    """Field of view of pictures: of a camera with ``zoom`` times the focal length, its middle moved by ``shift``."""

    zoom: float
    shift: tuple[float, float]  # of the middle of the pictures, fractions of the stated width and height
    loss: float  # under this camera
    stated_loss: float
    lead: float  # of this camera over the stated one where it is clear in the pairs of frames, else 0

    @property
    def differs(self) -> bool:
        """Whether the pictures are clearly those of another camera than the stated one."""
        return (
            self.loss <= _MAX_LOSS_RATIO * self.stated_loss and self.lead > 0 and abs(self.zoom - 1) >= _MIN_ZOOM_OFFSET
        )

    def camera(self, stated: Camera, hw: tuple[int, int]) -> Camera:
        """The camera (B = 1) of the pictures, of size ``hw``, by the stated one."""
        return _picture_camera(stated, hw, torch.tensor([[self.zoom, *self.shift]]))


class _Returns(NamedTuple):
    """Tracked pixels of one pair of frames and the motion between them."""

    a: Frame
    b: Frame
    uv_0: Tensor  # (1, n, 2) px
    uv_1: Tensor  # (1, n, 2) px
    T_b_from_a: Pose


def measure_picture_field(
    poses: Pose,
    frames: Mapping[int, Frame],
    pairs: Sequence[tuple[int, int]],
    tracks: Sequence[tuple[Samples, Tracks]],
) -> PictureField | None:
    """Stated poses, frames and tracks between them -> the field of view of the pictures; None of too few tracks.

    Args:
        poses: (n) T_world_from_cam of all frames.
        frames: position → frame (B = 1).
        pairs: positions of two frames each.
        tracks: samples of the first picture of each pair and their tracks into the second.

    Gradient: none.
    """
    with torch.no_grad():
        returns = []
        for (i, j), (samples, track) in zip(pairs, tracks, strict=True):
            T = se3.relative(poses[i : i + 1], poses[j : j + 1]).map(lambda x: x.to(samples.uv.dtype))  # noqa: B023
            used = track.valid[0]
            returns.append(_Returns(frames[i], frames[j], samples.uv[:, used], track.uv_1[:, used], T))
        stated = torch.tensor([[1.0, 0.0, 0.0]])
        corners = list(itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=2))  # whose misses are within 40 px
        fields = torch.tensor(
            [
                (zoom, *(p * abs(zoom - 1) / zoom / 2 for p in place))
                for zoom in _ZOOMS
                for place in (corners if zoom > 1 else [(0.0, 0.0)])
            ]
        )
        stated_losses = _pair_losses(returns, stated)
        if len(stated_losses) < 3:  # three parameters fit a few tracks by chance
            return None
        best, losses = _best(returns, fields)
        for k in (1, 2, 3):  # each with half the steps: 0.1 / 2³ is about a hundredth
            steps = torch.tensor(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
            best, losses = _best(returns, best + steps * torch.tensor([0.1, 0.05, 0.05]) / 2**k)
    lead = clear_lead(stated_losses[:, 0] - losses, _MIN_LOSS_DIFFERENCE, errors=2.0)
    zoom, *shift = best.tolist()
    return PictureField(zoom, (shift[0], shift[1]), float(losses.mean()), float(stated_losses.mean()), lead)


def _best(returns: Sequence[_Returns], fields: Tensor) -> tuple[Tensor, Tensor]:
    """The field (3,) of the least mean loss among (H, 3), and its losses (K,) in the pairs."""
    losses = _pair_losses(returns, fields)
    k = int(losses.mean(0).argmin())
    return fields[k], losses[:, k]


def _pair_losses(returns: Sequence[_Returns], fields: Tensor) -> Tensor:
    """Losses (K', H) of near returns at their tracks, by pictures of fields (H, 3), in the pairs with enough tracks."""
    losses = [_pair_loss(each, fields) for each in returns]
    kept = [loss for loss in losses if bool(loss.isfinite().all())]
    return torch.stack(kept) if kept else fields.new_zeros(0, len(fields))


def _pair_loss(pair: _Returns, fields: Tensor) -> Tensor:
    """Mean loss (H,) of one pair; 1 for returns that a camera does not see; NaN of too few tracks or motions."""
    n = pair.uv_0.shape[1]
    has_pose = bool(pair.T_b_from_a.t.isfinite().all() and pair.T_b_from_a.R.isfinite().all())
    # The error of tracks, a fifth of a pixel, is to be below two pixels of 640: 64 px wide, and half as much again.
    # Twenty tracks for each of the three parameters.
    if pair.a.hw[1] < 96 or n < 60 or not has_pose:
        return fields.new_full((len(fields),), torch.nan)
    camera = _picture_camera(pair.a.camera, pair.a.hw, fields)
    rays = cam.rays(camera, pair.uv_0.expand(len(fields), -1, -1))
    depth, inside = sample_nearest(pair.a.depth, cam.project(pair.a.map_camera, rays.reshape(1, -1, 3)))
    depth, inside = depth.view(len(fields), n), inside.view(len(fields), n)
    moved = se3.apply(pair.T_b_from_a.map(lambda x: x.expand(len(fields), *x.shape[1:])), rays * depth[..., None])
    seen = inside & (depth > 0) & (moved[..., 2] > 1e-6)
    uv = cam.project(camera, torch.where(seen[..., None], moved, moved.new_tensor([0.0, 0.0, 1.0])))
    miss = (uv - pair.uv_1).norm(dim=-1) * (640 / pair.a.hw[1])
    loss = torch.where(seen, bounded_loss(miss, DEFAULT_VALIDATION_OPTIONS.half_loss_px), 0.0).sum(-1)
    n_seen = seen.sum(-1)
    return torch.where(n_seen >= MIN_LOSSES, loss / n_seen.clamp_min(1), 1.0)


def _picture_camera(camera: Camera, hw: tuple[int, int], fields: Tensor) -> Camera:
    """Cameras (H) of pictures of ``fields`` (H, 3): factor on f, and the move of their middle in the stated field."""
    size = camera.f.new_tensor([hw[1], hw[0]])
    zoom, shift = fields[:, :1].to(camera.f), fields[:, 1:].to(camera.f)
    middle = (size - 1) / 2
    # A point at x in the stated picture is at middle + zoom (x − middle − shift) in a picture of that field.
    return camera.map(lambda x: x.expand(len(fields), *x.shape[1:])).replace(
        f=camera.f * zoom, c=middle + zoom * (camera.c - middle - shift * size)
    )
