"""Rewrite archived results of earlier versions with present names: ``python benchmarks/migrate_results.py FILE …``

A schema-1 result keeps its key, which is that of the code it was made by: a sweep with ``resume=true`` computes it
again. Functions, options and summary keys get their present names, and the seal is that of the file as it then stands.
Arrays of benchmark rows get the present names of modes. Files are replaced in place.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dhtorch.runtime import results as result_files
from dhtorch.runtime.storage import replace_file

WINGS = {
    "paper": (
        *("ablation", "calibration", "device_pose", "gate_ablation", "global_map", "heldout", "hole_census"),
        *("latency", "motion", "range_split", "real_holes"),
    ),
    "compare": ("learned", "method_comparison", "opencv_twin", "part_ablation", "views_study", "dense_comparison"),
    "negative": ("helix_correlation", "hole_attention", "icp"),
    "focal": ("defocus", "defocus_fusion", "focus_stack"),
    "probes": ("learned_score", "rh20t_probe", "vo_probe"),
}

#: Function or module in an earlier version → its present name.
NAMES = {
    "dhtorch.pair.extend": "dhtorch.pipeline.method.Method",
    "dhtorch.window.extend_window": "dhtorch.pipeline.method.Method",
    "dhtorch.window.inverse_variance": "dhtorch.stages.fuse.inverse_variance",
    "dhtorch.method": "dhtorch.pipeline.method",
    "dhtorch.views": "dhtorch.pipeline.view_selection",
    "dhtorch.geometry.start": "dhtorch.geometry.coarse_flow",
    "dhtorch.data.open_all": "dhtorch.data.open_capture",
    "dhtorch.data.synthetic.SyntheticRoom": "dhtorch.synthetic.recording.open_room",
    "dhtorch.synthetic.recording.SyntheticRoom": "dhtorch.synthetic.recording.open_room",
    "dhtorch.data.synthetic": "dhtorch.synthetic.recording",
    "dhtorch.data.synthetic_robot": "dhtorch.synthetic.robot",
    "dhtorch.data.stress": "dhtorch.synthetic.stress",
    "dhtorch.data.viewpoints": "dhtorch.synthetic.viewpoints",
    "dhtorch.data.rh20t_set": "dhtorch.data.readers.rh20t_set",
    "dhtorch.data.focal_stacks": "dhtorch.experiments.focal.formats",
    **{
        f"dhtorch.data.{name}": f"dhtorch.experiments.focal.{name}"
        for name in ("ddff12", "fod500", "image_folder", "light_field", "stacks")
    },
    **{f"dhtorch.experiments.{s}": f"dhtorch.experiments.{w}.{s}" for w, names in WINGS.items() for s in names},
    "dhtorch.studies.compare.anchor_study": "dhtorch.experiments.compare.align_study",
    "dhtorch.studies.compare.judge_study": "dhtorch.experiments.compare.validate_study",
    "dhtorch.studies": "dhtorch.experiments",
    "dhtorch.baselines": "dhtorch.experiments.baselines",
}

_FUSE = {"_target_": "dhtorch.stages.fuse.inverse_variance", "_partial_": True, "min_views": 2, "max_chi2": 9.0}

#: Function → options that earlier results do not name, as they were.
IMPLIED: dict[str, dict[str, Any]] = {
    "dhtorch.pipeline.method.Method": {
        "views": 1,
        "chain": True,
        "fuse": {**_FUSE, "correlation": 1.0, "max_sigma_rel": 0.1, "max_still": 0.5},
    },
    **{f"dhtorch.experiments.probes.{name}.run": {"xfeat": False} for name in ("rh20t_probe", "vo_probe")},
    "dhtorch.experiments.negative.helix_correlation.run": {"turns": None, "foveation": 1.0, "gaze": None},
}


def present_name(name: str) -> str:
    """The present dotted name of a function or module that an earlier version names."""
    for length in range(name.count(".") + 1, 0, -1):
        parts = name.split(".")
        if (new := NAMES.get(".".join(parts[:length]))) is not None:
            return ".".join([new, *parts[length:]])
    return name


def present_settings(settings: Any) -> Any:
    """Settings of an earlier result with present names, and with the options that it did not name."""
    if isinstance(settings, list):
        return [present_settings(value) for value in settings]
    if not isinstance(settings, Mapping):
        return settings
    node = {key: present_settings(value) for key, value in settings.items()}
    if not isinstance(node.get("_target_"), str):
        return node
    name = node["_target_"] = present_name(node["_target_"])
    if name == "dhtorch.pipeline.method.Method":
        node.pop("_partial_", None)  # a method was a function with its options bound, and is a record
    if name == "dhtorch.stages.backproject.backproject" and node.get("search_px") == 0:
        node["search_px"] = None  # the radius that the density of the returns asks for
    return {**IMPLIED.get(name, {}), **node}


def migrate(path: Path) -> None:
    """Rewrite one file; one without earlier names stays as it is, byte for byte."""
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content, dict) and "schema" in content:
        new = content | {"config": present_settings(content["config"])}
        if new != content:
            result_files.write_result(path, new)
    elif isinstance(content, list):
        new_rows = [row | {"mode": MODES.get(row["mode"], row["mode"])} if "mode" in row else row for row in content]
        if new_rows != content:
            replace_file(path, (json.dumps(new_rows, indent=1, ensure_ascii=False) + "\n").encode())


#: Mode of a benchmark row in an earlier version → its present name.
MODES: dict[str, str] = {}


def main() -> None:
    """Rewrite the files that the command names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path)
    for path in parser.parse_args().files:
        migrate(path)


if __name__ == "__main__":
    main()
