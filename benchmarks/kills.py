"""Faults in the command's sleep: killed, told to end, raced, and out of disk, again and again; what is lost is counted.

    python benchmarks/kills.py --times 17 --json benchmarks/results/kills.json

Every fault hits ``dhtorch extract``, ``enrich`` (two workers each) and ``complete`` on a small set, at a moment drawn
from the seed. Afterwards the same command is run undisturbed, and its files are held against those of a run that nobody
disturbed: ``lost``, ``doubled`` and ``changed`` files, and unfinished files and processes ``left`` behind. Of two that
race, each must be right or refused in one line, else it is ``unclear``; the files of one that succeeded are compared
before the further run, too. Before that run, files of others are put beside the outputs wherever the folder bears the
record of the first run: ``deleted`` counts those that are gone or changed after it. Each of these must be 0. Commands
are forked off a process that has imported what they need, so that faults hit work, not imports.
"""

import argparse
import contextlib
import hashlib
import importlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import cast

from dhtorch import extract  # noqa: F401 (imported once, before commands are forked)
from dhtorch.cli import complete, enrich, run  # noqa: F401
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, is_private

ROOM = (
    "data=synthetic",
    "data.n_frames=6",
    "data.hw=[48,64]",
    "data.depth_hw=[24,32]",
    "data.supersample=1",
    "method.n=64",
)
COMMANDS = {
    "extract": (*ROOM, "workers=2", "extract.gap=1", "extract.shard_rows=1", "extract.columns=[depth]"),
    "enrich": (*ROOM, "workers=2", "shard_rows=1", "report=false", "dense={planes: 8}"),
    "complete": (*ROOM, "planes=8", "refinements=1", "steps=[1]", "figures=false"),
}
#: What shows that a folder is a command's, to which it then comes back although others have put files there.
RECORDS = {"extract": ".", "enrich": "meta/dhtorch.json", "complete": "complete.json"}
LOSSES = "lost", "doubled", "changed", "left", "unclear", "deleted"
FORK = get_context("fork")
OTHERS = b"mine"
PATIENCE_S = 5  # after which a process that lives on is left behind

Row = dict[str, str | int]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the faults, print a line for each; exit code 1 where anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", default=",".join(COMMANDS), help="separated by commas")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    rows: list[Row] = []
    commands = options.commands.split(",")
    with tempfile.TemporaryDirectory(prefix="dhtorch-kills-") as place:
        for command in commands:
            rows += suffered(command, Path(place) / command, options)
    bad = sum(int(row[loss]) for row in rows for loss in LOSSES)
    print(f"{bad} lost, doubled, changed, left, unclear or deleted")
    if options.json:
        storage.write_json(options.json, rows)
    return int(bad > 0)


def suffered(command: str, place: Path, options: argparse.Namespace) -> list[Row]:
    """What every fault, so many times, costs one command; ``hit``: how often it ended the command early."""
    draw = random.Random(options.seed)
    rows: list[Row] = []
    place.mkdir()
    import_what_is_needed(command, place)
    began = time.monotonic()
    whole = start(command, place / "whole")
    whole.join()
    if whole.exitcode:
        message = _messages(place / "whole", cast("int", whole.pid)).read_text(encoding="utf-8")
        raise SystemExit(f"dhtorch {command}: fails undisturbed: {message}")
    took, want, source = time.monotonic() - began, contents(place / "whole"), _checkout()
    for name, fault in FAULTS.items():
        counts = Counter(dict.fromkeys(("hit", *LOSSES), 0))
        for number in range(options.times):
            folder = place / f"{name}-{number}"
            processes = fault(command, folder, draw.uniform(0.0, 1.0) * took)
            counts["left"] += ended(*processes)
            counts["hit"] += any(p.exitcode for p in processes)
            if name == "race":
                counts["unclear"] += sum(not _is_clear(folder, process) for process in processes)
                if not all(process.exitcode for process in processes):
                    counts.update(difference(want, contents(folder)))
            others = put_others(folder) if (folder / RECORDS[command]).exists() else []
            start(command, folder).join()
            counts["deleted"] += sum(not file.is_file() or file.read_bytes() != OTHERS for file in others)
            for file in others:
                file.unlink(missing_ok=True)
            counts.update(difference(want, contents(folder)))
            counts["left"] += len(unfinished(folder))
            shutil.rmtree(folder)
        if _checkout() != source:
            raise SystemExit("the checkout changed meanwhile: run it where nobody works")
        rows.append({"name": f"{command}, {name}", "times": options.times, **counts})
        print(*(f"{key} {value}" for key, value in rows[-1].items()), sep=", ", flush=True)
    return rows


