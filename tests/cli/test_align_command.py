"""``dhtorch align``: maps in other units written in metres, frames that are whole stay, limits decide the exit code."""

import json

import numpy as np
import pytest
from support import stored_outputs
from support.byte_damage import change_middle

from dhtorch import data
from dhtorch.cli import run
from dhtorch.data.depth_maps import open_depth_maps
from dhtorch.synthetic import SyntheticRoom

ROOM = ["data=synthetic", "data.hw=[96,128]", "data.depth_hw=[96,128]", "data.supersample=1", "data.n_frames=6"]
LITTLE = ["method.n=256", "cutoff=2.0", "max_frames=2", "every=3", "steps=[1,2]"]


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(n_frames=6, hw=(96, 128), depth_hw=(96, 128), supersample=1)


@pytest.fixture(scope="module")
def maps(tmp_path_factory, room):
    folder = tmp_path_factory.mktemp("maps")
    for k in range(len(room)):
        truth = room.truth(k)["depth"][0].numpy()
        np.savez(folder / f"net_{k:04d}.npz", disparity=np.where(truth > 0, 30 / np.maximum(truth, 0.1) + 2, 0))
    return folder


def test_maps_are_written_in_metres_and_stay(tmp_path, maps, room, capsys):
    out = tmp_path / "out"
    asked = ["align", *ROOM, *LITTLE, f"depth={maps}", f"out={out}", "kind=inverse", 'fail_on="no_answer>0.9"']
    assert run.main(asked) == run.EXIT_DONE
    printed = capsys.readouterr().out
    assert "2 maps" in printed
    stored_outputs.check("align", tmp_path, printed=printed.replace(str(maps), "MAPS"), folder=out)
    found = json.loads((out / "align.json").read_text())
    assert [row["frame"] for row in found["frames"]] == [0, 3]
    assert found["whole"]["limited"]["unaligned"] == 0
    for row in (frame["aligned"] for frame in found["frames"]):
        assert 0 <= row["probability"] <= row["likeliest_probability"] <= 1
        assert (row["probability"] == row["likeliest_probability"]) == (row["model"] == row["likeliest"])
    for frame in found["frames"]:
        z, row = room.truth(frame["frame"])["depth"], frame["aligned"]
        assert row["near"] / 256 == pytest.approx(float(((z > 0) & (z < 2)).double().mean()), abs=0.1)
        assert 0 <= row["far"] <= 256 - row["near"]
        assert frame["views"] == [frame["frame"] + k for k in (-2, -1, 1, 2) if 0 <= frame["frame"] + k < 6]
    again = data.open(out)
    truth = room.truth(3)["depth"]
    depth = again[1].depth
    known = (truth > 0) & (depth > 0)
    assert known.double().mean() > 0.9
    assert ((depth - truth).abs() / truth)[known].median() < 0.02
    assert (out / "align.html").read_text().count("data:image/png;base64,") == 2
    before = {p: p.stat().st_mtime_ns for p in (out / "depth").iterdir()}
    (out / "meta" / "000003.json").unlink()
    assert run.main(asked) == run.EXIT_DONE
    assert "1 left untouched" in capsys.readouterr().out
    after = {p: p.stat().st_mtime_ns for p in (out / "depth").iterdir()}
    assert before.keys() == after.keys()
    assert sum(before[p] != after[p] for p in before) == 1
    assert run.main([*asked, "kind=affine"]) == run.EXIT_FAILED, "other maps in the same folder"


def test_a_byte_of_a_map_or_its_unit_makes_another_run(tmp_path, room, capsys):
    """A change in the middle of a map of the same size and time is one of the data; so is another unit stated."""
    depth = np.zeros((6, 96, 128), np.float32)
    depth[0] = room.truth(0)["depth"][0].numpy()
    np.save(tmp_path / "maps.npy", depth)
    words = ["align", *ROOM, *LITTLE, f"depth={tmp_path}", f"out={tmp_path / 'out'}", "max_frames=1"]
    assert run.main(words) == run.EXIT_DONE
    change_middle(tmp_path / "maps.npy")
    assert run.main(words) == run.EXIT_FAILED and "files of another run (other data)" in capsys.readouterr().err
    change_middle(tmp_path / "maps.npy")
    assert run.main(words) == run.EXIT_DONE and "1 left untouched" in capsys.readouterr().out
    (tmp_path / "complete.json").write_text('{"unit_m": 0.5}')
    assert run.main(words) == run.EXIT_FAILED and "files of another run (other data)" in capsys.readouterr().err


