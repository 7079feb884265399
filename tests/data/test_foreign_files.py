"""Files and folders that no reader recognises: how each is described, and the remedy that is named."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from support import writers
from support.box_scene import walk

from dhtorch import data
from dhtorch.cli import inspect
from dhtorch.data import foreign_files
from dhtorch.data.foreign_files import describe_foreign_file
from dhtorch.data.io.decode import FormatError


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("a.svo", "ZED_SVO_Export a.svo FOLDER 4"),
        ("b.svo2", "ZED_SVO_Export b.svo2 FOLDER 4"),
        ("scene.sens", "python reader.py --filename scene.sens --output_path FOLDER --export_depth_images"),
        ("a.oni", "pyonitool.py --extractcolor"),
        ("a.klg", "klg2png a.klg"),
        ("a.tar.gz", "tar -xf a.tar.gz"),
        ("a.db3.zstd", "zstd -d a.db3.zstd"),
        ("a.json.gz", "gunzip a.json.gz"),
        ("A.ZIP", "unzip A.ZIP"),
        ("a.bag.active", "rosbag reindex a.bag.active"),
    ],
)
def test_the_command_that_converts_it_is_named(tmp_path: Path, name: str, command: str) -> None:
    (tmp_path / name).write_bytes(b"something")
    assert command in describe_foreign_file(tmp_path / name).command
    with pytest.raises(FormatError, match="format: found a") as caught:
        data.recognise(tmp_path / name)
    assert f"expected the files that this command writes: {command}" in str(caught.value)
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / name).rename(tmp_path / "deep" / "er" / name)
    with pytest.raises(FormatError, match=f"content: found deep/er/{name}: a") as caught:
        inspect.find_captures(tmp_path)
    assert command in str(caught.value)


def test_videos_and_unknown_files(tmp_path: Path) -> None:
    assert describe_foreign_file(tmp_path / "a.txt") is None
    assert describe_foreign_file(tmp_path / "a.mp4").what.startswith("a video without depth")
    (tmp_path / "a.mkv").write_bytes(b"no video at all")
    assert describe_foreign_file(tmp_path / "a.mkv").what == "a video that cannot be read (content: b'no video at ')"


def test_a_folder_of_arrays_alone_names_the_option_for_maps(tmp_path: Path) -> None:
    for name in ("00000.npy", "00001.npy", "README.md"):
        (tmp_path / name).write_bytes(b"something")
    said = rf"found arrays \(00000.npy, …\) and no images, .*dhtorch validate CAPTURE --depth {tmp_path}"
    for find in (data.recognise, inspect.find_captures):
        with pytest.raises(FormatError, match=said):
            find(tmp_path)
    (tmp_path / "00000.png").write_bytes(b"a picture")
    with pytest.raises(FormatError, match=r"found 00000\.npy, 00000\.png"):
        data.recognise(tmp_path)


@pytest.mark.parametrize(
    ("tracks", "what"),
    [
        ([], "a video without depth"),
        ([("COLOR", "mjpeg")], "a video without depth"),
        (
            [("COLOR", "mjpeg"), ("", "b16g")],
            "a video of the tracks COLOR, b16g, none of which is called DEPTH",
        ),
    ],
)
def test_a_matroska_file_without_a_depth_track_is_described_by_its_tracks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tracks: list[tuple[str, str]], what: str
) -> None:
    found = [SimpleNamespace(name=name, codec=codec) for name, codec in tracks]
    monkeypatch.setattr(foreign_files.video, "list_video_tracks", lambda _: found)
    assert describe_foreign_file(tmp_path / "a.mkv").what == f"{what}; {foreign_files.NEEDS_DEPTH}"


#: Files of a folder → description of it, the same from every command.
LAYOUTS = {
    "stray_depth": ("depth/000000.png confidence/000000.png rgb.mp4 odometry.csv", "Stray Scanner.* without camera_m"),
    "stray_tables": ("depth/000000.png confidence/000000.png imu.csv", "without rgb.mp4, odometry.csv, camera_matrix"),
    "stray_film": ("rgb.mp4 odometry.csv camera_matrix.csv", "a Stray Scanner capture without depth/,"),
    "r3d": ("rgbd/0.jpg rgbd/0.depth rgbd/0.conf icon", "an unpacked Record3D capture without metadata,"),
    "r3d_frames": ("metadata icon", r"unpacked Record3D capture without rgbd/\*\.jpg, rgbd/\*\.depth,"),
    "exr": ("EXR_RGBD/rgb/7.jpg EXR_RGBD/depth/7.exr", "EXR \\+ RGB export of Record3D without metadata.json,"),
    "exr_itself": ("rgb/0.jpg metadata.json", r"EXR \+ RGB export of Record3D without depth/\*\.exr,"),
    "polycam": ("keyframes/images/1.jpg keyframes/depth/1.png", r"Polycam's raw data without cameras/\*\.json,"),
    "scanner": ("info.json frame_00000.json frame_00000.jpg", r"3D Scanner App without depth_\*\.png,"),
    "scanner_whole": ("frame_0.json frame_0.jpg depth_0.png", "3D Scanner App, which no reader"),
    "arkitscenes": (
        "lowres_wide/1.png lowres_wide_intrinsics/1.pincam",
        "an ARKitScenes capture without lowres_depth/",
    ),
    "tum": ("rgb/1.5.png rgb.txt groundtruth.txt", "a TUM RGB-D sequence without depth/,"),
    "scannet": ("depth/0.png pose/0.txt intrinsic/intrinsic_depth.txt", "a ScanNet export without color/,"),
    "bop": ("depth/000000.png scene_camera.json", "a BOP scene without rgb/,"),
    "colmap": ("sparse/0/cameras.txt depth/1.png", "a COLMAP model without images/,"),
    "rtabmap": ("rgb/1.jpg calib/1.yaml poses.txt", "an RTAB-Map export without depth/,"),
    "airsim": ("airsim_rec.txt images/img_0_0_1.png images/img_0_2_1.pfm", "an AirSim recording, which no reader"),
    "vkitti2": ("extrinsic.txt intrinsic.txt frames/rgb/Camera_0/rgb_00000.jpg", "a scene of Virtual KITTI 2, which"),
    "mvsnet": ("cams/00000000_cam.txt blended_images/00000000.jpg", "an MVSNet or BlendedMVS scene, which"),
    "kitti": ("image/1.png velodyne_raw/1.png", "KITTI's depth completion selection, which"),
    "hypersim": ("_detail/metadata_scene.csv images/scene_cam_00_final_preview/1.jpg", "a Hypersim scene, which"),
    "agibot": ("observations/1/2/depth/1.png observations/1/2/videos/1.mp4", "AgiBot World data, which"),
    "isaac": ("rgb_0000.png distance_to_camera_0000.npy", "an Isaac Sim .* recording, which"),
    "tartanair": ("image_left/0_left.png depth_left/0_left_depth.npy", "a TartanAir trajectory, which"),
    "kubric": ("rgba_00000.png depth_00000.tiff metadata.json", "a Kubric sequence, which"),
    "moge": ("0/depth.exr 0/fov.json 0/mask.png", "maps of MoGe, which no reader supports"),
    "habitat": ("rgb/0.png depth/0.npy", "images beside depth maps of another type than PNG, which"),
}


def lay(folder: Path, names: str) -> None:
    for name in names.split():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"{}" if name.endswith(".json") else b"something")


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_folder_of_a_known_layout_is_named_with_what_it_lacks(tmp_path: Path, name: str) -> None:
    files, words = LAYOUTS[name]
    lay(tmp_path / "above" / name, files)
    for find, path in (
        (data.recognise, tmp_path / "above" / name),
        (inspect.find_captures, tmp_path / "above" / name),
        (inspect.find_captures, tmp_path / "above"),
    ):
        with pytest.raises(FormatError, match=f"/{name}: (format|content): found .*{words}.* expected "):
            find(path)


def test_the_parts_of_captures_are_those_that_their_readers_need(tmp_path: Path) -> None:
    """What a writer writes is no incomplete layout."""
    frames = walk(2, hw=(24, 32))
    for name, write in writers.CAPTURE_WRITERS.items():
        (tmp_path / name).mkdir()
        assert foreign_files.describe_layout(write(tmp_path / name, frames)) is None, name


def test_the_content_of_a_folder_is_counted_by_folder_and_ending(tmp_path: Path) -> None:
    assert foreign_files.describe_content(tmp_path) == "no files" and not foreign_files.may_hold_depth(tmp_path)
    lay(tmp_path, "K.txt poses.txt a/1.png a/2.png a/x.json b/c/d/7.jpg .hidden")
    assert foreign_files.describe_content(tmp_path) == "2 .txt, a/ (2 .png, x.json), b/c/d/ (7.jpg)"
    assert not foreign_files.may_hold_depth(tmp_path)
    lay(tmp_path, " ".join(f"z{k}/1.png" for k in range(9)))
    assert foreign_files.describe_content(tmp_path).endswith(", z2/ (1.png), …")
    (tmp_path / "b" / "c" / "d" / "7.pfm").write_bytes(b"something")
    assert foreign_files.may_hold_depth(tmp_path)
