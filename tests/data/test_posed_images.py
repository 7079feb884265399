"""Exports with a camera for every image (nerfstudio and its relatives, Polycam): written with known geometry, read."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from support.box_scene import walk
from support.capture_cases import DELETE, Case, check_case, check_frames
from support.writers import write_colmap_capture, write_counted_frames, write_nerfstudio, write_polycam

from dhtorch import data
from dhtorch.records import Camera, Frame

RIGID = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 1.5], [0, 0, 0, 1]])  # as nerfstudio's of COLMAP


# ------------------------------------------------------------------------------------------------------ transforms.json


def with_camera(n: int, f: list[float], c: list[float], lens: list[float] | None = None, **options: Any) -> Any:
    """Frames of another camera."""
    distortion = None if lens is None else torch.tensor([lens])
    return lambda: walk(n, Camera(torch.tensor([f]), torch.tensor([c]), distortion), **options)


def half_depth() -> list[Frame]:
    half = Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[15.5, 11.5]]))
    frames = walk(2, Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[31.5, 23.5]])))
    return [f.replace(depth=f.depth[:, ::2, ::2].contiguous(), depth_camera=half) for f in frames]


def in_turn(*entries: dict[str, Any]) -> tuple[str, Any]:
    """An edit of the frames of ``transforms.json``."""
    return FILE, {"frames": dict(enumerate(entries))}


def float_map(i: int, kind: str) -> bytes:
    """Depth of frame ``i`` in m, with one value that is none, as a file."""
    values, file = walk(2)[i].depth[0].numpy().copy(), io.BytesIO()
    values[0, 0] = np.nan
    np.save(file, values[..., None]) if kind == "npy" else Image.fromarray(values).save(file, "tiff")
    return file.getvalue()


def levelled() -> list[Frame]:
    """Frames with all three levels of confidence."""
    levels = (torch.arange(48 * 64) % 3).to(torch.uint8).reshape(1, 48, 64)
    return [f.replace(conf=levels) for f in walk(3)]


FILE = "transforms.json"
LENS = [0.01, -0.02, 0.003, -0.004, 0.005]
ANGLE = {"camera_angle_x": 2 * np.arctan(0.5)}
NO_CAMERA = {"frames": {"*": dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"), DELETE)}}
nerf, polycam, colmap = write_nerfstudio, write_polycam, write_colmap_capture
STEM = [str(round((100 + i / 30) * 1e6)) for i in range(4)]
KEY = "keyframes"
MODEL = "sparse/0"

FOUR = ([0, 1, 2, 3], 1e-3, 1.0, True)
CASES = [
    # Poses are those before the converter's transformation and scale, in metres.
    *(Case(f"nerfstudio, {name} {scale} {shared}", nerf, 4, (),
           {"format": "nerfstudio", "number": [1, 2, 3, 4], "axes": "gl", "same": FOUR,
            "times of": [100.0, 100.033333, 100.066667, 100.1], "unit": (1e-3, f"{FILE}: depth_unit_scale_factor"),
            "report": () if scale == 1 else (f"poses are stored times {scale:g} (applied_scale): undone",)},
           written={"applied": applied, "scale": scale, "shared_K": shared}, path=path)
      for shared, path in ((False, "."), (True, FILE))
      for name, applied, scale in (("plain", None, 1.0), ("rigid", RIGID, 1.0), ("rigid", RIGID, 0.25), ("plain", None, 3.0))),
    Case("codes of no return", nerf, 2, [("depth/frame_00001.png", np.full((48, 64), 65535, np.uint16))], {"returns": 0}),
    Case("images of half the size", nerf, 2, [("images/*", np.zeros((24, 32, 3), np.uint8))],
         {"f": pytest.approx([61.5 / 2, 58.25 / 2]),
          "report": ("images of 32x24, transforms.json states K for 64x48: K is scaled",)}),
    Case("images of another shape", nerf, 2, [("images/*", np.zeros((32, 32, 3), np.uint8))], error="image size"),
    *(Case(f"floats in {kind} without unit are metres", nerf, 2,
           [*((f"depth/frame_{i + 1:05d}.{kind}", float_map(i, kind)) for i in range(2)),
            in_turn(*({"depth_file_path": f"depth/frame_{i + 1:05d}.{kind}"} for i in range(2)))],
           {"unit": (1.0, None), "returns": 48 * 64 - 1,
            "median": pytest.approx(float(torch.cat([f.depth.flatten()[1:] for f in walk(2)]).median()))},
           written={"unit_key": None}) for kind in ("npy", "tiff")),
    *(Case(f"images of two folders are two cameras, {name}", nerf, 4,
           [*((f"images/frame_{i:05d}.png", Path(f"images/left/frame_{i:05d}.png")) for i in (1, 2)),
            in_turn(*({"file_path": f"images/left/frame_{i:05d}.png"} for i in (1, 2)))],
           {"title": f"capture/{name}", "number": numbers, "same": (places, 1e-3, 1.0, True)}, which=place)
      for place, (name, numbers, places) in enumerate((("images/left", [1, 2], [0, 1]), ("images", [3, 4], [2, 3])))),
    *(Case(f"nerfcapture, {key}", nerf, 3, (),
           {"unit": (10 / 65535, f"{FILE}: {key}"), "times": None, "same": ([0, 1, 2], 10 / 65535)},
           written={"unit_key": key, "unit_m": 10 / 65535, "depth_key": "depth_path", "suffix": "", "times": False})
      for key in ("integer_depth_scale", "depth_unit_scale_factor")),
    Case("unit assumed", nerf, 2, (), {"unit": (1e-3, None)}, written={"unit_key": None, "unit_m": 2e-4}),
    Case("unit of an option", nerf, 2, (), {"same": ([0, 1], 2e-4)}, options={"depth_unit": 2e-4},
         written={"unit_key": None, "unit_m": 2e-4}),
    Case("lens in the order of OpenCV", nerf, with_camera(2, [61.5, 58.25], [33.5, 21.75], LENS), (),
         {"lens": pytest.approx(LENS)}),
    Case("a term of r⁸", nerf, 2, [in_turn({}, {"k4": 0.1})],
         error=r"transforms.json: frames.1.k4: found 0.1, expected 0 .*undistort"),
    *(Case(f"other lens {name}", nerf, 2, [(FILE, change)],
           error=rf"camera_model: found {name}, expected OPENCV, .*undistort other lenses")
      for name, change in (("OPENCV_FISHEYE", {"camera_model": "OPENCV_FISHEYE"}), ("is_fisheye", {"is_fisheye": True}),
                           ("EQUIRECTANGULAR", {"camera_model": "EQUIRECTANGULAR"}))),
    Case("angles of Instant-NGP", nerf, 2, [(FILE, ANGLE), (FILE, NO_CAMERA)],
         {"f": pytest.approx([64, 64]), "c": [31.5, 23.5]}),
    Case("order by number", nerf, 4, [(FILE, lambda text: json.dumps(
        json.loads(text) | {"frames": json.loads(text)["frames"][::-1]}))], {"same": ([0, 1, 2, 3], 1e-3)}),
    Case("order by time", nerf, 4,
         [*((f"images/frame_{i + 1:05d}.png", Path(f"images/{name}.png"))
            for i, name in enumerate(("delta", "bravo", "alpha", "charlie"))),
          in_turn(*({"file_path": f"images/{name}"} for name in ("delta", "bravo", "alpha", "charlie")))],
         {"same": ([0, 1, 2, 3], 1e-3)}),
    Case("a clock against the numbers", nerf, 3, [in_turn(*({"timestamp": -float(i)} for i in range(3)))],
         {"times": None, "same": ([0, 1, 2], 1e-3),
          "report": ("time stamps do not increase with the numbers of the images: there are no times",)}),
    Case("a clock of no seconds", nerf, 3, [in_turn(*({"timestamp": 1e9 * i} for i in range(3)))],
         {"times": None, "report": ["no seconds: there are no times"]}),
    Case("incomplete frames are named", nerf, 5,
         [("images/frame_00002.png", DELETE), ("depth/frame_00003.png", DELETE),
          (FILE, {"frames": {3: {"transform_matrix": np.full((4, 4), np.nan).tolist()}}})],
         {"number": [1, 3, 5], "empty": [False, True, False], "report": (
             "image frame_00002.png: no such image: left out",
             "image frame_00004.png: no pose, or one that is not finite (tracking lost): left out",
             "image frame_00003.png: no depth map: its depth is empty")}),
    Case("no depth", nerf, 2, [(FILE, {"frames": {"*": {"depth_file_path": DELETE}}})],
         {"unit": None, "empty": [True, True], "report": (
             "depth/ is not read: transforms.json names no depth maps (depth_file_path of each frame)",
             "no depth maps: depth is empty")}),
    Case("smaller depth keeps the field of view", nerf, half_depth, (), {"depth hw": (24, 32), "depth f": None}),
    *(Case(f"damaged {field}", nerf, 2, [(FILE, {"frames": {1: {field: value}}})], error=message)
      for field, value, message in (
          ("file_path", "/etc/passwd", "found /etc/passwd, expected a file inside the capture"),
          ("file_path", "../x.png", "expected a file inside the capture"),
          ("depth_file_path", "..\\x.png", "expected a file inside the capture"),
          ("file_path", 3, "file_path: found 3, expected a text"),
          ("transform_matrix", [[1, 2], [3, 4]], "found 2 rows, expected 3 or 4 rows"),
          ("transform_matrix", (2 * np.eye(4)).tolist(), "transforms.json"),
          ("fl_x", 0, r"frames.1.fl_x: found 0.0, expected a positive number"), ("cx", "a", "frames.1.cx"))),
    Case("no rigid motion", nerf, 2, [(FILE, {"applied_transform": (2 * RIGID)[:3].tolist()})],
         error=r"applied_transform: .* expected a rotation"),
    *(Case(f"the whole file is {content!r}", nerf, 2, [(FILE, content)], error=r"transforms\.json")
      for content in ("", "[]", "{}", '{"frames": 3}', '{"frames": [3]}', '{"frames": []}')),
    # Polycam
    *(Case(f"polycam, corrected {corrected}, {path}", polycam, levelled, (),
           {"format": "polycam", "title": "capture", "report": (), "axes": "gl", "conf": True,
            "unit": (1e-3, "format definition: Polycam stores millimetres"), "same": ([0, 1, 2], 1e-3, 1.0, True)},
           written={"corrected": corrected}, path=path) for corrected in (True, False) for path in (".", "keyframes")),
    Case("polycam, poses as captured", polycam, levelled, (),
         {"start": pytest.approx((walk(1)[0].T_world_from_cam.t[0] + 1).tolist())}, options={"corrected": False}),
    Case("polycam, what is missing", polycam, 4,
         [(f"{KEY}/cameras/{STEM[1]}.json", DELETE), (f"{KEY}/depth/{STEM[2]}.png", DELETE),
          (f"{KEY}/confidence/{STEM[3]}.png", DELETE)],
         {"number": [0, 2, 3], "empty": [False, True, False],
          "report": ("frame 1: no file in cameras/: left out", f"image {STEM[2]}.png: no depth map: its depth is empty")},
         written={"corrected": False}),
    Case("polycam without an image", polycam, 3, [(f"{KEY}/images/{STEM[2]}.png", DELETE)],
         {"report": (f"frame {STEM[2]}: no file in images/: left out",)}, written={"corrected": False}),
    *(Case(f"polycam, {field} {value}", polycam, 2, [(f"{KEY}/cameras/{STEM[1]}.json", {field: value})],
           error=rf"\.json: .*{message}", written={"corrected": False})
      for field, value, message in (("fx", 0, "fx: found 0.0"), ("t_00", "a", "t_00"), ("t_00", 7.0, "determinant"))),
    # COLMAP
    *(Case(f"colmap in {folder}", colmap, 3, (),
           {"format": "colmap", "number": [1, 2, 3], "report": (), "unit": (1e-3, None), "axes": "cv",
            "times": pytest.approx([100 + i / 30 for i in range(3)]), "same": ([0, 1, 2], 1e-3)},
           written={"folder": folder, "model": "PINHOLE"}) for folder in ("sparse/0", "sparse", "colmap", ".")),
    *(Case(f"colmap {model}", colmap, with_camera(2, [61.0, 61.0], [30.5, 22.5], LENS[:4]), (),
           {"lens": pytest.approx([*LENS[:n], *[0.0] * (4 - n)]), "f": pytest.approx([61.0, 61.0]), "times": None,
            "report": ("poses were estimated by COLMAP: their scale is not metric unless it was aligned",)},
           written={"model": model, "is_metric": False}) for model, n in (("SIMPLE_RADIAL", 1), ("OPENCV", 4))),
    Case("a model alone", colmap, 2, error="images: found none beside the model", path=MODEL),
    Case("a model with options", colmap, 2, (), {"empty": [False, False], "same": ([0, 1], 1e-3)}, path=MODEL,
         options={"images": "../../images", "depth": "../../depth"}),
    Case("no such folder of images", colmap, 2, options={"images": "pictures"},
         error="images: found no folder pictures"),
    Case("another lens of colmap", colmap, 2, [(f"{MODEL}/cameras.txt", [("OPENCV", "OPENCV_FISHEYE")])],
         error=r"model: found OPENCV_FISHEYE, expected .*undistort the images first"),
    Case("a camera that is not listed", colmap, 2, [(f"{MODEL}/cameras.txt", [("\n2 OPENCV", "\n9 OPENCV")])],
         error="camera of image 2: found 2, expected a camera"),
    Case("no text model", colmap, 2, [(f"{MODEL}/cameras.txt", DELETE)], error="colmap model_converter",
         options={"format": "colmap"}),
    Case("poses of numbered frames win over an estimate",
         lambda root, frames: [write(root, frames) for write in (colmap, write_counted_frames)], 2,
         [(f"{folder}/000{i}.png", DELETE) for folder in ("images", "depth") for i in (1, 2)],
         {"format": "frames_dir", "same": ([0, 1], 1e-3)}),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)


def test_images_with_an_orientation_tag_are_turned_to_their_camera(tmp_path: Path) -> None:
    """Stored landscape with EXIF 6; w, h, K and depth describe the upright image."""
    frames = walk(2, hw=(64, 48), camera=Camera(torch.tensor([[61.0, 61.0]]), torch.tensor([[22.5, 33.5]])))
    write_nerfstudio(tmp_path, frames)
    for file in (tmp_path / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.open(file).transpose(Image.Transpose.ROTATE_90).save(file, exif=exif)
    recording = data.open(tmp_path)
    check_frames(recording, frames, 1e-3)
    assert any(line.startswith("orientation: EXIF orientation 6") for line in recording.report)
