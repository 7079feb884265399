"""Time of the validation of a frame, beside a fixed-threshold photometric check of the same frame.

    python benchmarks/validate.py --json benchmarks/results/validate_speed.json --clock cpu --repeats 9

``validate_sparse``: :func:`dhtorch.validate_depth` of a map of 640×480 with one source view, by sparse evidence
(``views=False``) of :data:`dhtorch.validation.validate.QUICK_METHOD`, from the frames to the record;
``validate_sparse_512``: the same with 512 samples of ``map``; ``validate_views``: with photometric evidence too. Rows
of mode ``compiled`` use the operators that ``python -m dhtorch.ops`` compiles. All take turns in one process, a second
or more of frames in a row each, as a data set is validated. The peer needs a relative pose and gets one by the same
method. Frames of TUM fr1/desk where DHTORCH_DATA is set, else of the built-in room; frames a second are 1000 / ms.
"""

from functools import partial
from typing import Any

import harness
import pair as pairs
import torch

from dhtorch import MAP, validate_depth
from dhtorch.experiments.compare import validate_study
from dhtorch.pipeline import dense
from dhtorch.pipeline.method import Method
from dhtorch.validation.validate import QUICK_METHOD

METHOD = MAP.replace(n=512)


def measure(threads: int, options: Any) -> list[dict[str, Any]]:
    """A row for each way to ask."""
    harness.set_threads(threads)
    _, near, other, reference, _ = pairs.load(1)

    def check() -> None:
        trace: dict[str, Any] = {}
        with torch.no_grad():
            selected = dense.selected_views(METHOD(near, other, trace=trace), other, trace)
            validate_study.photometric_difference(reference.depth, near, selected)

    def ours(method: Method, views: bool) -> None:
        validate_depth(reference.depth, near, other, method=method, views=views)

    variants = {"sparse": (QUICK_METHOD, False), "sparse_512": (METHOD, False), "views": (METHOD, True)}
    modes = {"eager": ours, "compiled": harness.with_compiled_operators()(ours)}
    sides = [(name, mode) for mode in modes for name in variants]
    calls = [*(partial(modes[mode], *variants[name]) for name, mode in sides), check]
    *durations, peer = harness.in_turn(calls, repeats=options.repeats, clock=options.clock, least_ms=1000.0)
    return [
        harness.row(f"validate_{name}", times, "photometric", peer, n=variants[name][0].n, mode=mode)
        for (name, mode), times in zip(sides, durations, strict=True)
    ]


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    rows = measure(1, options)
    print(f"milliseconds a frame, medians of {options.repeats}")
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
