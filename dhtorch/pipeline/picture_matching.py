"""Pictures of two collections -> which are the same picture, at any size, and which show the same place."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from dhtorch.geometry.filters import grayscale
from dhtorch.stages.sample import regular_grid
from dhtorch.stages.track import lucas_kanade

_Chosen = TypeVar("_Chosen")


def spread_evenly(items: Sequence[_Chosen], most: int) -> list[_Chosen]:
    """At most ``most`` items, evenly spread, the first and the last among them."""
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))]


def is_same_picture(a: Tensor, b: Tensor) -> bool:
    """Whether two pictures (1, C, H, W) of any size are one: tracks between them do not move."""
    a = _small(a)
    b = torch.nn.functional.interpolate(_small(b), a.shape[-2:], mode="area")
    uv = regular_grid((a.shape[-2], a.shape[-1]), 150, margin_px=12.0)[None]
    tracks = lucas_kanade(a, b, uv, levels=3, normalise="gain_bias")
    valid = tracks.valid[0]
    moved = (tracks.uv_1 - tracks.uv_0)[0][valid].norm(dim=-1)
    # Neighbouring frames of a hand-held video at 30 Hz move by more than 1/8 px.
    return int(valid.sum()) >= 10 and bool(moved.median() < 0.125)


def match_pictures(
    pictures: Mapping[int, Callable[[], Tensor]], others: Mapping[int, Callable[[], Tensor]]
) -> list[tuple[int, int, bool]]:
    """(picture, most similar other one, whether both are the same picture); none of too little correlation.

    Args:
        pictures, others: number of each picture -> function that loads it, (1, C, H, W).
    """
    numbers = list(others)
    matches: list[tuple[int, int, bool]] = []
    of_others = torch.stack([_thumbnail(load()) for load in others.values()])
    for k, load in pictures.items():
        picture = load()
        alike = of_others @ _thumbnail(picture)
        order = alike.argsort(descending=True)[:2].tolist()
        best = [numbers[i] for i in order if alike[i] > 0.4]
        same = [i for i in best if is_same_picture(picture, others[i]())]
        matches += [(k, i, bool(same)) for i in (same[:1] or best[:1])]
    return matches


def _small(image: Tensor) -> Tensor:
    """Picture (1, C, H, W) -> grey (1, 1, h, w) with the longer side 320 px or less."""
    factor = min(1.0, 320 / max(image.shape[-2:]))
    hw = [max(32, round(s * factor)) for s in image.shape[-2:]]
    return torch.nn.functional.interpolate(grayscale(image), hw, mode="area")


def _thumbnail(image: Tensor) -> Tensor:
    """Picture (1, C, H, W) -> normalised grey values (768,) of a thumbnail."""
    x = torch.nn.functional.interpolate(grayscale(image), (24, 32), mode="area").flatten().float()
    x = x - x.mean()
    return x / x.norm().clamp_min(1e-6)
