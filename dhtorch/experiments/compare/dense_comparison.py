"""Question: can every far pixel have a depth as accurate as a sparse answer, or else no answer?

Expectation (written before the run): a sweep under the sparse method's motions answers at least half of the hidden
pixels, with or without texture; where sparse answers as well its median error is at most 1.15 times theirs; on the
samples of the sparse method it answers as many at 5 % mean risk; its score orders errors half as badly as chance at
most; sigma is right to .07 in other rooms; semi-global matching under the same motion is no better; nothing is answered
where the camera only turns, and one answer in twenty at most is wrong by a fifth.
What would refute it: any of these numbers missed.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import Gate, is_estimated
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.scene import SceneLike, scenes_of
from dhtorch.experiments import compare_methods as compare
from dhtorch.experiments.baselines import stereo
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.experiments.outcome import Bars, Row, join_outcomes, judge_bars
from dhtorch.experiments.protocol import (
    MIN_CANDIDATES,
    Answer,
    Batch,
    Cohort,
    Outcome,
    Progress,
    Protocol,
    ScenePairs,
    Settings,
    Variant,
    held_back_truth,
    no_progress,
    run_protocol,
    spread_pairs,
)
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.filters import grayscale
from dhtorch.geometry.patches import sample_nearest
from dhtorch.metrics import bootstrap, errors, holdout, map_quality, risk
from dhtorch.metrics.errors import Points
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.records import DepthMap, Estimate, Frame, Pose, PoseFit, Samples
from dhtorch.synthetic import SyntheticRoom

#: Number → (least, largest) value.
DENSE_BARS: Bars = {
    "dense.answered": (0.50, math.inf),
    "dense.error_ratio_to_sparse": (-math.inf, 1.15),
    "dense.coverage_ratio_at_5_indoor": (1.0, math.inf),
    "dense.ause_ratio": (-math.inf, 0.5),
    "dense.within_sigma": (0.61, 0.75),
    "dense.within_2sigma": (0.90, math.inf),
    "dense.error_ratio_to_sgbm": (-math.inf, 1.0),
    "dense.rotation_answered": (-math.inf, 0.003),
    "dense.convoy_wrong": (-math.inf, 0.01),
    "dense.wrong_share": (-math.inf, 0.05),
    "dense.room_within_1": (0.90, math.inf),
    "dense.artefact_share": (-math.inf, 0.02),
    "dense.room_step_wrong_share": (-math.inf, 0.10),
}

#: Variants: all pixels of the map; the map sampled at the sparse method's samples; the map from one source view, for
#: comparison with two-view baselines.
DENSE_VARIANT, AT_SAMPLES, _ONE_VIEW = "dense", "dense, at samples", "dense, one view"
_PEERS = ("sgbm", "sgbm, own calibration", "dis flow", "bilateral")

#: Cohorts: pairs that can be rectified, and all.
_RECTIFIABLE, FULL_COHORT = "rectifiable", "full"


#: Sparse answers and maps of one reference view, computed once for all variants: ``reference``, ``trace`` of the sparse
#: method, ``maps`` by the number of source views, ``at_samples`` (the joint answers at the samples; of a method without
#: them, the map's), ``grid`` (pixels of the map that are evaluated), ``other`` (the best source view), ``T_1_from_0``
#: (NaN where the pose failed), ``ms``.
ReferenceSweep = SimpleNamespace


class _SweepCache:
    """Cache of one reference view: the sparse method runs once, the sweep once per number of source views."""

    def __init__(self, options: Mapping[str, Any], stride: int) -> None:
        self.options, self.stride = dict(options), stride
        self._last: ReferenceSweep | None = None

    def estimate(
        self,
        compute: Callable[[ReferenceSweep], tuple[Samples, Estimate]],
        method: Method,
        *views: Frame,
        **options: Any,
    ) -> Estimate:
        """Estimate of one variant at a reference view, in the signature of :attr:`protocol.Variant.estimate`."""
        trace = options.pop("trace")
        reference, others = views
        if self._last is None or self._last.reference is not reference:
            self._last = self._sweep(method, reference, others, options)
        sweep = self._last
        trace |= sweep.trace
        samples, estimate = compute(sweep)
        # (B,) whether the relative pose puts both epipoles outside the images, as rectification needs
        inside = stereo.is_epipole_inside(
            ((reference.camera, reference.hw), (sweep.other.camera, sweep.other.hw)), sweep.T_1_from_0
        )
        rectifiable = ~inside & sweep.T_1_from_0.t.isfinite().all(-1)
        trace |= {"samples": samples, "ms": dict(sweep.ms), "rectifiable": rectifiable}
        trace["map"] = sweep.maps[max(sweep.maps)]
        return estimate

    def _sweep(
        self, method: Method, reference: Frame, others: Frame, call_options: Mapping[str, Any]
    ) -> ReferenceSweep:
        trace: Trace = {}
        method = method.replace(track=call_options["track"])
        complete = method.complete or _sweep_alone
        start = time.perf_counter()
        estimate = method.replace(complete=None)(
            reference, others, seed=call_options["seed"], hint=call_options["hint"], trace=trace
        )
        selected = dense.selected_views(estimate, others, trace)
        ms = {"sparse": 1e3 * (time.perf_counter() - start)}
        maps: dict[int, DepthMap] = {}
        for source_views in (1, self.options.get("source_views", 3)):
            start = time.perf_counter()
            at_samples, maps[source_views] = complete(
                method, reference, selected, **{**self.options, "source_views": source_views}
            )
            ms[f"sweep_{source_views}"] = 1e3 * (time.perf_counter() - start)
        hw = next(iter(maps.values())).depth.shape[-2:]
        centres = dense.map_pixel_centres(reference, (hw[0], hw[1])).unflatten(0, hw)
        half = self.stride // 2
        grid = method.backproject(reference, centres[half :: self.stride, half :: self.stride].reshape(-1, 2))
        index, _ = dense.top_views(selected, 1)
        best = index[0], torch.arange(len(index[0]), device=index.device)
        fit = selected.fits[best]
        R = torch.where(fit.ok[:, None, None], fit.T_1_from_0.R, torch.nan)
        t = torch.where(fit.ok[:, None], fit.T_1_from_0.t, torch.nan)
        return ReferenceSweep(
            reference=reference,
            trace={**trace, "sparse": estimate},
            maps=maps,
            at_samples=at_samples,
            grid=grid,
            other=selected.frames[best],
            T_1_from_0=Pose(R, t),
            ms=ms,
        )


def _sweep_alone(
    method: Method, reference: Frame, selected: dense.SelectedViews, **options: Any
) -> tuple[Estimate, DepthMap]:
    """The sweep in the place of the stage ``complete``."""
    depth_map = dense.sweep_depth(reference, selected, method=method, **options)
    return sample_map(depth_map, selected.samples, reference), depth_map


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    method: Method | None = None,
    sweep: Mapping[str, Any] | None = None,
    stride: int = 4,
    reference_views: int | None = None,
    peers: bool = True,
    indoor: Sequence[str] = (),
    rotations: Sequence[SceneLike] = (),
    convoys: Sequence[SceneLike] = (),
    rooms: Sequence[int] = (0, 1, 2),
    progress: Progress = no_progress,
) -> Outcome:
    """Error, coverage and calibration of dense maps, beside sparse answers and dense baselines under the same poses.

    Rows of the variants ``sparse`` and ``dense, at samples`` cover the method's own samples (with texture, as in every
    protocol), all others pixels of the map, with or without texture. The summary holds ``dense.answered`` (median over
    scenes), ``dense.error_ratio_to_sparse`` (geometric mean over scenes of the ratio of median errors on samples that
    both answer), ``dense.coverage_at_5_indoor`` and ``sparse.coverage_at_5_indoor`` (means over scenes of the
    ``indoor`` rooms, on the samples) with their ratio ``dense.coverage_ratio_at_5_indoor``,
    ``dense.pixels_at_5_indoor`` (on all pixels), ``dense.ause_ratio`` (median over scenes), ``dense.within_sigma`` and
    the other numbers of :func:`dhtorch.experiments.compare_methods.evaluate_promises`, ``dense.wrong_share`` (mean over
    scenes), ``dense.artefact_share`` and ``dense.step_wrong_share`` (means over scenes of medians over reference views:
    artefacts over swept pixels, and wrong answers over answers beside a true depth step, with raw truth, see
    :mod:`dhtorch.metrics.map_quality`), ``dense.error_ratio_to_sgbm`` (one source view each, rectifiable pairs, equal
    coverage; geometric mean), ``dense.error_ratio_to_<peer>`` likewise, ``dense.rotation_answered``,
    ``dense.convoy_wrong`` (largest fraction of the candidates of a scene with the role ``moving`` that are answered and
    wrong) and ``dense.room_within_1`` and ``dense.room_step_wrong_share``.

    Args:
        scenes, chosen, pairs, settings, progress: as :func:`dhtorch.experiments.protocol.run`; of ``pairs``
            only the reference views are used.
        method: the sparse method; None = the job's.
        sweep: options of :func:`dhtorch.pipeline.dense.sweep_depth`.
        stride: spacing of the evaluated pixels of the map, in both directions, px.
        reference_views: number of reference views of a scene, evenly spaced; None = all.
        peers: run the baselines as well.
        indoor: rooms over which the coverages at 5 % are averaged.
        rotations: further scenes in which the camera only turns.
        convoys: further scenes in which near objects move.
        rooms: seeds of built-in rooms with exact depth and poses.

    Raises:
        ValueError: an option out of range; else as the main job.
    """
    for name, value in {"stride": stride, "reference_views": 1 if reference_views is None else reference_views}.items():
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"experiment.{name}: found {value!r}, expected a whole number of at least 1")
    sparse = method or next(iter(chosen.values()))
    options = dict(sweep or {})
    all_scenes = list(scenes_of(scenes))
    for scene in (*scenes_of(rotations), *scenes_of(convoys)):
        all_scenes += [scene] if scene.name not in {listed.name for listed in all_scenes} else []
    cache = _SweepCache(options, stride)
    variants = _variants(sparse, cache, settings.seed, peers)
    spread = partial(spread_pairs, pairs, reference_views)
    parts = []
    for is_rotation in (False, True):  # also rotations without a candidate count
        selected = [scene for scene in all_scenes if (scene.role == "rotation") == is_rotation]
        cohorts: dict[str, Cohort] = {
            _RECTIFIABLE: partial(_far_cohort, rectifiable_only=True),
            FULL_COHORT: _far_cohort,
        }
        dense_protocol = Protocol(
            variants,
            cohorts=cohorts,
            columns=_map_columns,
            min_candidates=0 if is_rotation else MIN_CANDIDATES,
        )
        parts.append(run_protocol(selected, dense_protocol, spread, settings, progress=progress))
    outcome = join_outcomes(parts)
    outcome.summary |= _summary(outcome, {scene.name: scene.place for scene in all_scenes}, indoor, peers)
    outcome.summary |= compare.rotation_answered(outcome.rows, [DENSE_VARIANT])
    outcome.summary |= compare.worst_wrong_share(DENSE_VARIANT, _moving_points(outcome))
    if rooms:
        outcome.summary |= _measure_rooms(rooms, sparse, options)
    return outcome.decide(
        "Can every far pixel have a depth as accurate as a sparse answer, or else no answer?",
        (
            "Every number of the list of bars is met; scenes are the unit, thresholds hold in rooms they were "
            "not fitted on."
        ),
        *verdict(outcome, peers),
    )


def verdict(outcome: Outcome, peers: bool = True) -> tuple[bool | None, str]:
    """(all bars met, or None if undecided; the bars that are missed and the numbers that are undefined)."""
    holds, why = judge_bars(outcome.summary, DENSE_BARS)
    rows = outcome.scenes("sgbm", _RECTIFIABLE) if peers else {}
    lost = sorted(scene for scene, row in rows.items() if not row.get("n_candidates"))
    return holds, f"{why}; no pair can be rectified: {', '.join(lost)}" if lost else why


def sample_map(depth_map: DepthMap, samples: Samples, frame: Frame) -> Estimate:
    """Map at samples of its frame → estimate: swept depth of the nearest pixel, else the gate that rejected it."""
    h, w = depth_map.depth.shape[-2:]
    map_uv = cam.depth_pixels(frame.camera, frame.hw, None, (h, w), samples.uv)
    depth, sigma, score, source, gate = (
        sample_nearest(x.to(depth_map.depth), map_uv)[0]
        for x in (depth_map.depth, depth_map.sigma, depth_map.score, depth_map.source, depth_map.gate)
    )
    keep = is_estimated(source)
    gate = torch.where(gate == Gate.ANSWER, Gate.NO_TRACK, gate)
    return Estimate.unanswered(samples, Gate.NO_TRACK, n_views=2).replace(
        depth=torch.where(keep, depth, torch.nan),
        sigma=torch.where(keep, sigma, torch.nan),
        score=torch.where(keep, score, 0.0),
        gate=torch.where(keep, Gate.ANSWER, gate).to(torch.int32),
    )


def _variants(method: Method, cache: _SweepCache, seed: int, peers: bool) -> dict[str, Variant]:
    max_views = cache.options.get("source_views", 3)

    def at(k: int) -> Callable[[ReferenceSweep], tuple[Samples, Estimate]]:
        return lambda x: (x.grid, sample_map(x.maps[k], x.grid, x.reference))

    answers: dict[str, Callable[[ReferenceSweep], tuple[Samples, Estimate]]] = {
        "sparse": lambda x: (x.trace["samples"], x.trace["sparse"]),
        AT_SAMPLES: lambda x: (x.trace["samples"], x.at_samples),
        _ONE_VIEW: at(1),
        DENSE_VARIANT: at(max_views),
    }
    if peers:
        answers |= {
            "sgbm": lambda x: (x.grid, _match_semi_global(x, x.T_1_from_0)),
            "dis flow": lambda x: (x.grid, stereo.match_optical_flow(x.reference, x.other, x.T_1_from_0, x.grid)),
            "bilateral": lambda x: (x.grid, stereo.fill_bilateral(x.reference, x.grid)),
        }
    variants = {
        name: Variant(method, estimate=partial(cache.estimate, answer), seed=seed, offers=candidate_frames)
        for name, answer in answers.items()
    }
    if peers:
        own_calibration = partial(cache.estimate, _match_own_calibration)
        variants["sgbm, own calibration"] = Variant(
            method,
            estimate=own_calibration,
            seed=seed,
            offers=candidate_frames,
            needs=lambda scene: None if scene.recording.format == "rectified" else "not a rectified pair",
        )
    return variants


def _match_semi_global(sweep: ReferenceSweep, T_1_from_0: Pose) -> Estimate:
    samples = sweep.trace["samples"]
    nearest = torch.where(samples.usable, samples.depth, 0.0).amax(-1)
    nearest = torch.where(nearest > 0, 0.7 * nearest, 1.0)
    return stereo.match_semi_global(sweep.reference, sweep.other, T_1_from_0, sweep.grid, nearest_m=nearest)


def _match_own_calibration(sweep: ReferenceSweep) -> tuple[Samples, Estimate]:
    """Semi-global matching under the relative pose that the data set states."""
    a, b = sweep.reference.T_world_from_cam, sweep.other.T_world_from_cam
    assert a is not None and b is not None
    T = se3.compose(se3.invert(b), a).map(lambda x: x.to(sweep.grid.uv))
    return sweep.grid, _match_semi_global(sweep, T)


def _far_cohort(batch: Batch, trace: Trace, *, rectifiable_only: bool = False) -> holdout.Truth:
    """Held-back returns that pass the truth test; those without texture count only for variants on all pixels."""
    truth = held_back_truth(batch, trace)
    code = truth.code
    if trace["samples"].uv.shape[1] != trace["sparse"].uv.shape[1]:  # on pixels
        code = torch.where(code == holdout.TruthCode.TEXTURE, holdout.TruthCode.CANDIDATE, code)
    if rectifiable_only:
        code = torch.where(trace["rectifiable"][:, None], code, holdout.TruthCode.EXCLUDED)
    return truth.replace(code=code)


def _map_columns(answer: Answer) -> Row:
    """Shares of artefacts, and of wrong answers beside true depth steps, of the map of one reference view."""
    if answer.variant != DENSE_VARIANT:
        return {}
    depth_map: DepthMap = answer.trace["map"]
    hw = depth_map.depth.shape[-2], depth_map.depth.shape[-1]
    centres = dense.map_pixel_centres(answer.batch.exact, hw)[None]
    truth = holdout.sample_truth(answer.batch.exact, centres, truth="raw")
    depth = torch.where(truth.code == holdout.TruthCode.CANDIDATE, truth.depth, 0.0).unflatten(1, hw)
    counts = torch.ones_like(depth, dtype=torch.bool)
    if answer.batch.odd:
        kind = sample_nearest(answer.batch.surface, centres)[0].unflatten(1, hw)
        counts = ~torch.isin(kind, torch.tensor([*answer.batch.odd], dtype=kind.dtype, device=kind.device))
    shares = (map_quality.artefact_counts(depth_map), map_quality.step_counts(depth_map, depth, counts))
    names = ("artefact_share", "step_wrong_share")
    return {name: part / whole for name, (part, whole) in zip(names, shares, strict=True) if whole}


def _summary(outcome: Outcome, rooms: Mapping[str, str], indoor: Sequence[str], peers: bool) -> Row:
    points_of = {name: _scene_points(outcome, name) for name in ("sparse", AT_SAMPLES, DENSE_VARIANT)}
    rows: dict[str, Row] = {scene: {} for scene in points_of[DENSE_VARIANT]}
    summary: Row = {}
    for number, value in compare.evaluate_promises(
        {s: [p] for s, p in points_of[DENSE_VARIANT].items()}, rooms, rows, 2000, 0
    ).items():
        summary[f"dense.{number}"] = value.entry(errors.metric_unit(number))
    for scene, points in points_of[DENSE_VARIANT].items():
        rows[scene] |= {"ause_ratio": risk.ause(points)}
        rows[scene]["error_ratio_to_sparse"] = _error_ratio(points_of[AT_SAMPLES][scene], points_of["sparse"][scene])
    metrics = [errors.measure_errors(points) for points in points_of[DENSE_VARIANT].values()]
    summary["dense.answered"] = _interval_over([m["coverage"] for m in metrics], "median")
    summary["dense.wrong_share"] = _interval_over([m["wrong_share"] for m in metrics], "mean")
    summary["dense.ause_ratio"] = _interval_over([row["ause_ratio"] for row in rows.values()], "median")
    for name in ("artefact_share", "step_wrong_share"):
        shares = [row.get(name) for scene, row in outcome.scenes(DENSE_VARIANT).items() if scene in rows]
        summary[f"dense.{name}"] = _interval_over(shares, "mean")
    ratios = [row["error_ratio_to_sparse"] for row in rows.values()]
    summary["dense.error_ratio_to_sparse"] = _interval_over(ratios, "geometric_mean")
    summary |= _indoor_coverage(points_of, {scene for scene in rows if rooms[scene] in indoor})
    for peer in _PEERS if peers else ():
        ours, theirs = (_scene_points(outcome, name, _RECTIFIABLE) for name in (_ONE_VIEW, peer))
        shared = [scene for scene in ours if scene in theirs]
        cut = compare.cut_to_equal_coverage({s: [ours[s]] for s in shared}, {s: [theirs[s]] for s in shared})
        equal, _ = compare.ratio_over_seeds(*cut, lambda p: errors.measure_errors(p)["median_rel"])
        name = f"error_ratio_to_{peer.replace(', ', '_').replace(' ', '_')}"
        for scene, ratio in equal.items():
            rows[scene][name] = ratio
        summary[f"dense.{name}"] = _interval_over(list(equal.values()), "geometric_mean")
    for scene, row in outcome.scenes(DENSE_VARIANT).items():
        row["dense"] = rows.get(scene, {})
    return summary


def _indoor_coverage(points_of: Mapping[str, Mapping[str, Points]], scenes: set[str]) -> Row:
    """Mean coverage at 5 % mean risk over the given scenes, of map and sparse answers, and their ratio."""
    coverages = {
        name: [risk.measure_risk(points)["coverage_at_5"] for scene, points in scene_points.items() if scene in scenes]
        for name, scene_points in points_of.items()
    }
    summary: Row = {
        "dense.coverage_at_5_indoor": _interval_over(coverages[AT_SAMPLES], "mean"),
        "sparse.coverage_at_5_indoor": _interval_over(coverages["sparse"], "mean"),
        "dense.pixels_at_5_indoor": _interval_over(coverages[DENSE_VARIANT], "mean"),
    }
    ours, theirs = (summary[f"{name}.coverage_at_5_indoor"]["value"] for name in ("dense", "sparse"))
    summary["dense.coverage_ratio_at_5_indoor"] = bootstrap.without_interval(
        ours / theirs if ours is not None and theirs else None, len(scenes)
    )
    return summary


def _error_ratio(ours: Points, theirs: Points) -> float | None:
    """Ratio of the median errors on samples that both answer; None if they are too few."""
    both = ours.keep & theirs.keep
    if int(both.sum()) < compare.MIN_COMPARED_ANSWERS:
        return None
    a, b = (float(p.error[both].median()) for p in (ours, theirs))
    return max(a, compare.MIN_COMPARED_ERROR) / max(b, compare.MIN_COMPARED_ERROR)


def _scene_points(outcome: Outcome, variant: str, cohort: str = FULL_COHORT) -> dict[str, Points]:
    """Scene → candidates, for scenes without a role that have any."""
    with_role = {row["scene"] for row in outcome.rows if row.get("role")}
    return {
        scene: points
        for (scene, name, truth_cohort), points in outcome.points.items()
        if (name, truth_cohort) == (variant, cohort) and scene not in with_role and points.keep.numel()
    }


def _moving_points(outcome: Outcome) -> list[list[Points]]:
    """Candidates of every scene in which near objects move."""
    moving = {row["scene"] for row in outcome.rows if row.get("role") == "moving"}
    return [
        [points]
        for (scene, *of), points in outcome.points.items()
        if scene in moving and of == [DENSE_VARIANT, FULL_COHORT]
    ]


def _interval_over(values: Sequence[float | None], statistic: str) -> Row:
    return bootstrap.interval_over_scenes(values, statistic=statistic).entry("1")


# ------------------------------------------------------------------- built-in rooms with exact depth and poses

#: Near limit of a room, m, and the frames of its reference view and source view.
_NEAR_LIMIT_M, _VIEW_FRAMES = 2.0, (3, 11)


def _measure_rooms(seeds: Sequence[int], method: Method, options: Mapping[str, Any]) -> Row:
    """Fraction of pixels within 1 %, mean over rooms: ``dense.room_within_1`` of answered pixels, ``…_of_all`` of all.

    Unanswered pixels count as misses in ``dense.room_within_1_of_all``. ``dense.room_step_wrong_share``: wrong answers
    over answers beside a depth step (:func:`dhtorch.metrics.map_quality.step_counts`). Pixels are those of
    :func:`evaluated_pixels`.
    """
    fractions = []
    for seed in seeds:
        room = SyntheticRoom(
            n_frames=max(_VIEW_FRAMES) + 1,
            hw=(480, 640),
            depth_hw=(480, 640),
            lidar="exact",
            image_noise=0.0,
            seed=seed,
        )
        reference, other = (room[k] for k in _VIEW_FRAMES)
        near_views = (holdout.range_split(view, _NEAR_LIMIT_M) for view in (reference, other))
        fit = exact_pose_fit(reference, other, method.n)
        with torch.no_grad():
            sparse = method.replace(views=1, select_views=None)
            depth_map = complete_depth(*near_views, method=sparse, fit=fit, **options)
        surface = room.truth(_VIEW_FRAMES[0])["surface"]
        codes = [code for code, name in room.surfaces.items() if name in room.odd_surfaces]
        odd = torch.isin(surface, torch.tensor(codes, dtype=surface.dtype))
        evaluated = evaluated_pixels(reference, other, odd)
        answered = evaluated & is_estimated(depth_map.source)
        right = int((answered & ((depth_map.depth - reference.depth).abs() < 0.01 * reference.depth)).sum())
        wrong, beside = map_quality.step_counts(depth_map, reference.depth, ~odd)
        parts = ((wrong, beside), (right, int(answered.sum())), (right, int(evaluated.sum())))
        fractions.append([part / max(whole, 1) for part, whole in parts])
    names = ("room_step_wrong_share", "room_within_1", "room_within_1_of_all")
    columns = zip(names, zip(*fractions, strict=True), strict=True)
    return {f"dense.{name}": _interval_over(values, "mean") for name, values in columns}


def exact_pose_fit(reference: Frame, other: Frame, n: int) -> PoseFit:
    """Relative pose from the frames' ``T_world_from_cam`` as a fit with standard deviations of 0.1 mm and 0.1 mrad."""
    a, b = reference.T_world_from_cam, other.T_world_from_cam
    assert a is not None and b is not None
    fit = known_pose_fit(se3.compose(se3.invert(b), a).map(lambda x: x.to(reference.camera.f)), n)
    one = torch.ones_like(fit.rms_px)
    cov = 1e-8 * torch.eye(6).to(fit.cov).expand(len(one), 6, 6)
    return fit.replace(
        cov=cov, inlier=~fit.inlier, n_inlier=fit.n_inlier + n, rms_px=one, sigma_px=0.1 * one, t_snr=1e3 * one
    )


