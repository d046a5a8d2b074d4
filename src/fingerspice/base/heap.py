"""Memory that a process has freed and keeps."""

from __future__ import annotations

import ctypes
import os
from functools import cache

# As in malloc.h of glibc: parameters of mallopt. Blocks below the second threshold come from the heap, of which so much
# may be free at the top before it is given back.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT = 128 << 20


@cache
def keep_freed_memory() -> None:
    """Keep up to 128 MB of freed memory in this process, if its environment asks glibc to give all of it back.

    Dask's workers start with MALLOC_TRIM_THRESHOLD_=65536, so that every array of a batch is memory that the system
    fetches and clears anew: a third of the time of fast scenes. Other C libraries have no such parameters.
    """
    if "MALLOC_TRIM_THRESHOLD_" not in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEPT)
        mallopt(_MMAP_THRESHOLD, _KEPT)
