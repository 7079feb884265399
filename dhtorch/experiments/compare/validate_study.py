"""Question: does validation detect the errors of a depth map, and report unknown where there is no evidence?

Expectation (written before the run): a metre that is wrong by a tenth is found in 95 % of the pairs with a baseline, at
2 % false alarms; objects that stand elsewhere are told from the rest with an area under the curve of .95 where
something is said; of the pixels called consistent one in a hundred at most is a fifth off; a wrong unit, a mirrored, a
rolled, a late map, one that is not registered and a wrong focal length are named in nine of ten windows in which they
move the picture by two pixels. Ghosts of a card at 0.22 m, flying pixels and edge bleed are told from the rest with an
area under the curve of .95 where something is said.
What would refute it: any of these numbers missed.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import State, WrongCause, describe
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.recording import Recording, TruthRecording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.outcome import Bars, MainMetric, Row, judge_bars, mean_or_none
from dhtorch.experiments.protocol import Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.geometry import camera as cam
from dhtorch.geometry import plane_sweep, se3
from dhtorch.geometry.patches import rescale_field_of_view, sample_nearest
from dhtorch.metrics import bootstrap
from dhtorch.metrics.detection import auroc
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import DepthValidation, Frame
from dhtorch.synthetic import SyntheticRoom
from dhtorch.synthetic.depth_faults import RETURN_FAULTS, apply_fault, mirror_depth, scale_depth
from dhtorch.synthetic.near_card import add_near_card, card_over_map
from dhtorch.validation import faults
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS
from dhtorch.validation.validate import QUICK_METHOD, validate_against

# A fixed-threshold photometric check: the peer of :func:`dhtorch.validation.validate.validate_depth`.
#
# A pixel is projected into one source view by its depth and the relative pose; it is wrong if the grey values differ
# by more than a fixed threshold, else consistent. Texture, baseline, exposure and occlusion are ignored.

#: Difference of grey values in [0, 1] above which a pixel counts as wrong.
_WRONG_GREY_DIFFERENCE = 0.1


@torch.no_grad()
def photometric_difference(depth: Tensor, reference: Frame, selected: dense.SelectedViews) -> tuple[Tensor, Tensor]:
    """Depth map (B, h, w) in m → (grey difference to the best source view, states), (B, h, w) each.

    CANNOT_KNOW: no depth, no relative pose, or outside the source image. Gradient: none.
    """
    size = max(depth.shape[-2:])
    base = plane_sweep.make_reference_view(*dense.downscale_grey(reference, size))
    index, _ = dense.top_views(selected, 1)
    has_pose = selected.fits.ok.gather(0, index)[0]
    source_view = dense.source_view_of(selected, index[0], size, has_pose, base.image)
    inverse_depth = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    uv, front = plane_sweep.project_inverse_depth(source_view.view, base.ray, inverse_depth.flatten(1))
    grey, inside = plane_sweep.sample_bilinear(source_view.view.image, uv)
    visible = (inside & front).unflatten(-1, base.hw) & (depth > 0) & has_pose[:, None, None]
    difference = (grey[:, 0].unflatten(-1, base.hw) - base.image[:, 0]).abs()
    state = torch.where(difference > _WRONG_GREY_DIFFERENCE, State.WRONG, State.CONSISTENT)
    return torch.where(visible, difference, torch.nan), torch.where(visible, state, State.CANNOT_KNOW).to(torch.int32)


#: Number → (least, largest) value.
VALIDATE_BARS: Bars = {
    "validate.scale_detected": (0.95, math.inf),
    "validate.false_alarm": (-math.inf, 0.02),
    "validate.jump_auroc": (0.95, math.inf),
    "validate.called_right_wrong": (-math.inf, 0.01),
    "validate.named_worst": (0.90, math.inf),
    **{f"validate.{cause}_auroc": (0.95, math.inf) for cause in RETURN_FAULTS},
}

#: (all bars met, or None if undecided; the bars that are missed and the numbers that are undefined) of a summary.
verdict = partial(judge_bars, bars=VALIDATE_BARS)

#: Scale factors that are planted: name in rows → factor.
_SCALE_FAULTS = {"10_long": 1.1, "10_short": 1 / 1.1, "5_long": 1.05, "5_short": 1 / 1.05}

#: Planted maps whose pixels are validated one by one: faults of a single map, and the map of another time.
_PIXEL_FAULTS = ("none", "jumps", "invented", "warp_large", "cut", "time")

#: A scale is reported wrong if its interval excludes 1 and |log(scale)| exceeds this.
_MIN_ALARM_LOG_SCALE = 0.03

#: Relative error above which a pixel of a planted map counts as wrong.
_WRONG_PIXEL_ERROR = 0.2

#: Relative error up to which a pixel of a planted map counts as right where those between are left out.
_RIGHT_PIXEL_ERROR = 0.025

#: A reference view has a baseline if the median sigma / depth of its answers is at most this.
_MAX_BASELINE_SIGMA_REL = 0.05

#: Fewest answers of a reference view with a baseline.
_MIN_BASELINE_ANSWERS = 20

#: Frames of a window.
_WINDOW_FRAMES = 20

#: A fault counts if it moves the median pixel by at least this, px of an image 640 wide.
_MIN_FAULT_MOTION_PX = 2.0

#: Columns of the estimated scale → suffix of their summary keys: all evidence, triangulated points alone, and
#: triangulated points of the quick method alone.
_SCALE_COLUMN_SUFFIXES = {"scale": "", "scale_far": "_far", "quick_far": "_quick_far"}

#: Predictor of the pixels' states → prefix of its columns.
_PREDICTOR_PREFIXES = {"validate": "", "quick": "quick_", "photometric": "peer_"}


#: Fault → its kind, as dhtorch.validation.faults names it, and the options of :func:`_plant_fault`.
_PLANTED_FAULTS: dict[str, tuple[str | None, dict[str, Any]]] = {
    "none": (None, {}),
    "unit_mm": ("unit", {"spoil": partial(scale_depth, factor=1e3)}),
    "unit_m": ("unit", {"spoil": partial(scale_depth, factor=1e-3)}),
    "unit_inch": ("unit", {"spoil": partial(scale_depth, factor=1 / 0.0254)}),
    "mirrored": ("mirrored", {"spoil": mirror_depth}),
    "upside_down": ("mirrored", {"spoil": partial(torch.flip, dims=(-2,))}),
    "along_ray": ("along the ray", {"ray": True}),
    "inverse": ("inverse", {"spoil": lambda depth: torch.where(depth > 0, 3 / depth.clamp_min(1e-3), 0.0)}),
    "rolled_90": ("rolled", {"spoil": partial(faults.rot90_map, quarters=1)}),
    "rolled_180": ("rolled", {"spoil": partial(faults.rot90_map, quarters=2)}),
    "wide": ("registration", {"spoil": partial(rescale_field_of_view, factor=1 / 1.35)}),
    "narrow": ("registration", {"spoil": partial(rescale_field_of_view, factor=1.2)}),
    "beside": ("registration", {"spoil": partial(rescale_field_of_view, factor=1.0, right=-0.06)}),
    "late_3": ("time offset", {"lag": 3}),
    "early_4": ("time offset", {"lag": -4}),
    "focal_long": ("focal length", {"focal": 1.06}),
    "focal_short": ("focal length", {"focal": 0.93}),
}


def run(
    scenes: Sequence[SceneLike],
    chosen: Mapping[str, Method],
    pairs: ScenePairs,
    settings: Settings,
    *,
    method: Method | None = None,
    reference_views: int = 3,
    windows: int = 2,
    size: int = 320,
    rooms: Sequence[int] = (0, 1, 2),
    progress: Progress = no_progress,
) -> Outcome:
    """Detection rates of faults planted in true maps, from near returns and source views.

    Rows: one per reference view (``pair`` [i, i], method ``validate``), one per window and fault (``pair`` [first,
    last], method ``causes``), one per scene. In the summary, ratios of reference views are means over scenes with
    intervals over scenes:

    * ``validate.scale_detected`` and ``validate.false_alarm`` (all evidence); suffix ``_5`` for a scale wrong by a
      twentieth, ``_far`` for triangulated points alone;
    * ``validate.jump_auroc`` of pixels without a near return, ``_all`` of all pixels;
    * ``validate.ghost_auroc``, ``.flying_pixel_auroc`` and ``.edge_bleed_auroc`` of pixels with a state whose error is
      at least 20 % or at most 2.5 %; ``validate.cause_right`` of those that are called wrong and were
      planted, and for each cause, ``validate.cause_right_<cause>``; ``validate.outline_alarms``, sound pixels that are
      called wrong because of outlines alone, of those with a state;
    * ``validate.called_right_wrong``, ``_worst`` of the worst scene, ``_cut`` of clipped maps alone;
      ``validate.known``;
    * ``photometric.<key>`` of the photometric baseline; ``quick.<key>`` of
      :data:`dhtorch.validation.validate.QUICK_METHOD` without the images of other views, whose scale from
      triangulated points alone is ``_quick_far``.

    Ratios of windows: ``validate.named.<kind>``, their minimum ``validate.named_worst``, and ``validate.misnamed``
    where no fault was planted. Nothing is fitted to the scenes.

    Args:
        scenes, chosen, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        pairs: not used; source views are chosen among those around a reference view.
        method: the sparse method; None = the job's.
        reference_views: number of reference views of each scene, evenly spaced.
        windows: number of windows of each scene that is long enough.
        size: longer side of the map, px.
        rooms: seeds of built-in rooms, validated in addition to the scenes.

    Raises:
        ValueError: an option out of range; else as the main job.
    """
    for name, value in {"reference_views": reference_views, "windows": windows}.items():
        if not isinstance(value, int) or value < 0:
            raise ValueError(f"experiment.{name}: found {value!r}, expected a whole number of at least 0")
    selecting_method = with_view_selection(method or next(iter(chosen.values())))
    all_scenes = [scene for scene in scenes_of(scenes) if len(scene.recording) > 1]
    all_scenes += [
        Scene(
            SyntheticRoom(
                n_frames=_WINDOW_FRAMES + 2 * faults.MAX_LAG_FRAMES, hw=(240, 320), seed=seed, name=f"room_{seed}"
            ),
            near=2.0,
            gap=6,
        )
        for seed in rooms
    ]

    def evaluate_scene(scene: Scene) -> Outcome:
        def load(i: int) -> Frame:
            return scene.recording[i].to(settings.dtype).to(settings.device)

        n = len(scene.recording)
        count = min(n, reference_views)
        spread = progress(
            [(2 * k + 1) * n // (2 * count) for k in range(count)], f"{scene.name}: reference views", reference_views
        )
        reference_rows = [_reference_row(scene, i, load, selecting_method, settings, size) for i in spread]
        firsts = _first_frames(len(scene.recording), windows)
        window_rows = [
            r for k in progress(firsts, f"{scene.name}: windows", len(firsts)) for r in _window_rows(scene, k, load)
        ]
        rows = [*reference_rows, *window_rows, _scene_row(scene, reference_rows)]
        return Outcome(rows, n_pairs=len(reference_rows))

    outcome = settings.finished.run(
        all_scenes,
        evaluate_scene,
        metrics=(
            MainMetric("called_right_wrong", larger_is_better=False),
            MainMetric("called_wrong_right", larger_is_better=False),
            MainMetric("false_alarm", larger_is_better=False),
            MainMetric("scale_detected", larger_is_better=True),
            MainMetric("jump_auroc", larger_is_better=True),
        ),
    )
    outcome.summary = summarise_validation(outcome.rows)
    return outcome.decide(
        "Does validation detect the errors of a depth map, and report unknown where there is no evidence?",
        "Every number of the list of bars is met; scenes, and of causes windows, are the unit.",
        *verdict(outcome.summary),
    )


def summarise_validation(rows: Sequence[Row]) -> Row:
    """Rows of scenes and of windows → summary: key → value with its interval."""
    scene_rows = [row for row in rows if row["pair"] is None and row["role"] is None]
    keys = sorted(
        {name for row in scene_rows for name, value in row.items() if "." in name and not isinstance(value, str)}
    )
    summary: Row = {
        key: bootstrap.interval_over_scenes([row.get(key) for row in scene_rows], statistic="mean").entry("1")
        for key in keys
    }
    for predictor in _PREDICTOR_PREFIXES:
        rates = [
            row[f"{predictor}.called_right_wrong"]
            for row in scene_rows
            if row.get(f"{predictor}.called_right_wrong") is not None
        ]
        summary[f"{predictor}.called_right_wrong_worst"] = bootstrap.without_interval(
            max(rates, default=None), len(rates)
        )
    measured = [row for row in rows if row["method"] == "causes" and row["moved_px"] is not None]
    counted = [row for row in measured if row["planted_kind"] is not None and row["moved_px"] >= _MIN_FAULT_MOTION_PX]
    named_ratio = {}
    for kind in sorted({row["planted_kind"] for row in counted}):
        right = [float(row["named_kind"] == kind) for row in counted if row["planted_kind"] == kind]
        named_ratio[kind] = sum(right) / len(right)
        summary[f"validate.named.{kind.replace(' ', '_')}"] = bootstrap.without_interval(named_ratio[kind], len(right))
    summary["validate.named_worst"] = bootstrap.without_interval(min(named_ratio.values(), default=None), len(counted))
    clean = [
        float(row["named_kind"] is not None) for row in rows if row["method"] == "causes" and row["fault"] == "none"
    ]
    summary["validate.misnamed"] = bootstrap.without_interval(mean_or_none(clean), len(clean))
    return summary


# ------------------------------------------------------------------------------------------------------ single frames


def scale_alarm(scale: Tensor) -> bool | None:
    """Estimated scale (3,), value and interval → whether it is significantly wrong; None if it was not estimated."""
    value, low, high = (float(x) for x in scale)
    if math.isnan(value):
        return None
    return abs(math.log(value)) > _MIN_ALARM_LOG_SCALE and not low <= 1 <= high


def _reference_row(
    scene: Scene, i: int, load: Callable[[int], Frame], method: Method, settings: Settings, size: int
) -> Row:
    """One reference view → row: estimated scales and pixel counts of every planted map."""
    full, cutoff = load(i), settings.cutoff_of(scene)
    near = range_split(full, cutoff)
    candidates = candidate_frames(scene.recording, i)
    others = stack([range_split(load(k), cutoff) for k in candidates])
    selected, validate = _make_validator(method, scene, near, others, settings, size)
    _, validate_quick = _make_validator(with_view_selection(QUICK_METHOD), scene, near, others, settings, size)
    true_map = _true_map(scene.recording, i, full, size, method)
    hidden = selected.joined.keep & ~selected.samples.usable
    sigma_rel = (selected.joined.sigma / selected.joined.depth)[hidden]
    n = int(hidden.sum())
    median = float(sigma_rel.median()) if n else None
    is_wide = n >= _MIN_BASELINE_ANSWERS and median is not None and median <= _MAX_BASELINE_SIGMA_REL
    row: Row = {"scene": scene.name, "pair": [i, i], "method": "validate"}
    row |= {"n_answers": n, "stated": median, "baseline": is_wide}
    for name, factor in {"none": 1.0, **_SCALE_FAULTS}.items():
        validation, quick = (check(true_map * factor, views=False) for check in (validate, validate_quick))
        scale = {"scale": validation.scale[0], "scale_far": validation.scale_far[0], "quick_far": quick.scale_far[0]}
        row |= {f"{column}.{name}": scale_alarm(scale[column]) for column in _SCALE_COLUMN_SUFFIXES}
        row |= {f"{column}_value.{name}": float(scale[column][0] / factor) for column in _SCALE_COLUMN_SUFFIXES}
    other_time = candidates[-1] if candidates[-1] > i else candidates[0]
    other_map = _true_map(scene.recording, other_time, load(other_time), size, method)
    has_return = method.backproject(
        near, dense.map_pixel_centres(near, (true_map.shape[-2], true_map.shape[-1]))
    ).usable.unflatten(1, true_map.shape[-2:])
    for name in _PIXEL_FAULTS:
        faulty = true_map if name == "none" else apply_fault(name, true_map, seed=i, other=other_map)[0]
        validations = {"": validate(faulty), "quick_": validate_quick(faulty, views=False)}
        predictions = {prefix: (v.evidence.abs(), v.state) for prefix, v in validations.items()}
        predictions["peer_"] = photometric_difference(faulty, near, selected)
        for prefix, (score, state) in predictions.items():
            counts = _pixel_counts(name, faulty, true_map, score, state, has_return)
            row |= {f"{prefix}{k}": v for k, v in counts.items()}
    row["outline_alarms"] = _outline_alarms(validate(true_map))
    for name in RETURN_FAULTS:
        if name != "ghost":
            row |= _cause_columns(name, true_map, i, validate)
        elif full.T_world_from_cam is not None:
            row |= _ghost_columns(scene, i, load, method, settings, true_map)
    return row


def _ghost_columns(
    scene: Scene, i: int, load: Callable[[int], Frame], method: Method, settings: Settings, true_map: Tensor
) -> Row:
    """One reference view, with a card before it that is nearer than a sensor measures → columns of its ghosts."""
    view_pose = load(i).T_world_from_cam
    assert view_pose is not None

    def load_with_card(k: int) -> tuple[Frame, Tensor]:
        frame, card_depth = add_near_card(load(k), view_pose, seed=i)
        return range_split(frame, settings.cutoff_of(scene)), card_depth

    near, card_depth = load_with_card(i)
    candidates = candidate_frames(scene.recording, i)
    if any(load(k).T_world_from_cam is None for k in candidates):
        return {}
    others = stack([load_with_card(k)[0] for k in candidates])
    _, validate = _make_validator(method, scene, near, others, settings, max(true_map.shape[-2:]))
    return _cause_columns("ghost", card_over_map(true_map, card_depth), i, validate)


def _cause_columns(name: str, true_map: Tensor, seed: int, validate: Callable[..., DepthValidation]) -> Row:
    """A fault of single pixels in a true map → AUROC, planted pixels that are called wrong, and those whose cause is
    named."""
    faulty = apply_fault(name, true_map, seed=seed)[0]
    validation = validate(faulty)
    error = (faulty / true_map.clamp_min(1e-6) - 1).abs()
    valid = (true_map > 0) & (faulty > 0)
    planted = valid & (error > _WRONG_PIXEL_ERROR)
    score = validation.evidence.abs()
    counted = valid & validation.known & score.isfinite() & (planted | (error < _RIGHT_PIXEL_ERROR))
    detected = planted & (validation.state == State.WRONG)
    entry = describe(WrongCause, name)
    assert entry is not None
    return {
        f"planted.{name}": int(planted.sum()),
        f"known_planted.{name}": int((planted & validation.known).sum()),
        f"detected.{name}": int(detected.sum()),
        f"cause_right.{name}": int((detected & (validation.cause == entry.number)).sum()),
        f"auroc.{name}": auroc(score[counted], planted[counted]),
    }


def _outline_alarms(validation: DepthValidation) -> float | None:
    """Fraction of the pixels with a state that are wrong by evidence at outlines alone."""
    others = (validation.sparse_evidence, validation.photometric_evidence, validation.consistency_evidence)
    refuted = torch.stack([x.abs() > DEFAULT_VALIDATION_OPTIONS.refuting_evidence_sigmas for x in others]).any(0)
    alarms = (validation.state == State.WRONG) & ~refuted
    n = int(validation.known.sum())
    return int(alarms.sum()) / n if n else None


def _make_validator(
    method: Method, scene: Scene, reference: Frame, others: Frame, settings: Settings, size: int
) -> tuple[dense.SelectedViews, Callable[..., DepthValidation]]:
    """Reference and source views → views selected by the sparse method, and a function that validates maps by them."""
    trace: Trace = {}
    with torch.no_grad():
        estimate = method(reference, others, seed=settings.seed, hint=scene.hint, trace=trace)
    selected = dense.selected_views(estimate, others, trace)
    offered = trace["choice"].index if "choice" in trace else None
    return selected, partial(
        validate_against, reference=reference, selected=selected, offered=offered, method=method, size=size
    )


def _pixel_counts(name: str, faulty: Tensor, true_map: Tensor, score: Tensor, state: Tensor, has_return: Tensor) -> Row:
    """States and scores of one faulty map's pixels → counts per state and AUROC, over pixels with truth."""
    valid = (true_map > 0) & (faulty > 0)
    wrong = valid & ((faulty / true_map.clamp_min(1e-6) - 1).abs() > _WRONG_PIXEL_ERROR)
    answered = valid & (state != State.CANNOT_KNOW) & score.isfinite()
    consistent = valid & (state == State.CONSISTENT)
    row: Row = {f"n.{name}": int(valid.sum()), f"known.{name}": int(answered.sum())}
    row |= {f"consistent.{name}": int(consistent.sum()), f"consistent_off.{name}": int((consistent & wrong).sum())}
    row |= {f"wrong.{name}": int((answered & (state == State.WRONG)).sum())}
    if name == "jumps":
        row["auroc_all"] = auroc(score[answered], wrong[answered])
        hidden = answered & ~has_return
        row["auroc"] = auroc(score[hidden], wrong[hidden])
    return row


