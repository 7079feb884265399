"""Memory of a long recording that goes through a stream.

    python benchmarks/memory.py --json benchmarks/results/memory.json

The built-in room as a recording of 10,000 frames of 64×48, with 64 samples each, through what ``dhtorch stream`` does
with it: a frame is made, answered from those before it, counted and forgotten, and its row kept for the report. What is
kept of every frame adds up with their number, whatever the picture's size. Said is how far the process's peak rises
above that of the first 100 frames, in MiB.
"""

import resource
import sys
from collections.abc import Iterable
from typing import Any

import harness

from dhtorch import MAP
from dhtorch.cli.stream import stream_scene
from dhtorch.data.scene import Scene
from dhtorch.runtime import storage
from dhtorch.synthetic import SyntheticRoom

#: Frames in all, those that may take memory, the size of a picture and the samples of each.
FRAMES, FIRST, HW, SAMPLES = 10_000, 100, (48, 64), 64


def peak_mib() -> float:
    """The largest memory of this process until now."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def measure(frames: int) -> dict[str, Any]:
    """The peak after the first frames, and how far it rises until the last."""
    peaks: list[float] = []

    def watched(numbers: Iterable[Any], *_: Any) -> Iterable[Any]:
        for k in numbers:
            if k == FIRST:
                peaks.append(peak_mib())
            yield k
            room._frames.clear()  # the room keeps what it has rendered, a recording in files does not

    room = SyntheticRoom(n_frames=frames, hw=HW, depth_hw=HW)
    settings = {
        "steps": (1, 2, 3, 5, 8),
        "seed": 0,
        "max_frames": None,
        "dtype": "float32",
        "device": "cpu",
        "cutoff": 2.0,
    }
    summary = stream_scene(Scene(room, near=2.0), MAP.replace(n=SAMPLES), settings, progress=watched)
    return {
        "name": "stream_recording",
        "frames": summary["n_frames"],
        "first": FIRST,
        "first_mib": peaks[0],
        "above_mib": peak_mib() - peaks[0],
        "state_mib": summary["mib"],
        **harness.place(),
    }


def main() -> None:
    """Print the row; write it with ``--json``."""
    parser = harness.arguments(__doc__ or "")
    parser.add_argument("--frames", type=int, default=FRAMES)
    options = parser.parse_args()
    if options.frames <= FIRST:
        parser.error(f"--frames: found {options.frames}, expected more than {FIRST}")
    harness.set_threads(1)
    row = measure(options.frames)
    print(f"{row['frames']} frames: {row['first_mib']:.0f} MiB after {FIRST}, then {row['above_mib']:.1f} more")
    if options.json is not None:
        storage.write_json(options.json, [row])


if __name__ == "__main__":
    main()
