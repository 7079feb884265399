"""Exports with a camera for every image (nerfstudio and its relatives, Polycam): written with known geometry, read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from support.box_scene import off_wall, walk, world_points
from support.writers import write_colmap_capture, write_counted_frames, write_nerfstudio, write_polycam
from support.writers.parts import encode_unfiltered_png

from dhtorch import data
from dhtorch.data.io.decode import FormatError
from dhtorch.data.units import DepthUnit
from dhtorch.export.arrays import encode_depth_codes
from dhtorch.records import Camera, Frame

RIGID = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 1.5], [0, 0, 0, 1]])  # as nerfstudio's of COLMAP


def edit(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = root / "transforms.json"
    about = json.loads(file.read_text())
    change(about)
    file.write_text(json.dumps(about))


def check_same(recording: data.Recording, frames: list[Frame], step: float = 1e-3) -> None:
    assert len(recording) == len(frames)
    for frame, want in zip(recording, frames, strict=True):
        assert torch.equal(frame.image, want.image)
        torch.testing.assert_close(frame.depth, want.depth, atol=step / 2 + 1e-6, rtol=0)
        torch.testing.assert_close(frame.camera.f, want.camera.f)
        torch.testing.assert_close(frame.camera.c, want.camera.c)
        torch.testing.assert_close(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-9, rtol=0)
        torch.testing.assert_close(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-9, rtol=0)
        torch.testing.assert_close(frame.time, want.time, atol=1e-6, rtol=0)
        assert float(off_wall(world_points(frame)).max()) < 2 * step


# ------------------------------------------------------------------------------------------------------ transforms.json


@pytest.mark.parametrize("shared_K", [False, True])
@pytest.mark.parametrize(("applied", "scale"), [(None, 1.0), (RIGID, 1.0), (RIGID, 0.25), (None, 3.0)])
def test_what_is_written_is_read(applied: np.ndarray | None, scale: float, shared_K: bool, tmp_path: Path) -> None:
    """Poses are those before the converter's transformation and scale, in metres."""
    frames = walk(4)
    write_nerfstudio(tmp_path, frames, applied=applied, scale=scale, shared_K=shared_K)
    assert data.recognise(tmp_path) == ("nerfstudio", "transforms.json")
    recording = data.open(tmp_path)
    check_same(recording, frames)
    assert recording.number.tolist() == [1, 2, 3, 4] and recording.pose_axes == "gl"
    assert recording.depth_unit == DepthUnit(1e-3, "transforms.json: depth_unit_scale_factor")
    remark = (f"poses are stored times {scale:g} (applied_scale): undone",)
    assert recording.report == (() if scale == 1 else remark)
    assert torch.equal(data.open(tmp_path / "transforms.json")[1].depth, recording[1].depth)


@pytest.mark.parametrize("names", [("integer_depth_scale", "depth_path"), ("depth_unit_scale_factor", "depth_path")])
def test_names_without_suffix_and_depth_of_any_step(names: tuple[str, str], tmp_path: Path) -> None:
    """NeRFCapture: ``images/0`` for ``images/0.png``, depth in steps of its range / 65535."""
    unit_key, depth_key = names
    frames, step = walk(3), 10 / 65535
    write_nerfstudio(tmp_path, frames, unit_key=unit_key, unit_m=step, depth_key=depth_key, suffix="", times=False)
    recording = data.open(tmp_path)
    assert recording.depth_unit == DepthUnit(step, f"transforms.json: {unit_key}") and recording.times is None
    torch.testing.assert_close(recording[2].depth, frames[2].depth, atol=step / 2 + 1e-6, rtol=0)


def test_a_unit_that_is_not_stated_is_assumed(tmp_path: Path) -> None:
    frames = walk(2)
    write_nerfstudio(tmp_path, frames, unit_key=None, unit_m=2e-4)
    recording = data.open(tmp_path)
    assert recording.depth_unit == DepthUnit(1e-3) and recording.depth_unit.is_assumed
    check_same(data.open(tmp_path, depth_unit=2e-4), frames, 2e-4)


def test_distortion_in_the_order_of_opencv(tmp_path: Path) -> None:
    lens = torch.tensor([[0.01, -0.02, 0.003, -0.004, 0.005]])
    frames = [f.replace(camera=Camera(f.camera.f, f.camera.c, lens)) for f in walk(2)]
    write_nerfstudio(tmp_path, frames)
    assert torch.allclose(data.open(tmp_path)[0].camera.distortion, lens)
    edit(tmp_path, lambda about: about["frames"][1].update(k4=0.1))
    with pytest.raises(FormatError, match=r"transforms.json: frames.1.k4: found 0.1, expected 0 .*undistort"):
        data.open(tmp_path)


