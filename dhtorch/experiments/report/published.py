"""Numbers of the paper as printed, with their place in it, for comparison with a result.

Cells are kept as printed, so that no digit is added; :func:`parse_printed` converts one to a number. The paper is
"Double- Helix Active Geometry: LiDAR-Anchored Multi-View Depth with Selective Abstention" (J. Wen). Its data sets
are its own: none of these figures was measured on the scenes of a result shown beside it, unless that result states
it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

PAPER_CITATION = "Double-Helix Active Geometry: LiDAR-Anchored Multi-View Depth with Selective Abstention (J. Wen)"


@dataclass(frozen=True)
class PublishedTable:
    """Lines of a table of the paper: line → metric → printed cell."""

    where: str
    data: str
    lines: Mapping[str, Mapping[str, str]]
    notes: tuple[str, ...] = ()


def _parse_lines(metrics: str, lines: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Parse lines of cells separated by bars, in the order of the metric names; a dash is an empty cell."""
    names = metrics.split()
    cells = {line: [c.strip() for c in row.split("|")] for line, row in lines.items()}
    return {line: {n: c for n, c in zip(names, row, strict=True) if c != "–"} for line, row in cells.items()}


_ARKIT = "ARKitScenes, five sequences"

_PROBE_NOTES = (
    "No test of equivalence was run. Features of any kind gain 0.6–2.4 % on the context; raw RGB is not beaten.",
)

