"""Adapters of the transform to the hooks of LeRobot, openpi, OpenVLA and torchvision, without importing them.

LeRobot returns samples one by one, map-style or as a stream: :class:`ExtendedDataset`, :class:`ExtendedStream` wrap
the data set (its own ``image_transforms`` gets one image and no depth). openpi calls ``dict → dict`` with numpy
leaves: :class:`NumpyTransform`. OpenVLA calls ``batch_transform`` on an RLDS frame and then a collator for its own
keys: :class:`RldsBatchTransform`, :class:`AddedCollate`. In ``torchvision.transforms.v2.Compose`` the transform is used
directly, before any crop: a crop would not adapt the intrinsics. kornia's containers move the intrinsics within
:class:`dhtorch.transforms.kornia.AugmentSample`.
"""

import copy
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from dhtorch.data.depth_codes import find_return_range
from dhtorch.runtime.allocator import disable_malloc_trim
from dhtorch.transforms.extend_depth import ExtendDepth
from dhtorch.transforms.layout import UNREADABLE_KEY, conform, explain_difference, zeros_like
from dhtorch.transforms.sample_access import SampleError, drop_keys, get_value, has_key, to_tensor
from dhtorch.transforms.sample_spec import AUTO_UNIT, NO_LIMITS, SampleSpec


class _DatasetWrapper:
    """Base of wrappers: attributes that the wrapper lacks are those of the data set."""

    dataset: Any

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "dataset":
            raise AttributeError(name)
        return getattr(self.dataset, name)


