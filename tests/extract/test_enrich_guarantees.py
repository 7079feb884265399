"""Guarantees of ``dhtorch enrich``: the same bytes after any kill and with any workers, unchanged source, causal depth."""

import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tracemalloc
from functools import cache, partial
from itertools import product, starmap
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("av")

import pyarrow
from PIL import Image
from pyarrow import parquet
from support import writers
from support.dataset_folders import decode_map, read_files, read_rows

from dhtorch.cli import capture_checks
from dhtorch.cli.run import main
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.export.lerobot import N_BINS
from dhtorch.extract import cut, origin, plan
from dhtorch.extract.enriched import DatasetCamera, MapRowDataset, camera_feature, camera_key, map_columns
from dhtorch.extract.nerf_target import NerfstudioTarget
from dhtorch.extract.origin import DEFAULT_FPS, LeRobotSource, frame_rate
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.extract.targets import MapCounts, PeekableRows
from dhtorch.pipeline.presets import PAPER
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
    return {name: hashlib.sha256(content).hexdigest() for name, content in read_files(root).items()}


def enrich(source, out, *more):
    assert main(["enrich", str(source), str(out), *ASKED, *more]) == 0
    return out


@pytest.fixture(scope="module")
def whole(robot, tmp_path_factory):
    return enrich(robot, tmp_path_factory.mktemp("whole") / "set")


def strike(robot, folder, moments):
    script = Path(__file__).parents[1] / "support" / "kill_enrich.py"
    words = [sys.executable, str(script), str(robot), str(folder), str(moments), "--", *ASKED]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
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
    assert "too large" in said and str(tmp_path / "full") in said and "run the same command again for the rest" in said
    assert found["after"] == [0, ""] and digest(tmp_path / "full") == want
    assert digest(robot) == before
    left = [p.name for p in tmp_path.iterdir() if p.name.startswith(".")]
    assert not left, "locks and unfinished files are gone"


@pytest.mark.slow
@pytest.mark.parametrize("more", ["workers=2", "engine=ray"])
def test_workers_and_a_cluster_give_the_same_bytes(more, robot, whole, tmp_path):
    if more == "engine=ray":
        pytest.importorskip("ray.data")
    assert read_files(enrich(robot, tmp_path / "set", more)) == read_files(whole)


@pytest.mark.parametrize("format", ["lerobot", "nerfstudio"])
def test_an_episode_made_with_other_settings_is_not_whole(format, robot, tmp_path):
    out = enrich(robot, tmp_path / "set", "data=lerobot", "data.episode=0", f"format={format}")
    key = json.loads((out / "meta" / "dhtorch.json").read_text())["key"]
    views = {FRONT: DatasetCamera(FRONT, HW, HW, posed=True)}

    def own(key, k=0):
        if format == "nerfstudio":
            return NerfstudioTarget(out, views, [{FRONT: ""}, {FRONT: "1"}], key).own(k)
        made = {"step": 0.0, "maps": ("depth",), "as_images": False, "fps": 30.0, "task": None, "key": key}
        return LeRobotTarget(out, 3, views, origin=None, numbers=[0, 1], **made).own(k)

    assert own(key)["length"] == LENGTHS[0]
    assert own(f"{key}x") is None
    assert own(key, 1) is None, "not there"


@pytest.mark.parametrize("version", [2, 3])
def test_tasks_that_are_noted_for_an_episode_are_kept(version, tmp_path):
    """Of several that describe it, the rows bear one."""
    source = tmp_path / "source"
    source.mkdir()
    writers.write_lerobot(source, [shots(2)], depth="tiff", version=version)
    room_scene = ["look", "look carefully"]
    if version == 2:
        file = source / "meta" / "episodes.jsonl"
        file.write_text(json.dumps({**json.loads(file.read_text()), "tasks": room_scene}) + "\n")
    else:
        file = next((source / "meta" / "episodes").rglob("*.parquet"))
        table = parquet.read_table(file)
        parquet.write_table(table.set_column(table.column_names.index("tasks"), "tasks", [[room_scene]]), file)
    out = enrich(source, tmp_path / "set")
    (table,) = (out / "meta" / "episodes").rglob("*.parquet")
    assert parquet.read_table(table)["tasks"].to_pylist() == [room_scene]
    assert {row["task_index"] for row in read_rows(out)} == {0}


