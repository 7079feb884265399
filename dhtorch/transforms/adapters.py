"""The transform in other people's pipelines: each adapter fits a hook that exists there, and imports nothing of theirs.

LeRobot hands samples out one by one, map-style or as a stream: :class:`ExtendedDataset`, :class:`ExtendedStream` wrap
the data set (its own ``image_transforms`` sees one picture and no depth). openpi calls ``dict → dict`` with numpy
leaves: :class:`NumpyTransform`. OpenVLA calls ``batch_transform`` on an RLDS frame and then a collator that knows its
keys: :class:`RldsBatchTransform`, :class:`AddedCollate`. In ``torchvision.transforms.v2.Compose`` the transform itself
stands as it is, before anything that crops: a crop would not move the intrinsics.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset, default_collate

from dhtorch.runtime.allocator import disable_malloc_trim
from dhtorch.transforms.collate import collate_shared, pack_shared
from dhtorch.transforms.extend_depth import ExtendDepth
from dhtorch.transforms.sample_access import SampleError, drop_keys, get_value, has_key, to_tensor

#: Neighbours asked for the shapes of a sample that could not be loaded.
_MAX_NEIGHBOURS_TRIED = 16


class _DatasetWrapper:
    """What a wrapper does not know itself, its data set does."""

    dataset: Any

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "dataset":
            raise AttributeError(name)
        return getattr(self.dataset, name)


class ExtendedDataset(_DatasetWrapper, Dataset[Any]):
    """A map-style data set whose items went through the transform; everything else is the data set's own.

    With ``gap`` the other view is the item so many places before, of the same episode; it is put under the
    transform's ``other_image`` while the transform runs. Where an episode has no such item the front end runs alone.

    A corrupt item, whose loading raises, is treated as the transform's ``on_error`` says: with ``flag`` it is replaced
    by zeros in the shapes of a neighbour, and its ``problem`` is UNREADABLE.

    Args:
        dataset: ``dataset[i]`` is a dict.
        transform: for single samples; with ``by_batch`` for batches.
        gap: places from the other view to the reference view; None = the sample itself holds both.
        episode_key: key of a number that items of one episode share; None = there is one episode.
        by_batch: items stay as they are, and :meth:`collate`, then needed as the loader's ``collate_fn``, extends the
            whole batch in the worker: the same bits in less time.
        consumed: keys among those that the transform reads, of which nobody has a use afterwards (the depth, the other
            view): items and batches come without them, so that no worker copies them into shared memory.

    Raises:
        ValueError: a gap without ``other_image``; a transform for batches without ``by_batch``, or with it one for
            single samples or one that does not raise; a consumed key that the transform does not read.
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
        if transform.batched != by_batch:
            single = "single samples, expected ExtendDepth(batched=True)"
            batches = "batches, expected one for single samples, or by_batch=True"
            raise ValueError(f"found a transform for {single if by_batch else batches}")
        if by_batch and transform.on_error != "raise":
            raise ValueError(f"on_error is {transform.on_error!r}, expected raise where by_batch is set")
        keys = transform.views.keys()
        if isinstance(consumed, str) or not set(consumed) <= set(keys):
            raise ValueError(f"consumed is {consumed!r}, expected a list of some of {', '.join(keys)}")
        self.by_batch, self.consumed = by_batch, tuple(consumed)
        self.dataset, self.transform, self.gap, self.episode_key = dataset, transform, gap, episode_key
        views = transform.views
        self._lent: tuple[str, ...] = (
            f"{views.other_image}",
            f"{views.other_image}_is_pad",
        )  # what a gap puts in, for the transform
        if views.pose is not None and views.other_pose is not None:
            self._lent += (views.other_pose,)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> dict[str, Any] | None:
        i = range(len(self))[index]
        try:
            sample = self._loaded(i)
            if self.by_batch:
                return sample
        except Exception as error:  # whatever a decoder raises; lack of memory is no property of a sample
            if self.transform.on_error == "raise" or isinstance(error, MemoryError | torch.OutOfMemoryError):
                raise
            zeros = {} if self.transform.on_error == "skip" else self._zeros_like_neighbour(i, error)
            out = self.transform.left_out(zeros, SampleError(f"item {i} cannot be loaded: {error}"))
            return self._returned(out)
        return self._returned(self.transform(sample))

    def collate(self, samples: Sequence[Any]) -> dict[str, Any]:
        """One batch, collated as torch does, with ``by_batch`` then extended as a whole; skipped samples are left out,
        as :func:`collate_kept` does. From a worker what was added comes as views of one piece of shared memory."""
        if not self.by_batch:
            skips = self.transform.on_error == "skip"
            return (collate_kept if skips else collate_shared)(samples, self.transform.prefix)
        return pack_shared(self._extended(samples), self.transform.prefix)

    def _extended(self, samples: Sequence[Any]) -> dict[str, Any]:
        """A whole batch of samples that the transform has not seen."""
        # In a worker torch collates into memory that it shares: page by page a new one, several times as slow.
        gone = {key: _collect_key(samples, key) for key in self.consumed if has_key(samples[0], key)}
        views = self.transform.views
        own = {key: torch.stack(found) for key, found in gone.items() if key != views.depth}
        if views.depth in gone:
            own[views.in_metres] = views.metres(gone[views.depth])
        batch = default_collate([drop_keys(sample, gone) for sample in samples] if gone else list(samples))
        return self._returned(self.transform({**batch, **own} if own else batch)) or {}

    def _returned(self, out: dict[str, Any] | None) -> dict[str, Any] | None:
        """Without what a gap lent, and what was consumed."""
        gone = (*self.consumed, self.transform.views.in_metres) if self.consumed else ()
        gone = gone if self.gap is None else (*gone, *self._lent)
        return drop_keys(out, gone) if out is not None and gone else out

    def _loaded(self, i: int) -> dict[str, Any]:
        """The item, with the other view where it comes from another item."""
        sample = self.dataset[i]
        if self.gap is None:
            return sample
        earlier = self.dataset[i - self.gap] if i >= self.gap else sample
        same = i >= self.gap and self._episode(earlier) == self._episode(sample)
        views, source = self.transform.views, earlier if same else sample
        found = [get_value(source, views.image), torch.tensor([not same])]
        if len(self._lent) > len(found):
            found.append(get_value(source, str(views.pose)))
        return {**sample, **dict(zip(self._lent, found, strict=True))}

    def _episode(self, sample: Mapping[str, Any]) -> int:
        return 0 if self.episode_key is None else int(get_value(sample, self.episode_key))

    def _zeros_like_neighbour(self, i: int, error: Exception) -> dict[str, Any]:
        """Zeros in the shapes of the nearest item that can be loaded."""
        for k in (i + sign * step for step in range(1, _MAX_NEIGHBOURS_TRIED) for sign in (1, -1)):
            if not 0 <= k < len(self):
                continue
            try:
                return {key: _zeros_like(value) for key, value in self.dataset[k].items()}
            except Exception:
                continue  # as corrupt as the first
        raise SampleError(f"neither item {i} nor its neighbours can be loaded: {error}") from error


