"""Pairs per second on an accelerator, beside the same calls on the CPU and kornia's on the accelerator.

    python benchmarks/gpu.py --json benchmarks/results/gpu.json      skipped with a line where there is no CUDA device
    python benchmarks/gpu.py --device cpu                            the same code without one, to see that it runs

Front end, pose, triangulation, whole pairs, a reference view with four neighbours (``auto``, ``fused``, every pixel)
and the loader's transform, 1 to 64 at once (``--full``: 256 pairs, too), n = 2048, the recording of ``pair.py``.
float32 with TF32 off; times lie between two events of the device, after warm-up. A row has two peers: the same call on
the CPU (all threads, of ``CPU_BATCH`` pairs or one reference view), and, where kornia has the stage, kornia on the
device with the same batch: its pixels and filters (``method=kornia``) and ``triangulate_points``.

Rows of mode ``graph`` are the same call recorded once as a CUDA graph and replayed, beside the call itself.

``waits`` counts how often the host waits for the device in one call, ``peak_mib`` is the largest memory of the device.
Errors: median relative depth error over the same candidates, on either device. ``gate_flips`` is the share of samples
or pixels with another gate than on the CPU, ``change_sigma`` the median change of depth in units of sigma.
"""

import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import harness
import kornia.geometry.epipolar as kornia_epipolar
import pair as pairs
import pnp
import torch
import triangulate
from frontend import front_end

from dhtorch import pytree
from dhtorch.geometry import camera as cam
from dhtorch.geometry import epipolar
from dhtorch.metrics import holdout
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.pair import uniform_draws
from dhtorch.pipeline.presets import METHODS
from dhtorch.records import Frame
from dhtorch.stages.pose import pnp_ransac
from dhtorch.transforms.extend_depth import ExtendDepth

N, CPU_BATCH, VIEWS = 2048, 8, 4
SIZES, ALL_SIZES = (1, 8, 64), (1, 8, 64, 256)

#: Calls of one reference view with several others, which the CPU answers one at a time.
OF_VIEWS = ("views_auto", "views_fused", "every_pixel")

#: Calls that read values on the host.
READING = ("extend_depth", "kornia_frontend", "pair_kornia")

#: Calls that kornia has, by the call that is its peer.
KORNIA = {"frontend": "kornia_frontend", "triangulate": "kornia_triangulate", "pair_paper": "pair_kornia"}

Call = Callable[[], Any]


class Inputs:
    """One reference view and its neighbours, the first its pair's, as near views."""

    def __init__(self) -> None:
        self.pair = pairs.load(1)
        recording, near, gap = pairs._recording()
        i, j = pairs.by_gap(recording, gap)[0]
        around = [k for k in range(len(recording)) if k not in (i, j)]
        around = [j, *sorted(around, key=lambda k: (abs(abs(k - i) - gap), k))[: VIEWS - 1]]
        self.views = [holdout.range_split(recording[k], near) for k in around]


def calls(batch: int, device: str, one: Inputs) -> dict[str, Call]:
    """What is timed, by name, its inputs already on the device."""
    near, *others = (pytree.collate([f[:1]] * batch).to(device) for f in (one.pair[1], *one.views))
    samples, tracks, camera, _ = pnp.scene(batch, 500, 0.3, seed=1)
    draws = uniform_draws(0, batch, pnp.HYPOTHESES).to(device)
    samples, tracks, camera = samples.to(device), tracks.to(device), camera.to(device)
    uv_0, uv_1, view, T, _ = triangulate.scene(N)
    seen = [x.repeat(batch, 1, 1).to(device) for x in (uv_0, uv_1)]
    view, T = pytree.collate([view] * batch).to(device), pytree.collate([T] * batch).to(device)
    eye, zero = torch.eye(3).to(device).expand_as(T.R), torch.zeros_like(T.t)[..., None]
    K = cam.to_matrix(view)
    P_0, P_1 = (kornia_epipolar.projection_from_KRt(K, R, t) for R, t in ((eye, zero), (T.R, T.t[..., None])))
    transform = ExtendDepth(depth_unit="m", other_image="other", n=N, batched=True)
    sample = {
        "image": near.image,
        "depth": near.depth,
        "intrinsics": cam.to_matrix(near.camera),
        "other": others[0].image,
    }
    return {
        "frontend": partial(front_end, near, N),
        "kornia_frontend": partial(METHODS["kornia"].replace(n=N).sample_depth, near),
        "pnp_n500": partial(pnp_ransac, samples, tracks, camera, camera, draws),
        "triangulate": partial(epipolar.triangulate_depth, seen[0], seen[1], view, view, T),
        "kornia_triangulate": lambda: kornia_epipolar.triangulate_points(P_0, P_1, *seen)[..., 2],
        **{f"pair_{name}": partial(METHODS[name], near, others[0], n=N) for name in ("paper", "map", "kornia")},
        "extend_depth": partial(transform, sample),
        "views_auto": partial(METHODS["auto"], near, others, n=N),
        "views_fused": partial(METHODS["fused"], near, others, n=N),
        "every_pixel": partial(complete_depth, near, others),
    }


def error(name: str, device: str, one: Inputs) -> float | None:
    """Median relative depth error of a method on a device; answers come home to be judged."""
    kind, _, method = name.partition("_")
    if method not in METHODS:
        return None

    def run(near: Frame, other: Frame, *, trace: dict[str, Any]) -> Any:
        others = [f.to(device) for f in one.views] if kind == "views" else other.to(device)
        result = METHODS[method](near.to(device), others, n=N, trace=trace)
        trace["samples"] = trace["samples"].to("cpu")
        return result.to("cpu")

    return pairs.median_error(run, one.pair)


