"""How the simulated GigE Vision camera puts grey levels into bytes: binning, region, and the packed formats.

Layouts: Pixel Format Naming Convention 2.1 (Mono10p, Mono12p) and GigE Vision 1.2, annex (Mono10Packed,
Mono12Packed). Plain NumPy, and written apart from any driver that undoes it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.simulated import gige_features as f
from scanner.devices import Pixels

BITS: Mapping[int, int] = {
    f.MONO8: 8,
    f.MONO10: 10,
    f.MONO10P: 10,
    f.MONO10_PACKED: 10,
    f.MONO12: 12,
    f.MONO12P: 12,
    f.MONO12_PACKED: 12,
    f.MONO14: 14,
    f.MONO16: 16,
    f.BAYER_RG8: 8,
    f.BAYER_RG12: 12,
}


def payload_bytes(pixel_format: int, pixels: int) -> int:
    """Bytes of an image: the format's code carries its bits a pixel."""
    return -(-pixels * (pixel_format >> 16 & 0xFF) // 8)


def binned(frame: Pixels, across: int, down: int) -> Pixels:
    """Mean of `across` x `down` pixels each; what is left over at the edges is cut off."""
    if across == down == 1:
        return frame
    height, width = frame.shape[0] // down, frame.shape[1] // across
    blocks = frame[: height * down, : width * across].reshape(height, down, width, across)
    return np.asarray(blocks.mean(axis=(1, 3)).round().astype(frame.dtype))


def packed(frame: Pixels, pixel_format: int) -> NDArray[np.uint8]:
    """The image's bytes. frame: (H, W) uint8 or uint16, right-aligned."""
    values = frame.reshape(-1)
    if pixel_format in (f.MONO10P, f.MONO12P):
        return _in_a_row(values.astype(np.uint16), BITS[pixel_format])
    if pixel_format in (f.MONO10_PACKED, f.MONO12_PACKED):
        return _in_threes(values.astype(np.uint16), BITS[pixel_format])
    return values.astype("<u2" if BITS[pixel_format] > 8 else "u1", copy=False).view(np.uint8)


def _in_a_row(values: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """Pixel after pixel, least significant bit first, none between them."""
    each = np.unpackbits(values.astype("<u2").view(np.uint8).reshape(-1, 2), axis=1, bitorder="little", count=bits)
    return np.packbits(each.reshape(-1), bitorder="little")


def _in_threes(values: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """Two pixels in three bytes: upper 8 bits of the first, both remainders, upper 8 bits of the second."""
    low = bits - 8
    if len(values) % 2:
        values = np.append(values, np.uint16(0))
    first, second = values[0::2], values[1::2]
    mask = (1 << low) - 1
    out = np.empty((len(first), 3), dtype=np.uint8)
    out[:, 0] = first >> low
    out[:, 1] = (first & mask) | (second & mask) << 4
    out[:, 2] = second >> low
    return out.reshape(-1)
