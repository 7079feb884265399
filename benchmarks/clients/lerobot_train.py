"""``lerobot-train``, as installed, on sets that ``dhtorch enrich`` wrote, and README's example of a loader.

python benchmarks/clients/lerobot_train.py --lerobot PYTHON --lerobot PYTHON --json FILE

Two steps on the CPU, with no option about features or statistics. For each of :data:`VERSIONS` that no interpreter has,
the rows that FILE holds are kept; where there are none, they say ``not run``. An interpreter in another root folder is
named by a script that enters it.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from all import POLICY_COLUMNS, SOURCES, call, enriched, environment, short, versions

#: Versions of LeRobot: the last that runs on Python 3.11, and the newest, which needs 3.12.
VERSIONS = ("0.4.4", "0.6.1")

#: Policy → options that make its network small, for a CPU.
POLICIES: dict[str, tuple[str, ...]] = {
    "act": ("--policy.chunk_size=16", "--policy.n_action_steps=16"),
    "diffusion": ("--policy.down_dims=[64,128,256]",),
}

#: Set → what it is there for; each has an action and a state, which these policies want.
SETS = {
    "robot": "depth",
    "two-camera robot": "depth, two cameras",
    "GR00T, LeRobot v2.0": "no depth anywhere",
    "RLDS": "no depth anywhere, four cameras of which one is enriched",
    "two-camera robot, pictures and points": "geometry images and points of two cameras",
    "GR00T, LeRobot v2.0, pictures and points": "geometry images and points without any depth",
}

#: End of the name of a set that is another one with columns for policies of pictures or points.
POLICY = ", pictures and points"

#: Name of the example in README, which is run as it stands.
EXAMPLE = "README"

#: What every run has; ``{root}`` is the set, ``{out}`` a new folder.
OPTIONS = (
    *("--policy.push_to_hub=false", "--policy.pretrained_backbone_weights=null", "--policy.device=cpu"),
    *("--dataset.repo_id=local/set", "--dataset.root={root}", "--dataset.video_backend=pyav"),
    *("--steps=2", "--batch_size=1", "--num_workers=0", "--save_checkpoint=false", "--log_freq=1"),
    "--output_dir={out}",
)

#: Seconds after which a run has failed.
LIMIT_S = 1800


def train(python: str, policy: str, root: Path) -> dict[str, Any]:
    """Whether a run ended well, the loss of its last step, and else its last words."""
    with tempfile.TemporaryDirectory() as folder:
        places = {"root": str(root), "out": f"{folder}/out"}
        words = [f"--policy.type={policy}", *POLICIES[policy], *(option.format(**places) for option in OPTIONS)]
        command = [python, "-m", "lerobot.scripts.lerobot_train", *words]
        env = environment() | {"HF_HOME": f"{folder}/hf", "PYTHONPATH": ""}
        try:
            done = subprocess.run(command, env=env, capture_output=True, text=True, check=False, timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            return {"passed": False, "loss": None, "why": f"no end within {LIMIT_S} s"}
    said = done.stderr + done.stdout
    losses = [float(word.removeprefix("loss:")) for word in said.split() if word.startswith("loss:")]
    passed = done.returncode == 0 and "End of training" in said and len(losses) == 2
    lines = [line for line in said.splitlines() if "Error" in line.split(":")[0]]
    why = "" if passed else short((lines or said.strip().splitlines() or ["no word"])[-1])
    return {"passed": passed, "loss": losses[-1] if losses else None, "why": why}


def run_readme(python: str) -> dict[str, Any]:
    """Whether README's example of a loader ends well and prints what stands under it."""
    with tempfile.TemporaryDirectory() as folder:
        reply, why = call(python, "readme_snippet.py", folder)
    return {"passed": reply is not None, "loss": None, "why": why, **({} if reply is None else {"unit": reply["unit"]})}


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--set", action="append", choices=[*SETS, EXAMPLE], help="only this one")
    parser.add_argument("--work", type=Path, help="folder of the sets, which are kept; a temporary one")
    parser.add_argument("--json", type=Path, help="rows that are not run now stay as they are in it")
    args = parser.parse_args()
    known = {versions(python).get("lerobot"): python for python in args.lerobot}
    before = json.loads(args.json.read_text()) if args.json and args.json.is_file() else []
    kept = {(row["set"], row["command"], row["lerobot"]): row for row in before}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, version in ((name, version) for name in (*SETS, EXAMPLE) for version in VERSIONS):
            python = known.get(version) if name in (args.set or (*SETS, EXAMPLE)) else None
            source, more = name.removesuffix(POLICY), [POLICY_COLUMNS] if name.endswith(POLICY) else []
            root, why = (
                enriched(source, "lerobot v3.0", args.work or Path(folder), *more)
                if python and name in SETS
                else (None, "")
            )
            if why:
                sys.exit(f"{name}: {why}")
            for command in POLICIES if name in SETS else ("the example",):
                row = {"set": name, "about": SETS.get(name, "a loader with depth tokens"), "command": command}
                row |= {"options": [*SOURCES[source][1:], *more] if name in SETS else [], "lerobot": version}
                if python is None:
                    none = {**row, "passed": None, "loss": None, "why": "not run"}
                    rows.append(kept.get((name, command, version), none))
                    continue
                rows.append(row | (run_readme(python) if root is None else train(python, command, root)))
                print(json.dumps(rows[-1]), flush=True)
                if args.json:
                    args.json.write_text(json.dumps([*rows, *_rest(kept, rows)], indent=1) + "\n")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if all(row["passed"] is not False for row in rows) else 1


def _rest(kept: dict[tuple[str, str, str], dict[str, Any]], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of an earlier run that none of the new ones replaces."""
    made = {(row["set"], row["command"], row["lerobot"]) for row in rows}
    return [row for key, row in kept.items() if key not in made]


if __name__ == "__main__":
    sys.exit(main())
