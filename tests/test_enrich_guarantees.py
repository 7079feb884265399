"""What dhtorch enrich promises: killed anywhere it ends alike, whoever works; the source stays; the past alone counts."""

import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
import tracemalloc
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from PIL import Image
from pyarrow import parquet
from test_enrich import map_of, rows, tree

from dhtorch import data, lock
from dhtorch import testing as writers
from dhtorch.commands.run import main
from dhtorch.data.codecs import tfrecord
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.extract import cut, plan
from dhtorch.extract.enriched import MapRows, View, camera_key, columns
from dhtorch.extract.step_set import StepSet
from dhtorch.methods import PAPER
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.synthetic.two_cameras import open_two_cameras

HW, LENGTHS = (48, 64), (3, 2)
FRONT = "observation.images.front"
ASKED = ["method=paper", "method.n=64", "method.hypotheses=10", "gap=1", "dense=false", "shard_rows=2"]


@cache
def room():
    """Frames of the synthetic room, whose sensor sees no farther than 2.5 m."""
    rendered = SyntheticRoom(hw=HW, n_frames=7, lidar="exact", supersample=1)
    frames = [rendered[i] for i in range(len(rendered))]
    return [frame.replace(depth=torch.where(frame.depth <= 2.5, frame.depth, 0.0)) for frame in frames]


def shots(length, first=0):
    return room()[first : first + length]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    root = tmp_path_factory.mktemp("robot") / "set"
    root.mkdir()
    writers.write_lerobot(root, [shots(n, 3 * k) for k, n in enumerate(LENGTHS)], depth="tiff")
    return root


def digest(root):
    return {name: hashlib.sha256(content).hexdigest() for name, content in tree(root).items()}


def enrich(source, out, *more):
    assert main(["enrich", str(source), str(out), *ASKED, *more]) == 0
    return out


@pytest.fixture(scope="module")
def whole(robot, tmp_path_factory):
    return enrich(robot, tmp_path_factory.mktemp("whole") / "set")


def strike(robot, folder, moments):
    script = Path(__file__).parent / "struck.py"
    words = [sys.executable, str(script), str(robot), str(folder), str(moments), "--", *ASKED]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("moments", [2, pytest.param(0, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])])
def test_killed_at_any_moment_or_out_of_disk_it_ends_with_the_same_bytes(moments, robot, whole, tmp_path):
    before = digest(robot)
    found = strike(robot, tmp_path, moments)
    assert found["whole"] == [0, ""] and found["total"] > 20
    want = digest(whole)
    assert digest(tmp_path / "whole") == want
    assert len(found["ends"]) == (moments or found["total"])
    for moment, killed, after in found["ends"]:
        assert (killed, after) == (-9, [0, ""]), moment
        assert digest(tmp_path / str(moment)) == want, moment
    code, said = found["full"]
    assert code == 2 and said.count("\n") == 1
    assert "too large" in said and str(tmp_path / "full") in said and "the same command does the rest" in said
    assert found["after"] == [0, ""] and digest(tmp_path / "full") == want
    assert digest(robot) == before
    left = [p.name for p in tmp_path.iterdir() if p.name.startswith(".")]
    assert not left, "locks and unfinished files are gone"


def test_workers_give_the_same_bytes(robot, whole, tmp_path):
    assert tree(enrich(robot, tmp_path / "set", "workers=2")) == tree(whole)


@pytest.mark.slow
def test_a_cluster_gives_the_same_bytes(robot, whole, tmp_path):
    pytest.importorskip("ray.data")
    assert tree(enrich(robot, tmp_path / "set", "engine=ray")) == tree(whole)


def test_a_changed_source_is_another_set(robot, whole, tmp_path, capsys):
    source = tmp_path / "source"
    shutil.copytree(robot, source)
    out = enrich(source, tmp_path / "set")
    table = next((source / "data").rglob("*.parquet"))
    changed = parquet.read_table(table)
    place = changed.column_names.index("timestamp")
    parquet.write_table(changed.set_column(place, "timestamp", [np.asarray(changed["timestamp"]) + 1e-7]), table)
    assert main(["enrich", str(source), str(out), *ASKED]) == 2
    said = capsys.readouterr().err
    assert "another enriched set" in said and "data" in said and said.count("\n") == 1


