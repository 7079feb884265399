"""README, and every page of docs/ that shows a figure or the code's own words: written from results and from the code.

python benchmarks/readme.py            rewrite what stands between markers
python benchmarks/readme.py --check    exit 1 if a page does not say what result files and code say

``<!-- name -->`` up to ``<!-- end -->`` holds a table of ``TABLES``, ``<!-- results name -->`` those of a result file
in the paper's layout, ``<!-- make: name argument -->`` what a function
of docs/hooks.py says. The pages are committed whole. Pictures: docs/pictures.py.
"""

import argparse
import re
import statistics
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import beside_kornia
import client_tables
import fidelity
import kornia_adapters
import learning_tables
import mutants
import pose_tables
import reader_tables
import reproduce
import speed_tables
from cells import RESULTS, load, names_read, number, percent, percents, read, summary_value, table, table_of_bars

from dhtorch.experiments.compare import method_comparison
from dhtorch.experiments.report import layouts, text
from dhtorch.runtime import results as result_files

HERE = Path(__file__).resolve().parent
README = HERE.parent / "README.md"

#: The beginning of a part that is written, and the whole of it.
MARKER = re.compile(r"^<!-- (?!end -->)([^>]*?) -->$", re.M)
BLOCK = re.compile(r"^<!-- (?!end -->)([^>]*?) -->\n.*?^<!-- end -->$", re.M | re.S)


#: Methods that are compared with the paper's.
COMPARED = ("map", "auto_2", "auto")


def heading(method: str, result: str) -> str:
    """Heading of a method's column: ``map`` without the test of misaligned depth is that of release 1."""
    if method == "auto_2":
        return "`auto` of release 2"
    options = read(result)["config"]["experiment"]["methods"].get(method)
    return "`map` of release 1" if method == "map" and options and not options.get("verify") else f"`{method}`"


def scenes(name: str, truth: str) -> dict[str, dict[str, dict[str, Any]]]:
    """Scene → method → row of a result file, for one truth test."""
    by_scene: dict[str, dict[str, dict[str, Any]]] = {}
    for row in read(name)["rows"]:
        if row["pair"] is None and row["truth"] == truth:
            by_scene.setdefault(row["scene"], {})[row["method"]] = row
    return by_scene


def twin() -> str:
    """The paper's method and its implementation on kornia, in one sentence."""
    summary = read("kornia_twin")["summary"]
    coverage, error = (number(summary[f"kornia.{k}_ratio_to_paper"]["value"]) for k in ("coverage", "error"))
    times = [
        sum(methods["kornia"]["ms"].values()) / sum(methods["paper"]["ms"].values())
        for methods in scenes("kornia_twin", "full").values()
    ]
    return (
        f"`kornia` has {coverage} times the coverage of `paper` at {error} of its median error (geometric means over "
        f"{len(times)} scenes) and takes {min(times):.0f} to {max(times):.0f} times as long."
    )


def chained() -> str:
    """What tracks through the frames between two views change, in one sentence."""
    summary = read("track_chain")["summary"]

    def ratios(ours: str, other: str) -> str:
        values = [number(summary[f"{ours}.{k}_ratio_to_{other}"]["value"]) for k in ("coverage", "error")]
        return f"{values[0]} times the coverage of `{other}` at {values[1]} of its median error"

    return (
        f"On pairs of six shared scenes with frames between, `paper` has {ratios('paper', 'paper_direct')}, and `map` "
        f"with its tracker in such a chain {ratios('map_chain', 'map')} (geometric means over scenes; `map` itself "
        "has no chain)."
    )


def comparison() -> str:
    """The numbers that decide the method comparison, each beside its bar."""
    bars = {}
    for name, (one, many, _) in method_comparison.METHOD_BARS.items():
        bars[name] = NUMBER[name], f"{BOUND[name]} {one:g}" + f" / {many:g}" * (one != many)
    return table_of_bars(
        bars, {heading(m, "method_comparison"): summary_value("method_comparison", f"{m}.") for m in COMPARED}
    )


def chosen_views(*results: str) -> str:
    """``auto`` and that of the second release in each of some comparisons, beside its bars."""
    summaries = [read(name)["summary"] for name in results]
    rows = []
    for name, (words, bar) in GAINS.items():
        cells = ["" if (e := s.get(f"auto.{name}")) is None else f"{e['value']:.3f}" for s in summaries]
        frozen = [s.get(f"auto_2.{name}") for s in summaries]
        before = " / ".join("–" if e is None or e["value"] is None else f"{e['value']:.3f}" for e in frozen)
        rows.append([words, before, *cells, bar])
    return table(["number", "`auto` of release 2", *(f"`auto`, {name}" for name in results), "bar"], rows)


def beside_chosen() -> str:
    """View selection where nothing can be answered, and its cost."""
    comparison, stress = (read(name)["summary"] for name in ("method_comparison", "stress"))
    timed = {r["name"]: r["ratio"] for r in read("stream") if r["threads"] == 1}
    turned, wrong = comparison["auto.rotation_answered"]["value"], stress["auto.convoy_wrong"]["value"]
    rows = [
        ["coverage of samples without a return where the camera only rotates", percent(turned), "≤ 0.5 %"],
        ["answers off by more than 20 % where near objects move, worst room", percent(wrong), "≤ 1 %"],
        [
            "time of a whole reference view, ratio to `map` with five given views",
            number(timed["auto_reference_view"]),
            "≤ 1.0",
        ],
        ["time of `Stream.push`, ratio to OpenCV's stages on the same views", number(timed["stream_push"]), "≤ 1.2"],
    ]
    return table(["number", "`auto`", "bar"], rows)


