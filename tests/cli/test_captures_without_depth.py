"""Captures without depth, and what phones export instead of frames: one sentence with what to export."""

import shutil
import sys
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image
from support import writers
from support.box_scene import walk

from dhtorch import data
from dhtorch.data import FormatError
from dhtorch.data.io import decode
from dhtorch.synthetic.recording import SyntheticRoom


@pytest.fixture(scope="module")
def blind(tmp_path_factory):
    """A TUM sequence whose depth maps are all 0."""
    folder = tmp_path_factory.mktemp("captures") / "blind"
    room = SyntheticRoom(n_frames=4, hw=(48, 64), depth_hw=(48, 64), lidar=None)
    writers.write_tum(folder, [room[k] for k in range(4)])
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["PATH"],
        ["complete", "PATH", "--out", "o"],
        ["enrich", "PATH", "o"],
        ["integrate", "PATH"],
        ["stream", "PATH"],
        ["run", "PATH", "--cutoff", "2"],
    ],
)
def test_a_capture_without_depth_is_announced(command, blind, tmp_path, words):
    code, _, err = command(*(str(blind) if word == "PATH" else word for word in words), "--quiet")
    line = err.strip().splitlines()[-1]
    assert code == 2 and "blind: 4 frames, none of the 4 examined has depth; sensor depth" in line, err
    assert not (tmp_path / "o").exists()
    if words[0] == "enrich":
        assert line.endswith("without_depth=true writes empty maps")


def test_a_set_without_depth_is_written_on_request(command, blind, tmp_path):
    options = ["method=paper", "method.n=64", "dense=false", "report=false", "without_depth=true"]
    code, _, err = command("enrich", str(blind), "o", *options, "--quiet")
    assert code == 0, err
    assert (tmp_path / "o" / "meta" / "info.json").is_file()


def test_images_with_cameras_are_no_focal_stack(command, tmp_path):
    room = SyntheticRoom(n_frames=3, hw=(48, 64), depth_hw=(48, 64))
    writers.write_counted_frames(tmp_path / "posed", [room[k] for k in range(3)])
    shutil.rmtree(tmp_path / "posed" / "depth")
    code, _, err = command("posed")
    assert code == 2 and "3 pictures without depth" in err and "poses.txt" in err and "still camera" not in err
    with pytest.raises(FormatError, match=r"\(no depth\)"):
        data.open(tmp_path / "posed")
    code, _, err = command("stream", "posed")
    assert code == 2 and "3 pictures without depth" in err


#: Layout, files to remove, and what is printed by the command for a capture: its format, and what it lacks.
LACKING = [
    ("stray", "odometry.csv", "a Stray Scanner capture without odometry.csv, expected the whole folder"),
    ("stray", "camera_matrix.csv", "a Stray Scanner capture without camera_matrix.csv, expected the whole folder"),
    ("stray", "*.csv", "a Stray Scanner capture without odometry.csv, camera_matrix.csv, expected the whole folder"),
    ("stray", "depth/*", "a Stray Scanner capture without depth/, expected the whole folder"),
    ("stray", "rgb.mp4", "requires: a Stray Scanner capture without rgb.mp4, expected the whole folder of the capture"),
    (
        "record3d_exr",
        "EXR_RGBD/metadata.json",
        "EXR + RGB export of Record3D without metadata.json, expected the whole",
    ),
    ("record3d_exr", "EXR_RGBD/depth/*", "an EXR + RGB export of Record3D without depth/*.exr, expected the whole"),
    ("record3d_exr", "EXR_RGBD/rgb/*", "an EXR + RGB export of Record3D without rgb/*.jpg, expected the whole"),
    ("polycam", "keyframes/depth/*", "Polycam's raw data without depth/, expected all folders of keyframes/"),
    ("polycam", "keyframes/*cameras/*", "Polycam's raw data without cameras/*.json, expected all folders"),
    ("polycam", "keyframes/*images/*", "Polycam's raw data without images/, expected all folders"),
    ("tum", "depth/*", "a TUM RGB-D sequence without depth/, expected both folders"),
    ("tum", "rgb/*", "a TUM RGB-D sequence without rgb/, expected both folders"),
    ("scannet", "color/*", "a ScanNet export without color/, expected the folders of SensReader"),
    ("bop", "rgb/*", "a BOP scene without rgb/, expected the whole folder"),
    ("colmap", "images/*", "a COLMAP model without images/, expected its images"),
    (
        "named_frames",
        "*.color.png",
        "found none complete among 2, expected frame-XXXXXX.color.{jpg,png}, .depth.png and",
    ),
    ("named_frames", "*.depth.png", ".pose.txt; frame 0: no depth: left out"),
    ("arkitscenes", "41048190/lowres_depth/*", "an ARKitScenes capture without lowres_depth/, expected these assets"),
]


