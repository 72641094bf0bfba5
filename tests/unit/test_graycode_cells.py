"""Sigmas of Gray code by how wide the borders of its cells show to be, against errors that are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode.graycode_cells import FEWEST, narrow_cells

ROOT12 = np.sqrt(12)


def seen(width_finest, width_other, cell, along=256, per_cell=40):
    """Positions and sigmas as the pass leaves them, and what they err by: borders are strips of these widths, cells."""
    true = (np.arange(along // cell * per_cell) + 0.5) / per_cell
    border = np.round(true)
    width = np.where(border % 2 == 1, width_finest, width_other)
    on_border = np.abs(true - border) < width / 2
    place = np.where(on_border, border, np.floor(true) + 0.5)
    sigma = np.where(on_border, 2, 1) * cell / ROOT12
    position = place * cell - 0.5
    return position.astype(np.float32), sigma.astype(np.float32), (true - place) * cell, on_border


@pytest.mark.parametrize(("finest", "other", "cell"), [(0.1, 0.1, 1), (0.5, 0.3, 1), (0.3, 0.3, 4), (0.9, 0.2, 2)])
def test_sigmas_are_what_strips_leave(finest, other, cell):
    position, sigma, error, on_border = seen(finest, other, cell)
    narrow_cells(sigma, position, 256, cell, 40)
    inside = (position > cell) & (position < 256 - cell - 1)
    decided = sigma[inside & ~on_border]
    rms = np.sqrt(np.mean(error[inside & ~on_border] ** 2))
    assert decided.max() <= 1.0001 * cell / ROOT12
    assert 0.97 * rms < np.median(decided) < 1.4 * rms
    rms = np.sqrt(np.mean(error[inside & on_border] ** 2))
    assert 0.97 * rms < np.median(sigma[inside & on_border]) < 2 * rms
    assert np.median(sigma[inside & on_border]) < 2 * cell / ROOT12


def test_ends_of_the_field_pixels_without_a_value_and_few_pixels_keep_theirs():
    position, sigma, *_ = seen(0.2, 0.2, 1)
    position[5000:5010] = sigma[5000:5010] = np.nan
    before = sigma.copy()
    narrow_cells(sigma, position, 256, 1, 40)
    at_ends = (position < 0.25) | (position > 254.75)
    np.testing.assert_array_equal(sigma[at_ends], before[at_ends])
    assert np.isnan(sigma[5000:5010]).all()
    assert (sigma[~at_ends][:4000] < before[~at_ends][:4000]).all()
    few = before[1000 : 1000 + FEWEST - 1].copy()
    narrow_cells(few, position[1000 : 1000 + FEWEST - 1], 256, 1, 40)
    np.testing.assert_array_equal(few, before[1000 : 1000 + FEWEST - 1])
