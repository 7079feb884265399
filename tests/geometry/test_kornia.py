"""Our values as kornia's and back: cameras, motions, and what both say of the same points; kornia's functions here."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
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


def test_a_motion_comes_back_and_moves_points_alike():
    T, xyz = motions(), points()
    theirs = T.to_kornia()
    assert isinstance(theirs, Se3)
    back = Pose.from_kornia(theirs)
    torch.testing.assert_close(back.R, T.R, rtol=0, atol=1e-12)
    assert torch.equal(back.t, T.t)
    torch.testing.assert_close((theirs.rotation.matrix() @ xyz.mT).mT + theirs.t[:, None], se3.apply(T, xyz))


def test_quaternions_and_matrices_by_kornia_are_those_of_the_exponential_map():
    g = np.random.default_rng(0)
    vectors = np.concatenate((np.zeros((1, 3)), 1e-9 * g.normal(size=(5, 3)), g.normal(size=(50, 3)), [[np.pi, 0, 0]]))
    q = convert.to_quaternions(vectors)
    found = convert.to_c2w(3 * q, vectors, Path("poses"))
    cross = np.cross(vectors[:, None], np.eye(3)).swapaxes(1, 2)
    np.testing.assert_allclose(found[:, :3, :3], torch.matrix_exp(torch.from_numpy(cross)), atol=1e-14)
    assert (found[:, :3, 3] == vectors).all() and (found[:, 3] == [0, 0, 0, 1]).all()
    assert convert.to_c2w(q[:0], vectors[:0], Path("poses")).shape == (0, 4, 4)


def test_kornia_is_loaded_with_the_methods_and_not_with_the_package():
    code = "import sys, dhtorch, dhtorch.data; dhtorch.Frame; print('kornia' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"


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