def _scene_row(scene: Scene, rows: Sequence[Row]) -> Row:
    """Rows of a scene's reference views → the scene's row of ratios."""
    with_baseline = [row for row in rows if row["baseline"]]
    out: Row = {"scene": scene.name, "pair": None, "method": "validate", "role": scene.role}
    out["n_wide"] = len(with_baseline)
    for column, suffix in _SCALE_COLUMN_SUFFIXES.items():
        for percent, ending in (("10", ""), ("5", "_5")):
            alarms = [row[f"{column}.{percent}_{side}"] for row in with_baseline for side in ("long", "short")]
            out[f"validate.scale_detected{ending}{suffix}"] = mean_or_none([float(bool(x)) for x in alarms])
        false_alarms = [float(bool(row[f"{column}.none"])) for row in with_baseline]
        out[f"validate.false_alarm{suffix}"] = mean_or_none(false_alarms)
    for name, prefix in _PREDICTOR_PREFIXES.items():
        for key, column in (("jump_auroc", "auroc"), ("jump_auroc_all", "auroc_all")):
            out[f"{name}.{key}"] = mean_or_none(
                [r[prefix + column] for r in with_baseline if r.get(prefix + column) is not None]
            )
        count = {
            k: sum(r[f"{prefix}{k}.{p}"] for r in rows for p in _PIXEL_FAULTS) for k in ("consistent", "consistent_off")
        }
        out[f"{name}.called_right_wrong"] = (
            count["consistent_off"] / count["consistent"] if count["consistent"] else None
        )
        n_cut, off_cut = (sum(row[f"{prefix}{k}.cut"] for row in rows) for k in ("consistent", "consistent_off"))
        out[f"{name}.called_right_wrong_cut"] = off_cut / n_cut if n_cut else None
        n = sum(row[f"{prefix}n.none"] for row in with_baseline)
        answered, wrong = (sum(row[f"{prefix}{k}.none"] for row in with_baseline) for k in ("known", "wrong"))
        out[f"{name}.known"] = answered / n if n else None
        out[f"{name}.called_wrong_right"] = wrong / answered if answered else None
    return out | _cause_ratios(with_baseline)


