"""How numbers stand in the tables that readme.py writes."""

from __future__ import annotations

from dhtorch.experiments.report import ReportTable, text


def percent(value: float | None) -> str:
    """A share as text."""
    return "–" if value is None else f"{100 * value:.1f} %"


def number(value: float | None) -> str:
    """Two decimals."""
    return "–" if value is None else f"{value:.2f}"


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table, words left and numbers right."""
    return text.table_to_markdown(ReportTable("", head, rows))
