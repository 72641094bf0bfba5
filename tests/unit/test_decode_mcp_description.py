"""Is the pattern the one described: the search for its carriers, and code words that stand in one another's places."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from scanner.decode.mcp import carriers, decision, description, emissions, hmm, linking, stripes, tracks
from scanner.decode.mcp.decoder import decode_image
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.signals import Signals
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, ProjectorSize

PROJECTOR = ProjectorSize(1152, 864)
CAMERA = CameraFormat(696, 520)
OWN = PatternModel.of(McpPattern(), PROJECTOR)
PUBLISHED = PatternModel.of(
    McpPattern(carriers=(90.0, 106.0, 120.0, 132.0), codes=tuple(range(16)), levels="composite"), PROJECTOR
)


def test_a_place_in_the_order_is_what_most_of_a_run_say():
    a_break = hmm.MAX_GAP
    runs = [  # path, gap to the peak before, expected places
        ([3, 4, -1, 6, 9, 8], [0, 0, 0, 0, 0, 0], [3, 4, 5, 6, 7, 8]),
        ([5, 6, 8, 9, 2], [0, 0, 1, 0, 0], [5, 6, 8, 9, 10]),
        ([1, 2, 3, 7, 8, 9, 10], [0, 0, 0, a_break, 0, 0, 0], [-1, -1, -1, 7, 8, 9, 10]),
        ([4, 9, 6, 11, 8, 13, 10, 15], [0] * 8, [-1] * 8),
        ([-1, 0, 1, 2, 3], [0] * 5, [-1, 0, 1, 2, 3]),
    ]
    path, gap, expected = (np.concatenate([run[k] for run in runs]).astype(np.int32) for k in range(3))
    first = np.concatenate([np.arange(len(run[0])) == 0 for run in runs])
    np.testing.assert_array_equal(description.places_in_order(path, first, gap), expected)


def test_words_that_trade_places_are_told_from_a_few_wrong_ones():
    word = np.unique(OWN.ratio > 0, axis=0, return_inverse=True)[1].ravel()
    place = np.repeat(np.arange(OWN.stripes, dtype=np.int32), 20)

    def said(shown):
        each = np.zeros((len(place) + 9, 16), np.float32)
        each[np.arange(len(place)), shown] = 2 * description.CLEAR
        run_on = np.concatenate((place, OWN.stripes + np.arange(8), [-1])).astype(np.int32)  # past the last stripe
        return description.exchanged_words(each, run_on, word, OWN)

    shown = word[place]
    assert said(shown) == ()
    one_wrong = np.where(place == 6, word[8], shown)
    assert said(one_wrong) == ()
    traded = np.where(place == 8, word[6], one_wrong)
    assert said(traded) == (McpPattern().codes[3], McpPattern().codes[4])
    assert said(np.where(np.arange(len(place)) % 20 < 12, shown, traded)) == ()
    round_three = np.select([place == 6, place == 8, place == 20], [word[8], word[20], word[6]], shown)
    assert said(round_three) == tuple(McpPattern().codes[k] for k in (3, 4, 10))


def test_carriers_of_one_set_are_not_taken_for_another_where_the_magnification_drifts():
    random = np.random.default_rng(5)
    rows, columns = np.arange(20, 1000, 38), np.arange(348)
    x, y = np.meshgrid((columns + 0.5) / 174 - 1, rows / 520.0 - 1)
    scale = 1.4 * np.exp(0.1 * x - 0.12 * y)
    phase = np.cumsum(np.repeat(4 / scale, 4, axis=1) / 4, axis=1)
    light = np.ones_like(phase) + 0.02 * random.normal(size=phase.shape)
    for k in range(1, len(rows), 2):
        word = k // 2 + 1  # natural order: neighbours lack the same carriers
        on = [carrier for i, carrier in enumerate(PUBLISHED.carriers) if word >> i & 1]
        light[k] += 0.25 * np.cos(2 * np.pi * np.outer(on, phase[k])).sum(axis=0)
    count = len(rows) * len(columns)
    order = np.arange(count, dtype=np.int32).reshape(len(columns), len(rows)).T.ravel()
    chains = linking.Chains(
        np.ascontiguousarray(order),
        np.arange(0, count + 1, len(columns), dtype=np.int32),
        np.repeat(columns, len(rows)).astype(np.int32),
    )
    zero = np.zeros(count, np.float32)
    start = np.arange(0, count + 1, len(rows), dtype=np.int32)
    at = np.tile(rows, len(columns)).astype(np.float32)
    peaks = stripes.Peaks(start, at, zero, zero, zero, zero, np.ones(count, np.uint8))
    signals = Signals(light.astype(np.float32).ravel(), zero)
    found = carriers.search_carriers(signals, tracks.single(peaks, chains), PUBLISHED, 38 / 27, (1040, 1392))
    assert found.scale == pytest.approx(1.4, rel=0.02)
    assert found.drift_x == pytest.approx(0.1, abs=0.031)
    assert found.drift_y == pytest.approx(-0.12, abs=0.031)
    assert np.prod(found.contrast) ** 0.25 > 1.25


def test_a_peak_whose_carriers_were_hardly_measured_needs_more_to_be_decided():
    sigma = np.float32([0.005, 0.03, 0.05, 10.0])[:, None] * np.ones((1, 4), np.float32)
    seen = emissions.Amplitudes(np.zeros((4, 4), np.float32), sigma, np.ones(4, np.float32))
    for model in (OWN, PUBLISHED):  # the weakest carrier is a quarter of its stripe's light in both
        np.testing.assert_allclose(decision.confidence_needed(seen, model), [0.9, 0.9, 0.99, 0.99], rtol=1e-6)


def grid(across: float, along: float, degrees: float) -> np.ndarray:
    """Two waves at right angles, turned; no pattern."""
    angle = np.radians(degrees)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    one = 0.5 + 0.5 * np.cos(2 * np.pi * (x * np.sin(angle) + y * np.cos(angle)) / across)
    other = 0.7 + 0.3 * np.cos(2 * np.pi * (x * np.cos(angle) - y * np.sin(angle)) / along)
    noise = np.random.default_rng(0).normal(0, 2, x.shape)
    return np.clip(200 * one * other + 20 + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("across", "along", "degrees"), [(15.5, 10, 32), (15, 10, 32), (15, 10, 30)])
def test_a_grid_whose_stripes_show_words_by_chance_is_refused(across: float, along: float, degrees: float) -> None:
    with pytest.raises(DecodeError):
        decode_image(grid(across, along, degrees), McpPattern(), PROJECTOR, CAMERA)


@pytest.mark.parametrize("waves", [1, 4])
def test_one_wave_along_short_chains_is_no_set_of_carriers(waves: int) -> None:
    random = np.random.default_rng(3)
    count, length = 40, 14
    x = np.arange(stripes.STEP * length)
    on = OWN.carriers[:waves] / 1.4
    phase = random.uniform(0, 2 * np.pi, (count, 1, waves))
    light = 1 + 0.2 * np.cos(2 * np.pi * x[None, :, None] * on + phase).sum(axis=2)
    light += random.normal(0, 0.01, light.shape)
    places = np.arange(count * length, dtype=np.int32)
    start = np.arange(0, count * length + 1, length, dtype=np.int32)
    chains = linking.Chains(places, start, places % length)
    scales = 1.4 * np.exp(np.arange(-0.7, 0.701, 0.02))
    found = carriers._by_least_squares(light.astype(np.float32).ravel(), chains, OWN, scales, 1.4, 128)
    assert (found.contrast[0] > 3) == (waves == 4)


def test_names_without_any_value_are_said_to_be_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(description, "LEAST_ORDER", 0.0)
    found = decode_image(grid(15, 10, 32), McpPattern(), PROJECTOR, CAMERA)
    assert found.rows is not None
    assert found.peaks is not None
    assert not np.isfinite(found.rows).any()
    assert len(found.peaks) > 100
    assert "none has the next stripe beside it: no values" in found.warnings[0]


def test_the_order_of_neighbours_is_asked_where_there_are_any() -> None:
    sound = description.Agreement(clear=0.4, agree=0.99, order=0.95, hits=0.95, wraps=0.0)
    assert sound.holds
    assert replace(sound, order=0.7).holds  # rods before a rolled projector
    assert not replace(sound, order=0.25).holds
    found = [agreement_of(path) for path in ([3, 4, 5, 9, 10], [3, 9, 1, 14, 7])]
    assert [round(each.order, 2) for each in found] == [0.75, 0.0]
    assert agreement_of([3]).order == 1.0


@pytest.mark.parametrize(("brightness", "cause"), [(90, "contradict the description"), (4, "cannot be read")])
def test_codes_that_are_not_read_do_not_accuse_the_description(brightness: float, cause: str) -> None:
    described = McpPattern()
    shown = replace(described, codes=tuple(int(c) for c in np.random.default_rng(0).permutation(described.codes)))
    light = cv2.resize(shown.fringe(0, PROJECTOR).astype(np.float32), (CAMERA.width, CAMERA.height))
    image = 10 + brightness * light + np.random.default_rng(2).normal(0, 1, light.shape)
    with pytest.raises(DecodeError, match=cause) as refused:
        decode_image(np.rint(image).astype(np.uint8), described, PROJECTOR, CAMERA)
    assert "bits, carriers, codes and axis of the description" in refused.value.hint
    if brightness < 10:
        assert "2% are needed" in str(refused.value)
        assert "1 of 255 grey levels bright" in str(refused.value)
        assert refused.value.hint.startswith("more light on the surface, or a longer exposure")


def agreement_of(path: list[int]) -> description.Agreement:
    """Of one column of peaks a pitch apart."""
    count, channels = len(path), OWN.channels
    none = np.zeros((count, channels), np.float32)
    seen = emissions.Amplitudes(none, none, np.zeros(count, np.float32))
    evidence = np.zeros((count, OWN.stripes), np.float32)
    columns = np.array([0, count], np.int32), np.zeros(count, np.int32)
    return description.agreement(seen, evidence, OWN, np.ones(channels, np.float32), np.array(path, np.int32), columns)
