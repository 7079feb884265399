"""Reader of Record3D captures: RGB-D recordings of an iPhone or iPad, in the three layouts that the app exports.

- ``.r3d``: a zip archive (or its folder) with ``metadata``, ``rgbd/<i>.jpg``, ``.depth`` and ``.conf``, the latter two
  compressed with LZFSE: float32 metres and confidence 0, 1 or 2.
- *EXR + RGB*: a folder with ``metadata.json``, ``rgb/<i>.jpg`` and ``depth/<i>.exr``.
- *RGBD mp4*: one video; see below.

Image, depth, pose and intrinsics of a frame share the number ``<i>``, which starts at 0 and has no leading zeros. Poses
are camera-to-world with ARKit's axes (x right, y up, z backward) of the image *as stored*, portrait or landscape, so
nothing is rotated here. Colour and depth are registered. Assumed, since undocumented: depth that is not finite or not
positive is *no return*; time stamps count from the first one; ``initPose`` is not used.

The RGBD mp4 has depth as hue in the left half of every image, colour in the right half.

A pixel's hue (full saturation, full value) runs once round the circle from the nearest to the furthest depth, 0 to 3 m
unless the file has another range. Both ends are red and cannot be distinguished, so they are dropped, and so are pixels
next to a depth discontinuity: there the codec has blended two hues into a third one. Intrinsics are stored as JSON near
the end of the file, behind the images, or in a ``metadata.json`` beside it; they refer to one half. There is no
confidence and no pose.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import exr as codec_exr
from dhtorch.data.codecs import lzfse, video
from dhtorch.data.io import decode as files
from dhtorch.data.members import Member, list_folder_members, list_zip_members
from dhtorch.data.recording import Recording
from dhtorch.data.stored_sizes import StoredSizes
from dhtorch.records import Camera, Frame
from dhtorch.runtime import safe_open as doors
from dhtorch.runtime.console import format_count

_MEMBER_PATTERN = re.compile(r"(?:rgbd|rgb|depth)/(0|[1-9]\d{0,8})\.(jpg|depth|conf|exr)")
#: Number of pixels → portrait size of a depth map: LiDAR, front camera, front camera of later devices.
_DEPTH_SIZES = {256 * 192: (256, 192), 640 * 480: (640, 480), 960 * 720: (960, 720)}
#: What is expected where a part of a capture is missing.
_WHOLE_EXPORT = (
    "a whole export of Record3D: metadata with rgbd/<i>.jpg and .depth, or metadata.json with rgb/<i>.jpg and "
    "depth/<i>.exr; share it from the app again"
)
# of the RGBD mp4
_METADATA_START = b'{"intrinsicMatrix"'
_TAIL_BYTES = 1 << 20  # bytes at the end of the file that are searched for the intrinsics
_DEFAULT_RANGE_M = (0.0, 3.0)  # m
_KEPT_RANGE_RATIO = (0.1 / 3, 2.8 / 3)  # of the range, as kept by the app's own viewer

_JPEG_MARKERS = (b"\xff\xd8", b"\xff\xd9")


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if root.is_file():
        if root.suffix.lower() == ".r3d":
            return ".r3d archive"
        return _recognise_film(root)
    inner = root / "EXR_RGBD" if (root / "EXR_RGBD").is_dir() else root
    if (inner / "metadata.json").is_file() and (inner / "rgb").is_dir() and any((inner / "depth").glob("*.exr")):
        return "metadata.json, rgb/ and depth/*.exr"
    if (root / "metadata").is_file() and any((root / "rgbd").glob("*.depth")):
        return "metadata and rgbd/*.depth, an unpacked .r3d"
    return None


def read(
    root: str | Path,
    *,
    poses: bool = True,
    per_frame: bool = True,
    exr_channel: str | None = None,
    verify: bool = False,
    depth_range: Sequence[float] | None = None,
    max_step: float = 0.05,
) -> list[Recording]:
    """Open one capture.

    Args:
        root: the ``.r3d`` file or its folder, the folder of the EXR + RGB export or its parent, or the mp4.
        poses: use the device's poses. Captures of the front camera have none: theirs are all the identity.
        per_frame: use the intrinsics of each frame where the app wrote them, since autofocus and stabilisation change
            them; False = those of frame 0 for all.
        exr_channel: name of the depth channel. None = R, else the only one (the exports at hand have R; unconfirmed).
        verify: decode every frame once while opening, and leave out those that do not decode. Without it only frames
            whose first or last bytes are wrong are decoded.
        depth_range: m, nearest and furthest depth encoded by the mp4's colours. None = from the file, else 0, 3.
        max_step: m, largest difference between neighbouring pixels of the mp4's depth: beyond it the codec has blended
            colours.

    Returns:
        One recording; depth has its own resolution. Frames without a part, a usable pose or intrinsics are left out and
        reported, and so are damaged ones as far as ``verify`` checks. Damage detected later raises an error for that
        frame.

    Raises:
        FormatError: no frame, or damaged metadata.
        ImportError: the decoder of depth is not installed.
    """
    root = Path(root)
    if root.is_file() and root.suffix.lower() != ".r3d":
        return _read_film(root, depth_range, max_step)
    if root.is_file():
        members, inner, name = list_zip_members(root), root, root.stem
    elif root.is_dir():
        inner, name = root / "EXR_RGBD" if (root / "EXR_RGBD").is_dir() else root, root.resolve().name
        members = list_folder_members(inner)
    else:
        raise files.FormatError(root, "path", "no such file or folder", "a Record3D capture")
    table = next((members[table] for table in ("metadata.json", "metadata") if table in members), None)
    if table is None:
        raise files.FormatError(inner, "metadata", f"none among {format_count(len(members), 'file')}", _WHOLE_EXPORT)
    meta = _parse_metadata(table, per_frame)
    shots, report = _list_shots(members, inner)
    lengths = [len(rows) for rows in (meta.poses, meta.stamps) if rows is not None]
    n_rows = min(lengths + ([len(meta.K)] if len(meta.K) > 1 else []), default=math.inf)
    beyond = [shot.number for shot in shots if shot.number >= n_rows]
    uncovered = files.format_left_out(beyond, f"beyond the metadata's {n_rows} rows")
    shots = [shot for shot in shots if shot.number < n_rows]
    c2w, unposed, remarks = _select_posed([shot.number for shot in shots], meta, poses)
    posed = [shot for shot in shots if shot.number not in unposed]
    report += uncovered + remarks + files.format_left_out(sorted(unposed), "its pose is not usable (tracking lost)")
    files.refuse_if(not posed, inner, "frames", "; ".join(report) or "none", _WHOLE_EXPORT)
    hw, depth_hw = _find_sizes(posed, meta)
    load = partial(_load_frame, shots=tuple(posed), meta=meta, hw=hw, depth_hw=depth_hw, exr_channel=exr_channel)
    intact = [i for i, shot in enumerate(posed) if not (verify or _is_damaged(shot)) or _can_decode(load, i)]
    report += files.format_left_out([shot.number for i, shot in enumerate(posed) if i not in set(intact)], "damaged")
    files.refuse_if(not intact, inner, "frames", "; ".join(report), "frames that decode")
    first = posed[intact[0]].image
    exif = files.decode_image_header(first.read(), first.path).orientation
    number = torch.tensor([posed[i].number for i in intact])
    times, remarks = _frame_times(number, meta)
    return [
        Recording(
            name=name,
            format="record3d",
            load=partial(load, shots=tuple(posed[i] for i in intact)),
            number=number,
            root=root,
            times=times,
            poses=None if c2w is None else convert.to_poses(c2w[intact], table.path),
            rate_hz=meta.fps,
            report=tuple(report + remarks),
            stored=StoredSizes.of_images(hw, depth_hw, exif),
        )
    ]


@dataclass(frozen=True)
class _Shot:
    """The parts of one frame."""

    number: int
    image: Member
    depth: Member
    conf: Member | None


@dataclass(frozen=True, eq=False)
class _Metadata:
    """Contents of a capture's metadata; rows are indexed by frame number."""

    file: Path
    hw: tuple[int, int]  # of the images that K refers to
    depth_hw: tuple[int, int] | None
    fps: float | None
    K: np.ndarray  # (1 or n, 4) fx fy cx cy
    poses: np.ndarray | None  # (n, 7) qx qy qz qw px py pz
    stamps: np.ndarray | None  # (n,) s


