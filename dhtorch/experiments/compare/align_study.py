"""Question: does alignment make any depth map as metric as the references allow, and leave a correct map unchanged?

The true map of a frame is distorted in controlled ways, aligned to the frame's near returns and far answers, and
compared with the truth beyond the near limit. Faults in shape and scale like a network's enter the ratio; faults of
files (unit, mirrored, rolled, wrong camera, wrong time) are reported separately.

Expectation (written before the run): a map off by 1.3 % in shape and 5 % in scale is right to 2 %; over the faults the
error is at most half that of an affine fit to the near returns; nowhere is it, less .2 %, more than 1.05 times that of
the better of the raw and the near-only map; sigma is right to .07.
What would refute it: any of these numbers missed.

The constants of :mod:`dhtorch.alignment.error_model` and :mod:`dhtorch.alignment.references` were chosen on
``data=shared_scenes``, so the results on these scenes are no independent test. Map and near returns come from one
sensor here: a near-only fit of a rescaled map is nearly exact, more than a network's would be.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.alignment import align
from dhtorch.alignment.references import collect_references
from dhtorch.codes import is_estimated
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.recording import TruthRecording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import Bars, MainMetric, Row, judge_bars, mean_or_none
from dhtorch.experiments.protocol import Outcome, Progress, ScenePairs, Settings, no_progress, spread_pairs
from dhtorch.geometry import camera as cam
from dhtorch.geometry.patches import sample_nearest
from dhtorch.metrics import bootstrap
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.pytree import stack
from dhtorch.records import Frame
from dhtorch.synthetic import depth_faults
from dhtorch.synthetic.depth_faults import NETWORK_FAULTS, WRONG_TIME

# Usual metric alignments of a depth map: scale, or scale and shift, from pixels with depth of both.

#: Number of RANSAC trials.
_N_RANSAC_TRIALS = 200

#: Largest relative error of an inlier.
_MAX_INLIER_ERROR = 0.05


def fit_median_scale(x: Tensor, z: Tensor) -> tuple[float, float]:
    """Map values x and depths z, (n,) each → (scale with median ratio one, shift 0); scale NaN without points."""
    return (float((z / x).median()), 0.0) if len(x) else (float("nan"), 0.0)


def fit_scale_shift(x: Tensor, z: Tensor) -> tuple[float, float]:
    """Map values x and depths z, (n,) each → (s, t) minimising Σ(s x + t − z)²; NaN with fewer than two points."""
    if len(x) < 2:
        return float("nan"), float("nan")
    A = torch.stack((x, torch.ones_like(x)), -1).double()
    return tuple(torch.linalg.lstsq(A, z.double()[:, None]).solution[:, 0].tolist())


def fit_scale_shift_ransac(x: Tensor, z: Tensor, *, seed: int = 0) -> tuple[float, float]:
    """Map values x and depths z, (n,) each → (s, t) by RANSAC, refined by least squares on the inliers."""
    if len(x) < 2:
        return float("nan"), float("nan")
    draw = torch.randint(len(x), (_N_RANSAC_TRIALS, 2), generator=torch.Generator().manual_seed(seed))
    (x0, x1), (z0, z1) = x[draw].double().unbind(-1), z[draw].double().unbind(-1)
    s = (z1 - z0) / torch.where(x1 == x0, torch.nan, x1 - x0)
    t = z0 - s * x0
    inlier = (s[:, None] * x + t[:, None] - z).abs() < _MAX_INLIER_ERROR * z
    best = inlier[inlier.sum(-1).argmax()]
    return fit_scale_shift(x[best], z[best])


#: Number → (least, largest) value.
ALIGN_BARS: Bars = {
    "align.simulated_median": (0.0, 0.02),
    "align.ratio_to_near_affine": (0.0, 0.5),
    "align.worst_ratio_to_better": (-math.inf, 1.05),
    "align.within_sigma": (0.61, 0.75),
    "align.within_2sigma": (0.90, math.inf),
}

#: (all bars met, or None if one is undefined; the bars that are missed or undefined) of a summary.
verdict = partial(judge_bars, bars=ALIGN_BARS)

#: Method names in rows: ours, the unaligned map, and the fit to near returns alone.
_OURS, _RAW, _NEAR_ONLY = "align", "raw", "near least squares"
_PEERS = (_RAW, _NEAR_ONLY, "least squares", "median ratio", "ransac")

#: Relative error that is subtracted from ours before the ratio to the better of two maps is taken.
_NEGLIGIBLE_ERROR = 0.002

#: Offset of the map from another time, frames.
_WRONG_TIME_FRAMES = 3

#: Fewest pixels with truth beyond the near limit for a frame to be evaluated.
_MIN_FAR_PIXELS = 200


def run(
    scenes: Sequence[SceneLike],
    methods: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    reference_views: int | None = 2,
    size: int = 320,
    swept: bool = False,
    faults: Sequence[str] | None = None,
    progress: Progress = no_progress,
) -> Outcome:
    """Errors of faulty maps after alignment by :func:`dhtorch.alignment.align.align_depth` and by global fits.

    Rows: one per scene, fault (``truth``) and method, with ``median_rel`` (median relative error beyond the near
    limit), ``within_sigma`` and ``within_2sigma`` (answered pixels with truth) and ``answered``; for ours also
    ``models``, how often each model was selected. Summary: see :data:`ALIGN_BARS`, each also as ``<key>_one_left_out``
    (median, minimum and maximum with one scene left out); ``align.<fault>_median`` for every fault (median over
    scenes).

    Args:
        scenes: those without a near limit, of a sparse sensor or with a role are left out with a note in their row.
        methods: name → method; the first one computes near returns and far answers.
        pairs: scene → pairs, of which only the reference views are used.
        settings: of the job.
        reference_views: number of reference views of a scene, evenly spaced; None = all.
        size: longer side of the maps, px.
        swept: add the depths of a plane sweep to the far answers.
        faults: names from :data:`dhtorch.synthetic.depth_faults.DEPTH_FAULTS`, or ``time``; None = all.
        progress: as for the main job.

    Raises:
        ValueError: an unknown fault, a size below 16.
    """
    names = tuple(faults) if faults is not None else (*depth_faults.DEPTH_FAULTS, WRONG_TIME)
    if unknown := set(names) - {*depth_faults.DEPTH_FAULTS, WRONG_TIME}:
        raise ValueError(f"experiment.faults: found {', '.join(sorted(unknown))}, expected some of {', '.join(names)}")
    if size < 16:
        raise ValueError(f"experiment.size: found {size}, expected at least 16")
    method = next(iter(methods.values()))

    def evaluate_scene(scene: Scene) -> Outcome:
        near = settings.cutoff_of(scene)
        note = f"role {scene.role}" if scene.role is not None else None if near is not None else "no near limit"
        if note := note or ("sparse sensor: no dense true map" if scene.recording.sparse else None):
            return Outcome([_scene_row(scene, _OURS, None) | {"note": note}])
        assert near is not None
        case_rows: dict[tuple[str, str], list[Row]] = {}
        n = len(scene.recording)
        frames = sorted({pair[0] for pair in spread_pairs(pairs, reference_views, scene)})
        for i in progress(frames, scene.name, len(frames)):
            references = _references(scene, i, method, settings, near, size=size if swept else None)
            other = i + _WRONG_TIME_FRAMES if i + _WRONG_TIME_FRAMES < n else max(i - _WRONG_TIME_FRAMES, 0)
            views = {k: scene.recording[k].to(settings.dtype) for k in (i, other)}
            truth = [_true_map(scene, k, view, size) for k, view in views.items()]
            for name, method_name, row in _evaluate_maps(truth, references, views[i].hw, near, names, i):
                case_rows.setdefault((name, method_name), []).append(row)
        scene_rows = [
            _scene_row(scene, method_name, name) | _mean_over_frames(rows)
            for (name, method_name), rows in case_rows.items()
        ]
        return Outcome(scene_rows, n_pairs=len(frames))

    outcome = settings.finished.run(
        scenes_of(scenes),
        evaluate_scene,
        metrics=(
            MainMetric("simulated_median", larger_is_better=False),
            MainMetric("ratio_to_near_affine", larger_is_better=False),
            MainMetric("worst_ratio_to_better", larger_is_better=False),
            MainMetric("within_sigma", larger_is_better=None),
            MainMetric("within_2sigma", larger_is_better=None),
        ),
    )
    outcome.summary = summarise_alignment(outcome.rows, names) | leave_one_scene_out(outcome.rows, names)
    return outcome.decide(
        "Does alignment make any depth map as metric as the references allow, and leave a correct map unchanged?",
        "Every number of the list of bars is met; scenes are the unit.",
        *verdict(outcome.summary),
    )


def summarise_alignment(rows: Sequence[Row], names: Sequence[str]) -> Row:
    """Scene rows, fault names → the numbers of :data:`ALIGN_BARS` and the median error of every fault and method."""
    row_of = {(r["scene"], r["truth"], r["method"]): r for r in rows if r.get("median_rel") is not None}
    scenes = sorted({scene for scene, _, _ in row_of})

    def errors(name: str, method: str) -> list[float | None]:
        return [row_of.get((scene, name, method), {}).get("median_rel") for scene in scenes]

    summary: Row = {}
    for method in (_OURS, *_PEERS):
        key = method.replace(" ", "_")
        for name in names:
            summary[f"{key}.{name}_median"] = bootstrap.interval_over_scenes(errors(name, method)).entry("1")
    ratios, worst = torch.full((len(scenes), len(names)), torch.nan, dtype=torch.float64), []
    for column, name in enumerate(names):
        for row, (ours, raw, near) in enumerate(
            zip(*(errors(name, method) for method in (_OURS, _RAW, _NEAR_ONLY)), strict=True)
        ):
            if name not in NETWORK_FAULTS or ours is None or raw is None or near is None:
                continue
            ratios[row, column] = ours / max(near, 1e-6)
            worst.append((ours - _NEGLIGIBLE_ERROR) / max(min(raw, near), 1e-6))
    network_rows = [r for (_, name, method), r in row_of.items() if method == _OURS and name in NETWORK_FAULTS]
    with_ratio = ratios[ratios.isfinite().any(1)]
    median_ratio = bootstrap.interval_of_statistic(
        lambda index: with_ratio[index].flatten(1).nanquantile(0.5, -1), len(with_ratio)
    )
    summary["align.ratio_to_near_affine"] = median_ratio.entry("1")
    summary["align.worst_ratio_to_better"] = bootstrap.without_interval(max(worst) if worst else None, len(scenes))
    for key in ("within_sigma", "within_2sigma"):
        means = [mean_or_none([r[key] for r in network_rows if r["scene"] == scene]) for scene in scenes]
        summary[f"align.{key}"] = bootstrap.interval_over_scenes(means, statistic="mean").entry("1")
    return summary


def leave_one_scene_out(rows: Sequence[Row], names: Sequence[str]) -> Row:
    """Jackknife of :data:`ALIGN_BARS` over scenes: median, minimum and maximum with one scene left out."""
    scenes = sorted({row["scene"] for row in rows if row.get("median_rel") is not None})
    summaries = [summarise_alignment([row for row in rows if row["scene"] != scene], names) for scene in scenes]
    left_out: Row = {}
    for key in ALIGN_BARS:
        values = sorted(summary[key]["value"] for summary in summaries if summary.get(key, {}).get("value") is not None)
        if len(scenes) > 1 and values:
            median = float(torch.tensor(values, dtype=torch.float64).median())
            left_out[f"{key}_one_left_out"] = bootstrap.without_interval(median, len(values)) | {
                "low": values[0],
                "high": values[-1],
            }
    return left_out


def _references(
    scene: Scene, i: int, method: Method, settings: Settings, near: float, *, size: int | None
) -> list[Any]:
    """Near returns and far answers of reference view ``i``, with a ``size`` also the depths of a plane sweep."""

    def near_view(k: int) -> Frame:
        return range_split(scene.recording[k].to(settings.dtype).to(settings.device), near)

    trace: Trace = {}
    views = near_view(i), stack([near_view(k) for k in candidate_frames(scene.recording, i)])
    options: dict[str, Any] = {"seed": settings.seed, "hint": scene.hint, "trace": trace}
    with torch.no_grad():
        if size is None:
            far = method(*views, **options)
            return [trace["samples"], far]
        swept = complete_depth(*views, method=method, size=size, calibration=default_calibration(), **options)
    # the swept depths as the map's only answers: the sensor's returns are references of their own
    gate = torch.where(is_estimated(swept.source), swept.gate, 1).to(torch.int32)
    return [trace["samples"], trace["fused"], swept.replace(gate=gate)]


def _true_map(scene: Scene, i: int, frame: Frame, size: int) -> Tensor:
    """True depth (1, h, w) at the pixels of a map: the recording's exact depth or the sensor's; 0 = none."""
    if isinstance(scene.recording, TruthRecording):
        depth = scene.recording.truth(i)["depth"].to(frame.depth)
        frame = frame.replace(depth=depth, depth_camera=frame.camera, conf=None)
    hw = dense.map_hw(frame.hw, size)
    uv = dense.map_pixel_centres(frame, hw)[None]
    depth_hw = (frame.depth.shape[-2], frame.depth.shape[-1])
    depth_uv = cam.depth_pixels(frame.camera, frame.hw, frame.depth_camera, depth_hw, uv)
    z, inside = sample_nearest(frame.depth, depth_uv)
    if frame.conf is not None:
        z = torch.where(sample_nearest(frame.conf, depth_uv)[0] > 0, z, 0.0)
    z = torch.where(inside & z.isfinite() & (z > 0), z, 0.0)
    return z.unflatten(1, hw)


def _evaluate_maps(
    truth: Sequence[Tensor],  # true maps (1, h, w) m of the frame and of another time, 0 = no truth
    references: Sequence[Any],
    hw: tuple[int, int],
    near: float,
    names: Sequence[str],
    seed: int,
) -> Iterator[tuple[str, str, Row]]:
    """Maps, references, fault names → (fault, method, metrics), for our alignment and the usual global fits."""
    true, other = truth
    has_truth, far = true > 0, (true > 0) & (true > near)
    for name in names if int(far.sum()) >= _MIN_FAR_PIXELS else ():
        faulty, _ = depth_faults.apply_fault(name, true, seed=seed, other=other)
        trace: dict[str, align.ModelSelection] = {}
        with torch.no_grad():
            ours = align.align_depth(faulty, references, hw=hw, trace=trace)
        error, chosen = (ours.depth - true).abs(), trace["chosen"]
        answered = ours.keep & has_truth
        row = {
            "median_rel": _median_relative_error(ours.depth, true, far & ours.keep),
            "answered": float(answered.sum() / (has_truth & (faulty > 0)).sum().clamp_min(1)),
            "within_sigma": float((error <= ours.sigma)[answered].double().mean()),
            "within_2sigma": float((error <= 2 * ours.sigma)[answered].double().mean()),
            "model": "none" if int(chosen.model) < 0 else chosen.names[int(chosen.model)],
        }
        yield name, _OURS, row
        points = collect_references(torch.where(faulty > 0, faulty, torch.nan), references, hw)
        value, z, is_near = (x[0][points.used[0]] for x in (points.x, points.depth, points.near))
        fits = {
            _RAW: (1.0, 0.0),
            _NEAR_ONLY: fit_scale_shift(value[is_near], z[is_near]),
            "least squares": fit_scale_shift(value, z),
            "median ratio": fit_median_scale(value[is_near], z[is_near]),
            "ransac": fit_scale_shift_ransac(value, z),
        }
        for peer, (s, t) in fits.items():
            yield name, peer, {"median_rel": _median_relative_error(s * faulty + t, true, far & (faulty > 0))}


def _median_relative_error(depth: Tensor, truth: Tensor, where: Tensor) -> float | None:
    """Median relative error over ``where``; None if it is empty."""
    return float(((depth - truth).abs() / truth)[where].median()) if bool(where.any()) else None


def _mean_over_frames(rows: Sequence[Row]) -> Row:
    """Rows of a scene's frames → the mean of every metric, and how often each model was selected."""
    metrics = ("median_rel", "answered", "within_sigma", "within_2sigma")
    means: Row = {k: mean_or_none([r[k] for r in rows if r[k] is not None]) for k in metrics if k in rows[0]}
    models = [r["model"] for r in rows if "model" in r]
    return (
        means
        | {"n_pairs": len(rows)}
        | ({"models": {k: models.count(k) for k in sorted(set(models))}} if models else {})
    )


def _scene_row(scene: Scene, method: str, fault: str | None) -> Row:
    return {"scene": scene.name, "pair": None, "method": method, "truth": fault, "role": scene.role}
