"""Rendering against plain NumPy: the projector's light, the sensor's noise, the claim of exactness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from drivers.simulated import optics, sensor
from scanner.patterns import PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection
from tests.unit.simulated_bench import Bench

RESPONSE = (np.arange(256) / 255.0).astype(np.float32)


def exact_light(values: np.ndarray, position: np.ndarray, sigma: float) -> np.ndarray:
    """Light at any position of a line of pixels, by the sum over all of them."""
    x = position[:, None] - np.arange(len(values))[None, :]
    s = np.sqrt(2) * sigma
    return 0.5 * (erf((x + 0.5) / s) - erf((x - 0.5) / s)) @ values


@pytest.mark.parametrize("sigma", [0.3, 0.7, 2.0])
def test_line_of_light_is_the_pixel_square_blurred(sigma: float) -> None:
    values = np.random.default_rng(1).integers(0, 256, 64, dtype=np.uint8)
    line = optics.line_of_light(values, RESPONSE, sigma, "row")
    position = np.arange((64 + 2 * line.border) * line.steps) / line.steps - 0.5 - line.border
    expected = exact_light(values / 255.0, position, sigma)
    assert np.abs(line.light[: len(position)] - expected).max() < 2e-6


@pytest.mark.parametrize("sigma", [0.4, 0.7])
def test_grid_of_light_is_the_product_of_two_lines(sigma: float) -> None:
    generator = np.random.default_rng(2)
    rows, columns = generator.integers(0, 16, 24), generator.integers(0, 16, 30)
    image = (rows[:, None] * columns[None, :]).astype(np.uint8)
    grid = optics.grid_of_light(image, RESPONSE, sigma)
    begin = -0.5 - grid.border
    down = exact_light(rows / 1.0, np.arange((24 - 2 * begin - 1) * grid.steps) / grid.steps + begin, sigma)
    across = exact_light(columns / 255.0, np.arange((30 - 2 * begin - 1) * grid.steps) / grid.steps + begin, sigma)
    assert np.abs(grid.light[: len(down), : len(across)] - down[:, None] * across[None, :]).max() < 2e-6


def test_lookup_is_linear_between_the_steps() -> None:
    image = np.random.default_rng(3).integers(0, 256, (20, 30), dtype=np.uint8)
    grid = optics.grid_of_light(image, RESPONSE, 0.7)
    generator = np.random.default_rng(4)
    row = generator.uniform(-grid.border, 19.99 + grid.border, (7, 9)).astype(np.float32)
    column = generator.uniform(-grid.border, 29.99 + grid.border, (7, 9)).astype(np.float32)
    gain, floor = generator.random((2, 7, 9), dtype=np.float32)
    out = np.empty_like(row)
    optics.look_up(grid, row, column, gain, floor, out)
    u, v = column * 2 + grid.border * 2, row * 2 + grid.border * 2
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    a, b = u - j, v - i
    t = grid.light
    light = (1 - b) * ((1 - a) * t[i, j] + a * t[i, j + 1]) + b * ((1 - a) * t[i + 1, j] + a * t[i + 1, j + 1])
    assert np.abs(out - (light * gain + floor)).max() < 1e-5
    line = optics.line_of_light(image[:, 0], RESPONSE, 0.7, "row")
    optics.look_up(line, row, column, gain, floor, out)
    light = np.interp(row, np.arange(len(line.light)) / line.steps - line.border, line.light)
    assert np.abs(out - (light * gain + floor)).max() < 1e-5


@pytest.mark.parametrize("axis", ["row", "column"])
def test_images_that_are_flat_along_one_axis_are_recognised(axis: str) -> None:
    line = np.arange(12, dtype=np.uint8)
    image = np.repeat(line[:, None], 9, axis=1) if axis == "row" else np.repeat(line[None, :], 9, axis=0)
    assert optics.flat_axis(image) == axis
    image[3, 4] += 1
    assert optics.flat_axis(image) is None


@pytest.mark.parametrize(("period_px", "limit_px"), [(6.0, 0.003), (13.5, 0.001)])
@pytest.mark.parametrize("flat", [True, False])
def test_no_fringe_is_shifted_by_the_lookup(period_px: float, limit_px: float, flat: bool) -> None:
    """The phase looked up is that of the exact light, to 0.001 projector px at 13.5 px a period."""
    values = np.arange(216, dtype=np.uint8)
    image = np.repeat(values[:, None], 40, axis=1)
    row = np.linspace(60, 150, 5000, dtype=np.float32)[None, :]
    column, one, zero = np.full_like(row, 20.0), np.ones_like(row), np.zeros_like(row)
    out = np.empty_like(row)
    seen, exact = 0j, 0j
    for n in range(8):
        fringe = 0.5 + 0.48 * np.cos(2 * np.pi * (np.arange(256) / period_px - n / 8))
        response = fringe.astype(np.float32)
        light: optics.Light = optics.grid_of_light(image, response, 0.7)
        if flat:
            light = optics.line_of_light(values, response, 0.7, "row")
        optics.look_up(light, row, column, one, zero, out)
        turn = np.exp(2j * np.pi * n / 8)
        seen = seen + out[0].astype(np.float64) * turn
        exact = exact + exact_light(fringe[:216], row[0].astype(np.float64) - 0.5, 0.7) * turn
    error = np.angle(seen * np.conj(exact)) * period_px / (2 * np.pi)
    assert np.abs(error).max() < (0.0001 if flat else limit_px)


def test_sensor_blurs_and_quantises_as_numpy_does() -> None:
    """What falls beside the sensor is blurred onto it."""
    light = np.random.default_rng(5).random((46, 58), dtype=np.float32)
    own = light[3:-3, 4:-4]
    out = np.empty(own.shape, dtype=np.uint16)
    sensor.sense(light, sensor.blur_taps(0.7), 15000.0, 4095 / 15000, None, (0, 0), out, 4095)
    expected = gaussian_filter(light.astype(np.float64), 0.7, truncate=3 / 0.7 + 0.01)[3:-3, 4:-4] * 4095
    assert np.abs(out.astype(np.float64) - expected).max() <= 0.51
    sensor.sense(light * 2, sensor.blur_taps(0.0), 15000.0, 4095 / 15000, None, (0, 0), out, 4095)
    assert np.array_equal(out, np.minimum(np.floor(own.astype(np.float64) * 2 * 4095 + 0.5), 4095).astype(np.uint16))
    with pytest.raises(ValueError, match="does not reach"):
        sensor.sense(light[1:], sensor.blur_taps(0.7), 1.0, 1.0, None, (0, 0), out, 4095)


def test_noise_has_the_mean_and_variance_of_photons_and_readout() -> None:
    """60 frames: variance e + read^2 within 3 standard errors; frames, rows and columns are not correlated."""
    electrons, read = 4000.0, 50.0
    light = np.full((30, 2006), 1.0, dtype=np.float32)
    out = np.empty((24, 2000), dtype=np.uint16)
    frames = np.empty((60, 24, 2000))
    for n in range(60):
        sensor.sense(light, sensor.blur_taps(0.7), electrons, 4.0, read, (3, n), out, 65535)
        frames[n] = out / 4.0
    count = frames.size
    variance = electrons + read**2 + (1 / 4.0) ** 2 / 12
    assert frames.mean() == pytest.approx(electrons, abs=3 * np.sqrt(variance / count))
    assert frames.var() == pytest.approx(variance, rel=3 * np.sqrt(2 / count))
    deviations = (frames - electrons) / np.sqrt(variance)
    between_frames = (deviations[1:] * deviations[:-1]).mean(axis=(1, 2))
    between_rows = (deviations[:, 1:] * deviations[:, :-1]).mean(axis=(1, 2))
    between_columns = (deviations[..., 1:] * deviations[..., :-1]).mean()
    assert np.abs(between_frames).max() < 5 / np.sqrt(24 * 2000)
    assert np.abs(between_rows).max() < 5 / np.sqrt(23 * 2000)
    assert abs(between_columns) < 5 / np.sqrt(count)
    assert np.abs(deviations.mean(axis=0)).max() < 6 / np.sqrt(60)


def test_noise_is_the_same_for_the_same_seed_and_frame_only() -> None:
    light = np.full((14, 70), 0.5, dtype=np.float32)

    def frame(seed: int, number: int) -> np.ndarray:
        out = np.empty((8, 64), dtype=np.uint8)
        sensor.sense(light, sensor.blur_taps(0.7), 15000.0, 255 / 15000, 47.0, (seed, number), out, 255)
        return out

    assert np.array_equal(frame(1, 7), frame(1, 7))
    assert not np.array_equal(frame(1, 7), frame(1, 8))
    assert not np.array_equal(frame(1, 7), frame(2, 7))


def test_full_on_board_is_at_230_grey_levels() -> None:
    for device, top in (("quick/board?noise=false", 255), ("quick/board?noise=false&bits=12", 4095)):
        bench = Bench(device)
        (frame,) = bench.captured([np.full((240, 320), 255, dtype=np.uint8)])
        assert np.percentile(frame, 99) == pytest.approx(230 / 255 * top, abs=top / 255)


def decoded(frames: list[np.ndarray], pattern: PmpPattern, size: int) -> np.ndarray:
    """Projector coordinate by plain NumPy: phases by least squares, unwrapped from coarse to fine."""
    found: np.ndarray | None = None
    for s in pattern.sets():
        z = sum(frames[s.first + n] * np.exp(2j * np.pi * n / s.shifts) for n in range(s.shifts))
        period = size / s.frequency
        fine = np.angle(z) / (2 * np.pi) * period - 0.5
        found = (fine + 0.5) % period - 0.5 if found is None else fine + period * np.round((found - fine) / period)
    assert found is not None
    return found


@pytest.mark.parametrize("device", ["casey2011/board", "bench2026/board"])
def test_noise_free_decoding_gives_the_truth(device: str) -> None:
    """(1, 8, 64) x 8 without noise: the median error on the board is below 0.004 projector px, at its borders, too."""
    bench = Bench(f"{device}?noise=false&bits=12")
    c = bench.projector.capabilities
    axis = bench.camera.true_calibration().phase_axis
    pattern = PmpPattern(axes=(axis,))
    sequence = PatternSequence(ProjectorSize(c.width, c.height), pattern, precorrection=Precorrection(gamma=2.3))
    frames = bench.captured([sequence.image(i) for i in range(len(sequence))])
    truth = bench.camera.truth()
    expected = truth.rows if axis == "y" else truth.columns
    # A hundred and sixty thousand pixels, which tell of all of them; and the outermost lines and columns, of which
    # some see where the projected picture of bench2026 ends.
    for sample, wrong in ((lambda plane: plane[::3, ::3].ravel(), 1e-3), (outermost, 1e-2)):
        found = decoded([sample(frame) for frame in frames], pattern, sequence.projector.along(axis))
        error = (found - sample(expected))[sample(truth.lit)]
        assert np.median(np.abs(error)) < 0.004
        assert abs(np.median(error)) < 0.001
        assert (np.abs(error) > 0.5).mean() < wrong


def outermost(plane: np.ndarray) -> np.ndarray:
    return np.concatenate((plane[0], plane[-1], plane[1:-1, 0], plane[1:-1, -1]))
