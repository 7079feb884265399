"""Reconstructions up to scale: read as cameras with points or depth, written in metres in the same format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.colmap import find_colmap_model, read_colmap_model
from dhtorch.data.models.nerfstudio import read_nerfstudio_model
from dhtorch.data.models.network import read_network_model
from dhtorch.data.models.scene_model import ModelView, SceneModel, Similarity, write_model
from dhtorch.data.models.splat import read_splat_model
from dhtorch.data.readers.nerfstudio import find_transforms
from dhtorch.runtime.safe_open import restrict_links

__all__ = ["ModelView", "SceneModel", "Similarity", "read_model", "write_model"]


def read_model(root: str | Path, *, images: str | Path | None = None) -> SceneModel:
    """Open a model: a COLMAP folder, ``transforms.json`` with points, a folder of npz files, or a splat's PLY file.

    Args:
        root: the file, or the folder of the model.
        images: folder of its pictures. None = ``images/`` beside or above the model.

    Raises:
        FormatError: another format, a damaged file, a model without points and depth, a link to outside the model's
            folder.
    """
    root = Path(root)
    with restrict_links(root if root.is_dir() else root.parent, "model"):
        return _checked(_read_format(root, None if images is None else Path(images)))


def _read_format(root: Path, pictures: Path | None) -> SceneModel:
    """As :func:`read_model`, without the check."""
    if (model := find_colmap_model(root)) is not None:
        return read_colmap_model(*model, pictures)
    if (transforms := find_transforms(root)) is not None:
        return read_nerfstudio_model(transforms)
    if root.suffix == ".ply" and root.is_file():
        return read_splat_model(root, pictures)
    archives = [root] if root.suffix == ".npz" else sorted(root.glob("*.npz"), key=files.natural_sort_key)
    if archives and archives[0].is_file():
        return read_network_model(root, archives, pictures)
    if len(splats := sorted(root.glob("**/point_cloud.ply"), key=files.natural_sort_key)):
        return read_splat_model(splats[-1], pictures)
    expected = "COLMAP's cameras, images and points3D (bin or txt), transforms.json, npz files of a network or a PLY"
    raise FormatError(root, "model", "none" if root.exists() else "no such file or folder", expected)


def _checked(model: SceneModel) -> SceneModel:
    """The model, after a check of its cameras, poses and points.

    Raises:
        FormatError: numbers that are not finite, a focal length or a size that is not positive.
    """
    if not bool(np.isfinite(model.xyz).all()):
        raise FormatError(model.root, "points", "numbers that are not finite", "places of points")
    for view in model.views:
        numbers = np.concatenate([view.K.ravel(), view.c2w.ravel(), np.array(view.distortion or ())])
        if not bool(np.isfinite(numbers).all()):
            raise FormatError(model.root, f"view {view.name}", "numbers that are not finite", "a camera and a pose")
        if not (bool((view.K.diagonal() > 0).all()) and min(view.hw) > 0):
            size = f"focal lengths {view.K[0, 0]:g} and {view.K[1, 1]:g} px in {view.hw[1]}x{view.hw[0]}"
            raise FormatError(model.root, f"view {view.name}", size, "a camera of some pixels")
    return model
