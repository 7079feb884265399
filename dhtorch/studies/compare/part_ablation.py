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
from functools import partial
from typing import Any

from dhtorch.data.scene import Given
from dhtorch.evaluate import bootstrap
from dhtorch.methods import LEVELS
from dhtorch.studies import protocol
from dhtorch.studies.compare import method_comparison
from dhtorch.studies.protocol import Method, Outcome, Pairs, Progress, Settings
from dhtorch.studies.rows import median

QUESTION = "Which part of the method carries its gain over the paper's, and what does each cost?"
EXPECTATION = "The whole is better than every part alone, and no part can be left out without loss."

#: A loss in a ratio that is told from none: reordering the points of a search moves it as much.
TELLING = 1.05

#: Options of the pose that leave out far tracks, and a turn of the rows.
NEAR_ONLY: dict[str, Any] = {"far_weight": 0.0}
NO_TURN: dict[str, Any] = {"turn_sigma": 0.0}

#: Seat 6 as the paper has it: its gates, and how its sigma is made. The whole sets both differently.
PAPER_GATES: dict[str, Any] = {
    "min_parallax_deg": 0.3,
    "max_residual_px": 3.0,
    "max_sigma_rel": None,
    "min_t_snr": None,
    "max_mismatch_px": None,
}
PAPER_SIGMA: dict[str, Any] = {
    "fitted_noise": False,
    "isotropic": 0.1,
    "mismatch_px": None,
    "residual_px": None,
    "round_trip_px": None,
    "sigma_scale": 1.0,
    "sensor_share": 0.0,
}

#: What several views are replaced by on scenes that have too few.
STAND_INS = {"+ views": "paper", "window": "map"}


def run(
    scenes: Sequence[Given],
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
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.studies.protocol.run`.
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
    outcome = method_comparison.run(scenes, {}, pairs, settings, methods=variants, **options)
    cost = {name: _pair_ms(outcome, name) for name in variants}
    for name, ms in cost.items():
        more = None if ms is None or cost["paper"] is None else ms - cost["paper"]
        for number, value in (("pair_ms", ms), ("extra_ms", more)):
            outcome.summary[f"{name}.{number}"] = bootstrap.single(value, len(outcome.scenes(name)), "ms")
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome.summary))


def taken_apart(paper: Method, whole: Method, window: Method) -> dict[str, Method]:
    """Variant → method: the paper's, with one part of the whole (``+ …``), the whole, without one (``- …``)."""
    return {
        "paper": paper,
        "+ affine tracks": paper.replace(track=whole.track),
        "+ weighted near pose": paper.replace(pose=partial(whole.pose, **NEAR_ONLY, **NO_TURN)),
        "+ near and far pose": paper.replace(pose=partial(whole.pose, **NO_TURN)),
        "+ pose with turn": paper.replace(pose=whole.pose),
        "+ sigma and gates": paper.replace(triangulate=whole.triangulate),
        "+ score by error": paper.replace(score=whole.score),
        "+ views": paper.replace(views=window.views, chain=window.chain, fuse=window.fuse),
        "map": whole,
        "- affine tracks": whole.replace(track=partial(paper.track, levels=LEVELS)),
        "- far tracks": whole.replace(pose=NEAR_ONLY),
        "- turn": whole.replace(pose=NO_TURN),
        "- pose": whole.replace(pose=paper.pose),
        "- gates": whole.replace(triangulate=PAPER_GATES),
        "- sigma": whole.replace(triangulate=PAPER_SIGMA),
        "- score by error": whole.replace(score=paper.score),
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
