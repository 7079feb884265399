"""Sample dict of any data set → reference and source views, from stated keys, layouts and units.

A sample is a dict, flat with dotted keys (LeRobot) or nested (RLDS, openpi), of numpy arrays or tensors, one frame or
a few along time, one sample or a collated batch. The meaning of a number is an option, never guessed: a depth without
a unit is an error, and so are values that contradict the options.

Alphabet: B samples, T frames of a sample along time, C × H × W image, h × w depth map.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.stored_sizes import describe_mismatch
from dhtorch.geometry import camera as cam
from dhtorch.geometry import pose_conventions as conventions
from dhtorch.geometry.checks import all_known, is_transformed
from dhtorch.geometry.no_depth import clear_far_constant, clear_saturated
from dhtorch.ops.dispatch import operator
from dhtorch.pipeline.inputs import EXPECTED_METRES, EXPECTED_RANGE, dtype_name
from dhtorch.pytree import stack
from dhtorch.records import Camera, Frame, PosePrior
from dhtorch.transforms.poses import (
    POSE_KINDS,
    PoseMatrix,
    check_constant_pose,
    parse_pose_sigmas,
    read_pose_priors,
)
from dhtorch.transforms.sample_access import KeyOrCamera, KeyOrNumbers, SampleError, SampleReader

#: Named depth units -> units per metre.
SAMPLE_UNITS_PER_METRE = {"m": 1.0, "mm": 1000.0}

#: Relative distance from a limit beyond which float32 rounding cannot change the result of a check.
_ROUNDING_REL = 1e-5


class SampleViews(NamedTuple):
    """Reference and source views of B samples, and the result of their checks."""

    reference: Frame
    other: Frame | None  # source view, with a leading dimension for several; None = none
    paired: Tensor  # (B,) bool: there is a source view, not a copy that pads the start of an episode
    bad: Tensor  # (B,) bool: values contradict the options
    has_returns: Tensor  # (B,) bool: the depth map of the reference view has a return
    complaints: tuple[tuple[Tensor, Tensor, str], ...]  # failed checks: mask (B,), value (B,), message
    pose_prior: PosePrior | None = None  # motion to the source view, if samples hold one; leading dims as of other

    def complaint(self) -> str:
        """Message of the first failed check of the first bad sample that has one; empty without one."""
        for row in self.bad.nonzero()[:, 0].tolist():
            message = next(text.format(float(value[row])) for bad, value, text in self.complaints if bad[row])
            if message:  # empty: of an item that was reported when it was loaded
                return message if len(self.bad) == 1 else f"sample {row} of the batch: {message}"
        return ""


#: Value of ``depth_unit``: the unit that the data set declares.
AUTO_UNIT = "auto"

#: Value of ``depth_range``, m: every depth is a return.
NO_LIMITS = (0.0, math.inf)


def default_prefix(image: str) -> str:
    """Key of the picture -> prefix of added keys: for names of LeRobot's pictures one that its processors keep."""
    return "observation.dh_" if image.startswith("observation.images.") else "dhtorch."