def test_a_source_has_episodes_of_its_splits_rows_up_to_its_limit_and_the_files_that_are_not_rewritten(tmp_path):
    root = tmp_path / "source"
    writers.write_lerobot(root, [shots(3), shots(2, 3), shots(2, 5)], depth="tiff")
    info = root / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"splits": {"train": "0:2", "val": "2:3"}}))
    for name in ("notes.txt", "meta/stats.json", "meta/other.json"):
        (root / name).write_text("{}")
    source = LeRobotSource.open(root, [0, 1, 2], limit=2)
    assert source.splits == {"train": [0, 1], "val": [2]}
    assert [sum(part.num_rows for part in source.batches(k, [])) for k in range(3)] == [2, 2, 2]
    assert sum(part.num_rows for part in LeRobotSource.open(root, [0]).batches(0, [])) == 3
    assert {"notes.txt", "meta/other.json"} <= source.more.keys()
    assert not {"meta/info.json", "meta/stats.json", "meta/tasks.parquet"} & source.more.keys()
    for more, splits in (([], {"train": "0:2", "val": "2:3"}), (["data=lerobot", "data.episode=2"], {"val": "0:1"})):
        out = enrich(root, tmp_path / str(len(more)), *more)
        assert json.loads((out / "meta" / "info.json").read_text())["splits"] == splits, "in the new numbers"


def test_rows_without_frame_index_are_counted_over_all_groups(tmp_path, monkeypatch):
    writers.write_lerobot(tmp_path, [shots(3)], depth="tiff")
    (file,) = (tmp_path / "data").rglob("*.parquet")
    parquet.write_table(parquet.read_table(file).drop_columns("frame_index"), file)
    monkeypatch.setattr(origin, "TABLE_GROUP_ROWS", 2)
    groups = list(LeRobotSource.open(tmp_path, [0]).batches(0, []))
    assert [part["frame_index"].to_pylist() for part in groups] == [[0, 1], [2]]


def test_a_video_that_no_episode_has_is_no_feature_of_the_new_set(tmp_path):
    writers.write_lerobot(tmp_path, [shots(2)], depth="tiff", version=2)
    info = tmp_path / "meta" / "info.json"
    about = json.loads(info.read_text())
    about["features"]["observation.images.wrist"] = about["features"][FRONT]
    info.write_text(json.dumps(about))
    source = LeRobotSource.open(tmp_path, [0])
    assert set(source.features) == set(about["features"]) - {"observation.images.wrist"}
    assert set(source.clips(0, 2)) == {FRONT}


def test_a_nerfstudio_folder_holds_frames_with_a_pose_and_is_sure_of_its_own_depth_alone(tmp_path, monkeypatch):
    """It has no pose that is not known, and no step beyond 65.534 m."""
    made, in_metres = MapRowDataset.features, []

    def lost(self, opened, i):
        row = made(self, opened, i)
        in_metres.append(np.array(Image.open(io.BytesIO(row["depth"]))))
        return {**row, "pose": np.full(16, np.nan)} if i == 1 else row

    monkeypatch.setattr(MapRowDataset, "features", lost)
    source = tmp_path / "source"
    source.mkdir()
    writers.write_lerobot(source, [[shot.replace(depth=40 * shot.depth) for shot in shots(3)]], depth="tiff")
    out = enrich(source, tmp_path / "set", "format=nerfstudio", "method.n=256")
    found = json.loads((out / "transforms.json").read_text())["frames"]
    assert [Path(frame["file_path"]).stem for frame in found] == ["frame_000000", "frame_000002"]
    depth, sure = (np.array(Image.open(out / found[0][f"{name}_file_path"])) for name in ("depth", "confidence"))
    held = (in_metres[0] > 0) & (in_metres[0] < 65.5)
    assert 0 < held.sum() < (in_metres[0] > 0).sum()
    assert np.array_equal(depth > 0, held) and np.array_equal(sure > 0, held)


