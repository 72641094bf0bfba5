"""Witnesses of Gray and binary code: inverses, the order bars, and positions that follow one another smoothly.

A bit exchanged with its inverse, or bits out of order, still decode to clean positions; but coarse ones then contradict
the order bars, and fine ones break the positions into saw teeth that no surface has. Orders are accused by comparison:
another one must explain the frames markedly better. Which orders there are stands in `code_orders`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import GrayPattern
from scanner.patterns.description import Axis
from scanner.patterns.sequence import BAR_COUNT, bar_light
from scanner.sequencer.code_orders import Order, as_captured, orders_of
from scanner.sequencer.findings import Array, Scene, Witness, listed

MAX_UNEQUAL = 0.25
"""Median of |bit + inverse - white - black| over the contrast: a foreign frame in the pair leaves a half or more."""

DECISIVE = 0.15
"""Of a pixel's contrast, by which a bit's two levels must differ to be read: less is the border of two cells, or blur
(the decoder's own limit)."""

LEAST_READ = 0.3
"""Of the lit pixels, at which a bit and all coarser ones can be read, or the bit is not judged."""

MIN_SAMPLES = 200
"""Pixels, or pixels between two neighbours, fewer than which prove nothing."""

MAX_SAMPLES = 3000
"""Samples looked at: their share is known to 2 % (1 sigma of a half: .5 / sqrt(3000) = .9 %)."""

MIN_BARS_AGREEMENT = 0.87
"""Of pixels with the order bars; by chance a half agrees. In step all do but those at edges: one pixel at each of 16
edges of 31 bars, four pixels wide on the smallest projectors, is 13 %."""

COPY_EQUAL, COPY_CHANGES = 0.97, 0.9
"""Two bits that are equal at such a share of pixels and change together at such a share of all their changes are one:
no two bits of a Gray code change at one place, and of a binary code's the finer one changes twice as often."""

BARS_GAIN = 0.15
"""Another order is believed when so many more pixels agree with the bars in it."""

MIN_BARS_SEEN = 8
"""Different bars in view, fewer than which could agree by chance (2^-8)."""

LEAST_WEIGHT = 0.2
"""Mean square of the bars' light (-1 .. 1) over the code's cells, below which cells are too coarse to tell bars."""

ROUGHNESS_GAIN = 0.8
"""Another order is believed when positions are rougher by no more than this share of what they are as it is."""

MOST_BEYOND = 0.1
"""Share of positions off the projector above which no order is the right one: it is the description that is wrong, and
decoding says so (`scanner.scale_check`)."""


def gray_witnesses(scene: Scene, cannot: list[str]) -> list[Witness]:
    """All witnesses of a Gray or binary code capture."""
    pattern = scene.sequence.pattern
    if not isinstance(pattern, GrayPattern):
        return []
    items = _inverses(scene, pattern) if pattern.inverse else []
    suspected = {p for item in items if not item.passed for p in item.frames}
    for index, axis in enumerate(pattern.axes):
        code = _read(scene, pattern, index, axis, cannot)
        if code is None or suspected & {p for pair in code.positions for p in pair}:
            # Bits of frames that are no pair prove nothing against others.
            continue
        if copied := _copies(scene, code):
            items.append(copied)
            continue
        orders = orders_of(len(code.positions), inverse=pattern.inverse)
        found = _bars(scene, code, orders, cannot)
        items += found
        if all(item.passed for item in found):
            items += _smoothness(scene, code, orders, cannot)
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
    says = f"frames {listed(frames)} are no pairs of bit and inverse" if wrong else "pairs are inverse"
    return [Witness("inverse pairs", not wrong, float(value.max()), limit, frames, says)]


# --- reading ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Code:
    """The bits of one axis that can be read, most significant first."""

    axis: Axis
    bits: NDArray[np.bool_]
    """(K, P)"""
    read: NDArray[np.bool_]
    """(P,) lit pixels at which all of them are decisive"""
    positions: tuple[tuple[int, ...], ...]
    """by bit: the frames it was read from"""
    middle: Array
    """(P,) between full light and none"""
    contrast: Array
    """(P,) between them"""
    code: str
    cells: float
    """cells of the finest of these bits along the projector"""

    def values(self, order: Order, where: NDArray[np.intp]) -> NDArray[np.int32]:
        """Index of the cell at some pixels, were the frames in this order."""
        value = np.zeros(where.shape, dtype=np.int32)
        running = np.zeros(where.shape, dtype=bool)
        for bit, inverted in zip(order.bits, order.inverted, strict=True):
            here = self.bits[bit][where] ^ inverted
            running = running ^ here if self.code == "gray" else here
            value = 2 * value + running
        return value


def _read(scene: Scene, pattern: GrayPattern, axis_index: int, axis: Axis, cannot: list[str]) -> _Code | None:
    differences, positions = _differences(scene, pattern, axis_index)
    blind = f"code frames along {axis} in another order"
    if len(differences) < 3:
        cannot.append(f"{blind} (too few frames)")
        return None
    middle, contrast = _levels(scene, pattern)
    read, count = scene.lit.copy(), 0
    enough = max(LEAST_READ * np.count_nonzero(scene.lit), MIN_SAMPLES)
    for difference in differences:
        now = read & (np.abs(difference) > np.maximum(DECISIVE * contrast, 2 * scene.noise))
        if np.count_nonzero(now) < enough:
            break
        read, count = now, count + 1
    if count < 3:
        cannot.append(f"{blind} (the scene shows too little of the code)")
        return None
    if count < pattern.bits:
        cannot.append(
            f"an exchange among the {pattern.bits - count} finest code frames along {axis} (blurred or missing)"
        )
    bits = np.stack(differences[:count]) > 0
    cells = scene.sequence.projector.along(axis) / 2.0 ** (pattern.code_bits - count)
    return _Code(axis, bits, read, tuple(positions[:count]), middle, contrast, pattern.code, cells)


def _differences(scene: Scene, pattern: GrayPattern, axis_index: int) -> tuple[list[Array], list[tuple[int, ...]]]:
    """Of the bits that are here, most significant first: bright less dark (P,), and the positions it was read from."""
    fringes, per_bit = scene.sequence.fringes, pattern.frames_per_bit
    middle, _ = _levels(scene, pattern)
    found: list[Array] = []
    positions: list[tuple[int, ...]] = []
    for bit in range(pattern.bits):
        first = (axis_index * pattern.bits + bit) * per_bit
        pair = fringes[first : first + per_bit]
        if any(p not in scene.frames for p in pair):
            break
        frame = scene.frames[pair[0]]
        found.append(frame - scene.frames[pair[1]] if per_bit == 2 else 2 * (frame - middle))
        positions.append(tuple(pair))
    return found, positions


def _levels(scene: Scene, pattern: GrayPattern) -> tuple[Array, Array]:
    """(middle, contrast) of every pixel, from white and black, or from all frames."""
    white, black = scene.sequence.white, scene.sequence.black
    if white is not None and black is not None and white in scene.frames and black in scene.frames:
        light, dark = scene.frames[white], scene.frames[black]
    else:
        stack = np.stack(list(scene.frames.values()))
        light, dark = stack.max(axis=0), stack.min(axis=0)
    return np.asarray((light + dark) / 2, np.float32), np.asarray(np.abs(light - dark), np.float32)


# --- orders -------------------------------------------------------------------------------------------------------


def _copies(scene: Scene, code: _Code) -> Witness | None:
    """Two bits that are one picture: a stale buffer, a flip that never came."""
    lit, bits = scene.lit.reshape(scene.shape), code.bits.reshape(-1, *scene.shape)
    if code.axis == "x":
        lit, bits = lit.T, bits.transpose(0, 2, 1)
    change = (bits[:, 1:] ^ bits[:, :-1])[:, lit[1:] & lit[:-1]]
    shown = code.bits[:, code.read]
    for a, b in combinations(range(len(code.positions)), 2):
        either = int(np.count_nonzero(change[a] | change[b]))
        equal = float(np.mean(shown[a] == shown[b]))
        together = float(np.count_nonzero(change[a] & change[b]) / max(either, 1))
        if either >= MIN_SAMPLES / 4 and together > COPY_CHANGES and max(equal, 1 - equal) > COPY_EQUAL:
            frames = (*code.positions[a], *code.positions[b])
            says = f"code frames {listed(frames)} show one bit twice"
            return Witness(f"code copies {code.axis}", False, together, COPY_CHANGES, frames, says)
    return None


def _bars(scene: Scene, code: _Code, orders: tuple[Order, ...], cannot: list[str]) -> list[Witness]:
    """The order bars against the positions that the code gives: whole mirror images show in nothing else."""
    axis, position = code.axis, scene.sequence.bars.get(code.axis)
    blind = f"the coarsest code frames along {axis} exchanged with their inverses, or all of them reversed"
    if position is None or position not in scene.frames:
        cannot.append(f"{blind} (no order bars)")
        return []
    above = scene.frames[position] - code.middle
    where = _thinned(np.flatnonzero(code.read))
    values = code.values(_as_it_is(code), where)
    told = np.nan_to_num(_light_of_cells(code), nan=1.0)
    seen = np.unique(np.floor((values + 0.5) * (BAR_COUNT / code.cells))[np.abs(told[values]) > 0.5])
    if where.size < MIN_SAMPLES or np.mean(told[values] ** 2) < LEAST_WEIGHT or len(seen) < MIN_BARS_SEEN:
        cannot.append(f"{blind} (the scene and the code show {len(seen)} of {BAR_COUNT} order bars well enough)")
        return []
    light = above[where] > 0
    here = _agreement(code, _as_it_is(code), where, light)
    scores = np.array([_agreement(code, order, where, light) for order in orders])
    best = float(scores.max())
    name, every = f"order bars {axis}", tuple(sorted({position, *(p for pair in code.positions for p in pair)}))
    gain = BARS_GAIN if here >= MIN_BARS_AGREEMENT else BARS_GAIN / 2
    if best >= max(MIN_BARS_AGREEMENT, here + gain):
        frames = _named(code, orders[int(scores.argmax())])
        says = (
            f"{here:.0%} of pixels agree with the order bars along {axis}, {best:.0%} with frames {listed(frames)} "
            f"{orders[int(scores.argmax())].says}"
        )
        return [Witness(name, False, here, best - gain, frames, says)]
    if here < MIN_BARS_AGREEMENT:
        binary = float(np.mean(np.abs(above[where]) > 0.25 * code.contrast[where]))
        if binary < 0.75 or not 0.1 < light.mean() < 0.9:
            return [
                Witness(name, False, here, MIN_BARS_AGREEMENT, (position,), f"frame {position} shows no order bars")
            ]
        says = f"{here:.0%} of pixels agree with the order bars along {axis}: code and bars are not in one order"
        return [Witness(name, False, here, MIN_BARS_AGREEMENT, every, says, whole=True)]
    return [Witness(name, True, here, MIN_BARS_AGREEMENT, says=f"{here:.0%} agree with the code, in no order more")]


def _agreement(code: _Code, order: Order, where: NDArray[np.intp], light: NDArray[np.bool_]) -> float:
    """How far the bars are as the code says: 1 in step, about a half by chance, as if a share of pixels agreed.

    Correlation of seen light with that of the pixel's cell, over what it would be in step; cells that two lights share
    evenly count nothing, and positions off the projector agree with nothing.
    """
    told = _light_of_cells(code)[code.values(order, where)]
    off, told = np.isnan(told), np.nan_to_num(told)
    agrees = np.where(off, -1.0, told * np.where(light, 1.0, -1.0))
    weight = float(np.mean(np.where(off, 1.0, told**2)))
    return float(0.5 + 0.5 * agrees.mean() / weight) if weight > LEAST_WEIGHT else 0.0


def _light_of_cells(code: _Code) -> NDArray[np.float64]:
    """By cell: the bars' mean light over it, -1 dark, 1 lit; NaN where it lies off the projector."""
    width = BAR_COUNT / code.cells
    edges = np.arange(2 ** len(code.positions) + 1) * width
    integral = np.append(0.0, np.cumsum(bar_light(np.arange(BAR_COUNT), BAR_COUNT) * 2.0 - 1))
    lit = np.diff(np.interp(edges, np.arange(BAR_COUNT + 1), integral))
    inside = np.clip(BAR_COUNT - edges[:-1], 0.0, width)
    return np.asarray(np.where(inside > 0.01 * width, lit / np.maximum(inside, 1e-9), np.nan))


def _smoothness(scene: Scene, code: _Code, orders: tuple[Order, ...], cannot: list[str]) -> list[Witness]:
    """Positions change evenly from pixel to pixel, but for the scene's own edges: in a false order they do not."""
    triples = _triples(scene, code)
    if len(triples) < MIN_SAMPLES:
        cannot.append(f"code frames along {code.axis} in another order (the scene shows too little of the code)")
        return []
    here = _roughness(code, _as_it_is(code), triples)
    scores = np.array([_roughness(code, order, triples) for order in orders])
    best, order = float(scores.min()), orders[int(scores.argmin())]
    name = f"code order {code.axis}"
    other = replace(code, code="binary" if code.code == "gray" else "gray")
    as_other = _roughness(other, _as_it_is(code), triples)
    if as_other < ROUGHNESS_GAIN * min(here, best):
        says = (
            f"positions along {code.axis} are broken as {code.code} code and smooth as {other.code} code (roughness "
            f'{here:.2f} and {as_other:.2f}): is "code": "{code.code}" of the description wrong?'
        )
        every = tuple(sorted(p for pair in code.positions for p in pair))
        return [Witness(name, False, here, as_other / ROUGHNESS_GAIN, every, says, whole=True)]
    if best >= ROUGHNESS_GAIN * here:
        return [Witness(name, True, here, best / ROUGHNESS_GAIN, says="positions are smoothest in this order")]
    if np.mean((code.values(order, triples) >= code.cells).any(axis=1)) > MOST_BEYOND:
        cannot.append(f"code frames along {code.axis} in another order (in all of them the code leaves the projector)")
        return []
    frames = _named(code, order)
    says = (
        f"positions along {code.axis} are broken as they are and smoother with frames {listed(frames)} {order.says} "
        f"(roughness {here:.2f} and {best:.2f})"
    )
    return [Witness(name, False, here, best / ROUGHNESS_GAIN, frames, says)]


def _triples(scene: Scene, code: _Code) -> NDArray[np.intp]:
    """(T, 3) lit neighbours in a line along the axis. Where one bit cannot be read, Gray code is off by a cell only."""
    grid, read = np.arange(code.read.size).reshape(scene.shape), scene.lit.reshape(scene.shape)
    if code.axis == "x":
        grid, read = grid.T, read.T
    return _thinned(np.stack([grid[:-2], grid[1:-1], grid[2:]], axis=-1)[read[:-2] & read[1:-1] & read[2:]])


def _roughness(code: _Code, order: Order, triples: NDArray[np.intp]) -> float:
    """Mean of log2(1 + |second difference| in cells): one depth edge, and one jump of a false order, count alike."""
    value = code.values(order, triples)
    bend = np.abs(value[:, 0] - 2 * value[:, 1] + value[:, 2])
    # No position lies off the projector: that is as rough as can be.
    bend[(value >= code.cells).any(axis=1)] = 2 ** len(code.positions)
    return float(np.log2(1 + bend).mean())


def _thinned(samples: NDArray[np.intp]) -> NDArray[np.intp]:
    return samples[:: max(1, -(-len(samples) // MAX_SAMPLES))]


def _as_it_is(code: _Code) -> Order:
    return as_captured(len(code.positions))


def _named(code: _Code, order: Order) -> tuple[int, ...]:
    """Positions of the frames that this order moves."""
    return tuple(sorted(p for bit in order.moved for p in code.positions[bit]))
