"""Reconstructions up to scale: COLMAP, nerfstudio, point maps of networks and splats -> cameras, points, depth.

A model is read into views (picture, camera, pose, depth map) and points, in its own units. ``write_model`` multiplies
every length of its files by a scale, or applies a similarity; what is no length stays byte for byte.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs.npy import read_npz
from dhtorch.data.codecs.zips import check_zip_directory
from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.data.io.safe_open import check_memory
from dhtorch.data.readers.colmap import COLMAP_LENSES, ColmapLens, make_colmap_lens, read_colmap_cameras
from dhtorch.export.arrays import rotation_to_wxyz
from dhtorch.runtime import storage
from dhtorch.viz.viewer.points import PlyVertices, read_ply_vertices

#: Numbers of COLMAP's binary camera models that OpenCV's lens covers → names. Source: COLMAP, sensor/models.h.
_BINARY_LENSES = dict(zip((0, 1, 2, 3, 4, 6), COLMAP_LENSES, strict=True))

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

#: Share of the pixels of a network's map that is left out, those of least confidence. Source: origin not recorded.
_LEAST_CONFIDENT_SHARE = 0.25

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


class Similarity(NamedTuple):
    """x' = scale · R x + t."""

    scale: float
    R: np.ndarray  # (3, 3)
    t: np.ndarray  # (3,)

    def apply(self, xyz: np.ndarray) -> np.ndarray:
        """Points (…, 3) after the similarity."""
        return self.scale * xyz @ self.R.T + self.t

    def move(self, c2w: np.ndarray) -> np.ndarray:
        """Camera-to-world matrices (…, 4, 4) after the similarity."""
        moved = np.array(c2w, np.float64)
        moved[..., :3, :3] = self.R @ moved[..., :3, :3]
        moved[..., :3, 3] = self.apply(moved[..., :3, 3])
        return moved


