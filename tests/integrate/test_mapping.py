"""``dhtorch integrate``: from a recording to files that other programs read, and a result that counts."""

import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import hydra
import numpy as np
import pytest
import torch
from support import stored_outputs, writers
from support.read_back import read_ply

from dhtorch import data
from dhtorch.cli.run import config_dir, main
from dhtorch.experiments import report
from dhtorch.integrate import mapping
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Camera, Frame
from dhtorch.runtime import results as result_files
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.viz.viewer import points

TINY = [
    "data.hw=[240,320]",
    "data.n_frames=4",
    "data.supersample=1",
    "data.step_m=0.04",
    "data.gap=3",
    "pairs=gap",
    "method=map",
    "method.n=512",
    "dense=false",
    "voxel=0.06",
]
SWEPT = [option for option in TINY if option not in ("method=map", "dense=false")]
FILES = {"map.ply", "map.glb", "points.ply", "map.png", "cameras.txt", "images.txt", "points3D.txt", "times.txt"}


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    env = {k: v for k, v in os.environ.items() if k != "DHTORCH_DATA"}
    command = [sys.executable, "-m", "dhtorch", "integrate", *TINY, "cutoff=2.0", "output=here"]
    done = subprocess.run(command, check=False, cwd=folder, env=env, capture_output=True, text=True, timeout=290)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "neither warnings nor a progress bar"
    return folder / "here", done.stdout


def test_every_file_is_written_and_named_and_the_result_counts_what_was_widened(job):
    folder, said = job
    stored_outputs.check("integrate", folder, printed=said, folder=folder)
    written = [p for p in (folder / "synthetic_room").rglob("*") if p.is_file()]
    assert {p.name for p in written} == FILES | {"000000.png", "000003.png"}
    assert all(
        f"here/{name}" in said for name in ("synthetic_room/colmap/images", "result.json", "synthetic_room/map.glb")
    )
    newest = max(p.stat().st_mtime_ns for p in written)
    assert (folder / "result.json").stat().st_mtime_ns >= newest, "written last"
    result = result_files.read_result(folder)
    pair, scene = result["rows"]
    assert pair["pair"] == [0, 3] and pair["placed"] == 1 and scene["n_frames"] == 2 and scene["n_fragments"] == 1
    assert scene["voxels_vs_sensor"] == scene["n_voxels"] / scene["n_voxels_sensor"] > 1
    assert result["summary"]["map.n_voxels"]["value"] == scene["n_voxels"]
    assert report.tables(result), "the report shows it as any other"


def test_colmap_reads_views_and_tracks(job):
    folder, _ = job
    pycolmap = pytest.importorskip("pycolmap")
    workspace = folder / "synthetic_room" / "colmap"
    model = pycolmap.Reconstruction(str(workspace / "sparse" / "0"))
    assert len(model.images) == 2 and len(model.cameras) == 1
    assert {image.name for image in model.images.values()} == {p.name for p in (workspace / "images").iterdir()}
    row = result_files.read_result(folder)["rows"][-1]
    assert len(model.points3D) == row["colmap_n_points"] > row["colmap_n_triangulated"] > 30
    (camera,) = model.cameras.values()
    misses = [
        np.linalg.norm(camera.img_from_cam(image.cam_from_world() * model.points3D[p.point3D_id].xyz) - p.xy)
        for image in model.images.values()
        for p in image.points2D
    ]
    assert len(misses) == row["colmap_n_points"] + row["colmap_n_triangulated"]
    assert np.median(misses) < 1.0 and max(misses) < 4.001, "poses, lens and half pixels agree, outliers are left out"


