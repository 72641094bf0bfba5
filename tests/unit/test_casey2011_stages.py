"""The stages of the reference MCP decoder, each against formulas and plain forms; the whole: test_decode_casey2011."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from scanner.decode.mcp.casey2011 import (
    carrier_search,
    channels,
    growth,
    hidden_markov,
    inclination,
    refusals,
    stripe_detection,
)
from scanner.decode.mcp.casey2011.stripe_detection import Peaks
from scanner.errors import DecodeError


def peaks_of(image):
    """Peaks of a binary image."""
    column, y = np.nonzero(np.asarray(image).T)
    start = np.searchsorted(column, np.arange(np.shape(image)[1] + 1))
    return Peaks(start.astype(np.int32), y.astype(np.int32), column.astype(np.int32))


def triangles(height, wavelength, width=40, level=100.0):
    t = (np.arange(height) + 0.5) / wavelength % 1
    return np.repeat((level * (1 - np.abs(2 * t - 1)))[:, None], width, axis=1).astype(np.float32)


# --- 4.1 ----------------------------------------------------------------------------------------------------------


def test_the_filter_averages_one_wavelength_without_its_middle():
    grey = np.random.default_rng(0).uniform(0, 200, (40, 3)).astype(np.float32)
    enhanced = stripe_detection.enhance(grey, 7.0)
    padded = np.pad(grey, ((3, 3), (0, 0)), mode="reflect")
    for y in range(40):
        window = np.delete(padded[y : y + 7], 3, axis=0)
        np.testing.assert_allclose(enhanced[y], grey[y] - window.mean(axis=0), atol=1e-3)


@pytest.mark.parametrize("wavelength", [13.0, 20.0, 32.0])
def test_the_second_pass_finds_the_stripes_whatever_the_first_assumes(wavelength):
    image = np.rint(20 + triangles(416, wavelength)).astype(np.uint8)
    found = stripe_detection.detect(image, stripes=32, weakest=0.125)
    assert 416 / found.wavelength == pytest.approx(416 / wavelength, abs=0.6)
    middle = (np.arange(np.ceil(416 / wavelength)) + 0.5) * wavelength - 0.5
    seen = found.peaks.y[found.peaks.column == 20]
    distance = np.abs(seen[:, None] - middle).min(axis=1)
    assert len(seen) >= len(middle) - 3
    assert distance.max() <= 0.5


def test_the_dark_has_no_peaks_and_a_clipped_stripe_has_its_middle():
    image = np.clip(triangles(320, 32.0, level=400.0), 0, 255)
    image[:, 20:] *= 0.02
    image = np.rint(image).astype(np.uint8)
    found = stripe_detection.detect(image, stripes=10, weakest=0.125)
    inner = (found.peaks.column > 4) & (found.peaks.column < 16)
    assert inner.any()
    assert np.abs((found.peaks.y[inner] + 0.5) % 32 - 16).max() <= 1
    assert (found.peaks.column < 25).all()


# --- 4.2 ----------------------------------------------------------------------------------------------------------


def test_the_slope_of_a_stripe_is_that_of_its_peaks():
    image = np.zeros((120, 100), np.uint8)
    x = np.arange(100)
    for first, slope in ((20, 0.0), (40, 0.3), (110, -0.3)):
        image[np.rint(first + slope * x).astype(int), x] = 1
    peaks = peaks_of(image)
    slope = inclination.slopes(peaks, 12.0)
    inside = (peaks.column > 12) & (peaks.column < 88)
    level = inside & (peaks.y == 20)
    np.testing.assert_allclose(slope[level], 0, atol=1e-6)
    rising = inside & (np.abs(peaks.y - (40 + 0.3 * peaks.column)) < 1) & (peaks.column < 50)
    np.testing.assert_allclose(slope[rising], 0.3, atol=0.04)


def test_segments_are_turned_level_and_back():
    y, x = np.mgrid[:200, :240]
    slope = 0.25
    image = np.zeros((200, 240), np.uint8)
    image[np.rint(60 + slope * np.arange(240)).astype(int), np.arange(240)] = 1
    peaks = peaks_of(image)
    parts = inclination.segments(peaks, np.full(240, slope, np.float32), 0.1, 12.0, image.shape)
    assert [p.name for p in parts] == ["negligible", "positive"]
    assert parts[1].slope == pytest.approx(slope)
    assert (inclination.segment_of(parts, np.full(240, slope, np.float32), 0.1) == 1).all()
    stripes = np.cos(2 * np.pi * (y - slope * x) / 24).astype(np.float32)
    level = inclination.turned_level(stripes, parts[1])
    assert inclination.level_mask(parts[1])[94:105, 60:180].all()
    middle = level[94:105, 60:180]
    assert np.ptp(middle, axis=1).max() < 0.25
    back = inclination.turned_back((level > 0).astype(np.uint8), parts[1])
    kept = parts[1].mask[40:160, 40:200] > 0
    assert (back[40:160, 40:200] == (stripes[40:160, 40:200] > 0))[kept].mean() > 0.97


# --- 4.3 ----------------------------------------------------------------------------------------------------------


def test_the_spectrum_is_the_average_of_four_quadrants():
    image = np.random.default_rng(1).uniform(0, 1, (24, 32)).astype(np.float32)
    full = np.abs(np.fft.fft2((image - image.mean()) * np.hanning(32))) ** 2
    want = np.empty((5, 17))
    for v, u in np.ndindex(want.shape):
        want[v, u] = np.mean([full[v, u], full[-v, u], full[v, -u], full[-v, -u]])
    np.testing.assert_allclose(carrier_search.folded_psd(image, 6.0), want, rtol=1e-3, atol=1e-4)


def test_analysis_by_synthesis_finds_the_bands_and_their_widths():
    bins = np.arange(400)
    centres, sigmas, heights = (78, 92, 104, 118), (3.0, 3.5, 3.0, 4.0), (9.0, 5.0, 7.0, 6.0)
    A = 200 * np.exp(-(bins**2) / 200) + 0.05
    for centre, sigma, height in zip(centres, sigmas, heights, strict=True):
        A = A + height * np.exp(-((bins - centre) ** 2) / (2 * sigma**2))
    expected = np.array(centres) * 1.03 / 798
    for near in (False, True):
        found = carrier_search.search(np.float32(A[None, :] / 4), expected, 798, near)
        assert found.complete
        np.testing.assert_allclose(found.frequency * 798, centres, atol=1)
        # The search smooths A by one bin.
        np.testing.assert_allclose(found.sigma * 798, np.hypot(sigmas, 1), rtol=0.15)
        np.testing.assert_allclose(found.C, found.A - found.B)
        assert found.contrast > 2


def test_prior_knowledge_is_all_carriers_times_one_factor():
    lines = np.array([80.0, 100.0, 125.0, 140.0])
    A = 0.01 + np.exp(-((np.arange(300) - 1.12 * lines[:, None]) ** 2) / 18).sum(axis=0)
    assert carrier_search.common_factor(A, lines) == pytest.approx(1.12, abs=0.01)
    # Texture outshines the weakest carrier: only the prior tells which band is none.
    textured = A - 0.7 * np.exp(-((np.arange(300) - 1.12 * 125) ** 2) / 18) + np.exp(-((np.arange(300) - 122) ** 2) / 8)
    found = carrier_search.search(np.float32(textured[None, :]), lines / 598, 598, near=True)
    np.testing.assert_allclose(found.frequency * 598, 1.12 * lines, atol=1.5)


def test_noise_has_no_bands():
    noise = np.random.default_rng(2).normal(0, 1, (256, 400)).astype(np.float32)
    folded = carrier_search.folded_psd(noise, 16.0)
    assert carrier_search.search(folded, np.array([0.1, 0.125, 0.15, 0.175]), 400).contrast < 2


def test_the_second_derivative_is_zero_one_sigma_from_the_middle():
    A = np.exp(-((np.arange(101) - 50.0) ** 2) / (2 * 6.0**2))
    below, above = carrier_search.zeros_about(carrier_search.second_derivative(A), 50)
    assert (below, above) == (pytest.approx(44, abs=0.15), pytest.approx(56, abs=0.15))


# --- 4.4, 4.5 -----------------------------------------------------------------------------------------------------


def test_a_channel_is_a_gaussian_band_on_its_carrier():
    image = np.random.default_rng(3).uniform(0, 1, (30, 64)).astype(np.float32)
    isolated = channels.isolate(carrier_search.spectrum(image), 0.25, 0.02, 8.0, image.shape)
    fx, fy = np.fft.fftfreq(64), np.fft.fftfreq(30)
    band = np.exp(-((np.abs(fx) - 0.25) ** 2) / (2 * 0.02**2)) * (np.abs(np.abs(fx) - 0.25) <= 0.06 + 1 / 64)
    filtered = np.fft.fft2(image - image.mean()) * band * np.exp(-((fy[:, None] * 8) ** 2) / 2)
    np.testing.assert_allclose(isolated, np.fft.ifft2(filtered).real, atol=2e-4)


def test_two_sigma_spares_peaks_down_to_half_of_the_highest():
    # Eq. 5.49-5.51: 8 of 32 regions active, half of them of height .6776, the others 1.322.
    line = np.concatenate(
        [np.concatenate([h * triangles(400, 400.0, 1, 1.0).ravel(), np.zeros(1200)]) for h in [0.6776, 1.322] * 4]
    )
    threshold = channels.two_sigma(line.astype(np.float32)[None, :], np.ones((1, len(line)), np.uint8))
    assert threshold == pytest.approx(0.6776, abs=0.002)


def test_the_carriers_zero_crossings_are_closed():
    x = np.arange(600)
    channel = np.where((x > 200) & (x < 300), np.cos(2 * np.pi * 0.08 * x), 0).astype(np.float32)[None, :]
    bits = channels.binarize(channel, 0.08, np.ones_like(channel, np.uint8))
    assert bits[0, 205:295].all()
    assert not bits[0, :190].any()
    assert not bits[0, 310:].any()


def test_code_words_and_miss_rates():
    bits = [np.zeros((4, 5), np.uint8) for _ in range(3)]
    bits[0][1, 2] = bits[2][1, 2] = bits[1][3, 4] = 1
    word = channels.code_words(bits, np.array([1, 3, 0]), np.array([2, 4, 0]))
    assert word.tolist() == [5, 2, 0]
    word = np.array([1] * 30 + [0] * 70, np.int32)
    np.testing.assert_allclose(channels.miss_rates(word, np.array([0.4, 0.5])), [0.25, 0.5])


# --- 5.2, 5.3 -----------------------------------------------------------------------------------------------------

SYMBOLS = np.array([1, 3, 2], np.int32)
FALSE, MISS = np.array([0.159, 0.1]), np.array([0.2, 0.3])


def test_the_emission_of_the_dissertations_example():
    # Eq. 6.6, 6.7: {1, 1, 0, 1} sent, {0, 0, 1, 1} received; channel 1 is the first, here bit 0.
    false, miss = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.11, 0.12, 0.13, 0.14])
    table = hidden_markov.emission_matrix(np.array([0b1011], np.int32), false, miss)
    assert table[0, 0b1100] == pytest.approx(0.11 * 0.12 * 0.3 * (1 - 0.14))
    np.testing.assert_allclose(table.sum(axis=1), 1)


def test_transitions_go_forwards_and_fall_with_every_symbol_skipped():
    n = 5
    table = hidden_markov.transition_matrix(n, error=0.05, skip=3.0)
    np.testing.assert_allclose(table.sum(axis=1), 1)
    for i in range(n):
        assert (table[i, : i + 1] == 0).all()
        assert table[i, n + i + 1] > 0
        assert (table[i, n : n + i + 1] == 0).all()
        np.testing.assert_allclose(table[i], table[n + i + 1])
    assert table[0, 1] / table[0, 2] == pytest.approx(3)
    assert table[0, n + 1] == pytest.approx(0.05)
    start = hidden_markov.start_matrix(n)
    assert start[: n + 1].tolist() == pytest.approx([1 / 6] * 6)
    assert (start[n + 1 :] == 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_viterbi_and_posteriors_agree_with_enumeration(seed):
    rng = np.random.default_rng(seed)
    word = rng.integers(0, 4, 9).astype(np.int32)
    start = np.array([0, 5, 5, 9], np.int32)
    known = hidden_markov.model(SYMBOLS, FALSE, MISS)
    path = hidden_markov.best_paths(word, start, known)
    sure = hidden_markov.posteriors(word, start, path, known)
    assert known.symbols == 3
    for begin, end in itertools.pairwise(start):
        at = [p for p in range(begin, end) if word[p] > 0]
        if not at:
            continue
        chances = {}
        for states in itertools.product(range(7), repeat=len(at)):
            log = known.start[states[0]] + sum(known.step[a, b] for a, b in itertools.pairwise(states))
            chances[states] = np.exp(log + sum(known.emission[s, word[p]] for s, p in zip(states, at, strict=True)))
        best = max(chances, key=lambda states: chances[states])
        assert [path[p] for p in at] == [s + 1 if s < 3 else 0 for s in best]
        total = sum(chances.values())
        for k, p in enumerate(at):
            if path[p]:
                share = sum(c for states, c in chances.items() if states[k] == path[p] - 1) / total
                assert sure[p] == pytest.approx(share, rel=1e-4)
    assert (path[word == 0] == 0).all()


# --- 5.4, 2.1 -----------------------------------------------------------------------------------------------------


def test_the_mode_of_a_window_ignores_zeros():
    rng = np.random.default_rng(4)
    image = rng.random((60, 40)) < 0.06
    peaks = peaks_of(image)
    label = rng.integers(0, 4, len(peaks.y)).astype(np.int32)
    out = growth.modal_filter(label, peaks, 8.0)
    for p in range(len(label)):
        near = (np.abs(peaks.column - peaks.column[p]) <= 8) & (np.abs(peaks.y - peaks.y[p]) <= 4) & (label > 0)
        votes = np.bincount(label[near], minlength=4)
        if label[p] == 0:
            assert out[p] == 0
        else:
            assert votes[out[p]] == votes.max()
            assert out[p] == label[p] or votes[label[p]] < votes.max()


def line_of_peaks(width=120, rows=(20,), height=60):
    image = np.zeros((height, width), np.uint8)
    image[list(rows)] = 1
    return peaks_of(image), image


def test_short_pieces_go_and_long_ones_stay_though_broken():
    peaks, image = line_of_peaks()
    label = np.zeros(120, np.int32)
    label[10:20], label[40:80] = 2, 3
    label[55:60] = 0
    kept = growth.eliminate_blobs(label, peaks, image.shape, 12.0, gap=7, width=25)
    assert (kept[10:20] == 0).all()
    assert (kept[40:80] == label[40:80]).all()


def test_growth_follows_regions_and_leaves_what_both_passes_contest():
    peaks, image = line_of_peaks(rows=(20, 40))
    upper, lower = peaks.y == 20, peaks.y == 40
    at = peaks.column
    image[20, 50:54] = 0
    peaks = peaks_of(image)
    upper, lower, at = peaks.y == 20, peaks.y == 40, peaks.column
    region = np.zeros_like(image)
    region[17:24] = region[37:44] = 1
    label = np.zeros(len(at), np.int32)
    label[upper & (at == 10)] = 5
    label[lower & (at == 5)] = 6
    label[lower & (at == 100)] = 7
    grown, _mask = growth.grow(label, peaks, region, 12.0)
    assert (grown[upper] == 5).all()
    assert (grown[lower & (at == 50)] == 0).all()


def test_unmodulated_stripes_minima_and_mid_levels():
    image = triangles(96, 24.0, width=3)
    peaks = peaks_of((image == image.max()) & (np.arange(96) % 24 == 12)[:, None])
    stripe = np.array([4, -1, 6, -1] * 3, np.int32)
    sure = np.array([0.9, 0, 0.7, 0] * 3, np.float32)
    light = image[peaks.y, peaks.column]
    filled, confidence = growth.name_unmodulated(stripe, sure, peaks, light)
    assert filled.tolist() == [4, 5, 6, -1] * 3
    assert confidence[1] == np.float32(0.7)
    marks = growth.name_2x_4x(image, filled, confidence, peaks)
    first = marks.x == 0
    assert sorted(marks.index[first]) == [4, 4.25, 4.5, 4.75, 5, 5.25, 5.5, 5.75, 6]
    np.testing.assert_allclose(marks.y[first], (marks.index[first] - 4 + 0.5) * 24 - 0.5, atol=1)


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [3, 7, 15, 31])
def test_shuffled_orders_leave_little_in_order(count):
    symbols = np.random.default_rng(1).permutation(np.arange(1, count + 1)).astype(np.int32)
    orders = refusals.shuffled_orders(symbols)
    assert (orders[0] == symbols[::-1]).all()
    assert len(orders) == (1 if count == 3 else refusals.SHUFFLES)
    place = {int(s): k for k, s in enumerate(symbols)}
    for order in orders:
        assert sorted(order) == sorted(symbols)
        at = [place[int(s)] for s in order]
        rises = [1] * count
        for k in range(count):
            rises[k] = 1 + max((rises[j] for j in range(k) if at[j] < at[k]), default=0)
        assert max(rises) == refusals.longest_rise(np.array(at)) <= max(1, count // 3)


def test_the_described_order_has_to_fit_better_than_shuffled_ones():
    symbols = np.arange(1, 16, dtype=np.int32)
    rates = np.full(4, 0.159), np.full(4, 0.2)
    rng = np.random.default_rng(0)
    columns = 160
    peaks = Peaks(
        np.arange(0, 15 * columns + 1, 15, dtype=np.int32),
        np.tile(np.arange(15, dtype=np.int32), columns),
        np.repeat(np.arange(columns, dtype=np.int32), 15),
    )
    for clear in (0.95, 0.6):
        word = np.where(rng.random(15 * columns) < clear, np.tile(symbols, columns), rng.integers(0, 16, 15 * columns))
        known = hidden_markov.model(symbols, *rates)
        word = word.astype(np.int32)
        agreement = hidden_markov.fitting(word, hidden_markov.best_paths(word, peaks.start, known), symbols)
        assert agreement > clear - 0.1
        assert refusals.refuse_order(agreement, word, peaks, symbols, rates) < agreement - refusals.MARGIN
        order = rng.permutation(symbols)
        path = hidden_markov.best_paths(word, peaks.start, hidden_markov.model(order, *rates))
        with pytest.raises(DecodeError, match="contradict the description"):
            refusals.refuse_order(hidden_markov.fitting(word, path, order), word, peaks, order, rates)
