"""Stripes that print breaks up: their pieces joined, and their light without the print."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scanner.decode.mcp import linking, signals, stripes, tracks

PITCH, LONG = 40.0, 17


def chained(pieces, valley=10.0, height=80.0):
    """Peaks and chains of pieces (first column, heights), in the order that `linking.link` gives them."""
    at = sorted((first + i, y, n) for n, (first, line) in enumerate(pieces) for i, y in enumerate(line))
    column, y, piece = (np.array(part) for part in zip(*at, strict=True))
    start = np.searchsorted(column, np.arange(column.max() + 2)).astype(np.int32)
    figures = (np.full(len(y), value, np.float32) for value in (height, valley, 0, 0))
    peaks = stripes.Peaks(start, y.astype(np.float32), *figures, np.ones(len(y), np.uint8))
    heads = sorted({n: k for k, n in reversed(list(enumerate(piece)))}.items(), key=lambda item: item[1])
    order = np.concatenate([np.flatnonzero(piece == n) for n, _ in heads]).astype(np.int32)
    lengths = [len(pieces[n][1]) for n, _ in heads]
    return peaks, linking.Chains(order, np.cumsum([0, *lengths]).astype(np.int32), column.astype(np.int32))


def test_pieces_up_and_down_over_a_hole_become_one_line():
    pieces = [(8 * n + 2 * (n > 2), [100 + 4 * (-1) ** n] * 8) for n in range(6)]
    peaks, chains = chained(pieces)
    found = tracks.join(peaks, chains, PITCH, LONG)
    assert list(found.joined) == [True]
    assert list(found.chains.column[found.chains.order]) == list(range(50))
    line = found.y[found.chains.order]
    np.testing.assert_allclose(line[8:-8], 100, atol=4)
    assert np.abs(np.diff(line)).max() < 1.5  # a box of eleven columns over steps of eight
    assert (found.place == np.arange(48)).all()
    assert found.broken.all()
    assert sorted(found.chains.order) == list(range(50))
    assert list(found.links.order) == list(chains.order)
    np.testing.assert_allclose(found.ambient, 10 / (10 + 0.58 * 80), rtol=1e-5)
    assert (found.valley == 0).all()


def test_two_peaks_in_one_column_are_read_at_one_place():
    oblique = np.linspace(10, -10, 10)
    peaks, chains = chained([(8 * n, 100 + oblique) for n in range(5)])
    found = tracks.join(peaks, chains, PITCH, LONG)
    assert list(found.joined) == [True]
    assert list(found.chains.column[found.chains.order]) == list(range(42))
    doubled = np.flatnonzero(found.place != np.arange(50))
    assert len(doubled) == 8
    assert (chains.column[found.place[doubled]] == chains.column[doubled]).all()
    assert (np.diff(chains.column[found.links.order]) >= 0).all()
    assert np.abs(found.y[found.chains.order][6:-6] - 100).max() < 4


def test_a_short_piece_beside_a_track_belongs_to_it():
    pieces = [(8 * n, [100 + 4 * (-1) ** n] * 8) for n in range(5)]
    peaks, chains = chained([*pieces, (9, [114, 115, 116]), (20, [128, 128])])
    found = tracks.join(peaks, chains, PITCH, LONG)
    assert list(found.joined) == [False, True]
    beside = np.flatnonzero((peaks.y > 110) & (peaks.y < 120))
    assert found.broken[beside].all()
    assert (chains.column[found.place[beside]] == chains.column[beside]).all()
    assert (found.place[beside] != beside).all()
    assert not found.broken[peaks.y > 120].any()  # more than half way to the next stripe


@pytest.mark.parametrize(
    "pieces",
    [
        [(0, [100.0] * 40), (40, [105.0] * 40)],  # long ones
        [(8 * n, [100 + 14 * (n % 2)] * 8) for n in range(6)],  # steps of a third of a pitch
        [(0, [100.0] * 8), (8, [104.0] * 8)],  # no more than a window all together
        [(14 * n, [100 + 4 * (-1) ** n] * 8) for n in range(6)],  # holes of six columns
    ],
    ids=["long", "far", "few", "apart"],
)
def test_what_may_be_another_stripe_is_not_joined(pieces):
    peaks, chains = chained(pieces)
    found = tracks.join(peaks, chains, PITCH, LONG)
    assert found.chains is chains
    assert not found.joined.any()


def test_no_peaks_make_no_tracks():
    nothing = np.zeros(0, np.float32)
    peaks = stripes.Peaks(np.zeros(5, np.int32), *(nothing,) * 5, np.zeros(0, np.uint8))
    assert len(tracks.join(peaks, linking.link(peaks, PITCH), PITCH, LONG).y) == 0


def test_light_without_print_is_what_the_formula_says():
    """Printed cells of .2 and 1, ambient light of .3 of all: the carrier is left as it was projected."""
    x = np.arange(400)
    printed = cv2.GaussianBlur(np.where(x // 60 % 2, 1.0, 0.2)[None], (0, 0), 2)[0]
    pattern = 1 + 0.25 * np.cos(2 * np.pi * x / 9)
    total = np.float32(printed * (0.3 + 0.7 * pattern) * 120)
    weights = np.exp(-0.5 * (np.arange(-14, 15) / 5.6) ** 2).astype(np.float32)
    light = np.concatenate((total, total))
    joined, ambient = np.array([False, True]), np.float32([0.3, 0.3])
    signals._flatten(light, np.array([0, 100, 200], np.int32), joined, ambient, weights)
    np.testing.assert_array_equal(light[:400], total)
    mean = np.convolve(total, weights, "same") / np.convolve(np.ones(400), weights, "same")
    np.testing.assert_allclose(light[400:], 1 + (total / mean - 1) / 0.7, rtol=1e-4, atol=1e-5)
    far = (np.abs((x + 30) % 60 - 30) > 16) & (x < 380)  # beyond the means' reach from an edge, and from the end
    np.testing.assert_allclose(light[400:][far], pattern[far], atol=0.02)


def test_between_two_sites_of_a_joined_track_one_decided_is_enough():
    column = np.arange(7, dtype=np.int32)
    chains = linking.Chains(column, np.array([0, 7], np.int32), column)
    sites = linking.Sites(column[::2], np.arange(5, dtype=np.int32), chains)
    label, sure = np.array([3, -1, 3, 4], np.int32), np.float32([0.9, 0, 0.95, 0.99])
    for joined, expected in ((False, [3, -1, -1, -1, 3, -1, 4]), (True, [3, 3, -1, 3, 3, -1, 4])):
        every, confidence = linking.between_sites(label, sure, sites, chains, np.array([joined]))
        assert list(every) == expected
        assert (confidence[[1, 3]] == ([np.float32(0.9), np.float32(0.95)] if joined else [0, 0])).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_light_along_a_track_is_the_mean_over_its_rows_above_the_valleys(dtype):
    random = np.random.default_rng(6)
    image = random.integers(0, 250, (60, 48)).astype(dtype)
    image[28:31, 20:23] = 255  # clipped
    y = np.float32([20, 20.2, 20.1, 22.9, 25.4, 29, 29.2, 29.1, 29.3, 40, 57.5, 59])
    valley = random.uniform(0, 9, len(y)).astype(np.float32)
    column = np.arange(len(y), dtype=np.int32)
    each = linking.Chains(column, np.array([0, len(y)], np.int32), column)
    peaks = stripes.Peaks(np.arange(len(y) + 1, dtype=np.int32), y, y, valley, y, y, np.ones(len(y), np.uint8))
    found = signals.signals_along(image, tracks.single(peaks, each), 18.0, 8.0, 255)
    place = np.clip((np.arange(image.shape[1]) - 1.5) / 4, 0, len(y) - 1)
    high = np.zeros(len(y))
    for x, (row, base) in enumerate(zip(np.interp(place, column, y), np.interp(place, column, valley), strict=True)):
        middle = int(np.floor(row + 0.5))
        seen = image[max(middle - 3, 0) : middle + 4, x]
        assert found.light[x] == pytest.approx(seen.mean() - base, abs=1e-3)
        high[x // 4] += (seen == 255).mean() / 4
    np.testing.assert_allclose(found.clipped, high, atol=1e-6)
    assert high.max() > 0.2