@pytest.mark.slow
def test_the_past_alone_counts_and_of_the_same_episode(robot, whole, tmp_path):
    keys = [f"{FRONT}_depth_enriched", f"{FRONT}_dhtorch_source"]
    every = read_rows(whole)
    for row in every:
        assert 0 < (decode_map(row, keys[0]) > 0).sum() <= 64, "samples alone"
    short = read_rows(enrich(robot, tmp_path / "short", "max_frames=2"))
    assert [row["episode_index"] for row in short] == [0, 0, 1, 1]
    assert [row["source.index"] for row in short] == [0, 1, 3, 4] and [row["index"] for row in short] == [0, 1, 2, 3]
    for row, same in zip(short, [every[0], every[1], every[3], every[4]], strict=True):
        assert all(row[key] == same[key] for key in keys), "a later frame changed an earlier one"
    second = read_rows(enrich(robot, tmp_path / "second", "data=lerobot", "data.episode=1"))
    assert [row[keys[0]] for row in second] == [row[keys[0]] for row in every[3:]]
    recovered = [int((decode_map(row, keys[1]) == 2).sum()) for row in every]
    assert recovered[0] == recovered[3] == 0 and sum(recovered) > 0
    both = read_rows(enrich(robot, tmp_path / "both", "causal=false", "gap=auto"))
    assert int((decode_map(both[0], keys[1]) == 2).sum()) > 0, "looking ahead the first frame has an answer too"
    device = read_rows(enrich(robot, tmp_path / "device", "pose=device"))
    recovered = [int((decode_map(row, keys[1]) == 2).sum()) for row in device]
    assert recovered[1] > 0 and recovered[0] == 0, "the source's poses are used"


@pytest.mark.slow
def test_the_whole_is_never_held(tmp_path, monkeypatch):
    content = os.urandom(300_000)
    made = MapRowDataset.features

    def large(self, opened, i):
        if not hasattr(large, "row"):
            large.row = made(self, opened, i)
        return {**large.row, "picture": content + bytes([i % 256])}

    monkeypatch.setattr(MapRowDataset, "features", large)
    words = ["data=synthetic", "data.hw=[48,64]", "data.n_frames=60", "data.supersample=1", "report=false"]
    assert main(["enrich", f"out={tmp_path / 'first'}", *words, "data.n_frames=2", *ASKED]) == 0  # loads modules
    tracemalloc.start()
    assert main(["enrich", f"out={tmp_path / 'set'}", *words, *ASKED]) == 0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5 * 60 * len(content)
    (table,) = (tmp_path / "set" / "data").rglob("*.parquet")
    counted = parquet.read_table(table, columns=["index", "frame_index", "timestamp"]).to_pydict()
    assert counted["index"] == counted["frame_index"] == list(range(60)), "over all parts"
    assert np.allclose(counted["timestamp"], np.arange(60) / 30)


# ---------------------------------------------------------------------------------------------------- other sources


def test_counts_of_an_episode_are_sums_and_shares_along_it():
    tally = MapCounts()
    for k in range(48):  # two to a part; the second half is all recovered
        pixels = [6, 0, 2] if k < 24 else [0, 0, 8]
        row = {"depth": b"x", "pixels": pixels, "no_answer": [pixels[0], 0], "refuted": 0, "moments": np.ones(25)}
        row["ranges"] = np.ones((3, N_BINS))
        tally.add(row)
    tally.add(None)
    found = tally.summary()
    assert found["pixels"].tolist() == [144, 0, 240] and found["no_answer"].tolist() == [144, 0]
    assert np.allclose(found["over_time"], [[0.75, 0, 0.25]] * 12 + [[0, 0, 1]] * 12)
    assert np.allclose(found["no_answer_over_time"], [[0.75, 0]] * 12 + [[0, 0]] * 12)
    assert (found["frames"], found["unread"]) == (48, 1)


def pair_of_cameras():
    rig = open_two_cameras(n_frames=3, hw=(96, 128), depth_hw=(48, 64), supersample=1)[0].recording
    fields = ("name", "format", "number", "times", "poses", "rate_hz")
    return [
        Recording(**{k: getattr(each, k) for k in fields}, load=each.load, camera_name=each.name.rpartition("/")[2])
        for each in rig.load.recordings
    ]


def test_another_camera_of_the_instant_is_another_view():
    scenes = [Scene(each) for each in pair_of_cameras()]
    whole = plan.make_plan(scenes, "auto", 1, rigs=True)
    assert whole.episodes == (0, 0) and whole.beside(0) == [1] and whole.beside(1) == [0]
    views = {v.key: v for v in (DatasetCamera.of(scene, 64) for scene in scenes)}
    assert list(views) == ["observation.images.left", "observation.images.right"]
    options = {"method": PAPER.replace(n=128), "gap": "auto", "step": 0.0, "views": views, "dense": False}
    alone = MapRowDataset(scenes, whole, map_columns(pictures=False), **options)[0]
    beside = MapRowDataset(scenes, whole, map_columns(pictures=False), beside=True, pose="pose", **options)
    left, right = beside[0], beside[3]
    assert alone.features["pixels"][2] == 0, "the first frame has nothing before it"
    assert left.features["pixels"][2] > 0 and right.features["pixels"][2] > 0


