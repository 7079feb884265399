"""Losses: values of plain formulas, gradients by gradcheck, and exact zeros where an element does not count; soft ranks
against the area of the metrics."""

import math

import pytest
import torch

from dhtorch.functional import reprojection_loss, risk_coverage_loss, sigma_weighted_depth_loss
from dhtorch.geometry import camera as cam
from dhtorch.geometry import se3
from dhtorch.metrics.risk import risk_curve
from dhtorch.records import Camera, Pose

D = torch.float64
NAN, INF = math.nan, math.inf
KERNELS = (None, "huber", "cauchy", "geman_mcclure")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def view(batch=2, n=7, lens=False):
    """Depths, pixels in both views with half a pixel of noise, pose, cameras and covariances."""
    g = generator()
    depth = 1.5 + torch.rand(batch, n, generator=g, dtype=D)
    uv_0 = 20 + 120 * torch.rand(batch, n, 2, generator=g, dtype=D)
    T = se3.exp(0.1 * torch.randn(batch, 6, generator=g, dtype=D))
    distortion = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=D).expand(batch, 5) if lens else None
    cameras = [Camera(*(torch.full((batch, 2), x, dtype=D) for x in (f, 80.0)), distortion) for f in (120.0, 130.0)]
    uv_1 = pixels(depth, uv_0, T, *cameras) + 0.5 * torch.randn(batch, n, 2, generator=g, dtype=D)
    root = torch.randn(batch, n, 2, 2, generator=g, dtype=D)
    return (depth, uv_0, uv_1, T, *cameras), root @ root.mT + 0.1 * torch.eye(2, dtype=D)


def pixels(depth, uv_0, T, camera_0, camera_1):
    return cam.project(camera_1, se3.apply(T, cam.unproject(camera_0, uv_0, depth)))


@pytest.mark.parametrize(
    ("kernel", "rho"),
    [
        (None, lambda s: s),
        ("huber", lambda s: torch.where(s > 4, 4 * s.sqrt() - 4, s)),
        ("cauchy", lambda s: 4 * (1 + s / 4).log()),
        ("geman_mcclure", lambda s: s / (1 + s / 4)),
    ],
)
def test_depth_loss_is_the_mean_cost_of_residuals_over_sigma(kernel, rho):
    p, t = (1 + torch.rand(2, 3, 5, generator=generator(k), dtype=D) for k in (0, 1))
    sigma = 0.05 + 0.3 * torch.rand(2, 3, 5, generator=generator(2), dtype=D)
    keep = torch.rand(2, 3, 5, generator=generator(3)) < 0.7
    each = rho(((p - t) / sigma) ** 2) * keep
    loss = {r: sigma_weighted_depth_loss(p, t, sigma, keep, kernel=kernel, scale=2.0, reduction=r) for r in REDUCTIONS}
    torch.testing.assert_close(loss["none"], each)
    torch.testing.assert_close(loss["sum"], each.sum())
    torch.testing.assert_close(loss["mean"], each.sum() / keep.sum())


REDUCTIONS = ("none", "sum", "mean")


@pytest.mark.parametrize("kernel", KERNELS)
def test_depth_loss_gradcheck(kernel):
    g = generator()
    p, t = ((1 + torch.rand(2, 6, generator=g, dtype=D)).requires_grad_() for _ in range(2))
    sigma = torch.full((2, 6), 0.1, dtype=D)
    keep = torch.rand(2, 6, generator=g) < 0.7
    assert torch.autograd.gradcheck(lambda p, t: sigma_weighted_depth_loss(p, t, sigma, keep, kernel=kernel), (p, t))


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_has_no_label_costs_nothing_and_has_no_gradient(kernel):
    values = [  # prediction, target, sigma, keep
        *[(1.5, bad, 0.1, True) for bad in (NAN, INF, 0.0, -1.0)],
        *[(1.5, 2.0, bad, True) for bad in (NAN, INF, 0.0, -0.1)],
        *[(bad, 2.0, 0.1, False) for bad in (NAN, INF, 1.0)],
        (1.0, 1.0, 0.1, True),
        (1.1, 1.0, 0.1, True),
    ]
    p, t, sigma = (torch.tensor([v[k] for v in values], dtype=D, requires_grad=True) for k in range(3))
    keep = torch.tensor([v[3] for v in values])
    each = sigma_weighted_depth_loss(p, t, sigma, keep, kernel=kernel, reduction="none")
    assert each[:-1].eq(0).all() and each[-1] > 0
    loss = sigma_weighted_depth_loss(p, t, sigma, keep, kernel=kernel)
    torch.testing.assert_close(loss, each.sum() / 2)
    loss.backward()
    for x in (p, t):
        assert x.grad[:-1].eq(0).all() and x.grad[-1].isfinite() and x.grad[-1] != 0
    assert sigma.grad is None


