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
from pathlib import Path, PurePosixPath
from typing import Any

from dhtorch.cli import enrich_page
from dhtorch.codes import Gate, Source, names, words
from dhtorch.data.io.decode import need
from dhtorch.data.rig import Rig
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.extract import columns, cut, engines, plan, shards
from dhtorch.extract.enriched import SILENCE, MapRows, View, camera_key
from dhtorch.extract.enriched import columns as map_columns
from dhtorch.extract.nerf_target import NerfTarget
from dhtorch.extract.origin import NO_RATE, Origin, RobotSet, knows_rate, rate
from dhtorch.extract.robot_target import RobotTarget
from dhtorch.extract.step_set import StepSet
from dhtorch.extract.targets import Target
from dhtorch.pipeline import dense
from dhtorch.runtime import file_lock as lock
from dhtorch.runtime import results as archive
from dhtorch.runtime import storage
from dhtorch.runtime.console import many
from dhtorch.transforms import poses as given

Progress = Callable[..., Iterable[Any]]
Row = dict[str, Any]

#: Of the files: raised when a reader of older ones would be wrong.
FORMAT = 1

#: Formats of the new set → version of LeRobot, None = another.
FORMATS: dict[str, int | None] = {"lerobot": 3, "v3.0": 3, "lerobot_v2.1": 2, "v2.1": 2, "nerfstudio": None}

#: Options that decide what is written.
KEYED = ("data", "method", "seed", "format", "dense", "causal", "gap", "cameras", "pose", "pose_sigma", "frames",
         "step", "fps", "task", "on_error")  # fmt: skip

#: Where the maps of episodes wait that are not whole; and what all share.
_WAITING, _SHARED = ".dhtorch", "dhtorch.json"

#: Size of a map where samples alone are wanted, px.
_SIZE = 640

_SHOWN = 3

#: What the system says where nothing more can be written.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

#: Where the motion to another view comes from.
POSES = ("near", "device", "start")


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
    notes: Sequence[str] = ()

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
    home = work.out.absolute()
    rest = "what is whole stays; the same command does the rest"
    try:
        with lock.held(home.parent / f".{home.name}.lock", f"out: {work.out}"):
            before, owns, complaints = _make(work, settings, progress)
            if settings["report"]:
                enrich_page.write(work.out / "meta", work.shared, owns)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what is whole in {work.out} stays; the same command does the rest") from None
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise OSError(error.errno, f"{error.strerror}: {error.filename or work.out}; {rest}") from None
    print("\n".join(_said(work, owns, before, complaints)))
    return 0


def _make(work: Work, settings: Mapping[str, Any], progress: Progress) -> tuple[int, list[Row], list[str]]:
    """Make what is missing; how many episodes were whole before, what all amount to, and what could not be read."""
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
    with closing(progress(engine, many(len(work.whole), "frame"), len(positions))) as answers:  # type: ignore[type-var]
        for k, each in todo.items():
            for piece in (piece for files in each.values() for piece in files if piece.name not in done):
                made = islice(answers, len(piece.rows))
                kept = engines.kept(made, settings["on_error"], work.rows, complaints, "on_error=flag")
                shards.write(work.waiting, piece, kept, work.rows.wanted, work.shared)
            files = {_key(work, n): [work.waiting / p.name for p in own_pieces] for n, own_pieces in each.items()}
            owns[k] = work.target.assemble(k, [own for own in owns[:k] if own is not None], files)
            for path in (path for paths in files.values() for path in paths):
                path.unlink(missing_ok=True)
    every_own = [own for own in owns if own is not None]
    work.target.finish(every_own)
    shutil.rmtree(work.waiting, ignore_errors=True)
    return before, every_own, complaints


def _work(settings: Mapping[str, Any], parts: Mapping[str, Any]) -> Work:
    scenes, method = cut.cut(scenes_of(parts["data"]), settings["frames"]), parts["method"]
    whole = plan.make(scenes, settings["gap"], method.views, rigs=True)
    out = Path(str(settings["out"])).expanduser()
    for root in whole.roots:
        if out.resolve().is_relative_to(root.resolve()) or (root.is_file() and out.resolve() == root.resolve()):
            raise ValueError(f"out: found {out} inside the source {root}, which is only read; expected another folder")
    asked = dense.options(settings["dense"], "dense")
    first = [scenes[whole.order[n]] for n in _episodes(whole)[0]]
    size = _SIZE if asked is None else asked["size"]
    views = {v.key: v for v in (View.of(scene, size) for scene in first)}
    _check_views(settings, first, views)
    format = _format(settings["format"], first)
    found = scenes, whole, views
    origin = None if FORMATS[format] is None else _origin(settings, found)
    wanted = map_columns(pictures=origin is None)
    shared = _described(settings, whole, wanted)
    rows = MapRows(
        scenes,
        whole,
        wanted,
        method=method,
        gap=settings["gap"],
        past=settings["causal"],
        beside=settings["cameras"],
        step=settings["step"],
        views=views,
        seed=settings["seed"],
        dense=settings["dense"],
        **_pose_options(settings),
    )
    target = _target(settings, found, out, format, shared["key"], origin)
    notes = []
    if FORMATS[format] is not None and settings["fps"] is None and not knows_rate(first[0].recording):
        notes.append(f"no frame rate is known: time stamps are for {NO_RATE:g} frames a second (fps=N tells)")
    return Work(out=out, scenes=scenes, whole=whole, views=views, target=target, shared=shared, rows=rows, notes=notes)


