"""Tables 2.1 to 2.3: isolated strips of a board, how much of a stripe is found and how far it reaches beyond."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from scanner.decode.mcp.casey2011 import carrier_search, channels, stripe_detection
from tables.page import Grid, Page
from tables.rig import PUBLISHED, PX_PER_CYCLE, SEEDS, Picture, shoot

WIDTHS = (301, 201, 101, 51, 25, 15, 7, 3)
LEVELS = 32
"""Stripes of the pattern, every second one modulated (16)."""

WEAKEST = 0.125
"""Mean light of the dimmest stripe of the published pattern over that of the brightest."""

PUBLISHED_FIGURES = {
    "2.1": ((1, 19, 47), (1, 30, 65), (1, 25, 83), (1, 13, 102), (1, 6, 92), (1, 4, 119), (1, 2, 114), (1, 1, 116)),
    "2.2": ((1, 42, 77), (1, 40, 85), (1, 20, 91), (1, 10, 94), (1, 3, 69), (1, 3, 128), (1, 2, 107), (1, 1, 110)),
    "2.3": ((1, 47, 73), (1, 40, 88), (1, 20, 98), (1, 10, 103), (1, 4, 123), (1, 3, 88), (1, 2, 109), (1, 1, 111)),
}
CARRIERS = {"2.1": (106.0,), "2.2": PUBLISHED.carriers, "2.3": PUBLISHED.carriers}
CHANNEL = {"2.1": 0, "2.2": 1, "2.3": 3}
"""The channel that is looked at: 92, 92 and 115 cycles per field of view."""

TITLES = {
    "2.1": "Table 2.1: isolated strips, 92 cycles, single frequency modulated",
    "2.2": "Table 2.2: isolated strips, 92 cycles, four frequencies modulated",
    "2.3": "Table 2.3: isolated strips, 115 cycles, four frequencies modulated",
}

WORDS = """
A test pattern of 16 modulated and 16 unmodulated stripes ({pattern}) on the board. A window leaves a strip of the
image and sets all else to zero; the strip goes through stripe detection, band-pass and two-sigma threshold (sec. 4.1,
4.4, 4.5), the band being the one that the search of sec. 4.3 finds in the whole image. *Fraction correct*: pixels of
modulated stripes' peaks inside the window that the channel shows. *False II*: length of what it shows inside the
window on unmodulated stripes' peaks, mean of all such stripes. *False region*: mean length of the regions it shows
beyond the window's edges, along the modulated stripes. Pixels; largest of the seeds, of the fraction the smallest.
The window stands in the middle of the image.
"""

DIFFERS = """
As published: nothing is missed, and the narrower the window, the farther a stripe reaches beyond it, up to a length
that the band-pass alone decides. {own} *False II* differs in kind. Here all unmodulated stripes of a window are shown
at once, over most of its width, or none is, for on a flat simulated board they are all alike: a narrow window turns a
bright stripe into a pulse whose spectrum covers every carrier. The published means are a quarter to a fifth of the
window's width below 101 px, as if every fourth or fifth stripe had been shown; on a real projector and board stripes
are not alike. In wide windows the published stripes are shown too where these are not, which noise and texture at the
carrier's frequency would explain. The dissertation's conclusion stands: isolation costs false positives, not misses.
Where the carriers have to be found in the window itself, the search of sec. 4.3 finds them down to 101 px of one
carrier, and 301 px of four.
"""

OWN = {
    "2.1": """Here the false regions agree with the published ones to about a tenth at most widths, and rise and fall
where they do (a dip at 25 px, a peak at 15 px), so the band-pass, whose width the dissertation does not tell, must be
about the same.""",
    "2.2": """From 101 px down the false regions agree with the published ones to about a tenth, and rise and fall
where they do (a dip at 25 px, a peak at 15 px); in the widest windows they are shorter here.""",
    "2.3": """From 101 px down the false regions agree with the published ones within a fifth, and rise and fall where
