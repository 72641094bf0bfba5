"""Speed of the MCP decoder: frames of casey2011, uint8 image to dense rows and to dense XYZ float32.

    python bench/mcp.py [--scene bust] [--pattern own|published] [--runs 20] [--seconds 20] [--threads 2] [--calibrated]

Prints the median CPU time of one thread, ms: of a frame decoded by itself to all maps, of one in a series (pitch and
carriers are known from the frame before) with each stage, of one in a series to rows alone, and of its XYZ; stages that
have a plain NumPy form in that form too, as a ratio (`mcp_plain`); the reference decoder (casey2011) with each stage,
which must take 400 ms at most; then the frames a second that so many threads sustain, each with a decoder of its own,
from image to XYZ. Fails where the reference decoder takes longer.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time

import cv2
import mcp_plain
import numba
import numpy as np
from mcp_accuracy import PATTERNS, take

from scanner.decode import decoder_for
from scanner.decode.mcp import casey2011, decode_image, warm_up
from scanner.decode.mcp.decoder import decode_next, positions_next
from scanner.triangulation import triangulate

MOST_REFERENCE_MS = 400.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="bust")
    parser.add_argument("--pattern", default="own", choices=PATTERNS)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--calibrated", action="store_true", help="the decoder knows the rig's calibration, too")
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    warm_up()
    frame, sequence, camera, _, calibration = take(f"casey2011/{chosen.scene}", PATTERNS[chosen.pattern])
    given = (frame, sequence.pattern, sequence.projector, camera)
    rig = calibration if chosen.calibrated else None
    known = decode_next(*given, None, calibration=rig)[1]
    alone, series, rows, points, stages = [], [], [], [], []
    for _ in range(chosen.runs + 2):
        timed(alone, lambda: decode_image(*given, rig))
        decoded, _ = timed(series, lambda: decode_next(*given, known, calibration=rig))
        stages.append(decoded.details["stages_ms"])
        found, _ = timed(rows, lambda: positions_next(*given, known, calibration=rig))
        timed(points, lambda: triangulate(calibration, rows=found))  # noqa: B023
    for name in stages[-1]:
        print(f"  {name:16s} {np.median([s[name] for s in stages[2:]]):7.2f} ms")
    one, next_one, positions, xyz = (float(np.median(times[2:])) for times in (alone, series, rows, points))
    print(f"{chosen.scene}, {chosen.pattern}, {camera.width} x {camera.height}: by itself {one:.1f} ms a frame,")
    print(f"  in a series {next_one:.1f} ms, rows alone {positions:.1f} ms, XYZ {xyz:.1f} ms:")
    print(f"  image to XYZ {positions + xyz:.1f} ms, with all maps {next_one + xyz:.1f} ms")
    upright = frame if sequence.pattern.axis == "y" else np.ascontiguousarray(frame.T)
    mcp_plain.compare(lambda: decode_next(*given, known), upright, calibration, found)
    reference = reference_decoder(given, max(3, chosen.runs // 4))
    if chosen.seconds:
        rate = sustained(frame, sequence, camera, calibration, rig, chosen.threads, chosen.seconds)
        print(f"  {chosen.threads} threads over {chosen.seconds:g} s: {rate:.1f} frames a second, image to XYZ")
    return int(reference > MOST_REFERENCE_MS)


def reference_decoder(given, runs):
    """Print the reference decoder's stages; its median CPU time, ms."""
    casey2011.warm_up()
    times, stages = [], []
    for _ in range(runs + 1):
        stages.append(timed(times, lambda: casey2011.decode_image(*given)).details["timings_ms"])
    whole = float(np.median(times[1:]))
    print(f"  reference decoder (casey2011): {whole:.1f} ms a frame (at most {MOST_REFERENCE_MS:g})")
    for name in stages[-1]:
        print(f"    {name:20s}{np.median([s[name] for s in stages[1:]]):7.2f} ms")
    return whole


def timed(times, work):
    """What `work` returns; its CPU time, ms, goes to `times`."""
    begin = time.thread_time()
    result = work()
    times.append(1e3 * (time.thread_time() - begin))
    return result


def sustained(frame, sequence, camera, calibration, rig, threads, seconds):
    """Frames a second, image to XYZ, of some threads that decode without a pause."""
    end = time.perf_counter() + seconds
    counts = [0] * threads

    def work(number):
        decoder = decoder_for(sequence, camera, calibration=rig)
        while time.perf_counter() < end:
            decoder.add(0, frame)
            triangulate(calibration, rows=decoder.positions())
            decoder.next_frame()
            counts[number] += 1

    crew = [threading.Thread(target=work, args=(number,)) for number in range(threads)]
    for thread in crew:
        thread.start()
    for thread in crew:
        thread.join()
    return sum(counts) / seconds


if __name__ == "__main__":
    sys.exit(main())