def every_pixel() -> str:
    """The numbers that decide the dense comparison, in each of two results, beside their bars; and what it costs."""
    columns = {"`dense`, shared scenes": summary_value("dense"), "`dense`, streams": summary_value("dense_streams")}
    rows = [table_of_bars(PIXELS, columns)]
    for row in read("dense_speed"):
        if row["threads"] == 1:
            size = row["name"].removeprefix("sweep_").replace("x", "×")
            how = "" if row["mode"] == "eager" else ", compiled code"
            words = f"time of a sweep{how}, {size}, ratio to rectification + SGBM"
            rows.append(f"| {words} | {number(row['ratio'])} |  | ≤ 1.5 |")
    return "\n".join(rows)


def pixels_by_scene(comparison: str) -> str:
    """What the dense map of every scene answers, how well, and how its peers do under the same motion."""
    rows = []
    for scene, methods in scenes(comparison, "full").items():
        record = methods["dense"]
        if record["role"] or not record.get("n_candidates"):
            continue
        own = record["dense"]
        cells = [scene, percent(record["coverage"]), percent(record["median_rel"]), percent(record["wrong_share"])]
        cells += [number(own.get("ause_ratio")), number(own.get("error_ratio_to_sparse"))]
        peers = (own.get(f"error_ratio_to_{peer}") for peer in ("sgbm", "dis_flow", "bilateral"))
        rows.append([*cells, " / ".join("–" if ratio is None else number(ratio) for ratio in peers)])
    head = ["scene", "coverage", "median error", "off by more than 20 %", "AUSE", "error to sparse"]
    return table([*head, "to SGBM / DIS / bilateral"], rows)


def by_scene(comparison: str) -> str:
    """Coverage and median error of every method on every scene of a comparison, and the ratio at equal coverage."""
    rows = []
    for scene, methods in scenes(comparison, "full").items():
        name = f"{scene} ({methods['paper']['role']})" if methods["paper"]["role"] else scene
        cells = [name, str(methods["paper"]["n_candidates"])]
        shown = [m for m in ("paper", "opencv", *COMPARED) if m in methods]
        for key in ("coverage", "median_rel"):
            cells.append(percents(methods[m].get(key) for m in shown))
        ratios = [
            methods[m].get("against_paper", {}).get("median_rel_ratio_at_equal_coverage")
            for m in COMPARED
            if m in methods
        ]
        rows.append([*cells, " / ".join(map(number, ratios))])
    several, compared = (
        " / ".join(heading(m, comparison) for m in group if m in methods) for group in (shown, COMPARED)
    )
    heads = ["scene", "candidates", f"coverage, {several}", "median error", f"ratio at equal coverage, {compared}"]
    return table(heads, rows)


def archived_answers() -> dict[str, dict[str, Any]]:
    """Result files with a verdict: name → result."""
    results = {path.stem: load(path) for path in sorted(RESULTS.glob("*.json"))}
    return {name: result for name, result in results.items() if isinstance(result, dict) and result.get("verdict")}


def with_others(names: Sequence[str]) -> list[dict[str, Any]]:
    """Results of some names, each followed by all others of its experiment: no answer is quoted without the others."""
    answers = archived_answers()
    wanted = [
        other
        for name in names
        for other in (name, *(k for k in answers if answers[k]["experiment"] == answers[name]["experiment"]))
    ]
    names_read.update(wanted)
    return [answers[name] for name in dict.fromkeys(wanted)]


def with_verdicts(make: Callable[[], str], *names: str) -> str:
    """A table of bars, with the verdicts of its experiments on all data below it: met bars and missed ones."""
    lines = [f"- {r['verdict']} on {r['data']['name']}: {r['why']}" for r in with_others(names)]
    return "\n".join([make(), "", "Verdicts of this experiment, on every set of data that is archived:", "", *lines])


def verdicts(names: Sequence[str]) -> str:
    """Archived questions, their answers and why, with those of the same experiment on other data."""
    rows = []
    for result in with_others(names):
        n_scenes, n_pairs = len(result["data"]["scenes"]), result["data"].get("n_pairs") or 0
        count = f"{n_scenes} / {n_pairs}" if n_scenes > 1 else f"**1** / {n_pairs}"
        question = f"`{result['experiment']}` on {result['data']['name']}"
        rows.append([question, count, result["verdict"], result["why"]])
    return table(["experiment", "scenes / pairs", "verdict", "why"], rows, n_label=4)


#: What a policy of the closed loop has beside the picture, in words.
CLOSED_LOOP = {
    "rgb": "nothing",
    "sensor": "sensor's returns",
    "far": "and depth recovered by `map`",
    "true": "true depth (positive control)",
}


