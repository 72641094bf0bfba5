"""Orders that are wrong by one on a part of a surface, and surfaces that are one fringe apart."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
import pytest

from scanner.decode import Reason, decoder_for
from scanner.decode.one_surface import doubt_wrong_orders
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize

SHAPE = (60, 80)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
PLANE = 3 + 0.011 * X + 0.004 * Y


def hollow(most):
    """What light from elsewhere does to the coarse phase, cycles of the finer one: `most` in the middle of the left."""
    return most * np.exp(-((X - 20) ** 2 + (Y - 30) ** 2) / 300)


def judged(true, bias, noise=0.01, seed=1):
    """Cycles as a decoder has them, whether they are wrong, and reasons before and after."""
    random = np.random.default_rng(seed)
    psi, coarse = (true + random.normal(0, noise, SHAPE), true + bias + random.normal(0, 3 * noise, SHAPE))
    cycles = (psi + np.rint(coarse - psi)).astype(np.float32)
    coarse = coarse.astype(np.float32)
    before = np.where(np.abs(coarse - cycles) > 0.4, Reason.UNWRAP_RISK, Reason.VALUE).astype(np.uint8)
    before[random.random(SHAPE) < 0.03] = Reason.SHADOW
    after, confidence = before.copy(), np.ones(SHAPE, np.float32)
    lost = doubt_wrong_orders(*(m.reshape(-1) for m in (cycles, coarse, confidence, after)), SHAPE[1])
    gone = (before == Reason.VALUE) & (after == Reason.UNWRAP_RISK)
    assert lost == gone.sum()
    assert np.all((confidence == 0) == gone)
    assert np.all((before == after) | gone)
    return cycles, coarse, before, gone, np.abs(cycles - true) > 0.5


@pytest.mark.parametrize("most", [0.9, -1.1, 1.8])
def test_a_part_of_a_surface_on_the_wrong_fringe_is_left_out(most):
    _, _, before, gone, wrong = judged(PLANE, hollow(most))
    assert (wrong & (before == Reason.VALUE)).sum() > 200
    assert np.mean(gone[wrong & (before == Reason.VALUE)]) > 0.99
    assert not np.any(gone & ~wrong)


@pytest.mark.parametrize("step", [1.0, -1.0, 2.0, 0.5])
@pytest.mark.parametrize("most", [0.0, 0.35])
def test_surfaces_some_fringes_apart_keep_their_values(step, most):
    *_, gone, wrong = judged(PLANE + step * (X > 50), hollow(most))
    assert not wrong.any()
    assert not gone.any()


def test_a_surface_half_of_which_is_beyond_is_left_out_whole():
    _, _, before, gone, _ = judged(PLANE, np.clip((X - 39.5) / 20 + 0.5, 0, 1))
    assert np.all(gone[(before == Reason.VALUE) & (X > 2) & (X < 77) & (Y > 2) & (Y < 57)])


def test_the_kernel_does_what_the_plain_form_does():
    cycles, coarse, before, gone, _ = judged(PLANE + 0.3 * (X > 50), hollow(1.2), noise=0.04, seed=3)
    np.testing.assert_array_equal(gone, plain(cycles, coarse, before))


def plain(cycles, coarse, reason):
    """Regions by flooding, surfaces by flooding over borders; the vote; what is not of the winner's order."""
    known = (reason == Reason.VALUE) | (reason == Reason.UNWRAP_RISK)

    def step(here, there):
        apart = cycles[there] - cycles[here]
        whole = np.rint(apart)
        smooth = abs(whole) <= 1 and abs(apart - whole) <= 0.25 and abs(coarse[there] - coarse[here]) <= 0.25
        return int(whole) if smooth else None

    pixels = [tuple(at) for at in np.argwhere(known)]
    links = {here: [there for there in neighbours(here) if known[there] and step(here, there) == 0] for here in pixels}
    region = flooded(links)
    borders = {}
    for here in pixels:
        for there in neighbours(here):
            if known[there] and region[here][0] != region[there][0]:
                borders.setdefault((region[here][0], region[there][0]), []).append(step(here, there))
    jumps = {
        pair: way for pair, steps in borders.items() for way in (-1, 1)
        if len(steps) >= 16 and 2 * steps.count(way) > len(steps)
    }  # fmt: skip
    beside = {first: [pair[1] for pair in jumps if pair[0] == first] for first, _ in region.values()}
    surface = flooded(beside, jumps)
    gone = np.zeros(SHAPE, bool)
    for name in {first for first, _ in surface.values()}:
        orders = {at: surface[region[at][0]][1] for at in pixels if surface[region[at][0]][0] == name}
        votes = Counter()
        for at, order in orders.items():
            if reason[at] == Reason.VALUE:
                votes[order] += max(1 - 2 * abs(coarse[at] - cycles[at]), 0)
        ((best, most),) = votes.most_common(1) or [(0, 0)]
        unclear = most < 2 * (sum(votes.values()) - most)
        for at, order in orders.items():
            several = len(set(orders.values())) > 1
            gone[at] = several and reason[at] == Reason.VALUE and (unclear or order != best)
    return gone


