"""Cameras and maps of networks in npz archives as a reconstruction up to scale."""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from dhtorch.data.codecs.npy import list_npz, read_npz
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.scene_model import ModelView, SceneModel, Similarity, check_inside, find_picture
from dhtorch.runtime import storage

#: Names of arrays in files of networks: VGGT, Depth Anything 3, MapAnything, DUSt3R and MASt3R.
_ARRAY_NAMES = {
    "depth": ("depth", "depths", "depth_z", "depthmap", "depthmaps"),
    "points": ("world_points", "pts3d", "point_map", "points", "world_points_from_depth"),
    "K": ("intrinsic", "intrinsics", "K", "Ks"),
    "w2c": ("extrinsic", "extrinsics", "w2c", "world_to_camera"),
    "c2w": ("camera_poses", "camera_pose", "cam2world", "cams2world", "c2w", "poses"),
    "conf": ("depth_conf", "conf", "confidence", "world_points_conf"),
}
_TEXT_NAMES = ("names", "image_names", "image_paths")


def read_network_model(root: Path, archives: Sequence[Path], pictures: Path | None) -> SceneModel:
    """Open one archive with all views along the first axis, or one archive for each view.

    Raises:
        FormatError: a damaged archive, or one without intrinsics, poses, or maps.
    """
    views: list[ModelView] = []
    for archive in archives:
        present = list_npz(archive)
        key = {kind: next((n for n in names if n in present), None) for kind, names in _ARRAY_NAMES.items()}
        missing = [kind for kind in ("K",) if key[kind] is None]
        missing += ["w2c or c2w"] if key["w2c"] is key["c2w"] is None else []
        missing += ["depth or points"] if key["depth"] is key["points"] is None else []
        if missing:
            expected = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in _ARRAY_NAMES.items())
            raise FormatError(archive, f"arrays without {', '.join(missing)}", ", ".join(sorted(present)), expected)
        values = {kind: read_npz(archive, name).astype(np.float64) for kind, name in key.items() if name is not None}
        views += _views_of_arrays(archive, values, _names_of_arrays(root, archive, present, len(archives), pictures))

    def save(out: Path, similarity: Similarity) -> None:
        for archive in archives:
            _write_arrays(archive, out / archive.name, similarity)

    return SceneModel(views, format="npz", root=root, save=save)


def _names_of_arrays(
    root: Path, archive: Path, present: set[str], n_archives: int, pictures: Path | None
) -> list[str | Path] | None:
    """Names of the views of an archive: stored, its own, or the files of ``images/``; None = none of these."""
    stored = next((name for name in _TEXT_NAMES if name in present), None)
    if stored is not None:
        try:
            names = np.load(archive, allow_pickle=False)[stored]
        except Exception as error:  # numpy's parser and zlib: their exceptions are not specified
            raise FormatError(archive, stored, error, "an array of text") from None
        return [str(name) for name in np.atleast_1d(names).ravel()]
    if n_archives > 1:
        return [archive.stem]
    top = pictures if pictures is not None else root if root.is_dir() else root.parent
    below = top if pictures is not None else top / "images"
    present_files = [file for file in below.glob("*") if file.suffix in files.IMAGE_SUFFIXES] if below.is_dir() else []
    return [check_inside(file, top) for file in sorted(present_files, key=files.natural_sort_key)] or None


def _views_of_arrays(
    archive: Path, values: Mapping[str, np.ndarray], names: Sequence[str | Path] | None
) -> Iterator[ModelView]:
    """Views of an archive, whose arrays have a first axis of views or are those of one view."""
    pose = values["c2w"] if "c2w" in values else values["w2c"]
    maps = values["depth"] if "depth" in values else values["points"]
    trailing = 3 if "depth" not in values else 1
    for kind, array in (("pose", pose), ("depth or points", maps), ("K", values["K"])):
        if array.ndim < 2 or array.size == 0:
            raise FormatError(archive, kind, f"shape {array.shape}", "an array with numbers for every view")
    pose = pose.reshape(-1, *pose.shape[-2:])
    n = len(pose)
    maps = maps[..., None] if trailing == 1 and maps.shape[-1] != 1 else maps
    try:
        maps = maps.reshape(n, *maps.shape[-3:])
        K = np.broadcast_to(values["K"].reshape(-1, 3, 3), (n, 3, 3))
        full = np.tile(np.eye(4), (n, 1, 1))
        full[:, : pose.shape[1]] = pose
        conf = values["conf"].reshape(n, *maps.shape[1:3]) if "conf" in values else None
    except ValueError as error:
        raise FormatError(archive, "shapes", error, f"the same number of views in all arrays, here {n}") from None
    if maps.ndim != 4 or maps.shape[-1] != trailing:
        raise FormatError(archive, "depth or points", f"shape {maps.shape}", f"(views, height, width, {trailing})")
    if names is not None and len(names) != n:
        raise FormatError(archive, "names", f"{len(names)} names or pictures", f"one for each of {n} views")
    c2w = full if "c2w" in values else _invert(archive, full)
    for k in range(n):
        z = maps[k, ..., 0]
        if trailing == 3:
            z = ((maps[k] - c2w[k, :3, 3]) @ c2w[k, :3, :3])[..., 2]
        z = np.where(np.isfinite(z) & (z > 0), z, 0.0)
        if conf is not None:
            # The pixels of least confidence are left out.
            z[conf[k] < np.quantile(conf[k], 0.25)] = 0
        name = f"{k:06d}" if names is None else names[k]
        image = name if isinstance(name, Path) else find_picture(archive.parent, Path(name).name, None)
        yield ModelView(Path(name).name, K[k], (z.shape[0], z.shape[1]), c2w[k], image=image, depth=z)


def _invert(archive: Path, poses: np.ndarray) -> np.ndarray:
    """Inverse of poses (n, 4, 4)."""
    try:
        return np.linalg.inv(poses)
    except np.linalg.LinAlgError:
        raise FormatError(archive, "poses", "a singular matrix", "rotations and translations") from None


def _write_arrays(archive: Path, out: Path, similarity: Similarity) -> None:
    """An archive with its lengths after a similarity; other arrays as they are."""
    kinds = {name: kind for kind, names in _ARRAY_NAMES.items() for name in names}
    written = {}
    with np.load(archive, allow_pickle=False) as stored:
        for name in stored.files:
            value, kind = stored[name], kinds.get(name)
            if kind == "depth":
                written[name] = value * value.dtype.type(similarity.scale)
            elif kind == "points":
                written[name] = similarity.apply(value.astype(np.float64)).astype(value.dtype)
            elif kind in ("c2w", "w2c"):
                full = np.tile(np.eye(4), (*value.shape[:-2], 1, 1))
                full[..., : value.shape[-2], :] = value
                moved = similarity.move(full if kind == "c2w" else np.linalg.inv(full))
                moved = moved if kind == "c2w" else np.linalg.inv(moved)
                written[name] = moved[..., : value.shape[-2], :].astype(value.dtype)
            else:
                written[name] = value
    buffer = io.BytesIO()
    np.savez(buffer, **written)
    storage.replace_file(out, buffer.getvalue())
