"""The two-sigma threshold (sec. 4.5, eq. 5.14-5.51): how unequal a channel's stripes may be before one is lost."""

from __future__ import annotations

import numpy as np

from scanner.decode.mcp.casey2011 import channels
from tables.page import Grid, Page
from tables.rig import PUBLISHED, SEEDS, decode, shoot

TITLE = "Two-sigma threshold (eq. 5.49-5.51)"
REGIONS = 32
ACTIVE = (4, 6, 8, 10, 12)


def solve(active: int, regions: int = REGIONS) -> tuple[float, float]:
    """x and H_b of eq. 5.49, 5.50: half of the active triangles of height x, half of H_b = 2 - x, x on the threshold.

    x = E{B} + 2 sigma (eq. 5.32), with E{B} = a / (2 N), E{B^2} = a / (3 N) (x^2 - 2 x + 2) (eq. 5.31).
    """
    m, q = active / (2 * regions), 4 * active / (3 * regions)
    roots = np.roots([1 - q, 2 * q - 2 * m, 5 * m * m - 2 * q])
    x = float(max(roots.real))
    return x, 2 - x


def _by_threshold(active: int) -> float:
    """The same ratio from the decoder's own threshold on drawn triangles: bisection for the height that just falls."""
    t = (np.arange(800) + 0.5) / 800
    triangle = 1 - np.abs(2 * t - 1)
    low, high = 0.01, 1.0
    for _ in range(40):
        x = (low + high) / 2
        heights = np.zeros(REGIONS)
        heights[:active] = [x if k % 2 else 2 - x for k in range(active)]
        line = np.concatenate([h * triangle for h in heights]).astype(np.float32)
        above = channels.two_sigma(line[None], np.ones((1, len(line)), np.uint8)) < x
        low, high = (low, x) if above else (x, high)
    return (2 - high) / high


def _captured(channel: int):
    """Highest over lowest stripe of a channel on the board, threshold over the lowest, and share of its pixels kept."""
    worst = []
    for seed in SEEDS:
        shot = shoot("board", seed, PUBLISHED)
        stages = {}
        decode(shot, "casey2011", stages)
        magnitude = np.abs(stages[f"channel-{channel}"])
        stripe = np.floor((shot.truth.rows + 0.5) / PUBLISHED.pitch_px(shot.sequence.projector)).astype(int)
        heights, kept, total = [], 0, 0
        for s in range(0, REGIONS, 2):
            on = (stripe == s) & (stages["stripes"] > 0) & shot.truth.lit
            if (s // 2) >> channel & 1 and on.sum() > 500:
                # A cosine's magnitude: its crests stand at the 95th percentile and above.
                heights.append(float(np.percentile(magnitude[on], 95)))
                kept += int((stages[f"bits-{channel}"][on] > 0).sum())
                total += int(on.sum())
        level = channels.two_sigma(magnitude, np.ones(magnitude.shape, np.uint8))
        worst.append((max(heights) / min(heights), level / min(heights), -kept / total))
    ratio, level, kept = np.max(worst, axis=0)
    return len(heights), float(ratio), float(level), float(-kept)


def make() -> Page:
    """The page."""
    rows = []
    for active in ACTIVE:
        x, high = solve(active)
        rows.append([str(active), x, high, high / x, _by_threshold(active)])
    captured = [[str(c), f"{PUBLISHED.carriers[c]:g}", *_captured(c)] for c in range(4)]
    return Page(
        "threshold",
        TITLE,
        """
The dissertation's worst case: of 32 stripe regions *a* are active triangles, half of height x and half of height H_b
(mean 1), and x lies just on the threshold of mean plus two standard deviations. Published for a = 8: x = .6776, H_b =
1.322, H_b / x = 1.95. *By the decoder*: the ratio at which `two_sigma` loses the lower ones, by bisection on drawn
triangles. The second grid is a real channel: the published pattern on the simulated board.
""",
        [
            Grid(["a", "x", "H_b", "H_b / x", "H_b / x by the decoder"], rows, "Model:"),
            Grid(
                ["Channel", "Carrier", "Stripes", "highest / lowest", "threshold / lowest", "pixels kept"],
                captured,
                "Board:",
                places=3,
            ),
        ],
        """
Equations 5.49 to 5.51 come out as published, and the decoder's own threshold agrees. A captured channel differs from
the model in three ways: it still swings about zero with its carrier, so that its magnitude's mean and deviation are
smaller against its crests; it is a triangle blurred by the band-pass along y; and its stripes are unequal because the
projector's keystone moves the carrier off the band's middle towards both ends of the pattern. Where threshold /
lowest exceeds 1, stripes are lost in whole, as the dissertation's ratio says.
""",
    )
