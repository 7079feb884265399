"""Samples per second of a data loader, with and without the transform, for 0, 1 and 2 workers.

    python benchmarks/loader.py --json benchmarks/results/loader.json

The plain loader decodes a JPEG and a 16-bit PNG with the depth, resizes both where asked for, and resizes the picture
to 224×224 for a network; only that leaves the worker. ``single`` is one view per sample, of which the transform's
front end alone is asked; ``pair`` is two views, and beside the transform stands the same with OpenCV in its stages.
Rows of mode ``compiled`` use the compiled code of ``python -m dhtorch.ops``. Rows
with ``by_batch`` collate in the worker first and extend the whole batch at once (``batched=True``): the same answers.
Bars are about rows without workers (``workers0``).
``ours_ms`` and ``peer_ms`` are milliseconds per sample in the steady state, workers included. In ``scaling`` rows
``peer_ms`` is what two workers would take per sample if the transform scaled from one worker to two as the plain
loader does. In ``step`` rows the transform alone stands beside a forward pass of DINOv2 (random weights).

Pairs of TUM fr1/desk where DHTORCH_DATA is set, else of the built-in room; every process, that without workers too, is
set up by ``one_thread``: one thread, and what is freed is kept.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import harness
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from dhtorch import PAPER, data
from dhtorch.experiments.baselines import dinov2, opencv
from dhtorch.geometry import camera as cam
from dhtorch.stages import triangulate
from dhtorch.synthetic.recording import SyntheticRoom
from dhtorch.transforms import ExtendDepth, ExtendedDataset, one_thread

SIDE = 224
BATCH = 8
STRETCH = 2  # batches that make one time
ROUNDS = 3  # turns of each loader
SIZES = {"224x224": (SIDE, SIDE), "640x480": (480, 640)}
BARS = "640x480"
#: Loaders that use compiled code, and which transform they are.
COMPILED_SIDES = {"transform_compiled": "transform", "by_batch_compiled": "by_batch"}
NETWORKS = {"dinov2_l": {}, "dinov2_s": {"hidden": 384, "layers": 12, "heads": 6}}
OPENCV = PAPER.replace(
    track=opencv.opencv_lucas_kanade,
    pose=opencv.opencv_pnp_ransac,
    triangulate=partial(triangulate.two_view, solver=opencv.opencv_triangulate),
)


class Encoded(Dataset[Any]):
    """Views as JPEG and depth as 16-bit PNG, in memory, repeated; decoded, resized and handed out when asked for.

    ``light`` = without the pictures in full size and the depth, of which the network has no use.
    """

    def __init__(
        self, pairs: list[dict[str, Any]], hw: tuple[int, int], keys: Sequence[str], length: int, light: bool = False
    ) -> None:
        self.pairs, self.hw, self.keys, self.length, self.light = pairs, hw, keys, length, light

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, i: int) -> dict[str, Any]:
        out = self.decoded(i)
        views = {key: out[key] for key in self.keys}
        small = {f"{k}_{SIDE}": cv2.resize(v, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for k, v in views.items()}
        if self.light:
            out = {k: v for k, v in out.items() if k not in (*self.keys, "depth")}
        return {**small, **out}

    def decoded(self, i: int) -> dict[str, Any]:
        """One sample as the transform reads it."""
        pair, wh = self.pairs[i % len(self.pairs)], (self.hw[1], self.hw[0])
        views = {key: cv2.imdecode(pair[key], cv2.IMREAD_COLOR_RGB) for key in self.keys}
        depth = cv2.imdecode(pair["depth"], cv2.IMREAD_UNCHANGED)
        if depth.shape != self.hw:
            views = {key: cv2.resize(v, wh, interpolation=cv2.INTER_AREA) for key, v in views.items()}
            depth = cv2.resize(depth, wh, interpolation=cv2.INTER_NEAREST)
        return {**views, "depth": depth, "intrinsics": pair["intrinsics"], "index": i}


def encoded() -> tuple[str, tuple[int, int], list[dict[str, Any]]]:
    """Name, image size and eight pairs."""
    root = os.environ.get("DHTORCH_DATA")
    if root:
        recording, near, gap = data.open(Path(root) / "tum_fr1_desk9"), 1.0, 4
    else:
        recording, near, gap = SyntheticRoom(n_frames=9, lidar="exact"), 2.0, 6
    pairs = []
    for i in range(min(8, len(recording) - gap)):
        a, b = recording[i], recording[i + gap]
        mm = torch.where(a.depth[0] <= near, a.depth[0] * 1000, 0.0).round().numpy().astype(np.uint16)
        pictures = {"image": a.image[0], "other": b.image[0]}
        pair = {
            k: cv2.imencode(".jpg", v.permute(1, 2, 0).numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            for k, v in pictures.items()
        }
        pair |= {"depth": cv2.imencode(".png", mm)[1], "intrinsics": cam.to_matrix(a.camera)[0].numpy()}
        pairs.append(pair)
    return recording.name, recording[0].hw, pairs


def per_sample(dataset: Encoded | ExtendedDataset, workers: int, repeats: int, clock: str) -> Iterator[float]:
    """Milliseconds per sample, one number for each stretch, after one to warm up; of workers always by the wall."""
    now = harness.CLOCKS["wall" if workers else clock]
    options: dict[str, Any] = {"worker_init_fn": one_thread, "multiprocessing_context": "fork"} if workers else {}
    collate = dataset.collate if isinstance(dataset, ExtendedDataset) else None
    loader = iter(DataLoader(dataset, BATCH, num_workers=workers, collate_fn=collate, **options))
    for k in range(repeats + 1):
        start = now()
        for _ in range(STRETCH):
            next(loader)
        if k:
            yield 1e3 * (now() - start) / (STRETCH * BATCH)


def mode_of(side: str) -> str:
    """How a result file calls what a loader uses."""
    return "compiled" if side in COMPILED_SIDES else "eager"


class Bench:
    """One image size and one kind of sample: the loaders that are compared, and their rows."""

    def __init__(self, size: str, mode: str, n: int, repeats: int, clock: str) -> None:
        (self.name, self.hw, self.pairs), self.size, self.mode, self.n = encoded(), size, mode, n
        self.repeats, self.clock = max(repeats // ROUNDS, 1), clock
        self.keys = ("image",) if mode == "single" else ("image", "other")
        self.transforms = {"transform": self.transform(), "by_batch": self.transform(batched=True)}
        self.transforms["plain_loader"] = None
        self.transforms |= {side: self.transforms[COMPILED_SIDES[side]] for side in COMPILED_SIDES}
        if mode == "pair":
            self.transforms["opencv_stages"] = self.transform(method=OPENCV)
        self.times: dict[tuple[str, int], list[float]] = {}

    def transform(self, **options: Any) -> ExtendDepth:
        """For the samples of this loader."""
        other = {"other_image": "other"} if self.mode == "pair" else {}
        return ExtendDepth(depth_unit="mm", intrinsics_hw=self.hw, tokens_hw=(SIDE, SIDE), n=self.n, **other, **options)

    def encoded(self, workers: int, *, light: bool = False) -> Encoded:
        """Long enough for one turn."""
        length = BATCH * (STRETCH * (self.repeats + 1) + 2 * workers)
        return Encoded(self.pairs, SIZES[self.size], self.keys, length, light)

    def dataset(self, transform: ExtendDepth | None, workers: int) -> Encoded | ExtendedDataset:
        """What leaves the worker are small pictures and, with a transform, what it tells."""
        if transform is None:
            return self.encoded(workers, light=True)
        consumed = (*self.keys, "depth")
        return ExtendedDataset(self.encoded(workers), transform, by_batch=transform.batched, consumed=consumed)

    def measure(self, counts: Sequence[int]) -> None:
        """Loaders and numbers of workers take turns, so that a busy minute hits all alike."""
        for _, name, workers in product(range(ROUNDS), self.transforms, counts):
            dataset = self.dataset(self.transforms[name], workers)
            with harness.with_compiled_operators() if name in COMPILED_SIDES else nullcontext():
                durations = list(per_sample(dataset, workers, self.repeats, self.clock))
            self.times.setdefault((name, workers), []).extend(durations)
        for workers in counts:
            rates = {name: 1e3 / median(self.times[name, workers]) for name in self.transforms}
            rates_text = ", ".join(f"{name} {rate:.1f}" for name, rate in rates.items())
            print(f"{self.mode} {self.size}, {workers} workers: samples/s {rates_text}", flush=True)

    def rows(self, workers: int) -> list[dict[str, Any]]:
        """Against the plain loader and against OpenCV; the bars stand on the larger pictures."""
        barred = {"single": "plain_loader", "pair": "opencv_stages"}[self.mode]
        name = f"loader_{self.mode}_{self.size}_workers{workers}"
        return [
            harness.row(
                f"{name}_by_batch" if side.startswith("by_batch") else name,
                self.times[side, workers],
                peer,
                self.times[peer, workers],
                mode=mode_of(side),
                **self.common(peer == barred and not workers),
            )
            for side in self.ours()
            for peer in self.transforms
            if peer not in self.ours()
        ]

    def scaling(self, side: str) -> dict[str, Any]:
        """Two workers, against the plain loader's gain from one to two."""
        one, plain_one, plain_two = (
            median(self.times[key]) for key in ((side, 1), ("plain_loader", 1), ("plain_loader", 2))
        )
        expected = [one * plain_two / plain_one] * 2
        name = f"loader_scaling_{self.mode}_{self.size}"
        name = f"{name}_by_batch" if side.startswith("by_batch") else name
        times = self.times[side, 2]
        return harness.row(name, times, "plain_scaling", expected, mode=mode_of(side), **self.common(True))

    def ours(self) -> list[str]:
        """The loaders that are no peer."""
        return [side for side in self.transforms if COMPILED_SIDES.get(side, side) in ("transform", "by_batch")]

    def common(self, bar: bool) -> dict[str, Any]:
        """Fields of a row."""
        return {"n": self.n, "batch": BATCH, "bar": bar and self.size == BARS}


