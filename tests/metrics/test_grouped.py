"""Means and slopes of values whose errors last over groups, and the similarity of two camera paths."""

import numpy as np
import pytest

from dhtorch.metrics.camera_paths import align_camera_paths, compare_motions, motions_of_path
from dhtorch.metrics.grouped import grouped_slopes, huber_mean, mad_sigma


def test_sigma_of_normal_numbers_and_a_mean_that_outliers_do_not_move():
    x = np.random.default_rng(0).normal(size=2001)
    assert mad_sigma(x) == pytest.approx(1, abs=0.05)
    spoilt = np.r_[x, np.full(200, 50.0)]
    assert abs(huber_mean(spoilt, np.ones(2201))) < 0.25 < abs(spoilt.mean()) and np.isnan(huber_mean(x[:0], x[:0]))


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


def turned_path(n=24, curl=0.0):
    """Cameras 0.1 m apart that turn by ``curl`` rad about y from the first to the last."""
    c2w = np.tile(np.eye(4), (n, 1, 1))
    angle = np.linspace(0, curl, n)
    c2w[:, 0, 0], c2w[:, 0, 2], c2w[:, 2, 0], c2w[:, 2, 2] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    c2w[:, :3, 3] = np.cumsum(0.1 * c2w[:, :3, 0], 0)
    return c2w


def test_length_curl_and_single_cameras_of_a_path():
    exact = motions_of_path(turned_path())
    longer, curled, spoilt = turned_path(), turned_path(curl=0.2), turned_path()
    longer[:, :3, 3] *= 1.06
    assert compare_motions(exact, longer).length == pytest.approx(1.06)
    found = compare_motions(exact, curled)
    np.testing.assert_allclose(found.curl, [0, 0.2, 0], atol=2e-3)
    assert found.length == pytest.approx(1, abs=0.01)
    spoilt[10, 1, 3] += 0.05
    found = compare_motions(exact, spoilt)
    off = (exact.first == 10) | (exact.second == 10)
    np.testing.assert_allclose(found.shift, np.where(off, 0.05, 0), atol=1e-3)
    assert found.length == pytest.approx(1, abs=1e-3) and found.turn.max() < 1e-6
    few = type(exact)(*(x[:2] for x in exact))
    assert (
        compare_motions(few, longer) is None and compare_motions(type(exact)(*(x[:0] for x in exact)), longer) is None
    )


def test_sigma_of_a_length_is_of_the_scatter_along_the_path():
    errors = []
    for seed in range(40):
        path, noise = turned_path(32), np.random.default_rng(seed).normal(size=(32, 3))
        found = compare_motions(
            motions_of_path(path), path + np.pad(0.01 * noise[:, :, None], ((0, 0), (0, 1), (3, 0)))
        )
        errors.append((found.length - 1) / found.length_sigma)
    assert np.mean(np.abs(errors) < 2) > 0.75 and 0.6 < np.std(errors) < 1.7
