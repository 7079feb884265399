"""``dhtorch view``: a result or recording -> 3D viewer (Rerun), .rrd file or HTML page."""

import contextlib
import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dhtorch.cli.job import DATA_ROOT_FILE
from dhtorch.data import FormatError
from dhtorch.data.scene import scenes_of
from dhtorch.experiments.exhibits import make_exhibit
from dhtorch.experiments.protocol import Progress, Settings
from dhtorch.integrate.sweeps import DenseSweep
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import format_count, has_screen
from dhtorch.runtime.output_folder import is_whole, open_output_file
from dhtorch.runtime.storage import read_utf8
from dhtorch.viz.viewer import again, html, points, rrd
from dhtorch.viz.viewer.exhibit import Exhibit

#: Printed where the page is written for want of Rerun.
_NO_RERUN = "Rerun is not installed (pip install 'dhtorch[view]'): wrote a page instead"


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Show the result or recording of the settings; returns the exit code.

    With ``result`` (a result file, its folder or a PLY file) the job is computed again with its own data, method,
    pairs, hold-out and seed; where its data are missing, its ``points.ply`` is shown. Without ``result``, the recording
    and method of the settings are used. ``html`` and ``save`` name files; with neither, Rerun's viewer opens, or,
    without a screen, ``view.rrd`` is written (``view.html`` where Rerun is not installed).

    Raises:
        ValueError, OSError, ImportError: bad options or data.
    """
    page, recording = settings["html"], settings["save"]
    for name, endings in ((page, html.HTML_SUFFIXES), (recording, rrd.RRD_SUFFIXES)):
        if name is not None and (Path(name).is_dir() or Path(name).suffix.lower() not in endings):
            raise ValueError(f"{name}: expected a file name that ends in {endings[0]}")
    target = None if settings["result"] is None else Path(settings["result"])
    folder = Path(settings["output"]) if target is None else target if target.is_dir() else target.parent
    notes: list[str] = []
    if page is None and recording is None:
        if importlib.util.find_spec("rerun") is None:
            page, notes = str(folder / "view.html"), [_NO_RERUN]
        elif not has_screen():
            recording = str(folder / "view.rrd")
    with contextlib.ExitStack() as stack:
        for option, name in (("html", page), ("save", recording)):
            if name is not None:
                stack.enter_context(open_output_file(name, option))
        scene = _make_scene(target, settings, parts, progress)
        # Write the page or recording, or open the viewer -> printed lines
        lines = []
        if page is None and recording is None:
            rrd.spawn_viewer(scene)
            lines.append(f"{scene.name}: {format_count(len(scene.shots), 'pair')} in Rerun's viewer")
        if page is not None:
            path = html.write_viewer_page(Path(page), scene)
            lines.append(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB): open it in any browser")
        if recording is not None:
            path = rrd.write_rrd(Path(recording), scene)
            lines.append(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB): rerun {path}")
        for line in [*notes, *lines]:
            print(line)
    return 0


def _make_scene(
    target: Path | None, settings: Mapping[str, Any], parts: Mapping[str, Any], progress: Progress
) -> Exhibit:
    """The exhibit of a result, of a PLY file, or, without ``target``, of the recording and method of the settings."""
    if target is not None and target.suffix == ".ply":
        return points.read_ply_exhibit(target)
    if target is not None:
        # The exhibit of a result: computed again, or only its points
        result = result_files.read_result(target)
        folder = target if target.is_dir() else target.parent
        config, name = result["config"], settings["scene"]
        result_settings = {**settings, **{k: config[k] for k in ("seed", "dtype") if k in config}}
        try:
            # The data folder recorded beside a result, where it still exists
            note = folder / DATA_ROOT_FILE
            root = read_utf8(note).strip() if is_whole(note) else ""
            known = root if root and Path(root).exists() else None
            parts = again.rebuild_parts(result, settings["root"] or known)
            scene = _compute_exhibit(parts, result_settings, partial(again.read_cutoff, result), progress)
        except (OSError, FormatError) as error:
            scenes = result["data"]["scenes"]
            ply = folder / str(_select_item(scenes, name, str)) / "points.ply"
            if not ply.is_file():
                raise ValueError(f"{error}; set root=PATH to the folder of the data") from error
            print(
                f"{error}; showing only the points of {ply} (set root=PATH to the folder of the data)", file=sys.stderr
            )
            return replace(points.read_ply_exhibit(ply), name=str(_select_item(scenes, name, str)))
        facts = {"experiment": result["experiment"], "data": result["data"]["name"], "created": result["meta"]["utc"]}
        return replace(scene, facts={**facts, **scene.facts})
    return _compute_exhibit(parts, settings, lambda _name: settings["holdout"]["cutoff"], progress)


def _compute_exhibit(
    parts: Mapping[str, Any], settings: Mapping[str, Any], cutoff: Callable[[str], float | None], progress: Progress
) -> Exhibit:
    """Compute the exhibit of the selected scene; ``cutoff``: scene name -> cutoff, m."""
    scene = _select_item(scenes_of(parts["data"]), settings["scene"], lambda scene: scene.name)
    dtype = getattr(torch, settings["dtype"])
    common = Settings(cutoff=cutoff(scene.name), seed=settings["seed"], device=settings["device"], dtype=dtype)
    options: dict[str, Any] = {
        "most": settings["max_frames"],
        "sweep": DenseSweep.from_options(settings["dense"]),
        "progress": progress,
    }
    exhibit = make_exhibit(scene, parts["method"], parts["pairs"], common, **options)
    cutoff_m = common.cutoff_of(scene)
    hidden = cutoff_m is not None and cutoff_m != float("inf")
    facts = {"samples": f"{parts['method'].n} per pair"}
    facts["sensor"] = f"returns beyond {cutoff_m:g} m held out" if hidden else "all returns used"
    return replace(exhibit, facts={**facts, **exhibit.facts})


def _select_item(items: Sequence[Any], wanted: str | int | None, name: Any) -> Any:
    """The first item, or the item with the given name or number."""
    if wanted is None and len(items):
        return items[0]
    names = [name(item) for item in items]
    if str(wanted) in names:
        return items[names.index(str(wanted))]
    if isinstance(wanted, int) and 0 <= wanted < len(names):
        return items[wanted]
    raise ValueError(f"scene: found {wanted!r}, expected a number below {len(names)} or one of {', '.join(names[:12])}")
