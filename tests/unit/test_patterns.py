"""Patterns: images against the formulas of formats.md written out once more, sentinels, order bars, descriptions."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.errors import DecodeError
from scanner.patterns import (
    CameraFormat,
    FrameRole,
    GrayPattern,
    McpPattern,
    PatternSequence,
    PmpPattern,
    ProjectorSize,
    pattern_from_description,
)
from scanner.patterns.sequence import Precorrection

PROJECTOR = ProjectorSize(96, 72)
PMP = {"method": "pmp", "axes": ["y"], "frequencies": [1, 8], "shifts": [4, 4]}
GRAY = {"method": "gray", "code": "gray", "axes": ["x"], "bits": 5, "code_bits": 7, "inverse": False}
MCP = {"method": "mcp", "axis": "y", "bits": 2, "carriers": [10, 20], "codes": [0, 2, 1, 3]}


# --- images -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sign", "offset", "origin"), [(-1, 0.0, 0.5), (1, 0.7, 0.0)])
def test_pmp_images_follow_their_formula(sign, offset, origin):
    pattern = PmpPattern(("y", "x"), (1.0, 7.5), (3, 5), sign, offset, origin)
    index = 0
    for axis, size in (("y", 72), ("x", 96)):
        for f, shifts in ((1.0, 3), (7.5, 5)):
            for n in range(shifts):
                image = pattern.fringe(index, PROJECTOR)
                assert image.shape == (72, 96)
                for y, x in ((0, 0), (13, 57), (71, 95)):
                    at = (y if axis == "y" else x) + origin
                    angle = 2 * math.pi * f * at / size + sign * 2 * math.pi * n / shifts + offset
                    assert image[y, x] == pytest.approx(0.5 + 0.48 * math.cos(angle), abs=1e-6)
                index += 1
    assert index == pattern.fringe_count
    with pytest.raises(IndexError):
        pattern.fringe(index, PROJECTOR)


@pytest.mark.parametrize("code", ["gray", "binary"])
@pytest.mark.parametrize("inverse", [False, True])
def test_code_images_show_one_bit_each(code, inverse):
    pattern = GrayPattern(("x", "y"), bits=5, code_bits=7, code=code, inverse=inverse)
    each = 2 if inverse else 1
    assert pattern.fringe_count == 2 * 5 * each
    for axis, axis_name in enumerate("xy"):
        for bit in range(5):
            for inverted in range(each):
                image = pattern.fringe((axis * 5 + bit) * each + inverted, PROJECTOR)
                for i in (0, 1, 31, 40, 63, 71):
                    word = i ^ (i >> 1) if code == "gray" else i
                    bright = int(f"{word:07b}"[bit]) ^ inverted
                    assert (image[50, i] if axis_name == "x" else image[i, 50]) == bright
    with pytest.raises(IndexError):
        pattern.fringe(pattern.fringe_count, PROJECTOR)


@pytest.mark.parametrize("profile", ["triangle", "cosine"])
@pytest.mark.parametrize("levels", ["composite", "equal"])
@pytest.mark.parametrize("first", ["modulated", "unmodulated"])
@pytest.mark.parametrize("axis", ["y", "x"])
def test_the_composite_image_follows_its_formula(profile, levels, first, axis):
    pattern = McpPattern(axis, 2, (10.0, 20.5), (0, 2, 1, 3), profile, first, 0.9, levels)
    image = pattern.fringe(0, PROJECTOR)
    along, across = (72, 96) if axis == "y" else (96, 72)
    h = along / 2**3
    for y, x in ((0, 0), (5, 33), (17, 60), (30, 2), (55, 47), (71, 71)):
        s = math.floor((y + 0.5) / h)
        t = (y + 0.5) / h - s
        p = 1 - abs(2 * t - 1) if profile == "triangle" else (1 - math.cos(2 * math.pi * t)) / 2
        if (s % 2 == 0) == (first == "modulated"):
            code = (0, 2, 1, 3)[s // 2]
            on = [f for i, f in enumerate((10.0, 20.5)) if code & (1 << i)]
            waves = [math.cos(2 * math.pi * f * (x + 0.5) / across) for f in on]
            expected = sum((1 + w) / 2 for w in waves) / 2 if levels == "composite" else 0.5 + sum(waves) / 4
        else:
            expected = 0.9 if levels == "composite" else 0.5
        seen = image[y, x] if axis == "y" else image[x, y]
        assert seen == pytest.approx(p * expected, abs=1e-6)
    with pytest.raises(IndexError):
        pattern.fringe(1, PROJECTOR)


def test_stripes_have_their_code_words():
    pattern = McpPattern("y", 2, (10.0, 20.0), (0, 2, 1, 3))
    assert [pattern.code_of(s) for s in range(8)] == [0, None, 2, None, 1, None, 3, None]
    assert pattern.stripe_count == 8
    assert pattern.pitch_px(PROJECTOR) == 9


# --- sequences ----------------------------------------------------------------------------------------------------


def test_a_sequence_is_bracketed_by_sentinels_and_order_bars():
    sequence = PatternSequence.bracketed(PROJECTOR, PmpPattern(("x", "y"), (1.0, 8.0), (4, 3)))
    assert len(sequence) == 6 + 14 + 2
    assert [sequence.role(p) for p in (0, 1, 2, 3, 16, 17, 18, 19)] == [
        *[FrameRole.SENTINEL] * 3, FrameRole.FRINGE, FrameRole.FRINGE, FrameRole.BARS, FrameRole.BARS,
        FrameRole.SENTINEL,
    ]  # fmt: skip
    assert [int(sequence.image(p).max()) for p in sequence.sentinels] == [0, 255, 0, 255, 0, 255]
    assert sequence.fringes == tuple(range(3, 17))
    assert sequence.bars == {"x": 17, "y": 18}
    with pytest.raises(IndexError):
        sequence.image(22)


def test_gray_code_gets_white_and_black_and_one_image_nothing():
    sequence = PatternSequence.bracketed(PROJECTOR, GrayPattern(("x",), 7, 7, inverse=False))
    assert (sequence.white, sequence.black) == (3, 4)
    assert sequence.role(3) is FrameRole.WHITE
    assert sequence.role(4) is FrameRole.BLACK
    assert (sequence.image(3) == 255).all()
    assert (sequence.image(4) == 0).all()
    assert len(PatternSequence.bracketed(PROJECTOR, McpPattern("y", 2, (10.0, 20.0), (0, 1, 2, 3)))) == 1


@pytest.mark.parametrize("axis", ["x", "y"])
def test_order_bars_match_no_shift_nor_mirror_image_of_themselves(axis):
    projector = ProjectorSize(310, 620)
    sequence = PatternSequence.bracketed(projector, PmpPattern((axis,), (1.0,), (3,)))
    image = sequence.image(sequence.bars[axis])
    line = image[0] if axis == "x" else image[:, 0]
    assert (image == (line[None, :] if axis == "x" else line[:, None])).all()
    bars = line.reshape(31, -1)
    assert (bars == bars[:, :1]).all()
    bits = bars[:, 0] > 0
    for shift in range(31):
        for other in (np.roll(bits, shift), np.roll(bits[::-1], shift)):
            same = int(np.count_nonzero(bits == other))
            assert same == 31 or same <= 23
    assert [int(np.count_nonzero(bits == np.roll(bits, s))) for s in range(1, 31)] == [15] * 30


def test_precorrection_makes_the_light_linear():
    pattern = PmpPattern(("y",), (1.0,), (3,))
    light = PatternSequence(PROJECTOR, pattern).light(0)
    plain = PatternSequence(PROJECTOR, pattern).image(0)
    assert plain.dtype == np.uint8
    assert np.abs(plain / 255 - light).max() <= 0.5 / 255 + 1e-6
    for gamma in (1.8, 2.3):
        shown = PatternSequence(PROJECTOR, pattern, precorrection=Precorrection(gamma=gamma)).image(0)
        assert np.abs((shown / 255.0) ** gamma - light).max() < gamma / 255
    table = tuple(255 * (k / 255) ** (1 / 2.3) for k in range(256))
    by_table = PatternSequence(PROJECTOR, pattern, precorrection=Precorrection(table=table)).image(0)
    by_gamma = PatternSequence(PROJECTOR, pattern, precorrection=Precorrection(gamma=2.3)).image(0)
    assert np.abs(by_table.astype(int) - by_gamma).max() <= 1


def test_sizes_and_formats():
    assert (PROJECTOR.along("x"), PROJECTOR.along("y")) == (96, 72)
    assert (CameraFormat(4, 3, 8).dtype, CameraFormat(4, 3, 12).dtype) == (np.uint8, np.uint16)
    assert (CameraFormat(4, 3, 12).max_value, CameraFormat(4, 3).shape) == (4095, (3, 4))


# --- descriptions -------------------------------------------------------------------------------------------------

AXES = st.sampled_from([("x",), ("y",), ("x", "y"), ("y", "x")])
FREQUENCY = st.one_of(st.integers(1, 24).map(float), st.floats(0.1, 24, allow_nan=False))


@st.composite
def pmp_patterns(draw):
    count = draw(st.integers(1, 4))
    frequencies = tuple(draw(st.lists(FREQUENCY, min_size=count, max_size=count, unique=True)))
    shifts = tuple(draw(st.lists(st.integers(3, 16), min_size=count, max_size=count)))
    offset, origin = (draw(st.floats(-4, 4, allow_nan=False)) for _ in range(2))
    return PmpPattern(draw(AXES), frequencies, shifts, draw(st.sampled_from([-1, 1])), offset, origin)


@st.composite
def gray_patterns(draw):
    code_bits = draw(st.integers(7, 16))
    code = draw(st.sampled_from(["gray", "binary"]))
    return GrayPattern(draw(AXES), draw(st.integers(1, code_bits)), code_bits, code, draw(st.booleans()))


@st.composite
def mcp_patterns(draw):
    bits = draw(st.integers(2, 3))
    start, step = draw(st.floats(1, 5)), draw(st.floats(4.5, 9))
    return McpPattern(
        draw(st.sampled_from(["x", "y"])),
        bits,
        tuple(start + step * i for i in range(bits)),
        tuple(draw(st.permutations(range(1 << bits)))),
        draw(st.sampled_from(["triangle", "cosine"])),
        draw(st.sampled_from(["modulated", "unmodulated"])),
        draw(st.floats(0.1, 1)),
        draw(st.sampled_from(["composite", "equal"])),
    )


PRECORRECTIONS = st.one_of(
    st.none(),
    st.floats(0.5, 4).map(lambda gamma: Precorrection(gamma=gamma)),
    st.just(Precorrection(table=tuple(float(k) for k in range(256)))),
)


@given(st.one_of(pmp_patterns(), gray_patterns(), mcp_patterns()), PRECORRECTIONS)
@settings(max_examples=120, deadline=None)
def test_a_description_says_the_whole_sequence(pattern, precorrection):
    sequence = PatternSequence.bracketed(PROJECTOR, pattern, precorrection)
    described = sequence.describe()
    again = PatternSequence.from_description(PROJECTOR, described)
    assert again == sequence
    assert again.describe() == described
    for position in {0, len(sequence) // 2, len(sequence) - 1}:
        assert (again.image(position) == sequence.image(position)).all()


def test_a_reader_who_does_not_know_order_bars_takes_the_same_frames_for_fringes():
    sequence = PatternSequence.bracketed(PROJECTOR, PmpPattern(("x",), (1.0, 8.0), (3, 3)))
    described = sequence.describe()
    special = {*described["sentinels"], described["white"], described["black"]}
    assert tuple(p for p in range(len(sequence)) if p not in special) == sequence.fringes


def test_what_may_be_absent_has_its_default():
    pattern = pattern_from_description(PMP)
    assert pattern == PmpPattern(("y",), (1.0, 8.0), (4, 4), -1, 0.0, 0.5)
    assert pattern_from_description({"method": "gray", "axes": ["x"], "bits": 8}) == GrayPattern(
        ("x",), 8, 8, "gray", False
    )
    mcp = pattern_from_description(MCP)
    assert (mcp.levels, mcp.profile, mcp.first, mcp.unmodulated) == ("composite", "triangle", "modulated", 1.0)


BAD = [
    ([], "not an object"),
    ({}, "None"),
    ({"method": "fourier"}, "'fourier'"),
    ({**PMP, "axes": []}, '"axes"'),
    ({**PMP, "axes": ["y", "y"]}, '"axes"'),
    ({**PMP, "axes": ["z"]}, '"axes"'),
    ({**PMP, "frequencies": None}, '"frequencies"'),
    ({**PMP, "frequencies": [1, "8"]}, '"frequencies"'),
    ({**PMP, "frequencies": [1, math.nan]}, '"frequencies"'),
    ({**PMP, "frequencies": [1, math.inf]}, '"frequencies"'),
    ({**PMP, "frequencies": [0, 8]}, "must lie in"),
    ({**PMP, "frequencies": [1, 10**400]}, "finite number"),
    ({**PMP, "frequencies": [8, 8]}, "listed twice"),
    ({**PMP, "shifts": [3, 10**9]}, "more than 1000 shifts"),
    ({**PMP, "origin": 1e9}, "offset and origin"),
    ({**PMP, "frequencies": [1, 8, 64]}, "3 frequencies and 2 shifts"),
    ({**PMP, "frequencies": [1, 30]}, "2.40 projector pixels"),
    ({**PMP, "shifts": [4, 2]}, "three shifts"),
    ({**PMP, "shifts": [4, 3.5]}, '"shifts"'),
    ({**PMP, "shifts": [4, True]}, '"shifts"'),
    ({**PMP, "sign": 2}, '"sign"'),
    ({**PMP, "sign": 1.0}, '"sign"'),
    ({**PMP, "offset": "0"}, '"offset"'),
    ({**PMP, "origin": None}, '"origin"'),
    ({**PMP, "white": 1.5}, '"white"'),
    ({**PMP, "white": 40}, "positions in 0 .. 8"),
    ({**PMP, "white": 0, "black": 0}, "different positions"),
    ({**PMP, "black": True}, '"black"'),
    ({**PMP, "sentinels": 3}, '"sentinels"'),
    ({**PMP, "sentinels": [0, 1, 2]}, "6 sentinels, got 3"),
    ({**PMP, "sentinels": [0, "1"]}, "sentinels"),
    ({**PMP, "bars": [3]}, '"bars"'),
    ({**PMP, "bars": {"z": 3}}, '"bars"'),
    ({**PMP, "precorrection": 2.3}, '"precorrection"'),
    ({**PMP, "precorrection": {}}, "either gamma or table"),
    ({**PMP, "precorrection": {"gamma": 2, "table": [0] * 256}}, "either gamma or table"),
    ({**PMP, "precorrection": {"gamma": "two"}}, '"precorrection.gamma"'),
    ({**PMP, "precorrection": {"gamma": True}}, '"precorrection.gamma"'),
    ({**PMP, "precorrection": {"table": "falling"}}, '"precorrection.table"'),
    ({**PMP, "precorrection": {"gamma": 1e200}}, "0.1 .. 10"),
    ({**PMP, "precorrection": {"gamma": float("nan")}}, "finite"),
    ({**PMP, "precorrection": {"gamma": 0}}, "0.1 .. 10"),
    ({**PMP, "precorrection": {"gamma": -2}}, "0.1 .. 10"),
    ({**PMP, "precorrection": {"table": list(range(255, -1, -1))}}, "falls, or is flat"),
    ({**PMP, "precorrection": {"table": [7] * 256}}, "falls, or is flat"),
    ({**PMP, "precorrection": {"gamma": 40}}, "0.1 .. 10"),
    ({**PMP, "precorrection": {"table": [1, 2, 3]}}, "256 numbers"),
    ({**PMP, "precorrection": {"table": [300] * 256}}, "256 numbers"),
    ({**GRAY, "bits": 0}, "bits must be"),
    ({**GRAY, "bits": 8}, "bits must be"),
    ({**GRAY, "bits": "5"}, '"bits"'),
    ({**GRAY, "code_bits": 6}, "6 code bits name 64 positions"),
    ({**GRAY, "code_bits": 17}, "at most 16"),
    ({**GRAY, "code": "grey"}, '"code"'),
    ({**GRAY, "inverse": 1}, '"inverse"'),
    ({**MCP, "axis": "z"}, '"axis"'),
    ({**MCP, "bits": 7}, "2 to 6 bits"),
    ({**MCP, "carriers": [10]}, "2 bits need 2 carriers"),
    ({**MCP, "carriers": [10, 11]}, "1 cycles apart"),
    ({**MCP, "carriers": [-10, 20]}, "positive"),
    ({**MCP, "carriers": [10, 40]}, "2.40 projector pixels"),
    ({**MCP, "codes": [0, 1, 2, 2]}, "codes must name each"),
    ({**MCP, "codes": [0, 1, 2, 3.0]}, '"codes"'),
    ({**MCP, "unmodulated": 0}, '"unmodulated"'),
    ({**MCP, "profile": "square"}, '"profile"'),
    ({**MCP, "first": "both"}, '"first"'),
    ({**MCP, "levels": "mixed"}, '"levels"'),
    ({**MCP, "bits": 4, "carriers": [4, 12, 20, 28], "codes": list(range(16))}, "2.25 projector pixels high"),
]


@pytest.mark.parametrize(("description", "says"), BAD, ids=[says for _, says in BAD])
def test_a_bad_description_is_named(description, says):
    with pytest.raises(DecodeError, match=re.escape(says)):
        PatternSequence.from_description(PROJECTOR, description)


def test_a_pattern_without_fringes_is_refused():
    with pytest.raises(DecodeError, match="no frequency is given"):
        PmpPattern(("y",), (), ())
