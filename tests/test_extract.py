"""Features of a whole data set: right rows, once each, whoever makes them and whatever interrupts it."""

import itertools
import json
import os
import pickle
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
from hydra.utils import instantiate
from omegaconf import OmegaConf
from processes import start, stop
from pyarrow import parquet

from dhtorch import data, extract
from dhtorch.data import writers
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.extract import Features, JoinedDataset, columns, engines, plan, shards
from dhtorch.geometry import camera as cam
from dhtorch.pair import METHODS
from dhtorch.run import config_dir, main
from dhtorch.transform import CHANNELS, ExtendDepth, ExtendedDataset, Problem

HW, GAP, N = (72, 96), 2, 128
LENGTHS = (5, 4, 3)
PAPER = ["method=paper", f"method.n={N}", "method.hypotheses=20"]
CAMERA = "observation.images.front"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """A LeRobot v3 data set of three episodes through the synthetic room."""
    root = tmp_path_factory.mktemp("robot") / "set"
    root.mkdir()
    room = SyntheticRoom(hw=HW, n_frames=sum(LENGTHS), lidar="exact", supersample=1)
    starts = np.cumsum((0, *LENGTHS))
    episodes = [[room[i] for i in range(a, b)] for a, b in itertools.pairwise(starts)]
    writers.write_lerobot(root, episodes, depth="tiff")
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
    return ["data=lerobot", f"data.root={root}", f"data.gap={gap}", f"out={out}", "extract.shard_rows=5", *PAPER, *more]


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
    method = instantiate(OmegaConf.create({"_target_": "dhtorch.pair.extend", "_partial_": True, "hypotheses": 20}))
    views = {"image": CAMERA, "other_image": "other", "depth_unit": "m", "tokens_hw": (224, 224)}
    return ExtendedDataset(Items(root), ExtendDepth(method=method, n=N, **views, **options), gap=GAP)


def test_rows_are_those_of_the_transform_in_a_loader(robot, command):
    code, out, err = command(*asked(robot))
    assert code == 0 and err == "", err
    assert "features: 3 shards, 12 rows" in out and "6 no second view" in out
    features, expected = Features("features"), live(robot)
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
    assert sensed > 100, "an empty answer would compare equal as well"
    assert recovered >= 0 and any(bool(row["dhtorch.pose_ok"]) for row in features)


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
    features = Features("features", ["tokens"])
    assert sorted(set(features.place["episode_index"])) == [0, 2] and len(features) == LENGTHS[0] + LENGTHS[2]
    assert features.at(2, 1).keys() == {"dhtorch.tokens"}
    with pytest.raises(KeyError, match="frame 0 of episode 1"):
        features.at(1, 0)


def test_the_schema_says_what_the_columns_mean(robot, command):
    assert command(*asked(robot))[0] == 0
    path = files("features")[0]
    schema = parquet.read_schema(path)
    assert schema.field("uv").type == pyarrow.list_(pyarrow.list_(pyarrow.float32(), 2), N)
    assert schema.field("tokens").type == pyarrow.list_(pyarrow.list_(pyarrow.float32(), len(CHANNELS)), 256)
    for field in schema:
        assert field.metadata[b"unit"] and field.metadata[b"about"] and not field.nullable, field.name
    shared, own = shards.described(path)
    assert shared["codes"]["hole"]["1"] == "TRACKABLE_NO_LIDAR" and shared["codes"]["problem"]["3"] == "UNREADABLE"
    assert shared["config"]["method"]["n"] == N and shared["channels"] == list(CHANNELS) and shared["grid"] == [16, 16]
    assert shared["data"]["frames"] == 12 and len(shared["key"]) == len(shared["data"]["digest"]) == 64
    assert {"version", "git"} <= set(shared) and set(shared["columns"]) == set(schema.names)
    assert own == {"number": 0, "of": 3, "counts": {"no_second_view": 2, "none": 3, "skipped": 0}}
    assert str(robot) not in json.dumps(shared), "no place of this machine"


def test_every_key_of_the_transform_has_a_column():
    transform = ExtendDepth(depth_unit="m", n=7, tokens_hw=(28, 42))
    found = columns.columns(7, 6)
    blank = transform._blank((28, 42))
    assert set(found) == set(columns.PLACE) | set(blank)
    for name, value in blank.items():
        assert tuple(value.shape[1:]) == found[name].shape, name
        assert found[name].kind in ("float32", "bool", "uint8")
    for name, table in columns.CODES.items():
        assert max(columns.code_tables()[name]) < 256 and table, "codes fit a byte"
        assert sum(k for k in columns.code_tables()["flag"]) < 256


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_make_the_same_files(robot, command, workers):
    assert command(*asked(robot))[0] == 0
    code, _, err = command(*asked(robot, f"workers={workers}", out="other"))
    assert code == 0 and err == "", err
    assert contents("features") == contents("other") and len(files("other")) == 3


