"""Pairs of a recording, loaded in batches for a protocol, and chunks of frames for the probes."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dhtorch import pytree
from dhtorch.data.io.decode import set_opencv_threads
from dhtorch.data.pairs import Pair, spaced_frames
from dhtorch.data.recording import Recording, TruthRecording
from dhtorch.data.rig import Rig
from dhtorch.records import Frame
from dhtorch.runtime.parent_watch import exit_with_parent
from dhtorch.stages.track_chain import frames_between

CandidateViews = Callable[[Recording, int], Sequence[int]]  # (recording, reference view) → positions of source views

#: (reference view, source views, reference view with its true depth, kinds of surface, disagreement of truth and
#: sensor, candidate views around it, images between reference view and source view)
LoadedPair = tuple[Frame, tuple[Frame, ...], Frame, Tensor, Tensor, tuple[Frame, ...], tuple[Tensor, ...]]


class PairDataset(Dataset[LoadedPair]):
    """Data set of the pairs of one recording."""

    def __init__(
        self,
        recording: Recording,
        pairs: Sequence[Pair],
        dtype: torch.dtype,
        views: int = 1,
        offers: CandidateViews | None = None,
        between: int = 0,
    ) -> None:
        self.recording, self.pairs, self.dtype, self.views, self.offers = recording, pairs, dtype, views, offers
        self.between = between

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> LoadedPair:
        i, other = pair = Pair(*self.pairs[index])
        pair_views = spaced_frames(i, other, self.views) if isinstance(other, int) else []
        candidates = candidate_views(pair, self.recording, self.offers)
        positions_between = images_between(pair, self.recording, self.between)
        wanted = sorted({i, *pair_views, *candidates, *positions_between})
        frames = {k: self.recording[k].to(self.dtype) for k in wanted}
        reference = frames[i]
        others, candidate_frames = (tuple(frames[k] for k in positions) for positions in (pair_views, candidates))
        between = tuple(frames[k].image for k in positions_between)
        if not isinstance(self.recording, TruthRecording):
            no_kinds = torch.zeros(1, 1, 1)
            unknown = torch.full((1,), torch.nan)
            return reference, others, reference, no_kinds, unknown, candidate_frames, between
        exact = self.recording.truth(i)
        true_reference = reference.replace(depth=exact["depth"].to(self.dtype), depth_camera=None)
        disagreement = exact.get("disagreement", torch.full((1,), torch.nan))
        return reference, others, true_reference, exact["surface"].float(), disagreement, candidate_frames, between


def load_pairs(data: PairDataset, *, batch: int, workers: int) -> DataLoader[LoadedPair]:
    """Data loader of the pairs, in batches of ``batch``, read by ``workers`` processes."""
    return _make_loader(data, _collate, batch=batch, workers=workers if len(data) else 0)


def _make_loader(
    data: Dataset[Any], collate: Callable[[Any], Any], *, batch: int | None, workers: int
) -> DataLoader[Any]:
    """Data loader with started workers: a fork would copy locks held by threads of torch and OpenCV in this process,
    and may deadlock."""
    return DataLoader(
        data,
        batch_size=batch,
        num_workers=workers,
        collate_fn=collate,
        worker_init_fn=_init_worker,
        multiprocessing_context="spawn" if workers else None,
    )


#: Frames of one recording that go through one forward pass: rows of positions, such as (frame, second view), and
#: whether also the true depth of the first frame of each row, of a TruthRecording.
FrameChunk = tuple[Recording, Sequence[tuple[int, ...]], bool]

#: Rows of frames, and by row the true depth (1, H, W) of its first frame, empty without truth.
LoadedChunk = tuple[list[tuple[Frame, ...]], list[Tensor]]


class _ChunkDataset(Dataset[LoadedChunk]):
    """Data set of chunks of frames, of any recordings; a position is read once per chunk."""

    def __init__(self, chunks: Sequence[FrameChunk], dtype: torch.dtype) -> None:
        self.chunks, self.dtype = chunks, dtype

    def __len__(self) -> int:
        return len(self.chunks)

    def __getitem__(self, index: int) -> LoadedChunk:
        recording, rows, with_truth = self.chunks[index]
        frames = {k: recording[k].to(self.dtype) for k in sorted({k for row in rows for k in row})}
        truth: list[Tensor] = []
        if with_truth and isinstance(recording, TruthRecording):
            truth = [recording.truth(row[0])["depth"].to(self.dtype) for row in rows]
        return [tuple(frames[k] for k in row) for row in rows], truth


def read_chunks(chunks: Sequence[FrameChunk], dtype: torch.dtype, workers: int) -> Iterator[LoadedChunk]:
    """Read chunks in order, in ``workers`` processes that start once for all of them (0: in this process)."""
    data = _ChunkDataset(chunks, dtype)
    return iter(_make_loader(data, _unchanged, batch=None, workers=min(workers, len(data))))


def _unchanged(item: Any) -> Any:
    return item


def candidate_views(pair: Pair, recording: Recording, offers: CandidateViews | None) -> Sequence[int]:
    """Positions of the candidate views of a pair; empty if it has a source view of its own."""
    return pair.candidates or (() if offers is None else offers(recording, pair.reference))


def images_between(pair: Pair, recording: Recording, most: int) -> list[int]:
    """Positions of at most ``most`` frames between the two of a pair; none of a rig, where these are other cameras."""
    if not isinstance(pair.other, int) or isinstance(recording, Rig):
        return []
    return frames_between(pair.reference, pair.other, most)


def _collate(items: list[LoadedPair]) -> LoadedPair:
    reference, others, exact, surface, disagreement, around, between = zip(*items, strict=True)
    views, candidates = (tuple(pytree.collate(v) for v in zip(*columns, strict=True)) for columns in (others, around))
    return (
        pytree.collate(reference),
        views,
        pytree.collate(exact),
        torch.cat(surface),
        torch.cat(disagreement),
        candidates,
        tuple(torch.cat(images) for images in zip(*between, strict=True)),
    )


def move_to_device(item: Any, device: str) -> Any:
    """Nested tuples of tensors and records → the same on a device."""
    return tuple(move_to_device(i, device) for i in item) if isinstance(item, tuple) else item.to(device)


def _init_worker(_number: int) -> None:
    """Initialise a loader's worker: one thread, and exit together with the parent process."""
    exit_with_parent()
    torch.set_num_threads(1)
    set_opencv_threads(1)
