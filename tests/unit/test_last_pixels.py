"""An image's last pixels, fewer than a vector: read from copies, which must live as long as they are read.

In a process of its own, where memory is overwritten as soon as it is freed (mallopt(3), M_PERTURB).
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

DECODING = """
import numpy as np
from scanner.decode.graycode import GrayDecoder
from scanner.decode.pmp import PmpDecoder
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize

for bits in (8, 16):
    camera = CameraFormat(200, 150, bits)
    truth = np.repeat(np.linspace(10, 230, camera.height)[:, None], camera.width, axis=1)
    for decoder, pattern in (
        (PmpDecoder, PmpPattern(("y",), (1.0, 8.0, 40.0), (4, 4, 6))),
        (GrayDecoder, GrayPattern(("y",), 8, 8)),
    ):
        sequence = PatternSequence(ProjectorSize(320, 240), pattern)
        it = decoder(sequence, camera, threads=1)
        for position in range(len(sequence)):
            line = np.interp(truth, np.arange(240), sequence.light(position)[:, 0])
            it.add(position, np.rint((0.1 + 0.8 * line) * camera.max_value).astype(camera.dtype))
        off = np.abs(it.finish().rows - truth).reshape(-1)
        print(decoder.__name__, bits, off.size % 32, np.isfinite(off[-16:]).sum(), np.nanmax(off[-16:]) < 1)
"""


def test_they_are_those_of_the_image() -> None:
    overwriting = {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0", "MALLOC_PERTURB_": "165"}
    ran = subprocess.run(
        [sys.executable, "-c", DECODING],
        env={**os.environ, **overwriting},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    decoders = [f"{name} {bits}" for bits in (8, 16) for name in ("PmpDecoder", "GrayDecoder")]
    assert ran.stdout.splitlines() == [f"{decoder} 16 16 True" for decoder in decoders]
