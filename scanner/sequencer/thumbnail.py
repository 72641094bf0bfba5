"""Thumbnails: a frame thinned to about 160 pixels across, without averaging.

Each pixel of a thumbnail is one pixel of the frame, with its own noise, so that statistics made on thumbnails hold
for the frame, and a thinned frame of a colour sensor keeps to one colour of the mosaic.
"""

from __future__ import annotations

import numpy as np

from scanner.devices import Pixels

THUMBNAIL_WIDTH = 160


def stride_for(width: int) -> int:
    """Every how many pixels one is taken: even above 1, so that a mosaic's colours do not mix."""
    stride = max(1, round(width / THUMBNAIL_WIDTH))
    return stride if stride == 1 else stride + stride % 2


def thumbnail(frame: Pixels) -> Pixels:
    """A copy of every stride-th pixel in rows and columns, beginning in the stride's middle. (H, W) -> (h, w)."""
    stride = stride_for(frame.shape[1])
    top, left = (min(stride // 2, (size - 1) // 2) for size in frame.shape)
    thinned: Pixels = np.ascontiguousarray(frame[top::stride, left::stride])  # type: ignore[assignment]
    return thinned
