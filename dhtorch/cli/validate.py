"""``dhtorch validate``: correctness of a recording's depth, from its sensor or from separate maps.

Writes ``validate.json`` (a row for every frame, statistics of the recording, likely causes in windows of frames) and
``validate.html``, worst first. The exit code is 1 where a limit of ``fail_on`` is exceeded, for use in data pipelines.
"""

import io
import math
import re
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from dhtorch.cli.complete import Row, load_frame
from dhtorch.codes import State, WrongCause, names, words
from dhtorch.data import depth_maps
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.depth_maps import DepthMaps
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.pipeline.method import Method
from dhtorch.pytree import stack
from dhtorch.records import DepthValidation
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.validation import faults
from dhtorch.validation.options import DEFAULT_VALIDATION_OPTIONS
from dhtorch.validation.validate import share_interval, validate_depth
from dhtorch.viz.plots import append_cutoff, draw_validation, format_frame
from dhtorch.viz.viewer import validation as pages

#: Statistics of a frame that have a confidence interval.
_INTERVAL_FIELDS = ("scale", "scale_near", "scale_far", "scale_vs_trajectory", "shift", "tilt", "wrong")

#: Names that ``fail_on`` accepts → the quantity compared with the limit, over a whole recording. All but the last are
#: lower bounds at 95 % confidence, so that few or uncertain frames exceed no limit by chance.
_VALIDATION_LIMITS = {
    "wrong": "fraction of wrong pixels among those that can be checked, lower bound",
    "scale": "|scale - 1| of the median frame, lower bound",
    "shift": "|shift| of the median frame, m, lower bound",
    "tilt": "tilt of the median frame, lower bound",
    "drift": "difference of scale between frames, lower bound",
    "causes": "fraction of the windows with a likely cause, lower bound",
    "unknown": "fraction of the pixels with a depth that cannot be checked",
}

#: Columns of the page's table.
_TABLE_COLUMNS = ("wrong, of checked", "checked, of depth", "scale", "shift, m", "tilt", "cut at, m")

#: Difference of a scale from 1, as a log ratio, from which the wrong one of sensor and maps is named.
_MIN_SCALE_DIFFERENCE = 0.03

#: The poses agree with one of the two if its log ratio to them is at most this fraction of the other's.
_MAX_WITNESS_RATIO = 1 / 3

_LIMIT_PATTERN = re.compile(r"\s*([a-z_]+)\s*>\s*([0-9.eE+-]+)\s*")

#: Causes of wrong pixels that the summary names, and the least fraction of the checked pixels from which it does.
_NAMED_CAUSES = ("ghost", "flying_pixel", "edge_bleed")
_MIN_NAMED_SHARE = 0.0005


