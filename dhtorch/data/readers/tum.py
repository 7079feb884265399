"""Reader of TUM RGB-D sequences and their variants: colour, depth and a trajectory, each with its own time stamps.

``rgb/<stamp>.png``, ``depth/<stamp>.png`` (16 bits, already registered to colour), listed with their stamps in
``rgb.txt`` and ``depth.txt`` (or ``associations.txt``, or by the file names alone), and ``groundtruth.txt`` with
``stamp tx ty tz qx qy qz qw``, the pose of the colour camera in the capture hall.

- *TUM*: 5000 codes are 1 m; K is the published one of the camera that the folder's name or the trajectory names.
- *ICL-NUIM*: numbers in place of stamps, depth in the first columns of ``associations.txt``, ``*.gt.freiburg`` as
  trajectory. 5000 codes are 1 m. The published K has a negative fy, since the renderer's y axes point up; the images
  are upright. fy is read as positive, and the poses, of camera and world with y up, are mirrored to y down.
- *Recorders for ROS*, ETH3D's SLAM benchmark: ``calibration.txt`` holds fx fy cx cy. Nothing states the unit of depth:
  1/5000 m is assumed.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data import intrinsics as intrinsics_options
from dhtorch.data.io import decode as files
from dhtorch.data.readers import image_folders
from dhtorch.data.recording import Recording
from dhtorch.data.units import DepthUnit
from dhtorch.records import Camera

#: Published calibration of the three colour cameras at 640×480: fx fy cx cy, then k1 k2 p1 p2 k3.
_CAMERA_CALIBRATIONS = {
    1: ((517.306408, 516.469215, 318.643040, 255.313989), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    2: ((520.908620, 521.007327, 325.141442, 249.701764), (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    3: ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
_ROS_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
_IMAGE_HW = (480, 640)
_RATE_HZ = 30.0

#: K of ICL-NUIM at 640×480, fx fy cx cy; published with a negative fy. Source: the data set's page.
_ICL_INTRINSICS = (481.2, 480.0, 319.5, 239.5)

#: Depth codes of one metre. Source: format definition of TUM RGB-D and ICL-NUIM.
_UNITS_PER_METRE = 5000.0


#: Files with fx fy cx cy, or a 3×3 matrix, and distortion.
_CALIBRATION_FILES = ("calibration.txt", "K.txt", "camera-intrinsics.txt", "intrinsics.txt")

#: Tables with the stamps and names of both images in each line.
_JOINT_TABLES = ("associations.txt", "association.txt", "associated.txt", "associate.txt", "assoc.txt")

#: Names of ICL-NUIM's sequences and of its trajectories.
_ICL_NAME_PATTERN = re.compile(r"(living_?room|office_?room).*(traj|kt)\d|traj\d_frei_png", re.IGNORECASE)
_ICL_TRAJECTORIES = "*.gt.freiburg"

#: Stem of an image that is named by its time stamp in s.
_STAMP_PATTERN = re.compile(r"\d+\.\d+")

#: Reflection of the y axis, of camera and world: from y up to y down.
_FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])

#: Files of the format that hold neither cameras nor poses of the camera.
UNUSED_FILES = ("accelerometer.txt", *_JOINT_TABLES)


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if not (root / "rgb").is_dir() or not (root / "depth").is_dir():
        return None
    has_listing = any((root / name).is_file() for name in ("rgb.txt", "groundtruth.txt", *_JOINT_TABLES))
    if not (has_listing or _is_icl(root) or any(_STAMP_PATTERN.fullmatch(e.stem) for e in (root / "rgb").iterdir())):
        return None  # plain numbers are no stamps
    return "rgb/ and depth/ folders of time-stamped images"


def read(
    root: str | Path,
    *,
    intrinsics: intrinsics_options.IntrinsicsOption = "camera",
    K: Sequence[float] | None = None,
    fov: float | None = None,
    camera: int | str | None = None,
    poses: bool = True,
    max_difference: float = 0.02,
    units_per_metre: float | None = None,
) -> list[Recording]:
    """Open one sequence.

    Args:
        root: the folder of the sequence.
        intrinsics: ``"camera"`` = the published calibration of the camera that took it, with its distortion;
            ``"ros"`` = the driver's default used to register the depth (f = 525, no distortion); or four
            numbers as ``K``, or one as ``fov``.
        K: fx, fy, cx, cy of the images, without distortion. A negative fy is that of a camera with y up, as ICL-NUIM's.
        fov: horizontal field of view of the images in degrees, for a guessed K where none is available.
        camera: 1, 2, 3 or icl. None = ``calibration.txt``; failing this, the ``freiburgN`` (``frN``) in the folder's
            name or in the trajectory's header, or ICL-NUIM's names; failing all, ``K`` and ``dist`` of a side-car
            ``meta.json``.
        poses: read the trajectory; frames that it does not cover are left out. False keeps every RGB-D frame.
        max_difference: s, largest time difference of associated images, depth maps and poses.
        units_per_metre: of the depth codes. None = ``depth_scale`` of ``meta.json``, else 5000, as TUM and ICL-NUIM
            document; of other sequences this is an assumption. ORB-SLAM2 uses 5208 for camera 2, and factors for each
            camera are quoted elsewhere (unconfirmed, or already applied in the files).

    Returns:
        One recording at the stamps of the colour images. Poses are interpolated between the two neighbouring ones
        where these are less than 0.05 s apart, else the nearest one within ``max_difference`` is used. Images without
        depth or pose are left out and reported. Where numbers stand in place of stamps, images, depth maps and poses of
        one number belong together.

    Raises:
        FormatError: no image, nothing associates, an unknown camera, or a damaged file.
    """
    root = Path(root)
    (colour, is_numbered), (depth, _) = _read_listing(root, "rgb"), _read_listing(root, "depth")
    pairs = associate([t for t, _ in colour], [t for t, _ in depth], max_difference)
    if not pairs:
        problem = f"{len(colour)} images and {len(depth)} depth maps, none within {max_difference} s of one another"
        raise files.FormatError(root, "time stamps", problem, "pairs")
    times = np.array([colour[i][0] for i, _ in pairs])
    report = _format_unmatched(len(colour) - len(pairs), "images", "depth map", max_difference, is_numbered)
    hw = files.read_image_header(colour[pairs[0][0]][1]).hw
    lens, remarks, data_set, is_y_up = _find_camera(root, intrinsics, camera, hw, K, fov)
    side_car = root / "meta.json"
    stated = None if data_set is None else f"{data_set} stores 1/5000 m"
    meta = files.read_json(side_car) if units_per_metre is None and side_car.is_file() else {}
    units, source = image_folders.choose_units(root, units_per_metre, meta, side_car, _UNITS_PER_METRE, stated)
    candidates = (root / "groundtruth.txt", *sorted(root.glob(_ICL_TRAJECTORIES)))
    trajectory = next((file for file in candidates if file.is_file()), None)
    c2w = None
    if poses and trajectory is not None:
        interpolate = _match_numbers if is_numbered else _interpolate_trajectory
        c2w, covered = interpolate(trajectory, times, max_difference)
        if is_numbered:
            report += files.format_left_out(times[~covered].astype(int).tolist(), f"no pose in {trajectory.name}")
        else:
            report += _format_unmatched(int((~covered).sum()), "RGB-D frames", "pose", max_difference, is_numbered)
        pairs = [pair for pair, keep in zip(pairs, covered, strict=True) if keep]
        times = times[covered]
        if is_y_up:
            c2w = _FLIP_Y @ c2w @ _FLIP_Y
    rows = tuple(
        image_folders.FrameFiles(int(t) if is_numbered else i, colour[i][1], depth[j][1])
        for (i, j), t in zip(pairs, times, strict=True)
    )
    load = image_folders.FrameLoader(
        rows=rows,
        hw=hw,
        depth_hw=image_folders.read_depth_type(rows[0].depth)[0],
        camera=lens,
        units_per_metre=units,
    )
    has_times = not is_numbered or data_set == "ICL-NUIM"
    if not has_times:
        report.append("images are numbered, not stamped: no times")
    load, stored = image_folders.read_stored_sizes(load)
    return [
        Recording(
            name=root.resolve().name,
            format="tum",
            load=load,
            number=torch.tensor([row.number for row in rows]),
            root=root,
            times=torch.tensor(times / _RATE_HZ if is_numbered else times, dtype=torch.float64) if has_times else None,
            poses=None if c2w is None else convert.to_poses(c2w, trajectory or root),
            rate_hz=_RATE_HZ if has_times else None,
            report=(*report, *remarks),
            depth_unit=DepthUnit(1 / units, source),
            stored=stored,
        )
    ]


def associate(times_a: Sequence[float], times_b: Sequence[float], max_difference: float) -> list[tuple[int, int]]:
    """One-to-one pairs (i, j), sorted by i, of stamps less than ``max_difference`` s apart; the closest pair first."""
    order = np.argsort(np.asarray(times_b, dtype=np.float64), kind="stable")
    sorted_b = np.asarray(times_b, dtype=np.float64)[order]
    candidates = []
    for i, t in enumerate(times_a):
        low, high = np.searchsorted(sorted_b, (t - max_difference, t + max_difference), "left")
        candidates += [(abs(t - sorted_b[k]), i, int(order[k])) for k in range(low, high)]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for difference, i, j in sorted(candidates):
        if difference < max_difference and i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return sorted(pairs.items())


def _format_unmatched(count: int, what: str, without: str, max_difference: float, is_numbered: bool) -> list[str]:
    within = "of their number" if is_numbered else f"within {max_difference} s"
    return [f"{count} {what} without a {without} {within}: left out"] if count else []


def _read_listing(root: Path, kind: str) -> tuple[list[tuple[float, Path]], bool]:
    """(stamp, file) of the images of ``kind`` ("rgb" or "depth"), sorted by stamp, and whether stamps are numbers.

    Of two images with one stamp the first is kept.
    """
    table = root / f"{kind}.txt"
    joint = next((root / name for name in _JOINT_TABLES if (root / name).is_file()), None)
    if table.is_file():
        rows = [(table, line, words[:2]) for line, words in files.read_rows(table)]
    elif joint is not None:
        # Stamp and name are found by the folder in the names, not by position. Names of other folders: colour stands in
        # the first two columns, depth in the next two, as in TUM's files.
        usual, rows = 1 if kind == "rgb" else 3, []
        for line, words in files.read_rows(joint):
            place = next((i for i, word in enumerate(words) if Path(word).parent.name == kind), usual)
            rows.append((joint, line, list(words[max(place - 1, 0) : place + 1])))
    else:
        pictures = image_folders.list_images(root / kind)
        rows = [(root / kind, i, [stem, f"{kind}/{pictures[stem].name}"]) for i, stem in enumerate(pictures)]
    by_stamp: dict[float, Path] = {}
    for file, line, words in rows:
        files.refuse_if(
            len(words) != 2 or not re.fullmatch(r"\d+(\.\d*)?", words[0]),
            file,
            f"line {line}",
            " ".join(words) or "nothing",
            "a time stamp and a file name",
        )
        picture = Path(words[1])
        files.refuse_if(
            picture.is_absolute() or ".." in picture.parts,
            file,
            f"line {line}",
            words[1],
            "a file inside the sequence's folder",
        )
        by_stamp.setdefault(float(words[0]), root / picture)
    files.refuse_if(not by_stamp, root, f"{kind} frames", "none", f"time-stamped images in {kind}/")
    # Stamps of digits alone are frame numbers below this limit; as seconds it is 11 days after 1970. Source: chosen.
    is_numbered = all(words[0].isdigit() for _, _, words in rows) and max(by_stamp) < 1e6
    return sorted(by_stamp.items()), is_numbered


def _match_numbers(file: Path, numbers: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrices of the frames whose number has a row, and the mask (n,) of these frames."""
    rows = {row[0]: row for row in _read_trajectory(file)}
    covered = np.array([number in rows for number in numbers])
    files.refuse_if(
        not covered.any(), file, "frame numbers", "none of the images", f"{numbers[0]:g} to {numbers[-1]:g}"
    )
    kept = np.stack([rows[number] for number in numbers[covered]])
    return convert.to_c2w(kept[:, 4:], kept[:, 1:4], file), covered


