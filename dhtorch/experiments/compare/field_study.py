"""Question: does every command read captures of other tools with the right unit, orientation, time and axes?

Expectation (written before the run): each command on each case prints the true value, or refuses or warns with the true
cause; controls give no warning.
What would refute it: one command of one case whose output meets none of its accepted forms.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dhtorch.data import scenes_root
from dhtorch.data.scene import SceneLike
from dhtorch.experiments.outcome import MainMetric
from dhtorch.experiments.protocol import Outcome, Progress, ScenePairs, Settings, no_progress
from dhtorch.experiments.rows import Row
from dhtorch.metrics import bootstrap
from dhtorch.pipeline.method import Method

#: Main metrics of the experiment.
_METRICS = (
    MainMetric("cases_right", larger_is_better=True),
    MainMetric("commands_right", larger_is_better=True),
)

QUESTION = "Does every command read captures of other tools with the right unit, orientation, time and axes?"
EXPECTATION = "Each output has the true value, or a refusal or warning with the true cause."

#: Time limit of one command, s.
_MAX_SECONDS = 300

#: Characters of an output that a row keeps.
_MAX_OUTPUT_SHOWN = 600


def run(
    _scenes: Sequence[SceneLike],
    _chosen: Mapping[str, Method],
    _pairs: ScenePairs,
    _settings: Settings,
    *,
    cases: Mapping[str, Sequence[Mapping[str, Any]]],
    root: str | None = None,
    folder: str = "field_cases",
    progress: Progress = no_progress,
) -> Outcome:
    """Run each command of each case in its folder and compare the output with the accepted forms.

    Args:
        cases: folder → commands. A command has ``run`` (arguments of ``dhtorch``, ``{out}`` = a temporary folder; or
            ``python FILE``) and ``accept``, a list of forms; a form is a list of checks that must all hold, see
            :func:`holds`.
        root: folder of the shared data; None = the environment variable ``DHTORCH_DATA``.
        folder: folder of the cases below it.

    Rows: one per command, with ``right`` and the output; one per case, right if all its commands are. The scenes and
    methods of the settings are not used.
    """
    base = scenes_root(root) / folder
    outcome = Outcome(metrics=_METRICS)
    for name in progress(list(cases), "cases", len(cases)):
        with tempfile.TemporaryDirectory() as scratch:
            rows = [_command_row(base / name, command, Path(scratch) / str(k)) for k, command in enumerate(cases[name])]
        right = all(row["right"] for row in rows)
        outcome.rows += rows
        outcome.rows.append(
            {"scene": name, "pair": None, "method": "field", "truth": None, "right": right, "n_commands": len(rows)}
        )
    right_cases = [float(row["right"]) for row in outcome.rows if row["pair"] is None]
    right_commands = [float(row["right"]) for row in outcome.rows if row["pair"] is not None]
    outcome.summary = {
        "field.cases_right": bootstrap.without_interval(sum(right_cases) / len(right_cases), len(right_cases)),
        "field.commands_right": bootstrap.without_interval(
            sum(right_commands) / len(right_commands), len(right_commands)
        ),
    }
    wrong = [row["scene"] for row in outcome.rows if row["pair"] is None and not row["right"]]
    why = f"{len(right_cases) - len(wrong)} of {len(right_cases)} cases" + (f"; not: {', '.join(wrong)}" * bool(wrong))
    return outcome.decide(QUESTION, EXPECTATION, not wrong, why)


def _command_row(case: Path, command: Mapping[str, Any], out: Path) -> Row:
    """One command of a case → row."""
    text, code = run_command(case, command["run"], out)
    right = any(all(holds(check, text, code, out) for check in form) for form in command["accept"])
    return {
        "scene": case.name,
        "pair": [0, 0],
        "method": command["run"],
        "truth": None,
        "right": right,
        "exit": code,
        "output": text.replace(str(out.parent), "TMP")[-_MAX_OUTPUT_SHOWN:],
    }


def run_command(case: Path, arguments: str, out: Path) -> tuple[str, int]:
    """Run one command in the folder of a case → (standard output and error with single spaces, exit code)."""
    out.mkdir(parents=True)
    words = [word.replace("{out}", str(out)) for word in arguments.split()]
    start = [sys.executable] if words[0] == "python" else [sys.executable, "-m", "dhtorch"]
    words = words[1:] if words[0] == "python" else words
    package = Path(__file__).resolve().parents[3]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(package), os.environ.get("PYTHONPATH", "")))}
    try:
        done = subprocess.run(
            [*start, *words],
            check=False,
            cwd=case,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_MAX_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return f"no end after {_MAX_SECONDS} s", -1
    return re.sub(r"\s+", " ", f"{done.stdout} {done.stderr}"), done.returncode


def holds(check: Mapping[str, Any], text: str, code: int, out: Path) -> bool:
    """Whether an output passes a check.

    ``see`` / ``unseen``: a regular expression that occurs, or does not occur, in the output, ignoring case. ``number``:
    one whose first group is a number in the interval ``within``. ``exit``: the exit code. With ``file``, a name below
    the output folder, the text of that file is examined instead; a missing file fails.
    """
    if "file" in check:
        file = out / check["file"]
        if not file.is_file():
            return False
        text = re.sub(r"\s+", " ", file.read_text(encoding="utf-8", errors="replace"))
    if "exit" in check and code != check["exit"]:
        return False
    if "see" in check and not re.search(check["see"], text, re.IGNORECASE):
        return False
    if "unseen" in check and re.search(check["unseen"], text, re.IGNORECASE):
        return False
    if "number" in check:
        match = re.search(check["number"], text, re.IGNORECASE)
        low, high = check["within"]
        return match is not None and low <= float(match[1].replace(",", "")) <= high
    return True