def _check_views(settings: Mapping[str, Any], first: Sequence[Scene], views: Mapping[str, View]) -> None:
    """Raises ValueError for what the cameras of an episode cannot be asked."""
    names = ", ".join(scene.name for scene in first)
    if len(views) < len(first):
        raise ValueError(f"data: found several recordings of one camera in one episode ({names}), expected one each")
    if any(isinstance(scene.recording, Rig) for scene in first):
        raise ValueError(f"data: found a rig ({names}), expected its cameras apart (cameras=true joins them)")
    sizes = {view.hw for view in views.values()}
    if settings["cameras"] and (len(views) < 2 or len(sizes) > 1 or settings["gap"] != plan.CHOICE):
        seen = " and ".join(f"{w}x{h}" for h, w in sorted(sizes))
        found = f"{len(views)} of {seen} pixels, gap={settings['gap']}"
        raise ValueError(f"cameras: found {found}, expected two or more of one size in an episode, and gap=auto")
    unposed = [view.name for view in views.values() if not view.posed]
    if settings["pose"] != "near" and unposed:
        raise ValueError(f"pose: found none of {', '.join(unposed)}, expected a posed recording, or pose=near")


def _pose_options(settings: Mapping[str, Any]) -> Row:
    """Of :class:`dhtorch.transforms.ExtendDepth`."""
    if settings["pose"] == "near":
        return {}
    return {"pose": "pose", "pose_cov": settings["pose_sigma"], "refine": settings["pose"] == "start"}


def _origin(settings: Mapping[str, Any], found: tuple[Sequence[Scene], plan.Plan, dict[str, View]]) -> Origin | None:
    """The data set with columns of its own that the recordings are of."""
    scenes, whole, _ = found
    groups = _episodes(whole)
    recording, numbers = scenes[whole.order[0]].recording, [whole.episodes[group[0]] for group in groups]
    if recording.format == "lerobot" and recording.root is not None:
        return RobotSet.open(recording.root, numbers, limit=settings["frames"], bounds=recording.bounds)
    if recording.format == "rlds":
        each = cut.Chosen(scenes, tuple(whole.order[group[0]] for group in groups))
        return StepSet(each, numbers, settings["fps"] or rate(recording), settings["frames"])
    return None


def _target(
    settings: Mapping[str, Any],
    found: tuple[Sequence[Scene], plan.Plan, dict[str, View]],
    out: Path,
    format: str,
    key: str,
    origin: Origin | None,
) -> Target:
    scenes, whole, views = found
    version, of_episode = FORMATS[format], _episodes(whole)
    if version is None:
        unposed = [v.name for v in views.values() if not v.posed]
        if unposed:
            raise ValueError(f"format=nerfstudio: found no poses of {', '.join(unposed)}, expected a posed recording")
        return NerfTarget(out, views, _folders(scenes, whole, of_episode), key)
    recording = scenes[whole.order[0]].recording
    fps = rate(recording) if origin is None else origin.fps
    return RobotTarget(
        out,
        version,
        views,
        origin=origin,
        numbers=[whole.episodes[group[0]] for group in of_episode],
        step=settings["step"],
        fps=settings["fps"] or fps,
        task=settings["task"],
        key=key,
        cut=settings["frames"] is not None,
    )


def _folders(scenes: Sequence[Scene], whole: plan.Plan, groups: Sequence[Sequence[int]]) -> list[dict[str, str]]:
    """Name of the folder of each recording, by episode and then by camera; of the only one empty."""
    found: list[dict[str, str]] = []
    seen: set[str] = set()
    for group in groups:
        named = {}
        for n in group:
            scene = scenes[whole.order[n]]
            parts = [part for part in PurePosixPath(f"/{scene.name}").parts[1:] if part != ".."]
            named[camera_key(scene.recording)] = name = "" if len(whole.order) == 1 else "/".join(parts)
            if name in seen:
                raise ValueError(f"data: found two recordings called {name}, expected different names")
            seen.add(name)
        found.append(named)
    return found


