"""Exports with a camera for every image (nerfstudio and its relatives, Polycam): written with known geometry, read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from support.box_scene import walk
from support.capture_cases import DELETE, Case, check_case, check_frames, edit_files
from support.writers import write_colmap_capture, write_counted_frames, write_nerfstudio, write_polycam
from support.writers.parts import encode_unfiltered_png

from dhtorch import data
from dhtorch.data.io.decode import FormatError
from dhtorch.data.units import DepthUnit
from dhtorch.export.arrays import encode_depth_codes
from dhtorch.records import Camera, Frame

RIGID = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 1.5], [0, 0, 0, 1]])  # as nerfstudio's of COLMAP


# ------------------------------------------------------------------------------------------------------ transforms.json


@pytest.mark.parametrize("shared_K", [False, True])
@pytest.mark.parametrize(("applied", "scale"), [(None, 1.0), (RIGID, 1.0), (RIGID, 0.25), (None, 3.0)])
def test_what_is_written_is_read(applied: np.ndarray | None, scale: float, shared_K: bool, tmp_path: Path) -> None:
    """Poses are those before the converter's transformation and scale, in metres."""
    frames = walk(4)
    write_nerfstudio(tmp_path, frames, applied=applied, scale=scale, shared_K=shared_K)
    assert data.recognise(tmp_path) == ("nerfstudio", "transforms.json")
    recording = data.open(tmp_path)
    check_frames(recording, frames, 1e-3)
    assert recording.times.tolist() == pytest.approx([float(f.time[0]) for f in frames], abs=1e-6)
    assert recording.number.tolist() == [1, 2, 3, 4] and recording.pose_axes == "gl"
    assert recording.depth_unit == DepthUnit(1e-3, "transforms.json: depth_unit_scale_factor")
    remark = (f"poses are stored times {scale:g} (applied_scale): undone",)
    assert recording.report == (() if scale == 1 else remark)
    assert torch.equal(data.open(tmp_path / "transforms.json")[1].depth, recording[1].depth)


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


FILE = "transforms.json"
LENS = [0.01, -0.02, 0.003, -0.004, 0.005]
ANGLE = {"camera_angle_x": 2 * np.arctan(0.5)}
NO_CAMERA = {"frames": {"*": dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"), DELETE)}}
nerf, polycam, colmap = write_nerfstudio, write_polycam, write_colmap_capture
STEM = [str(round((100 + i / 30) * 1e6)) for i in range(4)]
KEY = "keyframes"
MODEL = "sparse/0"

CASES = [
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


def test_images_of_two_folders_are_two_cameras(tmp_path: Path) -> None:
    frames = walk(4)
    write_nerfstudio(tmp_path, frames)

    left = [f"images/left/frame_{i:05d}.png" for i in (1, 2)]
    edit_files(tmp_path, [(name.replace("left/", ""), Path(name)) for name in left])
    edit_files(tmp_path, [in_turn(*({"file_path": name} for name in left))])
    recordings = data.open_all(tmp_path)
    assert [r.name.removeprefix(tmp_path.name) for r in recordings] == ["/images/left", "/images"]
    assert [len(r) for r in recordings] == [2, 2]


def test_images_of_another_size_than_stated(tmp_path: Path) -> None:
    """Half-size images: K is scaled and that is reported; a cropped one is refused."""
    frames = walk(2)
    write_nerfstudio(tmp_path, frames)
    for file in (tmp_path / "images").iterdir():
        Image.open(file).resize((32, 24)).save(file)
    recording = data.open(tmp_path)
    assert torch.allclose(recording[0].camera.f, frames[0].camera.f / 2)
    assert recording.report == ("images of 32x24, transforms.json states K for 64x48: K is scaled",)
    for file in (tmp_path / "images").iterdir():
        Image.open(file).resize((32, 32)).save(file)
    with pytest.raises(FormatError, match="image size"):
        data.open(tmp_path)


@pytest.mark.parametrize("kind", ["npy", "tiff"])
def test_floating_depth_without_unit_is_in_metres(kind: str, tmp_path: Path) -> None:
    frames = walk(2)
    write_nerfstudio(tmp_path, frames, unit_key=None)
    for i, frame in enumerate(frames):
        values = frame.depth[0].numpy().copy()
        values[0, 0] = np.nan
        file = tmp_path / "depth" / f"frame_{i + 1:05d}.{kind}"
        np.save(file, values[..., None]) if kind == "npy" else Image.fromarray(values).save(file)
    edit_files(tmp_path, [in_turn(*({"depth_file_path": f"depth/frame_{i + 1:05d}.{kind}"} for i in range(2)))])
    recording = data.open(tmp_path)
    assert recording.depth_unit == DepthUnit(1.0)
    depth = recording[1].depth
    assert float(depth[0, 0, 0]) == 0 and torch.allclose(depth[0, 1:], frames[1].depth[0, 1:])


def test_codes_of_no_return_are_holes(tmp_path: Path) -> None:
    frames = walk(2)
    write_nerfstudio(tmp_path, frames)
    file = tmp_path / "depth" / "frame_00001.png"
    code = encode_depth_codes(frames[0].depth, 1000)
    code[:5] = 65535
    file.write_bytes(encode_unfiltered_png(code))
    depth = data.open(tmp_path)[0].depth
    assert not depth[0, :5].any() and depth[0, 5:].all()


@pytest.mark.parametrize("corrected", [True, False])
def test_polycam(corrected: bool, tmp_path: Path) -> None:
    frames = walk(3)
    write_polycam(tmp_path, frames, corrected=corrected)
    assert data.recognise(tmp_path)[0] == data.recognise(tmp_path / "keyframes")[0] == "polycam"
    recording = data.open(tmp_path)
    check_frames(recording, frames, 1e-3)
    assert recording.name == data.open(tmp_path / "keyframes").name == tmp_path.name
    assert recording.report == ()
    assert recording.depth_unit == DepthUnit(1e-3, "format definition: Polycam stores millimetres")
    assert recording.pose_axes == "gl" and (recording[0].conf == 2).all()
    levels = (torch.arange(frames[0].depth.numel()) % 3).to(torch.uint8).reshape(frames[0].depth.shape)
    write_polycam(tmp_path, [f.replace(conf=levels) for f in frames], corrected=corrected)
    assert torch.equal(data.open(tmp_path)[1].conf, levels)
    if corrected:
        captured = data.open(tmp_path, corrected=False)
        offset = captured[0].T_world_from_cam.t - frames[0].T_world_from_cam.t
        assert torch.allclose(offset, torch.ones(1, 3).double())


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
