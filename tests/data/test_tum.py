"""TUM RGB-D: sequences written in its layout, with the traps of its clocks and of its trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import CAMERA, HW, check_same, pose, walk
from support.writers import parts

from dhtorch import data
from dhtorch.data.readers import tum
from dhtorch.data.units import DepthUnit
from dhtorch.export import arrays
from dhtorch.geometry import se3
from dhtorch.records import Frame


def test_tum_gives_back_the_scene(tmp_path: Path) -> None:
    lens = torch.tensor([tum._CAMERA_CALIBRATIONS[1][1]])
    frames = walk(3, CAMERA.replace(distortion=lens))
    writers.write_tum(tmp_path, frames)
    recording = data.open(tmp_path)
    assert recording.format == "tum" and recording.report == ()
    assert torch.equal(recording[0].camera.distortion, lens)
    torch.testing.assert_close(recording.times, torch.cat([f.time for f in frames]), atol=1e-6, rtol=0)
    check_same(recording, frames, 1 / 5000)


def test_a_validation_twin_has_no_poses_and_other_files_are_passed_over(tmp_path: Path) -> None:
    root = tmp_path / "rgbd_dataset_freiburg3_walking_xyz_validation"
    writers.write_tum(root, blank(2), camera=3)
    (root / "groundtruth.txt").unlink()
    (root / "accelerometer.txt").write_text("# timestamp ax ay az\n100.0 0.1 9.8\nnot a number\n")
    recording = data.open(root)
    assert len(recording) == 2 and recording.poses is None and recording.report == ()
    assert float(recording[0].camera.f[0, 0]) == pytest.approx(535.4)


def test_the_largest_code_is_no_depth(tmp_path: Path) -> None:
    writers.write_tum(tmp_path, walk(1))
    codes = np.tile(np.array([0, 1, 5000, 65535], np.uint16), (HW[0], HW[1] // 4))
    next((tmp_path / "depth").iterdir()).write_bytes(parts.encode_unfiltered_png(codes))
    depth = data.open(tmp_path)[0].depth[0]
    assert depth[0, :4].tolist() == pytest.approx([0, 0.0002, 1, 0])
    assert data.open(tmp_path, units_per_metre=5208)[0].depth[0, 0, 2] == pytest.approx(5000 / 5208)
    (tmp_path / "meta.json").write_text('{"depth_scale": 4000}')
    unit = tum._find_unit(tmp_path, None, tum._CameraSource(CAMERA))
    assert unit == DepthUnit(1 / 4000, "meta.json: depth_scale")


def blank(n: int) -> list[Frame]:
    """Frames of the size that the published TUM calibration belongs to, with nothing to see."""
    image, depth = torch.zeros(1, 3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640)
    stamps = [torch.tensor([100 + i / 30], dtype=torch.float64) for i in range(n)]
    return [Frame(image, depth, CAMERA, time=t, T_world_from_cam=pose(i)) for i, t in enumerate(stamps)]


@pytest.mark.parametrize(
    ("number", "fx", "k1"), [(1, 517.306408, 0.262383), (2, 520.908620, 0.231222), (3, 535.4, None)]
)
def test_tum_takes_the_calibration_of_its_camera(tmp_path: Path, number: int, fx: float, k1: float | None) -> None:
    writers.write_tum(tmp_path, blank(1), camera=number)
    camera = data.open(tmp_path)[0].camera
    assert float(camera.f[0, 0]) == pytest.approx(fx)
    assert camera.distortion is None if k1 is None else float(camera.distortion[0, 0]) == pytest.approx(k1)
    ros = data.open(tmp_path, intrinsics="ros")[0].camera
    assert ros.distortion is None and ros.f.tolist() == [[525, 525]] and ros.c.tolist() == [[319.5, 239.5]]
    (tmp_path / "groundtruth.txt").unlink()
    named = tmp_path.rename(tmp_path.parent / f"rgbd_dataset_freiburg{number}_xyz")
    assert torch.equal(data.open(named)[0].camera.f, camera.f)
    assert torch.equal(data.open(named, camera=1)[0].camera.f, torch.tensor([[517.306408, 516.469215]]))


def test_association_is_one_to_one_and_closest_first() -> None:
    assert tum.associate([0.0, 0.1, 0.2], [0.11, 0.205, 0.5], 0.02) == [(1, 0), (2, 1)]
    assert tum.associate([0.0, 0.01], [0.009], 0.02) == [(1, 0)]
    assert tum.associate([0.0], [0.02], 0.02) == []  # the limit itself is outside
    rng = np.random.default_rng(1)
    a, b = np.sort(rng.uniform(0, 3, 40)), np.sort(rng.uniform(0, 3, 40))
    taken: dict[int, int] = {}
    for d, i, j in sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b)):
        if d < 0.05 and i not in taken and j not in taken.values():
            taken[i] = j
    assert tum.associate(list(a), list(b), 0.05) == sorted(taken.items())


def test_tum_bridges_no_gap_of_the_trajectory(tmp_path: Path) -> None:
    frames = walk(4)
    frames = [f.replace(time=torch.tensor([100.0 + 0.5 * i], dtype=torch.float64)) for i, f in enumerate(frames)]
    writers.write_tum(tmp_path, frames)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    lines[4] = lines[4].split()[0] + " nan nan nan nan nan nan nan"  # lost at frame 1
    lines[5] = lines[5].split()[0] + " 0 0 0 0 0 0 0"  # and, differently said, at frame 2
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    recording = data.open(tmp_path)
    assert recording.number.tolist() == [0, 3]
    assert recording.report == ("2 RGB-D frames without a pose within 0.02 s: left out",)
    assert len(data.open(tmp_path, poses=False)) == 4


@pytest.mark.parametrize("sign", [1, -1])
def test_tum_interpolates_between_neighbouring_poses(tmp_path: Path, sign: int) -> None:
    writers.write_tum(tmp_path, walk(2))
    a, b = pose(0), pose(1)
    rows = [
        f"{100 + s:.4f} " + parts.format_row([*T.t[0], *(q * arrays.rotation_to_xyzw(T.R[0].numpy()))])
        for s, T, q in ((-0.004, a, 1), (0.012, b, sign))
    ]
    (tmp_path / "groundtruth.txt").write_text("# no camera named\n" + "\n".join(rows))
    recording = data.open(tmp_path)
    assert len(recording) == 1
    torch.testing.assert_close(recording.poses.t[0], 0.75 * a.t[0] + 0.25 * b.t[0], atol=1e-9, rtol=0)
    full = se3.rotation_angle(a.R.mT @ b.R)
    assert float(se3.rotation_angle(a.R.mT @ recording.poses.R) / full) == pytest.approx(0.25, abs=0.002)


def fails(message: str, *args: object, **options: object) -> None:
    """Opening, and reading every frame, ends in one line that contains ``message`` (a regular expression)."""
    with pytest.raises(ValueError, match=message) as caught:
        for recording in data.open_all(*args, **options):
            list(recording)
    assert "\n" not in str(caught.value)


def test_bad_tum(tmp_path: Path) -> None:
    writers.write_tum(tmp_path, blank(3), camera=1)
    good = {name: (tmp_path / name).read_text() for name in ("rgb.txt", "depth.txt", "groundtruth.txt")}

    def restore() -> None:
        for name, text in good.items():
            (tmp_path / name).write_text(text)

    (tmp_path / "depth.txt").write_text(good["depth.txt"].replace("100.", "900.", 1))
    recording = data.open(tmp_path)
    assert len(recording) == 2 and recording.report == ("1 images without a depth map within 0.02 s: left out",)
    lagging = good["depth.txt"].replace("\n1", "\n7")
    (tmp_path / "depth.txt").write_text(lagging)
    fails(r"time stamps: found 3 images and 3 depth maps, none within 0.02 s of one another, expected pairs", tmp_path)
    restore()
    (tmp_path / "groundtruth.txt").write_text(good["groundtruth.txt"].replace("\n100", "\n500"))
    fails(r"groundtruth.txt: time stamps: found no pose within 0.02 s of any image, expected overlapping", tmp_path)
    (tmp_path / "groundtruth.txt").write_text("# freiburg1\n")
    fails(r"groundtruth.txt: poses: found no usable row", tmp_path)
    (tmp_path / "groundtruth.txt").write_text("# freiburg1\n1 2 3\n")
    fails(r"groundtruth.txt: line 2: found 3 columns, expected 8 numbers", tmp_path)
    (tmp_path / "groundtruth.txt").unlink()
    fails(r"K: found no intrinsics, expected data.fov=69 .*data.camera=1, 2, 3 \(freiburg\) or icl", tmp_path)
    with pytest.warns(UserWarning, match="intrinsics are a guess from a field of view of 90°"):
        (guess,) = data.open_all(tmp_path, fov=90)
    assert float(guess[0].camera.f[0, 0]) == pytest.approx(guess[0].hw[1] / 2) and "are a guess" in guess.report[-1]
    assert data.open(tmp_path, intrinsics=[40, 41, 30, 20])[0].camera.f.tolist() == [[40, 41]]
    assert data.open(tmp_path, camera=2).poses is None
    fails(r"option camera: found 4, expected 1, 2, 3 or icl", tmp_path, camera=4)
    fails(r"option intrinsics: found default, expected camera or ros", tmp_path, intrinsics="default")
    restore()
    (tmp_path / "rgb.txt").write_text(good["rgb.txt"].replace("rgb/", "../rgb/"))
    fails(r"rgb.txt: line 2: found ../rgb/.*, expected a file inside the sequence's folder", tmp_path)
    (tmp_path / "rgb.txt").write_text("soon rgb/1.png\n")
    fails(r"rgb.txt: line 1: found soon rgb/1.png, expected a time stamp and a file name", tmp_path)
    restore()
    next((tmp_path / "rgb").iterdir()).unlink()
    fails(r"rgb/100.*png: file: found no such file, expected a readable file", tmp_path)
