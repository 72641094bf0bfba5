"""What to do about frames in doubt: which frames belong to one moment, and the error that names them."""

from __future__ import annotations

from collections.abc import Sequence

from scanner.errors import DecodeError, ScannerError, SyncError
from scanner.patterns import FrameRole, PatternSequence
from scanner.sequencer.findings import Witnesses, listed
from scanner.sequencer.verify import FrameVerdict

LIVE_HINT = "light comes at other times than its flips say, or pictures in another order: raise dwell"
RECORDED_HINT = (
    "the frames' order or timing is not what capture.json says; capture again, or look at it with fringed audit"
)
"""What to do about a rig out of step, and about a folder whose frames are."""


def set_of(sequence: PatternSequence, position: int) -> tuple[int, ...]:
    """Positions of the frames that must be of one moment with `position`: its fringe set, or itself."""
    sets = getattr(sequence.pattern, "sets", None)
    if sets is None or sequence.role(position) is not FrameRole.FRINGE:
        return (position,)
    fringes = sequence.fringes
    index = fringes.index(position)
    for fringe_set in sets():
        if fringe_set.first <= index < fringe_set.first + fringe_set.shifts:
            return fringes[fringe_set.first : fringe_set.first + fringe_set.shifts]
    return (position,)


def sync_error(
    sequence: PatternSequence,
    verdicts: Sequence[FrameVerdict],
    witnesses: Witnesses,
    suspects: Sequence[int],
    retakes: int = 0,
    hint: str = LIVE_HINT,
    said: Sequence[str] = (),
) -> ScannerError:
    """The error that names the frames, says what spoke against them, and what to do. said: what devices reported."""
    if witnesses.dark:
        why, remedy = witnesses.why_dark
        return DecodeError(why, hint=remedy)
    named = sorted(set(suspects) | set(witnesses.suspects))
    frames = list(range(len(sequence))) if witnesses.whole else named
    says = [found.says for found in witnesses.items if not found.passed and found.says]
    reasons = [reason for verdict in verdicts if verdict.suspect for reason in verdict.reasons[:1]]
    detail = "; ".join(dict.fromkeys([*said, *says, *reasons])) or "stamps and content contradict the plan"
    tried = f" after {retakes} retakes" if retakes else ""
    return SyncError(
        f"{concerned(sequence, named, witnesses)} out of step with the projector{tried}: {detail}",
        frames=frames,
        hint=hint,
    )


def concerned(sequence: PatternSequence, suspects: Sequence[int], witnesses: Witnesses) -> str:
    """The frames that something speaks against, in words; with the order of all of them where that is in doubt."""
    count = len(sequence)
    if witnesses.whole and len(suspects) in (0, count):
        return f"frames {listed(range(count))}"
    named = f"frame{'s' if len(suspects) != 1 else ''} {listed(suspects)}"
    return f"{named} and the order of all {count}" if witnesses.whole else named