def closed_loop() -> str:
    """Success rates of the policies in simulation."""
    (result,) = read("closed_loop")
    rows = []
    for name, words in CLOSED_LOOP.items():
        rate = result["rates"][name]
        seeds = ", ".join(percent(x) for x in rate["by_seed"])
        interval = f"{percent(rate['success']['low'])} to {percent(rate['success']['high'])}"
        outcomes = (percent(rate["wrong_ball"]), percent(rate["neither"]))
        rows.append([f"`{name}`: {words}", percent(rate["success"]["value"]), interval, seeds, *outcomes])
    heads = ["depth tokens", "reached", "95 % interval", "each network", "other ball", "neither"]
    return table(heads, rows)


def closed_loop_differences() -> str:
    """Paired differences of the success rates, in points, over the test episodes."""
    (result,) = read("closed_loop")
    rows = [
        [f"`{name}`", *(f"{100 * e[key]:+.0f}" for key in ("value", "low", "high"))]
        for name, e in result["differences"].items()
    ]
    return table(["difference", "points", "from", "to"], rows)


def row_of(name: str, scene: str, method: str) -> dict[str, Any]:
    """One scene's row of a comparison."""
    return scenes(name, "full")[scene][method]


def how_good() -> str:
    """Coverage, errors and time of the methods on the shared scenes."""
    sparse = read("method_comparison")["summary"]
    pixels = read("dense")["summary"]
    rows = []
    for key, words in GOOD.items():
        cells = [percent(sparse.get(f"{m}.{key}", {}).get("value")) for m in README_METHODS]
        rows.append([words, *cells, percent(pixels.get(f"dense.{DENSE_KEY.get(key, key)}", {}).get("value"))])
    turned = [percent(row_of("method_comparison", TURNED, m)["coverage"]) for m in README_METHODS]
    rows.append(["coverage where the camera only turns", *turned, percent(pixels["dense.rotation_answered"]["value"])])
    timed = [(timing(file, name), side) for file, name, side in TIMED]
    where = " and ".join(sorted({r["processor"] for r, _ in timed}))
    rows.append([f"ms a reference view of 640×480, one thread ({where})", *(f"{r[s]:,.0f}" for r, s in timed)])
    rows[-1][-1] = "as `fused`"
    return table(
        ["median over eleven scenes", *(heading(m, "method_comparison") for m in (*README_METHODS, "dense"))], rows
    )


def untouched() -> str:
    """README's one table: coverage and errors on scenes that no constant was chosen on, beside peers."""
    samples, maps = (read(name) for name in ("untouched", "untouched_dense"))
    scenes = {row["scene"] for row in samples["rows"]}  # the other file has stress rooms as well
    maps["rows"] = [row for row in maps["rows"] if row["scene"] in scenes]
    columns = [(samples, m, heading(m, "untouched")) for m in UNTOUCHED_METHODS]
    columns += [(maps, m, words) for m, words in UNTOUCHED_MAPS.items()]
    rows = []
    for label, is_room in (("real", False), ("rooms", True)):
        for key in UNTOUCHED_KEYS:
            cells = [percent(_median_over_scenes(result, method, key, is_room)) for result, method, _ in columns]
            rows.append([f"{label}: {GOOD[key]}", *cells])
    n = [len(_scenes_of(samples, UNTOUCHED_METHODS[0], is_room)) for is_room in (False, True)]
    about = f"medians over {n[0]} real scenes, {len(STUDIO_PAIRS)} of them studio pairs, and {n[1]} rooms"
    about += f"; commit {samples['meta']['git']}"
    moving = [row_of("method_comparison", scene, "fused") for scene in MOVING_CAMERAS]
    values = ([row[key] for row in moving] for key in ("coverage", "median_rel"))
    coverage, error = (f"{percent(min(v))} to {percent(max(v))}" for v in values)
    note = (
        f"The medians of the real scenes are those of studio pairs ({', '.join(STUDIO_PAIRS)}): sharp and still. "
        f"Moving cameras are harder: on {', '.join(MOVING_CAMERAS)}, where constants were chosen, `fused` "
        f"has a coverage of {coverage} and a median error of {error} "
        "(`python benchmarks/reproduce.py method_comparison`)."
    )
    return f"{table([about, *(words for *_, words in columns)], rows)}\n\n{note}"


def _scenes_of(result: dict[str, Any], method: str, is_room: bool) -> list[dict[str, Any]]:
    """Rows of a method over whole scenes: the built-in rooms, or the others."""
    chosen = [r for r in result["rows"] if r["pair"] is None and (r["method"], r.get("truth")) == (method, "full")]
    return [row for row in chosen if row["scene"].startswith("synthetic") is is_room]


def _median_over_scenes(result: dict[str, Any], method: str, key: str, is_room: bool) -> float | None:
    values = [row[key] for row in _scenes_of(result, method, is_room) if row.get(key) is not None]
    return statistics.median(values) if values else None


def timing(file: str, name: str) -> dict[str, Any]:
    """A row of a timing script, of one thread, in torch."""
    wanted = (name, 1, "eager")
    return next(r for r in speed_tables.timings(file) if (r["name"], r["threads"], r["mode"]) == wanted)


#: What the tables say, in words; what a dense map calls it; the scene without a baseline; what was timed.
GOOD = {
    "coverage": "coverage",
    "median_rel": "median error",
    "p90_rel": "p90 error",
    "wrong_share": "errors above 20 %",
    "coverage_at_5": "coverage at 5 % risk",
    "within_sigma": "errors within one stated sigma (68 % wanted)",
}

