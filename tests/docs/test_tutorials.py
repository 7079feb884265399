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
    printed = re.sub(r"[\d.,]+", "N", capsys.readouterr().out)
    assert not [name for name in MADE[page] if not (tmp_path / name).is_file()]
    if page == "lerobot_set":
        sensor, completed = re.findall(r"N% of the pixels have a depth", printed)
        assert sensor and completed
        share = [float((names[name][2].depth > 0).float().mean()) for name in ("sensor", "completed")]
        assert share[1] > share[0] + 0.1, "depth beyond the sensor"
    if page == "phone_scan":
        shown = re.search(
            r"^```text\n(.*?)^```", (TUTORIALS / "phone_scan.md").read_text(encoding="utf-8"), re.M | re.S
        )
        for line in shown[1].strip().splitlines():
            assert re.sub(r"[\d.,]+", "N", line) in printed, line