MANY = ["data.hw=[60,80]", "data.n_frames=60", "data.supersample=1", "out=features", "extract.shard_rows=4"]


def test_kill_9_in_the_middle_loses_and_doubles_nothing(tmp_path, command):
    """With workers, in the middle of a shard; then the same command again."""
    args = [*MANY, *PAPER, "workers=1"]
    process = start(tmp_path, "extract", *args)
    assert stop(process, partial(files, tmp_path / "features"), 3, signal.SIGKILL) == -signal.SIGKILL, (
        tmp_path / "err"
    ).read_text()
    before = seen(files("features"))
    assert 3 <= len(before) < 15
    assert all(parquet.read_table(Path("features") / name).num_rows == 4 for name in before)
    (Path("features") / ".shard-00014.parquet.tmp").write_bytes(b"PAR1")  # as a killed writer leaves it
    code, out, err = command(*args)
    assert code == 0, err
    assert f"15 shards ({len(before)} left untouched), 60 rows" in out
    after = seen(files("features"))
    assert {k: after[k] for k in before} == before, "what was finished is untouched"
    assert Features("features", ["depth"]).place["frame_index"].tolist() == list(range(60)), "none lost, none doubled"
    assert [p.name for p in Path("features").iterdir() if p.name.startswith(".")] == []
    assert command(*[a.replace("out=features", "out=whole") for a in args])[0] == 0
    assert contents("whole") == contents("features"), "the same as without the kill"


def test_ctrl_c_leaves_whole_shards_and_says_how_to_go_on(robot, command, monkeypatch):
    real, calls = shards.write, []

    def interrupted(*args):
        calls.append(1)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)
        return real(*args)

    monkeypatch.setattr(shards, "write", interrupted)
    code, out, err = command(*asked(robot))
    assert code == 130 and "Traceback" not in err and out == ""
    assert "interrupted: 1 of 3 shards in features are whole and stay; the same command does the rest" in err
    before = seen(files("features"))
    assert len(before) == 1
    with pytest.raises(data.FormatError, match="found 1, expected 3: the same dhtorch extract once more"):
        Features("features")
    code, out, _ = command(*asked(robot))
    assert code == 0 and "3 shards (1 left untouched)" in out
    assert {k: v for k, v in seen(files("features")).items() if k in before} == before
    code, out, _ = command(*asked(robot))
    assert code == 0 and "3 shards (3 left untouched), 12 rows" in out and "6 no second view" in out


def test_ctrl_c_from_a_terminal_ends_the_workers_quietly(tmp_path):
    process = start(tmp_path, "extract", *MANY, *PAPER, "workers=2")
    code = stop(process, partial(files, tmp_path / "features"), 2, signal.SIGINT)
    err = (tmp_path / "err").read_text()
    assert code == 130 and "Traceback" not in err and len(err.strip().splitlines()) == 1, err
    assert "whole and stay" in err


def test_a_torn_shard_is_written_again(robot, command):
    assert command(*asked(robot))[0] == 0
    whole = contents("features")
    torn = files("features")[1]
    torn.write_bytes(torn.read_bytes()[:-100])
    code, out, _ = command(*asked(robot))
    assert code == 0 and "(2 left untouched)" in out and contents("features") == whole


@pytest.fixture
def damaged(tmp_path):
    """Numbered frames, the fourth with half a picture."""
    room = SyntheticRoom(hw=HW, n_frames=8, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "set", [room[i] for i in range(8)])
    image = tmp_path / "set" / "images" / "00003.png"
    image.write_bytes(image.read_bytes()[:500])
    return ["data=auto", f"data.root={tmp_path / 'set'}", "data.gap=2", "out=features", "extract.shard_rows=3", *PAPER]


@pytest.mark.parametrize("workers", [0, 1])
def test_a_corrupt_frame_raises_in_one_line(damaged, command, workers):
    code, _, err = command(*damaged, f"workers={workers}")
    assert code == 2 and "Traceback" not in err and len(err.strip().splitlines()) == 1, err
    assert all(word in err for word in ("frame 3", "00003.png", "expected", "extract.on_error=skip")), err
    assert [p.name for p in files("features")] == ["shard-00000.parquet"], "what was whole before it stays"
    assert not list(Path("features").glob(".*"))