def _load_frame(
    i: int,
    *,
    shots: tuple[_Shot, ...],
    meta: _Metadata,
    hw: tuple[int, int],
    depth_hw: tuple[int, int],
    exr_channel: str | None,
) -> Frame:
    """Position → frame."""
    shot = shots[i]
    image = files.decode_image(shot.image.read(), shot.image.path, hw)
    row = meta.K[shot.number if len(meta.K) > 1 else 0]
    K = convert.resize_K(convert.make_K(*row), meta.hw, hw)
    h, w = depth_hw
    part, conf = shot.depth, None
    if part.path.suffix == ".exr":
        depth = codec_exr.decode_exr(part.read(), part.path, exr_channel, depth_hw)
    else:
        content = lzfse.decompress_lzfse(part.read(), 4 * h * w, part.path, "depth")
        depth = np.frombuffer(content, "<f4").reshape(h, w)
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(depth) & (depth > 0)
    if shot.conf is not None:
        content = lzfse.decompress_lzfse(shot.conf.read(), h * w, shot.conf.path, "confidence")
        levels = np.frombuffer(content, np.uint8)
        files.refuse_if(levels.max() > 2, shot.conf.path, "confidence", int(levels.max()), "0, 1 or 2")
        conf = torch.from_numpy(levels.reshape(1, h, w).copy())
    return Frame(
        image=torch.from_numpy(image)[None],
        depth=torch.from_numpy(np.where(usable, depth, np.float32(0)))[None],
        camera=convert.to_camera(K, hw, meta.file, f"intrinsics of frame {shot.number}"),
        conf=conf,
    )