@dataclass(frozen=True, kw_only=True)
class SampleSpec:
    """Keys, layouts and units of the views in a sample.

    A key is looked up as it is, else part by part (``observation.depth`` or ``observation/depth`` in nested
    dicts). Images are uint8 or float in [0, 1], (C, H, W) or (H, W, C), with T in front where the sample holds frames
    along time. Depth maps are (h, w), (1, h, w) or (h, w, 1), with or without that T.

    Raises:
        ValueError: an invalid option.
    """

    # "m", "mm", or metres per unit; required. "auto" = what the data set declares in ExtendedDataset or ExtendedStream.
    depth_unit: str | float = ""
    image: str = "image"  # key of the reference view's image
    depth: str = "depth"  # key of the reference view's depth map
    intrinsics: KeyOrCamera = "intrinsics"  # 3×3, 4×4, fx fy cx cy, or a camera of kornia, px of the image
    distortion: KeyOrNumbers | None = None  # of the image, in OpenCV's order
    depth_intrinsics: "KeyOrCamera | None" = None  # px of the depth map; None = it covers the same field as the image
    confidence: str | None = None  # key of the sensor's confidence: 0 low, 1 medium, 2 high
    other_image: str | None = None  # key of the source view's image; None = another frame along time
    other_intrinsics: "KeyOrCamera | None" = None  # None = those of the reference view
    sparse: bool = False  # the depth map is a projected LiDAR sweep, mostly empty between returns
    at: int = -1  # index of the reference view along time
    other_at: int | Sequence[int] = 0  # index of the source view; several are for a multi-view method
    # Key of an external pose, 4x4 or 3x4, NaN = unknown; or, with "1_from_0", the matrix itself: two cameras of a rig.
    pose: str | PoseMatrix | None = None
    # "world_from_cam": of each frame; "1_from_0": maps points of the reference view into the source view.
    pose_kind: str = "world_from_cam"
    # Of each such pose: key of 6x6 (left perturbation, rad and m); or two standard deviations (rad, m) of the relative
    # pose; None = unknown, the near returns then validate the pose.
    pose_cov: KeyOrNumbers | None = None
    other_pose: str | None = None  # key of the source view's pose; None = another frame along time
    pose_axes: str = "cv"  # of the camera: x right, y down, z forward; "gl": x right, y up, z backward
    pose_unit: str | float = "m"  # or "mm", or metres per unit
    refine: bool = False  # use the pose only as the starting point of the pose estimation
    layout: str | None = None  # "hwc" or "chw"; None = the axis of size 1 or 3 is C, an error if both fit
    intrinsics_hw: tuple[int, int] | None = None  # image size of the intrinsics; None = size of the image
    depth_range: tuple[float, float] = NO_LIMITS  # m, depths outside are no returns (a codec's "no return")
    max_depth: float = 100.0  # m, a larger median depth means a wrong unit
    min_depth: float = 0.01  # m, a smaller median depth means a wrong unit
    min_focal: float = 0.05  # smaller focal lengths, as a fraction of the longer image side, are of another unit

    _cameras: dict[Any, Camera] = field(default_factory=dict, init=False, repr=False, compare=False)  # read before

    def __post_init__(self) -> None:
        unit = self.depth_unit
        if not (unit in (*SAMPLE_UNITS_PER_METRE, AUTO_UNIT) or (isinstance(unit, float | int) and unit > 0)):
            expected = f"one of {sorted(SAMPLE_UNITS_PER_METRE)}, metres per unit, or {AUTO_UNIT}"
            raise ValueError(f"depth_unit is {unit!r}, expected {expected}")
        if self.layout not in (None, "hwc", "chw"):
            raise ValueError(f"layout is {self.layout!r}, expected hwc, chw or None")
        self._check_pose()
        if self.other_image is not None and not isinstance(self.other_at, int):
            raise ValueError("other_at is a list, expected one number where other_image names the other view")

    def read(
        self, sample: Mapping[str, Any], *, batched: bool = False, dtype: torch.dtype = torch.float32
    ) -> SampleViews:
        """Sample (B = 1) or collated batch -> its views.

        Raises:
            SampleError: a missing key, or a shape or dtype that contradicts the options. Values that contradict them
                are marked in ``bad``.
        """
        if self.depth_unit == AUTO_UNIT:
            expected = "a data set that declares its unit in ExtendedDataset(dataset, transform), or m, mm, a number"
            raise ValueError(f"depth_unit is {AUTO_UNIT!r} for samples without a data set: expected {expected}")
        leaves = SampleReader(sample, batched, dtype)
        images = leaves.images(self.image, self.layout)
        T, hw = images.shape[1], (images.shape[-2], images.shape[-1])
        at = _frame_index(self.at, T, self.image)
        image = images[:, at].contiguous()
        checks = _unit_range_checks(image, self.image)
        ready = self.metric_depth_key in sample
        planes = leaves.planes(self.metric_depth_key if ready else self.depth, T, signed=False)
        depths = planes if ready else self.metres([planes])[0]
        depth = depths[:, at if depths.shape[1] > 1 else 0].contiguous()
        low, high = self.min_depth * (1 + _ROUNDING_REL), self.max_depth * (1 - _ROUNDING_REL)
        has_returns, failed = _check_returns(depth, spec=self, low=low, high=high)
        checks += failed
        conf = None if self.confidence is None else leaves.planes(self.confidence, T)
        if conf is not None:
            conf = conf[:, at if conf.shape[1] > 1 else 0]
            level = conf.flatten(1).amax(1)
            text = f"{self.confidence}: found the value {{:.4g}}, expected 0 low, 1 medium, 2 high"
            checks.append((~(level <= 2) | (conf != conf.floor()).flatten(1).any(1), level, text))
            conf = conf.clamp(0, 2).to(torch.uint8).contiguous()
            if conf.shape != depth.shape:
                raise SampleError(
                    f"{self.confidence}: found {_format_hw(conf)}, expected {_format_hw(depth)} as {self.depth}"
                )
        camera = self._camera(leaves, self.intrinsics, hw, T, at, checks)
        reference = Frame(image, depth, camera, self._depth_camera(leaves, depth, hw, T, at), conf)
        if self.sparse:
            reference = reference.replace(sparse=torch.ones(len(depth), dtype=torch.bool, device=depth.device))
        other, paired, motion = self._other(leaves, images, depths, reference, checks)
        bad = torch.stack([c[0] for c in checks]).any(0) if checks else paired.new_zeros(len(depth))
        return SampleViews(
            reference, other, paired, bad, has_returns=has_returns, complaints=tuple(checks), pose_prior=motion
        )

    @property
    def metric_depth_key(self) -> str:
        """Key of depth maps that were already converted by :meth:`metres` when they were collated."""
        return f"{self.depth} in metres"

    def metres(self, maps: Sequence[Tensor]) -> Tensor:
        """Depth maps of one shape in the data set's unit -> stacked maps in metres, 0 = no return.

        They are converted one after the other, while each is in the cache.

        Raises:
            SampleError: integers with the unit m.
        """
        if self.depth_unit == "m" and not maps[0].is_floating_point():
            raise SampleError(f"{self.depth}: found {dtype_name(maps[0])}, {EXPECTED_METRES}; is the unit mm?")
        if any(x.dtype not in (torch.int16, torch.uint16) for x in maps):
            z = torch.stack(list(maps)) if len(maps) > 1 else maps[0][None]
            if not z.is_floating_point():
                z = _to_metres(z.float(), z.dtype.is_signed, self.depth_unit)
            elif isinstance(self.depth_unit, str):
                z = z.nan_to_num(0.0, 0.0, 0.0).relu()
                z = z if self.depth_unit == "m" else z / SAMPLE_UNITS_PER_METRE[self.depth_unit]
            else:
                z = z.nan_to_num(0.0, 0.0, 0.0).relu() * float(self.depth_unit)
            z = clear_saturated(z, _metres_per(self.depth_unit))
        else:
            z = torch.empty(len(maps), *maps[0].shape, dtype=torch.float32, device=maps[0].device)
            for into, x in zip(z, maps, strict=True):
                _write_metres(into, x.view(torch.int16), signed=x.dtype.is_signed, unit=self.depth_unit)
        z = clear_far_constant(z)
        low, high = self.depth_range
        return z if low <= 0 and high == float("inf") else torch.where((z > low) & (z <= high), z, 0.0)

    def keys(self) -> tuple[str, ...]:
        """The keys that are read from a sample, without the ``_is_pad`` keys."""
        values = (
            *(self.image, self.depth, self.confidence, self.intrinsics, self.distortion, self.depth_intrinsics),
            *(self.other_image, self.other_intrinsics, self.pose, self.pose_cov, self.other_pose),
        )
        return tuple(dict.fromkeys(key for key in values if isinstance(key, str)))

    def number_keys(self) -> tuple[str, ...]:
        """The keys whose numbers must be finite: all but those of depth and poses, where NaN means unknown."""
        unknown = {self.depth, self.metric_depth_key, self.pose, self.other_pose, self.pose_cov}
        return tuple(key for key in self.keys() if key not in unknown)

    def image_hw(self, sample: Mapping[str, Any]) -> tuple[int, int] | None:
        """Size of the reference image of a sample, None if it cannot be read."""
        try:
            images = SampleReader(sample, batched=False, dtype=torch.float32).images(self.image, self.layout)
        except SampleError:
            return None
        return images.shape[-2], images.shape[-1]

    def _other(
        self, leaves: SampleReader, images: Tensor, depths: Tensor, reference: Frame, checks: list[Any]
    ) -> tuple[Frame | None, Tensor, PosePrior | None]:
        """Source views (None = none), whether each sample has one (B,), and pose priors of the views, None without the
        option ``pose``; appends to ``checks``."""
        T = images.shape[1]
        at = _frame_index(self.at, T, self.image)
        key = self.image if self.other_image is None else self.other_image
        if self.other_image is not None:
            images = leaves.images(key, self.layout)
        offsets = [self.other_at] if isinstance(self.other_at, int) else self.other_at
        indices = [_frame_index(p, images.shape[1], key) for p in offsets]
        pad = leaves.pad(key, images.shape[1])
        if self.other_image is None and set(indices) == {at}:
            return None, pad.new_zeros(len(pad)), None
        frames, is_own = [], []
        for p in indices:
            is_own.append(~pad[:, p] if self.other_image is not None or p != at else torch.zeros_like(pad[:, p]))
            image = images[:, p].contiguous()
            checks += _unit_range_checks(image, key)
            depth = torch.zeros_like(reference.depth)
            if self.other_image is None and depths.shape[1] > 1:
                depth = depths[:, p].contiguous()
            hw = image.shape[-2], image.shape[-1]
            intrinsics = self.intrinsics if self.other_intrinsics is None else self.other_intrinsics
            # Intrinsics of the reference view along time belong to its own frames, not to those of another image.
            shared = self.other_image is not None and self.other_intrinsics is None
            count, when = (T, at) if shared else (images.shape[1], p)
            camera = self._camera(leaves, intrinsics, hw, count, when, checks)
            frames.append(Frame(image, depth, camera, reference.depth_camera))
        is_single = isinstance(self.other_at, int)
        motion = None
        if self.pose is not None:
            priors = read_pose_priors(
                leaves,
                (at, indices),
                (T, images.shape[1]),
                checks,
                keys=(self.pose, self.other_pose),
                cov=self.pose_cov,
                kind=self.pose_kind,
                axes=self.pose_axes,
                unit=_metres_per(self.pose_unit),
                refine=self.refine,
            )
            motion = priors[0] if is_single else priors
        return (frames[0] if is_single else stack(frames)), torch.stack(is_own).any(0), motion

    def _check_pose(self) -> None:
        """Raises ValueError for pose options that are invalid or contradict each other."""
        unit = self.pose_unit
        if self.pose is None:
            options = {"pose_cov": self.pose_cov, "other_pose": self.other_pose, "refine": self.refine or None}
            if pose_only := [name for name, value in options.items() if value is not None]:
                raise ValueError(f"found {pose_only[0]} without pose, expected the key of a pose")
        if self.pose_kind not in POSE_KINDS:
            raise ValueError(f"pose_kind is {self.pose_kind!r}, expected {' or '.join(POSE_KINDS)}")
        if self.pose_axes not in conventions.STATED_AXES:
            raise ValueError(f"pose_axes is {self.pose_axes!r}, expected {' or '.join(conventions.STATED_AXES)}")
        if not (unit in SAMPLE_UNITS_PER_METRE or (isinstance(unit, float | int) and 0 < unit < float("inf"))):
            raise ValueError(
                f"pose_unit is {unit!r}, expected one of {sorted(SAMPLE_UNITS_PER_METRE)} or metres per unit"
            )
        if not isinstance(self.pose, str | None):
            check_constant_pose(self.pose, self.pose_kind)
        between_two = self.other_image is not None and self.pose_kind == "world_from_cam"
        if self.pose is not None and between_two and self.other_pose is None:
            raise ValueError("found pose and other_image, expected other_pose: the other view's pose")
        parse_pose_sigmas(self.pose_cov)

    def _camera(
        self, leaves: SampleReader, numbers: KeyOrCamera, hw: tuple[int, int], T: int, at: int, checks: list[Any]
    ) -> Camera:
        digest = None if self.distortion is not None else leaves.fingerprint(numbers)
        key = (digest, hw, T, at)
        if digest is not None and key in self._cameras:
            return self._cameras[key]
        failed: list[Any] = []
        camera = leaves.camera(numbers, T, at, leaves.numbers(self.distortion, T, at), failed)
        if self.intrinsics_hw is not None and self.intrinsics_hw != hw:
            camera = cam.resize(camera, self.intrinsics_hw, hw)
        least = self.min_focal * max(hw)
        if not failed and _is_clearly_plausible(camera, least):
            if digest is not None and len(self._cameras) < 64:  # a recording has one camera, or one for each frame
                self._cameras[key] = camera
            return camera
        name = numbers if isinstance(numbers, str) else "intrinsics"
        small, centre = camera.f.detach().amin(-1), camera.c.detach().sum(-1)
        limit = f"{name}: focal length {{:.4g}} px in an image of {hw[0]}x{hw[1]}, expected at least {least:.4g}"
        hint = f"(min_focal={self.min_focal:g} of its longer side); are they normalised, or of another size?"
        checks += failed
        checks.append((~(small > 0), small, f"{name}: found focal length {{:.4g}}, expected a positive number of px"))
        checks.append((~(small >= least), small, f"{limit} {hint}"))
        checks.append((~centre.isfinite(), centre, f"{name}: found a principal point of {{:.4g}}, expected numbers"))
        return camera

    def _depth_camera(self, leaves: SampleReader, depth: Tensor, hw: tuple[int, int], T: int, at: int) -> Camera | None:
        """Camera of the depth map; None = it covers the field of view of the image."""
        if self.depth_intrinsics is not None:
            return leaves.camera(self.depth_intrinsics, T, at, None)
        check_sample_orientation(self.depth, depth, hw)
        h, w = depth.shape[-2:]
        if abs((h * hw[1]) / (w * hw[0]) - 1) > 0.1:  # a transposed map differs by far more
            raise SampleError(
                f"{self.depth}: found {h}x{w} (height x width), which is no scaled image of {hw[0]}x{hw[1]}; a map "
                "with another field of view needs depth_intrinsics"
            )
        return None


