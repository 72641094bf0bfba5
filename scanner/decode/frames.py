"""What every decoder asks of a frame before it takes it, and reshaping that costs nothing."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, PatternSequence


class FrameCheck:
    """Remembers which positions have been taken and refuses frames that cannot belong to the pattern."""

    def __init__(self, sequence: PatternSequence, camera: CameraFormat) -> None:
        self._count = len(sequence)
        self._camera, self._shape, self._dtype = camera, camera.shape, camera.dtype
        self._seen: set[int] = set()

    def take(self, position: int, frame: NDArray[Any]) -> None:
        """Note that the frame at `position` has come.

        Raises:
            DecodeError: no such position, one that was given before, wrong size or dtype.
        """
        if not 0 <= position < self._count:
            raise DecodeError(f"frame {position} does not exist: the pattern has {self._count} frames")
        if position in self._seen:
            raise DecodeError(f"frame {position} was given before")
        if frame.shape != self._shape:
            camera = self._camera
            size = " x ".join(str(n) for n in reversed(frame.shape))
            raise DecodeError(f"frame {position} is {size} px, the camera's format {camera.width} x {camera.height}")
        if frame.dtype != self._dtype:
            bits = self._camera.bits
            raise DecodeError(f"frame {position} has dtype {frame.dtype}; {bits} bits come as {self._dtype}")
        self._seen.add(position)
