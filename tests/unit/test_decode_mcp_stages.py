"""The MCP decoder's stages against plain forms: sums written out, every path enumerated, signals made by formula."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from scanner.decode.mcp import (
    carriers,
    dense,
    dense_lines,
    emissions,
    exponentials,
    hmm,
    linking,
    magnification,
    profiles,
    ranks,
    stripes,
    subpixel,
    tracks,
)
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.signals import Signals
from scanner.patterns import McpPattern, ProjectorSize

PROJECTOR = ProjectorSize(1152, 864)
OWN = PatternModel.of(McpPattern(), PROJECTOR)
PUBLISHED = PatternModel.of(
    McpPattern(carriers=(90.0, 106.0, 120.0, 132.0), codes=tuple(range(16)), levels="composite"), PROJECTOR
)


@pytest.mark.parametrize("model", [OWN, PUBLISHED], ids=["own", "published"])
def test_the_model_agrees_with_the_projected_image(model):
    pattern = (
        McpPattern()
        if model is OWN
        else McpPattern(carriers=(90.0, 106.0, 120.0, 132.0), codes=tuple(range(16)), levels="composite")
    )
    image = pattern.fringe(0, PROJECTOR)
    for stripe in range(model.stripes):
        line = image[round((stripe + 0.5) * model.pitch - 0.5)]
        assert line.mean() == pytest.approx(model.level[stripe], abs=1e-3)
        for i, carrier in enumerate(model.carriers):
            wave = np.exp(-2j * np.pi * carrier * np.arange(len(line)))
            amplitude = 2 * abs((line * wave).mean())
            assert amplitude == pytest.approx(model.ratio[stripe, i] * model.level[stripe], abs=1e-3)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_columns_are_averaged_by_fours(dtype):
    image = np.random.default_rng(0).integers(0, 255, (37, 23)).astype(dtype)
    expected = image[:, :20].reshape(37, 5, 4).mean(axis=2).T
    np.testing.assert_allclose(stripes.reduce_columns(image), expected, rtol=1e-6)


@pytest.mark.parametrize("model", [OWN, PUBLISHED], ids=["own", "published"])
@pytest.mark.parametrize("pitch", [8.0, 21.0, 37.0, 90.0])
def test_the_pitch_is_found_and_is_no_pair_of_stripes(model, pitch):
    rows = np.arange(900) / pitch + 3.3
    column = np.interp(rows % model.stripes, (np.arange(len(model.column)) + 0.5) / 16, model.column)
    reduced = np.tile(np.float32(20 + 100 * column), (16, 1))
    [(found, match)] = stripes.estimate_pitch(reduced, model)
    assert found == pytest.approx(pitch, rel=0.05)
    assert match > 0.5


def test_peaks_of_a_triangle_wave():
    y = np.arange(400)
    line = 10 + 80 * (1 - np.abs(2 * ((y - 7.25) / 40 % 1) - 1))
    reduced = np.tile(np.float32(line), (12, 1))
    peaks = stripes.find_peaks(reduced, 40.0, 16.0, 0.1)
    # The flank of a stripe beyond the border ends on the border row.
    assert (np.diff(peaks.start) == 11).all()
    assert peaks.y[0] == 0
    np.testing.assert_allclose(peaks.y[1:11], 27.25 + 40 * np.arange(10), atol=0.1)
    # Smoothing by a twelfth of a pitch takes .16 of the height at the top and as much at the valleys.
    assert ((peaks.height[1:11] > 55) & (peaks.height[1:11] < 80)).all()
    assert ((peaks.valley[1:11] > 10) & (peaks.valley[1:11] < 25)).all()
    chains = linking.link(peaks, 40.0)
    assert (chains.lengths == 12).all()
    assert sorted(chains.order) == list(range(132))
    fine = subpixel.refine(reduced, peaks, chains, np.tile(np.arange(11, dtype=np.int32), 12), 40.0)
    np.testing.assert_allclose(fine.y[1:11], 27.25 + 40 * np.arange(10), atol=0.03)
    np.testing.assert_array_equal(fine.whole, np.arange(132) % 11 > 0)


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_an_edge_of_print_beside_the_peak_moves_it_little(share):
    y = np.arange(400)
    light = 1 - np.abs(2 * ((y - 7.25) / 40 % 1) - 1)
    printed = np.where((y - 27.25) % 80 > 11, share, 1.0)  # from 11 px below each second peak to 29 px below the next
    reduced = np.tile(np.float32(10 + 80 * light * printed), (12, 1))
    peaks = stripes.find_peaks(reduced, 40.0, 16.0, 0.1)
    label = np.tile(np.arange(11, dtype=np.int32), 12)
    fine = subpixel.refine(reduced, peaks, linking.link(peaks, 40.0), label, 40.0)
    whole = np.flatnonzero(fine.whole[1:11]) + 1
    np.testing.assert_allclose(fine.y[whole], 27.25 + 40 * (whole - 1), atol=0.4)
    assert len(whole) >= 5


@pytest.mark.parametrize("end", ["top", "bottom"])
def test_a_stripe_that_leaves_the_image_is_followed_to_its_border(end):
    y, columns = np.arange(200), np.arange(45)
    at = 18.3 - 0.6 * columns  # leaves at column 30
    light = 1 - np.abs(2 * (((y[None, :] - at[:, None]) / 40 + 0.5) % 1) - 1)
    light = light if end == "top" else light[:, ::-1]
    at = at if end == "top" else 199 - at
    reduced = np.ascontiguousarray(10 + 80 * light, np.float32)
    peaks = stripes.find_peaks(reduced, 40.0, 16.0, 0.1)
    chains = linking.link(peaks, 40.0)
    first = peaks.start[:-1] if end == "top" else peaks.start[1:] - 1
    label = np.full(len(peaks), -1, np.int32)
    label[first] = 4
    fine = subpixel.refine(reduced, peaks, chains, label, 40.0)
    inside = (at > 0.3) & (at < 198.7) & (columns > 2)  # not where smoothing along it meets its image
    np.testing.assert_allclose(fine.y[first][inside], at[inside], atol=0.25)
    assert (fine.whole[first][inside] == 1).all()
    assert (fine.whole[first][(at < -0.3) | (at > 199.3)] == 0).all()
    near = inside & ((at < 2) | (at > 197))
    assert (fine.sigma[first][near] >= 0.2).all()


def test_a_slope_of_brightness_does_not_move_the_peak():
    y = np.arange(400)
    light = 1 - np.abs(2 * ((y - 7.25) / 40 % 1) - 1)
    reduced = np.tile(np.float32(10 + light * (60 + 0.5 * (y - 200))), (24, 1))
    peaks = stripes.find_peaks(reduced, 40.0, 16.0, 0.1)
    count = int(peaks.start[1])
    label = np.tile(np.arange(count, dtype=np.int32), 24)
    fine = subpixel.refine(reduced, peaks, linking.link(peaks, 40.0), label, 40.0)
    error = (fine.y - 27.25 + 20) % 40 - 20
    inside = (fine.y > 150) & (fine.y < 380)
    assert np.abs(error[inside]).max() < 0.12


def columns_case(seed, size=5, states=4):
    """Random evidence of one column, and every assignment of stripe or none to its peaks with its probability."""
    random = np.random.default_rng(seed)
    evidence = random.normal(0, 2, (size, states)).astype(np.float32)
    stray = random.normal(-1, 1, size).astype(np.float32)
    gap = np.concatenate(([0], random.integers(0, 2 * hmm.MAX_GAP, size - 1))).astype(np.int32)
    tables = hmm.transitions(states).astype(np.float64)
    total = {}
    for first in range(states):
        for choice in product([*range(states), None], repeat=size):
            state, weight = first, 1 / states
            for t, pick in enumerate(choice):
                if pick is None:
                    weight *= hmm.STRAY * np.exp(stray[t])
                    continue
                move = (1.0 if pick == state else 0.0) if t == 0 else tables[gap[t], state, pick]
                weight *= move * (1 - hmm.STRAY) * np.exp(evidence[t, pick])
                state = pick
            total[choice, first] = weight
    return evidence, stray, gap, total


@pytest.mark.parametrize("seed", range(3))
def test_forward_backward_is_the_sum_over_all_paths(seed):
    evidence, stray, gap, total = columns_case(seed)
    start = np.array([0, len(evidence)], np.int32)
    posterior, lost = hmm.smooth_columns(evidence, start, gap, hmm.transitions(4), stray)
    expected, none = np.zeros_like(evidence, np.float64), np.zeros(len(evidence))
    for (choice, _), weight in total.items():
        for t, pick in enumerate(choice):
            if pick is None:
                none[t] += weight
            else:
                expected[t, pick] += weight
    everything = sum(total.values())
    np.testing.assert_allclose(posterior, expected / everything, atol=3e-3)
    np.testing.assert_allclose(lost, none / everything, atol=3e-3)


def test_forward_backward_of_more_states_than_a_vector_has_lanes():
    random = np.random.default_rng(4)
    start, states = np.array([0, 7, 7, 12], np.int32), 40
    evidence, stray = random.normal(0, 1, (12, states)).astype(np.float32), random.normal(-2, 1, 12).astype(np.float32)
    gap = random.integers(0, 2 * hmm.MAX_GAP, 12).astype(np.int32)
    tables = hmm.transitions(states).astype(np.float64)
    posterior, lost = hmm.smooth_columns(evidence, start, gap, hmm.transitions(states), stray)
    likely, none = (1 - hmm.STRAY) * np.exp(evidence.astype(np.float64)), hmm.STRAY * np.exp(stray.astype(np.float64))
    for first, last in ((0, 7), (7, 12)):
        before = [np.full(states, 1 / states)]
        for t in range(first, last):
            moved = before[-1] if t == first else before[-1] @ tables[gap[t]]
            before.append(moved * likely[t] + before[-1] * none[t])
        after = np.ones(states)
        for t in range(last - 1, first - 1, -1):
            moved = before[t - first] if t == first else before[t - first] @ tables[gap[t]]
            right, wrong = moved * likely[t] * after, (before[t - first] * none[t] * after).sum()
            np.testing.assert_allclose(posterior[t], right / (right.sum() + wrong), atol=3e-3)
            assert lost[t] == pytest.approx(wrong / (right.sum() + wrong), abs=3e-3)
            after = tables[gap[t]] @ (likely[t] * after) + after * none[t]


@pytest.mark.parametrize("seed", range(5))
def test_viterbi_is_the_best_of_all_paths(seed):
    evidence, stray, gap, total = columns_case(seed)
    start = np.array([0, len(evidence)], np.int32)
    path = hmm.best_paths(evidence, start, gap, hmm.transitions(4), stray)
    best = max(total, key=lambda key: total[key])[0]
    assert [None if s < 0 else int(s) for s in path] == list(best)


def chain_of(count):
    return linking.Chains(
        np.arange(count, dtype=np.int32), np.array([0, count], np.int32), np.arange(count, dtype=np.int32)
    )


def test_votes_are_the_weighted_mean_of_the_neighbours():
    logs = np.random.default_rng(2).normal(size=(9, 3)).astype(np.float32)
    votes = linking.votes_along(logs, chain_of(9), 2.0, 1.5)
    weight = np.exp(-np.abs(np.arange(9)[:, None] - np.arange(9)[None, :]) / 2.0)
    np.fill_diagonal(weight, 0)
    expected = 1.5 * weight @ logs / np.maximum(weight.sum(axis=1), 1)[:, None]
    np.testing.assert_allclose(votes, expected, rtol=1e-4, atol=1e-5)


def test_the_path_along_a_chain_pays_for_a_change():
    logs = np.zeros((10, 2), np.float32)
    logs[:5, 0] = logs[5:, 1] = 2
    logs[2] = 0, 1
    assert list(linking.path_along(logs, chain_of(10), 6.0)) == [0] * 5 + [1] * 5
    assert set(linking.path_along(logs, chain_of(10), 100.0)) == {1}


@pytest.mark.parametrize("length", [400, 40])
def test_amplitudes_and_magnification_of_made_signals(length):
    scale, drift, count = 1.41, 0.04, 24
    column = np.tile(np.arange(length // 4, dtype=np.int32), count)
    number = np.repeat(np.arange(count), length // 4)
    start = (np.arange(count + 1) * (length // 4)).astype(np.int32)
    chains = linking.Chains(np.arange(len(column), dtype=np.int32), start, column)
    y = np.float32(20 + 40 * number)
    peaks = stripes.Peaks(np.zeros(2, np.int32), y, *(y * 0 + 1,) * 4, np.ones(len(y), np.uint8))
    each = tracks.single(peaks, chains)
    shape = (40 * count, length)
    own = scale * np.exp(drift * (y * 2 / shape[0] - 1))
    x = np.arange(length)
    light = np.empty((count, length), np.float32)
    for n in range(count):
        ratio = OWN.ratio[2 * (n % 16)] * (0.9, 0.8, 0.7, 0.6)
        phase = 2 * np.pi * OWN.carriers[:, None] * x / own[number == n][0] + n
        light[n] = 50 * (1 + 0.1 * x / length + (ratio[:, None] * np.cos(phase)).sum(axis=0))
    flat = light.ravel()
    size = magnification.window_px(OWN, scale)
    if length >= 2 * size:
        signals = Signals(flat, np.zeros(len(y), np.float32))
        search = carriers.search_carriers(signals, each, OWN, 1.38, shape)
        assert min(search.contrast) > 1.5
        field = magnification.fit_fields(flat, each, OWN, search, size, shape)[0] * search.scale
        np.testing.assert_allclose(field, own, rtol=0.006)
    seen = emissions.measure(flat, each, np.float32(own / scale), OWN, scale, size)
    expected = OWN.ratio[2 * (number % 16)] * (0.9, 0.8, 0.7, 0.6)
    assert np.abs(seen.ratio - expected).max() < 0.03
    assert np.median(seen.sigma) < 0.02


def test_dense_rows_keep_a_quadratic_and_stop_at_a_missing_stripe():
    columns, size, pitch, step = 6, 300, 40.0, 27.0
    stripe = np.array([0, 1, 2, 4, 5], np.int32)
    y = np.float32(30 + 40 * stripe + 0.8 * stripe**2)
    row = np.float32((stripe + 0.5) * step - 0.5)
    ones = np.ones(5 * columns, np.float32)
    knots = dense.Knots(
        np.arange(0, 5 * columns + 1, 5, dtype=np.int32),
        np.tile(y, columns),
        np.tile(row, columns),
        0.1 * ones,
        ones,
        90 * ones,
        80 * ones,
        np.tile(stripe, columns),
    )
    maps = dense.interpolate(knots, (size, 4 * columns), pitch, step)
    assert np.isnan(maps.rows[150:165]).all()
    assert (maps.confidence[150:165] == 0).all()
    inner = slice(int(y[0]), int(y[2]))
    at = (-40 + np.sqrt(1600 + 3.2 * (np.arange(size) - 30.0).clip(0))) / 1.6
    np.testing.assert_allclose(maps.rows[inner, 8], ((at + 0.5) * step - 0.5)[inner], atol=0.05)
    np.testing.assert_allclose(maps.albedo[inner], 90, rtol=1e-5)
    assert np.ptp(maps.rows[inner], axis=1).max() < 1e-3


def test_sigma_grows_between_stripes_where_the_surface_bends_or_steps():
    step, sigma = 27.0, 0.02

    def sigmas(y):
        count, columns = len(y), 6
        ones = np.ones(count * columns, np.float32)
        stripe = np.arange(count, dtype=np.int32)
        knots = dense.Knots(
            np.arange(0, count * columns + 1, count, dtype=np.int32),
            np.tile(np.float32(y), columns),
            np.tile(np.float32((stripe + 0.5) * step - 0.5), columns),
            np.float32(sigma) * ones,
            ones,
            90 * ones,
            80 * ones,
            np.tile(stripe, columns),
        )
        return dense.interpolate(knots, (320, 4 * columns), 40.0, step).sigma[:, 8]

    even = sigmas(30 + 40 * np.arange(7))
    np.testing.assert_allclose(even[75:225], sigma, rtol=0.01)
    assert even[20] > 1.9 * sigma  # beyond the last stripe
    curved = sigmas(30 + 36 * np.arange(7) + 0.7 * np.arange(7) ** 2)
    assert curved[130] < 1.1 * even[130], "a cubic follows an even bend, and so does the fit"
    waved = sigmas(30 + 40 * np.arange(7) + 2 * np.cos(2 * np.arange(7)))
    assert waved[130] > 3 * even[130]
    stepped = sigmas(np.array([30, 70, 110, 165, 205, 245, 285]))
    assert stepped[137] > 20 * sigma
    assert stepped[110] > 4 * sigma
    assert stepped[65] < 2 * sigma  # two stripes away


def drawn_plainly(columns, pieces, agree, shape):
    """`dense_lines.draw` by its formulas, column by column, pixel by pixel."""
    height, width = shape
    narrow = np.full((5, height, columns), np.nan)
    narrow[2] = 0
    for b, begin, end, f in zip(*pieces, strict=True):
        y = np.arange(begin, end)
        t = (y - f[0]) * f[1]
        u = 1 - t
        narrow[0, y, b] = f[2] + f[3] * t + t * u * (u * f[4] - t * f[5])
        narrow[1, y, b] = u * f[6] + t * f[7] + t * u * f[8]
        narrow[2, y, b] = f[9]
        narrow[3, y, b], narrow[4, y, b] = u * f[10] + t * f[11], u * f[12] + t * f[13]
    place = (np.arange(width) - 1.5) / 4
    left = np.clip(np.floor(place).astype(int), 0, columns - 2)
    near = np.clip(np.rint(place).astype(int), 0, columns - 1)
    inside = (place >= 0) & (place <= columns - 1)
    one_surface = np.abs(narrow[0][:, left + 1] - narrow[0][:, left]) < agree
    share = place - left
    between = narrow[:, :, left] * (1 - share) + narrow[:, :, left + 1] * share
    return np.where(inside & one_surface, between, narrow[:, :, near])


def test_maps_are_drawn_as_written_out_pixel_by_pixel():
    random = np.random.default_rng(7)
    columns, shape = 9, (70, 38)
    pieces = [(), (), (), ()]
    for b in range(columns):
        y = 0 if b % 2 else 11
        while y < 60:
            end = min(y + int(random.integers(0, 25)), shape[0])
            figures = np.concatenate(([y - 0.5, 0.05], random.uniform(0, 5, dense_lines.FIGURES - 2)))
            pieces = [(*had, new) for had, new in zip(pieces, (b, y, end, figures), strict=True)]
            y = end if random.random() < 0.6 else end + 9
    lists = tuple(np.asarray(part, np.float32 if k == 3 else np.int32) for k, part in enumerate(pieces))
    expected = drawn_plainly(columns, lists, 1.7, shape)
    maps = np.empty((5, *shape), np.float32)
    dense_lines.draw(columns, lists, 1.7, maps)
    np.testing.assert_allclose(maps, expected, rtol=1e-4, atol=1e-4)
    alone = np.empty((1, *shape), np.float32)
    dense_lines.draw(columns, lists, 1.7, alone)
    np.testing.assert_array_equal(alone[0], maps[0])
    assert 0.2 < np.isnan(expected[0]).mean() < 0.8


def test_rows_alone_are_those_of_all_maps_and_a_lower_run_has_the_say_where_two_overlap():
    # Stripe 5 is followed by 9 a third of a pitch below: what the first run's end reaches belongs to the second.
    y = np.array([20, 60, 73, 113], np.float32)
    row = np.array([100, 127, 235, 262], np.float32)
    even = np.full(8, np.float32(0.1))
    knots = dense.Knots(
        np.array([0, 4, 8], np.int32),
        np.tile(y, 2),
        np.tile(row, 2),
        *(even.copy() for _ in range(4)),
        np.tile(np.array([4, 5, 9, 10], np.int32), 2),
    )
    maps = dense.interpolate(knots, (140, 8), 40.0, 27.0)
    alone = np.empty((140, 8), np.float32)
    dense.rows_alone(knots, 40.0, 27.0, alone)
    np.testing.assert_array_equal(alone, maps.rows)
    line = maps.rows[:, 3]
    np.testing.assert_allclose(line[20:57], np.interp(np.arange(20, 57), y[:2], row[:2]), atol=1e-3)
    np.testing.assert_allclose(line[57:74], 235 - 27 / 40 * np.arange(16, -1, -1), atol=1e-3)


def test_exponentials_and_logarithms_are_right_to_two_roundings():
    x = np.concatenate([np.linspace(-86.9, 0, 700), -np.geomspace(1e-9, 1, 100)]).astype(np.float32)
    np.testing.assert_allclose([exponentials.exp_of(v) for v in x], np.exp(np.float64(x)), rtol=1.5e-7)
    y = np.concatenate([np.geomspace(1e-37, 1e37, 700), 1 + np.linspace(-0.4, 0.6, 301)]).astype(np.float32)
    np.testing.assert_allclose([exponentials.log_of(v) for v in y], np.log(np.float64(y)), rtol=1.5e-7, atol=1.5e-7)


@pytest.mark.parametrize("model", [OWN, PUBLISHED], ids=["own", "published"])
def test_likelihoods_are_those_of_rayleigh_and_rice(model):
    random = np.random.default_rng(2)
    count, channels = 40, model.channels
    ratio, noise = random.uniform(0, 0.9, (count, channels)), random.uniform(0.005, 0.3, (count, channels))
    seen = emissions.Amplitudes(np.float32(ratio), np.float32(noise), np.ones(count, np.float32))
    modulation, floor = np.float32([0.9, 0.8, 0.7, 0.6]), np.float32([0.01, 0.02, 0.03, 0.04])
    found, stray = emissions.log_likelihood(seen, model, modulation, floor)
    sigma = np.hypot(noise, floor)
    flat = 1 / (1.5 * model.ratio.max(axis=0) + 2.5 * sigma)
    np.testing.assert_allclose(stray, np.log(flat).sum(axis=1), rtol=1e-5)
    for s in range(model.stripes):
        mean = model.ratio[s] * modulation
        off = np.maximum(ratio / sigma, 0.02) / sigma * np.exp(-0.5 * (ratio / sigma) ** 2)
        wide = np.hypot(sigma, emissions.SPREAD * mean)
        on = 0.39894 / wide * np.exp(-0.5 * ((np.hypot(mean, sigma) - ratio) / wide) ** 2)
        density = (1 - emissions.OUTLIER) * np.where(mean == 0, off, on) + emissions.OUTLIER * flat
        dark = np.log(1e-4) if model.level[s] == 0 else 0
        np.testing.assert_allclose(found[:, s], np.log(density).sum(axis=1) + dark, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_ranks_are_numpy_s(count):
    values = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    shares = (0.0, 0.01, 0.37, 0.99, 1.0)
    np.testing.assert_allclose(ranks.quantiles(values, *shares), np.quantile(values, shares), rtol=1e-5, atol=1e-6)
    assert ranks.median(values) == pytest.approx(float(np.median(values)), rel=1e-6)


@pytest.mark.parametrize("count", [1, 5, 40, 97])
def test_sums_over_averaged_profiles_are_those_written_out(count):
    random, reach = np.random.default_rng(count), 6
    stride, pad = profiles.stride_of(count), profiles.PAD
    profile = np.full((2 * reach + 1, stride), np.nan, np.float32)
    usable, bend = np.full(stride, np.nan, np.float32), np.full(stride, np.nan, np.float32)
    here = slice(pad, pad + count)
    profile[:, here] = random.uniform(0, 50, (2 * reach + 1, count))
    usable[here], bend[here] = random.integers(1, reach + 1, count), random.uniform(-0.01, 0.01, count)
    used, sums = np.empty(stride, np.float32), np.empty((profiles.SUMS, stride), np.float32)
    profiles.add_up(profile.ravel(), usable, bend, count, stride, reach, used, sums.ravel())
    expected, least = np.zeros((profiles.SUMS, count)), np.zeros(count)
    for p in range(count):
        window = slice(pad + max(p - profiles.HALF_COLUMNS, 0), pad + min(p + profiles.HALF_COLUMNS, count - 1) + 1)
        mean, least[p] = np.float64(profile[:, window]).mean(axis=1), usable[window].min()
        for u in range(1, int(least[p])):
            even, odd = (mean[reach + u] + mean[reach - u]) / 2, (mean[reach + u] - mean[reach - u]) / 2
            beside = [mean[reach + v] + mean[reach - v] for v in (u - 1, u + 1)]
            shift, slope = (beside[0] - beside[1]) / 4, even * u
            odd -= bend[pad + p] * u * u * shift
            terms = (shift * shift, shift * slope, slope * slope, odd * shift, odd * slope, odd * odd)
            expected[:, p] += terms
    np.testing.assert_array_equal(used[here], least)
    np.testing.assert_allclose(sums[:, here], expected, rtol=1e-3, atol=0.02)
    kappa, worth, slope = (np.zeros(stride, np.float32) for _ in range(3))
    profiles.slopes(sums.ravel(), used, count, stride, kappa, worth, slope)
    ss, sv, vv, os, ov, _ = np.float64(sums[:, here])
    apart = (least >= 4) & (ss * vv - sv * sv > 1e-4 * ss * vv)
    determinant, square = np.where(apart, ss * vv - sv**2, 1), np.where(apart, ss, 1)
    k, w = apart * (ss * ov - sv * os) / determinant, apart * determinant / square
    for p in range(count):
        window = slice(max(p - profiles.SLOPE_COLUMNS, 0), p + profiles.SLOPE_COLUMNS + 1)
        if w[window].sum() == 0:
            assert slope[pad + p] == 0
            continue
        mean = np.average(k[window], weights=w[window])
        scatter = np.average((k[window] - mean) ** 2, weights=w[window])
        doubt = 0.25 * scatter / max(1, len(k[window]) / (2 * profiles.HALF_COLUMNS + 1))
        assert slope[pad + p] == pytest.approx(mean * mean**2 / (mean**2 + doubt), rel=0.02, abs=1e-5)
