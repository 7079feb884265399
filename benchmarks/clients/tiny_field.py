"""A small radiance field with and without our depth: error of held-out depth and PSNR of held-out pictures.

python benchmarks/clients/tiny_field.py --json benchmarks/results/tiny_field.json

A voxel grid of density and colour is fitted to every second picture of a recording. Returns beyond ``--cutoff`` are
hidden from everything but the evaluation. Three fits differ in their depth alone: none, the returns that are left, and
these with the depth that ``complete_depth`` adds from the same pictures; its pixels are weighted by 1 / sigma. Pictures
between the fitted ones, and all hidden returns there, evaluate.
"""

import argparse
import os
import time
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch import data
from dhtorch.geometry import camera as cameras
from dhtorch.geometry import se3
from dhtorch.metrics.holdout import range_split
from dhtorch.pipeline import completion, dense
from dhtorch.pytree import stack
from dhtorch.records import Frame
from dhtorch.runtime import storage

#: Side of the pictures, px; distances of samples along a ray, m; samples of a ray; rays of a step.
WIDTH, NEAR_M, FAR_M, SAMPLES, RAYS = 135, 0.3, 6.0, 64, 1024
#: Step at which the grid gets each number of voxels on its longest side; all steps; rate; weight of the depth term.
GRIDS, STEPS, RATE, DEPTH_WEIGHT = {0: 32, 150: 64, 350: 96}, 500, 0.08, 0.1
#: Frames from a reference view to its candidate source views, all of them fitted ones.
OFFSETS = (-8, -6, -4, -2, 2, 4, 6, 8)


