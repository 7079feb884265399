"""A sample of somebody's data set → our views: which keys, which layout, which unit.

A sample is a dict, flat with dotted keys (LeRobot) or nested (RLDS, openpi), of numpy arrays or tensors, one frame or
a few along time, one sample or a collated batch. What a number means is stated, never guessed: a depth without a unit
is an error, and so are values that contradict what was stated.

Alphabet: B samples, T frames of a sample along time, C × H × W image, h × w depth map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry import camera as cam
from dhtorch.geometry import pose_conventions as conventions
from dhtorch.geometry.checks import all_known, is_transformed
from dhtorch.ops.dispatch import operator
from dhtorch.pytree import stack
from dhtorch.records import Camera, Frame, PosePrior
from dhtorch.transforms import poses
from dhtorch.transforms.sample_access import KeyOrNumbers, SampleError, SampleReader

#: Units per metre of the depths that have a name.
SAMPLE_UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0}

#: Pixels at most by which the median depth of a frame is judged.
_MAX_PROBES = 1024

#: Cameras that are kept; a recording has one, or one for each frame.
MAX_CACHED_CAMERAS = 64

#: Relative distance from a limit beyond which single precision cannot change a verdict.
_ROUNDING_REL = 1e-5

#: The shapes of the image and the depth map may differ by this share; a transposed map differs by far more.
_MAX_ASPECT_MISMATCH = 0.1

#: Options that may name a key.
_KEY_OPTIONS = (
    *("image", "depth", "confidence", "intrinsics", "distortion", "depth_intrinsics"),
    *("other_image", "other_intrinsics", "pose", "pose_cov", "other_pose"),
)


class SampleViews(NamedTuple):
    """The views of B samples."""

    reference: Frame
    other: Frame | None  # with a leading dimension where several were asked for; None = there is none
    paired: Tensor  # (B,) bool: the other view is a view of its own, no copy that pads the start of an episode
    bad: Tensor  # (B,) bool: values contradict what was stated
    sensed: Tensor  # (B,) bool: the reference view's map has a return
    complaints: tuple[tuple[Tensor, Tensor, str], ...]  # mask (B,), value (B,) and what to say about it
    given: PosePrior | None = None  # the motion to the other view, where samples state it; leading dims as of other

    def complaint(self) -> str:
        """What to say about the first bad sample."""
        row = int(self.bad.int().argmax())
        said = next(text.format(float(value[row])) for bad, value, text in self.complaints if bad[row])
        return said if len(self.bad) == 1 else f"sample {row} of the batch: {said}"


@dataclass(frozen=True, kw_only=True)
class SampleSpec:
    """Where in a sample the views are, and what their numbers mean.

    A key is looked up as it stands, else piece by piece (``observation.depth`` or ``observation/depth`` in nested
    dicts). Images are uint8 or float in [0, 1], (C, H, W) or (H, W, C), with T in front where the sample holds frames
    along time. Depth maps are (h, w), (1, h, w) or (h, w, 1), with or without that T.

    Raises:
        ValueError: an option that cannot be.
    """

    depth_unit: str | float = ""  # "m", "mm", or metres per unit; must be said
    image: str = "image"  # key of the reference view's image
    depth: str = "depth"  # key of the reference view's depth map
    intrinsics: KeyOrNumbers = "intrinsics"  # 3×3, or fx fy cx cy, px of the image
    distortion: KeyOrNumbers | None = None  # of the image, OpenCV's order
    depth_intrinsics: KeyOrNumbers | None = None  # px of the depth map; None = it covers the same field as the image
    confidence: str | None = None  # key of the sensor's confidence: 0 low, 1 medium, 2 high
    other_image: str | None = None  # key of the other view's image; None = another frame along time
    other_intrinsics: KeyOrNumbers | None = None  # None = those of the reference view
    sparse: bool = False  # the depth map is a projected LiDAR sweep, mostly empty between returns
    at: int = -1  # the reference view's place along time
    other_at: int | Sequence[int] = 0  # the other view's; several are for a method of many views
    pose: str | poses.PoseMatrix | None = None  # key of a pose from elsewhere, 4x4 or 3x4, NaN where it is not
    # known; or, with "1_from_0", the matrix itself: two cameras of a rig
    pose_kind: str = (
        "world_from_cam"  # of each frame; or "1_from_0": maps points of the reference view into the other view
    )
    pose_cov: KeyOrNumbers | None = (
        None  # of each such pose: key of 6x6 (left perturbation, rad and m); or two standard
    )
    # deviations (rad, m) of the relative pose; None = not stated, the near returns then tell
    other_pose: str | None = None  # key of the other view's pose; None = another frame along time
    pose_axes: str = "cv"  # of the camera: x right, y down, z forward; "gl": x right, y up, z backward
    pose_unit: str | float = "m"  # or "mm", or metres per unit
    refine: bool = False  # only start the search for the most probable pose from it
    layout: str | None = None  # "hwc" or "chw"; None = the axis of 1 or 3 is C, an error where that fits both
    intrinsics_hw: tuple[int, int] | None = None  # image size that the intrinsics belong to; None = the image as it is
    depth_range: tuple[float, float] = (0.0, float("inf"))  # m, returns outside are none (a codec's "no return")
    max_depth: float = 100.0  # m, a median depth beyond is taken for a wrong unit
    min_depth: float = 0.01  # m, one below likewise
    max_offset: float = 0.2  # share of the image size by which the principal point may lie off the centre
    _cameras: dict[Any, Camera] = field(default_factory=dict, init=False, repr=False, compare=False)  # by their numbers

    def __post_init__(self) -> None:
        unit = self.depth_unit
        if not (unit in SAMPLE_UNITS_PER_METRE or (isinstance(unit, float | int) and unit > 0)):
            raise ValueError(
                f"depth_unit is {unit!r}, expected one of {sorted(SAMPLE_UNITS_PER_METRE)} or metres per unit"
            )
        if self.layout not in (None, "hwc", "chw"):
            raise ValueError(f"layout is {self.layout!r}, expected hwc, chw or None")
        self._check_pose()
        if self.other_image is not None and not isinstance(self.other_at, int):
            raise ValueError("other_at is a list, expected one number where other_image names the other view")

    def read(
        self, sample: Mapping[str, Any], *, batched: bool = False, dtype: torch.dtype = torch.float32
    ) -> SampleViews:
        """The views of a sample (B = 1) or of a collated batch.

        Raises:
            SampleError: a key is missing, or a shape or dtype is not what was stated. Values that contradict what was
                stated are in ``bad``.
        """
        leaves = SampleReader(sample, batched, dtype)
        images = leaves.images(self.image, self.layout)
        T, hw = images.shape[1], (images.shape[-2], images.shape[-1])
        at = _frame_index(self.at, T, self.image)
        image = images[:, at]
        checks = _unit_range_checks(image, self.image)
        ready = self.in_metres in sample
        planes = leaves.planes(self.in_metres if ready else self.depth, T, signed=False)
        depths = planes if ready else self.metres([planes])[0]
        depth = depths[:, at if depths.shape[1] > 1 else 0].contiguous()
        sensed, doubts = self._probed(depth)
        checks += doubts
        conf = None if self.confidence is None else leaves.planes(self.confidence, T)
        if conf is not None:
            conf = conf[:, at if conf.shape[1] > 1 else 0]
            checks.append(_confidence_check(conf, self.confidence))
            conf = conf.clamp(0, 2).to(torch.uint8).contiguous()
            if conf.shape != depth.shape:
                raise SampleError(
                    f"{self.confidence}: found {_format_hw(conf)}, expected {_format_hw(depth)} as {self.depth}"
                )
        camera = self._camera(leaves, self.intrinsics, hw, T, at, checks)
        reference = Frame(image, depth, camera, self._depth_camera(leaves, depth, hw, T, at), conf)
        if self.sparse:
            reference = reference.replace(sparse=torch.ones(len(depth), dtype=torch.bool, device=depth.device))
        other, paired = self._other(leaves, images, depths, reference, checks)
        motion = None if other is None else self._motion(leaves, T, checks)
        if other is not None:  # tracking reads all pixels, the front end alone a few where they lie
            reference = reference.replace(image=reference.image.contiguous())
        bad = torch.stack([c[0] for c in checks]).any(0) if checks else paired.new_zeros(len(depth))
        return SampleViews(reference, other, paired, bad, sensed=sensed, complaints=tuple(checks), given=motion)

    @property
    def in_metres(self) -> str:
        """Key of depth maps that went through :meth:`metres` when they were collated, in place of the stated one."""
        return f"{self.depth} in metres"

    def metres(self, maps: Sequence[Tensor]) -> Tensor:
        """Depth maps of one shape as they are in files, stacked and in metres, 0 = no return.

        They are converted one after the other, while each is in the cache.

        Raises:
            SampleError: numbers that cannot be metres.
        """
        if self.depth_unit == "m" and not maps[0].is_floating_point():
            raise SampleError(f"{self.depth}: found whole numbers ({maps[0].dtype}), expected metres; is the unit mm?")
        if any(x.dtype not in (torch.int16, torch.uint16) for x in maps):
            z = self._scaled(torch.stack(list(maps)) if len(maps) > 1 else maps[0][None])
        else:
            z = torch.empty(len(maps), *maps[0].shape, dtype=torch.float32, device=maps[0].device)
            for into, x in zip(z, maps, strict=True):
                _write_metres(into, x.view(torch.int16), signed=x.dtype.is_signed, unit=self.depth_unit)
        low, high = self.depth_range
        return z if low <= 0 and high == float("inf") else torch.where((z > low) & (z <= high), z, 0.0)

    def keys(self) -> tuple[str, ...]:
        """The keys of a sample that are read, but for those that say what only pads."""
        said = (getattr(self, name) for name in _KEY_OPTIONS)
        return tuple(dict.fromkeys(key for key in said if isinstance(key, str)))

    def image_hw(self, sample: Mapping[str, Any]) -> tuple[int, int] | None:
        """Size of the reference view's image, None where it cannot be read."""
        try:
            images = SampleReader(sample, batched=False, dtype=torch.float32).images(self.image, self.layout)
        except SampleError:
            return None
        return images.shape[-2], images.shape[-1]

    def _other(
        self, leaves: SampleReader, images: Tensor, depths: Tensor, reference: Frame, checks: list[Any]
    ) -> tuple[Frame | None, Tensor]:
        T = images.shape[1]
        at = _frame_index(self.at, T, self.image)
        key = self.image if self.other_image is None else self.other_image
        if self.other_image is not None:
            images = leaves.images(key, self.layout)
        wanted = [self.other_at] if isinstance(self.other_at, int) else self.other_at
        places = [_frame_index(p, images.shape[1], key) for p in wanted]
        pad = leaves.pad(key, images.shape[1])
        if self.other_image is None and set(places) == {at}:
            return None, pad.new_zeros(len(pad))
        frames, own = [], []
        for p in places:
            own.append(~pad[:, p] if self.other_image is not None or p != at else torch.zeros_like(pad[:, p]))
            image = images[:, p].contiguous()
            checks += _unit_range_checks(image, key)
            depth = torch.zeros_like(reference.depth)
            if self.other_image is None and depths.shape[1] > 1:
                depth = depths[:, p].contiguous()
            hw = image.shape[-2], image.shape[-1]
            numbers = self.intrinsics if self.other_intrinsics is None else self.other_intrinsics
            # The reference view's numbers along time belong to its own frames, not to those of another image.
            shared = self.other_image is not None and self.other_intrinsics is None
            count, when = (T, at) if shared else (images.shape[1], p)
            camera = self._camera(leaves, numbers, hw, count, when, checks)
            frames.append(Frame(image, depth, camera, reference.depth_camera))
        return (frames[0] if isinstance(self.other_at, int) else stack(frames)), torch.stack(own).any(0)

    def _motion(self, leaves: SampleReader, T: int, checks: list[Any]) -> PosePrior | None:
        """The motions to the other views that the samples state."""
        if self.pose is None:
            return None
        T_other = T if self.other_image is None else leaves.images(self.other_image, self.layout).shape[1]
        wanted = [self.other_at] if isinstance(self.other_at, int) else self.other_at
        places = [_frame_index(p, T_other, self.other_image or self.image) for p in wanted]
        unit = self.pose_unit
        found = poses.read_pose_priors(
            leaves,
            (_frame_index(self.at, T, self.image), places),
            (T, T_other),
            checks,
            keys=(self.pose, self.other_pose),
            cov=self.pose_cov,
            kind=self.pose_kind,
            axes=self.pose_axes,
            unit=1 / SAMPLE_UNITS_PER_METRE[unit] if isinstance(unit, str) else unit,
            refine=self.refine,
        )
        return found[0] if isinstance(self.other_at, int) else found

    def _check_pose(self) -> None:
        unit = self.pose_unit
        if self.pose is None:
            options = {"pose_cov": self.pose_cov, "other_pose": self.other_pose, "refine": self.refine or None}
            if said := [name for name, value in options.items() if value is not None]:
                raise ValueError(f"found {said[0]} without pose, expected the key of a pose")
        if self.pose_kind not in poses.POSE_KINDS:
            raise ValueError(f"pose_kind is {self.pose_kind!r}, expected {' or '.join(poses.POSE_KINDS)}")
        if self.pose_axes not in conventions.STATED_AXES:
            raise ValueError(f"pose_axes is {self.pose_axes!r}, expected {' or '.join(conventions.STATED_AXES)}")
        if not (unit in SAMPLE_UNITS_PER_METRE or (isinstance(unit, float | int) and 0 < unit < float("inf"))):
            raise ValueError(
                f"pose_unit is {unit!r}, expected one of {sorted(SAMPLE_UNITS_PER_METRE)} or metres per unit"
            )
        if not isinstance(self.pose, str | None):
            poses.check_constant_pose(self.pose, self.pose_kind)
        between_two = self.other_image is not None and self.pose_kind == "world_from_cam"
        if self.pose is not None and between_two and self.other_pose is None:
            raise ValueError("found pose and other_image, expected other_pose: the other view's pose")
        poses.parse_pose_sigmas(self.pose_cov)

    def _scaled(self, x: Tensor) -> Tensor:
        """Positive numbers in metres, 0 for all others."""
        if not x.is_floating_point():
            return _to_metres(x.float(), x.dtype.is_signed, self.depth_unit)
        x = x.nan_to_num(0.0, 0.0, 0.0).relu()
        if not isinstance(self.depth_unit, str):
            return x * float(self.depth_unit)
        return x if self.depth_unit == "m" else x / SAMPLE_UNITS_PER_METRE[self.depth_unit]

    def _probed(self, depth: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor, str]]]:
        """Which maps (B,) have a return, and what speaks against the unit."""
        low, high = self.min_depth * (1 + _ROUNDING_REL), self.max_depth * (1 - _ROUNDING_REL)
        return _check_returns(depth, spec=self, low=low, high=high)

    def _depth_checks(self, probes: Tensor, low: float, high: float) -> list[tuple[Tensor, Tensor, str]]:
        median = torch.where(probes > 0, probes, torch.nan).nanmedian(1).values
        if _is_cheap_to_read(median) and all(low < m < high or math.isnan(m) for m in median.tolist()):
            return []
        said = f"{self.depth}: the median return is {{:.4g}} m with the unit {self.depth_unit!r}, expected"
        return [
            (median > self.max_depth, median, f"{said} at most {self.max_depth:g} m; are the numbers millimetres?"),
            (median < self.min_depth, median, f"{said} at least {self.min_depth:g} m; are the numbers metres?"),
        ]

    def _camera(
        self, leaves: SampleReader, numbers: KeyOrNumbers, hw: tuple[int, int], T: int, at: int, checks: list[Any]
    ) -> Camera:
        stated = None if self.distortion is not None else leaves.stated(numbers)
        known = (stated, hw, T, at)
        if stated is not None and known in self._cameras:
            return self._cameras[known]
        camera = leaves.camera(numbers, T, at, leaves.numbers(self.distortion, T, at))
        if self.intrinsics_hw is not None and self.intrinsics_hw != hw:
            camera = cam.resize(camera, self.intrinsics_hw, hw)
        if self._fits_surely(camera, hw):
            if stated is not None and len(self._cameras) < MAX_CACHED_CAMERAS:
                self._cameras[known] = camera
            return camera
        name = numbers if isinstance(numbers, str) else "intrinsics"
        size = torch.tensor([hw[1], hw[0]], dtype=camera.c.dtype, device=camera.c.device)
        off = ((camera.c.detach() + 0.5) / size - 0.5).abs().amax(-1)
        small = camera.f.detach().amin(-1)
        limit = f"at most {self.max_offset:g} in an image of {hw[0]}x{hw[1]}; do they belong to another size?"
        checks.append(
            (~(off <= self.max_offset), off, f"{name}: principal point {{:.2f}} sizes off the centre, {limit}")
        )
        checks.append((~(small > 0), small, f"{name}: found focal length {{:.4g}}, expected a positive number of px"))
        return camera

    def _fits_surely(self, camera: Camera, hw: tuple[int, int]) -> bool:
        """Whether no rounding can make the intrinsics suspect; for few numbers operations of torch are dear."""
        if not (_is_cheap_to_read(camera.c) and camera.f.dtype == camera.c.dtype):
            return False
        off = (abs((c + 0.5) / n - 0.5) for row in camera.c.tolist() for c, n in zip(row, (hw[1], hw[0]), strict=True))
        return all(x < self.max_offset - _ROUNDING_REL for x in off) and all(x > 0 for x in camera.f.flatten().tolist())

    def _depth_camera(self, leaves: SampleReader, depth: Tensor, hw: tuple[int, int], T: int, at: int) -> Camera | None:
        if self.depth_intrinsics is not None:
            return leaves.camera(self.depth_intrinsics, T, at, None)
        h, w = depth.shape[-2:]
        if abs((h * hw[1]) / (w * hw[0]) - 1) > _MAX_ASPECT_MISMATCH:
            raise SampleError(
                f"{self.depth}: found {h}x{w} (height x width), which is no scaled image of {hw[0]}x{hw[1]}; is it "
                "transposed? A map with a field of its own needs depth_intrinsics"
            )
        return None


