"""Reader of folders of numbered RGB-D frames, in three layouts.

- *named*: ``frame-XXXXXX.color.{jpg,png}``, ``.depth.png``, ``.pose.txt`` (4×4) in one folder, as in 7-Scenes and
  its derivatives, with or without ``camera-intrinsics.txt`` (3×3).
- *counted*: ``images/*`` (or ``color/``, ``rgb/``), ``depth/*.png`` or ``.pgm``, and optionally
  ``poses.txt`` or ``pose.txt``: one line per frame, a 4×4 by rows or tx ty tz qx qy qz qw; or a 4×4 in a file for each
  frame, ``poses/*.txt`` or ``pose/*.txt``. ``K.txt`` (3×3; also ``cam_K.txt``, ``intrinsics.txt`` and the like).
- *single*: ``rgb.{jpg,png}``, ``raw_depth.png`` and ``intrinsics.txt`` (3×3), one frame without a pose.

Poses are camera-to-world with our axes. The intrinsics file applies to colour and depth unless ``K`` is set:
7-Scenes' depth (f = 585) is not registered to its colour (f = 525), and its file gives the depth camera's. A side-car
``meta.json`` (keys ``K``, ``K_depth``, ``dist``, ``depth_scale``, ``invalid``, ``fps``, and ``times`` and ``K_frames``
with a value for each image) is read where present; options
override it, and it overrides the intrinsics file.
"""

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.readers.image_folders import (
    FrameFiles,
    FrameLoader,
    choose_units,
    list_images,
    read_depth_type,
    read_K,
    read_pose,
    read_stored_sizes,
    split_lost,
)
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.no_depth import NO_DEPTH_CODES
from dhtorch.records import Pose

_NAMED_FRAME_PATTERN = re.compile(r"frame-(\d+)\.(color|depth|pose)\.(?:png|jpg|jpeg|pgm|txt)")
_IMAGE_FOLDERS = ("images", "color", "rgb")  # of the *counted* layout
_POSE_FILES = ("poses.txt", "pose.txt")
_POSE_FOLDERS = ("poses", "pose")
_INTRINSICS_FILES = (
    "K.txt",
    "camera-intrinsics.txt",
    "intrinsics.txt",
    "cam_K.txt",
    "camera_intrinsics.txt",
    "intrinsic.txt",
)

