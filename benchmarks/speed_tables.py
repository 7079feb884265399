"""Tables of the timing scripts' result files, for docs/results/speed.md; see readme.py."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from reproduce import AGAIN

from dhtorch.experiments.report import ReportTable, text

RESULTS = Path(__file__).resolve().parent / "results"

#: File, row, mode and bar of every speed that has one, in words.
BARS = (
    ("frontend", "frontend_224", "eager", 1.3, "front end, 224×224, n = 1024"),
    ("frontend", "frontend_224", "torch.compile", 0.4, "front end, 224×224, n = 1024"),
    ("frontend", "frontend_1440", "eager", 0.08, "front end, 1440×1920"),
    ("lk", "lk_w21_n2048", "eager", 1.3, "search there, n = 2048"),
    ("lk", "lk_w21_n512_b8", "eager", 1.3, "search there, n = 512, B = 8"),
    ("lk", "lk_fb_w21_n2048", "eager", 1.2, "search there and back, n = 2048"),
    ("pnp", "pnp_n500_b16", "eager", 1.0, "pose, 500 points, B = 16"),
    ("pnp", "pnp_n500_b1", "eager", 3.0, "pose, 500 points, B = 1"),
    ("pnp", "pnp_n500_b1", "torch.compile", 1.0, "pose, 500 points, B = 1"),
    ("pnp", "pnp_n500_b1", "compiled", 0.5, "pose, 500 points, B = 1"),
    ("triangulate", "triangulate_100k", "eager", 0.03, "triangulation, 100,000 points"),
    ("pair", "pair_paper_b1", "eager", 1.3, "`paper`, whole pair, B = 1"),
    ("pair", "pair_paper_b8", "eager", 1.0, "`paper`, whole pair, B = 8"),
    ("pair", "pair_map_b1", "eager", 2.0, "`map`, whole pair, B = 1"),
    ("pair", "pair_map_b8", "eager", 1.3, "`map`, whole pair, B = 8"),
    ("pair", "pair_map_b8.per_far_answer", "eager", 0.2, "`map`, a far answer within 5 %, B = 8"),
    ("pair", "every_pixel.per_far_answer", "eager", 0.2, "every pixel, a far answer within 5 %"),
    ("pair", "every_pixel.per_far_answer", "compiled", 0.2, "every pixel, a far answer within 5 %"),
    ("pair", "auto_reference_view", "eager", 0.7, "`auto`, a reference view, beside `WINDOW_1`"),
    ("loader", "loader_single_640x480_workers0", "eager", 1.2, "loader with one view, 640×480, 0 workers"),
    ("loader", "loader_single_640x480_workers0_by_batch", "eager", 1.1, "the same, a batch at once"),
    ("loader", "loader_pair_640x480_workers0", "eager", 1.2, "loader with two views, 640×480, 0 workers"),
    ("loader", "loader_pair_640x480_workers0_by_batch", "eager", 0.9, "the same, a batch at once"),
    ("loader", "loader_scaling_pair_640x480", "eager", 1.05, "loader with two views, what two workers gain"),
    ("loader", "loader_scaling_single_640x480", "eager", 1.05, "loader with one view, what two workers gain"),
    ("frontend", "frontend_224", "compiled", 1.3, "front end, 224×224, n = 1024"),
    ("frontend", "frontend_1440", "compiled", 0.08, "front end, 1440×1920"),
    ("lk", "lk_w21_n2048", "compiled", 0.28, "search there, n = 2048"),
    ("lk", "lk_w21_n512_b8", "compiled", 1.3, "search there, n = 512, B = 8"),
    ("lk", "lk_fb_w21_n2048", "compiled", 0.28, "search there and back, n = 2048"),
    ("pair", "pair_paper_b1", "compiled", 0.36, "`paper`, whole pair, B = 1"),
    ("pair", "pair_paper_b8", "compiled", 0.32, "`paper`, whole pair, B = 8"),
    ("pair", "pair_map_b1", "compiled", 0.5, "`map`, whole pair, B = 1"),
    ("pair", "pair_map_b8", "compiled", 0.4, "`map`, whole pair, B = 8"),
    ("pair", "auto_reference_view", "compiled", 0.4, "`auto`, a reference view, beside `WINDOW_1`"),
    ("loader", "loader_pair_640x480_workers0", "compiled", 0.58, "loader with two views, 640×480, 0 workers"),
    ("loader", "loader_pair_640x480_workers0_by_batch", "compiled", 0.5, "the same, a batch at once"),
    ("loader", "loader_single_640x480_workers0", "compiled", 1.05, "loader with one view, 640×480, 0 workers"),
    ("loader", "loader_single_640x480_workers0_by_batch", "compiled", 1.05, "the same, a batch at once"),
    ("loader", "loader_scaling_pair_640x480", "compiled", 1.0, "loader with two views, what two workers gain"),
    ("loader", "loader_scaling_single_640x480", "compiled", 1.0, "loader with one view, what two workers gain"),
    ("dense_speed", "sweep_640x480", "eager", 1.5, "every pixel, one source view, 640×480"),
    ("dense_speed", "sweep_640x480", "compiled", 0.75, "every pixel, one source view, 640×480"),
    ("start", "start_import", "eager", 0.05, "`import dhtorch` beside `import torch`"),
)

#: Smallest share of a call that the table of parts shows, a ratio. Source: chosen, what rounds to one per cent.
_LEAST_SHARE = 0.005

#: Scripts whose every row is shown.
SCRIPTS = ("frontend", "lk", "pnp", "triangulate", "pair", "loader", "validate_speed", "start")


def timings(file: str) -> list[dict[str, Any]]:
    """Rows of a benchmark's result file; none where it was not made again otherwise."""
    path = RESULTS / f"{file}.json"
    again = file.endswith(tuple(f"_{how}" for how in AGAIN))
    rows: list[dict[str, Any]] = [] if again and not path.is_file() else json.loads(path.read_text())
    return rows