class ExtendedDataset(_DatasetWrapper, Dataset[Any]):
    """Map-style data set -> the same data set with the transform applied to its items; other attributes are delegated.

    With ``gap`` the source view is the item ``gap`` places earlier in the same episode; it is added under the
    transform's ``other_image`` while the transform runs. Without such an item only the front end runs.

    A corrupt item, whose loading raises, is treated by the transform's ``on_error``: with ``flag`` it is replaced by
    zeros in the shapes of the first item that can be read, and its ``problem`` is UNREADABLE. So is an item that lacks
    a key of the transform, or has it with another type or shape: only these values become zeros.

    Args:
        dataset: ``dataset[i]`` is a dict.
        transform: for single samples; ``by_batch`` makes one for batches of it. With ``depth_unit="auto"`` the unit is
            that which the data set declares, see :func:`dhtorch.transforms.declared_depth_unit`; its depth's range
            (:func:`dhtorch.transforms.declared_depth_range`) limits ``depth_range`` in any case.
        gap: items from the source view to the reference view; None = the sample itself holds both.
        episode_key: key of the episode number; None = there is one episode.
        by_batch: items stay unchanged, and :meth:`collate`, then required as the loader's ``collate_fn``, transforms
            the whole batch in the worker: the same bits in less time.
        consumed: keys read by the transform that are not needed afterwards (the depth, the source view): they are
            dropped from items and batches, so that no worker copies them into shared memory.

    Raises:
        ValueError: a gap without ``other_image``; a transform for batches without ``by_batch``, or with it one made
            with ``batched=False`` or one that skips; a consumed key that the transform does not read;
            ``depth_unit="auto"`` of a data set that declares none.
    """

    def __init__(
        self,
        dataset: Any,
        transform: ExtendDepth,
        *,
        gap: int | None = None,
        episode_key: str | None = "episode_index",
        by_batch: bool = False,
        consumed: Sequence[str] = (),
    ) -> None:
        if gap is not None and (gap < 1 or transform.views.other_image is None):
            raise ValueError(f"gap is {gap}: expected a positive one, and a transform with other_image")
        transform = _as_declared(transform, dataset)
        if by_batch:
            transform = transform.with_options(batched=True)
        elif transform.batched:
            raise ValueError("found a transform for batches, expected one for single samples, or by_batch=True")
        if by_batch and transform.on_error == "skip":
            raise ValueError("on_error is 'skip', expected raise or flag where by_batch is set")
        keys = transform.views.keys()
        if isinstance(consumed, str) or not set(consumed) <= set(keys):
            raise ValueError(f"consumed is {consumed!r}, expected a list of some of {', '.join(keys)}")
        self.by_batch, self.consumed = by_batch, tuple(consumed)
        self.dataset, self.transform, self.gap, self.episode_key = dataset, transform, gap, episode_key
        views = transform.views
        # Keys added by a gap while the transform runs.
        other_pose = () if views.pose is None or views.other_pose is None else (views.other_pose,)
        self._gap_keys = (f"{views.other_image}", f"{views.other_image}_is_pad", *other_pose)
        # Zeros in the shapes of the first good item; empty = there is none, None = not looked for.
        self._layout: dict[str, Any] | None = None

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> dict[str, Any] | None:
        i = range(len(self))[index]
        try:
            sample = self._load(i)
        except Exception as error:  # any error of a decoder; lack of memory is no property of a sample
            if self.transform.on_error == "raise" or isinstance(error, MemoryError | torch.OutOfMemoryError):
                raise
            blank = {} if self.transform.on_error == "skip" else self._find_layout(i)
            if self.transform.on_error == "flag" and not blank:
                raise SampleError(f"neither item {i} nor its neighbours can be loaded: {error}") from error
            return self._left_out(dict(blank), f"item {i} cannot be loaded: {error}")
        if self.transform.on_error == "flag":
            like, keys = self._find_layout(i), (*self.transform.read_keys, *self._gap_keys)
            if difference := explain_difference(sample, like, keys):
                return self._left_out(conform(sample, like, keys), f"item {i}: {difference}")
        if self.by_batch:
            return self._marked(sample, False)
        return self._drop_internal(self.transform(sample))

    def _left_out(self, sample: dict[str, Any], reason: str) -> dict[str, Any] | None:
        """Item that is not read, with all keys -> result for it; of a loader by batch the item with its mark."""
        if not self.by_batch:
            return self._drop_internal(self.transform.left_out(sample, SampleError(reason)))
        warnings.warn(f"flagged: {reason}", stacklevel=4)
        return self._marked(sample, True)

    def _marked(self, sample: dict[str, Any], is_unreadable: bool) -> dict[str, Any]:
        """Item with the mark of those not read, where the transform flags them."""
        return sample if self.transform.on_error == "raise" else {**sample, UNREADABLE_KEY: is_unreadable}

    def collate(self, samples: Sequence[Any]) -> dict[str, Any]:
        """Samples -> batch by torch's default collate, with ``by_batch`` then transformed as a whole.

        Skipped samples are left out as by :func:`collate_kept`. In a worker the added tensors are views of one block
        of shared memory.
        """
        if not self.by_batch:
            skips = self.transform.on_error == "skip"
            return (collate_kept if skips else _collate_shared)(samples, self.transform.prefix)
        # In a worker torch collates into new shared memory, which is several times slower: consumed keys avoid that.
        consumed = {
            key: [to_tensor(get_value(sample, key), key, signed=False) for sample in samples]
            for key in self.consumed
            if has_key(samples[0], key)
        }
        views = self.transform.views
        stacked = {key: torch.stack(values) for key, values in consumed.items() if key != views.depth}
        if views.depth in consumed:
            stacked[views.metric_depth_key] = views.metres(consumed[views.depth])
        batch = default_collate([drop_keys(sample, consumed) for sample in samples] if consumed else list(samples))
        out = self._drop_internal(self.transform({**batch, **stacked} if stacked else batch)) or {}
        shareable = _shareable_tensors(out, self.transform.prefix)
        return {**out, **{key: place.copy_(shareable[key]) for key, place in _allocate_shared(shareable).items()}}

    def _drop_internal(self, out: dict[str, Any] | None) -> dict[str, Any] | None:
        """Drop the keys that a gap added, and the consumed keys."""
        dropped = (*self.consumed, self.transform.views.metric_depth_key) if self.consumed else ()
        dropped = (*dropped, UNREADABLE_KEY) if self.by_batch and self.transform.on_error == "flag" else dropped
        dropped = dropped if self.gap is None else (*dropped, *self._gap_keys)
        return drop_keys(out, dropped) if out is not None and dropped else out

    def _load(self, i: int) -> dict[str, Any]:
        """Item ``i``, with ``gap`` plus the source view from an earlier item."""
        sample = self.dataset[i]
        if not isinstance(sample, Mapping) and self.transform.on_error == "flag":
            raise SampleError(f"found {type(sample).__name__}, expected a dict with pictures and depth")
        views = self.transform.views
        if self.gap is None:
            other = views.other_image  # which a ``gap`` would add
            if isinstance(other, str) and not has_key(sample, other):
                expected = "gap=N, the items from the source view to the reference view, or that key in the items"
                raise SampleError(f"{other}: found no such key and no gap, expected {expected}")
            return sample
        earlier = self.dataset[i - self.gap] if i >= self.gap else sample
        key = self.episode_key
        same = i >= self.gap and (key is None or int(get_value(earlier, key)) == int(get_value(sample, key)))
        source = earlier if same else sample
        values = [get_value(source, views.image), torch.tensor([not same])]
        if len(self._gap_keys) > len(values):
            values.append(get_value(source, str(views.pose)))
        return {**sample, **dict(zip(self._gap_keys, values, strict=True))}

    def __repr__(self) -> str:
        gap = "the source view in each item" if self.gap is None else f"the source view {self.gap} items before"
        gap = gap if self.transform.views.other_image is not None else "no source view"
        return f"ExtendedDataset({len(self)} items of {type(self.dataset).__name__}, {gap}, {self.transform!r})"

    def _find_layout(self, i: int) -> dict[str, Any]:
        """Zeros in the shapes of the first item that can be read; of item ``i`` or its neighbours where the first
        cannot; empty where none of them can. Of either 16 at most are tried.
        """
        if self._layout is None:
            self._layout = {}
            near = [i, *(i + sign * step for step in range(1, 16) for sign in (1, -1))]
            for k in dict.fromkeys([*range(16), *near]):
                with suppress(Exception):  # corrupt as well
                    if 0 <= k < len(self) and not bool(self.transform.views.read(sample := self._load(k)).bad.any()):
                        self._layout = zeros_like(sample)
                        break
        return self._layout