def test_a_corrupt_frame_is_skipped_and_counted(damaged, command):
    code, out, err = command(*damaged, "extract.on_error=skip")
    assert code == 0 and err == "", err
    assert "7 rows" in out and "1 skipped" in out and "00003.png" in out
    assert "3 no second view" in out, "the two first, and the one whose other view cannot be read"
    assert Features("features").place["frame_index"].tolist() == [0, 1, 2, 4, 5, 6, 7]
    code, out, _ = command(*damaged, "extract.on_error=skip")
    assert "(3 left untouched), 7 rows" in out and "1 skipped" in out, "counts are kept with the shards"


def test_a_corrupt_frame_is_flagged_with_zeros(damaged, command):
    code, out, _ = command(*damaged, "extract.on_error=flag", "workers=1")
    assert code == 0 and "8 rows" in out and "1 unreadable" in out
    features = Features("features")
    assert [int(row["dhtorch.problem"]) for row in features] == [1, 1, 0, 3, 0, 1, 0, 0]
    row = features.at(0, 3)
    assert int(row.pop("dhtorch.problem")) == Problem.UNREADABLE and all(not x.any() for x in row.values())
    assert [features.place["timestamp"][i] == features.place["timestamp"][i] for i in (2, 3)] in (
        [True] * 2,
        [False] * 2,
    )


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["data=lerobot", "data.root=nowhere", "out=x"], ["nowhere", "no such file"]),
        (["data=lerobot", "out=x"], ["data.root"]),
        (["data.n_frames=3"], ["out"]),
        (["out=x", "extract.engine=dask"], ["extract.engine", "dask", "local, ray"]),
        (["out=x", "extract.on_error=ignore"], ["extract.on_error", "raise, skip, flag"]),
        (["out=x", "extract.columns=[depth,colour]"], ["extract.columns", "colour", "tokens"]),
        (["out=x", "extract.gap=-1"], ["extract.gap", "-1"]),
        (["out=x", "extract.shard_rows=0"], ["extract.shard_rows", "0"]),
        (["out=x", "extract.tokens_hw=[7,7]"], ["7x7", "14"]),
        (["out=x", "extract.tokens_hw=null"], ["extract.tokens_hw", "height and width"]),
        (["out=x", "workers=-1"], ["workers", "-1"]),
        (["out=x", "extract.shardrows=4"], ["shardrows"]),
        (["out=file", "data.n_frames=3"], ["file", "expected a folder"]),
        (["out=file/below", "data.n_frames=3"], ["file"]),
        (["out=x", "method=window", "extract.gap=3"], ["views", "5"]),
        (["--out", "x"], ["--out", "unknown flag"]),
    ],
)  # fmt: skip
def test_bad_input_gets_one_clear_line(command, args, words):
    Path("file").write_text("")
    code, _, err = command(*args)
    assert code == 2 and "Traceback" not in err and len(err.strip().splitlines()) == 1, err
    assert all(word in err for word in words), err
    assert not files("x")


def test_a_recording_without_a_gap_asks_for_one(robot, command):
    code, _, err = command("data=lerobot", f"data.root={robot}", "out=x", *PAPER)
    assert code == 2 and "extract.gap" in err and "0 = front end alone" in err


def test_two_cameras_of_one_episode_are_not_one_row(robot):
    (one, *_), (two, *_) = data.open_all(robot), data.open_all(robot)
    with pytest.raises(ValueError, match="are one episode, expected one camera of it"):
        plan.make([one, two], GAP, 1)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written(robot, command):
    Path("features").mkdir(mode=0o500)
    code, _, err = command(*asked(robot))
    assert code == 2 and "Permission denied" in err and "features" in err


def test_a_full_disk_is_one_line(robot, command, monkeypatch):
    real = columns.table

    def full(rows, *args):
        if rows[0]["frame_index"]:
            raise OSError(28, "No space left on device")
        return real(rows, *args)

    monkeypatch.setattr(shards, "GROUP_ROWS", 1)
    monkeypatch.setattr(shards, "table", full)
    code, _, err = command(*asked(robot))
    assert code == 2 and "No space left" in err and not list(Path("features").iterdir()), err


def test_shards_of_another_extraction_are_not_mixed(robot, command, tmp_path):
    assert command(*asked(robot))[0] == 0
    before = seen(files("features"))
    for other, words in (
        ("seed=1", "seed 0 there, 1 here"),
        ("method.n=64", "method.n 128 there, 64 here"),
        ("extract.half=true", "extract.half False there, True here"),
        ("data.episode=0", "data.episode None there, 0 here"),
    ):
        code, _, err = command(*asked(robot, other))
        assert code == 2 and words in err and "another extraction" in err and len(err.strip().splitlines()) == 1, err
    (robot.parent / "set2").mkdir(exist_ok=True)
    assert seen(files("features")) == before


