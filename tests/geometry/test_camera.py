"""Cameras against OpenCV, kornia, finite differences and the definition of a pixel; shape contracts."""

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera import PinholeCamera

from dhtorch.geometry import camera as cam
from dhtorch.geometry.camera import Camera
from dhtorch.geometry.checks import all_finite, all_known, any_possible, check, is_static

HW = (480, 640)

#: Lenses of every supported number of coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6]].
LENSES = {
    "wide barrel": [-0.28, 0.09, 0.0, 0.0],
    "pincushion": [0.15, 0.06, 0.0, 0.0, 0.02],
    "tangential": [-0.05, 0.02, 0.02, -0.013],
    "third order": [0.03, -0.05, 0.001, -0.002, 0.04],
    "rational": [0.9, 0.25, -0.002, 0.003, 0.02, 1.1, 0.4, 0.06],
}

lenses = pytest.mark.parametrize("lens", LENSES.values(), ids=list(LENSES))


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def pinhole(lens=None, batch=1):
    """Cameras with oblong pixels and a principal point off the middle; the second has another K."""
    f, c = double([300.0, 330.0], [410.0, 380.0])[:batch], double([310.5, 250.0], [333.0, 221.5])[:batch]
    return Camera(f, c, None if lens is None else double(*lens).expand(batch, -1))


def grid(batch=1, margin=20.0):
    """Pixels (B, 35, 2) over the whole picture, corners included."""
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
def test_projection_is_that_of_opencv(lens):
    """Each camera of a batch with its own K."""
    camera = pinhole(lens, batch=2)
    generator = np.random.default_rng(0)
    xyz = np.concatenate((generator.uniform(-0.7, 0.7, (2, 20, 2)), np.ones((2, 20, 1))), -1)
    xyz = xyz * generator.uniform(0.4, 5, (2, 20, 1))
    ours = cam.project(camera, torch.from_numpy(xyz))
    for b in range(2):
        theirs, _ = cv2.projectPoints(xyz[b], np.zeros(3), np.zeros(3), *numpys(camera, b))
        close(ours[b], torch.from_numpy(theirs[:, 0]))


def test_projection_is_that_of_kornia():
    camera = pinhole(batch=2)
    K = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    K[:, :3, :3] = cam.to_matrix(camera)
    eye, hw = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), [torch.full((2,), float(n)) for n in HW]
    xyz = double([[0.3, -0.2, 2.0], [-1.0, 0.5, 4.0]], [[0.1, 0.7, 1.0], [2.0, 0.4, 3.0]])
    close(cam.project(camera, xyz), PinholeCamera(K, eye, *hw).project(xyz))


def test_projection_keeps_away_from_zero_depth_and_leaves_signs_alone():
    camera = pinhole()
    at = lambda z: cam.project(camera, double([[0.3, -0.2, z]]))  # noqa: E731
    for z in (0.0, 5e-10, -5e-10):
        assert torch.equal(at(z), at(1e-9)), "|z| below 1e-9 m counts as 1e-9 m in front"
    for z in (2e-9, -2e-9, -2.0):
        close(at(z), camera.c[:, None] + camera.f * double([[0.3, -0.2]]) / z, atol=0)
    xyz = double([[0.3, -0.2, 0.0]]).requires_grad_()
    cam.project(camera, xyz).sum().backward()
    assert xyz.grad.isfinite().all()


def test_unprojected_points_have_that_depth_and_project_onto_their_pixels():
    for lens in (None, LENSES["tangential"]):
        camera, uv = pinhole(lens, batch=2), grid(2)
        depth = torch.linspace(-3, 9, 70, dtype=torch.float64).view(2, 35)
        xyz = cam.unproject(camera, uv, depth)
        assert torch.equal(xyz[..., 2], depth)
        close(cam.project(camera, xyz), uv)
        close(cam.rays(camera, uv), xyz / depth[..., None])


@pytest.mark.parametrize("lens", [None, LENSES["tangential"]], ids=["ideal", "lens"])
@pytest.mark.parametrize(
    "linear", [[[-1.0, 0], [0, 1]], [[0, -1.0], [1, 0]], [[1.5, 0], [0, 2]], [[-0.8, 0.6], [0.6, 0.8]]]
)
def test_the_camera_of_a_moved_picture_sees_the_turned_point_at_the_moved_pixel(linear, lens):
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


