"""Parts of test writers: files of images, rows of numbers, and films."""

import io
import struct
import zlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

from dhtorch.data.codecs.video import SYMMETRY_OF_MATRIX
from dhtorch.export import video
from dhtorch.export.arrays import encode_depth_codes, frame_to_hwc, pose_matrix, rotation_to_xyzw
from dhtorch.records import Frame

# ------------------------------------------------------------------------------------------------------------- parts


def encode_unfiltered_png(picture: np.ndarray) -> bytes:
    """(H, W, 1 or 3) uint8 or (H, W) uint16 → bytes of a PNG with unfiltered rows."""
    h, w = picture.shape[:2]
    bits = 8 * picture.dtype.itemsize
    colour = 2 if picture.ndim == 3 and picture.shape[2] == 3 else 0
    rows = picture.astype(picture.dtype.newbyteorder(">"), order="C").reshape(h, -1).view(np.uint8)
    raw = np.concatenate((np.zeros((h, 1), np.uint8), rows), 1).tobytes()
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", w, h, bits, colour, 0, 0, 0), b"IDAT" + zlib.compress(raw, 1), b"IEND")
    framed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def format_row(values: Any) -> str:
    """Numbers → one line of text with all digits of float64."""
    return " ".join(f"{float(x):.17g}" for x in values)


def format_rows(matrix: np.ndarray) -> str:
    """Matrix → text, one row per line."""
    return "".join(format_row(row) + "\n" for row in matrix)


def save_file(file: Path, content: bytes | str) -> None:
    """Write a file and create its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)


def encode_jpeg(picture: np.ndarray, quality: int) -> bytes:
    """(H, W, 3) uint8 → bytes of a JPEG without chroma subsampling."""
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "JPEG", quality=quality, subsampling=0)
    return out.getvalue()


def save_rgbd(root: Path, frame: Frame, image: str, depth: str, units_per_metre: float) -> None:
    """Write a frame's image (PNG, or nearly lossless JPEG by its name) and its depth codes (PNG)."""
    picture = frame_to_hwc(frame)
    save_file(root / image, encode_jpeg(picture, 97) if image.endswith(".jpg") else encode_unfiltered_png(picture))
    save_file(root / depth, encode_unfiltered_png(encode_depth_codes(frame.depth, units_per_metre)))


def pose_row(frame: Frame, pose: np.ndarray | None = None) -> str:
    """Translation and quaternion x y z w of a pose, by default the frame's, as one line of text."""
    T = pose_matrix(frame) if pose is None else pose
    return format_row([*T[:3, 3], *rotation_to_xyzw(T[:3, :3])])


# ------------------------------------------------------------------------------------------------------------- video


def write_video(
    file: Path,
    pictures: Sequence[np.ndarray],
    times: Sequence[float],
    *,
    hide_first: bool = False,
    display: int = 0,
    **options: Any,
) -> None:
    """A film as :func:`dhtorch.export.video.write_video`; with ``hide_first`` the first frame is before time 0.

    ``display``: symmetry of the stored images that the display matrix states.
    """
    video.write_video(file, pictures, times, **options)
    if hide_first:
        hide_first_image(file, times[1] - times[0])
    if display:
        write_display_matrix(file, display)


def write_display_matrix(file: Path, display: int) -> None:
    """Write the display matrix of the only track for a symmetry (:mod:`dhtorch.data.orientation`) of the images."""
    content = bytearray(file.read_bytes())
    at = content.index(b"tkhd") + 44  # version and flags, then 40 bytes in version 0
    a, b, c, d = next(matrix for matrix, k in SYMMETRY_OF_MATRIX.items() if k == display)
    content[at : at + 20] = struct.pack(">5i", *(entry << 16 for entry in (a, b, 0, c, d)))
    file.write_bytes(content)


def hide_first_image(file: Path, step_s: float) -> None:
    """Delay the start of the only edit in the file's edit list by a frame: the first is decoded but not presented."""
    with av.open(str(file)) as container:
        shift = round(Fraction(step_s) / container.streams.video[0].time_base)
    content = bytearray(file.read_bytes())
    at = content.index(b"elst") + 16  # version and flags, count, duration, then the start
    start = int.from_bytes(content[at : at + 4], "big") + shift
    content[at : at + 4] = start.to_bytes(4, "big")
    file.write_bytes(content)
