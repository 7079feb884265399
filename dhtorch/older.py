"""Results of older versions in today's words: where functions are now, and what was left unsaid then."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Function or module that an older result names → where it is found now.
ALIASES = {
    "dhtorch.pair.extend": "dhtorch.method.Method",
    "dhtorch.window.extend_window": "dhtorch.method.Method",
    "dhtorch.window.inverse_variance": "dhtorch.stages.fuse.inverse_variance",
    "dhtorch.data.open_all": "dhtorch.data.open_capture",
    "dhtorch.extract.Options": "dhtorch.extract.ExtractOptions",
    "dhtorch.data.synthetic.SyntheticRoom": "dhtorch.synthetic.recording.open_room",
    "dhtorch.synthetic.recording.SyntheticRoom": "dhtorch.synthetic.recording.open_room",
    "dhtorch.data.synthetic": "dhtorch.synthetic.recording",
    "dhtorch.data.synthetic_robot": "dhtorch.synthetic.robot",
    "dhtorch.data.focal_stacks": "dhtorch.studies.focal.formats",
    **{
        f"dhtorch.data.{name}": f"dhtorch.studies.focal.{name}"
        for name in ("ddff12", "fod500", "image_folder", "light_field", "stacks")
    },
    "dhtorch.data.stress": "dhtorch.synthetic.stress",
    "dhtorch.data.viewpoints": "dhtorch.synthetic.viewpoints",
    "dhtorch.experiments.pair": "dhtorch.studies.pair",
    **{
        f"dhtorch.experiments.{study}": f"dhtorch.studies.{wing}.{study}"
        for wing, studies in {
            "paper": (
                *("ablation", "calibration", "device_pose", "gate_ablation", "global_map", "heldout", "hole_census"),
                *("latency", "motion", "range_split", "real_holes"),
            ),
            "compare": ("learned", "method_comparison", "opencv_twin", "part_ablation"),
            "negative": ("helix_correlation", "hole_attention", "icp"),
            "focal": ("defocus", "defocus_fusion", "focus_stack"),
            "probes": ("learned_score", "rh20t_probe", "vo_probe"),
        }.items()
        for study in studies
    },
    **{
        f"dhtorch.baselines.{name}": f"dhtorch.studies.baselines.{name}"
        for name in ("dinov2", "dust3r", "opencv", "relative", "vggt")
    },
}

#: Function → options that older results do not name, as they were.
IMPLIED: dict[str, dict[str, Any]] = {
    "dhtorch.method.Method": {
        "views": 1,
        "chain": True,
        "fuse": {
            **{"_target_": "dhtorch.stages.fuse.inverse_variance", "_partial_": True, "min_views": 2, "max_chi2": 9.0},
            **{"correlation": 1.0, "max_sigma_rel": 0.1, "max_still": 0.5},
        },
    },
    **{f"dhtorch.studies.probes.{name}.run": {"xfeat": False} for name in ("rh20t_probe", "vo_probe")},
    "dhtorch.studies.negative.helix_correlation.run": {"turns": None, "foveation": 1.0, "gaze": None},
}


def today(settings: Any) -> Any:
    """Settings of an older result in today's words: functions where they are now, with what was left unsaid then."""
    if isinstance(settings, list):
        return [today(value) for value in settings]
    if not isinstance(settings, Mapping):
        return settings
    said = {key: today(value) for key, value in settings.items()}
    if not isinstance(said.get("_target_"), str):
        return said
    name = said["_target_"]
    home, _, last = name.rpartition(".")
    said["_target_"] = ALIASES.get(name) or f"{ALIASES.get(home, home)}.{last}"
    if said["_target_"] == "dhtorch.method.Method":
        said.pop("_partial_", None)  # a method was a function with its options bound, and is a record
    if name == "dhtorch.stages.backproject.backproject" and said.get("search_px") == 0:
        said["search_px"] = None  # as far as the frame asks for
    return {**IMPLIED.get(said["_target_"], {}), **said}
