"""Compile-time constants that the torch functions share with the C++ kernels.

:func:`constants_header` writes them, with the codes of :mod:`dhtorch.codes`, into a header. Every other constant of a
kernel is an argument.
"""

from typing import Final

from dhtorch import codes

#: Luma weights of red, green and blue, thousandths: those of ``cv2.cvtColor`` (``tests/geometry/test_patches.py``).
#: Source: ITU-R BT.601.
LUMA_THOUSANDTHS: Final = (299, 587, 114)

#: Radius of the windows of a swept surface's refinement, px: 9×9 pixels.
FIT_RADIUS_PX: Final = 4

#: Largest width of a window around a sample that the kernels support, px.
MAX_KERNEL_WINDOW_PX: Final = 16

#: Largest radius of a correlation map in the Lucas-Kanade search, px.
#: Source: derived, the largest of ``TOP_RADII``, ``MIDDLE_RADII`` and ``FINEST_RADII`` of
#: :mod:`dhtorch.geometry.lucas_kanade`.
MAX_MAP_RADIUS_PX: Final = 2


def constants_header() -> str:
    """C++ header with the values of the code tables, as ``<table>_<name>``, and of this module."""
    lines = ["// Generated from dhtorch/codes.py and dhtorch/ops/constants.py.", "#pragma once", "#include <cstdint>"]
    lines.append("namespace {")
    for table in (codes.Flag, codes.Gate, codes.Hole, codes.Source, codes.PoseCode):
        values = ((f"{table.__name__.upper()}_{name}", code) for code, name in codes.names(table).items())
        lines += [f"[[maybe_unused]] constexpr int32_t {name} = {code};" for name, code in values]
    for name, value in globals().items():
        if name.isupper() and isinstance(value, int):
            lines.append(f"[[maybe_unused]] constexpr int64_t {name} = {value};")
        elif name.isupper():
            numbers = ", ".join(map(str, value))
            lines.append(f"[[maybe_unused]] constexpr int32_t {name}[] = {{{numbers}}};")
    return "\n".join((*lines, "}  // namespace", ""))
