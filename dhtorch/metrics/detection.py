"""How well a number tells what is wrong from what is right."""

from __future__ import annotations

from torch import Tensor

from dhtorch.geometry.checks import check


def auroc(
    score: Tensor,  # (N,) the more, the likelier wrong
    wrong: Tensor,  # (N,) bool
) -> float | None:
    """Area under the receiver operating characteristic: how often a wrong one scores above a right one, ties by half.

    None where all are alike. Gradient: none.

    Raises:
        ValueError: wrong shapes.

    Source: J. A. Hanley, B. J. McNeil, "The meaning and use of the area under a ROC curve", 1982.
    """
    check("auroc", score=(score, "N"), wrong=(wrong, "N"))
    n, m = (int(kind.sum()) for kind in (wrong, ~wrong))
    if not n or not m:
        return None
    _, place, count = score.detach().double().unique(return_inverse=True, return_counts=True)
    rank = (count.cumsum(0).double() - 0.5 * (count - 1).double())[place]  # ties share their mean rank
    return float((rank[wrong].sum() - n * (n + 1) / 2) / (n * m))
