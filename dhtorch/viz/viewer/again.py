"""Archived result -> data, method and pairs, rebuilt from its settings.

Result files are untrusted: only functions on a list of this package's modules are called; any other name is rejected.
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

#: Settings group → modules whose public functions its ``_target_`` may name.
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
            "dhtorch.pipeline.fused",
            "dhtorch.pipeline.dense_options",
            "dhtorch.geometry.epipolar",
            "dhtorch.geometry.coarse_flow",
        ),
        "dhtorch.experiments.baselines.opencv",
        "dhtorch.experiments.baselines.xfeat",
        *(
            f"dhtorch.stages.{name}"
            for name in (
                *("sample", "backproject", "holes", "track", "track_chain", "guided_search", "pose", "misalignment"),
                *("triangulate", "shared_error", "score", "fuse"),
                *(f"kornia.{name}" for name in ("backproject", "holes", "track", "pose", "triangulate")),
            )
        ),
    ),
}


def rebuild_parts(result: Mapping[str, Any], root: str | Path | None = None) -> dict[str, Any]:
    """Result -> ``data``, ``method`` and ``pairs`` of its settings, as objects.

    Args:
        result: valid, as from :func:`dhtorch.runtime.results.read_result`.
        root: present location of its data; None = the recorded one, below DHTORCH_DATA or the working folder.

    Raises:
        ValueError: the settings name a function outside :data:`_ALLOWED_MODULES`, or options that it does not accept.
        OSError: its data are missing.
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
    """The cutoff on a scene of the result, m; infinite without a hold-out."""
    rows = (row for row in result["rows"] if row["pair"] is None and row["scene"] == scene)
    cutoff = next((row.get("cutoff_m") for row in rows), None)
    return float(cutoff) if isinstance(cutoff, int | float) else math.inf


def _resolve_root(recorded: Any, root: str | Path | None) -> Path | None:
    if root is not None or recorded is None:
        return Path(root) if root is not None else Path(os.environ.get("DHTORCH_DATA", "."))
    below = Path(os.environ.get("DHTORCH_DATA", ".")) / str(recorded)
    return below if below.exists() else Path(str(recorded))


def _instantiate(node: Any, group: str, where: str) -> Any:
    """Settings node at ``where`` -> functions with bound options, or their results."""
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
    try:  # unknown options would otherwise fail later, with another message
        inspect.signature(function).bind_partial(**options)
    except TypeError as error:
        raise ValueError(f"result.config.{where}: {error}") from error
    return partial(function, **options) if node.get("_partial_") else function(**options)


def _load_allowed_function(name: Any, group: str, where: str) -> Any:
    module, _, last = str(name).rpartition(".")
    if module in _ALLOWED_MODULES[group] and not last.startswith("_"):
        function = getattr(importlib.import_module(module), last, None)
        if callable(function) and getattr(function, "__module__", None) == module:
            return function
    expected = f"a function of {', '.join(_ALLOWED_MODULES[group])}"
    raise ValueError(f"result.config.{where}._target_: found {name!r}, expected {expected}")
