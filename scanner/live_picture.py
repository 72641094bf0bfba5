"""A picture of one live result, to look at while the run goes on: depth, or the relief of the rows.

Rows rise across the whole image whatever is in view; what bends them is the shape. So the plane that fits them best is
taken off, and what is left is drawn. Small and quick: a picture a second costs nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.colours import (
    ACCENT,
    BACKGROUND,
    DIM,
    TEXT,
    Picture,
    colour_bar,
    fit,
    grouped,
    scale_of,
    text,
)
from scanner.errors import StorageError
from scanner.live import LiveFrame, Map

WIDTH, HEIGHT = 960, 720
_TOP, _MARGIN, _BAR = 56, 16, 96

FORMATS = (".png", ".jpg", ".jpeg")


def live_picture(frame: LiveFrame, caption: str = "") -> Picture:
    """(720, 960, 3) uint8 BGR: the map with a colour bar, the frame's figures above; words where it has no values."""
    picture = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    picture[:] = BACKGROUND
    x = _MARGIN + text(picture, f"frame {grouped(frame.number)}", (_MARGIN, 36), size=22, weight=600, colour=ACCENT)
    figures = f"{grouped(frame.header.points)} points   {frame.latency_ms:.0f} ms   {caption}"
    text(picture, figures, (x + 24, 36), size=18, colour=TEXT)
    shown, unit, reverse = _shown(frame)
    if shown is None or not np.isfinite(shown).any():
        text(picture, frame.error or "nothing decoded", (_MARGIN, HEIGHT // 2), size=18, colour=DIM)
        return picture
    scale = scale_of(shown, "viridis", unit, reverse=reverse)
    small = fit(shown, WIDTH - 2 * _MARGIN - _BAR, HEIGHT - _TOP - _MARGIN)
    height, width = small.shape
    picture[_TOP : _TOP + height, _MARGIN : _MARGIN + width] = scale.apply(small)
    colour_bar(picture, scale, (WIDTH - _BAR, _TOP + 24, 20, height - 24))
    return picture


def encoded(picture: Picture, suffix: str) -> bytes:
    """The picture as a file of that kind: .png, .jpg or .jpeg.

    Raises:
        StorageError: another kind.
    """
    if suffix.lower() not in FORMATS:
        raise StorageError(f"pictures are not written as {suffix or 'files without an ending'}", hint="png or jpg")
    _, content = cv2.imencode(suffix.lower(), picture)
    return content.tobytes()


def relief(rows: Map) -> Map:
    """Rows or columns, (H, W) float32 px, without the plane that fits them best."""
    height, width = rows.shape
    step = max(1, int(np.sqrt(rows.size / 10_000)))
    y, x = np.mgrid[0:height:step, 0:width:step]
    sample = rows[::step, ::step]
    there = np.isfinite(sample)
    if np.count_nonzero(there) < 3:
        return rows
    known = np.stack([x[there], y[there], np.ones(np.count_nonzero(there))], axis=1)
    plane = np.linalg.lstsq(known, sample[there].astype(np.float64), rcond=None)[0].astype(np.float32)
    along, down = plane[0] * np.arange(width, dtype=np.float32), plane[1] * np.arange(height, dtype=np.float32)
    flat: NDArray[np.float32] = along[None, :] + down[:, None] + plane[2]
    return np.asarray(rows - flat, dtype=np.float32)


def _shown(frame: LiveFrame) -> tuple[Map | None, str, bool]:
    if frame.xyz is not None:
        return frame.xyz[..., 2], "mm", True
    rows = frame.rows if frame.rows is not None else frame.columns
    return (None, "px", False) if rows is None else (relief(rows), "px", False)
