"""Changes of the mean of a series of vectors: binary segmentation."""

import torch
from torch import Tensor

from dhtorch.geometry.checks import check

#: Fewest values before and after a change. Source: derived, two show a level, one an outlier.
MIN_SEGMENT = 2


def median_of_three(
    x: Tensor,  # (k, n)
) -> Tensor:
    """Medians (k, n) of three neighbours: lasting changes stay, a single outlier disappears. Gradient: none."""
    check("median_of_three", x=(x, "k n"))
    middle = x.unfold(1, 3, 1).median(-1).values
    return torch.cat([middle[:, :1], middle, middle[:, -1:]], 1)


def mean_changes(
    x: Tensor,  # (k, n)
    limit: float,
) -> list[tuple[int, int, int]]:
    """Series of vectors with unit noise -> (low, place, high) of every change of the mean at ``place`` within [low,
    high), by halving where the means on both sides differ most.

    Args:
        x: the series.
        limit: squared difference in standard deviations that makes a change, e.g. a quantile of chi².

    Gradient: none.
    """
    check("mean_changes", x=(x, "k n"))
    changes, parts = [], [(0, x.shape[1])]
    while parts:
        low, high = parts.pop()
        n = high - low
        if n < 2 * MIN_SEGMENT:
            continue
        k = torch.arange(MIN_SEGMENT, n - MIN_SEGMENT + 1)
        sums = x[:, low:high].cumsum(1)
        left, right = sums[:, k - 1] / k, (sums[:, -1:] - sums[:, k - 1]) / (n - k)
        gain = (right - left).square().sum(0) * (k * (n - k) / n)
        if float(gain.max()) > limit:
            place = low + int(k[int(gain.argmax())])
            changes.append((low, place, high))
            parts += [(low, place), (place, high)]
    return sorted(changes, key=lambda change: change[1])