def test_without_labels_the_loss_is_zero_and_a_prediction_that_diverged_shows():
    p = torch.ones(3, requires_grad=True)
    loss = sigma_weighted_depth_loss(p, torch.full((3,), NAN), torch.ones(3))
    loss.backward()
    assert loss == 0 and p.grad.eq(0).all()
    assert sigma_weighted_depth_loss(torch.tensor([NAN]), torch.ones(1), torch.ones(1)).isnan()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": torch.ones(2)}, "expected equal ones"),
        ({"keep": torch.zeros(3, dtype=torch.int32)}, "expected bool"),
        ({"reduction": "median"}, "reduction is 'median'"),
        ({"kernel": "tukey"}, "kernel is 'tukey'"),
    ],
)
def test_depth_loss_refuses(change, message):
    call = {"prediction": torch.ones(3), "target": torch.ones(3), "sigma": torch.ones(3)} | change
    with pytest.raises(ValueError, match=message):
        sigma_weighted_depth_loss(**call)


@pytest.mark.parametrize("lens", [False, True])
def test_reprojection_loss_is_the_mean_squared_mahalanobis_distance(lens):
    geometry, cov = view(lens=lens)
    depth, uv_0, uv_1, T, *cameras = geometry
    r = uv_1 - pixels(depth, uv_0, T, *cameras)
    each = (r[..., None, :] @ torch.linalg.inv(cov) @ r[..., None])[..., 0, 0]
    torch.testing.assert_close(reprojection_loss(*geometry, cov=cov, reduction="none"), each)
    torch.testing.assert_close(reprojection_loss(*geometry, cov=cov), each.mean())
    torch.testing.assert_close(reprojection_loss(*geometry), r.square().sum(-1).mean())
    keep = torch.rand(each.shape, generator=generator(1)) < 0.6
    torch.testing.assert_close(reprojection_loss(*geometry, cov=cov, keep=keep), each[keep].mean())


@pytest.mark.parametrize("kernel", KERNELS)
def test_reprojection_loss_gradcheck(kernel):
    (depth, uv_0, uv_1, T, *cameras), cov = view(batch=1, n=3, lens=True)
    values = depth, uv_0, uv_1, torch.zeros(1, 6, dtype=D), *(x for c in cameras for x in (c.f, c.c, c.distortion))

    def loss(depth, uv_0, uv_1, xi, *intrinsics):
        both = Camera(*intrinsics[:3]), Camera(*intrinsics[3:])
        return reprojection_loss(depth, uv_0, uv_1, se3.retract(T, xi), *both, cov=cov, kernel=kernel, scale=2.0)

    assert torch.autograd.gradcheck(loss, [x.clone().requires_grad_() for x in values])


