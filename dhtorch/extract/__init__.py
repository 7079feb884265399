"""Features of a whole data set, written once: ``dhtorch extract`` and what reads it back.

dhtorch extract data=lerobot data.root=PATH data.gap=5 out=features workers=8

Every recording is an episode, every frame a row: ``plan`` numbers the rows, ``rows`` makes one (with
:class:`dhtorch.transforms.ExtendDepth`), ``engines`` say where, ``columns`` and ``shards`` write Parquet files, and
``features`` reads them for a data loader.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from dhtorch.data.io.decode import need
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.extract import columns, engines, plan, shards
from dhtorch.extract.dataset import Rows, maps_hw
from dhtorch.extract.features import Features, JoinedDataset
from dhtorch.pipeline.method import Method
from dhtorch.runtime import file_lock as lock
from dhtorch.runtime import results as archive
from dhtorch.runtime import storage
from dhtorch.runtime.console import many
from dhtorch.transforms import CHANNELS, Maps, grid, maps
from dhtorch.transforms.extend_depth import ON_ERROR
from dhtorch.transforms.tokens import FITS

__all__ = ["ExtractOptions", "Features", "JoinedDataset", "run"]

#: Of the files: raised when a reader of older ones would be wrong.
FORMAT = 1

#: ExtractOptions that change where and how fast rows are made, and no row.
_UNKEYED = ("engine", "address")

#: Frames that cannot be read, named in the report.
_SHOWN = 3


@dataclass(frozen=True, kw_only=True)
class ExtractOptions:
    """What to extract, where it is made, and how it is stored.

    Raises:
        ValueError: an option that cannot be.
    """

    engine: str = "local"  # local: this machine; ray: a cluster, through Ray Data
    address: str | None = None  # of the Ray cluster; None = one that is started here
    gap: int | str | None = plan.CHOICE  # auto = chosen among earlier frames; else frames back, 0 = front end alone
    patch: int = 14  # px
    tokens_hw: Sequence[int] = (224, 224)  # size of the network's picture: with it all rows have one shape
    fit: str = "stretch"  # how the picture is brought to that size
    dense: bool | Mapping[str, Any] = False  # maps of every pixel: True, or options as ExtendDepth takes them
    on_error: str = "raise"  # a frame that cannot be read: raise, skip, or flag = zeros and a problem
    columns: Sequence[str] | None = None  # to write; None = all
    half: bool = False  # depths, scores, maps and tokens as float16
    shard_rows: int = 512  # of one file: what a kill loses at most

    def __post_init__(self) -> None:
        for name, known in {"engine": engines.ENGINES, "on_error": ON_ERROR, "fit": FITS}.items():
            if getattr(self, name) not in known:
                raise ValueError(f"extract.{name}: found {getattr(self, name)!r}, expected one of {', '.join(known)}")
        for name, low in {"gap": 0, "patch": 1, "shard_rows": 1}.items():
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= low) and not (name == "gap" and value in (None, plan.CHOICE)):
                raise ValueError(f"extract.{name}: found {value!r}, expected a whole number of at least {low}")
        Maps.asked(self.dense, "extract.dense")
        if not (isinstance(self.tokens_hw, Sequence) and len(self.tokens_hw) == 2):
            raise ValueError(f"extract.tokens_hw: found {self.tokens_hw!r}, expected height and width")


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Callable[..., Iterable[Any]]) -> int:
    """``dhtorch extract``: write the shards of ``out`` that are not there yet.

    Args:
        settings: ``out``, ``workers``, ``seed``, ``choices`` and the groups' options, as plain values.
        parts: ``data`` (scenes or recordings, one or many), ``method`` and ``extract`` (:class:`ExtractOptions`).
        progress: wraps the loop over rows: (items, text, number of items) → items.

    Raises:
        ValueError, OSError, ImportError: bad options or data, a folder that cannot be written or belongs to another
            extraction, a library that is missing.
        KeyboardInterrupt: Ctrl-C; what is finished stays.
    """
    options: ExtractOptions = parts["extract"]
    need("pyarrow.parquet", extra="scale")
    if not isinstance(settings["workers"], int) or settings["workers"] < 0:
        raise ValueError(f"workers: found {settings['workers']!r}, expected a whole number of at least 0")
    scenes = scenes_of(parts["data"])
    whole = plan.make(scenes, options.gap, parts["method"].views)
    rows = _rows(scenes, whole, parts["method"], settings["seed"], options)
    folder = _folder(settings["out"])
    with lock.held(folder / ".lock", f"out: {folder}"):
        shards.clear(folder)  # what a killed run left there
        return _write(settings, options, whole, rows, folder, progress)


def _write(
    settings: Mapping[str, Any],
    options: ExtractOptions,
    whole: plan.Plan,
    rows: Rows,
    folder: Path,
    progress: Callable[..., Iterable[Any]],
) -> int:
    """The shards that are not there yet; the exit code."""
    shared = _shared(settings, options, whole, rows)
    every = whole.shards(options.shard_rows)
    done = shards.finished(folder, shared)
    counts = dict(done)
    todo = [shard for shard in every if shard.name not in done]
    positions = [position for shard in todo for position in shard.rows]
    complaints: list[str] = []
    engine = engines.run(options.engine, rows, positions, workers=settings["workers"], address=options.address)
    try:
        with closing(progress(engine, many(len(whole), "frame"), len(positions))) as answers:  # type: ignore[type-var]
            for shard in todo:
                kept = engines.kept(islice(answers, len(shard.rows)), options.on_error, rows, complaints)
                counts[shard.name] = shards.write(folder, shard, kept, rows.wanted, shared)
    except KeyboardInterrupt:
        whole_ones = f"{len(counts)} of {many(len(every), 'shard')} in {folder} are whole and stay"
        raise KeyboardInterrupt(f"{whole_ones}; the same command does the rest") from None
    _say(folder, counts, len(done), complaints)
    return 0


def _rows(scenes: Sequence[Scene], whole: plan.Plan, method: Method, seed: int, options: ExtractOptions) -> Rows:
    hw = (int(options.tokens_hw[0]), int(options.tokens_hw[1]))
    rows, across = grid(hw, patch=options.patch, tokens_hw=hw)
    every = columns.columns(method.n, rows * across, half=options.half, map_hw=_map_hw(scenes, options))
    return Rows(
        scenes,
        whole,
        columns.choose(every, options.columns),
        method=method,
        gap=options.gap,
        seed=seed,
        patch=options.patch,
        tokens_hw=hw,
        fit=options.fit,
        dense=options.dense,
    )


def _map_hw(scenes: Sequence[Scene], options: ExtractOptions) -> tuple[int, int] | None:
    """Size of the maps, where there is a column of one: all pictures must then have one shape."""
    asked = Maps.asked(options.dense, "extract.dense")
    named = options.columns is None or not {*maps.NUMBERS, *maps.CODES}.isdisjoint(options.columns)
    return maps_hw(scenes, asked) if asked is not None and named else None


def _shared(settings: Mapping[str, Any], options: ExtractOptions, whole: plan.Plan, rows: Rows) -> dict[str, Any]:
    """Metadata of all shards: what the columns mean and where they come from."""
    asked = {k: v for k, v in asdict(options).items() if k not in _UNKEYED}
    config = {**{k: settings[k] for k in ("data", "method", "seed")}, "extract": asked}
    files = {**archive.files_below(whole.roots), **archive.files_named(config)}
    name, digest = settings["choices"]["data"], archive.data_digest(files)
    made = archive.meta(device="cpu", dtype="float32", threads=1, seed=settings["seed"])
    found: dict[str, Any] = storage.strict(
        {
            "format": FORMAT,
            "version": made["versions"]["dhtorch"],
            "git": made["git"],
            "versions": made["versions"],
            "key": archive.result_key({**config, "name": name, "format": FORMAT}, digest, roots=[Rows.__module__]),
            "config": archive.portable(config),
            "data": {"name": name, "digest": digest, "recordings": len(whole.episodes), "frames": len(whole)},
            "columns": {k: c._asdict() for k, c in rows.wanted.items()},
            "codes": columns.code_tables(),
            "channels": CHANNELS,
            "grid": grid(rows.options["tokens_hw"], patch=options.patch),
        }
    )
    return found


def _folder(out: str) -> Path:
    """The folder of the shards, made where it is missing."""
    folder = Path(str(out)).expanduser()
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"out: {folder} is a file, expected a folder, or a place for one")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _say(folder: Path, counts: Mapping[str, Counter[str]], n_before: int, complaints: Sequence[str]) -> None:
    """What is there now, and what was wrong with frames."""
    total = sum(counts.values(), Counter())
    skipped = total.pop("skipped", 0)
    size = sum(file.stat().st_size for file in shards.shard_files(folder))
    before = f" ({n_before} left untouched)" if n_before else ""
    print(f"{folder}: {many(len(counts), 'shard')}{before}, {many(total.total(), 'row')}, {size / 1e6:.1f} MB")
    said = [
        f"{n} {name.replace('_', ' ')}" for name, n in (*total.items(), ("skipped", skipped)) if n and name != "none"
    ]
    if said:
        print(f"frames with a problem: {', '.join(said)}")
    for complaint in complaints[:_SHOWN]:
        print(f"  {complaint}")
    if len(complaints) > _SHOWN:
        print(f"  and {len(complaints) - _SHOWN} more")
