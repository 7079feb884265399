"""``dhtorch complete``: every frame of a recording with depth and sigma from the sensor or from other views.

A frame is a file in each of ``depth/``, ``sigma/``, ``source/`` and, written last, ``meta/``: a frame with a meta file
is complete. ``complete.json`` holds what all frames of a folder share, and the folder is a recording again, in the
capture's own format where that can hold the maps. A second run of the command makes only the missing frames.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from dhtorch import export
from dhtorch.cli import completed_folder as completed
from dhtorch.cli import recover_page
from dhtorch.cli.completed_folder import FRAME_LAYOUTS, STRAY_CONFIDENCE, CompletionTask, Row, select_layout
from dhtorch.cli.option_checks import validate_choices
from dhtorch.codes import Gate, Source, is_estimated, names, words
from dhtorch.data.pairs import by_choice
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.pipeline import dense
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import with_sensor
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.view_report import report_selection, with_view_selection
from dhtorch.pytree import stack
from dhtorch.records import DepthMap, Frame
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import is_whole, open_output_folder
from dhtorch.viz.plots import append_cutoff, draw_completed, format_frame

#: Options that determine the content of a frame's files, beside the resolved format and unit; they enter the key.
_KEY_OPTIONS = ("data", "method", "seed", "dtype", "cutoff", "steps", "past", *dense.DENSE_OPTIONS, "arrays")
#: Further ones, which enter it only where they are set.
_SET_KEY_OPTIONS = ("budget", "sensor")

#: Pixels per inch of the figures of ``previews/``, about 1000 px wide. Source: chosen for an eighth of a figure's size.
_PREVIEW_DPI = 100.0

#: Sources whose number of pixels is in every meta file; that of others is left out where it is 0.
_COUNTED_SOURCES = ("none", "sensor", "swept")

#: Modules that determine the result, beside those that the settings name.
_CODE_ROOTS = (
    "dhtorch.pipeline.completion",
    "dhtorch.pipeline.view_report",
    "dhtorch.data.pairs",
    "dhtorch.export.frames",
)


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """``dhtorch complete``: write the missing frames of ``out``; several scenes get one folder each.

    Args:
        settings: the options of ``conf/complete.yaml``, resolved, with ``choices``.
        parts: ``data`` and ``method``, as objects.
        progress: wraps a loop: (items, text, number of items) → items.

    Returns:
        Exit code 0.

    Raises:
        ValueError, OSError, ImportError: bad options or data, or an output folder with other files.
        KeyboardInterrupt: Ctrl-C; complete frames are kept.
    """
    validate_choices(settings, {"format": ("auto", *FRAME_LAYOUTS)})
    if settings["unit"] is not None and not 1e-6 < settings["unit"] <= 0.1:
        raise ValueError(f"unit: found {settings['unit']!r}, expected a number above 1e-06, at most 0.1")
    scenes = scenes_of(parts["data"])
    out = Path(str(settings["out"])).expanduser()
    with open_output_folder(out, "out") if len(scenes) > 1 else contextlib.nullcontext():
        summaries = _complete_scenes(scenes, out, settings, parts["method"], progress)
    print("\n".join([*summaries.values(), "wrote", *(f"  {folder}" for folder in summaries)]))
    return 0


def _complete_scenes(
    scenes: Sequence[Scene], out: Path, settings: Mapping[str, Any], method: Method, progress: Progress
) -> dict[Path, str]:
    """Complete the scenes one by one -> output folder and summary of each."""
    summaries: dict[Path, str] = {}
    digests: dict[Path | None, str] = {}
    for scene in scenes:
        folder = out if len(scenes) == 1 else out / scene.name
        if folder in summaries:
            raise ValueError(f"data: found two scenes named {scene.name}, expected one (data.camera=KEY, or one root)")
        if scene.root not in digests:
            digests[scene.root] = completed.digest_scene_files(scene, settings, out)
        task = make_completion_task(scene, folder, method, settings, digests[scene.root])
        with completed.open_task_folder(task):
            n_untouched = sum(task.name(i) in task.done for i in task.frames)
            # The folder is a readable recording afterwards, unless the process is killed
            todo = [i for i in task.frames if task.missing(i)]
            with close_on_exit(task):
                for i in progress(todo, f"{scene.name}: frames", len(todo)):
                    complete_frame(task, i)
        # Printed summary of one scene
        rows = [task.done[task.name(i)] for i in task.frames]
        stats = recover_page.measure_recovery(task, task.frames)
        reasons = dict(stats.reasons)
        unfit = reasons.pop("unfit")
        why = ", ".join(f"{words(name.upper())} {share:.1%}" for name, share in reasons.items())
        counts = {kind: f"{words(kind)} {fraction:.1%}" for kind, fraction in stats.fractions.items()}
        counts["recovered"] += f" (median sigma {stats.error:.1%} of the depth)" if stats.error is not None else ""
        layout, (h, w) = task.layout, rows[0]["hw"]
        untouched = f" ({n_untouched} left untouched)" if n_untouched else ""
        shown = f"{', '.join(counts.values())}{f' ({why})' if why else ''}"
        lines = [
            f"{scene.name}: {format_count(len(rows), 'frame')}{untouched} of {w}x{h}: {shown}",
            f"  depth in steps of {1e3 * layout.unit:g} mm, up to {layout.reach:.1f} m"
            + (f": {unfit:.2%} of the pixels are beyond it and left empty (see unit=, arrays=true)" if unfit else ""),
        ]
        if layout.name == "png" != task.settings["format"]:
            lines.append("  maps only, not a recording: some frames have no pose")
        if layout.pictures and any((r["K"], r["distortion"]) != (rows[0]["K"], rows[0]["distortion"]) for r in rows):
            lines.append("  the intrinsics change: K.txt has those of the first frame, meta/ those of every frame")
        summaries[folder] = "\n".join(lines)
    return summaries


def make_completion_task(
    scene: Scene, folder: Path, method: Method, settings: Mapping[str, Any], digest: str, *, sized_as: int = 0
) -> CompletionTask:
    """The completion task of a scene; the image size is that of frame ``sized_as``."""
    frames = range(0, len(scene.recording), settings["every"])[: settings["max_frames"]]
    hw = scene.recording[sized_as].hw
    if 0 in hw:
        raise ValueError(f"{scene.name}: found frames without images, expected images (data.images=true)")
    is_same_size = dense.map_hw(hw, settings["size"]) == hw
    layout_options = {"unit": settings["unit"], "arrays": settings["arrays"], "same": is_same_size}
    layout_options["budget"] = bool(settings.get("budget"))
    layout = select_layout(scene.recording, settings["format"], **layout_options)
    pairs = [] if len(scene.recording) < 2 else by_choice(scene, settings["steps"], stride=1, past=settings["past"])
    return CompletionTask(
        scene=scene,
        folder=folder,
        layout=layout,
        method=with_sensor(method, settings.get("sensor")),
        settings=settings,
        frames=frames,
        offers={pair.reference: pair.candidates for pair in pairs},
        shared=completed.build_shared_metadata(
            scene,
            layout,
            settings,
            digest,
            keyed=(*_KEY_OPTIONS, *(name for name in _SET_KEY_OPTIONS if settings.get(name))),
            roots=_CODE_ROOTS,
            calibration="fused",
        ),
    )


# ------------------------------------------------------------------------------------------------------------- frames


def complete_frame(task: CompletionTask, i: int) -> None:
    """Write the missing files of frame ``i``; figures and points are made from its written maps."""
    if task.name(i) not in task.done:
        write_frame(task, i, *_compute_map(task, i))
    missing = [path for path in task.extras(i) if not is_whole(path)]
    if not missing:
        return
    maps, source = completed.read_completed_maps(task, i)
    frame = task.recording[i]
    picture = resize_picture(frame, source.shape)
    for path in missing:
        if path.suffix in (".png", ".jpg"):  # a figure, or its preview from the small image
            image: Any = frame.image[0]
            options: dict[str, Any] = {}
            if path.suffix == ".jpg":
                image, options = np.atleast_3d(picture).transpose(2, 0, 1), {"dpi": _PREVIEW_DPI, "kind": "jpg"}
            title = format_frame(task.scene.name, task.done[task.name(i)]["frame"])
            options["title"] = append_cutoff(title, task.settings["cutoff"])
            out = io.BytesIO()
            draw_completed(out, image, maps["depth"], maps["sigma"], source, **options)
            storage.replace_file(path, out.getvalue())
        else:
            # In camera axes: points as PLY, or a mesh (edges across depth steps left out) as GLB
            depth, hw = maps["depth"], (source.shape[0], source.shape[1])
            z = torch.from_numpy(np.where(depth > 0, depth, np.nan)).reshape(1, -1)
            xyz = cameras.unproject(frame.camera, dense.map_pixel_centres(frame, hw)[None], z)[0]
            rgb = np.broadcast_to(picture if picture.ndim == 3 else picture[..., None], (*hw, 3)).reshape(-1, 3)
            if path.suffix == ".ply":
                export.write_ply(path, xyz, rgb, sigma=maps["sigma"].reshape(-1), source=source.reshape(-1))
            else:
                export.write_glb(path, [export.Shape("view", xyz, rgb, face=export.mesh_depth_map(depth))])


@contextlib.contextmanager
def close_on_exit(task: CompletionTask) -> Iterator[None]:
    """Context in which frames are written: on exit, also by an exception, the folder is closed as a recording.

    Raises:
        KeyboardInterrupt: Ctrl-C; the message gives the number of complete frames.
    """
    try:
        try:
            yield
        finally:
            # Register the complete frames and write the files that make the folder a recording
            task.done.update(completed.read_complete_frames(task))
            complete = [i for i in range(len(task.recording)) if task.name(i) in task.done]
            if complete:
                task.layout.close(task.folder, task.recording, complete, [task.done[task.name(i)] for i in complete])
    except KeyboardInterrupt:
        n = sum(task.name(i) in task.done for i in task.frames)
        stay = f"{n} of {format_count(len(task.frames), 'frame')} in {task.folder} are complete and kept"
        raise KeyboardInterrupt(f"{stay}; run the same command again for the rest") from None


def _compute_map(task: CompletionTask, i: int) -> tuple[Frame, DepthMap, Row]:
    """Complete frame ``i`` -> the reference frame, its depth map (CPU), and a row with the selected views."""
    settings, offered = task.settings, task.offers.get(i, ())
    reference = task.load(i)
    if not offered:
        completed_map = dense.sensor_depth_map(reference, method=task.method, size=settings["size"])
        return reference, completed_map.to("cpu"), {"views": [], "n_offered": 0}
    source_views = stack([task.load(k) for k in offered])
    options: dict[str, Any] = {k: settings[k] for k in (*dense.DENSE_OPTIONS, "seed")}
    options |= {
        "method": with_view_selection(task.method),
        "calibration": default_calibration(),
        "hint": task.scene.hint,
    }
    trace: Trace = {}
    with torch.no_grad():
        completed_map = complete_depth(reference, source_views, **options, trace=trace)
    choice = report_selection(i, offered, trace)
    views = [int(task.recording.number[k]) for k in choice.views]
    row: Row = {"views": views, **choice.row()["why"]}
    if task.recording.poses is None:
        fits = [each["fit"] for each in trace.get("views", ())] or [trace["fit"]]
        solved = [(number, fit) for number, fit in zip(views, fits, strict=False) if bool(fit.ok[0])]
        row["motions"] = {str(number): se3.to_matrix(fit.T_1_from_0.to("cpu"))[0] for number, fit in solved}
    return reference, completed_map.to("cpu"), row


def write_frame(task: CompletionTask, i: int, reference: Frame, depth_maps: DepthMap, views_row: Row) -> None:
    """Write the files of one frame; the meta file, which marks it complete, comes last."""
    name, layout, depth_map = task.name(i), task.layout, depth_maps[0]
    steps = export.quantise_depth(depth_map.depth, depth_map.sigma, depth_map.source, layout.unit)
    pictures = {"depth": steps.depth, "sigma": steps.sigma, "source": steps.source}
    if layout.pictures:
        pictures[layout.pictures] = resize_picture(reference, steps.depth.shape)
    if layout.confidence:
        table = np.zeros(max(STRAY_CONFIDENCE) + 1, np.uint8)
        table[list(STRAY_CONFIDENCE)] = list(STRAY_CONFIDENCE.values())
        pictures["confidence"] = table[steps.source]
    shares: Row = {}
    if layout.budget:
        # The largest cause of every pixel's sigma; of estimated pixels the mean fraction of each cause in sigma²
        pictures["budget"] = depth_map.budget.dominating.to(torch.uint8).numpy()
        shares["sigma_shares"] = depth_map.budget.shares(depth_map.keep & is_estimated(depth_map.source))
    if not (shared_file := task.folder / "complete.json").is_file():
        storage.write_json(shared_file, task.shared)
    for kind, pixels in pictures.items():
        storage.replace_file(layout.file(task.folder, kind, name), export.encode_png(pixels))
    if layout.arrays:
        out = io.BytesIO()  # unquantised
        codes = {k: getattr(depth_map, k).to(torch.uint8).numpy() for k in ("source", "gate")}
        np.savez_compressed(out, **{k: getattr(depth_map, k).numpy() for k in ("depth", "sigma", "score")}, **codes)
        storage.replace_file(layout.file(task.folder, "arrays", name), out.getvalue())
    # Pixel counts by source, and fractions of all pixels without an answer, by reason
    counts = {name.lower(): int((steps.source == code).sum()) for code, name in names(Source).items()}
    gates = {name.lower(): float((depth_map.gate == code).double().mean()) for code, name in names(Gate).items()}
    no_answer = {name: share for name, share in gates.items() if share and name != "answer"}
    # Metadata of one frame: units, camera, pose, time, size
    camera = cameras.resize(reference.camera, reference.hw, steps.depth.shape).to("cpu")
    poses = task.recording.poses
    shared_keys = ("key", "version", "method", "calibration", "unit_m", "sigma_unit_m")
    row = storage.to_strict_json(
        {
            **{k: task.shared[k] for k in shared_keys},
            "cutoff_m": task.settings["cutoff"],
            "frame": int(task.recording.number[i]),
            "time": None if reference.time is None else float(reference.time[0]),
            "hw": list(steps.depth.shape),
            "K": cameras.to_matrix(camera)[0],
            "distortion": None if camera.distortion is None else camera.distortion[0],
            "T_world_from_cam": None if poses is None else se3.to_matrix(poses[i : i + 1])[0],
        }
        | views_row
        | {"pixels": {name: n for name, n in counts.items() if n or name in _COUNTED_SOURCES}}
        | {"no_answer": {**no_answer, "unfit": float(steps.unfit.mean())}}
        | shares
    )
    storage.write_json(layout.file(task.folder, "meta", name), row)
    task.done[name] = row


def resize_picture(frame: Frame, hw: tuple[int, ...]) -> np.ndarray:
    """Frame image -> (h, w, 3) or (h, w) uint8 at the map's size, by area averaging."""
    image = frame.image[0].cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    if image.shape[-2:] != hw:
        image = F.interpolate(image[None].float(), hw, mode="area")[0].round().to(torch.uint8)
    return image[0].numpy() if len(image) == 1 else image.permute(1, 2, 0).numpy()
