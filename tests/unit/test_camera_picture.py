"""Figures of preview pictures: brightness as shares of the range, and a sharpness that is highest in focus."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scanner.camera_picture import CameraPicture, sharpness
from scanner.wire_images import PreviewHeader, encode_image
from service.commands import preview as command


def picture(blur_px: float, noise: float = 0.0, level: float = 1.0) -> np.ndarray:
    """A board of squares, of a camera of 10 bits."""
    y, x = np.mgrid[:240, :320] // 24
    board = 200 + 600.0 * ((x + y) % 2)
    board = cv2.GaussianBlur(board, (0, 0), blur_px) * level
    noisy = board + np.random.default_rng(3).normal(0, noise, board.shape)
    return np.clip(noisy.round(), 0, 1023).astype(np.uint16)


def message(number: int, pixels: np.ndarray) -> bytes:
    height, width = pixels.shape
    header = PreviewHeader(number=number, width=width, height=height, dtype="uint16", t_ns=0)
    return encode_image(header, pixels.data.cast("B"))


def test_figures_are_shares_of_the_camera_range_and_gaps_are_counted() -> None:
    pixels = np.full((10, 20), 512, np.uint16)
    pixels[:1] = 1023
    first = CameraPicture.of(message(1, pixels), None)
    figures = first.figures(10)
    assert figures["mean"] == pytest.approx((0.9 * 512 + 0.1 * 1023) / 1023)
    assert figures["bright"] == 1
    assert figures["saturated"] == pytest.approx(0.1)
    assert CameraPicture.of(message(5, pixels), first).missed == 3
    assert CameraPicture.of(message(1, pixels), first).missed == 0


def test_sharpness_is_highest_in_focus_whatever_brightness_and_noise() -> None:
    blurs = (0.5, 0.8, 1.2, 2.0, 3.0, 5.0)
    for noise in (0.0, 8.0):
        seen = [sharpness(picture(blur, noise)) for blur in blurs]
        assert seen == sorted(seen, reverse=True)
        assert seen == pytest.approx([sharpness(picture(blur)) for blur in blurs], rel=0.05)
    assert sharpness(picture(1.0, level=0.5)) == pytest.approx(sharpness(picture(1.0)), rel=0.02)
    assert sharpness(np.zeros((50, 50), np.uint8)) == 0
    assert sharpness(np.random.default_rng(1).normal(100, 5, (200, 200)).round().astype(np.uint8)) < 2


def test_the_line_of_a_preview_is_written_when_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "LINE_S", 0.0)
    levels = (300, 300, 300, 900, 900, 300)
    pictures = [CameraPicture.of(message(n, np.full((8, 8), level, np.uint16)), None) for n, level in enumerate(levels)]
    lines: list[str] = []
    watching = command.Watching(tmp_path / "now.png")
    watching.all(iter(pictures), 10, lines.append)
    assert [line.split()[1] for line in lines] == ["29%", "88%", "29%"]
    assert watching.seen == len(levels)
