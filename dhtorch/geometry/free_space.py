"""Free-space violations: depth of samples without return -> fraction within the range where the sensor has returns.

A pose estimated from a car ahead or from an object in the hand is exact for that object and wrong for the rest of the
scene. Where the object partly moves with the camera, epipolar residuals do not show it; but triangulated depth becomes
too small, within the range of a sensor that has no return there.
"""

import torch
from torch import Tensor

from dhtorch.geometry.checks import constant, shaped
from dhtorch.geometry.covariance import masked_median

#: Approximate number of samples in a cell of the image.
SAMPLES_PER_CELL = 10

#: Lower limit of the number of answers that are tested.
MIN_FREE_SPACE_ANSWERS = 10


@shaped("uv: B N 2, sensed: B N, pose_returns: B N, candidates: B N, depth: B N, sigma: B N")
def free_space_violations(
    uv: Tensor,  # (B, N, 2) px
    sensed: Tensor,  # (B, N) m, 0 = no return
    pose_returns: Tensor,  # (B, N) bool
    candidates: Tensor,  # (B, N) bool
    depth: Tensor,  # (B, N) m
    sigma: Tensor,  # (B, N) m
) -> Tensor:
    """Fraction (B,) of the answers without return whose depth plus two sigma is below the median depth of the returns.

    Args:
        uv: samples.
        sensed: depth of the sensor at the samples.
        pose_returns: returns that the pose is estimated from; their median depth is within the range of the sensor.
        candidates: answers at samples whose return is missing for no other reason. Only those in cells of the image
            without any return are tested: small holes between returns are usual.
        depth, sigma: depth of the answers and its standard deviation.

    Returns:
        0 where fewer than :data:`MIN_FREE_SPACE_ANSWERS` answers are tested, for a sensor that is sparse also where it
        has returns, and where more returns than answers are given: a moving object would then be most of the measured
        scene, and a sensor of long range has its holes for other reasons.

    Raises:
        ValueError: wrong shapes.

    Gradient: none.
    """
    has_return = sensed > 0
    pose_returns = pose_returns & has_return
    return_ratio = _return_ratio(uv, has_return)
    # Lower limit of the fraction of samples with a return in the cells of returns; in sparser data a missing return
    # is no evidence of free space.
    dense = torch.where(has_return, return_ratio, 0).sum(-1) >= 0.6 * has_return.sum(-1).clamp_min(1)
    few_returns = pose_returns.sum(-1) <= candidates.sum(-1)
    candidates = candidates & (return_ratio == 0)
    violating = candidates & (depth.detach() + 2 * sigma.detach() < masked_median(sensed.detach(), pose_returns))
    n = candidates.sum(-1)
    ratio = violating.sum(-1) / n.clamp_min(1).to(depth.dtype)
    testable = dense & pose_returns.any(-1) & (n >= MIN_FREE_SPACE_ANSWERS) & few_returns
    return torch.where(testable, ratio, torch.zeros_like(ratio))


def _return_ratio(uv: Tensor, has_return: Tensor) -> Tensor:
    """Fraction (B, N) of the samples in each sample's cell that have a return; cells divide the samples' extent."""
    N = uv.shape[1]
    rows = max(1, round((0.75 * N / SAMPLES_PER_CELL) ** 0.5))
    columns = max(1, round(N / SAMPLES_PER_CELL / rows))
    lowest, highest = uv.detach().amin(1, keepdim=True), uv.detach().amax(1, keepdim=True)
    cell_position = (uv.detach() - lowest) / (highest - lowest).clamp_min(1e-6) * constant(uv, [columns, rows])
    column, row = cell_position.long().unbind(-1)
    cell = column.clamp_max(columns - 1) + columns * row.clamp_max(rows - 1)
    ones = torch.ones_like(uv[..., 0])
    empty = ones.new_zeros(len(ones), columns * rows)
    in_cell, returns = (
        empty.scatter_add(1, cell, x) for x in (ones, torch.where(has_return, ones, 0))
    )  # integers: exact
    return returns.gather(1, cell) / in_cell.gather(1, cell)
