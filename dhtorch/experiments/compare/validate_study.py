"""Question: does the judge find what is wrong with a depth map, and keep silent where nothing can tell?

Expectation (written before the run): a metre that is wrong by a tenth is found in 95 % of the pairs with a baseline, at
2 % false alarms; objects that stand elsewhere are told from the rest with an area under the curve of .95 where
something is said; of the pixels called consistent one in a hundred at most is a fifth off; a wrong unit, a mirrored, a
rolled, a late map, one that is not registered and a wrong focal length are named in nine of ten windows in which they
move the picture by two pixels.
What would refute it: any of these numbers missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dhtorch.codes import State
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.recording import Recording, TruthRecording
from dhtorch.data.scene import Scene, SceneLike, scenes_of
from dhtorch.experiments.baselines import photometric
from dhtorch.experiments.protocol import Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row, mean_or_none
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
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
from dhtorch.synthetic.depth_faults import apply_fault, mirror_depth, scale_depth
from dhtorch.validation import faults
from dhtorch.validation.validate import QUICK_METHOD, validate_against

QUESTION = "Does the judge find what is wrong with a depth map, and keep silent where nothing can tell?"
EXPECTATION = "Every number of the list of bars is met; scenes, and of causes windows, are the unit."

#: Number → (bar, whether it holds).
VALIDATE_BARS: dict[str, tuple[float, Callable[[float, float], bool]]] = {
    "judge.scale_found": (0.95, lambda value, bar: value >= bar),
    "judge.false_alarm": (0.02, lambda value, bar: value <= bar),
    "judge.jump_auroc": (0.95, lambda value, bar: value >= bar),
    "judge.called_right_wrong": (0.01, lambda value, bar: value <= bar),
    "judge.named_worst": (0.90, lambda value, bar: value >= bar),
}

#: Metres that are planted, by their names in rows.
_SCALE_FAULTS = {"10_long": 1.1, "10_short": 1 / 1.1, "5_long": 1.05, "5_short": 1 / 1.05}

#: Maps whose pixels are judged one by one: faults of one map, and the map of another time.
_PIXEL_FAULTS = ("none", "jumps", "invented", "warp_large", "cut", "time")

#: A scale is found where its interval leaves out 1 and it lies so far from it, as a logarithm.
_MIN_ALARM_LOG_SCALE = 0.03

#: Relative error from which on a pixel is a fifth off.
_WRONG_PIXEL_ERROR = 0.2

#: What makes a pair one with a baseline: median sigma / depth of its answers, and how many there are at least.
_MAX_BASELINE_SIGMA_REL, _MIN_BASELINE_ANSWERS = 0.05, 20

#: Windows of so many frames, and the motion of the median pixel, of a picture 640 wide, from which on a fault counts.
_WINDOW_FRAMES, _MIN_FAULT_MOTION_PX = 20, 2.0

#: Columns that are looked at for the metre, and how their numbers end: ours by all evidence, by triangulated points
#: alone, and the quick method's by points alone.
_SCALE_COLUMN_SUFFIXES = {"scale": "", "scale_far": "_far", "quick_far": "_quick_far"}

#: Whose pixels are counted → how their columns begin.
_PREDICTOR_PREFIXES = {"judge": "", "quick": "quick_", "photometric": "peer_"}


@dataclass(frozen=True)
class PlantedFault:
    """A fault that all frames of a window share."""

    kind: str | None  # as dhtorch.validation.faults names it; None = no fault
    spoil: Callable[[Tensor], Tensor] = lambda depth: depth
    lag: int = 0  # frames by which the maps come late
    focal: float = 1.0  # factor on the focal lengths that are told
    ray: bool = False  # depth becomes the distance along the ray
    told: bool = True  # of the sensor's own depth as well: nothing holds its order against another


_PLANTED_FAULTS: dict[str, PlantedFault] = {
    "none": PlantedFault(None),
    "unit_mm": PlantedFault("unit", partial(scale_depth, factor=1e3)),
    "unit_m": PlantedFault("unit", partial(scale_depth, factor=1e-3)),
    "unit_inch": PlantedFault("unit", partial(scale_depth, factor=1 / 0.0254)),
    "mirrored": PlantedFault("mirrored", mirror_depth),
    "upside_down": PlantedFault("mirrored", partial(torch.flip, dims=(-2,))),
    "along_ray": PlantedFault("along the ray", ray=True),
    "inverse": PlantedFault(
        "inverse", lambda depth: torch.where(depth > 0, 3 / depth.clamp_min(1e-3), 0.0), told=False
    ),
    "rolled_90": PlantedFault("rolled", partial(faults.rot90_map, quarters=1)),
    "rolled_180": PlantedFault("rolled", partial(faults.rot90_map, quarters=2)),
    "wide": PlantedFault("registration", partial(rescale_field_of_view, factor=1 / 1.35)),
    "narrow": PlantedFault("registration", partial(rescale_field_of_view, factor=1.2)),
    "beside": PlantedFault("registration", partial(rescale_field_of_view, factor=1.0, right=-0.06)),
    "late_3": PlantedFault("time offset", lag=3),
    "early_4": PlantedFault("time offset", lag=-4),
    "focal_long": PlantedFault("focal length", focal=1.06),
    "focal_short": PlantedFault("focal length", focal=0.93),
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
    """Plant faults in true maps, with near returns alone shown to the method, and hold what is said against them.

    Rows: one per reference view (``pair`` [i, i], method ``judge``), one per window and fault (``pair`` [first, last],
        method
    ``causes``), one per scene. In the summary shares of reference views are means over scenes with intervals over
    these: ``judge.scale_found`` and ``judge.false_alarm`` (all evidence), the same with ``_5`` for a twentieth and with
    ``_far`` by triangulated points alone; ``judge.jump_auroc`` of pixels without a shown return, ``_all`` of all;
    ``judge.called_right_wrong``, ``_worst`` of the worst scene, ``_cut`` of maps that are cut alone; ``judge.known``;
    ``photometric.<the same>`` of the peer, ``quick.<the same>`` of :data:`dhtorch.validation.validate.QUICK_METHOD`
    without the pictures of other views, whose metre by points alone is ``_quick_far``. Nothing is fitted to the scenes.
    Named are shares of
    windows: ``judge.named.<kind>``, their least ``judge.named_worst``; ``judge.misnamed`` where nothing was planted.

    Args:
        scenes, chosen, settings, progress: as :func:`dhtorch.experiments.protocol.run`.
        pairs: not used; other views are chosen among those around a reference view.
        method: the sparse method; None = the job's.
        anchors: of each scene, evenly spread.
        windows: of each scene that is long enough.
        size: longer side of the grid, px.
        rooms: seeds of built-in rooms, judged beside the scenes.

    Raises:
        ValueError: an option out of range; else as the main job.
    """
    for name, value in {"reference_views": reference_views, "windows": windows}.items():
        if not isinstance(value, int) or value < 0:
            raise ValueError(f"experiment.{name}: found {value!r}, expected a whole number of at least 0")
    ask = with_view_selection(method or next(iter(chosen.values())))
    every = [scene for scene in scenes_of(scenes) if len(scene.recording) > 1]
    every += [Scene(_make_room(seed), near=2.0, gap=6) for seed in rooms]
    outcome = Outcome()
    for scene in every:
        look = partial(_load_frame, scene, settings)
        rows = []
        for i in progress(
            _evenly_spaced(len(scene.recording), reference_views), f"{scene.name}: reference views", reference_views
        ):
            rows.append(_reference_row(scene, i, look, ask, settings, size))
        firsts = _first_frames(len(scene.recording), windows)
        found = [
            r for k in progress(firsts, f"{scene.name}: windows", len(firsts)) for r in _window_rows(scene, k, look)
        ]
        outcome.rows += [*rows, *found, _scene_row(scene, rows)]
        outcome.n_pairs += len(rows)
    outcome.summary = summarise_validation(outcome.rows)
    return outcome.decide(QUESTION, EXPECTATION, *verdict(outcome.summary))


def verdict(found: Mapping[str, Any]) -> tuple[bool | None, str]:
    """Hold the summary against the bars, and name what is missed or could not be measured."""
    values = {name: found.get(name, {}).get("value") for name in VALIDATE_BARS}
    undefined = [name for name, value in values.items() if value is None]
    told = {name: value for name, value in values.items() if value is not None}
    missed = [
        f"{k} {value:.3f} (bar {VALIDATE_BARS[k][0]:g})"
        for k, value in told.items()
        if not VALIDATE_BARS[k][1](value, VALIDATE_BARS[k][0])
    ]
    notes = [f"not measured: {', '.join(undefined)}"] if undefined else []
    said = "; ".join([f"{len(told) - len(missed)} of {len(told)} bars met", *missed, *notes])
    return (None if undefined and not missed else not missed), said


def summarise_validation(rows: Sequence[Row]) -> Row:
    """All numbers of the result, from rows of scenes and of windows."""
    whole = [row for row in rows if row["pair"] is None and row["role"] is None]
    names = sorted({name for row in whole for name, value in row.items() if "." in name and not isinstance(value, str)})
    found: Row = {
        n: bootstrap.interval_over_scenes([row.get(n) for row in whole], statistic="mean").entry("1") for n in names
    }
    for who in _PREDICTOR_PREFIXES:
        shares = [row[f"{who}.called_right_wrong"] for row in whole if row.get(f"{who}.called_right_wrong") is not None]
        found[f"{who}.called_right_wrong_worst"] = bootstrap.without_interval(max(shares, default=None), len(shares))
    told = [row for row in rows if row["method"] == "causes" and row["moved_px"] is not None]
    counted = [row for row in told if row["planted_kind"] is not None and row["moved_px"] >= _MIN_FAULT_MOTION_PX]
    right_of = {}
    for kind in sorted({row["planted_kind"] for row in counted}):
        right = [float(row["named_kind"] == kind) for row in counted if row["planted_kind"] == kind]
        right_of[kind] = sum(right) / len(right)
        found[f"judge.named.{kind.replace(' ', '_')}"] = bootstrap.without_interval(right_of[kind], len(right))
    found["judge.named_worst"] = bootstrap.without_interval(min(right_of.values(), default=None), len(counted))
    clean = [
        float(row["named_kind"] is not None) for row in rows if row["method"] == "causes" and row["fault"] == "none"
    ]
    found["judge.misnamed"] = bootstrap.without_interval(mean_or_none(clean), len(clean))
    return found


# ------------------------------------------------------------------------------------------------------ single frames


def scale_alarm(scale: Tensor) -> bool | None:
    """Whether a scale (3,) with its interval is said to be wrong; None where nothing is known of it."""
    value, low, high = (float(x) for x in scale)
    if math.isnan(value):
        return None
    return abs(math.log(value)) > _MIN_ALARM_LOG_SCALE and not low <= 1 <= high


def _reference_row(
    scene: Scene, i: int, look: Callable[[int], Frame], ask: Method, settings: Settings, size: int
) -> Row:
    """All that is planted in one frame's map."""
    full, cutoff = look(i), settings.cutoff_of(scene)
    near = range_split(full, cutoff)
    offered = candidate_frames(scene.recording, i)
    others = stack([range_split(look(k), cutoff) for k in offered])
    asked, say = _make_validator(ask, scene, near, others, settings, size)
    _, hurry = _make_validator(with_view_selection(QUICK_METHOD), scene, near, others, settings, size)
    true = _true_map(scene.recording, i, full, size, ask)
    row: Row = {"scene": scene.name, "pair": [i, i], "method": "judge", **_baseline_columns(asked)}
    for name, factor in {"none": 1.0, **_SCALE_FAULTS}.items():
        found, fast = (speak(true * factor, views=False) for speak in (say, hurry))
        scale = {"scale": found.scale[0], "scale_far": found.scale_far[0], "quick_far": fast.scale_far[0]}
        row |= {f"{way}.{name}": scale_alarm(scale[way]) for way in _SCALE_COLUMN_SUFFIXES}
        row |= {f"{way}_value.{name}": float(scale[way][0] / factor) for way in _SCALE_COLUMN_SUFFIXES}
    elsewhere = offered[-1] if offered[-1] > i else offered[0]
    later = _true_map(scene.recording, elsewhere, look(elsewhere), size, ask)
    shown = ask.backproject(near, dense.map_pixel_centres(near, (true.shape[-2], true.shape[-1]))).usable.unflatten(
        1, true.shape[-2:]
    )
    for name in _PIXEL_FAULTS:
        spoilt = true if name == "none" else apply_fault(name, true, seed=i, other=later)[0]
        row |= _validated_counts("", name, spoilt, true, say(spoilt), shown)
        row |= _validated_counts("quick_", name, spoilt, true, hurry(spoilt, views=False), shown)
        miss, state = photometric.photometric_difference(spoilt, near, asked)
        row |= {f"peer_{k}": v for k, v in _pixel_counts(name, spoilt, true, miss, state, shown).items()}
    return row


