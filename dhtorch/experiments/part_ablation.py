"""Question: which part of the method carries its gain over the paper's, and what does each cost?

Expectation (written before the run): the parts need each other. Alone, put in the paper's place, far tracks in the pose
gain most and a registration of tracks gains little; gates and scores change what is answered, not how well; the whole
is better than every single part, at equal coverage, and leaving any part out of it raises the area under the
risk–coverage curve.
What would refute it: a single part better than the whole at equal coverage, or a part whose absence lowers that area by
more than a twentieth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dhtorch.experiments import method_comparison, protocol
from dhtorch.experiments.protocol import Method, Outcome, Pairs, Progress, Settings, refill
from dhtorch.experiments.rows import median

QUESTION = "Which part of the method carries its gain over the paper's, and what does each cost?"
EXPECTATION = "The whole is better than every part alone, and no part can be left out without loss."

#: A loss in a ratio that is told from none: reordering the points of a search moves it as much.
TELLING = 1.05

#: Options of the pose that leave out far tracks, and a turn of the rows.
NEAR_ONLY: dict[str, Any] = {"far_weight": 0.0}
NO_TURN: dict[str, Any] = {"turn_sigma": 0.0}

#: Gates of seat 6; the paper's and the whole's set them differently. What else differs there is how sigma is made.
GATES = ("min_parallax_deg", "max_residual_px", "max_sigma_rel", "min_t_snr", "max_mismatch_px")

#: Options by which several views of one anchor are joined.
VIEWS = ("views", "chain", "fuse")

#: What several views are replaced by on scenes that have too few.
STAND_INS = {"+ views": "paper", "window": "map"}


def run(
    recordings: Sequence[Any],
    chosen: Mapping[str, Method],
    pairs: Pairs,
    settings: Settings,
    *,
    methods: Mapping[str, Method] | None = None,
    seeds: int = 2,
    progress: Progress = protocol.quiet,
) -> Outcome:
    """Each part of ``map`` put into ``paper`` alone, and each left out of the whole.

    Numbers are those of ``method_comparison``, in which every variant is held against ``paper``; the summary adds
    ``<variant>.pair_ms``, the time of one pair (median over the pairs of a scene, then over scenes), and
    ``<variant>.extra_ms``, what of it the paper's does not take.

    Args:
        recordings, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: ``paper``, ``map`` and ``window``; None = ``chosen``.
        seeds: how many, from the job's own upwards.

    Raises:
        ValueError: one of the three is missing; else as the main job.
    """
    methods = dict(methods or chosen)
    if missing := {"paper", "map", "window"} - methods.keys():
        raise ValueError(f"experiment.methods: found {', '.join(methods)}, expected {', '.join(sorted(missing))} too")
    variants = taken_apart(methods["paper"], methods["map"], methods["window"])
    options: dict[str, Any] = {"once": (), "seeds": seeds, "stand_ins": STAND_INS, "progress": progress}
    outcome = method_comparison.run(recordings, {}, pairs, settings, methods=variants, **options)
    cost = {name: _pair_ms(outcome, name) for name in variants}
    for name, ms in cost.items():
        more = None if ms is None or cost["paper"] is None else ms - cost["paper"]
        for number, value in (("pair_ms", ms), ("extra_ms", more)):
            entry = {"value": value, "low": None, "high": None, "n": len(outcome.scenes(name)), "unit": "ms"}
            outcome.summary[f"{name}.{number}"] = entry
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome.summary))


def taken_apart(paper: Method, whole: Method, window: Method) -> dict[str, Method]:
    """Variant → method: the paper's, with one part of the whole (``+ …``), the whole, without one (``- …``)."""
    own, base = whole.keywords, paper.keywords
    near = refill(own["pose"], **NEAR_ONLY, **NO_TURN)
    gates = {k: base["triangulate"].keywords[k] for k in GATES}
    sigma = {k: v for k, v in base["triangulate"].keywords.items() if k not in (*GATES, "solver")}
    plain = refill(base["track"], levels=own["track"].keywords["levels"])
    several = {k: window.keywords[k] for k in VIEWS}
    return {
        "paper": paper,
        "+ affine tracks": refill(paper, track=own["track"]),
        "+ weighted near pose": refill(paper, pose=near),
        "+ near and far pose": refill(paper, pose=refill(own["pose"], **NO_TURN)),
        "+ pose with turn": refill(paper, pose=own["pose"]),
        "+ sigma and gates": refill(paper, triangulate=own["triangulate"]),
        "+ score by error": refill(paper, score=own["score"]),
        "+ views": refill(paper, window.func, **several),
        "map": whole,
        "- affine tracks": refill(whole, track=plain),
        "- far tracks": refill(whole, pose=NEAR_ONLY),
        "- turn": refill(whole, pose=NO_TURN),
        "- pose": refill(whole, pose=base["pose"]),
        "- gates": refill(whole, triangulate=gates),
        "- sigma": refill(whole, triangulate=sigma),
        "- score by error": refill(whole, score=base["score"]),
        "window": window,
    }


def verdict(summary: Mapping[str, Any]) -> tuple[bool | None, str]:
    """Hold the parts against the whole."""

    def value(name: str, number: str) -> float | None:
        found: float | None = summary.get(f"{name}.{number}", {}).get("value")
        return found

    equal, area = "median_rel_ratio_at_equal_coverage", "aurc_ratio"
    names = list(dict.fromkeys(k.rpartition(".")[0] for k in summary if k.endswith(f".{area}")))
    if value("map", equal) is None or value("map", area) is None:
        return None, "no scene on which the whole can be held against the paper's method"
    ratios = {n: value(n, equal) for n in names if n.startswith("+")}
    areas = {n: value(n, area) for n in names if n.startswith("-")}
    better = [n for n, v in ratios.items() if v is not None and v < value("map", equal) / TELLING]  # type: ignore[operator]
    idle = [n for n, v in areas.items() if v is not None and v < value("map", area) / TELLING]  # type: ignore[operator]
    shown = ", ".join(f"{n} {v:.2f}" for n, v in {**ratios, "map": value("map", equal)}.items() if v is not None)
    left = ", ".join(f"{n} {v:.2f}" for n, v in {"map": value("map", area), **areas}.items() if v is not None)
    why = f"error ratio at equal coverage: {shown}; ratio of areas under risk–coverage: {left}"
    if better or idle:
        why = f"{why}; alone better than the whole: {better or 'none'}; better without: {idle or 'none'}"
    return not better and not idle, why


def _pair_ms(outcome: Outcome, variant: str) -> float | None:
    times = [sum(row["ms"].values()) for row in outcome.scenes(variant).values() if "ms" in row]
    return median(times)
