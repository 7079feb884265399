"""One job: from the parts that the settings name to a result file in the job's own folder.

The result is written last, after its pictures: a folder with a valid ``result.json`` holds everything the job makes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dhtorch.data import scenes_of
from dhtorch.data.io import decode as data_files
from dhtorch.data.scene import Scene
from dhtorch.experiments import report
from dhtorch.experiments.focal.stacks import FocalStacks
from dhtorch.experiments.pictures import draw_example
from dhtorch.experiments.protocol import MIN_CANDIDATES, Outcome, Settings
from dhtorch.runtime import console, storage
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import format_count

_LOG = logging.getLogger(__name__)

#: File beside a result that says where its data lie.
DATA_ROOT_FILE = "data_root.txt"

#: The settings groups; their names enter the key of a result.
SETTINGS_GROUPS = ("method", "data", "pairs", "holdout", "experiment")


@dataclass(frozen=True)
class JobStatus:
    """How a job ended."""

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
    """Run the experiment and write ``folder/result.json``, unless resuming finds the same one there already.

    Args:
        settings: all options, resolved.
        parts: ``data``, ``method``, ``pairs`` and ``experiment``, as objects.
        choices: settings group → name of the chosen settings.
        folder: of this job alone.
        progress: wraps a loop, see :func:`dhtorch.experiments.protocol.run`.
        swept: one job of several, whose results stand in one table at the end.

    Raises:
        ValueError, OSError, KeyError, ImportError: bad options or data; nothing is written.
    """
    if settings["threads"] is not None:
        torch.set_num_threads(settings["threads"])
        data_files.set_opencv_threads(settings["threads"])
    names = {group: choices[group] for group in SETTINGS_GROUPS}
    asked = _resolve_data(parts["data"])
    digest = result_files.compute_data_digest({**_list_data_files(asked), **_list_settings_files(settings)})
    key = result_files.compute_result_key({**settings, "choices": names}, digest)
    target = folder / "result.json"
    for each in asked if _LOG.isEnabledFor(logging.DEBUG) else ():
        what = each.recording if isinstance(each, Scene) else each
        _LOG.debug("data: %s, %d of %s", each.name, len(what), what.format)
    _LOG.debug("digest %s, key %s", digest, key)
    storage.remove_unfinished_files(target)
    if settings["resume"] and result_files.is_finished(target, key):
        print(f"{target}: finished and valid, left untouched")
        return JobStatus(str(folder), "untouched")
    methods = {names["method"]: parts["method"]}
    outcome = parts["experiment"](asked, methods, parts["pairs"], _make_pair_settings(settings), progress=progress)
    _LOG.debug("%d pairs answered", outcome.n_pairs)
    examples = outcome.examples if settings["figures"] else []
    drawn = [path for example in examples for path in draw_example(folder / example.scene, example)]
    scenes = [each.name for each in asked]
    data = {"name": names["data"], "scenes": scenes, "n_pairs": outcome.n_pairs, "digest": digest}
    result = _build_result(settings, names["experiment"], key, data, outcome)
    _write_data_root(folder, settings)
    result_files.write_result(target, result)
    _print_result(result, [target, *drawn], swept=swept)
    return JobStatus(str(folder), "finished")


def _build_result(
    settings: Mapping[str, Any], experiment: str, key: str, data: Mapping[str, Any], outcome: Outcome
) -> dict[str, Any]:
    threads = torch.get_num_threads()
    return result_files.build_result(
        experiment=experiment,
        key=key,
        meta=result_files.collect_run_metadata(
            device=settings["device"], dtype=settings["dtype"], threads=threads, seed=settings["seed"]
        ),
        config=settings,
        data=data,
        summary=outcome.summary,
        rows=outcome.rows,
        question=outcome.question,
        expectation=outcome.expectation,
        verdict=outcome.verdict,
        why=outcome.why,
    )


def _write_data_root(folder: Path, settings: Mapping[str, Any]) -> None:
    """Where the data lie on this machine: beside the result, which names none."""
    root = settings["data"].get("root") if isinstance(settings["data"], Mapping) else None
    if root is not None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / DATA_ROOT_FILE).write_text(f"{Path(root).resolve()}\n", encoding="utf-8")


def _print_result(result: Mapping[str, Any], written: Sequence[Path], *, swept: bool) -> None:
    """The first look; all tables where much is to be said, none of a job of a sweep, which has a table at its end."""
    if console.get_verbosity() == "verbose":
        report.print_tables(result)
    elif not swept:
        report.print_brief(result)
    few = {r["scene"]: r["n_few"] for r in result["rows"] if r["pair"] is None and r.get("n_few")}
    for scene, n in few.items() if not swept else ():
        print(f"{scene}: {format_count(n, 'pair')} dropped, fewer than {MIN_CANDIDATES} candidates each")
    if result["verdict"]:
        print(f"{result['verdict']}: {result['why']}")
    advice = report.advice(result)
    print(
        "\n".join(advice if len(advice) <= 2 else [f"{advice[0]} (and {len(advice) - 1} more)"]),
        end="\n" * bool(advice),
    )
    beside = len(written) - 1
    more = f" and {format_count(beside, 'picture')} and points beside it" if beside else ""
    print(f"wrote {written[0]}{more}")


def _make_pair_settings(settings: Mapping[str, Any]) -> Settings:
    """The options that every pair of the job shares."""
    dtype = getattr(torch, str(settings["dtype"]), None)
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype: found {settings['dtype']!r}, expected float32 or float64")
    for name, low in (("batch", 1), ("workers", 0)):
        if not isinstance(settings[name], int) or settings[name] < low:
            raise ValueError(f"{name}: found {settings[name]!r}, expected a whole number of at least {low}")
    try:
        torch.empty(0, device=settings["device"])
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: found {settings['device']!r}, expected one that torch can use here") from error
    return Settings(
        cutoff=settings["holdout"]["cutoff"],
        truth=(settings["holdout"]["truth"],),
        seed=settings["seed"],
        device=settings["device"],
        dtype=dtype,
        batch=settings["batch"],
        workers=settings["workers"],
    )


def _resolve_data(data: Any) -> Sequence[Scene] | Sequence[FocalStacks]:
    """What the data of a job are: scenes, or focal stacks for the experiments that read them."""
    given = data if isinstance(data, list) else [data]
    if given and all(isinstance(each, FocalStacks) for each in given):
        return given
    return scenes_of(data)


def _list_data_files(asked: Iterable[Scene | FocalStacks]) -> dict[str, Path]:
    """Name → file of all data below their folders."""
    return result_files.list_files_below(each.root for each in asked)


def _list_settings_files(settings: Mapping[str, Any]) -> dict[str, Path]:
    """Option → file that the settings of a group name."""
    return result_files.list_files_named({k: settings[k] for k in SETTINGS_GROUPS})