def _make_validator(
    ask: Method, scene: Scene, near: Frame, others: Frame, settings: Settings, size: int
) -> tuple[dense.SelectedViews, Callable[..., DepthValidation]]:
    """What a method finds at a reference view, and what is said of a map by it."""
    trace: Trace = {}
    with torch.no_grad():
        joined = ask(near, others, seed=settings.seed, hint=scene.hint, trace=trace)
    asked = dense.selected_views(joined, others, trace)
    offered = trace["choice"].index if "choice" in trace else None
    return asked, partial(validate_against, reference=near, asked=asked, offered=offered, method=ask, size=size)


def _validated_counts(
    begin: str, name: str, spoilt: Tensor, true: Tensor, found: DepthValidation, shown: Tensor
) -> Row:
    counts = _pixel_counts(name, spoilt, true, found.evidence.abs(), found.state, shown)
    return {f"{begin}{key}": value for key, value in counts.items()}


def _pixel_counts(name: str, spoilt: Tensor, true: Tensor, score: Tensor, state: Tensor, shown: Tensor) -> Row:
    """What is said of the pixels of one spoilt map, where the truth is known."""
    there = (true > 0) & (spoilt > 0)
    off = there & ((spoilt / true.clamp_min(1e-6) - 1).abs() > _WRONG_PIXEL_ERROR)
    known = there & (state != State.CANNOT_KNOW) & score.isfinite()
    fine = there & (state == State.CONSISTENT)
    row: Row = {f"n.{name}": int(there.sum()), f"known.{name}": int(known.sum())}
    row |= {f"consistent.{name}": int(fine.sum()), f"consistent_off.{name}": int((fine & off).sum())}
    row |= {f"wrong.{name}": int((known & (state == State.WRONG)).sum())}
    if name == "jumps":
        row["auroc_all"] = auroc(score[known], off[known])
        hidden = known & ~shown
        row["auroc"] = auroc(score[hidden], off[hidden])
    return row