def test_splits_are_in_the_new_numbers(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    writers.write_lerobot(source, [shots(2), shots(2, 2), shots(2, 4)], depth="tiff")
    info = source / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"splits": {"train": "0:2", "val": "2:3"}}))

    def splits(out, *more):
        return json.loads((enrich(source, out, *more) / "meta" / "info.json").read_text())["splits"]

    assert splits(tmp_path / "all") == {"train": "0:2", "val": "2:3"}
    assert splits(tmp_path / "one", "data=lerobot", "data.episode=2") == {"val": "0:1"}


def test_two_writers_do_not_share_a_folder(robot, whole, tmp_path, capsys):
    with lock.held(tmp_path / ".set.lock", "out"):
        assert main(["enrich", str(robot), str(tmp_path / "set"), *ASKED]) == 2
    assert "one writer" in capsys.readouterr().err and not (tmp_path / "set").exists()


def test_the_past_alone_counts_and_of_the_same_episode(robot, whole, tmp_path):
    keys = [f"{FRONT}_depth_enriched", f"{FRONT}_dhtorch_source"]
    every = rows(whole)
    short = rows(enrich(robot, tmp_path / "short", "frames=2"))
    assert [row["episode_index"] for row in short] == [0, 0, 1, 1]
    assert [row["source.index"] for row in short] == [0, 1, 3, 4] and [row["index"] for row in short] == [0, 1, 2, 3]
    for row, same in zip(short, [every[0], every[1], every[3], every[4]], strict=True):
        assert all(row[key]["bytes"] == same[key]["bytes"] for key in keys), "a later frame changed an earlier one"
    second = rows(enrich(robot, tmp_path / "second", "data=lerobot", "data.episode=1"))
    assert [row[keys[0]]["bytes"] for row in second] == [row[keys[0]]["bytes"] for row in every[3:]]
    recovered = [int((map_of(row, keys[1]) == 2).sum()) for row in every]
    assert recovered[0] == recovered[3] == 0 and sum(recovered) > 0
    both = rows(enrich(robot, tmp_path / "both", "causal=false", "gap=auto"))
    assert int((map_of(both[0], keys[1]) == 2).sum()) > 0, "looking ahead the first frame has an answer too"


def test_samples_alone(whole):
    for row in rows(whole):
        found = map_of(row, f"{FRONT}_depth_enriched") > 0
        assert 0 < found.sum() <= 64


def test_an_older_version_of_the_format(robot, whole, tmp_path):
    one = tmp_path / "older"
    one.mkdir()
    writers.write_lerobot(one / "set", [shots(n, 3 * k) for k, n in enumerate(LENGTHS)], depth="tiff", version=2)
    out = enrich(one / "set", tmp_path / "out", "format=same")
    about = json.loads((out / "meta" / "info.json").read_text())
    assert about["codebase_version"] == "v2.1" and about["total_videos"] == len(LENGTHS)
    lines = [json.loads(line) for line in (out / "meta" / "episodes_stats.jsonl").read_text().splitlines()]
    assert [line["episode_index"] for line in lines] == [0, 1]
    depth = lines[1]["stats"][f"{FRONT}_depth_enriched"]
    for name, entry in lines[1]["stats"].items():  # what LeRobot 0.3 asks of them
        wanted = (3, 1, 1) if "image" in name else np.shape(entry["min"])
        assert {np.shape(v) for k, v in entry.items() if k != "count"} == {wanted}, name
    assert depth["mean"][0] == depth["mean"][1] == depth["mean"][2]
    again = data.open_all(out, depth=f"{FRONT}_depth_enriched")
    assert [len(each) for each in again] == list(LENGTHS)
    for a, b in zip(rows(out), rows(whole), strict=True):
        assert a[f"{FRONT}_depth_enriched"]["bytes"] == b[f"{FRONT}_depth_enriched"]["bytes"]


