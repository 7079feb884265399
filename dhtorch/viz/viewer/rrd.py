"""Exhibit -> Rerun recording, shown in its viewer or written as an ``.rrd`` file.

All entities are below ``world`` in metres, on two timelines: ``pair``, a counter, and ``time``, that of the reference
view. ``gates`` holds the counts of every pair as numbers, ``pair`` as text.
"""

from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Source, names, words
from dhtorch.runtime import storage
from dhtorch.viz.plots.colours import DEPTH_CMAP, FILLED, GATE_COLOURS, RECOVERED, SENSOR, SWEPT, UNANSWERED, parse_rgb
from dhtorch.viz.viewer.exhibit import Exhibit, ExhibitView, PairExhibit, PointCloud

RRD_SUFFIXES = (".rrd",)

#: Smallest radius of a point, m; the radius of a recovered point is its sigma.
_MIN_RADIUS_M = 0.004
#: Largest radius of a recovered point, m.
_MAX_RADIUS_M = 0.15

#: Class of samples with a sensor return; other samples have the code of their gate.
_SENSOR_CLASS = 100
#: Classes of swept and of filled pixels.
_SWEPT_CLASS, _FILLED_CLASS = 101, 102


def write_rrd(path: Path, scene: Exhibit) -> Path:
    """Write the exhibit as an ``.rrd`` file.

    Raises:
        ImportError: Rerun is not installed.
        OSError: the file cannot be written.
    """
    rr = _import_rerun()
    with storage.replace_at_end(path) as unfinished:
        stream = rr.RecordingStream("dhtorch")
        stream.save(unfinished, default_blueprint=_make_blueprint())
        _log_exhibit(rr, stream, scene)
        stream.flush()
        stream.disconnect()
    return path


def spawn_viewer(scene: Exhibit) -> None:
    """Open Rerun's viewer with the exhibit.

    Raises:
        ImportError: Rerun is not installed.
    """
    rr = _import_rerun()
    stream = rr.RecordingStream("dhtorch")
    stream.spawn(default_blueprint=_make_blueprint())
    _log_exhibit(rr, stream, scene)
    stream.flush()


def _import_rerun() -> Any:
    try:
        import rerun  # noqa: PLC0415
    except ImportError as error:
        message = "Rerun is not installed: pip install 'dhtorch[view]', or use html=FILE for a page without it"
        raise ImportError(f"view: {message}") from error
    return rerun


def _make_blueprint() -> Any:
    from rerun import blueprint as b  # noqa: PLC0415

    space = b.Spatial3DView(origin="/world", name="points", contents=["+ /world/**", "- /world/reference/depth/**"])
    words_ = b.Tabs(b.TextDocumentView(origin="/pair", name="pair"), b.TextDocumentView(origin="/about", name="about"))
    pictures = b.Vertical(
        b.Tabs(
            b.Spatial2DView(origin="/world/reference/picture", name="reference view"),
            b.Spatial2DView(origin="/world/reference/depth", name="sensor depth"),
        ),
        b.Spatial2DView(origin="/world/source/picture", name="source view, tracks"),
        words_,
    )
    left = b.Vertical(space, b.TimeSeriesView(origin="/gates", name="gates"), row_shares=[3, 1])
    return b.Blueprint(b.Horizontal(left, pictures, column_shares=[2, 1]), collapse_panels=True)


def _log_exhibit(rr: Any, stream: Any, scene: Exhibit) -> None:
    classes = [(_SENSOR_CLASS, "sensor", parse_rgb(SENSOR)), (Gate.ANSWER, "recovered", parse_rgb(RECOVERED))]
    classes += [(_SWEPT_CLASS, "swept", parse_rgb(SWEPT)), (_FILLED_CLASS, "filled", parse_rgb(FILLED))]
    classes += [(code, words(names(Gate)[code]), parse_rgb(colour)) for code, colour in GATE_COLOURS.items()]
    stream.log("/", rr.AnnotationContext(classes), static=True)
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    about = "\n".join(f"{k}: {v}" for k, v in {"scene": scene.name, **scene.facts}.items())
    stream.log("about", rr.TextDocument(about), static=True)
    if scene.path is not None:
        stream.log("world/path", rr.LineStrips3D([scene.path], colors=parse_rgb(UNANSWERED)), static=True)
    outcomes = {"SENSOR": ("sensor", parse_rgb(SENSOR)), "ANSWER": ("recovered", parse_rgb(RECOVERED))}
    outcomes |= {names(Gate)[code]: (words(names(Gate)[code]), parse_rgb(c)) for code, c in GATE_COLOURS.items()}
    for name, (label, colour) in outcomes.items():
        stream.log(f"gates/{name.lower()}", rr.SeriesLines(names=label, colors=colour), static=True)
    swept = any(len(shot.swept.xyz) for shot in scene.shots)
    for k, shot in enumerate(scene.shots):
        stream.set_time("pair", sequence=k)
        if shot.view_0 is not None and (time := scene.views[shot.view_0].time) is not None:
            stream.set_time("time", duration=time)
        counts = shot.gates()
        for name, count in counts.items():
            stream.log(f"gates/{name.lower()}", rr.Scalars(count))
        lines = [f"pair {shot.label}", *(f"{k}: {v}" for k, v in shot.facts.items()), ""]
        lines += [f"{counts[name]:6d}  {label}" for name, (label, _) in outcomes.items() if counts[name]]
        stream.log("pair", rr.TextDocument("\n".join(lines)))
        _log_points(rr, stream, shot, swept)
        if shot.view_0 is not None and shot.view_1 is not None:
            _log_views(rr, stream, shot, scene.views[shot.view_0], scene.views[shot.view_1])


