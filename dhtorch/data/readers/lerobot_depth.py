"""Depth of LeRobot data sets: the depth feature of a camera, and its images or video codes -> metres.

A depth video holds 12-bit codes, by default logarithmic, that span ``depth_min`` to ``depth_max``. The encoder clips
*no return* to the nearest distance and everything too far to the farthest; the two codes at either end are therefore
read as no return.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.lerobot_meta import LeRobotFeature, LeRobotMeta, select_colour_keys

_N_DEPTH_CODES = 4096
_DEFAULT_DEPTH_RANGE = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5}  # m


def find_depth_feature(meta: LeRobotMeta, camera: str, asked: str | None) -> LeRobotFeature | None:
    """The depth feature of a camera: the one ``asked`` for, named like the camera, or the only one; else None."""
    depths = {key: f for key, f in meta.features.items() if f.is_depth and len(f.shape) >= 2}
    if asked is not None:
        if asked not in meta.features or len(meta.features[asked].shape) < 2:
            raise FormatError(meta.root, "option depth", asked, f"one of {', '.join(depths) or 'none'}")
        return meta.features[asked]
    matching = [f for key, f in depths.items() if _distinctive_words(key) == _distinctive_words(camera)]
    if len(matching) == 1:
        return matching[0]
    return next(iter(depths.values())) if len(depths) == 1 and len(select_colour_keys(meta)) == 1 else None


def _distinctive_words(key: str) -> frozenset[str]:
    """The words of a key without those that name the kind of image (rgb, depth, images, …)."""
    kinds = {"observation", "images", "image", "depth", "depths", "rgb", "color", "colour", ""}
    return frozenset(re.split(r"[._\-]", key.lower())) - kinds


def dequantise_depth(feature: LeRobotFeature, codes: np.ndarray, file: Path) -> np.ndarray:
    """12-bit codes (h, w) → depth in m, 0 = no return.

    Raises:
        FormatError: codes of more bits, or an invalid range in the feature's info.
    """
    if codes.dtype != np.uint16 or codes.max(initial=0) >= _N_DEPTH_CODES:
        raise FormatError(file, f"{feature.key} pixels", f"{codes.dtype} up to {codes.max(initial=0)}", "12-bit codes")
    return _metres_by_code(feature, file)[codes]


def decode_depth_picture(data: bytes, file: Path, hw: tuple[int, int]) -> np.ndarray:
    """TIFF or 16-bit PNG → numbers (h, w) as stored.

    Raises:
        FormatError: another format or size.
    """
    if data[:2] in (b"II", b"MM"):
        return decode_tiff(data, file, hw)
    return files.decode_depth_png(data, file, 1.0, hw).astype(np.uint16)


def _metres_by_code(feature: LeRobotFeature, file: Path) -> np.ndarray:
    """Table code → m, 0 for the two codes at either end, to which the encoder clips values out of range."""
    numbers = []
    for key, default in _DEFAULT_DEPTH_RANGE.items():
        value = feature.info.get(f"video.{key}", feature.info.get(key, default))
        numbers.append(float(files.to_array(value, (), file, f"{feature.key} {key}")))
    low, high, shift = numbers
    log = feature.info.get("video.use_log", feature.info.get("use_log", True))
    if not 0 <= low < high <= 1e4 or (log and not 1e-6 < low + shift <= 1e4):  # only the logarithm needs a shift
        raise FormatError(file, f"{feature.key} depth_min, depth_max, shift", numbers, "a range of metres")
    fraction = np.arange(_N_DEPTH_CODES) / (_N_DEPTH_CODES - 1)
    if log:
        table = np.exp((1 - fraction) * np.log(low + shift) + fraction * np.log(high + shift)) - shift
    else:
        table = low + fraction * (high - low)
    table[:2] = table[-2:] = 0
    return table
