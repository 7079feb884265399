"""Poses from elsewhere on real captures: right ones, late ones and misread ones, held against the near returns.

    python benchmarks/given_poses.py --json benchmarks/results/given_poses.json

Of every pair the sensor's returns beyond a cutoff are held back, and answers there are held against them. Tracks and
the near returns' own pose are found once; what changes is the pose that is given and what is made of it. A row for
each capture, method, pose and use.
"""

import argparse
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch import data
from dhtorch.codes import PoseCode
from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.geometry import se3
from dhtorch.geometry.pose_conventions import CONVENTIONS, STATED_AXES, pose_from_axes
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import METHODS
from dhtorch.pytree import collate
from dhtorch.records import Frame, Pose, PoseFit, PosePrior
from dhtorch.runtime import storage
from dhtorch.stages import pose_prior
from dhtorch.synthetic import SyntheticRoom

#: Captures whose poses come from a device or a tracker, with cutoff (m), frames between two views, and what they need.
CAPTURES: tuple[dict[str, Any], ...] = (
    {"path": "holo_a", "near": 2.5, "gap": 3},
    *(
        {"path": f"7s_redkitchen_{k}", "near": 2.0, "gap": 20, "room": "redkitchen"}
        for k in ("000", "200", "400", "600")
    ),
    {"path": "tum_fr1_desk9", "near": 1.0, "gap": 4},
    {"path": "r3d_door", "near": 0.25, "gap": 10},
    {"path": "slambook_rgbd", "near": 2.5, "gap": 1},
    {"path": "dgp_drive6cam", "near": 20.0, "gap": 1, "levels": 6, "crop_bottom": 0.25},
    {"path": "tum_fr1_rpy_a", "near": 1.5, "gap": 8, "role": "rotation"},
)

#: Captures that would belong here, and why they are not.
MISSING = {
    "stray_room": "no pictures in it: nothing to track",
    "ARKitScenes": "no capture at hand",
    "CA-1M": "no capture at hand",
}

#: Methods, pairs a capture, and frames by which poses are late.
MEASURED_METHODS = ("paper", "map")
PAIRS = 8
LATE = range(1, 6)

#: What is made of a pose: standard deviations that are stated with it (rad, m), and whether it only starts a search.
USES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "stated": {"sigma": (0.005, 0.01)},
    "exact": {"sigma": (0.0, 0.0)},
    "refined": {"refine": True},
}

#: Uses of a pose that is misread; of late ones all but the exact.
OF_WRONG = ("as it is", "refined")


@dataclass(frozen=True)
class TrackedPairs:
    """Pairs of a scene, tracked, and the answers that were held back."""

    scene: Scene
    pairs: list[tuple[int, int]]
    reference: Frame  # with the returns up to the cutoff
    others: Frame
    truth: holdout.Truth
    method: Method  # its tracks and near returns' pose are known
    fit: PoseFit

    def points(self, fit: PosePrior | None, at: Tensor) -> tuple[errors.Points, PoseFit]:
        """What is answered in the pairs ``at``, under a pose or the near returns' own."""
        trace: dict[str, Any] = {}
        method = self.method.replace(
            track=lambda *_, hint: self.method.track(*_, hint=hint)[at],
            pose=lambda *_: self.fit[at],
        )
        estimate = method(self.reference[at], self.others[at], fit=fit, trace=trace)
        return errors.points_from_estimate(estimate, self.truth[at]), trace["fit"]