def steps(benches: Sequence[Bench], repeats: int, clock: str) -> Iterator[dict[str, Any]]:
    """The transform alone beside a forward pass of a network, and the share of both that it takes."""
    picture = torch.zeros(1, 3, SIDE, SIDE)
    for peer, sizes in NETWORKS.items():
        try:
            network = dinov2.load_dinov2(**sizes)
        except ImportError as error:
            print(f"step rows skipped: {error}")
            return
        for bench in benches:
            transform, sample = bench.transforms["transform"], bench.encoded(0).decoded(0)
            calls = [partial(transform, sample), partial(network, pixel_values=picture)]
            with torch.no_grad():
                ours, theirs = harness.in_turn(calls, repeats=repeats, warm_up=1, clock=clock)
            record = harness.row(f"step_{bench.mode}_{bench.size}", ours, peer, theirs, n=bench.n)
            share = record["ours_ms"] / (record["ours_ms"] + record["peer_ms"])
            print(f"{bench.mode} {bench.size}: {100 * share:.2f} % of the transform and a {peer} forward", flush=True)
            yield record


def main() -> None:
    arguments = harness.arguments(str(__doc__).splitlines()[0])
    arguments.add_argument("--samples", type=int, default=512, help="points per image")
    arguments.add_argument("--workers", type=int, nargs="+", help="instead of 0 1 2")
    options = arguments.parse_args()
    one_thread()  # as a worker is set up, and what is measured without workers, too
    counts = options.workers or ([0, 1, 2, 4] if options.full else [0, 1, 2])
    modes = [(size, mode) for size in SIZES for mode in ("single", "pair")]
    benches = [Bench(*each, options.samples, options.repeats, options.clock) for each in modes]
    print(f"pairs of {benches[0].name}")
    rows = []
    for bench in benches:
        bench.measure(counts)
        for workers in counts:
            rows += bench.rows(workers)
        if {1, 2} <= set(counts):
            rows += [bench.scaling(side) for side in bench.ours()]
    rows += steps(benches, max(options.repeats // 5, 3), options.clock)
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