def test_matrices_hold_focal_lengths_and_centre():
    K = double(
        [[300.0, 0.0, 310.5], [0.0, 330.0, 250.0], [0.0, 0.0, 1.0]], [[410.0, 0, 333.0], [0, 380.0, 221.5], [0, 0, 1]]
    )
    lens, readout = double([0.1, 0, 0, 0], [0.2, 0, 0, 0]), double(0.01, 0.02)
    camera = cam.from_matrix(K, lens, readout)
    assert torch.equal(camera.f, pinhole(batch=2).f) and torch.equal(camera.c, pinhole(batch=2).c)
    assert torch.equal(cam.to_matrix(camera), K)
    assert camera.distortion is lens and camera.readout is readout
    assert cam.from_matrix(K).distortion is None and cam.from_matrix(K).readout is None
    assert cam.ideal(camera).distortion is None and cam.ideal(camera).readout is readout
    assert cam.ideal(camera).f is camera.f and cam.ideal(camera).c is camera.c


# ------------------------------------------------------------------------------------------------ lens


@lenses
def test_undistorted_pixels_are_those_of_opencv(lens):
    camera, uv = pinhole(lens), grid()
    K, numbers = numpys(camera)
    exact = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    theirs = cv2.undistortPoints(uv[0].numpy(), K, numbers, P=K, criteria=exact)
    close(cam.undistort(camera, uv)[0], torch.from_numpy(theirs[:, 0]), atol=1e-8)


@lenses
def test_lens_is_that_of_kornia_both_ways(lens):
    camera, uv = pinhole(lens, batch=2), grid(2)
    K, ideal = cam.to_matrix(camera), cam.undistort(camera, uv)
    close(cam.distort(camera, ideal), distort_points(ideal, K, camera.distortion))
    close(ideal, undistort_points(uv, K, camera.distortion, num_iters=100), atol=1e-8)
    close(cam.distort(camera, ideal), uv)


def test_lenses_of_one_batch_stay_apart():
    lens = double(LENSES["tangential"], LENSES["wide barrel"])
    both = pinhole(batch=2).replace(distortion=lens)
    ideal = cam.undistort(both, grid(2))
    jacobian = cam.undistort_jacobian(both, ideal)
    for b in range(2):
        K, numbers = numpys(both, b)
        theirs, _ = cv2.projectPoints(cam.rays(both, grid(2))[b].numpy(), np.zeros(3), np.zeros(3), K, numbers)
        close(torch.from_numpy(theirs[:, 0]), grid()[0])
        assert torch.equal(cam.undistort(both[b : b + 1], grid())[0], ideal[b])
        assert torch.equal(cam.undistort_jacobian(both[b : b + 1], ideal[b : b + 1])[0], jacobian[b])


@pytest.mark.parametrize("count", [1, 2, 3, 6, 7, 9, 12, 14])
def test_a_lens_with_another_number_of_coefficients_is_refused(count):
    camera = pinhole([0.01] * count)
    xyz = double([[0.1, 0.2, 1.0]])
    for call in (
        lambda: cam.project(camera, xyz),
        lambda: cam.distort(camera, grid()),
        lambda: cam.undistort(camera, grid()),
        lambda: cam.undistort_jacobian(camera, grid()),
    ):
        with pytest.raises(ValueError, match=rf"{count} coefficients, expected one of \(4, 5, 8\)"):
            call()


