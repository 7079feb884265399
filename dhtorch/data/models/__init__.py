"""Reconstructions up to scale: read as cameras with points or depth, written in metres in the same format."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.colmap import find_colmap_model, read_colmap_model
from dhtorch.data.models.network import read_network_model
from dhtorch.data.models.scene_model import (
    ModelView,
    SceneModel,
    Similarity,
    check_inside,
    find_picture,
    read_points,
    write_model,
    write_points,
)
from dhtorch.data.readers.nerfstudio import find_transforms, parse_lens, parse_matrix, resolve_image
from dhtorch.runtime import storage
from dhtorch.runtime.safe_open import MAX_FILE_BYTES, check_regular_file, restrict_links

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
        model = _read_format(root, None if images is None else Path(images))
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


def _read_format(root: Path, pictures: Path | None) -> SceneModel:
    """As :func:`read_model`, without a check of cameras, poses and points."""
    if (model := find_colmap_model(root)) is not None:
        return read_colmap_model(*model, pictures)
    if (transforms := find_transforms(root)) is not None:
        return _read_nerfstudio_model(transforms)
    if root.suffix == ".ply" and root.is_file():
        return _read_splat_model(root, pictures)
    archives = [root] if root.suffix == ".npz" else sorted(root.glob("*.npz"), key=files.natural_sort_key)
    if archives and archives[0].is_file():
        return read_network_model(root, archives, pictures)
    if len(splats := sorted(root.glob("**/point_cloud.ply"), key=files.natural_sort_key)):
        return _read_splat_model(splats[-1], pictures)
    expected = "COLMAP's cameras, images and points3D (bin or txt), transforms.json, npz files of a network or a PLY"
    raise FormatError(root, "model", "none" if root.exists() else "no such file or folder", expected)


#: Names of a frame's files, which are copied beside the written ``transforms.json`` of nerfstudio.
_FILE_KEYS = ("file_path", "mask_path", "depth_file_path")


def _read_nerfstudio_model(file: Path) -> SceneModel:
    """Open nerfstudio's ``transforms.json`` with a PLY of points, in the world of the file.

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


def _read_splat_model(file: Path, pictures: Path | None) -> SceneModel:
    """Open a splat: centres of the opaque ones, and cameras.

    These lie in ``cameras.json`` beside the PLY or up to two folders above it.

    Raises:
        FormatError: a damaged file, no cameras.
    """
    folder = file.parent
    places = [f / "cameras.json" for f in (folder, *folder.resolve().parents[:2]) if (f / "cameras.json").is_file()]
    if not places:
        raise FormatError(folder, "cameras.json", "none beside or above the PLY", "the splat's cameras")
    source = check_inside(places[0], places[0].parent)
    cameras = files.decode_json(files.read_text(source), source)
    vertices, views = read_points(file), []
    for k, entry in enumerate(files.get_entry({"cameras": cameras}, "cameras", list, source)):
        values = entry if isinstance(entry, dict) else {}
        w, h, fx, fy = (files.to_positive(values.get(n), source, f"{k}.{n}") for n in ("width", "height", "fx", "fy"))
        c2w = np.eye(4)
        c2w[:3, :3] = files.to_array(values.get("rotation"), (3, 3), source, f"{k}.rotation")
        c2w[:3, 3] = files.to_array(values.get("position"), (3,), source, f"{k}.position")
        name = str(values.get("img_name", k))
        K = convert.make_K(fx, fy, w / 2 - 0.5, h / 2 - 0.5)
        image = find_picture(source.parent, name, pictures)
        views.append(ModelView(name, K, (round(h), round(w)), c2w, None, image))
    names = vertices.vertex.dtype.names or ()
    xyz = vertices.xyz[vertices.vertex["opacity"] > 0] if "opacity" in names else vertices.xyz

    def save(out: Path, similarity: Similarity) -> None:
        write_points(out / file.name, vertices, similarity)
        moved = [similarity.move(view.c2w) for view in views]
        places = [{"position": c2w[:3, 3].tolist(), "rotation": c2w[:3, :3].tolist()} for c2w in moved]
        entries = [{**entry, **place} for entry, place in zip(cameras, places, strict=True)]
        storage.replace_file(out / "cameras.json", (json.dumps(entries) + "\n").encode("utf-8"))

    return SceneModel(views, xyz[np.isfinite(xyz).all(1)], "splat", file, save)