@dataclass(frozen=True, eq=False)
class ModelView:
    """A picture of a model: camera and pose in the model's units, and the depth or the points seen in it."""

    name: str  # of the picture
    K: np.ndarray  # (3, 3), pixel centres at integers
    hw: tuple[int, int]  # that K refers to
    c2w: np.ndarray  # (4, 4), OpenCV axes
    distortion: tuple[float, ...] | None = None  # OpenCV's order
    image: Path | None = None
    depth: np.ndarray | None = None  # (h, w) of the same field of view, model units; 0 = none
    point: np.ndarray | None = None  # (n,) int64, indices of observed points; None = not stored
    uv: np.ndarray | None = None  # (n, 2) px, where they are observed


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A reconstruction up to scale."""

    views: Sequence[ModelView]
    xyz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # (P, 3) model units
    format: str = "memory"
    root: Path = Path()
    save: Callable[[Path, Similarity], None] | None = field(default=None, repr=False)


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
    for folder in [root / each for each in ("", "sparse/0", "sparse", "colmap")]:
        for suffix in (".bin", ".txt"):
            if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images", "points3D")):
                return _read_colmap(folder, suffix, pictures)
    transforms = root if root.name.startswith("transforms") and root.suffix == ".json" else root / "transforms.json"
    if transforms.is_file():
        return _read_nerfstudio(transforms)
    if root.suffix == ".ply" and root.is_file():
        return _read_splat(root, pictures)
    archives = [root] if root.suffix == ".npz" else sorted(root.glob("*.npz"), key=files.natural_sort_key)
    if archives and archives[0].is_file():
        return _read_arrays(root, archives, pictures)
    if len(splats := sorted(root.glob("**/point_cloud.ply"), key=files.natural_sort_key)):
        return _read_splat(splats[-1], pictures)
    expected = "COLMAP's cameras, images and points3D (bin or txt), transforms.json, npz files of a network or a PLY"
    raise FormatError(root, "model", "none" if root.exists() else "no such file or folder", expected)


def write_model(model: SceneModel, out: Path, similarity: Similarity) -> None:
    """Write the files of a model that was read into the folder ``out``, after a similarity.

    Raises:
        ValueError: a model from memory, or a rotation of a splat, whose colours depend on the direction.
    """
    if model.save is None:
        raise ValueError("write_model: found a model from memory, expected one that was read")
    model.save(out, similarity)


def _find_picture(folder: Path, name: str, pictures: Path | None) -> Path | None:
    """File of a picture below ``images/`` of the folder or up to two folders above it; None where there is none."""
    above = [folder, *folder.resolve().parents[:2]]
    for base in [pictures] if pictures is not None else [f / sub for f in above for sub in ("images", "rgb", "color")]:
        for suffix in ("", *_IMAGE_SUFFIXES):
            file = files.resolve_inside(base, name + suffix, folder, "picture")
            if file.is_file():
                return file
    return None


# ------------------------------------------------------------------------------------------------------------- COLMAP


class _Numbers(NamedTuple):
    """Where a file holds numbers of one image or point: byte offset or line, and their values."""

    at: int
    values: np.ndarray


def _read_colmap(folder: Path, suffix: str, pictures: Path | None) -> SceneModel:
    data = {name: files.read_bytes(folder / f"{name}{suffix}") for name in ("images", "points3D")}
    if suffix == ".bin":
        lenses = _binary_cameras(folder / "cameras.bin")
        images = list(_binary_images(folder / "images.bin", data["images"]))
        points = list(_binary_points(folder / "points3D.bin", data["points3D"]))
    else:
        lenses = read_colmap_cameras(folder / "cameras.txt")
        images = list(_text_images(folder / "images.txt"))
        points = list(_text_points(folder / "points3D.txt"))
    if not points:
        raise FormatError(folder, f"points3D{suffix}", "no points", "points, which give the depth of the pictures")
    index = {number: k for k, (number, _) in enumerate(points)}
    views = []
    for name, camera, pose, uv, seen in images:
        if camera not in lenses:
            raise FormatError(folder / f"images{suffix}", f"camera of {name}", camera, "a camera")
        lens, known = lenses[camera], np.array([k in index for k in seen.tolist()], bool)
        w2c = convert.to_c2w(pose.values[None, [1, 2, 3, 0]], pose.values[None, 4:], folder, f"pose of {name}")[0]
        point = np.array([index[k] for k in seen[known].tolist()], np.int64)
        picture = _find_picture(folder, name, pictures)
        c2w = np.linalg.inv(w2c)
        views.append(ModelView(name, lens.K, lens.hw, c2w, lens.distortion, picture, point=point, uv=uv[known] - 0.5))

    def save(out: Path, similarity: Similarity) -> None:
        poses = [_move_w2c(pose, similarity) for _, _, pose, _, _ in images]
        places = [_Numbers(at, similarity.apply(xyz)) for _, (at, xyz) in points]
        storage.copy_file(folder / f"cameras{suffix}", out / f"cameras{suffix}")
        for name, moved in (("images", poses), ("points3D", places)):
            patched = _patch_binary(data[name], moved) if suffix == ".bin" else _patch_text(data[name], moved)
            storage.replace_file(out / f"{name}{suffix}", patched)

    return SceneModel(views, np.array([n.values for _, n in points]), f"colmap {suffix[1:]}", folder, save)


def _move_w2c(pose: _Numbers, similarity: Similarity) -> _Numbers:
    """Quaternion and translation of a world-to-camera pose after a similarity of the world."""
    w2c = convert.to_c2w(pose.values[None, [1, 2, 3, 0]], pose.values[None, 4:], Path())[0]
    c2w = similarity.move(np.linalg.inv(w2c))
    moved = np.linalg.inv(c2w)
    return _Numbers(pose.at, np.array([*rotation_to_wxyz(torch.from_numpy(moved[:3, :3])), *moved[:3, 3]]))


def _patch_binary(data: bytes, numbers: Sequence[_Numbers]) -> bytes:
    out = bytearray(data)
    for at, values in numbers:
        struct.pack_into(f"<{len(values)}d", out, at, *values)
    return bytes(out)


def _patch_text(data: bytes, numbers: Sequence[_Numbers]) -> bytes:
    """Lines with the numbers after their first word replaced."""
    lines = data.decode("utf-8").split("\n")
    for at, values in numbers:
        words = lines[at].split(maxsplit=len(values) + 1)
        lines[at] = " ".join([words[0], *(f"{v:.12g}" for v in values), *words[len(values) + 1 :]])
    return "\n".join(["# metres", *lines]).encode("utf-8")


class _Cursor:
    """Values of a binary file in turn; running over its end is an error of its format."""

    def __init__(self, file: Path, data: bytes) -> None:
        self.file, self.data, self.at = file, data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        try:
            values = struct.unpack_from(f"<{layout}", self.data, self.at)
        except struct.error:
            raise FormatError(self.file, f"byte {self.at}", "the end of the file", "more values") from None
        self.at += struct.calcsize(f"<{layout}")
        return values

    def array(self, dtype: np.dtype, n: int) -> np.ndarray:
        if n > (len(self.data) - self.at) // dtype.itemsize:
            raise FormatError(self.file, f"byte {self.at}", f"{n} entries", "as many as the file holds")
        values = np.frombuffer(self.data, dtype, n, self.at)
        self.at += n * dtype.itemsize
        return values

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        name = self.data[self.at : end].decode("utf-8", "replace") if end >= 0 else ""
        self.at = end + 1 if end >= 0 else len(self.data)
        return name


def _binary_cameras(file: Path) -> dict[int, ColmapLens]:
    cursor, lenses = _Cursor(file, files.read_bytes(file)), {}
    for _ in range(cursor.take("Q")[0]):
        number, model, w, h = cursor.take("iiQQ")
        if model not in _BINARY_LENSES:
            names = ", ".join(_BINARY_LENSES.values())
            raise FormatError(file, f"model of camera {number}", model, f"{names} (undistort the images first)")
        name = _BINARY_LENSES[model]
        n_focal, n_lens = COLMAP_LENSES[name]
        lenses[number] = make_colmap_lens(name, (h, w), cursor.take(f"{n_focal + 2 + n_lens}d"))
    return lenses


_Image = tuple[str, int, _Numbers, np.ndarray, np.ndarray]


def _binary_images(file: Path, data: bytes) -> Iterator[_Image]:
    cursor = _Cursor(file, data)
    observation = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
    for _ in range(cursor.take("Q")[0]):
        cursor.take("I")
        pose = _Numbers(cursor.at, np.array(cursor.take("7d")))
        camera = cursor.take("I")[0]
        name = cursor.text()
        seen = cursor.array(observation, cursor.take("Q")[0])
        yield name, camera, pose, seen["uv"], seen["point"]


def _binary_points(file: Path, data: bytes) -> Iterator[tuple[int, _Numbers]]:
    cursor = _Cursor(file, data)
    track = np.dtype("<u8")
    for _ in range(cursor.take("Q")[0]):
        number = cursor.take("Q")[0]
        place = _Numbers(cursor.at, np.array(cursor.take("3d")))
        cursor.take("3Bd")
        cursor.array(track, cursor.take("Q")[0])
        yield number, place


def _text_rows(file: Path, stride: int) -> Iterator[tuple[int, list[str], list[str]]]:
    """(line, its words, words of the next line of an entry) of a text model; an entry has ``stride`` lines."""
    lines, k = files.read_text(file).split("\n"), 0
    while k < len(lines):
        if lines[k].strip() and not lines[k].lstrip().startswith("#"):
            yield k, lines[k].split(maxsplit=9), lines[k + 1].split() if stride == 2 and k + 1 < len(lines) else []
            k += stride
        else:
            k += 1


def _text_images(file: Path) -> Iterator[_Image]:
    for line, words, seen in _text_rows(file, 2):
        if len(words) != 10 or len(seen) % 3 or not (words[0] + words[8]).isdecimal():
            raise FormatError(file, f"line {line + 1}", " ".join(words), "IMAGE_ID, QW … TZ, CAMERA_ID, NAME")
        pose = files.to_array(_floats(words[1:8]), (7,), file, f"line {line + 1}")
        row = files.to_array(_floats(seen), (len(seen),), file, f"line {line + 2}").reshape(-1, 3)
        yield words[9].strip(), int(words[8]), _Numbers(line, pose), row[:, :2], row[:, 2].astype(np.int64)


def _text_points(file: Path) -> Iterator[tuple[int, _Numbers]]:
    for line, words, _ in _text_rows(file, 1):
        if len(words) < 8 or not words[0].isdecimal():
            raise FormatError(file, f"line {line + 1}", " ".join(words), "POINT3D_ID, X, Y, Z, R, G, B, ERROR, …")
        yield int(words[0]), _Numbers(line, files.to_array(_floats(words[1:4]), (3,), file, f"line {line + 1}"))


def _floats(words: Sequence[str]) -> list[Any]:
    """Numbers of words; a word that is none stays, for the error of the array."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return list(words)


