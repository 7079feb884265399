"""Our values as kornia's and back: cameras, motions, and what both say of the same points; kornia's functions here."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import undistort_points
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from kornia.geometry.vector import Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import (
    BrownConradyModel,
    CameraModel,
    CameraModelType,
    KannalaBrandtK3,
    Orthographic,
    PinholeModel,
)

from dhtorch import Camera, Pose
from dhtorch.data import convert
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.pipeline.presets import METHODS
from dhtorch.synthetic import SyntheticRoom

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import beside_kornia

REPO = Path(__file__).resolve().parents[2]
PAGE = (REPO / "docs/kornia.md").read_text(encoding="utf-8")
B, HW = 3, (120, 160)


def cameras(dtype=torch.float64):
    g = torch.Generator().manual_seed(0)
    f, c = 100 + 40 * torch.rand(B, 2, generator=g, dtype=dtype), 60 + 20 * torch.rand(B, 2, generator=g, dtype=dtype)
    return Camera(f, c, torch.rand(B, 4, generator=g, dtype=dtype))


def motions(dtype=torch.float64):
    return se3.exp(torch.randn(B, 6, generator=torch.Generator().manual_seed(1), dtype=dtype))


def points(n=20, dtype=torch.float64):
    x = torch.randn(B, n, 3, generator=torch.Generator().manual_seed(2), dtype=dtype)
    return torch.cat((x[..., :2], x[..., 2:].abs() + 1), -1)


def test_a_camera_comes_back_as_it_went():
    ours, T = cameras(), motions()
    theirs = ours.to_kornia(HW, T)
    assert (
        isinstance(theirs, PinholeCamera) and theirs.height.tolist() == [120] * B and theirs.width.tolist() == [160] * B
    )
    back = Camera.from_kornia(theirs, ours.distortion)
    assert torch.equal(back.f, ours.f) and torch.equal(back.c, ours.c) and back.distortion is ours.distortion
    where = Pose.from_kornia(theirs)
    assert torch.equal(where.R, T.R) and torch.equal(where.t, T.t)
    assert Camera.from_kornia(ours.to_kornia(HW)).distortion is None
    assert torch.equal(Pose.from_kornia(ours.to_kornia(HW)).R, torch.eye(3).double().expand(B, 3, 3))


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("batch", [(), (B,)])
def test_cameras_of_kornias_sensors_see_points_where_ours_do(batch, wrapped):
    ours, xyz = cameras(), points()[:1]
    lens = torch.tensor([-0.05, 0.02, 0.02, -0.013, 0.01, 0.02, 0.01, 0.0], dtype=torch.float64)
    params = torch.cat((ours.f, ours.c), -1) if batch else torch.cat((ours.f[0], ours.c[0]))
    kinds = {
        CameraModelType.PINHOLE: params,
        CameraModelType.BROWN_CONRADY: torch.cat((params, lens.expand(*batch, 8)), -1),
    }
    for kind, numbers in kinds.items():
        made = {CameraModelType.PINHOLE: PinholeModel, CameraModelType.BROWN_CONRADY: BrownConradyModel}[kind]
        theirs = CameraModel(ImageSize(*HW), kind, numbers) if wrapped else made(ImageSize(*HW), numbers)
        camera = Camera.from_kornia(theirs)
        assert len(camera.f) == (B if batch else 1) and (camera.distortion is None) == (made is PinholeModel)
        for b in range(len(camera.f)):
            alone = made(ImageSize(*HW), numbers[b] if batch else numbers)
            one = Camera(*(None if x is None else x[b : b + 1] for x in (camera.f, camera.c, camera.distortion)))
            seen = alone.project(Vector3(xyz[0])).data
            torch.testing.assert_close(cam.project(one, xyz)[0], seen, rtol=1e-9, atol=1e-9)


def test_cameras_without_a_counterpart_are_refused_by_name():
    lens = torch.zeros(1, 4)
    for theirs, options, name in (
        (KannalaBrandtK3(ImageSize(*HW), torch.rand(8)), {}, "KannalaBrandtK3"),
        (Orthographic(ImageSize(*HW), torch.rand(4)), {}, "Orthographic"),
        (CameraModel(ImageSize(*HW), CameraModelType.ORTHOGRAPHIC, torch.rand(4)), {}, "Orthographic"),
        (BrownConradyModel(ImageSize(*HW), torch.rand(12)), {"distortion": lens}, "BrownConradyModel with another"),
        (torch.eye(3), {}, "Tensor"),
    ):
        with pytest.raises(
            TypeError, match=f"^Camera.from_kornia: found {name}.*, expected a PinholeCamera, PinholeModel"
        ):
            Camera.from_kornia(theirs, **options)
    given = PinholeModel(ImageSize(*HW), torch.rand(1, 4))
    assert Camera.from_kornia(given, lens).distortion is lens


def test_both_see_a_point_of_the_world_at_the_same_pixel():
    ours, T, xyz = cam.ideal(cameras()), motions(), points()
    world = se3.apply(se3.invert(T), xyz)
    torch.testing.assert_close(ours.to_kornia(HW, T).project(world), cam.project(ours, xyz), rtol=1e-9, atol=1e-7)


def test_a_motion_comes_back_and_moves_points_alike():
    T, xyz = motions(), points()
    theirs = T.to_kornia()
    assert isinstance(theirs, Se3)
    back = Pose.from_kornia(theirs)
    torch.testing.assert_close(back.R, T.R, rtol=0, atol=1e-12)
    assert torch.equal(back.t, T.t)
    torch.testing.assert_close((theirs.rotation.matrix() @ xyz.mT).mT + theirs.t[:, None], se3.apply(T, xyz))


def test_tangents_are_in_the_other_order():
    xi = torch.tensor([[0.1, -0.2, 0.3, 1.0, 2.0, 3.0]], dtype=torch.float64)
    theirs = Se3.exp(torch.cat((xi[:, 3:], xi[:, :3]), -1))
    torch.testing.assert_close(Pose.from_kornia(theirs).t, se3.exp(xi).t)
    torch.testing.assert_close(se3.exp(xi).to_kornia().log()[:, 3:], xi[:, :3])


def test_gradients_cross_the_border():
    f = cameras().f.requires_grad_()
    Camera(f, cameras().c).to_kornia(HW).project(points()).sum().backward()
    assert bool((f.grad != 0).all())
    t = motions().t.requires_grad_()
    (Pose.from_kornia(Pose(motions().R, t).to_kornia()).t * 2).sum().backward()
    assert bool((t.grad == 2).all())


def test_quaternions_and_matrices_by_kornia_are_those_of_the_exponential_map():
    g = np.random.default_rng(0)
    vectors = np.concatenate((np.zeros((1, 3)), 1e-9 * g.normal(size=(5, 3)), g.normal(size=(50, 3)), [[np.pi, 0, 0]]))
    q = convert.to_quaternions(vectors)
    found = convert.to_c2w(3 * q, vectors, Path("poses"))
    cross = np.cross(vectors[:, None], np.eye(3)).swapaxes(1, 2)
    np.testing.assert_allclose(found[:, :3, :3], torch.matrix_exp(torch.from_numpy(cross)), atol=1e-14)
    assert (found[:, :3, 3] == vectors).all() and (found[:, 3] == [0, 0, 0, 1]).all()
    assert convert.to_c2w(q[:0], vectors[:0], Path("poses")).shape == (0, 4, 4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kornias_functions_that_are_used_give_the_bits_of_the_formulas_that_they_replaced(dtype):
    camera, uv = cameras(dtype), 160 * torch.rand(B, 500, 2, generator=torch.Generator().manual_seed(3)).to(dtype)
    camera = camera.replace(distortion=0.02 * camera.distortion)
    depth = 1 + points(500, dtype)[..., 2]
    arguments = {
        "geometry.camera.unproject": (camera, uv, depth),
        "geometry.se3.hat": (points(500, dtype),),
        "geometry.filters.grayscale": (torch.rand(B, 3, *HW, dtype=dtype),),
    }
    used = {p.ours: p for p in beside_kornia.PEERS if p.used == "kornia"}
    assert used.keys() == arguments.keys()
    for name, peer in used.items():
        mine, theirs = peer.mine(*arguments[name]), peer.theirs(*arguments[name])
        assert torch.equal(mine, theirs) and mine.isfinite().all(), name
    assert torch.equal(cam.rays(camera, uv), used["geometry.camera.unproject"].mine(camera, uv, depth**0))


@pytest.mark.parametrize("method", ["paper", "map"])
def test_methods_enter_kornias_geometry(method):
    room = SyntheticRoom(seed=2, n_frames=6, hw=HW, depth_hw=(48, 64))
    entered = set()

    def profile(frame, event, _):
        if event == "call" and "/kornia/" in frame.f_code.co_filename:
            entered.add(frame.f_code.co_name)

    sys.setprofile(profile)
    try:
        METHODS[method](room[0], room[3])
    finally:
        sys.setprofile(None)
    assert {"unproject_points", "rgb_to_grayscale"} <= entered
    assert ("hat" in entered) == (method == "map")


def test_behind_a_wide_lens_kornias_steps_have_not_arrived():
    camera = Camera(
        torch.full((1, 2), 300.0), torch.tensor([[320.0, 240.0]]), torch.tensor([[-0.45, 0.2, 0.001, 0.001]])
    )
    uv = torch.rand(1, 500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([640.0, 480.0])
    ideal, theirs = cam.undistort(camera, uv), undistort_points(uv, cam.to_matrix(camera), camera.distortion)
    assert ideal.isfinite().all() and (cam.distort(camera, ideal) - uv).abs().max() < 0.01
    assert ((theirs - ideal).abs().amax(-1) > 0.1).float().mean() > 0.4


def test_kornia_is_loaded_with_the_methods_and_not_with_the_package():
    code = "import sys, dhtorch, dhtorch.data; dhtorch.Frame; print('kornia' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"


def test_the_result_has_a_row_for_every_pair_of_functions_and_kornias_are_used_where_they_cost_nothing():
    rows = json.loads((REPO / "benchmarks/results/kornia.json").read_text())
    assert [(p.ours, p.kornia, p.used, p.why) for p in beside_kornia.PEERS] == [
        (r["name"], r["kornia"], r["used"], r["why"]) for r in rows
    ]
    for row in rows:
        free = max(row["added_percent"].values()) < beside_kornia.MAX_ADDED_PERCENT
        assert (row["used"] == "kornia") == (free and row["largest"] == 0), row["name"]
    assert f"adds less than {beside_kornia.MAX_ADDED_PERCENT} %" in PAGE.replace("\n", " ")


def test_the_page_lists_the_functions_that_are_imported_from_kornia():
    """Outside the stages that are written on it, the adapters and the experiments; classes (without "_") convert."""
    imported = set()
    for path in (REPO / "dhtorch").rglob("*.py"):
        if not {"kornia", "transforms", "features.py", "experiments"} & set(path.relative_to(REPO).parts):
            for names in re.findall(r"from kornia\.\S+ import ([\w, ]+)", path.read_text(encoding="utf-8")):
                imported |= {name.strip() for name in names.split(",") if "_" in name and not name.strip().isupper()}
    table = PAGE.partition("## Function by function")[2].partition("The next table")[0]
    first_column = "".join(row.split("|")[1] for row in table.splitlines() if row.startswith("| "))
    listed = set(re.findall(r"`(?:\w+\.)*(\w+)`", first_column))
    assert listed == imported | {"hat"}


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", PAGE, re.S))
def test_the_example_of_the_page_runs(code):
    names = {}
    exec(compile(code, "docs/kornia.md", "exec"), names)
    if "back" in names:
        assert torch.equal(names["back"].intrinsics, names["theirs"].intrinsics)
        assert torch.equal(names["back"].extrinsics, names["theirs"].extrinsics)
    elif "chain" in names:
        out = names["out"]
        assert (
            out["image"].shape == (1, 3, 96, 128) and out["camera"].width.tolist() == [128] and out["dhtorch.pose_ok"]
        )
    else:
        assert names["estimate"].keep.sum() > 50
