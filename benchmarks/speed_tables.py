"""Tables of the timing scripts' result files, for docs/results/speed.md; see readme.py."""

from collections.abc import Callable
from typing import Any

from cells import COLLECTIONS, read, table
from reproduce import AGAIN

#: File, row, bar (None where none was set) and words of the table of speeds: compiled where there is an operator.
BARS = (
    ("frontend", "frontend_224", 1.3, "front end, 224×224, n = 1024"),
    ("frontend", "frontend_1440", 0.08, "front end, 1440×1920"),
    ("lk", "lk_w21_n2048", 0.28, "search there, n = 2048"),
    ("lk", "lk_w21_n512_b8", 1.3, "search there, n = 512, B = 8"),
    ("lk", "lk_fb_w21_n2048", 0.28, "search there and back, n = 2048"),
    ("pnp", "pnp_n500_b1", 0.5, "pose, 500 points, B = 1"),
    ("pnp", "pnp_n500_b16", 1.0, "pose, 500 points, B = 16"),
    ("triangulate", "triangulate_100k", 0.03, "triangulation, 100,000 points"),
    ("pair", "pair_paper_b1", 0.36, "`paper`, whole pair, B = 1"),
    ("pair", "pair_paper_b8", 0.32, "`paper`, whole pair, B = 8"),
    ("pair", "pair_map_b1", 0.5, "`map`, whole pair, B = 1"),
    ("pair", "pair_map_b8", 0.4, "`map`, whole pair, B = 8"),
    ("pair", "auto_reference_view", 0.4, "`auto`, a reference view, beside five views of release 1"),
    ("dense_speed", "sweep_640x480", 0.75, "every pixel, one source view, 640×480"),
    ("pair", "every_pixel.per_far_answer", 0.2, "every pixel, a far answer within 5 %"),
    ("loader", "loader_pair_640x480_workers0", 0.58, "loader with two views, 640×480, 0 workers"),
    ("loader", "loader_pair_640x480_workers0_by_batch", 0.5, "the same, a batch at once"),
    ("loader", "loader_single_640x480_workers0", 1.05, "loader with one view, 640×480, 0 workers"),
    ("loader", "loader_single_640x480_workers0_by_batch", 1.05, "the same, a batch at once"),
    ("loader", "loader_scaling_pair_640x480", 1.0, "two views, what two workers gain"),
    ("loader", "loader_scaling_single_640x480", 1.0, "one view, what two workers gain"),
    ("validate_speed", "validate_sparse", None, "validation by sparse evidence"),
    ("validate_speed", "validate_views", None, "validation with the images of another view"),
    ("start", "start_import", 0.05, "`import dhtorch` beside `import torch`"),
)

#: Smallest share of a call that the table of parts shows, a ratio. Source: chosen, what rounds to one per cent.
_LEAST_SHARE = 0.005

#: Scripts whose every row is shown.
SCRIPTS = ("frontend", "lk", "pnp", "triangulate", "pair", "loader", "validate_speed", "start")


def timings(file: str) -> list[dict[str, Any]]:
    """Rows of a benchmark's result file; none where it was not made again otherwise."""
    again = file.endswith(tuple(f"_{how}" for how in AGAIN))
    return [] if again and file not in COLLECTIONS["speeds"] else list(read(file))


def ratio(value: float) -> str:
    """Two decimals, and two digits where that would say too little."""
    return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"


def errors(row: dict[str, Any]) -> str:
    """Both sides' errors; a dash where neither has one."""
    both = ["–" if row[k] is None else f"{row[k]:.3g}" for k in ("ours_error", "peer_error")]
    return "–" if both == ["–", "–"] else " / ".join(both)


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


def bars() -> str:
    """Speeds of one thread beside their bars: compiled where there is an operator, then in torch, and held to AVX2."""
    rows = []
    for file, name, bar, words in BARS:
        modes = {mode: _barred(file, name, mode) for mode in ("compiled", "eager")}
        r = modes["compiled"] or modes["eager"]
        assert r is not None, (file, name)
        held = _barred(f"{file}_avx2", name, r["mode"])
        cells = [words, f"{r['ours_ms']:.2f}", r["peer"].replace("_", " "), f"{r['peer_ms']:.2f}", ratio(r["ratio"])]
        cells.append("–" if bar is None else f"≤ {bar:g}" + ", missed" * (r["ratio"] > bar))
        in_torch = modes["eager"] if modes["compiled"] else None
        cells += ["–" if other is None else ratio(other["ratio"]) for other in (in_torch, held)]
        rows.append([*cells, errors(r), f"{r['processor'].partition('(')[0].partition(',')[0]}, {r.get('git') or '–'}"])
    head = [
        "",
        "ours, ms",
        "peer",
        "peer, ms",
        "ratio",
        "bar",
        "in torch",
        "held to AVX2",
        "errors, ours / peer",
        "on, code of",
    ]
    return table(head, rows)


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
    return on("scaling", table(head, rows))


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
    return on("waterfall", table(head, rows))


def memory() -> str:
    """How far a long stream's memory rises above that of its first frames."""
    rows = [
        [f"{r['frames']:,}", f"{r['first_mib']:.0f}", str(r["first"]), f"{r['above_mib']:.1f}", "≤ 50"]
        for r in timings("memory")
    ]
    head = ["frames", "peak, MiB", "after", "then, MiB more", "bar"]
    return on("memory", table(head, rows))


def accelerator() -> str:
    """Calls on an accelerator: at once, as recorded graphs, on the CPU and, where it has them, by kornia."""
    by_name: dict[tuple[str, str], dict[str, Any]] = {(r["name"], r["mode"]): r for r in timings("gpu")}
    rows = []
    for (name, mode), r in by_name.items():
        if mode != "eager" or r["peer"] == "kornia" or r["batch"] not in (1, 64) or "kornia" in name:
            continue
        graph, kornia = by_name.get((name, "graph")), by_name.get((f"{name}.kornia", "eager"))
        others = [
            "–" if other is None else f"{other[key]:.3g}" for other, key in ((graph, "ours_ms"), (kornia, "peer_ms"))
        ]
        least = min(r["ours_ms"], r["ours_ms"] if graph is None else graph["ours_ms"])
        is_compared = bool(r.get("change_sigma"))  # 0 where the CPU answers nothing
        flips = [f"{r[k]:.2g}" for k in ("gate_flips", "change_sigma")] if is_compared else ["–"]
        cells = [f"`{name.removeprefix('gpu_').rpartition('_b')[0]}`", str(r["batch"]), f"{r['ours_ms']:.3g}", *others]
        cells += [f"{r['peer_ms']:.3g}", f"{1e3 / least:,.0f}", f"{r['peak_mib']:.0f}", str(r["waits"])]
        rows.append([*cells, errors(r), " / ".join(flips)])
    head = ["call", "at once", "ms", "replayed, ms", "kornia, ms", "CPU, ms", "a second, at best", "peak, MiB", "waits"]
    head += ["errors, device / CPU", "other gates / change in sigmas"]
    cards = sorted({f"{r['card']}, torch {r['torch']}" for r in timings("gpu")})
    return f"{table(head, rows)}\n\nDevice: {'; '.join(cards)}. CPU beside it: " + (
        f"{timings('gpu')[0]['processor']}, {timings('gpu')[0]['threads']} threads{code(timings('gpu'))}."
    )


#: Tables by marker.
TABLES: dict[str, Callable[[], str]] = {"bars": bars, "scaling": scaling, "memory": memory, "accelerator": accelerator}
TABLES["waterfall"] = waterfall
