"""Ten seconds of flips at the refresh, and what may run beside them."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from drivers.kms.projector import KmsProjector
from scanner.decode import decoder_for
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize

SCRATCH = Path("/var/tmp/load")  # noqa: S108  (a disk, not a RAM file system)


def flip_six_hundred(projector: KmsProjector) -> int:
    """Flip as fast as the display takes it; the number of blanks that went by unused.

    Every stamp lies where the count of blanks says, so that none of them went by unsaid.
    """
    projector.load([np.full((480, 640), 10 * i, dtype=np.uint8) for i in range(24)])
    flips = [projector.show(i % 24) for i in range(600)]
    refresh = projector.capabilities.refresh_ns
    steps = [after.vblank - before.vblank for before, after in itertools.pairwise(flips)]
    times = [after.t_ns - before.t_ns for before, after in itertools.pairwise(flips)]
    unused = sum(step - 1 for step in steps)
    print(f"600 flips: {unused} blanks unused, worst {max(steps) - 1} in a row")
    assert min(steps) >= 1
    for step, time_ns in zip(steps, times, strict=True):
        assert abs(time_ns - step * refresh) <= 2 * flips[0].bound_ns
    return unused


@contextmanager
def decoding_and_writing() -> Iterator[None]:
    """A process beside this one that decodes scans, and writes every frame and result through to the disk."""
    sequence = PatternSequence.bracketed(ProjectorSize(640, 480), PmpPattern(frequencies=(1.0, 8.0), shifts=(4, 4)))
    images = [sequence.image(position) for position in range(len(sequence))]
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        try:
            with SCRATCH.open("wb") as file:
                while True:
                    decoder = decoder_for(sequence, CameraFormat(640, 480, 8))
                    for position, image in enumerate(images):
                        decoder.add(position, image)
                        file.write(image.tobytes())
                    file.write(np.asarray(decoder.finish().rows).tobytes())
                    os.fsync(file.fileno())
                    file.seek(0)
                    os.write(writer, b".")
        finally:
            os._exit(1)
    os.close(writer)
    assert os.read(reader, 1) == b"."
    try:
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        rounds = len(os.read(reader, 1 << 16))
        os.close(reader)
        SCRATCH.unlink()
    print(f"beside it {rounds} scans of {len(images)} frames were decoded and written")
    assert rounds >= 3
