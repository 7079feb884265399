"""Tables of poses from elsewhere, of rigs and of gravity; see readme.py."""

import statistics
from functools import partial
from typing import Any

from cells import percent, percents, read, table

from dhtorch.runtime.console import format_count

#: Uses of a given pose, in words.
USED = {"as it is": "as it is", "refined": "`refine=True`"}


def given_poses() -> str:
    """What ``map`` answers under right poses of every capture, by what is made of them, beside near returns alone."""
    rows = []
    for scene, runs in by_capture("map").items():
        right = {row["use"]: row for row in runs if row["pose"] in ("right", "none")}
        name = f"`{scene}`" + (" (turns only)" if runs[0]["role"] == "rotation" else "")
        uses = [right["near returns"], *(right[use] for use in USED)]
        cells = [percents(row[key] for row in uses) for key in ("coverage", "median_rel", "within_2sigma")]
        rows.append([name, str(right["near returns"]["n_candidates"]), *cells])
    head = f"near returns / {' / '.join(USED.values())}"
    return table(["capture", "held back", f"answered: {head}", "median error", "within 2 sigma"], rows)


def misread_poses(method: str) -> str:
    """What becomes of late and misread poses, over all captures that do not only turn."""
    runs = [row for rows in by_capture(method).values() for row in rows if row["role"] is None]
    rows = []
    for pose in dict.fromkeys(row["pose"] for row in runs if row["pose"] != "none"):
        cells = []
        for use in ("as it is", "refined"):
            of = [row for row in runs if (row["pose"], row["use"]) == (pose, use)]
            n, ok, refuted = (sum(row[key] for row in of) for key in ("n_pairs", "n_ok", "n_refuted"))
            looks = sum(n for row in of for label, n in row["looks"].items() if label and pose.lower() in label.lower())
            cells += [f"{ok} / {refuted} / {n - ok - refuted} of {n}"]
            cells += [*([str(looks or "")] if use == "as it is" else []), answered_numbers(of)]
        rows.append([pose, *cells])
    used = "used / refuted / not known"
    answers = "median error (near returns'), within 1 and 2 sigma"
    return table(["poses", used, "named right", answers, f"refined: {used}", f"refined: {answers}"], rows)


def answered_numbers(rows: list[dict[str, Any]]) -> str:
    """Medians over captures that answered twenty times at least."""
    of = [row for row in rows if row["n_candidates"] * (row["coverage"] or 0) >= 20]
    if not of:
        return "hardly an answer"
    keys = ("median_rel", "within_sigma", "within_2sigma")
    error, one, two = (percent(statistics.median(row[key] for row in of)) for key in keys)
    near = [row["near"]["median_rel"] for row in of if row["near"]["median_rel"] is not None]
    captures = format_count(len(of), "capture")
    return f"{error} ({percent(statistics.median(near)) if near else '–'}), {one}, {two}; {captures}"


def by_capture(method: str) -> dict[str, list[dict[str, Any]]]:
    """Capture → its rows of one method."""
    by_scene: dict[str, list[dict[str, Any]]] = {}
    for row in read("given_poses"):
        if row.get("method") == method:
            by_scene.setdefault(row["scene"], []).append(row)
    return by_scene


def rigs(kind: str) -> list[dict[str, Any]]:
    """Rows of one kind, those of all robots as one of medians."""
    records = [row for row in read("rigs") if row["kind"] == kind]
    rows = [row for row in records if not row["rig"].startswith("robot")]
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in records:
        if row["rig"].startswith("robot"):
            groups.setdefault(tuple(row.get(k, "") for k in ("tracker", "pose", "pairs")), []).append(row)
    for of in groups.values():
        joined = {
            key: median([row.get(key) for row in of]) for key, value in of[0].items() if not isinstance(value, str)
        }
        rows.append({**of[0], **joined, "rig": f"{len(of)} robots, medians", "all": of})
    return rows


def median(values: list[Any]) -> Any:
    """Of numbers, the rest left out."""
    some = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    return statistics.median(some) if some else None


def rig_poses() -> str:
    """A rig's pose from all instants against its calibration."""
    rows = []
    for row in rigs("pose"):
        several = row.get("all", [row])
        head = [row["rig"], row["tracker"], f"{row['n_ok']:g} of {row['n_instants']:g}"]
        if row.get("baseline_m") is None:  # no pose at any instant
            continue
        off = f"{row['off_deg']:.3f}°, {1e3 * row['off_m']:.2f} mm"
        stated = f"{row['sigma_deg']:.3f}°, {1e3 * row['sigma_m']:.2f} mm"
        worst = "" if len(several) == 1 else f" (largest {max(r['deviation'] for r in several):.1f})"
        baseline = f"{1e3 * row['baseline_m']:.1f} / {1e3 * row['calibrated_m']:.1f}"
        rows.append([*head, baseline, off, stated, f"{row['deviation']:.1f}{worst}"])
    head = ["rig", "stage 4", "instants with a pose", "baseline, mm: found / calibrated"]
    return table([*head, "off", "stated sigma", "off in sigmas (2.3 expected, 4.7 once in a thousand)"], rows)


def rig_answers() -> str:
    """What pairs of cameras answer, by where their pose comes from."""
    rows = []
    for row in (r for r in rigs("answers") if r["coverage"]):
        n = row["n_candidates"]
        cells = [row["rig"], row["tracker"], row["pairs"], row["pose"], f"{n:g}", percent(row["coverage"])]
        cells += [percent(row["median_rel"]), percent(row["p90_rel"])]
        rows.append([*cells, f"{percent(row['within_sigma'])}, {percent(row['within_2sigma'])}"])
    head = ["rig", "stage 4", "pairs in", "pose from", "held back", "answered", "median error", "p90"]
    return table([*head, "within 1, 2 sigma"], rows)


def upwards() -> str:
    """Which way is up in captures that show a level surface: stated, shown by it, written."""
    rows = []
    for row in (r for r in read("gravity") if "plane" in r):
        stated = row.get("stated")
        axis = "–" if stated is None else "xyz"[max(range(3), key=lambda k: abs(stated[k]))]
        sign = "" if stated is None else "−" if sum(stated) < 0 else "+"
        angles = (row.get(key) for key in ("stated_from_plane_deg", "written_from_plane_deg"))
        rows.append(
            [
                f"`{row['capture']}`",
                sign + axis,
                percent(row["share"]),
                *("–" if a is None else f"{a:.1f}°" for a in angles),
            ]
        )
    return table(["capture", "stated", "level area", "stated axis from it", "`up` in the files from it"], rows)


TABLES = {"given poses": given_poses, "misread poses": partial(misread_poses, "map"), "rig poses": rig_poses}
TABLES |= {"rig answers": rig_answers, "upwards": upwards}
