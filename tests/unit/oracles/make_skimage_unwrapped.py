"""Makes skimage_unwrapped.npz, what scikit-image finds for a small PMP capture: run by hand, no part of the tests.

    pip install scikit-image numpy; python tests/unit/oracles/make_skimage_unwrapped.py

It was made with scikit-image 0.26.0 (BSD-3-Clause). Frames are kept beside the result, so that the oracle stays what it
is where NumPy's random numbers change; scikit-image itself is too large a thing to install for one test.

    frames: (12, H, W) uint8, sets of 1, 8 and 32 periods along y, 4 shifts each, of a bump before a tilted plane
    wrapped: (H, W) float32 rad, of the finest set, by arctan2
    unwrapped: (H, W) float32 rad, `skimage.restoration.unwrap_phase(wrapped)`: by neighbours, not by other sets
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from skimage.restoration import unwrap_phase

HEIGHT, WIDTH, SHIFTS, FREQUENCIES, PROJECTOR_ROWS = 72, 80, 4, (1, 8, 32), 240


def main():
    y, x = np.mgrid[:HEIGHT, :WIDTH] / np.array([HEIGHT, WIDTH])[:, None, None]
    rows = 20 + 150 * y + 20 * x + 12 * np.exp(-(((x - 0.5) / 0.25) ** 2) - ((y - 0.5) / 0.2) ** 2)
    random = np.random.default_rng(2011)
    frames = []
    for f in FREQUENCIES:
        for n in range(SHIFTS):
            angle = 2 * np.pi * (f * (rows + 0.5) / PROJECTOR_ROWS - n / SHIFTS)
            grey = 255 * 0.8 * (0.54 + 0.45 * np.cos(angle)) + random.normal(0, 1, rows.shape)
            frames.append(np.rint(np.clip(grey, 0, 255)).astype(np.uint8))
    a, b, c, d = (frame.astype(np.float64) for frame in frames[-SHIFTS:])
    wrapped = np.arctan2(b - d, a - c)
    np.savez_compressed(
        Path(__file__).with_name("skimage_unwrapped.npz"),
        frames=np.stack(frames),
        wrapped=wrapped.astype(np.float32),
        unwrapped=unwrap_phase(wrapped).astype(np.float32),
    )


if __name__ == "__main__":
    main()