class ExtendedStream(_DatasetWrapper, IterableDataset[Any]):
    """Iterable data set -> transformed samples; skipped ones are left out of the stream."""

    def __init__(self, dataset: Iterable[Any], transform: Callable[[Any], dict[str, Any] | None]) -> None:
        self.dataset = dataset
        reads_depth = isinstance(getattr(transform, "views", None), SampleSpec)
        self.transform = _as_declared(transform, dataset) if reads_depth else transform

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for sample in self.dataset:
            out = self.transform(sample)
            if out is not None:
                yield out


class NumpyTransform:
    """openpi's ``DataTransformFn``: dict → dict, with the added values as numpy arrays."""

    def __init__(self, transform: ExtendDepth) -> None:
        self.transform = transform

    def __call__(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """Sample -> copy with the added keys. Raises SampleError instead of skipping: openpi does not accept None."""
        out = self.transform(data)
        if out is None:
            raise SampleError("a sample cannot be skipped here: use on_error='flag'")
        return {k: v.numpy(force=True) if k.startswith(self.transform.prefix) else v for k, v in out.items()}


class RldsBatchTransform:
    """OpenVLA's ``batch_transform`` plus the keys that the transform adds to the same frame."""

    def __init__(self, batch_transform: Callable[[Any], Mapping[str, Any]], transform: ExtendDepth) -> None:
        self.batch_transform, self.transform = batch_transform, transform

    def __call__(self, rlds_batch: Mapping[str, Any]) -> dict[str, Any]:
        """RLDS frame -> dict of the wrapped ``batch_transform`` plus the added keys."""
        out = self.transform(rlds_batch)
        if out is None:
            raise SampleError("a sample cannot be skipped here: use on_error='flag'")
        added = {k: v for k, v in out.items() if k.startswith(self.transform.prefix)}
        return {**self.batch_transform(rlds_batch), **added}


class AddedCollate:
    """A collator for fixed keys, extended by the stacked keys that the transform added."""

    def __init__(self, collate: Callable[[Sequence[Any]], Mapping[str, Any]], prefix: str = "dhtorch.") -> None:
        self.collate, self.prefix = collate, prefix

    def __call__(self, instances: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Samples -> batch."""
        added = [{k: v for k, v in sample.items() if k.startswith(self.prefix)} for sample in instances]
        return {**self.collate(instances), **_collate_shared(added, self.prefix)}


def collate_kept(samples: Sequence[dict[str, Any] | None], prefix: str = "dhtorch.") -> dict[str, Any]:
    """Samples, None if skipped -> batch by torch's default collate; ``dhtorch.skipped`` counts the skipped ones.

    A batch whose samples were all skipped holds only that number. In a worker the tensors under keys with ``prefix``
    are views of one block of shared memory.
    """
    kept = [sample for sample in samples if sample is not None]
    skipped = torch.tensor(len(samples) - len(kept))
    return {**(_collate_shared(kept, prefix) if kept else {}), "dhtorch.skipped": skipped}


def one_thread(worker: int = 0) -> None:
    """Set one thread for torch and OpenCV: the ``worker_init_fn`` of a data loader, whose workers run in parallel.

    Where supported, a worker also keeps freed memory (:func:`dhtorch.runtime.allocator.disable_malloc_trim`), because
    its next batch needs as much.
    """
    torch.set_num_threads(1)
    disable_malloc_trim()
    opencv = sys.modules.get("cv2")
    if opencv is not None:
        opencv.setNumThreads(0)  # 1 would wait for the threads of the pool, which do not exist in a forked worker


# ----------------------------------------------------------------------- one block of shared memory for what is added
#
# Otherwise each tensor that a worker returns is a shared-memory file of its own, whose handle the main process requests
# from the worker while that computes its next batch: seventeen times a batch, whatever their size. The keys are views
# of the block: keeping one of them keeps all.


def _collate_shared(samples: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, Any]:
    """Samples -> batch by torch's default collate; in a worker tensors under keys with ``prefix`` share one block.

    Raises RuntimeError if the shapes of samples differ, KeyError if a sample lacks a key, as the default collate does.
    """
    shareable = _shareable_tensors(samples[0], prefix)
    if not shareable:
        return default_collate(list(samples))
    batch = default_collate([{k: v for k, v in sample.items() if k not in shareable} for sample in samples])
    for key, place in _allocate_shared(shareable, len(samples)).items():
        batch[key] = torch.stack([sample[key] for sample in samples], out=place)
    return batch


def _shareable_tensors(batch: Mapping[str, Any], prefix: str) -> dict[str, Tensor]:
    """Dense CPU tensors under keys with ``prefix``, in a worker; none outside a worker."""
    if get_worker_info() is None:
        return {}
    tensors = {key: x for key, x in batch.items() if key.startswith(prefix) and type(x) is Tensor}
    return {key: x for key, x in tensors.items() if x.is_cpu and x.layout == torch.strided}


def _allocate_shared(like: Mapping[str, Tensor], *front: int) -> dict[str, Tensor]:
    """Tensors -> empty tensors of shape (``front``, …) and the same dtypes, consecutive in one shared block."""
    shapes = {key: (*front, *x.shape) for key, x in like.items()}
    sizes = [math.prod(shapes[key]) * x.element_size() for key, x in like.items()]
    # Aligned to 64 bytes: vector registers and cache lines.
    starts = list(accumulate((size + -size % 64 for size in sizes), initial=0))
    block = torch.empty(starts[-1], dtype=torch.uint8, device="cpu").share_memory_()
    rows = zip(like.items(), starts[:-1], sizes, strict=True)
    return {key: block[at : at + size].view(x.dtype).view(shapes[key]) for (key, x), at, size in rows}


# --------------------------------------------------------------- unit and range of depth, as LeRobot data sets declare

#: Unit of a decoded depth video -> largest error of its rounding, m. Source: derived: LeRobot 0.6 rounds to whole
#: millimetres and not at all in metres; a hundredth of a millimetre for its arithmetic in float32.
_ROUNDING_M = {"m": 0.0, "mm": 0.51e-3}


def declared_depth_unit(dataset: Any, key: str) -> str:
    """LeRobot data set and key of its depth -> unit of the depth in its items, ``m`` or ``mm``.

    LeRobot 0.6 and later convert depth that is an image with a stated ``depth_unit``, or a video, into the data set's
    ``depth_output_unit``; earlier versions hand out what is stored, and all of them arrays of numbers.

    Raises:
        ValueError: a data set that declares none: nothing is inferred from the numbers.
    """
    features = getattr(getattr(dataset, "meta", None), "features", None)
    if not isinstance(features, Mapping):
        raise ValueError(f"depth_unit=auto: found {type(dataset).__name__}, expected a LeRobot data set; else m or mm")
    if key not in features:
        raise ValueError(f"depth_unit=auto: found no feature {key}, expected one of {', '.join(features)}")
    feature = features[key]
    info = feature.get("info") or {}
    stored = info.get("depth_unit")
    if feature["dtype"] in ("image", "video") and (converts := _output_unit(dataset, key)):
        unit = converts if feature["dtype"] == "video" or stored is not None else None
    else:
        unit = None if feature["dtype"] == "video" else stored or info.get("unit")
    if unit not in ("m", "mm"):
        feature_text = f"{key} ({feature['dtype']}) without a unit that this LeRobot declares"
        expected = "depth_unit in its info; else depth_unit='m' or 'mm'"
        raise ValueError(f"depth_unit=auto: found {feature_text}, expected {expected}")
    return str(unit)


def declared_depth_range(dataset: Any, key: str) -> tuple[float, float]:
    """LeRobot data set and key of its depth -> lower and upper limit in m of returns, for ``depth_range``.

    A depth video has no code for *no return*: LeRobot hands out its two ends, ``depth_min`` and ``depth_max``, instead.
    Depth in another form, of other data sets or of versions that decode no depth has no limits, (0, inf).

    Raises:
        FormatError: the data set states an invalid range.
    """
    features = getattr(getattr(dataset, "meta", None), "features", None)
    feature = features.get(key) if isinstance(features, Mapping) else None
    unit = _output_unit(dataset, key) if feature is not None and feature["dtype"] == "video" else None
    if feature is None or unit is None:
        return NO_LIMITS
    return find_return_range(feature.get("info") or {}, key, Path("meta") / "info.json", _ROUNDING_M[unit])


def _output_unit(dataset: Any, key: str) -> str | None:
    """Unit into which LeRobot converts a depth image or video; None if it is not marked as depth, and before 0.6."""
    unit = getattr(dataset, "depth_output_unit", None)
    return unit if unit in _ROUNDING_M and key in (getattr(dataset.meta, "depth_keys", None) or ()) else None


def _as_declared(transform: Any, dataset: Any) -> Any:
    """Transform -> the same with the range of depth that the data set declares, and its unit for ``"auto"``."""
    views = transform.views
    low, high = declared_depth_range(dataset, views.depth)
    changes: dict[str, Any] = {}
    if views.depth_unit == AUTO_UNIT:
        changes["depth_unit"] = declared_depth_unit(dataset, views.depth)
    if (low, high) != NO_LIMITS:
        changes["depth_range"] = max(low, views.depth_range[0]), min(high, views.depth_range[1])
    if not changes:
        return transform
    other = copy.copy(transform)
    other.views = replace(views, **changes)
    return other
