"""Two cameras of a robot's set by name in one whole job: every result says which camera it is of, and nothing is mixed."""

import json

import pytest

pytest.importorskip("av")
pytest.importorskip("pyarrow")

from pyarrow import parquet
from support import writers

from dhtorch.cli.run import main
from dhtorch.data.rig import open_rig
from dhtorch.runtime import results as result_files
from dhtorch.synthetic.recording import SyntheticRoom

LEFT, FRONT = "observation.images.left", "observation.images.front"
N = 3
ASKED = ["method=paper", "method.n=64", "method.hypotheses=10"]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """A set whose cameras walk differently, each with depth of its own."""
    folder = tmp_path_factory.mktemp("robot")
    for key, seed in ((FRONT, 2), (LEFT, 5)):
        room = SyntheticRoom(hw=(48, 64), n_frames=N, lidar="exact", supersample=1, seed=seed)
        writers.write_lerobot(folder / key, [[room[i] for i in range(N)]], version=2, depth="png", camera=key)
    both = folder / FRONT
    tables = [next((folder / key / "data").rglob("*.parquet")) for key in (FRONT, LEFT)]
    table, other = map(parquet.read_table, tables)
    for name in other.column_names:
        if name.startswith(LEFT):
            table = table.append_column(name, other[name])
    parquet.write_table(table, tables[0])
    infos = [folder / key / "meta" / "info.json" for key in (FRONT, LEFT)]
    info, more = (json.loads(path.read_text()) for path in infos)
    info["features"] |= {k: v for k, v in more["features"].items() if k.startswith(LEFT)}
    infos[0].write_text(json.dumps(info))
    (film,) = (folder / LEFT / "videos").rglob("*.mp4")
    place = both / film.relative_to(folder / LEFT)
    place.parent.mkdir(parents=True)
    film.rename(place)
    return both


@pytest.mark.slow
def test_a_job_of_two_cameras_is_that_of_each_alone(robot, tmp_path):
    source = ["data=lerobot", f"data.root={robot}", "pairs.gap=2", "holdout=none", "figures=false", *ASKED]
    for name, said in (("both", f"[{LEFT},{FRONT}]"), ("left", LEFT), ("front", FRONT)):
        assert main([*source, f"data.camera={said}", f"output={tmp_path / name}"]) == 0
    both, *each = (result_files.read_result(tmp_path / name) for name in ("both", "left", "front"))
    assert [name.rpartition("/")[2] for name in both["data"]["scenes"]] == ["left", "front"]

    def of(result, camera):
        timeless = [{k: v for k, v in row.items() if "ms" not in k.split("_")} for row in result["rows"]]
        return [row for row in timeless if str(row["scene"]).endswith(camera)]

    for alone, camera in zip(each, ("left", "front"), strict=True):
        assert of(both, camera) == of(alone, camera) != []
    assert of(both, "left") != [{**row, "scene": row["scene"].replace("front", "left")} for row in of(both, "front")]


@pytest.mark.slow
def test_enriched_maps_stand_beside_their_own_camera(robot, tmp_path, capsys):
    asked = ["data=lerobot", *ASKED, "gap=2", "dense={size: 64, planes: 8}"]
    cells = {}
    for name, said in (("both", f"[{LEFT},{FRONT}]"), ("left", LEFT), ("front", FRONT)):
        assert main(["enrich", str(robot), str(tmp_path / name), f"data.camera={said}", *asked]) == 0, (
            capsys.readouterr()
        )
        (table,) = (tmp_path / name / "data").rglob("*.parquet")
        cells[name] = parquet.read_table(table).to_pydict()
    made = {camera: f"observation.images.{camera}_depth_enriched" for camera in ("left", "front")}
    for camera, column in made.items():
        assert cells["both"][column] == cells[camera][column] and len(cells["both"][column]) == N
        assert set(made.values()) & set(cells[camera]) == {column}, "of the camera that was named alone"
    assert cells["both"][made["left"]] != cells["both"][made["front"]]


@pytest.mark.slow
def test_features_of_two_cameras_are_refused_and_name_the_option(robot, tmp_path, capsys):
    words = ["extract", "data=lerobot", f"data.root={robot}", "data.gap=2", *ASKED, f"out={tmp_path / 'set'}"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "expected one camera of it (data.camera=KEY)" in said and "left" in said and "front" in said
    assert not list(tmp_path.rglob("*.parquet"))
    assert main([*words, f"data.camera={LEFT}"]) == 0


@pytest.mark.slow
def test_other_cameras_of_the_instant_are_the_views_of_pairs_cameras(robot, tmp_path):
    words = ["data=rig", f"data.root={robot}", "pairs=cameras", "holdout=none", "figures=false", *ASKED]
    assert main([*words, f"output={tmp_path / 'rig'}"]) == 0
    pairs = [tuple(row["pair"]) for row in result_files.read_result(tmp_path / "rig")["rows"] if row["pair"]]
    rig = open_rig(robot)[0].recording
    assert pairs and all(i // 2 == j // 2 and i % 2 != j % 2 for i, j in pairs), "another camera, the same instant"
    assert {i % 2 for i, _ in pairs} == {0, 1} and sorted(rig.cameras) == ["front", "left"]