@pytest.mark.parametrize("lens", [False, True])
@pytest.mark.parametrize("kernel", KERNELS)
def test_points_that_do_not_count_have_no_gradient(kernel, lens):
    """Masked, without depth or pixel, behind the camera, with a singular or missing covariance, outside the lens model;
    and a pair without a pose."""
    (depth, uv_0, uv_1, T, *cameras), cov = view(n=12, lens=lens)
    keep = torch.ones(2, 12, dtype=torch.bool)
    keep[0, 0], depth[0, 1], depth[0, 2], uv_1[0, 3], uv_0[0, 4] = False, NAN, 0, INF, NAN
    cov[0, 5], cov[0, 6] = 0, NAN
    T = Pose(T.R, T.t.clone())
    T.t[0, 2] = -2.0
    depth[0, 7], depth[0, 8:] = 0.5, 4.0  # behind camera 1, and before it
    if lens:
        uv_0[0, 8] = 1e5
    T.R[1], T.t[1] = NAN, NAN
    leaves = [x.detach().clone().requires_grad_() for x in (depth, uv_0, uv_1, T.R, T.t, cov)]
    depth, uv_0, uv_1, R, t, cov = leaves
    cameras = [c.map(lambda x: x.clone().requires_grad_()) for c in cameras]
    options = {"cov": cov, "keep": keep, "kernel": kernel, "scale": 2.0, "reduction": "none"}
    each = reprojection_loss(depth, uv_0, uv_1, Pose(R, t), *cameras, **options)
    first = 9 if lens else 8
    assert each[0, :first].eq(0).all() and each[1].eq(0).all() and each[0, first:].gt(0).all()
    each.sum().backward()
    assert cov.grad is None
    for x in (depth, uv_0, uv_1):
        assert x.grad[0, :first].eq(0).all() and x.grad[1].eq(0).all() and x.grad[0, first:].isfinite().all()
    for x in (R, t, *(x for c in cameras for x in (c.f, c.c))):
        assert x.grad[0].isfinite().all() and x.grad[0].ne(0).any() and x.grad[1].eq(0).all()


def test_reprojection_loss_refuses_wrong_shapes_and_codes():
    (depth, uv_0, uv_1, *rest), _ = view()
    with pytest.raises(ValueError, match="uv_1"):
        reprojection_loss(depth, uv_0, uv_1[:, :-1], *rest)
    with pytest.raises(ValueError, match="expected bool"):
        reprojection_loss(depth, uv_0, uv_1, *rest, keep=torch.zeros(2, 7, dtype=torch.int32))


# --- risk and coverage ---


def answers(n=60, sets=3):
    g = torch.Generator().manual_seed(5)
    return (torch.rand(sets, n, generator=g, dtype=torch.float64) for _ in range(2))


def test_hard_ranks_give_the_area_of_the_metrics():
    confidence, error = answers()
    area = torch.stack([risk_curve(e, c).mean() for c, e in zip(confidence, error, strict=True)])
    torch.testing.assert_close(risk_coverage_loss(confidence, error, temperature=1e-7), area)


def test_answers_that_do_not_count_change_nothing_and_get_no_gradient():
    confidence, error = answers()
    keep = torch.arange(60) < 40
    padded_c, padded_e = (torch.where(keep, x, float("nan")).requires_grad_() for x in (confidence, error))
    loss = risk_coverage_loss(padded_c, padded_e, keep.expand(3, -1))
    assert risk_coverage_loss(confidence, error, (keep & ~keep).expand(3, -1)).eq(0).all()
    torch.testing.assert_close(loss, risk_coverage_loss(confidence[:, :40], error[:, :40]))
    loss.sum().backward()
    for x in (padded_c, padded_e):
        assert x.grad.isfinite().all() and (x.grad[:, 40:] == 0).all() and (x.grad[:, :40] != 0).all()


def test_an_error_above_1_counts_as_1_and_has_no_gradient():
    confidence, error = answers()
    error = (3 * error).requires_grad_()
    loss = risk_coverage_loss(confidence, error)
    torch.testing.assert_close(loss, risk_coverage_loss(confidence, error.clamp(max=1)))
    loss.sum().backward()
    assert torch.equal(error.grad > 0, error < 1)


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan")])
def test_a_temperature_is_positive(temperature):
    with pytest.raises(ValueError, match="temperature is"):
        risk_coverage_loss(*answers(), temperature=temperature)