def ratio(value: float) -> str:
    """Two decimals, and two digits where that would say too little."""
    return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"


def errors(row: dict[str, Any]) -> str:
    """Both sides' errors."""
    return " / ".join("–" if row[k] is None else f"{row[k]:.3g}" for k in ("ours_error", "peer_error"))


def on(file: str, shown: str) -> str:
    """A table, and under it the processor that its file was measured on and the commit whose code it was, where the
    file says them."""
    names = {r.get("processor") for r in timings(file)} - {None}
    return f"{shown}\n\nMeasured on: {', '.join(sorted(names))}{code(timings(file))}." if names else shown


def code(rows: list[dict[str, Any]]) -> str:
    """In words, which commit's code was measured."""
    commits = {r.get("git") for r in rows}
    versions = [f"code of {commit}" for commit in sorted(commit for commit in commits if commit)]
    return "; " + " and ".join(versions + ["code of an earlier commit, not noted"] * (None in commits))


def _barred(file: str, name: str, mode: str) -> dict[str, Any] | None:
    """The row of one thread that a bar is about; of several peers the one that it names."""
    matching = [r for r in timings(file) if (r["name"], r["mode"], r["threads"]) == (name, mode, 1)]
    return next((r for r in matching if r["bar"]), matching[0] if matching else None)


