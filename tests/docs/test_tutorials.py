"""The tutorials: every command and every Python block of a page runs in its order, in an empty folder."""

import re
import shlex
from pathlib import Path

import pytest

from dhtorch.cli.run import main

REPO = Path(__file__).resolve().parents[2]
TUTORIALS = REPO / "docs" / "tutorials"

#: What a tutorial leaves behind.
MADE = {
    "phone_scan": ["dhtorch_out/room/view.html", "dhtorch_out/room/map.ply", "dhtorch_out/room/overview.png"],
    "lerobot_set": ["trial/meta/report.html", "trial/README.md", "trial/meta/stats.json"],
    "depth_network": ["before/validate.html", "before/validate.json", "metric/align.html"],
    "ablation_sweep": ["one/result.json", "sweep/sweep.csv", "sweep.html"],
}


def blocks(page):
    """(language, text) of the blocks of a page that run."""
    return re.findall(
        r"^```(python|bash)\n(.*?)^```", (TUTORIALS / f"{page}.md").read_text(encoding="utf-8"), re.M | re.S
    )


def expected_code(line):
    """The exit code that a command's comment states; 0 without one."""
    stated = re.search(r"# exit code (\d)$", line)
    return int(stated[1]) if stated else 0


def masked(text):
    """Text with N for every number: other processors round otherwise."""
    return re.sub(r"\d[\d.,]*", "N", text)


def shown(page):
    """Lines of output that a page shows; blocks of code that is not run do not count."""
    text = (TUTORIALS / f"{page}.md").read_text(encoding="utf-8")
    output = re.findall(r"^```text\n(.*?)^```", text, re.M | re.S)
    return [line for block in output if "LeRobotDataset" not in block for line in block.strip("\n").splitlines()]


def test_every_tutorial_is_run():
    assert {p.stem for p in TUTORIALS.glob("*.md")} == set(MADE)


@pytest.mark.slow
@pytest.mark.parametrize("page", MADE)
def test_a_tutorial_works_as_it_is_written(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DHTORCH_DATA", raising=False)
    names: dict = {}
    for language, text in blocks(page):
        if language == "python":
            exec(compile(text, f"{page}.md", "exec"), names)
            continue
        for line in text.strip().splitlines():
            program, *arguments = shlex.split(line, comments=True)
            assert program == "dhtorch"
            assert main(arguments) == expected_code(line), (line, capsys.readouterr().err)
    printed = masked(capsys.readouterr().out)
    assert not [name for name in MADE[page] if not (tmp_path / name).is_file()]
    for line in shown(page):
        assert masked(line) in printed, line
    if page == "lerobot_set":
        share = [float((names[name][2].depth > 0).float().mean()) for name in ("sensor", "completed")]
        assert share[1] > share[0] + 0.1, "depth beyond the sensor"
