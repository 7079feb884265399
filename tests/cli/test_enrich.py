"""``dhtorch enrich``: the source is kept value for value, depth is added, and an interrupted run can be finished."""

import io
import itertools
import json

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from PIL import Image
from pyarrow import parquet
from support import stored_outputs, writers
from support.dataset_folders import decode_map, read_files, read_rows

from dhtorch import data
from dhtorch.cli.run import main
from dhtorch.export.lerobot import FeatureMoments, LogHistogram
from dhtorch.extract import shards
from dhtorch.extract.robot_target import LeRobotTarget
from dhtorch.runtime import storage
from dhtorch.synthetic.recording import SyntheticRoom

HW, LENGTHS, NEAR = (48, 64), (4, 3), 2.5
CAMERA = "observation.images.front"
DEPTH = f"{CAMERA}_depth_enriched"  # the source has a depth of its own
STEP = 2.0**-10
ASKED = ["method=paper", "method.n=64", "method.hypotheses=10", "gap=2", "dense={size: 64, planes: 8}", "shard_rows=2"]


@pytest.fixture(scope="module")
def shots():
    """Frames of the synthetic room, whose sensor sees no farther than NEAR."""
    room = SyntheticRoom(hw=HW, n_frames=sum(LENGTHS), lidar="exact", supersample=1)
    frames = [room[i] for i in range(len(room))]
    return [frame.replace(depth=torch.where(frame.depth <= NEAR, frame.depth, 0.0)) for frame in frames]


def robot_set(root, shots, version):
    root.mkdir(parents=True)
    starts = np.cumsum((0, *LENGTHS))
    episodes = [shots[a:b] for a, b in itertools.pairwise(starts)]
    writers.write_lerobot(root, episodes, version=version, depth="tiff")
    return root


@pytest.fixture(scope="module")
def robot(tmp_path_factory, shots):
    return robot_set(tmp_path_factory.mktemp("robot") / "set", shots, 3)


@pytest.fixture(scope="module")
def enriched(tmp_path_factory, robot):
    """The robot's set, enriched."""
    out = tmp_path_factory.mktemp("enriched") / "set"
    assert main(["enrich", str(robot), str(out), *ASKED]) == 0
    return out


def test_statistics_of_large_numbers_keep_their_spread():
    """A time stamp of today squared has no digits left for how far apart two frames are."""
    x = 1.7e9 + np.arange(600).reshape(-1, 1) / 30
    total = FeatureMoments.of(x[:7]) + FeatureMoments.of(x[7:7]) + FeatureMoments.parse(FeatureMoments.of(x[7:]).pack())
    entry = total.stats(len(x), (1,))
    assert np.allclose([entry["mean"][0] - 1.7e9, entry["std"][0]], [x.mean() - 1.7e9, (x - 1.7e9).std()], rtol=1e-5)


def test_no_feature_but_pictures_of_three_channels_is_an_image(robot, enriched, tmp_path):
    """LeRobot's policies take every image and video as such a picture, and want statistics of each."""
    assert main(["enrich", str(robot), str(tmp_path / "set"), *ASKED, "maps=images", "columns=[depth,source]"]) == 0
    features = json.loads((enriched / "meta" / "info.json").read_text())["features"]
    stated = [features[f"{DEPTH}{end}"]["info"]["quantiser_step_m"] for end in ("", "_sigma")]
    assert stated == [STEP, STEP / 8], "metres"
    for root, images in ((enriched, {CAMERA}), (tmp_path / "set", {CAMERA, DEPTH, f"{CAMERA}_dhtorch_source"})):
        features = json.loads((root / "meta" / "info.json").read_text())["features"]
        pictures = {k for k, f in features.items() if f["dtype"] in ("image", "video")}
        assert pictures - {f"{CAMERA}_depth"} == images and (f"{CAMERA}_depth" in pictures) == (root != enriched)
        assert pictures <= json.loads((root / "meta" / "stats.json").read_text()).keys()
        assert features[DEPTH]["info"]["is_depth_map"] is True
    assert features[DEPTH]["info"]["depth_unit"] == "m" and f"{DEPTH}_sigma" not in features
    for left, right in zip(read_rows(enriched), read_rows(tmp_path / "set"), strict=True):
        assert np.array_equal(decode_map(left, DEPTH), decode_map(right, DEPTH))
    frames = [data.open_all(root, depth=DEPTH)[0][1] for root in (enriched, tmp_path / "set")]
    assert torch.equal(frames[0].depth, frames[1].depth), "both forms read back alike"


def test_a_depth_video_of_the_source_stays_as_a_file(shots, tmp_path):
    writers.write_lerobot(tmp_path / "source", [shots[:2]], depth="video")
    assert main(["enrich", str(tmp_path / "source"), str(tmp_path / "set"), *ASKED, "dense=false", "gap=1"]) == 0
    key, meta = f"{CAMERA}_depth", tmp_path / "set" / "meta"
    assert key not in json.loads((meta / "info.json").read_text())["features"]
    assert json.loads((meta / "source_features.json").read_text())[key]["dtype"] == "video"
    assert any(name.startswith(f"videos/{key}/") for name in read_files(tmp_path / "set"))