def _log_points(rr: Any, stream: Any, shot: PairExhibit, swept: bool) -> None:
    s, T = shot.samples, shot.T_world_from_0
    answer = s["source"] == Source.RECOVERED
    xyz, sigma = s["xyz"][answer], s["sigma"][answer]

    def log(name: str, xyz: np.ndarray, *values: Any, **options: Any) -> None:
        stream.log(f"world/map/{name}", rr.Points3D(_transform_points(T, xyz), **options), *values)

    radii, classes = sigma.clip(_MIN_RADIUS_M, _MAX_RADIUS_M), np.full(len(xyz), Gate.ANSWER, np.uint16)
    values = {name: s[name][answer] for name in ("score", "sigma", "hole")}
    log("recovered", xyz, rr.AnyValues(**values), radii=radii, class_ids=classes)
    ratio = (sigma / np.maximum(s["depth"][answer], 1e-9)).clip(0, 0.9)[:, None]
    bars = np.stack((_transform_points(T, xyz * (1 - ratio)), _transform_points(T, xyz * (1 + ratio))), 1)
    stream.log("world/map/sigma", rr.LineStrips3D(bars, colors=[*parse_rgb(RECOVERED), 120]))
    sensed = s["source"] == Source.SENSOR
    seen = shot.seen if len(shot.seen.xyz) else PointCloud(s["xyz"][sensed], s["rgb"][sensed])
    for name, cloud in (("sensor", seen), ("held_out", shot.held_out)):
        log(name, cloud.xyz, colors=cloud.rgb, radii=_MIN_RADIUS_M)
    if swept:
        classes = np.where(shot.swept.source == Source.FILLED, _FILLED_CLASS, _SWEPT_CLASS).astype(np.uint16)
        values = {name: getattr(shot.swept, name) for name in ("score", "sigma")}
        log("swept", shot.swept.xyz, rr.AnyValues(**values), radii=_MIN_RADIUS_M, class_ids=classes)


def _log_views(rr: Any, stream: Any, shot: PairExhibit, view_0: ExhibitView, view_1: ExhibitView) -> None:
    s = shot.samples
    if shot.depth_image is not None:
        (h, w), m = shot.depth_image.depth.shape, shot.depth_image
        c = [m.c[0] + 0.5, m.c[1] + 0.5]
        stream.log("world/reference/depth", rr.Pinhole(focal_length=m.f, principal_point=c, width=w, height=h))
        stream.log("world/reference/depth", rr.DepthImage(m.depth, meter=1.0, colormap=DEPTH_CMAP))
    for name, T, view in (("reference", shot.T_world_from_0, view_0), ("source", shot.T_world_from_1, view_1)):
        if T is None:
            stream.log(f"world/{name}", rr.Clear(recursive=True))
            continue
        h, w = view.jpeg_hw
        scale = (w / view.hw[1], h / view.hw[0])
        c, f = [(view.c[k] + 0.5) * scale[k] for k in range(2)], [view.f[k] * scale[k] for k in range(2)]
        stream.log(f"world/{name}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        camera = rr.Pinhole(focal_length=f, principal_point=c, width=w, height=h, image_plane_distance=0.3)
        stream.log(f"world/{name}/picture", camera)
        stream.log(f"world/{name}/picture", rr.EncodedImage(contents=view.jpeg, media_type="image/jpeg"))
    groups = {"unanswered": Source.NONE, "sensor": Source.SENSOR, "recovered": Source.RECOVERED}
    classes = np.where(s["source"] == Source.SENSOR, _SENSOR_CLASS, s["gate"]).astype(np.uint16)
    at_0, at_1 = _to_jpeg_pixels(view_0, s["uv_0"]), _to_jpeg_pixels(view_1, s["uv_1"])
    for name, code in groups.items():
        of_source = s["source"] == code
        points = rr.Points2D(at_0[of_source], class_ids=classes[of_source], radii=1.5 if code == Source.NONE else 2.5)
        stream.log(f"world/reference/picture/samples/{name}", points)
    tracked = s["tracked"]
    strips = np.stack((_to_jpeg_pixels(view_1, s["uv_0"])[tracked], at_1[tracked]), 1)
    stream.log("world/source/picture/tracks", rr.LineStrips2D(strips, class_ids=classes[tracked]))
    stream.log("world/source/picture/samples", rr.Points2D(at_1[tracked], class_ids=classes[tracked], radii=2.0))


def _to_jpeg_pixels(view: ExhibitView, uv: np.ndarray) -> np.ndarray:
    """Pixels of the full image -> pixels of the JPEG, with (0, 0) at the corner of the first pixel."""
    (h, w), (H, W) = view.jpeg_hw, view.hw
    return (uv + 0.5) * np.array([w / W, h / H], uv.dtype)


def _transform_points(T: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return (xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