#: Rows, methods of samples, and maps, in README's table.
UNTOUCHED_KEYS = ("coverage", "median_rel", "p90_rel", "coverage_at_5")
UNTOUCHED_METHODS = ("paper", "map", "auto", "fused")
#: Real scenes of that table that are pairs of a studio, and hand-held or head-worn recordings beside them.
STUDIO_PAIRS = ("Art", "Books", "Dolls", "Moebius")
MOVING_CAMERAS = ("holo_a", *(f"7s_redkitchen_{k}00" for k in ("0", "2", "4", "6")), "tum_fr1_desk9")
UNTOUCHED_MAPS = {"dense": "map of `fused`", "sgbm": "OpenCV SGBM", "bilateral": "filled sensor"}

DENSE_KEY = {"coverage": "answered"}
TURNED = "tum_fr1_rpy_a"
README_METHODS = ("paper", "opencv", "map", "auto", "fused")
TIMED = (
    ("pair", "pair_paper_b1", "ours_ms"),
    ("pair", "pair_paper_b1", "peer_ms"),  # the same stages of OpenCV
    ("pair", "pair_map_b1", "ours_ms"),
    ("stream", "auto_reference_view", "ours_ms"),
    ("stream", "fused_reference_view", "ours_ms"),
    ("dense_speed", "sweep_640x480", "ours_ms"),
)


def loader_times() -> str:
    """What the transform costs in a loader, in one sentence."""
    rows = {(r["name"], r["mode"]): r for r in speed_tables.timings("loader_workers0") if r["threads"] == 1}

    def taken(views: str, mode: str) -> list[dict[str, Any]]:
        names = (f"loader_{views}_640x480_workers0{kind}" for kind in ("", "_by_batch"))
        return [rows[name, mode] for name in names if (name, mode) in rows]

    def ratio_of(mode: str) -> str:
        both = (("single", "one view"), ("pair", "two views"))
        times = [(*taken(views, mode), words) for views, words in both if taken(views, mode)]
        return " and ".join(f"{a['ours_ms']:.2g} ms with {x} ({b['ours_ms']:.2g} by batch)" for a, b, x in times)

    plain, _ = taken("single", "eager")
    after = f"; after `python -m dhtorch.ops`, which compiles inner loops, {ratio_of('compiled')}" * bool(
        ratio_of("compiled")
    )
    return (
        f"A sample of 640×480 takes {ratio_of('eager')}{after}; {plain['peer_ms']:.2g} ms of it is decoding\n"
        f"(`python benchmarks/loader.py --workers 0`; one thread, {plain['processor']})."
    )


def swept() -> str:
    """The jobs of the sweep that README shows, a row each; the best of a column in bold."""
    jobs = read("sweep")
    shown = [[number_as(job[key], key) for key in SWEPT] for job in jobs]
    for k, (key, better) in enumerate(SWEPT.items()):
        if better:
            best = better(job[key] for job in jobs)
            for row, job in zip(shown, jobs, strict=True):
                row[k] = f"**{row[k]}**" if job[key] == best else row[k]
    names = [[f"`{value}`" for value in job["overrides"].values()] for job in jobs]
    head = [*(f"`{key}`" for key in jobs[0]["overrides"]), *(HEAD[key] for key in SWEPT)]
    rows = [a + b for a, b in zip(names, shown, strict=True)]
    return table(head, rows, n_label=len(names[0]))


def number_as(value: float, key: str) -> str:
    """A cell of a sweep's table."""
    return f"{value:,.0f}" if key == "ms" else percent(value)


#: Columns of a sweep's table, and which end of each is the better one.
SWEPT: dict[str, Any] = {"coverage": max, "median_rel": min, "p90_rel": min, "coverage_at_5": max, "ms": min}
HEAD = {"coverage": "coverage", "median_rel": "median error", "p90_rel": "p90 error"}
HEAD |= {"coverage_at_5": "coverage at 5 % risk", "ms": "ms"}


#: What ``dhtorch PATH`` prints of recovered pixels.
RECOVERED = re.compile(r"Recovered ([\d,]+) pixels a frame .*?from (.*?) to (.*?), median stated error ([\d.]+%)")


def captures() -> str:
    """Captures of which ``dhtorch PATH`` recovered something, and how long it took; then the others by name."""
    rows, others = [], []
    for record in [*read("captures"), *read("phone")]:
        first = "" if record["first_s"] is None else f"{record['first_s']:.0f}"
        found = RECOVERED.search(record.get("printed") or "")
        if found is None:
            others.append(f"`{record['name']}`")
        else:
            pixels, near, far, error = found.groups()
            rows.append([f"`{record['name']}`", pixels, f"{near} to {far}", error, first, f"{record['seconds']:.0f}"])
    head = ["capture", "recovered pixels a frame", "depths", "median stated error", "first image, s", "all, s"]
    shown = "".join(
        f"\n\n![{file.stem}: image, sensor, completed](../assets/captures/{file.name})\n\n`{file.stem}`"
        for file in sorted((HERE.parent / "docs/assets/captures").glob("*.jpg"))
    )
    rest = f"Nothing recovered, with a sentence that states why: {', '.join(others)}."
    return f"{table(head, rows)}\n\n{rest}\n\n{record['processor']}, {record['cores']} cores, beside other work.{shown}"


