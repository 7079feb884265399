"""The demo page: an uploaded capture gives a picture and a page, a hostile archive and an unreadable capture one line."""

from __future__ import annotations

import importlib.util
import zipfile
from pathlib import Path

import pytest

from dhtorch import testing as writers
from dhtorch.synthetic.recording import SyntheticRoom

APP = Path(__file__).resolve().parents[2] / "integrations" / "space" / "app.py"


@pytest.fixture(scope="module")
def app():
    spec = importlib.util.spec_from_file_location("space_app", APP)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def zipped(folder, file):
    with zipfile.ZipFile(file, "w") as archive:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            archive.write(path, Path(folder.name) / path.relative_to(folder))
    return file


@pytest.mark.slow
def test_an_upload_gives_a_picture_and_a_page(app, tmp_path):
    room = SyntheticRoom(n_frames=4, hw=(60, 80), depth_hw=(60, 80))
    writers.write_tum(tmp_path / "room", [room[k] for k in range(4)])
    (tmp_path / "out").mkdir()
    picture, page, text = app.process(str(zipped(tmp_path / "room", tmp_path / "room.zip")), str(tmp_path / "out"))
    assert Path(picture).read_bytes()[:4] == b"\x89PNG" and Path(page).read_text().startswith("<!doctype html>")
    assert "4 frames" in text


@pytest.mark.slow
def test_bad_uploads_are_one_line(app, tmp_path):
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as archive:
        archive.writestr("../outside.txt", "x")
    with pytest.raises(ValueError, match="expected names inside the archive"):
        app.unpack(tmp_path / "bad.zip", tmp_path / "in")
    assert not (tmp_path / "outside.txt").exists()
    (tmp_path / "scan.r3d").write_bytes(b"nothing")
    (tmp_path / "out").mkdir()
    with pytest.raises(ValueError, match=r"^dhtorch: .*scan\.r3d"):
        app.process(str(tmp_path / "scan.r3d"), str(tmp_path / "out"))


def test_the_page_is_built(app):
    pytest.importorskip("gradio")
    assert app.build_page() is not None
