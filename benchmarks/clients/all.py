"""Which loaders open what ``dhtorch enrich`` makes: source × target × loader, compared by value, trained one step.

python benchmarks/clients/all.py --lerobot PYTHON --lerobot PYTHON --json benchmarks/results/clients.json

Every interpreter is one process (``serve.py``); packages that are not here are those of an interpreter that is named:
``--lerobot`` (also of ``datasets``), ``--webdataset``, ``--openpi``, ``--nerfstudio``; or ``DHTORCH_CLIENTS``,
interpreters with a colon between. A loader without an interpreter gets a row that says so. Sources are read from
``DHTORCH_DATA``, beside two that are written first (``written.py``).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from written import WRITTEN

HERE = Path(__file__).resolve().parent
REPO = HERE.parents[1]

#: The same quick method for all: what is asked is whether values arrive, not how good they are.
QUICK = ("method=paper", "method.n=128", "gap=2", "dense=false", "report=false")

DENSE = "dense={size: 80}"

#: Of sets without any depth, whose maps are then empty.
WITHOUT_DEPTH = "without_depth=true"

#: Source → its folder below ``DHTORCH_DATA``, or that it is written, and the options it needs.
SOURCES: dict[str, tuple[str, ...]] = {
    "TUM": ("tum_fr1_desk9", DENSE),
    "TUM, samples alone": ("tum_fr1_desk9",),
    "7-Scenes": ("7s_redkitchen_000",),
    "HoloLens": ("holo_a",),
    "LeRobot v2.1": ("lerobot_g1", "data=lerobot", "data.fov=69", "data.episode=[29]"),
    "GR00T, LeRobot v2.0": ("gr00t_demo", "data=lerobot", "data.fov=69", "data.episode=[4]", WITHOUT_DEPTH),
    "RLDS": (
        "rlds_bridge/bridge_dataset/1.0.0",
        *("data=rlds", "data.fov=69", "data.rate_hz=5", "data.split=train"),
        *("data.camera=observation/image_0", "data.episode=[0,1]", WITHOUT_DEPTH),
    ),
    "robot": ("written", "data=lerobot", DENSE),
    "two-camera robot": ("written", "data=lerobot", DENSE),
    "RLDS with depth": ("written", "data=rlds", "data.rate_hz=10", DENSE),
}

#: Target → what ``format=`` is told.
TARGETS = {"lerobot v3.0": "lerobot", "lerobot v2.1": "v2.1", "nerfstudio": "nerfstudio"}

#: Columns for policies of pictures or points, which some sets are written with once more.
POLICY_COLUMNS = "columns=[depth,sigma,source,geometry_image,point_cloud]"

#: Sources of such sets.
POLICY_SOURCES = ("two-camera robot", "GR00T, LeRobot v2.0")

#: Loader that needs only torch, or a package → the script of one training step.
STEPS = {
    "torch": "torch_loader.py",
    "openpi_client": "openpi_transforms.py",
    "datasets": "hf_datasets.py",
    "webdataset": "webdataset_stream.py",
}

#: Its name, interpreter, script that compares, script that trains.
Loader = tuple[str, str | None, str | None, str | None]

#: Packages whose versions name a loader.
PACKAGES = ("lerobot", "datasets", "webdataset", "torch", "openpi_client", "nerfstudio")


def call(python: str, *words: str) -> tuple[dict[str, Any] | None, str]:
    """What a script said as JSON in its last line, or None and its last words."""
    done = subprocess.run([python, *words], env=environment(), cwd=HERE, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        last = done.stdout.strip().splitlines()[-1:]
        return (json.loads(last[0]) if last and last[0].startswith("{") else {}), ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    at = next((i for i in reversed(range(len(lines))) if "Error" in lines[i].split(":")[0]), max(len(lines) - 1, 0))
    return None, short(" ".join(lines[at : at + 2]) or "no word")


def environment() -> dict[str, str]:
    """Of a client's process."""
    env = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    return env | {"PYTHONPATH": os.pathsep.join(filter(None, (str(REPO), env.get("PYTHONPATH"))))}


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


