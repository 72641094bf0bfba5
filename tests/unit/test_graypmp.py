"""Gray + PMP: the images of both methods, the fringe that the code names, and what is left out rather than wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.decode import Reason, decoder_for
from scanner.errors import ConfigError, DecodeError
from scanner.patterns import (
    CameraFormat,
    GrayPattern,
    GrayPmpPattern,
    PartSequence,
    PatternSequence,
    PmpPattern,
    ProjectorSize,
)
from scanner.patterns.graypmp import default_gray_pmp
from scanner.ripple_correction import without_ripple
from scanner.sequencer.thumbnail import thumbnail
from scanner.sequencer.witness import witness
from service.scan_patterns import pattern_for

PROJECTOR = ProjectorSize(320, 240)
CAMERA = CameraFormat(260, 200)


def surface():
    """Columns and rows seen: a bent board with a step, whose edge runs down the image."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] / np.array(CAMERA.shape)[:, None, None]
    step = np.where(x > 0.55, 17.0, 0.0)
    return 8 + 270 * x + 6 * np.sin(3 * y) + step, 6 + 200 * y + 5 * np.sin(4 * x) + step


def take(sequence, noise=1.0, seed=0, blur_px=0.7):
    """Frames as a camera sees images through a projector's blur."""
    random, lines = np.random.default_rng(seed), {}
    columns, rows = surface()
    far = int(np.ceil(4 * blur_px))
    reach = np.arange(-far, far + 1)
    weights = np.exp(-(reach**2) / (2 * blur_px**2))
    for position in range(len(sequence)):
        light = sequence.light(position)
        along = rows if (light[:, :1] == light[:, -1:]).all() and (light == light[:, :1]).all() else columns
        line = light[:, 0] if along is rows else light[0]
        line = np.convolve(np.pad(line, far, mode="edge"), weights / weights.sum(), mode="valid")
        grey = 10 + 190 * np.interp(along, np.arange(line.size), line) + random.normal(0, noise, CAMERA.shape)
        lines[position] = np.rint(np.clip(grey, 0, 255)).astype(np.uint8)
    return lines


def decode(sequence, frames):
    decoder = decoder_for(sequence, CAMERA)
    for position, frame in frames.items():
        decoder.add(position, frame)
    return decoder.finish()


def test_its_images_are_those_of_both_methods():
    pattern = default_gray_pmp(("x", "y"), PROJECTOR)
    assert pattern.fringe_count == 2 * 4 + 2 * pattern.gray.bits
    np.testing.assert_array_equal(pattern.fringe(5, PROJECTOR), pattern.pmp.fringe(5, PROJECTOR))
    np.testing.assert_array_equal(pattern.fringe(9, PROJECTOR), pattern.gray.fringe(1, PROJECTOR))
    sequence = PatternSequence.bracketed(PROJECTOR, pattern)
    again = PatternSequence.from_description(PROJECTOR, sequence.describe())
    assert again == sequence
    assert set(sequence.bars) == {"x", "y"}
    part = PartSequence.of(sequence, pattern.gray, pattern.pmp.fringe_count)
    assert part.fringes == sequence.fringes[8:]
    assert len(part) == len(sequence)


@pytest.mark.parametrize(
    ("description", "said"),
    [
        ({"frequencies": [1, 8], "shifts": [4, 4]}, "one frequency"),
        ({"bits": 4}, "tell no fringes of 16 px"),
        ({"code_bits": 7, "bits": 7}, "code bits name"),
        ({"shifts": [2]}, "three shifts"),
    ],
)
def test_what_cannot_be_told_apart_is_refused(description, said):
    good = default_gray_pmp(("y",), PROJECTOR).describe()
    PatternSequence.from_description(PROJECTOR, good)
    with pytest.raises(DecodeError, match=said):
        PatternSequence.from_description(PROJECTOR, good | description)