# --------------------------------------------------------------------------------------------------------- nerfstudio


def _read_nerfstudio(file: Path) -> SceneModel:
    """Cameras of ``transforms.json`` and the points of its PLY, both in the world of the file."""
    meta, folder = files.read_json(file), file.parent
    name = meta.get("ply_file_path", "sparse_pc.ply")
    cloud = files.resolve_inside(folder, str(name), file, "ply_file_path")
    if not cloud.is_file():
        raise FormatError(file, "ply_file_path", name if "ply_file_path" in meta else "none", "a PLY with points")
    vertices, views = _read_points(cloud), []
    entries = files.get_entry(meta, "frames", list, file)
    for k, entry in enumerate(entries):
        values = {**meta, **(entry if isinstance(entry, dict) else {})}
        number = {key: files.to_array(values.get(key, 0), (), file, f"frames.{k}.{key}") for key in _LENS_KEYS}
        fl_x, w, h = (files.to_positive(values.get(key), file, f"frames.{k}.{key}") for key in ("fl_x", "w", "h"))
        fl_y = files.to_positive(values.get("fl_y", fl_x), file, f"frames.{k}.fl_y")
        c2w = files.to_array(values.get("transform_matrix"), (4, 4), file, f"frames.{k}.transform_matrix")
        lens = tuple(float(number[key]) for key in _LENS_KEYS[2:])
        K = convert.make_K(fl_x, fl_y, float(number["cx"]) - 0.5, float(number["cy"]) - 0.5)
        path = str(values.get("file_path", ""))
        picture = files.resolve_inside(folder, path, file, f"frames.{k}.file_path")
        image = picture if picture.is_file() else None
        views.append(ModelView(path, K, (round(h), round(w)), c2w @ _GL_FROM_CV, lens if any(lens) else None, image))

    def save(out: Path, similarity: Similarity) -> None:
        frames = []
        for view, entry in zip(views, entries, strict=True):
            frames.append({**entry, "transform_matrix": (similarity.move(view.c2w) @ _GL_FROM_CV).tolist()})
            for key in _FILE_KEYS:
                if isinstance(entry.get(key), str):
                    stored = files.resolve_inside(folder, entry[key], file, key)
                    storage.copy_file(stored, files.resolve_inside(out, entry[key], file, key))
        kept = {key: value for key, value in meta.items() if key not in ("applied_transform", "applied_scale")}
        storage.write_json(out / file.name, {**kept, "ply_file_path": cloud.name, "frames": frames})
        _write_points(out / cloud.name, vertices, similarity)

    return SceneModel(views, vertices.xyz, "nerfstudio", file, save)


