"""``dhtorch reference``: maps of any depth network or sensor in metres, aligned in a recording's own returns.

Frames are written as ``dhtorch complete`` writes them: whole or not there, a recording again where the format can hold
it. ``reference.json`` holds what was done to every map, ``reference.html`` shows it, worst first. The exit code is 1
where a limit of ``fail_on`` is exceeded.
"""

from __future__ import annotations

import io
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch.alignment import align
from dhtorch.cli import complete
from dhtorch.cli import completed_folder as completed
from dhtorch.cli.completed_folder import CompletionTask
from dhtorch.cli.layouts import select_layout
from dhtorch.cli.validate import list_exceeded_limits, parse_limits
from dhtorch.data import depth_maps
from dhtorch.data.depth_maps import DepthMaps
from dhtorch.data.io import decode as data_files
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import upcast_intrinsics
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import DepthMap, Frame
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.viz.plots import draw_aligned
from dhtorch.viz.viewer import validation as pages

Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]
Row = dict[str, Any]

#: What ``fail_on`` may name → what is held against the limit, in words. All are of a whole recording.
_ALIGNMENT_LIMITS = {
    "scale": "|median scale - 1| of the frames, of kind=metric",
    "change": "median share by which depths were changed, of kind=metric",
    "sigma": "median sigma / depth of the frames",
    "silent": "share of the pixels of the maps that are silent",
    "unanchored": "share of the frames with a map that could not be aligned",
}

#: Columns of the page's table.
_TABLE_COLUMNS = ("model", "scale", "sigma / depth", "silent", "near references", "far references")

#: Options that decide what the files of a frame hold.
_KEY_OPTIONS = (
    "data",
    "method",
    "seed",
    "dtype",
    "cutoff",
    "steps",
    "past",
    "kind",
    "depth_unit",
    "max_sigma_rel",
    "arrays",
)

#: Modules that decide what is found beside those that the settings name.
_CODE_ROOTS = (
    "dhtorch.alignment.align",
    "dhtorch.pipeline.view_report",
    "dhtorch.data.depth_maps",
    "dhtorch.export.frames",
)

#: Median sigma / depth below which maps and near returns are of one source: no two sensors agree so well.
_SAME_SENSOR_SIGMA_REL = 5e-4

