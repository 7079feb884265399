"""README says what the result files say, and its example runs."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dhtorch import archive

REPO = Path(__file__).resolve().parents[1]
README = (REPO / "README.md").read_text()


def test_tables_are_those_of_the_result_files():
    done = subprocess.run([sys.executable, "benchmarks/readme.py", "--check"], cwd=REPO, check=False)
    assert done.returncode == 0, "run: python benchmarks/readme.py"


@pytest.mark.parametrize("path", sorted((REPO / "benchmarks/results").glob("*.json")), ids=lambda p: p.name)
def test_committed_results_are_valid(path):
    if isinstance(json.loads(path.read_text()), dict):  # the others are rows of benchmarks
        archive.read(path)


def test_the_examples_run(capsys):
    first, *others = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(first.strip().splitlines()) <= 12
    assert "SyntheticRoom()" in first
    for code in (first, *others):
        smaller = code.replace(
            "SyntheticRoom()", "SyntheticRoom(hw=(120, 160), supersample=1)"
        )  # seconds, not a minute
        exec(compile(smaller, "README.md", "exec"), {})
    assert "answers" in capsys.readouterr().out


def test_links_and_names_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("http") or (REPO / target).exists(), target
    for name in re.findall(r"`(stages\.[\w.]+)`", README):
        module, _, function = f"dhtorch.{name}".rpartition(".")
        assert hasattr(__import__(module, fromlist=["x"]), function), name
    for file in re.findall(r"`((?:conf|dhtorch|notebooks|benchmarks)/[\w/.]+)`", README):
        assert (REPO / file).exists(), file
