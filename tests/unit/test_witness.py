"""Witnesses of content: every disorder is seen, no sound capture is accused."""

from __future__ import annotations

import random
import re
from functools import cache
from typing import Literal

import numpy as np
import pytest

from scanner.devices import Pixels
from scanner.patterns import GrayPattern, PatternSequence, PmpPattern
from scanner.patterns.description import Axis
from scanner.sequencer import Hearing, Witnesses, witness
from scanner.sequencer.disorder import sync_error
from scanner.sequencer.witness import hear
from tests.unit.sequencer_bench import QUICK, Taken, gray, pmp, take

SCENES = ("board", "sphere_board", "sphere_dark", "blocks", "bust", "textured", "two_albedo", "wedge")
PATTERNS = {
    "8 shifts": pmp((1.0, 8.0), (8, 8)),
    "3 shifts": pmp((1.0, 16.0), (3, 3)),
    "4 shifts": pmp((1.0, 6.0, 36.0), (4, 4, 4)),
    "heterodyne": pmp((11.0, 12.0, 13.0), (5, 5, 5)),
    "one set": pmp((1.0,), (16,)),
    "unequal": pmp((1.0, 8.0, 32.0), (8, 3, 12)),
}


@cache
def taken(pattern: str, scene: str = "board") -> Taken:
    return take(PATTERNS[pattern], scene=scene, exposure_ns=16_666_667)


def reordered(capture: Taken, order: dict[int, int]) -> dict[int, Pixels]:
    """The thumbnails, with position p showing what was taken at order[p]."""
    shown = capture.thumbnails
    return {p: shown[order.get(p, p)] for p in shown}


def questioned(capture: Taken, order: dict[int, int]) -> Witnesses:
    return witness(capture.sequence, reordered(capture, order), capture.format.max_value)


def sets(sequence: PatternSequence) -> list[tuple[int, ...]]:
    pattern = sequence.pattern
    assert isinstance(pattern, PmpPattern)
    return [sequence.fringes[s.first : s.first + s.shifts] for s in pattern.sets()]


# --- sound captures ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("pattern", ["4 shifts", "3 shifts"])
def test_sound_captures_are_not_accused(scene: str, pattern: str) -> None:
    found = questioned(taken(pattern, scene), {})
    assert found.passed, [item for item in found.items if not item.passed]
    assert not found.suspects


@pytest.mark.parametrize(
    "conditions",
    [
        {"exposure_ns": 4_166_667, "faults": "full_well_e=2000&read_noise_dn=2"},
        {"faults": "ambient=0.5"},
        {"faults": "gamma=2.0"},
        {"faults": "gamma=2.6"},
        {"exposure_ns": 60_000_000},
        {"faults": "bits=12"},
    ],
    ids=["dark and noisy", "strong ambient", "gamma -.3", "gamma +.3", "saturated", "12 bits"],
)
@pytest.mark.parametrize("scene", ["sphere_dark", "bust"])
def test_hard_conditions_are_not_disorder(scene: str, conditions: dict[str, object]) -> None:
    for pattern in ("3 shifts", "4 shifts"):
        capture = take(PATTERNS[pattern], scene=scene, **conditions)  # type: ignore[arg-type]
        assert capture.acquisition.witnesses.passed, capture.acquisition.witnesses.items
        assert capture.acquisition.retakes == 0


def test_fringes_that_blur_has_taken_testify_nothing() -> None:
    # What swings at the ends of the field then is no fringe: its phases have nothing to do with the other sets'.
    sequence = PatternSequence.bracketed(QUICK, PmpPattern(frequencies=(1, 5, 30), shifts=(8, 8, 8)))
    found = take(sequence, exposure_ns=12_500_001, scene="bust", faults="projector_blur_sigma_px=4").acquisition
    assert found.witnesses.passed, found.witnesses.items
    assert found.retakes == 0
    assert any("frequency 30 is blurred away" in text for text in found.witnesses.cannot_reveal)


