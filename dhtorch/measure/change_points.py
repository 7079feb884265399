"""Offsets of a camera over time -> lasting changes."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import PinVerdict
from dhtorch.geometry.covariance import chi2_quantile
from dhtorch.metrics.change_points import MIN_SEGMENT, mean_changes, median_of_three
from dhtorch.records import PinResult

#: Median absolute difference of two Gaussians with unit sigma. Source: derived, 0.6745 sqrt(2).
MEDIAN_DIFFERENCE = 0.954


class ChangePoint(NamedTuple):
    """A lasting change of the camera's offset between two pictures."""

    first: int  # position of the first picture after the change
    shift_px: float  # root mean square change of the scene in the picture
    offset: Tensor  # (6,) change of the offset: rotation vector, rad, and translation, m (or unitless)


def find_change_points(result: PinResult, *, false_alarm_rate: float = 0.01, min_px: float = 1.0) -> list[ChangePoint]:
    """Lasting changes within a sequence of pictures; a single picture that differs from both its neighbours is none.

    Args:
        result: of the pictures of an episode in their order; those that cannot be known are left out.
        false_alarm_rate: of one or more change points in a sequence of independent errors without any.
        min_px: smallest change that counts, px at the scene's depths.
    """
    known = (result.verdict != PinVerdict.CANNOT_KNOW).nonzero()[:, 0]
    if len(known) < 2 * MIN_SEGMENT:
        return []
    free = 6 if bool(result.metric.all()) else 3
    offset, cov = result.offset[known][:, :free], result.cov[known][:, :free, :free].mean(0)
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(cov), offset.mT, upper=False)  # (free, n)
    scatter = whitened.diff(dim=1).abs().median(1, keepdim=True).values / MEDIAN_DIFFERENCE
    whitened = median_of_three(whitened / scatter.clamp_min(1.0))  # at least the stated noise
    offset = median_of_three(offset.mT).mT
    changes: list[ChangePoint] = []
    for low, k, high in mean_changes(whitened, chi2_quantile(1 - false_alarm_rate / max(len(known) - 1, 1), free)):
        change = offset[k:high].mean(0) - offset[low:k].mean(0)
        shift = float((change @ result.flow_form[known[0], :free, :free] @ change).sqrt())
        if shift >= min_px:
            changes.append(ChangePoint(int(known[k]), shift, F.pad(change, (0, 6 - free))))
    return changes
