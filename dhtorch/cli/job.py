"""One experiment job: components named by the settings -> ``result.json`` in the job's own folder.

The result is written last, after its figures: a folder with a valid ``result.json`` holds all output of the job.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from dhtorch.data import scenes_of
from dhtorch.data.io import decode as data_files
from dhtorch.data.scene import Scene
from dhtorch.experiments import report
from dhtorch.experiments.finished_scenes import FinishedScenes
from dhtorch.experiments.focal.stacks import FocalStacks
from dhtorch.experiments.pictures import draw_example
from dhtorch.experiments.protocol import MIN_CANDIDATES, Outcome, Settings
from dhtorch.ops import loader
from dhtorch.runtime import code_dependencies, console, storage
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import format_count
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, OutputFolder, open_output_folder

_LOG = logging.getLogger(__name__)

#: File beside a result with the path of its data on this machine.
DATA_ROOT_FILE = "data_root.txt"

#: Folder of the scenes that an unfinished job has finished, below its own.
_SCENES_FOLDER = Path(PRIVATE_FOLDER, "scenes")

#: The settings groups; their names enter the key of a result.
SETTINGS_GROUPS = ("method", "data", "pairs", "holdout", "experiment")


@dataclass(frozen=True)
class JobStatus:
    """Final state of a job."""

    folder: str
    state: str  # finished | untouched | failed
    error: str = ""  # of a failed job, one line


def run(
    settings: Mapping[str, Any],
    parts: Mapping[str, Any],
    choices: Mapping[str, str],
    folder: Path,
    *,
    progress: Callable[[Iterable[Any], str, int], Iterable[Any]],
    swept: bool = False,
) -> JobStatus:
    """Run the experiment and write ``folder/result.json``; with ``resume``, a finished result of the same key is kept.

    Args:
        settings: all options, resolved.
        parts: ``data``, ``method``, ``pairs`` and ``experiment``, as objects.
        choices: settings group → name of the chosen settings.
        folder: of this job alone.
        progress: wraps a loop, see :func:`dhtorch.experiments.protocol.run`.
        swept: whether the job is one of a sweep, which prints one table at its end.

    Raises:
        ValueError, OSError, KeyError, ImportError: bad options or data; nothing is written.
    """
    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        data_files.set_opencv_threads(settings["threads"])
    names = {group: choices[group] for group in SETTINGS_GROUPS}
    data_sets = _resolve_data(parts["data"])
    digest = result_files.compute_data_digest({**_list_data_files(data_sets), **_list_settings_files(settings)})
    modules = code_dependencies.find_reachable_modules(code_dependencies.iter_targets(settings))
    code = code_dependencies.compute_code_digest(modules)
    key = result_files.compute_result_key({**settings, "choices": names}, digest, code=code)
    target = folder / "result.json"
    for data_set in data_sets if _LOG.isEnabledFor(logging.DEBUG) else ():
        sequence = data_set.recording if isinstance(data_set, Scene) else data_set
        _LOG.debug("data: %s, %d of %s", data_set.name, len(sequence), sequence.format)
    _LOG.debug("digest %s, key %s", digest, key)
    if settings["resume"] and result_files.is_finished(target, key):
        print(f"{target}: finished and valid, left untouched")
        return JobStatus(str(folder), "untouched")
    with open_output_folder(folder, "output") as output:
        _check_files(output, target, data_sets)
        return _write_result(settings, parts, names, (target, key, digest, code), data_sets, progress, swept=swept)


def _check_files(output: OutputFolder, target: Path, data_sets: Sequence[Scene] | Sequence[FocalStacks]) -> None:
    """Raise FileExistsError for a link or a foreign file where the job writes."""
    folder = target.parent
    if output.is_unlisted and target.is_file():
        with contextlib.suppress(ValueError, OSError):
            result_files.read_result(target)
            output.adopt(folder.rglob("*"))  # a result of an older version, without a manifest
    output.check_folders([folder / _SCENES_FOLDER, *(folder / data_set.name for data_set in data_sets)])
    output.check([target, folder / DATA_ROOT_FILE])


def _write_result(
    settings: Mapping[str, Any],
    parts: Mapping[str, Any],
    names: Mapping[str, str],
    place: tuple[Path, str, str, str],  # result file, key, digests of the data and of the code
    data_sets: Sequence[Scene] | Sequence[FocalStacks],
    progress: Callable[[Iterable[Any], str, int], Iterable[Any]],
    *,
    swept: bool,
) -> JobStatus:
    """Run the experiment and write its files."""
    target, key, digest, code = place
    folder = target.parent
    methods = {names["method"]: parts["method"]}
    finished = FinishedScenes(folder / _SCENES_FOLDER, _scenes_key(settings, key), reuse=settings["resume"])
    pair_settings = _make_pair_settings(settings, finished)
    outcome = parts["experiment"](data_sets, methods, parts["pairs"], pair_settings, progress=progress)
    _LOG.debug("%d pairs answered", outcome.n_pairs)
    examples = outcome.examples if settings["figures"] else []
    drawn = [path for example in examples for path in draw_example(folder / example.scene, example)]
    scenes = [data_set.name for data_set in data_sets]
    data = {"name": names["data"], "scenes": scenes, "n_pairs": outcome.n_pairs, "digest": digest}
    result = _build_result(settings, names["experiment"], key, data, outcome)
    result["meta"]["code"] = code
    _write_data_root(folder, settings)
    result_files.write_result(target, result)
    finished.remove()
    _print_result(result, [target, *drawn], swept=swept)
    return JobStatus(str(folder), "finished")


def _build_result(
    settings: Mapping[str, Any], experiment: str, key: str, data: Mapping[str, Any], outcome: Outcome
) -> dict[str, Any]:
    return result_files.build_result(
        experiment=experiment,
        key=key,
        meta=_collect_metadata(settings),
        config=settings,
        data=data,
        summary=outcome.summary,
        rows=outcome.rows,
        question=outcome.question,
        expectation=outcome.expectation,
        verdict=outcome.verdict,
        why=outcome.why,
        metrics=[asdict(metric) for metric in outcome.metrics],
    )


def _write_data_root(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write the absolute data path beside the result (the result itself holds no machine paths)."""
    root = settings["data"].get("root") if isinstance(settings["data"], Mapping) else None
    if root is not None:
        storage.replace_file(folder / DATA_ROOT_FILE, f"{Path(root).resolve()}\n".encode())


