"""Reports of archived results: tables on the console, as Markdown, or as an HTML page with figures.

Only the result files are read, so ``dhtorch report`` shows a result of any age and machine as its job did.

``reading`` accesses the schema of results, ``cells`` formats numbers, ``tables`` builds tables; ``layouts`` lists those
of the paper, beside the figures in ``published``; ``figures`` draws matplotlib axes, ``jobs`` compares the jobs of a
sweep; ``text`` and ``page`` write the output.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dhtorch.codes import Gate, describe, words
from dhtorch.experiments.report import jobs, page, text
from dhtorch.experiments.report.cells import Result, describe_result, metric_value, scene_rows
from dhtorch.experiments.report.layouts import SHOWN_COLUMNS, layout_tables
from dhtorch.experiments.report.tables import INTERVAL_LABEL, ReportTable, generic_tables
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import Progress, format_count, get_verbosity
from dhtorch.runtime.output_folder import open_output_folder

__all__ = [
    "INTERVAL_LABEL",
    "ReportTable",
    "Result",
    "advice",
    "describe_result",
    "main",
    "print_brief",
    "print_sweep",
    "print_tables",
    "tables",
    "to_markdown",
]


def tables(result: Result) -> list[ReportTable]:
    """Tables of one result: in the layout of the paper if it has this experiment, then the generic ones."""
    return [*layout_tables(result), *generic_tables(result, SHOWN_COLUMNS)]


def print_tables(result: Result, console: Any = None) -> None:
    """Print the tables of a result with rich.

    Args:
        result: valid, as from :func:`dhtorch.runtime.results.read_result`.
        console: a ``rich.console.Console``; None = standard output.
    """
    for table in tables(result):
        text.print_table(table, console)


def print_brief(result: Result) -> None:
    """Print the main table of a result and every other one with figures of the paper.

    The summary is left out if it repeats a single scene; of more than eight rows it alone is printed.
    """
    for k, table in enumerate(layout_tables(result) or generic_tables(result, SHOWN_COLUMNS)):
        n_body, rows, footer = len(table.rows) - table.footer - table.quoted, table.rows, table.footer
        if footer and n_body == 1:
            rows, footer = [*rows[:1], *rows[1 + footer :]], 0
        elif footer and n_body > 8:
            rows = rows[n_body:]
        if k == 0 or table.cites_paper:
            text.print_table(replace(table, rows=rows, footer=footer))


def advice(result: Result) -> list[str]:
    """What might help where a job answered next to nothing: a line per scene and reason, from its samples."""
    lines = []
    for row in scene_rows(result):
        fractions = metric_value(row, "gate_share") or {}
        if "answer" not in fractions or fractions["answer"] > 0.005:
            continue
        gate = max((g for g in fractions if g != "answer"), key=lambda g: fractions[g])
        entry = describe(Gate, gate)
        if entry is not None and entry.retry:
            share = f"{words(gate)}: {fractions[gate]:.0%}"
            lines.append(f"{row['scene']}: no answer, {entry.meaning} ({share}); {entry.retry}")
    return list(dict.fromkeys(lines))


def print_sweep(results: Sequence[Result], folder: Path, *, markdown: bool = False) -> None:
    """Print the table of a sweep's jobs and write it beside them as ``sweep.csv`` and, as curves, ``sweep.png``.

    Nothing for fewer than two jobs; no picture where every job has ``figures=false``.
    """
    table = jobs.jobs_table(results)
    if table is None:
        return
    if markdown:
        print(text.tables_to_markdown([table]))
    else:
        text.print_table(table)
    try:
        with open_output_folder(folder, "folder"):
            message = f"wrote {jobs.write_jobs_csv(folder / 'sweep.csv', results)}"
            pictured = any(result["config"].get("figures", True) for result in results)
            if pictured and jobs.draw_sweep(folder / "sweep.png", results):
                message += " and sweep.png"
    except OSError as error:  # a read-only folder, a sweep that is running, a foreign file
        message = f"{folder}: no sweep.csv written ({error.strerror or error})"
    if not markdown:
        print(message)


def to_markdown(result: Result) -> str:
    """Tables of a result as Markdown."""
    return text.tables_to_markdown(tables(result))


def run(settings: Mapping[str, Any], parts: Mapping[str, Any], *, progress: Progress) -> int:
    """Run ``dhtorch report RESULT…``: print tables of archived results, or write a page; returns the exit code.

    Raises:
        FileNotFoundError, ValueError: a result is missing or invalid, or the page cannot be written.
    """
    folders, is_markdown = [Path(str(each)).expanduser() for each in settings["result"]], settings["markdown"]
    if settings["html"] and is_markdown:
        raise ValueError("markdown: found true with html, expected one of them")
    paths = list(_find_results(folders))
    results = [result_files.read_result(path) for path in progress(paths, "results", len(paths))]
    if settings["html"]:
        print(f"wrote {page.write_report(Path(settings['html']), results)}: {format_count(len(results), 'result')}")
        return 0
    for folder in folders:
        jobs_of_folder = [
            r for path, r in zip(paths, results, strict=True) if path != folder and path.is_relative_to(folder)
        ]
        print_sweep(jobs_of_folder, folder, markdown=is_markdown)
    experiments = {r["experiment"] for r in results}
    if len(folders) == 1 and len(results) > 1 and len(experiments) == 1 and get_verbosity() != "verbose":
        return 0  # the table of the sweep is enough; -v shows every job
    for path, result in zip(paths, results, strict=True):
        try:
            if is_markdown:
                print(to_markdown(result))
                continue
            print(path)
            print_tables(result)
        except ValueError as error:  # of a cell
            raise ValueError(f"{path}: {error}") from error
        if result["verdict"]:
            print(f"{result['question']}\n{result['verdict']}: {result['why']}\n")
    return 0


def _find_results(paths: Iterable[Path]) -> Iterable[Path]:
    """Result files of the paths; a folder without a result of its own stands for all below it, as of a sweep."""
    for path in paths:
        below = sorted(path.rglob("result.json")) if path.is_dir() and not (path / "result.json").is_file() else []
        yield from below or [path]
