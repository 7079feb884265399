"""benchmarks/clients: every client takes its training step on a tiny enriched set, where its package is."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from pyarrow import parquet
from support.sample_dicts import room
from support.writers import write_rlds

from dhtorch.cli.run import main
from dhtorch.functional.policy_inputs import NEAREST_M

CLIENTS = Path(__file__).resolve().parents[1] / "benchmarks" / "clients"
ROOM = ["data=synthetic", "data.hw=[64,80]", "data.n_frames=4", "method=paper", "method.n=32", "method.hypotheses=8"]
SETS = {"torch_loader": (), "hf_datasets": ("datasets",), "webdataset_stream": ("webdataset",)}
SETS |= {"lerobot_policy": ("lerobot",), "compare_lerobot": ("lerobot",)}
SETS["openpi_transforms"] = ("openpi_client",)


@pytest.fixture(scope="module")
def enriched(tmp_path_factory):
    """The built-in room as a LeRobot set and as a nerfstudio folder."""
    folder = tmp_path_factory.mktemp("enriched")
    for name in ("lerobot", "nerfstudio"):
        more = ["dense=false", "gap=1", "report=false", f"format={name}", f"out={folder / name}"]
        assert main(["enrich", *ROOM, *more]) == 0
    return folder


@pytest.fixture
def client(monkeypatch, capsys):
    """A client's ``main`` here: what it said."""
    monkeypatch.syspath_prepend(str(CLIENTS))

    def asked(name, *words):
        importlib.import_module(name).main(*map(str, words))
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return asked


@pytest.mark.parametrize("name", SETS)
def test_a_client_takes_its_step(name, enriched, client, tmp_path):
    for package in SETS[name]:
        pytest.importorskip(package)
    more = {"webdataset_stream": [tmp_path / "rows.tar"], "torch_loader": [0]}  # no fork of a process with threads
    said = client(name, enriched / "lerobot", *more.get(name, ()))
    assert said["frames"] == 4
    if name == "compare_lerobot":
        assert max(said["largest_difference"].values()) < 1e-6
    else:
        assert said["loss"] > 0 and said["tokens_known"] > 5 and said["target"].endswith("T_world_from_cam")


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The set of two cameras with actions and depth, as it is written and enriched."""
    folder = tmp_path_factory.mktemp("robot")
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(str(CLIENTS))
        importlib.import_module("written").write_robot(folder / "source")
    more = ["data=lerobot", "method=paper", "method.n=32", "method.hypotheses=8", "dense={size: 40}", "report=false"]
    assert main(["enrich", str(folder / "source"), str(folder / "set"), *more, "gap=1", "format=lerobot"]) == 0
    return folder


@pytest.mark.slow
def test_actions_and_depth_of_two_cameras_arrive_together(robot, client):
    said = client("torch_loader", robot / "set", 0)
    assert said["target"] == "action" and said["frames"] == 12 and said["tokens_known"] > 5


@pytest.mark.slow
def test_actions_state_and_statistics_are_kept(robot):
    """What LeRobot normalises by is there for both cameras, and the arm's numbers are the source's."""
    stats = json.loads((robot / "set" / "meta" / "stats.json").read_text())
    cameras = [f"observation.images.{side}{kind}" for side in ("left", "right") for kind in ("", "_depth_enriched")]
    assert set(cameras) | {"observation.state", "action"} <= stats.keys()
    states, found = (
        np.concatenate(
            [
                np.stack(parquet.read_table(f)["action"].to_numpy())
                for f in sorted((robot / name / "data").rglob("*.parquet"))
            ]
        )
        for name in ("source", "set")
    )
    assert found.shape == (12, 8) and np.array_equal(states, found)
    assert np.allclose(stats["action"]["mean"], found.mean(0)) and np.ptp(found, 0).min() >= 0


@pytest.mark.slow
def test_a_picture_that_is_video_ends_a_loader_of_tables_in_a_sentence(robot, client, tmp_path):
    info = json.loads((robot / "set" / "meta" / "info.json").read_text())
    for name in ("observation.images.left", "observation.images.right"):
        info["features"][name]["dtype"] = "video"
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(SystemExit, match=r"observation.images.left is video: found no picture in the tables"):
        client("torch_loader", tmp_path, 0)


@pytest.fixture(scope="module")
def pictured(robot, tmp_path_factory):
    """The robot's set with geometry images and points."""
    out = tmp_path_factory.mktemp("pictured") / "set"
    more = ["data=lerobot", "method=paper", "method.n=32", "method.hypotheses=8", "dense={size: 40}", "report=false"]
    columns = "columns=[depth,sigma,source,geometry_image,point_cloud]"
    assert main(["enrich", str(robot / "source"), str(out), *more, "gap=1", columns]) == 0
    return out


@pytest.mark.slow
def test_groot_reads_geometry_images_by_its_modality(pictured, client):
    said = client("groot_modality", pictured)
    assert said["frames"] == 12 and said["missing"] == [] and said["parts"] == 2 and said["pictures"] == 24
    assert said["known"] > 100 and said["largest_difference"]["inverse depth"] <= 0.5 / (255 * NEAREST_M) * 1.001


@pytest.mark.slow
def test_openpi_resizes_geometry_images_without_new_codes(pictured, client):
    pytest.importorskip("openpi_client")
    assert client("openpi_transforms", pictured)["geometry_known"] > 0.05


def test_nerfstudio_parses_its_folder(enriched, client):
    pytest.importorskip("nerfstudio")
    said = client("nerfstudio_parser", enriched / "nerfstudio")
    assert said["frames"] == 4 and max(said["largest_difference"].values()) < 1e-5


@pytest.mark.slow
def test_ray_actors_extend_the_rows(enriched, client):
    pytest.importorskip("ray.data")
    said = client("ray_data", enriched / "lerobot")
    assert said["frames"] == 4 and said["batch"] == [3, 16, 10] and said["tokens_known"] > 5


def test_rlds_steps_without_tensorflow(client, tmp_path):
    write_rlds(tmp_path, [[room()[i] for i in range(n, n + 3)] for n in (0, 3)])
    said = client("rlds_steps", tmp_path)
    assert said["frames"] == 6 and said["tokens_known"] > 5 and said["loss"] > 0


def test_nerfstudio_says_what_the_columns_say(enriched, client):
    said = client("compare_nerfstudio", enriched / "nerfstudio", enriched / "lerobot")
    assert said["frames"] == 4 and said["largest_difference"]["depth"] <= 1e-3
    assert said["largest_difference"]["numbers"] < 1e-9
