"""DDFF-12: focal stacks of twelve rooms, refocused from a light-field camera, with depth from an RGB-D sensor.

The published HDF5 files (``stack_<split>``, ``disp_<split>``), or the raw light fields
``LightField/<split>/<scene>/LF_<n>.npy`` beside ``DepthRegistered/<split>/<scene>/DEPTH_<n>.png`` (16 bits, mm), which
are refocused here. Depth is a constant divided by the disparity, 0 = none. The stored type and the number of stacks of
the HDF5 files are not documented: both are taken from the file, and images without a value above 1.5 are taken as 0 to
1 instead of 0 to 255.
"""

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from dhtorch.data import convert
from dhtorch.data.codecs.hdf5 import Hdf5Array, list_hdf5_arrays
from dhtorch.data.codecs.npy import parse_real_npy_header
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks, parse_focus_distances

# Refocusing: a focal stack from a light field, the array of sub-aperture images of one main lens.
#
# A point of disparity d (px between neighbouring sub-apertures) moves up and left by d from one image to the next.
# Shifting every image back accordingly and averaging brings all points of this depth into focus; others are blurred as
# by a lens with the aperture of the whole array.

_LOBES = 3  # of the windowed sinc that interpolates


def refocus(
    light_field: Tensor,  # (U, V, H, W, C) uint8: rows and columns of sub-aperture images
    disparity: Tensor,  # (S,) px between neighbours
) -> Tensor:
    """Refocus a light field: images (S, C, H, W) uint8, one focused at each disparity.

    Shifts are sub-pixel; a three-lobed Lanczos kernel gives all of them the same sharpness (with linear interpolation
    it would depend on the fraction). Rows and columns are shifted separately, each by one convolution that sums over
    the sub-apertures. The border is repeated.
    """
    u, v, h, w, channels = light_field.shape
    row_kernels, column_kernels = _kernels(v, disparity), _kernels(u, disparity)  # (S, V, K), (S, U, K)
    pad_x, pad_y = (row_kernels.shape[-1] // 2,) * 2 + (0, 0), (0, 0) + (column_kernels.shape[-1] // 2,) * 2
    total = torch.zeros(channels, len(disparity), h, w)
    for i in range(u):
        for c in range(channels):
            pictures = pad(light_field[i, ..., c][None].float(), pad_x, mode="replicate")  # (1, V, H, W+)
            row = conv2d(pictures, row_kernels[:, :, None])  # (1, S, H, W)
            row = pad(row, pad_y, mode="replicate")
            total[c] += conv2d(row, column_kernels[:, i][:, None, :, None], groups=len(disparity))[0]
    return (total.transpose(0, 1) / (u * v)).round().clamp(0, 255).to(torch.uint8)


def _kernels(n: int, disparity: Tensor) -> Tensor:
    """Lanczos weights (S, n, K), K odd, that shift each of n sub-aperture images onto the central one."""
    shift = ((n - 1) / 2 - torch.arange(n, dtype=torch.float64)) * disparity.double()[:, None]
    reach = math.ceil(float(shift.abs().max())) + _LOBES
    x = torch.arange(-reach, reach + 1, dtype=torch.float64) - shift[..., None]
    weight = torch.where(x.abs() < _LOBES, torch.sinc(x) * torch.sinc(x / _LOBES), torch.zeros_like(x))
    return (weight / weight.sum(-1, keepdim=True)).float()


_DEPTH_DISPARITY = 0.1412376  # m px: 521.4052 px focal length times 0.27088 mm between two sub-apertures
_DISPARITIES = (0.28247513, 0.02017679)  # px, of the first slice (0.5 m) and the last (7 m)
_SLICES = 10
_HW = (383, 552)
_K = (521.4052, 521.4052, 285.114, 187.825)
_MIN_DISPARITY = 1e-4  # px; 1.4 km
_MAX_STACKS = 1_000_000
_MAX_APERTURES = 32  # per axis


def recognise(root: Path) -> str | None:
    """Text of the evidence that ``root`` holds stacks of this format; None without evidence."""
    if (root / "LightField").is_dir() and next((root / "LightField").glob("*/*/LF_*.npy"), None):
        return "light fields LightField/<split>/<scene>/LF_<n>.npy"
    sources = [root] if root.suffix in (".h5", ".hdf5") and root.is_file() else sorted(root.glob("*.h5"))[:1]
    if sources and any(key.startswith(("stack_", "stacks_")) for key in list_hdf5_arrays(sources[0])):
        return "HDF5 arrays stack_<split>"
    return None


def read(
    root: str | Path,
    *,
    split: str | None = None,
    focus_m: Sequence[float] | None = None,
    depth_disparity: float = _DEPTH_DISPARITY,
    depth_folder: str = "DepthRegistered",
    per_scene: int | None = None,
) -> FocalStacks:
    """Open DDFF-12.

    Args:
        root: an HDF5 file, a folder with some, or the folder that holds ``LightField/``.
        split: ``"train"``, ``"val"``, ``"test"``. None = all splits of the files.
        focus_m: focus distances. None = equal steps of disparity from 0.5 m to 7 m, as in the published stacks; raw
            light fields are refocused at these.
        depth_disparity: m px, depth times disparity: focal length times distance of two neighbouring sub-apertures.
        depth_folder: of the raw depth maps (16-bit PNG, mm).
        per_scene: number of consecutive stacks of an HDF5 file that show one room. None = unknown: the file does not
            record which stacks share a room, so all of a split count as one scene.

    Returns:
        Stacks in the order of the file, near focus first; light fields of one folder are one scene. The published HDF5
        mixes the rooms of train and val. Depth is None for a split without labels. The camera is the calibrated one
        for images of 552×383.

    Raises:
        FormatError: no stack, a stack and labels of different sizes, a damaged file, or an invalid option.
    """
    root = Path(root)
    constant = files.to_positive(depth_disparity, root, "option depth_disparity")
    steps = torch.linspace(*_DISPARITIES, _SLICES, dtype=torch.float64)
    focus = (constant / steps).float() if focus_m is None else parse_focus_distances(focus_m, root)
    if per_scene is not None and per_scene < 1:
        raise FormatError(root, "option per_scene", per_scene, "at least 1")
    raw = (root / "LightField").is_dir()
    locations, report = _light_fields(root, depth_folder) if raw else _hdf5_stacks(root, per_scene)
    locations = [location for location in locations if split in (None, location[1])]
    if not locations:
        raise FormatError(root, "stacks", f"none of split {split or 'any'}", "stack_<split> or LightField/<split>/")
    load = partial(_load_stack, locations, focus, constant)
    names, _, scenes, *_ = zip(*locations, strict=True)
    return FocalStacks(root.resolve().stem, "ddff12", load, names, root=root, report=tuple(report), scenes=scenes)


#: One stack: name, split, scene, row of an HDF5 array or file of a light field, its truth, and the row.
_StackLocation = tuple[str, str, str, Hdf5Array | Path, Hdf5Array | Path | None, int]


def _load_stack(locations: Sequence[_StackLocation], focus: Tensor, depth_disparity: float, i: int) -> FocalStack:
    """Index → decoded stack; focus distances (S,)."""
    _, _, _, stack, truth, row = locations[i]
    if isinstance(stack, Path):
        images, source = refocus(_light_field(stack), depth_disparity / focus.double()), stack
    else:
        images, source = _as_images(stack.row(row), stack), stack.file
    hw, depth = (images.shape[-2], images.shape[-1]), None
    if len(images) != len(focus):
        raise FormatError(source, "slices", len(images), f"{len(focus)}, one for each focus distance")
    if isinstance(truth, Path):
        depth = torch.from_numpy(files.read_depth_png(truth, 1000.0, hw))[None]
    elif truth is not None:
        disparity = truth.row(row).astype(np.float64)
        usable = np.isfinite(disparity) & (disparity > _MIN_DISPARITY)
        metres = np.where(usable, depth_disparity / np.where(usable, disparity, 1), 0)
        depth = torch.from_numpy(metres.astype(np.float32))[None]
    camera = convert.to_camera(convert.make_K(*_K), hw, source) if hw == _HW else None
    return FocalStack(images[None], focus[None], depth, camera)


def _hdf5_stacks(root: Path, per_scene: int | None) -> tuple[list[_StackLocation], list[str]]:
    """Stacks of the HDF5 files at ``root``, and an empty report."""
    sources = [root] if root.is_file() else sorted(root.glob("*.h5"))
    locations: list[_StackLocation] = []
    for file in sources:
        arrays = list_hdf5_arrays(file)
        for key, stack in arrays.items():
            match = re.fullmatch(r"stacks?_(\w+)", key)
            if stack is None or not match:
                continue
            truth = arrays.get(f"disp_{match[1]}")
            n, hw = stack.shape[0], stack.shape[2:4]
            if len(stack.shape) != 5 or stack.shape[4] not in (1, 3) or 0 in stack.shape or n > _MAX_STACKS:
                raise FormatError(file, key, f"shape {stack.shape}", "stacks, slices, height, width, 1 or 3 channels")
            if truth is not None and truth.shape != (n, *hw):
                raise FormatError(file, truth.key, f"shape {truth.shape}", f"{(n, *hw)}, as {key}")
            prefix = f"{file.stem}/{match[1]}" if len(sources) > 1 else match[1]
            rooms = [prefix if per_scene is None else f"{prefix}/scene_{i // per_scene:02d}" for i in range(n)]
            locations += [(f"{prefix}/{i:04d}", match[1], rooms[i], stack, truth, i) for i in range(n)]
    return locations, []


def _light_fields(root: Path, depth_folder: str) -> tuple[list[_StackLocation], list[str]]:
    """Light fields below ``root``, and a report of those left out for a missing depth map."""
    locations: list[_StackLocation] = []
    report = []
    for file in sorted((root / "LightField").glob("*/*/LF_*.npy")):
        scene = file.parent.relative_to(root / "LightField")
        number = file.stem.removeprefix("LF_")
        folder = root / depth_folder / scene
        truth = folder / f"DEPTH_{number}.png"
        if folder.is_dir() and not truth.is_file():
            report.append(f"{scene}/{number}: no {truth.name}: left out")
        else:
            label = truth if folder.is_dir() else None
            room = scene.as_posix()
            locations.append((f"{room}/{number}", scene.parts[0], room, file, label, 0))
    return locations, report


def _light_field(file: Path) -> Tensor:
    """Read a light field: (U, V, H, W, C) uint8, C 1 or 3."""
    raw = files.read_bytes(file)
    header = parse_real_npy_header(file, "light field", raw)
    shape = header.shape
    usable = len(shape) == 5 and shape[4] in (1, 3) and max(shape[:2]) <= _MAX_APERTURES and min(shape) > 0
    if header.dtype != np.uint8 or header.fortran or not usable:
        raise FormatError(file, "light field", f"{header.dtype} of {shape}", "uint8: 9, 9, height, width, 3")
    if len(raw) - header.start != math.prod(shape):
        raise FormatError(file, "data", f"{len(raw) - header.start} bytes", f"{shape}")
    return torch.from_numpy(np.frombuffer(raw, np.uint8, offset=header.start).reshape(shape).copy())


def _as_images(stack: np.ndarray, source: Hdf5Array) -> Tensor:
    """Images (S, C, H, W) of a stored stack: integers up to 255 as uint8, otherwise float in [0, 1]."""
    if not np.isfinite(stack).all() or stack.min() < 0 or stack.max() > 255:
        raise FormatError(source.file, source.key, f"{stack.min():g} to {stack.max():g}", "values from 0 to 255")
    images = torch.from_numpy(np.ascontiguousarray(stack.transpose(0, 3, 1, 2)))
    if not images.is_floating_point():
        return images.to(torch.uint8)
    images = images.float()
    if float(images.max()) <= 1.5:
        return images.clamp(max=1)
    return images.to(torch.uint8) if bool((images == images.round()).all()) else images / 255
