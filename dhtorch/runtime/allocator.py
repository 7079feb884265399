"""Memory that a process keeps: what an allocator gives back is handed out anew, cleared page by page, a batch later."""

from __future__ import annotations

import os

#: What a user tells glibc's allocator of this by; it then stays as it was told.
_MALLOC_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TOP_PAD_", "GLIBC_TUNABLES")

#: Options of mallopt, from glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3

#: Bytes from which on a block, or what is free above all blocks, goes back to the system.
_TRIM_LIMIT_BYTES = 1 << 30


def disable_malloc_trim() -> bool:
    """From now on, what this process frees stays with it for what it asks for next. Whether that is so: only of glibc's
    allocator, unless the environment tells it something else (:data:`_MALLOC_VARIABLES`).

    Large tensors otherwise go back to the system whenever they are freed, and a data loader or a stream asks for the
    same memory with its next batch. The price: a process stays as large as it ever was. It cannot be taken back.
    """
    import ctypes  # noqa: PLC0415  (a command that only says something must not pay for it)

    if any(name in os.environ for name in _MALLOC_VARIABLES):
        return False
    try:
        allocator = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library, another system
        return False
    return bool(allocator(_MMAP_THRESHOLD, _TRIM_LIMIT_BYTES) and allocator(_TRIM_THRESHOLD, _TRIM_LIMIT_BYTES))
