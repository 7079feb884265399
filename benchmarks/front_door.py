"""The four roles of the front door over every capture: phone scan, robot data set, ablation sweep, depth network check.

    DHTORCH_DATA=/data python benchmarks/front_door.py [--only NAME,NAME] [--roles scan,robot,sweep,network]
        [--minutes N] [--json benchmarks/results/front_door.json]

Only what README, docs/command.md, ``--help`` or the output of an earlier command show is typed, as a process of its own
in an empty folder, with few frames. A role ends in ``ok``, in one sentence with exit code 2 (``said``), or it
``failed``: another exit code, a traceback, more than one line, or a sentence without what was
expected. Results are added to the file, so that several runs complete it.
"""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]

#: Options that keep a run short; all are in the help of their commands.
FEW = ("--max-frames", "2", "--size", "160", "--method.n", "512")

#: Seconds after which a command counts as failed. Source: chosen for two busy cores.
TIMEOUT_S = 400

#: Words one of which a right sentence has: what was expected, or what is required.
RIGHT = re.compile(r"expected|required|requires|need|one frame|no frame|no pair|nothing", re.I)


class Said(Exception):
    """A command that ended in one right sentence."""


class Failed(Exception):
    """A command that ended otherwise."""


def typed(folder: Path, *words: str) -> str:
    """Run ``dhtorch`` with some words in a folder -> standard output."""
    env = {**os.environ, "PYTHONPATH": str(REPO), "OMP_NUM_THREADS": "1"}
    run = [sys.executable, "-m", "dhtorch", *words]
    line = shlex.join(["dhtorch", *words])
    try:
        done = subprocess.run(run, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise Failed(f"{line}: more than {TIMEOUT_S} s") from None
    said = [text for text in done.stderr.splitlines() if text.startswith(("dhtorch: ", "failed: "))]
    last = (said or done.stderr.strip().splitlines() or [""])[-1]
    if done.returncode == 0:
        return done.stdout
    if done.returncode in (1, 2) and said and "Traceback" not in done.stderr and RIGHT.search(last):
        raise Said(f"{line}: {last}")
    raise Failed(f"{line}: exit code {done.returncode}: {last}")


def below(folder: Path, capture: str) -> str:
    """The capture that a sentence of ``dhtorch validate`` names where PATH holds several; PATH itself otherwise."""
    try:
        typed(folder, "validate", capture, "--max-frames", "1", "--method.n", "64", "--size", "64", "--window", "0")
    except (Said, Failed) as end:
        match = re.search(r"captures below, expected one of ([^,]+)", str(end))
        return match[1] if match else capture
    return capture


def retried(folder: Path, options: list[str], *words: str) -> str:
    """As ``typed``; where the sentence names an option for the camera, that is typed, and kept in ``options``."""
    try:
        return typed(folder, *words, *options)
    except Said as said:
        if "data.fov=69" not in str(said) or options:
            raise
        options.append("data.fov=69")
        return typed(folder, *words, *options)


def scan(folder: Path, capture: str) -> None:
    """README, "Your own capture": inspect, PATH, and the command that it prints."""
    options: list[str] = []
    typed(folder, "inspect", capture, "--max-frames", "2")
    out = retried(folder, options, capture, *FEW, "--recordings", "1")
    for line in out.splitlines():
        if line.startswith("Next: ") and ": dhtorch run " in line:
            words = shlex.split(line.rpartition(": dhtorch ")[2])
            typed(folder, *words, "--method.n", "256", "--no-figures", "pairs.stride=20")
            return
        if line.startswith("Next: ") and "left at the time limit" in line:
            return  # on a busy machine; the command shown is the one that was typed, without its limit
    raise Failed("no command was printed as the next step")


def robot(folder: Path, capture: str) -> None:
    """README: enrich, then extract, and the enriched set is read again."""
    few = ("--max-frames", "2", "--method.n", "256")
    options: list[str] = []
    capture = below(folder, capture)
    retried(folder, options, "enrich", capture, "set", *few, "--dense", "{size: 160}")
    typed(folder, "extract", capture, "--out", "features", *few, *options)
    typed(folder, "inspect", "set", "--max-frames", "2")


def sweep(folder: Path, capture: str) -> None:
    """`dhtorch run --help`: a sweep over methods on a capture, and its report."""
    options: list[str] = []
    capture = below(folder, capture)
    words = ("run", capture, "--multirun", "method=paper,map", "--method.n", "256", "pairs.stride=40", "--no-figures")
    retried(folder, options, *words, "--cutoff", "2.0", "--out", "sweep")
    typed(folder, "report", "sweep")


def network(folder: Path, capture: str) -> None:
    """`dhtorch validate --help`: the sensor's depth, then maps (those of complete) validated and aligned."""
    options: list[str] = []
    capture = below(folder, capture)
    small = ("--max-frames", "1", "--method.n", "512")
    retried(folder, options, "complete", capture, "--out", "maps", *small, "--size", "160", "--no-figures")
    maps = "maps" if (folder / "maps" / "depth").is_dir() else None
    typed(folder, "validate", capture, *small, "--size", "96", "--window", "0", "--out", "sensor", *options)
    if maps is not None:  # one recording: several have a folder each
        typed(folder, "validate", capture, "--depth", maps, *small, "--window", "0", "--out", "checked", *options)
        typed(folder, "align", capture, "--depth", maps, "--out", "aligned", *small, *options)


ROLES = {"scan": scan, "robot": robot, "sweep": sweep, "network": network}


def captures(data: Path) -> dict[str, Path]:
    """Name → path of the captures of DHTORCH_DATA and of field_cases."""
    cases = data / "field_cases"
    folders = [p for p in sorted(data.iterdir()) if p.is_dir() and p != cases]
    folders += [p for p in sorted(cases.iterdir()) if p.is_dir()] if cases.is_dir() else []
    return {p.relative_to(data).as_posix(): p for p in folders}


def play(role: str, capture: Path) -> dict[str, str]:
    """One role on one capture -> its end."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            ROLES[role](Path(folder), str(capture))
        except Said as said:
            return {"end": "said", "sentence": str(said).replace(str(capture), "PATH").replace(folder, "…")}
        except Failed as failed:
            return {"end": "failed", "sentence": str(failed).replace(str(capture), "PATH").replace(folder, "…")}
    return {"end": "ok"}


def main() -> int:
    """Play the roles that are not yet in the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, default=REPO / "benchmarks" / "results" / "front_door.json")
    parser.add_argument("--only", help="names of captures, joined by commas")
    parser.add_argument("--roles", default=",".join(ROLES))
    parser.add_argument("--minutes", type=float, default=1e9, help="no further capture is begun after these")
    parser.add_argument("--again", action="store_true", help="play roles again that are in the file and failed")
    options = parser.parse_args()
    git = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=REPO, capture_output=True, text=True, check=False
    )
    rows = json.loads(options.json.read_text(encoding="utf-8")) if options.json.is_file() else []
    played = {(row["capture"], row["role"]): row for row in rows}
    began, found = time.monotonic(), captures(Path(os.environ["DHTORCH_DATA"]))
    wanted = options.only.split(",") if options.only else list(found)
    for name in wanted:
        for role in options.roles.split(","):
            if time.monotonic() - began > 60 * options.minutes:
                break
            if (name, role) in played and not (options.again and played[name, role]["end"] == "failed"):
                continue
            start = time.monotonic()
            end = play(role, found[name])
            played[name, role] = {"capture": name, "role": role, **end, "commit": git.stdout.strip()}
            seconds = time.monotonic() - start
            print(f"{name}: {role}: {end['end']} {end.get('sentence', '')} ({seconds:.0f} s)", flush=True)
            text = json.dumps(list(played.values()), indent=1, ensure_ascii=False)
            options.json.write_text(text + "\n", encoding="utf-8")
    print(dict(Counter(row["end"] for row in played.values())))
    return int(any(row["end"] == "failed" for row in played.values()))


if __name__ == "__main__":
    sys.exit(main())
