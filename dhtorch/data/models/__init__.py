"""Reconstructions up to scale: read as cameras with points or depth, written in metres in the same format."""

from __future__ import annotations

from pathlib import Path

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.colmap import find_colmap_model, read_colmap_model
from dhtorch.data.models.nerfstudio import read_nerfstudio_model
from dhtorch.data.models.network import read_network_model
from dhtorch.data.models.scene_model import ModelView, SceneModel, Similarity, write_model
from dhtorch.data.models.splat import read_splat_model
from dhtorch.data.readers.nerfstudio import find_transforms

__all__ = ["ModelView", "SceneModel", "Similarity", "read_model", "write_model"]


def read_model(root: str | Path, *, images: str | Path | None = None) -> SceneModel:
    """Open a model: a COLMAP folder, ``transforms.json`` with points, a folder of npz files, or a splat's PLY file.

    Args:
        root: the file, or the folder of the model.
        images: folder of its pictures. None = ``images/`` beside or above the model.

    Raises:
        FormatError: another format, a damaged file, a model without points and depth.
    """
    root = Path(root)
    pictures = None if images is None else Path(images)
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
