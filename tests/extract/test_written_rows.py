"""Every number of an enriched set stands in the row of its own frame and camera: rows, tables and folders of few pixels."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from support.stub_recordings import Load, frame, recording
from support.stub_samples import FixedEstimate, H, N, Stub, W

pytest.importorskip("pyarrow")
import pyarrow as pa
import pyarrow.parquet as parquet

from dhtorch.data.io.decode import decode_image
from dhtorch.extract import plan
from dhtorch.extract.engines import filter_rows
from dhtorch.extract.enriched import DatasetCamera, MapRowDataset, map_columns
from dhtorch.extract.nerf_target import NerfstudioTarget
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.shards import write_shard
from dhtorch.extract.step_set import RldsSource
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.records import Pose

#: Frames of a camera, more than a table takes at a time.
M = 10

SHARED = {"codes": {"problem": {str(k): str(k) for k in range(32)}}}


def moving(first, name, n=M, **options):
    """A scene of ``n`` frames with poses, times and pictures that no other frame of any camera has."""
    t = torch.stack([torch.tensor([0.1 * (first + i), 0.2, -0.01 * i]) for i in range(n)]).double()
    turns = torch.tensor([[0.0, 0.02 * (first + i), 0.0, 0.0, 0.0, 0.0] for i in range(n)], dtype=torch.float64)
    times = (torch.arange(n) * 0.25 + first).double()
    load = Load(first, **options)
    return recording(n, name=name, load=load, poses=Pose(se3.exp(turns).R, t), times=times, camera_name=name)


def written_cameras(folder, scenes, views, on_error="raise"):
    """Rows of two cameras of one episode as a worker returns them, and their shards by camera."""
    whole, wanted = plan.make_plan(scenes, 1, 1, rigs=True), map_columns(pictures=True, n=N)
    method = Stub(answer=FixedEstimate(), n=N)
    rows = MapRowDataset(scenes, whole, wanted, method=method, gap=1, step=2**-10, views=views)
    answers, parts = [rows[k] for k in range(len(rows))], {}
    for key, first in zip(views, (0, M), strict=True):
        shard = plan.ShardSpec(first, 8, range(first, first + M))
        write_shard(folder, shard, filter_rows(answers[first : first + M], on_error, rows, []), wanted, SHARED)
        parts[key] = [folder / shard.name]
    return answers, parts


@pytest.fixture(scope="module")
def two_cameras(tmp_path_factory):
    scenes = [moving(0, "left"), moving(40, "right")]
    views = {view.key: view for view in (DatasetCamera.of(scene, 64) for scene in scenes)}
    rows, parts = written_cameras(tmp_path_factory.mktemp("shards"), scenes, views)
    assert not [row.complaint for row in rows if row.complaint]
    return SimpleNamespace(scenes=scenes, views=views, rows=rows, parts=parts)


def test_a_row_is_that_of_its_own_frame(two_cameras):
    for n, row in enumerate(two_cameras.rows):
        scene, i = two_cameras.scenes[n // M], n % M
        recorded, columns = scene.recording, row.features
        assert row.place["recording"] == scene.name and row.place["frame_index"] == i
        assert row.place["timestamp"] == float(recorded.times[i])
        expected = se3.to_matrix(recorded.poses[i : i + 1])[0].flatten().numpy()
        assert np.array_equal(columns["pose"], expected)
        own = frame(40 * (n // M) + i)
        assert np.allclose(columns["K"], cam.to_matrix(own.camera)[0].double().flatten())
        assert np.array_equal(decode_image(columns["picture"], "a row"), own.image[0].numpy())


def lerobot(folder, views, **options):
    plain = {"origin": None, "numbers": [7, 8], "step": 2**-10, "maps": ("depth", "sigma", "source"), "fps": 5.0}
    return LeRobotTarget(folder, 3, views, **{**plain, "as_images": False, "task": None, "key": "k", "n": N, **options})


def test_a_table_of_two_cameras_holds_what_each_of_them_saw_and_counts_on(two_cameras, tmp_path):
    target = lerobot(tmp_path, two_cameras.views)
    first = target.assemble(0, [], two_cameras.parts)
    second = target.assemble(1, [first], two_cameras.parts)
    assert (first["start"], first["length"], second["start"], second["length"]) == (0, M, M, M)
    for k, start in enumerate((0, M)):
        table = parquet.read_table(target.file(k)).to_pydict()
        assert table["index"] == list(range(start, start + M)) and table["frame_index"] == list(range(M))
        assert table["episode_index"] == [k] * M and table["task_index"] == [0] * M
        assert np.allclose(table["timestamp"], np.arange(M) / 5)
        assert table["observation.time"] == [0.25 * i for i in range(M)]
        assert table["observation.frame_number"] == list(range(M))
        for n, name in enumerate(("left", "right")):
            images = [decode_image(cell["bytes"], "a cell") for cell in table[f"observation.images.{name}"]]
            for i, image in enumerate(images):
                own = two_cameras.rows[M * n + i].features
                assert np.array_equal(image, frame(40 * n + i).image[0].numpy()), (name, i)
                assert np.array_equal(table[f"observation.{name}.T_world_from_cam"][i], own["pose"])
                assert np.array_equal(table[f"observation.{name}.intrinsics"][i], own["K"])


@pytest.mark.parametrize("on_error", ["flag", "skip"])
def test_an_instant_with_an_unreadable_frame_takes_no_row(on_error, two_cameras, tmp_path):
    broken = [moving(0, "left", bad={1}), moving(40, "right")]
    _, parts = written_cameras(tmp_path, broken, two_cameras.views, on_error)
    target = lerobot(tmp_path / "out", two_cameras.views)
    assert target.assemble(0, [], parts)["length"] == M - 1
    table = parquet.read_table(target.file(0)).to_pydict()
    assert table["observation.frame_number"] == [0, *range(2, M)] and table["frame_index"] == list(range(M - 1))
    for cell, i in zip(table["observation.images.right"], (0, *range(2, M)), strict=True):
        assert np.array_equal(decode_image(cell["bytes"], "a cell"), frame(40 + i).image[0].numpy())


@pytest.mark.parametrize("lens", [(), (0.11, -0.05, 0.003, -0.002, 0.01)])
def test_a_nerfstudio_folder_states_the_lens_and_the_pose_of_every_picture(two_cameras, tmp_path, lens):
    (key, view), *_ = two_cameras.views.items()
    target = NerfstudioTarget(tmp_path, {key: replace(view, lens=lens)}, [{key: ""}], "k")
    target.assemble(0, [], two_cameras.parts)
    shots = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [shot["timestamp"] for shot in shots] == [0.25 * i for i in range(M)]
    for i, shot in enumerate(shots):
        own = two_cameras.rows[i].features
        assert tuple(shot.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")) == (lens or (0.0,) * 5)
        expected = own["pose"].reshape(4, 4) @ np.diag([1, -1, -1, 1])
        assert np.allclose(shot["transform_matrix"], expected)
        assert np.allclose((shot["fl_x"], shot["fl_y"]), own["K"][[0, 4]])
        assert np.allclose((shot["cx"], shot["cy"]), own["K"][[2, 5]] + 0.5)
        assert (shot["w"], shot["h"]) == (W, H)
        picture = decode_image((tmp_path / shot["file_path"]).read_bytes(), "a file")
        assert np.array_equal(picture, frame(i).image[0].numpy())


class Steps:
    """An episode of 19 steps whose numbers name their step; one feature is called as a column of every table."""

    n, instruction, about = 19, "text", {"split": "train", "number": 3}
    features: ClassVar = {
        "action": SimpleNamespace(kind="tensor", dtype="float32", shape=(2,)),
        "timestamp": SimpleNamespace(kind="tensor", dtype="float32", shape=(1,)),
        "text": SimpleNamespace(kind="text"),
        "note": SimpleNamespace(kind="text"),
        "observation/image_0": SimpleNamespace(kind="image"),
    }

    def values(self, name, steps):
        if name in ("text", "note"):
            return [f"{name} {i // 10}" for i in steps]
        if name == "observation/image_0":
            return [(b"\xff\xd8\xff\xe0", b"\x89PNG")[i % 2] for i in steps]
        size = self.features[name].shape[0]
        return np.stack([np.full(size, i, np.float32) + 100 * np.arange(size, dtype=np.float32) for i in steps])


def test_every_step_of_a_robot_has_its_own_values():
    tasks = ["text 1"]  # of an episode before
    source = RldsSource([None], [3], 10.0, cached={0: Steps()})
    tables = list(source.batches(0, tasks))
    assert [table.num_rows for table in tables] == [8, 8, 3]
    table = pa.concat_tables(tables).to_pydict()
    assert table["action"] == [[float(i), 100.0 + i] for i in range(19)]
    assert table["source.timestamp"] == [float(i) for i in range(19)]
    assert table["frame_index"] == list(range(19))
    assert np.allclose(table["timestamp"], np.arange(19) / 10)
    assert tasks == ["text 1", "text 0"] and table["task_index"] == [1] * 10 + [0] * 9
    assert table["note"] == [f"note {i // 10}" for i in range(19)] and "text" not in table
    ends = [cell["path"].rpartition(".")[2] for cell in table["observation.images.image_0"]]
    assert ends == [("jpg", "png")[i % 2] for i in range(19)], "as they are encoded"
    few = pa.concat_tables(RldsSource([None], [3], 10.0, 11, {0: Steps()}).batches(0, [])).to_pydict()
    assert few["frame_index"] == list(range(11)) and few["action"][10] == [10.0, 110.0]
