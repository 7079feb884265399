"""Result files of every experiment with random numbers, for tests of the report."""

import random

from dhtorch.codes import Gate, Hole, names
from dhtorch.experiments.outcome import Outcome, summarise_rows
from dhtorch.experiments.probes import probing
from dhtorch.metrics import errors
from dhtorch.runtime import results as result_files
from support.paper_protocol_runs import probe_errors

SCENES = ("kitchen_000", "office_desk", "terrace/CAMERA_01", "lab_rotation")
ROLES = {"lab_rotation": "rotation"}
DATA = {"name": "rooms", "scenes": [*SCENES], "n_pairs": 12, "digest": "d" * 64}
HW = (480, 640)


def steps(n, low, high):
    return [low + (high - low) * k / (n - 1) for k in range(n)]


def curves(rng, error, coverage):
    share = [coverage * k / 20 for k in range(1, 21)]
    risk = [error * (0.6 + 0.8 * k / 20 + 0.1 * rng.random()) for k in range(1, 21)]
    depth = steps(10, 2.1, 6.0)
    claimed = [None if k > 7 else 0.1 * k + 0.05 for k in range(10)]
    return {
        "risk_coverage": {
            "coverage": share,
            "risk": risk,
            "oracle": [0.4 * r for r in risk],
            "score": steps(20, 0.9, 0.1),
            "median_rel": [0.7 * r for r in risk],
        },
        "distance": {
            "depth": depth,
            "coverage": [min(1.0, coverage * (1.1 - 0.03 * k)) for k in range(10)],
            "median_rel": [None if k == 4 else error * z / 3 for k, z in enumerate(depth)],
        },
        "reliability": {
            "claimed": claimed,
            "realised": [None if c is None else min(1.0, 0.2 + 0.9 * c) for c in claimed],
            "weight": [0.0 if c is None else 1 / 8 for c in claimed],
        },
    }


def overlay(rng, n=400):
    source = [rng.choice((0, 1, 2)) for _ in range(n)]
    gate = [rng.choice(list(names(Gate))[1:]) if s == 0 else 0 for s in source]
    u, v = ([round(rng.random() * (size - 1)) for _ in range(n)] for size in HW[::-1])
    return {"hw": list(HW), "u": u, "v": v, "source": source, "gate": gate, "depth": [1 + 3 * rng.random() for _ in u]}


def measured(rng, error=0.06, coverage=0.6):
    error *= 0.7 + 0.6 * rng.random()
    shares = [rng.random() for _ in names(Gate)]
    holes = [rng.random() for _ in list(names(Hole))[1:]]
    return {
        "n_candidates": rng.randrange(400, 30_000),
        "n_kept": rng.randrange(100, 400),
        "coverage": min(1.0, coverage * (0.8 + 0.4 * rng.random())),
        "median_rel": error,
        "p90_rel": 3 * error,
        "wrong_share": 0.05,
        "corr": max(-0.5, 0.9 - 3 * error),
        "residual_px": 0.4 + error,
        "aurc": error,
        "aurc_excess": error / 2,
        "monotonicity": 0.7,
        "ece": 0.25,
        "ece_equal_mass": 0.24,
        "pnp_success": 1.0,
        "n_recovered": 40.0 + rng.randrange(100),
        "n_dropped": {"close": 7, "wide": 21},
        "gate_share": {name.lower(): s / sum(shares) for name, s in zip(names(Gate).values(), shares, strict=True)},
        "hole_share": {n.lower(): h / sum(holes) for n, h in zip(list(names(Hole).values())[1:], holes, strict=True)},
        "ms": {"sample": 1.0, "track": 100 + rng.random(), "pose": 6.25},
        "apart": {},
    }


def rows_of(variants, cohorts=("full",), scenes=SCENES, notes=None, more=None, seed=0):
    """``variants``: name → (error, coverage); ``notes``: (scene, variant) → why nothing was measured."""
    rng, rows = random.Random(seed), []
    for scene in scenes:
        role = ROLES.get(scene)
        for k, (variant, (error, coverage)) in enumerate(variants.items()):
            for cohort in cohorts:
                base = {"scene": scene, "method": variant, "truth": cohort}
                whole = {**base, "pair": None, "role": role, "cutoff_m": 2.0, "n_pairs": 3, "n_few": 0}
                note = (notes or {}).get((scene, variant))
                if note:
                    rows.append({**whole, "n_pairs": 0, "note": note})
                    continue
                for pair in range(3):
                    rows.append(
                        {**base, "pair": [pair, pair + 3], "pnp_ok": True, "coverage": coverage, "median_rel": error}
                    )
                row = {**whole, **measured(rng, error, coverage), "curves": curves(rng, error, coverage)}
                row |= more(rng, k, variant) if more else {}
                row |= {"overlay": overlay(rng)} if cohort == cohorts[-1] else {}
                rows.append(row)
    return rows


