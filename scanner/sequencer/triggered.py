"""One round of a run whose camera is fired through its trigger line: the host flips, the line does the timing.

Frames are paired by time and by count: a pulse's event (or the camera's own stamp) tells when a frame was exposed,
and the flips tell what shone then. A flip that came a refresh late, a pulse that a busy camera dropped and a false
edge move nothing out of step: they leave patterns without a frame, and those are shown again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from scanner.clock import Clock
from scanner.devices import (
    Camera,
    CameraFrame,
    Exposure,
    Flip,
    Interval,
    Projector,
    SequencedProjector,
    Source,
    TriggerBoard,
    TriggerEvent,
    TriggerSource,
)
from scanner.sequencer.plan import Plan
from scanner.sequencer.trigger_plan import GUARD_NS, guard_ns

Take = Callable[[int, Flip, CameraFrame], None]
"""Called with a pattern, its flip and its frame."""

Check = Callable[[], None]
"""Called between slots; what it raises ends the round."""

ARMED_EARLY = 0.1
"""Share of a refresh after a vertical blank at which the board should be armed: the flip has the rest of it."""


class TriggeredRounds:
    """Runs rounds; keeps what the board said went wrong."""

    def __init__(
        self, plan: Plan, projector: Projector, camera: Camera, board: TriggerBoard | None, clock: Clock
    ) -> None:
        """Nothing moves yet. board: None where the projector drives the line."""
        self._plan, self._projector, self._camera, self._board, self._clock = plan, projector, camera, board, clock
        self._arming_ns = 0
        """how long the board takes to be armed, as last seen"""
        self.faults: list[str] = []
        """what the board reported, in words"""

    def round(self, patterns: Sequence[int], black: int, take: Take, check: Check) -> dict[int, Flip]:
        """Show patterns in turn and take a frame of each; the camera acquires in mode HARDWARE.

        Args:
            patterns: pattern indices; image = index % plan.patterns.
            black: image to show before the first.
            take: gets each frame while its pixels are valid.
            check: called between slots; what it raises ends the round.

        Returns:
            The flips of patterns that got no frame.

        Raises:
            DeviceError: a device failed.
        """
        line = self._camera.capabilities.line_latency
        if isinstance(self._projector, SequencedProjector):
            return self._run_table(self._projector, patterns, Pairing(self._plan, line, with_board=True), take, check)
        guard = guard_ns(None if self._board is None else self._board.capabilities)
        pairing = Pairing(self._plan, line, with_board=self._board is not None, guard=guard)
        try:
            first = self._begin(len(patterns), black)
            for pattern in patterns:
                check()
                flip = self._projector.show(pattern % self._plan.patterns)
                pairing.flipped(pattern, flip)
                self._collect(pairing, take, flip.t_ns + self._hold_ns(flip.vblank - first))
            last = self._clock.now_ns()
            lead = 0 if self._plan.trigger is None else self._plan.trigger.lead
            self._collect(pairing, take, last + lead * self._plan.period_ns + self._plan.pop_timeout_ns, whole=True)
        finally:
            self._end(pairing)
        return pairing.without_frame()

    def _run_table(
        self, projector: SequencedProjector, patterns: Sequence[int], pairing: Pairing, take: Take, check: Check
    ) -> dict[int, Flip]:
        """The projector's own table: its slots' starts are flips, and each one's edge fired the camera."""
        if self._plan.trigger is None:
            raise AssertionError("a plan in mode HARDWARE has its line")
        projector.program(self._plan.trigger.shown([pattern % self._plan.patterns for pattern in patterns]))
        projector.start()
        latency = self._plan.latency or Interval(0, 0)
        until = self._clock.now_ns() + self._plan.pop_timeout_ns + self._plan.period_ns
        events: list[TriggerEvent] = []
        while not (pairing.is_whole and len(events) == len(patterns)) and self._clock.now_ns() < until:
            check()
            frame = self._camera.pop(until - self._clock.now_ns())
            for step, flip in list(enumerate(projector.flips()))[len(events) :]:
                pairing.flipped(patterns[step], flip)
                spread = latency.high_ns - latency.low_ns
                lit_ns = flip.t_ns + latency.low_ns + spread // 2
                events.append(TriggerEvent(0, step, lit_ns, flip.bound_ns + -(-spread // 2), flip.source))
                until = flip.t_ns + self._plan.pop_timeout_ns + self._plan.period_ns
            if frame is not None and (found := pairing.pair(frame, events)) is not None:
                take(*found)
        return pairing.without_frame()

    def _begin(self, patterns: int, black: int) -> int:
        """Arm so that the first edge counted is that of the first flip, or nearly: `Pairing` allows for the rest.

        Returns the vertical blank at which the first pattern should be flipped to.
        """
        flip = self._projector.show(black)
        if self._board is None or self._plan.trigger is None:
            return flip.vblank + 1
        self._board.program(self._plan.trigger.table(patterns, self._plan.dwell), TriggerSource.VSYNC)
        refresh = self._plan.refresh_ns
        passed = -(-(self._clock.now_ns() + self._arming_ns - flip.t_ns) // refresh)
        armed_ns = flip.t_ns + round((passed + ARMED_EARLY) * refresh)
        self._clock.sleep_until(armed_ns - self._arming_ns)
        began = self._clock.now_ns()
        self._board.arm()
        self._arming_ns = self._clock.now_ns() - began
        # The first slot, too, begins at the edge whose number is the dwell.
        self._clock.sleep_until(armed_ns + (self._plan.dwell - 1) * refresh)
        return flip.vblank + passed + self._plan.dwell

    def _hold_ns(self, since_first: int) -> int:
        """Time after a flip in which the host may take frames; half a refresh is left for it to be back in time.

        A board pulses every `dwell` refreshes whatever the host does: a pattern that was late by less stays on until
        the next ones are in step with the pulses again.
        """
        dwell = self._plan.dwell
        late = 0 if self._board is None else since_first % dwell
        stays = dwell + (dwell - late if late else 0)
        return (stays - 1) * self._plan.refresh_ns + self._plan.refresh_ns // 2

    def _collect(self, pairing: Pairing, take: Take, until_ns: int, *, whole: bool = False) -> None:
        """Take frames until then; `whole`: until every pattern has one. A host that is late takes one that waits.

        Else they would pile up until the camera has no room for more.
        """
        taken = 0
        while not (whole and pairing.is_whole):
            left = until_ns - self._clock.now_ns()
            frame = self._camera.pop(max(0, left)) if left > 0 or whole or not taken else None
            if frame is None:
                return
            taken += 1
            found = pairing.pair(frame, () if self._board is None else self._board.events())
            if found is not None:
                take(*found)

    def _end(self, pairing: Pairing) -> None:
        if self._board is None:
            return
        self.faults += [fault.message for fault in self._board.faults()]
        self._board.abort()
        if pairing.uncounted:
            self.faults.append(f"{pairing.uncounted} frames have the number of no pulse at their time: edges were lost")


class Pairing:
    """Which pattern each frame of a round saw. Pure: stamps and counts in, pattern out."""

    def __init__(self, plan: Plan, line_latency: Interval | None, *, with_board: bool, guard: int = GUARD_NS) -> None:
        """Nothing shown yet.

        Args:
            guard: by which pulses follow certain light, ns.
            line_latency: edge to first row's start; None = unknown, and the camera's own stamps stand.
            with_board: pulses have events, and follow the light; else they begin with it.
        """
        self._plan = plan
        self._line = line_latency
        self._with_board = with_board
        self._guard = guard
        self._flips: list[tuple[int, Flip]] = []
        self._have: set[int] = set()
        self._base: int | None = None
        """the camera's trigger number of the board's first pulse, from the first frame that has both"""
        self.uncounted = 0
        """frames whose trigger number belongs to no pulse at their time"""

    @property
    def is_whole(self) -> bool:
        """Every pattern shown so far has a frame."""
        return len(self._have) == len(self._flips)

    def flipped(self, pattern: int, flip: Flip) -> None:
        """A pattern is shown from now on."""
        self._flips.append((pattern, flip))

    def pair(self, frame: CameraFrame, events: Sequence[TriggerEvent]) -> tuple[int, Flip, CameraFrame] | None:
        """The pattern that shone when the frame was exposed, with the frame's best stamp.

        None: it saw what was shown before the round, or its pattern has a frame already.
        """
        stamped = self._stamped(frame, events)
        exposure = stamped.exposure
        # A board's pulse comes GUARD after certain light; a projector's own comes as light begins, and is too early.
        slack = exposure.bound_ns + self._guard if self._with_board else -exposure.bound_ns
        for pattern, flip in reversed(self._flips):
            if exposure.start_ns + slack >= flip.t_ns + self._plan.window_start_ns:
                if pattern in self._have:
                    return None
                self._have.add(pattern)
                return pattern, flip, stamped
        return None

    def without_frame(self) -> dict[int, Flip]:
        """Patterns that got none, with their flips."""
        return {pattern: flip for pattern, flip in self._flips if pattern not in self._have}

    def _stamped(self, frame: CameraFrame, events: Sequence[TriggerEvent]) -> CameraFrame:
        """The frame with the stamp of the pulse that fired it, where count and time agree on which that was."""
        if self._line is None or not events:
            return frame
        event = min(events, key=lambda one: abs(one.t_ns - frame.exposure.start_ns))
        exact = self._exposure(frame.exposure, event)
        apart = abs(exact.start_ns - frame.exposure.start_ns)
        if apart > frame.exposure.bound_ns + exact.bound_ns + self._guard:
            self.uncounted += bool(self._flips)
            return frame
        if not self._counts(frame, event) and frame.exposure.source is Source.ESTIMATED:
            # Only a belief says which pulse it was: so is what follows from it.
            exact = replace(exact, source=Source.ESTIMATED)
        return replace(frame, exposure=exact)

    def _counts(self, frame: CameraFrame, event: TriggerEvent) -> bool:
        """Whether the camera's count of triggers agrees with the board's of pulses."""
        if frame.trigger is None:
            return False
        if self._base is None:
            self._base = frame.trigger - event.step
        agrees = frame.trigger - self._base == event.step
        self.uncounted += not agrees
        return agrees

    def _exposure(self, seen: Exposure, event: TriggerEvent) -> Exposure:
        line = self._line or Interval(0, 0)
        start = event.t_ns + (line.low_ns + line.high_ns) // 2
        bound = event.bound_ns + -(-(line.high_ns - line.low_ns) // 2)
        return Exposure(start, start + seen.end_ns - seen.start_ns, bound, event.source)
