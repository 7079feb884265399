"""Constants that both the torch functions and the C++ kernels need when they are compiled.

Written with the codes of :mod:`dhtorch.codes` into a header by :func:`dhtorch.ops.loader.constants_header`. Every other
constant of a kernel is one of its arguments.
"""

from __future__ import annotations

from typing import Final

#: ITU-R BT.601 luma weights of red, green and blue, in thousandths: those of ``cv2.cvtColor``.
LUMA_THOUSANDTHS: Final = (299, 587, 114)

#: Half width of the windows that a swept surface is fitted in, px: 9×9 pixels.
FIT_RADIUS_PX: Final = 4

#: Widest window around a sample that the kernels read, px.
MAX_KERNEL_WINDOW_PX: Final = 16

#: Largest radius of a correlation map in the search for points, in pixels.
MAX_MAP_RADIUS_PX: Final = 2