def _probe_depth(depth: Tensor) -> Tensor:
    """Some of the numbers (B, k) of each map, evenly spread; far from each other, they are read once for all."""
    return depth.flatten(1)[:, :: _probe_stride(depth)].contiguous()


def _probe_stride(depth: Tensor) -> int:
    """From one of the probed numbers of maps (…, h, w) to the next."""
    return max(1, depth.shape[-2] * depth.shape[-1] // _MAX_PROBES)


def _check_returns_kernel(depth: Tensor, *, spec: SampleSpec, low: float, high: float) -> tuple[Tensor, list[Any]]:
    counts = depth.new_empty(2, len(depth), dtype=torch.int64)
    torch.ops.dhtorch.count_returns.default(depth, counts, _probe_stride(depth), low, high)
    if all(0 < some < 2 * sound for some, sound in zip(*counts.tolist(), strict=True)):
        return torch.ones(len(depth), dtype=torch.bool), []  # each median lies between the bounds
    return _probed_returns(depth, spec, low, high)


@operator(kernel=_check_returns_kernel, dtypes={"depth": torch.float32})
def _check_returns(depth: Tensor, *, spec: SampleSpec, low: float, high: float) -> tuple[Tensor, list[Any]]:
    """Which maps (B, h, w) have a return (B,), and what contradicts their unit: :meth:`SampleSpec._probed`."""
    return _probed_returns(depth, spec, low, high)


def _probed_returns(depth: Tensor, spec: SampleSpec, low: float, high: float) -> tuple[Tensor, list[Any]]:
    probes = _probe_depth(depth.detach())
    return _has_return(depth, probes), spec._depth_checks(probes, low, high)


def _has_integer_unit(*_: Tensor, signed: bool, unit: str | float) -> bool:
    return isinstance(unit, str)


def _write_metres_kernel(into: Tensor, words: Tensor, *, signed: bool, unit: str) -> None:
    torch.ops.dhtorch.write_metres.default(words, into, SAMPLE_UNITS_PER_METRE[unit], signed)


@operator(kernel=_write_metres_kernel, dtypes={"into": torch.float32, "words": torch.int16}, when=_has_integer_unit)
def _write_metres(into: Tensor, words: Tensor, *, signed: bool, unit: str | float) -> None:
    """Fill ``into`` (…) with metres, from the 16-bit ``words`` (…) of a file, signed or unsigned."""
    _to_metres(into.copy_(words if signed else words.view(torch.uint16)), signed, unit)


def _to_metres(x: Tensor, signed: bool, unit: str | float) -> Tensor:
    """Whole numbers as floats -> metres in place; 0 for those that are not positive."""
    # Every pass over a whole map costs as much as the front end: no more of them than the numbers ask for.
    x = x.relu_() if signed else x
    return x.div_(SAMPLE_UNITS_PER_METRE[unit]) if isinstance(unit, str) else x.mul_(float(unit))


def _has_return(depth: Tensor, probes: Tensor) -> Tensor:
    """Whether maps (B, h, w) have a return, (B,) bool: a pass over all of them only where some numbers do not tell."""
    some = (probes > 0).any(1)
    return some if depth.is_cpu and all_known(some) else depth.amax((1, 2)) > 0


def _frame_index(at: int, T: int, key: str) -> int:
    """A place along time, counted from the end if negative; the only frame where there is no other."""
    if T == 1:
        return 0
    if not -T <= at < T:
        raise SampleError(f"{key}: found {T} frames along time, expected one at {at}")
    return at % T


def _is_cheap_to_read(x: Tensor) -> bool:
    """Whether numbers may be looked at without waiting for a device, and have the digits for it."""
    return x.device.type == "cpu" and x.dtype.itemsize >= 4 and not is_transformed()


def _unit_range_checks(image: Tensor, key: str) -> list[tuple[Tensor, Tensor, str]]:
    if image.dtype == torch.uint8:
        return []
    text = f"{key}: found the value {{:.4g}}, expected floats in [0, 1] (pixels before any normalisation)"
    low, high = (f(image.detach(), (1, 2, 3)) for f in (torch.amin, torch.amax))  # no copy in whatever layout
    bad_low, bad_high = ~(low >= -1e-3), ~(high <= 1 + 1e-3)
    return [(bad_low | bad_high, torch.where(bad_high, high, low), text)]


def _confidence_check(conf: Tensor, key: str | None) -> tuple[Tensor, Tensor, str]:
    high = conf.flatten(1).amax(1)
    text = f"{key}: found the value {{:.4g}}, expected 0 low, 1 medium, 2 high"
    return ~(high <= 2) | (conf != conf.floor()).flatten(1).any(1), high, text


def _format_hw(x: Tensor) -> str:
    return f"{x.shape[-2]}x{x.shape[-1]}"
