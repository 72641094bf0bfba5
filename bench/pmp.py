"""Speed of PMP and Gray code decoding: frames as they come, then what is left to do after the last one. One thread.

    python bench/pmp.py [--size 1392x1040] [--bits 8] [--frequencies 1,8,64] [--shifts 8] [--runs 15] [--gray]

Prints, as medians: ms a frame for taking it (the set's fit included), ms after the last frame, and their sum as a ratio
to reading all frames once and writing the maps, measured in the same run. Frames rotate over several stacks, so that
none is still in a cache from the run before.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from scanner.decode import decoder_for, graycode, pmp
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize

PROJECTOR = ProjectorSize(1152, 864)
STACKS = 3


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1392x1040")
    parser.add_argument("--bits", type=int, default=8)
    parser.add_argument("--frequencies", default="1,8,64")
    parser.add_argument("--shifts", type=int, default=8)
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--gray", action="store_true", help="Gray code with inverses along both axes instead")
    chosen = parser.parse_args()
    width, height = (int(n) for n in chosen.size.split("x"))
    camera = CameraFormat(width, height, chosen.bits)
    if chosen.gray:
        sequence = PatternSequence(PROJECTOR, GrayPattern(("x", "y"), 11, 11, inverse=True))
        graycode.warm_up()
    else:
        frequencies = tuple(float(f) for f in chosen.frequencies.split(","))
        sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), frequencies, (chosen.shifts,) * len(frequencies)))
        pmp.warm_up()
    stacks = [frames_of(sequence, camera, seed) for seed in range(STACKS)]
    adding, finishing, memory, decided = [], [], [], []
    for run in range(chosen.runs):
        add, finish, share = decode(sequence, camera, stacks[run % STACKS])
        adding.append(add)
        finishing.append(finish)
        decided.append(share)
        memory.append(read_and_write(stacks[(run + 1) % STACKS], 2 if chosen.gray else 1))
    count, whole = len(sequence), np.array(adding) + np.array(finishing)
    print(f"{count} frames {width} x {height}, {camera.dtype}, {min(decided):.1%} decided")
    print(f"  take a frame          {np.median(adding) / count:7.2f} ms")
    print(f"  after the last        {np.median(finishing):7.2f} ms")
    print(f"  all of it             {np.median(whole):7.2f} ms")
    print(f"  read once, write maps {np.median(memory):7.2f} ms      ratio {np.median(whole) / np.median(memory):.1f}")


def frames_of(sequence, camera, seed):
    """(frames, H, W): a tilted board, with shot and read noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: camera.height, : camera.width]
    rows = 20 + (PROJECTOR.height - 40) * (y / camera.height) + 8 * np.sin(x / 200)
    columns = 20 + (PROJECTOR.width - 40) * (x / camera.width) + 8 * np.sin(y / 200)
    at = np.rint(rows).astype(np.intp), np.rint(columns).astype(np.intp)
    noise = rng.normal(size=(camera.height, camera.width)).astype(np.float32)
    stack = np.empty((len(sequence), camera.height, camera.width), camera.dtype)
    for position, frame in enumerate(stack):
        grey = (0.04 + 0.8 * sequence.light(position)[at]) * camera.max_value
        # One field of noise, shifted for each frame: as good as new for timing, and much quicker to make.
        grey += 0.01 * camera.max_value * np.roll(noise, 977 * position)
        frame[:] = np.rint(np.clip(grey, 0, camera.max_value))
    return stack


def decode(sequence, camera, stack):
    """ms to take all frames, ms to finish, share of pixels decided."""
    decoder = decoder_for(sequence, camera)
    begin = time.perf_counter()
    for position, frame in enumerate(stack):
        decoder.add(position, frame)
    middle = time.perf_counter()
    found = decoder.finish()
    end = time.perf_counter()
    return 1e3 * (middle - begin), 1e3 * (end - middle), float(np.mean(found.reason == 0))


def read_and_write(stack, axes):
    """ms to read every frame once and to write an axis's maps and the common ones, where memory is already there."""
    words = stack.reshape(-1).view(np.uint64)
    maps = np.zeros((2 * axes + 3, *stack.shape[1:]), np.float32)
    begin = time.perf_counter()
    np.bitwise_or.reduce(words)
    maps.fill(1)
    return 1e3 * (time.perf_counter() - begin)


if __name__ == "__main__":
    main()
