"""Features of a whole data set: right rows, once each, whoever makes them and whatever interrupts it."""

import itertools
import os
import signal
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from pyarrow import parquet
from support import writers
from support.processes import start, stop

import dhtorch
from dhtorch import data
from dhtorch.cli.run import main
from dhtorch.extract import FeatureTable, JoinedDataset, engines
from dhtorch.geometry import camera as cam
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.transforms import ExtendDepth, ExtendedDataset

HW, GAP, N, NEAR = (72, 96), 2, 128, 2.5
LENGTHS = (5, 4, 3)
PAPER = ["method=paper", f"method.n={N}", "method.hypotheses=20"]
CAMERA = "observation.images.front"


@pytest.fixture(scope="module")
def shots():
    """Frames of the synthetic room, whose sensor sees no farther than NEAR."""
    room = SyntheticRoom(hw=HW, n_frames=sum(LENGTHS), lidar="exact", supersample=1)
    frames = [room[i] for i in range(len(room))]
    return [frame.replace(depth=torch.where(frame.depth <= NEAR, frame.depth, 0.0)) for frame in frames]


@pytest.fixture(scope="module")
def robot(tmp_path_factory, shots):
    """A LeRobot v3 data set of three episodes through the synthetic room."""
    root = tmp_path_factory.mktemp("robot") / "set"
    root.mkdir()
    starts = np.cumsum((0, *LENGTHS))
    writers.write_lerobot(root, [shots[a:b] for a, b in itertools.pairwise(starts)], depth="tiff")
    return root


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """``dhtorch extract`` in this process, from an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)

    def call(*args):
        code = main(["extract", *args])
        return (code, *capsys.readouterr())

    return call


def asked(root, *more, out="features", gap=GAP):
    place = ["data=lerobot", f"data.root={root}", f"out={out}"]
    return [*place, f"extract.gap={gap}", "extract.shard_rows=5", *PAPER, *more]


def files(folder):
    return sorted(Path(folder).glob("*.parquet"))


class Items(torch.utils.data.Dataset):
    """What a LeRobot loader hands out: rows of the data set's own table, with its pictures."""

    def __init__(self, root):
        self.table = parquet.read_table(next(root.glob("data/*/*.parquet"))).to_pydict()
        self.recordings = data.open_all(root)

    def __len__(self):
        return len(self.table["index"])

    def __getitem__(self, i):
        if not 0 <= i < len(self):
            raise IndexError(i)
        episode, number = self.table["episode_index"][i], self.table["frame_index"][i]
        frame = self.recordings[episode][number]
        return {
            CAMERA: frame.image[0],
            "depth": frame.depth[0],
            "intrinsics": cam.to_matrix(frame.camera)[0],
            "episode_index": torch.tensor(episode),
            "frame_index": torch.tensor(number),
            "timestamp": torch.tensor(self.table["timestamp"][i]),
        }


def live(root, **options):
    """The transform in a loader over the same frames."""
    method = dhtorch.PAPER.replace(hypotheses=20)
    views = {"image": CAMERA, "other_image": "other", "depth_unit": "m", "tokens_hw": (224, 224), "prefix": "dhtorch."}
    return ExtendedDataset(Items(root), ExtendDepth(method=method, n=N, **views, **options), gap=GAP)


def test_rows_are_those_of_the_transform_in_a_loader(robot, command):
    code, out, err = command(*asked(robot))
    assert code == 0 and err == "", err
    assert "features: 3 shards, 12 rows" in out and "6 no second view" in out
    features, expected = FeatureTable("features"), live(robot)
    assert repr(features).startswith("FeatureTable(") and "tokens" in repr(features)
    joined = JoinedDataset(Items(robot), features)
    assert len(features) == len(joined) == sum(LENGTHS)
    with torch.no_grad():
        for i in range(len(joined)):
            mine, theirs = joined[i], expected[i]
            assert mine.keys() == theirs.keys()
            for key, value in theirs.items():
                assert mine[key].dtype == value.dtype or not key.startswith("dhtorch."), key
                assert torch.equal(mine[key], value), (i, key)
    recovered = sum(int((row["dhtorch.source"] == 2).sum()) for row in features)
    sensed = sum(int((row["dhtorch.source"] == 1).sum()) for row in features)
    assert recovered > 75 and sensed > 400, "an empty answer would compare equal as well"
    assert sum(int(row["dhtorch.pose_ok"]) for row in features) == 6


@pytest.fixture
def many(tmp_path, shots):
    """Numbered frames on the disk, each a shard."""
    writers.write_counted_frames(tmp_path / "set", shots)
    place = ["data=auto", f"data.root={tmp_path / 'set'}", "out=features"]
    return [*place, "extract.gap=2", "extract.shard_rows=1", *PAPER]


@pytest.mark.slow
def test_ctrl_c_from_a_terminal_ends_the_workers_quietly(tmp_path, many):
    process = start(tmp_path, "extract", *many, "workers=2")
    code = stop(process, partial(files, tmp_path / "features"), 2, signal.SIGINT)
    err = (tmp_path / "err").read_text()
    assert code == 130 and "Traceback" not in err and len(without_notes(err)) == 1, err
    assert "complete and stay" in err


