"""Plans of runs whose camera is fired through its trigger line, and which pulse made which frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from scanner.devices import (
    CameraFrame,
    Exposure,
    Flip,
    Interval,
    Source,
    TriggerEvent,
    TriggerMode,
    TriggerSource,
)
from scanner.errors import ConfigError
from scanner.patterns import McpPattern, PatternSequence
from scanner.sequencer import Plan
from scanner.sequencer.plan import Mode, plan
from scanner.sequencer.triggered import Pairing
from scanner.trigger_protocol import CAPABILITIES
from tests.unit.sequencer_bench import QUICK, pmp
from tests.unit.triggered_bench import CAMERA, MS, PROJECTOR, REFRESH

BOARD = replace(CAPABILITIES, event_bound_ns=5_000)
SEQUENCE = pmp()


def planned(sequence: PatternSequence = SEQUENCE, **changes: Any) -> Plan:
    return plan(PROJECTOR, CAMERA, sequence, **{"exposure_ns": 8 * MS, "board": BOARD, **changes})


# --- the plan -----------------------------------------------------------------------------------------------------


def test_a_board_makes_every_refresh_a_pattern() -> None:
    made = planned()
    assert made.mode is Mode.HARDWARE
    assert made.dwell == 1
    assert made.trigger is not None
    assert (made.trigger.line, made.trigger.lead) == ("board", 0)
    assert made.trigger.dark_us == 5_600
    assert made.trigger.dark_us + made.trigger.pulse_us < REFRESH / 1000
    assert "after a vertical blank" in made.why["trigger"]
    assert Plan.from_dict(made.as_dict()) == made


def test_light_that_comes_after_the_next_flip_puts_pulses_slots_behind() -> None:
    made = planned(latency=Interval(39 * MS, 40 * MS))
    assert made.dwell == 1
    assert made.trigger is not None
    assert made.trigger.lead == 2
    assert made.trigger.dark_us == -(-(40_600_000 - 2 * REFRESH) // 1000)


def test_pulses_keep_away_from_changing_light_by_what_their_events_are_unsure_of() -> None:
    loose = planned(board=replace(BOARD, event_bound_ns=400_000))
    assert loose.trigger is not None
    assert loose.trigger.dark_us == 6_301


def test_a_long_exposure_takes_more_refreshes() -> None:
    made = planned(exposure_ns=20 * MS)
    assert made.dwell == 2
    assert made.trigger is not None
    assert {slot.edges for slot in made.trigger.table(4, made.dwell)} == {2}
    assert len(made.trigger.table(4, made.dwell)) == 8


def test_a_camera_that_is_not_ready_in_time_gets_it() -> None:
    slow = replace(CAMERA, min_gap_ns=12 * MS)
    assert plan(PROJECTOR, slow, SEQUENCE, exposure_ns=8 * MS, board=BOARD).dwell == 2


def test_what_cannot_pulse_the_line_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs a trigger board"):
        planned(board=None, trigger_mode=TriggerMode.HARDWARE)
    with pytest.raises(ConfigError, match="vertical-sync"):
        planned(board=replace(BOARD, sources=frozenset({TriggerSource.INTERNAL})))
    untriggered = replace(CAMERA, trigger_modes=frozenset({TriggerMode.FREE}))
    with pytest.raises(ConfigError, match="no trigger mode"):
        plan(PROJECTOR, untriggered, SEQUENCE, board=BOARD, trigger_mode=TriggerMode.HARDWARE)


def test_what_is_asked_for_goes_before_the_board() -> None:
    assert planned(trigger_mode=TriggerMode.SOFTWARE).mode is Mode.SOFTWARE
    assert planned(trigger_mode=TriggerMode.FREE).mode is Mode.FREE
    one = PatternSequence(QUICK, McpPattern())
    assert planned(one).mode is Mode.STATIC


# --- pairing ------------------------------------------------------------------------------------------------------


def frame(start_ns: int, trigger: int | None = None, source: Source = Source.HARDWARE) -> CameraFrame:
    return CameraFrame(None, 0, Exposure(start_ns, start_ns + 8 * MS, MS, source), trigger=trigger)  # type: ignore[arg-type]


def paired(shown: int = 4) -> tuple[Pairing, list[TriggerEvent]]:
    """A pairing with flips at every refresh, and the events of a board that pulses 5.6 ms after each."""
    pairing = Pairing(planned(), CAMERA.line_latency, with_board=True)
    for i in range(shown):
        pairing.flipped(i, Flip(i * REFRESH, i, 0, Source.HARDWARE))
    return pairing, [TriggerEvent(0, i, i * REFRESH + 5_600_000, 2_000, Source.HARDWARE) for i in range(shown)]


def test_a_frame_belongs_to_what_shone_and_has_its_pulses_stamp() -> None:
    pairing, events = paired()
    found = pairing.pair(frame(2 * REFRESH + 5_900_000, trigger=2), events)
    assert found is not None
    pattern, flip, stamped = found
    assert (pattern, flip.vblank) == (2, 2)
    assert stamped.exposure == Exposure(2 * REFRESH + 5_610_000, 2 * REFRESH + 13_610_000, 7_000, Source.HARDWARE)
    assert list(pairing.without_frame()) == [0, 1, 3]


def test_a_second_frame_and_one_from_before_are_left() -> None:
    pairing, events = paired()
    assert pairing.pair(frame(-5 * MS), events) is None
    assert pairing.pair(frame(5_600_000), events) is not None
    assert pairing.pair(frame(7 * MS), events) is None


def test_counts_that_disagree_are_told_and_time_decides() -> None:
    pairing, events = paired()
    first = pairing.pair(frame(5_600_000, trigger=7), events)
    assert first is not None
    assert first[0] == 0
    later = pairing.pair(frame(REFRESH + 5_600_000, trigger=9), events)
    assert later is not None
    assert later[0] == 1
    assert pairing.uncounted == 1


def test_a_believed_stamp_without_a_count_stays_a_belief() -> None:
    pairing, events = paired()
    found = pairing.pair(frame(5_600_000, source=Source.ESTIMATED), events)
    assert found is not None
    assert found[2].exposure.source is Source.ESTIMATED
    counted = pairing.pair(frame(REFRESH + 5_600_000, trigger=1, source=Source.ESTIMATED), events)
    assert counted is not None
    assert counted[2].exposure.source is Source.HARDWARE
