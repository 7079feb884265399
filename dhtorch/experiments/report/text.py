"""Output of tables on the console and as Markdown."""

import sys
from collections.abc import Iterable
from typing import Any

from dhtorch.experiments.report.tables import INTERVAL_LABEL, ReportTable
from dhtorch.runtime.console import escape_markup, unwrap_terminal


def print_table(table: ReportTable, console: Any = None) -> None:
    """Print a table with rich; ``console`` is a ``rich.console.Console``, None = standard output."""
    from rich import box  # noqa: PLC0415
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table as RichTable  # noqa: PLC0415

    console = console or Console(file=unwrap_terminal(sys.stdout))
    if not console.is_terminal:
        console.width = max(console.width, 240)  # output to a file is not wrapped at the terminal width
    shown = RichTable(
        title=escape_markup(table.title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold", pad_edge=False
    )
    for k, head in enumerate(table.flat_head()):
        shown.add_column(escape_markup(head), justify="left" if k < table.n_label else "right", overflow="fold")
    n_body = len(table.rows) - table.footer - table.quoted
    ends = (n_body, n_body + table.footer)  # of the body and of the summary
    for k, cells in enumerate(table.rows):
        style = None if k < n_body else "yellow" if k >= ends[1] else "dim" if cells[0] == INTERVAL_LABEL else "bold"
        texts = map(escape_markup, cells)
        marked = [f"[bold]{text}[/bold]" if (k, n) in table.best else text for n, text in enumerate(texts)]
        shown.add_row(*marked, style=style, end_section=k + 1 in ends and k + 1 < len(table.rows))
    console.print(shown)
    if table.note:
        console.print(f"{escape_markup(table.note)}\n", style="dim", highlight=False)


def tables_to_markdown(tables: Iterable[ReportTable]) -> str:
    """Tables as Markdown, each under its title in bold and above its note."""
    parts = []
    for table in tables:
        parts.append(f"**{_escape_cell(table.title)}**\n\n{table_to_markdown(table)}\n")
        parts += [f"{_escape_cell(table.note)}\n"] if table.note else []
    return "\n".join(parts)


def table_to_markdown(table: ReportTable) -> str:
    """Rows of a table as Markdown, without title and note."""
    rows = [list(map(_escape_cell, cells)) for cells in (table.flat_head(), *table.rows)]
    for k, n in table.best:
        rows[k + 1][n] = f"**{rows[k + 1][n]}**"
    rows.insert(1, [":--" if k < table.n_label else "--:" for k in range(len(table.head))])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


def _escape_cell(cell: str) -> str:
    """Cell on one line with Markdown and HTML characters escaped."""
    return " ".join(cell.split()).replace("|", "\\|").replace("<", "&lt;")
