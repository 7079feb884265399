"""Plausibility of stored depth: a few decoded depth maps and their unit -> doubts about unit, byte order and meaning.

Only gross contradictions show in depth alone: a factor of ten, swapped bytes, shifted bits, a z-buffer. A factor of two
is consistent with another room; poses and tracks show it, not the depth.
"""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor

from dhtorch.data.units import DepthUnit, format_unit

#: Fewest returns of all maps for a statement.
_MIN_VALUES: Final = 500

#: Median depth in m above which metres stored as floats are doubted: outdoor scenes of simulators.
_MAX_MEDIAN_FLOATS_M: Final = 100.0

#: Median depth in m to which a likelier unit leads: rooms and table tops.
_LIKELY_MEDIAN_M: Final = (0.3, 8.0)

#: Factors on the unit that are tried, in this order. Source: the units of FORMATS and the usual confusions: 1/10000 m
#: read as 1/1000 m, 1/5000 m, cm, mm read as m.
_UNIT_FACTORS: Final = (0.1, 10.0, 0.2, 5.0, 0.01, 100.0, 0.001, 1000.0)

#: Shifts of codes in bits that are looked for, and the share of codes that must be such multiples: rotated codes of
#: depths beyond 8191 are not. Source: SUN3D and SUN RGB-D rotate 16-bit codes by three bits; by chance 1/8 are such.
_CODE_SHIFTS: Final = (8, 7, 6, 5, 4, 3)


class _PlausibilityFinding(NamedTuple):
    """A doubt about stored depth."""

    code: str  # unit | shifted | byte_order | z_buffer | 8_bit
    text: str  # what was measured, and its likely reading
    remedy: str  # option or conversion that mends it


