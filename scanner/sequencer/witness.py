"""What the content of the frames says about their order: all witnesses heard. Pure: thumbnails in, findings out.

Stamps can lie and latencies be wrong; what the frames show cannot. Findings stand in `findings`; the witnesses of
full-on and full-off frames in `witness_levels`, of fringe sets in `witness_fringes`, of Gray code in `witness_gray`.
The last two sentinels speak by their levels alone, so that all others can be heard while they are exposed (`hear`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from scanner.devices import Pixels
from scanner.patterns import GrayPmpPattern, PartSequence, PatternSequence
from scanner.patterns.sequence import SENTINELS_AFTER, SENTINELS_BEFORE
from scanner.sequencer.darkness import why_dark
from scanner.sequencer.findings import Scene, Witness, Witnesses, equal_positions, look, samples_in_noise
from scanner.sequencer.witness_fringes import fringe_witnesses
from scanner.sequencer.witness_gray import gray_witnesses
from scanner.sequencer.witness_levels import level_witnesses


@dataclass(frozen=True, eq=False)
class Heard:
    """What the frames before the last two sentinels say of their order."""

    thumbnails: Mapping[int, Pixels]
    """those frames"""
    scene: Scene | None
    """None: no pixel changes with the pattern"""
    items: tuple[Witness, ...] = ()
    cannot_reveal: tuple[str, ...] = ()

    def of(self, thumbnails: Mapping[int, Pixels]) -> bool:
        """Whether it was heard of these very frames."""
        return self.thumbnails.keys() == thumbnails.keys() and all(
            self.thumbnails[position] is pixels for position, pixels in thumbnails.items()
        )


def hear(sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int) -> Heard:
    """Question the frames before the last two sentinels, for `witness` to be given: most of what it has to do.

    Args: as `witness`; frames behind these do not matter.
    """
    before = _before_last(sequence, thumbnails)
    scene = look(sequence, before, max_value)
    if scene is None:
        return Heard(before, None)
    cannot: list[str] = []
    items: list[Witness] = []
    if sequence.pattern.method == "pmp":
        items = fringe_witnesses(scene, cannot)
    elif sequence.pattern.method == "gray":
        items = gray_witnesses(scene, cannot)
    elif isinstance(pattern := sequence.pattern, GrayPmpPattern):
        fringes = PartSequence.of(sequence, pattern.pmp, 0)
        items = fringe_witnesses(replace(scene, sequence=fringes), cannot)
        code = PartSequence.of(sequence, pattern.gray, pattern.pmp.fringe_count)
        items += gray_witnesses(replace(scene, sequence=code), cannot)
    return Heard(before, scene, tuple(items), tuple(cannot))


def may_be_heard(sequence: PatternSequence, thumbnails: Mapping[int, Pixels]) -> bool:
    """Whether `hear` may be asked already: nothing but the last two sentinels is not there yet."""
    return len(_last(sequence)) > 0 and all(
        position in thumbnails for position in range(len(sequence)) if position not in _last(sequence)
    )


def witness(
    sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int, heard: Heard | None = None
) -> Witnesses:
    """Question the frames of one repetition.

    Args:
        thumbnails: by position, (h, w) uint8 or uint16 each, all of one size; absent positions are missing frames.
        max_value: the camera's largest grey level.
        heard: what was heard of them before the last ones came; of other frames it counts for nothing.

    Returns:
        Every witness this sequence has. One-frame sequences have none, and nothing is revealed.
    """
    if len(sequence) < 2 or len(thumbnails) < 2:
        return Witnesses(cannot_reveal=("any fault of order: one frame has no order",))
    if heard is None or not heard.of(_before_last(sequence, thumbnails)):
        heard = hear(sequence, thumbnails, max_value)
    if heard.scene is None:
        frames, noise, least = samples_in_noise(sequence, thumbnails)
        why = why_dark(sequence, frames, max_value, noise, least)
        says = "no pixel changes with the projector's pattern"
        return Witnesses((Witness("light", False, 0.0, 0.0, says=says),), dark=True, why_dark=why)
    cannot: list[str] = []
    items = level_witnesses(heard.scene.with_frames(thumbnails), cannot)
    return Witnesses((*items, *heard.items), (*cannot, *heard.cannot_reveal))


def _before_last(sequence: PatternSequence, thumbnails: Mapping[int, Pixels]) -> dict[int, Pixels]:
    """The frames without the last two sentinels; with them where the noise of lit pixels could not be told else."""
    before = {position: pixels for position, pixels in thumbnails.items() if position not in _last(sequence)}
    full_on = dict(equal_positions(sequence))[1.0]
    return before if sum(position in before for position in full_on) > 1 else dict(thumbnails)


def _last(sequence: PatternSequence) -> tuple[int, ...]:
    """The sentinels behind the first full-on one after everything."""
    first = len(SENTINELS_BEFORE) + SENTINELS_AFTER.index(1.0)
    return sequence.sentinels[first + 1 :]