#: Depth codes of one metre where nothing states another. Source: convention of the layout, millimetres.
_UNITS_PER_METRE = 1000.0


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    pictures, poses = _find_image_folder(root), _first_existing(root, _POSE_FILES)
    if pictures is not None and list_images(root / "depth"):
        return f"{pictures.name}/ and depth/" + (f" and {poses.name}" if poses else "")
    if _single(root) is not None:
        return "rgb, raw_depth.png and intrinsics.txt"
    if root.is_dir() and any(_NAMED_FRAME_PATTERN.fullmatch(file.name) for file in root.iterdir()):
        return "frame-XXXXXX.{color,depth,pose} files"
    return None


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption | None = None,
    K: Sequence[float] | None = None,
    fov: float | None = None,
    K_depth: Sequence[float] | None = None,
    distortion: Sequence[float] | None = None,
    units_per_metre: float | None = None,
    invalid: Sequence[int] | None = None,
    rotated_bits: int = 0,
    fps: float | None = None,
    register: bool = True,
) -> list[Recording]:
    """Open a folder of numbered frames as one recording.

    Args:
        root: the folder.
        intrinsics: four numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the colour image. None = ``meta.json``, else the intrinsics file.
        fov: horizontal field of view of the colour image in degrees, for a guessed K where none is available.
        K_depth: as ``K``, of a depth map that is not registered to colour. None = ``meta.json``, else as colour.
        distortion: of the colour image, in OpenCV's order. None = ``meta.json``, else none.
        units_per_metre: of the depth codes. None = ``depth_scale`` of ``meta.json`` (below 1: metres of one code), else
            1000 (millimetres) is assumed.
        invalid: depth codes that mean *no return* beside 0. None = ``meta.json``, else 65535.
        rotated_bits: by which the depth codes are rotated to the left: 3 in SUN3D and SUN RGB-D.
        fps: frame rate, for time stamps. None = ``meta.json`` if it has a number, else no time stamps.
        register: warp depth with intrinsics of its own to the colour image (one z-buffer, holes are kept). The centres
            of the two cameras are assumed to coincide, since these sets have no extrinsics. False keeps the depth map
            and sets ``Frame.depth_camera``.

    Returns:
        One recording. In the named layout a frame without depth, pose or colour is left out and reported.

    Raises:
        FormatError: no frame, counts that disagree, a damaged file, or values that are no camera or pose.
    """
    root = Path(root)
    side_car = root / "meta.json"
    meta = files.read_json(side_car) if side_car.is_file() else {}
    frames, poses, report = _list_frames(root)
    hw = files.read_image_header(frames[0].image).hw
    depth_hw = read_depth_type(frames[0].depth)[0]
    stated = intrinsics_options.parse_intrinsics(root, hw, intrinsics, K, fov, features=False)
    colour_K = _read_intrinsics(root, "K", stated.K, meta)
    if colour_K is None:
        raise intrinsics_options.missing_intrinsics_error(root, None, "a file K.txt, intrinsics.txt or meta.json")
    lens = distortion if distortion is not None else meta.get("dist")
    colour = convert.to_camera(colour_K[0], hw, *colour_K[1:], lens)
    # Depth has a camera of its own only where K_depth is set: most sets of this layout are registered.
    depth_K = _read_intrinsics(root, "K_depth", K_depth, meta) if K_depth is not None or "K_depth" in meta else None
    other_K = _compare_with_file(root, colour_K, depth_K)  # read in any case: a file beside an option is not unread
    report += other_K if stated.K is None else []
    # No camera stores less than one code per metre: such a number is metres of one code, as RealSense's.
    units, source = choose_units(root, units_per_metre, meta, side_car, _UNITS_PER_METRE)
    units = 1 / units if units < 1 and units_per_metre is None else units
    value = fps if fps is not None else meta.get("fps")
    rate = None if value is None or isinstance(value, str) else files.to_positive(value, side_car, "fps")
    no_return = invalid if invalid is not None else meta.get("invalid", NO_DEPTH_CODES)
    if not isinstance(no_return, Sequence) or not all(isinstance(code, int) for code in no_return):
        raise files.FormatError(side_car, "invalid", no_return, "a list of depth codes")
    number = torch.tensor([frame.number for frame in frames])
    times = None if rate is None else number.double() / rate
    if fps is None and "times" in meta:
        times = torch.from_numpy(files.to_array(meta["times"], (len(frames),), side_car, "times"))
    if K is None and "K_frames" in meta:
        rows = files.to_array(meta["K_frames"], (len(frames), 4), side_car, "K_frames")
        cameras = [convert.to_camera(convert.make_K(*row), hw, side_car, "K_frames", lens) for row in rows]
        frames = [replace(frame, camera=camera) for frame, camera in zip(frames, cameras, strict=True)]
    load = FrameLoader(
        rows=tuple(frames),
        hw=hw,
        depth_hw=depth_hw,
        camera=colour,
        depth_camera=convert.to_camera(depth_K[0], depth_hw, *depth_K[1:]) if depth_K else None,
        units_per_metre=units,
        no_return=tuple(no_return),
        rotated_bits=rotated_bits,
        register=register,
    )
    load, stored = read_stored_sizes(load)
    return [
        Recording(
            name=root.resolve().name,
            format="frames_dir",
            load=load,
            number=number,
            root=root,
            times=times,
            poses=poses,
            rate_hz=rate,
            report=(*report, *stated.report),
            depth_unit=DepthUnit(1 / units, source),
            stored=stored,
        )
    ]


def _first_existing(root: Path, names: Sequence[str]) -> Path | None:
    return next((root / name for name in names if (root / name).is_file()), None)


def _find_image_folder(root: Path) -> Path | None:
    """The image folder of the *counted* layout; None where there is none."""
    return next((root / name for name in _IMAGE_FOLDERS if list_images(root / name)), None)


def _single(root: Path) -> FrameFiles | None:
    image = _first_existing(root, ("rgb.png", "rgb.jpg", "rgb.jpeg"))
    depth, K = root / "raw_depth.png", root / "intrinsics.txt"
    return FrameFiles(0, image, depth) if image is not None and depth.is_file() and K.is_file() else None


def _list_frames(root: Path) -> tuple[list[FrameFiles], Pose | None, list[str]]:
    """(frames, poses or None, report of what was left out) of the layout that ``root`` has."""
    if (pictures := _find_image_folder(root)) is not None or (root / "images").is_dir():
        folder = pictures or root / "images"
        images, depths = list_images(folder), list_images(root / "depth")
        file = _first_existing(root, _POSE_FILES)
        rows = None if file is None else files.read_table(file)
        files.refuse_if(not images, folder, "frames", "no image", "at least one .png or .jpg")
        # Rows have no names: they can be matched to images only if all counts are equal.
        counts = {"depth": len(depths)} | ({} if file is None or rows is None else {file.name: len(rows)})
        for field, count in counts.items():
            files.refuse_if(
                count != len(images),
                root,
                f"{field} count",
                count,
                f"{len(images)}, one for each file of {folder.name}/",
            )
        if images.keys() != depths.keys():
            unpaired = min(images.keys() ^ depths.keys())
            raise files.FormatError(
                root, "file names", f"{unpaired} in one of {folder.name}/ and depth/", "the same names in both"
            )
        stems = list(images)
        digits = [re.search(r"(\d+)\D*$", stem) for stem in stems]
        values = [int(m[1]) for m in digits if m]
        increasing = len(values) == len(stems) and all(a < b for a, b in itertools.pairwise(values))
        numbers = values if increasing else range(len(stems))
        frames = [FrameFiles(number, images[stem], depths[stem]) for number, stem in zip(numbers, stems, strict=True)]
        folders = [root / name for name in _POSE_FOLDERS]
        has_file = (each for each in folders if any((each / f"{stem}.txt").is_file() for stem in stems))
        source = file or next(has_file, None)
        if source is None:
            return frames, None, ["no poses.txt: no poses"]
        if rows is None:  # a file for each image, by its name
            places = [source / f"{stem}.txt" for stem in stems]
            poses = [read_pose(place) if place.is_file() else None for place in places]
        else:
            poses = _parse_poses(rows, source)
        frames, report = split_lost([replace(frame, c2w=pose) for frame, pose in zip(frames, poses, strict=True)])
        c2w = [frame.c2w for frame in frames if frame.c2w is not None]
        return frames, convert.to_poses(np.stack(c2w), source) if c2w else None, report
    single = _single(root)
    return ([single], None, ["no poses in this layout"]) if single is not None else _list_named_frames(root)


