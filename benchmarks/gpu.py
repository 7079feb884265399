"""Pairs per second on an accelerator, beside the same calls on the CPU.

    python benchmarks/gpu.py --json benchmarks/results/gpu.json      skipped with a line where there is no CUDA device
    python benchmarks/gpu.py --device cpu                            the same code without one, to see that it runs

Front end, pose, triangulation and whole pairs of both methods, 1 to 1024 pairs at once (``--full``: all sizes),
n = 2048, the pairs of ``pair.py``. float32 with TF32 off; times lie between two events of the device, after warm-up.
Peer is the same call on the CPU with 8 pairs (all threads), per pair.

Errors: of whole pairs the median relative depth error over the same candidates, on either device.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import harness
import pair as pairs
import pnp
import torch
import triangulate
from frontend import front_end

from dhtorch import pytree
from dhtorch.geometry import epipolar
from dhtorch.pipeline.pair import uniform_draws
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Frame
from dhtorch.stages.pose import pnp_ransac

N, CPU_BATCH = 2048, 8
SIZES, ALL_SIZES = (1, 64, 1024), (1, 8, 64, 256, 1024)
Call = Callable[[], Any]


def calls(batch: int, device: str, one: tuple[str, Frame, Frame, Frame, float]) -> dict[str, Call]:
    """What is timed, by name, its inputs already on the device."""
    near, other = (pytree.collate([f[:1]] * batch).to(device) for f in one[1:3])
    samples, tracks, camera, _ = pnp.scene(batch, 500, 0.3, seed=1)
    draws = uniform_draws(0, batch, pnp.HYPOTHESES).to(device)
    samples, tracks, camera = samples.to(device), tracks.to(device), camera.to(device)
    uv_0, uv_1, view, T, _ = triangulate.scene(N)
    seen = [x.repeat(batch, 1, 1).to(device) for x in (uv_0, uv_1)]
    view, T = pytree.collate([view] * batch).to(device), pytree.collate([T] * batch).to(device)
    calls: dict[str, Call] = {
        "frontend": partial(front_end, near, N),
        "pnp_n500": partial(pnp_ransac, samples, tracks, camera, camera, draws),
        "triangulate": partial(epipolar.triangulate_depth, seen[0], seen[1], view, view, T),
    }
    return calls | {f"pair_{name}": partial(method, near, other, n=N) for name, method in METHODS.items()}


def error(method: str, device: str, one: tuple[str, Frame, Frame, Frame, float]) -> float | None:
    """Median relative depth error of the pair on a device; answers come home to be judged."""

    def run_pair(near: Frame, other: Frame, *, trace: dict[str, Any]) -> Any:
        result = METHODS[method](near.to(device), other.to(device), n=N, trace=trace)
        trace["samples"] = trace["samples"].to("cpu")
        return result.to("cpu")

    return pairs.median_error(run_pair, one)


def measure(device: str, options: Any) -> list[dict[str, Any]]:
    """Rows of all batch sizes; what does not fit into the device's memory ends its series."""
    one = pairs.load(1)
    many = {
        k: [t / CPU_BATCH for t in harness.in_turn([c], repeats=3, warm_up=1)[0]]
        for k, c in calls(CPU_BATCH, "cpu", one).items()
    }
    errors = {f"pair_{m}": (error(m, device, one), error(m, "cpu", one)) for m in METHODS}
    rows = []
    alive = set(many)
    for batch in ALL_SIZES if options.full else SIZES:
        for name, call in calls(batch, device, one).items():
            if name not in alive:
                continue
            try:
                times = harness.in_turn([call], repeats=options.repeats, warm_up=2, device=device)[0]
            except torch.cuda.OutOfMemoryError:
                print(f"{name}: {batch} pairs do not fit into the memory of {device}")
                alive.discard(name)
                continue
            ours, theirs = errors.get(name, (None, None))
            more: dict[str, Any] = {"n": N, "batch": batch, "device": device, "ours_error": ours, "peer_error": theirs}
            rows.append(
                harness.row(f"gpu_{name}_b{batch}", [t / batch for t in times], f"cpu_b{CPU_BATCH}", many[name], **more)
            )
            print(f"{name}, {batch} at once: {1e3 / rows[-1]['ours_ms']:.0f} per second")
    return rows


def main() -> int:
    """Print the table; write it with ``--json``."""
    parser = harness.arguments(__doc__ or "")
    parser.set_defaults(device="cuda", repeats=10)
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        print(f"gpu: skipped, torch {torch.__version__} sees no CUDA device here")
        return 0
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    with torch.no_grad():
        rows = measure(options.device, options)
    print(f"milliseconds per pair, medians of {options.repeats}, {options.device}, float32, TF32 off")
    harness.report(rows, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
