"""The demo page: an uploaded capture gives a picture and a page, a hostile archive and an unreadable capture one line."""

import importlib.util
import io
import tempfile
import zipfile
from pathlib import Path

import pytest
from support import writers

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


def archive_with(method, *, flags=0, cut=None, body=bytes(range(256)) * 9):
    """Bytes of an archive of one file, with other flags or its content damaged at ``cut``."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        archive.writestr("room/rgb.txt", body)
    raw = bytearray(out.getvalue())
    directory = raw.index(b"PK\x01\x02")
    for at in (6, directory + 8):
        raw[at] |= flags
    if cut is not None:
        raw[cut : cut + 40] = b"\xff" * 40
    return raw


DEFLATED = archive_with(zipfile.ZIP_DEFLATED)
UNKNOWN = DEFLATED.replace(b"\x08\x00", b"\x62\x00")  # compression method 98


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"nothing", "File is not a zip file"),
        (b"", "File is not a zip file"),
        (DEFLATED[:-30], "File is not a zip file"),
        (archive_with(zipfile.ZIP_DEFLATED, flags=1), "encrypted"),
        (UNKNOWN, "compression"),
        *((archive_with(method, cut=60), "") for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2)),
        (archive_with(zipfile.ZIP_STORED, cut=60), "Bad CRC-32"),
    ],
    ids=["no zip", "empty", "cut", "encrypted", "unknown method", "deflate", "lzma", "bzip2", "crc"],
)
def test_a_damaged_or_encrypted_archive_is_one_sentence(app, tmp_path, content, found):
    (tmp_path / "scan.zip").write_bytes(content)
    with pytest.raises(
        ValueError, match=f"^scan.zip: found .*{found}.*, expected a whole zip archive without a password"
    ):
        app.unpack(tmp_path / "scan.zip", tmp_path / "in")


def test_the_files_of_an_answer_are_removed_when_the_page_has_them_and_after_an_error(app, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ValueError, match="scan"):
        next(app.answer("scan.zip"))
    assert not list(tmp_path.iterdir())

    def process(upload, place):
        (page := Path(place) / "view.html").write_text(upload)
        return str(page), str(page), ""

    monkeypatch.setattr(app, "process", process)
    answers = app.answer("scan.r3d")
    page, *_ = next(answers)
    assert Path(page).read_text() == "scan.r3d" and next(answers, None) is None
    assert not list(tmp_path.iterdir())
