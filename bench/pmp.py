"""Speed of PMP and Gray code decoding, as times and as ratios to what is measured beside them in the same run.

    python bench/pmp.py [--size 1392x1040] [--bits 8] [--frequencies 1,8,64] [--shifts 8] [--runs 15] [--gray]

For one thread and for as many as there are: ms to decode frames that are all at hand, to all maps (`finish`) and to
coordinates and confidence alone (`coordinates`); ms a frame and after the last one where they come one by one, and how
much that is beyond a pass over frames at hand; reading all frames once, and writing two float32 maps besides; a decode
with OpenCV and NumPy; and `fringes` (PyPI, mode "fast"), or with --gray OpenCV's GrayCodePattern, if installed.
Frames rotate over several stacks, so that none is still in a cache from the run before. Medians and (least) times;
ratios are medians of ratios of what ran one after the other, and (those of the least times): a busy machine moves
medians of what takes long, and of two threads more than of one. A decoder and its maps are made before its time runs,
as in a scan.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numba
import numpy as np

from scanner.decode import graycode, pmp
from scanner.decode.strips import threads_to_use
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize

PROJECTOR = ProjectorSize(1152, 864)
STACKS = 4
BLOCKS = 5
"""Of another's runs and of ours, in turns."""
SETTLING = 0.1
"""Seconds of a block that are not counted: the threads of NumPy's BLAS go on looking for work for a quarter of it, and
take a processor from whoever runs next."""


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
        kind = graycode.GrayDecoder
        graycode.warm_up()
    else:
        frequencies = tuple(float(f) for f in chosen.frequencies.split(","))
        sequence = PatternSequence(PROJECTOR, PmpPattern(("y",), frequencies, (chosen.shifts,) * len(frequencies)))
        kind = pmp.PmpDecoder
        pmp.warm_up()
    stacks = [frames_of(sequence, camera, seed) for seed in range(STACKS)]
    read(np.zeros(8, np.uint64))
    print(f"{len(sequence)} frames {width} x {height}, {camera.dtype}; ms, median (least)")
    for threads in sorted({1, threads_to_use()}):
        measure(kind, sequence, camera, stacks, chosen.runs, threads)
    if chosen.gray:
        measure_peer(stacks[0])
    else:
        measure_others(sequence, camera, stacks, chosen.runs)


def measure(kind, sequence, camera, stacks, runs, threads):
    """Print the rows of one number of threads. What is compared runs in turns; ratios are medians over them."""
    whole, brief, adding, finishing, floor, reading, decided = [], [], [], [], [], [], []
    for run in range(runs):
        decoder = kind(sequence, camera, threads=threads)
        begin = time.perf_counter()
        keep_all(decoder, stacks[run % STACKS])
        found = decoder.finish()
        whole.append(time.perf_counter() - begin)
        decided.append(float(np.mean(found.reason == 0)))
        floor.append(read_and_write(stacks[(run + 2) % STACKS], threads))
        brief.append(coordinates_time(kind(sequence, camera, threads=threads), stacks[(run + 1) % STACKS]))
        reading.append(read_and_write(stacks[(run + 3) % STACKS], threads, maps=False))
        decoder = kind(sequence, camera, threads=threads)
        begin = time.perf_counter()
        for position, frame in enumerate(stacks[(run + 2) % STACKS]):
            decoder.add(position, frame)
        middle = time.perf_counter()
        decoder.finish()
        adding.append((middle - begin) / len(sequence))
        finishing.append(time.perf_counter() - middle)
    name = "one thread" if threads == 1 else f"{threads} threads"
    print(f"{name}, {min(decided):.1%} decided")
    for label, times in (
        ("all frames at hand, all maps", whole),
        ("coordinates and confidence", brief),
        ("one by one: a frame", adding),
        ("one by one: after the last", finishing),
        ("read once, write two maps", floor),
        ("read once", reading),
    ):
        to_floor, to_reading = (ratio(times, other) for other in (floor, reading))
        print(
            f"  {label:30s}{1e3 * np.median(times):8.2f} ({1e3 * min(times):.2f})"
            f"   {to_floor} x read and write, {to_reading} x read"
        )
    beyond = np.subtract(finishing, whole)
    print(f"  {'after the last, beyond a pass':30s}{1e3 * np.median(beyond):8.2f} ({1e3 * min(beyond):.2f})")


def ratio(times, others):
    """Median of the ratios of what ran one after the other, and that of the least times, which nobody disturbed."""
    return f"{np.median(np.divide(times, others)):5.2f} ({min(times) / min(others):.2f})"


def keep_all(decoder, frames):
    """Give all frames to a decoder where they lie."""
    for position, frame in enumerate(frames):
        decoder.keep(position, frame)


def coordinates_time(decoder, frames):
    """Seconds of a decode to coordinates and confidence."""
    begin = time.perf_counter()
    keep_all(decoder, frames)
    decoder.coordinates()
    return time.perf_counter() - begin


