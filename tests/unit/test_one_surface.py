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
    """Surfaces by flooding; the vote; what is not of the winner's order."""
    known = (reason == Reason.VALUE) | (reason == Reason.UNWRAP_RISK)
    order, gone = np.full(SHAPE, 99), np.zeros(SHAPE, bool)
    for seed in zip(*np.nonzero(known), strict=True):
        if order[seed] != 99:
            continue
        order[seed], surface, left = 0, [], deque([seed])
        while left:
            here = left.popleft()
            surface.append(here)
            for there in neighbours(here):
                apart = cycles[there] - cycles[here] if known[there] else np.inf
                whole = np.rint(apart)
                smooth = abs(whole) <= 1 and abs(apart - whole) <= 0.25 and abs(coarse[there] - coarse[here]) <= 0.25
                if smooth and order[there] == 99:
                    order[there] = order[here] + whole
                    left.append(there)
        votes = Counter()
        for at in surface:
            if reason[at] == Reason.VALUE:
                votes[order[at]] += max(1 - 2 * abs(coarse[at] - cycles[at]), 0)
        ((best, most),) = votes.most_common(1) or [(0, 0)]
        unclear = most < 2 * (sum(votes.values()) - most)
        several = len({order[at] for at in surface}) > 1
        for at in surface:
            gone[at] = several and reason[at] == Reason.VALUE and (unclear or order[at] != best)
    return gone


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
