"""The tables of docs/kornia.md, from ``results/kornia.json``; see readme.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from speed_tables import ratio

from dhtorch.experiments.report import ReportTable, text

RESULTS = Path(__file__).resolve().parent / "results"


def rows() -> list[dict[str, Any]]:
    """Rows of the result file."""
    loaded: list[dict[str, Any]] = json.loads((RESULTS / "kornia.json").read_text())
    return loaded


def functions() -> str:
    """One row for every pair of functions, those that are kornia's first."""
    shown = []
    compared = [r for r in rows() if r["name"] != "answers"]
    for r in sorted(compared, key=lambda r: r["used"] != "kornia"):
        size = r["note"] or (f"B = {r['batch']}" if r["n"] == 1 else f"B = {r['batch']}, N = {r['n']}")
        cells = [
            f"`{r['name'].split(' ')[0]}`{r['name'][len(r['name'].split(' ')[0]) :]}",
            f"`{r['kornia']}`",
            r["used"],
        ]
        cells += [size, f"{1e3 * r['ours_ms']:.0f}", ratio(r["ratio"]), f"{r['largest']:.1g}", f"{r['median_rel']:.1g}"]
        shown.append([*cells, lacks(r), r["why"]])
    head = ["ours", "kornia's", "used", "size", "ours, µs", "ratio", "largest", "median", "kornia's lacks", "why"]
    return f"{text.table_to_markdown(ReportTable('', head, shown, n_label=3))}\n\n{measured(compared)}"


def lacks(r: dict[str, Any]) -> str:
    """What ours keeps and kornia's does not."""
    words = {"steady": "bits", "captures": "one graph", "gradient": "gradient", "hard": "gradient at 0"}
    missing = [word for key, word in words.items() if r[f"kornia_{key}"] is False and r[f"ours_{key}"] is not False]
    return ", ".join(missing) or "–"


def measured(compared: list[dict[str, Any]]) -> str:
    """Where the file was made."""
    first = compared[0]
    versions = ", ".join(f"{name} {value}" for name, value in first["versions"].items())
    threads = "one thread" if first["threads"] == 1 else f"{first['threads']} threads"
    clock = {"wall": "", "cpu": "; time given to the process, on a machine that did other things too"}[first["clock"]]
    return f"Measured on: {first['processor']}; {threads}; {versions}{clock}."


def answers() -> str:
    """What both methods said of real pairs before and after."""
    answers = [r for r in rows() if r["name"] == "answers"]
    shown = []
    for r in answers:
        cells = [f"{r['scene']}, `{r['method']}`", str(r["pairs"]), str(r["answered"])]
        shown.append([*cells, f"{r['median_rel']:.1g}", f"{r['largest_rel']:.1g}", f"{100 * r['flipped']:.2g} %"])
    head = ["scene, method", "pairs", "answers", "median difference of depth", "largest", "gates flipped"]
    return text.table_to_markdown(ReportTable("", head, shown))


#: Tables of docs/kornia.md.
TABLES = {"kornia functions": functions, "kornia answers": answers}
