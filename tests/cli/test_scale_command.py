"""``dhtorch scale``: the model in metres beside the original, and a bent one refused with exit code 1."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support import stored_outputs
from support.writers.layouts import write_counted_frames

from dhtorch.cli import run
from dhtorch.measure import read_model
from tests.support import room_models as made
from tests.support.byte_damage import change_middle, overwrite


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "room"
    write_counted_frames(folder, made.room_scene().frames)
    return folder


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "sparse"
    content, true = made.room_model("points")
    made.write_colmap_text(folder, content)
    made.write_pictures(tmp_path / "images")
    return folder, true


def test_a_model_is_written_in_metres(capture, model, capsys):
    folder, true = model
    assert run.main(["scale", str(folder), str(capture), "--cutoff", "2.5"]) == 0
    out = folder.with_name("sparse_metres")
    report = json.loads((out / "scale.json").read_text())
    assert not report["refused"] and abs(report["scale"] / true - 1) < 0.01
    assert report["U"]["low"] < true < report["U"]["high"] and len(report["frames"]) == 12
    before, after = read_model(folder), read_model(out)
    np.testing.assert_allclose(after.xyz, report["scale"] * before.xyz, rtol=1e-6)
    printed = capsys.readouterr().out
    assert "1 unit = " in printed
    stored_outputs.check("scale", folder.parent, printed=printed.replace(str(capture), "CAPTURE"), folder=out)
    assert (out / "scale.html").read_text().count("data:image/png;base64,") == 3


def test_a_model_whose_path_is_too_long_is_refused_with_where_and_how_much(capture, tmp_path, capsys):
    content, _ = made.room_model("points")
    c2w = np.stack([view.c2w for view in content.views])
    c2w[:, :3, 3] += 0.1 * (c2w[:, :3, 3] - c2w[:, :3, 3].mean(0))
    views = [replace(view, c2w=pose) for view, pose in zip(content.views, c2w, strict=True)]
    made.write_colmap_text(tmp_path / "sparse", replace(content, views=views))
    made.write_pictures(tmp_path / "images")
    assert run.main(["scale", str(tmp_path / "sparse"), str(capture), "--cutoff", "2.5"]) == run.EXIT_SOME_FAILED
    report = json.loads((tmp_path / "sparse_metres" / "scale.json").read_text())
    (fault,) = [fault for fault in report["faults"] if fault["kind"] == "path"]
    assert fault["change"] == pytest.approx(0.1, abs=2.5 * fault["sigma"])
    assert report["path"]["by"] and report["path"]["scale"] < report["scale"]
    assert "camera path against depths, by " in capsys.readouterr().out


@pytest.mark.slow
def test_the_folder_of_another_model_gets_this_ones_cameras_and_a_foreign_file_stays(capture, model, capsys):
    folder, out = model[0], model[0].with_name("out")
    words = ["scale", str(folder), str(capture), "--cutoff", "2.5", "--max-frames", "3", "--out", str(out)]
    assert run.main(words) == 0
    lines = (folder / "cameras.txt").read_text().splitlines()
    overwrite(folder / "cameras.txt", "\n".join([lines[0], *(x[:-1] + "1" for x in lines[1:]), ""]).encode())
    assert (out / "cameras.txt").read_bytes() != (folder / "cameras.txt").read_bytes()
    assert run.main(words) == 0
    assert (out / "cameras.txt").read_bytes() == (folder / "cameras.txt").read_bytes()
    change_middle(out / "cameras.txt")
    foreign = (out / "cameras.txt").read_bytes()
    capsys.readouterr()
    assert run.main(words) == run.EXIT_FAILED
    assert "cameras.txt, a file that was changed since dhtorch wrote it, expected none" in capsys.readouterr().err
    assert (out / "cameras.txt").read_bytes() == foreign


@pytest.mark.slow
def test_the_model_is_moved_into_the_world_of_the_capture(capture, model, tmp_path):
    words = ["--cutoff", "2.5", "--frame", "capture", "--out", str(tmp_path / "out")]
    assert run.main(["scale", str(model[0]), str(capture), *words]) == 0
    poses = made.room_scene().poses
    found = np.stack([view.c2w for view in read_model(tmp_path / "out").views])
    np.testing.assert_allclose(found[:, :3, 3], poses[:, :3, 3], atol=0.05)


@pytest.mark.slow
def test_a_drifting_model_is_refused(capture, tmp_path, capsys):
    content, _ = made.room_model("maps", "drift", 0.08)
    made.write_arrays(tmp_path / "model", content)
    made.write_pictures(tmp_path / "model" / "images")
    assert run.main(["scale", str(tmp_path / "model"), str(capture), "--cutoff", "2.5"]) == run.EXIT_SOME_FAILED
    out = tmp_path / "model_metres"
    assert not (out / "predictions.npz").exists() and json.loads((out / "scale.json").read_text())["refused"]
    printed = capsys.readouterr().out
    assert "refused" in printed and "from 000000.png to 000011.png" in printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--sensor", "sonar"], "sensor: found 'sonar', expected one of iphone_lidar"),
        (["--frame", "sky"], "frame: found 'sky'"),
        (["--out", "."], "out: found the model's own folder"),
        (["--tolerance", "-1"], "tolerance: found -1"),
    ],
)
def test_bad_options_are_one_line(capture, model, monkeypatch, capsys, words, message):
    monkeypatch.chdir(model[0])
    assert run.main(["scale", str(model[0]), str(capture), "--max-frames", "3", *words]) == run.EXIT_FAILED
    (line,) = [x for x in capsys.readouterr().err.strip().splitlines() if "assumed" not in x]
    assert message in line
