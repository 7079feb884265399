"""``dhtorch demo``: the built-in room as a phone capture, for the same processing as a capture of one's own."""

from __future__ import annotations

import shutil
import sys
import webbrowser
from pathlib import Path
from typing import Final

from dhtorch.cli.view import has_screen
from dhtorch.export.stray import write_stray
from dhtorch.synthetic.recording import SyntheticRoom

#: Frames and size of the capture. Source: chosen for half a minute on a quiet machine; 8 frames took 40 s of processor
#: time beside seventeen other processes on two cores.
_N_FRAMES: Final = 6
_IMAGE_HW: Final = (240, 320)

#: Range of the simulated LiDAR, m: the room is 6 m deep, so that much lies beyond.
_RANGE_M: Final = 2.5

#: Step of the camera from frame to frame, m, that of a slow walk.
_STEP_M: Final = 0.05


def write_demo_capture(folder: Path) -> tuple[Path, Path]:
    """Write the room as a Stray Scanner capture below ``folder``, unless it is there -> capture, folder of the result.

    Raises:
        FileExistsError: ``folder`` has other content.
    """
    folder = folder.expanduser()
    capture, out, mark = folder / "room", folder / "result", folder / "room" / "odometry.csv"
    if not mark.is_file():
        unfinished = folder / "room.unfinished"
        if folder.exists() and (not folder.is_dir() or any(each != unfinished for each in folder.iterdir())):
            raise FileExistsError(f"out: {folder} has other content, expected a new or empty folder")
        shutil.rmtree(unfinished, ignore_errors=True)
        room = SyntheticRoom(n_frames=_N_FRAMES, hw=_IMAGE_HW, range_limit=_RANGE_M, step_m=_STEP_M)
        write_stray(unfinished, [room[k] for k in range(len(room))])
        unfinished.rename(capture)
    return capture, out


def open_page(page: Path, *, in_browser: bool) -> None:
    """Print the address of a page; with ``in_browser`` open it where there is a screen."""
    address = page.absolute().as_uri()
    print(f"Open {address}")
    if in_browser and sys.stdout.isatty() and has_screen():
        webbrowser.open(address)
