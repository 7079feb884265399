"""What frames that are asked together must share: a device, a precision, and that there is something to see."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.records import Camera, Frame

#: What a method reads of its reference view and of the other views: times and poses of the data set are not for it.
REFERENCE_FIELDS = "image", "depth", "conf", "sparse", "camera", "depth_camera"
SOURCE_FIELDS = "image", "camera"


def validate_views(reference: Frame, others: Frame | Sequence[Frame]) -> tuple[Frame, Frame]:
    """The reference view and its other views, stacked to V × B where there are several, in one precision.

    Frames of several data sets come in several precisions: cameras become the widest of them, and pictures that differ
    become floating in the widest of theirs (uint8 counts as float32). Equal ones stay as they are, byte for byte.

    Raises:
        TypeError: something that is no frame.
        ValueError: no other view, a frame without a view or a pixel, or tensors on different devices.

    Gradient: to pictures and intrinsics, through the change of precision.
    """
    single = isinstance(others, Frame)
    given = [others] if isinstance(others, Frame) else list(others or ())
    if not given:
        raise ValueError("method: found no other view, expected at least one")
    frames = [reference, *given]
    names = ["reference", *("other" if single else f"others[{k}]" for k in range(len(given)))]
    for name, frame in zip(names, frames, strict=True):
        if not isinstance(frame, Frame):
            raise TypeError(f"method: {name} is a {type(frame).__name__}, expected a dhtorch.Frame")
        _check(name, frame, SOURCE_FIELDS if name != "reference" else REFERENCE_FIELDS, reference.image.device)
    reference, *given = _one_precision(frames)
    return reference, given[0] if single else pytree.stack(given)


def _check(name: str, frame: Frame, fields: tuple[str, ...], device: torch.device) -> None:
    for field, x in _tensors(frame, fields):
        if 0 in x.shape:
            lacks = "pixel" if 0 in x.shape[-2:] else "view"
            raise ValueError(f"method: {name}.{field} has shape {tuple(x.shape)}, expected at least one {lacks}")
        if x.device != device:
            raise ValueError(
                f"method: {name}.{field} is on {x.device}, reference.image on {device}, expected one device"
            )


def _tensors(frame: Frame, fields: tuple[str, ...]) -> Iterator[tuple[str, Tensor]]:
    for field in fields:
        value = getattr(frame, field)
        if isinstance(value, Tensor):
            yield field, value
        elif isinstance(value, Camera):
            yield f"{field}.f", value.f


def _one_precision(frames: list[Frame]) -> list[Frame]:
    pictures, cameras = {f.image.dtype for f in frames}, {f.camera.f.dtype for f in frames}
    if len(cameras) > 1:
        wide = _widest(cameras)
        frames = [f.replace(camera=f.camera.to(wide)) for f in frames]
    if len(pictures) > 1:
        wide = _widest(pictures)
        frames = [f.replace(image=_floating(f.image, wide)) for f in frames]
    return frames


def _widest(dtypes: set[torch.dtype]) -> torch.dtype:
    """The floating type that holds all of them."""
    wide = torch.float32 if torch.uint8 in dtypes else torch.float16
    for dtype in dtypes - {torch.uint8}:
        wide = torch.promote_types(wide, dtype)
    return wide


def _floating(image: Tensor, dtype: torch.dtype) -> Tensor:
    return image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)