def _read_trajectory(file: Path) -> np.ndarray:
    """Rows (n, 8) with a finite pose, sorted by stamp, one for each stamp."""
    rows = files.read_table(file, 8)
    rows = rows[np.isfinite(rows).all(-1) & (np.linalg.norm(rows[:, 4:], axis=-1) > 1e-6)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    files.refuse_if(len(rows) == 0, file, "poses", "no usable row", "rows of stamp, position and quaternion")
    return rows


def _interpolate_trajectory(file: Path, times: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world matrices of the covered ``times``, and the mask (n,) of covered times."""
    rows = _read_trajectory(file)
    after = np.searchsorted(rows[:, 0], times, "left").clip(1, max(len(rows) - 1, 1)).clip(max=len(rows) - 1)
    before = (after - 1).clip(0)
    a, b = rows[before], rows[after]
    span = b[:, 0] - a[:, 0]
    weight = (times - a[:, 0]) / np.where(span > 0, span, 1)
    nearest_weight = np.where(weight > 0.5, 1.0, 0.0)
    nearest = np.minimum(np.abs(times - a[:, 0]), np.abs(times - b[:, 0]))
    # Largest interval in s between two poses to interpolate in: across longer ones tracking was lost.
    interpolated = (weight >= 0) & (weight <= 1) & (span < 0.05)
    covered = interpolated | (nearest < max_difference)
    files.refuse_if(
        not covered.any(), file, "time stamps", f"no pose within {max_difference} s of any image", "overlapping clocks"
    )
    weight = np.where(interpolated, weight, nearest_weight)[covered, None]
    a, b = a[covered], b[covered]
    # q and −q are one rotation; over 10 ms or less linear interpolation of quaternions equals slerp.
    sign = np.where((a[:, 4:] * b[:, 4:]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    q = (1 - weight) * a[:, 4:] + weight * sign * b[:, 4:]
    return convert.to_c2w(q, (1 - weight) * a[:, 1:4] + weight * b[:, 1:4], file), covered


def _find_camera(
    root: Path,
    intrinsics: intrinsics_options.IntrinsicsOption,
    camera: int | str | None,
    hw: tuple[int, int],
    K: Sequence[float] | None,
    fov: float | None,
) -> tuple[Camera, tuple[str, ...], str | None, bool]:
    """Camera of a sequence, report, data set whose unit of depth is documented, whether its trajectory has y up."""
    files.refuse_if(
        isinstance(intrinsics, str) and intrinsics not in ("camera", "ros"),
        root,
        "option intrinsics",
        intrinsics,
        "camera or ros",
    )
    files.refuse_if(camera not in (None, "icl", *_CAMERA_CALIBRATIONS), root, "option camera", camera, "1, 2, 3 or icl")
    number = camera if isinstance(camera, int) else None if camera == "icl" else _find_camera_number(root)
    is_icl = camera == "icl" or (camera is None and number is None and _is_icl(root))
    data_set = "ICL-NUIM" if is_icl else None if number is None else "TUM RGB-D"
    option = intrinsics_options.parse_intrinsics(root, hw, None if isinstance(intrinsics, str) else intrinsics, K, fov)
    calibration = next((root / name for name in _CALIBRATION_FILES if (root / name).is_file()), None)
    report, side_car = option.report, root / "meta.json"
    place, field = root, "K"
    values: Sequence[float]
    distortion: Sequence[float] | np.ndarray | None = None
    if option.K is not None:
        values, field = option.K, "option K"
    elif calibration is not None and camera is None and intrinsics == "camera":
        (values, distortion), place, field = _read_calibration(calibration), calibration, "fx fy cx cy"
    elif is_icl:
        matrix, scaled = image_folders.fit_K(convert.make_K(*_ICL_INTRINSICS), _IMAGE_HW, hw, Path("ICL-NUIM"))
        return convert.to_camera(matrix, hw, root), (*scaled, *report), data_set, True
    elif number is not None or intrinsics != "camera":
        files.refuse_if(
            hw != _IMAGE_HW, root, "image size", f"{hw[1]}x{hw[0]}", "640x480, the size of the published calibration"
        )
        values, distortion = _ROS_INTRINSICS, None
        if number and intrinsics == "camera":
            values, distortion = _CAMERA_CALIBRATIONS[number]
    elif side_car.is_file():
        meta = files.read_json(side_car)
        return convert.to_camera(meta.get("K"), hw, side_car, "K", meta.get("dist")), report, data_set, False
    else:
        raise intrinsics_options.missing_intrinsics_error(
            root, None, "data.camera=1, 2, 3 (freiburg) or icl, data.intrinsics=ros", "calibration.txt, meta.json"
        )
    fx, fy, cx, cy = values
    if fy < 0 and not is_icl:  # ICL-NUIM's published K is known to have a negative fy
        report = (*report, "K has a negative fy: that of a camera with y up; read as positive, poses are mirrored")
    K_up = convert.make_K(fx, abs(fy), cx, cy)
    return convert.to_camera(K_up, hw, place, field, distortion), report, data_set, fy < 0 or is_icl


def _read_calibration(file: Path) -> tuple[list[float], np.ndarray | None]:
    """(fx fy cx cy, distortion or None) of four numbers, with or without distortion, or of a 3×3 matrix."""
    words = [word for _, row in files.read_rows(file) for word in row]
    expected = "fx fy cx cy, with or without 4 or 5 numbers of distortion, or a 3x3 matrix"
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise files.FormatError(file, "numbers", " ".join(words), expected) from None
    if len(values) == 9 and values[6:] == [0, 0, 1]:
        return [values[0], values[4], values[2], values[5]], None
    files.refuse_if(len(values) not in (4, 8, 9), file, "numbers", " ".join(words), expected)
    return values[:4], np.array(values[4:]) if values[4:] else None


def _is_icl(root: Path) -> bool:
    """Whether the trajectory or the folder has a name of ICL-NUIM."""
    return any(root.glob(_ICL_TRAJECTORIES)) or _ICL_NAME_PATTERN.search(root.resolve().name) is not None


def _find_camera_number(root: Path) -> int | None:
    """1, 2 or 3 from the folder's name, else from the trajectory's header comments; None if neither names a camera."""
    texts = [root.resolve().name]
    if (root / "groundtruth.txt").is_file():
        lines = files.read_lines(root / "groundtruth.txt")[:5]
        texts += [line for line in lines if line.startswith("#")]
    matches = [m for text in texts if (m := re.search(r"(?:freiburg|fr)([123])(?![0-9])", text))]
    return int(matches[0][1]) if matches else None
