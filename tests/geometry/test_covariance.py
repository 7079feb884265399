"""What normal equations say about an estimate, against numpy."""

import numpy as np
import pytest
import torch

from dhtorch.geometry import covariance

D = torch.float64


def positive(n, batch=2, seed=0):
    A = torch.randn(batch, n, n + 2, generator=torch.Generator().manual_seed(seed), dtype=D)
    return A @ A.mT


def test_the_covariance_is_the_inverse_times_the_variance():
    H, sigma = positive(6, 3), torch.tensor([0.5, 3.0, 2.0], dtype=D)
    H[1, 0], H[1, :, 0] = 0, 0
    cov, ok = covariance.covariance_from_normal(H, sigma)
    assert ok.tolist() == [True, False, True] and (cov[1] == 0).all()
    for b in (0, 2):
        np.testing.assert_allclose(cov[b], float(sigma[b]) ** 2 * np.linalg.inv(H[b].numpy()), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("values", "used", "wanted"),
    [
        ([3.0, 1.0, 2.0], [1, 1, 1], 2.0),
        ([4.0, 1.0, 2.0, 3.0], [1, 1, 1, 1], 2.0),  # the lower of the middle two
        ([9.0, 1.0, 0.0, 3.0], [0, 1, 0, 1], 1.0),
        ([9.0, float("nan"), 5.0, 3.0], [1, 0, 1, 1], 5.0),
        ([9.0, 5.0], [0, 0], 1.0),
        ([], [], 1.0),
    ],
)
def test_the_median_of_the_used(values, used, wanted):
    found = covariance.masked_median(torch.tensor([values], dtype=D), torch.tensor([used], dtype=torch.bool))
    assert found.tolist() == [[wanted]]


@pytest.mark.parametrize("isotropic", [0.0, 0.3, 1.0])
def test_shapes_are_covariances_over_the_median_of_their_mean_variance(isotropic):
    """Unused ones and those that are no covariance count for nothing and are round."""
    cov = torch.stack((positive(2, 10), 7 * positive(2, 10, seed=1)))
    used = torch.ones(2, 10, dtype=torch.bool)
    used[0, 2] = False
    cov[0, 5] = torch.tensor([[0.5, -0.4], [-0.4, 0.5]], dtype=D)  # correlated, and yet a covariance
    cov[0, 6] = cov[0, 5].abs()
    nan, inf = torch.nan, torch.inf
    bad = [[[1, 0], [0, -1]], [[-1, 0], [0, 1]], [[1, -2], [-2, 1]], [[1, 1], [1, 1]], [[nan, 0], [0, 1]]]
    bad += [[[inf, 0], [0, 1]], [[0, 0], [0, 1]], [[1, 0], [0, 0]], [[1, 0], [0, inf]]]
    cov[1, :9] = torch.tensor(bad, dtype=D)
    shape, good = covariance.noise_shape(cov, used, isotropic), used.clone()
    good[1, :9] = False
    for b in range(2):
        size = 0.5 * cov[b, good[b]].diagonal(dim1=-2, dim2=-1).sum(-1)
        wanted = torch.eye(2, dtype=D).repeat(10, 1, 1)
        wanted[good[b]] = (1 - isotropic) * cov[b, good[b]] / size.median() + isotropic * torch.eye(2, dtype=D)
        torch.testing.assert_close(shape[b], wanted)
