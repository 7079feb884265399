"""A camera fixed before a robot in the built-in room: other lights, exposures and noise, and arms that hide the room.

Alphabet: an *arm* is a chain of straight links of one width over the picture, from the picture's border inwards; its
texture moves with it. It has a depth of its own in the sensor's map.
"""

import math
from functools import lru_cache
from random import Random
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from dhtorch.records import Frame
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.room import furnished_room
from dhtorch.synthetic.shading import ShadedRoom

#: Lights of the room by name: factors on window, lamp and ceiling light, and the ambient light.
#: Source: chosen, lamps off and on by day and in the evening; "day" is the room's own.
ROOM_LIGHTS: dict[str, tuple[tuple[float, float, float], float]] = {
    "day": ((1.0, 1.0, 1.0), 0.42),
    "morning": ((1.9, 0.0, 0.0), 0.38),
    "evening": ((0.1, 1.7, 0.9), 0.26),
}

#: Distance of an arm from the camera, m. Source: chosen, arms on a table before their camera.
_ARM_DISTANCE_M = 0.6

#: Links of an arm, and the width of a link as a fraction of the picture's height. Source: chosen.
_ARM_LINKS, _ARM_WIDTH = 3, 0.22

#: Most arms that are drawn to hide a share of the picture. Source: chosen; six hide all of it.
_MAX_ARMS = 8

#: Exposures as a factor, exponents of the response, and noise in grey levels of 255 of a picture taken again: their
#: limits. Source: chosen, a camera with automatic exposure, by day and at night.
_EXPOSURES, _EXPONENTS, _NOISE_LEVELS = (0.6, 1.5), (0.85, 1.2), (0.5, 3.0)


@lru_cache(maxsize=3)
def _lit_room(seed: int, light: str) -> ShadedRoom:
    """The furnished room of a seed under one of :data:`ROOM_LIGHTS`; cached for the last three."""
    room = furnished_room(seed)
    return room if light == "day" else room.relit(*ROOM_LIGHTS[light])


class LitRoom(SyntheticRoom):
    """The built-in room under another light; options as its.

    Raises:
        ValueError: an unknown light.
    """

    def __init__(self, *, light: str = "day", **options: Any) -> None:
        if light not in ROOM_LIGHTS:
            raise ValueError(f"lit room: light is {light!r}, expected one of {', '.join(ROOM_LIGHTS)}")
        super().__init__(**options)
        self.light = light

    def world(self, index: int) -> ShadedRoom:
        """The room under its light."""
        return _lit_room(self.seed, self.light)


def photograph_again(frame: Frame, draw: Random) -> Frame:
    """The frame with another exposure, response and noise in its picture."""
    exposure, exponent, noise = (draw.uniform(*limits) for limits in (_EXPOSURES, _EXPONENTS, _NOISE_LEVELS))
    generator = Generator().manual_seed(draw.getrandbits(62))
    image = (frame.image.float() / 255).pow(exponent) * exposure * 255
    image = image + noise * torch.randn(image.shape, generator=generator)
    return frame.replace(image=(image + 0.5).floor().clamp(0, 255).to(torch.uint8))


def hide_behind_arms(frame: Frame, share: float, *, arm_seed: int, draw: Random) -> tuple[Frame, Tensor]:
    """Frame -> the frame with arms over at least ``share`` of its picture, and where they are (H, W) bool.

    Arms of one ``arm_seed`` have the same texture and begin at the same places; ``draw`` bends them.
    """
    H, W = frame.hw
    image = frame.image.float()
    hidden = torch.zeros(H, W, dtype=torch.bool)
    base = Random(f"arms {arm_seed}")
    for k in range(_MAX_ARMS):
        if float(hidden.float().mean()) >= share:
            break
        start = (
            (base.uniform(0, W), H * 1.02) if k % 2 == 0 else (W * (-0.02 if k % 4 == 1 else 1.02), base.uniform(0, H))
        )
        image, mask = _draw_arm(image, start, _arm_texture(1000 * arm_seed + k), draw)
        hidden |= mask
    size = (frame.depth.shape[-2], frame.depth.shape[-1])
    behind = F.interpolate(hidden[None, None].float(), size, mode="nearest")[:, 0] > 0
    depth = torch.where(behind, _ARM_DISTANCE_M, frame.depth)
    conf = None if frame.conf is None else torch.where(behind, 2, frame.conf).to(frame.conf.dtype)
    return frame.replace(image=image.round().to(frame.image.dtype), depth=depth, conf=conf), hidden


def _draw_arm(image: Tensor, start: tuple[float, float], texture: Tensor, draw: Random) -> tuple[Tensor, Tensor]:
    """The picture (1, C, H, W) with one arm over it, and the arm's mask (H, W)."""
    H, W = image.shape[-2:]
    v, u = torch.meshgrid(torch.arange(H, dtype=torch.float32), torch.arange(W, dtype=torch.float32), indexing="ij")
    covered = torch.zeros(H, W, dtype=torch.bool)
    width, (x, y) = _ARM_WIDTH * H * draw.uniform(0.7, 1.1), start
    heading = math.atan2(H / 2 - y, W / 2 - x)
    for link in range(_ARM_LINKS):
        heading += draw.uniform(-0.8, 0.8)
        length = H * draw.uniform(0.25, 0.5)
        ux, uy = math.cos(heading), math.sin(heading)
        along, across = (u - x) * ux + (v - y) * uy, -(u - x) * uy + (v - y) * ux
        outside = torch.maximum(torch.maximum(-along, along - length), torch.zeros(()))
        mask = (outside.square() + across.square()) < (width / 2) ** 2
        grid = torch.stack((2 * along / length - 1, 2 * across / width), -1)[None] * 0.95
        colour = F.grid_sample(texture[link : link + 1], grid, padding_mode="reflection", align_corners=False)
        image = torch.where(mask, 255 * colour, image)
        covered |= mask
        x, y = x + length * ux, y + length * uy
    return image, covered


@lru_cache(maxsize=16)
def _arm_texture(seed: int) -> Tensor:
    """Random pictures (links, 1, 96, 96) in [0, 1] with cells of two sizes: bolts, cables and printed parts."""
    generator = Generator().manual_seed(seed)
    coarse, fine = (torch.rand(_ARM_LINKS, 1, n, n, generator=generator) for n in (6, 24))
    coarse, fine = (F.interpolate(x, (96, 96), mode="bilinear") for x in (coarse, fine))
    return 0.15 + 0.35 * (coarse + fine)
