"""Reader of CA-1M (Cubify Anything): ARKitScenes captures with laser-scan pose and depth for every frame.

One WebDataset archive ``ca1m-<split>-<video id>.tar`` per capture, with members ``<video id>/<nanoseconds>.<what>``:
``wide/image`` (PNG), ``wide/depth`` (16 bits, mm, the iPad's LiDAR), ``wide/depth/confidence`` (TIFF), ``gt/depth``
(16 bits, mm, rendered from the laser scan, 0 = not registered), ``wide/image/K``, ``wide/depth/K``, ``gt/depth/K``
(JSON, 3×3) and ``gt/RT`` (JSON, 4×4). The archive is read in place.

Images are stored upright, so sizes may be transposed; K and pose refer to the stored images. ``T_gravity`` and the
boxes (``instances``) are not read: no stage needs them. Extensions are ignored; a member's format is determined by
content.
"""

import re
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dhtorch.data import convert
from dhtorch.data.codecs import tarballs, tiff
from dhtorch.data.io import decode as files
from dhtorch.data.laser import resample_laser_depth
from dhtorch.data.recording import MeasuredRecording, Recording, Recordings
from dhtorch.data.units import DepthUnit
from dhtorch.geometry.camera import resize
from dhtorch.records import Camera, Frame
from dhtorch.runtime.console import format_count

_MEMBER_PATTERN = re.compile(r"(?:\./)?(\d{1,15})/(\d{1,18})\.([a-z_/]{1,80})\.[a-z]{1,8}", re.IGNORECASE)
_REQUIRED_MEMBERS = ("wide/image", "wide/image/k", "wide/depth", "gt/rt")
_OPTIONAL_MEMBERS = ("wide/depth/k", "wide/depth/confidence")  # if any frame has it, all must
_TRUTH_MEMBERS = ("gt/depth", "gt/depth/k")
_KNOWN_MEMBERS = {*_REQUIRED_MEMBERS, *_OPTIONAL_MEMBERS, *_TRUTH_MEMBERS}
_UNITS_PER_METRE = 1000.0


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if root.is_dir():
        archives = sorted(root.glob("ca1m-*.tar"))
        return f"{len(archives)} CA-1M archives" if archives else None
    if root.suffix != ".tar":
        return None
    try:
        names = [member.name for member in islice(tarballs.iter_tar_members(root), 32)]
    except files.FormatError:
        return None
    members = {match[3].lower() for name in names if (match := _MEMBER_PATTERN.fullmatch(name))}
    return "a tar archive of <video>/<time>.wide and .gt members" if members & _KNOWN_MEMBERS else None


def read(
    root: str | Path,
    *,
    confidence: str | None = "unit",
    truth: bool = True,
    max_disagreement: float = 0.05,
) -> Recordings:
    """Open an archive, or a folder of them.

    Args:
        root: ``ca1m-*.tar``, or a folder of such archives.
        confidence: how the confidence is stored. Documented as a value in [0, 1] (no file was at hand: unconfirmed).
            ``"unit"``: that; below 0.25 is low, from 0.75 on high. ``"level"``: 0, 1 or 2. None: not read.
        truth: use ``gt/depth`` as true depth; the recording then has ``truth(i)``.
        max_disagreement: median relative difference of laser and LiDAR over their common pixels beyond which a laser
            depth map is rejected.

    Returns:
        One recording per archive, opened on access, at the capture's own frame rate. Frames without image, depth,
        intrinsics or pose are left out and reported, and so are frames without confidence or intrinsics of the depth
        where others have them (where none has, the depth uses the camera of the image, scaled).

    Raises:
        FormatError: no archive; on access also no complete frame, a damaged archive or member.
    """
    root = Path(root)
    files.to_positive(max_disagreement, root, "option max_disagreement")
    files.refuse_if(
        confidence not in ("unit", "level", None), root, "option confidence", confidence, "unit, level or None"
    )
    archives = sorted(root.glob("ca1m-*.tar")) if root.is_dir() else [root]
    files.refuse_if(not archives, root, "archives", "none", "ca1m-<split>-<video id>.tar")
    skip = {"wide/depth/confidence"} if confidence is None else set()
    skip |= set() if truth else {"gt/depth"}
    open_archive = partial(
        _open_archive, archives=tuple(archives), skip=skip, confidence=confidence, max_disagreement=max_disagreement
    )
    return Recordings([archive.stem for archive in archives], open_archive)


def _open_archive(
    i: int,
    *,
    archives: tuple[Path, ...],
    skip: set[str],
    confidence: str | None,
    max_disagreement: float,
) -> Recording:
    """Position → recording."""
    archive = archives[i]
    # (time in ns, member prefix) → member type → (offset, size); sorted by time
    frames: dict[tuple[int, str], dict[str, tuple[int, int]]] = {}
    for member in tarballs.iter_tar_members(archive):
        match = _MEMBER_PATTERN.fullmatch(member.name)
        if match and (what := match[3].lower()) in _KNOWN_MEMBERS - skip:
            frame = frames.setdefault((int(match[2]), f"{match[1]}/{match[2]}"), {})
            frame[what] = member.offset, member.size
    return _make_recording(archive, dict(sorted(frames.items())), confidence, max_disagreement)


