"""The C library's allocator, set for work that makes the same large arrays again at every step."""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt(3)."""
KEPT_BYTES = 2**30
OLD_GLIBC_LIMIT = 2**25
"""Largest M_MMAP_THRESHOLD that older versions of glibc take."""


def keep_freed_memory() -> bool:
    """Keep freed memory in the process; return whether the C library can (glibc; others are left as they are).

    glibc gives large freed blocks back to the system, so that every step of a network touches new pages again.
    The price: up to KEPT_BYTES that are free stay with the process. No number changes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or not mallopt(M_TRIM_THRESHOLD, KEPT_BYTES):
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, KEPT_BYTES) or mallopt(M_MMAP_THRESHOLD, OLD_GLIBC_LIMIT))
