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

from dhtorch.metrics import bootstrap
from dhtorch.metrics.holdout import truth_kept_ratio
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

#: Function or module in an earlier version → its present name. The longest prefix of a dotted name counts.
NAMES = {
    "dhtorch.pair.extend": "dhtorch.pipeline.method.Method",
    "dhtorch.window.extend_window": "dhtorch.pipeline.method.Method",
    "dhtorch.window.inverse_variance": "dhtorch.stages.fuse.inverse_variance",
    "dhtorch.method": "dhtorch.pipeline.method",
    "dhtorch.views.by_probes": "dhtorch.pipeline.view_selection.select_views_by_preview",
    "dhtorch.geometry.start": "dhtorch.geometry.coarse_flow",
    "dhtorch.stages.fuse.agree": "dhtorch.stages.fuse.fuse_consistent",
    "dhtorch.stages.sample.grid": "dhtorch.stages.sample.regular_grid",
    "dhtorch.stages.sample.vogel": "dhtorch.stages.sample.vogel_spiral",
    "dhtorch.stages.score.rank": "dhtorch.stages.score.confidence",
    "dhtorch.stages.score.rank_by_error": "dhtorch.stages.score.confidence_from_error",
    "dhtorch.stages.score.rank_by_sigma": "dhtorch.stages.score.confidence_from_sigma",
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
    **{
        f"dhtorch.{package}.opencv.{name}": f"dhtorch.experiments.baselines.opencv.opencv_{name}"
        for package in ("baselines", "studies.baselines")
        for name in ("lucas_kanade", "pnp_ransac", "triangulate")
    },
    **{
        f"dhtorch.{package}.dinov2.load": "dhtorch.experiments.baselines.dinov2.load_dinov2"
        for package in ("baselines", "studies.baselines")
    },
    "dhtorch.studies.baselines.xfeat.search": "dhtorch.experiments.baselines.xfeat.search_matches",
    "dhtorch.baselines": "dhtorch.experiments.baselines",
}

_STUDY_OPTIONS = {"anchors": "reference_views"}

#: Present name of a function → its options of an earlier version and their present names.
OPTIONS: dict[str, dict[str, str]] = {
    "dhtorch.pipeline.method.Method": {"choose": "select_views", "given": "pose_prior"},
    "dhtorch.stages.fuse.inverse_variance": {"max_still": "max_static_ratio"},
    "dhtorch.stages.fuse.fuse_consistent": {"max_still": "max_static_ratio", "max_against": "max_conflict_ratio"},
    "dhtorch.stages.pose.map_pose": {"turn_sigma": "shutter_sigma", "turn_gain": "shutter_gain"},
    "dhtorch.geometry.coarse_flow.coarse_flow": {"turns_deg": "rotations_deg"},
    "dhtorch.data.pairs.by_cameras": {"anchor": "reference"},
    **{
        f"dhtorch.experiments.compare.{study}.run": _STUDY_OPTIONS
        for study in ("align_study", "dense_comparison", "validate_study", "views_study")
    },
}

#: Options of a dense sweep, which settings hold as a mapping.
SWEEP_OPTIONS = {"partners": "source_views"}

#: Beginning of a summary key, name of a column or name of an experiment in an earlier version → its present name.
KEYS = {
    "anchor.": "align.",
    "judge.": "validate.",
    "anchor_study": "align_study",
    "judge_study": "validate_study",
    "one_partner": "one_source_view",
    "worth": "gain",
    "n_mute": "n_no_answer",
    "n_pairs_told": "n_diagnosed_pairs",
    **{
        f"validate.scale_found{suffix}": f"validate.scale_detected{suffix}"
        for suffix in ("", "_5", "_far", "_5_far", "_quick_far", "_5_quick_far")
    },
}

_FUSE = {"_target_": "dhtorch.stages.fuse.inverse_variance", "_partial_": True, "min_views": 2, "max_chi2": 9.0}

