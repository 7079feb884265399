"""What the tables of readme.py share: the result files, how numbers stand in cells, and Markdown."""

import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from dhtorch.experiments.report import ReportTable, text

RESULTS = Path(__file__).resolve().parent / "results"

#: Files with the rows of several scripts → these results; a result with a file of its own stands there instead.
COLLECTIONS = {
    "speeds": (
        *(
            "frontend",
            "lk",
            "pnp",
            "triangulate",
            "pair",
            "loader",
            "loader_workers0",
            "stream",
            "dense_speed",
            "start",
        ),
        *("validate_speed", "scaling", "waterfall", "memory"),
        *(f"{name}_avx2" for name in ("frontend", "lk", "pnp", "pair", "loader", "dense_speed")),
    ),
    "programs": ("clients", "lerobot_train", "lerobot_plugin", "readers_3d", "tiny_field"),
    "recorded": ("captures", "phone", "validate_real", "gravity", "given_poses", "rigs"),
    "faults": ("fuzz", "kills", "front_door", "capture_faults", "mutants"),
    "trained": ("self_calibration", "far_labels", "learned_confidence", "closed_loop"),
}

#: Names of the results that were read since this was cleared.
names_read: set[str] = set()


def read(name: str) -> Any:
    """Content of a result, which must not be changed: many tables are of the same."""
    names_read.add(name)
    path = RESULTS / f"{name}.json"
    return load(path) if path.is_file() else load(RESULTS / f"{collection_of(name)}.json")[name]


def collection_of(name: str) -> str:
    """The collection that holds a result; the result's own name where none does."""
    return next((file for file, names in COLLECTIONS.items() if name in names), name)


@cache
def load(path: Path) -> Any:
    """Content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_collection(path: Path, results: dict[str, list[Any]]) -> None:
    """Write a collection, a line for every row."""
    parts = []
    for name, rows in sorted(results.items()):
        lines = (json.dumps(row, ensure_ascii=False, separators=(",", ":")) for row in rows)
        parts.append(f'"{name}": [\n' + ",\n".join(lines) + "\n]")
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def percent(value: float | None, decimals: int = 1) -> str:
    """A fraction as text."""
    return "–" if value is None else f"{100 * value:.{decimals}f} %"


def percents(values: Iterable[float | None]) -> str:
    """Several fractions as text, with one unit."""
    return f"{' / '.join(percent(value).removesuffix(' %') for value in values)} %"


def number(value: float | None, decimals: int = 2) -> str:
    """So many decimals."""
    return "–" if value is None else f"{value:.{decimals}f}"


def table(head: list[str], rows: list[list[str]], n_label: int = 1) -> str:
    """A Markdown table, words left and numbers right."""
    return text.table_to_markdown(ReportTable("", head, rows, n_label))


def table_of_bars(bars: dict[str, tuple[str, str]], columns: dict[str, Any], first: str = "number") -> str:
    """A row for each number, in words, with its value in every column (heading → value of a name) and its bar."""
    rows = []
    for name, (words, bar) in bars.items():
        values = [value_of(name) for value_of in columns.values()]
        rows.append([words, *("" if value is None else f"{value:.3f}" for value in values), bar])
    return table([first, *columns, "bar"], rows)


def summary_value(name: str, prefix: str = "") -> Any:
    """The values of a result's summary by name, None where it has none."""
    summary = read(name)["summary"]
    return lambda key: summary.get(f"{prefix}{key}", {}).get("value")