def test_a_camera_without_a_picture_that_can_be_read_has_statistics_that_change_nothing():
    entry = LogHistogram.of(np.zeros(4)).stats(FeatureMoments.of(np.zeros((0, 1))), 3, (1, 1, 1))
    assert {k: np.ravel(v).tolist() for k, v in entry.items() if k in ("min", "max", "mean", "std")} == {
        "min": [0.0], "max": [1.0], "mean": [0.0], "std": [1.0]
    }  # fmt: skip


def test_the_range_of_a_map_is_that_of_most_pixels():
    """One pixel in a thousand at 35 m in a room of 7 m, over two frames: no range that a policy is to divide by."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0.5, 7.0, 20_000)
    x[::1000], x[1::10] = 35.0, 0.0
    histogram = LogHistogram.of(x[:9000]) + LogHistogram.parse(LogHistogram.of(x[9000:]).pack())
    entry = histogram.stats(FeatureMoments.of(x[x > 0, None]), 2, (1, 1, 1))
    for name, fraction in (("min", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("max", 0.99)):
        assert np.ravel(entry[name])[0] == pytest.approx(np.quantile(x[x > 0], fraction), rel=0.02), name
    assert np.ravel(entry["mean"])[0] == pytest.approx(x[x > 0].mean())


def test_what_is_known_to_less_than_half_a_step_is_known_to_one(robot, tmp_path):
    """Depth in whole metres: nothing that has a depth is said to have none, or to be known exactly."""
    assert main(["enrich", str(robot), str(tmp_path / "set"), *ASKED, "step=1"]) == 0
    for row in read_rows(tmp_path / "set"):
        depth, sigma, source = (decode_map(row, k) for k in (DEPTH, f"{DEPTH}_sigma", f"{CAMERA}_dhtorch_source"))
        assert set(np.unique(depth)) <= set(range(8)) and np.array_equal(depth > 0, source > 0)
        assert sigma[depth > 0].min() == 1 / 8


@pytest.mark.parametrize(
    ("target", "name", "after"),
    [
        (LeRobotTarget, "_copy_videos", 1),
        pytest.param(shards, "write_shard", 2, marks=pytest.mark.slow),
        pytest.param(storage, "write_json", 2, marks=pytest.mark.slow),
    ],
)
def test_interrupted_anywhere_the_same_command_gives_the_same_bytes(
    target, name, after, robot, enriched, tmp_path, monkeypatch, capsys
):
    out, real, calls = tmp_path / "set", getattr(target, name), itertools.count()

    def stopped(*args, **options):
        if next(calls) == after:
            raise KeyboardInterrupt
        return real(*args, **options)

    monkeypatch.setattr(target, name, stopped)
    assert main(["enrich", str(robot), str(out), *ASKED]) == 130 and not (out / "meta" / "info.json").exists()
    assert "run the same command again for the rest" in capsys.readouterr().err
    assert main(["enrich", str(robot), str(out), *ASKED]) == 0 and read_files(out) == read_files(enriched)


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_an_episode_of_an_older_set_is_counted_from_0_and_its_numbers_stay_beside(shots, tmp_path, version):
    source, out = robot_set(tmp_path / "old", shots, 2), tmp_path / "new"
    words = ["data=lerobot", "data.episode=1", *(["format=same"] if version == "v2.1" else [])]
    assert main(["enrich", str(source), str(out), *ASKED, *words]) == 0
    columns = {
        name: [row[name] for row in read_rows(out)] for name in ("episode_index", "index", "source.episode_index")
    }
    assert list(columns.values()) == [[0] * LENGTHS[1], list(range(LENGTHS[1])), [1] * LENGTHS[1]]
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["codebase_version"] == version and "source.index" in info["features"]
    origin = source / "videos" / "chunk-000" / CAMERA / "episode_000001.mp4"
    copied = out / "videos" / CAMERA / "chunk-000" / "file-000.mp4"
    if version == "v2.1":
        copied = out / "videos" / "chunk-000" / CAMERA / "episode_000000.mp4"
        lines = (out / "meta" / "episodes.jsonl").read_text().splitlines()
        assert info["total_chunks"] == 1 and [json.loads(line)["episode_index"] for line in lines] == [0]
        assert (out / "data" / "chunk-000" / "episode_000000.parquet").is_file()
    assert copied.read_bytes() == origin.read_bytes()


def test_a_recording_becomes_a_set(tmp_path, capsys):
    folder = tmp_path / "room"
    assert main(["enrich", "out=" + str(folder), "data=synthetic", "data.hw=[48,64]", "data.n_frames=3", *ASKED]) == 0
    stored_outputs.check("enrich", tmp_path, printed=capsys.readouterr().out, folder=folder)
    found = read_rows(folder)
    assert [row["frame_index"] for row in found] == [0, 1, 2]
    assert np.array(Image.open(io.BytesIO(found[0]["observation.images.camera"]["bytes"]))).shape == (*HW, 3)


def test_a_nerfstudio_folder_becomes_one(shots, tmp_path):
    writers.write_nerfstudio(tmp_path / "room", shots[:3])
    out = tmp_path / "out"
    assert main(["enrich", str(tmp_path / "room"), str(out), *ASKED, "format=same"]) == 0
    again = data.open(out)
    assert again.format == "nerfstudio" and len(again) == 3
    assert torch.equal(again[1].image, shots[1].image)


def test_a_table_without_frame_index_counts_its_rows(shots, tmp_path):
    """As GR00T's sets: the first row bears a time that the video does not know."""
    source = robot_set(tmp_path / "set", shots, 2)
    for table in (source / "data").rglob("*.parquet"):
        read = parquet.read_table(table).drop_columns(["frame_index"])
        stamps = np.asarray(read.column("timestamp")) + np.float32(0.05)
        place = read.column_names.index("timestamp")
        parquet.write_table(read.set_column(place, "timestamp", [stamps]), table, row_group_size=3)
    recording = data.open_all(source)[0]
    assert recording.number.tolist() == list(range(LENGTHS[0])) and float(recording.times[0]) == 0
    assert recording[2].hw == HW  # its video frame is found
    assert any("by the order of rows" in line for line in recording.report)
    out = tmp_path / "new"
    assert main(["enrich", str(source), str(out), *ASKED]) == 0
    found = read_rows(out)
    assert found[0]["timestamp"] == 0 and found[0]["source.timestamp"] == pytest.approx(0.05)
    assert [row["frame_index"] for row in found] == [*range(LENGTHS[0]), *range(LENGTHS[1])]
    assert all((decode_map(row, DEPTH) > 0).any() for row in found)