@pytest.mark.parametrize(
    "change", [{"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "EQUIRECTANGULAR"}, {"is_fisheye": True}]
)
def test_other_lenses_are_refused_by_name(change: dict[str, Any], tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, walk(2))
    edit(tmp_path, lambda about: about.update(change))
    name = change.get("camera_model", "is_fisheye")
    with pytest.raises(FormatError, match=rf"camera_model: found {name}, expected OPENCV, .*undistort other lenses"):
        data.open(tmp_path)


def test_angles_in_place_of_focal_lengths(tmp_path: Path) -> None:
    """Instant-NGP: horizontal angle of view, principal point in the middle."""
    write_nerfstudio(tmp_path, walk(2))

    def change(about: dict[str, Any]) -> None:
        about["camera_angle_x"] = 2 * np.arctan(0.5)
        for entry in about["frames"]:
            for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
                del entry[name]

    edit(tmp_path, change)
    camera = data.open(tmp_path)[0].camera
    assert camera.f[0].tolist() == pytest.approx([64, 64]) and camera.c[0].tolist() == [31.5, 23.5]


def test_order_by_number_and_by_time(tmp_path: Path) -> None:
    frames = walk(4)
    write_nerfstudio(tmp_path, frames)
    edit(tmp_path, lambda about: about["frames"].reverse())
    check_same(data.open(tmp_path), frames)
    names = ["delta", "bravo", "alpha", "charlie"]  # no numbers: in the order of the stamps
    edit(tmp_path, lambda about: about["frames"].reverse())

    def rename(about: dict[str, Any]) -> None:
        for entry, name in zip(about["frames"], names, strict=True):
            (tmp_path / entry["file_path"]).rename(tmp_path / "images" / f"{name}.png")
            entry["file_path"] = f"images/{name}"

    edit(tmp_path, rename)
    check_same(data.open(tmp_path), frames)


def test_a_clock_that_contradicts_the_numbers_does_not_reorder(tmp_path: Path) -> None:
    frames = walk(3)
    write_nerfstudio(tmp_path, frames)
    edit(tmp_path, lambda about: [e.update(timestamp=-e["timestamp"]) for e in about["frames"]])
    recording = data.open(tmp_path)
    assert recording.times is None and torch.equal(recording[0].image, frames[0].image)
    assert recording.report == ("time stamps do not increase with the numbers of the images: there are no times",)
    edit(tmp_path, lambda about: [e.update(timestamp=1e9 * i) for i, e in enumerate(about["frames"])])
    assert "no seconds: there are no times" in data.open(tmp_path).report[0]


def test_incomplete_frames_are_named(tmp_path: Path) -> None:
    frames = walk(5)
    write_nerfstudio(tmp_path, frames)
    (tmp_path / "images" / "frame_00002.png").unlink()
    (tmp_path / "depth" / "frame_00003.png").unlink()
    edit(tmp_path, lambda about: about["frames"][3].update(transform_matrix=np.full((4, 4), np.nan).tolist()))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [1, 3, 5] and not recording[1].depth.any() and recording[2].depth.any()
    assert recording.report == (
        "image frame_00002.png: no such image: left out",
        "image frame_00004.png: no pose, or one that is not finite (tracking lost): left out",
        "image frame_00003.png: no depth map: its depth is empty",
    )


def test_images_without_depth_and_of_two_cameras(tmp_path: Path) -> None:
    frames = walk(4)
    write_nerfstudio(tmp_path, frames)

    def change(about: dict[str, Any]) -> None:
        (tmp_path / "images" / "left").mkdir()
        for entry in about["frames"]:
            del entry["depth_file_path"]
        for entry in about["frames"][:2]:
            name = Path(entry["file_path"]).name
            (tmp_path / "images" / name).rename(tmp_path / "images" / "left" / name)
            entry["file_path"] = f"images/left/{name}"

    edit(tmp_path, change)
    recordings = data.open_all(tmp_path)
    assert [r.name.removeprefix(tmp_path.name) for r in recordings] == ["/images/left", "/images"]
    assert [len(r) for r in recordings] == [2, 2] and all(r.depth_unit is None for r in recordings)
    assert recordings[0].report == (
        "depth/ is not read: transforms.json names no depth maps (depth_file_path of each frame)",
        "no depth maps: depth is empty",
    )
    assert not recordings[0][0].depth.any()


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


def test_smaller_depth_keeps_the_field_of_view(tmp_path: Path) -> None:
    camera = Camera(torch.tensor([[60.0, 60.0]]), torch.tensor([[31.5, 23.5]]))
    half = Camera(torch.tensor([[30.0, 30.0]]), torch.tensor([[15.5, 11.5]]))
    frames = [f.replace(depth=f.depth[:, ::2, ::2].contiguous(), depth_camera=half) for f in walk(2, camera)]
    write_nerfstudio(tmp_path, frames)
    frame = data.open(tmp_path)[0]
    assert frame.depth.shape == (1, 24, 32) and frame.depth_camera is None, "None: the image's camera, scaled"


@pytest.mark.parametrize("kind", ["npy", "tiff"])
def test_floating_depth_without_unit_is_in_metres(kind: str, tmp_path: Path) -> None:
    frames = walk(2)
    write_nerfstudio(tmp_path, frames, unit_key=None)
    for i, frame in enumerate(frames):
        values = frame.depth[0].numpy().copy()
        values[0, 0] = np.nan
        file = tmp_path / "depth" / f"frame_{i + 1:05d}.{kind}"
        np.save(file, values[..., None]) if kind == "npy" else Image.fromarray(values).save(file)
    edit(tmp_path, lambda about: [e.update(depth_file_path=e["depth_file_path"][:-3] + kind) for e in about["frames"]])
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file_path": "/etc/passwd"}, "found /etc/passwd, expected a file inside the capture"),
        ({"file_path": "../x.png"}, "expected a file inside the capture"),
        ({"depth_file_path": "..\\x.png"}, "expected a file inside the capture"),
        ({"file_path": 3}, "file_path: found 3, expected a text"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "found 2 rows, expected 3 or 4 rows"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "transforms.json"),
        ({"fl_x": 0}, r"frames.1.fl_x: found 0.0, expected a positive number"),
        ({"cx": "a"}, "frames.1.cx"),
    ],
)
def test_damage_names_the_field(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, walk(2))
    edit(tmp_path, lambda about: about["frames"][1].update(change))
    with pytest.raises(FormatError, match=message):
        _ = data.open(tmp_path)[1]


