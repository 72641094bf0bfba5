"""The proof from time stamps: which frames certainly saw their pattern. Pure: plan and records in, verdicts out.

The rule (architecture.md, Plan, run, verify). A frame belongs to a pattern only if
(a) from its first row's start to its last row's end, with bounds, it lies inside
    [flip + latency + settle, next flip + latency], with bounds;
(b) on a time-multiplexed projector each row's exposure is a whole number of modulation periods;
(c) exposures are the same for the whole set.
Stamps can lie; what the frames show is judged in `witness`.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from scanner.capture import FrameRecord, Verdict
from scanner.devices import Exposure, Flip, Source
from scanner.patterns import PatternSequence
from scanner.sequencer.plan import Mode, Plan


@dataclass(frozen=True)
class FrameVerdict:
    """What the stamps say of one frame of the capture.

    proved: the intervals hold with their bounds, all of them measured. consistent: they hold as far as is known.
    unproved: not shown, or contradicted; `suspect` is set where trustworthy stamps contradict it, or it is not there.
    """

    pattern: int
    """repetition x patterns + position"""
    verdict: Verdict
    reasons: tuple[str, ...] = ()
    suspect: bool = False


def verify(plan: Plan, sequence: PatternSequence, records: Sequence[FrameRecord]) -> list[FrameVerdict]:
    """Judge every frame of a run by its stamps.

    Args:
        records: every line of frames.jsonl, retakes and missing frames too (their flips end other patterns' time);
            the last line of a pattern is the one that is judged.

    Returns:
        One verdict a pattern index, 0 .. plan.frame_count - 1.
    """
    last = {record.pattern: record for record in records if record.pattern < plan.frame_count}
    flips = _flips(records)
    times = [flip.t_ns for flip in flips]
    ids = Counter(record.frame_id for record in last.values() if record.slot is not None)
    # The frames of a static pattern are decoded one by one: (c) has nothing to compare.
    typical = _typical_exposure(last) if plan.mode is not Mode.STATIC else None
    backwards = _backwards(last)
    verdicts = []
    for pattern in range(plan.frame_count):
        record = last.get(pattern)
        if record is None or record.status == "missing":
            verdicts.append(FrameVerdict(pattern, "unproved", ("the frame is missing",), suspect=True))
            continue
        found = judge(plan, record, _next(flips, times, record.flip))
        extra = []
        if record.frame_id is not None and ids[record.frame_id] > 1:
            extra.append(f"frame id {record.frame_id} came more than once")
        if pattern in backwards:
            extra.append("its exposure began before that of the frame taken earlier")
        if typical is not None and record.exposure is not None and _differs(record.exposure, typical, plan.step_ns):
            extra.append(
                f"exposed for {_ms(record.exposure.end_ns - record.exposure.start_ns)}, "
                f"the others for {_ms(typical.end_ns - typical.start_ns)}"
            )
        if extra:
            found = replace(found, verdict="unproved", reasons=(*found.reasons, *extra), suspect=True)
        verdicts.append(found)
    return verdicts


def judge(plan: Plan, record: FrameRecord, next_flip: Flip | None) -> FrameVerdict:
    """Judge one frame by (a) and (b) alone. next_flip None: the pattern was still on when the frame had arrived."""
    if record.status != "ok":
        return FrameVerdict(record.pattern, "unproved", (f"the frame is {record.status}",), suspect=True)
    exposure, flip = record.exposure, record.flip
    if exposure is None or flip is None:
        return FrameVerdict(record.pattern, "unproved", ("no time stamps",))
    believed = _belief(plan, exposure, flip)
    outside = _outside(plan, exposure, flip, next_flip)
    partial = _partial_modulation(plan, exposure)
    if not outside and not partial:
        return FrameVerdict(record.pattern, "consistent" if believed else "proved", tuple(believed))
    certain = _certainly_outside(plan, exposure, flip, next_flip)
    # A static pattern's frame with a partial modulation period has wrong greys; no other frame would be more in step.
    suspect = bool(certain) or (not believed and (bool(outside) or plan.mode is not Mode.STATIC))
    nominal = not partial and not _outside(plan, _exact(exposure), replace(flip, bound_ns=0), _sharp(next_flip))
    verdict: Verdict = "consistent" if nominal and believed and not certain else "unproved"
    return FrameVerdict(record.pattern, verdict, (*outside, *partial, *certain, *believed), suspect)


def mixed_share(plan: Plan, records: Sequence[FrameRecord]) -> float | None:
    """Largest share of an exposure in which another pattern may have shone, bounds included; 0 where all are inside.

    Returns:
        None where a frame has no stamps, or latency and settling were not measured.
    """
    last = {record.pattern: record for record in records if record.pattern < plan.frame_count}
    flips = _flips(records)
    times = [flip.t_ns for flip in flips]
    share = 0.0
    for record in last.values():
        exposure, flip = record.exposure, record.flip
        if record.status != "ok":
            continue
        if exposure is None or flip is None or not plan.measured:
            return None
        early, late = _excess(plan, exposure, flip, _next(flips, times, flip))
        share = max(share, (max(early, 0) + max(late, 0)) / max(exposure.end_ns - exposure.start_ns, 1))
    return share


def summary(verdicts: Sequence[FrameVerdict]) -> Mapping[str, int]:
    """Number of frames by verdict."""
    counts = Counter(verdict.verdict for verdict in verdicts)
    return {name: counts[name] for name in ("proved", "consistent", "unproved")}


def _belief(plan: Plan, exposure: Exposure, flip: Flip) -> list[str]:
    """Why an interval that holds is still no proof."""
    reasons = []
    if not plan.measured:
        reasons.append("latency and settling of the projector were not measured")
    if exposure.source is Source.ESTIMATED:
        reasons.append("the camera's stamp is an estimate")
    if flip.source is Source.ESTIMATED and plan.mode is not Mode.STATIC:
        reasons.append("the flip's stamp is an estimate")
    return reasons


def _outside(plan: Plan, exposure: Exposure, flip: Flip, next_flip: Flip | None) -> list[str]:
    """(a): where the exposure, with bounds, leaves the pattern's time."""
    reasons = []
    early, late = _excess(plan, exposure, flip, next_flip)
    if early > 0:
        reasons.append(f"began {_ms(early)} before its pattern certainly shone (bounds included)")
    if late > 0:
        reasons.append(f"ended {_ms(late)} after the next pattern may have begun (bounds included)")
    return reasons


def _excess(plan: Plan, exposure: Exposure, flip: Flip, next_flip: Flip | None) -> tuple[int, int]:
    """By how much an exposure, with bounds, begins before its pattern and ends after it, ns; negative inside."""
    ready = flip.t_ns + flip.bound_ns + plan.window_start_ns
    early = ready - (exposure.start_ns - exposure.bound_ns)
    if next_flip is None:
        return early, -1
    gone = next_flip.t_ns - next_flip.bound_ns + plan.window_end_ns
    return early, exposure.end_ns + exposure.bound_ns - gone


def _certainly_outside(plan: Plan, exposure: Exposure, flip: Flip, next_flip: Flip | None) -> list[str]:
    """Contradictions that no unmeasured latency and no estimate within its bound can explain."""
    reasons = []
    if exposure.end_ns + exposure.bound_ns < flip.t_ns - flip.bound_ns:
        reasons.append("was over before its pattern was flipped to")
    if next_flip is not None:
        gone = next_flip.t_ns + next_flip.bound_ns + plan.window_start_ns
        if exposure.start_ns - exposure.bound_ns > gone:
            reasons.append("began after the next pattern was there")
    return reasons


def _partial_modulation(plan: Plan, exposure: Exposure) -> list[str]:
    """(b): a row's exposure that is no whole number of modulation periods."""
    if plan.modulation_ns is None:
        return []
    row = exposure.end_ns - exposure.start_ns - plan.rolling_ns
    rest = abs(row - max(1, round(row / plan.modulation_ns)) * plan.modulation_ns)
    if rest > plan.step_ns + 2 * exposure.bound_ns:
        return [f"a row was exposed for {_ms(row)}, no whole number of modulation periods ({_ms(plan.modulation_ns)})"]
    return []


def _flips(records: Sequence[FrameRecord]) -> list[Flip]:
    found = {record.flip.t_ns: record.flip for record in records if record.flip is not None}
    return [found[t] for t in sorted(found)]


def _next(flips: Sequence[Flip], times: Sequence[int], flip: Flip | None) -> Flip | None:
    if flip is None:
        return None
    index = bisect_right(times, flip.t_ns)
    return flips[index] if index < len(flips) else None


def _typical_exposure(last: Mapping[int, FrameRecord]) -> Exposure | None:
    """(c): the exposure of median length, to compare the others with."""
    exposures = [record.exposure for record in last.values() if record.exposure is not None]
    exposures.sort(key=lambda exposure: exposure.end_ns - exposure.start_ns)
    return exposures[len(exposures) // 2] if exposures else None


def _differs(exposure: Exposure, typical: Exposure, step_ns: int) -> bool:
    difference = abs((exposure.end_ns - exposure.start_ns) - (typical.end_ns - typical.start_ns))
    return difference > step_ns + 2 * (exposure.bound_ns + typical.bound_ns)


def _backwards(last: Mapping[int, FrameRecord]) -> set[int]:
    """Patterns whose exposure began before that of a frame whose flip came earlier."""
    stamped = [record for record in last.values() if record.exposure is not None and record.flip is not None]
    stamped.sort(key=lambda record: (record.flip.t_ns if record.flip else 0, record.slot or 0))
    found, latest, bound = set(), None, 0
    for record in stamped:
        exposure = record.exposure
        if exposure is None:
            continue
        if latest is not None and exposure.start_ns + exposure.bound_ns + bound < latest:
            found.add(record.pattern)
        if latest is None or exposure.start_ns > latest:
            latest, bound = exposure.start_ns, exposure.bound_ns
    return found


def _exact(exposure: Exposure) -> Exposure:
    return replace(exposure, bound_ns=0)


def _sharp(flip: Flip | None) -> Flip | None:
    return None if flip is None else replace(flip, bound_ns=0)


def _ms(ns: float) -> str:
    return f"{ns / 1e6:.3g} ms"