_PAGE_NOTE = "Maps are coloured from near (blue) to far (red), each by its own range; silence is left blank."


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Reference the maps of a recording; returns the exit code, 1 where a limit is exceeded.

    Raises:
        ValueError, OSError: bad options or data, a folder that holds something else.
        KeyboardInterrupt: Ctrl-C; whole frames stay.
    """
    limits = _check_options(settings)
    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        data_files.set_opencv_threads(settings["threads"])
    scenes = scenes_of(parts["data"])
    if len(scenes) > 1:
        raise ValueError(f"depth: found {len(scenes)} recordings for one folder of maps, expected one (data.root=…)")
    scene, out = scenes[0], Path(str(settings["out"])).expanduser()
    maps = depth_maps.open_depth_maps(settings["depth"], scene.recording, settings["depth_unit"])
    task = _make_alignment_task(scene, maps, parts["method"], settings, out)
    completed.resume_folder(task)
    before = sum(task.name(i) in task.done for i in task.frames)
    todo = [i for i in task.frames if task.name(i) not in task.done]
    with complete.close_on_exit(task):
        for i in progress(todo, f"{scene.name}: frames", len(todo)):
            complete.write_frame(task, i, *_align_frame(task, maps, i))
    rows = [task.done[task.name(i)] for i in task.frames]
    whole = _summarise_recording(rows)
    over = list_exceeded_limits(whole, limits, _ALIGNMENT_LIMITS)
    content = {"scene": scene.name, "kind": settings["kind"], "fail_on": settings["fail_on"], "exceeded": over}
    keep = ("frame", "anchored", "views")
    content |= {"maps": maps.report, "whole": whole, "frames": [{k: row[k] for k in keep} for row in rows]}
    storage.write_json(out / "align.json", storage.to_strict_json(content))
    said = [*_format_summary(scene.name, settings["kind"], whole, before), *(f"  {note}" for note in maps.notes)]
    _write_page(task, maps, said, over)
    print("\n".join([*said, *(f"  exceeded: {line}" for line in over), "wrote", f"  {out}"]))
    return int(bool(over))


# -------------------------------------------------------------------------------------------------------------- frames


def _make_alignment_task(
    scene: Scene, maps: DepthMaps, method: Method, settings: Mapping[str, Any], out: Path
) -> CompletionTask:
    """What is wanted of a recording: every frame that has a map."""
    recording = scene.recording
    frames = maps.frames[:: settings["every"]][: settings["most"]]
    hw = recording[frames[0]].hw
    if 0 in hw:
        raise ValueError(f"{scene.name}: found frames without pictures, expected pictures (data.images=true)")
    first = maps[frames[0]]
    assert first is not None
    layout = select_layout(recording, settings["format"], settings["unit"], same=first.shape[-2:] == hw)
    digest = result_files.compute_data_digest(_list_data_files(scene, maps, frames))
    options = {**settings, **dict.fromkeys(completed.EXTRA_FILES, False)}
    return CompletionTask(
        scene=scene,
        folder=out,
        layout=layout,
        method=method,
        settings=options,
        frames=frames,
        offers={},
        shared=completed.build_shared_metadata(
            scene, layout, settings, digest, keyed=_KEY_OPTIONS, roots=_CODE_ROOTS, calibration=None, word="anchor"
        ),
    )


def _list_data_files(scene: Scene, maps: DepthMaps, frames: Sequence[int]) -> dict[str, Path]:
    """All that is read."""
    given = {f"depth/{file.name}": file for i in frames if (file := maps.files[i]) is not None}
    root = scene.root
    return {**result_files.list_files_below([root]), **given}


def _align_frame(task: CompletionTask, maps: DepthMaps, i: int) -> tuple[Frame, DepthMap, Row]:
    """The map of one frame, on the CPU, and what was done to it."""
    s, given = task.settings, maps[i]
    assert given is not None  # frames without a map are not asked for
    frame = _load_frame(task, i)
    x = torch.where(given > 0, given, torch.nan).to(frame.camera.f)  # a 0 of a file is no value, of whatever kind
    trace: Trace = {}
    views: list[int] = []
    with torch.no_grad():
        if len(task.recording) > 1:
            offered = candidate_frames(task.recording, i, s["steps"], s["past"])
            others = stack([_load_frame(task, k) for k in offered])
            method = with_view_selection(task.method)
            told = method(frame, others, seed=s["seed"], hint=task.scene.hint, trace=trace)
            references, views = [trace["samples"], told], [int(task.recording.number[k]) for k in offered]
        else:
            whole = upcast_intrinsics(frame)
            uv = task.method.sample(frame.hw, task.method.n).to(frame.camera.f)[None]
            references = [task.method.backproject(whole, uv)]
        chosen: dict[str, align.ModelSelection] = {}
        options = {"kind": s["kind"], "max_sigma_rel": s["max_sigma_rel"], "hw": frame.hw, "trace": chosen}
        found = align.align_depth(x, references, **options).to("cpu")
    points = [int((a.usable if k == 0 else a.keep).sum()) for k, a in enumerate(references)]
    row = _summarise_frame(x.cpu(), found, chosen["chosen"]) | {"near": points[0], "far": sum(points[1:])}
    return frame, found, {"views": views, "anchored": row}


def _load_frame(task: CompletionTask, i: int) -> Frame:
    s = task.settings
    return range_split(task.recording[i].to(getattr(torch, s["dtype"])).to(s["device"]), s["cutoff"])


def _summarise_frame(x: Tensor, found: DepthMap, chosen: align.ModelSelection) -> Row:
    """What was done to a map."""
    keep, there = found.keep, x > 0
    best = int(chosen.model)
    row: Row = {"model": None if best < 0 else chosen.names[best], "silent": 1 - _masked_share(keep, there)}
    row["probability"] = None if best < 0 else float(chosen.weight[0, best])
    likeliest = int(chosen.weight[0].argmax())
    row["likeliest"] = None if best < 0 else chosen.names[likeliest]
    row["likeliest_probability"] = None if best < 0 else float(chosen.weight[0, likeliest])
    if not bool(keep.any()):
        return row | {"scale": None, "change": None, "sigma": None}
    ratio = (found.depth / x)[keep].double()
    sigma = (found.sigma / found.depth)[keep].double().median()
    return row | {"scale": float(ratio.median()), "change": float((ratio - 1).abs().median()), "sigma": float(sigma)}


def _masked_share(part: Tensor, of: Tensor) -> float:
    return int((part & of).sum()) / max(int(of.sum()), 1)


# -------------------------------------------------------------------------------------------------------- what is said


def _summarise_recording(rows: Sequence[Row]) -> Row:
    """A recording's numbers, and those that limits are held against."""
    told = [row["anchored"] for row in rows]
    done = [row for row in told if row["model"] is not None and row["scale"] is not None]
    middle = {k: statistics.median(row[k] for row in done) if done else None for k in ("scale", "change", "sigma")}
    held = {
        "scale": None if middle["scale"] is None else abs(middle["scale"] - 1),
        "change": middle["change"],
        "sigma": middle["sigma"],
        "silent": statistics.fmean(row["silent"] for row in told),
        "unanchored": 1 - len(done) / len(told),
    }
    models = Counter(row["model"] for row in done)
    references = {k: statistics.median(row[k] for row in told) for k in ("near", "far")}
    return {"frames": len(told), "models": dict(models), "median": middle, "reference_views": references, "held": held}


