"""A web page for one capture: upload a scan, see its completed depth. Run it with ``python app.py``; needs ``gradio``.

The capture is processed by ``dhtorch PATH`` in a process of its own, in a temporary folder that is removed as soon as
the page has its files; the upload is an archive or a single-file capture (``.r3d``, RGBD ``.mp4``).
"""

from __future__ import annotations

import lzma
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

#: Frames of a capture that are processed; limits the time of a request to about a minute on two cores.
MAX_FRAMES = 12

#: Seconds after which a request is ended.
TIMEOUT_S = 600

#: Largest content of an archive, bytes; against decompression bombs.
MAX_CONTENT_BYTES = 2_000_000_000

#: Raised by ``zipfile`` for damaged archives, passwords (RuntimeError) and unknown compression (NotImplementedError).
_ARCHIVE_ERRORS = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError, RuntimeError)


def unpack(upload: Path, folder: Path) -> Path:
    """The capture of an upload: the file itself, or the folder of a ``.zip`` unpacked below ``folder``.

    Raises:
        ValueError: a damaged archive, one with a password, with names that leave the folder, or with too much in it.
    """
    if upload.suffix != ".zip":
        return upload
    try:
        with zipfile.ZipFile(upload) as archive:
            if (size := sum(entry.file_size for entry in archive.infolist())) > MAX_CONTENT_BYTES:
                raise ValueError(f"{upload.name}: found {size:,} bytes, expected at most {MAX_CONTENT_BYTES:,}")
            for entry in archive.infolist():
                if not (folder / entry.filename).resolve().is_relative_to(folder.resolve()):
                    name = f"the name {entry.filename!r}"
                    raise ValueError(f"{upload.name}: found {name}, expected names inside the archive")
            archive.extractall(folder)
    except _ARCHIVE_ERRORS as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"{upload.name}: found {reason}, expected a whole zip archive without a password") from None
    inside = [path for path in folder.iterdir() if not path.name.startswith(("__MACOSX", "."))]
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder


def process(upload: str, place: str) -> tuple[str, str, str]:
    """Upload -> path of the overview picture, path of the page with the 3D map, and what the command printed.

    Args:
        upload: path of the uploaded file.
        place: folder for the output.

    Raises:
        ValueError: a capture that cannot be processed, with the command's message.
    """
    out = Path(place)
    (out / "upload").mkdir()
    capture = unpack(Path(upload), out / "upload")
    words = [sys.executable, "-m", "dhtorch", str(capture), f"out={out / 'result'}", f"max_frames={MAX_FRAMES}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    if done.returncode:
        raise ValueError(
            done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "dhtorch ended without a message"
        )
    return str(out / "result" / "overview.png"), str(out / "result" / "view.html"), done.stdout


def answer(upload: str) -> Iterator[tuple[str, str, str]]:
    """The answer of :func:`process`, once; its files are removed when the iterator goes on, ends or fails.

    gradio copies the files of an answer before it goes on.
    """
    with tempfile.TemporaryDirectory(prefix="dhtorch_space_") as place:
        yield process(upload, place)


def build_page():
    """The page."""
    import gradio as gr  # noqa: PLC0415

    def show(upload: str):
        try:
            yield from answer(upload)
        except ValueError as error:
            raise gr.Error(str(error)) from None

    return gr.Interface(
        show,
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
