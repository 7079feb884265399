"""What the transform adds to a batch leaves a worker in one piece of shared memory.

Each tensor that a worker returns is otherwise a piece of its own, which the system has to make and for which the main
process has to ask the worker, while that is at its next batch: seventeen times a batch, however little they hold. The
keys are views of the piece: whoever keeps one of them keeps all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import default_collate, get_worker_info

#: Bytes at whose multiples tensors begin, as vectors and caches like them.
_ALIGNMENT_BYTES = 64


def collate_shared(samples: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, Any]:
    """torch's default collate; in a worker tensors under keys that begin with ``prefix`` (B, …) lie in one piece.

    Raises RuntimeError where the shapes of samples differ, KeyError where a sample lacks a key, as that does.
    """
    mine = _shareable_tensors(samples[0], prefix)
    if not mine:
        return default_collate(list(samples))
    batch = default_collate([{k: v for k, v in sample.items() if k not in mine} for sample in samples])
    for key, place in _allocate_shared(mine, len(samples)).items():
        batch[key] = torch.stack([sample[key] for sample in samples], out=place)
    return batch


def pack_shared(batch: dict[str, Any], prefix: str) -> dict[str, Any]:
    """A batch whose tensors under keys that begin with ``prefix`` lie in one piece, in a worker; elsewhere itself."""
    mine = _shareable_tensors(batch, prefix)
    if not mine:
        return batch
    return {**batch, **{key: place.copy_(mine[key]) for key, place in _allocate_shared(mine).items()}}


def _shareable_tensors(found: Mapping[str, Any], prefix: str) -> dict[str, Tensor]:
    """Tensors that leave a worker and can share their memory; none outside a worker."""
    if get_worker_info() is None:
        return {}
    own = {key: x for key, x in found.items() if key.startswith(prefix) and type(x) is Tensor}
    return {key: x for key, x in own.items() if x.is_cpu and x.layout == torch.strided}


def _allocate_shared(like: Mapping[str, Tensor], *front: int) -> dict[str, Tensor]:
    """Empty tensors of the shapes (``front``, …) and types of others, one after the other in one shared piece."""
    shapes = {key: (*front, *x.shape) for key, x in like.items()}
    sizes = [math.prod(shapes[key]) * x.element_size() for key, x in like.items()]
    begins = list(accumulate((size + -size % _ALIGNMENT_BYTES for size in sizes), initial=0))
    piece = torch.empty(begins[-1], dtype=torch.uint8).share_memory_()
    rows = zip(like.items(), begins[:-1], sizes, strict=True)
    return {key: piece[at : at + size].view(x.dtype).view(shapes[key]) for (key, x), at, size in rows}
