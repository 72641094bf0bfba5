"""Out of step on purpose: never a wrong cloud. Either retakes mend it, or a SyncError names the frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanner.capture import Capture, CaptureHeader, CaptureWriter, FrameRecord
from scanner.decode import Decoded, Reason
from scanner.devices import TriggerMode
from scanner.empty_scan import raise_if_empty
from scanner.errors import DecodeError, DeviceLost, SyncError
from scanner.patterns import PatternSequence, PmpPattern
from scanner.reconstruct import reconstruct
from scanner.sequencer import FinishReason, check_capture, timing_diagram
from service import cli
from tests.unit.sequencer_bench import Taken, gray, pmp, take

EIGHT = pmp((1.0, 8.0), (8, 8))
THREE = pmp((1.0, 8.0), (3, 3))
BLIND = pmp((1.0, 16.0), (3, 3))
"""Both sets rotated by one: 16 / 3 of a fringe from the first set, 1 / 3 from the second, and no remainder."""

FOUR = pmp((1.0, 6.0, 36.0), (4, 4, 4))
PATTERNS = [EIGHT, THREE, BLIND, FOUR]
NAMES = ["N=8", "N=3", "N=3 blind", "N=4"]
MODES = [TriggerMode.SOFTWARE, TriggerMode.FREE]


def shown(sequence: PatternSequence, wrong: dict[int, int]) -> str:
    """A projector that shows image wrong[i] where image i was asked for."""
    return "projector.permute=" + ",".join(str(wrong.get(p, p)) for p in range(len(sequence)))


def sets(sequence: PatternSequence) -> list[Sequence[int]]:
    pattern = sequence.pattern
    assert isinstance(pattern, PmpPattern)
    return [sequence.fringes[s.first : s.first + s.shifts] for s in pattern.sets()]


def turned(sequence: PatternSequence, by: int) -> dict[int, int]:
    """Every set rotated."""
    return {p: group[(i + by) % len(group)] for group in sets(sequence) for i, p in enumerate(group)}


def assert_never_wrong(taken: Taken) -> None:
    """The run was mended and its rows are right, or it failed and named frames."""
    acquisition, sequence = taken.acquisition, taken.sequence
    pattern = sequence.pattern
    assert isinstance(pattern, PmpPattern)
    if acquisition.reason is FinishReason.COMPLETED:
        error = taken.error_px()
        assert error.max() < 240 / max(pattern.frequencies) / 2
        assert np.median(error) < 0.25
        assert all(v.verdict == "proved" for v in acquisition.verdicts)
    else:
        assert acquisition.reason is FinishReason.SYNC_LOST
        assert isinstance(acquisition.error, SyncError)
        assert acquisition.error.frames
        assert set(acquisition.error.frames) <= set(range(len(sequence)))
        assert acquisition.error.hint


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sequence", PATTERNS, ids=NAMES)
def test_in_step_all_frames_are_proved_and_none_is_taken_again(sequence: PatternSequence, mode: TriggerMode) -> None:
    taken = take(sequence, mode=mode)
    assert taken.acquisition.reason is FinishReason.COMPLETED
    assert taken.acquisition.retakes == 0
    assert_never_wrong(taken)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sequence", PATTERNS[:3], ids=NAMES[:3])
@pytest.mark.parametrize(
    "fault",
    [
        "camera.phase_frames=0.5",
        "camera.phase_frames=-0.5",
        "camera.phase_frames=1",
        "camera.stamp_lie_ns=8000000",
        "camera.stamp_lie_ns=-8000000",
        "camera.stamp_lie_ns=20000000",
        "camera.double=7",
        "camera.drop=6",
        "camera.drop=6&camera.drop_hides_id=true",
        "camera.swap=6",
        "camera.jitter_us=12000",
        "camera.incomplete=5",
        "projector.skip=6",
        "projector.double=6",
        "projector.extra_latency_us=9000",
        "projector.extra_latency_us=16667",
        "projector.extra_latency_us=9000&projector.extra_latency_after=8",
    ],
)
def test_faults_of_time_never_give_a_wrong_cloud(sequence: PatternSequence, mode: TriggerMode, fault: str) -> None:
    assert_never_wrong(take(sequence, fault, mode=mode))


@pytest.mark.parametrize("sequence", PATTERNS, ids=NAMES)
def test_a_wrong_order_that_stays_is_a_sync_error(sequence: PatternSequence) -> None:
    first, second = sets(sequence)[:2]
    orders = {
        "swapped": shown(sequence, {first[1]: first[2], first[2]: first[1]}),
        "swapped between sets": shown(sequence, {first[1]: second[2], second[2]: first[1]}),
        "doubled": shown(sequence, {first[2]: first[1]}),
        "every set rotated by one": shown(sequence, turned(sequence, 1)),
        "every set rotated back": shown(sequence, turned(sequence, -1)),
        "every set reversed": shown(
            sequence, {p: q for g in sets(sequence) for p, q in zip(g, reversed(g), strict=True)}
        ),
        "reversed": "projector.order=reverse",
        "late by one": "projector.late_flips=1",
        "late by a whole set": f"projector.late_flips={len(first)}",
        "second set is the first": shown(sequence, dict(zip(second, first, strict=True))),
    }
    for name, faults in orders.items():
        taken = take(sequence, faults)
        assert taken.acquisition.reason is FinishReason.SYNC_LOST, name
        assert_never_wrong(taken)


def test_a_swap_names_the_two_frames() -> None:
    taken = take(EIGHT, "projector.order=swap:5,6")
    error = taken.acquisition.error
    assert isinstance(error, SyncError)
    assert error.frames == (5, 6)
    assert "exchanged" in error.message


@pytest.mark.parametrize("sequence", PATTERNS, ids=NAMES)
@pytest.mark.parametrize(
    "fault",
    ["projector.order=swap:4,5", "projector.skip=5", "camera.double=7", "camera.drop=5", "projector.double=5"],
)
def test_a_fault_that_passes_is_mended_by_retakes(sequence: PatternSequence, fault: str) -> None:
    taken = take(sequence, f"{fault}&times=2" if "swap" in fault else f"{fault}&times=1")
    assert taken.acquisition.reason is FinishReason.COMPLETED
    assert taken.acquisition.retakes > 0
    assert max(record.attempt for record in taken.acquisition.records) >= 1
    assert_never_wrong(taken)


def test_dropped_frames_are_recorded_as_missing_and_taken_again_alone() -> None:
    taken = take(EIGHT, "camera.drop=6,9")
    missing = [r.pattern for r in taken.sink.records if r.status == "missing"]
    assert missing == [6, 9]
    assert taken.acquisition.retakes == 2
    assert taken.acquisition.missing == ()


def test_what_never_comes_is_named() -> None:
    taken = take(EIGHT, "camera.drop_probability=1.0")
    error = taken.acquisition.error
    assert isinstance(error, SyncError)
    assert error.frames == tuple(range(len(EIGHT)))
    assert taken.acquisition.missing == tuple(range(len(EIGHT)))


def test_a_late_retake_takes_the_whole_set_again() -> None:
    from drivers.registry import open_camera, open_projector  # noqa: PLC0415
    from scanner.clock import VirtualClock  # noqa: PLC0415
    from scanner.sequencer import Rig, acquire  # noqa: PLC0415
    from tests.unit.sequencer_bench import MemorySink  # noqa: PLC0415

    clock, device = VirtualClock(), "quick/board?seed=1&camera.drop=4"
    projector, camera = open_projector("simulated", device, {}, clock), open_camera("simulated", device, {}, clock)
    rig, sink = Rig(projector, camera), MemorySink()
    made = rig.plan(EIGHT, exposure_ns=12_500_001, max_set_ms=100)
    acquisition = acquire(rig, made, EIGHT, sink, clock)
    assert acquisition.reason is FinishReason.COMPLETED
    assert [r.pattern for r in sink.records if r.attempt == 1] == list(range(3, 11))
    camera.close()
    projector.close()


@pytest.mark.parametrize("mode", MODES)
def test_a_lost_camera_ends_the_run_with_what_was_whole(mode: TriggerMode) -> None:
    taken = take(EIGHT, "camera.unplug_after=9", mode=mode)
    acquisition = taken.acquisition
    assert acquisition.reason is FinishReason.DEVICE_LOST
    assert 0 < len(acquisition.records) <= 9
    assert all(record.slot is not None for record in acquisition.records)
    with pytest.raises(DeviceLost):
        acquisition.raise_for_reason()


def test_a_lost_projector_ends_the_run() -> None:
    assert take(EIGHT, "projector.unplug_after=4").acquisition.reason is FinishReason.DEVICE_LOST


def test_a_cancelled_run_ends_between_slots() -> None:
    calls = iter(range(100))
    taken = take(EIGHT, cancelled=lambda: next(calls) >= 5)
    assert taken.acquisition.reason is FinishReason.CANCELLED
    assert [r.pattern for r in taken.acquisition.records] == [0, 1, 2, 3, 4]
    taken.acquisition.raise_for_reason()


def test_a_projector_that_is_off_is_said_at_once() -> None:
    taken = take(EIGHT, shown(EIGHT, dict.fromkeys(range(len(EIGHT)), 0)))
    assert taken.acquisition.reason is FinishReason.SYNC_LOST
    assert isinstance(taken.acquisition.error, DecodeError)
    assert "lens cap" in (taken.acquisition.error.hint or "")
    assert taken.acquisition.retakes == 0


def test_frames_are_told_as_they_are_recorded() -> None:
    told: list[tuple[int, int | None]] = []
    taken = take(EIGHT, "camera.drop=3", on_frame=lambda record, offset: told.append((record.pattern, offset)))
    assert told[3] == (3, None)
    assert told[-1][0] == 3
    assert told[0] == (0, 128)
    assert len(told) == len(taken.acquisition.records)


@pytest.mark.parametrize("order", ["swap:5,6", "swap:7,8", "rotate:5,16,2", "swap:19,20"])
def test_gray_code_out_of_order_is_a_sync_error_and_mended_where_it_passes(order: str) -> None:
    sequence = gray(bits=8)
    error = take(sequence, f"projector.order={order}").acquisition.error
    assert isinstance(error, SyncError)
    assert set(error.frames) <= set(sequence.fringes)
    taken = take(sequence, f"projector.order={order}&times=2")
    assert taken.acquisition.reason is FinishReason.COMPLETED
    assert taken.acquisition.retakes > 0
    assert np.median(taken.error_px()) < 1


# --- from the folder ----------------------------------------------------------------------------------------------


def written(folder: Path, taken: Taken, wrong: dict[int, int] | None = None) -> Capture:
    """A run as a capture folder; `wrong` shows frames in another order under stamps that say nothing of it."""
    plan = taken.acquisition.plan
    header = CaptureHeader(taken.sequence, taken.format, id="test", plan=plan.as_dict())
    writer = CaptureWriter(folder, header, plan.frame_count)
    for record in taken.sink.records:
        source = taken.acquisition.last[(wrong or {}).get(record.pattern, record.pattern)]
        assert source.slot is not None
        slot, found = writer.write(taken.sink.frames[source.slot])
        writer.record(FrameRecord(**{**record.__dict__, "slot": slot, "xxh3": found}))
    writer.close("complete", witnesses=taken.acquisition.witnesses.as_list())
    return Capture.open(folder)


def test_a_sound_folder_passes_its_audit(tmp_path: Path) -> None:
    check = check_capture(written(tmp_path / "capture", take(BLIND))).raise_if_out_of_step()
    assert check.summary()["proved"] == len(BLIND)
    assert check.as_dict()["passed"]
    assert check.suspects == ()


@pytest.mark.parametrize("sequence", PATTERNS, ids=NAMES)
def test_an_audit_finds_what_the_stamps_do_not_tell(tmp_path: Path, sequence: PatternSequence) -> None:
    capture = written(tmp_path / "capture", take(sequence), turned(sequence, 1))
    check = check_capture(capture)
    assert check.summary()["proved"] == len(sequence)
    with pytest.raises(SyncError) as error:
        check.raise_if_out_of_step()
    assert error.value.frames


def test_an_audit_finds_a_stamp_outside_its_patterns_time(tmp_path: Path) -> None:
    taken = take(EIGHT)
    exposure = taken.sink.records[9].exposure
    assert exposure is not None
    early = replace(exposure, start_ns=exposure.start_ns - 10_000_000, end_ns=exposure.end_ns - 10_000_000)
    taken.sink.records[9] = replace(taken.sink.records[9], exposure=early)
    with pytest.raises(SyncError) as error:
        check_capture(written(tmp_path / "capture", taken)).raise_if_out_of_step()
    assert error.value.frames == (9,)


# --- what a user is told ------------------------------------------------------------------------------------------


def test_light_that_comes_a_refresh_late_is_metered_right_and_accused() -> None:
    from drivers.registry import open_camera, open_projector  # noqa: PLC0415
    from scanner.clock import VirtualClock  # noqa: PLC0415
    from scanner.sequencer import auto_exposure  # noqa: PLC0415

    chosen = []
    for extra in (0, 20_000):
        clock, device = VirtualClock(), f"quick/board?seed=1&extra_latency_us={extra}"
        projector, camera = open_projector("simulated", device, {}, clock), open_camera("simulated", device, {}, clock)
        chosen.append(auto_exposure(projector, camera, clock).exposure_ns)
        camera.close()
        projector.close()
    assert chosen[0] == chosen[1]
    for exposure_ns in (chosen[1], 133_333_000):
        taken = take(EIGHT, "extra_latency_us=20000", exposure_ns=exposure_ns)
        assert taken.acquisition.reason is FinishReason.SYNC_LOST, exposure_ns
        assert_never_wrong(taken)


def test_a_whole_sequence_in_doubt_is_named_shortly() -> None:
    error = take(EIGHT, "order=reverse").acquisition.error
    assert isinstance(error, SyncError)
    assert error.frames == tuple(range(len(EIGHT)))
    assert f" and the order of all {len(EIGHT)} out of step" in error.message
    assert "raise dwell" in (error.hint or "")


def test_the_scan_and_the_audit_name_the_same_frames_and_none_of_them_is_called_proved_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = take(EIGHT, "late_flips=5")
    folder = written(tmp_path / "capture", taken).path
    assert cli.main(["audit", str(folder)]) == 1
    out, err = capsys.readouterr()
    check = check_capture(Capture.open(folder))
    assert check.suspects
    assert f"concerned: {check.concerned}\n" in err
    assert str(taken.acquisition.error).startswith(f"{check.concerned} out of step")
    lines = out.splitlines()[1:]
    for position, frame in enumerate(check.as_dict()["frames"]):
        said = "against: " + ", ".join(frame["against"]) if frame["against"] else "order in doubt"
        assert (frame["verdict"], bool(frame["against"])) == ("proved", position in check.suspects)
        assert lines[position].split(maxsplit=3)[2:] == ["proved", said]
    drawn = timing_diagram(check).decode()
    for position in range(len(EIGHT)):
        tip = re.search(rf"<title>frame {position}, (?!.*taken again).*</title>", drawn)
        assert tip is not None
        assert ("suspect; its picture: against " in tip[0]) == (position in check.suspects)
    assert re.search(rf"^by pictures +{len(check.suspects)} of {len(EIGHT)} contradicted$", out, re.MULTILINE)


def test_a_folder_out_of_step_is_not_told_to_measure_latencies(tmp_path: Path) -> None:
    with pytest.raises(SyncError) as error:
        check_capture(written(tmp_path / "capture", take(EIGHT), {5: 6, 6: 5})).raise_if_out_of_step()
    assert error.value.frames == (5, 6)
    assert "capture.json" in (error.value.hint or "")
    assert "dwell" not in (error.value.hint or "")


def test_a_folder_with_a_plan_and_no_stamps_is_judged_by_its_content(tmp_path: Path) -> None:
    capture = written(tmp_path / "capture", take(EIGHT))
    (capture.path / "frames.jsonl").unlink()
    check = check_capture(Capture.open(capture.path)).raise_if_out_of_step()
    assert check.summary() == {"proved": 0, "consistent": 0, "unproved": len(EIGHT)}


def test_a_scan_without_a_single_value_is_an_error_that_says_why() -> None:
    reason = np.full((20, 30), Reason.UNWRAP_RISK, dtype=np.uint8)
    reason[:15] = Reason.SHADOW
    empty = np.full(reason.shape, np.nan, dtype=np.float32)
    zeros = np.zeros_like(empty)
    decoded = Decoded(empty, None, empty, None, zeros, zeros, zeros, reason)
    with pytest.raises(DecodeError, match="450 in shadow, 150 of no certain fringe") as error:
        raise_if_empty(decoded)
    assert "order of the frames" in (error.value.hint or "")
    reason[0, 0] = Reason.VALUE
    raise_if_empty(decoded)


def test_three_shifts_all_reversed_never_give_an_empty_success(tmp_path: Path) -> None:
    sequence = pmp((1.0, 8.0, 64.0), (3, 3, 3))
    wrong = dict(zip(sequence.fringes, sequence.fringes[::-1], strict=True))
    capture = written(tmp_path / "capture", take(sequence), wrong)
    with pytest.raises((SyncError, DecodeError)) as error:
        reconstruct(capture, None)
    assert error.value.hint
