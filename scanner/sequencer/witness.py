"""What the content of the frames says about their order: all witnesses heard. Pure: thumbnails in, findings out.

Stamps can lie and latencies be wrong; what the frames show cannot. Findings stand in `findings`; the witnesses of
full-on and full-off frames in `witness_levels`, of fringe sets in `witness_fringes`, of Gray code in `witness_gray`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from scanner.devices import Pixels
from scanner.patterns import GrayPmpPattern, PartSequence, PatternSequence
from scanner.sequencer.findings import Witness, Witnesses, look
from scanner.sequencer.witness_fringes import fringe_witnesses
from scanner.sequencer.witness_gray import gray_witnesses
from scanner.sequencer.witness_levels import level_witnesses


def witness(sequence: PatternSequence, thumbnails: Mapping[int, Pixels], max_value: int) -> Witnesses:
    """Question the frames of one repetition.

    Args:
        thumbnails: by position, (h, w) uint8 or uint16 each, all of one size; absent positions are missing frames.
        max_value: the camera's largest grey level.

    Returns:
        Every witness this sequence has. One-frame sequences have none, and nothing is revealed.
    """
    if len(sequence) < 2 or len(thumbnails) < 2:
        return Witnesses(cannot_reveal=("any fault of order: one frame has no order",))
    scene = look(sequence, thumbnails, max_value)
    if scene is None:
        return Witnesses(
            (Witness("light", False, 0.0, 0.0, says="no pixel changes with the projector's pattern"),), dark=True
        )
    cannot: list[str] = []
    items = level_witnesses(scene, cannot)
    if sequence.pattern.method == "pmp":
        items += fringe_witnesses(scene, cannot)
    elif sequence.pattern.method == "gray":
        items += gray_witnesses(scene, cannot)
    elif isinstance(pattern := sequence.pattern, GrayPmpPattern):
        fringes = PartSequence.of(sequence, pattern.pmp, 0)
        items += fringe_witnesses(replace(scene, sequence=fringes), cannot)
        code = PartSequence.of(sequence, pattern.gray, pattern.pmp.fringe_count)
        items += gray_witnesses(replace(scene, sequence=code), cannot)
    return Witnesses(tuple(items), tuple(cannot))
