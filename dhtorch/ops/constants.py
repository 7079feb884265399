"""Compile-time constants that the torch functions share with the C++ kernels.

:func:`dhtorch.ops.loader.constants_header` writes them, with the codes of :mod:`dhtorch.codes`, into a header. Every
other constant of a kernel is an argument.
"""

from __future__ import annotations

from typing import Final

#: Luma weights of red, green and blue, thousandths: those of ``cv2.cvtColor`` (``tests/geometry/test_patches.py``).
#: Source: ITU-R BT.601.
LUMA_THOUSANDTHS: Final = (299, 587, 114)

#: Radius of the windows of a swept surface's refinement, px: 9×9 pixels. Source: origin not recorded.
FIT_RADIUS_PX: Final = 4

#: Largest width of a window around a sample that the kernels support, px. Source: origin not recorded.
MAX_KERNEL_WINDOW_PX: Final = 16

#: Largest radius of a correlation map in the Lucas-Kanade search, px.
#: Source: derived, the largest of ``TOP_RADII``, ``MIDDLE_RADII`` and ``FINEST_RADII`` of
#: :mod:`dhtorch.geometry.lucas_kanade`.
MAX_MAP_RADIUS_PX: Final = 2