@pytest.mark.parametrize(("layout", "removed", "said"), LACKING)
def test_an_export_that_lacks_files_names_its_format_and_them(command, tmp_path, layout, removed, said):
    writers.CAPTURE_WRITERS[layout].write(tmp_path / "scan", walk(2, hw=(24, 32)))
    paths = list((tmp_path / "scan").glob(removed))
    assert paths
    for path in paths:
        path.unlink()
        if not any(path.parent.iterdir()):
            path.parent.rmdir()
    code, _, err = command("scan")
    assert code == 2 and said in err and len(err.strip().splitlines()) == 1, err
    assert "focal stack" not in err and "no known format" not in err
    code, out, err = command("inspect", "scan")
    assert "focal stack" not in out + err


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        ("rgbd/", "metadata: found none among 6 files, expected a whole export of Record3D: metadata with rgbd/"),
        ("metadata", "frames: found none, expected a whole export of Record3D: metadata with rgbd/"),
        ("metadata rgbd/0.jpg", "frames: found frame 0: no depth: left out, expected a whole export of Record3D"),
    ],
)
def test_an_r3d_file_that_lacks_files_names_them(command, tmp_path, kept, said):
    frames = [frame.replace(conf=torch.full(frame.depth.shape, 2, dtype=torch.uint8)) for frame in walk(2, hw=(24, 32))]
    writers.write_r3d(tmp_path / "whole.r3d", frames)
    with zipfile.ZipFile(tmp_path / "whole.r3d") as whole, zipfile.ZipFile(tmp_path / "scan.r3d", "w") as lacking:
        for name in whole.namelist():
            if name.startswith(tuple(kept.split())):
                lacking.writestr(name, whole.read(name))
    code, _, err = command("scan.r3d")
    assert code == 2 and said in err and "share it from the app again" in err


def test_a_capture_below_that_lacks_files_is_named_by_every_command(command, tmp_path):
    writers.write_stray(tmp_path / "above" / "scan", walk(2, hw=(24, 32)))
    (tmp_path / "above" / "scan" / "odometry.csv").unlink()
    for words in (["above"], ["inspect", "above"], ["stream", "above"], ["run", "above", "--cutoff", "2"]):
        code, _, err = command(*words)
        assert code == 2 and "scan: content: found a Stray Scanner capture without odometry.csv" in err, words


@pytest.mark.parametrize("name", ["scan.usdz", "scan.obj", "scan.mp4"])
def test_a_phone_s_model_or_video_names_what_to_export(command, tmp_path, name):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / name).write_bytes(b"x")
    for path in ("scans", f"scans/{name}"):
        code, _, err = command(path)
        assert code == 2 and len(err.strip().splitlines()) == 1
        for app in ("Record3D", "Stray Scanner", "Polycam's raw data", "Scaniverse"):
            assert app in err, err
        assert "rectified" not in err


def test_a_missing_decoder_names_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ImportError, match=r"needs OpenEXR, which is not installed: pip install OpenEXR$"):
        decode.import_optional("OpenEXR")
    with pytest.raises(ImportError, match=r"pip install 'dhtorch\[live\]'"):
        decode.import_optional("no_such_library", extra="live")


def test_pictures_alone_name_what_to_export(command, tmp_path):
    (tmp_path / "photos").mkdir()
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "photos" / "a.jpg")
    code, _, err = command("photos")
    assert code == 2 and "1 picture without depth" in err and "Record3D" in err


def test_a_capture_below_the_path_is_found_by_every_command(command, tmp_path):
    room = SyntheticRoom(n_frames=3, hw=(48, 64), depth_hw=(48, 64))
    writers.write_tum(tmp_path / "above" / "one", [room[k] for k in range(3)])
    code, out, err = command("stream", "above", "--max-frames", "1", "--method", "map", "--method.n", "64")
    assert code == 0 and out.startswith("one: 1 frame"), err
    writers.write_tum(tmp_path / "above" / "two", [room[k] for k in range(3)])
    code, _, err = command("stream", "above")
    assert code == 2 and "above: found 2 captures below, expected one of above/one, above/two" in err