# --------------------------------------------------------------------------------------------------------- metadata


def _parse_metadata(table: Member, per_frame: bool) -> _Metadata:
    file = table.path
    value = files.decode_json(table.read(), file)
    files.refuse_if(not isinstance(value, dict), file, "JSON", type(value).__name__, "an object")
    hw = _parse_size(value, "h", "w", file)
    if hw is None:
        raise files.FormatError(file, "w, h", "nothing", "the size of the images")
    coefficients = _parse_rows(value, "perFrameIntrinsicCoeffs", 4, file) if per_frame else None
    if coefficients is None:
        K = files.to_array(value.get("K"), (9,), file, "K").reshape(3, 3).T  # stored by columns
        files.refuse_if(
            K[2].tolist() != [0, 0, 1] or K[0, 1] != 0 or K[1, 0] != 0,
            file,
            "K",
            K.T.ravel().tolist(),
            "fx 0 0 0 fy 0 cx cy 1",
        )
        coefficients = np.array([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]])
    elif not np.isfinite(coefficients).all():
        raise files.FormatError(
            file, "perFrameIntrinsicCoeffs", "a number that is not finite", "fx fy cx cy of each frame"
        )
    fps = value.get("fps")
    stamps = _parse_rows(value, "frameTimestamps", 1, file)
    return _Metadata(
        file=file,
        hw=hw,
        depth_hw=_parse_size(value, "dh", "dw", file),
        fps=None if fps is None else files.to_positive(fps, file, "fps"),
        K=coefficients,
        poses=_parse_rows(value, "poses", 7, file),
        stamps=None if stamps is None else stamps[:, 0],
    )