@pytest.mark.parametrize("pattern", list(PATTERNS))
def test_an_uncorrected_gamma_is_not_disorder(pattern: str) -> None:
    bent = PATTERNS[pattern].pattern
    sequence = PatternSequence.bracketed(QUICK, bent)
    for scene in ("board", "sphere_dark"):
        found = take(sequence, scene=scene).acquisition
        assert found.witnesses.passed, found.witnesses.items


def test_a_small_lit_object_is_not_accused_and_what_it_cannot_reveal_is_said() -> None:
    capture = taken("8 shifts")
    rng = np.random.default_rng(3)
    shown = {}
    for position, pixels in capture.thumbnails.items():
        dark = rng.normal(3, 1, pixels.shape).clip(0).astype(np.uint8)
        dark[50:62, 70:86] = pixels[50:62, 70:86]
        shown[position] = dark
    found = witness(capture.sequence, shown, 255)
    assert found.passed, found.items
    assert any("order bars" in text for text in found.cannot_reveal)


@pytest.mark.parametrize(
    ("black", "adds", "says", "hint"),
    [
        (5, 0, "nothing in the camera's view is lit", "lens cap"),
        (20, 6, "too weak: it adds [567] of 255.*other light makes 20", "times as long.*darken the room"),
        (2, 6, "too weak: it adds [567] of 255 .* noise of [0-9.]*$", "times as long .*move nearer$"),
        (300, 0, "saturated without the projector's light", "shorten the exposure"),
    ],
)
def test_nothing_lit_is_said_clearly(black: int, adds: int, says: str, hint: str) -> None:
    rng = np.random.default_rng(3)
    sequence = PATTERNS["8 shifts"]
    shown = {}
    for p in range(len(sequence)):
        level = black + adds * sequence.light(p)[:, :160][:120] + rng.normal(0, 1, (120, 160))
        shown[p] = np.rint(level.clip(0, 255)).astype(np.uint8)
    found = witness(sequence, shown, 255)
    assert found.dark
    assert not found.passed
    error = sync_error(sequence, (), found, ())
    assert re.search(says, str(error))
    assert re.search(hint, error.hint)


def test_captures_from_elsewhere_are_judged_by_what_they_have() -> None:
    capture = taken("3 shifts")
    bare = PatternSequence(QUICK, capture.sequence.pattern)
    shown = [capture.thumbnails[p] for p in capture.sequence.fringes]
    found = witness(bare, dict(enumerate(shown)), 255)
    assert found.passed
    assert any("no sentinels" in text for text in found.cannot_reveal)
    assert any("no order bars" in text for text in found.cannot_reveal)
    rotated = witness(bare, dict(enumerate([*shown[:3], shown[4], shown[5], shown[3]])), 255)
    assert not rotated.passed
    white = witness(bare, {n: np.full_like(frame, 255) for n, frame in enumerate(shown)}, 255)
    assert white.dark
    assert "saturated in every frame" in str(sync_error(bare, (), white, ()))


# --- disorder ----------------------------------------------------------------------------------------------------


def disorders(sequence: PatternSequence) -> dict[str, dict[int, int]]:
    """Everything that can happen to the order of a sequence: position -> what it shows instead."""
    rng = random.Random(1)  # noqa: S311
    count, groups = len(sequence), sets(sequence)
    found: dict[str, dict[int, int]] = {"reversed": {p: count - 1 - p for p in range(count)}}
    for lag in (1, 2, -1, len(groups[0])):
        found[f"late by {lag}"] = {p: min(max(p - lag, 0), count - 1) for p in range(count)}
    for number, group in enumerate(groups):
        i = rng.randrange(len(group) - 1)
        found[f"swap in set {number}"] = {group[i]: group[i + 1], group[i + 1]: group[i]}
        found[f"double in set {number}"] = {group[i + 1]: group[i]}
        found[f"set {number} rotated"] = dict(zip(group, (*group[1:], group[0]), strict=True))
        found[f"set {number} reversed"] = dict(zip(group, group[::-1], strict=True))
    found["all sets rotated"] = {p: q for g in groups for p, q in zip(g, (*g[1:], g[0]), strict=True)}
    found["all sets reversed"] = {p: q for g in groups for p, q in zip(g, g[::-1], strict=True)}
    found["fringes reversed"] = dict(zip(sequence.fringes, sequence.fringes[::-1], strict=True))
    if len(groups) > 1:
        found["swap across sets"] = {groups[0][1]: groups[1][2], groups[1][2]: groups[0][1]}
        if len(groups[0]) == len(groups[1]):
            found["second set is the first again"] = dict(zip(groups[1], groups[0], strict=True))
    return found