def change(there: Any, here: Any) -> dict[str, float]:
    """Share of other gates than on the CPU, and the median change of the depth both answer, in sigmas; of answers."""
    if not hasattr(here, "gate") or not here.keep.any():
        return {}
    there = there.to("cpu")
    both = (there.keep & here.keep).nonzero(as_tuple=True)
    moved = ((there.depth - here.depth).abs() / here.sigma)[both]
    flips = float((there.gate != here.gate).double().mean())
    return {"gate_flips": flips, "change_sigma": float(moved.median()) if len(moved) else 0.0}


def waits(call: Call) -> int:
    """How often the host waits for the device in one call."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(w.message) for w in caught)


def time_call(call: Call, device: str, repeats: int) -> tuple[list[float], dict[str, Any]]:
    """Milliseconds of a call, and what else is measured of it on the device."""
    times = harness.in_turn([call], repeats=repeats, warm_up=1, device=device)[0]
    if device == "cpu":
        return times, {}
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    n_waits = waits(call)
    more = {"waits": n_waits, "peak_mib": (torch.cuda.max_memory_allocated() - before) / 2**20}
    return times, more


def graph_times(name: str, call: Call, device: str, repeats: int) -> list[float] | None:
    """Milliseconds of a call that was recorded as a CUDA graph and is replayed; None where it cannot be recorded.

    A call for which the host never waits can be. The replayed answers are those of the call, or none count.
    """
    if device == "cpu" or name in READING:
        return None
    try:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            recorded = call()
        graph.replay()
        torch.cuda.synchronize()
        if hasattr(recorded, "gate") and not torch.equal(recorded.gate, call().gate):
            raise RuntimeError("replayed answers differ")
        return harness.in_turn([graph.replay], repeats=repeats, warm_up=1, device=device)[0]
    except RuntimeError as problem:
        print(f"{name}: not replayed, {str(problem).splitlines()[0]}")
        return None


def measure(device: str, options: Any, rows: list[dict[str, Any]]) -> None:
    """Appends the rows of all sizes; what does not fit into the device's memory, or the time given, ends its series."""
    end = time.monotonic() + options.seconds
    one = Inputs()
    here: dict[str, tuple[list[float], Any]] = {}
    alone = {name: call for name, call in calls(1, "cpu", one).items() if name in OF_VIEWS}
    for name, call in (calls(CPU_BATCH, "cpu", one) | alone).items():
        size = 1 if name in OF_VIEWS else CPU_BATCH
        results: list[Any] = []
        spent = harness.in_turn([lambda call=call, results=results: results.append(call())], repeats=2, warm_up=0)[0]
        here[name] = [t / size for t in spent], results[-1]
    errors = {m: (error(m, device, one), error(m, "cpu", one)) for m in here}
    ended: set[str] = set()
    for batch in ALL_SIZES if options.full else SIZES:
        times: dict[str, list[float]] = {}
        for name, call in calls(batch, device, one).items():
            if name in ended or time.monotonic() > end:
                continue
            try:
                spent, more = time_call(call, device, options.repeats)
            except torch.cuda.OutOfMemoryError:
                print(f"{name}: {batch} do not fit into the memory of {device}")
                ended.add(name)
                continue
            times[name] = [t / batch for t in spent]
            if batch == (1 if name in OF_VIEWS else CPU_BATCH):
                more |= change(call(), here[name][1])
            graphed = batch <= CPU_BATCH or name not in OF_VIEWS
            replayed = graph_times(name, call, device, options.repeats) if graphed else None
            ours, theirs = errors[name]
            more |= {"n": N, "batch": batch, "device": device, "ours_error": ours, "peer_error": theirs}
            peer = f"cpu_b{1 if name in OF_VIEWS else CPU_BATCH}"
            rows.append(harness.row(f"gpu_{name}_b{batch}", times[name], peer, here[name][0], **more))
            if replayed is not None:
                spent = [t / batch for t in replayed]
                size = {"n": N, "batch": batch, "device": device, "mode": "graph"}
                rows.append(harness.row(f"gpu_{name}_b{batch}", spent, "eager", times[name], **size))
            print(f"{name}, {batch} at once: {1e3 / rows[-1]['ours_ms']:.0f} per second, {more}", flush=True)
        for name, peer in KORNIA.items():
            if name in times and peer in times:
                more = {"n": N, "batch": batch, "device": device}
                rows.append(harness.row(f"gpu_{name}_b{batch}.kornia", times[name], "kornia", times[peer], **more))


def main() -> int:
    """Print the table; write it with ``--json``."""
    parser = harness.arguments(__doc__ or "")
    parser.set_defaults(device="cuda", repeats=3)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="rows that begin later are left out")
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        print(f"gpu: skipped, torch {torch.__version__} sees no CUDA device here")
        return 0
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    rows: list[dict[str, Any]] = []
    with torch.no_grad():
        try:
            measure(options.device, options, rows)
        except (RuntimeError, KeyboardInterrupt) as problem:
            print(f"ended: {problem}")
    card = torch.cuda.get_device_name() if options.device != "cpu" else "cpu"
    rows = [{**row, "card": card, "torch": torch.__version__} for row in rows]
    print(f"milliseconds per pair, medians of {options.repeats}, {card}, torch {torch.__version__}, float32, TF32 off")
    harness.report(rows, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
