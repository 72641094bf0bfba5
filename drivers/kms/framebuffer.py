"""Images in a card's memory: dumb buffers of 32 bits a pixel, in which an 8-bit grey is exact."""

from __future__ import annotations

import contextlib
import mmap

import numpy as np
from numpy.typing import NDArray

from drivers.ioctl import Node, device_error
from drivers.kms import drm
from scanner.devices import Image

_OPAQUE, _GREY = 0xFF000000, 0x00010101


class DumbBuffer:
    """One image. Freed by `free`, or by the kernel when the card is closed."""

    def __init__(self, node: Node, width: int, height: int) -> None:
        """Allocate, black.

        Raises:
            DeviceError: no room.
        """
        self._node = node
        self.width, self.height = width, height
        made = drm.CreateDumb(width=width, height=height, bpp=32)
        try:
            node.call(drm.CREATE_DUMB, made)
        except OSError as error:
            raise device_error(error, f"no room for an image of {width}x{height} in the card", node.name) from error
        self._handle = made.handle
        try:
            self.fb = self._add(made.pitch)
            where = drm.MapDumb(handle=made.handle)
            node.call(drm.MAP_DUMB, where)
            self._pixels = self._map(made, where.offset)
        except (OSError, ValueError) as error:
            self.free()
            reason = error if isinstance(error, OSError) else OSError(0, str(error))
            raise device_error(reason, "an image cannot be mapped", node.name) from error
        self._pixels[...] = _OPAQUE

    def write(self, image: Image) -> None:
        """Fill with a grey image (H, W) uint8."""
        np.bitwise_or(image.astype(np.uint32) * np.uint32(_GREY), np.uint32(_OPAQUE), out=self._pixels)

    def read(self) -> NDArray[np.uint8]:
        """Copy of the colours, (H, W, 3) uint8: red, green, blue."""
        words = self._pixels.copy()
        return np.stack([(words >> shift).astype(np.uint8) for shift in (16, 8, 0)], axis=-1)

    def free(self) -> None:
        """Give the memory back. One that is on show makes the screen black. May be called twice."""
        with contextlib.suppress(OSError):  # the card is gone, and the memory with it
            if getattr(self, "fb", 0):
                self._node.call(drm.RMFB, drm.Handle(handle=self.fb))
            if self._handle:
                self._node.call(drm.DESTROY_DUMB, drm.Handle(handle=self._handle))
        self.fb = self._handle = 0

    def _add(self, pitch: int) -> int:
        command = drm.FbCmd2(width=self.width, height=self.height, pixel_format=drm.FORMAT_XRGB8888)
        command.handles[0], command.pitches[0] = self._handle, pitch
        self._node.call(drm.ADDFB2, command)
        return int(command.fb_id)

    def _map(self, made: drm.CreateDumb, offset: int) -> NDArray[np.uint32]:
        mapping = mmap.mmap(self._node.fd, made.size, offset=offset)
        lines = np.frombuffer(mapping, dtype=np.uint32, count=made.pitch // 4 * self.height)
        return lines.reshape(self.height, made.pitch // 4)[:, : self.width]