def enriched() -> str:
    """Sets that ``dhtorch enrich`` wrote of real and of written sources, read back value for value; what it refuses."""
    records = read("enrich")
    targets = ("lerobot v3.0", "lerobot v2.1", "nerfstudio", "the source's own")
    rows = []
    for origin in ("real", "written"):
        of_origin = [r for r in records if (r["origin"] == "real") == (origin == "real")]
        cells = []
        for target in targets:
            written = [r for r in of_origin if r["target"] == target and "refused" not in r]
            equal = sum(bool(r["source_untouched"] and r["done_again"] and r["compared"]) for r in written)
            cells.append(f"{equal} of {len(written)}")
        times = [r["s_per_frame"] for r in of_origin if "refused" not in r]
        sources = ", ".join(f"`{source}`" for source in sorted({r["source"] for r in of_origin}))
        rows.append([f"{origin}: {sources}", *cells, f"{min(times):.2f} to {max(times):.2f}"])
    return table(["sources", *targets, "s a frame"], rows)


#: What validation is to find, in words, and its bars.
SCALE_ROWS = {
    "scale_detected": ("scale off by a tenth: detected, reference views with a baseline", "≥ 0.95"),
    "scale_detected_5": ("scale off by a twentieth: detected", "≥ 0.90"),
    "false_alarm": ("correct maps whose scale is called wrong", "≤ 0.02"),
    "scale_detected_far": ("a tenth, by triangulated points alone", ""),
    "scale_detected_5_far": ("a twentieth, by triangulated points alone", ""),
    "false_alarm_far": ("false alarms of triangulated points alone", ""),
    "jump_auroc": (
        "surfaces moved to three times their depth, without a return: area under the ROC curve",
        "≥ 0.95",
    ),
    "called_right_wrong": ("pixels called consistent that are off by 20 %", "≤ 0.01"),
    "called_right_wrong_worst": ("the same in the worst scene", ""),
    "called_right_wrong_cut": ("the same of maps clipped at the 60th percentile of depth", ""),
    "called_wrong_right": ("pixels of correct maps called wrong, of those validated", ""),
    "known": ("pixels of correct maps that are not unknown", ""),
    "named_worst": ("cause named, worst kind, windows moved by two pixels", "≥ 0.90"),
    "misnamed": ("cause named in windows without a fault", ""),
}


#: Columns of the table of validation: result, whose number, head.
VALIDATIONS = (
    ("validate_study", "validate", "`validate`"),
    ("validate_study_streams", "validate", "`validate`, streams"),
    ("validate_study_unseen", "validate", "`validate`, rooms"),
    ("validate_study", "quick", "`QUICK`, no pictures"),
    ("validate_study_streams", "quick", "`QUICK`, streams"),
    ("validate_study", "photometric", "photometric check"),
)


def validated() -> str:
    """What validation finds, beside a fixed-threshold photometric check and the bars."""
    columns, named = {}, []
    for result, who, head in VALIDATIONS:
        value_of = summary_value(result)
        columns[head] = lambda name, who=who, value_of=value_of: value_of(
            f"validate.{name.removesuffix('_far')}_quick_far"
            if who == "quick" and name.endswith("_far")
            else f"{who}.{name}"
        )
        # of the windows in which the depth is not registered, the number in which that cause was named
        causes = [row["named_kind"] for row in read(result)["rows"] if row.get("planted_kind") == "registration"]
        named.append(f"{causes.count('registration')} of {len(causes)}" if who == "validate" else "")
    last = ["depth that is not registered: named, all windows", *named, ""]
    return f"{table_of_bars(SCALE_ROWS, columns)}\n| {' | '.join(last)} |"


def validated_real() -> str:
    """Validation of real sensors' own depth."""
    rows = []
    for row in read("validate_real"):
        whole, limited = row["whole"], row["whole"]["limited"]
        wrong = "unknown" if whole["wrong"] is None else f"{whole['wrong']:.1%}, at least {limited['wrong']:.1%}"
        causes = "; ".join(f"{cause} ({n} of {whole['windows']})" for cause, n in whole["causes"].items())
        options = f" {' '.join(row['options'])}" if row["options"] else ""
        cells = [f"`{row['name']}{options}`", str(whole["frames"]), wrong, f"{limited['unknown']:.1%}"]
        rows.append([*cells, causes or ("no window" if not whole["windows"] else "none")])
        if len(rows) > 1 and rows[-1][1:] == rows[-2][1:]:  # captures with the same results share a row
            rows[-2:] = [[f"{rows[-2][0].partition(', … ')[0]}, … {cells[0]}", *rows[-1][1:]]]
    return table(["capture", "frames", "wrong, of validated pixels", "unknown", "likely cause (windows)"], rows)