@dataclass
class _RecordingValidation:
    """Validation of one recording."""

    scene: Scene
    maps: DepthMaps | None
    rows: list[Row] = field(default_factory=list)
    windows: list[Row] = field(default_factory=list)
    pictures: dict[int, bytes] = field(default_factory=dict)  # frame → PNG, of the worst

    @property
    def notes(self) -> list[str]:
        """Doubts about the maps, and notes on their unit and on the matching of files to frames."""
        return [] if self.maps is None else [*self.maps.doubts, *self.maps.notes]


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Validate every scene of the settings; returns the exit code, 1 where a limit is exceeded.

    Raises:
        ValueError, OSError: bad options or data.
    """
    if settings["size"] < 16:
        raise ValueError(f"size: found {settings['size']!r}, expected a whole number of at least 16")
    if settings["window"] == 1:
        raise ValueError("window: found 1, expected 0 or at least 2 frames")
    limits = parse_limits(settings["fail_on"])
    scenes = scenes_of(parts["data"])
    if settings["depth"] is not None and len(scenes) > 1:
        raise ValueError(f"depth: found {len(scenes)} recordings for one folder of maps, expected one (data.root=…)")
    folder = Path(str(settings["output"])).expanduser()
    folders = [folder if len(scenes) == 1 else folder / scene.name for scene in scenes]
    with open_output_folder(folder, "output") as output:
        output.check(place / name for place in folders for name in ("validate.json", "validate.html"))
        # Validate the scenes, write the files of each into its folder and print the summary; returns the
        # exit code
        method = parts["method"]
        written, all_exceeded, lines = [], [], []
        for scene, scene_folder in zip(scenes, folders, strict=True):
            maps = None
            if settings["depth"] is not None:
                maps = depth_maps.open_depth_maps(settings["depth"], scene.recording, settings["depth_unit"])
            validation = _validate_recording(_RecordingValidation(scene, maps), method, settings, progress)
            summary = _summarise_recording(validation)
            exceeded = list_exceeded_limits(summary, limits)
            content = {
                "scene": scene.name,
                "source": "sensor" if maps is None else "maps",
                "fail_on": settings["fail_on"],
                **({} if maps is None else {"maps": maps.report}),
                "notes": list(scene.recording.report),
                "intrinsics_guessed": intrinsics_options.find_guess_report(scene.recording.report),
                "exceeded": exceeded,
                "whole": summary,
                "windows": validation.windows,
                "frames": validation.rows,
            }
            written += [
                storage.write_json(scene_folder / "validate.json", storage.to_strict_json(content)),
                _write_page(scene_folder, validation, summary, exceeded),
            ]
            lines += [
                *_format_summary(validation.scene.name, summary, validation.notes),
                *(f"  exceeded: {limit_line}" for limit_line in exceeded),
            ]
            all_exceeded += exceeded
        print("\n".join([*lines, "wrote", *(f"  {path}" for path in written)]))
        return int(bool(all_exceeded))


def list_exceeded_limits(
    whole: Mapping[str, Any], limits: Mapping[str, float], known: Mapping[str, str] = _VALIDATION_LIMITS
) -> list[str]:
    """Texts of the limits exceeded by a recording; an unknown quantity exceeds no limit."""
    values = {name: whole["limited"][name] for name in limits}
    return [
        f"{name} is {value:.4g}, limit {limits[name]:g} ({known[name]})"
        for name, value in values.items()
        if value is not None and value > limits[name]
    ]


def parse_limits(text: str | None, known: Mapping[str, str] = _VALIDATION_LIMITS) -> dict[str, float]:
    """``wrong>0.05,scale>0.1`` -> limit by name; names must be in ``known``.

    Raises:
        ValueError: another syntax or name.
    """
    limits: dict[str, float] = {}
    for part in (text or "").split(",") if text else ():
        match = _LIMIT_PATTERN.fullmatch(part)
        try:
            if match is None or match.group(1) not in known:
                raise ValueError
            limits[match.group(1)] = float(match.group(2))
        except ValueError:
            expected = f"NAME>NUMBER, separated by commas, of {', '.join(known)}"
            raise ValueError(f"fail_on: found {part.strip()!r}, expected {expected}") from None
    return limits


# ------------------------------------------------------------------------------------------------------------- frames


def _validate_recording(
    validated: _RecordingValidation, method: Method, settings: Mapping[str, Any], progress: Progress
) -> _RecordingValidation:
    """Validate the frames one by one, then diagnose windows of frames."""
    n = len(validated.scene.recording)
    with_map = list(range(n)) if validated.maps is None else validated.maps.frames
    frames = with_map[:: settings["every"]][: settings["max_frames"]]
    for i in progress(frames, f"{validated.scene.name}: frames", len(frames)):
        frame = load_frame(validated.scene, settings, i)
        recording = validated.scene.recording
        depth, source_views, source_maps = None, None, None
        if validated.maps is not None:
            depth_map = validated.maps[i]
            depth = torch.zeros(1, *frame.hw) if depth_map is None else depth_map
            depth = depth.to(frame.camera.f)
        if len(recording) > 1:
            offered = candidate_frames(recording, i, settings["steps"])
            source_views = stack([load_frame(validated.scene, settings, k) for k in offered])
            maps = [] if validated.maps is None else [validated.maps[k] for k in offered]
            available = [m for m in maps if m is not None]
            if available and len({m.shape for m in available}) == 1:
                source_maps = torch.stack([torch.zeros_like(available[0]) if m is None else m for m in maps])
        options = {k: settings[k] for k in ("views", "source_views", "size", "tolerance", "seed")}
        frame_validation = validate_depth(
            depth, frame, source_views, other_maps=source_maps, method=method, hint=validated.scene.hint, **options
        )
        row = _summarise_frame(int(validated.scene.recording.number[i]), frame_validation)
        validated.rows.append(row)
        # Figures of the worst frames so far are kept
        worst = sorted(validated.rows, key=_severity, reverse=True)[: settings["pictures"]]
        kept = {each["frame"] for each in worst}
        if row["frame"] in kept:
            out, single = io.BytesIO(), frame_validation[0]
            title = append_cutoff(format_frame(validated.scene.name, row["frame"]), settings["cutoff"])
            draw_validation(out, frame.image[0].cpu(), single.depth, single.state, single.evidence, title=title)
            validated.pictures[row["frame"]] = out.getvalue()
            validated.pictures = {k: v for k, v in validated.pictures.items() if k in kept}
    if settings["window"]:
        size = min(settings["window"], n)
        firsts = sorted({min(k, n - size) for k in range(0, max(frames[-1] + 1 - size, 0) + 1, size)}) if n > 1 else []
        for first in progress(firsts, f"{validated.scene.name}: windows", len(firsts)):
            validated.windows.append(_diagnose_window(validated, first, size, settings))
    return validated


def _summarise_frame(number: int, validation: DepthValidation) -> Row:
    """DepthValidation -> row of a frame: fractions by state, intervals, evidence coverage."""
    has_depth = validation.depth > 0
    n = int(has_depth.sum())
    wrong_by_cause = validation.cause[has_depth & (validation.state == State.WRONG)]
    causes = {name.lower(): int((wrong_by_cause == code).sum()) for code, name in names(WrongCause).items()}
    row: Row = {
        "frame": number,
        "pixels": n,
        **{
            f"share_{name.lower()}": int(((validation.state == code) & has_depth).sum()) / n if n else None
            for code, name in names(State).items()
        },
        "wrong_causes": {name: count for name, count in causes.items() if name != "none"},
    }
    for name in _INTERVAL_FIELDS:
        value, low, high = (float(x) for x in getattr(validation, name)[0])
        row[name] = None if math.isnan(value) else {"value": value, "low": low, "high": high}
    for name in ("sparse_evidence", "photometric_evidence", "consistency_evidence"):
        evidence = getattr(validation, name)[has_depth]
        coverage = float(evidence.isfinite().double().mean()) if n else None
        row[name] = {"coverage": coverage, "against": int((evidence.abs() > 3).sum())}
    clip_depth = float(validation.clip_depth[0])
    return row | {"clip_depth": None if math.isnan(clip_depth) else clip_depth}


def _severity(row: Row) -> float:
    """Sort key of the frames: fraction of wrong pixels among all."""
    wrong = row["share_wrong"]
    return float(wrong) if wrong is not None else -1.0


def _diagnose_window(validated: _RecordingValidation, first: int, size: int, settings: Mapping[str, Any]) -> Row:
    """Diagnose ``size`` consecutive frames -> row with the likely cause."""
    frames = [load_frame(validated.scene, settings, k) for k in range(first, first + size)]
    diagnosis = faults.Diagnosis(None, None, {}, 0)
    if validated.maps is None:
        diagnosis = faults.diagnose(frames, seed=settings["seed"])
    else:
        depth_maps_of_window = [validated.maps[k] for k in range(first, first + size)]
        shapes = {m.shape for m in depth_maps_of_window if m is not None}
        if len(shapes) == 1:  # maps of different sizes have no common fault
            blank = torch.zeros(next(iter(shapes)))
            diagnosis = faults.diagnose(
                frames, [blank if m is None else m for m in depth_maps_of_window], seed=settings["seed"]
            )
    number = validated.scene.recording.number
    row: Row = {
        "frames": [int(number[first]), int(number[first + size - 1])],
        "pairs": diagnosis.n_pairs,
        "by": diagnosis.by,
    }
    numbers = set(number[first : first + size].tolist())
    clip_depth = _find_shared_clip_depth([each for each in validated.rows if each["frame"] in numbers])
    cause, kind = diagnosis.cause, diagnosis.kind
    if cause is None and clip_depth is not None:
        cause, kind = f"cut at {clip_depth:.3g} m", "cut"
    return row | {"cause": cause, "kind": kind, "loss": dict(diagnosis.loss)}


def _find_shared_clip_depth(rows: Sequence[Row]) -> float | None:
    """Common depth at which most maps of ``rows`` are clipped, m; None without one."""
    depths = [row["clip_depth"] for row in rows if row["clip_depth"] is not None]
    if 2 * len(depths) <= len(rows):
        return None
    median = statistics.median(depths)
    return median if 2 * sum(abs(x - median) <= 0.01 * median for x in depths) > len(rows) else None


# ------------------------------------------------------------------------------------------------------------- summary


def _summarise_recording(validated: _RecordingValidation) -> Row:
    """Statistics of a recording; ``limited`` are those that ``fail_on`` limits."""
    rows = validated.rows
    pixels = sum(row["pixels"] for row in rows)
    states = [name.lower() for name in names(State).values()]
    count = {name: sum(row[f"share_{name}"] * row["pixels"] for row in rows if row["pixels"]) for name in states}
    checked = count["wrong"] + count["consistent"]
    medians = {}
    for name in ("scale", "scale_vs_trajectory", "shift", "tilt"):
        values = [row[name]["value"] for row in rows if row[name] is not None]
        medians[name] = statistics.median(values) if values else None
    least = DEFAULT_VALIDATION_OPTIONS.min_window_pairs
    diagnosable = [row for row in validated.windows if row["pairs"] >= least or row["cause"] is not None]
    causes = Counter(row["cause"] for row in diagnosable if row["cause"] is not None)
    known = [(row["wrong"]["low"], row["pixels"] * (1 - row["share_cannot_know"])) for row in rows if row["wrong"]]
    weight = sum(n for _, n in known)
    # Lower bound of the two-sided 95 % interval of a fraction
    n_caused, n_windows = (torch.tensor([float(n)]) for n in (sum(causes.values()), len(diagnosable)))
    of_windows = float(share_interval(n_caused, n_windows)[0, 1])
    # Difference of scale between frames: largest lower minus smallest upper bound, a tenth of the frames left out at
    # either end; 0 where one scale is in all intervals
    scales = [row["scale"] for row in rows if row["scale"] is not None]
    low, high = (sorted(x[bound] for x in scales) for bound in ("low", "high"))
    rest = len(scales) // 10
    drift = max(low[-1 - rest] - high[rest], 0.0) if len(scales) > 1 else None
    limited = {
        "wrong": (sum(low * n for low, n in known) / weight if weight else None),
        "scale": _deviation_lower_bound(rows, "scale", 1.0),
        "shift": _deviation_lower_bound(rows, "shift", 0.0),
        "tilt": _deviation_lower_bound(rows, "tilt", 0.0),
        "drift": drift,
        "causes": None if math.isnan(of_windows) else of_windows,
        "unknown": count["cannot_know"] / pixels if pixels else None,
    }
    return {
        "frames": len(rows),
        "has_maps": validated.maps is not None,
        "pixels": pixels,
        "median": medians,
        "wrong": count["wrong"] / checked if checked else None,
        "wrong_causes": {
            name: sum(row["wrong_causes"][name] for row in rows) / checked if checked else None
            for name in _NAMED_CAUSES
        },
        "causes": dict(causes),
        "windows": len(diagnosable),
        "clip_depth": _find_shared_clip_depth(rows),
        "limited": limited,
    }


def _deviation_lower_bound(rows: Sequence[Row], name: str, sound: float) -> float | None:
    """Distance of a statistic's median interval from ``sound``, its value for a correct map; 0 inside the interval.

    Errors common to all frames are in every frame's interval, so more frames do not narrow it.
    """
    known = [row[name] for row in rows if row[name] is not None]
    if not known:
        return None
    low, high = (statistics.median(x[bound] for x in known) for bound in ("low", "high"))
    return max(low - sound, sound - high, 0.0)


def _format_summary(name: str, summary: Row, notes: Sequence[str] = ()) -> list[str]:
    """Printed summary of a recording."""
    limited, medians = summary["limited"], summary["median"]
    wrong = "no pixel can be checked"
    if summary["wrong"] is not None:
        named = [(x, cause) for cause, x in summary["wrong_causes"].items() if x and x >= _MIN_NAMED_SHARE]
        shown = ", ".join(f"{x:.1%} {words(cause)}" for x, cause in sorted(named, reverse=True))
        wrong = f"{summary['wrong']:.1%} of the checked pixels are wrong{f' ({shown})' if shown else ''}"
    unknown = "no depth" if limited["unknown"] is None else f"{limited['unknown']:.1%} cannot be checked"
    scale = "scale unknown" if medians["scale"] is None else f"scale {_format_factor(medians['scale'])}"
    lines = [f"{name}: {format_count(summary['frames'], 'frame')}: {wrong}, {unknown}; {scale}"]
    if limited["drift"]:
        lines.append(f"  the scale differs by at least {limited['drift']:.3f} between frames")
    for cause, n in sorted(summary["causes"].items(), key=lambda item: -item[1]):
        lines.append(f"  likely cause in {n} of {format_count(summary['windows'], 'window')}: {cause}")
    if summary["clip_depth"] is not None and not any(cause.startswith("cut at") for cause in summary["causes"]):
        lines.append(f"  cut at {summary['clip_depth']:.3g} m: larger depths are set to this value")
    if summary["has_maps"]:
        lines += _name_wrong_scale(medians, limited["scale"])
    return lines + [f"  {note}" for note in notes]


def _name_wrong_scale(medians: Mapping[str, float | None], deviation: float | None) -> list[str]:
    """Sentence on whether the sensor or the maps have the wrong scale, by the poses as a third witness.

    Args:
        medians: ``scale``, maps over the sensor's near returns, and ``scale_vs_trajectory``, the sensor's depth over
            what the poses imply; None = not measured.
        deviation: distance of the interval of ``scale`` from 1.
    """
    scale, sensor = medians["scale"], medians["scale_vs_trajectory"]
    if scale is None or scale <= 0 or not deviation or abs(math.log(scale)) < _MIN_SCALE_DIFFERENCE:
        return []
    start = f"  maps are {_format_factor(scale)} times the sensor's depth"
    if sensor is None or sensor <= 0:
        return [f"{start}; without usable poses which of the two is wrong cannot be determined"]
    off_maps = abs(math.log(scale * sensor))
    off_sensor = abs(math.log(sensor))
    if off_maps < _MAX_WITNESS_RATIO * off_sensor:
        return [f"{start}, and agree with the poses: the sensor's scale is wrong (data.depth_unit=)"]
    if off_sensor < _MAX_WITNESS_RATIO * off_maps:
        return [f"{start}, which agrees with the poses: the maps' scale is wrong"]
    return [f"{start}; the poses agree with neither, so which is wrong cannot be determined"]


def _format_factor(value: float) -> str:
    """A factor as text; very large or small ones in scientific notation."""
    return f"{value:.3f}" if 0.1 <= value < 1e4 else f"{value:.4g}"


def _write_page(place: Path, validated: _RecordingValidation, whole: Row, exceeded: Sequence[str]) -> Path:
    rows = sorted(validated.rows, key=_severity, reverse=True)
    frames = []
    for row in rows:
        checked = None if row["share_cannot_know"] is None else 1 - row["share_cannot_know"]
        cells = [pages.format_estimate(row["wrong"]), "–" if checked is None else f"{checked:.2f}"]
        cells += [pages.format_estimate(row[name]) for name in ("scale", "shift", "tilt")]
        cells.append("–" if row["clip_depth"] is None else f"{row['clip_depth']:.3g}")
        frames.append(pages.ValidatedFrame(f"frame {row['frame']}", cells, validated.pictures.get(row["frame"])))
    notes = [f"{line[:1].upper()}{line[1:]}." for line in validated.scene.recording.report]
    lines = _format_summary(validated.scene.name, whole, validated.notes) + notes
    return pages.write_validation_page(
        place / "validate.html",
        validated.scene.name,
        sentences=lines,
        columns=_TABLE_COLUMNS,
        frames=frames,
        failed=[f"Exceeded: {limit_line}" for limit_line in exceeded],
    )
