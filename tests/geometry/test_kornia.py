"""Our values as kornia's and back: cameras, motions, and what both say of the same points; kornia's functions here."""

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

from dhtorch import Camera, Pose
from dhtorch.data import convert
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import before_kornia
import kornia_peers
import kornia_tables

REPO = Path(__file__).resolve().parents[2]
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


def test_what_kornia_does_here_is_what_was_done_before():
    g = np.random.default_rng(0)
    rotations = np.concatenate(
        (np.zeros((1, 3)), 1e-9 * g.normal(size=(5, 3)), g.normal(size=(50, 3)), [[np.pi, 0, 0]])
    )
    q = convert.to_quaternions(rotations)
    np.testing.assert_allclose(q, before_kornia.to_quaternions(rotations), atol=1e-15)
    found = convert.to_c2w(3 * q, rotations, Path("poses"))
    np.testing.assert_allclose(found, before_kornia.to_c2w(3 * q, rotations), atol=1e-15)
    assert convert.to_c2w(q[:0], rotations[:0], Path("poses")).shape == (0, 4, 4)
    camera, uv = cameras(), 160 * torch.rand(B, 30, 2, generator=torch.Generator().manual_seed(3)).double()
    torch.testing.assert_close(cam.distort(camera, uv), before_kornia.distort(camera, uv), rtol=1e-12, atol=1e-10)
    T = motions()
    assert torch.equal(se3.to_matrix(T), before_kornia.to_matrix(T))


def test_behind_a_wide_lens_kornias_steps_have_not_arrived():
    camera = Camera(
        torch.full((1, 2), 300.0), torch.tensor([[320.0, 240.0]]), torch.tensor([[-0.45, 0.2, 0.001, 0.001]])
    )
    uv = torch.rand(1, 500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([640.0, 480.0])
    ideal, theirs = cam.undistort(camera, uv), undistort_points(uv, cam.to_matrix(camera), camera.distortion)
    assert ideal.isfinite().all() and (cam.distort(camera, ideal) - uv).abs().max() < 0.01
    assert ((theirs - ideal).abs().amax(-1) > 0.1).float().mean() > 0.4


def test_kornia_is_loaded_where_it_is_first_used():
    code = "import sys, dhtorch; dhtorch.MAP, dhtorch.data; print('kornia' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"


def test_the_page_has_a_row_for_every_pair_of_functions():
    asked = [(p.ours, p.kornia, p.used, p.why, p.note) for p in kornia_peers.PEERS]
    rows = [r for r in kornia_tables.rows() if r["name"] != "answers"]
    assert asked == [(r["name"], r["kornia"], r["used"], r["why"], r["note"]) for r in rows]
    assert len(asked) >= 15 and {p.used for p in kornia_peers.PEERS} == {"ours", "kornia"}
    assert all(p.why for p in kornia_peers.PEERS if p.used == "ours"), "where we depart, the reason is said"


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", (REPO / "docs/kornia.md").read_text(), re.S))
def test_the_example_of_the_page_runs(code):
    found = {}
    exec(compile(code, "docs/kornia.md", "exec"), found)
    assert torch.equal(found["back"].intrinsics, found["theirs"].intrinsics)
    assert torch.equal(found["back"].extrinsics, found["theirs"].extrinsics)