@pytest.mark.parametrize(
    ("every", "most", "numbers"), [(1, None, [0, 1, 2]), (1, 2, [0, 1]), (2, None, [0, 2]), (2, 1, [0])]
)
def test_scenes_are_cut_to_every_so_many_frames_and_to_the_first(every, most, numbers):
    scenes = [Scene(each) for each in pair_of_cameras()]
    for scene, whole in zip(cut.subsample_scenes(scenes, every, most), scenes, strict=True):
        assert scene.recording.number.tolist() == whole.recording.number[numbers].tolist()
        assert camera_key(scene.recording) == camera_key(whole.recording)
        for k, place in enumerate(numbers):
            assert torch.equal(scene.recording[k].image, whole.recording[place].image)


def test_names_of_cameras_rates_and_rows_of_frames():
    names = {"image_0": "image_0", "observation/image_0": "image_0", "observation/images/front": "front"}
    for name, key in {**names, "hand/left/rgb": "hand_left_rgb"}.items():
        assert camera_feature(name) == f"observation.images.{key}", "no path"
    number = torch.tensor([0, 2, 4, 5])  # skipped frames do not slow a recording down
    known = {"name": "a", "format": "x", "load": shots(1).__getitem__, "number": number}
    for more, rate in (
        ({"times": number.double() / 10}, 10),
        ({"times": number.double() / 10, "rate_hz": 15.0}, 15),
        ({}, DEFAULT_FPS),
    ):
        assert frame_rate(Recording(**known, **more)) == rate
    rows = PeekableRows(iter([{"frame_index": 3}, {"frame_index": 5}]))
    taken = [rows.take(k) for k in (2, 4, 3, 5, 6)]
    assert taken == [None, None, {"frame_index": 3}, {"frame_index": 5}, None], "by its own frame alone"


def test_a_frame_of_another_size_or_lens_than_the_first_is_said():
    plain = SyntheticRoom(hw=HW, n_frames=1, supersample=1)[0]
    lens = torch.tensor([[0.1, 0.0, 0.0, 0.0]])
    frames = [
        plain,
        plain.replace(image=plain.image[..., :-8, :]),
        plain.replace(camera=plain.camera.replace(distortion=lens)),
        plain,
    ]
    scene = Scene(Recording(name="mixed", format="x", load=frames.__getitem__, number=torch.arange(4)))
    view = DatasetCamera.of(scene, 64)
    options = {"method": PAPER.replace(n=64), "gap": 1, "step": 0.0, "views": {view.key: view}, "dense": False}
    made = MapRowDataset([scene], plan.make_plan([scene], 1, 1), map_columns(pictures=False), **options)
    said = [made[i].complaint for i in range(4)]
    assert "image: found 40x64, expected 48x64 as of the first frame" in said[1]
    assert "expected none as of the first frame" in said[2]
    assert said[0] == said[3] == ""


def test_poses_that_near_returns_refute_are_said_everywhere_with_their_reading(tmp_path, capsys, monkeypatch):
    """Of a capture whose poses the check at the start lets pass: it sees some frames of a set's first episode."""
    source, out = tmp_path / "source", tmp_path / "set"
    poses = [shot.T_world_from_cam for shot in shots(3)]
    in_mm = [shot.replace(T_world_from_cam=T.replace(t=1000 * T.t)) for shot, T in zip(shots(3), poses, strict=True)]
    source.mkdir()
    writers.write_lerobot(source, [in_mm], depth="tiff")
    with pytest.warns(UserWarning, match="poses and depth contradict each other .* they are not used"):
        assert main(["enrich", str(source), str(out), *ASKED, "pose=device"]) == 2
    assert "pose: found no poses of front" in capsys.readouterr().err and not out.exists()
    monkeypatch.setattr(capture_checks, "check_scene", lambda scene: scene)
    enrich(source, out, "method.n=256", "pose=device")
    said = "front: the input poses contradict the near returns in 2 of 3 frames; they fit as millimetres"
    assert said in capsys.readouterr().out
    about = json.loads((out / "meta" / "report.json").read_text())
    (camera,) = (episode["cameras"]["front"] for episode in about["episodes"])
    alone = [code for code, name in about["codes"]["no_answer"].items() if name == "NO_OTHER_VIEW"]
    assert (
        sum(camera["no_answer"]) == camera["pixels"][0] and 0 < camera["no_answer"][int(*alone)] < camera["pixels"][0]
    )
    assert camera["refuted"] == {"millimetres": 2} and camera["frames"] == 3
    page = (out / "meta" / "report.html").read_text()
    assert "millimetres" in page and "Input poses that contradict the near returns" in page
    assert (
        "there was no other view" in page and page.count("contradict the near returns") > 1 and "no track" not in page
    )