class ExtendedStream(_DatasetWrapper, IterableDataset[Any]):
    """An iterable data set whose samples went through the transform; skipped ones are left out of the stream."""

    def __init__(self, dataset: Iterable[Any], transform: Callable[[Any], dict[str, Any] | None]) -> None:
        self.dataset, self.transform = dataset, transform

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for sample in self.dataset:
            out = self.transform(sample)
            if out is not None:
                yield out


class NumpyTransform:
    """openpi's ``DataTransformFn``: the same dict → dict, what is added as numpy arrays."""

    def __init__(self, transform: ExtendDepth) -> None:
        self.transform = transform

    def __call__(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """The dict with our keys. Raises SampleError where the transform would skip: openpi knows no None."""
        out = self.transform(data)
        if out is None:
            raise SampleError("a sample cannot be skipped here: use on_error='flag'")
        return {k: v.numpy(force=True) if k.startswith(self.transform.prefix) else v for k, v in out.items()}


class RldsBatchTransform:
    """OpenVLA's ``batch_transform``: the given one, and what ours adds to the same frame."""

    def __init__(self, batch_transform: Callable[[Any], Mapping[str, Any]], transform: ExtendDepth) -> None:
        self.batch_transform, self.transform = batch_transform, transform

    def __call__(self, rlds_batch: Mapping[str, Any]) -> dict[str, Any]:
        """The given transform's dict with our keys."""
        out = self.transform(rlds_batch)
        if out is None:
            raise SampleError("a sample cannot be skipped here: use on_error='flag'")
        mine = {k: v for k, v in out.items() if k.startswith(self.transform.prefix)}
        return {**self.batch_transform(rlds_batch), **mine}


class AddedCollate:
    """A collator that knows its own keys only, and the stacked keys that the transform added."""

    def __init__(self, collate: Callable[[Sequence[Any]], Mapping[str, Any]], prefix: str = "dhtorch.") -> None:
        self.collate, self.prefix = collate, prefix

    def __call__(self, instances: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """One batch."""
        mine = [{k: v for k, v in one.items() if k.startswith(self.prefix)} for one in instances]
        return {**self.collate(instances), **collate_shared(mine, self.prefix)}


def collate_kept(samples: Sequence[dict[str, Any] | None], prefix: str = "dhtorch.") -> dict[str, Any]:
    """torch's default collate without the samples that were skipped; ``dhtorch.skipped`` tells how many.

    A batch of which every sample was skipped holds nothing but that number. From a worker what begins with ``prefix``
    comes as views of one piece of shared memory.
    """
    kept = [sample for sample in samples if sample is not None]
    skipped = torch.tensor(len(samples) - len(kept))
    return {**(collate_shared(kept, prefix) if kept else {}), "dhtorch.skipped": skipped}


def one_thread(worker: int = 0) -> None:
    """One thread for torch and OpenCV: the ``worker_init_fn`` of a data loader. Workers are the parallelism there.

    A worker also keeps what it frees, where that can be asked for
    (:func:`dhtorch.runtime.allocator.disable_malloc_trim`): its next batch asks for the same memory.
    """
    torch.set_num_threads(1)
    disable_malloc_trim()
    opencv = sys.modules.get("cv2")
    if opencv is not None:
        opencv.setNumThreads(0)  # 1 would wait for the threads of the pool, which a forked worker does not have


def _collect_key(samples: Sequence[Any], key: str) -> list[torch.Tensor]:
    """What lies under a key of each sample."""
    return [to_tensor(get_value(sample, key), key, signed=False) for sample in samples]


def _zeros_like(value: Any) -> Any:
    """Nothing, in the shape and type of a value."""
    if isinstance(value, Mapping):
        return {k: _zeros_like(v) for k, v in value.items()}
    if isinstance(value, str | bytes):
        return type(value)()
    if isinstance(value, list | tuple):
        return type(value)(_zeros_like(v) for v in value)
    if isinstance(value, bool | int | float):
        return type(value)(0)
    return torch.zeros_like(value) if isinstance(value, torch.Tensor) else np.zeros_like(value)
