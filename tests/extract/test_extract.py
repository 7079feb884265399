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

import pyarrow
from omegaconf import OmegaConf
from pyarrow import parquet
from support import writers
from support.processes import start, stop

import dhtorch
from dhtorch import data, extract
from dhtorch.cli.run import config_dir, main
from dhtorch.extract import FeatureTable, JoinedDataset, columns, engines, shards
from dhtorch.geometry import camera as cam
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.transforms import ExtendDepth, ExtendedDataset, SampleProblem

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


def seen(paths):
    return {p.name: (p.read_bytes(), p.stat().st_ino, p.stat().st_mtime_ns) for p in paths}


def contents(folder):
    return {p.name: p.read_bytes() for p in files(folder)}


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


@pytest.mark.slow
def test_a_gap_of_zero_reads_no_second_view(robot, command):
    code, out, err = command(*asked(robot, "extract.columns=[depth]", gap=0))
    assert code == 0 and err == "" and "12 no second view" in out
    assert len(FeatureTable("features")) == sum(LENGTHS)
    code, _, err = command(*asked(robot, gap=-1))
    assert code == 2 and "extract.gap: found -1, expected a whole number of at least 0" in err


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


def test_rows_join_the_data_set_by_episode_and_frame(robot, command):
    assert command(*asked(robot))[0] == 0
    ours = pyarrow.concat_tables(parquet.read_table(p) for p in files("features"))
    theirs = parquet.read_table(
        next(robot.glob("data/*/*.parquet")), columns=["episode_index", "frame_index", "timestamp"]
    )
    order = list(zip(ours["episode_index"].to_pylist(), ours["frame_index"].to_pylist(), strict=True))
    assert order == sorted(order) == [(e, f) for e, n in enumerate(LENGTHS) for f in range(n)]
    pairs = ours.select(["episode_index", "frame_index", "timestamp"]).join(
        theirs, ["episode_index", "frame_index"], right_suffix="_theirs", join_type="inner"
    )
    assert pairs.num_rows == sum(LENGTHS)
    assert np.allclose(pairs["timestamp"], pairs["timestamp_theirs"], atol=1e-6)
    assert set(ours["recording"].to_pylist()) == {f"set/episode_{e:06d}/front" for e in range(3)}


def test_episodes_keep_their_numbers(robot, command):
    assert command(*asked(robot, "data.episode=[2,0]"))[0] == 0
    features = FeatureTable("features", ["tokens"])
    assert sorted(set(features.place["episode_index"])) == [0, 2] and len(features) == LENGTHS[0] + LENGTHS[2]
    assert features.at(2, 1).keys() == {"dhtorch.tokens"}
    with pytest.raises(KeyError, match="frame 0 of episode 1"):
        features.at(1, 0)


@pytest.mark.slow
def test_workers_make_the_same_files(robot, command):
    assert command(*asked(robot))[0] == 0
    code, _, err = command(*asked(robot, "workers=2", out="other"))
    assert code == 0 and err == "", err
    assert contents("features") == contents("other") and len(files("other")) == 3


@pytest.fixture
def many(tmp_path, shots):
    """Numbered frames on the disk, each a shard."""
    writers.write_counted_frames(tmp_path / "set", shots)
    return [
        "data=auto",
        f"data.root={tmp_path / 'set'}",
        "extract.gap=2",
        "out=features",
        "extract.shard_rows=1",
        *PAPER,
    ]


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


@pytest.mark.slow
def test_ctrl_c_leaves_whole_shards_and_says_how_to_go_on(robot, command, monkeypatch):
    real, calls = shards.write_shard, []

    def interrupted(*args):
        calls.append(1)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)
        return real(*args)

    monkeypatch.setattr(shards, "write_shard", interrupted)
    code, out, err = command(*asked(robot))
    assert code == 130 and "Traceback" not in err and out == ""
    assert (
        "interrupted: 1 of 3 shards in features are complete and stay; run the same command again for the rest" in err
    )
    before = seen(files("features"))
    assert len(before) == 1
    with pytest.raises(data.FormatError, match="found 1, expected 3: run the same dhtorch extract again"):
        FeatureTable("features")
    code, out, _ = command(*asked(robot))
    assert code == 0 and "3 shards (1 left untouched)" in out
    assert {k: v for k, v in seen(files("features")).items() if k in before} == before


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


