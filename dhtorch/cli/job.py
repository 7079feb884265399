"""One experiment job: components named by the settings -> ``result.json`` in the job's own folder.

The result is written last, after its figures: a folder with a valid ``result.json`` holds all output of the job.
"""

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
from dhtorch.experiments.protocol import MIN_CANDIDATES, Settings
from dhtorch.ops import loader
from dhtorch.runtime import code_dependencies, console, storage
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import format_count
from dhtorch.runtime.output_folder import PRIVATE_FOLDER, open_output_folder

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
    data_sets: Sequence[Any] = parts["data"] if isinstance(parts["data"], list) else [parts["data"]]
    if not (data_sets and all(isinstance(each, FocalStacks) for each in data_sets)):
        data_sets = scenes_of(parts["data"])
    sources = [each if isinstance(each, FocalStacks) else each.recording for each in data_sets]
    digest = result_files.compute_data_digest(
        {
            **result_files.list_files_below((source.root, source.bounds) for source in sources),
            **result_files.list_files_named({k: settings[k] for k in SETTINGS_GROUPS}),
        }
    )
    modules = code_dependencies.find_reachable_modules(code_dependencies.iter_targets(settings))
    code = code_dependencies.compute_code_digest(modules)
    key = result_files.compute_result_key({**settings, "choices": names}, digest, code=code)
    target = folder / "result.json"
    for data_set in data_sets if _LOG.isEnabledFor(logging.DEBUG) else ():
        sequence = data_set.recording if isinstance(data_set, Scene) else data_set
        _LOG.debug("data: %s, %d of %s", data_set.name, len(sequence), sequence.format)
    _LOG.debug("digest %s, key %s", digest, key)
    with open_output_folder(folder, "output") as output:
        if output.is_unlisted and target.is_file():
            with contextlib.suppress(ValueError, OSError):
                result_files.read_result(target)
                output.adopt(folder.rglob("*"))  # a result of an older version, without a manifest
        if settings["resume"] and output.owns(target) and result_files.is_finished(target, key):
            print(f"{target}: finished and valid, left untouched")
            return JobStatus(str(folder), "untouched")
        output.check_folders([folder / _SCENES_FOLDER, *(folder / data_set.name for data_set in data_sets)])
        output.check([target, folder / DATA_ROOT_FILE])
        methods = {names["method"]: parts["method"]}
        # The key of the scenes: that of the result, and the machine and libraries on which their last bits depend
        meta = {k: v for k, v in _collect_metadata(settings).items() if k not in ("utc", "git")}
        finished = FinishedScenes(
            folder / _SCENES_FOLDER, hashlib.sha256(repr((key, meta)).encode()).hexdigest(), reuse=settings["resume"]
        )
        pair_settings = Settings(
            cutoff=settings["holdout"]["cutoff"],
            truth=(settings["holdout"]["truth"],),
            dtype=getattr(torch, settings["dtype"]),
            finished=finished,
            **{name: settings[name] for name in ("seed", "device", "batch", "workers", "between")},
        )
        outcome = parts["experiment"](data_sets, methods, parts["pairs"], pair_settings, progress=progress)
        _LOG.debug("%d pairs answered", outcome.n_pairs)
        examples = outcome.examples if settings["figures"] else []
        drawn = [path for example in examples for path in draw_example(folder / example.scene, example)]
        scenes = [data_set.name for data_set in data_sets]
        data = {"name": names["data"], "scenes": scenes, "n_pairs": outcome.n_pairs, "digest": digest}
        result = result_files.build_result(
            experiment=names["experiment"],
            key=key,
            meta={**_collect_metadata(settings), "code": code},
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
        root = settings["data"].get("root") if isinstance(settings["data"], Mapping) else None
        if root is not None:
            storage.replace_file(folder / DATA_ROOT_FILE, f"{Path(root).resolve()}\n".encode())
        result_files.write_result(target, result)
        finished.remove()
        _print_result(result, [target, *drawn], swept=swept)
        return JobStatus(str(folder), "finished")


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


def _collect_metadata(settings: Mapping[str, Any]) -> dict[str, Any]:
    options = {name: settings[name] for name in ("device", "dtype", "seed")}
    return result_files.collect_run_metadata(
        **options, threads=torch.get_num_threads(), operators=loader.describe_operators()
    )
