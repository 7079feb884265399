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

import re
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs import npy, pfm
from dhtorch.data.io import decode as files
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
        file, pair = _read_calib_pair(root)
    elif (root / "dmin.txt").is_file():
        (file, pair), report = _read_views_pair(root), (_VIEWS_ASSUMPTION,)
    else:
        file, pair = _read_npz_pair(root)
    files.refuse_if(
        not 0 < pair.baseline <= convert.MAX_COORDINATE_M, file, "baseline", pair.baseline, "a positive length"
    )
    left, right = pair.cameras
    files.refuse_if(
        not torch.equal(left.f, right.f),
        file,
        "focal length",
        f"{left.f.tolist()} and {right.f.tolist()}",
        "equal ones",
    )
    shift = float(right.c[0, 0] - left.c[0, 0])
    files.refuse_if(
        abs(shift - pair.doffs) > 0.5, file, "doffs", pair.doffs, f"{shift:g}, the difference of the principal points"
    )
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3).clone()
    t = torch.tensor([[0.0, 0.0, 0.0], [pair.baseline, 0.0, 0.0]], dtype=torch.float64)
    return [
        Recording(
            name=root.resolve().name,
            format="rectified",
            load=partial(_load_view, pair=pair),
            number=consecutive_frame_numbers(2),
            root=root,
            poses=Pose(eye, t),
            report=report,
        )
    ]


class _Pair(NamedTuple):
    """The left and the right view."""

    images: tuple[Path, Path]
    disparities: tuple[Path | None, Path | None]
    cameras: tuple[Camera, Camera]
    hw: tuple[int, int]
    baseline: float  # m
    doffs: float  # px
    codes_per_px: float = 1.0  # of the disparity maps; codes of 0 are then unknown


def _load_view(i: int, *, pair: _Pair) -> Frame:
    """0 → left frame, 1 → right frame."""
    image = torch.from_numpy(files.read_image(pair.images[i], pair.hw))
    camera, file = pair.cameras[i], pair.disparities[i]
    depth = np.zeros(pair.hw, np.float32)
    if file is not None:
        code = _read_disparity(file, pair.hw)
        disparity = code.astype(np.float64) / pair.codes_per_px + pair.doffs
        is_known = code > 0 if file.suffix == ".png" else np.isfinite(disparity)
        # Disparities in px up to this value give no depth: they are too small to be measured.
        usable = is_known & (disparity > 1e-3)
        f = camera.f[0, 0].double().item()
        depth = np.where(usable, f * pair.baseline / np.where(usable, disparity, 1), 0).astype(np.float32)
    return Frame(image[None], torch.from_numpy(depth)[None], camera)


def _read_calib_pair(root: Path) -> tuple[Path, _Pair]:
    file = root / "calib.txt"
    entries = dict(re.findall(r"^\s*(\w+)\s*=\s*(.*?)\s*$", files.read_text(file), re.MULTILINE))
    images = (root / "im0.png", root / "im1.png")
    hw = files.read_image_header(images[0]).hw
    names = ("height", "width", "baseline", "doffs")
    h, w, baseline, doffs = (float(files.to_array(entries.get(name), (), file, name)) for name in names)
    files.refuse_if((h, w) != hw, file, "width and height", f"{w:g}x{h:g}", f"{hw[1]}x{hw[0]}, as im0.png")
    maps = [[root / f"disp{i}.pfm", root / f"disp{i}GT.pfm"] for i in (0, 1)]
    first, second = (next((each for each in named if each.is_file()), None) for named in maps)
    if first is None:
        raise files.FormatError(root / "disp0.pfm", "file", "no such file", "a disparity map disp0.pfm or disp0GT.pfm")
    # Matlab's [a b c; d e f; g h i]
    matrices = [[row.split() for row in entries.get(f"cam{i}", "").strip("[]").split(";")] for i in (0, 1)]
    left, right = (convert.to_camera(matrix, hw, file, f"cam{i}") for i, matrix in enumerate(matrices))
    return file, _Pair(images, (first, second), (left, right), hw, baseline / 1000, doffs)


def _read_npz_pair(root: Path) -> tuple[Path, _Pair]:
    names = {}
    for kind in ("left.png", "right.png", "disp.npz"):
        matching = sorted(root.glob(f"*_{kind}")) if root.is_dir() else []
        files.refuse_if(len(matching) != 1, root, f"*_{kind}", f"{len(matching)} such files", "exactly one")
        names[kind] = matching[0]
    file = root / "meta.json"
    meta = files.read_json(file)
    hw = files.read_image_header(names["left.png"]).hw
    left, right = (convert.to_camera(meta.get(key), hw, file, key) for key in ("K_left", "K_right"))
    baseline, doffs = (float(files.to_array(meta.get(key), (), file, key)) for key in ("baseline_m", "doffs"))
    images = (names["left.png"], names["right.png"])
    return file, _Pair(images, (names["disp.npz"], None), (left, right), hw, baseline, doffs)


def _read_views_pair(root: Path) -> tuple[Path, _Pair]:
    file = root / "dmin.txt"
    images = (root / "view1.png", root / "view5.png")
    hw = files.read_image_header(images[0]).hw
    factor = 1 if hw[1] >= _VIEWS_FULL_WIDTH_PX else 2 if hw[1] >= _VIEWS_HALF_WIDTH_PX else 3
    doffs = float(files.to_array(files.read_text(file).strip(), (), file, "shift")) / factor
    f = _VIEWS_FOCAL_PX / factor
    c = ((hw[1] - 1) / 2, (hw[0] - 1) / 2)
    left, right = (convert.to_camera([[f, 0, c[0] + x], [0, f, c[1]], [0, 0, 1]], hw, file, "K") for x in (0, doffs))
    second = root / "disp5.png"
    maps = (root / "disp1.png", second if second.is_file() else None)
    return file, _Pair(images, maps, (left, right), hw, _VIEWS_BASELINE_M, doffs, factor)


def _read_disparity(file: Path, hw: tuple[int, int]) -> np.ndarray:
    if file.suffix == ".pfm":
        return pfm.read_pfm(file, hw)
    if file.suffix == ".png":
        return files.read_image(file, hw)[0]
    disparity = npy.read_npz(file, "arr_0")
    files.refuse_if(disparity.shape != hw, file, "arr_0", f"shape {disparity.shape}", f"{hw}, as the image")
    return disparity
