"""Overexposure is named, with an exposure that would not be."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scanner.capture import Capture
from scanner.decode import Reason
from scanner.empty_scan import raise_if_empty
from scanner.errors import DecodeError
from scanner.patterns import GrayPattern, Pattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.saturation import clips_below, overexposed

PMP = PmpPattern()
SIZE = (64, 512)


def capture(brightness: float, pattern: Pattern = PMP, exposure: dict[str, Any] | None = None) -> Capture:
    """Frames of 8 bits whose fringes are `brightness` times full scale high, exposed for 40 ms."""
    sequence = PatternSequence(ProjectorSize(*SIZE), pattern)
    header = SimpleNamespace(
        sequence=sequence,
        camera=SimpleNamespace(max_value=255),
        plan={"exposure_ns": 40_000_000},
        extra={"exposure": exposure or {"mode": "given", "asked_us": 40_000.0}},
    )

    def frame(position: int) -> Any:
        return np.minimum(brightness * sequence.image(position).astype(float), 255).astype(np.uint8)

    return SimpleNamespace(header=header, records=dict.fromkeys(range(len(sequence))), frame=frame)


def decoded(clipped: float) -> Any:
    """A quarter of the pixels is in shadow; of the others a share is clipped."""
    found = np.zeros(1000, np.uint8)
    found[:250] = Reason.SHADOW
    found[250 : 250 + round(750 * clipped)] = Reason.CLIPPED
    return SimpleNamespace(reason=found.reshape(25, 40))


@pytest.mark.parametrize("brightness", [1.1, 1.3, 1.5, 1.9])
def test_the_exposure_that_is_advised_saturates_nothing_and_is_no_dim_one(brightness: float) -> None:
    (warning,) = overexposed(decoded(0.5), capture(brightness))
    assert "overexposed: 50.0% of the pixels in which the pattern shows" in warning
    assert "--exposure auto" in warning
    advised = re.search(r"expose for ([0-9.]+) ms at most \(these were 40\)", warning)
    assert advised is not None
    assert 0.8 < float(advised[1]) / 40 * brightness < 1.0


@pytest.mark.parametrize(("brightness", "words"), [(3.0, "some"), (6.0, "some"), (20.0, "3.6 ms or less")])
def test_what_is_advised_where_hardly_a_sample_is_whole_is_called_a_guess(brightness: float, words: str) -> None:
    (warning,) = overexposed(decoded(1.0), capture(brightness))
    assert "at most" not in warning
    advised = re.search(
        r"expose for (some )?([0-9.]+) ms (or less )?\(a guess: after 40 ms \d+% of the brightest .*\)", warning
    )
    assert advised is not None
    assert words in advised[0]
    assert words != "some" or 0.6 < float(advised[2]) / 40 * brightness < 1.0


@pytest.mark.parametrize("clipped", [0.0, 0.009])
def test_glints_are_no_warning(clipped: float) -> None:
    assert overexposed(decoded(clipped), capture(3.0)) == ()


def test_frames_that_are_no_sinusoids_tell_no_brightness() -> None:
    (warning,) = overexposed(decoded(0.2), capture(3.0, GrayPattern()))
    assert "expose for half of these 40 ms at most" in warning


def test_what_was_exposed_automatically_is_not_told_to_be() -> None:
    (warning,) = overexposed(decoded(0.2), capture(1.1, exposure={"mode": "auto"}))
    assert "ms at most" in warning
    assert "auto" not in warning


def test_a_scan_without_a_value_says_once_what_to_do_about_light() -> None:
    said = overexposed(decoded(1.0), capture(3.0))
    clipped = np.full((4, 5), Reason.CLIPPED)
    for warnings, hint in ((said, said[0]), ((), "lower the exposure or the gain, or close the lens")):
        with pytest.raises(DecodeError, match="20 clipped") as error:
            raise_if_empty(SimpleNamespace(reason=clipped, warnings=warnings))  # type: ignore[arg-type]
        assert error.value.hint == hint


@pytest.mark.parametrize(("brightness", "level", "said"), [(0.95, 200, True), (1.2, 235, True), (0.7, 235, False)])
def test_fringes_cut_off_below_the_last_level_are_named(brightness: float, level: int, said: bool) -> None:
    whole, noise = capture(brightness), np.random.default_rng(3).normal(0, 1, SIZE[::-1])

    def limited(position: int) -> Any:
        return np.minimum(whole.frame(position) + noise, level).clip(0).astype(np.uint8)

    cut = SimpleNamespace(header=whole.header, records=whole.records, frame=limited)
    found = clips_below(cut)
    assert bool(found) == said
    assert not said or f"are {level} of 255 and none is brighter" in found[0]


def test_cosines_that_end_where_they_are_highest_are_not_cut_off() -> None:
    for brightness in (0.012, 0.05, 0.16, 0.3, 0.6, 0.9):
        assert clips_below(capture(brightness)) == ()
