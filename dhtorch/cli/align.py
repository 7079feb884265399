"""``dhtorch align``: depth maps of any network or sensor -> metric depth and sigma, aligned to a recording's returns.

Frames are written as by ``dhtorch complete``: each frame completely or not at all, and the folder is a recording again
where the format allows. ``align.json`` holds the alignment of every map, ``align.html`` shows the maps, worst first.
The exit code is 1 where a limit of ``fail_on`` is exceeded.
"""

import io
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch.alignment import align
from dhtorch.alignment.map_family import MAP_FAMILIES
from dhtorch.cli import complete
from dhtorch.cli.complete import CompletionTask, Row, select_layout
from dhtorch.cli.option_checks import validate_choices
from dhtorch.cli.validate import list_exceeded_limits, parse_limits
from dhtorch.data import depth_maps
from dhtorch.data.depth_maps import DepthMaps
from dhtorch.data.pairs import candidate_frames
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.pair import upcast_intrinsics
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import DepthMap, Frame
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.viz.plots import draw_aligned
from dhtorch.viz.viewer import validation as pages

#: Names that ``fail_on`` accepts → the quantity compared with the limit, over a whole recording.
_ALIGNMENT_LIMITS = {
    "scale": "|median scale - 1| of the frames, of kind=metric",
    "change": "median relative change of depth, of kind=metric",
    "sigma": "median sigma / depth of the frames",
    "no_answer": "fraction of the maps' pixels without an answer",
    "unaligned": "fraction of the maps that could not be aligned",
}

#: Columns of the page's table.
_TABLE_COLUMNS = ("model", "scale", "sigma / depth", "no answer", "near references", "far references")

#: Options that determine the content of a frame's files; they enter the key.
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

#: Modules that determine the result, beside those that the settings name.
_CODE_ROOTS = (
    "dhtorch.alignment.align",
    "dhtorch.pipeline.view_report",
    "dhtorch.data.depth_maps",
    "dhtorch.export.frames",
)

#: Median sigma / depth below which maps and near returns are taken to come from one sensor: two sensors never agree so
#: well.
_SAME_SENSOR_SIGMA_REL = 5e-4

#: Family of a map that is no depth → the remark on it.
_FAMILY_REMARKS = {
    "disparity": "that its values are inverse depth: kind=inverse",
    "z-buffer": "a z-buffer (non-linear depth): depth = near / (1 - value * (1 - near / far))",
}

