"""A splat's PLY with ``cameras.json`` as a reconstruction up to scale: centres of opaque splats, and cameras."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dhtorch.data import convert
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.scene_model import (
    ModelView,
    SceneModel,
    Similarity,
    check_inside,
    find_picture,
    read_points,
    write_points,
)
from dhtorch.runtime import storage


def read_splat_model(file: Path, pictures: Path | None) -> SceneModel:
    """Open a splat; its cameras lie in ``cameras.json`` beside the PLY or up to two folders above it.

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
