"""Captures without depth, and what phones export instead of frames: one sentence with what to export."""

import shutil
import sys

import numpy as np
import pytest
from PIL import Image

from dhtorch import data
from dhtorch import testing as writers
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
    with pytest.raises(ImportError, match=r"pip install 'dhtorch\[robot\]'"):
        decode.import_optional("no_such_library", extra="robot")


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
