"""Every number that the commands and writers write, against the numbers of frames that are known, by other readers.

The frames are those of ``support.known_episodes``, of which no two share a number. Files are read with pyarrow, PyAV,
Pillow, json and struct, never with dhtorch's own readers.
"""

import io
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("av")

import av
from PIL import Image
from pyarrow import parquet
from support import known_episodes as known
from support import stored_outputs, writers
from support.known_episodes import CAMERAS, FPS, HW, LENGTHS, LENS, TASKS
from support.read_back import Array, linear, read_glb, read_ply, same
from support.writers.simulator_hdf5 import write_simulator_hdf5

from dhtorch import data
from dhtorch.cli.run import main
from dhtorch.codes import Gate, Hole, Source
from dhtorch.extract.step_set import RldsSource

KEYS = [f"observation.images.{name}" for name in CAMERAS]
FEW = ["method=paper", "method.n=64", "method.hypotheses=10"]
#: Without another view every depth is the sensor's, so that the maps are known, too.
ENRICH = [*FEW, "gap=0", "dense={size: 64, planes: 8}", "shard_rows=4", "report=false"]
#: Quantisation of enrich's depth and sigma, m, and the sensor's relative standard deviation.
STEP, SIGMA_STEP, SIGMA_REL = 2.0**-10, 2.0**-13, 0.01


def enrich(source: Path, out: Path, *more: str) -> Path:
    assert main(["enrich", str(source), str(out), *ENRICH, *more]) == 0
    return out


def stored_depth(camera: int, e: int, i: int) -> Array:
    """The sensor's depth in steps of enrich, m."""
    return np.rint(known.depth(camera, e, i).astype(np.float64) / STEP) * STEP


def stored_sigma(camera: int, e: int, i: int) -> Array:
    z = known.depth(camera, e, i).astype(np.float64)
    return np.rint(SIGMA_REL * z / SIGMA_STEP) * SIGMA_STEP


def pixels(content: Path | bytes) -> Array:
    return np.array(Image.open(io.BytesIO(content) if isinstance(content, bytes) else content))


def read_rows(root: Path) -> list[dict[str, Any]]:
    return [row for file in sorted((root / "data").rglob("*.parquet")) for row in parquet.read_table(file).to_pylist()]


def read_json(*parts: Path | str) -> Any:
    return json.loads(Path(*parts).read_text())