#: What a pinned camera is to reach, in words, and its bars.
PINNED = {
    "false_alarms": ("false alarms, camera stands still, three lights", "≤ 0.01"),
    "unknown": ("cannot know, all pictures", ""),
    "found_0.5px": ("found: shift of 0.5 px at the median point of the scene", ""),
    "found_1px": ("1 px", ""),
    "found_2px": ("2 px", "≥ 0.95"),
    "found_5px": ("5 px", ""),
    "found_20px": ("20 px", ""),
    "found_60px": ("60 px", ""),
    "found_0.1deg": ("found: turn of 0.1°", ""),
    "found_0.5deg": ("0.5°", ""),
    "found_1deg": ("1°", ""),
    "found_2deg": ("2°", ""),
    "found_5deg": ("5°", ""),
    "error_mm_half": ("offset, half hidden: median error, mm", "≤ 2"),
    "error_deg_half": ("degrees", "≤ 0.1"),
    "within_1sigma_half": ("its six components within one sigma", "0.68 ± 0.07"),
    "within_2sigma_half": ("within two", "≥ 0.92"),
    "within_1sigma_all": ("all moved pictures: within one sigma", ""),
    "within_2sigma_all": ("within two", ""),
    "time_ratio": ("time of a picture, ratio to one pair of `map`", "≤ 1.5"),
    "time_ratio_half": ("the same, half hidden", ""),
    "gr00t_demo_moved": ("`gr00t_demo`: episodes moved by more than 2 px, of 10", "0"),
    "lerobot_g1_moved": ("`lerobot_g1`: episodes moved by more than 8 px, of 6", "0"),
    "lerobot_g1_turned": ("its sway reported as rotation alone, of what is known", ""),
}


#: What alignment is to reach, in words, and its bars.
ALIGNED = {
    "simulated_median": ("far error, map off by 1.3 % in shape and 5 % in scale, median", "≤ 0.02"),
    "ratio_to_near_affine": ("far error, ratio to an affine fit to near returns, median over faults", "≤ 0.5"),
    "worst_ratio_to_better": ("worst scene and fault: (error − 0.002) / the better of raw and near-only", "≤ 1.05"),
    "within_sigma": ("within one sigma, all pixels with ground truth", "0.68 ± 0.07"),
    "within_2sigma": ("within two", "≥ 0.90"),
}


def aligned() -> str:
    """What alignment reaches, of several results, beside its bars."""
    columns = {}
    for name in ("", "_streams", "_rooms", "_unseen", "_unseen_2", "_unseen_3"):
        result = read(f"align_study{name}")
        seed = result["config"]["data"].get("seed")
        seeds = f", seeds {seed[0]} to {seed[-1]}" if seed else ""
        columns[f"`{result['data']['name']}`{seeds}"] = summary_value(f"align_study{name}", "align.")
    return table_of_bars(ALIGNED, columns)


#: What the scale of a model is to reach, in words, and its bars.
SCALED = {
    "far_error": ("error at three times the near limit, mean over scenes of medians", "≤ 0.01"),
    "error_without_sensor": ("error of scale, without the sensor's own", ""),
    "within_sigma": ("scale within one sigma, sound models", ""),
    "within_2sigma": ("within two", "≥ 0.92"),
    "sound_refused": ("sound models refused", "≤ 0.02"),
    "faulty_refused": ("models bent or drifting by 3 % or more refused", "≥ 0.95"),
    **{
        f"refused_{fault}_{size}": (f"{words}, by {100 * float(size):g} %", "")
        for fault, words in (
            ("drift", "refused: drift along the recording"),
            ("bend", "refused: other scale in the middle of the recording"),
            ("frames", "refused: other scale of a quarter of the frames"),
            ("range", "refused: change over the sensor's range"),
            ("region", "refused, not among these: other scale of a sixth of the near scene"),
        )
        for size in ("0.03", "0.05", "0.1")
    },
}


def caught() -> str:
    """Faults drawn by rule that a test caught, by group of packages."""
    rows = read("mutants")
    seed = rows[0]["seed"]
    cells = [[name, f"{n} of {of}", f"{n / of:.0%}"] for name, n, of in mutants.summarize(rows) if name[0] != "`"]
    return table([f"faults drawn with the seed `{seed}` in", "caught", "fraction"], cells)


def lerobot_trained() -> str:
    """Commands of LeRobot by set and version: passed, failed and why, or not run."""
    rows = read("lerobot_train")
    versions = sorted({row["lerobot"] for row in rows})
    found = {(row["set"], row["command"], row["lerobot"]): row for row in rows}
    cells = []
    for name, command in dict.fromkeys((row["set"], row["command"]) for row in rows):
        each = [found.get((name, command, version), {"passed": None, "why": "not run"}) for version in versions]
        about = next(row["about"] for row in rows if row["set"] == name)
        outcomes = ["passed" if row["passed"] else row["why"].replace("|", "/") for row in each]
        shown = f"`--policy.type={command}`" if command in ("act", "diffusion") else command
        cells.append([name, about, shown, *outcomes])
    return table(["set", "with", "command", *(f"LeRobot {version}" for version in versions)], cells)


