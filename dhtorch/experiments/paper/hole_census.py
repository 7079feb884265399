"""Question: are most of the sensor's holes trackable in the picture?

Expectation (written before the run): yes; most holes are TRACKABLE_NO_LIDAR (the paper: 90.4 % indoors, 86.1 %
outdoors), and their trackability is of the same order as that of samples with a return.
What would refute it: on the median scene fewer than half of the holes are of that class, or their median trackability
is below a tenth of that of samples with a return.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from dhtorch.codes import ROUTE_OF_HOLE, Hole, Route, names
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import MainMetric, Row, mean_or_none, median_or_none
from dhtorch.experiments.protocol import Method, Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.metrics import errors
from dhtorch.records import Samples


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    stride: int = 1,
    progress: Progress = no_progress,
) -> Outcome:
    """Classes of holes and trackability of the samples of every frame; nothing is hidden, no second view is used.

    Rows: one per frame (``pair`` is [i, i]) and one per scene: ``n_samples``, ``n_holes``, ``hole_rate``,
    ``hole_share.<class>``, ``route_share.<route>`` and the median trackability of trackable holes
    (``trackability_hole``) and of samples with a return (``trackability_valid``).

    Args:
        scenes, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        methods: name → method; stages 1 to 3 of the first are used.
        pairs: not used.
        stride: step between frames.

    Source: paper, "Hole taxonomy".
    """
    name, method = next(iter(methods.items()))

    def count_scene(scene: Scene) -> Outcome:
        recording = scene.recording
        frames = list(range(0, len(recording), stride))
        rows = []
        for i in progress(frames, recording.name, len(frames)):
            rows.append({"scene": recording.name, "pair": [i, i], "method": name, "truth": None})
            rows[-1] |= count_holes(classify_frame(method, recording[i].to(settings.dtype).to(settings.device)))
        return Outcome([*rows, _join_frames(rows, scene)], n_pairs=len(rows))

    outcome = settings.finished.run(
        scenes_of(scenes),
        count_scene,
        metrics=(
            MainMetric("hole_rate", larger_is_better=None),
            MainMetric("hole_share.trackable_no_lidar", larger_is_better=None),
            MainMetric("trackability_hole", larger_is_better=None),
            MainMetric("trackability_valid", larger_is_better=None),
        ),
    )
    scene_rows = [r for r in outcome.rows if r["pair"] is None and r["role"] is None]
    outcome.summary = errors.summarise_scenes(
        [{k: v for k, v in r.items() if k not in ("pair", "role")} for r in scene_rows]
    )
    return outcome.decide(
        "Are most of the sensor's holes trackable in the picture?",
        "At least half of the holes are TRACKABLE_NO_LIDAR, of trackability like that of samples with a return.",
        *verdict(outcome.summary),
    )


def verdict(summary: Mapping[str, Any]) -> tuple[bool | None, str]:
    """(most holes are trackable, about as well as returns; ratio and trackabilities), from scene medians."""
    ratio = summary.get("hole_share.trackable_no_lidar", {}).get("value")
    hole, valid = (summary.get(f"trackability_{k}", {}).get("value") for k in ("hole", "valid"))
    if ratio is None or hole is None or valid is None:
        return None, "no scene with both holes and returns"
    why = f"{ratio:.1%} of the holes are trackable; their trackability {hole:.2g} against {valid:.2g} (scene medians)"
    return ratio >= 0.5 and hole >= 0.1 * valid, why


def classify_frame(method: Method, frame: Any) -> Samples:
    """Classified samples of a frame, by stages 1 to 3 of a method."""
    with torch.no_grad():
        return method.sample_depth(frame)


def count_holes(samples: Samples) -> Row:
    """Classified samples (B = 1) → numbers of holes, ratios of their classes and routes, and trackability."""
    hole, quality = samples.hole[0], samples.trackability[0]
    n_holes = int((hole != Hole.NONE).sum())
    class_ratio = {k: float((hole == k).sum()) / n_holes if n_holes else None for k in names(Hole) if k != Hole.NONE}
    route_ratio = {r: sum(v or 0.0 for k, v in class_ratio.items() if ROUTE_OF_HOLE[k] == r) for r in names(Route)}
    open_hole, valid = quality[hole == Hole.TRACKABLE_NO_LIDAR], quality[hole == Hole.NONE]
    return {
        "n_samples": hole.numel(),
        "n_holes": n_holes,
        "hole_rate": n_holes / max(hole.numel(), 1),
        "hole_share": {names(Hole)[k].lower(): v for k, v in class_ratio.items()},
        "route_share": {names(Route)[r].lower(): v if n_holes else None for r, v in route_ratio.items()},
        "trackability_hole": median_or_none(open_hole.tolist()),
        "trackability_valid": median_or_none(valid.tolist()),
    }


def _join_frames(rows: Sequence[Row], scene: Scene) -> Row:
    """Rows of frames → scene row: sums of counts, mean ratios over frames with holes, median trackability."""
    row: Row = {"scene": scene.name, "pair": None, "method": rows[0]["method"], "truth": None}
    row |= {"role": scene.role, "n_pairs": len(rows)} | {k: sum(r[k] for r in rows) for k in ("n_samples", "n_holes")}
    row["hole_rate"] = row["n_holes"] / max(row["n_samples"], 1)
    for group in ("hole_share", "route_share"):
        with_holes = [r[group] for r in rows if r["n_holes"]]
        row[group] = {k: mean_or_none([g[k] for g in with_holes]) for k in rows[0][group]}
    for key in ("trackability_hole", "trackability_valid"):
        row[key] = median_or_none([r[key] for r in rows if r[key] is not None])
    return row
