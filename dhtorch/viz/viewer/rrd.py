"""A scene as a Rerun recording: for its viewer, or for an ``.rrd`` file where there is no screen.

Everything stands below ``world`` in metres, on two time lines: ``pair`` counts, ``time`` is the reference view's.
``gates`` holds the counts of every pair, ``pair`` the same in words.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.codes import Gate, Source, names, words
from dhtorch.viz.plots.colours import DEPTH_CMAP, GATE_COLOURS, RECOVERED, SENSOR, SILENT, SWEPT, parse_rgb
from dhtorch.viz.viewer.exhibit import Exhibit, ExhibitView, PairExhibit, PointCloud

RRD_SUFFIXES = (".rrd",)

#: Radii of points, m: a recovered point is as large as its sigma, within these limits.
_MIN_RADIUS_M, _MAX_RADIUS_M = 0.004, 0.15

#: Classes of samples with a return of the sensor, and of swept pixels; other samples have the code of their gate.
_SENSOR_CLASS, _SWEPT_CLASS = 100, 101


def write_rrd(path: Path, scene: Exhibit) -> Path:
    """Write the scene as an ``.rrd`` file.

    Raises:
        ImportError: Rerun is not installed.
        OSError: the file cannot be written.
    """
    rr = _import_rerun()
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = rr.RecordingStream("dhtorch")
    stream.save(path, default_blueprint=_make_blueprint())
    _log_exhibit(rr, stream, scene)
    stream.flush()
    stream.disconnect()
    return path


def spawn_viewer(scene: Exhibit) -> None:
    """Show the scene in a viewer of its own.

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
        found = "Rerun is not installed: pip install 'dhtorch[view]', or html=FILE for a page that needs nothing"
        raise ImportError(f"view: {found}") from error
    return rerun


def _make_blueprint() -> Any:
    from rerun import blueprint as b  # noqa: PLC0415

    space = b.Spatial3DView(origin="/world", name="points", contents=["+ /world/**", "- /world/anchor/depth/**"])
    words_ = b.Tabs(b.TextDocumentView(origin="/pair", name="pair"), b.TextDocumentView(origin="/about", name="about"))
    pictures = b.Vertical(
        b.Tabs(
            b.Spatial2DView(origin="/world/anchor/picture", name="anchor"),
            b.Spatial2DView(origin="/world/anchor/depth", name="sensor depth"),
        ),
        b.Spatial2DView(origin="/world/other/picture", name="other view, tracks"),
        words_,
    )
    left = b.Vertical(space, b.TimeSeriesView(origin="/gates", name="gates"), row_shares=[3, 1])
    return b.Blueprint(b.Horizontal(left, pictures, column_shares=[2, 1]), collapse_panels=True)


def _log_exhibit(rr: Any, stream: Any, scene: Exhibit) -> None:
    classes = [(_SENSOR_CLASS, "sensor", parse_rgb(SENSOR)), (Gate.ANSWER, "recovered", parse_rgb(RECOVERED))]
    classes.append((_SWEPT_CLASS, "swept", parse_rgb(SWEPT)))
    classes += [(code, words(names(Gate)[code]), parse_rgb(colour)) for code, colour in GATE_COLOURS.items()]
    stream.log("/", rr.AnnotationContext(classes), static=True)
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    about = "\n".join(f"{k}: {v}" for k, v in {"scene": scene.name, **scene.facts}.items())
    stream.log("about", rr.TextDocument(about), static=True)
    if scene.path is not None:
        stream.log("world/path", rr.LineStrips3D([scene.path], colors=parse_rgb(SILENT)), static=True)
    for name, (said, colour) in _describe_outcomes().items():
        stream.log(f"gates/{name.lower()}", rr.SeriesLines(names=said, colors=colour), static=True)
    swept = any(len(shot.swept.xyz) for shot in scene.shots)
    for k, shot in enumerate(scene.shots):
        stream.set_time("pair", sequence=k)
        if shot.view_0 is not None and (time := scene.views[shot.view_0].time) is not None:
            stream.set_time("time", duration=time)
        _log_text(rr, stream, shot)
        _log_points(rr, stream, shot)
        if swept:
            _log_swept(rr, stream, shot)
        if shot.view_0 is not None and shot.view_1 is not None:
            _log_views(rr, stream, shot, scene.views[shot.view_0], scene.views[shot.view_1])


def _describe_outcomes() -> dict[str, tuple[str, tuple[int, int, int]]]:
    """Outcome → its name and colour."""
    found = {"SENSOR": ("sensor", SENSOR), "ANSWER": ("recovered", RECOVERED)}
    found |= {names(Gate)[code]: (words(names(Gate)[code]), colour) for code, colour in GATE_COLOURS.items()}
    return {name: (said, parse_rgb(colour)) for name, (said, colour) in found.items()}


def _log_text(rr: Any, stream: Any, shot: PairExhibit) -> None:
    counts = shot.gates()
    for name, count in counts.items():
        stream.log(f"gates/{name.lower()}", rr.Scalars(count))
    lines = [f"pair {shot.label}", *(f"{k}: {v}" for k, v in shot.facts.items()), ""]
    lines += [f"{counts[name]:6d}  {said}" for name, (said, _) in _describe_outcomes().items() if counts[name]]
    stream.log("pair", rr.TextDocument("\n".join(lines)))


