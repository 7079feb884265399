"""Fit the calibration that travels with the package: what a score and a sigma of ``map`` turned out to be worth.

python benchmarks/fit_calibration.py      on the shared scenes, five seeds; writes dhtorch/metrics/calibration/map.json
python benchmarks/fit_calibration.py --method auto --seeds 2          the same of a method of several views, whose
                                   thresholds nine scenes in ten keep, one by one
python benchmarks/fit_calibration.py --method fused                of the joint answers at samples and at pixels, also
                                   of five built-in rooms with a phone's noise; four reference views a scene, one
                                   seed; writes dhtorch/metrics/calibration/fused.json

Scenes with a role are left out; every scene has the same weight, its seeds are pooled. Sigma is that of the real
scenes: tracks in the built-in rooms are cleaner than a phone's. What the same recipe is worth in
rooms it was not fitted on is measured by ``dhtorch experiment=method_comparison`` (rows ``ece``, ``realised_risk_…``).
"""

import argparse
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.utils import instantiate

from dhtorch import pytree
from dhtorch.cli.run import config_dir
from dhtorch.data.pairs import by_gap, candidate_frames
from dhtorch.data.scene import scenes_of
from dhtorch.experiments import protocol
from dhtorch.experiments.compare import dense_comparison
from dhtorch.experiments.compare_methods import MIN_ANSWERS_ABOVE_THRESHOLD as FEW
from dhtorch.metrics import calibration, control
from dhtorch.metrics.calibration import fitting
from dhtorch.metrics.errors import Points

#: Reference views of every scene whose maps the calibration of joint answers is fitted on.
REFERENCE_VIEWS = 4

HERE = Path(__file__).resolve().parent


def settings(method: str) -> tuple[protocol.Method, list[Any]]:
    """The method and its scenes, as the command would make them: the shared ones, for joint answers also rooms."""
    chosen: list[Any] = []
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        for data in ("shared_scenes", "synthetic_seeds")[: 2 if method == "fused" else 1]:
            cfg = hydra.compose("run", [f"method={method}", f"data={data}"])
            chosen += scenes_of(instantiate(cfg.data, _convert_="all"))
    return instantiate(cfg.method, _convert_="all"), chosen


def _sparse(method: protocol.Method, chosen: list[Any], seeds: int) -> dict[str, list[Points]]:
    """Scene → candidates of every seed."""
    offers = None if method.select_views is None else candidate_frames
    variants = {f"{k}": protocol.Variant(method, seed=k, offers=offers) for k in range(seeds)}
    return _by_scene(protocol.run(chosen, protocol.Protocol(variants), by_gap, protocol.Settings()).points)


def _joint(method: protocol.Method, chosen: list[Any]) -> dict[str, list[Points]]:
    """Scene → hidden samples, and hidden pixels of the maps, of some reference views."""
    study = dense_comparison.run(
        chosen, {"fused": method}, by_gap, protocol.Settings(), reference_views=REFERENCE_VIEWS, peers=False, rooms=()
    )
    wanted = [
        (name, dense_comparison.FULL_COHORT) for name in (dense_comparison.DENSE_VARIANT, dense_comparison.AT_SAMPLES)
    ]
    return _by_scene({k: p for k, p in study.points.items() if k[1:] in wanted and p.keep.numel()})


def _by_scene(points_by_key: dict[tuple[str, str, str], Points]) -> dict[str, list[Points]]:
    scenes: dict[str, list[Points]] = {}
    for (scene, _, _), points in points_by_key.items():
        scenes.setdefault(scene, []).append(points)
    return scenes


def main() -> int:
    """Run the method on the scenes, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="map")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--output", type=Path, default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.method == "fused":
        options.seeds = 1
    method, chosen = settings(options.method)
    points_by_scene = _joint(method, chosen) if options.method == "fused" else _sparse(method, chosen, options.seeds)
    scenes = [scene.name for scene in chosen if scene.role is None]
    pooled = {s: pytree.collate(points_by_scene[s]) for s in scenes if points_by_scene.get(s)}
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True, check=False
    ).stdout.strip()
    origin = {"method": options.method, "scenes": [*pooled], "truth": "full", "seeds": options.seeds, "git": commit}
    choose = (
        control.plug_in_threshold
        if method.views == 1
        else partial(control.scene_quantile_threshold, few=FEW * options.seeds)
    )
    fitted = fitting.fit_calibration(list(pooled.values()), choose=choose, provenance=origin)
    real = [points for name, points in pooled.items() if not name.startswith("synthetic")]
    fitted = replace(fitted, sigma=calibration.fit_sigma_model(real))
    target = options.output or HERE.parent / "dhtorch" / "metrics" / "calibration" / f"{options.method}.json"
    print(calibration.save_calibration(fitted, target))
    return 0


if __name__ == "__main__":
    sys.exit(main())