@pytest.mark.parametrize("given", [{}, {"frequencies": [40]}, {"frequencies": [7.5]}, {"axes": ["x"]}])
def test_its_default_follows_what_is_given(given):
    pattern = pattern_for("gray+pmp", given, "y", PROJECTOR)
    assert isinstance(pattern, GrayPmpPattern)
    pattern.validate(PROJECTOR)
    half = PROJECTOR.along(pattern.axes[0]) / pattern.pmp.frequencies[0] / 2
    assert half / 2 < pattern.cell_px <= half
    with pytest.raises(ConfigError):
        pattern_for("gray+pmp", {"frequency": 3}, "y", PROJECTOR)


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize(("axes", "shifts"), [(("y",), 4), (("x",), 3), (("x", "y"), 8)])
def test_every_pixel_is_on_its_fringe(axes, shifts, inverse):
    pattern = default_gray_pmp(axes, PROJECTOR, shifts=shifts)
    gray = GrayPattern(axes, pattern.gray.bits, pattern.gray.code_bits, inverse=inverse)
    sequence = PatternSequence(PROJECTOR, GrayPmpPattern(pattern.pmp, gray))
    found = decode(sequence, take(sequence))
    for axis, values, sigma, truth in (
        ("x", found.columns, found.sigma_columns, surface()[0]),
        ("y", found.rows, found.sigma_rows, surface()[1]),
    ):
        if axis not in axes:
            assert values is None
            continue
        decided = np.isfinite(values)
        assert decided.mean() > 0.99
        error = (values - truth)[decided]
        assert np.abs(error).max() < 2
        # Three shifts of one frequency leave nothing to judge noise by: a cautious default then.
        assert (0.5 if shifts == 3 else 0.8) < np.sqrt(np.mean((error / sigma[decided]) ** 2)) < 1.25
    assert ((found.reason == Reason.VALUE) == (found.confidence > 0)).all()
    assert found.details["light"][axes[0]]["harmonics"][0]["shifts"] == shifts


