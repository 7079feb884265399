"""Reader of rectified stereo pairs with a disparity map: corresponding rows, right camera displaced along x.

- *calib.txt* layout (Middlebury 2014, ETH3D two-view): ``im0.png``, ``im1.png``, ``disp0.pfm`` (or ``disp0GT.pfm``; the
  right view's ``disp1…`` where there is one) and ``calib.txt`` with ``cam0=[…]``, ``cam1=[…]``, ``doffs``,
  ``baseline`` in mm.
- *npz* layout (scikit-image's motorcycle): ``*_left.png``, ``*_right.png``, ``*_disp.npz`` and a side-car ``meta.json``
  with ``K_left``, ``K_right``, ``baseline_m``, ``doffs``; which is needed to convert this disparity to metres.
- *views* layout (Middlebury 2005 and 2006): ``view1.png``, ``view5.png``, ``disp1.png``, ``disp5.png`` and
  ``dmin.txt``. Codes are disparities times the factor by which the pictures were reduced (1, 2 or 3 by their
  width), 0 = unknown; ``dmin.txt`` is in pixels of the full size. The focal length (3740 px at the full size) and the
  baseline (0.16 m) are those of the data set's page, the principal point is taken to be the picture's centre.

Depth is ``f · baseline / (disparity + doffs)`` with ``doffs`` the difference of the principal points.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import npy, pfm
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.recording import Recording, consecutive_frame_numbers
from dhtorch.records import Camera, Frame, Pose

#: Focal length of the Middlebury 2005 and 2006 pictures at full size, px, and their baseline, m.
#: Source: https://vision.middlebury.edu/stereo/data/scenes2005/.
_VIEWS_FOCAL_PX, _VIEWS_BASELINE_M = 3740.0, 0.16

#: What is assumed of such a pair, as a line of the recording's report.
_VIEWS_ASSUMPTION = (
    f"intrinsics: f = {_VIEWS_FOCAL_PX:g} px at full size and baseline {_VIEWS_BASELINE_M:g} m, as the page of "
    "Middlebury 2005 states; principal point assumed at the picture's centre"
)

#: Widths from which on such pictures have their full size or half of it; smaller ones have a third.
#: Source: derived, full ones are 1240 to 1396 px wide.
_VIEWS_FULL_WIDTH_PX, _VIEWS_HALF_WIDTH_PX = 1000, 550

#: Side-car of dhtorch, of which the layout with ``calib.txt`` needs nothing.
UNUSED_FILES = ("meta.json",)


def recognise(root: Path) -> str | None:
    """The files by which ``root`` is recognised as this format, as text; None if it is not."""
    if (root / "calib.txt").is_file() and (root / "im0.png").is_file():
        return "calib.txt and im0.png"
    if all((root / name).is_file() for name in ("view1.png", "disp1.png", "dmin.txt")):
        return "view1.png, disp1.png and dmin.txt"
    if root.is_dir() and any(root.glob("*_disp.npz")) and any(root.glob("*_left.png")):
        return "*_left.png and *_disp.npz"
    return None


def read(root: str | Path) -> list[Recording]:
    """Open a pair as a recording of two frames: 0 = left, with depth; 1 = right, whose depth is 0 where it has no map.

    The world is the left camera; each view has its own intrinsics; there are no time stamps.

    Raises:
        FormatError: a missing or damaged file, or an invalid calibration.
    """
    root = Path(root)
    report: tuple[str, ...] = ()
    if (root / "calib.txt").is_file():
        file = root / "calib.txt"
        entries = dict(re.findall(r"^\s*(\w+)\s*=\s*(.*?)\s*$", files.read_text(file), re.MULTILINE))
        images = (root / "im0.png", root / "im1.png")
        hw = files.read_image_header(images[0]).hw
        size = (_parse_number(entries, "height", file), _parse_number(entries, "width", file))
        if size != hw:
            raise FormatError(file, "width and height", f"{size[1]:g}x{size[0]:g}", f"{hw[1]}x{hw[0]}, as im0.png")
        first, second = (_find_first(root, f"disp{i}.pfm", f"disp{i}GT.pfm") for i in (0, 1))
        if first is None:
            raise FormatError(root / "disp0.pfm", "file", "no such file", "a disparity map disp0.pfm or disp0GT.pfm")
        cameras = [convert.to_camera(_parse_matrix(entries, f"cam{i}", file), hw, file, f"cam{i}") for i in (0, 1)]
        baseline, doffs = _parse_number(entries, "baseline", file) / 1000, _parse_number(entries, "doffs", file)
        pair = _check_pair(_LoadPair(images, (first, second), (cameras[0], cameras[1]), hw, baseline, doffs), file)
    elif (root / "dmin.txt").is_file():
        pair, report = _read_views_pair(root), (_VIEWS_ASSUMPTION,)
    else:
        pair = _read_npz_pair(root)
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3).clone()
    t = torch.tensor([[0.0, 0.0, 0.0], [pair.baseline, 0.0, 0.0]], dtype=torch.float64)
    return [
        Recording(
            name=root.resolve().name,
            format="rectified",
            load=pair,
            number=consecutive_frame_numbers(2),
            root=root,
            poses=Pose(eye, t),
            report=report,
        )
    ]


@dataclass(frozen=True, eq=False)
class _LoadPair:
    """0 → left frame, 1 → right frame."""

    images: tuple[Path, Path]
    disparities: tuple[Path | None, Path | None]
    cameras: tuple[Camera, Camera]
    hw: tuple[int, int]
    baseline: float  # m
    doffs: float  # px
    codes_per_px: float = 1.0  # of the disparity maps; codes of 0 are then unknown

    def __call__(self, i: int) -> Frame:
        image = torch.from_numpy(files.read_image(self.images[i], self.hw))
        camera, file = self.cameras[i], self.disparities[i]
        depth = np.zeros(self.hw, np.float32)
        if file is not None:
            code = _read_disparity(file, self.hw)
            disparity = code.astype(np.float64) / self.codes_per_px + self.doffs
            is_known = code > 0 if file.suffix == ".png" else np.isfinite(disparity)
            # Disparities in px (with ``doffs``) up to this value give no depth: they are too small to be measured.
            usable = is_known & (disparity > 1e-3)
            f = camera.f[0, 0].double().item()
            depth = np.where(usable, f * self.baseline / np.where(usable, disparity, 1), 0).astype(np.float32)
        return Frame(image[None], torch.from_numpy(depth)[None], camera)


def _read_npz_pair(root: Path) -> _LoadPair:
    names = {}
    for kind in ("left.png", "right.png", "disp.npz"):
        matching = sorted(root.glob(f"*_{kind}")) if root.is_dir() else []
        if len(matching) != 1:
            raise FormatError(root, f"*_{kind}", f"{len(matching)} such files", "exactly one")
        names[kind] = matching[0]
    file = root / "meta.json"
    meta = files.read_json(file)
    hw = files.read_image_header(names["left.png"]).hw
    cameras = [convert.to_camera(meta.get(key), hw, file, key) for key in ("K_left", "K_right")]
    baseline, doffs = (float(files.to_array(meta.get(key), (), file, key)) for key in ("baseline_m", "doffs"))
    images = (names["left.png"], names["right.png"])
    return _check_pair(
        _LoadPair(images, (names["disp.npz"], None), (cameras[0], cameras[1]), hw, baseline, doffs), file
    )


def _read_views_pair(root: Path) -> _LoadPair:
    file = root / "dmin.txt"
    images = (root / "view1.png", root / "view5.png")
    hw = files.read_image_header(images[0]).hw
    factor = 1 if hw[1] >= _VIEWS_FULL_WIDTH_PX else 2 if hw[1] >= _VIEWS_HALF_WIDTH_PX else 3
    doffs = float(files.to_array(files.read_text(file).strip(), (), file, "shift")) / factor
    f = _VIEWS_FOCAL_PX / factor
    c = ((hw[1] - 1) / 2, (hw[0] - 1) / 2)
    cameras = [convert.to_camera([[f, 0, c[0] + x], [0, f, c[1]], [0, 0, 1]], hw, file, "K") for x in (0, doffs)]
    second = root / "disp5.png"
    maps = (root / "disp1.png", second if second.is_file() else None)
    pair = _LoadPair(images, maps, (cameras[0], cameras[1]), hw, _VIEWS_BASELINE_M, doffs, factor)
    return _check_pair(pair, file)


def _check_pair(pair: _LoadPair, file: Path) -> _LoadPair:
    """Check the calibration: positive baseline, equal focal lengths, ``doffs`` = difference of the principal points."""
    if not 0 < pair.baseline <= convert.MAX_COORDINATE_M:
        raise FormatError(file, "baseline", pair.baseline, "a positive length")
    left, right = pair.cameras
    if not torch.equal(left.f, right.f):
        raise FormatError(file, "focal length", f"{left.f.tolist()} and {right.f.tolist()}", "equal ones")
    shift = float(right.c[0, 0] - left.c[0, 0])
    if abs(shift - pair.doffs) > 0.5:
        raise FormatError(file, "doffs", pair.doffs, f"{shift:g}, the difference of the principal points")
    return pair


def _read_disparity(file: Path, hw: tuple[int, int]) -> np.ndarray:
    if file.suffix == ".pfm":
        return pfm.read_pfm(file, hw)
    if file.suffix == ".png":
        return files.read_image(file, hw)[0]
    disparity = npy.read_npz(file, "arr_0")
    if disparity.shape != hw:
        raise FormatError(file, "arr_0", f"shape {disparity.shape}", f"{hw}, as the image")
    return disparity


def _parse_matrix(entries: dict[str, str], key: str, file: Path) -> list[list[str]]:
    """Matlab's ``[a b c; d e f; g h i]`` → rows of texts."""
    return [row.split() for row in entries.get(key, "").strip("[]").split(";")]


def _parse_number(entries: dict[str, str], key: str, file: Path) -> float:
    return float(files.to_array(entries.get(key), (), file, key))


def _find_first(root: Path, *names: str) -> Path | None:
    return next((root / name for name in names if (root / name).is_file()), None)