def test_more_data_is_another_extraction(damaged, command):
    assert command(*damaged, "extract.on_error=skip")[0] == 0
    image = Path("set/images/00003.png")
    image.write_bytes((image.parent / "00002.png").read_bytes())
    code, _, err = command(*damaged, "extract.on_error=skip")
    assert code == 2 and "(other data)" in err


def test_a_missing_pyarrow_names_the_extra(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    code, _, err = command("out=x", "data.n_frames=3")
    assert code == 2 and "dhtorch[scale]" in err and len(err.strip().splitlines()) == 1


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
        list(engines.here(Deadly(), range(4), 1))


def test_halves_and_chosen_columns_are_smaller(robot, command):
    for out, more in (("all", []), ("half", ["extract.half=true"]), ("few", ["extract.columns=[tokens]"])):
        assert command(*asked(robot, *more, out=out))[0] == 0
    sizes = [sum(p.stat().st_size for p in files(folder)) for folder in ("all", "half", "few")]
    assert sizes[0] > sizes[1] > sizes[2]
    whole, half, few = (Features(folder) for folder in ("all", "half", "few"))
    assert (
        few.columns == ("tokens", "problem")
        and parquet.read_schema(half.files[0]).field("uv").type.value_type.value_type == pyarrow.float32()
    )
    for one, two in zip(whole, half, strict=True):
        for key, value in one.items():
            exact = key.removeprefix("dhtorch.") not in columns.MAY_BE_HALF
            assert two[key].dtype == value.dtype
            torch.testing.assert_close(two[key], value, rtol=0 if exact else 2**-11, atol=0 if exact else 1e-7)


def test_front_end_alone_and_a_method_of_many_views(robot, command):
    code, out, _ = command(*asked(robot, "extract.gap=0", out="alone"))
    assert code == 0 and "12 no second view" in out
    assert not any(bool((row["dhtorch.source"] == 2).any()) for row in Features("alone"))
    window = ["data.hw=[72,96]", "data.n_frames=6", "data.supersample=1", "data.lidar=exact", "method=window"]
    code, out, err = command(*window, "method.n=64", "method.views=2", "extract.gap=3", "out=window")
    assert code == 0 and "6 rows" in out, err
    problems = [int(row["dhtorch.problem"]) for row in Features("window")]
    assert problems == [1, 1, 0, 0, 0, 0], "the nearer view, two frames back, is there before the farther one"


def test_settings_are_the_defaults():
    cfg = OmegaConf.to_container(OmegaConf.load(config_dir() / "extract.yaml"))["extract"]
    assert cfg.pop("_target_") == "dhtorch.extract.Options"
    defaults = {k: f.default for k, f in extract.Options.__dataclass_fields__.items()}
    assert cfg == {k: list(v) if isinstance(v, tuple) else v for k, v in defaults.items()}


def test_features_and_plans_pickle_and_stay_small(robot, command):
    assert command(*asked(robot))[0] == 0
    features = Features("features", ["tokens", "tokens_valid"])
    loader = torch.utils.data.DataLoader(JoinedDataset(Items(robot), features), batch_size=4, num_workers=1)
    assert sum(len(batch["dhtorch.tokens"]) for batch in loader) == 12
    recordings = data.open_all(robot)
    whole = plan.make(recordings, GAP, 1)
    rows = extract.Rows(
        recordings, whole, columns.columns(N, 256), method=instantiate_paper(), gap=GAP, seed=0, tokens_hw=(224, 224)
    )
    rows[3]
    twin = pickle.loads(pickle.dumps(rows))
    assert twin._opened is None and torch.equal(
        torch.from_numpy(twin[7].features["depth"]), torch.from_numpy(rows[7].features["depth"])
    )


def instantiate_paper():
    return instantiate(OmegaConf.create({"_target_": "dhtorch.pair.extend", "_partial_": True, "n": N}))


def test_positions_and_places():
    whole = plan.Plan(order=(2, 0, 1), episodes=(0, 4, 9), ends=(3, 4, 8), roots=())
    assert [whole.place(i) for i in range(8)] == [
        (2, 0, 0),
        (2, 0, 1),
        (2, 0, 2),
        (0, 4, 0),
        *((1, 9, i) for i in range(4)),
    ]
    pieces = whole.shards(3)
    assert [list(s.rows) for s in pieces] == [[0, 1, 2], [3, 4, 5], [6, 7]] and pieces[2].name == "shard-00002.parquet"
    assert set(METHODS) >= {"paper", "map"}
