"""Question: which parts account for a method's gain over the one before it, and what does each cost?

Expectation (written before the run): the parts need each other. Of ``map``, put in the paper's place alone, far tracks
in the pose gain most and a registration of tracks gains little; gates and scores change what is answered, not how well;
the whole is better than every single part, at equal coverage, and leaving any part out of it raises the area under the
risk–coverage curve. Of ``auto``, put into ``window`` alone, chosen views gain most and joining those that agree comes
next; the start and the exposure count where motions are long or exposures differ, so on few scenes; the whole leaves a
smaller area over all candidates, silence as an error of one, than every single part, and than itself without any part.
What would refute it: a single part better than the whole by more than a twentieth, in the error at equal coverage
(``map``) or that area (``auto``), or a part whose absence lowers the area by more than that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from dhtorch.data.scene import SceneLike
from dhtorch.experiments import protocol
from dhtorch.experiments.compare import method_comparison
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings
from dhtorch.experiments.rows import median_or_none
from dhtorch.experiments.shared_tracks import stage_key
from dhtorch.metrics import bootstrap
from dhtorch.pipeline.presets import MAP_PYRAMID_LEVELS

QUESTION = "Which parts account for a method's gain over the one before it, and what does each cost?"
EXPECTATION = "Either whole is better than every part alone, and no part can be left out without loss."

#: Least change of a ratio that counts: reordering the points of a search changes it by as much.
_MIN_TELLING_RATIO = 1.05

#: Options of the pose without far tracks.
_NEAR_ONLY_OPTIONS: dict[str, Any] = {"far_weight": 0.0}

#: Options of the pose without a rolling shutter.
_GLOBAL_SHUTTER_OPTIONS: dict[str, Any] = {"shutter_sigma": 0.0}

#: Gates of the triangulation stage as in the paper; ``map`` has others.
PAPER_GATE_OPTIONS: dict[str, Any] = {
    "min_parallax_deg": 0.3,
    "max_residual_px": 3.0,
    "max_sigma_rel": None,
    "min_t_snr": None,
    "max_mismatch_px": None,
    "max_far_noise": None,
    "max_in_reach": None,
}

#: Sigma of the triangulation stage as in the paper; ``map`` has another.
PAPER_SIGMA_OPTIONS: dict[str, Any] = {
    "fitted_noise": False,
    "isotropic": 0.1,
    "mismatch_px": None,
    "residual_px": None,
    "round_trip_px": None,
    "sigma_scale": 1.0,
    "sensor_share": 0.0,
}

#: Variant of several views → variant that replaces it on scenes with too few; others use the views there are.
_SPARSE_SCENE_STAND_INS = {"+ views": "paper", "window": "map"}

#: Group → (complete method, metric that compares it with single parts, metric that compares it without a part).
ABLATION_GROUPS = {
    "map": ("map", "median_rel_ratio_at_equal_coverage", "aurc_ratio"),
    "auto": ("auto", "aurc_full_ratio_to_window", "aurc_full_ratio_to_window"),
}

#: Metric → its label in the verdict.
_NUMBER_LABELS = {
    "median_rel_ratio_at_equal_coverage": "error ratio at equal coverage",
    "aurc_ratio": "ratio of areas under risk–coverage",
    "aurc_full_ratio_to_window": "ratio to window of areas with unanswered as risk 1",
}


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    groups: Sequence[str] = ("map", "auto"),
    seeds: int = 2,
    progress: Progress = protocol.no_progress,
) -> Outcome:
    """Ablation: each part of ``map`` added to ``paper`` alone, and each left out of ``map``; likewise for ``auto``.

    The metrics are those of ``method_comparison``: every variant is compared with ``paper``, and those of several views
    with ``window`` as well; the summary adds ``<variant>.pair_ms``, the time of one pair (median over the pairs of a
    scene, then over scenes), and ``<variant>.extra_ms``, its difference to the time of ``paper``.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: ``paper``, ``map`` and ``window``, and ``auto`` if it is in ``groups``; None = ``chosen``.
        groups: methods to ablate, ``map`` or ``auto`` or both.
        seeds: number of seeds, from the job's own upwards.

    Raises:
        ValueError: one of the methods is missing, or no such group; else as the main job.
    """
    methods = dict(methods or chosen)
    if not groups or not set(groups) <= ABLATION_GROUPS.keys():
        raise ValueError(f"experiment.groups: found {list(groups)}, expected some of {', '.join(ABLATION_GROUPS)}")
    if missing := {"paper", "map", "window", *groups} - methods.keys():
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {', '.join(sorted(missing))} too")
    ablations = {
        "map": build_map_ablations(methods["paper"], methods["map"], methods["window"]),
        "auto": build_auto_ablations(methods["window"], methods["auto"]) if "auto" in groups else {},
    }
    variants = {name: methods[name] for name in ("paper", "map", "window")}
    variants |= {
        name: method for group in ABLATION_GROUPS if group in groups for name, method in ablations[group].items()
    }
    options: dict[str, Any] = {"once": (), "seeds": seeds, "stand_ins": _SPARSE_SCENE_STAND_INS, "progress": progress}
    outcome = method_comparison.run(scenes, {}, pairs, settings, methods=variants, baselines=("window",), **options)
    pair_ms = {name: _median_pair_ms(outcome, name) for name in variants}
    for name, ms in pair_ms.items():
        extra = None if ms is None or pair_ms["paper"] is None else ms - pair_ms["paper"]
        for number, value in (("pair_ms", ms), ("extra_ms", extra)):
            outcome.summary[f"{name}.{number}"] = bootstrap.without_interval(value, len(outcome.scenes(name)), "ms")
    verdicts = [verdict(outcome.summary, group, list(ablations[group])) for group in ABLATION_GROUPS if group in groups]
    holds = None if any(met is None for met, _ in verdicts) else all(met for met, _ in verdicts)
    return outcome.decide(QUESTION, EXPECTATION, holds, "; ".join(why for _, why in verdicts))


def build_map_ablations(paper: Method, whole: Method, window: Method) -> dict[str, Method]:
    """Variant → method: ``paper``, with one part of ``map`` (``+ …``), ``map``, and without one part (``- …``)."""
    return {
        "paper": paper,
        "+ affine tracks": paper.replace(track=whole.track),
        "+ weighted near pose": paper.replace(
            pose=partial(whole.pose, **_NEAR_ONLY_OPTIONS, **_GLOBAL_SHUTTER_OPTIONS)
        ),
        "+ near and far pose": paper.replace(pose=partial(whole.pose, **_GLOBAL_SHUTTER_OPTIONS)),
        "+ pose with turn": paper.replace(pose=whole.pose),
        "+ sigma and gates": paper.replace(triangulate=whole.triangulate),
        "+ score by error": paper.replace(score=whole.score),
        "+ views": paper.replace(views=window.views, chain=window.chain, fuse=window.fuse),
        "map": whole,
        "- affine tracks": whole.replace(track=partial(paper.track, levels=MAP_PYRAMID_LEVELS)),
        "- far tracks": whole.replace(pose=_NEAR_ONLY_OPTIONS),
        "- turn": whole.replace(pose=_GLOBAL_SHUTTER_OPTIONS),
        "- pose": whole.replace(pose=paper.pose),
        "- gates": whole.replace(triangulate=PAPER_GATE_OPTIONS),
        "- sigma": whole.replace(triangulate=PAPER_SIGMA_OPTIONS),
        "- score by error": whole.replace(score=paper.score),
        "window": window,
    }


def build_auto_ablations(window: Method, auto: Method) -> dict[str, Method]:
    """Variant → method: one part of ``auto`` in ``window`` (``+ …``), ``auto``, and ``auto`` without one (``- …``).

    A stage or option in which the two differ and that is not in :data:`_ABLATION_PARTS` is a part of its own, named
    after its stage.
    """
    gated = _swap_contradiction_gates(_swap_sigma_gate(window, auto), auto)
    parts = _ABLATION_PARTS | {
        f"{stage} of auto": partial(_swap_stage, stage)
        for stage in _COMPARED_STAGES
        if stage_key(getattr(gated, stage)) != stage_key(getattr(auto, stage))
    }
    alone = {f"+ {name}": part(window, auto) for name, part in parts.items()}
    return {**alone, "auto": auto, **{f"- {name}": part(auto, window) for name, part in parts.items()}}


def _swap_start(method: Method, other: Method) -> Method:
    """Method with the other's initial displacement; chained only if both methods are."""
    return method.replace(track=_with_start(method.track, other.track), chain=method.chain and other.chain)