#: Function → options that earlier results do not name, as they were.
IMPLIED: dict[str, dict[str, Any]] = {
    "dhtorch.pipeline.method.Method": {
        "views": 1,
        "chain": True,
        "fuse": {**_FUSE, "correlation": 1.0, "max_sigma_rel": 0.1, "max_static_ratio": 0.5},
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
    node = {SWEEP_OPTIONS.get(key, key): present_settings(value) for key, value in settings.items()}
    if not isinstance(node.get("_target_"), str):
        return node
    name = node["_target_"] = present_name(node["_target_"])
    if name == "dhtorch.pipeline.method.Method":
        node.pop("_partial_", None)  # a method was a function with its options bound, and is a record
    if name == "dhtorch.stages.backproject.backproject" and node.get("search_px") == 0:
        node["search_px"] = None  # the radius that the density of the returns asks for
    present = OPTIONS.get(name, {})
    return {**IMPLIED.get(name, {}), **{present.get(option, option): value for option, value in node.items()}}


#: Name of a row's method in an earlier version → its present name.
METHODS = {"anchor": "align", "judge": "validate"}


def present_key(key: str) -> str:
    """The present name of a summary key, column or experiment."""
    if key in KEYS:
        return KEYS[key]
    old = next((old for old in KEYS if old.endswith(".") and key.startswith(old)), "")
    return KEYS[old] + key.removeprefix(old) if old else key


def present_rows(value: Any) -> Any:
    """Rows with the present names of their columns, at every depth; and of their methods."""
    if isinstance(value, list):
        return [present_rows(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    row = {present_key(key): present_rows(item) for key, item in value.items()}
    return row | {"method": METHODS[row["method"]]} if row.get("method") in METHODS else row


#: Experiments that evaluate the score of every method as a probability, also one that only orders answers.
READ_SCORES = ("heldout", "calibration")

#: Numbers of a sigma, and of a score as a probability.
SIGMA_NUMBERS, SCORE_NUMBERS = ("within_sigma", "within_2sigma"), ("ece", "ece_equal_mass")

UNDEFINED = {"value": None, "low": None, "high": None, "n": 0}


def states_no_sigma(config: Mapping[str, Any], variant: str) -> bool:
    """Whether the settings of a variant are those of a method that states no sigma (``Method.states_sigma``).

    A variant that the settings do not name is the job's own method, unless they name several.
    """
    experiment = config.get("experiment") or {}
    named = {**(experiment.get("methods") or {}), **(experiment.get("others") or {})}
    own = {} if experiment.get("methods") else config.get("method") or {}
    method = named.get(variant) or own
    score, triangulate = (method.get(stage) or {} for stage in ("score", "triangulate"))
    orders_alone = score.get("_target_") == "dhtorch.stages.score.confidence"
    return orders_alone and not triangulate.get("fitted_noise")


def blank_unstated(content: Mapping[str, Any]) -> dict[str, Any]:
    """A result without numbers of a sigma or a probability that the method does not state."""
    names = SIGMA_NUMBERS if content["experiment"] in READ_SCORES else (*SIGMA_NUMBERS, *SCORE_NUMBERS)
    variants = dict.fromkeys(row["method"] for row in content["rows"] if "method" in row)
    silent = {v for v in variants if states_no_sigma(content["config"], v)}

    def blank(row: Any) -> Any:
        if not isinstance(row, Mapping):
            return row
        return {k: None if k in names else blank(v) for k, v in row.items()}

    def is_blank(key: str) -> bool:
        owner = next(
            (v for v in variants if key.startswith(f"{v}.")), None if len(variants) > 1 else next(iter(variants))
        )
        return owner in silent and key.rpartition(".")[2] in names

    if not silent:
        return dict(content)
    rows = [blank(row) if row.get("method") in silent else row for row in content["rows"]]
    summary = {k: {**v, **UNDEFINED} if is_blank(k) else v for k, v in content["summary"].items()}
    return {**content, "rows": rows, "summary": summary}


def with_truth_kept(content: Mapping[str, Any]) -> dict[str, Any]:
    """A result whose rows of scenes, and whose summary, have the fraction of the returns that pass the truth test."""

    def complete(row: Mapping[str, Any]) -> dict[str, Any]:
        if row["pair"] is not None or not row.get("n_dropped") or "truth_kept" in row:
            return dict(row)
        return {**row, "truth_kept": truth_kept_ratio(row["n_candidates"], row["n_dropped"])}

    rows, summary = [complete(row) for row in content["rows"]], dict(content["summary"])
    for variant, truth in dict.fromkeys((row.get("method"), row.get("truth")) for row in rows):
        prefixes = (f"{variant}.{truth}.", f"{variant}.", "")
        prefix = next((p for p in prefixes if f"{p}n_dropped.close" in summary), None)
        scenes = [r for r in rows if (r["pair"], r.get("method"), r.get("truth")) == (None, variant, truth)]
        values = [r["truth_kept"] for r in scenes if "truth_kept" in r and r["role"] is None]
        if prefix is not None and values:
            summary.setdefault(f"{prefix}truth_kept", bootstrap.interval_over_scenes(values).entry("1"))
    return {**content, "rows": rows, "summary": summary}


def migrate(path: Path) -> None:
    """Rewrite one file; one without earlier names stays as it is, byte for byte."""
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content, dict) and "schema" in content:
        new = content | {
            "experiment": present_key(content["experiment"]),
            "config": present_settings(content["config"]),
            "summary": {present_key(key): value for key, value in content["summary"].items()},
            "rows": present_rows(content["rows"]),
        }
        new = blank_unstated(with_truth_kept(new))
        if new != content:
            result_files.write_result(path, new)
    elif isinstance(content, list) and any(_is_earlier(row) for row in content):
        rows = [_present_row(row) for row in content]
        replace_file(path, (json.dumps(rows, indent=1, ensure_ascii=False) + "\n").encode())


def _is_earlier(row: Mapping[str, Any]) -> bool:
    """Whether the names of a benchmark row are an earlier version's."""
    torch_alone = str(row.get("name")).startswith(("triangulate", "start"))  # rows that have no compiled operators
    if any(_present_text(value) != value for value in row.values()):
        return True
    other_mode = row.get("mode") == "native" or (torch_alone and row.get("mode") == "compiled")
    return other_mode or row.get("name") in ROW_NAMES or not COLUMNS.keys().isdisjoint(row)


def _present_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A benchmark row with the present names of its columns, of itself, its mode and its peer."""
    tables = {"name": ROW_NAMES, "mode": MODES, "peer": PEERS}
    values = {key: tables[key].get(value, value) if key in tables else value for key, value in row.items()}
    return {COLUMNS.get(key, key): _present_text(value) for key, value in values.items()}


def _present_text(value: Any) -> Any:
    """A text with present names, also within lists and mappings; anything else as it is."""
    if isinstance(value, str):
        for old, new in TEXTS.items():
            value = value.replace(old, new)
    if isinstance(value, list):
        return [_present_text(item) for item in value]
    if isinstance(value, Mapping):
        return {COLUMNS.get(key, key): _present_text(item) for key, item in value.items()}
    return value


#: Name of a benchmark row in an earlier version → its present name.
ROW_NAMES = {"anchor_auto": "auto_reference_view", "auto_anchor": "auto_reference_view"} | {
    f"judge_{way}": f"validate_{way}" for way in ("sparse", "sparse_512", "views")
}

#: Peer, columns and parts of a text of a benchmark row in an earlier version → their present names.
PEERS = {"opencv_seats": "opencv_stages"}
TEXTS = {
    "the anchor's is exact": "the reference view's is exact",
    "those of the studies have": "those of the experiments have",
    "studies.": "experiments.",
    ", silent ": ", no answer ",
}
COLUMNS = {"seat": "tracker", "said": "printed", "made": "origin", "held": "limited", "told": "coverage"} | {
    "held_mib": "state_mib"
}

#: Mode of a benchmark row in an earlier version → its present name.
MODES = {"native": "compiled", "compiled": "torch.compile"}


def main() -> None:
    """Rewrite the files that the command names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path)
    for path in parser.parse_args().files:
        migrate(path)


if __name__ == "__main__":
    main()