def import_what_is_needed(command: str, place: Path) -> None:
    """Import here the modules that a run of the command imports, without any other work of it."""
    names = place / "modules.txt"

    def scout() -> None:
        before = set(sys.modules)
        try:
            _run(command, place / "scout", None)
        finally:
            names.write_text("\n".join(name for name in sys.modules if name not in before), encoding="utf-8")

    process = FORK.Process(target=scout)
    process.start()
    process.join()
    for name in names.read_text(encoding="utf-8").splitlines():
        with contextlib.suppress(Exception):
            importlib.import_module(name)


def _checkout() -> str:
    """The state of the code, which every file names."""
    return str(
        result_files.collect_run_metadata(device="cpu", dtype="float32", threads=1, seed=0, operators="torch")["git"]
    )


def start(command: str, folder: Path, limit: int | None = None) -> ForkProcess:
    """The command in a process group of its own; ``limit``: bytes that a file of it may have."""
    process = FORK.Process(target=_run, args=(command, folder, limit))
    process.start()
    return process


def _run(command: str, folder: Path, limit: int | None) -> None:
    os.setsid()
    nowhere = os.open(os.devnull, os.O_RDWR)
    messages = os.open(_messages(folder, os.getpid()), os.O_WRONLY | os.O_CREAT, 0o644)
    for stream, file in enumerate((nowhere, nowhere, messages)):
        os.dup2(file, stream)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    raise SystemExit(run.main([command, *COMMANDS[command], f"out={folder}"]))


def ended(*processes: ForkProcess) -> int:
    """Waits for processes; how many of their groups live on, which are then killed."""
    left = 0
    for process in processes:
        process.join()
        group = cast("int", process.pid)
        end = time.monotonic() + PATIENCE_S
        while alive := _alive(group):
            if time.monotonic() > end:
                os.killpg(group, signal.SIGKILL)
                break
            time.sleep(0.05)
        left += alive
    return left


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def _signalled(number: int) -> Callable[[str, Path, float], list[ForkProcess]]:
    def fault(command: str, folder: Path, after: float) -> list[ForkProcess]:
        process = start(command, folder)
        time.sleep(after)
        os.kill(cast("int", process.pid), number)
        return [process]

    return fault


def _raced(command: str, folder: Path, after: float) -> list[ForkProcess]:
    """A second one in the same folder."""
    first = start(command, folder)
    time.sleep(after / 4)
    return [first, start(command, folder)]


def _full(command: str, folder: Path, after: float) -> list[ForkProcess]:
    """No file may grow beyond some kilobytes."""
    return [start(command, folder, limit=1024 * (1 + int(2 * after)))]


FAULTS: dict[str, Callable[[str, Path, float], list[ForkProcess]]] = {
    "kill": _signalled(signal.SIGKILL),
    "terminate": _signalled(signal.SIGTERM),
    "race": _raced,
    "full disk": _full,
}


def _messages(folder: Path, process: int) -> Path:
    """File of what a process prints to stderr."""
    return folder.with_name(f"{folder.name}.{process}.txt")


def _is_clear(folder: Path, process: ForkProcess) -> bool:
    """Whether a process succeeded, or was refused in one line because another one writes there."""
    lines = _messages(folder, cast("int", process.pid)).read_text(encoding="utf-8").splitlines()
    refusal = "found another dhtorch process"
    return not process.exitcode or (process.exitcode == run.EXIT_FAILED and len(lines) == 1 and refusal in lines[0])


def unfinished(folder: Path) -> list[Path]:
    """Hidden files, and files of the private folder beside the manifest."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    manifest = folder / PRIVATE_FOLDER / "manifest"
    return [f for f in files if f != manifest and (f.name.startswith(".") or is_private(f.relative_to(folder)))]


def put_others(folder: Path) -> list[Path]:
    """Write files that are not dhtorch's beside all outputs -> their paths."""
    folders = [place for place in (folder, *folder.rglob("*")) if place.is_dir()]
    folders = [place for place in folders if not is_private(place.relative_to(folder))]
    others = [place / name for place in folders for name in ("mine.png", ".mine.tmp", "mine.json")]
    for file in others:
        file.write_bytes(OTHERS)
    return others


def contents(folder: Path) -> dict[str, str]:
    """Name → digest of the files, dhtorch's records excluded."""
    files = [file for file in folder.rglob("*") if file.is_file() and not is_private(file.relative_to(folder))]
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def difference(want: dict[str, str], have: dict[str, str]) -> dict[str, int]:
    """Files that are missing, too many, or other than they should be."""
    changed = sum(have[name] != want[name] for name in have.keys() & want.keys())
    return {"lost": len(want.keys() - have.keys()), "doubled": len(have.keys() - want.keys()), "changed": changed}


if __name__ == "__main__":
    raise SystemExit(main())
