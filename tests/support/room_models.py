"""Models of the built-in room in the layouts of COLMAP, nerfstudio, splats and networks, and its capture."""

import json
import struct
from functools import cache

import numpy as np
import torch

from dhtorch.data.models import ModelView, SceneModel
from dhtorch.experiments.compare.scale_study import ScaleScene, make_scale_model, regular_grid_of
from dhtorch.export.arrays import rotation_to_wxyz
from dhtorch.geometry import se3
from dhtorch.geometry.patches import sample_nearest
from dhtorch.synthetic.recording import SyntheticRoom

#: Near limit of the models and captures, m.
NEAR = 2.5

GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


@cache
def room_scene(n_frames=12):
    """A small room with exact depth."""
    room = SyntheticRoom(hw=(96, 128), depth_hw=(96, 128), n_frames=n_frames, supersample=1, step_m=0.08, lidar="exact")
    frames = [room[i] for i in range(n_frames)]
    depth = [sample_nearest(f.depth, regular_grid_of((48, 64), f.hw))[0].view(48, 64).double().numpy() for f in frames]
    return ScaleScene(frames, se3.to_matrix(room.poses).numpy(), depth, True)


def room_model(kind, fault=None, size=0.0, seed=0):
    """(model, true scale) of the room."""
    return make_scale_model(room_scene(), kind, fault, size, near=NEAR, seed=seed)


def write_pictures(folder, suffix=".png"):
    """The room's pictures, named as the views of its models."""
    import cv2  # noqa: PLC0415

    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(room_scene().frames):
        cv2.imwrite(str(folder / f"{i:06d}{suffix}"), frame.image[0].permute(1, 2, 0).numpy()[..., ::-1])


def colmap_pose(view):
    """Quaternion (w first) and translation, world to camera."""
    w2c = np.linalg.inv(view.c2w)
    return [*rotation_to_wxyz(torch.from_numpy(w2c[:3, :3])), *w2c[:3, 3]]


def write_colmap_text(folder, model: SceneModel):
    folder.mkdir(parents=True)
    cameras, images, points = ["# cameras"], ["# images"], ["# points"]
    for k, view in enumerate(model.views, 1):
        f, c = view.K.diagonal()[:2], view.K[:2, 2] + 0.5
        cameras.append(f"{k} PINHOLE {view.hw[1]} {view.hw[0]} {f[0]} {f[1]} {c[0]} {c[1]}")
        images.append(f"{k} {' '.join(map(repr, map(float, colmap_pose(view))))} {k} {view.name}.png")
        images.append(" ".join(f"{u + 0.5} {v + 0.5} {p + 1}" for (u, v), p in zip(view.uv, view.point, strict=True)))
    points += [f"{k} {x} {y} {z} 1 2 3 0.5 1 0" for k, (x, y, z) in enumerate(model.xyz.tolist(), 1)]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")


def write_colmap_binary(folder, model: SceneModel):
    folder.mkdir(parents=True)
    n = struct.pack("<Q", len(model.views))
    cameras, images, points = bytearray(n), bytearray(n), bytearray(struct.pack("<Q", len(model.xyz)))
    for k, view in enumerate(model.views, 1):
        f, c = view.K.diagonal()[:2], view.K[:2, 2] + 0.5
        cameras += struct.pack("<iiQQ4d", k, 1, view.hw[1], view.hw[0], *f, *c)
        images += struct.pack("<I7dI", k, *colmap_pose(view), k) + f"{view.name}.png".encode() + b"\0"
        images += struct.pack("<Q", len(view.uv))
        for (u, v), p in zip(view.uv, view.point, strict=True):
            images += struct.pack("<ddq", u + 0.5, v + 0.5, p + 1)
    for k, xyz in enumerate(model.xyz, 1):
        points += struct.pack("<Q3d3BdQII", k, *xyz, 1, 2, 3, 0.5, 1, 1, 0)
    for name, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(bytes(data))


def write_ply(file, xyz, *, text=False, **columns):
    """Points with further float columns, as text or binary."""
    names = ["x", "y", "z", *columns]
    rows = np.column_stack([xyz, *columns.values()]).astype("<f4")
    header = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    body = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode() if text else rows.tobytes()
    file.write_bytes("\n".join(header).encode() + body)


def write_nerfstudio(folder, model: SceneModel):
    write_pictures(folder / "images")
    view = model.views[0]
    frames = [
        {"file_path": f"images/{v.name}.png", "transform_matrix": (v.c2w @ GL_FROM_CV).tolist()} for v in model.views
    ]
    meta = {"w": view.hw[1], "h": view.hw[0], "fl_x": view.K[0, 0], "fl_y": view.K[1, 1], "applied_scale": 0.5}
    meta |= {"cx": view.K[0, 2] + 0.5, "cy": view.K[1, 2] + 0.5, "ply_file_path": "sparse_pc.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    write_ply(folder / "sparse_pc.ply", model.xyz, text=True)


def write_splat(folder, model: SceneModel):
    place = folder / "point_cloud" / "iteration_30000"
    place.mkdir(parents=True)
    n = len(model.xyz)
    opacity = np.r_[np.full(n, 2.0), np.full(50, -2.0)]
    xyz = np.r_[model.xyz, model.views[0].c2w[:3, 3] + 0.01 * np.random.default_rng(0).normal(size=(50, 3))]
    columns = {"opacity": opacity, "scale_0": np.full(n + 50, -4.0), "rot_0": np.ones(n + 50)}
    write_ply(place / "point_cloud.ply", xyz, **columns)
    cameras = [
        {"id": k, "img_name": v.name, "width": v.hw[1], "height": v.hw[0], "fx": v.K[0, 0], "fy": v.K[1, 1]}
        | {"position": v.c2w[:3, 3].tolist(), "rotation": v.c2w[:3, :3].tolist()}
        for k, v in enumerate(model.views)
    ]
    (folder / "cameras.json").write_text(json.dumps(cameras))


def write_arrays(folder, model: SceneModel, *, one=True):
    """As VGGT writes them (one file), or one file for each view."""
    folder.mkdir(parents=True)

    def arrays(views: list[ModelView]):
        values = {"depth": np.stack([v.depth for v in views])[..., None].astype(np.float32)}
        values["extrinsic"] = np.stack([np.linalg.inv(v.c2w)[:3] for v in views])
        small = [v.K * [[v.depth.shape[1] / v.hw[1]], [v.depth.shape[0] / v.hw[0]], [1]] for v in views]
        return values | {"intrinsic": np.stack(small), "other": np.arange(3)}

    if one:
        names = np.array([f"{v.name}.png" for v in model.views])
        np.savez(folder / "predictions.npz", names=names, **arrays(list(model.views)))
        return
    for view in model.views:
        np.savez(folder / f"{view.name}.npz", **{k: v[0] if k != "other" else v for k, v in arrays([view]).items()})