def _swap_exposure(method: Method, other: Method) -> Method:
    """Method with the other's tracker except for its start: its handling of different exposures."""
    return method.replace(track=_with_start(other.track, method.track))


def _swap_views(method: Method, other: Method) -> Method:
    """Method with the other's source views; views on both sides of a reference view are not chained."""
    return method.replace(select_views=other.select_views, views=other.views, chain=method.chain and other.chain)


def _swap_gates(names: Sequence[str], method: Method, other: Method) -> Method:
    """Method with the other's limits ``names`` of the triangulation stage."""
    own, theirs = ({name: _find_option(m.triangulate, name) for name in names} for m in (method, other))
    changed = {name: value for name, value in theirs.items() if value != own[name]}
    return method.replace(triangulate=changed) if changed else method


#: Stages and options of a method that are a part of their own where they differ.
_COMPARED_STAGES = (
    *("sample", "backproject", "classify", "pose", "verify", "triangulate", "verify_views", "guide", "n"),
    *("pose_samples", "hypotheses", "min_trackability"),
)

#: Limit of the sigma of a single view, before views are fused.
_swap_sigma_gate = partial(_swap_gates, ("max_sigma_rel",))

#: Limits of near returns that contradict far answers.
_swap_contradiction_gates = partial(_swap_gates, ("max_far_noise", "max_in_reach"))


