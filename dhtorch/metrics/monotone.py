"""Monotone functions fitted to points: a table by isotonic regression, and a two-parameter sigmoid as its baseline.

Both are callables on tensors of any shape, usable in a scoring stage: they follow the dtype and device of their
argument, have gradients, and are elementwise.
"""

import torch
from torch import Tensor

from dhtorch.geometry.checks import check
from dhtorch.geometry.determinism import pad_elementwise
from dhtorch.pytree import Record, record


@record
class MonotoneTable(Record):
    """A monotone function as a table of corners: linear between them, constant beyond."""

    x: Tensor  # (k,) strictly rising
    y: Tensor  # (k,) rising or falling

    def __call__(self, x: Tensor) -> Tensor:
        """The function at ``x`` (any shape), elementwise; NaN stays NaN."""
        corners, values = self.x.to(x), self.y.to(x)
        if corners.numel() == 1:
            return values[0] + 0 * x
        right = torch.searchsorted(corners, x.detach().contiguous(), right=True).clamp(1, corners.numel() - 1)
        x0, x1, y0, y1 = corners[right - 1], corners[right], values[right - 1], values[right]
        width = x1 - x0  # zero if two corners are equal in the dtype of x
        share = (x - x0) / torch.where(width > 0, width, torch.ones_like(width))
        return y0 + share.clamp(0, 1) * (y1 - y0)


@record
class Sigmoid(Record):
    """p ↦ σ(slope · logit(p) + offset): temperature scaling with an offset, after Platt."""

    slope: Tensor  # ()
    offset: Tensor  # ()

    def __call__(self, p: Tensor) -> Tensor:
        """The function at ``p`` (any shape), elementwise; arguments outside (0, 1) are clamped to its ends."""
        return pad_elementwise(torch.sigmoid, self.slope.to(p) * _logit(p) + self.offset.to(p))


def fit_isotonic(
    x: Tensor,  # (n,)
    y: Tensor,  # (n,)
    weight: Tensor | None = None,  # (n,) ≥ 0
    *,
    rising: bool = True,
    min_share: float = 0.0,
    ends: tuple[float, float] | None = None,
) -> MonotoneTable:
    """Isotonic regression of points (x, y) as a continuous table: least weighted square error.

    Pool-adjacent-violators gives blocks of equal value. The table is linear from the middle of one block to the middle
    of the next, so that unequal arguments have unequal values; for the same reason the outermost blocks get a
    negligible slope.

    Args:
        x, y: points; points of equal x share one value.
        weight: of each; None = equal.
        rising: whether the function rises or falls.
        min_share: blocks with a smaller fraction of the weight are merged with a neighbour: one or two good points at
            an end would otherwise give a probability of 1.
        ends: first and last argument of the table; None = the smallest and largest x.

    Raises:
        ValueError: unequal lengths, or no point with weight.

    Source: M. Ayer et al., "An empirical distribution function for sampling with incomplete information", 1955;
    A. Oron, N. Flournoy, "Centered isotonic regression", 2017 (the middles of blocks).
    """
    check("fit_isotonic", x=(x, "n"), y=(y, "n"), weight=(weight, "n"))
    x, y = x.detach().double(), y.detach().double()
    weight = torch.ones_like(x) if weight is None else weight.detach().double()
    x, y, weight = (v[weight > 0] for v in (x, y, weight))
    if not x.numel():
        raise ValueError("fit_isotonic: found no point with weight, expected at least one")
    argument, group = x.unique(return_inverse=True)
    mass = torch.zeros_like(argument).index_add(0, group, weight)
    mean = torch.zeros_like(argument).index_add(0, group, weight * y) / mass
    sign = 1.0 if rising else -1.0
    # Pool-adjacent-violators in one pass: a stack of blocks whose values rise strictly.
    stack: list[_Block] = []
    for point in zip((sign * mean).tolist(), mass.tolist(), argument.tolist(), strict=True):
        block = point
        while stack and stack[-1][0] >= block[0]:
            block = _merge_blocks(stack.pop(), block)
        stack.append(block)
    # Light blocks merge with their neighbours; values still rise, as means of rising values.
    least = min_share * float(mass.sum())
    blocks: list[_Block] = []
    for block in stack:
        light = bool(blocks) and blocks[-1][1] < least
        blocks.append(_merge_blocks(blocks.pop(), block) if light else block)
    while len(blocks) > 1 and blocks[-1][1] < least:
        last = blocks.pop()
        blocks.append(_merge_blocks(blocks.pop(), last))
    x_block, y_block = [block[2] for block in blocks], [sign * block[0] for block in blocks]
    low, high = (float(argument[0]), float(argument[-1])) if ends is None else ends
    corners = list(zip(x_block, y_block, strict=True))
    if len(corners) > 1:
        # The end blocks, where isotonic regression is flat, slope by a quarter of the step to the next block, at most
        # 1e-3: no order is lost there.
        left, right = low < x_block[0], high > x_block[-1]
        first, final = (max(-1e-3, min(1e-3, (y_block[k + 1] - y_block[k]) / 4)) for k in (0, -2))
        corners[0] = (x_block[0], y_block[0] + left * first)
        corners[-1] = (x_block[-1], y_block[-1] - right * final)
        corners = [(low, y_block[0])] * left + corners + [(high, y_block[-1])] * right
    return MonotoneTable(*(torch.tensor(v, dtype=torch.float64) for v in zip(*corners, strict=True)))


