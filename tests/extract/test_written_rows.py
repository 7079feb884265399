"""Every number of an enriched set stands in the row of its own frame and camera: rows, tables and folders of few pixels."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from support.stub_recordings import Load, frame, recording
from support.stub_samples import FixedEstimate, N, Stub

pytest.importorskip("pyarrow")
import pyarrow as pa
import pyarrow.parquet as parquet

from dhtorch.data.io.decode import decode_image
from dhtorch.extract import plan
from dhtorch.extract.engines import filter_rows
from dhtorch.extract.enriched import DatasetCamera, MapRowDataset, map_columns
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.shards import write_shard
from dhtorch.extract.step_set import RldsSource
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
    """Shards by camera of two cameras of one episode."""
    whole, wanted = plan.make_plan(scenes, 1, 1, rigs=True), map_columns(pictures=True, n=N)
    method = Stub(answer=FixedEstimate(), n=N)
    rows = MapRowDataset(scenes, whole, wanted, method=method, gap=1, step=2**-10, views=views)
    answers, parts = [rows[k] for k in range(len(rows))], {}
    for key, first in zip(views, (0, M), strict=True):
        shard = plan.ShardSpec(first, 8, range(first, first + M))
        write_shard(folder, shard, filter_rows(answers[first : first + M], on_error, rows, []), wanted, SHARED)
        parts[key] = [folder / shard.name]
    return parts


@pytest.mark.parametrize("on_error", ["flag", "skip"])
def test_an_instant_with_an_unreadable_frame_takes_no_row(on_error, tmp_path):
    scenes = [moving(0, "left", bad={1}), moving(40, "right")]
    views = {view.key: view for view in (DatasetCamera.of(scene, 64) for scene in scenes)}
    parts = written_cameras(tmp_path, scenes, views, on_error)
    plain = {"origin": None, "numbers": [7, 8], "step": 2**-10, "maps": ("depth", "sigma", "source"), "fps": 5.0}
    target = LeRobotTarget(tmp_path / "out", 3, views, **plain, as_images=False, task=None, key="k", n=N)
    first = target.assemble(0, [], parts)
    second = target.assemble(1, [first], parts)
    assert (first["start"], first["length"], second["start"], second["length"]) == (0, M - 1, M - 1, M - 1)
    kept = [0, *range(2, M)]
    for k in range(2):
        table = parquet.read_table(target.file(k)).to_pydict()
        assert table["index"] == [k * (M - 1) + i for i in range(M - 1)] and table["episode_index"] == [k] * (M - 1)
        assert table["observation.frame_number"] == kept and table["frame_index"] == list(range(M - 1))
        assert table["observation.time"] == [0.25 * i for i in kept]
        assert np.allclose(table["timestamp"], np.arange(M - 1) / 5)
        for cell, pose, i in zip(
            table["observation.images.right"], table["observation.right.T_world_from_cam"], kept, strict=True
        ):
            assert np.array_equal(decode_image(cell["bytes"], "a cell"), frame(40 + i).image[0].numpy())
            assert np.array_equal(pose, se3.to_matrix(scenes[1].recording.poses[i : i + 1])[0].flatten())


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
