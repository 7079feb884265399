"""Unit of the depth that a data set hands out, as the data set declares it: LeRobot's metadata and options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Form of a depth feature that LeRobot decodes; the others are arrays of numbers.
_PICTURE_FORMS = ("image", "video")


def declared_depth_unit(dataset: Any, key: str) -> str:
    """LeRobot data set and key of its depth -> unit of the depth in its items, ``m`` or ``mm``.

    LeRobot 0.6 and later convert depth that is an image with a stated ``depth_unit``, or a video, into the data set's
    ``depth_output_unit``; earlier versions hand out what is stored, and all of them arrays of numbers.

    Raises:
        ValueError: a data set that declares none: nothing is inferred from the numbers.
    """
    features = getattr(getattr(dataset, "meta", None), "features", None)
    if not isinstance(features, Mapping):
        raise ValueError(f"depth_unit=auto: found {type(dataset).__name__}, expected a LeRobot data set; else m or mm")
    if key not in features:
        raise ValueError(f"depth_unit=auto: found no feature {key}, expected one of {', '.join(features)}")
    feature = features[key]
    info = feature.get("info") or {}
    stored = info.get("depth_unit")
    converts = getattr(dataset, "depth_output_unit", None)
    marked = key in (getattr(dataset.meta, "depth_keys", None) or ())
    if feature["dtype"] in _PICTURE_FORMS and marked and converts in ("m", "mm"):
        is_converted = feature["dtype"] == "video" or stored is not None
        unit = converts if is_converted else None
    else:
        unit = None if feature["dtype"] == "video" else stored or info.get("unit")
    if unit not in ("m", "mm"):
        feature_text = f"{key} ({feature['dtype']}) without a unit that this LeRobot declares"
        expected = "depth_unit in its info; else depth_unit='m' or 'mm'"
        raise ValueError(f"depth_unit=auto: found {feature_text}, expected {expected}")
    return str(unit)
