"""``dhtorch validate``: whether the depth of a recording is right, its sensor's own or maps from elsewhere.

Writes ``validate.json`` (a row for every frame, what they come to, the causes named in windows of frames) and
``validate.html``, worst first. The exit code is 1 where a limit of ``fail_on`` is exceeded, so that it can stand in a
data pipeline.
"""

from __future__ import annotations

import io
import math
import re
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from dhtorch.codes import State, names
from dhtorch.data import depth_maps
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.depth_maps import DepthMaps
from dhtorch.data.io import decode as files
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.method import Method
from dhtorch.pytree import stack
from dhtorch.records import DepthValidation, Frame
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.validation import faults
from dhtorch.validation.validate import share_interval, validate_depth
from dhtorch.viz.plots import append_cutoff, draw_validation, format_frame
from dhtorch.viz.viewer import validation as pages

Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]
Row = dict[str, Any]

#: Numbers of a frame with their interval.
_INTERVAL_FIELDS = ("scale", "scale_near", "scale_far", "scale_vs_trajectory", "shift", "tilt", "wrong")

#: What ``fail_on`` may name → what is held against the limit, in words. All are of a whole recording, and all but the
#: last are bounds that the number exceeds with 95 %: few frames, or unsure ones, exceed no limit by chance.
_VALIDATION_LIMITS = {
    "wrong": "share of wrong pixels among those of which something is known, at least",
    "scale": "|scale - 1| of the median frame, at least",
    "shift": "|shift| of the median frame, m, at least",
    "tilt": "tilt of the median frame, at least",
    "drift": "by how much the scale differs between frames, at least",
    "causes": "share of the windows in which a cause is named, at least",
    "unknown": "share of the pixels with a depth of which nothing can be known",
}

#: Columns of the page's table.
_TABLE_COLUMNS = ("wrong, of what is known", "known, of the depth", "scale", "shift, m", "tilt", "cut at, m")

_LIMIT_PATTERN = re.compile(r"\s*([a-z]+)\s*>\s*([0-9.eE+-]+)\s*")


@dataclass
class RecordingValidation:
    """What is said of one recording."""

    scene: Scene
    maps: DepthMaps | None
    rows: list[Row] = field(default_factory=list)
    windows: list[Row] = field(default_factory=list)
    pictures: dict[int, bytes] = field(default_factory=dict)  # frame → PNG, of the worst

    @property
    def notes(self) -> list[str]:
        """How files were matched to frames, where that has to be known."""
        return [] if self.maps is None else self.maps.notes

    def asked(self, every: int) -> list[int]:
        """Every so many of the frames that have a map."""
        return list(range(len(self.scene.recording)) if self.maps is None else self.maps.frames)[::every]

    @property
    def by_number(self) -> dict[int, Row]:
        """Rows of the frames that were looked at, by their number in the capture."""
        return {row["frame"]: row for row in self.rows}


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Judge every scene of the settings; returns the exit code, 1 where a limit is exceeded.

    Raises:
        ValueError, OSError: bad options or data.
    """
    limits = _check_options(settings)
    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        files.set_opencv_threads(settings["threads"])
    scenes = scenes_of(parts["data"])
    if settings["depth"] is not None and len(scenes) > 1:
        raise ValueError(f"depth: found {len(scenes)} recordings for one folder of maps, expected one (data.root=…)")
    folder = Path(str(settings["output"])).expanduser()
    written, failed, lines = [], [], []
    for scene in scenes:
        maps = None
        if settings["depth"] is not None:
            maps = depth_maps.open_depth_maps(settings["depth"], scene.recording, settings["depth_unit"])
        found = _validate_recording(RecordingValidation(scene, maps), parts["method"], settings, progress)
        whole = _summarise_recording(found)
        over = list_exceeded_limits(whole, limits)
        place = folder if len(scenes) == 1 else folder / scene.name
        content = {"scene": scene.name, "source": "sensor" if maps is None else "maps", "fail_on": settings["fail_on"]}
        content |= {} if maps is None else {"maps": maps.report}
        content |= {"intrinsics_guessed": intrinsics_options.find_guess_report(scene.recording.report)}
        content |= {"exceeded": over, "whole": whole, "windows": found.windows, "frames": found.rows}
        written += [
            storage.write_json(place / "validate.json", storage.to_strict_json(content)),
            _write_page(place, found, whole, over),
        ]
        lines += [*_format_summary(found.scene.name, whole, found.notes), *(f"  exceeded: {line}" for line in over)]
        failed += over
    print("\n".join([*lines, "wrote", *(f"  {path}" for path in written)]))
    return int(bool(failed))


def list_exceeded_limits(
    whole: Mapping[str, Any], limits: Mapping[str, float], known: Mapping[str, str] = _VALIDATION_LIMITS
) -> list[str]:
    """Limits that a recording's numbers exceed, in words; a number that cannot be known exceeds none."""
    found = []
    for name, limit in limits.items():
        value = whole["held"][name]
        if value is not None and value > limit:
            found.append(f"{name} is {value:.4g}, limit {limit:g} ({known[name]})")
    return found


