"""Our values as kornia's and back: cameras, motions, and what both say of the same points."""

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3

from dhtorch import Camera, Pose
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3

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