def test_strong_noise_leaves_pixels_out_rather_than_wrong():
    sequence = PatternSequence(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    found = decode(sequence, take(sequence, noise=12.0))
    decided = np.isfinite(found.rows)
    assert decided.mean() > 0.3
    assert np.mean(np.abs(found.rows - surface()[1])[decided] > 6) < 1e-3


def test_blur_that_takes_half_of_the_fringes_leaves_the_code():
    # Levels made of the fringes alone lie well inside what the code's images reach.
    sequence = PatternSequence(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    found = decode(sequence, take(sequence, blur_px=3.0))
    decided = np.isfinite(found.rows)
    assert decided.mean() > 0.9
    assert np.mean(np.abs(found.rows - surface()[1])[decided] > 6) < 1e-3


def test_missing_frames_are_named_and_one_of_four_shifts_is_none():
    sequence = PatternSequence.bracketed(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    frames = take(sequence)
    fringes = sequence.fringes
    assert np.isfinite(decode(sequence, {p: f for p, f in frames.items() if p != fringes[2]}).rows).mean() > 0.99
    for lost, named in (((0, 1), f"{fringes[0]}, {fringes[1]}"), ((6,), f"{fringes[6]}")):
        with pytest.raises(DecodeError, match=f"frames {named} are missing"):
            decode(sequence, {p: f for p, f in frames.items() if p not in [fringes[n] for n in lost]})


@pytest.mark.parametrize("exchanged", [(0, 1), (5, 7), None])
def test_frames_out_of_order_are_found_out(exchanged):
    sequence = PatternSequence.bracketed(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    frames = take(sequence)
    if exchanged is not None:
        one, two = (sequence.fringes[n] for n in exchanged)
        frames[one], frames[two] = frames[two], frames[one]
    found = witness(sequence, {p: thumbnail(f) for p, f in frames.items()}, 255)
    assert found.passed == (exchanged is None)
    if exchanged is not None:
        assert {one, two} & set(found.suspects)


def test_other_patterns_are_not_its_business():
    from scanner.decode.graypmp import GrayPmpDecoder  # noqa: PLC0415

    with pytest.raises(DecodeError, match="pmp"):
        GrayPmpDecoder(PatternSequence(PROJECTOR, PmpPattern(("x",), (1.0,), (3,))), CAMERA)


def described(sequence, **members):
    """The same frames by another description of the fringes."""
    pattern = sequence.pattern
    return PatternSequence(PROJECTOR, replace(pattern, pmp=replace(pattern.pmp, **members)))


@pytest.mark.parametrize(
    ("axis", "members", "wrong"),
    [
        ("y", {"offset": 0.5}, "offset, origin or order"),
        ("y", {"offset": np.pi}, "offset, origin or order"),
        ("x", {"origin": 4.5}, "offset, origin or order"),
        ("y", {"sign": 1}, "lie 0.50 of a fringe"),
        ("y", {"frequencies": (16.0,)}, "frequency"),
        ("x", {"frequencies": (20.5,)}, "frequency"),
        ("y", {"frequencies": (19.0,)}, "do not follow the Gray code"),
    ],
)
def test_fringes_that_contradict_the_code_are_refused(axis, members, wrong):
    sequence = PatternSequence(PROJECTOR, default_gray_pmp((axis,), PROJECTOR))
    with pytest.raises(DecodeError, match="frames and description contradict each other") as refused:
        decode(described(sequence, **members), take(sequence))
    assert wrong in f"{refused.value} {refused.value.hint}"


@pytest.mark.parametrize("shifts", [3, 4, 8])
def test_fringe_frames_rotated_by_one_contradict_the_code(shifts):
    sequence = PatternSequence(PROJECTOR, default_gray_pmp(("y",), PROJECTOR, shifts=shifts))
    frames = take(sequence)
    fringes = sequence.fringes[:shifts]
    rotated = frames | {to: frames[of] for to, of in zip(fringes, np.roll(fringes, 1), strict=True)}
    with pytest.raises(DecodeError, match=f"lie {1 / shifts:.2f} of a fringe"):
        decode(sequence, rotated)


def test_a_small_shift_is_told_and_none_where_there_is_none():
    sequence = PatternSequence(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    frames = take(sequence)
    found = decode(sequence, frames)
    assert abs(found.details["phase_and_code"]["y"]["shift_px"]) < 0.05
    assert not any("Gray code" in said for said in found.warnings)
    shifted = decode(described(sequence, offset=0.25), frames)
    assert shifted.details["phase_and_code"]["y"]["shift_px"] == pytest.approx(-0.25 / (2 * np.pi) * 16, abs=0.1)
    assert any("offset or origin of the description may be wrong" in said for said in shifted.warnings)


def test_few_pixels_are_not_judged():
    sequence = PatternSequence(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    dark = {position: np.where(np.arange(CAMERA.height)[:, None] < 20, f, 3) for position, f in take(sequence).items()}
    found = decode(described(sequence, offset=0.5), {p: f.astype(np.uint8) for p, f in dark.items()})
    assert np.isfinite(found.rows).any()
    assert found.details["phase_and_code"]["y"]["cells"] < 8


def test_ripple_is_not_corrected_where_one_set_measures():
    sequence = PatternSequence(PROJECTOR, default_gray_pmp(("y",), PROJECTOR))
    with pytest.raises(DecodeError, match="this one is gray\\+pmp"):
        without_ripple(decode(sequence, take(sequence)), sequence)


@pytest.mark.parametrize("order", ["rotated", "reversed", "last two", "first two", "second and third"])
@pytest.mark.parametrize(("axis", "code"), [("x", "gray"), ("y", "gray"), ("x", "binary")])
def test_code_frames_out_of_order_are_refused(axis, code, order):
    pattern = default_gray_pmp((axis,), PROJECTOR)
    sequence = PatternSequence(PROJECTOR, replace(pattern, gray=replace(pattern.gray, code=code)))
    decode(sequence, frames := take(sequence))
    code = list(sequence.fringes[4:])
    shown = {
        "rotated": code[1:] + code[:1],
        "reversed": code[::-1],
        "last two": [*code[:-2], code[-1], code[-2]],
        "first two": [code[1], code[0], *code[2:]],
        "second and third": [code[0], code[2], code[1], *code[3:]],
    }[order]
    with pytest.raises(DecodeError, match=r"the Gray code (jumps at|names cells beyond).*not in the order described"):
        decode(sequence, frames | {to: frames[of] for to, of in zip(code, shown, strict=True)})


def test_a_thumbnail_of_few_rows_has_some() -> None:
    frame = np.arange(480, dtype=np.uint8)[None].repeat(1, axis=0)
    assert thumbnail(frame).shape[0] == 1
    assert thumbnail(frame.T).shape[1] == 1