@lenses
def test_undistort_jacobian_against_finite_differences(lens):
    camera, uv, h = pinhole(lens, batch=2), grid(2), 1e-3
    steps = [double([h, 0.0]), double([0.0, h])]
    slope = torch.stack([cam.undistort(camera, uv + s) - cam.undistort(camera, uv - s) for s in steps], -1) / (2 * h)
    torch.testing.assert_close(cam.undistort_jacobian(camera, cam.undistort(camera, uv)), slope, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("lens", [LENSES["tangential"], LENSES["rational"]])
def test_undistort_differentiates_to_pixels_intrinsics_and_lens(lens):
    camera = pinhole(lens)

    def call(uv, f, c, k):
        return cam.undistort(Camera(f, c, k), uv)

    inputs = (grid(margin=60.0)[:, [0, 9, 20]], camera.f, camera.c, camera.distortion)
    assert torch.autograd.gradcheck(call, tuple(x.clone().requires_grad_() for x in inputs), rtol=1e-5, atol=1e-6)


def test_without_a_lens_pixels_stay_and_the_jacobian_is_one():
    camera, uv = pinhole(batch=2), grid(2)
    assert cam.undistort(camera, uv) is uv and cam.distort(camera, uv) is uv
    assert torch.equal(cam.undistort_jacobian(camera, uv), torch.eye(2, dtype=torch.float64).expand(2, 35, 2, 2))


def test_a_pixel_beyond_the_fold_of_the_lens_is_nan_and_spoils_no_gradient():
    """r (1 − 0.3 r²) rises to 0.70 and falls again: nothing is seen at 0.8."""
    camera = Camera(double([100.0, 100.0]), double([0.0, 0.0]), double([-0.3, 0.0, 0.0, 0.0]))
    wanted = [x.requires_grad_() for x in (camera.f, camera.c, camera.distortion)]
    uv = double([[80.0, 0.0], [60.0, 10.0], [0.0, -75.0]]).requires_grad_()
    found = cam.undistort(camera, uv)
    assert found.isnan().all(-1).tolist() == [[True, False, True]]
    found[0, 1].sum().backward()
    assert all(x.grad.isfinite().all() and x.grad.any() for x in (uv, *wanted))


def test_default_steps_suffice_close_to_the_fold():
    camera = Camera(double([300.0, 300.0]), double([0.0, 0.0]), double([-0.3, 0.0, 0.0, 0.0]))
    ideal = double([[0.999 * 300 / 0.9**0.5, 0.0]])  # the fold is at 1 / √0.9
    close(cam.undistort(camera, cam.distort(camera, ideal)), ideal, atol=1e-6)
    across, along = 1 / (1 - 0.3 * 0.999**2 / 0.9), 1 / (1 - 0.999**2)  # of r (1 − 0.3 r²)
    close(cam.undistort_jacobian(camera, ideal)[0, 0], torch.diag(double(along, across)))


def test_a_pixel_is_solved_when_it_returns_to_within_a_hundredth_of_a_pixel():
    """Newton's steps written out for pixels on the two axes, under focal lengths far apart."""
    f, k1 = double(50.0, 5000.0), -0.25
    camera = Camera(f[None], double([0.0, 0.0]), double([k1, 0.0, 0.0, 0.0]))
    target = torch.linspace(0.02, 0.74, 37, dtype=torch.float64)
    for axis in range(2):
        uv = torch.zeros(1, 37, 2, dtype=torch.float64)
        uv[..., axis] = target * f[axis]
        for iterations in range(5):
            x = target.clone()
            for _ in range(iterations):
                x = x - (x + k1 * x**3 - target) / (1 + 3 * k1 * x**2)
            solved = (x + k1 * x**3 - target).abs() * 5000 < 0.01
            found = cam.undistort(camera, uv, iterations=iterations)
            assert torch.equal(found[0, :, axis].isfinite(), solved)
            last = x - (x + k1 * x**3 - target) / (1 + 3 * k1 * x**2)
            close(found[0, solved, axis], (last * f[axis])[solved])


def test_a_singular_lens_leaves_finite_numbers():
    """r (1 − r²): at r = 1 the whole ring is seen in the middle, and the determinant is zero."""
    camera = Camera(double([128.0, 128.0]), double([0.0, 0.0]), double([-1.0, 0.0, 0.0, 0.0]))
    assert cam.undistort_jacobian(camera, double([[128.0, 0.0], [0.0, -128.0]])).isfinite().all()


# ------------------------------------------------------------------------------------------------ pictures


@pytest.mark.parametrize("new_hw", [(120, 320), (480, 160), (960, 640), (37, 53)])
def test_resized_camera_sees_where_opencv_puts_the_pixels(new_hw):
    """A picture of its own coordinates says from where each new pixel came."""
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


def test_borders_of_the_picture_stay_borders_when_it_is_resized():
    camera = cam.resize(pinhole(), HW, (60, 160))
    ray = lambda c, u, v: (double(u, v) - c.c[0]) / c.f[0]  # noqa: E731
    close(ray(camera, -0.5, -0.5), ray(pinhole(), -0.5, -0.5))
    close(ray(camera, 159.5, 59.5), ray(pinhole(), 639.5, 479.5))


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
            for b in range(2):
                rays = cam.rays(camera, uv)[b].numpy()
                theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), *numpys(depth_camera, b))
                close(found[b], torch.from_numpy(theirs[:, 0]))