def _log_points(rr: Any, stream: Any, shot: PairExhibit) -> None:
    s, T = shot.samples, shot.T_world_from_0
    answer = s["source"] == Source.RECOVERED
    xyz, sigma = s["xyz"][answer], s["sigma"][answer]
    kept = {name: s[name][answer] for name in ("score", "sigma", "hole")}
    radii = sigma.clip(_MIN_RADIUS_M, _MAX_RADIUS_M)
    classes = np.full(len(xyz), Gate.ANSWER, np.uint16)
    stream.log(
        "world/map/recovered",
        rr.Points3D(_transform_points(T, xyz), radii=radii, class_ids=classes),
        rr.AnyValues(**kept),
    )
    share = (sigma / np.maximum(s["depth"][answer], 1e-9)).clip(0, 0.9)[:, None]
    bars = np.stack((_transform_points(T, xyz * (1 - share)), _transform_points(T, xyz * (1 + share))), 1)
    stream.log("world/map/sigma", rr.LineStrips3D(bars, colors=[*parse_rgb(RECOVERED), 120]))
    sensed = s["source"] == Source.SENSOR
    seen = shot.seen if len(shot.seen.xyz) else PointCloud(s["xyz"][sensed], s["rgb"][sensed])
    for name, cloud in (("sensor", seen), ("held_back", shot.held)):
        stream.log(
            f"world/map/{name}", rr.Points3D(_transform_points(T, cloud.xyz), colors=cloud.rgb, radii=_MIN_RADIUS_M)
        )


def _log_swept(rr: Any, stream: Any, shot: PairExhibit) -> None:
    cloud = shot.swept
    classes = np.full(len(cloud.xyz), _SWEPT_CLASS, np.uint16)
    dots = rr.Points3D(_transform_points(shot.T_world_from_0, cloud.xyz), radii=_MIN_RADIUS_M, class_ids=classes)
    stream.log("world/map/swept", dots, rr.AnyValues(score=cloud.score, sigma=cloud.sigma))


def _log_views(rr: Any, stream: Any, shot: PairExhibit, view_0: ExhibitView, view_1: ExhibitView) -> None:
    s = shot.samples
    _log_camera(rr, stream, "anchor", shot.T_world_from_0, view_0)
    if shot.depth_image is not None:
        (h, w), m = shot.depth_image.depth.shape, shot.depth_image
        c = [m.c[0] + 0.5, m.c[1] + 0.5]
        stream.log("world/anchor/depth", rr.Pinhole(focal_length=m.f, principal_point=c, width=w, height=h))
        stream.log("world/anchor/depth", rr.DepthImage(m.depth, meter=1.0, colormap=DEPTH_CMAP))
    groups = {"silent": Source.NONE, "sensor": Source.SENSOR, "recovered": Source.RECOVERED}
    classes = np.where(s["source"] == Source.SENSOR, _SENSOR_CLASS, s["gate"]).astype(np.uint16)
    at_0, at_1 = _to_jpeg_pixels(view_0, s["uv_0"]), _to_jpeg_pixels(view_1, s["uv_1"])
    for name, code in groups.items():
        here = s["source"] == code
        points = rr.Points2D(at_0[here], class_ids=classes[here], radii=1.5 if code == Source.NONE else 2.5)
        stream.log(f"world/anchor/picture/samples/{name}", points)
    if shot.T_world_from_1 is not None:
        _log_camera(rr, stream, "other", shot.T_world_from_1, view_1)
    else:
        stream.log("world/other", rr.Clear(recursive=True))
    found = s["tracked"]
    strips = np.stack((_to_jpeg_pixels(view_1, s["uv_0"])[found], at_1[found]), 1)
    stream.log("world/other/picture/tracks", rr.LineStrips2D(strips, class_ids=classes[found]))
    stream.log("world/other/picture/samples", rr.Points2D(at_1[found], class_ids=classes[found], radii=2.0))


def _log_camera(rr: Any, stream: Any, name: str, T: np.ndarray, view: ExhibitView) -> None:
    h, w = view.jpeg_hw
    s = (w / view.hw[1], h / view.hw[0])
    c = [(view.c[k] + 0.5) * s[k] for k in range(2)]
    f = [view.f[k] * s[k] for k in range(2)]
    stream.log(f"world/{name}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    camera = rr.Pinhole(focal_length=f, principal_point=c, width=w, height=h, image_plane_distance=0.3)
    stream.log(f"world/{name}/picture", camera)
    stream.log(f"world/{name}/picture", rr.EncodedImage(contents=view.jpeg, media_type="image/jpeg"))


def _to_jpeg_pixels(view: ExhibitView, uv: np.ndarray) -> np.ndarray:
    """Pixels of the full picture in those of the JPEG, where (0, 0) is the corner of the first."""
    (h, w), (H, W) = view.jpeg_hw, view.hw
    return (uv + 0.5) * np.array([w / W, h / H], uv.dtype)


def _transform_points(T: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return (xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
