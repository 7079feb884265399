"""How wrong XFeat's matches are: the constants of ``dhtorch.experiments.baselines.xfeat.match_covariance``, fitted and
tested.

python benchmarks/xfeat_noise.py [--json FILE]      a few minutes; needs the extra ``matchers``

Matches between views of the built-in rooms, whose truth is exact. The logarithm of eᵀ S⁻¹ e, e the error and S the
stated spread, is linear in 1 − similarity up to that of a χ² variable of two degrees of freedom: regression gives both
constants. Matches further off than a cell are wrong ones, no noise, and stay out. What the constants are worth is told
in rooms of other seeds: shares of the errors within one and two stated sigmas, over all matches and by similarity.
"""

import argparse
import json
import math
import sys
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from dhtorch.experiments.baselines import xfeat
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.synthetic import SyntheticRoom

#: Rooms that the constants are fitted in, and rooms that they are tested in.
FITTED, TESTED = (0, 1, 3), (4, 5)

#: Paths, and frame steps between the views of a pair.
PATHS, GAPS = ("walk", "lateral"), (6, 12)

#: How pictures are looked at and matches read: the defaults of ``xfeat.match``.
LOOK, SHARPNESS = {"scale": 1.3, "longest_px": 1664}, 80.0

#: Samples per pair, how far from the border, px, and how much deeper what is seen there may be before it hides a point.
SAMPLES, MARGIN, HIDDEN = 2048, 8, 0.02

#: Mean logarithm of a χ² variable of two degrees of freedom.
MEAN_LOG = math.log(2) - 0.5772156649015329

#: Shares of such a variable below one and four.
EXPECTED = {"within_sigma": 1 - math.exp(-0.5), "within_2sigma": 1 - math.exp(-2.0)}


def truth(room: SyntheticRoom, i: int, j: int, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Where whole pixels (1, N, 2) of frame i lie in frame j, px, and which are seen there and no mirror or pane."""
    there = room.truth(i)
    depth, _ = sample_nearest(there["depth"], uv)
    surface, _ = sample_nearest(there["surface"].float(), uv)
    T = se3.compose(se3.invert(room.true_poses[j : j + 1]), room.true_poses[i : i + 1])
    camera = room.camera.to(torch.float64)
    xyz = se3.apply(T, cam.unproject(camera, uv.double(), depth.double()))
    uv_1 = cam.project(camera, xyz).float()
    seen, inside = sample_nearest(room.truth(j)["depth"], uv_1)
    ordinary = surface == 0
    return uv_1, inside & ordinary & ((seen / xyz[..., 2] - 1).abs() < HIDDEN)


def matches(seeds: tuple[int, ...]) -> dict[str, Tensor]:
    """Errors in cells, similarities and spreads of the valid matches in the rooms of these seeds."""
    draw = torch.Generator().manual_seed(0)
    net = xfeat.load_xfeat().net
    matches: dict[str, list[Tensor]] = {"error": [], "similarity": [], "spread": []}
    for seed in seeds:
        for path in PATHS:
            room = SyntheticRoom(seed=seed, path=path, n_frames=max(GAPS) + 1, supersample=1)
            for gap in GAPS:
                high = torch.tensor([room.hw[1], room.hw[0]]) - 2 * MARGIN
                uv = (torch.rand(1, SAMPLES, 2, generator=draw) * high).floor() + MARGIN
                tracks = xfeat.match(room[0].image, room[gap].image, uv, sharpness=SHARPNESS, **LOOK)
                a, b = (xfeat.extract_xfeat(net, room[k].image, **LOOK)[0] for k in (0, gap))
                match = xfeat.search_matches(a, b, uv[0], SHARPNESS)
                there, known = truth(room, 0, gap, uv)
                use = (known & tracks.valid)[0]
                matches["error"].append(((tracks.uv_1 - there)[0] * torch.tensor(b.gain))[use])
                matches["similarity"].append(match.similarity[use])
                matches["spread"].append(match.spread[use])
    return {k: torch.cat(v).double() for k, v in matches.items()}


def squares(matches: dict[str, Tensor], gain: float, unlike: float) -> Tensor:
    """Squared errors (M,) in units of what :func:`xfeat.noise` states."""
    cov = xfeat.match_covariance(matches["similarity"], matches["spread"], gain=gain, unlike=unlike)
    return (matches["error"] * torch.linalg.solve(cov, matches["error"])).sum(-1)


def fit(matches: dict[str, Tensor]) -> tuple[float, float]:
    """``GAIN`` and ``UNLIKE`` of matches that are no more than a cell off."""
    noise = matches["error"].square().sum(-1) < 1
    y = squares(matches, 1.0, 0.0)[noise].clamp_min(1e-12).log() - MEAN_LOG
    x = 1 - matches["similarity"][noise]
    slope = ((x - x.mean()) * y).sum() / (x - x.mean()).square().sum()
    return float((y.mean() - slope * x.mean()).exp()), float(slope)


def consistency(matches: dict[str, Tensor], gain: float, unlike: float) -> dict[str, float]:
    """What the constants are worth on some matches."""
    d = squares(matches, gain, unlike)
    away = matches["error"].square().sum(-1).sqrt()
    return {
        "n": len(d),
        "median_error_cells": float(away.median()),
        "wrong": float((away >= 1).double().mean()),
        "within_sigma": float((d < 1).double().mean()),
        "within_2sigma": float((d < 4).double().mean()),
    }


def main() -> int:
    """Fit, test, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    path = parser.parse_args().json
    torch.set_num_threads(1)
    with torch.no_grad():
        fitted, tested = matches(FITTED), matches(TESTED)
    gain, unlike = (float(f"{x:.2g}") for x in fit(fitted))
    limits = tested["similarity"].quantile(torch.tensor([1 / 3, 2 / 3], dtype=torch.float64))
    third = (tested["similarity"][:, None] > limits).sum(-1)
    rooms = {"paths": PATHS, "gaps": GAPS}
    rows = [
        {"name": "constants", "gain": gain, "unlike": unlike, "expected": EXPECTED},
        {"name": "fitted", "seeds": FITTED, **rooms, **consistency(fitted, gain, unlike)},
        {"name": "tested", "seeds": TESTED, **rooms, **consistency(tested, gain, unlike)},
    ]
    for k, (low, high) in enumerate(pairwise([0.0, *limits.tolist(), 1.0])):
        some = {name: v[third == k] for name, v in tested.items()}
        rows.append({"name": "tested", "similarity": (low, high), **consistency(some, gain, unlike)})
    text = json.dumps(rows, indent=1)
    print(text)
    if path is not None:
        path.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
