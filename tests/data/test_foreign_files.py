"""Files that no reader supports: what is said of them, and the command that converts them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

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
    assert describe_foreign_file(tmp_path / "a.mkv").what == "a video that cannot be read (content: no EBML header)"


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
        ([("COLOR", "V_MJPEG")], "a video without depth"),
        (
            [("COLOR", "V_MJPEG"), ("", "V_MS/VFW")],
            "a video of the tracks COLOR, V_MS/VFW, none of which is called DEPTH",
        ),
    ],
)
def test_a_matroska_file_without_a_depth_track_is_described_by_its_tracks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tracks: list[tuple[str, str]], what: str
) -> None:
    found = [SimpleNamespace(name=name, codec=codec) for name, codec in tracks]
    monkeypatch.setattr(foreign_files.matroska, "list_video_tracks", lambda _: found)
    assert describe_foreign_file(tmp_path / "a.mkv").what == f"{what}; {foreign_files.NEEDS_DEPTH}"