def evaluated_pixels(reference: Frame, other: Frame, odd: Tensor) -> Tensor:
    """Mask (B, h, w) of pixels beyond the near limit with texture, on the same surface in the source view (depth within
    3 %), away from depth steps of 5 % within 11 x 11 pixels, and not near odd surfaces.

    Args:
        reference, other: frames with exact depth of their image's size.
        odd: (B, h, w) bool, surfaces whose image is not their own (mirrors, windows).
    """
    depth, grey = reference.depth, grayscale(reference.image)
    mean = F.avg_pool2d(grey, 9, 1, 4)
    contrast = (F.avg_pool2d(grey.square(), 9, 1, 4) - mean.square()).clamp_min(0).sqrt()[:, 0]
    low, high = (sign * F.max_pool2d(sign * depth, 11, 1, 5) for sign in (-1, 1))
    xyz = se3.apply(
        exact_pose_fit(reference, other, 1).T_1_from_0,
        cam.unproject(reference.camera, dense.map_pixel_centres(reference, reference.hw)[None], depth.flatten(1)),
    )
    depth_1, inside = sample_nearest(other.depth, cam.project(other.camera, xyz))
    visible = inside & ((depth_1 - xyz[..., 2]).abs() < 0.03 * xyz[..., 2])
    near_odd = F.max_pool2d(odd.to(depth), 9, 1, 4) > 0
    textured_far = (depth > _NEAR_LIMIT_M) & (contrast > 0.02)
    return textured_far & (high < 1.05 * low) & visible.unflatten(1, reference.hw) & ~near_odd