def read_lines(file: Path) -> list[Any]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def hold(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Assert that fields have their values: equal, or (numbers, tolerance), whatever their shape."""
    for name, want in wanted.items():
        values, tolerance = want if isinstance(want, tuple) else (want, 0.0)
        if isinstance(values, np.ndarray):
            same(np.reshape(found[name], values.shape), values, tolerance)
        else:
            assert found[name] == (pytest.approx(values, abs=tolerance) if tolerance else values), name


# --------------------------------------------------------------------------------------------------- enrich, LeRobot


def check_maps(row: dict[str, Any], camera: int, e: int, i: int, depth_key: str) -> None:
    """Depth, sigma, source, K and pose of one camera in one row."""
    key = depth_key.removesuffix("_enriched").removesuffix("_depth")
    name = key.removeprefix("observation.images.")
    has_return = known.depth(camera, e, i) > 0
    wanted = {
        depth_key: stored_depth(camera, e, i),
        f"{depth_key}_sigma": (stored_sigma(camera, e, i), SIGMA_STEP),  # on the edge of two steps
        f"{key}_dhtorch_source": np.where(has_return, Source.SENSOR, Source.NONE),
        f"observation.{name}.intrinsics": known.intrinsics(camera, e, i),
        f"observation.{name}.T_world_from_cam": (known.pose(camera, e, i), 1e-7),
    }
    hold(row, wanted)


@pytest.fixture(scope="module", params=[3, 2])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    """Version of the format, and the known set enriched in it."""
    root = tmp_path_factory.mktemp("robot")
    known.write_robot(root / "source", version=request.param)
    return request.param, enrich(root / "source", root / "set", "format=same")


def test_every_row_of_a_robots_set_has_its_own_numbers(robot: tuple[int, Path]) -> None:
    rows = read_rows(robot[1])
    assert len(rows) == sum(LENGTHS)
    for index, (row, (e, i)) in enumerate(zip(rows, known.rows(), strict=True)):
        own = {"index": index, "episode_index": e, "frame_index": i, "timestamp": np.float32(i / FPS)}
        own |= {"task_index": known.task(e, i), "note": f"step {i} of {e}"}
        own |= {"observation.state": known.joints(e, i), "action": known.action(e, i)}
        for camera, key in enumerate(KEYS):
            check_maps(row, camera, e, i, f"{key}_depth_enriched")
            own |= {f"{key}_depth": known.depth(camera, e, i), f"{key}.intrinsics": known.intrinsics(camera, e, i)}
            own[f"{key}.pose"] = known.pose(camera, e, i), 1e-9
        hold(row, own)


def test_the_metadata_lead_to_the_rows_and_video_frames_of_every_episode(robot: tuple[int, Path]) -> None:
    version, root = robot
    info = read_json(root, "meta", "info.json")
    tasks = [list(dict.fromkeys(TASKS[known.task(e, i)] for i in range(n))) for e, n in enumerate(LENGTHS)]
    totals = {"total_episodes": len(LENGTHS), "total_frames": sum(LENGTHS), "total_tasks": len(TASKS), "fps": FPS}
    assert {name: info[name] for name in totals} == totals
    assert info["splits"] == {"train": "0:1", "val": "1:2"} and info["robot_type"] == "known arm"
    if version == 2:
        found = [
            (row["episode_index"], row["length"], row["tasks"]) for row in read_lines(root / "meta/episodes.jsonl")
        ]
        task_rows = read_lines(root / "meta" / "tasks.jsonl")
    else:
        (file,) = (root / "meta" / "episodes").rglob("*.parquet")
        episodes = parquet.read_table(file).to_pylist()
        found = [(row["episode_index"], row["length"], row["tasks"]) for row in episodes]
        spans = [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes]
        assert spans == [(0, LENGTHS[0]), (LENGTHS[0], sum(LENGTHS))]
        task_rows = parquet.read_table(root / "meta" / "tasks.parquet").to_pylist()
    assert found == [(e, n, tasks[e]) for e, n in enumerate(LENGTHS)]
    assert [(row["task_index"], row["task"]) for row in task_rows] == list(enumerate(TASKS))
    for camera, key in enumerate(KEYS):
        for e, n in enumerate(LENGTHS):
            where = {"video_key": key, "episode_index": e, "episode_chunk": 0, "chunk_index": 0, "file_index": 0}
            first = 0
            if version == 3:
                where |= {name: episodes[e][f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
                first, last = (episodes[e][f"videos/{key}/{end}_timestamp"] * FPS for end in ("from", "to"))
                assert last - first == pytest.approx(n)
            with av.open(str(root / info["video_path"].format(**where))) as container:
                frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)][round(first) :]
            for i in range(n):
                assert np.array_equal(frames[i], known.picture(camera, e, i)), (key, e, i)


def test_statistics_are_those_of_the_known_numbers(robot: tuple[int, Path]) -> None:
    version, root = robot
    sets = [(read_json(root, "meta", "stats.json"), known.rows())]
    if version == 2:
        lines = read_lines(root / "meta" / "episodes_stats.jsonl")
        sets += [(line["stats"], [row for row in known.rows() if row[0] == line["episode_index"]]) for line in lines]
        assert len(sets) == 3
        shapes = {
            np.shape(v)
            for stats, _ in sets[1:]
            for n, x in stats.items()
            if "image" in n
            for k, v in x.items()
            if k != "count"
        }
        assert shapes == {(3, 1, 1)}, "what LeRobot 0.3 asks of every feature with image in its name"
    for stats, rows in sets:
        columns = {
            "action": [known.action(e, i) for e, i in rows],
            "observation.state": [known.joints(e, i) for e, i in rows],
            "timestamp": [[np.float32(i / FPS)] for _, i in rows],
            "task_index": [[known.task(e, i)] for e, i in rows],
        }
        for camera, name in enumerate(CAMERAS):
            columns[f"observation.{name}.intrinsics"] = [known.intrinsics(camera, e, i).ravel() for e, i in rows]
            columns[f"observation.{name}.T_world_from_cam"] = [known.pose(camera, e, i).ravel() for e, i in rows]
        for name, values in columns.items():
            entry, x = stats[name], np.asarray(values, np.float64)
            want = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0), "count": [len(rows)]}
            for kind, value in want.items():
                same(entry[kind], value, 1e-6)
        for camera, key in enumerate(KEYS):
            picture = np.stack([known.picture(camera, e, i) for e, i in rows]).reshape(-1, 3) / 255
            z = np.stack([stored_depth(camera, e, i) for e, i in rows])
            z = z[z > 0]
            for kind, of in (("mean", np.mean), ("std", np.std)):
                same(np.ravel(stats[key][kind]), of(picture, 0), 1e-9)
                same(np.ravel(stats[f"{key}_depth_enriched"][kind])[0], of(z), 1e-6)
            for kind, q in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
                assert np.ravel(stats[f"{key}_depth_enriched"][kind])[0] == pytest.approx(np.quantile(z, q), rel=0.025)


# ---------------------------------------------------------------------------------------------- enrich, other sources


def write_simulator(file: Path) -> None:
    """Both episodes of both cameras in one file of ManiSkill."""
    h5py = pytest.importorskip("h5py")
    other = file.with_name("other.h5")
    for camera, part in enumerate((file, other)):
        frames = known.episodes(camera, lens=False)
        write_simulator_hdf5(part, frames, "maniskill3", camera=CAMERAS[camera])
    with h5py.File(file, "a") as first, h5py.File(other) as second:
        for e in range(len(LENGTHS)):
            for group in ("sensor_data", "sensor_param"):
                place = f"traj_{e}/obs/{group}"
                second.copy(f"{place}/{CAMERAS[1]}", first[place])
    other.unlink()


def test_several_recordings_of_several_cameras_are_episodes_of_one_set(tmp_path: Path) -> None:
    write_simulator(tmp_path / "demo.h5")
    out = enrich(tmp_path / "demo.h5", tmp_path / "set", f"fps={FPS}", "task=look")
    rows = read_rows(out)
    assert len(rows) == sum(LENGTHS)
    for index, (row, (e, i)) in enumerate(zip(rows, known.rows(), strict=True)):
        own = {"index": index, "episode_index": e, "frame_index": i, "task_index": 0, "observation.frame_number": i}
        hold(row, own | {"timestamp": np.float32(i / FPS)})
        for camera, key in enumerate(KEYS):
            assert np.array_equal(pixels(row[key]["bytes"]), known.picture(camera, e, i))
            check_maps(row, camera, e, i, f"{key}_depth")
    assert parquet.read_table(out / "meta" / "tasks.parquet").to_pylist() == [{"task_index": 0, "task": "look"}]


def test_steps_of_rlds_keep_every_number(tmp_path: Path) -> None:
    source = tmp_path / "1.0.0"
    writers.write_rlds(source, known.episodes(1, lens=False))
    out = enrich(source, tmp_path / "set", "data=rlds", f"fps={FPS}")
    rows, key = read_rows(out), "observation.images.image_0"
    said = parquet.read_table(out / "meta" / "tasks.parquet").to_pylist()
    assert len(rows) == sum(LENGTHS)
    for index, (row, (e, i)) in enumerate(zip(rows, known.rows(), strict=True)):
        own = {"index": index, "episode_index": e, "frame_index": i, "timestamp": np.float32(i / FPS)}
        own |= {"is_last": i == LENGTHS[e] - 1, "action": 1000 * e + 7 * i + np.arange(7)}
        own |= {"observation.image_0_intrinsics": known.intrinsics(1, e, i)}
        hold(row, own | {"observation.image_0_T_world_from_cam": (known.pose(1, e, i), 1e-6)})
        assert np.array_equal(pixels(row[key]["bytes"]), known.picture(1, e, i))
        check_maps(row, 1, e, i, f"{key}_depth")
        assert row[key]["bytes"] in next(source.glob("*.tfrecord*")).read_bytes(), "not encoded again"
    about = read_lines(out / "meta" / "source_episodes.jsonl")
    assert [(row["split"], row["number"], row["episode_id"]) for row in about] == [("train", 0, -1), ("train", 1, -1)]
    few, tasks = RldsSource(data.open_all(source, "rlds"), [0, 1], FPS, 9), ["before"]
    tables = [table for k in range(2) for table in few.batches(k, tasks)]
    assert (
        [table.num_rows for table in tables] == [8, 1] * 2
        and tasks[0] == "before"
        and len(tasks) == 1 + len({*tasks[1:]})
    )
    texts = [tasks[k] for table in tables for k in table["task_index"].to_pylist()]
    assert texts == [said[row["task_index"]]["task"] for row in rows[:9] + rows[LENGTHS[0] :]]


def test_nerfstudio_folders_are_of_their_own_camera_and_episode(tmp_path: Path) -> None:
    known.write_robot(tmp_path / "source")
    out = enrich(tmp_path / "source", tmp_path / "out", "format=nerfstudio")
    folders = {(c, e): folder for folder in out.rglob("transforms.json") for c, e in [whose(folder.parent)]}
    assert folders.keys() == {(c, e) for c in range(2) for e in range(2)}
    for (camera, e), file in folders.items():
        content = read_json(file)
        assert content["camera_model"] == "OPENCV" and content["depth_unit_scale_factor"] == 1e-3
        assert len(content["frames"]) == LENGTHS[e]
        for i, shot in enumerate(content["frames"]):
            K, z, sigma = (of(camera, e, i) for of in (known.intrinsics, stored_depth, stored_sigma))
            lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), ((x, 1e-7) for x in map(float, LENS)), strict=True))
            own = {"w": HW[1], "h": HW[0], "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
            own |= {"timestamp": (i / FPS, 1e-6), **(lens if camera else {})}
            hold(shot, own | {"transform_matrix": (known.pose(camera, e, i) @ np.diag([1, -1, -1, 1]), 1e-7)})
            assert camera or not any(shot.get(k) for k in lens)
            steps = pixels(file.parent / shot["depth_file_path"])
            same(steps, np.rint(z / 1e-3))
            relative = np.divide(sigma, z, where=z > 0, out=np.zeros_like(z))
            same(pixels(file.parent / shot["confidence_file_path"]), np.where(z > 0, 25.5 / (0.1 + relative), 0), 0.6)
            same(pixels(file.parent / shot["dhtorch_source_file_path"]), z > 0)
            assert np.array_equal(pixels(file.parent / shot["file_path"]), known.picture(camera, e, i))
        check_points(file.parent / content["ply_file_path"], camera, e)


def whose(folder: Path) -> tuple[int, int]:
    """Camera and episode of a folder by its name."""
    return CAMERAS.index(folder.name), int(folder.parent.name.removeprefix("episode_"))


def project(xyz: Array, camera: int, e: int, i: int) -> tuple[Array, Array]:
    """Points of the world (P, 3) -> pixels (P, 2) by OpenCV's formulas, and depth (P,)."""
    T = np.linalg.inv(known.pose(camera, e, i))
    x, y, z = T[:3, :3] @ xyz.T + T[:3, 3:]
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = LENS if camera else (0.0,) * 5
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    u = x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    v = y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y
    K = known.intrinsics(camera, e, i)
    return np.stack((K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]), 1), z


