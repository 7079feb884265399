"""Reader of Stray Scanner captures: a phone's video, LiDAR depth, confidence and odometry, one folder each.

``rgb.mp4`` (1920×1440, HEVC or H.264), ``depth/000000.png`` (16 bits, mm; ``.npy`` in very old captures),
``confidence/000000.png`` (0, 1, 2), ``odometry.csv`` with a row for every stored frame, and ``camera_matrix.csv``: K of
the *last* frame. Newer captures have K in every row, which is used instead. Poses are camera-to-world with our axes in
a world with y up. Images are stored in the sensor's orientation, also where the phone was held upright, and poses and K
refer to that orientation. Colour and depth are registered, so depth has the same K at its own size. ``imu.csv`` is not
read.

The ``n``-th row belongs to the ``n``-th frame *stored* in the video, presented or not: the app stamps the first one
before time 0, where an edit list may hide it. If their numbers differ, gaps and the length of the video show which rows
have a frame, whatever its rate (:func:`dhtorch.data.clocks.pair_film`). If not, the edges of depth and image may
show clearly that the first or the last frames were lost; else an option must decide.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.clocks import FilmPairing, format_numbers, pair_film
from dhtorch.data.codecs import pickles
from dhtorch.data.codecs.video import read_video_frame, read_video_header, read_video_times
from dhtorch.data.io import decode as files
from dhtorch.data.orientation import orientation_scores
from dhtorch.data.recording import Recording
from dhtorch.data.stored_sizes import StoredSizes, describe_mismatch
from dhtorch.data.units import DepthUnit
from dhtorch.geometry import camera as cameras
from dhtorch.records import Frame
from dhtorch.runtime.console import format_count

_ODOMETRY_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS_COLUMNS = ("fx", "fy", "cx", "cy")
_DEFAULT_HW = (1440, 1920)  # of the images, where there is no video
_UNITS_PER_METRE = 1000.0
_DEPTH_UNIT = DepthUnit(1 / _UNITS_PER_METRE, "Stray Scanner's definition of depth/*.png")
#: Lead of one pairing's edge score over the other's that each of these frames must show. Source: chosen: the right
#: pairing leads by 0.077 or more in the built-in room at 12 cm from frame to frame; on holo_stream and
#: 7s_redkitchen_400, where frames differ little, a wrong one leads by 0.09 in single frames, but not in all.
_MIN_EDGE_LEAD = 0.06


#: Files of the app that hold neither cameras nor poses.
UNUSED_FILES = ("imu.csv",)


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if (root / "depth").is_dir() and all((root / name).is_file() for name in ("odometry.csv", "camera_matrix.csv")):
        return "odometry.csv, camera_matrix.csv and depth/"
    return None


def read(
    root: str | Path,
    *,
    images: bool = True,
    poses: bool = True,
    per_frame: bool = True,
    lost_first: bool | None = None,
    K_hw: Sequence[int] | None = None,
) -> list[Recording]:
    """Open one capture.

    Args:
        root: its folder.
        images: read ``rgb.mp4``. False for a capture without video: the image of every frame then has no pixels,
            (1, 3, 0, 0), and cannot be mistaken for a dark one.
        poses: use the device's poses.
        per_frame: use the intrinsics of each frame where the capture has them; False = ``camera_matrix.csv`` for all.
        lost_first: where the video has fewer frames than there are rows, and its time stamps do not show which are
            missing: True = the first were lost, False = the last. None = compare the edges of a few frames, the only
            case in which opening decodes images.
        K_hw: (height, width) of the images that K refers to. None = the video's own, else 1440, 1920.

    Returns:
        One recording with the times of the odometry (s since the phone was started; the video's own are a 60 Hz grid).
        Rows without depth, confidence (if any frame has it), image or usable pose are left out and reported.

    Raises:
        FormatError: no frame, no ``rgb.mp4`` (unless ``images`` is False), or a damaged file.
        ImportError: no decoder of videos is installed.
    """
    root = Path(root)
    rows, report = _read_odometry(root / "odometry.csv")
    video = root / "rgb.mp4" if images else None
    if video is not None and not video.is_file():
        raise files.FormatError(video, "file", "no such file", "the images (data.images=false reads depth only)")
    header = None if video is None else read_video_header(video, all_frames=True)
    stated_hw = None
    if K_hw is not None:
        sides = files.to_array(K_hw, (2,), root, "option K_hw")
        stated_hw = (
            int(files.to_positive(sides[0], root, "option K_hw")),
            int(files.to_positive(sides[1], root, "option K_hw")),
        )
    hw = header.hw if header is not None else stated_hw or _DEFAULT_HW
    shots, missing = _list_shots(root, rows, poses)
    report += missing
    if (root / "distortion").is_dir():
        report.append("distortion/ has lens tables of each frame: they are not applied")
    files.refuse_if(not shots, root, "frames", "; ".join(report) or "none", "rows with depth and pose")
    table = root / "camera_matrix.csv"
    lines = [line.replace(",", " ").split() for line in files.read_lines(table) if line.strip()]
    K = files.to_array(lines, (3, 3), table, "K")
    load = _Load(root, tuple(shots), video, hw, K, stated_hw or hw, per_frame, _depth_hw(shots))
    if video is not None:
        load, remarks = _match_pictures(load, rows, lost_first)
        report += remarks
    stored, used = None, load.shots
    if header is not None:
        # The app leaves the display matrix and stores film and depth as the sensor sees, so that the matrix counts only
        # where their sizes contradict this.
        display = header.display if describe_mismatch(load.depth_hw, header.hw) else 0
        stored = StoredSizes(header.hw, load.depth_hw, display, "display matrix of rgb.mp4")
    times = torch.tensor([shot.row.time for shot in used], dtype=torch.float64)
    increasing = bool((times.diff() > 0).all())
    c2w = np.stack([shot.row.c2w for shot in used]) if poses else None
    return [
        Recording(
            name=root.resolve().name,
            format="stray",
            load=load,
            number=torch.tensor([shot.row.number for shot in used]),
            root=root,
            times=times if increasing else None,
            poses=None if c2w is None else convert.to_poses(c2w, root / "odometry.csv"),
            rate_hz=float(1 / times.diff().median()) if increasing and len(used) > 1 else None,
            report=tuple(report + ([] if increasing else ["time stamps do not increase: there are no times"])),
            depth_unit=_DEPTH_UNIT,
            stored=stored,
        )
    ]


@dataclass(frozen=True, eq=False)
class _Row:
    """One row of the odometry."""

    place: int  # index in the table
    number: int  # frame number in the file names
    time: float  # s
    c2w: np.ndarray  # (4, 4); NaN where tracking was lost
    K: np.ndarray | None  # fx fy cx cy


@dataclass(frozen=True, eq=False)
class _Shot:
    """A row with its files."""

    row: _Row
    depth: Path
    conf: Path | None
    picture: int = -1  # index in the video


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    root: Path
    shots: tuple[_Shot, ...]
    video: Path | None
    hw: tuple[int, int]
    K: np.ndarray  # (3, 3) of all frames that have none of their own
    K_hw: tuple[int, int]  # of the images that K refers to
    per_frame: bool
    depth_hw: tuple[int, int]

    def __call__(self, i: int) -> Frame:
        shot = self.shots[i]
        own = convert.make_K(*shot.row.K) if self.per_frame and shot.row.K is not None else self.K
        K, file = convert.resize_K(own, self.K_hw, self.hw), self.root / "camera_matrix.csv"
        camera = convert.to_camera(K, self.hw, file, f"intrinsics of frame {shot.row.number}")
        image = np.zeros((3, 0, 0), np.uint8) if self.video is None else self.picture(shot.picture).transpose(2, 0, 1)
        return Frame(
            image=torch.from_numpy(np.ascontiguousarray(image))[None],
            depth=torch.from_numpy(self.depth(shot))[None],
            camera=camera,
            depth_camera=cameras.resize(camera, self.hw, self.depth_hw) if self.video is None else None,
            conf=None if shot.conf is None else torch.from_numpy(self._conf(shot.conf))[None],
        )

    def picture(self, number: int) -> np.ndarray:
        """(H, W, 3) uint8."""
        assert self.video is not None
        return read_video_frame(self.video, number, self.hw, all_frames=True)

    def depth(self, shot: _Shot) -> np.ndarray:
        """(h, w) m."""
        if shot.depth.suffix == ".png":
            return files.read_depth_png(shot.depth, _UNITS_PER_METRE, self.depth_hw)
        code = pickles.read_npy(shot.depth)
        if not isinstance(code, np.ndarray) or code.dtype != np.uint16 or code.shape != self.depth_hw:
            actual = f"{getattr(code, 'dtype', type(code).__name__)} of shape {getattr(code, 'shape', None)}"
            raise files.FormatError(shot.depth, "depth", actual, f"uint16 of shape {self.depth_hw}")
        return code.astype(np.float32) / np.float32(_UNITS_PER_METRE)

    def _conf(self, file: Path) -> np.ndarray:
        conf = files.read_image(file, self.depth_hw)[0]  # some writers store three equal channels
        files.refuse_if(conf.max() > 2, file, "confidence", int(conf.max()), "0, 1 or 2")
        return np.ascontiguousarray(conf)


# ------------------------------------------------------------------------------------------------------------- tables


def _read_odometry(file: Path) -> tuple[list[_Row], list[str]]:
    """(rows, report) of the odometry, by the header's names; extra columns and empty cells are allowed."""
    try:
        lines = [[cell.strip() for cell in line] for line in csv.reader(files.read_lines(file))]
    except csv.Error as error:
        raise files.FormatError(file, "table", error, "comma-separated columns") from None
    lines = [line for line in lines if any(line)]
    head = lines[0] if lines else []
    files.refuse_if(
        not set(_ODOMETRY_COLUMNS) <= set(head),
        file,
        "header",
        ", ".join(head) or "nothing",
        ", ".join(_ODOMETRY_COLUMNS),
    )
    body, report = lines[1:], list[str]()
    if body and len(body[-1]) < len(head):
        body, report = body[:-1], ["the last row of odometry.csv is cut off: left out"]
    rows: list[_Row] = []
    for place, line in enumerate(body):
        files.refuse_if(
            len(line) != len(head), file, f"row {place}", f"{len(line)} columns", f"{len(head)}, as the header"
        )
        cells = dict(zip(head, line, strict=True))
        number = cells["frame"]
        files.refuse_if(
            not (number.isascii() and number.isdigit() and len(number) <= 9),
            file,
            f"row {place} frame",
            number,
            "a frame number",
        )
        value = {
            name: _parse_number(cells[name], file, f"row {place} {name}")
            for name in _ODOMETRY_COLUMNS[:1] + _ODOMETRY_COLUMNS[2:]
        }
        files.refuse_if(
            not np.isfinite(value["timestamp"]), file, f"row {place} timestamp", cells["timestamp"], "a time in s"
        )
        t, q = (
            np.array([[value[name] for name in names]]) for names in (_ODOMETRY_COLUMNS[2:5], _ODOMETRY_COLUMNS[5:9])
        )
        with np.errstate(over="ignore"):
            usable = np.isfinite(t).all() and 1e-6 < np.linalg.norm(q) < np.inf
        c2w = convert.to_c2w(q, t, file)[0] if usable else np.full((4, 4), np.nan)
        own = [_parse_number(cells.get(name, ""), file, f"row {place} {name}") for name in _INTRINSICS_COLUMNS]
        row = _Row(place, int(number), value["timestamp"], c2w, np.array(own) if np.isfinite(own).all() else None)
        if rows and row.number <= rows[-1].number:
            raise files.FormatError(file, f"row {place} frame", row.number, f"a number beyond {rows[-1].number}")
        rows.append(row)
    return rows, report


def _parse_number(cell: str, file: Path, field: str) -> float:
    try:
        return float(cell) if cell else float("nan")
    except ValueError:
        raise files.FormatError(file, field, cell, "a number") from None


# ------------------------------------------------------------------------------------------------------------- frames


def _list_shots(root: Path, rows: list[_Row], poses: bool) -> tuple[list[_Shot], list[str]]:
    """(rows with all their files, report of those left out by reason)."""
    depth = {file.stem: file for kind in ("npy", "png") for file in sorted((root / "depth").glob(f"*.{kind}"))}
    conf = {file.stem: file for file in sorted((root / "confidence").glob("*.png"))}
    shots, missing = [], dict[str, list[int]]()
    for row in rows:
        name = f"{row.number:06d}"
        if name not in depth:
            missing.setdefault("no depth", []).append(row.number)
        elif conf and name not in conf:
            missing.setdefault("no confidence", []).append(row.number)
        elif poses and not np.isfinite(row.c2w).all():
            missing.setdefault("its pose is not usable (tracking lost)", []).append(row.number)
        else:
            shots.append(_Shot(row, depth[name], conf.get(name)))
    extra = sorted(depth.keys() - {f"{row.number:06d}" for row in rows})
    report = [line for reason, numbers in missing.items() for line in files.format_left_out(numbers, reason)]
    return shots, report + files.format_left_out(extra, "no row in odometry.csv")


def _depth_hw(shots: list[_Shot]) -> tuple[int, int]:
    """(h, w) of the depth maps, from the first that can be read; old ``.npy`` maps must be read whole."""
    error = None
    for shot in shots:
        try:
            if shot.depth.suffix == ".png":
                return files.read_image_header(shot.depth).hw
            h, w = np.shape(pickles.read_npy(shot.depth))
            return int(h), int(w)
        except ValueError as failure:
            error = error or failure
    raise (
        error
        if isinstance(error, files.FormatError)
        else files.FormatError(shots[0].depth, "depth", error, "a depth map")
    )


# ---------------------------------------------------------------------------------------------- rows and the pictures


def _match_pictures(load: _Load, rows: list[_Row], lost_first: bool | None) -> tuple[_Load, list[str]]:
    """(loader with the shots that have a picture, numbered; report)."""
    assert load.video is not None
    n = read_video_header(load.video, all_frames=True).n
    times = read_video_times(load.video, all_frames=True)
    counts = f"rgb.mp4 has {format_count(len(times), 'frame')} for {format_count(len(rows), 'row')}"
    pairing, report = FilmPairing(np.arange(n)), list[str]()
    if len(times) == n or n != len(rows):  # else it is cut off and lacks its last frames, which its index counts
        candidates = pair_film(times, np.array([row.time for row in rows]))
        pairing, choice = _choose_pairing(load, candidates, len(times) - len(rows), lost_first)
        report += [f"{counts}: {choice}"] if choice else []
    picture = pairing.picture.tolist()
    shots = [replace(shot, picture=picture[shot.row.place]) for shot in load.shots if picture[shot.row.place] >= 0]
    files.refuse_if(not shots, load.video, "frames", f"{n} frames", "at least one with depth and pose")
    lost = [row.number for row in rows if picture[row.place] < 0]
    if lost:
        verb = "have" if len(lost) > 1 else "has"
        report.append(f"{format_numbers(lost, 'row')} {verb} no picture in rgb.mp4: left out")
    return replace(load, shots=tuple(shots)), report


def _choose_pairing(
    load: _Load, candidates: list[FilmPairing], surplus: int, lost_first: bool | None
) -> tuple[FilmPairing, str]:
    """The pairing by stamps, option or edges where the film has ``surplus`` pictures more than rows, and the choice.

    Raises:
        FormatError: pictures are missing, and neither stamps nor edges show which.
    """
    early, late = candidates[0], candidates[-1]  # the film lacks its last pictures, or its first
    if len(candidates) == 1:
        factor = early.speed if early.speed > 1 else 1 / early.speed
        word = "fast" if early.speed > 1 else "slow"
        # Ratio of the clocks of film and rows from which it is reported. Source: chosen: 60 and 59.94 Hz are one
        # rate.
        pace = "" if factor < 1.02 else f", it plays {factor:.4g} times as {word}"
        return early, f"paired by their time stamps{pace}" if early.by_stamps else ""
    if surplus > 0 and lost_first is None:
        return early, "paired from the first on"
    if lost_first is not None:
        first_lost, reason = lost_first, "option lost_first"
    else:
        leads = _edge_leads(load, early, late)
        is_clear = len(leads) > 1 and (leads.min() >= _MIN_EDGE_LEAD or leads.max() <= -_MIN_EDGE_LEAD)
        if not is_clear:
            shortage = f"{-surplus} pictures less than rows at a constant rate, which does not show the lost ones"
            expected = "stamps with gaps, or data.lost_first=true (the film lacks its first ones) or false (its last)"
            raise files.FormatError(load.video or load.root, "frames", shortage, expected)
        first_lost, reason = bool(leads[0] < 0), "by the edges of depth and image"
    lost = f"its {'first' if first_lost else 'last'} frame{'s are' if surplus < -1 else ' is'} lost"
    return (late if first_lost else early), f"{lost} ({reason})"


def _edge_leads(load: _Load, early: FilmPairing, late: FilmPairing) -> np.ndarray:
    """By how much depth fits the picture of the early pairing better than that of the late one, for a few rows."""
    both = [shot for shot in load.shots if min(p.picture[shot.row.place] for p in (early, late)) >= 0]
    leads = []
    # frames decoded to determine whether the first or last video frames were lost
    for shot in both[:: max(1, len(both) // 6)]:
        try:
            depth = torch.from_numpy(load.depth(shot))
            pictures = [load.picture(int(p.picture[shot.row.place])).transpose(2, 0, 1) for p in (early, late)]
        except files.FormatError:
            continue
        scores = [float(orientation_scores(torch.from_numpy(picture), depth, (0,))) for picture in pictures]
        leads.append(scores[0] - scores[1])
    return np.array(leads)