@pytest.mark.parametrize(
    ("pattern", "scene"),
    [("8 shifts", "board"), ("3 shifts", "bust"), ("4 shifts", "blocks"), ("heterodyne", "board"), ("one set", "bust")],
)
def test_every_disorder_is_seen(pattern: str, scene: str) -> None:
    capture = taken(pattern, scene)
    for name, order in disorders(capture.sequence).items():
        assert not questioned(capture, order).passed, name


def test_swapped_and_doubled_frames_are_named() -> None:
    capture = taken("8 shifts")
    assert questioned(capture, {5: 6, 6: 5}).suspects == (5, 6)
    assert questioned(capture, {6: 5}).suspects == (6,)
    assert questioned(capture, {5: 14, 14: 5}).suspects == (5, 14)


def test_a_shadow_over_one_frame_is_named_though_no_order_explains_it() -> None:
    capture = taken("8 shifts")
    position = capture.sequence.fringes[-3]
    shown = reordered(capture, {})
    frame = shown[position]
    shown[position] = (frame * np.linspace(1, 0.6, frame.shape[1])).astype(frame.dtype)
    found = witness(capture.sequence, shown, capture.format.max_value)
    assert [item.name for item in found.items if not item.passed] == ["residual 8y"]
    assert found.suspects == (position,)


def test_a_rotated_set_is_named_and_the_blind_rotation_needs_the_bars() -> None:
    capture = taken("4 shifts")
    middle = sets(capture.sequence)[1]
    assert set(questioned(capture, dict(zip(middle, (*middle[1:], middle[0]), strict=True))).suspects) == set(middle)
    blind = taken("3 shifts")
    order = disorders(blind.sequence)["all sets rotated"]
    found = questioned(blind, order)
    assert [item.name for item in found.items if not item.passed] == ["order bars y"]
    assert found.whole


def test_sentinels_tell_blends_lag_and_direction() -> None:
    capture = taken("8 shifts")
    order = disorders(capture.sequence)
    assert "backwards" in questioned(capture, order["reversed"]).items[0].says
    assert "before its own" in questioned(capture, order["late by 1"]).items[0].says
    assert "after its own" in questioned(capture, order["late by -1"]).items[0].says
    shown = capture.thumbnails
    blended = {p: np.rint(0.8 * shown[p].astype(float) + 0.2 * shown[max(p - 1, 0)]).astype(np.uint8) for p in shown}
    found = witness(capture.sequence, blended, 255)
    assert "neither black nor white" in found.items[0].says
    assert found.whole


def test_one_stale_sentinel_is_taken_again_alone() -> None:
    found = questioned(taken("8 shifts"), {1: 0})
    assert found.suspects == (1,)
    assert not found.whole


def test_a_missing_frame_does_not_accuse_the_others() -> None:
    capture = taken("8 shifts")
    for absent in (0, 7, 19, 22):
        shown = {p: pixels for p, pixels in capture.thumbnails.items() if p != absent}
        assert witness(capture.sequence, shown, 255).passed


# --- Gray code ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inverse", [True, False])
@pytest.mark.parametrize("scene", ["bust", "blocks"])
def test_gray_code_sound_and_exchanged(scene: str, inverse: bool) -> None:
    capture = take(gray(inverse=inverse), scene=scene)
    assert capture.acquisition.witnesses.passed, capture.acquisition.witnesses.items
    step = 2 if inverse else 1
    fringes = capture.sequence.fringes
    a, b = fringes[2 * step], fringes[3 * step]
    order = {a: b, b: a} | ({a + 1: b + 1, b + 1: a + 1} if inverse else {})
    found = questioned(capture, order)
    assert not found.passed
    assert {a, b} <= set(found.suspects)


