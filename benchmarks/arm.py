"""A robot arm's camera: answers beyond .5 m with and without the arm's poses, ten stations in two rows of five.

    DHTORCH_DATA=… python benchmarks/arm.py --json benchmarks/results/arm.json

Returns beyond the near limit are hidden, and answers there are compared with them. ``map`` has the next station of the
row as its source view; every other method has all other stations as candidates, nearest in number first. A row of the
result for each method and use of the arm's pose, over the candidates of all stations, with the stations' coverages.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dhtorch import data
from dhtorch.codes import Gate, names
from dhtorch.data.recording import Recording
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pytree import collate, stack
from dhtorch.records import Frame, PosePrior
from dhtorch.runtime import storage
from dhtorch.stages.pose_prior import priors_from_frames

#: Near limit, m: returns beyond it are hidden. Source: the note of the data set.
NEAR_M = 0.5

#: Stations in a row. Source: the note of the data set.
ROW = 5

METHODS: dict[str, Method] = {"map": MAP, "auto": AUTO}

#: Uses of the arm's pose. Source: the ways in which a method takes a pose.
USES: dict[str, Any] = {
    "none": None,
    "prior": priors_from_frames,
    "start": partial(priors_from_frames, refine=True),
}


def source_views(name: str, station: int, count: int) -> list[int]:
    """Numbers of the candidate source views of a station."""
    if name == "map":
        return [station + 1 if station % ROW < ROW - 1 else station - 1]
    return sorted((k for k in range(count) if k != station), key=lambda k: (abs(k - station), k))


def estimate_station(
    name: str, method: Method, recording: Recording, station: int, use: Any
) -> tuple[errors.Points, dict[str, Any]]:
    """Held-back points of a station and their estimates, and what its views did."""
    whole = collate([recording[station]])
    reference = holdout.range_split(whole, NEAR_M)
    frames = [collate([recording[k]]) for k in source_views(name, station, len(recording))]
    others: Frame = frames[0] if name == "map" else stack(frames)
    prior: PosePrior | None = None if use is None else use(reference, others)
    trace: dict[str, Any] = {}
    start = time.process_time()
    estimate = method(reference, others, fit=prior, trace=trace)
    seconds = time.process_time() - start
    # The sensor's map has pinholes everywhere: no window of 5 x 5 is full, so the test is that of a sparse map.
    sparse = whole.replace(sparse=torch.ones(1, dtype=torch.bool))
    truth = holdout.select_candidates(trace["samples"], holdout.sample_truth(sparse, trace["samples"].uv), NEAR_M)
    points = errors.points_from_estimate(estimate, truth)
    gates = {name: int((truth.ok & (estimate.gate == code)).sum()) for code, name in names(Gate).items()}
    return points, {"station": station, "seconds": seconds, "gates": {k: v for k, v in gates.items() if v}}


def coverage_of_accurate(points: errors.Points, max_median: float = 0.015) -> float:
    """Largest share of the candidates, surest first, whose median relative error is at most ``max_median``."""
    answers = points.answered()
    error = answers.error[answers.score.argsort(descending=True, stable=True)]
    counts = [k for k in range(1, len(error) + 1) if float(error[:k].median()) <= max_median]
    return max(counts, default=0) / max(len(points.keep), 1)


def rows(recording: Recording, stations: list[int], names: list[str]) -> Iterator[dict[str, Any]]:
    """A row for each method and use of the pose."""
    for name in names:
        for label, use in USES.items():
            results = [estimate_station(name, METHODS[name], recording, k, use) for k in stations]
            pooled = collate([p for p, _ in results])
            yield {
                "method": name,
                "pose": label,
                **errors.measure_errors(pooled),
                "coverage_at_median_1.5": coverage_of_accurate(pooled),
                "gates": dict(sum((Counter(s["gates"]) for _, s in results), Counter())),
                "cpu_seconds": sum(s["seconds"] for _, s in results) / len(results),
                "stations": [{"station": s["station"], **errors.measure_errors(p)} for p, s in results],
            }


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--every", type=int, default=1, help="every so many stations, for trials")
    options = parser.parse_args()
    torch.set_num_threads(1)
    recording = data.open_scenes(scenes=[{"path": "apc_arm", "near": NEAR_M}])[0].recording
    found = []
    for row in rows(recording, list(range(len(recording)))[:: options.every], options.methods):
        found.append(row)
        shown = {k: v for k, v in row.items() if k != "stations"}
        print(shown, [round(s["coverage"] or 0, 2) for s in row["stations"]], flush=True)
        if options.json:
            storage.write_json(options.json, storage.to_strict_json(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
