"""Batches of a ``DataLoader`` with or without workers, and the features in them joined row by row."""

import torch
from torch.utils.data import DataLoader

from dhtorch.transforms import one_thread


def load_batches(dataset, workers, context=None, batch=2, **options):
    """All batches of a data set, and the loader; ``context`` is how its worker processes are started."""
    loader = DataLoader(
        dataset,
        batch,
        num_workers=workers,
        multiprocessing_context=context,
        worker_init_fn=one_thread if workers else None,
        timeout=120 if workers else 0,
        **options,
    )
    return list(loader), loader


def join_features(batches):
    """{name: tensor over all rows} of the keys that :class:`dhtorch.transforms.ExtendDepth` added."""
    return {
        k: torch.cat([b[k] for b in batches]) for k in batches[0] if k.startswith("dhtorch.") and k != "dhtorch.skipped"
    }
