"""What the viewers draw, from an exhibit of two cameras in which every number is another."""

import base64
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dhtorch.codes import Gate, Hole, Source
from dhtorch.viz.viewer import html, rrd
from dhtorch.viz.viewer.exhibit import (
    EMPTY_CLOUD,
    DepthImage,
    Exhibit,
    ExhibitView,
    PairExhibit,
    PointCloud,
    SweptPointCloud,
)


def view(k):
    return ExhibitView(
        number=10 + k, hw=(60, 80), f=(50.0 + k, 60.0 + k), c=(40.0 + k, 30.0 + k), jpeg=b"\xff\xd8" + bytes([k]),
        jpeg_hw=(30, 20), time=1.5 + k,
    )  # fmt: skip


def pose(k):
    T = np.eye(4)
    c, s = np.cos(0.1 * k), np.sin(0.1 * k)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = k, 2 * k, 3 * k
    return T


def cloud(first, n=2):
    xyz = np.arange(first, first + 3 * n, dtype=np.float32).reshape(n, 3)
    return PointCloud(xyz, np.full((n, 3), first, np.uint8))


@pytest.fixture
def exhibit():
    n = 4
    whole = np.arange(n)
    samples = {
        "uv_0": np.stack([10.0 + whole, 20.0 + whole], 1).astype(np.float32),
        "uv_1": np.stack([15.0 + whole, 26.0 + whole], 1).astype(np.float32),
        "xyz": np.arange(3 * n, dtype=np.float32).reshape(n, 3),
        "rgb": np.arange(3 * n, dtype=np.uint8).reshape(n, 3),
        "depth": np.array([1.0, 2.0, 4.0, 8.0], np.float32),
        "sigma": np.array([0.01, 0.02, 0.4, 0.8], np.float32),
        "score": np.array([0.0, 0.25, 0.5, 1.0], np.float32),
        "parallax_deg": np.array([1.0, 2.0, 3.0, 4.0], np.float32),
        "residual_px": np.array([0.1, 0.2, 0.3, 0.4], np.float32),
        "error": np.array([0.01, 0.02, 0.03, np.nan], np.float32),
        "source": np.array([Source.SENSOR, Source.NONE, Source.RECOVERED, Source.RECOVERED], np.int32),
        "gate": np.array([Gate.NO_TRACK, Gate.PARALLAX, Gate.ANSWER, Gate.ANSWER], np.int32),
        "hole": np.array([Hole.NONE, Hole.TOO_DARK, Hole.TRACKABLE_NO_LIDAR, Hole.TRACKABLE_NO_LIDAR], np.int32),
        "tracked": np.array([False, True, True, True]),
        "candidate": np.array([False, False, True, False]),
    }  # fmt: skip
    swept = SweptPointCloud(
        *(getattr(cloud(60), name) for name in ("xyz", "rgb")),
        np.float32([0.3, 0.6]),
        np.float32([0.2, 0.9]),
        np.uint8([Source.SWEPT, Source.FILLED]),
    )
    shot = PairExhibit(
        "10 11", samples, pose(1), pose(2), view_0=0, view_1=1, seen=cloud(20), held_out=cloud(40), swept=swept,
        depth_image=DepthImage(np.ones((3, 5), np.float32), (7.0, 8.0), (2.0, 1.0)),
    )  # fmt: skip
    return Exhibit("two cameras", [shot], [view(0), view(1)])


def unpacked(packed):
    return np.frombuffer(base64.b64decode(packed["base64"]), f"<{packed['type']}")


def test_a_page_places_each_camera_where_it_stood(exhibit):
    page = html.build_viewer_page(exhibit)
    data = json.loads(re.search(r"<script[^>]*json[^>]*>(.*?)</script>", page, re.DOTALL).group(1))
    (shot,) = data["shots"]
    for k in (1, 2):
        assert np.allclose(np.reshape(shot[f"T_world_from_{k - 1}"], (3, 4)), pose(k)[:3])
    assert (shot["view_0"], shot["view_1"]) == (0, 1)
    for k, sent in enumerate(data["views"]):
        assert (sent["number"], sent["time"], sent["hw"]) == (10 + k, 1.5 + k, [60, 80])
        assert (sent["f"], sent["c"]) == ([50.0 + k, 60.0 + k], [40.0 + k, 30.0 + k])
        assert base64.b64decode(sent["jpeg"])[2] == k
    for name in ("uv_0", "uv_1"):
        uv = unpacked(shot["samples"][name]).reshape(-1, 2) / data["per_pixel"] - data["margin_px"]
        assert np.allclose(uv, exhibit.shots[0].samples[name])
    for name in ("seen", "held_out", "swept"):
        xyz = unpacked(shot[name]["xyz"]).reshape(-1, 3) * shot[name]["step"] + shot[name]["low"]
        assert np.allclose(xyz, getattr(exhibit.shots[0], name).xyz, atol=1e-3)
    assert np.allclose(unpacked(shot["samples"]["score"]) / 65535, [0, 0.25, 0.5, 1], atol=1e-4)
    assert np.allclose(unpacked(shot["swept"]["score"]) / 65535, [0.2, 0.9], atol=1e-4)
    assert unpacked(shot["swept"]["source"]).tolist() == [Source.SWEPT, Source.FILLED]
    assert data["about"].endswith(", 1 swept and 1 filled pixels")