def _cause_ratios(rows: Sequence[Row]) -> Row:
    """Rows of reference views with a baseline → ratios of the planted faults of single pixels."""
    out: Row = {
        "validate.outline_alarms": mean_or_none([r["outline_alarms"] for r in rows if r["outline_alarms"] is not None])
    }
    total = {"detected": 0, "cause_right": 0}
    for name in RETURN_FAULTS:
        aurocs = [row[f"auroc.{name}"] for row in rows if row.get(f"auroc.{name}") is not None]
        out[f"validate.{name}_auroc"] = mean_or_none(aurocs)
        count = {k: sum(row.get(f"{k}.{name}", 0) for row in rows) for k in ("known_planted", "planted", *total)}
        total = {k: total[k] + count[k] for k in total}
        out[f"validate.{name}_known"] = count["known_planted"] / count["planted"] if count["planted"] else None
        out[f"validate.cause_right_{name}"] = count["cause_right"] / count["detected"] if count["detected"] else None
    out["validate.cause_right"] = total["cause_right"] / total["detected"] if total["detected"] else None
    return out


# ------------------------------------------------------------------------------------------------------------ windows


def _window_rows(scene: Scene, first: int, load: Callable[[int], Frame]) -> list[Row]:
    """Diagnoses of every fault planted in one window → rows: in the sensor's own depth, then in maps beside it."""
    indices = range(first - faults.MAX_LAG_FRAMES, first + _WINDOW_FRAMES + faults.MAX_LAG_FRAMES)
    frames_of = {k: load(k) for k in indices}
    window_tracks = faults.track_window([frames_of[k] for k in range(first, first + _WINDOW_FRAMES)])
    rows = []
    for in_sensor in (True, False):
        for name, (kind, options) in _PLANTED_FAULTS.items():
            if in_sensor and name == "inverse":  # a fault of maps alone
                continue
            frames, maps = _plant_fault(scene, frames_of, first, in_sensor, **options)
            diagnosis = faults.diagnose(frames, maps, watched=window_tracks)
            row: Row = {"scene": scene.name, "pair": [first, first + _WINDOW_FRAMES - 1], "method": "causes"}
            row |= {"source": "sensor" if in_sensor else "map", "fault": name, "planted_kind": kind}
            row |= {"named": diagnosis.cause, "named_kind": diagnosis.kind}
            row["moved_px"] = _fault_motion_px(frames, maps, frames_of, first, diagnosis.pairs) if kind else 0.0
            rows.append(row | {"n_diagnosed_pairs": diagnosis.n_pairs})
    return rows


