"""A result of ``dhtorch pin`` in words, and what to do to put the mount back."""

from __future__ import annotations

import math

from dhtorch.codes import PinReason, PinVerdict, name
from dhtorch.geometry import se3
from dhtorch.records import PinResult

#: Distance and angle below which the guide calls a mount in place, mm and degrees: the median error of a half hidden
#: picture allowed for. Source: the required accuracy of the offset.
IN_PLACE_MM, IN_PLACE_DEG = 2.0, 0.1

#: Ways of the guide along and about the camera's axes (x right, y down, z forward): negative, positive.
_SHIFTS = (("← left", "→ right"), ("↑ up", "↓ down"), ("⊙ back", "⊗ forward"))
_TURNS = (("⤓ tilt down", "⤒ tilt up"), ("↶ turn left", "↷ turn right"), ("⟲ roll left", "⟳ roll right"))


def describe_pin(result: PinResult) -> str:
    """One picture's result (1) in a line: verdict, shift, offset with standard deviations, or the reason for none."""
    verdict = name(PinVerdict, int(result.verdict)).lower().replace("_", " ")
    if int(result.verdict) == PinVerdict.CANNOT_KNOW:
        text = f"{verdict}: {PinReason.entries[int(result.reason)].definition}"
        focal = f" ({float(result.zoom):.4f} ± {float(result.zoom_sigma):.4f} of the stated one)"
        return text + focal if int(result.reason) == PinReason.ZOOM else text
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
