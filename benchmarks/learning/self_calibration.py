"""Self-calibration: focal length, depth scale and colour–depth time offset by gradient descent through ``MAP``.

    python benchmarks/learning/self_calibration.py                       the built-in room, one seed
    python benchmarks/learning/self_calibration.py --data holo_a room    also a capture below DHTORCH_DATA

A moving camera with known poses determines its own focal length (tracks must lie on their epipolar lines), the scale of
its depth sensor (sensed depth must equal triangulated depth) and the time of its depth (the sensor of another time was
elsewhere). All three are optimised together. At each step ``MAP`` draws pixels of some pairs anew, tracks them and
triangulates them under the capture's poses; two losses compare its answers with the tracks and with the depth sensor.
The gradient passes through the triangulation, the change to the sensor's view and the depth map.

A capture has errors of its own, which nothing tells apart from planted ones. The result is therefore a difference: the
errors recovered from the capture with planted ones, less those recovered from the capture as it is.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dhtorch import MAP, data
from dhtorch.data.recording import Recording
from dhtorch.experiments.baselines.device_pose import known_pose_fit
from dhtorch.functional import reprojection_loss, sigma_weighted_depth_loss
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.geometry.filters import gaussian_blur
from dhtorch.pytree import collate
from dhtorch.records import Camera, Frame, Pose
from dhtorch.runtime import storage
from dhtorch.synthetic import SyntheticRoom

#: Planted errors: focal length and depth too large by these fractions, and depth later than colour, in frames.
PLANTED = {"focal": 0.05, "scale": 0.08, "offset": 1}

#: Frames between the two views of a pair.
GAP = 2

#: Pairs of a step, pixels of a pair, and steps. Chosen on holo_a with PLANTED: two minutes a seed.
PAIRS, POINTS, STEPS = 8, 512, 120

#: First step sizes of Adam in the parameters' units, falling linearly to zero. Chosen on holo_a with PLANTED.
RATES = {"focal": 0.006, "scale": 0.008, "offset": 0.06}

#: Standard deviations of a tracked pixel coordinate, px, and of a sensed depth, relative: the weights of the losses.
TRACK_NOISE_PX, SENSOR_NOISE_REL = 0.5, 0.02

#: Blur of the depth maps, sigma as a fraction of their width: the slope of a surface, which is the gradient of the time
#: offset, would otherwise be that of the sensor's noise and steps. Chosen on holo_a with PLANTED.
BLUR = 0.011

#: Least fraction of returns in a blurred pixel, and largest relative change by the blur: beyond, there is an edge.
MIN_RETURNS, MAX_BLURRED_REL = 0.6, 0.05

Sampler = Callable[..., Tensor]


class Calibration(torch.nn.Module):
    """The errors of a capture: logarithms of stated / true focal length and sensed / true depth; frames that depth is
    later than colour."""

    def __init__(self) -> None:
        super().__init__()
        self.focal, self.scale, self.offset = (torch.nn.Parameter(torch.zeros(())) for _ in PLANTED)

    def camera(self, stated: Camera) -> Camera:
        """The camera without the error of its focal length."""
        return stated.replace(f=stated.f / self.focal.exp())

    def depth(self, sensed: Tensor) -> Tensor:
        """Depth without the error of its scale."""
        return sensed / self.scale.exp()

    def vector(self) -> Tensor:
        """The three errors, without a graph: fractions and frames."""
        return torch.stack((self.focal.expm1(), self.scale.expm1(), self.offset)).detach()


def load_capture(recording: Recording) -> Frame:
    """All frames of a recording as one batch.

    Raises:
        ValueError: no poses, or depth that is not registered to the pictures.
    """
    frames = collate(recording[k] for k in range(len(recording)))
    if frames.T_world_from_cam is None or frames.depth.shape[-2:] != frames.hw:
        raise ValueError(f"{recording.name}: expected poses, and depth at the pixels of the pictures")
    return frames.replace(T_world_from_cam=frames.T_world_from_cam.to(torch.float64))


def plant(capture: Frame, *, focal: float, scale: float, offset: int) -> Frame:
    """The capture with a wrong focal length, a wrong depth scale, and the depth of ``offset`` frames later."""
    later = (torch.arange(len(capture.depth)) + offset).clamp_max(len(capture.depth) - 1)  # the last are in no pair
    camera = capture.camera.replace(f=capture.camera.f * (1 + focal))
    return capture.replace(camera=camera, depth=capture.depth[later] * (1 + scale))


def blur_depth(depth: Tensor) -> Tensor:
    """Depth maps (B, H, W) -> blurred ones, and 1 where they are continuous surfaces (B, 2, H, W)."""
    sensed = (depth > 0).to(depth)
    total, mass = (gaussian_blur(x[:, None], BLUR * depth.shape[-1])[:, 0] for x in (depth, sensed))
    blurred = total / mass.clamp_min(MIN_RETURNS)
    change = (blurred - depth).abs()
    surface = (depth > 0) & (mass >= MIN_RETURNS) & (change < MAX_BLURRED_REL * depth)
    return torch.stack((blurred, surface.to(depth)), 1)


def read_depth(maps: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Maps of :func:`blur_depth` and pixels (B, N, 2) -> bilinear depth (B, N), and whether all of it is surface.

    Gradient: to the pixels, by the slope of the surface.
    """
    last = torch.tensor([maps.shape[-1] - 1, maps.shape[-2] - 1]).to(uv)
    depth, surface = torch.nn.functional.grid_sample(maps, (2 * uv / last - 1)[:, None], align_corners=True)[
        :, :, 0
    ].unbind(1)
    return depth, surface > 1 - 1e-4