def _plant_fault(
    scene: Scene,
    frames_of: Mapping[int, Frame],
    first: int,
    in_sensor: bool,
    *,
    spoil: Callable[[Tensor], Tensor] = lambda depth: depth,
    lag: int = 0,  # frames by which the maps lag behind the images
    focal: float = 1.0,  # factor on the stated focal lengths
    ray: bool = False,  # depth becomes the distance along the ray
) -> tuple[list[Frame], list[Tensor] | None]:
    """Frames of a window with a depth fault that all share, and the maps beside them if it is not in the sensor's."""
    faulty_frames, maps = [], []
    for k in range(first, first + _WINDOW_FRAMES):
        source = frames_of[k - lag]
        depth = spoil(source.depth)
        camera = frames_of[k].camera.replace(f=frames_of[k].camera.f * focal)
        depth_camera = frames_of[k].depth_camera
        if depth_camera is not None:
            depth_camera = depth_camera.replace(f=depth_camera.f * focal)
        frame = frames_of[k].replace(camera=camera, depth_camera=depth_camera)
        image_depth = _depth_over_image(source)
        if ray:
            depth = depth * _ray_lengths(source.depth_camera, source, depth)
            image_depth = image_depth * _ray_lengths(None, source, image_depth)
        faulty_frames.append(frame.replace(depth=depth) if in_sensor else range_split(frame, scene.near))
        maps.append(spoil(image_depth))
    return faulty_frames, None if in_sensor else maps


