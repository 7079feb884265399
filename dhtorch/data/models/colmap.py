"""COLMAP's model as a reconstruction up to scale: its views with their observed points."""

from pathlib import Path

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.codecs.colmap import (
    ColmapImageEntry,
    ColmapNumbers,
    read_colmap_cameras,
    read_colmap_images,
    read_colmap_points,
    replace_numbers,
)
from dhtorch.data.io.decode import FormatError
from dhtorch.data.models.scene_model import ModelView, SceneModel, Similarity, find_picture
from dhtorch.data.readers.colmap import MODEL_FOLDERS
from dhtorch.runtime import storage


def find_colmap_model(root: Path) -> tuple[Path, str] | None:
    """Folder of the model and the suffix of its files, ``.bin`` before ``.txt``; None where there is none."""
    for folder in [root / each for each in MODEL_FOLDERS]:
        for suffix in (".bin", ".txt"):
            if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images", "points3D")):
                return folder, suffix
    return None


def read_colmap_model(folder: Path, suffix: str, pictures: Path | None) -> SceneModel:
    """Open a model of COLMAP.

    Raises:
        FormatError: a damaged file, a camera model without OpenCV's distortion, no points.
    """
    cameras, images_file, points_file = (folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    lenses, images = read_colmap_cameras(cameras), read_colmap_images(images_file)
    points = read_colmap_points(points_file)
    if not points:
        raise FormatError(folder, points_file.name, "no points", "points, which give the depth of the pictures")
    index = {number: k for k, number in enumerate(points)}
    views = []
    for image in images:
        if image.camera_id not in lenses:
            raise FormatError(images_file, f"camera of {image.name}", image.camera_id, "a camera")
        lens = lenses[image.camera_id]
        seen = np.array([index.get(k, -1) for k in image.point.tolist()], np.int64)
        views.append(
            ModelView(
                name=image.name,
                K=lens.K,
                hw=lens.hw,
                c2w=image.c2w,
                distortion=lens.distortion,
                image=find_picture(folder, image.name, pictures),
                point=seen[seen >= 0],
                uv=image.uv[seen >= 0],
            )
        )

    def save(out: Path, similarity: Similarity) -> None:
        storage.copy_file(cameras, out / cameras.name)
        poses = [_move_pose(image, similarity) for image in images]
        places = [ColmapNumbers(at, similarity.apply(xyz)) for at, xyz in points.values()]
        for file, moved in ((images_file, poses), (points_file, places)):
            storage.replace_file(out / file.name, replace_numbers(file, moved))

    return SceneModel(views, np.array([n.values for n in points.values()]), f"colmap {suffix[1:]}", folder, save)


def _move_pose(image: ColmapImageEntry, similarity: Similarity) -> ColmapNumbers:
    """Quaternion, w >= 0, and translation of a world-to-camera pose after a similarity of the world."""
    w2c = np.linalg.inv(similarity.move(image.c2w))
    q = convert.quaternions_of(torch.from_numpy(w2c[None, :3, :3]))[0, [3, 0, 1, 2]].numpy()
    return ColmapNumbers(image.pose.at, np.concatenate((-q if q[0] < 0 else q, w2c[:3, 3])))
