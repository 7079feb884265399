"""What might help where a job answered next to nothing: one sentence, from what became of the samples."""

from __future__ import annotations

from dhtorch.codes import words
from dhtorch.experiments.report.reading import Result, metric_value, scene_rows

#: Share of the samples up to which answers are next to none.
_MAX_SILENT_SHARE = 0.005

#: Gate → what it means, and what to try.
_GATE_HELP = {
    "no_track": (
        "hardly a sample was found again in the other view",
        "the two views lie too far apart or show nothing in common: try a smaller pairs.gap, or pairs=auto",
    ),
    "no_texture": ("there is hardly any texture to track", "try frames with more detail in sight"),
    "no_pose": (
        "no pose was found",
        "there are too few returns among what was tracked: try a larger holdout.cutoff, or holdout=none",
    ),
    "no_baseline": ("the camera hardly moved between the views", "try a larger pairs.gap, or pairs=auto"),
    "contradicted": ("what is near moves otherwise than what is far", "try frames in which nothing else moves"),
}


def advice(result: Result) -> list[str]:
    """One line for every scene and variant that is silent for one reason."""
    said = []
    for row in scene_rows(result):
        shares = metric_value(row, "gate_share") or {}
        if "answer" not in shares or shares["answer"] > _MAX_SILENT_SHARE:
            continue
        gate = max((g for g in shares if g != "answer"), key=lambda g: shares[g])
        if gate in _GATE_HELP:
            found, tried = _GATE_HELP[gate]
            said.append(f"{row['scene']}: no answer, {found} ({words(gate)}: {shares[gate]:.0%}); {tried}")
    return list(dict.fromkeys(said))