def _ray_lengths(camera: cam.Camera | None, frame: Frame, depth: Tensor) -> Tensor:
    """Lengths of the rays through a map's pixels, from the depth camera or else the image's camera, resized."""
    hw = (depth.shape[-2], depth.shape[-1])
    return faults.ray_lengths(camera or cam.resize(frame.camera, frame.hw, hw), hw)


def _depth_over_image(frame: Frame, size: int = 320) -> Tensor:
    """Frame → its depth (1, h, w) resampled to the field of view of its image, nearest pixel; 0 outside."""
    hw = dense.map_hw(frame.hw, size)
    uv = dense.map_pixel_centres(frame, hw)[None]
    depth_uv = cam.depth_pixels(
        frame.camera, frame.hw, frame.depth_camera, (frame.depth.shape[-2], frame.depth.shape[-1]), uv
    )
    depth, inside = sample_nearest(frame.depth.to(uv), depth_uv)
    return torch.where(inside, depth, 0.0).unflatten(1, hw)


def _fault_motion_px(
    frames: Sequence[Frame],
    maps: Sequence[Tensor] | None,
    true_frames: Mapping[int, Frame],
    first: int,
    pairs: Sequence[tuple[int, int]],
) -> float | None:
    """Median displacement (px, image 640 wide) caused by a fault in a pair's second image, under the stated poses."""
    medians = []
    for i, j in pairs:
        a, b = true_frames[first + i], true_frames[first + j]
        if a.T_world_from_cam is None or b.T_world_from_cam is None:
            return None
        T = se3.relative(a.T_world_from_cam, b.T_world_from_cam).map(lambda x: x.float())
        faulty = _depth_over_image(frames[i]) if maps is None else maps[i]
        true_depth = _depth_over_image(a)
        uv = dense.map_pixel_centres(a, (true_depth.shape[-2], true_depth.shape[-1]))[None]
        projections = []
        for depth, camera, other in ((true_depth, a.camera, b.camera), (faulty, frames[i].camera, frames[j].camera)):
            xyz = se3.apply(T, cam.unproject(camera, uv, depth.flatten(1)))
            projections.append(cam.project(other, torch.where(xyz[..., 2:] > 0, xyz, torch.nan)))
        displacement = (projections[0] - projections[1]).norm(dim=-1)[
            (true_depth > 0).flatten(1) & (faulty > 0).flatten(1)
        ]
        if displacement.numel():
            medians.append(displacement.nan_to_num(1e3).median())  # behind the other camera: far away
    return float(torch.stack(medians).median()) * 640 / frames[0].hw[1] if medians else None


# ------------------------------------------------------------------------------------------------------------- scenes


def _true_map(recording: Recording, i: int, full: Frame, size: int, method: Method) -> Tensor:
    """True depth map (1, h, w): the recording's exact depth, else all returns of the sensor."""
    hw = dense.map_hw(full.hw, size)
    if isinstance(recording, TruthRecording):
        exact = full.replace(
            depth=recording.truth(i)["depth"].to(full.camera.f), depth_camera=None, conf=None, sparse=None
        )
        return _depth_over_image(exact, size)
    samples = method.backproject(full, dense.map_pixel_centres(full, hw))
    return torch.where(samples.depth > 0, samples.depth, 0.0).unflatten(1, hw)


def _first_frames(n: int, count: int) -> list[int]:
    """First frames of evenly spaced windows, at least :data:`faults.MAX_LAG_FRAMES` frames from either end."""
    last = n - _WINDOW_FRAMES - faults.MAX_LAG_FRAMES
    if last < faults.MAX_LAG_FRAMES or not count:
        return []
    step = (last - faults.MAX_LAG_FRAMES) / max(count - 1, 1)
    return sorted({faults.MAX_LAG_FRAMES + round(k * step) for k in range(count)})
