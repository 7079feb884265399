"""Features of a whole data set, computed once and stored: ``dhtorch extract`` and its reader.

dhtorch extract data=lerobot data.root=PATH data.gap=5 out=features workers=8

Every recording is an episode, every frame a row: ``plan`` numbers the rows, ``dataset`` computes one (with
:class:`dhtorch.transforms.ExtendDepth`), ``engines`` run it on workers or a cluster, ``columns`` and ``shards`` write
Parquet files, and ``features`` reads them for a data loader.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from dhtorch.data.io.decode import import_optional
from dhtorch.data.scene import Scene, scenes_of
from dhtorch.extract import columns, engines, plan, shards
from dhtorch.extract.dataset import RowDataset, common_map_hw
from dhtorch.extract.features import FeatureTable, JoinedDataset
from dhtorch.ops import loader
from dhtorch.pipeline.method import Method
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.runtime.console import format_count
from dhtorch.runtime.output_folder import open_output_folder
from dhtorch.transforms import TOKEN_CHANNELS, DenseMaps, schema, token_grid
from dhtorch.transforms.extend_depth import ON_ERROR_CHOICES
from dhtorch.transforms.tokens import FIT_MODES

__all__ = ["ExtractOptions", "FeatureTable", "JoinedDataset", "run"]

#: Version of the file format, increased by every change that an older reader would misread.
_FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class ExtractOptions:
    """Options of ``dhtorch extract``: what to extract, where to compute it, how to store it.

    Raises:
        ValueError: an invalid option.
    """

    engine: str = "local"  # local: this machine; ray: a cluster, through Ray Data
    address: str | None = None  # of the Ray cluster; None = start one on this machine
    gap: int | str | None = plan.AUTO_GAP  # auto = view selection among earlier frames; 0 = front end only
    patch: int = 14  # px
    tokens_hw: Sequence[int] = (224, 224)  # size of the network's input: gives all rows one shape
    fit: str = "stretch"  # how the image is resized to that size
    dense: bool | Mapping[str, Any] = False  # dense maps: True, or options as of ExtendDepth
    on_error: str = "raise"  # an unreadable frame: raise, skip, or flag = zeros and a problem code
    columns: Sequence[str] | None = None  # columns to write; None = all
    half: bool = False  # depths, scores, maps and tokens as float16
    shard_rows: int = 512  # rows per file: the most that an interruption loses

    def __post_init__(self) -> None:
        for name, choices in {"engine": engines.ENGINES, "on_error": ON_ERROR_CHOICES, "fit": FIT_MODES}.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"extract.{name}: found {getattr(self, name)!r}, expected one of {', '.join(choices)}")
        for name, low in {"gap": 0, "patch": 1, "shard_rows": 1}.items():
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= low) and not (name == "gap" and value in (None, plan.AUTO_GAP)):
                raise ValueError(f"extract.{name}: found {value!r}, expected a whole number of at least {low}")
        DenseMaps.from_options(self.dense, "extract.dense")
        if not (isinstance(self.tokens_hw, Sequence) and len(self.tokens_hw) == 2):
            raise ValueError(f"extract.tokens_hw: found {self.tokens_hw!r}, expected height and width")


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Callable[..., Iterable[Any]]) -> int:
    """``dhtorch extract``: scenes, method and options -> missing shards in ``out``; returns the exit code.

    Args:
        settings: ``out``, ``workers``, ``seed``, ``choices`` and the groups' options, as plain values.
        parts: ``data`` (scenes or recordings, one or many), ``method`` and ``extract`` (:class:`ExtractOptions`).
        progress: wraps the loop over rows: (items, text, number of items) → items.

    Raises:
        ValueError, OSError, ImportError: bad options or data, a folder that cannot be written or belongs to another
            extraction, a library that is missing.
        KeyboardInterrupt: Ctrl-C; finished shards stay.
    """
    options: ExtractOptions = parts["extract"]
    import_optional("pyarrow.parquet")
    if not isinstance(settings["workers"], int) or settings["workers"] < 0:
        raise ValueError(f"workers: found {settings['workers']!r}, expected a whole number of at least 0")
    scenes = scenes_of(parts["data"])
    extraction_plan = plan.make_plan(scenes, options.gap, parts["method"].views)
    rows = _make_rows(scenes, extraction_plan, parts["method"], settings["seed"], options)
    folder = Path(str(settings["out"])).expanduser()
    with open_output_folder(folder, "out") as output:
        folder, shared = output.path, _shared_metadata(settings, options, extraction_plan, rows)
        all_shards = extraction_plan.shards(options.shard_rows)
        done = shards.find_finished_shards(folder, shared)
        if output.is_unlisted:  # of an older version
            output.adopt(folder / name for name in done)
        todo = [shard for shard in all_shards if shard.name not in done]
        output.check(folder / shard.name for shard in todo)
        counts = dict(done)
        positions = [position for shard in todo for position in shard.rows]
        complaints: list[str] = []
        engine = engines.run_engine(
            options.engine, rows, positions, workers=settings["workers"], address=options.address
        )
        shown = progress(engine, format_count(len(extraction_plan), "frame"), len(positions))
        try:
            with closing(shown) as answers:  # type: ignore[type-var]
                for shard in todo:
                    kept = engines.filter_rows(islice(answers, len(shard.rows)), options.on_error, rows, complaints)
                    counts[shard.name] = shards.write_shard(folder, shard, kept, rows.wanted, shared)
        except KeyboardInterrupt:
            finished = f"{len(counts)} of {format_count(len(all_shards), 'shard')} in {folder} are complete and stay"
            raise KeyboardInterrupt(f"{finished}; run the same command again for the rest") from None
        _print_summary(folder, counts, len(done), complaints)
        return 0


def _make_rows(
    scenes: Sequence[Scene], extraction_plan: plan.ExtractionPlan, method: Method, seed: int, options: ExtractOptions
) -> RowDataset:
    """Scenes, plan and options -> data set of rows with the selected columns."""
    hw = (int(options.tokens_hw[0]), int(options.tokens_hw[1]))
    token_rows, token_columns = token_grid(hw, patch=options.patch, tokens_hw=hw)
    # Height and width of the maps; None if no column holds one. Maps require images of one size
    maps = DenseMaps.from_options(options.dense, "extract.dense")
    dense = {spec.key for spec in schema.COLUMNS if spec.option == "dense"}
    has_map_column = options.columns is None or not dense.isdisjoint(options.columns)
    all_columns = columns.feature_columns(
        method.n,
        token_rows * token_columns,
        half=options.half,
        map_hw=common_map_hw(scenes, maps) if maps is not None and has_map_column else None,
    )
    return RowDataset(
        scenes,
        extraction_plan,
        columns.select_columns(all_columns, options.columns),
        method=method,
        gap=options.gap,
        seed=seed,
        patch=options.patch,
        tokens_hw=hw,
        fit=options.fit,
        dense=options.dense,
    )


def _shared_metadata(
    settings: Mapping[str, Any], options: ExtractOptions, extraction_plan: plan.ExtractionPlan, rows: RowDataset
) -> dict[str, Any]:
    """Metadata shared by all shards: meaning of the columns, settings, data, versions and key."""
    # The others change where and how fast rows are computed, but not the rows.
    key_options = {k: v for k, v in asdict(options).items() if k not in ("engine", "address")}
    config = {**{k: settings[k] for k in ("data", "method", "seed")}, "extract": key_options}
    files = {**result_files.list_files_below(extraction_plan.roots.items()), **result_files.list_files_named(config)}
    name, digest = settings["choices"]["data"], result_files.compute_data_digest(files)
    run_metadata = result_files.collect_run_metadata(
        device="cpu", dtype="float32", threads=1, seed=settings["seed"], operators=loader.describe_operators()
    )
    metadata: dict[str, Any] = storage.to_strict_json(
        {
            "format": _FORMAT_VERSION,
            "version": run_metadata["versions"]["dhtorch"],
            "git": run_metadata["git"],
            "operators": run_metadata["operators"],
            "versions": run_metadata["versions"],
            "key": result_files.compute_result_key(
                {**config, "name": name, "format": _FORMAT_VERSION}, digest, roots=[RowDataset.__module__]
            ),
            "config": result_files.make_portable(config),
            "data": {
                "name": name,
                "digest": digest,
                "recordings": len(extraction_plan.episodes),
                "frames": len(extraction_plan),
            },
            "columns": {k: c._asdict() for k, c in rows.wanted.items()},
            "codes": columns.code_tables(),
            "channels": TOKEN_CHANNELS,
            "grid": token_grid(rows.options["tokens_hw"], patch=options.patch),
        }
    )
    return metadata


def _print_summary(folder: Path, counts: Mapping[str, Counter[str]], n_before: int, complaints: Sequence[str]) -> None:
    """Print the number of shards and rows, their size, and the problems of frames."""
    total = sum(counts.values(), Counter())
    skipped = total.pop("skipped", 0)
    size = sum(file.stat().st_size for file in shards.shard_files(folder))
    before = f" ({n_before} left untouched)" if n_before else ""
    rows = format_count(total.total(), "row")
    print(f"{folder}: {format_count(len(counts), 'shard')}{before}, {rows}, {size / 1e6:.1f} MB")
    problems = [
        f"{n} {name.replace('_', ' ')}" for name, n in (*total.items(), ("skipped", skipped)) if n and name != "none"
    ]
    if problems:
        print(f"frames with a problem: {', '.join(problems)}")
    for complaint in complaints[:3]:
        print(f"  {complaint}")
    if len(complaints) > 3:
        print(f"  and {len(complaints) - 3} more")