def _is_like(row: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether both rows are of one processor, whichever vectors it was restricted to, and one commit's code."""
    processors = [r["processor"].rpartition(",")[0] for r in (row, other)]
    return processors[0] == processors[1] and row.get("git") == other.get("git")


def bars() -> str:
    """Each speed that has a bar, one thread, beside that bar; last its ratio without vectors wider than AVX2's, and
    where freed memory is kept."""
    rows = []
    for file, name, mode, bar, words in BARS:
        r, *again = (_barred(f"{file}{how}", name, mode) for how in ("", *(f"_{how}" for how in AGAIN)))
        called = words if mode == "eager" else f"{words}, {mode}"
        if r is None:
            rows.append([called, "–", "–", "–", f"≤ {bar:g}", "not measured", "–", "–", "–", "–"])
            continue
        cells = [called, f"{r['ours_ms']:.2f}", f"{r['peer_ms']:.2f}"]
        verdict = "met" if r["ratio"] <= bar else "missed"
        maker = f"{r['processor'].partition('(')[0].partition(',')[0]}, {r.get('git') or 'earlier code'}"
        others = ["–" if other is None or not _is_like(other, r) else ratio(other["ratio"]) for other in again]
        rows.append([*cells, ratio(r["ratio"]), f"≤ {bar:g}", verdict, errors(r), maker, *others])
    head = ["", "ours, ms", "peer, ms", "ratio", "bar", "", "errors, ours / peer", "on, code of"]
    head += [{"avx2": "ratio held to AVX2", "kept": "memory kept"}[how] for how in AGAIN]
    return text.table_to_markdown(ReportTable("", head, rows))


def stages() -> str:
    """Milliseconds per pair by stage, one thread, compiled operators."""
    shown = []
    rows = {r["name"]: r for r in timings("pair") if (r["threads"], r["mode"]) == (1, "compiled")}
    for batch in (1, 8):
        for stage in ("", ".track", ".pose", ".triangulate"):
            cells = [f"B = {batch}, {stage[1:] or 'whole pair'}"]
            for method in ("paper", "map"):
                r = rows[f"pair_{method}_b{batch}{stage}"]
                cells += [f"{r['ours_ms']:.1f}", f"{r['ratio']:.2f}"]
            shown.append([*cells, f"{r['peer_ms']:.1f}"])
    head = ["one thread", "`paper`, ms", "ratio", "`map`, ms", "ratio", "`opencv`, ms"]
    return on("pair", text.table_to_markdown(ReportTable("", head, shown)))


def every_row(file: str) -> str:
    """All rows of a script, each thread count apart."""
    rows = []
    for r in timings(file):
        mode = r["mode"] if r.get("warm_up_s") is None else f"{r['mode']} (warm-up {r['warm_up_s']:.0f} s)"
        cells = [f"`{r['name']}`", mode, str(r["threads"]), f"{r['ours_ms']:.2f}", f"{r['ours_iqr']:.2f}"]
        rows.append([*cells, r["peer"], f"{r['peer_ms']:.2f}", ratio(r["ratio"]), errors(r)])
    head = ["row", "mode", "threads", "ours, ms", "iqr", "peer", "peer, ms", "ratio", "errors, ours / peer"]
    return on(file, text.table_to_markdown(ReportTable("", head, rows, n_label=2)))


def scaling() -> str:
    """Growth exponents, and the memory of the largest size."""
    rows = []
    for r in timings("scaling"):
        if r["bar"]:
            name = r["name"].removeprefix("scaling.")
            grows = ["–" if r.get(k) is None else f"{r[k]:.2f}" for k in ("time_exponent", "memory_exponent")]
            cells = [str(r["n"]), f"{r['ours_ms']:.1f}", "–" if r["peak_mib"] is None else f"{r['peak_mib']:.0f}"]
            rows.append([f"`{name}`", *grows, *cells])
    head = ["what doubles", "time ^", "memory ^", "largest size", "ms there", "MiB above the inputs there"]
    return on("scaling", text.table_to_markdown(ReportTable("", head, rows)))


def waterfall() -> str:
    """Milliseconds of the parts of whole calls and their shares of the call; parts of less than half a per cent are
    left out."""
    shares: dict[str, dict[str, dict[str, Any]]] = {}
    for r in timings("waterfall"):
        call, part = r["name"].split(".", 1)
        shares.setdefault(call, {})[part] = r
    parts = list(dict.fromkeys(part for by_part in shares.values() for part in by_part))
    parts.sort(key=lambda part: -sum(by_part[part]["ratio"] for by_part in shares.values() if part in by_part))
    rows = []
    for part in parts:
        cells = [by_part.get(part, {"ratio": 0.0}) for by_part in shares.values()]
        shown = [f"{r['ours_ms']:,.1f} ({r['ratio']:.0%})" if r["ratio"] >= _LEAST_SHARE else "–" for r in cells]
        if set(shown) != {"–"}:
            rows.append([part, *shown])
    rows.append(["whole call", *(f"{next(iter(by_part.values()))['peer_ms']:,.1f}" for by_part in shares.values())])
    head = ["ms (share)", *(f"`{call}`" for call in shares)]
    return on("waterfall", text.table_to_markdown(ReportTable("", head, rows)))


def memory() -> str:
    """How far a long stream's memory rises above that of its first frames."""
    rows = [
        [f"{r['frames']:,}", f"{r['first_mib']:.0f}", str(r["first"]), f"{r['above_mib']:.1f}", "≤ 50"]
        for r in timings("memory")
    ]
    head = ["frames", "peak, MiB", "after", "then, MiB more", "bar"]
    return on("memory", text.table_to_markdown(ReportTable("", head, rows)))


def accelerator() -> str:
    """Calls on an accelerator: at once, as recorded graphs, on the CPU and, where it has them, by kornia."""
    by_name: dict[tuple[str, str], dict[str, Any]] = {(r["name"], r["mode"]): r for r in timings("gpu")}
    rows = []
    for (name, mode), r in by_name.items():
        if mode != "eager" or r["peer"] == "kornia":
            continue
        graph, kornia = by_name.get((name, "graph")), by_name.get((f"{name}.kornia", "eager"))
        others = [
            "–" if other is None else f"{other[key]:.3g}" for other, key in ((graph, "ours_ms"), (kornia, "peer_ms"))
        ]
        least = min(r["ours_ms"], r["ours_ms"] if graph is None else graph["ours_ms"])
        is_compared = bool(r.get("change_sigma"))  # 0 where the CPU answers nothing
        flips = [f"{r[k]:.2g}" if is_compared else "–" for k in ("gate_flips", "change_sigma")]
        cells = [f"`{name.removeprefix('gpu_').rpartition('_b')[0]}`", str(r["batch"]), f"{r['ours_ms']:.3g}", *others]
        cells += [f"{r['peer_ms']:.3g}", f"{1e3 / least:,.0f}", f"{r['peak_mib']:.0f}", str(r["waits"])]
        rows.append([*cells, errors(r), " / ".join(flips)])
    head = ["call", "at once", "ms", "replayed, ms", "kornia, ms", "CPU, ms", "a second, at best", "peak, MiB", "waits"]
    head += ["errors, device / CPU", "other gates / change in sigmas"]
    cards = sorted({f"{r['card']}, torch {r['torch']}" for r in timings("gpu")})
    return f"{text.table_to_markdown(ReportTable('', head, rows))}\n\nDevice: {'; '.join(cards)}. CPU beside it: " + (
        f"{timings('gpu')[0]['processor']}, {timings('gpu')[0]['threads']} threads{code(timings('gpu'))}."
    )


#: Tables by marker.
TABLES: dict[str, Callable[[], str]] = {"bars": bars, "scaling": scaling, "memory": memory, "accelerator": accelerator}
TABLES["waterfall"] = waterfall
TABLES |= {f"rows {file}": partial(every_row, file) for file in SCRIPTS}
