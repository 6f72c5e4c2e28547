"""Keep the memory of big tensors on CPU, in place of giving it back to the kernel after every use.

An update at paper size makes and drops several GB of tensors. By default glibc maps each block of more than 32 MB afresh
and unmaps it when it is freed, so every update pays for the same page faults again (docs/notes/performance.md).
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys

#: set to 0 to leave the allocator alone
SWITCH = "SB3_DREAMER_KEEP_MEMORY"
# mallopt's numbers, from glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


@functools.cache
def keep_freed_memory() -> bool:
    """Let this process's glibc hold on to freed memory, for good; nothing happens with another C library.

    The price: memory that has been used once stays with the process, which matters where several share a machine. Blocks
    come from the heap, so M_MMAP_THRESHOLD, which cannot exceed 32 MB, is not the setting that helps.

    :return: whether the setting was made
    """
    if os.environ.get(SWITCH, "1") == "0" or not sys.platform.startswith("linux"):
        return False
    try:
        ctypes.CDLL(None).gnu_get_libc_version  # noqa: B018  musl and others lack it
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    # −1: never. The largest int is 2 GB, and more than that lies free after an update at paper size.
    settings = {_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: -1, _M_TOP_PAD: 64 * 2**20}
    return all(mallopt(name, value) == 1 for name, value in settings.items())
