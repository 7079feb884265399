"""``dhtorch enrich SRC DST``: a data set with a depth, a sigma and a camera for every picture.

The maps of the frames are made in shards, as ``dhtorch extract`` makes its rows; when those of an episode are there,
it is written and they go. What is whole stays: the same command makes what is missing, and gives the same bytes.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from dhtorch import archive, dense, storage
from dhtorch.codes import Gate, Source, names, words
from dhtorch.commands import enrich_page
from dhtorch.data.files import need
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.extract import columns, engines, plan, shards
from dhtorch.extract.enriched import MapRows, View, camera_key
from dhtorch.extract.enriched import columns as map_columns
from dhtorch.extract.origin import RobotSet, rate
from dhtorch.extract.targets import NerfTarget, RobotTarget, Target

Progress = Callable[..., Iterable[Any]]
Row = dict[str, Any]

#: Of the files: raised when a reader of older ones would be wrong.
FORMAT = 1

#: Formats of the new set → version of LeRobot, None = another.
FORMATS: dict[str, int | None] = {"lerobot": 3, "v3.0": 3, "lerobot_v2.1": 2, "v2.1": 2, "nerfstudio": None}

#: Options that decide what is written.
KEYED = ("data", "method", "seed", "format", "dense", "causal", "gap", "step", "fps", "task", "on_error")

#: Where the maps of episodes wait that are not whole; and what all share.
_WAITING, _SHARED = ".dhtorch", "dhtorch.json"

#: Size of a map where samples alone are wanted, px.
_SIZE = 640

_SHOWN = 3


@dataclass(frozen=True)
class Work:
    """What is to be done."""

    out: Path
    scenes: Sequence[Scene]
    whole: plan.Plan
    views: dict[str, View]
    target: Target
    shared: Row
    rows: MapRows

    @property
    def waiting(self) -> Path:
        """The folder of the shards."""
        return self.out / _WAITING


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """``dhtorch enrich``: write the episodes of ``out`` that are not there yet, then what describes them.

    Args:
        settings: the options of ``conf/enrich.yaml``, resolved, with ``choices``.
        parts: ``data`` and ``method``, as objects.
        progress: wraps the loop over frames: (items, text, number of items) → items.

    Returns:
        Exit code 0.

    Raises:
        ValueError, OSError, ImportError: bad options or data, a folder that holds something else or lies in the source,
            a full disk.
        KeyboardInterrupt: Ctrl-C; what is whole stays.
    """
    need("pyarrow.parquet", extra="scale")
    _check(settings)
    work = _work(settings, parts)
    try:
        before, complaints = _make(work, settings, progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what is whole in {work.out} stays; the same command does the rest") from None
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        rest = "what is whole stays; the same command does the rest"
        raise OSError(error.errno, f"no space left on the disk of {work.out}: {rest}") from None
    owns = [own for k in range(len(_episodes(work.whole))) if (own := work.target.own(k)) is not None]
    if settings["report"]:
        enrich_page.write(_report(work), work.shared, owns)
    print("\n".join(_said(work, owns, before, complaints)))
    return 0


def _make(work: Work, settings: Mapping[str, Any], progress: Progress) -> tuple[int, list[str]]:
    """Make what is missing; how many episodes were whole before, and what could not be read."""
    of_episode = _episodes(work.whole)
    owns = [work.target.own(k) for k in range(len(of_episode))]
    before = sum(own is not None for own in owns)
    every = work.whole.shards(settings["shard_rows"], apart=True)
    _take_up(work)
    done = shards.finished(work.waiting, work.shared)
    todo = {k: _pieces(every, work.whole, of_episode[k]) for k, own in enumerate(owns) if own is None}
    pieces = [piece for each in todo.values() for files in each.values() for piece in files if piece.name not in done]
    positions = [position for piece in pieces for position in piece.rows]
    complaints: list[str] = []
    engine = engines.run(
        settings["engine"], work.rows, positions, workers=settings["workers"], address=settings["address"]
    )
    with closing(progress(engine, f"{len(work.whole)} frames", len(positions))) as answers:  # type: ignore[type-var]
        for k, each in todo.items():
            for piece in (piece for files in each.values() for piece in files if piece.name not in done):
                made = islice(answers, len(piece.rows))
                kept = engines.kept(made, settings["on_error"], work.rows, complaints, "on_error")
                shards.write(work.waiting, piece, kept, work.rows.wanted, work.shared)
            files = {_key(work, n): [work.waiting / p.name for p in own_pieces] for n, own_pieces in each.items()}
            owns[k] = work.target.assemble(k, [own for own in owns[:k] if own is not None], files)
            for path in (path for paths in files.values() for path in paths):
                path.unlink(missing_ok=True)
    work.target.finish([own for own in owns if own is not None])
    shutil.rmtree(work.waiting, ignore_errors=True)
    return before, complaints


def _work(settings: Mapping[str, Any], parts: Mapping[str, Any]) -> Work:
    scenes, method = scenes_of(parts["data"]), parts["method"]
    whole = plan.make(scenes, settings["gap"], method.views, rigs=True)
    out = Path(str(settings["out"])).expanduser()
    for root in whole.roots:
        if out.resolve().is_relative_to(root.resolve()) or (root.is_file() and out.resolve() == root.resolve()):
            raise ValueError(f"out: found {out} inside the source {root}, which is only read; expected another folder")
    asked = dense.options(settings["dense"], "dense")
    first = _episodes(whole)[0]
    size = _SIZE if asked is None else asked["size"]
    views = {v.key: v for v in (View.of(scenes[whole.order[n]], size) for n in first)}
    kinds = {scenes[k].recording.format for k in whole.order[: len(first)]}
    format = _format(settings["format"], kinds, scenes[whole.order[0]])
    wanted = map_columns(pictures=kinds != {"lerobot"} or FORMATS[format] is None)
    shared = _described(settings, whole, wanted)
    rows = MapRows(
        scenes,
        whole,
        wanted,
        method=method,
        gap=settings["gap"],
        past=settings["causal"],
        step=settings["step"],
        views=views,
        seed=settings["seed"],
        dense=settings["dense"],
    )
    target = _target(settings, (scenes, whole, views), out, format, shared["key"])
    return Work(out=out, scenes=scenes, whole=whole, views=views, target=target, shared=shared, rows=rows)


def _target(
    settings: Mapping[str, Any],
    found: tuple[Sequence[Scene], plan.Plan, dict[str, View]],
    out: Path,
    format: str,
    key: str,
) -> Target:
    scenes, whole, views = found
    version, of_episode = FORMATS[format], _episodes(whole)
    if version is None:
        unposed = [v.name for v in views.values() if not v.posed]
        if unposed:
            raise ValueError(f"format=nerfstudio: found no poses of {', '.join(unposed)}, expected a posed recording")
        alone = len(whole.order) == 1
        names_of = [
            {camera_key(scenes[whole.order[n]].recording): "" if alone else scenes[whole.order[n]].name for n in group}
            for group in of_episode
        ]
        return NerfTarget(out, views, names_of, key)
    recording = scenes[whole.order[0]].recording
    numbers = [whole.episodes[group[0]] for group in of_episode]
    origin = None
    if recording.format == "lerobot" and recording.root is not None:
        origin = RobotSet.open(recording.root, numbers)
    fps = rate(recording) if origin is None else origin.meta.fps
    return RobotTarget(
        out,
        version,
        views,
        origin=origin,
        numbers=numbers,
        step=settings["step"],
        fps=settings["fps"] or fps,
        task=settings["task"],
        key=key,
    )


def _format(asked: str, kinds: set[str], first: Scene) -> str:
    """The format to write.

    Raises:
        ValueError: the source's own, where nothing writes it.
    """
    if asked != "same":
        return asked
    root = first.root
    if kinds != {"lerobot"} or root is None:
        writers = ", ".join(FORMATS)
        raise ValueError(f"format=same: found {', '.join(sorted(kinds))}, which has no writer here; expected {writers}")
    return "v2.1" if RobotSet.open(root, [first.recording.episode or 0]).meta.version == 2 else "lerobot"


def _described(settings: Mapping[str, Any], whole: plan.Plan, wanted: Mapping[str, columns.Column]) -> Row:
    """What all files of the set have in common, and their key."""
    config = {k: settings[k] for k in KEYED}
    files = {**archive.files_below(whole.roots), **archive.files_named({k: settings[k] for k in ("data", "method")})}
    digest = archive.data_digest(files)
    made = archive.meta(device="cpu", dtype="float32", threads=1, seed=settings["seed"])
    name = settings["choices"]["data"]
    found: Row = storage.strict(
        {
            "format": FORMAT,
            "version": made["versions"]["dhtorch"],
            "git": made["git"],
            "key": archive.result_key({**config, "name": name, "files": FORMAT}, digest, roots=[MapRows.__module__]),
            "config": archive.portable(config),
            "method": settings["choices"]["method"],
            "data": {"name": name, "digest": digest, "frames": len(whole)},
            "step_m": settings["step"],
            "columns": {k: c._asdict() for k, c in wanted.items()},
            "codes": {**columns.code_tables(), "source": names(Source), "gate": names(Gate)},
        }
    )
    return found


def _take_up(work: Work) -> None:
    """The folder, ready for what is missing.

    Raises:
        FileExistsError: it holds something else, or was made of other data or with other options.
    """
    if work.out.exists() and not work.out.is_dir():
        raise NotADirectoryError(f"out: {work.out} is a file, expected a folder, or a place for one")
    about = work.out / "meta" / _SHARED
    if about.is_file():
        other = storage.loads(about.read_text(encoding="utf-8"))
        if other["key"] != work.shared["key"]:
            what = archive.difference(other, work.shared)
            raise FileExistsError(f"{work.out}: found another enriched set ({what}), expected another folder for out")
    elif storage.filled(work.out):
        raise FileExistsError(f"{work.out}: found a folder that holds something else, expected an empty or a new one")
    else:
        storage.write_json(about, work.shared)
    for left in work.out.rglob(".*.tmp"):
        left.unlink(missing_ok=True)
    work.waiting.mkdir(exist_ok=True)


def _episodes(whole: plan.Plan) -> list[list[int]]:
    """Recordings, as places in the plan, by episode."""
    found: dict[int, list[int]] = {}
    for n, number in enumerate(whole.episodes):
        found.setdefault(number, []).append(n)
    return list(found.values())


def _pieces(every: Sequence[plan.Shard], whole: plan.Plan, group: Sequence[int]) -> dict[int, list[plan.Shard]]:
    """Place of a recording in the plan → its shards."""
    spans = whole.spans
    return {n: [p for p in every if spans[n].start <= p.rows.start < spans[n].stop] for n in group}


def _key(work: Work, n: int) -> str:
    return camera_key(work.scenes[work.whole.order[n]].recording)


# ------------------------------------------------------------------------------------------------------ what is said


def _report(work: Work) -> Path:
    return work.out / "meta" / "report.html"


def _said(work: Work, owns: Sequence[Row], before: int, complaints: Sequence[str]) -> list[str]:
    """The whole in words."""
    size = sum(path.stat().st_size for path in work.out.rglob("*") if path.is_file())
    frames = sum(own["length"] for own in owns)
    left = f" ({before} left untouched)" if before else ""
    lines = [f"{work.out}: {len(owns)} episode{'s' * (len(owns) != 1)}{left}, {frames} frames, {size / 1e6:.1f} MB"]
    for name, shares, reasons in enrich_page.by_camera(owns):
        kinds = ", ".join(f"{kind} {share:.1%}" for kind, share in shares.items())
        why = ", ".join(f"{words(gate)} {share:.1%}" for gate, share in reasons.items())
        lines.append(f"  {name}: {kinds}" + (f" ({why})" if why else ""))
    lines += [f"  {complaint}" for complaint in complaints[:_SHOWN]]
    lines += [f"  and {len(complaints) - _SHOWN} more frames"] if len(complaints) > _SHOWN else []
    return lines


def _check(settings: Mapping[str, Any]) -> None:
    """Options that would only fail after minutes."""
    known = {"format": (*FORMATS, "same"), "engine": engines.ENGINES, "on_error": ("raise", "flag")}
    for name, among in known.items():
        if settings[name] not in among:
            raise ValueError(f"{name}: found {settings[name]!r}, expected one of {', '.join(among)}")
    for name in ("causal", "report"):
        if not isinstance(settings[name], bool):
            raise ValueError(f"{name}: found {settings[name]!r}, expected true or false")
    for name, low in (("workers", 0), ("shard_rows", 1), ("gap", 0)):
        value = settings[name]
        whole = isinstance(value, int) and not isinstance(value, bool) and value >= low
        if not whole and not (name == "gap" and value == plan.CHOICE):
            raise ValueError(f"{name}: found {value!r}, expected a whole number of at least {low}")
    for name, high in (("step", 1.0), ("fps", 1e4)):
        value = settings[name]
        number = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= high
        if not number and not (name == "fps" and value is None):
            raise ValueError(f"{name}: found {value!r}, expected a number from 0 to {high:g}")
