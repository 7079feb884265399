"""Question: which part of the method determines the result?

Expectation (written before the run): the sampler hardly matters (any even-handed pattern does), coverage does not
depend on the number of samples, the tracking window matters little between 15 and 31 px, and no single change of a
part improves the median error over scenes by more than a tenth.
What would refute it: one change of one part lowers the median error ratio (geometric mean over scenes) below 0.9.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace

from dhtorch.data.scene import SceneLike
from dhtorch.experiments.outcome import join_outcomes
from dhtorch.experiments.protocol import (
    Method,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    no_progress,
    run_protocol,
    stage_key,
)
from dhtorch.metrics import bootstrap
from dhtorch.stages.sample import regular_grid, vogel_spiral


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    n: Sequence[int] = (512, 1024, 4096),
    windows: Sequence[int] = (15, 31),
    others: Mapping[str, Method] | None = None,
    wholes: Mapping[str, Method] | None = None,
    progress: Progress = no_progress,
) -> Outcome:
    """Error ratios of single changes on the range split: sampler, number of samples, tracker, method, cutoff.

    Variants: the method under its own name, ``sampler grid``, ``sampler vogel``, ``n 512`` …, ``window 15`` …, each of
    ``others`` and ``wholes``, and ``cutoff x0.5``. The summary adds ``<variant>.median_rel_ratio``, the geometric
    mean over scenes of its error to the method's.

    Args:
        scenes, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; the first is ablated.
        n: numbers of samples.
        windows: sides of the tracking window, px.
        others: name → further methods to run unchanged.
        wholes: name → further methods that are run unchanged and taken apart as well: ``+ <stage> of <name>`` is the
            ablated method with one stage or option of the whole, ``- <stage> of <name>`` the whole with that of the
            ablated method. They enter no verdict.
    """
    name, method = next(iter(methods.items()))
    changed: dict[str, Method] = {
        name: method,
        "sampler grid": method.replace(sample=regular_grid),
        "sampler vogel": method.replace(sample=vogel_spiral),
        **{f"n {count}": method.replace(n=count) for count in n},
        **{f"window {side}": method.replace(track={"window": side}) for side in windows},
        **{other: m for other, m in (others or {}).items() if other != name},
    }
    judged = list(changed)
    for other, whole in (wholes or {}).items():
        changed[other] = whole
        for stage in (f.name for f in fields(Method)):
            ours, theirs = getattr(method, stage), getattr(whole, stage)
            if stage_key(ours) != stage_key(theirs):
                changed[f"+ {stage} of {other}"] = method.replace(**{stage: theirs})
                changed[f"- {stage} of {other}"] = whole.replace(**{stage: ours})
    variants = {k: Variant(m) for k, m in changed.items()}
    main = run_protocol(scenes, Protocol(variants), pairs, settings, progress=progress)
    half_cutoff = run_protocol(
        scenes,
        Protocol({"cutoff x0.5": Variant(method)}),
        pairs,
        replace(settings, cutoff_factor=0.5),
        progress=progress,
    )
    half_cutoff.summary = {f"cutoff x0.5.{k}": v for k, v in half_cutoff.summary.items()}
    outcome = join_outcomes([main, half_cutoff])
    ratios = {k: _error_ratio(outcome, k, name) for k in [*changed, "cutoff x0.5"] if k != name}
    for k, (value, count) in ratios.items():
        outcome.summary[f"{k}.median_rel_ratio"] = bootstrap.without_interval(value, count)
    return outcome.decide(
        "Which part of the method determines the result?",
        "No change of a single part lowers the median error by more than a tenth.",
        *verdict({k: ratios[k][0] for k in judged[1:]}),
    )


def verdict(ratios: Mapping[str, float | None]) -> tuple[bool | None, str]:
    """(no change lowers the error ratio below 0.9; the ratios)."""
    measured = {k: v for k, v in ratios.items() if v is not None}
    if not measured:
        return None, "no scene with answers"
    best = min(measured, key=lambda k: measured[k])
    ratios_text = ", ".join(f"{k} {v:.2f}" for k, v in measured.items())
    return measured[best] >= 0.9, f"error ratio to the method, geometric mean over scenes: {ratios_text}"


def _error_ratio(outcome: Outcome, variant: str, reference: str) -> tuple[float | None, int]:
    ours, base = outcome.scenes(variant), outcome.scenes(reference)
    logs = [
        math.log(ours[s]["median_rel"] / base[s]["median_rel"])
        for s in ours
        if s in base and ours[s].get("median_rel") and base[s].get("median_rel")
    ]
    return (math.exp(sum(logs) / len(logs)) if logs else None), len(logs)
