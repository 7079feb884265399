"""Cameras against OpenCV, kornia, finite differences and the definition of a pixel; shape contracts."""

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera import PinholeCamera

from dhtorch.geometry import camera as cam
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import check

HW = (480, 640)

#: Lenses of every supported number of coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6]].
LENSES = {
    "wide barrel": [-0.28, 0.09, 0.0, 0.0],
    "pincushion": [0.15, 0.06, 0.0, 0.0, 0.02],
    "tangential": [-0.05, 0.02, 0.02, -0.013],
    "third order": [0.03, -0.05, 0.001, -0.002, 0.04],
    "rational": [0.9, 0.25, -0.002, 0.003, 0.02, 1.1, 0.4, 0.06],
}


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def pinhole(lens=None, batch=1):
    """Cameras with oblong pixels and a principal point off the middle; the second has another K."""
    f, c = double([300.0, 330.0], [410.0, 380.0])[:batch], double([310.5, 250.0], [333.0, 221.5])[:batch]
    return Camera(f, c, None if lens is None else double(*lens).expand(batch, -1))


def grid(batch=1, margin=20.0):
    """Pixels (B, 35, 2) over the whole image, corners included."""
    v, u = torch.meshgrid(
        torch.linspace(margin, HW[0] - margin, 5, dtype=torch.float64),
        torch.linspace(margin, HW[1] - margin, 7, dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack((u, v), -1).reshape(1, -1, 2).expand(batch, -1, 2)


def numpys(camera, b=0):
    """K and the coefficients of one camera as OpenCV takes them."""
    return cam.to_matrix(camera)[b].numpy(), None if camera.distortion is None else camera.distortion[b].numpy()


def close(a, b, atol=1e-9):
    torch.testing.assert_close(a, b, rtol=1e-9, atol=atol)


# ------------------------------------------------------------------------------------------------ projection


@pytest.mark.parametrize("lens", [None, *LENSES.values()], ids=["none", *LENSES])
def test_points_and_pixels_are_those_of_opencv_and_kornia(lens):
    """Each camera of a batch with its own K, whose numbers it holds; there and back, with their slopes."""
    camera, uv, h = pinhole(lens, batch=2), grid(2), 1e-3
    depth = torch.linspace(0.4, 5, 70, dtype=torch.float64).view(2, 35)
    xyz = cam.unproject(camera, uv, depth)
    K, ideal = cam.to_matrix(camera), cam.undistort(camera, uv)
    assert torch.equal(xyz[..., 2], depth)
    close(cam.project(camera, xyz), uv)
    close(cam.project(camera, -xyz), uv)
    close(cam.rays(camera, uv), xyz / depth[..., None])
    close(cam.distort(camera, ideal), uv)
    exact = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    for b in range(2):
        matrix, numbers = numpys(camera, b)
        theirs, _ = cv2.projectPoints(xyz[b].numpy(), np.zeros(3), np.zeros(3), matrix, numbers)
        close(uv[b], torch.from_numpy(theirs[:, 0]), atol=1e-8)
        theirs = cv2.undistortPoints(uv[b].numpy(), matrix, numbers, P=matrix, criteria=exact)
        close(ideal[b], torch.from_numpy(theirs[:, 0]), atol=1e-8)
    steps = [double([h, 0.0]), double([0.0, h])]
    slope = torch.stack([cam.undistort(camera, uv + s) - cam.undistort(camera, uv - s) for s in steps], -1) / (2 * h)
    torch.testing.assert_close(cam.undistort_jacobian(camera, ideal), slope, rtol=1e-6, atol=1e-7)
    if lens is None:
        eye, size = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), torch.full((2,), 480.0)
        whole = torch.nn.functional.pad(K, (0, 1, 0, 1)) + eye * double(0, 0, 0, 1)
        theirs = PinholeCamera(whole, eye, size, size)
        close(cam.project(camera, xyz), theirs.project(xyz))
        assert ideal is uv and cam.distort(camera, uv) is uv
    else:
        close(cam.distort(camera, ideal), distort_points(ideal, K, camera.distortion))
        close(ideal, undistort_points(uv, K, camera.distortion, num_iters=100), atol=1e-8)


def test_projection_keeps_away_from_zero_depth():
    camera = pinhole()
    at = lambda z: cam.project(camera, double([[0.3, -0.2, z]]))  # noqa: E731
    for z in (0.0, 5e-10, -5e-10):
        assert torch.equal(at(z), at(1e-9)), "|z| below 1e-9 m counts as 1e-9 m in front"
    for z in (2e-9, -2e-9, -2.0):
        close(at(z), camera.c[:, None] + camera.f * double([[0.3, -0.2]]) / z, atol=0)
    xyz = double([[0.3, -0.2, 0.0]]).requires_grad_()
    cam.project(camera, xyz).sum().backward()
    assert xyz.grad.isfinite().all()


@pytest.mark.parametrize("lens", [None, LENSES["tangential"]], ids=["ideal", "lens"])
@pytest.mark.parametrize(
    "linear", [[[-1.0, 0], [0, 1]], [[0, -1.0], [1, 0]], [[1.5, 0], [0, 2]], [[-0.8, 0.6], [0.6, 0.8]]]
)
def test_the_camera_of_a_moved_image_sees_the_turned_point_at_the_moved_pixel(linear, lens):
    camera = pinhole(lens)
    if linear[0][0] and linear[0][1]:
        camera = camera.replace(f=camera.f[:, :1].expand(1, 2))  # only square pixels turn by any angle
    A = torch.eye(3, dtype=torch.float64)[None].clone()
    A[0, :2, :2], A[0, :2, 2] = double(*linear), double(20.0, -7.0)
    moved, Q = cam.warp(camera, A)
    assert (moved.f > 0).all()
    close(Q @ Q.mT, torch.eye(3, dtype=torch.float64)[None])
    uv, z = grid(), torch.linspace(1, 4, 35, dtype=torch.float64)[None]
    xyz = cam.unproject(camera, uv, z)
    close(cam.project(moved, xyz @ Q.mT), uv @ A[:, :2, :2].mT + A[:, None, :2, 2], atol=1e-6)
    sheared = cam.warp(camera, A @ double([1, 0.1, 0], [0, 1, 0], [0, 0, 1]))[1]
    assert (sheared @ sheared.mT - torch.eye(3).double()).abs().max() > 0.01


# ------------------------------------------------------------------------------------------------ lens


@pytest.mark.parametrize("count", [1, 3, 6, 7, 9, 12, 14])
@pytest.mark.parametrize(
    "call",
    [
        lambda c: cam.project(c, double([[0.1, 0.2, 1.0]])),
        *(lambda c, f=f: f(c, grid()) for f in (cam.distort, cam.undistort, cam.undistort_jacobian, cam.rays)),
    ],
)
def test_a_lens_with_another_number_of_coefficients_is_refused(call, count):
    with pytest.raises(ValueError, match=rf"{count} coefficients, expected one of \(4, 5, 8\)"):
        call(pinhole([0.01] * count))


def test_a_pixel_beyond_the_fold_of_the_lens_is_nan_and_spoils_no_gradient():
    """r (1 − 0.3 r²) rises to 0.70 and falls again: nothing is seen at 0.8, and 0.999 of the fold's 1 / √0.9 is solved."""
    camera = Camera(double([100.0, 100.0]), double([0.0, 0.0]), double([-0.3, 0.0, 0.0, 0.0]))
    wanted = [x.requires_grad_() for x in (camera.f, camera.c, camera.distortion)]
    uv = double([[80.0, 0.0], [60.0, 10.0], [0.0, -75.0]]).requires_grad_()
    found = cam.undistort(camera, uv)
    assert found.isnan().all(-1).tolist() == [[True, False, True]]
    found[0, 1].sum().backward()
    assert all(x.grad.isfinite().all() and x.grad.any() for x in (uv, *wanted))
    ideal = double([[0.999 * 100 / 0.9**0.5, 0.0]])
    close(cam.undistort(camera, cam.distort(camera, ideal)), ideal, atol=1e-6)
    across, along = 1 / (1 - 0.3 * 0.999**2 / 0.9), 1 / (1 - 0.999**2)  # of r (1 − 0.3 r²)
    close(cam.undistort_jacobian(camera, ideal)[0, 0], torch.diag(double(along, across)))
    ring = camera.replace(distortion=double([-1.0, 0.0, 0.0, 0.0]))  # at r = 1 the determinant is zero
    assert cam.undistort_jacobian(ring, double([[100.0, 0.0], [0.0, -100.0]])).isfinite().all()


def test_a_pixel_is_solved_when_it_returns_to_within_a_hundredth_of_a_pixel():
    """Newton's steps written out for pixels on the two axes, under focal lengths far apart."""
    f, k1 = double(50.0, 5000.0), -0.25
    camera = Camera(f[None], double([0.0, 0.0]), double([k1, 0.0, 0.0, 0.0]))
    target = torch.linspace(0.02, 0.74, 37, dtype=torch.float64)
    step = lambda x: x - (x + k1 * x**3 - target) / (1 + 3 * k1 * x**2)  # noqa: E731
    for axis in range(2):
        uv = torch.zeros(1, 37, 2, dtype=torch.float64)
        uv[..., axis], x = target * f[axis], target
        for iterations in range(5):
            solved = (x + k1 * x**3 - target).abs() * 5000 < 0.01
            found = cam.undistort(camera, uv, iterations=iterations)
            assert torch.equal(found[0, :, axis].isfinite(), solved)
            close(found[0, solved, axis], (step(x) * f[axis])[solved])
            x = step(x)


# ------------------------------------------------------------------------------------------------ images


@pytest.mark.parametrize("new_hw", [(120, 320), (480, 160), (960, 640), (37, 53)])
def test_resized_camera_sees_where_opencv_puts_the_pixels(new_hw):
    """An image of its own coordinates says from where each new pixel came."""
    v, u = np.meshgrid(np.arange(HW[0], dtype=np.float32), np.arange(HW[1], dtype=np.float32), indexing="ij")
    came = cv2.resize(np.stack((u, v), -1), new_hw[::-1], interpolation=cv2.INTER_LINEAR)[5:-5, 7:-7]
    lens, readout = double([0.01, 0.02, 0.003, 0.004]), double(0.02)
    camera = pinhole().replace(distortion=lens, readout=readout)
    small = cam.resize(camera, HW, new_hw)
    v, u = np.meshgrid(np.arange(5, new_hw[0] - 5), np.arange(7, new_hw[1] - 7), indexing="ij")
    there = torch.from_numpy(np.stack((u, v), -1).reshape(1, -1, 2)).double()
    back = torch.from_numpy(came.reshape(1, -1, 2)).double()
    xy = [(uv - c.c[:, None]) / c.f[:, None] for uv, c in ((there, small), (back, camera))]
    torch.testing.assert_close(*xy, rtol=0, atol=2e-6)
    assert small.distortion is lens and small.readout is readout
    assert cam.resize(camera.to(torch.float32), HW, new_hw).f.dtype == torch.float32
    K = cam.to_matrix(camera)
    again = cam.from_matrix(K, lens, readout)
    assert torch.equal(again.f, camera.f) and torch.equal(again.c, camera.c) and K[0, 2].tolist() == [0, 0, 1]
    assert again.distortion is lens and again.readout is readout and cam.ideal(camera).distortion is None
    assert cam.ideal(camera).readout is readout and cam.ideal(camera).f is camera.f


def test_depth_pixels_follow_the_resize_rule_or_the_viewing_ray():
    camera, uv = pinhole(LENSES["tangential"], batch=2), grid(2)
    assert cam.depth_pixels(camera, HW, None, HW, uv) is uv
    small = cam.depth_pixels(camera, HW, None, (120, 320), uv)
    close(small, torch.stack(((uv[..., 0] + 0.5) / 2 - 0.5, (uv[..., 1] + 0.5) / 4 - 0.5), -1))
    other = Camera(double([200.0, 210.0], [190.0, 220.0]), double([100.0, 90.0], [110.0, 80.0]))
    for lens in (None, double(LENSES["pincushion"]).expand(2, -1)):
        depth_camera = other.replace(distortion=lens)
        for depth_hw in (HW, (192, 256)):
            found = cam.depth_pixels(camera, HW, depth_camera, depth_hw, uv)
            close(found, cam.project(depth_camera, cam.rays(camera, uv)))


# ------------------------------------------------------------------------------------------------ shape contracts


X, Y = torch.zeros(2, 5, 3), torch.zeros(3, 5, 3)


@pytest.mark.parametrize(
    ("tensors", "sizes"),
    [
        ({"x": (X, "B N 3"), "missing": (None, "B 7"), "y": (torch.zeros(5), "N")}, {"B": 2, "N": 5}),
        ({"x": (X, "* 3")}, {}),
        ({"x": (X, "* N 3"), "y": (torch.zeros(5), "* N")}, {"N": 5}),
        ({"x": (X, "B N 4")}, r"here: x has shape \(2, 5, 3\), expected \(B N 4\) with B=2, N=5$"),
        ({"x": (X, "B N")}, "expected"),
        ({"x": (X, "B N 3 1")}, "expected"),
        ({"x": (X[0, 0], "* N 3")}, "expected"),
        ({"x": (X, "* 4")}, "expected"),
        ({"x": (X[:, 0], "B B")}, "expected"),
        ({"x": (X, "B N 3"), "y": (Y, "B N 3")}, r"here: y has shape \(3, 5, 3\), expected \(B N 3\) with B=2, N=5$"),
        ({"x": (X, "3 3")}, r"here: x has shape \(2, 5, 3\), expected \(3 3\) with any sizes$"),
        ({"none": (None, "B"), "x": (X, "B 5 3"), "y": (Y, "B 5 3")}, r"y has shape \(3, 5, 3\)"),
    ],
)
def test_equal_letters_are_equal_sizes_or_the_message_names_the_argument(tensors, sizes):
    if isinstance(sizes, dict):
        assert check("here", **tensors) == sizes
        return
    with pytest.raises(ValueError, match=sizes):
        check("here", **tensors)
