"""Frames of the simulated camera that were rendered beforehand and are handed out in turn, for tests of rate."""

from __future__ import annotations

from collections.abc import Callable

from drivers.simulated.exposures import STAMP_BOUND_NS, Window
from drivers.simulated.timeline import Timeline
from scanner.devices import CameraFrame, Exposure, Pixels, Source


class Ring:
    """So many frames of one light."""

    def __init__(self, count: int, timeline: Timeline, render: Callable[[Window], Pixels]) -> None:
        """count: frames; 0 for a camera that renders each frame anew. render: gives a frame of its own memory."""
        self._count, self._timeline, self._render = count, timeline, render
        self._frames: list[Pixels] = []
        self._shows: list[object] = []
        self._handed_out = 0
        self._end_ns = 0

    def clear(self) -> None:
        """The camera's settings have changed."""
        self._frames = []

    def fill(self, now_ns: int, exposure_ns: int) -> None:
        """Render frames of what shone during the last exposure's time, unless that is what they show."""
        self._handed_out = self._end_ns = 0
        start = now_ns - exposure_ns
        segments = self._timeline.between(start, now_ns)
        # One image all through looks the same whenever it was flipped to; a change within the exposure never does.
        images = [segment.image for segment in segments]
        one = all(image is images[0] for image in images)
        shows: list[object] = [images[0]] if one else [segment.on_ns for segment in segments]
        if len(self._frames) == self._count and shows == self._shows:
            return
        self._shows = shows
        self._frames = [self._render(Window(start, exposure_ns, number)) for number in range(self._count)]

    def pixels(self, number: int) -> Pixels | None:
        """Those of frame `number`; None: there is no ring."""
        return self._frames[number % self._count] if self._count else None

    def next(self, now_ns: int, exposure_ns: int) -> CameraFrame:
        """A frame at once; its stamps follow one another without overlap, however fast it is asked."""
        start = max(now_ns - exposure_ns, self._end_ns)
        self._end_ns = max(now_ns, start)
        number = self._handed_out
        self._handed_out += 1
        exposure = Exposure(start, self._end_ns, STAMP_BOUND_NS, Source.HARDWARE)
        return CameraFrame(self._frames[number % self._count], number, exposure)