def test_gray_pairs_that_are_no_inverses_are_named() -> None:
    capture = take(gray())
    a = capture.sequence.fringes[4]
    assert set(questioned(capture, {a + 1: a}).suspects) == {a, a + 1}


@cache
def gray_taken(scene: str, axes: tuple[Axis, ...] = ("y",), bits: int = 8) -> Taken:
    code_bits = 8 if axes == ("y",) else 9
    return take(PatternSequence.bracketed(QUICK, GrayPattern(axes, bits, code_bits)), scene=scene)


@pytest.mark.parametrize("scene", ["board", "bust", "blocks"])
def test_every_bit_of_gray_code_exchanged_with_its_inverse_is_named(scene: str) -> None:
    capture = gray_taken(scene)
    fringes = capture.sequence.fringes
    for a, b in zip(fringes[::2], fringes[1::2], strict=True):
        assert questioned(capture, {a: b, b: a}).suspects == (a, b)


def test_code_frames_turned_round_or_reversed_are_named() -> None:
    capture = gray_taken("board")
    fringes = capture.sequence.fringes
    for count in (12, 16):
        order = {fringes[i]: fringes[(i + 2) % count] for i in range(count)}
        assert questioned(capture, order).suspects == fringes[:count]
    assert questioned(capture, dict(zip(fringes, fringes[::-1], strict=True))).suspects == fringes
    a, b = fringes[12:14], fringes[14:16]
    found = questioned(capture, dict(zip((*a, *b), (*b, *a), strict=True)))
    assert found.suspects == (*a, *b)
    assert "smooth" in found.items[-1].says


def test_the_coarsest_bit_needs_the_bars_and_without_them_it_is_said() -> None:
    capture = gray_taken("board", ("x", "y"))
    bare = PatternSequence(QUICK, capture.sequence.pattern)
    fringes = capture.sequence.fringes
    found = witness(bare, {i: capture.thumbnails[p] for i, p in enumerate(fringes)}, 255)
    assert found.passed
    assert sum("no order bars" in text for text in found.cannot_reveal) == 2
    assert "no order bars" not in str(gray_taken("board", ("x", "y")).acquisition.witnesses.cannot_reveal)
    a, b = fringes[18:20]
    assert questioned(capture, {a: b, b: a}).suspects == (a, b)


@pytest.mark.parametrize("bit", range(7))
def test_a_pair_of_code_frames_that_is_the_next_one_again_is_named(bit: int) -> None:
    capture = gray_taken("board")
    own, later = (capture.sequence.fringes[2 * b : 2 * b + 2] for b in (bit, bit + 1))
    assert set(questioned(capture, dict(zip(own, later, strict=True))).suspects) >= set(own)


@pytest.mark.parametrize("factor", [0.7, 0.9, 0.95])
@pytest.mark.parametrize("pattern", ["4 shifts", "3 shifts"])
def test_frequencies_that_were_not_projected_are_told_by_the_bars(pattern: str, factor: float) -> None:
    capture = taken(pattern)
    content = capture.sequence.describe()
    content["frequencies"] = [factor * f for f in content["frequencies"]]
    described = PatternSequence.from_description(capture.sequence.projector, content)
    found = witness(described, capture.thumbnails, capture.format.max_value)
    (wrong,) = [item for item in found.items if not item.passed]
    assert wrong.name == "order bars y"
    assert f"{factor:.1f}"[:2] in wrong.says
    assert "frequencies or projector size" in wrong.says


@pytest.mark.parametrize("move", [-12.0, 1.5, 6.0])
def test_an_origin_that_is_not_that_of_the_frames_is_told_by_the_bars(move: float) -> None:
    capture = taken("4 shifts")
    content = {**capture.sequence.describe(), "origin": 0.5 + move}
    described = PatternSequence.from_description(capture.sequence.projector, content)
    found = witness(described, capture.thumbnails, capture.format.max_value)
    (said,) = [item.says for item in found.items if not item.passed]
    (told,) = re.findall(r"order bars along y if .* moved by ([+-]\d+) px: the description's origin", said)
    assert float(told) == pytest.approx(move, abs=2)


