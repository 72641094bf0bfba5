"""Interference between channels: what gamma (eq. 3.28) and saturation (eq. 3.29-3.36) add to the spectrum."""

from __future__ import annotations

import numpy as np

from scanner.errors import DecodeError
from tables.page import Grid, Page
from tables.rig import FIRST_GENERATION, PUBLISHED, PX_PER_CYCLE, SEEDS, THIRD_GENERATION, Picture, decode, shoot

GAMMA_TITLE = "Interference by gamma (eq. 3.28)"
SATURATION_TITLE = "Interference by saturation (eq. 3.29-3.36)"

GAMMAS = (1.0, 1.5, 2.0, 2.3, 2.6, 3.0)
GRATING = 24
"""Cycles: low enough that blur takes less than 2 % from the third harmonic."""

EXPOSURES = (1.0, 1.25, 1.5, 1.75, 2.0, 2.5)
PAIR = (90, 120)
"""Two carriers whose greatest common divisor, 30 cycles, is well above zero."""


def _grating(frequencies):
    """Equal cosines along x, full modulation, constant along y."""
    x = (np.arange(1152) + 0.5) / 1152
    line = np.mean([(1 + np.cos(2 * np.pi * f * x)) / 2 for f in frequencies], axis=0)
    return Picture(f"grating {frequencies}", np.repeat(line[None], 864, axis=0).astype(np.float32))


def _amplitude(frame, cycles):
    """Amplitude of `cycles` per projector field, grey levels: fit of a cosine under a Hann window, middle rows' mean.

    The keystone moves the frequency from row to row; the best frequency near the expected one is taken in each row.
    """
    middle = frame[420:620:10].astype(np.float64)
    columns = frame.shape[1]
    window = np.hanning(columns)
    x = np.arange(columns) - (columns - 1) / 2
    near = cycles * PX_PER_CYCLE * np.linspace(0.97, 1.03, 61) / columns
    waves = np.exp(-2j * np.pi * near[:, None] * x) * window
    flat = middle - (middle * window).sum(axis=1, keepdims=True) / window.sum()
    return float(np.median(np.abs(flat @ waves.T).max(axis=1) * 2 / window.sum()))


def gamma_page() -> Page:
    """Harmonics of a grating by the projector's gamma, and which carriers they fall on."""
    rows = []
    for gamma in GAMMAS:
        ratios = []
        for seed in SEEDS:
            frame = shoot("board", seed, _grating((GRATING,)), None, f"gamma={gamma}").frame
            a, b, c = (_amplitude(frame, k * GRATING) for k in (1, 2, 3))
            ratios.append((b / a, c / b))
        first, second = np.max(ratios, axis=0)
        theory = [(gamma - k) / (gamma + k + 1) for k in (1, 2)]
        # Of harmonics below the noise no ratio is formed.
        rows.append(
            [f"{gamma:g}", theory[0], float(first), abs(theory[1]), float(second) if theory[0] > 0.05 else np.nan]
        )
    sets = []
    for name, carriers in (
        ("first generation", FIRST_GENERATION.carriers),
        ("MCP, as captured in sec. 5.6", PUBLISHED.carriers),
        ("third-generation MCP", THIRD_GENERATION.carriers),
    ):
        listed = ", ".join(f"{f:g}" for f in carriers)
        sets.append([f"{name} ({listed})", *_fallen_on(carriers)])
    return Page(
        "gamma",
        GAMMA_TITLE,
        f"""
A projector of gamma g that is not corrected for turns a cosine of full modulation into harmonics whose amplitudes
stand in the ratio B(k+1) / B(k) = (g - k) / (g + k + 1). A grating of {GRATING} cycles on the board, uncorrected, is
measured at its harmonics. The second grid projects one carrier of a set after the other, uncorrected at gamma 2.3,
and measures what appears on the set's other carriers, as a share of the carrier's own amplitude.
""",
        [
            Grid(
                ["gamma", "B2 / B1 (eq. 3.28)", "B2 / B1 (here)", "B3 / B2 (eq. 3.28)", "B3 / B2 (here)"],
                rows,
                "Harmonics:",
            ),
            Grid(["Carriers", "Largest share", "From", "On"], sets, "What falls on another carrier:"),
        ],
        """
The first ratio agrees with the formula to the third digit or so (at gamma 2 the published "influence of 25 %"); what
is left is blur, which takes a little more from each harmonic. Of the third harmonic little is there below gamma 2
(its sign changes at 2), so its ratio is that of two small numbers. The dissertation's conclusion holds: carriers of
50, 100, 150 and 200 are harmonics of one another, and a quarter to a third of one channel falls into the next; the
MCP sets have none of their own harmonics among them, and what is found there is the skirt of the window that measures
it.
""",
    )