def check_points(file: Path, camera: int, e: int) -> None:
    """Every return of every frame is a point, in the colour of its pixel."""
    points = read_ply(file)
    xyz, rgb = (np.stack([points[name] for name in part], 1) for part in (("x", "y", "z"), ("red", "green", "blue")))
    counts = [int((known.depth(camera, e, i) > 0).sum()) for i in range(LENGTHS[e])]
    assert len(points) == sum(counts)
    ends = np.cumsum([0, *counts])
    for i, (start, end) in enumerate(itertools.pairwise(ends)):
        v, u = np.nonzero(known.depth(camera, e, i))
        at, z = project(xyz[start:end].astype(np.float64), camera, e, i)
        same(at, np.stack((u, v), 1), 2e-3)
        same(z, stored_depth(camera, e, i)[v, u], 1e-5)
        assert np.array_equal(rgb[start:end], known.picture(camera, e, i)[v, u])


# ------------------------------------------------------------------------------------------------------ complete


@pytest.fixture(scope="module")
def completed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of the second camera in its second episode, completed, with their points; its files are counted from 1."""
    root = tmp_path_factory.mktemp("completed")
    writers.write_nerfstudio(root / "source", known.episodes(1)[1][:4])
    words = [*FEW, "planes=8", "refinements=1", "steps=[30]", "figures=false", "points=all", "arrays=true"]
    assert main(["complete", str(root / "source"), f"out={root / 'out'}", *words, "format=frames"]) == 0
    return root / "out"


def test_what_complete_writes_is_stored(completed: Path) -> None:
    stored_outputs.check("complete", completed.parent, folder=completed)


def test_complete_writes_the_numbers_of_every_frame(completed: Path) -> None:
    about, poses = read_json(completed, "meta.json"), np.loadtxt(completed / "poses.txt").reshape(-1, 4, 4)
    assert about["depth_scale"] == 1000 and about["invalid"] == [0] and len(about["K_frames"]) == len(poses) == 4
    same(about["dist"], LENS, 1e-7)
    same(np.loadtxt(completed / "K.txt"), known.intrinsics(1, 1, 0))
    same(about["K"], known.intrinsics(1, 1, 0))
    for i in range(4):
        K, T, z, time = (of(1, 1, i) for of in (known.intrinsics, known.pose, known.depth, known.time))
        hold(
            {k: about[k][i] for k in ("K_frames", "times")},
            {"K_frames": K[[0, 1, 0, 1], [0, 1, 2, 2]], "times": (time, 1e-6)},
        )
        same(poses[i], T, 1e-7)
        row = read_json(completed, "meta", f"{i + 1:06d}.json")
        own = {
            "K": K,
            "T_world_from_cam": (T, 1e-7),
            "distortion": (np.array(LENS), 1e-7),
            "hw": list(HW),
            "frame": i + 1,
        }
        own |= {"time": (time, 1e-6), "unit_m": 1e-3, "sigma_unit_m": 2e-4}
        own["pixels"] = {"none": int((z == 0).sum()), "sensor": int((z > 0).sum()), "swept": 0}
        hold(row, own)
        assert i + 1 not in row["views"]
        depth, sigma, source, image = (
            pixels(completed / kind / f"{i + 1:06d}.png") for kind in ("depth", "sigma", "source", "images")
        )
        same(depth, np.rint(1e3 * z.astype(np.float64)))
        same(sigma, np.rint(SIGMA_REL * z.astype(np.float64) / 2e-4), 1)  # on the edge of two steps
        same(source, z > 0)
        assert np.array_equal(image, known.picture(1, 1, i))
        arrays = np.load(completed / "arrays" / f"{i + 1:06d}.npz")
        same(np.nan_to_num(arrays["depth"]), z)
        same(np.nan_to_num(arrays["sigma"]), SIGMA_REL * z, 1e-7)
        same(arrays["source"], z > 0)


def test_points_and_mesh_of_complete_are_those_of_their_frame(completed: Path) -> None:
    for i in range(4):
        z = np.rint(1e3 * known.depth(1, 1, i).astype(np.float64)) / 1e3
        v, u = np.nonzero(z)
        points = read_ply(completed / "points" / f"{i + 1:06d}.ply")
        xyz = np.stack([points[a] for a in "xyz"], 1).astype(np.float64)
        T = known.pose(1, 1, i)
        at, depth = project(xyz @ T[:3, :3].T + T[:3, 3], 1, 1, i)
        same(at, np.stack((u, v), 1), 2e-3)
        same(depth, z[v, u], 1e-5)
        rgb = np.stack([points[name] for name in ("red", "green", "blue")], 1)
        assert np.array_equal(rgb, known.picture(1, 1, i)[v, u])
        same(points["sigma"], SIGMA_REL * z[v, u], 1.01e-4)  # half a step of the file
        same(points["source"], np.ones(len(points)))
        (node,), arrays = read_glb(completed / "points" / f"{i + 1:06d}.glb")
        assert node["rotation"] == [1, 0, 0, 0], "y up"
        (mesh,) = arrays
        corners = mesh["POSITION"][mesh["indices"].reshape(-1, 3)]
        assert len(corners) > 5000 and {*map(tuple, mesh["POSITION"].tolist())} <= {*map(tuple, xyz.tolist())}
        same(mesh["COLOR_0"], linear(rgb), 1e-6)
        # neighbouring pixels of one slanted wall: no triangle is longer than two pixels
        assert np.ptp(corners, axis=1).max() < 2.5 * z.max() / known.intrinsics(1, 1, i)[0, 0]


# ------------------------------------------------------------------------------------------------------- extract


def test_rows_of_extract_are_those_of_their_frames(tmp_path: Path) -> None:
    known.write_robot(tmp_path / "source")
    words = ["data=lerobot", f"data.root={tmp_path / 'source'}", f"data.camera={KEYS[1]}", "extract.shard_rows=7"]
    assert main(["extract", *words, "extract.gap=1", *FEW, f"out={tmp_path / 'out'}"]) == 0
    rows = [r for f in sorted((tmp_path / "out").glob("*.parquet")) for r in parquet.read_table(f).to_pylist()]
    assert len(rows) == sum(LENGTHS)
    for row, (e, i) in zip(rows, known.rows(), strict=True):
        assert (row["episode_index"], row["frame_index"]) == (e, i) and row["timestamp"] == np.float32(i / FPS)
        assert row["recording"].endswith(f"episode_{e:06d}/{CAMERAS[1]}")
        uv = np.asarray(row["uv"])
        u, v = np.floor(uv + 0.5).astype(int).T  # of the nearest pixel
        z, is_sensor = known.depth(1, e, i)[v, u], np.asarray(row["source"]) == Source.SENSOR
        assert np.array_equal(is_sensor, z > 0) and len(u) == 64
        valid, hole = np.asarray(row["valid"]), np.asarray(row["hole"])
        assert np.array_equal(valid, np.asarray(row["source"]) != Source.NONE)
        assert np.array_equal(hole == Hole.NONE, is_sensor)
        same(np.asarray(row["depth"])[is_sensor], z[is_sensor])
        same(np.asarray(row["sigma"])[is_sensor], SIGMA_REL * z[is_sensor], 1e-7)
        xyz, T = np.asarray(row["xyz"]), known.pose(1, e, i)
        assert not xyz[~valid].any() and not np.asarray(row["depth"])[~valid].any()
        at, depth = project(xyz[valid] @ T[:3, :3].T + T[:3, 3], 1, e, i)
        same(at, uv[valid], 5e-3)
        same(depth, np.asarray(row["depth"])[valid], 1e-5)
        check_tokens(row, *uv.T, valid)
        if not row["pose_ok"]:
            same(row["T_1_from_0"], np.zeros((4, 4)))
            same(row["pose_cov"], np.zeros((6, 6)))
        if i == 0:
            assert not row["pose_ok"] and (np.asarray(row["gate"]) == Gate.NO_TRACK).all()


def check_tokens(row: dict[str, Any], u: Array, v: Array, valid: Array) -> None:
    """Tokens of the 16 x 16 patches of a picture that is stretched to 224 x 224."""
    patch = ((v + 0.5) * 224 / HW[0] // 14 * 16 + (u + 0.5) * 224 / HW[1] // 14).astype(int)
    tokens, depth, sigma = (np.asarray(row[name]) for name in ("tokens", "depth", "sigma"))
    hole = np.asarray(row["hole"])
    for k, token in enumerate(tokens):
        inside = patch == k
        there = inside & valid
        assert row["tokens_valid"][k] == there.any()
        want = np.zeros(3 + tokens.shape[1] - 3)
        if there.any():
            inverse, noise = 1 / depth[there], sigma[there] / depth[there] ** 2
            want[:2] = inverse.mean(), np.sqrt((noise**2).mean() + inverse.var())
        if inside.any():
            want[2] = valid[inside].mean()
            want[3:] = np.bincount(hole[inside], minlength=len(want) - 3) / inside.sum()
        same(token, want, 1e-5)