def _baseline_columns(asked: dense.SelectedViews) -> Row:
    keep = asked.joined.keep & ~asked.samples.usable
    stated = (asked.joined.sigma / asked.joined.depth)[keep]
    n = int(keep.sum())
    median = float(stated.median()) if n else None
    return {
        "n_answers": n,
        "stated": median,
        "baseline": n >= _MIN_BASELINE_ANSWERS and median is not None and median <= _MAX_BASELINE_SIGMA_REL,
    }


def _scene_row(scene: Scene, rows: Sequence[Row]) -> Row:
    """Shares over a scene's reference views."""
    wide = [row for row in rows if row["baseline"]]
    out: Row = {"scene": scene.name, "pair": None, "method": "judge", "role": scene.role, "n_wide": len(wide)}
    for way, tail in _SCALE_COLUMN_SUFFIXES.items():
        for size, end in (("10", ""), ("5", "_5")):
            told = [row[f"{way}.{size}_{side}"] for row in wide for side in ("long", "short")]
            out[f"judge.scale_found{end}{tail}"] = mean_or_none([float(bool(x)) for x in told])
        out[f"judge.false_alarm{tail}"] = mean_or_none([float(bool(row[f"{way}.none"])) for row in wide])
    for name, prefix in _PREDICTOR_PREFIXES.items():
        for key, column in (("jump_auroc", "auroc"), ("jump_auroc_all", "auroc_all")):
            out[f"{name}.{key}"] = mean_or_none(
                [r[prefix + column] for r in wide if r.get(prefix + column) is not None]
            )
        count = {
            k: sum(r[f"{prefix}{k}.{p}"] for r in rows for p in _PIXEL_FAULTS) for k in ("consistent", "consistent_off")
        }
        out[f"{name}.called_right_wrong"] = (
            count["consistent_off"] / count["consistent"] if count["consistent"] else None
        )
        n_cut, off_cut = (sum(row[f"{prefix}{k}.cut"] for row in rows) for k in ("consistent", "consistent_off"))
        out[f"{name}.called_right_wrong_cut"] = off_cut / n_cut if n_cut else None
        n = sum(row[f"{prefix}n.none"] for row in wide)
        known, wrong = (sum(row[f"{prefix}{k}.none"] for row in wide) for k in ("known", "wrong"))
        out[f"{name}.known"] = known / n if n else None
        out[f"{name}.called_wrong_right"] = wrong / known if known else None
    return out


