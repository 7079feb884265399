"""What the commands write is a capture again, with the same frames, K, poses, unit and times."""

import os
import shutil
from pathlib import Path

import pytest
import torch

pytest.importorskip("pyarrow")
pytest.importorskip("av")

from support import writers

from dhtorch import data
from dhtorch.cli.run import main
from dhtorch.data import depth_maps
from dhtorch.synthetic import SyntheticRoom

#: Many whole runs of commands: minutes. `pytest -m slow` runs them.
pytestmark = pytest.mark.slow

HW, NEAR = (48, 64), 2.5
FEW = ["method.n=64", "method.hypotheses=10"]
ENRICH = ["method=paper", *FEW, "gap=2", "dense={size: 64, planes: 8}"]
COMPLETE = [*FEW, "planes=8", "figures=false", "refinements=1"]
HOLO = Path(os.environ.get("DHTORCH_DATA", "/nowhere")) / "holo_a"
needs_data = pytest.mark.skipif(not HOLO.is_dir(), reason="DHTORCH_DATA has no holo_a")


@pytest.fixture(scope="module")
def shots():
    """Frames of the room whose clock is irregular and whose sensor sees no farther than NEAR."""
    room = SyntheticRoom(hw=HW, depth_hw=HW, n_frames=4, lidar="exact", supersample=1)
    stamps = [10.0, 10.04, 10.07, 10.125]
    frames = [room[i].replace(time=torch.tensor([t], dtype=torch.float64)) for i, t in enumerate(stamps)]
    return [frame.replace(depth=torch.where(frame.depth <= NEAR, frame.depth, 0.0)) for frame in frames]


@pytest.fixture(scope="module")
def captures(shots, tmp_path_factory):
    """Captures of the frames by layout; in ``nerfstudio`` every frame has its own focal length."""
    root = tmp_path_factory.mktemp("captures")
    writers.write_tum(root / "tum", shots)
    writers.write_stray(root / "stray", shots)
    zoomed = [f.replace(camera=f.camera.replace(f=f.camera.f + 0.1 * i)) for i, f in enumerate(shots)]
    writers.write_nerfstudio(root / "nerfstudio", zoomed)
    return {name: root / name for name in ("tum", "stray", "nerfstudio")} | {"holo": HOLO}


def same(a, b, atol=1e-9, rtol=0.0):
    torch.testing.assert_close(a, b, atol=atol, rtol=rtol)


def check_same(back, source, step):
    """Frames are those of the source, but for depth in steps and cameras in single precision; times to a microsecond."""
    assert len(back) == len(source)
    for frame, want in zip(back, source, strict=True):
        assert torch.equal(frame.image, want.image)
        same(frame.camera.f, want.camera.f, rtol=1e-6)
        same(frame.camera.c, want.camera.c, 1e-4)
        assert (frame.camera.distortion is None) == (want.camera.distortion is None)
        same(frame.T_world_from_cam.R, want.T_world_from_cam.R)
        same(frame.T_world_from_cam.t, want.T_world_from_cam.t)
        both = (frame.depth > 0) & (want.depth > 0)
        assert both.sum() > 20 and float((frame.depth - want.depth)[both].abs().max()) <= step / 2 + 1e-6
        assert (frame.time is None) == (want.time is None)
        if want.time is not None:
            same(frame.time, want.time, 1e-6)


#: Command, capture, options, positions of the frames, format of what is written, step of its depth in m: enrich writes
#: steps of 2⁻¹⁰ m in its shards, and then that of the format. The folder is called like a camera whose calibration is
#: published.
WRITTEN = [
    ("enrich", "tum", ["format=nerfstudio"], [0, 1, 2, 3], "nerfstudio", 1e-3 + 2.0**-10),
    ("enrich", "tum", ["format=lerobot"], [0, 1, 2, 3], "lerobot", 2.0**-10),
    ("enrich", "tum", ["format=v2.1"], [0, 1, 2, 3], "lerobot", 2.0**-10),
    ("enrich", "holo", ["format=nerfstudio", "gap=1", "dense=false", "max_frames=2"], [0, 1], "nerfstudio", 1e-3 + 2.0**-10),
    ("enrich", "holo", ["format=lerobot", "gap=1", "dense=false", "max_frames=2"], [0, 1], "lerobot", 2.0**-10),
    ("complete", "tum", ["format=frames"], [0, 1, 2, 3], "frames_dir", 1e-3),
    ("complete", "tum", ["format=frames", "unit=0.0005"], [0, 1, 2, 3], "frames_dir", 5e-4),
    ("complete", "tum", ["format=tum"], [0, 1, 2, 3], "tum", 2e-4),
    ("complete", "tum", ["format=tum", "unit=0.001"], [0, 1, 2, 3], "tum", 1e-3),
    ("complete", "nerfstudio", ["format=frames"], [0, 1, 2, 3], "frames_dir", 1e-3),
    ("complete", "holo", ["format=frames", "max_frames=2", "every=20"], [0, 20], "frames_dir", 1e-3),
    ("complete", "stray", ["format=stray"], [0, 1, 2, 3], "stray", 1e-3),
]  # fmt: skip


