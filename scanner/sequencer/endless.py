"""Frames without end: one pattern stays on, and every frame of the camera is handed on as it comes.

The same devices, plan and rule as a run of `run.acquire` in mode static (or, where the camera takes software triggers
only, one trigger after the other), but nothing is kept here: memory does not grow with the length of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace

from scanner.capture import FrameRecord
from scanner.clock import Clock
from scanner.devices import CameraFrame, Flip, KnowsPresence, Pixels, TriggerMode
from scanner.errors import DeviceLost
from scanner.patterns import PatternSequence
from scanner.sequencer.plan import Mode, Plan
from scanner.sequencer.rig import Rig
from scanner.sequencer.steady import Steady
from scanner.sequencer.verify import judge

PATIENCE = 3
"""Frames in a row that may stay away before the camera counts as lost: each had its time and half a second."""

LOOK_NS = 500_000_000
"""From one look at the projector to the next: nothing else is asked of it, and frames come without its light too."""


@dataclass(frozen=True, eq=False)
class EndlessFrame:
    """One frame: its pixels, lent until the next one, and its line as a capture has it, judged, without a slot."""

    pixels: Pixels
    record: FrameRecord
    lost: int
    """frames that the camera counted since the one before, and that never came"""


def endless(
    rig: Rig,
    plan: Plan,
    sequence: PatternSequence,
    clock: Clock,
    cancelled: Callable[[], bool],
    *,
    load: bool = True,
) -> Generator[EndlessFrame, None, None]:
    """Show the one pattern and yield frames until `cancelled` says so. Whole frames, each exposed in the new light.

    The camera is stopped when the iterator is closed or ends, whatever ends it.

    Args:
        plan: of this one-image sequence.
        cancelled: asked before every frame.
        load: whether to load the image; False when the projector holds it already.

    Raises:
        ConfigError: the camera refuses the settings.
        DeviceLost: a device went away, or the camera gives no frames any more.
        DeviceError: a device refuses something.
    """
    camera = rig.camera
    if load:
        rig.projector.load([rig.oriented(sequence.image(0))])
    camera.apply(replace(rig.settings, exposure_ns=plan.exposure_ns))
    flip = rig.projector.show(0)
    # One exposure of the new light alone before the first: what a camera has begun, or keeps ready, shows nothing else.
    clock.sleep_until(flip.t_ns + flip.bound_ns + plan.trigger_delay_ns + plan.exposure_ns)
    triggered = plan.mode is Mode.SOFTWARE
    camera.start(TriggerMode.SOFTWARE if triggered else TriggerMode.FREE)
    steady, absent, lost = Steady(plan, flip), 0, 0
    looked_ns = clock.now_ns()
    try:
        while not cancelled():
            if clock.now_ns() - looked_ns >= LOOK_NS:
                looked_ns = clock.now_ns()
                if isinstance(rig.projector, KnowsPresence):
                    rig.projector.check_present()
            if triggered:
                camera.trigger()
            frame = camera.pop(plan.pop_timeout_ns)
            if frame is None:
                absent += 1
                if absent == PATIENCE:
                    raise DeviceLost(
                        f"no frame came in {PATIENCE * plan.pop_timeout_ns / 1e9:.1f} s",
                        device=camera.name,
                        hint="look at the camera's cable and link, and start again",
                    )
                continue
            absent = 0
            if (before := steady.lost_before(frame)) is None:
                continue
            lost += before
            if not frame.complete:
                lost += 1  # half a frame is a lost one
                continue
            yield EndlessFrame(frame.pixels, _record(plan, flip, frame), lost)
            lost = 0
    finally:
        camera.stop()


def _record(plan: Plan, flip: Flip, frame: CameraFrame) -> FrameRecord:
    record = FrameRecord(None, 0, frame_id=frame.frame_id, trigger=frame.trigger, exposure=frame.exposure, flip=flip)
    return replace(record, verdict=judge(plan, record, None).verdict)