def _format(asked: str, first: Sequence[Scene]) -> str:
    """The format to write.

    Raises:
        ValueError: the source's own, where nothing writes it.
    """
    if asked != "same":
        return asked
    kind, root = first[0].recording.format, first[0].root
    if kind != "lerobot" or root is None:
        raise ValueError(f"format=same: found {kind}, which has no writer here; expected {', '.join(FORMATS)}")
    return "v2.1" if RobotSet.open(root, [first[0].recording.episode or 0]).meta.version == 2 else "lerobot"


def _described(settings: Mapping[str, Any], whole: plan.Plan, wanted: Mapping[str, columns.Column]) -> Row:
    """What all files of the set have in common, and their key."""
    config = {k: settings[k] for k in KEYED}
    files = {**archive.files_below(whole.roots), **archive.files_named({k: settings[k] for k in ("data", "method")})}
    digest = archive.data_digest(files)
    made = archive.meta(device="cpu", dtype="float32", threads=1, seed=settings["seed"])
    name = settings["choices"]["data"]
    source = whole.roots[0].resolve().name if whole.roots else name
    found: Row = storage.strict(
        {
            "format": FORMAT,
            "version": made["versions"]["dhtorch"],
            "git": made["git"],
            "key": archive.result_key({**config, "name": name, "files": FORMAT}, digest, roots=[MapRows.__module__]),
            "config": archive.portable(config),
            "method": settings["choices"]["method"],
            "data": {"name": name, "source": source, "digest": digest, "frames": len(whole)},
            "step_m": settings["step"],
            "columns": {k: c._asdict() for k, c in wanted.items()},
            "codes": {**columns.code_tables(), "source": names(Source), "gate": names(Gate), "silent": SILENCE},
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
    storage.clear(about)  # who was killed while it was written left nothing else
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


def _said(work: Work, owns: Sequence[Row], before: int, complaints: Sequence[str]) -> list[str]:
    """The whole in words."""
    size = sum(path.stat().st_size for path in work.out.rglob("*") if path.is_file())
    frames = sum(own["length"] for own in owns)
    left = f" ({before} left untouched)" if before else ""
    lines = [f"{work.out}: {many(len(owns), 'episode')}{left}, {many(frames, 'frame')}, {size / 1e6:.1f} MB"]
    for name, shares, reasons in enrich_page.by_camera(owns):
        kinds = ", ".join(f"{kind} {share:.1%}" for kind, share in shares.items())
        why = ", ".join(f"{words(gate)} {share:.1%}" for gate, share in reasons.items())
        lines.append(f"  {name}: {kinds}" + (f" ({why})" if why else ""))
    lines += [f"  {line}" for line in (*enrich_page.refuted(owns), *work.notes)]
    lines += [f"  {complaint}" for complaint in complaints[:_SHOWN]]
    lines += [f"  and {len(complaints) - _SHOWN} more frames"] if len(complaints) > _SHOWN else []
    return lines


def _check(settings: Mapping[str, Any]) -> None:
    """Options that would only fail after minutes."""
    known = {"format": (*FORMATS, "same"), "engine": engines.ENGINES, "on_error": ("raise", "flag"), "pose": POSES}
    for name, among in known.items():
        if settings[name] not in among:
            raise ValueError(f"{name}: found {settings[name]!r}, expected one of {', '.join(among)}")
    for name in ("causal", "report", "cameras"):
        if not isinstance(settings[name], bool):
            raise ValueError(f"{name}: found {settings[name]!r}, expected true or false")
    for name, low in (("workers", 0), ("shard_rows", 1), ("gap", 0)):
        value = settings[name]
        whole = isinstance(value, int) and not isinstance(value, bool) and value >= low
        if not whole and not (name == "gap" and value == plan.CHOICE):
            raise ValueError(f"{name}: found {value!r}, expected a whole number of at least {low}")
    if settings["frames"] is not None and not (isinstance(settings["frames"], int) and settings["frames"] >= 1):
        raise ValueError(f"frames: found {settings['frames']!r}, expected a whole number of at least 1, or null")
    if settings["pose_sigma"] is not None and settings["pose"] == "near":
        raise ValueError(f"pose_sigma: found {settings['pose_sigma']} with pose=near, expected pose=device or start")
    given.sigmas(settings["pose_sigma"], "pose_sigma")
    for name, high in (("step", 1.0), ("fps", 1e4)):
        value = settings[name]
        least = 0.0 if name == "step" else 1e-4
        number = isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= high
        if not number and not (name == "fps" and value is None):
            raise ValueError(f"{name}: found {value!r}, expected a number from {least:g} to {high:g}")
