"""dhtorch inside a data loader: :class:`ExtendDepth` maps a sample dict to the same dict plus far depth.

transform = ExtendDepth(image="observation.images.wrist", depth="observation.images.wrist_depth", depth_unit="auto")
dataset = ExtendedDataset(dataset, transform)
loader = DataLoader(dataset, collate_fn=dataset.collate, num_workers=2, worker_init_fn=one_thread)
"""

from dhtorch.transforms.adapters import (
    AddedCollate,
    ExtendedDataset,
    ExtendedStream,
    NumpyTransform,
    RldsBatchTransform,
    collate_kept,
    declared_depth_range,
    declared_depth_unit,
    one_thread,
)
from dhtorch.transforms.extend_depth import ExtendDepth
from dhtorch.transforms.maps import DenseMaps
from dhtorch.transforms.sample_access import SampleError
from dhtorch.transforms.sample_spec import SampleSpec
from dhtorch.transforms.schema import SampleProblem
from dhtorch.transforms.tokens import TOKEN_CHANNELS, patch_tokens, token_grid
from dhtorch.transforms.validate_depth import ValidateDepth

__all__ = [
    "TOKEN_CHANNELS",
    "AddedCollate",
    "DenseMaps",
    "ExtendDepth",
    "ExtendedDataset",
    "ExtendedStream",
    "NumpyTransform",
    "RldsBatchTransform",
    "SampleError",
    "SampleProblem",
    "SampleSpec",
    "ValidateDepth",
    "collate_kept",
    "declared_depth_range",
    "declared_depth_unit",
    "one_thread",
    "patch_tokens",
    "token_grid",
]