def _list_named_frames(root: Path) -> tuple[list[FrameFiles], Pose | None, list[str]]:
    parts: dict[int, dict[str, Path]] = {}
    for file in root.iterdir() if root.is_dir() else ():
        if match := _NAMED_FRAME_PATTERN.fullmatch(file.name):
            parts.setdefault(int(match[1]), {})[match[2]] = file
    frames, poses, report = [], list[np.ndarray](), []
    has_poses = any("pose" in files_of for files_of in parts.values())
    required = ("color", "depth", "pose") if has_poses else ("color", "depth")
    for number, files_of in sorted(parts.items()):
        missing = [part for part in required if part not in files_of]
        matrix = None if missing else files.read_table(files_of["pose"], 4) if has_poses else np.eye(4)
        if matrix is None:
            report.append(f"frame {number}: no {' and no '.join(missing)}: left out")
        elif not np.isfinite(matrix).all():
            report.append(f"frame {number}: its pose is not finite (tracking lost): left out")
        else:
            if matrix.shape != (4, 4):
                raise files.FormatError(files_of["pose"], "pose", f"{len(matrix)} rows", "4 rows of 4 numbers")
            poses.append(matrix)
            frames.append(FrameFiles(number, files_of["color"], files_of["depth"]))
    if not frames:
        problem = f"none complete among {len(parts)}" if parts else "none"
        expected = "frame-XXXXXX.color.{jpg,png}, .depth.png and .pose.txt"
        raise files.FormatError(root, "frames", problem, "; ".join([expected, *report[:1]]))
    if not has_poses:
        return frames, None, [*report, "no frame-XXXXXX.pose.txt: no poses"]
    try:
        return frames, convert.to_poses(np.stack(poses), root), report
    except files.FormatError:  # check one by one, so that the error names the file
        for frame, matrix in zip(frames, poses, strict=True):
            convert.to_poses(matrix[None], frame.image.with_name(f"{frame.image.name.split('.')[0]}.pose.txt"))
        raise


def _parse_poses(rows: np.ndarray, file: Path) -> list[np.ndarray | None]:
    """Camera-to-world (4, 4) of each row, not finite where its row is not or has no rotation."""
    if rows.shape[1] == 16:
        return list(rows.reshape(-1, 4, 4))
    files.refuse_if(
        rows.shape[1] != 7, file, "columns", rows.shape[1], "16 (4x4 by rows) or 7 (tx ty tz qx qy qz qw) numbers"
    )
    is_lost = ~np.isfinite(rows).all(-1) | ~rows[:, 3:].any(-1)
    c2w = convert.to_c2w(np.where(is_lost[:, None], [0, 0, 0, 1], rows[:, 3:]), rows[:, :3], file, "pose")
    c2w[is_lost] = np.nan
    return list(c2w)


def _read_intrinsics(
    root: Path, key: str, option: Sequence[float] | None, meta: dict[str, object]
) -> tuple[object, Path, str] | None:
    """(K, its file, its field) from the option, else the side-car, else the layout's own file; None if all lack it."""
    if option is not None:
        return convert.make_K(*files.to_array(option, (4,), root, f"option {key}")), root, f"option {key}"
    if key in meta:
        return meta[key], root / "meta.json", key
    file = _first_existing(root, _INTRINSICS_FILES)
    return (read_K(file), file, "K") if file else None


def _compare_with_file(root: Path, *used: tuple[object, Path, str] | None) -> list[str]:
    """Report where the intrinsics file states none of the ``used`` (K, file, field), which came from elsewhere."""
    file = _first_existing(root, _INTRINSICS_FILES)
    if file is None:
        return []
    stated = read_K(file)
    matrices = [files.to_array(source[0], (3, 3), *source[1:]) for source in used if source is not None]
    # Two matrices that state one camera may differ by rounding to three digits.
    if any(np.allclose(K, stated, rtol=1e-3) for K in matrices):
        return []
    return [
        f"{file.name} states another K than the one in use: f {stated[0, 0]:g}, c {stated[0, 2]:g} {stated[1, 2]:g}"
    ]
