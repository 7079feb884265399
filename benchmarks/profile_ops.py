"""The ten most expensive operations of a method or a stage, in several calls, and how often each runs.

    python benchmarks/profile_ops.py                         method=paper, whole pair
    python benchmarks/profile_ops.py map --stage pose        one stage of a method
    python benchmarks/profile_ops.py paper --batch 8 --n 2048 --top 20

Stages: sample, backproject, classify, track, pose, triangulate, score. One pair of TUM fr1/desk where DHTORCH_DATA is
set, else of the built-in room.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import harness
import pair as pairs
import torch
from torch.profiler import ProfilerActivity, profile

from dhtorch.pipeline.method import Method
from dhtorch.pipeline.presets import METHODS

STAGES = ("sample", "backproject", "classify", "track", "pose", "triangulate", "score")


def seat_call(method: Method, name: str, frames: tuple[Any, Any], n: int) -> Callable[[], Any]:
    """One stage of a method with the arguments that the method gives it."""
    seen: dict[str, Callable[[], Any]] = {}
    stage = getattr(method, name)

    def watched(*args: Any, **kwargs: Any) -> Any:
        seen[name] = partial(stage, *args, **kwargs)
        return stage(*args, **kwargs)

    method.replace(n=n, **{name: watched})(*frames)
    return seen[name]


def table(call: Callable[[], Any], repeats: int, top: int, device: str) -> str:
    """Operations by the time they take themselves in all calls."""
    for _ in range(3):
        call()
    kinds = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if device != "cpu" else [])
    with profile(activities=kinds) as profiler:
        for _ in range(repeats):
            call()
    key = "self_cpu_time_total" if device == "cpu" else "self_device_time_total"
    return profiler.key_averages().table(sort_by=key, row_limit=top)


def main() -> None:
    """Print the table."""
    parser = harness.arguments(__doc__ or "")
    parser.add_argument("method", nargs="?", choices=[*METHODS], default="paper")
    parser.add_argument("--stage", choices=STAGES, help="one stage instead of the whole pair")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--n", type=int, default=2048)
    parser.add_argument("--top", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    harness.set_threads(options.threads)
    scene, near, other, *_ = pairs.load(options.batch)
    frames = (near.to(options.device), other.to(options.device))
    method = METHODS[options.method]
    with torch.no_grad():
        call: Callable[[], Any] = partial(method, *frames, n=options.n)
        if options.stage:
            call = seat_call(method, options.stage, frames, options.n)
        print(f"{options.method}{'.' + options.stage if options.stage else ''} on {scene}, batch {options.batch}")
        print(table(call, options.repeats, options.top, options.device))


if __name__ == "__main__":
    main()