def result(experiment, rows, summary=None, data=None, **changes):
    variants = list(dict.fromkeys(r["method"] for r in rows))
    cohorts = list(dict.fromkeys(r.get("truth") for r in rows))
    overrides = {
        "question": "Does it?",
        "expectation": "It does.",
        "verdict": "refuted",
        "why": "it does not: 3 < 5 & so on",
    }
    parts = {
        "experiment": experiment,
        "key": "0" * 64,
        "meta": result_files.collect_run_metadata(device="cpu", dtype="float32", threads=1, seed=0, operators="torch"),
        "config": {"seed": 0, "method": {"n": 2048, "track": {"levels": 4}}},
        "data": data or DATA,
        "summary": summarise_rows(rows, variants, cohorts) if summary is None else summary,
        "rows": rows,
        **({} if experiment == "pair" else overrides),
    }
    return result_files.build_result(**{**parts, **changes})


def range_split():
    variants = {
        "sensor_only": (0.05, 0.0),
        "device_raw": (1.2, 0.02),
        "device_gl_to_cv": (0.5, 0.1),
        "no_gates": (0.07, 0.7),
        "gated": (0.06, 0.6),
        "gated, cutoff x0.75": (0.08, 0.55),
        "gated, cutoff x1.25": (0.05, 0.65),
    }
    notes = {("office_desk", v): "no device trajectory" for v in ("device_raw", "device_gl_to_cv")}
    notes |= {("terrace/CAMERA_01", v): "too short" for v in variants}
    rows = rows_of(variants, notes=notes)
    for row in rows:
        if row["method"] == "sensor_only" and row["pair"] is None and "note" not in row:
            row |= {
                "n_kept": 0,
                "coverage": 0.0,
                "median_rel": None,
                "p90_rel": None,
                "corr": None,
                "residual_px": None,
            }
            empty = {k: {m: [] for m in c} for k, c in row["curves"].items()}
            row["curves"] = empty
    return result("range_split", rows)


def gate_ablation():
    variants = {"both gates": (0.06, 0.6), "parallax gate off": (0.09, 0.8), "reprojection gate off": (0.065, 0.62)}
    variants |= {"gap x0.5": (0.07, 0.5), "gap x2": (0.05, 0.4)}
    return result("gate_ablation", rows_of(variants, ("heldout",), notes={("office_desk", "gap x2"): "too short"}))


def heldout():
    more = lambda rng, _k, _v: {"passes": rng.random() > 0.5, "reach_p95_m": 4 + rng.random(), "reach_max_m": 6.5}  # noqa: E731
    rows = rows_of({"paper": (0.03, 0.7), "opencv": (0.035, 0.6)}, ("cyclic", "heldout"), more=more)
    return result("heldout", rows)


def calibration():
    def more(_rng, k, _variant):
        steps = (0.1, 0.3, 0.5)
        at = {
            f"at_{t}": {"coverage": 0.6 - t / 2, "median_rel": 0.05 - t / 50 + k / 100, "p90_rel": 0.2} for t in steps
        }
        return {"mean_risk": 0.11, **at}

    variants = {"paper": (0.06, 0.6), "opencv": (0.07, 0.5)}
    rows = rows_of(variants, ("full",), more=more) + rows_of(variants, ("heldout",), more=more)
    return result("calibration", rows, summarise_rows(rows, list(variants), ["heldout", "full"]))


def device_pose():
    more = lambda rng, k, _v: {"rotation_deg": 5.0 * (2 - k) + rng.random(), "translation_m": 0.02 * (2 - k)}  # noqa: E731
    variants = {"device_raw": (1.2, 0.02), "device_gl_to_cv": (0.5, 0.1), "anchored": (0.06, 0.6)}
    return result("device_pose", rows_of(variants, more=more))


