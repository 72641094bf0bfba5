"""MCP before rigs that draw its image out of shape: rolled, diagonal, with pixels that are not square."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from scanner.decode import Decoded
from scanner.decode.mcp import local_field, locate, magnification
from scanner.decode.mcp.decoder import decode_image
from scanner.decode.mcp.model import PatternModel
from scanner.patterns import CameraFormat, McpPattern, ProjectorSize

PROJECTOR = ProjectorSize(640, 416)
CAMERA = CameraFormat(640, 480)
PATTERN = McpPattern(carriers=(49.0, 68.0, 92.0, 111.0))
PITCH = PATTERN.pitch_px(PROJECTOR)
MIDDLE = 319.5, 239.5

Array = NDArray[np.float64]
Mapping = Callable[[Array, Array], tuple[Array, Array]]


def rolled(degrees: float, zoom: float = 1.0) -> Mapping:
    """Projector columns and rows at camera pixels, turned about the middle."""
    c, s = np.cos(np.radians(degrees)) / zoom, np.sin(np.radians(degrees)) / zoom

    def at(x: Array, y: Array) -> tuple[Array, Array]:
        x, y = x - MIDDLE[0], y - MIDDLE[1]
        return c * x - s * y + 319.5, s * x + c * y + 207.5

    return at


def picture(at: Mapping) -> tuple[NDArray[np.uint8], Array]:
    """What the camera sees of PATTERN, and the row at each pixel."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    columns, rows = at(x, y)
    light = PATTERN.fringe(0, PROJECTOR)
    seen = cv2.remap(light, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    noise = np.random.default_rng(0).normal(0, 1.0, seen.shape)
    return np.clip(np.rint(180 * cv2.GaussianBlur(seen, (0, 0), 0.7) + 8 + noise), 0, 255).astype(np.uint8), rows


def shares(decoded: Decoded, rows: Array) -> tuple[float, float]:
    """Of all peaks the share that is right, and of all crossings of a stripe's middle the share that has one."""
    assert decoded.peaks is not None
    x, y = (np.rint(decoded.peaks[:, k]).astype(int) for k in (0, 1))
    right = np.abs(decoded.peaks[:, 2] - rows[y, x]) < PITCH / 2
    stripe = np.floor((rows + 0.5) / PITCH - 0.5)
    inside = (rows[1:] > 0) & (rows[1:] < PROJECTOR.height - 1)
    crossings = ((stripe[1:] != stripe[:-1]) & inside).sum()
    # One peak stands for a column of the decoder, four of the image.
    return float(right.mean()), float(right.sum() * 4 / crossings)


@pytest.mark.parametrize("degrees", [14.0, -19.0])
def test_stripes_that_a_rolled_projector_inclines_are_followed(degrees: float) -> None:
    image, rows = picture(rolled(degrees))
    right, recall = shares(decode_image(image, PATTERN, PROJECTOR, CAMERA), rows)
    assert right > 0.995
    assert recall > 0.85


def test_pixels_twice_as_wide_as_high_on_a_tilted_surface() -> None:
    # Carriers are seen .42 times as large as the stripes: beyond what is searched for square pixels.
    def at(x: Array, y: Array) -> tuple[Array, Array]:
        return (x - MIDDLE[0]) / 0.9 + 319.5, (y - MIDDLE[1]) / 2.15 + 207.5

    image, rows = picture(at)
    found = locate.locate(image, PatternModel.of(PATTERN, PROJECTOR, even=False), CAMERA, locate.Stages())
    assert found.search is not None
    assert found.search.scale == pytest.approx(0.9, rel=0.02)
    assert shares(decode_image(image, PATTERN, PROJECTOR, CAMERA), rows)[0] > 0.995


def test_carriers_that_a_diagonal_projector_draws_together() -> None:
    # A ridge that falls away along the stripes on both sides: magnification from .8 to 1.35.
    def at(x: Array, y: Array) -> tuple[Array, Array]:
        u = (x - MIDDLE[0]) / 320
        columns = 319.5 + 320 * (u + 0.1 * np.sin(2.2 * u) ** 2)
        return columns, y / 1.05 - 10 + 0.12 * (x - MIDDLE[0])

    image, rows = picture(at)
    right, recall = shares(decode_image(image, PATTERN, PROJECTOR, CAMERA), rows)
    assert right > 0.99
    assert recall > 0.8


def test_the_smooth_field_stands_where_windows_keep_to_it() -> None:
    image, _ = picture(rolled(0.0))
    found = locate.locate(image, PatternModel.of(PATTERN, PROJECTOR, even=False), CAMERA, locate.Stages())
    _, _, tracks, signals, search = found.parts()
    model = PatternModel.of(PATTERN, PROJECTOR, even=False)
    size = magnification.window_px(model, search.scale)
    fields = magnification.fit_fields(signals.light, tracks, model, search, size, (480, 640))
    assert len(fields) == 1
    assert np.abs(fields[0] * search.scale - 1).max() < 0.02


def test_share_explained_is_that_of_plain_least_squares() -> None:
    size, lowest, count = 48, -3, 7
    carriers = (0.08, 0.11, 0.16)
    light = np.random.default_rng(1).normal(30, 8, 200).astype(np.float32)
    starts, first = np.array([0, 17, 90], np.int32), np.array([0, 2, 1], np.int32)
    ground, waves = local_field._orthonormal(carriers, lowest, count, size)
    energy, share = np.zeros(3, np.float32), np.zeros((3, 4), np.float32)
    window = local_field._window(size)
    local_field._explain(light, starts, first, window.astype(np.float32), ground, waves, energy, share)
    t = np.arange(size) - (size - 1) / 2
    root, flat = np.sqrt(window), np.vander(t / size, 3)

    def left(design: Array, piece: Array) -> float:
        solution = np.linalg.lstsq(design * root[:, None], piece * root, rcond=None)[0]
        return float((((piece - design @ solution) * root) ** 2).sum())

    for n in range(3):
        piece = light[starts[n] : starts[n] + size].astype(np.float64)
        whole = left(flat, piece)
        assert energy[n] == pytest.approx(whole / np.average(piece, weights=window) ** 2, rel=1e-3)
        for j in range(4):
            phase = 2 * np.pi * t[:, None] * np.array(carriers) / (1 + (lowest + first[n] + j) * local_field.STEP)
            design = np.concatenate([flat, np.cos(phase), np.sin(phase)], axis=1)
            assert share[n, j] == pytest.approx(1 - left(design, piece) / whole, abs=2e-3)
