"""The camera's count of frames without its wrap, so that no two frames of a run have the same."""

from __future__ import annotations

ID_WRAP = 0xFFFF
"""GigE Vision 1.x counts frames 1 .. 65535 and begins again"""


class FrameIds:
    """Goes on counting where the camera begins again."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._wraps = 0

    def next(self, frame_id: int) -> int:
        """The count that goes on. A step back of less than half the range is a late frame, not a wrap."""
        if frame_id > ID_WRAP:  # extended ids have 64 bits
            return frame_id
        if self._last is not None and self._last - frame_id > ID_WRAP // 2:
            self._wraps += 1
        self._last = frame_id
        return frame_id + self._wraps * ID_WRAP
