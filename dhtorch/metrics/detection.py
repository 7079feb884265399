"""Detection metrics: how well a score separates wrong from right."""

from torch import Tensor

from dhtorch.geometry.checks import check


def auroc(
    score: Tensor,  # (N,) larger = more likely wrong
    wrong: Tensor,  # (N,) bool
) -> float | None:
    """Area under the ROC curve: the probability that a wrong one scores above a right one, ties counting half.

    None if all are wrong or all are right. Gradient: none.

    Raises:
        ValueError: wrong shapes.

    Source: J. A. Hanley, B. J. McNeil, "The meaning and use of the area under a ROC curve", 1982.
    """
    check("auroc", score=(score, "N"), wrong=(wrong, "N"))
    n, m = (int(kind.sum()) for kind in (wrong, ~wrong))
    if not n or not m:
        return None
    _, group, count = score.detach().double().unique(return_inverse=True, return_counts=True)
    rank = (count.cumsum(0).double() - 0.5 * (count - 1).double())[group]  # ties share their mean rank
    return float((rank[wrong].sum() - n * (n + 1) / 2) / (n * m))
