"""Reports of archived results: tables on the console, as Markdown, or as an HTML page with figures.

Only the result files are read, so ``dhtorch report`` shows a result of any age and machine as its job did.

``reading`` accesses the schema of results, ``cells`` formats numbers, ``tables`` builds tables; ``layouts`` (and
``timings``) arrange them as the paper does, beside the figures in ``published``; ``plots`` lists the figures (built by
``curves``, ``sweeps`` and ``overlays`` with the types of ``figure``, drawn by ``dhtorch.viz.plots``); ``text`` and
``page`` write the output.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dhtorch.experiments.report import job_figure, jobs, page, text
from dhtorch.experiments.report.advice import advice
from dhtorch.experiments.report.layouts import SHOWN_COLUMNS, layout_tables
from dhtorch.experiments.report.reading import Result, describe_result
from dhtorch.experiments.report.tables import INTERVAL_LABEL, ReportTable, generic_tables
from dhtorch.runtime import results as result_files
from dhtorch.runtime.console import HELP_EPILOG, format_count, get_verbosity, progress
from dhtorch.runtime.output_folder import open_output_folder

#: Largest number of rows that the brief table shows; with more, only the summary.
_MAX_BRIEF_ROWS = 8

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
    """Print the main table of a result and every other one with figures of the paper; of many scenes the summary."""
    for k, table in enumerate(layout_tables(result) or generic_tables(result, SHOWN_COLUMNS)):
        if k == 0 or table.cites_paper:
            text.print_table(_shorten_table(table))


def _shorten_table(table: ReportTable) -> ReportTable:
    """The table without its summary if that repeats a single scene, or of many scenes with the summary alone."""
    n_body = len(table.rows) - table.footer - table.quoted
    if table.footer and n_body == 1:
        return replace(table, rows=[*table.rows[:1], *table.rows[n_body + table.footer :]], footer=0)
    return replace(table, rows=table.rows[n_body:]) if table.footer and n_body > _MAX_BRIEF_ROWS else table


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
            if pictured and job_figure.draw_sweep(folder / "sweep.png", results):
                message += " and sweep.png"
    except OSError as error:  # a read-only folder, a sweep that is running, a foreign file
        message = f"{folder}: no sweep.csv written ({error.strerror or error})"
    if not markdown:
        print(message)


def to_markdown(result: Result) -> str:
    """Tables of a result as Markdown."""
    return text.tables_to_markdown(tables(result))


def main(argv: Sequence[str]) -> int:
    """Run ``dhtorch report RESULT…``: print tables of archived results, or write a page; returns the exit code.

    Raises:
        FileNotFoundError, ValueError: a result is missing or invalid, or the page cannot be written.
    """
    parser = argparse.ArgumentParser(
        prog="dhtorch report", description="Tables and a page from archived results.", epilog=HELP_EPILOG
    )
    parser.add_argument("result", nargs="+", type=Path, help="result.json, or a folder with one or many below it")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--markdown", action="store_true", help="Markdown instead of console tables")
    form.add_argument("--html", type=Path, metavar="FILE", help="write one page with tables and figures instead")
    parser.add_argument("--traceback", action="store_true", help="show the traceback of an error")
    options = parser.parse_args(argv)
    paths = list(_find_results(options.result))
    results = [result_files.read_result(path) for path in progress(paths, "results", len(paths))]
    if options.html:
        print(f"wrote {page.write_report(options.html, results)}: {format_count(len(results), 'result')}")
        return 0
    for folder in options.result:
        jobs_of_folder = [
            r for path, r in zip(paths, results, strict=True) if path != folder and path.is_relative_to(folder)
        ]
        print_sweep(jobs_of_folder, folder, markdown=options.markdown)
    experiments = {r["experiment"] for r in results}
    if len(options.result) == 1 and len(results) > 1 and len(experiments) == 1 and get_verbosity() != "verbose":
        return 0  # the table of the sweep is enough; -v shows every job
    for path, result in zip(paths, results, strict=True):
        try:
            _print_result(path, result, markdown=options.markdown)
        except ValueError as error:  # of a cell
            raise ValueError(f"{path}: {error}") from error
    return 0


def _print_result(path: Path, result: Result, *, markdown: bool) -> None:
    """Print one archived result: its tables, and the verdict on its question."""
    if markdown:
        print(to_markdown(result))
        return
    print(path)
    print_tables(result)
    if result["verdict"]:
        print(f"{result['question']}\n{result['verdict']}: {result['why']}\n")


def _find_results(paths: Iterable[Path]) -> Iterable[Path]:
    """Result files of the paths; a folder without a result of its own stands for all below it, as of a sweep."""
    for path in paths:
        below = sorted(path.rglob("result.json")) if path.is_dir() and not (path / "result.json").is_file() else []
        yield from below or [path]
