"""Means and contrasts of values whose errors last over groups of them: frames, stretches of a recording."""

import numpy as np

#: Stretches of a recording within which errors are common: as many as the jackknife over them takes.
N_STRETCHES = 8


def mad_sigma(
    x: np.ndarray,  # (n, …)
) -> np.ndarray:
    """Standard deviation (…) along the first axis from the median absolute deviation, of normal values: 1 / Phi^-1(3/4)
    times that."""
    return 1.4826 * np.median(np.abs(x - np.median(x, 0)), 0)


def huber_mean(
    x: np.ndarray,  # (n,)
    sigma: np.ndarray,  # (n,)
) -> float:
    """Huber's mean of values with standard deviations, bent at 1.5 of these; NaN of none."""
    mean = float(np.median(x)) if len(x) else np.nan
    for _ in range(20):
        weight = 1 / (sigma * np.maximum(sigma, np.abs(x - mean) / 1.5))
        mean = float((weight * x).sum() / weight.sum()) if len(x) else np.nan
    return mean


def mean_over_stretches(
    x: np.ndarray,  # (F,) one value of each frame, NaN = none
    sigma: np.ndarray,  # (F,)
) -> tuple[float, float]:
    """Huber's mean over frames and its standard deviation.

    The larger of that from sigma and the scatter between frames, and of a jackknife over stretches of the recording.
    """
    has = np.isfinite(x)
    total = np.hypot(sigma, mad_sigma(x[has]))
    mean = huber_mean(x[has], total[has])
    parts = [p for p in np.array_split(np.nonzero(has)[0], min(N_STRETCHES, has.sum())) if len(p)]
    without = [huber_mean(np.delete(x, p)[n], np.delete(total, p)[n]) for p in parts for n in [np.delete(has, p)]]
    n = len(parts)
    jackknife = np.sqrt((n - 1) / n * ((np.array(without) - mean) ** 2).sum()) if n > 1 else np.inf
    return mean, max(float(np.sqrt(1 / (total[has] ** -2).sum())), float(jackknife))


def covariance_of_mean(
    x: np.ndarray,  # (F, n)
) -> np.ndarray:
    """Covariance (n, n) of the mean of rows whose errors last over a stretch of them."""
    means = np.stack([part.mean(0) for part in np.array_split(x, min(N_STRETCHES, len(x)))])
    return np.cov(means.T) / len(means)


def grouped_slopes(
    X: np.ndarray,  # (C, K)
    y: np.ndarray,  # (C,)
    sigma: np.ndarray,  # (C,) of y
    group: np.ndarray,  # (C,) int
    least_scatter: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Slope (K,) of y over every column alone, with an intercept, and its standard deviation from the scatter between
    groups; not below that of independent values of their common scatter, which is at least ``least_scatter``, since
    few groups scatter little by chance."""
    w = 1 / sigma**2
    w = w / w.sum()
    X, y = X - w @ X, y - w @ y
    square = (w[:, None] * X**2).sum(0)
    slope = (w[:, None] * X * y[:, None]).sum(0) / square
    rest = y[:, None] - X * slope
    groups, index = np.unique(group, return_inverse=True)
    score = np.zeros((len(groups), X.shape[1]))
    np.add.at(score, index, w[:, None] * X * rest)
    clustered = (score**2).sum(0) * len(groups) / max(len(groups) - 1, 1)
    independent = ((w[:, None] * X) ** 2).sum(0) * np.maximum(mad_sigma(rest), least_scatter) ** 2
    return slope, np.sqrt(np.maximum(clustered, independent)) / square
