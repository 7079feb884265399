"""Tables of docs/learning.md: a recovered calibration, far labels for a network, a confidence trained on its risk."""

from collections.abc import Mapping, Sequence
from typing import Any

from cells import percent, read, table

#: What the self-calibration recovers, and how large its error may be on holo_a.
CALIBRATED = {"focal": ("focal length", 0.005), "scale": ("depth scale", 0.01), "offset": ("time of depth", 0.2)}

#: What the data of a result are called on a page.
NAMES = {
    "rooms": "built-in rooms",
    "holo": "holo_stream",
    "redkitchen": "7s_redkitchen_stream_000, _200",
    "shared_scenes": "shared scenes",
}


def self_calibration() -> str:
    """Planted and recovered errors of every seed, and those of the capture as it is."""
    runs = read("self_calibration")
    rows = []
    for data in dict.fromkeys(run["data"] for run in runs):
        of = [run for run in runs if run["data"] == data]
        for key, (name, required) in CALIBRATED.items():
            planted, recovered = of[0]["planted"][key], [run["recovered"][key] for run in of]
            show = _frames if key == "offset" else _percents
            worst = show([max(abs(x - planted) for x in recovered)]).lstrip("+")
            limit = show([required]).lstrip("+") if data == "holo_a" else "–"
            as_it_is = show([run["as_it_is"][key] for run in of])
            rows.append([f"`{data}`, {name}", show([planted]), show(recovered), worst, limit, as_it_is])
    head = ["", "planted", "recovered, each seed", "largest error", "required", "as it is, each seed"]
    seconds = max(run["cpu_s"] for run in runs)
    return f"{table(head, rows)}\n\nA seed, both runs, takes up to {seconds:.0f} s of processor time on one thread."


def _percents(values: Sequence[float]) -> str:
    return ", ".join(f"{100 * x:+.2f}" for x in values) + " %"


def _frames(values: Sequence[float]) -> str:
    return ", ".join(f"{x:+.3f}" for x in values) + " frames"


def far_labels() -> str:
    """Far and near error of every variant on held-out frames, and the far error's ratio to near labels alone."""
    rows = []
    for row in read("far_labels"):
        for variant in ("near", "far", "unweighted", "truth", "constant"):
            cells = [percent(row[f"{variant}.{part}_error"]["value"]) for part in ("far", "near")]
            seeds = row[f"{variant}.far_ratio_of_seeds"]
            spread = "–" if variant in ("near", "constant") else f"{min(seeds):.2f} to {max(seeds):.2f}"
            rows.append([f"{NAMES[row['data']]}, `{variant}`", *cells, interval(row[f"{variant}.far_ratio"]), spread])
    head = ["data, labels", "far error", "near error", "far error to `near` (95 %)", "of each seed"]
    return table(head, rows)


def label_quality() -> str:
    """How many frames train and are held out, and how good the far labels of the training frames are."""
    rows = []
    for row in read("far_labels"):
        counts = [str(row["training_frames"]), str(row["held_out_frames"])]
        rows.append([NAMES[row["data"]], *counts, *(percent(row[k]) for k in ("answered", "median_rel", "mean_rel"))])
    head = ["data", "training frames", "held out", "far pixels answered", "median error of answers", "mean error"]
    return table(head, rows)


def learned_confidence() -> str:
    """Areas under the risk–coverage curve as ratios to the analytic score, on rooms that were not trained on."""
    rows = []
    for row in read("learned_confidence"):
        for score in ("paper", "regressed", "by_risk"):
            entry = row[f"{score}.aurc_ratio"]
            spread = "–" if score == "paper" else f"{min(entry['of_seeds']):.3f} to {max(entry['of_seeds']):.3f}"
            rows.append([f"{NAMES[row['data']]}, `{score}`", str(len(row["answers"])), interval(entry, 3), spread])
    return table(["data, score", "scenes", "AURC to `by_error` (95 %)", "of each seed"], rows)


def interval(entry: Mapping[str, Any], digits: int = 2) -> str:
    """A value with its interval."""
    return f"{entry['value']:.{digits}f} ({entry['low']:.{digits}f}–{entry['high']:.{digits}f})"


TABLES = {
    "self calibration": self_calibration,
    "far labels": far_labels,
    "far label quality": label_quality,
    "learned confidence": learned_confidence,
}
