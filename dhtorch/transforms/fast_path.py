"""A view alone, at once: what the front end says of samples without a second view, by one call of compiled code each.

A loader reads a sample with cold caches, where calling the stages one after the other costs more than what they do. Of
samples alike (one size, layout and camera) the places to look at are the same, so they are kept; what is left is one
pass over the picture and the depth map as they were decoded. The stages give the same bits, and are asked wherever
anything is not as usual (``tests/ops/test_compiled.py``).

Alphabet: B samples, N places, C × H × W picture, h × w depth map.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dhtorch.geometry.checks import is_transformed
from dhtorch.geometry.patches import MAX_COMPILED_WINDOW_PX, flatten_images, product_is_exact, whole_is_faster
from dhtorch.ops import loader
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import options
from dhtorch.records import MergedDepth
from dhtorch.stages import sample as samplers
from dhtorch.stages.backproject import ReturnLimits, backproject, project_samples, window_sizes
from dhtorch.stages.holes import classify
from dhtorch.transforms.sample_access import SampleError, get_value, has_key, numbers_fingerprint, to_tensor
from dhtorch.transforms.sample_spec import (
    MAX_CACHED_CAMERAS,
    SAMPLE_UNITS_PER_METRE,
    SampleSpec,
    all_medians_plausible,
    probe_stride,
)

#: Patterns that say the same whenever they are asked for a size of picture.
_FIXED = (samplers.spiral, samplers.vogel_spiral, samplers.regular_grid)


class Looked(NamedTuple):
    """What was seen of B samples."""

    found: MergedDepth
    xyz: Tensor  # (B, N, 3) m; 0 where there is no usable return
    flag: Tensor  # (B, N) int32, codes.Flag
    hole: Tensor  # (B, N) int32, codes.Hole
    hw: tuple[int, int]  # of the pictures


class _Spots(NamedTuple):
    """What samples of one kind share."""

    hw: tuple[int, int]
    uv: Tensor  # (1, N, 2) px
    pixel: Tensor  # (1, N, 2) int32, of the picture
    at: Tensor  # (1, N, 2) int32, of the map
    ray: Tensor  # (1, N, 3)
    step: int  # between the numbers of the map that tell the unit
    shape: tuple[int, ...]  # windows and steps, as compiled code is told them


class _Read(NamedTuple):
    """A sample as it was decoded."""

    picture: Tensor
    depth: Tensor  # (h, w), words as int16
    signed: bool
    spots: _Spots


class Alone:
    """The front end of a method on samples of which ``views`` says what they hold."""

    def __init__(self, views: SampleSpec, method: Method) -> None:
        self.views, self.n, self.method = views, method.n, method
        self.limits = _told(views, method)
        self.bounds = views.bounds()
        self.pad, self.ready = f"{views.image}_is_pad", views.in_metres
        self.kept: dict[Hashable, _Spots] = {}

    def look(self, samples: Sequence[Any]) -> Looked | None:
        """What is seen of samples that are not collated; None where the stages have to be asked.

        Gradient: none; where one is wanted, the stages are asked.
        """
        if self.limits is None or not samples or not loader.serves():
            return None
        read = []
        for sample in samples:
            one = self._read(sample)
            if one is None:
                return None
            read.append(one)
        hw = read[0].spots.hw
        if any(one.spots.hw != hw for one in read):
            return None
        B, like = len(read), read[0].spots.ray
        depth, sigma, score = (like.new_empty(B, self.n) for _ in range(3))
        flag, hole, source = (like.new_empty(B, self.n, dtype=torch.int32) for _ in range(3))
        xyz = like.new_empty(B, self.n, 3)
        counts = like.new_empty(2, B, dtype=torch.int64)
        filled = depth, sigma, score, xyz, flag, hole, source, counts
        unit, (limits, (block, least)) = SAMPLE_UNITS_PER_METRE[str(self.views.depth_unit)], self.limits
        look, exact = torch.ops.dhtorch.look.default, product_is_exact(read[0].picture)
        for b, (picture, z, signed, spots) in enumerate(read):
            where, seen = (z, spots.at, picture, spots.pixel, spots.ray), (b, unit, signed, spots.step, *self.bounds)
            grey = block, exact and spots.shape[4] == 3, least
            look(*where, *filled, *seen, *spots.shape, *limits, *grey)
        if not all_medians_plausible(counts):
            return None
        uv = torch.cat([one.spots.uv for one in read])
        return Looked(MergedDepth(uv, depth, sigma, score, source), xyz, flag, hole, hw)

    def _read(self, sample: Any) -> _Read | None:
        views = self.views
        if not isinstance(sample, Mapping) or self.ready in sample:
            return None
        try:
            numbers = views.intrinsics
            stated = numbers_fingerprint(get_value(sample, numbers)) if isinstance(numbers, str) else b""
            picture = to_tensor(get_value(sample, views.image), views.image)
            depth = to_tensor(get_value(sample, views.depth), views.depth, signed=False)
            if stated is None or has_key(sample, self.pad):
                return None
            if depth.ndim == 3 and 1 in (depth.shape[0], depth.shape[2]):
                depth = depth[0] if depth.shape[0] == 1 else depth[..., 0]
            signed = depth.dtype == torch.int16
            depth = depth.view(torch.int16) if depth.dtype == torch.uint16 else depth
            if not _is_usual(picture, depth):
                return None
            kind = stated, picture.shape, depth.shape, depth.dtype
            spots = self.kept.get(kind) or self._spots(sample, kind)
        except SampleError:  # the stages say it
            return None
        return None if spots is None else _Read(picture, depth, signed, spots)

    def _spots(self, sample: Mapping[str, Any], kind: Hashable) -> _Spots | None:
        """What samples of this kind share, from the first of them, kept; None where it is not as usual.

        Raises:
            SampleError: it cannot be read.
        """
        if len(self.kept) >= MAX_CACHED_CAMERAS or torch.is_inference_mode_enabled() or is_transformed():
            return None
        read = self.views.read(sample)
        frame = read.reference
        if read.complaints or read.other is not None or not bool(read.sensed.all()):
            return None
        uv = self.method.sample(frame.hw, self.n, device=frame.camera.f.device, dtype=frame.camera.f.dtype)[None]
        told = project_samples(frame, uv)
        size, reach = window_sizes(frame)
        h, w = frame.depth.shape[-2:]
        many = whole_is_faster(frame.hw, self.n, size) or whole_is_faster((h, w), self.n, reach)
        assert self.limits is not None
        widest = self.limits[1][0] + 2  # the block whose texture is asked, and a pixel around it
        if told is None or many or widest > min(MAX_COMPILED_WINDOW_PX, *frame.hw):
            return None
        _, steps = flatten_images(frame.image)
        shape = (reach, *steps, *frame.image.shape[1:], size)
        spots = self.kept[kind] = _Spots(frame.hw, uv, *told, probe_stride(frame.depth), shape)
        return spots


def _is_usual(picture: Tensor, depth: Tensor) -> bool:
    """Bytes and a map of words or single precision, which compiled code reads where they lie."""
    shaped = picture.ndim == 3 and depth.ndim == 2
    typed = picture.dtype == torch.uint8 and depth.dtype in (torch.int16, torch.float32)
    return shaped and typed and loader.serves(picture, depth)


def _told(views: SampleSpec, method: Method) -> tuple[ReturnLimits, tuple[int, float]] | None:
    """What the stages' options tell compiled code; None where it cannot do what they ask for."""
    seen, named = options(method.backproject, backproject), options(method.classify, classify)
    fixed = any(options(method.sample, sampler) is not None for sampler in _FIXED)
    more = (views.confidence, views.distortion, views.other_image, views.pose)
    if not fixed or seen is None or named is None or seen.pop("search_px") or any(x is not None for x in more):
        return None
    own_lens = isinstance(views.depth_intrinsics, str)
    if (
        views.sparse
        or own_lens
        or views.depth_unit not in SAMPLE_UNITS_PER_METRE
        or views.depth_range != (0.0, float("inf"))
    ):
        return None
    limits = ReturnLimits(**seen).told()
    return (limits, (named["block"], named["min_trackability"])) if 0 <= limits.min_conf <= 2 else None
