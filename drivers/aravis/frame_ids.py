"""The camera's count of frames without its wrap, so that no two frames of a run have the same."""

from __future__ import annotations

ID_WRAP = 0xFFFF
"""GigE Vision 1.x counts frames 1 .. 65535 and begins again"""


class FrameIds:
    """Goes on counting where the camera begins again."""

    def __init__(self) -> None:
        self._last: int | None = None

    def next(self, frame_id: int) -> int:
        """The count nearest to the last one: a small step back is a late frame, a large one a wrap."""
        count = frame_id
        if self._last is not None and frame_id <= ID_WRAP:  # extended ids have 64 bits
            half = ID_WRAP // 2
            count = self._last + (frame_id - self._last + half) % ID_WRAP - half
        self._last = count
        return count
