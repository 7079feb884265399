"""Time per pair of the search for points, against ``cv2.calcOpticalFlowPyrLK``, and how well both find them.

    python benchmarks/lk.py --json benchmarks/results/lk.json

*Forward* is both pyramids and one search; mode ``cached`` has the pyramid of image 0 made before, as for a reference
view seen from many views. Mode ``compiled`` uses ``python -m dhtorch.ops``. *Forward-backward* is
``lucas_kanade`` with all its fields against two calls of OpenCV. Times are of real pairs where DHTORCH_DATA is set,
else of the built-in room; both sides take turns in one process.

Errors of forward rows: share of points more than 1 px from where a known warp of the same images, with noise, put them.
Errors of forward-backward rows: share of points of the real pairs on which the two verdicts differ.
"""

import os
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import harness
import numpy as np
import torch
from torch import Tensor

from dhtorch import data
from dhtorch.data.pairs import by_gap
from dhtorch.experiments.baselines import opencv
from dhtorch.geometry import lucas_kanade as lk
from dhtorch.geometry.determinism import ELEMENTWISE_LANES
from dhtorch.geometry.patches import luma
from dhtorch.geometry.pyramid import Pyramid, PyramidCache, build_pyramid
from dhtorch.records import TrackHint
from dhtorch.stages import track
from dhtorch.stages.sample import spiral
from dhtorch.synthetic.recording import SyntheticRoom

#: Real pairs: folder → gap; all 640x480.
SCENES = {"tum_fr1_desk9": 4, "7s_redkitchen_000": 20, "7s_redkitchen_200": 20, "7s_redkitchen_600": 20}
LEVELS = 4


#: Multiply-adds of one pixel of a window on one level: three planes read between pixels (3 each), five moments, and 4
#: steps that read image 1 between pixels (3) and correlate it with two gradients.
PER_PIXEL = 3 * 3 + 5 + 4 * (3 + 2)

#: Bytes of one pixel of both pyramids: written and read once, grey value and two gradients of image 0, grey value of
#: image 1, in single precision; the coarser levels add a third.
PER_PICTURE_PIXEL = 2 * 4 * (3 + 1) * 4 / 3


def work(n: int, window: int, hw: tuple[int, int], ways: int = 1) -> harness.Work:
    """Least work of a pair's search, there (1) or there and back (2)."""
    return harness.Work(ways * n * LEVELS * window**2 * PER_PIXEL, PER_PICTURE_PIXEL * hw[0] * hw[1])