def measure_others(sequence, camera, stacks, runs):
    """Print what others need for the same frames; one thread is theirs to choose.

    Theirs and ours run in blocks that take turns. Each ratio is that of the medians of two blocks side by side; what is
    told is their median, the least and greatest of them, and the ratio of the least times.
    """
    others = {"OpenCV and NumPy": lambda frames: plain_decode(sequence.pattern, frames)}
    if importlib.util.find_spec("fringes") is not None:
        others['fringes, mode "fast"'] = decode = decoder_of_fringes(sequence.pattern)
        # Its rows count from the projector's edge, ours from the first row's middle.
        require_fringes_agrees(decode, stacks[0], coordinates_of(sequence, camera, stacks[0]) + sequence.pattern.origin)
    else:
        print("fringes is not installed: no comparison with it")
    for name, decode in others.items():
        times, ours, ratios = [], [], []
        for _ in range(BLOCKS):
            times.append(
                block_of(lambda frames, decode=decode: time_of(decode, frames), stacks, max(2, runs // BLOCKS))
            )
            ours.append(
                block_of(lambda frames: coordinates_time(pmp.PmpDecoder(sequence, camera), frames), stacks, runs)
            )
            ratios.append(np.median(times[-1]) / np.median(ours[-1]))
        print(
            f"{name:30s}{1e3 * np.median(times):8.1f} ({1e3 * np.min(times):.1f})   {np.median(ratios):5.1f} x ours, "
            f"{1e3 * np.median(ours):.2f} ({min(ratios):.1f} to {max(ratios):.1f}; "
            f"least times {np.min(times) / np.min(ours):.1f})"
        )


def block_of(seconds_of, stacks, runs):
    """(runs,) seconds of runs one after the other, on stacks in rotation, after SETTLING."""
    begin, run = time.perf_counter(), 0
    while run == 0 or time.perf_counter() - begin < SETTLING:
        seconds_of(stacks[run % STACKS])
        run += 1
    return [seconds_of(stacks[run % STACKS]) for run in range(runs)]


def time_of(decode, frames):
    """Seconds of a decode by others."""
    begin = time.perf_counter()
    decode(frames)
    return time.perf_counter() - begin


def measure_peer(frames):
    """Print what OpenCV's GrayCodePattern needs, if opencv-contrib is there: its decode is for two cameras at once."""
    if not hasattr(cv2, "structured_light"):
        print("opencv-contrib is not installed: no comparison with its GrayCodePattern")
        return
    columns, rows = (2 * int(np.ceil(np.log2(size))) for size in (PROJECTOR.width, PROJECTOR.height))
    images = [*frames[:columns], *frames[-rows:]]
    peer = cv2.structured_light.GrayCodePattern.create(PROJECTOR.width, PROJECTOR.height)
    black, white = np.zeros_like(images[0]), np.full_like(images[0], 255)
    begin = time.perf_counter()
    peer.decode([images, images], None, [black, black], [white, white])
    print(f"{'OpenCV, half of two cameras':30s}{500 * (time.perf_counter() - begin):8.1f}")


def coordinates_of(sequence, camera, frames):
    """Rows of our decoder."""
    decoder = pmp.PmpDecoder(sequence, camera)
    for position, frame in enumerate(frames):
        decoder.add(position, frame)
    return decoder.finish().rows


def plain_decode(pattern, frames):
    """Rows and modulation over mean, as a tutorial has it: for sets whose first has one period."""
    absolute, before, first = None, None, 0
    for f, shifts in zip(pattern.frequencies, pattern.shifts, strict=True):
        samples = frames[first : first + shifts].astype(np.float32)
        alpha = pattern.sign * 2 * np.pi * np.arange(shifts) / shifts + pattern.offset
        p = np.tensordot(np.cos(alpha).astype(np.float32), samples, 1)
        q = np.tensordot(-np.sin(alpha).astype(np.float32), samples, 1)
        cycles = cv2.phase(p, q) / (2 * np.pi)
        absolute = cycles if absolute is None else cycles + np.rint(absolute * (f / before) - cycles)
        confidence = cv2.magnitude(p, q) / np.maximum(samples.mean(axis=0), 1)
        before, first = f, first + shifts
    return absolute / before * PROJECTOR.height - pattern.origin, confidence


def decoder_of_fringes(pattern):
    """The decode of the package `fringes`, 2.0.1 or later, for the same sets (GPL; never a dependency)."""
    from fringes import Fringes  # noqa: PLC0415  (GPL: only where a user has installed it)

    fringes = Fringes(Y=PROJECTOR.height, X=PROJECTOR.width)
    fringes.axes = (0,)
    fringes.K = len(pattern.frequencies)
    fringes.N = list(pattern.shifts)
    fringes.v = list(pattern.frequencies)
    fringes.p0 = 0.0  # its phase starts at the projector's edge, as ours does
    fringes.mode = "fast"
    return fringes.decode


def require_fringes_agrees(decode, frames, ours):
    """What is timed must be the same work: rows that differ by less than a tenth of one, but for wrong periods."""
    theirs = np.asarray(decode(frames).x, np.float64).squeeze()
    off = np.abs(theirs - ours)
    share = float(np.mean(off[np.isfinite(ours)] < 0.1))
    print(f"fringes: rows agree with ours to {np.nanmedian(off):.4f} (median), {share:.2%} to better than 0.1")
    assert share > 0.99, "fringes decodes something else: check its axes, sets and phase offset against ours"


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


@numba.njit(nogil=True)
def read(words):
    """All bits of all words, in one: nothing reads memory faster (np.bitwise_or.reduce takes half as long again)."""
    bits = np.uint64(0)
    for i in range(words.size):
        bits |= words[i]
    return bits


_maps = {}
_pool = ThreadPoolExecutor()
"""Threads that are there already, as a decoder's are."""


def read_and_write(stack, threads, maps=True):
    """Seconds to read every frame once and to write two maps (or none), where memory is already there."""
    words = stack.reshape(-1).view(np.uint64)
    maps = _maps.setdefault(stack.shape[1:], np.full(2 * stack[0].size, 0, np.float32))[: None if maps else 0]

    def part(i):
        read(words[i * words.size // threads : (i + 1) * words.size // threads])
        maps[i * maps.size // threads : (i + 1) * maps.size // threads].fill(1)

    begin = time.perf_counter()
    if threads == 1:
        part(0)
    else:
        others = [_pool.submit(part, i) for i in range(1, threads)]
        part(0)
        for other in others:
            other.result()
    return time.perf_counter() - begin


if __name__ == "__main__":
    main()
