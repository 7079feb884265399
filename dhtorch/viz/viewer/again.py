"""An archived result as something to see: what its settings name, as objects.

A result file may come from anywhere. Its settings name functions, and only those of this package that settings are
meant to name are called; whatever else a file names is refused.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

#: Group of the settings → modules whose public functions it may name.
_ALLOWED_MODULES = {
    "data": (
        *("dhtorch.data", "dhtorch.data.readers.rh20t_set", "dhtorch.data.rig"),
        *("dhtorch.experiments.focal.formats", "dhtorch.stages.sample"),
        *(f"dhtorch.synthetic.{name}" for name in ("recording", "stress", "viewpoints", "robot", "two_cameras")),
    ),
    "pairs": ("dhtorch.data.pairs",),
    "method": (
        *(
            "dhtorch.pipeline.method",
            "dhtorch.pipeline.view_selection",
            "dhtorch.geometry.epipolar",
            "dhtorch.geometry.coarse_flow",
        ),
        "dhtorch.experiments.baselines.opencv",
        "dhtorch.experiments.baselines.xfeat",
        *(
            f"dhtorch.stages.{name}"
            for name in ("sample", "backproject", "holes", "track", "pose", "triangulate", "score", "fuse")
        ),
    ),
}


def rebuild_parts(result: Mapping[str, Any], root: str | Path | None = None) -> dict[str, Any]:
    """``data``, ``method`` and ``pairs`` of a result's settings, as objects.

    Args:
        result: valid, as from :func:`dhtorch.runtime.results.read_result`.
        root: where its data lie now; None = where the settings say, below DHTORCH_DATA or the present folder.

    Raises:
        ValueError: the settings name a function that is none of :data:`_ALLOWED_MODULES`, or one that takes other
            options.
        OSError: its data are not there.
    """
    config = result["config"]
    for group in _ALLOWED_MODULES:
        if not isinstance(config.get(group), Mapping):
            raise ValueError(f"result.config.{group}: found {config.get(group)!r}, expected settings with a _target_")
    data = dict(config["data"])
    if "root" in data:
        data["root"] = str(_resolve_root(data["root"], root))
    return {group: _instantiate(data if group == "data" else config[group], group, group) for group in _ALLOWED_MODULES}


def read_cutoff(result: Mapping[str, Any], scene: str) -> float:
    """The cutoff on a scene of the result, m; infinite where nothing was held back."""
    rows = (row for row in result["rows"] if row["pair"] is None and row["scene"] == scene)
    limit = next((row.get("cutoff_m") for row in rows), None)
    return float(limit) if isinstance(limit, int | float) else math.inf


def _resolve_root(said: Any, root: str | Path | None) -> Path | None:
    if root is not None or said is None:
        return Path(root) if root is not None else Path(os.environ.get("DHTORCH_DATA", "."))
    below = Path(os.environ.get("DHTORCH_DATA", ".")) / str(said)
    return below if below.exists() else Path(str(said))


def _instantiate(node: Any, group: str, where: str) -> Any:
    """What the settings say below ``where``: functions with their options bound, or called."""
    if isinstance(node, list):
        return [_instantiate(v, group, f"{where}.{k}") for k, v in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    options = {
        k: _instantiate(v, group, f"{where}.{k}")
        for k, v in node.items()
        if k not in ("_target_", "_partial_", "_convert_")
    }
    if "_target_" not in node:
        return options
    function = _load_allowed_function(node["_target_"], group, where)
    try:  # an option that the function has not would be seen only when it is called, with another message
        inspect.signature(function).bind_partial(**options)
    except TypeError as error:
        raise ValueError(f"result.config.{where}: {error}") from error
    return partial(function, **options) if node.get("_partial_") else function(**options)


def _load_allowed_function(name: Any, group: str, where: str) -> Any:
    module, _, last = str(name).rpartition(".")
    if module in _ALLOWED_MODULES[group] and not last.startswith("_"):
        found = getattr(importlib.import_module(module), last, None)
        if callable(found) and getattr(found, "__module__", None) == module:
            return found
    expected = f"a function of {', '.join(_ALLOWED_MODULES[group])}"
    raise ValueError(f"result.config.{where}._target_: found {name!r}, expected {expected}")