def test_the_whole_is_never_held(tmp_path, monkeypatch):
    content = os.urandom(300_000)
    made = MapRows.features

    def large(self, opened, i):
        if not hasattr(large, "row"):
            large.row = made(self, opened, i)
        return {**large.row, "picture": content + bytes([i % 256])}

    monkeypatch.setattr(MapRows, "features", large)
    tracemalloc.start()
    words = ["data=synthetic", "data.hw=[48,64]", "data.n_frames=60", "data.supersample=1", "report=false"]
    assert main(["enrich", f"out={tmp_path / 'set'}", *words, *ASKED]) == 0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5 * 60 * len(content)


# ---------------------------------------------------------------------------------------------------- other sources


def test_steps_of_robots_keep_what_they_say(tmp_path):
    """RLDS: numbers, texts, splits, and pictures as they are encoded."""
    source = tmp_path / "1.0.0"
    writers.write_rlds(source, [shots(3), shots(2, 3)], split="train")
    writers.write_rlds(source, [shots(2, 5)], split="val")
    before = tree(source)
    out = enrich(source, tmp_path / "out", "data=rlds")
    assert tree(source) == before
    found = rows(out)
    assert [row["episode_index"] for row in found] == [0, 0, 0, 1, 1, 2, 2]
    assert [row["index"] for row in found] == list(range(7)) and [row["frame_index"] for row in found][:3] == [0, 1, 2]
    assert [row["action"] for row in found[:3]] == np.arange(21.0).reshape(3, 7).tolist()
    assert [row["is_last"] for row in found] == [False, False, True, False, True, False, True]
    about = json.loads((out / "meta" / "info.json").read_text())
    assert about["splits"] == {"train": "0:2", "val": "2:3"} and about["features"]["is_last"]["dtype"] == "bool"
    picture = np.array(Image.open(io.BytesIO(found[0]["observation.images.image_0"]["bytes"])))
    assert np.array_equal(picture, shots(1)[0].image[0].permute(1, 2, 0).numpy())
    inside = (source / "tiny_robot-train.tfrecord-00000-of-00001").read_bytes()
    assert found[0]["observation.images.image_0"]["bytes"] in inside, "not encoded again"
    said = [json.loads(line) for line in (out / "meta" / "source_episodes.jsonl").read_text().splitlines()]
    assert [(row["split"], row["number"], row["episode_id"]) for row in said] == [
        ("train", 0, -1),
        ("train", 1, -1),
        ("val", 0, -1),
    ]
    again = data.open_all(out, depth="observation.images.image_0_depth")
    assert [len(each) for each in again] == [3, 2, 2]


def test_the_record_of_an_episode_is_read_once(tmp_path, monkeypatch):
    writers.write_rlds(tmp_path / "1.0.0", [shots(7), shots(5)])
    recordings = data.open_all(tmp_path / "1.0.0")
    read, opened = [], []
    record, stream = tfrecord.read_record, tfrecord.opened
    monkeypatch.setattr(tfrecord, "read_record", lambda file, span: read.append(span) or record(file, span))
    monkeypatch.setattr(tfrecord, "opened", lambda file: opened.append(file) or stream(file))
    held = [recordings[0], recordings[1]]
    read.clear(), opened.clear()
    steps = StepSet(held, [0, 1], 30.0)
    tables = [list(steps.batches(k, [])) for k in (0, 1)]
    assert [sum(t.num_rows for t in found) for found in tables] == [7, 5] and steps.about(1)["split"] == "train"
    assert len(read) == 2, "one an episode"
    columns = sum(len(t.column_names) for found in tables for t in found)
    assert len(opened) <= 2 + columns, "one a column and group at most, not one a step"


def test_an_episode_of_which_nothing_can_be_read_is_said(tmp_path, capsys):
    source = tmp_path / "source"
    source.mkdir()
    writers.write_lerobot(source, [shots(2), shots(2, 2)], depth="tiff", version=2)
    gone = source / "videos" / "chunk-000" / FRONT / "episode_000001.mp4"
    gone.unlink()
    for more, helps in (((), "on_error=flag the rest"), (("on_error=flag",), "the video of episode 1")):
        assert main(["enrich", str(source), str(tmp_path / "set"), *ASKED, *more]) == 2
        said = capsys.readouterr().err
        assert gone.name in said and helps in said and said.count("\n") == 1, said
        shutil.rmtree(tmp_path / "set")