def _parse_size(value: Mapping[str, Any], high: str, wide: str, file: Path) -> tuple[int, int] | None:
    """(height, width); None where the metadata have neither."""
    if value.get(high) is None and value.get(wide) is None:
        return None
    h, w = (files.to_positive(value.get(key), file, key) for key in (high, wide))
    files.refuse_if(
        h != int(h) or w != int(w) or h * w > files.MAX_PIXELS,
        file,
        f"{wide}, {high}",
        f"{w:g}x{h:g}",
        f"whole numbers, 1 to {files.MAX_PIXELS} pixels",
    )
    return int(h), int(w)


def _parse_rows(value: Mapping[str, Any], key: str, width: int, file: Path) -> np.ndarray | None:
    """(n, width) numbers, NaN allowed; None where the key is missing or its list empty."""
    rows = value.get(key)
    if rows is None or rows == []:
        return None
    try:
        array = np.asarray(rows, dtype=np.float64).reshape(len(rows), width)
    except (TypeError, ValueError, OverflowError):
        raise files.FormatError(file, key, rows, f"{width} numbers for each frame") from None
    return array


# ------------------------------------------------------------------------------------------------------------ frames


def _list_shots(members: Mapping[str, Member], root: Path) -> tuple[list[_Shot], list[str]]:
    """Frames with image and depth (and confidence, if any frame has it) in numerical order; report of missing files."""
    parts: dict[int, dict[str, Member]] = {}
    for name, part in members.items():
        if match := _MEMBER_PATTERN.fullmatch(name):
            parts.setdefault(int(match[1]), {})["depth" if match[2] == "exr" else match[2]] = part
    files.refuse_if(not parts, root, "frames", "none", _WHOLE_EXPORT)
    required = ["jpg", "depth"] + (["conf"] if any("conf" in files_of for files_of in parts.values()) else [])
    names = {"jpg": "picture", "depth": "depth", "conf": "confidence"}
    shots, missing = [], dict[str, list[int]]()
    for number, files_of in sorted(parts.items()):
        absent = " and no ".join(names[part] for part in required if part not in files_of)
        if absent:
            missing.setdefault(f"no {absent}", []).append(number)
        else:
            shots.append(_Shot(number, files_of["jpg"], files_of["depth"], files_of.get("conf")))
    gaps = sorted(set(range(min(parts), max(parts))) - set(parts)) if max(parts) - min(parts) < 10 * len(parts) else []
    missing |= {"no file": gaps} if gaps else {}
    return shots, [line for reason, numbers in missing.items() for line in files.format_left_out(numbers, reason)]


def _select_posed(
    numbers: list[int], meta: _Metadata, use_poses: bool
) -> tuple[np.ndarray | None, set[int], list[str]]:
    """(camera-to-world of the frames with a usable pose, numbers of the others, report)."""
    if meta.poses is None or not use_poses or not numbers:
        return None, set(), []
    if (np.abs(meta.poses - [0, 0, 0, 1, 0, 0, 0]) <= 1e-9).all():  # front camera: no tracking
        return None, set(), ["every pose is the identity: no tracking"]
    rows = meta.poses[numbers]
    with np.errstate(invalid="ignore", over="ignore"):
        usable = np.isfinite(rows).all(-1) & (np.linalg.norm(rows[:, :4], axis=-1) > 1e-6)
    unposed = {number for number, ok in zip(numbers, usable, strict=True) if not ok}
    c2w = convert.to_c2w(rows[usable, :4], rows[usable, 4:], meta.file, "poses")
    return convert.cv_from_gl(c2w), unposed, []


def _frame_times(number: torch.Tensor, meta: _Metadata) -> tuple[torch.Tensor | None, list[str]]:
    """Times (s) since the first stamp of the capture; frame number / rate where stamps are missing or unordered."""
    nominal = None if meta.fps is None else number.double() / meta.fps
    if meta.stamps is None:
        return nominal, []
    times = torch.from_numpy(meta.stamps - meta.stamps[0])[number]
    if bool(torch.isfinite(times).all()) and bool((times.diff() > 0).all()):
        return times, []
    fallback = "the frame rate is used instead" if nominal is not None else "there are no times"
    return nominal, [f"time stamps do not increase: {fallback}"]