def fit_platt(
    p: Tensor,  # (n,) in [0, 1]
    good: Tensor,  # (n,) bool
    weight: Tensor | None = None,  # (n,) ≥ 0
    *,
    steps: int = 100,
) -> Sigmoid:
    """Platt scaling: the sigmoid of logit(p) with the least weighted log loss, a baseline for :func:`fit_isotonic`.

    Args:
        p: claimed probability, or a score in [0, 1].
        good: whether the answer was good.
        weight: of each; None = equal.
        steps: of Newton's method, halved where they overshoot.

    Returns:
        Sigmoid; the identity without points.

    Raises:
        ValueError: unequal lengths.

    Source: J. Platt, "Probabilistic outputs for support vector machines", 1999; C. Guo et al., "On calibration of
    modern neural networks", 2017.
    """
    check("fit_platt", p=(p, "n"), good=(good, "n"), weight=(weight, "n"))
    weight = torch.ones_like(p) if weight is None else weight
    share = weight.double() / weight.double().sum().clamp_min(torch.finfo(torch.float64).tiny)
    feature = torch.stack((_logit(p.detach().double()), torch.ones_like(p, dtype=torch.float64)), -1)
    sign = 2 * good.double() - 1
    identity = torch.tensor([1.0, 0.0], dtype=torch.float64, device=p.device)

    # A ridge towards the identity, beside a log loss of total weight 1, keeps the sigmoid of separable data finite.
    ridge = 1e-6

    def loss(theta: Tensor) -> Tensor:
        pull = ridge / 2 * (theta - identity).square().sum()
        return (share * torch.nn.functional.softplus(-sign * (feature @ theta))).sum() + pull

    theta = identity
    for _ in range(steps):
        claimed = torch.sigmoid(feature @ theta)
        gradient = feature.mT @ (share * (claimed - good.double())) + ridge * (theta - identity)
        curvature = (feature * (share * claimed * (1 - claimed))[:, None]).mT @ feature
        step = torch.linalg.solve(curvature + ridge * torch.eye(2).to(curvature), gradient)
        before, length = loss(theta), 1.0
        while length > 1e-6 and loss(theta - length * step) > before:
            length /= 2
        theta = theta - length * step
        if float(step.abs().max()) < 1e-10:
            break
    return Sigmoid(theta[0], theta[1])


#: A block: value, weight, weighted mean of its arguments.
_Block = tuple[float, float, float]


def _merge_blocks(a: _Block, b: _Block) -> _Block:
    mass = a[1] + b[1]
    return (a[0] * a[1] + b[0] * b[1]) / mass, mass, (a[2] * a[1] + b[2] * b[1]) / mass


def _logit(p: Tensor) -> Tensor:
    p = p.clamp(1e-6, 1 - 1e-6)
    return pad_elementwise(torch.log, p) - pad_elementwise(torch.log, 1 - p)
