"""What the commands write is a capture again, with the same frames, K, poses, unit and times."""

from __future__ import annotations

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
from dhtorch.data.recording import Recording
from dhtorch.records import Frame
from dhtorch.synthetic import SyntheticRoom

#: Many whole runs of commands: minutes. `pytest -m slow` runs them.
pytestmark = pytest.mark.slow

HW, NEAR = (48, 64), 2.5
SMALL = ["method=paper", "method.n=64", "method.hypotheses=10", "dense={size: 64, planes: 8}"]
HOLO = Path(os.environ.get("DHTORCH_DATA", "/nowhere")) / "holo_a"
needs_data = pytest.mark.skipif(not HOLO.is_dir(), reason="DHTORCH_DATA has no holo_a")

#: Step of depth in m of what enrich writes: 2⁻¹⁰ m in its shards, and then that of the format.
STEPS = {"nerfstudio": 1e-3 + 2.0**-10, "lerobot": 2.0**-10, "v2.1": 2.0**-10}


@pytest.fixture(scope="module")
def shots() -> list[Frame]:
    """Frames of the room whose clock is irregular and whose sensor sees no farther than NEAR."""
    room = SyntheticRoom(hw=HW, depth_hw=HW, n_frames=4, lidar="exact", supersample=1)
    stamps = [10.0, 10.04, 10.07, 10.125]
    frames = [room[i].replace(time=torch.tensor([t], dtype=torch.float64)) for i, t in enumerate(stamps)]
    return [frame.replace(depth=torch.where(frame.depth <= NEAR, frame.depth, 0.0)) for frame in frames]


@pytest.fixture(scope="module")
def tum(tmp_path_factory: pytest.TempPathFactory, shots: list[Frame]) -> Path:
    root = tmp_path_factory.mktemp("tum") / "room"
    writers.write_tum(root, shots)
    return root


def check_same(back: Recording, source: Recording, step: float, *, tolerance_s: float = 1e-9) -> None:
    assert len(back) == len(source)
    assert back.depth_unit is not None and not back.depth_unit.is_assumed
    for frame, want in zip(back, source, strict=True):
        assert torch.equal(frame.image, want.image)
        torch.testing.assert_close(frame.camera.f, want.camera.f, rtol=1e-6, atol=0)
        torch.testing.assert_close(frame.camera.c, want.camera.c, rtol=0, atol=1e-4)
        assert (frame.camera.distortion is None) == (want.camera.distortion is None)
        torch.testing.assert_close(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-9, rtol=0)
        torch.testing.assert_close(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-9, rtol=0)
        has_return = want.depth > 0
        assert has_return.any() and float((frame.depth - want.depth)[has_return].abs().max()) <= step / 2 + 1e-6
        assert (frame.time is None) == (want.time is None)
        if want.time is not None:
            torch.testing.assert_close(frame.time, want.time, atol=tolerance_s, rtol=0)


# --------------------------------------------------------------------------------------------------------------- enrich


@pytest.mark.parametrize("format", ["nerfstudio", "lerobot", "v2.1"])
def test_enrich(format: str, tum: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["enrich", str(tum), str(out), *SMALL, "gap=2", f"format={format}"]) == 0
    source, back = data.open(tum), data.open(out)
    assert back.format == ("nerfstudio" if format == "nerfstudio" else "lerobot")
    assert torch.equal(back.number, source.number)
    check_same(back, source, STEPS[format])
    whole = data.open(out, recovered=True)
    for frame, want, full in zip(back, source, whole, strict=True):
        assert torch.equal(frame.depth > 0, want.depth > 0), "the sensor's returns alone"
        assert torch.equal(full.depth[frame.depth > 0], frame.depth[frame.depth > 0])
    assert any(bool((full.depth > frame.depth).any()) for full, frame in zip(whole, back, strict=True))
    assert back.report == ("depths that dhtorch enrich recovered are left out (data.recovered=true reads them)",)
    assert whole.report == ()


@needs_data
@pytest.mark.parametrize("format", ["nerfstudio", "lerobot"])
def test_enrich_of_a_real_capture(format: str, tmp_path: Path) -> None:
    out, options = tmp_path / "out", ["method=paper", "method.n=64", "method.hypotheses=10", "dense=false"]
    assert main(["enrich", str(HOLO), str(out), *options, "gap=1", "max_frames=2", f"format={format}"]) == 0
    source, back = data.open(HOLO), data.open(out)
    assert torch.equal(back.number, source.number[:2]) and (source.times is None) == (back.times is None)
    for i in range(2):
        frame, want = back[i], source[i]
        assert torch.equal(frame.image, want.image)
        assert torch.allclose(frame.camera.f, want.camera.f) and torch.allclose(frame.camera.c, want.camera.c)
        assert torch.allclose(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-9)
        assert torch.allclose(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-9)
        both = (frame.depth > 0) & (want.depth > 0)
        assert both.sum() > 20 and float((frame.depth - want.depth)[both].abs().max()) <= STEPS[format] / 2 + 1e-6


# ------------------------------------------------------------------------------------------------------------- complete


