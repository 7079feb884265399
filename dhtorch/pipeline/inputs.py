"""Validation of the views of a method: dtypes, channels, range of values, one device and precision, no empty frames."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dhtorch import pytree
from dhtorch.geometry.checks import is_static
from dhtorch.records import Camera, Frame

#: Fields that a method reads of its reference view; timestamps and poses of a data set are not among them.
REFERENCE_FIELDS = "image", "depth", "conf", "sparse", "camera", "depth_camera"

#: Fields that a method reads of its other views.
SOURCE_FIELDS = "image", "camera"

#: What messages expect of depth, and of an image's dtype and values, here and in transforms.
EXPECTED_METRES = "expected floating point, m"
EXPECTED_IMAGE = "expected uint8, or floating point in [0, 1]"
EXPECTED_RANGE = "expected [0, 1] (of [0, 255]: image / 255)"


def validate_views(reference: Frame, others: Frame | Sequence[Frame]) -> tuple[Frame, Frame]:
    """The reference view and its other views, stacked to V × B where there are several, in one precision.

    Frames of different data sets have different precisions: cameras get the widest dtype among them, and images of
    different dtypes become floating in the widest of these (uint8 counts as float32). Equal dtypes are unchanged.

    Raises:
        TypeError: an argument that is not a Frame.
        ValueError: no other view, a frame without a view or a pixel, tensors on different devices, images other than
            uint8 or floating in [0, 1] of 1 or 3 channels, depth of integers.

    Gradient: to images and intrinsics, through the change of precision.
    """
    is_single = isinstance(others, Frame)
    views = [others] if isinstance(others, Frame) else list(others or ())
    if not views:
        raise ValueError("method: found no other view, expected at least one")
    frames = [reference, *views]
    names = ["reference", *("other" if is_single else f"others[{k}]" for k in range(len(views)))]
    for name, frame in zip(names, frames, strict=True):
        if not isinstance(frame, Frame):
            raise TypeError(f"method: {name} is a {type(frame).__name__}, expected a dhtorch.Frame")
        _check_frame(name, frame, SOURCE_FIELDS if name != "reference" else REFERENCE_FIELDS, reference.image.device)
    image_dtypes, camera_dtypes = {f.image.dtype for f in frames}, {f.camera.f.dtype for f in frames}
    if len(camera_dtypes) > 1:
        dtype = _widest_dtype(camera_dtypes)
        frames = [f.replace(camera=f.camera.to(dtype)) for f in frames]
    if len(image_dtypes) > 1:
        dtype = _widest_dtype(image_dtypes)
        frames = [
            f.replace(image=f.image.to(dtype) / 255 if f.image.dtype == torch.uint8 else f.image.to(dtype))
            for f in frames
        ]
    reference, *views = frames
    return reference, views[0] if is_single else pytree.stack(views)


def _check_frame(name: str, frame: Frame, fields: tuple[str, ...], device: torch.device) -> None:
    """Raise ValueError for an empty tensor of the frame, one on another device, an image of another dtype, number of
    channels or range (this only where it is read without waiting for a device), and depth of integers."""
    for field in fields:
        value = getattr(frame, field)
        place, x = (f"{field}.f", value.f) if isinstance(value, Camera) else (field, value)
        if not isinstance(x, Tensor):
            continue
        if 0 in x.shape:
            missing = "pixel" if 0 in x.shape[-2:] else "view"
            raise ValueError(f"method: {name}.{place} has shape {tuple(x.shape)}, expected at least one {missing}")
        if x.device != device:
            raise ValueError(
                f"method: {name}.{place} is on {x.device}, reference.image on {device}, expected one device"
            )
    image = frame.image
    if image.dtype != torch.uint8 and not image.is_floating_point():
        raise ValueError(f"method: {name}.image is {dtype_name(image)}, {EXPECTED_IMAGE}")
    if image.ndim == 4 and image.shape[1] not in (1, 3):
        shape = tuple(image.shape)
        raise ValueError(
            f"method: {name}.image has shape {shape}, expected (B C H W) with C 1 or 3 (RGBA: image[:, :3])"
        )
    if image.is_floating_point() and not is_static(image):
        # 1 of 64 pixels: a check that costs nothing beside a stage.
        largest = float(image.detach()[..., ::8, ::8].amax())
        # Twice the range leaves room for brightness that an augmentation added; images in [0, 255] exceed it.
        if largest > 2.0:
            raise ValueError(f"method: {name}.image has values up to {largest:g}, {EXPECTED_RANGE}")
    if "depth" in fields and not frame.depth.is_floating_point():
        raise ValueError(
            f"method: {name}.depth is {dtype_name(frame.depth)}, {EXPECTED_METRES} (of mm: depth.float() / 1000)"
        )


def dtype_name(x: Tensor) -> str:
    """Name of a tensor's dtype as numpy has it, such as ``uint16``."""
    return str(x.dtype).removeprefix("torch.")


def _widest_dtype(dtypes: set[torch.dtype]) -> torch.dtype:
    """The floating dtype that represents all of them."""
    widest = torch.float32 if torch.uint8 in dtypes else torch.float16
    for dtype in dtypes - {torch.uint8}:
        widest = torch.promote_types(widest, dtype)
    return widest