def test_a_frame_of_bars_that_shows_none_is_named() -> None:
    capture = gray_taken("board")
    bars = capture.sequence.bars["y"]
    assert questioned(capture, {bars: capture.sequence.sentinels[0]}).suspects == (bars,)


@pytest.mark.parametrize("bits", [3, 5, 8])
@pytest.mark.parametrize("code", ["gray", "binary"])
def test_few_bits_and_binary_code_are_not_accused(bits: int, code: Literal["gray", "binary"]) -> None:
    sequence = PatternSequence.bracketed(QUICK, GrayPattern(("y",), bits, 8, code))
    found = take(sequence, scene="sphere_board").acquisition
    assert found.witnesses.passed, found.witnesses.items
    assert found.retakes == 0


@pytest.mark.parametrize(
    "faults", ["full_well_e=2000&read_noise_dn=2", "ambient=0.5", "gamma=2.6", "bits=12", "exposure"]
)
@pytest.mark.parametrize("scene", ["textured", "bust"])
def test_hard_conditions_are_no_disorder_of_gray_code(scene: str, faults: str) -> None:
    exposure_ns, faults = (60_000_000, "") if faults == "exposure" else (12_500_001, faults)
    for inverse in (True, False):
        found = take(gray(8, inverse), faults, scene=scene, exposure_ns=exposure_ns).acquisition
        assert found.witnesses.passed, found.witnesses.items
        assert found.retakes == 0


def test_white_and_black_exchanged() -> None:
    capture = take(gray(inverse=False))
    assert capture.sequence.white is not None
    assert capture.sequence.black is not None
    white, black = capture.sequence.white, capture.sequence.black
    assert not questioned(capture, {white: black, black: white}).passed


# --- heard before the last frames ---------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [{}, {5: 6, 6: 5}, {4: 3}], ids=["sound", "exchanged", "doubled"])
def test_listening_while_the_last_frames_are_exposed_changes_no_verdict(order: dict[int, int]) -> None:
    capture = taken("8 shifts")
    shown, last = reordered(capture, order), capture.sequence.sentinels[-2:]
    hearing = Hearing(capture.sequence, capture.format.max_value)
    asked = []
    for position, source in ((p, order.get(p, p)) for p in sorted(shown)):
        hearing.listen(position)
        asked.append(bool(hearing._heard))
        hearing.take(position, capture.frames[source])
    assert asked.index(True) == last[0]
    assert hearing.witnesses(0) == questioned(capture, order)
    for position in last:  # one that shows fringes in place of light
        hearing.take(position, capture.frames[5])
        assert hearing.witnesses(0).suspects
        hearing.take(position, capture.frames[position])
    hearing.take(7, capture.frames[9])  # taken again, and wrong: what was heard counts for nothing
    assert 7 in hearing.witnesses(0).suspects


def test_a_lamp_that_drifts_does_not_pass_for_noise() -> None:
    capture = taken("8 shifts")
    dimmed = {p: (pixels * (0.97 if p > 5 else 1.0)).astype(np.uint8) for p, pixels in capture.thumbnails.items()}
    steady, drifting = (hear(capture.sequence, shown, 255).scene for shown in (capture.thumbnails, dimmed))
    assert steady is not None
    assert drifting is not None
    assert drifting.noise < 1.25 * steady.noise


@pytest.mark.parametrize(("shown", "claimed"), [("gray", "binary"), ("binary", "gray")])
def test_a_code_described_as_the_other_one_is_named(shown: str, claimed: str) -> None:
    capture = take(PatternSequence.bracketed(QUICK, GrayPattern(("y",), 7, 8, shown, inverse=True)), scene="board")
    frames = dict(enumerate(capture.thumbnails[p] for p in capture.sequence.fringes))
    right, wrong = (PatternSequence(QUICK, GrayPattern(("y",), 7, 8, code, inverse=True)) for code in (shown, claimed))
    assert witness(right, frames, 255).passed
    found = witness(wrong, frames, 255)
    assert not found.passed
    assert f"smooth as {shown} code" in str(sync_error(wrong, (), found, ()))
