"""Collate samples so that the tensors added to a batch leave a worker in one block of shared memory.

Otherwise each tensor that a worker returns is a shared-memory file of its own, whose handle the main process requests
from the worker while that computes its next batch: seventeen times a batch, whatever their size. The keys are views of
the block: keeping one of them keeps all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import default_collate, get_worker_info

#: Alignment of the tensors in the block, bytes: vector registers and cache lines.
_ALIGNMENT_BYTES = 64


def collate_shared(samples: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, Any]:
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


def pack_shared(batch: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Batch -> batch whose tensors under keys with ``prefix`` share one block in a worker; elsewhere unchanged."""
    shareable = _shareable_tensors(batch, prefix)
    if not shareable:
        return batch
    return {**batch, **{key: place.copy_(shareable[key]) for key, place in _allocate_shared(shareable).items()}}


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
    starts = list(accumulate((size + -size % _ALIGNMENT_BYTES for size in sizes), initial=0))
    block = torch.empty(starts[-1], dtype=torch.uint8, device="cpu").share_memory_()
    rows = zip(like.items(), starts[:-1], sizes, strict=True)
    return {key: block[at : at + size].view(x.dtype).view(shapes[key]) for (key, x), at, size in rows}