def pair_of_cameras():
    rig = open_two_cameras(n_frames=3, hw=(96, 128), depth_hw=(48, 64), supersample=1)[0].recording
    fields = ("name", "format", "number", "times", "poses", "rate_hz")
    return [
        Recording(**{k: getattr(each, k) for k in fields}, load=each.load, camera_name=each.name.rpartition("/")[2])
        for each in rig.load.recordings
    ]


def test_another_camera_of_the_instant_is_another_view():
    scenes = [Scene(each) for each in pair_of_cameras()]
    whole = plan.make(scenes, "auto", 1, rigs=True)
    assert whole.episodes == (0, 0) and whole.beside(0) == [1] and whole.beside(1) == [0]
    views = {v.key: v for v in (View.of(scene, 64) for scene in scenes)}
    assert list(views) == ["observation.images.left", "observation.images.right"]
    options = {"method": PAPER.replace(n=128), "gap": "auto", "step": 0.0, "views": views, "dense": False}
    alone = MapRows(scenes, whole, columns(pictures=False), **options)[0]
    beside = MapRows(scenes, whole, columns(pictures=False), beside=True, pose="pose", **options)
    left, right = beside[0], beside[3]
    assert alone.features["pixels"][2] == 0, "the first frame has nothing before it"
    assert left.features["pixels"][2] > 0 and right.features["pixels"][2] > 0
    assert camera_key(cut.shorter(scenes[1].recording, 2)) == "observation.images.right"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["cameras=true"], "two or more of one size"),
        (["pose_sigma=[0.01,0.02]"], "pose=near"),
        (["pose=device", "pose_sigma=[0.01]"], "pose_sigma"),
        (["frames=0"], "frames"),
        (["fps=0"], "fps"),
        (["pose=robot"], "near, device, start"),
    ],
)
def test_options_that_cannot_be(more, said, robot, tmp_path, capsys):
    assert main(["enrich", str(robot), str(tmp_path / "x"), *ASKED, *more]) == 2
    text = capsys.readouterr().err
    assert said in text and text.count("\n") == 1 and not (tmp_path / "x").exists()


def test_the_sources_poses_are_used(robot, tmp_path):
    out = enrich(robot, tmp_path / "set", "pose=device")
    recovered = [int((map_of(row, f"{FRONT}_dhtorch_source") == 2).sum()) for row in rows(out)]
    assert recovered[1] > 0 and recovered[0] == 0


def test_poses_that_near_returns_refute_are_said_everywhere_with_their_reading(tmp_path, capsys):
    source, out = tmp_path / "source", tmp_path / "set"
    poses = [shot.T_world_from_cam for shot in shots(3)]
    in_mm = [shot.replace(T_world_from_cam=T.replace(t=1000 * T.t)) for shot, T in zip(shots(3), poses, strict=True)]
    source.mkdir()
    writers.write_lerobot(source, [in_mm], depth="tiff")
    enrich(source, out, "method.n=256", "pose=device")
    said = "front: the poses given contradict the near returns in 2 of 3 frames; they look like millimetres"
    assert said in capsys.readouterr().out
    about = json.loads((out / "meta" / "report.json").read_text())
    (camera,) = (episode["cameras"]["front"] for episode in about["episodes"])
    alone = [code for code, name in about["codes"]["silent"].items() if name == "NO_OTHER_VIEW"]
    assert sum(camera["silent"]) == camera["pixels"][0] and 0 < camera["silent"][int(*alone)] < camera["pixels"][0]
    assert camera["refuted"] == {"millimetres": 2} and camera["frames"] == 3
    page = (out / "meta" / "report.html").read_text()
    assert "millimetres" in page and "Poses given that the near returns contradict" in page
    assert (
        "there was no other view" in page
        and "the poses given contradict the near returns" in page
        and "no track" not in page
    )


def test_a_name_that_leads_elsewhere_is_refused(robot, tmp_path, capsys):
    source = tmp_path / "source"
    shutil.copytree(robot, source)
    info = source / "meta" / "info.json"
    about = json.loads(info.read_text())
    about["features"]["../../../gone"] = {"dtype": "video", "shape": [48, 64, 3], "names": None}
    info.write_text(json.dumps(about))
    assert main(["enrich", str(source), str(tmp_path / "a" / "b" / "set"), *ASKED]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "gone").exists()
