"""Question: which part of a method carries its gain over the one before it, and what does each cost?

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

QUESTION = "Which part of a method carries its gain over the one before it, and what does each cost?"
EXPECTATION = "Either whole is better than every part alone, and no part can be left out without loss."

#: A loss in a ratio that is told from none: reordering the points of a search moves it as much.
_MIN_TELLING_RATIO = 1.05

#: Options of the pose that leave out far tracks, and a turn of the rows.
_NEAR_ONLY_OPTIONS: dict[str, Any] = {"far_weight": 0.0}
_GLOBAL_SHUTTER_OPTIONS: dict[str, Any] = {"shutter_sigma": 0.0}

#: Seat 6 as the paper has it: its gates, and how its sigma is made. The whole sets both differently.
PAPER_GATE_OPTIONS: dict[str, Any] = {
    "min_parallax_deg": 0.3,
    "max_residual_px": 3.0,
    "max_sigma_rel": None,
    "min_t_snr": None,
    "max_mismatch_px": None,
    "max_far_noise": None,
    "max_in_reach": None,
}
PAPER_SIGMA_OPTIONS: dict[str, Any] = {
    "fitted_noise": False,
    "isotropic": 0.1,
    "mismatch_px": None,
    "residual_px": None,
    "round_trip_px": None,
    "sigma_scale": 1.0,
    "sensor_share": 0.0,
}

#: What several views are replaced by on scenes that have too few. The others answer there with the views there are.
_SPARSE_SCENE_STAND_INS = {"+ views": "paper", "window": "map"}

#: Group → the whole, the number by which its parts alone are held against it, and that for what is left out of it.
ABLATION_GROUPS = {
    "map": ("map", "median_rel_ratio_at_equal_coverage", "aurc_ratio"),
    "auto": ("auto", "aurc_full_ratio_to_window", "aurc_full_ratio_to_window"),
}

#: What these numbers are called.
_NUMBER_LABELS = {
    "median_rel_ratio_at_equal_coverage": "error ratio at equal coverage",
    "aurc_ratio": "ratio of areas under risk–coverage",
    "aurc_full_ratio_to_window": "ratio to window of areas with silence as 1",
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
    """Each part of ``map`` put into ``paper`` alone, and each left out; the same of ``auto`` and ``window``.

    Numbers are those of ``method_comparison``, in which every variant is held against ``paper``, and those of several
    views against ``window`` as well; the summary adds ``<variant>.pair_ms``, the time of one pair (median over the
    pairs of a scene, then over scenes), and ``<variant>.extra_ms``, what of it the paper's does not take.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: ``paper``, ``map`` and ``window``, and ``auto`` where that is taken apart; None = ``chosen``.
        groups: what is taken apart, ``map`` or ``auto`` or both.
        seeds: how many, from the job's own upwards.

    Raises:
        ValueError: one of the methods is missing, or no such group; else as the main job.
    """
    methods = dict(methods or chosen)
    if not groups or not set(groups) <= ABLATION_GROUPS.keys():
        raise ValueError(f"experiment.groups: found {list(groups)}, expected some of {', '.join(ABLATION_GROUPS)}")
    if missing := {"paper", "map", "window", *groups} - methods.keys():
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {', '.join(sorted(missing))} too")
    of_group = {
        "map": build_map_ablations(methods["paper"], methods["map"], methods["window"]),
        "auto": build_auto_ablations(methods["window"], methods["auto"]) if "auto" in groups else {},
    }
    variants = {name: methods[name] for name in ("paper", "map", "window")}
    variants |= {
        name: method for group in ABLATION_GROUPS if group in groups for name, method in of_group[group].items()
    }
    options: dict[str, Any] = {"once": (), "seeds": seeds, "stand_ins": _SPARSE_SCENE_STAND_INS, "progress": progress}
    outcome = method_comparison.run(scenes, {}, pairs, settings, methods=variants, **options)
    cost = {name: _median_pair_ms(outcome, name) for name in variants}
    for name, ms in cost.items():
        more = None if ms is None or cost["paper"] is None else ms - cost["paper"]
        for number, value in (("pair_ms", ms), ("extra_ms", more)):
            outcome.summary[f"{name}.{number}"] = bootstrap.without_interval(value, len(outcome.scenes(name)), "ms")
    judged = [verdict(outcome.summary, group, list(of_group[group])) for group in ABLATION_GROUPS if group in groups]
    holds = None if any(held is None for held, _ in judged) else all(held for held, _ in judged)
    return outcome.decide(QUESTION, EXPECTATION, holds, "; ".join(why for _, why in judged))


def build_map_ablations(paper: Method, whole: Method, window: Method) -> dict[str, Method]:
    """Variant → method: the paper's, with one part of the whole (``+ …``), the whole, without one (``- …``)."""
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

    What is not in one of :data:`_ABLATION_PARTS` is a part of its own, under the name of its seat, where the two differ
    in it.
    """
    gated = _swap_contradiction_gates(_swap_sigma_gate(window, auto), auto)
    parts = _ABLATION_PARTS | {
        f"{seat} of auto": partial(_swap_stage, seat)
        for seat in ("sample", "backproject", "classify", "pose", "triangulate", "n", "hypotheses", "min_trackability")
        if stage_key(getattr(gated, seat)) != stage_key(getattr(auto, seat))
    }
    alone = {f"+ {name}": part(window, auto) for name, part in parts.items()}
    return {**alone, "auto": auto, **{f"- {name}": part(auto, window) for name, part in parts.items()}}


def _swap_start(method: Method, other: Method) -> Method:
    """The other's start of the search; it is not chained where either method's is not."""
    return method.replace(track=_with_start(method.track, other.track), chain=method.chain and other.chain)


def _swap_exposure(method: Method, other: Method) -> Method:
    """All that the other's tracker does otherwise, but for the start: what it makes of different exposures."""
    return method.replace(track=_with_start(other.track, method.track))