# ------------------------------------------------------------------------------------------------------------ windows


def _window_rows(scene: Scene, first: int, look: Callable[[int], Frame]) -> list[Row]:
    """Every fault in one window: in the sensor's own depth, and in maps beside a sound sensor."""
    reach = range(first - faults.MAX_LAG_FRAMES, first + _WINDOW_FRAMES + faults.MAX_LAG_FRAMES)
    around_it = {k: look(k) for k in reach}
    watched = faults.track_window([around_it[k] for k in range(first, first + _WINDOW_FRAMES)])
    rows = []
    for own in (True, False):
        for name, planted in _PLANTED_FAULTS.items():
            if own and not planted.told:
                continue
            frames, maps = _plant_fault(scene, around_it, first, planted, own)
            found = faults.diagnose(frames, maps, watched=watched)
            moved = _fault_motion_px(frames, maps, around_it, first, found.pairs) if planted.kind else 0.0
            row: Row = {"scene": scene.name, "pair": [first, first + _WINDOW_FRAMES - 1], "method": "causes"}
            row |= {"source": "sensor" if own else "map", "fault": name, "planted_kind": planted.kind}
            row |= {"named": found.cause, "named_kind": found.kind, "moved_px": moved, "n_pairs_told": found.n_pairs}
            rows.append(row)
    return rows