def check_sample_orientation(key: str, depth: Tensor, hw: tuple[int, int]) -> None:
    """Raise SampleError for portrait maps (B, h, w) of a landscape image of size ``hw``, or vice versa."""
    if mismatch := describe_mismatch((depth.shape[-2], depth.shape[-1]), hw):
        raise SampleError(f"{key}: the orientation differs: {mismatch} (width x height); turn one of them and its K")


def _probe_stride(depth: Tensor) -> int:
    """Step between the values of flattened maps (…, h, w), 1024 at least, of which the median depth is computed."""
    return max(1, depth.shape[-2] * depth.shape[-1] // 1024)


def _check_returns_kernel(depth: Tensor, *, spec: SampleSpec, low: float, high: float) -> tuple[Tensor, list[Any]]:
    counts = depth.new_empty(2, len(depth), dtype=torch.int64)
    torch.ops.dhtorch.count_returns.default(depth, counts, _probe_stride(depth), low, high)
    if all(0 < n_returns < 2 * n_within for n_returns, n_within in zip(*counts.tolist(), strict=True)):
        return torch.ones(len(depth), dtype=torch.bool), []  # each median lies within the limits
    return _check_returns_reference(depth, spec, low, high)


@operator(kernel=_check_returns_kernel, dtypes={"depth": torch.float32})
def _check_returns(depth: Tensor, *, spec: SampleSpec, low: float, high: float) -> tuple[Tensor, list[Any]]:
    """Maps (B, h, w) -> whether each has a return (B,), and the checks of the unit; none if all medians lie within the
    limits."""
    return _check_returns_reference(depth, spec, low, high)


def _check_returns_reference(depth: Tensor, spec: SampleSpec, low: float, high: float) -> tuple[Tensor, list[Any]]:
    # Evenly spaced values (B, k), copied once because strided reads are slow.
    probes = depth.detach().flatten(1)[:, :: _probe_stride(depth)].contiguous()
    has_probe = (probes > 0).any(1)
    has_returns = has_probe if depth.is_cpu and all_known(has_probe) else depth.amax((1, 2)) > 0
    median = torch.where(probes > 0, probes, torch.nan).nanmedian(1).values
    if _is_cheap_to_read(median) and all(low < m < high or math.isnan(m) for m in median.tolist()):
        return has_returns, []
    text = f"{spec.depth}: the median return is {{:.4g}} m with the unit {spec.depth_unit!r}, expected"
    return has_returns, [
        (median > spec.max_depth, median, f"{text} at most {spec.max_depth:g} m; are the numbers millimetres?"),
        (median < spec.min_depth, median, f"{text} at least {spec.min_depth:g} m; are the numbers metres?"),
    ]


def _write_metres_kernel(into: Tensor, words: Tensor, *, signed: bool, unit: str) -> None:
    torch.ops.dhtorch.write_metres.default(words, into, SAMPLE_UNITS_PER_METRE[unit], signed)


@operator(
    kernel=_write_metres_kernel,
    dtypes={"into": torch.float32, "words": torch.int16},
    when=lambda *_, signed, unit: isinstance(unit, str),
)
def _write_metres(into: Tensor, words: Tensor, *, signed: bool, unit: str | float) -> None:
    """Fill ``into`` (…) with metres, 0 = no return, from the 16-bit integers ``words`` (…), signed or unsigned."""
    _to_metres(into.copy_(words if signed else words.view(torch.uint16)), signed, unit)
    if not signed:
        cleared = clear_saturated(into, _metres_per(unit))
        if cleared is not into:
            into.copy_(cleared)


def _metres_per(unit: str | float) -> float:
    return 1 / SAMPLE_UNITS_PER_METRE[unit] if isinstance(unit, str) else unit


def _to_metres(x: Tensor, signed: bool, unit: str | float) -> Tensor:
    """Integer depths as floats -> metres in place; 0 for those that are not positive."""
    # A pass over a whole map costs as much as the front end: as few passes as possible.
    x = x.relu_() if signed else x
    return x.div_(SAMPLE_UNITS_PER_METRE[unit]) if isinstance(unit, str) else x.mul_(float(unit))


def _frame_index(at: int, T: int, key: str) -> int:
    """Index along time, negative = from the end -> index of the frame; 0 if there is only one."""
    if T == 1:
        return 0
    if not -T <= at < T:
        raise SampleError(f"{key}: found {T} frames along time, expected one at {at}")
    return at % T


def _is_clearly_plausible(camera: Camera, least: float) -> bool:
    """Whether the intrinsics pass all checks regardless of rounding; plain Python is faster for so few numbers."""
    if not (_is_cheap_to_read(camera.c) and camera.f.dtype == camera.c.dtype):
        return False
    f, c = camera.f.flatten().tolist(), camera.c.flatten().tolist()
    return all(x > least * (1 + _ROUNDING_REL) for x in f) and all(map(math.isfinite, c))


def _is_cheap_to_read(x: Tensor) -> bool:
    """Whether a tensor is on the CPU, outside a transform of torch.func, and has at least 32 bits."""
    return x.device.type == "cpu" and x.dtype.itemsize >= 4 and not is_transformed()


def _unit_range_checks(image: Tensor, key: str) -> list[tuple[Tensor, Tensor, str]]:
    """Images (B, C, H, W) -> checks that floats lie in [0, 1]."""
    if image.dtype == torch.uint8:
        return []
    text = f"{key}: found the value {{:.4g}}, {EXPECTED_RANGE}, pixels before any normalisation"
    low, high = (f(image.detach(), (1, 2, 3)) for f in (torch.amin, torch.amax))  # no copy for any layout
    bad_low, bad_high = ~(low >= -1e-3), ~(high <= 1 + 1e-3)
    return [(bad_low | bad_high, torch.where(bad_high, high, low), text)]


def _format_hw(x: Tensor) -> str:
    return f"{x.shape[-2]}x{x.shape[-1]}"