def parse_limits(text: str | None, known: Mapping[str, str] = _VALIDATION_LIMITS) -> dict[str, float]:
    """``wrong>0.05,scale>0.1`` as numbers by name, of those ``known``.

    Raises:
        ValueError: something else.
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
    found: RecordingValidation, method: Method, settings: Mapping[str, Any], progress: Progress
) -> RecordingValidation:
    """Every frame by itself, then windows of frames."""
    n = len(found.scene.recording)
    frames = found.asked(settings["every"])[: settings["most"]]
    for i in progress(frames, f"{found.scene.name}: frames", len(frames)):
        frame = _load_frame(found.scene, settings, i)
        verdict = _validate_frame(found, frame, i, method, settings)
        row = _summarise_frame(int(found.scene.recording.number[i]), verdict)
        found.rows.append(row)
        _keep_worst(found, frame, verdict, settings)
    if settings["window"]:
        size = min(settings["window"], n)
        firsts = sorted({min(k, n - size) for k in range(0, max(frames[-1] + 1 - size, 0) + 1, size)}) if n > 1 else []
        for first in progress(firsts, f"{found.scene.name}: windows", len(firsts)):
            found.windows.append(_diagnose_window(found, first, size, settings))
    return found


def _load_frame(scene: Scene, settings: Mapping[str, Any], i: int) -> Frame:
    frame = scene.recording[i].to(getattr(torch, settings["dtype"])).to(settings["device"])
    if 0 in frame.hw:
        raise ValueError(f"{scene.name}: found frames without pictures, expected pictures (data.images=true)")
    return range_split(frame, settings["cutoff"])


def _validate_frame(
    found: RecordingValidation, frame: Frame, i: int, method: Method, settings: Mapping[str, Any]
) -> DepthValidation:
    recording = found.scene.recording
    depth, others, beside = None, None, None
    if found.maps is not None:
        given = found.maps[i]
        depth = torch.zeros(1, *frame.hw) if given is None else given
        depth = depth.to(frame.camera.f)
    if len(recording) > 1:
        offered = candidate_frames(recording, i, settings["steps"])
        others = stack([_load_frame(found.scene, settings, k) for k in offered])
        maps = [] if found.maps is None else [found.maps[k] for k in offered]
        known = [m for m in maps if m is not None]
        if known and len({m.shape for m in known}) == 1:
            beside = torch.stack([torch.zeros_like(known[0]) if m is None else m for m in maps])
    options = {k: settings[k] for k in ("views", "source_views", "size", "tolerance", "seed")}
    return validate_depth(depth, frame, others, other_maps=beside, method=method, hint=found.scene.hint, **options)


def _summarise_frame(number: int, verdict: DepthValidation) -> Row:
    """A frame's numbers."""
    there = verdict.depth > 0
    n = int(there.sum())
    row: Row = {"frame": number, "pixels": n}
    for code, name in names(State).items():
        row[f"share_{name.lower()}"] = int(((verdict.state == code) & there).sum()) / n if n else None
    for name in _INTERVAL_FIELDS:
        value, low, high = (float(x) for x in getattr(verdict, name)[0])
        row[name] = None if math.isnan(value) else {"value": value, "low": low, "high": high}
    for name in ("sparse_evidence", "photometric_evidence", "consistency_evidence"):
        said = getattr(verdict, name)[there]
        against = said.abs() > 3
        row[name] = {"told": float(said.isfinite().double().mean()) if n else None, "against": int(against.sum())}
    clip_depth = float(verdict.clip_depth[0])
    return row | {"clip_depth": None if math.isnan(clip_depth) else clip_depth}


