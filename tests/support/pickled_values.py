"""A value of every kind that a pickled ``.npy`` file may hold."""

import collections
from typing import Any

import numpy as np


def plain_values() -> dict[str, Any]:
    """Numbers, texts, arrays, scalars and containers that the reader accepts, as one dict."""
    return {
        "750612070851": [{"timestamp": 1_600_000_000_000, "tcp": np.arange(7.0), "ft": np.float64(2.5)}] * 2,
        "numbers": (0, 1, 255, 256, 65536, -1, -(2**31), 2**40, 2**62, 1.5, float("inf"), True, False, None),
        "texts": ["", "é", "x" * 300, b"", b"\x00\xff", bytes(range(256))],
        "arrays": [
            np.zeros((0, 3)),
            np.array(3.0),
            np.asfortranarray(np.arange(6).reshape(2, 3)),
            np.arange(3, dtype=">i4"),
            np.array(["ab", "c"]),
            np.array([True, False]),
            np.float16([1, 2]),
        ],
        "scalars": [np.int64(3), np.float32(0.5), np.str_("hey"), np.bool_(True)],
        "objects": np.array([None, {"x": 1}], dtype=object),
        "set": {1, 2},
        "ordered": collections.OrderedDict(a=1),
        "empty": [{}, [], ()],
    }