def _plant_fault(
    scene: Scene, frames: Mapping[int, Frame], first: int, fault: PlantedFault, own: bool
) -> tuple[list[Frame], list[Tensor] | None]:
    shown, maps = [], []
    for k in range(first, first + _WINDOW_FRAMES):
        seen = frames[k - fault.lag]
        spoilt = fault.spoil(seen.depth)
        camera = frames[k].camera.replace(f=frames[k].camera.f * fault.focal)
        depth_camera = frames[k].depth_camera
        if depth_camera is not None:
            depth_camera = depth_camera.replace(f=depth_camera.f * fault.focal)
        frame = frames[k].replace(camera=camera, depth_camera=depth_camera)
        over = _depth_over_image(seen)
        if fault.ray:
            spoilt = spoilt * _ray_lengths(seen.depth_camera, seen, spoilt)
            over = over * _ray_lengths(None, seen, over)
        shown.append(frame.replace(depth=spoilt) if own else range_split(frame, scene.near))
        maps.append(fault.spoil(over))
    return shown, None if own else maps


def _ray_lengths(camera: cam.Camera | None, frame: Frame, depth: Tensor) -> Tensor:
    """Lengths of the rays through a map's pixels, of a camera of its own or of the picture's."""
    hw = (depth.shape[-2], depth.shape[-1])
    return faults.ray_lengths(camera or cam.resize(frame.camera, frame.hw, hw), hw)


