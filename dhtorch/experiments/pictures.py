"""Figures and point cloud of one pair."""

from pathlib import Path
from typing import Any

import torch

from dhtorch.codes import Source
from dhtorch.export import write_ply
from dhtorch.geometry.camera import unproject
from dhtorch.metrics import errors
from dhtorch.metrics.risk import risk_coverage
from dhtorch.pipeline.completion import complete_depth, default_calibration
from dhtorch.pipeline.pair import merge
from dhtorch.viz.plots import (
    append_cutoff,
    draw_completed,
    draw_depth,
    draw_holes,
    draw_risk_coverage,
    draw_samples,
)
from dhtorch.viz.plots.colours import colour_by_source


def draw_example(folder: str | Path, example: Any) -> list[Path]:
    """Write the figures and the point cloud of one pair → files written.

    Args:
        folder: folder of the files, made if missing.
        example: a :class:`dhtorch.experiments.outcome.Example`.
    """
    e = example.cpu()
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    title = append_cutoff(f"{e.scene} {e.pair}", e.cutoff)
    whole, image, uv = merge(e.samples, e.estimate), e.frame.image[0], e.samples.uv[0]
    draw_samples(folder / "samples.png", image, uv, whole.source[0], e.estimate.gate[0], title=title)
    draw_holes(folder / "holes.png", image, uv, e.samples.hole[0], title=title)
    written = ["samples.png", "holes.png", "points.ply"]
    if example.call_options is not None:  # where the method ran without further options
        with torch.no_grad():
            maps = complete_depth(example.frame, calibration=default_calibration(), **example.call_options).to("cpu")[0]
        draw_completed(folder / "completed.png", image, maps.depth, maps.sigma, maps.source, title=title)
        written.append("completed.png")
    pooled = errors.points_from_estimate(e.estimate, e.truth)
    if pooled.keep.any():
        draw_depth(folder / "depth.png", pooled.true_depth, pooled.depth, pooled.score, title=title)
        curves = {e.method: risk_coverage(pooled)}
        draw_risk_coverage(folder / "risk_coverage.png", curves, oracle=risk_coverage(pooled, oracle=True), title=title)
        written += ["depth.png", "risk_coverage.png"]
    answered = whole.source[0] != Source.NONE
    xyz = unproject(e.frame.camera, whole.uv, whole.depth)[0][answered]
    columns = {name: getattr(whole, name)[0][answered] for name in ("sigma", "score")}
    columns |= {"hole": e.samples.hole[0][answered], "source": whole.source[0][answered]}
    write_ply(folder / "points.ply", xyz, colour_by_source(columns["source"]), **columns)
    return [folder / name for name in written]