def _print_result(result: Mapping[str, Any], written: Sequence[Path], *, swept: bool) -> None:
    """Print a brief result; all tables if verbose; no table for a job of a sweep, which prints one at its end."""
    if console.get_verbosity() == "verbose":
        report.print_tables(result)
    elif not swept:
        report.print_brief(result)
    n_skipped = {r["scene"]: r["n_few"] for r in result["rows"] if r["pair"] is None and r.get("n_few")}
    for scene, n in n_skipped.items() if not swept else ():
        print(f"{scene}: {format_count(n, 'pair')} skipped: fewer than {MIN_CANDIDATES} candidate samples each")
    if result["verdict"]:
        print(f"{result['verdict']}: {result['why']}")
    advice = report.advice(result)
    print(
        "\n".join(advice if len(advice) <= 2 else [f"{advice[0]} (and {len(advice) - 1} more)"]),
        end="\n" * bool(advice),
    )
    n_figures = len(written) - 1
    figures = f" and {format_count(n_figures, 'picture')} and points beside it" if n_figures else ""
    print(f"wrote {written[0]}{figures}")


def _scenes_key(settings: Mapping[str, Any], key: str) -> str:
    """Key of the scenes of a job: that of its result, and the machine and libraries on which their last bits depend."""
    meta = {k: v for k, v in _collect_metadata(settings).items() if k not in ("utc", "git")}
    return hashlib.sha256(repr((key, meta)).encode()).hexdigest()


def _collect_metadata(settings: Mapping[str, Any]) -> dict[str, Any]:
    options = {name: settings[name] for name in ("device", "dtype", "seed")}
    return result_files.collect_run_metadata(
        **options, threads=torch.get_num_threads(), operators=loader.describe_operators()
    )


def _make_pair_settings(settings: Mapping[str, Any], finished: FinishedScenes) -> Settings:
    """The options shared by all pairs of the job."""
    dtype = getattr(torch, str(settings["dtype"]), None)
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype: found {settings['dtype']!r}, expected float32 or float64")
    for name, low in (("batch", 1), ("workers", 0)):
        if not isinstance(settings[name], int) or settings[name] < low:
            raise ValueError(f"{name}: found {settings[name]!r}, expected a whole number of at least {low}")
    try:
        torch.empty(0, device=settings["device"])
    except (RuntimeError, AssertionError) as error:
        raise ValueError(
            f"device: found {settings['device']!r}, expected a device that torch can use on this machine"
        ) from error
    return Settings(
        cutoff=settings["holdout"]["cutoff"],
        truth=(settings["holdout"]["truth"],),
        seed=settings["seed"],
        device=settings["device"],
        dtype=dtype,
        batch=settings["batch"],
        workers=settings["workers"],
        between=settings["between"],
        finished=finished,
    )


def _resolve_data(data: Any) -> Sequence[Scene] | Sequence[FocalStacks]:
    """Data object -> scenes, or focal stacks for the experiments that read them."""
    data_sets = data if isinstance(data, list) else [data]
    if data_sets and all(isinstance(each, FocalStacks) for each in data_sets):
        return data_sets
    return scenes_of(data)


def _list_data_files(data_sets: Iterable[Scene | FocalStacks]) -> dict[str, Path | str]:
    """Name → path of all data files below the scenes' folders."""
    sources = [each if isinstance(each, FocalStacks) else each.recording for each in data_sets]
    return result_files.list_files_below((source.root, source.bounds) for source in sources)


def _list_settings_files(settings: Mapping[str, Any]) -> dict[str, Path]:
    """Option → path of every file named in the settings."""
    return result_files.list_files_named({k: settings[k] for k in SETTINGS_GROUPS})
