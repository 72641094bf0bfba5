"""Witnesses of Gray and binary code: inverses, and neighbours whose code words follow one another."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import GrayPattern
from scanner.patterns.description import Axis
from scanner.sequencer.findings import Scene, Witness

MAX_UNEQUAL = 0.25
"""Median of |bit + inverse - white - black| over the contrast: a foreign frame in the pair leaves a half or more."""

RESOLVED_PX = 8
"""Thumbnail pixels in a cell of a bit that is judged: finer ones are blurred to grey."""

STEP_GAIN = 0.15
"""A swap of two bits is believed when it makes so many more of the code's changes go by single steps."""

MIN_CHANGES = 100
"""Changes of the code word between neighbours, fewer than which prove nothing."""


def gray_witnesses(scene: Scene, cannot: list[str]) -> list[Witness]:
    """All witnesses of a Gray or binary code capture."""
    pattern = scene.sequence.pattern
    if not isinstance(pattern, GrayPattern):
        return []
    items = _inverses(scene, pattern) if pattern.inverse else []
    for index, axis in enumerate(pattern.axes):
        items += _succession(scene, pattern, index, axis, cannot)
    return items


def _inverses(scene: Scene, pattern: GrayPattern) -> list[Witness]:
    """Bit + inverse = white + black at every pixel; pairs are compared with one another, so no white is needed."""
    fringes = scene.sequence.fringes
    pairs = [(fringes[i], fringes[i + 1]) for i in range(0, len(fringes), 2)]
    pairs = [pair for pair in pairs if pair[0] in scene.frames and pair[1] in scene.frames]
    if len(pairs) < 3:
        return []
    sums = np.stack([scene.frames[a][scene.lit] + scene.frames[b][scene.lit] for a, b in pairs])
    spread = np.median(np.abs(sums - np.median(sums, axis=0)), axis=1)
    contrast = np.median(np.ptp(np.stack([scene.frames[p][scene.lit] for p in scene.frames]), axis=0))
    value = spread / max(float(contrast), 1e-6)
    limit = MAX_UNEQUAL + 2 * scene.noise / max(float(contrast), 1e-6)
    wrong = [pairs[i] for i in np.flatnonzero(value > limit)]
    frames = tuple(sorted(p for pair in wrong for p in pair))
    says = f"frames {', '.join(map(str, frames))} are no pairs of bit and inverse" if wrong else "pairs are inverse"
    return [Witness("inverse pairs", not wrong, float(value.max()), limit, frames, says)]


def _succession(scene: Scene, pattern: GrayPattern, axis_index: int, axis: Axis, cannot: list[str]) -> list[Witness]:
    """Along the axis the coarse code words follow one another; where bits are swapped they jump."""
    bits, positions = _bits(scene, pattern, axis_index)
    if len(bits) < 3:
        cannot.append(f"code frames along {axis} in another order (too few frames)")
        return []
    lit = scene.lit.reshape(scene.shape)
    size = scene.sequence.projector.along(axis)
    along = scene.shape[0 if axis == "y" else 1]
    cell_px = [along * 2.0 ** (pattern.code_bits - 1 - bit) / size for bit in range(len(bits))]
    resolved = [bit for bit in range(len(bits)) if cell_px[bit] >= RESOLVED_PX]
    if len(resolved) < 3:
        resolved = list(range(min(3, len(bits))))
    if len(resolved) < pattern.bits:
        cannot.append(f"an exchange among the {pattern.bits - len(resolved)} finest code frames along {axis}")
    chosen = [bits[bit] for bit in resolved]
    steps, changes = _single_steps(chosen, lit, axis, pattern.code)
    if changes < MIN_CHANGES:
        cannot.append(f"code frames along {axis} in another order (the scene shows too little of the code)")
        return []
    share = steps / changes
    best, swap = share, None
    for i, j in combinations(range(len(chosen)), 2):
        tried = list(chosen)
        tried[i], tried[j] = tried[j], tried[i]
        other, count = _single_steps(tried, lit, axis, pattern.code)
        if count >= MIN_CHANGES and other / count > best:
            best, swap = other / count, (i, j)
    if swap is None or best < share + STEP_GAIN:
        return [Witness(f"code order {axis}", True, share, share, says=f"{share:.0%} of the code's changes are steps")]
    frames = tuple(sorted(p for index in swap for p in positions[resolved[index]]))
    says = (
        f"code frames {', '.join(map(str, frames))} are exchanged: {share:.0%} of the code's changes along {axis} are "
        f"single steps, {best:.0%} with these exchanged back"
    )
    return [Witness(f"code order {axis}", False, share, best - STEP_GAIN, frames, says)]


def _bits(scene: Scene, pattern: GrayPattern, axis_index: int) -> tuple[list[NDArray[np.bool_]], list[tuple[int, ...]]]:
    """The bits that are here, most significant first, as (h, w) bool, and the positions each was read from."""
    fringes, per_bit = scene.sequence.fringes, pattern.frames_per_bit
    middle = _middle(scene)
    bits: list[NDArray[np.bool_]] = []
    positions: list[tuple[int, ...]] = []
    for bit in range(pattern.bits):
        first = (axis_index * pattern.bits + bit) * per_bit
        pair = fringes[first : first + per_bit]
        if any(p not in scene.frames for p in pair):
            break
        reference = scene.frames[pair[1]] if per_bit == 2 else middle
        bits.append((scene.frames[pair[0]] > reference).reshape(scene.shape))
        positions.append(tuple(pair))
    return bits, positions


def _middle(scene: Scene) -> NDArray[np.float32]:
    white, black = scene.sequence.white, scene.sequence.black
    if white in scene.frames and black in scene.frames and white is not None and black is not None:
        return np.asarray((scene.frames[white] + scene.frames[black]) / 2, dtype=np.float32)
    stack = np.stack(list(scene.frames.values()))
    return np.asarray((stack.max(axis=0) + stack.min(axis=0)) / 2, dtype=np.float32)


def _single_steps(bits: list[NDArray[np.bool_]], lit: NDArray[np.bool_], axis: Axis, code: str) -> tuple[int, int]:
    """(changes by one, all changes) of the code word between lit neighbours along the axis."""
    value = np.zeros(lit.shape, dtype=np.int32)
    running = np.zeros(lit.shape, dtype=bool)
    for bit in bits:
        running = running ^ bit if code == "gray" else bit
        value = 2 * value + running
    if axis == "x":
        value, lit = value.T, lit.T
    difference = np.abs(np.diff(value, axis=0))[lit[1:] & lit[:-1]]
    return int(np.count_nonzero(difference == 1)), int(np.count_nonzero(difference))