def hole_census():
    rng, rows = random.Random(0), []
    for scene in SCENES:
        base = {"scene": scene, "method": "paper", "truth": None}
        for pair in ([0, 0], [1, 1], None):
            numbers = {k: measured(rng)[k] for k in ("hole_share",)}
            numbers |= {"n_samples": 2048, "n_holes": 900, "hole_rate": 0.44, "trackability_hole": 4e-4 * rng.random()}
            rows.append({**base, "pair": pair, **numbers, "trackability_valid": 2e-3})
        rows[-1] |= {"role": ROLES.get(scene), "n_pairs": 2}
    scenes = [
        {k: v for k, v in r.items() if k not in ("pair", "role")} for r in rows if r["pair"] is None and not r["role"]
    ]
    return result("hole_census", rows, errors.summarise_scenes(scenes))


def real_holes():
    rows = rows_of({"no_gates": (0.4, 0.6), "gated": (0.3, 0.5)}, ("full", "real_holes"))
    return result("real_holes", rows)


def motion():
    more = lambda rng, k, _v: {"baseline_m": 0.05 * 2**k + 0.01 * rng.random()}  # noqa: E731
    variants = {f"gap x{g}": (0.1 - 0.015 * k, 0.3 + 0.1 * k) for k, g in enumerate((0.25, 0.5, 1, 2))}
    return result("motion", rows_of(variants, notes={("office_desk", "gap x2"): "too short"}, more=more))


def global_map():
    metrics = ("n_voxels", "voxels_vs_sensor", "n_islands", "largest_island", "right_share", "n_fragments")
    return screened("global_map", [f"{a} {b}" for b in ("device", "anchored") for a in ("sensor", "fused")], metrics)


def latency():
    rows = []
    for hw, scale in (((224, 224), 1.0), ((1440, 1920), 4.0)):
        for stage, ms in (("front_end", 2.0), ("pair", 90.0), ("track", 70.0), ("pose", 9.0)):
            row = {"scene": "synthetic_room", "pair": None, "method": "paper", "stage": stage, "hw": list(hw)}
            row |= {"n": 1024, "repeats": 60, "threads": 1, "device": "cpu", "p50_ms": ms * scale}
            row |= {"p95_ms": ms * scale * 1.2, "p99_ms": None, "low_ms": ms * scale * 0.9, "high_ms": ms * scale * 1.1}
            whole = {"parameters": 0, "weight_bytes": 0, "peak_mib": 310.0 * scale}
            rows.append(row | whole if stage in ("front_end", "pair") else row)
    row = {"scene": "synthetic_room", "pair": None, "method": "dinov2_l", "stage": "forward", "hw": [224, 224]}
    row |= {"n": None, "repeats": 20, "threads": 1, "device": "cpu", "p50_ms": 900.0, "p95_ms": 950.0, "p99_ms": None}
    rows.append(row | {"parameters": 304_368_640, "weight_bytes": 1_217_474_560, "peak_mib": 1900.0})
    entry = {"value": 450.0, "low": 400.0, "high": 500.0, "n": 5, "unit": "1"}
    return result("latency", rows, {"paper.speedup": entry})


def learned():
    variants = {
        "paper": (0.06, 0.6),
        "dust3r_oracle": (0.07, 1.0),
        "vggt_oracle": (0.025, 1.0),
        "vggt_sensor": (0.05, 1.0),
    }

    def more(_rng, k, _variant):
        labels = {"scale": ("sensor", "oracle", "oracle", "sensor")[k], "metric": ("yes", "no", "no", "yes")[k]}
        numbers = {"parameters": (0, 571_000_000, 1_260_000_000, 1_260_000_000)[k], "seconds_per_video": 78.0 * k}
        return {**labels, **numbers, "device": "cpu", "on_ours": {"median_rel": 0.02, "n_kept": 50}}

    return result("learned", rows_of(variants, more=more))


def ablation():
    variants = {
        "default": (0.06, 0.6),
        "sampler grid": (0.065, 0.55),
        "sampler vogel": (0.06, 0.58),
        "n 512": (0.07, 0.6),
    }
    return result("ablation", rows_of(variants))


def screened(experiment, variants, metrics, extra=None):
    """One item a scene, as experiments write them whose estimator is no method."""
    rng, rows = random.Random(0), []
    for scene in SCENES:
        for variant in variants:
            base = {"scene": scene, "method": variant, "truth": "full", "n_candidates": 3000}
            numbers = {m: rng.uniform(-0.2, 0.9) for m in metrics}
            rows += [{**base, **numbers, "pair": [0, 0]}, {**base, **numbers, "pair": None, "role": ROLES.get(scene)}]
    return result(experiment, rows, summarise_rows(rows, variants, ["full"]) | (extra or {}))


