"""Which loaders open what ``dhtorch enrich`` makes: source × target × loader, compared by value, trained one step.

python benchmarks/clients/all.py --lerobot PYTHON --lerobot PYTHON --json benchmarks/results/clients.json

Every client runs in its own process, those of packages that are not here in the interpreter that is named:
``--lerobot`` (also of ``datasets``), ``--webdataset``; or ``DHTORCH_CLIENTS``, interpreters with a colon between.
A loader without an interpreter gets a row that says so. Sources are read from ``DHTORCH_DATA``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
REPO = HERE.parents[1]

#: The same quick method for all: what is asked is whether values arrive, not how good they are.
QUICK = ("method=paper", "method.n=128", "gap=2", "dense=false", "report=false")

#: Source → its folder below ``DHTORCH_DATA`` and the options it needs.
SOURCES: dict[str, tuple[str, ...]] = {
    "TUM": ("tum_fr1_desk9", "dense={size: 80}"),
    "TUM, samples alone": ("tum_fr1_desk9",),
    "7-Scenes": ("7s_redkitchen_000",),
    "HoloLens": ("holo_a",),
    "LeRobot v2.1": ("lerobot_g1", "data=lerobot", "data.fov=69", "data.episode=[29]"),
    "GR00T, LeRobot v2.0": ("gr00t_demo", "data=lerobot", "data.fov=69", "data.episode=[4]"),
    "RLDS": (
        "rlds_bridge/bridge_dataset/1.0.0",
        *("data=rlds", "data.fov=69", "data.rate_hz=5", "data.split=train"),
        *("data.camera=observation/image_0", "data.episode=[0,1]"),
    ),
}

#: Target → what ``format=`` is told.
TARGETS = {"lerobot v3.0": "lerobot", "lerobot v2.1": "v2.1", "nerfstudio": "nerfstudio"}

#: Loader that needs only torch, or a package → the script of one training step.
STEPS = {
    "torch": "torch_loader.py",
    "openpi-style": "openpi_transforms.py",
    "datasets": "hf_datasets.py",
    "webdataset": "webdataset_stream.py",
}

#: Packages whose versions name a loader.
PACKAGES = ("lerobot", "datasets", "webdataset", "torch")


def call(python: str, *words: str) -> tuple[dict[str, Any] | None, str]:
    """What a script said as JSON in its last line, or None and its last words."""
    env = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    env["PYTHONPATH"] = os.pathsep.join(filter(None, (str(REPO), env.get("PYTHONPATH"))))
    done = subprocess.run([python, *words], env=env, cwd=HERE, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        last = done.stdout.strip().splitlines()[-1:]
        return (json.loads(last[0]) if last and last[0].startswith("{") else {}), ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    at = next((i for i in reversed(range(len(lines))) if "Error" in lines[i].split(":")[0]), max(len(lines) - 1, 0))
    return None, short(" ".join(lines[at : at + 2]) or "no word")


def short(text: str, most: int = 160) -> str:
    """One line without folders of this machine."""
    words = [Path(w).name if w.count("/") > 1 and w.startswith(("/", "'/")) else w for w in text.split()]
    joined = " ".join(words)
    return joined if len(joined) <= most else joined[: most - 1] + "…"


def versions(python: str) -> dict[str, str]:
    """Version of every package of :data:`PACKAGES` that an interpreter has."""
    code = (
        "import importlib.metadata as m, importlib.util as u, json;"
        f"print(json.dumps({{k: m.version(k) for k in {PACKAGES!r} if u.find_spec(k)}}))"
    )
    return call(python, "-c", code)[0] or {}


def enriched(source: str, target: str, work: Path) -> tuple[Path, str]:
    """The folder of one source in one format, and why there is none; what is there already is not made again."""
    folder, *options = SOURCES[source]
    out = work / f"{source.replace(',', '').replace(' ', '-')}-{TARGETS[target]}"
    root = Path(os.environ["DHTORCH_DATA"]) / folder
    words = ["-m", "dhtorch", "enrich", str(root), str(out), f"format={TARGETS[target]}", *QUICK, *options]
    found, why = call(sys.executable, *words)
    return out, "" if found is not None else why


def loaders(target: str, pythons: Sequence[str]) -> Iterator[tuple[str, str | None, str | None, str | None]]:
    """(loader, interpreter, script that compares, script that trains) of a target."""
    known = {python: versions(python) for python in pythons}
    if target == "nerfstudio":
        yield "transforms.json by its keys", sys.executable, "compare_nerfstudio.py", None
        yield "nerfstudio", None, None, None
        return
    for number in dict.fromkeys(has["lerobot"] for has in known.values() if "lerobot" in has):
        python = next(p for p, has in known.items() if has.get("lerobot") == number)
        yield f"lerobot {number}", python, "compare_lerobot.py", "lerobot_policy.py"
    if target != "lerobot v3.0":
        return
    for package, script in STEPS.items():
        name = "torch" if package == "openpi-style" else package
        having = next((p for p, has in known.items() if name in has), None)
        version = "" if having is None else f" {known[having].get(package, '')}".rstrip()
        yield f"{package}{version}", having, None, script


def rows(pythons: Sequence[str], work: Path, sources: Sequence[str]) -> Iterator[dict[str, Any]]:
    """One row for each source, target and loader."""
    offered = {target: list(loaders(target, pythons)) for target in TARGETS}
    for source in sources:
        for target, clients in offered.items():
            root, why = enriched(source, target, work)
            for loader, python, compare, train in clients if not why else [("–", None, None, None)]:
                row = {"source": source, "data": SOURCES[source][0], "options": list(SOURCES[source][1:])}
                row |= {"target": target, "loader": loader, "opened": False, "compared": None, "step": None}
                row["why"] = why or ("" if python else "not installed")
                if python:
                    row |= asked(python, compare, train, root, work / root.name.replace("nerfstudio", "lerobot"))
                print(json.dumps(row), flush=True)
                yield row


def asked(python: str, compare: str | None, train: str | None, root: Path, twin: Path) -> dict[str, Any]:
    """What one loader made of one set."""
    found: dict[str, Any] = {}
    if compare:
        beside = [str(twin)] if compare == "compare_nerfstudio.py" else []
        compared, why = call(python, compare, str(root), *beside)
        found |= {"opened": compared is not None, "compared": compared, "why": why}
        if compared is None:
            return found
    if train:
        with tempfile.TemporaryDirectory() as folder:
            more = [f"{folder}/rows.tar"] if train == "webdataset_stream.py" else []
            step, why = call(python, train, str(root), *more)
        found |= {"opened": found.get("opened", False) or step is not None, "step": step, "why": why}
    return found


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--webdataset", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--source", action="append", choices=SOURCES, help="only this one")
    parser.add_argument("--work", type=Path, help="folder of the sets, which are kept; a temporary one")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    named = [python for python in os.environ.get("DHTORCH_CLIENTS", "").split(":") if python]
    pythons = [*args.lerobot, *args.webdataset, *named, sys.executable]
    with tempfile.TemporaryDirectory() as folder:
        found = list(rows(list(dict.fromkeys(pythons)), args.work or Path(folder), args.source or list(SOURCES)))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
