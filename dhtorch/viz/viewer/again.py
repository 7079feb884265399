"""Archived result -> data, method and pairs, rebuilt from its settings.

Result files are untrusted: only the functions of a list are called, none of which writes; any other name is rejected.
"""

import importlib
import inspect
import math
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

#: Settings group → functions that its ``_target_`` may name: none of them writes a file or runs a program, whatever its
#: options. Without ``dhtorch.synthetic.robot.open_robot``, which writes the data set that it opens.
_ALLOWED_FUNCTIONS = {
    "data": (
        *(f"dhtorch.data.{name}" for name in ("open", "open_all", "open_capture", "open_scenes")),
        "dhtorch.data.readers.rh20t_set.open_set",
        "dhtorch.data.rig.open_rig",
        *(f"dhtorch.experiments.focal.formats.{name}" for name in ("open_collections", "open_stacks")),
        "dhtorch.stages.sample.spiral",
        *(f"dhtorch.synthetic.recording.{name}" for name in ("join_scenes", "open_room", "open_rooms")),
        "dhtorch.synthetic.stress.open_stress",
        "dhtorch.synthetic.two_cameras.open_two_cameras",
        "dhtorch.synthetic.viewpoints.open_viewpoints",
    ),
    "pairs": tuple(
        f"dhtorch.data.pairs.{name}"
        for name in ("by_baseline", "by_cameras", "by_choice", "by_gap", "by_scaled_gap", "by_time")
    ),
    "method": (
        "dhtorch.pipeline.method.Method",
        "dhtorch.pipeline.dense_options.DenseOptions",
        "dhtorch.pipeline.fused.fuse_with_sweep",
        *(f"dhtorch.pipeline.view_selection.select_views_by_{name}" for name in ("pose", "preview")),
        "dhtorch.geometry.epipolar.triangulate",
        "dhtorch.geometry.coarse_flow.coarse_flow",
        *(f"dhtorch.experiments.baselines.opencv.opencv_{name}" for name in ("lucas_kanade", "pnp_ransac")),
        "dhtorch.experiments.baselines.opencv.opencv_triangulate",
        "dhtorch.experiments.baselines.xfeat.match",
        *(f"dhtorch.stages.sample.{name}" for name in ("regular_grid", "spiral", "vogel_spiral")),
        "dhtorch.stages.backproject.backproject",
        "dhtorch.stages.holes.classify",
        *(f"dhtorch.stages.track.{name}" for name in ("lucas_kanade", "lucas_kanade_affine")),
        "dhtorch.stages.track_chain.track_chain",
        "dhtorch.stages.guided_search.guided_search",
        *(f"dhtorch.stages.pose.{name}" for name in ("map_pose", "pnp_ransac")),
        "dhtorch.stages.misalignment.reject_misaligned",
        "dhtorch.stages.triangulate.two_view",
        "dhtorch.stages.shared_error.verify_views",
        *(f"dhtorch.stages.score.confidence{name}" for name in ("", "_from_error", "_from_sigma")),
        *(f"dhtorch.stages.fuse.{name}" for name in ("fuse_consistent", "inverse_variance")),
        *(f"dhtorch.stages.kornia.{name}_kornia" for name in ("backproject.backproject", "holes.classify")),
        *(f"dhtorch.stages.kornia.{name}_kornia" for name in ("track.lucas_kanade", "pose.pnp_ransac")),
        "dhtorch.stages.kornia.triangulate.two_view_kornia",
    ),
}


def rebuild_parts(result: Mapping[str, Any], root: str | Path | None = None) -> dict[str, Any]:
    """Result -> ``data``, ``method`` and ``pairs`` of its settings, as objects.

    Args:
        result: valid, as from :func:`dhtorch.runtime.results.read_result`.
        root: present location of its data; None = the recorded one, below DHTORCH_DATA or the working folder.

    Raises:
        ValueError: the settings name a function outside :data:`_ALLOWED_FUNCTIONS`, or options that it does not accept.
        OSError: its data are missing.
    """
    config = result["config"]
    for group in _ALLOWED_FUNCTIONS:
        if not isinstance(config.get(group), Mapping):
            raise ValueError(f"result.config.{group}: found {config.get(group)!r}, expected settings with a _target_")
    data = dict(config["data"])
    if "root" in data:
        data["root"] = str(_resolve_root(data["root"], root))
    nodes = {**{group: config[group] for group in _ALLOWED_FUNCTIONS}, "data": data}
    return {group: _instantiate(node, group, group) for group, node in nodes.items()}


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
    name = node["_target_"]
    if name not in _ALLOWED_FUNCTIONS[group]:
        expected = f"one of the functions for {group} in dhtorch/viz/viewer/again.py, none of which writes"
        raise ValueError(f"result.config.{where}._target_: found {name!r}, expected {expected}")
    module, _, last = name.rpartition(".")
    function = getattr(importlib.import_module(module), last)
    try:
        inspect.signature(function).bind_partial(**options)  # unknown ones would fail later, with another message
        return partial(function, **options) if node.get("_partial_") else function(**options)
    except TypeError as error:
        raise ValueError(f"result.config.{where}: {error}") from error