@pytest.fixture
def damaged(tmp_path, shots):
    """Numbered frames, the fourth with half a picture."""
    writers.write_counted_frames(tmp_path / "set", shots[:8])
    image = tmp_path / "set" / "images" / "00003.png"
    image.write_bytes(image.read_bytes()[:500])
    return [
        "data=auto",
        f"data.root={tmp_path / 'set'}",
        "extract.gap=2",
        "out=features",
        "extract.shard_rows=3",
        *PAPER,
    ]


def test_a_corrupt_frame_raises_in_one_line(damaged, command):
    code, _, err = command(*damaged, "workers=1")
    assert code == 2 and "Traceback" not in err and len(without_notes(err)) == 1, err
    assert all(word in err for word in ("frame 3", "00003.png", "expected", "extract.on_error=skip")), err
    assert [p.name for p in files("features")] == ["shard-00000.parquet"], "what was whole before it stays"
    assert [p.name for p in Path("features").glob(".*")] == [".dhtorch"]


@pytest.mark.slow
def test_a_corrupt_frame_is_skipped_and_counted(damaged, command):
    code, out, err = command(*damaged, "extract.on_error=skip")
    assert code == 0 and not without_notes(err), err
    assert "7 rows" in out and "1 skipped" in out and "00003.png" in out
    assert "3 no second view" in out, "the two first, and the one whose other view cannot be read"
    assert FeatureTable("features").place["frame_index"].tolist() == [0, 1, 2, 4, 5, 6, 7]
    code, out, _ = command(*damaged, "extract.on_error=skip")
    assert "(3 left untouched), 7 rows" in out and "1 skipped" in out, "counts are kept with the shards"


def test_a_corrupt_frame_is_flagged_with_zeros(damaged, command):
    code, out, _ = command(*damaged, "extract.on_error=flag", "workers=1")
    assert code == 0 and "8 rows" in out and "1 unreadable" in out
    features = FeatureTable("features")
    assert [int(row["dhtorch.problem"]) for row in features] == [1, 1, 0, 3, 0, 1, 0, 0]
    row = features.at(0, 3)
    assert int(row.pop("dhtorch.problem")) == SampleProblem.UNREADABLE and all(not x.any() for x in row.values())
    assert np.isnan(features.place["timestamp"]).all(), "counted frames have no times"


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["data=lerobot", "data.root=nowhere", "out=x"], ["nowhere", "no such file"]),
        (["data=lerobot", "out=x"], ["data.root"]),
        (["data.n_frames=3"], ["out"]),
        (["out=x", "extract.engine=dask"], ["extract.engine", "dask", "local, ray"]),
        (["out=x", "extract.tokens_hw=null"], ["extract.tokens_hw", "expected"]),
        (["out=x", "extract.shardrows=4"], ["shardrows"]),
        (["out=file", "data.n_frames=3"], ["file", "expected a folder"]),
        (["out=file/below", "data.n_frames=3"], ["file"]),
        (["out=x", "method=window", "extract.gap=3"], ["views", "5"]),
        (["--outt", "x"], ["--outt", "unknown option"]),
    ],
)  # fmt: skip
def test_bad_input_gets_one_clear_line(command, args, words):
    Path("file").write_text("")
    code, _, err = command(*args)
    assert code == 2 and "Traceback" not in err and len(err.strip().splitlines()) == 1, err
    assert all(word in err for word in words), err
    assert not files("x")


@pytest.mark.slow
def test_a_recording_without_a_gap_asks_for_one(robot, command):
    code, _, err = command("data=lerobot", f"data.root={robot}", "extract.gap=null", "out=x", *PAPER)
    assert code == 2 and "extract.gap" in err and "0 = front end only" in err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written(robot, command):
    Path("features").mkdir(mode=0o500)
    code, _, err = command(*asked(robot))
    assert code == 2 and "Permission denied" in err and "features" in err


