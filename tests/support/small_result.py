"""A small valid result file as a dict, and the key of its job."""

import math
from functools import cache

import numpy as np
import torch

from dhtorch.runtime import results as result_files

KEY = "0123456789abcdef" * 4


@cache
def meta_now():
    """Metadata of a run in this process, collected once."""
    return result_files.collect_run_metadata(device="cpu", dtype=torch.float32, threads=1, seed=0, operators="torch")


def result(**changes):
    """A result of one pair with two rows and values of every kind, with fields replaced."""
    parts = {
        "experiment": "pair",
        "key": KEY,
        "meta": meta_now(),
        "config": {"method": {"n": 2048}, "holdout": {"cutoff": math.inf}},
        "data": {"name": "room", "scenes": ["room"], "n_pairs": 1, "digest": result_files.compute_data_digest({})},
        "summary": {"coverage": {"value": 0.5, "low": None, "high": None, "n": 1, "unit": "1"}},
        "rows": [
            {
                "scene": "room",
                "pair": (0, 5),
                "method": "paper",
                "n_kept": np.int64(3),
                "median_rel": torch.tensor(0.5),
            },
            {"scene": "room", "pair": None, "method": "paper", "corr": math.nan, "ms": {"track": np.float32(1.5)}},
        ],
    }
    return result_files.build_result(**{**parts, **changes})
