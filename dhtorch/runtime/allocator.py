"""glibc malloc settings: freed memory stays in the process, instead of page faults for every batch."""

import os

#: Environment variables with which a user configures glibc's allocator; it is then left unchanged.
_MALLOC_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TOP_PAD_", "GLIBC_TUNABLES")

#: Options of mallopt, from glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3

#: Size from which a block, or free memory above all blocks, is returned to the system, bytes.
_TRIM_LIMIT_BYTES = 1 << 30


def disable_malloc_trim() -> bool:
    """Keep freed memory in this process for reuse -> whether it took effect.

    Takes effect only with glibc's allocator, and unless the environment configures it (:data:`_MALLOC_VARIABLES`).

    By default large tensors return to the system when freed, and a data loader or stream allocates the same memory for
    its next batch. Cost: the process never shrinks. The setting cannot be undone.
    """
    import ctypes  # noqa: PLC0415  (imported only where used: start-up time)

    if any(name in os.environ for name in _MALLOC_VARIABLES):
        return False
    try:
        allocator = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library, another system
        return False
    return bool(allocator(_MMAP_THRESHOLD, _TRIM_LIMIT_BYTES) and allocator(_TRIM_THRESHOLD, _TRIM_LIMIT_BYTES))
