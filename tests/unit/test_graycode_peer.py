"""Gray code against its peer: OpenCV's GrayCodePattern, which is in opencv-contrib and not in what this needs."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np
import pytest

from scanner.decode.graycode import GrayDecoder
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, ProjectorSize

PEER = getattr(cv2, "structured_light", None)
needs_peer = pytest.mark.skipif(PEER is None, reason="OpenCV's GrayCodePattern needs opencv-contrib, not installed")
SIZES = [ProjectorSize(1920, 1080), ProjectorSize(640, 480)]
DIGESTS = {
    1920: "87b94b73d276d07f277239d073f951007944704218198a9e78c9e564f5d32db6",
    640: "25a5404427432103471ff7845b7dd50c393f5173c70f5f39bcd8abbaf084577d",
}
"""SHA-256 of all images that GrayCodePattern.create(width, height).generate() of OpenCV 5.0.0 gives, in its order."""


def images_of(size):
    """Ours, with as many bits along each axis as the peer takes: columns first."""
    found = []
    for axis in ("x", "y"):
        bits = int(np.ceil(np.log2(size.along(axis))))
        sequence = PatternSequence(size, GrayPattern((axis,), bits, bits, inverse=True))
        found += [sequence.image(position) for position in range(len(sequence))]
    return found


@pytest.mark.parametrize("size", SIZES, ids=lambda size: str(size.width))
def test_images_are_those_of_the_peer(size):
    digest = hashlib.sha256()
    for image in images_of(size):
        digest.update(np.ascontiguousarray(image).tobytes())
    assert digest.hexdigest() == DIGESTS[size.width]


@needs_peer
@pytest.mark.parametrize("size", SIZES, ids=lambda size: str(size.width))
def test_the_peer_gives_these_images_today(size):
    found, images = PEER.GrayCodePattern.create(size.width, size.height).generate()
    assert found
    assert all(np.array_equal(ours, theirs) for ours, theirs in zip(images_of(size), images, strict=True))


@needs_peer
def test_frames_are_decoded_as_the_peer_does():
    """Of a slanted surface, with noise: the same projector pixel wherever both name one."""
    size, camera = ProjectorSize(1920, 1080), CameraFormat(320, 240, 8)
    sequence = PatternSequence(size, GrayPattern(("x", "y"), 11, 11, inverse=True))
    y, x = np.mgrid[: camera.height, : camera.width]
    rows, columns = (100 + 3.1 * y + 0.2 * x).astype(int), (200 + 4.3 * x + 0.3 * y).astype(int)
    rng = np.random.default_rng(2)
    frames = [
        np.clip(30 + 180 * sequence.light(n)[rows, columns] + rng.normal(0, 2, camera.shape), 0, 255).astype(np.uint8)
        for n in range(len(sequence))
    ]
    decoder = GrayDecoder(sequence, camera)
    for n, frame in enumerate(frames):
        decoder.keep(n, frame)
    ours = decoder.finish()
    peer = PEER.GrayCodePattern.create(size.width, size.height)
    compared = 0
    for v in range(0, camera.height, 7):
        for u in range(0, camera.width, 7):
            failed, (column, row) = peer.getProjPixel(frames, u, v)
            if not failed and ours.reason[v, u] == 0:
                compared += 1
                assert (ours.columns[v, u], ours.rows[v, u]) == (column, row)
    assert compared > 1000