@pytest.mark.slow
def test_a_full_disk_is_one_line(robot, command, monkeypatch):
    real = columns.arrow_table

    def full(rows, *args):
        if rows[0]["frame_index"]:
            raise OSError(28, "No space left on device")
        return real(rows, *args)

    monkeypatch.setattr(shards, "_MAX_GROUP_ROWS", 1)
    monkeypatch.setattr(shards, "arrow_table", full)
    code, _, err = command(*asked(robot))
    assert code == 2 and "No space left" in err and not Path("features").exists(), err


@pytest.mark.slow
def test_shards_of_another_extraction_are_not_mixed(robot, command, tmp_path):
    assert command(*asked(robot))[0] == 0
    before = seen(files("features"))
    for other, words in (
        ("seed=1", "seed 0 there, 1 here"),
        ("data.episode=0", "data.episode None there, 0 here"),
    ):
        code, _, err = command(*asked(robot, other))
        assert code == 2 and words in err and "another extraction" in err and len(err.strip().splitlines()) == 1, err
    assert seen(files("features")) == before


def test_a_missing_pyarrow_is_named(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    code, _, err = command("out=x", "data.n_frames=3")
    assert code == 2 and err.strip().endswith("pip install pyarrow") and len(err.strip().splitlines()) == 1


def test_a_missing_ray_names_the_extra(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    code, _, err = command("out=x", "data.n_frames=3", "data.hw=[60,80]", "extract.engine=ray")
    assert code == 2 and "ray" in err and "dhtorch[scale]" in err and len(err.strip().splitlines()) == 1


def test_a_killed_worker_is_said(monkeypatch):
    class Deadly(torch.utils.data.Dataset):
        def __len__(self):
            return 4

        def __getitem__(self, i):
            os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ChildProcessError, match="memory for 1 workers"):
        list(engines.run_local(Deadly(), range(4), 1))


def test_a_method_of_many_views_looks_back_several_times(command):
    window = ["data.hw=[72,96]", "data.n_frames=6", "data.supersample=1", "data.lidar=exact", "method=window"]
    code, out, err = command(*window, "method.n=64", "method.views=2", "extract.gap=3", "out=window")
    assert code == 0 and "6 rows" in out, err
    problems = [int(row["dhtorch.problem"]) for row in FeatureTable("window")]
    assert problems == [1, 1, 0, 0, 0, 0], "the nearer view, two frames back, is there before the farther one"


@pytest.mark.slow
def test_without_a_gap_the_method_chooses_among_earlier_frames(command):
    room = ["data.hw=[120,160]", "data.n_frames=6", "data.supersample=1", "data.step_m=0.04", "data.lidar=exact"]
    room += ["method.n=256", "extract.columns=[T_1_from_0,pose_ok,problem]"]
    code, out, err = command(*room, "out=chosen")
    assert code == 0 and "6 rows" in out, err
    rows = list(FeatureTable("chosen"))
    assert [int(row["dhtorch.problem"]) for row in rows] == [1, 0, 0, 0, 0, 0], "the first has none before it"
    command(*room, "extract.gap=1", "out=one")
    gap = list(FeatureTable("one"))
    assert all(torch.equal(rows[1][k], gap[1][k]) for k in gap[1]), "one earlier frame is asked as a pair"
    length = {k: float(found[5]["dhtorch.T_1_from_0"][:3, 3].norm()) for k, found in (("chosen", rows), ("one", gap))}
    assert rows[5]["dhtorch.pose_ok"] and length["chosen"] > 2 * length["one"], "a wider one is worth more"


def test_settings_are_the_defaults():
    cfg = OmegaConf.to_container(OmegaConf.load(config_dir() / "extract.yaml"))["extract"]
    assert cfg.pop("_target_") == "dhtorch.extract.ExtractOptions"
    defaults = {k: f.default for k, f in extract.ExtractOptions.__dataclass_fields__.items()}
    assert cfg == {k: list(v) if isinstance(v, tuple) else v for k, v in defaults.items()}
