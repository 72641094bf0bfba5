"""MCP frames of too few pixels: the refusal names that cause, and does not where the pixels are enough."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from scanner.decode import decoder_for
from scanner.decode.mcp import resolution
from scanner.decode.mcp.model import PatternModel
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize

PROJECTOR = ProjectorSize(1152, 864)
SEQUENCE = PatternSequence(PROJECTOR, McpPattern())
OWN, PUBLISHED = (PatternModel.of(McpPattern(levels=levels), PROJECTOR) for levels in ("equal", "composite"))


def refusal(image: np.ndarray) -> DecodeError:
    decoder = decoder_for(SEQUENCE, CameraFormat(image.shape[1], image.shape[0]), "default", None)
    decoder.add(0, image)
    with pytest.raises(DecodeError) as caught:
        decoder.finish()
    return caught.value


def coarse(fraction: int) -> np.ndarray:
    """The pattern on a board before a camera with a pixel for so many of the projector's."""
    width, height = 1152 // fraction, 864 // fraction
    seen = cv2.resize(SEQUENCE.image(0), (width, height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(5).normal(0, 3, seen.shape)
    return np.asarray(np.clip(0.3 * seen + 20 + noise, 0, 255), np.uint8)


@pytest.mark.parametrize(
    ("fraction", "cause"),
    [
        (5, "carriers are too fine .* stripes 5.4 px high the finest has a period of 1.0 px"),
        (8, "stripes are 3.4 px apart, too fine for this camera: 5 px are needed"),
        (12, "stripes are 2.2 px apart, too fine"),
    ],
)
def test_stripes_or_carriers_too_fine_for_the_camera_are_the_cause_named(fraction: int, cause: str) -> None:
    refused = refusal(coarse(fraction))
    assert refused.hint is not None
    assert "more pixels" in refused.hint
    with pytest.raises(DecodeError, match=cause):
        raise refused


def test_stripes_of_a_pixel_beat_with_the_pixels_and_the_beat_is_not_the_cause_named() -> None:
    every = np.ascontiguousarray(SEQUENCE.image(0)[::24, ::24])
    assert "32 on 36 px are 1.1 px high, 5 are needed" in str(refusal(every))


def test_a_dark_frame_or_noise_is_no_stripes_too_fine() -> None:
    dark = refusal(np.full((432, 576), 20, np.uint8))
    assert "too fine" not in f"{dark} {dark.hint}"
    noise = np.random.default_rng(2).normal(60, 12, (108, 144)).clip(0, 255).astype(np.uint8)
    refused = refusal(noise)
    assert "too fine" not in str(refused)
    assert "32 on 108 px are 3.4 px high, 5 are needed" in str(refused.hint)


@pytest.mark.parametrize("model", [OWN, PUBLISHED], ids=["own", "published"])
@pytest.mark.parametrize("pitch", [2.3, 3.4, 4.6])
def test_fine_stripes_are_measured_in_noise_and_coarse_ones_left_alone(model: PatternModel, pitch: float) -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, (60, 100)).astype(np.float32)
    at = 16 / pitch * (np.arange(100) + 0.5)
    seen = np.interp(at, np.arange(len(model.column)), model.column).astype(np.float32)
    assert resolution.fine_stripes(seen + noise, model) == pytest.approx(pitch, rel=0.05)
    assert resolution.fine_stripes(noise, model) is None
    high = np.interp(at / 6, np.arange(len(model.column)), model.column).astype(np.float32)
    assert resolution.fine_stripes(high + noise, model) is None


def stripes_down(_: np.ndarray, x: np.ndarray) -> np.ndarray:
    return 120 + 100 * np.cos(2 * np.pi * x / 15)


def lettering(y: np.ndarray, _: np.ndarray) -> np.ndarray:
    page = np.full(y.shape, 230, np.uint8)
    for row in range(20, len(page), 22):
        cv2.putText(page, "The quick brown fox jumps over the lazy dog" * 2, (5, row), 0, 0.5, 20)
    return page


def squares(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return 30 + 180 * ((x // 23 + y // 23) % 2)


def grain(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    noise = np.fft.rfft2(np.random.default_rng(1).normal(size=y.shape))
    distance = np.hypot(np.fft.fftfreq(y.shape[0])[:, None], np.fft.rfftfreq(y.shape[1])[None])
    seen = np.fft.irfft2(noise / np.maximum(distance, 1e-3) ** 1.5, y.shape)
    return 128 + 50 * seen / seen.std()


@pytest.mark.parametrize("picture", [stripes_down, lettering, squares, grain])
def test_pictures_without_the_pattern_are_not_too_fine(picture: Callable[..., np.ndarray]) -> None:
    y, x = np.mgrid[:520, :696]
    noise = np.random.default_rng(3).normal(0, 2, y.shape)
    assert "too fine" not in str(refusal((picture(y, x) + noise).clip(0, 255).astype(np.uint8)))