def poses_at(world: Pose, k: Tensor) -> Pose:
    """Poses at fractional frame numbers, on the geodesics between frames. Gradient: to the frame numbers."""
    first = k.detach().floor().long().clamp(0, len(world.t) - 2)
    a, b = world[first], world[first + 1]
    return se3.compose(a, se3.exp((k - first)[:, None] * se3.log(se3.relative(b, a))))


def calibration_loss(
    calibration: Calibration, capture: Frame, maps: Tensor, k: Tensor, *, points: int, sample: Sampler
) -> Tensor:
    """Loss of the pairs (k, k + GAP): MAP's answers against the tracks, and against the sensor at its own time."""
    world = capture.T_world_from_cam
    assert world is not None
    camera = calibration.camera(capture.camera[k])
    reference = capture[k].replace(camera=camera, depth=calibration.depth(capture.depth[k]))
    T_1_from_0 = se3.relative(world[k], world[k + GAP]).to(torch.float32)
    pose = known_pose_fit(T_1_from_0, points)
    pose = pose.replace(sigma_px=torch.full_like(pose.sigma_px, TRACK_NOISE_PX))
    trace: dict[str, Any] = {}
    # No limit on the residual: points off their epipolar lines are what the focal length is seen by.
    method = MAP.replace(n=points, sample=sample, triangulate={"max_residual_px": None})
    estimate = method(reference, capture[k + GAP].replace(camera=camera), fit=pose, trace=trace)
    tracks, keep = trace["tracks"], estimate.keep
    cov = TRACK_NOISE_PX**2 * torch.eye(2).expand(*keep.shape, 2, 2)
    geometry = estimate.depth, tracks.uv_0, tracks.uv_1, T_1_from_0, camera, camera
    off_line = reprojection_loss(*geometry, cov=cov, keep=keep, kernel="cauchy")

    xyz = cam.unproject(camera, estimate.uv, torch.where(keep, estimate.depth, 1))
    at_sensor = poses_at(world, k + calibration.offset.double())
    xyz_sensor = se3.apply(se3.relative(world[k], at_sensor).to(torch.float32), xyz)
    sensed, surface = read_depth(maps[k], cam.project(camera, xyz_sensor))
    sensed = calibration.depth(sensed)
    sigma = torch.where(keep, estimate.sigma, 1).hypot(SENSOR_NOISE_REL * sensed)
    return off_line + sigma_weighted_depth_loss(xyz_sensor[..., 2], sensed, sigma, keep & surface, kernel="cauchy")


