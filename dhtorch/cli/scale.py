"""``dhtorch scale``: a reconstruction up to scale and an RGB-D capture of the same scene -> the model in metres.

Writes ``scale.json``, ``scale.html`` (scale of every frame, picture region and range) and, unless the model is
refused, the files of the model with all lengths in metres. A model whose parts, or whose camera path and depths, have
different scales is refused with exit code 1.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data.models import Similarity, read_model, write_model
from dhtorch.data.scene import scenes_of
from dhtorch.geometry.sensor_noise import get_sensor_noise
from dhtorch.measure.local_scales import REGIONS, ScaleTolerance
from dhtorch.measure.scale import ScaleResult, metric_scale
from dhtorch.metrics.grouped import mad_sigma
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.viz.plots import make_figure, save_figure, set_axis
from dhtorch.viz.plots.colours import FAINT, SERIES_COLOURS
from dhtorch.viz.viewer import validation as pages

_COLUMNS = ("frame of the capture", "matched by", "scale", "difference", "sigma")
#: Differences that a plot of scales shows at least: smaller ones are rounding. Source: derived, a tenth of 1 %.
_LEAST_REACH = 1e-3

_NOTE = "Bars are two standard deviations of the frame, the region or the range alone, without the sensor's own scale."


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Any) -> int:
    """Measure the scale of a model; returns the exit code, 1 where the model is refused.

    Raises:
        ValueError, OSError: bad options or data, or views that match no frame.
    """
    if settings["sensor"] is not None:
        get_sensor_noise(settings["sensor"])  # refuses an unknown class
    if settings["device"] != "cpu":
        raise ValueError(f"device: found {settings['device']!r}, expected cpu: the measurement is small")
    if settings["frame"] not in ("model", "capture"):
        raise ValueError(f"frame: found {settings['frame']!r}, expected model or capture")
    if not settings["tolerance"] > 0:
        raise ValueError(f"tolerance: found {settings['tolerance']!r}, expected a positive number")
    scenes = scenes_of(parts["data"])
    if len(scenes) > 1:
        raise ValueError(f"data: found {len(scenes)} recordings for one model, expected one (data.root=…)")
    root = Path(str(settings["model"])).expanduser()
    resolved = root.resolve()
    out = Path(str(settings["out"] or resolved.with_name(f"{resolved.stem}_metres"))).expanduser()
    if out.resolve() in (resolved, resolved.parent):
        raise ValueError(f"out: found the model's own folder {out}, expected another one")
    model = read_model(root, images=settings["images"])
    recording = scenes[0].recording
    options = {key: settings[key] for key in ("sensor", "cutoff", "max_frames")}
    result = metric_scale(model, recording, tolerance=ScaleTolerance(settings["tolerance"]), **options)
    if settings["frame"] == "capture" and result.R is None:
        raise ValueError("frame: found capture, expected model: the capture has no poses for the matched views")
    plain = Similarity(result.scale, np.eye(3), np.zeros(3))
    similarity = plain if settings["frame"] == "model" else result.similarity
    with open_output_folder(out, "out"):
        if result.ok:
            write_model(model, out, similarity)
        content = {"model": str(root), "format": model.format, "capture": recording.name, **_describe_scale(result)}
        storage.write_json(out / "scale.json", storage.to_strict_json(content))
        _write_page(out / "scale.html", _model_name(root), result)
    for line in _format_lines(root, result):
        print(line)
    print(f"wrote {out}: {'the model in metres, ' if result.ok else ''}scale.json, scale.html")
    return 0 if result.ok else 1


def _describe_scale(result: ScaleResult) -> dict[str, Any]:
    """Result -> what ``scale.json`` holds."""
    low, high = result.interval()
    path = result.path
    rows = zip(result.names, result.matches, result.frame_log, result.frame_sigma, strict=True)
    return {
        "refused": not result.ok,
        "scale": result.scale,
        "U": {"k": 2, "low": low, "high": high},
        "sigma": {"relative": result.sigma, **result.terms},
        "similarity": None if result.R is None else {"R": result.R, "t": result.t, "cov": result.cov},
        "path": path
        and {
            "by": path.source,
            "scale": path.scale,
            "sigma": path.sigma,
            "changes": [_describe_fault(change) for change in path.changes],
        },
        "faults": [_describe_fault(fault) for fault in result.faults],
        "gradients": [_describe_fault(gradient) for gradient in result.gradients],
        "ranges": [dict(zip(("from", "to", "difference", "n"), row, strict=True)) for row in result.by_range],
        "regions": [dict(zip(("row", "column", "difference", "sigma"), row, strict=True)) for row in _regions(result)],
        "frames": [
            {"view": name, "frame": m.frame, "same_picture": m.is_same, "scale": np.exp(log), "sigma": sigma}
            for name, m, log, sigma in rows
        ],
        "notes": result.notes,
    }


def _describe_fault(fault: Any) -> dict[str, Any]:
    return {"kind": fault.kind, "where": fault.where, "change": fault.change, "sigma": fault.sigma}


def _regions(result: ScaleResult) -> list[tuple[int, int, float, float]]:
    """(row, column, relative difference of scale, its sigma) of the picture regions."""
    rows = []
    for region in np.unique(result.local.region):
        log = result.local.log[result.local.region == region] - np.log(result.scale)
        sigma = mad_sigma(log) / np.sqrt(len(log))
        rows.append((*divmod(int(region), REGIONS[1]), float(np.expm1(np.median(log))), float(sigma)))
    return rows


def _model_name(root: Path) -> str:
    """Name of a model in sentences: its folder or file, with the folder above it where that is a number (COLMAP's)."""
    return f"{root.parent.name}/{root.name}" if root.name.isdigit() and root.parent.name else root.name


def _format_lines(root: Path, result: ScaleResult) -> list[str]:
    """Printed sentences."""
    half = 2 * result.sigma
    terms = ", ".join(f"{name} {value:.2%}" for name, value in result.terms.items())
    lines = [*(f"note: {note}" for note in result.notes)]
    n = len(result.matches)
    if result.faults:
        lines += [f"{_model_name(root)}: refused. No single scale fits it ({n} views compared):"]
        lines += [f"  {fault}" for fault in _distinct(result.faults)]
        return [*lines, "  a sensor that is itself off at places looks the same: --tolerance accepts changes up to it"]
    lines += [f"{_model_name(root)}: 1 unit = {result.scale:.6g} m ± {half:.1%} (k = 2; {n} views; sigma: {terms})"]
    return [*lines, *(f"  {line}" for line in _describe_path(result))]


def _describe_path(result: ScaleResult) -> list[str]:
    """The size by the camera path in a line; none where it is not known."""
    path = result.path
    if path is None:
        return []
    return [f"by the camera path alone: {path.scale:.6g} m ± {2 * path.sigma:.1%} (k = 2; {path.source})"]


def _distinct(faults: list[Any], most: int = 4) -> list[Any]:
    """The clearest fault of each kind."""
    first: dict[str, Any] = {}
    for fault in faults:
        first.setdefault(fault.kind, fault)
    return list(first.values())[:most]


def _write_page(path: Path, name: str, result: ScaleResult) -> None:
    low, high = result.interval()
    sentences = [f"1 unit of the model is {result.scale:.6g} m, from {low:.6g} to {high:.6g} m (k = 2)."]
    sentences += [*_describe_path(result), *result.notes]
    order = np.argsort(-np.abs(np.nan_to_num(result.frame_log - np.log(result.scale))))
    frames = []
    for k in order:
        match, log = result.matches[k], float(result.frame_log[k])
        how = "same picture" if match.is_same else "tracks"
        difference = float(np.expm1(log - np.log(result.scale)))
        cells = (str(match.frame), how, f"{np.exp(log):.5g}", f"{difference:+.2%}", f"{result.frame_sigma[k]:.2%}")
        frames.append(pages.ValidatedFrame(result.names[k], cells))
    # Differences of scale over frames, image regions and range
    off = result.frame_log - np.log(result.scale)
    of_frames = list(zip(map(float, range(len(off))), off.tolist(), result.frame_sigma.tolist(), strict=True))
    of_regions = [(float(k), change, sigma) for k, (_, _, change, sigma) in enumerate(_regions(result))]
    plots = [
        pages.ValidatedFrame(title, (), _plot(label, values))
        for title, label, values in (
            ("scale of every frame", "view, in the order of the capture", of_frames),
            ("scale of every picture region", "region, row by row", of_regions),
            ("scale by range", "m", [((a + b) / 2, change, 0.0) for a, b, change, _ in result.by_range]),
        )
    ]
    pages.write_validation_page(
        path,
        f"{name}: {'refused' if result.faults else 'metric scale'}",
        sentences=sentences,
        columns=_COLUMNS,
        frames=[*plots, *frames],
        failed=[str(fault) for fault in _distinct(result.faults)],
        word="scale",
        note=_NOTE,
    )


def _plot(label: str, rows: list[tuple[float, float, float]]) -> bytes:
    rows = [row for row in rows if np.isfinite(row[1])]
    reach = [value for _, y, sigma in rows for value in (y - 2 * sigma, y + 2 * sigma)]
    reach += [-_LEAST_REACH, _LEAST_REACH]
    figure, (axes,) = make_figure(size=(420, 216))
    axes.axhline(0.0, color=FAINT, linewidth=1.8)
    at, value, sigma = np.array(rows).reshape(-1, 3).T
    axes.errorbar(at, value, 2 * sigma, fmt="o", color=SERIES_COLOURS[0], linewidth=1.8, markersize=6.8)
    set_axis(axes, "x", label)
    set_axis(axes, "y", "difference, %", percent=True, limits=(1.06 * min(reach), 1.06 * max(reach)))
    buffer = io.BytesIO()
    save_figure(figure, buffer)
    return buffer.getvalue()
