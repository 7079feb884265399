"""dhtorch inside a data loader: :class:`ExtendDepth` takes a sample dict and returns it with what the depth tells.

transform = ExtendDepth(image="observation.images.wrist", depth="observation.depth.wrist", depth_unit="mm")
dataset = ExtendedDataset(dataset, transform)
loader = DataLoader(dataset, collate_fn=dataset.collate, num_workers=2, worker_init_fn=one_thread)
"""

from dhtorch.transform.adapters import (
    AddedCollate,
    ExtendedDataset,
    ExtendedStream,
    NumpyTransform,
    RldsBatchTransform,
    collate_kept,
    one_thread,
)
from dhtorch.transform.extend_depth import ExtendDepth
from dhtorch.transform.judge_depth import JudgeDepth
from dhtorch.transform.leaves import SampleError
from dhtorch.transform.maps import Maps
from dhtorch.transform.problems import SampleProblem
from dhtorch.transform.tokens import CHANNELS, grid, patch_tokens
from dhtorch.transform.views import Views

__all__ = [
    "CHANNELS",
    "AddedCollate",
    "ExtendDepth",
    "ExtendedDataset",
    "ExtendedStream",
    "JudgeDepth",
    "Maps",
    "NumpyTransform",
    "RldsBatchTransform",
    "SampleError",
    "SampleProblem",
    "Views",
    "collate_kept",
    "grid",
    "one_thread",
    "patch_tokens",
]
