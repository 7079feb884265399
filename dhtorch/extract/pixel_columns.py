"""Images of one channel in the tables of a source data set -> arrays of numbers, value for value.

LeRobot's policies take every image and video feature as a picture of three channels. Depth, masks and other images of
one channel that a source holds beside its cameras therefore become numbers in an enriched set; such videos stay as
files, without a feature.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.codecs.tiff import decode_tiff
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.readers.lerobot_meta import LeRobotFeature
from dhtorch.export.lerobot import FeatureSpec


def find_one_channel(features: Mapping[str, FeatureSpec], kind: str, cameras: Container[str]) -> list[str]:
    """Keys of the features of ``kind`` (image, video) with one channel that are none of the ``cameras``."""
    keys = (key for key, feature in features.items() if feature["dtype"] == kind and key not in cameras)
    return [key for key in keys if _parse(key, features[key]).channels == 1]


def decode_cell(key: str, feature: FeatureSpec, cell: Any, root: Path | None) -> np.ndarray:
    """Cell of an image column -> its pixels (h, w) as stored, or (3, h, w) of a colour image.

    Args:
        key: of the feature.
        feature: its specification.
        cell: bytes, or the path of a file below ``root``.
        root: of the data set; None = its cells hold bytes.

    Raises:
        FormatError: no image, or one of another size.
    """
    place = root or Path(key)
    data, path = ((cell or {}).get(name) for name in ("bytes", "path"))
    if not data and root is not None and path:
        place = files.resolve_inside(root, path, root, key)
        data = files.read_bytes(place)
    if not data:
        raise FormatError(place, key, "an empty cell", "an image")
    hw = _parse(key, feature).hw
    if data[:2] in (b"II", b"MM"):
        return decode_tiff(data, place, hw)
    if files.decode_image_header(data, place).bits == 16:
        return files.decode_depth_png(data, place, 1.0, hw).astype(np.uint16)
    pixels = files.decode_image(data, place, hw)
    return pixels[0] if len(pixels) == 1 else pixels


def count_channels(key: str, feature: FeatureSpec) -> int:
    """Channels of an image or a video by its feature, in either order of axes."""
    return _parse(key, feature).channels


def _parse(key: str, feature: FeatureSpec) -> LeRobotFeature:
    return LeRobotFeature(key, feature["dtype"], tuple(feature["shape"]), dict(feature.get("info") or {}))