def _fallen_on(carriers):
    """Largest share of one carrier's amplitude found on another of the set, and which two."""
    worst = (0.0, 0.0, 0.0)
    for own in carriers:
        frame = shoot("board", SEEDS[0], _grating((own,)), None, "gamma=2.3").frame
        amplitude = _amplitude(frame, own)
        for other in carriers:
            if other != own:
                worst = max(worst, (_amplitude(frame, other) / amplitude, own, other))
    return worst[0], f"{worst[1]:g}", f"{worst[2]:g}"


def saturation_page() -> Page:
    """Two carriers, and their differences, in an image that clips; and what clipping does to decoding."""
    rows, base = [], {}
    for exposure in EXPOSURES:
        options = f"exposure_scale={exposure}"
        runs = []
        for seed in SEEDS:
            frame = shoot("board", seed, _grating(PAIR), options=options).frame
            amplitudes = [_amplitude(frame, f) for f in (30, 60, *PAIR)]
            if exposure == 1.0:
                base[seed] = np.array([0.5 * sum(amplitudes[2:])] * 2 + amplitudes[2:])
            share = float((frame[420:620] >= 255).mean())
            runs.append([share, *(np.array(amplitudes) / (base[seed] * exposure))])
        clipped, low, twice, one, other = np.max(runs, axis=0)
        rows.append([f"{exposure:g}", *(float(v) for v in (clipped, one, other, low, twice)), *_model(exposure)])
    decoded = [_decoded_when(exposure) for exposure in EXPOSURES]
    return Page(
        "saturation",
        SATURATION_TITLE,
        """
Two in-phase carriers of 90 and 120 cycles (greatest common divisor 30) on the board, exposed more and more.
Amplitudes are shares of the unclipped carrier's. Model: eq. 3.29, S' = S + (b - S) R, with R one window of width 1 /
(2 f_max) at each period of the greatest common divisor, and b the clipping level. The second grid is the published
MCP pattern, exposed as much: share of peaks with the right code word before the model (*Original*) and after growth
(*Final*), on the board against truth.
""",
        [
            Grid(
                ["Exposure", "clipped pixels", "at 90", "at 120", "at 30", "at 60", "at 90 (model)", "at 30 (model)"],
                rows,
                "Two carriers:",
                places=3,
            ),
            Grid(["Exposure", "clipped pixels", "Original", "Final"], decoded, "The published pattern:", places=3),
        ],
        """
What eq. 3.29-3.36 predict is there: light lost at both carriers, and lines that were not projected at multiples of
the greatest common divisor. The published model takes one window a period, always as wide as half a period of the
highest carrier; it therefore holds near the exposure at which so much is clipped (about 1.5 here), has its effect too
early below and too little above. The carriers of the published pattern have no large common divisor, so their
clipping products spread over many weak lines; the unmodulated stripes clip first, which moves no code word and costs
only the position of their peaks.
""",
    )


def _model(exposure):
    """Shares at 90 and 30 cycles by eq. 3.29, the clip at 255 where the unclipped full light makes 230 grey levels."""
    t = (np.arange(3600) + 0.5) / 3600 / 30
    signal = np.mean([(1 + np.cos(2 * np.pi * f * t)) / 2 for f in PAIR], axis=0) * exposure
    level = 255 / 230
    period, width = 1 / 30, 1 / (2 * max(PAIR))
    window = np.minimum(t % period, period - t % period) <= width / 2
    if signal.max() <= level:
        window[:] = False
    distorted = np.where(window, level, signal)
    unclipped = 0.25 * exposure
    return [float(abs(2 * (distorted * np.cos(2 * np.pi * f * t)).mean()) / unclipped) for f in (90, 30)]


def _decoded_when(exposure):
    runs = []
    for seed in SEEDS:
        shot = shoot("board", seed, PUBLISHED, options=f"exposure_scale={exposure}")
        stages = {}
        try:
            decode(shot, "casey2011", stages)
        except DecodeError:
            runs.append((np.nan, np.nan, np.nan))
            continue
        stripe = np.floor((shot.truth.rows + 0.5) / PUBLISHED.pitch_px(shot.sequence.projector))
        true = np.where(stripe % 2 == 0, stripe // 2, 0)
        peaks = shot.truth.lit & (stages["stripes"] > 0) & (true > 0)
        shares = [float((stages[name] == true)[peaks].mean()) for name in ("code", "grown")]
        runs.append((float((shot.frame >= 255).mean()), *shares))
    table = np.array(runs)
    return [f"{exposure:g}", float(table[:, 0].max()), float(table[:, 1].min()), float(table[:, 2].min())]
