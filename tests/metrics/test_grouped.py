"""Means and slopes of values whose errors last over groups, and the similarity of two camera paths."""

import numpy as np
import pytest

from dhtorch.metrics.camera_paths import align_camera_paths, scale_of_camera_paths
from dhtorch.metrics.grouped import covariance_of_mean, grouped_slopes, huber_mean, mad_sigma, mean_over_stretches


def test_sigma_of_normal_numbers_and_a_mean_that_outliers_do_not_move():
    x = np.random.default_rng(0).normal(size=2001)
    assert mad_sigma(x) == pytest.approx(1, abs=0.05)
    spoilt = np.r_[x, np.full(200, 50.0)]
    assert abs(huber_mean(spoilt, np.ones(2201))) < 0.25 < abs(spoilt.mean()) and np.isnan(huber_mean(x[:0], x[:0]))


def test_sigma_of_a_mean_falls_with_the_root_of_the_number_of_frames():
    mean, sigma = mean_over_stretches(np.full(25, 2.0), np.full(25, 0.1))
    assert mean == pytest.approx(2.0) and sigma == pytest.approx(0.1 / 5)


def test_sigma_of_a_mean_covers_errors_that_last_over_a_stretch():
    draw = np.random.default_rng(0)
    within = []
    for _ in range(100):
        x = np.repeat(draw.normal(size=8), 6) + 0.1 * draw.normal(size=48)
        mean, sigma = mean_over_stretches(x, np.full(48, 0.1))
        within.append(abs(mean) < 2 * sigma)
    assert np.mean(within) > 0.8
    assert covariance_of_mean(np.repeat(draw.normal(size=(8, 2)), 6, 0)).shape == (2, 2)


def test_slopes_are_found_with_the_scatter_between_groups():
    draw = np.random.default_rng(0)
    group, x = np.repeat(np.arange(30), 10), draw.uniform(-0.5, 0.5, 300)
    y = 0.3 * x + 0.01 * draw.normal(size=30)[group] + 0.01 * draw.normal(size=300)
    slope, sigma = grouped_slopes(np.stack((x, group / 29), 1), y, np.full(300, 0.01), group, 0.0)
    assert abs(slope[0] - 0.3) < 3 * sigma[0] and abs(slope[1]) < 3 * sigma[1]
    assert sigma[1] > 2 * 0.014 / 300**0.5  # errors common to a group do not average out over its members
    moved = grouped_slopes(np.stack((x + 5, group / 29 - 2), 1), y + 1, np.full(300, 0.01), group, 0.0)
    np.testing.assert_allclose(moved, (slope, sigma), rtol=1e-9, atol=1e-12, err_msg="an intercept is fitted")


def test_a_similarity_of_camera_paths():
    draw = np.random.default_rng(0)
    R = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    R = R * np.linalg.det(R)
    other = np.tile(np.eye(4), (12, 1, 1))
    other[:, :3, 3] = draw.normal(size=(12, 3))
    own = other.copy()
    own[:, :3, :3], own[:, :3, 3] = R @ other[:, :3, :3], 2.5 * other[:, :3, 3] @ R.T + [1, 2, 3]
    found, t, cov = align_camera_paths(own, other, 2.5, 0.01)
    np.testing.assert_allclose(found, R, atol=1e-9)
    np.testing.assert_allclose(t, [1, 2, 3], atol=1e-9)
    assert cov.shape == (7, 7) and cov[6, 6] == pytest.approx(1e-4)
    assert scale_of_camera_paths(own, other)[0] == pytest.approx(2.5)
    assert scale_of_camera_paths(own[:1], other[:1]) is None
