"""What came out, for a person: console and Markdown tables from archived results, and nothing but them.

So ``dhtorch report`` shows a result of any age and machine exactly as the job that wrote it did.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from dhtorch import archive
from dhtorch.codes import words

Result = Mapping[str, Any]

#: First cell of the row with the intervals over scenes.
INTERVAL = "95 % interval"


class Column(NamedTuple):
    """A metric in a table."""

    metric: str
    head: str
    show: str  # percent | ratio | fine | number | count


#: The main table, one row per scene. The optional ones appear where a result has them.
COLUMNS = (
    Column("n_candidates", "candidates", "count"),
    Column("coverage", "coverage", "percent"),
    Column("median_rel", "median", "percent"),
    Column("p90_rel", "p90", "percent"),
    Column("corr", "corr", "ratio"),
    Column("residual_px", "residual px", "ratio"),
    Column("pnp_success", "pose found", "percent"),
)
OPTIONAL = (
    Column("wrong_share", "> 20 % off", "percent"),
    Column("aurc", "AURC", "fine"),
    Column("ece", "ECE", "fine"),
)
DECIMALS = {"count": 0, "number": 1, "ratio": 2, "fine": 3}


@dataclass(frozen=True)
class Table:
    """Text cells, ready for any medium."""

    title: str
    head: list[str]
    rows: list[list[str]]
    n_label: int = 1  # leading columns that are words
    footer: int = 0  # trailing rows that sum up


def tables(result: Result) -> list[Table]:
    """The tables of one result: errors by scene, what the truth test dropped, holes by class, time by stage."""
    methods = list(dict.fromkeys(row["method"] for row in result["rows"]))
    truths = list(dict.fromkeys(row.get("truth") for row in result["rows"]))
    several = len(truths) > 1
    found = [_main(result, t, f"{describe(result)}; truth test {t}" if several else describe(result)) for t in truths]
    groups = (("n_dropped", "truth dropped", "count"), ("hole_share", "holes by class", "percent"))
    for group, title, show in (*groups, ("ms", "milliseconds per pair", "number")):
        table = _group(result, methods, group, title, show)
        found += [table] if table else []
    return found


def print_tables(result: Result, console: Any = None) -> None:
    """Print the tables of a result with rich.

    Args:
        result: valid, as from :func:`dhtorch.archive.read`.
        console: a ``rich.console.Console``; None = standard output.
    """
    from rich import box  # noqa: PLC0415
    from rich.console import Console  # noqa: PLC0415
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table as RichTable  # noqa: PLC0415

    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, 180)  # a file has no edge to wrap at
    for table in tables(result):
        shown = RichTable(
            title=escape(table.title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold", pad_edge=False
        )
        for k, head in enumerate(table.head):
            shown.add_column(escape(head), justify="left" if k < table.n_label else "right")
        for k, cells in enumerate(table.rows):
            left = len(table.rows) - k
            style = "bold" if left <= table.footer and cells[0] != INTERVAL else "dim" if left <= table.footer else None
            shown.add_row(*map(escape, cells), style=style, end_section=left == table.footer + 1 and table.footer > 0)
        console.print(shown)


def markdown(result: Result) -> str:
    """The tables of a result as Markdown."""
    parts = []
    for table in tables(result):
        align = [":--" if k < table.n_label else "--:" for k in range(len(table.head))]
        plain = [f"| {' | '.join(_escape(c) for c in cells)} |" for cells in (table.head, align, *table.rows)]
        parts.append(f"**{table.title}**\n\n" + "\n".join(plain) + "\n")
    return "\n".join(parts)


def main(argv: Sequence[str]) -> int:
    """``dhtorch report RESULT…``: tables from archived results.

    Raises:
        FileNotFoundError, ValueError: a result is missing or not valid.
    """
    parser = argparse.ArgumentParser(prog="dhtorch report", description="Tables from archived results.")
    parser.add_argument("result", nargs="+", type=Path, help="result.json, or a folder with one")
    parser.add_argument("--markdown", action="store_true", help="Markdown instead of console tables")
    parser.add_argument("--traceback", action="store_true", help="show where an error came from")
    options = parser.parse_args(argv)
    results = [archive.read(path) for path in options.result]
    for path, result in zip(options.result, results, strict=True):
        if options.markdown:
            print(markdown(result))
        else:
            print(path)
            print_tables(result)
    return 0


def describe(result: Result) -> str:
    """One line: experiment, data, verdict, when and with which code."""
    verdict = f", {result['verdict']}" if result["verdict"] else ""
    meta = result["meta"]
    return (
        f"{result['experiment']} on {result['data']['name']}{verdict} ({meta['utc']}, code {meta['git'] or 'unknown'})"
    )


def _main(result: Result, truth: str | None, title: str) -> Table:
    """Errors by scene and method for one truth test; scenes with a role stand apart from the summary."""
    mine = [row for row in result["rows"] if row.get("truth") == truth]
    order = list(dict.fromkeys(row["scene"] for row in mine))
    scenes = sorted((row for row in mine if row["pair"] is None), key=lambda row: order.index(row["scene"]))
    methods = list(dict.fromkeys(row["method"] for row in mine))
    columns = (*COLUMNS, *(c for c in OPTIONAL if any(row.get(c.metric) is not None for row in scenes)))
    lead = ["scene", "method"] if len(methods) > 1 else ["scene"]
    pairs = [(row["scene"], row["method"]) for row in mine if row["pair"] is not None]
    apart = {row["scene"] for row in scenes if row.get("role")}

    def line(scene: str, method: str, count: str, cells: list[str]) -> list[str]:
        return [*[scene, method][: len(lead)], count, *cells]

    rows = []
    for row in scenes:
        name = f"{row['scene']} ({row['role']})" if row.get("role") else row["scene"]
        cells = [_show(row.get(c.metric), c.show) for c in columns]
        rows.append(line(name, row["method"], str(pairs.count((row["scene"], row["method"]))), cells))
    footer = []
    n_scenes = len({row["scene"] for row in scenes} - apart)
    for method in methods if n_scenes else ():
        entries = [(_entry(result, method, c.metric, truth), c.show) for c in columns]
        n_pairs = sum(m == method and scene not in apart for scene, m in pairs)
        values = [_show(entry.get("value"), show) for entry, show in entries]
        footer.append(line(f"{n_scenes} scene{'s' * (n_scenes != 1)}", method, str(n_pairs), values))
        ranges = [_range(entry.get("low"), entry.get("high"), show) for entry, show in entries]
        if any(ranges):
            footer.append(line(INTERVAL, method, "", ranges))
    return Table(title, [*lead, "pairs", *(c.head for c in columns)], rows + footer, len(lead), len(footer))


def _group(result: Result, methods: list[str], group: str, title: str, show: str) -> Table | None:
    """A table with one row per method and one column per member of a group of metrics; None where there is none."""
    split = [f".{name}".split(f".{group}.", 1) for name in result["summary"]]
    members = list(dict.fromkeys(parts[1] for parts in split if len(parts) > 1))
    rows = []
    for method in methods:
        values = [_entry(result, method, f"{group}.{m}").get("value") for m in members]
        total = [_show(sum(v or 0 for v in values), show)] if group == "ms" else []
        rows.append([method, *(_show(v, show) for v in values), *total])
    if len(rows) > 1 and all(row[1:] == rows[0][1:] for row in rows):
        rows = [["all methods", *rows[0][1:]]]
    head = ["method", *map(words, members), *(["total"] if group == "ms" else [])]
    return Table(title, head, rows) if members and rows else None


def _entry(result: Result, method: str, metric: str, truth: str | None = None) -> Mapping[str, Any]:
    """Summary of a metric: under the method and truth test, under the method, or plain in a result of one method."""
    summary = result["summary"]
    found = summary.get(f"{method}.{truth}.{metric}") or summary.get(f"{method}.{metric}")
    return found or summary.get(metric) or {}


def _show(value: float | None, show: str) -> str:
    if value is None:
        return "–"
    if show == "percent":
        return _percent(value)
    return f"{value:.{DECIMALS[show]}f}"


def _range(low: float | None, high: float | None, show: str) -> str:
    if low is None or high is None:
        return ""
    return f"{_show(low, show).removesuffix(' %')}–{_show(high, show)}"


def _percent(value: float) -> str:
    """Two decimals below 10 %, one above, none at 0 and 100."""
    percent = 100 * value
    decimals = 0 if percent in (0, 100) else 2 if percent < 9.995 else 1
    return f"{percent:.{decimals}f} %"


def _escape(cell: str) -> str:
    return cell.replace("|", "\\|")
