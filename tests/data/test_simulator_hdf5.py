"""Simulators' demonstrations in HDF5: every layout written and read back; links and damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.box_scene import walk
from support.capture_cases import Case, check_case
from support.writers.simulator_hdf5 import write_simulator_hdf5

from dhtorch.records import Frame

h5py = pytest.importorskip("h5py")


def still(n: int = 3) -> list[Frame]:
    """Frames of a camera that stands."""
    return walk(1) * n


def write(
    root: Path, frames: list[Frame], *, layout: str, change: Any = None, second: Any = None, **options: Any
) -> None:
    """A file of one episode or two, changed, and another one with the same content."""
    for name in ("secret.h5", "a.h5"):
        write_simulator_hdf5(root / name, [frames] if second is None else [second, frames], layout, **options)
    with h5py.File(root / "a.h5", "a") as file:
        for path, value in (change or {}).items():
            del file[path]
            if value is not None:
                file[path] = value


def h5_case(name: str, layout: str, frames: Any, expect: Any = None, **more: Any) -> Case:
    keys = ("error", "options", "which")
    rest = {key: more.pop(key) for key in keys if key in more}
    return Case(name, write, frames, (), expect or {}, written={"layout": layout, **more}, path="a.h5", **rest)


NUMBERS = np.zeros((1, 48, 64, 3), np.float32)
NUMBERS[0, 0, :7, 0] = [0.0, 0.2, 0.75, 1.0, 1.5, -0.1, np.nan]
FRONT, PLANES = "traj_0/obs/sensor_data/front", (0.01, 50.0)
EXACT = ([0, 1], 0, 1.0, True)
CASES = [
    *(h5_case(f"{layout}, an episode of two", layout, 2, {
        "title": f"a/{name}_1/front", "posed": True, "times": None, "camera": "front", "episode": 1, "step": step,
        "same": ([0, 1], step or 0, 1.0, True)}, second=walk(3), which=1)
      for layout, name, step in (("maniskill3", "traj", 1 / 1000), ("maniskill2", "traj", 1 / 1024))),
    *(h5_case(f"robomimic, episode {k}", "robomimic", still, {
        "title": f"a/demo_{k}/front", "posed": True, "times": None, "step": None, "same": ([0, 1, 2], 0, 1.0, True)},
              second=still(3), which=k) for k in (0, 1)),
    h5_case("images of numbers become bytes", "maniskill3", 1, {"first values": [0, 51, 191, 255, 255, 0, 0]},
            change={f"{FRONT}/rgb": NUMBERS}),
    h5_case("one source of poses suffices", "maniskill3", 2, {"posed": True, "same": ([0, 1], 1e-3, 1.0, True)},
            change={"traj_0/obs/sensor_param/front/cam2world_gl": None}),
    h5_case("a camera in the hand has no pose", "robomimic", 2, {"posed": False}, camera="robot0_eye_in_hand"),
    h5_case("no K", "robomimic", 2, parameters=False, error=r"front: found no intrinsics, expected .*data.K"),
    h5_case("no K, an option", "robomimic", 2, {"same": EXACT}, parameters=False,
            options={"K": [61.5, 58.25, 33.5, 21.75]}),
    h5_case("a z-buffer as stored", "robomimic", still, {"median": pytest.approx(1, abs=0.1)}, clip_planes=PLANES),
    h5_case("a z-buffer between its planes", "robomimic", still, {"same": ([0, 1, 2], 1e-3, 1.0, True)},
            clip_planes=PLANES, options={"clip_planes": PLANES}),
    h5_case("planes in the other order", "robomimic", still, clip_planes=PLANES, options={"clip_planes": [2.0, 1.0]},
            error="clip_planes"),
    h5_case("a camera by another name", "maniskill3", 2, options={"camera": "hand"},
            error="option camera: found hand, expected among front"),
    *(h5_case(f"a link of {path} to another file", "maniskill3", 2, change={path: h5py.ExternalLink("secret.h5", path)},
              error=r"a\.h5") for path in (f"{FRONT}/depth", "traj_0")),
    *(h5_case(f"{name} of another shape", "maniskill3", 2, change={f"{FRONT}/{name}": value}, error=message)
      for name, value, message in (("depth", [[1.0]], "depth"), ("rgb", [[[1.0]]], "an array of"))),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_variants_are_read_and_faults_named(case: Case, tmp_path: Path) -> None:
    check_case(case, tmp_path)