@pytest.mark.parametrize(
    "call",
    [
        lambda one, uv: cam.project(one, torch.zeros(2, 35, 3)),
        lambda one, uv: cam.unproject(one, uv, torch.ones(2, 35)),
        lambda one, uv: cam.unproject(pinhole(batch=2), uv, torch.ones(2, 34)),
        lambda one, uv: cam.unproject(pinhole(batch=2), uv, torch.ones(2, 1)),
        cam.rays,
        cam.distort,
        cam.undistort,
        cam.undistort_jacobian,
        lambda one, uv: cam.from_matrix(torch.eye(3).expand(2, 3, 3), torch.zeros(1, 4)),
        lambda one, uv: cam.from_matrix(torch.eye(4).expand(2, 4, 4)),
    ],
)
def test_nothing_is_repeated_to_fit(call):
    """One camera for the points of two views, or one depth for all points, is a mistake and no broadcast."""
    with pytest.raises(ValueError, match=r"camera.*expected"):
        call(pinhole(), grid(2))


def test_whole_numbers_of_a_picture_are_taken_in_the_camera_s_precision():
    assert cam.resize(pinhole().to(torch.float32), HW, (100, 100)).f.dtype == torch.float32
    assert cam.depth_pixels(pinhole(), HW, None, (100, 100), grid().float()).dtype == torch.float32


# ------------------------------------------------------------------------------------------------ shape contracts


def test_equal_letters_are_equal_sizes_and_the_sizes_come_back():
    x, y = torch.zeros(2, 5, 3), torch.zeros(5)
    assert check("here", x=(x, "B N 3"), missing=(None, "B 7"), y=(y, "N")) == {"B": 2, "N": 5}
    assert check("here", x=(x, "* 3")) == {} and check("here", y=(y, "*")) == {}
    assert check("here", x=(x, "* N 3"), y=(y, "* N")) == {"N": 5}


@pytest.mark.parametrize(
    ("shape", "pattern"),
    [
        ((2, 5, 4), "B N 3"),
        ((2, 5), "B N 3"),
        ((2, 5, 3, 1), "B N 3"),
        ((3,), "* N 3"),
        ((5, 4), "* 3"),
        ((2, 3), "B B"),
    ],
)
def test_another_shape_raises(shape, pattern):
    with pytest.raises(ValueError, match="expected"):
        check("here", x=(torch.zeros(shape), pattern))


def test_the_message_names_place_argument_shape_and_what_is_bound():
    x, y = torch.zeros(2, 5, 3), torch.zeros(3, 5, 3)
    with pytest.raises(ValueError, match=r"here: y has shape \(3, 5, 3\), expected \(B N 3\) with B=2, N=5$"):
        check("here", x=(x, "B N 3"), y=(y, "B N 3"))
    with pytest.raises(ValueError, match=r"here: x has shape \(2, 5, 3\), expected \(3 3\) with any sizes$"):
        check("here", x=(x, "3 3"))
    with pytest.raises(ValueError, match=r"x has shape \(2, 5, 3\), expected \(\* 4 3\)"):
        check("here", x=(x, "* 4 3"))
    with pytest.raises(ValueError, match=r"y has shape \(3, 5, 3\)"):
        check("here", none=(None, "B"), x=(x, "B 5 3"), y=(y, "B 5 3"))


def test_shapes_are_static_in_graphs_and_transforms_only():
    x = torch.zeros(3, 2)
    seen = []

    def look(v):
        seen.append(is_static(v))
        return v + 1

    look(x)
    torch.func.vmap(look)(x)
    torch.func.grad(lambda v: look(v).sum())(x)
    assert seen == [False, True, True]
    torch._dynamo.reset()
    captured = torch.compile(lambda v: v + 1 if is_static(v) else v - 1, fullgraph=True, backend="eager")
    assert torch.equal(captured(x), x + 1)


def test_masks_are_looked_at_where_they_have_values_alone():
    all_, some, none = torch.tensor([True, True]), torch.tensor([True, False]), torch.tensor([False, False])
    assert [all_known(x) for x in (all_, some, none)] == [True, False, False]
    assert [any_possible(x) for x in (all_, some, none)] == [True, True, False]
    told = []
    torch.vmap(lambda x: (told.append((all_known(x), any_possible(x))), x)[1])(none[None])
    assert told == [(False, True)]


def test_one_number_that_is_none_is_seen():
    x = torch.tensor(
        [[1.0, -3e38, 0.0], [torch.nan, 1, 1], [1, torch.inf, 1], [1, 1, -torch.inf], [-torch.inf, torch.nan, 0]]
    )
    for dim in (0, 1):
        assert torch.equal(all_finite(x, dim), x.isfinite().all(dim))
    assert all_finite(x, 1).tolist() == [True, False, False, False, False] and all_finite(x[:0], 1).shape == (0,)