class Log:
    """A recording stream, and a rerun module whose archetypes are their arguments."""

    def __init__(self):
        self.entries = {}

    def log(self, name, *parts):
        self.entries.setdefault(name, []).extend(parts)

    def set_time(self, *args, **options):
        pass

    def __getattr__(self, kind):
        return lambda *args, **options: SimpleNamespace(kind=kind, args=args, **options)

    def of(self, name, kind):
        (entry,) = [part for part in self.entries[name] if part.kind == kind]
        return entry


def test_a_recording_places_each_camera_and_every_point_where_it_stood(exhibit):
    log, (shot,) = Log(), exhibit.shots
    rrd._log_points(log, log, shot, True)
    rrd._log_views(log, log, shot, *exhibit.views)
    for k, name in ((1, "reference"), (2, "source")):
        placed, camera = log.of(f"world/{name}", "Transform3D"), log.of(f"world/{name}/picture", "Pinhole")
        assert np.allclose(placed.translation, pose(k)[:3, 3]) and np.allclose(placed.mat3x3, pose(k)[:3, :3])
        own = exhibit.views[k - 1]
        assert np.allclose(camera.focal_length, np.array(own.f) * [20 / 80, 30 / 60])
        assert np.allclose(camera.principal_point, (np.array(own.c) + 0.5) * [20 / 80, 30 / 60])
        assert (camera.width, camera.height) == (20, 30)
        assert log.of(f"world/{name}/picture", "EncodedImage").contents == own.jpeg
    depth = log.of("world/reference/depth", "Pinhole")
    assert (
        depth.principal_point == [2.5, 1.5]
        and depth.focal_length == (7.0, 8.0)
        and (depth.width, depth.height) == (5, 3)
    )
    placed = lambda xyz: xyz @ pose(1)[:3, :3].T + pose(1)[:3, 3]  # noqa: E731
    points = log.of("world/map/recovered", "Points3D")
    assert np.allclose(points.args[0], placed(shot.samples["xyz"][2:])) and len(points.radii) == 2
    for name in ("held_out", "swept"):
        assert np.allclose(log.of(f"world/map/{name}", "Points3D").args[0], placed(getattr(shot, name).xyz))
    assert log.of("world/map/swept", "Points3D").class_ids.tolist() == [rrd._SWEPT_CLASS, rrd._FILLED_CLASS]
    assert np.allclose(log.of("world/map/sensor", "Points3D").args[0], placed(shot.seen.xyz))
    alone = Log()
    rrd._log_points(alone, alone, replace(shot, seen=EMPTY_CLOUD), False)
    sensed = alone.of("world/map/sensor", "Points3D")
    assert (
        np.allclose(sensed.args[0], placed(shot.samples["xyz"][:1]))
        and (sensed.colors == shot.samples["rgb"][:1]).all()
    )
    bars = log.of("world/map/sigma", "LineStrips3D").args[0]
    assert np.allclose(bars[:, 0], placed(0.9 * shot.samples["xyz"][2:]))
    assert np.allclose(bars[:, 1], placed(1.1 * shot.samples["xyz"][2:]))
    tracks = log.of("world/source/picture/tracks", "LineStrips2D").args[0]
    to_jpeg = lambda uv: (uv + 0.5) * [20 / 80, 30 / 60]  # noqa: E731
    tracked = shot.samples["tracked"]
    assert np.allclose(tracks[:, 0], to_jpeg(shot.samples["uv_0"][tracked]))
    assert np.allclose(tracks[:, 1], to_jpeg(shot.samples["uv_1"][tracked]))
    silent = log.of("world/reference/picture/samples/unanswered", "Points2D")
    assert np.allclose(silent.args[0], to_jpeg(shot.samples["uv_0"][1:2])) and silent.class_ids.tolist() == [
        Gate.PARALLAX
    ]
