"""What might help where a job answered next to nothing: one sentence, from what became of the samples."""

from __future__ import annotations

from dhtorch.codes import Gate, describe, words
from dhtorch.experiments.report.reading import Result, metric_value, scene_rows

#: Share of the samples up to which answers are next to none.
_MAX_ANSWERED_SHARE = 0.005


def advice(result: Result) -> list[str]:
    """One line for every scene and variant without answers, for one reason."""
    lines = []
    for row in scene_rows(result):
        shares = metric_value(row, "gate_share") or {}
        if "answer" not in shares or shares["answer"] > _MAX_ANSWERED_SHARE:
            continue
        gate = max((g for g in shares if g != "answer"), key=lambda g: shares[g])
        entry = describe(Gate, gate)
        if entry is not None and entry.retry:
            share = f"{words(gate)}: {shares[gate]:.0%}"
            lines.append(f"{row['scene']}: no answer, {entry.meaning} ({share}); {entry.retry}")
    return list(dict.fromkeys(lines))