def enriched(source: str, target: str, work: Path, *more: str) -> tuple[Path, str]:
    """The folder of one source in one format, and why there is none; what is there already is not made again.

    With ``more`` options the set has a folder of its own.
    """
    _, *options = SOURCES[source]
    out = work / f"{source.replace(',', '').replace(' ', '-')}-{TARGETS[target]}{'-policy' if more else ''}"
    words = [
        "-m",
        "dhtorch",
        "enrich",
        str(place(source, work)),
        str(out),
        f"format={TARGETS[target]}",
        *QUICK,
        *options,
        *more,
    ]
    result, why = call(sys.executable, *words)
    return out, "" if result is not None else why


def place(source: str, work: Path) -> Path:
    """The folder of a source; one that is written here is written if it is not there yet."""
    if SOURCES[source][0] != "written":
        return Path(os.environ["DHTORCH_DATA"]) / SOURCES[source][0]
    root = work / f"written-{source.replace(' ', '-')}"
    if not root.is_dir():
        WRITTEN[source](root)
    return root


def loaders(target: str, known: Mapping[str, Mapping[str, str]]) -> Iterator[Loader]:
    """Those of a target; ``known``: interpreter → versions of its packages."""
    if target == "nerfstudio":
        yield "transforms.json by its keys", sys.executable, "compare_nerfstudio.py", None
        having = next((p for p, has in known.items() if "nerfstudio" in has), None)
        version = "" if having is None else f" {known[having]['nerfstudio']}"
        yield f"nerfstudio{version}, its parser", having, "nerfstudio_parser.py", None
        return
    for number in dict.fromkeys(has["lerobot"] for has in known.values() if "lerobot" in has):
        python = next(p for p, has in known.items() if has.get("lerobot") == number)
        yield (
            f"lerobot {number}",
            python,
            "compare_lerobot.py",
            "lerobot_policy.py" if target == "lerobot v3.0" else None,
        )
    if target != "lerobot v3.0":
        return
    for package, script in STEPS.items():
        having = next((p for p, has in known.items() if package in has), None)
        version = "" if having is None else f" {known[having].get(package, '')}".rstrip()
        yield f"{package}{version}", having, None, script


def rows(source: str, offered: Mapping[str, Sequence[Loader]], work: Path, *more: str) -> list[dict[str, Any]]:
    """One row for each target and loader of a source; ``more`` are options of a set with geometry images and points."""
    folder, *options = SOURCES[source]
    name = f"{source}, pictures and points" if more else source
    start = {"source": name, "data": folder, "options": [*options, *more]}
    nothing = {"opened": False, "compared": None, "step": None}
    rows = []
    for target, clients in offered.items():
        root, why = enriched(source, target, work, *more)
        for loader, python, compare, train in clients if not why else [("–", None, None, None)]:
            row = {**start, "target": target, "loader": loader, **nothing}
            row["why"] = why or ("" if python else "not installed")
            if python:
                row |= run_loaders(python, compare, train, root, work / root.name.replace("nerfstudio", "lerobot"))
            rows.append(row)
    if "data=rlds" in options:  # the set itself: its depth in the loader, without any step before
        fov = [option.removeprefix("data.fov=") for option in options if option.startswith("data.fov=")]
        step, why = Served.of(sys.executable).request("rlds_steps.py", str(place(source, work)), *fov)
        row = {**start, "target": "as it is", "loader": "RLDS steps", **nothing}
        rows.append(row | {"opened": step is not None, "step": step, "why": why})
    print(*map(json.dumps, rows), sep="\n", flush=True)
    return rows


def policy_loaders(known: Mapping[str, Mapping[str, str]]) -> list[Loader]:
    """Those of a set with geometry images and points: openpi's transforms, and GR00T's ``modality.json``."""
    having = next((p for p, has in known.items() if "openpi_client" in has), None)
    version = "" if having is None else f" {known[having]['openpi_client']}"
    openpi = f"openpi_client{version}", having, None, "openpi_transforms.py"
    return [openpi, ("modality.json by its fields", sys.executable, "groot_modality.py", None)]


def own_depth(known: Mapping[str, Mapping[str, str]], work: Path) -> list[dict[str, Any]]:
    """Depth that LeRobot wrote, as LeRobot and as dhtorch read it; versions before 0.6 know none."""
    rows = []
    for python, has in known.items():
        if "lerobot" in has and not any(row["loader"] == f"lerobot {has['lerobot']}" for row in rows):
            with tempfile.TemporaryDirectory(dir=work) as folder:
                reply, why = Served.of(python).request("lerobot_depth.py", folder)
            row = {"source": "LeRobot's own depth", "data": "written", "options": [], "target": "read by dhtorch"}
            row |= {"loader": f"lerobot {has['lerobot']}", "opened": reply is not None, "compared": reply}
            rows.append({**row, "step": None, "why": why})
    return rows