def completed(source: Path, out: Path, *options: str) -> Recording:
    few = ["method.n=64", "method.hypotheses=10", "planes=8", "figures=false", "refinements=1"]
    assert main(["complete", str(source), f"out={out}", *few, *options]) == 0
    return data.open(out)


@pytest.mark.parametrize(("format", "unit"), [("frames", None), ("frames", 0.0005), ("tum", None), ("tum", 0.001)])
def test_complete(format: str, unit: float | None, tum: Path, tmp_path: Path) -> None:
    """In a folder that is called like a camera whose calibration is published."""
    options = [f"format={format}"] + ([] if unit is None else [f"unit={unit}"])
    source, back = data.open(tum), completed(tum, tmp_path / "freiburg1_done", *options)
    assert back.format == {"frames": "frames_dir", "tum": "tum"}[format]
    step = unit or {"frames": 1e-3, "tum": 2e-4}[format]
    assert back.depth_unit is not None and back.depth_unit.metres == pytest.approx(step)
    check_same(back, source, step, tolerance_s=1e-6)


def test_complete_keeps_the_intrinsics_of_every_frame(shots: list[Frame], tmp_path: Path) -> None:
    frames = [f.replace(camera=f.camera.replace(f=f.camera.f + 0.1 * i)) for i, f in enumerate(shots)]
    writers.write_nerfstudio(tmp_path / "source", frames)
    back = completed(tmp_path / "source", tmp_path / "out", "format=frames")
    assert [round(float(frame.camera.f[0, 0] - back[0].camera.f[0, 0]), 3) for frame in back] == [0, 0.1, 0.2, 0.3]
    check_same(back, data.open(tmp_path / "source"), 1e-3)


@needs_data
def test_complete_of_a_real_capture(tmp_path: Path) -> None:
    source, back = data.open(HOLO), completed(HOLO, tmp_path / "out", "max_frames=2", "every=20", "format=frames")
    assert back.number.tolist() == source.number[[0, 20]].tolist() and back.depth_unit is not None
    for frame, want in zip(back, (source[0], source[20]), strict=True):
        assert torch.equal(frame.image, want.image)
        assert torch.allclose(frame.camera.f, want.camera.f) and torch.allclose(frame.camera.c, want.camera.c)
        assert torch.allclose(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-9)
        assert float((frame.depth - want.depth)[want.depth > 0].abs().max()) <= 1e-3 / 2 + 1e-6


def test_complete_of_stray(shots: list[Frame], tmp_path: Path) -> None:
    writers.write_stray(tmp_path / "source", shots)
    source, back = data.open(tmp_path / "source"), completed(tmp_path / "source", tmp_path / "out", "format=stray")
    assert back.format == "stray" and torch.equal(back.number, source.number)
    check_same(back, source, 1e-3)


@pytest.mark.parametrize("unit", [0.001, 0.0005])
def test_complete_of_maps_alone(unit: float, tum: Path, tmp_path: Path) -> None:
    """They are no recording, but depth maps of one, whose unit they state."""
    out = tmp_path / "out"
    few = ["method.n=64", "method.hypotheses=10", "planes=8", "figures=false", "refinements=1"]
    assert main(["complete", str(tum), f"out={out}", *few, "format=png", f"unit={unit}"]) == 0
    source = data.open(tum)
    maps = depth_maps.open_depth_maps(out, source)
    assert maps.unit.metres == unit and not maps.unit.is_assumed
    depth_map, want = maps[1], source[1].depth
    assert depth_map is not None and float((depth_map - want)[want > 0].abs().max()) <= unit / 2 + 1e-6


# ------------------------------------------------------------------------------------------------------------ integrate


def test_colmap_model_of_integrate_beside_its_images(tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    options = ["method=map", "method.n=256", "dense=false", "voxel=0.06", "pairs=gap", "pairs.gap=2", "poses=device"]
    assert main(["integrate", f"data.root={tum}", "data=auto", f"output={tmp_path / 'map'}", *options]) == 0
    (model,) = (tmp_path / "map").rglob("colmap")
    with pytest.raises(data.FormatError, match=r"images: found none beside the model, expected images/, or"):
        data.open(model / "sparse" / "0")
    frames = completed(tum, tmp_path / "frames", "format=frames")
    back = data.open(model, images=str(tmp_path / "frames" / "images"), depth=str(tmp_path / "frames" / "depth"))
    source = [frames[frames.number.tolist().index(int(n))] for n in back.number]
    assert back.format == "colmap" and back.report == () and len(back) >= 2
    for frame, want in zip(back, source, strict=True):
        assert torch.equal(frame.image, want.image) and torch.equal(frame.depth, want.depth)
        assert torch.allclose(frame.camera.f, want.camera.f) and torch.allclose(frame.camera.c, want.camera.c)
        assert torch.allclose(frame.T_world_from_cam.t, want.T_world_from_cam.t, atol=1e-8)
        assert torch.allclose(frame.T_world_from_cam.R, want.T_world_from_cam.R, atol=1e-8)
        assert float((frame.time - want.time).abs()) < 1e-9
    shutil.copytree(tmp_path / "frames" / "depth", model / "depth")
    beside = data.open(model)
    assert beside.format == "colmap" and torch.equal(beside[0].depth, back[0].depth)