def _format_summary(name: str, kind: str, whole: Row, before: int) -> list[str]:
    """A recording in three sentences."""
    held, middle, n = whole["held"], whole["median"], whole["frames"]
    again = f" ({before} left untouched)" if before else ""
    if middle["scale"] is None:
        return [f"{name}: none of {format_count(n, 'map')} could be aligned{again}: too few near returns."]
    alone = sum(count for model, count in whole["models"].items() if model == "raw")
    maps = format_count(n, "map")
    first = f"{name}: {maps}{again} put into metres."
    if kind == "metric":
        times = f"multiplied by {middle['scale']:.4g} (median of all)"
        left = f"{alone} left as {'they are' if n != 1 else 'it is'}"
        first = f"{name}: {maps}{again}, {left}{'' if alone == n else f'; the others were {times}'}."
        first = (
            first if alone else f"{name}: {maps}{again}, none left as {'they were' if n != 1 else 'it was'}: {times}."
        )
    near, far = (f"{whole['anchors'][k]:g}" for k in ("near", "far"))
    alike = middle["sigma"] < _SAME_SENSOR_SIGMA_REL
    return [
        first,
        *(
            ["  The near returns are on the maps as if both were of one sensor: what it is wrong by is not in sigma."]
            * alike
        ),
        f"  Sigma is {middle['sigma']:.1%} of the depth (median), {held['silent']:.1%} of the pixels are silent.",
        f"  A map is held by {near} near returns and {far} far answers (medians); "
        f"{held['unanchored']:.0%} of the maps could not be aligned.",
    ]


def _write_page(task: CompletionTask, maps: DepthMaps, said: Sequence[str], over: Sequence[str]) -> Path:
    order = sorted(task.frames, key=lambda i: -_severity(task.done[task.name(i)]["anchored"]))
    shown = set(order[: task.settings["pictures"]])
    frames = []
    for i in order:
        row = task.done[task.name(i)]
        cells = [_format_cell(row["anchored"][k]) for k in ("model", "scale", "sigma", "silent", "near", "far")]
        frames.append(
            pages.ValidatedFrame(f"frame {row['frame']}", cells, _render_frame(task, maps, i) if i in shown else None)
        )
    failed = [f"Exceeded: {line}" for line in over]
    place, told = task.folder / "align.html", {"columns": _TABLE_COLUMNS, "frames": frames, "failed": failed}
    return pages.write_validation_page(place, task.scene.name, said=said, word="anchor", note=_PAGE_NOTE, **told)


def _severity(row: Row) -> float:
    """By which frames are ordered: silent pixels, then how wide sigma is."""
    return float(row["silent"]) + (1.0 if row["sigma"] is None else float(row["sigma"]))


def _format_cell(value: Any) -> str:
    return "–" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _render_frame(task: CompletionTask, maps: DepthMaps, i: int) -> bytes:
    """PNG of a frame as its files have it."""
    out, given = io.BytesIO(), maps[i]
    found, _ = completed.read_completed_maps(task, i)
    draw_aligned(out, task.recording[i].image[0], given, **found, title=f"{task.scene.name} {task.name(i)}")
    return out.getvalue()


def _check_options(settings: Mapping[str, Any]) -> dict[str, float]:
    """The limits; options that would only fail later."""
    for name, low in (("every", 1), ("most", 1), ("pictures", 0)):
        value = settings[name]
        whole = isinstance(value, int) and not isinstance(value, bool) and value >= low
        if not whole and not (name == "most" and value is None):
            raise ValueError(f"{name}: found {value!r}, expected a whole number of at least {low}")
    for name, known in (("dtype", ("float32", "float64")), ("kind", align.ALIGNMENT_KINDS)):
        if settings[name] not in known:
            raise ValueError(f"{name}: found {settings[name]!r}, expected one of {', '.join(known)}")
    limits = parse_limits(settings["fail_on"], _ALIGNMENT_LIMITS)
    if settings["kind"] != "metric" and (wrong := {"scale", "change"} & set(limits)):
        raise ValueError(
            f"fail_on: found {', '.join(sorted(wrong))} with kind={settings['kind']}, expected kind=metric"
        )
    return limits