def run_loaders(python: str, compare: str | None, train: str | None, root: Path, twin: Path) -> dict[str, Any]:
    """What one loader made of one set."""
    record: dict[str, Any] = {}
    folders = sorted(each.parent for each in root.rglob("transforms.json"))
    root = folders[0] if folders else root  # of several episodes the first
    if compare:
        beside = [str(twin)] if compare == "compare_nerfstudio.py" else []
        compared, why = Served.of(python).request(compare, str(root), *beside)
        record |= {"opened": compared is not None, "compared": compared, "why": why}
        if compared is None:
            return record
    if train:
        with tempfile.TemporaryDirectory() as folder:
            more = [f"{folder}/rows.tar"] if train == "webdataset_stream.py" else []
            step, why = Served.of(python).request(train, str(root), *more)
        record |= {"opened": record.get("opened", False) or step is not None, "step": step, "why": why}
    return record


def keep(table: list[dict[str, Any]], file: Path | None) -> list[dict[str, Any]]:
    """Write the rows made so far, before those of earlier runs that none of them replaces."""
    if file is not None:
        before = json.loads(file.read_text()) if file.is_file() else []
        made = {_subject(row) for row in table}
        file.write_text(json.dumps([*table, *(row for row in before if _subject(row) not in made)], indent=1) + "\n")
    return table


def _subject(row: dict[str, Any]) -> tuple[str, str, str]:
    """Source, target and loader of a row; of LeRobot, whose formats differ, with its version."""
    loader = str(row["loader"])
    return row["source"], row["target"], loader if loader.startswith("lerobot") else loader.partition(" ")[0]


class Served:
    """An interpreter in which scripts run one after the other (``serve.py``); it ends with this process."""

    known: ClassVar["dict[str, Served]"] = {}
    alone: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, python: str) -> None:
        self.process = subprocess.Popen(
            [python, "serve.py"],
            **{"env": environment(), "cwd": HERE, "text": True},
            **{"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL},
        )
        self.lock = threading.Lock()

    @classmethod
    def of(cls, python: str) -> "Served":
        """The one of an interpreter, started where there is none or the last one died."""
        with cls.alone:
            if python not in cls.known or cls.known[python].process.poll() is not None:
                cls.known[python] = cls(python)
            return cls.known[python]

    def request(self, script: str, *words: str) -> tuple[dict[str, Any] | None, str]:
        """What a script said, or None and why."""
        with self.lock:
            assert self.process.stdin and self.process.stdout
            self.process.stdin.write(json.dumps([script, *words]) + "\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        if not line:
            return None, f"{script} ended its interpreter"
        reply, why = json.loads(line)
        return reply, short(why)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--webdataset", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--openpi", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--nerfstudio", action="append", default=[], metavar="PYTHON")
    parser.add_argument("--source", action="append", choices=SOURCES, help="only this one")
    parser.add_argument("--work", type=Path, help="folder of the sets, which are kept; a temporary one")
    parser.add_argument("--at-once", type=int, default=1, metavar="N", help="sources")
    parser.add_argument("--json", type=Path, help="rows that are not run now stay as they are in it")
    args = parser.parse_args()
    named = [python for python in os.environ.get("DHTORCH_CLIENTS", "").split(":") if python]
    pythons = dict.fromkeys([*args.lerobot, *args.webdataset, *args.openpi, *args.nerfstudio, *named, sys.executable])
    known = {python: versions(python) for python in pythons}
    offered = {target: list(loaders(target, known)) for target in TARGETS}
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(args.at_once) as pool:
        of = partial(rows, offered=offered, work=args.work or Path(folder))
        table = []
        for some in pool.map(of, args.source or list(SOURCES)):
            table = keep(table + some, args.json)
        policies = dict.fromkeys(("lerobot v3.0", "lerobot v2.1"), policy_loaders(known))
        for source in (source for source in POLICY_SOURCES if source in (args.source or SOURCES)):
            table = keep(table + rows(source, policies, args.work or Path(folder), POLICY_COLUMNS), args.json)
        keep(table + own_depth(known, args.work or Path(folder)), args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
