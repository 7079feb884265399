"""A sweep's result: one table of its jobs, what differs between them on the left and what came of it on the right."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dhtorch.experiments.report.cells import NOTHING, head, show
from dhtorch.experiments.report.reading import Result, entry, variants
from dhtorch.experiments.report.tables import Table
from dhtorch.runtime import storage
from dhtorch.runtime.console import many

#: Metric → whether more is better.
METRICS = {"coverage": True, "median_rel": False, "p90_rel": False, "coverage_at_5": True, "ms": False}

#: Settings that make no other job.
ALIKE = ("output", "resume", "traceback", "figures", "workers", "threads", "launch")

#: Groups whose choices have a name of their own; what they set is named beside it only where it differs under one name.
NAMED = ("method", "data", "pairs", "experiment")


def differing(results: Sequence[Result]) -> list[dict[str, str]]:
    """Of every result, the settings that are not the same in all, by name."""
    choices = [_choices(result) for result in results]
    flat = [dict(_leaves(result["config"])) for result in results]
    found: list[dict[str, str]] = [{} for _ in results]
    for group in NAMED:
        if len({chosen[group] for chosen in choices}) > 1:
            for row, chosen in zip(found, choices, strict=True):
                row[group] = chosen[group]
    for name in dict.fromkeys(name for leaves in flat for name in leaves):
        group = name.partition(".")[0]
        told: dict[str, set[str]] = {}
        for leaves, chosen in zip(flat, choices, strict=True):
            told.setdefault(chosen.get(group, ""), set()).add(leaves.get(name, NOTHING))
        if any(len(values) > 1 for values in told.values()):
            for row, leaves in zip(found, flat, strict=True):
                row[name] = leaves.get(name, NOTHING)
    return found


def measured(result: Result, variant: str) -> dict[str, float | None]:
    """The numbers of one row; milliseconds are those of all seats together."""
    numbers = {m: entry(result, variant, m).get("value") for m in METRICS if m != "ms"}
    seats = {name.rpartition("ms.")[2] for name in result["summary"] if "ms." in f".{name}"}
    spent = [entry(result, variant, f"ms.{seat}").get("value") for seat in seats]
    return {**numbers, "ms": sum(v for v in spent if v is not None) if any(v is not None for v in spent) else None}


def jobs(results: Sequence[Result]) -> tuple[list[str], list[tuple[list[str], dict[str, float | None]]]]:
    """Names of the columns of words, and for every job and variant its words and its numbers."""
    told = differing(results)
    names = list(dict.fromkeys(name for row in told for name in row))
    several = "method" not in names and any(len(variants(result)) > 1 for result in results)
    rows = []
    for result, row in zip(results, told, strict=True):
        for variant in variants(result):
            label = {**row, "method": variant} if "method" in row or several else row
            rows.append(([label.get(n, NOTHING) for n in _heads(names, several)], measured(result, variant)))
    return _heads(names, several) or ["job"], rows if _heads(names, several) else _numbered(rows)


def table(results: Sequence[Result]) -> Table | None:
    """One row per job; the best of every column is marked. None for fewer than two results."""
    if len(results) < 2:
        return None
    heads, rows = jobs(results)
    body = [
        [*labels, *(show(numbers[m], m) if m != "ms" else _ms(numbers[m]) for m in METRICS)] for labels, numbers in rows
    ]
    best = set()
    for k, (metric, more) in enumerate(METRICS.items(), start=len(heads)):
        values = {n: v for n, (_, numbers) in enumerate(rows) if (v := numbers[metric]) is not None}
        if len(values) > 1:
            wanted = max(values.values()) if more else min(values.values())
            best |= {(n, k) for n, v in values.items() if v == wanted and len(set(values.values())) > 1}
    named = {"coverage_at_5": "coverage at 5 %", "ms": "ms"}
    title = many(len(results), "job")
    return Table(title, [*heads, *(named.get(m) or head(m) for m in METRICS)], body, len(heads), best=frozenset(best))


def write_csv(path: Path, results: Sequence[Result]) -> Path:
    """The same table with every digit, as comma-separated values: shares from 0 to 1, nothing where nothing is known.

    Raises:
        OSError: the file cannot be written.
    """
    heads, rows = jobs(results)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*heads, *METRICS])
    for labels, numbers in rows:
        writer.writerow([*labels, *("" if numbers[m] is None else repr(numbers[m]) for m in METRICS)])
    return storage.replace_file(path, text.getvalue().encode())


def _heads(names: Sequence[str], several: bool) -> list[str]:
    return [*names, *(["method"] if several else [])]


def _numbered(rows: list[tuple[list[str], dict[str, float | None]]]) -> list[tuple[list[str], dict[str, float | None]]]:
    """Jobs that nothing tells apart."""
    return [([str(k + 1)], numbers) for k, (_, numbers) in enumerate(rows)]


def _ms(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.0f}"


def _choices(result: Result) -> dict[str, str]:
    """Group → name of what was chosen."""
    config = result["config"]
    pairs = config.get("pairs")
    target = str(pairs.get("_target_")) if isinstance(pairs, Mapping) else str(pairs)
    return {
        "method": " ".join(variants(result)),
        "data": str(result["data"]["name"]),
        "pairs": target.rpartition(".")[2].removeprefix("by_"),
        "experiment": str(result["experiment"]),
    }


def _leaves(config: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    for key, value in config.items():
        if str(key).startswith("_") or (not above and key in ALIKE):
            continue
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", "null" if value is None else str(value)
