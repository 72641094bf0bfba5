"""The rule, clause by clause, on records made by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner.capture import FrameRecord
from scanner.devices import Exposure, Flip, Source
from scanner.sequencer import Plan, plan, verify
from scanner.sequencer.verify import judge, mixed_share, summary
from tests.unit.test_plan import CAMERA, MCP, PMP, PROJECTOR

PLAN = plan(PROJECTOR, CAMERA, PMP, exposure_ns=4_166_667)
SLOT_NS = 33_333_334


def sound(made: Plan = PLAN, delay_ns: int = 5_000_000) -> list[FrameRecord]:
    """Every frame as it should be: `delay_ns` after its flip."""
    records = []
    for pattern in range(made.frame_count):
        t = 1_000_000_000 + pattern * SLOT_NS
        exposure = Exposure(t + delay_ns, t + delay_ns + made.exposure_ns, 1000, Source.HARDWARE)
        flip = Flip(t, pattern * 2, 0, Source.HARDWARE)
        records.append(FrameRecord(pattern, pattern, frame_id=pattern, exposure=exposure, flip=flip))
    return records


def moved(record: FrameRecord, by_ns: int, **changes: object) -> FrameRecord:
    e = record.exposure
    assert e is not None
    shifted = Exposure(e.start_ns + by_ns, e.end_ns + by_ns, e.bound_ns, e.source)
    return replace(record, exposure=replace(shifted, **changes))  # type: ignore[arg-type]


def test_frames_inside_their_patterns_time_are_proved() -> None:
    verdicts = verify(PLAN, PMP, sound())
    assert summary(verdicts) == {"proved": len(PMP), "consistent": 0, "unproved": 0}
    assert not any(v.suspect for v in verdicts)


def test_an_exposure_that_begins_before_the_light_is_there_is_suspect() -> None:
    records = sound()
    records[4] = moved(records[4], -5_000_000 + 4_700_000 + 999)
    verdict = verify(PLAN, PMP, records)[4]
    assert (verdict.verdict, verdict.suspect) == ("unproved", True)
    assert "before its pattern certainly shone" in verdict.reasons[0]
    records[4] = moved(records[4], 2)
    assert verify(PLAN, PMP, records)[4].verdict == "proved"


def test_an_exposure_that_ends_when_the_next_pattern_may_begin_is_suspect() -> None:
    records = sound()
    last_end = SLOT_NS + 4_000_000 - 1000
    by = last_end - 5_000_000 - PLAN.exposure_ns
    records[4] = moved(records[4], by)
    assert verify(PLAN, PMP, records)[4].verdict == "proved"
    records[4] = moved(records[4], 1)
    verdict = verify(PLAN, PMP, records)[4]
    assert verdict.suspect
    assert "after the next pattern may have begun" in verdict.reasons[0]


def test_the_share_of_another_patterns_light_is_bounded() -> None:
    records = sound()
    assert mixed_share(PLAN, records) == 0
    last_end = SLOT_NS + 4_000_000 - 1000
    records[4] = moved(records[4], last_end - 5_000_000 - PLAN.exposure_ns + PLAN.exposure_ns // 10)
    assert mixed_share(PLAN, records) == pytest.approx(0.1, abs=1e-6)
    records[5] = replace(records[5], exposure=None)
    assert mixed_share(PLAN, records) is None
    unmeasured = plan(replace(PROJECTOR, latency=None), CAMERA, PMP, exposure_ns=4_166_667)
    assert mixed_share(unmeasured, sound(unmeasured)) is None


def test_flips_of_missing_and_repeated_frames_end_a_patterns_time() -> None:
    records = sound()
    late = moved(records[-1], 2 * SLOT_NS)
    assert verify(PLAN, PMP, [*records[:-1], late])[-1].verdict == "proved"
    flip = Flip(1_000_000_000 + len(PMP) * SLOT_NS, 999, 0, Source.HARDWARE)
    retake = FrameRecord(None, 3, 1, "missing", flip=flip)
    assert verify(PLAN, PMP, [*records[:-1], late, retake])[-1].suspect


def test_unmeasured_or_estimated_is_consistent_at_best_and_never_suspect_for_a_little() -> None:
    unmeasured = plan(replace(PROJECTOR, latency=None), CAMERA, PMP, exposure_ns=4_166_667)
    assert unmeasured.trigger_delay_ns > SLOT_NS
    held = [replace(r, flip=replace(r.flip, t_ns=r.flip.t_ns - 0)) for r in sound(unmeasured) if r.flip is not None]
    verdicts = verify(unmeasured, PMP, held)
    assert {v.verdict for v in verdicts} == {"unproved"}
    assert not any(v.suspect for v in verdicts)
    estimated = [moved(r, 0, source=Source.ESTIMATED) for r in sound()]
    verdicts = verify(PLAN, PMP, estimated)
    assert {v.verdict for v in verdicts} == {"consistent"}
    assert "estimate" in verdicts[0].reasons[0]


def test_a_frame_over_before_its_flip_is_suspect_whatever_is_unmeasured() -> None:
    unmeasured = plan(replace(PROJECTOR, latency=None, settle=None), CAMERA, PMP)
    records = [moved(r, -12_000_000, source=Source.ESTIMATED) for r in sound(unmeasured)]
    verdicts = verify(unmeasured, PMP, records)
    assert all(v.suspect for v in verdicts)
    assert any("before its pattern was flipped to" in reason for reason in verdicts[0].reasons)


def test_a_part_of_a_modulation_period_proves_nothing() -> None:
    records = [moved(r, 0, end_ns=r.exposure.end_ns + 1_000_000) for r in sound() if r.exposure is not None]
    verdicts = verify(PLAN, PMP, records)
    assert all("modulation periods" in v.reasons[0] for v in verdicts)
    assert all(v.suspect for v in verdicts)


def test_the_rows_of_a_rolling_shutter_are_judged_each() -> None:
    rolling = plan(PROJECTOR, replace(CAMERA, shutter="rolling", readout_ns=6_000_000), PMP, exposure_ns=4_166_667)
    records = [moved(r, 0, end_ns=r.exposure.end_ns + 6_000_000) for r in sound(rolling) if r.exposure is not None]
    assert {v.verdict for v in verify(rolling, PMP, records)} == {"proved"}


def test_exposures_that_differ_are_named() -> None:
    records = sound()
    records[7] = moved(records[7], 0, end_ns=records[7].exposure.end_ns + 4_166_667)  # type: ignore[union-attr]
    verdicts = verify(PLAN, PMP, records)
    assert [v.pattern for v in verdicts if v.suspect] == [7]
    assert "the others for" in verdicts[7].reasons[-1]


def test_exposures_differ_beyond_a_step_and_what_their_stamps_are_unsure_of() -> None:
    constant = replace(PLAN, modulation_ns=None)
    most = PLAN.step_ns + 2 * (1000 + 1000)
    for by, named in ((most, []), (most + 1, [7])):
        records = sound()
        records[7] = moved(records[7], 0, end_ns=records[7].exposure.end_ns + by)  # type: ignore[union-attr]
        assert [v.pattern for v in verify(constant, PMP, records) if v.suspect] == named


def test_what_a_flip_is_unsure_of_is_taken_off_both_ends_of_a_patterns_time() -> None:
    first_proved = -5_000_000 + 4_700_000 + 1001
    last_proved = SLOT_NS + 4_000_000 - 1000 - 5_000_000 - PLAN.exposure_ns
    for by, unsure in ((first_proved, 4), (last_proved, 5)):
        records = sound()
        records[4] = moved(records[4], by)
        assert verify(PLAN, PMP, records)[4].verdict == "proved"
        flip = records[unsure].flip
        assert flip is not None
        records[unsure] = replace(records[unsure], flip=replace(flip, bound_ns=500))
        assert verify(PLAN, PMP, records)[4].suspect


def test_doubled_ids_backward_stamps_missing_and_incomplete_frames() -> None:
    records = sound()
    records[5] = replace(records[5], frame_id=4)
    records[9] = FrameRecord(None, 9, 0, "missing", flip=records[9].flip)
    records[11] = replace(records[11], status="incomplete")
    verdicts = verify(PLAN, PMP, records)
    assert [v.pattern for v in verdicts if v.suspect] == [4, 5, 9, 11]
    backwards = sound()
    backwards[8] = moved(backwards[8], -2 * SLOT_NS)
    assert "began before that of the frame taken earlier" in " ".join(verify(PLAN, PMP, backwards)[8].reasons)


def test_the_last_line_of_a_pattern_counts() -> None:
    records = sound()
    bad = moved(records[4], -5_000_000)
    t = 1_000_000_000 + (len(PMP) + 1) * SLOT_NS
    e = Exposure(t + 5_000_000, t + 5_000_000 + PLAN.exposure_ns, 1000, Source.HARDWARE)
    again = replace(records[4], attempt=1, slot=99, frame_id=99, exposure=e, flip=Flip(t, 999, 0, Source.HARDWARE))
    verdicts = verify(PLAN, PMP, [*records[:4], bad, *records[5:], again])
    assert verdicts[4].verdict == "proved"


def test_no_stamps_is_unproved_and_not_suspect() -> None:
    verdict = judge(PLAN, FrameRecord(0, 0), None)
    assert (verdict.verdict, verdict.suspect) == ("unproved", False)


def test_static_frames_need_only_begin_after_the_light() -> None:
    made = plan(PROJECTOR, CAMERA, MCP, repeat=4)
    flip = Flip(1_000_000_000, 1, 0, Source.HARDWARE)
    records = [
        FrameRecord(i, i, frame_id=i, flip=flip, exposure=Exposure(t, t + made.exposure_ns, 1000, Source.HARDWARE))
        for i, t in enumerate(range(1_010_000_000, 1_050_000_000, 10_000_000))
    ]
    assert {v.verdict for v in verify(made, MCP, records)} == {"proved"}


@given(st.integers(-40_000_000, 40_000_000))
def test_proved_means_inside_the_window(by_ns: int) -> None:
    records = sound()
    records[6] = moved(records[6], by_ns)
    e, flip, following = records[6].exposure, records[6].flip, records[7].flip
    assert e is not None
    assert flip is not None
    assert following is not None
    inside = e.start_ns - 1000 >= flip.t_ns + 4_700_000 and e.end_ns + 1000 <= following.t_ns + 4_000_000
    assert (judge(PLAN, records[6], following).verdict == "proved") == inside


@pytest.mark.parametrize("count", [0, 3])
def test_an_interrupted_run_is_judged_too(count: int) -> None:
    verdicts = verify(PLAN, PMP, sound()[:count])
    assert len(verdicts) == PLAN.frame_count
    assert sum(v.verdict == "proved" for v in verdicts) == count