def rays_of(frame: Frame, hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Origins and directions (h · w, 3) in the world of the pixels of a map of size ``hw``; z = 1 along the axis."""
    T = frame.T_world_from_cam
    direction = se3.rotate(T.R.float(), cameras.rays(frame.camera, dense.map_pixel_centres(frame, hw)[None]))[0]
    return T.t.float().expand(len(direction), 3), direction


class Field(torch.nn.Module):
    """Density and colour on a grid over a box, interpolated."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.low, self.size = low, high - low
        self.grid = torch.nn.Parameter(torch.zeros(1, 4, 2, 2, 2))

    def refine(self, side: int) -> None:
        """Interpolate the grid to ``side`` voxels on the longest side."""
        shape = (self.size / self.size.max() * side).ceil().long().clamp_min(2).flip(0).tolist()
        self.grid = torch.nn.Parameter(F.interpolate(self.grid.detach(), shape, mode="trilinear", align_corners=True))

    def forward(self, origin: Tensor, direction: Tensor, noise: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Rays (n, 3) -> colour (n, 3), weights (n, S) and depths of the samples (n, S)."""
        jitter = torch.rand(len(origin), SAMPLES) if noise else torch.full((len(origin), SAMPLES), 0.5)
        z = NEAR_M * (FAR_M / NEAR_M) ** ((torch.arange(SAMPLES) + jitter) / SAMPLES)
        xyz = origin[:, None] + z[..., None] * direction[:, None]
        where = 2 * (xyz - self.low) / self.size - 1
        value = F.grid_sample(self.grid, where[None, None], align_corners=True, padding_mode="border")[0, :, 0]
        step = torch.diff(z, append=z[:, -1:] * 1.05) * direction.norm(dim=-1, keepdim=True)
        opacity = 1 - torch.exp(-F.softplus(value[0] * 5 - 2) * step)
        clear = torch.cumprod(torch.cat((torch.ones_like(opacity[:, :1]), 1 - opacity + 1e-7), 1), 1)[:, :-1]
        weight = opacity * clear
        return (weight[..., None] * torch.sigmoid(value[1:]).movedim(0, -1)).sum(1), weight, z


def depth_of(weight: Tensor, z: Tensor) -> Tensor:
    """Depth (n,) at which half of a ray's weight is passed."""
    share = weight.cumsum(1) / weight.sum(1, keepdim=True).clamp_min(1e-6)
    return z.gather(1, (share < 0.5).sum(1, keepdim=True).clamp_max(SAMPLES - 1))[:, 0]


def fit(columns: dict[str, Tensor], box: tuple[Tensor, Tensor], steps: int) -> Field:
    """Fit a field to rays with colour, and to depth where its weight is positive."""
    torch.manual_seed(0)
    field, optimizer = Field(*box), None
    for step in range(steps):
        if step in GRIDS or optimizer is None:
            field.refine(GRIDS[step])
            optimizer = torch.optim.Adam(field.parameters(), RATE)
        rows = torch.randint(len(columns["rgb"]), (RAYS,))
        origin, direction, rgb, depth, trust = (columns[k][rows] for k in ("o", "d", "rgb", "depth", "trust"))
        colour, weight, z = field(origin, direction, noise=True)
        loss = (colour - rgb).square().mean()
        if bool((trust > 0).any()):  # the weights of a ray gather at its depth
            off = ((z / depth.clamp_min(NEAR_M)[:, None] - 1).abs().clamp_max(1) * weight).sum(1) + 1 - weight.sum(1)
            loss = loss + DEPTH_WEIGHT * (off * trust).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return field


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", default="holo_a", help="below DHTORCH_DATA")
    for name, kind, default in (("--cutoff", float, 2.0), ("--steps", int, STEPS)):
        parser.add_argument(name, type=kind, default=default)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    began, recording = time.perf_counter(), data.open(Path(os.environ["DHTORCH_DATA"]) / args.recording)
    fitted, unseen = range(0, len(recording), 2), range(1, len(recording), 4)
    visible = {k: range_split(recording[k].to(torch.float32), args.cutoff) for k in fitted}
    hw = dense.map_hw(recording[0].hw, WIDTH)
    rows: dict[str, list[Tensor]] = {k: [] for k in ("o", "d", "rgb", "sensor", "ours", "trust")}
    for k, frame in visible.items():
        others = stack([visible[k + j] for j in OFFSETS if k + j in visible])
        options = {"size": WIDTH, "planes": 64, "calibration": completion.default_calibration()}
        maps = completion.complete_depth(frame, others, **options)
        depth, rel = (x[0].flatten().nan_to_num() for x in (maps.depth, maps.sigma / maps.depth))
        rows["sensor"].append(torch.where(maps.source[0].flatten() == 1, depth, 0.0))
        rows["ours"].append(depth)
        rows["trust"].append(torch.where(depth > 0, 0.02 / (0.02 + rel), 0.0))
        rows["rgb"].append(F.interpolate(frame.image.float(), hw, mode="area")[0].flatten(1).T / 255)
        for name, x in zip("od", rays_of(frame, hw), strict=True):
            rows[name].append(x)
    whole = {name: torch.cat(parts) for name, parts in rows.items()}
    ends = torch.cat((whole["o"], whole["o"] + 5 * whole["d"]))
    box, prepared, table = (ends.amin(0), ends.amax(0)), time.perf_counter() - began, []
    for name, depth in (("none", 0 * whole["ours"]), ("sensor", whole["sensor"]), ("ours", whole["ours"])):
        start, columns = time.perf_counter(), {**whole, "depth": depth, "trust": whole["trust"] * (depth > 0)}
        field, errors, squares = fit(columns, box, args.steps), [], []
        spent = time.perf_counter() - start
        with torch.no_grad():
            for frame in (recording[k].to(torch.float32) for k in unseen):
                colour, weight, z = field(*rays_of(frame, hw), noise=False)
                rgb = F.interpolate(frame.image.float(), hw, mode="area")[0].flatten(1).T / 255
                truth = F.interpolate(frame.depth[:, None], hw, mode="nearest")[0, 0].flatten()
                hidden = truth > args.cutoff
                squares.append((colour - rgb).square().mean())
                errors.append((depth_of(weight, z)[hidden] / truth[hidden] - 1).abs())
        off, psnr = torch.cat(errors), [-10 * float(torch.log10(x)) for x in squares]
        row = {"recording": args.recording, "cutoff_m": args.cutoff, "depth": name, "steps": args.steps}
        row |= {"depth_pixels": float((depth > 0).float().mean()), "median_rel": float(off.median())}
        row |= {"mean_rel": float(off.clamp_max(1).mean()), "share_within_10": float((off < 0.1).float().mean())}
        table.append(row | {"psnr": sum(psnr) / len(psnr), "fit_s": round(spent, 1), "depth_s": round(prepared, 1)})
        print(table[-1], flush=True)
    if args.json:
        storage.write_json(args.json, table)


if __name__ == "__main__":
    main()
