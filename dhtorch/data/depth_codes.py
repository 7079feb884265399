"""Codes of LeRobot's depth videos: their depth in metres, and the range of those that are returns.

The 12-bit codes, by default logarithmic, span ``depth_min`` to ``depth_max``. The encoder clips *no return* to the
nearest distance and everything too far to the farthest; the two codes at either end are therefore read as no return,
also where LeRobot has decoded the video.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from dhtorch.runtime.safe_open import FormatError

CODE_BITS: Final = 12
N_CODES: Final = 2**CODE_BITS

#: Range of the codes and offset of their logarithm where the feature's info states none, m. Source: LeRobot 0.6.
DEFAULT_RANGE: Final = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5}


def metres_by_code(info: Mapping[str, Any], key: str, file: Path) -> np.ndarray:
    """Depth (:data:`N_CODES`,) in m of every code, from ``depth_min`` to ``depth_max``.

    Args:
        info: of the video's feature.
        key, file: of the feature, named in errors.

    Raises:
        FormatError: an invalid range.
    """
    numbers = [info.get(f"video.{name}", info.get(name, default)) for name, default in DEFAULT_RANGE.items()]
    log = info.get("video.use_log", info.get("use_log", True))
    are_numbers = all(isinstance(x, int | float) and abs(x) <= 1e4 for x in numbers)
    low, high, shift = numbers if are_numbers else (0.0, 0.0, 0.0)
    if not 0 <= low < high or (log and low + shift <= 1e-6):  # only the logarithm needs a shift
        raise FormatError(file, f"{key} {', '.join(DEFAULT_RANGE)}", numbers, "a range of metres")
    fraction = np.arange(N_CODES) / (N_CODES - 1)
    if log:
        return np.exp((1 - fraction) * np.log(low + shift) + fraction * np.log(high + shift)) - shift
    return low + fraction * (high - low)


def find_return_range(info: Mapping[str, Any], key: str, file: Path, rounding: float = 0.0) -> tuple[float, float]:
    """Lower and upper limit in m of the returns: the two codes at either end lie outside.

    Args:
        info: of the video's feature.
        key, file: of the feature, named in errors.
        rounding: largest error in m of the decoded depth; returns as near to an end code are left out as well.

    Raises:
        FormatError: an invalid range.
    """
    metres = metres_by_code(info, key, file)
    low, high = float(metres[1]), float(metres[-2])
    return low + max(rounding, (metres[2] - low) / 2), high - max(rounding, (high - metres[-3]) / 2)