def flooded(links, jumps=None):
    """Of each node, the first of those it hangs together with, and the jumps on the way to it."""
    found = {}
    for seed in links:
        if seed not in found:
            found[seed], left = (seed, 0), deque([seed])
            while left:
                here = left.popleft()
                for there in links[here]:
                    if there not in found:
                        found[there] = seed, found[here][1] + (jumps[here, there] if jumps else 0)
                        left.append(there)
    return found


def test_surfaces_that_touch_in_noise_are_not_one():
    """A step, and along it some pixels over which the coarse phase seems to run on, as it may where it is noisy."""
    true = PLANE + 0.8 * (X > 39.5)
    cycles, coarse = true.astype(np.float32), true.astype(np.float32)
    coarse[::5, 40] = coarse[::5, 39] + 0.011
    reason, confidence = np.full(SHAPE, Reason.VALUE, np.uint8), np.ones(SHAPE, np.float32)
    assert doubt_wrong_orders(*(m.reshape(-1) for m in (cycles, coarse, confidence, reason)), SHAPE[1]) == 0


def neighbours(at):
    y, x = at
    return [(j, i) for j, i in ((y, x + 1), (y + 1, x), (y, x - 1), (y - 1, x)) if 0 <= j < 60 and 0 <= i < 80]


@pytest.mark.parametrize("brief", [False, True])
def test_a_scan_of_a_hollow_has_no_values_on_the_wrong_fringe(brief):
    projector, camera = ProjectorSize(320, 240), CameraFormat(160, 120)
    pattern, random = PmpPattern(("y",), (1.0, 8.0, 32.0), (4, 4, 4)), np.random.default_rng(2)
    y, x = np.mgrid[:120, :160]
    rows = 20 + 200 * y / 120 + 6 * np.sin(x / 25)
    shift = 0.12 * np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / 900)
    decoder = decoder_for(PatternSequence(projector, pattern), camera)
    position = 0
    for s in pattern.sets():
        for n in range(s.shifts):
            turns = s.frequency * (rows + pattern.origin) / 240 + (shift if s.frequency == 1 else 0) - n / s.shifts
            grey = 110 + 80 * np.cos(2 * np.pi * turns) + random.normal(0, 1, camera.shape)
            decoder.add(position, np.rint(grey).astype(np.uint8))
            position += 1
    found = decoder.coordinates() if brief else decoder.finish()
    assert found.rows is not None
    known = np.isfinite(found.rows)
    assert np.abs(found.rows - rows)[known].max() < 2
    assert known.mean() > 0.75
    assert np.all(known == (found.confidence > 0))
    if not brief:
        assert found.details["unwrapping"]["y"]["left_out_by_surface"] > 100
        assert known.sum() == found.details["counts"]["value"]
        assert np.all((found.reason == Reason.VALUE) == known)
        assert any("differ by" in said for said in found.warnings)