#: Tables of the paper.
PAPER: dict[str, PublishedTable] = {
    "latency": PublishedTable(
        "Table 1, section 6.1",
        "one Apple M4 Pro, 224×224, batch 1, fp32; OpenCV on 14 threads",
        _parse_lines(
            "device p50_ms p95_ms p99_ms parameters weight_bytes peak_mib",
            {
                "DINOv2-L": "CPU | 106.5 | – | – | 303 M | 1.2 GB | –",
                "DINOv2-L (MPS)": "GPU | 42.0 | – | – | 303 M | – | 2.2 GB",
                "core front end": "CPU | 1.11 | 1.24 | 1.34 | 0 | 0 | –",
                "core front end, 1440×1920": "CPU | 3.81 | – | – | – | – | –",
            },
        ),
        ("Latency of the front end is 96 times lower than DINOv2-L's on the CPU and 38 times lower than on the GPU.",),
    ),
    "heldout": PublishedTable(
        "Table 2, section 6.2",
        "two iPhone captures of its own",
        _parse_lines(
            "n_kept corr median_rel residual_px n_recovered reach_max_m passes",
            {
                "indoor (near-static)": "225 | 0.963 | 3.5 % | 0.96 | 105 | – | yes",
                "outdoor (walking)": "2,010 | 0.974 | 1.4 % | 0.74 | 663 | 6.1 | yes",
            },
        ),
    ),
    "cyclic": PublishedTable(
        "section 6.2",
        "an iPhone capture of its own, not named",
        _parse_lines("cyclic heldout ratio", {"in-house": "0.7 % | – | 5×"}),
    ),
    "cross_data": PublishedTable(
        "Table 3, section 6.3",
        "its own captures and two public benchmarks",
        _parse_lines(
            "n_scenes median_rel range corr ece passes",
            {
                "in-house iPhone": "2 | 1.4–3.5 % | – | 0.96–0.97 | – | 2/2",
                "TUM RGB-D": "11 | 2.6 % | 1.0–4.2 % | 0.806 | 0.284 | 8/11",
                "ARKitScenes": "5 | 6.7 % | – | 0.745 | 0.224 | 1/5",
            },
        ),
        ("Coverage is as low as 1 % of the candidates on a sequence with large rotation.",),
    ),
    "range_split": PublishedTable(
        "Table 4, section 6.4",
        f"{_ARKIT}, cutoff 2 m, 32,690 candidates, laser truth",
        _parse_lines(
            "coverage corr median_rel p90_rel",
            {
                "sensor-only (after cutoff)": "0.0 % | – | – | –",
                "device pose (raw)": "0.4 % | −0.33 | 126.0 % | 663 %",
                "device pose (GL→CV)": "3.5 % | −0.44 | 57.3 % | 375 %",
                "no gates": "68.0 % | 0.02 | 14.1 % | 41.0 %",
                "gated": "64.2 % | 0.26 | 13.4 % | 35.6 %",
            },
        ),
        (
            "Gated, single sequences: coverage 47.7–88.8 %, median error 8.5–14.1 %.",
            "Pooled: 22,045 of 32,690 candidates answered (67.4 %).",
        ),
    ),
    "real_holes": PublishedTable(
        "section 6.4",
        f"{_ARKIT}, 260 stable points of the laser truth",
        _parse_lines(
            "coverage median_rel p90_rel",
            {"no gates": "58.9 % | 46.4 % | 71.8 %", "gated": "53.5 % | 42.4 % | 47.2 %"},
        ),
        ("One of the five sequences has no gated answer on its 12 real-hole candidates.",),
    ),
    "cutoff_sweep": PublishedTable(
        "Table 5, section 6.4",
        _ARKIT,
        _parse_lines(
            "cutoff_m pnp_success n_candidates coverage median_rel",
            {
                "1.5 m": "1.5 | 69.6 % | 113,556 | 66.5 % | 11.3 %",
                "2.0 m": "2.0 | 89.2 % | 32,690 | 64.2 % | 13.4 %",
                "2.5 m": "2.5 | 91.6 % | 7,254 | 71.9 % | 12.9 %",
            },
        ),
    ),
    "gate_ablation": PublishedTable(
        "Table 6, section 6.5",
        _ARKIT,
        _parse_lines(
            "corr median_rel",
            {
                "gap 16": "0.803 | 7.1 %",
                "gap 30 (default)": "0.745 | 6.7 %",
                "gap 60": "0.731 | 6.3 %",
                "parallax gate OFF (gap 30)": "0.034 | 7.2 %",
                "reprojection gate OFF (gap 30)": "0.724 | 6.8 %",
            },
        ),
    ),
    "learned": PublishedTable(
        "Table 7, section 6.6",
        _ARKIT,
        _parse_lines(
            "median_rel corr scale metric parameters seconds_per_video",
            {
                "DH-Active": "6.7 % | 0.745 | sensor | yes | 0 | –",
                "DUSt3R": "7.2 % | 0.802 | oracle | no | 571 M | 78",
                "VGGT-1B": "2.5 % | 0.967 | oracle | no | 1.26 B | 235",
            },
        ),
        ("Contextual measurements, not a ranking: inputs, density and scale treatment differ.",),
    ),
    "thresholds": PublishedTable(
        "section 6.4",
        _ARKIT,
        _parse_lines("coverage median_rel", {"0": "64.2 % | 13.4 %", "0.3": "34.3 % | 9.5 %"}),
        ("The paper names 0.3 as the knee; stricter thresholds no longer improve the error monotonically.",),
    ),
    "score_calibration": PublishedTable(
        "Table 3, section 6.3",
        "public benchmarks",
        _parse_lines("ece", {"TUM RGB-D": "0.284", "ARKitScenes": "0.224"}),
    ),
    "hole_census": PublishedTable(
        "section 3.1",
        "two iPhone captures of its own",
        _parse_lines("hole_share.trackable_no_lidar", {"indoor": "90.4 %", "outdoor": "86.1 %"}),
        ("Trackability of these holes is of the same order as that of samples with a return.",),
    ),
    "global_map": PublishedTable(
        "section 3.5 and the limitations",
        "captures of its own; no figure is printed",
        {},
        ("Recovered points widen the coverage of the map; they do not stitch its fragments into a closed room.",),
    ),
    "device_pose": PublishedTable(
        "section 3.2",
        "iPhone captures of its own; axes of the trajectory not stated",
        _parse_lines("rotation_deg corr", {"device (VIO) pose": "∼5 | ≈ 0.16"}),
    ),
    "baseline_motion": PublishedTable(
        "Table 2, section 6.2",
        "two iPhone captures of its own",
        _parse_lines(
            "median_rel n_recovered",
            {"indoor (near-static)": "3.5 % | 105", "outdoor (walking)": "1.4 % | 663"},
        ),
    ),
    "helix": PublishedTable(
        "section 4",
        "captures of its own, mostly; inverse depth of the LiDAR",
        _parse_lines("corr", {"dual-helix correlation": "−0.04", "plain 2-D optical flow": "+0.34"}),
        ("Under forward motion the flow is radial, and a tangential correlation does not see it.",),
    ),
    "icp": PublishedTable(
        "section 4",
        "captures of its own, mostly",
        _parse_lines("n_voxels", {"device pose (VIO) alone": "6,200", "ICP over it": "5,417"}),
        ("Rarely confident over a good pose; of use where there is none.",),
    ),
    "hole_attention": PublishedTable(
        "section 4",
        "captures of its own, mostly",
        _parse_lines("hole_rate", {"before": "0.67", "gaze on the largest hole cluster": "0.78"}),
        ("Use of the holes: routing, what may need a head turn.",),
    ),
    "defocus": PublishedTable(
        "section 4",
        "captures of its own, mostly",
        _parse_lines(
            "rho_abs corr",
            {"unsigned": "0.22 | –", "side from an oracle": "0.22 | 0.66", "side has to be produced": "– | 0.06"},
        ),
        (
            "|ρ| does not depend on the side: the same figure is in two lines.",
            "Two ambiguities: texture (a blank wall looks defocused), and near against far of the focus.",
        ),
    ),
    "focus_stack": PublishedTable(
        "section 4",
        "FoD500 (clean synthetic), DDFF-12 (real light fields)",
        _parse_lines(
            "rank_corr gated_corr flip_share abs_corr gated_abs_corr",
            {"clean synthetic": "0.69 | 0.76 | – | – | –", "real light fields": "– | – | ∼1/5 | 0.15 | 0.21"},
        ),
    ),
    "defocus_fusion": PublishedTable(
        "section 4",
        "captures of its own, mostly",
        _parse_lines("corr", {"bilinear": "0.82–0.99"}),
        ("Defocus never beats plain interpolation and slightly raises the error.",),
    ),
    "future_motion": PublishedTable(
        "section 6.7",
        "RH20T, 799 tasks, ∼100k samples, DINOv2-L",
        _parse_lines("vs_dinov2", {"DH-Active": "1.006"}),
        _PROBE_NOTES,
    ),
    "future_motion_moving": PublishedTable(
        "section 6.7",
        "RH20T, 799 tasks, DINOv2-L, moving samples",
        _parse_lines("vs_dinov2", {"DH-Active": "1.013"}),
        _PROBE_NOTES,
    ),
    "visual_odometry": PublishedTable(
        "section 6.7",
        "a single scene, not named",
        _parse_lines("mse vs_dinov2", {"DH-Active": "1.32 | 0.81", "DINOv2": "1.63 | –"}),
        ("The paper itself calls the task geometry-favoured.",),
    ),
}


def parse_printed(text: str | None) -> float | None:
    """Printed cell as a number, per cent as a fraction; None for a range, a word or an empty cell."""
    match = re.fullmatch(r"([+−-]?[\d,]+(?:\.\d+)?) ?(%|M|B)?", text or "")
    if not match:
        return None
    scale = {"%": 0.01, "M": 1e6, "B": 1e9, None: 1.0}[match[2]]
    return float(match[1].replace(",", "").replace("−", "-")) * scale
