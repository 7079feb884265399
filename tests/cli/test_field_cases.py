"""Captures as other tools write them: every command prints the true value, or refuses or warns with the true cause."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

REPO = Path(__file__).resolve().parents[2]
CASES = yaml.safe_load(Path(__file__).with_name("field_cases.yaml").read_text())
COMMANDS = [(case, command["run"], command["accept"]) for case, commands in CASES.items() for command in commands]


def holds(check, text, code):
    """``see``, ``unseen``: an expression occurs, or does not; ``number``: the group of one lies within; ``exit``."""
    number = re.search(check.get("number", ""), text, re.IGNORECASE)
    low, high = check.get("within", (None, None))
    return (
        code == check.get("exit", code)
        and re.search(check.get("see", ""), text, re.IGNORECASE) is not None
        and not ("unseen" in check and re.search(check["unseen"], text, re.IGNORECASE))
        and (low is None or (number is not None and low <= float(number[1].replace(",", "")) <= high))
    )


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif("DHTORCH_DATA" not in os.environ, reason="DHTORCH_DATA is not set")
@pytest.mark.parametrize(("case", "arguments", "accept"), COMMANDS, ids=[f"{c}: {run}" for c, run, _ in COMMANDS])
def test_field_case(case, arguments, accept, tmp_path):
    words = [word.replace("{out}", str(tmp_path)) for word in arguments.split()]
    start = [sys.executable] if words[0] == "python" else [sys.executable, "-m", "dhtorch"]
    done = subprocess.run(
        [*start, *words[words[0] == "python" :]],
        check=False,
        cwd=Path(os.environ["DHTORCH_DATA"]) / "field_cases" / case,
        env={**os.environ, "PYTHONPATH": str(REPO)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    text = re.sub(r"\s+", " ", f"{done.stdout} {done.stderr}")
    assert any(all(holds(check, text, done.returncode) for check in form) for form in accept), text[-900:]