def without_notes(err):
    """The lines of stderr beside the note on the unit that numbered frames do not state."""
    return [line for line in err.splitlines() if line != "set: depth unit assumed: 1/1000 m (data.depth_unit= sets it)"]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["data=lerobot", "data.root=nowhere", "out=x"], ["nowhere", "no such file"]),
        (["data=lerobot", "out=x"], ["data.root"]),
        (["data.n_frames=3"], ["out"]),
        (["out=x", "extract.engine=dask"], ["extract.engine", "dask", "local, ray"]),
        (["out=x", "extract.tokens_hw=null"], ["extract.tokens_hw", "expected"]),
        (["out=x", "extract.shardrows=4"], ["shardrows"]),
        (["out=x", "data.n_frames=3", "extract.dense={sise: 48}"], ["extract.dense: found 'sise'"]),
        (["out=x", "data.n_frames=3", "extract.gap=-1"], ["extract.gap: found -1, expected a whole number of at least 0"]),
        (["out=file", "data.n_frames=3"], ["file", "expected a folder"]),
        (["out=file/below", "data.n_frames=3"], ["file"]),
        (["out=x", "method=map", "method.views=5", "extract.gap=3"], ["views", "5"]),
        (["--outt", "x"], ["--outt", "unknown option"]),
    ],
)  # fmt: skip
def test_bad_input_gets_one_clear_line(command, args, words):
    Path("file").write_text("")
    code, _, err = command(*args)
    assert code == 2 and "Traceback" not in err and len(err.strip().splitlines()) == 1, err
    assert all(word in err for word in words), err
    assert not files("x")


@pytest.mark.parametrize(
    ("module", "more", "words"),
    [
        ("pyarrow.parquet", [], "pip install pyarrow\n"),
        ("ray", ["data.hw=[60,80]", "extract.engine=ray"], "dhtorch[scale]"),
    ],
)
def test_a_missing_library_is_named(module, more, words, command, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    code, _, err = command("out=x", "data.n_frames=3", *more)
    assert code == 2 and words in err and len(err.strip().splitlines()) == 1


def test_a_killed_worker_is_said(monkeypatch):
    class Deadly(torch.utils.data.Dataset):
        def __len__(self):
            return 4

        def __getitem__(self, i):
            os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ChildProcessError, match="memory for 1 workers"):
        list(engines.run_local(Deadly(), range(4), 1))


def seen(paths):
    return {p.name: (p.read_bytes(), p.stat().st_ino, p.stat().st_mtime_ns) for p in paths}


def contents(folder):
    return {p.name: p.read_bytes() for p in files(folder)}


@pytest.mark.slow
def test_workers_make_the_same_files(robot, command):
    assert command(*asked(robot))[0] == 0
    code, _, err = command(*asked(robot, "workers=2", out="other"))
    assert code == 0 and err == "", err
    assert contents("features") == contents("other") and len(files("other")) == 3


@pytest.mark.slow
def test_kill_9_in_the_middle_loses_and_doubles_nothing(tmp_path, many, command):
    """With a worker; then the same command again."""
    args = [*many, "workers=1"]
    process = start(tmp_path, "extract", *args)
    assert stop(process, partial(files, tmp_path / "features"), 3, signal.SIGKILL) == -signal.SIGKILL, (
        tmp_path / "err"
    ).read_text()
    before = seen(files("features"))
    assert 3 <= len(before) < 12
    assert all(parquet.read_table(Path("features") / name).num_rows == 1 for name in before)
    code, out, err = command(*args)
    assert code == 0, err
    assert f"12 shards ({len(before)} left untouched), 12 rows" in out
    after = seen(files("features"))
    assert {k: after[k] for k in before} == before, "what was finished is untouched"
    assert FeatureTable("features", ["depth"]).place["frame_index"].tolist() == list(range(12)), (
        "none lost, none doubled"
    )
    assert [p.name for p in (Path("features") / ".dhtorch").iterdir()] == ["manifest"]
    assert command(*[a.replace("out=features", "out=whole") for a in args])[0] == 0
    assert contents("whole") == contents("features"), "the same as without the kill"


@pytest.fixture
def damaged(tmp_path, shots):
    """Numbered frames, the fourth with half an image."""
    writers.write_counted_frames(tmp_path / "set", shots[:8])
    image = tmp_path / "set" / "images" / "00003.png"
    image.write_bytes(image.read_bytes()[:500])
    place = ["data=auto", f"data.root={tmp_path / 'set'}", "out=features"]
    return [*place, "extract.gap=2", "extract.shard_rows=3", *PAPER]


def test_a_corrupt_frame_raises_in_one_line(damaged, command):
    code, _, err = command(*damaged, "workers=1")
    assert code == 2 and "Traceback" not in err and len(without_notes(err)) == 1, err
    assert all(word in err for word in ("frame 3", "00003.png", "expected", "extract.on_error=skip")), err
    assert [p.name for p in files("features")] == ["shard-00000.parquet"], "what was whole before it stays"
    assert [p.name for p in Path("features").glob(".*")] == [".dhtorch"]
