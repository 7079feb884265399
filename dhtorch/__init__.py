"""dhtorch: metric depth beyond the range of a short-range depth sensor, from several views.

Near returns fix the metric relative pose of two views; pixels tracked beyond the sensor's range are triangulated under
that pose; where the geometry is weak, a hole with a reason remains. ``extend`` is the paper's method, ``merge``
combines its estimate with the sensor's returns.

Names are imported on first access: ``dhtorch --help`` runs without loading torch.
"""

import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dhtorch.alignment.align import align_depth
    from dhtorch.measure import CameraPin, PinResult
    from dhtorch.pipeline.completion import complete_depth
    from dhtorch.pipeline.method import Method
    from dhtorch.pipeline.pair import merge
    from dhtorch.pipeline.presets import AUTO, FUSED, KORNIA, MAP, PAPER, extend
    from dhtorch.pipeline.stream import Stream
    from dhtorch.pytree import collate
    from dhtorch.records import (
        Camera,
        DepthValidation,
        Estimate,
        Frame,
        MergedDepth,
        Pose,
        PoseFit,
        Samples,
        TrackHint,
        Tracks,
    )
    from dhtorch.transforms import ExtendDepth, ValidateDepth
    from dhtorch.validation.validate import validate_depth

__version__ = "0.2.0"

__all__ = [
    "AUTO",
    "FUSED",
    "KORNIA",
    "MAP",
    "PAPER",
    "Camera",
    "CameraPin",
    "DepthValidation",
    "Estimate",
    "ExtendDepth",
    "Frame",
    "MergedDepth",
    "Method",
    "PinResult",
    "Pose",
    "PoseFit",
    "Samples",
    "Stream",
    "TrackHint",
    "Tracks",
    "ValidateDepth",
    "align_depth",
    "collate",
    "complete_depth",
    "extend",
    "merge",
    "validate_depth",
]

#: Public name → module that defines it, if that is not ``records``.
_HOMES = dict.fromkeys(("AUTO", "FUSED", "KORNIA", "MAP", "PAPER", "extend"), "pipeline.presets")
_HOMES |= {
    "CameraPin": "measure",
    "ExtendDepth": "transforms",
    "Method": "pipeline.method",
    "PinResult": "measure",
    "Stream": "pipeline.stream",
    "ValidateDepth": "transforms",
    "align_depth": "alignment.align",
    "collate": "pytree",
    "complete_depth": "pipeline.completion",
    "merge": "pipeline.pair",
    "validate_depth": "validation.validate",
}


def __getattr__(name: str) -> Any:
    if name == "WINDOW":  # kept for one release; an ImportError says so after ``from dhtorch import`` as well
        raise ImportError("dhtorch.WINDOW is gone, use dhtorch.MAP.replace(views=5)")
    if name in __all__:
        value = getattr(importlib.import_module(f"dhtorch.{_HOMES.get(name, 'records')}"), name)
    elif not name.startswith("_") and importlib.util.find_spec(f"dhtorch.{name}") is not None:
        value = importlib.import_module(f"dhtorch.{name}")
    else:
        raise AttributeError(f"module 'dhtorch' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
