"""TUM RGB-D: sequences written in its layout, with the traps of its clocks and of its trajectories."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support import writers
from support.box_scene import CAMERA, HW, pose, walk
from support.capture_cases import DELETE, Case, check_case
from support.writers import parts

from dhtorch import data
from dhtorch.data.readers import tum
from dhtorch.export import arrays
from dhtorch.geometry import se3
from dhtorch.records import Frame


def blank(n: int) -> list[Frame]:
    """Frames of the size that the published TUM calibration belongs to, with nothing to see."""
    image, depth = torch.zeros(1, 3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640)
    stamps = [torch.tensor([100 + i / 30], dtype=torch.float64) for i in range(n)]
    return [Frame(image, depth, CAMERA, time=t, T_world_from_cam=pose(i)) for i, t in enumerate(stamps)]


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


def lose(text: str) -> str:
    """A trajectory that was lost at frames 1 and, differently written, 2."""
    lines = text.splitlines()
    lines[4] = lines[4].split()[0] + " nan nan nan nan nan nan nan"
    lines[5] = lines[5].split()[0] + " 0 0 0 0 0 0 0"
    return "\n".join(lines)


def slow() -> list[Frame]:
    return [f.replace(time=torch.tensor([100.0 + 0.5 * i]).double()) for i, f in enumerate(walk(4))]


def write_twin(root: Path, frames: list[Frame], **options: int) -> None:
    writers.write_tum(root / "rgbd_dataset_freiburg3_walking_xyz_validation", frames, **options)


def write_named(number: int) -> Any:
    """What writes into a folder that is named after its camera."""
    return lambda root, frames, **options: writers.write_tum(root / TITLE.format(number), frames, **options)


TUM = {"write": writers.write_tum, "frames": lambda: blank(3), "written": {"camera": 1}}
POSES, NO_POSES = "groundtruth.txt", ("groundtruth.txt", DELETE)

CODES = np.tile(np.array([0, 1, 5000, 65535], np.uint16), (HW[0], HW[1] // 4))
LENS = torch.tensor([tum._CAMERA_CALIBRATIONS[1][1]])
PUBLISHED = {
    1: ([517.306408, 516.469215], 0.262383),
    2: ([520.908620, 521.007327], 0.231222),
    3: ([535.4, 539.2], None),
}
TITLE = "rgbd_dataset_freiburg{}_xyz"
CASES = [
    Case("as it is written", writers.write_tum, lambda: walk(3, CAMERA.replace(distortion=LENS)), (),
         {"format": "tum", "report": (), "lens": LENS[0].tolist(), "times of": [100.0, 100.033333, 100.066667],
          "same": ([0, 1, 2], 1 / 5000, 1.0, True)}),
    *(Case(f"the largest code is no depth, {units}", writers.write_tum, 1, [("depth/*", CODES)],
           {"returns": HW[0] * HW[1] // 2, "median": pytest.approx(1 / units)}, options={"units_per_metre": units})
      for units in (5000, 5208)),
    *(Case(f"camera {number} by {name}", write, lambda: blank(1), edits, expect, written={"camera": number}, path=path,
           options=options)
      for number, (f, k1) in PUBLISHED.items()
      for name, write, edits, path, options, expect in (
          ("trajectory", writers.write_tum, [], ".", {},
           {"f": pytest.approx(f), "first term": k1 and pytest.approx(k1)}),
          ("trajectory, registered", writers.write_tum, [], ".", {"intrinsics": "ros"},
           {"f": [525, 525], "c": [319.5, 239.5], "lens": None}),
          ("folder", write_named(number), [("*/groundtruth.txt", DELETE)], TITLE.format(number), {},
           {"f": pytest.approx(f)}),
          ("option", write_named(number), [("*/groundtruth.txt", DELETE)], TITLE.format(number), {"camera": 1},
           {"f": pytest.approx(PUBLISHED[1][0])}))),
    Case("a validation twin has no poses", write_twin, lambda: blank(2),
         [("*/groundtruth.txt", DELETE),
          ("rgbd_dataset_freiburg3_walking_xyz_validation/accelerometer.txt", "# t ax ay az\n100.0 0.1 9.8\nno number\n")],
         {"number": [0, 1], "posed": False, "report": (), "f": pytest.approx([535.4, 539.2])}, written={"camera": 3},
         path="rgbd_dataset_freiburg3_walking_xyz_validation"),
    Case("depth_scale of meta.json", writers.write_tum, 1,
         [("meta.json", lambda text: text.replace("{", '{"depth_scale": 4000, ', 1))],
         {"unit": (1 / 4000, "meta.json: depth_scale")}),
    Case("no gap of the trajectory is bridged", writers.write_tum, slow, [(POSES, lose)],
         {"number": [0, 3], "report": ("2 RGB-D frames without a pose within 0.02 s: left out",)}),
    Case("without poses all are kept", writers.write_tum, slow, [(POSES, lose)], {"number": [0, 1, 2, 3]},
         options={"poses": False}),
    Case("one depth map of another time", **TUM, edits=[("depth.txt", lambda text: text.replace("100.", "900.", 1))],
         expect={"number": [1, 2], "report": ("1 images without a depth map within 0.02 s: left out",)}),
    Case("depth of another clock", **TUM, edits=[("depth.txt", [("\n1", "\n7")])],
         error=r"time stamps: found 3 images and 3 depth maps, none within 0.02 s of one another, expected pairs"),
    Case("poses of another clock", **TUM, edits=[(POSES, [("\n100", "\n500")])],
         error=r"groundtruth.txt: time stamps: found no pose within 0.02 s of any image, expected overlapping"),
    Case("no pose", **TUM, edits=[(POSES, "# freiburg1\n")], error=r"groundtruth.txt: poses: found no usable row"),
    Case("poses of three numbers", **TUM, edits=[(POSES, "# freiburg1\n1 2 3\n")],
         error=r"groundtruth.txt: line 2: found 3 columns, expected 8 numbers"),
    Case("no camera", **TUM, edits=[NO_POSES],
         error=r"K: found no intrinsics, expected data.fov=69 .*data.camera=1, 2, 3 \(freiburg\) or icl"),
    Case("a field of view", **TUM, edits=[NO_POSES], options={"fov": 90},
         expect={"f": pytest.approx([320, 320]), "report": ["are a guess"]}),
    Case("four numbers", **TUM, edits=[NO_POSES], options={"intrinsics": [40, 41, 300, 200]}, expect={"f": [40, 41]}),
    Case("a camera by number", **TUM, edits=[NO_POSES], options={"camera": 2}, expect={"posed": False}),
    Case("an unknown camera", **TUM, options={"camera": 4}, error=r"option camera: found 4, expected 1, 2, 3 or icl"),
    Case("an unknown calibration", **TUM, options={"intrinsics": "default"},
         error=r"option intrinsics: found default, expected camera or ros"),
    Case("a file outside", **TUM, edits=[("rgb.txt", [("rgb/", "../rgb/")])],
         error=r"rgb.txt: line 2: found ../rgb/.*, expected a file inside the sequence's folder"),
    Case("no stamp", **TUM, edits=[("rgb.txt", "soon rgb/1.png\n")],
         error=r"rgb.txt: line 1: found soon rgb/1.png, expected a time stamp and a file name"),
    Case("no image", **TUM, edits=[("rgb/100.000000.png", DELETE)],
         error=r"rgb/100.*png: file: found no such file, expected a readable file"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)