def pairs_of(recording: Recording, gap: int) -> list[tuple[int, int]]:
    """Pairs (i, i + gap), evenly thinned; the first frames are left to poses that are late, where there are enough."""
    last = len(recording) - gap
    first = LATE[-1] if last - LATE[-1] >= PAIRS else 0
    count = min(PAIRS, last - first)
    return [(i, i + gap) for i in (first + k * (last - 1 - first) // max(count - 1, 1) for k in range(count))]


def tracked(scene: Scene, method: Method) -> TrackedPairs:
    """The pairs of a scene under the near returns' own pose."""
    assert scene.gap is not None
    pairs = pairs_of(scene.recording, scene.gap)
    whole, others = (collate(scene.recording[k] for k in side) for side in zip(*pairs, strict=True))
    reference, others = (holdout.range_split(frame, scene.near) for frame in (whole, others))
    trace: dict[str, Any] = {}
    method(reference, others, hint=scene.hint, trace=trace)
    truth = holdout.select_candidates(trace["samples"], holdout.sample_truth(whole, trace["samples"].uv), scene.near)
    known = method.replace(track=lambda *_, hint: trace["tracks"])
    return TrackedPairs(scene, pairs, reference, others, truth, known, trace["fit"])


def stated(world: Pose) -> Iterator[tuple[str, Pose, list[int] | None]]:
    """What a trajectory may be taken for, and the frame whose pose each frame gets (None = its own)."""
    n = len(world.t)
    yield "right", world, None
    for d in LATE:
        yield f"late by {d}", world, [k - d for k in range(n)]
    yield "OpenGL axes", pose_from_axes(world, STATED_AXES["gl"]), None
    yield "inverse", se3.invert(world), None
    yield "millimetres", world.replace(t=1000 * world.t), None
    yield "order of letters", world, sorted(range(n), key=str)
    yield "backwards", world, [n - 1 - k for k in range(n)]


def motions(case: TrackedPairs, world: Pose, source: list[int] | None, **use: Any) -> tuple[PosePrior | None, Tensor]:
    """The motions of those pairs whose poses are there and not right by chance, and which pairs these are."""
    place = list(range(len(world.t))) if source is None else source
    there = [b for b, (i, j) in enumerate(case.pairs) if min(place[i], place[j]) >= 0]
    if source is not None:
        there = [b for b in there if (place[case.pairs[b][0]], place[case.pairs[b][1]]) != case.pairs[b]]
    if not there:
        return None, torch.tensor(there)
    ends = ([place[case.pairs[b][side]] for b in there] for side in (0, 1))
    T_0, T_1 = (world.map(lambda x, k=k: x[k]) for k in ends)
    return pose_prior.relative_prior(T_0, T_1, **use).to(case.reference.camera.f.dtype), torch.tensor(there)


def off(case: TrackedPairs, motion: PosePrior, world: Pose, at: Tensor) -> dict[str, float]:
    """By how much a motion differs from that of the capture's own poses, medians over pairs."""
    i, j = (torch.tensor(side)[at] for side in zip(*case.pairs, strict=True))
    right = se3.relative(world.map(lambda x: x[i]), world.map(lambda x: x[j]))
    xi = se3.log(se3.compose(motion.T_1_from_0.to(torch.float64), se3.invert(right)))
    return {
        "off_deg": math.degrees(float(xi[:, :3].norm(dim=1).median())),
        "off_m": float(xi[:, 3:].norm(dim=1).median()),
    }


def numbers(points: errors.Points, fit: PoseFit) -> dict[str, Any]:
    """A row's numbers."""
    refuted = fit.code == PoseCode.REFUTED
    looks = (
        Counter("" if fit.matched_convention is None else CONVENTIONS[int(k)] for k in fit.matched_convention[refuted])
        if refuted.any()
        else {}
    )
    return {
        "n_pairs": len(fit.code),
        "n_ok": int(fit.ok.sum()),
        "n_refuted": int(refuted.sum()),
        "looks": dict(looks),
        "sigma_rel": None if not points.keep.any() else float((points.sigma / points.depth)[points.keep].median()),
        **error_row(points),
    }


def error_row(points: errors.Points) -> dict[str, Any]:
    """How far answers are from what was held back."""
    measured = errors.measure_errors(points)
    return {
        k: measured[k] for k in ("n_candidates", "coverage", "median_rel", "p90_rel", "within_sigma", "within_2sigma")
    }


def rows(scene: Scene, name: str) -> Iterator[dict[str, Any]]:
    """All rows of one scene under one method."""
    case, world = tracked(scene, METHODS[name]), scene.recording.poses
    assert world is not None
    head = {"scene": scene.name, "room": scene.place, "role": scene.role, "cutoff_m": scene.near, "method": name}
    everything = torch.arange(len(case.pairs))
    yield head | {"pose": "none", "use": "near returns"} | numbers(*case.points(None, everything))
    for pose, poses, source in stated(world):
        true = pose == "right" or pose.startswith("late")
        for use, options in USES.items():
            if not (true or use in OF_WRONG) or (use == "exact" and pose != "right"):
                continue
            motion, at = motions(case, poses, source, **options)
            if motion is None:
                continue
            away = off(case, motion, world, at) if true else {}
            row = numbers(*case.points(motion, at))
            yield head | {"pose": pose, "use": use} | away | row | {"near": error_row(case.points(None, at)[0])}


def scenes() -> Iterator[Scene]:
    """The captures, and the built-in room, whose poses are exact."""
    for capture in CAPTURES:
        yield from data.open_scenes(scenes=[capture])
    yield Scene(SyntheticRoom(n_frames=40, hw=(360, 480), step_m=0.02), near=2.0, gap=8)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", help="one scene")
    options = parser.parse_args()
    torch.set_num_threads(1)
    records: list[Mapping[str, Any]] = [{"scene": name, "why": why} for name, why in MISSING.items()]
    for scene in scenes():
        if options.only in (None, scene.name):
            for method in MEASURED_METHODS:
                records += rows(scene, method)
            print(scene.name, flush=True)
    storage.write_json(options.json, storage.to_strict_json([*records]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
