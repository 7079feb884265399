"""Outputs that are incomplete, damaged, foreign or of an earlier run: what the next run of a command makes of them."""

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from pyarrow import parquet
from support import writers
from support.dataset_folders import read_files, read_rows
from support.known_episodes import CAMERAS, LENS, episodes, write_robot

from dhtorch.cli import run
from dhtorch.extract.enriched import MapRowDataset

FRONT, WRIST = (f"observation.images.{name}" for name in CAMERAS)
FEW = ["method=paper", "method.n=64", "method.hypotheses=10"]
ENRICH = [*FEW, "gap=0", "dense=false", "max_frames=2", "workers=0"]


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The known set, with a card and a report page that are not dhtorch's."""
    root = tmp_path_factory.mktemp("robot") / "set"
    write_robot(root)
    (root / "README.md").write_text("---\nlicense: mit\n---\n# Of the robot\n")
    (root / "meta" / "report.html").write_text("foreign")
    return root


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of one camera, time-stamped."""
    root = tmp_path_factory.mktemp("captures") / "room"
    writers.write_tum(root, episodes(0)[0][:2])
    return root


def enrich(source: Path, out: Path, *more: str) -> int:
    return run.main(["enrich", str(source), str(out), *ENRICH, *more])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if "depth unit assumed" not in line]
    assert len(lines) == 1, lines
    return lines[0]


# ------------------------------------------------------------------------------------------------- an enriched set again


@pytest.fixture(scope="module")
def once(robot: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The set with depth for its first camera, and the report of that run."""
    out = tmp_path_factory.mktemp("once") / "set"
    assert enrich(robot, out, "data=lerobot", f"data.camera={FRONT}", "dense={size: 64, planes: 8}") == 0
    return out


def test_an_enriched_set_that_is_enriched_again_has_its_own_records_and_can_be_resumed(
    robot: Path, once: Path, tmp_path: Path
) -> None:
    twice = tmp_path / "twice"
    words = ["data=lerobot", f"data.camera={WRIST}", "report=false"]
    assert enrich(once, twice, *words) == 0
    keys = [json.loads((root / "meta" / "dhtorch.json").read_text())["key"] for root in (once, twice)]
    assert keys[0] != keys[1]
    stated = [json.loads((root / "meta" / "intrinsics.json").read_text()) for root in (once, twice)]
    assert stated == [{WRIST: {"dist": pytest.approx(LENS)}}] * 2, "of a camera that is not enriched, too"
    summaries = []
    for root in (once, twice):
        table = next((root / "data").rglob("*.parquet"))
        summaries.append(json.loads(parquet.read_metadata(table).metadata[b"dhtorch.episode"]))
    assert [summary["key"] for summary in summaries] == keys
    assert [list(summary["cameras"]) for summary in summaries] == [["front"], ["wrist"]]
    assert not list((twice / "meta").glob("report.*")) and (once / "meta" / "report.json").is_file()
    assert (twice / "README.source.md").read_bytes() == (once / "README.md").read_bytes()
    assert "license: mit\n" in (twice / "README.md").read_text()
    before, after = read_rows(once), read_rows(twice)
    assert len(before) == len(after) == 4
    for row, same in zip(before, after, strict=True):
        assert {name: same[name] for name in row} == row, "what the first run wrote is there"
        assert f"{WRIST}_depth_enriched" in same
    whole = read_files(twice)
    (twice / "data" / "chunk-000" / "file-001.parquet").unlink()
    assert enrich(once, twice, *words) == 0
    assert read_files(twice) == whole, "resumed"


# ----------------------------------------------------------------------------------------------------------- long names


def test_a_camera_whose_video_would_have_too_long_a_name_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = "observation.images." + 231 * "c"
    source = tmp_path / "source"
    source.mkdir()
    writers.write_lerobot(source, [episodes(0)[0][:2]], camera=camera, depth="tiff", image="image")
    rows: list[int] = []
    real = MapRowDataset.features
    monkeypatch.setattr(MapRowDataset, "features", lambda self, opened, i: rows.append(i) or real(self, opened, i))
    more = ["columns=[depth,sigma,source,geometry_image]"]
    assert enrich(source, tmp_path / "out", *more) == run.EXIT_FAILED
    assert "File name too long (265 bytes, at most 255)" in one_line(capsys) and not rows
    assert not (tmp_path / "out").exists()
    assert enrich(source, tmp_path / "out", "report=false") == 0 and rows, "without the video it is no name of a file"


def test_a_capture_of_a_long_name_runs_as_any_other(capture: Path, tmp_path: Path) -> None:
    long = tmp_path / (250 * "n")
    shutil.copytree(capture, long)
    out = tmp_path / "out"
    words = ["data=auto", f"data.root={long}", "pairs.gap=1", "method=paper", "method.n=64", "figures=false"]
    assert run.main(["run", *words, f"output={out}"]) == 0
    assert json.loads((out / "result.json").read_text())["data"]["scenes"] == [250 * "n"]
