"""Fit the calibration that travels with the package: what a score and a sigma of ``map`` turned out to be worth.

python benchmarks/fit_calibration.py      on the shared scenes, five seeds; writes dhtorch/calibration/map.json
python benchmarks/fit_calibration.py --method auto --seeds 2          the same of methods of several views, whose
python benchmarks/fit_calibration.py --method window_1 --seeds 2      thresholds nine scenes in ten keep, one by one

Scenes with a role are left out; every scene has the same weight, its seeds are pooled. What the same recipe is worth in
rooms it was not fitted on is measured by ``dhtorch experiment=method_comparison`` (rows ``ece``, ``realised_risk_…``).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.utils import instantiate

from dhtorch import calibration, tree
from dhtorch.commands.run import config_dir
from dhtorch.data.pairs import around, by_gap
from dhtorch.evaluate import control, score_calibration
from dhtorch.evaluate.compare import MIN_ABOVE as FEW
from dhtorch.studies import protocol

HERE = Path(__file__).resolve().parent


def settings(method: str) -> tuple[protocol.Method, list[Any]]:
    """The method and the shared scenes, as the command would make them."""
    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = hydra.compose("run", [f"method={method}", "data=shared_scenes"])
    return instantiate(cfg.method, _convert_="all"), instantiate(cfg.data, _convert_="all")


def main() -> int:
    """Run the method on the scenes, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="map")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--output", type=Path, default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    method, chosen = settings(options.method)
    offers = None if method.choose is None else around
    variants = {f"{k}": protocol.Variant(method, seed=k, offers=offers) for k in range(options.seeds)}
    outcome = protocol.run(chosen, protocol.Protocol(variants), by_gap, protocol.Settings())
    scenes = [scene.name for scene in chosen if scene.role is None]
    found = {s: [p for (name, _, _), p in outcome.points.items() if name == s] for s in scenes}
    pooled = {s: tree.collate(points) for s, points in found.items() if points}
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True, check=False
    ).stdout.strip()
    origin = {"method": options.method, "scenes": [*pooled], "truth": "full", "seeds": options.seeds, "git": commit}
    choose = control.plug_in if method.views == 1 else partial(control.most_scenes, few=FEW * options.seeds)
    fitted = score_calibration.fit(list(pooled.values()), choose=choose, provenance=origin)
    target = options.output or HERE.parent / "dhtorch" / "calibration" / f"{options.method}.json"
    print(calibration.save(fitted, target))
    return 0


if __name__ == "__main__":
    sys.exit(main())