def _depth_over_image(frame: Frame, size: int = 320) -> Tensor:
    """A frame's depth over the field of its picture, nearest pixels."""
    hw = dense.map_hw(frame.hw, size)
    uv = dense.map_pixel_centres(frame, hw)[None]
    place = cam.depth_pixels(
        frame.camera, frame.hw, frame.depth_camera, (frame.depth.shape[-2], frame.depth.shape[-1]), uv
    )
    depth, inside = sample_nearest(frame.depth.to(uv), place)
    return torch.where(inside, depth, 0.0).unflatten(1, hw)


def _fault_motion_px(
    frames: Sequence[Frame],
    maps: Sequence[Tensor] | None,
    sound: Mapping[int, Frame],
    first: int,
    pairs: Sequence[tuple[int, int]],
) -> float | None:
    """By how much a fault moves the median pixel into the other picture of a pair, under the frames' own poses."""
    moved = []
    for i, j in pairs:
        a, b = sound[first + i], sound[first + j]
        if a.T_world_from_cam is None or b.T_world_from_cam is None:
            return None
        T = se3.relative(a.T_world_from_cam, b.T_world_from_cam).map(lambda x: x.float())
        spoilt = _depth_over_image(frames[i]) if maps is None else maps[i]
        true = _depth_over_image(a)
        uv = dense.map_pixel_centres(a, (true.shape[-2], true.shape[-1]))[None]
        ends = []
        for depth, camera, other in ((true, a.camera, b.camera), (spoilt, frames[i].camera, frames[j].camera)):
            xyz = se3.apply(T, cam.unproject(camera, uv, depth.flatten(1)))
            ends.append(cam.project(other, torch.where(xyz[..., 2:] > 0, xyz, torch.nan)))
        miss = (ends[0] - ends[1]).norm(dim=-1)[(true > 0).flatten(1) & (spoilt > 0).flatten(1)]
        if miss.numel():
            moved.append(miss.nan_to_num(1e3).median())  # behind the other camera: far away
    return float(torch.stack(moved).median()) * 640 / frames[0].hw[1] if moved else None


# ------------------------------------------------------------------------------------------------------------- scenes


def _load_frame(scene: Scene, settings: Settings, i: int) -> Frame:
    return scene.recording[i].to(settings.dtype).to(settings.device)


def _true_map(recording: Recording, i: int, full: Frame, size: int, ask: Method) -> Tensor:
    """The true map (1, h, w) on the grid: exact where the recording knows it, else all that the sensor returned."""
    hw = dense.map_hw(full.hw, size)
    if isinstance(recording, TruthRecording):
        exact = full.replace(
            depth=recording.truth(i)["depth"].to(full.camera.f), depth_camera=None, conf=None, sparse=None
        )
        return _depth_over_image(exact, size)
    samples = ask.backproject(full, dense.map_pixel_centres(full, hw))
    return torch.where(samples.depth > 0, samples.depth, 0.0).unflatten(1, hw)


def _make_room(seed: int) -> SyntheticRoom:
    return SyntheticRoom(
        n_frames=_WINDOW_FRAMES + 2 * faults.MAX_LAG_FRAMES, hw=(240, 320), seed=seed, name=f"room_{seed}"
    )


def _evenly_spaced(n: int, wanted: int) -> list[int]:
    wanted = min(n, wanted)
    return [(2 * k + 1) * n // (2 * wanted) for k in range(wanted)]


def _first_frames(n: int, wanted: int) -> list[int]:
    """First frames of windows, with as many frames before and after as a map may be early or late."""
    last = n - _WINDOW_FRAMES - faults.MAX_LAG_FRAMES
    if last < faults.MAX_LAG_FRAMES or not wanted:
        return []
    step = (last - faults.MAX_LAG_FRAMES) / max(wanted - 1, 1)
    return sorted({faults.MAX_LAG_FRAMES + round(k * step) for k in range(wanted)})