_LENS_KEYS = ("cx", "cy", "k1", "k2", "p1", "p2", "k3")

#: Names of a frame's files, which are copied beside the written ``transforms.json``.
_FILE_KEYS = ("file_path", "mask_path", "depth_file_path")


# -------------------------------------------------------------------------------------------------------------- splats


def _read_points(file: Path) -> PlyVertices:
    try:
        return read_ply_vertices(file)
    except ValueError as error:
        raise FormatError(file, "points", str(error).removeprefix(f"{file}: "), "a PLY with x, y and z") from None


def _write_points(file: Path, vertices: PlyVertices, similarity: Similarity) -> None:
    """A PLY after a similarity: places, normals, and of splats the logarithms of their sizes."""
    vertex = vertices.vertex.copy()
    names = vertex.dtype.names or ()
    turned = not np.allclose(similarity.R, np.eye(3))
    if turned and any(name.startswith(("f_rest_", "rot_")) for name in names):
        raise ValueError(f"{file.name}: found a splat to be turned, expected frame=model: colours depend on direction")
    for name, values in zip("xyz", similarity.apply(vertices.xyz).T, strict=True):
        vertex[name] = values
    if turned and {"nx", "ny", "nz"} <= {*names}:
        normals = np.stack([vertex[n] for n in ("nx", "ny", "nz")], 1).astype(np.float64) @ similarity.R.T
        for name, values in zip(("nx", "ny", "nz"), normals.T, strict=True):
            vertex[name] = values
    for name in names:
        if name.startswith("scale_"):
            vertex[name] += np.log(similarity.scale)
    storage.replace_file(file, vertices.encode(vertex))


def _read_splat(file: Path, pictures: Path | None) -> SceneModel:
    """Centres of opaque splats, and the cameras of ``cameras.json`` beside the PLY or up to two folders above it."""
    places = [f / "cameras.json" for f in [file.parent, *file.resolve().parents[1:3]] if (f / "cameras.json").is_file()]
    if not places:
        raise FormatError(file.parent, "cameras.json", "none beside or above the PLY", "the splat's cameras")
    source = places[0]
    cameras = files.decode_json(files.read_text(source), source)
    vertices, views = _read_points(file), []
    for k, entry in enumerate(files.get_entry({"cameras": cameras}, "cameras", list, source)):
        values = entry if isinstance(entry, dict) else {}
        w, h, fx, fy = (files.to_positive(values.get(n), source, f"{k}.{n}") for n in ("width", "height", "fx", "fy"))
        c2w = np.eye(4)
        c2w[:3, :3] = files.to_array(values.get("rotation"), (3, 3), source, f"{k}.rotation")
        c2w[:3, 3] = files.to_array(values.get("position"), (3,), source, f"{k}.position")
        name = str(values.get("img_name", k))
        K = convert.make_K(fx, fy, w / 2 - 0.5, h / 2 - 0.5)
        image = _find_picture(source.parent, name, pictures)
        views.append(ModelView(name, K, (round(h), round(w)), c2w, None, image))
    names = vertices.vertex.dtype.names or ()
    xyz = vertices.xyz[vertices.vertex["opacity"] > 0] if "opacity" in names else vertices.xyz

    def save(out: Path, similarity: Similarity) -> None:
        _write_points(out / file.name, vertices, similarity)
        moved = [similarity.move(view.c2w) for view in views]
        places = [{"position": c2w[:3, 3].tolist(), "rotation": c2w[:3, :3].tolist()} for c2w in moved]
        entries = [{**entry, **place} for entry, place in zip(cameras, places, strict=True)]
        storage.replace_file(out / "cameras.json", (json.dumps(entries) + "\n").encode("utf-8"))

    return SceneModel(views, xyz, "splat", file, save)


