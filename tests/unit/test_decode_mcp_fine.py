"""MCP frames of too few pixels: the refusal says so, and says nothing of it where the pixels are enough."""

import cv2
import numpy as np
import pytest

from scanner.decode import decoder_for
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize

SEQUENCE = PatternSequence(ProjectorSize(1152, 864), McpPattern())


def refusal(image: np.ndarray) -> str:
    decoder = decoder_for(SEQUENCE, CameraFormat(image.shape[1], image.shape[0]), "default", None)
    decoder.add(0, image)
    with pytest.raises(DecodeError) as caught:
        decoder.finish()
    return str(caught.value.hint)


def test_stripes_too_fine_for_the_camera_are_said_to_be() -> None:
    noise = np.random.default_rng(5).normal(0, 3, (108, 144))
    seen = cv2.resize(SEQUENCE.image(0), (144, 108), interpolation=cv2.INTER_AREA)
    said = refusal(np.clip(0.3 * seen + 20 + noise, 0, 255).astype(np.uint8))
    assert "32 on 108 px are 3.4 px high, 5 are needed" in said
    assert "fewer bits" in said
    assert "too fine" not in refusal(np.full((432, 576), 20, np.uint8))