_PAGE_NOTE = "Depth is coloured from near (blue) to far (red), each map over its own range. Blank: no answer."


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Align the maps of a recording; returns the exit code, 1 where a limit is exceeded.

    Raises:
        ValueError, OSError: bad options or data, or an output folder with other files.
        KeyboardInterrupt: Ctrl-C; complete frames are kept.
    """
    validate_choices(settings, {"kind": align.ALIGNMENT_KINDS})
    limits = parse_limits(settings["fail_on"], _ALIGNMENT_LIMITS)
    if settings["kind"] != "metric" and (wrong := {"scale", "change"} & set(limits)):
        raise ValueError(
            f"fail_on: found {', '.join(sorted(wrong))} with kind={settings['kind']}, expected kind=metric"
        )
    scenes = scenes_of(parts["data"])
    if len(scenes) > 1:
        raise ValueError(f"depth: found {len(scenes)} recordings for one folder of maps, expected one (data.root=…)")
    scene, out = scenes[0], Path(str(settings["out"])).expanduser()
    maps = depth_maps.open_depth_maps(settings["depth"], scene.recording, settings["depth_unit"])
    task = _make_alignment_task(scene, maps, parts["method"], settings, out)
    with complete.open_task_folder(task, ("align.json", "align.html")):
        # Align the missing maps of a task, write and print the summary; returns the exit code
        scene, out = task.scene, task.folder
        n_untouched = sum(task.name(i) in task.done for i in task.frames)
        todo = [i for i in task.frames if task.name(i) not in task.done]
        with complete.close_on_exit(task):
            for i in progress(todo, f"{scene.name}: frames", len(todo)):
                complete.write_frame(task, i, *_align_frame(task, maps, i))
        rows = [task.done[task.name(i)] for i in task.frames]
        summary = _summarise_recording(rows)
        exceeded = list_exceeded_limits(summary, limits, _ALIGNMENT_LIMITS)
        content = {"scene": scene.name, "kind": settings["kind"], "fail_on": settings["fail_on"], "exceeded": exceeded}
        keep = ("frame", "aligned", "views")
        content |= {"maps": maps.report, "whole": summary, "frames": [{k: row[k] for k in keep} for row in rows]}
        storage.write_json(out / "align.json", storage.to_strict_json(content))
        lines = [
            *_format_summary(scene.name, settings["kind"], summary, n_untouched),
            *(f"  {note}" for note in [*(maps.doubts if settings["kind"] == "metric" else []), *maps.notes]),
        ]
        _write_page(task, maps, lines, exceeded)
        print("\n".join([*lines, *(f"  exceeded: {limit_line}" for limit_line in exceeded), "wrote", f"  {out}"]))
        return int(bool(exceeded))


# -------------------------------------------------------------------------------------------------------------- frames


def _make_alignment_task(
    scene: Scene, maps: DepthMaps, method: Method, settings: Mapping[str, Any], out: Path
) -> CompletionTask:
    """The completion task of a recording: every frame that has a map."""
    recording = scene.recording
    frames = maps.frames[:: settings["every"]][: settings["max_frames"]]
    hw = recording[frames[0]].hw
    if 0 in hw:
        raise ValueError(f"{scene.name}: found frames without images, expected images (data.images=true)")
    first = maps[frames[0]]
    assert first is not None
    layout = select_layout(recording, settings["format"], settings["unit"], same=first.shape[-2:] == hw)
    more: dict[str, Path | str] = {f"depth/{file.name}": file for i in frames if (file := maps.files[i]) is not None}
    digest = complete.digest_scene_files(scene, settings, out, more | {"depth unit": f"{maps.unit.metres} m"})
    options = {**settings, **dict.fromkeys(complete.EXTRA_FILES, False)}
    return CompletionTask(
        scene=scene,
        folder=out,
        layout=layout,
        method=method,
        settings=options,
        frames=frames,
        offers={},
        shared=complete.build_shared_metadata(
            scene, layout, settings, digest, keyed=_KEY_OPTIONS, roots=_CODE_ROOTS, calibration=None, word="align"
        ),
    )


def _align_frame(task: CompletionTask, maps: DepthMaps, i: int) -> tuple[Frame, DepthMap, Row]:
    """Align the map of frame ``i`` -> the frame, its depth map (CPU), and a row with the views and the alignment."""
    settings, depth_map = task.settings, maps[i]
    assert depth_map is not None  # only frames with a map are in the task
    frame = task.load(i)
    x = torch.where(depth_map > 0, depth_map, torch.nan).to(frame.camera.f)  # 0 in a file is no value, for every kind
    trace: Trace = {}
    views: list[int] = []
    with torch.no_grad():
        if len(task.recording) > 1:
            offered = candidate_frames(task.recording, i, settings["steps"], settings["past"])
            source_views = stack([task.load(k) for k in offered])
            method = with_view_selection(task.method)
            estimate = method(frame, source_views, seed=settings["seed"], hint=task.scene.hint, trace=trace)
            references, views = [trace["samples"], estimate], [int(task.recording.number[k]) for k in offered]
        else:
            upcast = upcast_intrinsics(frame)
            uv = task.method.sample(frame.hw, task.method.n).to(frame.camera.f)[None]
            references = [task.method.backproject(upcast, uv)]
        selection: dict[str, align.ModelSelection] = {}
        options = {
            "kind": settings["kind"],
            "max_sigma_rel": settings["max_sigma_rel"],
            "hw": frame.hw,
            "trace": selection,
        }
        aligned = align.align_depth(x, references, **options).to("cpu")
    points = [int((a.usable if k == 0 else a.keep).sum()) for k, a in enumerate(references)]
    row = _summarise_frame(x.cpu(), aligned, selection["chosen"]) | {"near": points[0], "far": sum(points[1:])}
    return frame, aligned, {"views": views, "aligned": row}


def _summarise_frame(x: Tensor, aligned: DepthMap, selection: align.ModelSelection) -> Row:
    """Statistics of one alignment: model and its probability, scale, relative change, sigma / depth, gaps."""
    keep, has_value = aligned.keep, x > 0
    best = int(selection.model)
    row: Row = {
        "model": None if best < 0 else selection.names[best],
        "no_answer": 1 - (int((keep & has_value).sum()) / max(int(has_value.sum()), 1)),
    }
    row["family"] = None if selection.family is None else MAP_FAMILIES[int(selection.family)]
    row["probability"] = None if best < 0 else float(selection.weight[0, best])
    likeliest = int(selection.weight[0].argmax())
    row["likeliest"] = None if best < 0 else selection.names[likeliest]
    row["likeliest_probability"] = None if best < 0 else float(selection.weight[0, likeliest])
    if not bool(keep.any()):
        return row | {"scale": None, "change": None, "sigma": None}
    ratio = (aligned.depth / x)[keep].double()
    sigma = (aligned.sigma / aligned.depth)[keep].double().median()
    return row | {"scale": float(ratio.median()), "change": float((ratio - 1).abs().median()), "sigma": float(sigma)}


# ------------------------------------------------------------------------------------------------------------- summary


def _summarise_recording(rows: Sequence[Row]) -> Row:
    """Statistics of a recording; ``limited`` are those that ``fail_on`` limits."""
    alignments = [row["aligned"] for row in rows]
    answered = [row for row in alignments if row["model"] is not None and row["scale"] is not None]
    medians = {
        k: statistics.median(row[k] for row in answered) if answered else None for k in ("scale", "change", "sigma")
    }
    limited = {
        "scale": None if medians["scale"] is None else abs(medians["scale"] - 1),
        "change": medians["change"],
        "sigma": medians["sigma"],
        "no_answer": statistics.fmean(row["no_answer"] for row in alignments),
        "unaligned": 1 - len(answered) / len(alignments),
    }
    models = Counter(row["model"] for row in answered)
    references = {k: statistics.median(row[k] for row in alignments) for k in ("near", "far")}
    families = Counter(family for row in alignments if (family := row.get("family")) in _FAMILY_REMARKS)
    return {
        "frames": len(alignments),
        "models": dict(models),
        "families": dict(families),
        "median": medians,
        "references": references,
        "limited": limited,
    }


def _format_summary(name: str, kind: str, summary: Row, n_untouched: int) -> list[str]:
    """Printed summary of a recording, one sentence a line."""
    limited, medians, n = summary["limited"], summary["median"], summary["frames"]
    untouched = f" ({n_untouched} left untouched)" if n_untouched else ""
    contradicted = [
        f"  {format_count(count, 'map')}: near returns show {_FAMILY_REMARKS[family]}"
        for family, count in sorted(summary["families"].items())
    ]
    if medians["scale"] is None:
        why = ":" if contradicted else ": too few near returns."
        return [f"{name}: none of {format_count(n, 'map')} could be aligned{untouched}{why}", *contradicted]
    n_unchanged = sum(count for model, count in summary["models"].items() if model == "raw")
    maps = format_count(n, "map")
    first = f"{name}: {maps}{untouched} converted to metres."
    if kind == "metric":
        factor = f"multiplied by {medians['scale']:.4g} (median of all)"
        unchanged = f"{n_unchanged} unchanged"
        first = f"{name}: {maps}{untouched}, {unchanged}{'' if n_unchanged == n else f'; the others {factor}'}."
        first = first if n_unchanged else f"{name}: {maps}{untouched}, none unchanged: {factor}."
    near, far = (f"{summary['references'][k]:g}" for k in ("near", "far"))
    is_same_sensor = medians["sigma"] < _SAME_SENSOR_SIGMA_REL
    return [
        first,
        *(
            ["  Maps and near returns agree as if from one sensor: sigma does not include that sensor's own error."]
            * is_same_sensor
        ),
        f"  Median sigma {medians['sigma']:.1%} of the depth; {limited['no_answer']:.1%} of the pixels have no answer.",
        f"  References per map: {near} near returns and {far} far answers (medians); "
        f"{limited['unaligned']:.0%} of the maps could not be aligned.",
        *contradicted,
    ]


def _write_page(task: CompletionTask, maps: DepthMaps, lines: Sequence[str], exceeded: Sequence[str]) -> Path:
    order = sorted(task.frames, key=lambda i: -_severity(task.done[task.name(i)]["aligned"]))
    shown = set(order[: task.settings["pictures"]])
    frames = []
    for i in order:
        row = task.done[task.name(i)]
        values = [row["aligned"][k] for k in ("model", "scale", "sigma", "no_answer", "near", "far")]
        cells = ["–" if x is None else f"{x:.3f}" if isinstance(x, float) else str(x) for x in values]
        image = None
        if i in shown:  # the figure of a frame, from its written files
            out, aligned = io.BytesIO(), complete.read_completed_maps(task, i)[0]
            title = f"{task.scene.name} {task.name(i)}"
            draw_aligned(out, task.recording[i].image[0], maps[i], **aligned, title=title)
            image = out.getvalue()
        frames.append(pages.ValidatedFrame(f"frame {row['frame']}", cells, image))
    return pages.write_validation_page(
        task.folder / "align.html",
        task.scene.name,
        sentences=lines,
        columns=_TABLE_COLUMNS,
        frames=frames,
        failed=[f"Exceeded: {limit_line}" for limit_line in exceeded],
        word="align",
        note=_PAGE_NOTE,
    )


def _severity(row: Row) -> float:
    """Sort key of the frames: unanswered fraction plus sigma / depth."""
    return float(row["no_answer"]) + (1.0 if row["sigma"] is None else float(row["sigma"]))