def test_the_files_of_a_map_have_one_set_of_axes_and_sources(job):
    folder, _ = job
    trimesh = pytest.importorskip("trimesh")
    vertex, points = (read_ply(folder / "synthetic_room" / name) for name in ("map.ply", "points.ply"))
    assert len(vertex) == result_files.read_result(folder)["rows"][-1]["n_points"]
    assert bool((vertex["sigma"] > 0).all()) and bool(((vertex["score"] >= 0) & (vertex["score"] <= 1.001)).all())
    assert all({*np.unique(each["source"])} == {1, 2} for each in (vertex, points))
    assert bool((points["class"][points["source"] == 2] > 0).all()), "what was recovered fills a hole"
    scene = trimesh.load(folder / "synthetic_room" / "map.glb")
    assert set(scene.geometry) == {"surface", "recovered"}
    assert len(scene.geometry["recovered"].faces) == 2 * int((points["source"] == 2).sum()), "a square for each"
    corners = np.stack([vertex[axis] for axis in "xyz"], 1)
    np.testing.assert_allclose(scene.geometry["surface"].vertices, corners, atol=1e-6)
    assert np.allclose(scene.graph["surface"][0], np.eye(4)), "GLB and PLY have the same axes"
    up = re.search(rb"^comment up (.+)$", (folder / "synthetic_room" / "map.ply").read_bytes(), re.MULTILINE)[1]
    np.testing.assert_allclose([float(x) for x in up.split()], [0, 1, 0], atol=1e-6)


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """The command in this process, from an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NO_COLOR", "1")

    def call(*args):
        try:
            code = main(["integrate", *args])
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return call


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("poses=gps", "poses: found 'gps', expected auto or device or anchored"),
        ("voxel=0", "voxel: found 0, expected a positive number"),
        ("truncation=0.001", "expected 0 < voxel <= truncation"),
        ("min_weight=-1", "min_weight: found -1, expected a number of at least 0"),
        ("dtype=int32", "dtype: found 'int32', expected float32 or float64"),
        ("cutoff=-1", "cutoff: found -1, expected a positive number, or null"),
        ("pairs.gap=99", "pairs.gap: found 99"),
        ("voxle=1", "voxle"),
        ("dense=often", "dense: found 'often', expected true, false or options"),
        ("dense={planse: 32}", "dense: found 'planse', expected some of source_views"),
        ("dense={planes: few}", "dense.planes: found 'few', expected a whole number"),
        ("weight=score", "weight: found 'score', expected variance or confidence"),
        ("min_maps=0", "min_maps: found 0, expected a whole number of at least 1"),
    ],
)
def test_wrong_options_end_in_one_line_and_no_file(command, tmp_path, option, words):
    code, out, err = command(*TINY, option, "output=here")
    assert code == 2 and out == "" and words in err and err.count("\n") == 1
    assert not (tmp_path / "here").exists()


@pytest.mark.slow
def test_a_recording_without_a_trajectory_is_anchored_unless_its_own_is_asked_for(command, tmp_path):
    room = SyntheticRoom(hw=(240, 320), n_frames=4, supersample=1, step_m=0.04, lidar="exact")
    folder = tmp_path / "walk"
    writers.write_tum(folder, [room[i] for i in range(4)])
    (folder / "groundtruth.txt").unlink()
    own = ["data=tum", f"data.root={folder}", "pairs.gap=3", "method=map", "method.n=512", "voxel=0.06", "output=here"]
    code, _, err = command(*own, "poses=device")
    assert code == 2 and "walk has no trajectory of its own, expected poses=anchored" in err
    code, out, err = command(*own, "mesh=false")
    assert code == 0, err
    assert "walk: depth unit assumed: 1/5000 m" in err
    assert "2 of 2 frames placed by anchored poses, 1 fragment" in out and "triangles" not in out


def test_ctrl_c_keeps_the_scenes_that_are_whole(tmp_path, monkeypatch):
    row = {"seconds": 0.0, "scene": "a", "method": "map", "truth": "device"}
    mapped = [mapping.MappedScene(SyntheticRoom(n_frames=2), [], None, None, None, row), KeyboardInterrupt]
    monkeypatch.setattr(mapping, "map_scene", Mock(side_effect=mapped))
    monkeypatch.setattr(mapping, "write_mapped_scene", lambda *_: [])
    settings = {"output": str(tmp_path), "dtype": "float32", "poses": "device", "axes": "y_up", "min_weight": 0.0}
    settings |= dict.fromkeys(("mesh", "threads", "truncation", "cutoff"))
    settings |= {"voxel": 0.1, "dense": False, "min_maps": 2}
    rooms = [SyntheticRoom(n_frames=2), SyntheticRoom(n_frames=2)]
    with pytest.raises(KeyboardInterrupt, match=f"1 of 2 scenes in {tmp_path} are whole and stay"):
        mapping.run(settings, {"data": rooms, "method": None, "pairs": None}, progress=lambda items, _text, _n: items)
    assert not (tmp_path / "result.json").exists()


@pytest.mark.slow
def test_a_dense_map_says_what_the_sweep_added(command, tmp_path):
    code, out, err = command(*SWEPT, "cutoff=2.0", "dense={planes: 32, size: 160}", "mesh=false", "output=here")
    assert code == 0, err
    assert "times those without a sweep" in out
    here = tmp_path / "here"
    written = {p.name for p in here.rglob("*") if p.is_file() and not {".dhtorch", "images"} & {*p.parts}}
    assert written == {*FILES, "result.json"}, "the maps' file is gone"
    result = result_files.read_result(here)
    pair, scene = result["rows"]
    assert pair["map_hw"] == [120, 160] and pair["n_swept"] == scene["n_swept"] > 1000
    assert scene["n_voxels"] > scene["n_voxels_sparse"] > scene["n_voxels_sensor"]
    assert scene["voxels_vs_sparse"] == scene["n_voxels"] / scene["n_voxels_sparse"]
    assert result["summary"]["fused.voxels_vs_sparse"]["value"] == scene["voxels_vs_sparse"]
    assert result["config"]["dense"] == {"planes": 32, "size": 160}
    words = (here / "synthetic_room" / "map.ply").read_bytes()[:400]
    assert b"source: 0 none, 1 sensor, 2 recovered, 3 swept" in words
    (shot,) = points.read_ply_exhibit(here / "synthetic_room" / "map.ply").shots
    assert len(shot.swept.xyz) > 200 and len(shot.swept.xyz) + len(shot.samples["xyz"]) == scene["n_points"]
    glb = (here / "synthetic_room" / "map.glb").read_bytes()
    assert b'"name":"swept"' in glb and b'"_SOURCE"' in glb


def composed(*overrides, word="integrate"):
    """Settings of a word, and the choices of groups."""
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = hydra.compose(word, list(overrides), return_hydra_config=True)
    return cfg, cfg.hydra.runtime.choices


def test_the_built_in_room_shows_what_views_add_and_a_recording_hides_nothing():
    room, _ = composed()
    assert room.cutoff == room.data.near == 2.0 and room.dense is True and room.pairs.stride == 2
    own, _ = composed("data=auto", "data.root=x")
    assert own.cutoff is None and own.dense is False and own.pairs.stride is None
    plain, _ = composed("dense={size: 99}", "cutoff=null", "pairs.stride=1")
    assert plain.cutoff is None and plain.dense == {"size": 99} and plain.pairs.stride == 1, "what is stated wins"
    for word in ("integrate", "view"):
        methods = [composed(*more, word=word)[1].method for more in ((), ("dense=true",), ("dense=true", "method=map"))]
        assert methods[1:] == ["fused", "map"] and METHODS[methods[0]].views > 1


def test_a_voxel_is_two_pixels_of_the_sensor_at_the_median_return_of_three_frames():
    """Those of a depth map without a camera of its own are pixels of the image at its size; to two digits."""
    camera = Camera(torch.full((1, 2), 50.0), torch.full((1, 2), 20.0))
    depth = torch.tensor([0.0, math.nan, 2.0]).repeat(24, 11)[None, :, :32]
    frame = Frame(torch.zeros(1, 3, 48, 64), depth, camera)
    assert mapping.choose_voxel([frame]) == pytest.approx(2 * 2.0 / 25)
    own = frame.replace(depth_camera=camera)
    far, near = own.replace(depth=2.25 * depth), own.replace(depth=0.5 * depth)
    assert mapping.choose_voxel([near, far, own, far, far]) == pytest.approx(0.08), "of the first, middle and last"
    assert mapping.choose_voxel([far, far, near, own], [2, 3]) == pytest.approx(0.08)
    limits = [mapping.choose_voxel([own.replace(depth=x * depth)]) for x in (0.0, 0.01, 9.0, 2.2525 / 2)]
    assert limits == [0.02, 0.005, 0.2, 0.09]


@pytest.mark.data
@pytest.mark.skipif("DHTORCH_DATA" not in os.environ, reason="DHTORCH_DATA is unset")
@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("holo_a", 0.005, 0.02),
        ("tum_fr1_desk9", 0.0025, 0.01),
        ("r3d_door", 0.005, 0.005),
        ("7s_redkitchen_000", 0.004, 0.012),
    ],
)
def test_a_voxel_is_two_pixels_of_the_sensor(name, least, most):
    recording = data.open(Path(os.environ["DHTORCH_DATA"]) / name)
    voxel = mapping.choose_voxel(recording)
    assert least <= voxel <= most and voxel == float(f"{voxel:.2g}")
    frames = [recording[k] for k in (0, len(recording) // 2, len(recording) - 1)]
    sizes = []
    for frame in frames:
        depth = frame.depth[0].double().numpy()
        side = float((frame.depth_camera or frame.camera).f.mean())
        side *= 1 if frame.depth_camera is not None else depth.shape[1] / max(frame.hw[1], 1)
        sizes.append(float(np.median(depth[np.isfinite(depth) & (depth > 0)])) / side)
    assert voxel == pytest.approx(max(0.005, 2 * sorted(sizes)[1]), rel=0.06), "two digits"


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif("DHTORCH_DATA" not in os.environ, reason="DHTORCH_DATA is unset")
def test_a_real_desk_becomes_a_map(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    root = os.path.join(os.environ["DHTORCH_DATA"], "tum_fr1_desk9")  # noqa: PTH118
    options = [
        "data=tum",
        f"data.root={root}",
        "pairs.gap=4",
        "pairs.stride=4",
        "method.n=512",
        "voxel=0.04",
        "output=here",
    ]
    assert main(["integrate", *options, "mesh=false"]) == 0
    (scene,) = [r for r in result_files.read_result(tmp_path / "here")["rows"] if r["pair"] is None]
    assert scene["n_frames"] == 3 and scene["n_voxels"] > 1000 and scene["largest_island"] > 0.2
    assert torch.get_num_threads() == 1 and "tum_fr1_desk9: 3 of 3 frames" in capsys.readouterr().out
    shutil.rmtree(tmp_path / "here")