def icp():
    return screened("icp", ("good", "good + icp points", "none"), ("n_voxels", "drift_deg", "drift_rel"))


def hole_attention():
    return screened("hole_attention", ("centre", "attention", "random"), ("hole_rate", "rise", "cluster_share"))


def helix_correlation():
    return screened("helix_correlation", ("own_arm", "flow"), ("corr", "rank_corr", "coverage"))


def defocus():
    variants = ("oracle_side", "by_height", "all_beyond", "height_alone", "natural")
    walls = {"blank_wall.soft_paint_px": 2.4, "two_sides.near_px": 1.66, "two_sides.true_px": 1.69}
    extra = {name: {"value": v, "low": None, "high": None, "n": 1, "unit": "1"} for name, v in walls.items()}
    return screened("defocus", variants, ("rho_abs", "corr", "rank_corr", "side_right"), extra)


def focus_stack():
    variants = [c + m for c in ("clean", "noisy", "light_field", "no_focus") for m in ("", ", variance")]
    return screened(
        "focus_stack", variants, ("rank_corr", "corr", "gated_corr", "abs_corr", "gated_abs_corr", "flip_share")
    )


def defocus_fusion():
    variants = ("bilinear", "guided_filter", "defocus_guided")
    return screened("defocus_fusion", variants, ("corr", "mean_rel", "mean_rel_ratio", "edge_mean_rel", "rmse_m"))


def unknown():
    return result("tomorrow", rows_of({"a": (0.06, 0.6), "b": (0.07, 0.5), "c": (0.05, 0.4)}))


def pair():
    return result("pair", rows_of({"paper": (0.06, 0.6)}))


def unmeasured():
    """Notes of scenes in place of numbers, and a variant without a row."""
    notes = {(scene, "gated"): "too short" for scene in "ab"} | {("a", "device_raw"): "no device trajectory"}
    rows = rows_of({"gated": (0.05, 0.5)}, scenes=("a", "b"), notes=notes)
    return result("range_split", rows + rows_of({"device_raw": (1.0, 0.1)}, scenes=("a",), notes=notes))


def knee():
    """Thresholds of which the second is the knee."""
    made = calibration()
    numbers = {"": (0.65, 0.13), "at_0.1.": (0.55, 0.1), "at_0.3.": (0.4, 0.05), "at_0.5.": (0.1, 0.045)}
    for prefix, values in numbers.items():
        for metric, value in zip(("coverage", "median_rel"), values, strict=True):
            made["summary"][f"paper.{prefix}{metric}"]["value"] = value
    made["summary"]["opencv.at_0.3.median_rel"]["n"] -= 1  # a threshold at which a scene is silent is no point
    return made


def probed(experiment, weights=None, **changes):
    """A probe by rooms, of which one has too few pairs."""
    outcome = Outcome(metrics=probing.PROBE_METRICS)
    arms = {"dhtorch": 1.5, "dinov2": 1.0, "context": 2.0, "dhtorch + dinov2": 0.9, "sensor": 1.2, "true_motion": 0.3}
    errors_by_arm = probe_errors(0.2, **arms)
    for name in ("kitchen", "hall"):
        probing.record_probes(outcome, errors_by_arm, name)
    row = {"scene": "yard", "pair": None, "method": "context", "truth": probing.PROBE_TRUTH, "note": "3 pairs"}
    config = {"experiment": {"dinov2": {"weights": weights}}} | changes
    summary = probing.summarise_probes(errors_by_arm)
    return result(
        experiment, [*outcome.rows, row], summary, metrics=[vars(metric) for metric in outcome.metrics], config=config
    )


def future_motion():
    """Arms with random weights beside the paper's figures."""
    return probed("rh20t_probe")


def visual_odometry():
    """Rooms of a probe with the published weights."""
    return probed("vo_probe", "/some/folder")


def next_motion():
    """Enriched sets."""
    return probed("downstream_probe")


ALL = (
    unmeasured,
    knee,
    future_motion,
    visual_odometry,
    next_motion,
    range_split,
    real_holes,
    gate_ablation,
    heldout,
    calibration,
    hole_census,
    device_pose,
    motion,
    global_map,
    latency,
    learned,
    helix_correlation,
    icp,
    hole_attention,
    defocus,
    focus_stack,
    defocus_fusion,
    ablation,
    unknown,
    pair,
)