def faults_of_captures() -> str:
    """Planted faults of captures: outcomes by fault, over windows and layouts."""
    rows = [row for row in read("capture_faults") if row["counted"]]
    kinds = {"right": "read right", "refused": "refused", "named": "named", "otherwise": "other warning"}
    kinds |= {"unchecked": "stated as unchecked", "silent": "not detected", "alarm": "false alarm"}
    faults: dict[tuple[str, ...], list[str]] = {}
    for fault in dict.fromkeys(row["fault"] for row in rows):
        outcomes = [row["outcome"] for row in rows if row["fault"] == fault]
        counts = (str(len(outcomes)), *(str(outcomes.count(kind) or "") for kind in kinds))
        faults.setdefault(counts, []).append(f"`{fault}`")
    cells = [[", ".join(names), *counts] for counts, names in faults.items()]
    return table(["faults, of each", "captures", *kinds.values()], cells)


def sensitivities() -> str:
    """Options whose half and twice value change neither coverage nor median error, and the strongest others."""
    rows = read("sensitivity")
    idle = ", ".join(f"`{row['name']}`" for row in rows if row["candidate_for_removal"])

    def reach(row: dict[str, Any], number: str) -> float:
        values = [row[at].get(number) for at in ("half", "as_is", "twice")]
        some = [value for value in values if value is not None and value == value]
        return max(some) - min(some)

    strong = sorted(rows, key=lambda row: -reach(row, "coverage"))[:8]
    cells = [
        [f"`{row['name']}`", f"{row['value']:g}", *(f"{reach(row, x):.3f}" for x in ("coverage", "median_rel"))]
        for row in strong
    ]
    head = ["option", "value", "coverage, range", "median error, range"]
    return f"{table(head, cells)}\n\nNeither number moves by more than 0.002 with {idle}."


TABLES: dict[str, Callable[[], str]] = {"comparison": comparison}
TABLES |= {"comparison scenes": partial(by_scene, "method_comparison"), "stress": partial(by_scene, "stress")}
TABLES |= {"kornia twin": twin, "track chain": chained}
TABLES |= {"chosen views": partial(chosen_views, "method_comparison", "streams"), "beside chosen": beside_chosen}
TABLES |= {
    "validate": validated,
    "pin": lambda: table_of_bars(PINNED, {"`pin_study`": summary_value("pin_study", "pin.")}),
    "validate real": validated_real,
    "lerobot train": lerobot_trained,
    "scale": lambda: table_of_bars(SCALED, {"measured": summary_value("scale_study", "scale.")}),
    "align": aligned,
}
TABLES |= {"every pixel": every_pixel}
TABLES |= {"pixels by scene": partial(pixels_by_scene, "dense")}
TABLES |= {"mutants": caught} | speed_tables.TABLES | beside_kornia.TABLES | pose_tables.TABLES
TABLES |= kornia_adapters.TABLES | learning_tables.TABLES | reader_tables.TABLES | client_tables.TABLES
TABLES |= {
    "how good": how_good,
    "sweep": swept,
    "captures": captures,
    "enriched": enriched,
    "loader": loader_times,
    "capture faults": faults_of_captures,
    "sensitivity": sensitivities,
}

#: Numbers of the method comparison in words, and on which side of its bar each belongs.
NUMBER = {
    "median_rel_ratio": "median error, ratio to `paper`",
    "worst_scene_ratio": "worst scene's ratio at equal coverage",
    "aurc_ratio": "area under risk–coverage, ratio to `paper`",
    "coverage_at_5": "coverage at 5 % mean risk",
    "within_sigma": "errors within one stated sigma",
    "within_2sigma": "errors within two",
    "ece": "calibration error of P(error < 10 %)",
    "realised_risk_10": "risk realised at the threshold for 10 %",
    "realised_risk_5": "risk realised at the threshold for 5 %",
}
#: What choosing and joining views is to gain, in words, and its bars.
GAINS = {
    "coverage": ("coverage, median over scenes", "≥ 0.50"),
    "coverage_at_5_indoor": ("coverage at 5 % mean risk, mean over indoor scenes", "≥ 0.50 (streams 0.62)"),
    "error_ratio_to_auto_2": ("median error at equal coverage, ratio to that of release 2", "≤ 1.0"),
    "worst_scene_ratio_to_auto_2": ("the same, worst scene", "≤ 1.1"),
    "aurc_full_ratio_to_auto_2": ("area under risk–coverage with unanswered as risk 1, ratio to it", "≤ 1.0"),
    "within_sigma": ("errors within one stated sigma", "0.68 ± 0.05"),
    "within_2sigma": ("errors within two", "≥ 0.92"),
    "ece_scenes": ("calibration error beyond chance, mean over scenes", "≤ 0.05"),
    "within_target_5": ("scenes that keep the threshold for 5 %", "≥ 0.9"),
    "coverage_within_5": ("coverage above that threshold, mean over scenes", "≥ 0.8 of that at 5 %"),
}

