"""A textured card that stands before a camera nearer than a depth sensor measures, added to frames of any recording.

It hides what is behind it in the pictures; a sensor has no return from it, or a false one far behind it.
"""

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.records import Frame, Pose

#: Distance of the card from the camera, m: below the minimum range of phone LiDARs, time-of-flight and structured-light
#: cameras. Source: chosen, the middle of 0.1 to 0.3 m.
CARD_DISTANCE_M = 0.22

#: Side of the card, m, and its centre right of and below the optical axis, m. Source: chosen, a fifteenth of the
#: picture of a phone, away from its centre.
_CARD_SIDE_M, _CARD_CENTRE_M = 0.06, (0.02, 0.015)

#: Slope of the card's distance to the right. Source: chosen, a card that is not parallel to the picture.
_CARD_SLOPE = 0.2

#: Cells along a side of the card's random texture, coarse and fine. Source: chosen, 10 and 3 px of a picture 320 wide.
_TEXTURE_CELLS = (8, 24)


def add_near_card(frame: Frame, T_world_from_card_view: Pose, seed: int) -> tuple[Frame, Tensor]:
    """Frame with a pose, and the pose of the camera before which the card stands -> frame with the card in its picture
    and no returns there, and the card's depth (B, H, W) m at the picture's pixels, 0 beside it.

    Gradient: none.
    """
    if frame.T_world_from_cam is None:
        raise ValueError("add_near_card: the frame has no pose, expected T_world_from_cam")
    T_card_from_cam = se3.relative(
        *(T.map(lambda x: x.double()) for T in (frame.T_world_from_cam, T_world_from_card_view))
    )
    depth, across = _card_in_view(frame.camera, frame.hw, T_card_from_cam)
    # Random texture (1, 1, n, n) in [0, 1] with cells of two sizes.
    generator = Generator().manual_seed(seed)
    size = 8 * _TEXTURE_CELLS[1]
    layers = [
        F.interpolate(torch.rand(1, 1, n, n, generator=generator), (size, size), mode="bilinear")
        for n in _TEXTURE_CELLS
    ]
    texture = (0.5 * (layers[0] + layers[1])).to(across)
    colour = F.grid_sample(texture.expand(len(across), -1, -1, -1), across, mode="bilinear", align_corners=False)
    scale = 255.0 if frame.image.dtype == torch.uint8 else 1.0
    colour = (colour * scale).to(frame.image.dtype).expand(-1, frame.image.shape[1], -1, -1)
    image = torch.where(depth[:, None] > 0, colour, frame.image)
    depth_hw = frame.depth.shape[-2], frame.depth.shape[-1]
    on_card = _card_in_view(frame.map_camera, depth_hw, T_card_from_cam)[0] > 0
    return frame.replace(image=image, depth=frame.depth.masked_fill(on_card, 0.0)), depth


def _card_in_view(camera: cam.Camera, hw: tuple[int, int], T_card_from_cam: Pose) -> tuple[Tensor, Tensor]:
    """Depth (B, h, w) of the card in a view, 0 beside it, and place on it (B, h, w, 2), -1 to 1."""
    T = T_card_from_cam.map(lambda x: x.to(camera.f))
    ray = se3.rotate(T.R, plane_sweep.pixel_rays(camera, hw).contiguous())
    normal = torch.tensor([-_CARD_SLOPE, 0.0, 1.0]).to(ray)
    centre = torch.tensor([*_CARD_CENTRE_M, CARD_DISTANCE_M]).to(ray)
    z = ((centre - T.t[:, None]) @ normal) / (ray @ normal)
    point = T.t[:, None] + z[..., None] * ray
    across = (point - centre)[..., :2] / (0.5 * _CARD_SIDE_M)
    on_card = (z > 0) & (across.abs().amax(-1) < 1)
    return torch.where(on_card, z, 0.0).unflatten(-1, hw), across.unflatten(1, hw)


def card_over_map(depth_map: Tensor, card_depth: Tensor) -> Tensor:
    """Map (B, h, w) m over a picture, and the card's depth (B, H, W) at the picture's pixels -> map with the card."""
    h, w = depth_map.shape[-2:]
    v, u = torch.meshgrid(*(torch.arange(n).to(depth_map) for n in (h, w)), indexing="ij")
    uv = torch.stack([u, v], -1).reshape(1, -1, 2).expand(len(depth_map), -1, -1)
    place = cam.resize_pixels(uv, (h, w), (card_depth.shape[-2], card_depth.shape[-1]))
    card = sample_nearest(card_depth.to(depth_map), place)[0].unflatten(1, (h, w))
    return torch.where(card > 0, card, depth_map)
