"""What the public entries of dhtorch give on one small problem, whose tensors may be views with any strides."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

import dhtorch
from dhtorch import functional
from dhtorch.geometry.camera import to_matrix
from dhtorch.synthetic import SyntheticRoom


def channels_last(x: Tensor) -> Tensor:
    """Images with their channels together in memory, maps and matrices with their columns."""
    if x.dim() < 2:
        return x
    is_image = x.dim() > 2 and x.shape[-3] == 3
    return x.movedim(-3, -1).contiguous().movedim(-1, -3) if is_image else x.mT.contiguous().mT


#: Layout of a tensor in memory -> the same values in it, as a view.
VIEWS: dict[str, Callable[[Tensor], Tensor]] = {
    "every second column": lambda x: x.repeat_interleave(2, -1)[..., ::2],
    "channels last": channels_last,
}


def reversed_array(x: Tensor) -> np.ndarray:
    """The values as an array with negative strides."""
    return np.ascontiguousarray(x.numpy()[..., ::-1])[..., ::-1]


@cache
def frames() -> list[dhtorch.Frame]:
    """Three contiguous views of the room."""
    room = SyntheticRoom(n_frames=3, hw=(90, 120), depth_hw=(45, 60))
    return [room[k].map(Tensor.contiguous) for k in range(3)]


def public_results(layout: str | None = None) -> dict[str, list[Tensor]]:
    """Name of an entry -> the tensors of its result, of frames and samples with a layout of ``VIEWS``; None =
    contiguous."""
    view = Tensor.contiguous if layout is None else VIEWS[layout]
    a, b, c = (frame.map(view) for frame in frames())
    first, _, third = frames()
    few: dict[str, Any] = {"n": 64, "seed": 0}
    K = to_matrix(first.camera)[0]
    sample = {"image": first.image[0], "depth": first.depth[0], "K": K, "other": third.image[0]}
    sample = {key: view(x) for key, x in sample.items()}
    arrays = {key: reversed_array(x) for key, x in sample.items()}
    keys: dict[str, Any] = {"image": "image", "depth": "depth", "intrinsics": "K", "depth_unit": "m", "n": 64}
    extend, alone = dhtorch.ExtendDepth(**keys, other_image="other"), dhtorch.ExtendDepth(**keys, at=0, other_at=0)
    validate = dhtorch.ValidateDepth(**keys, other_image="other", judging={"views": False}, method="paper")
    stream = dhtorch.Stream(dhtorch.MAP.replace(n=64), steps=(1,))
    estimate = dhtorch.PAPER(first, third, **few)
    maps = dhtorch.complete_depth(a, [c], method=dhtorch.FUSED.replace(n=64), size=48)

    def added(extended: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in extended.items() if key not in sample}

    results = {
        "PAPER": dhtorch.PAPER(a, c, **few, hint=dhtorch.TrackHint(between=[b.image])),
        "MAP": dhtorch.MAP(a, [c], **few),
        "AUTO": dhtorch.AUTO(a, (c,), **few),
        "complete_depth": maps,
        "validate_depth": dhtorch.validate_depth(view(first.depth), a, c, size=32),
        "align_depth": dhtorch.align_depth(view(first.depth * 3), estimate.map(view), hw=a.hw, kind="scale"),
        "CameraPin": dhtorch.CameraPin(a).check(b.image, view(K)),
        "Stream": [stream.push(frame) for frame in (a, b)],
        "ExtendDepth": [added(t(x)) for t in (extend, alone) for x in (sample, arrays)],
        "ValidateDepth": [added(validate(x)) for x in (sample, arrays)],
        "geometry_image": functional.geometry_image(*(view(x) for x in (maps.depth, maps.sigma, maps.source))),
    }
    return {name: [x for x in pytree.tree_leaves(result) if isinstance(x, Tensor)] for name, result in results.items()}


def differing_entries(found: dict[str, list[Tensor]], expected: dict[str, list[Tensor]]) -> list[str]:
    """Names of the entries whose tensors have another number, dtype, device or bit."""

    def is_same(x: Tensor, y: Tensor) -> bool:
        same_kind = (x.dtype, x.device) == (y.dtype, y.device)
        return same_kind and torch.allclose(x, y, rtol=0, atol=0, equal_nan=True)

    return [
        name
        for name, tensors in expected.items()
        if len(tensors) != len(found[name]) or not all(map(is_same, found[name], tensors))
    ]
