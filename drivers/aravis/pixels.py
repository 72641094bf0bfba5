"""Pixel formats of GenICam cameras: which the driver takes, and how their bytes become grey levels.

Bayer frames stay raw: each pixel keeps the value of its own colour. Packed formats are unpacked on receipt. Layouts:
Pixel Format Naming Convention 2.1, and GigE Vision 1.2 for the older `Packed` ones. Colour that the camera has
computed already (RGB8, YUV) is not taken: the greys of a fringe would be mixtures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanner.devices import Pixels

Packing = Literal["none", "row", "threes"]
"""row: pixel after pixel, least significant bit first; threes: two pixels in three bytes"""

_MOSAICS = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}


@dataclass(frozen=True)
class PixelFormat:
    """A format that the driver understands."""

    name: str
    bits: int
    packing: Packing
    mosaic: str | None

    @property
    def dtype(self) -> np.dtype[np.uint8] | np.dtype[np.uint16]:
        """Of the frames handed out."""
        return np.dtype(np.uint8) if self.bits <= 8 else np.dtype(np.uint16)

    def image_bytes(self, pixels: int) -> int:
        """Bytes of so many pixels on the wire."""
        if self.packing == "none":
            return pixels * self.dtype.itemsize
        return -(-pixels * self.bits // 8) if self.packing == "row" else -(-pixels // 2) * 3


def _known() -> dict[str, PixelFormat]:
    found = {}
    for prefix, mosaic in (("Mono", None), *((f"Bayer{name}", pattern) for name, pattern in _MOSAICS.items())):
        for bits in (8, 10, 12, 14, 16):
            found[f"{prefix}{bits}"] = PixelFormat(f"{prefix}{bits}", bits, "none", mosaic)
        for bits in (10, 12):
            found[f"{prefix}{bits}p"] = PixelFormat(f"{prefix}{bits}p", bits, "row", mosaic)
            found[f"{prefix}{bits}Packed"] = PixelFormat(f"{prefix}{bits}Packed", bits, "threes", mosaic)
    return found


FORMATS = _known()


def unpacked(content: NDArray[np.uint8], shape: tuple[int, int], pixel_format: PixelFormat) -> Pixels:
    """Grey levels (H, W), uint8 or uint16, right-aligned, C-contiguous; unpacked formats without a copy.

    Args:
        content: (N,) uint8, the image's bytes; what follows them (chunks) is ignored.
        shape: (height, width).

    Raises:
        ValueError: there are fewer bytes than the image has.
    """
    pixels = shape[0] * shape[1]
    size = pixel_format.image_bytes(pixels)
    if len(content) < size:
        raise ValueError(f"{len(content)} bytes for an image of {size}")
    image = content[:size]
    if pixel_format.packing == "row":
        return _from_row(image, pixels, pixel_format.bits).reshape(shape)
    if pixel_format.packing == "threes":
        return _from_threes(image, pixels, pixel_format.bits).reshape(shape)
    if pixel_format.bits <= 8:
        return image.reshape(shape)
    return image.view("<u2").reshape(shape)


def _from_row(content: NDArray[np.uint8], pixels: int, bits: int) -> NDArray[np.uint16]:
    """Groups of pixels that fill whole bytes (4 of 10 bits, 2 of 12) are taken apart by shifts."""
    group, size = (4, 5) if bits == 10 else (2, 3)
    groups = -(-pixels // group)
    padded = content
    if len(content) < groups * size:
        padded = np.zeros(groups * size, dtype=np.uint8)
        padded[: len(content)] = content
    columns = padded.reshape(groups, size).astype(np.uint16)
    out = np.empty((groups, group), dtype=np.uint16)
    mask = np.uint16((1 << bits) - 1)
    for i in range(group):
        byte, shift = divmod(i * bits, 8)
        value = columns[:, byte] >> np.uint16(shift)
        value |= columns[:, byte + 1] << np.uint16(8 - shift)
        out[:, i] = value & mask
    return out.reshape(-1)[:pixels]


def _from_threes(content: NDArray[np.uint8], pixels: int, bits: int) -> NDArray[np.uint16]:
    """Upper 8 bits of the first, both remainders (first's low, second's high nibble), upper 8 bits of the second."""
    triples = content.reshape(-1, 3).astype(np.uint16)
    low = np.uint16(bits - 8)
    mask = np.uint16((1 << (bits - 8)) - 1)
    out = np.empty((len(triples), 2), dtype=np.uint16)
    out[:, 0] = (triples[:, 0] << low) | (triples[:, 1] & mask)
    out[:, 1] = (triples[:, 2] << low) | ((triples[:, 1] >> np.uint16(4)) & mask)
    return out.reshape(-1)[:pixels]
