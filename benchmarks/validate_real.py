"""``dhtorch validate`` on real sensor depth with real faults, of the captures below DHTORCH_DATA that have some.

    python benchmarks/validate_real.py --json benchmarks/results/validate_real.json

A row for each recording: what is said of the sensor's own depth, of the whole and of each frame, and the likely cause.
With ``--pages`` the pages with the pictures are kept there.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

#: Capture → options beside those as they come. The RealSense's K is nobody's: the field of view is the maker's. The
#: last are single views, each in a folder of its own.
CAPTURES: dict[str, tuple[str, ...]] = {
    "realsense_slam": ("data.fov=69", "every=2"),
    "slambook_rgbd": (),
    **{f"lingbot_examples/{k}": () for k in range(8)},
}

#: What is kept of a frame.
OF_FRAME = (
    "frame",
    "share_wrong",
    "share_consistent",
    "share_cannot_know",
    "clip_depth",
    "photometric_evidence",
    "consistency_evidence",
)


def rows(path: Path, options: tuple[str, ...], folder: Path) -> list[dict[str, Any]]:
    """What is said of the recordings of a capture."""
    words = [sys.executable, "-m", "dhtorch", "validate", str(path), f"output={folder}", "pictures=30", *options]
    subprocess.run(words, check=True, cwd=folder)
    records = []
    for file in sorted(folder.rglob("validate.json")):
        report = json.loads(file.read_text())
        row = {
            "recording": report["scene"],
            "options": list(options),
            "processor": result_files.describe_processor(),
        }
        row |= {"intrinsics_guessed": report["intrinsics_guessed"], "whole": report["whole"]}
        row |= {"windows": [{k: w[k] for k in ("frames", "cause", "pairs")} for w in report["windows"]]}
        records.append(row | {"frames": [{k: frame[k] for k in OF_FRAME} for frame in report["frames"]]})
    return records


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--pages", type=Path, help="folder that keeps the pages; none = they are not kept")
    options = parser.parse_args()
    data = Path(os.environ["DHTORCH_DATA"])
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, arguments in CAPTURES.items():
            folder = Path(options.pages or scratch).resolve() / name
            folder.mkdir(parents=True, exist_ok=True)
            records += [{"name": name} | row for row in rows(data / name, arguments, folder)]
    storage.write_json(options.json, storage.to_strict_json(records))
    return 0


if __name__ == "__main__":
    sys.exit(main())
