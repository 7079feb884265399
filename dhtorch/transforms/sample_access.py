"""Keys of a sample dict -> tensors with a fixed number of dimensions, whatever the layout of the sample.

Alphabet: B samples, T frames of a sample along time, C × H × W image, h × w depth map.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dhtorch.geometry.checks import all_known, is_transformed
from dhtorch.geometry.least_squares import has_graph
from dhtorch.pipeline.inputs import EXPECTED_IMAGE, dtype_name
from dhtorch.records import Camera

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera
    from kornia.sensors.camera import CameraModelBase

#: Source of numbers: a key of the sample, or the numbers themselves, the same for every sample.
KeyOrNumbers = str | Sequence[float]

#: Source of intrinsics: as above, or a camera of kornia under the key or the same for every sample.
KeyOrCamera: TypeAlias = "KeyOrNumbers | PinholeCamera | CameraModelBase"


#: Unsigned dtypes for which torch has few operations -> the signed dtype they are converted to.
_SIGNED_DTYPES = {torch.uint16: torch.int32, torch.uint32: torch.int64}


class SampleError(ValueError):
    """A sample does not match its specification; the message names the key, what was found and what was expected."""


def get_value(sample: Mapping[str, Any], key: str) -> Any:
    """Sample and key -> value; a dotted key is also looked up part by part in nested dicts.

    Raises:
        SampleError: the key is missing.
    """
    if key in sample:
        return sample[key]
    value: Any = sample
    for piece in key.replace("/", ".").split("."):
        if not (isinstance(value, Mapping) and piece in value):
            raise SampleError(f"{key}: found no such key, expected one of {', '.join(_list_keys(sample))}")
        value = value[piece]
    return value


def has_key(sample: Mapping[str, Any], key: str) -> bool:
    """Whether a sample has a key, by the lookup of :func:`get_value`."""
    try:
        get_value(sample, key)
    except SampleError:
        return False
    return True


def drop_keys(sample: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Copy of a sample without some keys, which :func:`get_value` would find; changed nested dicts are copied too."""
    out = dict(sample)
    for key in keys:
        head, _, rest = key.replace("/", ".").partition(".")
        if key in out:
            del out[key]
        elif rest and isinstance(out.get(head), Mapping):
            out[head] = drop_keys(out[head], [rest])
    return out


