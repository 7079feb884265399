"""The page of clients: its table is made of the result files, and what it says of a client is said once."""

import json
import sys
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
sys.path.append(str(REPO / "benchmarks"))

import cells as cells_of_pages  # noqa: E402
import client_tables  # noqa: E402


def row(loader, target="lerobot v3.0", **more):
    """A row of clients.json."""
    plain = {"source": "s", "target": target, "loader": loader, "options": [], "opened": True, "compared": None}
    return {**plain, "why": "", **more}


def write(folder, monkeypatch, **files):
    """Result files in a folder of their own."""
    programs = {name: [] for name in ("clients", "lerobot_train", "lerobot_plugin", "readers_3d")}
    for name, rows in (programs | files).items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    monkeypatch.setattr(cells_of_pages, "RESULTS", folder)


def cells(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def test_sets_are_counted_by_client_version_and_command(tmp_path, monkeypatch):
    off = {"compared": {"largest_difference": {"depth": 0.002}}}
    failed = {"opened": False, "why": "BackwardCompatibilityError: is in 2.1 format"}
    rows = [row("lerobot 0.4.4", **off), row("lerobot 0.4.4"), row("lerobot 0.4.4", "lerobot v2.1", **failed)]
    rows += [row("torch 2.10.0", opened=False, why="not installed"), row("nerfstudio 1.1.5, its parser", "nerfstudio")]
    write(tmp_path, monkeypatch, clients=rows)
    assert cells(client_tables.clients()) == [
        ["LeRobot", "0.4.4", "`enrich format=lerobot`", "2 of 2", "2", "", ""],
        ["LeRobot", "0.4.4", "`enrich format=v2.1`", "0 of 1", "–", "supports only v3.0", "`enrich format=lerobot`"],
        [
            "PyTorch",
            "2.10.0",
            "`enrich format=lerobot`",
            "not run",
            "–",
            "not run",
            client_tables.explain("not run")[1],
        ],
        ["nerfstudio's parser", "1.1.5", "`enrich format=nerfstudio`", "1 of 1", "–", "", ""],
    ]


def test_columns_for_policies_are_a_command_of_their_own(tmp_path, monkeypatch):
    write(tmp_path, monkeypatch, clients=[row("openpi_client 0.1.2", options=["x=1", "columns=[depth,point_cloud]"])])
    assert cells(client_tables.clients())[0][2] == "`enrich format=lerobot columns=[depth,point_cloud]`"


def test_commands_plugin_and_readers_have_rows_and_what_was_not_run_never_passes(tmp_path, monkeypatch):
    train = {"set": "robot", "command": "act", "lerobot": "0.6.1", "passed": None, "why": "not run"}
    plugin = {"lerobot": "0.6.1", "test": "t", "passed": True, "why": ""}
    reader = {"reader": "Open3D", "version": None, "written_by": "recover", "state": "failed", "why": "a | b"}
    write(tmp_path, monkeypatch, clients=[], lerobot_train=[train], lerobot_plugin=[plugin] * 2, readers_3d=[reader])
    found = {(name, command): (passed, why) for name, _, command, passed, _, why, _ in cells(client_tables.clients())}
    assert found == {
        ("LeRobot", "`lerobot-train --policy.type=act`"): ("not run", "not run"),
        ("LeRobot", "tests of `integrations/lerobot`"): ("2 of 2", ""),
        ("Open3D", "`dhtorch PATH`"): ("0 of 1", "a / b"),
    }


def test_every_failure_in_the_result_files_has_a_fix():
    for outcome in client_tables.list_outcomes():
        if not outcome.passed:
            assert client_tables.explain(outcome.why)[1], outcome