they do (a peak at 25 px, a dip at 15 px); in the widest windows they are shorter here.""",
}


def _picture(table: str):
    """The test pattern: modulated stripes carry all of its carriers, each at an equal share of the light."""
    h = 864 / LEVELS
    position = (np.arange(864) + 0.5) / h
    stripe = np.floor(position)
    triangle = 1 - np.abs(2 * (position - stripe) - 1)
    x = (np.arange(1152) + 0.5) / 1152
    waves = np.mean([(1 + np.cos(2 * np.pi * f * x)) / 2 for f in CARRIERS[table]], axis=0)
    modulated = (stripe % 2 == 0)[:, None]
    light = triangle[:, None] * np.where(modulated, waves, 1.0)
    return Picture(f"strips {CARRIERS[table]}", light.astype(np.float32))


@lru_cache(maxsize=4)
def _shot(carriers, seed):
    table = next(t for t, c in CARRIERS.items() if c == carriers)
    return shoot("board", seed, _picture(table))


def _runs(high):
    """Lengths of the runs of True along the last axis of (H, W), all rows together."""
    padded = np.pad(high.astype(np.int8), ((0, 0), (1, 1)))
    step = np.diff(padded, axis=1)
    return np.argwhere(step == -1)[:, 1] - np.argwhere(step == 1)[:, 1]


def _band(table: str, seed: int, wavelength: float):
    """Frequency and sigma of the channel's band, found in the whole image, cycles per px."""
    grey = _shot(CARRIERS[table], seed).frame.astype(np.float32)
    columns = grey.shape[1]
    carriers = np.array(CARRIERS[table]) * PX_PER_CYCLE / columns
    spacing = float(np.diff(PUBLISHED.carriers).min()) * PX_PER_CYCLE / columns
    folded = carrier_search.folded_psd(grey - grey.mean(), wavelength)
    search = carrier_search.search(folded, carriers, columns, spacing=spacing)
    k = CHANNEL[table]
    return float(search.frequency[k]), float(search.sigma[k])


def _measure(table: str, seed: int, width: int):
    """Fraction correct, False II and False region length of one window."""
    shot = _shot(CARRIERS[table], seed)
    image, truth = shot.frame, shot.truth
    rows, columns = image.shape
    left = (columns - width) // 2
    inside = slice(left, left + width)
    windowed = np.zeros_like(image)
    windowed[:, inside] = image[:, inside]
    found = stripe_detection.detect(windowed, LEVELS, WEAKEST)
    # Where the true stripes run, column by column: the row nearest to each stripe's middle.
    middle = (np.arange(LEVELS) + 0.5) * 864 / LEVELS - 0.5
    line = np.stack(
        [np.interp(middle, truth.rows[:, c], np.arange(rows), left=-1, right=-1) for c in range(columns)], 1
    )
    there = (line > 0).all(axis=1) & (line < rows - 1).all(axis=1)
    line = np.rint(line).astype(int)

    frequency, sigma = _band(table, seed, found.wavelength)
    grey = windowed.astype(np.float32)
    grey -= grey.mean()
    isolated = channels.isolate(carrier_search.spectrum(grey), frequency, sigma, found.wavelength, image.shape)
    bits = channels.binarize(isolated, frequency, np.ones(image.shape, np.uint8)) > 0

    peak_stripe = np.floor((truth.rows[found.peaks.y, found.peaks.column] + 0.5) / (864 / LEVELS))
    within = (found.peaks.column >= left) & (found.peaks.column < left + width)
    modulated = within & (peak_stripe % 2 == 0)
    fraction = float(bits[found.peaks.y, found.peaks.column][modulated].mean()) if modulated.any() else np.nan
    plain = within & (peak_stripe % 2 == 1)
    shown = int(bits[found.peaks.y, found.peaks.column][plain].sum())
    plain_stripes = len(np.unique(peak_stripe[plain]))
    beyond = bits[line, np.arange(columns)[None, :]]
    beyond[:, inside] = False
    beyond = beyond[there & (np.arange(LEVELS) % 2 == 0)]
    false = _runs(beyond)
    return fraction, shown / max(plain_stripes, 1), float(false.mean()) if len(false) else 0.0


def make(table: str) -> Page:
    """The page of one of tables 2.1 to 2.3."""
    rows = []
    for width, told in zip(WIDTHS, PUBLISHED_FIGURES[table], strict=True):
        runs = np.array([_measure(table, seed, width) for seed in SEEDS])
        rows.append([str(width), *told, float(runs[:, 0].min()), float(runs[:, 1].max()), float(runs[:, 2].max())])
    names = ["Fraction correct", "False II", "False region"]
    head = ["Window (px)", *(f"{n} (published)" for n in names), *(f"{n} (here)" for n in names)]
    pattern = "106 cycles per projector field, alone" if table == "2.1" else "all of 90, 106, 120 and 132 cycles on"
    return Page(
        f"table-{table}",
        TITLES[table],
        WORDS.format(pattern=pattern),
        [Grid(head, rows, places=1)],
        DIFFERS.format(own=OWN[table]),
        argument=table,
    )