def test_a_picture_that_no_camera_reads_has_statistics(shots, tmp_path):
    """LeRobot's training ends in an error without those of any picture: here, another camera that is not enriched."""
    source, other = tmp_path / "source", "observation.images.other"
    writers.write_lerobot(source, [shots[:3]], image="image", depth="tiff")
    info = json.loads((source / "meta" / "info.json").read_text())
    info["features"][other] = info["features"][CAMERA]
    (source / "meta" / "info.json").write_text(json.dumps(info))
    (file,) = (source / "data").rglob("*.parquet")
    table = parquet.read_table(file)
    parquet.write_table(table.append_column(other, table[CAMERA]), file)
    words = ["data=lerobot", f"data.camera={CAMERA}", *ASKED, "dense=false", "gap=1", "report=false"]
    assert main(["enrich", str(source), str(tmp_path / "set"), *words]) == 0
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    pictures = np.stack([decode_map(row, CAMERA) for row in read_rows(source)]) / 255
    for key, part in ((CAMERA, pictures), (other, pictures[:1])):  # of the latter every eighth
        for name, value in (("mean", part.mean((0, 1, 2))), ("std", part.std((0, 1, 2))), ("max", part.max((0, 1, 2)))):
            assert np.ravel(stats[key][name]) == pytest.approx(value, rel=1e-6), (key, name)


def test_the_card_states_cameras_shares_and_the_licence_of_the_source(enriched, shots, tmp_path, capsys):
    card = (enriched / "README.md").read_text()
    assert "license:" not in card and "not stated by the source" in card and "lerobot-train" not in card
    source = tmp_path / "source"
    writers.write_lerobot(source, [shots[:3]], depth="tiff")
    (source / "README.md").write_text("---\npretty_name: x\nlicense: cc-by-4.0\ntags:\n- LeRobot\n---\n# Mine\n")
    assert main(["enrich", str(source), str(tmp_path / "set"), *ASKED, "dense=false", "gap=1", "report=false"]) == 0
    card = (tmp_path / "set" / "README.md").read_text()
    head, body = card.removeprefix("---\n").split("---\n", 1)
    assert "license: cc-by-4.0\n" in head and "- LeRobot\n" in head and "data_files: data/*/*.parquet" in head
    assert (tmp_path / "set" / "README.source.md").read_text().endswith("# Mine\n")
    (line,) = (line for line in body.splitlines() if line.startswith(f"| `{CAMERA}`"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    said = capsys.readouterr().out
    parts = [
        f"{kind} {cell}" for kind, cell in zip(("recovered", "filled", "sensor", "no answer"), cells[4:8], strict=True)
    ]
    assert cells[1:3] == ["64×48", "64×48"] and ", ".join(parts) in said
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    assert cells[-2] == f"{stats[DEPTH]['q01'][0][0][0]:.2f}–{stats[DEPTH]['q99'][0][0][0]:.2f}"
    K = shots[0].camera
    assert cells[3].startswith(f"{float(K.f[0, 0]):.1f}") and f'dataset[0]["{DEPTH}"]' in body