def pairs(count: int) -> tuple[Tensor, Tensor]:
    """Grey images 0 and 1 (count, 1, H, W) uint8, taken from the scenes in turn."""
    root = os.environ.get("DHTORCH_DATA")
    captures = [(data.open(Path(root) / name), gap) for name, gap in SCENES.items()] if root else [(SyntheticRoom(), 6)]
    chosen = [(recording, by_gap(recording, gap)) for recording, gap in captures]
    views: list[list[Tensor]] = [[], []]
    for k in range(count):
        recording, pairs = chosen[k % len(chosen)]
        pair = pairs[k // len(chosen) % len(pairs)]
        for side, i in zip(views, pair, strict=True):
            grey = luma(recording[i].image, -3) * 255
            side.append(grey.round().to(torch.uint8).reshape(1, *grey.shape[-2:]))
    return torch.stack(views[0]), torch.stack(views[1])


def forward(image_0: Tensor, image_1: Tensor, uv: Tensor, window: int, pyramid_0: Pyramid | None = None):
    """Positions (B, N, 2) and whether they were found (B, N)."""
    B, N, _ = uv.shape
    assert B * N % ELEMENTWISE_LANES == 0
    o = lk.SearchOptions(window, 30, 0.01, track.MIN_TRACK_EIGENVALUE, "none")
    with torch.no_grad():
        source = build_pyramid(image_0, LEVELS, window) if pyramid_0 is None else pyramid_0
        target = build_pyramid(image_1, LEVELS, window, gradients=False)
        x = uv.permute(2, 0, 1).reshape(2, B * N).contiguous()
        batch = torch.arange(B).repeat_interleave(N)
        known = lk.is_between(x, *source.bounds())
        every = {"known": known, "begun": known, "near_levels": len(source.levels), "alike": True}
        d, valid, _ = lk.search_displacements(source, target, o, x, torch.zeros_like(x), batch, **every)
    return (x + d).reshape(2, B, N).permute(1, 2, 0), valid.reshape(B, N)


def forward_opencv(image_0: Tensor, image_1: Tensor, uv: Tensor, window: int):
    """The same by OpenCV, pair after pair."""
    options: Any = {"winSize": (window, window), "maxLevel": LEVELS - 1, "criteria": (3, 30, 0.01)}
    flow: Any = cv2.calcOpticalFlowPyrLK
    results = [
        flow(a[0].numpy(), b[0].numpy(), x.numpy()[:, None], None, **options)[:2]
        for a, b, x in zip(image_0, image_1, uv, strict=True)
    ]
    return tuple(
        torch.from_numpy(np.stack(y)).squeeze(-1 if k else 2) for k, y in enumerate(zip(*results, strict=True))
    )


def warped(images: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Each image turned, scaled, shifted by up to 4°, 5 % and 12 px with noise of 2 grey values; where points went."""
    draw = np.random.default_rng(0)
    H, W = images.shape[-2:]
    moved, truth = [], []
    for image, x in zip(images[:, 0].numpy(), uv.numpy(), strict=True):
        M = cv2.getRotationMatrix2D((W / 2, H / 2), draw.uniform(-4, 4), draw.uniform(0.95, 1.05))
        M[:, 2] += draw.uniform(-12, 12, 2)
        b = cv2.warpAffine(image, M, (W, H), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        moved.append(np.clip(b + draw.normal(0, 2, b.shape), 0, 255).round().astype(np.uint8))
        truth.append(x @ M[:, :2].T + M[:, 2])
    return torch.from_numpy(np.stack(moved))[:, None], torch.from_numpy(np.stack(truth))


def misses(image: Tensor, uv: Tensor, window: int) -> list[float]:
    """Fraction of points that stay inside the image and are found more than 1 px off: ours, compiled, and OpenCV's."""
    moved, truth = warped(image, uv)
    high = torch.tensor([image.shape[-1] - 1, image.shape[-2] - 1])
    inside = ((truth >= 0) & (truth <= high)).all(-1)
    results = []
    for method in (forward, harness.with_compiled_operators()(forward), forward_opencv):
        uv_1, ok = method(image, moved, uv, window)
        missed = ~ok.bool() | ((uv_1 - truth).norm(dim=-1) > 1)
        results.append(missed[inside].double().mean().item())
    return results


def measure(n: int, batch: int, window: int, repeats: int) -> list[dict[str, Any]]:
    """Rows of one size: forward, the same compiled or with the reference view's pyramid cached, forward-backward."""
    image_0, image_1 = pairs(batch)
    uv = spiral(tuple(image_0.shape[-2:]), n).float().expand(batch, n, 2).contiguous()
    views, suffix = (image_0, image_1, uv), f"_w{window}_n{n}" + (f"_b{batch}" if batch > 1 else "")
    kept = PyramidCache(image_0)
    reference = kept(LEVELS, window)
    options: Any = {"window": window, "levels": LEVELS}
    compiled = harness.with_compiled_operators()
    calls = {
        "lk eager": partial(forward, *views, window),
        "lk cached": partial(forward, *views, window, reference),
        "lk compiled": partial(compiled(forward), *views, window),
        "lk opencv": partial(forward_opencv, *views, window),
        "lk_fb eager": partial(track.lucas_kanade, *views, **options),
        "lk_fb cached": partial(track.lucas_kanade, *views, hint=TrackHint(pyramid=kept), **options),
        "lk_fb compiled": partial(compiled(track.lucas_kanade), *views, **options),
        "lk_fb opencv": partial(opencv.opencv_lucas_kanade, *views, **options),
    }
    durations = harness.in_turn([*calls.values()], repeats=repeats, warm_up=2)
    times = {name: [t / batch for t in side] for name, side in zip(calls, durations, strict=True)}
    missed, missed_compiled, peer_missed = misses(image_0, uv, window)
    theirs = calls["lk_fb opencv"]().valid
    rows = []
    for name, ways in (("lk", 1), ("lk_fb", 2)):
        for mode in ("eager", "cached", "compiled"):
            errors = {"ours_error": missed_compiled if mode == "compiled" else missed, "peer_error": peer_missed}
            if ways == 2:
                errors = {"ours_error": (calls[f"lk_fb {mode}"]().valid != theirs).double().mean().item()}
            more: dict[str, Any] = {"mode": mode, "n": n, "batch": batch, "bar": window == 21, **errors}
            least = work(n, window, tuple(image_0.shape[-2:]), ways)
            both = times[f"{name} {mode}"], "opencv", times[f"{name} opencv"]
            rows.append(harness.row(name + suffix, *both, work=least, **more))
    return rows


def main() -> None:
    """Print the tables; write the rows with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = []
    for threads in (1, 2):
        harness.set_threads(threads)
        windows = (21, 15, 11) if options.full or threads == 1 else (21,)
        sizes = [(2048, 1, w) for w in windows] + [(512, 8, 21)]
        if options.full:
            sizes = [(n, B, w) for w in windows for n in (512, 2048) for B in (1, 8, 32)]
        for size in sizes:
            rows += measure(*size, options.repeats)
    print(f"milliseconds per pair, medians of {options.repeats}; errors: see above")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