def _swap_stage(stage: str, method: Method, other: Method) -> Method:
    return method.replace(**{stage: getattr(other, stage)})


#: Part → (method, other) → the method with that part of the other.
_ABLATION_PARTS: dict[str, Callable[[Method, Method], Method]] = {
    "start": _swap_start,
    "exposure": _swap_exposure,
    "chosen views": _swap_views,
    "agreement": partial(_swap_stage, "fuse"),
    "score by sigma": partial(_swap_stage, "score"),
    "unsure views": _swap_sigma_gate,
    "contradiction": _swap_contradiction_gates,
}


def _with_start(track: Any, other: Any) -> Any:
    """Tracker with the start of another."""
    own, start = (_find_option(stage, "start") for stage in (track, other))
    return track if stage_key(own) == stage_key(start) else partial(track, start=start)


def _find_option(stage: Any, name: str) -> Any:
    """Value of an option of a partial or of one nested in it; None if it is not set."""
    while isinstance(stage, partial):
        if name in stage.keywords:
            return stage.keywords[name]
        stage = stage.func
    return None


def verdict(summary: Mapping[str, Any], group: str, names: Sequence[str]) -> tuple[bool | None, str]:
    """(no part alone beats the complete method, nor does leaving one out; the ratios), of one group."""
    whole, alone_metric, without_metric = ABLATION_GROUPS[group]

    def value(name: str, number: str) -> float | None:
        entry: float | None = summary.get(f"{name}.{number}", {}).get("value")
        return entry

    alone, left_out = (
        {n: value(n, k) for n in names if n.startswith(sign)}
        for sign, k in (("+", alone_metric), ("-", without_metric))
    )
    whole_values = value(whole, alone_metric), value(whole, without_metric)
    if whole_values[0] is None or whole_values[1] is None:
        return None, f"no scene on which {whole} can be compared with the method before it"
    better = [n for n, v in alone.items() if v is not None and v < whole_values[0] / _MIN_TELLING_RATIO]
    idle = [n for n, v in left_out.items() if v is not None and v < whole_values[1] / _MIN_TELLING_RATIO]
    alone_text = ", ".join(f"{n} {v:.2f}" for n, v in {**alone, whole: whole_values[0]}.items() if v is not None)
    without_text = ", ".join(f"{n} {v:.2f}" for n, v in {whole: whole_values[1], **left_out}.items() if v is not None)
    why = f"{_NUMBER_LABELS[alone_metric]}: {alone_text}; {_NUMBER_LABELS[without_metric]}: {without_text}"
    if better or idle:
        why = f"{why}; alone better than the whole: {better or 'none'}; better without: {idle or 'none'}"
    return not better and not idle, why


def _median_pair_ms(outcome: Outcome, variant: str) -> float | None:
    times = [sum(row["ms"].values()) for row in outcome.scenes(variant).values() if "ms" in row]
    return median_or_none(times)