# --------------------------------------------------------------------------------------- what is refused, in a sentence


def stretch(source, out):
    """The source changes after a first run."""
    enrich(source, out)
    table = next((source / "data").rglob("*.parquet"))
    changed = parquet.read_table(table)
    place = changed.column_names.index("timestamp")
    parquet.write_table(changed.set_column(place, "timestamp", [np.asarray(changed["timestamp"]) + 1e-7]), table)


def lead_outside(source, out):
    info = source / "meta" / "info.json"
    about = json.loads(info.read_text())
    about["features"]["../../../gone"] = {"dtype": "video", "shape": [48, 64, 3], "names": None}
    info.write_text(json.dumps(about))


def lose_video(source, out):
    shutil.rmtree(source)
    source.mkdir()
    writers.write_lerobot(source, [shots(2), shots(2, 2)], depth="tiff", version=2)
    (source / "videos" / "chunk-000" / FRONT / "episode_000001.mp4").unlink()


def fill_metadata(content, source, out):
    (out / "meta").mkdir(parents=True)
    (out / "meta" / "dhtorch.json").write_text(content)


def metadata(format, content):
    words = ["data=lerobot", "data.episode=0", f"format={format}"]
    return pytest.param(
        partial(fill_metadata, content),
        words,
        "dhtorch.json: found ",
        marks=[] if (format, content) in (("lerobot", "null"), ("nerfstudio", '{"key": 1}')) else pytest.mark.slow,
        id=f"{format} {content}",
    )


@pytest.mark.parametrize(
    ("spoil", "more", "said"),
    [
        (None, ["cameras=true"], "two or more cameras of one image size"),
        (None, ["pose_sigma=[0.01,0.02]"], "pose=near"),
        (None, ["pose=device", "pose_sigma=[0.01]"], "pose_sigma"),
        (None, ["max_frames=0"], "max_frames"),
        (None, ["fps=0"], "fps"),
        (None, ["pose=robot"], "near, device, start"),
        (stretch, [], "files of another run.*data"),
        (lead_outside, [], "gone"),
        (lose_video, [], "episode_000001.mp4.*on_error=flag to continue"),
        (lose_video, ["on_error=flag"], "episode_000001.mp4.*the video of episode 1"),
        *starmap(metadata, product(("lerobot", "nerfstudio"), ("null", "[]", "7", '"x"', "{}", "", '{"key": 1}'))),
        *(metadata(format, '{"key": null, "config": 3}') for format in ("lerobot", "nerfstudio")),
    ],
)
def test_what_cannot_be_is_one_sentence_and_nothing_is_written(spoil, more, said, robot, tmp_path, capsys):
    source, out = robot, tmp_path / "a" / "b" / "set"
    if spoil is not None:
        source = tmp_path / "source"
        shutil.copytree(robot, source)
        spoil(source, out)
    before = read_files(out) if out.exists() else {}
    capsys.readouterr()
    assert main(["enrich", str(source), str(out), *ASKED, *more]) == 2
    text = capsys.readouterr().err
    assert re.search(said, text) and text.count("\n") == 1
    assert spoil is lose_video or (read_files(out) if out.exists() else {}) == before
    assert not (tmp_path / "gone").exists()