# -------------------------------------------------------------------------------------------------- maps of networks


def _read_arrays(root: Path, archives: Sequence[Path], pictures: Path | None) -> SceneModel:
    """One archive with all views along the first axis, or one archive for each view."""
    views: list[ModelView] = []
    for archive in archives:
        present = _list_arrays(archive)
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


def _list_arrays(archive: Path) -> set[str]:
    data = files.read_bytes(archive)
    check_zip_directory(io.BytesIO(data), archive)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as opened:
            size = sum(member.file_size for member in opened.infolist())
            check_memory(archive, "arrays", size, f"{size} bytes unpacked", len(data))
            return {name.removesuffix(".npy") for name in opened.namelist() if name.endswith(".npy")}
    except (zipfile.BadZipFile, ValueError) as error:
        raise FormatError(archive, "archive", error, "a whole .npz archive") from None


def _names_of_arrays(
    root: Path, archive: Path, present: set[str], n_archives: int, pictures: Path | None
) -> list[str | Path] | None:
    """Names of the views of an archive: stored, its own, or the files of ``images/``; None = none of these."""
    stored = next((name for name in _TEXT_NAMES if name in present), None)
    if stored is not None:
        try:
            names = np.load(archive, allow_pickle=False)[stored]
        except (ValueError, OSError, zipfile.BadZipFile) as error:
            raise FormatError(archive, stored, error, "an array of text") from None
        return [str(name) for name in np.atleast_1d(names)]
    if n_archives > 1:
        return [archive.stem]
    folder = pictures if pictures is not None else (root if root.is_dir() else root.parent) / "images"
    present_files = [file for file in folder.glob("*") if file.suffix in _IMAGE_SUFFIXES] if folder.is_dir() else []
    return sorted(present_files, key=files.natural_sort_key) or None


def _views_of_arrays(
    archive: Path, values: Mapping[str, np.ndarray], names: Sequence[str | Path] | None
) -> Iterator[ModelView]:
    """Views of an archive, whose arrays have a first axis of views or are those of one view."""
    pose = values["c2w"] if "c2w" in values else values["w2c"]
    pose = pose.reshape(-1, *pose.shape[-2:])
    n = len(pose)
    maps = values["depth"] if "depth" in values else values["points"]
    trailing = 3 if "depth" not in values else 1
    maps = maps[..., None] if trailing == 1 and maps.shape[-1] != 1 else maps
    try:
        maps = maps.reshape(n, *maps.shape[-3:])
        K = np.broadcast_to(values["K"].reshape(-1, 3, 3), (n, 3, 3))
        full = np.tile(np.eye(4), (n, 1, 1))
        full[:, : pose.shape[1]] = pose
        conf = values["conf"].reshape(n, *maps.shape[1:3]) if "conf" in values else None
    except ValueError as error:
        raise FormatError(archive, "shapes", error, f"the same number of views in all arrays, here {n}") from None
    if names is not None and len(names) != n:
        raise FormatError(archive, "names", f"{len(names)} names or pictures", f"one for each of {n} views")
    c2w = full if "c2w" in values else np.linalg.inv(full)
    for k in range(n):
        z = maps[k, ..., 0]
        if trailing == 3:
            z = ((maps[k] - c2w[k, :3, 3]) @ c2w[k, :3, :3])[..., 2]
        z = np.where(np.isfinite(z) & (z > 0), z, 0.0)
        if conf is not None:
            z[conf[k] < np.quantile(conf[k], _LEAST_CONFIDENT_SHARE)] = 0
        name = f"{k:06d}" if names is None else names[k]
        image = name if isinstance(name, Path) else _find_picture(archive.parent, Path(name).name, None)
        yield ModelView(Path(name).name, K[k], (z.shape[0], z.shape[1]), c2w[k], image=image, depth=z)


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