def test_damage_of_the_whole_file(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, walk(2))
    edit(tmp_path, lambda about: about.update(applied_transform=(2 * RIGID)[:3].tolist()))
    with pytest.raises(FormatError, match=r"applied_transform: .* expected a rotation"):
        data.open(tmp_path)
    for content in ("", "[]", "{}", '{"frames": 3}', '{"frames": [3]}', '{"frames": []}'):
        (tmp_path / "transforms.json").write_text(content)
        with pytest.raises(FormatError, match=r"transforms\.json"):
            data.open(tmp_path)


# -------------------------------------------------------------------------------------------------------------- Polycam


@pytest.mark.parametrize("corrected", [True, False])
def test_polycam(corrected: bool, tmp_path: Path) -> None:
    frames = walk(3)
    write_polycam(tmp_path, frames, corrected=corrected)
    assert data.recognise(tmp_path)[0] == data.recognise(tmp_path / "keyframes")[0] == "polycam"
    recording = data.open(tmp_path)
    check_same(recording, frames)
    assert recording.name == data.open(tmp_path / "keyframes").name == tmp_path.name
    assert recording.report == ()
    assert recording.depth_unit == DepthUnit(1e-3, "format definition: Polycam stores millimetres")
    assert recording.pose_axes == "gl" and (recording[0].conf == 2).all()
    if corrected:
        captured = data.open(tmp_path, corrected=False)
        offset = captured[0].T_world_from_cam.t - frames[0].T_world_from_cam.t
        assert torch.allclose(offset, torch.ones(1, 3).double())


def test_polycam_confidence_and_what_is_missing(tmp_path: Path) -> None:
    frames = walk(4)
    levels = (torch.arange(frames[0].depth.numel()) % 3).to(torch.uint8).reshape(frames[0].depth.shape)
    write_polycam(tmp_path, [f.replace(conf=levels) for f in frames], corrected=False)
    assert torch.equal(data.open(tmp_path)[1].conf, levels)
    stems = sorted(file.stem for file in (tmp_path / "keyframes" / "cameras").iterdir())
    (tmp_path / "keyframes" / "cameras" / f"{stems[1]}.json").unlink()
    (tmp_path / "keyframes" / "depth" / f"{stems[2]}.png").unlink()
    (tmp_path / "keyframes" / "confidence" / f"{stems[3]}.png").unlink()
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 2, 3] and recording[0].conf is None and not recording[1].depth.any()
    assert recording.report == (
        "frame 1: no file in cameras/: left out",
        f"image {stems[2]}.png: no depth map: its depth is empty",
    )
    image = next((tmp_path / "keyframes" / "images").glob(f"{stems[2]}.*"))
    image.unlink()
    assert f"frame {stems[2]}: no file in images/: left out" in data.open(tmp_path).report


