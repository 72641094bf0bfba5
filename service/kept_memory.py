"""Memory that this process frees stays its own for a while: the next frame takes it again.

By itself the C library gives large blocks back to the kernel as soon as they are free, and each frame then takes a
thousand fresh pages, which the kernel must find and clear: 2 ms for a frame that takes 16 to decode. What is kept is
bounded; blocks that are larger than a frame's go back as ever.
"""

from __future__ import annotations

import ctypes

BLOCK_BYTES = 32 << 20
"""Blocks up to this size are kept: all that decoding one frame takes, and its points (17 MB for 1392 x 1040). The C
library takes no more for this limit."""

KEPT_BYTES = 128 << 20
"""Free memory above which the rest is given back: two threads' frames."""

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of <malloc.h>"""


def keep_memory() -> bool:
    """Set both limits for this process; False where the C library has none."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_MMAP_THRESHOLD, BLOCK_BYTES) and mallopt(_TRIM_THRESHOLD, KEPT_BYTES))