def plausibility_findings(
    depths: Iterable[Tensor],  # (h, w) m, 0 = no return
    unit: DepthUnit | None,
    sparse: bool = False,
) -> list[_PlausibilityFinding]:
    """Depth maps, the unit by which they were converted and whether they are LiDAR sweeps -> findings, likeliest first.

    ``unit`` None: the format defines metres. A unit of 1 m, and None, mean that the values may be floats; any other
    that they were integers.
    """
    # Evenly spaced rows, in which neighbours stay neighbours; 12,000 values of a map take 5 ms.
    thin = (depth.detach()[:: max(1, -(-depth.numel() // 12_000))] for depth in depths if depth.numel())
    maps = [depth.cpu().double() for depth in thin]
    values = torch.cat([x[x > 0] for x in maps]) if maps else torch.zeros(0, dtype=torch.float64)
    if values.numel() < _MIN_VALUES:
        return []
    metres = 1.0 if unit is None else unit.metres
    if metres >= 1:
        finding = _check_z_buffer(values) or _check_median(values, unit, sparse)
    else:
        codes = [(x / metres).round() for x in maps]
        finding = _check_byte_order(codes)
        if unit is not None and unit.is_assumed:  # a unit that is stated may include the shift
            finding = finding or _check_shifted(values, metres)
        finding = finding or _check_median(values, unit, sparse)
        finding = finding or _check_8_bit(values, metres)
    return [] if finding is None else [finding]


def _check_median(values: Tensor, unit: DepthUnit | None, sparse: bool) -> _PlausibilityFinding | None:
    median, metres = float(values.median()), 1.0 if unit is None else unit.metres
    # Integer codes are doubted beyond the reach of structured light, time of flight and stereo with a short baseline.
    # Source: chosen on the captures of DHTORCH_DATA, whose medians without sparse sets are at most 4 m.
    high = _MAX_MEDIAN_FLOATS_M if metres >= 1 or sparse else 12.0
    # Median depth in m below which depth is doubted: with an assumed unit, and otherwise. Source: minimum range of
    # depth cameras, 0.1 to 0.5 m; r3d_door of DHTORCH_DATA, whose format states metres, has a median of 0.21 m.
    low = 0.2 if unit is not None and unit.is_assumed else 0.05
    if low <= median <= high:
        return None
    if median > high:
        limit = "any depth sensor" if high == _MAX_MEDIAN_FLOATS_M else "a short-range depth sensor"
        text = f"median depth {median:.3g} m is beyond the reach of {limit}"
    else:
        text = f"median depth {median:.3g} m is at or below the minimum range of depth sensors"
    read_as = "" if unit is None else f" with {unit}"
    likely = [f for f in _UNIT_FACTORS if _LIKELY_MEDIAN_M[0] <= median * f <= _LIKELY_MEDIAN_M[1]]
    if not likely:
        return _PlausibilityFinding("unit", f"{text}{read_as}: wrong depth unit?", "data.depth_unit=…")
    likelier = metres * likely[0]
    text = f"{text}{read_as}: depth unit {format_unit(likelier)}?"
    return _PlausibilityFinding("unit", text, f"data.depth_unit={format_unit(likelier).removesuffix(' m')}")


def _check_shifted(values: Tensor, metres: float) -> _PlausibilityFinding | None:
    codes = (values / metres).round().long()
    shifts = [n for n in _CODE_SHIFTS if float((codes % 2**n == 0).double().mean()) >= 0.98]
    if not shifts or bool((codes == codes[0]).all()):
        return None
    n = shifts[0]
    where = ", as SUN3D and SUN RGB-D rotate them" if n == 3 else ""
    text = f"depth codes are multiples of {2**n}: shifted by {n} bits{where}?"
    return _PlausibilityFinding("shifted", text, f"data.depth_unit={format_unit(metres / 2**n).removesuffix(' m')}")


def _check_byte_order(codes: Sequence[Tensor]) -> _PlausibilityFinding | None:
    steps: list[Tensor] = []
    for code in codes:
        left, right = code[:, :-1].long(), code[:, 1:].long()
        both = (left > 0) & (right > 0) & (left < 2**16) & (right < 2**16)
        left, right = left[both], right[both]
        swapped_left, swapped_right = (256 * (c % 256) + c // 256 for c in (left, right))
        steps.append(torch.stack(((left - right).abs(), (swapped_left - swapped_right).abs())))
    step = torch.cat(steps, 1).double()
    if step.shape[1] < _MIN_VALUES:
        return None
    # Means of capped steps: medians of piecewise constant maps are 0, and steps at edges outweigh the rest in sums.
    stored, swapped = (step.clamp_max(1000) + 0.1).log().mean(1).exp().tolist()
    # Ratio of the step between neighbouring pixels, codes / byte-swapped codes, from which the bytes are swapped.
    # Source: chosen on the captures of DHTORCH_DATA: at most 0.41 as they are, at least 2.4 with swapped bytes.
    if stored < 1.5 * swapped:
        return None
    ratio = stored / swapped
    text = f"neighbouring depths differ {ratio:.0f} times as much as with swapped bytes: codes of the other byte order?"
    return _PlausibilityFinding("byte_order", text, "swap the bytes of the 16-bit codes (numpy: codes.byteswap())")


def _check_8_bit(values: Tensor, metres: float) -> _PlausibilityFinding | None:
    codes = (values / metres).round().unique()
    # Most different values of 8-bit depth. Source: derived, 2^8.
    if not 2 < len(codes) <= 256:
        return None
    gap = codes.diff()
    step = float(gap.median())
    equal = float(((gap - step).abs() <= 1).double().mean())
    # Relative step of 8-bit depth from which it is reported, and the share of steps that are equal up to one code:
    # disparities have steps that grow with depth. Source: chosen on 7-Scenes and TUM fr1 of DHTORCH_DATA, which have
    # 240 to 360 values; below 0.4 of their steps are equal.
    if step * metres < 0.004 * float(values.median()) or equal < 0.7 or step < 3:
        return None
    text = f"only {len(codes)} different depths in equal steps of {step * metres:.3g} m: 8-bit depth?"
    return _PlausibilityFinding("8_bit", text, "export depth with 16 bits or as floats")


def _check_z_buffer(values: Tensor) -> _PlausibilityFinding | None:
    if float(values.max()) > 1:
        return None
    # Values that a z-buffer in [0, 1] has in scenes beyond ten near planes: 1 - near / depth. Source: derived, 1 -
    # 1/10.
    share = float((values >= 0.9).double().mean())
    # Share of the values that lie there, and least value of the farthest hundredth.
    if share < 0.95 or float(values.quantile(0.99)) < 0.97:
        return None
    low, high = values.quantile(torch.tensor([0.01, 0.99], dtype=values.dtype)).tolist()
    text = f"depth values from {low:.4f} to {high:.4f}, none above 1: z-buffer (non-linear depth)?"
    return _PlausibilityFinding(
        "z_buffer", text, "depth = near / (1 - value * (1 - near / far)), with the camera's planes"
    )