def test_polycam_damage_names_the_file(tmp_path: Path) -> None:
    write_polycam(tmp_path, walk(2), corrected=False)
    file = sorted((tmp_path / "keyframes" / "cameras").iterdir())[1]
    for change, message in (({"fx": 0}, "fx: found 0.0"), ({"t_00": "a"}, "t_00"), ({"t_00": 7.0}, "determinant")):
        about = json.loads(file.read_text())
        file.write_text(json.dumps(about | change))
        with pytest.raises(FormatError, match=rf"\.json: .*{message}"):
            data.open(tmp_path)
        file.write_text(json.dumps(about))


# ---------------------------------------------------------------------------------------------------------- orientation


def test_images_with_an_orientation_tag_are_turned_to_their_camera(tmp_path: Path) -> None:
    """Stored landscape with EXIF 6; w, h, K and depth describe the upright image."""
    frames = walk(2, hw=(64, 48), camera=Camera(torch.tensor([[61.0, 61.0]]), torch.tensor([[22.5, 33.5]])))
    write_nerfstudio(tmp_path, frames)
    for file in (tmp_path / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.open(file).transpose(Image.Transpose.ROTATE_90).save(file, exif=exif)
    recording = data.open(tmp_path)
    check_same(recording, frames)
    assert any(line.startswith("orientation: EXIF orientation 6") for line in recording.report)


# --------------------------------------------------------------------------------------------------------------- COLMAP


@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap", "."])
def test_colmap(folder: str, tmp_path: Path) -> None:
    frames = walk(3)
    write_colmap_capture(tmp_path, frames, folder=folder, model="PINHOLE")
    assert data.recognise(tmp_path)[0] == "colmap"
    recording = data.open(tmp_path)
    check_same(recording, frames)
    assert recording.number.tolist() == [1, 2, 3] and recording.report == ()
    assert recording.depth_unit == DepthUnit(1e-3) and recording.pose_axes == "cv"


@pytest.mark.parametrize(("model", "n"), [("SIMPLE_RADIAL", 1), ("OPENCV", 4)])
def test_colmap_lenses(model: str, n: int, tmp_path: Path) -> None:
    lens = torch.tensor([[0.01, -0.02, 0.003, -0.004]])
    camera = Camera(torch.tensor([[61.0, 61.0]]), torch.tensor([[30.5, 22.5]]), lens)
    write_colmap_capture(tmp_path, walk(2, camera), model=model, is_metric=False)
    recording = data.open(tmp_path)
    want = torch.where(torch.arange(4) < n, lens, 0.0)
    assert torch.allclose(recording[0].camera.distortion, want) and torch.allclose(recording[0].camera.f, camera.f)
    assert recording.times is None
    assert recording.report == ("poses were estimated by COLMAP: their scale is not metric unless it was aligned",)


def test_colmap_without_what_it_needs(tmp_path: Path) -> None:
    write_colmap_capture(tmp_path, walk(2))
    sparse = tmp_path / "sparse" / "0"
    with pytest.raises(FormatError, match="images: found none beside the model"):
        data.open(sparse)
    assert data.open(sparse, images="../../images", depth="../../depth")[0].depth.any()
    with pytest.raises(FormatError, match="images: found no folder pictures"):
        data.open(tmp_path, images="pictures")
    text = (sparse / "cameras.txt").read_text()
    (sparse / "cameras.txt").write_text(text.replace("OPENCV", "OPENCV_FISHEYE"))
    with pytest.raises(FormatError, match=r"model: found OPENCV_FISHEYE, expected .*undistort the images first"):
        data.open(tmp_path)
    (sparse / "cameras.txt").write_text(text.replace("\n2 OPENCV", "\n9 OPENCV"))
    with pytest.raises(FormatError, match="camera of image 2: found 2, expected a camera"):
        data.open(tmp_path)
    (sparse / "cameras.txt").unlink()
    with pytest.raises(FormatError, match="colmap model_converter"):
        data.open(tmp_path, "colmap")


def test_poses_of_numbered_frames_win_over_an_estimate(tmp_path: Path) -> None:
    """A folder whose sensor has poses of its own beside a model of COLMAP."""
    frames = walk(2)
    write_counted_frames(tmp_path, frames)
    write_colmap_capture(tmp_path / "other", frames)
    (tmp_path / "other" / "sparse").rename(tmp_path / "sparse")
    assert data.recognise(tmp_path)[0] == "frames_dir"
