"""``dhtorch PATH`` on a phone's capture of a hundred frames, with nothing else said: first picture, everything.

    python benchmarks/phone.py --json benchmarks/results/phone.json

The capture is the built-in room as a Stray Scanner folder: HEVC video of 1440×1920, depth of 192×256 to three metres.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

from captures import row

from dhtorch.export.stray import write_stray
from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage
from dhtorch.synthetic import SyntheticRoom

#: Size of a picture held upright, the way from frame to frame (0.3 m/s at ten frames a second), the reach.
HW, STEP_M, RANGE_M = (1920, 1440), 0.03, 3.0


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=100)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "captures" / "phone"
        room = SyntheticRoom(
            n_frames=options.frames, hw=HW, depth_hw=(256, 192), step_m=STEP_M, range_limit=RANGE_M, supersample=1
        )
        write_stray(capture, room, codec="libx265")
        record = row(capture, Path(folder), ())
    record |= {
        "frames": options.frames,
        "hw": list(HW),
        "processor": result_files.describe_processor(),
        "cores": os.cpu_count(),
    }
    print(record)
    storage.write_json(options.json, [record])
    return record["rc"]


if __name__ == "__main__":
    sys.exit(main())
