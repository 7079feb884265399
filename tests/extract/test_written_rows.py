"""Every number of an enriched set stands in the row of its own frame and camera: rows, tables and folders of few pixels."""

import numpy as np
import pytest
import torch
from support.stub_recordings import Load, frame, recording
from support.stub_samples import FixedEstimate, N, Stub

pytest.importorskip("pyarrow")
import pyarrow.parquet as parquet

from dhtorch.data.io.decode import decode_image
from dhtorch.extract import plan
from dhtorch.extract.engines import filter_rows
from dhtorch.extract.enriched import DatasetCamera, MapRowDataset, map_columns
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.shards import write_shard
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