@pytest.mark.slow
def test_a_z_buffer_is_named_and_gets_no_answer(tmp_path, room, capsys):
    for k in range(len(room)):
        np.save(tmp_path / f"{k:04d}.npy", 1 - 0.01 / room.truth(k)["depth"][0].numpy())
    words = [f"depth={tmp_path}", f"out={tmp_path / 'out'}", "max_frames=1", "cutoff=null"]
    assert run.main(["align", *ROOM, *LITTLE, *words]) == run.EXIT_DONE
    lines = capsys.readouterr().out.splitlines()
    assert "none of 1 map could be aligned" in lines[0] and "few" not in lines[0]
    assert "1 map: near returns show a z-buffer (non-linear depth)" in lines[1]
    assert any(line.startswith("  warning: maps: ") and "z-buffer" in line for line in lines)
    assert "  maps: depth unit assumed: 1 m" in lines
    report = json.loads((tmp_path / "out/align.json").read_text())
    assert report["frames"][0]["aligned"]["family"] == "z-buffer" and report["whole"]["families"] == {"z-buffer": 1}
    assert report["maps"]["depth_unit"] == "depth unit assumed: 1 m"


@pytest.mark.slow
def test_a_limit_decides_the_exit_code(tmp_path, room, capsys):
    for k in range(len(room)):
        np.save(tmp_path / f"{k:04d}.npy", 1.5 * room.truth(k)["depth"][0].numpy())
    words = [f"depth={tmp_path}", f"out={tmp_path / 'out'}", "max_frames=1", 'fail_on="scale>0.2,no_answer>0.99"']
    assert run.main(["align", *ROOM, *LITTLE, *words]) == run.EXIT_SOME_FAILED
    assert "exceeded: scale is 0.33" in capsys.readouterr().out
    assert "Exceeded" in (tmp_path / "out" / "align.html").read_text()


@pytest.mark.slow
def test_a_hole_in_a_file_is_no_value_of_any_kind_and_a_sensor_beside_itself_is_told(tmp_path, room, capsys):
    for k in range(2):
        depth = room[k].depth[0].numpy()
        np.save(tmp_path / f"{k:04d}.npy", np.where(np.arange(128) < 20, 0, depth))
    words = [f"depth={tmp_path}", "max_frames=1", "kind=affine"]
    assert run.main(["align", *ROOM, *LITTLE[:1], *words, f"out={tmp_path / 'out'}"]) == run.EXIT_DONE
    assert "from one sensor" in capsys.readouterr().out
    depth = data.open(tmp_path / "out")[0].depth
    assert (depth[..., :20] == 0).all()
    assert (depth[..., 20:] > 0).double().mean() > 0.5


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("kind=wrong", "kind"),
        ("fail_on='colour>1'", "fail_on"),
        ("depth=/nowhere", "no folder"),
        ("every=0", "every"),
        ("pictures=-1", "pictures"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(word, said, tmp_path, maps, capsys):
    words = [f"depth={maps}", f"out={tmp_path / 'out'}", word]
    assert run.main(["align", *ROOM, *LITTLE, *words]) == run.EXIT_FAILED
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_limits_of_a_metre_need_a_metre(tmp_path, maps, capsys):
    words = [f"depth={maps}", f"out={tmp_path / 'out'}", "kind=inverse", "fail_on='scale>0.1'"]
    assert run.main(["align", *ROOM, *LITTLE, *words]) == run.EXIT_FAILED
    assert "expected kind=metric" in capsys.readouterr().err


def test_an_archive_of_several_arrays_says_which_is_depth(tmp_path, room):
    truth = room.truth(0)["depth"][0].numpy()
    np.savez(tmp_path / "0.npz", depth=truth, normal=np.zeros((3, *truth.shape)))
    assert np.allclose(open_depth_maps(tmp_path, room)[0][0], truth)
