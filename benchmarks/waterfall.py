"""Where the time of a whole call goes, part by part: what users wait for, and which of it is arithmetic.

    python benchmarks/waterfall.py --json benchmarks/results/waterfall.json --clock cpu --repeats 5

Four calls with compiled operators, one thread: a loader's sample with two views (by sample and by batch), one ``auto``
reference view, every pixel of one frame from one source view (TUM fr1/desk where DHTORCH_DATA is set, else the built-in
room), and once ``dhtorch PATH`` on eight frames of holo_a (with DHTORCH_DATA). A part's time leaves out that of the
parts within it; ``other`` is the rest of the call. ``ratio`` is the share of the call.
"""

import functools
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import harness
import loader
import pair as pairs
import torch

from dhtorch.cli import complete, process_capture
from dhtorch.cli import run as command
from dhtorch.data.recording import Recording
from dhtorch.export import encode_png
from dhtorch.integrate import from_maps
from dhtorch.metrics import holdout
from dhtorch.pipeline import dense, multiview, pair
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.presets import AUTO, MAP
from dhtorch.pipeline.view_report import with_view_selection
from dhtorch.stages import misalignment
from dhtorch.transforms import adapters, extend_depth, one_thread, sample_spec

#: Part → the functions that it times, by owner and name.
PARTS: dict[str, list[tuple[Any, str]]] = {
    "decode pictures": [(cv2, "imdecode")],
    "resize for the network": [(loader.Encoded, "__getitem__")],
    "read the sample": [(sample_spec.SampleSpec, "read")],
    "collate and hand over": [(adapters.ExtendedDataset, "collate"), (adapters.ExtendedDataset, "__getitem__")],
    "columns": [(extend_depth.ExtendDepth, "_extend")],
    "read frames": [(Recording, "__getitem__")],
    "check the capture": [(process_capture, "check_capture")],
    "digests": [(complete, "build_shared_metadata"), (complete, "digest_scene_files")],
    "choose views": [(multiview, "_select_views")],
    "sample and classify": [(pair, "estimate_pair"), (multiview, "estimate_multiview")],
    "track": [(pair, "track_in_chunks")],
    "pose and triangulate": [(pair, "solve_pairs")],
    "misaligned depth": [(misalignment, "_reject")],
    "sweep": [(dense, "sweep_views")],
    "filter and fill": [(dense, "filter_sweep")],
    "figures": [(complete, "draw_completed"), (process_capture, "write_overview")],
    "video": [(process_capture, "write_moving_preview")],
    "PNG files": [(sys.modules[encode_png.__module__], "encode_png")],
    "fuse the map": [(from_maps, "_fuse_sources")],
    "extract the surface": [(from_maps, "extract_points"), (from_maps, "extract_mesh")],
}


class PartClock:
    """Milliseconds by part of what runs within :meth:`timed`."""

    def __init__(self, clock: str) -> None:
        self.now, self.ms, self._open, self._since = harness.CLOCKS[clock], dict[str, float](), ["other"], 0.0

    def _charge(self) -> None:
        """Add the time since the last change to the innermost part."""
        now = self.now()
        self.ms[self._open[-1]] = self.ms.get(self._open[-1], 0.0) + 1e3 * (now - self._since)
        self._since = now

    def wrap(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed as a part."""

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._charge()
            self._open.append(part)
            try:
                return function(*args, **kwargs)
            finally:
                self._charge()
                self._open.pop()

        return timed

    def measure(self, call: Callable[[], Any]) -> dict[str, float]:
        """Milliseconds by part of one call."""
        self.ms, self._since = {}, self.now()
        call()
        self._charge()
        return self.ms


@contextmanager
def timed_parts(clock: PartClock) -> Iterator[None]:
    """The functions of :data:`PARTS` are timed in this block, in every module that imported them."""
    replaced = []
    for part, functions in PARTS.items():
        for owner, name in functions:
            function = vars(owner)[name]
            timed = clock.wrap(part, function)
            modules = [m for n, m in sys.modules.items() if n.startswith("dhtorch") and vars(m).get(name) is function]
            for holder in {id(x): x for x in (owner, *modules)}.values():
                setattr(holder, name, timed)
                replaced.append((holder, name, function))
    try:
        yield
    finally:
        for holder, name, function in replaced:
            setattr(holder, name, function)


def loader_calls() -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Name, samples and call of a batch of two views, by sample and at once."""
    bench = loader.Bench("640x480", "pair", 512, 2 * loader.ROUNDS, "cpu")
    for name, side in (("loader_pair", "transform"), ("loader_pair_by_batch", "by_batch")):
        dataset = bench.dataset(bench.transforms[side], 0)

        def batch(dataset: Any = dataset) -> None:
            dataset.collate([dataset[i] for i in range(loader.BATCH)])

        yield name, loader.BATCH, batch


def view_calls() -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Name and call of one reference view with ``auto``, and of every pixel from one source view."""
    recording, near, _ = pairs._recording()
    middle = len(recording) // 2
    reference, *others = (
        holdout.range_split(recording[k], near) for k in (middle, *(i for i in range(len(recording)) if i != middle))
    )
    _, first, other, *_ = pairs.load(1)
    yield "auto_reference_view", 1, partial(with_view_selection(AUTO), reference, others, n=2048)
    yield "complete_depth", 1, partial(complete_depth, first, other, method=MAP, source_views=1)


def run_command(capture: Path) -> None:
    """``dhtorch PATH`` on eight frames, into a folder that is removed.

    Raises:
        RuntimeError: the command fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [str(capture), "--max-frames", "8", "--minutes", "null", "--out", f"{folder}/out", "--quiet"]
        if code := command.main(words):
            raise RuntimeError(f"dhtorch {' '.join(words)}: exit code {code}")


def rows_of(name: str, count: int, measured: list[Mapping[str, float]]) -> list[dict[str, Any]]:
    """A row for the whole call and for every part, largest first; milliseconds for each of ``count`` samples."""
    whole = [sum(ms.values()) / count for ms in measured]
    more: dict[str, Any] = {"mode": "compiled", "batch": count}
    names = sorted({part for ms in measured for part in ms}, key=lambda part: -sum(ms.get(part, 0) for ms in measured))
    return [
        harness.row(f"{name}.{part}", [ms.get(part, 0.0) / count for ms in measured], "whole call", whole, **more)
        for part in names
    ]


def main() -> None:
    """Print the table; write it with ``--json``."""
    options = harness.arguments(__doc__ or "").parse_args()
    one_thread()
    harness.set_threads(1)
    clock = PartClock(options.clock)
    rows = []
    with harness.with_compiled_operators(), timed_parts(clock), torch.no_grad():
        for name, count, call in (*loader_calls(), *view_calls()):
            call()
            rows += rows_of(name, count, [clock.measure(call) for _ in range(options.repeats)])
        root = os.environ.get("DHTORCH_DATA")
        if root:
            capture = partial(run_command, Path(root) / "holo_a")
            rows += rows_of("dhtorch_path", 1, [clock.measure(capture) for _ in range(2)])
    harness.report(rows, options.json)


if __name__ == "__main__":
    main()