@pytest.mark.parametrize("place", ["data", "meta"])
@pytest.mark.parametrize("value", [1e30, 0.5, -1, float("nan"), "0", 10**6, True, None])
def test_a_task_index_that_is_no_count_is_refused(robot, tmp_path, place, value):
    """In the rows None is none, in the metadata True is 1."""
    source = tmp_path / "source"
    shutil.copytree(robot, source)
    table = source / "meta" / "tasks.parquet" if place == "meta" else next((source / "data").rglob("*.parquet"))
    content = pyarrow.table({"task_index": [value], "task": ["pick"]})
    if place == "data":
        rows = parquet.read_table(table)
        at = rows.column_names.index("task_index")
        content = rows.set_column(at, "task_index", pyarrow.array([value] * sum(LENGTHS)))
    parquet.write_table(content, table)
    if (place, value) == ("data", None):
        assert list(LeRobotSource.open(source, [0]).batches(0, []))
        return
    with pytest.raises(FormatError, match=r"task_index: found ") as refused:
        list(LeRobotSource.open(source, [0]).batches(0, []))
    assert str(refused.value).startswith(str(table)) and "\n" not in str(refused.value)
    assert place == "meta" or "expected a whole number from 0 to 999999" in str(refused.value)


@pytest.mark.parametrize(
    "line", ["[1]", "null", "3", '"x"', '{"tasks": ["a"]}', '{"tasks": ["a"], "episode_index": []}']
)
def test_lines_of_episodes_with_other_types_are_left_or_named(tmp_path, line):
    writers.write_lerobot(tmp_path, [room()[:2]], version=2)
    file = tmp_path / "meta" / "episodes.jsonl"
    source = LeRobotSource.open(tmp_path, [0])
    words = source.words(0)
    file.write_text(file.read_text().rstrip("\n") + f"\n{line}\n")
    if "tasks" in line:
        with pytest.raises(FormatError, match=r"episodes\.jsonl: episode_index: found"):
            source.words(0)
    else:
        assert source.words(0) == words


@pytest.mark.parametrize(
    "name", ["data/*/*.parquet", "meta/tasks.parquet", "meta/episodes/*/*.parquet", "meta/stats.json", "README.md"]
)
def test_links_that_leave_a_data_set_are_not_read(robot, tmp_path, name):
    outside, source = tmp_path / "outside", tmp_path / "source"
    for folder in (outside, source):
        shutil.copytree(robot, folder)
        (folder / "README.md").write_text("about")
        (folder / "meta" / "stats.json").write_text('{"action": {"min": [0]}}')
    (path,) = source.glob(name)
    path.unlink()
    path.symlink_to(outside / path.relative_to(source))

    def read_all(bounds):
        opened = LeRobotSource.open(source, [0], bounds=bounds)
        rows = sum(part.num_rows for part in opened.batches(0, []))
        return rows, opened.words(0), opened.meta_file("stats.json"), [*opened.more]

    rows, _, stats, more = read_all(None)
    assert rows == LENGTHS[0] and stats and "README.md" in more
    if name.endswith((".json", ".md")):
        _, _, stats, more = read_all(source)
        assert (stats == {}) == name.endswith(".json")
        assert ("README.md" not in more) == name.endswith(".md"), "left out, as other files may be"
        return
    with pytest.raises(FormatError, match="link: found one to outside the capture"):
        read_all(source)


@pytest.mark.parametrize("linked", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_pictures_named_by_cells_are_not_read_through_links(robot, tmp_path, capsys, linked):
    """A mask in files beside the tables, of which one is a link to a file outside."""
    source, outside = tmp_path / "source", tmp_path / "secret.png"
    shutil.copytree(robot, source)
    info = json.loads((source / "meta" / "info.json").read_text())
    info["features"]["mask"] = {"dtype": "image", "shape": [*HW, 1], "names": ["height", "width", "channel"]}
    (source / "meta" / "info.json").write_text(json.dumps(info))
    table = next((source / "data").rglob("*.parquet"))
    content = parquet.read_table(table)
    cells = [{"bytes": None, "path": f"masks/{i}.png"} for i in range(content.num_rows)]
    parquet.write_table(content.append_column("mask", pyarrow.array(cells)), table)
    (source / "masks").mkdir()
    for i in range(content.num_rows):
        Image.fromarray(np.full(HW, i, np.uint8)).save(source / "masks" / f"{i}.png")
    asked = ["enrich", str(source), *ASKED, "data=lerobot", "data.episode=0", f"data.camera={FRONT}"]
    assert main([*asked[:2], str(tmp_path / "sound"), *asked[2:]]) == 0
    picture = source / "masks" / f"{linked}.png"
    picture.rename(outside)
    picture.symlink_to(outside)
    capsys.readouterr()
    assert main([*asked[:2], str(tmp_path / "set"), *asked[2:]]) == 2
    message = capsys.readouterr().err
    assert f"masks/{linked}.png: link: found one to outside the capture" in message and message.count("\n") == 1