@pytest.mark.parametrize(
    ("command", "capture", "options", "frames", "format", "step"),
    [pytest.param(*row, marks=[needs_data] * (row[1] == "holo")) for row in WRITTEN],
)
def test_what_is_written_is_a_capture_again(command, capture, options, frames, format, step, captures, tmp_path):
    out = tmp_path / "freiburg1_done"
    words = [str(out), *ENRICH] if command == "enrich" else [f"out={out}", *COMPLETE]
    assert main([command, str(captures[capture]), *words, *options]) == 0
    source, back = data.open(captures[capture]), data.open(out)
    assert not back.depth_unit.is_assumed and back.format == format
    assert back.number.tolist() == source.number[frames].tolist()
    check_same(back, [source[k] for k in frames], step)
    if command == "complete":
        assert back.depth_unit.metres == pytest.approx(step)
        focal = [float(frame.camera.f[0, 0] - back[0].camera.f[0, 0]) for frame in back]
        assert focal == pytest.approx([0.1 * k * (capture == "nerfstudio") for k in range(len(frames))], abs=1e-3)
        return
    whole = data.open(out, recovered=True)
    for frame, want, full in zip(back, (source[k] for k in frames), whole, strict=True):
        assert torch.equal(frame.depth > 0, want.depth > 0) or capture == "holo", "the sensor's returns alone"
        assert torch.equal(full.depth[frame.depth > 0], frame.depth[frame.depth > 0])
    assert (
        any(bool((full.depth > frame.depth).any()) for full, frame in zip(whole, back, strict=True)) or len(back) == 2
    )
    assert any("dhtorch enrich recovered are left out (data.recovered=true" in line for line in back.report)
    assert not any("recovered" in line for line in whole.report)


@pytest.mark.parametrize("unit", [0.001, 0.0005])
def test_maps_alone_are_no_recording_but_depth_maps_of_one_with_their_unit(unit, captures, tmp_path):
    out = tmp_path / "out"
    assert main(["complete", str(captures["tum"]), f"out={out}", *COMPLETE, "format=png", f"unit={unit}"]) == 0
    source = data.open(captures["tum"])
    maps = depth_maps.open_depth_maps(out, source)
    assert maps.unit.metres == unit and not maps.unit.is_assumed
    want = source[1].depth
    assert float((maps[1] - want)[want > 0].abs().max()) <= unit / 2 + 1e-6


def test_colmap_model_of_integrate_beside_its_images(captures, tmp_path):
    words = ["method=map", "method.n=256", "dense=false", "voxel=0.06", "pairs=gap", "pairs.gap=2", "poses=device"]
    assert main(["integrate", str(captures["tum"]), f"output={tmp_path / 'map'}", *words]) == 0
    (model,) = (tmp_path / "map").rglob("colmap")
    with pytest.raises(data.FormatError, match=r"images: found none beside the model, expected images/, or"):
        data.open(model / "sparse" / "0")
    folder = tmp_path / "frames"
    assert main(["complete", str(captures["tum"]), f"out={folder}", *COMPLETE, "format=frames"]) == 0
    frames = data.open(folder)
    back = data.open(model, images=str(folder / "images"), depth=str(folder / "depth"))
    source = [frames[frames.number.tolist().index(int(n))] for n in back.number]
    assert back.format == "colmap" and back.report == () and len(back) >= 2
    check_same(back, source, 0.0)
    shutil.copytree(folder / "depth", model / "depth")
    beside = data.open(model)
    assert beside.format == "colmap" and torch.equal(beside[0].depth, back[0].depth)
