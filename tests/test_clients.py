"""benchmarks/clients: every client takes its training step on a tiny enriched set, where its package is."""

import importlib
import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("pyarrow")

from sample_dicts import room

from dhtorch.commands.run import main
from dhtorch.testing import write_rlds

CLIENTS = Path(__file__).resolve().parents[1] / "benchmarks" / "clients"
ROOM = ["data=synthetic", "data.hw=[64,80]", "data.n_frames=4", "method=paper", "method.n=32", "method.hypotheses=8"]
SETS = {"torch_loader": (), "openpi_transforms": (), "hf_datasets": ("datasets",), "webdataset_stream": ("webdataset",)}
SETS |= {"lerobot_policy": ("lerobot",), "compare_lerobot": ("lerobot",)}


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


def test_rlds_steps_without_tensorflow(client, tmp_path):
    write_rlds(tmp_path, [[room()[i] for i in range(n, n + 3)] for n in (0, 3)])
    said = client("rlds_steps", tmp_path)
    assert said["frames"] == 6 and said["tokens_known"] > 5 and said["loss"] > 0


def test_nerfstudio_says_what_the_columns_say(enriched, client):
    said = client("compare_nerfstudio", enriched / "nerfstudio", enriched / "lerobot")
    assert said["frames"] == 4 and said["largest_difference"]["depth"] <= 1e-3
    assert said["largest_difference"]["numbers"] < 1e-9


def test_a_failure_is_said_in_one_line_without_folders(client):
    """What becomes of a client's traceback in the table."""
    sys.path.insert(0, str(CLIENTS))
    try:
        ask = importlib.import_module("all")
    finally:
        sys.path.remove(str(CLIENTS))
    found, why = ask.call(sys.executable, "-c", "raise OSError('no file /tmp/some/where.txt')")
    assert found is None and why == "OSError: no file where.txt"
    assert ask.call(sys.executable, "-c", "print('{\"frames\": 3}')") == ({"frames": 3}, "")
    assert len(ask.short("word " * 100)) == 160
