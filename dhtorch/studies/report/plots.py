"""All figures of a result, drawn from nothing but its rows and summary; those that compare stand here."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dhtorch.codes import Hole, names, words
from dhtorch.studies.report import curves, published, sweeps
from dhtorch.studies.report.cells import show
from dhtorch.studies.report.figure import PUBLISHED, Figure, axis_of, deciding, named, series, share
from dhtorch.studies.report.layouts import counterparts
from dhtorch.studies.report.overlays import overlays
from dhtorch.studies.report.reading import Result, Row, entry, scene_rows, variants
from dhtorch.studies.report.svg import Panel, spanning
from dhtorch.studies.report.timings import branch, is_whole

#: Height of a named row, and of what lies around them.
ROW, AROUND = 19, 66


def figures(result: Result) -> list[Figure]:
    """All figures that a result has the numbers for."""
    makers: tuple[Callable[[Result], Figure | None], ...] = (
        latency,
        side_by_side,
        sweeps.cutoffs,
        sweeps.motion,
        sweeps.threshold,
        holes,
        curves.risk,
        curves.error_by_distance,
        curves.coverage_by_distance,
        curves.reliability,
    )
    found = [figure for make in makers if (figure := make(result))]
    return [*found, *overlays(result)]


def side_by_side(result: Result) -> Figure | None:
    """Medians over scenes with their intervals, variants below one another."""
    rows = variants(result)
    if len(rows) < 2:
        return None
    theirs, panels = counterparts(result), []
    for metric, label in (("coverage", "coverage, %"), ("median_rel", "median error, %"), ("corr", "correlation")):
        entries = {v: entry(result, v, metric) for v in rows}
        ours = [e.get(k) for e in entries.values() for k in ("value", "low", "high")]
        if not any(v is not None for v in ours):
            continue
        cited = {v: number for v in rows if (number := theirs.get(v, {}).get(metric)) is not None}
        axis = axis_of(metric, [*ours, *cited.values()])
        panel = Panel(label, axis, None, size=(400, AROUND + ROW * len(rows)), rows=rows)
        for k, (v, e) in enumerate(entries.items()):
            if e.get("low") is not None:
                panel.line([e["low"], e["high"]], [k, k], series(result, v))
            if e.get("value") is not None:
                panel.dot(e["value"], k, series(result, v), f"{v}: {show(e['value'], metric)}")
            if v in cited:
                panel.diamond(cited[v], k, f"published: {show(cited[v], metric)}")
        panels.append(panel.render())
    caption = "Dots: median over scenes; lines: 95 % interval of a bootstrap over scenes."
    drawn = [PUBLISHED] if any(theirs.values()) else []
    return Figure("Variants side by side", caption, panels, drawn, wide=True) if panels else None


def latency(result: Result) -> Figure | None:
    """Milliseconds on a logarithmic axis."""
    rows = [(branch(row), row) for row in scene_rows(result) if row.get("p50_ms")]
    if not rows:
        return None
    cited = {
        f"published: {name}": number
        for name, cells in published.LATENCY.lines.items()
        if (number := published.number(cells["p50_ms"]))
    }
    labels = [*(name for name, _ in rows), *cited]
    times = [t for _, row in rows for t in (row["p50_ms"], _slow(row))]
    x = spanning([*times, *cited.values()], "milliseconds (logarithmic)", log=True)
    panel = Panel("", x, None, size=(720, AROUND + ROW * len(labels)), rows=labels)
    for k, (name, row) in enumerate(rows):
        style = "s1" if row.get("stage") == "forward" else "s0" if is_whole(row) else "s7"
        panel.line([row["p50_ms"], _slow(row)], [k, k], style)
        panel.dot(row["p50_ms"], k, style, f"{name}: {show(row['p50_ms'])} ms")
    for k, (name, number) in enumerate(cited.items()):
        panel.diamond(number, len(rows) + k, f"{name}: {number:g} ms")
    caption = "Dots: p50; lines reach to p99, or to p95 where there were too few calls."
    drawn = [("dot s0", "front end and pair"), ("dot s7", "single stages"), ("dot s1", "visual branch"), PUBLISHED]
    return Figure("Latency", caption, [panel.render()], drawn, wide=True)


def holes(result: Result) -> Figure | None:
    """Classes of holes by scene, as stacked bars."""
    if result["experiment"] != "hole_census":
        return None
    first = next(iter(variants(result)), None)
    bars: dict[str, Mapping[str, float | None]] = {
        named(row): row["hole_share"]
        for row in deciding(result)
        if row["method"] == first and any((row.get("hole_share") or {}).values())
    }
    if not bars:
        return None
    for name, cells in published.CENSUS.lines.items():
        number = published.number(cells["hole_share.trackable_no_lidar"])
        bars[f"published: {name}"] = {"trackable_no_lidar": number}
    classes = {name.lower(): code for code, name in names(Hole).items() if code}
    panel = Panel("", share("share of the holes, %"), None, size=(720, AROUND + ROW * len(bars)), rows=list(bars))
    for k, shares in enumerate(bars.values()):
        at = 0.0
        for name, code in classes.items():
            part = shares.get(name) or 0.0
            if part > 0:
                panel.bar(at, at + part, k + 0.32, k - 0.32, f"hole{code}")
            at += part
    drawn = [(f"box hole{code}", words(name)) for name, code in classes.items()]
    caption = "Holes of the sensor by class; of the published captures only the key class is known."
    return Figure("Why returns are missing", caption, [panel.render()], drawn, wide=True)


def _slow(row: Row) -> float | None:
    found: float | None = row.get("p99_ms") or row.get("p95_ms")
    return found
