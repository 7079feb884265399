"""``dhtorch PATH`` on every capture below DHTORCH_DATA: how long it took, and what came of it or why nothing did.

    python benchmarks/captures.py --json benchmarks/results/captures.json --pictures docs/assets/captures

As a user has it, a process each, but for half a minute a capture instead of four, and at most two recordings of one.
``first_s`` is the time from the start of the process until the first preview exists.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2

from dhtorch.runtime import results as result_files
from dhtorch.runtime import storage

#: Options that are not as they come.
SHORT = ("minutes=0.5", "recordings=2")

#: Captures whose licences let pictures of them be shown (MIT, MIT, CC BY 4.0), and how wide they are.
SHOWN, WIDTH = ("dgp_drive6cam", "holo_a", "tum_fr1_desk9"), 640

#: Sentences that say what was made, and what to do next, not what was recovered.
ASIDE = ("Wrote ", "Next: ")


def has_picture(out: Path) -> bool:
    """Whether the first preview of a capture, or of one of its recordings, exists."""
    return any(out.glob("previews/*.jpg")) or any(out.glob("*/previews/*.jpg"))


def row(path: Path, folder: Path, options: Sequence[str] = SHORT) -> dict[str, Any]:
    """What the command makes of one capture, with the options ``options``."""
    out, began, first = folder / path.name, time.perf_counter(), None
    words = [sys.executable, "-m", "dhtorch", str(path), f"out={out}", *options]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            if first is None and has_picture(out):
                first = time.perf_counter() - began
            time.sleep(0.2)
        stdout, wrong = process.communicate()
    lines = [line for line in stdout.splitlines() if not line.startswith(ASIDE)]
    record: dict[str, Any] = {"name": path.name, "seconds": time.perf_counter() - began, "first_s": first}
    record |= {"rc": process.returncode}
    if process.returncode == 0:
        return record | {"printed": " ".join(lines)}
    wrong = next((line for line in wrong.splitlines() if line.startswith("dhtorch: ")), wrong)
    return record | {"why": wrong.strip().removeprefix("dhtorch: ").replace(f"{path.parent}{os.sep}", "")}


def picture(folder: Path, file: Path) -> None:
    """Keep a smaller copy of the first overview below ``folder``, if there is one."""
    for picture in sorted(folder.rglob("overview.png"))[:1]:
        whole = cv2.imread(str(picture))
        size = (WIDTH, round(whole.shape[0] * WIDTH / whole.shape[1]))
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), cv2.resize(whole, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--pictures", type=Path, help="keep the overviews of captures that may be shown in this folder")
    options = parser.parse_args()
    data = Path(os.environ["DHTORCH_DATA"])
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(p for p in data.iterdir() if p.is_dir()):
            rows.append(
                row(path, Path(folder)) | {"processor": result_files.describe_processor(), "cores": os.cpu_count()}
            )
            if options.pictures is not None and path.name in SHOWN:
                picture(Path(folder) / path.name, options.pictures / f"{path.name}.jpg")
            print(rows[-1], flush=True)
            options.json.write_text(storage.dump_strict_json(storage.to_strict_json(rows), indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
