"""Speed of the MCP decoder: one frame of casey2011, uint8 image to dense rows, one thread.

    python bench/mcp.py [--scene bust] [--pattern own|published] [--runs 20]

Prints the median CPU time of a decode and of each stage, ms, after two frames that warm caches.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numba
import numpy as np
from mcp_accuracy import PATTERNS, take

from scanner.decode.mcp import decode_image, warm_up


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="bust")
    parser.add_argument("--pattern", default="own", choices=PATTERNS)
    parser.add_argument("--runs", type=int, default=20)
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    warm_up()
    frame, sequence, camera, *_ = take(f"casey2011/{chosen.scene}", PATTERNS[chosen.pattern])
    total, stages = [], []
    for run in range(chosen.runs + 2):
        begin = time.thread_time()
        decoded = decode_image(frame, sequence.pattern, sequence.projector, camera)
        if run >= 2:
            total.append(1e3 * (time.thread_time() - begin))
            stages.append(decoded.details["stages_ms"])
    for name in stages[0]:
        print(f"  {name:16s} {np.median([s[name] for s in stages]):7.2f} ms")
    print(f"{chosen.scene}, {chosen.pattern}: {np.median(total):.1f} ms a frame, {camera.width} x {camera.height}")


if __name__ == "__main__":
    main()