#: What a dense map is to be, in words, and its bars.
PIXELS = {
    "dense.answered": ("hidden pixels answered, textured or not, median over scenes", "≥ 0.50"),
    "dense.error_ratio_to_sparse": ("median error where `auto` answers as well, ratio to it", "≤ 1.15"),
    "dense.coverage_at_5_indoor": ("coverage at 5 % mean risk indoors, on the samples of `auto`", "≥ that of `auto`"),
    "sparse.coverage_at_5_indoor": ("the same of `auto`", ""),
    "dense.pixels_at_5_indoor": ("the same of all hidden pixels", ""),
    "dense.ause_ratio": ("area between sparsification and the errors' own order, over that of chance", "≤ 0.5"),
    "dense.within_sigma": ("errors within one sigma, calibrated in other rooms", "0.68 ± 0.07"),
    "dense.within_2sigma": ("errors within two", "≥ 0.90"),
    "dense.wrong_share": ("answered pixels off by more than 20 %, mean over scenes", "≤ 0.05"),
    "dense.error_ratio_to_sgbm": ("error at equal coverage with one other view, ratio to rectified SGBM", "≤ 1.0"),
    "dense.error_ratio_to_sgbm_own_calibration": ("the same, SGBM under the data set's own calibration", ""),
    "dense.error_ratio_to_dis_flow": ("the same, DIS flow triangulated", ""),
    "dense.error_ratio_to_bilateral": ("the same, the sensor filled by a joint bilateral filter", ""),
    "dense.rotation_answered": ("pixels answered where the camera only rotates", "≤ 0.003"),
    "dense.room_within_1": ("built-in rooms, exact motion: answered pixels within 1 %", "≥ 0.90"),
    "dense.room_within_1_of_all": ("the same of all pixels, unanswered ones counted as misses", ""),
}

BOUND = dict.fromkeys(NUMBER, "≤") | {"coverage_at_5": "≥", "within_2sigma": "≥", "within_sigma": "±0.07 of"}

#: Results whose verdicts are shown, beside those with a table.
SUPPORTED = (
    *("hole_census", "device_pose", "motion", "ablation", "latency"),
    *("room_range_split", "room_gate_ablation", "room_device_pose", "room_real_holes", "paths_motion"),
)
PIPELINES = ("rh20t_probe", "vo_probe", "vo_probe_streams", "downstream_probe", "learned_score")
NEGATIVE = ("helix_correlation", "defocus", "focus_stack", "defocus_fusion", "icp", "hole_attention")
TABLES |= {"verdicts": partial(verdicts, SUPPORTED), "negative": partial(verdicts, NEGATIVE)}
TABLES |= {"untouched": untouched, "fidelity": fidelity.table}
TABLES |= {"closed loop": closed_loop, "closed loop differences": closed_loop_differences}
TABLES |= {"pipelines": partial(verdicts, PIPELINES), "map": partial(verdicts, ("global_map",))}


#: Table of bars → results of its experiments.
_VERDICTS_BELOW = {
    "comparison": ("method_comparison",),
    "every pixel": ("dense",),
    "align": ("align_study",),
    "validate": ("validate_study",),
}
TABLES |= {name: partial(with_verdicts, TABLES[name], *results) for name, results in _VERDICTS_BELOW.items()}


def in_layout(name: str) -> str:
    """The tables of ``results/<name>.json`` in the paper's layout, the paper's figures beside ours."""
    names_read.add(name)
    tables = layouts.layout_tables(result_files.read_result(RESULTS / f"{name}.json"))
    if not tables:
        raise ValueError(f"{RESULTS / name}.json: found an experiment without tables of its own, expected a known one")
    return text.tables_to_markdown(tables).rstrip()


def maker(name: str) -> Callable[[], str]:
    """What writes the part of a page that a marker names.

    Raises:
        ValueError: a marker that nobody knows.
    """
    if name.startswith("results "):
        return partial(in_layout, name.removeprefix("results "))
    if name.startswith("make: "):
        sys.path.append(str(HERE.parent / "docs"))
        import hooks

        return partial(hooks.generate, name.removeprefix("make: "))
    if name not in TABLES:
        raise ValueError(f"marker <!-- {name} -->: expected one of {', '.join(TABLES)}")
    return TABLES[name]


def fill(page: Path) -> str:
    """A page with everything between its markers as result files and code have it.

    Raises:
        ValueError: a marker that nobody knows, or one without its end.
    """
    whole = page.read_text(encoding="utf-8")
    names, ends = MARKER.findall(whole), whole.count("<!-- end -->")
    if len(names) != ends:
        raise ValueError(f"{page}: found {len(names)} markers and {ends} ends, expected as many of each")
    return BLOCK.sub(lambda m: f"<!-- {m[1]} -->\n{_written(m[1])}\n<!-- end -->", whole)


def _written(name: str) -> str:
    """The part of a page that a marker names, and a note on its files with the settings of an earlier release."""
    names_read.clear()
    part = maker(name)()
    if name == "make: experiments":  # of docs/hooks.py, with every archived answer
        names_read.update(archived_answers())
    old = sorted(name for name in names_read if reproduce.other_settings(name))
    note = "\n\n*Made with the settings of an earlier release, not of this one; again with "
    note += f"`python benchmarks/reproduce.py {' '.join(old)}`.*"
    return part + note * bool(old)


def pages() -> list[Path]:
    """README, that of the benchmarks, and all of docs/."""
    return [README, HERE / "README.md", *sorted((HERE.parent / "docs").rglob("*.md"))]


def main() -> int:
    """Rewrite or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    wanted = {page: fill(page) for page in pages()}
    stale = [page for page, filled in wanted.items() if page.read_text(encoding="utf-8") != filled]
    for page in stale:
        print(f"{page.relative_to(HERE.parent)}: {'not up to date' if options.check else 'written'}")
        if not options.check:
            page.write_text(wanted[page], encoding="utf-8")
    return int(options.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