def random_pixels(generator: torch.Generator) -> Sampler:
    """Stage 1 of a method: other pixels at every call."""

    def sample(hw: tuple[int, int], n: int, **like: Any) -> Tensor:
        return (torch.rand(n, 2, generator=generator) * torch.tensor([hw[1] - 1.0, hw[0] - 1.0])).to(**like)

    return sample


def draw_pairs(n: int, size: int, generator: torch.Generator) -> Iterator[Tensor]:
    """First frames of ``size`` pairs, endlessly; all of ``n`` pairs come before one comes again."""
    queue: list[int] = []
    while True:
        while len(queue) < size:
            queue += torch.randperm(n, generator=generator).tolist()
        yield torch.tensor(queue[:size])
        queue = queue[size:]


def calibrate(
    capture: Frame, *, seed: int = 0, steps: int = STEPS, pairs: int = PAIRS, points: int = POINTS
) -> dict[str, float]:
    """Capture -> its errors, the mean over the last third of the steps: keys of ``PLANTED``."""
    generator = torch.Generator().manual_seed(seed)
    calibration = Calibration()
    groups = [{"params": [getattr(calibration, name)], "lr": rate} for name, rate in RATES.items()]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1 - step / steps)
    maps, sample = blur_depth(capture.depth), random_pixels(generator)
    path = []
    for _, k in zip(range(steps), draw_pairs(len(capture.depth) - GAP, pairs, generator), strict=False):
        optimiser.zero_grad()
        calibration_loss(calibration, capture, maps, k, points=points, sample=sample).backward()
        optimiser.step()
        schedule.step()
        path.append(calibration.vector())
    mean = torch.stack(path[2 * steps // 3 :]).mean(0)
    return dict(zip(PLANTED, mean.tolist(), strict=True))


def recovered_errors(planted: Mapping[str, float], as_it_is: Mapping[str, float]) -> dict[str, float]:
    """Errors of two runs -> what the planted run has beyond the other: ratios as fractions, and frames."""
    ratio = {name: (1 + planted[name]) / (1 + as_it_is[name]) - 1 for name in ("focal", "scale")}
    return ratio | {"offset": planted["offset"] - as_it_is["offset"]}


def run(capture: Frame, name: str, *, seed: int, **options: Any) -> dict[str, Any]:
    """One seed: errors of the capture as it is and with planted ones, what was recovered, and the processor's time."""
    start = time.process_time()
    as_it_is = calibrate(capture, seed=seed, **options)
    planted = calibrate(plant(capture, **PLANTED), seed=seed, **options)
    return {
        "data": name,
        "seed": seed,
        "n_frames": len(capture.depth),
        "planted": PLANTED,
        "as_it_is": as_it_is,
        "with_planted": planted,
        "recovered": recovered_errors(planted, as_it_is),
        "threads": torch.get_num_threads(),
        "cpu_s": time.process_time() - start,
    }


def open_recording(name: str) -> Recording:
    """A capture by its path or its name below DHTORCH_DATA; ``room`` is the built-in room."""
    if name == "room":
        return SyntheticRoom(path="orbit", n_frames=24, step_m=0.06, hw=(240, 320), lidar="exact")
    return data.open(name if Path(name).exists() else data.scenes_root(None) / name)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data",
        nargs="+",
        default=["room"],
        help="captures with poses and registered depth: paths, names below DHTORCH_DATA, or room, the built-in one",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.data:
        capture = load_capture(open_recording(name))
        for seed in options.seeds:
            row = run(capture, name, seed=seed)
            recovered = row["recovered"]
            print(
                f"{name}, seed {seed}: focal {recovered['focal']:+.2%}, scale {recovered['scale']:+.2%}, "
                f"offset {recovered['offset']:+.3f} frames, {row['cpu_s']:.0f} s of processor time",
                flush=True,
            )
            rows.append(row)
    if options.json:
        storage.write_json(options.json, storage.to_strict_json(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
