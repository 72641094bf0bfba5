"""Overexposure, named: how much of what the projector lights is saturated, and what exposure would not be.

It judges a decoded capture and warns; it chooses no exposure (that is `scanner.sequencer.exposure`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.capture import Capture
from scanner.capture.exposure import exposure_report
from scanner.decode import Decoded, Reason
from scanner.decode.reasons import tally
from scanner.patterns import PmpPattern

OVEREXPOSED = "overexposed: "
"""How the warning begins"""

LARGE = 0.01
"""Share of what shows the pattern: automatic exposure lets fewer than one pixel in 200 saturate (glints)."""

CLIP = 0.98
"""Share of the camera's range from which a sample counts as clipped, as the decoders have it."""

AIM = 0.9
"""Share of that level for what is advised, .88 of the range: between automatic exposure's choices, .95 and less."""

SURE, MOST = 2.0, 10.0
"""Fringes that are twice too bright are saturated in half of their samples, and what is advised is right to a tenth.
Beyond, blur (which leaves fine fringes no black) makes it a guess on the short side: 19 ms of 200 where 31 would do.
Ten times too bright are eight of ten: more cannot be told by counting."""

PERCENTILE = 99.5
"""Of the pixels' brightness, as automatic exposure has it."""

PILED, NEXT, OVER_NEXT = 0.005, 20, 2.0
"""Share of the samples that lie at the brightest level of all, and how many times as many as in the twentieth below it:
a cosine has twice as many there as here, and noise makes these fewer."""

LEAST_TOP = 40
"""Grey levels: of dimmer fringes the last level alone is as wide as the top of a cosine"""

_EVERY, _BLOCK = 8, 4
"""Pixels from sample to sample, and samples each way that are counted together. Of one pixel's eight shifts a whole
number is saturated; its neighbours' phases differ, and the mean is the share that the brightness makes."""


def overexposed(decoded: Decoded, capture: Capture) -> tuple[str, ...]:
    """What to say where more than `LARGE` of the pixels that show the pattern are saturated; () where not.

    Args:
        decoded: the maps; `reason` tells what is saturated.
        capture: whose frames these are; it may still be open.
    """
    counts = tally(decoded.reason)
    shows = int(counts.sum() - counts[Reason.SHADOW] - counts[Reason.LOW_MODULATION])
    clipped = int(counts[Reason.CLIPPED])
    if clipped <= LARGE * shows:
        return ()
    report = exposure_report(capture.header) or {}
    used, mode = report.get("used_us"), report.get("mode")
    automatic = "" if mode == "auto" else ", or automatically (--exposure auto)"
    advice = "expose for less" if used is None else _advice(used / 1000, _too_bright(capture))
    return (
        f"{OVEREXPOSED}{clipped / shows:.1%} of the pixels in which the pattern shows are saturated and have no value: "
        f"{advice}{automatic}, lower the gain, or close the lens",
    )


def clips_below(capture: Capture) -> tuple[str, ...]:
    """What to say where fringes are cut off at a level below the camera's last one, which no decoder takes for
    saturated: video levels that end at 235, a sensor that is full before its converter; () where none are."""
    header = capture.header
    present = [p for p in header.sequence.fringes if p in capture.records]
    if not isinstance(header.sequence.pattern, PmpPattern) or not present:
        return ()
    return cut_off((capture.frame(p) for p in present), header.camera.max_value)


def cut_off(frames: Iterable[NDArray[Any]], last: int) -> tuple[str, ...]:
    """The same of fringes' frames, (H, W) each. last: the camera's largest grey level."""
    counts, every = np.zeros(last + 1, np.int64), 2 * _EVERY
    for frame in frames:
        counts += np.bincount(frame[::every, ::every].reshape(-1), minlength=last + 1)[: last + 1]
    top = int(np.flatnonzero(counts)[-1]) if counts.any() else 0
    if not LEAST_TOP <= top < CLIP * last:
        return ()
    share, below = counts[top] / counts.sum(), int(counts[top - max(top // NEXT, 1) : top].sum())
    if share < PILED or counts[top] < OVER_NEXT * below:
        return ()
    return (
        f"cut off: {share:.1%} of the samples are {top} of {last} and none is brighter, as if the camera ended there "
        "(video levels, a lookup table, a full sensor): what lies above is lost, and no pixel counts as saturated. "
        f"Expose for less, so that the brightest stays below {top}, or set the camera to its full range",
    )


def _advice(used_ms: float, factor: float | None) -> str:
    if factor is None:
        return f"expose for half of these {used_ms:.3g} ms at most"
    less, share = used_ms * AIM / factor, math.acos(2 / factor - 1) / math.pi
    if factor <= SURE:
        return f"expose for {less:.2g} ms at most (these were {used_ms:.3g})"
    guessed = f"{less:.2g} ms or less" if factor >= MOST else f"some {less:.2g} ms"
    return f"expose for {guessed} (a guess: after {used_ms:.3g} ms {share:.0%} of the brightest fringes is gone)"


def _too_bright(capture: Capture) -> float | None:
    """How many times brighter than `CLIP` the brightest fringes are; None where frames are no sinusoids.

    A fringe (1 + cos) / 2 of height L passes 1 for a share s of its phases, with cos(pi s) = 2 / L - 1: the samples
    that are saturated, counted, tell a height that none of them shows.
    """
    header = capture.header
    present = [p for p in header.sequence.fringes if p in capture.records]
    if not isinstance(header.sequence.pattern, PmpPattern) or not present:
        return None
    level = CLIP * header.camera.max_value
    over = np.mean([capture.frame(p)[::_EVERY, ::_EVERY] >= level for p in present], axis=0)
    share = float(np.percentile(_in_blocks(over), PERCENTILE))
    return min(MOST, 2.0 / max(1e-9, 1.0 + math.cos(math.pi * share)))


def _in_blocks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of blocks of `_BLOCK` samples each way, (H // _BLOCK, W // _BLOCK); of less where an image has fewer."""
    high, wide = (min(_BLOCK, count) for count in values.shape)
    rows, columns = values.shape[0] // high, values.shape[1] // wide
    whole = values[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
    return np.asarray(whole.mean(axis=(1, 3)))