def replace_values(sample: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Copy of a sample with other values under keys that :func:`get_value` finds; changed nested dicts are copied."""
    out = dict(sample)
    for key, value in values.items():
        head, _, rest = key.replace("/", ".").partition(".")
        if key not in out and rest and isinstance(out.get(head), Mapping):
            out[head] = replace_values(out[head], {rest: value})
        else:
            out[key] = value
    return out


def is_kornia_camera(value: Any) -> bool:
    """Whether a value is an object of kornia, as cameras in samples are."""
    return type(value).__module__.partition(".")[0] == "kornia"


def to_tensor(value: Any, key: str, *, signed: bool = True) -> Tensor:
    """Array, image, numbers or tensor of any class -> plain tensor; ``signed`` converts uint16 and uint32 to signed.

    Raises:
        SampleError: the value holds no numbers.
    """
    if isinstance(value, Tensor):
        x = value.as_subclass(Tensor)
        return x.to(_SIGNED_DTYPES[x.dtype]) if signed and x.dtype in _SIGNED_DTYPES else x
    array = np.asarray(value)
    if array.dtype.kind not in "buif":
        raise SampleError(f"{key}: found {type(value).__name__} of {array.dtype}, expected an array of numbers")
    if signed and array.dtype.kind == "u" and array.dtype.itemsize in (2, 4):
        array = array.astype(np.int32 if array.dtype.itemsize == 2 else np.int64)
    array = array.astype(array.dtype.newbyteorder("="), copy=not array.flags.writeable)
    return torch.from_numpy(np.ascontiguousarray(array))


#: Keys of integers: one in a sample, one per sample in a collated batch.
_INDEX_KEYS = ("episode_index", "index", "frame_index")


def check_sample(sample: Any, image: str, intrinsics: KeyOrCamera, batched: bool | None) -> None:
    """Reject what is no sample; if ``batched`` is None also a batch, whose samples would be read as frames along time.

    Raises:
        SampleError: it is no dict, or a field has one value per image; the message names the remedy.
    """
    if not isinstance(sample, Mapping):
        size = f" of shape {tuple(sample.shape)}" if hasattr(sample, "shape") else ""
        raise SampleError(
            f"sample: found {type(sample).__name__}{size}, expected a dict with pictures and depth; image_transforms "
            "passes single images only: wrap the data set instead, ExtendedDataset(dataset, transform), or kornia's "
            "container, dhtorch.transforms.kornia.AugmentSample(container)"
        )
    if batched is not None:
        return
    try:
        images = get_value(sample, image)
    except SampleError:
        return  # reported when the key is read
    n = len(images) if getattr(images, "ndim", 0) == 4 else 1
    flag = f"{image}_is_pad"
    if has_key(sample, flag) and tuple(getattr(get_value(sample, flag), "shape", ())) == (n,):
        return  # LeRobot's delta_timestamps: time
    candidates: tuple[Any, ...] = () if n < 2 else (intrinsics, *_INDEX_KEYS, *sample)
    for key in candidates:
        value = sample.get(key) if isinstance(key, str) else None
        shape = tuple(getattr(getattr(value, "intrinsics", value), "shape", ()))
        is_texts = isinstance(value, list | tuple) and len(value) == n and all(isinstance(text, str) for text in value)
        is_index = shape == (n,) and key in _INDEX_KEYS
        if is_texts or is_index or (key == intrinsics and shape in ((n, 3, 3), (n, 4, 4))):
            actual = f"{n} texts" if is_texts else f"shape {shape}"
            raise SampleError(
                f"{key}: found {actual} beside {n} pictures, expected one sample; batched=True reads {n} samples, "
                f"batched=False one sample of {n} frames"
            )


class SampleReader:
    """Reads the tensors of a sample or a batch, all with B in front."""

    def __init__(self, sample: Mapping[str, Any], batched: bool, dtype: torch.dtype) -> None:
        self.sample, self.batched, self.dtype = sample, batched, dtype
        self.like: Tensor | None = None  # first tensor read (reference images): sets device and batch size

    def get(self, key: str, *, signed: bool = True) -> Tensor:
        """Key -> tensor (B, …) on the device of the first tensor read."""
        x = to_tensor(get_value(self.sample, key), key, signed=signed)
        x = x if self.batched else x[None]
        if self.like is None:
            self.like = x
        if x.ndim == 0 or x.shape[0] != self.like.shape[0]:
            raise SampleError(f"{key}: found shape {tuple(x.shape)}, expected {self.like.shape[0]} samples in front")
        return x.to(self.like.device)

    def images(self, key: str, layout: str | None) -> Tensor:
        """Key of images -> (B, T, C, H, W), uint8 or floating."""
        x = self.get(key, signed=False)
        if x.ndim not in (4, 5):
            shape = tuple(x.shape[1:])
            raise SampleError(f"{key}: found shape {shape}, expected (C, H, W) or (H, W, C), or with T in front")
        if x.dtype != torch.uint8 and not x.is_floating_point():
            raise SampleError(f"{key}: found {dtype_name(x)}, {EXPECTED_IMAGE}")
        x = x if x.ndim == 5 else x[:, None]
        first, last = x.shape[2] in (1, 3), x.shape[4] in (1, 3)
        if layout is None and first == last:
            shape = tuple(x.shape[2:])
            raise SampleError(
                f"{key}: found shape {shape}, expected one axis of 1 or 3 channels (RGBA: the first 3); or state layout"
            )
        hwc = last if layout is None else layout == "hwc"
        if not (last if hwc else first):
            raise SampleError(f"{key}: found shape {tuple(x.shape[2:])}, expected layout {layout} with 1 or 3 channels")
        x = x.permute(0, 1, 4, 2, 3) if hwc else x
        return x if x.dtype == torch.uint8 else x.to(self.dtype)

    def planes(self, key: str, T: int, *, signed: bool = True) -> Tensor:
        """Key of depth or confidence maps -> (B, T or 1, h, w); floats as ``dtype``, integers unchanged."""
        x = self.get(key, signed=signed)
        shape = tuple(x.shape[1:])
        if x.ndim == 3:
            x = x[:, None]
        elif x.ndim == 4 and x.shape[1] not in (1, T) and x.shape[3] == 1:
            x = x[:, None, ..., 0]
        elif x.ndim == 5:
            x = x[:, :, 0] if x.shape[2] == 1 else x[..., 0] if x.shape[4] == 1 else x
        if x.ndim != 4 or x.shape[1] not in (1, T) or 0 in x.shape:
            expected = f"(h, w), (1, h, w) or (h, w, 1), with or without {T} in front"
            raise SampleError(f"{key}: found shape {shape}, expected {expected}")
        return x.to(self.dtype) if x.is_floating_point() else x

    def numbers(self, numbers: KeyOrNumbers | None, T: int, at: int) -> Tensor | None:
        """Numbers for all samples, per sample, or per sample and frame -> (B, k)."""
        if numbers is None or self.like is None:
            return None
        name = numbers if isinstance(numbers, str) else "numbers"
        if isinstance(numbers, str):
            x = self.get(numbers)
        else:
            x = torch.as_tensor(numbers, device=self.like.device)[None].expand(self.like.shape[0], *np.shape(numbers))
        return self._row(x, name, T, at).to(self.dtype)

    def _row(self, x: Tensor, name: str, T: int, at: int) -> Tensor:
        """Numbers (B, k), (B, 1, k), (B, T, k), or 3x3 or 4x4 for k -> those of a frame (B, k)."""
        x = intrinsic_rows(x, T)
        if x.ndim == 3 and x.shape[1] in (1, T):
            x = x[:, at if x.shape[1] > 1 else 0]
        if x.ndim != 2:
            raise SampleError(
                f"{name}: found shape {tuple(x.shape[1:])}, expected one row of numbers, or one per frame"
            )
        return x

    def fingerprint(self, numbers: KeyOrCamera) -> Hashable | None:
        """Numbers -> cache key of the tensors read from them; None if they cannot be cached.

        These are numbers with a graph, on another device or of a type unknown to numpy, and all in inference mode,
        whose tensors cannot be used outside it.
        """
        value = get_value(self.sample, numbers) if isinstance(numbers, str) else np.asarray(numbers)
        if isinstance(value, Tensor) and value.dtype in (torch.float32, torch.float64) and not is_transformed():
            value = value.numpy() if value.is_cpu and not has_graph(value) else value
        is_plain = isinstance(value, np.ndarray) and value.dtype.kind in "buif"
        if not is_plain or self.like is None or torch.is_inference_mode_enabled():
            return None
        digest = value.tobytes(), value.dtype.str, value.shape
        return digest, self.dtype, self.like.device, self.batched, len(self.like)

    def camera(
        self, numbers: KeyOrCamera, T: int, at: int, distortion: Tensor | None, checks: list[Any] | None = None
    ) -> Camera:
        """Intrinsics -> camera (B,) of the frame with index ``at`` along time; appends to ``checks``."""
        name = numbers if isinstance(numbers, str) else "intrinsics"
        value = get_value(self.sample, numbers) if isinstance(numbers, str) else numbers
        if is_kornia_camera(value):
            return self._kornia_camera(value, name, T, at, distortion)
        x = self.numbers(numbers, T, at)  # type: ignore[arg-type]  # no camera of kornia
        assert x is not None
        if x.shape[1] == 4:
            return Camera(x[:, :2], x[:, 2:], distortion)
        if x.shape[1] != 9:
            raise SampleError(f"{name}: found {x.shape[1]} numbers, expected 3x3, 4x4, fx fy cx cy or a camera")
        if checks is not None:
            last = (x[:, 6:] - x.new_tensor([0.0, 0, 1])).detach().abs().amax(-1)
            if not (last.device.type == "cpu" and all_known(last == 0)):
                text = f"{name}: the last row is off 0 0 1 by {{:.4g}}; is the matrix transposed?"
                # 1e-3 is far above single precision; a transposed matrix is off by its principal point in pixels.
                checks.append((~(last < 1e-3), last, text))
        return Camera(x[:, 0:5:4].contiguous(), x[:, 2:6:3].contiguous(), distortion)

    def _kornia_camera(self, value: Any, name: str, T: int, at: int, distortion: Tensor | None) -> Camera:
        """Camera of kornia -> camera (B,) of a frame: it holds one, or one per sample, or per frame of one sample."""
        try:
            camera = Camera.from_kornia(value)
        except TypeError as error:
            raise SampleError(f"{name}: {error}") from error
        if camera.distortion is not None and distortion is not None:
            raise SampleError(f"{name}: found a camera with a distortion, expected none beside the option distortion")
        f, c = (self._row(self.per_sample(x), name, T, at).to(self.dtype) for x in (camera.f, camera.c))
        if camera.distortion is not None:
            distortion = self._row(self.per_sample(camera.distortion), name, T, at).to(self.dtype)
        return Camera(f, c, distortion)

    def per_sample(self, x: Tensor) -> Tensor:
        """Numbers (n, …) of a camera of kornia: of n samples, of n frames of one, or the same for all -> (B, …)."""
        assert self.like is not None
        B = len(self.like)
        x = x.to(self.like.device)
        return x if self.batched and len(x) == B else x.expand(B, *x.shape)

    def pad(self, key: str, T: int) -> Tensor:
        """Image key -> (B, T) bool, True for frames that pad an episode: LeRobot's ``<key>_is_pad``."""
        assert self.like is not None
        name = f"{key}_is_pad"
        if not has_key(self.sample, name):
            return torch.zeros(self.like.shape[0], T, dtype=torch.bool, device=self.like.device)
        x = self.get(name).bool().flatten(1)
        if x.shape[1] != T:
            raise SampleError(f"{name}: found {x.shape[1]} values, expected {T}")
        return x


def intrinsic_rows(x: Tensor, T: int) -> Tensor:
    """Numbers (B, …) of samples, 3x3 or 4x4 matrices among them -> matrices as rows of nine numbers.

    Four rows of four numbers are fx fy cx cy of T = 4 frames, unless they end in 0 0 0 1.
    """
    if x.ndim < 3 or x.shape[-1] != x.shape[-2] or x.shape[-1] not in (3, 4):
        return x
    if x.shape[-1] == 4:
        last = x[..., 3, :]
        if x.ndim == 3 and T == 4 and not all_known(last == last.new_tensor([0, 0, 0, 1])):
            return x
        x = x[..., :3, :3]
    return x.flatten(-2)


def _list_keys(sample: Mapping[str, Any], prefix: str = "") -> list[str]:
    keys: list[str] = []
    for key, value in sample.items():
        nested = isinstance(value, Mapping)
        keys += _list_keys(value, f"{prefix}{key}.") if nested else [f"{prefix}{key}"]
    return sorted(keys)