def _keep_worst(
    found: RecordingValidation, frame: Frame, verdict: DepthValidation, settings: Mapping[str, Any]
) -> None:
    """The pictures of the worst frames so far."""
    order = sorted(range(len(found.rows)), key=lambda k: -_severity(found.rows[k]))[: settings["pictures"]]
    here = len(found.rows) - 1
    if here not in order:
        return
    out = io.BytesIO()
    one = verdict[0]
    number = found.rows[here]["frame"]
    title = append_cutoff(format_frame(found.scene.name, number), settings["cutoff"])
    draw_validation(out, frame.image[0].cpu(), one.depth, one.state, one.evidence, title=title)
    found.pictures[number] = out.getvalue()
    kept = {found.rows[k]["frame"] for k in order}
    found.pictures = {k: v for k, v in found.pictures.items() if k in kept}


def _severity(row: Row) -> float:
    """By which frames are ordered: the share of all pixels that are wrong."""
    wrong = row["share_wrong"]
    return float(wrong) if wrong is not None else -1.0


def _diagnose_window(found: RecordingValidation, first: int, size: int, settings: Mapping[str, Any]) -> Row:
    """What is named in some consecutive frames."""
    frames = [_load_frame(found.scene, settings, k) for k in range(first, first + size)]
    named = faults.Diagnosis(None, None, {}, 0)
    if found.maps is None:
        named = faults.diagnose(frames, seed=settings["seed"])
    else:
        given = [found.maps[k] for k in range(first, first + size)]
        shapes = {m.shape for m in given if m is not None}
        if len(shapes) == 1:  # maps of several sizes share no fault of the file
            blank = torch.zeros(next(iter(shapes)))
            named = faults.diagnose(frames, [blank if m is None else m for m in given], seed=settings["seed"])
    number = found.scene.recording.number
    row: Row = {"frames": [int(number[first]), int(number[first + size - 1])], "pairs": named.n_pairs, "by": named.by}
    cut = _find_shared_clip_depth(
        [found.by_number[k] for k in number[first : first + size].tolist() if k in found.by_number]
    )
    if named.cause is None and cut is not None:
        return row | {"cause": f"cut at {cut:.3g} m", "kind": "cut", "loss": dict(named.loss)}
    return row | {"cause": named.cause, "kind": named.kind, "loss": dict(named.loss)}


def _find_shared_clip_depth(rows: Sequence[Row]) -> float | None:
    """Where the maps of some frames are cut, if those of most of them are, all at one depth."""
    at = [row["clip_depth"] for row in rows if row["clip_depth"] is not None]
    if 2 * len(at) <= len(rows):
        return None
    middle = statistics.median(at)
    return middle if 2 * sum(abs(x - middle) <= 0.01 * middle for x in at) > len(rows) else None


# -------------------------------------------------------------------------------------------------------- what is said


def _summarise_recording(found: RecordingValidation) -> Row:
    """A recording's numbers, and those that limits are held against."""
    rows = found.rows
    pixels = sum(row["pixels"] for row in rows)
    states = [name.lower() for name in names(State).values()]
    count = {name: sum(row[f"share_{name}"] * row["pixels"] for row in rows if row["pixels"]) for name in states}
    known = count["wrong"] + count["consistent"]
    middle = {}
    for name in ("scale", "scale_vs_trajectory", "shift", "tilt"):
        values = [row[name]["value"] for row in rows if row[name] is not None]
        middle[name] = statistics.median(values) if values else None
    able = [row for row in found.windows if row["pairs"] >= faults.MIN_WINDOW_PAIRS or row["cause"] is not None]
    kinds = Counter(row["cause"] for row in able if row["cause"] is not None)
    held = {
        "wrong": _wrong_lower_bound(rows),
        "scale": _deviation_lower_bound(rows, "scale", 1.0),
        "shift": _deviation_lower_bound(rows, "shift", 0.0),
        "tilt": _deviation_lower_bound(rows, "tilt", 0.0),
        "drift": _drift_lower_bound(rows),
        "causes": _share_lower_bound(sum(kinds.values()), len(able)),
        "unknown": count["cannot_know"] / pixels if pixels else None,
    }
    return {
        "frames": len(rows),
        "pixels": pixels,
        "median": middle,
        "wrong": count["wrong"] / known if known else None,
        "causes": dict(kinds),
        "windows": len(able),
        "clip_depth": _find_shared_clip_depth(rows),
        "held": held,
    }


def _deviation_lower_bound(rows: Sequence[Row], name: str, sound: float) -> float | None:
    """How far a number of the median frame is from what it would be of a sound map, by the nearer bound of its
    interval; 0 where the interval holds that.

    What errs in all frames alike is in each frame's interval, so more frames make it no narrower.
    """
    known = [row[name] for row in rows if row[name] is not None]
    if not known:
        return None
    low, high = (statistics.median(x[bound] for x in known) for bound in ("low", "high"))
    return max(low - sound, sound - high, 0.0)


