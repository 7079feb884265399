"""A web page for one capture: upload a scan, see its completed depth. Run it with ``python app.py``; needs ``gradio``.

The capture is processed by ``dhtorch PATH`` in a process of its own, in a temporary folder that is deleted with the
session; the upload is an archive or a single-file capture (``.r3d``, RGBD ``.mp4``).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

#: Frames of a capture that are processed; limits the time of a request to about a minute on two cores.
MAX_FRAMES = 12

#: Seconds after which a request is ended.
TIMEOUT_S = 600

#: Largest content of an archive, bytes; against decompression bombs.
MAX_CONTENT_BYTES = 2_000_000_000


def unpack(upload: Path, folder: Path) -> Path:
    """The capture of an upload: the file itself, or the folder of a ``.zip`` unpacked below ``folder``.

    Raises:
        ValueError: an archive with names that leave the folder, or with too much in it.
    """
    if upload.suffix != ".zip":
        return upload
    with zipfile.ZipFile(upload) as archive:
        if (size := sum(entry.file_size for entry in archive.infolist())) > MAX_CONTENT_BYTES:
            raise ValueError(f"{upload.name}: found {size:,} bytes, expected at most {MAX_CONTENT_BYTES:,}")
        for entry in archive.infolist():
            if not (folder / entry.filename).resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"{upload.name}: found the name {entry.filename!r}, expected names inside the archive")
        archive.extractall(folder)
    inside = [path for path in folder.iterdir() if not path.name.startswith(("__MACOSX", "."))]
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder


def process(upload: str, place: str | None = None) -> tuple[str, str, str]:
    """Upload -> path of the overview picture, path of the page with the 3D map, and what the command printed.

    Args:
        upload: path of the uploaded file.
        place: folder for the output; None = a temporary one.

    Raises:
        ValueError: a capture that cannot be processed, with the command's message.
    """
    out = Path(place or tempfile.mkdtemp(prefix="dhtorch_space_"))
    (out / "upload").mkdir()
    capture = unpack(Path(upload), out / "upload")
    words = [sys.executable, "-m", "dhtorch", str(capture), f"out={out / 'result'}", f"max_frames={MAX_FRAMES}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    if done.returncode:
        raise ValueError(
            done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "dhtorch ended without a message"
        )
    return str(out / "result" / "overview.png"), str(out / "result" / "view.html"), done.stdout


def build_page():
    """The page."""
    import gradio as gr  # noqa: PLC0415

    def answer(upload: str):
        try:
            return process(upload)
        except ValueError as error:
            raise gr.Error(str(error)) from None

    return gr.Interface(
        answer,
        gr.File(label="Capture: .r3d, RGBD .mp4, or a .zip of the folder", type="filepath"),
        [
            gr.Image(label="Picture, sensor, completed depth"),
            gr.File(label="3D map (open in a browser)"),
            gr.Textbox(label="Summary"),
        ],
        title="dhtorch",
        description="Extends LiDAR depth past the sensor's range, with an uncertainty for every pixel.",
    )


if __name__ == "__main__":
    build_page().launch()
