"""One pattern that stays on, and frames as they come: which of them saw it, and how many were lost on the way. Pure."""

from __future__ import annotations

from scanner.devices import CameraFrame, Flip
from scanner.sequencer.plan import Plan


class Steady:
    """The frames after one flip, in their order."""

    def __init__(self, plan: Plan, flip: Flip) -> None:
        self._ready_ns = flip.t_ns + flip.bound_ns + plan.window_start_ns
        self._expected: int | None = None

    def lost_before(self, frame: CameraFrame) -> int | None:
        """Frames that the camera counted since the one before, and that never came; None: it saw the old light, too."""
        if frame.exposure.start_ns - frame.exposure.bound_ns < self._ready_ns:
            return None
        lost = 0 if self._expected is None else max(0, frame.frame_id - self._expected)
        self._expected = frame.frame_id + 1
        return lost
