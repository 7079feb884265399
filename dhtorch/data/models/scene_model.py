"""A reconstruction up to scale: views (picture, camera, pose, depth map or observed points) and points."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dhtorch.data.io import decode as files
from dhtorch.data.io.decode import FormatError
from dhtorch.geometry import camera as cam
from dhtorch.records import Camera
from dhtorch.runtime import storage
from dhtorch.runtime.ply import PlyVertices, read_ply_vertices
from dhtorch.runtime.safe_open import check_link, check_regular_file, restrict_links

#: A model point is seen in a picture unless another one is nearer by this fraction within a cell of so many cells
#: across.
_OCCLUSION_REL, _OCCLUSION_CELLS = 0.05, 48


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

    @property
    def camera(self) -> Camera:
        """(1) float64."""
        lens = None if self.distortion is None else torch.tensor([self.distortion], dtype=torch.float64)
        return cam.from_matrix(torch.from_numpy(np.array(self.K, np.float64))[None], lens)

    def read_picture(self) -> Tensor:
        """Picture (1, C, H, W) uint8.

        Raises:
            FormatError: none, or a damaged one.
        """
        if self.image is None:
            raise FormatError(Path(self.name), "picture", "none", "the picture of the view")
        return torch.from_numpy(files.read_image(self.image))[None]

    def to_world(self, xyz: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the camera -> of the model."""
        return xyz @ self.c2w[:3, :3].T + self.c2w[:3, 3]


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A reconstruction up to scale."""

    views: Sequence[ModelView]
    xyz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # (P, 3) model units
    format: str = "memory"
    root: Path = Path()
    save: Callable[[Path, Similarity], None] | None = field(default=None, repr=False)

    def seen_points(self, view: ModelView) -> tuple[Tensor, Tensor]:
        """Pixels (n, 2) of a view, of K's size, and depths (n,) of the points observed there; where observations are
        not stored, of all points inside the picture that no other one hides."""
        xyz = self.xyz if view.point is None else self.xyz[view.point]
        local = torch.from_numpy((xyz - view.c2w[:3, 3]) @ view.c2w[:3, :3])
        z = local[:, 2]
        if view.uv is None:
            camera = view.camera
            uv = cam.project(cam.ideal(camera), torch.where(z[:, None] > 0, local, 1.0)[None])
            uv = cam.distort(camera, uv)[0]
            # Points (N,) inside a picture that are not behind others in their cell
            inside = (z > 0) & (uv >= 0).all(-1) & (uv[:, 0] <= view.hw[1] - 1) & (uv[:, 1] <= view.hw[0] - 1)
            cell = (uv.nan_to_num(-1.0) / (max(view.hw) / _OCCLUSION_CELLS)).long()
            key = torch.where(inside, cell[:, 1] * (_OCCLUSION_CELLS + 1) + cell[:, 0], 0).clamp_min(0)
            nearest = torch.full((int(key.max()) + 1 if len(key) else 1,), torch.inf, dtype=z.dtype)
            nearest.scatter_reduce_(0, key[inside], z[inside], "amin")
            keep = inside & (z <= (1 + _OCCLUSION_REL) * nearest[key])
        else:
            uv, keep = torch.from_numpy(np.array(view.uv)), z > 0
        return uv[keep].double(), z[keep].double()


def write_model(model: SceneModel, out: Path, similarity: Similarity) -> None:
    """Write the files of a model that was read into the folder ``out``, after a similarity.

    What is no length stays as it is.

    Raises:
        ValueError: a model from memory, or a rotation of a splat, whose colours depend on the direction.
    """
    if model.save is None:
        raise ValueError("write_model: found a model from memory, expected one that was read")
    model.save(out, similarity)


def find_picture(folder: Path, name: str, pictures: Path | None) -> Path | None:
    """File of a picture below ``images/`` of the folder or up to two folders above it; None where there is none.

    Raises:
        FormatError: a name or a link that leads out of the folder that holds ``images/``, or out of ``pictures``.
    """
    above = [folder, *folder.resolve().parents[:2]] if pictures is None else [pictures]
    for top, below in itertools.product(above, ("images", "rgb", "color") if pictures is None else ("",)):
        for suffix in ("", *files.IMAGE_SUFFIXES):
            file = files.resolve_inside(top / below, name + suffix, folder, "picture")
            if file.is_file():
                return check_inside(file, top)
    return None


def check_inside(file: Path, folder: Path) -> Path:
    """The file, below ``folder``, after a check that no link leads out of that.

    Raises:
        FormatError: a link does.
    """
    with restrict_links(folder, "model"):
        check_link(file)
    return file


def read_points(file: Path) -> PlyVertices:
    """Points of a PLY file.

    Raises:
        FormatError: no such PLY.
    """
    check_regular_file(file)
    try:
        return read_ply_vertices(file)
    except ValueError as error:
        raise FormatError(file, "points", str(error).removeprefix(f"{file}: "), "a PLY with x, y and z") from None


def write_points(file: Path, vertices: PlyVertices, similarity: Similarity) -> None:
    """Write a PLY after a similarity: places, normals, and of splats the logarithms of their sizes.

    Raises:
        ValueError: a rotation of a splat.
    """
    vertex = vertices.vertex.copy()
    names = vertex.dtype.names or ()
    turned = not np.allclose(similarity.R, np.eye(3))
    if turned and any(name.startswith(("f_rest_", "rot_")) for name in names):
        raise ValueError(f"{file.name}: found a splat to be turned, expected frame=model: colours depend on direction")
    for name, values in zip("xyz", similarity.apply(vertices.xyz).T, strict=True):
        vertex[name] = values
    normal = ("nx", "ny", "nz")
    if turned and {*normal} <= {*names}:
        normals = np.stack([vertex[n] for n in normal], 1).astype(np.float64) @ similarity.R.T
        for name, values in zip(normal, normals.T, strict=True):
            vertex[name] = values
    for name in names:
        if name.startswith("scale_"):
            vertex[name] += np.log(similarity.scale)
    storage.replace_file(file, vertices.encode(vertex))
