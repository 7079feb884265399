"""nerfstudio's ``transforms.json`` with a PLY of points as a reconstruction up to scale, in the world of the file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.scene_model import ModelView, SceneModel, Similarity, read_points, write_points
from dhtorch.data.readers.nerfstudio import parse_lens, parse_matrix, resolve_image
from dhtorch.runtime import storage
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, check_regular_file

#: Names of a frame's files, which are copied beside the written ``transforms.json``.
_FILE_KEYS = ("file_path", "mask_path", "depth_file_path")


def read_nerfstudio_model(file: Path) -> SceneModel:
    """Open a ``transforms.json`` with points.

    Raises:
        FormatError: a damaged file, a camera model that is not perspective, no points.
    """
    meta, folder = files.read_json(file), file.parent
    name = meta.get("ply_file_path", "sparse_pc.ply")
    cloud = files.resolve_inside(folder, str(name), file, "ply_file_path")
    if not cloud.is_file():
        raise FormatError(file, "ply_file_path", name if "ply_file_path" in meta else "none", "a PLY with points")
    vertices, views = read_points(cloud), []
    entries = files.get_entry(meta, "frames", list, file)
    for k, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise FormatError(file, f"frames.{k}", type(entry).__name__, "an object")
        image = resolve_image(folder, entry, file, k)
        K, hw, lens = parse_lens({**meta, **entry}, image, file, k)
        c2w = parse_matrix(entry.get("transform_matrix"), file, f"frames.{k}.transform_matrix")
        picture = image if image.is_file() else None
        for each in filter(Path.is_file, [image, *_files_of_frame(folder, entry, file)]):
            if (size := check_regular_file(each)) > MAX_FILE_BYTES:
                raise FormatError(each, "file size", f"{size} bytes", f"at most {MAX_FILE_BYTES}")
        views.append(ModelView(entry["file_path"], K, hw, convert.cv_from_gl(c2w), lens, picture))

    def save(out: Path, similarity: Similarity) -> None:
        frames = []
        for view, entry in zip(views, entries, strict=True):
            moved = convert.cv_from_gl(similarity.move(view.c2w))  # the change of axes is its own inverse
            frames.append({**entry, "transform_matrix": moved.tolist()})
            for stored in _files_of_frame(folder, entry, file):
                storage.copy_file(stored, out / stored.relative_to(folder))
        kept = {key: value for key, value in meta.items() if key not in ("applied_transform", "applied_scale")}
        storage.write_json(out / file.name, {**kept, "ply_file_path": cloud.name, "frames": frames})
        write_points(out / cloud.name, vertices, similarity)

    return SceneModel(views, vertices.xyz[np.isfinite(vertices.xyz).all(1)], "nerfstudio", file, save)


def _files_of_frame(folder: Path, entry: Mapping[str, Any], file: Path) -> list[Path]:
    """Paths of a frame's files, as ``transforms.json`` names them."""
    return [files.resolve_inside(folder, entry[k], file, k) for k in _FILE_KEYS if isinstance(entry.get(k), str)]