def _swap_views(method: Method, other: Method) -> Method:
    """The other's views; those on both sides of a reference view are no chain."""
    return method.replace(select_views=other.select_views, views=other.views, chain=method.chain and other.chain)


def _swap_gates(names: Sequence[str], method: Method, other: Method) -> Method:
    """Limits of the other's seat 6."""
    own, theirs = ({name: _find_option(m.triangulate, name) for name in names} for m in (method, other))
    changed = {name: value for name, value in theirs.items() if value != own[name]}
    return method.replace(triangulate=changed) if changed else method


#: Views that may be unsure as long as they are sure together, and near returns that what lies far contradicts.
_swap_sigma_gate = partial(_swap_gates, ("max_sigma_rel",))
_swap_contradiction_gates = partial(_swap_gates, ("max_far_noise", "max_in_reach"))


def _swap_stage(seat: str, method: Method, other: Method) -> Method:
    return method.replace(**{seat: getattr(other, seat)})


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
    """A tracker with the start of another."""
    own, start = (_find_option(seat, "start") for seat in (track, other))
    return track if stage_key(own) == stage_key(start) else partial(track, start=start)


def _find_option(seat: Any, name: str) -> Any:
    """What a partial, or one inside it, says of an option; None where none does."""
    while isinstance(seat, partial):
        if name in seat.keywords:
            return seat.keywords[name]
        seat = seat.func
    return None


def verdict(summary: Mapping[str, Any], group: str, names: Sequence[str]) -> tuple[bool | None, str]:
    """Hold the parts of one group against its whole."""
    whole, equal, area = ABLATION_GROUPS[group]

    def value(name: str, number: str) -> float | None:
        found: float | None = summary.get(f"{name}.{number}", {}).get("value")
        return found

    alone, left_out = ({n: value(n, k) for n in names if n.startswith(sign)} for sign, k in (("+", equal), ("-", area)))
    limits = value(whole, equal), value(whole, area)
    if limits[0] is None or limits[1] is None:
        return None, f"no scene on which {whole} can be held against the method before it"
    better = [n for n, v in alone.items() if v is not None and v < limits[0] / _MIN_TELLING_RATIO]
    idle = [n for n, v in left_out.items() if v is not None and v < limits[1] / _MIN_TELLING_RATIO]
    shown = ", ".join(f"{n} {v:.2f}" for n, v in {**alone, whole: limits[0]}.items() if v is not None)
    left = ", ".join(f"{n} {v:.2f}" for n, v in {whole: limits[1], **left_out}.items() if v is not None)
    why = f"{_NUMBER_LABELS[equal]}: {shown}; {_NUMBER_LABELS[area]}: {left}"
    if better or idle:
        why = f"{why}; alone better than the whole: {better or 'none'}; better without: {idle or 'none'}"
    return not better and not idle, why


def _median_pair_ms(outcome: Outcome, variant: str) -> float | None:
    times = [sum(row["ms"].values()) for row in outcome.scenes(variant).values() if "ms" in row]
    return median_or_none(times)
