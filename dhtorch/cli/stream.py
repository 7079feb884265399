"""``dhtorch stream``: a recording processed frame by frame -> speed and recovered fraction of every frame."""

import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from dhtorch.data.scene import Scene, scenes_of
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.spec import Trace
from dhtorch.pipeline.stream import Stream
from dhtorch.runtime import storage
from dhtorch.runtime.console import Progress, format_count
from dhtorch.runtime.output_folder import open_output_folder

Row = dict[str, Any]


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Stream every scene of the settings, write ``stream.json`` and print a summary; returns the exit code.

    Raises:
        ValueError, OSError: bad options or data.
    """
    path = Path(settings["output"]) / "stream.json"
    with open_output_folder(path.parent, "output") as folder:
        folder.check([path])
        sources = scenes_of(parts["data"])
        scenes = [stream_scene(scene, parts["method"], settings, progress=progress) for scene in sources]
        storage.write_json(path, {"scenes": scenes})
    print("\n".join(_format_summary(scene) for scene in scenes))
    print(f"wrote\n  {path}")
    return 0


def stream_scene(scene: Scene, method: Method, settings: Mapping[str, Any], *, progress: Progress) -> Row:
    """Stream one scene -> a row for every frame, and their totals.

    Raises:
        ValueError: from the method or the stream.
    """
    recording, hint = scene.recording, scene.hint
    stream = Stream(method, steps=settings["steps"], seed=settings["seed"], hint=hint)
    n = len(recording)
    rows: list[Row] = []
    ratios = [torch.zeros(0)]
    for k in progress(range(n), f"{scene.name}: frames", n):
        frame = recording[k].to(getattr(torch, settings["dtype"])).to(settings["device"])
        frame = range_split(frame, settings["cutoff"])
        cuts = len(stream.cuts)
        trace: Trace = {}
        start = time.perf_counter()
        estimate = stream.push(frame, trace=trace)
        row: Row = {"frame": int(recording.number[k]), "ms": 1e3 * (time.perf_counter() - start)}
        row["cut"] = len(stream.cuts) > cuts
        row["back"] = sorted(trace["back"][:, 0].tolist()) if "back" in trace else []
        hole = ~(trace["samples"] if "samples" in trace else method.sample_depth_at(frame, estimate.uv[0])).usable
        recovered = estimate.keep & hole
        row |= {"n_holes": int(hole.sum()), "n_recovered": int(recovered.sum())}
        ratios.append((estimate.sigma / estimate.depth)[recovered].float().cpu())
        rows.append(row)
    ratio = torch.cat(ratios)
    seconds = sum(row["ms"] for row in rows) / 1e3
    holes = sum(row["n_holes"] for row in rows)
    return {
        "scene": scene.name,
        "n_frames": n,
        "frames_per_second": n / seconds,
        "ms_median": statistics.median(row["ms"] for row in rows),
        "recovered": sum(row["n_recovered"] for row in rows) / holes if holes else None,
        "recovered_sigma_rel": float(ratio.median()) if len(ratio) else None,
        "cuts": stream.cuts,
        "mib": stream.nbytes / 2**20,
        "frames": rows,
    }


def _format_summary(scene: Row) -> str:
    share = (
        "every sample has a return"
        if scene["recovered"] is None
        else f"{scene['recovered']:.1%} of the samples without a return recovered from other views"
    )
    if scene["recovered_sigma_rel"] is not None:
        share += f" (median sigma {scene['recovered_sigma_rel']:.1%} of the depth)"
    cuts = f"; cuts at {', '.join(map(str, scene['cuts']))}" if scene["cuts"] else ""
    speed = f"{scene['frames_per_second']:.2f} frames/s"
    frames = format_count(scene["n_frames"], "frame")
    return f"{scene['scene']}: {frames}, {speed}, {share}, {scene['mib']:.0f} MiB of memory{cuts}"