def _drift_lower_bound(rows: Sequence[Row]) -> float | None:
    """By how much the scales of frames differ: what one is at least where depth is too far, minus what one is at most
    where it is too near, a tenth of the frames left out at either end; 0 where one scale is in all intervals."""
    known = [row["scale"] for row in rows if row["scale"] is not None]
    if len(known) < 2:
        return None
    low, high = (sorted(x[bound] for x in known) for bound in ("low", "high"))
    rest = len(known) // 10
    return max(low[-1 - rest] - high[rest], 0.0)


def _wrong_lower_bound(rows: Sequence[Row]) -> float | None:
    """Lower bounds of the frames' shares that are wrong, averaged by the pixels of which something is known."""
    known = [(row["wrong"]["low"], row["pixels"] * (1 - row["share_cannot_know"])) for row in rows if row["wrong"]]
    weight = sum(n for _, n in known)
    return sum(low * n for low, n in known) / weight if weight else None


def _share_lower_bound(part: int, whole: int) -> float | None:
    """Lower bound of a share, one of 95 % to both sides."""
    low = float(share_interval(torch.tensor([float(part)]), torch.tensor([float(whole)]))[0, 1])
    return None if math.isnan(low) else low


def _format_summary(name: str, whole: Row, notes: Sequence[str] = ()) -> list[str]:
    """A recording in words."""
    held, middle = whole["held"], whole["median"]
    wrong = "nothing can be known" if whole["wrong"] is None else f"{whole['wrong']:.1%} of what is known is wrong"
    unknown = "no depth" if held["unknown"] is None else f"{held['unknown']:.1%} cannot be known"
    scale = "scale cannot be known" if middle["scale"] is None else f"scale {_format_factor(middle['scale'])}"
    lines = [f"{name}: {format_count(whole['frames'], 'frame')}: {wrong}, {unknown}; {scale}"]
    if held["drift"]:
        lines.append(f"  the scale differs by {held['drift']:.3f} at least between frames")
    for cause, n in sorted(whole["causes"].items(), key=lambda item: -item[1]):
        lines.append(f"  likely cause in {n} of {format_count(whole['windows'], 'window')}: {cause}")
    if whole["clip_depth"] is not None and not any(cause.startswith("cut at") for cause in whole["causes"]):
        lines.append(f"  cut at {whole['clip_depth']:.3g} m: what is farther is said to lie there")
    return lines + [f"  {note}" for note in notes]


def _format_factor(value: float) -> str:
    """A factor, legible where it is a unit's or beyond all sense."""
    return f"{value:.3f}" if 0.1 <= value < 1e4 else f"{value:.4g}"


def _write_page(place: Path, found: RecordingValidation, whole: Row, over: Sequence[str]) -> Path:
    rows = sorted(found.rows, key=_severity, reverse=True)
    frames = []
    for row in rows:
        known = None if row["share_cannot_know"] is None else 1 - row["share_cannot_know"]
        cells = [pages.format_estimate(row["wrong"]), "–" if known is None else f"{known:.2f}"]
        cells += [pages.format_estimate(row[name]) for name in ("scale", "shift", "tilt")]
        cells.append("–" if row["clip_depth"] is None else f"{row['clip_depth']:.3g}")
        frames.append(pages.ValidatedFrame(f"frame {row['frame']}", cells, found.pictures.get(row["frame"])))
    failed = [f"Exceeded: {line}" for line in over]
    guess = intrinsics_options.find_guess_report(found.scene.recording.report)
    said = _format_summary(found.scene.name, whole, found.notes) + ([f"Its {guess}."] if guess else [])
    return pages.write_validation_page(
        place / "validate.html", found.scene.name, said=said, columns=_TABLE_COLUMNS, frames=frames, failed=failed
    )


def _check_options(settings: Mapping[str, Any]) -> dict[str, float]:
    """The limits; options that would only fail later."""
    for name, low in (("every", 1), ("most", 1), ("window", 0), ("pictures", 0), ("source_views", 1), ("size", 16)):
        value = settings[name]
        whole = isinstance(value, int) and not isinstance(value, bool) and value >= low
        if not whole and not (name == "most" and value is None):
            raise ValueError(f"{name}: found {value!r}, expected a whole number of at least {low}")
    if settings["window"] == 1:
        raise ValueError("window: found 1, expected 0 or at least 2 frames")
    if settings["dtype"] not in ("float32", "float64"):
        raise ValueError(f"dtype: found {settings['dtype']!r}, expected float32 or float64")
    return parse_limits(settings["fail_on"])
