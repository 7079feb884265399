"""Samples per second of a data loader, with and without the transform, for 0, 1 and 2 workers.

    python benchmarks/loader.py --json benchmarks/results/loader.json

The plain loader decodes a JPEG, resizes it to 224×224 and decodes the depth from PNG, for two views; beside it the same
with ``ExtendDepth``, and with the same seats filled by OpenCV. ``ours_ms`` and ``peer_ms`` are milliseconds per sample
in the steady state, workers included; their inverse times 1000 is printed as samples per second. Pairs of TUM fr1/desk
where DHTORCH_DATA is set, else of the built-in room; every process uses one thread.
"""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import harness
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from dhtorch import data, extend
from dhtorch.baselines import opencv
from dhtorch.data.synthetic import SyntheticRoom
from dhtorch.geometry import camera as cam
from dhtorch.stages import triangulate
from dhtorch.transform import ExtendDepth, ExtendedDataset, one_thread

SIDE = 224
OPENCV = partial(
    extend,
    track=opencv.lucas_kanade,
    pose=opencv.pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.triangulate),
)


class Encoded(Dataset[Any]):
    """Two views as JPEG and depth as 16-bit PNG, in memory, repeated; decoded and resized when asked for."""

    def __init__(self, pairs: list[dict[str, Any]], hw: tuple[int, int], length: int) -> None:
        self.pairs, self.hw, self.length = pairs, hw, length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int) -> dict[str, Any]:
        if not 0 <= i < self.length:
            raise IndexError(i)
        pair, wh = self.pairs[i % len(self.pairs)], (self.hw[1], self.hw[0])
        depth = cv2.imdecode(pair["depth"], cv2.IMREAD_UNCHANGED)
        out = {
            key: cv2.resize(cv2.imdecode(pair[key], cv2.IMREAD_COLOR_RGB), wh, interpolation=cv2.INTER_AREA)
            for key in ("image", "other")
        }
        small = {k: cv2.resize(v, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for k, v in out.items()}
        depth = cv2.resize(depth, wh, interpolation=cv2.INTER_NEAREST)
        network = {f"{k}_{SIDE}": v for k, v in small.items()}
        return {**out, **network, "depth": depth.astype(np.int32), "intrinsics": pair["intrinsics"], "index": i}


def encoded() -> tuple[str, tuple[int, int], list[dict[str, Any]]]:
    """Name, image size and eight pairs."""
    root = os.environ.get("DHTORCH_DATA")
    if root:
        recording: Any = data.open(Path(root) / "tum_fr1_desk9", near=1.0, gap=4)
    else:
        recording = SyntheticRoom(n_frames=9, lidar="exact")
    pairs = []
    for i in range(min(8, len(recording) - recording.gap)):
        a, b = recording[i], recording[i + recording.gap]
        mm = torch.where(a.depth[0] <= recording.near, a.depth[0] * 1000, 0.0).round().numpy().astype(np.uint16)
        pictures = {"image": a.image[0], "other": b.image[0]}
        pair = {
            k: cv2.imencode(".jpg", v.permute(1, 2, 0).numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            for k, v in pictures.items()
        }
        pair |= {"depth": cv2.imencode(".png", mm)[1], "intrinsics": cam.to_matrix(a.camera)[0].numpy()}
        pairs.append(pair)
    return recording.name, recording[0].hw, pairs


def per_sample(dataset: Any, workers: int, batch: int, repeats: int) -> list[float]:
    """Milliseconds per sample, one number for each stretch of four batches, after one stretch to warm up."""
    options: dict[str, Any] = {"worker_init_fn": one_thread, "multiprocessing_context": "fork"} if workers else {}
    loader = iter(DataLoader(dataset, batch, num_workers=workers, **options))
    times = []
    for k in range(repeats + 1):
        start = time.perf_counter()
        for _ in range(4):
            next(loader)
        if k:
            times.append(1e3 * (time.perf_counter() - start) / (4 * batch))
    del loader
    return times


def measure(
    size: tuple[int, int], workers: int, repeats: int, n: int, batch: int, found: tuple[str, Any, Any]
) -> list[dict[str, Any]]:
    """Rows of one image size and number of workers: against the plain loader, and against OpenCV in the seats."""
    _, native, pairs = found
    dataset = Encoded(pairs, size, 4 * batch * (repeats + 1 + 2 * max(workers, 1)))
    views = {"depth_unit": "mm", "other_image": "other", "intrinsics_hw": native, "tokens_hw": (SIDE, SIDE)}
    sets = [
        ExtendedDataset(dataset, ExtendDepth(**views, n=n)),
        dataset,
        ExtendedDataset(dataset, ExtendDepth(**views, n=n, method=OPENCV)),
    ]
    stretches: list[list[float]] = [[], [], []]
    for _ in range(2):  # in turn, so that a busy minute hits all alike
        for own, one in zip(stretches, sets, strict=True):
            own.extend(per_sample(one, workers, batch, max(repeats // 2, 1)))
    name = f"loader_{size[1]}x{size[0]}_workers{workers}"
    rates = ", ".join(f"{1e3 / np.median(s):.1f}" for s in stretches)
    print(f"{name}: samples/s {rates} (with the transform, plain, OpenCV seats)")
    common = {"n": n, "batch": batch, "mode": "eager"}
    return [
        harness.row(name, stretches[0], "plain_loader", stretches[1], **common),
        harness.row(name, stretches[0], "opencv_seats", stretches[2], **common, bar=True),
    ]


def main() -> None:
    arguments = harness.arguments(str(__doc__).splitlines()[0])
    arguments.add_argument("--samples", type=int, default=512, help="points per image")
    options = arguments.parse_args()
    harness.set_threads(1)
    found = encoded()
    print(f"pairs of {found[0]}")
    sizes = [(SIDE, SIDE), (480, 640)]
    counts = (0, 1, 2, 4) if options.full else (0, 1, 2)
    rows = [
        row
        for size in sizes
        for workers in counts
        for row in measure(size, workers, options.repeats, options.samples, 8, found)
    ]
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
