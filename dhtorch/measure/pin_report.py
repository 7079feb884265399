"""Offsets of a camera over time -> change points; and an offset -> words that tell how to put the mount back."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dhtorch.codes import PinReason, PinVerdict, name
from dhtorch.geometry import se3
from dhtorch.measure.pin import PinResult, chi2_quantile

#: Fewest pictures before and after a change. Source: derived, two show a level, one an outlier.
MIN_SEGMENT = 2

#: Median absolute difference of two Gaussians with unit sigma. Source: derived, 0.6745 sqrt(2).
MEDIAN_DIFFERENCE = 0.954

#: Distance and angle below which the guide calls a mount in place, mm and degrees: the median error of a half hidden
#: picture allowed for. Source: the required accuracy of the offset.
IN_PLACE_MM, IN_PLACE_DEG = 2.0, 0.1

#: Ways of the guide along and about the camera's axes (x right, y down, z forward): negative, positive.
_SHIFTS = (("← left", "→ right"), ("↑ up", "↓ down"), ("⊙ back", "⊗ forward"))
_TURNS = (("⤓ tilt down", "⤒ tilt up"), ("↶ turn left", "↷ turn right"), ("⟲ roll left", "⟳ roll right"))


class ChangePoint(NamedTuple):
    """A lasting change of the camera's offset between two pictures."""

    first: int  # position of the first picture after the change
    shift_px: float  # root mean square change of the scene in the picture
    offset: Tensor  # (6,) change of the offset: rotation vector, rad, and translation, m (or unitless)


def find_change_points(result: PinResult, *, false_alarm_rate: float = 0.01, min_px: float = 1.0) -> list[ChangePoint]:
    """Lasting changes within a sequence of pictures, by halving it where the means on both sides differ most.

    A single picture that differs from both its neighbours is none.

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
    whitened = _without_single_outliers(whitened / scatter.clamp_min(1.0))  # at least the stated noise
    offset = _without_single_outliers(offset.mT).mT
    limit = chi2_quantile(1 - false_alarm_rate / max(len(known) - 1, 1), free)
    square_px = result.flow_form[known[0], :free, :free]
    changes: list[ChangePoint] = []
    parts = [(0, len(known))]
    while parts:
        low, high = parts.pop()
        k, gain = _best_split(whitened[:, low:high])
        if k is None or gain <= limit:
            continue
        change = offset[low + k : high].mean(0) - offset[low : low + k].mean(0)
        shift = float((change @ square_px @ change).sqrt())
        if shift >= min_px:
            changes.append(ChangePoint(int(known[low + k]), shift, F.pad(change, (0, 6 - free))))
        parts += [(low, low + k), (low + k, high)]
    return sorted(changes)


def _without_single_outliers(x: Tensor) -> Tensor:
    """Series (free, n) -> medians of three neighbours: lasting changes stay, a wrong picture disappears."""
    middle = x.unfold(1, 3, 1).median(-1).values
    return torch.cat([middle[:, :1], middle, middle[:, -1:]], 1)


def _best_split(x: Tensor) -> tuple[int | None, float]:
    """Where the means of unit-noise series (free, n) differ most, and the squared length of that difference."""
    n = x.shape[1]
    if n < 2 * MIN_SEGMENT:
        return None, 0.0
    k = torch.arange(MIN_SEGMENT, n - MIN_SEGMENT + 1)
    sums = x.cumsum(1)
    left, right = sums[:, k - 1] / k, (sums[:, -1:] - sums[:, k - 1]) / (n - k)
    gain = (right - left).square().sum(0) * (k * (n - k) / n)
    best = int(gain.argmax())
    return int(k[best]), float(gain[best])


def describe_pin(result: PinResult) -> str:
    """One picture's result (1) in a line: verdict, shift, offset with standard deviations, or the reason for none."""
    verdict = name(PinVerdict, int(result.verdict)).lower().replace("_", " ")
    if int(result.verdict) == PinVerdict.CANNOT_KNOW:
        return f"{verdict}: {PinReason.entries[int(result.reason)].definition}"
    sigma = result.cov[0].diagonal().clamp_min(0).sqrt()
    turn, shift = result.offset[0].split(3)
    angle = math.degrees(float(turn.norm()))
    angle_sigma = math.degrees(float(sigma[:3].norm()))
    px = f"{verdict}, {float(result.shift_px):.2f} ± {float(result.shift_sigma_px):.2f} px"
    text = f"{px}, turned by {angle:.3f} ± {angle_sigma:.3f}°"
    if bool(result.metric):
        return f"{text}, displaced by {1e3 * float(shift.norm()):.1f} ± {1e3 * float(sigma[3:].norm()):.1f} mm"
    if float(shift.norm()) > 0:
        return f"{text}, displaced along ({', '.join(f'{x:.2f}' for x in shift.tolist())}) by an unknown length"
    return f"{text} (reference without depth: no length)"


def guide_pin(result: PinResult) -> list[str]:
    """One picture's result (1) -> lines that say how to put the camera back: arrows, mm and degrees.

    Directions are those of the live camera: right, down and forward in its own picture.
    """
    if int(result.verdict) == PinVerdict.CANNOT_KNOW:
        return [describe_pin(result)]
    back = se3.invert(result.T_ref_from_live)  # the reference camera seen from the live one
    turn = [math.degrees(x) for x in se3.log(back)[0, :3].tolist()]
    shift = [1e3 * x for x in back.t[0].tolist()]
    lines = []
    if bool(result.metric):
        lines += [f"{_SHIFTS[k][x > 0]} {abs(x):.1f} mm" for k, x in enumerate(shift) if abs(x) >= IN_PLACE_MM]
    elif any(shift):
        k = max(range(3), key=lambda k: abs(shift[k]))
        lines.append(f"mainly {_SHIFTS[k][shift[k] > 0]}, by an unknown length")
    lines += [f"{_TURNS[k][x > 0]} {abs(x):.2f}°" for k, x in enumerate(turn) if abs(x) >= IN_PLACE_DEG]
    return [*(lines or ["in place"]), f"shift {float(result.shift_px):.1f} ± {float(result.shift_sigma_px):.1f} px"]
