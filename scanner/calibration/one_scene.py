"""Whether scans that are said to repeat each other show one scene that stood still.

A standard deviation of depth is a repeatability only of the same points. Two scenes have one too, of centimetres, and
nothing in it says so: what differs by more than any noise is told apart here, before it is taken for a figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError

Array = NDArray[np.float64]

SAMPLES = 200_000
"""Pixels that are asked: a share of 5 % is known to a twentieth of a per cent"""
MOST_FAR = 0.01
"""Of the distance: warmth moves a rig by a ten-thousandth, a knock that leaves it usable by a thousandth or two. What
is a hundredth off is another surface."""
MOST_SHARE = 0.05
"""Share of pixels: a silhouette, a leaf, a wire may move without making it another scene"""
MOST_SIGMAS = 6.0
"""Of the difference of two depths by the scans' own sigmas: beyond lies no pixel of a million, with sigmas that are a
fifth too small one in a million"""


@dataclass(frozen=True)
class Repeat:
    """One scan. xyz: (H, W, 3) mm; sigma_z: (H, W) mm, None where the scan has none; report: report.json's."""

    name: str
    xyz: NDArray[Any]
    sigma_z: NDArray[np.float32] | None
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def made(self) -> dict[str, str]:
        """How, as far as its report tells: what scans that repeat each other have in common."""
        capture, decoder, rig = (self.report.get(name) or {} for name in ("capture", "decoder", "rig"))
        frames = (capture.get("shows") or {}).get("fringe")
        centre = rig.get("projector_centre_mm") or ()
        places = ", ".join(f"{mm:.2f}" for mm in centre if isinstance(mm, int | float))
        return {
            "method": f"{capture.get('method') or decoder.get('method')}, {frames} frames of the pattern",
            "repetitions": f"{capture.get('repeat')} in one scan",
            "calibration": f"{rig.get('calibration')}, with the projector at {places} mm",
        }


def made_otherwise(scans: Sequence[Repeat]) -> list[str]:
    """Words for what scans that are said to repeat each other were made differently by."""
    found = []
    for what in scans[0].made if scans else ():
        ways: dict[str, list[str]] = {}
        for scan in scans:
            ways.setdefault(scan.made[what], []).append(scan.name)
        if len(ways) > 1:
            listed = "; ".join(f"{way} ({', '.join(names)})" for way, names in ways.items())
            found.append(
                f"the scans were not made alike: {what} {listed}. Their deviation is no repeatability of either"
            )
    return found


def require_one_scene(scans: Sequence[Repeat]) -> list[str]:
    """Hold each scan against the median of all (of two: against the other).

    Returns:
        Words for scans that differ by more than noise: something moved a little, or warmed up.

    Raises:
        DecodeError: a scan is of another scene than the others.
    """
    if len({scan.xyz.shape for scan in scans}) != 1:
        return []  # the comparison itself says so
    height, width = scans[0].xyz.shape[:2]
    step = max(1, int(np.sqrt(height * width / SAMPLES)))
    depths = np.stack([scan.xyz[::step, ::step, 2] for scan in scans]).astype(np.float64)
    common = np.isfinite(depths).all(axis=0)
    if not common.any():
        return []
    depths = depths[:, common]
    middle = depths[0] if len(scans) == 2 else np.median(depths, axis=0)
    others = f"{scans[0].name}" if len(scans) == 2 else "the others"
    found = []
    for scan, depth in zip(scans, depths, strict=True):
        off = np.abs(depth - middle)
        far = float(np.mean(off > MOST_FAR * np.abs(middle)))
        if far > MOST_SHARE:
            raise DecodeError(
                f"{scan.name} shows another scene than {others}, or something large moved: {far:.0%} of the pixels "
                f"that all have differ by more than {MOST_FAR:.0%} of the distance, half of all by "
                f"{np.median(off):.3g} mm or more; no noise does that, and their deviation is no repeatability",
                hint="give scans of one scene that did not move, taken one after the other",
            )
        if scan.sigma_z is None:
            continue
        beyond = float(np.mean(off > MOST_SIGMAS * np.sqrt(2) * scan.sigma_z[::step, ::step][common]))
        if beyond > MOST_SHARE:
            found.append(
                f"{scan.name} differs from {others} by more than noise: {beyond:.0%} of the pixels are beyond "
                f"{MOST_SIGMAS:.0f} sigmas, half of all {np.median(off):.2g} mm off or more; something moved or the "
                "rig warmed up, and the deviation is of that, too"
            )
    return found
