"""Verifies a capture again, from its folder alone: `fringed audit`, and the check before every decode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scanner.capture import Capture
from scanner.errors import DecodeError
from scanner.sequencer.disorder import RECORDED_HINT, concerned, sync_error
from scanner.sequencer.findings import Witnesses
from scanner.sequencer.hearing import Hearing
from scanner.sequencer.plan import Plan
from scanner.sequencer.verify import FrameVerdict, mixed_share, summary, verify
from scanner.sequencer.witness import witness


@dataclass(frozen=True)
class CaptureCheck:
    """What stamps and content of a capture say."""

    capture: Capture
    plan: Plan | None
    """None for captures made elsewhere"""
    verdicts: tuple[FrameVerdict, ...]
    witnesses: Witnesses

    @property
    def suspects(self) -> tuple[int, ...]:
        """Positions, in the pattern's frame list, of frames that stamps or content speak against."""
        count = len(self.capture.header.sequence)
        missing = set(self.capture.missing)
        stamped = {v.pattern % count for v in self.verdicts if v.suspect and v.pattern not in missing}
        return tuple(sorted(stamped | set(self.witnesses.suspects)))

    @property
    def concerned(self) -> str:
        """The same in words, with the order of all frames where that is in doubt; empty where none is named."""
        if not self.suspects and not self.witnesses.whole:
            return ""
        return concerned(self.capture.header.sequence, self.suspects, self.witnesses)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the frames that are here."""
        return not self.suspects and self.witnesses.passed

    def against(self, position: int) -> tuple[str, ...]:
        """Names of the witnesses that speak against the picture of the frame at a position."""
        names = [item.name for item in self.witnesses.items if not item.passed and position in item.frames]
        return tuple(dict.fromkeys(names))

    def summary(self) -> Mapping[str, int]:
        """Number of frames by verdict."""
        return summary(self.verdicts)

    @property
    def mixed_share(self) -> float | None:
        """Largest share of an exposure that may have seen another pattern; None where no stamps can tell."""
        if self.plan is None or not self.capture.all_records:
            return None
        return mixed_share(self.plan, self.capture.all_records)

    def raise_if_out_of_step(self) -> CaptureCheck:
        """Raise if anything speaks against the frames; else return self.

        Raises:
            SyncError: naming the frames.
            DecodeError: nothing in view is lit.
        """
        if not self.passed:
            raise sync_error(
                self.capture.header.sequence, self.verdicts, self.witnesses, self.suspects, hint=RECORDED_HINT
            )
        return self

    def as_dict(self) -> dict[str, Any]:
        """Plain data for report.json."""
        count = len(self.capture.header.sequence)
        return {
            "passed": self.passed,
            "verdicts": dict(self.summary()),
            "frames": [
                {
                    "pattern": v.pattern,
                    "verdict": v.verdict,
                    "suspect": v.suspect,
                    "reasons": list(v.reasons),
                    "against": list(self.against(v.pattern % count)),
                }
                for v in self.verdicts
            ],
            "witnesses": self.witnesses.as_list(),
            "cannot_reveal": list(self.witnesses.cannot_reveal),
            "suspects": list(self.suspects),
        }


def check_capture(capture: Capture, hearing: Hearing | None = None) -> CaptureCheck:
    """Verify the stamps and question the content of a capture's frames.

    Frames that are missing are not an error here: whether the rest can be decoded is the method's to say.

    Args:
        hearing: of those of its frames that were seen already; the others are read.

    Raises:
        DecodeError: a frame cannot be read.
    """
    header = capture.header
    plan = _plan(header.plan)
    stamped = plan is not None and len(capture.all_records) > 0
    verdicts = verify(plan, header.sequence, capture.all_records) if plan and stamped else _unstamped(capture)
    count = len(header.sequence)
    witnesses = Witnesses() if count > 1 else witness(header.sequence, {}, header.camera.max_value)
    if count > 1:
        for repetition in range(header.repeat):
            here = hearing or Hearing(header.sequence, header.camera.max_value)
            for pattern in range(repetition * count, (repetition + 1) * count):
                if pattern in capture.records and not here.has(pattern):
                    here.take(pattern, capture.frame(pattern))
            witnesses = witnesses.joined(here.witnesses(repetition, among=capture.records))
    return CaptureCheck(capture, plan, tuple(verdicts), witnesses)


def _plan(content: Mapping[str, Any] | None) -> Plan | None:
    if not content:
        return None
    try:
        return Plan.from_dict(content)
    except (KeyError, TypeError, ValueError) as error:
        raise DecodeError(f"capture.json: its plan cannot be read: {error}") from error


def _unstamped(capture: Capture) -> list[FrameVerdict]:
    return [
        FrameVerdict(pattern, "unproved", ("made elsewhere: no time stamps to judge",)) for pattern in capture.records
    ]