def _find_sizes(shots: list[_Shot], meta: _Metadata) -> tuple[tuple[int, int], tuple[int, int]]:
    """(height, width) of image and depth map, from the first frame whose headers can be read."""
    first_error: files.FormatError | None = None
    for shot in shots:
        try:
            hw = files.decode_image_header(shot.image.read(), shot.image.path).hw
            if shot.depth.path.suffix == ".exr":
                return hw, codec_exr.decode_exr_header(shot.depth.read(), shot.depth.path).hw
            if meta.depth_hw is not None:
                return hw, meta.depth_hw
            data = shot.depth.read()
            count = lzfse.lzfse_unpacked_size(data, shot.depth.path, "depth") if data.startswith(b"bvx") else len(data)
            if count / 4 not in _DEPTH_SIZES:
                expected = "dw and dh in the metadata, or 4 for each of " + ", ".join(map(str, _DEPTH_SIZES))
                raise files.FormatError(shot.depth.path, "depth", f"{count} bytes", expected)
            h, w = _DEPTH_SIZES[count // 4]
            return hw, ((h, w) if meta.hw[0] > meta.hw[1] else (w, h))
        except files.FormatError as error:
            first_error = first_error or error
    raise first_error or files.FormatError(meta.file, "frames", "none", "at least one")


def _is_damaged(shot: _Shot) -> bool:
    """Whether the first or last bytes of a part differ from the format's markers."""
    ends = shot.image.ends(2)
    return (ends is not None and ends != _JPEG_MARKERS) or any(
        part.path.suffix != ".exr" and (ends := part.ends(4)) is not None and ends[0][:3] + ends[1] != b"bvxbvx$"
        for part in (shot.depth, shot.conf)
        if part is not None
    )


def _can_decode(load: Callable[[int], Frame], i: int) -> bool:
    try:
        load(i)
    except files.FormatError:
        return False
    return True


# ---------------------------------------------------------------------------------------------------------- RGBD mp4


def _recognise_film(file: Path) -> str | None:
    """The content by which ``file`` is recognised as an RGBD mp4, as text; None if it is not."""
    if file.suffix.lower() != ".mp4":
        return None
    if _METADATA_START in _read_tail(file):
        return "an mp4 with an intrinsicMatrix at its end"
    side_car = file.parent / "metadata.json"
    if side_car.is_file() and _METADATA_START.strip(b'{"') in files.read_bytes(side_car, doors.MAX_TEXT_BYTES):
        return "an mp4 beside a metadata.json with an intrinsicMatrix"
    return None


def _read_film(file: Path, depth_range: Sequence[float] | None, max_step: float) -> list[Recording]:
    """Open one RGBD mp4."""
    meta, source = _read_film_metadata(file)
    header = video.read_video_header(file)
    hw = (header.hw[0], header.hw[1] // 2)
    K = files.to_array(meta.get("intrinsicMatrix", meta.get("K")), (9,), source, "intrinsicMatrix").reshape(3, 3).T
    limits = depth_range if depth_range is not None else meta.get("rangeOfEncodedDepth", _DEFAULT_RANGE_M)
    near, far = files.to_array(limits, (2,), source, "rangeOfEncodedDepth")
    if not 0 <= near < far <= 1e4 or header.hw[1] % 2:
        problem = f"{near} to {far} m in an image {header.hw[1]} px wide"
        raise files.FormatError(source, "rangeOfEncodedDepth", problem, "two increasing depths, two halves")
    camera = convert.to_camera(K, hw, source, "intrinsicMatrix")
    load = partial(
        _load_film_frame,
        file=file,
        hw=header.hw,
        camera=camera,
        near=float(near),
        far=float(far),
        max_step=files.to_positive(max_step, file, "option max_step"),
    )
    number = torch.arange(header.n)
    stamps, remarks = video.read_video_times(file), list[str]()
    times = None if header.rate_hz is None else number.double() / header.rate_hz
    if len(stamps) == header.n:  # from the first frame on, s
        times = torch.from_numpy(stamps - stamps[0])
    else:
        remarks = [f"the file has {len(stamps)} of {header.n} frames: times are those of the nominal rate"]
    return [
        Recording(
            name=file.stem,
            format="record3d",
            load=load,
            number=number,
            root=file,
            times=times,
            rate_hz=header.rate_hz,
            report=("no poses in this layout", *remarks),
        )
    ]


def _load_film_frame(
    i: int,
    *,
    file: Path,
    hw: tuple[int, int],  # of the whole image, both halves
    camera: Camera,
    near: float,  # m
    far: float,
    max_step: float,
) -> Frame:
    """Position → frame."""
    # Nearest: interpolating the half-size colour planes would blend hues.
    picture = video.read_video_frame(file, i, hw, nearest=True)
    half = hw[1] // 2
    image = np.ascontiguousarray(picture[:, half:].transpose(2, 0, 1))
    depth = decode_hue_depth(picture[:, :half], near, far, max_step)
    return Frame(torch.from_numpy(image)[None], torch.from_numpy(depth)[None], camera)


def decode_hue_depth(
    rgb: np.ndarray,  # (h, w, 3) uint8
    near: float,  # m, of hue 0
    far: float,  # m, of hue 1
    max_step: float,  # m
) -> np.ndarray:
    """Hues → depth (h, w) m float32; 0 near both ends of the range, beside a discontinuity and without hue."""
    x = rgb.astype(np.float32)
    r, g, b = x[..., 0], x[..., 1], x[..., 2]
    top, chroma = x.max(-1), np.ptp(x, -1)
    c = np.maximum(chroma, 1)
    sixth = np.where(top == r, (g - b) / c % 6, np.where(top == g, (b - r) / c + 2, (r - g) / c + 4))
    hue = sixth / 6
    depth = near + hue * (far - near)
    # of the maximum: coded pixels are saturated, grey has no hue
    usable = (hue >= _KEPT_RANGE_RATIO[0]) & (hue < _KEPT_RANGE_RATIO[1]) & (chroma >= 255 * 0.25)
    jump = np.maximum(_window_extreme(depth, np.maximum) - depth, depth - _window_extreme(depth, np.minimum)) > max_step
    return np.where(usable & ~jump, depth, 0).astype(np.float32)


def _window_extreme(x: np.ndarray, extreme: np.ufunc) -> np.ndarray:
    """Largest or smallest value (``np.maximum``, ``np.minimum``) in the 3×3 window of every pixel."""
    x = np.pad(x, 1, mode="edge")
    x = extreme(extreme(x[:-2], x[1:-1]), x[2:])
    return np.asarray(extreme(extreme(x[:, :-2], x[:, 1:-1]), x[:, 2:]))


def _read_film_metadata(file: Path) -> tuple[dict[str, Any], Path]:
    """The JSON object with the intrinsics, and the file that contains it."""
    tail = _read_tail(file)
    at = tail.rfind(_METADATA_START)
    if at < 0:
        side_car = file.parent / "metadata.json"
        files.refuse_if(
            not side_car.is_file(), file, "intrinsicMatrix", "neither in the file nor in a metadata.json", "one of them"
        )
        return files.read_json(side_car), side_car
    try:  # other bytes follow
        return json.JSONDecoder().raw_decode(tail[at:].decode("utf-8", errors="replace"))[0], file
    except (ValueError, RecursionError) as error:
        raise files.FormatError(file, "intrinsicMatrix", error, "a JSON object") from None


def _read_tail(file: Path) -> bytes:
    try:
        with doors.open_regular(file) as stream:
            stream.seek(-min(_TAIL_BYTES, stream.seek(0, 2)), 2)
            return stream.read()
    except OSError as error:
        raise files.FormatError(file, "file", error, "a readable file") from None
