"""Extraction on a Ray cluster on this machine: the rows of one process, bit for bit, also when a node dies."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("ray.data")
pytest.importorskip("pyarrow")

from dhtorch.extract import FeatureTable

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

STORE = 150_000_000  # bytes of shared memory of a node
ROWS, EACH = 128, 4
SETTINGS = [
    *["data.hw=[60,80]", f"data.n_frames={ROWS}", "data.supersample=1", "data.lidar=exact"],
    *["method=paper", "method.n=256", f"extract.shard_rows={EACH}"],
]


def quiet_environment():
    here = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": path}


@pytest.fixture
def cluster(monkeypatch):
    """A head that computes nothing and two raylets of one core each; ended by process id."""
    for name, value in quiet_environment().items():
        monkeypatch.setenv(name, value)
    started = patiently(head)
    try:
        nodes = [patiently(partial(started.add_node, num_cpus=1, object_store_memory=STORE)) for _ in range(2)]
        yield started.address, [raylet(node) for node in nodes]
    finally:
        started.shutdown()


def head():
    from ray.cluster_utils import Cluster  # noqa: PLC0415

    options = {"num_cpus": 0, "object_store_memory": STORE, "include_dashboard": False}
    return Cluster(initialize_head=True, head_node_args=options)


def patiently(make, tries=4):
    """Ray gives a node 30 s to come up, which is not enough on a busy machine."""
    for k in range(tries):
        try:
            return make()
        except Exception:
            if k + 1 == tries:
                raise
    return None


def raylet(node):
    return node.all_processes["raylet"][0].process.pid


def start(folder, *args):
    with (folder / "out").open("w") as out, (folder / "err").open("w") as err:
        command = [sys.executable, "-m", "dhtorch", "extract", *SETTINGS, *args]
        return subprocess.Popen(command, cwd=folder, env=quiet_environment(), stdout=out, stderr=err)


def contents(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*.parquet"))}


def until(folder, process, n):
    """Wait for ``n`` shards; how many there are."""
    end = time.monotonic() + 300
    while len(contents(folder)) < n and process.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    return len(contents(folder))


def test_a_killed_node_costs_no_row_and_changes_none(tmp_path, cluster):
    address, raylets = cluster
    process = start(tmp_path, "out=ray", "extract.engine=ray", f"extract.address={address}")
    there = until(tmp_path / "ray", process, 4)
    os.kill(raylets[1], signal.SIGKILL)
    assert 4 <= there < ROWS // EACH, (tmp_path / "err").read_text()
    killed = time.monotonic()
    assert process.wait(600) == 0, (tmp_path / "err").read_text()
    print(f"{there} of {ROWS // EACH} shards when the node was killed, the rest took {time.monotonic() - killed:.0f} s")
    assert "Traceback" not in (tmp_path / "err").read_text()
    assert start(tmp_path, "out=one").wait(600) == 0
    assert contents(tmp_path / "ray") == contents(tmp_path / "one")
    assert FeatureTable(tmp_path / "ray", ["depth"]).place["frame_index"].tolist() == list(range(ROWS))


def test_a_killed_driver_resumes_with_another_engine(tmp_path):
    """A cluster that the command starts itself; killed, the rest is done by this machine alone."""
    process = start(tmp_path, "out=ray", "extract.engine=ray")
    there = until(tmp_path / "ray", process, 2)
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130, (tmp_path / "err").read_text()
    err = (tmp_path / "err").read_text()
    assert 2 <= there < ROWS // EACH and "complete and stay" in err and "Traceback" not in err, err
    before = contents(tmp_path / "ray")
    assert start(tmp_path, "out=ray").wait(600) == 0
    after = contents(tmp_path / "ray")
    assert len(after) == ROWS // EACH and {k: after[k] for k in before} == before


def test_a_corrupt_frame_and_a_missing_cluster_are_one_line(tmp_path):
    from support import writers  # noqa: PLC0415

    from dhtorch.synthetic.recording import SyntheticRoom  # noqa: PLC0415

    room = SyntheticRoom(hw=(60, 80), n_frames=6, lidar="exact", supersample=1)
    writers.write_counted_frames(tmp_path / "set", [room[i] for i in range(6)])
    image = tmp_path / "set" / "images" / "00003.png"
    image.write_bytes(image.read_bytes()[:300])
    options = ["data=auto", f"data.root={tmp_path / 'set'}", "extract.gap=2", "method=paper", "method.n=64", "out=x"]
    for extra, words in (
        (["extract.engine=ray"], ["00003.png", "frame 3"]),
        (["extract.engine=ray", "extract.address=127.0.0.1:1"], ["127.0.0.1:1"]),
    ):
        command = [sys.executable, "-m", "dhtorch", "extract", *options, *extra]
        done = subprocess.run(
            command, check=False, cwd=tmp_path, env=quiet_environment(), capture_output=True, text=True
        )
        lines = [line for line in done.stderr.strip().splitlines() if "depth unit assumed" not in line]
        assert done.returncode == 2 and len(lines) == 1, done.stderr
        assert all(word in done.stderr for word in words), done.stderr
