"""Unit and range of the depth that a data set hands out, as it declares them: LeRobot's metadata and options."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dhtorch.data.depth_codes import find_return_range
from dhtorch.transforms.sample_spec import NO_LIMITS

#: Form of a depth feature that LeRobot decodes; the others are arrays of numbers.
_PICTURE_FORMS = ("image", "video")

#: Unit of a decoded depth video -> largest error of its rounding, m. Source: derived: LeRobot 0.6 rounds to whole
#: millimetres and not at all in metres; a hundredth of a millimetre for its arithmetic in float32.
_ROUNDING_M = {"m": 0.0, "mm": 0.51e-3}


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
    if feature["dtype"] in _PICTURE_FORMS and (converts := _output_unit(dataset, key)):
        is_converted = feature["dtype"] == "video" or stored is not None
        unit = converts if is_converted else None
    else:
        unit = None if feature["dtype"] == "video" else stored or info.get("unit")
    if unit not in ("m", "mm"):
        feature_text = f"{key} ({feature['dtype']}) without a unit that this LeRobot declares"
        expected = "depth_unit in its info; else depth_unit='m' or 'mm'"
        raise ValueError(f"depth_unit=auto: found {feature_text}, expected {expected}")
    return str(unit)


def declared_depth_range(dataset: Any, key: str) -> tuple[float, float]:
    """LeRobot data set and key of its depth -> lower and upper limit in m of returns, for ``depth_range``.

    A depth video has no code for *no return*: LeRobot hands out its two ends, ``depth_min`` and ``depth_max``, instead.
    Depth in another form, of other data sets or of versions that decode no depth has no limits, (0, inf).

    Raises:
        FormatError: the data set states an invalid range.
    """
    features = getattr(getattr(dataset, "meta", None), "features", None)
    feature = features.get(key) if isinstance(features, Mapping) else None
    unit = _output_unit(dataset, key) if feature is not None and feature["dtype"] == "video" else None
    if feature is None or unit is None:
        return NO_LIMITS
    return find_return_range(feature.get("info") or {}, key, Path("meta") / "info.json", _ROUNDING_M[unit])


def _output_unit(dataset: Any, key: str) -> str | None:
    """Unit into which LeRobot converts a depth image or video; None if it is not marked as depth, and before 0.6."""
    unit = getattr(dataset, "depth_output_unit", None)
    return unit if unit in _ROUNDING_M and key in (getattr(dataset.meta, "depth_keys", None) or ()) else None