@dataclass(frozen=True, eq=False)
class _Load:
    """Position → frame."""

    archive: Path
    stamps: tuple[str, ...]  # <video id>/<nanoseconds>
    spans: dict[str, np.ndarray]  # member type → (n, 2) offset and size, −1 = none
    confidence: str | None

    def __call__(self, i: int) -> Frame:
        image = torch.from_numpy(files.decode_image(*self.member(i, "wide/image")))
        depth = self.depth(i, "wide/depth")
        hw = (depth.shape[0], depth.shape[1])
        conf = None
        if "wide/depth/confidence" in self.spans:
            data, file = self.member(i, "wide/depth/confidence")
            value, largest = tiff.decode_tiff(data, file, hw).astype(np.float64), 2 if self.confidence == "level" else 1
            if not ((value >= 0) & (value <= largest)).all():
                expected = f"0 to {largest} (option confidence: unit or level)"
                raise files.FormatError(file, "confidence", f"{np.nanmin(value):g} to {np.nanmax(value):g}", expected)
            conf = torch.from_numpy(np.floor(value * (2 / largest) + 0.5).astype(np.uint8))[None]  # 0 low to 2 high
        return Frame(
            image=image[None],
            depth=depth[None],
            camera=self.camera(i, "wide/image/k", (image.shape[1], image.shape[2])),
            depth_camera=self.camera(i, "wide/depth/k", hw) if "wide/depth/k" in self.spans else None,
            conf=conf,
        )

    def member(self, i: int, what: str) -> tuple[bytes, Path]:
        """Bytes of a member and its path for errors."""
        offset, size = self.spans[what][i].tolist()
        return tarballs.read_tar_member(self.archive, offset, size), self.archive / f"{self.stamps[i]}.{what}"

    def depth(self, i: int, what: str) -> Tensor:
        """Depth (h, w) m."""
        return torch.from_numpy(files.decode_depth_png(*self.member(i, what), _UNITS_PER_METRE))

    def camera(self, i: int, what: str, hw: tuple[int, int]) -> Camera:
        """Camera of an image of size ``hw``."""
        data, file = self.member(i, what)
        return convert.to_camera(_parse_matrix(data, file, 3), hw, file, "K")


def _load_truth(
    i: int,
    *,
    load: _Load,
    max_disagreement: float,
) -> tuple[Tensor, float]:
    """Position → laser depth at the pixels of the image, and its disagreement with the LiDAR."""
    hw = files.decode_image_header(*load.member(i, "wide/image")).hw
    if load.spans["gt/depth"][i, 0] < 0:
        return torch.zeros(hw), float("nan")
    camera = load.camera(i, "wide/image/k", hw)
    maps, cameras = [], []
    for what in ("gt/depth", "wide/depth"):
        depth = load.depth(i, what)
        intrinsics, size = load.spans.get(f"{what}/k"), (depth.shape[0], depth.shape[1])
        has_own = intrinsics is not None and intrinsics[i, 0] >= 0
        cameras.append(load.camera(i, f"{what}/k", size) if has_own else resize(camera, hw, size))
        maps.append(depth)
    return resample_laser_depth(maps[0], cameras[0], maps[1], cameras[1], camera, hw, max_disagreement)


def _make_recording(
    archive: Path,
    frames: dict[tuple[int, str], dict[str, tuple[int, int]]],
    confidence: str | None,
    max_disagreement: float,
) -> Recording:
    available = set().union(*frames.values())
    required = [*_REQUIRED_MEMBERS, *(what for what in _OPTIONAL_MEMBERS if what in available)]
    report = []
    keys = list(frames)
    for what in required:
        kept = [key for key in keys if what in frames[key]]
        if len(kept) < len(keys):
            report.append(f"{format_count(len(keys) - len(kept), 'frame')} without {what}: left out")
        keys = kept
    files.refuse_if(not keys, archive, "frames", "; ".join(report) or "none", f"members {', '.join(required)}")
    if confidence and "wide/depth/confidence" not in available:
        report.append("no confidence: all returns are weighted equally")
    spans = {
        what: np.array([frames[key].get(what, (-1, 0)) for key in keys], dtype=np.int64)
        for what in {*required, *_TRUTH_MEMBERS} & available
    }
    load = _Load(archive, tuple(stamp for _, stamp in keys), spans, confidence)
    c2w = np.stack([_parse_matrix(*load.member(i, "gt/rt"), 4) for i in range(len(keys))])
    times = np.array([time for time, _ in keys]) / 1e9
    number_of = {key: number for number, key in enumerate(frames)}
    fields: dict[str, Any] = {"name": archive.stem, "format": "ca1m", "load": load, "root": archive}
    fields |= {"number": torch.tensor([number_of[key] for key in keys]), "times": torch.from_numpy(times)}
    fields |= {"poses": convert.to_poses(c2w, archive, "gt/RT")}
    fields |= {"rate_hz": float(1 / np.median(np.diff(times))) if len(times) > 1 else None}
    fields |= {"depth_unit": DepthUnit(1 / _UNITS_PER_METRE, "CA-1M stores mm")}
    if "gt/depth" not in spans:
        return Recording(**fields, report=tuple(report))
    if (n_without := int((spans["gt/depth"][:, 0] < 0).sum())) > 0:
        report.append(f"{format_count(n_without, 'frame')} without gt/depth: no ground truth")
    return MeasuredRecording(
        **fields, load_truth=partial(_load_truth, load=load, max_disagreement=max_disagreement), report=tuple(report)
    )


def _parse_matrix(data: bytes, file: Path, n: int) -> np.ndarray:
    """JSON document → n×n numbers, stored as rows or as one list."""
    value = files.decode_json(data, file)
    flat = isinstance(value, list) and len(value) == n * n
    return files.to_array(value, (n * n,) if flat else (n, n), file, "matrix").reshape(n, n)
